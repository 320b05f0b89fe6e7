"""The policy of a belief, on an extended Kalman filter that runs with it."""

from dataclasses import replace

import numpy as np

from lqrsim.annotations import checked
from lqrsim.control.controllers import Controller, ControllerRun, Feedback
from lqrsim.control.tracking_laws import check_plan
from lqrsim.errors import Array, InputError
from lqrsim.problem.belief import Belief
from lqrsim.problem.problem import Problem
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Spaces
from lqrsim.results.solution import Solution


class BeliefFeedback(Controller):
    """The policy of a plan in belief space: controls affine in the mean and the root of the covariance.

    It reads the belief's sensors in place of measured states, from the end of the first period on, and begins with the
    plan's first belief. States that the belief takes as known are measured exactly. `ReadingErrors` are the errors of
    the readings in a run; the belief's `process` is the noise on the state that the filter assumes. A rollout's
    `controller_run` has `beliefs`, (T, K, N) at the knots at which there is a control.
    """

    @checked
    def __init__(self, problem: Problem, solution: Solution) -> None:
        if not isinstance(problem.dynamics, Belief):
            raise InputError("BeliefFeedback: problem: got one of other dynamics, want a problem of a Belief")
        check_plan("BeliefFeedback", problem, solution)
        self.belief, self.solution = problem.dynamics, solution

    def __repr__(self) -> str:
        return f"BeliefFeedback({self.belief.name}, {self.solution.trajectory.steps} steps)"

    def start(self, trials: int) -> "BeliefRun":
        return BeliefRun(self, trials)

    @property
    def sensors(self) -> Belief:
        return self.belief

    @property
    def plan(self) -> Solution:
        """The plan of the mean. Its policy has the gains on the mean; the covariance is that of the plan."""
        n, solution, policy = self.belief.size, self.solution, self.solution.policy
        known = np.vecdot(policy.gain[:, :, n:], policy.nominal[:, None, n:])
        law = replace(
            policy, gain=policy.gain[:, :, :n], offset=policy.offset + known, nominal=policy.nominal[:, :n],
            state_coordinates=self.belief.robot.state_coordinates,
        )  # fmt: skip
        trajectory = replace(solution.trajectory, states=solution.trajectory.states[:, :n])
        return replace(
            solution, policy=law, trajectory=trajectory, goal=None if solution.goal is None else solution.goal[:n],
            cost_to_go=None, cost_to_come=None, inverse_policy=None, candidates=(),
        )  # fmt: skip

    @property
    def digest(self) -> str:
        data, first = self.belief.data, self.solution.trajectory.states[0]
        late = str(self.belief.sensors.delay)
        return sha256(self.solution.policy.digest, self.belief.step_source.digest, data, first, late)[:16]

    @property
    def coordinates(self) -> Spaces:
        return self.belief.robot.state_coordinates, self.solution.policy.control_coordinates


class BeliefRun(ControllerRun):
    """K trials of a run.

    Attributes:
      beliefs: the beliefs at each knot so far, after the readings that had arrived by then, (t, K, N).
    """

    def __init__(self, law: BeliefFeedback, trials: int) -> None:
        self._law, self._feedback = law, Feedback(law.solution.policy)
        self._read = np.tile(law.solution.trajectory.states[0], (trials, 1))  # at the last knot whose readings arrived
        self._commands, self._known, self._record = list[Array](), list[Array](), list[Array]()

    @property
    def beliefs(self) -> Array:
        return np.array(self._record)

    def control(self, step: int, measured: Array) -> Array:
        belief = self._law.belief
        readings, late = measured[:, : belief.readings], belief.sensors.delay
        self._known.append(measured[:, belief.readings :])
        if not step:
            self._read[:, belief.known] = self._known[0]
        if step > late:
            self._read = belief.corrected(self._read, self._commands.pop(0), readings)
            self._read[:, belief.known] = self._known[step - late]
        now = self._read.copy()
        for command in self._commands:  # whose readings have not arrived
            now = belief.corrected(now, command, np.full_like(readings, np.nan))
        now[:, belief.known] = self._known[step]
        self._record.append(now)
        self._commands.append(self._feedback.control(step, now))
        return self._commands[-1]
