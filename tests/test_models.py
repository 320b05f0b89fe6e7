"""The MJCF of each robot against its constants, its analytic model, and independent maps of rotations."""

import mujoco
import numpy as np
import pytest
from mechanisms import scene
from scipy.spatial.transform import Rotation

from lqrsim import robots
from lqrsim.errors import InputError
from lqrsim.robots.packaged import DifferentialDrive, Quadrotor
from lqrsim.scenes.mjcf_model import names
from lqrsim.scenes.scene import load_scene
from lqrsim.simulation.plant import Plant
from lqrsim.simulation.plant_check import check_plant


@pytest.fixture
def open_floor(tmp_path):
    path = tmp_path / "open_floor.xml"
    path.write_text(scene('<geom name="floor" type="plane" size="5 5 0.1"/>', before='<include file="create.xml"/>'))
    return Plant(DifferentialDrive(), load_scene(path))


def test_registry_finds_each_robot():
    assert robots.names() == ["differential_drive", "quadrotor"]
    assert isinstance(robots.get("quadrotor"), Quadrotor)
    with pytest.raises(InputError, match=r"^robot: got 'quadrotr', want one of: differential_drive, quadrotor"):
        robots.get("quadrotr")


@pytest.mark.parametrize("name", robots.names())
def test_each_robot_stands_in_a_packaged_scene_and_maps_there_and_back(name):
    robot = robots.get(name)
    scenes = [scene for scene in map(load_scene, names()) if robot.body in [b.name for b in _bodies(scene.model)]]
    plant = Plant(robot, scenes[0])
    space = robot.dynamics.state_coordinates
    states = np.random.default_rng(0).uniform(-1.5, 1.5, (7, 3, len(space)))
    qpos, qvel = robot.configuration(states)
    assert qpos.shape == (7, 3, len(plant.qpos))
    assert qvel.shape == (7, 3, len(plant.qvel))
    # Rounding of a dozen operations on numbers of order one.
    np.testing.assert_allclose(space.difference(robot.state(qpos, qvel), states), 0, atol=1e-14)
    one = robot.state(*robot.configuration(states[2, 1]), near=states[2, 1])
    np.testing.assert_allclose(one, states[2, 1], atol=1e-14)
    limits = [robot.dynamics.control_coordinates.low, robot.dynamics.control_coordinates.high]
    np.testing.assert_array_equal(plant.model.actuator_ctrlrange[plant.ctrl].T, robot.actuation(limits))


def test_quadrotor_mjcf_has_the_constants_of_the_model():
    robot, model = Quadrotor(), load_scene("cage").model
    body = model.body("quadrotor")
    assert body.mass[0] == robot.mass
    np.testing.assert_array_equal(body.inertia, [robot.inertia] * 3)
    np.testing.assert_array_equal(body.ipos, 0)
    np.testing.assert_array_equal(model.opt.gravity, [0, 0, -robot.gravity])
    np.testing.assert_array_equal(model.dof_damping, [robot.drag] * 3 + [0] * 3)
    assert model.geom("quadrotor_sphere").size[0] == robot.radius
    places = [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]
    for i, (place, turn) in enumerate(zip(places, [1, -1, 1, -1], strict=True), start=1):
        np.testing.assert_allclose(model.site(f"quadrotor_rotor_{i}").pos, np.multiply(place, robot.arm))
        gear = model.actuator(f"quadrotor_rotor_{i}").gear
        np.testing.assert_array_equal(gear, [0, 0, 1, 0, 0, turn * robot.torque_ratio])
    assert (model.opt.timestep, model.opt.integrator) == (1 / 30, mujoco.mjtIntegrator.mjINT_RK4)


def test_differential_drive_mjcf_has_the_constants_of_the_model():
    robot, model = DifferentialDrive(), load_scene("arena").model
    for side, sign in (("left", 1), ("right", -1)):
        np.testing.assert_allclose(model.body(f"create_wheel_{side}").pos, [0, sign * robot.axle_length / 2, 0])
        assert model.geom(f"create_tread_{side}").size[0] == robot.wheel_radius
        # The servo acts on the speed of the rim: its gear is the wheel's radius.
        assert model.actuator(f"create_wheel_{side}").gear[0] == robot.wheel_radius
    disc = model.geom("create_disc")
    assert (disc.size[0], *disc.pos[:2]) == (robot.radius, 0, 0)
    np.testing.assert_allclose(model.body("create").ipos[:2], 0, atol=1e-12)


def test_one_control_period_of_the_quadrotor_equals_the_analytic_step():
    robot, model = Quadrotor(), load_scene("cage").model
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT  # some of the random states are inside bars
    data, draw, worst = mujoco.MjData(model), np.random.default_rng(0), 0.0
    for _ in range(200):
        axis = draw.normal(size=3)
        rotation = draw.uniform(0, 3) * axis / np.linalg.norm(axis)
        state = np.concatenate([draw.uniform(-2, 2, 6), rotation, draw.uniform(-3, 3, 3)])
        control = draw.uniform(0, robot.max_force, 4)
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = robot.configuration(state)
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        expected = robot.dynamics.step(state, control, model.opt.timestep)
        difference = robot.dynamics.state_coordinates.difference(robot.state(data.qpos, data.qvel), expected)
        worst = max(worst, np.abs(difference).max())
    # Both are Runge-Kutta steps of order 4, of a quaternion there and of a rotation vector here.
    assert worst < 1e-6


def test_rotation_vectors_and_quaternions_agree_with_scipy_also_near_none_and_half_a_turn():
    robot, draw = Quadrotor(), np.random.default_rng(1)
    axes = draw.normal(size=(40, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.array([0.0, 1e-300, 1e-13, 1e-9, 1e-5, 0.5, 3.0, np.pi - 1e-9, np.pi])
    rotations = (angles[:, None, None] * axes).reshape(-1, 3)
    states = np.zeros((len(rotations), 12))
    states[:, 6:9] = rotations
    qpos, qvel = robot.configuration(states)
    expected = Rotation.from_rotvec(rotations).as_matrix()
    there = Rotation.from_quat(qpos[:, 3:], scalar_first=True).as_matrix()
    np.testing.assert_allclose(there, expected, atol=1e-14)
    for sign in (1, -1):  # q and -q are the same rotation
        qpos[:, 3:] *= sign
        back = robot.state(qpos, qvel)[:, 6:9]
        assert (np.linalg.norm(back, axis=1) <= np.pi + 1e-12).all()
        np.testing.assert_allclose(Rotation.from_rotvec(back).as_matrix(), expected, atol=1e-14)
    # Small rotations keep their digits, not only their size.
    small = (angles > 0) & (angles < 1e-4)
    np.testing.assert_allclose(back.reshape(9, 40, 3)[small], rotations.reshape(9, 40, 3)[small], rtol=1e-9, atol=0)


def test_a_rotation_beyond_half_a_turn_comes_back_next_to_the_nominal_one():
    robot = Quadrotor()
    state = np.zeros(12)
    state[6:9] = 0.0, 0.0, 4.0
    qpos, qvel = robot.configuration(state)
    np.testing.assert_allclose(robot.state(qpos, qvel)[8], 4.0 - 2 * np.pi)
    np.testing.assert_allclose(robot.state(qpos, qvel, near=state)[8], 4.0)


@pytest.mark.parametrize("start", [(0.0, -2.5, np.pi), (1.0, 0.5, -1.0)])
def test_differential_drive_open_loop_stays_within_5_cm_of_the_analytic_model(open_floor, start):
    robot, times = open_floor.robot, np.arange(150) / 6
    controls = np.stack([0.25 + 0.15 * np.sin(times), 0.25 + 0.15 * np.cos(0.7 * times)], axis=1)
    data = mujoco.MjData(open_floor.model)
    expected = np.array(start)
    data.qpos[:], data.qvel[:] = robot.configuration(expected)
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(open_floor.model, data, open_floor.substeps(1 / 6))
        expected = robot.dynamics.step(expected, control, 1 / 6)
        position = robot.state(data.qpos, data.qvel)[:2]
        assert np.linalg.norm(position - expected[:2]) < 0.05
    # It did drive: wheels roll, and the plan winds through more than five radians.
    assert np.abs(data.qpos[-2:]).min() > 50
    np.testing.assert_allclose(data.qpos[2], robot.wheel_radius, atol=1e-4)


def test_differential_drive_turns_on_the_spot_by_the_wheels_alone(open_floor):
    robot, data = open_floor.robot, mujoco.MjData(open_floor.model)
    data.qpos[:], data.qvel[:] = robot.configuration(np.zeros(3))
    data.ctrl[:] = -0.2, 0.2
    mujoco.mj_step(open_floor.model, data, round(10 / open_floor.timestep))
    turned = 10 * 0.4 / robot.axle_length
    # 1 %: the start from rest, and the wheels' sinking in by some micrometres.
    error = robot.dynamics.state_coordinates.difference(robot.state(data.qpos, data.qvel), [0, 0, turned])
    assert abs(error[2]) < 0.01 * turned
    assert np.linalg.norm(error[:2]) < 1e-3


def _bodies(model):
    return [model.body(i) for i in range(model.nbody)]


def test_check_plant_agrees_for_our_own_and_names_what_differs():
    quadrotor = check_plant(Quadrotor(), load_scene("cage"))
    assert quadrotor.good
    assert quadrotor.relative.max() < 1e-4  # one Runge-Kutta step each
    assert check_plant(DifferentialDrive(), load_scene("arena")).good
    with pytest.raises(InputError, match="want a Robot, such as"):
        check_plant(Quadrotor, "cage")  # pyright: ignore[reportArgumentType]
    heavy = check_plant(Quadrotor(mass=0.6), load_scene("cage"))
    assert not heavy.good
    assert heavy.worst in ("vx", "vy", "vz", "x", "y", "z")
    assert f"DISAGREES (tolerance 0.02 of the change); worst state: {heavy.worst}, MuJoCo" in str(heavy)
    with pytest.raises(InputError, match=r"controls: got .*want .*each a number or"):
        check_plant(Quadrotor(), load_scene("cage"), controls=((0, 1), (1, 2)))


@pytest.mark.parametrize("value", [-1, 0, np.nan, np.inf, "heavy", None])
@pytest.mark.parametrize(
    ("robot", "field"),
    [
        (Quadrotor, field)
        for field in ("mass", "inertia", "arm", "max_force", "radius", "drag", "gravity", "torque_ratio")
    ]
    + [(DifferentialDrive, field) for field in ("axle_length", "radius", "max_speed", "wheel_radius")],
)
def test_impossible_constants_are_refused(robot, field, value):
    if value == 0 and field in ("drag", "gravity", "torque_ratio"):
        assert getattr(robot(**{field: value}), field) == 0
        return
    with pytest.raises(InputError, match=f"{robot.__name__}: {field}: got .*, want a finite number >"):
        robot(**{field: value})
