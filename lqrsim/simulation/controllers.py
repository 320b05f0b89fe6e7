"""What decides on the controls in the loop: a policy in compiled code. Subclass `Controller` for another way."""

import abc
import hashlib
from collections.abc import Callable

import numpy as np

from lqrsim import compiled
from lqrsim.coordinates import Coordinates
from lqrsim.errors import Array
from lqrsim.policy import AffinePolicy

Control = Callable[[int, Array], Array]


class Controller(abc.ABC):
    """Base class of what decides on the controls."""

    @abc.abstractmethod
    def start(self, trials: int) -> Control:
        """Begin a run of K trials: (step, states that are shown (K, n)) -> controls (K, m) within the limits.

        Each trial gets the controls that it gets alone, to the last bit.
        """

    @property
    @abc.abstractmethod
    def digest(self) -> str:
        """Hash of all that the controls depend on."""

    @property
    @abc.abstractmethod
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        """Of the states that it wants to be shown, and of its controls."""


class Feedback(Controller):
    """A policy, or an open-loop plan, whose gains are zero."""

    def __init__(self, policy: AffinePolicy) -> None:
        self.policy = policy

    def start(self, trials: int) -> Control:
        policy = self.policy
        evaluate = compiled.policy(policy.state_coordinates, policy.control_coordinates)

        def control(step: int, shown: Array) -> Array:
            t = min(step, policy.steps - 1)
            return evaluate(shown, policy.gain[t], policy.offset[t], policy.nominal[t])

        return control

    @property
    def digest(self) -> str:
        hasher = hashlib.sha256()
        for array in (self.policy.gain, self.policy.offset, self.policy.nominal, np.float64(self.policy.dt)):
            hasher.update(np.ascontiguousarray(array).tobytes())
        return hasher.hexdigest()[:16]

    @property
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        return self.policy.state_coordinates, self.policy.control_coordinates
