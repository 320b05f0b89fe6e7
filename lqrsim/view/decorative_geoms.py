"""Geoms that are drawn beside the model's own, in pictures and in viewers."""

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array

PLAN_RGB = (0.78, 0.08, 0.42)  # the plan's colour; none of the error map, and of no robot


def decorate(
    geom: mujoco.MjvGeom,
    kind: mujoco.mjtGeom,
    size: npt.ArrayLike,
    position: npt.ArrayLike,
    rgba: npt.ArrayLike,
    rotation: Array | None = None,
) -> mujoco.MjvGeom:
    """Makes of a geom one of this kind, size (3,), place (3,) and colour (4,), that throws no shadow; returns it."""
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
