"""Scenes: from an MJCF to a MuJoCo model and the obstacles that a robot must keep clear of.

There is one rule for obstacles, which anyone can apply to their own file: **every geom that is fixed to the world and
can collide is an obstacle.** A geom is fixed to the world if there is no joint and no mocap between them. It can
collide if contype or conaffinity is not zero, and contacts are not switched off by a flag. Therefore

- geoms that are only drawn (both zero) are no obstacles, nor is anything that can move, the robot included;
- planes are walls, floors and ceilings, infinite, at any drawn size, and solid behind. A plane that is parallel to the
  plane in which a robot moves, such as the floor that it drives on, does not bound the robot (`World.seen_by`);
- plane, sphere, capsule, cylinder, box and mesh have a distance; a mesh is its convex hull, as in contacts. Other types
  are refused by name, not left out. A robot from an MJCF uses MuJoCo's distances, to all types;
- a cylinder or capsule counts as infinite if both ends lie on or behind planes, because nothing can reach them, and
  prolonged ones would stay behind these planes.

`obstacles=` of `load_scene` chooses other obstacles, by names or by a function. `MjcfRobot` leaves out geoms that are
not in the way of that robot.
"""

import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from lqrsim.annotations import Want, checked
from lqrsim.errors import Array, InputError, check_count, check_items, check_name, excerpt, free_name
from lqrsim.scenes.mjcf_kinematics import colliding, placed
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.mujoco_log import mujoco
from lqrsim.scenes.urdf import Base, Servos, is_urdf, read_urdf
from lqrsim.scenes.world import FLAT, KINDS, OTHER_KINDS, Obstacle, World

_FLAGS = mujoco.mjtDisableBit

Choice = bool | Sequence[str] | Callable[[Any], bool]  # a choice of obstacles; see `load_scene`


@checked
@dataclass(frozen=True, eq=False)
class Scene:
    """A place for a robot to move in.

    Attributes:
      world: the obstacles, as the module's docstring defines them.
      geoms: ids of their geoms in the model, in the same order.
    """

    _want = "a Scene, such as load_scene('cage')"

    mjcf: MjcfModel
    world: World
    geoms: Annotated[tuple[int, ...], Want("ids of geoms")]

    @property
    def name(self) -> str:
        """Name of the packaged scene, or the stem of the file."""
        return self.mjcf.name

    @property
    def xml(self) -> str:
        """The whole MJCF as text, with includes resolved. The model can be made from it alone."""
        return self.mjcf.xml

    @property
    def model(self) -> mujoco.MjModel:
        """The model compiled from `xml`."""
        return self.mjcf.model

    def __repr__(self) -> str:
        return f"Scene({self.name!r}, {len(self.world)} obstacles)"

    def __post_init__(self) -> None:
        for geom in self.geoms:
            check_count("Scene: geoms", geom, at_least=0, at_most=self.model.ngeom - 1)
        if len(set(self.geoms)) < len(self.geoms):
            raise InputError(f"Scene: geoms: got {excerpt(self.geoms)}, want different ids")
        if len(self.world) != len(self.geoms):
            raise InputError(f"Scene: world: got {len(self.world)} obstacles, want {len(self.geoms)}, one per geom")


def load_scene(
    name_or_path: str | os.PathLike[str],
    *,
    obstacles: Choice = True,
    base: Base | None = None,
    servos: Servos | None = None,
    efforts: Mapping[str, float] | None = None,
    armature: float | Mapping[str, float] | None = None,
) -> Scene:
    """A packaged scene by name, or any MJCF or URDF by path.

    An MJCF may include the packaged robots, e.g. `create.xml`, by name. A URDF becomes an MJCF, `scene.xml`, in which
    each joint with an effort in its <limit> has a motor of its name. `MjcfRobot.joint_limits` keeps its largest speeds.
    Fixed links stay, and the link that carries them has their masses. Warnings name what is missing, such as efforts
    and meshes, and the links that touch at zero, which never collide.

    Args:
      name_or_path: a name in models/, or the path of a file. The meshes of a URDF are .stl, .obj or .msh files, there
        or of the same name beside it; packages are in a folder above it, in ROS_PACKAGE_PATH or in AMENT_PREFIX_PATH.
      obstacles: the geoms fixed to the world that are obstacles: all that can collide; none, with False; names of
        geoms, or of bodies for all of their geoms; or a function that says whether a geom, as from
        `model.geom(number)`, is an obstacle. In runs the robot passes through geoms that are left out, except ground
        and what it stands on; an `MjcfRobot` does not, because its plans have their contacts.
      base: of a URDF: whether its root link is "fixed" to the world, by default, or "free".
      servos: of a URDF: stiffness and damping of servos in the place of motors, in N m/rad and N m s/rad, or in N/m and
        N s/m; by joint, {"shoulder": (200.0, 10.0)}, or for all that have an effort, (200.0, 10.0).
      efforts: of a URDF: largest torques in N m, or forces in N, by joint, in the place of the file's; 0 for no motor.
      armature: of a URDF, which has none: inertias of motors as their joints feel them, with the square of the gear
        ratio, in kg m^2, or masses in kg; by joint, or one for all. Without, small links with strong motors are shaken
        by noise that real ones do not feel.
    """
    of_urdf: dict[str, Any] = {"base": base, "servos": servos, "efforts": efforts, "armature": armature}
    stated = {name: value for name, value in of_urdf.items() if value is not None}
    mjcf = MjcfModel(*read_urdf(name_or_path, **stated)) if stated else MjcfModel.of_file(name_or_path)
    # What moves in a URDF is an MjcfRobot, which has MuJoCo's distances.
    return _with_choice(mjcf, obstacles, (*KINDS, *OTHER_KINDS) if is_urdf(name_or_path) else KINDS)


def scene_from_xml(xml: str, name: str, *, obstacles: Choice = True) -> Scene:
    """The scene of an MJCF given as text, without includes."""
    return _with_choice(MjcfModel(name, xml), obstacles)


def _with_choice(mjcf: MjcfModel, obstacles: Choice, kinds: Collection[str] = KINDS) -> Scene:
    geoms = chosen_geoms(mjcf.model, obstacles, obstacle_geoms(mjcf.model), f"scene {mjcf.name}")
    return scene_of(mjcf, geoms, kinds)


def chosen_geoms(model: mujoco.MjModel, obstacles: Choice, default: Sequence[int], what: str) -> list[int]:
    """Ids of the geoms that the `obstacles=` of `load_scene` chooses; `default` for True."""
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
    chosen = {geom for name in listed for geom in geoms_of[check_name(f"{what}: obstacles", name, tuple(geoms_of))]}
    return sorted(chosen)


def obstacle_geoms(model: mujoco.MjModel) -> list[int]:
    """Ids of the geoms that are obstacles by the module's rule, in the order of `Scene.world`."""
    if model.opt.disableflags & (_FLAGS.mjDSBL_CONTACT | _FLAGS.mjDSBL_CONSTRAINT):
        return []
    return np.flatnonzero((model.body_weldid[model.geom_bodyid] == 0) & colliding(model)).tolist()


def scene_of(mjcf: MjcfModel, geoms: Sequence[int], kinds: Collection[str] = (*KINDS, *OTHER_KINDS)) -> Scene:
    """The scene in which these geoms are the obstacles. Raises InputError if a geom is not of these kinds."""
    model, text = mjcf.model, mjcf.model.names
    data = placed(model)
    names = [text[first : text.index(b"\0", first)].decode() for first in model.name_geomadr.tolist()]
    used_names, types = set(names), model.geom_type.tolist()
    kind_of = {number: mujoco.mjtGeom(number).name.removeprefix("mjGEOM_").lower() for number in set(types)}
    places, axes = data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy()
    sizes, still, no_corners = model.geom_size.copy(), np.zeros(3), np.zeros((0, 3))
    obstacles: list[Obstacle] = []
    for geom in geoms:
        kind = kind_of[types[geom]]
        name = names[geom] or free_name(f"{kind} {geom}", used_names)
        if kind not in kinds:
            raise InputError(
                f"scene {mjcf.name}: got the obstacle {name!r} of type {kind}, want one of: {', '.join(KINDS)};"
                ' or contype="0" conaffinity="0" if it is only to be drawn; or obstacles= to choose others; or an'
                " MjcfRobot, which has MuJoCo's distances"
            )
        position, size, corners = places[geom], np.zeros(3) if kind == "plane" else sizes[geom], no_corners
        if kind == "mesh" or kind in OTHER_KINDS:
            middle, size = model.geom_aabb[geom, :3], np.maximum(model.geom_aabb[geom, 3:], FLAT)
            position = position + axes[geom] @ middle
            corners = _hull_of(model, int(model.geom_dataid[geom])) - middle if kind == "mesh" else no_corners
        obstacle = Obstacle._of_mujoco(
            name=name, kind=kind, position=position, rotation=axes[geom], size=size, velocity=still, corners=corners
        )
        obstacles.append(obstacle)
    planes = [obstacle for obstacle in obstacles if obstacle.kind == "plane"]
    for i, obstacle in enumerate(obstacles):
        if obstacle.kind in ("capsule", "cylinder") and all(_walled_off(obstacle, end, planes) for end in (-1, 1)):
            obstacles[i] = replace(obstacle, size=np.array([obstacle.size[0], np.inf, 0.0]))
    return Scene(mjcf, World(obstacles), tuple(geoms))


def _hull_of(model: mujoco.MjModel, mesh: int) -> Array:
    """The corners (C, 3) of a mesh's convex hull, with which MuJoCo lets it collide; without one, all its corners."""
    first, graph = int(model.mesh_vertadr[mesh]), int(model.mesh_graphadr[mesh])
    corners = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(np.float64)
    if graph < 0:
        return corners
    count = int(model.mesh_graph[graph])
    return corners[model.mesh_graph[graph + 2 + count : graph + 2 + 2 * count]]


def _walled_off(bar: Obstacle, end: int, planes: list[Obstacle]) -> bool:
    """Whether the end of a cylinder or capsule, as a disc across its axis, lies wholly on or behind a plane.

    It does not count if the bar, prolonged beyond this end, would come out of the plane again.
    """
    radius, half_length, _ = bar.size
    axis = end * bar.rotation[:, 2]
    centre = bar.position + half_length * axis

    def height(plane: Obstacle) -> float:
        normal = plane.rotation[:, 2]
        return normal @ (centre - plane.position) + radius * math.sqrt(max(0.0, 1 - float(normal @ axis) ** 2))

    return any(height(plane) <= 1e-6 and plane.rotation[:, 2] @ axis <= 1e-9 for plane in planes)
