"""An arm of three links in a level plane, with its MJCF: a robot made of capsules, without a position of its own."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mechanisms import Jointed, motors, scene

import lqrsim as ls

LENGTH, RADIUS, HEIGHT = 0.4, 0.03, 0.1  # m, of each link, and where the plane is
INERTIA, DAMPING = 0.05, 0.5  # kg m^2, of each joint's motor, which is most of what moves; N m s
LINK = ls.types.Capsule(LENGTH, RADIUS, 0.003)
POSTS = """
    <geom name="near post" type="capsule" size="0.04 0.2" pos="0.55 0.45 0.1"/>
    <geom name="far post" type="cylinder" size="0.05 0.3" pos="0.2 -0.95 0.2"/>
    <geom name="crate" type="box" size="0.1 0.2 0.2" pos="-0.9 0.3 0" euler="0 0 30"/>
"""


def places(x, p):
    from sympy import cos, sin

    joint, angle, found = [0, 0, HEIGHT], 0, []
    for turn in x[:3]:
        angle = angle + turn
        end = [joint[0] + p.length * cos(angle), joint[1] + p.length * sin(angle), HEIGHT]
        found += LINK.between(joint, end)
        joint = end
    return found


@dataclass(frozen=True)
class PlanarArm(Jointed):
    """Speeds are commanded: each joint follows its own, so that the dynamics are linear and the geometry is not."""

    radius: float = 0.3  # m, how large pictures take it to be

    name = "planar_arm"
    body = "upper"
    joints = ("shoulder", "elbow", "wrist")
    actuators = ("shoulder", "elbow", "wrist")

    @cached_property
    def dynamics(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        def rate(x, u, p):
            return [*x[3:], *((u[i] - p.damping * x[3 + i]) / p.inertia for i in range(3))]

        return ls.Dynamics(
            rate,
            states=dict.fromkeys(self.joints, "rad") | {f"{name}_speed": "rad/s" for name in self.joints},
            controls=dict.fromkeys(self.actuators, "N m"),
            parameters={"length": LENGTH, "damping": DAMPING, "inertia": INERTIA},
            angles=self.joints,
            control_limits=(-0.6, 0.6),
        )

    @cached_property
    def balls(self) -> ls.CollisionSpheres:  # pyright: ignore[reportIncompatibleVariableOverride]
        sites = [None] * (LINK.count - 1)
        return ls.CollisionSpheres(places, 3 * LINK.radii, sites=[*sites, "end 0", *sites, "end 1", *sites, "end 2"])

    @staticmethod
    def scene(folder: Path, things: str = POSTS) -> ls.Scene:
        """The arm among these obstacles."""
        (folder / "planar_arm.xml").write_text(PlanarArm.mjcf(things))
        return ls.load_scene(folder / "planar_arm.xml")

    @staticmethod
    def mjcf(things: str = POSTS) -> str:
        """The arm among these obstacles, as MJCF. The links weigh next to nothing; the inertia is the motors'."""
        link = f'<geom name="link {{}}" type="capsule" fromto="0 0 0 {LENGTH} 0 0" size="{RADIUS}" mass="1e-6"/>'
        site, end = '<site name="end {}" pos="{} 0 0"/>', "</body>"
        bodies = ""
        for i, (body, joint) in enumerate((("upper", "shoulder"), ("fore", "elbow"), ("hand", "wrist"))):
            place = f"0 0 {HEIGHT}" if i == 0 else f"{LENGTH} 0 0"
            hinge = f'<joint name="{joint}" axis="0 0 1" damping="{DAMPING}" armature="{INERTIA}"/>'
            bodies += f'<body name="{body}" pos="{place}">{hinge}{link.format(i)}{site.format(i, LENGTH)}'
        return scene(
            bodies + 3 * end, motors(PlanarArm.joints, [0.6] * 3), things='<light pos="0 0 5"/>' + things, compiler="",
            option='timestep="0.01" integrator="RK4"',
            before='<visual><global offwidth="1280" offheight="720"/></visual>',
            more='<contact><exclude body1="upper" body2="fore"/><exclude body1="fore" body2="hand"/></contact>',
        )  # fmt: skip
