"""Solutions made by hand, without the package's solvers, for the tests of the closed loop."""

import numpy as np
import numpy.typing as npt

from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Certificate, Status, Trajectory
from lqrsim.robots.base import Robot
from lqrsim.robots.packaged import DifferentialDrive, Quadrotor


def track(robot: Robot, start: npt.ArrayLike, controls: npt.ArrayLike, dt: float, *, feedback: bool = True) -> Solution:
    """The plan of given controls from a start, with a time-varying LQR about it, or without feedback."""
    dynamics, controls = robot.dynamics, np.asarray(controls, dtype=float)
    steps, m = controls.shape
    states = [np.asarray(start, dtype=float)]
    for control in controls:
        states.append(dynamics.step(states[-1], control, dt))
    n = len(states[0])
    value, gain = np.eye(n), np.zeros((steps, m, n))
    for t in reversed(range(steps if feedback else 0)):
        a, b, _ = dynamics.linearize(states[t], controls[t], dt)
        gain[t] = -np.linalg.solve(b.T @ value @ b + np.eye(m), b.T @ value @ a)
        value = np.eye(n) + a.T @ value @ (a + b @ gain[t])
    plan = Trajectory(np.array(states), controls, dt)
    policy = AffinePolicy(
        gain=gain,
        offset=controls - np.einsum("tmn,tn->tm", gain, plan.states[:-1]),
        nominal=plan.states[:-1],
        dt=dt,
        state_coordinates=dynamics.state_coordinates,
        control_coordinates=dynamics.control_coordinates,
    )
    return Solution(
        status=Status.CONVERGED,
        detail="",
        policy=policy,
        inverse_policy=None,
        cost_to_go=None,
        cost_to_come=None,
        trajectory=plan,
        iterations=(),
        clearance=None,
        # There is no problem, so no cost of it; the plan is made by the dynamics, and by the law.
        certificate=Certificate(
            cost=np.nan,
            start=0.0,
            dynamics_residual=0.0,
            policy_residual=0.0,
            limits=0.0,
            violation=0.0,
            optimality=np.inf,
        ),
        gap=np.nan,
        solver="by hand",
        options={},
        problem_digest="",
        versions={},
    )


def weave(steps: int = 150) -> Solution:
    """A drive to the left along the arena's wall, to and fro across the cut at heading pi."""
    turn = 0.05 * np.cos(np.arange(steps) / 6)
    return track(DifferentialDrive(), (0.9, -2.5, np.pi), np.stack([0.08 - turn, 0.08 + turn], axis=1), 1 / 6)


def hover(steps: int = 60) -> Solution:
    """A hover in the middle of the cage that rocks for two seconds."""
    robot, time = Quadrotor(), np.arange(steps) / 30
    rock = 0.02 * np.sin(2 * np.pi * time)
    controls = robot.hover_force + np.stack([rock, -rock / 2, -rock, rock / 2], axis=1)
    return track(robot, np.zeros(12), controls, 1 / 30)
