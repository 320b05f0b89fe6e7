"""The mark on a robot by which its position is read from a video."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco import mjtGeom as Geom

from lqrsim.errors import Array, InputError, check_array, check_number
from lqrsim.rollout import Rollout

# Pure green: the error map, the plan, forces, robots and scenes do not use it. With all of its light its own, and its
# channels at their ends, it looks the same lit and in the shade.
COLOUR = (0.0, 1.0, 0.0)
MAST = (0.15, 0.16, 0.18)
THICKNESS = 0.001  # of the disc, half, in metres


@dataclass(frozen=True)
class Marker:
    """A green ball on a mast, on a robot that moves in space; a green disc on top of one that moves in the plane.

    Attributes:
      kind: `ball` or `disc`. radius: its own, in metres.
      offset: its centre in the frame of the robot's body, in metres.
    """

    kind: str
    offset: tuple[float, float, float]
    radius: float

    def centre(self, position: Array, rotation: Array) -> Array:
        """Where it is (..., 3), on a body at positions (..., 3) and rotations (..., 3, 3) in the world."""
        return position + rotation @ np.array(self.offset)

    def draw(self, scene: mujoco.MjvScene, position: Array, rotation: Array) -> None:
        """Adds it to a scene, on the body at a position (3,) and a rotation (3, 3) in the world."""
        centre, size = self.centre(position, rotation), [self.radius, self.radius, THICKNESS]
        kind = Geom.mjGEOM_SPHERE if self.kind == "ball" else Geom.mjGEOM_CYLINDER
        mark = _add(scene, kind, np.array(size), centre, rotation, COLOUR)
        mark.emission = 1.0
        if self.kind == "ball":
            mast = _add(scene, Geom.mjGEOM_CAPSULE, np.ones(3), centre, rotation, MAST)
            mujoco.mjv_connector(mast, Geom.mjGEOM_CAPSULE, 0.1 * self.radius, position, centre)

    def as_json(self) -> dict[str, Any]:
        """What `from_json` makes the same marker of."""
        return asdict(self)

    @classmethod
    def from_json(cls, parts: Mapping[str, Any]) -> "Marker":
        """Raises InputError unless it is what `as_json` gives."""
        try:
            kind, offset, radius = parts["kind"], parts["offset"], parts["radius"]
        except (KeyError, TypeError) as error:
            raise InputError(f"marker: got {parts!r}, want a marker's parts ({error})") from None
        if kind not in ("ball", "disc"):
            raise InputError(f"marker.kind: got {kind!r}, want ball or disc")
        x, y, z = check_array("marker.offset", offset, (3,)).tolist()
        return cls(kind, (x, y, z), check_number("marker.radius", radius, above=0))


def marker(rollout: Rollout) -> Marker:
    """The marker that a robot wears."""
    model = mujoco.MjModel.from_xml_string(rollout.model)
    highest = max((_top(model, geom) for geom in range(model.ngeom) if _worn(model, geom)), default=0.0)
    if len(rollout.state_coordinates.position) == 3:
        radius = rollout.radius * 2 / 15
        return Marker("ball", (0.0, 0.0, max(0.5 * rollout.radius, highest + 1.5 * radius)), radius)
    return Marker("disc", (0.0, 0.0, highest + 2 * THICKNESS), 0.4 * rollout.radius)


def robot_body(model: mujoco.MjModel) -> int:
    """The number of the robot's body: the first that moves."""
    return int(np.argmax(model.body_weldid != 0))


def _worn(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom is a part of the robot's body that is drawn."""
    return model.geom_bodyid[geom] == robot_body(model) and model.geom_group[geom] < 3


def _top(model: mujoco.MjModel, geom: int) -> float:
    """The highest point of a geom in its body's frame."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    up, centre, half = rotation.reshape(3, 3)[2], model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    return float(model.geom_pos[geom, 2] + up @ centre + np.abs(up) @ half)


def _add(
    scene: mujoco.MjvScene, kind: Geom, size: Array, position: Array, rotation: Array, colour: tuple[float, ...]
) -> mujoco.MjvGeom:
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, size, position, rotation.ravel(), np.array([*colour, 1.0], dtype=np.float32))
    geom.category, geom.castshadow, geom.specular = mujoco.mjtCatBit.mjCAT_DECOR, 0, 0
    scene.ngeom += 1
    return geom
