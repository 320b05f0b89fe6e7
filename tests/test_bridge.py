"""A controller and a robot in two programs: messages as ROS 2 has them, and the same run as in one program.

All of it is on the loopback interface; each test has topics of its own.
"""

import os
import re
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from linear_plans import double_integrator, law_of
from sampling import rarely
from scipy.spatial.transform import Rotation
from tracking import hover

import lqrsim as ls

pytest.importorskip("cyclonedds", reason="needs the `ros` extra")

from lqrsim import bridge, rotations
from lqrsim.control.controllers import Feedback

LOOPBACK = """<CycloneDDS><Domain>
  <General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces></General>
  <Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer Address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
PATIENCE = 600.0  # s: a program that starts, or a law that is compiled, on a machine that has much else to do
JOINT = ("slider", "slider_velocity")
ODOMETRY: tuple[str, ...] = bridge.ODOMETRY[:12]


@pytest.fixture(autouse=True)
def on_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


@pytest.fixture
def topics() -> dict[str, Any]:
    name = f"/test_{uuid.uuid4().hex}"
    return {"odometry": f"{name}/odom", "commands": f"{name}/commands"}


def policy(steps: int = 10, dt: float = 0.05) -> ls.AffinePolicy:
    """A law that differs from step to step."""
    rng = np.random.default_rng(0)
    controls = ls.types.Coordinates(names=("push",), units=("N",), low=(-5.0,), high=(5.0,))
    return ls.AffinePolicy(
        gain=rng.normal(size=(steps, 1, 2)), offset=rng.normal(size=(steps, 1)), nominal=np.zeros((steps, 2)), dt=dt,
        state_coordinates=ls.types.Coordinates(names=JOINT, units=("m", "m/s")), control_coordinates=controls,
    )  # fmt: skip


@contextmanager
def controlling(*arguments: object, json: bool = False) -> Iterator[subprocess.Popen[str]]:
    """`lqrsim bridge` in a process of its own."""
    command = [sys.executable, "-m", "lqrsim.cli", "bridge", *map(str, (*arguments, "--patience", PATIENCE))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def meanwhile(call: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    """A thread that calls, and where what it returns will be."""
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(call()), daemon=True)
    thread.start()
    return thread, found


@pytest.mark.parametrize("kind", ["Odometry", "JointState", "Float64MultiArray"])
def test_messages_have_the_bytes_of_ros_2(kind: str) -> None:
    """By the definitions of ROS 2 Humble and the serialisation of another library."""
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    node, rng = bridge._Node(None), np.random.default_rng(1)
    match kind:
        case "Odometry":
            ours = node.odometry(dict(zip(ODOMETRY, rng.normal(size=12).tolist(), strict=True)), 3.25)
        case "JointState":
            ours = node.joints({"one": 1.5, "another": -2.5, "one_velocity": 0.5, "another_velocity": 0.25}, 7.125)
        case _:
            ours = node.numbers(rng.normal(size=5))
    package = {"Odometry": "nav_msgs", "JointState": "sensor_msgs"}.get(kind, "std_msgs")
    name = f"{package}/msg/{kind}"
    assert ours.__idl__.idl_transformed_typename == f"{package}::msg::dds_::{kind}_"
    theirs = store.deserialize_cdr(ours.serialize(), name)
    assert bytes(store.serialize_cdr(theirs, name)) == ours.serialize()
    match kind:
        case "Odometry":
            assert theirs.header.stamp.sec == 3
            assert theirs.header.stamp.nanosec == 250_000_000
            assert theirs.pose.pose.position.y == ours.pose.pose.position.y
            assert theirs.twist.twist.angular.z == ours.twist.twist.angular.z
        case "JointState":
            assert (theirs.name, theirs.position.tolist()) == (["one", "another"], [1.5, -2.5])
            assert theirs.velocity.tolist() == [0.5, 0.25]
        case _:
            assert theirs.data.tolist() == ours.data


@pytest.mark.parametrize("axis", rotations.AXES)
def test_odometry_of_turns_and_tilts(axis: str) -> None:
    """As a robot from an MJCF with `turns_about` has them, whose states name the axis; there and back, to rounding."""
    names = ("rx", "ry", "rz")
    space = ls.types.Coordinates(
        names=names, units=("rad",) * 3, rotation_vectors=(0,), angles=(rotations.AXES.index(axis),)
    )
    assert bridge._turns_about(space, names) == axis
    assert bridge._turns_about(replace(space, angles=()), names) is None
    values = dict(zip(ODOMETRY, np.random.default_rng(0).normal(size=12).tolist(), strict=True))
    message = bridge._Node(None).odometry(values, 0.0, turns_about=axis)
    turn, tilt = ({name: values[name] * (name[1] == axis) for name in names}, dict.fromkeys(names, 0.0))
    tilt |= {name: values[name] for name in names if name[1] != axis}
    turned = Rotation.from_rotvec(list(turn.values())) * Rotation.from_rotvec(list(tilt.values()))
    found = [getattr(message.pose.pose.orientation, name) for name in "xyzw"]
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), turned.as_matrix(), atol=1e-14)
    again = bridge._parse_odometry(message, turns_about=axis)
    np.testing.assert_allclose([again[name] for name in values], list(values.values()), atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_odometry_is_read_in_its_frames(seed: int) -> None:
    """Velocity along the body's axes, as REP 103 has it; rotations by SciPy, to rounding. And there and back."""
    rng, node = np.random.default_rng(seed), bridge._Node(None)
    values = dict(zip(ODOMETRY, rng.normal(size=12).tolist(), strict=True))
    message = node.odometry(values, 0.0)
    turned = Rotation.from_rotvec([values[name] for name in ("rx", "ry", "rz")])
    pose, twist = message.pose.pose, message.twist.twist
    quaternion = [getattr(pose.orientation, name) for name in "xyzw"]
    np.testing.assert_allclose(Rotation.from_quat(quaternion).as_matrix(), turned.as_matrix(), atol=1e-14)
    seen = turned.apply([getattr(twist.linear, name) for name in "xyz"])
    np.testing.assert_allclose(seen, [values[name] for name in ("vx", "vy", "vz")], atol=1e-14)
    again = bridge._parse_odometry(message)
    np.testing.assert_allclose([again[name] for name in values], list(values.values()), atol=1e-14)
    yawed = bridge._parse_odometry(node.odometry({"heading": 2.5}, 0.0))
    assert yawed["heading"] == pytest.approx(2.5, abs=1e-15)


@pytest.mark.parametrize("filtered", [True, *rarely(False)])
def test_two_programs_run_as_one(
    filtered: bool, topics: dict[str, Any], tmp_path: Path, differential_drive: ls.Scenario,
    drive_solution: ls.Solution, quadrotor: ls.Scenario, quadrotor_solution: ls.Solution,
) -> None:  # fmt: skip
    """In lockstep, under noise: the quadrotor to 1e-12, the drive to 1e-8, for wheels on a floor amplify rounding.

    Messages round, for they have rotations as quaternions and velocities along the body's axes.
    """
    scenario, plan = (differential_drive, drive_solution) if filtered else (quadrotor, quadrotor_solution)
    disturbances = [ls.disturbances.MeasurementNoise(1e-3), ls.disturbances.ForceNoise(0.05)]
    controller: Any = None
    if filtered:
        disturbances.append(ls.disturbances.MeasurementDropouts(0.1))
        stated = ls.uncertainty_of(scenario.plant(), disturbances)
        controller = ls.OffsetFree(scenario.problem, plan, stated).policy
    file = ls.save(plan if controller is None else controller, tmp_path / "policy.npz")
    alone = ls.simulate(scenario.plant(), plan, controller=controller, disturbances=disturbances, seed=3)
    safe = ["0"] * len(plan.policy.control_coordinates)
    options = [word for name, topic in topics.items() for word in (f"--{name}", topic)]
    with (
        controlling(file, "--lockstep", "--safe", *safe, *options) as process,
        bridge.SimulatedRobot(plan, **topics, patience=PATIENCE) as robot,
    ):
        rollout = ls.simulate(scenario.plant(), plan, controller=robot, disturbances=disturbances, seed=3)
        printed, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, printed
    assert f"{plan.trajectory.steps} periods, " in printed
    assert rollout.outcome == alone.outcome
    close = 1e-8 if filtered else 1e-12
    np.testing.assert_allclose(rollout.states, alone.states, rtol=0, atol=close)
    np.testing.assert_allclose(rollout.commanded, alone.commanded, rtol=0, atol=close)
    assert len(robot.round_trips) == plan.trajectory.steps
    assert "99th percentile" in robot.summary()


def test_by_the_clock_commands_are_those_of_the_law(topics: dict[str, Any]) -> None:
    """Joints, each state once; the robot gets the command of each period, and the safe one last."""
    law, states = policy(steps=9), np.random.default_rng(5).normal(size=(9, 2))  # ten commands, all that a topic keeps
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    thread, ran = meanwhile(lambda: bridge.run(law, safe=[-1.5], lost_after=PATIENCE, **where))
    with bridge.SimulatedRobot(law, **where) as robot:
        got = [robot(states[0], 0.0)]
        thread.join(PATIENCE)
        got += [message.data for _ in range(10) for message in robot._inlet.receive()]  # pyright: ignore[reportOptionalMemberAccess]
    assert ran[0].completed
    assert ran[0].held == 8  # there was one state only, which the laws of all periods were for
    np.testing.assert_allclose(ran[0].commands, [law(states[0], k * law.dt) for k in range(9)], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(got, [*ran[0].commands, [-1.5]])
    assert (ran[0].late >= 0).all()


def test_the_controller_of_each_run_answers_its_states(topics: dict[str, Any]) -> None:
    """One robot runs several times in lockstep, each time with a new controller; safe commands are no answers."""
    law, states = policy(), np.random.default_rng(6).normal(size=(3, 10, 2))
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    with bridge.SimulatedRobot(law, **where) as robot:
        for run in states:
            thread, ran = meanwhile(lambda: bridge.run(law, safe=[-1.5], lockstep=True, **where))
            got = [robot(state, k * law.dt) for k, state in enumerate(run)]
            thread.join(PATIENCE)
            wanted = [law(state, k * law.dt) for k, state in enumerate(run)]
            np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-15)
            np.testing.assert_array_equal(got, ran[0].commands)
    assert (len(robot.round_trips), robot.unanswered) == (30, 0)


def test_a_controller_that_ends_before_it_answers_is_not_the_one_of_a_run(topics: dict[str, Any]) -> None:
    law, node = policy(), bridge._Node(None)
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    silent, inlet = node.writer(where["commands"], "Float64MultiArray"), node.reader(where["joints"], "JointState")
    with bridge.SimulatedRobot(law, **where) as robot:
        thread, got = meanwhile(lambda: robot([0.1, 0.2], 0.0))
        assert inlet.wait(PATIENCE)
        del silent, inlet
        ran = bridge.run(law, safe=[-1.5], lockstep=True, seconds=law.dt, **where)
        thread.join(PATIENCE)
    np.testing.assert_array_equal(got, ran.commands)
    assert (len(robot.round_trips), robot.unanswered) == (1, 0)


@pytest.mark.parametrize("slow", [range(12), [3]])
def test_by_the_clock_a_slow_simulation_gets_no_old_commands(slow: Sequence[int], topics: dict[str, Any]) -> None:
    """If it is late at each state, or at one. The controller ends before it; then the safe command stays in force."""
    law, states = policy(steps=12, dt=0.03), np.random.default_rng(7).normal(size=(12, 2))
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    thread, ran = meanwhile(lambda: bridge.run(law, safe=[-1.5], lost_after=PATIENCE, **where))
    with bridge.SimulatedRobot(law, **where) as robot:
        got = []
        for j, state in enumerate(states):
            got.append(robot(state, j * law.dt)[0])
            time.sleep(3.5 * law.dt if j in slow else 0.0)
        thread.join(PATIENCE)
    answered, safe = len(robot.round_trips), got.index(-1.5)
    for state, command in zip(states, got[:safe], strict=False):
        fresh = [law(state, k * law.dt)[0] for k in range(12)]
        assert np.abs(np.array(fresh) - command).min() < 1e-15
    assert ran[0].completed
    assert got[safe:] == [-1.5] * (12 - safe)
    assert safe <= answered <= safe + 1
    assert answered + robot.unanswered == 12
    assert f"controller's end, with its last command: {robot.unanswered}" in robot.summary()


@pytest.mark.parametrize("seed", range(3))
def test_a_filter_is_told_what_got_lost(seed: int, topics: dict[str, Any]) -> None:
    """States that equal the last one are measurements; those of NaN got lost. Commands by hand, to rounding."""
    rng, steps = np.random.default_rng(seed), 12
    system = double_integrator(controls=rng.normal(size=(steps, 1)), limits=(-5.0, 5.0))
    law = law_of(system).policy
    names = dict(zip(law.state_coordinates.names, JOINT, strict=True))
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    thread, ran = meanwhile(lambda: bridge.run(law, safe=[0.0], lockstep=True, names=names, **where))
    state, z, wanted, got = rng.normal(size=2), law.start(), [], []
    with bridge.SimulatedRobot(system.solution, names=names, **where) as robot:
        for t in range(steps):
            lost = t > 0 and rng.random() < 0.3
            state = state if rng.random() < 0.5 else rng.normal(size=2)
            got.append(robot(np.full(2, np.nan) if lost else state, t * law.dt))
            command, z = law.step(z, None if lost else state, t * law.dt)
            wanted.append(command)
        thread.join(PATIENCE)
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-12)
    assert ran[0].completed


@pytest.mark.parametrize("seed", range(3))
def test_a_command_that_answers_an_earlier_state_is_skipped(seed: int, topics: dict[str, Any]) -> None:
    """It was computed just before the state arrived. Commands without a label are those of other programs."""
    rng, law, node = np.random.default_rng(seed), policy(), bridge._Node(None)
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    outlet, inlet = node.writer(where["commands"], "Float64MultiArray"), node.reader(where["joints"], "JointState")
    with bridge.SimulatedRobot(law, **where) as robot:
        last = None
        for t in range(6):
            thread, got = meanwhile(lambda t=t: robot(rng.normal(size=2), t * law.dt))
            assert inlet.wait(PATIENCE)
            (state,) = inlet.receive()
            if last is not None and rng.random() < 0.7:
                outlet.write(node.numbers(np.array([-1.0]), bridge._label_of([last])))
            wanted = rng.uniform(-0.5, 0.5, size=1)
            outlet.write(node.numbers(wanted, bridge._label_of([state]) if rng.random() < 0.5 else ""))
            thread.join(PATIENCE)
            np.testing.assert_array_equal(got, [wanted])
            last = state
    assert robot.unanswered == 0


@pytest.mark.parametrize("lockstep", [False, True])
def test_a_robot_that_ends_is_lost(lockstep: bool, topics: dict[str, Any]) -> None:
    law = policy(steps=1000, dt=0.05)
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    thread, ran = meanwhile(lambda: bridge.run(law, safe=[-1.5], lockstep=lockstep, lost_after=0.15, **where))
    with bridge.SimulatedRobot(law, **where) as robot:
        robot([0.1, 0.2], 0.0)
    thread.join(PATIENCE)
    assert re.match(r"no state for [\d.]+ s, after \d+ periods", ran[0].reason)


def test_it_stops_when_states_stay_away(topics: dict[str, Any]) -> None:
    """The state is held until it is too old; then comes the safe command."""
    law = policy(steps=1000, dt=0.02)
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    thread, ran = meanwhile(lambda: bridge.run(law, safe=[-1.5], **where))
    with bridge.SimulatedRobot(law, **where) as robot:
        got = [robot([0.1, 0.2], 0.0).tolist()]
        thread.join(PATIENCE)
        got += [message.data for _ in range(9) for message in robot._inlet.receive()]  # pyright: ignore[reportOptionalMemberAccess]
    assert not ran[0].completed
    assert re.match(r"no state for [\d.]+ s, after \d periods", ran[0].reason)
    assert len(ran[0].commands) <= 4  # three periods, and the one in which the state arrived
    np.testing.assert_array_equal(got, [*ran[0].commands.tolist(), [-1.5]])
    assert "stopped: no state" in ran[0].summary()


@pytest.mark.parametrize("spoilt", [[np.nan, 0.0], [np.inf, 0.0]])
def test_what_is_no_state_is_not_used(spoilt: npt.ArrayLike, topics: dict[str, Any]) -> None:
    law = policy()
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    thread, ran = meanwhile(lambda: bridge.run(law, safe=[0.0], lockstep=True, **where))
    with bridge.SimulatedRobot(law, **where) as robot:
        got = [robot(state, 0.0) for state in ([0.1, 0.2], spoilt, *np.zeros((8, 2)))]
        thread.join(PATIENCE)
    np.testing.assert_allclose(got[1], law([0.1, 0.2], law.dt), rtol=0, atol=1e-15)
    assert ran[0].refused == (1, f"{topics['odometry']}: got a number that is not finite")
    assert ran[0].held == 1


def test_an_orientation_that_is_none_is_not_used() -> None:
    message = bridge._Node(None).odometry({}, 0.0)
    message.pose.pose.orientation.w = 0.0
    with pytest.raises(ValueError, match="no unit quaternion but of length 0"):
        bridge._parse_odometry(message)


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
def test_ctrl_c_leaves_the_safe_command(topics: dict[str, Any], tmp_path: Path) -> None:
    law, state = policy(steps=1000), np.array([0.1, 0.2])
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"]}
    options = [word for name, topic in where.items() for word in (f"--{name}", topic)]
    file = ls.save(law, tmp_path / "policy.npz")
    with (
        controlling(file, *options, "--lockstep", "--safe", -1.5) as process,
        bridge.SimulatedRobot(law, **where, patience=PATIENCE) as robot,
    ):
        for k in range(5):
            np.testing.assert_allclose(robot(state, k * law.dt), law(state, k * law.dt), rtol=0, atol=1e-15)
        process.send_signal(signal.SIGINT)
        assert robot._inlet is not None
        assert robot._inlet.wait(PATIENCE)
        (last,) = robot._inlet.receive()
        printed, _ = process.communicate(timeout=PATIENCE)
    assert last.data == [-1.5]
    assert process.returncode == 130
    assert "lqrsim: stopped" in printed


def test_a_failing_controller_leaves_the_safe_command(topics: dict[str, Any]) -> None:
    law = policy()
    broken = replace(law, offset=np.where(np.arange(10)[:, None] == 3, np.nan, law.offset))
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    thread, ran = meanwhile(lambda: bridge.run(broken, safe=[-1.5], lockstep=True, **where))
    with bridge.SimulatedRobot(law, **where) as robot:
        got = [robot([0.1, 0.2], k * law.dt) for k in range(4)]
        thread.join(PATIENCE)
    np.testing.assert_array_equal(got[3], [-1.5])
    assert (ran[0].completed, ran[0].reason) == (False, "got [nan] from the controller")


def test_a_live_replanner_runs(topics: dict[str, Any], quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """Before the first solve is done it is the policy; the robot waits until one is."""
    replanner = ls.Replanner(quadrotor.problem, quadrotor_solution, every=0.1, horizon="moving")
    state, periods = quadrotor_solution.trajectory.states[0], 450
    with replanner.live() as live, bridge.SimulatedRobot(quadrotor_solution, **topics, patience=PATIENCE) as robot:
        options: dict[str, Any] = {"lockstep": True, "seconds": periods / 30, "patience": PATIENCE}
        thread, ran = meanwhile(lambda: bridge.run(live, safe=[0.0] * 4, **topics, **options))
        got = []
        for k in range(periods):
            got.append(robot(state, k / 30))
            if not live.log.records:
                time.sleep(0.04)
        thread.join(PATIENCE)
    assert ran[0].completed
    assert live.log.records
    np.testing.assert_allclose(got[0], quadrotor_solution.policy(state, 0.0), rtol=0, atol=1e-12)


class Reading(Feedback):
    """The numbers that it wants are no states, however many there are."""

    sensors, plan = property(lambda self: object()), property(lambda self: hover())  # pyright: ignore


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"controller": 3}, "controller: got"),
        ({"controller": ls.lq}, "controller: got"),
        ({"controller": Reading(hover().policy)}, "controller: got a Reading that reads sensors, want one of the meas"),
        ({"safe": [6.0]}, r"safe: got \[6.0\], want numbers from"),
        ({"safe": [0.0, 0.0]}, "safe: got shape"),
        ({"joints": None}, "odometry: got none, want a topic of states"),
        ({"joints": "joint states"}, "topic: got 'joint states', want a ROS 2 topic name"),
        ({"joints": "/a//b"}, "topic: got"),
        ({"commands": 3}, "topic: got 3"),
        ({"odometry": "/j"}, "joints: got '/j', as for odometry, want a topic of its own"),
        ({"commands": "/j"}, "joints: got '/j', as for commands, want a topic of its own"),
        ({"commands": "/o", "odometry": "/o"}, "odometry: got '/o', as for commands, want a topic of its own"),
        ({"names": {"theta": "heading"}}, r"names: got \['theta'\], want some of slider"),
        ({"names": {"theta": "heading", 3: "x"}}, r"names: got \[3, 'theta'\], want some of slider"),
        ({"names": {"slider": "x", "slider_velocity": "x"}}, "names: got 'x' for slider and for slider_velocity, want"),
        ({"names": {"slider": "slider_velocity"}}, "names: got 'slider_velocity' for slider and for slider_velocity"),
        ({"names": {"slider": 3}}, "names: got 3 for slider, want its name in messages"),
        ({"names": {"slider_velocity": None}}, "names: got None for slider_velocity, want its name"),
        ({"joints": None, "odometry": "/odom"}, "odometry: got no slider, slider_velocity in its messages"),
        ({"seconds": 0}, "seconds: got 0"),
        ({"domain": 500}, "domain: got 500"),
        ({}, "states: got no slider, slider_velocity from /j within 0.1 s, want the other program"),
    ],
)
def test_what_cannot_be_is_told_in_a_line(changed: dict[str, Any], message: str) -> None:
    asked: dict[str, Any] = {"controller": policy(), "commands": "/nobody_listens", "safe": [0.0], "joints": "/j"}
    with pytest.raises(ls.InputError, match=message):
        bridge.run(**{**asked, "patience": 0.1, **changed})


@pytest.mark.parametrize("one", ["commands", "odometry", "joints"])
def test_a_simulated_robot_has_a_topic_for_each(one: str) -> None:
    names: dict[str, Any] = {"commands": "/c", "odometry": "/o", "joints": "/j"}
    for other in names.keys() - {one}:
        with pytest.raises(ls.InputError, match=r"got '/\w', as for \w+, want a topic of its own"):
            bridge.SimulatedRobot(policy(), **{**names, one: names[other]})


def test_what_is_not_there_is_named(topics: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that does not listen, and one that is silent; neither gets a command. What is there is waited for."""
    node, where = bridge._Node(None), {"joints": topics["odometry"], "commands": topics["commands"]}
    silent, wait, there = node.writer(where["joints"], "JointState"), bridge._wait, 1

    def waits(until: Callable[[], Any], patience: float, lacking: Callable[[], str]) -> None:
        nonlocal there
        there -= 1
        wait(until, PATIENCE if there >= 0 else patience, lacking)

    monkeypatch.setattr(bridge, "_wait", waits)
    with pytest.raises(ls.InputError, match=r"commands: got no reader of /test_.* within 0.1 s"):
        bridge.run(policy(), safe=[0.0], patience=0.1, **where)
    listening, there = node.reader(where["commands"], "Float64MultiArray"), 2
    with pytest.raises(ls.InputError, match=r"states: got no slider, slider_velocity from /test_.* within 0.1 s"):
        bridge.run(policy(), safe=[0.0], patience=0.1, **where)
    assert silent.get_matched_subscriptions() is not None
    assert not listening.receive()
    with bridge.SimulatedRobot(policy(), patience=0.1, **where) as robot:
        with pytest.raises(ls.InputError, match=r"commands: got no controller on /test_.* within 0.1 s"):
            robot([0.0, 0.0], 0.0)
        outlet, inlet = node.writer(where["commands"], "Float64MultiArray"), node.reader(where["joints"], "JointState")
        there = 1
        with pytest.raises(ls.InputError, match=r"commands: got no command on /test_.* within 0.1 s"):
            robot([0.0, 0.0], 0.0)
        assert outlet.get_matched_subscriptions()
        assert inlet.writers()


def test_a_message_without_a_joint_that_was_there_is_not_used(topics: dict[str, Any]) -> None:
    law = policy()
    where: dict[str, Any] = {"joints": topics["odometry"], "commands": topics["commands"], "patience": PATIENCE}
    thread, ran = meanwhile(lambda: bridge.run(law, safe=[0.0], lockstep=True, **where))
    node = bridge._Node(None)
    outlet, inlet = node.writer(where["joints"], "JointState"), node.reader(where["commands"], "Float64MultiArray")
    while not (inlet.writers() and outlet.get_matched_subscriptions()):
        time.sleep(0.01)
    for k in range(10):
        values = {"slider": 0.1, "slider_velocity": 0.2} if k != 4 else {"another": 3.0, "another_velocity": 4.0}
        outlet.write(node.joints(values, 0.0))
        assert inlet.wait(PATIENCE)
        inlet.receive()
    thread.join(PATIENCE)
    assert ran[0].refused == (1, f"{where['joints']}: got a message without slider, slider_velocity")
    assert ran[0].held == 1


def test_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    bridge._ros.cache_clear()
    with pytest.raises(ls.InputError, match=r"want pip install 'lqrsim\[ros\]'"):
        bridge.run(policy(), commands="/c", safe=[0.0], joints="/j")
    bridge._ros.cache_clear()
