"""The differential equations of `continuous.py`, integrated by SciPy: Riccati equations, dynamics and cost.

In the coordinates (x, 1) the three equations for S, **s** and s become one equation. With

    V = [S s; s' 2s]   F = [A c; 0 0]   G = [B; 0]   H = [Q q; q' 2q]   P = [P r]

Eqs. (9)-(11) and (13) are

    -dV/dt = H + F'V + VF - (P + G'V)' R^-1 (P + G'V)     pi(x, t) = -R^-1 (P + G'V) (x, 1)

and with the signs of F and G turned, as the paper notes, they are Eqs. (15)-(17) and (19), forward in time.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.interpolate import PPoly
from scipy.linalg.lapack import dposv  # pyright: ignore[reportAttributeAccessIssue]

from lqrsim.errors import Array, check_number
from lqrsim.problem.problem import Problem
from lqrsim.results.solution_parts import Status
from lqrsim.solvers import compiled
from lqrsim.solvers.initial_guess import InitialPrior

NO_MINIMUM, FLAT = "S + Sbar is not positive definite", "R is not positive definite"

# Largest number of evaluations of one right-hand side, a few seconds. A trajectory that needs more diverges or is far
# too stiff.
_EVALUATIONS = 100_000

# The dense output of DOP853 is a polynomial of degree 7 per step, which eight points determine.
_NODES = 0.5 * (1.0 - np.cos(np.pi * np.arange(8) / 7))
_FIT = np.linalg.inv(np.vander(_NODES))


class Tolerances(NamedTuple):
    """Relative and absolute tolerance of the integration."""

    rtol: float
    atol: float


def tolerances_of(rtol: float, atol: float) -> Tolerances:
    """Check the tolerances."""
    # SciPy replaces a smaller tolerance, with a warning.
    return Tolerances(check_number("rtol", rtol, at_least=1e-13), check_number("atol", atol, above=0.0))


class IntegrationFailure(Exception):
    """The exception of all functions here for a failed integration, a lost state, or a model without a minimum.

    It becomes the status of the solve, and never reaches the caller.
    """

    def __init__(self, status: Status, why: str, t: float) -> None:
        super().__init__(why)
        self.status, self.time = status, t


class Model(NamedTuple):
    """Linear dynamics and a quadratic cost at one time. The letters are explained in the module's docstring."""

    F: Array
    G: Array
    H: Array
    P: Array
    R: Array


def homogeneous(
    fx: Array, fu: Array, f: Array, hessian: Array, gradient: Array, value: float, x: Array, u: Array
) -> Model:
    """The model about the origin of dynamics and cost with these derivatives at (x, u). Paper: Eqs. (24)-(27)."""
    n, m = fu.shape
    z = np.concatenate([x, u])
    slope = gradient - hessian @ z
    F, G, H, P = np.zeros((n + 1, n + 1)), np.zeros((n + 1, m)), np.empty((n + 1, n + 1)), np.empty((m, n + 1))
    F[:n, :n], F[:n, n], G[:n] = fx, f - fx @ x - fu @ u, fu
    H[:n, :n], H[:n, n], H[n, :n], H[n, n] = hessian[:n, :n], slope[:n], slope[:n], 2 * value - z @ (gradient + slope)
    P[:, :n], P[:, n] = hessian[n:, :n], slope[n:]
    return Model(F, G, H, P, hessian[n:, n:])


def bordered(hessian: Array, gradient: Array, constant: float) -> Array:
    """A quadratic `1/2 x'Hx + x'g + k` as V, (n+1, n+1)."""
    return np.block([[hessian, gradient[:, None]], [gradient, 2 * constant]])


def minimizer(V: Array, t: float) -> Array:
    """The state (n,) of least value at time t. Paper: Eqs. (21), (28). Raises IntegrationFailure if none exists."""
    _, x, info = dposv(V[:-1, :-1], V[:-1, -1])
    if info != 0:
        raise IntegrationFailure(
            Status.NOT_POSITIVE_DEFINITE if np.isfinite(V).all() else Status.NOT_FINITE, NO_MINIMUM, t
        )
    return -x


class Pass:
    """A value function and its policy as functions of time.

    Attributes:
      times: (any,) the times between the pieces of the polynomials: the integrator's steps.
      states, controls: n and m.
    """

    def __init__(self, pieces: PPoly, n: int, m: int) -> None:
        self.times, self.states, self.controls = pieces.x, n, m
        self._pieces = pieces

    @classmethod
    def constant(cls, V: Array, law: Array, horizon: float) -> "Pass":
        """A constant value function and law."""
        m, n = law.shape[0], law.shape[1] - 1
        return cls(PPoly(np.concatenate([V.ravel(), law.ravel()])[None, None], [0.0, horizon]), n, m)

    def at(self, t: npt.ArrayLike) -> tuple[Array, Array]:
        """V (..., n+1, n+1) and the law (..., m, n+1): u = law (x, 1)."""
        flat, size = self._pieces(t), (self.states + 1) ** 2
        V = flat[..., :size].reshape(*flat.shape[:-1], self.states + 1, self.states + 1)
        return V, flat[..., size:].reshape(*flat.shape[:-1], self.controls, self.states + 1)


def riccati_pass(
    model: Callable[[float, Array], Model], end: Array, horizon: float, *, backward: bool, tolerances: Tolerances
) -> Pass:
    """Integrate the Riccati equation of `model(t, V)` from V = `end`: back from the horizon, or forward from 0."""
    n = len(end) - 1
    sign = 1.0 if backward else -1.0
    rows, columns = np.triu_indices(n + 1)  # only the upper triangle is integrated, so V stays symmetric
    spread = np.zeros((n + 1, n + 1), dtype=np.intp)
    spread[rows, columns] = spread[columns, rows] = np.arange(len(rows))
    corner = rows * (n + 1) + columns

    def slope(t: float, packed: Array) -> tuple[Array, Array, Array]:
        """V, its rate in the direction of the pass, and the law."""
        V = packed[spread]
        F, G, H, P, R = model(t, V)
        push = P + sign * (G.T @ V)
        _, law, info = dposv(R, push)
        if info != 0:
            good = np.isfinite(R).all() and np.isfinite(push).all()
            raise IntegrationFailure(Status.NOT_POSITIVE_DEFINITE if good else Status.NOT_FINITE, FLAT, t)
        drift = sign * (F.T @ V)
        return V, H + drift + drift.T - push.T @ law, -law

    def rate(t: float, packed: Array) -> Array:
        return -sign * slope(t, packed)[1].ravel()[corner]

    span = (horizon, 0.0) if backward else (0.0, horizon)
    solution = integrate(rate, end[rows, columns], span, tolerances)

    def sample(t: float, packed: Array) -> Array:
        V, _, law = slope(t, packed)
        return np.concatenate([V.ravel(), law.ravel()])

    return Pass(_pieces(solution, sample), n, model(span[0], end).G.shape[1])


def integrate(
    rate: Callable[[float, Array], Array], start: Array, span: tuple[float, float], tolerances: Tolerances
) -> Any:
    """Run `solve_ivp` with dense output for `rate(t, y)` from y = `start` over `span`.

    If the rate cannot be evaluated, a shorter step is tried. Raises IntegrationFailure if that fails, too.
    """
    last: list[IntegrationFailure] = []
    count = 0

    def guarded(t: float, y: Array) -> Array:
        nonlocal count
        count += 1
        if count > _EVALUATIONS:
            why = f"the integration is not done after {_EVALUATIONS} evaluations"
            raise IntegrationFailure(Status.MAX_ITERATIONS, why, t)
        try:
            out = rate(t, y)
            if not math.isfinite(out.sum()):
                raise IntegrationFailure(Status.NOT_FINITE, "a rate is not finite", t)
            return out
        except IntegrationFailure as failure:
            last[:] = [failure]
            return np.full_like(y, math.nan)  # SciPy treats this as too large an error

    with np.errstate(all="ignore"):
        guarded(span[0], start)
        if last:
            raise last[0]
        solution = solve_ivp(guarded, span, start, method="DOP853", dense_output=True, **tolerances._asdict())
    if not solution.success:
        t = float(solution.t[-1])
        if last and abs(last[0].time - t) < 1e-6 * abs(span[1] - span[0]):
            raise last[0]
        raise IntegrationFailure(Status.NOT_FINITE, "the solution grows beyond what steps of any length can follow", t)
    return solution


def _pieces(solution: Any, sample: Callable[[float, Array], Array]) -> PPoly:
    """`sample(t, y)` along a solution of `integrate`, as polynomials of degree 7 between its steps."""
    knots = solution.t if solution.t[-1] > solution.t[0] else solution.t[::-1]
    lengths = np.diff(knots)
    times = (knots[:-1, None] + lengths[:, None] * _NODES).ravel()
    with np.errstate(all="ignore"):
        points = np.array([sample(t, y) for t, y in zip(times.tolist(), solution.sol(times).T, strict=True)])
    points = points.reshape(len(lengths), 8, -1)
    scale = lengths[:, None] ** np.arange(7, -1, -1)
    return PPoly(np.einsum("kj,ijs->kis", _FIT, points) / scale.T[:, :, None], knots)


class System:
    """A problem in continuous time: its compiled functions, with the stage cost per second."""

    def __init__(self, problem: Problem) -> None:
        costs, data, dynamics = compiled.costs_module(problem), compiled.arguments(problem), problem.dynamics
        n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
        self.n, self.m, self.dt, self.horizon = n, m, problem.dt, problem.steps * problem.dt
        self.knots = np.linspace(0.0, self.horizon, problem.steps + 1)
        self._steps, self._last, self._data = problem.steps, max(problem.steps - 1, 1), data
        self._none = np.zeros(m)
        # Buffers into which compiled code writes.
        self._f, self._fx, self._fu = np.zeros(n), np.zeros((n, n)), np.zeros((n, m))
        self._hessian, self._gradient = np.zeros((n + m, n + m)), np.zeros(n + m)
        joint = self._hessian, self._gradient
        self._parameters = data.dynamics.parameters
        self._linearize = dynamics.compiled.lay_out(
            "rate_jacobian", self._f, self._none, self._parameters, self._f, self._fx, self._fu
        )
        self._quadratize = costs.lay_out("cost_quadratic", self._f, self._none, 1, data.stage, *joint)

    def _expand(self, t: float, x: Array, u: Array) -> float:
        """Expand dynamics and stage cost about (x, u), in place; returns the cost. All are per second."""
        self._linearize(x, u, self._parameters, self._f, self._fx, self._fu)
        step = min(max(int(t / self.dt), 1), self._last)
        value = self._quadratize(x, u, step, self._data.stage, self._hessian, self._gradient)
        self._hessian /= self.dt
        self._gradient /= self.dt
        return value / self.dt

    def end_value(self, which: str, x: Array) -> float:
        """The `initial` or `final` cost; its derivatives are left in the buffers."""
        return self._quadratize(x, self._none, 0, getattr(self._data, which), self._hessian, self._gradient)

    def end_model(self, which: str, x: Array) -> Array:
        """The `initial` or `final` cost, quadratised at x, as V. Paper: Eqs. (23), (31)."""
        value = self.end_value(which, x)
        hessian, gradient = self._hessian[: self.n, : self.n], self._gradient[: self.n]
        slope = gradient - hessian @ x
        return bordered(hessian, slope, value - 0.5 * float(x @ (gradient + slope)))

    def model(self, other: Pass, prior: InitialPrior | None) -> Callable[[float, Array], Model]:
        """The model of a pass, about the states of least total cost and the policy of the `other` pass.

        Paper: Eqs. (24)-(29), (32).
        """

        def about(t: float, V: Array) -> Model:
            theirs, law = other.at(t)
            x = minimizer(V + theirs, t)
            u = law[:, :-1] @ x + law[:, -1]
            value = self._expand(t, x, u)
            if prior is not None:
                # Rounding may put the horizon a little after the last step.
                weight, error = prior.weight / self.dt, x - prior.at(min(t / self.dt, self._steps))
                self._hessian[range(self.n), range(self.n)] += weight
                self._gradient[: self.n] += weight * error
                value += 0.5 * float(error @ (weight * error))
            return homogeneous(self._fx, self._fu, self._f, self._hessian, self._gradient, value, x, u)

        return about

    def rollout(self, start: Array, policy: Pass, tolerances: Tolerances) -> tuple[float, PPoly]:
        """Run a policy under the true dynamics; return its cost, and its states (n,) as a function of time."""

        def rate(t: float, y: Array) -> Array:
            x = y[: self.n]
            law = policy.at(t)[1]
            cost = self._expand(t, x, law[:, :-1] @ x + law[:, -1])
            return np.append(self._f, cost)

        solution = integrate(rate, np.append(start, self.end_value("initial", start)), (0.0, self.horizon), tolerances)
        cost = solution.y[-1, -1] + self.end_value("final", np.ascontiguousarray(solution.y[:-1, -1]))
        return float(cost), _pieces(solution, lambda t, y: y[: self.n])

    def decrease(self, states: PPoly, policy: Pass, tolerances: Tolerances) -> float:
        """The decrease of cost that a linear-quadratic model about a rollout predicts."""
        still, no_control = np.zeros(self.n), np.zeros(self.m)

        def deviation(t: float, _: Array) -> Model:
            """The model in deviations from the rollout, so that no constants cancel."""
            x, law = states(t), policy.at(t)[1]
            self._expand(t, x, law[:, :-1] @ x + law[:, -1])
            return homogeneous(self._fx, self._fu, still, self._hessian, self._gradient, 0.0, still, no_control)

        def end(which: str, x: Array) -> Array:
            self.end_value(which, x)
            return bordered(self._hessian[: self.n, : self.n], self._gradient[: self.n], 0.0)

        last, first = states(self.horizon), states(0.0)
        backward = riccati_pass(deviation, end("final", last), self.horizon, backward=True, tolerances=tolerances)
        total = backward.at(0.0)[0] + end("initial", first)
        return float(-0.5 * total[-1, -1] - 0.5 * total[-1, :-1] @ minimizer(total, 0.0))
