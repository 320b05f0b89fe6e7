"""Parts of a robot's outline: boxes by their corners, and capsules as chains of balls.

A capsule is the set of points within `radius` of a segment, such as the link of an arm. Balls of the same radius,
evenly spaced along the segment, are inside it. Between two balls, `spacing` apart, the capsule protrudes by

    radius - sqrt(radius^2 - spacing^2 / 4)

so the distance to the balls exceeds the distance to the capsule by at most this amount.
"""

import itertools
import math
from collections import namedtuple
from collections.abc import Sequence
from numbers import Real
from typing import Any

from lqrsim.errors import InputError, check_number, excerpt
from lqrsim.rotations import rotate

MOST = 10_000  # largest number of balls in a chain


# A named tuple, so that formulas that refer to a capsule can be cached: see `codegen/fingerprint.py`.
class Capsule(namedtuple("Capsule", ("length", "radius", "tolerance"))):
    """A capsule that is covered by a chain of balls, for `CollisionSpheres`.

        link = ls.types.Capsule(length=0.4, radius=0.03, tolerance=0.002)

        def arm(x, p):
            from sympy import cos, sin
            return link.between((0, 0, 0.1), (0.4 * cos(x[0]), 0.4 * sin(x[0]), 0.1))

        balls = ls.CollisionSpheres(arm, link.radii)

    A `Clearance` with a margin of `missed` keeps the capsule itself clear.

    Attributes:
      length: length of the segment, without the round ends, in metres; 0 for a ball.
      radius: radius of the capsule and of each ball, in metres.
      tolerance: largest protrusion of the capsule from the balls, in metres, more than 0, for at most 10 000 balls.
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
        """Number of balls for the tolerance, as a float."""
        sunk = min(self.tolerance, self.radius)
        widest = 2 * math.sqrt(sunk) * math.sqrt(2 * self.radius - sunk)  # largest spacing
        return self.length / widest * (1 - 1e-12) // 1 + 2 if self.length else 1

    @property
    def count(self) -> int:  # pyright: ignore[reportIncompatibleMethodOverride] of tuple, which is not needed here
        """Number of balls."""
        return int(self._fewest)

    @property
    def radii(self) -> tuple[float, ...]:
        """The radius of each ball, in metres."""
        return (self.radius,) * self.count

    @property
    def missed(self) -> float:
        """Largest protrusion of the capsule from the balls, in metres: the error of a clearance."""
        half = self.length / (self.count - 1) / 2 if self.count > 1 else 0.0
        return self.radius - math.sqrt(max(self.radius**2 - half**2, 0.0))

    def between(self, start: Sequence[Any], end: Sequence[Any]) -> list[list[Any]]:
        """The centre of each ball on the segment from `start` to `end`: SymPy expressions or numbers.

        The ends have 2 or 3 coordinates in metres, and so has each centre.
        """
        try:
            first, last = (list(itertools.islice(iter(point), 4)) for point in (start, end))
        except TypeError:
            first, last = [], [0]
        if len(first) != len(last) or len(first) not in (2, 3):
            got = f"{excerpt(start)} and {excerpt(end)}"
            raise InputError(f"between: got {got}, want two points of 2 or 3 coordinates")
        pairs, most = list(zip(first, last, strict=True)), max(self.count - 1, 1)
        try:
            return [[((most - k) * a + k * b) / most for a, b in pairs] for k in range(self.count)]
        except Exception as error:  # entries that are not numbers
            got = f"{excerpt(start)} and {excerpt(end)} ({type(error).__name__})"
            raise InputError(f"between: got {got}, want points of expressions") from None


class Box(namedtuple("Box", ("length", "width", "height"))):
    """A box, for the hulls of `CollisionSpheres`.

    Attributes:
      length, width, height: its extents along its axes, in metres, above 0; the height is None in the plane.
    """

    __slots__ = ()

    def __new__(cls, length: float, width: float, height: float | None = None) -> "Box":
        sizes = {"length": length, "width": width} | ({} if height is None else {"height": height})
        checked = [check_number(f"Box: {name}", size, above=0.0) for name, size in sizes.items()]
        return super().__new__(cls, *checked, *[None] * (3 - len(checked)))

    def corners(self, center: Sequence[Any], turn: Any) -> list[list[Any]]:
        """The four corners, counterclockwise, or in space the eight corners: SymPy expressions, or numbers.

        Args:
          center: its 2 or 3 coordinates in metres.
          turn: its angle in rad, from the first axis of the plane to its length; in space its rotation vector.
        """
        try:
            if self.height is not None:
                (x, y, z), sides = center, ((-0.5, 0.5),) * 3
                ends = [[a * b for a, b in zip(self, end, strict=True)] for end in itertools.product(*sides)]
                return [[a + b for a, b in zip((x, y, z), rotate(turn, end), strict=True)] for end in ends]
            if isinstance(turn, Real):
                from math import cos, sin
            else:
                from sympy import Expr, cos, sin

                if not isinstance(turn, Expr):
                    raise TypeError("no angle")  # SymPy would read an iterator to its end
            (x, y), c, s = center, cos(turn) / 2, sin(turn) / 2
            ends = [(a * self.length, b * self.width) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            return [[x + a * c - b * s, y + a * s + b * c] for a, b in ends]
        except Exception as error:  # entries that are not numbers
            got = f"{excerpt(center)} and {excerpt(turn)} ({type(error).__name__})"
            wanted = "2 coordinates and an angle" if self.height is None else "3 coordinates and a rotation vector"
            raise InputError(f"corners: got {got}, want {wanted}") from None
