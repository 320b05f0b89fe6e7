"""The colliding geoms of an MJCF's moving bodies, as balls fixed to the bodies."""

from dataclasses import dataclass

import mujoco
import numpy as np

from lqrsim.capsules import Capsule
from lqrsim.errors import Array
from lqrsim.scenes.mjcf_obstacles import solid_geoms

# The largest part of a capsule outside its balls, relative to its radius.
TOLERANCE = 0.25


@dataclass(frozen=True, eq=False)
class Outline:
    """B balls.

    Attributes:
      bodies: (B,) numbers of the bodies that they are fixed to. offsets: (B, 3) positions in the axes of these bodies,
        in metres. radii: (B,) in metres. names: names of the balls. sites: names of the geoms in whose centre they are;
        None for other balls. missed: largest part of a capsule outside its balls, in metres.
    """

    bodies: Array
    offsets: Array
    radii: Array
    names: tuple[str, ...]
    sites: tuple[str | None, ...]
    missed: float


def outline_of(model: mujoco.MjModel) -> Outline:
    """Spheres as balls, capsules as chains of balls, other geoms as a ball about their centre that contains them.

    Geoms that are only drawn count if nothing collides. The last ball is in the centre of a geom.
    """
    rows, names, sites, missed = list[tuple[int, Array, float]](), list[str](), list[str | None](), 0.0
    for geom in solid_geoms(model).tolist():
        body, middle, name = int(model.geom_bodyid[geom]), model.geom_pos[geom], model.geom(geom).name
        radius, places = float(model.geom_rbound[geom]), [middle]
        if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_CAPSULE):
            radius, half = (float(number) for number in model.geom_size[geom, :2])
            capsule = Capsule(2 * half, radius, TOLERANCE * radius)
            missed = max(missed, capsule.missed)
            axis = np.zeros(3)
            mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, half]), model.geom_quat[geom])
            chain = np.array(capsule.between(tuple(middle - axis), tuple(middle + axis)))
            places = [*(one for one in chain if np.linalg.norm(one - middle) > 1e-9), middle]
        for number, place in enumerate(places, start=1 - len(places)):
            rows.append((body, np.asarray(place, dtype=np.float64), radius))
            names.append(f"{name} ({-number} before)" if number else name)
            sites.append(None if number else name)
    return Outline(
        bodies=np.array([body for body, _, _ in rows]), offsets=np.array([place for _, place, _ in rows]),
        radii=np.array([radius for _, _, radius in rows]), names=tuple(names), sites=tuple(sites), missed=missed,
    )  # fmt: skip
