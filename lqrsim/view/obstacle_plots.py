"""Obstacles in figures: in the plane as the planner sees them, in space as surfaces."""

import numpy as np
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d import Axes3D
from scipy.spatial import ConvexHull

from lqrsim.codegen import distances
from lqrsim.errors import Array
from lqrsim.scenes.world import Obstacle, World
from lqrsim.view.style import MARGIN, SOLID

EDGE = "#5b6470"


def bounds(places: Array, world: World, margin: float = 0.0) -> tuple[Array, Array]:
    """The lowest and highest corner of what to show: places (k, 2 or 3) and the obstacles, with a margin in metres."""
    size = places.shape[1]
    places = np.vstack([places, *(obstacle.position[None, :size] for obstacle in world.obstacles)])
    return np.nanmin(places, axis=0) - margin, np.nanmax(places, axis=0) + margin


def draw_in_plane(axes: Axes, flat: World, low: Array, high: Array, radius: float, *, plane: str = "xy") -> None:
    """Obstacles between two corners (2,), and, paler, where they are closer than the robot's radius in metres.

    Args:
      flat: the world as a robot in that plane sees it.
    """
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel=f"{plane[0]} (m)", ylabel=f"{plane[1]} (m)")
    if not flat.obstacles:
        return
    # What the planner sees, whatever the obstacles are made of: the distance itself, and where it is the radius.
    # Grid lines through the obstacles' positions keep the corners of walls sharp.
    spacing, places = float((high - low).max()) / 130, [obstacle.position for obstacle in flat.obstacles]
    x, y = (
        np.unique(np.append(np.arange(low[axis], high[axis] + spacing, spacing), np.array(places)[:, axis]))
        for axis in (0, 1)
    )
    distance = distances.signed_distance(flat, np.stack(np.meshgrid(x, y), axis=-1))
    levels = [-np.inf, 0, radius] if radius > 0 else [-np.inf, 0]
    axes.contourf(x, y, distance, levels=levels, colors=[SOLID, MARGIN][: len(levels) - 1])
    axes.contour(x, y, distance, levels=[0], colors=[EDGE], linewidths=0.8)


def draw_in_space(axes: Axes3D, world: World, low: Array, high: Array) -> None:
    """The surfaces of obstacles between two corners (3,), seen through."""
    for obstacle in world.obstacles:
        if obstacle.kind != "plane":  # they are the sides of the box that is drawn
            x, y, z = surface(obstacle, low, high)
            axes.plot_surface(x, y, z, color=SOLID, alpha=0.10, linewidth=0, rstride=1, cstride=1, shade=True)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.zaxis.set_rotate_label(False)  # it would stand on its head
    axes.set_zlabel("z (m)", rotation=90)
    axes.set_box_aspect(tuple(high - low), zoom=1.0)  # pyright: ignore[reportArgumentType] a float, as its documentation says
    axes.view_init(elev=27, azim=-110)


def draw_projected(axes: Axes, world: World, low: Array, high: Array, across: int, up: int) -> None:
    """The shadows of obstacles between two corners (3,) on the plane of two of the axes x, y, z, seen through."""
    for obstacle in world.obstacles:
        if obstacle.kind != "plane":
            points = surface(obstacle, low, high).reshape(3, -1)[[across, up]].T
            outline = points[ConvexHull(points).vertices]  # obstacles have no hollows
            axes.fill(*outline.T, facecolor=(SOLID, 0.35), edgecolor=EDGE, linewidth=0.6)
    names = "xyz"
    axes.set(xlabel=f"{names[across]} (m)", ylabel=f"{names[up]} (m)", aspect="equal")
    axes.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]))


def surface(obstacle: Obstacle, low: Array, high: Array) -> Array:
    """Points (3, i, j) on an obstacle's surface; infinite ones end at the sides of the box from `low` to `high`."""
    around, (radius, half, _) = np.linspace(0, 2 * np.pi, 25)[:, None], obstacle.size
    if obstacle.kind == "sphere":
        up = np.linspace(0, np.pi, 13)
        local = np.broadcast_arrays(np.cos(around) * np.sin(up), np.sin(around) * np.sin(up), np.cos(up))
        local = radius * np.stack(local)
    elif obstacle.kind not in ("capsule", "cylinder"):  # a box, or the one that it is in
        ring = obstacle.size[:2, None] * np.array([[-1, -1, 1, 1, -1], [-1, 1, 1, -1, -1]])
        ends = obstacle.size[2] * np.array([-1, 1])
        local = np.stack(np.broadcast_arrays(ring[0][:, None], ring[1][:, None], ends))
    else:
        axis = obstacle.rotation[:, 2]
        along = np.abs(axis) > 1e-9
        spans = np.sort([(side - obstacle.position)[along] / axis[along] for side in (low, high)], axis=0)
        ends = np.clip([spans[0].max(), spans[1].min()], -half, half)
        local = np.stack(np.broadcast_arrays(radius * np.cos(around), radius * np.sin(around), ends))
    return np.tensordot(obstacle.rotation, local, axes=1) + obstacle.position[:, None, None]
