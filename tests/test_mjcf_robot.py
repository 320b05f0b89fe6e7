"""A robot of any MJCF: MuJoCo's own steps, the derivatives of these, and what states and controls are called."""

import os
import pickle
import re
import signal
import threading
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import mechanisms
import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mechanisms import NO_CONTACT, arm, motors, row, scene, sled
from sampling import examples, rarely
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.errors import Array, InputError
from lqrsim.kernels import mjcf_dynamics as kernel
from lqrsim.machine import processors
from lqrsim.problem.parts import terms_of
from lqrsim.problem.state_bounds import LimitCost
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.solvers.compiled import costs_of

SEEDS = st.integers(0, 2**32 - 1)


@cache
def robot_of(kind: str, seed: int, integrator: str | None = None) -> tuple[ls.MjcfRobot, mechanisms.Drawn]:
    drawn = mechanisms.draw(kind, seed, integrator)
    axis = (None, "x", "y", "z")[seed % 4] if kind in ("arm", "box") else None  # those with a ball or free joint
    return ls.MjcfRobot(scene_from_xml(drawn.xml, kind), turns_about=axis), drawn


def near_rest(robot: ls.MjcfRobot, seed: int, size: float = 0.4) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    n, m = len(robot.dynamics.state_coordinates), len(robot.dynamics.control_coordinates)
    return robot.at() + size * rng.normal(size=n), rng.normal(size=m)


def stepped(robot: ls.MjcfRobot, state: Array, control: Array, substeps: int, *, near: Array) -> Array:
    """By MuJoCo's bindings, from `mj_resetData`, with the model that the dynamics are of."""
    model, n = robot.dynamics.physics.model, len(state)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = robot.configuration(state)
    data.act[:] = state[n - model.na :]
    data.ctrl[:] = control
    for _ in range(substeps):
        mujoco.mj_step(model, data)
    after = np.concatenate([robot.state(data.qpos, data.qvel), data.act])
    return robot.dynamics.state_coordinates.nearest(after, near)


@pytest.mark.parametrize("kind", mechanisms.KINDS)
@settings(max_examples=examples(15))
@given(seed=SEEDS)
def test_a_control_period_is_that_many_steps_of_mujoco(kind: str, seed: int) -> None:
    robot, drawn = robot_of(kind, seed)
    state, control = near_rest(robot, seed)
    found = robot.dynamics.step(state, control, 0.005 * drawn.substeps)
    # To rounding: the maps between rotation vectors and quaternions differ in the last bits.
    expected = stepped(robot, state, control, drawn.substeps, near=state)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", mechanisms.KINDS)
@settings(max_examples=examples(10))
@given(seed=SEEDS)
def test_its_derivatives_are_those_of_the_steps(kind: str, seed: int) -> None:
    """Against central differences of whole periods: they differ by what one-sided differences of a step may be off.

    At contacts and limits the width of the differences shows, for these forces have kinks.
    """
    robot, drawn = robot_of(kind, seed)
    state, control = near_rest(robot, seed, 0.1 if kind == "cart" else 0.4)
    if kind == "box":
        state[2] += 3.0
    dt, n = 0.005 * drawn.substeps, len(state)
    A, B, c = robot.dynamics.linearize(state, control, dt)
    joint, columns = np.concatenate([state, control]), []
    for move in 1e-6 * np.eye(len(joint)):
        ahead, behind = joint + move, joint - move
        sides = [stepped(robot, one[:n], one[n:], drawn.substeps, near=state) for one in (ahead, behind)]
        columns.append((sides[0] - sides[1]) / 2e-6)
    expected = np.stack(columns, axis=1)
    size = 1 + np.abs(expected).max()
    np.testing.assert_allclose(np.concatenate([A, B], axis=1), expected, rtol=0, atol=kernel.CURVED * size)
    np.testing.assert_allclose(A @ state + B @ control + c, robot.dynamics.step(state, control, dt), atol=1e-9)


@settings(max_examples=examples(20))
@given(seed=SEEDS)
def test_derivatives_of_a_linear_file_have_a_closed_form(seed: int) -> None:
    """A mass on a spring and a damper, driven through a lag: as MuJoCo's Euler and implicitfast step, damping implicit.

    Differences of a linear step have no error but rounding: 1e-16 of numbers near 1, over 1e-6.
    """
    rng = np.random.default_rng(seed)
    mass, stiffness, damping, gear, lag = (rng.uniform(0.5, 2, 5) * [1, 10, 1, 5, 0.1]).tolist()
    integrator, h, substeps = rng.choice(["Euler", "implicitfast"]), 0.004, int(rng.integers(1, 8))
    xml = sled(
        joint=f'stiffness="{stiffness!r}" damping="{damping!r}"', geom=f'size="0.1" mass="{mass!r}"',
        actuators=f'<general joint="x" gear="{gear!r}" dyntype="filter" dynprm="{lag!r}"/>',
        option=f'timestep="{h}" integrator="{integrator}"',
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "mass"))
    velocity = np.array([-h * stiffness, mass, h * gear, 0.0]) / (mass + h * damping)
    step = np.stack([h * velocity + [1, 0, 0, 0], velocity, [0, 0, 1 - h / lag, h / lag], [0, 0, 0, 1]])
    expected = np.linalg.matrix_power(step, substeps)
    A, B, c = robot.dynamics.linearize(rng.normal(size=3), rng.normal(size=1), substeps * h)
    np.testing.assert_allclose(np.hstack([A, B]), expected[:3], rtol=0, atol=1e-8)
    np.testing.assert_allclose(c, 0, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", ["cage", "arena"])
def test_derivatives_of_the_packaged_robots(name: str) -> None:
    """Against central differences of whole periods; the Create's wheels touch the floor."""
    robot = ls.MjcfRobot(name)
    dynamics, dt = robot.dynamics, robot.dynamics.period_near(0.03)
    start, rng = robot.at(), np.random.default_rng(0)
    n, m = len(start), len(dynamics.control_coordinates)
    joint = np.concatenate([start + 0.02 * rng.normal(size=n), robot.hold(start) + 0.1 * rng.normal(size=m)])
    if name == "arena":
        joint[:n] = start
        for _ in range(30):  # on its wheels, rolling
            joint[:n] = dynamics.step(joint[:n], joint[n:], dt)
    moves = [
        [dynamics.step(one[:n], one[n:], dt) for one in (joint + move, joint - move)] for move in 1e-6 * np.eye(n + m)
    ]
    expected = np.stack([(ahead - behind) / 2e-6 for ahead, behind in moves], axis=1)
    A, B, _ = dynamics.linearize(joint[:n], joint[n:], dt)
    np.testing.assert_allclose(np.hstack([A, B]), expected, rtol=0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("integrator", ["Euler", "implicit", "implicitfast"])
@pytest.mark.parametrize(("kind", "seed"), [("cart", 3), ("wheel", 4)])
def test_they_are_what_mjd_transition_fd_finds(kind: str, seed: int, integrator: str) -> None:
    robot, _ = robot_of(kind, seed, integrator)
    state, control = near_rest(robot, seed, 0.1)
    model, n, m = robot.dynamics.physics.model, len(state), len(control)
    data, A, B = mujoco.MjData(model), np.zeros((n, n)), np.zeros((n, m))
    data.qpos[:], data.qvel[:] = robot.configuration(state)
    data.act[:], data.ctrl[:] = state[n - model.na :], control
    mujoco.mjd_transitionFD(model, data, 1e-6, 1, A, B, None, None)
    found = robot.dynamics.linearize(state, control, 0.005)
    np.testing.assert_allclose(found[0], A, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found[1], B, rtol=0, atol=1e-7)


def test_a_resting_box_is_linearised_through_its_contacts() -> None:
    """The floor's force is stiff: a millimetre deeper is pushed out by what MuJoCo's own differences say."""
    robot, _ = robot_of("box", 1, "Euler")
    state = robot.at()
    for _ in range(300):
        state = robot.dynamics.step(state, np.zeros(2), 0.005)
    assert robot.dynamics.physics.model.opt.tolerance <= 1e-12
    model, data = robot.dynamics.physics.model, mujoco.MjData(robot.dynamics.physics.model)
    A, B = np.zeros((12, 12)), np.zeros((12, 2))
    data.qpos[:], data.qvel[:] = robot.configuration(state)
    mujoco.mj_forward(model, data)
    assert data.ncon >= 3
    mujoco.mjd_transitionFD(model, data, 1e-6, 1, A, B, None, None)
    found, _, _ = robot.dynamics.linearize(state, np.zeros(2), 0.005)
    # Its rotations are of the body, ours entries of a rotation vector, which are the same at no rotation at all.
    assert np.abs(state[3:6]).max() < 1e-6
    np.testing.assert_allclose(found, A, rtol=0, atol=1e-4 * np.abs(A).max())


@pytest.mark.parametrize("integrator", ["RK4", "implicitfast"])
@pytest.mark.parametrize("kind", mechanisms.KINDS)
def test_columns_of_a_helper_have_the_bits_of_ones_own(kind: str, integrator: str) -> None:
    """A helper that computes all columns of a job, a physics step, whichever thread would have got there first
    otherwise. Where the step is curved, it has differences to both sides.
    """
    robot, _ = robot_of(kind, 4, integrator)
    dynamics = robot.dynamics
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    team, job, width = dynamics.physics.team, dynamics.physics._job, n + m
    points = [near_rest(robot, seed) for seed in range(10)]
    alone = [np.hstack(dynamics.linearize(*point, 0.005)[:2]) for point in points]
    helper = threading.Thread(target=dynamics.compiled.help_out, args=(dynamics.data,))
    helper.start()

    def helped(state: Array, control: Array, side: float) -> Array:
        job[0], job[1 : 1 + width], job[1 + width : -n * width] = side, np.concatenate([state, control]), 0
        team[kernel.DONE] = 0
        team[kernel.TICKET] = kernel.JOBS * (team[kernel.TICKET] // kernel.JOBS + 1)
        while team[kernel.DONE] < width:
            assert helper.is_alive()
            time.sleep(1e-4)
        return job[-n * width :].reshape(n, width).copy()

    try:
        for point, jacobian in zip(points, alone, strict=True):
            ahead, behind = helped(*point, 1), helped(*point, -1)
            curved = not np.array_equal(jacobian, ahead)
            assert kind in ("box", "rig") or not curved
            np.testing.assert_array_equal(jacobian, 0.5 * (ahead + behind) if curved else ahead)
    finally:
        team[kernel.STOP] = 1
        helper.join()
        team[kernel.STOP] = 0


@pytest.mark.parametrize("kind", mechanisms.KINDS)
def test_helpers_change_no_bit(kind: str) -> None:
    robot, drawn = robot_of(kind, 11)
    dynamics, dt = robot.dynamics, 0.005 * drawn.substeps
    points = [near_rest(robot, seed) for seed in range(20)]
    alone = [dynamics.linearize(*point, dt) for point in points]
    with dynamics.solving(3):
        assert dynamics.physics.team[kernel.HELPERS] == min(3, processors()) - 1
        together = [dynamics.linearize(*point, dt) for point in points]
    assert dynamics.physics.team[kernel.HELPERS] == 0
    for one, other in zip(alone, together, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_threads_do_not_disturb_each_other() -> None:
    robot, drawn = robot_of("arm", 5)
    points = [near_rest(robot, seed) for seed in range(40)]
    expected = [robot.dynamics.step(*point, 0.005 * drawn.substeps) for point in points]
    found: dict[int, list[Array]] = {}

    def work(which: int) -> None:
        found[which] = [robot.dynamics.step(*point, 0.005 * drawn.substeps) for point in points]

    threads = [threading.Thread(target=work, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    for one in found.values():
        np.testing.assert_array_equal(one, expected)


@pytest.mark.parametrize("kind", mechanisms.KINDS)
@settings(max_examples=examples(20))
@given(seed=SEEDS)
def test_states_and_mujocos_numbers_are_the_same_place(kind: str, seed: int) -> None:
    robot, _ = robot_of(kind, 0)
    rng, nv = np.random.default_rng(seed), robot.scene.model.nv
    states = robot.at() + rng.normal(size=(4, len(robot.dynamics.state_coordinates)))
    qpos, qvel = robot.configuration(states)
    back = robot.state(qpos, qvel, near=states)
    np.testing.assert_allclose(back, states[:, : 2 * nv], rtol=0, atol=1e-9)
    np.testing.assert_allclose(robot.state(qpos[0], qvel[0], near=states[0]), back[0], rtol=0, atol=0)


def test_what_is_not_finite_comes_back_as_nan_and_nothing_is_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    robot, _ = robot_of("cart", 3, "Euler")
    dynamics, state = robot.dynamics, robot.at()
    assert np.isnan(dynamics.step(np.where(np.arange(4) == 2, 1e11, state), np.zeros(1), 0.005)).all()
    # Large enough to blow up within the period.
    assert np.isnan(dynamics.step(state + 9e9, np.full(1, 9e9), 0.02)).all()
    np.testing.assert_array_equal(dynamics.step(state, np.zeros(1), 0.005), dynamics.step(state, np.zeros(1), 0.005))
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_names_units_limits_and_what_wraps() -> None:
    cart, _ = robot_of("cart", 0)
    space, controls = cart.dynamics.state_coordinates, cart.dynamics.control_coordinates
    assert space.names == ("slider", "pole", "slider_velocity", "pole_velocity")
    assert space.units == ("m", "rad", "m/s", "rad/s")
    assert space.angles == (1,)
    assert (controls.names, controls.low, controls.high) == (("push",), (-1.0,), (1.0,))
    arm, _ = robot_of("arm", 0)
    space = arm.dynamics.state_coordinates
    assert space.names[:4] == ("shoulder_rx", "shoulder_ry", "shoulder_rz", "elbow")
    assert space.names[4:] == ("shoulder_wx", "shoulder_wy", "shoulder_wz", "elbow_velocity")
    assert (space.rotation_vectors, space.angles) == ((0,), (3,))
    assert arm.dynamics.control_coordinates.units == ("rad", "rad/s")
    box, _ = robot_of("box", 0)
    space = box.dynamics.state_coordinates
    assert space.names == ("x", "y", "z", "rx", "ry", "rz", "vx", "vy", "vz", "wx", "wy", "wz")
    assert (space.position, space.rotation_vectors, space.plane) == ((0, 1, 2), (3,), "xyz")
    assert box.dynamics.control_coordinates.names == ("unnamed_actuator_0", "unnamed_actuator_1")
    wheel, _ = robot_of("wheel", 0)
    assert wheel.dynamics.state_coordinates.names == ("axle", "axle_velocity", "drive_activation")


def test_states_by_name_and_keyframe() -> None:
    xml = mechanisms.draw("cart", 1).xml.replace(
        "</mujoco>", '<keyframe><key name="tilted" qpos="0.1 0.5" qvel="1 2"/></keyframe></mujoco>'
    )
    robot = ls.MjcfRobot(scene_from_xml(xml, "cart"))
    np.testing.assert_array_equal(robot.at(), np.zeros(4))
    np.testing.assert_array_equal(robot.at(pole=np.pi, slider_velocity=2.0), [0, np.pi, 2, 0])
    np.testing.assert_array_equal(robot.at("tilted"), [0.1, 0.5, 1, 2])
    np.testing.assert_array_equal(robot.at("tilted", slider=0.0), [0, 0.5, 1, 2])
    with pytest.raises(InputError, match=r"keyframe: got 'up', want one of: tilted"):
        robot.at("up")
    with pytest.raises(InputError, match=r"state: got 'hinge', want one of: slider, pole"):
        robot.at(hinge=1.0)


@pytest.mark.parametrize("kind", ["motor", "position", "general"])
@settings(max_examples=examples(10))
@given(seed=SEEDS)
def test_what_holds_an_arm_still_by_inverse_dynamics(kind: str, seed: int) -> None:
    """The acceleration by MuJoCo is zero there; and where a limit is too tight, the joint that is short is told of."""
    rng = np.random.default_rng(seed)
    given = {"motor": 'gear="3"', "position": 'kp="80" kv="2"', "general": 'gainprm="5" gear="-2"'}[kind]
    driven = "".join(f'<{kind} name="a{i}" joint="j{i}" {given}/>' for i in range(3))
    tight = arm(
        *rng.uniform(0.1, 0.3, 3), names=("j0", "j1", "j2"), joint='armature="0.01"',
        joints=('axis="0 1 0"', 'axis="1 1 0"', 'axis="0 1 0"'), actuators=driven, option="",
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(tight, "arm"))
    state = robot.at(None, **{f"j{i}": float(rng.uniform(-1, 1)) for i in range(3)})
    data = mujoco.MjData(robot.scene.model)
    data.qpos[:], data.ctrl[:] = state[:3], robot.hold(state)
    mujoco.mj_forward(robot.scene.model, data)
    np.testing.assert_allclose(data.qacc, 0, rtol=0, atol=1e-6)
    problem = robot.problem(state, state, steps=5)
    np.testing.assert_allclose(problem.nominal_control, robot.hold(state), rtol=1e-9)
    assert "held at rest by: a0" in str(robot)
    assert "is not held" not in str(robot)
    weak = tight.replace(f"<{kind} ", f'<{kind} ctrlrange="-1e-3 1e-3" ')
    weakling = ls.MjcfRobot(scene_from_xml(weak, "arm"))
    data.qpos[:], data.ctrl[:] = weakling.configuration(weakling.at())[0], weakling.hold(weakling.at())
    mujoco.mj_forward(weakling.scene.model, data)
    left = data.qfrc_bias - data.qfrc_passive - data.qfrc_actuator
    worst = int(np.argmax(np.abs(left)))
    assert f"; j{worst} is not held: {abs(left[worst]):.3g} N m are missing" in str(weakling)


@pytest.mark.parametrize(
    "kind",
    [
        '<general gear="-4" dyntype="filter" dynprm="0.05" ctrlrange="-9 9" {}/>',
        '<general gainprm="3" dyntype="filterexact" dynprm="0.02" {}/>',
        '<position kp="60" kv="1" timeconst="0.03" {}/>',
        '<intvelocity kp="80" actrange="-3 3" {}/>',
        '<motor {}/>',
    ],
)  # fmt: skip
@settings(max_examples=examples(5))
@given(seed=SEEDS)
def test_actuators_with_states_hold_what_they_are_said_to(kind: str, seed: int) -> None:
    """Two links in gravity, by plain `mj_step` for half a second from the state that `at` and `at_rest` return."""
    rng = np.random.default_rng(seed)
    xml = arm(
        rng.uniform(0.2, 0.3), 0.2, names=("upper", "fore"), option='integrator="implicitfast"',
        actuators=kind.format('name="first" joint="upper"') + kind.format('name="second" joint="fore"'),
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "arm"))
    model, angles = robot.scene.model, dict(zip(("upper", "fore"), rng.uniform(-1, 1, 2), strict=True))
    state = robot.at(None, **angles)
    np.testing.assert_array_equal(robot.at_rest(state), state)
    with pytest.warns(FutureWarning, match="settled is at_rest now"):
        np.testing.assert_array_equal(robot.settled(state), state)
    data = mujoco.MjData(model)
    data.qpos[:], data.act[:], data.ctrl[:] = state[:2], state[4:], robot.hold(state)
    mujoco.mj_step(model, data, round(0.5 / model.opt.timestep))
    np.testing.assert_allclose(np.concatenate([data.qpos, data.qvel, data.act]), state, rtol=0, atol=1e-9)
    assert "falls short" not in str(robot)
    if model.na:
        named = robot.at(None, **angles, first_activation=0.25)
        np.testing.assert_array_equal(named, [*state[:4], 0.25, state[5]])
    keys = {"bare": "", "driven": 'ctrl="0.2 -0.1"'} | ({"set": 'act="0.3 0"', "zero": 'act="0 0"'} if model.na else {})
    places = " ".join(repr(float(angle)) for angle in angles.values())
    frames = "".join(f'<key name="{name}" qpos="{places}" {more}/>' for name, more in keys.items())
    other = ls.MjcfRobot(scene_from_xml(xml.replace("</mujoco>", f"<keyframe>{frames}</keyframe></mujoco>"), "arm"))
    acts = {"set": [0.3, 0.0], "zero": [0.0, 0.0]}  # a keyframe that states none has those that hold the robot
    for name in keys:
        wanted = [*state[:4], *acts.get(name, state[4:])]
        np.testing.assert_allclose(other.at(name), wanted, rtol=0, atol=1e-12)
        if model.na:
            changed = other.at(name, second_activation=0.5)
            np.testing.assert_allclose(changed, [*wanted[:5], 0.5], rtol=0, atol=1e-12)


@settings(max_examples=examples(10))
@given(seed=SEEDS)
def test_the_robot_is_its_base_where_the_mass_is_in_what_is_fixed_to_it(seed: int) -> None:
    """A chassis that is welded to a base without mass, with wheels: the position is the base's, and so are pushes."""
    rng = np.random.default_rng(seed)
    nested = int(rng.integers(1, 3))
    wheels = "".join(
        f'<body pos="{x} 0.1 0"><joint name="wheel{i}"/><geom size="0.05" mass="0.1"/></body>'
        for i, x in enumerate((0, 1))
    )
    inner = f'<geom size="0.1" mass="2"/>{wheels}'
    for depth in range(nested):
        inner = f'<body name="part{depth}" pos="{rng.uniform(-0.3, 0.3)} 0 0">{inner}</body>'
    xml = scene(f'<body name="base"><freejoint name="root"/>{inner}</body>', '<motor joint="wheel0"/>')
    robot = ls.MjcfRobot(scene_from_xml(xml, "car"))
    space = robot.dynamics.state_coordinates
    assert robot.body == "base"
    assert [space.names[i] for i in space.position] == ["root_x", "root_y", "root_z"]
    assert "body: base, with the position root_x, root_y, root_z" in str(robot)
    assert "unnamed" not in str(robot).split("body:")[1].splitlines()[0]
    with pytest.raises(InputError, match=r"want 2 or 3 that are the position of the body 'part0', among: none"):
        ls.MjcfRobot(robot.scene, body="part0", position=("root_x", "root_y"))
    assert "body: part0, whose position is not among the states" in str(ls.MjcfRobot(robot.scene, body="part0"))


@pytest.mark.parametrize("seed", range(10))
def test_a_position_is_the_place_in_the_world_or_there_is_none(seed: int) -> None:
    """Slides in any order and along some axes, each from a place of its own, with a `ref` that makes up for it or not.

    Where it makes up for all, the states of the position are MuJoCo's `xpos`, and otherwise nothing is a position:
    a robot that is judged by two of three coordinates would reach goals that it is far from.
    """
    rng = np.random.default_rng(seed)
    axes = rng.permutation(3)[: rng.integers(2, 4)]
    place = np.where(rng.random(3) < 0.6, 0.0, rng.uniform(-2, 2, 3).round(3))
    made_up = [rng.random() < 0.5 for _ in axes]
    joints = ""
    for axis, up in zip(axes, made_up, strict=True):
        along, ref = " ".join("1" if i == axis else "0" for i in range(3)), f"ref='{place[axis]}'" if up else ""
        joints += f"<joint name='p{'xyz'[axis]}' type='slide' axis='{along}' {ref}/>"
    body = f"<body name='base' pos='{' '.join(map(str, place))}'>{joints}<geom size='0.1' mass='1'/></body>"
    robot = ls.MjcfRobot(scene_from_xml(scene(body, f"<motor joint='p{'xyz'[axes[0]]}'/>"), "gantry"))
    missing = [axis for axis, up in zip(axes, made_up, strict=True) if place[axis] != 0 and not up]
    position = robot.dynamics.state_coordinates.position
    if missing:
        assert position == ()
        for axis in missing:
            hint = f"p{'xyz'[axis]} is the body's {'xyz'[axis]} minus {place[axis]:.6g} m"
            assert hint in str(robot)
            with pytest.raises(InputError, match=re.escape(hint)):
                ls.MjcfRobot(robot.scene, position=[f"p{'xyz'[axis]}" for axis in axes])
    else:
        model, data = robot.scene.model, mujoco.MjData(robot.scene.model)
        state = robot.at() + np.append(rng.normal(size=len(axes)), np.zeros(len(axes)))
        data.qpos[:] = robot.configuration(state)[0]
        mujoco.mj_kinematics(model, data)
        assert state[list(position)] == pytest.approx(data.body("base").xpos[sorted(axes)], abs=1e-12)


def test_weights_of_a_problem_by_name_and_by_unit() -> None:
    robot, _ = robot_of("cart", 0)
    start, goal = robot.at(pole=1.0), robot.at()
    asked: dict[str, Any] = {"steps": 5, "limits": 0.0, "damping": 0.0}
    by_name = robot.problem(start, goal, weights={"rad": 3.0, "slider": 2.0}, effort={"push": 0.5}, **asked)
    by_number = robot.problem(start, goal, weights=[2.0, 3.0, 0, 0], effort=0.5, **asked)
    assert by_name.digest == by_number.digest
    with pytest.raises(InputError, match=r"weight: got 'N', want one of: slider"):
        robot.problem(start, goal, weights={"N": 1.0})


@pytest.mark.parametrize("field", ["weights", "effort"])
@pytest.mark.parametrize(
    "value", [[[1.0], [1.0, 2.0]], [1.0, [2.0]], [[1.0]], [], "1", -1.0, [-1.0] * 4, np.nan], ids=str
)
def test_what_are_no_weights_of_a_problem(field: str, value: Any) -> None:
    robot, _ = robot_of("cart", 0)
    with pytest.raises(InputError, match=f"^{field}: got "):
        robot.problem(robot.at(pole=1.0), robot.at(), steps=5, **{field: value})


def rov_among(others: str, *, hull: str = "ellipsoid") -> ls.MjcfRobot:
    """A body with eight thrusters, which could turn it in any way while it flies, and what else there is."""
    places = [(x, y) for x in (-0.15, 0.15) for y in (-0.1, 0.1)]
    sites = "".join(f'<site name="{i}" pos="{x} {y} 0"/>' for i, (x, y) in enumerate(places))
    thrusters = "".join(
        f'<motor site="{i}" gear="0.7 {0.7 if x * y > 0 else -0.7} 0 0 0 0" ctrlrange="-35 35"/>'
        f'<motor site="{i}" gear="0 0 1 0 0 0" ctrlrange="-35 35"/>'
        for i, (x, y) in enumerate(places)
    )
    bodies = f"""<body name="rov" pos="0 0 1" gravcomp="1"><freejoint name="rov"/>
      <geom type="{hull}" mass="11.5" size="0.25 0.18 0.13"/>{sites}</body>{others}"""
    water = 'timestep="0.02" integrator="implicitfast" density="1000" viscosity="0.001"'
    return ls.MjcfRobot(scene_from_xml(scene(bodies, thrusters, option=water), "rov"), body="rov")


@pytest.mark.parametrize("clearance", rarely(0.2, None))
def test_a_free_body_passes_pillars(clearance: float | None) -> None:
    """With a clearance that the plan without one does not have; an arrival within its own size needs no second search.

    Without curvature the interior point goes up and down by 1e-4 of the cost here; what converges are multipliers.
    """
    pillars = ((1.6, 0.15, 0.35), (3.4, -0.35, 0.35))
    robot = rov_among("".join(f'<geom type="cylinder" size="{r} 2" pos="{x} {y} 2"/>' for x, y, r in pillars))
    goal = robot.at(rov_x=5.0, rov_y=0.3, rov_z=1.4)
    problem = robot.problem(robot.at(), goal, steps=40, dt=0.2, clearance=clearance)
    solution = ls.smooth(problem, max_iterations=80, threads=1)
    assert solution.status is ls.Status.CONVERGED, solution
    assert not [one for one in solution.candidates if "times the weight" in one.start]
    model, data = robot.scene.model, mujoco.MjData(robot.scene.model)
    apart = []
    for state in solution.trajectory.states:
        data.qpos[:] = robot.configuration(state)[0]
        mujoco.mj_kinematics(model, data)
        apart += [mujoco.mj_geomDistance(model, data, 0, geom, 9.0, None) for geom in range(1, model.ngeom)]
    # MuJoCo's distances are good to some 1e-6 m.
    assert min(apart) > (-1e-5 if clearance is None else clearance - 1e-5)
    if clearance is not None:
        assert min(apart) == pytest.approx(clearance, abs=1e-5)


@pytest.mark.long  # what is compiled for it takes 6 s
def test_a_plan_along_which_flat_sides_lie_along_pillars_ends() -> None:
    """The optimum is at kinks of distances, where no gradient vanishes, though no clearance acts.

    Of plans by other controls, which smooth random changes make, none is cheaper by more than the tolerance.
    """
    pillars = ((1.5, 0.2, 0.2), (3.0, -0.3, 0.2))
    others = "".join(f'<geom type="cylinder" size="{r} 2" pos="{x} {y} 2"/>' for x, y, r in pillars)
    robot = rov_among(others, hull="box")
    problem = robot.problem(robot.at(), robot.at(rov_x=4.0), steps=40, dt=0.2, clearance=0.05)
    solution = ls.smooth(problem, starts=1, max_iterations=60, threads=1)
    assert solution.status is ls.Status.CONVERGED, solution
    assert solution.clearance is not None
    assert solution.clearance.min() > 0.05
    draws, states, controls = np.random.default_rng(0), [], []
    for size in (0.0, *np.geomspace(1e-4, 1.0, 40)):
        change = size * np.cumsum(draws.normal(size=(40, 8)), axis=0) / 6.0
        xs, us = [solution.trajectory.states[0]], []
        for t, known in enumerate(solution.trajectory.controls):
            fed_back = solution.policy.gain[t] @ (xs[-1] - solution.trajectory.states[t])
            us.append(np.clip(known + fed_back + change[t], -35.0, 35.0))
            xs.append(robot.dynamics.step(xs[-1], us[-1], problem.dt))
        states.append(xs)
        controls.append(us)
    costs = costs_of(problem, np.array(states), np.array(controls))
    assert costs[0] == pytest.approx(solution.cost, rel=1e-9)
    assert costs.min() > solution.cost * (1 - 1e-4)


@pytest.mark.parametrize("turn", [6.1, *rarely(5.0, 2 * np.pi, 6.5, 8.0)])
def test_a_plan_that_comes_near_a_whole_turn_says_so(turn: float) -> None:
    """There a tilt of 0.02 rad is at least 0.3 rad of the rotation vector: |r| / (2 sin(|r| / 2)) times as much."""
    motors = "".join(f'<motor joint="b" gear="{gear}"/>' for gear in ("1 0 0", "0 1 0", "0 0 1"))
    xml = row(
        "b", joint='type="ball" damping="0.1"', geom='type="box" size="0.1 0.1 0.1" mass="5"',
        actuators=motors, option='timestep="0.02" gravity="0 0 0" integrator="implicitfast"',
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "ball"))
    goal = robot.at(b_rx=0.6 * turn, b_rz=0.8 * turn)
    solution = ls.smooth(robot.problem(robot.at(), goal, steps=50, dt=0.04, weights=1e4))
    assert solution.status is ls.Status.CONVERGED
    states, space, amplified = solution.trajectory.states, robot.dynamics.state_coordinates, []
    for state in states:
        tilted = np.zeros(4)
        mujoco.mju_mulQuat(tilted, robot.configuration(state)[0], np.array([np.cos(0.01), 0.0, np.sin(0.01), 0.0]))
        amplified.append(np.linalg.norm(space.difference(robot.state(tilted, np.zeros(3)), state)[:3]))
    said = re.search(r"at ([\d.e-]+) s b_rx, b_ry, b_rz are ([\d.e-]+) rad from a whole turn", solution.detail)
    assert (said is not None) == (max(amplified) > 0.3), solution.detail
    assert (said is not None) == (turn > 6)
    if said:
        knot = round(float(said[1]) / 0.04)
        off = abs(np.linalg.norm(states[knot, :3]) - 2 * np.pi)
        assert float(said[2]) == pytest.approx(off, rel=0.05)
        assert off <= np.abs(np.linalg.norm(states[:, :3], axis=1) - 2 * np.pi).min()


CRATE = '<body name="crate" pos="0 3 1" gravcomp="1"><freejoint name="crate"/><geom size="0.1"/></body>'


def past_a_crate(robot: ls.MjcfRobot) -> ls.Problem:
    goal = robot.at(rov_x=5.0, rov_y=0.3, rov_z=1.4, rov_rz=0.5)
    return robot.problem(robot.at(), goal, steps=80, dt=0.1)


@pytest.mark.long
def test_a_free_body_does_not_tumble_on_its_way() -> None:
    robot = rov_among(CRATE)
    solution = ls.smooth(past_a_crate(robot), max_iterations=40, starts=1, threads=1)
    assert solution.status is ls.Status.CONVERGED
    first = robot.dynamics.state_coordinates.names.index("rov_rx")
    assert np.linalg.norm(solution.trajectory.states[:, first : first + 3], axis=1).max() < 1.0


def test_tumbling_costs_a_free_body_and_nothing_what_it_handles() -> None:
    robot = rov_among(CRATE)
    problem, names = past_a_crate(robot), robot.dynamics.state_coordinates.names
    (calm,) = (one for one in terms_of(problem.stage_cost) if isinstance(one, ls.QuadraticCost))
    weights = dict(zip(names, np.diag(calm.weight), strict=True))
    assert {name: weight for name, weight in weights.items() if weight} == {
        "rov_rx": 0.1, "rov_ry": 0.1, "rov_rz": 0.1, "rov_wx": 0.05, "rov_wy": 0.05, "rov_wz": 0.05,
    }  # fmt: skip
    np.testing.assert_array_equal(calm.about, np.where(np.array(names) == "rov_rz", 0.5, 0.0))


def over_floor(rng: np.random.Generator) -> str:
    """An arm of three hinges, lengths drawn, that can strike the floor and itself."""
    return arm(
        *rng.uniform(0.25, 0.45, 3), joint='axis="0 -1 0" damping="0.3" armature="0.02"', geom='size="0.035"', gap=0.1,
        geoms=('mass="3"', 'mass="2"', 'mass="1"'), place="0 0 0.3",
        things='<geom name="floor" type="plane" size="3 3 0.1"/>',
    )  # fmt: skip


@pytest.mark.parametrize("seed", [3, 8, 11, 13])
def test_an_arm_that_swings_onto_the_floor_at_first_follows_a_line_of_states(seed: int) -> None:
    """Smoothing fails from the controls that hold it: its first plan strikes the floor, or the arm itself."""
    rng = np.random.default_rng(seed)
    robot = ls.MjcfRobot(scene_from_xml(over_floor(rng), "arm"), obstacles=False)

    def free() -> Array:
        while True:
            drawn = dict(zip("abc", rng.uniform([0.0, -2.2, -2.2], [np.pi, 2.2, 2.2]), strict=True))
            if not robot.dynamics.touches(robot.at(**drawn)[None]):
                return robot.at(**drawn)

    start, goal = free(), free()
    problem = robot.problem(start, goal, steps=50, dt=0.02)
    heard: list[Any] = []
    solution = ls.smooth(problem, threads=1, callback=heard.append)
    assert solution.status is ls.Status.CONVERGED
    assert len(set(heard)) == len(heard)  # each once, of both starts
    assert set(solution.iterations) <= set(heard)
    assert solution.cost < ls.ilqr(problem, max_iterations=100).cost  # which stays on the floor
    assert [one.start for one in solution.candidates] == ["nominal control", "a line of states"]
    assert not robot.dynamics.touches(solution.trajectory.states)


@settings(max_examples=examples(4))
@given(seed=SEEDS)
def test_an_arm_that_is_to_stay_where_it_is_has_nothing_to_do(seed: int) -> None:
    """The least cost is zero; by MuJoCo's rounding, that of the arm's friction included, the plan's is about 1e-20."""
    rng = np.random.default_rng(seed)
    friction = f'frictionloss="{rng.uniform(0, 0.1)}" ' if rng.random() < 0.5 else ""
    xml = over_floor(rng).replace("<joint ", f"<joint {friction}", 1)
    robot = ls.MjcfRobot(scene_from_xml(xml, "arm"), obstacles=False)
    state = robot.at(a=rng.uniform(1.0, 2.0), b=rng.uniform(-0.5, 0.5), c=rng.uniform(-0.5, 0.5))
    solution = ls.smooth(robot.problem(state, state, steps=50, dt=0.02), threads=1)
    assert solution.status is ls.Status.CONVERGED
    assert len(solution.candidates) <= 1
    assert len(solution.iterations) <= 5
    assert abs(solution.trajectory.states - state).max() < 1e-6


@settings(max_examples=examples(8))
@given(seed=SEEDS)
def test_a_robot_above_its_support_is_let_down(seed: int) -> None:
    """A body on two feet over a floor or a table, at any height and heading: plain `mj_step` leaves it where it is."""
    rng = np.random.default_rng(seed)
    feet = "".join(
        f'<body pos="{x} 0 -.2"><joint name="{name}" axis="0 1 0" damping="1"/>'
        '<geom type="box" size=".06 .1 .02" pos="0 0 -.1" mass=".3"/></body>'
        for name, x in (("fore", rng.uniform(0.1, 0.2)), ("hind", -rng.uniform(0.1, 0.2)))
    )
    top = rng.uniform(-0.2, 0.3)
    xml = sled(
        "", place="0 0 1", geom='type="box" size=".2 .1 .05" mass="2"', carried=f"<freejoint/>{feet}",
        things=f'<geom name="table" type="box" size="2 2 .01" pos="0 0 {top - 0.01}"/>',
        actuators='<position joint="fore" kp="80"/><position joint="hind" kp="80"/>',
        option='integrator="implicitfast"',
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "stand"), obstacles=False)
    state = robot.at_rest(robot.at(z=top + rng.uniform(0.33, 0.8), rz=rng.uniform(-3, 3)))
    model = robot.scene.model
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = robot.configuration(state)[0], robot.hold(state)
    place = data.qpos.copy()
    mujoco.mj_step(model, data, round(0.3 / model.opt.timestep))
    # The feet carry 2.6 kg without moving; the contacts' springs settle by micrometres.
    np.testing.assert_allclose(data.qpos, place, rtol=0, atol=2e-5)
    with pytest.raises(InputError, match="touches its support, or is above it"):
        robot.at_rest(robot.at(z=top - 2))
    with pytest.raises(InputError, match="obstacles such as table carry nothing: obstacles= chooses others"):
        ls.MjcfRobot(scene_from_xml(xml, "stand")).at_rest(robot.at(z=top + 1))


@settings(max_examples=examples(8))
@given(seed=SEEDS)
def test_muscles_hold_by_pulling_at_most_as_much_as_they_can(seed: int) -> None:
    """Two of them, one against the other, with or without a range of their own: by `mj_step` the limb stays for 0.2 s.

    MuJoCo passes on only controls in 0..1, and with less the muscle on the other side would have to push.
    """
    rng = np.random.default_rng(seed)
    limited = rng.choice(["", 'ctrllimited="true" ctrlrange="-1 2"', 'ctrllimited="true" ctrlrange="0.05 0.9"'])
    places = {"a": -rng.uniform(0.04, 0.06), "b": rng.uniform(0.04, 0.06)}
    sites = {one: "".join(f'<site name="{one}{k}" pos="{x} 0 {z}"/>' for k, x in places.items())
             for one, z in (("top", 0.3), ("limb", -0.1))}  # fmt: skip
    muscles = "".join(f'<muscle name="{k}" tendon="{k}" lengthrange="0.3 0.5" force="40" {limited}/>' for k in places)
    tendons = "".join(f'<spatial name="{k}"><site site="top{k}"/><site site="limb{k}"/></spatial>' for k in places)
    xml = arm(
        0.3, along=(0, 0, -1), names=["hinge"], joint='axis="0 1 0" damping="0.5"', geom='size="0.02" mass="0.5"',
        end=sites["limb"], things=sites["top"], more=f"<tendon>{tendons}</tendon>", actuators=muscles,
        option='timestep="0.002" integrator="implicitfast"',
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "limb"))
    space = robot.dynamics.control_coordinates
    state = robot.at(hinge=rng.uniform(-0.2, 0.2))
    control, data = robot.hold(state), mujoco.MjData(robot.scene.model)
    least, most = (0.05, 0.9) if "0.05" in limited else (0.0, 1.0)
    assert (space.low, space.high) == ((least,) * 2, (most,) * 2)
    assert ((control >= least) & (control <= most)).all()
    data.qpos[:], data.act[:], data.ctrl[:] = state[:1], state[2:], control
    mujoco.mj_step(robot.scene.model, data, 100)
    np.testing.assert_allclose(data.qpos, state[:1], rtol=0, atol=1e-6)
    np.testing.assert_allclose(data.act, state[2:], rtol=0, atol=1e-12)


def test_cables_that_only_pull_hold_a_platform_with_winches_that_lag() -> None:
    """Four cables to a mass in a plane: of the tensions that hold it, all within their limits, by `mj_step`."""
    sites = {"a": (-2, 3), "b": (2, 3), "c": (-2, 0), "d": (2, 0)}
    places = "".join(f'<site name="{name}" pos="{x} 0 {z}"/>' for name, (x, z) in sites.items())
    cables = "".join(f'<spatial name="{name}"><site site="{name}"/><site site="hook"/></spatial>' for name in sites)
    lag = 'gear="-1" dyntype="filter" dynprm="0.05" ctrlrange="2 90"'
    winches = "".join(f'<general tendon="{name}" {lag}/>' for name in sites)
    xml = sled(
        "xz", place="0 0 1.5", geom=f'size="0.1" mass="3" {NO_CONTACT}', carried='<site name="hook"/>', things=places,
        more=f"<tendon>{cables}</tendon>", actuators=winches, option="",
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "cables"))
    state = robot.at(x=-0.7, z=-0.4)
    held, data = robot.hold(state), mujoco.MjData(robot.scene.model)
    assert (held >= 2).all()
    np.testing.assert_allclose(state[4:], held, rtol=1e-12)
    data.qpos[:], data.act[:], data.ctrl[:] = state[:2], state[4:], held
    mujoco.mj_forward(robot.scene.model, data)
    np.testing.assert_allclose(data.qacc, 0, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(robot.at_rest(state)[:2], state[:2])  # winches drive it


@settings(max_examples=examples(10))
@given(seed=SEEDS)
def test_fingers_that_are_coupled_follow_and_are_held(seed: int) -> None:
    """Two fingers that one motor moves; against gravity and each other's weight, by MuJoCo's own steps."""
    rng = np.random.default_rng(seed)
    offset, ratio = rng.uniform(-0.02, 0.02), rng.choice([-1.0, 1.0, 0.5])
    tie = f'<joint joint1="right" joint2="left" polycoef="{offset} {ratio}" solref="0.005 1"/>'
    xml = row(
        ("left", "right"), joint='type="slide" axis="0 0 1" damping="5"', geoms=('mass="0.2"', 'mass="0.3"'),
        more=f"<equality>{tie}</equality>", actuators='<motor name="grip" joint="left"/>',
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "gripper"), position=())
    state = robot.at(left=0.05)
    np.testing.assert_allclose(state, [0.05, offset + ratio * 0.05, 0, 0], rtol=1e-12)
    np.testing.assert_allclose(robot.hold(state), 9.81 * (0.2 + ratio * 0.3), rtol=1e-6)
    after = robot.dynamics.step(state, robot.hold(state), 0.1)
    # The constraint is soft: what it carries of the other finger moves it by less than a millimetre.
    np.testing.assert_allclose(after[:2], state[:2], rtol=0, atol=1e-3)


INTEGRATING = '<general name="drive" joint="hinge" dyntype="integrator" gainprm="{gain}" biastype="affine"'


@settings(max_examples=6)
@given(seed=SEEDS, above=st.booleans())
def test_an_integrator_whose_control_is_never_zero_rests_at_the_end_of_its_range_or_drifts(
    seed: int, above: bool
) -> None:
    """By `mj_step` for half a second: with a range of activations it stays, and without one nothing is said to hold."""
    rng = np.random.default_rng(seed)
    low, high = np.sort(rng.uniform(0.1, 2.0, 2)) if above else -np.sort(-rng.uniform(-2.0, -0.1, 2))[::-1]
    end, gain = rng.uniform(0.2, 0.8), rng.uniform(20, 60)
    servo = INTEGRATING.format(gain=gain) + f' biasprm="0 -{gain} -2" ctrlrange="{low} {high}" '
    xml = row(
        ["hinge"], joint='axis="0 1 0" damping="0.5"', geom='size="0.05" pos="0 0 -0.3" mass="0.5"',
        actuators=f"{servo} {{}}/>", option='integrator="implicitfast"',
    )  # fmt: skip
    drifting = ls.MjcfRobot(scene_from_xml(xml.format(""), "drift"))
    state, model = drifting.at(hinge=0.3), drifting.scene.model
    (control,) = drifting.hold(state)
    assert control == pytest.approx(low if above else high)
    said = f"the activation of drive drifts: its control is at {'least' if above else 'most'} {control:g}"
    assert said in str(drifting)
    with pytest.raises(InputError, match="got one at which the activation of drive drifts"):
        drifting.at_rest(state)
    # With the range of its activation, one angle can be held: where its end balances the weight.
    reached = f'actrange="{-end if above else -0.9} {0.9 if above else end}"'
    resting = ls.MjcfRobot(scene_from_xml(xml.format(reached), "rest"))
    level = 0.9 if above else -0.9
    angle = level
    for _ in range(200):  # a contraction: the weight is less than the servo's stiffness
        angle = level - 0.5 * 9.81 * 0.3 * np.sin(angle) / gain
    state, model = resting.at(hinge=angle), resting.scene.model
    assert "drifts" not in str(resting)
    assert state[2] == level
    data = mujoco.MjData(model)
    data.qpos[:], data.act[:], data.ctrl[:] = angle, level, resting.hold(state)
    mujoco.mj_step(model, data, round(0.5 / model.opt.timestep))
    np.testing.assert_allclose([data.qpos[0], data.qvel[0], data.act[0]], [angle, 0, level], rtol=0, atol=1e-9)
    assert low <= resting.hold(state)[0] <= high


def five_bar(rng: np.random.Generator, tie: str = "connect") -> str:
    """Two arms of two links in a vertical plane, whose tips are tied; motors at both shoulders."""
    apart, upper, rise = rng.uniform(0.05, 0.12), rng.uniform(0.15, 0.25), rng.uniform(0.15, 0.25)
    arms = "".join(
        f'<body pos="{-side * apart} 0 0"><joint name="{name}" axis="0 1 0" damping="0.2" armature="0.01"/>'
        f'<geom type="capsule" fromto="0 0 0 0 0 {upper}" size="0.01" mass="{rng.uniform(0.1, 0.4)}" {NO_CONTACT}/>'
        f'<body name="{name}_link" pos="0 0 {upper}"><joint name="{name}_elbow" axis="0 1 0" damping="0.05"/>'
        f'<geom type="capsule" fromto="0 0 0 {side * apart} 0 {rise}" size="0.01" mass="0.1" {NO_CONTACT}/>'
        f'<site name="{name}_tip" pos="{side * apart} 0 {rise}"/></body></body>'
        for name, side in (("left", 1.0), ("right", -1.0))
    )
    ties = {
        "connect": f'<connect name="tie" body1="left_link" body2="right_link" anchor="{apart} 0 {rise}"/>',
        "sites": '<connect name="tie" site1="left_tip" site2="right_tip"/>',
    }
    driven, tied = motors(("left", "right"), (3, 3)), f"<equality>{ties[tie]}</equality>"
    return scene(arms, driven, more=tied, option='integrator="implicitfast"')


@pytest.mark.parametrize("tie", ["connect", "sites"])
@settings(max_examples=1)
@given(seed=SEEDS)
def test_a_closed_loop_closes_is_held_and_is_moved_by_a_plan(seed: int, tie: str) -> None:
    """Tips by MuJoCo's kinematics; torques by virtual work, of differences of the potential energy along the loop."""
    rng = np.random.default_rng(seed)
    robot = ls.MjcfRobot(scene_from_xml(five_bar(rng, tie), "five-bar"))
    model, left, right = robot.scene.model, *rng.uniform(-0.3, 0.3, 2)
    data = mujoco.MjData(model)

    def energy(left: float, right: float) -> float:
        """Potential energy where the loop is closed, in J."""
        data.qpos[:] = robot.configuration(robot.at(left=left, right=right))[0]
        mujoco.mj_kinematics(model, data)
        tips = data.site("left_tip").xpos, data.site("right_tip").xpos
        np.testing.assert_allclose(*tips, rtol=0, atol=1e-9)
        return float(9.81 * model.body_mass @ data.xipos[:, 2])

    state, goal = robot.at(left=left, right=right), robot.at(left=right, right=left)
    assert (state[0], state[2]) == (left, right)
    for pose in (state, goal):  # where the elbows meet, the tips turn about them, and no torque holds them
        data.qpos[:] = pose[:4]
        mujoco.mj_kinematics(model, data)
        assume(data.body("right_link").xpos[0] - data.body("left_link").xpos[0] > 0.04)
    step = 1e-4
    work = [
        (energy(left + step, right) - energy(left - step, right)) / (2 * step),
        (energy(left, right + step) - energy(left, right - step)) / (2 * step),
    ]
    np.testing.assert_allclose(robot.hold(state), work, rtol=0, atol=1e-6)
    assert "falls short" not in str(robot)
    plan = ls.smooth(robot.problem(state, goal, steps=30))
    assert plan.success
    np.testing.assert_allclose(plan.trajectory.states[-1, :4], goal[:4], rtol=0, atol=0.02)
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = state[:4], 0.0, 0.0
    for control in plan.trajectory.controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data, round(plan.trajectory.dt / model.opt.timestep))
    # The robot's physics solves the constraint to 1e-14, MuJoCo by default to 1e-8.
    np.testing.assert_allclose(data.qpos, plan.trajectory.states[-1, :4], rtol=0, atol=1e-4)


@settings(max_examples=4)
@given(seed=SEEDS)
def test_welds_and_tendons_hold_joints_together(seed: int) -> None:
    """Two arms of three links with one hand, by MuJoCo's kinematics; two fingers that a tendon keeps symmetric."""
    rng = np.random.default_rng(seed)
    arms = "".join(
        f'<body pos="{x} 0 0"><joint name="{s}1" axis="0 1 0"/><geom size="0.02" {NO_CONTACT}/><body pos="0 0 0.3">'
        f'<joint name="{s}2" axis="0 1 0"/><geom size="0.02" {NO_CONTACT}/><body name="{s}" pos="{-x} 0 0.3">'
        f'<joint name="{s}3" axis="0 1 0"/><geom size="0.05" {NO_CONTACT}/></body></body></body>'
        for s, x in (("l", -0.1), ("r", 0.1))
    )
    xml = scene(arms, motors(("l1", "r1", "l3")), more='<equality><weld body1="l" body2="r"/></equality>')
    robot = ls.MjcfRobot(scene_from_xml(xml, "arms"))
    state, data = robot.at(l1=rng.uniform(-0.3, 0.3), r1=rng.uniform(-0.3, 0.3)), mujoco.MjData(robot.scene.model)
    data.qpos[:] = robot.configuration(state)[0]
    mujoco.mj_forward(robot.scene.model, data)
    for side in (data.body("l"), data.body("r")):
        np.testing.assert_allclose(side.xpos, data.body("l").xpos, rtol=0, atol=1e-9)
        np.testing.assert_allclose(side.xmat, data.body("l").xmat, rtol=0, atol=1e-9)
    assert "falls short" not in str(robot)
    geoms, ratio = [f'pos="{far} 0 0"' for far in rng.uniform(0.1, 0.3, 2)], rng.uniform(0.5, 2.0)
    tendon = f'<fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="{ratio}"/></fixed>'
    xml = row(
        "ab", joint='axis="0 1 0" damping="1"', geom=f'size="0.05" mass="0.2" {NO_CONTACT}', geoms=geoms,
        more=f'<tendon>{tendon}</tendon><equality><tendon tendon1="t"/></equality>', actuators='<motor joint="a"/>',
    )  # fmt: skip
    fingers = ls.MjcfRobot(scene_from_xml(xml, "fingers"))
    state = fingers.at(a=0.4)
    assert state[1] == pytest.approx(-0.4 / ratio, abs=1e-9)
    after = fingers.dynamics.step(state, fingers.hold(state), 0.2)
    np.testing.assert_allclose(after[:2], state[:2], rtol=0, atol=5e-3)  # soft


def test_loops_that_can_not_close_and_couplings_that_bend() -> None:
    robot = ls.MjcfRobot(scene_from_xml(five_bar(np.random.default_rng(0)), "five-bar"))
    with pytest.raises(InputError, match=r"joints: got left -1.5, right 1.5, want positions at which all loops close"):
        robot.at(left=-1.5, right=1.5)
    cam = '<equality><joint joint1="a" joint2="b" polycoef="0.1 1 2"/></equality>'
    bent = ls.MjcfRobot(scene_from_xml(row("ab", more=cam, actuators='<motor joint="a"/>'), "cam"))
    np.testing.assert_allclose(bent.at(b=0.3)[:2], [0.1 + 0.3 + 2 * 0.3**2, 0.3], rtol=0, atol=1e-9)


def tied(kind: str, rng: np.random.Generator) -> str:
    """An MJCF with equality constraints: a five-bar, a swinging plate, or arms that another one follows."""
    if kind == "connect":
        return five_bar(rng)
    if kind == "plate":  # on two rods by ball joints, which a lever in the middle moves
        ends = rng.uniform(0.1, 0.3, 2).tolist()
        rods = "".join(
            f'<body name="rod{i}" pos="{x} 0 0"><joint type="ball"/>'
            f'<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.01" {NO_CONTACT}/></body>'
            for i, x in enumerate((-ends[0], ends[1]))
        )
        ties = "".join(f'<connect body1="rod{i}" body2="plate" anchor="0 0 -0.3"/>' for i in range(2))
        moved = '<body><joint name="lever" axis="1 0 0"/><geom size="0.05"/></body>'
        plate = (
            f'<body name="plate" pos="0 0 -0.3"><freejoint/><geom type="box" size="0.3 0.05 0.01" {NO_CONTACT}/></body>'
        )
        return scene(rods + moved + plate, motors(["lever"]), more=f"<equality>{ties}</equality>")
    ratio = rng.uniform(0.5, 2.0)
    held = {
        "joint": f'<joint joint1="a" joint2="b" polycoef="0 {ratio} {rng.uniform(-1, 1)}"/><joint joint1="c"/>',
        "linear": f'<joint joint1="a" joint2="b" polycoef="0.1 {ratio}"/>',
        "weld": '<weld body1="hand"/>',
        "tendon": '<tendon tendon1="t"/>',
    }[kind]
    tendon = f'<fixed name="t"><joint joint="a" coef="1"/><joint joint="c" coef="{ratio}"/></fixed>'
    more = f"<tendon>{tendon}</tendon><equality>{held}</equality>"
    return arm(
        0.3, 0.3, 0.3, along=(0, 0, 1), joint='axis="0 1 0"', more=more, actuators='<motor joint="b"/>', option=""
    )


@pytest.mark.parametrize("kind", ["connect", "plate", "joint", "linear", "weld", "tendon"])
@settings(max_examples=2)
@given(seed=SEEDS)
def test_an_error_of_the_start_leaves_loops_closed(kind: str, seed: int) -> None:
    """By MuJoCo's constraints; what is drawn is what the robot without the constraints begins with."""
    rng, trials = np.random.default_rng(seed), 3
    xml = tied(kind, rng)
    loose = re.sub("<equality>.*</equality>", "", xml, flags=re.DOTALL)
    robots = [ls.MjcfRobot(scene_from_xml(text, kind)) for text in (xml, loose)]
    n, model = len(robots[0].dynamics.state_coordinates), robots[0].scene.model
    error = ls.disturbances.InitialStateError(rng.uniform(0.005, 0.02, n))
    plan = ls.Trajectory(np.tile(robots[0].at(), (2, 1)), np.zeros((1, len(robots[0].actuators))), dt=0.02)
    effects = [
        error.start(ls.Plant(robot, robot.scene), plan, [np.random.default_rng((seed, i)) for i in range(trials)])
        for robot in robots
    ]
    begun, drawn = (one.initial_states(np.tile(plan.states[0], (trials, 1))) for one in effects if one.initial_states)
    model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    data, changes = mujoco.MjData(model), list[float]()
    for state, first in zip(begun, drawn, strict=True):
        wanted, _ = robots[0].configuration(first)
        data.qpos[:], data.qvel[:] = robots[0].configuration(state)
        mujoco.mj_forward(model, data)
        rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert np.abs(data.efc_pos[rows]).max() < 1e-9
        assert np.abs(data.efc_vel[rows]).max() < 1e-12
        # What is added is across the motions that the constraints leave, to first order: nothing else moves.
        change, slopes = np.zeros(model.nv), data.efc_J.reshape(-1, model.nv)[rows]
        mujoco.mj_differentiatePos(model, change, 1.0, wanted, data.qpos)
        free = np.eye(model.nv) - np.linalg.pinv(slopes, rcond=1e-9) @ slopes
        changes.append(float(np.linalg.norm(change)))
        assert np.linalg.norm(free @ change) < 10 * np.linalg.norm(change) ** 2 + 1e-12
        np.testing.assert_allclose(free @ (state - first)[model.nv : 2 * model.nv], 0, atol=1e-12)
    assert max(changes) > 1e-4  # a draw may be next to closed


def test_a_start_far_from_a_closed_loop_is_refused() -> None:
    robot = ls.MjcfRobot(scene_from_xml(five_bar(np.random.default_rng(0)), "five-bar"))
    state = robot.at()
    np.testing.assert_array_equal(robot.with_closed_loops(np.stack([state, state]))[1], state)
    robot.scene.model.eq_data[:, 0] += 9.0  # an anchor out of reach
    with pytest.raises(InputError, match=r"states: got left 0.*, want positions near which all loops close"):
        robot.with_closed_loops(state)


def test_a_light_where_there_is_none() -> None:
    bare = mechanisms.draw("cart", 0).xml
    assert "<camera" not in bare
    model = ls.MjcfRobot(scene_from_xml(bare, "cart")).scene.model
    assert (model.ncam, model.nlight) == (0, 1)
    own = bare.replace("<worldbody>", '<worldbody><light name="lamp"/><camera name="side"/>')
    model = ls.MjcfRobot(scene_from_xml(own, "cart")).scene.model
    assert (model.camera(0).name, model.light(0).name, model.ncam, model.nlight) == ("side", "lamp", 1, 1)


def test_joint_limits_are_bounds() -> None:
    robot, _ = robot_of("cart", 0)
    bounds = robot.joint_limits
    assert bounds.bounds == {"slider": (-0.3, 0.3)}


@pytest.mark.parametrize("joints", ["hinge", "slide", "ball", "free", "hinge hinge"])
def test_joint_limits_of_a_robot_without_any_are_refused_by_their_name(joints: str) -> None:
    nested = ""
    for number, kind in enumerate(joints.split()):
        nested += f'<body><joint name="j{number}" type="{kind}"/><geom size="0.1"/>'
    bodies = nested + "</body>" * len(joints.split())
    robot = ls.MjcfRobot(scene_from_xml(scene(bodies, '<motor joint="j0" gear="1 0 0 0 0 0"/>'), "loose"))
    with pytest.raises(InputError, match=r"^MjcfRobot loose: joint_limits: got none, want problems without$"):
        _ = robot.joint_limits


@settings(max_examples=examples(15))
@given(seed=SEEDS)
def test_what_stands_on_its_feet_stays_there(seed: int) -> None:
    """A table with two bent legs and a load off its middle, by plain `mj_step` for half a second."""
    rng = np.random.default_rng(seed)
    bend, mass, aside = rng.uniform(-0.3, 0.3), rng.uniform(0.5, 5), rng.uniform(-0.15, 0.15)
    legs = "".join(
        f'<body pos="{x} {y} 0"><joint name="leg{i}" axis="0 1 0" damping="0.1"/>'
        f'<geom size="0.03" pos="0 0 -0.3" mass="0.1"/></body>'
        for i, (x, y) in enumerate([(0.25, 0.2), (0.25, -0.2), (-0.25, 0.2), (-0.25, -0.2)])
    )
    load = f'<geom size="0.01" pos="{aside} 0.05 0.05" mass="{mass}"/>'
    xml = sled(
        "", place="0 0 0.33", geom='type="box" size="0.3 0.25 0.02" mass="1"',
        things='<geom type="plane" size="1 1 1"/>', carried=f'<freejoint name="base"/>{load}{legs}',
        actuators=motors([f"leg{i}" for i in range(4)]), option="",
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "table"))
    bent = robot.at(None, base_z=0.03 + 0.3 * np.cos(bend) - 1e-4, **{f"leg{i}": bend for i in range(4)})
    state = robot.at_rest(bent)
    np.testing.assert_array_equal(state[6:10], bent[6:10])  # the legs keep their angles
    held, model = robot.hold(state), robot.scene.model
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = robot.configuration(state)[0], held
    mujoco.mj_step(model, data, round(0.5 / model.opt.timestep))
    moved = robot.state(data.qpos, data.qvel) - state[: 2 * model.nv]
    np.testing.assert_allclose(moved, 0, atol=1e-6)  # MuJoCo's solver ends at 1e-8 of the forces
    above = bent.copy()
    above[2] = 0.6
    np.testing.assert_allclose(robot.at_rest(above), state, rtol=0, atol=1e-5)


def elbow(gear: float, least: float, *, collides: int = 0) -> ls.MjcfRobot:
    """Two links on a fixed base, in a level plane; the second joint has limits. The first link overlaps the base."""
    touching = f'contype="{collides}" conaffinity="1"'
    links = arm(
        0.4, 0.4, joint='axis="0 0 1" damping="0.05"', joints=("", f'range="{least} 2"'), option='timestep="0.005"',
        geom=f'size="0.03" mass="1" {touching}',
        actuators=motors("ab", (1, 1)).replace('"a" ', '"a" gear="10" ', 1).replace('"b" ', f'"b" gear="{gear}" ', 1),
    )  # fmt: skip
    base = f'<body name="base"><geom size="0.05" {touching}/>'
    xml = links.replace("<worldbody>", f"<worldbody>{base}").replace("</worldbody>", "</body></worldbody>")
    return ls.MjcfRobot(scene_from_xml(xml, "arm"))


@pytest.mark.parametrize("turn", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("gear", [2.0, 4.0])
def test_plans_keep_off_joint_limits(gear: float, turn: float) -> None:
    """The swing folds the elbow: plans without that cost all touch the limit at -0.3."""
    robot = elbow(gear, -0.3)
    problem = robot.problem(robot.at(), robot.at(a=turn), steps=40, dt=0.02, weights=[1000, 1000, 100, 100])
    solution = ls.smooth(problem)
    assert solution.success
    assert solution.trajectory.states[:, 1].min() > -0.3
    (*states, last), controls = solution.trajectory.states, solution.trajectory.controls
    low, high = np.maximum(0, -0.2 - np.array(states)[:, 1]), np.maximum(0, np.array(states)[:, 1] - 1.9)
    squares = np.sum(controls**2) + 1e-3 * np.sum(np.array(states)[:, 2:] ** 2) + 100 * np.sum(low**2 + high**2)
    squares += (last - robot.at(a=turn)) ** 2 @ [1000, 1000, 100, 100]
    assert solution.cost == pytest.approx(squares / 2, rel=1e-9)


@settings(max_examples=examples(20))
@given(seed=SEEDS)
def test_limits_cost_nothing_where_start_and_goal_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot, (start, goal) = elbow(1.0, -0.3), rng.uniform(-0.3, 2.0, size=2)
    problem = robot.problem(robot.at(b=start), robot.at(b=goal))
    (term,) = [one for one in terms_of(problem.stage_cost) if isinstance(one, LimitCost)]
    (_, _, low), (_, _, high) = term.bounds
    assert low == pytest.approx(min(-0.2, start, goal))
    assert high == pytest.approx(max(1.9, start, goal))


@pytest.mark.parametrize("past", [-1.0, -0.32, 2.1, 57.0])
def test_a_goal_past_the_limits_of_a_joint_is_refused(past: float) -> None:
    """At the limit, and for a joint that stays where it is, it is not."""
    robot = elbow(1.0, -0.3)
    degrees = f"{-0.3 * 180 / np.pi:.4g} to {360 / np.pi:.4g}"
    wanted = rf"goal: got {past:.4g} rad for b, want .* -0.3 to 2 rad \({degrees} degrees\)$"
    with pytest.raises(InputError, match=wanted):
        robot.problem(robot.at(), robot.at(b=past))
    for fine in (-0.3, 2.0):
        robot.problem(robot.at(), robot.at(b=fine))
    if past in (-0.32, 2.1):  # by less than a tenth of the range, as springs are pressed
        robot.problem(robot.at(b=past), robot.at(a=1.0, b=past))
        robot.problem(robot.at(b=past), robot.at(a=1.0))


@pytest.mark.parametrize("past", [-1.0, -0.54, 2.24, 57.0, -1e6])
def test_a_start_far_past_the_limits_of_a_joint_is_refused(past: float) -> None:
    """The range is 2.3 rad; 0.23 rad past it, as springs are, and where the MJCF itself has the joint it is not."""
    robot = elbow(1.0, -0.3)
    degrees = f"{-0.3 * 180 / np.pi:.4g} to {360 / np.pi:.4g}"
    wanted = rf"got {re.escape(f'{past:.4g}')} rad for b, want .* -0.3 to 2 rad \({degrees} degrees\)$"
    for goal in (robot.at(), robot.at(b=past), robot.at(a=1.0, b=past)):
        with pytest.raises(InputError, match=f"^start: {wanted}"):
            robot.problem(robot.at(b=past), goal)
    key = f'<keyframe><key name="past" qpos="0.2 {past!r}"/></keyframe></mujoco>'
    stated = ls.MjcfRobot(scene_from_xml(robot.scene.xml.replace("</mujoco>", key), "arm"))
    stated.problem(stated.at("past"), stated.at())
    stated.problem(stated.at("past", a=0.0), stated.at("past"))
    with pytest.raises(InputError, match="start: got 30 rad for b"):
        stated.problem(stated.at("past", b=30.0), stated.at())


def test_a_start_that_mujoco_cannot_leave_is_said_to_be_past_the_limits() -> None:
    """The first state is not finite either, but it is not the cause."""
    robot = elbow(1.0, -0.3)
    far = robot.at(b=1e12)
    assert not np.isfinite(robot.dynamics.step(far, np.zeros(2), 0.02)).any()
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=0.02, steps=5, initial=ls.FixedState(far), stage_cost=ls.ControlCost([1.0, 1.0]),
        final_cost=ls.QuadraticCost(np.ones(4), about=robot.at()),
    )  # fmt: skip
    with pytest.raises(InputError, match=r"no finite state follows the start: got 1e\+12 rad for b, want .* -0.3 to 2"):
        ls.smooth(problem)


def test_what_is_amiss_at_rest_is_said() -> None:
    """Joints past their limits, and bodies that touch, but not those that MuJoCo lets through."""
    assert "past their limits at rest: b 0 (want 0.2 to 2)\n" in str(elbow(1.0, 0.2))
    assert "limits at rest" not in str(elbow(1.0, -0.2))
    assert "touching" not in str(elbow(1.0, 0.2))
    assert "touching at rest: base and upper\n" in str(elbow(1.0, 0.2, collides=1))


def test_a_wrench_on_the_body_is_a_disturbance() -> None:
    robot, _ = robot_of("box", 2, "Euler")
    state = robot.at(z=3.0)
    pushed = robot.dynamics.disturbed.with_parameters(force_x=2.0, torque_z=0.1)
    mass = float(robot.scene.model.body_mass[1])
    spin = float(robot.scene.model.body_inertia[1, 2])
    after = pushed.step(state, np.zeros(2), 0.005)
    np.testing.assert_allclose(after[6], 0.005 * 2.0 / mass, rtol=1e-9)
    np.testing.assert_allclose(after[11], 0.005 * 0.1 / spin, rtol=1e-9)
    np.testing.assert_array_equal(
        robot.dynamics.disturbed.step(state, np.zeros(2), 0.005), robot.dynamics.step(state, np.zeros(2), 0.005)
    )


def test_it_is_pickled_with_its_model() -> None:
    robot, _ = robot_of("cart", 4, "Euler")
    again = pickle.loads(pickle.dumps(robot))
    state, control = near_rest(robot, 0)
    np.testing.assert_array_equal(again.dynamics.step(state, control, 0.01), robot.dynamics.step(state, control, 0.01))


def test_what_it_cannot_touch_is_no_obstacle() -> None:
    """By MuJoCo's bits: the cart shares one with the post that is near, and none with the other."""
    posts = '<geom name="near" size="0.1" pos="2 0 0"/>'
    posts += '<geom name="other" size="0.1" pos="3 0 0" contype="2" conaffinity="2"/>'
    xml = mechanisms.draw("cart", 0).xml.replace("<worldbody>", f"<worldbody>{posts}")
    robot = ls.MjcfRobot(scene_from_xml(xml, "cart"), position=())
    assert robot.scene.world.names == ("near",)
    assert ls.Plant(robot, robot.scene).obstacles == ("near",)


PART = '<geom {name} size="0.1" pos="{number} 2 0"/><body pos="{number} 3 0"><joint/><geom size="0.1"/></body>'


@settings(max_examples=examples(10))
@given(parts=st.lists(st.tuples(st.integers(0, 3), st.booleans()), min_size=1, max_size=8))
def test_what_has_no_name_gets_one_in_all_sections_and_included_files(
    tmp_path_factory: pytest.TempPathFactory, parts: list[tuple[int, bool]]
) -> None:
    """The parts are spread over the file and those that it includes; some geoms have the name that is given first."""
    folder, sections = tmp_path_factory.mktemp("parts"), [""] * 4
    for number, (section, is_named) in enumerate(parts):
        name = f'name="unnamed_geom_{number}"' if is_named else ""
        sections[section] += PART.format(name=name, number=number)
    for number, section in enumerate(sections[1:]):
        text = f"<mujocoinclude><worldbody>{section}</worldbody></mujocoinclude>"
        (folder / f"part_{number}.xml").write_text(text)
    includes = "".join(f'<include file="part_{number}.xml"/>' for number in range(3))
    body, again = '<body><joint name="j"/><geom size="0.1"/></body>', '<actuator><motor joint="j"/></actuator>'
    xml = scene(body, '<motor joint="j"/>', things=sections[0], more=includes + again)
    (folder / "whole.xml").write_text(xml)
    robot, model = ls.MjcfRobot(folder / "whole.xml"), mujoco.MjModel.from_xml_path(str(folder / "whole.xml"))
    ours = robot.scene.model
    assert (ours.ngeom, ours.njnt, ours.nu) == (model.ngeom, model.njnt, model.nu)
    names = {ours.geom(number).name for number in range(ours.ngeom)}
    assert len(names) == ours.ngeom
    assert "" not in names
    np.testing.assert_array_equal(ours.geom_pos, model.geom_pos)


def test_an_obstacle_that_is_half_of_a_pair_is_named() -> None:
    xml = mechanisms.draw("cart", 0).xml.replace("<worldbody>", '<worldbody><geom name="post" size="0.1" pos="2 0 0"/>')
    xml = xml.replace("</mujoco>", '<contact><pair geom1="post" geom2="cart"/></contact></mujoco>')
    with pytest.raises(InputError, match=r"geom 'post': got an obstacle in a <contact><pair>"):
        ls.MjcfRobot(scene_from_xml(xml, "cart"))


def swing(robot: ls.MjcfRobot, **options: Any) -> ls.Problem:
    return ls.Problem(
        dynamics=robot.dynamics, dt=0.02, steps=60, initial=ls.FixedState(robot.at(pole=2.5)),
        stage_cost=ls.ControlCost([0.1]), final_cost=ls.QuadraticCost(np.full(4, 50.0), about=robot.at(pole=np.pi)),
        **options,
    )  # fmt: skip


def test_a_plan_of_the_smoother_is_what_mujoco_does() -> None:
    """One hanging pole, brought to rest: solved, optimal by differences of its cost, and run in the same MJCF."""
    robot, _ = robot_of("cart", 4, "implicitfast")
    problem = swing(robot)
    solution = ls.smooth(problem)
    assert solution.success, solution
    assert solution.certificate.optimality < 1e-3
    rollout = ls.simulate(ls.Plant(robot, robot.scene), solution)
    # Not to the bit: the plan's solver of constraints ends nearer to its solution.
    np.testing.assert_allclose(rollout.states[0], solution.trajectory.states, rtol=0, atol=1e-6)
    np.testing.assert_allclose(ls.ilqr(problem).cost, solution.cost, rtol=1e-3)
    pickled = pickle.loads(pickle.dumps(problem))
    assert pickled.digest == problem.digest
    np.testing.assert_array_equal(ls.smooth(pickled, threads=1).trajectory.states, solution.trajectory.states)


def test_laws_that_track_and_estimate_take_it() -> None:
    robot, _ = robot_of("cart", 4, "implicitfast")
    problem = swing(robot)
    solution, plant = ls.smooth(problem), ls.Plant(robot, robot.scene)
    noise = [ls.disturbances.MeasurementNoise(0.002)]
    law = ls.track(problem, solution, tolerate={"m": 0.05, "rad": 0.05, "m/s": 0.5, "rad/s": 0.5}, effort=0.5)
    estimating = ls.OffsetFree(
        problem, solution, ls.uncertainty_of(plant, noise), effort=0.5,
        tolerate={"m": 0.05, "rad": 0.05, "m/s": 0.5, "rad/s": 0.5},
    )  # fmt: skip
    rollout = ls.simulate(plant, solution, controller=estimating, disturbances=noise, trials=5, seed=1)
    tracking = ls.simulate(plant, replace(solution, policy=law), disturbances=noise, trials=5, seed=1)
    for run in (rollout, tracking):
        assert np.abs(run.states - solution.trajectory.states)[..., :2].max() < 0.1


BAD = {
    "no actuators": (row("a"), "actuators: got none, want at"),
    "nothing moves": (scene('<geom size="0.1"/>'), "got no joints, want a robot that moves"),
    "deformable": (
        row(
            "a",
            things='<flexcomp name="rope" type="grid" dim="1" count="3 1 1" spacing="0.1 0.1 0.1" mass="1" '
            'radius="0.01"/>',
            actuators='<motor joint="a"/>',
        ),
        "deformable parts: got some, want rigid bodies",
    ),
}


@pytest.mark.parametrize("which", BAD)
def test_what_states_do_not_describe_is_refused(which: str) -> None:
    text, message = BAD[which]
    with pytest.raises(InputError, match=message):
        ls.MjcfRobot(scene_from_xml(text, "bad"))


def test_bad_arguments_are_named() -> None:
    scene = robot_of("cart", 0)[0].scene
    robot = ls.MjcfRobot(scene)
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"body": "hull"}, "body: got 'hull', want one of: cart, pole"),
        (
            {"position": ("pole", "slider")},
            "position: got .*, want 2 or 3 that are the position of the body 'cart', among: slider",
        ),
        ({"position": ("nose",)}, "position: got 'nose'"),
        ({"radius": -1.0}, "radius: got -1"),
        ({"floors": 3}, "floors: got 3"),
    )
    for arguments, message in cases:
        with pytest.raises(InputError, match=message):
            ls.MjcfRobot(scene, **arguments)
    with pytest.raises(InputError, match=r"dt: got 0.007 s, want a multiple of the physics step"):
        robot.dynamics.step(robot.at(), np.zeros(1), 0.007)
    with pytest.raises(InputError, match="no rate"):
        robot.dynamics.rate(robot.at(), np.zeros(1))
    with pytest.raises(InputError, match="steps have no inverse, want 'dual'"):
        ls.smooth(swing(robot), form="primal")


@pytest.mark.skipif(os.name != "posix", reason="Windows has no signals to send to a process")
@pytest.mark.parametrize("solve", [ls.ilqr, ls.smooth])
def test_ctrl_c_ends_an_iteration_that_would_take_minutes(solve: Any) -> None:
    robot = ls.MjcfRobot(scene_from_xml(arm(1.0, names=("hinge",), option='timestep="1e-6"'), "pendulum"))
    quick, endless = (robot.problem(robot.at(), robot.at(hinge=1.0), steps=200, dt=dt) for dt in (1e-6, 0.5))
    solve(quick, max_iterations=1)  # compiles
    ctrl_c = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
    ctrl_c.start()
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt) as raised:
        solve(endless, max_iterations=1)
    # 5e5 steps for each of 200 periods and 7 rollouts, at 0.3 us or more: three minutes at least.
    assert time.monotonic() - begin < 30.0
    assert raised.value.solution.status is ls.Status.INTERRUPTED  # pyright: ignore[reportAttributeAccessIssue]
    after = robot.dynamics.step(robot.at(hinge=1.0), np.zeros(1), 1e-6)
    assert np.isfinite(after).all()  # the robot can be used again


def test_a_load_that_hangs_from_a_winch_is_at_rest() -> None:
    """It only pulls, and for a control near 0 as much as it can. By `mj_step` the load stays for half a second."""
    rope = '<spatial name="rope"><site site="hook"/><site site="eye"/></spatial>'
    winch = '<position name="winch" tendon="rope" kp="3000" kv="300" forcerange="-500 0"/>'
    xml = row(
        ("trolley", "load"), joints=('type="slide" axis="1 0 0" damping="5"', 'type="free"'), joint="",
        places=("0 0 3", "0 0 1"), geom='type="box"',
        geoms=('size="0.1 0.1 0.05" mass="10"', 'size="0.2 0.2 0.1" mass="6"'),
        carried=('<site name="hook"/>', '<site name="eye" pos="0 0 0.1"/>'), more=f"<tendon>{rope}</tendon>",
        actuators=motors(["trolley"]) + winch, option='timestep="0.002" integrator="implicitfast"',
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "crane"))
    state = robot.at()
    np.testing.assert_array_equal(robot.at_rest(state), state)
    data = mujoco.MjData(robot.scene.model)
    data.ctrl[:] = robot.hold(state)
    mujoco.mj_step(robot.scene.model, data, 250)
    np.testing.assert_allclose(data.qpos, robot.configuration(state)[0], rtol=0, atol=1e-6)


@settings(max_examples=examples(8))
@given(mass=st.floats(0.3, 3.0), loss=st.floats(0.2, 3.0), push=st.floats(0.5, 1.0), speed=st.floats(0.5, 2.0))
def test_dry_friction_is_coulombs_while_a_joint_moves(mass: float, loss: float, push: float, speed: float) -> None:
    """A block that slides loses its friction from each push, whatever its speed: steps in closed form."""
    xml = sled(
        joint=f'frictionloss="{loss!r}"', geom=f'type="sphere" size="0.1" mass="{mass!r}"',
        actuators='<motor joint="x" gear="10"/>', option='timestep="0.005"',
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "dry"))
    state = robot.dynamics.step(robot.at(x_velocity=speed), [push], 0.05)
    h, rate, way, velocity = 0.005, (10 * push - loss) / mass, 0.0, speed
    for _ in range(10):
        velocity += h * rate
        way += h * velocity
    # MuJoCo's constraint solver ends within 1e-14.
    np.testing.assert_allclose(state, [way, velocity], rtol=1e-10)


@pytest.mark.parametrize("loss", [0.3, 1.0])
def test_a_plan_with_dry_friction_is_replayed_by_mujocos_own_steps(loss: float) -> None:
    turning = 'axis="0 1 0" damping="0.1" frictionloss="0.05" armature="0.05"'
    xml = sled(
        names=("way",), joint=f'frictionloss="{loss!r}"', geom=f'type="box" size="0.1 0.1 0.1" mass="1" {NO_CONTACT}',
        carried=f"""<body><joint name="turn" {turning}/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.2" {NO_CONTACT}/></body>""",
        actuators="""<motor joint="way" gear="10" ctrlrange="-1 1"/><motor joint="turn" gear="2" ctrlrange="-1 1"/>""",
        option='timestep="0.005" integrator="implicitfast"',
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "dry"))
    told = next(line for line in str(robot).splitlines() if "dry friction" in line)
    assert told == f"  dry friction, in plans and runs: way {loss:g} N, turn 0.05 N m"
    problem = robot.problem(robot.at(), robot.at(way=0.3, turn=0.4), steps=40, dt=0.02, weights={"m": 100, "rad": 100})
    plan = ls.smooth(problem, max_iterations=30).trajectory
    apart = {}
    for dry in (True, False):
        model = mujoco.MjModel.from_xml_string(robot.scene.xml)
        model.opt.tolerance = 1e-14  # the file's own, 1e-8, is that of MuJoCo's friction, too
        model.dof_frictionloss *= dry
        data = mujoco.MjData(model)
        data.qpos[:] = plan.states[0, :2]
        worst = 0.0
        for control, after in zip(plan.controls, plan.states[1:], strict=True):
            data.ctrl[:] = control
            mujoco.mj_step(model, data, 4)
            worst = max(worst, float(np.abs(data.qpos - after[:2]).max()))
        apart[dry] = worst
    assert apart[True] <= 1e-8  # warm starts differ
    assert apart[False] >= 0.01  # m or rad, if the friction is left out


@pytest.mark.parametrize(
    ("wheel", "rolls"),
    [
        ('<joint name="wheel" axis="0 1 0"/><geom type="cylinder" zaxis="0 1 0" size="0.1 0.03"/>', True),
        ('<joint name="wheel" axis="0 1 0"/><geom type="sphere" size="0.1"/>', True),
        ('<joint name="wheel" axis="0 1 0"/><geom type="cylinder" size="0.1 0.03"/>', False),
        ('<joint name="wheel" axis="0 1 0"/><geom size="0.1"/><body pos="0.1 0 0"><geom size="0.01"/></body>', False),
        ('<joint name="wheel" axis="0 1 0"/><geom type="sphere" size="0.1" pos="0.05 0 0"/>', False),
        ('<joint name="wheel" axis="0 1 0" range="-1 1"/><geom type="sphere" size="0.1"/>', False),
    ],
)
def test_the_turn_of_a_wheel_is_no_goal_unless_it_is_named(wheel: str, rolls: bool, tmp_path: Path) -> None:
    """A goal for it would hold it where it is: of all weights, those by which a wheel cannot roll on cost most."""
    path = tmp_path / "cart.xml"
    text = sled(
        "xz", place="0 0 0.0999", geom='type="box" size="0.2 0.05 0.02" mass="3"', carried=f"<body>{wheel}</body>",
        things='<geom type="plane" size="9 9 1"/>', actuators=motors(["wheel"], [5]),
        option='timestep="0.01" integrator="implicitfast"',
    )  # fmt: skip
    path.write_text(text)
    robot = ls.MjcfRobot(path)
    assert [joint.name for joint in robot.mjcf.wheels] == ["wheel"] * rolls
    begin = robot.at()

    def has(goal: np.ndarray, wanted: list[float], **weights: Any) -> bool:
        stated = robot.problem(begin, goal, steps=50, dt=0.04, **weights)
        return stated.digest == robot.problem(begin, goal, steps=50, dt=0.04, weights=wanted).digest

    goal, held = robot.at(x=1.0), 0.0 if rolls else 1.0
    assert has(goal, [100, 100, 100 * held, 100, 100, 100])
    assert has(goal, [1, 1, 2 * held, 0, 0, 0], weights={"m": 1.0, "rad": 2.0})
    assert has(goal, [1, 1, 2, 0, 0, 0], weights={"m": 1.0, "wheel": 2.0})
    assert has(robot.at(x=1.0, wheel=0.5), [100] * 6)


@pytest.mark.parametrize("off", [0.0, 0.01])
@settings(max_examples=examples(10))
@given(seed=st.integers(0, 2**32 - 1))
def test_a_wheel_may_be_of_parts_that_are_fixed_to_it(off: float, seed: int) -> None:
    """As of a URDF, whose tyre and cap are links: a tyre about the hinge's axis, or off it by some metres."""
    rng = np.random.default_rng(seed)
    rim, tyre = Rotation.random(2, rng=rng)
    axis, place, anchor = tyre.as_matrix()[:, 2], rng.normal(size=3), rng.normal(size=3)
    side = tyre.as_matrix()[:, 0]
    within, turned = rim.inv().apply(anchor + rng.normal() * axis + off * side - place), rim.inv() * tyre
    pos, centre, pivot, along = (" ".join(map(repr, v.tolist())) for v in (place, within, anchor, axis))
    quats = [" ".join(map(repr, turn.as_quat(scalar_first=True).tolist())) for turn in (rim, turned)]
    carried = f"""<body><joint name="wheel" pos="{pivot}" axis="{along}"/><body pos="{pos}" quat="{quats[0]}">
      <geom type="cylinder" size="0.1 0.03" pos="{centre}" quat="{quats[1]}"/><body name="cap"/></body></body>"""
    robot = ls.MjcfRobot(scene_from_xml(sled(carried=carried, actuators=motors(["wheel"])), "wheel"))
    assert [joint.name for joint in robot.mjcf.wheels] == ["wheel"] * (off == 0)


def test_a_clearance_that_start_and_goal_lack_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """As that of a boat on slides, whose water is a plane below it that it can never touch."""
    path = tmp_path / "boat.xml"
    path.write_text(
        sled(
            "xy",
            place="0 0 0.15",
            things='<geom name="water" type="plane" size="9 9 1"/><geom name="buoy" size="0.2" pos="2 2 0"/>',
        )
    )
    robot = ls.MjcfRobot(path)
    robot.problem(robot.at(), robot.at(x=1.0), clearance=0.04)
    assert not caplog.records
    robot.problem(robot.at(), robot.at(x=1.0), clearance=0.1)
    assert "'water' is 0.05 m from the robot at start and goal" in caplog.text
    assert "buoy" not in caplog.text
    other = ls.MjcfRobot(path, obstacles=["buoy"])  # the remedy
    caplog.clear()
    other.problem(other.at(), other.at(x=1.0), clearance=0.1)
    assert not caplog.records
