"""An MJCF as a record: compiled once, with joints and actuators as MuJoCo has them, and found again in its spec."""

import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mechanisms
import mujoco
import numpy as np
import pytest

import lqrsim as ls
from lqrsim.scenes.mjcf_model import MjcfModel

THINGS = '<geom type="plane" size="2 2 .1"/><geom type="sphere" size=".1" pos="0 2 .5"/>'
ARM = mechanisms.arm(0.3, names=["turn"], place="0 0 1", limits=[5], things=THINGS)


@contextmanager
def compilations() -> Iterator[list[str]]:
    """The names of the ways by which MuJoCo compiles in this context, in turn."""
    found: list[str] = []
    ways = [(mujoco.MjModel, "from_xml_string"), (mujoco.MjModel, "from_xml_path"), (mujoco.MjSpec, "compile")]
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in ways:
            old = getattr(owner, name)

            def counted(*arguments, old=old, name=name, **others):
                found.append(name)
                return old(*arguments, **others)

            patch.setattr(owner, name, counted if owner is mujoco.MjSpec else staticmethod(counted))
        yield found


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    return path


def test_a_file_is_compiled_once_for_the_robot_and_its_plans_and_once_for_each_plant(arm: Path) -> None:
    """This file has no light, so that what is compiled also has the one that pictures need."""
    ls.Plant(ls.Quadrotor(), ls.load_scene("cage"))  # MuJoCo compiles an empty model when its module batch is imported
    with compilations() as found:
        robot = ls.MjcfRobot(arm)
        assert len(found) == 1
        problem = robot.problem(robot.at(), robot.at(turn=0.1), steps=5)
        assert robot.dynamics.physics._kernel_numbers is None  # MuJoCo's memory is made at the solve
        solution = ls.smooth(problem, max_iterations=2)
        assert str(robot)
        assert len(found) == 1
        plant = ls.Plant(robot, robot.scene)
        ls.simulate(plant, solution)
        assert len(found) == 2
        assert len(pickle.loads(pickle.dumps((robot, problem)))[0].scene.model.names) > 0
        assert len(found) == 3


def test_what_has_all_names_and_a_light_is_not_compiled_again_for_a_robot(arm: Path) -> None:
    scene = ls.MjcfRobot(arm).scene
    with compilations() as found:
        other = ls.MjcfRobot(scene)
        assert found == []
        assert other.mjcf is scene.mjcf
        assert other.with_parameters(mass=2.0).mjcf.model.body_mass.sum() == pytest.approx(2.0, rel=1e-12)
        assert len(found) == 1


def test_the_light_that_is_added_is_the_same_in_the_text(arm: Path) -> None:
    """The model is compiled before the place of the light is known. MuJoCo's text has six digits."""
    mjcf = ls.MjcfRobot(arm).mjcf
    again = mujoco.MjModel.from_xml_string(mjcf.xml)
    middle, size = again.stat.center, again.stat.extent
    np.testing.assert_allclose(mjcf.model.light_pos[0], middle + size * np.array([-1, -1, 3]), rtol=1e-5)
    for field in dir(again):
        value = getattr(again, field)
        if not field.startswith("_") and isinstance(value, np.ndarray):
            np.testing.assert_allclose(getattr(mjcf.model, field), value, rtol=1e-14, atol=1e-14, err_msg=field)


# Of each kind: an actuator, and whether its force is affine in its input.
ACTUATORS = {
    "motor": ('<motor {on} gear="3" forcerange="-.2 .4"/>', True),
    "position": ('<position {on} kp="70" kv="3" forcerange="-5 5"/>', True),
    "velocity": ('<velocity {on} kv="4" gear="2"/>', True),
    "intvelocity": ('<intvelocity {on} kp="9" actrange="-2 2"/>', True),
    "damped": ('<damper {on} kv="2" ctrlrange="0 3"/>', True),
    "filtered": (
        '<general {on} dyntype="filterexact" dynprm=".1" gainprm="8" biastype="affine" biasprm="1 -2 -3"/>',
        True,
    ),
    "early": ('<general {on} dyntype="filter" dynprm=".1" gainprm="8" actearly="true"/>', False),
    "cylinder": ('<cylinder {on} timeconst=".1" area="2" bias="1 2 3"/>', True),
    "muscle": ('<muscle {on} lengthrange=".1 1"/>', False),
    "pid": ('<pid {on} kp="20" kv="2" ki="5" input="pos vel"/>', False),
    "dcmotor": ('<dcmotor {on} motorconst="0.5 0.5" resistance="2"/>', False),
}


@pytest.mark.parametrize("kind", ["hinge", "slide"])
@pytest.mark.parametrize("limits", ["", 'actuatorfrcrange="-6 3"'], ids=["free", "limited"])
@pytest.mark.parametrize("name", ACTUATORS)
def test_forces_of_actuators_are_those_of_mujoco(name: str, limits: str, kind: str) -> None:
    """The record's gain, bias and limits, at random states, against `mj_forward`."""
    text, affine = ACTUATORS[name]
    joint, driven = f'type="{kind}" axis="0 1 0" {limits}', text.format(on='name="a" joint="turn"')
    mjcf = MjcfModel(name, mechanisms.row(["turn"], joint=joint, actuators=driven, option='gravity="0 0 0"'))
    (actuator,), (joint,) = mjcf.actuators, mjcf.joints
    assert (actuator.name, actuator.joint) == ("a", "turn")
    assert joint.forces == ((-6, 3) if limits else (-np.inf, np.inf))
    assert (actuator.gain is not None) == (actuator.bias is not None) == affine
    rng, data = np.random.default_rng(0), mujoco.MjData(mjcf.model)
    clipped = 0
    for _ in range(20 * affine):
        data.qpos[:], data.qvel[:], data.act[:] = (
            rng.normal(size=len(part)) for part in (data.qpos, data.qvel, data.act)
        )
        data.ctrl[:] = rng.uniform(0, 1, len(data.ctrl))
        mujoco.mj_forward(mjcf.model, data)
        motion = np.array([1.0, actuator.gear * data.qpos[0], actuator.gear * data.qvel[0]])
        inputs = [*data.ctrl[actuator.controls], *data.act[actuator.activations]]
        assert actuator.gain is not None
        assert actuator.bias is not None
        free = (actuator.gain @ motion) * inputs[-1] + actuator.bias @ motion
        force = np.clip(free, *actuator.forces)
        np.testing.assert_allclose(data.actuator_force[actuator.outputs], force, rtol=1e-12, atol=1e-12)
        on_joint = np.clip(actuator.gear * force, *joint.forces)
        np.testing.assert_allclose(data.qfrc_actuator, on_joint, rtol=1e-12, atol=1e-12)
        clipped += int(force != free)
    assert (clipped > 0) == (affine and name in ("motor", "position"))


HAND = mechanisms.scene(
    """<body name="hand"><freejoint/><geom size=".1"/><site name="palm"/>
    <body><joint axis="0 1 0"/><geom size=".1"/></body></body>""",
    '<motor site="palm" gear="0 0 1 0 0 0"/>',
)
TWO = mechanisms.scene(
    """<body name="b"><body name="c"><geom size=".1"/></body><geom size=".2"/></body><geom type="box" size="1 1 .1"/>
    <replicate count="2" offset="1 0 0"><body name="r"><geom size=".1" mass="1"/></body></replicate>
    <frame pos="0 0 1"><attach model="hand" body="hand" prefix="left_"/></frame>
    <frame pos="0 1 1"><attach model="hand" body="hand" prefix="right_"/></frame>""",
    before='<asset><model name="hand" file="hand.xml"/></asset>',
)


@pytest.fixture
def two(tmp_path: Path) -> Path:
    (tmp_path / "hand.xml").write_text(HAND)
    (tmp_path / "two.xml").write_text(TWO)
    return tmp_path / "two.xml"


def test_two_robots_in_a_file_are_told_apart(two: Path) -> None:
    """Both are the same file without names, attached twice."""
    robot = ls.MjcfRobot(two)
    states, elements = robot.dynamics.state_coordinates.names, [*robot.joints, *robot.actuators]
    assert {"left_hand_x", "right_hand_x", "left_hand_wz", "right_hand_vx"} <= set(states)
    assert len(set(states)) == len(states) == 28
    assert len(set(elements)) == len(elements) == 6
    model = robot.scene.model
    names = [
        [one(k).name for k in range(count)] for one, count in ((model.body, model.nbody), (model.geom, model.ngeom))
    ]
    assert all(len({*some}) == len(some) and all(some) for some in names)
    other, plant = pickle.loads(pickle.dumps(robot)), ls.Plant(robot, robot.scene)
    assert other.joints == robot.joints == tuple(plant.model.joint(k).name for k in range(plant.model.njnt))
    one = ls.MjcfRobot(two, body="right_hand")
    assert one.dynamics.state_coordinates.position == tuple(
        map(states.index, ("right_hand_x", "right_hand_y", "right_hand_z"))
    )


def test_geoms_of_a_spec_are_in_the_order_of_their_ids(two: Path) -> None:
    """A plant finds the scene's geoms before it compiles: in bodies, replicas, frames and attached models."""
    for mjcf in (MjcfModel.of_file(two), MjcfModel.of_file(two).named(), *map(MjcfModel.of_file, ("arena", "cage"))):
        spec = mjcf.spec()
        for k, geom in enumerate(spec.geoms):
            geom.name = f"geom {k}"
        model = spec.compile()
        assert [model.geom(k).name for k in range(model.ngeom)] == [f"geom {k}" for k in range(model.ngeom)]
        np.testing.assert_array_equal(model.geom_bodyid, mjcf.model.geom_bodyid)
        np.testing.assert_array_equal(model.geom_size, mjcf.model.geom_size)
