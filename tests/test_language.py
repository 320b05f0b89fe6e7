"""The kernels' language: what compiles does as Python does, and what is not of it is refused with its place."""

import ast
import copy
import ctypes
import math
import textwrap
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from compiling import compiled, run
from constructs import CONSTRUCTS, REFUSED, REFUSED_TEXTS, SIGNATURE
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st
from programs import SIZES, arguments, for_python, numbers_in, on_tracked, programs
from rounding import Unsure, functions_on_tracked, tracked
from sampling import examples
from scipy import special

from lqrsim.codegen import language
from lqrsim.codegen.compiled_module import CompiledModule, compilations, object_code
from lqrsim.codegen.language import SubsetError, type_of
from lqrsim.codegen.plain import plain_functions
from lqrsim.codegen.printer import Program
from lqrsim.codegen.sources import Scope, text_source
from lqrsim.errors import InputError
from lqrsim.kernels.records import Limits, Policy

INF, NAN = math.inf, math.nan


# Whole programs.


def assert_does_as_python(text: str, seed: int) -> None:
    """Exactly where no number is rounded, and elsewhere to the bounds of `rounding.py`; ints and bools exactly."""
    try:
        bounds = on_tracked(arguments(seed))
        limits = functions_on_tracked(text, SIZES)["main"](*bounds)
    except Unsure:
        assume(False)
    wanted, found = for_python(arguments(seed)), arguments(seed)
    with np.errstate(all="ignore"):
        plain = plain_functions(text_source(text), SIZES, ["main"])["main"](*wanted)
    returned = run(text, "main", *found, **SIZES)
    assert (returned is None) == (plain is None)
    numbers = (numbers_in([*each]) for each in ((*found, returned), (*wanted, plain), (*bounds, limits)))
    for one, other, limit in zip(*numbers, strict=True):
        if isinstance(limit, bool | int) and not isinstance(one, float):
            assert one == other == limit
        else:
            # A compiled sum may be in another order than Python's, so they are twice the bound apart at most.
            assert abs(one - other) <= 2 * tracked(limit).error


# To find a smaller program that fails would take minutes: each is compiled.
WITHOUT_SHRINKING = (Phase.explicit, Phase.reuse, Phase.generate)


@settings(max_examples=examples(40), phases=WITHOUT_SHRINKING)
@given(text=programs, seed=st.integers(0, 2**32 - 1))
def test_programs_do_as_python_does(text: str, seed: int) -> None:
    assert_does_as_python(text, seed)


# Each construct by itself: Python says what it returns.


def function(body: str, signature: str = "def f(i, j):") -> str:
    return f"{signature}\n{textwrap.indent(body, '    ')}\n"


def in_python(text: str, name: str = "f", **names: Any) -> Callable[..., Any]:
    """The function as Python has it, with the functions of `math` at hand."""
    known: dict[str, Any] = {**vars(math), **names}
    exec(text, known)
    return known[name]


def assert_same(found: Any, wanted: Any, relative: float = 4e-15) -> None:
    """Numbers of the same kind, ints and bools equal; floats to some ulps, for powers are products."""
    if isinstance(wanted, tuple):
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted, strict=True):
            assert_same(one, other, relative)
        return
    assert found == pytest.approx(wanted, rel=relative if isinstance(found, float) else 0, abs=0, nan_ok=True)
    assert not isinstance(wanted, float) or isinstance(found, float)  # an int may have become one


@pytest.mark.parametrize("construct", CONSTRUCTS)
def test_each_construct_does_as_python_does(construct: str) -> None:
    pairs, body = CONSTRUCTS[construct]
    text = function(body)
    for pair in eval(f"[{pairs}]", {"INF": INF, "NAN": NAN}):
        assert_same(run(text, "f", *pair), in_python(text)(*pair))


def test_a_division_by_zero_gives_infinity_or_nan_and_zero_of_ints() -> None:
    text = "def f(a, b):\n    return a / b, a // b, a % b\n"
    divided = compiled(text, "f", 1.0, 0.0)
    assert divided(1.0, 0.0)[0] == INF
    assert divided(-1.0, 0.0)[0] == -INF
    assert math.isnan(divided(0.0, 0.0)[0])
    for numerator in (1.0, -1.0, 0.0):
        assert not any(map(math.isfinite, divided(numerator, 0.0)))
    assert run(text, "f", 3, 0) == (INF, 0, 0)
    whole = "def f(a):\n    return a // 0, a % 0, 7 // 0, 7 % 0, 1 / 0, a // (a - a)\n"
    assert run(whole, "f", 3) == (0, 0, 0, 0, INF, 0)
    assert all(map(math.isnan, run("def f(a):\n    return 0.0 / 0, 1.5 % 0\n", "f", 1.0)))


def test_nan_and_infinity_keep_their_meaning() -> None:
    text = """\
def f(x, y):
    total = 0.0
    for i in range(3):
        total += x
    return x - x, 0 * x, x / x, total, x + y, not x < y, not x >= y, x != x, min(x, y), max(y, x)
"""
    for x, y in ((INF, 1.0), (NAN, 1.0), (-INF, INF), (2.0, NAN)):
        assert_same(run(text, "f", x, y), in_python(text)(x, y))


def test_exact_functions_lose_no_rounding_error() -> None:
    """That of a sum, which LLVM may otherwise find to be 0."""
    text = """\
@exact
def f(x, y):
    total = x + y
    return (x - total) + y
"""
    assert run(text, "f", 1.0, 1e-17) == 1e-17


def test_and_and_or_stop_where_it_is_decided() -> None:
    """What would count is not called."""
    text = """\
def f(a, words):
    first = a > 0 and fetch_add(words, 0, 1) >= 0
    second = a > 0 or fetch_add(words, 1, 1) >= 0
    if a > 0 and a > 1 and fetch_add(words, 2, 1) >= 0 or fetch_add(words, 3, 1) < 0:
        fetch_add(words, 4, 1)
    third = fetch_add(words, 5, 1) if a > 0 else fetch_add(words, 6, 1)
    return first, second, third
"""
    for a, returned, counted in (
        (-1.0, (False, True, 0), [0, 1, 0, 1, 0, 0, 1]),
        (2.0, (True, True, 0), [1, 0, 1, 0, 1, 1, 0]),
    ):
        words = np.zeros(7, dtype=np.int64)
        assert run(text, "f", a, float(words.ctypes.data)) == returned
        assert words.tolist() == counted


def test_the_field_of_a_row_is_looked_up_once() -> None:
    words, rows = np.zeros(1, dtype=np.int64), np.array([(1.0,), (2.0,)], dtype=[("cost", np.float64)])
    text = "def f(words, rows):\n    return rows[fetch_add(words, 0, 1)].cost\n"
    assert run(text, "f", words.ctypes.data, rows) == 1.0
    assert words[0] == 1


def test_arrays_of_one_to_three_dimensions() -> None:
    text = """\
def f(x, m, c, i, j):
    m[1, 2] = x[3] + c[1, 0, 2]
    row, plane = m[i], c[1]
    row[0] += 2
    plane[j, 1] *= 3
    c[0][j][2] = row[0]
    c[i][2, 3] -= 1.5
    last = plane[2] if i > 0 else x
    last[3] = -7
    own = stack(2, 3)
    for a in range(2):
        for b in range(3):
            own[a, b] = a - b
    x[0], x[1] = x[1], x[0]
    m[0, 0] = x[2] = own[1][2]
    return own[1, 0] + own[0, 2], last[0]
"""
    for i, j in ((0, 2), (1, 0)):
        given = [np.arange(4.0), np.arange(12.0).reshape(3, 4), np.arange(24.0).reshape(2, 3, 4), i, j]
        found, wanted = copy.deepcopy(given), copy.deepcopy(given)
        assert run(text, "f", *found) == in_python(text, stack=lambda *shape: np.empty(shape))(*wanted)
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(one, other)


def test_records_and_rows_and_vectors_in_tuples() -> None:
    text = """\
from lqrsim.kernels.records import Limits, Policy


def shifted(limits, by):
    return Limits(limits.low, limits.high + by)


def f(policy, vectors, log, n):
    limits = Limits(policy.gain[1], 2.5)
    limits.low[0] = limits.high
    moved = shifted(limits, n)
    both = Policy(moved, vectors[n])
    both.gain.low[1] += vectors[0][1]
    low, high = both.gain
    log[n].cost, log[0].gap = both.gain.high, log[1].cost + 1
    log[1].gap -= log[n].cost
    row = log[1]
    row.cost *= 2
    return high, low[0], both[1][0], Limits(n, n).low
"""
    log = np.array([(1.0, 2.0), (3.0, 4.0)], dtype=[("cost", np.float64), ("gap", np.float64)])
    given = [Policy(np.arange(6.0).reshape(2, 3), np.zeros(1)), (np.arange(3.0), np.ones(2)), log, 1]
    found, wanted = copy.deepcopy(given), copy.deepcopy(given)
    wanted[2] = wanted[2].view(np.recarray)
    assert run(text, "f", *found) == in_python(text)(*wanted)
    np.testing.assert_array_equal(found[0].gain, wanted[0].gain)
    np.testing.assert_array_equal(found[2], np.asarray(wanted[2]))


def test_compact_functions_take_records_by_address() -> None:
    """Whether a record is what the caller was given, a part of it, newly made, renamed or replaced."""
    text = """\
from lqrsim.kernels.declarations import compact
from lqrsim.kernels.records import Limits, Policy

@compact
def inner(limits, n):
    low, high = limits
    return limits.low[n] + high if limits.high > 1 else low[0] - n

@compact
def middle(policy, limits, on):
    gain, other, total = policy.gain, limits, 0.0
    for i in range(3):
        part = gain if i > 0 else other
        total = 10 * total + inner(part, i % 2)
        total += inner(gain, 0) + inner(Limits(policy.offset, i), 1)
    limits = Limits(other.low, gain.high + on)
    return total + inner(limits, 1) - inner(other, 0) + policy[0].low[1]

@compact
def f(policy, limits, on):
    renamed, n = policy, 2
    renamed.gain.low[0] += n
    swapped = Policy(limits, renamed.gain.low)
    first = middle(renamed, limits, on) + middle(swapped, swapped.gain, not on)
    policy = Policy(limits, policy.offset)
    return first, middle(policy, renamed.gain, on), on, Limits(n, first).high
"""
    for on, high in ((True, 1.5), (False, 1)):
        given = [Policy(Limits(np.arange(2.0), 2), np.array([3.0, 5.0])), Limits(np.array([7.0, 11.0]), high), on]
        found, wanted = copy.deepcopy(given), copy.deepcopy(given)
        assert run(text, "f", *found) == in_python(text)(*wanted)
        np.testing.assert_array_equal(found[0].gain.low, wanted[0].gain.low)


def test_helpers_are_compiled_for_what_they_are_called_with() -> None:
    text = """\
def half(a):
    return a // 2, a

def first(a):
    b = 0
    if a[0] > 1:
        b = a[0]
    return b

def f(i, x, m):
    a, b = half(i)
    c, d = half(i + 0.5)
    e, _ = half(i > 2)
    return a, b, c, d, e, first(x) + first(m[1])
"""
    given = 7, np.array([1.0, 2.0]), np.array([[0.0, 1.0], [2.5, 3.0]])
    found = run(text, "f", *given)
    assert found == in_python(text)(*given)
    assert [type(one) for one in found] == [int, int, float, float, int, float]


# Functions and constants.

POINTS = np.array([-900.0, -3.5, -1.0, -0.7, -1e-3, -1e-300, 0.0, 1e-300, 1e-3, 0.3, 0.9999, 1.0, 1.5, 20.25, 900.0])
ODD = np.array([NAN, INF, -INF])
# The names that NumPy or SciPy have for what `math` has by another.
ELSEWHERE = {
    "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "asinh": np.arcsinh, "acosh": np.arccosh,
    "atanh": np.arctanh, "erf": special.erf, "erfc": special.erfc, "gamma": special.gamma, "lgamma": special.gammaln,
    "atan2": np.arctan2, "pow": np.power,
}  # fmt: skip


def elsewhere(name: str) -> Any:
    return ELSEWHERE[name] if name in ELSEWHERE else getattr(np, name)


@pytest.mark.parametrize("name", language.UNARY)
def test_functions_of_one_number(name: str) -> None:
    """Against `math` where that has a value, to four ulps, and NumPy or SciPy for what is no number."""
    text = f"def f(x, n, out):\n    for i in range(n):\n        out[i] = {name}(x[i])\n    return {name}(1)\n"
    given = np.concatenate([POINTS, ODD])
    out = np.empty(len(given))
    of_int = run(text, "f", given, len(given), out)
    wanted = []
    with np.errstate(all="ignore"):
        for x in given:
            try:
                wanted.append(float(getattr(math, name)(x)))
            except (ValueError, OverflowError):
                wanted.append(float(elsewhere(name)(x)))
    # Some of these `math` works out itself: lgamma and gamma to some 1e-15, and near a zero of lgamma absolutely.
    np.testing.assert_allclose(out, wanted, rtol=4e-15 if "gamma" in name else 9e-16, atol=1e-15 * (name == "lgamma"))
    assert of_int == out[given == 1][0]


@pytest.mark.parametrize("name", language.UNARY)
def test_functions_of_one_number_in_plain_python(name: str) -> None:
    """Infinite and NaN where the compiled ones are: at poles, beyond all floats, and where nothing is defined."""
    text = f"def f(x, n, out):\n    for i in range(n):\n        out[i] = {name}(x[i])\n"
    given = np.concatenate([POINTS, ODD, [-0.0, -2.0, 0.5, 171.0, 172.0, -200.5, 1e-310, -1e-310, 1e306, -1e300]])
    found, wanted = np.empty(len(given)), np.empty(len(given))
    run(text, "f", given, len(given), wanted)
    with np.errstate(all="ignore"):
        plain_functions(text_source(text), {}, ["f"])["f"](given, len(given), found)
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(wanted))
    np.testing.assert_array_equal(found[~np.isfinite(found)], wanted[~np.isfinite(wanted)])


@pytest.mark.parametrize("name", language.BINARY)
def test_functions_of_two_numbers(name: str) -> None:
    given = np.array([-2.5, -1.0, -0.0, 0.0, 0.5, 1.0, 3.0, 1e10, NAN, INF, -INF])
    a, b = (grid.ravel() for grid in np.meshgrid(given, given))
    out = np.empty(len(a))
    text = (
        f"def f(a, b, n, out):\n    for i in range(n):\n        out[i] = {name}(a[i], b[i])\n    return {name}(3, 2)\n"
    )
    assert run(text, "f", a, b, len(a), out) == pytest.approx(float(getattr(math, name)(3, 2)), rel=1e-15)
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(out, elsewhere(name)(a, b), rtol=1e-15)
    if name in ("copysign", "atan2"):  # the sign of zero, too
        np.testing.assert_array_equal(np.signbit(out), np.signbit(elsewhere(name)(a, b)))


def test_degrees_and_radians() -> None:
    text = "def f(x):\n    return degrees(x), radians(x), degrees(2), radians(180)\n"
    assert set(language.SCALES) == {"degrees", "radians"}
    for x in (0.3, -7.0, INF):
        assert_same(run(text, "f", x), (math.degrees(x), math.radians(x), math.degrees(2), math.pi))


def test_tests_of_numbers() -> None:
    text = "def f(x):\n    return isnan(x), isinf(x), isfinite(x), isnan(0 * x), isfinite(3), isnan(nan), isinf(-inf)\n"
    assert set(language.TESTS) == {"isnan", "isinf", "isfinite"}
    for x in (NAN, INF, -INF, 0.0, -0.0, 1.7e308, 5e-324):
        found = run(text, "f", x)
        assert found == (math.isnan(x), math.isinf(x), math.isfinite(x), not math.isfinite(x), True, True, True)
        assert all(type(one) is bool for one in found)


def test_constants() -> None:
    text = f"def f():\n    return {', '.join(language.CONSTANTS)}, pi > 3\n"
    assert_same(run(text, "f"), (*(getattr(math, name) for name in language.CONSTANTS), True), relative=0)


def test_powers_of_two() -> None:
    text = "def f(x, n, out):\n    for i in range(n):\n        out[i] = power_of_two(x[i])\n"
    given = np.arange(-1022.0, 1024.0)
    out = np.empty(len(given))
    run(text, "f", given, len(given), out)
    np.testing.assert_array_equal(out, np.exp2(given))
    odd = np.array([NAN, INF, -INF, 1e300, -1e300, -1023.0, 1024.0])
    run(text, "f", odd, len(odd), odd)  # any number, but nothing worse


# What is not of the language.


def refusal(text: str, *given: Any) -> str:
    """What is said when it is compiled."""
    with pytest.raises(SubsetError) as caught:
        Program().entry(
            Scope(text_source(text, "my formula"), SIZES).function("f"), tuple(map(type_of, given)), "entry"
        )
    assert isinstance(caught.value, InputError)
    return str(caught.value)


def typical() -> list[Any]:
    log = np.zeros(2, dtype=[("cost", np.float64), ("gap", np.float64)])
    return [1.5, 2, np.ones(3), np.ones((3, 3)), (np.ones(3), np.ones(3)), Limits(np.zeros(3), np.ones(3)), log]


@pytest.mark.parametrize("construct", REFUSED)
def test_what_is_not_of_the_language_is_refused_with_its_place(construct: str) -> None:
    got, body = REFUSED[construct]
    text = f"from lqrsim.kernels.records import Limits\n\n{function(body, SIGNATURE)}"
    (line,) = [i + 1 for i, one in enumerate(text.splitlines()) if one.endswith("  #")] or [4]
    if got.startswith("function: "):
        line, got = 3, got.removeprefix("function: ")
    said = refusal(text, *typical())
    assert said.startswith(f"my formula: f, line {line}: got {got}")
    assert ", want " in said


@pytest.mark.parametrize("construct", REFUSED_TEXTS)
def test_texts_that_are_refused(construct: str) -> None:
    said, text = REFUSED_TEXTS[construct]
    assert said in refusal(text, 1.5)


@pytest.mark.parametrize(
    "text", ["def f(a):\n    return " + "(" * 5000 + "a" + ")" * 5000, "def f(a):\n    return a\0"]
)
def test_texts_that_python_does_not_read(text: str) -> None:
    assert "which is not valid Python" in refusal(text, 1.5)


def test_too_deep_a_nesting_is_refused() -> None:
    assert "f, line 1: got expressions nested too deeply" in refusal(
        "def f(a):\n    return " + "+".join(["a"] * 2000), 1.5
    )


def statements(body: str) -> list[ast.stmt]:
    (found,) = ast.parse(function(body)).body
    assert isinstance(found, ast.FunctionDef)
    return found.body


def changed(text: str, random: Random) -> str:
    """A program with an expression or a statement of those above in place of, or beside, one of its own."""
    tree = ast.parse(text)
    helpers = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    where = random.choice([*helpers, *[helpers[-1]] * len(helpers)])
    new = random.choice(statements(random.choice([body for _, body in REFUSED.values()])))
    if random.random() < 0.4:
        bodies = [getattr(node, "body", None) for node in ast.walk(where)]
        body = random.choice([one for one in bodies if isinstance(one, list)])
        body.insert(random.randrange(len(body) + 1), new)
    else:
        values = [one for one in ast.walk(new) if isinstance(one, ast.expr)]
        old = [one for one in ast.walk(where) if isinstance(one, ast.expr) and is_read(one)]
        value = random.choice(old if random.random() < 0.3 or not values else values)
        _Replaced(random.choice(old), copy.deepcopy(value)).visit(where)
    found = ast.unparse(ast.fix_missing_locations(tree))
    try:
        ast.parse(found)
    except SyntaxError:  # as of a slice that is no index
        return text
    return found


def is_read(node: ast.expr) -> bool:
    return isinstance(getattr(node, "ctx", ast.Load()), ast.Load)


class _Replaced(ast.NodeTransformer):
    def __init__(self, old: ast.expr, new: ast.expr) -> None:
        self.old, self.new = old, new

    def visit(self, node: ast.AST) -> ast.AST:
        return self.new if node is self.old else self.generic_visit(node)


@settings(max_examples=examples(30), phases=WITHOUT_SHRINKING)
@given(text=programs, seed=st.integers(0, 2**32 - 1))
def test_what_is_changed_at_random_compiles_or_is_refused(text: str, seed: int) -> None:
    """No other exception, and no IR that LLVM does not take."""
    random, types = Random(seed), tuple(map(type_of, arguments(seed)))
    for _ in range(3):
        text = changed(text, random)
        built = Program()
        try:
            built.entry(Scope(text_source(text), SIZES).function("main"), types, "entry")
        except SubsetError:
            return
        object_code(built.text)


# C functions, and memory at an address.

Callback = ctypes.CFUNCTYPE(
    None, ctypes.POINTER(ctypes.c_double), ctypes.c_double, ctypes.c_int64, ctypes.c_int32, ctypes.c_int64,
    ctypes.POINTER(ctypes.c_double), ctypes.POINTER(ctypes.c_double), ctypes.c_double,
)  # fmt: skip
Function = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double, ctypes.c_int64, ctypes.POINTER(ctypes.c_double))


def at(callback: Any) -> int:
    return ctypes.cast(callback, ctypes.c_void_p).value or 0


CALLS = """\
from lqrsim.kernels.records import Limits


def f(function, value, x, m, a, i, flag):
    law = Limits(m[1], a + 1)
    call(function, x, a, i, int32(i - 3), flag, law.low, law)
    number = call_for_value(value, a, 7, x)
    return number + call_for_value(value, 0.5, i, m[1]), x[0]
"""


@pytest.mark.parametrize("kind", [int, float])
def test_c_functions_are_called_by_their_address(kind: type[float]) -> None:
    """Arrays as addresses, 32-bit ints, bools as ints, records taken apart; compiled and in plain Python."""
    seen = []

    @Callback
    def function(x: Any, a: float, i: int, small: int, flag: int, low: Any, again: Any, high: float) -> None:
        seen.append((x[0], x[1], a, i, small, flag, low[0], again[1], high))
        x[0] = 11.0

    @Function
    def value(a: float, i: int, x: Any) -> float:
        return 100 * a + 10 * i + x[0]

    for one in (compiled, None):
        x, m = np.array([1.0, 2.0]), np.array([[3.0, 4.0], [5.0, 6.0]])
        given = kind(at(function)), kind(at(value)), x, m, 2.5, -(2**40), True
        call = plain_functions(text_source(CALLS), {}, ["f"])["f"] if one is None else one(CALLS, "f", *given)
        assert call(*given) == (250 + 70 + 11 + 50 - 10 * 2**40 + 5, 11.0)
    # The ints of 32 bits are what is left of one of 64.
    assert seen == [(1.0, 2.0, 2.5, -(2**40), -3, 1, 5.0, 6.0, 3.5)] * 2


def test_memory_at_an_address() -> None:
    text = """\
def f(address, count):
    numbers, rows = at(address), rows_at(address + 16, 3)
    total = 0.0
    for i in range(count):
        total += numbers[i]
    rows[1, 2] = total
    row = rows[0]
    row[0] = -1
    return rows[0, 1], at(address + 8)[0]
"""
    for run_it in (run, lambda text, name, *given: plain_functions(text_source(text), {}, [name])[name](*given)):
        for kind in (int, float):
            numbers = np.arange(8.0)
            assert run_it(text, "f", kind(numbers.ctypes.data), 8) == (3.0, 1.0)
            assert numbers.tolist() == [0, 1, -1, 3, 4, 5, 6, 28]


def test_words_that_threads_share() -> None:
    """What each does by itself, and what is returned; compiled and in plain Python."""
    text = """\
def f(words):
    first, second = claim(words, 0), claim(words, 0)
    before = fetch_add(words, 1, 5)
    after = fetch_add(words, 1, -7)
    store(words, 2, load(words, 1) * 3)
    return first, second, before, after, load(words, 2)
"""
    for run_it in (run, lambda text, name, *given: plain_functions(text_source(text), {}, [name])[name](*given)):
        words = np.array([0, 40, 0], dtype=np.int64)
        assert run_it(text, "f", float(words.ctypes.data)) == (1, 0, 40, 45, 114)
        assert words.tolist() == [1, 38, 114]


def in_threads(*works: Callable[[], Any]) -> list[Any]:
    """What they return, each in a thread of its own, begun at once."""
    begin, found = threading.Barrier(len(works)), [None] * len(works)

    def go(i: int) -> None:
        begin.wait()
        found[i] = works[i]()

    threads = [threading.Thread(target=go, args=(i,)) for i in range(len(works))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def test_several_threads_add_up_and_claim_once() -> None:
    text = """\
def add(words, times):
    for _ in range(times):
        fetch_add(words, 0, 1)

def take(words, count):
    mine = 0
    for i in range(count):
        mine += claim(words, i)
    return mine
"""
    words, flags = np.zeros(1, dtype=np.int64), np.zeros(5000, dtype=np.int64)
    add, take = compiled(text, "add", 1, 1), compiled(text, "take", 1, 1)
    in_threads(*[lambda: add(words.ctypes.data, 20_000)] * 4)
    assert words[0] == 80_000
    claimed = in_threads(*[lambda: take(flags.ctypes.data, len(flags))] * 4)
    assert sum(claimed) == len(flags)
    assert flags.tolist() == [1] * len(flags)


def test_what_was_written_before_a_store_is_there_after_the_load() -> None:
    text = """\
def give(words, numbers, times, count):
    for k in range(times):
        while load(words, 0) != 0:
            wait = 0
        for i in range(count):
            numbers[i] = k + i
        store(words, 0, 1)

def take(words, numbers, times, count):
    wrong = 0
    for k in range(times):
        while load(words, 0) != 1:
            wait = 0
        for i in range(count):
            if numbers[i] != k + i:
                wrong += 1
        store(words, 0, 0)
    return wrong
"""
    words, numbers = np.zeros(1, dtype=np.int64), np.zeros(50)
    given = words.ctypes.data, numbers, 20, len(numbers)
    give, take = compiled(text, "give", *given), compiled(text, "take", *given)
    assert in_threads(lambda: give(*given), lambda: take(*given)) == [None, 0]


# How arguments are laid out.

LAYOUT = """\
from lqrsim.kernels.records import Limits


def f(x, m, pair, law, log, a, i, flag):
    total = 0.0
    for k in range(i):
        total += x[k] + 10 * m[k, 1] + 100 * pair[1][k] + 1000 * law.low[k] + law.high[k] * log[k].gap
        x[k] += 1
    return total * a, i, flag

def count(x, m, n):
    return n + 1

def first(x):
    return x[0]

def nothing():
    return 3

def whole(i):
    return i // 2

def chosen(flag):
    return 1 if flag else 2
"""


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> CompiledModule:
    monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
    return CompiledModule(text_source(LAYOUT), {}, "a test")


def laid_out() -> list[Any]:
    log = np.array([(1.0, 2.0), (3.0, 4.0)], dtype=[("cost", np.float64), ("gap", np.float64)])
    pair = np.array([1.0, 2.0]), np.array([3.0, 4.0])
    law = Limits(np.array([0.5, 0.25]), np.array([2.0, 4.0]))
    return [np.array([1.0, 2.0]), np.array([[1.0, 2.0], [3.0, 4.0]]), pair, law, log, 0.5, 2, True]


TOTAL = 0.5 * (1 + 2 + 10 * (2 + 4) + 100 * (3 + 4) + 1000 * 0.75 + 2 * 2 + 4 * 4)


def test_a_call_sees_other_arguments_and_what_was_written_meanwhile(module: CompiledModule) -> None:
    given = laid_out()
    call = module.lay_out("f", *given)
    assert call() == (TOTAL, 2, True)
    assert given[0].tolist() == [2.0, 3.0]
    assert call() == (TOTAL + 1, 2, True)
    given[2][1][0] += 1
    given[4]["gap"][1] += 1
    assert call() == (TOTAL + 2 + 50 + 2, 2, True)
    # Others: an array, one in a tuple, one in a record, rows and numbers.
    other = [*laid_out()[:5], 1.0, 1, False]
    assert call(*other) == (1 + 20 + 300 + 500 + 4, 1, False)
    other[2] = (other[2][0], np.array([7.0]))
    other[3] = other[3]._replace(low=np.array([1.0]))
    other[4] = other[4][1:].copy()
    assert call(*other) == (2 + 20 + 700 + 1000 + 2 * 4, 1, False)
    assert call(*laid_out()) == (TOTAL, 2, True)


def test_a_call_that_was_refused_leaves_the_arguments_as_they_were(module: CompiledModule) -> None:
    given = laid_out()
    call = module.lay_out("f", *given)
    with pytest.raises(TypeError, match="2 arguments, want 8"):
        call(*given[:2])
    for i, wrong in ((7, 1), (6, 2.5), (1, np.zeros((2, 3))), (3, Limits(np.zeros(2), 1.0))):
        with pytest.raises(TypeError):
            call(np.full(2, 1e6), *[wrong if k == i else laid_out()[k] for k in range(1, 8)])
    assert call() == (TOTAL, 2, True)


WRONG = {
    "a list": (0, [1.0, 2.0], "got list, want an array"),
    "a float": (1, 1.0, "2 indices of a float|want an array"),
    "None": (0, None, "got NoneType, want an array"),
    "ints": (0, np.array([1, 2]), "of int64, want C-ordered float64 blocks"),
    "float32": (0, np.ones(2, dtype=np.float32), "of float32, want C-ordered float64 blocks"),
    "the other byte order": (0, np.ones(2, dtype=">f8"), "of >f8, want C-ordered float64 blocks"),
    "bools": (0, np.array([True, False]), "of bool, want C-ordered float64 blocks"),
    "objects": (0, np.array([None, 1.0]), "of object, want C-ordered float64 blocks"),
    "complex": (0, np.ones(2, dtype=complex), "of complex128, want C-ordered float64 blocks"),
    "no dimension": (0, np.array(1.0), "array \\(\\) of float64"),
    "every other": (0, np.ones(4)[::2], "want C-ordered"),
    "Fortran's order": (1, np.asfortranarray(np.ones((2, 2))), "want C-ordered"),
    "transposed": (1, np.ones((2, 2)).T, "want C-ordered"),
    "a matrix in a tuple": (2, (np.ones(2), np.ones((2, 2))), "blocks \\(\\)"),
    "floats in a tuple": (2, (1.0, 2.0), "got float, want an array"),
    "ints in a tuple": (2, (np.ones(2), np.array([1, 2])), "of int64"),
    "rows of ints": (
        4,
        np.zeros(2, dtype=[("cost", np.int64), ("gap", np.int64)]),
        "want C-ordered \\[\\('cost', '<f8'\\), \\('gap', '<f8'\\)\\] blocks",
    ),
    "rows of float32": (
        4,
        np.zeros(2, dtype=[("cost", np.float32), ("gap", np.float64)]),
        "want C-ordered \\[\\('cost', '<f8'\\)",
    ),
    "every other row": (4, np.zeros(4, dtype=[("cost", np.float64), ("gap", np.float64)])[::2], "want C-ordered"),
    "one row": (
        4,
        np.zeros((), dtype=[("cost", np.float64), ("gap", np.float64)]),
        "want C-ordered \\[\\('cost', '<f8'\\)",
    ),
    "a float for an int": (6, 2.0, "got a float, want an int"),
    "text": (5, "text", "got str, want an array"),
    "a complex number": (5, 1j, "got complex, want an array"),
    "an array of one": (6, np.array([1]), "got an array of 1 dimensions, want an int"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_arguments_of_another_kind_are_refused(module: CompiledModule, wrong: str) -> None:
    """Where a function of such arguments can be compiled, it is, and refuses what it is called with."""
    place, argument, said = WRONG[wrong]
    for after in (False, True):  # at once, or after a good one
        given = laid_out()
        if after:
            assert module.f(*given) == (TOTAL, 2, True)
        given[place] = argument
        with pytest.raises((TypeError, SubsetError), match=said):
            module.f(*given)


def test_numbers_of_other_types_get_functions_of_their_own(module: CompiledModule) -> None:
    for one, wanted in ((7, 3), (np.int32(9), 4), (True, 0), (-7, -4), (7.5, 3.0), (np.float32(9.5), 4.0)):
        found = module.whole(one)
        assert found == wanted
        assert isinstance(found, float) == isinstance(wanted, float)
    for one, wanted in ((True, 1), (False, 2), (np.bool_(True), 1), (2, 1), (0, 2), (np.bool_(False), 2), (4, 1)):
        assert module.chosen(one) == wanted
    assert module.nothing() == 3
    with pytest.raises(SubsetError, match="a float as a condition"):
        module.chosen(1.5)
    with pytest.raises(SubsetError, match="0 arguments, want 1"):
        module.whole()
    with pytest.raises(SubsetError, match="got no function something"):
        module.something()


def test_arrays_that_are_read_only_or_empty(module: CompiledModule) -> None:
    x = np.array([1.5, 2.0])
    x.flags.writeable = False
    assert module.first(x) == 1.5
    assert module.first(np.frombuffer(x.tobytes())) == 1.5
    assert module.count(np.empty(0), np.empty((0, 5)), 2) == 3
    assert module.count(np.empty((0, 3, 2)), np.empty((4, 0)), -1) == 0


def test_one_module_for_several_threads(module: CompiledModule) -> None:
    """Compiled by one of them, called by all; each has memory of its own."""

    def work(shift: float) -> list[float]:
        totals = []
        for k in range(300):
            given = laid_out()
            given[0] += shift + k
            totals.append(module.f(*given)[0])
        return totals

    wanted = [[TOTAL + shift + k for k in range(300)] for shift in (0.0, 1.0, 20.0, 300.0)]
    before = len(compilations)
    assert in_threads(*[partial(work, shift) for shift in (0.0, 1.0, 20.0, 300.0)]) == wanted
    assert len(compilations) == before + 1
