"""A robot in a scene: the MuJoCo model that is run, and where the robot is in it."""

from collections.abc import Iterable

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim import compiled
from lqrsim.errors import Array, InputError, check_number
from lqrsim.robots.base import Robot
from lqrsim.scenes import Scene, obstacle_geoms
from lqrsim.world import World

Indices = npt.NDArray[np.intp]


class Plant:
    """A robot in a scene, ready to run.

    Attributes:
      robot, scene: what it is made of.
      world: the obstacles that bound the robot. model: the compiled scene, with a contact sensor for each of them.
      body: id of the robot's body. qpos, qvel, ctrl: where its joints' and actuators' numbers are in MuJoCo's arrays.
      contact: where the contact sensors are in MuJoCo's `sensordata`; positive while the robot touches the obstacle.
      timestep: of the physics, in seconds.

    Raises:
      InputError: there is no such robot in the scene: its body, a joint or an actuator is missing.
    """

    def __init__(self, robot: Robot, scene: Scene) -> None:
        wanted = {
            "body": ([robot.body], [scene.model.body(i).name for i in range(scene.model.nbody)]),
            "joint": (robot.joints, [scene.model.joint(i).name for i in range(scene.model.njnt)]),
            "actuator": (robot.actuators, [scene.model.actuator(i).name for i in range(scene.model.nu)]),
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
        self.model = self._compile()
        joints = [self.model.joint(name) for name in robot.joints]
        self.body = int(self.model.body(robot.body).id)
        self.qpos = _ranges((joint.qposadr[0], joint.qpos0.size) for joint in joints)
        self.qvel = _ranges((joint.dofadr[0], joint.damping.size) for joint in joints)
        self.ctrl = np.array([self.model.actuator(name).id for name in robot.actuators], dtype=np.intp)
        self.contact = np.arange(self.model.nsensordata - len(self.world), self.model.nsensordata)

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

    def clearance(self, states: npt.ArrayLike) -> Array:
        """Signed distance to the nearest obstacle minus the robot's radius in metres, (...), at states (..., n)."""
        states = np.asarray(states, dtype=np.float64)
        if not len(self.world):
            return np.full(states.shape[:-1], np.inf)
        position = states[..., list(self.robot.dynamics.state_coordinates.position)]
        return compiled.signed_distance(self.world, position) - self.robot.radius

    def _compile(self) -> mujoco.MjModel:
        spec = mujoco.MjSpec.from_string(self.scene.xml)
        # The sensors need names; geoms without one get the obstacle's. A geom's id is its place in the compiled model.
        spec.compile()
        geoms = {geom.id: geom for geom in spec.geoms}
        for geom, obstacle in zip(obstacle_geoms(self.scene.model), self.scene.world.obstacles, strict=True):
            geoms[geom].name = obstacle.name
        for name in self.world.names:
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


def _ranges(starts_and_sizes: Iterable[tuple[int, int]]) -> Indices:
    return np.concatenate([np.arange(start, start + size) for start, size in starts_and_sizes], dtype=np.intp)
