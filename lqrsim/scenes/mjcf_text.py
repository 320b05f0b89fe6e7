"""The text of an MJCF: read, with its includes, checked, and compiled."""

import contextlib
import difflib
import itertools
import math
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Container, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lqrsim.errors import InputError, check_name, check_path, excerpt
from lqrsim.scenes.mujoco_log import mujoco, unlogged

# In the wheel, models/ is inside the package; in the repository, next to it.
_PACKAGED = [Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "models"]
MODELS = next((folder for folder in _PACKAGED if folder.is_dir()), _PACKAGED[0])

DEEPEST = 490  # largest depth of elements; MuJoCo's reader refuses slightly more
UNNAMED = "unnamed_"  # prefix of the names of bodies, joints, geoms and actuators without a name in the MJCF
SPEED_LIMIT = "_velocity_limit"  # <numeric name="JOINT_velocity_limit"> is the joint's largest speed in rad/s or m/s
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
        files = [file.name for file in path.parent.glob("*.xml") if os.path.isfile(file)]
        near = difflib.get_close_matches(path.name, files, n=1)
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


def listed(names: Sequence[str], most: int = 12) -> str:
    """Names in a line, or none; only the first ones if there are many."""
    return (", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")) or "none"
