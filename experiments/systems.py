"""Small systems that benchmarks and tests share: one formula each, with all else as numbers.

What has the same text, and the same kinds of cost terms in the same order, is compiled once and kept for all processes.
A problem that is made of `linear` and `stage_cost`, or of `scalar` and `scalar_cost`, therefore compiles nothing where
another one of as many states and controls has been solved.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

import lqrsim as ls
from lqrsim.errors import Array


def linear_rate(x: Any, u: Any, p: Any) -> list[Any]:
    """`A x + B u + c`; p has the entries row by row, as `linear` names them."""
    entries = list(p.__dict__.values())
    n, z = len(x), [*x, *u, 1]
    return [sum(entries[i * len(z) + j] * z[j] for j in range(len(z))) for i in range(n)]


def cross_cost(x: Any, u: Any, p: Any) -> Any:
    """`1/2 z'K z` with z = (x, u); p has the entries of K on and above the diagonal, row by row."""
    entries, z, k = list(p.__dict__.values()), [*x, *u], 0
    total = 0
    for i in range(len(z)):
        for j in range(i, len(z)):
            total += entries[k] * z[i] * z[j] / (2 if i == j else 1)
            k += 1
    return total


def _named(letter: str, values: Sequence[float] | Array) -> Mapping[str, float]:
    return {f"{letter}{i}": float(value) for i, value in enumerate(values)}


def linear(a: npt.ArrayLike, b: npt.ArrayLike, c: npt.ArrayLike | None = None) -> ls.Dynamics:
    """`x' = a x + b u + c` with a (n, n), b (n, m) and c (n,), by default none."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    n, m = b.shape
    constant = np.zeros(n) if c is None else np.asarray(c, dtype=float)
    return ls.Dynamics(
        linear_rate,
        states={f"x{i}": "" for i in range(n)},
        controls={f"u{i}": "" for i in range(m)},
        parameters=_named("a", np.hstack([a, b, constant[:, None]]).ravel()),
    )


DOUBLE_INTEGRATOR = linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])


def stage_cost(control: ls.ControlCost, state: ls.QuadraticCost, cross: Array | None = None) -> ls.Cost:
    """A cost of the control and one of the state, and `1/2 z'K z` with z = (x, u) and K (n+m, n+m), by default 0."""
    size = len(state.about) + len(control.about)
    weights = (np.zeros((size, size)) if cross is None else cross)[np.triu_indices(size)]
    return control + state + ls.SymbolicCost(cross_cost, parameters=_named("k", weights), convex=True)


def scalar_rate(x: Any, u: Any, p: Any) -> list[Any]:
    """Unstable, or escaping to infinity in finite time, or with a pole, as its parameters say."""
    return [u[0] + p.linear * x[0] + p.cubic * x[0] ** 3 + p.pole / (x[0] - p.at)]


def bonus(x: Any, u: Any, p: Any) -> Any:
    """A constant, and effort that is paid for."""
    return p.constant - p.bonus * u[0] ** 2


def scalar(*, linear: float = 0.0, cubic: float = 0.0, pole: float = 0.0, at: float = 1e300) -> ls.Dynamics:
    """`x' = linear x + cubic x^3 + pole / (x - at) + u`, of one state and one control."""
    parameters = {"linear": linear, "cubic": cubic, "pole": pole, "at": at}
    return ls.Dynamics(scalar_rate, states={"x": ""}, controls={"u": ""}, parameters=parameters)


def scalar_cost(effort: float = 1.0, *, weight: float = 0.0, constant: float = 0.0, paid: float = 0.0) -> ls.Cost:
    """`effort u^2 / 2 + weight x^2 / 2 + constant - paid u^2`."""
    return (
        ls.ControlCost([effort], about=[0.0])
        + ls.QuadraticCost([weight], about=[0.0])
        + ls.SymbolicCost(bonus, parameters={"constant": constant, "bonus": paid}, convex=True)
    )
