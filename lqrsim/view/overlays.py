"""Overlays of a trial: lines, dots, tubes, bodies and an arrow in the scene over time; and its readings as text.

MuJoCo draws their shapes as geoms, in addition to the model's; `exports.py` has them on a page in a browser, and for
Rerun. Tubes are of ellipsoids along a plan, which figures have, too.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco import mjtGeom as Geom

from lqrsim.annotations import Want, checked
from lqrsim.errors import Array, InputError
from lqrsim.results.certified import Funnel
from lqrsim.results.goal import OF_RANGE
from lqrsim.results.solution import Solution
from lqrsim.view.options import DRAWN_BY, OVERLAY_KINDS, Colour, Overlay
from lqrsim.view.recorded_trial import RecordedTrial, interpolated

Shown = Annotated[Sequence[Overlay], Want("a tuple of overlays")]


def check_drawn(overlays: Sequence[Overlay], **given: object) -> None:
    """Raise InputError if one of `DRAWN_BY` is given, for one run or for several, without the overlay that draws it."""
    for name, value in given.items():
        items = value if isinstance(value, Sequence) else (value,)
        if (overlay := DRAWN_BY[name]) not in overlays and any(item is not None for item in items):
            raise InputError(f"{name}: got one without {overlay} in overlays=, want it with that")


Rgba = tuple[float, float, float, float]

# Opacities for planar robots and for robots in space.
TUBE_OPACITY = {True: 0.43, False: 0.2}  # of a whole tube
INTERPOLATED_OPACITY = {True: 0.4, False: 0.18}  # of a funnel between its knots
CERTIFIED_OPACITY = {True: 0.4, False: 0.16}  # of a certified ellipsoid
GHOST_OPACITY = {True: 0.35, False: 0.10}
INTERPOLATED = (0.98, 0.76, 0.38)  # the colour of a funnel, paler
DRIVEN = (0.0, 0.45, 0.7, 1.0)  # of a trace where a line has one colour
MOVING = (0.20, 0.38, 0.62, 0.5)  # obstacles that move, as those of the packaged scenes
MOST_ELLIPSOIDS = 80  # largest number of ellipsoids; more take too long to draw
LIFT = 0.006  # m, height of lines above the floor
SLIM = 0.65  # relative width of lines within a tube, which is often hardly wider than the lines
SEGMENTS = 120  # of a line, at most: each is a geom of MuJoCo's
DOTS = 30  # number of latest measured states that are drawn
ARROW = 4.0  # length of the largest force's arrow, in radii of the robot: longer than the robot, and no path
END_ON = 0.9  # cosine of the angle to the line of sight above which an arrow is not drawn

SIGMAS = 2.0  # standard deviations at which ellipsoids are drawn
COST_ABOVE_LEAST = SIGMAS**2 / 2  # total cost above its minimum, on an ellipsoid of the cost
PREDICTED = f"predicted: {SIGMAS:g} sigma, 95 % in each direction"
OF_COST = f"{SIGMAS:g} sigma of the cost: total ≤ least + {COST_ABOVE_LEAST:g}"

WIDEST = 0.2  # largest half axis that is drawn, relative to the extent of the plan; larger ones hide the picture
STAYS = 1e-3  # m; a plan of less extent stays in place, and its tube hides nothing
APART = 0.8  # distance between neighbours, in half axes


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """Ellipsoids at the knots of a plan, or at some of them: centres (k, d) and covariances (k, d, d)."""

    centres: Array
    covariances: Array
    cut_at: float | None = None  # half axis in m at which the tube is cut off; None if it is whole

    @classmethod
    def predicted(cls, centres: Array, covariances: Array) -> "Ellipsoids":
        """The ellipsoids of a tube about positions (T+1, d), up to the first that is too wide for a picture."""
        extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
        largest = WIDEST * extent if extent > STAYS else np.inf
        wide = SIGMAS * np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0)) > largest
        last = int(np.argmax(wide)) if wide.any() else len(wide)
        return cls(centres[:last], covariances[:last], largest if wide.any() else None)

    @classmethod
    def of_cost(cls, solution: Solution, states: tuple[int, ...]) -> "Ellipsoids":
        """The states whose total cost is at most `COST_ABOVE_LEAST` above its minimum, projected onto d of the states.

        The projection of an ellipsoid has the corresponding block of its covariance.
        """
        total, chosen = solution.total_cost, list(states)
        return cls(total.minimizer()[:, chosen], total.covariance()[:, chosen][:, :, chosen])

    @property
    def label(self) -> str:
        """The label of a predicted tube in a legend."""
        return PREDICTED if self.cut_at is None else f"{PREDICTED}; drawn up to half axes of {self.cut_at:.2g} m"

    def axes(self) -> tuple[Array, Array]:
        """Half axes (k, d), and rotations (k, d, d) whose columns are their directions."""
        covariances = 0.5 * (self.covariances + np.swapaxes(self.covariances, 1, 2))
        variances, rotations = np.linalg.eigh(covariances)
        rotations[:, :, 0] *= np.linalg.det(rotations)[:, None]
        return SIGMAS * np.sqrt(np.maximum(variances, 0.0)), rotations

    def projected(self, onto: Array) -> "Ellipsoids":
        """Their projections onto a plane, whose axes are the rows of `onto` (2, d)."""
        return Ellipsoids(self.centres @ onto.T, onto @ self.covariances @ onto.T, self.cut_at)

    def outlines(self) -> Array:
        """Outlines (k, 48, 2) of ellipses."""
        half_axes, rotations = self.axes()
        around = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        circle = np.stack([np.cos(around), np.sin(around)], axis=-1)
        return self.centres[:, None, :] + np.einsum("kij,kj,pj->kpi", rotations, half_axes, circle)

    def overlapping(self, knots: npt.NDArray[np.int64], most: int) -> npt.NDArray[np.int64]:
        """Knots whose ellipsoids overlap to a tube of even depth: the first, the last and some in between."""
        half_axes = self.axes()[0].mean(axis=1)
        chosen = list(knots[:1])
        for knot in knots[1:]:
            before = chosen[-1]
            apart = np.linalg.norm(self.centres[knot] - self.centres[before])
            grown = abs(half_axes[knot] - half_axes[before])
            if apart + grown >= APART * half_axes[knot] or knot == knots[-1]:
                chosen.append(knot)
        places = np.linspace(0, len(chosen) - 1, min(most, len(chosen))).astype(np.int64)
        return np.array(chosen, dtype=np.int64)[places]


class Shape(NamedTuple):
    """A geom of MuJoCo's as it is drawn in addition to the model's, without shadow and gloss."""

    kind: Geom
    size: Any  # (3,) numbers, as its place
    place: Any
    rgba: Any
    rotation: Array = np.eye(3)

    def set(self, geom: mujoco.MjvGeom, *, emission: float = 0.0) -> mujoco.MjvGeom:
        """Give a geom of a scene this shape; returns the geom."""
        mujoco.mjv_initGeom(geom, self.kind, self.size, self.place, self.rotation.ravel(), self.rgba)
        geom.category, geom.castshadow = mujoco.mjtCatBit.mjCAT_DECOR, 0
        geom.specular, geom.emission = 0, emission
        return geom

    def append(self, scene: mujoco.MjvScene, *, emission: float = 0.0) -> mujoco.MjvGeom:
        """Append a geom of this shape to a scene; returns the geom."""
        scene.ngeom += 1
        return self.set(scene.geoms[scene.ngeom - 1], emission=emission)


@dataclass(frozen=True, eq=False)
class Drawable:
    """Something in the world, in metres and seconds."""

    name: str  # of the overlay, of a part of it, or of an obstacle that moves
    rgba: Rgba
    label: str  # in the legend; none if empty

    def shapes(self, time: float) -> Iterable[Shape]:
        """What MuJoCo draws of it at a time; of an arrow nothing, which depends on the camera."""
        return ()


@dataclass(frozen=True, eq=False)
class Line(Drawable):
    """A line through points (k, 3), with half its width and half its thickness as profile."""

    points: Array
    profile: tuple[float, float]
    times: Array | None = None  # (k,) at which it gets to its points; None for a line that is always whole
    colours: Array | None = None  # (k-1, 4) of its segments, by the map of the tracking error; None if all have `rgba`

    def shapes(self, time: float) -> Iterator[Shape]:
        """A box for each segment that it has by then; boxes are cheaper than capsules."""
        points = self.points
        colours = np.tile(np.array(self.rgba), (len(points) - 1, 1)) if self.colours is None else self.colours
        if self.times is not None and time < self.times[-1]:
            count = int(np.searchsorted(self.times, time, side="right"))
            points = np.vstack([points[:count], interpolated(points, self.times, time)])
        along = np.diff(points, axis=0)
        length = np.linalg.norm(along, axis=1, keepdims=True)
        z = along / np.where(length > 0, length, 1)
        side = np.cross(np.where(np.abs(z[:, 2:]) < 0.99, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]), z)
        x = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
        rotations, centres = np.stack([x, np.cross(z, x), z], axis=-1), points[:-1] + 0.5 * along
        for i in np.flatnonzero(length > 1e-6):
            size = [*self.profile, 0.5 * length[i, 0]]
            yield Shape(Geom.mjGEOM_BOX, size, centres[i], colours[i], rotations[i])


@dataclass(frozen=True, eq=False)
class Dots(Drawable):
    """Boxes of half sizes (3,) at points (k, 3), each shown for `seconds` from its time (k,) on."""

    points: Array
    times: Array
    half_sizes: tuple[float, float, float]
    seconds: float

    def shapes(self, time: float) -> Iterator[Shape]:
        age = time - self.times
        for point in self.points[(age >= 0) & (age < self.seconds - 1e-9)]:
            yield Shape(Geom.mjGEOM_BOX, self.half_sizes, point, self.rgba)


@dataclass(frozen=True, eq=False)
class DrawnTube(Drawable):
    """Ellipsoids at knots (k,) of the plan: centres (k, 3), half axes (k, 3), and rotations (k, 3, 3) of their axes."""

    knots: npt.NDArray[np.int64]
    centres: Array
    half_axes: Array
    rotations: Array

    def shapes(self, time: float) -> Iterator[Shape]:
        for centre, sizes, rotation in zip(self.centres, self.half_axes, self.rotations, strict=True):
            yield Shape(Geom.mjGEOM_ELLIPSOID, sizes, centre, self.rgba, rotation)


@dataclass(frozen=True, eq=False)
class MovingBody(Drawable):
    """A body of a geom's kind, size (3,) and rotation (3, 3), at places (k, 3) at times (k,), and between them."""

    kind: str
    size: Array
    rotation: Array
    times: Array
    places: Array

    def at(self, times: Array | float) -> Array:
        """Its places at these times, (..., 3)."""
        return interpolated(self.places, self.times, times)

    def shapes(self, time: float) -> Iterator[Shape]:
        kind, size = getattr(Geom, f"mjGEOM_{self.kind.upper()}"), self.size
        size = np.full(3, size[0]) if self.kind == "sphere" else size
        yield Shape(kind, size, self.at(time), self.rgba, self.rotation)


@dataclass(frozen=True, eq=False)
class Arrow(Drawable):
    """The arrow of a force (T, 3) in each period, `width` thick; it begins `gap` from the robot, which may hide it."""

    forces: Array
    gap: float
    width: float
    metres_per_newton: float

    def draw_for(self, scene: mujoco.MjvScene, force: Array, place: Array, *, emission: float) -> None:
        """Append the arrow of a force (3,) on a robot at `place` (3,), for the camera that is set in the scene.

        An arrow along the line of sight is left out: it would show nothing and hide the robot.
        """
        forward, strength = np.array(scene.camera[0].forward, dtype=np.float64), float(np.linalg.norm(force))
        length = self.metres_per_newton * strength
        if length < 2 * self.width or abs(force @ forward) > END_ON * strength:
            return
        start = place + self.gap * force / strength
        geom = Shape(Geom.mjGEOM_ARROW, [1, 1, 1], start, self.rgba).append(scene, emission=emission)
        mujoco.mjv_connector(geom, Geom.mjGEOM_ARROW, self.width, start, start + length * force / strength)


class Scale(NamedTuple):
    """The error in m at the end of a trace's colours, and the force in N of the longest arrow, in all runs."""

    error: float
    force: float


def common_scale(recordings: Iterable[RecordedTrial]) -> Scale:
    """The scale for all of these runs, at all times."""
    largest = [(recorded.error.max(), np.linalg.norm(recorded.force, axis=1).max()) for recorded in recordings]
    error, force = (float(most) for most in np.max(largest, axis=0))
    error = max(error, 0.01)
    power = 10.0 ** np.floor(np.log10(error) + 1e-9)
    # Rounded up to one of 1, 1.5, 2, 3, 5, 7, 10, 15, ...
    steps = (step for step in (1, 1.5, 2, 3, 5, 7, 10) if step * power >= error * (1 - 1e-9))
    return Scale(float(power * next(steps)), force)


def error_colours(fractions: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Colours (n, 4) of errors as fractions (n,) of the full scale."""
    import matplotlib  # not above: viewers draw no trace in colours, and matplotlib makes a folder for its settings

    return np.asarray(matplotlib.colormaps["cividis"](np.asarray(fractions, dtype=np.float64)))


class Overlays:
    """The overlays of one trial that have something to draw."""

    _prefix = ""

    @checked
    def __init__(
        self,
        recorded: RecordedTrial,
        show: Shown,
        scale: Scale,
        *,
        solution: Solution | None = None,
        funnel: Funnel | None = None,
        segments: int = SEGMENTS,
    ) -> None:
        self.recorded, self.scale = recorded, scale
        self.membership: tuple[str, ...] | None = None  # in the funnel, for each of T+1 steps as text
        self._lift = np.array([0.0, 0.0, LIFT if recorded.planar else 0.0])
        # In the order of the legend.
        self.drawables = [*self._draw(show, solution, funnel, segments), *self._moving()]

    def readings(self, time: float, speed: float = 1.0) -> list[str]:
        """Time, error, clearance and force at a time, and whether the run is in the funnel or has ended."""
        recorded = self.recorded
        clearance, error = (np.interp(time, recorded.times, values) for values in (recorded.clearance, recorded.error))
        texts = [f"time {time:.1f} s" + (f" at {speed:g}x" if speed != 1 else "")]
        if recorded.rollout.tracking_unit == OF_RANGE:
            texts.append(f"tracking error {100 * error:.1f} % of range")
        else:
            texts.append(f"tracking error {1e3 * error:.0f} mm" if error < 1 else f"tracking error {error:.2f} m")
        if np.isfinite(clearance):
            texts.append(f"clearance {clearance:.2f} m")
        if any(isinstance(drawable, Arrow) for drawable in self.drawables):
            texts.append(f"force {np.linalg.norm(recorded.force_at(time)):.2f} N")
        if self.membership is not None:
            texts.append(self.membership[recorded.step(time)])
        return texts + ([ending.replace("_", " ")] if (ending := recorded.ending(time)) else [])

    def _draw(
        self, show: Sequence[Overlay], solution: Solution | None, funnel: Funnel | None, segments: int
    ) -> Iterator[Drawable]:
        """The overlays but texts, in the order of the legend."""
        recorded, run, planar, lift = self.recorded, self.recorded.rollout, self.recorded.planar, self._lift
        knots = np.unique(np.linspace(0, run.plan.steps, min(run.plan.steps, segments) + 1).astype(int))
        times, position = run.times[knots], list(run.state_coordinates.position)
        tube = None
        if "tube" in show and run.tube is not None and run.tube.max() >= 1e-12:
            ellipsoids = Ellipsoids.predicted(run.plan.states[:, position], run.tube)
            tube = self._overlapping("tube", colour_of("tube"), ellipsoids.label, ellipsoids, height=0.6)
        width = 0.0035 * recorded.model.stat.extent * (1.0 if tube is None else SLIM)

        def profile(relative: float) -> tuple[float, float]:  # on a floor, lines are flat
            return relative * width, 0.2 * LIFT if planar else relative * width

        if "plan" in show:
            yield Line("plan", rgba_of("plan"), "planned", recorded.planned(times) + 2 * lift, profile(0.8))
        if "forces" in show and self.scale.force >= 1e-6:
            # The radius of an arm is its reach.
            gap = min(run.radius or recorded.size, 0.1 * recorded.model.stat.extent)
            label, longest = f"force, longest {self.scale.force:.2g} N", ARROW * gap
            thick, for_newton = max(0.1 * gap, 1.5 * width), longest / self.scale.force
            yield Arrow("forces", rgba_of("forces"), label, recorded.force, gap, thick, for_newton)
        if "measured" in show and position and not np.array_equal(recorded.measured, recorded.states):
            points = run.in_world(recorded.measured[:, position], height=recorded.floor) + 3 * lift
            sizes, seconds = (width, *profile(1.0)), DOTS * run.plan.dt
            yield Dots("measured", rgba_of("measured"), "measured", points, recorded.times, sizes, seconds)
        if tube is not None:
            yield tube
        if "cost_tube" in show:
            ellipsoids, colour = self._of_cost(solution), colour_of("cost_tube")
            yield self._overlapping("cost_tube", colour, OF_COST, ellipsoids, height=0.3)
        if "funnel" in show:
            yield from self._draw_funnel(funnel)
        if "trace" in show:
            errors, full = np.interp(times, recorded.times, recorded.error), self.scale.error
            end = f"{1e3 * full:g} mm" if full < 1 else f"{full:g} m"
            end = f"{100 * full:g} % of range" if run.tracking_unit == OF_RANGE else end
            colours = error_colours(0.5 * (errors[1:] + errors[:-1]) / full)
            points, wide = recorded.driven(times) + lift, profile(2.6 if planar else 1.1)
            yield Line("trace", DRIVEN, f"driven, tracking error 0 to {end}", points, wide, times, colours)
        if "ghost" in show:
            places, kind = recorded.planned(run.times), "cylinder" if planar else "sphere"
            if planar:
                places[:, 2] = recorded.floor + 3 * LIFT
            rgba, size = rgba_of("ghost", GHOST_OPACITY[planar]), np.array([recorded.ghost_radius, LIFT, 0.0])
            yield MovingBody("ghost", rgba, "", kind, size, np.eye(3), run.times, places)

    def _moving(self) -> Iterator[MovingBody]:
        """The obstacles that move, except planes, which have no thickness; infinite ones reach far beyond the scene."""
        moving, times = self.recorded.rollout.moving, np.array([0.0, self.recorded.end])
        if moving is None:
            return
        for i, kind in enumerate(moving.kinds):
            if kind != "plane":
                size = np.minimum(moving.sizes[i], 10 * self.recorded.model.stat.extent)
                places = moving.positions[i] + times[:, None] * moving.velocities[i]
                name, shape = f"moving {moving.names[i]}", "box" if kind == "mesh" else kind  # the box about a hull
                yield MovingBody(name, MOVING, "", shape, size, moving.rotations[i], times, places)

    def _of_cost(self, solution: Solution | None) -> Ellipsoids:
        """The ellipsoids in which the solution's total cost is near its minimum."""
        run = self.recorded.rollout
        if solution is None:
            raise InputError("solution: got None with the overlay cost_tube, want the Solution that was run")
        if not run.state_coordinates.position:
            raise InputError("overlays: got cost_tube for a robot without a position, want other overlays")
        if not np.array_equal(solution.trajectory.states, run.plan.states):
            raise InputError("solution: got a plan other than the run's, want the Solution that was run")
        return Ellipsoids.of_cost(solution, run.state_coordinates.position)

    def _draw_funnel(self, funnel: Funnel | None) -> Iterator[DrawnTube]:
        """The projection of a funnel onto the position, from its first knot to its last, wherever it has a level."""
        run, planar = self.recorded.rollout, self.recorded.planar
        if funnel is None:
            raise InputError("funnel: got None with the overlay funnel, want the Funnel about the plan of the run")
        if not np.array_equal(funnel.plan.states, run.plan.states):
            raise InputError("funnel: got a funnel about another plan, want a funnel about the plan of the run")
        covariances = funnel.position_covariance / SIGMAS**2  # gives the half axes at the level
        ellipsoids = Ellipsoids(run.plan.states[:, list(run.state_coordinates.position)], covariances)
        levels, knots = np.array([funnel.level(t) for t in run.times]), np.arange(len(run.times))
        covered = (levels > 0) & (knots >= funnel.knots[0]) & (knots <= funnel.knots[-1])
        membership = ["no funnel here"] * len(knots)
        for knot in np.flatnonzero(covered):
            inside = funnel.contains(run.states[self.recorded.trial, knot], float(run.times[knot]))
            membership[knot] = "in the funnel" if inside else "outside the funnel"
        self.membership = tuple(membership)
        at_knots = np.isin(knots, funnel.knots)
        certified, between = np.flatnonzero(covered & at_knots), np.flatnonzero(covered & ~at_knots)
        if len(certified):
            certified = certified[np.linspace(0, len(certified) - 1, min(MOST_ELLIPSOIDS, len(certified))).astype(int)]
            label = f"funnel: {100 * funnel.rate:g} % succeed, confidence {100 * funnel.confidence:g} %"
            rgba = rgba_of("funnel", CERTIFIED_OPACITY[planar])
            yield self._tube("funnel", rgba, label, ellipsoids, certified, height=0.2)
        if len(between):
            label, opacity = "funnel, interpolated", INTERPOLATED_OPACITY
            yield self._overlapping(
                "interpolated", INTERPOLATED, label, ellipsoids, height=0.1, knots=between, opacity=opacity
            )

    def _overlapping(
        self, name: str, colour: Colour, label: str, ellipsoids: Ellipsoids, *, height: float,
        knots: npt.NDArray[np.int64] | None = None, opacity: Mapping[bool, float] = TUBE_OPACITY,
    ) -> DrawnTube:  # fmt: skip
        """Some of the ellipsoids, at these knots or all. Where they overlap, their joint opacity is about this."""
        knots = np.arange(len(ellipsoids.centres)) if knots is None else knots
        knots = ellipsoids.overlapping(knots, MOST_ELLIPSOIDS)
        apart = np.linalg.norm(np.diff(ellipsoids.centres[knots], axis=0), axis=1).sum() / max(len(knots) - 1, 1)
        overlap = 2 * float(ellipsoids.axes()[0][knots].mean()) / apart if apart > 0 else 1.0
        # Ellipsoids that hardly overlap must not be too opaque: they would show as stripes on the lines within.
        alpha = 1 - (1 - opacity[self.recorded.planar]) ** (1 / np.clip(overlap, 1.6, 10.0))
        return self._tube(name, (*colour, float(alpha)), label, ellipsoids, knots, height=height)

    def _tube(
        self, name: str, rgba: Rgba, label: str, ellipsoids: Ellipsoids, knots: npt.NDArray[np.int64], *, height: float
    ) -> DrawnTube:
        """The ellipsoids at these knots in the world, at this height above a floor in units of LIFT."""
        space = self.recorded.rollout.state_coordinates
        size, count = len(space.position), len(knots)
        lengths, turns = (part[knots] for part in ellipsoids.axes())
        half_axes, rotations = np.full((count, 3), 0.1 * LIFT), np.zeros((count, 3, 3))
        half_axes[:, :size] = np.maximum(lengths, 0.1 * LIFT)  # an ellipsoid without width cannot be drawn
        rotations[:, list(space.world_axes), :size] = turns
        if size == 2:  # the third axis of a flat ellipsoid
            rotations[:, :, 2] = np.cross(rotations[:, :, 0], rotations[:, :, 1])
        centres = space.in_world(ellipsoids.centres[knots], height=self.recorded.floor) + height * self._lift
        return DrawnTube(name, rgba, label, knots, centres, half_axes, rotations)


def colour_of(overlay: Overlay) -> Colour:
    """The colour of an overlay that has one."""
    colour = OVERLAY_KINDS[overlay].colour
    assert colour is not None
    return colour


def rgba_of(overlay: Overlay, opacity: float = 1.0) -> Rgba:
    """The colour of an overlay that has one, with its opacity."""
    return (*colour_of(overlay), opacity)


def legend_entries(overlays: Iterable[Overlays]) -> dict[str, Colour | None]:
    """Labels and colours of a picture; the colour None is the map of the tracking error, and last."""
    colours: dict[str, Colour | None] = {
        part.label: None if isinstance(part, Line) and part.colours is not None else part.rgba[:3]
        for run in overlays
        for part in run.drawables
        if part.label
    }
    # If one of two labels begins with the other, as for tubes drawn in part and in full, the longer one stays.
    short = [label for label in colours if any(other != label and other.startswith(label) for other in colours)]
    entries = [(label, colour) for label, colour in colours.items() if label not in short]
    return dict(sorted(entries, key=lambda entry: entry[1] is None))
