"""LQR smoothing and its iteration in continuous time, as in Secs. IV and V of the paper; SciPy integrates.

In the coordinates (x, 1) the three equations for S, **s** and s become one equation. With

    V = [S s; s' 2s]   F = [A c; 0 0]   G = [B; 0]   H = [Q q; q' 2q]   P = [P r]

Eqs. (9)-(11) and (13) are

    -dV/dt = H + F'V + VF - (P + G'V)' R^-1 (P + G'V)     pi(x, t) = -R^-1 (P + G'V) (x, 1)

and with the signs of F and G turned, as the paper notes, they are Eqs. (15)-(17) and (19), forward in time.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.interpolate import PPoly
from scipy.linalg.lapack import dposv  # pyright: ignore[reportAttributeAccessIssue]

from lqrsim.annotations import Bounds, Positive, checked
from lqrsim.codegen.user_functions import UserFunction, interrupt_of, raised_by
from lqrsim.errors import Array, InputError, check_array, check_function, excerpt, real
from lqrsim.problem.derivative_check import check_functions, check_start, functions_of
from lqrsim.problem.parts import terms_of
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution_parts import Iteration, Quadratic, Status, joined
from lqrsim.solvers import compiled
from lqrsim.solvers.budget import Callback
from lqrsim.solvers.linear_quadratic import WEIGH_MORE, Stage, check_end, definite
from lqrsim.solvers.settings import InitialPrior

NO_MINIMUM, FLAT = "S + Sbar is not positive definite", "R is not positive definite"
# Largest number of evaluations of one right-hand side, a few seconds. A trajectory that needs more diverges or is far
# too stiff.
_EVALUATIONS = 100_000
# The dense output of DOP853 is a polynomial of degree 7 per step, which eight points determine.
_NODES = 0.5 * (1.0 - np.cos(np.pi * np.arange(8) / 7))
_FIT = np.linalg.inv(np.vander(_NODES))
Tolerances = dict[str, float]  # rtol and atol, those of `solve_ivp`
RelativeTolerance = Annotated[float, Bounds(at_least=1e-13)]  # SciPy replaces a smaller tolerance, with a warning


class IntegrationFailure(Exception):
    """A failed integration, a lost state, or a model without a minimum, which becomes the status of the solve."""

    def __init__(self, status: Status, why: str, t: float) -> None:
        super().__init__(why)
        self.status, self.time = status, t


class Model(NamedTuple):
    """Linear dynamics and a quadratic cost at one time, in the letters of the module's docstring."""

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
    """A value function and its policy, for n states and m controls, as functions of time, in pieces between `times`."""

    def __init__(self, pieces: PPoly, n: int, m: int) -> None:
        self.times, self.states, self.controls, self._pieces = pieces.x, n, m, pieces

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
        rtol, atol = tolerances["rtol"], tolerances["atol"]
        solution = solve_ivp(guarded, span, start, method="DOP853", dense_output=True, rtol=rtol, atol=atol)
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


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class ContinuousSolution:
    """A policy and the value functions as functions of the time t, in seconds from 0 to the horizon.

    t may be an array of times, whose axes then come first in the result.

    Attributes:
      status: how the solve ended; only CONVERGED is success.
      detail: the pass, the time and the reason if the solve failed.
      remedy: what to try then.
      horizon: the paper's l, in seconds.
      iterations: the log of the iterations; empty for a linear-quadratic problem, which needs none.
    """

    status: Status
    detail: str
    remedy: str
    horizon: Positive
    iterations: tuple[Iteration, ...] = ()
    _backward: Pass | None = field(repr=False, compare=False)
    _forward: Pass | None = field(repr=False, compare=False)

    @property
    def success(self) -> bool:
        """True for CONVERGED."""
        return self.status is Status.CONVERGED

    @property
    def cost(self) -> float:
        """True cost of the rollout from x_hat(0), or the least cost of a linear-quadratic problem; NaN if not found."""
        if self.iterations or not self.success:
            return self.iterations[-1].cost if self.iterations else float("nan")
        return float(self.total_cost(0.0).minimum())

    def policy(self, x: npt.ArrayLike, t: npt.ArrayLike) -> Array:
        """The control (..., m) to apply in the states x (..., n) at time t, without saturation. Paper: Eq. (13)."""
        return self._law("policy", self._backward, x, t)

    def inverse_policy(self, x: npt.ArrayLike, t: npt.ArrayLike) -> Array:
        """The control (..., m) that led to the states x (..., n) at time t at least cost. Paper: Eq. (19)."""
        return self._law("inverse_policy", self._forward, x, t)

    def cost_to_go(self, t: npt.ArrayLike) -> Quadratic:
        """v: the least cost from time t on, as a function of the state at t. Paper: Eqs. (8)-(11)."""
        return self._value("cost_to_go", self._backward, t)

    def cost_to_come(self, t: npt.ArrayLike) -> Quadratic:
        """vbar: the least cost up to time t, as a function of the state at t. Paper: Eqs. (14)-(17)."""
        return self._value("cost_to_come", self._forward, t)

    def total_cost(self, t: npt.ArrayLike) -> Quadratic:
        """vhat: the least cost of visiting a state at time t. Paper: Eq. (20)."""
        return self.cost_to_go(t) + self.cost_to_come(t)

    def x_hat(self, t: npt.ArrayLike) -> Array:
        """The state (..., n) of least total cost at time t. Paper: Eq. (21)."""
        return self.total_cost(t).minimizer()

    def u_hat(self, t: npt.ArrayLike) -> Array:
        """The policy's control (..., m) there; at convergence also the inverse policy's. Paper: Eq. (22)."""
        return self.policy(self.x_hat(t), t)

    def summary(self) -> str:
        """The status with its remedy, and the results, in a few lines."""
        lines = [f"{self.status.name} after {len(self.iterations)} iterations: {self.status.meaning}"]
        if not self.iterations and self.success:
            lines = [f"{self.status.name}: a linear-quadratic problem is solved by one pass each way"]
        if self.detail:
            lines.append(f"  detail:    {self.detail}")
        if self.remedy:
            lines.append(f"  remedy:    {self.remedy}")
        line = f"  cost:      {self.cost:.9g}"
        if self.iterations:
            line += f"   gap: {self.iterations[-1].gap:.1e}   optimality: {self.iterations[-1].optimality:.1e}"
        return "\n".join([*lines, line])

    def __str__(self) -> str:
        rows = [iteration.row(number) for number, iteration in enumerate(self.iterations, start=1)]
        return "\n".join([*([Iteration.HEADER, *rows] if rows else []), self.summary()])

    def _at(self, what: str, backward: Pass | None, t: npt.ArrayLike) -> tuple[Pass, Array]:
        if backward is None:
            raise InputError(f"{what}: got a solution that is {self.status.value} before a pass ended, want a success")
        times, slack = real("t", t), 1e-9 * self.horizon  # rounding may put a time slightly outside
        outside = ~((times >= -slack) & (times <= self.horizon + slack))
        if outside.any():
            raise InputError(f"t: got {times[outside].flat[0]:g}, want seconds from 0 to {self.horizon:g}")
        return backward, np.clip(times, 0.0, self.horizon)

    def _value(self, what: str, backward: Pass | None, t: npt.ArrayLike) -> Quadratic:
        backward, times = self._at(what, backward, t)
        value, _ = backward.at(times)
        return Quadratic(value[..., :-1, :-1], value[..., :-1, -1], 0.5 * value[..., -1, -1])

    def _law(self, what: str, backward: Pass | None, x: npt.ArrayLike, t: npt.ArrayLike) -> Array:
        backward, times = self._at(what, backward, t)
        states, want = real("x", x), f"(..., {backward.states}), one state or one for each of the times"
        if states.shape[-1:] != (backward.states,) or (times.ndim and states.shape[:-1] not in ((), times.shape)):
            raise InputError(f"x: got shape {states.shape}, want {want}")
        if not np.isfinite(states).all():
            raise InputError(f"x: got {excerpt(states)}, want finite numbers")
        _, law = backward.at(times)
        return np.einsum("...ij,...j->...i", law[..., :-1], states) + law[..., -1]


@checked
def smooth_lq_continuous(
    stage: Stage | Callable[[float], Stage],
    *,
    horizon: Positive,
    initial: Quadratic,
    final: Quadratic,
    rtol: RelativeTolerance = 1e-9,
    atol: Positive = 1e-9,
) -> ContinuousSolution:
    """Solve a linear-quadratic problem in continuous time by LQR smoothing. Paper: Sec. IV, Eqs. (4)-(22).

    Args:
      stage: the dynamics and the cost per second, without a leading axis; or a function t [s] -> Stage if they change
        with time. At jumps, the integrator takes many short steps.
      horizon: l, in seconds.
      initial: c_0: hessian (n, n), gradient (n,), constant. Together, stage, initial and final must give every state a
        total cost with one minimum.
      final: c_l, in the same form.
      rtol: relative tolerance of the integration of the Riccati equations.
      atol: absolute tolerance of the integration.

    Returns:
      A ContinuousSolution. A problem without a minimum raises no exception; the status says where this was noticed.
    """
    tolerances = Tolerances(rtol=rtol, atol=atol)

    def at(t: float) -> Stage:
        value = stage(t) if callable(stage) else stage
        if not isinstance(value, Stage) or np.ndim(value.B) != 2:
            got = f"a Stage with {np.ndim(value.B)} dimensions in B" if isinstance(value, Stage) else excerpt(value)
            raise InputError(
                f"stage: got {got}, want a Stage without a leading axis, or a function of t that gives one"
            )
        return value

    if callable(stage):
        check_function("stage", stage, "a Stage, or a function of t that gives one", arguments=1)
    first = at(0.0)
    n, m = first.states, first.controls

    constant_model = _model(first, n, m)

    def model(t: float, _: Array) -> Model:
        return _model(at(t), n, m) if callable(stage) else constant_model

    c_0, c_l = (bordered(*check_end(name, cost, n)) for name, cost in (("initial", initial), ("final", final)))
    backward, forward, status, detail = None, None, Status.CONVERGED, ""
    where = "backward pass"
    try:
        backward = riccati_pass(model, c_l, horizon, backward=True, tolerances=tolerances)
        where = "forward pass"
        forward = riccati_pass(model, c_0, horizon, backward=False, tolerances=tolerances)
        where = "total cost"
        _check_minimum(backward, forward)
    except IntegrationFailure as failure:
        status, detail = failure.status, _at(where, failure)
    return ContinuousSolution(
        status=status, detail=detail, remedy="" if status.success else WEIGH_MORE, horizon=horizon,
        _backward=backward, _forward=forward,
    )  # fmt: skip


def _model(stage: Stage, n: int, m: int) -> Model:
    A, B, c, Q, P, R, q, r = (np.asarray(getattr(stage, name)) for name in "ABcQPRqr")
    if B.shape != (n, m):
        raise InputError(f"stage: got B of shape {B.shape}, want ({n}, {m}) at all times")
    hessian, gradient = np.block([[Q, P.T], [P, R]]), np.concatenate([q, r])
    return homogeneous(A, B, c, hessian, gradient, float(np.asarray(stage.constant)), np.zeros(n), np.zeros(m))


def _check_minimum(backward: Pass, forward: Pass) -> None:
    """Check that the total cost has one minimum at every step of the passes. Raises IntegrationFailure."""
    times = np.union1d(backward.times, forward.times)
    total = backward.at(times)[0] + forward.at(times)[0]
    flat = ~definite(total[:, :-1, :-1], (total.shape[1] - 1) * np.finfo(float).eps)
    if flat.any():
        raise IntegrationFailure(Status.NOT_POSITIVE_DEFINITE, NO_MINIMUM, float(times[flat][0]))


@checked
def smooth_continuous(
    problem: Problem,
    *,
    tolerance: Positive = 1e-4,
    gap_tolerance: Positive = 1e-3,
    max_iterations: Annotated[int, Bounds(at_least=1, at_most=1_000_000)] = 50,
    start: npt.ArrayLike | InitialPrior | None = None,
    rtol: RelativeTolerance = 1e-8,
    atol: Positive = 1e-8,
    callback: Callback | None = None,
) -> ContinuousSolution:
    """Compute a locally optimal feedback policy by iterated LQR smoothing in continuous time. Paper: Sec. V.

    The horizon is `steps * dt`, the cost per second is `stage_cost / dt`, and the control is not held over a step. As
    dt and the weights shrink, `smooth` approaches this solution at first order. A stage cost that depends on the step
    gets the step that contains the time, but at least 1, because some costs do not act at step 0. Controls have no
    limits here.

    Args:
      problem: a problem with an initial cost, the paper's soft start.
      tolerance: tolerance of the relative change of cost, and of the optimality (see `Iteration`). A cost below `atol`
        counts as `atol`.
      gap_tolerance: tolerance of the gap (see `Iteration`), checked every dt. The dynamics residual is not evaluated.
      max_iterations: number of iterations after which to give up.
      start: (m,), the control that the first pass applies; the problem's nominal control by default. Or an
        InitialPrior, which is added to the cost at first. The start influences which local optimum is found.
      rtol: relative tolerance of all integrations.
      atol: absolute tolerance of all integrations.
      callback: called with each `Iteration` as it ends.

    Returns:
      A ContinuousSolution, from the last completed iteration. A hard problem raises no exception: the status says how
      the solve ended, and the detail where.

    Raises:
      InputError: the dynamics or a cost is not finite at the start; or the problem has a fixed start, a free duration,
        constraints, rates, noise, `accuracy=`, a cost with rows for knots, or dynamics that are a map.
    """
    if isinstance(problem.initial, FixedState):
        raise InputError(
            "initial: got a FixedState, want an initial cost such as QuadraticCost(weight, about=x_start);"
            " the primal form has no other start"
        )
    if problem.duration is not None:
        raise InputError("duration: got a free duration, want None in continuous time; use `smooth`")
    if problem.accuracy is not None:
        raise InputError("accuracy: got that of steps, want None and rtol=, which is that of all integrations here")
    if problem.constraints:
        raise InputError("constraints: got a problem with constraints, want none in continuous time; use `smooth`")
    if problem.control_rate is not None:
        raise InputError("control_rate: got rates, which are per control period, want none; use `smooth`")
    if problem.noise is not None:
        raise InputError("noise: got a problem with noise, which is per control period, want none; use `smooth`")
    for cost in terms_of(problem.stage_cost):
        if cost.by_knot:
            raise InputError(f"stage_cost: got a {cost.name} with a row for each knot, want one; or use `smooth`")
    if problem.dynamics.discrete:
        raise InputError(
            f"dynamics: got {problem.dynamics.name}, which has no rate, want dynamics with one; or use `smooth`"
        )
    tolerances = Tolerances(rtol=rtol, atol=atol)
    prior = start.fitting(problem) if isinstance(start, InitialPrior) else None
    if prior is not None and prior.obstacles:
        raise InputError(f"start: got a prior with obstacles={prior.obstacles}, want one without in continuous time")
    wanted, state = start.controls if isinstance(start, InitialPrior) else start, problem._start_or_zero
    control = problem.nominal_control
    if wanted is not None:
        control = check_array("start", wanted, (len(problem.dynamics.control_coordinates),))
    check_functions(problem, control)
    check_start(problem, state, control)

    functions = functions_of(problem)
    for function in functions:
        function.forget()
    solver = _Smoother(problem, state, control, prior, tolerances)
    iterations, status, detail = solver.iterate(tolerance, gap_tolerance, max_iterations, functions, callback)
    if (error := interrupt_of(functions)) is not None:
        raise error
    raised = raised_by(functions)
    remedy = status.remedy
    if status not in (Status.CONVERGED, Status.MAX_ITERATIONS):
        remedy = "raise the control weight" if FLAT in detail else "solve with smooth, whose steps only lower the cost"
    return ContinuousSolution(
        status=status, detail=joined(detail, raised if detail else ""), remedy=remedy,
        horizon=solver.horizon, iterations=tuple(iterations),
        _backward=solver.backward, _forward=solver.forward,
    )  # fmt: skip


class _Smoother:
    """Runs the iterations for a problem in continuous time, whose stage cost is per second, and keeps their state.

    Attributes:
      forward, backward: the passes of the last iteration that completed both passes; None before.
      horizon: the paper's l, in seconds.
    """

    def __init__(
        self, problem: Problem, state: Array, control: Array, prior: InitialPrior | None, tolerances: Tolerances
    ) -> None:
        costs, data, dynamics = compiled.costs_module(problem), compiled.compile_problem(problem), problem.dynamics
        n, m, dt, steps = len(state), len(control), problem.dt, problem.steps
        self._n, self._dt, self._steps, self.horizon = n, dt, steps, steps * dt
        self._tolerances, self._data, self._none = tolerances, data, np.zeros(m)
        # Buffers into which compiled code writes.
        self._f, self._fx, self._fu = np.zeros(n), np.zeros((n, n)), np.zeros((n, m))
        self._hessian, self._gradient = np.zeros((n + m, n + m)), np.zeros(n + m)
        self._parameters = data.dynamics.parameters
        self._linearize = dynamics.compiled.lay_out(
            "rate_jacobian", self._f, self._none, self._parameters, self._f, self._fx, self._fu
        )
        self._quadratize = costs.lay_out(
            "cost_quadratic", self._f, self._none, 1, data.stage, self._hessian, self._gradient
        )
        self._prior, self._prior_left = prior, prior.iterations if prior is not None else 0
        self._x_hat = state  # at 0
        # Before the first pass there is no cost-to-go, and the policy applies the initial control.
        law = np.hstack([np.zeros((m, n)), control[:, None]])
        self._to_go = Pass.constant(np.zeros((n + 1, n + 1)), law, self.horizon)
        self.forward: Pass | None = None
        self.backward: Pass | None = None
        self._where, self._cost, self._gap = "", math.nan, math.nan  # the pass that is under way; of the last rollout
        self._states: PPoly | None = None

    def iterate(
        self, tolerance: float, gap_tolerance: float, most: int, functions: list[UserFunction],
        callback: Callable[[Iteration], object] | None,
    ) -> tuple[list[Iteration], Status, str]:  # fmt: skip
        """Iterate until convergence, `most` times at most; return the log, the status, and where it failed."""
        iterations: list[Iteration] = []
        for number in range(1, most + 1):
            clock, last = time.perf_counter(), number == most
            try:
                self._do_passes()
            except IntegrationFailure as failure:
                return iterations, failure.status, _at(f"{self._where} of iteration {number}", failure)
            escape = self._roll_out()
            before = iterations[-1].cost if iterations else math.inf
            # A cost below the tolerance is noise of the integrator.
            improvement = (before - self._cost) / max(abs(self._cost), self._tolerances["atol"])
            settled = abs(improvement) < tolerance and self._gap < gap_tolerance
            row = Iteration(
                cost=self._cost, improvement=improvement, gap=self._gap,
                optimality=self._optimality() if settled or last else math.nan, dynamics_residual=math.nan,
                violation=0.0, seconds=time.perf_counter() - clock, method="smooth",
            )  # fmt: skip
            iterations.append(row)
            if callback is not None:
                callback(row)
            if (error := interrupt_of(functions)) is not None:
                raise error
            if settled and row.optimality < tolerance:
                return iterations, Status.CONVERGED, ""
            if last and escape is not None:
                return iterations, Status.DIVERGED, _at(f"rollout of iteration {number}", escape)
        return iterations, Status.MAX_ITERATIONS, ""

    def _do_passes(self) -> None:
        """One pass forward and one backward. Paper: Secs. V-A and V-B. Raises IntegrationFailure."""
        horizon = self.horizon
        prior, self._prior_left = self._prior if self._prior_left > 0 else None, self._prior_left - 1
        self._where = "forward pass"
        come = self._pass(self._model(self._to_go, prior), self._end_model("initial", self._x_hat), backward=False)
        # Eq. (33). With c_l quadratised there, the next pass again begins at the minimiser, by Eq. (28) at l.
        x_end = minimizer(self._to_go.at(horizon)[0] + come.at(horizon)[0], horizon)
        self._where = "backward pass"
        go = self._pass(self._model(come, prior), self._end_model("final", x_end), backward=True)
        first = go.at(0.0)[0]
        x_hat = minimizer(first + come.at(0.0)[0], 0.0)  # Eq. (30)
        self._x_hat = minimizer(first + self._end_model("initial", x_hat), 0.0)
        self._to_go, self.forward, self.backward = go, come, go

    def _pass(self, model: Callable[[float, Array], Model], end: Array, *, backward: bool) -> Pass:
        return riccati_pass(model, end, self.horizon, backward=backward, tolerances=self._tolerances)

    def _expand(self, t: float, x: Array, u: Array) -> float:
        """Expand dynamics and stage cost about (x, u), in place; returns the cost. All are per second."""
        self._linearize(x, u, self._parameters, self._f, self._fx, self._fu)
        step = min(max(int(t / self._dt), 1), max(self._steps - 1, 1))
        value = self._quadratize(x, u, step, self._data.stage, self._hessian, self._gradient)
        self._hessian /= self._dt
        self._gradient /= self._dt
        return value / self._dt

    def _end_value(self, which: str, x: Array) -> float:
        """The `initial` or `final` cost; its derivatives are left in the buffers."""
        return self._quadratize(x, self._none, 0, getattr(self._data, which), self._hessian, self._gradient)

    def _end_model(self, which: str, x: Array) -> Array:
        """The `initial` or `final` cost, quadratised at x, as V. Paper: Eqs. (23), (31)."""
        value = self._end_value(which, x)
        hessian, gradient = self._hessian[: self._n, : self._n], self._gradient[: self._n]
        slope = gradient - hessian @ x
        return bordered(hessian, slope, value - 0.5 * float(x @ (gradient + slope)))

    def _model(self, other: Pass, prior: InitialPrior | None) -> Callable[[float, Array], Model]:
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
                weight, error = prior.weight / self._dt, x - prior.at(min(t / self._dt, self._steps))
                self._hessian[range(self._n), range(self._n)] += weight
                self._gradient[: self._n] += weight * error
                value += 0.5 * float(error @ (weight * error))
            return homogeneous(self._fx, self._fu, self._f, self._hessian, self._gradient, value, x, u)

        return about

    def _roll_out(self) -> IntegrationFailure | None:
        """Run the new policy under the true dynamics, and set cost, gap and states, the first two infinite if it fails.

        Returns the failure, if any.
        """
        assert self.forward is not None
        times, policy = np.linspace(0.0, self.horizon, self._steps + 1), self._to_go

        def rate(t: float, y: Array) -> Array:
            x = y[: self._n]
            law = policy.at(t)[1]
            cost = self._expand(t, x, law[:, :-1] @ x + law[:, -1])
            return np.append(self._f, cost)

        try:
            start = np.append(self._x_hat, self._end_value("initial", self._x_hat))
            solution = integrate(rate, start, (0.0, self.horizon), self._tolerances)
            end = self._end_value("final", np.ascontiguousarray(solution.y[:-1, -1]))
            self._cost, self._states = float(solution.y[-1, -1] + end), _pieces(solution, lambda t, y: y[: self._n])
            total = self.forward.at(times)[0] + policy.at(times)[0]
            x_hats = np.array([minimizer(V, t) for V, t in zip(total, times.tolist(), strict=True)])
        except IntegrationFailure as failure:
            self._cost, self._gap, self._states = math.inf, math.inf, None
            return failure
        states = self._states(times)
        self._gap = float((np.abs(x_hats - states).max(axis=0) / np.maximum(np.ptp(states, axis=0), 1.0)).max())
        return None

    def _optimality(self) -> float:
        """The decrease of cost that a linear-quadratic model about the rollout predicts; see `Iteration.optimality`.

        Infinite if that has no minimum.
        """
        states, policy, still = self._states, self._to_go, np.zeros(self._n)
        if states is None:
            return math.inf

        def deviation(t: float, _: Array) -> Model:
            """The model in deviations from the rollout, so that no constants cancel."""
            x, law = states(t), policy.at(t)[1]
            self._expand(t, x, law[:, :-1] @ x + law[:, -1])
            return homogeneous(self._fx, self._fu, still, self._hessian, self._gradient, 0.0, still, self._none)

        def end(which: str, t: float) -> Array:
            self._end_value(which, states(t))
            return bordered(self._hessian[: self._n, : self._n], self._gradient[: self._n], 0.0)

        try:
            backward = self._pass(deviation, end("final", self.horizon), backward=True)
            total = backward.at(0.0)[0] + end("initial", 0.0)
            decrease = float(-0.5 * total[-1, -1] - 0.5 * total[-1, :-1] @ minimizer(total, 0.0))
        except IntegrationFailure:
            return math.inf
        return decrease / max(abs(self._cost), self._tolerances["atol"])


def _at(where: str, failure: IntegrationFailure) -> str:
    return f"{where}, at {failure.time:.4g} s: {failure}"
