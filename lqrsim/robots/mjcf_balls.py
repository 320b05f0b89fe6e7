"""The outline of a robot from an MJCF: balls that cover the colliding geoms, placed by MuJoCo's kinematics."""

from collections.abc import Callable

import numpy as np

from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError
from lqrsim.kernels import mjcf_places
from lqrsim.problem.collision_spheres import CollisionSpheres, SphereCenters
from lqrsim.problem.dynamics import Dynamics
from lqrsim.robots.mjcf_dynamics import MjcfDynamics
from lqrsim.robots.mjcf_memory import MjcfMemory
from lqrsim.scenes.mjcf_outline import Outline


class MjcfBalls(CollisionSpheres):
    """Balls that are fixed to bodies of an MJCF; `MjcfRobot` makes them.

    Args:
      outline: bodies, positions on them, and radii. place: the centres (K, 3) at a state (n,), in plain Python.
    """

    def __init__(self, outline: Outline, place: Callable[[Array], Array]) -> None:
        self.outline, self.place, self.level = outline, place, "compiled"
        self.function, self.jacobian, self.depends_on = place, None, None
        self._set_balls(outline.radii, outline.names, outline.sites)

    @property
    def name(self) -> str:
        return "MuJoCo's kinematics"

    def bind(self, dynamics: Dynamics) -> SphereCenters:
        if not isinstance(dynamics, MjcfDynamics):
            raise InputError(f"balls: got an MJCF's balls for {dynamics.name}, want its own dynamics, robot.dynamics")
        memory = MjcfMemory.of(dynamics)
        positions = dynamics.physics.model.nv
        data = np.concatenate([[len(self), positions], np.c_[self.outline.bodies, self.outline.offsets].ravel()])
        return SphereCenters(source_of(mjcf_places), data, tuple(range(positions)), functions=(memory,))
