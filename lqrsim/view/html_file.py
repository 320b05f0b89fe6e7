"""Trials as one HTML file that any browser plays, without a network: scene, robot, plan, path, tubes and a time line.

The page is `html_file.html`, which draws with WebGL 2 and loads nothing. Its data are JSON, and the arrays whose places
the JSON has.
"""

import gzip
import html
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
from lqrsim.results.archive import replacing
from lqrsim.results.funnel import Funnel
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenes.mjcf_kinematics import quaternion_of
from lqrsim.view.cameras import camera_view
from lqrsim.view.options import OVERLAYS
from lqrsim.view.overlays import (
    Arrow,
    Dots,
    DrawnTube,
    Line,
    MovingBody,
    Overlays,
    Shown,
    check_drawn,
    common_scale,
    error_colours,
    legend_entries,
)
from lqrsim.view.recorded_trial import DrawnGeom, RecordedTrial, drawn_geoms, in_bytes, rows_of

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
    rows, arrays = _rows(rollout, trial), _Arrays()
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
    page = packaged("lqrsim.view").joinpath("html_file.html").read_text(encoding="utf-8")
    page = page.replace("{{data}}", arrays.text(described)).replace("{{title}}", html.escape(described["title"]))
    with replacing(path) as unfinished:
        unfinished.write_text(page, encoding="utf-8")
    return path


def _rows(rollout: Rollout, trial: int | Sequence[int] | None) -> list[Any]:
    if trial is None:
        states, frames = (np.any(np.isfinite(part).all(axis=2), axis=1) for part in (rollout.states, rollout.frames))
        rows = np.flatnonzero(states & frames).tolist()
        if not rows:
            raise InputError("rollout: got no trial with a finite state, want one that can be drawn")
        return rows
    return rows_of(trial, rollout.trials)


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
        "poses": arrays.rounded(_without_jumps(np.array(poses))),
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


def _without_jumps(poses: Array) -> Array:
    """Positions and quaternions (k, bodies, 7) with each quaternion on the side of the one before."""
    turns = poses[:, :, 3:]
    signs = np.where(np.sum(turns[1:] * turns[:-1], axis=2) < 0, -1.0, 1.0)
    turns[1:] *= np.cumprod(signs, axis=0)[:, :, None]
    return poses
