"""Videos and stills of executed runs, drawn offscreen by MuJoCo from a `Rollout` alone."""

import contextlib
import os
import textwrap
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco import mjtGeom as Geom
from PIL import Image

from lqrsim.errors import Array, InputError, check_count, check_name, check_number
from lqrsim.files import replacing
from lqrsim.rollout import Rollout
from lqrsim.view import caption, gl
from lqrsim.view.caption import Pixels
from lqrsim.view.video import encoder

PLAN = (0.78, 0.08, 0.42)  # no colour of the error map, and none of the robots
FORCE = (0.0, 0.50, 0.36)
SEGMENTS = 120  # a line on the stage is drawn with no more than this many
ROBOTS = 50  # more of them in one picture can not be told apart
LIFT = 0.006  # metres between the floor and the lines on it
FADE = 0.10  # what is left of the opacity of something that hides the robot
FADE_SECONDS = 0.25


def render(
    rollout: Rollout,
    path: str | os.PathLike[str],
    *,
    trial: int = 0,
    camera: str | None = None,
    size: tuple[int, int] = (1280, 720),
    fps: float = 30,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Writes a video (mp4, h264) of one trial, in real time; returns its path.

    It shows the plan, the trace driven so far, coloured by tracking error, and a translucent disc or ball where the
    robot should be now. What stands between the camera and the robot fades. A trial that diverged stands still from
    there on. The file is whole or not there, also after an error or Ctrl-C.

    Args:
      trial: row of the rollout.
      camera: one of the model's; by default `overview` if there is one.
      size: width and height in pixels, both even. fps: frames a second, whatever the rate of `rollout.frame_times`.
      progress: called after each frame with the number of frames done and of all frames.

    Raises:
      InputError: an argument is wrong, the file can not be written, or there is no OpenGL.
    """
    rate = Fraction(check_number("fps", fps, above=0, at_most=240)).limit_denominator(1001)
    count = int(rollout.times[-1] * rate + 1e-9) + 1
    with (
        replacing(_named(path, ".mp4")) as unfinished,
        _stage(rollout, trial, camera, size) as stage,
        encoder(unfinished, stage.size, rate) as encode,
    ):
        for number in range(count):
            encode(stage.draw(float(number / rate), fade=1.0 if number == 0 else float(1 / (FADE_SECONDS * rate))))
            if progress:
                progress(number + 1, count)
    return Path(path)


def still(
    rollout: Rollout,
    path: str | os.PathLike[str],
    *,
    time: float | None = None,
    every: float | None = None,
    trial: int = 0,
    camera: str | None = None,
    size: tuple[int, int] = (1280, 720),
) -> Path:
    """Writes a picture (png) of one moment, `time` seconds after the start (the end by default); returns its path.

    With `every`, the robot is drawn also where it was at each multiple of that many seconds, as in the paper's figures.
    The rest, and what is raised, is as in `render`.
    """
    end = float(rollout.times[-1])
    time = end if time is None else check_number("time", time, at_least=0, at_most=end)
    earlier = [] if every is None else np.arange(0, time, check_number("every", every, at_least=end / ROBOTS)).tolist()
    with replacing(_named(path, ".png")) as unfinished, _stage(rollout, trial, camera, size) as stage:
        Image.fromarray(stage.draw(time, earlier=earlier)).save(unfinished)
    return Path(path)


def _named(path: str | os.PathLike[str], suffix: str) -> Path:
    path = Path(path)
    if path.suffix.lower() != suffix:
        raise InputError(f"path: got {str(path)!r}, want a name that ends in {suffix}")
    return path


@contextlib.contextmanager
def _stage(rollout: Rollout, trial: int, camera: str | None, size: tuple[int, int]) -> Iterator["_Stage"]:
    if np.shape(size) != (2,):
        raise InputError(f"size: got {size!r}, want a width and a height in pixels")
    width, height = (check_count("size", pixels, at_least=64) for pixels in size)
    if width % 2 or height % 2:
        raise InputError(f"size: got {width} x {height}, want even numbers, which h264 needs")
    if not 0 <= check_count("trial", trial, at_least=0) < rollout.trials:
        raise InputError(f"trial: got {trial}, want one of 0 to {rollout.trials - 1}")
    if len(rollout.state_coordinates.position) not in (2, 3):
        raise InputError("state_coordinates.position: got none, want the 2 or 3 states that are the position")
    try:
        model = mujoco.MjModel.from_xml_string(rollout.model)
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(f"rollout.model: got an MJCF that MuJoCo refuses: {' '.join(str(error).split())}") from None
    if model.nq != rollout.frames.shape[-1]:
        raise InputError(f"rollout.frames: got {rollout.frames.shape[-1]} numbers each, want the model's {model.nq}")
    cameras = [name for name in (model.camera(number).name for number in range(model.ncam)) if name]
    if camera is not None:
        check_name("camera", camera, cameras)
    elif cameras:
        camera = "overview" if "overview" in cameras else cameras[0]
    gl.bind()
    # A larger buffer than the picture costs as much as a larger picture, a smaller one is refused.
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    with mujoco.Renderer(model, height, width, max_geom=1000 + (ROBOTS + 1) * model.ngeom) as renderer:
        yield _Stage(rollout, trial, renderer, camera)


class _Stage:
    """One trial, ready to be drawn at any time.

    Attributes:
      size: width and height in pixels.
    """

    def __init__(self, rollout: Rollout, trial: int, renderer: mujoco.Renderer, camera: str | None) -> None:
        self.size = renderer.width, renderer.height
        self.rollout, self.trial = rollout, trial
        self.renderer, self.model = renderer, renderer.model
        self.data, self.ghost = mujoco.MjData(self.model), mujoco.MjData(self.model)
        self.camera = -1 if camera is None else camera
        whole_frames = np.isfinite(rollout.frames[trial]).all(axis=1)
        alive = np.isfinite(rollout.states[trial]).all(axis=1)
        if not (whole_frames.any() and alive.any()):
            raise InputError(f"rollout: got trial {trial} without one finite state, want something to draw")
        self.frame_times, self.frames = rollout.frame_times[whole_frames], rollout.frames[trial][whole_frames]
        self.times, self.states = rollout.times[alive], rollout.states[trial, alive]
        self.error, self.clearance = rollout.tracking_error[trial, alive], rollout.clearance[trial, alive]
        self.force = _recent(rollout.forces[trial], rollout.plan.dt)
        self.scale = _round_up(max(float(self.error.max()), 0.01))

        # A plane is seen through from behind as it is, and from the front it hides nothing.
        solid = self.model.geom_type != Geom.mjGEOM_PLANE.value
        self.can_hide = solid & (self.model.body_weldid[self.model.geom_bodyid] == 0)
        self.robot = int(np.argmax(self.model.body_weldid != 0))  # the first body that moves
        self.faded = np.zeros(self.model.ngeom)
        self.planar = len(rollout.state_coordinates.position) == 2
        self.floor = self._floor()
        self.width = 0.0035 * self.model.stat.extent
        knots = np.unique(np.linspace(0, rollout.plan.steps, min(rollout.plan.steps, SEGMENTS) + 1).astype(int))
        self.knots = rollout.times[knots]
        self.plan = self._positions(rollout.plan.states, rollout.times, self.knots)
        self.trace = self._positions(self.states, self.times, self.knots)

    def draw(self, time: float, *, fade: float = 1.0, earlier: Iterable[float] = ()) -> Pixels:
        """The picture (height, width, 3) at `time`, with the robot also where it was earlier.

        Args:
          fade: the most by which opacities may change since the picture before.
        """
        self._pose(self.data, time)
        self.renderer.update_scene(self.data, self.camera)
        self._fade(self._in_the_way(), fade)
        for moment in earlier:
            self._pose(self.ghost, moment)
            moving, extras = mujoco.mjtCatBit.mjCAT_DYNAMIC.value, (mujoco.MjvOption(), mujoco.MjvPerturb())
            mujoco.mjv_addGeoms(self.model, self.ghost, *extras, moving, self.renderer.scene)
        self._draw_lines(time)
        image = self.renderer.render()
        self._write(image, time)
        return image

    def _pose(self, data: mujoco.MjData, time: float) -> None:
        """Puts the model where it was at `time`, between two recorded frames if need be."""
        first = int(np.clip(np.searchsorted(self.frame_times, time, side="right") - 1, 0, max(len(self.frames) - 2, 0)))
        data.qpos[:] = self.frames[first]
        if len(self.frames) > 1:
            start, end = self.frame_times[first : first + 2]
            motion = np.zeros(self.model.nv)
            mujoco.mj_differentiatePos(self.model, motion, 1.0, self.frames[first], self.frames[first + 1])
            mujoco.mj_integratePos(self.model, data.qpos, motion, float(np.clip((time - start) / (end - start), 0, 1)))
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_camlight(self.model, data)

    def _positions(self, states: Array, times: Array, at: Array | float) -> Array:
        """Where the robot is in the world, (..., 3); on the floor, if it moves in the plane."""
        columns = [np.interp(at, times, states[:, i]) for i in self.rollout.state_coordinates.position]
        return np.stack([*columns, np.full_like(columns[0], self.floor)][:3], axis=-1)

    def _floor(self) -> float:
        """The height of what the robot stands on in the first frame."""
        self._pose(self.data, 0.0)
        centre, drop = self.data.xpos[self.robot], np.array([0.0, 0.0, -1.0])
        hit = mujoco.mj_ray(self.model, self.data, centre, drop, None, True, self.robot, np.zeros(1, np.int32))
        return float(centre[2] - max(hit, 0.0))

    def _in_the_way(self) -> npt.NDArray[np.bool_]:
        """Which geoms (ngeom,) stand between the camera and the robot's centre or outline."""
        view = self.renderer.scene.camera[0]
        eye, up = np.array(view.pos, dtype=np.float64), np.array(view.up, dtype=np.float64)
        right = np.cross(np.array(view.forward, dtype=np.float64), up)
        centre, radius = self.data.xpos[self.robot], 0.8 * self.rollout.radius
        found, geom = np.zeros(self.model.ngeom, dtype=bool), np.zeros(1, np.int32)
        drawn = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)  # the geom groups that MuJoCo shows by default
        for offset in (0 * up, up, -up, right, -right):
            target, start = centre + radius * offset, eye
            for _ in range(100):  # surfaces between; more do not matter
                ray = target - start
                hit = mujoco.mj_ray(self.model, self.data, start, ray, drawn, True, -1, geom)
                if not 0 <= hit < 1:
                    break
                found[geom[0]] = self.can_hide[geom[0]]
                start = start + (hit + 1e-4) * ray
        return found

    def _fade(self, hiding: npt.NDArray[np.bool_], step: float) -> None:
        self.faded += np.clip(hiding - self.faded, -step, step)
        scene = self.renderer.scene
        for number in range(scene.ngeom if self.faded.any() else 0):
            geom = scene.geoms[number]
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and self.faded[geom.objid] > 0:
                share, alpha = self.faded[geom.objid], geom.rgba[3]
                geom.rgba[3] = (1 - share) * alpha + share * min(alpha, FADE)
                geom.transparent = 1

    def _draw_lines(self, time: float) -> None:
        """The plan, the trace up to `time`, where the robot should be, and the force that disturbs it."""
        run, lift = self.rollout, np.array([0.0, 0.0, LIFT if self.planar else 0.0])
        here = self._positions(self.states, self.times, time)
        wanted = self._positions(run.plan.states, run.times, time)
        done = int(np.searchsorted(self.knots, time, side="right"))
        trace = np.vstack([self.trace[:done], here])
        error = np.interp(np.append(self.knots[:done], time), self.times, self.error)
        colours = caption.error_colours(0.5 * (error[1:] + error[:-1]) / self.scale)
        self._ribbon(trace + lift, (2.6 if self.planar else 1.5) * self.width, colours)
        self._ribbon(self.plan + 2 * lift, 0.8 * self.width, np.tile((*PLAN, 1.0), (len(self.plan) - 1, 1)))
        if self.planar:
            self._overlay(Geom.mjGEOM_CYLINDER, wanted + 3 * lift, [run.radius, LIFT, 0], (*PLAN, 0.35))
        else:
            self._overlay(Geom.mjGEOM_SPHERE, wanted, [run.radius] * 3, (*PLAN, 0.10))
        force = self.force[min(int(time / run.plan.dt + 1e-9), len(self.force) - 1)]
        if np.linalg.norm(force) > 0.15:
            start = self.data.xpos[self.robot] + [0, 0, 0.5 * run.radius]
            arrow = self._overlay(Geom.mjGEOM_ARROW, start, [1, 1, 1], (*FORCE, 1.0))
            mujoco.mjv_connector(arrow, Geom.mjGEOM_ARROW, 2.5 * self.width, start, start + 4 * run.radius * force)

    def _ribbon(self, points: Array, width: float, colours: Array) -> None:
        """A line through points (k, 3) with a colour (k-1, 4) each segment, of boxes: far cheaper than capsules."""
        along = np.diff(points, axis=0)
        length = np.linalg.norm(along, axis=1, keepdims=True)
        z = along / np.where(length > 0, length, 1)
        side = np.cross(np.where(np.abs(z[:, 2:]) < 0.99, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]), z)
        x = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
        rotations, centres = np.stack([x, np.cross(z, x), z], axis=-1), points[:-1] + 0.5 * along
        thickness = 0.2 * LIFT if self.planar else width
        for number in np.flatnonzero(length > 1e-6):
            size = [width, thickness, 0.5 * length[number, 0]]
            self._overlay(Geom.mjGEOM_BOX, centres[number], size, colours[number], rotations[number])

    def _overlay(
        self, kind: Geom, position: Array, size: npt.ArrayLike, rgba: npt.ArrayLike, rotation: Array | None = None
    ) -> mujoco.MjvGeom:
        scene = self.renderer.scene
        geom = scene.geoms[scene.ngeom]
        matrix = np.eye(3) if rotation is None else rotation
        mujoco.mjv_initGeom(
            geom,
            kind,
            np.asarray(size, dtype=np.float64),
            np.asarray(position, dtype=np.float64),
            matrix.ravel(),
            np.asarray(rgba, dtype=np.float32),
        )
        geom.category, geom.castshadow = mujoco.mjtCatBit.mjCAT_DECOR, 0
        geom.specular, geom.emission = 0, 0 if self.planar else 0.3  # the sun is on a floor, not on what hangs in space
        scene.ngeom += 1
        return geom

    def _write(self, image: Pixels, time: float) -> None:
        """The captions."""
        run, height = self.rollout, max(round(self.size[1] / 44), 9)
        error, clearance = (float(np.interp(time, self.times, x)) for x in (self.error, self.clearance))
        lines = [f"{run.robot} in {run.scene}".replace("_", " ")]
        for disturbance in run.disturbances or ["undisturbed"]:
            lines += textwrap.wrap(disturbance, 34, subsequent_indent="  ")
        lines += [f"time {time:.1f} s", f"tracking error {1e3 * error:.0f} mm"]
        lines += [f"clearance {clearance:.2f} m"] if np.isfinite(clearance) else []
        lines += ["diverged"] if run.diverged[self.trial] and time > self.times[-1] else []
        caption.paste(image, caption.text(tuple(lines), height, width=self.size[0] // 5), left=height, top=height)
        full = f"{1e3 * self.scale:g} mm" if self.scale < 1 else f"{self.scale:g} m"
        entries = (("planned", PLAN), ("force", FORCE)) if self.force.any() else (("planned", PLAN),)
        caption.paste(image, caption.legend(entries, full, round(0.8 * height)), left=height, bottom=height)


def _recent(forces: Array, dt: float) -> Array:
    """Mean forces (T, 3) over the fifth of a second before each period's end, relative to the strongest.

    A push of one period would be gone before it is seen, and noise would flicker.
    """
    window = max(round(0.2 / dt), 1)
    total = np.cumsum(np.vstack([np.zeros((window, 3)), np.nan_to_num(forces)]), axis=0)
    recent = (total[window:] - total[:-window]) / window
    return recent / max(float(np.linalg.norm(recent, axis=1).max()), 1e-9)


def _round_up(value: float) -> float:
    """The next of 1, 1.5, 2, 3, 5, 7, 10, 15, ..."""
    power = 10.0 ** np.floor(np.log10(value) + 1e-9)
    return float(power * next(step for step in (1, 1.5, 2, 3, 5, 7, 10) if step * power >= value * (1 - 1e-9)))
