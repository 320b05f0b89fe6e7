"""What `check_plant` takes away, what it leaves, and that it says so."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import Jointed, scene, sled
from planar_quadrotor import BLOCK, PlanarQuadrotor, mjcf
from sampling import examples
from tracking import track, weave

import lqrsim as ls
from lqrsim.scenes.scene import scene_from_xml

MASS, LENGTH, GRAVITY = 0.4, 0.5, 9.81


@dataclass(frozen=True)
class Arm(Jointed):
    """A rod that a motor swings, with a ball at its end: nothing of it is a position."""

    radius: float = 0.1
    length: float = LENGTH  # m

    name = "arm"
    body = "arm"
    joints = ("shoulder",)
    actuators = ("motor",)

    @cached_property
    def dynamics(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        def rate(x, u, p):
            from sympy import sin

            return [x[1], u[0] / (p.mass * p.length**2) - p.gravity / p.length * sin(x[0])]

        return ls.Dynamics(
            rate,
            states={"angle": "rad", "speed": "rad/s"},
            controls={"torque": "N m"},
            parameters={"mass": MASS, "gravity": GRAVITY, "length": self.length},
            angles=("angle",),
            control_limits=(-3, 3),
        )


def arm(things: str = "", *, joint: str = "", motor: str = "", more: str = "") -> ls.Scene:
    body = f"""<body name="arm" pos="0 0 0.5"><joint name="shoulder" axis="0 -1 0" {joint}/>
      <inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="1e-9 1e-9 1e-9"/>
      <geom name="fist" size="0.1" pos="0 0 -{LENGTH}"/></body>"""
    option = f'timestep="0.005" integrator="RK4" gravity="0 0 -{GRAVITY}"'
    driven = f'<motor name="motor" joint="shoulder" {motor}/>'
    return scene_from_xml(scene(body, driven, things=things, option=option, more=more), "bench")


POSTS = (
    '<geom name="post" type="cylinder" size="0.1 1" pos="0.25 0 0.5"/><geom type="box" size="0.1 1 1" pos="-0.3 0 0"/>'
)
FLOOR = '<geom name="floor" type="plane" size="1 1 1" pos="0 0 0.05"/>'


@pytest.mark.parametrize("paired", [(), ("post",), ("floor",), ("floor", "post")])
def test_an_arm_between_posts_and_on_a_floor_that_it_reaches_agrees(paired: tuple[str, ...]) -> None:
    """An obstacle of a pair would collide whatever its contype."""
    pairs = "".join(f'<pair geom1="fist" geom2="{obstacle}"/>' for obstacle in paired)
    found = ls.check_plant(Arm(), arm(POSTS + FLOOR, more=f"<contact>{pairs}</contact>"))
    assert found.good, found
    assert found.contacts == ()
    assert not ls.check_plant(Arm(length=0.6), arm(POSTS + FLOOR)).good


def test_a_planar_quadrotor_over_a_floor_among_obstacles_agrees() -> None:
    floor = '<geom name="floor" type="plane" size="1 1 1"/>'  # on which half of the states lie
    found = ls.check_plant(PlanarQuadrotor(), scene_from_xml(mjcf(BLOCK + floor), "planar"))
    assert found.good, found
    assert found.contacts == ()


def swung(**stated: Any) -> ls.Problem:
    return ls.Problem(**{
        "dynamics": Arm().dynamics, "dt": 0.02, "steps": 5, "initial": ls.FixedState((0.3, 0.0)),
        "stage_cost": ls.ControlCost([1.0]), "final_cost": ls.QuadraticCost(np.ones(2), about=np.zeros(2)), **stated,
    })  # fmt: skip


@settings(max_examples=examples(8))
@given(low=st.floats(-1.0, 0.2), high=st.floats(0.4, 1.5), most=st.floats(0.1, 2.0), seed=st.integers(0, 99))
def test_samples_keep_to_the_bounds_of_a_problem(low: float, high: float, most: float, seed: int) -> None:
    """A stop of the joint, of which the dynamics know nothing, is outside of them; the change shows the controls."""
    scene = arm(joint=f'range="{low - 0.15} {high + 0.15}"')
    bounds = [ls.StateBounds(angle=(low, high), speed=(-5.0, 5.0)), ls.StateBounds(speed=(-np.inf, 4.0))]
    problem = swung(constraints=bounds, control_limits=(-most, most))
    found = ls.check_plant(Arm(), scene, problem=problem, spread=3.0, seed=seed, samples=20)
    assert found.good, found
    assert low <= found.state[0] <= high
    assert abs(found.control[0]) <= most
    assert not ls.check_plant(Arm(), scene, spread=3.0, seed=seed, samples=20).good


@dataclass(frozen=True)
class Spinner(Jointed):
    """A cart, and a fast wheel that nothing couples to it."""

    radius: float = 0.1
    thrust: float = 1.0  # of the cart's force
    turns: bool = True

    name = "cart"
    body = "cart"

    @property
    def joints(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return ("x", "spin") if self.turns else ("x",)

    @property
    def actuators(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return ("push", "drive") if self.turns else ("push",)

    @cached_property
    def dynamics(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        def rate(x, u, p):
            return [x[2], x[3], p.thrust * u[0], 1e5 * u[1]] if self.turns else [x[1], p.thrust * u[0]]

        wheel, drive = ({"turn": "rad"}, {"torque": "N m"}) if self.turns else ({}, {})
        return ls.Dynamics(
            rate,
            states={"place": "m", **wheel, "speed": "m/s", **{f"{name}_rate": "rad/s" for name in wheel}},
            controls={"force": "N", **drive},
            parameters={"thrust": self.thrust},
            control_limits=(-1, 1),
        )


@settings(max_examples=examples(20))
@given(thrust=st.floats(0.5, 0.9) | st.floats(1.1, 2.0) | st.just(1.0), seed=st.integers(0, 99))
def test_a_fast_wheel_hides_no_fault_of_the_cart(thrust: float, seed: int) -> None:
    """Its changes, in another unit, are thousands of times as large."""
    wheel = """<body name="wheel" pos="0 9 0"><joint name="spin" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1e-5 1e-5 1e-5"/></body>"""
    found = []
    for turns in (False, True):
        scene = scene_from_xml(
            sled(
                name="cart",
                option='timestep="0.005" integrator="RK4" gravity="0 0 0"',
                actuators='<motor name="push" joint="x"/>' + '<motor name="drive" joint="spin"/>' * turns,
                things=wheel * turns,
            ),
            "rails",
        )
        found.append(ls.check_plant(Spinner(thrust=thrust, turns=turns), scene, seed=seed))
    assert found[0].good == found[1].good == (thrust == 1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"problem": swung(constraints=[ls.StateBounds(speed=(1.0, 2.0))])},
         "around: got 0 for speed, want one within its bounds, 1 to 2"),
        ({"problem": swung(), "around": (0.0, np.inf)}, "around: got inf"),
        ({"problem": ls.scenarios.differential_drive().problem}, "problem: got a problem with the states"),
        ({"problem": 3}, "problem: got 3, want a Problem of the robot"),
        ({"plan": 3}, "plan: got 3, want a Plan of the robot, such as a Solution, or None"),
        ({"plan": weave(3)}, "plan: got a plan with the states x, y, heading, want angle, speed, as the robot has"),
    ],
)  # fmt: skip
def test_a_problem_that_does_not_fit_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ls.InputError, match=message):
        ls.check_plant(Arm(), arm(), **options)


def drawn(count: int, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """The states (k, 2) and controls (k, 1) of single samples."""
    scene = arm()
    found = [ls.check_plant(Arm(), scene, seed=seed, samples=1, **options) for seed in range(count)]
    return np.array([one.state for one in found]), np.array([one.control for one in found])


def test_samples_are_about_the_line_from_start_to_goal() -> None:
    """Of 100, the moments within 4.5 standard errors."""
    count, end = 100, 1e-3
    problem = swung(final_cost=ls.QuadraticCost(np.ones(2), about=(0.3 + end, 0.0)), steps=50)
    states, controls = drawn(count, problem=problem)
    angle, speed = states.T
    along = (angle - 0.3) / end  # on 20 points of the line, uniformly, and 0.3 of its length beside them
    assert abs(along.mean() - 0.5) < 4.5 * np.sqrt((1 / 12 + 0.09) / count)
    # 1.1 for the 20 points: the variance of k / 19 is (20^2 - 1) / (12 * 19^2), 1.105 / 12.
    assert along.var() == pytest.approx(1.105 / 12 + 0.09, rel=4.5 * np.sqrt(2 / count))
    fastest = 2 * end / 1.0  # of a motion that takes 50 steps of 0.02 s, with constant acceleration
    assert speed.std() == pytest.approx(0.3 * fastest, rel=4.5 / np.sqrt(2 * count))
    low, high = Arm().dynamics.control_coordinates.low[0], Arm().dynamics.control_coordinates.high[0]
    assert np.ptp(controls) > 0.9 * (high - low)


@pytest.mark.long
def test_samples_are_about_a_plan() -> None:
    """Each is near one of its knots: 300 normal numbers in three coordinates stay within 4.5."""
    swing = 0.1 * np.sin(np.arange(40) / 5)[:, None]
    plan = track(Arm(), (0.3, 0.1), swing, 0.02)
    states, controls = drawn(300, plan=plan)
    knots = np.hstack([plan.trajectory.states[:-1], plan.trajectory.controls])
    away = np.abs(np.hstack([states, controls])[:, None] - knots) / (0.3 * np.ptp(knots, axis=0))
    assert away.max(axis=2).min(axis=1).max() < 4.5
    assert away[:, 0].max(axis=1).max() > 4.5  # and not all near the first


def test_a_plan_between_stops_agrees_near_it() -> None:
    """The dynamics do not know of the stops, which most of what is drawn by default is past."""
    scene = arm(joint='range="-0.03 0.03"')
    plan = track(Arm(), (0.01, 0.0), np.zeros((50, 1)), 0.02)  # a pendulum's swing of 0.01 rad
    assert ls.check_plant(Arm(), scene, plan=plan).good
    assert not ls.check_plant(Arm(), scene).good


@settings(max_examples=examples(12))
@given(ends=st.lists(st.floats(-0.5, 0.5), min_size=2, max_size=2).map(sorted), seed=st.integers(0, 10**6))
def test_controls_are_numbers_vectors_or_pairs_by_name(ends: list[float], seed: int) -> None:
    """The same bits in each form, and the worst control is within; a control that is not named keeps its limits."""
    low, high = ends
    plant, options = (ls.DifferentialDrive(), ls.load_scene("arena")), {"samples": 2, "settle": 0.0, "seed": seed}
    first = ls.check_plant(*plant, controls=([low, low], [high, high]), **options)
    assert ((low <= first.control) & (first.control <= high)).all()
    forms: list[Any] = [
        (low, high), [low, high], (low, [high, high]),
        {"left": (low, high), "right": (low, high)}, {"m/s": (low, high)},
    ]  # fmt: skip
    for controls in forms:
        found = ls.check_plant(*plant, controls=controls, **options)
        np.testing.assert_array_equal(found.errors, first.errors)
        np.testing.assert_array_equal(found.control, first.control)
    named = ls.check_plant(*plant, controls={"right": (low, high)}, **options)
    drawn = np.random.default_rng(seed)  # a state, then a control, for each sample
    controls = [(drawn.normal(size=3), drawn.uniform((-0.5, low), (0.5, high)))[1] for _ in range(2)]
    assert min(np.abs(named.control - one).max() for one in controls) == 0


def test_contacts_that_stay_are_named() -> None:
    """What can move is not taken away, here a heavy box on the way of the arm's fist."""
    box = '<body pos="0.3 0 0"><freejoint/><geom type="box" size="0.12 0.3 0.3" mass="50"/></body>'
    found = ls.check_plant(Arm(), arm(box + FLOOR), samples=30)
    assert not found.good
    (pair,) = found.contacts
    assert pair[:2] == ("geom 1", "fist")
    assert 0 < pair[2] < 30
    assert f"touching in {pair[2]} of 30 samples: {pair[0]} and {pair[1]}" in str(found)


def test_wheels_stay_on_their_floor_and_their_contacts_are_said() -> None:
    found = ls.check_plant(ls.DifferentialDrive(), ls.load_scene("arena"), samples=10)
    assert found.good
    named = {name for a, b, _ in found.contacts for name in (a, b)}
    assert {"floor", "create_tread_left", "create_tread_right"} <= named
    assert not named & set(ls.Plant(ls.DifferentialDrive(), ls.load_scene("arena")).world.names)


def test_a_simulation_that_becomes_unstable_is_told() -> None:
    with pytest.raises(ls.InputError, match="scene bench: got a simulation that becomes unstable from x = "):
        ls.check_plant(Arm(), arm(), controls=((1e12,), (1e13,)))


@pytest.mark.parametrize(
    ("limited", "got"),
    [
        (
            'ctrlrange="-2 2"',
            r"got controls \(torque -3\), for which actuation\(\) commands -3 of actuator 'motor'",
        ),
        ('ctrlrange="-3 2.9"', r"got controls \(torque 3\), for which actuation\(\) commands 3"),
    ],
)
def test_limits_that_an_actuator_cuts_off_are_refused(limited: str, got: str) -> None:
    """MuJoCo would cut the control off without a word, and what the rollout says was applied would not be so."""
    with pytest.raises(ls.InputError, match=f"robot arm: control_limits: {got}"):
        ls.Plant(Arm(), arm(motor=limited))


@pytest.mark.parametrize("limited", ['ctrlrange="-3 3"', 'ctrlrange="-1 1" ctrllimited="false"'])
def test_limits_that_actuators_let_through_are_accepted(limited: str) -> None:
    ls.Plant(Arm(), arm(motor=limited))
