"""Checks that a robot fits a scene: its names exist, its maps fit MuJoCo's arrays, and its body is at its position."""

import itertools
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from lqrsim.errors import Array, InputError, check_kind, check_number, excerpt
from lqrsim.problem.collision_shape import CollisionSpheres, ShapeInWorld
from lqrsim.results.coordinates import Coordinates
from lqrsim.robots.base import Robot, indices_in
from lqrsim.scenes.scene import Scene
from lqrsim.scenes.world import PLANES, SPACE

OFF = 1e-4  # allowed error in m of positions, and of moves by a metre; numbers in an MJCF have six digits
UNLIMITED = 1e9  # used for an infinite limit of a control
MIXED = 10  # largest number of controls for which all corners of the limits are checked


def check_names(robot: Robot, scene: Scene) -> None:
    """Raise InputError unless the robot's body, joints, actuators and wheels are in the scene by their names.

    Its radius and its drag must not be negative, and its balls must be CollisionSpheres.
    """
    if getattr(robot, "radius", None) is None:
        size = "of its collision circle or ball; without position and balls, its size in pictures"
        raise InputError(f"robot {robot.name}: radius: got none, want a number >= 0, in m: {size}")
    check_number(f"robot {robot.name}: radius", robot.radius, at_least=0.0)
    check_number(f"robot {robot.name}: drag", robot.drag, at_least=0.0)
    kinds, wanted_balls = (CollisionSpheres, type(None)), "CollisionSpheres(places, radii), or None"
    check_kind(f"robot {robot.name}: balls", robot.balls, kinds, wanted_balls)
    model = scene.model
    wanted = {
        "body": ("body", [robot.body], model.nbody),
        "joint": ("joints", robot.joints, model.njnt),
        "actuator": ("actuators", robot.actuators, model.nactuator),
        "geom": ("wheels", robot.wheels, model.ngeom),
    }
    for kind, (field, names, count) in wanted.items():
        if isinstance(names, str) or not all(isinstance(name, str) and name for name in names):
            raise InputError(f"robot {robot.name}: {field}: got {excerpt(names)}, want names of the MJCF in a tuple")
        if len(set(names)) != len(names):
            raise InputError(f"robot {robot.name}: {field}: got a name twice in {', '.join(names)}, want each once")
        elements = [getattr(model, kind)(number).name for number in range(count)]
        for name in names:
            if name not in elements:
                wanted_name = f"its {kind} {name!r}; it has: {_present(kind, elements)}"
                raise InputError(f"scene {scene.name}: got no robot {robot.name} in it, want {wanted_name}")


def _present(kind: str, names: list[str]) -> str:
    """What an MJCF has of a kind, for a message: names, and the numbers of joints and actuators without one."""
    named = [name for name in names if name]
    nameless = [str(number) for number, name in enumerate(names) if not name]
    if not nameless or kind not in ("joint", "actuator"):
        return ", ".join(named) or "none"
    which = f"{kind} {nameless[0]} has" if len(nameless) == 1 else f"{kind}s {', '.join(nameless)} have"
    listed = ", ".join([*named, f"{len(nameless)} without a name"])
    return f"{listed} ({which} none, counted from 0: name them there)"


def check_maps(robot: Robot, scene: Scene, model: mujoco.MjModel, shape: ShapeInWorld, *, clips: bool) -> None:
    """Raise InputError unless the robot's maps fit the model, and its body and balls are where its states say.

    With `clips`, MuJoCo applies the controls, and clips those that exceed an actuator's ctrlrange.
    """
    in_qpos, in_qvel, in_ctrl = indices_in(robot, model)
    n, m = len(robot.dynamics.state_coordinates), len(robot.dynamics.control_coordinates)
    qpos, qvel = (np.asarray(part) for part in robot.configuration(np.zeros(n)))
    joints, actuators = ", ".join(robot.joints) or "no joints", ", ".join(robot.actuators) or "no actuators"
    for field, got, want, of in (
        ("configuration: qpos", qpos, len(in_qpos), joints),
        ("configuration: qvel", qvel, len(in_qvel), joints),
        ("actuation", np.asarray(robot.actuation(np.zeros(m))), len(in_ctrl), actuators),
        ("state", np.asarray(robot.state(qpos, qvel)), n - robot.activations, "its dynamics"),
    ):
        if got.shape != (want,):
            raise InputError(f"robot {robot.name}: {field}: got shape {got.shape}, want ({want},) for {of}")
    if clips:
        _check_limits(robot, scene, model)
    if robot.dynamics.state_coordinates.position:
        _check_position(robot, model)
    if robot.balls is not None:
        _check_sites(robot, model, robot.balls, in_plane=shape.in_plane)


def _check_limits(robot: Robot, scene: Scene, model: mujoco.MjModel) -> None:
    """Raise InputError if a control within its limits gives a command that exceeds an actuator's ctrlrange.

    MuJoCo would clip it silently, and records of applied controls would be wrong.
    """
    space, (_, _, ctrl) = robot.dynamics.control_coordinates, indices_in(robot, model)
    m = len(space)
    finite = np.clip(space.limits, -UNLIMITED, UNLIMITED)
    if m <= MIXED:  # every corner, because actuation may mix controls
        which = np.array(list(itertools.product((0, 1), repeat=m)))
        corners = np.take_along_axis(finite, which, axis=0)
    else:
        corners = np.repeat(np.clip(0.0, *finite)[None], 2 * m, axis=0)
        for k in range(m):
            corners[2 * k : 2 * k + 2, k] = finite[:, k]
    commands = np.asarray(robot.actuation(corners), dtype=np.float64)
    if commands.shape != (len(corners), len(ctrl)):
        return  # the map takes one control only; running it raises an error
    low, high = model.actuator_ctrlrange[ctrl].T
    spare = 1e-9 * np.maximum(np.abs(low), np.abs(high))
    exceeds = model.actuator_ctrllimited[ctrl].astype(bool) & ~((commands >= low - spare) & (commands <= high + spare))
    if exceeds.any():
        row, k = (int(place) for place in np.argwhere(exceeds)[0])
        controls = ", ".join(f"{name} {float(value):g}" for name, value in zip(space.names, corners[row], strict=True))
        name = scene.mjcf.controls[ctrl[k]].name
        got = f"controls ({controls}), for which actuation() commands {commands[row, k]:g} of actuator {name!r}"
        own = f"its ctrlrange in the MJCF, {low[k]:g} to {high[k]:g}"
        raise InputError(f"robot {robot.name}: control_limits: got {got}, want {own}")


def _check_position(robot: Robot, model: mujoco.MjModel) -> None:
    """Raise InputError unless the body's origin is at the position, and moves with it, by MuJoCo's kinematics."""
    space, (in_qpos, _, _) = robot.dynamics.state_coordinates, indices_in(robot, model)
    n, data, number = len(space), mujoco.MjData(model), model.body(robot.body).id

    def body(state: Array) -> Array:
        data.qpos[in_qpos] = robot.configuration(state)[0]
        mujoco.mj_kinematics(model, data)
        return data.xpos[number].copy()

    # About a state without zeros, so that angles have an effect.
    middle = 0.1 + 0.01 * np.arange(n)
    moves = np.array([(body(middle + step) - body(middle - step)) / 2 for step in np.eye(n)[list(space.position)]])
    wanted = np.eye(3)[list(space.world_axes)]
    who = f"robot {robot.name}: position"
    names = [space.names[index] for index in space.position]
    if np.abs(moves - wanted).max() > OFF:
        raise InputError(f"{who}: got ({', '.join(names)}) in {_of(space)}; {_remedy(robot, names, moves)}")
    for state in (np.zeros(n), middle):
        place = state[list(space.position)]
        origin, said = body(state), space.in_world(place)
        off = origin - said
        if space.from_above:
            off[2] = 0.0  # its height is not known
        if np.abs(off).max() <= OFF:
            continue
        across = 3 - sum(space.world_axes) if len(names) == 2 else -1
        if across >= 0 and np.abs(np.delete(off, across)).max() <= OFF:
            raise InputError(
                f"{who}: got the plane {space.plane!r} at {SPACE[across]} = {said[across]:g} m, where MuJoCo has body"
                f" {robot.body!r} at {SPACE[across]} = {origin[across]:g} m; want offset={origin[across]:g}"
            )
        raise InputError(
            f"{who}: got {_point(place)} m in {_of(space)}, where MuJoCo has the origin of body {robot.body!r} at"
            f" {_point(origin)} m; want configuration() to put it there (slides count from the body's pos in the MJCF)"
        )


def anchor_of(model: mujoco.MjModel, site: str) -> Array:
    """The body id of a site or geom, and its position in the axes of that body, (4,)."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)
    if number >= 0:
        return np.array([model.site_bodyid[number], *model.site_pos[number]])
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, site)
    return np.array([model.geom_bodyid[number], *model.geom_pos[number]])


def _check_sites(robot: Robot, model: mujoco.MjModel, balls: CollisionSpheres, *, in_plane: bool) -> None:
    """Raise InputError unless each ball that names a site or a geom has its centre there in MuJoCo."""
    (in_qpos, _, _), data = indices_in(robot, model), mujoco.MjData(model)
    who, n = f"robot {robot.name}: balls", len(robot.dynamics.state_coordinates)
    names = [model.site(number).name for number in range(model.nsite)]
    names = list(filter(None, [*names, *(model.geom(number).name for number in range(model.ngeom))]))
    for site in filter(None, balls.sites):
        if site not in names:
            has = ", ".join(names) or "none"
            raise InputError(f"{who}: sites: got {excerpt(site)}, want a site or a geom of the MJCF; it has: {has}")
    anchors = [(k, site, anchor_of(model, site)) for k, site in enumerate(balls.sites) if site is not None]
    rng = np.random.default_rng(0)
    for state in (np.zeros(n), 0.1 + 0.01 * np.arange(n), *rng.uniform(-1.0, 1.0, (3, n))):
        data.qpos[in_qpos] = robot.configuration(state)[0]
        mujoco.mj_kinematics(model, data)
        centres = balls.centres(robot.dynamics, state) if anchors else ()
        for k, site, (body, *place) in anchors:
            position = data.xpos[int(body)] + data.xmat[int(body)].reshape(3, 3) @ place
            off = position - centres[k]
            if in_plane and robot.dynamics.state_coordinates.from_above:
                off[2] = 0.0  # its height is not known
            if not np.abs(off).max() <= OFF:
                got = f"{balls.ball_names[k]!r} at {_point(centres[k])} m in the state {_point(state)}"
                there = f"where MuJoCo has {site!r} at {_point(position)} m"
                raise InputError(f"{who}: got {got}, {there}; want them in the same place")


def _remedy(robot: Robot, names: list[str], jacobian: Array) -> str:
    """A message that says how each position state moves the body, and how to correct this."""
    exact = np.abs(np.round(jacobian) - jacobian).max() <= OFF
    rows = np.round(jacobian)
    directions = [_direction(row) for row in (rows if exact else jacobian)]
    moved = ", ".join(f"{name} along {direction}" for name, direction in zip(names, directions, strict=True))
    motion = f"MuJoCo moves body {robot.body!r} by a metre of {moved}"
    if exact and (np.abs(rows).sum(axis=1) == 1).all() and (rows.sum(axis=1) == 1).all():
        axes = "".join(SPACE[int(row.argmax())] for row in rows)
        space = robot.dynamics.state_coordinates
        if axes in PLANES:  # names such as x and z tell the plane, too
            others = "" if _accepts(space, plane=axes) else f", and names that tell it, such as ({', '.join(axes)})"
            return f"{motion}; want plane={axes!r}{others}"
        if sorted(axes) == sorted(SPACE):
            order = [axes.index(letter) for letter in SPACE]
            if _accepts(space, position=tuple(space.position[k] for k in order)):
                return f"{motion}; want position=({', '.join(repr(names[k]) for k in order)})"
    return f"{motion}; want each to move it by a metre along its own axis: check the joints and configuration()"


def _accepts(space: Coordinates, **changes: Any) -> bool:
    """Whether coordinates may be changed so: names such as x, y and z have to agree."""
    try:
        replace(space, **changes)
    except InputError:
        return False
    return True


def _of(space: Coordinates) -> str:
    return "space" if len(space.position) == 3 else f"the plane {space.plane!r}"


def _point(numbers: Any) -> str:
    return "(" + ", ".join(f"{number:.4g}" for number in numbers) + ")"


def _direction(row: Array) -> str:
    """A move in words: `+x`, `-z`, or by its numbers."""
    lengths = np.abs(row)
    if lengths.max() <= OFF:
        return "nothing"
    if np.count_nonzero(lengths > OFF) == 1 and abs(lengths.max() - 1) <= OFF:
        axis = int(lengths.argmax())
        return f"{'-' if row[axis] < 0 else '+'}{SPACE[axis]}"
    return _point(row)
