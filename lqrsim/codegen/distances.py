"""Distances of points to the obstacles of a world, by compiled code."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.compiled_module import CompiledModule, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels import obstacle_distances
from lqrsim.scenes.world import World


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
    return module_of(source_of(obstacle_distances), "distances to obstacles")
