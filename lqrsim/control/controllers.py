"""What decides on the controls in the loop: a policy, or solving again. Subclass `Controller` for another way."""

import abc
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from lqrsim.control.law import evaluator
from lqrsim.errors import Array, InputError, check_kind, check_number
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.hashing import sha256
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory
from lqrsim.solvers import compiled
from lqrsim.solvers.smoother import smooth

Control = Callable[[int, Array], Array]


class Controller(abc.ABC):
    """Base class of what decides on the controls."""

    @abc.abstractmethod
    def start(self, trials: int) -> Control:
        """Begin a run of K trials: (step, states that are shown (K, n)) -> controls (K, m) within the limits.

        Each trial gets the controls that it gets alone, to the last bit.
        """

    @property
    @abc.abstractmethod
    def digest(self) -> str:
        """Hash of all that the controls depend on."""

    @property
    @abc.abstractmethod
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        """Of the states that it wants to be shown, and of its controls."""

    def lost(self) -> Mapping[int, str]:
        """The trials of the last run whose state it has lost -> why, in a line. They end there, as diverged.

        Asked after each control period. It is for what estimates; what just follows measurements loses none.
        """
        return {}

    def summary(self) -> str:
        """What there is to say of the last run, in a line; empty if nothing."""
        return ""


class Feedback(Controller):
    """A policy, or an open-loop plan, whose gains are zero."""

    def __init__(self, policy: AffinePolicy) -> None:
        self.policy = check_kind("Feedback: policy", policy, AffinePolicy, "an AffinePolicy, such as solution.policy")

    def start(self, trials: int) -> Control:
        policy = self.policy
        evaluate = evaluator(policy.state_coordinates, policy.control_coordinates)

        def control(step: int, shown: Array) -> Array:
            t = min(step, policy.steps - 1)
            return evaluate(shown, policy.gain[t], policy.offset[t], policy.nominal[t])

        return control

    @property
    def digest(self) -> str:
        return self.policy.digest

    @property
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        return self.policy.state_coordinates, self.policy.control_coordinates


class SolvingAgain:
    """What solves again as it goes, and how that went.

    Attributes:
      periods: control periods between two solves.
      solved: how many solves of the last run succeeded, of all its trials. kept: why others did not, and the law before
        went on: reason -> how many. `summary()` says both in a line.

    Raises:
      InputError: `every` is shorter than a control period; or the solution's plan has another horizon than the problem.
    """

    def __init__(self, who: str, problem: Problem, solution: Solution, every: float, name: str = "every") -> None:
        plan = solution.trajectory
        if (plan.steps, plan.dt) != (problem.steps, problem.dt):
            got, want = f"{plan.steps} steps of {plan.dt:g} s", f"{problem.steps} steps of {problem.dt:g} s"
            raise InputError(f"{who}: solution: got {got}, want the problem's: {want}")
        self.every = check_number(f"{who}: {name}", every, at_least=0.999 * problem.dt)
        self.periods = round(self.every / problem.dt)
        self.start()

    def start(self) -> None:
        """Forget the last run."""
        self.solved, self.kept = 0, Counter[str]()

    def due(self, step: int) -> bool:
        return step > 0 and step % self.periods == 0

    def solve(self, problem: Problem, step: int, state: Array, gain: Array, offset: Array) -> Solution | None:
        """A solution of what is left of a problem at a step, from a state (n,); None where there is none, counted.

        It begins with where the law in force, gain (T-step, m, n) and offset (T-step, m), leads from there by the
        model.
        """
        try:
            constraints = [one.ahead(step) for one in problem.constraints]
            problem = replace(problem, initial=FixedState(state), steps=problem.steps - step, constraints=constraints)
        except InputError as error:  # it begins within an obstacle
            return self.keep(str(error))
        # The law itself would not do: without its cost-to-go the first iteration may leave for a worse optimum.
        ahead = Trajectory(*compiled.rollout(problem, gain, offset, state), problem.dt)
        if not np.isfinite(ahead.states).all():
            return self.keep("the law before leads to infinity by the model")
        solution = smooth(problem, start=ahead, threads=1)
        if not solution.success:
            return self.keep(solution.status.name)
        self.solved += 1
        return solution

    def keep(self, reason: str) -> None:
        """Count why the law before goes on."""
        self.kept[reason] += 1

    def summary(self) -> str:
        """How often it solved in the last run, and why where it kept the law before, in a line."""
        line = f"solved again {self.solved} times"
        if self.kept:
            reasons = "; ".join(f"{count} times {reason}" for reason, count in self.kept.most_common())
            line += f", kept the law before {self.kept.total()} times: {reasons}"
        return line


class Replanning(Controller):
    """Solves again and again from where the robot is measured to be, for what is left of the horizon.

    Each solve begins with where the law in force leads from there, by the model, so that it ends in the local optimum
    nearest to that; where one does not succeed, that law goes on. It takes no time in the simulation, so that none is
    late. Costs that depend on the step's number are not supported.

    Args:
      problem: that was solved. solution: its solution.
      every: seconds between two solves, rounded to control periods.

    Attributes:
      solved: how many solves of the last run succeeded, of all its trials. kept: why others did not, and the law before
        went on: reason -> how many. `summary()` says both in a line.

    Raises:
      InputError: `every` is shorter than a control period.
    """

    def __init__(self, problem: Problem, solution: Solution, *, every: float) -> None:
        check_kind("Replanning: problem", problem, Problem, "a Problem, such as scenario.problem")
        check_kind("Replanning: solution", solution, Solution, "its Solution")
        dynamics = problem.dynamics
        spaces = solution.policy.state_coordinates.names, solution.policy.control_coordinates.names
        if spaces != (dynamics.state_coordinates.names, dynamics.control_coordinates.names):
            raise InputError("Replanning: solution: got one of another system, want the problem's")
        self._again = SolvingAgain("Replanning", problem, solution, every)
        self.problem, self.solution, self.every = problem, solution, self._again.every

    @property
    def solved(self) -> int:
        return self._again.solved

    @property
    def kept(self) -> Counter[str]:
        return self._again.kept

    def start(self, trials: int) -> Control:
        policy = self.solution.policy
        evaluate = evaluator(*self.spaces)
        self._again.start()
        laws = [(policy, 0)] * trials  # each trial's law, and the step that it begins at

        def control(step: int, shown: Array) -> Array:
            if self._again.due(step):
                for trial, state in enumerate(shown):
                    laws[trial] = self._replan(*laws[trial], step, state)
            commands = np.empty((trials, len(policy.control_coordinates)))
            for trial, (law, first) in enumerate(laws):
                t = min(step - first, law.steps - 1)
                one = shown[trial : trial + 1]
                commands[trial] = evaluate(one, law.gain[t], law.offset[t], law.nominal[t])[0]
            return commands

        return control

    def _replan(self, law: AffinePolicy, first: int, step: int, state: Array) -> tuple[AffinePolicy, int]:
        """The law from now on, and the step that it begins at."""
        if step >= self.problem.steps:
            return law, first
        done = step - first
        here = law.state_coordinates.nearest(state, law.nominal[done])
        solution = self._again.solve(self.problem, step, here, law.gain[done:], law.offset[done:])
        return (law, first) if solution is None else (solution.policy, step)

    def summary(self) -> str:
        """How often it solved in the last run, and why where it kept the law before, in a line."""
        return self._again.summary()

    @property
    def digest(self) -> str:
        return sha256(f"{self.solution.policy.digest} {self.problem.digest} {self._again.periods}")[:16]

    @property
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        return self.solution.policy.state_coordinates, self.solution.policy.control_coordinates
