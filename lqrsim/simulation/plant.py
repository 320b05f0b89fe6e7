"""A robot in a scene: the MuJoCo model of both, and the places of the robot's states and actuators in it.

It is checked that the robot fits the scene: its names exist, its maps fit MuJoCo's arrays, and its body is at its
position. With a `Simulator`, the simulator moves the robot. The MuJoCo model then provides the obstacles and the
pictures.
"""

import copy
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco import batch

from lqrsim.annotations import checked
from lqrsim.errors import (
    Array,
    InputError,
    check_kind,
    check_number,
    check_text,
    excerpt,
    free_name,
    shaped,
    vectors_of,
)
from lqrsim.problem.collision_shape import CollisionSpheres, shape_in
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.pickles import OneVersion
from lqrsim.results.rollout import BallRecord
from lqrsim.robots.base import Robot, indices_in
from lqrsim.robots.sensors import RobotSensors, Sensor, ignore_timing
from lqrsim.scenes import mjcf_kinematics
from lqrsim.scenes.mjcf_model import compiled
from lqrsim.scenes.mujoco_log import unlogged
from lqrsim.scenes.scene import Pairs, Scene, mounting_pairs, obstacle_geoms, touchable, touching_pairs
from lqrsim.scenes.world import PLANES, SPACE, World
from lqrsim.simulation.simulator import Simulator

MOST_SUBSTEPS = 20_000  # physics steps in a control period
OFF = 1e-4  # allowed error in m of positions, and of moves by a metre; numbers in an MJCF have six digits
UNLIMITED = 1e9  # used for an infinite limit of a control
MIXED = 10  # largest number of controls for which all corners of the limits are checked


class Plant(OneVersion):
    """A robot in a scene, ready to run.

    Attributes:
      simulator: the simulator that moves the robot, such as `ls.simulators.RotorPy()`; None for MuJoCo.
      shape: the robot's geoms, its balls, or the ball at its position among the obstacles.
      world: the obstacles for it; none for a robot that has neither geoms nor balls nor a position.
      obstacles: names of the obstacles that the robot can collide with: those of `world`. Without a position, and for
        balls in space, all that the MJCF lets it touch, except what a free joint, or a slide that is not level, lets it
        stand on: level planes that face up, and height fields.
      obstacle_geoms: ids of the geoms of the obstacles in `world`.
      model: the compiled scene, with a contact sensor for each obstacle.
      body: id of the robot's body. bodies: ids of it, of those that the robot's joints move, and of what is attached.
      qpos, qvel, ctrl: indices of the robot's joints and controls in MuJoCo's arrays.
      actuators: ids of the robot's actuators, of which each has any number of controls.
      contact: indices of the contact sensors in MuJoCo's `sensordata`, one row for each of the robot's kinematic trees;
        positive while it touches the obstacle.
    """

    _prefix = ""
    _want = "a Plant, such as scenario.plant()"

    def __repr__(self) -> str:
        moved = "MuJoCo" if self.simulator is None else self.simulator.name
        return f"Plant({self.robot.name} in scene {self.scene.name}, moved by {moved})"

    @unlogged()
    @checked
    def __init__(self, robot: Robot, scene: Scene, simulator: Simulator | None = None) -> None:
        if simulator is not None:
            check_text("simulator: name", getattr(simulator, "name", None))
            check_number("simulator: timestep", getattr(simulator, "timestep", None), above=0.0)
        _check_names(robot, scene)
        self.robot, self.scene, self.simulator = robot, scene, simulator
        self._step: float | None = None  # s, in place of the timestep of the MJCF
        # The last undisturbed run of a plan's own policy: hash of the policy, the plan's states, and the run's.
        self.ran: tuple[str, bytes, Array | None] | None = None
        planned = scene if robot.geoms is None else robot.geoms.scene
        if planned is not scene and (planned.xml, planned.geoms) != (scene.xml, scene.geoms):
            raise InputError(f"scene {scene.name}: got a scene other than the robot's own, want robot.scene")
        self.shape = shape_in(robot.dynamics, scene.world, **robot.shape)
        in_space = self.shape.centers is not None and not self.shape.in_plane
        bounded = "radius" not in robot.shape or robot.dynamics.state_coordinates.position
        root, near = int(scene.model.body(robot.body).id), scene.world
        if in_space or not bounded:  # the obstacles that MuJoCo lets it touch, except what it stands on
            ids = set(touchable(scene.model, list(scene.geoms), root))
            pairs = zip(scene.geoms, scene.world.obstacles, strict=True)
            near = World([obstacle for geom, obstacle in pairs if geom in ids])
        if in_space:
            self.shape = replace(self.shape, world=near)
        self.world = self.shape.world
        self.obstacles = self.world.names if bounded else near.names
        self._scenery = list(zip(scene.geoms, scene.world.names, strict=True))  # ids and names of the scene's obstacles
        ids = {name: geom for geom, name in self._scenery}
        self.obstacle_geoms: npt.NDArray[np.int64] = np.array([ids[name] for name in self.world.names], dtype=np.int64)
        self.body = root
        attached = {root, *(int(scene.model.joint(name).bodyid[0]) for name in robot.joints)}
        for body in range(scene.model.nbody):  # parents come before their children
            if scene.model.body_parentid[body] in attached:
                attached.add(body)
        self.bodies = np.array(sorted(attached), dtype=np.intp)
        self._roots = self.bodies[~np.isin(scene.model.body_parentid[self.bodies], self.bodies) | (self.bodies == 0)]
        mounts = mounting_pairs(scene.model, [geom for geom, name in self._scenery if name in self.obstacles])
        # What a choice of obstacles leaves out does not collide, but ground and what the robot stands on; for a robot
        # whose own steps are MuJoCo's all of it does.
        left = [] if robot.geoms is not None else sorted({*obstacle_geoms(scene.model)} - {*scene.geoms})
        left = touching_pairs(scene.model, touchable(scene.model, left, root))
        apart = np.concatenate([mounts, left])
        self._apart = apart[np.isin(scene.model.geom_bodyid[apart[:, 0]], self.bodies)]
        self.model = self._compile()
        self.qpos, self.qvel, self.ctrl = indices_in(robot, self.model)
        self.actuators = np.array([self.model.actuator(name).id for name in robot.actuators], dtype=np.intp)
        first = self.model.nsensordata - len(self._roots) * len(self.obstacles)
        self.contact = np.arange(first, self.model.nsensordata).reshape(len(self._roots), len(self.obstacles))
        try:
            batch.Batch(self.model, 1, 1)
        except ValueError as error:
            raise InputError(f"scene {scene.name}: got an MJCF that cannot be run in batches: {error}") from None
        _check_maps(self)
        if simulator is not None:
            if self.obstacles != self.world.names:
                raise InputError(f"simulator: got robot {robot.name} without position and balls, want one with either")
            simulator.check(robot)

    @property
    def timestep(self) -> float:
        if self.simulator is not None:
            return self._step or self.simulator.timestep
        return float(self.model.opt.timestep)

    @property
    def has_medium(self) -> bool:
        """Whether wind is the velocity of a medium, and not a force: a simulator's, or the fluid of the MJCF."""
        if self.simulator is not None:
            return self.simulator.wind
        flags, option = mujoco.mjtDisableBit, self.model.opt
        passive = int(flags.mjDSBL_SPRING) | int(flags.mjDSBL_DAMPER)  # without both, MuJoCo has no passive forces
        return (option.density > 0 or option.viscosity > 0) and option.disableflags & passive != passive

    @property
    def weight(self) -> float:
        """Weight of the robot in N."""
        if self.simulator is not None:
            return self.simulator.weight
        return float(self.model.body_subtreemass[self._roots].sum() * np.linalg.norm(self.model.opt.gravity))

    def sensors(self, sensors: Sequence[Sensor]) -> RobotSensors:
        """Sensors of the scene's MJCF, for `OffsetFree(sensors=...)` and `SensorErrors`."""
        if self.simulator is not None:
            raise InputError(f"sensors: got a plant simulated by {self.simulator.name}, want one moved by MuJoCo")
        return RobotSensors(self.robot, self.scene, sensors)

    def check_simulator(self, what: str, parameter: str | None = None) -> None:
        """Raise an InputError if a disturbance cannot change a parameter; None for one of MuJoCo's models alone."""
        if self.simulator is not None and parameter not in self.simulator.parameters:
            raise InputError(f"{what}: got a plant simulated by {self.simulator.name}, want one that can have it")

    def for_period(self, period: float) -> "Plant":
        """The plant with the longest physics step that divides a control period, in s, and does not exceed its own.

        A plan with a free duration has a period that the MJCF cannot know.
        """
        period = check_number("control period", period, above=0.0)
        other = copy.copy(self)
        vars(other).pop("without_contacts", None)
        other.ran = None
        other._step = period / max(1, math.ceil(period / self.timestep - 1e-6))
        other.model = other._compile()
        return other

    def substeps(self, period: float) -> int:
        """The number of physics steps in a control period of so many seconds, which must be a whole one."""
        period = check_number("control period", period, above=0.0)
        steps = period / self.timestep
        whose, larger = f"scene {self.scene.name}", "a larger <option timestep=.../> there"
        other = f'; or set <option timestep="{float(period / max(round(min(steps, 1e9)), 1))!r}"/> there'
        if self.simulator is not None:
            whose, larger, other = self.simulator.name, "a larger one", ""
        if steps > MOST_SUBSTEPS:
            count = f"{steps:,.0f}" if steps < 1e12 else f"{steps:.3g}"
            got, most = f"{period:g} s, {count} physics steps of {whose}", f"at most {MOST_SUBSTEPS:,}"
            raise InputError(f"control period: got {got}, want {most}: {larger} than {self.timestep:g} s")
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6 * steps:
            step, remedy = f"the physics step of {whose}, {self.timestep:g} s", f"plant.for_period({period:g}){other}"
            raise InputError(f"control period: got {period:g} s, want a multiple of {step}: {remedy}")
        return round(steps)

    @cached_property
    def without_contacts(self) -> mujoco.MjModel:
        """A copy of the model in which the robot passes through obstacles, and contacts are not sensed."""
        return self._compile(contacts=False)

    @cached_property
    def enclosed(self) -> bool:
        """Whether all colliding parts of the robot are within its radius, so that no part touches an obstacle earlier.

        For balls and geoms this is not known. A `<pair>` with an obstacle collides whatever their contype, so that its
        contacts have to be sensed, too.
        """
        if not self.obstacles or "radius" not in self.robot.shape:
            return not self.obstacles
        geoms = [self.model.geom(name).id for name in self.obstacles]
        if np.isin([self.model.pair_geom1, self.model.pair_geom2], geoms).any():
            return False
        return len(self.world) > 0 and extent(self) <= self.robot.radius * (1 + 1e-9)

    def state(self, qpos: Array, qvel: Array, act: Array, near: Array | None = None) -> Array:
        """The analytic state (..., n) for `qpos`, `qvel` and activations (..., na); as `Robot.state`."""
        state = self.robot.state(qpos, qvel, near=near)
        if not self.robot.activations:
            return state
        return np.concatenate([state, vectors_of("act", act, self.robot.activations)], axis=-1)

    def clearance(self, states: npt.ArrayLike, displaced: Array | None = None) -> Array:
        """The signed distance (...) in m to the nearest obstacle minus the radius; of balls or geoms, the least.

        Args:
          displaced: (K, obstacles, 3), displacements of the obstacles in each trial, along the world's axes; states are
            then (K, k, n).
        """
        states = vectors_of("states", states, len(self.robot.dynamics.state_coordinates))
        if displaced is not None:
            wanted = (len(states) if states.ndim == 3 else None, len(self.world), 3)
            displaced = shaped("displaced", displaced, wanted)
            if displaced.any() and states.ndim != 3:
                raise InputError(f"states: got shape {states.shape} beside displaced obstacles, want (K, k, n)")
            displaced = self.shape.across(displaced) if displaced.any() else None
        return self.shape.clearance(self.shape.places(states), displaced)

    def record_of_balls(self, planned: Array, driven: Array) -> BallRecord | None:
        """The balls along planned states (T+1, n) and runs (K, T+1, n), for pictures; None for a robot without balls.

        One with neither balls nor a position is represented by a ball about its outermost part.
        """
        balls, dynamics, known = self.robot.balls, self.robot.dynamics, np.isfinite(driven).all(axis=2)
        if balls is not None:
            anchors, radii, centres = np.full((len(balls), 4), np.nan), balls.radii, partial(balls.centres, dynamics)
            for k, site in enumerate(balls.sites):
                if site is not None:
                    anchors[k] = anchor_of(self.model, site)
        elif dynamics.state_coordinates.position:
            return None
        else:
            number, place, radius = mjcf_kinematics.farthest_out(self.model, self.body)
            anchors, radii = np.array([[number, *place]]), np.array([radius])

            def centres(states: Array) -> Array:
                found = [data.xpos[number] + data.xmat[number].reshape(3, 3) @ place for data in self._posed(states)]
                return np.reshape(found, (-1, 1, 3))

        places = np.full((*driven.shape[:2], len(radii), 3), np.nan)
        places[known] = centres(driven[known])
        return BallRecord(driven=places, planned=centres(planned), radii=radii, anchors=anchors)

    def _posed(self, states: Array) -> Iterator[mujoco.MjData]:
        """MuJoCo's data with the places of all bodies in each of these states (k, n): one object, which changes."""
        positions = np.tile(self.model.qpos0, (len(states), 1))
        for position, state in zip(positions, states, strict=True):
            position[self.qpos] = self.robot.configuration(state)[0]
        return mjcf_kinematics.posed(self.model, positions)

    def _compile(self, *, contacts: bool = True) -> mujoco.MjModel:
        spec = self.scene.mjcf.spec()
        if self._step is not None:
            spec.option.timestep = self._step
        geoms = list(spec.geoms)
        for geom, name in self._scenery:
            geoms[geom].name = name  # sensors need names
        _separate(spec, geoms, self._apart, self.scene.model)
        sensors, bodies = {sensor.name for sensor in spec.sensors}, list(spec.bodies)
        for root in self._roots.tolist():
            bodies[root].name = bodies[root].name or free_name("robot", [body.name for body in bodies])
        if not contacts:
            for geom in geoms:
                if geom.name in self.obstacles:
                    geom.contype = geom.conaffinity = 0
            for pair in list(spec.pairs):  # which collide whatever their contype
                if not {pair.geomname1, pair.geomname2}.isdisjoint(self.obstacles):
                    spec.delete(pair)
        for root, name in itertools.product(self._roots.tolist() if contacts else [], self.obstacles):
            sensor = free_name(f"contact with {name}", sensors)
            sensors.add(sensor)
            spec.add_sensor(
                name=sensor,
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_XBODY,  # the body and everything attached to it
                objname=bodies[root].name,
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname=name,
                # The items to report, their order, and their number.
                intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1],
            )
        model = compiled(spec)
        ignore_timing(model)
        return model


def extent(plant: Plant) -> float:
    """An upper bound of the distance from its position at which the robot can touch an obstacle, in m; exact for balls.

    The distance is seen from above for a robot that is seen from above; else it is the distance in space, for any
    plane. Moving parts count in all positions that their joints would allow without limits.
    """
    model, space, off = plant.model, plant.robot.dynamics.state_coordinates, 0.0
    axes = [0, 1] if space.from_above else [0, 1, 2]  # axes of the world that count for distances
    states = np.random.default_rng(0).standard_normal((9, len(space)))
    states[-1] = 0.0
    for state, data in zip(states, plant._posed(states), strict=True):
        place = space.in_world(state[list(space.position)])
        off = max(off, float(np.linalg.norm((data.xpos[plant.body] - place)[axes])))
    at_zero = next(plant._posed(states[-1:]))
    obstacles = [model.geom(name).id for name in plant.obstacles]
    thick = model.geom_margin + model.geom_gap  # distance at which MuJoCo detects a contact
    thickest = max(thick[obstacles].max(initial=0.0), (model.pair_margin + model.pair_gap).max(initial=0.0))
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    collides[model.pair_geom1], collides[model.pair_geom2] = True, True
    reach = 0.0
    for geom in np.flatnonzero(collides).tolist():
        path = mjcf_kinematics.path_to(model, geom, plant.body)
        if path is None:
            reach = np.inf if model.geom_bodyid[geom] in plant.bodies else reach
            continue
        size, kind = float(model.geom_rbound[geom]) or np.inf, model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_CYLINDER and space.from_above and abs(at_zero.geom_xmat[geom][8]) > 1 - 1e-9:
            size = float(model.geom_size[geom, 0])  # upright: its outline from above
        distance, jointed = np.linalg.norm(model.geom_pos[geom]), False
        for body in path:
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            jointed |= count > 0
            distance += np.linalg.norm(model.body_pos[body])
            for joint in range(first, first + count):
                slides = model.jnt_type[joint] in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_FREE)
                distance += np.inf if slides else 2 * np.linalg.norm(model.jnt_pos[joint])
        if not jointed:
            distance = np.linalg.norm((at_zero.geom_xpos[geom] - at_zero.xpos[plant.body])[axes])
        reach = max(reach, float(distance) + size + float(thick[geom]))
    return off + reach + float(thickest)


def _separate(spec: mujoco.MjSpec, geoms: Sequence[mujoco.MjsGeom], apart: Pairs, model: mujoco.MjModel) -> None:
    """Let no contact arise between the geoms of these pairs, by bits of their own for the fixed ones.

    Args:
      geoms: those of the spec, by id. apart: pairs of a robot's geom and a geom that is fixed to the world.
    """
    used = int(np.bitwise_or.reduce(model.geom_contype | model.geom_conaffinity, initial=0))
    free = [1 << bit for bit in range(31) if not used >> bit & 1]
    of_others = dict[tuple[int, ...], int]()  # the geoms that a fixed one still touches, and the bit for such
    for fixed in np.unique(apart[:, 1]).tolist():
        others = np.setdiff1d(touching_pairs(model, [fixed])[:, 0], apart[apart[:, 1] == fixed, 0])
        if (same := tuple(others.tolist())) not in of_others:
            if not free:
                raise InputError("obstacles: got an MJCF with all bits of contype and conaffinity, want a free one")
            of_others[same] = free.pop()
            for other in same:
                geoms[other].conaffinity |= of_others[same]
        geoms[fixed].contype, geoms[fixed].conaffinity = of_others[same], 0
    names = {frozenset((geoms[geom].name, geoms[other].name)) for geom, other in apart.tolist()}
    for pair in list(spec.pairs):
        if frozenset((pair.geomname1, pair.geomname2)) in names:
            spec.delete(pair)


def _check_names(robot: Robot, scene: Scene) -> None:
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


def _check_maps(plant: Plant) -> None:
    """Raise InputError unless the robot's maps fit the model, and its body and balls are where its states say."""
    robot = plant.robot
    n, m = len(robot.dynamics.state_coordinates), len(robot.dynamics.control_coordinates)
    qpos, qvel = (np.asarray(part) for part in robot.configuration(np.zeros(n)))
    joints, actuators = ", ".join(robot.joints) or "no joints", ", ".join(robot.actuators) or "no actuators"
    for field, got, want, of in (
        ("configuration: qpos", qpos, len(plant.qpos), joints),
        ("configuration: qvel", qvel, len(plant.qvel), joints),
        ("actuation", np.asarray(robot.actuation(np.zeros(m))), len(plant.ctrl), actuators),
        ("state", np.asarray(robot.state(qpos, qvel)), n - robot.activations, "its dynamics"),
    ):
        if got.shape != (want,):
            raise InputError(f"robot {robot.name}: {field}: got shape {got.shape}, want ({want},) for {of}")
    if plant.simulator is None:
        _check_limits(plant)
    if robot.dynamics.state_coordinates.position:
        _check_position(plant)
    if robot.balls is not None:
        _check_sites(plant, robot.balls)


def _check_limits(plant: Plant) -> None:
    """Raise InputError if a control within its limits gives a command that exceeds an actuator's ctrlrange.

    MuJoCo would clip it silently, and records of applied controls would be wrong.
    """
    robot, model, ctrl, space = plant.robot, plant.model, plant.ctrl, plant.robot.dynamics.control_coordinates
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
        name = plant.scene.mjcf.controls[ctrl[k]].name
        got = f"controls ({controls}), for which actuation() commands {commands[row, k]:g} of actuator {name!r}"
        own = f"its ctrlrange in the MJCF, {low[k]:g} to {high[k]:g}"
        raise InputError(f"robot {robot.name}: control_limits: got {got}, want {own}")


def _check_position(plant: Plant) -> None:
    """Raise InputError unless the body's origin is at the position, and moves with it, by MuJoCo's kinematics."""
    robot, space, n = plant.robot, plant.robot.dynamics.state_coordinates, len(plant.robot.dynamics.state_coordinates)

    def origins(states: Array) -> Array:
        return np.array([data.xpos[plant.body].copy() for data in plant._posed(states)])

    # About a state without zeros, so that angles have an effect.
    middle, steps = 0.1 + 0.01 * np.arange(n), np.eye(n)[list(space.position)]
    moves = (origins(middle + steps) - origins(middle - steps)) / 2
    wanted = np.eye(3)[list(space.world_axes)]
    who = f"robot {robot.name}: position"
    names = [space.names[index] for index in space.position]
    if np.abs(moves - wanted).max() > OFF:
        raise InputError(f"{who}: got ({', '.join(names)}) in {_of(space)}; {_remedy(robot, names, moves)}")
    states = np.array([np.zeros(n), middle])
    for state, origin in zip(states, origins(states), strict=True):
        place = state[list(space.position)]
        said = space.in_world(place)
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


def _check_sites(plant: Plant, balls: CollisionSpheres) -> None:
    """Raise InputError unless each ball that names a site or a geom has its centre there in MuJoCo."""
    model, dynamics = plant.model, plant.robot.dynamics
    who, n = f"robot {plant.robot.name}: balls", len(dynamics.state_coordinates)
    names = [model.site(number).name for number in range(model.nsite)]
    names = list(filter(None, [*names, *(model.geom(number).name for number in range(model.ngeom))]))
    for site in filter(None, balls.sites):
        if site not in names:
            has = ", ".join(names) or "none"
            raise InputError(f"{who}: sites: got {excerpt(site)}, want a site or a geom of the MJCF; it has: {has}")
    anchors = [(k, site, anchor_of(model, site)) for k, site in enumerate(balls.sites) if site is not None]
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (3, n))
    states = np.array([np.zeros(n), 0.1 + 0.01 * np.arange(n), *drawn])
    for state, data in zip(states, plant._posed(states), strict=True):
        centres = balls.centres(dynamics, state) if anchors else ()
        for k, site, (body, *place) in anchors:
            position = data.xpos[int(body)] + data.xmat[int(body)].reshape(3, 3) @ place
            off = position - centres[k]
            if plant.shape.in_plane and dynamics.state_coordinates.from_above:
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
