"""Checks of the values and derivatives of a user's functions: before the first iteration, and when in doubt."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from lqrsim.annotations import Bounds, Line, NonNegative, Positive, Seed, checked
from lqrsim.codegen.user_functions import Term, UserFunction, first_numbers
from lqrsim.errors import Array, InputError
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.parts import CostTerm, terms_of
from lqrsim.problem.problem import FixedState, PlainTerm, Problem

STEP = 6e-6  # step of difference quotients, relative to numbers above 1
_Points = Sequence[tuple[Array, Array]]  # states (n,) and controls (m,)


def functions_of(problem: Problem) -> list[UserFunction]:
    """The functions of a problem that are no formulas."""
    return [function for part in _parts(problem) for function in part.functions]


def check_functions(problem: Problem, u: Array) -> None:
    """Call each function that is no formula once at the start, which raises InputError for an unsuitable result."""
    x = problem._start_or_zero
    for part in _parts(problem):
        for function in part.functions:
            parameters = dict(zip(function.parameters, part.data.tolist(), strict=False))
            values = function.call(x[: function.states], u, parameters)
            for i, name in function.unused:
                z = np.concatenate([x, u])
                z[i] += 1e-2 * max(1.0, abs(z[i]))
                if not np.array_equal(function.call(z[: len(x)], z[len(x) :], parameters), values, equal_nan=True):
                    raise InputError(f"{function.name}: got a value that depends on {name}, want it in depends_on")


def _parts(problem: Problem) -> list[Dynamics | Term]:
    """The dynamics, and all terms that are bound to them."""
    terms = [term for name in ("initial", "stage_cost", "final_cost") for term in problem.terms(name)]
    noise = () if problem.noise_term is None else (problem.noise_term,)
    return [problem.dynamics.calling, *terms, *problem.constraint_terms, *noise]


def check_start(problem: Problem, x: Array, u: Array) -> None:
    """Raises InputError if the dynamics or a cost is not finite at a state (n,) and control (m,)."""
    where = f"at the start, x = {first_numbers(x)}, u = {first_numbers(u)}"
    dynamics, names = problem.dynamics, problem.dynamics.state_coordinates.names
    called = dynamics.name if dynamics.discrete else f"{dynamics.name}(x, u, p)"
    with np.errstate(all="ignore"):
        for i, moved in enumerate(dynamics.step(x, u, problem.dt) if dynamics.discrete else dynamics.rate(x, u)):
            if not np.isfinite(moved):
                if cause := dynamics._cause_of_failure(x):
                    raise InputError(f"{called}: no finite state follows the start: {cause}")
                raise InputError(f"{called}: got {moved:g} as entry {i} ({names[i]}) {where}, want a finite number")
        columns = names, dynamics.control_coordinates.names
        slopes_of = dynamics.linearize(x, u, problem.dt)[:2] if dynamics.discrete else dynamics.rate_jacobian(x, u)
        for label, slopes, column in zip(("df/dx", "df/du"), slopes_of, columns, strict=True):
            for i, j in np.argwhere(~np.isfinite(slopes)):
                got = f"{slopes[i, j]:g} in {label}, row {names[i]}, column {column[j]}"
                raise InputError(f"{called}: got {got}, {where}, want finite derivatives")
        for cost, term in _terms(problem):
            value, gradient, hessian = evaluate(term, x, u)
            for label, array in (("value", np.array(value)), ("gradient", gradient), ("Hessian", hessian)):
                for entry in np.argwhere(~np.isfinite(array)).tolist():
                    got = f"{array[tuple(entry)]:g} as its {label}{f' at {entry}' if entry else ''}"
                    raise InputError(f"{cost}: got {got} {where}, want finite numbers")


def _terms(problem: Problem) -> Iterator[tuple[str, CostTerm]]:
    """The cost terms, with their names in messages."""
    for part in ("initial", "stage_cost", "final_cost"):
        if not isinstance(cost := getattr(problem, part), FixedState):
            for cost_term, term in zip(terms_of(cost), problem.terms(part), strict=True):
                yield f"{part}: {cost_term.name}", term


def evaluate(term: CostTerm, x: Array, u: Array) -> tuple[float, Array, Array]:
    """A cost term at a state (n,) and control (m,) in plain Python; see `PlainTerm.cost`."""
    return PlainTerm(term, len(x), len(u)).cost(np.concatenate([x, u]))


@checked
@dataclass(frozen=True, eq=False)
class DerivativeCheck:
    """The largest deviation of derivatives from central differences.

    Attributes:
      what: name of the derivative, such as `df/dx of ...`.
      error: largest difference over entries and samples, relative to the entry and the differences' own rounding.
      row, column: names of the output and the input at that entry.
      stated: the derivative there. difference: its difference quotient. state, control: the sample.
      tolerance: the largest acceptable error.
    """

    what: Line
    error: float
    row: Line
    column: Line
    stated: float
    difference: float
    state: Annotated[Array, "n"]
    control: Annotated[Array, "m"]
    tolerance: float

    @property
    def good(self) -> bool:
        """Whether the error is within the tolerance; a NaN is not."""
        return self.error <= self.tolerance

    def __str__(self) -> str:
        verdict = "agrees" if self.good else "DISAGREES"
        return (
            f"{self.what}: {verdict}; worst at row {self.row}, column {self.column}: {self.stated:.8g} stated,"
            f" {self.difference:.8g} by central differences (error {self.error:.1e}, tolerance {self.tolerance:.0e};"
            f" x = {first_numbers(self.state)}, u = {first_numbers(self.control)})"
        )


@checked
def check_derivatives(
    subject: Problem | Dynamics,
    *,
    samples: Annotated[int, Bounds(at_least=1, at_most=10_000)] = 20,
    spread: NonNegative = 0.3,
    tolerance: Positive = 1e-5,
    seed: Seed = 0,
) -> list[DerivativeCheck]:
    """Compare derivatives with central differences: of dynamics, or of a problem's dynamics, costs and constraints.

    Derivatives of symbolic functions are exact, but a formula can still be singular where the robot goes. Costs without
    derivatives are left out, because central differences are used for them anyway.

    Args:
      subject: dynamics, checked around zero, or a problem, checked around its start and nominal control.
      spread: standard deviation of the samples, in the units of states and controls.
      tolerance: tolerance of the error, relative to each entry.

    Returns:
      One check per matrix of derivatives, with its worst entry; print it.
    """
    dynamics = subject.dynamics if isinstance(subject, Problem) else subject
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    x0, u0 = np.zeros(n), np.zeros(m)
    if isinstance(subject, Problem):
        x0, u0 = x0 if subject.start is None else subject.start, subject.nominal_control
    rng = np.random.default_rng(seed)
    points = [(x0 + spread * rng.normal(size=n), u0 + spread * rng.normal(size=m)) for _ in range(samples)]
    worst_by_name: dict[str, DerivativeCheck] = {}
    checks = [_of_dynamics(dynamics, points, tolerance)]
    if isinstance(subject, Problem):
        names = *dynamics.state_coordinates.names, *dynamics.control_coordinates.names
        checks += [_of_costs(subject, names, points, tolerance), _of_constraints(subject, names, points, tolerance)]
    with np.errstate(all="ignore"):
        for check in itertools.chain(*checks):
            worst = worst_by_name.setdefault(check.what, check)
            if not np.isnan(worst.error) and not check.error <= worst.error:  # a NaN is the worst
                worst_by_name[check.what] = check
    return [*worst_by_name.values()]


def _of_dynamics(dynamics: Dynamics, points: _Points, tolerance: float) -> Iterator[DerivativeCheck]:
    states, controls = dynamics.state_coordinates.names, dynamics.control_coordinates.names
    n = len(states)
    if dynamics.by_mujoco:
        return  # its derivatives are central differences already
    for x, u in points:
        fx, fu = dynamics.rate_jacobian(x, u)
        joint, noise = _differences(lambda z: dynamics.rate(z[:n], z[n:]), np.concatenate([x, u]))
        parts = (("df/dx", states, fx, np.s_[:n]), ("df/du", controls, fu, np.s_[n:]))
        for derivative, names, slopes, columns in parts:
            what, differences = f"{derivative} of {dynamics.name}", (joint[:, columns], noise[:, columns])
            yield _worst_entry(what, states, names, slopes, differences, (x, u), tolerance)


def _of_costs(problem: Problem, names: Sequence[str], points: _Points, tolerance: float) -> Iterator[DerivativeCheck]:
    for cost, term in _terms(problem):
        if len(term.functions) == 1 and term.exact_hessian:
            continue  # a function without derivatives uses central differences already
        plain = PlainTerm(term, *map(len, points[0]))
        for x, u in points:
            z = np.concatenate([x, u])
            _, gradient, hessian = plain.cost(z)
            slope = _differences(lambda z, plain=plain: np.array([plain.cost(z)[0]]), z)
            yield _worst_entry(f"gradient of {cost}", ("cost",), names, gradient[None], slope, (x, u), tolerance)
            if term.exact_hessian:
                curvature = _differences(lambda z, plain=plain: plain.cost(z)[1], z)
                yield _worst_entry(f"Hessian of {cost}", names, names, hessian, curvature, (x, u), tolerance)


def _of_constraints(
    problem: Problem, names: Sequence[str], points: _Points, tolerance: float
) -> Iterator[DerivativeCheck]:
    for term in problem.constraint_terms:
        plain = PlainTerm(term, *map(len, points[0]))
        for row, (x, u) in itertools.product(range(term.rows), points):
            z = np.concatenate([x, u])
            differences = _differences(lambda z, of=plain, row=row: np.array([of.value(z, row)]), z)
            label, slope = f"slope of {term.describe(row)}", plain.slope(z, row)[None]
            yield _worst_entry(label, ("value",), names, slope, differences, (x, u), tolerance)


def _worst_entry(
    what: str, rows: Sequence[str], columns: Sequence[str], stated: Array, differences: tuple[Array, Array],
    point: tuple[Array, Array], tolerance: float,
) -> DerivativeCheck:  # fmt: skip
    """The entry of a matrix at a point that is furthest from its difference, relative to the larger of the two."""
    difference, noise = differences
    size = np.maximum(np.abs(stated), np.abs(difference)) + noise / tolerance
    error = np.abs(stated - difference) / np.maximum(size, np.finfo(float).tiny)
    worst = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
    i, j = (int(k) for k in np.unravel_index(worst, error.shape))
    return DerivativeCheck(
        what=what, error=float(error[i, j]), row=rows[i], column=columns[j], stated=float(stated[i, j]),
        difference=float(difference[i, j]), state=point[0], control=point[1], tolerance=tolerance,
    )  # fmt: skip


def _differences(function: Any, z: Array) -> tuple[Array, Array]:
    """The Jacobian of a function by central differences, and a bound on the rounding error of each entry."""
    columns, noise = [], []
    for i in range(len(z)):
        h = STEP * max(1.0, abs(z[i]))
        ahead, behind = z.copy(), z.copy()
        ahead[i] += h
        behind[i] -= h
        above, below = function(ahead), function(behind)
        columns.append((above - below) / (2 * h))
        # A thousand rounding errors of a number of that size, or of 1.
        noise.append(1e3 * np.finfo(float).eps * np.maximum(np.maximum(np.abs(above), np.abs(below)), 1.0) / h)
    return np.stack(columns, axis=1), np.stack(noise, axis=1)
