"""Robots: constants, analytic dynamics, MJCF names, and the maps between the two."""

import abc
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_kind, vectors_of

if TYPE_CHECKING:
    import mujoco

    from lqrsim.problem.collision_shape import CollisionGeoms, CollisionSpheres, ShapeInWorld
    from lqrsim.problem.dynamics import Dynamics
    from lqrsim.scenes.world import World


Indices = npt.NDArray[np.intp]


class Robot(abc.ABC):
    """A robot. Subclass it to add your own; `packaged.py` has examples, `docs/adding_a_robot.md` lists the steps.

    Attributes:
      name: name of the robot on the command line.
      body: the robot's body in the MJCF; its origin is the position in the states. Obstacles are everything else that
        is fixed to the world.
      joints: its joints in the MJCF. `qpos` and `qvel` below are theirs alone, in this order.
      actuators: its actuators in the MJCF, in the order of `actuation`.
      wheels: the geoms in the MJCF that are the treads of its wheels, each on its own body.
      drag: linear drag against its velocity through the air, in N s/m; wind acts through it. A fluid of the MJCF needs
        none.
      activations: number of states of MuJoCo's actuators, `act`; they are the robot's last states.
      radius: radius in metres of its collision circle if the world is seen from above, else of its collision ball. With
        balls or without a position, its size in pictures, and the distance from the goal that counts as reached.
      balls: the colliding balls, in place of `radius`, for a robot of more than one ball or without a position.
      geoms: the colliding geoms, in place of both, for a robot from an MJCF; the simulator computes their distances.
    """

    _want = "a Robot, such as Quadrotor()"

    name: str
    body: str
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    wheels: tuple[str, ...] = ()
    drag: float = 0.0
    activations: int = 0
    radius: float
    balls: "CollisionSpheres | None" = None
    geoms: "CollisionGeoms | None" = None

    @property
    def shape(self) -> "dict[str, Any]":
        """The collision shape as a keyword for ObstacleCost and Clearance: geoms, else balls, else radius."""
        if self.geoms is not None:
            return {"geoms": self.geoms}
        return {"balls": self.balls} if self.balls is not None else {"radius": self.radius}

    def among(self, world: "World") -> "ShapeInWorld":
        """The collision shape among obstacles that are not the scene's; they may move, and are as at the time 0."""
        from lqrsim.problem.collision_shape import shape_in
        from lqrsim.scenes.world import World

        check_kind("world", world, World, "a World, such as scene.world")
        return shape_in(self.dynamics, world, **self.shape)

    @property
    @abc.abstractmethod
    def dynamics(self) -> "Dynamics":
        """The analytic model `xdot = f(x, u)`. It is read often: make it once, as with `functools.cached_property`."""

    @abc.abstractmethod
    def state(self, qpos: npt.ArrayLike, qvel: npt.ArrayLike, near: npt.ArrayLike | None = None) -> Array:
        """The analytic state (..., n) of MuJoCo's `qpos` (..., nq), `qvel` (..., nv), without the `activations`.

        Args:
          near: (..., n), a state; angles are returned in the representative nearest to it. None for any representative.
        """

    @abc.abstractmethod
    def configuration(self, state: npt.ArrayLike) -> tuple[Array, Array]:
        """The `qpos` (..., nq) and `qvel` (..., nv) that realise an analytic state (..., n)."""

    def with_closed_loops(self, states: npt.ArrayLike) -> Array:
        """The states (..., n) near those given that the robot can be in: by default the same, without loops."""
        return vectors_of("states", states, len(self.dynamics.state_coordinates))

    def actuation(self, control: npt.ArrayLike) -> Array:
        """The `ctrl` (..., nu) of MuJoCo that realises an analytic control (..., m); the same numbers by default."""
        return np.asarray(control, dtype=np.float64)


def configuration_of(qpos: npt.ArrayLike, qvel: npt.ArrayLike, nq: int, nv: int) -> tuple[Array, Array]:
    """MuJoCo's positions (..., nq) and velocities (..., nv) as arrays. Raises InputError unless they fit."""
    qpos, qvel = vectors_of("qpos", qpos, nq), vectors_of("qvel", qvel, nv)
    if qpos.shape[:-1] != qvel.shape[:-1]:
        raise InputError(f"qvel: got shape {qvel.shape}, want qpos's shape, {qpos.shape}, with {nv} numbers")
    return qpos, qvel


def indices_in(robot: Robot, model: "mujoco.MjModel") -> tuple[Indices, Indices, Indices]:
    """The indices of a robot's joints in the qpos and qvel of a model, and of its controls in ctrl."""
    joints = [model.joint(name) for name in robot.joints]
    actuators = [model.actuator(name).id for name in robot.actuators]
    spans = (
        [(joint.qposadr[0], joint.qpos0.size) for joint in joints],
        [(joint.dofadr[0], joint.damping.size) for joint in joints],
        [(model.actuator_ctrladr[i], model.actuator_ctrlnum[i]) for i in actuators],
    )
    qpos, qvel, ctrl = (
        np.array([at for first, size in span for at in range(first, first + size)], dtype=np.intp) for span in spans
    )
    return qpos, qvel, ctrl
