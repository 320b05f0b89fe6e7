"""Run a controller and its robot as two programs that exchange ROS 2 messages over DDS. Needs the extra `ros`.

    import lqrsim.bridge

    ran = lqrsim.bridge.run(solution, odometry="/odom", commands="/rotors/commands", safe=[0, 0, 0, 0])

`run` is the controller's side: it reads states and publishes the commands, period by period. The messages have the
names, types and bytes of ROS 2, so ROS 2 nodes treat them like any others. ROS 2 itself is not needed.
`SimulatedRobot` is the robot's side for a test: MuJoCo takes the place of the robot.

States come from `nav_msgs/msg/Odometry`, from `sensor_msgs/msg/JointState`, or from both. Commands go out as
`std_msgs/msg/Float64MultiArray`, in the order of the policy's controls and in their units, as the controllers of
ros2_control take them. Frames follow REP 103, as in this package: z up; the body's x forward, y to the left.
"""

import contextlib
import functools
import itertools
import math
import os
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt

from lqrsim import rotations
from lqrsim.annotations import Bounds, checked
from lqrsim.control.controllers import Controller, Feedback, FunctionController, OutputFeedback
from lqrsim.control.replanner import LiveReplanner
from lqrsim.errors import Array, InputError, check_array, check_count, check_kind, excerpt, vectors_of
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.policy import AffinePolicy, OutputFeedbackPolicy
from lqrsim.results.solution import Plan

LOST_AFTER = 3  # control periods without a state after which the controller stops
KEPT = 10  # commands that a reader keeps until they are received
WAIT_SLICE = 0.05  # s, the interval at which a wait checks for signals
ANSWERS = "answers "  # begins the label of a command; the rest is the stamp of the state that it answers
AXES = "xyz"
# The states in an Odometry message, by name: velocities along the world's axes, rates along the body's.
ODOMETRY = ("x", "y", "z", "vx", "vy", "vz", "rx", "ry", "rz", "wx", "wy", "wz", "heading")

Bridgeable = Plan | AffinePolicy | OutputFeedbackPolicy | Controller | LiveReplanner


@dataclass(frozen=True, kw_only=True, eq=False)
class Bridged:
    """The record of a controller's run of T periods, up to the safe command."""

    completed: bool
    reason: str  # why not all periods were run, in one line; empty if all were
    commands: Array  # (T, m), as published
    held: int  # periods that had to use the state of an earlier one
    refused: tuple[int, str]  # number of messages not used because of their content, and the last reason
    # (T,) time in s until each command was published, from the beginning of its period; in lockstep, from the arrival
    # of its state.
    response: Array
    late: Array  # (T,) delay in s of each period's beginning behind the clock; zeros in lockstep

    def summary(self) -> str:
        lines = [f"{len(self.commands)} periods, {self.held} with the state held"]
        lines += [f"stopped: {self.reason}"] if self.reason else []
        lines += [f"{self.refused[0]} messages not used; the last: {self.refused[1]}"] if self.refused[0] else []
        if len(self.commands):
            lines.append(f"state to command: {_quantiles(self.response)}")
            lines += [f"behind the clock: {_quantiles(self.late)}"] if self.late.any() else []
        return "\n".join(lines)


@checked
def run(
    controller: Bridgeable,
    *,
    commands: str,
    safe: npt.ArrayLike,
    odometry: str | None = None,
    joints: str | None = None,
    names: Mapping[str, str] | None = None,
    seconds: Annotated[float, Bounds(above=0.0, at_most=1e9)] | None = None,
    lockstep: bool = False,
    lost_after: Annotated[float, Bounds(above=0.0, at_most=1e6)] | None = None,
    patience: Annotated[float, Bounds(above=0.0, at_most=1e6)] = 10.0,
    domain: int | None = None,
) -> Bridged:
    """Control a robot by messages: in each control period of a monotonic clock, a command for the newest state.

    The clock begins with the first state. If a period has no new state, the last one is held: a policy acts on it by
    the law of the new period, and a filter predicts. After `lost_after` without a state the run stops. After the
    horizon a policy holds its last law. Once a command has been published, the safe command is published last, however
    the run ends, be it by Ctrl-C or an error.

    Args:
      controller: a plan, whose policy then controls; a policy, with or without a filter; a Controller with a plan, such
        as an OffsetFree; or a running re-planner, from `with replanner.live() as live`.
      commands: topic, such as "/rotors/commands".
      safe: (m,), within the limits: the command for the robot when it is no longer controlled.
      odometry: topic. It has the states x, y, z, vx, vy, vz (along the world's axes), the rotation vector rx, ry, rz,
        or its turn and tilt as with `turns_about`, the rates wx, wy, wz (along the body's), and heading, the yaw.
      joints: topic. It has the states NAME and NAME_velocity of each joint, as in a robot from an MJCF.
      names: state -> its name in messages, for states with other names.
      seconds: how long to run; by default the plan's horizon.
      lockstep: run one period for each state that arrives, instead of by the clock; for simulations.
      lost_after: stop after so long without a state, in s; by default three control periods, in lockstep `patience`.
      patience: time in s to wait for the other program to appear, and for the first state.
      domain: domain of DDS; by default ROS_DOMAIN_ID, or 0.
    """
    live = isinstance(controller, LiveReplanner)
    controller, dt, steps, nominal = _controller_of(controller)
    states, controls = controller.coordinates
    safe = check_array("safe", safe, (len(controls),))
    if (safe < controls.low).any() or (safe > controls.high).any():
        raise InputError(f"safe: got {excerpt(safe.tolist())}, want numbers from {controls.low} to {controls.high}")
    longest = lost_after or (patience if lockstep else LOST_AFTER * dt)
    if seconds is not None:
        steps = math.ceil(seconds / dt - 1e-9)
    filtered = isinstance(controller, OutputFeedback)
    needed = controller.policy.measured_coordinates.names if filtered else states.names
    node, commands = _Node(domain), _checked_topic(commands)
    inlet = _Inlet(node, _topics(commands, odometry, joints), states, needed, names, reliable=lockstep)
    _wait(inlet.matched, patience, inlet.lacking)
    outlet = node.writer(commands, "Float64MultiArray")  # seeing this writer means that its states are heard
    _wait(outlet.get_matched_subscriptions, patience, lambda: f"commands: got no reader of {commands}")
    if not live:  # a LiveReplanner would begin to solve
        controller.start(1).control(0, nominal[None])  # loads compiled code before the first period
    _wait(inlet.complete, patience, inlet.lacking)
    running, sent, response, late = controller.start(1), list[Array](), list[float](), list[float]()
    held, reason, begun = 0, "", time.monotonic()
    try:
        for step in range(steps):
            due = begun + step * dt
            if lockstep and step:
                inlet.wait(longest)
            while not lockstep and (left := due - time.monotonic()) > 0:
                time.sleep(left)
            began = time.monotonic()
            some_new, all_new = inlet.receive()
            held += not all_new and step > 0
            if (age := began - inlet.arrived) > longest:
                reason = f"no state for {age:.3g} s, after {step} periods"
                break
            lost = controller.sees_losses and not some_new and step > 0
            command = running.control(step, np.full((1, len(states)), np.nan) if lost else inlet.state[None])[0]
            diverged = running.estimator_diverged()
            if diverged or not np.isfinite(command).all():
                reason = diverged.get(0, f"got {excerpt(command.tolist())} from the controller")
                break
            outlet.write(node.numbers(command, _label_of(inlet.messages.values())))
            response.append(time.monotonic() - began)
            late.append(0.0 if lockstep else began - due)
            sent.append(command)
    finally:
        outlet.write(node.numbers(safe))
        with contextlib.suppress(AttributeError):  # cyclonedds 11.0 raises it if a reader hangs or is gone
            outlet.wait_for_acks(node.one_second)
    return Bridged(
        completed=not reason, reason=reason, commands=np.array(sent).reshape(len(sent), len(controls)), held=held,
        refused=inlet.refused, response=np.array(response), late=np.array(late),
    )  # fmt: skip


class SimulatedRobot:
    """A simulated robot for `run`. In `simulate` it is the controller: its controls come from the other program.

        with lqrsim.bridge.SimulatedRobot(solution, odometry="/odom", commands="/rotors/commands") as robot:
            rollout = ls.simulate(plant, solution, controller=robot)
        print(robot.summary())

    It publishes the measured state of each control period and waits for its command. With a bridge in lockstep, the
    simulation runs as fast as both programs allow. With a bridge that runs by a clock, it runs as fast as the clock.
    A simulation that falls behind skips the commands that arrived meanwhile, and those that are labelled as answers to
    earlier states. A measurement that gets lost is published as NaN, which a bridge does not use.

    One robot can serve several runs, one after the other. A time that is not after the last one begins a run, which
    waits for a controller.

    The other arguments are as in `run`.

    Args:
      patience: time in s to wait for the other program to appear, and for each command.

    Attributes:
      round_trips: times in s from publishing each state to the arrival of its command.
      unanswered: number of states after the end of the controller; its last command stayed in force.
    """

    _prefix = ""
    sees_losses = True

    @checked
    def __init__(
        self,
        plan: Plan | AffinePolicy,
        *,
        commands: str,
        odometry: str | None = None,
        joints: str | None = None,
        names: Mapping[str, str] | None = None,
        patience: Annotated[float, Bounds(above=0.0, at_most=1e6)] = 10.0,
        domain: int | None = None,
    ) -> None:
        policy = plan.policy if isinstance(plan, Plan) else plan
        self._controls = policy.control_coordinates
        self._patience = patience
        topics = _topics(commands, odometry, joints)
        self._names, node = _renamed(policy.state_coordinates, names), _Node(domain)
        self._turns_about = _turns_about(policy.state_coordinates, self._names)
        self._outlets = {kind: node.writer(topic, kind) for kind, topic in topics.items()}
        self._topic = commands
        self._inlet: _Reader | None = node.reader(commands, "Float64MultiArray")
        self._node: _Node | None = node
        self._t, self._command = math.inf, None  # time and command of the last state
        self.round_trips, self.unanswered = list[float](), 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._outlets, self._inlet, self._node = {}, None, None

    def __call__(self, state: npt.ArrayLike, t: float) -> Array:
        """The controls (m,) for a measured state (n,). Raises InputError if no controls arrive, or invalid ones."""
        node, inlet = self._node, self._inlet
        if node is None or inlet is None:
            raise InputError("SimulatedRobot: got a state after its end, want it within `with SimulatedRobot(...)`")
        values = dict(zip(self._names, vectors_of("state", state, len(self._names)).tolist(), strict=True))
        if begins := t <= self._t:
            everyone = [inlet.writers, *(outlet.get_matched_subscriptions for outlet in self._outlets.values())]
            lacking = f"commands: got no controller on {self._topic}"
            _wait(lambda: all(matched() for matched in everyone), self._patience, lambda: lacking)
        commands = [self._command, *(message.data for message in inlet.receive(most=KEPT))]  # for earlier states
        self._command = None if begins else commands[-1]
        writers, answer = inlet.writers(), list[Any]()
        self._t, begun = t, time.monotonic()
        published = [
            node.odometry(values, t, self._turns_about) if kind == "Odometry" else node.joints(values, t)
            for kind in self._outlets
        ]
        for outlet, message in zip(self._outlets.values(), published, strict=True):
            outlet.write(message)
        label = _label_of(published)

        def answered_or_ended() -> bool:
            ended = set(writers).isdisjoint(inlet.writers())  # before receiving what it last sent
            if not ended:
                inlet.wait(WAIT_SLICE)
            for message in inlet.receive():
                labels = [dimension.label for dimension in message.layout.dim]
                if label in labels or not any(other.startswith(ANSWERS) for other in labels):
                    answer.append(message)
                elif not begins:
                    self._command = message.data
            return bool(answer) or ended

        _wait(answered_or_ended, self._patience, lambda: f"commands: got no command on {self._topic}")
        if answer:
            self.round_trips.append(time.monotonic() - begun)
            self._command = answer[0].data
        elif self._command is None:  # the controller of an earlier run was still there: wait for the next one
            return self(state, t)
        else:
            self.unanswered += 1
        return check_array("command", self._command, (len(self._controls),))

    def summary(self) -> str:
        lines = [f"state to command and back: {_quantiles(self.round_trips)}" if self.round_trips else "no command"]
        if self.unanswered:
            lines.append(f"states after the controller's end, with its last command: {self.unanswered}")
        return "\n".join(lines)


def _label_of(states: Iterable[Any]) -> str:
    """The label of a command that answers messages of states, by the oldest of their stamps."""
    stamps = [state.header.stamp for state in states]
    return "{}{}.{:09d}".format(ANSWERS, *min((stamp.sec, stamp.nanosec) for stamp in stamps))


def _quantiles(seconds: npt.ArrayLike) -> str:
    middle, high, most = 1e3 * np.quantile(np.asarray(seconds), [0.5, 0.99, 1.0])
    return f"median {middle:.3f} ms, 99th percentile {high:.3f} ms, maximum {most:.3f} ms"


def _wait(until: Callable[[], Any], patience: float, lacking: Callable[[], str]) -> None:
    """Wait. When the patience ends, raises InputError that says what is missing."""
    end = time.monotonic() + patience
    while not until():
        if time.monotonic() > end:
            raise InputError(f"{lacking()} within {patience:g} s, want the other program, in the same domain")
        time.sleep(1e-3)


def _controller_of(source: Bridgeable) -> tuple[Controller, float, int, Array]:
    """The controller, its control period in s, the periods of its horizon, and the nominal state at its start (n,)."""
    if isinstance(source, LiveReplanner):
        policy, problem = source.active.plan.policy, source.problem
        return FunctionController(source.step, problem.dynamics, policy.dt), policy.dt, problem.steps, policy.nominal[0]
    if isinstance(source, OutputFeedbackPolicy):
        return OutputFeedback(source), source.dt, source.steps, source.nominal[0, : len(source.state_coordinates)]
    if isinstance(source, AffinePolicy):
        return Feedback(source), source.dt, source.steps, source.nominal[0]
    plan = source.plan if isinstance(source, Controller) else source
    wanted = "a plan, a policy, a Controller with a plan, or a live re-planner"
    policy = check_kind("controller", plan, Plan, wanted).policy
    controller = source if isinstance(source, Controller) else Feedback(policy)
    controller._check_reads_states()
    return controller, policy.dt, policy.steps, policy.nominal[0]


def _checked_topic(topic: object) -> str:
    if not isinstance(topic, str) or not re.fullmatch(r"(/[A-Za-z][A-Za-z0-9_]*)+", topic):
        raise InputError(f"topic: got {excerpt(topic)}, want a ROS 2 topic name, such as /odom")
    return topic


def _topics(commands: str, odometry: str | None, joints: str | None) -> dict[str, str]:
    """The topics of states by their kind of message. Raises InputError if two arguments name the same topic."""
    topics = {kind: topic for kind, topic in (("Odometry", odometry), ("JointState", joints)) if topic is not None}
    if not topics:
        raise InputError("odometry: got none, want a topic of states in odometry=, in joints=, or in both")
    fields = {"commands": commands, "odometry": odometry, "joints": joints}
    for (first, topic), (second, other) in itertools.combinations(fields.items(), 2):
        if topic is not None and topic == other:
            raise InputError(f"{second}: got {excerpt(topic)}, as for {first}, want a topic of its own")
    return topics


def _renamed(states: Coordinates, names: Mapping[str, str] | None) -> tuple[str, ...]:
    message_names = {} if names is None else check_kind("names", names, Mapping, "state -> its name in messages")
    if unknown := set(message_names) - set(states.names):
        raise InputError(f"names: got {excerpt(sorted(unknown, key=str))}, want some of {', '.join(states.names)}")
    renamed = tuple(message_names.get(name, name) for name in states.names)
    for place, name in enumerate(renamed):
        state = states.names[place]
        if not isinstance(name, str):
            raise InputError(f"names: got {excerpt(name)} for {state}, want its name in messages")
        if name in renamed[:place]:
            other = states.names[renamed.index(name)]
            raise InputError(f"names: got {excerpt(name)} for {other} and for {state}, want another name for each")
    return renamed


def _turns_about(states: Coordinates, names: Sequence[str]) -> str | None:
    """The axis about which rx, ry, rz, by their names in messages, have a turn; None for a rotation vector."""
    first = names.index("rx") if "rx" in names else -1
    turn = dict(zip(states.rotation_vectors, states.turns, strict=True)).get(first, -1)
    return AXES[turn] if turn >= 0 else None


class _Inlet:
    """The newest state (n,) from the topics, 0 for what the controller does not measure; `refused` as in `Bridged`."""

    def __init__(
        self, node: "_Node", topics: Mapping[str, str], states: Coordinates, needed: tuple[str, ...],
        names: Mapping[str, str] | None, *, reliable: bool,
    ) -> None:  # fmt: skip
        renamed = _renamed(states, names)
        self._wanted = dict(zip(renamed, range(len(states)), strict=True))
        self._turns_about = _turns_about(states, renamed)
        self._topics, self._lacking = topics, {name for name, i in self._wanted.items() if states.names[i] in needed}
        known = set(ODOMETRY) if set(topics) == {"Odometry"} else self._lacking
        if self._lacking - known:
            lacking, wanted = ", ".join(sorted(self._lacking - known)), "a topic in joints= that has them"
            raise InputError(f"odometry: got no {lacking} in its messages, want {wanted}, or other names=")
        self._readers = {kind: node.reader(topic, kind, reliable=reliable) for kind, topic in topics.items()}
        self._arrived, self._known = dict.fromkeys(topics, -math.inf), {kind: set[str]() for kind in topics}
        self.state, self.refused = np.zeros(len(states)), (0, "")
        self.messages = dict[str, Any]()  # the newest of each topic, whether it was used or not

    @property
    def arrived(self) -> float:
        """The time on the clock at which the oldest part of the state was received."""
        return min(self._arrived.values())

    def wait(self, seconds: float) -> None:
        """Wait until each topic has a new message, or the time is over."""
        end = time.monotonic() + seconds
        for reader in self._readers.values():
            while not reader.wait(WAIT_SLICE) and time.monotonic() < end:
                pass

    def matched(self) -> bool:
        return all(reader.writers() for reader in self._readers.values())

    def complete(self) -> bool:
        self.receive()
        return not self._lacking

    def lacking(self) -> str:
        return f"states: got no {', '.join(sorted(self._lacking))} from {', '.join(self._topics.values())}"

    def receive(self) -> tuple[bool, bool]:
        """Receive new messages. Returns whether some part of the state is new, and whether all parts are."""
        now = time.monotonic()
        for kind, reader in self._readers.items():
            for message in reader.receive():
                self.messages[kind] = message
                try:
                    is_odometry = kind == "Odometry"
                    values = _parse_odometry(message, self._turns_about) if is_odometry else _parse_joints(message)
                    used = values.keys() & self._wanted.keys()
                    self._known[kind] |= used
                    if missing := self._known[kind] - used:
                        raise ValueError(f"a message without {', '.join(sorted(missing))}")
                    if not np.isfinite([values[name] for name in used]).all():
                        raise ValueError("a number that is not finite")
                except ValueError as error:
                    self.refused = self.refused[0] + 1, f"{self._topics[kind]}: got {error}"
                    continue
                for name in used:
                    self.state[self._wanted[name]] = values[name]
                self._lacking -= used
                self._arrived[kind] = now
        return max(self._arrived.values()) == now, self.arrived == now


def _parse_odometry(message: Any, turns_about: str | None = None) -> dict[str, float]:
    """The states in the message. Raises ValueError if they are invalid."""
    pose, twist = message.pose.pose, message.twist.twist
    place, turned = pose.position, pose.orientation
    quaternion = np.array([turned.w, turned.x, turned.y, turned.z])
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) < 1e-2:
        raise ValueError(f"an orientation that is no unit quaternion but of length {length:.3g}")
    w, x, y, z = quaternion / length
    rotation = rotations.rotation_vector(quaternion, turns_about=turns_about)
    velocity = rotations.rotate(rotations.rotation_vector(quaternion), [getattr(twist.linear, axis) for axis in AXES])
    rates = [getattr(twist.angular, axis) for axis in AXES]
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    numbers = [place.x, place.y, place.z, *velocity, *rotation, *rates, heading]
    return dict(zip(ODOMETRY, map(float, numbers), strict=True))


def _parse_joints(message: Any) -> dict[str, float]:
    """The states in the message, for the joints that it lists. Raises ValueError if they are invalid."""
    states: dict[str, float] = {}
    for field, suffix in (("position", ""), ("velocity", "_velocity")):
        numbers = getattr(message, field)
        if len(numbers) not in (0, len(message.name)):
            raise ValueError(f"{len(message.name)} joints with {len(numbers)} numbers as their {field}")
        states |= {name + suffix: number for name, number in zip(message.name, numbers, strict=False)}
    return states


class _Node:
    """Readers and writers of ROS 2 topics in one DDS domain, and their messages."""

    def __init__(self, domain: int | None) -> None:
        self._ros = _ros()
        if domain is None:
            setting = os.environ.get("ROS_DOMAIN_ID") or "0"
            if not setting.isdecimal():
                raise InputError(f"ROS_DOMAIN_ID: got {excerpt(setting)}, want a number")
            domain = int(setting)
        self._participant = self._ros.domain.DomainParticipant(check_count("domain", domain, at_least=0, at_most=232))
        self.one_second = self._ros.util.duration(seconds=1)

    def reader(self, topic: str, kind: str, *, reliable: bool = True) -> "_Reader":
        return _Reader(self._ros, self._participant, self._topic(topic, kind), self._quality(reliable, kind))

    def writer(self, topic: str, kind: str) -> Any:
        return self._ros.pub.DataWriter(self._participant, self._topic(topic, kind), qos=self._quality(True, kind))

    def _topic(self, topic: str, kind: str) -> Any:
        return self._ros.topic.Topic(self._participant, f"rt{_checked_topic(topic)}", self._ros.messages[kind])

    def _quality(self, reliable: bool, kind: str) -> Any:
        """Readers keep only the newest state, but all of the last ten commands.

        A reliable writer also serves unreliable readers. The representation is the first version of CDR, as in ROS 2.
        """
        core, policy = self._ros.core, self._ros.core.Policy
        history = policy.History.KeepLast(KEPT if kind == "Float64MultiArray" else 1)
        reliability = policy.Reliability.Reliable(self.one_second) if reliable else policy.Reliability.BestEffort
        return core.Qos(reliability, history, policy.DataRepresentation(use_cdrv0_representation=True))

    def numbers(self, numbers: Array, label: str = "") -> Any:
        types, size = self._ros.messages, len(numbers)
        dim = [types["MultiArrayDimension"](label=label, size=size, stride=size)] if label else []
        layout = types["MultiArrayLayout"](dim=dim, data_offset=0)
        return types["Float64MultiArray"](layout=layout, data=[float(number) for number in numbers])

    def odometry(self, values: Mapping[str, float], t: float, turns_about: str | None = None) -> Any:
        types, numbers = self._ros.messages, {name: values.get(name, 0.0) for name in ODOMETRY}
        rotation = np.array([numbers["rx"], numbers["ry"], numbers["rz"] + numbers["heading"]])
        turned = rotations.quaternion(rotation, turns_about=turns_about)
        w, x, y, z = turned.tolist()
        velocity = [numbers["vx"], numbers["vy"], numbers["vz"]]
        linear = map(float, rotations.rotate(-rotations.rotation_vector(turned), velocity))
        place = types["Point"](x=numbers["x"], y=numbers["y"], z=numbers["z"])
        pose = types["Pose"](position=place, orientation=types["Quaternion"](x=x, y=y, z=z, w=w))
        moving = types["Twist"](
            linear=types["Vector3"](**dict(zip(AXES, linear, strict=True))),
            angular=types["Vector3"](x=numbers["wx"], y=numbers["wy"], z=numbers["wz"]),
        )
        return types["Odometry"](
            header=self._header(t, "odom"), child_frame_id="base_link",
            pose=types["PoseWithCovariance"](pose=pose, covariance=[0.0] * 36),
            twist=types["TwistWithCovariance"](twist=moving, covariance=[0.0] * 36),
        )  # fmt: skip

    def joints(self, values: Mapping[str, float], t: float) -> Any:
        names = [name for name in values if name.removesuffix("_velocity") not in values.keys() - {name}]
        rates = [values.get(f"{name}_velocity", 0.0) for name in names]
        places = [values[name] for name in names]
        return self._ros.messages["JointState"](
            header=self._header(t, ""), name=names, position=places, velocity=rates, effort=[]
        )

    def _header(self, t: float, frame: str) -> Any:
        seconds = math.floor(t)
        stamp = self._ros.messages["Time"](sec=seconds, nanosec=min(round((t - seconds) * 1e9), 999_999_999))
        return self._ros.messages["Header"](stamp=stamp, frame_id=frame)


class _Reader:
    """A reader of a topic that can be waited for."""

    def __init__(self, ros: SimpleNamespace, participant: Any, topic: Any, quality: Any) -> None:
        self._ros, self._reader = ros, ros.sub.DataReader(participant, topic, qos=quality)
        core = ros.core
        new = core.SampleState.NotRead | core.ViewState.Any | core.InstanceState.Any
        self._new, self._waits = core.ReadCondition(self._reader, new), core.WaitSet(participant)
        self._waits.attach(self._new)

    def wait(self, seconds: float) -> bool:
        """Wait for a message until the time is over. Returns whether a message is there."""
        return self._waits.wait(self._ros.util.duration(seconds=seconds)) > 0

    def receive(self, most: int = 1) -> list[Any]:
        """New messages, the oldest first. The end of a writer can leave a sample without a message."""
        return [sample for sample in self._reader.take(N=most) if sample.sample_info.valid_data]

    def writers(self) -> list[Any]:
        return self._reader.get_matched_publications()


@functools.cache
def _ros() -> SimpleNamespace:
    """The parts of cyclonedds that are used, and the messages. Raises InputError if cyclonedds is not installed."""
    try:
        from cyclonedds import core, domain, pub, sub, topic, util
        from cyclonedds.idl import make_idl_struct
        from cyclonedds.idl.types import array, float64, int32, sequence, uint32
    except ImportError as error:
        raise InputError(f"lqrsim.bridge: got no cyclonedds ({error}), want pip install 'lqrsim[ros]'") from None
    messages: dict[str, Any] = {}

    def message(package: str, name: str, /, **fields: Any) -> Any:
        messages[name] = make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields)
        return messages[name]

    three = dict.fromkeys(AXES, float64)
    stamp = message("builtin_interfaces", "Time", sec=int32, nanosec=uint32)
    header = message("std_msgs", "Header", stamp=stamp, frame_id=str)
    point, vector = message("geometry_msgs", "Point", **three), message("geometry_msgs", "Vector3", **three)
    quaternion = message("geometry_msgs", "Quaternion", **three, w=float64)
    pose = message("geometry_msgs", "Pose", position=point, orientation=quaternion)
    twist = message("geometry_msgs", "Twist", linear=vector, angular=vector)
    covariance = array[float64, 36]
    posed = message("geometry_msgs", "PoseWithCovariance", pose=pose, covariance=covariance)
    twisted = message("geometry_msgs", "TwistWithCovariance", twist=twist, covariance=covariance)
    message("nav_msgs", "Odometry", header=header, child_frame_id=str, pose=posed, twist=twisted)
    many = sequence[float64]
    message("sensor_msgs", "JointState", header=header, name=sequence[str], position=many, velocity=many, effort=many)
    dimension = message("std_msgs", "MultiArrayDimension", label=str, size=uint32, stride=uint32)
    layout = message("std_msgs", "MultiArrayLayout", dim=sequence[dimension], data_offset=uint32)
    message("std_msgs", "Float64MultiArray", layout=layout, data=many)
    return SimpleNamespace(core=core, domain=domain, pub=pub, sub=sub, topic=topic, util=util, messages=messages)
