"""Capsules as chains of balls: how many it takes, and where they are.

A capsule is what is within `radius` of a segment, as the link of an arm. Balls of the same radius, evenly along the
segment, are inside it; between two of them, `spacing` apart, the capsule sticks out by

    radius - sqrt(radius^2 - spacing^2 / 4)

and an obstacle that clears the balls is nearer to the capsule than to them by at most that.
"""

import math
from collections import namedtuple
from collections.abc import Sequence
from typing import Any

from lqrsim.errors import InputError, check_number, excerpt

MOST = 10_000  # balls in a chain


# A named tuple, for formulas that refer to one can be kept: see `codegen/fingerprint.py`.
class Capsule(namedtuple("Capsule", ("length", "radius", "tolerance"))):
    """A capsule that is covered by a chain of balls, for `CollisionSpheres`.

        link = ls.Capsule(length=0.4, radius=0.03, tolerance=0.002)

        def arm(x, p):
            from sympy import cos, sin
            return link.between((0, 0, 0.1), (0.4 * cos(x[0]), 0.4 * sin(x[0]), 0.1))

        balls = ls.CollisionSpheres(arm, link.radii)

    A `Clearance` with a margin of `missed` keeps the capsule itself clear.

    Attributes:
      length: of its segment, without the round ends, in metres; 0 for a ball.
      radius: in metres, of the capsule and of each ball.
      tolerance: by how much the capsule may stick out of the balls, in metres, more than 0.

    Raises:
      InputError: a number is out of range, or it would take more than 10 000 balls.
    """

    __slots__ = ()

    def __new__(cls, length: float, radius: float, tolerance: float) -> "Capsule":
        length = check_number("Capsule: length", length, at_least=0.0)
        radius = check_number("Capsule: radius", radius, above=0.0)
        capsule = super().__new__(cls, length, radius, check_number("Capsule: tolerance", tolerance, above=0.0))
        if not capsule._fewest <= MOST:
            raise InputError(
                f"Capsule: tolerance: got {capsule.tolerance:g} m for a length of {length:g} m and a radius of"
                f" {radius:g} m, which takes {capsule._fewest:.3g} balls, want at most {MOST}"
            )
        return capsule

    @property
    def _fewest(self) -> float:
        """Balls that keep to the tolerance."""
        sunk = min(self.tolerance, self.radius)
        widest = 2 * math.sqrt(sunk) * math.sqrt(2 * self.radius - sunk)  # between two balls
        return self.length / widest * (1 - 1e-12) // 1 + 2 if self.length else 1

    @property
    def count(self) -> int:  # pyright: ignore[reportIncompatibleMethodOverride] of tuples, which nobody counts here
        """How many balls there are."""
        return int(self._fewest)

    @property
    def radii(self) -> tuple[float, ...]:
        """The radius of each ball, in metres."""
        return (self.radius,) * self.count

    @property
    def missed(self) -> float:
        """By how much the capsule sticks out of the balls at most, in metres: what a clearance misses, too."""
        half = self.length / (self.count - 1) / 2 if self.count > 1 else 0.0
        return self.radius - math.sqrt(max(self.radius**2 - half**2, 0.0))

    def between(self, start: Sequence[Any], end: Sequence[Any]) -> list[list[Any]]:
        """The middle of each ball, where the segment is from `start` to `end`: expressions of SymPy, or numbers.

        Args:
          start: one end of the segment, 2 or 3 coordinates in metres.
          end: the other end, as many coordinates.

        Returns:
          `count` lists of as many coordinates.

        Raises:
          InputError: they are no two points of the same size.
        """
        try:
            first, last = list(start), list(end)
        except TypeError:
            first, last = [], [0]
        if len(first) != len(last) or len(first) not in (2, 3):
            given = f"{excerpt(start)} and {excerpt(end)}"
            raise InputError(f"between: got {given}, want two points of 2 or 3 coordinates")
        most = max(self.count - 1, 1)
        try:
            return [
                [((most - k) * a + k * b) / most for a, b in zip(first, last, strict=True)] for k in range(self.count)
            ]
        except Exception as error:  # whatever is no number
            given = f"{excerpt(start)} and {excerpt(end)}"
            raise InputError(f"between: got {given} ({type(error).__name__}), want points of expressions") from None
