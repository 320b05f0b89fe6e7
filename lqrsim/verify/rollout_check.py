"""Verification of a run by drawing it."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco import mjtGeom as Geom

from lqrsim.errors import Array, InputError
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.verify import ground_truth, pixels
from lqrsim.verify.ground_truth import Progress
from lqrsim.verify.verdict import Positions, Verification, compare
from lqrsim.view import cameras, gl
from lqrsim.view.cameras import Camera
from lqrsim.view.recorded_trial import place_in, robot_body

SIZE = (640, 480)
POSITION_BOUND = 1 / 60  # largest error, in radii of the robot: 5 and 2.8 mm for the packaged ones
# Orthographic silhouettes of these geoms are symmetric about their centre in any orientation.
SYMMETRIC_KINDS = (
    Geom.mjGEOM_SPHERE,
    Geom.mjGEOM_CAPSULE,
    Geom.mjGEOM_ELLIPSOID,
    Geom.mjGEOM_CYLINDER,
    Geom.mjGEOM_BOX,
)


def verify_run(
    rollout: Rollout, trial: int = 0, *, solution: Solution | None = None, progress: Progress | None = None
) -> Verification:
    """Draw the frames of a rollout, read positions from the pixels, and compare them with its states.

    Each control period is drawn from above if the robot moves on a floor, from the side if it moves in a vertical
    plane, and from both if it moves in space. The pictures are segmentations that show only a part of the robot that
    can collide, like X-rays, in which obstacles hide nothing. For a robot without a position, the place of its last
    ball is read.

    Args:
      rollout: rollout of `simulate`, with frames.
      trial: row of the rollout.
      solution: the solution that was run, to check the plan in the rollout.
      progress: called after each frame with the numbers of frames that are done and of all frames.

    Raises:
      InputError: there is no such trial, nothing can be drawn, or there is no OpenGL.
    """
    ground_truth.check_arguments(solution, progress)
    model = ground_truth.drawable_model(rollout, trial)
    body = robot_body(model, rollout.body)
    if rollout.balls is not None and not rollout.state_coordinates.position:
        body = rollout.balls.tracked[0]
    geom = _tracked_geom(model, body)
    views = [{"top": cameras.top, "side": cameras.side}[name](rollout) for name in cameras.measuring(rollout.plane)]
    times, rows = ground_truth.frames_at_states(rollout, trial)
    measured: list[Array] = []
    offsets: list[Array] = []
    for masks, offset in _silhouettes(model, geom, rollout, rollout.frames[trial, rows], views):
        measured.append(
            np.array([view.measure(pixels.mask_centre(mask), SIZE) for view, mask in zip(views, masks, strict=True)])
        )
        offsets.append(offset)
        if progress:
            progress(len(measured), len(rows))
    places, apart = pixels.triangulate(views, measured, rollout.plane)
    name = model.geom(geom).name or model.geom(geom).id
    positions = Positions(
        times,
        seen=places - rollout.of_world(offsets),
        actual=ground_truth.state_positions(rollout, trial, times),
        planned=ground_truth.planned_positions(rollout, times),
        apart=apart,
    )
    return compare(
        ground_truth.describe(rollout, trial),
        f"the silhouette of {name} in {SIZE[0]} x {SIZE[1]} pixels from {' and '.join(view.name for view in views)},"
        " all else left out (X-ray)",
        positions,
        bound=POSITION_BOUND * rollout.radius,
        interval=float(rollout.frame_times[1] - rollout.frame_times[0]),
        others=(ground_truth.check_plan(rollout, solution),),
    )


def _tracked_geom(model: mujoco.MjModel, body: int) -> int:
    """The largest geom of the robot's body that can collide and has a symmetric silhouette."""
    kinds = [kind.value for kind in SYMMETRIC_KINDS]
    fits = (model.geom_bodyid == body) & np.isin(model.geom_type, kinds)
    fits &= (model.geom_contype | model.geom_conaffinity) != 0
    if not fits.any():
        raise InputError(
            "rollout.model: got no geom to track, want a sphere, capsule, ellipsoid, cylinder or box of the robot"
        )
    return int(np.argmax(np.where(fits, model.geom_rbound, -1)))


def _silhouettes(
    model: mujoco.MjModel, geom: int, rollout: Rollout, frames: Array, views: Sequence[Camera]
) -> Iterator[tuple[list[npt.NDArray[np.bool_]], Array]]:
    """For each frame (nq,): masks (height, width) of the geom in each view, and its offset from the robot's place."""
    gl.bind()
    body = robot_body(model, rollout.body)
    model.geom_group[:], model.geom_group[geom] = 1, 0
    model.vis.quality.offsamples, model.vis.quality.shadowsize = 0, 0
    model.vis.global_.offwidth, model.vis.global_.offheight = SIZE
    data, options = mujoco.MjData(model), mujoco.MjvOption()
    options.geomgroup[:], options.sitegroup[:] = [1, 0, 0, 0, 0, 0], 0
    with mujoco.Renderer(model, SIZE[1], SIZE[0]) as renderer:
        for frame in frames:
            data.qpos = frame
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            masks = []
            for view in views:
                renderer.update_scene(data, scene_option=options)
                view.place(renderer.scene, SIZE[0] / SIZE[1])
                # The renderer's own segmentation, without looking up the only geom.
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT.value] = 1
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR.value] = 1
                masks.append(renderer.render()[..., 0] > 0)
            yield masks, data.geom_xpos[geom] - place_in(data, rollout, body)
