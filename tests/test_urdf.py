"""A URDF as a robot: its equations of motion, its motors, its meshes, and what is said of what it lacks."""

import os
import re
from pathlib import Path
from typing import Any

import drawn_urdfs
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import scene
from sampling import examples
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.errors import Array, InputError
from lqrsim.scenarios.references import from_anywhere, names_code, resolve
from lqrsim.view import gl

SEEDS = st.integers(0, 2**32 - 1)
ROUNDING = 1e-12  # of the largest entry: both sides sum a hundred products

INERTIAL = """<inertial><origin xyz="0.1 0 0"/><mass value="{}"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0"
  izz="0.01"/></inertial>"""
BOX = '<{0}><geometry><box size="0.2 0.04 0.04"/></geometry></{0}>'
ARM = f"""<robot name="arm">
  <link name="base">{INERTIAL.format(3)}</link>
  <link name="upper">{INERTIAL.format(1)}{BOX.format("visual")}{BOX.format("collision")}</link>
  <link name="lower">{INERTIAL.format(0.5)}{BOX.format("collision")}</link>
  <link name="flange"/>
  <link name="hand">{INERTIAL.format(0.25)}</link>
  <link name="left">{INERTIAL.format(0.1)}</link><link name="right">{INERTIAL.format(0.1)}</link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <origin xyz="0 0 0.3"/><limit lower="-2" upper="1.5" effort="20" velocity="2.5"/>
    <dynamics damping="0.5" friction="0.1"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0.5 0 0"/>
    <axis xyz="0 1 0"/><limit effort="8" velocity="4"/></joint>
  <joint name="bolts" type="fixed"><parent link="lower"/><child link="flange"/><origin xyz="0.3 0 0"/></joint>
  <joint name="glue" type="fixed"><parent link="flange"/><child link="hand"/><origin xyz="0.1 0 0"/></joint>
  <joint name="grip" type="prismatic"><parent link="hand"/><child link="left"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.04" effort="5" velocity="0.1"/></joint>
  <joint name="twin" type="prismatic"><parent link="hand"/><child link="right"/><axis xyz="0 0 1"/>
    <limit lower="-0.05" upper="0.05" effort="5" velocity="0.1"/>
    <mimic joint="grip" multiplier="-1" offset="0.01"/></joint>
</robot>"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    (tmp_path / "arm.urdf").write_text(ARM, encoding="utf-8")
    return tmp_path / "arm.urdf"


def changed(arm: Path, *pairs: tuple[str, str]) -> Path:
    text = ARM
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    arm.write_text(text, encoding="utf-8")
    return arm


def drawn(folder: Path, seed: int, base: Any) -> tuple[str, ls.MjcfRobot]:
    urdf = drawn_urdfs.draw(seed)
    (folder / "drawn.urdf").write_text(urdf, encoding="utf-8")
    return urdf, ls.MjcfRobot(ls.load_scene(folder / "drawn.urdf", base=base))


def forces_of(robot: ls.MjcfRobot, qpos: Array, qvel: Array) -> tuple[Array, Array]:
    """MuJoCo's mass matrix, and its forces of gravity and of what is quadratic in the speeds."""
    model = robot.scene.model
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    return mass, data.qfrc_bias.copy()


def close(found: tuple[Array, Array], wanted: tuple[Array, Array]) -> None:
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=ROUNDING * max(1.0, np.abs(other).max()))


@pytest.mark.parametrize("base", ["fixed", "free"])
@settings(max_examples=examples(60))
@given(seed=SEEDS)
def test_the_equations_of_motion_are_those_of_the_file(
    tmp_path_factory: pytest.TempPathFactory, base: str, seed: int
) -> None:
    urdf, robot = drawn(tmp_path_factory.mktemp("drawn"), seed, base)
    rng, names = np.random.default_rng(seed), [one.name for one in robot.mjcf.joints if one.kind != "free"]
    at, speeds = rng.uniform(-3, 3, size=len(names)), rng.normal(size=len(names))
    frame = None
    qpos, qvel = at, speeds
    if base == "free":
        turn = Rotation.random(rng=rng)
        place, velocity, spin = rng.normal(size=(3, 3))
        frame = (turn.as_matrix(), spin)
        qpos, qvel = np.r_[place, turn.as_quat(scalar_first=True), at], np.r_[velocity, spin, speeds]
    each = (dict(zip(names, some.tolist(), strict=True)) for some in (at, speeds))
    close(forces_of(robot, qpos, qvel), drawn_urdfs.equations(urdf, *each, base=frame))


@settings(max_examples=examples(40))
@given(seed=SEEDS)
def test_pinocchio_has_the_same_equations(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    pinocchio: Any = pytest.importorskip("pinocchio", reason="pin takes 400 MB, so that no extra has it")
    urdf, robot = drawn(tmp_path_factory.mktemp("drawn"), seed, "fixed")
    other = pinocchio.buildModelFromXML(urdf)
    joints = [(one.name, one.limits is None and one.kind == "hinge") for one in robot.mjcf.joints]
    rng = np.random.default_rng(seed)
    qpos, qvel = rng.uniform(-3, 3, size=len(joints)), rng.normal(size=len(joints))
    q, v, columns = pinocchio.neutral(other), np.zeros(other.nv), list[int]()
    for (name, turning), place, speed in zip(joints, qpos, qvel, strict=True):
        joint = other.joints[other.getJointId(name)]
        q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(place), np.sin(place)] if turning else [place]
        v[joint.idx_v] = speed
        columns.append(joint.idx_v)
    data = other.createData()
    upper = np.triu(pinocchio.crba(other, data, q))
    mass, bias = upper + np.triu(upper, 1).T, pinocchio.nonLinearEffects(other, data, q, v)
    close(forces_of(robot, qpos, qvel), (mass[np.ix_(columns, columns)], bias[columns]))


def test_any_path_of_a_file_will_do(arm: Path) -> None:
    """As for an MJCF; those of `os.scandir` are no `Path`."""
    (entry,) = os.scandir(arm.parent)
    for path in (entry, arm, str(arm)):
        assert ls.MjcfRobot(path).actuators == ("shoulder", "elbow", "grip")


def test_joints_with_an_effort_have_a_motor_and_links_keep_their_names(arm: Path) -> None:
    robot = ls.MjcfRobot(arm)
    assert robot.name == "arm"
    assert robot.joints == ("shoulder", "elbow", "grip", "twin")
    assert robot.dynamics.control_coordinates.labels == ("shoulder (N m)", "elbow (N m)", "grip (N)")
    assert robot.dynamics.control_coordinates.high == (20.0, 8.0, 5.0)
    assert robot.dynamics.control_coordinates.low == (-20.0, -8.0, -5.0)
    model = robot.scene.model
    assert [model.body(k).name for k in range(1, model.nbody)] == [
        "base", "upper", "lower", "flange", "hand", "left", "right",
    ]  # fmt: skip
    assert [model.geom(k).name for k in range(model.ngeom)] == ["upper_visual", "upper_collision", "lower_collision"]
    assert model.geom_group.tolist() == [1, 3, 0]  # what collides is drawn where nothing else is
    assert model.geom_contype.tolist() == [0, 1, 1]
    # Damping, friction and limits are the file's.
    shoulder, elbow, *_ = robot.mjcf.joints
    assert shoulder.limits == (-2.0, 1.5)
    assert elbow.limits is None
    assert elbow.dof in robot.dynamics.state_coordinates.angles
    assert (model.dof_damping[0], model.dof_frictionloss[0]) == (0.5, 0.1)
    # A link has the masses of those that are fixed to it.
    assert model.body_mass[model.body("lower").id] == pytest.approx(0.75, rel=1e-15)
    assert robot.dynamics.numbers["mass"] == pytest.approx(1.95, rel=1e-15)


def test_the_largest_speeds_are_kept_with_the_limits_of_joints(arm: Path) -> None:
    robot = ls.MjcfRobot(arm)
    assert robot.joint_limits.bounds == {
        "shoulder": (-2.0, 1.5), "grip": (0.0, 0.04), "twin": (-0.05, 0.05), "shoulder_velocity": (-2.5, 2.5),
        "elbow_velocity": (-4.0, 4.0), "grip_velocity": (-0.1, 0.1), "twin_velocity": (-0.1, 0.1),
    }  # fmt: skip
    assert "limits of speed, kept only by robot.joint_limits: shoulder 2.5 rad/s, elbow 4 rad/s, grip 0.1 m/s" in str(
        robot
    )
    copy = robot.with_parameters(mass=3.0)  # an MJCF that is written anew
    assert copy.joint_limits.bounds == robot.joint_limits.bounds
    # An MJCF has speeds in the same place.
    arm.with_name("arm.xml").write_text(robot.scene.xml.replace('data="2.5"', 'data="1.5"'), encoding="utf-8")
    assert ls.MjcfRobot(arm.with_name("arm.xml")).joint_limits.bounds["shoulder_velocity"] == (-1.5, 1.5)


def test_a_joint_that_mimics_another_follows_it(arm: Path) -> None:
    robot = ls.MjcfRobot(arm)
    names = robot.dynamics.state_coordinates.names
    closed = robot.at(grip=0.03)
    assert closed[names.index("twin")] == pytest.approx(-0.02, abs=1e-9)  # the tolerance of equalities is 1e-10


def test_efforts_and_servos_can_be_stated(arm: Path, caplog: pytest.LogCaptureFixture) -> None:
    changed(arm, ('<limit effort="8" velocity="4"/>', ""))
    assert ls.MjcfRobot(arm).actuators == ("shoulder", "grip")
    assert [one.message for one in caplog.records] == [
        "arm.urdf: no motor for elbow: want an effort in <limit>, or efforts={'elbow': 10.0}, with 0.0 if there is none"
    ]
    caplog.clear()
    assert ls.MjcfRobot(ls.load_scene(arm, efforts={"elbow": 0.0})).actuators == ("shoulder", "grip")
    strong = ls.MjcfRobot(ls.load_scene(arm, efforts={"elbow": 3.0, "shoulder": 40}))
    assert strong.dynamics.control_coordinates.high == (40.0, 3.0, 5.0)
    mixed = ls.MjcfRobot(ls.load_scene(arm, servos={"shoulder": (300.0, 12.0), "elbow": (50.0, 2)}))
    assert not caplog.records
    shoulder, elbow, grip = mixed.mjcf.actuators
    assert (shoulder.gain, shoulder.bias) == ((300.0, 0.0, 0.0), (0.0, -300.0, -12.0))
    assert shoulder.forces == (-20.0, 20.0)
    assert elbow.forces == (-np.inf, np.inf)
    assert grip.bias == (0.0, 0.0, 0.0)
    assert mixed.dynamics.control_coordinates.labels == ("shoulder (rad)", "elbow (rad)", "grip (N)")
    assert mixed.dynamics.control_coordinates.high == (1.5, np.inf, 5.0)
    every = ls.MjcfRobot(ls.load_scene(arm, servos=(300.0, 12.0), efforts={"elbow": 3.0}))
    assert {one.bias for one in every.mjcf.actuators} == {(0.0, -300.0, -12.0)}
    # Servos stay at what holds them, but for twin, which has none and hangs on the spring of its coupling.
    state = every.at(shoulder=0.4, elbow=-0.3, grip=0.02)
    np.testing.assert_allclose(every.dynamics.step(state, every.hold(state), 0.02)[:3], state[:3], rtol=0, atol=1e-4)


def test_a_base_that_floats(arm: Path) -> None:
    robot = ls.MjcfRobot(ls.load_scene(arm, base="free"))
    names = robot.dynamics.state_coordinates.names
    assert names[:6] == ("x", "y", "z", "rx", "ry", "rz")
    assert robot.body == "base"
    assert robot.dynamics.numbers["mass"] == pytest.approx(4.95, rel=1e-15)
    # Nothing but gravity: the centre of mass falls freely.
    after = robot.dynamics.step(robot.at(z=1.0), robot.hold(robot.at(z=1.0)) * 0, 0.1)
    assert after[names.index("vz")] < -0.5
    # The same by a floating joint in the file, whose name the states have.
    floating = (
        '<link name="world"/><joint name="float" type="floating"><parent link="world"/><child link="base"/></joint>'
    )
    changed(arm, ('<robot name="arm">', f'<robot name="arm">{floating}'))
    stated = ls.MjcfRobot(arm)
    assert stated.dynamics.state_coordinates.names[:6] == tuple(f"float_{name}" for name in names[:6])
    np.testing.assert_allclose(
        stated.dynamics.step(stated.at(float_z=1.0), np.zeros(3), 0.1), after, rtol=0, atol=1e-12
    )
    with pytest.raises(InputError, match=r"^arm.urdf: base: got 'free', with base at the root, want one link there"):
        ls.load_scene(arm, base="free")


@pytest.mark.parametrize("links", [1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_what_floats_may_be_stated_below_any_fixed_links(tmp_path: Path, links: int, seed: int) -> None:
    """MuJoCo's free joints are of bodies in the world. It reads the file itself if it drops the fixed links."""
    rng, parts = np.random.default_rng(seed), ['<link name="link0"/>']
    for number in range(1, links + 2):
        kind = "fixed" if number < links else "floating" if number == links else "continuous"
        xyz, rpy = (" ".join(map(str, rng.normal(size=3))) for _ in range(2))
        parts.append(
            f'<link name="link{number}">{INERTIAL.format(number)}</link><joint name="joint{number}" type="{kind}">'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><parent link="link{number - 1}"/><child link="link{number}"/></joint>'
        )
    path = tmp_path / "thrown.urdf"
    path.write_text(f'<robot name="thrown">{"".join(parts)}</robot>', encoding="utf-8")
    model, wanted = ls.load_scene(path).model, mujoco.MjModel.from_xml_path(str(path))
    assert np.abs(model.qpos0[3:7] @ wanted.qpos0[3:7]) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(np.delete(model.qpos0 - wanted.qpos0, range(3, 7)), 0, atol=1e-12)
    qpos, qvel, accelerations = rng.normal(size=model.nq), rng.normal(size=model.nv), []
    for candidate in (model, wanted):
        data = mujoco.MjData(candidate)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_normalizeQuat(candidate, data.qpos)
        mujoco.mj_forward(candidate, data)
        accelerations.append(data.qacc.copy())
    np.testing.assert_allclose(*accelerations, rtol=1e-9, atol=1e-9)


TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


def test_meshes_are_found_by_package_and_beside_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Those that MuJoCo has no file for are left out, which is said; the link is then drawn as it collides."""
    names = (
        "package://arms/meshes/own.obj", "package://parts/one.obj", "package://more/two.obj", "own.obj",
        "../meshes/own.obj", "package://arms/meshes/drawn.dae", "package://arms/meshes/lost.dae",
    )  # fmt: skip
    for place in (
        "arms/meshes/own.obj",
        "arms/meshes/drawn.obj",
        "arms/urdf/own.obj",
        "ros/parts/one.obj",
        "new/share/more/two.obj",
    ):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text(TETRAHEDRON, encoding="utf-8")
    shapes = "".join(
        f'<{kind}><geometry><mesh filename="{name}" scale="1 2 1"/></geometry></{kind}>'
        for name in names
        for kind in ("visual", "collision")
    )
    file = tmp_path / "arms" / "urdf" / "arm.urdf"
    file.write_text(ARM.replace(BOX.format("visual"), shapes), encoding="utf-8")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "ros"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "new"))
    model = ls.MjcfRobot(file).scene.model
    meshes = [model.geom(k).name for k in range(model.ngeom) if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_MESH]
    assert len(meshes) == 2 * (len(names) - 1)
    assert model.body_mass[model.body("upper").id] == 1.0  # a mesh adds none
    told = [one.message for one in caplog.records]
    assert [line.partition(":")[2].partition(":")[0] for line in told] == [
        f" 1 {kind} meshes are left out, such as package" for kind in ("visual", "collision")
    ]
    # By a path of MuJoCo's own settings, without the folders that are named.
    (tmp_path / "flat").mkdir()
    (tmp_path / "flat" / "own.obj").write_text(TETRAHEDRON, encoding="utf-8")
    settings = f'<mujoco><compiler meshdir="{tmp_path / "flat"}" strippath="true"/></mujoco>'
    only = (
        '<collision><geometry><mesh filename="C:/elsewhere/own.obj"/></geometry></collision></link><link name="lower">'
    )
    file.write_text(
        ARM.replace('</link>\n  <link name="lower">', only).replace(
            '<robot name="arm">', f'<robot name="arm">{settings}'
        )
    )
    assert "upper_collision_1" in ls.MjcfRobot(file).scene.xml


def test_a_base_of_a_mesh_is_no_obstacle(arm: Path) -> None:
    """A mesh that is fixed to the world has no distance of ours, and needs none."""
    arm.with_name("own.obj").write_text(TETRAHEDRON, encoding="utf-8")
    foot = '<collision><geometry><mesh filename="own.obj"/></geometry></collision>'
    changed(arm, ('<link name="base">', f'<link name="base">{foot}'))
    for file in (arm, ls.load_scene(arm), ls.load_scene(arm, base="fixed")):
        assert ls.MjcfRobot(file).scene.world.names == ()


def test_shapes_that_mujoco_refuses_are_left_out(arm: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One in a plane has no hull, though it can be drawn; a box of nothing is for neither. Prefixes need no meaning."""
    arm.with_name("flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n", encoding="utf-8")
    flat = '<{0}><geometry drake:kind="flat"><mesh filename="flat.obj"/><drake:convex/></geometry></{0}>'
    nothing = '<visual><geometry><box size="0 0 0"/></geometry></visual>'
    shapes = "".join([flat.format("visual"), flat.format("collision"), nothing])
    model = ls.MjcfRobot(changed(arm, ('<link name="hand">', f'<link name="hand">{shapes}'))).scene.model
    assert model.geom("hand_visual").group == 1
    assert model.ngeom == 4
    (said,) = [one.message for one in caplog.records]
    assert "2 shapes are left out, such as hand_collision: Error: mesh 'flat' has coplanar vertices" in said


def test_the_extension_of_mujoco_has_the_last_word(arm: Path) -> None:
    """An inertia that no body can have is refused by MuJoCo, unless the file says that it is to be mended."""
    odd = ('<mass value="0.5"/><inertia ixx="0.01"', '<mass value="0.5"/><inertia ixx="0.3"')
    with pytest.raises(InputError, match=r"inertia must satisfy A \+ B >= C; use 'balanceinertia'"):
        ls.MjcfRobot(changed(arm, odd))
    settings = '<mujoco><compiler balanceinertia="true"/><option timestep="0.005" integrator="Euler"/></mujoco>'
    model = ls.MjcfRobot(changed(arm, odd, ("</robot>", f"{settings}</robot>"))).scene.model
    assert (model.opt.timestep, model.opt.integrator) == (0.005, mujoco.mjtIntegrator.mjINT_EULER)
    assert np.ptp(model.body_inertia[model.body("lower").id]) == 0
    # That of a fixed link does not matter, if with what it is fixed to it is a body's.
    hand = ('<mass value="0.25"/><inertia ixx="0.01"', '<mass value="0.25"/><inertia ixx="0.03"')
    assert ls.MjcfRobot(changed(arm, hand)).scene.model.nv == 4


def test_masses_may_be_those_of_the_shapes(arm: Path) -> None:
    settings = '<mujoco><compiler inertiafromgeom="true"/></mujoco>'
    bare = ('<link name="hand">', f'<link name="hand">{BOX.format("collision")}')
    other = ('<link name="left">', f'<link name="left">{BOX.format("collision")}')
    right = ('<link name="right">', f'<link name="right">{BOX.format("collision")}')
    model = ls.MjcfRobot(changed(arm, bare, other, right, ("</robot>", f"{settings}</robot>"))).scene.model
    assert model.body("upper").mass[0] == pytest.approx(1000 * 0.2 * 0.04 * 0.04, rel=1e-12)  # water, as MuJoCo has it


@pytest.mark.parametrize("base", ["fixed", "free"])
@pytest.mark.parametrize("shaped", [("hand",), ("hand", "flange"), ("hand", "base"), ("hand", "flange", "base")])
def test_a_mass_that_a_shape_gives_counts_once(arm: Path, base: Any, shaped: tuple[str, ...]) -> None:
    """Of a link that is fixed to another, too, whatever its <inertial> says; links without a shape keep theirs."""
    settings, box = '<mujoco><compiler inertiafromgeom="true"/></mujoco>', BOX.format("collision")
    lower = f'<link name="lower">{INERTIAL.format(0.5)}'
    links = {f'<link name="{link}">': f'<link name="{link}">{box}' for link in (*shaped, "left", "right")}
    if links.pop('<link name="flange">', None):
        links |= {'<link name="flange"/>': f'<link name="flange">{box}</link>'}
    changed(arm, (lower + box, lower), *links.items(), ("</robot>", f"{settings}</robot>"))
    model, water = ls.load_scene(arm, base=base).model, 1000 * 0.2 * 0.04 * 0.04
    spec = mujoco.MjSpec.from_file(str(arm))
    spec.compiler.fusestatic = False
    if base == "free":
        spec.worldbody.bodies[0].add_freejoint()
    wanted, masses = spec.compile(), []
    for candidate in (model, wanted):
        data, matrix = mujoco.MjData(candidate), np.zeros((candidate.nv, candidate.nv))
        data.qpos[-4:] = 0.1, 0.2, 0.01, 0.02
        mujoco.mj_forward(candidate, data)
        mujoco.mj_fullM(candidate, data, matrix)
        masses.append(matrix)
    np.testing.assert_allclose(masses[0], masses[1], rtol=0, atol=1e-9)
    assert model.body("hand").mass[0] == pytest.approx(water, rel=1e-12)


def test_links_that_overlap_at_zero_pass_through_each_other(arm: Path, caplog: pytest.LogCaptureFixture) -> None:
    """MuJoCo lets two collide that are two joints apart, and one with a fixed base."""
    block = '<collision><geometry><box size="2 0.2 0.9"/></geometry></collision>'
    changed(arm, ('<link name="base">', f'<link name="base">{block}'))
    robot = ls.MjcfRobot(arm)
    assert [one.message for one in caplog.records] == [
        "arm.urdf: links that touch at zero never collide: base and upper, base and lower"
    ]
    assert "touching at rest" not in str(robot)
    free = ls.MjcfRobot(ls.load_scene(changed(arm)))
    still = free.dynamics.step(free.at(elbow=1.0), np.zeros(3), 0.02)
    np.testing.assert_allclose(robot.dynamics.step(robot.at(elbow=1.0), np.zeros(3), 0.02), still, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([("</robot>", "")], r"URDF: got arm.urdf, which is not XML \(.*\), want a URDF"),
        ([("<robot name", "<mujoco name"), ("</robot>", "</mujoco>")], "with <mujoco> at its root, want <robot>"),
        ([('<link name="flange"/>', '<link name="hand"/>')], "which MuJoCo refuses: .*repeated URDF name"),
        ([('<joint name="twin"', '<joint name="grip"')], "which MuJoCo refuses: .*repeated name 'grip' in joint"),
        ([('<mass value="0.5"/>', '<mass value="inf"/>')], "scene arm: got .*"),
        ([('type="continuous"', 'type="hinged"')], "which MuJoCo refuses: .*invalid joint type"),
        ([('velocity="4"', 'velocity="fast"')], "arm.urdf: got 'fast' for the velocity of elbow, want a number"),
        ([('<mass value="0.5"/>', '<mass value="0"/>'), ('<mass value="0.25"/>', '<mass value="0"/>')],
         "mass and inertia of moving bodies must be larger.*'lower'"),
        ([('lower="-2" upper="1.5"', 'lower="2" upper="1.5"')], "got limits from 2 to 1.5 for shoulder, want"),
        ([('<mass value="0.5"/>', '<mass value="nan"/>')], "got NaN"),
        ([('<link name="flange"/>', '<link name="flange"/><xacro:arm xmlns:xacro="http://ros.org/xacro"/>')],
         r"got arm.urdf with macros, want what `xacro arm\.urdf` prints"),
        ([("</robot>", "".join(f'<link name="l{k}"/>' for k in range(500)) + "</robot>")], "with 507 links, want 490"),
    ],
)  # fmt: skip
def test_what_is_no_urdf_or_no_robot_is_said_in_a_line(
    arm: Path, pairs: list[tuple[str, str]], message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match=message):
        ls.MjcfRobot(changed(arm, *pairs))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"base": "floating"}, "arm.urdf: base: got 'floating', want one of: fixed, free"),
        ({"efforts": {"twin": 3.0}}, "efforts: got 'twin', want one of: shoulder, elbow, grip"),
        ({"efforts": {"elbow": -1.0}}, "efforts of elbow: got -1.0, want"),
        ({"efforts": 3.0}, "efforts: got 3.0, want numbers by joint"),
        ({"efforts": np.ones((2, 4))}, "efforts: got array("),
        ({"armature": {"wrist": 0.1}}, "armature: got 'wrist', want one of: shoulder, elbow, grip, twin"),
        ({"armature": -0.1}, "armature of shoulder: got -0.1, want"),
        ({"servos": {"wrist": (1.0, 1.0)}}, "servos: got 'wrist', want one of: shoulder, elbow, grip"),
        ({"servos": {"elbow": 20.0}}, "servos of elbow: got 20.0, want two numbers, the stiffness and the damping"),
        ({"servos": (1.0, 2.0, 3.0)}, "servos of shoulder: got .*, want two numbers"),
    ],
)
def test_wrong_arguments_are_named(arm: Path, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message).replace(r"\.\*", ".*")):
        ls.load_scene(arm, **arguments)
    with pytest.raises(InputError, match=r"URDF: got 'arena', want the path of a \.urdf file"):
        ls.load_scene("arena", **arguments)


def test_a_follower_of_no_joint_is_named(arm: Path, caplog: pytest.LogCaptureFixture) -> None:
    robot = ls.MjcfRobot(changed(arm, ('<mimic joint="grip"', '<mimic joint="glue"')))
    assert [one.message for one in caplog.records] == [
        "arm.urdf: no joint is followed by twin: want a <mimic> of one that turns or slides"
    ]
    assert robot.actuators == ("shoulder", "elbow", "grip", "twin")


@pytest.mark.parametrize("armature", [0.03, {"elbow": 0.02, "grip": 0.4}])
def test_armature_is_on_the_diagonal_of_the_mass_matrix(arm: Path, armature: float | dict[str, float]) -> None:
    def mass(**stated: Any) -> Array:
        model = ls.load_scene(arm, **stated).model
        data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        return full

    names = ("shoulder", "elbow", "grip", "twin")
    added = [armature.get(name, 0.0) if isinstance(armature, dict) else armature for name in names]
    np.testing.assert_allclose(mass(armature=armature) - mass(), np.diag(added), rtol=0, atol=1e-12)


def test_it_stands_where_a_scenario_is_named(
    arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the URDF to a video, with settings of its own, in a folder that is not its own."""
    reference = "arm.urdf,servos={'grip': (300.0, 10.0)},efforts={'elbow': 9.0},goal={'shoulder': 0.4},steps=20"
    monkeypatch.chdir(tmp_path)
    assert not names_code(reference)
    assert from_anywhere(reference) == f"{tmp_path}/{reference}"
    scenario = resolve(reference)
    assert isinstance(scenario.robot, ls.MjcfRobot)
    by_hand = ls.MjcfRobot(ls.load_scene(arm, servos={"grip": (300.0, 10.0)}, efforts={"elbow": 9.0}))
    assert scenario.robot.mjcf.xml == by_hand.mjcf.xml
    assert scenario.robot.dynamics.control_coordinates.high == (20.0, 9.0, 0.04)
    (tmp_path / "cart.xml").write_text(by_hand.scene.xml, encoding="utf-8")
    with pytest.raises(InputError, match=r"URDF: got 'cart.xml', want the path of a \.urdf file"):
        resolve("cart.xml,base=free")
    assert main(["solve", reference, "--out", "runs"]) == 0
    monkeypatch.chdir(tmp_path.parent)
    assert main(["simulate", f"{tmp_path}/runs/solution.npz", "--out", str(tmp_path / "runs")]) == 0
    assert "in arm" in capsys.readouterr().out
    rollout = ls.load(tmp_path / "runs" / "rollout.npz", ls.Rollout)
    assert rollout.tracking_error.max() < 1e-6  # nothing disturbs it
    assert ls.verify_run(rollout).passed
    if not gl.missing():
        few = ["--out", str(tmp_path / "arm.mp4"), "--quality", "draft", "--fps", "5"]
        assert main(["render", str(tmp_path / "runs" / "rollout.npz"), *few]) == 0


def test_a_plant_of_it_agrees_with_it(arm: Path) -> None:
    robot = ls.MjcfRobot(arm)
    found = ls.check_plant(robot, robot.scene, samples=5)
    assert found.good


def test_an_mjcf_includes_what_a_urdf_becomes(arm: Path) -> None:
    """With ground and obstacles: joints in radians, in a file that has another mass by its density."""
    arm.with_name("arm.xml").write_text(ls.load_scene(arm, base="free").xml, encoding="utf-8")
    file = arm.with_name("field.xml")
    things = """<geom name="ground" type="plane" size="5 5 .1"/>
      <geom name="post" type="cylinder" size=".1 1" pos="2 0 1"/>
      <body name="ball" pos="3 0 1"><freejoint/><geom size="0.1"/></body>"""
    file.write_text(scene(things, before='<include file="arm.xml"/>'), encoding="utf-8")
    robot = ls.MjcfRobot(file, body="base")
    file.with_name("wrong.xml").write_text(scene("", before='<include file="arm.urdf"/>'), encoding="utf-8")
    with pytest.raises(
        InputError, match=r"^scene: got arm\.urdf, which is a URDF, want a name that ends in \.urdf; to be"
    ):
        ls.load_scene(file.with_name("wrong.xml"))
    assert "post" in robot.scene.world.names
    assert robot.mjcf.joints[1].limits == (-2.0, 1.5)
    assert robot.scene.model.body("ball").mass[0] == pytest.approx(1000 * 4 / 3 * np.pi * 1e-3, rel=1e-12)
