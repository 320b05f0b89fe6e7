"""The obstacles of a robot that consists of all moving bodies of an MJCF, and its geoms that can touch them."""

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array

Pairs = npt.NDArray[np.int64]  # (K, 2), the robot's geom and the obstacle's geom

_NEAR = 1e-3  # m; a geom nearer to the floor stands on it
_LEVEL = 1 - 1e-9  # the least vertical part of the normal of a plane that is level


def in_the_way(model: mujoco.MjModel, candidates: list[int], body: int, *, floors: bool) -> list[int]:
    """The candidates (ids of geoms fixed to the world) that are obstacles to the robot.

    They are those of `touchable`, except its own base, and a floor that it touches at rest.

    Args:
      body: the robot's first that moves. floors: whether level planes and height fields may be for standing on.
    """
    data, base, bodies = _at_rest(model), _base(model), model.geom_bodyid.tolist()
    ground = _ground(model, data) if floors else set[int]()
    return [
        geom
        for geom in touchable(model, candidates, body, floors=floors)
        if bodies[geom] not in base and not (geom in ground and _touches(model, data, geom))
    ]


def touchable(model: mujoco.MjModel, candidates: list[int], body: int, *, floors: bool) -> list[int]:
    """The candidates that MuJoCo lets the robot touch, except a floor that it can sink to.

    Args:
      body, floors: as of `in_the_way`. A free joint, or a slide that is not level, lets it sink.
    """
    data, touched = _at_rest(model), set(touching_pairs(model, candidates)[:, 1].tolist())
    ground = _ground(model, data) if floors and _sinks(model, data, body) else set[int]()
    return [geom for geom in candidates if geom in touched and geom not in ground]


def touching_pairs(model: mujoco.MjModel, obstacles: list[int]) -> Pairs:
    """The pairs of a moving geom and an obstacle that MuJoCo lets collide.

    They collide by contype and conaffinity, unless their bodies are excluded, or as a pair in the MJCF.
    """
    moving = np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0)
    fixed = np.array(obstacles, dtype=np.int64)
    kinds, others = model.geom_contype, model.geom_conaffinity
    touch = (kinds[moving][:, None] & others[fixed]) | (others[moving][:, None] & kinds[fixed]) != 0
    if model.nexclude:
        own, far = model.geom_bodyid[moving].astype(np.int64)[:, None], model.geom_bodyid[fixed].astype(np.int64)
        signs = np.minimum(own, far) << 16 | np.maximum(own, far)
        touch &= ~np.isin(signs, model.exclude_signature)
    rows, columns = (dict(zip(ids.tolist(), range(len(ids)), strict=True)) for ids in (moving, fixed))
    for one, other in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True):
        for mover, obstacle in ((one, other), (other, one)):
            if mover in rows and obstacle in columns:
                touch[rows[mover], columns[obstacle]] = True
    first, second = np.nonzero(touch)
    return np.stack([moving[first], fixed[second]], axis=1)


def pairs_of(model: mujoco.MjModel, obstacles: list[int]) -> Pairs:
    """The pairs whose distances matter: pairs that can touch, and all pairs with an obstacle that nothing can touch.

    The user has chosen such an obstacle by name or by a rule.
    """
    pairs = touching_pairs(model, obstacles)
    untouched = sorted(set(obstacles) - set(pairs[:, 1].tolist()))
    if untouched:
        moving = solid_geoms(model)
        extra = np.stack(np.meshgrid(moving, untouched, indexing="ij"), axis=-1).reshape(-1, 2)
        pairs = np.concatenate([pairs, extra])
    return pairs


def solid_geoms(model: mujoco.MjModel) -> npt.NDArray[np.intp]:
    """Ids of the moving geoms that can collide; of all moving geoms if none can."""
    moves = model.body_weldid[model.geom_bodyid] != 0
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return np.flatnonzero(moves & collides) if (moves & collides).any() else np.flatnonzero(moves)


def levers(model: mujoco.MjModel) -> Array:
    """The largest distance that any point of the robot moves per degree of freedom, (nv,): in m/rad, or 1 for slides.

    It holds for any joint angles. Slides between a joint and the body that it turns count with their range, or 1 m
    without a range.
    """
    reach, spans = np.zeros(model.nbody), np.zeros(model.nbody)
    found = np.ones(model.nv)
    for joint in range(model.njnt):
        spans[model.jnt_bodyid[joint]] += 2 * np.linalg.norm(model.jnt_pos[joint])
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            spans[model.jnt_bodyid[joint]] += np.abs(model.jnt_range[joint]).max() if model.jnt_limited[joint] else 1.0
    for geom in solid_geoms(model).tolist():
        body = int(model.geom_bodyid[geom])
        reach[body] = max(reach[body], float(np.linalg.norm(model.geom_pos[geom]) + model.geom_rbound[geom]))
    for body in range(model.nbody - 1, 0, -1):  # children come after their parents
        parent = int(model.body_parentid[body])
        reach[parent] = max(reach[parent], reach[body] + spans[body] + float(np.linalg.norm(model.body_pos[body])))
    for joint in range(model.njnt):
        kind, body, first = model.jnt_type[joint], int(model.jnt_bodyid[joint]), int(model.jnt_dofadr[joint])
        far = reach[body] + spans[body] + float(np.linalg.norm(model.jnt_pos[joint]))
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            found[first + 3 : first + 6] = far
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            found[first : first + 3] = far
        elif kind == mujoco.mjtJoint.mjJNT_HINGE:
            found[first] = far
    return found


def _base(model: mujoco.MjModel) -> set[int]:
    """The bodies that carry the moving bodies, up to the world, and everything fixed to the last of these."""
    fixed, base, carriers = model.body_weldid == 0, set[int](), set[int]()
    for body in np.flatnonzero(~fixed).tolist():
        above = int(model.body_parentid[body])
        if fixed[above] and above:
            carriers.add(above)
    for body in carriers:
        above = body
        while above:
            base.add(above)
            above = int(model.body_parentid[above])
    for body in range(1, model.nbody):  # children come after their parents
        if fixed[body] and int(model.body_parentid[body]) in carriers:
            carriers.add(body)
    return base | carriers


def _ground(model: mujoco.MjModel, data: mujoco.MjData) -> set[int]:
    """Ids of level planes that face up, and of height fields."""
    planes = (model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)) & (data.geom_xmat[:, 8] > _LEVEL)
    return set(np.flatnonzero(planes | (model.geom_type == int(mujoco.mjtGeom.mjGEOM_HFIELD))).tolist())


def _at_rest(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data


def _touches(model: mujoco.MjModel, data: mujoco.MjData, ground: int) -> bool:
    """Whether a moving geom touches a geom, or is inside it."""
    pairs = touching_pairs(model, [ground])[:, 0].tolist()
    return any(mujoco.mj_geomDistance(model, data, geom, ground, 2 * _NEAR, None) < _NEAR for geom in pairs)


def _sinks(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> bool:
    """Whether a body can sink: it, or a body that carries it, has a free joint or a slide that is not level."""
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        for joint in range(first, first + count):
            kind = model.jnt_type[joint]
            slides = kind == mujoco.mjtJoint.mjJNT_SLIDE and abs(data.xaxis[joint, 2]) > 1e-9
            if slides or kind == mujoco.mjtJoint.mjJNT_FREE:
                return True
        body = int(model.body_parentid[body])
    return False
