"""Second derivatives of formulas, against differences with many digits, and recurrences."""

import functools
import hashlib
import itertools
import os
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
from altro.airplane import airplane
from compiling import run
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples
from sympy import Abs, Heaviside, Max, Min, Mod, Piecewise, atan2, cos, exp, floor, log, sign, sin, sqrt, tanh

import lqrsim as ls
from lqrsim import rotations
from lqrsim.codegen.edge_pushing import Operations, hessian_of, jacobian_of
from lqrsim.codegen.plain import plain_functions
from lqrsim.codegen.sources import text_source
from lqrsim.codegen.symbolic import without_kinks, write_function
from lqrsim.errors import Array

# Each maps numbers of size 1 to numbers of size 1, so that rounding stays what it is. Some are undefined in a case of
# theirs that does not apply.
NODES: tuple[Callable[[Any, Any, Any], Any], ...] = (
    lambda a, b, c: (a + b - 2 * c) / 3,
    lambda a, b, c: a * b * c / 2 - a / 3,
    lambda a, b, c: a * b / (1 + c**2),
    lambda a, b, c: a**2 / 2 - b**3 / 4,
    lambda a, b, c: (1 + a**2) ** (tanh(b) / 2),
    lambda a, b, c: sqrt(1 + a**2) * sin(b),
    lambda a, b, c: cos(a + 2 * b),
    lambda a, b, c: exp(-(a**2)) * atan2(b, 1 + c**2),
    lambda a, b, c: log(1 + a**2) / sqrt(2 + b**2),
    lambda a, b, c: Abs(a) * b,
    lambda a, b, c: Max(a, b, c) ** 2,
    lambda a, b, c: a * Min(b, 0.3 * c),
    lambda a, b, c: sign(a) * b + Heaviside(b) * c,
    lambda a, b, c: (floor(3 * a) / 3 + Mod(b, 1)) * c / 2,
    lambda a, b, c: Piecewise((a * b, a > c), (sin(b), b < 0.2), (c, True)),
    lambda a, b, c: Piecewise((sqrt(a) * b, a > 0), (a * c, (b > 0) & (c < 0.5)), (0, True)),
    lambda a, b, c: Piecewise((sin(log(a * b)) * c, (a > 0) & (b > 0)), (c**2 / 2, True)),
    lambda a, b, c: sum(rotations.rotate([a, b, c], [c, 1, a])) / 2,
    lambda a, b, c: sum(rotations.vector_rate([a, b / 2, c / 2], [b, 1, a])) / 3,
)


def drawn(choose: Callable[[int], int], symbols: list[Any]) -> list[Any]:
    """Two formulas that share what they are made of."""
    made = [*symbols, sympy.Rational(1, 3)]
    for _ in range(2 + choose(4)):
        made.append(NODES[choose(len(NODES))](*[made[-1 - choose(len(made))] for _ in range(3)]))
    return [sympy.sympify(one) for one in made[-2:]]


def dynamics_of(formulas: list[Any], symbols: list[Any]) -> ls.Dynamics:
    """Their rates are formulas of two states, a control and a parameter."""

    def rates(x: Any, u: Any, p: Any) -> list[Any]:
        values = dict(zip(symbols, [*x, *u, p.number], strict=True))
        return [sympy.sympify(one).subs(values, simultaneous=True) for one in formulas]

    return ls.Dynamics(rates, states={"a": "", "b": ""}, controls={"c": ""}, parameters={"number": 0.7})


def compiled_hessian(dynamics: ls.Dynamics, x: Array, u: Array, weights: Array) -> Array:
    """The Hessian (W, W) of the weighted rates, by compiled code."""
    made = dynamics._trace_curvature()
    support, size = made["support"], len(x) + len(u)
    curve, found = np.zeros((len(support), len(support))), np.zeros((size, size))
    if support:
        run(made["source"], "rate_curvature", x, u, dynamics.data, weights, curve)
    found[np.ix_(support, support)] = np.tril(curve) + np.tril(curve, -1).T
    return found


def exact_hessian(formulas: list[Any], weights: Array, symbols: list[Any], at: Array, size: int) -> Array:
    """By second differences with 60 digits of SymPy's own functions, whose error is some 1e-25."""
    angles = {
        "sine_ratio": lambda r: mpmath.sin(r) / r,
        "cosine_ratio": lambda r: (1 - mpmath.cos(r)) / r**2,
        "cotangent_ratio": lambda r: (1 - r / 2 * mpmath.cot(r / 2)) / r**2,
    }
    known: dict[str, Any] = {name: lambda s, of=of: of(mpmath.sqrt(s)) for name, of in angles.items()}
    known["Heaviside"] = lambda a, half=0.5: (1 + mpmath.sign(a)) / 2
    function = sympy.lambdify(symbols, formulas, modules=[known, "mpmath"], cse=True)
    step = mpmath.mpf(10) ** -15
    with mpmath.workdps(60):
        weighed, point = ([mpmath.mpf(float(one)) for one in numbers] for numbers in (weights, at))

        def value(*moves: tuple[int, int]) -> Any:
            moved = point[:]
            for i, sign in moves:
                moved[i] += sign * step
            return mpmath.fdot(weighed, function(*moved))

        wanted = np.zeros((size, size))
        for i, j in itertools.combinations_with_replacement(range(size), 2):
            ends = [one * other * value((i, one), (j, other)) for one in (1, -1) for other in (1, -1)]
            wanted[i, j] = wanted[j, i] = float(mpmath.fsum(ends) / (4 * step**2))
    return wanted


@settings(max_examples=examples(60))
@given(draw=st.data(), seed=st.integers(0, 2**32 - 1))
def test_of_drawn_formulas(draw: st.DataObject, seed: int) -> None:
    rng = np.random.default_rng(seed)
    symbols = list(sympy.symbols("x0 x1 u0 p0", real=True))
    formulas = drawn(lambda count: draw.draw(st.integers(0, count - 1)), symbols)
    dynamics = dynamics_of(formulas, symbols)
    at, weights = np.append(rng.uniform(-1, 1, 3), 0.7), rng.uniform(-1, 1, 2)
    wanted = exact_hessian(formulas, weights, symbols, at, 3)
    found = compiled_hessian(dynamics, at[:2].copy(), at[2:3].copy(), weights)
    # Some hundred operations on numbers of size 1, whose derivatives grow.
    np.testing.assert_allclose(found, wanted, atol=1e-11 * max(1.0, np.abs(wanted).max()))


def swept_jacobian(formulas: list[Any], symbols: list[Any], at: Array) -> Array:
    """The first derivatives of formulas of x, u and p, by a sweep forward."""
    operations, found = Operations(), np.zeros((len(formulas), len(symbols) - 1))
    names = operations.of([without_kinks(one) for one in formulas])
    slopes = jacobian_of(operations, names, symbols[:-1])
    values = {f"out[{i}, {j}]": slope for (i, j), slope in slopes.items()}
    if not values:
        return found
    text = write_function("slopes", "x, u, p, out", "p", values, of="f", steps=operations.steps)
    slopes_at = plain_functions(text_source(text), {}, ["slopes"])["slopes"]
    with np.errstate(all="ignore"):
        slopes_at(at[:2], at[2:3], at[3:], found)
    return found


@settings(max_examples=examples(30))
@given(draw=st.data(), seed=st.integers(0, 2**32 - 1))
def test_slopes_of_drawn_formulas(draw: st.DataObject, seed: int) -> None:
    """Against SymPy's derivatives of the whole formulas, which need no product of a case that does not apply."""
    symbols = list(sympy.symbols("x0 x1 u0 p0", real=True))
    formulas = drawn(lambda count: draw.draw(st.integers(0, count - 1)), symbols)
    at = np.append(np.random.default_rng(seed).uniform(-1, 1, 3), 0.7)
    with np.errstate(all="ignore"):
        wanted = np.hstack(dynamics_of(formulas, symbols).rate_jacobian(at[:2], at[2:3]))
    found = swept_jacobian(formulas, symbols, at)
    np.testing.assert_allclose(found, wanted, atol=1e-12 * max(1.0, np.abs(wanted).max()))


@pytest.mark.parametrize("of", NODES[14:17])
@pytest.mark.parametrize("a", [-0.5, 0.0, 0.5])
@pytest.mark.parametrize("b", [-0.3, 0.0, 0.7])
def test_slopes_of_a_case_that_does_not_apply_may_be_undefined(of: Callable[..., Any], a: float, b: float) -> None:
    """Also of a root at the end of where it is defined, which something larger hides."""
    symbols, at = list(sympy.symbols("x0 x1 u0 p0", real=True)), np.array([a, b, 0.2, 0.7])
    formulas = [of(*symbols[:3]) ** 2, Max(sqrt(Max(symbols[0], 0)), 0.9) + Min(log(1 + symbols[1] ** 2), symbols[2])]
    with np.errstate(all="ignore"):
        wanted = np.hstack(dynamics_of(formulas, symbols).rate_jacobian(at[:2], at[2:3]))
    np.testing.assert_allclose(swept_jacobian(formulas, symbols, at), wanted, atol=1e-14)


@pytest.mark.parametrize(
    ("formulas", "support"),
    [
        (lambda a, b, c, p: [a + p * b, 0], []),
        (lambda a, b, c, p: [p, 3], []),
        (lambda a, b, c, p: [a, sin(b) * p], [1]),
        (lambda a, b, c, p: [c**2, a - c], [2]),
        (lambda a, b, c, p: [a, -b * c], [1, 2]),
        (lambda a, b, c, p: [floor(a) + sign(b), Abs(c)], []),
    ],
    ids=["linear", "constant", "a state", "a control", "a product", "kinks"],
)
def test_support(formulas: Callable[..., list[Any]], support: list[int]) -> None:
    """What the rates are not curved in has no entries."""
    symbols = list(sympy.symbols("x0 x1 u0 p0", real=True))
    assert dynamics_of(formulas(*symbols), symbols)._trace_curvature()["support"] == support


def test_a_case_that_does_not_apply_may_be_undefined() -> None:
    """Its derivatives are infinite or NaN, also those of what only such cases use."""

    def rates(x: Any, u: Any, p: Any) -> list[Any]:
        inner = sqrt(x[0])
        first = Piecewise((inner * x[1] + exp(inner), x[0] > 0), (x[1] ** 2, True))
        return [first, Piecewise((inner**3 * u[0], x[0] > 0), (u[0] ** 2, True))]

    dynamics = ls.Dynamics(rates, states={"a": "", "b": ""}, controls={"c": ""})
    for a in (-0.5, 0.0):
        found = compiled_hessian(dynamics, np.array([a, 0.3]), np.array([0.2]), np.array([1.0, 3.0]))
        np.testing.assert_array_equal(found, np.diag([0.0, 2.0, 6.0]))
    found = compiled_hessian(dynamics, np.array([4.0, 0.3]), np.array([0.2]), np.array([1.0, 3.0]))
    # d2/da2 of 0.3 a^0.5 + exp(a^0.5) + 0.6 a^1.5 at 4.
    second = -0.25 * 0.3 / 8 + np.exp(2) * (1 / 16 - 1 / 32) + 0.45 / 2
    np.testing.assert_allclose(found, [[second, 0.25, 9.0], [0.25, 0, 0], [9.0, 0, 0]], rtol=1e-13)


def test_extremes_of_dozens() -> None:
    """SymPy compares all pairs of arguments, for hours with these. At a kink a slope is that of one side."""
    rng = np.random.default_rng(3)
    sides, levels = rng.normal(size=(40, 2)), rng.uniform(0.1, 1, 40)

    def rates(x: Any, u: Any, p: Any) -> list[Any]:
        planes = [a * x.a + b * x.b - c for (a, b), c in zip(sides.tolist(), levels.tolist(), strict=True)]
        return [Max(*planes), functools.reduce(Min, planes) + Max(u.c, -sympy.oo), Abs(x.a) * x.b - Max(x.a, 2 * x.a)]

    dynamics = ls.Dynamics(rates, states={"a": "", "b": "", "d": ""}, controls={"c": ""})
    for x in [*rng.normal(size=(5, 3)), np.array([0.0, 0.7, 0.0])]:
        planes, (a, b, _) = sides @ x[:2] - levels, x
        # Numbers of formulas are written with 15 digits.
        np.testing.assert_allclose(
            dynamics.rate(x, [0.3]), [planes.max(), planes.min() + 0.3, abs(a) * b - max(a, 2 * a)], rtol=1e-13
        )
        fx, fu = dynamics.rate_jacobian(x, [0.3])
        np.testing.assert_allclose(fx[:2, :2], sides[[planes.argmax(), planes.argmin()]], rtol=1e-14)
        np.testing.assert_array_equal(fu, [[0], [1], [0]])
        if a:
            np.testing.assert_allclose(fx[2], [np.sign(a) * b - (2 if a > 0 else 1), abs(a), 0], atol=1e-15)
        else:  # between -b - 1 and b - 2, of which Abs has the mean and Max one
            assert fx[2, 0] in (-1, -2)


def test_the_effort_grows_with_the_number_of_operations() -> None:
    """Each turn of a map uses the last value twice: written out, ten turns are thousands of operations."""
    x, weight = sympy.symbols("x0 w0", real=True)
    formula, counts = x, []
    value, first, second = 0.4, 1.0, 0.0
    for _ in range(10):
        formula = sin(formula) * (2 + formula)
        s, c = np.sin(value), np.cos(value)
        slope = c * (2 + value) + s
        second = (2 * c - s * (2 + value)) * first**2 + slope * second
        value, first = s * (2 + value), slope * first
        operations = Operations()
        found = hessian_of(operations, operations.of([formula]), [weight], [x], most=1000)
        assert found is not None
        counts.append(len(found[0]))
    assert sympy.count_ops(formula) > 3000
    assert len(set(np.diff(counts)[1:])) == 1
    operations = Operations()
    assert hessian_of(operations, operations.of([formula]), [weight], [x], most=counts[-1] // 2) is None
    dynamics = ls.Dynamics(lambda x, u, p: [formula], states={"a": ""}, controls={"b": ""})
    hessian = compiled_hessian(dynamics, np.array([0.4]), np.zeros(1), np.ones(1))
    # Ten turns of a map that stretches by up to 2 round by some 1e-13.
    np.testing.assert_allclose(hessian, [[second, 0], [0, 0]], rtol=1e-11)


@pytest.mark.long
def test_of_an_aeroplane() -> None:
    """The largest formula of the experiments."""
    dynamics = airplane()
    symbols = sympy.symbols("x:17", real=True)
    rates = dynamics.f(symbols[:13], symbols[13:], SimpleNamespace(**dynamics.parameters))
    rng = np.random.default_rng(0)
    attitude, speed = rng.normal(size=4), np.array([6.0, 0.5, -0.4])
    at = np.concatenate([rng.normal(size=3), attitude, speed, rng.normal(size=3), [90.0, 100.0, 110.0, 95.0]])
    weights = rng.normal(size=13)
    wanted = exact_hessian(rates, weights, list(symbols), at, 17)
    found = compiled_hessian(dynamics, at[:13].copy(), at[13:].copy(), weights)
    np.testing.assert_allclose(found, wanted, atol=1e-12 * np.abs(wanted).max())


SCRIPT = """
import hashlib
import lqrsim as ls
from sympy import Max, Piecewise, sqrt

def rates(x, u, p):
    far = sqrt(x[0] ** 2 + x[1] ** 2)
    return [Piecewise((far * u[0], far > p.size), (Max(far, x[1], u[0]) ** 2, x[1] < 0), (x[0] * u[0], True)), far ** 3]

own = ls.Dynamics(rates, states={"a": "", "b": ""}, controls={"c": ""}, parameters={"size": 1.0})
for dynamics in (own, ls.Quadrotor().dynamics):
    print(dynamics._trace_curvature()["source"])
"""


def test_each_process_writes_the_same() -> None:
    """Compiled code is found again by its source."""

    def digest(seed: str) -> str:
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, check=True)
        assert done.stdout
        return hashlib.sha256(done.stdout).hexdigest()

    assert len({digest(seed) for seed in ("0", "1", "2")}) == 1
