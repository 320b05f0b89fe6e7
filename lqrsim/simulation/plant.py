"""A robot in a scene: the MuJoCo model that is run, where the robot is in it, and whether it moves as it should."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco import batch

from lqrsim import compiled
from lqrsim.errors import Array, InputError, check_array, check_count, check_number, excerpt
from lqrsim.robots.base import Robot
from lqrsim.scenes import Scene, obstacle_geoms
from lqrsim.world import World

Indices = npt.NDArray[np.intp]


class Plant:
    """A robot in a scene, ready to run.

    Attributes:
      robot, scene: what it is made of.
      world: the obstacles that bound the robot's position; none without one.
      obstacles: names of what the robot can collide with: those; without a position all but level planes.
      model: the compiled scene, with a contact sensor for each obstacle.
      body: id of the robot's body. qpos, qvel, ctrl: where its joints' and actuators' numbers are in MuJoCo's arrays.
      contact: where the contact sensors are in MuJoCo's `sensordata`; positive while the robot touches the obstacle.
      timestep: of the physics, in seconds.

    Raises:
      InputError: there is no such robot in the scene: its body, a joint, an actuator or a wheel is missing.
    """

    def __init__(self, robot: Robot, scene: Scene) -> None:
        wanted = {
            "body": ([robot.body], [scene.model.body(i).name for i in range(scene.model.nbody)]),
            "joint": (robot.joints, [scene.model.joint(i).name for i in range(scene.model.njnt)]),
            "actuator": (robot.actuators, [scene.model.actuator(i).name for i in range(scene.model.nu)]),
            "geom": (robot.wheels, [scene.model.geom(i).name for i in range(scene.model.ngeom)]),
        }
        for kind, (names, present) in wanted.items():
            for name in names:
                if name not in present:
                    has = ", ".join(filter(None, present)) or "none"
                    raise InputError(
                        f"scene {scene.name}: got no robot {robot.name} in it, want its {kind} {name!r}; it has: {has}"
                    )
        dimension = len(robot.dynamics.state_coordinates.position)
        self.robot, self.scene = robot, scene
        self.world = scene.world.seen_by(dimension) if dimension else World()
        self.obstacles = self.world.names if dimension else _upright(scene.world)
        self.model = self._compile()
        joints = [self.model.joint(name) for name in robot.joints]
        self.body = int(self.model.body(robot.body).id)
        self.qpos = _ranges((joint.qposadr[0], joint.qpos0.size) for joint in joints)
        self.qvel = _ranges((joint.dofadr[0], joint.damping.size) for joint in joints)
        self.ctrl = np.array([self.model.actuator(name).id for name in robot.actuators], dtype=np.intp)
        self.contact = np.arange(self.model.nsensordata - len(self.obstacles), self.model.nsensordata)

    @property
    def timestep(self) -> float:
        return float(self.model.opt.timestep)

    def substeps(self, period: float) -> int:
        """Physics steps in a control period of that many seconds. Raises InputError if it is no multiple of one."""
        steps = check_number("control period", period, above=0.0) / self.timestep
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6 * steps:
            raise InputError(
                f"control period: got {period:g} s, want a multiple of the physics step of scene {self.scene.name},"
                f' {self.timestep:g} s; or set <option timestep="{period / max(round(steps), 1):.17g}"/> there'
            )
        return round(steps)

    @cached_property
    def without_contacts(self) -> mujoco.MjModel:
        """The same model, but that the robot goes through the obstacles, and nothing says whether it touches them."""
        return self._compile(contacts=False)

    @cached_property
    def enclosed(self) -> bool:
        """Whether the robot touches nothing at a clearance above 0: all of it that collides is within its radius."""
        return not self.obstacles or (len(self.world) > 0 and extent(self) <= self.robot.radius * (1 + 1e-9))

    def clearance(self, states: npt.ArrayLike, displaced: Array | None = None) -> Array:
        """Signed distance to the nearest obstacle minus the robot's radius in metres, (...), at states (..., n).

        Args:
          displaced: (K, obstacles, 3), by how much obstacles are elsewhere in each trial; states are then (K, k, n).
        """
        states = np.asarray(states, dtype=np.float64)
        return self.clearance_at(states[..., list(self.robot.dynamics.state_coordinates.position)], displaced)

    def clearance_at(self, position: Array, displaced: Array | None = None) -> Array:
        """The same at positions (..., 2 or 3)."""
        if not len(self.world):
            return np.full(position.shape[:-1], np.inf)
        if displaced is None or not displaced.any():
            return compiled.signed_distance(self.world, position) - self.robot.radius
        return compiled.signed_distance_displaced(self.world, position, displaced) - self.robot.radius

    def displace(self, simulations: batch.Batch, displaced: Array) -> None:
        """Move the obstacles of each simulation by (K, obstacles, 3) metres, world axes; `set_const` must follow."""
        places, drawn = simulations.expand("geom_pos"), mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, drawn)
        for number, name in enumerate(self.world.names):
            geom = self.model.geom(name)
            places[:, geom.id] += displaced[:, number] @ drawn.xmat[geom.bodyid[0]].reshape(3, 3)

    def _compile(self, *, contacts: bool = True) -> mujoco.MjModel:
        spec = mujoco.MjSpec.from_string(self.scene.xml)
        # The sensors need names; geoms without one get the obstacle's. A geom's id is its place in the compiled model.
        spec.compile()
        geoms = {geom.id: geom for geom in spec.geoms}
        for geom, obstacle in zip(obstacle_geoms(self.scene.model), self.scene.world.obstacles, strict=True):
            geoms[geom].name = obstacle.name
        for name in self.obstacles:
            if not contacts:
                geom = next(geom for geom in spec.geoms if geom.name == name)
                geom.contype = geom.conaffinity = 0
                continue
            spec.add_sensor(
                name=f"contact with {name}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_XBODY,  # the robot's body and what is attached to it
                objname=self.robot.body,
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname=name,
                # What to report, how to sort, how many.
                intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1],
            )
        return spec.compile()


@dataclass(frozen=True)
class PlantCheck:
    """How far MuJoCo moves a robot from where its dynamics say, over one control period.

    Attributes:
      names, units: of the states. errors: (n,) the largest difference of each over the samples, in its unit.
      changes: (n,) the largest change that the dynamics predict for it. period: in seconds.
      state, control: where the worst state of all was furthest off. simulated, predicted: (n,) what came of it.
      tolerance: what `relative` must not exceed.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    errors: Array
    changes: Array
    period: float
    state: Array
    control: Array
    simulated: Array
    predicted: Array
    tolerance: float

    @property
    def relative(self) -> Array:
        """(n,) errors relative to the changes; where next to nothing changes, to the largest change of all."""
        return self.errors / np.maximum(self.changes, 1e-3 * np.nanmax(self.changes, initial=1e-12))

    @property
    def worst(self) -> str:
        """The name of the state that is furthest off, relative to its change."""
        return self.names[int(np.argmax(self.relative))]

    @property
    def good(self) -> bool:
        """Whether every state is within the tolerance."""
        return bool((self.relative <= self.tolerance).all())

    def __str__(self) -> str:
        i = self.names.index(self.worst)
        width = max(len(name) for name in self.names)
        lines = [f"{'state':<{width}} {'error':>10} {'of change':>10}  over one period of {self.period:.4g} s"]
        lines += [
            f"{name:<{width}} {error:>10.2e} {relative:>10.2e}  {unit}"
            for name, unit, error, relative in zip(self.names, self.units, self.errors, self.relative, strict=True)
        ]
        lines.append(
            f"{'agrees' if self.good else 'DISAGREES'} (tolerance {self.tolerance:g} of the change); worst state:"
            f" {self.worst}, MuJoCo {self.simulated[i]:.6g}, dynamics {self.predicted[i]:.6g},"
            f" from x = {np.array2string(self.state, precision=3)}, u = {np.array2string(self.control, precision=3)}"
        )
        return "\n".join(lines)


def check_plant(
    robot: Robot,
    scene: Scene,
    *,
    period: float | None = None,
    around: npt.ArrayLike | None = None,
    spread: float = 0.3,
    controls: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
    settle: float | None = None,
    samples: int = 50,
    tolerance: float = 0.02,
    seed: int = 0,
) -> PlantCheck:
    """Compare a robot's dynamics with its MJCF: from random states, one control period of each.

    Obstacles are taken away for it. A mass, a sign or a unit that differs shows in the states that it acts on.

    Args:
      period: in seconds, a multiple of the physics step; by default that nearest to 0.02 s.
      around: (n,) the middle of the random states, zero by default. spread: their standard deviation in each unit.
      controls: lowest and highest random control (m,); by default the dynamics' limits.
      settle: seconds under the control before the comparison, for velocities that MuJoCo has and the dynamics do not
        (those of wheels, say); by default 0.5 where MuJoCo has more of them than the dynamics have states, else 0.
      samples: how many states. tolerance: of an error, relative to the largest change of that state. seed: of all.

    Raises:
      InputError: the robot is not in the scene, an argument is not as described, or the controls have no limits.
    """
    if not isinstance(robot, Robot) or not isinstance(scene, Scene):
        got = f"{excerpt(robot)} and {excerpt(scene)}"
        raise InputError(
            f"check_plant: got {got}, want a robot and a scene, such as Quadrotor() and load_scene('cage')"
        )
    plant = Plant(robot, scene)
    period = max(1, round(0.02 / plant.timestep)) * plant.timestep if period is None else period
    substeps = plant.substeps(period)
    dynamics = robot.dynamics
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    middle = check_array("around", np.zeros(n) if around is None else around, (n,))
    space = dynamics.control_coordinates
    if controls is not None and (not isinstance(controls, tuple | list) or len(controls) != 2):
        raise InputError(f"controls: got {excerpt(controls)}, want (lowest, highest), each ({m},)")
    low, high = (space.low, space.high) if controls is None else controls
    low, high = (
        check_array("controls: lowest", low, (m,), infinite=True),
        check_array("controls: highest", high, (m,), infinite=True),
    )
    if not (low <= high).all():
        raise InputError(f"controls: got {low.tolist()} to {high.tolist()}, want the lowest first")
    if not np.isfinite([low, high]).all():
        raise InputError(f"controls: got {robot.name}'s limits, which are infinite, want controls=(lowest, highest)")
    for name in plant.world.names:
        geom = plant.model.geom(name)
        geom.contype[:], geom.conaffinity[:] = 0, 0
    rng, data = np.random.default_rng(check_count("seed", seed, at_least=0)), mujoco.MjData(plant.model)
    check_number("spread", spread, at_least=0.0)
    if settle is None:
        settle = 0.5 if 2 * len(plant.qvel) > n else 0.0
    waiting = round(check_number("settle", settle, at_least=0.0) / plant.timestep)
    found = []
    for _ in range(check_count("samples", samples)):
        state, control = middle + spread * rng.normal(size=n), rng.uniform(low, high)
        mujoco.mj_resetData(plant.model, data)
        data.qpos[plant.qpos], data.qvel[plant.qvel] = robot.configuration(state)
        data.ctrl[plant.ctrl] = robot.actuation(control)
        for _ in range(waiting):
            mujoco.mj_step(plant.model, data)
        before = robot.state(data.qpos[plant.qpos], data.qvel[plant.qvel], near=state)
        for _ in range(substeps):
            mujoco.mj_step(plant.model, data)
        predicted = dynamics.step(before, control, period)
        simulated = robot.state(data.qpos[plant.qpos], data.qvel[plant.qvel], near=predicted)
        found.append((before, control, simulated, predicted))
    errors = np.array([np.abs(simulated - predicted) for _, _, simulated, predicted in found])
    changes = np.array([np.abs(predicted - before) for before, _, _, predicted in found])
    state, control, simulated, predicted = found[0]
    check = PlantCheck(
        names=dynamics.state_coordinates.names, units=dynamics.state_coordinates.units, errors=errors.max(axis=0),
        changes=changes.max(axis=0), period=period, state=state, control=control, simulated=simulated,
        predicted=predicted, tolerance=check_number("tolerance", tolerance, above=0.0),
    )  # fmt: skip
    at = int(errors[:, check.names.index(check.worst)].argmax())
    state, control, simulated, predicted = found[at]
    return replace(check, state=state, control=control, simulated=simulated, predicted=predicted)


def extent(plant: Plant) -> float:
    """How far from its position the robot can touch something, at most, in metres; a bound, and exact for balls.

    Seen from above by robots in the plane. Parts that move count wherever they can get, whatever their joints' limits.
    """
    model, data, dynamics = plant.model, mujoco.MjData(plant.model), plant.robot.dynamics
    place, rng = list(dynamics.state_coordinates.position), np.random.default_rng(0)
    axes = slice(0, len(place))  # of the world, along which the position is
    off, states = 0.0, rng.standard_normal((9, len(dynamics.state_coordinates)))
    states[-1] = 0.0  # the last, in which the geoms are looked at below
    for state in states:
        data.qpos[plant.qpos], data.qvel[plant.qvel] = plant.robot.configuration(state)
        mujoco.mj_kinematics(model, data)
        off = max(off, float(np.linalg.norm(data.xpos[plant.body, axes] - state[place])))
    obstacles = [model.geom(name).id for name in plant.obstacles]
    thick = model.geom_margin + model.geom_gap  # at which MuJoCo sees a contact
    thickest = max(thick[obstacles].max(initial=0.0), (model.pair_margin + model.pair_gap).max(initial=0.0))
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    collides[model.pair_geom1], collides[model.pair_geom2] = True, True
    reach = 0.0
    for geom in np.flatnonzero(collides):
        path = [int(model.geom_bodyid[geom])]
        while path[-1] not in (0, plant.body):
            path.append(int(model.body_parentid[path[-1]]))
        if path[-1] != plant.body:
            continue
        size, kind = float(model.geom_rbound[geom]) or np.inf, model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_CYLINDER and len(place) == 2 and abs(data.geom_xmat[geom][8]) > 1 - 1e-9:
            size = float(model.geom_size[geom, 0])  # upright: its outline from above
        own, jointed = np.linalg.norm(model.geom_pos[geom]), False
        for body in path[:-1]:
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            jointed |= count > 0
            own += np.linalg.norm(model.body_pos[body])
            for joint in range(first, first + count):
                slides = model.jnt_type[joint] in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_FREE)
                own += np.inf if slides else 2 * np.linalg.norm(model.jnt_pos[joint])
        if not jointed:
            own = np.linalg.norm((data.geom_xpos[geom] - data.xpos[plant.body])[axes])
        reach = max(reach, float(own) + size + float(thick[geom]))
    return off + reach + float(thickest)


def _upright(world: World) -> tuple[str, ...]:
    """Names of the obstacles but for level planes, on which what has no position may stand."""
    level = [one.kind == "plane" and abs(one.rotation[2, 2]) > 1 - 1e-9 for one in world.obstacles]
    return tuple(name for name, lies in zip(world.names, level, strict=True) if not lies)


def _ranges(starts_and_sizes: Iterable[tuple[int, int]]) -> Indices:
    return np.concatenate([np.arange(start, start + size) for start, size in starts_and_sizes], dtype=np.intp)
