"""Controllers of a run: a policy, a function or a `Controller`; and the state of one run.

Affine laws run compiled, for many trials at once. Each trial gets bit-identical controls to those it would get alone.
`AffinePolicy` implements the same law in NumPy, for a robot; its module's docstring says why there are two.
"""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import checked
from lqrsim.codegen.compiled_module import CompiledModule, in_c_order, module_of
from lqrsim.codegen.fingerprint import identity
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError, check_function, check_kind, shaped
from lqrsim.kernels import feedback
from lqrsim.kernels.records import AngularStates, Limits, Policy
from lqrsim.problem.belief import Belief
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.problem import Problem
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates, Spaces, check_same_system, spaces_of
from lqrsim.results.policy import AffinePolicy, OutputFeedbackPolicy
from lqrsim.results.solution import Plan, Solution
from lqrsim.robots.sensors import RobotSensors


def evaluator(policy: AffinePolicy) -> Callable[[AffinePolicy, int, Array], Array]:
    """A function that evaluates laws with these coordinates: (policy, row, states (K, n)) -> controls (K, m)."""
    states, controls = spaces_of(policy)
    limits, turning = Limits(*controls.limits), turning_of(states)
    laws = _laws(len(states), len(controls))

    def evaluate(policy: AffinePolicy, row: int, measured: Array) -> Array:
        x, out = np.array(measured, dtype=np.float64), np.empty((len(measured), len(controls)))
        law = Policy(in_c_order(policy.gain[row]), in_c_order(policy.offset[row]))
        laws.apply_policy(len(x), x, law, in_c_order(policy.nominal[row]), turning, limits, out)
        return out

    return evaluate


def turn_to_nearest(space: Coordinates, states: Array, nominal: Array) -> None:
    """As `space.nearest`, compiled and in place: states (T+1, K, n), C-ordered, become those nearest to (T+1, n)."""
    flat, turning = states.reshape(-1, len(space)), turning_of(space)
    _laws(len(space), 1).all_to_nearest(len(states), states.shape[1], flat, in_c_order(nominal), turning)


def _laws(n: int, m: int) -> CompiledModule:
    return module_of(source_of(feedback), f"policies of {n} states and {m} controls", N=n, M=m)


def turning_of(space: Coordinates) -> AngularStates:
    """The states that are to be turned to the nearest, in the form that `kernels/feedback.py` takes."""
    angles, rotations = np.array(space.angles, dtype=np.float64), np.array([space.rotation_vectors, space.turns]).T
    return AngularStates(angles, len(angles), in_c_order(rotations), len(rotations))


ControlFunction = Callable[[Array, float], npt.ArrayLike]


class ControllerRun(abc.ABC):
    """One run of a controller: its memory of K trials, and its records."""

    @abc.abstractmethod
    def control(self, step: int, measured: Array) -> Array:
        """The controls (K, m) of a control period, within the limits. Each trial gets the same bits as it would alone.

        Args:
          step: number of the control period; called once for each, in order.
          measured: (K, n), the measured states, NaN where one got lost for a controller that `sees_losses`; their
            readings, (K, Y), for a controller with `sensors`.
        """

    def estimator_diverged(self) -> Mapping[int, str]:
        """Rows of the trials whose estimate is useless, each with a reason in one line.

        They end in that period and count as diverged. The method is called after each control period. Controllers
        without an estimator need not override it.
        """
        return {}

    def moved_goal(self) -> Array | None:
        """The goal (n,) of the trials if it moved in the run, NaN in states that do not count; else None."""
        return None

    def summary(self) -> str:
        """A remark on the run, in one line, or empty."""
        return ""


class Controller(abc.ABC):
    """Computes the controls. Subclass it for your own controller, unless a function of state and time is enough.

    Running a controller does not change it: `start` returns the state of a run, so one controller can serve several
    runs at once.

    Attributes:
      sees_losses: whether a measurement that got lost is shown as NaN; else the last one that arrived is repeated.
    """

    sees_losses: bool = False

    @abc.abstractmethod
    def start(self, trials: int) -> ControllerRun:
        """The run of K trials; after `simulate` it is the rollout's `controller_run`."""

    @property
    @abc.abstractmethod
    def digest(self) -> str:
        """Hash of everything that the controls depend on."""

    @property
    @abc.abstractmethod
    def coordinates(self) -> Spaces:
        """Coordinates of the states that the controller needs, and of its controls."""

    @property
    def plan(self) -> Plan | None:
        """The controller's own plan, or None. A controller with its own plan can be simulated without another."""
        return None

    @property
    def sensors(self) -> RobotSensors | Belief | None:
        """What the controller reads in place of the measured states: sensors of the MJCF, or those of a belief."""
        return None

    def _check_reads_states(self) -> None:
        """Raise InputError for a controller of sensors, where only states are measured."""
        if self.sensors is not None:
            got = f"a {type(self).__name__} that reads sensors"
            raise InputError(f"controller: got {got}, want one of the measured states")


def check_plan(who: str, problem: Problem, solution: Solution) -> None:
    """Raise InputError unless the solution has a finite plan of the problem's system and control period."""
    check_kind(f"{who}: problem", problem, Problem, "a Problem, such as scenario.problem")
    check_kind(f"{who}: solution", solution, Solution, "a Solution of it")
    plan, want = solution.trajectory, spaces_of(problem.dynamics)
    check_same_system(f"{who}: solution", "a plan", spaces_of(solution.policy), want, "the problem")
    if plan.dt != problem.dt:
        raise InputError(f"{who}: solution: got a control period of {plan.dt:g} s, want the problem's {problem.dt:g} s")
    if not plan.finite:
        raise InputError(f"{who}: solution: got a plan that is not finite ({solution.status.name}), want one that is")


# The argument `controller` of `simulate` and of everything else that runs trials.
ControllerLike = Controller | AffinePolicy | OutputFeedbackPolicy | ControlFunction
WANTED = "a policy, a Controller or a function of state (n,) and time in s that returns controls (m,)"


def as_controller(controller: ControllerLike | None, plan: Plan | None, dynamics: Dynamics) -> tuple[Controller, Plan]:
    """The controller of a run on a robot with these dynamics, by default the plan's policy, and the plan of the run."""
    wanted = "a Plan, such as smooth(problem), which may be followed by another policy: controller=policy"
    check_kind("plan", plan, (Plan, type(None)), wanted)
    # What is planned in belief space has more states than the robot: its controller has the plan of the mean.
    of_belief = isinstance(controller, Controller) and isinstance(controller.sensors, Belief)
    if isinstance(controller, Controller) and (plan is None or of_belief):
        plan = check_kind(f"{type(controller).__name__}.plan", controller.plan, (Plan, type(None)), "a Plan or None")
    if plan is None:
        raise InputError("plan: got none, want one, such as smooth(problem), or a controller with a plan of its own")
    match controller:
        case None:
            return Feedback(plan.policy), plan
        case Controller():
            return controller, plan
        case AffinePolicy():
            return Feedback(controller), plan
        case OutputFeedbackPolicy():
            return OutputFeedback(controller), plan
        case _:
            check_function("controller", controller, WANTED, arguments=2)
            return FunctionController(controller, dynamics, plan.trajectory.dt), plan


@dataclass(frozen=True, eq=False)
class _OfPolicy(Controller):
    """Base of controllers that are a policy."""

    policy: AffinePolicy | OutputFeedbackPolicy

    @property
    def digest(self) -> str:
        return self.policy.digest

    @property
    def coordinates(self) -> Spaces:
        return spaces_of(self.policy)


@dataclass(frozen=True, eq=False)
class Feedback(_OfPolicy, ControllerRun):
    """A policy of the measured state. It remembers nothing, and is its own run."""

    policy: AffinePolicy

    def start(self, trials: int) -> ControllerRun:
        return self

    @cached_property
    def _evaluate(self) -> Callable[..., Array]:
        return evaluator(self.policy)

    def control(self, step: int, measured: Array) -> Array:
        return self._evaluate(self.policy, min(step, self.policy.steps - 1), measured)


@dataclass(frozen=True, eq=False)
class OutputFeedback(_OfPolicy):
    """An `OutputFeedbackPolicy` that measures states."""

    policy: OutputFeedbackPolicy
    sees_losses = True

    def __post_init__(self) -> None:
        states, names = self.policy.state_coordinates.names, self.policy.measured_coordinates.names
        if not set(names) <= set(states):
            wanted = f"one of states, some of {', '.join(states)}, or the OffsetFree that it was made from"
            raise InputError(f"controller: got an OutputFeedbackPolicy that measures {', '.join(names)}, want {wanted}")

    @property
    def measures(self) -> list[int]:
        """The indices of the measured states."""
        return [self.policy.state_coordinates.names.index(name) for name in self.policy.measured_coordinates.names]

    def start(self, trials: int) -> ControllerRun:
        return _OutputFeedbackRun(self, trials)


class _OutputFeedbackRun(ControllerRun):
    def __init__(self, controller: OutputFeedback, trials: int) -> None:
        self._policy, self._measures = controller.policy, controller.measures
        self._z = np.tile(controller.policy.start(), (trials, 1))
        self._diverged: dict[int, str] = {}

    def estimator_diverged(self) -> Mapping[int, str]:
        return self._diverged

    def control(self, step: int, measured: Array) -> Array:
        policy, commands = self._policy, np.empty((len(measured), len(self._policy.control_coordinates)))
        for k, state in enumerate(measured):
            y = None if np.isnan(state).all() else state[self._measures]
            with np.errstate(over="ignore", invalid="ignore"):
                commands[k], z = policy.step(self._z[k], y, step * policy.dt)
            if np.isfinite(z).all():
                self._z[k] = z
            else:  # `step` would refuse it, and end the other trials, too
                self._diverged.setdefault(k, "the state of the filter is not finite")
        return commands


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


class FunctionController(Controller, ControllerRun):
    """A function of the measured state (n,) and the time in s, held within the robot's limits. It is its own run.

    The function may have an attribute `sees_losses`.
    """

    def __init__(self, function: ControlFunction, dynamics: Dynamics, dt: float) -> None:
        self.function, self.dt, self.sees_losses = function, dt, bool(getattr(function, "sees_losses", False))
        self._coordinates = spaces_of(dynamics)

    def start(self, trials: int) -> ControllerRun:
        return self

    def control(self, step: int, measured: Array) -> Array:
        t, controls = step * self.dt, self._coordinates[1]
        commands = [shaped("commands", self.function(state.copy(), t), (len(controls),)) for state in measured]
        return controls.clip(np.array(commands))

    @property
    def digest(self) -> str:
        """Hash of what the function does, as far as that can be told: see `fingerprint.identity`."""
        return sha256(f"{identity(self.function)} {self.dt!r}")[:16]

    @property
    def coordinates(self) -> Spaces:
        return self._coordinates
