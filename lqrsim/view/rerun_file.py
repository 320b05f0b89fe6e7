"""A trial as a recording for Rerun's viewer: geometry, plan, tube and numbers on one timeline, in seconds.

Rerun is the package `rerun-sdk`, in the extra `rerun`.
"""

import importlib
import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lqrsim.errors import Array, InputError, check_path
from lqrsim.results.archive import replacing, sha256
from lqrsim.results.funnel import Funnel
from lqrsim.results.rollout import Rollout
from lqrsim.view.ellipsoids import Ellipsoids
from lqrsim.view.overlays import BETWEEN, FORCE, FUNNEL, PLAN_RGB, TUBE, DrawnFunnel, of_funnel
from lqrsim.view.recorded_trial import DrawnGeom, RecordedTrial, drawn_geoms

TIMELINE = "time"
DRIVEN = (0.0, 0.45, 0.7)
FLAT = 1e-4  # m, half thickness of flat shapes
ARROW = 0.2  # length of the largest force's arrow, relative to the extent of the scene


def write(rollout: Rollout, path: str | os.PathLike[str], *, trial: int = 0, funnel: Funnel | None = None) -> None:
    """Write a trial as FILE.rrd.

    Args:
      rollout: the result of `simulate`, with frames.
      path: path of the file.
      trial: row of the rollout.
      funnel: a funnel about the plan of the run.

    Raises:
      InputError: there is no such trial, nothing of it can be drawn, the funnel has another plan or no position, the
        file cannot be written, or the package is missing.
    """
    path = check_path("path", path, "the path of a file")
    rerun, recorded = _package(path), RecordedTrial(rollout, trial)
    drawn = None if funnel is None else of_funnel(recorded, funnel)
    with replacing(path) as unfinished:
        name = f"{rollout.robot} in {rollout.scene}, trial {rollout.first_trial + trial}"
        stream = rerun.RecordingStream("lqrsim", recording_id=sha256(rollout.states[trial].tobytes())[:32])
        stream.save(unfinished)
        stream.send_recording_name(name)
        _draw_model(rerun, stream, recorded)
        _draw_plan(rerun, stream, recorded)
        if drawn is not None:
            _draw_funnel(rerun, stream, drawn)
        _draw_numbers(rerun, stream, recorded)
        stream.disconnect()


def _package(path: Path) -> Any:
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        wanted = "the package rerun-sdk: pip install 'lqrsim[rerun]'"
        raise InputError(f"path: got {path.name}, want for it {wanted} ({error})") from None


def _draw_model(rerun: Any, stream: Any, recorded: RecordedTrial) -> None:
    """Draw the geoms of the model: fixed ones once, moving ones at each recorded frame."""
    data = mujoco.MjData(recorded.model)
    frames, places, turns = recorded.frame_times, [], []
    for time in frames:
        recorded.pose(data, float(time))
        places.append(data.geom_xpos.copy())
        turns.append(np.array([_quaternion(matrix.reshape(3, 3)) for matrix in data.geom_xmat]))
    for geom in drawn_geoms(recorded.model):
        entity = ["world", "model", f"{geom.number} {geom.name}"]
        stream.log(entity, _shape(rerun, geom), static=True)
        if geom.moves:
            moved = [place[geom.number] for place in places], [turn[geom.number] for turn in turns]
            columns = rerun.Transform3D.columns(translation=moved[0], quaternion=moved[1])
            _send(rerun, stream, entity, frames, columns)
        else:
            pose = rerun.Transform3D(translation=places[0][geom.number], quaternion=turns[0][geom.number])
            stream.log(entity, pose, static=True)


def _shape(rerun: Any, geom: DrawnGeom) -> Any:
    """Rerun's shape for a geom, in the geom's own axes."""
    size, kind, colours = geom.size, geom.kind, [_bytes(geom.colour)]
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
    assert geom.triangles is not None
    vertices, faces = geom.triangles
    return rerun.Mesh3D(vertex_positions=vertices, triangle_indices=faces, albedo_factor=colours[0])


def _draw_plan(rerun: Any, stream: Any, recorded: RecordedTrial) -> None:
    """Draw plan and path as lines; and over time the planned position, the tube and the force."""
    run = recorded.rollout
    plan, driven = recorded.planned(run.times), recorded.driven(recorded.times)
    thin = 0.002 * recorded.model.stat.extent
    for name, line, colour in (("plan", plan, PLAN_RGB), ("path", driven, DRIVEN)):
        shape = rerun.LineStrips3D([line], colors=[_bytes(np.array(colour))], radii=[thin])
        stream.log(["world", name], shape, static=True)
    count = len(plan)
    ball = rerun.Points3D.columns(
        positions=plan, colors=[_bytes(np.array([*PLAN_RGB, 0.6]))] * count, radii=[run.radius] * count
    )
    _send(rerun, stream, ["world", "planned"], run.times, ball)
    if run.tube is not None and run.state_coordinates.position:
        axes = run.in_world(np.eye(run.tube.shape[1])) - run.in_world(np.zeros(run.tube.shape[1]))
        half_axes, turns = Ellipsoids(plan, axes.T @ run.tube @ axes).axes()
        tube = rerun.Ellipsoids3D.columns(
            half_sizes=np.maximum(half_axes, FLAT),
            centers=plan,
            quaternions=[_quaternion(turn) for turn in turns],
            colors=[_bytes(np.array(TUBE))] * count,
        )
        _send(rerun, stream, ["world", "tube"], run.times, tube)
    if (largest := float(np.linalg.norm(recorded.force, axis=1).max())) > 0:
        times = recorded.times[recorded.times < run.times[-1]]
        forces = np.array([recorded.force_at(float(time)) for time in times])
        arrows = rerun.Arrows3D.columns(
            vectors=forces * ARROW * recorded.model.stat.extent / largest,
            origins=recorded.driven(times),
            colors=[_bytes(np.array(FORCE))] * len(times),
        )
        _send(rerun, stream, ["world", "force"], times, arrows)


def _draw_funnel(rerun: Any, stream: Any, funnel: DrawnFunnel) -> None:
    """Draw the certified and the interpolated ellipsoids, at all times."""
    for name, tube, colour in (("certified", funnel.certified, FUNNEL), ("interpolated", funnel.between, BETWEEN)):
        if tube is not None:
            centres, half_axes, turns = tube.in_world
            quaternions = [_quaternion(turn) for turn in turns]
            shape = rerun.Ellipsoids3D(
                half_sizes=half_axes, centers=centres, quaternions=quaternions, colors=[_bytes(np.array(colour))]
            )
            stream.log(["world", "funnel", name], shape, static=True)


def _draw_numbers(rerun: Any, stream: Any, recorded: RecordedTrial) -> None:
    """Draw states, controls, tracking error, clearance and chance of collision over time."""
    run, trial, begun = recorded.rollout, recorded.trial, len(recorded.times)
    numbers = {("error", f"tracking error, {run.tracking_unit}"): recorded.error}
    if np.isfinite(recorded.clearance).all():
        numbers["clearance", "clearance, m"] = recorded.clearance
    if run.collision_chance is not None:
        numbers["chance", "chance of collision"] = run.collision_chance[:begun]
    for which, label in enumerate(run.state_coordinates.labels):
        numbers["states", label] = recorded.states[:, which]
        numbers["plan", label] = run.plan.states[:begun, which]
    for which, label in enumerate(run.control_coordinates.labels):
        numbers["commanded", label] = run.commanded[trial, : begun - 1, which]
        numbers["applied", label] = run.applied[trial, : begun - 1, which]
    for path, values in numbers.items():
        known = np.isfinite(values)
        times = recorded.times[: len(values)][known]
        if known.any():
            _send(rerun, stream, ["numbers", *path], times, rerun.Scalars.columns(scalars=values[known]))


def _send(rerun: Any, stream: Any, entity: list[str], times: Array, columns: Any) -> None:
    path = rerun.new_entity_path(entity)
    rerun.send_columns(path, [rerun.TimeColumn(TIMELINE, duration=times.tolist())], columns, recording=stream)


def _bytes(colour: Array) -> list[int]:
    """A colour in bytes, from numbers between 0 and 1."""
    return np.round(255 * np.clip(colour, 0, 1)).astype(int).tolist()


def _quaternion(matrix: Array) -> Array:
    """The quaternion of a rotation (3, 3), scalar last, as in Rerun."""
    found = np.empty(4)
    mujoco.mju_mat2Quat(found, np.ascontiguousarray(matrix).ravel())
    return np.roll(found, -1)
