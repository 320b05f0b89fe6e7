"""A URDF as an MJCF: MuJoCo reads it, and what a URDF does not say is decided here.

A URDF has no actuators and does not say whether its base floats; its meshes are in ROS packages; its fixed links may
have inertias that MuJoCo refuses. What MuJoCo has read is written here, because its own writer has six digits.
"""

import itertools
import logging
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal
from xml.parsers import expat

import numpy as np
import numpy.typing as npt

from lqrsim.errors import (
    Array,
    InputError,
    check_items,
    check_kind,
    check_name,
    check_number,
    check_path,
    excerpt,
    listed,
)
from lqrsim.scenes.mjcf_kinematics import axes_of, contacts_of, quaternion_of
from lqrsim.scenes.mujoco_log import mujoco, unlogged

Base = Literal["fixed", "free"]
Servo = Sequence[float]  # stiffness and damping
Servos = Servo | Mapping[str, Servo]

SUFFIX = ".urdf"
DEEPEST = 490  # largest depth of elements; MuJoCo's reader refuses slightly more
SPEED_LIMIT = "_velocity_limit"  # <numeric name="JOINT_velocity_limit"> is the joint's largest speed in rad/s or m/s
_COUPLED = {"revolute", "continuous", "prismatic"}  # types of joints with one coordinate
_SIZES = {"box": 3, "cylinder": 2, "capsule": 2, "sphere": 1, "mesh": 0}  # how many numbers the size of a geom has
_MESHES = (".stl", ".obj", ".msh")  # files that MuJoCo reads
_HIDDEN = 3  # group of the collision geoms of links that have visual ones; pictures show groups below
_PATHS = ("meshdir", "texturedir", "assetdir", "strippath")  # settings about paths, which are resolved here
_LISTED = 6  # largest number of names in a line
_log = logging.getLogger("lqrsim")


def read_urdf(
    file: str | os.PathLike[str],
    *,
    base: Base = "fixed",
    servos: Servos | None = None,
    efforts: Mapping[str, float] | None = None,
    armature: float | Mapping[str, float] | None = None,
) -> tuple[str, str]:
    """The name of a URDF, and the MJCF that it becomes. Arguments and errors are those of `load_scene`."""
    path = check_path("URDF", file, f"the path of a {SUFFIX} file")
    root = _parsed(path)
    check_name(f"{path.name}: base", base, ("fixed", "free"))
    settings = root.findall("mujoco/*")  # MuJoCo's extension: elements of an MJCF
    compiler = dict[str, str]()
    for setting in root.findall("mujoco/compiler"):
        compiler |= setting.attrib
    _find_meshes(root, path, compiler)
    spec = _read(root, path.name, {key: value for key, value in compiler.items() if key not in _PATHS})
    _set_armature(spec, path.name, {} if armature is None else armature)
    if base == "free":
        _free_base(spec, path.name)
    mjcf = ElementTree.Element("mujoco", {"model": spec.modelname})
    _add(mjcf, "option", {"integrator": "implicitfast"})  # which is stable for damping, also that of servos
    for setting in settings:
        setting.attrib = {key: value for key, value in setting.attrib.items() if key not in _PATHS}
        mjcf.append(setting)
    _add(mjcf, "compiler", {"angle": "radian"})
    with np.errstate(all="ignore"):  # masses that are not finite are refused where the model is used
        _add_parts(mjcf, spec)
    _check_joints(root, spec, path.name)
    _add_actuators(mjcf, spec, path.name, servos, efforts)
    _add_speed_limits(mjcf, root, path.name)
    with unlogged():
        model, refusal = _compiled(mjcf)
        if refusal:
            _remove_refused_shapes(mjcf, path.name)
            model, _ = _compiled(mjcf)
        if model is not None:  # else what is wrong is said where the model is used
            _exclude_overlaps(mjcf, model, path.name)
    return path.stem, _text(mjcf)


def is_urdf(path: object) -> bool:
    """Whether it is the path of a URDF."""
    try:
        return check_path("URDF", path).suffix.lower() == SUFFIX
    except InputError:
        return False


def _parsed(path: Path) -> ElementTree.Element:
    """The root of the file. Raises InputError if it is no URDF, or MuJoCo's reader would crash."""
    if not is_urdf(path):
        raise InputError(f"URDF: got {excerpt(os.fspath(path))}, want the path of a {SUFFIX} file")
    if not os.path.isfile(path):
        raise InputError(f"URDF: got {excerpt(os.fspath(path))}, want a file that exists")
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    # Without namespaces, as MuJoCo and ROS: prefixes such as `drake:` are often not declared.
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    try:
        parser.Parse(path.read_bytes(), True)
        root = builder.close()
    except expat.ExpatError as error:
        raise InputError(f"URDF: got {path.name}, which is not XML ({error}), want a URDF") from None
    except (OSError, ValueError) as error:
        raise InputError(f"URDF: got {excerpt(os.fspath(path))}, want a file that can be read ({error})") from None
    if root.tag != "robot":
        raise InputError(f"URDF: got {path.name} with <{root.tag}> at its root, want <robot>")
    if any(element.tag.startswith("xacro:") for element in root.iter()):
        raise InputError(f"URDF: got {path.name} with macros, want what `xacro {path.name}` prints")
    if (links := len(root.findall("link"))) > DEEPEST:
        raise InputError(f"URDF: got {path.name} with {links:,} links, want {DEEPEST} at most")
    return root


def _find_meshes(root: ElementTree.Element, path: Path, settings: Mapping[str, str]) -> None:
    """Write the full paths of meshes, and take out the geometries of which MuJoCo has no file, with a warning."""
    omitted = dict[str, list[str]]()
    for link, kind in itertools.product(root.iterfind("link"), ("visual", "collision")):
        for geometry in link.findall(kind):
            geometry.attrib.pop("name", None)  # they get names later, as most have none, and some the same one
            if (mesh := geometry.find("geometry/mesh")) is not None:
                name = mesh.get("filename", "")
                files = list[Path]()
                for place in _places(name, path.parent.resolve(), settings):
                    is_read = place.suffix.lower() in _MESHES
                    files += [place] if is_read else [place.with_suffix(kind) for kind in _MESHES if place.name]
                mesh_file = next((str(candidate) for candidate in files if os.path.isfile(candidate)), None)
                mesh.set("filename", mesh_file or "")
                if mesh_file is None:
                    link.remove(geometry)
                    omitted.setdefault(kind, []).append(name)
    for kind, names in omitted.items():
        _log.warning(
            "%s: %d %s meshes are left out, such as %s: want .stl, .obj or .msh files, there or of the same name beside"
            " it; ROS_PACKAGE_PATH may name the folders of packages", path.name, len(names), kind, names[0],
        )  # fmt: skip


def _places(name: str, folder: Path, settings: Mapping[str, str]) -> Iterator[Path]:
    """Where a mesh may be. A package is in a folder of its name, above the URDF or in a path of ROS."""
    scheme, separator, location = name.rpartition("://")
    if not separator or scheme == "file":
        stripped = Path(location).name if settings.get("strippath") == "true" else location
        yield folder / settings.get("meshdir", settings.get("assetdir", "")) / stripped
        return
    for parent in (folder, *folder.parents):
        yield parent / location.lstrip("/")
    package, _, inside = location.lstrip("/").partition("/")
    for entry in filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)):
        yield Path(entry) / package / inside
        if Path(entry).name == package:
            yield Path(entry) / inside
    for entry in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(entry) / "share" / package / inside


def _read(root: ElementTree.Element, name: str, compiler: Mapping[str, str]) -> mujoco.MjSpec:
    """What MuJoCo reads, with all links and with all their geoms, each of which has a name."""
    for extension in root.findall("mujoco"):
        root.remove(extension)
    _add(_add(root, "mujoco"), "compiler", {**compiler, "fusestatic": "false", "discardvisual": "false"})
    try:
        with unlogged():
            spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
            _ = [body.joints for body in spec.bodies]  # MuJoCo says here whether two have the same name
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(f"URDF: got {name}, which MuJoCo refuses: {' '.join(str(error).split())}") from None
    used_names = {geom.name for geom in spec.geoms}
    dense = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for geom in spec.geoms:
        geom.density = geom.density if dense else 0.0  # a link without <inertial> has no mass
        if not geom.name:
            first = f"{geom.parent.name}_{'collision' if geom.contype else 'visual'}"
            names = itertools.chain([first], (f"{first}_{number}" for number in itertools.count(1)))
            geom.name = next(candidate for candidate in names if candidate not in used_names)
            used_names.add(geom.name)
    return spec


def _free_base(spec: mujoco.MjSpec, name: str) -> None:
    """Let the root link float. Raises InputError if there are several, or it moves by a joint of its own."""
    roots = spec.worldbody.bodies
    if len(roots) != 1 or roots[0].joints:
        got = f"'free', with {listed([link.name or '' for link in roots], _LISTED)} at the root"
        raise InputError(f"{name}: base: got {got}, want one link there, without a joint")
    roots[0].add_freejoint()


def _add_parts(mjcf: ElementTree.Element, spec: mujoco.MjSpec) -> None:
    """Add all meshes, bodies with their joints and geoms, and what couples joints."""
    assets = _add(mjcf, "asset")
    for mesh in spec.meshes:
        # Meshes have no mass here, and a flat one has no volume.
        _add(assets, "mesh", {"name": mesh.name, "file": mesh.file, "inertia": "shell"}, scale=mesh.scale)
    dense = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    world = _add(mjcf, "worldbody")
    _add_body(world, spec.worldbody, dense=dense, fixed=(world, np.eye(4)))
    ties = _add(mjcf, "equality")
    for equality in spec.equalities:
        _add(ties, "joint", {"joint1": equality.name1, "joint2": equality.name2}, polycoef=equality.data[:5])


def _check_joints(root: ElementTree.Element, spec: mujoco.MjSpec, name: str) -> None:
    """Raise InputError for limits in the wrong order, and warn of limits and couplings that MuJoCo does not take."""
    for joint in spec.joints:
        if joint.range[0] > joint.range[1]:
            got = f"got limits from {joint.range[0]:g} to {joint.range[1]:g} for {joint.name}"
            raise InputError(f"{name}: {got}, want lower below upper")
    coupled = {equality.name1 for equality in spec.equalities}
    followers = [element.get("name", "") for element in root.iterfind("joint[mimic]")]
    if loose := [follower for follower in followers if follower not in coupled]:
        _log.warning(
            "%s: no joint is followed by %s: want a <mimic> of one that turns or slides", name, listed(loose, _LISTED)
        )
    kinds = "revolute", "prismatic"
    bounded = {element.get("name") for element in root.iterfind("joint") if element.get("type") in kinds}
    if unlimited := [joint.name or "" for joint in spec.joints if joint.name in bounded and not _is_limited(joint)]:
        _log.warning("%s: no limits for %s: want a lower and an upper that differ", name, listed(unlimited, _LISTED))


def _add_body(
    element: ElementTree.Element,
    body: mujoco.MjsBody,
    *,
    dense: bool,
    fixed: tuple[ElementTree.Element, Array] | None,
) -> None:
    """Add what a body has: its inertia, with those of the bodies fixed to it, if it moves; joints, geoms and bodies.

    If geoms are `dense`, they take precedence over inertias, link by link, and each body has its own. `fixed` is the
    <worldbody> and the body's frame in it (4, 4), if it does not move: bodies that float go there, as MuJoCo wants it.
    """
    if body.joints or dense:
        moments = _moments(body, carrying=not dense)
        if (mass := moments[3, 3]) != 0:
            centre = moments[:3, 3] / mass
            second = moments[:3, :3] - mass * np.outer(centre, centre)
            inertia = np.trace(second) * np.eye(3) - second
            full = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            _add(element, "inertial", pos=centre, mass=mass, fullinertia=full)
    for joint in body.joints:
        if (kind := _kind(joint)) == "free":
            _add(element, "freejoint", {"name": joint.name} if joint.name else {})
            continue
        numbers = {"damping": joint.damping, "frictionloss": joint.frictionloss, "armature": joint.armature}
        numbers |= {"axis": joint.axis} if kind != "ball" else {}
        numbers |= {"range": joint.range} if _is_limited(joint) else {}
        _add(element, "joint", {"name": joint.name, "type": kind}, **numbers)
    drawn = any(not geom.contype for geom in body.geoms)
    for geom in body.geoms:
        collides, kind = bool(geom.contype), _kind(geom)
        attributes = {"name": geom.name, "type": kind, "group": str(_HIDDEN if collides and drawn else geom.group)}
        attributes |= {"mesh": geom.meshname} if geom.meshname else {}
        attributes |= {} if collides else {"contype": "0", "conaffinity": "0"}
        numbers = {"size": geom.size[: _SIZES[kind]]} if _SIZES[kind] else {}
        _add(element, "geom", attributes, **numbers, pos=geom.pos, quat=geom.quat, rgba=geom.rgba, density=geom.density)
    for child in body.bodies:
        parent, pos, quat, own = element, child.pos, child.quat, None
        if fixed is not None:
            own = fixed[0], fixed[1] @ _frame(pos, quat)
            if body.name != "world" and any(_kind(joint) == "free" for joint in child.joints):
                parent, pos, quat = own[0], own[1][:3, 3], quaternion_of(own[1][:3, :3])
        added = _add(parent, "body", {"name": child.name}, pos=pos, quat=quat)
        _add_body(added, child, dense=dense, fixed=None if child.joints else own)


def _moments(body: mujoco.MjsBody, *, carrying: bool = True) -> Array:
    """The second and first moments of mass and the mass, (4, 4), of a body in its frame, with the bodies fixed to it.

    A URDF may give fixed links inertias that no body can have, as sensors do; only the sum matters.
    """
    moments = np.zeros((4, 4))
    if body.explicitinertial:
        entries = body.fullinertia if np.any(body.fullinertia[1:]) else np.zeros(6)  # MuJoCo marks zeros by a NaN
        xx, yy, zz, xy, xz, yz = entries
        inertia, frame = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), _frame(body.ipos, body.iquat)
        moments[:3, :3], moments[3, 3] = np.trace(inertia) / 2 * np.eye(3) - inertia, body.mass
        moments = frame @ moments @ frame.T
    for child in body.bodies if carrying else ():
        if not child.joints:
            frame = _frame(child.pos, child.quat)
            moments += frame @ _moments(child) @ frame.T
    return moments


def _frame(position: Array, quaternion: Array) -> Array:
    """The frame at a position as a homogeneous matrix, (4, 4)."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = axes_of(quaternion), position
    return frame


def _set_armature(spec: mujoco.MjSpec, name: str, armature: float | Mapping[str, float]) -> None:
    joints = {joint.name: joint for joint in spec.joints if _kind(joint) in ("slide", "hinge")}
    inertias = armature if isinstance(armature, Mapping) else dict.fromkeys(joints, armature)
    for joint, inertia in inertias.items():
        element = joints[check_name(f"{name}: armature", joint, joints)]
        element.armature = check_number(f"{name}: armature of {joint}", inertia, at_least=0.0)


def _add_actuators(
    mjcf: ElementTree.Element,
    spec: mujoco.MjSpec,
    name: str,
    servos: Servos | None,
    efforts: Mapping[str, float] | None,
) -> None:
    """Add a motor or a servo for each joint with an effort that does not follow another; a warning names the others."""
    followers = {equality.name1 for equality in spec.equalities}
    joints = {
        joint.name: joint for joint in spec.joints if _kind(joint) in ("slide", "hinge") and joint.name not in followers
    }
    stated = {} if efforts is None else efforts
    effort_of = check_kind(f"{name}: efforts", stated, Mapping, "numbers by joint: {'shoulder': 20.0}")
    for joint, effort in effort_of.items():
        check_name(f"{name}: efforts", joint, joints)
        check_number(f"{name}: efforts of {joint}", effort, at_least=0.0)
    limits = {joint: float(effort_of.get(joint, element.actfrcrange[1])) for joint, element in joints.items()}
    if not isinstance(servos, Mapping):
        servos = {} if servos is None else dict.fromkeys((joint for joint in joints if limits[joint] > 0), servos)
    for joint in servos:
        check_name(f"{name}: servos", joint, joints)
    gains = {joint: _gains(name, joint, servo) for joint, servo in servos.items()}
    section = _add(mjcf, "actuator")
    for joint, element in joints.items():
        attributes, effort = {"name": joint, "joint": joint}, limits[joint]
        force = [-effort, effort] if 0 < effort < np.inf else None
        if joint in gains:
            stiffness, damping = gains[joint]
            numbers = {"ctrlrange": element.range} if _is_limited(element) else {}
            numbers |= {"forcerange": force} if force else {}
            _add(section, "position", attributes, kp=stiffness, kv=damping, **numbers)
        elif effort > 0:
            _add(section, "motor", attributes, **({"ctrlrange": force} if force else {}))
    if motorless := [joint for joint in joints if not limits[joint] > 0 and joint not in (*gains, *effort_of)]:
        _log.warning(
            "%s: no motor for %s: want an effort in <limit>, or efforts={%r: 10.0}, with 0.0 if there is none",
            name, listed(motorless, _LISTED), motorless[0],
        )  # fmt: skip


def _gains(name: str, joint: str, servo: object) -> list[float]:
    field, want = f"{name}: servos of {joint}", "two numbers, the stiffness and the damping"
    if len(gains := check_items(field, servo, object, want)) != 2:
        raise InputError(f"{field}: got {excerpt(servo)}, want {want}")
    return [check_number(field, gain, at_least=0.0) for gain in gains]


def _add_speed_limits(mjcf: ElementTree.Element, root: ElementTree.Element, name: str) -> None:
    """Add the largest speeds of joints, for which MuJoCo has no place, as numbers of the user's."""
    section = _add(mjcf, "custom")
    for joint in root.iterfind("joint"):
        text = next((limit.get("velocity", "") for limit in joint.iterfind("limit")), "") or "0"
        try:
            speed = float(text)
        except ValueError:
            got = f"got {excerpt(text)} for the velocity of {joint.get('name')}"
            raise InputError(f"{name}: {got}, want a number of rad/s or m/s") from None
        if joint.get("type") in _COUPLED and 0 < speed < np.inf:
            _add(section, "numeric", {"name": f"{joint.get('name')}{SPEED_LIMIT}"}, data=speed)


def _compiled(mjcf: ElementTree.Element) -> tuple[mujoco.MjModel | None, str]:
    """The model, or None and what MuJoCo has against it."""
    try:
        return mujoco.MjModel.from_xml_string(_text(mjcf)), ""
    except (ValueError, mujoco.FatalError) as error:
        return None, " ".join(str(error).split())


def _remove_refused_shapes(mjcf: ElementTree.Element, name: str) -> None:
    """Take out the geoms that MuJoCo refuses, such as boxes and meshes without a volume, with a warning."""
    meshes = {element.get("name"): element for element in mjcf.iterfind("asset/mesh")}
    omitted, used_meshes = dict[str, str](), set[str | None]()
    shapes = [(body, geom) for body in mjcf.iter("body") for geom in body.findall("geom")]
    for body, geom in shapes:
        alone, mesh = ElementTree.Element("mujoco"), geom.get("mesh")
        _add(alone, "asset").extend([meshes[mesh]] if mesh else [])
        _add(alone, "worldbody").append(geom)
        if refusal := _compiled(alone)[1]:
            body.remove(geom)
            omitted[geom.get("name", "")] = refusal
        else:
            used_meshes.add(mesh)
    for assets, (mesh, element) in itertools.product(mjcf.iterfind("asset"), meshes.items()):
        if mesh not in used_meshes:
            assets.remove(element)
    if omitted:
        (first, reason), *_ = omitted.items()
        _log.warning("%s: %d shapes are left out, such as %s: %s", name, len(omitted), first, reason)


def _exclude_overlaps(mjcf: ElementTree.Element, model: mujoco.MjModel, name: str) -> None:
    """Let links that touch at zero, or at the joints' limits next to it, pass through each other.

    A URDF cannot say which links may collide. Hulls of links that are two joints apart often overlap in any position.
    """
    qpos, limited = model.qpos0.copy(), np.flatnonzero(model.jnt_limited)
    places = model.jnt_qposadr[limited]
    qpos[places] = np.clip(qpos[places], *model.jnt_range[limited].T)
    pairs = contacts_of(model, qpos)
    section = _add(mjcf, "contact")
    for first, second in pairs:
        _add(section, "exclude", {"body1": first, "body2": second})
    if touching := [f"{first} and {second}" for first, second in pairs]:
        _log.warning("%s: links that touch at zero never collide: %s", name, listed(touching, _LISTED))


def _text(mjcf: ElementTree.Element) -> str:
    return ElementTree.tostring(mjcf, encoding="unicode") + "\n"


def _kind(element: mujoco.MjsJoint | mujoco.MjsGeom) -> str:
    return element.type.name.rpartition("_")[2].lower()


def _is_limited(joint: mujoco.MjsJoint) -> bool:
    """Whether it has limits. MuJoCo takes two equal ones, as of a joint without any in the URDF, for none."""
    return joint.limited != mujoco.mjtLimited.mjLIMITED_FALSE and joint.range[0] != joint.range[1]


def _add(
    parent: ElementTree.Element, tag: str, attributes: Mapping[str, str] | None = None, **numbers: npt.ArrayLike
) -> ElementTree.Element:
    """A new element, whose numbers read back exactly."""
    texts = {key: " ".join(repr(float(number)) for number in np.ravel(values)) for key, values in numbers.items()}
    return ElementTree.SubElement(parent, tag, {**(attributes or {}), **texts})
