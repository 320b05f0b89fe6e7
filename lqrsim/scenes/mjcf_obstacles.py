"""The obstacles of a robot that consists of all moving bodies of an MJCF, and its geoms that can touch them."""

from collections.abc import Iterator

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Finite, checked
from lqrsim.errors import Array
from lqrsim.scenes.mjcf_kinematics import carriers, colliding, driven_trees, placed, posed

_FREE, _SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)

Pairs = npt.NDArray[np.int64]  # (K, 2), the robot's geom and the obstacle's geom

_TOUCHING = 1e-3  # m; a geom nearer to another touches it
_LEVEL = 1 - 1e-9  # the least vertical part of the normal of a plane that is level
_LOWERED, _CARRIES = 1e-3, 0.7  # m; a geom carries another if lowering it by this widens the gap by this share or more
_POSITIONS = 64  # random positions of joints in which a geom must touch what carries it


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


@checked
def distance_data(model: mujoco.MjModel, pairs: Pairs, rows: npt.NDArray[np.int64], count: int, reach: Finite) -> Array:
    """The data of `kernels/mjcf_dynamics.py`, except the address of p.

    The first geom of each of K pairs moves; `rows` (K,) are theirs, of `count`; `reach` is the largest distance in m.
    """
    bodies, radii = model.geom_bodyid[pairs], model.geom_rbound[pairs]  # that of a plane is 0
    planes = model.geom_type[pairs[:, 1]] == int(mujoco.mjtGeom.mjGEOM_PLANE)
    moving = np.where(model.body_weldid[bodies[:, 1]] != 0, bodies[:, 1], 0)
    columns = [rows, pairs[:, 0], bodies[:, 0], pairs[:, 1], radii.sum(axis=1), planes, moving]
    return np.concatenate([[count, len(pairs), reach], np.stack(columns, axis=1).astype(np.float64).ravel()])


def solid_geoms(model: mujoco.MjModel) -> npt.NDArray[np.intp]:
    """Ids of the moving geoms that can collide; of all moving geoms if none can."""
    moves = model.body_weldid[model.geom_bodyid] != 0
    solid = moves & colliding(model)
    return np.flatnonzero(solid if solid.any() else moves)


def levers(model: mujoco.MjModel) -> Array:
    """The most that any point of the robot moves per degree of freedom, (nv,), at any angles: m/rad, or 1 for slides.

    Slides between a joint and the body that it turns count with the farthest that their range lets them move from rest,
    or 1 m without a range.
    """
    reach, spans = np.zeros(model.nbody), np.zeros(model.nbody)
    arms = np.ones(model.nv)
    for joint in range(model.njnt):
        spans[model.jnt_bodyid[joint]] += 2 * np.linalg.norm(model.jnt_pos[joint])
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            moved = model.jnt_range[joint] - model.qpos0[model.jnt_qposadr[joint]]  # from rest, which is at `ref`
            spans[model.jnt_bodyid[joint]] += np.abs(moved).max() if model.jnt_limited[joint] else 1.0
    for geom in solid_geoms(model).tolist():
        body = int(model.geom_bodyid[geom])
        reach[body] = max(reach[body], float(np.linalg.norm(model.geom_pos[geom]) + model.geom_rbound[geom]))
    for body in range(model.nbody - 1, 0, -1):  # children come after their parents
        parent = int(model.body_parentid[body])
        reach[parent] = max(reach[parent], reach[body] + spans[body] + float(np.linalg.norm(model.body_pos[body])))
    for joint in range(model.njnt):
        kind, body, dof = model.jnt_type[joint], int(model.jnt_bodyid[joint]), int(model.jnt_dofadr[joint])
        lever = reach[body] + spans[body] + float(np.linalg.norm(model.jnt_pos[joint]))
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            arms[dof + 3 : dof + 6] = lever
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            arms[dof : dof + 3] = lever
        elif kind == mujoco.mjtJoint.mjJNT_HINGE:
            arms[dof] = lever
    return arms


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
