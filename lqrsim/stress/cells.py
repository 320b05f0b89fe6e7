"""What a stress test is divided into."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Cell:
    """One combination of what is tested; all cells share the random numbers of their trials."""

    policy: str
    sweep: str
    strength: float
