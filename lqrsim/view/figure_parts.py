"""Common parts of figures: obstacles, a plan, predicted tubes, and chances of collision."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from mpl_toolkits.mplot3d import Axes3D
from scipy.spatial import ConvexHull

from lqrsim.codegen import distances
from lqrsim.errors import Array
from lqrsim.results.coordinates import Coordinates
from lqrsim.scenes.world import Obstacle, World
from lqrsim.view.ellipsoids import Ellipsoids
from lqrsim.view.moved_objects import MovedObject
from lqrsim.view.style import MARGIN, PLAN, SOLID

EDGE = "#5b6470"
OUTLINES = 24  # number of ellipses whose outlines are drawn
BEADS = 0.2  # mean half axis, relative to the distance between neighbours, below which outlines look like beads
EMPTY = 0.05  # margin around what is drawn at least, relative to its extent
LEAST = 1e-6  # smallest chance that is drawn
SLENDER = 4.0  # the longer side of a view relative to the shorter one, at most: an alley of 60 m would be a line
STRETCHED = 1.3  # by which the shorter side is stretched at least, if it is
FLAT = 0.2  # way along an axis that counts for the margin at least, relative to the longest
NOTHING = 0.5  # m around a plan that stays at a place, if the robot has no radius
CELLS = 200  # across a view, of the grid on which obstacles' outlines are found
RINGS = np.array([-1.1, -1.0, -0.8, 0.0, 0.8, 1.0, 1.1])  # grid lines through a small obstacle, in its half sizes
NEAR = "closer than the robot's radius"
THING = "#a6761d"  # colour of what a run moved


def draw_obstacles(
    axes: Axes, space: Coordinates, world: World, places: Array, radius: float, plane: tuple[int, int]
) -> None:
    """Draw the obstacles around places (k, 2 or 3) of a robot of that radius.

    A planar robot has its own plane. A robot in space is seen along the third axis; `plane` has the two others.
    """
    low, span = extent(space, world, places, radius)
    if len(space.position) == 2:
        draw_in_plane(axes, world.seen_by(space.plane, space.offset), low, low + span, radius, plane=space.plane)
    else:
        draw_projected(axes, world, low, low + span, *plane)


def extent(space: Coordinates, world: World, places: Array, radius: float) -> tuple[Array, Array]:
    """The lowest corner (2 or 3,) of what is drawn around places of a robot of that radius, and its sizes."""
    ways = np.nanmax(places, axis=0) - np.nanmin(places, axis=0)
    margin = np.maximum(1.5 * radius, EMPTY * np.maximum(ways, FLAT * ways.max())) if radius or ways.any() else NOTHING
    low, high = bounds(places, world.seen_by(space.plane, space.offset), margin)
    return low, high - low


def draw_plan(axes: Axes, path: Array, *, linewidth: float = 0.9) -> None:
    """Draw a planned path (T+1, 2) with its start and its end."""
    axes.plot(*path.T, "--", color=PLAN, linewidth=linewidth, zorder=3, label="planned")
    mark_ends(axes, path)


def mark_ends(axes: Axes, path: Array) -> None:
    """Mark the start and the end of a planned path (T+1, 2 or 3)."""
    axes.plot(*path[:1].T, "o", color=PLAN, markersize=6, zorder=3, label="start")
    axes.plot(*path[-1:].T, "*", color=PLAN, markersize=10, zorder=3, label="end of the plan")


def bounds(places: Array, world: World, margin: float | Array = 0.0) -> tuple[Array, Array]:
    """The lowest and highest corner of places (k, 2 or 3) and obstacles, with margins in metres."""
    size = places.shape[1]
    places = np.vstack([places, *(obstacle.position[None, :size] for obstacle in world.obstacles)])
    return np.nanmin(places, axis=0) - margin, np.nanmax(places, axis=0) + margin


def draw_in_plane(axes: Axes, flat: World, low: Array, high: Array, radius: float, *, plane: str = "xy") -> None:
    """Draw obstacles between two corners (2,), and in a paler colour the places closer to them than the robot's radius.

    Args:
      flat: the world in the plane of the robot.
    """
    _begin_view(axes, low, high, plane)
    if not flat.obstacles:
        return
    # Contours of the planner's own distance, for any obstacles. Grid lines through obstacles keep the corners of walls
    # sharp, and those that are smaller than a cell.
    x, y = (
        np.unique(np.append(np.linspace(low[i], high[i], CELLS), [_across(one, i) for one in flat.obstacles]))
        for i in (0, 1)
    )
    distance = distances.signed_distance(flat, np.stack(np.meshgrid(x, y), axis=-1))
    levels = [-np.inf, 0, radius] if radius > 0 else [-np.inf, 0]
    axes.contourf(x, y, distance, levels=levels, colors=[SOLID, MARGIN][: len(levels) - 1])
    axes.contour(x, y, distance, levels=[0], colors=[EDGE], linewidths=0.8)
    axes.fill([], [], facecolor=SOLID, edgecolor=EDGE, label="obstacle")  # for the legend
    if radius > 0:
        axes.fill([], [], facecolor=MARGIN, label=NEAR)


def _across(obstacle: Obstacle, axis: int) -> Array:
    """Grid lines through an obstacle along an axis."""
    half = np.abs(obstacle.rotation[axis]) @ np.nan_to_num(_half_sizes(obstacle), posinf=0.0)
    return obstacle.position[axis] + half * RINGS


def _half_sizes(obstacle: Obstacle) -> Array:
    """Half sizes (3,) of an obstacle along its own axes."""
    radius, half, _ = obstacle.size
    kinds = {"sphere": (radius,) * 3, "cylinder": (radius, radius, half), "capsule": (radius, radius, half + radius)}
    return np.array(kinds.get(obstacle.kind, obstacle.size))


def slenderness(span: Array) -> float:
    """Height over width of a view of this extent (2,): that of the extent, unless it is too slender for a picture."""
    shape = span[1] / span[0]
    slender = max(shape, 1 / shape) > STRETCHED * SLENDER
    return float(np.clip(shape, 1 / SLENDER, SLENDER) if slender else shape)


def _begin_view(axes: Axes, low: Array, high: Array, names: str) -> None:
    """Set limits (2,), names and scales: equal ones, unless the view is too slender, which the stretched axis says."""
    span = high - low
    stretch = slenderness(span) / (span[1] / span[0])  # of y, relative to x
    said = [
        f"{name} (m)" + (f"\nstretched {by:.2g}x" if by > 1.0 + 1e-9 else "")
        for name, by in zip(names, (1 / stretch, stretch), strict=True)
    ]
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect=stretch, xlabel=said[0], ylabel=said[1])


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
    solid = [obstacle for obstacle in world.obstacles if obstacle.kind != "plane"]
    for number, obstacle in enumerate(solid):
        label = None if number else "obstacle"
        axes.fill(
            *_outline(obstacle, low, high, [across, up]).T,
            facecolor=(SOLID, 0.35),
            edgecolor=EDGE,
            linewidth=0.6,
            label=label,
            zorder=1.6,  # over tubes, which show through
        )
    _begin_view(axes, low[[across, up]], high[[across, up]], "xyz"[across] + "xyz"[up])


def _outline(obstacle: Obstacle, low: Array, high: Array, plane: list[int]) -> Array:
    """The outline (k, 2) of an obstacle between two corners (3,), seen along the axis that is not in `plane`."""
    points = surface(obstacle, low, high).reshape(3, -1)[plane].T
    return points[ConvexHull(points).vertices]  # all obstacles are convex


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


def draw_moved(axes: Axes, objects: Sequence[MovedObject], plane: list[int]) -> None:
    """Draw objects at the beginning and at the end of a run, and their paths, in a plane of the world's axes."""
    for one in objects:
        for geoms, line, face in ((one.first, ":", "none"), (one.last, "-", (THING, 0.3))):
            for geom in geoms:
                low, high = one.path.min(axis=0), one.path.max(axis=0)
                axes.fill(
                    *_outline(geom, low, high, plane).T, facecolor=face, edgecolor=THING, linestyle=line, zorder=2.4
                )
        axes.plot(
            *one.path[:, plane].T, color=THING, linewidth=1.0, zorder=2.5, label=f"{one.name.replace('_', ' ')}, moved"
        )


def draw_tube(axes: Axes, ellipses: Ellipsoids, label: str, *, face: str, edge: str) -> None:
    """Draw ellipses as one area, with some of their outlines, unless these would look like beads on a string."""
    every = ellipses.outlines()
    axes.add_collection(PolyCollection(list(every), facecolors=face, edgecolors="none", zorder=1.5, label=label))
    chosen = np.unique(np.linspace(0, len(every) - 1, OUTLINES).astype(int)) if len(every) else np.arange(0)
    apart = np.linalg.norm(np.diff(ellipses.centres[chosen], axis=0), axis=1)
    if len(chosen) < 2 or ellipses.axes()[0][chosen].mean() > BEADS * apart.mean():
        some = PolyCollection(list(every[chosen]), facecolors="none", edgecolors=edge, linewidths=0.6, zorder=2.5)
        axes.add_collection(some)


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
