"""Which way a path goes round points in the plane: its homotopy class.

From each point a ray goes out, all of them parallel. A path is written down as the rays that it crosses, one after the
other; a crossing that is undone next is left out. Two paths with the same ends can be bent into one another without
passing a point if and only if what is left is the same. The angles by which a path turns about each point say less:
they are how often each ray is crossed, whatever the order.
"""

from collections.abc import Iterable

import numpy as np

from lqrsim.errors import Array

Way = tuple[int, ...]

WEST = (-1.0, 0.1)  # a little to the north, for no two rays may lie on one another


def way(path: Array, points: Array, direction: tuple[float, float] = WEST) -> Way:
    """The homotopy class of a path (k, 2) among points (p, 2): the rays that it crosses, which go out in `direction`.

    Number i stands for the ray of point i, counted from 1, crossed clockwise about the point, -i for the other way. So
    a path to the north that passes points 3 and 4 to the west of them, and all others to the east, is (3, 4).

    Raises:
      ValueError: two rays lie on one another.
    """
    ahead = np.array(direction) / np.hypot(*direction)
    left = np.array([-ahead[1], ahead[0]])
    across, along = (path @ axis - (points @ axis)[:, None] for axis in (left, ahead))  # (p, k)
    if np.diff(np.sort(points @ left)).min(initial=np.inf) < 1e-9:
        raise ValueError(f"direction: got {direction}, want one in which no ray lies on another")
    beyond = across >= 0  # a knot on a ray is on one side of it, so that a crossing there counts once
    crossings = []
    for point, knot in zip(*np.nonzero(beyond[:, 1:] != beyond[:, :-1]), strict=True):
        before, after = across[point, knot : knot + 2]
        share = before / (before - after)
        if along[point, knot] + share * (along[point, knot + 1] - along[point, knot]) > 0:
            crossings.append((knot + share, int(point + 1) * (-1 if after > before else 1)))
    return reduced(crossing for _, crossing in sorted(crossings))


def reduced(crossings: Iterable[int]) -> Way:
    """Without those that the next one undoes."""
    left: list[int] = []
    for crossing in crossings:
        if left and left[-1] == -crossing:
            left.pop()
        else:
            left.append(crossing)
    return tuple(left)
