"""Distances to obstacles, compiled."""

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.compiled_module import CompiledModule, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels import signed_distance as kernel
from lqrsim.scenes.world import World


def signed_distance(world_seen: World, points: npt.ArrayLike) -> Array:
    """As `world_seen.distance(points)`, compiled: (...) from points (..., 2 or 3)."""
    points = np.asarray(points, dtype=np.float64)
    flat = np.zeros((points[..., 0].size, 3))
    flat[:, : points.shape[-1]] = points.reshape(-1, points.shape[-1])
    out = np.empty(len(flat))
    table = np.array(world_seen.table)
    _distances().nearest(len(table), len(flat), table.ravel(), flat, out)
    return out.reshape(points.shape[:-1])


def signed_distance_displaced(world_seen: World, points: Array, displaced: Array) -> Array:
    """The same with obstacles that are elsewhere: (K, k) from points (K, k, 2 or 3), displaced (K, obstacles, 3)."""
    trials, count, size = points.shape
    flat = np.zeros((trials * count, 3))
    flat[:, :size] = points.reshape(-1, size)
    out, table = np.empty(len(flat)), np.array(world_seen.table)
    away = np.ascontiguousarray(displaced, dtype=np.float64).reshape(trials, -1)
    _distances().nearest_displaced(len(table), len(flat), count, table.ravel(), flat, away, out)
    return out.reshape(trials, count)


def signed_distance_at(world_seen: World, points: Array, times: Array) -> Array:
    """The same where obstacles are at some times (K,) in s, (K, k) from points (K, k, 2 or 3)."""
    if not world_seen.moving:
        return signed_distance(world_seen, points)
    return signed_distance_displaced(world_seen, points, world_seen.displacements(times))


def distances_with_normals(world_seen: World, points: npt.ArrayLike) -> tuple[Array, Array]:
    """The signed distance of points (K, 2 or 3) to each obstacle, (K, O), and the directions in which it grows.

    The directions are along the world's axes as seen, (K, O, 2 or 3).
    """
    points = np.asarray(points, dtype=np.float64)
    flat, count = np.zeros((len(points), 3)), len(world_seen)
    flat[:, : points.shape[1]] = points
    out, normals = np.empty(len(flat) * count), np.empty((len(flat) * count, 3))
    _distances().each_with_normal(count, len(flat), np.array(world_seen.table).ravel(), flat, out, normals)
    return out.reshape(-1, count), normals.reshape(len(flat), count, 3)[..., : points.shape[1]]


def _distances() -> CompiledModule:
    return module_of(source_of(kernel), "distances to obstacles")
