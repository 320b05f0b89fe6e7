"""The problems, of names that `lqrsim` itself offers: other checkouts solve them, too."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import lqrsim as ls

Stated = tuple[ls.Problem, Any]  # a problem, and the start of `smooth`


def solve(name: str) -> None:
    """What a user's program does: state the problem and solve it."""
    problem, start = PROBLEMS[name]()
    solution = ls.smooth(problem, start=start)
    if not solution.success:
        raise SystemExit(f"{name}: {solution.status}")


def _pendulum() -> Stated:
    def rate(x: Any, u: Any, p: Any) -> list[Any]:
        from sympy import sin

        return [x[1], u[0] / (p.mass * p.length**2) - p.gravity / p.length * sin(x[0])]

    return _swing_up(ls.Dynamics(rate, parameters={"mass": 1.0, "length": 0.5, "gravity": 9.81}, **_JOINT)), None


def _second_pendulum() -> Stated:
    """With friction, and hung up on a spring."""

    def rate(x: Any, u: Any, p: Any) -> list[Any]:
        from sympy import cos, sin, tanh

        slowed = p.friction * tanh(5 * x[1]) + p.spring * x[0] * cos(x[0] / 2)
        return [x[1], (u[0] - slowed) / p.inertia - p.pull * sin(x[0])]

    parameters = {"inertia": 0.25, "pull": 15.0, "friction": 0.1, "spring": 0.3}
    return _swing_up(ls.Dynamics(rate, parameters=parameters, **_JOINT)), None


_JOINT: Any = {"states": {"angle": "rad", "turn": "rad/s"}, "controls": {"torque": "N m"}, "angles": ("angle",)}


def _swing_up(dynamics: ls.Dynamics) -> ls.Problem:
    return ls.Problem(
        dynamics=dynamics, dt=0.05, steps=40, initial=ls.FixedState([0.0, 0.0]), stage_cost=ls.ControlCost([0.1]),
        final_cost=ls.QuadraticCost([100.0, 10.0], about=[3.0, 0.0]),
    )  # fmt: skip


def _drive() -> Stated:
    return ls.scenarios.differential_drive().problem, None


def _quadrotor() -> Stated:
    scenario = ls.scenarios.quadrotor()
    return scenario.problem, scenario.paper_start


def _with_clearance() -> Stated:
    scenario = ls.scenarios.quadrotor()
    clearance = ls.Clearance(scenario.scene.world, radius=scenario.robot.radius)
    return replace(scenario.problem, constraints=[clearance]), scenario.paper_start


_CART_POLE = """
<mujoco>
  <option timestep="0.01" integrator="RK4"/>
  <worldbody><body>
    <joint name="cart" type="slide" axis="1 0 0" damping="0.1"/><geom type="box" size=".1 .1 .05" mass="1"/>
    <body><joint name="pole" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.6" mass=".2"/></body>
  </body></worldbody>
  <actuator><motor name="push" joint="cart" ctrlrange="-20 20"/></actuator>
</mujoco>
"""


def _cart_pole() -> Stated:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cart_pole.xml"
        path.write_text(_CART_POLE, encoding="utf-8")
        robot = ls.MjcfRobot(ls.load_scene(path))
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=0.02, steps=60, initial=ls.FixedState([0.0] * 4),
        stage_cost=ls.ControlCost([0.01]),
        final_cost=ls.QuadraticCost([100.0, 100.0, 10.0, 10.0], about=[0.0, 1.0, 0.0, 0.0]),
    )  # fmt: skip
    return problem, None


PROBLEMS: dict[str, Callable[[], Stated]] = {
    "pendulum": _pendulum,
    "second pendulum": _second_pendulum,
    "quadrotor": _quadrotor,
    "quadrotor, clearance": _with_clearance,
    "drive": _drive,
    "cart-pole, MJCF": _cart_pole,
}
