"""A robot of balls without a position in a scene: an arm that folds up to pass a post, by the plan and in MuJoCo."""

import dataclasses
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
import pytest
from planar_arm import LINK, PlanarArm

import lqrsim as ls
from lqrsim.commands.solving import tube_under
from lqrsim.control.prediction import Surroundings
from lqrsim.disturbances import ControlNoise, DisplacedObstacles
from lqrsim.errors import Array
from lqrsim.results.goal import OF_WAY

pytestmark = pytest.mark.long  # test_balls.py has what is quick of robots of several balls

START, GOAL = (-0.6, 0.1, 0.1, 0.0, 0.0, 0.0), (1.6, 0.2, -0.3, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> ls.Plant:
    return ls.Plant(PlanarArm(), PlanarArm.scene(tmp_path_factory.mktemp("arm")))


def problem(plant: ls.Plant, world: ls.World) -> ls.Problem:
    """From one side of a post to the other, with these obstacles in mind."""
    balls = plant.robot.balls
    return ls.Problem(
        dynamics=plant.robot.dynamics, dt=0.05, steps=120, initial=ls.FixedState(START),
        stage_cost=ls.ControlCost(np.full(3, 0.05)) + ls.ObstacleCost(world, balls=balls, sharpness=20.0, weight=0.05),
        final_cost=ls.QuadraticCost(np.full(6, 1000.0), about=GOAL),
        constraints=[ls.Clearance(world, balls=balls, margin=0.02)],
    )  # fmt: skip


@pytest.fixture(scope="module")
def plan(plant: ls.Plant) -> ls.Solution:
    return ls.smooth(problem(plant, plant.world))


@pytest.fixture(scope="module")
def blind(plant: ls.Plant) -> ls.Solution:
    """The plan of who knows of no obstacles; the same compiled core."""
    return ls.smooth(problem(plant, ls.World([])))


def distances(plant: ls.Plant, qpos: Array) -> Array:
    """MuJoCo's own, of the nearest link to each obstacle, (..., obstacles), at (..., 3)."""
    model, data = plant.model, mujoco.MjData(plant.model)
    found = []
    for row in qpos.reshape(-1, 3):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        pairs = [
            [
                mujoco.mj_geomDistance(model, data, model.geom(f"link {i}").id, model.geom(name).id, 5.0, None)
                for i in range(3)
            ]
            for name in plant.world.names
        ]
        found.append(np.min(pairs, axis=1))
    return np.reshape(found, (*qpos.shape[:-1], -1))


def test_it_goes_round_and_every_link_is_clear(plant: ls.Plant, plan: ls.Solution) -> None:
    """By the plan and, at each frame between its knots, too, by MuJoCo's distances between geoms."""
    assert plan.success
    assert plan.clearance is not None
    assert plan.clearance[1:].min() >= 0.02
    rollout = ls.simulate(plant, plan)
    assert rollout.outcome == ("reached",)
    assert rollout.target.unit == OF_WAY
    assert distances(plant, rollout.frames[0]).min() > 0
    knots = distances(plant, rollout.states[0][:, :3]).min(axis=1)
    np.testing.assert_array_less(-1e-6, rollout.clearance[0] - knots)
    np.testing.assert_array_less(rollout.clearance[0] - knots, LINK.missed + 1e-6)
    # It is folded up on the way, for stretched out it would not pass.
    assert np.abs(plan.trajectory.states[:, 1:3]).max() > 0.8


def test_who_knows_of_no_obstacle_collides_with_the_first(plant: ls.Plant, blind: ls.Solution) -> None:
    rollout = ls.simulate(plant, blind, contacts=False)
    assert blind.clearance is None
    assert rollout.outcome == ("collided",)
    assert rollout.obstacles == ("near post",)
    fine = np.linspace(0, rollout.times[-1], 5001)
    angles = np.stack([np.interp(fine, rollout.times, rollout.states[0, :, i]) for i in range(3)], axis=1)
    touch = fine[np.argmax(distances(plant, angles).min(axis=1) < 0)]
    # Sensed at each physics step, of 0.01 s; between the knots the angles are not quite straight.
    assert rollout.collided_at[0] == pytest.approx(touch, abs=0.015)
    stopped = ls.simulate(plant, blind)
    assert stopped.collided_at[0] == rollout.collided_at[0]
    assert stopped.contacts[0] > 20


def test_obstacles_elsewhere(plant: ls.Plant, plan: ls.Solution) -> None:
    rollout = ls.simulate(plant, plan, disturbances=[DisplacedObstacles(0.03)], trials=3, frames=False)
    for k in range(3):
        moved = ls.World(
            [
                dataclasses.replace(one, position=one.position + away)
                for one, away in zip(plant.world.obstacles, rollout.displaced[k], strict=True)
            ]
        )
        states = rollout.states[k, ::30]
        centres = PlanarArm().balls.centres(plant.robot.dynamics, states)
        wanted = (moved.distance(centres) - PlanarArm().balls.radii).min(axis=-1)
        np.testing.assert_allclose(rollout.clearance[k, ::30], wanted, rtol=0, atol=1e-9)


def test_clearances_that_chances_of_collision_are_of(plant: ls.Plant, plan: ls.Solution) -> None:
    """The nearest ball's to each obstacle, and its slope; with a position, those of a radius are the same."""
    stated, balls = problem(plant, plant.world), PlanarArm().balls
    surroundings, dynamics = Surroundings.of(stated, 0.02), plant.robot.dynamics
    states = plan.trajectory.states[5:110:15]
    clearance, slope, variance = surroundings.clearances(states)

    def nearest(state: Array) -> Array:
        centres = balls.centres(dynamics, state)
        away = np.array([plant.world.distances(centre) for centre in centres]) - balls.radii[:, None]
        return away.min(axis=0)

    np.testing.assert_allclose(clearance, [nearest(state) for state in states], rtol=0, atol=1e-12)
    assert surroundings.position == (0, 1, 2)
    for state, own in zip(states, slope, strict=True):
        moves = 1e-7 * np.eye(6)[:3]
        wanted = np.stack([(nearest(state + move) - nearest(state - move)) / 2e-7 for move in moves], axis=1)
        np.testing.assert_allclose(own, wanted, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(variance, 0.02**2)


def test_the_chance_of_collision_is_about_how_often_it_collides(plant: ls.Plant, plan: ls.Solution) -> None:
    """Of obstacles that are elsewhere by so much that some runs collide."""
    noise = [DisplacedObstacles(0.06)]
    stated = problem(plant, plant.world)
    tube = ls.predict_tube(stated, plan, ls.uncertainty_of(plant, noise))
    run = ls.simulate(plant, plan, disturbances=noise, trials=200, frames=False, contacts=False)
    rate, std = run.collided.mean(), np.sqrt(run.collided.mean() * (1 - run.collided.mean()) / run.trials)
    assert 0.02 < rate < 0.6
    # The clearance is taken to be linear, and a collision counted when it begins: both err to the safe side here.
    assert rate - 3 * std < tube.collision_chance < 2.5 * (rate + 3 * std)


def test_no_tube_of_a_robot_without_a_position(plant: ls.Plant, plan: ls.Solution) -> None:
    tube, why = tube_under(problem(plant, plant.world), plan, plant, [ControlNoise(0.1)])
    assert tube is None
    assert why == "no predicted tube: the robot has no position"


@dataclasses.dataclass(frozen=True)
class Other(PlanarArm):
    """With balls of another kind."""

    what: object = None

    @cached_property
    def balls(self):  # pyright: ignore
        return self.what


def mirrored(x, p):
    from sympy import cos, sin

    return [[p.length * cos(x[0]), -p.length * sin(x[0]), 0.1]]


@pytest.mark.parametrize(
    ("balls", "said"),
    [
        (ls.CollisionSpheres(mirrored, [0.03], sites=["end 0"], names=["elbow"]), "got 'elbow' at .* has 'end 0' at"),
        (ls.CollisionSpheres(mirrored, [0.03], sites=["link 0"]), "has 'link 0' at"),
        (
            ls.CollisionSpheres(mirrored, [0.03], sites=["end 9"]),
            "got 'end 9', want a site or a geom of the MJCF; it has: end 0",
        ),
        ([0.03], "balls: got .*, want CollisionSpheres"),
    ],
)
def test_balls_that_are_elsewhere_in_mujoco_are_refused(plant: ls.Plant, balls: object, said: str) -> None:
    with pytest.raises(ls.InputError, match=said):
        ls.Plant(Other(what=balls), plant.scene)


def test_what_it_sees_of_a_floor(tmp_path: Path) -> None:
    """It cannot sink to it, so that it is an obstacle as any other."""
    plant = ls.Plant(PlanarArm(), PlanarArm.scene(tmp_path, '<geom name="floor" type="plane" size="3 3 0.1"/>'))
    assert plant.world.names == ("floor",)
    np.testing.assert_allclose(plant.clearance(np.zeros((2, 6))), 0.07, rtol=0, atol=1e-12)


class Long(ls.DifferentialDrive):
    """A drive that pushes a bumper before it: two balls in the plane, turned by its heading."""

    balls = ls.CollisionSpheres(
        lambda x, p: [[x[0], x[1]], [x[0] + 0.25 * _cos(x[2]), x[1] + 0.25 * _sin(x[2])]], [0.17, 0.05]
    )


def _cos(angle):
    from sympy import cos

    return cos(angle)


def _sin(angle):
    from sympy import sin

    return sin(angle)


def test_balls_in_the_plane_of_a_position(differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
    """Seen from above, as the position is; the plan of a rounder robot hits something with the bumper."""
    plant = ls.Plant(Long(), differential_drive.scene)
    around = ls.Plant(ls.DifferentialDrive(), differential_drive.scene)
    assert plant.world.names == around.world.names
    rollout = ls.simulate(plant, drive_solution, trials=2, disturbances=[ControlNoise(0.05)], contacts=False)
    x, y, heading = rollout.states[0].T
    front = np.stack([x + 0.25 * np.cos(heading), y + 0.25 * np.sin(heading)], axis=1)
    flat = plant.world
    wanted = np.minimum(flat.distance(np.stack([x, y], axis=1)) - 0.17, flat.distance(front) - 0.05)
    np.testing.assert_allclose(rollout.clearance[0], wanted, rtol=0, atol=1e-12)
    assert rollout.balls is not None
    np.testing.assert_allclose(rollout.balls.driven[0, :, 1], np.column_stack([front, 0 * x]), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rollout.places(0), rollout.states[0, :, :2])  # its position stands for it
    collides = wanted < 0
    assert rollout.collided[0] == (collides.any() or np.isfinite(rollout.collided_at[0]))
    if collides.any():
        assert rollout.collided_at[0] <= rollout.times[np.argmax(collides)]


def rotors(x, p):
    arms = [(0.2, 0, 0), (0, 0.2, 0), (-0.2, 0, 0), (0, -0.2, 0)]
    return [[a + b for a, b in zip(x[:3], ls.rotations.rotate(x[6:9], arm), strict=True)] for arm in arms]


def test_balls_in_space_that_turn_with_a_position(quadrotor: ls.Scenario) -> None:
    """The derivatives of places by rotation vectors, and costs of them, against differences."""
    balls = ls.CollisionSpheres(rotors, [0.1] * 4)
    problem = dataclasses.replace(
        quadrotor.problem,
        stage_cost=ls.ControlCost(np.ones(4)) + ls.ObstacleCost(quadrotor.scene.world, balls=balls),
        constraints=[ls.Clearance(quadrotor.scene.world, balls=balls)],
    )
    names = quadrotor.problem.dynamics.state_coordinates.names
    assert problem.terms("stage_cost")[1].nonconvex_in == (0, 1, 2, 6, 7, 8), names
    checks = ls.check_derivatives(problem, samples=2)
    assert all(check.good for check in checks), [str(check) for check in checks if not check.good]
    assert any(check.what.startswith("gradient of stage_cost: ObstacleCost") for check in checks)
    assert not any(check.what.startswith("Hessian of stage_cost: ObstacleCost") for check in checks)
