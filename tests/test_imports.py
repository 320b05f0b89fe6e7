"""The architecture: imports point only upward in a list of rooms, and nothing heavy is imported before it is needed."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import lqrsim

PACKAGE = Path(lqrsim.__file__).parent

# A module may import those above it, and those of its own room; nothing else of the package.
ROOMS = (
    ("errors", "machine", "process", "versions", "solvers.interface"),
    ("plain",),
    ("archive",),
    ("coordinates", "value_functions"),
    ("policy", "target"),
    ("results",),
    ("rollout",),
    ("files",),
    ("cache", "pointers"),
    ("differences", "integration", "laws", "rotations", "world", "solvers.kernels"),
    ("fingerprint",),
    ("tracing",),
    ("functions",),
    ("dynamics",),
    ("costs", "constraints"),
    ("problem", "linear_quadratic"),
    ("checks",),
    ("solvers.primal", "solvers.dual"),
    (
        "solvers.augmented",
        "solvers.certificate",
        "solvers.entries",
        "solvers.limits",
        "solvers.loops",
        "solvers.passes",
        "solvers.lq_passes",
        "solvers.projection",
        "solvers.rollouts",
        "solvers.safeguard",
    ),
    ("core",),
    ("compiled",),
    ("solvers",),
    ("robots",),
    ("scenes",),
    ("simulation.fitting", "simulation.plant"),
    ("simulation.disturbances",),
    ("simulation",),
    ("scenarios",),
    ("references",),
    ("stress",),
    ("view",),
    ("verify",),
    ("console",),
    ("demo", "reproduce"),
    ("commands",),
    ("cli",),
)

# Who may import a heavy package, inside a function too. Type checkers' imports do not count.
ALLOWED = {
    "mujoco": ("scenes", "simulation", "view", "verify"),
    "matplotlib": ("view",),
    "av": ("view", "verify"),
    "numba": ("core", "machine", "pointers"),
    "llvmlite": ("machine", "pointers"),
    "sympy": ("tracing", "dynamics", "rotations", "robots", "costs"),
    "tyro": ("cli", "commands"),
    "pyarrow": ("stress",),
    "distributed": ("stress",),
    "jinja2": ("view",),
    "tqdm": ("console", "reproduce"),
}

MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
    if path != PACKAGE / "__init__.py"
}


def within(module: str, room: str) -> bool:
    return module == room or module.startswith(f"{room}.")


def room_number(module: str) -> int:
    matches = [(len(room), number) for number, rooms in enumerate(ROOMS) for room in rooms if within(module, room)]
    assert matches, f"lqrsim.{module} has no room: give it a place in ROOMS"
    return max(matches)[1]


def imports(path: Path) -> list[str]:
    """Every module that a file imports, in functions too; those under `if TYPE_CHECKING:` excepted."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for_types = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    found: list[str] = []
    for node in ast.walk(tree):
        if id(node) in for_types:
            continue
        if isinstance(node, ast.Import):
            found += [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: a relative import"
            names = [f"{node.module}.{name.name}" for name in node.names]
            # `from lqrsim import files` imports a module, `from lqrsim.files import save` a name in one.
            found += [name if name.removeprefix("lqrsim.") in MODULES else str(node.module) for name in names]
    return found


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_upward(module: str) -> None:
    own = room_number(module)
    for name in imports(MODULES[module]):
        if name.startswith("lqrsim."):
            assert room_number(name.removeprefix("lqrsim.")) <= own, (
                f"lqrsim.{module} imports {name}, which is below it"
            )


@pytest.mark.parametrize("module", MODULES)
def test_heavy_packages_stay_in_their_rooms(module: str) -> None:
    for name in imports(MODULES[module]):
        rooms = ALLOWED.get(name.split(".")[0])
        assert rooms is None or any(within(module, room) for room in rooms), f"lqrsim.{module} imports {name}"


@pytest.mark.parametrize("module", ["lqrsim", "lqrsim.cli", "lqrsim.results", "lqrsim.files", "lqrsim.world"])
def test_importing_is_light(module: str) -> None:
    heavy = ("mujoco", "numba", "sympy", "matplotlib", "scipy", "av")
    code = f"import sys, {module}; print(*[name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("command", ["--help", "solve --help", "--version"])
def test_help_is_fast(command: str) -> None:
    """What takes the time is importing packages, and of those that lqrsim needs it imports the one that prints it."""
    heavy = sorted({*ALLOWED, "numpy", "scipy"} - {"tyro"})
    code = f"import sys; from lqrsim.cli import main\ntry: main({command.split()})\nexcept SystemExit: pass\n"
    code += f"print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    *printed, imported = done.stdout.splitlines()
    assert "lqrsim" in printed[0]
    assert imported == "[]"
