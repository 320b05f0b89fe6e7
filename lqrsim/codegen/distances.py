"""Distances of points to the obstacles of a world, by compiled code."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.compiled_module import CompiledModule, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels import signed_distance as kernel
from lqrsim.scenes.world import World


def signed_distance(world_seen: World, points: npt.ArrayLike) -> Array:
    """Distances (...) of points (..., 2 or 3) to the nearest obstacle: `world_seen.distance(points)`, compiled."""
    points = np.asarray(points, dtype=np.float64)
    flat = points.reshape(1, points[..., 0].size, points.shape[-1])
    still = np.zeros((1, len(world_seen), 3))
    return signed_distance_displaced(world_seen, flat, still).reshape(points.shape[:-1])


def signed_distance_displaced(world_seen: World, points: Array, displaced: Array) -> Array:
    """Distances (K, k) of points (K, k, 2 or 3) to obstacles that have moved by displaced (K, obstacles, 3)."""
    trials, count, size = points.shape
    flat, table, out = np.zeros((trials * count, 3)), np.array(world_seen.table), np.empty(trials * count)
    flat[:, :size] = points.reshape(-1, size)
    # One row for each obstacle, so that their number is not part of the type: another world compiles nothing.
    away = np.ascontiguousarray(displaced, dtype=np.float64).reshape(trials * len(table), 3)
    _distances().nearest(len(table), len(flat), count, table.ravel(), flat, away, out)
    return out.reshape(trials, count)


def distances_with_normals(world_seen: World, points: npt.ArrayLike) -> tuple[Array, Array]:
    """Distances (K, O) of points (K, 2 or 3) to each obstacle, and their gradients (K, O, 2 or 3)."""
    points = np.asarray(points, dtype=np.float64)
    flat, count = np.zeros((len(points), 3)), len(world_seen)
    flat[:, : points.shape[1]] = points
    out, normals = np.empty(len(flat) * count), np.empty((len(flat) * count, 3))
    _distances().each_with_normal(count, len(flat), np.array(world_seen.table).ravel(), flat, out, normals)
    return out.reshape(-1, count), normals.reshape(len(flat), count, 3)[..., : points.shape[1]]


def hull_distances(
    world_seen: World, places: Array, hulls: Sequence[int], displaced: Array | None = None
) -> tuple[Array, Array]:
    """Distances of convex polygons to each obstacle, and their derivatives in the polygons' corners.

    Args:
      places: (..., B, 2 or 3), the corners, polygon by polygon.
      hulls: number of corners of each of H polygons.
      displaced: (K, O, 3) displacements of the obstacles; the first axis of the places is then K.

    Returns:
      The distances (..., H, O), and the derivatives (..., H, O, C, 3), for C corners of the largest polygon.
    """
    many, count, widest = places.shape[:-2], len(world_seen), max(hulls)
    flat = np.zeros((int(np.prod(many)), places.shape[-2], 3))
    flat[..., : places.shape[-1]] = places.reshape(-1, *places.shape[-2:])
    displaced = np.zeros((1, count, 3)) if displaced is None else displaced
    rows, each = len(flat) * len(hulls) * count, max(1, len(flat) // len(displaced))
    out, pulls = np.empty(rows), np.zeros((rows, 3 * widest))
    _distances().hull_distances(
        count, len(flat), each, np.array(world_seen.table).ravel(), np.cumsum([0, *hulls], dtype=np.float64),
        len(hulls), flat.reshape(len(flat), -1), np.ascontiguousarray(displaced).reshape(-1, 3), out, pulls,
    )  # fmt: skip
    shape = (*many, len(hulls), count)
    return out.reshape(shape), pulls.reshape(*shape, widest, 3)


def _distances() -> CompiledModule:
    return module_of(source_of(kernel), "distances to obstacles")
