"""An MJCF: its text with all includes, read and checked; and the record of it, compiled once, that all else shares."""

import contextlib
import difflib
import itertools
import math
import os
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lqrsim import rotations
from lqrsim.annotations import checked
from lqrsim.errors import Array, InputError, check_name, check_number, check_path, excerpt
from lqrsim.scenes.mjcf_kinematics import colliding, placed, quaternion_of
from lqrsim.scenes.mujoco_log import mujoco, unlogged
from lqrsim.scenes.urdf import DEEPEST, SPEED_LIMIT, is_urdf, read_urdf
from lqrsim.scenes.world import KINDS, World

_OF_REVOLUTION = (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_ELLIPSOID)
_SIZES = {"free": (7, 6), "ball": (4, 3), "slide": (1, 1), "hinge": (1, 1)}
_OF_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_NUMBERS = ("damping", "stiffness", "armature", "frictionloss")  # of joints
_MEDIUM = ("density", "viscosity")
_BOUNDS = {"mass": {"above": 0.0}, "gear": {}}  # bounds; all other numbers must not be negative
_LONG = 1e3  # m, half length of a geom that stands for an infinite one
FAR_PAST = 0.1  # fraction of a joint's range; springs of limits give way by less
_ROUND = 1e-3  # distance from a wheel's axis relative to its radius, and error of the axis' cosine, that are rounding
_SAME = 1e-12  # m, and of quaternions, within which a mocap body is where a keyframe has it

# In the wheel, models/ is inside the package; in the repository, next to it.
_PACKAGED = [Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "models"]
MODELS = next((folder for folder in _PACKAGED if folder.is_dir()), _PACKAGED[0])

UNNAMED = "unnamed_"  # prefix of the names of bodies, joints, geoms and actuators without a name in the MJCF
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
_MASSES = {
    "mass", "density", "viscosity", "armature", "diaginertia", "fullinertia", "settotalmass", "boundmass",
    "boundinertia",
}  # fmt: skip
_NAN = re.compile(r"(^|[\s,])[+-]?nan")

Side = tuple[float, float]  # the least and the largest; infinite without a limit


class Joint(NamedTuple):
    """A joint."""

    name: str
    kind: str  # free, ball, slide or hinge
    qpos: slice  # its indices in qpos
    dofs: slice  # and in qvel
    limits: Side | None  # of a slide or hinge, in m or rad
    forces: Side  # of the sum that actuators exert on it, in N or N m, with gravity compensation if that is theirs
    # The largest speed of a slide or hinge, in m/s or rad/s, infinite if none is stated. MuJoCo does not know it: it is
    # the number `<numeric name="NAME_velocity_limit">` in the <custom> section.
    speed: float

    @property
    def dof(self) -> int:
        """The first of its indices in qvel; a slide or hinge has only this index."""
        return self.dofs.start

    def past_limits(self, position: float, fraction: float) -> str | None:
        """What a message says of a position past the joint's limits by more than a fraction of its range; else None."""
        if self.limits is None:
            return None
        least, most = self.limits
        if least - fraction * (most - least) <= position <= most + fraction * (most - least):
            return None
        unit, more = "m", ""
        if self.kind == "hinge":
            unit, more = "rad", f" ({np.degrees(least):.4g} to {np.degrees(most):.4g} degrees)"
        wanted = f"want the joint within its limits in the MJCF, {least:.4g} to {most:.4g} {unit}{more}"
        return f"got {position:.4g} {unit} for {self.name}, {wanted}"


class Control(NamedTuple):
    """A control: its name, its unit (or empty), and its limits."""

    name: str
    unit: str
    low: float
    high: float


class Actuator(NamedTuple):
    """An actuator. Its force is `(gain @ motion) input + bias @ motion`, where motion is (1, length, velocity).

    The input is its control, or the last of its activations if it has some. The force is clipped to `forces`; times the
    moment arm, which for a slide or hinge is the gear, it acts on the joint, whose sum is clipped to `Joint.forces`.

    `controls`, `activations` and `outputs` are its indices in ctrl, act and actuator_force; there may be several.
    """

    name: str
    joint: str | None  # that it acts on; None if it acts on something else
    controls: slice
    activations: slice
    outputs: slice
    inputs: tuple[str, ...]  # MuJoCo's names of its controls, such as pos and vel; empty for just a command
    forces: Side  # in N or N m
    gear: float  # of its first output
    gain: tuple[float, ...] | None  # three numbers, as bias; None for other forms, as of muscles, `pid` and `dcmotor`
    bias: tuple[float, ...] | None


class Number(NamedTuple):
    """A number of an MJCF: its kind, its body, joint, geom or actuator (empty for all), and its value."""

    what: str
    part: str
    value: float


@checked
@dataclass(frozen=True, eq=False)
class MjcfModel:
    """An MJCF: its text, and what MuJoCo compiles from it, once, when it is first asked for."""

    name: str  # of the packaged scene, or the stem of the file
    xml: str  # the whole text, with includes resolved; the model can be made from it alone
    turns_about: str | None = None  # the axis about which a robot's free and ball joints turn on; see `MjcfRobot`

    @classmethod
    def of_file(cls, name_or_path: str | os.PathLike[str], **of_urdf: Any) -> "MjcfModel":
        """That of a packaged scene, an MJCF or a URDF, of which `of_urdf` are the settings; errors as `load_scene`."""
        if of_urdf or is_urdf(name_or_path):
            return cls(*read_urdf(name_or_path, **of_urdf))
        path = check_path("scene", name_or_path, "the name of a packaged scene, or the path of an .xml or .urdf file")
        if path.suffix.lower() != ".xml":
            packaged = names()
            try:
                path = MODELS / f"{check_name('scene', os.fspath(name_or_path), packaged)}.xml"
            except InputError as error:
                raise InputError(f"{error}; or the path of an .xml or .urdf file") from None
        elif not os.path.isfile(path):
            packaged = ", ".join(names())
            files = [file.name for file in path.parent.glob("*.xml") if os.path.isfile(file)]
            near = difflib.get_close_matches(path.name, files, n=1)
            hint = f" (did you mean {path.with_name(near[0])}?)" if near else ""
            got = os.fspath(name_or_path)
            raise InputError(f"scene: got {got!r}, want a file that exists, or one of: {packaged}{hint}")
        try:
            return cls(path.stem, _flatten(path))
        except RecursionError:
            raise InputError(f"scene: got {path.name} with elements nested deeper than {DEEPEST}, want fewer") from None

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
        return spec_of(self.xml)

    # What it is made of.

    @cached_property
    def joints(self) -> tuple[Joint, ...]:
        model, joints = self.model, list[Joint]()
        for number in range(model.njnt):
            kind = mujoco.mjtJoint(model.jnt_type[number]).name.removeprefix("mjJNT_").lower()
            name = _joint_name(model, number)
            firsts = int(model.jnt_qposadr[number]), int(model.jnt_dofadr[number])
            qpos, dofs = (slice(first, first + size) for first, size in zip(firsts, _SIZES[kind], strict=True))
            single = kind in ("slide", "hinge")
            limited = model.jnt_limited[number] and single
            numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, f"{name}{SPEED_LIMIT}") if single else -1
            joints.append(
                Joint(
                    name=name, kind=kind, qpos=qpos, dofs=dofs,
                    limits=_side(limited, model.jnt_range[number]) if limited else None,
                    forces=_side(model.jnt_actfrclimited[number], model.jnt_actfrcrange[number]),
                    speed=math.inf if numeric < 0 else float(model.numeric(numeric).data[0]),
                )
            )  # fmt: skip
        return tuple(joints)

    @cached_property
    def wheels(self) -> tuple[Joint, ...]:
        """Hinges about which all turns look the same: without limits, the axis is that of all that collides there."""
        data = placed(self.model)
        return tuple(joint for number, joint in enumerate(self.joints) if self._is_wheel(number, data))

    def _is_wheel(self, number: int, data: mujoco.MjData) -> bool:
        model, welds, body = self.model, self.model.body_weldid, int(self.model.jnt_bodyid[number])
        if self.joints[number].kind != "hinge" or self.joints[number].limits or model.jnt_stiffness[number]:
            return False
        if model.body_jntnum[body] > 1 or ((welds[model.body_parentid] == body) & (welds != body)).any():
            return False
        start, axis = data.xanchor[number], data.xaxis[number]

        def is_round(geom: int) -> bool:
            size, center = model.geom_size[geom], data.geom_xpos[geom] - start
            if np.linalg.norm(np.cross(center, axis)) > _ROUND * size[0]:
                return False
            kind = mujoco.mjtGeom(model.geom_type[geom])
            if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
                return True
            if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID and size[0] != size[1]:
                return False
            turned = data.geom_xmat[geom, 2::3]
            return kind in _OF_REVOLUTION and abs(float(turned @ axis)) > 1 - _ROUND

        geoms = np.flatnonzero((welds[model.geom_bodyid] == body) & colliding(model))
        return len(geoms) > 0 and all(is_round(geom) for geom in geoms.tolist())

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        model, actuators = self.model, list[Actuator]()
        places = (
            (model.actuator_ctrladr, model.actuator_ctrlnum), (model.actuator_actadr, model.actuator_actnum),
            (model.actuator_outadr, model.actuator_outnum),
        )  # fmt: skip
        for number in range(model.nactuator):
            starts = [(max(0, int(first[number])), int(count[number])) for first, count in places]  # -1 without any
            controls, activations, outputs = (slice(first, first + count) for first, count in starts)
            of_joint = mujoco.mjtTrn(model.actuator_trntype[number]) in _OF_JOINTS
            gain, bias = _affine(model, number)
            actuators.append(
                Actuator(
                    name=model.actuator(number).name, controls=controls, activations=activations, outputs=outputs,
                    inputs=tuple(mujoco.mj_actuatorInputName(model, number, i) or "" for i in range(starts[0][1])),
                    joint=_joint_name(model, int(model.actuator_trnid[number, 0])) if of_joint else None,
                    forces=_side(model.actuator_forcelimited[number], model.actuator_forcerange[number]),
                    gear=float(model.actuator_gear[outputs.start, 0]), gain=gain, bias=bias,
                )
            )  # fmt: skip
        return tuple(actuators)

    @cached_property
    def controls(self) -> tuple[Control, ...]:
        """All controls, in MuJoCo's order: named as their actuator, `<actuator>_<input>` if it has several, or none."""
        model, joints, controls = self.model, {joint.name: joint for joint in self.joints}, list[Control]()
        low, high = ranges(model.actuator_ctrllimited.astype(bool), model.actuator_ctrlrange)
        for number, actuator in enumerate(self.actuators):
            if model.actuator_dyntype[number] == mujoco.mjtDyn.mjDYN_MUSCLE.value:  # MuJoCo passes on what is in 0..1
                for side in (low, high):
                    side[actuator.controls] = side[actuator.controls].clip(0, 1)
            for entry, name in enumerate(actuator.inputs, actuator.controls.start):
                full = f"{actuator.name}_{name}" if len(actuator.inputs) > 1 else actuator.name
                controls.append(Control(full, _unit(actuator, joints, name), float(low[entry]), float(high[entry])))
        return tuple(controls)

    @cached_property
    def efforts(self) -> Array:
        """The largest size of each control, (nu,): from its own limits, else from its force's; 1 without limits."""
        joints, largest = {joint.name: joint for joint in self.joints}, np.ones(len(self.controls))
        for actuator in self.actuators:
            sides = []
            # Otherwise its control is no force.
            if actuator.gain is not None and actuator.gain[0] and not any(actuator.bias or ()):
                sides.append(np.abs(actuator.forces) / abs(actuator.gain[0]))
                if actuator.joint is not None and actuator.gear:
                    sides.append(np.abs(joints[actuator.joint].forces) / abs(actuator.gain[0] * actuator.gear))
            for k in range(actuator.controls.start, actuator.controls.stop):
                limits = np.abs([self.controls[k].low, self.controls[k].high])
                largest[k] = next((size for side in (limits, *sides) if 0 < (size := float(side.max())) < np.inf), 1.0)
        return largest

    @cached_property
    def activations(self) -> tuple[str, ...]:
        """The names of the states of actuators, (na,): `<actuator>_activation`, numbered if an actuator has several."""
        names = [""] * int(self.model.na)
        for actuator in self.actuators:
            entries = range(actuator.activations.start, actuator.activations.stop)
            for i, entry in enumerate(entries):
                names[entry] = f"{actuator.name}_activation" + (f"_{i}" if len(entries) > 1 else "")
        return tuple(names)

    @cached_property
    def states(self) -> tuple[tuple[str, str], ...]:
        """The names and units of a robot's states: positions, velocities, states of actuators; as `MjcfRobot` says."""
        rotational = [("rx", "rad"), ("ry", "rad"), ("rz", "rad")], [("wx", "rad/s"), ("wy", "rad/s"), ("wz", "rad/s")]
        translational = [(axis, "m") for axis in "xyz"], [(f"v{axis}", "m/s") for axis in "xyz"]
        unnamed = [joint for joint in self.joints if joint.kind == "free" and joint.name.startswith(UNNAMED)]
        states = list[tuple[str, str]]()
        for derivative in (0, 1):
            for joint in self.joints:
                prefix = "" if [joint] == unnamed else f"{joint.name}_"
                if joint.kind in ("free", "ball"):
                    entries = [*(translational[derivative] if joint.kind == "free" else []), *rotational[derivative]]
                    states += [(prefix + name, unit) for name, unit in entries]
                else:
                    unit = "m" if joint.kind == "slide" else "rad"
                    states.append((joint.name, unit) if derivative == 0 else (f"{joint.name}_velocity", f"{unit}/s"))
        return (*states, *((name, "") for name in self.activations))

    def positions_of(self, qpos: Array) -> Array:
        """A robot's positions (..., nv), with rotation vectors, of MuJoCo's (..., nq), with quaternions."""
        return self._turned([qpos[..., joint.qpos] for joint in self.joints], 4, rotations.rotation_vector)

    def qpos_of(self, positions: Array) -> Array:
        """MuJoCo's positions (..., nq) of a robot's (..., nv)."""
        return self._turned([positions[..., joint.dofs] for joint in self.joints], 3, rotations.quaternion)

    def _turned(self, parts: list[Array], size: int, turn: Callable[..., Array]) -> Array:
        """The positions of all joints, the rotation in the last numbers of ball and free joints in its other form."""
        for i, joint in enumerate(self.joints):
            if joint.kind in ("free", "ball"):
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
    def carriers(self) -> tuple[int, ...]:
        """The ids of the bodies with mass that move, by themselves or with others: they can carry loads."""
        return tuple(np.flatnonzero((self.model.body_treeid >= 0) & (self.model.body_mass > 0)).tolist())

    @cached_property
    def numbers(self) -> dict[str, Number]:
        """The numbers that can be changed, by the names of parameters: `mass`, `<body>_mass`, `<joint>_damping`, ....

        Its elements all have names. Only elements with a name and this number in the text count: bodies that move,
        geoms that collide.
        """
        model = self.model
        elements, numbers = _elements(ElementTree.fromstring(self.xml)), list[Number]()
        masses = {model.body(number).name: float(model.body_mass[number]) for number in self.carriers}
        names = {model.body(number).name for number in range(1, model.nbody)}
        if names == elements["body"].keys():  # otherwise the text has no place for some masses
            numbers += [Number("mass", "", sum(masses.values()))] if masses else []
            numbers += [Number("mass", name, mass) for name, mass in masses.items()]
        for number in range(model.njnt):
            joint = model.joint(number)
            if joint.name in elements["joint"]:
                numbers += [Number(key, joint.name, float(getattr(joint, key)[0])) for key in _NUMBERS]
        for number in np.flatnonzero(colliding(model)):
            if (name := model.geom(number).name) in elements["geom"]:
                numbers.append(Number("friction", name, float(model.geom_friction[number, 0])))
        for number, gear in enumerate(model.actuator_gear[model.actuator_outadr]):
            element = elements["actuator"].get(model.actuator(number).name)
            if element is not None and element.tag != "adhesion" and gear.any():  # adhesion has no gear in the text
                numbers.append(Number("gear", element.attrib["name"], float(gear[np.abs(gear).argmax()])))
        numbers += [Number(key, "", float(getattr(model.opt, key))) for key in _MEDIUM]
        return {f"{number.part}_{number.what}" if number.part else number.what: number for number in numbers}

    def keyframe(self, name: str, what: str) -> tuple[Array, Array, Array | None]:
        """qpos, qvel and act of a keyframe; act is None if the MJCF does not state it, of which the model has zeros."""
        model, number = self.model, self._key(name, what)
        if bodies := list(_mocap_poses(model, number)):
            raise InputError(
                f"{what}: keyframe: got {name!r}, in which the mocap bodies {', '.join(bodies)} are elsewhere, want"
                f" MjcfRobot(..., mocap={name!r}), which has them there"
            )
        stated = model.na > 0 and len(self.spec().keys[number].act) > 0
        act = model.key_act[number].copy() if stated else None
        return model.key_qpos[number].copy(), model.key_qvel[number].copy(), act

    def _key(self, name: str, what: str) -> int:
        names = [self.model.key(number).name for number in range(self.model.nkey)]
        return names.index(check_name(f"{what}: keyframe", name, names))

    # The same with changes, each a model of its own.

    def for_robot(self, turns_about: str | None, mocap: str | None, what: str) -> "MjcfModel":
        """The same as `MjcfRobot` has it: its elements have names, it has a light, mocap bodies are where a keyframe
        has them.
        """
        mjcf = self if self.turns_about == turns_about else replace(self, turns_about=turns_about)
        mjcf = mjcf.named().lit()
        return mjcf if mocap is None else mjcf.with_mocap(mocap, what)

    def named(self) -> "MjcfModel":
        """The same with names for all bodies, joints, geoms and actuators.

        Names are `unnamed_<kind>_<number>`, counted from 0; of several free joints without one, each gets its body's.
        """
        root = ElementTree.fromstring(self.xml)
        used_names = {element.get("name") for element in root.iter()}
        # An MJCF has its own section worldbody, and one from each file that it includes.
        placed = [element for world in root.iter("worldbody") for element in world.iter()]
        kinds = {"body": ("body",), "joint": ("joint", "freejoint"), "geom": ("geom",)}
        parts = {kind: [element for element in placed if element.tag in tags] for kind, tags in kinds.items()}
        parts["actuator"] = [element for section in root.iter("actuator") for element in section]
        free = [
            (body.get("name"), joint)
            for body in parts["body"]
            for joint in body
            if (joint.tag == "freejoint" or (joint.tag == "joint" and joint.get("type") == "free"))
            and joint.get("name") is None
        ]
        for body, joint in free if len(free) > 1 else ():
            if body is not None and body not in {element.get("name") for element in parts["joint"]}:
                joint.set("name", body)
        changed = len(free) > 1
        for kind, elements in parts.items():
            unnamed = [element for element in elements if element.get("name") is None]
            for element, name in zip(unnamed, unnamed_names(kind, used_names), strict=False):
                element.set("name", name)
            changed = changed or len(unnamed) > 0
        return self._of(root) if changed else self

    def lit(self) -> "MjcfModel":
        """The same with a light, if it has none, and compiled: the light's place follows from the size of the whole.

        It is compiled only once, with the light at the origin, which is then moved in the text and in the model alike.
        """
        xml, end = self.xml, self.xml.rfind("</mujoco>")
        if end < 0 or (("<light" in xml or "<attach" in xml) and self.model.nlight):
            return self

        def with_light_at(pos: str) -> MjcfModel:
            look = 'dir="0.3 0.3 -1" directional="true" diffuse=".5 .5 .5"'
            added = f'<worldbody><light name="overview" pos="{pos}" {look} /></worldbody>'
            return replace(self, xml=f"{xml[:end]}{added}{xml[end:]}")  # not parsed: it can be long

        model = with_light_at("0 0 0").model
        place = model.stat.center + float(model.stat.extent) * np.array([-1.0, -1.0, 3.0])
        written = [f"{number:.6g}" for number in place]
        for field in (model.light_pos, model.light_pos0, model.light_poscom0):
            field[-1] += np.array(written, dtype=np.float64)
        lit = with_light_at(" ".join(written))
        vars(lit)["model"] = model  # as its text would be compiled
        return lit

    def with_mocap(self, key: str, what: str) -> "MjcfModel":
        """The same with its mocap bodies where a keyframe has them, and all else as it is.

        What MuJoCo compiles from where bodies are at rest is stated as it was: what ties two bodies, by sites whose
        names begin with that of the keyframe.
        """
        model, number = self.model, self._key(key, what)
        if not (poses := _mocap_poses(model, number)):
            return self
        root = ElementTree.fromstring(self.xml)
        elements = _elements(root)["body"]
        for body, pose in poses.items():
            for other in ("axisangle", "xyaxes", "zaxis", "euler"):
                elements[body].attrib.pop(other, None)
            for attribute, values in zip(("pos", "quat"), pose, strict=True):
                _set(elements[body], attribute, values)
        elements["world"] = next(root.iter("worldbody"))
        ties = [tie for section in root.findall("equality") for tie in section]
        for i, (tie, values) in enumerate(zip(ties, model.eq_data, strict=False)):
            if tie.tag == "weld" and "body1" in tie.attrib:
                _set(tie, "relpose", values[3:10])
            elif tie.tag == "connect" and "body1" in tie.attrib:
                del tie.attrib["anchor"]
                for side, place in enumerate((values[:3], values[3:6]), 1):
                    site = {"name": f"{key}_tie_{i}_{side}", "group": "5"}
                    tied = ElementTree.SubElement(elements[tie.attrib.pop(f"body{side}", "world")], "site", site)
                    _set(tied, "pos", place)
                    tie.set(f"site{side}", site["name"])
        placed = self._of(root)
        if not _same_forces(model, number, placed.model):
            raise InputError(
                f"{what}: mocap: got the keyframe {key!r}, whose mocap bodies cannot be placed by rewriting the MJCF,"
                " want them directly in the <worldbody>, and springs of tendons at them with a springlength"
            )
        return placed

    def with_numbers(self, values: Mapping[str, float], what: str) -> "MjcfModel":
        """The same with other `numbers`.

        A body's inertia scales with its mass; `mass` scales all bodies. The numbers of a gear keep their ratios. What
        MuJoCo computes from masses, by a `springdamper` or a `dampratio`, is as it was.
        """
        model, numbers, root = self.model, self.numbers, ElementTree.fromstring(self.xml)
        elements, scales = _elements(root), dict[str, float]()
        if any(word in self.xml for word in ("springdamper", "dampratio", "biasprm")):
            self._state_dampers(elements)
        for name, value in values.items():
            number = numbers[name]
            value = check_number(f"{what}: {name}", value, **_BOUNDS.get(number.what, {"at_least": 0.0}))
            ratio = value / number.value if number.value else 0.0
            if name == "mass":  # of all moving bodies together
                scales |= dict.fromkeys([model.body(number).name for number in self.carriers], ratio)
                if other := next((key for key in values if key != "mass" and numbers[key].what == "mass"), None):
                    raise InputError(f"{what}: mass: got mass and {other}, want one of the two")
            elif number.what == "mass":
                scales[number.part] = ratio
            elif number.what in _NUMBERS:
                joint = model.joint(number.part).id
                # Damping and stiffness may be polynomials, of which this is the linear coefficient.
                damping, stiffness = model.dof_dampingpoly[model.jnt_dofadr[joint]], model.jnt_stiffnesspoly[joint]
                higher = {"damping": damping, "stiffness": stiffness}.get(number.what, ())
                _set(elements["joint"][number.part], number.what, [value, *higher])
            elif number.what == "friction":
                _set(elements["geom"][number.part], "friction", [value, *model.geom(number.part).friction[1:]])
            elif number.what == "gear":
                first = np.reshape(model.actuator(number.part).gear, (-1, 6))[0]
                _set(elements["actuator"][number.part], "gear", ratio * first)
            else:
                _set(ElementTree.SubElement(root, "option"), number.what, [value])  # the last element takes precedence
        if not scales:
            return self._of(root)
        unaligned = self._unaligned()
        for name, body in elements["body"].items():  # the compiled masses, in the place of what they came from
            for inertial in body.findall("inertial"):
                body.remove(inertial)
            compiled_body, scale = unaligned.body(name), scales.get(name, 1.0)
            if compiled_body.mass[0] > 0:
                inertial = ElementTree.Element("inertial")
                _set(inertial, "pos", compiled_body.ipos)
                _set(inertial, "quat", compiled_body.iquat)
                _set(inertial, "mass", [scale * compiled_body.mass[0]])
                _set(inertial, "diaginertia", scale * compiled_body.inertia)
                body.insert(0, inertial)
        compiler = {"inertiafromgeom": "false", "settotalmass": "-1", "boundmass": "0", "boundinertia": "0"}
        ElementTree.SubElement(root, "compiler", compiler)
        return self._of(root)

    def _state_dampers(self, elements: dict[str, dict[str, ElementTree.Element]]) -> None:
        """Write the numbers that MuJoCo computes by a `springdamper` of a joint or a `dampratio` of an actuator.

        A `springdamper` takes precedence over stiffness and damping.
        """
        model, spec = self.model, self.spec()
        for joint in spec.joints:
            if (joint.springdamper > 0).all() and (element := elements["joint"].get(joint.name)) is not None:
                number = model.joint(joint.name).id
                _set(element, "springdamper", [0.0, 0.0])
                _set(element, "stiffness", [model.jnt_stiffness[number], *model.jnt_stiffnesspoly[number]])
                dof = model.jnt_dofadr[number]
                _set(element, "damping", [model.dof_damping[dof], *model.dof_dampingpoly[dof]])
        for actuator in spec.actuators:
            element = elements["actuator"].get(actuator.name)
            bias = model.actuator(actuator.name).biasprm
            if element is not None and bias[2] < 0 < actuator.biasprm[2]:
                element.attrib.pop("dampratio", None)
                name, numbers = ("biasprm", bias) if element.tag == "general" else ("kv", [-bias[2]])
                _set(element, name, numbers)

    def _unaligned(self) -> mujoco.MjModel:
        """The model with the axes of all bodies as in the text: MuJoCo may align those of free bodies with inertias."""
        if "align" not in self.xml:
            return self.model
        root = ElementTree.fromstring(self.xml)
        for joint in root.iter("freejoint"):
            joint.set("align", "false")
        ElementTree.SubElement(root, "compiler", {"alignfree": "false"})
        return self._of(root).model

    def with_obstacles(self, world: World) -> "MjcfModel":
        """The same with these obstacles as further geoms, fixed to the world, which nothing touches."""
        root = ElementTree.fromstring(self.xml)
        geom_names = {element.get("name") for element in root.iter("geom")}
        section = ElementTree.SubElement(root, "worldbody")
        for obstacle in world.obstacles:
            drawn = [kind for kind in KINDS if kind != "mesh"]
            if obstacle.kind not in drawn:
                raise InputError(f"moving: got {obstacle.name}, a {obstacle.kind}, want one of: {', '.join(drawn)}")
            if obstacle.name in geom_names:
                raise InputError(f"moving: got {obstacle.name}, which is a geom of the robot's MJCF, want another name")
            size = np.minimum([0.0, 0.0, 1.0] if obstacle.kind == "plane" else obstacle.size, _LONG)
            attributes = {"name": obstacle.name, "type": obstacle.kind, "contype": "0", "conaffinity": "0"}
            geom = ElementTree.SubElement(section, "geom", attributes)
            for key, values in (("size", size), ("pos", obstacle.position), ("quat", quaternion_of(obstacle.rotation))):
                _set(geom, key, values)
        return self._of(root)

    def _of(self, root: ElementTree.Element) -> "MjcfModel":
        return replace(self, xml=ElementTree.tostring(root, encoding="unicode"))


def _elements(root: ElementTree.Element) -> dict[str, dict[str, ElementTree.Element]]:
    """The named elements, by kind and name. Replicas have other names in the model, and are not found."""
    elements = {"body": {}, "joint": {}, "geom": {}, "actuator": {}}
    for world in root.iter("worldbody"):
        for element in world.iter():
            if element.tag in elements:
                elements[element.tag][element.get("name", "")] = element
    for section in root.findall("actuator"):
        elements["actuator"] |= {element.get("name", ""): element for element in section}
    return elements


def _set(element: ElementTree.Element, name: str, numbers: Iterable[float]) -> None:
    """Write numbers so that they read back exactly."""
    element.set(name, " ".join(repr(float(number)) for number in numbers))


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


def _unit(actuator: Actuator, joints: Mapping[str, Joint], entry: str) -> str:
    """The unit of an actuator's input, for plain motors and servos of joints; empty for others, which have none."""
    joint = joints.get(actuator.joint or "")
    if joint is None or joint.kind not in ("slide", "hinge") or actuator.gear != 1:
        return ""
    force, length = ("N", "m") if joint.kind == "slide" else ("N m", "rad")
    if entry or actuator.gain is None or actuator.bias is None or any(actuator.gain[1:]):
        return {"pos": length, "vel": f"{length}/s", "ff": force, "voltage": "V"}.get(entry, "")
    (gain, _, _), (constant, stiffness, damping) = actuator.gain, actuator.bias
    if not any(actuator.bias):
        return force if gain == 1 and actuator.activations.start == actuator.activations.stop else ""
    if gain == -stiffness and constant == 0:
        return length
    return f"{length}/s" if stiffness == 0 and gain == -damping else ""


def _mocap_poses(model: mujoco.MjModel, key: int) -> dict[str, tuple[Array, Array]]:
    """Positions and quaternions of the mocap bodies that are elsewhere in a keyframe than in the MJCF, by name."""
    poses = {}
    for body in np.flatnonzero(model.body_mocapid >= 0).tolist():
        mocap = int(model.body_mocapid[body])
        position, quat = (table[key].reshape(model.nmocap, -1)[mocap] for table in (model.key_mpos, model.key_mquat))
        same_position = np.abs(position - model.body_pos[body]).max() < _SAME
        if not same_position or 1 - abs(float(quat @ model.body_quat[body])) > _SAME * np.linalg.norm(quat):
            poses[model.body(body).name] = (position, quat)
    return poses


def _same_forces(model: mujoco.MjModel, key: int, other: mujoco.MjModel) -> bool:
    """Whether another model has the forces of this one with its mocap bodies where a keyframe has them."""
    rng, forces = np.random.default_rng(0), []
    move = rng.normal(size=(3, model.nv))
    for candidate in (model, other):
        data = mujoco.MjData(candidate)
        mujoco.mj_resetDataKeyframe(model, data, key)
        for step in move:
            mujoco.mj_integratePos(candidate, data.qpos, step, 0.3)
            mujoco.mj_inverse(candidate, data)
            rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
            parts = data.efc_pos[rows], data.ten_length, data.qfrc_passive, data.mocap_pos.ravel()
            forces.append(np.concatenate(parts))
    pairs = zip(forces[:3], forces[3:], strict=True)
    same = all(len(a) == len(b) and np.allclose(a, b, rtol=1e-6, atol=1e-9) for a, b in pairs)
    return same and not _mocap_poses(other, key)


@unlogged()
def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model of a spec, which has been compiled before: warnings about it were given, or are counted in runs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return spec.compile()


# The text, read and compiled.


def names() -> list[str]:
    """The packaged scenes: the files in models/ that include a robot."""
    return sorted(path.stem for path in MODELS.glob("*.xml") if "<include" in path.read_text(encoding="utf-8"))


def _flatten(path: Path) -> str:
    """The MJCF at `path` as one text: with includes in place, and other files by their full path."""
    seen: set[Path] = set()
    folder = path.parent
    folder_of = dict[ElementTree.Element, Path]()  # elements of included files -> the folder of their file

    def read(file: Path) -> ElementTree.Element:
        seen.add(file.resolve())
        try:
            root = ElementTree.parse(file).getroot()
        except ElementTree.ParseError as error:
            raise InputError(f"scene: got {file.name}, which is not XML ({error}), want an MJCF file") from None
        except OSError as error:
            raise InputError(f"scene: got {file.name}, which cannot be read ({error.strerror}), want a file") from None
        if root.tag == "robot":
            become = "to be included it wants to be an MJCF, load_scene(...).xml"
            raise InputError(f"scene: got {file.name}, which is a URDF, want a name that ends in .urdf; {become}")
        expand(root, file.parent)
        return root

    def expand(element: ElementTree.Element, including: Path) -> None:
        children = list(element)
        element[:] = []
        for child in children:
            if child.tag == "include":
                element.extend(read(find(child.get("file", ""), including)))
            else:
                expand(child, including)
                element.append(child)
                folder_of.setdefault(child, including)

    def find(name: str, including: Path) -> Path:
        # MuJoCo's rule, relative to the main file, then to the file that includes; and then the packaged models.
        file = next((file for file in (folder / name, including / name, MODELS / name) if os.path.isfile(file)), None)
        if file is None:
            packaged = ", ".join(sorted(file.name for file in MODELS.glob("*.xml")))
            raise InputError(f"scene: got an include of {name!r}, want a file beside {path.name} or one of: {packaged}")
        if file.resolve() in seen:
            raise InputError(f"scene: got {name} included twice in {path.name}, want each file once")
        return file

    root = read(path)
    if root.tag != "mujoco":
        raise InputError(f"scene: got {path.name} with <{root.tag}> at its root, want <mujoco>")
    settings, main = {"meshdir": "", "texturedir": ""}, folder.resolve()
    for compiler in root.iterfind("compiler"):  # an assetdir takes precedence over folders that were set before it
        common = compiler.get("assetdir")
        settings = {kind: compiler.get(kind, before if common is None else common) for kind, before in settings.items()}
    folders = {kind: str(main / setting) for kind, setting in settings.items()}
    files = [(element, key) for element in root.iter() for key in element.attrib if key.startswith("file")]
    for element, key in files:  # the same rule, but from the folder of their kind, of which an <attach> has none
        kind, file_folder = {"texture": "texturedir", "model": ""}.get(element.tag, "meshdir"), folder_of[element]
        if kind and file_folder == folder:
            continue
        first, second = (start / element.attrib[key] for start in (main / folders.get(kind, ""), file_folder.resolve()))
        nested = not os.path.isfile(first) and os.path.isfile(second)
        if nested or not kind:
            element.set(key, str(second if nested else first))
    if files:
        root.append(ElementTree.Element("compiler", folders))
    return re.sub(r"\n\s*\n+", "\n", ElementTree.tostring(root, encoding="unicode")) + "\n"


def model_from_xml(xml: str, what: str) -> mujoco.MjModel:
    """The model of an MJCF given as text, without includes; `what` is its name in messages."""
    _check_elements(xml, what)
    try:
        with unlogged():
            model = spec_of(xml).compile() if "<attach" in xml else mujoco.MjModel.from_xml_string(xml)
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
        raise InputError(f"{what}: got an MJCF that MuJoCo refuses: {' '.join(str(error).split())}") from None
    _check_numbers(model, what)
    return model


def spec_of(xml: str) -> mujoco.MjSpec:
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
        names = unnamed_names(kind, {element.name for element in elements})
        for element in elements:
            element.name = element.name or next(names)
    return spec


def unnamed_names(kind: str, used_names: Container[str | None]) -> Iterator[str]:
    """The names of elements of a kind that have none in the MJCF."""
    return (name for count in itertools.count() if (name := f"{UNNAMED}{kind}_{count}") not in used_names)


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
        total = 0
        events: Any = reader.read_events()
        for event, element in events:
            depth += 1 if event == "start" else -1
            if depth > DEEPEST:
                raise InputError(f"{what}: got elements nested deeper than {DEEPEST}, want less nesting")
            if element.tag in _COPIERS:
                copies = [*copies, copies[-1] * _product(element.get("count", ""))] if event == "start" else copies[:-1]
            if event == "start" and element.tag in ("geom", "body", "site", "light", "camera", *_COPIERS):
                total += copies[-1]
                if total > MOST_COPIES:
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
    attributes = element.attrib
    most = MOST.get(element.tag, {})
    for key, text in attributes.items() if most else ():
        largest = MOST_USER if key.startswith("nuser_") else most.get(key)
        if largest is not None and _size(text) > largest:
            raise InputError(f"{what}: got {key}={excerpt(text)} in <{element.tag}>, want {largest:,} at most")
    if element.tag == "texture" and "builtin" in attributes:
        width, height = _size(attributes.get("width", "0")), _size(attributes.get("height", "0"))
        if max(width * height, 6 * width**2 if attributes.get("type", "cube") == "cube" else 0) > MOST_PIXELS:
            got = f"{excerpt(attributes.get('width'))} x {excerpt(attributes.get('height'))} pixels in <texture>"
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
