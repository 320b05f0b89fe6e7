"""Overlays of pictures, drawn as MuJoCo geoms in addition to the model's: lines, forces, tubes, funnels, the mark."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco import mjtGeom as Geom

from lqrsim.errors import Array, InputError
from lqrsim.results.funnel import Funnel
from lqrsim.results.solution import Solution
from lqrsim.view.cameras import Camera
from lqrsim.view.ellipsoids import OF_COST, SIGMAS, Ellipsoids
from lqrsim.view.options import Overlay
from lqrsim.view.recorded_trial import RecordedTrial

Colour = tuple[float, float, float]

# The mark by which a robot's position is read from a video: a green ball at the origin of its body, in front of a black
# ball. Nothing else is pure green. The mark emits all of its light, so it looks the same in the sun and in the shade.
MARK_RGB = (0.0, 1.0, 0.0)
RIM = 1.8  # radius of the black ball, in radii of the green one: a video then blurs one colour into the whole edge
PLAN_RGB = (0.78, 0.08, 0.42)  # colour of the plan; neither the error map nor a robot has it

# Opacities for planar robots and for robots in space: of a whole tube, of a funnel between its knots, of a certified
# ellipsoid, and of the planned position.
OPACITY = {True: 0.43, False: 0.2}
BETWEEN_OPACITY = {True: 0.4, False: 0.18}
CERTIFIED_OPACITY = {True: 0.4, False: 0.16}
GHOST_OPACITY = {True: 0.35, False: 0.10}
MOST_ELLIPSOIDS = 80  # largest number of ellipsoids; more take too long to draw
LIFT = 0.006  # m, height of lines above the floor


@dataclass(frozen=True, eq=False)
class DrawnTube:
    """Ellipsoids in the world.

    Attributes:
      knots: (k,), knots of the plan.
      in_world: centres (k, 3), half axes (k, 3) and rotations (k, 3, 3).
      label: label in the legend.
      opacity: opacity of each ellipsoid.
    """

    knots: npt.NDArray[np.int64]
    in_world: tuple[Array, Array, Array]
    label: str
    opacity: float


@dataclass(frozen=True, eq=False)
class DrawnFunnel:
    """A funnel in the world.

    Attributes:
      certified: its ellipsoids at knots with a level, or None.
      between: some ellipsoids of interpolated levels, or None.
      said: (T+1) whether the run was in the funnel at each step, as text.
    """

    certified: DrawnTube | None
    between: DrawnTube | None
    said: tuple[str, ...]


def predicted(recorded: RecordedTrial) -> DrawnTube | None:
    """The predicted tube of the run; None if there is none, or it has no width."""
    run = recorded.rollout
    if run.tube is None or run.tube.max() < 1e-12:
        return None
    ellipsoids = Ellipsoids.predicted(run.plan.states[:, list(run.state_coordinates.position)], run.tube)
    return _tube(recorded, ellipsoids, np.arange(len(ellipsoids.centres)), ellipsoids.label)


def of_cost(recorded: RecordedTrial, solution: Solution | None) -> DrawnTube:
    """The ellipsoids in which the solution's total cost is near its minimum."""
    run = recorded.rollout
    if solution is None:
        raise InputError("solution: got None with the overlay cost_tube, want the Solution that was run")
    if not run.state_coordinates.position:
        raise InputError("overlays: got cost_tube for a robot without a position, want other overlays")
    if not np.array_equal(solution.trajectory.states, run.plan.states):
        raise InputError("solution: got a plan other than the run's, want the Solution that was run")
    ellipsoids = Ellipsoids.of_cost(solution, run.state_coordinates.position)
    return _tube(recorded, ellipsoids, np.arange(len(ellipsoids.centres)), OF_COST)


def of_funnel(recorded: RecordedTrial, funnel: Funnel | None) -> DrawnFunnel:
    """The projection of a funnel onto the position, from its first knot to its last, wherever it has a level.

    Raises:
      InputError: there is no funnel, it has another plan, or the position is not among its states.
    """
    run = recorded.rollout
    if funnel is None:
        raise InputError("funnel: got None with the overlay funnel, want the Funnel about the plan of the run")
    if not np.array_equal(funnel.plan.states, run.plan.states):
        raise InputError("funnel: got a funnel about another plan, want a funnel about the plan of the run")
    covariances = funnel.position_covariance / SIGMAS**2  # gives the half axes at the level
    every = Ellipsoids(run.plan.states[:, list(run.state_coordinates.position)], covariances)
    levels, knots = np.array([funnel.level(t) for t in run.times]), np.arange(len(run.times))
    drawn = (levels > 0) & (knots >= funnel.knots[0]) & (knots <= funnel.knots[-1])
    at_knots = np.isin(knots, funnel.knots)
    held, between = _some_of(np.flatnonzero(drawn & at_knots)), np.flatnonzero(drawn & ~at_knots)
    said = ["no funnel here"] * len(knots)
    for knot in np.flatnonzero(drawn):
        inside = funnel.contains(run.states[recorded.trial, knot], float(run.times[knot]))
        said[knot] = "in the funnel" if inside else "outside the funnel"
    stated = f"funnel: {100 * funnel.rate:g} % succeed, confidence {100 * funnel.confidence:g} %"
    certified = DrawnTube(held, _in_world(recorded, every, held), stated, CERTIFIED_OPACITY[recorded.planar])
    return DrawnFunnel(
        certified=certified if len(held) else None,
        between=_tube(recorded, every, between, "funnel, interpolated", BETWEEN_OPACITY) if len(between) else None,
        said=tuple(said),
    )


def _tube(
    recorded: RecordedTrial,
    every: Ellipsoids,
    among: npt.NDArray[np.int64],
    label: str,
    opaque: Mapping[bool, float] = OPACITY,
) -> DrawnTube:
    """Some of the ellipsoids at these knots. If they overlap, their joint opacity is about the given one."""
    one = Ellipsoids(every.centres[among], every.covariances[among])
    chosen = one.spread(MOST_ELLIPSOIDS)
    apart = np.linalg.norm(np.diff(one.centres[chosen], axis=0), axis=1).sum() / max(len(chosen) - 1, 1)
    overlap = 2 * float(one.axes()[0][chosen].mean()) / apart if apart > 0 else 1.0
    # Ellipsoids that hardly overlap must not be too opaque: they would show as stripes on the lines within.
    opacity = 1 - (1 - opaque[recorded.planar]) ** (1 / np.clip(overlap, 1.6, 10.0))
    knots = among[chosen]
    return DrawnTube(knots, _in_world(recorded, every, knots), label, float(opacity))


def _in_world(recorded: RecordedTrial, every: Ellipsoids, knots: npt.NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Centres (k, 3), half axes (k, 3) and rotations (k, 3, 3) of the ellipsoids at these knots."""
    space = recorded.rollout.state_coordinates
    size, count = len(space.position), len(knots)
    lengths, turns = (part[knots] for part in every.axes())
    half_axes, rotations = np.full((count, 3), 0.1 * LIFT), np.zeros((count, 3, 3))
    half_axes[:, :size] = np.maximum(lengths, 0.1 * LIFT)  # an ellipsoid without width cannot be drawn
    rotations[:, list(space.world_axes), :size] = turns
    if size == 2:  # the third axis of a flat ellipsoid
        rotations[:, :, 2] = np.cross(rotations[:, :, 0], rotations[:, :, 1])
    return space.in_world(every.centres[knots], height=recorded.floor), half_axes, rotations


def _some_of(knots: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Evenly spread knots, at most as many as can be drawn."""
    return knots[np.linspace(0, len(knots) - 1, min(MOST_ELLIPSOIDS, len(knots))).astype(np.int64)]


# Like PLAN_RGB, these colours are neither in the error map nor on a robot.
FORCE = (0.0, 0.50, 0.36)
MEASURED = (0.10, 0.10, 0.12)
TUBE = (0.0, 0.70, 0.72)
COST_TUBE = (0.47, 0.30, 0.78)
FUNNEL, BETWEEN = (0.92, 0.55, 0.0), (0.98, 0.76, 0.38)  # certified, and interpolated; not green, as the mark is
SLIM = 0.65  # relative width of lines within a tube, which is often hardly wider than the lines
SEGMENTS = 120  # largest number of segments of a line
MOVING = (0.20, 0.38, 0.62, 0.5)  # obstacles that move, as those of the packaged scenes
DOTS = 30  # number of latest measured states that are drawn
ARROW = 4.0  # length of the largest force's arrow, in radii of the robot: longer than the robot, and no path
END_ON = 0.9  # cosine of the angle to the line of sight above which an arrow is not drawn


_DRAWN = {
    "sphere": Geom.mjGEOM_SPHERE, "capsule": Geom.mjGEOM_CAPSULE, "cylinder": Geom.mjGEOM_CYLINDER,
    "box": Geom.mjGEOM_BOX,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class DrawnObstacle:
    """An obstacle that moves.

    Attributes:
      kind: one of _DRAWN.
      begin: (3,) its position at the beginning, in metres.
      velocity: (3,) in m/s.
      size: (3,) in metres, as of a geom.
      rotation: (3, 3), its axes as columns.
    """

    kind: str
    begin: Array
    velocity: Array
    size: Array
    rotation: Array


@dataclass(frozen=True)
class Scale:
    """The meaning of colours and lengths, the same for all runs in a picture.

    Attributes:
      error: error at the end of the trace's colours, in metres.
      force: force of the longest arrow, in N.
    """

    error: float
    force: float


def common_scale(recordings: Iterable[RecordedTrial]) -> Scale:
    """The scale for all of these runs, at all times."""
    largest = [(recorded.error.max(), np.linalg.norm(recorded.force, axis=1).max()) for recorded in recordings]
    error, force = (float(most) for most in np.max(largest, axis=0))
    return Scale(_round_up(max(error, 0.01)), force)


class Overlays:
    """The overlays of one trial.

    Args:
      solution: the solution that was run, for the tube of its cost.
      show: names of overlays; overlays without content, such as a tube that was not predicted, are left out.
      funnel: a funnel about the plan of the run.

    Raises:
      InputError: the solution or the funnel is missing or does not belong to the run; the solution has no total cost,
        or the funnel does not include the position.
    """

    def __init__(
        self,
        recorded: RecordedTrial,
        solution: Solution | None,
        show: Sequence[Overlay],
        scale: Scale,
        funnel: Funnel | None = None,
    ) -> None:
        self.recorded, self.show, self.scale = recorded, set(show), scale
        self.width = 0.0035 * recorded.model.stat.extent
        steps = recorded.rollout.plan.steps
        knots = np.unique(np.linspace(0, steps, min(steps, SEGMENTS) + 1).astype(int))
        self.knots = recorded.rollout.times[knots]
        self.plan, self.trace = recorded.planned(self.knots), recorded.driven(self.knots)
        self.errors = np.interp(self.knots, recorded.times, recorded.error)
        self.measured = recorded.measured_places()
        if not len(self.measured) or np.array_equal(recorded.measured, recorded.states):
            self.show.discard("measured")
        if scale.force < 1e-6:
            self.show.discard("forces")
        self.tube = predicted(recorded) if "tube" in self.show else None
        self.cost_tube = of_cost(recorded, solution) if "cost_tube" in self.show else None
        self.funnel = of_funnel(recorded, funnel) if "funnel" in self.show else None
        self.moving = _moving(recorded)
        if self.tube is not None:
            self.width *= SLIM
        self.plan_width, self.trace_width = 0.8 * self.width, (2.6 if recorded.planar else 1.1) * self.width

    def legend_entries(self) -> list[tuple[str, Colour]]:
        """Labels and colours, except for the trace."""
        entries = {
            "plan": ("planned", PLAN_RGB),
            "forces": (f"force, longest {self.scale.force:.2g} N", FORCE),
            "measured": ("measured", MEASURED),
        }
        found = [entry for overlay, entry in entries.items() if overlay in self.show]
        return found + [(tube.label, colour) for tube, colour, _ in reversed(self.tubes())]

    def tubes(self) -> list[tuple[DrawnTube, Colour, float]]:
        """The tubes with their colours, and their heights above a floor relative to LIFT."""
        certified, between = (None, None) if self.funnel is None else (self.funnel.certified, self.funnel.between)
        tubes = (
            (between, BETWEEN, 0.1),
            (certified, FUNNEL, 0.2),
            (self.cost_tube, COST_TUBE, 0.3),
            (self.tube, TUBE, 0.6),
        )
        return [(tube, colour, height) for tube, colour, height in tubes if tube is not None]

    def draw(self, scene: mujoco.MjvScene, data: mujoco.MjData, time: float) -> None:
        """Append the geoms of a moment to the scene; `data` is posed at that time."""
        pen, recorded = _Pen(scene, flat=self.recorded.planar), self.recorded
        for body in self.moving:
            pen.add(_DRAWN[body.kind], body.begin + time * body.velocity, body.size, MOVING, body.rotation)
        lift = np.array([0.0, 0.0, LIFT if recorded.planar else 0.0])
        for tube, colour, height in self.tubes():
            for centre, sizes, rotation in zip(*tube.in_world, strict=True):
                pen.add(Geom.mjGEOM_ELLIPSOID, centre + height * lift, sizes, (*colour, tube.opacity), rotation)
        if "trace" in self.show:
            done = int(np.searchsorted(self.knots, time, side="right"))
            points = np.vstack([self.trace[:done], recorded.driven(time)])
            errors = np.append(self.errors[:done], recorded.interpolate(recorded.error, time))
            colours = error_colours(0.5 * (errors[1:] + errors[:-1]) / self.scale.error)
            pen.ribbon(points + lift, self.trace_width, colours)
        if "plan" in self.show:
            colours = np.tile((*PLAN_RGB, 1.0), (len(self.plan) - 1, 1))
            pen.ribbon(self.plan + 2 * lift, self.plan_width, colours)
        if "measured" in self.show:
            seen = int(np.searchsorted(recorded.times, time, side="right"))
            for place in self.measured[max(seen - DOTS, 0) : seen]:
                height = 0.2 * LIFT if recorded.planar else self.width
                pen.add(Geom.mjGEOM_BOX, place + 3 * lift, [self.width, self.width, height], (*MEASURED, 1.0))
        if "ghost" in self.show:
            wanted, radius = recorded.planned(time), recorded.ghost_radius
            colour = (*PLAN_RGB, GHOST_OPACITY[recorded.planar])
            if recorded.planar:
                wanted[2] = recorded.floor
                pen.add(Geom.mjGEOM_CYLINDER, wanted + 3 * lift, [radius, LIFT, 0], colour)
            else:
                pen.add(Geom.mjGEOM_SPHERE, wanted, [radius] * 3, colour)

    @property
    def arrow(self) -> tuple[float, float, float]:
        """Of the force's arrow: the distance of its start from the robot, its thickness, and its length for 1 N, in
        metres."""
        # The radius of an arm is its reach.
        radius = min(self.recorded.rollout.radius, 0.1 * self.recorded.model.stat.extent)
        return radius, max(0.1 * radius, 1.5 * self.width), ARROW * radius / self.scale.force

    def draw_force(self, scene: mujoco.MjvScene, data: mujoco.MjData, time: float) -> None:
        """Append the arrow of the disturbing force, for the camera that is set in the scene.

        It begins at the edge of the robot's circle. An arrow along the line of sight is left out: it would show nothing
        and hide the robot.
        """
        if "forces" not in self.show:
            return
        recorded, forward = self.recorded, np.array(scene.camera[0].forward, dtype=np.float64)
        force, (apart, width, for_newton) = recorded.force_at(time), self.arrow
        strength = float(np.linalg.norm(force))
        length = for_newton * strength
        if length < 2 * width or abs(force @ forward) > END_ON * strength:
            return
        direction = force / strength
        start = recorded.place_in(data) + apart * direction
        arrow = _Pen(scene, flat=recorded.planar).add(Geom.mjGEOM_ARROW, start, [1, 1, 1], (*FORCE, 1.0))
        mujoco.mjv_connector(arrow, Geom.mjGEOM_ARROW, width, start, start + length * direction)


def _moving(recorded: RecordedTrial) -> list[DrawnObstacle]:
    """The obstacles that move, except planes, which have no thickness; infinite ones reach far beyond the scene."""
    moving, longest = recorded.rollout.moving, 10 * recorded.model.stat.extent
    if moving is None:
        return []
    each = zip(moving.kinds, moving.positions, moving.velocities, moving.sizes, moving.rotations, strict=True)
    return [
        DrawnObstacle(kind, begin, velocity, np.minimum(size, longest), rotation)
        for kind, begin, velocity, size, rotation in each
        if kind in _DRAWN
    ]


class _Pen:
    """Appends geoms to a scene. With `flat`, lines are lit and lie on a floor; otherwise they hang in space."""

    def __init__(self, scene: mujoco.MjvScene, *, flat: bool) -> None:
        self.scene, self.flat = scene, flat

    def add(
        self, kind: Geom, position: Array, size: npt.ArrayLike, rgba: npt.ArrayLike, rotation: Array | None = None
    ) -> mujoco.MjvGeom:
        geom = decorate(self.scene.geoms[self.scene.ngeom], kind, size, position, rgba, rotation)
        geom.specular, geom.emission = 0, 0 if self.flat else 0.3
        self.scene.ngeom += 1
        return geom

    def ribbon(self, points: Array, width: float, colours: Array) -> None:
        """A line through points (k, 3), with a colour (k-1, 4) for each segment; boxes are cheaper than capsules."""
        along = np.diff(points, axis=0)
        length = np.linalg.norm(along, axis=1, keepdims=True)
        z = along / np.where(length > 0, length, 1)
        side = np.cross(np.where(np.abs(z[:, 2:]) < 0.99, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]), z)
        x = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
        rotations, centres = np.stack([x, np.cross(z, x), z], axis=-1), points[:-1] + 0.5 * along
        thickness = 0.2 * LIFT if self.flat else width
        for number in np.flatnonzero(length > 1e-6):
            size = [width, thickness, 0.5 * length[number, 0]]
            self.add(Geom.mjGEOM_BOX, centres[number], size, colours[number], rotations[number])


def _round_up(value: float) -> float:
    """Round up to one of 1, 1.5, 2, 3, 5, 7, 10, 15, ..."""
    power = 10.0 ** np.floor(np.log10(value) + 1e-9)
    return float(power * next(step for step in (1, 1.5, 2, 3, 5, 7, 10) if step * power >= value * (1 - 1e-9)))


def error_colours(fractions: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Colours (n, 4) of errors as fractions (n,) of the full scale."""
    import matplotlib  # not above: viewers draw no trace in colours, and matplotlib makes a folder for its settings

    return np.asarray(matplotlib.colormaps["cividis"](np.asarray(fractions, dtype=np.float64)))


def decorate(
    geom: mujoco.MjvGeom,
    kind: Geom,
    size: npt.ArrayLike,
    position: npt.ArrayLike,
    rgba: npt.ArrayLike,
    rotation: Array | None = None,
) -> mujoco.MjvGeom:
    """Give a geom this kind, size (3,), position (3,) and colour (4,), without a shadow; returns the geom."""
    mujoco.mjv_initGeom(
        geom,
        kind,
        np.asarray(size, dtype=np.float64),
        np.asarray(position, dtype=np.float64),
        (np.eye(3) if rotation is None else rotation).ravel(),
        np.asarray(rgba, dtype=np.float32),
    )
    geom.category, geom.castshadow = mujoco.mjtCatBit.mjCAT_DECOR, 0
    return geom


def mark_radius(recorded: RecordedTrial) -> float:
    """Radius of the mark of a robot, in metres."""
    return 0.25 * recorded.size


def draw_mark(scene: mujoco.MjvScene, camera: Camera, centre: Array, radius: float) -> None:
    """Add the mark of a robot whose body is at `centre` (3,) to a scene that is seen through the camera.

    It is drawn close to the camera, where nothing hides it. In an orthographic picture this does not change its
    position.
    """
    forward = np.array(camera.forward)
    centre = centre - (forward @ (centre - camera.position)) * forward
    for distance, size, colour in ((1, radius, MARK_RGB), (2, RIM * radius, (0.0, 0.0, 0.0))):
        place = centre + (distance + size) * forward
        ball = decorate(scene.geoms[scene.ngeom], Geom.mjGEOM_SPHERE, [size] * 3, place, (*colour, 1.0))
        ball.specular, ball.emission = 0, 1
        scene.ngeom += 1
