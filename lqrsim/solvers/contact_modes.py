"""Plans at the edges of contact modes: a descent within a mode, and conditions for optimality of such a plan.

A control period of an MJCF is smooth only while the same contacts and limits act; see `scenes/contacts.py`. A
descent ends at a *switch*, next to a jump or at a kink: a contact that is just not reached, or just lets go. The
gradient is not zero there, and steps along it cross the switch. Here a switch is an inequality, like a limit of a
control:

- The model of the cost is that of iLQR, in the offsets of the policy with its gains held, and derivatives are those of
  the plan's own mode. The step minimises it with all switches on their sides, linearised: a quadratic program.
- A second step includes curvature. MuJoCo has no second derivatives. Secants replace them: the changes of a period's
  Jacobian between the last plans, times the multipliers. The better of both steps counts.
- A step that crosses a switch after all, because it is curved, is pushed back to its own side.
- Where no such step lowers the cost, each switch that the plan is pressed against is crossed on its own. If the cost is
  lower there, the descent goes on from there.

The plan is optimal if neither is possible; `optimality_in_mode` and `surroundings` measure both again.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg

from lqrsim.errors import Array
from lqrsim.kernels.records import Motion
from lqrsim.problem.mjcf_dynamics import MjcfDynamics
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution_parts import ContactCertificate, Quadratic, Status
from lqrsim.scenes.contacts import ContactModes, Period, Switches
from lqrsim.scenes.mjcf_holding import least_distance
from lqrsim.solvers import compiled
from lqrsim.solvers.budget import Budget, Laps
from lqrsim.solvers.certify import certified, faults
from lqrsim.solvers.engine import RunResult, SolveRun

MARGIN = 1e-9  # m, rad or m/s^2, distance that a plan keeps from a switch
ENOUGH = 0.1  # fraction of the predicted decrease that a step must achieve
PUSHES = 10  # times that a step is pushed back to its side
HALVINGS = 8  # number of halvings of a step before the damping grows
FLAT = 0.05  # least curvature of the second step, relative to that of the first
SHORT, SKEW = 1e-6, 1e-6  # least change of a point, and least cosine of it with its correction, that count
DAMPING, MOST = 1e-3, 1e6  # weight of the model's own curvature if steps fail: the first and the largest
ROUNDS = 50  # largest number of rounds in which switches are added to a quadratic program
SMALL = 1e-3  # change of a control in neighbouring plans, as a fraction of its range
SAMPLES, RAY = 50, 8  # number of sampled neighbouring plans; number of doublings of a ray across a switch


class CostedPlan(NamedTuple):
    """A plan and its cost: states (T+1, n) and controls (T, m)."""

    states: Array
    controls: Array
    cost: float


class ModeModel:
    """The cost and the switches about a plan in the offsets d (T m,) of its policy.

    Attributes:
      gain: (T, m, n). hessian, gradient: of the cost, (T m, T m) and (T m,). slopes, values: of K switches, (K, T m)
        and (K,). sides: +1 or -1. first: (T+1,) index of each period's first switch. known: whether the slopes are
        known. responses: (T m, T m) responses of the controls. low, high: (T, m) distances of the controls from their
        limits. periods: the linearised periods.
      points: (T, n+m) states and controls where they begin. motions: (T, n+m, T m) how these respond.
    """

    def __init__(self, problem: Problem, modes: ContactModes, plan: CostedPlan) -> None:
        self.check_time, self._problem, self._plan = modes.check_time, problem, plan
        states, controls, steps = plan.states, plan.controls, problem.steps
        n, m, size = states.shape[1], controls.shape[1], problem.steps * controls.shape[1]
        self.periods = [linearized(problem, modes, x, u) for x, u in zip(states[:-1], controls, strict=True)]
        self.points, self.motions = np.hstack([states[:-1], controls]), np.empty((steps, n + m, size))
        data, quadratic = compiled.compile_problem(problem), partial(compiled.quadratic_at, problem)
        self.stages = [quadratic(data.stage, states[t], controls[t], t)[1:] for t in range(steps)]
        _, slope, curve = quadratic(data.final, states[steps], np.zeros(m), steps)
        self.last = slope[:n], curve[:n, :n]
        space = problem.control_coordinates
        self.low, self.high = (np.broadcast_to(limit, controls.shape) - controls for limit in (space.low, space.high))
        self.gain = self._gains()
        self.hessian, self.gradient, reached = np.zeros((size, size)), np.zeros(size), np.zeros((n, size))
        slopes = []
        for t, (period, (gradient, hessian)) in enumerate(zip(self.periods, self.stages, strict=True)):
            both = self.motions[t]
            both[:n], both[n:] = reached, self.gain[t] @ reached
            both[n:, t * m : (t + 1) * m] += np.eye(m)
            self.hessian += both.T @ hessian @ both
            self.gradient += both.T @ gradient
            slopes.append(period.slopes @ both)
            reached = period.jacobian @ both
        self.hessian += reached.T @ self.last[1] @ reached
        self.hessian = 0.5 * (self.hessian + self.hessian.T)
        self.gradient += reached.T @ self.last[0]
        self.slopes, self.responses = np.vstack(slopes), self.motions[:, n:].reshape(size, size)
        self.values = np.concatenate([period.switches.values for period in self.periods])
        self.sides = np.where(self.values < 0, -1.0, 1.0)
        self.first = np.cumsum([0, *(len(period.switches.names) for period in self.periods)])
        self.known: npt.NDArray[np.bool_] = np.asarray(np.isfinite(self.slopes).all(axis=1))

    def _gains(self) -> Array:
        """Gains (T, m, n) of iLQR; zero for controls at their limits."""
        n, ahead = len(self.last[0]), self.last[1]
        gains = np.zeros((*self.low.shape, n))
        for t in reversed(range(len(self.periods))):
            jacobian = self.periods[t].jacobian
            hessian = self.stages[t][1] + jacobian.T @ ahead @ jacobian
            free = np.flatnonzero((self.low[t] < 0) & (self.high[t] > 0))
            if len(free):
                gains[t, free] = -np.linalg.solve(hessian[np.ix_(n + free, n + free)], hessian[n + free, :n])
            closed = np.vstack([np.eye(n), gains[t]])
            ahead = closed.T @ hessian @ closed
            ahead = 0.5 * (ahead + ahead.T)
        return gains

    def changed(self, change: Array) -> CostedPlan:
        """The plan after a change (T m,) of the offsets of its policy."""
        controls = self._plan.controls + change.reshape(self._plan.controls.shape)
        return rolled_out(self._problem, self._plan.states, controls, self.gain)

    def beyond(self, which: int) -> CostedPlan | None:
        """The cheapest plan across a switch, on a ray that crosses it by the least change; None without such a ray.

        The ray begins where a control has changed by half of SMALL, and doubles that RAY times.
        """
        toward = scipy.linalg.solve(self.hessian, self.slopes[which], assume_a="pos")
        reach = np.minimum(self.high - self.low, 1e3).ravel()
        depth = SMALL * float(self.slopes[which] @ toward) / max(float(np.abs(toward / reach).max()), 1e-300)
        steps = [minimize(self, self.hessian, across=which, depth=part * depth) for part in (0.5, 1.0)]
        near, far = (None if step is None else step.change for step in steps)
        if near is None or far is None:
            return None
        changes = (near + (2.0**doubled - 1) * (far - near) for doubled in range(RAY + 1))
        return min(map(self.changed, changes), key=lambda one: one.cost)


class ModeStep(NamedTuple):
    """A minimiser of the model, (T m,), and the decrease that it predicts.

    Also the multipliers of the switches, (K,), and of the control limits, (T, m), negative for upper limits.
    """

    change: Array
    decrease: float
    multipliers: Array
    limits: Array


def minimize(model: ModeModel, curvature: Array, *, across: int | None = None, depth: float = 0.0) -> ModeStep | None:
    """Minimise `gradient d + 1/2 d curvature d` with all switches and limits on their sides; None if that fails.

    If a switch `across` must be crossed by `depth` instead, the change is as small as possible.
    """
    model.check_time()
    try:
        factor = scipy.linalg.cholesky(curvature, lower=True)
    except np.linalg.LinAlgError:
        return None
    size = len(model.gradient)
    sides = np.where(np.arange(len(model.values)) == across, -1.0, 1.0) * model.sides
    room = model.sides * model.values - MARGIN
    bounds = np.where(room > 0, -room, 0.0)
    if across is not None:
        bounds[across] = abs(model.values[across]) + MARGIN + depth
    rows = np.vstack([sides[:, None] * model.slopes, model.responses, -model.responses])
    bounds = np.concatenate([bounds, model.low.ravel(), -model.high.ravel()])
    bounds[len(model.values) :] = np.minimum(bounds[len(model.values) :], 0.0)
    which = np.flatnonzero(np.concatenate([model.known, np.ones(2 * size, bool)]) & np.isfinite(bounds))
    rows = scipy.linalg.solve_triangular(factor, rows[which].T, lower=True).T
    lengths = np.linalg.norm(rows, axis=1)
    felt = lengths > 1e-12 * max(lengths.max(initial=0.0), 1e-300)
    rows, which, lengths = rows[felt] / lengths[felt, None], which[felt], lengths[felt]
    bounds = bounds[which] / lengths
    free = np.zeros(size) if across is not None else -scipy.linalg.solve_triangular(factor, model.gradient, lower=True)
    # The nearest point to `free` with rows y >= bounds.
    short, nearest, weights = bounds - rows @ free, free, np.zeros(len(bounds))
    active = np.flatnonzero(short > 0)
    for _ in range(ROUNDS):
        if not len(active):
            break
        residual, forces = least_distance(rows[active], short[active])
        if not abs(residual[-1]) > 1e-13:  # the rows contradict each other
            return None
        nearest = free - residual[:size] / residual[-1]
        weights[:] = 0.0
        weights[active] = -forces / residual[-1]
        missed = np.flatnonzero(rows @ nearest - bounds < -1e-9 * (1 + np.abs(bounds)))
        if not len(np.setdiff1d(missed, active)):
            break
        active = np.union1d(np.flatnonzero(weights > 0), missed)
    change = scipy.linalg.solve_triangular(factor.T, nearest, lower=False)
    forces = np.zeros(len(model.values) + 2 * size)
    forces[which] = weights / lengths
    multipliers, lower, upper = np.split(forces, [len(model.values), len(model.values) + size])
    decrease = -float(model.gradient @ change + 0.5 * change @ curvature @ change)
    return ModeStep(change, decrease, multipliers, (lower - upper).reshape(model.low.shape))


Linearized = tuple[Array, list[Period]]  # points and periods of a plan


def secant_curvature(model: ModeModel, earlier: Sequence[Linearized], step: ModeStep) -> Array:
    """The part of the Lagrangian's Hessian that the model lacks, (T m, T m): second derivatives of periods, switches.

    Each period's matrix is built by symmetric updates of rank one (SR1), from zero, over the earlier plans, the latest
    last, in which the period had the same mode. The multipliers are those of the step.
    """
    n = len(model.last[0])
    lacking, costate, signed = np.zeros_like(model.hessian), model.last[0], model.sides * step.multipliers
    for t in reversed(range(len(model.periods))):
        period, pull = model.periods[t], signed[model.first[t] : model.first[t + 1]]
        held = period.switches.names[pull != 0]
        bend, where, before, rate = np.zeros((model.points.shape[1],) * 2), None, None, np.zeros(0)
        for points, periods in (*earlier, (model.points, model.periods)):
            other = periods[t]
            if not other.switches.same_mode(period.switches):
                continue
            rate = other.jacobian.T @ costate - other.switches.at(held, other.slopes).T @ pull[pull != 0]
            if not np.isfinite(rate).all():
                continue
            if where is not None and before is not None:
                way = points[t] - where
                residual = rate - before - bend @ way
                along, size = float(residual @ way), float(np.linalg.norm(way))
                if size < SHORT:
                    continue
                if abs(along) > SKEW * size * np.linalg.norm(residual):
                    bend += np.outer(residual, residual) / along
            where, before = points[t], rate
        lacking += model.motions[t].T @ bend @ model.motions[t]
        rate = model.stages[t][0] + rate
        rate[n:] -= step.limits[t]
        costate = rate[:n] + model.gain[t].T @ rate[n:]
    return 0.5 * (lacking + lacking.T)


def bent(curvature: Array, lacking: Array) -> Array:
    """The sum of a positive definite and another matrix, with negative eigenvalues reversed and none near zero."""
    parts, vectors = scipy.linalg.eigh(lacking, curvature)
    vectors = curvature @ vectors
    return (vectors * np.maximum(np.abs(1 + parts), FLAT)) @ vectors.T


class Descent:
    """Descent from a plan, mode by mode, with the best `plan` so far and the model about it."""

    def __init__(
        self, problem: Problem, modes: ContactModes, plan: CostedPlan, tolerance: float, budget: Budget
    ) -> None:
        self._problem, self._modes, self._tolerance, self._budget = problem, modes, tolerance, budget
        self._damping, self._laps, self._earlier = 0.0, Laps(budget, plan.cost), list[Linearized]()
        self.plan, self.model = plan, ModeModel(problem, modes, plan)

    def run(self) -> Status:
        """Descend until the plan is optimal, nothing lowers the cost, or the budget is over."""
        aim, lacking, about = None, None, None
        while not self._budget.over:
            if about is not self.model:
                aim, lacking, about = minimize(self.model, self.model.hessian), None, self.model
            if aim is not None and aim.decrease < self._tolerance * abs(self.plan.cost):
                beyond = self._crossed(aim)
                if beyond is None:
                    return Status.CONVERGED
            else:
                if lacking is None and aim is not None:
                    lacking = secant_curvature(self.model, self._earlier, aim)
                beyond = self._descended(lacking)
                if beyond is None:
                    if self._damping > MOST:
                        return Status.STALLED
                    continue
            self._go_to(beyond)
        return Status.TIME_LIMIT if self._budget.stop.due else Status.MAX_ITERATIONS

    def _descended(self, lacking: Array | None) -> CostedPlan | None:
        """A step that lowers the cost in the plan's mode; None if none was found with this damping, which grows."""
        damped = self.model.hessian + self._damping * np.diag(np.diag(self.model.hessian))
        plans = list[CostedPlan | None]()
        with contextlib.suppress(np.linalg.LinAlgError):  # without damping they need not be positive definite
            plans.append(self._stepped(damped))
            if lacking is not None and lacking.any():
                plans.append(self._stepped(bent(damped, lacking)))
        best = min((plan for plan in plans if plan is not None), key=lambda one: one.cost, default=None)
        if best is None:
            self._damping = max(10 * self._damping, DAMPING)
        else:
            self._damping = 0.1 * self._damping if self._damping > DAMPING else 0.0
        return best

    def _stepped(self, curvature: Array) -> CostedPlan | None:
        """The plan after a step of this curvature, halved until it lowers the cost enough; None if it never does."""
        model, cost, step = self.model, self.plan.cost, minimize(self.model, curvature)
        if step is None or not step.decrease > 0:
            return None
        for halvings in range(HALVINGS):
            share = 0.5**halvings
            change, most = share * step.change, cost - ENOUGH * share * step.decrease
            trial = model.changed(change)
            if not trial.cost < most:
                trial = self._pushed_back(trial, change, step.multipliers)
            if trial.cost < most:
                return trial
        return None

    def _pushed_back(self, trial: CostedPlan, change: Array, multipliers: Array) -> CostedPlan:
        """The plan after a change of the offsets, corrected until it crosses no switch; or else the last trial."""
        wanted, factor = self.model.values + self.model.slopes @ change, None
        for _ in range(PUSHES):
            if not np.isfinite(trial.cost):
                break
            rows, missing, crossed = self._missing(trial, wanted, multipliers)
            if not crossed:
                break
            factor = scipy.linalg.cho_factor(self.model.hessian) if factor is None else factor
            change = change + self._push(factor, rows, missing)
            trial = self.model.changed(change)
        return trial

    def _missing(
        self, trial: CostedPlan, wanted: Array, multipliers: Array
    ) -> tuple[npt.NDArray[np.intp], Array, bool]:
        """The switches that a trial must keep to, what each misses, and whether the trial crosses any."""
        model, rows, missing, crossed, jumped = self.model, list[int](), list[float](), False, False
        for t, period in enumerate(model.periods):
            here = slice(model.first[t], model.first[t + 1])
            sides, held = model.sides[here], multipliers[here] > 0
            short = np.zeros(len(held))
            if len(held) and not jumped:
                values = self._modes.step(trial.states[t], trial.controls[t])[1].at(period.switches.names)
                across = (sides * values < 0) & model.known[here]
                seen = period.switches.before_jump(across)
                aim = np.where(held, np.maximum(MARGIN, sides * wanted[here]), MARGIN)
                across &= seen
                held = (across | held) & (np.isfinite(values) | ~seen)
                short = np.where(seen, sides * aim - values, 0.0)
                crossed, jumped = crossed or bool(across.any()), bool((across & ~period.switches.forces).any())
            # The rest of a plan after a jump is meaningless: pressed switches there keep their intended values.
            rows += (model.first[t] + np.flatnonzero(held)).tolist()
            missing += short[held].tolist()
        return np.array(rows, dtype=np.intp), np.array(missing), crossed

    def _push(self, factor: tuple[Array, bool], rows: npt.NDArray[np.intp], missing: Array) -> Array:
        """The change of the offsets that gives these switches what they miss, at the least cost of the model."""
        slopes = self.model.slopes[rows]
        moves = scipy.linalg.cho_solve(factor, slopes.T)
        system = slopes @ moves
        scale = 1 / np.sqrt(np.maximum(np.diag(system), 1e-300))
        forces = np.linalg.lstsq(scale[:, None] * system * scale, scale * missing, rcond=1e-10)[0]
        return moves @ (scale * forces)

    def _crossed(self, step: ModeStep) -> CostedPlan | None:
        """A cheaper plan across a switch that the present plan is pressed against; None if there is none."""
        for which in np.argsort(-step.multipliers)[: np.count_nonzero(step.multipliers)].tolist():
            best = self.model.beyond(which)
            if best is not None and best.cost < self.plan.cost - self._tolerance * abs(self.plan.cost):
                return best
        return None

    def switch_multipliers(self) -> tuple[list[Switches], Array]:
        """The multipliers of the switches of each period, by name, and of the limits of the controls, (T, m)."""
        step = minimize(self.model, self.model.hessian)
        multipliers = np.zeros(len(self.model.values)) if step is None else step.multipliers
        parts = np.split(multipliers, self.model.first[1:-1])
        periods = zip(self.model.periods, parts, strict=True)
        by_period = [Switches(period.switches.names, part) for period, part in periods]
        return by_period, np.zeros_like(self.model.low) if step is None else step.limits

    def result(self, status: Status, **others: Any) -> RunResult:
        plan = Motion(self.plan.states, self.plan.controls)
        policy = compiled.policy_about(*plan, self.model.gain)
        return RunResult(status=status, plan=plan, policy=policy, cost=self.plan.cost, violation=0.0, **others)

    def _go_to(self, plan: CostedPlan) -> None:
        count = self.model.points.shape[1] - 1
        self._earlier = [*self._earlier[-count:], (self.model.points, self.model.periods)]
        self.plan, self.model = plan, ModeModel(self._problem, self._modes, plan)
        self._laps.record("contact modes", plan.cost, optimality=np.nan)


def linearized(problem: Problem, modes: ContactModes, state: Array, control: Array) -> Period:
    """A period. If no switch is near, the compiled derivatives are used, which are as good and faster."""
    modes.check_time()
    end, switches = modes.step(state, control)
    if len(switches.names):
        return modes.linearize(state, control)
    jacobian = np.hstack(problem.dynamics.linearize(state, control, problem.dt)[:2])
    return Period(end, jacobian, switches, np.zeros((0, jacobian.shape[1])))


def rolled_out(problem: Problem, states: Array, controls: Array, gain: Array) -> CostedPlan:
    """The plan of the policy with these gains about these states (T+1, n) and controls (T, m)."""
    states, controls = compiled.rollout(problem, *compiled.policy_about(states, controls, gain), states[0])
    cost = compiled.cost_of(problem, states, controls) if np.isfinite(states).all() else np.inf
    return CostedPlan(states, controls, cost)


def keep_modes(run: SolveRun, result: RunResult) -> RunResult | None:
    """Descend from a plan within its contact modes; certified. None if no switch is near it, or known."""
    problem, dynamics = run.problem, run.problem.dynamics
    modes = dynamics.contact_modes(problem.dt) if isinstance(dynamics, MjcfDynamics) else None
    if modes is None or problem.constraints or problem.noise_term or not isinstance(problem.initial, FixedState):
        return None
    plan = CostedPlan(result.states.copy(), result.controls.copy(), result.cost)
    pairs = zip(plan.states[:-1], plan.controls, strict=True)
    if not np.isfinite(plan.cost) or not any(len(modes.step(x, u)[1].names) for x, u in pairs):
        return None

    def check_time() -> None:
        if run.budget.stop.due:
            raise TimeoutError

    modes.check_time = check_time
    descent = None
    try:
        descent = Descent(problem, modes, plan, run.method.tolerance, run.budget)
        return with_certificate(run, modes, descent, descent.run())
    except TimeoutError:
        if descent is None or descent.plan is plan:
            return None
        detail = "no time was left for a certificate within its contact modes"
        return certified(run, descent.result(Status.TIME_LIMIT, detail=detail))


def with_certificate(run: SolveRun, modes: ContactModes, descent: Descent, status: Status) -> RunResult:
    """The result of a descent that ended with this status, and its certificate."""
    plan, (multipliers, limits) = descent.plan, descent.switch_multipliers()
    optimality, value = optimality_in_mode(run.problem, modes, plan, descent.model.gain, multipliers, limits)
    result = descent.result(Status.STALLED, values={"cost_to_go": value})
    certificate = certified(run, result).certificate
    assert certificate is not None
    contacts = surroundings(descent.model, plan, multipliers)
    certificate = replace(certificate, optimality=optimality, contacts=contacts)
    detail = f"within its contact modes, against {contacts.pressed} switches"
    if status is Status.CONVERGED:
        wrong = faults(certificate, claimed=plan.cost, rounding=0.0, tolerance=run.method.tolerance)
        if max(contacts.across, contacts.sampled) > run.method.tolerance:
            wrong = f"{wrong}, a plan beside it is cheaper".removeprefix(", ")
        if wrong:
            status, detail = Status.STALLED, f"{detail}; {wrong}"
    elif status is Status.STALLED:
        detail = f"{detail}, no step lowers the cost any more"
    return replace(result, status=status, detail=detail, cost=certificate.cost, certificate=certificate)


def optimality_in_mode(
    problem: Problem, modes: ContactModes, plan: CostedPlan, gain: Array, multipliers: Sequence[Switches], limits: Array
) -> tuple[float, Quadratic]:
    """A bound on the relative decrease of cost within the plan's own mode, and the policy's cost-to-go.

    By duality: half the square of the Lagrangian's gradient in the offsets, weighed as in `kernels/certificate.py`, and
    the products of multipliers and distances of switches and limits. It uses the problem's functions and derivatives in
    a separate recursion, not the model from which the plan was found. Multipliers of switches are nonnegative, those of
    the control limits, (T, m), negative for upper limits.
    """
    states, controls, steps = plan.states, plan.controls, problem.steps
    n, m = states.shape[1], controls.shape[1]
    data, space = compiled.compile_problem(problem), problem.control_coordinates
    cost, rate, joint = compiled.quadratic_at(problem, data.final, states[steps], np.zeros(m), steps)
    ahead, costate, lagrangian, decrease = joint[:n, :n].copy(), rate[:n], rate[:n], 0.0
    hessians, slopes, constants = [ahead], [costate], [cost]
    for t in reversed(range(steps)):
        u, period = controls[t], linearized(problem, modes, states[t], controls[t])
        value, gradient, hessian = compiled.quadratic_at(problem, data.stage, states[t], u, t)
        cost, switches = cost + value, period.switches
        pull = np.nan_to_num(multipliers[t].at(switches.names))
        decrease += float(pull @ np.abs(switches.values))
        signed = np.where(switches.values < 0, -pull, pull)
        joint = hessian + period.jacobian.T @ ahead @ period.jacobian
        rate = gradient + period.jacobian.T @ lagrangian - np.nan_to_num(period.slopes).T @ signed
        policy_rate = gradient + period.jacobian.T @ costate
        rate[n:] -= limits[t]
        room = np.where(limits[t] > 0, u - space.low, np.where(limits[t] < 0, space.high - u, 0.0))
        decrease += float(np.abs(limits[t]) @ room) + 0.5 * float(rate[n:] @ np.linalg.solve(joint[n:, n:], rate[n:]))
        closed = np.vstack([np.eye(n), gain[t]])
        ahead, costate, lagrangian = closed.T @ joint @ closed, closed.T @ policy_rate, closed.T @ rate
        hessians.append(ahead)
        slopes.append(costate)
        constants.append(cost)
    hessian, slope = np.array(hessians[::-1]), np.array(slopes[::-1])
    bent = np.einsum("tij,tj->ti", hessian, states)
    constant = np.array(constants[::-1]) - np.einsum("ti,ti->t", slope - 0.5 * bent, states)
    return decrease / max(abs(plan.cost), 1e-300), Quadratic(hessian, slope - bent, constant)


def surroundings(model: ModeModel, plan: CostedPlan, multipliers: Sequence[Switches]) -> ContactCertificate:
    """The true cost near a plan: across each switch that the plan is pressed against, and at random samples."""
    pressed = np.flatnonzero(np.concatenate([pull.values for pull in multipliers]) > 0).tolist()
    plans = map(model.beyond, pressed)
    cheapest = min((crossed.cost for crossed in plans if crossed is not None), default=np.inf)
    draws, reach = np.random.default_rng(0), np.minimum(model.high - model.low, 1e3)
    factor, lowest = scipy.linalg.cholesky(model.hessian, lower=True), np.inf
    for _ in range(SAMPLES):
        change = scipy.linalg.solve_triangular(factor.T, draws.standard_normal(len(factor)), lower=False)
        change = change.reshape(reach.shape)
        change *= SMALL / np.abs(change / reach).max()
        lowest = min(lowest, model.changed(change.ravel()).cost)
    size = max(abs(plan.cost), 1e-300)
    return ContactCertificate(
        pressed=len(pressed), across=(plan.cost - cheapest) / size, sampled=(plan.cost - lowest) / size,
        radius=SMALL, samples=SAMPLES,
    )  # fmt: skip
