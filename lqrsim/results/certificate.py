"""A certificate of how often a policy fails, with everything needed to repeat the measurement. NumPy only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from lqrsim.annotations import LINE, SHARE, Bounds, Chance, Line, Positive, Share, checked
from lqrsim.errors import Array, InputError
from lqrsim.results.solution import Solution


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class FailureCertificate:
    """The probability that a policy fails, as measured by multilevel splitting, and a description of the measurement.

    Attributes:
      model: hash of the simulated MJCF.
      repetitions: the estimate of each repetition, (R,).
      keep: fraction of the trials that exceeds the next level; 0 if failures were counted.
    """

    solution: Solution
    scenario: Annotated[str, 10 * LINE]
    sweep: Line
    strength: Positive
    policy: Line
    design_disturbances: Line | None
    failure: Line
    goal_radius: Positive | None
    goal_tolerance: Positive | None
    disturbances: tuple[Line, ...]
    model: Line
    policy_digest: Line
    probability: Share
    low: Share
    high: Share
    confidence: Chance
    repetitions: Annotated[Array, "R", SHARE]
    particles: int
    seed: int
    versions: Mapping[str, Line]
    keep: Annotated[float, Bounds(at_least=0.0, at_most=0.5)] = 0.1

    _want = "a FailureCertificate, such as rare.certificate()"

    def __post_init__(self) -> None:
        if not self.low <= self.probability <= self.high:
            wanted = f"a number from {self.low:g} to {self.high:g}, its interval"
            raise InputError(f"FailureCertificate: probability: got {self.probability:g}, want {wanted}")
        mean = float(self.repetitions.mean()) if len(self.repetitions) > 1 else -1.0
        if abs(mean - self.probability) > 1e-9 * self.probability:
            got = f"{len(self.repetitions)} whose mean is not {self.probability:g}"
            want = "at least two, of which the probability is the mean"
            raise InputError(f"FailureCertificate: repetitions: got {got}, want {want}")

    def summary(self) -> str:
        """Lines that describe the measurement, and the probability."""
        interval = f"{100 * self.confidence:g} % interval, {len(self.repetitions)} repetitions"
        run = f"{self.policy} on {self.scenario}, {self.sweep} at strength {self.strength:g}; failure: {self.failure}"
        return f"{run}\nprobability of failure: {self.probability:.2g} [{self.low:.2g}, {self.high:.2g}] ({interval})"

    __str__ = summary
