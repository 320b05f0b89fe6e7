"""Output feedback that re-plans if its law no longer leads to the goal, with its estimates in the model.

At each check, and for each trial, the law is simulated with the model, from the estimated state and with the unknown
constants at their estimated values. If the simulated run collides or misses the goal, the rest of the horizon is solved
from that state, and the law and the filter are recomputed about the new plan. Otherwise a new plan would do harm: it
would have a lower cost, and go as close to obstacles as its constraints permit. The estimates continue unchanged. The
law acts on their difference from the values that the new plan assumes. Some disturbances are left to the law: gusts,
because they pass and plans do not model them; and gains and offsets of the controls and the lag of the actuators,
because they are not parameters of the model. A solve takes no time in the simulation.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.control.controllers import ControllerRun
from lqrsim.control.filter_law import Design, FilterLaw, FilterRun
from lqrsim.control.kalman import kalman_filter
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.replan_rule import ReplanLog, ReplanRule, SolveRequest
from lqrsim.errors import Array, InputError
from lqrsim.problem.problem import Problem
from lqrsim.results.solution_parts import Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.assembly import clearance_of
from lqrsim.solvers.initial_guess import InitialGuess


class ReplannedRun(ControllerRun):
    """A run in which each trial has its own law, which is checked by the rule; or solved anew `always`.

    Attributes:
      plans: plans of each trial, by the step at which they begin; without the first plan.
      estimates, innovations: as in `FilterRun`.
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
        near = radius is None or bool(solution.target.distance(states[-1]) <= radius)
        return near and (clearance is None or bool(clearance.min() >= 0))

    def _replan(self, run: FilterRun, trial: int, step: int) -> None:
        """Replace the law of a trial by a law about a new plan, if a new plan is needed and found."""
        law, model, z = run.law, run.model, run.z[0]
        n, done = model.n, step - run.first
        # The unknowns' states that are constant to the end of the horizon and change only parameters.
        beyond = (model.output[len(model.parameters) :] != 0).any(axis=0)
        known = (model.output != 0).any(axis=0) & ~beyond
        for unknown, states in zip(model.remembered, model.own_states, strict=True):
            known[list(states)] &= unknown.constant
        granted = np.where(known, z[n + model.lagging :], 0.0)
        changes = model.output[: len(model.parameters)] @ granted
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
        fixed = np.concatenate([reached, np.tile(granted, (len(gain), 1))], axis=1)
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
        run.law, run.first = FilterLaw.of(solution, Design.of(about, kalman, weights), granted), step
