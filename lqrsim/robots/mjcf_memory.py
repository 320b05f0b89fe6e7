"""MuJoCo's memory, for compiled code."""

from typing import Any

from lqrsim.codegen.user_functions import UserFunction
from lqrsim.errors import Array
from lqrsim.robots.mjcf_dynamics import MjcfDynamics


class MjcfMemory(UserFunction):
    """The address that kernels call p, in place of a function's address. MuJoCo's memory is there."""

    @classmethod
    def of(cls, dynamics: MjcfDynamics) -> "MjcfMemory":
        """The address for these dynamics."""
        memory = cls(
            function=_nothing, level="compiled", states=len(dynamics.state_coordinates), controls=0, parameters=(),
            offset=1, values=1, with_control=False, is_memory=True,
        )  # fmt: skip
        memory.held.append((dynamics.physics, dynamics.physics.numbers.ctypes.data))
        vars(memory).update(identity=dynamics.fixed, of_what=dynamics)
        return memory

    def __reduce__(self) -> tuple[Any, ...]:
        """The address for the dynamics in the other process."""
        return MjcfMemory.of, (vars(self)["of_what"],)


def _nothing(x: Array, p: Any) -> float:
    return 0.0
