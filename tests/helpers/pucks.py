"""A puck of 1 kg on ice, held in place by a linear law: where its runs end is a matrix times where they begin.

RK4 is exact under a constant force, so that of a control period is exactly the double integrator's.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mechanisms import Jointed, sled
from tracking import by_hand

import lqrsim as ls
from lqrsim.errors import Array

DT, STEPS = 0.1, 20
STIFFNESS, DAMPING = 0.3, 0.4  # so weak that much is left at the end
RADIUS = 0.1


@dataclass(frozen=True)
class Puck(Jointed):
    radius: float = RADIUS

    name = "puck"
    body = "puck"
    joints = actuators = ("x", "y")

    @property
    def dynamics(self) -> ls.Dynamics:
        return ls.Dynamics(
            lambda x, u, p: [x[2], x[3], u[0], u[1]],
            states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}, controls={"push_x": "N", "push_y": "N"},
            position=("x", "y"),
        )  # fmt: skip


def plant(folder: Path, *, wall: float | None = None) -> ls.Plant:
    """A plant with a wall at x = `wall`, or without one."""
    geom = "" if wall is None else f'<geom name="wall" type="box" size="0.5 9 1" pos="{wall + 0.5} 0 0"/>'
    path = folder / "ice.xml"
    option = 'timestep="0.1" integrator="RK4" gravity="0 0 0"'
    text = sled("xy", name="puck", geom='type="cylinder" size="0.1 0.03" mass="1"', option=option, things=geom)
    path.write_text(text, encoding="utf-8")
    return ls.Plant(Puck(), ls.load_scene(str(path)))


def solution() -> ls.Solution:
    """A plan that stays at the origin, its goal; the cost-to-go is |x|^2 / 2."""
    space, controls = Puck().dynamics.state_coordinates, Puck().dynamics.control_coordinates
    gain = -np.hstack([STIFFNESS * np.eye(2), DAMPING * np.eye(2)])
    plan = ls.Trajectory(np.zeros((STEPS + 1, 4)), np.zeros((STEPS, 2)), DT)
    policy = ls.AffinePolicy(
        gain=np.tile(gain, (STEPS, 1, 1)), offset=np.zeros((STEPS, 2)), nominal=np.zeros((STEPS, 4)), dt=DT,
        state_coordinates=space, control_coordinates=controls,
    )  # fmt: skip
    value = ls.types.Quadratic(np.tile(np.eye(4), (STEPS + 1, 1, 1)), np.zeros((STEPS + 1, 4)), np.zeros(STEPS + 1))
    return replace(by_hand(plan, policy), goal=np.zeros(4), cost_to_go=value)


def left(knot: int) -> Array:
    """The matrix (4, 4) from the states at a knot to those at the end."""
    push = np.vstack([DT**2 / 2 * np.eye(2), DT * np.eye(2)])
    drift = np.block([[np.eye(2), DT * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
    gain = -np.hstack([STIFFNESS * np.eye(2), DAMPING * np.eye(2)])
    return np.linalg.matrix_power(drift + push @ gain, STEPS - knot)
