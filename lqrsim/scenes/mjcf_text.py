"""The text of an MJCF: read, with its includes, and rewritten.

MuJoCo can also write a model as text, but with six digits, which gives another model.
"""

import difflib
import itertools
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lqrsim.errors import Array, InputError, check_name, check_number, check_path, opengl_error
from lqrsim.scenes.world import KINDS, World

try:
    import mujoco
except Exception as error:
    if (other := opengl_error(error)) is not None:
        raise other from None
    raise

# In the wheel, models/ is inside the package; in the repository, next to it.
_PACKAGED = [Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "models"]
MODELS = next((folder for folder in _PACKAGED if folder.is_dir()), _PACKAGED[0])

DEEPEST = 490  # largest depth of elements; MuJoCo's reader refuses slightly more
UNNAMED = "unnamed_"  # prefix of the names of bodies, joints, geoms and actuators without a name in the MJCF
SPEED_LIMIT = "_velocity_limit"  # <numeric name="JOINT_velocity_limit"> is the joint's largest speed in rad/s or m/s
WHOLE = "mass"  # name of the mass of all moving bodies together
_OF_JOINTS = ("damping", "stiffness", "armature", "frictionloss")
_MEDIUM = ("density", "viscosity")
_BOUNDS = {"mass": {"above": 0.0}, "gear": {}}  # bounds; all other numbers must not be negative
_LONG = 1e3  # m, half length of a geom that stands for an infinite one


def names() -> list[str]:
    """The packaged scenes: the files in models/ that include a robot."""
    return sorted(path.stem for path in MODELS.glob("*.xml") if "<include" in path.read_text(encoding="utf-8"))


def read_mjcf(name_or_path: str | os.PathLike[str]) -> tuple[str, str]:
    """The name and the whole text of an MJCF, with includes resolved. Raises InputError as `load_scene`."""
    path = check_path("scene", name_or_path, "the name of a packaged scene, or the path of an .xml or .urdf file")
    if path.suffix.lower() != ".xml":
        packaged = names()
        try:
            path = MODELS / f"{check_name('scene', os.fspath(name_or_path), packaged)}.xml"
        except InputError as error:
            raise InputError(f"{error}; or the path of an .xml or .urdf file") from None
    elif not os.path.isfile(path):
        packaged = ", ".join(names())
        there = [one.name for one in path.parent.glob("*.xml") if os.path.isfile(one)]
        near = difflib.get_close_matches(path.name, there, n=1)
        hint = f" (did you mean {path.with_name(near[0])}?)" if near else ""
        got = os.fspath(name_or_path)
        raise InputError(f"scene: got {got!r}, want a file that exists, or one of: {packaged}{hint}")
    try:
        return path.stem, _flatten(path)
    except RecursionError:
        raise InputError(f"scene: got {path.name} with elements nested deeper than {DEEPEST}, want fewer") from None


def _flatten(path: Path) -> str:
    """The MJCF at `path` as one text: with includes in place, and other files by their full path."""
    seen: set[Path] = set()
    folder = path.parent
    beside = dict[ElementTree.Element, Path]()  # elements of included files -> the folder of their file

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

    def expand(element: ElementTree.Element, own: Path) -> None:
        children = list(element)
        element[:] = []
        for child in children:
            if child.tag == "include":
                element.extend(read(find(child.get("file", ""), own)))
            else:
                expand(child, own)
                element.append(child)
                beside.setdefault(child, own)

    def find(name: str, own: Path) -> Path:
        # MuJoCo's rule, relative to the main file, then to the file that includes; and then the packaged models.
        file = next((file for file in (folder / name, own / name, MODELS / name) if os.path.isfile(file)), None)
        if file is None:
            packaged = ", ".join(sorted(file.name for file in MODELS.glob("*.xml")))
            raise InputError(f"scene: got an include of {name!r}, want a file beside {path.name} or one of: {packaged}")
        if file.resolve() in seen:
            raise InputError(f"scene: got {name} included twice in {path.name}, want each file once")
        return file

    root = read(path)
    if root.tag != "mujoco":
        raise InputError(f"scene: got {path.name} with <{root.tag}> at its root, want <mujoco>")
    settings = {key: value for compiler in root.iterfind("compiler") for key, value in compiler.attrib.items()}
    common, main = settings.get("assetdir", ""), folder.resolve()
    folders = {kind: str(main / settings.get(kind, common)) for kind in ("meshdir", "texturedir")}
    files = [(element, key) for element in root.iter() for key in element.attrib if key.startswith("file")]
    for element, key in files:  # the same rule, but from the folder of their kind, of which an <attach> has none
        kind, own = {"texture": "texturedir", "model": ""}.get(element.tag, "meshdir"), beside[element]
        if kind and own == folder:
            continue
        first, second = (start / element.attrib[key] for start in (main / folders.get(kind, ""), own.resolve()))
        nested = not os.path.isfile(first) and os.path.isfile(second)
        if nested or not kind:
            element.set(key, str(second if nested else first))
    if files:
        root.append(ElementTree.Element("compiler", folders))
    text = ElementTree.tostring(root, encoding="unicode")
    return re.sub(r"\n\s*\n+", "\n", text) + "\n"


def named(xml: str) -> tuple[str, bool]:
    """An MJCF in which every body, joint, geom and actuator has a name: `unnamed_<kind>_<number>`, counted from 0.

    Of several free joints without a name, each gets its body's. The flag says whether there is a light.
    """
    root = ElementTree.fromstring(xml)
    taken = {element.get("name") for element in root.iter()}
    # An MJCF has its own section worldbody, and one from each file that it includes.
    there = [one for world in root.iter("worldbody") for one in world.iter()]
    kinds = {"body": ("body",), "joint": ("joint", "freejoint"), "geom": ("geom",)}
    parts = {kind: [one for one in there if one.tag in tags] for kind, tags in kinds.items()}
    parts["actuator"] = [one for section in root.iter("actuator") for one in section]
    free = [
        (body.get("name"), one)
        for body in parts["body"]
        for one in body
        if (one.tag == "freejoint" or (one.tag == "joint" and one.get("type") == "free")) and one.get("name") is None
    ]
    for body, joint in free if len(free) > 1 else ():
        if body is not None and body not in {one.get("name") for one in parts["joint"]}:
            joint.set("name", body)
    unnamed = {kind: [one for one in elements if one.get("name") is None] for kind, elements in parts.items()}
    for kind, elements in unnamed.items():
        names = (name for count in itertools.count() if (name := f"{UNNAMED}{kind}_{count}") not in taken)
        for element in elements:
            element.set("name", next(names))
    changed = len(free) > 1 or any(unnamed.values())
    return ElementTree.tostring(root, encoding="unicode") if changed else xml, any(one.tag == "light" for one in there)


def with_obstacles(xml: str, world: World) -> str:
    """The MJCF with these obstacles as further geoms, fixed to the world, which nothing touches."""
    root = ElementTree.fromstring(xml)
    taken = {one.get("name") for one in root.iter("geom")}
    section = ElementTree.SubElement(root, "worldbody")
    for one in world.obstacles:
        if one.kind not in KINDS:
            raise InputError(f"moving: got {one.name}, a {one.kind}, want one of: {', '.join(KINDS)}")
        if one.name in taken:
            raise InputError(f"moving: got {one.name}, which is a geom of the robot's MJCF, want another name")
        turn = np.zeros(4)
        mujoco.mju_mat2Quat(turn, one.rotation.ravel())
        size = np.minimum([0.0, 0.0, 1.0] if one.kind == "plane" else one.size, _LONG)
        own = {"name": one.name, "type": one.kind, "contype": "0", "conaffinity": "0"}
        geom = ElementTree.SubElement(section, "geom", own)
        for key, values in (("size", size), ("pos", one.position), ("quat", turn)):
            _set(geom, key, values)
    return ElementTree.tostring(root, encoding="unicode")


def with_light(xml: str, place: Array) -> str:
    """The MJCF with a light named overview at a place (3,)."""
    light = {"name": "overview", "pos": "", "dir": "0.3 0.3 -1", "directional": "true", "diffuse": ".5 .5 .5"}
    added = ElementTree.Element("worldbody")
    ElementTree.SubElement(added, "light", light | {"pos": " ".join(f"{number:.6g}" for number in place)})
    end = xml.rindex("</mujoco>")  # the text comes from ElementTree, and can be long
    return f"{xml[:end]}{ElementTree.tostring(added, encoding='unicode')}{xml[end:]}"


def with_mocap(xml: str, model: mujoco.MjModel, poses: Mapping[str, tuple[Array, Array]], prefix: str) -> str:
    """The MJCF, compiled to this model, with the mocap bodies of the poses there, and all else as it is.

    What MuJoCo compiles from where bodies are at rest is stated as it was: what ties two bodies, by sites whose names
    have the prefix.
    """
    root = ElementTree.fromstring(xml)
    elements = _elements(root)["body"]
    for body, pose in poses.items():
        for other in ("axisangle", "xyaxes", "zaxis", "euler"):
            elements[body].attrib.pop(other, None)
        for attribute, values in zip(("pos", "quat"), pose, strict=True):
            _set(elements[body], attribute, values)
    elements["world"] = next(root.iter("worldbody"))
    ties = [one for section in root.findall("equality") for one in section]
    for i, (tie, values) in enumerate(zip(ties, model.eq_data, strict=False)):
        if tie.tag == "weld" and "body1" in tie.attrib:
            _set(tie, "relpose", values[3:10])
        elif tie.tag == "connect" and "body1" in tie.attrib:
            del tie.attrib["anchor"]
            for side, place in enumerate((values[:3], values[3:6]), 1):
                site = {"name": f"{prefix}_tie_{i}_{side}", "group": "5"}
                tied = ElementTree.SubElement(elements[tie.attrib.pop(f"body{side}", "world")], "site", site)
                _set(tied, "pos", place)
                tie.set(f"site{side}", site["name"])
    return ElementTree.tostring(root, encoding="unicode")


@dataclass(frozen=True)
class Number:
    """A number of an MJCF: its kind, its body, joint, geom or actuator (empty for all), and its value."""

    what: str
    part: str
    value: float


def numbers_of(xml: str, model: mujoco.MjModel) -> dict[str, Number]:
    """All such numbers, by the names of parameters: `mass`, `<body>_mass`, `<joint>_damping`, `<actuator>_gear`.

    They are of an MJCF, compiled to this model, whose elements all have names. Only elements with a name and this
    number in the text count: bodies that move, geoms that collide.
    """
    elements, found = _elements(ElementTree.fromstring(xml)), list[Number]()
    masses = {name: float(model.body(name).mass[0]) for name in _heavy(model)}
    names = {model.body(number).name for number in range(1, model.nbody)}
    if names == elements["body"].keys():  # otherwise the text has no place for some masses
        found += [Number("mass", "", sum(masses.values()))] if masses else []
        found += [Number("mass", name, mass) for name, mass in masses.items()]
    for number in range(model.njnt):
        name, dof = model.joint(number).name, int(model.jnt_dofadr[number])
        if name in elements["joint"]:
            values = {key: getattr(model, f"dof_{key}")[dof] for key in _OF_JOINTS if key != "stiffness"}
            values["stiffness"] = model.jnt_stiffness[number]
            found += [Number(key, name, float(values[key])) for key in _OF_JOINTS]
    for number in np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0)):
        if (name := model.geom(number).name) in elements["geom"]:
            found.append(Number("friction", name, float(model.geom_friction[number, 0])))
    for number, gear in enumerate(model.actuator_gear[model.actuator_outadr]):
        if (name := model.actuator(number).name) in elements["actuator"] and gear.any():
            found.append(Number("gear", name, float(gear[np.abs(gear).argmax()])))
    found += [Number(key, "", float(getattr(model.opt, key))) for key in _MEDIUM]
    return {f"{one.part}_{one.what}" if one.part else one.what: one for one in found}


def with_numbers(xml: str, model: mujoco.MjModel, values: Mapping[str, float], what: str) -> str:
    """The MJCF with changed numbers, by name, as in `numbers_of`.

    A body's inertia scales with its mass; `mass` scales all bodies. The numbers of a gear keep their ratios.
    """
    numbers, root = numbers_of(xml, model), ElementTree.fromstring(xml)
    elements, scales = _elements(root), dict[str, float]()
    for name, value in values.items():
        one = numbers[name]
        value = check_number(f"{what}: {name}", value, **_BOUNDS.get(one.what, {"at_least": 0.0}))
        ratio = value / one.value if one.value else 0.0
        if name == WHOLE:
            scales |= dict.fromkeys(_heavy(model), ratio)
            if other := next((key for key in values if key != WHOLE and numbers[key].what == "mass"), None):
                raise InputError(f"{what}: {WHOLE}: got {WHOLE} and {other}, want one of the two")
        elif one.what == "mass":
            scales[one.part] = ratio
        elif one.what in _OF_JOINTS:
            joint = model.joint(one.part).id
            # Damping and stiffness may be polynomials, of which this is the linear coefficient.
            damping, stiffness = model.dof_dampingpoly[model.jnt_dofadr[joint]], model.jnt_stiffnesspoly[joint]
            rest = {"damping": damping, "stiffness": stiffness}.get(one.what, ())
            _set(elements["joint"][one.part], one.what, [value, *rest])
        elif one.what == "friction":
            _set(elements["geom"][one.part], "friction", [value, *model.geom(one.part).friction[1:]])
        elif one.what == "gear":
            first = np.reshape(model.actuator(one.part).gear, (-1, 6))[0]
            _set(elements["actuator"][one.part], "gear", ratio * first)
        else:
            _set(ElementTree.SubElement(root, "option"), one.what, [value])  # the last element takes precedence
    for name, body in elements["body"].items() if scales else ():  # the compiled masses, for all that they came from
        for inertial in body.findall("inertial"):
            body.remove(inertial)
        compiled, scale = model.body(name), scales.get(name, 1.0)
        if compiled.mass[0] > 0:
            inertial = ElementTree.Element("inertial")
            _set(inertial, "pos", compiled.ipos)
            _set(inertial, "quat", compiled.iquat)
            _set(inertial, "mass", [scale * compiled.mass[0]])
            _set(inertial, "diaginertia", scale * compiled.inertia)
            body.insert(0, inertial)
    if scales:
        compiler = {"inertiafromgeom": "false", "settotalmass": "-1", "boundmass": "0", "boundinertia": "0"}
        ElementTree.SubElement(root, "compiler", compiler)
    return ElementTree.tostring(root, encoding="unicode")


def _heavy(model: mujoco.MjModel) -> list[str]:
    """The bodies with mass that move, by themselves or with others."""
    moves = (model.body_treeid >= 0) & (model.body_mass > 0)
    return [model.body(number).name for number in np.flatnonzero(moves)]


def _elements(root: ElementTree.Element) -> dict[str, dict[str, ElementTree.Element]]:
    """The named elements, by kind and name. Replicas have other names in the model, and are not found."""
    found = {"body": {}, "joint": {}, "geom": {}, "actuator": {}}
    for world in root.iter("worldbody"):
        for element in world.iter():
            if element.tag in found:
                found[element.tag][element.get("name", "")] = element
    for section in root.findall("actuator"):
        found["actuator"] |= {element.get("name", ""): element for element in section}
    return found


def _set(element: ElementTree.Element, name: str, numbers: Iterable[float]) -> None:
    """Write numbers so that they read back exactly."""
    element.set(name, " ".join(repr(float(number)) for number in numbers))


def listed(names: Sequence[str], most: int = 12) -> str:
    """Names in a line, or none; only the first ones if there are many."""
    return (", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")) or "none"
