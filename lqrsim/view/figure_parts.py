"""Common parts of figures: obstacles, a plan, predicted tubes, and chances of collision."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial import ConvexHull

from lqrsim.codegen import distances
from lqrsim.errors import Array
from lqrsim.results.coordinates import Coordinates
from lqrsim.scenes.world import Obstacle, World
from lqrsim.view.ellipsoids import Ellipsoids
from lqrsim.view.style import MARGIN, PLAN, SOLID

EDGE = "#5b6470"
OUTLINES = 24  # number of ellipses whose outlines are drawn
BEADS = 0.2  # mean half axis, relative to the distance between neighbours, below which outlines look like beads
EMPTY = 0.08  # margin around what is drawn of a robot without a radius, relative to its extent
LEAST = 1e-6  # smallest chance that is drawn


def draw_obstacles(
    axes: Axes, space: Coordinates, world: World, places: Array, radius: float, plane: tuple[int, int]
) -> None:
    """Draw the obstacles around places (k, 2 or 3) of a robot of that radius.

    A planar robot has its own plane. A robot in space is seen along the third axis; `plane` has the two others.
    """
    margin = 1.5 * radius if radius > 0 else EMPTY * float(np.ptp(places, axis=0).max())
    if len(space.position) == 2:
        flat = world.seen_by(space.plane, space.offset)
        draw_in_plane(axes, flat, *bounds(places, flat, margin), radius, plane=space.plane)
    else:
        draw_projected(axes, world, *bounds(places, world, margin), *plane)


def draw_plan(axes: Axes, path: Array, *, linewidth: float = 0.9) -> None:
    """Draw a planned path (T+1, 2) with its start and its end."""
    axes.plot(*path.T, "--", color=PLAN, linewidth=linewidth, zorder=3, label="planned")
    mark_ends(axes, path)


def mark_ends(axes: Axes, path: Array) -> None:
    """Mark the start and the end of a planned path (T+1, 2 or 3)."""
    axes.plot(*path[:1].T, "o", color=PLAN, markersize=6, zorder=3, label="start")
    axes.plot(*path[-1:].T, "*", color=PLAN, markersize=10, zorder=3, label="end of the plan")


def bounds(places: Array, world: World, margin: float = 0.0) -> tuple[Array, Array]:
    """The lowest and highest corner of places (k, 2 or 3) and obstacles, with a margin in metres."""
    size = places.shape[1]
    places = np.vstack([places, *(obstacle.position[None, :size] for obstacle in world.obstacles)])
    return np.nanmin(places, axis=0) - margin, np.nanmax(places, axis=0) + margin


def draw_in_plane(axes: Axes, flat: World, low: Array, high: Array, radius: float, *, plane: str = "xy") -> None:
    """Draw obstacles between two corners (2,), and in a paler colour the places closer to them than the robot's radius.

    Args:
      flat: the world in the plane of the robot.
    """
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel=f"{plane[0]} (m)", ylabel=f"{plane[1]} (m)")
    if not flat.obstacles:
        return
    # Contours of the planner's own distance, for any obstacles. Grid lines through the obstacles' positions keep the
    # corners of walls sharp.
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
    """Draw translucent surfaces of obstacles between two corners (3,)."""
    for obstacle in world.obstacles:
        if obstacle.kind != "plane":  # planes are the sides of the box
            x, y, z = surface(obstacle, low, high)
            axes.plot_surface(x, y, z, color=SOLID, alpha=0.10, linewidth=0, rstride=1, cstride=1, shade=True)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.zaxis.set_rotate_label(False)  # otherwise it would be upside down
    axes.set_zlabel("z (m)", rotation=90)
    axes.set_box_aspect(tuple(high - low), zoom=1.0)  # pyright: ignore[reportArgumentType] a float, as its documentation says
    axes.view_init(elev=27, azim=-110)


def draw_projected(axes: Axes, world: World, low: Array, high: Array, across: int, up: int) -> None:
    """Draw translucent projections of obstacles between two corners (3,) onto the plane of two axes."""
    for obstacle in world.obstacles:
        if obstacle.kind != "plane":
            points = surface(obstacle, low, high).reshape(3, -1)[[across, up]].T
            outline = points[ConvexHull(points).vertices]  # all obstacles are convex
            axes.fill(*outline.T, facecolor=(SOLID, 0.35), edgecolor=EDGE, linewidth=0.6)
    names = "xyz"
    axes.set(xlabel=f"{names[across]} (m)", ylabel=f"{names[up]} (m)", aspect="equal")
    axes.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]))


def surface(obstacle: Obstacle, low: Array, high: Array) -> Array:
    """Points (3, i, j) on an obstacle's surface; an infinite obstacle ends at the box from `low` to `high`."""
    around, (radius, half, _) = np.linspace(0, 2 * np.pi, 25)[:, None], obstacle.size
    if obstacle.kind == "sphere":
        up = np.linspace(0, np.pi, 13)
        local = np.broadcast_arrays(np.cos(around) * np.sin(up), np.sin(around) * np.sin(up), np.cos(up))
        local = radius * np.stack(local)
    elif obstacle.kind not in ("capsule", "cylinder"):  # a box, or the bounding box
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


def draw_tube(axes: Axes, ellipses: Ellipsoids, label: str, *, face: str, edge: str) -> None:
    """Draw ellipses as one area, with some of their outlines, unless these would look like beads on a string."""
    every = ellipses.outlines()
    axes.add_collection(PolyCollection(list(every), facecolors=face, edgecolors="none", zorder=1.5, label=label))
    chosen = np.unique(np.linspace(0, len(every) - 1, OUTLINES).astype(int)) if len(every) else np.arange(0)
    apart = np.linalg.norm(np.diff(ellipses.centres[chosen], axis=0), axis=1)
    if len(chosen) < 2 or ellipses.axes()[0][chosen].mean() > BEADS * apart.mean():
        some = PolyCollection(list(every[chosen]), facecolors="none", edgecolors=edge, linewidths=0.6, zorder=2.5)
        axes.add_collection(some)


def draw_tube_in_space(axes: Axes3D, ellipsoids: Ellipsoids, label: str, *, face: str, edge: str) -> None:
    """Draw ellipsoids as their projections along the line of sight, each at its own place."""
    up, around = np.radians(axes.elev), np.radians(axes.azim)
    right = np.array([-np.sin(around), np.cos(around), 0.0])
    forward = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    onto = np.stack([right, np.cross(forward, right)])
    chosen = ellipsoids.spread(len(ellipsoids.centres))
    flat = ellipsoids.seen_in(onto)
    around_centres = flat.outlines()[chosen] - flat.centres[chosen, None, :]
    discs = ellipsoids.centres[chosen, None, :] + around_centres @ onto
    axes.add_collection3d(Poly3DCollection(list(discs), facecolors=to_rgba(edge, 0.15), edgecolors="none"))
    axes.plot([], [], [], color=face, linewidth=7, label=label)  # only for the legend


def draw_chances(axes: Axes, curves: Sequence[tuple[Array, Array, str]]) -> None:
    """Draw chances of being in collision at each knot: curves with times (T+1,), chances (T+1,) and a colour."""
    most = LEAST
    for times, chances, colour in curves:
        axes.plot(times, np.where(chances > 0, chances, np.nan), color=colour)
        most = max(most, float(chances.max()))
    axes.set_yscale("log")
    axes.set_ylim(LEAST, 1.0 if most > 0.1 else 10 * most)
    axes.set(xlabel="time (s)", ylabel="chance", title="predicted chance of being in collision")
    axes.margins(x=0.01)
    axes.set_xlim(min(times[0] for times, *_ in curves), max(times[-1] for times, *_ in curves))
    if most <= LEAST:
        axes.text(0.5, 0.5, f"below {LEAST:g} throughout", transform=axes.transAxes, ha="center", va="center")
