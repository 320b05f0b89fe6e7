"""The obstacles of a robot that consists of all moving bodies of an MJCF, and its geoms that can touch them."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError
from lqrsim.scenes.mjcf_joints import placed
from lqrsim.scenes.world import KINDS, World

_FREE, _SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)

Pairs = npt.NDArray[np.int64]  # (K, 2), the robot's geom and the obstacle's geom

_LONG = 1e3  # m, half length of a geom that stands for an infinite one
_NEAR = 1e-3  # m; a geom nearer to another touches it
_LEVEL = 1 - 1e-9  # the least vertical part of the normal of a plane that is level
_LOWERED, _CARRIES = 1e-3, 0.7  # m; a geom carries another if lowering it by this widens the gap by this share or more
_POSITIONS = 64  # random positions of joints in which a geom must touch what carries it


def with_obstacles(xml: str, world: World) -> str:
    """The MJCF with these obstacles as further geoms, fixed to the world, which nothing touches.

    Raises:
      InputError: an obstacle is of a kind of which MuJoCo needs more than its size, or has the name of a geom.
    """
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
        numbers = {"size": size, "pos": one.position, "quat": turn}
        texts = {key: " ".join(repr(number) for number in values.tolist()) for key, values in numbers.items()}
        own = {"name": one.name, "type": one.kind, "contype": "0", "conaffinity": "0"}
        ElementTree.SubElement(section, "geom", own | texts)
    return ElementTree.tostring(root, encoding="unicode")


def in_the_way(model: mujoco.MjModel, candidates: list[int], body: int, *, floors: bool) -> list[int]:
    """The candidates (ids of geoms fixed to the world) that are obstacles to the robot.

    They are those of `touchable`, except its own base, and a floor that it touches at rest.

    Args:
      body: the robot's first that moves. floors: whether there may be ground for standing on.
    """
    data, base, bodies, pairs = placed(model), _base(model), model.geom_bodyid.tolist(), touching_pairs
    level, stood_on = set[int](), set[int]()
    if floors:
        level, stood_on = _ground(model, data), _supports(model, pairs(model, candidates))
    return [
        geom
        for geom in touchable(model, candidates, body, floors=floors)
        if bodies[geom] not in base
        and geom not in stood_on
        and not (geom in level and _touch(model, data, pairs(model, [geom])).any())
    ]


def touchable(model: mujoco.MjModel, candidates: list[int], body: int, *, floors: bool) -> list[int]:
    """The candidates that MuJoCo lets the robot touch, except ground and what only carries it.

    Ground is a floor that the robot can sink to, and what it stands on and can move over.

    Args:
      body, floors: as of `in_the_way`. A free joint, or a slide that is not level, lets it sink.
    """
    data, touched = placed(model), set(avoidable_pairs(model, candidates)[:, 1].tolist())
    ground = set[int]()
    if floors:
        pairs = touching_pairs(model, candidates)
        own = model.body_rootid[model.geom_bodyid[pairs[:, 0]]] == model.body_rootid[body]
        ground = (_ground(model, data) if _sinks(model, data, body) else ground) | _supports(model, pairs[own])
    return [geom for geom in candidates if geom in touched and geom not in ground]


def avoidable_pairs(model: mujoco.MjModel, obstacles: list[int]) -> Pairs:
    """The pairs that MuJoCo lets collide, except those that touch in every position of the joints.

    A link that turns on a pedestal touches it always: no plan can avoid that, and it is no collision.
    """
    pairs = touching_pairs(model, obstacles)
    return pairs[~_always_touch(model, pairs)]


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
    """The pairs whose distances matter: `avoidable_pairs`, and all pairs with an obstacle that has none of these.

    The user has chosen such an obstacle by name or by a rule.
    """
    pairs = avoidable_pairs(model, obstacles)
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


def _touch(model: mujoco.MjModel, data: mujoco.MjData, pairs: Pairs) -> npt.NDArray[np.bool_]:
    """Flags (K,) of the pairs whose geoms touch or overlap."""
    found, sizes = np.zeros(len(pairs), dtype=bool), model.geom_rbound[pairs]
    apart = np.linalg.norm(data.geom_xpos[pairs[:, 0]] - data.geom_xpos[pairs[:, 1]], axis=1) - sizes.sum(axis=1)
    for k in np.flatnonzero((apart < _NEAR) | (sizes == 0).any(axis=1)):  # planes have no size
        found[k] = mujoco.mj_geomDistance(model, data, *pairs[k].tolist(), 2 * _NEAR, None) < _NEAR
    return found


def _always_touch(model: mujoco.MjModel, pairs: Pairs) -> npt.NDArray[np.bool_]:
    """Flags (K,) of the pairs that touch in every position of the joints that carry the moving geom."""
    data = placed(model)
    always = _touch(model, data, pairs)
    always &= ~_moved_by(model, pairs, _FREE)
    rng, kept = np.random.default_rng(0), np.flatnonzero(always)
    for _ in range(_POSITIONS):
        if not len(kept):
            break
        data.qpos[:] = _random_position(model, rng)
        mujoco.mj_kinematics(model, data)
        always[kept] = _touch(model, data, pairs[kept])
        kept = kept[always[kept]]
    return always


def _moved_by(model: mujoco.MjModel, pairs: Pairs, *kinds: int) -> npt.NDArray[np.bool_]:
    """Flags (K,) of the pairs whose moving geom is carried by a joint of one of these kinds."""
    bodies = model.geom_bodyid[pairs[:, 0]].tolist()
    moved = {body: any(kind in kinds for kind, _ in _joints(model, body)) for body in set(bodies)}
    return np.array([moved[body] for body in bodies], dtype=bool)


def _random_position(model: mujoco.MjModel, rng: np.random.Generator) -> Array:
    """Random positions (nq,) of all joints; slides without a range move up to 1 m."""
    qpos = model.qpos0.copy()
    for joint, kind in enumerate(model.jnt_type):
        first = int(model.jnt_qposadr[joint])
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            turn = rng.standard_normal(4)
            qpos[first : first + 4] = turn / np.linalg.norm(turn)
        elif kind != _FREE:
            span = 1.0 if kind == mujoco.mjtJoint.mjJNT_SLIDE else np.pi
            low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-span, span)
            qpos[first] = rng.uniform(low, high)
    return qpos


def _supports(model: mujoco.MjModel, pairs: Pairs) -> set[int]:
    """The obstacles of these pairs on which the other geom stands, if a free joint or a slide moves it over them.

    It stands there at rest; with a free joint, in a keyframe also counts.
    """
    data, found, far = mujoco.MjData(model), set[int](), _NEAR + 2 * _LOWERED
    floating, moving = _moved_by(model, pairs, _FREE), _moved_by(model, pairs, _FREE, _SLIDE)
    for qpos, own in ((model.qpos0, pairs[moving]), *((one, pairs[floating]) for one in model.key_qpos)):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for one, other in own[_touch(model, data, own)].tolist():
            before = mujoco.mj_geomDistance(model, data, one, other, far, None)
            data.geom_xpos[other, 2] -= _LOWERED
            if mujoco.mj_geomDistance(model, data, one, other, far, None) - before > _CARRIES * _LOWERED:
                found.add(other)
            data.geom_xpos[other, 2] += _LOWERED
    return found


def _joints(model: mujoco.MjModel, body: int) -> Iterator[tuple[int, int]]:
    """The kind and number of each joint between a body and the world."""
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        yield from ((int(model.jnt_type[joint]), joint) for joint in range(first, first + count))
        body = int(model.body_parentid[body])


def _sinks(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> bool:
    """Whether a body can sink: it, or a body that carries it, has a free joint or a slide that is not level."""
    upward = np.abs(data.xaxis[:, 2]) > 1e-9
    return any(kind == _FREE or (kind == _SLIDE and upward[joint]) for kind, joint in _joints(model, body))
