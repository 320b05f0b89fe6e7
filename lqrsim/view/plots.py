"""The figures of runs, of a policy and of a funnel; and the views in them, of obstacles, a plan, tubes and objects."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, NamedTuple

import mujoco
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator
from scipy.spatial import ConvexHull

from lqrsim.annotations import Index, NonNegative, Want, checked
from lqrsim.control.tubes import Tube
from lqrsim.errors import Array, InputError, check_text
from lqrsim.problem.belief import Belief
from lqrsim.problem.collision_shape import signed_distance
from lqrsim.results.certified import Funnel
from lqrsim.results.coordinates import Coordinates, check_same_system, spaces_of
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenes.mjcf_kinematics import driven_trees, posed
from lqrsim.scenes.world import Obstacle, World
from lqrsim.view import style as styles
from lqrsim.view.overlays import OF_COST, SIGMAS, Ellipsoids
from lqrsim.view.recorded_trial import drawn_geoms, model_of, robot_body
from lqrsim.view.style import AROUND, LAYOUTS, LIMIT, MARGIN, PLAN, RUNS, SOLID, Panel, Style, arrange, legend_below

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
    for body in objects:
        low, high = body.path.min(axis=0), body.path.max(axis=0)
        for geoms, line, face in ((body.first, ":", "none"), (body.last, "-", (MOVED_COLOUR, 0.3))):
            properties = {"facecolor": face, "edgecolor": MOVED_COLOUR, "linestyle": line, "zorder": 2.4}
            for geom in geoms:
                axes.fill(*_outline(geom, low, high, plane).T, **properties)
        label = f"{body.name.replace('_', ' ')}, moved"
        axes.plot(*body.path[:, plane].T, color=MOVED_COLOUR, linewidth=1.0, zorder=2.5, label=label)


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


MOMENTS = 7  # number of times at which the balls of a robot are drawn
AREA = "area: "  # prefix of the label of a tube
CURVE, STRIP, NARROW = 1.2, 0.65, 1.65  # inches: the heights of curves and of strips, and the least width of a strip
LINES_OF_STRIP = 2.5  # lines of text above and below a strip
STRIPS = 3  # below one another; more are drawn in columns
ROUNDING = 1e-6  # of the largest error: smaller ones of an undisturbed run are rounding errors
LEAST_ERROR = 1e-3  # mm, or of the plan's range; an axis of smaller errors would show rounding errors


@checked
def plot_run(
    solution: Solution,
    rollouts: Annotated[Mapping[str, Rollout], Want("a dictionary of label: Rollout")],
    path: str | os.PathLike[str],
    *,
    world: World,
    trial: Index = 0,
    belief: Belief | None = None,
    style: Style = "screen",
) -> Path:
    """Writes a figure (png, pdf or svg, by the suffix) of a solution and of runs of its policy; returns its path.

    A robot in space is seen from above and from the side; of a robot without a position, the balls at several times.
    Objects that the first run moved are drawn where it began and where it ended. In a view that is more than four times
    as long as wide the short side is stretched. A predicted tube is drawn about the plan, 2 standard deviations wide,
    up to where it is too wide to be shown, with the chance of collision at each step.

    Args:
      rollouts: by their labels, for example `{"undisturbed": ..., "disturbed": ...}`; at most four.
      world: the obstacles, such as `scene.world`.
      belief: of a plan in belief space, whose `solution` is `BeliefFeedback.plan`: how well its sensors see the places.
      style: "screen"; or for a paper "column", 3.4 inches wide, or "page", 7.1 inches, with text of 7 points.
    """
    if not 1 <= len(rollouts) <= len(RUNS):
        raise InputError(f"rollouts: got {len(rollouts)}, want 1 to {len(RUNS)}")
    for name, run in rollouts.items():
        check_text("rollouts: a name", name, "a label", at_most=100)
        check_same_system(f"rollouts[{name!r}]", "a run", spaces_of(run), spaces_of(solution.policy), "the solution")
        if trial >= run.trials:
            raise InputError(f"trial: got {trial}, want one of 0 to {run.trials - 1} of rollouts[{name!r}]")
        if not run.plane:
            wanted = "the 2 or 3 states that are the position, or runs of a robot with balls that have frames"
            raise InputError(f"state_coordinates.position: got none, want {wanted}")
    with styles.figure(path, style=style) as figure:
        first = next(iter(rollouts.values()))
        views = (_of_positions if first.state_coordinates.position else _of_balls)(solution, rollouts, world, trial)
        if belief is not None:
            views = replace(views, sensed=(belief, solution.trajectory.states[:, : belief.size]))
        chances = [
            (run.times, run.collision_chance, color)
            for run, color in zip(rollouts.values(), RUNS, strict=False)
            if run.collision_chance is not None and run.collision_chance.any()
        ]
        count = len(first.control_coordinates)
        wide = count > STRIPS
        rows = -(-count // int(LAYOUTS[style].width / NARROW)) if wide else count
        across, strips = -(-count // rows), _strip_panel(rows, style, wide=wide)
        curves = [Panel(CURVE)] * (1 + bool(chances))
        of_time = [*curves, Panel(CURVE), strips] if strips.wide else [*curves, strips, Panel(CURVE)]
        parts = arrange(figure, [*views.panels(style), *of_time], style)
        drawn = views.draw(figure, parts[: len(views.planes)])
        *error_and_chances, commands, costs = parts[len(views.planes) :]
        if strips.wide:
            commands, costs = costs, commands
        _tracking_error(figure.add_subplot(error_and_chances[0]), rollouts, trial)
        if chances:
            draw_chances(figure.add_subplot(error_and_chances[1]), chances)
        controls = _controls(_grid(figure, commands, len(first.control_coordinates), across), solution, rollouts, trial)
        _convergence(figure.add_subplot(costs), solution)
        legend_below(figure, _entries(drawn[0]) | controls)
    return Path(path)


def _strip_panel(rows: int, style: Style, *, wide: bool = False) -> Panel:
    """The panel of strips below one another: the layout counts their titles and numbers with its height."""
    return Panel(rows * (STRIP + LINES_OF_STRIP * LAYOUTS[style].text / 72), wide)


def _grid(figure: Figure, place: SubplotSpec, count: int, across: int) -> list[Axes]:
    grid = place.subgridspec(-(-count // across), across)
    return [figure.add_subplot(grid[number]) for number in range(count)]


def _entries(*drawn: Axes) -> dict[str, Artist]:
    """What is drawn in these axes, by label."""
    return {label: artist for axes in drawn for artist, label in zip(*axes.get_legend_handles_labels(), strict=True)}


def _driven(rollouts: Mapping[str, Rollout], trial: int, zorder: float = 2.0) -> list[DrawnPath]:
    runs = zip(rollouts.items(), RUNS, strict=False)
    return [DrawnPath(run.places(trial), name, color, "-", zorder=zorder) for (name, run), color in runs]


def _of_positions(solution: Solution, rollouts: Mapping[str, Rollout], world: World, trial: int) -> Views:
    first, space = next(iter(rollouts.values())), solution.policy.state_coordinates
    driven = _driven(rollouts, trial)
    plan = DrawnPath(solution.trajectory.states[:, list(space.position)], "planned")
    objects = moved_objects(first, trial)
    of_world = ["xyz".index(letter) for letter in (space.plane if len(space.position) == 2 else "xyz")]
    shown = [thing.places[:, of_world] for thing in objects]
    places = np.vstack([*(path.points for path in (*driven, plan)), *shown])
    tubes = list[TubeArea]()
    for (name, run), color in zip(rollouts.items(), RUNS, strict=False):
        if run.tube is not None and run.tube.any():
            ellipsoids = Ellipsoids.predicted(run.plan.states[:, list(run.state_coordinates.position)], run.tube)
            tubes.append(TubeArea(ellipsoids, f"{AREA}{name}, {ellipsoids.label}", _paler(color, 0.6), color))
    return Views(
        title="path", space=space, world=world, radius=first.radius, places=places, planes=planes_of(places),
        paths=[*driven, plan], tubes=tubes, objects=objects,
    )  # fmt: skip


def _of_balls(solution: Solution, rollouts: Mapping[str, Rollout], world: World, trial: int) -> Views:
    """The view of the first run's balls at several times, along the axis of least motion; and paths of the last."""
    first = next(iter(rollouts.values()))
    assert first.balls is not None
    driven, radii = first.balls.driven[trial], first.balls.radii
    alive = driven[np.isfinite(driven).all(axis=(1, 2))]
    span = np.ptp(alive, axis=(0, 1))
    across, up = sorted(np.argsort(span, kind="stable")[1:].tolist())
    moments = np.unique(np.linspace(0, len(alive) - 1, MOMENTS).astype(int))
    colours = [_paler(RUNS[0], white) for white in np.linspace(0, 0.75, len(moments))[::-1].tolist()]
    balls = list[tuple[Array, float, str]]()
    for knot, colour in zip(moments, colours, strict=True):
        balls += [(centre, float(radius), colour) for centre, radius in zip(alive[knot], radii, strict=True)]
    margin = float(radii.max()) + 0.1 * float(span.max())
    return Views(
        title="balls, paler the earlier, and the path of the last", space=first.state_coordinates, world=world,
        radius=first.radius, places=np.zeros((0, 3)), planes=[(across, up)], balls=balls,
        limits=bounds(alive.reshape(-1, 3), world, margin), objects=moved_objects(first, trial),
        paths=[*_driven(rollouts, trial, zorder=3), DrawnPath(first.planned_places, "planned", zorder=3)],
    )  # fmt: skip


def _paler(colour: str, white: float) -> str:
    red, green, blue = (white + (1 - white) * part for part in to_rgb(colour))
    return to_hex((red, green, blue))


def _tracking_error(axes: Axes, rollouts: Mapping[str, Rollout], trial: int) -> None:
    errors = {name: run.tracking_error[trial] for name, run in rollouts.items()}
    worst = np.array([np.nanmax(error) for error in errors.values()])
    # Runs that differ by decades need a logarithmic axis, from which zeros and rounding errors are left out.
    decades = bool(worst.max() > 30 * worst.min())
    unit_of_error = next(iter(rollouts.values())).tracking_unit
    factor, unit = (1e3, "mm") if unit_of_error == "m" and worst.max() < 1 and not decades else (1.0, unit_of_error)
    for (name, error), color in zip(errors.items(), RUNS, strict=False):
        shown = np.where(error > ROUNDING * worst.max(), error, np.nan) if decades else error
        axes.plot(rollouts[name].times, factor * shown, color=color)
    if decades:
        axes.set_yscale("log")
    else:
        axes.set_ylim(0, max(1.05 * factor * worst.max(), LEAST_ERROR))
    unit = unit.replace("the plan's", "its")
    axes.set(xlabel="time (s)", ylabel=f"distance from\nthe plan ({unit})", title="tracking error")
    axes.margins(x=0.01)


def _controls(strips: list[Axes], solution: Solution, rollouts: Mapping[str, Rollout], trial: int) -> dict[str, Artist]:
    """The commanded controls over time; returns what the legend says of them."""
    space, plan = next(iter(rollouts.values())).control_coordinates, solution.trajectory
    legend: dict[str, Artist] = {}
    for number, axes in enumerate(strips):
        # Disturbed runs come first, so that the undisturbed one is not hidden.
        for (_, run), color in reversed(list(zip(rollouts.items(), RUNS, strict=False))):
            axes.stairs(run.commanded[trial, :, number], run.times, color=color, baseline=None, linewidth=1.0)
        axes.stairs(plan.controls[:, number], plan.times, color=PLAN, baseline=None, linestyle="--", linewidth=0.9)
        for limit in (space.low[number], space.high[number]):
            if np.isfinite(limit):
                line = axes.axhline(limit, color=LIMIT, linewidth=0.9, linestyle=":", gid="limit")
                legend["limit of a control"] = line
        axes.set_title(space.names[number].replace("_", " "))
        axes.set_ylabel("command" + f"\n({space.units[number]})" * bool(space.units[number]))
        axes.margins(x=0.01, y=0.12)
        if len(set(space.units)) == 1:
            axes.label_outer(remove_inner_ticks=False)
    _share_time(strips)
    return legend


def _share_time(strips: list[Axes]) -> None:
    """Numbers and label of the time only below the last strip of each column."""
    for axes in strips:
        place = axes.get_subplotspec()
        assert place is not None
        below = place.num1 + place.get_gridspec().ncols >= len(strips)
        axes.tick_params(labelbottom=below)
        axes.set_xlabel("time (s)" if below else "")


def _convergence(axes: Axes, solution: Solution) -> None:
    number = np.arange(1, len(solution.iterations) + 1)
    cost = np.array([iteration.cost for iteration in solution.iterations])
    change = np.abs([iteration.improvement for iteration in solution.iterations])
    axes.plot(number, cost, "o-", color=PLAN, markersize=4)
    if len(cost) and np.nanmin(cost) > 0 and np.nanmax(cost) > 20 * np.nanmin(cost):
        axes.set_yscale("log")
    axes.set(xlabel=f"iteration of {solution.solver}", ylabel="cost (circles)", title="convergence of the solver")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    shown = np.isfinite(change) & (change > 0)
    if shown.any():
        other = axes.twinx()
        other.semilogy(number[shown], change[shown], "s:", color=LIMIT, markersize=3.5, linewidth=1.0)
        other.set_ylabel("relative change\n(squares)")
        other.spines["right"].set_visible(True)


# Colours of faces and edges, as in videos.
TUBE = {"face": "#8ad7d5", "edge": "#008f91"}
COST_TUBE = {"face": "#d5c8ec", "edge": "#7a4dc7"}
LINES = ("-", "--", "-.", ":", (0, (6, 1.5, 1, 1.5, 1, 1.5)))
LEAST_RANGE = 0.05  # a curve whose range is a smaller part of the largest one's in its unit has another strip


@checked
def plot_policy(
    solution: Solution,
    path: str | os.PathLike[str],
    *,
    world: World | None = None,
    radius: NonNegative = 0.0,
    tube: Tube | None = None,
    belief: Belief | None = None,
    style: Style = "screen",
) -> Path:
    """Writes a figure (png, pdf or svg, by the suffix) of a solution's policy; returns its path.

    With a tube it shows what `plot_run` shows of one. Without a tube it shows the positions whose total cost is near
    its least, which does not depend on disturbances; solutions of `ilqr` have no total cost, and show the plan alone.
    Of a system without a position, not necessarily a robot, the plan's states are shown, without `world` and `radius`.

    Args:
      radius: radius in metres of a robot in the plane that is one ball about its position; places closer to an obstacle
        are grey. 0 leaves the grey out, which would be wrong for a robot of several balls.
      tube: of the solution, from `predict_tube`.
      belief: of a solution in belief space: how well its sensors see the places.
    """
    world = World() if world is None else world
    if solution.cost_to_go is None:
        raise InputError(f"solution: got no cost-to-go ({solution.status.name}), want a solution of a completed solve")
    # In belief space the tube has the states of the mean.
    planned = solution.trajectory.states
    if tube is not None and not np.array_equal(tube.plan.states, planned[:, : tube.plan.states.shape[1]]):
        raise InputError("tube: got a tube of another plan, want one of the solution's plan")
    if tube is not None and not solution.policy.state_coordinates.position:
        raise InputError("tube: got a tube of a robot without a position, want None")
    with styles.figure(path, style=style) as figure:
        draw_policy(figure, solution, world, radius, tube, style, belief)
    return Path(path)


def draw_policy(
    figure: Figure, solution: Solution, world: World, radius: float, tube: Tube | None = None, style: Style = "screen",
    belief: Belief | None = None,
) -> None:  # fmt: skip
    """Draw the figure of a policy."""
    policy = solution.policy
    space, chances = policy.state_coordinates, tube is not None and bool(tube.step_chance.any())
    gains = list(product(dict.fromkeys(policy.control_coordinates.units), dict.fromkeys(space.units)))
    curves = [Panel(CURVE)] * (1 + chances) + [_strip_panel(len(gains), style)]
    if space.position:
        plan, tubes = solution.trajectory.states[:, list(space.position)], list[TubeArea]()
        if tube is not None:
            ellipsoids = Ellipsoids.predicted(plan, tube.position_covariance)
            tubes.append(TubeArea(ellipsoids, ellipsoids.label, **TUBE))
        elif solution.cost_to_come is not None:
            tubes.append(TubeArea(Ellipsoids.of_cost(solution, space.position), OF_COST, **COST_TUBE))
        path = DrawnPath(plan, "planned", width=1.4 if tube is None else 0.9, zorder=3)
        title = "plan" if tube is None else "predicted tube"
        views = Views(
            title=title, space=space, world=world, radius=radius, places=plan, planes=planes_of(plan), paths=[path],
            tubes=tubes, sensed=None if belief is None else (belief, solution.trajectory.states[:, : belief.size]),
        )  # fmt: skip
        parts = arrange(figure, [*views.panels(style), *curves], style)
        of_time = parts[len(views.planes) :]
        drawn = views.draw(figure, parts[: len(views.planes)])
    else:
        groups = _grouped_states(solution)
        states, *of_time = arrange(figure, [_strip_panel(len(groups), style), *curves], style)
        drawn = []
        _states(_grid(figure, states, len(groups), 1), groups, solution)
    _cost_to_go(figure.add_subplot(of_time[0]), solution)
    if tube is not None and chances:
        axes = figure.add_subplot(of_time[1])
        draw_chances(axes, [(tube.plan.times, tube.step_chance, TUBE["edge"])])
        axes.set_title(f"predicted chance of collision ({tube.collision_chance:.2g} in all)")
    strips = _grid(figure, of_time[-1], len(gains), 1)
    _gains(strips, gains, policy, solution.trajectory.times)
    legend_below(figure, _entries(*drawn[:1], *strips))


def _grouped_states(solution: Solution) -> list[list[int]]:
    """The states of each strip: of one unit, and with ranges along the plan that can be seen beside one another."""
    space, strips = solution.policy.state_coordinates, list[list[int]]()
    sizes = np.ptp(solution.trajectory.states, axis=0)
    for unit in dict.fromkeys(space.units):
        strip = list[int]()
        for i in sorted((i for i, of in enumerate(space.units) if of == unit), key=lambda i: -sizes[i]):
            if strip and 0 < sizes[i] < LEAST_RANGE * sizes[strip[0]]:
                strips.append(sorted(strip))
                strip = []
            strip.append(i)
        strips.append(sorted(strip))
    return sorted(strips)


def _states(strips: list[Axes], groups: list[list[int]], solution: Solution) -> None:
    space, plan = solution.policy.state_coordinates, solution.trajectory
    for axes, drawn in zip(strips, groups, strict=True):
        for i in drawn:
            axes.plot(plan.times, plan.states[:, i], label=space.names[i].replace("_", " "))
        unit = space.units[drawn[0]]
        axes.set_ylabel(f"({unit})" if unit else "")
        axes.margins(x=0.01)
        axes.legend(loc="best")
    strips[0].set_title("planned states")
    _share_time(strips)


def _cost_to_go(axes: Axes, solution: Solution) -> None:
    """The cost-to-go at the planned states and, above it, the cost-to-come up to the total."""
    times, states = solution.trajectory.times, solution.trajectory.states
    assert solution.cost_to_go is not None
    to_go = solution.cost_to_go(states)
    axes.plot(times, to_go, color=RUNS[0], label="cost-to-go")
    axes.fill_between(times, 0, to_go, color=RUNS[0], alpha=0.15, linewidth=0)
    if solution.cost_to_come is not None:
        axes.plot(times, solution.total_cost.minimum(), "--", color=PLAN, label="least total cost")
    axes.set(xlabel="time (s)", ylabel="cost", title="cost-to-go along the plan")
    axes.set_ylim(bottom=min(0.0, float(to_go.min())), top=1.12 * float(to_go.max()))
    axes.margins(x=0.01)
    axes.legend(loc="lower left")


def _gains(strips: list[Axes], units: list[tuple[str, str]], policy: AffinePolicy, times: Array) -> None:
    """The gains of each control, for each unit of the states."""
    controls = policy.control_coordinates
    for axes, (answer, deviation) in zip(strips, units, strict=True):
        for number, (name, unit) in enumerate(zip(controls.names, controls.units, strict=True)):
            if unit == answer:
                norm = strength(policy, number, deviation)
                # Twenty pairs of a colour and a line; the first four differ in both.
                line, colour = LINES[(number + 2 * (number // len(RUNS))) % len(LINES)], RUNS[number % len(RUNS)]
                properties = {"baseline": None, "color": colour, "linestyle": line, "linewidth": 1.2}
                axes.stairs(norm, times, label=name.replace("_", " "), **properties)
        axes.set_ylabel(f"{answer or '1'}\nper {deviation or '1'}")
        axes.set_ylim(bottom=0)
        axes.margins(x=0.01)
    strips[0].set_title("feedback gains")
    _share_time(strips)


def strength(policy: AffinePolicy, control: int, unit: str) -> Array:
    """Norm (T,) of a control's gains on the states of a unit: its largest response to a unit deviation."""
    chosen = [i for i, of_state in enumerate(policy.state_coordinates.units) if of_state == unit]
    return np.linalg.norm(policy.gain[:, control, chosen], axis=-1)


FUNNEL = {"face": "#cfe3f5", "edge": "#5f97c9"}


@checked
def plot_funnel(
    funnel: Funnel, path: str | os.PathLike[str], *, world: World, radius: NonNegative, style: Style = "screen"
) -> Path:
    """Writes a figure (png, pdf or svg, by the suffix) of a funnel; returns its path.

    Outlines are dark at certified knots and pale between them, where the level is interpolated. The ellipsoids of all
    states are projected onto the position: whether a run may begin at a place also depends on the other states.

    Args:
      radius: as in `plot_policy`: 0 for a robot of several balls or geoms.
    """
    views = funnel_views(funnel, world, radius)
    with styles.figure(path, style=style) as figure:
        *parts, levels = arrange(figure, [*views.panels(style), Panel(1.4 * CURVE)], style)
        drawn = views.draw(figure, parts)
        _levels(figure.add_subplot(levels), funnel)
        legend_below(figure, _entries(drawn[0]))
    return Path(path)


def funnel_views(funnel: Funnel, world: World, radius: float) -> Views:
    """Views of a funnel's projection onto the position, with its certified outlines as a whole."""
    covariances, space = funnel.position_covariance, funnel.state_coordinates
    plan = funnel.plan.states[:, list(space.position)]
    certified, last = funnel.knots[funnel.levels > 0], int(funnel.knots[-1]) + 1
    reach = np.sqrt(np.diagonal(covariances[certified], axis1=1, axis2=2))
    places = np.vstack([plan, plan[certified] - reach, plan[certified] + reach])
    shapes = covariances / SIGMAS**2  # gives the outlines at the level
    return Views(
        title="funnel", space=space, world=world, radius=radius, places=places, planes=planes_of(places),
        tubes=[TubeArea(Ellipsoids(plan[:last], shapes[:last]), "funnel, interpolated", **FUNNEL)],
        certified=Ellipsoids(plan[certified], shapes[certified]),
        paths=[DrawnPath(plan, "planned", width=0.9, zorder=3)],
    )  # fmt: skip


def _levels(axes: Axes, funnel: Funnel) -> None:
    times = funnel.times
    axes.plot(times, funnel.levels, "-", color=FUNNEL["edge"], linewidth=1.0)
    axes.plot(times, funnel.levels, "o", color=CERTIFIED, markersize=6)
    for time, level, trials, successes in zip(times, funnel.levels, funnel.trials, funnel.successes, strict=True):
        counts = f"{successes}/{trials}" if trials else "none"
        axes.annotate(counts, (time, level), xytext=(0, 8), textcoords="offset points", ha="center", fontsize=8)
    axes.set_xlim(-0.06 * funnel.plan.horizon, 1.02 * funnel.plan.horizon)
    axes.set_ylim(0, 1.2 * max(float(funnel.levels.max()), 1e-9))
    title = f"levels: {funnel.rate:g} succeed, confidence {funnel.confidence:g}"
    axes.set(xlabel="time (s)", ylabel="level", title=title)
