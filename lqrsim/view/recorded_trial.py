"""One trial of a rollout for pictures: the model at any time, and the places of robot and plan."""

import copy
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Index, checked
from lqrsim.errors import Array, InputError, check_items
from lqrsim.results.rollout import BallRecord, Rollout
from lqrsim.scenes.mjcf_kinematics import axes_of, colliding, in_axes_of_bodies
from lqrsim.scenes.mjcf_model import model_from_xml

ARMS = 2.0  # radius relative to the reach of the robot's own body, above which the robot has arms
POINT = 0.02  # radius of a robot without a size, relative to the extent of the scene
UNCOLOURED = 0.5, 0.5, 0.5, 1.0  # the colour of a geom whose MJCF gives none
SHOWN_GROUPS = 3  # the first groups of geoms, which MuJoCo's own pictures show
FORCE_WINDOW = 0.2  # s over which forces are averaged: a push of one period would be invisible, and noise would flicker

Triangles = tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]  # vertices (v, 3) in metres, and faces (f, 3)


class DrawnGeom(NamedTuple):
    """A geom as pictures outside of MuJoCo draw it, in its own axes, with its number in the model."""

    number: int
    name: str
    kind: str  # in the words of the MJCF, such as "capsule"
    size: Array  # (3,) as in the MJCF; a plane without an end is twice as wide as the scene
    colour: Array  # (4,); of a texture, the mean
    moves: bool
    triangles: Triangles | None  # of a mesh, a height field or a signed distance function


class RecordedTrial:
    """A trial. A diverged trial stands still from its last finite state on."""

    def __init__(self, rollout: Rollout, trial: int) -> None:
        self.rollout, self.trial = rollout, trial
        self.model = model_of(rollout, trial)
        finite = np.isfinite(rollout.frames[trial]).all(axis=1)
        alive = np.isfinite(rollout.states[trial]).all(axis=1)
        if not (finite.any() and alive.any()):
            raise InputError(f"rollout: got trial {trial} without a finite state, want one that can be drawn")
        self.frame_times, self.frames = rollout.frame_times[finite], rollout.frames[trial][finite]
        # Rows of the k finite states.
        self.times, self.states = rollout.times[alive], rollout.states[trial, alive]
        self.measured = rollout.measured[trial, alive]
        self.error, self.clearance = rollout.tracking_error[trial, alive], rollout.clearance[trial, alive]
        window = max(round(FORCE_WINDOW / rollout.plan.dt), 1)
        total = np.cumsum(np.vstack([np.zeros((window, 3)), np.nan_to_num(rollout.forces[trial])]), axis=0)
        self.force = (total[window:] - total[:-window]) / window  # (T, 3) in N, means until the end of each period
        self.end = float(rollout.times[-1])  # of the plan, in seconds
        self.planar = rollout.state_coordinates.from_above  # the overlays are then on the floor
        self.robot = robot_body(self.model, rollout.body)
        self.size = drawn_size(self.model, rollout, self.robot)
        data = mujoco.MjData(self.model)
        self.pose(data, 0.0)
        self.floor = floor_below(self.model, data, self.robot)  # in the first frame

    @property
    def name(self) -> str:
        """Robot and scene; an MJCF with a robot is both."""
        run = self.rollout
        return (run.robot if run.scene == run.robot else f"{run.robot} in {run.scene}").replace("_", " ")

    def pose(self, data: mujoco.MjData, time: float) -> None:
        """Pose the model at `time`, between two recorded frames if necessary."""
        first = int(np.clip(np.searchsorted(self.frame_times, time, side="right") - 1, 0, max(len(self.frames) - 2, 0)))
        data.qpos[:] = self.frames[first]
        if len(self.frames) > 1:
            start, end = self.frame_times[first : first + 2]
            motion = np.zeros(self.model.nv)
            mujoco.mj_differentiatePos(self.model, motion, 1.0, self.frames[first], self.frames[first + 1])
            mujoco.mj_integratePos(self.model, data.qpos, motion, float(np.clip((time - start) / (end - start), 0, 1)))
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_tendon(self.model, data)
        mujoco.mj_camlight(self.model, data)

    def driven(self, at: Array | float) -> Array:
        """Places of the robot at these times, (..., 3); on the floor if it is seen from above."""
        alive = np.isin(self.rollout.times, self.times)
        places = interpolated(self.rollout.places(self.trial)[alive], self.times, at)
        return self.rollout.in_world(places, height=self.floor)

    def planned(self, at: Array | float) -> Array:
        """Planned places at these times, (..., 3)."""
        places = interpolated(self.rollout.planned_places, self.rollout.times, at)
        return self.rollout.in_world(places, height=self.floor)

    @property
    def ghost_radius(self) -> float:
        """The radius in metres of the ball at the planned place: that of the robot, or of an arm's last ball."""
        return self.size if self.rollout.balls is None else float(self.rollout.balls.radii[-1])

    def force_at(self, time: float) -> Array:
        """The recent disturbing force (3,) in N."""
        return self.force[min(self.step(time), len(self.force) - 1)]

    def step(self, time: float) -> int:
        """The number of the control period that a time is in; at the end of the plan, the number of periods."""
        return min(int(time / self.rollout.plan.dt + 1e-9), self.rollout.plan.steps)

    def ending(self, time: float) -> str:
        """The event that ended the trial before this time, as text; empty if there was none."""
        run, k = self.rollout, self.trial
        if run.outcome[k] not in ("collided", "diverged", "error") or time < run.ended[k]:
            return ""
        return f"collided with {run.obstacles[k]}" if run.collided[k] else run.outcome[k]


def interpolated(points: Array, times: Array, at: Array | float) -> Array:
    """Points (..., c) between rows of a table (k, c), which belong to increasing times (k,)."""
    return np.stack([np.interp(at, times, column) for column in points.T], axis=-1)


@checked
def model_of(rollout: Rollout, trial: Index) -> mujoco.MjModel:
    """Compile the model that was run, with the obstacles where they were in the trial."""
    if not 0 <= trial < rollout.trials:
        raise InputError(f"trial: got {trial}, want one of 0 to {rollout.trials - 1}")
    if not rollout.plane:
        wanted = "the 2 or 3 states that are the position, or a run of a robot with balls that has frames"
        raise InputError(f"state_coordinates.position: got none, want {wanted}")
    if (balls := tracked_balls(rollout)) is not None:
        _ = balls.tracked  # raises an exception if no site is named
    model = copy.copy(_compiled(rollout.model))
    hide_hulls(model)
    robot_body(model, rollout.body)
    if rollout.balls is not None and (rollout.balls.anchors[:, 0] >= model.nbody).any():
        wanted = f"want one of its {model.nbody}"
        raise InputError(f"rollout.balls.anchors: got a body that the model does not have, {wanted}")
    if model.nq != (numbers := rollout.frames.shape[-1]):
        raise InputError(f"rollout.frames: got {numbers} numbers a frame, want {model.nq}, as the model has")
    if (geoms := rollout.obstacle_geoms) is not None:
        if (geoms >= model.ngeom).any():
            raise InputError(f"rollout.obstacle_geoms: got {geoms.max()}, want numbers below {model.ngeom}")
        model.geom_pos[geoms] += in_axes_of_bodies(model, geoms, rollout.displaced[trial])
    return model


SKY = '<texture name="" type="skybox" builtin="gradient" rgb1=".93 .96 1" rgb2=".7 .78 .86" width="64" height="384"/>'


@functools.lru_cache(maxsize=1)  # the trials of a run have one model, and its meshes take half a second
def _compiled(xml: str) -> mujoco.MjModel:
    """Compile an MJCF, with a light sky if it has none: MuJoCo would draw a black one."""
    if "skybox" not in xml and "</mujoco>" in xml:
        end = xml.rindex("</mujoco>")
        xml = f"{xml[:end]}<asset>{SKY}</asset>{xml[end:]}"
    return model_from_xml(xml, "rollout.model")


def drawn_geoms(model: mujoco.MjModel) -> list[DrawnGeom]:
    """The geoms of a model that MuJoCo's own pictures show."""
    geoms = []
    for geom in range(model.ngeom):
        colour, size = _colour(model, geom), model.geom_size[geom].copy()
        if model.geom_group[geom] >= SHOWN_GROUPS or colour[3] == 0:
            continue
        kind = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
        if kind == "plane":
            size[:2] = np.where(size[:2] > 0, size[:2], 2 * model.stat.extent)
        shape, triangles = int(model.geom_dataid[geom]), None
        if kind in ("mesh", "sdf"):
            mesh = model.mesh(shape)
            vertices = model.mesh_vert[int(mesh.vertadr[0]) :][: int(mesh.vertnum[0])]
            triangles = vertices, model.mesh_face[int(mesh.faceadr[0]) :][: int(mesh.facenum[0])]
        if kind == "hfield":
            triangles = _surface(model, shape)
        name, moves = model.geom(geom).name or f"geom {geom}", model.body_weldid[model.geom_bodyid[geom]] != 0
        geoms.append(DrawnGeom(geom, name, kind, size, colour, bool(moves), triangles))
    return geoms


def _surface(model: mujoco.MjModel, field: int) -> Triangles:
    """Vertices (v, 3) and faces (f, 3) of the upper side of a height field."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    x, y, height, _ = model.hfield_size[field]
    heights = height * model.hfield_data[int(model.hfield_adr[field]) :][: rows * columns]
    across = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
    vertices = np.stack([across[0].ravel(), across[1].ravel(), heights], axis=1).astype(np.float32)
    corner = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    lower = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:]
    upper = corner[:-1, :-1], corner[1:, 1:], corner[1:, :-1]
    return vertices, np.vstack([np.stack([c.ravel() for c in half], axis=1) for half in (lower, upper)])


def _colour(model: mujoco.MjModel, geom: int) -> Array:
    """As in MuJoCo, the colour (4,) of the geom itself goes before that of its material."""
    colour, material = model.geom_rgba[geom].astype(np.float64), int(model.geom_matid[geom])
    if material >= 0 and np.array_equal(colour, UNCOLOURED):
        colour = model.mat_rgba[material].astype(np.float64)
    texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB.value]) if material >= 0 else -1
    if texture >= 0:
        channels = int(model.tex_nchannel[texture])
        count = int(model.tex_height[texture]) * int(model.tex_width[texture]) * channels
        pixels = model.tex_data[int(model.tex_adr[texture]) :][:count].reshape(-1, channels)
        colour[:3] *= pixels[:, :3].mean(axis=0) / 255
    return colour


def hide_hulls(model: mujoco.MjModel) -> None:
    """Do not draw colliding meshes of bodies that have other meshes, only for drawing, in the same place."""
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH.value
    collides = colliding(model)
    drawn = set(model.geom_bodyid[is_mesh & ~collides & (model.geom_group < SHOWN_GROUPS)].tolist())
    for geom in np.flatnonzero(is_mesh & collides).tolist():
        if int(model.geom_bodyid[geom]) in drawn:
            model.geom_rgba[geom, 3] = 0


def robot_body(model: mujoco.MjModel, name: str) -> int:
    """The number of the robot's body. Raises InputError if the model has no body of that name."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) if isinstance(name, str) else -1
    if number < 0:
        raise InputError(f"rollout.body: got {name!r}, want the name of a body of the model")
    return number


def drawn_size(model: mujoco.MjModel, rollout: Rollout, robot: int) -> float:
    """The radius in metres of what stands for a robot at its position in a picture, so that it does not hide the robot.

    The radius of a robot with arms is their reach. If it is more than ARMS times the half width of the robot's own
    body, along the axes in which it is seen, the half width is taken. A robot without a radius is as large as its body.
    """
    axes, reach = (2 if rollout.state_coordinates.from_above else 3), 0.0
    for geom in np.flatnonzero(model.geom_bodyid == robot) if rollout.state_coordinates.position else ():
        turn, (middle, half) = axes_of(model.geom_quat[geom]), model.geom_aabb[geom].reshape(2, 3)
        extent = np.abs(model.geom_pos[geom] + turn @ middle) + np.abs(turn) @ half
        reach = max(reach, float(extent[:axes].max()))
    if not rollout.radius:
        return reach or POINT * float(model.stat.extent)
    return reach if 0 < ARMS * reach < rollout.radius else rollout.radius


def tracked_balls(rollout: Rollout) -> BallRecord | None:
    """The balls of a robot without a position, the last of which stands for it; None for other robots."""
    return None if rollout.state_coordinates.position else rollout.balls


def place_of(data: mujoco.MjData, robot: int, balls: BallRecord | None) -> Array:
    """Place (3,) of a robot: the origin of its body, or its last ball, by its site."""
    if balls is None:
        return data.xpos[robot]
    body, place = balls.tracked
    return data.xpos[body] + data.xmat[body].reshape(3, 3) @ place


def floor_below(model: mujoco.MjModel, data: mujoco.MjData, robot: int) -> float:
    """The height of the ground below a body, in metres; the body's own height without ground."""
    centre, drop = data.xpos[robot], np.array([0.0, 0.0, -1.0])
    hit = mujoco.mj_ray(model, data, centre, drop, None, True, robot, np.zeros(1, np.int32))
    return float(centre[2] - max(hit, 0.0))


def in_bytes(colours: npt.ArrayLike) -> list[Any]:
    """Colours (..., c) from numbers between 0 and 1, in bytes."""
    return np.round(255 * np.clip(colours, 0, 1)).astype(int).tolist()


def rows_of(trial: int | Sequence[int], most: int) -> list[Any]:
    """The rows that `trial` names: one, or 1 to `most`. Raises InputError for another number of them."""
    if not isinstance(trial, Sequence) or isinstance(trial, str):
        return [trial]
    rows = check_items("trial", trial, object, f"1 to {most} of them", at_most=most)
    if not rows:
        raise InputError(f"trial: got none, want 1 to {most} of them")
    return list(rows)
