"""Free bodies that turn about an axis on and on: plans, runs under noise, filters and C, as at any other heading."""

import pickle
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from export_c import CompiledLaw
from mechanisms import NO_CONTACT, sled
from sampling import rarely
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.control.controllers import as_controller
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml

NOISE = [ls.disturbances.MeasurementNoise(0.002)]  # m, rad, m/s, rad/s
STEPS, DT = 125, 0.02


def quadrotor() -> str:
    """Four rotors, which lift it along its own z and turn it."""
    places = {"a": "0.1 0.1", "b": "-0.1 0.1", "c": "-0.1 -0.1", "d": "0.1 -0.1"}
    sites = "".join(f'<site name="{name}" pos="{place} 0"/>' for name, place in places.items())
    motors = "".join(
        f'<motor name="m{name}" site="{name}" gear="0 0 1 0 0 {sign}0.1" ctrlrange="0 6"/>'
        for name, sign in zip(places, ("", "-", "", "-"), strict=True)
    )
    return sled(
        "", place="0 0 2", geom=f'type="box" size="0.1 0.1 0.02" mass="0.5" {NO_CONTACT}',
        carried="<freejoint/>" + sites, actuators=motors, option='timestep="0.01" integrator="implicitfast"',
    )  # fmt: skip


def weightless() -> str:
    """A body with a torque about each of its axes and a force along one: as many controls as a quadrotor has."""
    motors = "".join(
        f'<motor name="m{i}" site="middle" gear="{" ".join(map(str, gear.tolist()))}" ctrlrange="-6 6"/>'
        for i, gear in enumerate(np.eye(6)[2:] * [1, 1, 1, 0.1, 0.1, 0.1])
    )
    return sled(
        "", geom='type="box" size="0.1 0.12 0.15" mass="0.5"', carried='<freejoint/><site name="middle"/>',
        actuators=motors, option='timestep="0.01" integrator="implicitfast" gravity="0 0 0"',
    )  # fmt: skip


FILES = {"quadrotor": quadrotor, "weightless": weightless}


@cache
def turning(
    kind: str, axis: str, degrees: float, turns_about: str | None
) -> tuple[ls.MjcfRobot, ls.Problem, ls.Solution]:
    """A plan that turns about an axis of the world for 1.5 s, and holds still for a second."""
    robot = ls.MjcfRobot(scene_from_xml(FILES[kind](), kind), turns_about=turns_about)
    start = robot.at()
    about = np.tile(start, (STEPS + 1, 1))
    about[:, 3 + "xyz".index(axis)] = np.deg2rad(degrees) * np.clip(np.arange(STEPS + 1) / 75, 0, 1)
    weight, hold = np.array([10.0] * 6 + [0.1] * 6), robot.hold(start)
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=DT, steps=STEPS, initial=ls.FixedState(start),
        stage_cost=ls.QuadraticCost(weight, about=about) + ls.ControlCost(np.full(len(hold), 0.1), about=hold),
        final_cost=ls.QuadraticCost(10 * weight, about=about[-1]),
    )  # fmt: skip
    return robot, problem, ls.smooth(problem, threads=1)


@cache
def held_still(kind: str, axis: str, degrees: float) -> tuple[float, float]:
    """The largest tilt of the axis, in rad, and the largest rate across it, in rad/s, of ten runs that hold still."""
    robot, _, plan = turning(kind, axis, degrees, axis)
    late = ls.simulate(ls.Plant(robot, robot.scene), plan, disturbances=NOISE, trials=10, seed=0).states[:, 80:]
    along = np.eye(3)["xyz".index(axis)]
    quaternions = robot.configuration(late)[0][..., 3:7].reshape(-1, 4)
    tilted = Rotation.from_quat(quaternions, scalar_first=True).apply(along)
    tilt = np.arctan2(np.linalg.norm(np.cross(along, tilted), axis=1), tilted @ along)
    return float(tilt.max()), float(np.abs(late[..., 9:12] * (1 - along)).max())


@pytest.mark.parametrize(("kind", "axis"), [("quadrotor", "z"), *rarely(("weightless", "x"), ("weightless", "y"))])
def test_a_whole_turn_is_like_any_other_angle(kind: str, axis: str) -> None:
    """The dynamics do not depend on the heading: runs under noise do there what they do next to it.

    Next to it the motion until then differs by little, so costs, tilts and rates are nearly the mean of both sides.
    """
    angles = 300, 355, 360, 365, 720
    plans = [turning(kind, axis, degrees, axis)[-1] for degrees in angles]
    assert all(plan.status is ls.Status.CONVERGED and not plan.detail for plan in plans)
    costs = [plan.cost for plan in plans]
    assert costs == sorted(costs)
    tilts, rates = np.transpose([held_still(kind, axis, degrees) for degrees in angles])
    for numbers, error in ((costs, 1e-3), (tilts, 0.02), (rates, 0.02)):
        assert numbers[2] == pytest.approx((numbers[1] + numbers[3]) / 2, rel=error)
    assert tilts.max() < np.deg2rad(0.3)  # of 0.002 rad of noise, 0.1 degrees
    assert rates.max() < 0.2


@pytest.mark.parametrize(("kind", "axis"), [("quadrotor", "z"), ("weightless", "x")])
def test_it_is_a_rotation_vector_where_nothing_tilts(kind: str, axis: str) -> None:
    """The same plan, to the tolerance of both solves, and where that is singular, the remedy is named."""
    *_, plan = turning(kind, axis, 300, axis)
    *_, other = turning(kind, axis, 300, None)
    assert plan.cost == pytest.approx(other.cost, rel=1e-7)
    np.testing.assert_allclose(plan.trajectory.states, other.trajectory.states, rtol=0, atol=1e-5)
    assert not other.detail
    *_, singular = turning(kind, axis, 360, None)
    assert "from a whole turn, where rotation vectors are singular" in singular.detail
    assert singular.detail.endswith(f'MjcfRobot(..., turns_about="{axis}") avoids this')


def test_a_tilt_near_half_a_turn_is_singular_and_named() -> None:
    *_, plan = turning("weightless", "x", 175, "z")
    assert "rx, ry are" in plan.detail
    assert "from half or whole turns, where tilts are singular" in plan.detail
    assert "turns_about" not in plan.detail
    *_, other = turning("weightless", "x", 120, "z")
    assert not other.detail


def test_steps_are_those_of_the_rotation_vector() -> None:
    """From random attitudes with tilts of up to 150 degrees, many turns on: the same attitude, by SciPy, and rates."""
    plain = ls.MjcfRobot(scene_from_xml(weightless(), "body"))
    rng = np.random.default_rng(0)
    for axis in "xyz":
        robot, along = (
            ls.MjcfRobot(scene_from_xml(weightless(), "body"), turns_about=axis),
            np.eye(3)["xyz".index(axis)],
        )
        for _ in range(20):
            tilt = np.where(along, 0, rng.normal(size=3))
            tilt *= np.deg2rad(rng.uniform(0, 150)) / np.linalg.norm(tilt)
            rotation, control = tilt + 20 * rng.normal() * along, rng.normal(size=4)
            attitude = Rotation.from_rotvec((rotation @ along) * along) * Rotation.from_rotvec(tilt)
            place, rates = rng.normal(size=3), rng.normal(size=6)
            state = np.concatenate([place, rotation, rates])
            after = robot.dynamics.step(state, control, DT)
            expected = plain.dynamics.step(np.concatenate([place, attitude.as_rotvec(), rates]), control, DT)
            turned = Rotation.from_rotvec((after[3:6] @ along) * along) * Rotation.from_rotvec(
                np.where(along, 0, after[3:6])
            )
            # 1e-9: rounding, which the turns made larger.
            np.testing.assert_allclose(
                turned.as_matrix(), Rotation.from_rotvec(expected[3:6]).as_matrix(), rtol=0, atol=1e-9
            )
            np.testing.assert_allclose(after[[0, 1, 2, *range(6, 12)]], expected[[0, 1, 2, *range(6, 12)]], atol=1e-9)
            assert np.abs(after[3:6] - rotation).max() < 1.0  # nearest to where it was


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler, cc")
def test_laws_and_filters_turn_on_in_c_too(tmp_path: Path) -> None:
    """At a whole turn, with half of the noise to the other side of it."""
    robot, problem, plan = turning("quadrotor", "z", 360, "z")
    plant = ls.Plant(robot, robot.scene)
    filtered = ls.OffsetFree(problem, plan, ls.uncertainty_of(plant, NOISE)).policy
    for name, policy in (("law", plan.policy), ("filter", filtered)):
        (tmp_path / name).mkdir()
        law = CompiledLaw(policy, tmp_path / name)
        run = ls.simulate(plant, plan, controller=law, disturbances=NOISE, trials=3, seed=0)
        again = as_controller(policy, plan, robot.dynamics)[0].start(3)
        commands = [again.control(step, run.controller_run.shown[step]) for step in range(STEPS)]
        # 1e-9 N: rounding of filters whose gains are large.
        np.testing.assert_allclose(run.commanded, np.stack(commands, axis=1), rtol=0, atol=1e-9)
        assert run.outcome == ("reached",) * 3


def test_copies_and_other_obstacles_keep_the_axis() -> None:
    robot = ls.MjcfRobot(scene_from_xml(weightless(), "body"), turns_about="y")
    state = robot.at(rx=0.3, ry=9.0, rz=-0.4)
    heavier = robot.with_parameters(mass=0.6)
    for one in (heavier, pickle.loads(pickle.dumps(heavier)), pickle.loads(pickle.dumps(robot))):
        np.testing.assert_array_equal(one.configuration(state)[0], robot.configuration(state)[0])
        assert one.dynamics.state_coordinates == robot.dynamics.state_coordinates
    assert robot.dynamics.state_coordinates.angles == (4,)
    plain = ls.MjcfRobot(robot.scene)
    assert plain.dynamics.state_coordinates.angles == ()
    assert plain.dynamics.model_digest != robot.dynamics.model_digest  # distances of the same state are others
    wall = ls.World([ls.Obstacle("wall", "sphere", np.array([1.0, 0, 0]), np.eye(3), np.array([0.2, 0, 0]))])
    moved: Array = np.array([state, robot.at(rx=0.3, ry=9.0 - 4 * np.pi, rz=-0.4)])
    shape = robot.among(wall)
    near, far = shape.clearance(shape.places(moved), None)
    assert near == pytest.approx(far, abs=1e-9)


@pytest.mark.parametrize(
    ("axis", "message"), [("w", "turns_about: got 'w', want one of: x, y, z"), (2, "turns_about: got 2, want one of")]
)
def test_what_is_no_axis_is_refused(axis: object, message: str) -> None:
    with pytest.raises(ls.InputError, match=message):
        ls.MjcfRobot(scene_from_xml(weightless(), "body"), turns_about=axis)  # pyright: ignore[reportArgumentType]


def test_what_has_no_rotation_has_no_axis() -> None:
    xml = weightless().replace("<freejoint/>", '<joint type="slide"/>')
    with pytest.raises(ls.InputError, match="turns_about: got 'z' without a free or ball joint, want None"):
        ls.MjcfRobot(scene_from_xml(xml, "body"), turns_about="z")
