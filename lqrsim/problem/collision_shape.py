"""The collision shape of a robot: a ball at its position, several balls or hulls of them, or the geoms of an MJCF.

`ShapeInWorld` is such a shape among obstacles, with the methods that plans, chances of collision and simulations need.
"""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.compiled_module import CompiledModule, module_of
from lqrsim.codegen.sources import Source, source_of
from lqrsim.codegen.user_functions import UserFunction
from lqrsim.errors import Array, InputError
from lqrsim.kernels import distances
from lqrsim.problem.collision_spheres import CollisionSpheres, SphereCenters, evaluate, evaluate_slopes, one_at
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.residual import Residual
from lqrsim.scenes.scene import Scene
from lqrsim.scenes.world import World


@dataclass(frozen=True, eq=False)
class GeomDistances(Residual):
    """Distances between parts of a robot and obstacles, made for one system.

    Attributes:
      obstacles: the number of each row's obstacle, or -1 for the nearest obstacle.
    """

    obstacles: tuple[int, ...]


class CollisionGeoms(abc.ABC):
    """The colliding geoms of a robot, with distances computed by its simulator, such as `MjcfRobot.geoms`.

    `ObstacleCost(world, geoms=...)` and `Clearance(world, geoms=...)` keep all these geoms clear.
    """

    @property
    @abc.abstractmethod
    def size(self) -> float:
        """The radius of the largest geom's bounding sphere, in metres."""

    @abc.abstractmethod
    def in_world(self, dynamics: Dynamics, world: World) -> "ShapeInWorld":
        """The geoms among obstacles, which must be in the robot's MJCF; the dynamics are the robot's."""

    @abc.abstractmethod
    def of_scene(self, scene: Scene) -> bool:
        """Whether these geoms belong to that scene, with its obstacles."""


@dataclass(frozen=True, eq=False)
class ShapeInWorld:
    """A robot's collision shape among obstacles: one ball or several; `robots/mjcf_shapes.py` has that of geoms.

    Its *places* at states (..., n) are the centres of its balls, (..., B, 2 or 3) in m; for geoms, they are the states,
    (..., 1, n).

    Attributes:
      dynamics: the robot's dynamics. world: the obstacles, in the coordinates of the places.
      radii: radii of the balls, or hulls, in m, (P,); for geoms, the radius of the largest geom.
      names: their names. centers: the centres of the balls; None for one ball at the robot's position.
      hulls: number of balls of each hull; None for balls by themselves among primitives.
    """

    dynamics: Dynamics
    world: World
    radii: Array
    names: tuple[str, ...] = ("",)
    centers: SphereCenters | None = None
    hulls: tuple[int, ...] | None = None

    @property
    def depends_on(self) -> tuple[int, ...]:
        """The states that the places depend on, by their indices."""
        return self.dynamics.state_coordinates.position if self.centers is None else self.centers.depends_on

    @property
    def in_plane(self) -> bool:
        """Whether the places are in the plane of the robot's position."""
        return len(self.dynamics.state_coordinates.position) == 2 if self.centers is None else self.centers.in_plane

    def distances(self, reach: float) -> GeomDistances | None:
        """The distances of geoms up to `reach` in m, among obstacles that stand still.

        None for balls, whose distances have second derivatives.
        """
        return None

    def placed(self, module: str, numbers: Array) -> tuple[Source, Array, tuple[UserFunction, ...]]:
        """The kernel of a module for these balls, with AT, BALLS and AXES; its data with its own; and its functions."""
        centers, axes = self.centers, self.depends_on
        if centers is None:
            return source_of(module, AXES=axes), numbers, ()
        kernel = source_of(
            module, AT=centers.numbers, BALLS=self.balls, PARTS=len(self.radii), AXES=axes, HULLS=int(bool(self.hulls))
        )
        filled = kernel.filled(places=centers.code, places_jacobian=centers.code)
        return filled, np.concatenate([centers.data, numbers]), centers.functions

    @property
    def sizes(self) -> tuple[int, ...]:
        """The number of balls of each part: of each hull, or 1."""
        return self.hulls or (1,) * len(self.radii)

    @property
    def balls(self) -> int:
        return sum(self.sizes)

    @property
    def parts(self) -> Array:
        """For the kernels: the radius of each part, and for hulls the first ball of each, and the end of the last."""
        return np.concatenate([self.radii, np.cumsum([0, *self.hulls])]) if self.hulls else self.radii

    def places(self, states: Array) -> Array:
        """The places at states (..., n)."""
        if self.centers is None:
            return states[..., None, list(self.depends_on)]
        return evaluate(self.centers, self.balls, states)

    def clearance(self, places: Array, displaced: Array | None = None) -> Array:
        """Signed distance to the nearest obstacle, minus the radius, at places: (...) in m; infinite without obstacles.

        Args:
          displaced: (K, O, 3) in m, displacements of the obstacles; the first axis of the places is then K.
        """
        if not len(self.world):
            return np.full(places.shape[:-2], np.inf)
        if self.hulls:
            distances, _ = hull_distances(self.world, places, self.hulls, displaced)
            return (distances - self.radii[:, None]).min(axis=(-2, -1))
        return (signed_distance(self.world, places, displaced) - self.radii).min(axis=-1)

    def with_slopes(self, states: Array, along: Sequence[int]) -> tuple[Array, Array]:
        """Clearance of each obstacle at states (K, n), (K, O) in m, and its derivatives in some states, (K, O, p).

        Both belong to the nearest ball, or hull.
        """
        knots, axes = np.arange(len(states))[:, None], list(self.depends_on)
        if self.centers is None:
            places, slopes = self.places(states), np.eye(states.shape[1])[None, None, axes].repeat(len(states), 0)
        else:
            places, slopes = evaluate_slopes(self.centers, self.balls, states)
        distances, corner_slopes = hull_distances(self.world, places, self.sizes)
        clearance = distances - self.radii[:, None]
        chosen = knots, clearance.argmin(axis=1), np.arange(len(self.world))
        corners = np.cumsum([0, *self.sizes[:-1]])[:, None] + np.arange(max(self.sizes))  # of each part
        moves = slopes[knots[..., None], np.minimum(corners, self.balls - 1)[chosen[1]]][..., list(along)]
        return clearance[chosen], np.einsum("kocd,kocdi->koi", corner_slopes[chosen][..., : moves.shape[-2]], moves)

    def nearest(self, places: Array, displaced: Array) -> int:
        """The number of the obstacle that is nearest at places (B, 2 or 3), when displaced by (O, 3)."""
        distances, _ = hull_distances(self.world, places[None], self.sizes, displaced[None])
        larger = self.radii - self.radii.min()  # a radius that all share changes no order, except by rounding
        return int((distances[0] - larger[:, None]).min(axis=0).argmin())

    def travel(self, before: Array, after: Array) -> Array:
        """The largest distance that any point moves on a straight line between places, (...) in m."""
        return np.linalg.norm(after - before, axis=-1).max(axis=-1)

    def inside(self, state: Array) -> tuple[str, str] | None:
        """The place in an obstacle of a state, which may have NaNs, and the remedy, as texts; None if it is clear."""
        if not len(self.world):
            return None
        ends = np.cumsum(self.sizes)[:-1]
        for name, radius, corners in zip(self.names, self.radii, np.split(self.places(state), ends), strict=True):
            if np.isnan(corners).any():
                continue
            place = corners.mean(axis=0)
            distances = hull_distances(self.world, corners[None], [len(corners)])[0][0, 0] - radius
            if distances.min() < 0:
                which, whose = (f"with {name!r} ", "its radius") if name else ("", "the robot's radius")
                at, deep = ", ".join(f"{value:g}" for value in place), -distances.min()
                obstacle = self.world.names[int(distances.argmin())]
                where = f"{which}at ({at}) m, {deep:.3g} m inside obstacle {obstacle!r}"
                return where, f" of obstacles by {whose} of {radius:g} m" if radius else " of obstacles"
        return None

    def across(self, vectors: Array) -> Array:
        """Convert vectors (..., 3) from the axes of the scene to the axes of `world`."""
        space = self.dynamics.state_coordinates
        if not self.in_plane or not space.plane:
            return vectors
        normal = np.cross(*np.eye(3)[list(space.world_axes)])
        return np.concatenate([space.of_world(vectors), (vectors @ normal)[..., None]], axis=-1)


def shape_in(
    dynamics: Dynamics, world: World, *, radius: float = 0.0, balls: CollisionSpheres | None = None,
    geoms: CollisionGeoms | None = None,
) -> ShapeInWorld:  # fmt: skip
    """The shape of a robot among obstacles. A robot without a position is among none by its radius."""
    space = dynamics.state_coordinates
    if geoms is not None:
        return geoms.in_world(dynamics, world)
    if balls is not None:
        centers = balls.bind(dynamics)
        seen = world.seen_by(space.plane or "xy", space.offset) if centers.in_plane else world
        if not balls.hulls:
            hulls = (1,) * len(balls) if seen.has_meshes else None
            return ShapeInWorld(dynamics, seen, balls.radii, balls.names, centers, hulls)
        radii = balls.radii[np.cumsum([0, *balls.hulls[:-1]])]
        seen = seen.upright() if centers.in_plane else seen
        for obstacle in seen.obstacles:
            if obstacle.kind == "box" and np.isinf(obstacle.size).sum() > 1:
                got = "a box that is infinite in two directions"
                raise InputError(f"obstacle {obstacle.name!r}: got {got}, want one of them")
        return ShapeInWorld(dynamics, seen, radii, balls.names, centers, balls.hulls)
    seen = world.seen_by(space.plane, space.offset) if space.position else World()
    if seen.has_meshes:
        return ShapeInWorld(dynamics, seen, np.array([radius]), ("",), one_at(space.position), (1,))
    return ShapeInWorld(dynamics, seen, np.array([radius]))


class KeepsClear:
    """A cost or a constraint that keeps a robot clear of obstacles.

    Attributes:
      world: the obstacles. shape: the robot's shape, as the keyword that was given: radius, balls or geoms.
      radius: the given radius; for balls the largest, for geoms that of the largest bounding sphere.
      balls, geoms: None if not given.
    """

    def _set_shape(
        self, world: World, radius: float | None, balls: CollisionSpheres | None, geoms: CollisionGeoms | None
    ) -> None:
        shape: dict[str, Any] = {"radius": radius, "balls": balls, "geoms": geoms}
        self.shape = {name: stated for name, stated in shape.items() if stated is not None}
        if len(self.shape) != 1:
            got = " and ".join(self.shape) or "none of radius, balls and geoms"
            wanted = "one of them: radius=robot.radius, balls=robot.balls or geoms=robot.geoms"
            raise InputError(f"{type(self).__name__}: got {got}, want {wanted}")
        self.world, self.balls, self.geoms = world, balls, geoms
        largest = geoms.size if geoms is not None else 0.0 if balls is None else float(balls.radii.max())
        self.radius: float = self.shape.get("radius", largest)

    @property
    def kept_clear(self) -> "KeepsClear":
        return self

    def with_added_state(self, dynamics: Dynamics) -> Self:
        return self

    @property
    def moving(self) -> bool:
        return self.world.moving

    def _stated(self) -> Mapping[str, object]:
        own = {name: value for name, value in vars(self).items() if name not in ("shape", "radius", "balls", "geoms")}
        return own | self.shape

    def in_world(self, dynamics: Dynamics, time: float = 0.0) -> ShapeInWorld:
        """The shape among the obstacles, at their positions at a time in s. Raises InputError if it does not fit."""
        if "radius" in self.shape and not dynamics.state_coordinates.position:
            wanted = "Dynamics(..., position=(names)), or balls="
            raise InputError(f"{type(self).__name__}: got dynamics without a position, want {wanted}")
        return shape_in(dynamics, self.world.moved(time) if time else self.world, **self.shape)


def each_once(terms: Sequence[KeepsClear]) -> list[KeepsClear]:
    """The first of each kind: those with other obstacles, or another shape, than all before."""
    distinct: list[KeepsClear] = []
    for term in terms:
        if not any(term.shape == other.shape and _same(term.world, other.world) for other in distinct):
            distinct.append(term)
    return distinct


def _same(one: World, other: World) -> bool:
    """Whether two worlds have the same obstacles in the same order, such as those of one file that was read twice."""
    fields = "name", "kind", "position", "rotation", "size", "velocity", "corners"
    pairs = zip(one.obstacles, other.obstacles, strict=False)
    return len(one) == len(other) and all(mine._equals(its, *fields) for mine, its in pairs)


def signed_distance(world_seen: World, points: npt.ArrayLike, displaced: Array | None = None) -> Array:
    """Distances (...) of points (..., 2 or 3) to the nearest obstacle: `world_seen.distance(points)`, compiled.

    Args:
      displaced: (K, obstacles, 3) displacements of the obstacles; the first axis of the points is then K.
    """
    points, count = np.asarray(points, dtype=np.float64), len(world_seen)
    flat = np.zeros((points[..., 0].size, 3))
    flat[:, : points.shape[-1]] = points.reshape(-1, points.shape[-1])
    displaced, out = np.zeros((1, count, 3)) if displaced is None else displaced, np.empty(len(flat))
    per_displacement = max(1, len(flat) // max(1, len(displaced)))
    # One row for each obstacle, so that their number is not part of the type: another world compiles nothing.
    away = np.ascontiguousarray(displaced, dtype=np.float64).reshape(-1, 3)
    _distances().nearest(count, len(flat), per_displacement, world_seen.table, flat, away, out)
    return out.reshape(points.shape[:-1])


def hull_distances(
    world_seen: World, places: Array, hulls: Sequence[int], displaced: Array | None = None
) -> tuple[Array, Array]:
    """Distances of convex hulls to each obstacle, and their derivatives in the corners.

    Args:
      world_seen: the obstacles; those of hulls in a plane are `World.upright`.
      places: (..., B, 2 or 3), the corners, hull by hull.
      hulls: number of corners of each of H hulls; 1 for a ball.
      displaced: (K, O, 3) displacements of the obstacles; the first axis of the places is then K.

    Returns:
      The distances (..., H, O), and the derivatives (..., H, O, C, 3), for C corners of the largest hull.
    """
    batch, count, widest = places.shape[:-2], len(world_seen), max(hulls)
    flat = np.zeros((int(np.prod(batch)), places.shape[-2], 3))
    flat[..., : places.shape[-1]] = places.reshape(-1, *places.shape[-2:])
    displaced = np.zeros((1, count, 3)) if displaced is None else displaced
    rows, per_displacement = len(flat) * len(hulls) * count, max(1, len(flat) // len(displaced))
    out, corner_slopes = np.empty(rows), np.zeros((rows, 3 * widest))
    _distances().hull_distances(
        count, len(flat), per_displacement, world_seen.table, np.cumsum([0, *hulls], dtype=np.float64),
        len(hulls), flat.reshape(len(flat), -1), np.ascontiguousarray(displaced).reshape(-1, 3), out, corner_slopes,
    )  # fmt: skip
    shape = (*batch, len(hulls), count)
    return out.reshape(shape), corner_slopes.reshape(*shape, widest, 3)


def _distances() -> CompiledModule:
    return module_of(source_of(distances), "distances to obstacles")
