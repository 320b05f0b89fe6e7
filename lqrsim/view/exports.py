"""Trials for programs other than MuJoCo's: a page that any browser plays, and a recording for Rerun's viewer.

The page is `page.html`, which draws with WebGL 2 and loads nothing. Its data are JSON, and the arrays whose places the
JSON has. Rerun is the package `rerun-sdk`, in the extra `rerun`.
"""

import gzip
import html
import importlib
import json
import math
import os
from base64 import b64encode
from collections.abc import Sequence
from importlib.resources import files as packaged
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.annotations import checked
from lqrsim.errors import Array, InputError, check_path
from lqrsim.results.archive import replacing, sha256
from lqrsim.results.certified import Funnel
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenes.mjcf_kinematics import quaternion_of
from lqrsim.view.cameras import camera_view
from lqrsim.view.options import OVERLAYS, Overlay
from lqrsim.view.overlays import (
    Arrow,
    Dots,
    Drawable,
    DrawnTube,
    Ellipsoids,
    Line,
    MovingBody,
    Overlays,
    Shown,
    check_drawn,
    colour_of,
    common_scale,
    error_colours,
    legend_entries,
)
from lqrsim.view.recorded_trial import DrawnGeom, RecordedTrial, Triangles, drawn_geoms, in_bytes, rows_of

ASPECTS = 1.6, 0.6  # of a screen and of a telephone; the page begins with the overview for the nearer one
LEVELS = np.iinfo(np.uint16).max
SHADES = 9  # colours of the legend's map of errors, between which the browser interpolates


@checked
def render_html(
    rollout: Rollout,
    path: str | os.PathLike[str],
    *,
    trial: int | Sequence[int] | None = None,
    overlays: Shown = OVERLAYS,
    solution: Solution | None = None,
    funnel: Funnel | None = None,
) -> Path:
    """Write a run as one HTML file, which any browser of 2023 or newer plays without a network; returns its path.

    The page shows the scene from all sides, the robot, and the overlays of `render`; it has a time line, and a list of
    the trials with their outcomes. The file has 16 bits for the range of each coordinate, so that places in a run
    across 6 m are exact to 0.05 mm. The same run gives the same bytes.

    Args:
      trial: row of the rollout, or several rows; by default all trials that have a finite state.
      overlays: as in `render`, except that there is always a caption.
    """
    path = check_path("path", path, suffixes=(".html",))
    check_drawn(overlays, solution=solution, funnel=funnel)
    if trial is None:
        states, frames = (np.any(np.isfinite(part).all(axis=2), axis=1) for part in (rollout.states, rollout.frames))
        rows = np.flatnonzero(states & frames).tolist()
        if not rows:
            raise InputError("rollout: got no trial with a finite state, want one that can be drawn")
    else:
        rows = rows_of(trial, rollout.trials)
    arrays = _Arrays()
    scale = common_scale(RecordedTrial(rollout, row) for row in rows)

    def overlays_of(row: int) -> Overlays:  # one at a time, as each has a model of its own, which may be large
        return Overlays(RecordedTrial(rollout, row), overlays, scale, solution=solution, funnel=funnel)

    first = overlays_of(rows[0])
    geoms = drawn_geoms(first.recorded.model)
    described = {
        **_of_run(arrays, first),
        "legend": list(legend_entries([first]).items()),
        "geoms": [_of_geom(arrays, geom) for geom in geoms],
        "trials": [_of_trial(arrays, overlays_of(row), geoms) for row in rows],
    }
    page = packaged("lqrsim.view").joinpath("page.html").read_text(encoding="utf-8")
    page = page.replace("{{data}}", arrays.text(described)).replace("{{title}}", html.escape(described["title"]))
    with replacing(path) as unfinished:
        unfinished.write_text(page, encoding="utf-8")
    return path


class _Arrays:
    """The arrays of a page, one after the other."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def exact(self, values: npt.ArrayLike, kind: str) -> dict[str, Any]:
        """Append an array as this kind of numbers: float32, uint8, uint16 or uint32. Returns its place."""
        array = np.asarray(values).astype(np.dtype(kind).newbyteorder("<"))
        place = {"at": self._size, "kind": kind, "shape": array.shape}
        self._parts.append(array.tobytes() + bytes(-array.nbytes % 4))  # browsers want numbers aligned
        self._size += len(self._parts[-1])
        return place

    def rounded(self, values: Array) -> dict[str, Any]:
        """Append a table (k, c) in 16 bits of the range of each column.

        The differences of rows are stored, column by column, which compress best.
        """
        table = values.reshape(len(values), math.prod(values.shape[1:]))
        low, high = table.min(axis=0, initial=np.inf), table.max(axis=0, initial=-np.inf)
        low, step = (low, (high - low) / LEVELS) if len(table) else (np.zeros(len(low)), np.zeros(len(low)))
        levels = np.round((table - low) / np.where(step > 0, step, 1)).astype(np.uint16)
        changes = np.diff(levels, axis=0, prepend=np.zeros_like(levels[:1]))  # modulo 2^16, as their sums are
        return self.exact(changes.T, "uint16") | {"shape": table.shape, "low": low.tolist(), "step": step.tolist()}

    def text(self, described: dict[str, Any]) -> str:
        """The length of the JSON as a number of 32 bits, the JSON, and the arrays; compressed, in base64."""
        words = json.dumps(described, separators=(",", ":"), allow_nan=False).encode("ascii")
        words += b" " * (-len(words) % 4)
        content = b"".join([len(words).to_bytes(4, "little"), words, *self._parts])
        return b64encode(gzip.compress(content, mtime=0)).decode("ascii")


def _of_run(arrays: _Arrays, overlays: Overlays) -> dict[str, Any]:
    recorded = overlays.recorded
    run = recorded.rollout
    page: dict[str, Any] = {
        "title": recorded.name,
        "about": "; ".join(run.disturbances) or "undisturbed",
        "end": recorded.end,
        "step": run.plan.dt,
        "extent": float(recorded.model.stat.extent),
        "middle": np.mean(recorded.planned(run.times), axis=0).tolist(),
        "views": [_view(recorded, aspect) for aspect in ASPECTS],
        "errors": in_bytes(error_colours(np.linspace(0, 1, SHADES))[:, :3]),
        "tubes": [],
        "bodies": [],
    }
    for part in overlays.drawables:
        match part:
            case Line(name="plan"):
                page["plan"] = _of_line(arrays, part)
            case Arrow():
                page["arrow"] = {"size": [part.gap, part.width, part.metres_per_newton], "colour": part.rgba}
            case DrawnTube():
                tube = {
                    "colour": part.rgba,
                    "places": arrays.rounded(part.centres),
                    "sizes": arrays.exact(part.half_axes, "float32"),
                    "turns": arrays.exact([quaternion_of(rotation) for rotation in part.rotations], "float32"),
                }
                page["tubes"].append(tube)
            case MovingBody():
                shape = {"kind": part.kind, "colour": part.rgba, "size": part.size.tolist()}
                motion = {"turn": quaternion_of(part.rotation).tolist(), "places": arrays.rounded(part.at(run.times))}
                page["bodies"].append(shape | motion)
    return page


def _of_line(arrays: _Arrays, line: Line) -> dict[str, Any]:
    described: dict[str, Any] = {"points": arrays.rounded(line.points), "width": 2 * line.profile[0]}
    if line.times is not None and line.colours is not None:
        colours = arrays.exact(in_bytes(line.colours[:, :3]), "uint8")
        return described | {"times": arrays.exact(line.times, "float32"), "colours": colours}
    return described | {"colour": in_bytes(line.rgba[:3])}


def _of_geom(arrays: _Arrays, geom: DrawnGeom) -> dict[str, Any]:
    shape = {"kind": geom.kind, "size": geom.size.tolist(), "colour": geom.colour.tolist(), "moves": geom.moves}
    if geom.triangles is None:
        return shape
    vertices, faces = geom.triangles
    return shape | {"vertices": arrays.rounded(vertices), "faces": arrays.exact(faces, "uint32")}


def _of_trial(arrays: _Arrays, overlays: Overlays, geoms: Sequence[DrawnGeom]) -> dict[str, Any]:
    """A trial: bodies and lines over time, and geoms in their bodies, or in the world if they do not move."""
    recorded, row, model = overlays.recorded, overlays.recorded.trial, overlays.recorded.model
    run, data = recorded.rollout, mujoco.MjData(model)
    moving = [int(model.geom_bodyid[geom.number]) for geom in geoms if geom.moves]
    bodies, poses = np.unique(moving).astype(int), []
    for time in recorded.frame_times:
        recorded.pose(data, float(time))
        poses.append(np.hstack([data.xpos[bodies], data.xquat[bodies]]))
    table = np.array(poses)
    turns = table[:, :, 3:]  # each quaternion on the side of the one before
    signs = np.where(np.sum(turns[1:] * turns[:-1], axis=2) < 0, -1.0, 1.0)
    turns[1:] *= np.cumprod(signs, axis=0)[:, :, None]
    places = [
        [*model.geom_pos[geom.number], *model.geom_quat[geom.number]]
        if geom.moves
        else [*data.geom_xpos[geom.number], *quaternion_of(data.geom_xmat[geom.number])]
        for geom in geoms
    ]
    ending = recorded.ending(np.inf)
    outcome = f"{ending} at {run.ended[row]:.1f} s" if ending else run.outcome[row]
    trial: dict[str, Any] = {
        "name": f"trial {run.first_trial + row}: {outcome}".replace("_", " "),
        "outcome": run.outcome[row],
        "ended": float(run.ended[row]) if ending else None,
        "readings": [" · ".join(overlays.readings(float(time))) for time in run.times],
        "robot": arrays.rounded(recorded.driven(run.times)),
        "times": arrays.exact(recorded.frame_times, "float32"),
        "poses": arrays.rounded(table),
        "places": arrays.exact(places, "float32"),
        "bodies": [int(np.searchsorted(bodies, model.geom_bodyid[geom.number])) for geom in geoms],
    }
    for part in overlays.drawables:
        match part:
            case Line(name="trace"):
                trial["trace"] = _of_line(arrays, part)
            case Arrow():
                trial["forces"] = arrays.rounded(part.forces)
            case Dots():
                trial["measured"] = {
                    "times": arrays.exact(part.times, "float32"),
                    "points": arrays.rounded(part.points),
                    "colour": in_bytes(part.rgba[:3]),
                    "width": 2 * part.half_sizes[0],
                    "seconds": part.seconds,
                }
    return trial


def _view(recorded: RecordedTrial, aspect: float) -> dict[str, Any]:
    """The overview in a picture of this aspect ratio, with the vertical field of view in radians."""
    scene = mujoco.MjvScene(recorded.model, maxgeom=1)
    camera_view("overview", recorded, aspect).place(scene, mujoco.MjData(recorded.model), 0.0)
    camera = scene.camera[0]
    vectors = {"eye": camera.pos, "forward": camera.forward, "up": camera.up}
    field = 2 * float(np.arctan2(camera.frustum_top, camera.frustum_near))
    return {"aspect": aspect, "field": field} | {name: vector.tolist() for name, vector in vectors.items()}


TIMELINE = "time"
GHOST_OPACITY = 0.6  # of a ball without shading
FLAT = 1e-4  # m, half thickness of flat shapes
# The tube is shown at its time, as wide as it is, and texts are the numbers.
RERUN_OVERLAYS: tuple[Overlay, ...] = ("plan", "trace", "ghost", "measured", "forces")
ENTITIES = {
    "trace": ["path"], "ghost": ["planned"], "forces": ["force"],
    "funnel": ["funnel", "certified"], "interpolated": ["funnel", "interpolated"],
}  # fmt: skip


def write_rerun(
    rollout: Rollout, path: str | os.PathLike[str], *, trial: int = 0, funnel: Funnel | None = None
) -> None:
    """Write a trial as FILE.rrd, with a funnel about its plan. Raises InputError if the package is missing."""
    path = check_path("path", path, "the path of a file")
    try:
        rerun = importlib.import_module("rerun")
    except ImportError as error:
        wanted = "the package rerun-sdk: pip install 'lqrsim[rerun]'"
        raise InputError(f"path: got {path.name}, want for it {wanted} ({error})") from None
    recorded = RecordedTrial(rollout, trial)
    shown = RERUN_OVERLAYS if funnel is None else (*RERUN_OVERLAYS, "funnel")
    overlays = Overlays(recorded, shown, common_scale([recorded]), funnel=funnel, segments=rollout.plan.steps)
    with replacing(path) as unfinished:
        stream = rerun.RecordingStream("lqrsim", recording_id=sha256(rollout.states[trial].tobytes())[:32])
        stream.save(unfinished)
        stream.send_recording_name(f"{rollout.robot} in {rollout.scene}, trial {rollout.first_trial + trial}")
        recording = _Recording(rerun, stream, recorded)
        recording.draw_model()
        for drawable in overlays.drawables:
            recording.draw(drawable)
        recording.draw_tube()
        recording.draw_numbers()
        stream.disconnect()


class _Recording:
    def __init__(self, rerun: Any, stream: Any, recorded: RecordedTrial) -> None:
        self.rerun, self.stream, self.recorded = rerun, stream, recorded

    def draw_model(self) -> None:
        """Draw the geoms of the model: fixed ones once, moving ones at each recorded frame."""
        recorded, data = self.recorded, mujoco.MjData(self.recorded.model)
        places, turns = [], []
        for time in recorded.frame_times:
            recorded.pose(data, float(time))
            places.append(data.geom_xpos.copy())
            turns.append([_scalar_last(matrix) for matrix in data.geom_xmat])
        for geom in drawn_geoms(recorded.model):
            i, entity = geom.number, ["world", "model", f"{geom.number} {geom.name}"]
            self._log(entity, self._shape(geom.kind, geom.size, geom.colour, geom.triangles))
            if geom.moves:
                pose = {"translation": [place[i] for place in places], "quaternion": [turn[i] for turn in turns]}
                self._send(entity, recorded.frame_times, self.rerun.Transform3D.columns(**pose))
            else:
                self._log(entity, self.rerun.Transform3D(translation=places[0][i], quaternion=turns[0][i]))

    def _shape(self, kind: str, size: Array, colour: npt.ArrayLike, triangles: Triangles | None = None) -> Any:
        rerun, colours = self.rerun, [in_bytes(colour)]
        solid = {"colors": colours, "fill_mode": "solid"}
        if kind == "plane":
            return rerun.Boxes3D(half_sizes=[[*size[:2], FLAT]], centers=[[0, 0, -FLAT]], **solid)
        if kind == "box":
            return rerun.Boxes3D(half_sizes=[size], **solid)
        if kind in ("sphere", "ellipsoid"):
            return rerun.Ellipsoids3D(half_sizes=[size if kind == "ellipsoid" else [size[0]] * 3], **solid)
        if kind == "cylinder":
            return rerun.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], **solid)
        if kind == "capsule":  # Rerun's capsule begins at its origin
            lower = [[0, 0, -size[1]]]
            return rerun.Capsules3D(lengths=[2 * size[1]], radii=[size[0]], translations=lower, **solid)
        assert triangles is not None
        vertices, faces = triangles
        return rerun.Mesh3D(vertex_positions=vertices, triangle_indices=faces, albedo_factor=colours[0])

    def draw(self, drawable: Drawable) -> None:
        """Draw an overlay: lines and a funnel as a whole, everything else at its times."""
        rerun, entity = self.rerun, ["world", *ENTITIES.get(drawable.name, [drawable.name])]
        match drawable:
            case Line():
                colour, thin = in_bytes(drawable.rgba), 0.002 * self.recorded.model.stat.extent
                self._log(entity, rerun.LineStrips3D([drawable.points], colors=[colour], radii=[thin]))
            case Dots():
                self._points(entity, drawable.times, drawable.points, drawable.rgba, drawable.half_sizes[0])
            case MovingBody(name="ghost"):
                colour = (*drawable.rgba[:3], GHOST_OPACITY)
                self._points(entity, drawable.times, drawable.places, colour, drawable.size[0])
            case MovingBody():
                self._log(entity, self._shape(drawable.kind, drawable.size, drawable.rgba))
                times = self.recorded.frame_times
                turns = [_scalar_last(drawable.rotation)] * len(times)
                self._send(entity, times, rerun.Transform3D.columns(translation=drawable.at(times), quaternion=turns))
            case DrawnTube():
                ellipsoids = self._ellipsoids(drawable.centres, drawable.half_axes, drawable.rotations)
                self._log(entity, rerun.Ellipsoids3D(**ellipsoids, colors=[in_bytes(drawable.rgba[:3])]))
            case Arrow():
                times = self.recorded.times[self.recorded.times < self.recorded.end]
                forces = np.array([self.recorded.force_at(float(time)) for time in times])
                arrows = rerun.Arrows3D.columns(
                    vectors=forces * drawable.metres_per_newton,
                    origins=self.recorded.driven(times),
                    colors=[in_bytes(drawable.rgba)] * len(times),
                )
                self._send(entity, times, arrows)

    def draw_tube(self) -> None:
        """Draw the ellipsoid of the predicted tube at each knot, however wide it is."""
        run = self.recorded.rollout
        if run.tube is not None and run.state_coordinates.position:
            axes = run.in_world(np.eye(run.tube.shape[1])) - run.in_world(np.zeros(run.tube.shape[1]))
            plan = self.recorded.planned(run.times)
            half_axes, rotations = Ellipsoids(plan, axes.T @ run.tube @ axes).axes()
            ellipsoids = self._ellipsoids(plan, np.maximum(half_axes, FLAT), rotations)
            columns = self.rerun.Ellipsoids3D.columns(**ellipsoids, colors=[in_bytes(colour_of("tube"))] * len(plan))
            self._send(["world", "tube"], run.times, columns)

    def draw_numbers(self) -> None:
        """Draw states, controls, tracking error, clearance and chance of collision over time."""
        recorded, run, trial = self.recorded, self.recorded.rollout, self.recorded.trial
        known = len(recorded.times)
        numbers = {("error", f"tracking error, {run.tracking_unit}"): recorded.error}
        if np.isfinite(recorded.clearance).all():
            numbers["clearance", "clearance, m"] = recorded.clearance
        if run.collision_chance is not None:
            numbers["chance", "chance of collision"] = run.collision_chance[:known]
        for i, label in enumerate(run.state_coordinates.labels):
            numbers["states", label] = recorded.states[:, i]
            numbers["plan", label] = run.plan.states[:known, i]
        for i, label in enumerate(run.control_coordinates.labels):
            numbers["commanded", label] = run.commanded[trial, :known, i]  # the last one ended the trial, if it ended
            numbers["applied", label] = run.applied[trial, :known, i]
        for entity, values in numbers.items():
            finite = np.isfinite(values)
            if finite.any():
                times = recorded.times[: len(values)][finite]
                self._send(["numbers", *entity], times, self.rerun.Scalars.columns(scalars=values[finite]))

    def _points(self, entity: list[str], times: Array, points: Array, colour: npt.ArrayLike, radius: float) -> None:
        colours, radii = [in_bytes(colour)] * len(points), [radius] * len(points)
        self._send(entity, times, self.rerun.Points3D.columns(positions=points, colors=colours, radii=radii))

    @staticmethod
    def _ellipsoids(centres: Array, half_axes: Array, rotations: Array) -> dict[str, Any]:
        quaternions = [_scalar_last(rotation) for rotation in rotations]
        return {"centers": centres, "half_sizes": half_axes, "quaternions": quaternions}

    def _log(self, entity: list[str], shape: Any) -> None:
        self.stream.log(entity, shape, static=True)

    def _send(self, entity: list[str], times: Array, columns: Any) -> None:
        path, index = self.rerun.new_entity_path(entity), self.rerun.TimeColumn(TIMELINE, duration=times.tolist())
        self.rerun.send_columns(path, [index], columns, recording=self.stream)


def _scalar_last(rotation: Array) -> Array:
    """The quaternion of a rotation as Rerun wants it."""
    return np.roll(quaternion_of(rotation), -1)
