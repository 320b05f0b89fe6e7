"""Joints, actuators and keyframes of an MJCF, for a robot's states and controls."""

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_name
from lqrsim.scenes.scene import unlogged

_KINDS = {
    mujoco.mjtJoint.mjJNT_FREE: "free", mujoco.mjtJoint.mjJNT_BALL: "ball", mujoco.mjtJoint.mjJNT_SLIDE: "slide",
    mujoco.mjtJoint.mjJNT_HINGE: "hinge",
}  # fmt: skip

_SIZES = {"free": (7, 6), "ball": (4, 3), "slide": (1, 1), "hinge": (1, 1)}
_OF_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


FAR_PAST = 0.1  # fraction of a joint's range; springs of limits give way by less


@dataclass(frozen=True)
class Joint:
    """A joint.

    Attributes:
      name: name of the joint. kind: free, ball, slide or hinge.
      qpos, dof: its indices in qpos and in qvel. limits: limits of a slide or hinge, in m or rad, or None.
    """

    name: str
    kind: str
    qpos: slice
    dofs: slice
    limits: tuple[float, float] | None

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


_MET, _NEWTON = 1e-10, 30  # m or rad by which an equality may be off, and steps to it at most
_TYPED = 1e-6  # m or rad by which it may be off if all its joints are given, as by rounding
_RANK = 1e-9  # relative size of singular values that count as zero
_STRIDE = 0.05  # m or rad, of joints that others follow
_SAME = 1e-12  # m, and of quaternions, within which a mocap body is where a keyframe has it
UNNAMED = "unnamed_"  # prefix of the names of bodies, joints, geoms and actuators without a name in the MJCF


def named(xml: str) -> str:
    """An MJCF in which every body, joint, geom and actuator has a name: `unnamed_<kind>_<number>`, counted from 0.

    Of several free joints without a name, each gets its body's.
    """
    root = ElementTree.fromstring(xml)
    taken = {element.get("name") for element in root.iter()}
    joints = {element.get("name") for tag in ("joint", "freejoint") for element in root.iter(tag)}
    free = [(body.get("name"), one) for body in root.iter("body") for one in body if _is_free(one)]
    for body, joint in free if len(free) > 1 else ():
        if body is not None and body not in joints:
            joint.set("name", body)
            joints.add(body)

    def name(elements: Iterable[ElementTree.Element], kind: str) -> None:
        count = 0
        for element in elements:
            if element.get("name") is None:
                while f"{UNNAMED}{kind}_{count}" in taken:
                    count += 1
                element.set("name", f"{UNNAMED}{kind}_{count}")
                count += 1

    # An MJCF has its own section worldbody, and one from each file that it includes.
    there = [one for world in root.iter("worldbody") for one in world.iter()]
    for kind, tags in (("body", ("body",)), ("joint", ("joint", "freejoint")), ("geom", ("geom",))):
        name((one for one in there if one.tag in tags), kind)
    name([one for section in root.iter("actuator") for one in section], "actuator")
    return ElementTree.tostring(root, encoding="unicode")


def _is_free(element: ElementTree.Element) -> bool:
    """Whether it is a free joint without a name."""
    free = element.tag == "freejoint" or (element.tag == "joint" and element.get("type") == "free")
    return free and element.get("name") is None


def check_attached(xml: str, model: mujoco.MjModel, what: str) -> None:
    """Raises InputError if a model that the MJCF attaches has elements without a name, which its text cannot name."""
    if "<attach" not in xml:
        return
    for kind, count in (
        ("body", model.nbody),
        ("joint", model.njnt),
        ("geom", model.ngeom),
        ("actuator", model.nactuator),
    ):
        for number in range(count):
            if not getattr(model, kind)(number).name:
                raise InputError(
                    f"{what}: got an attached model whose {kind} {number}, counted from 0, has no name, want names of"
                    " its bodies, joints, geoms and actuators in its own file"
                )


def lit(xml: str, model: mujoco.MjModel) -> str:
    """An MJCF with a light named overview added if it has none.

    Args:
      xml: the MJCF. model: the model compiled from it, for its overall size.
    """
    if model.nlight or "</mujoco>" not in xml:
        return xml
    middle, size = model.stat.center, float(model.stat.extent)
    added = ElementTree.Element("worldbody")
    place = " ".join(f"{number:.6g}" for number in middle + size * np.array([-1.0, -1.0, 3.0]))
    light = {"name": "overview", "pos": place, "dir": "0.3 0.3 -1", "directional": "true", "diffuse": ".5 .5 .5"}
    ElementTree.SubElement(added, "light", light)
    end = xml.rindex("</mujoco>")  # the text comes from ElementTree, and can be long
    return f"{xml[:end]}{ElementTree.tostring(added, encoding='unicode')}{xml[end:]}"


def joints_of(model: mujoco.MjModel) -> tuple[Joint, ...]:
    """All joints, in the order of their degrees of freedom."""
    found = []
    for number in range(model.njnt):
        kind = _KINDS[mujoco.mjtJoint(model.jnt_type[number])]
        firsts = int(model.jnt_qposadr[number]), int(model.jnt_dofadr[number])
        qpos, dofs = (slice(first, first + size) for first, size in zip(firsts, _SIZES[kind], strict=True))
        low, high = model.jnt_range[number].tolist()
        limits = (low, high) if model.jnt_limited[number] and kind in ("slide", "hinge") else None
        name = model.joint(number).name or f"generated_joint_{number}"  # such as those of a flexcomp
        found.append(Joint(name, kind, qpos, dofs, limits))
    return tuple(found)


def input_names(model: mujoco.MjModel, actuator: int) -> list[str]:
    """MuJoCo's names of an actuator's controls, such as pos and vel; empty for one that is just a command."""
    count = int(model.actuator_ctrlnum[actuator])
    return [mujoco.mj_actuatorInputName(model, actuator, i) or "" for i in range(count)]


def controls_of(model: mujoco.MjModel) -> tuple[Control, ...]:
    """All controls, in MuJoCo's order: named as their actuator, `<actuator>_<input>` if it has several, or none."""
    low, high = (side.tolist() for side in control_ranges(model))
    found = list[Control]()
    for number in range(model.nactuator):
        inputs, name = input_names(model, number), model.actuator(number).name
        for one in inputs:
            full, k = f"{name}_{one}" if len(inputs) > 1 else name, len(found)
            found.append(Control(full, _unit(model, number, one), low[k], high[k]))
    return tuple(found)


def ranges(limited: npt.NDArray[np.bool_], sides: Array) -> tuple[Array, Array]:
    """The least and the largest numbers (k,) of ranges (k, 2), infinite where there is no limit."""
    low, high = np.where(limited, sides.T, [[-np.inf], [np.inf]])
    return low, high


def control_ranges(model: mujoco.MjModel) -> tuple[Array, Array]:
    """The least and the largest of each control, (nu,). To a muscle MuJoCo passes on only what is in 0..1."""
    muscle = np.repeat(model.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE.value, model.actuator_ctrlnum)
    low, high = ranges(model.actuator_ctrllimited.astype(bool), model.actuator_ctrlrange)
    return np.where(muscle, np.clip(low, 0, 1), low), np.where(muscle, np.clip(high, 0, 1), high)


def activations_of(model: mujoco.MjModel) -> tuple[str, ...]:
    """The names of the states of actuators, (na,): `<actuator>_activation`, numbered if an actuator has several."""
    names = [""] * model.na
    for number in range(model.nactuator):
        first, count = int(model.actuator_actadr[number]), int(model.actuator_actnum[number])
        for i in range(count if first >= 0 else 0):
            names[first + i] = f"{model.actuator(number).name}_activation" + (f"_{i}" if count > 1 else "")
    return tuple(names)


def _unit(model: mujoco.MjModel, number: int, what: str) -> str:
    """The unit of an actuator's input, for plain motors and servos of joints; empty for others, which have none."""
    joint = int(model.actuator_trnid[number, 0])
    gear = model.actuator_gear[model.actuator_outadr[number]]
    gain, bias = model.actuator_gainprm[number], model.actuator_biasprm[number]
    if mujoco.mjtTrn(model.actuator_trntype[number]) not in _OF_JOINTS or gear[0] != 1:
        return ""
    kind = _KINDS[mujoco.mjtJoint(model.jnt_type[joint])]
    if kind not in ("slide", "hinge"):
        return ""
    force, length = ("N", "m") if kind == "slide" else ("N m", "rad")
    units = {"pos": length, "vel": f"{length}/s", "ff": force, "voltage": "V", "pressure": ""}
    if what or mujoco.mjtGain(model.actuator_gaintype[number]) != mujoco.mjtGain.mjGAIN_FIXED:
        return units.get(what, "")
    plain = mujoco.mjtDyn(model.actuator_dyntype[number]) == mujoco.mjtDyn.mjDYN_NONE
    if mujoco.mjtBias(model.actuator_biastype[number]) == mujoco.mjtBias.mjBIAS_NONE:
        return force if gain[0] == 1 and plain else ""
    if gain[0] == -bias[1] and bias[0] == 0:
        return length
    return f"{length}/s" if bias[1] == 0 and gain[0] == -bias[2] else ""


def placed(model: mujoco.MjModel, qpos: Array | None = None) -> mujoco.MjData:
    """MuJoCo's data with the places of all bodies at positions (nq,), by default at rest."""
    return next(posed(model, [model.qpos0 if qpos is None else qpos]))


def posed(model: mujoco.MjModel, positions: Iterable[Array]) -> Iterator[mujoco.MjData]:
    """MuJoCo's data with the places of all bodies at each of these positions (nq,): one object, which changes."""
    data = mujoco.MjData(model)
    for qpos in positions:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        yield data


@unlogged()
def contacts_of(model: mujoco.MjModel, qpos: Array) -> list[tuple[str, str]]:
    """The names of the bodies that touch, each pair once."""
    data = placed(model, qpos)
    mujoco.mj_collision(model, data)
    bodies = model.geom_bodyid[data.contact.geom] if data.ncon else np.zeros((0, 2), dtype=np.intp)
    return [
        (model.body(first).name, model.body(second).name)
        for first, second in dict.fromkeys(map(tuple, bodies.tolist()))
    ]


def leaders_of(model: mujoco.MjModel) -> npt.NDArray[np.bool_]:
    """Which degrees of freedom (nv,) are those of joints that others follow by an equality, and that follow none."""
    joints = np.flatnonzero(model.eq_active0 & (model.eq_type == mujoco.mjtEq.mjEQ_JOINT.value))
    leads, follows = np.zeros(model.nv, dtype=bool), np.zeros(model.nv, dtype=bool)
    follows[model.jnt_dofadr[model.eq_obj1id[joints]]] = True
    others = model.eq_obj2id[joints]
    leads[model.jnt_dofadr[others[others >= 0]]] = True
    return leads & ~follows


class Equalities:
    """All active equality constraints of a model, at given positions.

    Args:
      model: with at least one.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = copy.copy(model)
        self.model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
        self._data = mujoco.MjData(self.model)

    @unlogged()
    def at(self, qpos: Array) -> tuple[Array, Array]:
        """How far they are off at positions (nq,), (k,) in m or rad, and the derivatives by the velocities, (k, nv)."""
        data = self._data
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(self.model, data)
        rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        return data.efc_pos[rows].copy(), data.efc_J.reshape(-1, self.model.nv)[rows].copy()

    def met(self, qpos: Array, aim: Array, fixed: npt.NDArray[np.bool_]) -> Array | None:
        """Positions (nq,) at which they are met, as little away from those given as may be; None if none was found.

        Args:
          qpos: to begin with. aim: where the fixed degrees of freedom, (nv,), go. The others follow them in small
            steps, so that a loop does not flip over.
        """
        place, move, model = qpos.copy(), np.zeros(self.model.nv), self.model
        mujoco.mj_differentiatePos(model, move, 1.0, qpos, aim)
        move[~fixed] = 0.0
        steps = max(1, int(np.ceil(np.abs(move).max(initial=0.0) / _STRIDE)))
        off = np.zeros(0)
        for _ in range(steps):
            mujoco.mj_integratePos(model, place, move / steps, 1.0)
            for _ in range(_NEWTON):
                off, slopes = self.at(place)
                within_reach = slopes[:, ~fixed].any(axis=1)  # others need to be met at the aim only
                if np.abs(off[within_reach]).max(initial=0.0) < _MET:
                    break
                step = np.zeros(model.nv)
                step[~fixed] = -np.linalg.lstsq(slopes[:, ~fixed], off, rcond=_RANK)[0]
                mujoco.mj_integratePos(model, place, step, 1.0)
                if np.abs(step).max() < _MET:  # as near as it gets on the way: only the aim is to be consistent
                    break
            else:
                return None
        return place if np.abs(off).max(initial=0.0) < _TYPED else None

    def closed(self, qpos: Array, qvel: Array) -> tuple[Array, Array] | None:
        """Positions (nq,) and velocities (nv,) near those given at which they are met; None if none were found."""
        place = self.met(qpos, qpos, np.zeros(self.model.nv, dtype=bool))
        if place is None:
            return None
        _, slopes = self.at(place)
        return place, qvel - np.linalg.lstsq(slopes, slopes @ qvel, rcond=_RANK)[0]


def body_of(model: mujoco.MjModel, name: str | None, what: str) -> int:
    """The id of the body of that name; without a name, of the first moving body with mass. Raises InputError."""
    if name is not None:
        names = [model.body(number).name for number in range(1, model.nbody)]
        return int(model.body(check_name(f"{what}: body", name, names)).id)
    moving = [number for number in range(1, model.nbody) if model.body_jntnum[number] > 0]
    if not moving:
        raise InputError(f"{what}: got no joints, want a robot that moves: at least one <joint> or <freejoint/>")
    # Several bodies may each carry a slide before there is any mass. The robot is the first body with mass, its own or
    # the mass of bodies fixed to it.
    masses = np.bincount(model.body_weldid, weights=model.body_mass, minlength=model.nbody)
    return next((number for number in moving if masses[number] > 0), moving[0])


def keyframe(model: mujoco.MjModel, xml: str, name: str, what: str) -> tuple[Array, Array, Array | None]:
    """qpos, qvel and act of a keyframe; act is None if the MJCF does not state it, for which the model has zeros.

    Raises:
      InputError: there is no keyframe of that name, or mocap bodies are elsewhere in it.
    """
    number = _key(model, name, f"{what}: keyframe")
    moved = [model.body(body).name for body in _moved(model, number)]
    if moved:
        raise InputError(
            f"{what}: keyframe: got {name!r}, in which the mocap bodies {', '.join(moved)} are elsewhere, want"
            f" MjcfRobot(..., mocap={name!r}), which has them there"
        )
    stated = model.na > 0 and len(mujoco.MjSpec.from_string(xml).keys[number].act) > 0
    act = model.key_act[number].copy() if stated else None
    return model.key_qpos[number].copy(), model.key_qvel[number].copy(), act


def with_mocap(xml: str, model: mujoco.MjModel, name: str, what: str) -> str:
    """The MJCF with its mocap bodies where a keyframe has them, and all else as it is.

    What MuJoCo compiles from where bodies are at rest is stated as it was: what ties two bodies.

    Raises:
      InputError: there is no keyframe of that name; or the text cannot say this, as of a body in a <frame>.
    """
    number = _key(model, name, f"{what}: keyframe")
    if not (moved := _moved(model, number)):
        return xml
    root = ElementTree.fromstring(xml)
    elements = {one.get("name", ""): one for world in root.iter("worldbody") for one in world.iter("body")}
    for body in moved:
        element, where = elements[model.body(body).name], int(model.body_mocapid[body])
        for other in ("axisangle", "xyaxes", "zaxis", "euler"):
            element.attrib.pop(other, None)
        for attribute, values in (("pos", model.key_mpos), ("quat", model.key_mquat)):
            element.set(attribute, _text(values[number].reshape(model.nmocap, -1)[where]))
    elements["world"] = next(root.iter("worldbody"))
    ties = [one for section in root.findall("equality") for one in section]
    for i, (tie, values) in enumerate(zip(ties, model.eq_data, strict=False)):
        if tie.tag == "weld" and "body1" in tie.attrib:
            tie.set("relpose", _text(values[3:10]))
        elif tie.tag == "connect" and "body1" in tie.attrib:
            del tie.attrib["anchor"]
            for side, place in enumerate((values[:3], values[3:6]), 1):
                site = f"{name}_tie_{i}_{side}"
                ElementTree.SubElement(
                    elements[tie.attrib.pop(f"body{side}", "world")],
                    "site",
                    {"name": site, "pos": _text(place), "group": "5"},
                )
                tie.set(f"site{side}", site)
    found = ElementTree.tostring(root, encoding="unicode")
    if not _same_forces(model, number, mujoco.MjModel.from_xml_string(found)):
        raise InputError(
            f"{what}: mocap: got the keyframe {name!r}, whose mocap bodies cannot be placed by rewriting the MJCF, want"
            " them directly in the <worldbody>, and springs of tendons at them with a springlength"
        )
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
    return not _moved(other, key) and all(
        len(a) == len(b) and np.allclose(a, b, rtol=1e-6, atol=1e-9) for a, b in pairs
    )


def _text(numbers: Array) -> str:
    return " ".join(map(repr, numbers.tolist()))


def _key(model: mujoco.MjModel, name: str, field: str) -> int:
    names = [model.key(number).name for number in range(model.nkey)]
    return names.index(check_name(field, name, names))


def _moved(model: mujoco.MjModel, key: int) -> list[int]:
    """The mocap bodies that are elsewhere in a keyframe than in the MJCF."""
    found = []
    for body in np.flatnonzero(model.body_mocapid >= 0).tolist():
        where = int(model.body_mocapid[body])
        quat = model.key_mquat[key].reshape(model.nmocap, 4)[where]
        near = np.abs(model.key_mpos[key].reshape(model.nmocap, 3)[where] - model.body_pos[body]).max() < _SAME
        if not near or 1 - abs(float(quat @ model.body_quat[body])) > _SAME * np.linalg.norm(quat):
            found.append(body)
    return found


@dataclass(frozen=True)
class Axes:
    """Which degrees of freedom alone move a body's origin along the axes of the world (0 to 2).

    Attributes:
      of: degree of freedom -> axis, where its position is the origin's coordinate.
      shifted: degree of freedom -> its axis and the origin's coordinate at its zero, where that is another one.
      moving: whether anything moves the origin along each axis, (3,).
    """

    of: dict[int, int]
    shifted: dict[int, tuple[int, float]]
    moving: tuple[bool, ...]


def position_of(model: mujoco.MjModel, body: int) -> Axes:
    """How joints move a body's origin, found by moving them: it must hold for any positions of the other joints."""
    data, rng, joints = mujoco.MjData(model), np.random.default_rng(0), joints_of(model)
    candidates = {
        one.dof + i: one.qpos.start + i for one in joints if one.kind in ("free", "slide")
        for i in range(3 if one.kind == "free" else 1)
    }  # fmt: skip
    origins, positions = np.zeros((5, 3)), np.zeros((5, model.nq))
    for trial in range(5):
        data.qpos[:] = model.qpos0 + rng.normal(size=model.nq)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        origins[trial], positions[trial] = data.xpos[body], data.qpos
    exact, shifted = dict[int, int](), dict[int, tuple[int, float]]()
    for dof, number in candidates.items():
        for axis in range(3):
            away = origins[:, axis] - positions[:, number]
            if np.abs(away).max() < 1e-9:
                exact[dof] = axis
            elif np.ptp(away) < 1e-9:
                shifted[dof] = (axis, float(away.mean()))
    return Axes(exact, shifted, tuple(bool(moved) for moved in np.ptp(origins, axis=0) > 1e-9))


def places_on(model: mujoco.MjModel, qpos: Array, bodies: Array, offsets: Array) -> Array:
    """World positions of points (K, 3) in the axes of bodies (K,), at MuJoCo's positions (nq,)."""
    data = placed(model, qpos)
    return data.xpos[bodies] + np.einsum("kij,kj->ki", data.xmat[bodies].reshape(-1, 3, 3), offsets)


def in_axes_of_bodies(model: mujoco.MjModel, geoms: npt.NDArray[np.int64], vectors: Array) -> Array:
    """Vectors (..., k, 3) along the world's axes, each in the axes of the body of its geom (k,), at rest."""
    axes = placed(model).xmat[model.geom_bodyid[geoms]].reshape(-1, 3, 3)
    # By elements, so that the bits of one do not depend on how many others there are.
    x, y, z = (vectors[..., i, None] * axes[:, i] for i in range(3))
    return x + y + z


def site_frame(model: mujoco.MjModel, site: int) -> tuple[int, Array, Array]:
    """The body of a site, and the site's position (3,) and axes (3, 3) in the body's axes."""
    return int(model.site_bodyid[site]), model.site_pos[site].copy(), axes_of(model.site_quat[site])


def axes_of(quaternion: Array) -> Array:
    """The rotation matrix (3, 3) of a quaternion (4,) of length 1."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)


def farthest_out(model: mujoco.MjModel, body: int) -> tuple[int, Array, float]:
    """The geom in a body's tree that is farthest from the body's origin at rest; the body itself if there is no geom.

    Returns:
      The number of the geom's body, its position (3,) there, and the radius of its bounding ball in metres.
    """
    data = placed(model)
    moves = (model.body_rootid[model.geom_bodyid] == model.body_rootid[body]) & (model.geom_rbound > 0)
    own = np.flatnonzero(moves & (model.body_weldid[model.geom_bodyid] != 0))
    if not len(own):
        return body, np.zeros(3), 0.0
    geom = int(own[np.argmax(np.linalg.norm(data.geom_xpos[own] - data.xpos[body], axis=1))])
    return int(model.geom_bodyid[geom]), model.geom_pos[geom].copy(), float(model.geom_rbound[geom])


def reach_of(model: mujoco.MjModel, body: int) -> float:
    """The largest distance of the colliding geoms of a body, or of bodies that it carries, from its origin, in metres.

    If no geom collides, the visual geoms count instead.
    """
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    collides &= model.body_rootid[model.geom_bodyid] == model.body_rootid[body]
    reach = 0.0
    for geom in np.flatnonzero(collides).tolist() if collides.any() else range(model.ngeom):
        if (path := path_to(model, geom, body)) is not None:
            offsets = [model.geom_pos[geom], *(model.body_pos[one] for one in path)]
            reach = max(reach, float(model.geom_rbound[geom] + sum(np.linalg.norm(one) for one in offsets)))
    return reach


def path_to(model: mujoco.MjModel, geom: int, body: int) -> list[int] | None:
    """The bodies from a geom's own up to `body`, without it; None if that one does not carry the geom."""
    path = [int(model.geom_bodyid[geom])]
    while path[-1] not in (0, body):
        path.append(int(model.body_parentid[path[-1]]))
    return path[:-1] if path[-1] == body else None
