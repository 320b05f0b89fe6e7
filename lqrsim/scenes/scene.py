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
not in the way of that robot: see `in_the_way`.
"""

import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Want, checked
from lqrsim.errors import Array, InputError, check_count, check_items, check_name, excerpt, free_name
from lqrsim.scenes.mjcf_kinematics import carriers, colliding, driven_trees, placed, posed
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.mujoco_log import mujoco
from lqrsim.scenes.urdf import Base, Servos, is_urdf
from lqrsim.scenes.world import FLAT, KINDS, OTHER_KINDS, Obstacle, World

_FLAGS = mujoco.mjtDisableBit
_FREE, _SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_TOUCHING = 1e-3  # m; a geom nearer to another touches it
_LEVEL = 1 - 1e-9  # the least vertical part of the normal of a plane that is level
_LOWERED, _CARRIES = 1e-3, 0.7  # m; a geom carries another if lowering it by this widens the gap by this share or more
_POSITIONS = 64  # random positions of joints in which a geom must touch what carries it

Pairs = npt.NDArray[np.int64]  # (K, 2), the robot's geom and the obstacle's geom
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
    given = {name: value for name, value in of_urdf.items() if value is not None}
    mjcf = MjcfModel.of_file(name_or_path, **given)
    # What moves in a URDF is an MjcfRobot, which has MuJoCo's distances.
    kinds = (*KINDS, *OTHER_KINDS) if is_urdf(name_or_path) else KINDS
    return scene_of(mjcf, chosen_geoms(mjcf.model, obstacles, f"scene {mjcf.name}"), kinds)


def scene_from_xml(xml: str, name: str, *, obstacles: Choice = True) -> Scene:
    """The scene of an MJCF given as text, without includes."""
    mjcf = MjcfModel(name, xml)
    return scene_of(mjcf, chosen_geoms(mjcf.model, obstacles, f"scene {name}"), KINDS)


def chosen_geoms(model: mujoco.MjModel, obstacles: Choice, what: str) -> list[int]:
    """Ids of the geoms that the `obstacles=` of `load_scene` chooses."""
    if isinstance(obstacles, bool):
        return obstacle_geoms(model) if obstacles else []
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


# What a robot that consists of all moving bodies of an MJCF can touch, and which of it is in its way.


def in_the_way(model: mujoco.MjModel, candidates: list[int], body: int, *, floors: bool) -> list[int]:
    """The candidates (ids of geoms fixed to the world) that are obstacles to the robot whose first moving body this is.

    They are those of `touchable`, except its own base and, with `floors`, a floor that anything touches at rest.
    """
    data, pairs = placed(model), touching_pairs(model, candidates)
    pairs = pairs[~np.isin(model.geom_bodyid[pairs[:, 1]], [*_base(model)])]
    if floors:
        level = _ground(model, data)
        near = pairs[np.isin(pairs[:, 1], [*level])]
        touched = set(near[_touch(model, data, near), 1].tolist())
        ground = (level if _sinks(model, data, body) else touched) | _supports(model, pairs)
        pairs = pairs[~np.isin(pairs[:, 1], [*ground])]
    avoidable = set(pairs[~_always_touch(model, pairs), 1].tolist())
    return [geom for geom in candidates if geom in avoidable]


def touchable(model: mujoco.MjModel, candidates: list[int], body: int) -> list[int]:
    """The candidates that MuJoCo lets the robot touch, except ground and what only carries it; see `in_the_way`.

    Ground is a floor that the robot can sink to, by a free joint or a slide that is not level, and what it stands on
    and can move over.
    """
    data, pairs = placed(model), touching_pairs(model, candidates)
    touched = set(pairs[~_always_touch(model, pairs), 1].tolist())
    of_robot = model.body_rootid[model.geom_bodyid[pairs[:, 0]]] == model.body_rootid[body]
    ground = (_ground(model, data) if _sinks(model, data, body) else set[int]()) | _supports(model, pairs[of_robot])
    return [geom for geom in candidates if geom in touched and geom not in ground]


def mounting_pairs(model: mujoco.MjModel, obstacles: list[int]) -> Pairs:
    """The pairs that touch in every position of the joints, of obstacles that another geom can also touch."""
    pairs = touching_pairs(model, obstacles)
    always = _always_touch(model, pairs)
    return pairs[always & np.isin(pairs[:, 1], pairs[~always, 1])]


def touching_pairs(model: mujoco.MjModel, obstacles: list[int]) -> Pairs:
    """The pairs of a moving geom and an obstacle that MuJoCo lets collide.

    They collide by contype and conaffinity, unless their bodies are excluded, or as a pair in the MJCF.
    """
    moving = np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0)
    fixed = np.array(obstacles, dtype=np.int64)
    pairs = np.stack(np.meshgrid(moving, fixed, indexing="ij"), axis=-1).reshape(-1, 2)
    return pairs[_collide_by_kind(model, pairs) | _are_stated(model, pairs)]


def link_pairs(model: mujoco.MjModel, body: int) -> Pairs:
    """The pairs of geoms on two links of the robot that MuJoCo lets collide.

    It does not if their bodies are fixed to each other, are parent and child, or are excluded, but for a pair in the
    MJCF. Pairs that touch in every position of the joints are left out. Links are the bodies of kinematic trees that
    actuators move, and of the tree of `body`, and what carries them: what the robot handles is none.
    """
    welds, trees = model.body_weldid, [*driven_trees(model, body)]
    geoms = np.flatnonzero((welds[model.geom_bodyid] != 0) & np.isin(model.body_treeid[model.geom_bodyid], trees))
    pairs = np.stack([geoms[places] for places in np.triu_indices(len(geoms), 1)], axis=1).astype(np.int64)
    first, second = welds[model.geom_bodyid[pairs]].T
    joined = first == second
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        parents = welds[model.body_parentid]
        joined |= (parents[first] == second) | (parents[second] == first)
    pairs = pairs[_collide_by_kind(model, pairs) & ~joined | _are_stated(model, pairs)]
    base = np.flatnonzero((welds[model.geom_bodyid] == 0) & np.isin(model.geom_bodyid, [*_base(model)]))
    fixed = touching_pairs(model, base.tolist())
    pairs = np.concatenate([pairs, fixed[np.isin(fixed[:, 0], geoms)]])
    return pairs[~_always_touch(model, pairs, carried=False)]


def _collide_by_kind(model: mujoco.MjModel, pairs: Pairs) -> npt.NDArray[np.bool_]:
    """Flags (K,) of the pairs that collide by contype and conaffinity, and whose bodies are not excluded."""
    kinds, others = model.geom_contype[pairs], model.geom_conaffinity[pairs]
    low, high = np.sort(model.geom_bodyid[pairs].astype(np.int64), axis=1).T
    touch = (kinds[:, 0] & others[:, 1]) | (others[:, 0] & kinds[:, 1]) != 0
    return touch & ~np.isin(low << 16 | high, model.exclude_signature)


def _are_stated(model: mujoco.MjModel, pairs: Pairs) -> npt.NDArray[np.bool_]:
    """Flags (K,) of the pairs that are pairs in the MJCF."""
    stated = np.stack([model.pair_geom1, model.pair_geom2], axis=1).astype(np.int64)
    low, high = np.sort(pairs, axis=1).T
    return np.isin(low * model.ngeom + high, np.sort(stated, axis=1) @ [model.ngeom, 1])


def pairs_of(model: mujoco.MjModel, obstacles: list[int]) -> Pairs:
    """The pairs whose distances matter: those that MuJoCo lets collide and that do not always touch.

    A link that turns on a pedestal touches it always: no plan can avoid that, and it is no collision. Of an obstacle
    without such pairs, which the user has chosen by name or by a rule, all pairs matter.
    """
    pairs = touching_pairs(model, obstacles)
    pairs = pairs[~_always_touch(model, pairs)]
    untouched = sorted(set(obstacles) - set(pairs[:, 1].tolist()))
    if untouched:
        moving = solid_geoms(model)
        extra = np.stack(np.meshgrid(moving, untouched, indexing="ij"), axis=-1).reshape(-1, 2)
        pairs = np.concatenate([pairs, extra])
    return pairs


def solid_geoms(model: mujoco.MjModel) -> npt.NDArray[np.intp]:
    """Ids of the moving geoms that can collide; of all moving geoms if none can."""
    moves = model.body_weldid[model.geom_bodyid] != 0
    solid = moves & colliding(model)
    return np.flatnonzero(solid if solid.any() else moves)


def _base(model: mujoco.MjModel) -> set[int]:
    """The bodies that carry the moving bodies, up to the world, and everything fixed to the last of these."""
    fixed, parents = model.body_weldid == 0, model.body_parentid.tolist()
    mounts = {parents[body] for body in np.flatnonzero(~fixed).tolist() if fixed[parents[body]]} - {0}
    base = {link for body in mounts for link in carriers(model, body)}
    for body in range(1, model.nbody):  # children come after their parents
        if fixed[body] and parents[body] in mounts:
            mounts.add(body)
    return base | mounts


def _ground(model: mujoco.MjModel, data: mujoco.MjData) -> set[int]:
    """Ids of level planes that face up, and of height fields."""
    planes = (model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)) & (data.geom_xmat[:, 8] > _LEVEL)
    return set(np.flatnonzero(planes | (model.geom_type == int(mujoco.mjtGeom.mjGEOM_HFIELD))).tolist())


def _touch(model: mujoco.MjModel, data: mujoco.MjData, pairs: Pairs) -> npt.NDArray[np.bool_]:
    """Flags (K,) of the pairs whose geoms touch or overlap."""
    touching, sizes = np.zeros(len(pairs), dtype=bool), model.geom_rbound[pairs]
    apart = np.linalg.norm(data.geom_xpos[pairs[:, 0]] - data.geom_xpos[pairs[:, 1]], axis=1) - sizes.sum(axis=1)
    for k in np.flatnonzero((apart < _TOUCHING) | (sizes == 0).any(axis=1)):  # planes have no size
        touching[k] = _close(model, data, pairs[k])
    return touching


def _close(model: mujoco.MjModel, data: mujoco.MjData, pair: Pairs) -> bool:
    return mujoco.mj_geomDistance(model, data, *pair.tolist(), 2 * _TOUCHING, None) < _TOUCHING


def _always_touch(model: mujoco.MjModel, pairs: Pairs, *, carried: bool = True) -> npt.NDArray[np.bool_]:
    """Flags (K,) of the pairs that touch in every position of the joints; without `carried`, of all but free joints."""
    if not len(pairs):
        return np.zeros(0, dtype=bool)
    always = _touch(model, placed(model), pairs)
    if carried:
        always &= ~_carried_by(model, pairs, _FREE)
    remaining = np.flatnonzero(always)
    for data in posed(model, _random_positions(model)) if len(remaining) else ():
        always[remaining] = [_close(model, data, pair) for pair in pairs[remaining]]
        remaining = remaining[always[remaining]]
        if not len(remaining):
            break
    return always


def _carried_by(model: mujoco.MjModel, pairs: Pairs, *kinds: int) -> npt.NDArray[np.bool_]:
    """Flags (K,) of the pairs whose moving geom is carried by a joint of one of these kinds."""
    bodies = model.geom_bodyid[pairs[:, 0]].tolist()
    moved = {body: any(kind in kinds for kind, _ in _joints(model, body)) for body in set(bodies)}
    return np.array([moved[body] for body in bodies], dtype=bool)


def _random_positions(model: mujoco.MjModel) -> Array:
    """Random positions (_POSITIONS, nq) of all joints but free ones; slides without a range are within 1 m of rest."""
    rng, positions = np.random.default_rng(0), np.tile(model.qpos0, (_POSITIONS, 1))
    slides = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    single = slides | (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    span, rest = np.where(slides, 1.0, np.pi), model.qpos0[model.jnt_qposadr]
    low, high = np.where(model.jnt_limited, model.jnt_range.T, [rest - span, rest + span])[:, single]
    positions[:, model.jnt_qposadr[single]] = rng.uniform(low, high, (_POSITIONS, len(low)))
    for first in model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_BALL]:
        turns = rng.standard_normal((_POSITIONS, 4))
        positions[:, first : first + 4] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    return positions


def _supports(model: mujoco.MjModel, pairs: Pairs) -> set[int]:
    """The obstacles of these pairs on which the other geom stands, if a free joint or a slide moves it over them.

    It stands there at rest; with a free joint, in a keyframe also counts.
    """
    floating, moving = _carried_by(model, pairs, _FREE), _carried_by(model, pairs, _FREE, _SLIDE)
    if not moving.any():
        return set()
    supports, reach = set[int](), _TOUCHING + 2 * _LOWERED
    for k, data in enumerate(posed(model, [model.qpos0, *model.key_qpos])):
        candidates = pairs[floating if k else moving]
        for geom, support in candidates[_touch(model, data, candidates)].tolist():
            gap = mujoco.mj_geomDistance(model, data, geom, support, reach, None)
            data.geom_xpos[support, 2] -= _LOWERED
            if mujoco.mj_geomDistance(model, data, geom, support, reach, None) - gap > _CARRIES * _LOWERED:
                supports.add(support)
            data.geom_xpos[support, 2] += _LOWERED
    return supports


def _joints(model: mujoco.MjModel, body: int) -> Iterator[tuple[int, int]]:
    """The kind and number of each joint between a body and the world."""
    for link in carriers(model, body):
        first, count = int(model.body_jntadr[link]), int(model.body_jntnum[link])
        yield from ((int(model.jnt_type[joint]), joint) for joint in range(first, first + count))


def _sinks(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> bool:
    """Whether a body can sink: it, or a body that carries it, has a free joint or a slide that is not level."""
    upward = np.abs(data.xaxis[:, 2]) > 1e-9
    return any(kind == _FREE or (kind == _SLIDE and upward[joint]) for kind, joint in _joints(model, body))
