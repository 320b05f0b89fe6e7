"""Scenes: from an MJCF to a MuJoCo model and the obstacles that a robot must keep clear of.

There is one rule for obstacles, which anyone can apply to their own file: **every geom that is fixed to the world and
can collide is an obstacle.** A geom is fixed to the world if there is no joint and no mocap between them. It can
collide if contype or conaffinity is not zero, and contacts are not switched off by a flag. Therefore

- geoms that are only drawn (both zero) are no obstacles, nor is anything that can move, the robot included;
- planes are walls, floors and ceilings, infinite, at any drawn size, and solid behind. A plane that is parallel to the
  plane in which a robot moves, such as the floor that it drives on, does not bound the robot (`World.seen_by`);
- plane, sphere, capsule, cylinder and box have a distance. Other types are refused by name, not left out. A robot from
  an MJCF uses MuJoCo's distances, to all types;
- a cylinder or capsule counts as infinite if both ends lie on or behind planes, because nothing can reach them.

`obstacles=` of `load_scene` chooses other obstacles, by names or by a function. `MjcfRobot` leaves out geoms that are
not in the way of that robot.
"""

import contextlib
import difflib
import math
import os
import re
import threading
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lqrsim.errors import (
    InputError,
    check_count,
    check_items,
    check_kind,
    check_name,
    check_path,
    check_text,
    excerpt,
    keep,
)
from lqrsim.scenes.world import KINDS, OTHER_KINDS, Obstacle, World

try:
    import mujoco
except Exception as error:
    # MuJoCo chooses its OpenGL while it is imported; if the chosen one is missing, it can raise anything.
    if "MUJOCO_GL" not in os.environ:
        raise
    raise InputError(
        f"MUJOCO_GL: got {os.environ['MUJOCO_GL']!r}, with which MuJoCo cannot be imported here"
        f" ({' '.join(str(error).split())}), want it unset: lqrsim finds an OpenGL by itself"
    ) from None

# In the wheel, models/ is inside the package; in the repository, next to it.
_PACKAGED = [Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "models"]
_FLAGS = mujoco.mjtDisableBit
DEEPEST = 490  # largest depth of elements; MuJoCo's reader refuses slightly more
_FLAT = 1e-9  # m, thickness of geoms without one
MOST_CELLS = 4096**2  # largest number of cells of a height field; MuJoCo crashes with far more

MOST_COPIES = 1_000_000  # largest number of elements from <replicate>: they take MuJoCo minutes, and GBs
_COPIERS = "replicate", "composite", "flexcomp"  # elements with a count of the elements that they make
_MASSES = frozenset(
    (
        "mass", "density", "viscosity", "diaginertia", "fullinertia", "settotalmass", "boundmass", "boundinertia",
        "armature",
    )
)  # fmt: skip
_NAN = re.compile(r"(^|[\s,])[+-]?nan")

MODELS = next((folder for folder in _PACKAGED if folder.is_dir()), _PACKAGED[0])


Choice = bool | Sequence[str] | Callable[[Any], bool]  # a choice of obstacles; see `load_scene`


@dataclass(frozen=True, eq=False)
class Scene:
    """A place for a robot to move in.

    Attributes:
      name: name of the packaged scene, or the stem of the file.
      xml: the whole MJCF as text, with includes resolved. The model can be made from it alone.
      model: the model compiled from `xml`.
      world: the obstacles, as the module's docstring defines them.
      geoms: ids of their geoms in the model, in the same order.
    """

    name: str
    xml: str
    model: mujoco.MjModel
    world: World
    geoms: tuple[int, ...]

    def __repr__(self) -> str:
        return f"Scene({self.name!r}, {len(self.world)} obstacles)"

    def __post_init__(self) -> None:
        check_text("Scene: name", self.name, "a name", at_most=1000)
        check_kind("Scene: xml", self.xml, str, "the MJCF as text")
        check_kind("Scene: model", self.model, mujoco.MjModel, "a mujoco.MjModel")
        check_kind("Scene: world", self.world, World, "a World")
        keep(self, geoms=check_items("Scene: geoms", self.geoms, (int, np.integer), "ids of geoms"))
        for geom in self.geoms:
            check_count("Scene: geoms", geom, at_least=0, at_most=self.model.ngeom - 1)
        if len(set(self.geoms)) < len(self.geoms):
            raise InputError(f"Scene: geoms: got {excerpt(self.geoms)}, want different ids")
        if len(self.world) != len(self.geoms):
            raise InputError(f"Scene: world: got {len(self.world)} obstacles, want {len(self.geoms)}, one per geom")


def names() -> list[str]:
    """The packaged scenes: the files in models/ that include a robot."""
    return sorted(path.stem for path in MODELS.glob("*.xml") if "<include" in path.read_text(encoding="utf-8"))


def load_scene(name_or_path: str | os.PathLike[str], *, obstacles: Choice = True) -> Scene:
    """A packaged scene by name, or any MJCF by path. It may include the packaged robots, e.g. `create.xml`, by name.

    Args:
      name_or_path: a name in models/, or the path of an MJCF file.
      obstacles: the geoms fixed to the world that are obstacles: all that can collide; none, with False; names of
        geoms, or of bodies for all of their geoms; or a function that says whether a geom, as from
        `model.geom(number)`, is an obstacle. In runs the robot passes through geoms that are left out, except ground
        and what it stands on; an `MjcfRobot` does not, because its plans have their contacts.

    Raises:
      InputError: no such scene or file; it does not parse or compile; there is no geom of such a name; or an obstacle
        is of a type without a distance.
    """
    name, xml = read_mjcf(name_or_path)
    return scene_from_xml(xml, name, obstacles=obstacles)


def read_mjcf(name_or_path: str | os.PathLike[str]) -> tuple[str, str]:
    """The name and the whole text of an MJCF, with includes resolved. Raises InputError as `load_scene`."""
    path = check_path("scene", name_or_path, "the name of a packaged scene, or the path of an .xml file")
    if path.suffix.lower() != ".xml":
        packaged = names()
        try:
            path = MODELS / f"{check_name('scene', os.fspath(name_or_path), packaged)}.xml"
        except InputError as error:
            raise InputError(f"{error}; or the path of an .xml file") from None
    elif not os.path.isfile(path):
        packaged = ", ".join(names())
        near = difflib.get_close_matches(path.name, [one.name for one in path.parent.glob("*.xml")], n=1)
        hint = f" (did you mean {path.with_name(near[0])}?)" if near else ""
        got = os.fspath(name_or_path)
        raise InputError(f"scene: got {got!r}, want a file that exists, or one of: {packaged}{hint}")
    try:
        return path.stem, _flatten(path)
    except RecursionError:
        raise InputError(f"scene: got {path.name} with elements nested deeper than {DEEPEST}, want fewer") from None


def model_from_xml(xml: str, what: str) -> mujoco.MjModel:
    """The model of an MJCF given as text, without includes.

    Args:
      what: name of the MJCF in messages.

    Raises:
      InputError: MuJoCo refuses the MJCF, or would crash, or the MJCF contains a NaN.
    """
    _check_elements(xml, what)
    try:
        with unlogged():
            model = mujoco.MjModel.from_xml_string(xml)
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
        raise InputError(f"{what}: got an MJCF that MuJoCo refuses: {' '.join(str(error).split())}") from None
    _check_numbers(model, what)
    return model


def scene_from_xml(xml: str, name: str, *, obstacles: Choice = True) -> Scene:
    """The scene of an MJCF given as text, without includes. Raises InputError as `load_scene` does."""
    model = checked_model(xml, name)
    return scene_of(xml, name, model, chosen_geoms(model, obstacles, obstacle_geoms(model), f"scene {name}"))


def checked_model(xml: str, name: str) -> mujoco.MjModel:
    """The model of a scene's MJCF. Raises InputError as `model_from_xml`, and if MuJoCo would solve it wrongly."""
    model = model_from_xml(xml, f"scene {name}")
    if mujoco.mj_isSparse(model) and mujoco.__version__ == "4.0.0":
        # Newton on a sparse Jacobian gives wrong forces in 4.0.0 (fixed in 4.0.1).
        raise InputError(
            f"scene {name}: got a sparse constraint Jacobian, which MuJoCo 4.0.0 solves wrongly;"
            ' want <option jacobian="dense"/> or a newer MuJoCo'
        )
    return model


def scene_of(xml: str, name: str, model: mujoco.MjModel, geoms: Sequence[int], kinds: Collection[str] = KINDS) -> Scene:
    """The scene in which these geoms are the obstacles. Raises InputError if a geom is not of these kinds."""
    return Scene(name, xml, model, World(_obstacles(model, name, geoms, kinds)), tuple(geoms))


def chosen_geoms(model: mujoco.MjModel, obstacles: Choice, default: Sequence[int], what: str) -> list[int]:
    """Ids of the geoms that the `obstacles=` of `load_scene` chooses.

    Args:
      default: the geoms for True. what: name of the scene in messages.

    Raises:
      InputError: no geom or body that is fixed to the world has such a name, or the argument is no choice.
    """
    if isinstance(obstacles, bool):
        return list(default) if obstacles else []
    fixed = np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0).tolist()
    if callable(obstacles):
        try:
            return [geom for geom in fixed if obstacles(model.geom(geom))]
        except Exception as error:  # any exception of a user's function becomes one line
            raise InputError(
                f"{what}: obstacles: got {type(error).__name__} ({error}), want a function of a geom that does not fail"
            ) from error
    wanted = "True, False, names of geoms or bodies, or a function of a geom"
    if isinstance(obstacles, str):
        raise InputError(f"{what}: obstacles: got {excerpt(obstacles)}, want a tuple of names: ({excerpt(obstacles)},)")
    listed = check_items(f"{what}: obstacles", obstacles, str, wanted)
    geoms_of: dict[str, list[int]] = {}
    for geom in fixed:
        geoms_of.setdefault(model.geom(geom).name, []).append(geom)
        if model.geom_bodyid[geom]:
            geoms_of.setdefault(model.body(model.geom_bodyid[geom]).name, []).append(geom)
    geoms_of.pop("", None)
    found = {geom for name in listed for geom in geoms_of[check_name(f"{what}: obstacles", name, tuple(geoms_of))]}
    return sorted(found)


_quiet, _count, _before = threading.Lock(), 0, None


@contextlib.contextmanager
def unlogged() -> Iterator[None]:
    """Keeps MuJoCo from writing MUJOCO_LOG.TXT and to the console, because its warnings are reported or recorded
    otherwise.

    Several threads may be in this context. The last to leave restores the state before the first.
    """
    global _count, _before
    with _quiet:
        if _count == 0:
            _before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
            quiet.logto_file = quiet.logto_console = False
            quiet.set()
        _count += 1
    try:
        yield
    finally:
        with _quiet:
            _count -= 1
            if _count == 0 and _before is not None:
                _before.set()


@unlogged()
def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model of a spec, which has been compiled before: warnings about it were given, or are counted in runs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return spec.compile()


def free_name(name: str, taken: Collection[str]) -> str:
    """A name for an element without a name in the MJCF: the given name, with underscores appended if it is taken."""
    while name in taken:
        name += "_"
    return name


def obstacle_geoms(model: mujoco.MjModel) -> list[int]:
    """Ids of the geoms that are obstacles by the module's rule, in the order of `Scene.world`."""
    if model.opt.disableflags & (_FLAGS.mjDSBL_CONTACT | _FLAGS.mjDSBL_CONSTRAINT):
        return []
    fixed = model.body_weldid[model.geom_bodyid] == 0
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return np.flatnonzero(fixed & collides).tolist()


def geom_names(model: mujoco.MjModel) -> list[str]:
    """The names of all geoms, empty for geoms without a name."""
    text = model.names
    return [text[first : text.index(b"\0", first)].decode() for first in model.name_geomadr.tolist()]


def _check_elements(xml: str, what: str) -> None:
    """Raises InputError where MuJoCo would crash or stay silent: for excessive counts, or NaN for unknown numbers.

    MuJoCo treats a NaN for the mass or density of a geom as a missing number.
    """
    text = xml.lower()
    rare = any(word in text for word in (*_COPIERS, "hfield", "nan"))
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
            if event == "start" and element.tag == "hfield":
                sizes = [element.attrib.get(key, "") for key in ("nrow", "ncol")]
                cells = int(sizes[0]) * int(sizes[1]) if all(size.strip().isdecimal() for size in sizes) else 0
                if cells > MOST_CELLS:
                    got = f"{sizes[0]} x {sizes[1]} heights in the height field {element.attrib.get('name', '')!r}"
                    raise InputError(f"{what}: got {got}, want {MOST_CELLS:,} at most")
    except (ElementTree.ParseError, ValueError) as error:
        if isinstance(error, InputError):
            raise  # MuJoCo reports all other errors


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
        if isinstance(array, np.ndarray) and array.dtype.kind == "f" and np.isnan(array).any():
            element = int(np.argwhere(np.isnan(array))[0][0])
            raise InputError(f"{what}: got NaN in the MJCF (MuJoCo's {field}[{element}]), want numbers")


def _obstacles(model: mujoco.MjModel, scene: str, geoms: Sequence[int], kinds: Collection[str]) -> list[Obstacle]:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names = geom_names(model)
    taken, types = set(names), model.geom_type.tolist()
    kind_of = {one: mujoco.mjtGeom(one).name.removeprefix("mjGEOM_").lower() for one in set(types)}
    places, axes = data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy()
    sizes, still = model.geom_size.copy(), np.zeros(3)
    found: list[Obstacle] = []
    for geom in geoms:
        kind = kind_of[types[geom]]
        name = names[geom] or free_name(f"{kind} {geom}", taken)
        if kind not in kinds:
            raise InputError(
                f"scene {scene}: got the obstacle {name!r} of type {kind}, want one of: {', '.join(KINDS)};"
                ' or contype="0" conaffinity="0" if it is only to be drawn; or obstacles= to choose others; or an'
                " MjcfRobot, which has MuJoCo's distances"
            )
        position, size = places[geom], np.zeros(3) if kind == "plane" else sizes[geom]
        if kind in OTHER_KINDS:
            middle, size = model.geom_aabb[geom, :3], np.maximum(model.geom_aabb[geom, 3:], _FLAT)
            position = position + axes[geom] @ middle
        found.append(Obstacle._of_mujoco(name, kind, position, axes[geom], size, still))
    planes = [obstacle for obstacle in found if obstacle.kind == "plane"]
    return [_endless(obstacle, planes) if obstacle.kind in ("capsule", "cylinder") else obstacle for obstacle in found]


def _endless(bar: Obstacle, planes: list[Obstacle]) -> Obstacle:
    """The cylinder or capsule, infinite if both its ends are walled off."""
    if all(_walled_off(bar, end, planes) for end in (-1, 1)):
        return replace(bar, size=np.array([bar.size[0], np.inf, 0.0]))
    return bar


def _walled_off(bar: Obstacle, end: int, planes: list[Obstacle]) -> bool:
    """Whether the end of a cylinder or capsule, as a disc across its axis, lies wholly on or behind a plane."""
    radius, half_length, _ = bar.size
    axis = end * bar.rotation[:, 2]
    centre = bar.position + half_length * axis

    def height(plane: Obstacle) -> float:
        normal = plane.rotation[:, 2]
        return normal @ (centre - plane.position) + radius * np.linalg.norm(np.cross(normal, axis))

    return any(height(plane) <= 1e-6 for plane in planes)


def _flatten(path: Path) -> str:
    """The MJCF at `path` as one text: with includes in place, and other files by their full path.

    MuJoCo can also write a model as text, but with six digits, which gives another model.
    """
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
    for element, own in beside.items():  # other files: the same rule, but from the folder of their kind
        start = Path(folders["texturedir" if element.tag == "texture" else "meshdir"])
        start = main if element.tag == "model" else start  # for <attach>; MuJoCo has no setting for their folder
        for key in [key for key in element.attrib if key.startswith("file")]:
            first, second = start / element.attrib[key], own.resolve() / element.attrib[key]
            nested = not os.path.isfile(first) and os.path.isfile(second)
            if nested or element.tag == "model":
                element.set(key, str(second if nested else first))
    if any(key.startswith("file") for element in root.iter() for key in element.attrib):
        root.append(ElementTree.Element("compiler", folders))
    text = ElementTree.tostring(root, encoding="unicode")
    return re.sub(r"\n\s*\n+", "\n", text) + "\n"
