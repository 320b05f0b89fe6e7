"""Verification of runs from pixels, by drawing them or from their videos.

Positions from the pixels are compared with the simulator's and with the plan. Errors are tested against bounds, the
parts of a record must fit together, and a failure is diagnosed.
"""

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import av
import mujoco
import numpy as np
import numpy.typing as npt
from av.error import FFmpegError
from mujoco import mjtGeom as Geom

from lqrsim.annotations import LINE, Index, Line, Progress, checked
from lqrsim.errors import Array, InputError
from lqrsim.results import save_load
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import spaces_of
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenes.mjcf_kinematics import carriers, posed
from lqrsim.view import gl
from lqrsim.view.cameras import RIM, Camera, calibrated, measuring
from lqrsim.view.picture import Pane
from lqrsim.view.recorded_trial import RecordedTrial, interpolated, place_of, tracked_balls
from lqrsim.view.render import digest, read_metadata

HIDDEN_FRACTION = 0.05  # of the frames, in which the robot may be hidden
SCALE_ERROR = 0.002  # largest, of the scale
VERDICTS = {True: "passed", False: "FAILED", None: "not checked"}
FEW_FRAMES = 4  # up to this number, each wrong frame is named


@checked
@dataclass(frozen=True)
class Criterion:
    """One test of a verification."""

    __test__ = False  # pytest would collect it

    name: Line
    passed: bool | None  # None if it could not be checked
    detail: Line  # the measured value, and the required value


@checked
@dataclass(frozen=True, eq=False)
class Verification:
    """Positions of a run from pixels, in N frames with d coordinates, and the tests that they passed.

    Attributes:
      seen: (N, d) positions from pixels in metres; NaN where the robot is hidden.
      actual: (N, d) positions in the simulator.
      planned: (N, d) positions in the plan.
      rms: root mean square of the distance between seen and actual, in metres.
      worst: largest distance between seen and actual, in metres.
      shift: shift of the pictures ahead of the run, in seconds.
      scale: scale of the seen motion relative to the actual one.
      likely: the likely cause if a test failed; otherwise empty.
    """

    subject: Annotated[str, 10 * LINE]
    method: Annotated[str, 10 * LINE]
    times: Annotated[Array, "N"]
    seen: Annotated[Array, "N d"]
    actual: Annotated[Array, "N d"]
    planned: Annotated[Array, "N d"]
    rms: float
    worst: float
    shift: float
    scale: float
    tests: tuple[Criterion, ...]
    likely: Annotated[str, 10 * LINE]

    def __post_init__(self) -> None:
        if not len(self.times):
            raise InputError("Verification: times: got none, want one for each frame")

    @property
    def passed(self) -> bool:
        return all(test.passed is not False for test in self.tests)

    @property
    def tracking_error(self) -> Array:
        """Distance from the plan by pixels, in metres, (N,)."""
        return np.linalg.norm(self.seen - self.planned, axis=1)

    def summary(self) -> str:
        """The verdict, and a line for each test."""
        error, recorded = self.tracking_error, np.linalg.norm(self.actual - self.planned, axis=1)
        lines = [
            f"{'verified' if self.passed else 'NOT VERIFIED'}: {self.subject}, by {self.method}",
            f"  off the simulator's position by {1e3 * self.rms:.1f} mm rms, {1e3 * self.worst:.1f} mm at worst;"
            f" {1e3 * self.shift:+.1f} ms ahead; scale {self.scale:.4f}",
            f"  off the plan by {1e3 * _rms(error):.0f} mm rms, {1e3 * np.nanmax(error, initial=0):.0f} mm at worst;"
            f" the record says {1e3 * _rms(recorded):.0f} and {1e3 * recorded.max():.0f} mm",
        ]
        lines += [f"  {VERDICTS[test.passed]}  {test.name}: {test.detail}" for test in self.tests]
        return "\n".join(lines + ([f"  likely: {self.likely}"] if self.likely else []))

    __str__ = summary


def recorded_trial(rollout: Rollout, trial: int) -> RecordedTrial:
    """The trial with its model. Raises InputError if there is none, or it has no frames."""
    if len(rollout.frame_times) < 2:
        raise InputError(f"rollout.frames: got shape {rollout.frames.shape}, want what simulate(frames=True) records")
    return RecordedTrial(rollout, trial)


def frames_at_states(rollout: Rollout, trial: int) -> tuple[Array, npt.NDArray[np.intp]]:
    """The times of the states that have a frame, and the rows of these frames."""
    rows = np.abs(rollout.frame_times - rollout.times[:, None]).argmin(axis=1)
    good = np.abs(rollout.frame_times[rows] - rollout.times) < 1e-6 * rollout.plan.dt
    good &= np.isfinite(rollout.frames[trial, rows]).all(axis=1) & np.isfinite(rollout.states[trial]).all(axis=1)
    if good.sum() < 3:
        raise InputError(f"rollout: got trial {trial} with {good.sum()} frames to draw, want 3 or more")
    return rollout.times[good], rows[good]


def state_positions(rollout: Rollout, trial: int, times: Array) -> Array:
    """Positions (N, d) of the states nearest to these times."""
    return rollout.places(trial)[np.abs(rollout.times - times[:, None]).argmin(axis=1)]


def frame_positions(recorded: RecordedTrial, times: Array) -> Array:
    """Positions (N, d) of the robot's body from the frames, which are denser than the states."""
    rollout, balls = recorded.rollout, tracked_balls(recorded.rollout)
    places = [place_of(data, recorded.robot, balls).copy() for data in posed(recorded.model, recorded.frames)]
    return interpolated(rollout.of_world(places), recorded.frame_times, times)


def check_plan(rollout: Rollout, solution: Solution | None) -> Criterion:
    """Whether the plan is the solution's; not checked if another policy was run."""
    if solution is None:
        return Criterion("plan", None, "not checked without the solution")
    run, plan = rollout.plan, solution.trajectory
    if not (np.array_equal(run.states, plan.states) and np.array_equal(run.controls, plan.controls)):
        return Criterion("plan", False, "not that of the solution")
    if not ran_policy_of(solution, rollout):
        unknown = "whether the controller followed it is unknown, for it was not the solution's policy"
        return Criterion("plan", None, f"that of the solution; {unknown}")
    return Criterion("plan", True, "that of the solution, whose policy was run")


def ran_policy_of(solution: Solution, rollout: Rollout) -> bool:
    """Whether the solution's policy was run, with or without its gains."""
    policies = [plan.policy for plan in (solution, solution.open_loop())]
    if rollout.policy_digest in [policy.digest for policy in policies]:
        return True
    # Hashes of earlier rollouts leave out limits and what wraps; the rollout itself has these.
    rules = [space.rules for space in spaces_of(rollout)]
    return any(
        rules == [space.rules for space in spaces_of(policy)]
        and rollout.policy_digest == sha256(policy.gain, policy.offset, policy.nominal, np.float64(policy.dt))[:16]
        for policy in policies
    )


SIZE = (640, 480)
# Pixels: what is thinner is thin, and drawn finer, up to FINEST times, until it is FILLED. Along a rod that is THINNEST
# every column or row of pixels has one of its own; along a thinner one some have none, and its ends can be missing.
THIN, FILLED, THINNEST, FINEST = 16.0, 2.0, 1.0, 4
ROUND = 1e-3  # relative difference of the widths of a silhouette that counts as a circle
DRAWN_BOUND = 1 / 60  # largest error, in radii of the robot: 5 and 2.8 mm for the packaged robots
# Orthographic silhouettes of these geoms are symmetric about their centre in any orientation.
SYMMETRIC_KINDS = Geom.mjGEOM_SPHERE, Geom.mjGEOM_CAPSULE, Geom.mjGEOM_ELLIPSOID, Geom.mjGEOM_CYLINDER, Geom.mjGEOM_BOX


@checked
def verify_run(
    rollout: Rollout, trial: Index = 0, *, solution: Solution | None = None, progress: Progress | None = None
) -> Verification:
    """Draw the frames of a rollout, read positions from the pixels, and compare them with its states.

    Each control period is drawn from above if the robot moves on a floor, from the side if it moves in a vertical
    plane, and from both if it moves in space. The pictures are segmentations that show only one geom of the robot, like
    X-rays, in which obstacles hide nothing, and all of it is in each picture. For a robot without a position, the
    position of its last ball is read, or of its outermost geom if it has no balls.
    """
    recorded = recorded_trial(rollout, trial)
    model, body, place = recorded.model, recorded.robot, None
    if (balls := tracked_balls(rollout)) is not None:
        body, place = balls.tracked
    geom = _tracked_geom(model, body, place)
    times, rows = frames_at_states(rollout, trial)
    box = _corners(model, geom, rollout.frames[trial, rows])
    views = [calibrated(name, rollout, around=box) for name in measuring(rollout.plane)]
    measured: list[Array] = []
    offsets: list[Array] = []
    thickness, curved = _thickness(model, geom, rollout.frames[trial, rows], views)
    bound, wanted = DRAWN_BOUND * (rollout.radius or recorded.size), 1.0 if thickness >= THIN else FILLED / thickness
    pixel = max(view.height for view in views) / SIZE[1]
    # The edge of a thin geom, or a straight edge, may lie along the pixels, and be drawn half of one too far.
    coarse = thickness < THIN or not curved
    if coarse:
        wanted = max(wanted, pixel / 2 / max(bound, 1e-9))
    finer = int(np.clip(np.ceil(wanted), 1, FINEST))
    bound = max(bound, pixel / finer) if coarse else bound
    size, centre = (finer * SIZE[0], finer * SIZE[1]), mask_centre if thickness >= THIN else mask_middle
    for masks, offset in _silhouettes(recorded, geom, rollout.frames[trial, rows], views, size):
        measured.append(np.array([view.measure(centre(mask), size) for view, mask in zip(views, masks, strict=True)]))
        offsets.append(offset)
        if progress:
            progress(len(measured), len(rows))
    places, apart = triangulate(views, measured, rollout.plane)
    name = model.geom(geom).name or f"a geom of {model.body(int(model.geom_bodyid[geom])).name}"
    others = [check_plan(rollout, solution)]
    if thickness < THIN:
        detail = f"{finer * thickness:.2g} pixels where it is thinnest, want {THINNEST:g} or more"
        others.append(Criterion("thickness", finer * thickness >= THINNEST, detail))
    return compare(
        recorded,
        f"the silhouette of {name} in {size[0]} x {size[1]} pixels from {' and '.join(view.name for view in views)},"
        " all else left out (X-ray)",
        times,
        seen=places - rollout.of_world(offsets),
        actual=state_positions(rollout, trial, times),
        apart=apart,
        bound=bound,
        interval=float(rollout.frame_times[1] - rollout.frame_times[0]),
        others=tuple(others),
    )


def _tracked_geom(model: mujoco.MjModel, body: int, place: Array | None = None) -> int:
    """The geom to draw: one that has a symmetric silhouette.

    The one about `place`, the followed point on the body (3,), is the best: its picture shows nothing but that point.
    Else the largest one of the body that can collide; else of the body; else of the bodies that carry it, the nearest
    first; else of any other body of the robot.
    """
    links = list(carriers(model, body))
    nearness = {int(model.body_weldid[link]): level for level, link in reversed([*enumerate(links)])}
    ranked = list[tuple[tuple[bool, int, bool, float], int]]()
    for geom in np.flatnonzero(np.isin(model.geom_type, [kind.value for kind in SYMMETRIC_KINDS])).tolist():
        owner, welded = int(model.geom_bodyid[geom]), int(model.body_weldid[model.geom_bodyid[geom]])
        if owner != body and (welded == 0 or model.body_rootid[owner] != model.body_rootid[body]):
            continue
        followed = place is not None and owner == body and np.allclose(model.geom_pos[geom], place, rtol=0, atol=1e-9)
        collides = bool(model.geom_contype[geom] | model.geom_conaffinity[geom])
        level = 0 if owner == body else 1 + nearness.get(welded, len(links))
        ranked.append(((not followed, level, not collides, -float(model.geom_rbound[geom])), geom))
    if not ranked:
        raise InputError("rollout.model: got no geom to track, want a sphere, capsule, ellipsoid, cylinder or box")
    return min(ranked)[1]


def _corners(model: mujoco.MjModel, geom: int, frames: Array) -> Array:
    """The lowest and the highest corner (2, 3) of a box in the world that has a geom in it in all frames (N, nq)."""
    places = [data.geom_xpos[geom].copy() for data in posed(model, frames)]
    reach = float(model.geom_rbound[geom])
    return np.stack([np.min(places, axis=0) - reach, np.max(places, axis=0) + reach])


def _thickness(model: mujoco.MjModel, geom: int, frames: Array, views: Sequence[Camera]) -> tuple[float, bool]:
    """The least width of the geom's silhouette in pictures of `SIZE`, in pixels, over frames (N, nq) and views.

    Also whether its edge is curved all round: that of a disc may be straight if it is not seen along its axis.
    """
    angles, least = np.linspace(0, np.pi, 60, endpoint=False), np.inf
    kind, curved = Geom(model.geom_type[geom]), True
    across = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for data in posed(model, frames):
        for view in views:
            seen = across @ view.axes @ data.geom_xmat[geom].reshape(3, 3)  # unit vectors in the geom's axes
            reach = _reach(kind, model.geom_size[geom], seen)
            least = min(least, 2 * float(reach.min()) * SIZE[1] / view.height)
            curved &= kind == Geom.mjGEOM_ELLIPSOID or bool(reach.max() < (1 + ROUND) * reach.min())
    return least, curved


def _reach(kind: mujoco.mjtGeom, size: Array, directions: Array) -> Array:
    """How far a geom reaches from its centre along unit vectors (N, 3) in its axes, (N,) in m."""
    along = np.abs(directions)
    if kind == Geom.mjGEOM_BOX:
        return along @ size
    if kind == Geom.mjGEOM_ELLIPSOID:
        return np.linalg.norm(along * size, axis=1)
    if kind == Geom.mjGEOM_CYLINDER:
        return size[1] * along[:, 2] + size[0] * np.linalg.norm(along[:, :2], axis=1)
    return size[0] + (size[1] * along[:, 2] if kind == Geom.mjGEOM_CAPSULE else np.zeros(len(along)))


def _silhouettes(
    recorded: RecordedTrial, geom: int, frames: Array, views: Sequence[Camera], size: tuple[int, int]
) -> Iterator[tuple[list[npt.NDArray[np.bool_]], Array]]:
    """For each frame (nq,): masks (height, width) of the geom in each view, and its offset from the robot's place."""
    gl.bind()
    model, balls = recorded.model, tracked_balls(recorded.rollout)
    model.geom_group[:], model.geom_group[geom] = 1, 0
    model.vis.quality.offsamples, model.vis.quality.shadowsize = 0, 0
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    options = mujoco.MjvOption()
    options.geomgroup[:], options.sitegroup[:] = [1, 0, 0, 0, 0, 0], 0
    with mujoco.Renderer(model, size[1], size[0]) as renderer:
        for data in posed(model, frames):
            mujoco.mj_camlight(model, data)
            masks = []
            for view in views:
                renderer.update_scene(data, scene_option=options)
                view.place(renderer.scene, size[0] / size[1])
                # The renderer's own segmentation, without looking up the only geom.
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT.value] = 1
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR.value] = 1
                masks.append(renderer.render()[..., 0] > 0)
            yield masks, data.geom_xpos[geom] - place_of(data, recorded.robot, balls)


FEWEST_PIXELS = 20  # of the tracked object; with fewer, the centre is too uncertain
LEAST_SHARE = 0.5  # fraction of the mark that must be visible; the rest may be outside the picture
# Green minus the larger of red and blue: a pixel below EMPTY does not count, a pixel above FULL counts fully. Video
# blurs the edge of the mark, and mixes the colours of overlays into its surroundings.
EMPTY, FULL = 0.2, 0.9


def mask_centre(mask: npt.NDArray[np.bool_]) -> Array:
    """The mean pixel (2,) of a mask (height, width), column and row; NaN if it has too few pixels."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()]) + 0.5 if len(rows) >= FEWEST_PIXELS else np.full(2, np.nan)


def mask_middle(mask: npt.NDArray[np.bool_]) -> Array:
    """The middle pixel (2,) of a mask of a shape that is symmetric about it, column and row; NaN if it is empty.

    It fits the middles between the outermost pixels in several directions. A rod that is few pixels thick is one pixel
    thicker in parts, which moves the mean along the rod, but not its ends.
    """
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return np.full(2, np.nan)
    angles = np.linspace(0, np.pi, 16, endpoint=False)
    across = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    places = across @ np.stack([columns, rows])
    # The directions are evenly spread: the sum of their squares is 8 times the identity.
    return across.T @ (places.min(axis=1) + places.max(axis=1)) / 16 + 0.5


def marker_centre(image: npt.NDArray[np.uint8], radius: float) -> Array:
    """The centre (2,), column and row, of the green mark of this radius in pixels; NaN if it is hidden."""
    red, green, blue = np.moveaxis(image.astype(np.int16), 2, 0)
    greenness = ((green - np.maximum(red, blue)) / 255 - EMPTY) / (FULL - EMPTY)
    rows, columns = np.nonzero(greenness > 0.5)
    if not len(rows):
        return np.full(2, np.nan)
    # The median ignores stray pixels; then the mean is taken within the rim of the mark.
    centre, reach = np.array([np.median(columns), np.median(rows)]) + 0.5, 0.9 * RIM * radius + 1
    area = 0.0
    for _ in range(3):
        (left, up), (right, down) = np.maximum(centre - reach, 0).astype(int), (centre + reach + 1).astype(int)
        part = np.clip(greenness[up:down, left:right], 0, 1)
        x, y = np.arange(left, left + part.shape[1]) + 0.5, np.arange(up, up + part.shape[0]) + 0.5
        weights = part * ((x - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2 <= reach**2)
        area = weights.sum()
        if area < LEAST_SHARE * np.pi * radius**2:
            return np.full(2, np.nan)
        centre = np.array([weights.sum(axis=0) @ x, weights.sum(axis=1) @ y]) / area
    return centre


def triangulate(views: Sequence[Camera], measured: npt.ArrayLike, plane: str) -> tuple[Array, Array]:
    """Positions (N, d) along these axes that best fit measurements (N, views, 2), and the views' disagreement, (N,)."""
    size, columns = len(plane), ["xyz".index(axis) for axis in plane]
    axes = np.vstack([view.axes for view in views])[:, columns] if views else np.zeros((0, size))
    if np.linalg.matrix_rank(axes) < size:
        names = " and ".join(view.name for view in views) or "none"
        raise InputError(f"views: got {names}, want {' and '.join(measuring(plane))} to measure positions")
    values = np.asarray(measured, dtype=np.float64).reshape(-1, len(axes))
    seen = np.linalg.norm(axes, axis=1) > 1e-6  # leaves out directions across the plane
    axes, values = axes[seen], values[:, seen]
    positions = values @ np.linalg.pinv(axes).T
    # Two views that differ by d in a direction each have a residual of d / 2.
    return positions, np.sqrt(2) * np.linalg.norm(values - positions @ axes.T, axis=1)


VIDEO_BOUND = 1 / 35  # largest error, in radii of the robot: 8.6 and 4.9 mm for the packaged robots
RECORD_BOUND = 1 / 350  # largest distance between frames and states, in radii of the robot


def run_beside(path: str | os.PathLike[str]) -> Path:
    """The file, in the folder of a video, of the rollout that it shows. Raises InputError if there is none."""
    metadata, folder = read_metadata(path), Path(path).parent
    for file in sorted(folder.glob("*.npz")):
        with contextlib.suppress(InputError):  # the file is a solution, or damaged
            if digest(save_load.load(file, Rollout)) in metadata.runs:
                return file
    raise InputError(f"run: no file in {folder} has the run that {Path(path).name} shows, want its file, --run RUN.npz")


@checked
def verify_video(
    path: str | os.PathLike[str],
    rollout: Rollout,
    *,
    trial: Index | None = None,
    solution: Solution | None = None,
    progress: Progress | None = None,
) -> Verification:
    """Reads positions from a video's pixels, by the mark in its calibrated panes, and compares them with a rollout.

    Args:
      path: a video by `lqrsim render`, whatever else it shows. It needs the camera `top`; for a robot in a vertical
        plane the camera `side`; for a robot that moves in space both.
      trial: row of the rollout; by default the first that the video shows.
    """
    metadata, plane = read_metadata(path), rollout.plane
    name = digest(rollout)
    runs = [run for run, shown in enumerate(metadata.runs) if shown == name]  # it may be shown several times
    panes = [pane for pane in metadata.panes if pane.run in (runs or [0]) and pane.camera is not None]
    trial = (panes[0].trial if panes and panes[0].trial < rollout.trials else 0) if trial is None else trial
    panes = [pane for pane in panes if pane.trial == trial] if runs else panes
    panes = [pane for pane in panes if pane.run == panes[0].run]
    views = [pane.camera for pane in panes if pane.camera is not None]
    triangulate(views, np.zeros((0, len(views), 2)), plane)  # reports missing views before the slow part
    recorded, radius = recorded_trial(rollout, trial), metadata.markers[panes[0].run]
    measured: list[list[Array]] = []
    off = 0.0  # s, largest difference between the actual and the intended time of a frame
    for time, image in _decoded(path):
        off = max(off, abs(time - len(measured) / float(metadata.rate)))
        measured.append([_measure_marker(image, pane, view, radius) for pane, view in zip(panes, views, strict=True)])
        if progress:
            progress(len(measured), metadata.frames)
    count = min(len(measured), metadata.frames)
    times = metadata.times()[:count]
    seen, apart = triangulate(views, measured[:count], plane)
    areas = [np.pi * (radius * pane.height / view.height) ** 2 for pane, view in zip(panes, views, strict=True)]
    drawn_times, _ = frames_at_states(rollout, trial)
    differences = frame_positions(recorded, drawn_times) - state_positions(rollout, trial, drawn_times)
    robot = rollout.radius or recorded.size
    worst, most = np.linalg.norm(differences, axis=1).max(), RECORD_BOUND * robot
    shows = f"the video shows {', '.join(metadata.runs)}, this run is {name}"
    timed = len(measured) == metadata.frames and off < 1 / float(metadata.rate) / 4
    counted = f"got {len(measured)}, want the {metadata.frames} that were written"
    marked = f"{min(areas):.0f} pixels in the pane where it is smallest, want {FEWEST_PIXELS} or more"
    detail = f"frames and states at most {1e3 * worst:.2f} mm apart, want {1e3 * most:.2f} at most"
    others = (
        Criterion("run", name in metadata.runs, shows),
        Criterion("frames", timed, f"{counted}; at most {1e3 * off:.1f} ms from their times"),
        Criterion("mark", min(areas) >= FEWEST_PIXELS, marked),
        Criterion("record", bool(worst <= most), detail),
        check_plan(rollout, solution),
    )
    named = " and ".join(f"{view.name} ({pane.width} x {pane.height})" for pane, view in zip(panes, views, strict=True))
    return compare(
        recorded,
        f"the green mark in its panes {named}",
        times,
        seen=seen,
        actual=frame_positions(recorded, times),
        apart=apart,
        bound=VIDEO_BOUND * robot,
        interval=metadata.speed * (1 / float(metadata.rate)),
        others=others,
        video=f"{Path(path).name}, ",
    )


def _decoded(path: str | os.PathLike[str]) -> Iterator[tuple[float, npt.NDArray[np.uint8]]]:
    """Each frame (height, width, 3), and the time at which a player shows it, in seconds."""
    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                yield frame.time or 0.0, np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)
    except (FFmpegError, OSError, IndexError) as error:
        raise InputError(f"video: got {path}, want one that can be read ({error})") from None


def _measure_marker(image: npt.NDArray[np.uint8], pane: Pane, view: Camera, radius: float) -> Array:
    """The measurement (2,) of the mark of this radius in metres, in one view."""
    part = image[pane.top : pane.top + pane.height, pane.left : pane.left + pane.width]
    if part.shape[:2] != (pane.height, pane.width):
        raise InputError(f"video: got frames of {image.shape[1]} x {image.shape[0]}, want the size that lqrsim wrote")
    return view.measure(marker_centre(part, radius * pane.height / view.height), (pane.width, pane.height))


def compare(
    recorded: RecordedTrial,
    method: str,
    times: Array,
    *,
    seen: Array,
    actual: Array,
    apart: Array,
    bound: float,
    interval: float,
    others: tuple[Criterion, ...],
    video: str = "",
) -> Verification:
    """Compare positions (N, d) from pixels with the actual ones; `apart` (N,) is the views' disagreement in metres.

    The shift must be less than a quarter of `interval`, the seconds between two frames.
    """
    good = np.asarray(np.isfinite(seen).all(axis=1))
    detail = f"in {good.sum()} of {len(good)} frames, want {100 * (1 - HIDDEN_FRACTION):.0f} % of them"
    tests = [*others, Criterion("seen", bool(good.mean() >= 1 - HIDDEN_FRACTION) and int(good.sum()) > 2, detail)]
    rms, worst, shift, scale, likely = np.nan, np.nan, np.nan, np.nan, "the robot is not in the pictures, or too small"
    if good.sum() > 2:
        error, velocity = (seen - actual)[good], np.gradient(actual, times, axis=0)[good]
        distance = np.linalg.norm(error, axis=1)
        (shift, shift_error), (stretch, stretch_error) = _fit(error, velocity, actual[good])
        # A robot that hardly moves determines neither shift nor scale; the bound is then the uncertainty of the fit.
        late, wide = max(interval / 4, 4 * shift_error), max(SCALE_ERROR, 4 * stretch_error)
        rms, worst, scale, when = _rms(distance), float(distance.max()), 1 + stretch, times[good][distance.argmax()]
        detail = f"at worst {1e3 * worst:.1f} mm off, at {when:.2f} s, want {1e3 * bound:.1f} at most"
        tests.append(Criterion("position", worst <= bound, detail))
        if (most := float(apart[good].max())) > 0:  # a single view cannot disagree
            detail = f"at worst {1e3 * most:.1f} mm apart, want {1e3 * bound:.1f} at most"
            tests.append(Criterion("views agree", most <= bound, detail))
        detail = f"{1e3 * shift:+.1f} ms ahead, want {1e3 * late:.1f} at most either way"
        tests.append(Criterion("time", abs(shift) <= late, detail))
        tests.append(Criterion("scale", abs(stretch) <= wide, f"{scale:.4f}, want 1 within {wide:.4f}"))
        likely = _likely_cause(tests, times, seen, actual, bound, interval)
    run = recorded.rollout
    subject = f"{video}{run.robot} in {run.scene}, seed {run.seed}, trial {run.first_trial + recorded.trial}"
    planned = interpolated(run.planned_places, run.times, times)
    return Verification(subject, method, times, seen, actual, planned, rms, worst, shift, scale, tuple(tests), likely)


def _likely_cause(
    tests: Sequence[Criterion], times: Array, seen: Array, actual: Array, bound: float, interval: float
) -> str:
    """The likely cause of a failure, as a line; empty if no test failed."""
    failed = {test.name for test in tests if test.passed is False}
    if "thickness" in failed:
        return "the geom is too thin to be seen: give its body a thicker one that can collide, or plan a shorter way"
    if "mark" in failed:
        return "the panes are too small: render the video larger, or with fewer of them"
    if failed & {"position", "time", "scale", "views agree"}:
        return diagnose(np.flatnonzero(np.isfinite(seen).all(axis=1)), times, seen, actual, bound, interval)
    causes = {
        "run": "the video is of another run, or the file of this run has changed",
        "plan": "the plan in this file is not the one that the policy followed",
        "frames": "frames were cut from the video or added to it, or its speed was changed",
        "record": "frames and states in the file are not of the same run",
        "seen": "something covers the robot, or it leaves the picture",
    }
    return "; ".join(cause for name, cause in causes.items() if name in failed)


def _fit(error: Array, velocity: Array, actual: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """The shift in seconds and the stretch that fit the errors (k, d), each with its standard error.

    error = offset + shift * velocity + stretch * (actual - mean of actual), by least squares with a free offset.
    """
    columns = np.stack([(part - part.mean(axis=0)).ravel() for part in (velocity, actual)], axis=1)
    inverse, centred = np.linalg.pinv(columns), (error - error.mean(axis=0)).ravel()
    fit = inverse @ centred
    noise = float(np.linalg.norm(centred - columns @ fit)) / max(np.sqrt(len(centred) - 4), 1)
    uncertain = noise * np.linalg.norm(inverse, axis=1)
    return (float(fit[0]), float(uncertain[0])), (float(fit[1]), float(uncertain[1]))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else np.nan


def diagnose(
    numbers: npt.NDArray[np.intp], times: Array, seen: Array, actual: Array, bound: float, interval: float
) -> str:
    """The explanation, as a line, that leaves nearly all positions in frames `numbers` (k,) within twice the bound."""
    where, truth, velocity = seen[numbers], actual[numbers], np.gradient(actual, times, axis=0)[numbers]
    error = where - truth
    wrong = np.flatnonzero(np.linalg.norm(error, axis=1) > bound)
    if 0 < len(wrong) <= FEW_FRAMES:
        named, crossed = numbers[wrong].astype(str), where[wrong] - truth[wrong[::-1]]
        if len(wrong) == 2 and np.linalg.norm(crossed, axis=1).max() <= 2 * bound:
            return f"frames {' and '.join(named)} are swapped"
        return f"frames that do not show their time: {', '.join(named)}"
    for axis, name in zip(range(truth.shape[1]), "xyz", strict=False):
        # If a coordinate is mirrored in one of the two views that show it, it seems to stand still.
        spread = truth[:, axis] - truth[:, axis].mean()
        slope = spread @ (where[:, axis] - where[:, axis].mean()) / max(spread @ spread, 1e-12)
        if slope < 0.25 and spread.std() > 5 * bound:
            return f"{name} is mirrored"
    offset = error.mean(axis=0)
    late = float((error * velocity).sum() / max((velocity**2).sum(), 1e-12))
    split, jump = _change_point(error, velocity)
    candidates: list[tuple[Array, str]] = []
    if np.linalg.norm(offset) > bound / 2:
        moved = np.round(1e3 * offset).astype(int).tolist()
        candidates.append((error - offset, f"a camera is off: it moves the robot by {moved} mm"))
    if abs(late) > interval / 4:
        expected = interpolated(actual, times, times[numbers] + late)
        candidates.append((where - expected, f"pictures show the run {_in_frames(late, interval)}"))
    if abs(jump) > interval / 4 and split > FEW_FRAMES:  # otherwise the whole video is late or early
        expected = interpolated(actual, times, times[numbers] + jump * (np.arange(len(numbers)) >= split))
        fault = "left out" if jump > 0 else "shown twice"
        text = f"frames are {fault} at frame {numbers[split]}: from there on, the run is {_in_frames(jump, interval)}"
        candidates.append((where - expected, text))
    if candidates:
        residual, text = min(candidates, key=lambda candidate: _quantile_95(candidate[0]))
        if _quantile_95(residual) <= 2 * bound:
            return text
    if _quantile_95(error) <= 2 * bound:
        return "the pictures are too small or too coarse"
    return "pictures of another run than the record's: another seed, trial or policy; or another robot's body"


def _change_point(error: Array, velocity: Array) -> tuple[int, float]:
    """The first frame whose error is velocity times a delay, and the delay; earlier frames have no errors."""
    products, squares = (error * velocity).sum(axis=1), (velocity**2).sum(axis=1)
    tails = [np.cumsum(part[::-1])[::-1] for part in (products, squares)]
    gained = tails[0] ** 2 / np.maximum(tails[1], 1e-12)  # reduction of the sum of squares by a break there
    split = int(gained.argmax())
    return split, float(tails[0][split] / max(tails[1][split], 1e-12))


def _in_frames(seconds: float, interval: float) -> str:
    return f"{abs(seconds) / interval:.1f} frames {'early' if seconds > 0 else 'late'}"


def _quantile_95(vectors: Array) -> float:
    return float(np.quantile(np.linalg.norm(vectors, axis=1), 0.95))
