"""The outline of a robot of an MJCF: balls along what collides, where MuJoCo's kinematics has them."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from lqrsim.codegen.sources import source_of
from lqrsim.codegen.user_functions import UserFunction
from lqrsim.errors import Array, InputError
from lqrsim.kernels import mjcf_places
from lqrsim.problem.collision_spheres import CollisionSpheres, SphereCenters
from lqrsim.problem.dynamics import Dynamics
from lqrsim.robots.mjcf_dynamics import MjcfDynamics
from lqrsim.scenes.mjcf_outline import Outline


class MjcfBalls(CollisionSpheres):
    """Balls that are fixed to bodies of an MJCF; `MjcfRobot` makes them.

    Args:
      outline: bodies, places and radii. place: where they are, plainly, at a state (n,): (K, 3).
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
            raise InputError(f"balls: got those of an MJCF for {dynamics.name}, want its own dynamics, robot.dynamics")
        memory = _Memory.of(dynamics, self)
        positions = dynamics.physics.model.nv
        data = np.concatenate([[len(self), positions], np.c_[self.outline.bodies, self.outline.offsets].ravel()])
        return SphereCenters(source_of(mjcf_places), data, tuple(range(positions)), functions=(memory,))


class _Memory(UserFunction):
    """MuJoCo's memory in the place of a function's address: compiled code finds its numbers there."""

    @classmethod
    def of(cls, dynamics: MjcfDynamics, balls: MjcfBalls) -> "_Memory":
        """That of these dynamics."""
        numbers = dynamics.physics.numbers
        memory = cls(
            function=partial(_plainly, balls.place), level="compiled", states=len(dynamics.state_coordinates),
            controls=0, parameters=(), offset=1, values=3 * len(balls), entries=balls.names, columns=3,
            with_control=False,
        )  # fmt: skip
        memory.held.append((numbers, numbers.ctypes.data))
        vars(memory).update(identity=dynamics.fixed, of_what=(dynamics, balls))
        return memory

    def __reduce__(self) -> tuple[Any, ...]:
        """That of the dynamics in the other process."""
        return _Memory.of, vars(self)["of_what"]


def _plainly(place: Callable[[Array], Array], x: Array, p: Any) -> Array:
    return place(x)
