"""Bodies that nothing touches: approaches of a robot to them, and plans that move them from nothing."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mjcf.files import DISC, FOREARM, GRIPPER, LEG
from sampling import examples, rarely

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.contacts import Approaches
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.solvers import strategy

DT = 0.02
# The disc with a body that slides, as the forearm's does: a solver for eight states is that of other tests, too.
SLIDE = '<joint name="body_{}" type="slide" axis="{}" damping="20"/>'
SLIDING = DISC.replace('<freejoint name="body"/>', SLIDE.format("x", "1 0 0") + SLIDE.format("y", "0 1 0"))


def robot_of(xml: str, mass: float | None = None) -> ls.MjcfRobot:
    """With another mass of what is to be moved, if one is given."""
    robot = ls.MjcfRobot(scene_from_xml(xml, "touch"))
    return robot if mass is None else robot.with_parameters(body_mass=mass)


def stated(robot: ls.MjcfRobot, state: Array, steps: int, effort: float = 1 / 400, **moves: float) -> ls.Problem:
    """States of a body are to change by so much; nothing else is weighed but the controls."""
    names, space = robot.dynamics.state_coordinates.names, robot.dynamics.control_coordinates
    ends = {name: state[names.index(name)] + way for name, way in moves.items()}
    return ls.Problem(
        dynamics=robot.dynamics, dt=DT, steps=steps, initial=ls.FixedState(state),
        stage_cost=ls.ControlCost([effort] * len(space)), control_limits=(space.low, space.high),
        final_cost=ls.QuadraticCost(dict.fromkeys(moves, 1000.0), about=ends),
    )  # fmt: skip


def moved(robot: ls.MjcfRobot, solution: ls.Solution) -> Array:
    """How far the plan takes the body, of which each period is one of MuJoCo's own, on the file as it is.

    The controls alone would measure how unstable a push is: MuJoCo's contacts of flat sides jump. Where its periods
    from states within 1e-12 of the plan's differ, the plan's may be any of these.
    """
    model, draws = mujoco.MjModel.from_xml_string(robot.scene.xml), np.random.default_rng(0)
    model.opt.tolerance = 1e-14  # of its solver, as in plans; at its default it ends anywhere within 1e-8

    def period(state: Array, control: Array, steps: int = round(DT / model.opt.timestep)) -> Array:
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = robot.configuration(state)
        data.ctrl[:] = control
        for _ in range(steps):
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        return np.concatenate([data.xpos.ravel(), data.qvel])

    plan = solution.trajectory
    for state, control, planned in zip(plan.states[:-1], plan.controls, plan.states[1:], strict=True):
        own, wanted = period(state, control), period(planned, control, 0)
        if not np.allclose(own, wanted, rtol=0, atol=1e-8):
            near = [period(state + 1e-12 * draws.standard_normal(len(state)), control) for _ in range(30)]
            assert (np.abs(own - wanted) <= np.ptp([own, *near], axis=0) + 1e-8).all()
    first, last = (period(state, plan.controls[0], 0) for state in plan.states[[0, -1]])
    body = 3 * model.body("body").id
    return (last - first)[body : body + 3]


@pytest.fixture
def no_further(monkeypatch: pytest.MonkeyPatch) -> None:
    """Solves end with the attempt that moves a body. The others make plans cheaper, and take most of the time."""
    for attempt in ("soften", "alternate", "leave_contact_modes"):
        monkeypatch.setattr(strategy.Softening, attempt, lambda softening: None)


def check_moved(
    robot: ls.MjcfRobot, problem: ls.Problem, way: tuple[float, float, float], *, most: int = 15, missed: float = 0.3
) -> None:
    """The body misses at most a part of its way after so many iterations, by default as many as an approach has."""
    there, wanted = moved(robot, ls.smooth(problem, max_iterations=most)), np.array(way)
    assert np.linalg.norm((there - wanted)[wanted != 0]) < missed * np.linalg.norm(wanted)


SIDES = [(-0.2, 0.0), (0.0, 0.2), (0.2, 0.0), (0.15, 0.15), (-0.1, 0.15), (-0.15, -0.15), (0.1, -0.2)]


@pytest.mark.usefixtures("no_further")
@pytest.mark.parametrize(("x", "y"), SIDES)
@pytest.mark.parametrize("mass", rarely(0.5, 0.2, 1.0))
def test_a_disc_pushes_a_box_to_any_side(x: float, y: float, mass: float) -> None:
    robot = robot_of(DISC, mass)
    problem = stated(robot, robot.at_rest(robot.at()), 50, body_x=x, body_y=y)
    # Friction of 1 kg takes half of the disc's force, and the time is short: plans stop earlier.
    check_moved(robot, problem, (x, y, 0.0), missed=0.3 if mass < 1 else 0.4)


@pytest.mark.usefixtures("no_further")
@pytest.mark.parametrize("mass", rarely(0.2, 0.1, 0.5))
def test_an_arm_pushes_a_puck_away_and_back(mass: float) -> None:
    robot = robot_of(FOREARM, mass)
    for state, way in ((robot.at(b=0.8), 0.15), (robot.at(a=-0.6, b=0.8), -0.15)):
        problem = stated(robot, state, 40, body_y=way)
        check_moved(robot, problem, (0.0, way, 0.0), most=4)


@pytest.mark.usefixtures("no_further")
# Sixteen states, of which no other test has as many. A ball of 0.8 kg would be grazed by the first plan, which counts
# as touched: no approach to it is tried.
@pytest.mark.parametrize("mass", rarely(0.2, 0.4))
def test_a_foot_kicks_a_ball(mass: float) -> None:
    robot = robot_of(LEG, mass)
    problem = stated(robot, robot.at_rest(robot.at(hip=0.3, knee=0.3)), 40, 1e-4, body_x=1.0)
    check_moved(robot, problem, (1.0, 0.0, 0.0), most=30)


@pytest.mark.usefixtures("no_further")
@pytest.mark.parametrize("place", rarely("0 0", "-0.08 0", "0 0.06", "0.05 -0.05"))
@pytest.mark.parametrize("mass", [0.1, *rarely(0.05, 0.2)])
def test_a_gripper_picks_up_a_cube(mass: float, place: str) -> None:
    robot = robot_of(GRIPPER.replace("0 0 0.35", f"{place} 0.35"), mass)
    problem = stated(robot, robot.at_rest(robot.at()), 60, body_z=0.15)
    check_moved(robot, problem, (0.0, 0.0, 0.15))


@settings(max_examples=examples(40))
@given(start=st.floats(-np.pi, np.pi), goal=st.floats(-np.pi, np.pi), far=st.floats(0.2, 0.5))
def test_a_push_goes_round_the_body_to_its_far_side(start: float, goal: float, far: float) -> None:
    robot = robot_of(DISC)
    model = mujoco.MjModel.from_xml_string(robot.scene.xml)
    data, disc, box = mujoco.MjData(model), model.geom("disc").id, model.body("body").geomadr[0]
    there, way = (np.array([np.cos(angle), np.sin(angle)]) for angle in (start, goal))
    x, y = far * there - model.body_pos[model.geom_bodyid[disc], :2]  # joints are 0 where the file has the disc
    state = robot.at(x=x, y=y)
    moves = np.zeros(model.nv)
    moves[2:4] = 0.2 * way
    found = [positions for _, positions in Approaches(robot.mjcf, np.tile(state, (51, 1)), moves)]
    assert found
    for positions in found:
        robots = positions[~np.isnan(positions[:, 0]), :2]
        assert np.isnan(positions[:, 2:]).all()  # the box is not drawn, but to be pushed
        gaps, places = [], []
        for position in robots:
            data.qpos[:2] = position
            mujoco.mj_kinematics(model, data)
            gaps.append(mujoco.mj_geomDistance(model, data, disc, box, 10.0, None))
            places.append(data.geom_xpos[disc, :2] - data.geom_xpos[box, :2])
        touched = 17 if len(robots) < 51 else min((20, 30), key=lambda knot: abs(gaps[knot]))  # of the three times
        # The search for contact and the inverse kinematics are each good to less than a millimetre.
        assert abs(gaps[touched]) < 1e-3
        assert np.linalg.norm(places[touched] / np.linalg.norm(places[touched]) + way) < 0.02
        assert min(gaps[:touched]) > -0.01  # it goes round: the corners of the box are at 1.4 of its half-width
        np.testing.assert_allclose(robots[-1] - robots[touched], 0.2 * way, rtol=0, atol=1e-3)


@pytest.mark.usefixtures("no_further")
def test_what_is_missing_is_said() -> None:
    robot = robot_of(SLIDING.replace('name="disc"', 'name="disc" contype="0" conaffinity="0"'))
    state = robot.at_rest(robot.at())
    solution = ls.smooth(stated(robot, state, 30, body_x=0.2), max_iterations=10)
    assert solution.status is ls.Status.STALLED
    assert "nothing that moves touches body" in solution.detail
    assert "nothing that is driven can collide with it" in solution.detail


@pytest.mark.usefixtures("no_further")
def test_a_push_that_does_not_pay_is_named() -> None:
    robot = robot_of(SLIDING)
    # With twenty times the weight, relative to the controls', it pays.
    cheap, dear = (stated(robot, robot.at_rest(robot.at()), 50, effort, body_y=0.2) for effort in (1 / 400, 1 / 20))
    assert ls.smooth(cheap, max_iterations=4).trajectory.states[-1][3] > 0.1
    solution = ls.smooth(dear, max_iterations=4)
    assert solution.status is ls.Status.STALLED
    assert "a push by disc" in solution.detail
    assert solution.remedy.startswith("raise the weight of body_y")


def test_dynamics_without_bodies_have_no_approaches() -> None:
    dynamics = ls.DifferentialDrive().dynamics
    assert list(dynamics.approaches(np.zeros((2, 3)), np.ones(3))) == []
