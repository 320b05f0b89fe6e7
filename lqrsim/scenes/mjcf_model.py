"""An MJCF as a record, read and compiled once, that robots, dynamics, plants and pictures share."""

import contextlib
import itertools
import math
import os
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim import rotations
from lqrsim.annotations import checked
from lqrsim.errors import Array, InputError, check_name, excerpt
from lqrsim.scenes import mjcf_text
from lqrsim.scenes.mjcf_text import DEEPEST, SPEED_LIMIT, UNNAMED, mujoco
from lqrsim.scenes.mujoco_log import unlogged
from lqrsim.scenes.urdf import is_urdf, read_urdf
from lqrsim.scenes.world import World

_KINDS = {
    mujoco.mjtJoint.mjJNT_FREE: "free", mujoco.mjtJoint.mjJNT_BALL: "ball", mujoco.mjtJoint.mjJNT_SLIDE: "slide",
    mujoco.mjtJoint.mjJNT_HINGE: "hinge",
}  # fmt: skip
_SIZES = {"free": (7, 6), "ball": (4, 3), "slide": (1, 1), "hinge": (1, 1)}
_OF_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
FAR_PAST = 0.1  # fraction of a joint's range; springs of limits give way by less
_SAME = 1e-12  # m, and of quaternions, within which a mocap body is where a keyframe has it

MOST_CELLS = 4096**2  # largest number of cells of a height field; MuJoCo crashes with far more
# Largest numbers of elements whose attributes are sizes of arrays, or of drawings; with far more, MuJoCo takes minutes
# and GBs. Those that begin with nuser_ are numbers of each element.
MOST = {
    "size": {"nkey": 10_000, "nuserdata": 10**7, "njmax": 10**6, "nconmax": 10**6, "nstack": 10**8, "memory": 2**32},
    "quality": {"shadowsize": 2**14, "offsamples": 64, "numslices": 1000, "numstacks": 1000, "numquads": 1000},
}
MOST_USER = 10_000
MOST_PIXELS = 8192**2  # of a texture that MuJoCo makes
MOST_COPIES = 1_000_000  # largest number of elements from <replicate>: they take MuJoCo minutes, and GBs
_COPIERS = "replicate", "composite", "flexcomp"  # elements with a count of the elements that they make
_MASSES = frozenset(
    (
        "mass", "density", "viscosity", "diaginertia", "fullinertia", "settotalmass", "boundmass", "boundinertia",
        "armature",
    )
)  # fmt: skip
_NAN = re.compile(r"(^|[\s,])[+-]?nan")


Side = tuple[float, float]  # the least and the largest; infinite without a limit


@dataclass(frozen=True)
class Joint:
    """A joint.

    Attributes:
      kind: free, ball, slide or hinge.
      qpos, dofs: its indices in qpos and in qvel. limits: limits of a slide or hinge, in m or rad, or None.
      forces: limits of the sum that actuators exert on it, in N or N m, with gravity compensation if that is theirs.
      speed: largest speed of a slide or hinge, in m/s or rad/s, infinite if none is stated. MuJoCo does not know it: it
        is the number `<numeric name="NAME_velocity_limit">` in the <custom> section.
    """

    name: str
    kind: str
    qpos: slice
    dofs: slice
    limits: Side | None
    forces: Side
    speed: float

    @property
    def dof(self) -> int:
        """The first of its indices in qvel; a slide or hinge has only this index."""
        return self.dofs.start

    def past_limits(self, position: float, share: float) -> str | None:
        """What a message says of a position past the joint's limits by more than a share of its range; else None."""
        if self.limits is None:
            return None
        least, most = self.limits
        if least - share * (most - least) <= position <= most + share * (most - least):
            return None
        unit, more = "m", ""
        if self.kind == "hinge":
            unit, more = "rad", f" ({np.degrees(least):.4g} to {np.degrees(most):.4g} degrees)"
        wanted = f"want the joint within its limits in the MJCF, {least:.4g} to {most:.4g} {unit}{more}"
        return f"got {position:.4g} {unit} for {self.name}, {wanted}"


@dataclass(frozen=True)
class Control:
    """A control: its name, its unit (or empty), and its limits."""

    name: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class Actuator:
    """An actuator. Its force is `(gain @ motion) input + bias @ motion`, where motion is (1, length, velocity).

    The input is its control, or the last of its activations if it has some. The force is clipped to `forces`; times the
    moment arm, which for a slide or hinge is the gear, it acts on the joint, whose sum is clipped to `Joint.forces`.

    Attributes:
      joint: name of the joint that it acts on; None if it acts on something else.
      controls, activations, outputs: its indices in ctrl, act and actuator_force; it may have several of each.
      inputs: MuJoCo's names of its controls, such as pos and vel; empty for one that is just a command.
      forces: limits of its force, in N or N m. gear: of its first output.
      gain, bias: three numbers each; None if the force has another form, as of muscles, `pid` and `dcmotor`.
    """

    name: str
    joint: str | None
    controls: slice
    activations: slice
    outputs: slice
    inputs: tuple[str, ...]
    forces: Side
    gear: float
    gain: tuple[float, ...] | None
    bias: tuple[float, ...] | None


@checked
@dataclass(frozen=True, eq=False)
class MjcfModel:
    """An MJCF: its text, and what MuJoCo compiles from it, once, when it is first asked for.

    Attributes:
      name: name of the packaged scene, or the stem of the file.
      xml: the whole MJCF as text, with includes resolved. The model can be made from it alone.
      turns_about: the axis about which a robot's free and ball joints turn on and on, see `MjcfRobot`; or None.
    """

    name: str
    xml: str
    turns_about: str | None = None

    @classmethod
    def of_file(cls, name_or_path: str | os.PathLike[str]) -> "MjcfModel":
        """That of a packaged scene, an MJCF or a URDF. Raises InputError if there is none, or something else in it."""
        return cls(*read_urdf(name_or_path)) if is_urdf(name_or_path) else cls(*mjcf_text.read_mjcf(name_or_path))

    def __reduce__(self) -> tuple[Any, ...]:
        """The text: another process compiles it."""
        return MjcfModel, (self.name, self.xml, self.turns_about)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model. Raises InputError as `model_from_xml` does, and if MuJoCo would solve it wrongly."""
        model = model_from_xml(self.xml, f"scene {self.name}")
        if mujoco.mj_isSparse(model) and mujoco.__version__ == "4.0.0":
            # Newton on a sparse Jacobian gives wrong forces in 4.0.0 (fixed in 4.0.1).
            raise InputError(
                f"scene {self.name}: got a sparse constraint Jacobian, which MuJoCo 4.0.0 solves wrongly;"
                ' want <option jacobian="dense"/> or a newer MuJoCo'
            )
        return model

    def spec(self) -> mujoco.MjSpec:
        """A spec of it, to be changed and compiled; its geoms are in the order of their ids."""
        return _spec_of(self.xml)

    # What it is made of.

    @cached_property
    def joints(self) -> tuple[Joint, ...]:
        model, found = self.model, list[Joint]()
        for number in range(model.njnt):
            kind, name = _KINDS[mujoco.mjtJoint(model.jnt_type[number])], _joint_name(model, number)
            firsts = int(model.jnt_qposadr[number]), int(model.jnt_dofadr[number])
            qpos, dofs = (slice(first, first + size) for first, size in zip(firsts, _SIZES[kind], strict=True))
            single = kind in ("slide", "hinge")
            limited = model.jnt_limited[number] and single
            stated = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, f"{name}{SPEED_LIMIT}") if single else -1
            found.append(
                Joint(
                    name=name, kind=kind, qpos=qpos, dofs=dofs,
                    limits=_side(limited, model.jnt_range[number]) if limited else None,
                    forces=_side(model.jnt_actfrclimited[number], model.jnt_actfrcrange[number]),
                    speed=math.inf if stated < 0 else float(model.numeric(stated).data[0]),
                )
            )  # fmt: skip
        return tuple(found)

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        model, found = self.model, list[Actuator]()
        places = (
            (model.actuator_ctrladr, model.actuator_ctrlnum), (model.actuator_actadr, model.actuator_actnum),
            (model.actuator_outadr, model.actuator_outnum),
        )  # fmt: skip
        for number in range(model.nactuator):
            starts = [(max(0, int(first[number])), int(count[number])) for first, count in places]  # -1 without any
            controls, activations, outputs = (slice(first, first + count) for first, count in starts)
            of_joint = mujoco.mjtTrn(model.actuator_trntype[number]) in _OF_JOINTS
            gain, bias = _affine(model, number)
            found.append(
                Actuator(
                    name=model.actuator(number).name, controls=controls, activations=activations, outputs=outputs,
                    inputs=tuple(mujoco.mj_actuatorInputName(model, number, i) or "" for i in range(starts[0][1])),
                    joint=_joint_name(model, int(model.actuator_trnid[number, 0])) if of_joint else None,
                    forces=_side(model.actuator_forcelimited[number], model.actuator_forcerange[number]),
                    gear=float(model.actuator_gear[outputs.start, 0]), gain=gain, bias=bias,
                )
            )  # fmt: skip
        return tuple(found)

    @cached_property
    def controls(self) -> tuple[Control, ...]:
        """All controls, in MuJoCo's order: named as their actuator, `<actuator>_<input>` if it has several, or none."""
        model, joints, found = self.model, {one.name: one for one in self.joints}, list[Control]()
        low, high = ranges(model.actuator_ctrllimited.astype(bool), model.actuator_ctrlrange)
        for number, one in enumerate(self.actuators):
            if model.actuator_dyntype[number] == mujoco.mjtDyn.mjDYN_MUSCLE.value:  # MuJoCo passes on what is in 0..1
                low[one.controls], high[one.controls] = (side[one.controls].clip(0, 1) for side in (low, high))
            for place, name in zip(range(one.controls.start, one.controls.stop), one.inputs, strict=True):
                full, unit = f"{one.name}_{name}" if len(one.inputs) > 1 else one.name, _unit(one, joints, name)
                found.append(Control(full, unit, float(low[place]), float(high[place])))
        return tuple(found)

    @cached_property
    def activations(self) -> tuple[str, ...]:
        """The names of the states of actuators, (na,): `<actuator>_activation`, numbered if an actuator has several."""
        names = [""] * int(self.model.na)
        for one in self.actuators:
            places = range(one.activations.start, one.activations.stop)
            for i, place in enumerate(places):
                names[place] = f"{one.name}_activation" + (f"_{i}" if len(places) > 1 else "")
        return tuple(names)

    @cached_property
    def states(self) -> tuple[tuple[str, str], ...]:
        """The names and units of a robot's states: positions, velocities, states of actuators; as `MjcfRobot` says."""
        turned = [("rx", "rad"), ("ry", "rad"), ("rz", "rad")], [("wx", "rad/s"), ("wy", "rad/s"), ("wz", "rad/s")]
        moved = [(axis, "m") for axis in "xyz"], [(f"v{axis}", "m/s") for axis in "xyz"]
        loose = [one for one in self.joints if one.kind == "free" and one.name.startswith(UNNAMED)]
        found = list[tuple[str, str]]()
        for side in (0, 1):
            for one in self.joints:
                own = "" if [one] == loose else f"{one.name}_"
                if one.kind in ("free", "ball"):
                    entries = [*(moved[side] if one.kind == "free" else []), *turned[side]]
                    found += [(own + name, unit) for name, unit in entries]
                else:
                    unit = "m" if one.kind == "slide" else "rad"
                    found.append((one.name, unit) if side == 0 else (f"{one.name}_velocity", f"{unit}/s"))
        return (*found, *((name, "") for name in self.activations))

    def positions_of(self, qpos: Array) -> Array:
        """A robot's positions (..., nv), with rotation vectors, of MuJoCo's (..., nq), with quaternions."""
        return self._turned([qpos[..., one.qpos] for one in self.joints], 4, rotations.rotation_vector)

    def qpos_of(self, positions: Array) -> Array:
        """MuJoCo's positions (..., nq) of a robot's (..., nv)."""
        return self._turned([positions[..., one.dofs] for one in self.joints], 3, rotations.quaternion)

    def _turned(self, parts: list[Array], size: int, turn: Callable[..., Array]) -> Array:
        """The positions of all joints, the rotation in the last numbers of ball and free joints in its other form."""
        for i, one in enumerate(self.joints):
            if one.kind in ("free", "ball"):
                rotation = turn(parts[i][..., -size:], turns_about=self.turns_about)
                parts[i] = np.concatenate([parts[i][..., :-size], rotation], axis=-1)
        return np.concatenate(parts, axis=-1)

    def body_of(self, name: str | None, what: str) -> int:
        """The id of the body of that name; without a name, of the first moving body with mass. Raises InputError."""
        model = self.model
        if name is not None:
            names = [model.body(number).name for number in range(1, model.nbody)]
            return int(model.body(check_name(f"{what}: body", name, names)).id)
        moving = [number for number in range(1, model.nbody) if model.body_jntnum[number] > 0]
        if not moving:
            raise InputError(f"{what}: got no joints, want a robot that moves: at least one <joint> or <freejoint/>")
        # Several bodies may each carry a slide before there is any mass. The robot is the first body with mass, its own
        # or the mass of bodies fixed to it.
        masses = np.bincount(model.body_weldid, weights=model.body_mass, minlength=model.nbody)
        return next((number for number in moving if masses[number] > 0), moving[0])

    @cached_property
    def numbers(self) -> dict[str, mjcf_text.Number]:
        """The numbers that can be changed, by the names of parameters."""
        return mjcf_text.numbers_of(self.xml, self.model)

    def keyframe(self, name: str, what: str) -> tuple[Array, Array, Array | None]:
        """qpos, qvel and act of a keyframe; act is None if the MJCF does not state it, of which the model has zeros."""
        model, number = self.model, self._key(name, what)
        if moved := list(_mocap_poses(model, number)):
            raise InputError(
                f"{what}: keyframe: got {name!r}, in which the mocap bodies {', '.join(moved)} are elsewhere, want"
                f" MjcfRobot(..., mocap={name!r}), which has them there"
            )
        stated = model.na > 0 and len(self.spec().keys[number].act) > 0
        act = model.key_act[number].copy() if stated else None
        return model.key_qpos[number].copy(), model.key_qvel[number].copy(), act

    def _key(self, name: str, what: str) -> int:
        names = [self.model.key(number).name for number in range(self.model.nkey)]
        return names.index(check_name(f"{what}: keyframe", name, names))

    # The same with changes, each a model of its own.

    def complete(self) -> "MjcfModel":
        """The same with names for all bodies, joints, geoms and actuators, and with a light, if it has none."""
        xml, has_light = mjcf_text.named(self.xml)
        named = self if xml == self.xml else replace(self, xml=xml)
        if has_light or "</mujoco>" not in xml or ("<attach" in xml and named.model.nlight):
            return named
        # The size of the whole is known when it is compiled, and the light is to be in what is compiled.
        lit = replace(self, xml=mjcf_text.with_light(xml, np.zeros(3)))
        model = lit.model
        place = model.stat.center + float(model.stat.extent) * np.array([-1.0, -1.0, 3.0])
        found = replace(self, xml=mjcf_text.with_light(xml, place))
        for field in (model.light_pos, model.light_pos0, model.light_poscom0):
            field[-1] += [float(f"{number:.6g}") for number in place]
        vars(found)["model"] = model
        return found

    def with_mocap(self, key: str, what: str) -> "MjcfModel":
        """The same with its mocap bodies where a keyframe has them, and all else as it is."""
        number = self._key(key, what)
        if not (poses := _mocap_poses(self.model, number)):
            return self
        found = replace(self, xml=mjcf_text.with_mocap(self.xml, self.model, poses, key))
        if not _same_forces(self.model, number, found.model):
            raise InputError(
                f"{what}: mocap: got the keyframe {key!r}, whose mocap bodies cannot be placed by rewriting the MJCF,"
                " want them directly in the <worldbody>, and springs of tendons at them with a springlength"
            )
        return found

    def with_numbers(self, values: Mapping[str, float], what: str) -> "MjcfModel":
        """The same with other `numbers`."""
        return replace(self, xml=mjcf_text.with_numbers(self.xml, self.model, values, what))

    def with_obstacles(self, world: World) -> "MjcfModel":
        """The same with these obstacles as further geoms."""
        return replace(self, xml=mjcf_text.with_obstacles(self.xml, world))


def model_from_xml(xml: str, what: str) -> mujoco.MjModel:
    """The model of an MJCF given as text, without includes; `what` is its name in messages."""
    _check_elements(xml, what)
    try:
        with unlogged():
            model = _spec_of(xml).compile() if "<attach" in xml else mujoco.MjModel.from_xml_string(xml)
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
        raise InputError(f"{what}: got an MJCF that MuJoCo refuses: {' '.join(str(error).split())}") from None
    _check_numbers(model, what)
    return model


def _spec_of(xml: str) -> mujoco.MjSpec:
    """The spec of an MJCF, in which elements of attached models have names, too: the text cannot name them."""
    spec = mujoco.MjSpec.from_string(xml)
    if "<attach" not in xml:
        return spec
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    for joint in free if len(free) > 1 else ():
        joint.name = joint.name or joint.parent.name
    for kind, elements in (
        ("body", spec.bodies), ("joint", spec.joints), ("geom", spec.geoms), ("actuator", spec.actuators),
    ):  # fmt: skip
        taken = {element.name for element in elements}
        names = (name for count in itertools.count() if (name := f"{UNNAMED}{kind}_{count}") not in taken)
        for element in elements:
            element.name = element.name or next(names)
    return spec


def _joint_name(model: mujoco.MjModel, number: int) -> str:
    return model.joint(number).name or f"generated_joint_{number}"  # such as those of a flexcomp


def _side(limited: Any, side: Array) -> Side:
    return (float(side[0]), float(side[1])) if limited else (-math.inf, math.inf)


def _affine(model: mujoco.MjModel, number: int) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """The gain and the bias of an actuator, if its force has the form that `Actuator` says."""
    gain, bias = mujoco.mjtGain(model.actuator_gaintype[number]), mujoco.mjtBias(model.actuator_biastype[number])
    gains = {mujoco.mjtGain.mjGAIN_FIXED: 1, mujoco.mjtGain.mjGAIN_AFFINE: 3}.get(gain, 0)
    biases = {mujoco.mjtBias.mjBIAS_NONE: 0, mujoco.mjtBias.mjBIAS_AFFINE: 3}.get(bias)
    early = model.actuator_actearly[number]  # the force is that of the next activation
    if not gains or biases is None or early or model.actuator_plugin[number] >= 0:
        return None, None
    parts = (model.actuator_gainprm[number, :gains], model.actuator_biasprm[number, :biases])
    first, second = (tuple(np.pad(part, (0, 3 - len(part))).tolist()) for part in parts)
    return first, second


def ranges(limited: npt.NDArray[np.bool_], sides: Array) -> tuple[Array, Array]:
    """The least and the largest numbers (k,) of ranges (k, 2), infinite where there is no limit."""
    low, high = np.where(limited, sides.T, [[-np.inf], [np.inf]])
    return low, high


def _unit(one: Actuator, joints: Mapping[str, Joint], what: str) -> str:
    """The unit of an actuator's input, for plain motors and servos of joints; empty for others, which have none."""
    joint = joints.get(one.joint or "")
    if joint is None or joint.kind not in ("slide", "hinge") or one.gear != 1:
        return ""
    force, length = ("N", "m") if joint.kind == "slide" else ("N m", "rad")
    if what or one.gain is None or one.bias is None or any(one.gain[1:]):
        units = {"pos": length, "vel": f"{length}/s", "ff": force, "voltage": "V"}
        return units.get(what, "")
    (gain, _, _), (constant, stiffness, damping) = one.gain, one.bias
    if not any(one.bias):
        return force if gain == 1 and one.activations.start == one.activations.stop else ""
    if gain == -stiffness and constant == 0:
        return length
    return f"{length}/s" if stiffness == 0 and gain == -damping else ""


def _mocap_poses(model: mujoco.MjModel, key: int) -> dict[str, tuple[Array, Array]]:
    """Positions and quaternions of the mocap bodies that are elsewhere in a keyframe than in the MJCF, by name."""
    found = {}
    for body in np.flatnonzero(model.body_mocapid >= 0).tolist():
        where = int(model.body_mocapid[body])
        place, quat = (all_of[key].reshape(model.nmocap, -1)[where] for all_of in (model.key_mpos, model.key_mquat))
        near = np.abs(place - model.body_pos[body]).max() < _SAME
        if not near or 1 - abs(float(quat @ model.body_quat[body])) > _SAME * np.linalg.norm(quat):
            found[model.body(body).name] = (place, quat)
    return found


def _same_forces(model: mujoco.MjModel, key: int, other: mujoco.MjModel) -> bool:
    """Whether another model has the forces of this one with its mocap bodies where a keyframe has them."""
    rng, found = np.random.default_rng(0), []
    move = rng.normal(size=(3, model.nv))
    for one in (model, other):
        data = mujoco.MjData(one)
        mujoco.mj_resetDataKeyframe(model, data, key)
        for step in move:
            mujoco.mj_integratePos(one, data.qpos, step, 0.3)
            mujoco.mj_inverse(one, data)
            rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
            found.append(
                np.concatenate([data.efc_pos[rows], data.ten_length, data.qfrc_passive, data.mocap_pos.ravel()])
            )
    pairs = zip(found[:3], found[3:], strict=True)
    return not _mocap_poses(other, key) and all(
        len(a) == len(b) and np.allclose(a, b, rtol=1e-6, atol=1e-9) for a, b in pairs
    )


@unlogged()
def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model of a spec, which has been compiled before: warnings about it were given, or are counted in runs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return spec.compile()


def _check_elements(xml: str, what: str) -> None:
    """Raises InputError where MuJoCo would crash or stay silent: for excessive counts, or NaN for unknown numbers.

    MuJoCo treats a NaN for the mass or density of a geom as a missing number.
    """
    text = xml.lower()
    rare = any(word in text for word in (*_COPIERS, "hfield", "nan", "builtin", *(f"<{tag}" for tag in MOST)))
    if not rare and xml.count("</") < DEEPEST and xml.count("<") <= MOST_COPIES:
        return  # files of thousands of geoms are not read again
    reader, depth, copies = ElementTree.XMLPullParser(["start", "end"]), 0, [1]
    try:
        reader.feed(xml)
        made = 0
        events: Any = reader.read_events()
        for event, element in events:
            depth += 1 if event == "start" else -1
            if depth > DEEPEST:
                raise InputError(f"{what}: got elements nested deeper than {DEEPEST}, want less nesting")
            if element.tag in _COPIERS:
                copies = [*copies, copies[-1] * _product(element.get("count", ""))] if event == "start" else copies[:-1]
            if event == "start" and element.tag in ("geom", "body", "site", "light", "camera", *_COPIERS):
                made += copies[-1]
                if made > MOST_COPIES:
                    got = f"<{element.tag}> of {copies[-1]:,} copies" if element.tag in _COPIERS else "more"
                    raise InputError(f"{what}: got {got}, want {MOST_COPIES:,} elements at most")
            for key in _MASSES.intersection(element.attrib) if event == "start" else ():
                if _NAN.search(element.attrib[key].lower()):
                    name = f" {element.attrib['name']!r}" if "name" in element.attrib else ""
                    raise InputError(f"{what}: got NaN for the {key} of {element.tag}{name}, want a number")
            if event == "start":
                _check_sizes(element, what)
            if event == "start" and element.tag == "hfield":
                sizes = [element.attrib.get(key, "") for key in ("nrow", "ncol")]
                cells = int(sizes[0]) * int(sizes[1]) if all(size.strip().isdecimal() for size in sizes) else 0
                if cells > MOST_CELLS:
                    got = f"{sizes[0]} x {sizes[1]} heights in the height field {element.attrib.get('name', '')!r}"
                    raise InputError(f"{what}: got {got}, want {MOST_CELLS:,} at most")
    except (ElementTree.ParseError, ValueError) as error:
        if isinstance(error, InputError):
            raise  # MuJoCo reports all other errors


def _check_sizes(element: ElementTree.Element, what: str) -> None:
    """Raises InputError for a size beyond MOST, or a texture of more than MOST_PIXELS."""
    given = element.attrib
    most = MOST.get(element.tag, {})
    for key, text in given.items() if most else ():
        largest = MOST_USER if key.startswith("nuser_") else most.get(key)
        if largest is not None and _size(text) > largest:
            got = f"{key}={excerpt(text)} in <{element.tag}>"
            raise InputError(f"{what}: got {got}, want {largest:,} at most")
    if element.tag == "texture" and "builtin" in given:
        width, height = _size(given.get("width", "0")), _size(given.get("height", "0"))
        if max(width * height, 6 * width**2 if given.get("type", "cube") == "cube" else 0) > MOST_PIXELS:
            got = f"{excerpt(given.get('width'))} x {excerpt(given.get('height'))} pixels in <texture>"
            raise InputError(f"{what}: got {got}, want {MOST_PIXELS:,} at most")


def _size(text: str) -> float:
    """A number of an MJCF, which may end in K, M, G, T, P or E, powers of 1024; 0 if MuJoCo itself refuses it."""
    match = re.fullmatch(r"\s*\+?([\d.]+(?:e\+?\d{1,2})?)([kmgtpe]?)\s*", text.lower())
    with contextlib.suppress(ValueError):
        return float(match[1]) * 1024.0 ** ("kmgtpe".find(match[2]) + 1 if match[2] else 0) if match else 0.0
    return 0.0


def _product(text: str) -> int:
    """The count in an element of an MJCF, or the product of several counts; 1 if MuJoCo itself refuses it."""
    return math.prod(max(int(number), 1) for number in re.findall(r"(?<!\S)\+?(\d+)(?!\S)", text))


def _check_numbers(model: mujoco.MjModel, what: str) -> None:
    """Raises InputError if the model contains a NaN, about which MuJoCo only warns, or its timestep is not positive."""
    if not 0 < model.opt.timestep < np.inf:
        raise InputError(f"{what}: got the timestep {model.opt.timestep:g}, want a finite number of seconds above 0")
    for field in ("gravity", "wind", "magnetic"):
        if not np.isfinite(getattr(model.opt, field)).all():
            raise InputError(f"{what}: got {field} {getattr(model.opt, field).tolist()}, want finite numbers")
    for field in (name for name in dir(model) if not name.startswith("_")):
        array = getattr(model, field)
        if isinstance(array, np.ndarray) and array.dtype.kind == "f" and array.size and np.isnan(array.min()):
            element = int(np.argwhere(np.isnan(array))[0][0])
            raise InputError(f"{what}: got NaN in the MJCF (MuJoCo's {field}[{element}]), want numbers")
