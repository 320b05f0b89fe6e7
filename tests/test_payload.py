"""Loads on the bodies of a robot from an MJCF: as dynamics, as a disturbance, and as an unknown that a filter finds."""

from functools import cache

import mujoco
import numpy as np
import pytest
from mechanisms import motors, row, scene, sled
from tracking import open_loop, track

import lqrsim as ls
from lqrsim.disturbances import MassMismatch, Payload, Unknown
from lqrsim.scenes.scene import scene_from_xml

GRAVITY, LENGTH, OWN, ARMATURE = 9.81, 0.5, 0.4, 0.05  # m/s^2, m, kg, kg m^2

# A beam on a hinge, that points along x; its hand's centre of mass is LENGTH from the hinge.
BEAM = scene(
    f"""<body name="beam"><joint name="hinge" axis="0 -1 0" damping="0.5" armature="{ARMATURE}"/>
    <inertial pos="0.2 0 0" mass="1" diaginertia="0.01 0.02 0.03"/>
    <body name="hand" pos="0.4 0 0">
      <inertial pos="0.1 0 0" mass="{OWN}" diaginertia="0.001 0.001 0.001"/></body></body>""",
    motors(["hinge"], [50]),
    option='timestep="0.01" integrator="implicitfast"',
)
INERTIA = ARMATURE + 0.02 + 0.2**2 + 0.001 + OWN * LENGTH**2  # about the hinge


@cache
def beam() -> ls.MjcfRobot:
    return ls.MjcfRobot(scene_from_xml(BEAM, "beam"))


def test_a_load_is_a_point_mass_at_the_centre_of_mass() -> None:
    """As the same MJCF does with a body of such a mass welded there."""
    robot, spec = beam(), mujoco.MjSpec.from_string(BEAM)
    added = spec.body("hand").add_body(pos=[0.1, 0, 0], ipos=[0, 0, 0], mass=0.7, inertia=[1e-15] * 3)
    added.explicitinertial = True
    model = spec.compile()
    data = mujoco.MjData(model)
    state, control = robot.at(hinge=0.4, hinge_velocity=-1.2), np.array([3.0])
    data.qpos[:], data.qvel[:], data.ctrl[:] = state[0], state[1], control
    mujoco.mj_step(model, data, 2)
    loaded = robot.dynamics.disturbed.with_parameters(hand_load=0.7)
    np.testing.assert_allclose(loaded.step(state, control, 0.02), [data.qpos[0], data.qvel[0]], rtol=0, atol=1e-13)
    # The dynamics without a load did not change, also in a memory that just had one.
    bare = robot.dynamics.step(state, control, 0.02)
    np.testing.assert_array_equal(robot.dynamics.disturbed.step(state, control, 0.02), bare)
    np.testing.assert_array_equal(loaded.with_parameters(hand_load=0.0).step(state, control, 0.02), bare)
    A, B, c = loaded.linearize(state, control, 0.02)
    np.testing.assert_allclose(A @ state + B @ control + c, loaded.step(state, control, 0.02), rtol=0, atol=1e-12)
    assert B[1, 0] < 0.9 * robot.dynamics.linearize(state, control, 0.02)[1][1, 0]  # it is more to move


def held() -> tuple[ls.MjcfRobot, ls.Problem, ls.Solution]:
    """A plan of 4 s that holds the beam level."""
    robot = beam()
    problem = robot.problem(robot.at(), robot.at(), steps=200, dt=0.02)
    return robot, problem, ls.smooth(problem)


def test_a_filter_finds_the_load_and_the_law_holds_it_with_its_static_torque() -> None:
    """m g l by the law, where `track` sags by m g l over its gain, which its own policy says."""
    robot, problem, solution = held()
    plant, load = ls.Plant(robot, robot.scene), Payload(1.0, "hand")
    alone = GRAVITY * (0.2 + OWN * LENGTH)
    np.testing.assert_allclose(solution.trajectory.controls, alone, rtol=1e-6)
    uncertainty = ls.uncertainty_of(plant, [load])
    assert uncertainty.unknowns == (Unknown({"hand_load": 1.0}, 1.0),)
    tolerate = {"rad": 0.05, "rad/s": 0.5}
    law = ls.OffsetFree(problem, solution, uncertainty, tolerate=tolerate, record=True)
    # A load speeds the level beam up by -m g l over its inertia, for the filter.
    effect = law.model.effects[0, 1, law.model.parameters.index("hand_load")]
    expected = -GRAVITY * LENGTH / (INERTIA + 0.5 * 0.01) * 0.01  # in a step; damping is implicit
    once = expected + expected * (INERTIA / (INERTIA + 0.5 * 0.01))
    np.testing.assert_allclose(effect, once, rtol=1e-3)  # the beam turns a little in two steps
    run = ls.simulate(plant, solution, controller=law, disturbances=[load])
    np.testing.assert_allclose(run.applied[0, -1] - alone, 1.0 * GRAVITY * LENGTH, rtol=1e-3)
    np.testing.assert_allclose(run.controller_run.estimates[-2, 0, -1], 1.0, rtol=1e-3)
    assert abs(run.states[0, -1, 0]) < 1e-4
    tracking = ls.track(problem, solution, tolerate=tolerate)
    sagged = ls.simulate(plant, solution, controller=tracking, disturbances=[load]).states[0]
    sag, rate = -sagged[120]
    assert abs(rate) < 1e-3
    torque = -tracking.gain[120, 0, 0] * sag
    wanted = GRAVITY * LENGTH * np.cos(sag) - alone * (1 - np.cos(sag))
    np.testing.assert_allclose(torque, wanted, rtol=0.02)  # the gains change a little with time


def test_a_mass_mismatch_is_one_unknown_with_the_bodies_masses_as_shares() -> None:
    robot = beam()
    plant = ls.Plant(robot, robot.scene)
    (unknown,) = ls.uncertainty_of(plant, [MassMismatch(factor=1.2)]).unknowns
    assert unknown.shares == {"beam_load": 1.0, "hand_load": OWN}
    assert unknown.std == pytest.approx(0.2)


def test_what_cannot_carry_a_load_is_refused_by_name() -> None:
    robot = beam()
    plant = ls.Plant(robot, robot.scene)
    with pytest.raises(ls.InputError, match=r"^Payload: body: got 'foot', want one of: beam, hand"):
        ls.uncertainty_of(plant, [Payload(1.0, "foot")])
    with pytest.raises(ls.InputError, match=r"^Payload: mass: got -1"):
        Payload(-1.0, "hand")
    scenario = ls.scenarios.quadrotor()
    assert ls.uncertainty_of(scenario.plant(), [Payload(0.1, "quadrotor")]).unknowns == (Unknown({"mass": 1.0}, 0.1),)


TWO = row(
    ("left", "right"), joint='type="slide" axis="1 0 0"', geom='size="0.1"', geoms=('mass="1"', 'mass="2"'),
    carried=("", '<body name="tip" pos="0 0 0.3"><geom size="0.1" mass="0.5"/></body>'),
    actuators=motors(("left", "right")), option='timestep="0.01" gravity="0 0 -10"',
)  # fmt: skip


@pytest.mark.parametrize(
    ("disturbance", "masses"),
    [
        (Payload(1.5, "left"), (2.5, 2.5)),
        (Payload(1.5, "right"), (1.0, 4.0)),
        (Payload(1.5, "tip"), (1.0, 4.0)),
        (MassMismatch(factor=1.4), (1.4, 3.5)),
    ],
)
def test_a_robot_of_several_trees_is_loaded_as_a_whole(
    disturbance: ls.disturbances.Disturbance, masses: tuple[float, float]
) -> None:
    """Newton's law for each cart: without friction its speed is force * time / mass, in a run and by the unknown."""
    robot = ls.MjcfRobot(scene_from_xml(TWO, "two"))
    plant, dynamics = ls.Plant(robot, robot.scene), robot.dynamics
    assert plant.weight == pytest.approx(35.0, rel=1e-12)
    force, steps, dt = np.array([3.0, -2.0]), 20, 0.05
    plan = track(robot, robot.at(), np.tile(force, (steps, 1)), dt, feedback=False)
    run = ls.simulate(plant, plan, disturbances=[disturbance])
    np.testing.assert_allclose(run.states[0, -1, 2:], force * steps * dt / masses, rtol=1e-9)
    unknown = dynamics.disturbed.with_parameters(**unknowns_of_disturbance(plant, disturbance))
    np.testing.assert_allclose(unknown.step(robot.at(), force, dt)[2:], force * dt / masses, rtol=1e-9)


def unknowns_of_disturbance(plant: ls.Plant, disturbance: ls.disturbances.Disturbance) -> dict[str, float]:
    """The loads, in kg, at one standard deviation of the only unknown."""
    (unknown,) = ls.uncertainty_of(plant, [disturbance]).unknowns
    assert not isinstance(unknown.of, str)
    return {name: unknown.std * share for name, share in unknown.of.items()}


def test_a_free_body_is_loaded() -> None:
    """Thrust / mass - gravity: the load has inertia as well as weight. MuJoCo keeps the inertia of such a body."""
    free = row(
        ["drone"], joint='type="free"', geom='type="box" size="0.1 0.2 0.05" mass="1.5"', carried=['<site name="s"/>'],
        actuators='<motor name="thrust" site="s" gear="0 0 1 0 0 0"/>', option='timestep="0.01" gravity="0 0 -10"',
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(free, "free"))
    loaded = robot.dynamics.disturbed.with_parameters(drone_load=0.5)
    rise = robot.dynamics.state_coordinates.names.index("drone_vz")
    for turned in (robot.at(), robot.at(drone_wx=1.0)):
        assert loaded.step(turned, [30.0], 0.01)[rise] == pytest.approx((30.0 / 2.0 - 10.0) * 0.01, rel=1e-9)


SPRINGY = sled(
    "", name="box", place="0 0 0.1", geom='type="box" size="0.1 0.1 0.1"',
    carried="""<freejoint name="f"/><inertial pos="0 0 0" mass="{box}" diaginertia="0.01 0.02 0.02"/>
    <body name="arm" pos="0 0 0.15"><joint name="a" axis="0 1 0" range="-0.3 0.3" frictionloss="0.2" armature="0.01"/>
      <inertial pos="0.05 0 0.1" mass="{arm}" diaginertia="0.002 0.002 0.001"/>
      <body name="hand" pos="0 0 0.25"><joint name="h" type="slide" axis="1 0 0" range="-0.05 0.05" frictionloss="0.1"/>
        <inertial pos="0 0 0" mass="{hand}" diaginertia="0.001 0.001 0.001"/></body></body>""",
    things='<geom name="floor" type="plane" size="3 3 1"/>', actuators=motors("ah", (5, 5)), option='timestep="0.005"',
    more="""<tendon><fixed name="t" range="-0.2 0.2" frictionloss="0.05">
      <joint joint="a" coef="1"/><joint joint="h" coef="2"/></fixed></tendon>
    <equality><joint joint1="h" joint2="a" polycoef="0 0.1 0 0 0"/></equality>""",
)  # fmt: skip
MASSES = {"box": 1.0, "arm": 0.3, "hand": 0.2}


@pytest.mark.parametrize("seed", range(6))
def test_contacts_limits_and_friction_are_as_soft_as_in_the_mjcf_with_that_mass(seed: int) -> None:
    """By mj_step alone, to rounding: MuJoCo scales the softness of constraints by inverse inertias at rest."""
    rng, robot = np.random.default_rng(seed), ls.MjcfRobot(scene_from_xml(SPRINGY.format(**MASSES), "springy"))
    body = ("box", "arm", "hand")[seed % 3]
    load, steps, dt = float(rng.uniform(0.3, 2.0)), 15, 0.02
    model = mujoco.MjModel.from_xml_string(SPRINGY.format(**(MASSES | {body: MASSES[body] + load})))
    data, controls = mujoco.MjData(model), rng.uniform(-2, 2, size=(steps, 2))
    states = [robot.at(a=0.28, f_vx=0.5, a_velocity=1.0, f_wy=float(rng.uniform(-1, 1)))]
    data.qpos[:], data.qvel[:] = robot.configuration(states[0])
    kinds = set[int]()
    for control in controls:
        data.ctrl[:] = control
        for _ in range(4):
            mujoco.mj_step(model, data)
            kinds |= set(data.efc_type.tolist())
        states.append(robot.state(data.qpos, data.qvel, near=states[-1]))
    assert len(kinds) >= 5  # equality, friction of joints and of the tendon, limits, contacts
    loaded = robot.dynamics.disturbed.with_parameters(**{f"{body}_load": load})
    for t in range(steps):
        np.testing.assert_allclose(loaded.step(states[t], controls[t], dt), states[t + 1], rtol=0, atol=1e-10)
    plan = open_loop(robot.dynamics, ls.Trajectory(np.array(states), controls, dt))
    run = ls.simulate(ls.Plant(robot, robot.scene), plan, disturbances=[Payload(load, body)])
    np.testing.assert_allclose(run.states[0], states, rtol=0, atol=1e-10)
