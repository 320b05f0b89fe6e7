"""What is kept on disk: found again, never stale, never an error; and the keys that make it so."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

import lqrsim as ls
from lqrsim import rotations
from lqrsim.codegen import compiled_module, disk_cache, symbolic
from lqrsim.codegen.compiled_module import CompiledModule
from lqrsim.codegen.fingerprint import fingerprint, identity
from lqrsim.codegen.sources import text_source
from lqrsim.codegen.user_functions import UserFunction, address_of

# The smallest problem there is, in a file of its own so that two processes trace the same function.
SYSTEM = """
import sys
import lqrsim as ls
from lqrsim.codegen import compiled_module

def decay(x, u, p):
    from sympy import exp
    return [p.gain * u[0] - x[0] * exp(-x[0])]

problem = ls.Problem(
    dynamics=ls.Dynamics(decay, states={"x": ""}, controls={"u": ""}, parameters={"gain": 2.0}), dt=0.1, steps=10,
    initial=ls.QuadraticCost([1.0], about=[1.0]), stage_cost=ls.ControlCost([1.0], about=[0.0]),
    final_cost=ls.QuadraticCost([5.0], about=[0.0]),
)
solution = ls.ilqr(problem)
print(repr(solution.cost), len(compiled_module.compilations), "sympy" in sys.modules, solution.status.name)
"""


def start(tmp_path: Path, folder: Path) -> "subprocess.Popen[str]":
    script = tmp_path / "system.py"
    script.write_text(SYSTEM)
    environment = {**os.environ, "LQRSIM_CACHE_DIR": str(folder)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, str(script)], env=environment, **pipes)


def finish(process: "subprocess.Popen[str]") -> tuple[list[str], str]:
    out, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    return out.split(), errors


@pytest.mark.long
def test_two_processes_compile_the_same_at_once_and_the_third_finds_it(tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    first, second = (finish(process) for process in [start(tmp_path, folder), start(tmp_path, folder)])
    assert "compiling ilqr for 1 states and 1 controls" in first[1]
    third, silence = finish(start(tmp_path, folder))
    # The same bits, whether compiled or loaded; loaded without compiling and without SymPy; nothing left over.
    assert first[0][0] == second[0][0] == third[0]
    assert third[1:] == ["0", "False", "CONVERGED"]
    assert silence == ""
    names = [path.name for path in folder.iterdir()]
    assert all((name.endswith(".item") and not name.startswith(".")) or name == "durations.json" for name in names)


# Each of these processes compiles one function, or loads both; a function that is called is too long to be inlined.
FACTORS = """
import sys
import numpy as np
from lqrsim.codegen import compiled_module
from lqrsim.codegen.compiled_module import CompiledModule
from lqrsim.codegen.sources import text_source
from lqrsim.codegen.user_functions import UserFunction, address_of

for factor in sys.argv[1:]:
    lines = "".join(f"    total = cos(total + {factor} * sin(x[0] * {i}))\\n" for i in range(40))
    source = f"def helper(x):\\n    total = {factor}.0\\n{lines}    return total\\n\\n"
    source += "def compute(x, out):\\n    for i in range(3):\\n        out[i] = helper(x) + helper(out)\\n"
    out = np.ones(3)
    CompiledModule(text_source(source), {}, "a test").compute(np.array([0.5]), out)
    print(repr(out.tolist()))
print(len(compiled_module.compilations))
"""


def test_what_two_processes_have_kept_does_not_run_each_other(tmp_path: Path) -> None:
    """Both have functions of the same names."""
    environment = {**os.environ, "LQRSIM_CACHE_DIR": str(tmp_path), "PYTHONHASHSEED": "0"}

    def run(*factors: str) -> list[str]:
        command = [sys.executable, "-c", FACTORS, *factors]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=600)
        return done.stdout.splitlines()

    alone = [run("2"), run("3")]
    assert [one[1] for one in alone] == ["1", "1"]
    assert alone[0][0] != alone[1][0]
    assert run("2", "3") == [alone[0][0], alone[1][0], "0"]
    assert run("3", "2") == [alone[1][0], alone[0][0], "0"]


def test_another_problem_of_the_same_size_compiles_only_its_own_and_has_the_same_bits(tmp_path: Path) -> None:
    def solve(system: str, folder: str) -> tuple[str, int]:
        environment = {**os.environ, "LQRSIM_CACHE_DIR": str(tmp_path / folder)}
        (tmp_path / "system.py").write_text(system)  # formulas are traced from a file
        command = [sys.executable, str(tmp_path / "system.py")]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=600)
        cost, compiled, *_ = done.stdout.split()
        return cost, int(compiled)

    other = SYSTEM.replace("x[0] * exp(-x[0])", "x[0] ** 3")
    _, all_of_it = solve(SYSTEM, "shared")
    cost, new = solve(other, "shared")
    alone, as_many = solve(other, "empty")
    assert cost == alone
    assert new == 2  # where a step leads, and how stable it is
    assert as_many == all_of_it


NESTED = b"[" * 100_000 + b"]" * 100_000


@pytest.mark.parametrize(
    "damage",
    [
        lambda item: item[: len(item) // 2], lambda item: b"", lambda item: item[:-1] + b"x",
        lambda item: NESTED + b"\n" + item, lambda item: b"[]\n" + item, lambda item: b'{"sha256": 1}\n' + item,
    ],
)  # fmt: skip
def test_a_damaged_item_is_made_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    source = "def double(x, out):\n    out[0] = 2 * x[0]\n"
    x, out = np.array([21.0]), np.zeros(1)
    for expected in (1, 0, 1, 0):
        before = len(compiled_module.compilations)
        CompiledModule(text_source(source), {}, "a test").double(x, out)
        assert out[0] == 42
        assert len(compiled_module.compilations) - before == expected
        if len(compiled_module.compilations) - before == 0:
            (item,) = tmp_path.iterdir()
            item.write_bytes(damage(item.read_bytes()))


FOREIGN = (
    {}, {"returns": None}, {"returns": 3}, {"returns": [["complex"]]},
)  # fmt: skip


@pytest.mark.parametrize("details", FOREIGN)
def test_what_was_well_kept_and_can_not_be_used_is_made_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, details: dict[str, Any]
) -> None:
    """A checksum does not tell whether another version of the compiler wrote it."""
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    source = "def triple(x, out):\n    out[0] = 3 * x[0]\n"
    x, out = np.array([2.0]), np.zeros(1)
    CompiledModule(text_source(source), {}, "a test").triple(x, out)
    (item,) = tmp_path.iterdir()
    kept = disk_cache.load(item.stem)
    assert kept is not None
    disk_cache.save(item.stem, kept[0], "a test", **details)
    before = len(compiled_module.compilations)
    CompiledModule(text_source(source), {}, "a test").triple(x, out)
    assert out[0] == 6
    assert len(compiled_module.compilations) == before + 1


def test_a_cache_that_can_not_be_written_costs_only_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path / "file" / "cache"))
    out = np.zeros(1)
    for _ in range(2):
        CompiledModule(text_source("def half(x, out):\n    out[0] = x[0] / 2\n"), {}, "a test").half(
            np.array([4.0]), out
        )
        assert out[0] == 2
    assert disk_cache.items() == []
    assert disk_cache.clear() == 0


def test_a_cache_that_can_only_be_read_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    disk_cache.save("kept", b"contents", "a test")

    def refuse(*arguments: object, **options: object) -> None:
        raise PermissionError("read-only")

    monkeypatch.setattr(os, "utime", refuse)
    monkeypatch.setattr(Path, "touch", refuse)
    disk_cache.save("lost", b"contents", "a test")
    assert disk_cache.load("kept") == (b"contents", {})
    assert disk_cache.load("lost") is None


def test_the_cache_is_bounded_and_forgets_what_was_used_longest_ago(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(disk_cache, "LIMIT", 3500)
    for i in range(3):
        disk_cache.save(f"item{i}", bytes(1000), "a test")
        os.utime(tmp_path / f"item{i}.item", (i, i))
    assert disk_cache.load("item0") is not None  # used now
    disk_cache.save("00item", bytes(1000), "a test")
    assert {item.path.stem for item in disk_cache.items()} == {"item0", "item2", "00item"}
    assert disk_cache.clear() == 3
    assert list(tmp_path.iterdir()) == []


def test_saving_reads_no_other_item(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """And looks for the size of others after one item in 256, by its name; the cache stays within its bound."""
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(disk_cache, "LIMIT", 200_000)
    shrink, shrunk = disk_cache._shrink, []
    monkeypatch.setattr(disk_cache, "_shrink", lambda: shrunk.append(shrink()))
    monkeypatch.setattr(disk_cache, "_object_of", lambda text: pytest.fail("read an item"))
    most, count = 0, 800
    for i in range(count):
        disk_cache.save(disk_cache.key(str(i)), bytes(1000), "a test")
        if i % 100 == 0:
            most = max(most, sum(path.stat().st_size for path in tmp_path.glob("*.item")))
    assert 1 <= len(shrunk) <= 10  # 3 on average
    assert 200_000 < most < 200_000 + 2 * 256 * 1200


def test_what_killed_processes_left_goes_when_it_is_old(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    left = [tmp_path / f".unfinished-{i:016x}{suffix}" for i, suffix in enumerate((".item", ".json", ".item"))]
    for path in left:
        path.write_bytes(b"half of ")
    for path in left[:2]:
        os.utime(path, (0, 0))
    disk_cache.save("00kept", b"contents", "a test")
    assert [path.exists() for path in left] == [False, False, True]  # the last may be another process's
    assert disk_cache.clear() == 1
    assert list(tmp_path.iterdir()) == []


def test_derivatives_that_were_kept_by_something_else_are_derived_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def falling(x, u, p):
        return [u[0] - x[0]]

    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    wanted = ls.Dynamics(falling, states={"a": ""}, controls={"b": ""}).source
    (item,) = tmp_path.iterdir()
    for contents in (NESTED, b"[]", b"{}", b'{"source": 3}', b"\xff", b""):
        disk_cache.save(item.stem, contents, "a test")
        assert ls.Dynamics(falling, states={"a": ""}, controls={"b": ""}).source == wanted


def scale(x, u, p):
    return [p.a * FACTOR * x[0]]


FACTOR = 2.0


@dataclass(frozen=True)
class Calling:
    """Has no fingerprint."""

    by: float
    around: Any = None

    def __call__(self, t: float, x: Any) -> Any:
        return replace(x, by=self.by)


class CallingTwice(Calling):
    def __call__(self, t: float, x: Any) -> Any:
        return super().__call__(2 * t, x)

    def method(self, t: float, x: Any) -> Any:
        return x


def identity_in_a_problem(function: Any) -> str:
    return UserFunction(function=function, level="plain", states=1, controls=1, parameters=(), offset=1).identity


@pytest.mark.parametrize("identity", [identity, identity_in_a_problem])
def test_identities_tell_callables_without_fingerprint_apart(identity: Callable[[Any], str]) -> None:
    """By class, fields, arguments, closures, defaults and code; equal ones have one identity, also when new."""

    def made(number: int) -> list[Any]:
        size, other = 0.1 * number, Calling(number)

        def closure(t: float, x: Any) -> Any:
            return replace(x, by=size)

        def around(t: float, x: Any, k: float = number) -> Any:
            return replace(other(t, x), by=1)

        return [
            Calling(number), CallingTwice(number), Calling(1, Calling(number)), Calling(1, [Calling(number)]),
            Calling(1, {"a": Calling(number)}), closure, around, partial(closure, number), partial(closure, x=number),
            partial(Calling(1), number), CallingTwice(number).method,
        ]  # fmt: skip

    one, again, other = made(3), made(3), made(4)
    assert all(fingerprint(each) is None for each in one)
    assert [identity(each) for each in one] == [identity(each) for each in again]
    assert len({identity(each) for each in (*one, *other)}) == 2 * len(one)
    assert identity(lambda t, x: replace(x, by=1)) != identity(lambda t, x: replace(x, by=2))
    assert identity(lambda t, x: replace(x, by=t)) != identity(lambda t, x: replace(x, by=-t))
    itself = Calling(1, [])
    itself.around.append(itself)
    assert identity(itself) == identity(itself)
    deep, other = Calling(1), Calling(2)
    for _ in range(3000):  # beyond what Python lets functions call one another
        deep, other = Calling(1, deep), Calling(1, other)
    assert identity(deep) != identity(other)


def test_a_fingerprint_covers_what_a_function_refers_to(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = {fingerprint(scale)}
    monkeypatch.setitem(globals(), "FACTOR", 3.0)
    seen.add(fingerprint(scale))

    def closure(power: float) -> Callable:
        def inner(x, u, p):
            return [x[0] ** power]

        return inner

    def calling(helper: Callable) -> Callable:
        return lambda x, u, p: [helper(x[0])]

    seen |= {fingerprint(closure(2.0)), fingerprint(closure(3.0))}
    seen |= {fingerprint(calling(lambda y: y)), fingerprint(calling(lambda y: -y))}
    seen |= {fingerprint(lambda x, u, p: rotations.rotate(x[:3], u)), fingerprint(lambda x, u, p, k=1: [k * x[0]])}
    seen |= {fingerprint(lambda x, u, p, k=2: [k * x[0]])}
    # Two functions of the same code that differ in what they enclose.
    square, cube = closure(2.0), closure(3.0)
    seen |= {fingerprint(lambda x, u, p: square(x, u, p) + cube(x, u, p))}
    cube = closure(4.0)
    seen |= {fingerprint(lambda x, u, p: square(x, u, p) + cube(x, u, p))}

    # Which of two functions stands in the third place, when both were seen before.
    def three(a: Callable, b: Callable, c: Callable) -> Callable:
        return lambda x, u, p: a(x, u, p) + b(x, u, p) + c(x, u, p)

    seen |= {fingerprint(three(square, cube, square)), fingerprint(three(square, cube, cube))}
    # A helper with other options of numba's.
    seen |= {fingerprint(calling(numba.njit(fastmath=fast)(lambda y: y))) for fast in (False, True)}
    assert len(seen) == 15
    assert None not in seen
    assert fingerprint(closure(2.0)) == fingerprint(closure(2.0))


class Mass:
    value = 1.0


def test_what_may_change_unseen_has_no_fingerprint() -> None:
    mass = Mass()

    def imports(x, u, p):
        import tests_helper_of_mine  # pyright: ignore[reportMissingImports]

        return [tests_helper_of_mine.drag(x[0])]

    assert fingerprint(lambda x, u, p: [mass.value * x[0]]) is None

    def counts(x, u, p):
        return [x[0] * vars(counts)["calls"]]

    vars(counts)["calls"] = 1
    assert fingerprint(imports) is None
    assert fingerprint(counts) is None
    assert fingerprint(lambda x, u, p: [eval("MASS") * x[0]]) is None
    assert fingerprint(lambda x, u, p: [getattr(p, "mass") * x[0]]) is not None  # noqa: B009
    assert fingerprint(lambda x, u, p: [getattr(Mass, "value") * x[0]]) is None  # noqa: B009
    assert fingerprint(lambda x, u, p: [getattr(scale, "__globals__")["FACTOR"] * x[0]]) is None  # noqa: B009
    assert fingerprint(lambda x, u, p: [scale.__globals__["FACTOR"] * x[0]]) is None
    assert fingerprint(lambda x, u, p: [x[0] * np.random.default_rng().normal()]) is None
    assert fingerprint(lambda x, u, p: [pytest.approx(x[0])]) is None


TABLE = np.linspace(0, 1, 200_000)  # numba refers to what is over a megabyte by its address


def test_code_with_addresses_of_this_process_is_not_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    dynamics = ls.Dynamics(
        numba.njit(lambda x, u, p: (u[0] - TABLE[min(int(abs(x[0]) * 1000), 199_999)],)),
        states={"x": ""}, controls={"u": ""},
    )  # fmt: skip
    assert fingerprint(dynamics.f) is not None
    assert address_of(dynamics.functions[0]) > 0
    assert disk_cache.items() == []


GAIN = 1.0


def test_what_numba_compiled_with_an_old_global_is_not_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))

    @numba.njit
    def drag(v):
        return GAIN * v

    def kept(gain: float) -> int:
        monkeypatch.setitem(globals(), "GAIN", gain)
        function = numba.njit(lambda x, u, p: (u[0] - drag(x[0]),))
        dynamics = ls.Dynamics(function, states={"x": ""}, controls={"u": ""})
        dynamics.functions[0].call(np.ones(1), np.ones(1), {})  # as the solvers do first
        address_of(dynamics.functions[0])
        return len(disk_cache.items())

    assert kept(1.0) == 1
    assert kept(50.0) == 1  # numba's drag still has a gain of 1: under the name of 50 it would be wrong elsewhere


def test_sources_are_kept_by_what_each_name_is() -> None:
    """One control more, or one parameter: the same names, in other places."""

    def falling(x, u, p):
        return [sum(u) - xi for xi in x]

    two = ls.Dynamics(falling, states={"a": ""}, controls={"b": "", "c": ""})
    assert two.rate([1.0], [3.0, 4.0]) == [6.0]
    one = ls.Dynamics(falling, states={"a": ""}, controls={"b": ""}, parameters={"c": 5.0})
    assert one.rate([1.0], [3.0]) == [2.0]


def test_every_module_that_keeps_derivatives_is_in_their_key() -> None:
    texts = {path.stem: path.read_text(encoding="utf-8") for path in Path(ls.__file__).parent.rglob("*.py")}
    assert [name for name, text in texts.items() if "symbolic.kept(" in text and text not in symbolic._writers()] == []


def test_a_formula_that_failed_is_not_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    for _ in range(2):
        with pytest.raises(ls.InputError, match="got 2 entries, want 1: one for each of x"):
            _ = ls.Dynamics(lambda x, u, p: [x[0], u[0]], states={"x": ""}, controls={"u": ""}).source
    assert list(tmp_path.iterdir()) == []
