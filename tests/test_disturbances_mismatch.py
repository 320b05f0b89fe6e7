"""Robots and surroundings that are not as planned, against MuJoCo: what moves, by how much."""

import xml.etree.ElementTree as ElementTree
from itertools import permutations

import mujoco
import numpy as np
import pytest
from tracking import hover, track, weave

from lqrsim.errors import InputError
from lqrsim.robots.packaged import DifferentialDrive, Quadrotor
from lqrsim.scenes.scene import load_scene, scene_from_xml
from lqrsim.simulation.closed_loop import ClosedLoop, simulate
from lqrsim.simulation.disturbances import (
    AxleMismatch,
    DisplacedObstacles,
    FrictionMismatch,
    InertiaMismatch,
    InitialStateError,
    MassMismatch,
    Push,
    ThrustMismatch,
    TorqueNoise,
    WheelRadiusMismatch,
)
from lqrsim.simulation.disturbances.base import Effects, seeded
from lqrsim.simulation.disturbances.mismatch import cut_normal
from lqrsim.simulation.physics import MujocoPhysics
from lqrsim.simulation.plant import Plant

DT = 1 / 30


def altered(plant, mismatch, trials=400):
    """The simulations of a mismatch, without running them."""
    physics = MujocoPhysics(plant, trials, 1, contacts=True, threads=1)
    Effects(plant, hover(1).trajectory, [mismatch], range(trials), seeded(0)).alter_models(physics)
    physics.simulations.set_const()
    return physics.simulations


def test_factors_are_normal_cut_at_three():
    generator = np.random.default_rng(0)
    numbers = np.array([cut_normal(generator) for _ in range(100_000)])
    assert np.abs(numbers).max() <= 3
    # A normal distribution cut at +-3 has the variance 1 - 6 phi(3) / (2 Phi(3) - 1) = 0.9733.
    assert abs(numbers.mean()) < 4 / np.sqrt(1e5)
    assert abs(numbers.var() - 0.9733) < 4 * np.sqrt(2 / 1e5)


@pytest.mark.parametrize("fixture", ["arena", "cage"])
@pytest.mark.parametrize(("kind", "field"), [(MassMismatch, "body_mass"), (InertiaMismatch, "body_inertia")])
def test_mass_and_inertia_are_off_by_one_factor_a_trial_and_nothing_else_is(request, fixture, kind, field):
    plant, std, trials = request.getfixturevalue(fixture), 0.1, 400
    simulations = altered(plant, kind(std), trials)
    own = plant.bodies
    factors = simulations.expanded(field)[:, own].reshape(trials, -1) / getattr(plant.model, field)[own].ravel()
    np.testing.assert_allclose(factors, np.broadcast_to(factors[:, :1], factors.shape))
    assert abs(factors.mean() - 1) < 4 * std / np.sqrt(trials)
    assert abs(factors[:, 0].std() / (std * np.sqrt(0.9733)) - 1) < 4 / np.sqrt(2 * trials)
    if kind is MassMismatch:
        total = simulations.expanded("body_subtreemass")[:, plant.body]
        np.testing.assert_allclose(total, factors[:, 0] * plant.model.body_subtreemass[plant.body])


def test_a_heavier_quadrotor_falls_and_is_pushed_as_its_mass_says(cage):
    robot, factor, impulse = cage.robot, 1.25, 0.05
    steady = track(robot, np.zeros(12), np.full((3, 4), robot.hover_force), DT, feedback=False)
    mass = factor * robot.mass
    rollout = simulate(cage, steady, disturbances=[MassMismatch(factor=factor), Push((impulse, 0, 0), at=0.0)])
    decay = robot.drag / mass
    gained = (1 - np.exp(-decay * DT)) / decay / mass  # of a constant force over a period
    np.testing.assert_allclose(rollout.states[0, 1, 3], impulse / DT * gained, rtol=1e-6)
    np.testing.assert_allclose(rollout.states[0, 1, 5], -(factor - 1) * robot.mass * 9.8 * gained, rtol=1e-6)
    lighter = simulate(cage, steady, disturbances=[InertiaMismatch(factor=0.8), TorqueNoise(0.001)])
    rates = lighter.torques[0, 0] / (0.8 * robot.inertia) * DT
    np.testing.assert_allclose(lighter.states[0, 1, 9:], rates, rtol=1e-3)


def test_thrust_is_off_for_each_rotor_on_its_own(cage):
    robot, factors = cage.robot, np.array([1.1, 1.0, 0.9, 1.05])
    steady = track(robot, np.zeros(12), np.full((3, 4), robot.hover_force), DT, feedback=False)
    rollout = simulate(cage, steady, disturbances=[ThrustMismatch(factor=factors.tolist())])
    np.testing.assert_array_equal(rollout.applied[0], steady.trajectory.controls)
    expected = robot.dynamics.step(np.zeros(12), factors * robot.hover_force, DT)
    np.testing.assert_allclose(rollout.states[0, 1], expected, atol=1e-5)
    gains = altered(cage, ThrustMismatch(0.1)).expanded("actuator_gainprm")[:, cage.ctrl, 0]
    correlation = np.corrcoef(gains.T) - np.eye(4)
    assert np.abs(correlation).max() < 4 / np.sqrt(400)
    assert np.abs(gains.std(axis=0) / (0.1 * np.sqrt(0.9733)) - 1).max() < 4 / np.sqrt(800)


def driven(arena, speeds, disturbances, seconds=3.0):
    """Change of place and heading over the last two thirds of a drive without feedback."""
    controls = np.tile(speeds, (round(6 * seconds), 1))
    solution = track(arena.robot, (0.0, -2.5, 0.0), controls, 1 / 6, feedback=False)
    rollout = simulate(arena, solution, disturbances=disturbances)
    assert not rollout.contacts.any()
    return rollout.states[0, -1] - rollout.states[0, len(controls) // 3]


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_larger_wheels_go_further_at_the_same_command(arena, factor):
    usual = driven(arena, (0.2, 0.2), ())
    larger = driven(arena, (0.2, 0.2), [WheelRadiusMismatch(factor=factor)])
    # The wheel's contact is soft by micrometres: a thousandth of what it rolls.
    assert larger[0] / usual[0] == pytest.approx(factor, rel=1e-3)
    assert abs(larger[2]) < 1e-3
    # One larger wheel: the kinematics say the heading, (r_right - r_left) / r * speed / axle * time.
    uneven = driven(arena, (0.2, 0.2), [WheelRadiusMismatch(factor=(1.0, factor))])
    assert uneven[2] == pytest.approx((factor - 1) * 0.2 / 0.258 * 2, rel=0.05)


def test_larger_wheels_stand_on_the_floor_level(arena):
    """The robot neither jumps nor sinks when it begins, and the casters stay clear."""
    still = track(arena.robot, (0.0, -2.5, 0.0), np.zeros((12, 2)), 1 / 6, feedback=False)
    usual = simulate(arena, still)
    for factor in (0.9, 1.1):
        rollout = simulate(arena, still, disturbances=[WheelRadiusMismatch(factor=factor)])
        # As much as with its usual wheels: it settles by a third of a millimetre, until the contacts hold it.
        np.testing.assert_allclose(rollout.frames[0, :, arena.qpos], usual.frames[0, :, arena.qpos], atol=2e-5)


@pytest.mark.parametrize("seed", range(3))
def test_mismatches_of_one_kind_are_one_of_their_product(arena, seed):
    """For all fields that the wheels have, whatever other mismatch comes between."""
    first, second, other = np.random.default_rng(seed).uniform(0.6, 1.5, 3)
    still = track(arena.robot, (0.0, -2.5, 0.0), np.zeros((2, 2)), 1 / 6, feedback=False)
    for kind, between in permutations((WheelRadiusMismatch, AxleMismatch, FrictionMismatch, MassMismatch), 2):
        models = list[list[np.ndarray]]()
        for factors in ((first, other, second), (first * second, other)):
            kinds = (kind, between, kind)
            disturbances = [one(factor=factor) for one, factor in zip(kinds, factors, strict=False)]
            loop = ClosedLoop(plant=arena, plan=still, disturbances=disturbances, frames=False)
            fields = ("geom_size", "body_pos", "geom_friction", "body_mass")
            assert isinstance(loop.physics, MujocoPhysics)
            models.append([loop.physics.simulations.expand(field) for field in fields])
        for one, both in zip(*models, strict=True):
            np.testing.assert_allclose(one, both, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("kind", [AxleMismatch, WheelRadiusMismatch])
@pytest.mark.parametrize("seed", range(3))
def test_wheels_on_struts_are_as_far_apart_as_without(arena, kind, seed):
    """Struts are fixed to the base, and turned; they are a part of the way from the middle to a wheel, or all of it."""
    rng = np.random.default_rng(seed)
    factor, share, angle = rng.uniform(0.8, 1.2), rng.choice([1.0, rng.uniform(0.2, 0.9)]), rng.uniform(-180, 180)
    root, whole = ElementTree.fromstring(load_scene("arena").xml), driven(arena, (0.1, 0.2), [kind(factor=factor)])
    bodies = {body.get("name"): body for body in root.iter("body")}
    base = next(body for body in root.iter("body") if bodies["create_wheel_left"] in list(body))
    for name, at in (("create_wheel_left", 0.129), ("create_wheel_right", -0.129)):
        wheel, turned = bodies[name], ElementTree.Element("frame", euler=f"0 {-angle} 0")
        strut = ElementTree.SubElement(base, "body", pos=f"0 {share * at} 0", euler=f"0 {angle} 0")
        base.remove(wheel)
        wheel.set("pos", f"0 {(1 - share) * at} 0")
        turned.append(wheel)
        strut.append(turned)
    scene = scene_from_xml(ElementTree.tostring(root, encoding="unicode"), "arena")
    on_struts = driven(Plant(DifferentialDrive(), scene), (0.1, 0.2), [kind(factor=factor)])
    np.testing.assert_allclose(on_struts, whole, atol=1e-4)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_longer_axle_turns_more_slowly(arena, factor):
    usual = driven(arena, (-0.1, 0.1), ())
    longer = driven(arena, (-0.1, 0.1), [AxleMismatch(factor=factor)])
    assert longer[2] / usual[2] == pytest.approx(1 / factor, rel=0.01)
    assert usual[2] == pytest.approx(0.2 / 0.258 * 2, rel=0.05)


def test_less_friction_lets_the_robot_slide_further(arena):
    mass = float(arena.model.body_subtreemass[arena.body])
    still = track(arena.robot, (0.0, -2.5, np.pi / 2), np.zeros((18, 2)), 1 / 6, feedback=False)
    for factor in (0.5, 0.8):
        shove = Push((9.0, 0.0, 0.0), at=0.0)  # sideways
        rollout = simulate(arena, still, disturbances=[shove, FrictionMismatch(factor=factor)])
        push, brake = 9.0 * 6 / mass, factor * 9.81
        speed = (push - brake) / 6
        slides = speed / 12 + speed**2 / (2 * brake)
        assert rollout.states[0, -1, 0] == pytest.approx(slides, rel=0.05)


@pytest.mark.parametrize("fixture", ["arena", "cage"])
def test_a_run_begins_off_by_what_it_says(request, fixture):
    plant, solution = request.getfixturevalue(fixture), (weave if fixture == "arena" else hover)(3)
    trials, n = 400, solution.trajectory.states.shape[1]
    std = np.linspace(0.01, 0.03, n)
    rollout = simulate(plant, solution, disturbances=[InitialStateError(std.tolist())], trials=trials)
    off = (rollout.states[:, 0] - solution.trajectory.states[0]) / std
    assert np.abs(off.mean(axis=0)).max() < 4.5 / np.sqrt(trials)
    assert np.abs(off.std(axis=0) - 1).max() < 4.5 / np.sqrt(2 * trials)


def test_obstacles_are_displaced_but_planes_stay_and_heights_in_the_plane(arena, cage):
    for plant, solution in ((arena, weave(2)), (cage, hover(2))):
        std, trials = np.array([0.05, 0.1, 0.2]), 100
        rollout = simulate(plant, solution, disturbances=[DisplacedObstacles(std.tolist())], trials=trials)
        planes = np.array([obstacle.kind == "plane" for obstacle in plant.world.obstacles])
        assert not rollout.displaced[:, planes].any()
        moved = rollout.displaced[:, ~planes] / std
        axes = 2 if plant is arena else 3
        assert not moved[..., axes:].any()
        count = moved[..., 0].size
        assert np.abs(moved[..., :axes].mean(axis=(0, 1))).max() < 4.5 / np.sqrt(count)
        assert np.abs(moved[..., :axes].std(axis=(0, 1)) - 1).max() < 4.5 / np.sqrt(2 * count)


def test_the_robot_hits_obstacles_where_they_are_not_where_the_scene_has_them(arena):
    # Straight at a pillar, which is a metre and a half ahead; clearances below say where it is in each trial.
    ahead = track(arena.robot, (0.0, -2.5, np.pi / 2), np.full((36, 2), 0.2), 1 / 6)
    rollout = simulate(arena, ahead, disturbances=[DisplacedObstacles(0.3)], trials=60, frames=False)
    nearest = rollout.clearance.min(axis=1)
    # Contacts give way by millimetres; between knots the robot may come nearer than at one.
    assert (rollout.contacts[nearest < -1e-3] > 0).all()
    assert (rollout.contacts[nearest > 5e-3] == 0).all()
    assert 10 < (rollout.contacts > 0).sum() < 50


def test_a_scene_without_obstacles_has_none_to_displace(cage, tmp_path):
    text = cage.scene.xml
    spec = mujoco.MjSpec.from_string(text)
    for name in cage.world.names:
        if not name.startswith("wall"):
            spec.delete(next(geom for geom in spec.geoms if geom.name == name))
    spec.compile()
    (tmp_path / "empty.xml").write_text(spec.to_xml())
    bare = Plant(Quadrotor(), load_scene(tmp_path / "empty.xml"))
    assert len(bare.world) > 0
    with pytest.raises(InputError, match=r"^DisplacedObstacles: got scene empty, where robot .* has no obstacles but"):
        simulate(bare, hover(3), disturbances=[DisplacedObstacles(0.1)])


def test_the_wheels_that_a_robot_names_are_in_the_scene():
    class Tricycle(DifferentialDrive):
        wheels = ("create_tread_left", "create_tread_middle")

    with pytest.raises(InputError, match="want its geom 'create_tread_middle'"):
        Plant(Tricycle(), load_scene("arena"))
