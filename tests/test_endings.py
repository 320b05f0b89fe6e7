"""How a trial ends: one answer everywhere, judged by the goal, for robots with a position and without one."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mechanisms
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import Jointed
from sampling import examples
from sympy import cos, sin
from tracking import hover, track

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.commands.solving import tube_under
from lqrsim.control.controllers import Controller, ControllerRun, Feedback
from lqrsim.disturbances import (
    ControlNoise,
    DisplacedObstacles,
    ForceNoise,
    InitialStateError,
    MassMismatch,
    MeasurementNoise,
    Push,
    Unknown,
)
from lqrsim.errors import Array, InputError
from lqrsim.reports import report
from lqrsim.results.goal import OF_RANGE, OF_WAY, OUTCOMES, Target
from lqrsim.robots.base import Robot
from lqrsim.scenarios.references import disturbance_set
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.simulation.closed_loop import simulate_from
from lqrsim.simulation.plant import Plant
from lqrsim.stress.analysis import Outcomes, outcomes
from lqrsim.stress.campaign import run_campaign
from lqrsim.stress.results import Results, differences, replay
from lqrsim.stress.study import Campaign, TrialRunner

BENCH = """<geom name="floor" type="plane" size="2 2 0.1" pos="0 0 -0.5"/>
  <geom name="post" type="cylinder" size="0.05 0.5" pos="0.5 0.5 0"/>"""
ARM = mechanisms.arm(
    1.0, names=("shoulder",), joint='axis="0 0 1" damping="1"', geom='size="0.03" mass="1"', limits=(5,),
    option='timestep="0.01"', things=BENCH,
)  # fmt: skip
UPPER = '<body name="upper" pos="0 0 0">'


def cart_pole(axes: str = "x", *, floor: float = -0.2, things: str = "") -> str:
    return mechanisms.sled(
        axes, name="cart", geom=f'type="box" size="0.1 0.1 0.05" mass="1" {mechanisms.NO_CONTACT}',
        carried="""<body name="pole"><joint name="hinge" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0.1 0 0 0.6" size="0.02" mass="0.1"/></body>""",
        actuators=mechanisms.motors("x", (20,)), option='timestep="0.01" integrator="RK4"',
        things=f'<geom name="floor" type="plane" size="9 9 0.1" pos="0 0 {floor}"/>{things}',
    )  # fmt: skip


@dataclass(frozen=True)
class Arm(Jointed):
    name = "arm"
    body = "upper"
    joints = actuators = ("shoulder",)

    @cached_property
    def dynamics(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return ls.Dynamics(
            lambda x, u, p: [x[1], (u[0] - x[1]) / 0.34],
            states={"angle": "rad", "rate": "rad/s"}, controls={"torque": "N m"}, angles=("angle",),
            control_limits=(-5, 5),
        )  # fmt: skip


@dataclass(frozen=True)
class CartPole(Jointed):
    name = "cart_pole"
    body = "cart"
    joints = ("x", "hinge")
    actuators = ("x",)

    @cached_property
    def dynamics(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return ls.Dynamics(  # about the upright pole, which is all that these tests plan for
            lambda x, u, p: [x[2], x[3], u[0], 20 * x[1] - 2 * u[0]],
            states={"x": "m", "angle": "rad", "v": "m/s", "rate": "rad/s"}, controls={"push": "N"}, angles=("angle",),
            control_limits=(-20, 20),
        )  # fmt: skip


@pytest.fixture(scope="module")
def arm() -> Plant:
    return Plant(Arm(), scene_from_xml(ARM, "bench"))


@pytest.fixture(scope="module")
def swing(arm: Plant) -> ls.Solution:
    """From 0 to a little over half a turn, past the post at an eighth of a turn."""
    solution = track(arm.robot, (0.0, 0.0), np.full((40, 1), 2.0), 0.05, feedback=False)
    return replace(solution, goal=np.array([solution.trajectory.states[-1, 0], np.nan]))


@pytest.fixture(scope="module")
def cage(quadrotor: ls.Scenario) -> Plant:
    return quadrotor.plant()


# Robots without a position.


@pytest.mark.parametrize("contacts", [True, False])
def test_an_arm_that_is_stuck_on_a_post_has_collided_with_it(arm: Plant, swing: ls.Solution, contacts: bool) -> None:
    rollout = ls.simulate(arm, swing, contacts=contacts)
    assert rollout.outcome == ("collided",)
    assert rollout.obstacles == ("post",)
    # The post's near side is at asin((0.05 + 0.03) / |(0.5, 0.5)|) before an eighth of a turn; a step is 0.03 rad.
    touch = np.pi / 4 - np.arcsin(0.08 / np.sqrt(0.5))
    at = np.interp(rollout.collided_at[0], rollout.times, rollout.states[0, :, 0])
    assert touch - 0.03 < at < touch + 0.06
    assert (rollout.tracking_unit, rollout.target.unit) == (OF_RANGE, OF_WAY)
    line = rollout.summary().splitlines()[-1]
    assert "collided with post" in line
    assert line.split(";")[1].endswith(OF_RANGE)  # and not in metres
    if contacts:
        assert rollout.states[0, -1, 0] < np.pi / 4  # stopped
        assert rollout.contacts[0] > 20
    else:
        assert rollout.states[0, -1, 0] > np.pi / 2
        assert rollout.contacts[0] == 0
    assert not arm.enclosed


@pytest.mark.parametrize("others", range(3))
def test_where_a_controller_has_failed_nothing_collides(arm: Plant, others: int) -> None:
    """It fails at once for an arm that begins in the post, with others that go on or alone; then that is all of it."""
    plan = track(arm.robot, (0.0, 0.0), np.zeros((5, 1)), 0.05, feedback=False)
    starts = np.zeros((1 + others, 2))
    starts[0, 0] = np.pi / 4
    for fails in (True, False):
        rollout = simulate_from(
            arm, plan, starts, contacts=False, controller=lambda x, t, fails=fails: [np.nan if fails and x[0] else 0.0]
        )
        assert rollout.outcome[0] == ("error" if fails else "collided")
        assert rollout.collided_at[0] == (np.inf if fails else 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_lines_of_trials_name_the_worst_state_of_a_robot_without_a_position(
    arm: Plant, swing: ls.Solution, seed: int
) -> None:
    """Relative to the ranges along the plan, here by NumPy; the goal counts for the angle alone, a tenth of its way."""
    free = scene_from_xml(ARM.replace('pos="0.5 0.5 0"', 'pos="5 5 0"'), "bench")
    noise = [ControlNoise(0.5), InitialStateError((0.1, 0.3))]
    run = ls.simulate(Plant(Arm(), free), swing, disturbances=noise, seed=seed, trials=3)
    plan = swing.trajectory.states
    off = run.states - plan
    off[..., 0] = (off[..., 0] + np.pi) % (2 * np.pi) - np.pi
    relative = np.abs(off) / np.maximum(np.ptp(plan, axis=0), 1.0)
    way = abs((plan[0, 0] - plan[-1, 0] + np.pi) % (2 * np.pi) - np.pi)
    for k, line in enumerate(run.summary().splitlines()[-3:]):
        knot, state = np.unravel_index(int(relative[k].argmax()), relative[k].shape)
        name, unit = (("angle", "rad"), ("rate", "rad/s"))[state]
        said = f"max {relative[k].max():.3g} ({name} {off[k, knot, state]:+.3g} {unit} at {0.05 * knot:.2f} s), final"
        assert said in line
        assert f" from the goal (angle {off[k, -1, 0]:+.3g} rad, allowed {way / 10:.3g} rad); " in line


@st.composite
def ways(draw: st.DrawFn) -> tuple[Array, Array, tuple[int, ...], tuple[str, ...]]:
    """Starts and goals of states, which of them the goal weighs, and their units. All of a unit go about as far."""
    size = draw(st.integers(1, 5))
    scale = 10.0 ** np.array(draw(st.lists(st.integers(-3, 3), min_size=size, max_size=size)))
    start = scale * draw(st.lists(st.sampled_from([-2.0, 0.0, 1.0, 40.0]), min_size=size, max_size=size))
    way = scale * draw(st.lists(st.sampled_from([-1.0, 0.5, 2.0]), min_size=size, max_size=size))
    weighed = draw(st.sets(st.integers(0, size - 1), min_size=1).map(sorted).map(tuple))
    units = tuple(draw(st.sampled_from(["", f"unit of {one:g}"])) for one in scale)
    return start, start + way, weighed, units


@settings(max_examples=examples(60))
@given(ways(), st.data())
def test_a_goal_is_reached_within_a_tenth_of_the_way_of_each_state(one: Any, data: st.DataObject) -> None:
    """By hand, for states of 1e-3 to 1e3: those that the goal weighs, each against its own way from the start."""
    start, end, weighed, units = one
    size, goal = len(start), np.full(len(start), np.nan)
    goal[list(weighed)] = end[list(weighed)]
    left = np.array(data.draw(st.lists(st.sampled_from([0, 0.05, -0.09, 0.11, 0.4, 1]), min_size=size, max_size=size)))
    space = ls.types.Coordinates(names=tuple(f"s{i}" for i in range(size)), units=units)
    plan = start + np.linspace(0.0, 1.0, 7)[:, None] * (1 - left) * (end - start)
    target = Target(space, goal, plan)
    radius = target.radius(None, None, None)
    misses = [i for i in weighed if abs(left[i]) > 0.1]
    assert target.misses(radius) == bool(misses)
    lines = target.of_plan(radius)
    assert any("MISSES" in line for line in lines) == bool(misses)
    if not left[list(weighed)].any():
        assert lines == [f"the plan ends 0 % {OF_WAY} from the goal, which is reached within 10 %"]
        return
    worst = max(weighed, key=lambda i: abs(left[i]))
    off, allowed = plan[-1, worst] - end[worst], abs(end - start)[worst] / 10
    if sum(abs(left[i]) == abs(left[worst]) for i in weighed) == 1:
        unit = f" {units[worst]}".rstrip()
        assert lines[0].endswith(f": s{worst} {off:+.3g}{unit}, allowed {allowed:.3g}{unit}")


@settings(max_examples=examples(60))
@given(st.data())
def test_the_unit_of_a_state_does_not_change_whether_its_goal_is_reached(data: st.DataObject) -> None:
    """States in a unit, some of them with no way at all, and the same in another, such as millimetres for metres."""
    size = data.draw(st.integers(1, 6))
    units = data.draw(st.lists(st.sampled_from(["m", "m/s", "", "kg"]), min_size=size, max_size=size))
    numbers = st.sampled_from([0.0, 0.0, 0.02, 0.3, -1.0, 2.5])
    vectors = st.lists(numbers, min_size=size, max_size=size).map(np.array)
    start, end, middle, off = (data.draw(vectors) for _ in range(4))
    weighed = list(data.draw(st.sets(st.integers(0, size - 1), min_size=1)))
    goal = np.full(size, np.nan)
    goal[weighed] = end[weighed]
    if (start == end)[weighed].all():  # nothing but the unit to be relative to
        goal[weighed[0]] = start[weighed[0]] + 1.0
    names = tuple(f"s{i}" for i in range(size))
    factor = {unit: 10.0 ** data.draw(st.integers(-3, 3)) for unit in units if unit}
    factor["m/s"] = factor.get("m", factor.get("m/s", 1.0))
    by = np.array([factor[unit] if unit else 10.0 ** data.draw(st.integers(-3, 3)) for unit in units])
    end = np.where(np.isnan(goal), end, goal)
    plan, run = np.stack([start, middle, end + 0.1 * off]), end + 0.03 * off
    ends = [data.draw(st.sampled_from([np.inf, 0.04, 3.0])) for _ in range(size)]  # limits of a state, where it has any
    found = []
    for scale in (1.0, by):
        low, high = (tuple((scale * np.array(side)).tolist()) for side in (np.negative(ends), ends))
        space = ls.types.Coordinates(names=names, units=tuple(units), low=low, high=high)
        target = Target(space, scale * goal, scale * plan)
        radius = target.radius(None, None, None)
        assert not target.distance(scale * start) <= radius  # the start has not reached it
        found.append([radius, target.distance(scale * plan[-1]), target.distance(scale * run)])
    np.testing.assert_allclose(*found, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("left", [0.0, 1e-5])
def test_a_held_finger_misses_its_goal_by_a_tenth_of_its_own_range(left: float) -> None:
    """An arm turns, and its finger of 40 mm stays where it is but for rounding: also to 1e-5 m from its goal."""
    space = ls.types.Coordinates(
        names=("hinge", "finger", "hinge_velocity", "finger_velocity"), units=("rad", "m", "rad/s", "m/s"),
        low=(-2.0, 0.0, -np.inf, -np.inf), high=(2.0, 0.04, np.inf, np.inf),
    )  # fmt: skip
    along = np.linspace(0.0, 1.0, 9)
    plan = np.stack([along, 0.038 + 1e-5 * np.sin(9 * along), along * (1 - along), 1e-3 * np.sin(7 * along)], axis=1)
    target = Target(space, np.array([1.0, 0.038 + left, 0.0, 0.0]), plan)
    radius = target.radius(None, None, None)
    for name, allowed in (("finger", 0.004), ("finger_velocity", 0.004), ("hinge", 0.1)):
        end = target.state.copy()
        for part, reached in ((0.99, True), (1.01, False)):
            end[space.names.index(name)] = target.state[space.names.index(name)] + part * allowed
            assert bool(target.distance(end) <= radius) == reached


@pytest.mark.parametrize("seed", range(3))
def test_states_that_start_at_their_goal_may_be_off_by_what_the_others_may(seed: int) -> None:
    """A box is to be pushed along: across, and in turning, by hand."""
    rng = np.random.default_rng(seed)
    way, fast = 10 ** rng.uniform(-3, 3), 10 ** rng.uniform(-3, 3)
    names, units = ("x", "y", "turn", "vx", "vy"), ("m", "m", "rad", "m/s", "m/s")
    space, goal = ls.types.Coordinates(names=names, units=units), np.array([way, 0.0, 0.0, 0.0, 0.0])
    along = np.linspace(0.0, 1.0, 9)[:, None]
    plan = along * goal + along * (1 - along) * np.array([0.0, 1e-4 * way, 1e-4, 4 * fast, 1e-4 * fast])
    target = Target(space, goal, plan)
    radius = target.radius(None, None, None)
    fastest = np.ptp(plan[:, 3])
    for i, allowed in enumerate([way / 10, way / 10, 0.1, fastest / 10, fastest / 10]):
        for share, reaches in ((0.99, True), (1.01, False)):
            assert (target.distance(goal + share * allowed * np.eye(5)[i]) <= radius) == reaches


@pytest.mark.parametrize("weighed", range(3))
def test_entries_of_a_rotation_vector_that_do_not_count_are_not_named(weighed: int) -> None:
    """The nearest vector of the same rotation, a turn less about the axis, is farther off in the other two entries."""
    space = ls.types.Coordinates(names=("rx", "ry", "rz"), units=("rad",) * 3, rotation_vectors=(0,))
    end = np.roll([3.0, 2.0, 1.0], weighed)
    goal = np.where(np.arange(3) == weighed, -3.0, np.nan)
    target = Target(space, goal, np.stack([np.zeros(3), end]))
    less = end * (1 - 2 * np.pi / np.linalg.norm(end))
    name, off, _ = target.worst(end, None).split()
    assert name == space.names[weighed]
    assert float(off) == pytest.approx(less[weighed] + 3.0, rel=1e-2)


@dataclass(frozen=True)
class Handed(Arm):
    """The same with a ball, which goes over the middle of the post."""

    @cached_property
    def balls(self) -> ls.CollisionSpheres:  # pyright: ignore[reportIncompatibleVariableOverride]
        def hand(x, p):
            return [[np.sqrt(0.5) * cos(x[0]), np.sqrt(0.5) * sin(x[0]), 0]]

        return ls.CollisionSpheres(hand, (0.03,))


@pytest.mark.parametrize("kind", [Arm, Handed])
def test_what_an_exclude_keeps_apart_never_collides(swing: ls.Solution, kind: Callable[[], Robot]) -> None:
    """As in MuJoCo: its arm goes through the post, and no clearance is measured to it."""
    exclude = '<contact><exclude body1="upper" body2="world"/></contact>'
    scene = scene_from_xml(ARM.replace("<actuator>", f"{exclude}<actuator>"), "bench")
    plant = Plant(kind(), scene)
    data = mujoco.MjData(scene.model)
    data.qpos[0] = np.pi / 4
    mujoco.mj_forward(scene.model, data)
    assert data.ncon == 0
    assert plant.obstacles == plant.world.names == ()
    rollout = ls.simulate(plant, swing)
    assert rollout.outcome == ("reached",)
    assert rollout.states[0, -1, 0] > np.pi / 2
    assert rollout.clearance.min() == np.inf


@pytest.mark.parametrize("kind", [Arm, Handed])
def test_a_pedestal_does_not_collide_with_the_arm_that_it_carries(
    swing: ls.Solution, kind: Callable[[], Robot]
) -> None:
    """They overlap in every position. A fist that the pedestal does not carry can still hit it."""
    pedestal = '<geom name="pedestal" type="cylinder" size="0.1 0.25" pos="0 0 -0.24"/>'
    fist = '<geom type="sphere" pos="1 0 0" size="0.04" mass="1e-9"/>'
    xml = ARM.replace(UPPER, f"{pedestal}{UPPER}{fist}")
    plant = Plant(kind(), scene_from_xml(xml.replace('pos="0.5 0.5 0"', 'pos="5 5 0"'), "bench"))
    assert "pedestal" in plant.obstacles
    rollout = ls.simulate(plant, swing)
    assert rollout.outcome == ("reached",)
    assert rollout.contacts[0] == 0


def test_no_tube_is_predicted_of_where_a_robot_without_a_position_is(arm: Plant, swing: ls.Solution) -> None:
    problem = ls.Problem(
        dynamics=arm.robot.dynamics, dt=0.05, steps=40, initial=ls.FixedState((0.0, 0.0)),
        stage_cost=ls.ControlCost((1.0,)), final_cost=ls.QuadraticCost((1.0, 1.0), about=(1.0, 0.0)),
    )  # fmt: skip
    assert tube_under(problem, swing, arm, [ControlNoise(0.1)]) == (
        None,
        "no predicted tube: the robot has no position",
    )
    tube = ls.predict_tube(problem, swing, ls.disturbances.Uncertainty(control=0.1))
    run = ls.simulate(arm, swing)
    with pytest.raises(ls.InputError, match=r"state_coordinates\.position: got none"):
        tube.added_to(run)
    with pytest.raises(ls.InputError, match=r"tube: got shape .*, want None without a position"):
        replace(run, tube=np.zeros((41, 2, 2)))


def test_contacts_that_are_only_felt_change_no_bit_and_miss_none(arm: Plant, swing: ls.Solution) -> None:
    """Against MuJoCo's own loop over the model without the obstacle, and its collisions in the model with it."""
    rollout = ls.simulate(arm, swing, contacts=False)
    free, solid = arm.without_contacts, arm.model
    data, probe = mujoco.MjData(free), mujoco.MjData(solid)
    first = None
    for step in range(40):
        np.testing.assert_array_equal(rollout.states[0, step], [*data.qpos, *data.qvel])
        data.ctrl[:] = rollout.applied[0, step]
        for sub in range(5):
            probe.qpos[:] = data.qpos
            mujoco.mj_forward(solid, probe)
            if probe.ncon and first is None:
                first = 0.05 * step + 0.01 * sub
            mujoco.mj_step(free, data)
    assert rollout.collided_at[0] == pytest.approx(first, abs=1e-9)


def test_an_arm_that_gets_there_has_reached_it_and_one_that_does_not_has_not(arm: Plant, swing: ls.Solution) -> None:
    """Scaled error by hand: the angle's shortest way to the goal, a state without weight left out."""
    clear = Plant(Arm(), scene_from_xml(ARM.replace('pos="0.5 0.5 0"', 'pos="-3 0 0"'), "bench"))
    rollout = ls.simulate(clear, swing)
    angle, plan = rollout.states[0, -1, 0], rollout.plan.states[:, 0]
    way = 2 * np.pi - plan[-1]  # a little less than half a turn
    assert rollout.goal_distance[0] == pytest.approx(abs(angle - plan[-1]) / way, rel=1e-9)
    assert rollout.outcome == ("reached",)
    # Whole turns are taken out; so is what the plan is told of how near counts.
    turned = replace(swing, goal=np.array([plan[-1] + 2 * np.pi, np.nan]))
    assert ls.simulate(clear, turned).goal_distance[0] == pytest.approx(rollout.goal_distance[0], abs=1e-12)
    strict = ls.simulate(clear, swing, goal_tolerance=0.5 * rollout.goal_distance[0])
    assert strict.outcome == ("timed out",)
    assert outcomes(rollout, goal_tolerance=0.5 * rollout.goal_distance[0]).outcome.tolist() == ["timed out"]
    with pytest.raises(InputError, match=r"^goal_radius: got 0.1, want goal_tolerance.*angle, rate$"):
        ls.simulate(clear, swing, goal_radius=0.1)


def test_a_cart_pole_that_has_fallen_has_not_reached_its_goal() -> None:
    plant = Plant(CartPole(), scene_from_xml(cart_pole(floor=-0.7), "rail"))  # out of reach
    plan = track(plant.robot, np.zeros(4), np.zeros((25, 1)), 0.05)
    plan = replace(plan, goal=np.zeros(4))
    held = ls.simulate(plant, plan, disturbances=[InitialStateError((0, 0.02, 0, 0))])
    assert held.outcome == ("reached",)
    fallen = ls.simulate(plant, plan.open_loop(), disturbances=[InitialStateError((0, 0.02, 0, 0))])
    assert abs(fallen.states[0, -1, 1]) > 1
    assert fallen.outcome == ("timed out",)
    assert fallen.tracking_error.max() > 1
    assert "0 of 1 trials reached the goal" in fallen.tally()


@pytest.mark.parametrize("contacts", [True, False])
def test_the_floor_is_an_obstacle_of_what_cannot_stand_on_it(contacts: bool) -> None:
    plant = Plant(CartPole(), scene_from_xml(cart_pole(), "rail"))
    assert plant.obstacles == ("floor",)
    plan = track(plant.robot, np.zeros(4), np.zeros((60, 1)), 0.05)
    fallen = ls.simulate(plant, plan.open_loop(), disturbances=[InitialStateError((0, 0.02, 0, 0))], contacts=contacts)
    assert (fallen.outcome, fallen.obstacles) == (("collided",), ("floor",))
    # The pole's tip, 0.6 m from the hinge and 2 cm thick, is then on the floor, 0.2 m below the hinge.
    touch, at = np.arccos(-0.18 / 0.6), round(fallen.collided_at[0] / 0.05 - 0.5)
    assert (np.abs(fallen.states[0, : at + 1, 1]) < touch).all()
    if contacts:
        assert abs(fallen.states[0, -1, 1]) == pytest.approx(touch, abs=1e-3)  # it lies there
    else:
        assert abs(fallen.states[0, at + 1, 1]) > touch


def test_what_can_sink_to_the_floor_stands_on_it() -> None:
    @dataclass(frozen=True)
    class Lifted(CartPole):
        joints = ("x", "z", "hinge")

        def state(self, qpos, qvel, near=None):
            return super().state(qpos[..., [0, 2]], qvel[..., [0, 2]], near)

        def configuration(self, state):
            qpos, qvel = (np.insert(part, 1, 0.0, axis=-1) for part in super().configuration(state))
            return qpos, qvel

    assert Plant(Lifted(), scene_from_xml(cart_pole("xz"), "rail")).obstacles == ()
    ceiling = '<geom name="ceiling" type="plane" size="9 9 0.1" pos="0 0 2" euler="180 0 0"/>'
    assert Plant(Lifted(), scene_from_xml(cart_pole("xz", things=ceiling), "rail")).obstacles == ("ceiling",)


# Judged by the goal.


def short(by: float) -> ls.Solution:
    """A plan that ends so far from its goal."""
    plan = hover()
    goal = plan.trajectory.states[-1] + np.array([by, *np.zeros(11)])
    return replace(plan, goal=goal, goal_radius=0.3)


@pytest.mark.parametrize("seed", range(4))
def test_a_plan_that_comes_back_to_its_start_misses_by_a_tenth_of_how_far_it_went(seed: int) -> None:
    """Where no radius is known. A body that turns in place ends at its goal but for rounding: that is no miss."""
    rng, plan = np.random.default_rng(seed), hover()
    states = plan.trajectory.states
    bent = np.sin(np.linspace(0.0, np.pi, len(states)))[:, None] * rng.normal(size=3)
    for away, off, missed in ((0.0, 1e-9, False), (1.0, 0.09, False), (1.0, 0.11, True), (1e-9, 1e-3, True)):
        moved = states.copy()
        moved[:, :3] = states[0, :3] + away * bent
        farthest = np.linalg.norm(moved[:, :3] - states[0, :3], axis=1).max()
        moved[-1, :3] = states[0, :3] + (off * farthest if away == 1.0 else off) * np.eye(3)[0]
        back = replace(plan, goal=states[0], goal_radius=None, trajectory=replace(plan.trajectory, states=moved))
        assert ("MISSES" in str(back)) == missed


def test_a_plan_that_stops_short_of_its_goal_does_not_reach_it_and_says_so(cage: Plant) -> None:
    solution = short(1.9)
    rollout = ls.simulate(cage, solution, trials=2)
    assert rollout.outcome == ("timed out",) * 2
    np.testing.assert_allclose(rollout.goal_distance, 1.9, atol=1e-3)
    for text in (str(solution), rollout.summary()):
        assert "the plan ends 1.9 m from the goal, which is reached within 0.3 m\n" in text
        assert "the plan MISSES the goal: raise the weights of the final cost" in text
    assert rollout.tally() == "0 of 2 trials reached the goal"
    assert outcomes(rollout).goal == pytest.approx(rollout.goal_distance)
    near = ls.simulate(cage, short(0.2), goal_radius=0.3)
    assert near.outcome == ("reached",)
    assert "MISSES" not in near.summary()
    # Where no radius is known, a tenth of the way decides, of which a robot that hovers goes nothing.
    assert "MISSES the goal by more than 10% of the way" in str(replace(short(0.2), goal_radius=None))
    assert "MISSES" not in str(replace(short(0.0), goal_radius=None))
    assert ls.simulate(cage, short(0.2), goal_radius=0.1).outcome == ("timed out",)
    with pytest.raises(InputError, match=r"^goal_tolerance: got 0\.1, want goal_radius, in metres"):
        ls.simulate(cage, solution, goal_tolerance=0.1)


@pytest.mark.parametrize("spatial", [True, False])
def test_a_start_near_its_goal_has_not_reached_it(cage: Plant, spatial: bool) -> None:
    """Whatever the way: its start is far from reaching it, its last twentieth is not; without a way both reach it."""
    space = cage.robot.dynamics.state_coordinates
    space = space if spatial else replace(space, position=(), plane="")
    rng = np.random.default_rng(36)
    for way in (*10 ** rng.uniform(-3.5, 1.0, 40), 0.0, 1e-9):
        across, usual = rng.normal(size=3), 0.3 if spatial else 0.1
        across *= way / (np.linalg.norm(across) if spatial else np.abs(across).max())
        goal = np.array([*across, *[np.nan] * 9])
        plan = np.linspace(0.0, 1.0, 11)[:, None] * np.nan_to_num(goal)
        target = Target(space, goal, plan)
        radius = target.radius(0.3, None, None)
        far = target.distance(plan[0])  # for long ways without a position relative to the plan's range
        near = 4 * usual if spatial else usual
        assert radius == usual if way < 1e-6 or far > near else radius == pytest.approx(far / 10)
        assert (far > (4 if spatial else 1) * radius) == (way > 1e-6)
        assert target.distance(0.95 * plan[-1]) <= radius
        asked = (way + 1, None) if spatial else (None, way + 1)
        assert target.radius(0.3, *asked) == way + 1


def test_a_robot_that_leaves_a_goal_beside_its_start_has_not_reached_it(cage: Plant) -> None:
    """The plan ends 6 to 28 cm from the goal, which is within the robot's radius, but no nearer than it began."""
    plan = hover()
    for by in (0.02, -0.1, -0.2):
        goal = plan.trajectory.states[0] + np.array([by, *np.zeros(11)])
        rollout = ls.simulate(cage, replace(plan, goal=goal, goal_radius=None))
        assert rollout.outcome == ("timed out",)
        assert rollout.goal_radius == pytest.approx(abs(by) / 10)
        assert rollout.goal_distance[0] < 0.3
    assert ls.simulate(cage, hover()).outcome == ("reached",)


def test_without_a_goal_it_is_the_end_of_the_plan_and_is_called_so(cage: Plant) -> None:
    rollout = ls.simulate(cage, hover())
    assert rollout.outcome == ("reached",)
    assert "the plan's end stands in for it" in rollout.summary()
    assert "from the plan's end" in rollout.summary()
    assert rollout.tally() == "1 of 1 trials reached the plan's end"


def test_what_the_final_cost_gives_no_weight_does_not_count(quadrotor: ls.Scenario) -> None:
    problem = quadrotor.problem
    weight = np.array([500.0, 0.0, 500.0, *np.zeros(9)])
    goal = replace(problem, final_cost=ls.QuadraticCost(weight, about=np.arange(12.0))).weighed_goal
    np.testing.assert_array_equal(goal, [0.0, np.nan, 2.0, *[np.nan] * 9])
    space = problem.dynamics.state_coordinates
    target = Target(space, goal, np.zeros((2, 12)))
    assert target.distance(np.array([3.0, 99.0, 6.0, *np.full(9, 7.0)])) == 5
    assert replace(problem, final_cost=ls.QuadraticCost(np.zeros(12), about=np.ones(12))).weighed_goal is None
    speed = replace(problem, final_cost=ls.QuadraticCost([0.0] * 3 + [1.0] * 3 + [0.0] * 6, about=np.ones(12)))
    assert Target(space, speed.weighed_goal, np.zeros((2, 12))).unit == OF_WAY


def test_a_solution_and_its_files_keep_the_goal(quadrotor_solution: ls.Solution, cage: Plant, tmp_path) -> None:
    solution = quadrotor_solution
    assert solution.goal is not None
    away = np.linalg.norm(solution.trajectory.states[-1, :3] - solution.goal[:3])
    assert f"the plan ends {away:.3g} m from the goal" in solution.summary()
    again = ls.load(ls.save(solution, tmp_path / "solution.npz"), ls.Solution)
    np.testing.assert_array_equal(again.goal, solution.goal)
    assert again.goal_radius == solution.goal_radius == 0.3
    half = replace(short(1.9), goal=np.array([1.0, *[np.nan] * 11]))
    rollout = ls.simulate(cage, half, disturbances=[ForceNoise(2.0)], trials=4)
    loaded = ls.load(ls.save(rollout, tmp_path / "rollout.npz"), ls.Rollout)
    assert loaded.outcome == rollout.outcome
    assert loaded.obstacles == rollout.obstacles
    np.testing.assert_array_equal(loaded.goal, half.goal)
    assert loaded.summary() == rollout.summary()


@pytest.mark.parametrize("trials", [1, 2, 10, 11, 25])
def test_a_summary_counts_the_outcomes_and_lists_the_first_trials(cage: Plant, trials: int) -> None:
    rollout = ls.simulate(cage, short(0.0), disturbances=[ForceNoise(5.0)], trials=trials, seed=3)
    text = str(rollout)
    listed = [int(one) for one in re.findall(r"^  trial (\d+): ", text, re.MULTILINE)]
    assert listed == list(range(min(trials, 10)))
    assert re.findall(r"^  and (\d+) more$", text, re.MULTILINE) == ([str(trials - 10)] if trials > 10 else [])
    counts = re.findall(r"^  (\d+) trials: (.*)$", text, re.MULTILINE)
    assert bool(counts) == (trials > 1)
    for total, each in counts:
        found = {outcome: int(number) for number, outcome in (one.split(" ", 1) for one in each.split(", "))}
        assert int(total) == trials
        assert found == {one: rollout.outcome.count(one) for one in set(rollout.outcome)}
        assert trials < 10 or len(found) > 1  # this noise is between what it survives and what it does not


# The first event ends a trial.


def test_what_hits_something_and_then_blows_up_has_collided_everywhere(cage: Plant) -> None:
    """Thrown at a wall, and out of the world two seconds later."""
    push = [Push((3.0, 0.0, 0.0), at=0.0), Push((1e12, 0.0, 0.0), at=1.5)]
    for contacts in (True, False):
        rollout = ls.simulate(cage, hover(), disturbances=push, contacts=contacts)
        assert np.isfinite(rollout.diverged_at[0])
        assert rollout.outcome == ("collided",)
        assert (rollout.collided[0], rollout.diverged[0]) == (True, False)
        assert outcomes(rollout).outcome.tolist() == ["collided"]
        assert outcomes(rollout).ended[0] == rollout.collided_at[0] < rollout.diverged_at[0]
        assert "collided with" in rollout.summary()
    lost = ls.simulate(cage, hover(), disturbances=[ForceNoise(1e300)], trials=2)
    assert set(lost.outcome) <= {"diverged", "collided"}
    assert lost.summary()  # whatever the strength


def test_a_collision_between_two_knots_is_one(cage: Plant) -> None:
    """At 20 m/s over a bar: no knot is within it, the line between two is, along a chord that is worked out by hand."""
    speed, plan = 20.0, hover(3)
    # Bar x1 lies along x at y = z = -1.25, radius 0.4; the robot's is 0.3. It flies along y, 0.69 m above its axis.
    start = np.array([0.0, -1.25 - 1.5 * speed / 30, -1.25 + 0.69, 0.0, speed, *np.zeros(7)])
    states = np.array([start + np.array([0.0, speed * t, *np.zeros(10)]) for t in plan.trajectory.times])
    plan = replace(plan, trajectory=replace(plan.trajectory, states=states)).open_loop()
    for contacts in (True, False):
        rollout = ls.simulate(cage, plan, contacts=contacts)
        assert rollout.outcome == ("collided",)
        assert rollout.obstacles == ("bar_x1",)
        y, height = (np.interp(rollout.collided_at[0], rollout.times[:3], rollout.states[0, :3, i]) for i in (1, 2))
        if not contacts:
            assert (rollout.clearance >= 0).all()
            chord = np.sqrt(0.7**2 - (height + 1.25) ** 2)
            assert -1.25 - chord <= y <= -1.25 - chord + 0.02 * 0.3 + 1e-3


@given(
    st.lists(
        st.tuples(*[st.sampled_from([0.0, 0.5, 1.0, 1.5, np.inf])] * 3, st.sampled_from([0.0, 0.1, 0.2, np.nan])),
        min_size=1, max_size=9,
    )
)  # fmt: skip
def test_the_first_event_ends_a_trial(rows: list[tuple[float, float, float, float]]) -> None:
    collided, diverged, failed, distance = (np.array(column) for column in zip(*rows, strict=True))
    run = SimpleNamespace(
        collided_at=collided, diverged_at=diverged, failed_at=failed, goal_distance=distance, goal_radius=0.1,
        plan=SimpleNamespace(horizon=2.0),
    )  # fmt: skip
    outcome, ended = ls.Rollout._endings.func(run)
    for one, when, (hit, lost, erred, away) in zip(outcome, ended, rows, strict=True):
        first = min(hit, lost, erred)
        if first == np.inf:
            assert (one, when) == ("reached" if away <= 0.1 else "timed out", 2.0)
        else:
            assert when == first
            assert {"collided": hit, "diverged": lost, "error": erred}[one] == first


def by_hand(rollout: ls.Rollout, table: Outcomes, k: int) -> None:
    """A row of the table from the rollout's records, in the plainest way."""
    first = min(rollout.collided_at[k], rollout.diverged_at[k], rollout.failed_at[k])
    last = [step for step in range(rollout.plan.steps + 1) if step == 0 or rollout.times[step] < first]
    last = list(range(rollout.plan.steps + 1)) if first == np.inf else last
    error = np.linalg.norm(rollout.states[k, last, :3] - rollout.plan.states[last, :3], axis=1)
    assert table.worst[k] == pytest.approx(error.max(), rel=1e-12)
    assert table.rms[k] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)
    total = 0.0
    for step in range(rollout.plan.steps):
        begun = rollout.times[step]
        if begun < first:
            total += min(rollout.plan.dt, first - begun) * float(np.sum(rollout.applied[k, step] ** 2))
    assert table.effort[k] == pytest.approx(total, rel=1e-9)
    assert table.ended[k] == min(first, rollout.plan.horizon)


@settings(max_examples=examples(12))
@given(
    st.sampled_from([0.0, 0.5, 2.0, 1e6, 1e13]), st.sampled_from([0.0, 1.9]), st.integers(0, 1000), st.booleans(),
    st.sampled_from([1, 5]),
)  # fmt: skip
def test_table_and_rollout_agree(force: float, by: float, seed: int, contacts: bool, trials: int) -> None:
    plant = Plant(ls.Quadrotor(), ls.load_scene("cage"))
    noise = [ForceNoise(force)]
    rollout = ls.simulate(plant, short(by), disturbances=noise, seed=seed, trials=trials, contacts=contacts)
    other = ls.simulate(
        plant, short(by), disturbances=noise, seed=seed, trials=trials, contacts=not contacts, frames=False
    )
    table = outcomes(rollout)
    assert tuple(table.outcome) == rollout.outcome
    assert set(rollout.outcome) <= set(OUTCOMES)
    for flag, name in ((rollout.reached, "reached"), (rollout.collided, "collided"), (rollout.diverged, "diverged")):
        np.testing.assert_array_equal(flag, table.outcome == name)
    for k in range(trials):
        by_hand(rollout, table, k)
    for name, column in outcomes(other).columns().items():
        assert column.tobytes() == table.columns()[name].tobytes(), name


# The same in a campaign, in a replay, and in a rollout.

ROUGH = Campaign(
    scenario="quadrotor",
    sweeps={"scenario": ls.scenarios.quadrotor().disturbances},
    strengths=(0.0, 1.4),
    policies=("smooth",),
    trials=300,
)


@pytest.fixture(scope="module")
def rough(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return run_campaign(ROUGH, tmp_path_factory.mktemp("rough") / "out", workers=0)


def test_a_row_is_what_a_rollout_with_contacts_and_a_replay_say(rough: Results, cage: Plant) -> None:
    cell = rough.cells[1]
    table = rough.outcomes(cell)
    rollout = ls.simulate(
        cage, rough.solution("smooth"), disturbances=ROUGH.disturbances(cell), trials=300, frames=False
    )
    again = outcomes(rollout, rough.runner.scenario.problem)
    assert (table.outcome == "collided").sum() >= 3
    for name, column in again.columns().items():
        np.testing.assert_array_equal(column, table.columns()[name], err_msg=name)
    for trial in np.flatnonzero(table.outcome == "collided")[:5]:
        solid = replay(rough, cell, int(trial))
        assert differences(rough, cell, int(trial), solid) == []
        assert solid.outcome == ("collided",)
        assert solid.obstacles == (table.obstacle[trial],)


def test_a_replay_says_what_differs(rough: Results) -> None:
    cell = rough.cells[1]
    other = replay(rough, cell, 1)
    found = differences(rough, cell, 0, other)
    assert any(line.startswith("worst: ") for line in found)


def test_at_strength_0_there_is_one_run_and_no_interval(rough: Results) -> None:
    calm, windy = rough.summary().splitlines()[1:3]
    assert "300/300 deterministic: 1 run" in calm
    assert "[" not in calm
    assert "[" in windy
    assert "smooth: the plan ends 0.0647 m from the goal" in rough.summary()


def test_where_nothing_reaches_the_kinds_to_try_alone_are_named(tmp_path: Path) -> None:
    """Each name is one that --sweep takes; nothing is said of a set that a trial survives, as calm."""
    scenario = ls.scenarios.quadrotor()
    sweeps = {name: disturbance_set(name, scenario) for name in ("calm", "light")}
    campaign = replace(ROUGH, sweeps=sweeps, strengths=(1.0,), trials=3, goal_radius=1e-9)
    (calm, light) = run_campaign(campaign, tmp_path / "none", workers=0).summary().splitlines()[-2:]
    for name, line in (("calm", calm), ("light", light)):
        said, _, kinds = line.partition(" --sweep ")
        assert said == f"{name}: no trial reached the goal; each kind of disturbance alone:"
        assert [one for kind in kinds.split() for one in disturbance_set(kind, scenario)] == list(sweeps[name])
    easy = replace(campaign, sweeps={"calm": sweeps["calm"]}, goal_radius=9.0)
    assert "--sweep" not in run_campaign(easy, tmp_path / "all", workers=0).summary()


@pytest.mark.parametrize("seed", range(3))
def test_what_runs_violate_is_named_though_they_reach_the_goal(
    seed: int, differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    """By states and controls themselves: bounds, a formula of the controls, and an equality at the end."""
    plant, rng = differential_drive.plant(), np.random.default_rng(seed)
    run = ls.simulate(plant, drive_solution, disturbances=ls.disturbances.preset("light", plant), trials=3, seed=seed)
    x, u, t = run.states, run.applied, run.times
    low, high = np.quantile(x[..., 0], [0.1, 0.9])
    most, end = float(np.quantile(u[..., 1], 0.9)), rng.normal()
    clear = ls.Clearance(differential_drive.scene.world, radius=differential_drive.robot.radius, margin=9.0)
    problem = replace(
        differential_drive.problem,
        constraints=[
            ls.StateBounds({differential_drive.robot.dynamics.state_coordinates.names[0]: (low, high)}),
            ls.SymbolicConstraint(lambda x, u, p: p.most - u[1], parameters={"most": most}),
            ls.SymbolicConstraint(lambda x, u, p: x[1] - p.end, parameters={"end": end}, equality=True, at="final"),
            clear,
        ],
    )
    missed = [low - x[:, 1:, 0], x[:, 1:, 0] - high, u[:, :, 1] - most, np.abs(x[:, -1:, 1] - end)]
    knots = [slice(1, None), slice(1, None), slice(0, -1), slice(-1, None)]
    found, x0 = problem.violations(run), problem.dynamics.state_coordinates.names[0]
    formulas = ["SymbolicConstraint: p.most - right", "SymbolicConstraint: -p.end + y"]  # lambdas have no other name
    assert list(found) == [f"StateBounds: {x0} low", f"StateBounds: {x0} high", *formulas]
    for own, by, acts in zip(found.values(), missed, knots, strict=True):
        values = np.where((by > 1e-6) & run.counts[:, acts], by, 0.0)
        worst, when = values.max(axis=1), t[acts][values.argmax(axis=1)]
        np.testing.assert_allclose(own[:, 0], worst, rtol=1e-12, atol=1e-12)  # rounding of the formulas
        np.testing.assert_array_equal(own[:, 1], np.where(worst > 0, when, 0.0))
    assert not replace(problem, constraints=[clear]).violations(run)
    with pytest.raises(InputError, match=r"rollout: got .* steps, want the problem's: "):
        replace(problem, steps=problem.steps + 1).violations(run)


@pytest.mark.parametrize("lows", [(0.3, 0.1), (0.1, 0.3), (0.1, 9.0, 0.2)])
def test_constraints_with_the_same_name_are_numbered(
    lows: tuple[float, ...], quadrotor: ls.Scenario, quadrotor_solution: ls.Solution
) -> None:
    """Names may be the same; one that nothing violates has zeros."""
    run = ls.simulate(quadrotor.plant(), quadrotor_solution, disturbances=[ForceNoise(0.3)], trials=3, seed=4)
    constraints = [ls.SymbolicConstraint(lambda x, u, p, low=low: [low - x[3] ** 2], name="slow") for low in lows]
    found, name = replace(quadrotor.problem, constraints=constraints).violations(run), "SymbolicConstraint: slow"
    assert list(found) == [name, f"{name} (2)", f"{name} (3)"][: len(lows)]
    for own, low in zip(found.values(), lows, strict=True):
        by = np.where(run.counts[:, 1:], run.states[:, 1:, 3] ** 2 - low, 0.0)
        by = np.where(by > 1e-6, by, 0.0)
        np.testing.assert_allclose(own[:, 0], by.max(axis=1), rtol=1e-12)
        np.testing.assert_array_equal(own[:, 1], np.where(by.any(axis=1), run.times[1 + by.argmax(axis=1)], 0.0))


class Slow(ls.Constraint):
    """Bounds on two velocities from above, whose rows have names, or none."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names

    def bind(self, dynamics: ls.Dynamics) -> ls.types.ConstraintTerm:
        bounds = ls.StateBounds(vx=(-np.inf, 0.1), vy=(-np.inf, 0.1)).bind(dynamics)
        return replace(bounds, names=self.names)


def test_rows_of_one_name_count_as_one(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """Rows without names have their indices."""
    run = ls.simulate(quadrotor.plant(), quadrotor_solution, disturbances=[ForceNoise(0.3)], trials=3, seed=4)
    constraints = [Slow(()), Slow(("speed", "speed"))]
    found = replace(quadrotor.problem, constraints=constraints).violations(run)
    assert list(found) == ["Slow[0]", "Slow[1]", "Slow: speed"]
    one, other = found["Slow[0]"], found["Slow[1]"]
    np.testing.assert_array_equal(found["Slow: speed"], np.where(one[:, :1] >= other[:, :1], one, other))
    assert (one[:, 0] > 0).all()
    with pytest.raises(InputError, match="ConstraintTerm: names: got 1, want none, or one for each of 2 rows"):
        replace(quadrotor.problem, constraints=[Slow(("speed",))])


def test_a_scenario_without_disturbances_is_told_of_presets() -> None:
    bare = replace(ls.scenarios.quadrotor(), disturbances=())
    with pytest.raises(ls.InputError, match=r"scenario quadrotor.* states none, want .* such as --sweep light"):
        disturbance_set("scenario", bare)
    assert disturbance_set("light", bare)


# Filters that diverge.


def test_a_campaign_says_whose_filter_diverged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the table, the summary and a replay, as of errors; whatever the batch."""
    scenario = ls.scenarios.quadrotor()
    tolerate = {"m": 0.05, "m/s": 0.3, "rad": 0.2, "rad/s": 1.0}
    # Estimates of drag that are negative make its predictions explode.
    wrong = ls.disturbances.Uncertainty(unknowns=[Unknown("drag", 3000.0)], measurement=0.02, start=0.01)

    def controller(own: TrialRunner, cell: Any) -> Controller | ls.AffinePolicy:
        return ls.OffsetFree(scenario.problem, own.solutions[cell.policy], wrong, tolerate=tolerate)

    monkeypatch.setattr(TrialRunner, "controller", controller)
    noise = (MeasurementNoise(0.02), ForceNoise(1.0))
    campaign = replace(ROUGH, sweeps={"noise": noise}, strengths=(1.0,), trials=12)
    files = []
    for batch in (12, 5):
        results = run_campaign(campaign, tmp_path / str(batch), workers=0, batch=batch)
        files.append([path.read_bytes() for path in sorted((tmp_path / str(batch) / "shards").iterdir())])
    assert files[0] == files[1]
    cell = results.cells[0]
    diverged = np.flatnonzero(results.outcomes(cell).outcome == "diverged")
    assert 0 < len(diverged) < 12
    reasons = results.reasons(cell)
    assert sorted(reasons) == diverged.tolist()
    assert all(re.fullmatch(r"filter at .* s: the estimate of \w+ is .*", reason) for reason in reasons.values())
    said = results.stop_reasons()
    assert len(said) == min(len(set(reasons.values())), 5)
    assert all(re.fullmatch(r"[1-9]\d* trials were stopped: filter at .*", line) for line in said)
    assert all(line in results.summary().splitlines() for line in said)
    page = report(results, tmp_path / "page.html", videos=0).read_text(encoding="utf-8")
    assert all(f"{line}." in page for line in said)
    trial = int(diverged[0])
    again = replay(results, cell, trial)
    assert again.reasons == (reasons[trial],)
    assert differences(results, cell, trial, again) == []


# Controllers that fail.


class Failing(Controller):
    """Follows the policy, and fails at step 7 in a way of its own, wherever a trial is further left than another."""

    def __init__(self, solution: ls.Solution, how: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        self.policy, self.how = Feedback(solution.policy), how

    def start(self, trials: int) -> ControllerRun:
        return FailingRun(self.policy.start(trials), self.how)

    @property
    def digest(self) -> str:
        return "failing"

    @property
    def coordinates(self):
        return self.policy.coordinates


class FailingRun(ControllerRun):
    def __init__(self, plain: ControllerRun, how: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        self.plain, self.how = plain, how

    def control(self, step: int, measured: np.ndarray) -> np.ndarray:
        command = self.plain.control(step, measured)
        return self.how(measured, command) if step == 7 else command


def raising(shown: np.ndarray, command: np.ndarray) -> np.ndarray:
    raise ZeroDivisionError("two\nlines")


def one_nan(shown: np.ndarray, command: np.ndarray) -> np.ndarray:
    command[int(np.argmax(shown[:, 0])), 2] = np.nan
    return command


@pytest.mark.parametrize(
    ("how", "failed", "why"),
    [
        (raising, 3, "ZeroDivisionError: two lines"),
        (lambda shown, command: command[:, :3], 3, "InputError: commands: got shape (3, 3), want (3, 4)"),
        (lambda shown, command: None, 3, "InputError: commands: got"),
        (lambda shown, command: "none", 3, "InputError: commands: got 'none', want numbers of shape (3, 4)"),
        (one_nan, 1, "got nan for rotor_3, want a finite number"),
    ],
)
def test_a_controller_that_fails_ends_its_trials_and_says_why(cage: Plant, how, failed: int, why: str) -> None:
    noise, plan = [ForceNoise(0.1)], hover()
    calm = ls.simulate(cage, plan, disturbances=noise, trials=3)
    rollout = ls.simulate(cage, plan, controller=Failing(plan, how), disturbances=noise, trials=3)
    assert rollout.outcome.count("error") == failed
    for k, outcome in enumerate(rollout.outcome):
        until = 8 if outcome == "error" else len(rollout.times)
        np.testing.assert_array_equal(rollout.states[k, :until], calm.states[k, :until])
        assert np.isnan(rollout.states[k, until:]).all()
        if outcome == "error":
            assert rollout.failed_at[k] == pytest.approx(7 / 30)
            assert rollout.reasons[k].startswith(f"controller at 0.2333 s: {why}")
            assert f"trial {k}: error after 0.23 s: controller at" in rollout.summary()
            assert np.isnan(rollout.applied[k, 7:]).all()
    assert outcomes(rollout).outcome.tolist() == list(rollout.outcome)
    assert len(rollout.frame_times) == rollout.frames.shape[1]


def some(shown: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Fails, whatever runs beside it, where a trial is to one side; a batch with such a trial fails as a whole."""
    if (shown[:, 0] > FAR).any():
        raise ValueError("too far to the side")
    return command


FAR = -2.2  # m; about half of the trials are beyond it at the seventh step


def test_in_a_campaign_only_those_trials_fail_that_fail_alone(
    rough: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = replace(ROUGH, strengths=(1.4,), trials=12)
    alone = rough.runner.run(rough.cells[1], 0, 12, frames=False, contacts=False)
    beyond = alone.measured[:, 7, 0] > np.median(alone.measured[:, 7, 0])
    monkeypatch.setitem(globals(), "FAR", float(np.median(alone.measured[:, 7, 0])))
    monkeypatch.setattr(TrialRunner, "controller", lambda own, cell: Failing(own.solutions[cell.policy], some))
    files = []
    for batch in (12, 5):
        results = run_campaign(campaign, tmp_path / str(batch), workers=0, batch=batch)
        table = results.outcomes(results.cells[0])
        np.testing.assert_array_equal(table.outcome == "error", beyond)
        line = some.__code__.co_firstlineno + 3
        assert set(results.reasons(results.cells[0]).values()) == {
            f"controller at 0.2333 s: ValueError: too far to the side ({Path(__file__).name}, line {line})"
        }
        files.append([path.read_bytes() for path in sorted((tmp_path / str(batch) / "shards").iterdir())])
    assert files[0] == files[1]


def test_simulate_says_how_many_reached_the_goal_and_that_a_plan_misses_it(
    quadrotor_solution: ls.Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(ls.save(replace(quadrotor_solution, scenario="quadrotor"), tmp_path / "solution.npz"))
    assert main(["simulate", path, "--trials", "3"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "3 of 3 trials reached the goal"
    assert main(["simulate", path, "--trials", "3", "--goal-radius", "0.01"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "0 of 3 trials reached the goal"
    assert "  the plan ends 0.0647 m from the goal, which is reached within 0.01 m" in lines
    assert any(line.startswith("  the plan MISSES the goal: ") for line in lines)
    assert main(["simulate", path, "--goal-tolerance", "0.1"]) == 2
    assert "want goal_radius, in metres" in capsys.readouterr().err


def test_parts_that_stick_out_of_the_radius_collide_too(cage: Plant) -> None:
    """The packaged ball of 0.3 m with a radius of 0.2: contacts are felt, at the states at which MuJoCo has them."""
    assert cage.enclosed
    plant = Plant(ls.Quadrotor(radius=0.2), cage.scene)
    assert not plant.enclosed
    noise = [
        ForceNoise(10.0),
        DisplacedObstacles(0.05),
        MassMismatch(0.05),
    ]
    runs = {c: ls.simulate(plant, hover(), disturbances=noise, trials=8, contacts=c) for c in (True, False)}
    free, solid = runs[False], runs[True]
    assert free.collided.sum() >= 4
    for name, column in outcomes(solid).columns().items():
        assert column.tobytes() == outcomes(free).columns()[name].tobytes(), name
    np.testing.assert_array_equal(free.states[free.counts], solid.states[free.counts])
    for k in np.flatnonzero(free.collided):
        # Each bar, wall and floor by its own distance, where the trial has it; a period is one physics step.
        moved = free.displaced[k]
        near = [
            min(plant.world.distances(place - moved[i])[i] for i in range(len(moved))) - 0.3
            for place in free.states[k, :, :3]
        ]
        assert free.collided_at[k] == free.times[np.argmax(np.array(near) < 0)]
        assert solid.contacts[k] > 0
