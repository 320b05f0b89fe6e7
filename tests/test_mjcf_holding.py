"""What holds a robot from an MJCF, against SciPy on MuJoCo's own accelerations, and by `mj_step`.

A free body is neutral, and all other drawn robots have springs that outweigh gravity, so that what is held stays with
constant controls. Whether it does is judged by two seconds of the unchanged MJCF.
"""

from collections import Counter
from typing import Any

import mujoco
import numpy as np
import pytest
from actuated import Rest, draw
from mechanisms import NO_CONTACT, arm, motors, row, scene, sled

import lqrsim as ls
from lqrsim.errors import InputError
from lqrsim.scenes.mujoco_log import unlogged
from lqrsim.scenes.scene import scene_from_xml

STAYS = 1e-4  # rad or m within which a held robot stays for 2 s
MORE = 1.02  # ratio of the norms of what two searches leave, of which the larger is no least


def outcome(seed: int) -> tuple[str, str]:
    """How what holds a drawn robot compares with SciPy's answer, and what to say of it."""
    drawn = draw(seed)
    robot = ls.MjcfRobot(scene_from_xml(drawn.xml, "drawn"))
    model, state = robot.scene.model, robot.at(None, **drawn.places)
    control, held = robot.hold(state), robot._held(state)
    rest, z = Rest(model, robot.configuration(state)[0]), np.concatenate([control, state[2 * model.nv :]])
    told = f"seed {seed}: {', '.join(drawn.kinds)} at {drawn.places}: {z}, missed {held.missed}"
    assert ((z >= rest.low) & (z <= rest.high)).all(), told
    if held.held:
        assert np.abs(rest.left(z)).max() < 1e-6 * (1 + np.abs(rest.data.qfrc_bias).max()), told
        far = moved(model, rest.data.qpos, z)
        if far < STAYS:
            return "held, and stays", ""
        kind = "held, but unstable" if growth(rest, z) > 1 + 1e-6 else "held, but moves"
        return kind, f"{told}, moves by {far:.2e}"
    left = rest.left(z)
    if not held.drifting.any():  # what is said to be missing is what accelerates it
        np.testing.assert_allclose(held.missed, -left[: model.nv], rtol=1e-6, atol=1e-6, err_msg=told)
    with unlogged():
        found, least = rest.search(np.random.default_rng(seed))
    if found is not None:
        return "short, but SciPy finds rest", f"{told}, SciPy {found}"
    if held.drifting.any():
        return "drifts, and SciPy finds no rest", ""
    more = np.linalg.norm(held.missed) > MORE * least + 1e-6
    return "short, and so is SciPy" + (", by less" if more else ""), f"{told}, SciPy misses {least}" if more else ""


def moved(model: mujoco.MjModel, qpos: np.ndarray, z: np.ndarray) -> float:
    """The largest distance in two seconds of any joint from where it began, in rad or m."""
    data, far, away = mujoco.MjData(model), 0.0, np.zeros(model.nv)
    data.qpos[:], data.ctrl[:], data.act[:] = qpos, z[: model.nu], z[model.nu :]
    for _ in range(round(2 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        mujoco.mj_differentiatePos(model, away, 1.0, qpos, data.qpos)
        far = max(far, float(np.abs(away).max()))
    return far


def growth(rest: Rest, z: np.ndarray) -> float:
    """The largest factor by which a deviation grows in a physics step, by MuJoCo's own derivatives."""
    rest.left(z)
    size = 2 * rest.model.nv + rest.model.na
    a = np.zeros((size, size))
    mujoco.mjd_transitionFD(rest.model, rest.data, 1e-7, True, a, None, None, None)
    return float(np.abs(np.linalg.eigvals(a)).max())


@pytest.mark.parametrize("seed", range(6))
def test_what_is_held_stays_and_what_is_short_cannot_be_held(seed: int) -> None:
    kind, told = outcome(seed)
    assert kind not in ("held, but moves", "short, but SciPy finds rest"), told


@pytest.mark.long
def test_a_thousand_robots_of_all_actuators() -> None:
    """Says what came out with `pytest -s`. Where it is short, a search that is local need not find the least forces."""
    found = Counter[str]()
    for seed in range(1000):
        kind, told = outcome(seed)
        found[kind] += 1
        if told:
            print(kind, "-", told)
    print(dict(found.most_common()))
    wrong = found["held, but moves"] + found["held, but unstable"] + found["short, but SciPy finds rest"]
    assert wrong <= 0.01 * (wrong + found["held, and stays"])
    assert found["short, and so is SciPy, by less"] <= 0.05 * 1000


def pendulum(actuators: str, joint: str = "", more: str = "") -> str:
    """A link in gravity about the y axis, of 0.5 kg and 0.3 m, with these actuators."""
    option, hinge = 'timestep="0.002" integrator="implicitfast"', 'axis="0 1 0" damping="0.1"'
    geom = f'size="0.02" mass="0.5" {NO_CONTACT}'
    return arm(
        0.3, names=["turn"], joint=hinge, joints=[joint], geom=geom, actuators=actuators, option=option, more=more
    )


WEIGHT = 0.5 * 9.81 * 0.15  # N m, of the level link


@pytest.mark.parametrize(
    ("joint", "actuator"),
    [
        ("", '<motor joint="turn" forcerange="-0.4 0.4"/>'),
        ("", '<position joint="turn" kp="100" kv="5" forcerange="-0.4 0.4"/>'),
        ('actuatorfrcrange="-0.4 0.4"', '<motor joint="turn" gear="-2"/>'),
        ("", '<motor joint="turn" ctrlrange="-0.4 0.4"/>'),
        ("", '<dcmotor joint="turn" motorconst="1 1" resistance="1" inductance="0.1" saturation="0.4 0 0"/>'),
    ],
)
def test_too_weak_an_actuator_is_short_by_what_its_limit_leaves(joint: str, actuator: str) -> None:
    robot = ls.MjcfRobot(scene_from_xml(pendulum(actuator, joint), "weak"))
    assert f"; turn is not held: {WEIGHT - 0.4:.3g} N m are missing" in str(robot)
    assert robot._held(robot.at()).missed == pytest.approx([-(WEIGHT - 0.4)], rel=1e-6)


def test_bodies_that_overlap_are_named_where_nothing_settles() -> None:
    wheel = '<body name="wheel"><joint axis="0 1 0"/><geom size="0.04"/></body>'
    fork = f"""<body name="fork" pos="0.1 0.12 0"><joint name="steer" axis="0 0 1"/><geom size="0.01" contype="0"/>
      {wheel}</body>"""
    text = sled(
        "", name="car", place="0 0 0.3", geom='type="box" size="0.2 0.1 0.05" mass="2"', carried="<freejoint/>" + fork,
        things='<geom type="plane" size="5 5 1"/>', actuators=motors(["steer"]), more="{}", option="",
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(text.format(""), "car"))
    with pytest.raises(ls.InputError, match=r"(car and wheel|wheel and car) touch, which an <exclude>"):
        robot.at_rest(robot.at())
    excluded = '<contact><exclude body1="car" body2="wheel"/></contact>'
    robot = ls.MjcfRobot(scene_from_xml(text.format(excluded), "car"))
    assert robot.at_rest(robot.at())[2] < 0.3


@pytest.mark.parametrize(
    "joints",
    [
        "<freejoint/>",
        '<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/><joint axis="0 1 0"/>',
    ],
)
def test_a_robot_above_its_ground_is_told_how_to_stand_on_it(joints: str) -> None:
    carried = '<body><joint name="arm" axis="0 0 1"/><geom pos="0.2 0 0.1" size="0.02" mass="0.1"/></body>'
    xml = sled(
        "", place="0 0 0.15", geom='type="box" size="0.1 0.1 0.1" mass="2"', carried=joints + carried,
        things='<geom type="plane" size="5 5 1"/>', actuators=motors(["arm"]), option="",
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "cart"))
    assert f"; z is not held: {2.1 * 9.81:.3g} N are missing; what stands on the ground starts" in str(robot)
    assert robot._held(robot.at_rest(robot.at())).held  # what the text names helps
    assert "  obstacles: none\n  ground, which is no obstacle: unnamed_geom_0" in str(robot)
    assert "  ground" not in str(ls.MjcfRobot(robot.scene, floors=False))


@pytest.mark.parametrize(
    ("actuator", "control", "act"),
    [
        ('<pid joint="turn" kp="20" kv="2" ki="5" imax="1" input="pos"/>', [0], [-WEIGHT / 5]),
        # Past its limit the integral leaves the rest to the target.
        ('<pid joint="turn" kp="20" ki="5" imax="0.1" input="pos"/>', [-(WEIGHT - 0.5) / 20], [-0.1]),
        ('<pid joint="turn" kp="20" kv="2" slewmax="1"/>', [-WEIGHT / 20, 0], [-WEIGHT / 20]),
        ('<dcmotor joint="turn" motorconst="0.5 0.5" resistance="2" inductance="0.02"/>', [-4 * WEIGHT], [-2 * WEIGHT]),
        ('<motor joint="turn" gear="3"/><velocity joint="turn" kv="2"/>', [-WEIGHT / 3, 0], []),
        ('<velocity joint="turn" kv="2"/>', [-WEIGHT / 2], []),
    ],
)
def test_controls_and_activations_that_hold_in_closed_form(actuator: str, control: Any, act: Any) -> None:
    robot = ls.MjcfRobot(scene_from_xml(pendulum(actuator), "link"))
    state = robot.at()
    np.testing.assert_allclose(robot.hold(state), control, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(state[2:], act, rtol=1e-7, atol=1e-9)
    assert "falls short" not in str(robot)


def test_an_actuator_of_two_controls_plans_and_runs() -> None:
    """Beside one without any and a motor: MuJoCo's `mj_step` with the plan's controls ends where the plan does."""
    actuators = """<dcmotor name="brake" joint="turn" motorconst="0.1 0.1" resistance="2" input="none"/>
      <pid name="servo" joint="turn" kp="20" kv="2"/><motor name="push" joint="turn" ctrlrange="-1 1"/>"""
    robot = ls.MjcfRobot(scene_from_xml(pendulum(actuators), "link"))
    controls, model = robot.dynamics.control_coordinates, robot.scene.model
    assert controls.names == ("servo_pos", "servo_vel", "push")
    assert controls.units == ("rad", "rad/s", "N m")
    assert (controls.low[2], controls.high[2]) == (-1, 1)
    plan = ls.smooth(robot.problem(robot.at(), robot.at(turn=0.5), steps=25, weights=1e3), threads=1)
    assert plan.success
    plant, data = ls.Plant(robot, robot.scene), mujoco.MjData(model)
    np.testing.assert_array_equal(plant.ctrl, [0, 1, 2])
    np.testing.assert_array_equal(plant.actuators, [0, 1, 2])
    for control in plan.trajectory.controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data, round(plan.trajectory.dt / model.opt.timestep))
    end = plan.trajectory.states[-1]
    np.testing.assert_allclose([*data.qpos, *data.qvel], end, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ls.simulate(plant, plan).states[0, -1], end, rtol=0, atol=1e-6)
    with pytest.raises(InputError, match="actuators: got none, want at least one <actuator> that has a control"):
        ls.MjcfRobot(scene_from_xml(pendulum(actuators.split("<pid")[0]), "link"))


def test_a_lost_actuator_is_the_one_that_is_named() -> None:
    """Controls and actuators are counted separately: the motor is the second actuator and the third control."""
    actuators = '<pid name="servo" joint="turn" kp="20" kv="2"/><motor name="push" joint="turn"/>'
    robot = ls.MjcfRobot(scene_from_xml(pendulum(actuators), "link"))
    plant = ls.Plant(robot, robot.scene)
    np.testing.assert_array_equal(plant.ctrl[2:], [2])
    assert [robot.scene.model.actuator(int(one)).name for one in plant.actuators] == ["servo", "push"]
    plan = ls.smooth(robot.problem(robot.at(), robot.at(), steps=2), threads=1)
    with pytest.raises(InputError, match="actuator 'servo' has a gain or bias of another type, want fixed or affine"):
        ls.simulate(plant, plan, disturbances=[ls.disturbances.ActuatorLoss("push")])


@pytest.mark.parametrize("seed", range(3))
def test_a_keyframe_with_mocap_bodies_is_what_plans_and_runs_begin_from(seed: int, tmp_path: Any) -> None:
    """An arm whose tip is tied to a mocap body: MuJoCo from the keyframe, against the dynamics and the plant."""
    rng = np.random.default_rng(seed)
    q, turn = rng.uniform(-1, 1, 2), rng.normal(size=4)
    tip = 0.3 * np.array([np.cos(q[0]) + np.cos(q.sum()), np.sin(q[0]) + np.sin(q.sum()), 0.0])
    told = {name: " ".join(map(repr, map(float, value))) for name, value in (("q", q), ("tip", tip), ("turn", turn))}
    file = tmp_path / "tied.xml"
    small = f'<geom size=".02" mass=".1" {NO_CONTACT}/>'
    text = arm(
        0.3, 0.3, joint='axis="0 0 1" damping=".5"', geom=f'size=".02" mass=".5" {NO_CONTACT}',
        end=f'<body name="tip" pos=".3 0 0">{small}</body>',
        things=f'<body name="target" mocap="true" pos="0.6 0 0" euler="0 0 0.5">{small}</body>',
        more=f"""<equality><connect body1="target" body2="tip" anchor="0 0 0"/></equality>
          <keyframe><key name="bent" qpos="{told["q"]}" mpos="{told["tip"]}" mquat="{told["turn"]}"/></keyframe>""",
        option='timestep="0.005" integrator="implicitfast" gravity="0 -2 0"',
    )  # fmt: skip
    file.write_text(text)
    with pytest.raises(InputError, match=r"keyframe: got 'bent', in which the mocap bodies target are elsewhere"):
        ls.MjcfRobot(file).at("bent")
    with pytest.raises(InputError, match="keyframe: got 'straight', want one of: bent"):
        ls.MjcfRobot(file, mocap="straight")
    robot = ls.MjcfRobot(file, mocap="bent")
    state, model = robot.at("bent"), mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.ctrl[:] = 0.1, -0.1
    mujoco.mj_step(model, data, 100)
    reached = robot.dynamics.step(state, [0.1, -0.1], 0.5)
    np.testing.assert_allclose(reached[:2], data.qpos, rtol=0, atol=1e-6)
    np.testing.assert_allclose(reached[:2], q, rtol=0, atol=0.02)  # the tie is soft
    plan = ls.smooth(robot.problem(state, state, steps=10), threads=1)
    run = ls.simulate(ls.Plant(robot, robot.scene), plan)
    np.testing.assert_allclose(run.states[0, -1], plan.trajectory.states[-1], rtol=0, atol=1e-6)
    scenario = ls.scenarios.mjcf(str(file), start="bent", goal="bent", steps=10)
    np.testing.assert_array_equal(scenario.problem.start, state)


@pytest.mark.parametrize("seed", range(4))
def test_a_follower_that_is_named_moves_what_it_follows(seed: int) -> None:
    """a follows b by a rising cubic, c follows a linearly: whichever is named, all are where the polynomials say."""
    rng = np.random.default_rng(seed)
    offset, slope, cubic, ratio = rng.uniform((-0.05, 0.5, 0, -2), (0.05, 2, 3, -0.5))
    ties = f"""<joint joint1="a" joint2="b" polycoef="{offset} {slope} 0 {cubic}"/>
      <joint joint1="c" joint2="a" polycoef="0 {ratio}"/>"""
    xml = row("abcd", joint='type="slide"', more=f"<equality>{ties}</equality>", actuators=motors("bd"))
    robot = ls.MjcfRobot(scene_from_xml(xml, "cams"), position=())
    b = rng.uniform(-0.3, 0.3)
    a = offset + slope * b + cubic * b**3
    wanted = [a, b, ratio * a, 0.2]
    for named in ({"b": b}, {"a": a}, {"c": ratio * a}, {"a": a, "b": b}, {"b": round(b, 7), "c": round(ratio * a, 7)}):
        np.testing.assert_allclose(robot.at(None, d=0.2, **named)[:4], wanted, rtol=0, atol=1e-6, err_msg=str(named))
    with pytest.raises(InputError, match=r"joints: got a .*, b .*, want positions at which all loops close and follow"):
        robot.at(a=a + 0.01, b=b)


def test_free_joints_without_a_name_are_told_apart_by_their_bodies() -> None:
    drone = '<body name="drone" pos="0 0 1"><freejoint/><geom size=".1" mass="1"/><site name="s"/></body>'
    box = '<body name="box" pos="1 0 .1"><joint type="free"/><geom size=".1" mass=".2"/></body>'
    twice = f'<replicate count="2" offset="0 1 0">{box.replace("box", "ball")}</replicate>'

    def names(bodies: str) -> tuple[str, ...]:
        xml = scene(bodies, '<motor name="lift" site="s" gear="0 0 1 0 0 0"/>')
        return ls.MjcfRobot(scene_from_xml(xml, "two")).dynamics.state_coordinates.names

    assert {"drone_x", "drone_wz", "box_x", "box_rz"} <= set(names(drone + box))
    assert {"drone_x", "box_x", "ball0_z", "ball1_z"} <= set(names(drone + box + twice))
    assert names(drone)[:3] == ("x", "y", "z")


@pytest.mark.parametrize("most", [5.0, 1.0])
def test_adhesion_between_two_bodies_that_touch(most: float) -> None:
    """A motor carries two spheres of which the upper one is stuck to it, or falls short by what MuJoCo accelerates."""
    xml = row(
        "ab", joint='type="slide" axis="0 0 1" damping="5" stiffness="50"', geom='size=".05" mass=".2"',
        places=("0 0 0", "0 0 0.0995"), option='integrator="implicitfast"',
        actuators='<adhesion name="stick" body="a" gain="20" ctrlrange="0 3"/>' + motors("a", [most]),
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "stuck"), position=())
    state, model = robot.at(a=0.01, b=0.0096), robot.scene.model
    held, rest = robot._held(state), Rest(model, robot.configuration(state)[0])
    np.testing.assert_allclose(held.missed, -rest.forces(held.controls), rtol=0, atol=1e-9)
    assert held.held == (most == 5.0)
    if held.held:
        assert moved(model, rest.data.qpos, held.controls) < STAYS
