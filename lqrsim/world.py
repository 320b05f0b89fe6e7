"""Obstacles as primitives, and the one place where the distance to each is written down.

`signed_distance` and `signed_distance_derivatives` are scalar functions in the subset of Python that numba compiles:
they run here as they are, and `compiled.py` puts the same text into every compiled core.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, sqrt

import numpy as np
import numpy.typing as npt

from lqrsim.coordinates import PLANES, SPACE
from lqrsim.errors import Array, InputError, check_array, check_items, check_name, check_number, check_text, real
from lqrsim.solvers.interface import stack

KINDS = ("plane", "sphere", "capsule", "cylinder", "box")
ROW = 16  # numbers an obstacle takes in `World.table`: kind, position (3), rotation (9, row by row), size (3)


@dataclass(frozen=True)
class Obstacle:
    """One primitive; sizes and axes as MuJoCo has them.

    Attributes:
      kind: one of `KINDS`.
      position: (3,) in metres. rotation: (3, 3), whose columns are the local axes; a plane's free side is its local +z,
        capsules and cylinders lie along their local z.
      size: (3,) in metres: sphere (radius, 0, 0); capsule and cylinder (radius, half length, 0), the latter infinite if
        the half length is; box half lengths; plane (0, 0, 0).
    """

    name: str
    kind: str
    position: Array
    rotation: Array
    size: Array

    def __post_init__(self) -> None:
        check_text("obstacle: name", self.name, "a name", at_most=1000)
        check_name(f"obstacle {self.name!r}: kind", self.kind, KINDS)
        object.__setattr__(self, "position", check_array(f"obstacle {self.name!r}: position", self.position, (3,)))
        rotation = check_array(f"obstacle {self.name!r}: rotation", self.rotation, (3, 3))
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
            raise InputError(f"obstacle {self.name!r}: rotation: got {rotation.tolist()}, want orthonormal axes")
        object.__setattr__(self, "rotation", rotation)
        size = check_array(f"obstacle {self.name!r}: size", self.size, (3,), infinite=True)
        used = {"plane": 0, "sphere": 1, "capsule": 2, "cylinder": 2, "box": 3}[self.kind]
        if (size[:used] <= 0).any():
            raise InputError(f"obstacle {self.name!r}: size: got {size[:used].tolist()}, want lengths above 0")
        object.__setattr__(self, "size", size)

    @property
    def row(self) -> Array:
        """This obstacle as `ROW` numbers."""
        return np.concatenate([[KINDS.index(self.kind)], self.position, self.rotation.ravel(), self.size])


@dataclass(frozen=True)
class World:
    """The obstacles that a robot must stay clear of."""

    obstacles: Sequence[Obstacle] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "obstacles", check_items("obstacles", self.obstacles, Obstacle, "a list of Obstacle"))

    def __len__(self) -> int:
        return len(self.obstacles)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(obstacle.name for obstacle in self.obstacles)

    @cached_property
    def table(self) -> Array:
        """The obstacles as numbers, (len(self), ROW)."""
        return np.array([obstacle.row for obstacle in self.obstacles]).reshape(len(self), ROW)

    def seen_by(self, plane: str, offset: float | None = None) -> "World":
        """The world of a robot whose position is in that plane, in the plane's coordinates: see `Coordinates`.

        In space ("xyz") it is this one. A plane has its two axes as x and y, in their order; its third axis is across.

        With an offset it is this world cut there: distances are those in space, from the points of the plane. The robot
        is a ball, obstacles beside the plane are beside it, and a floor is a wall. Without one, in a horizontal plane,
        it is this world seen from above: the robot is as high as everything, upright obstacles reach from the floor to
        the sky, and a sphere counts with its equator. Either way planes parallel to the robot's bound nothing: in the
        horizontal one that is the floor.

        Raises:
          InputError: there is no such plane, a vertical one has no offset; or, seen from above, an obstacle is tilted,
            so that it has no outline among the primitives.
        """
        check_name("plane", plane, (SPACE, *PLANES))
        offset = None if offset is None else check_number("offset", offset)
        if plane == SPACE:
            return self
        if offset is None and plane not in ("xy", "yx"):
            raise InputError(
                f"offset: got none for the plane {plane!r}, want where it is along its third axis, in metres"
            )
        seen = self.obstacles if offset is not None else [_from_above(obstacle) for obstacle in self.obstacles]
        if plane == "xy" and offset is None:
            return World([obstacle for obstacle in seen if not _parallel(obstacle, 2)])
        first, second = (SPACE.index(letter) for letter in plane)
        across = 3 - first - second
        turn = np.zeros((3, 3))  # to the plane's axes: a rotation, which only exchanges the world's axes
        turn[0, first] = turn[1, second] = 1.0
        turn[2] = np.cross(turn[0], turn[1])
        origin = np.zeros(3)
        origin[across] = 0.0 if offset is None else offset
        return World(
            [
                replace(obstacle, position=turn @ (obstacle.position - origin), rotation=turn @ obstacle.rotation)
                for obstacle in seen
                if not _parallel(obstacle, across)
            ]
        )

    def distances(self, point: npt.ArrayLike) -> Array:
        """Signed distances in metres to each obstacle, (len(self),), of one point (2,) or (3,); negative inside.

        Points (2,) are for a world that is seen by a robot in the plane, and in its coordinates.
        """
        x, y, z = (*_places("point", point, one=True).tolist(), 0.0)[:3]
        data = self.table.ravel()
        return np.array([signed_distance(data, ROW * i, x, y, z) for i in range(len(self))])

    def distance(self, points: npt.ArrayLike) -> Array:
        """Signed distance in metres to the nearest obstacle, (...), of points (..., 2 or 3); infinite without any."""
        points = _places("points", points)
        flat = [self.distances(point).min(initial=np.inf) for point in points.reshape(-1, points.shape[-1])]
        return np.array(flat).reshape(points.shape[:-1])

    def nearest(self, points: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Which obstacle is nearest, (...), at points (..., 2 or 3). Raises InputError in an empty world."""
        if not self.obstacles:
            raise InputError("nearest: got a world without obstacles, want at least one")
        points = _places("points", points)
        flat = [int(self.distances(point).argmin()) for point in points.reshape(-1, points.shape[-1])]
        return np.array(flat, dtype=np.int64).reshape(points.shape[:-1])


def _places(field: str, points: npt.ArrayLike, *, one: bool = False) -> Array:
    """Points (..., 2 or 3), or only one of them, as an array. Raises InputError for what is none."""
    array = real(field, points)
    if array.shape[-1:] not in ((2,), (3,)) or (one and array.ndim > 1):
        raise InputError(f"{field}: got shape {array.shape}, want {'' if one else '..., '}2 or 3 coordinates")
    return array


def _parallel(obstacle: Obstacle, across: int) -> bool:
    """Whether it is a plane whose normal is along that axis of the world."""
    return obstacle.kind == "plane" and bool(abs(abs(obstacle.rotation[across, 2]) - 1) < 1e-9)


def _from_above(obstacle: Obstacle) -> Obstacle:
    """The obstacle with infinite height; planes are as they are. Raises InputError if it is tilted."""
    upright = np.abs(np.abs(obstacle.rotation[2]) - 1) < 1e-9  # which local axis is vertical, if one is
    size = obstacle.size.copy()
    match obstacle.kind:
        case "sphere":
            return replace(obstacle, kind="cylinder", rotation=np.eye(3), size=np.array([size[0], np.inf, 0.0]))
        case "plane" if upright[2] or abs(obstacle.rotation[2, 2]) < 1e-9:
            return obstacle
        case "capsule" | "cylinder" if upright[2]:
            return replace(obstacle, kind="cylinder", size=np.array([size[0], np.inf, 0.0]))
        case "box" if upright.any():
            size[upright] = np.inf
            return replace(obstacle, size=size)
    raise InputError(
        f"obstacle {obstacle.name!r}: got a tilted {obstacle.kind}, want it upright for a robot that moves in the plane"
    )


# The numba subset from here on: scalars, flat arrays, no allocation. `row` is where an obstacle's numbers start.


def signed_distance(data, row: int, x: float, y: float, z: float) -> float:
    """Signed distance of (x, y, z) to the obstacle whose `ROW` numbers start at `data[row]`; negative inside."""
    kind = data[row]
    dx, dy, dz = x - data[row + 1], y - data[row + 2], z - data[row + 3]
    c = data[row + 6] * dx + data[row + 9] * dy + data[row + 12] * dz
    if kind == 0:
        return c
    radius, half = data[row + 13], data[row + 14]
    if kind == 1:
        return sqrt(dx * dx + dy * dy + dz * dz) - radius
    a = data[row + 4] * dx + data[row + 7] * dy + data[row + 10] * dz
    b = data[row + 5] * dx + data[row + 8] * dy + data[row + 11] * dz
    if kind == 2:
        c -= min(max(c, -half), half)
        return sqrt(a * a + b * b + c * c) - radius
    if kind == 3:
        side, end = sqrt(a * a + b * b) - radius, abs(c) - half
        return sqrt(side * side + end * end) if side > 0 and end > 0 else max(side, end)
    a, b, c = abs(a) - data[row + 13], abs(b) - data[row + 14], abs(c) - data[row + 15]
    inside = max(a, b, c)
    a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    return sqrt(a * a + b * b + c * c) if inside > 0 else inside


def signed_distance_derivatives(data, row: int, x: float, y: float, z: float, gradient, hessian) -> float:
    """Signed distance as above; writes its gradient (3,) and Hessian (3, 3).

    With `v` the vector from the nearest point (or axis) and `q` its length, the gradient is `v / q` and the Hessian
    `(F - gradient gradient') / q`, where F projects on the directions in which the obstacle is round there. On an axis
    or in a centre, where neither exists, both are zero.
    """
    kind = data[row]
    dx, dy, dz = x - data[row + 1], y - data[row + 2], z - data[row + 3]
    nx, ny, nz = data[row + 6], data[row + 9], data[row + 12]  # the axis; a plane's normal
    along = nx * dx + ny * dy + nz * dz
    if kind == 4:
        return box_derivatives(data, row, dx, dy, dz, gradient, hessian)
    if kind == 0:
        return flat_derivatives(along, 1.0, nx, ny, nz, gradient, hessian)
    radius, half = data[row + 13], data[row + 14]
    # What is round in all directions has a centre, nearest on the axis at `shift`; a side is flat along the axis.
    shift, flat = 0.0, 0.0
    if kind == 2:
        shift = min(max(along, -half), half)
        flat = 1.0 if abs(along) < half else 0.0
    elif kind == 3:
        shift, flat = along, 1.0
    vx, vy, vz = dx - shift * nx, dy - shift * ny, dz - shift * nz
    length = sqrt(vx * vx + vy * vy + vz * vz)
    if kind == 3:
        side, end = length - radius, abs(along) - half
        sign = 1.0 if along > 0 else -1.0
        if side > 0 and end > 0:
            return rim_derivatives(data, row, side, end * sign, vx, vy, vz, gradient, hessian)
        if end > side:
            return flat_derivatives(end, sign, nx, ny, nz, gradient, hessian)
    inverse = 1 / length if length >= 1e-12 else 0.0
    gradient[0], gradient[1], gradient[2] = inverse * vx, inverse * vy, inverse * vz
    for i in range(3):
        for j in range(3):
            round_there = (1.0 if i == j else 0.0) - flat * data[row + 6 + 3 * i] * data[row + 6 + 3 * j]
            hessian[i, j] = inverse * (round_there - gradient[i] * gradient[j])
    return length - radius


def flat_derivatives(distance: float, sign: float, nx: float, ny: float, nz: float, gradient, hessian) -> float:
    """A face with the normal `sign n`, at that distance."""
    gradient[0], gradient[1], gradient[2] = sign * nx, sign * ny, sign * nz
    for i in range(3):
        for j in range(3):
            hessian[i, j] = 0.0
    return distance


def rim_derivatives(
    data, row: int, side: float, end: float, vx: float, vy: float, vz: float, gradient, hessian
) -> float:
    """The rim of a cylinder, from `side` beyond its side, `end` (signed) along its axis, `v` from its axis.

    Round in the radial and the axial direction; along the rim it turns with the side.
    """
    radial = sqrt(vx * vx + vy * vy + vz * vz)
    distance = sqrt(side * side + end * end)
    outward = stack(3)
    outward[0], outward[1], outward[2] = vx / radial, vy / radial, vz / radial
    for i in range(3):
        gradient[i] = (side * outward[i] + end * data[row + 6 + 3 * i]) / distance
    for i in range(3):
        for j in range(3):
            across = outward[i] * outward[j] + data[row + 6 + 3 * i] * data[row + 6 + 3 * j]
            around = (1.0 if i == j else 0.0) - across
            hessian[i, j] = (across - gradient[i] * gradient[j] + around * side / radial) / distance
    return distance


def box_derivatives(data, row: int, dx: float, dy: float, dz: float, gradient, hessian) -> float:
    """A box, from `d` from its centre: as `signed_distance_derivatives`."""
    beyond, sign = stack(3), stack(3)
    deepest, face = -inf, 0
    for k in range(3):
        local = data[row + 4 + k] * dx + data[row + 7 + k] * dy + data[row + 10 + k] * dz
        beyond[k] = abs(local) - data[row + 13 + k]
        sign[k] = 1.0 if local > 0 else -1.0
        if beyond[k] > deepest:
            deepest, face = beyond[k], k
    if not deepest > 0:
        axis = row + 4 + face
        return flat_derivatives(deepest, sign[face], data[axis], data[axis + 3], data[axis + 6], gradient, hessian)
    distance = 0.0
    for k in range(3):
        beyond[k] = max(beyond[k], 0.0)
        distance += beyond[k] * beyond[k]
    distance = sqrt(distance)
    for i in range(3):
        gradient[i] = 0.0
        for k in range(3):
            gradient[i] += data[row + 4 + 3 * i + k] * sign[k] * beyond[k] / distance
    for i in range(3):
        for j in range(3):
            total = -gradient[i] * gradient[j]
            for k in range(3):
                if beyond[k] > 0:
                    total += data[row + 4 + 3 * i + k] * data[row + 4 + 3 * j + k]
            hessian[i, j] = total / distance
    return distance
