"""Common parts of figures: obstacles, a plan, predicted tubes, and chances of collision."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.patches import Circle
from scipy.spatial import ConvexHull

from lqrsim.errors import Array
from lqrsim.problem.belief import Belief
from lqrsim.problem.collision_shape import signed_distance
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.rollout import Rollout
from lqrsim.scenes.mjcf_kinematics import driven_trees, posed
from lqrsim.scenes.world import Obstacle, World
from lqrsim.view.ellipsoids import Ellipsoids
from lqrsim.view.recorded_trial import drawn_geoms, model_of, robot_body
from lqrsim.view.style import AROUND, LAYOUTS, MARGIN, PLAN, RUNS, SOLID, Panel, Style

EDGE = "#5b6470"
OUTLINES = 24  # number of ellipses whose outlines are drawn
BEADS = 0.2  # mean half axis, relative to the distance between neighbours, below which outlines look like beads
LEAST_MARGIN = 0.05  # around what is drawn, relative to its extent
LEAST = 1e-6  # smallest chance that is drawn
SLENDER = 4.0  # the longer side of a view relative to the shorter one, at most: an alley of 60 m would be a line
STRETCHED = 1.3  # least factor by which the shorter side is stretched
LEAST_WAY = 0.2  # least extent along an axis for its margin, relative to the largest extent
MARGIN_AT_REST = 0.5  # m around a plan that stays at a place, if the robot has no radius
CELLS = 200  # across a view, of the grid on which obstacles' outlines are found
RINGS = np.array([-1.1, -1.0, -0.8, 0.0, 0.8, 1.0, 1.1])  # grid lines through a small obstacle, in its half sizes
CLOSE = "closer than the robot's radius"
MOVED_COLOUR = "#a6761d"  # colour of what a run moved
LEAST_MOTION = 0.01  # distance that an object has to move to be drawn, relative to the extent of the run
SHAPES = "sphere", "capsule", "cylinder", "box"  # other geoms are drawn as their bounding boxes
CERTIFIED = RUNS[0]
SENSED_CELLS = 80  # across a view, of the grid on which sensors are shown
READING_STEP = 1e-5  # m, of differences of readings
DEEPEST = "#f5d36b"  # of the places that are seen best
LONG_VIEW = 0.45  # height over width, below which a view is as wide as the figure


class DrawnPath(NamedTuple):
    """A path through points (k, 2 or 3), as a view shows it."""

    points: Array
    label: str
    colour: str = PLAN
    line: str = "--"
    width: float = 1.4
    zorder: float = 2.0


class TubeArea(NamedTuple):
    """A tube, and the colours of its area and of its outlines."""

    ellipsoids: Ellipsoids
    label: str
    face: str
    edge: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """What views of a robot show: obstacles about it, tubes, paths, balls, and objects that it moved."""

    title: str  # of each view; where there are two, with its direction
    space: Coordinates
    world: World
    radius: float
    places: Array  # (k, 2 or 3), which the views contain
    planes: Sequence[tuple[int, int]]  # of each view, the axes of the places that it shows
    paths: Sequence[DrawnPath]  # the plan is last, on top, with marks at its ends
    tubes: Sequence[TubeArea] = ()
    certified: Ellipsoids | None = None  # with a thick outline
    objects: Sequence["MovedObject"] = ()
    balls: Sequence[tuple[Array, float, str]] = ()  # centres (3,) and radii, with their colours
    limits: tuple[Array, Array] | None = None  # lowest and highest corner; by default around the places
    sensed: tuple[Belief, Array] | None = None  # and states (k, n): how well its sensors see the places is drawn

    @property
    def corners(self) -> tuple[Array, Array]:
        """The lowest and the highest corner (2 or 3,) of what is shown."""
        if self.limits is not None:
            return self.limits
        ways = np.nanmax(self.places, axis=0) - np.nanmin(self.places, axis=0)
        margin = np.maximum(1.5 * self.radius, LEAST_MARGIN * np.maximum(ways, LEAST_WAY * ways.max()))
        margin = margin if self.radius or ways.any() else MARGIN_AT_REST
        return bounds(self.places, self.world.seen_by(self.space.plane, self.space.offset), margin)

    def panels(self, style: Style) -> list[Panel]:
        """The panels of the views: wide ones if they are long."""
        low, high = self.corners
        shapes = [slenderness((high - low)[list(plane)]) for plane in self.planes]
        wide, layout = max(shapes) < LONG_VIEW, LAYOUTS[style]
        width = layout.width / (1 if wide else layout.columns) - AROUND[1] * layout.text / 72
        return [Panel(width * min(shape, 1.0), wide) for shape in shapes]

    def draw(self, figure: Figure, places: Sequence[SubplotSpec]) -> list[Axes]:
        """Draw a view at each of these places of a figure."""
        low, high = self.corners
        views = [figure.add_subplot(place) for place in places]
        in_space = len(low) == 3
        for axes, plane in zip(views, self.planes, strict=True):
            along, onto = list(plane), np.eye(len(low))[list(plane)]
            if in_space:
                draw_projected(axes, self.world, low, high, along)
            else:
                flat = self.world.seen_by(self.space.plane, self.space.offset)
                draw_in_plane(axes, flat, low, high, self.radius, plane=self.space.plane)
            direction = f", from {'above' if plane == (0, 1) else 'the side'}"
            axes.set_title(self.title + direction * (in_space and not self.balls))
            if self.sensed is not None:
                draw_sensed(axes, *self.sensed, low, high, along)
            for centre, radius, colour in self.balls:
                across, up = centre[along]
                axes.add_patch(Circle((across, up), radius, facecolor=colour, edgecolor="none", zorder=2))
            for ellipsoids, label, face, edge in self.tubes:
                draw_tube(axes, ellipsoids.projected(onto), label, face=face, edge=edge)
            if self.certified is not None:
                outlines = list(self.certified.projected(onto).outlines())
                properties = {"facecolors": "none", "edgecolors": CERTIFIED, "linewidths": 1.6, "zorder": 2.8}
                axes.add_collection(PolyCollection(outlines, label="certified", **properties))
            for path in self.paths:
                properties = {"color": path.colour, "linewidth": path.width, "zorder": path.zorder}
                axes.plot(*path.points[:, along].T, path.line, label=path.label, **properties)
            start, end = self.paths[-1].points[[0, -1]][:, along]
            axes.plot(*start, "o", color=PLAN, markersize=6, zorder=3, label="start")
            axes.plot(*end, "*", color=PLAN, markersize=10, zorder=3, label="end of the plan")
            letters = "xyz" if in_space else self.space.plane
            draw_objects(axes, self.objects, ["xyz".index(letters[i]) for i in along])
        return views


def planes_of(places: Array) -> list[tuple[int, int]]:
    """The planes in which places (k, 2 or 3) are seen: from above and, in space, from their longer side."""
    if places.shape[1] == 2:
        return [(0, 1)]
    x, y, _ = np.ptp(places, axis=0)
    return [(0, 1), (0, 2) if x >= y else (1, 2)]


def bounds(places: Array, world: World, margin: float | Array = 0.0) -> tuple[Array, Array]:
    """The lowest and highest corner of places (k, 2 or 3) and obstacles, with margins in metres."""
    size = places.shape[1]
    places = np.vstack([places, *(obstacle.position[None, :size] for obstacle in world.obstacles)])
    return np.nanmin(places, axis=0) - margin, np.nanmax(places, axis=0) + margin


def draw_in_plane(axes: Axes, flat: World, low: Array, high: Array, radius: float, *, plane: str = "xy") -> None:
    """Draw obstacles between two corners (2,), and in a paler colour the places closer than the robot's radius."""
    _begin_view(axes, low, high, plane)
    if not flat.obstacles:
        return
    # Contours of the planner's own distance, for any obstacles. Grid lines through obstacles keep the corners of walls
    # sharp, and those that are smaller than a cell.
    grid = []
    for axis in (0, 1):
        lines = [np.linspace(low[axis], high[axis], CELLS)]
        for obstacle in flat.obstacles:
            half = np.abs(obstacle.rotation[axis]) @ np.nan_to_num(_half_sizes(obstacle), posinf=0.0)
            lines.append(obstacle.position[axis] + half * RINGS)
        grid.append(np.unique(np.concatenate(lines)))
    x, y = grid
    distance = signed_distance(flat, np.stack(np.meshgrid(x, y), axis=-1))
    levels = [-np.inf, 0, radius] if radius > 0 else [-np.inf, 0]
    axes.contourf(x, y, distance, levels=levels, colors=[SOLID, MARGIN][: len(levels) - 1])
    axes.contour(x, y, distance, levels=[0], colors=[EDGE], linewidths=0.8)
    axes.fill([], [], facecolor=SOLID, edgecolor=EDGE, label="obstacle")  # for the legend
    if radius > 0:
        axes.fill([], [], facecolor=MARGIN, label=CLOSE)


def _half_sizes(obstacle: Obstacle) -> Array:
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
    of_axes = zip(names, (1 / stretch, stretch), strict=True)
    labels = [f"{name} (m)" + (f"\nstretched {by:.2g}x" if by > 1.0 + 1e-9 else "") for name, by in of_axes]
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect=stretch, xlabel=labels[0], ylabel=labels[1])


def draw_projected(axes: Axes, world: World, low: Array, high: Array, plane: list[int]) -> None:
    """Draw translucent projections of obstacles between two corners (3,) onto the plane of two axes."""
    solid = [obstacle for obstacle in world.obstacles if obstacle.kind != "plane"]
    over_tubes = {"facecolor": (SOLID, 0.35), "edgecolor": EDGE, "linewidth": 0.6, "zorder": 1.6}  # which show through
    for number, obstacle in enumerate(solid):
        axes.fill(*_outline(obstacle, low, high, plane).T, label=None if number else "obstacle", **over_tubes)
    _begin_view(axes, low[plane], high[plane], "".join("xyz"[axis] for axis in plane))


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
    elif len(obstacle.corners):
        ends = np.array([[low[2], high[2]]]) - obstacle.position[2] if np.isinf(obstacle.size[2]) else np.zeros((1, 2))
        local = obstacle.corners.T[:, :, None] + np.array([0, 0, 1])[:, None, None] * ends
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


class MovedObject(NamedTuple):
    """A body that is not driven: its centre of mass (F, 3) in each frame, and its geoms in the first and the last."""

    name: str
    path: Array
    first: list[Obstacle]
    last: list[Obstacle]

    @property
    def places(self) -> Array:
        """Its path, and corners (k, 3) around its geoms."""
        geoms = *self.first, *self.last
        around = [geom.position + side * geom.size.max() for geom in geoms for side in (-1, 1)]
        return np.vstack([self.path, *around])


def moved_objects(rollout: Rollout, trial: int) -> list[MovedObject]:
    """The objects that moved in this trial: kinematic trees that are not the robot's, and that no actuator moves."""
    frames = rollout.frames[trial]
    frames = frames[np.isfinite(frames).all(axis=1)]
    if len(frames) < 2:
        return []
    model = model_of(rollout, trial)
    driven = driven_trees(model, robot_body(model, rollout.body))
    objects = [(tree, int(model.tree_bodyadr[tree])) for tree in range(model.ntree) if tree not in driven]
    path, geoms = np.zeros((len(frames), model.nbody, 3)), list[list[list[Obstacle]]]()
    for number, data in enumerate(posed(model, frames)):
        path[number] = data.xipos
        if number in (0, len(frames) - 1):
            geoms.append([_visible(model, data, tree) for tree, _ in objects])
    least = LEAST_MOTION * float(np.ptp(np.vstack([rollout.planned_places, rollout.places(trial)]), axis=0).max())
    return [
        MovedObject(model.body(body).name or f"body {body}", path[:, body], first, last)
        for (_, body), first, last in zip(objects, *geoms, strict=True)
        if np.linalg.norm(path[:, body] - path[0, body], axis=1).max() > least
    ]


def _visible(model: mujoco.MjModel, data: mujoco.MjData, tree: int) -> list[Obstacle]:
    """The visible geoms of a kinematic tree, in the pose of the data."""
    visible = list[Obstacle]()
    for geom in drawn_geoms(model):
        i, kind, size = geom.number, geom.kind, geom.size
        if model.body_treeid[model.geom_bodyid[i]] == tree:
            axes, place = data.geom_xmat[i].reshape(3, 3).copy(), data.geom_xpos[i].copy()
            if kind not in SHAPES:
                kind, size, place = "box", model.geom_aabb[i, 3:].copy(), place + axes @ model.geom_aabb[i, :3]
            visible.append(Obstacle(f"geom {i}", kind, place, axes, size))
    return visible


def draw_objects(axes: Axes, objects: Sequence[MovedObject], plane: list[int]) -> None:
    """Draw objects at the beginning and at the end of a run, and their paths, in a plane of the world's axes."""
    for moved in objects:
        low, high = moved.path.min(axis=0), moved.path.max(axis=0)
        for geoms, line, face in ((moved.first, ":", "none"), (moved.last, "-", (MOVED_COLOUR, 0.3))):
            properties = {"facecolor": face, "edgecolor": MOVED_COLOUR, "linestyle": line, "zorder": 2.4}
            for geom in geoms:
                axes.fill(*_outline(geom, low, high, plane).T, **properties)
        label = f"{moved.name.replace('_', ' ')}, moved"
        axes.plot(*moved.path[:, plane].T, color=MOVED_COLOUR, linewidth=1.0, zorder=2.5, label=label)


def draw_sensed(axes: Axes, belief: Belief, states: Array, low: Array, high: Array, along: list[int]) -> None:
    """Draw how well the readings of one period tell the position, as standard deviations in m, between two corners.

    A place in the view, whose axes are `along`, has the height, heading and speed of the nearest of the states (k, n).
    """
    shown = [belief.robot.state_coordinates.position[axis] for axis in along]
    x, y = (np.linspace(low[axis], high[axis], SENSED_CELLS) for axis in along)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    nearest = states[np.linalg.norm(points[:, None] - states[:, shown], axis=2).argmin(axis=1)]
    nearest[:, shown] = points
    deviations = accuracy(belief, nearest).reshape(SENSED_CELLS, SENSED_CELLS)
    least = deviations.min()
    levels = np.geomspace(least, max(np.quantile(deviations, 0.9), 1.01 * least), 7)
    shades = LinearSegmentedColormap.from_list("seen", [DEEPEST, "#ffffff"])
    axes.contourf(x, y, np.log(deviations), levels=np.log(levels), cmap=shades, zorder=0.5)
    lines = axes.contour(x, y, deviations, levels=levels[1:], colors="#b08f2a", linewidths=0.4, zorder=0.6)
    axes.clabel(lines, fmt=lambda value: f"{value:.2g} m", fontsize=5)
    axes.fill([], [], facecolor=DEEPEST, label="standard deviation of the position by readings alone")


def accuracy(belief: Belief, states: Array) -> Array:
    """Standard deviations (k,) in m with which readings in states (k, n) tell the position, over all directions."""
    place = belief.robot.state_coordinates.position
    deviations, information = belief.read(states)[1], np.zeros(len(states))
    for axis in place:
        step = READING_STEP * np.eye(states.shape[1])[axis]
        slopes = (belief.read(states + step)[0] - belief.read(states - step)[0]) / (2 * READING_STEP)
        information += np.square(slopes / deviations).sum(axis=1)
    return np.sqrt(len(place) / np.maximum(information, 1e-24))


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
