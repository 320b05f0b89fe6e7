"""Obstacles as primitives, and the one place where the distance to each is written down.

`signed_distance` and `signed_distance_derivatives` are scalar functions in the subset of Python that numba compiles:
they run here as they are, and `compiled.py` puts the same text into every compiled core.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import sqrt

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_array, check_name

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
        object.__setattr__(self, "obstacles", tuple(self.obstacles))

    def __len__(self) -> int:
        return len(self.obstacles)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(obstacle.name for obstacle in self.obstacles)

    @cached_property
    def table(self) -> Array:
        """The obstacles as numbers, (len(self), ROW)."""
        return np.array([obstacle.row for obstacle in self.obstacles]).reshape(len(self), ROW)

    def seen_by(self, dimension: int) -> "World":
        """The world of a robot whose position has `dimension` coordinates.

        In space (3) it is this one. In the plane (2) it is this one seen from above: upright obstacles reach from the
        floor to the sky, a sphere counts with its equator, and horizontal planes, the floor first, bound nothing.

        Raises:
          InputError: an obstacle is tilted, so that it has no outline from above among the primitives.
        """
        if dimension == 3:
            return self
        return World([flat for obstacle in self.obstacles if (flat := _from_above(obstacle)) is not None])

    def distances(self, point: npt.ArrayLike) -> Array:
        """Signed distances in metres to each obstacle, (len(self),), of one point (2,) or (3,); negative inside."""
        x, y, z = (*np.asarray(point, dtype=np.float64).tolist(), 0.0)[:3]
        data = self.table.ravel()
        return np.array([signed_distance(data, ROW * i, x, y, z) for i in range(len(self))])

    def distance(self, points: npt.ArrayLike) -> Array:
        """Signed distance in metres to the nearest obstacle, (...), of points (..., 2 or 3); infinite without any."""
        points = np.asarray(points, dtype=np.float64)
        flat = [self.distances(point).min(initial=np.inf) for point in points.reshape(-1, points.shape[-1])]
        return np.array(flat).reshape(points.shape[:-1])

    def nearest(self, points: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Which obstacle is nearest, (...), at points (..., 2 or 3). Raises InputError in an empty world."""
        if not self.obstacles:
            raise InputError("nearest: got a world without obstacles, want at least one")
        points = np.asarray(points, dtype=np.float64)
        flat = [int(self.distances(point).argmin()) for point in points.reshape(-1, points.shape[-1])]
        return np.array(flat, dtype=np.int64).reshape(points.shape[:-1])


def _from_above(obstacle: Obstacle) -> Obstacle | None:
    """The obstacle with infinite height, or None for a horizontal plane. Raises InputError if it is tilted."""
    upright = np.abs(np.abs(obstacle.rotation[2]) - 1) < 1e-9  # which local axis is vertical, if one is
    size = obstacle.size.copy()
    match obstacle.kind:
        case "sphere":
            return replace(obstacle, kind="cylinder", rotation=np.eye(3), size=np.array([size[0], np.inf, 0.0]))
        case "plane" if upright[2]:
            return None
        case "plane" if abs(obstacle.rotation[2, 2]) < 1e-9:
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
    kind = int(data[row])
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

    With `v` the vector from the nearest point (or axis) and `q` the distance from it, the gradient is `v / q` and the
    Hessian `(F - gradient gradient') / q`, where F projects on the directions in which the obstacle is round there.
    On an axis or in a centre, where neither exists, both are zero.
    """
    kind = int(data[row])
    dx, dy, dz = x - data[row + 1], y - data[row + 2], z - data[row + 3]
    # Local coordinates, and from them the vector v and the directions F, both in the local axes.
    a = data[row + 4] * dx + data[row + 7] * dy + data[row + 10] * dz
    b = data[row + 5] * dx + data[row + 8] * dy + data[row + 11] * dz
    c = data[row + 6] * dx + data[row + 9] * dy + data[row + 12] * dz
    fa, fb, fc = 1.0, 1.0, 1.0
    offset = 0.0
    extra = 0.0  # curvature of a cylinder's side where the rim is nearest
    ra, rb = 0.0, 0.0  # its radial direction
    if kind == 0:
        va, vb, vc, fa, fb, fc = 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
        distance, length = c, 1.0
    elif kind == 1 or kind == 2:
        va, vb, vc = a, b, c
        if kind == 2:
            half = data[row + 14]
            if abs(c) < half:
                vc, fc = 0.0, 0.0
            else:
                vc = c - half if c > 0 else c + half
        offset = data[row + 13]
        length = sqrt(va * va + vb * vb + vc * vc)
        distance = length - offset
    elif kind == 3:
        radial = sqrt(a * a + b * b)
        side, end = radial - data[row + 13], abs(c) - data[row + 14]
        sign = 1.0 if c > 0 else -1.0
        if side > 0 and end > 0:
            ra, rb = a / radial, b / radial
            va, vb, vc = side * ra, side * rb, sign * end
            length = sqrt(side * side + end * end)
            distance = length
            # The rim is round in the radial and the axial direction; along the rim it turns with the side.
            extra = side / (length * radial)
        elif side >= end:
            va, vb, vc, fc = a, b, 0.0, 0.0
            length, distance = radial, side
        else:
            va, vb, vc, fa, fb, fc = 0.0, 0.0, sign, 0.0, 0.0, 0.0
            length, distance = 1.0, end
    else:
        qa, qb, qc = abs(a) - data[row + 13], abs(b) - data[row + 14], abs(c) - data[row + 15]
        sa, sb, sc = 1.0 if a > 0 else -1.0, 1.0 if b > 0 else -1.0, 1.0 if c > 0 else -1.0
        distance = max(qa, qb, qc)
        va, vb, vc = 0.0, 0.0, 0.0
        if distance > 0:
            fa, fb, fc = 1.0 if qa > 0 else 0.0, 1.0 if qb > 0 else 0.0, 1.0 if qc > 0 else 0.0
            va, vb, vc = fa * sa * qa if qa > 0 else 0.0, sb * qb if qb > 0 else 0.0, sc * qc if qc > 0 else 0.0
            length = sqrt(va * va + vb * vb + vc * vc)
            distance = length
        else:
            fa, fb, fc, length = 0.0, 0.0, 0.0, 1.0
            if qa == distance:
                va = sa
            elif qb == distance:
                vb = sb
            else:
                vc = sc
    # The gradient of a flat face has length one without being divided by q, and no curvature: length is 1 there.
    if length < 1e-12:
        inverse, curvature = 0.0, 0.0
    else:
        inverse = 1.0 / length
        curvature = inverse if fa + fb + fc > 0 else 0.0
    ga, gb, gc = va * inverse, vb * inverse, vc * inverse
    if extra > 0:
        # (radial radial' + axial axial' - g g') / q + (tangential tangential') extra
        haa = curvature * (ra * ra - ga * ga) + extra * rb * rb
        hbb = curvature * (rb * rb - gb * gb) + extra * ra * ra
        hab = curvature * (ra * rb - ga * gb) - extra * ra * rb
    else:
        haa, hbb, hab = curvature * (fa - ga * ga), curvature * (fb - gb * gb), -curvature * ga * gb
    hcc, hac, hbc = curvature * (fc - gc * gc), -curvature * ga * gc, -curvature * gb * gc
    for i in range(3):
        ia, ib, ic = data[row + 4 + 3 * i], data[row + 5 + 3 * i], data[row + 6 + 3 * i]
        gradient[i] = ia * ga + ib * gb + ic * gc
        ha, hb, hc = ia * haa + ib * hab + ic * hac, ia * hab + ib * hbb + ic * hbc, ia * hac + ib * hbc + ic * hcc
        for j in range(3):
            hessian[i, j] = ha * data[row + 4 + 3 * j] + hb * data[row + 5 + 3 * j] + hc * data[row + 6 + 3 * j]
    return distance
