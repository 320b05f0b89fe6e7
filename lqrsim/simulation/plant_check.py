"""A comparison of a robot's dynamics with its MJCF in MuJoCo, or with another simulator."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from scipy import special

from lqrsim.annotations import Bounds, Count, Line, NonNegative, Positive, Seed, Want, checked
from lqrsim.errors import Array, InputError, check_array, check_count
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import Limits, check_same_system, spaces_of
from lqrsim.results.solution import Plan
from lqrsim.robots.base import Robot
from lqrsim.scenes.mujoco_log import unlogged
from lqrsim.scenes.scene import Scene
from lqrsim.simulation.physics import UNSTABLE
from lqrsim.simulation.plant import Plant
from lqrsim.simulation.simulator import Simulator, states_of

MOST_STEPS = 1_000_000  # physics steps in a check; they run one by one
PRINTED = 8  # pairs of geoms in contact
SPREAD = 0.3  # of samples, relative to what a state or control changes by, or in its unit if that is unknown
SLIGHT = 0.1  # what a state or control that does not change counts as changing, relative to others of its unit
POINTS = 20  # of the line from a start to a goal


@checked
@dataclass(frozen=True, eq=False)
class PlantCheck:
    """The differences between a robot's dynamics and MuJoCo, or another simulator, over one control period.

    Attributes:
      errors: (n,) the largest difference of each state over the samples, in its unit.
      changes: (n,) the largest change of each state that the dynamics predict.
      state, control, simulated, predicted: of the sample with the largest error of the worst state.
      contacts: pairs of geoms that touched, each with its number of samples, the most frequent first. The dynamics may
        not know of these contacts.
    """

    names: Annotated[tuple[Line, ...], "n"]
    units: Annotated[tuple[Line, ...], "n"]
    errors: Annotated[Array, "n"]
    changes: Annotated[Array, "n"]
    period: Positive
    state: Annotated[Array, "n"]
    control: Annotated[Array, "m"]
    simulated: Annotated[Array, "n"]
    predicted: Annotated[Array, "n"]
    tolerance: Positive
    samples: Count
    contacts: tuple[tuple[str, str, int], ...] = ()
    simulator: Line = "MuJoCo"

    def __post_init__(self) -> None:
        if not self.names:
            raise InputError("PlantCheck: names: got none, want at least one state")
        for *_, count in self.contacts:
            check_count("PlantCheck: contacts: count", count, at_most=self.samples)

    @property
    def relative(self) -> Array:
        """(n,) errors relative to the changes; one counts as at least a thousandth of the largest one in its unit."""
        units, changes = np.array(self.units), np.nan_to_num(self.changes)
        alike = (units[:, None] == units) & (units != "") | np.eye(len(units), dtype=bool)
        rounding = 1e-9 * np.nan_to_num(np.abs([self.state, self.simulated, self.predicted])).max(axis=0)
        least = np.maximum(1e-3 * (alike * changes).max(axis=1), rounding + 1e-15)
        return self.errors / np.maximum(self.changes, least)

    @property
    def worst(self) -> str:
        """The name of the state with the largest error relative to its change."""
        return self.names[int(np.argmax(self.relative))]

    @property
    def good(self) -> bool:
        """Whether every state is within the tolerance."""
        return bool((self.relative <= self.tolerance).all())

    def __str__(self) -> str:
        i = self.names.index(self.worst)
        width = max(len(name) for name in self.names)
        lines = [f"{'state':<{width}} {'error':>10} {'of change':>10}  over one period of {self.period:.4g} s"]
        lines += [
            f"{name:<{width}} {error:>10.2e} {relative:>10.2e}  {unit}"
            for name, unit, error, relative in zip(self.names, self.units, self.errors, self.relative, strict=True)
        ]
        lines.append(
            f"{'agrees' if self.good else 'DISAGREES'} (tolerance {self.tolerance:g} of the change); worst state:"
            f" {self.worst}, {self.simulator} {self.simulated[i]:.6g}, dynamics {self.predicted[i]:.6g},"
            f" from x = {np.array2string(self.state, precision=3)}, u = {np.array2string(self.control, precision=3)}"
        )
        lines += [
            f"touching in {count} of {self.samples} samples: {a} and {b}" for a, b, count in self.contacts[:PRINTED]
        ]
        if len(self.contacts) > PRINTED:
            lines.append(f"and {len(self.contacts) - PRINTED} more pairs of geoms")
        return "\n".join(lines)


@checked
def check_plant(
    robot: Robot,
    scene: Scene,
    *,
    simulator: Simulator | None = None,
    problem: Annotated[Problem, Want("a Problem of the robot, such as scenario.problem, or None")] | None = None,
    plan: Annotated[Plan, Want("a Plan of the robot, such as a Solution, or None")] | None = None,
    period: float | None = None,
    around: npt.ArrayLike | None = None,
    spread: NonNegative | None = None,
    controls: Limits | None = None,
    settle: NonNegative | None = None,
    samples: Annotated[int, Bounds(at_least=1, at_most=100_000)] = 50,
    tolerance: Positive = 0.02,
    seed: Seed = 0,
) -> PlantCheck:
    """Compare a robot's dynamics with its MJCF over one control period, from random states.

    A wrong mass, sign or unit shows in the states on which it acts. `Plant.obstacles` are removed, floors included.
    Geoms that are no obstacles in runs stay: the floor that the robot stands on, or planes parallel to the robot's
    plane. Contacts with these, and between moving parts, are in the result, by the names of the geoms.

    Args:
      simulator: a simulator to compare the dynamics with, in place of MuJoCo; it does not report contacts.
      problem: a problem of the robot. The random states are about the line from its start to its goal and keep its
        StateBounds, and the controls keep its limits: elsewhere the dynamics need not hold.
      plan: a plan of the robot, such as a Solution. The random states and controls are about those of the plan.
      period: control period in seconds, a multiple of the physics step; by default the multiple nearest to 0.02 s.
      around: (n,) mean of the random states; by default as the plan or the problem says, or zero.
      spread: their standard deviation, in each state's unit; by default 0.3 of what the state changes by along the plan
        or the line, or else 0.3. Rates of what moves along a line change as much as with constant acceleration.
      controls: (lowest, highest) random control, each a number or (m,), or a dictionary of name or unit of a control:
        (lowest, highest); by default, and for controls that are not named, the limits of the problem, or the dynamics'.
        Within them controls are equally probable, or normal about those of a plan.
      settle: seconds with constant control before the comparison, for velocities that only MuJoCo has, such as wheel
        speeds; by default 0.5 if MuJoCo has more velocities than half the number of states, else 0.
      tolerance: largest allowed error, relative to the largest change of the state.
    """
    plant = Plant(robot, scene, simulator)
    period = max(1, round(0.02 / plant.timestep)) * plant.timestep if period is None else period
    substeps = plant.substeps(period)
    n = len(robot.dynamics.state_coordinates)
    draw = _sampler(robot, problem, plan, around, spread, controls)
    plant.model = plant.without_contacts
    rng = np.random.default_rng(seed)
    if settle is None:
        settle = 0.5 if simulator is None and 2 * len(plant.qvel) > n else 0.0
    settling = settle / plant.timestep
    if not (steps := samples * (settling + substeps)) <= MOST_STEPS:
        most = f"at most {MOST_STEPS}: fewer samples, or a shorter period or time to settle"
        raise InputError(f"samples: got {samples}, which take {steps:.3g} physics steps, want {most}")
    compared, touching, data = [], Counter[tuple[str, str]](), mujoco.MjData(plant.model)
    with unlogged():
        for _ in range(samples):
            state, control = draw(rng)
            if simulator is None:
                sample, touched = _sample(plant, data, state, control, round(settling), period)
                touching.update(sorted(touched))
            else:
                sample = _in_simulator(simulator, plant, state, control, round(settling), period)
            compared.append(sample)
    return _worst_of(compared, plant, period, tolerance, touching)


class _Sample(NamedTuple):
    """One control period: the state (n,) before it, the control (m,), and the states (n,) after it."""

    state: Array
    control: Array
    simulated: Array
    predicted: Array


def _sampler(
    robot: Robot, problem: Problem | None, plan: Plan | None, around: npt.ArrayLike | None, spread: float | None,
    controls: Limits | None,
) -> Callable[[np.random.Generator], tuple[Array, Array]]:  # fmt: skip
    """A function that draws a state and a control, by the arguments of `check_plant`."""
    spaces = states, inputs = spaces_of(robot.dynamics)
    # Each of the points is the mean of some states, and each of the middles of some controls. Without middles, controls
    # are equally probable in their range.
    n, points, middles, seconds = len(states), np.zeros((1, len(states))), None, 0.0
    if problem is not None:
        check_same_system("problem", "a problem", spaces_of(problem.dynamics), spaces, "the robot")
        start, goal, seconds = problem.start, problem.weighed_goal, problem.steps * problem.dt
        start = np.zeros(n) if start is None else start
        points = np.linspace(start, start if goal is None else np.where(np.isnan(goal), start, goal), POINTS)
    if plan is not None:
        check_same_system("plan", "a plan", spaces_of(plan.policy), spaces, "the robot")
        points, middles = plan.trajectory.states[:-1], plan.trajectory.controls
        check_array("plan: trajectory", np.hstack([points, middles]), (None, n + len(inputs)))
    scale = SPREAD * _changes(points, states.units, seconds)
    if around is not None:
        points, middles = check_array("around", around, (n,))[None], None
    if spread is not None:
        scale = np.full(n, spread)
    within = _state_range(robot, problem, points[0])
    ranges = _control_range(robot, controls, problem, bounded=middles is None)
    points = np.clip(points, *within)
    control_scale = np.zeros(len(inputs)) if middles is None else SPREAD * _changes(middles, inputs.units, 0.0)
    middles = None if middles is None else np.clip(middles, *ranges)

    def draw(rng: np.random.Generator) -> tuple[Array, Array]:
        k = int(rng.integers(len(points))) if len(points) > 1 else 0
        state = _drawn(rng, points[k], scale, *within)
        control = rng.uniform(*ranges) if middles is None else _drawn(rng, middles[k], control_scale, *ranges)
        return state, control

    return draw


def _changes(points: Array, units: Sequence[str], seconds: float) -> Array:
    """What each column of points (k, n) changes by, in its unit: at least a little, and 1 if nothing is known of it."""
    extents = np.ptp(points, axis=0).tolist()
    most = {unit: max(change for change, other in zip(extents, units, strict=True) if other == unit) for unit in units}
    changes = []
    for change, unit in zip(extents, units, strict=True):
        known = max(change, SLIGHT * most[unit])
        if not known and seconds and unit.endswith("/s"):  # the peak of a motion that is accelerated, then braked
            known = 2 * most.get(unit.removesuffix("/s"), 0.0) / seconds
        changes.append(known or 1.0)
    return np.array(changes)


def _state_range(robot: Robot, problem: Problem | None, middle: Array) -> Array:
    """The lowest and the highest state, (2, n), infinite where unbounded, and the first mean, which lies between."""
    names = robot.dynamics.state_coordinates.names
    within = np.tile([[-np.inf], [np.inf]], len(names))
    for constraint in () if problem is None else problem.constraints:
        for i, (least, most) in constraint.state_bounds(robot.dynamics).items():  # the widest of all knots
            within[:, i] = max(within[0, i], np.min(least)), min(within[1, i], np.max(most))
    for name, least, mean, most in zip(names, within[0], middle, within[1], strict=True):
        if not least <= mean <= most:
            raise InputError(f"around: got {mean:g} for {name}, want one within its bounds, {least:g} to {most:g}")
    return within


def _drawn(rng: np.random.Generator, middle: Array, spread: Array, low: Array, high: Array) -> Array:
    """A normal vector (n,) about `middle`, truncated to the bounds, coordinate by coordinate."""
    drawn = middle + spread * rng.normal(size=len(middle))
    for i in np.flatnonzero((drawn < low) | (drawn > high)):
        ends = special.ndtr((np.array([low[i], high[i]]) - middle[i]) / spread[i])
        drawn[i] = np.clip(middle[i] + spread[i] * special.ndtri(rng.uniform(*ends)), low[i], high[i])  # for rounding
    return drawn


def _control_range(robot: Robot, controls: Limits | None, problem: Problem | None, *, bounded: bool) -> Array:
    """The lowest and the highest control, (2, m). Raises InputError unless they are in order, and, if so, bounded."""
    space = robot.dynamics.control_coordinates if problem is None else problem.applied_coordinates
    low, high = space._ranges("controls", {} if controls is None else controls)
    if not (low <= high).all():
        raise InputError(f"controls: got {low.tolist()} to {high.tolist()}, want the lowest first")
    if bounded and not np.isfinite([low, high]).all():
        raise InputError(f"controls: got {robot.name}'s limits, which are infinite, want controls=(lowest, highest)")
    return np.array([low, high])


def _sample(
    plant: Plant, data: mujoco.MjData, state: Array, control: Array, settling: int, period: float
) -> tuple[_Sample, set[tuple[str, str]]]:
    """Run one control period after `settling` physics steps. Returns it with the pairs of geoms that touched."""
    robot = plant.robot
    mujoco.mj_resetData(plant.model, data)
    data.qpos[plant.qpos], data.qvel[plant.qvel] = robot.configuration(state)
    if robot.activations:
        data.act[:] = state[len(state) - robot.activations :]
    data.ctrl[plant.ctrl] = robot.actuation(control)
    for _ in range(settling):
        mujoco.mj_step(plant.model, data)
    before = plant.state(data.qpos[plant.qpos], data.qvel[plant.qvel], data.act, near=state)
    touched, model = set[tuple[str, str]](), plant.model
    of_robot = np.isin(model.body_rootid[model.geom_bodyid], model.body_rootid[plant.bodies])  # in its kinematic trees
    for _ in range(plant.substeps(period)):
        mujoco.mj_step(plant.model, data)
        pairs = {tuple(sorted(contact.geom.tolist())) for contact in data.contact if contact.efc_address >= 0}
        touched |= {(_name(model, a), _name(model, b)) for a, b in pairs if of_robot[a] or of_robot[b]}
    if any(data.warning[kind].number for kind in UNSTABLE):
        at = f"x = {np.array2string(state, precision=3)}, u = {np.array2string(control, precision=3)}"
        wanted = "a smaller timestep, other states (around, spread) or other controls"
        raise InputError(f"scene {plant.scene.name}: got a simulation that becomes unstable from {at}, want {wanted}")
    predicted = robot.dynamics.step(before, control, period)
    simulated = plant.state(data.qpos[plant.qpos], data.qvel[plant.qvel], data.act, near=predicted)
    return _Sample(before, control, simulated, predicted), touched


def _in_simulator(
    simulator: Simulator, plant: Plant, state: Array, control: Array, settling: int, period: float
) -> _Sample:
    dynamics, states = plant.robot.dynamics, [state]
    running = simulator.start(state[None], {}, plant.timestep)
    for steps in (settling, plant.substeps(period)):
        if steps:
            simulator.step(running, control[None], np.zeros((1, 6)), np.zeros((1, 3)), steps)
        (after,) = states_of(simulator, running, (1, len(state)))
        if not np.isfinite(after).all():
            at = f"x = {np.array2string(state, precision=3)}, u = {np.array2string(control, precision=3)}"
            raise InputError(f"{simulator.name}: got a state that is not finite, from {at}, want finite states")
        states.append(after)
    before = dynamics.state_coordinates.nearest(states[1], state)
    predicted = dynamics.step(before, control, period)
    return _Sample(before, control, dynamics.state_coordinates.nearest(states[2], predicted), predicted)


def _worst_of(
    samples: list[_Sample], plant: Plant, period: float, tolerance: float, touching: Counter[tuple[str, str]]
) -> PlantCheck:
    """The result over all samples, with the sample in which the worst state has its largest error."""
    errors = np.array([np.abs(sample.simulated - sample.predicted) for sample in samples])
    changes = np.array([np.abs(sample.predicted - sample.state) for sample in samples])
    space = plant.robot.dynamics.state_coordinates
    check = PlantCheck(
        names=space.names, units=space.units, errors=errors.max(axis=0), changes=changes.max(axis=0), period=period,
        **samples[0]._asdict(), tolerance=tolerance, samples=len(samples),
        contacts=tuple((*pair, count) for pair, count in touching.most_common()),
        simulator="MuJoCo" if plant.simulator is None else plant.simulator.name,
    )  # fmt: skip
    worst = samples[int(errors[:, check.names.index(check.worst)].argmax())]
    return replace(check, **worst._asdict())


def _name(model: mujoco.MjModel, geom: int) -> str:
    """The geom's name; without one, its number and the name of its body."""
    body = model.body(int(model.geom_bodyid[geom])).name
    return model.geom(geom).name or f"geom {geom}" + (f" of {body}" if body else "")
