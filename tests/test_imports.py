"""The architecture: no import runs up a floor, and nothing heavy is imported before it is needed."""

import ast
import functools
import os
import subprocess
import sys
from pathlib import Path

import pytest

import lqrsim

PACKAGE = Path(lqrsim.__file__).parent

# From the ground up: a floor imports only from floors below it; see `FLOORS_WITHIN` for the rooms that have several.
FLOORS = (
    ("errors", "machine", "process"),
    ("annotations",),
    ("kernels",),
    ("rotations", "outlines"),
    ("scenes",),
    ("results",),
    ("codegen",),
    ("problem",),
    ("robots",),
    ("solvers",),
    ("control",),
    ("simulation",),
    ("scenarios", "simulators", "templates"),
    ("stress",),
    ("view",),
    ("gym", "bridge"),
    ("verify",),
    ("reports",),
    ("commands",),
    ("cli",),
    ("__main__",),
    ("belief", "disturbances", "lq", "types"),
)

# Within a room, the same: what is not named here may import whatever is, and its own kind.
FLOORS_WITHIN = {
    "kernels": (("declarations",), ("distances", "linear_algebra", "rotation_ratios", "runge_kutta")),
    "scenes": (("world",),),
    "results": (
        ("coordinates", "solution_parts"),
        ("archive", "display", "goal", "policy"),
        ("solution",),
        ("rollout",),
    ),
    "codegen": (
        ("disk_cache", "language"),
        ("sources",),
        ("fingerprint", "plain", "printer"),
        ("compiled_module", "symbolic"),
        ("user_functions",),
    ),
    "problem": (
        ("dynamics",),
        ("noise", "parts"),
        ("mjcf_dynamics",),
        ("collision_shape",),
        ("control_rate", "force_limits", "formulas", "obstacles", "quadratic_cost", "sites", "state_bounds"),
        ("problem",),
        ("belief",),
    ),
    "solvers": (
        ("budget", "compiled"),
        ("settings",),
        ("stages",),
        ("engine",),
        ("certify",),
        ("assembly", "augmented_lagrangian", "contact_modes", "multistart", "risk"),
        ("control_rates", "finish", "tree"),
        ("between_knots", "free_duration"),
        ("strategy",),
    ),
    "simulation": (("simulator",), ("plant",), ("physics",), ("disturbances",)),
}

# Who may import a heavy package, inside a function too. Type checkers' imports do not count.
ALLOWED = {
    "mujoco": ("scenes", "problem", "robots", "simulation", "view", "verify"),
    "matplotlib": ("view", "reports"),
    "av": ("view", "verify"),
    "jax": ("codegen",),
    "numba": ("codegen",),
    "llvmlite": ("codegen", "machine"),
    "sympy": ("codegen", "outlines", "problem", "rotations", "robots"),
    "tyro": ("cli", "commands"),
    "pyarrow": ("stress",),
    "distributed": ("stress",),
    "jinja2": ("reports", "commands.reproduce"),
    "tqdm": ("commands",),
    "gymnasium": ("gym",),
    "minari": ("gym",),
    "rerun": ("view",),
    "cyclonedds": ("bridge",),
}

MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
    if path != PACKAGE / "__init__.py"
}


def within(module: str, room: str) -> bool:
    return module == room or module.startswith(f"{room}.")


@functools.cache
def floor(module: str) -> tuple[int, int]:
    """Of its room, and within its room."""
    numbers = [number for number, rooms in enumerate(FLOORS) for room in rooms if within(module, room)]
    assert numbers, f"lqrsim.{module} has no room: give it a place in FLOORS"
    room, _, rest = module.partition(".")
    inner = FLOORS_WITHIN.get(room, ())
    for number, names in enumerate(inner):
        if any(within(rest, name) for name in names):
            return numbers[0], number
    return numbers[0], len(inner)


@functools.cache
def imports(path: Path) -> list[str]:
    """Every module that a file imports, in functions too; those under `if TYPE_CHECKING:` excepted."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for_types = {
        id(inner)
        for node in tree.body
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
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
            # `from lqrsim.results import save_load` imports a module, `from lqrsim.errors import Array` a name in one.
            found += [name if name.removeprefix("lqrsim.") in MODULES else str(node.module) for name in names]
    return found


def test_no_import_runs_up() -> None:
    above = [
        f"lqrsim.{module} imports {name}, which is above it"
        for module, path in MODULES.items()
        for name in imports(path)
        if name.startswith("lqrsim.") and floor(name.removeprefix("lqrsim.")) > floor(module)
    ]
    assert above == []


def test_heavy_packages_stay_in_their_rooms() -> None:
    for module, path in MODULES.items():
        for name in imports(path):
            rooms = ALLOWED.get(name.split(".")[0])
            assert rooms is None or any(within(module, room) for room in rooms), f"lqrsim.{module} imports {name}"


def test_importing_is_light() -> None:
    heavy = ("mujoco", "numba", "sympy", "matplotlib", "scipy", "av")
    modules = "lqrsim, lqrsim.cli, lqrsim.results.solution, lqrsim.results.save_load, lqrsim.scenes.world"
    code = f"import sys, {modules}; print(*[name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize(
    ("installed", "line"),
    [
        ({"numpy": "1.26.4"}, "got numpy 1.26.4, want newer: pip install 'numpy>=2.1'"),
        ({"numpy": "2.0.2rc1", "mujoco": "3.10"}, "got mujoco 3.10, numpy 2.0.2rc1, want newer: pip install 'mujoco>="),
        ({"numpy": "2.10.0", "scipy": "1.14"}, ""),
    ],
)
def test_what_is_older_than_lqrsim_needs_is_named_at_import(
    installed: dict[str, str], line: str, tmp_path: Path
) -> None:
    for name, version in installed.items():
        (tmp_path / f"{name}-{version}.dist-info").mkdir()
        text = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
        (tmp_path / f"{name}-{version}.dist-info" / "METADATA").write_text(text)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    ways = ("import lqrsim.results.save_load", "from lqrsim import smooth", "import lqrsim as ls; ls.Problem")
    for first in ways[: 3 if len(installed) == 1 else 1]:
        done = subprocess.run([sys.executable, "-c", first], capture_output=True, text=True, env=environment)
        assert done.returncode == bool(line)
        if line:
            assert done.stderr.splitlines()[-1].startswith(f"ImportError: lqrsim: {line}")
    command = [sys.executable, "-m", "lqrsim.cli", "list"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == (2 if line else 0)
    assert done.stderr.startswith(f"lqrsim: error: {line}" if line else "")
    assert len(done.stderr.splitlines()) == bool(line)


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


def test_the_top_has_what_most_users_need_and_the_rest_has_rooms() -> None:
    assert len(lqrsim.__all__) <= 73
