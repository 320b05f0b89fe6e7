"""Obstacles, which are primitives and convex hulls, and the world, a set of them. Kernels compute the distances."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Finite, OneOf, Want, checked
from lqrsim.errors import Array, InputError, check_array, check_name, check_text, keep, real
from lqrsim.kernels.declarations import ROW
from lqrsim.kernels.distances import hull_distance, signed_distance

# Spaces of a position: "xyz", or a plane by its two axes in their order.
SPACE = "xyz"
PLANES = tuple(a + b for a in SPACE for b in SPACE if a != b)

KINDS = ("plane", "sphere", "capsule", "cylinder", "box", "mesh")
# MuJoCo's types for which no distance is implemented here. Robots from an MJCF use MuJoCo's distances.
OTHER_KINDS = ("ellipsoid", "hfield", "sdf")
FLAT = 1e-9  # m, thickness of what has none


@dataclass(frozen=True, eq=False)
class Obstacle:
    """One primitive or convex hull, with sizes and axes as in MuJoCo. `of_corners` makes a hull.

    Attributes:
      kind: one of `KINDS`, or of `OTHER_KINDS`, to which only `MjcfRobot.geoms` computes distances.
      position: (3,) in metres.
      rotation: (3, 3) with the local axes as columns. The free side of a plane is its local +z; capsules and cylinders
        lie along their local z.
      size: (3,) in metres: sphere (radius, 0, 0); capsule and cylinder (radius, half length, 0), the latter infinite if
        the half length is; box half lengths, and for other kinds the half lengths of the bounding box; plane (0, 0, 0).
        Boxes, and meshes along their local z, may be infinite.
      velocity: (3,) in m/s, of an obstacle that moves in a straight line, from `position` at time 0. Plans take it into
        account; in the scene that MuJoCo simulates, the obstacle stands still.
      corners: (C, 3) in m in local axes, of a mesh, which is their convex hull; from `position`, the middle of the box.
    """

    name: str
    kind: str
    position: Array
    rotation: Array
    size: Array
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    corners: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        check_text("obstacle: name", self.name, "a name", at_most=1000)
        who = f"obstacle {self.name!r}"
        check_name(f"{who}: kind", self.kind, (*KINDS, *OTHER_KINDS))
        shapes = {"position": (3,), "rotation": (3, 3), "size": (3,), "velocity": (3,), "corners": (None, 3)}
        for name, shape in shapes.items():
            keep(self, **{name: check_array(f"{who}: {name}", getattr(self, name), shape, infinite=name == "size")})
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-6):
            raise InputError(f"{who}: rotation: got {self.rotation.tolist()}, want orthonormal axes")
        used = {"plane": 0, "sphere": 1, "capsule": 2, "cylinder": 2}.get(self.kind, 3)
        if (self.size[:used] <= 0).any():
            raise InputError(f"{who}: size: got {self.size[:used].tolist()}, want lengths above 0")
        if len(self.corners) and self.kind != "mesh":
            raise InputError(f"{who}: corners: got {len(self.corners)}, want none for a {self.kind}")

    @classmethod
    def of_corners(cls, name: str, corners: npt.ArrayLike, *, velocity: npt.ArrayLike = (0.0, 0.0, 0.0)) -> "Obstacle":
        """The convex hull of points (C, 3) in the world, in m; of points (C, 2), a prism that is infinitely high."""
        name = check_text("obstacle: name", name, "a name", at_most=1000)
        who = f"obstacle {name!r}: corners"
        points = real(who, corners)
        if points.ndim != 2 or points.shape[1] not in (2, 3) or not len(points):
            raise InputError(f"{who}: got shape {points.shape}, want (C, 2) or (C, 3), at least one")
        flat, size = np.zeros((len(points), 3)), np.full(3, np.inf)
        flat[:, : points.shape[1]] = points
        low, high = flat.min(axis=0), flat.max(axis=0)
        size[: points.shape[1]] = np.maximum(high - low, FLAT)[: points.shape[1]] / 2
        return cls(name, "mesh", (low + high) / 2, np.eye(3), size, real("velocity", velocity), flat - (low + high) / 2)

    @classmethod
    def _of_mujoco(cls, **fields: Any) -> "Obstacle":
        """Make an obstacle that MuJoCo has compiled, without checks: there can be tens of thousands."""
        obstacle = object.__new__(cls)
        vars(obstacle).update(fields)
        return obstacle

    def _equals(self, other: "Obstacle", *fields: str) -> bool:
        return self is other or all(np.array_equal(getattr(self, field), getattr(other, field)) for field in fields)

    def _check_kind(self) -> None:
        """Raise InputError unless a distance to it is implemented here."""
        if self.kind not in KINDS or (self.kind == "mesh" and not len(self.corners)):
            raise InputError(
                f"obstacle {self.name!r}: got a {self.kind}, want one of: {', '.join(KINDS)} with corners; or an"
                " MjcfRobot, with geoms=robot.geoms, whose distances are MuJoCo's"
            )

    @property
    def row(self) -> Array:
        """This obstacle as `ROW` numbers."""
        self._check_kind()
        high = np.inf if self.size[2] == np.inf else 0.0
        size = (0.0, len(self.corners), high) if len(self.corners) else self.size
        return np.concatenate([[KINDS.index(self.kind)], self.position, self.rotation.ravel(), size])


@checked
@dataclass(frozen=True, eq=False)
class World:
    """A set of obstacles, in the order in which they are numbered."""

    _want = "a World, such as scene.world"

    obstacles: Annotated[Sequence[Obstacle], Want("a list of Obstacle")] = ()

    def __len__(self) -> int:
        return len(self.obstacles)

    def __repr__(self) -> str:
        names = [repr(name) for name in self.names[:3]] + ["..."] * (len(self) > 3)
        return f"World({len(self)} obstacle{'s' * (len(self) > 1)}: {', '.join(names)})" if names else "World()"

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(obstacle.name for obstacle in self.obstacles)

    @cached_property
    def table(self) -> Array:
        """The obstacles as compiled code reads them: `ROW` numbers of each, then the corners of meshes."""
        return self.tables([0.0])[0]

    @cached_property
    def moving(self) -> bool:
        """Whether any obstacle moves."""
        return any(obstacle.velocity.any() for obstacle in self.obstacles)

    @cached_property
    def has_meshes(self) -> bool:
        """Whether any obstacle is a convex hull of corners."""
        return any(obstacle.kind == "mesh" for obstacle in self.obstacles)

    def displacements(self, times: npt.ArrayLike) -> Array:
        """The displacements (K, len(self), 3) in m of the obstacles at times (K,) in s since time 0 of the run."""
        velocities = np.array([obstacle.velocity for obstacle in self.obstacles]).reshape(len(self), 3)
        return np.multiply.outer(check_array("times", times, (None,)), velocities)

    def tables(self, times: npt.ArrayLike) -> tuple[Array, int]:
        """The same at times (K,) in s: K tables or, if nothing moves, one, then the corners; and the number of tables.

        In place of its size the row of a mesh has the place of its corners, from the row on, their number, and inf for
        a prism, else 0.
        """
        shifts = self.displacements(times) if self.moving else np.zeros((1, len(self), 3))
        rows = np.array([obstacle.row for obstacle in self.obstacles]).reshape(len(self), ROW)
        tables = np.repeat(rows[None], len(shifts), axis=0)
        tables[:, :, 1:4] += shifts
        corner_starts = tables.size + np.cumsum([0, *(obstacle.corners.size for obstacle in self.obstacles)])[:-1]
        meshes = [number for number, obstacle in enumerate(self.obstacles) if len(obstacle.corners)]
        row_starts = ROW * np.arange(len(shifts) * len(self)).reshape(tables.shape[:2])
        tables[:, meshes, 13] = (corner_starts - row_starts)[:, meshes]
        return np.concatenate([tables.ravel(), *(obstacle.corners.ravel() for obstacle in self.obstacles)]), len(shifts)

    @checked
    def moved(self, seconds: Finite) -> "World":
        """The world after some seconds, or before if they are negative: each obstacle has moved at its velocity.

        An obstacle that is seen at the time t of a run goes into its problem as `ls.World([seen]).moved(-t)`.
        """
        if not self.moving:
            return self
        return World(
            [replace(obstacle, position=obstacle.position + seconds * obstacle.velocity) for obstacle in self.obstacles]
        )

    @checked
    def seen_by(self, plane: Annotated[str, OneOf((SPACE, *PLANES))], offset: Finite | None = None) -> "World":
        """The world of a robot whose position is in that plane, in the plane's coordinates: see `Coordinates`.

        A robot in space ("xyz") sees this world itself. For a plane, its two axes become x and y, in their order; the
        third axis is normal to it.

        With an offset, this world is cut by the plane: distances are in space, from the points of the plane, where the
        robot is a ball, and a floor is a wall. Without an offset, in a horizontal plane, the world is seen from above:
        heights do not count, upright obstacles are infinitely high, and a sphere counts with its equator. In both
        cases, planes parallel to the robot's plane, such as the floor under a horizontal plane, bound nothing.
        """
        if plane == SPACE:
            return self
        seen: dict[tuple[str, float | None], World] = vars(self).setdefault("_seen", {})
        if (plane, offset) not in seen:
            seen[plane, offset] = self._seen_by(plane, offset)
        return seen[plane, offset]

    def _seen_by(self, plane: str, offset: float | None) -> "World":
        if offset is None and plane not in ("xy", "yx"):
            wanted = "its coordinate along the third axis, in metres"
            raise InputError(f"offset: got none for the plane {plane!r}, want {wanted}")
        obstacles = self.obstacles if offset is not None else [_from_above(obstacle) for obstacle in self.obstacles]
        if plane == "xy" and offset is None:
            return World([obstacle for obstacle in obstacles if not _parallel(obstacle, 2)])
        first, second = (SPACE.index(letter) for letter in plane)
        across = 3 - first - second
        turn = np.zeros((3, 3))  # to the plane's axes: a rotation, which only exchanges the world's axes
        turn[0, first] = turn[1, second] = 1.0
        turn[2] = np.cross(turn[0], turn[1])
        origin = np.zeros(3)
        origin[across] = 0.0 if offset is None else offset

        def seen(obstacle: Obstacle) -> Obstacle:
            position, rotation = turn @ (obstacle.position - origin), turn @ obstacle.rotation
            return replace(obstacle, position=position, rotation=rotation, velocity=turn @ obstacle.velocity)

        return World([seen(obstacle) for obstacle in obstacles if not _parallel(obstacle, across)])

    def upright(self) -> "World":
        """The obstacles of a plane as infinite prisms. Raises InputError if an outline depends on the height."""
        return World([_prism(obstacle) for obstacle in self.obstacles])

    def distances(self, point: npt.ArrayLike) -> Array:
        """The signed distances (len(self),) in m of a point (3,), or (2,) in a plane; negative inside an obstacle."""
        x, y, z = (*_places("point", point, single=True).tolist(), 0.0)[:3]
        return np.array([
            hull_distance(self.table, ROW * i, np.array([x, y, z]), 0, 1, np.empty(3)) if obstacle.kind == "mesh"
            else signed_distance(self.table, ROW * i, x, y, z)
            for i, obstacle in enumerate(self.obstacles)
        ])  # fmt: skip

    def distance(self, points: npt.ArrayLike) -> Array:
        """The signed distance in m to the nearest obstacle, (...), of points (..., 2 or 3); infinite without any."""
        points = _places("points", points)
        distances = [self.distances(point).min(initial=np.inf) for point in points.reshape(-1, points.shape[-1])]
        return np.array(distances).reshape(points.shape[:-1])

    def nearest(self, points: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """The index of the nearest obstacle, (...), at points (..., 2 or 3)."""
        if not self.obstacles:
            raise InputError("nearest: got a world without obstacles, want at least one")
        points = _places("points", points)
        indices = [int(self.distances(point).argmin()) for point in points.reshape(-1, points.shape[-1])]
        return np.array(indices, dtype=np.int64).reshape(points.shape[:-1])


def _places(field: str, points: npt.ArrayLike, *, single: bool = False) -> Array:
    """Points (..., 2 or 3), or a single point, as an array. Raises InputError for anything else."""
    array = real(field, points)
    if array.shape[-1:] not in ((2,), (3,)) or (single and array.ndim > 1):
        raise InputError(f"{field}: got shape {array.shape}, want {'' if single else '..., '}2 or 3 coordinates")
    return array


def _parallel(obstacle: Obstacle, across: int) -> bool:
    """Whether an obstacle is a plane with its normal along that axis of the world."""
    return obstacle.kind == "plane" and bool(abs(abs(obstacle.rotation[across, 2]) - 1) < 1e-9)


def _prism(obstacle: Obstacle) -> Obstacle:
    """An obstacle of a plane as an infinite prism. Raises InputError if its outline depends on the height."""
    obstacle._check_kind()
    axis = np.abs(obstacle.rotation[2])  # how much of each local axis is along the normal of the plane
    up, high, size = int(axis.argmax()), abs(obstacle.position[2]), obstacle.size.copy()
    size[up], cylinder_size = np.inf, np.array([obstacle.size[0], np.inf, 0.0])
    match obstacle.kind:
        case "plane" if axis[2] < 1e-9:
            return obstacle
        case "sphere" if not high:
            return replace(obstacle, kind="cylinder", rotation=np.eye(3), size=cylinder_size)
        case "capsule" | "cylinder" if axis[2] > 1 - 1e-9 and high <= obstacle.size[1]:
            return replace(obstacle, kind="cylinder", size=cylinder_size)
        case "box" if axis[up] > 1 - 1e-9 and high <= obstacle.size[up] and np.isfinite(np.delete(size, up)).all():
            return replace(obstacle, size=size)
        case "mesh" if axis[2] > 1 - 1e-9 and obstacle.size[2] == np.inf:
            return obstacle
    raise InputError(
        f"obstacle {obstacle.name!r}: got a {obstacle.kind} across the plane of hulls=, want it upright on the plane,"
        " and of finite width; or balls without hulls"
    )


def _from_above(obstacle: Obstacle) -> Obstacle:
    """The obstacle with infinite height; planes are unchanged. Raises InputError if it is tilted."""
    upright = np.abs(np.abs(obstacle.rotation[2]) - 1) < 1e-9  # flags of a vertical local axis
    size = obstacle.size.copy()
    if obstacle.kind == "ellipsoid" and upright.any() and np.ptp(size[~upright]) == 0:  # a circle from above
        size = np.array([size[~upright][0], np.inf, 0.0])
        return replace(obstacle, kind="cylinder", rotation=np.eye(3), size=size)
    obstacle._check_kind()
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
        case "mesh" if obstacle.size[2] < np.inf or upright[2]:  # its outline, from whatever side
            corners = obstacle.corners @ obstacle.rotation.T * (1, 1, 0)
            half = np.maximum(np.abs(corners).max(axis=0), FLAT)
            return replace(obstacle, rotation=np.eye(3), size=np.array([*half[:2], np.inf]), corners=corners)
    raise InputError(
        f"obstacle {obstacle.name!r}: got a tilted {obstacle.kind}, want it upright for a robot that moves in the plane"
    )
