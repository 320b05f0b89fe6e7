"""A quadrotor that moves in a vertical plane, x-z or y-z, with its MJCF: a user's own robot."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from mechanisms import NO_CONTACT, Jointed, scene
from oracle.planar_quadrotor import ARM, DRAG, INERTIA, MASS, rate

import lqrsim as ls

GRAVITY = 9.8  # m/s^2, as MuJoCo's models here have it
BLOCK = '<geom name="block" type="box" size="0.15 0.4 0.8" pos="0 0.1 0.2"/>'


@dataclass(frozen=True)
class PlanarQuadrotor(Jointed):
    """State: place, roll about the normal and their rates. Control: two rotors' forces in N."""

    plane: str = ""  # as `Dynamics` takes it
    offset: float | None = None
    names: tuple[str, str] = ("x", "z")
    radius: float = 0.2

    name = "planar_quadrotor"
    body = "drone"
    joints = ("across", "up", "roll")
    actuators = ("left", "right")

    @cached_property
    def dynamics(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        a, b = self.names
        return ls.Dynamics(
            rate,
            states={a: "m", b: "m", "roll": "rad", f"v{a}": "m/s", f"v{b}": "m/s", "spin": "rad/s"},
            controls={"left": "N", "right": "N"},
            parameters={"mass": MASS, "inertia": INERTIA, "arm": ARM, "drag": DRAG, "gravity": GRAVITY},
            position=self.names,
            plane=self.plane,
            offset=self.offset,
            angles=("roll",),
            control_limits=(0.0, 6.0),
        )


def mjcf(things: str = BLOCK, *, level: str = "x", y: float = 0.0, before: str = "", flags: str = "") -> str:
    """The drone in the plane of z and another axis, among these obstacles; it rolls from that axis towards z."""
    axis, normal = ("1 0 0", "0 -1 0") if level == "x" else ("0 1 0", "1 0 0")
    place, side = (f"0 {y} 0", "{} 0 0") if level == "x" else (f"{y} 0 0", "0 {} 0")
    drone = f"""<body name="drone" pos="{place}">
      <joint name="across" type="slide" axis="{axis}" damping="{DRAG}"/>
      <joint name="up" type="slide" axis="0 0 1" damping="{DRAG}"/>
      <joint name="roll" type="hinge" axis="{normal}"/>
      <inertial pos="0 0 0" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
      <geom name="ball" size="0.2" rgba="0.9 0.4 0.1 0.6"/>
      <geom name="bar" type="capsule" fromto="{side.format(-ARM)} {side.format(ARM)}" size="0.03" {NO_CONTACT}/>
      <site name="left" pos="{side.format(-ARM)}"/><site name="right" pos="{side.format(ARM)}"/></body>"""
    rotors = "".join(f'<general name="{one}" site="{one}" gear="0 0 1 0 0 0"/>' for one in ("left", "right"))
    return scene(
        before + drone, rotors, things=f'<light pos="0 -4 6"/>{things}', compiler="",
        option=f'timestep="0.01" integrator="RK4" gravity="0 0 -{GRAVITY}"',
        before=f'<option>{flags}</option><visual><global offwidth="1280" offheight="720"/></visual>',
    )  # fmt: skip


def problem(
    robot: PlanarQuadrotor, world: ls.World, *, start=(-1.63, 0.2), goal=(2.11, 0.3), steps: int = 150
) -> ls.Problem:
    """A flight past the obstacles: over, under or up to them, depending on start and goal."""
    hover = MASS * GRAVITY / 2
    return ls.Problem(
        dynamics=robot.dynamics, dt=0.02, steps=steps, initial=ls.FixedState((*start, 0, 0, 0, 0)),
        stage_cost=ls.ControlCost((1.0, 1.0), about=(hover, hover)) + ls.ObstacleCost(world, radius=robot.radius),
        final_cost=ls.QuadraticCost(np.full(6, 500.0), about=(*goal, 0, 0, 0, 0)),
        constraints=(ls.Clearance(world, radius=robot.radius, margin=0.05),),
    )  # fmt: skip
