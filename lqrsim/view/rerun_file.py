"""A trial as a recording for Rerun's viewer: geometry, overlays and numbers on one timeline, in seconds.

Rerun is the package `rerun-sdk`, in the extra `rerun`.
"""

import importlib
import os
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_path
from lqrsim.results.archive import replacing, sha256
from lqrsim.results.funnel import Funnel
from lqrsim.results.rollout import Rollout
from lqrsim.scenes.mjcf_kinematics import quaternion_of
from lqrsim.view.ellipsoids import Ellipsoids
from lqrsim.view.options import Overlay
from lqrsim.view.overlays import Arrow, Dots, Drawable, DrawnTube, Line, MovingBody, Overlays, colour_of, common_scale
from lqrsim.view.recorded_trial import RecordedTrial, Triangles, drawn_geoms, in_bytes

TIMELINE = "time"
GHOST_OPACITY = 0.6  # of a ball without shading
FLAT = 1e-4  # m, half thickness of flat shapes
# The tube is shown at its time, as wide as it is, and texts are the numbers.
OVERLAYS: tuple[Overlay, ...] = ("plan", "trace", "ghost", "measured", "forces")
ENTITIES = {
    "trace": ["path"], "ghost": ["planned"], "forces": ["force"],
    "funnel": ["funnel", "certified"], "interpolated": ["funnel", "interpolated"],
}  # fmt: skip


def write(rollout: Rollout, path: str | os.PathLike[str], *, trial: int = 0, funnel: Funnel | None = None) -> None:
    """Write a trial as FILE.rrd, with a funnel about its plan. Raises InputError if the package is missing."""
    path = check_path("path", path, "the path of a file")
    try:
        rerun = importlib.import_module("rerun")
    except ImportError as error:
        wanted = "the package rerun-sdk: pip install 'lqrsim[rerun]'"
        raise InputError(f"path: got {path.name}, want for it {wanted} ({error})") from None
    recorded = RecordedTrial(rollout, trial)
    shown: tuple[Overlay, ...] = OVERLAYS if funnel is None else (*OVERLAYS, "funnel")
    steps = rollout.plan.steps
    overlays = Overlays(recorded, shown, common_scale([recorded]), funnel=funnel, segments=steps)
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
                pose = rerun.Transform3D.columns(translation=drawable.at(times), quaternion=turns)
                self._send(entity, times, pose)
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
        count = len(points)
        columns = self.rerun.Points3D.columns(
            positions=points, colors=[in_bytes(colour)] * count, radii=[radius] * count
        )
        self._send(entity, times, columns)

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
