"""What decides on the controls in the loop. Subclass `Controller` for another way."""

import abc
from collections.abc import Callable, Mapping

from lqrsim.control.law import evaluator
from lqrsim.errors import Array, check_kind
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.policy import AffinePolicy

Control = Callable[[int, Array], Array]


class Controller(abc.ABC):
    """Base class of what decides on the controls."""

    @abc.abstractmethod
    def start(self, trials: int) -> Control:
        """Begin a run of K trials: (step, states that are shown (K, n)) -> controls (K, m) within the limits.

        Each trial gets the controls that it gets alone, to the last bit.

        Args:
          trials: K, how many run at once.

        Returns:
          A function (step, states shown (K, n)) -> controls (K, m).
        """

    @property
    @abc.abstractmethod
    def digest(self) -> str:
        """Hash of all that the controls depend on."""

    @property
    @abc.abstractmethod
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        """Of the states that it wants to be shown, and of its controls."""

    def lost(self) -> Mapping[int, str]:
        """The trials of the last run whose state it has lost -> why, in a line. They end there, as diverged.

        Asked after each control period. It is for what estimates; what just follows measurements loses none.
        """
        return {}

    def summary(self) -> str:
        """What there is to say of the last run, in a line; empty if nothing."""
        return ""


class Feedback(Controller):
    """A policy, or an open-loop plan, whose gains are zero.

    Args:
      policy: the feedback law, or `solution.open_loop()`.

    Raises:
      InputError: the policy is not an AffinePolicy.
    """

    def __init__(self, policy: AffinePolicy) -> None:
        self.policy = check_kind("Feedback: policy", policy, AffinePolicy, "an AffinePolicy, such as solution.policy")

    def start(self, trials: int) -> Control:
        policy = self.policy
        evaluate = evaluator(policy.state_coordinates, policy.control_coordinates)

        def control(step: int, shown: Array) -> Array:
            t = min(step, policy.steps - 1)
            return evaluate(shown, policy.gain[t], policy.offset[t], policy.nominal[t])

        return control

    @property
    def digest(self) -> str:
        return self.policy.digest

    @property
    def spaces(self) -> tuple[Coordinates, Coordinates]:
        return self.policy.state_coordinates, self.policy.control_coordinates
