"""A Kalman filter with the law that acts on its estimates: matrices about a plan, runs of K trials, and the export.

A run predicts with the nonlinear dynamics. The export, an `OutputFeedbackPolicy`, is linear about the plan.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.control.controllers import ControllerRun
from lqrsim.control.kalman import KalmanFilter, kalman_filter
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.replanner import ReplanLog, ReplanRule, SolveRequest
from lqrsim.control.tracking_laws import Laws, Weights, tracking_laws
from lqrsim.errors import Array, InputError
from lqrsim.kernels.feedback import FAR
from lqrsim.kernels.records import Limits, Policy
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.policy import OutputFeedbackPolicy
from lqrsim.results.solution import Plan
from lqrsim.results.solution_parts import Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.assembly import clearance_of
from lqrsim.solvers.settings import InitialGuess


@dataclass(frozen=True, eq=False)
class Design:
    """A filter with the law that acts on its estimates, or with C laws to choose from, for deviations from the plan."""

    model: PlanModel
    filter: KalmanFilter
    weights: Weights
    laws: Laws

    @classmethod
    def of(cls, model: PlanModel, kalman: KalmanFilter, weights: Weights) -> "Design":
        return cls(model, kalman, weights, tracking_laws(model, weights))

    def pick(self, i: int) -> "Design":
        """The design with one of the C laws."""
        return replace(self, weights=self.weights.pick(i), laws=self.laws.pick(i))


@dataclass(frozen=True, eq=False)
class FilterLaw:
    """A chosen `Design` for a run: the filter, and the law `u = gain z + offset` of its estimates z, about one plan."""

    plan: Plan
    model: PlanModel
    filter: KalmanFilter
    weights: Weights
    gain: Array  # (T, m, Z)
    offset: Array  # (T, m)
    nominal: Array  # (T+1, Z), z in an undisturbed run

    @classmethod
    def of(cls, plan: Plan, design: Design, in_plan: Array | None = None) -> "FilterLaw":
        """The law about a plan. `in_plan` are the unknowns' states (D,) with which it was planned; 0 by default."""
        model, (gain, offset) = design.model, design.laws
        trajectory = model.plan
        in_plan = np.zeros(len(model.transition)) if in_plan is None else in_plan
        # From deviations to the filter's estimates themselves.
        unknowns = np.tile(in_plan, (trajectory.steps + 1, 1))
        nominal = np.concatenate([trajectory.states, model.reached, unknowns], axis=1)
        offset = trajectory.controls + offset - np.einsum("tij,tj->ti", gain, nominal[:-1])
        return cls(plan, model, design.filter, design.weights, in_c_order(gain), offset, nominal)


class FilterRun(ControllerRun):
    """A run of `OffsetFree` with K trials: their estimates z (K, Z) at the knot of the newest measurement.

    If measurements are late by k periods, the filter runs k periods behind. Its estimate is predicted forward with the
    commands since, to the time at which the next command acts. The law's plan begins at the step `first`.
    """

    def __init__(self, law: FilterLaw, trials: int, record: bool) -> None:
        self.law, self.first = law, 0
        self.model = law.model  # for predictions, independent of a later plan's assumptions about the unknowns
        self._trials = trials
        self.z = np.tile(law.nominal[0], (trials, 1))
        # If the first measurement is lost, it counts as the plan's first state.
        self._last_measured = np.tile(law.model.plan.states[0], (trials, 1))
        self._diverged: dict[int, str] = {}
        self._innovation = np.empty((trials, law.model.sensor.size))
        self._limit_factors = np.ones(trials)  # factors on the limits of corrections; see `kernels/feedback.py`
        shape, sizes = (law.model.plan.steps + 1, trials), (law.model.size, law.model.sensor.size)
        self.estimates, self.innovations = (np.full((*shape, size), np.nan) if record else None for size in sizes)
        self._limits = Limits(*law.plan.policy.control_coordinates.limits)
        self._latency, self._delay = law.model.uncertainty.latency, law.model.uncertainty.delay
        # Commands since the knot of z, the oldest first. Until the first ones arrive, the plan's are applied.
        controls = law.model.plan.controls
        self._commands = [np.tile(controls[min(i, len(controls) - 1)], (trials, 1)) for i in range(self._delay)]

    def control(self, step: int, measured: Array) -> Array:
        self.update(step, measured)
        return self.command(step)

    def estimator_diverged(self) -> Mapping[int, str]:
        return self._diverged

    def update(self, step: int, measured: Array) -> None:
        """Predict the estimate to the knot of a step's measurement, and correct it."""
        if step < self._latency:  # no measurement has arrived
            return
        law, model = self.law, self.model
        if step > self._latency:
            self._predict(self.z, self._commands.pop(0))
        # After the horizon the last gain stays in force.
        knot = min(step - self.first - self._latency, law.model.plan.steps)
        lost = (measured == self._last_measured).all(axis=1).astype(np.float64)
        self._last_measured[:] = measured
        model.compiled.correct(
            self._trials, in_c_order(measured), lost, in_c_order(law.model.plan.states[knot]),
            law.filter.gain[knot], law.filter.limit[knot], self._limit_factors, model.compiled_sensor, model.turning,
            self.z, self._innovation,
        )  # fmt: skip
        at = step - self._latency
        if self.estimates is not None and self.innovations is not None and at < len(self.estimates):
            self.estimates[at], self.innovations[at] = self.z, self._innovation

    def command(self, step: int) -> Array:
        """The controls of a step, after its measurement was used."""
        law, model = self.law, self.model
        predicted = self.z
        if self._commands:
            predicted = predicted.copy()
            for command in self._commands:
                self._predict(predicted, command)
        t = min(step - self.first + self._delay, law.model.plan.steps - 1)
        out = np.empty((self._trials, self.model.m))
        nominal = in_c_order(law.model.plan.states[t])
        gains = Policy(law.gain[t], law.offset[t])
        model.compiled.command(self._trials, predicted, nominal, gains, self._limits, model.turning, out)
        self._commands.append(out.copy())
        first_implausible = np.empty(self._trials)
        model.compiled.diverged(self._trials, predicted, first_implausible)
        for k in np.flatnonzero(first_implausible < model.size):
            i = int(first_implausible[k])
            fault = f"is beyond {FAR:g}" if np.isfinite(predicted[k, i]) else "is not finite"
            self._diverged.setdefault(int(k), f"the estimate of {model.names[i]} {fault}")
        return out

    def _predict(self, estimates: Array, commands: Array) -> None:
        with self.model.dynamics.quiet():
            self.model.compiled.predict(self._trials, in_c_order(commands), self.model.predictor, estimates)


class ReplannedRun(ControllerRun):
    """A run of `OffsetFree(..., replan_every=...)`: each trial has its own law, about a new plan if that is needed.

    At each check of the rule, the law is simulated with the model, from the estimated state and with the unknown
    constants at their estimated values. If that run collides or misses the goal, or `always`, the rest of the horizon
    is solved from that state, and law and filter are recomputed about the new plan. A law that still leads to the goal
    stays: a new plan would cost less, but go as close to obstacles as its constraints permit. The estimates continue
    unchanged, and the law acts on their difference from the values that the new plan assumes. Some disturbances are
    left to the law: gusts, because they pass and plans do not model them; and gains and offsets of the controls and the
    lag of the actuators, which are no parameters of the model. A solve takes no time in the simulation.

    Attributes:
      plans: the new plans of each trial, by the step at which they begin.
    """

    def __init__(self, rule: ReplanRule, law: FilterLaw, trials: int, record: bool, *, always: bool) -> None:
        self._rule, self._always = rule, always
        self._runs = [FilterRun(law, 1, record) for _ in range(trials)]
        self.plans: list[dict[int, Trajectory]] = [{} for _ in range(trials)]
        self.log, self._sent = ReplanLog(), list[Array | None]([None] * trials)

    @property
    def estimates(self) -> Array | None:
        return self._of_all([run.estimates for run in self._runs])

    @property
    def innovations(self) -> Array | None:
        return self._of_all([run.innovations for run in self._runs])

    def _of_all(self, records: list[Array | None]) -> Array | None:
        known = [record for record in records if record is not None]
        return np.concatenate(known, axis=1) if known else None

    def control(self, step: int, measured: Array) -> Array:
        commands: list[Array] = []
        for k, run in enumerate(self._runs):
            run.update(step, measured[k : k + 1])
            if self._rule.due(step, max(step - 1, 0)) and not run.estimator_diverged():
                self._replan(run, k, step)
            commands.append(run.command(step))
            self._sent[k] = commands[-1][0]
        return np.concatenate(commands)

    def estimator_diverged(self) -> Mapping[int, str]:
        return {k: why for k, run in enumerate(self._runs) for why in run.estimator_diverged().values()}

    def summary(self) -> str:
        return self.log.summary()

    def _leads_to_goal(self, problem: Problem, gain: Array, offset: Array, state: Array) -> bool:
        """Whether a law leads from a state (n,) to the goal, clear of obstacles, by the model."""
        states, _ = compiled.rollout(problem, gain, offset, state)
        if not np.isfinite(states).all():
            return False
        clearance, solution = clearance_of(problem, states), self._rule.solution
        radius = solution.target.radius_of_plan(solution.goal_radius)
        reached = radius is None or bool(solution.target.distance(states[-1]) <= radius)
        return reached and (clearance is None or bool(clearance.min() >= 0))

    def _replan(self, run: FilterRun, trial: int, step: int) -> None:
        """Replace the law of a trial by a law about a new plan, if a new plan is needed and found."""
        law, model, z = run.law, run.model, run.z[0]
        n, done = model.n, step - run.first
        # The unknowns' states that are constant to the end of the horizon and change only parameters.
        on_controls = (model.output[len(model.parameters) :] != 0).any(axis=0)
        modelled = (model.output != 0).any(axis=0) & ~on_controls
        for unknown, states in zip(model.remembered, model.unknown_states, strict=True):
            modelled[list(states)] &= unknown.constant
        in_plan = np.where(modelled, z[n + model.lagging :], 0.0)
        changes = model.output[: len(model.parameters)] @ in_plan
        values = {
            name: float(model.dynamics.parameters[name] + change)
            for name, change in zip(model.parameters, changes, strict=True)
        }
        try:
            dynamics = model.dynamics.with_parameters(**values)
            problem = replace(self._rule.problem, dynamics=dynamics)
        except InputError as error:  # an estimate is not finite
            self.log.kept[str(error)] += 1
            return
        # In that model the actuators have no lag, gains or offsets.
        gain, reached = law.gain[done:], law.nominal[done:-1, n : n + model.lagging]
        fixed = np.concatenate([reached, np.tile(in_plan, (len(gain), 1))], axis=1)
        offset = law.offset[done:] + np.einsum("tij,tj->ti", gain[:, :, n:], fixed)
        here = dynamics.state_coordinates.nearest(z[:n], law.nominal[done, :n])
        gain = in_c_order(gain[:, :, :n])
        if not self._always and self._leads_to_goal(problem, gain, offset, here):
            return
        plan = law.plan
        start = InitialGuess(gain, in_c_order(offset), cost_to_go=plan.shifted(done, horizon="shrinking").cost_to_go)
        sent = self._sent[trial] if problem.control_rate is not None else None
        solution = self._rule.solve(SolveRequest(step, step, here, start, problem, sent))
        if not self.log.enter(step, trial, solution):
            return
        self.plans[trial][step] = solution.trajectory
        about = PlanModel(dynamics, solution.trajectory, model.uncertainty, model.sensor)
        # The filter begins with a measurement that has been used already.
        kalman = kalman_filter(about, law.filter.corrected_root[done])
        weights = replace(law.weights, emphasis=None)  # that of another plan
        run.law, run.first = FilterLaw.of(solution, Design.of(about, kalman, weights), in_plan), step


def policy_of(law: FilterLaw) -> OutputFeedbackPolicy:
    """The law as an `OutputFeedbackPolicy`, linear about the plan.

    Commands under way are part of the state, and advance by one place in each period. If measurements are late by k
    periods, z is k periods behind, and the law acts on the prediction of z with the commands since, which is linear.
    """
    model, plan = law.model, law.model.plan
    steps, m, latency, delay = plan.steps, model.m, model.uncertainty.latency, model.uncertainty.delay
    size, width = model.size, model.size + (latency + delay) * m
    F, G, nominal = model.F, model.G, law.nominal
    f = nominal[1:] + model.c - np.einsum("tij,tj->ti", F, nominal[:-1]) - np.einsum("tij,tj->ti", G, plan.controls)
    measured = np.empty((steps + 1, model.sensor.size))  # h of y = H x + h
    model.compiled.measurements(len(measured), in_c_order(plan.states), model.compiled_sensor, measured)
    measured -= np.einsum("tij,tj->ti", model.H, plan.states)
    knots = np.maximum(np.arange(steps) - latency, 0)  # of z
    sent = np.clip(np.arange(steps)[:, None] + delay - np.arange(latency + delay, 0, -1), 0, steps - 1)
    arrays = {
        "gain": np.empty((steps, m, width)), "offset": np.empty((steps, m)),
        "correction": np.zeros((steps, width, model.sensor.size)),
        "sensor": model.H[knots], "sensor_offset": measured[knots],
        "transition": np.zeros((steps, width, width)), "input": np.zeros((steps, width, m)),
        "drift": np.zeros((steps, width)),
        "nominal": np.concatenate([nominal[knots], plan.controls[sent].reshape(steps, -1)], axis=1),
    }  # fmt: skip
    for t, knot in enumerate(knots):
        under_way = min(t, latency) + delay  # commands, the newest last
        first = width - under_way * m
        # The prediction with the commands under way: z ahead = onto (z, commands) + constant.
        onto, constant = np.eye(size, width), np.zeros(size)
        for i in range(under_way):
            j = min(knot + i, steps - 1)
            onto, constant = F[j] @ onto, F[j] @ constant + f[j]
            onto[:, first + i * m : first + (i + 1) * m] += G[j]
        at = min(t + delay, steps - 1)
        arrays["gain"][t], arrays["offset"][t] = law.gain[at] @ onto, law.gain[at] @ constant + law.offset[at]
        transition, given, commands = arrays["transition"][t], arrays["input"][t], width - size
        transition[:size, :size] = F[knot] if t >= latency else np.eye(size)  # z waits for the first measurement
        if t >= latency:
            arrays["correction"][t, :size], arrays["drift"][t, :size] = law.filter.gain[knot], f[knot]
            acting = transition[:size, size : size + m] if commands else given[:size]  # the oldest command
            acting[:] = G[knot]
        if commands:  # all move up, and the new one is the last
            transition[size:-m, size + m :] = np.eye(commands - m)
            given[-m:] = np.eye(m)
    return OutputFeedbackPolicy(
        **arrays, dt=plan.dt, state_coordinates=law.plan.policy.state_coordinates,
        control_coordinates=law.plan.policy.control_coordinates,
        measured_coordinates=_measured_coordinates(law),
    )  # fmt: skip


def _measured_coordinates(law: FilterLaw) -> Coordinates:
    """Coordinates of the measured numbers: the coordinates of the states, if states are measured."""
    space, names = law.plan.policy.state_coordinates, law.model.sensor.names
    if not set(names) <= set(space.names):
        return Coordinates(names=names, units=("",) * len(names))
    chosen = [space.names.index(name) for name in names]
    rotations = [
        place
        for place, i in enumerate(chosen)
        if i in space.rotation_vectors and chosen[place : place + 3] == [i, i + 1, i + 2]
    ]
    return Coordinates(
        names=names, units=tuple(space.units[i] for i in chosen), rotation_vectors=tuple(rotations),
        angles=tuple(place for place, i in enumerate(chosen) if i in space.angles),
    )  # fmt: skip
