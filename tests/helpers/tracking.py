"""Solutions and funnels made by hand, without the package's solvers: nothing has certified them."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

import lqrsim as ls
from lqrsim.results.solution_parts import Certificate
from lqrsim.robots.base import Robot


def by_hand(plan: ls.Trajectory, policy: ls.AffinePolicy) -> ls.Solution:
    """There is no problem, so no cost of it; the plan is made by the dynamics, and by the law."""
    certificate = Certificate(
        cost=np.nan, start=0.0, dynamics_residual=0.0, policy_residual=0.0, limits=0.0, violation=0.0, optimality=np.inf
    )
    return ls.Solution(
        status=ls.Status.CONVERGED, detail="", policy=policy, inverse_policy=None, cost_to_go=None, cost_to_come=None,
        trajectory=plan, iterations=(), clearance=None, gap=np.nan, solver="by hand", options={}, problem_digest="",
        versions={}, certificate=certificate,
    )  # fmt: skip


def open_loop(dynamics: ls.Dynamics, plan: ls.Trajectory) -> ls.Solution:
    """The plan with its controls for a law, whatever the state is."""
    (steps, m), n = plan.controls.shape, plan.states.shape[1]
    policy = ls.AffinePolicy(
        gain=np.zeros((steps, m, n)), offset=plan.controls, nominal=plan.states[:-1], dt=plan.dt,
        state_coordinates=dynamics.state_coordinates, control_coordinates=dynamics.control_coordinates,
    )  # fmt: skip
    return by_hand(plan, policy)


def track(
    robot: Robot, start: npt.ArrayLike, controls: npt.ArrayLike, dt: float, *, feedback: bool = True
) -> ls.Solution:
    """The plan of given controls from a start, with a time-varying LQR about it, or without feedback."""
    dynamics, controls = robot.dynamics, np.asarray(controls, dtype=float)
    states = [np.asarray(start, dtype=float)]
    for control in controls:
        states.append(dynamics.step(states[-1], control, dt))
    plan = ls.Trajectory(np.array(states), controls, dt)
    if not feedback:
        return open_loop(dynamics, plan)
    (steps, m), n = controls.shape, len(states[0])
    value, gain = np.eye(n), np.zeros((steps, m, n))
    for t in reversed(range(steps)):
        a, b, _ = dynamics.linearize(states[t], controls[t], dt)
        gain[t] = -np.linalg.solve(b.T @ value @ b + np.eye(m), b.T @ value @ a)
        value = np.eye(n) + a.T @ value @ (a + b @ gain[t])
    policy = ls.AffinePolicy(
        gain=gain, offset=controls - np.einsum("tmn,tn->tm", gain, plan.states[:-1]), nominal=plan.states[:-1], dt=dt,
        state_coordinates=dynamics.state_coordinates, control_coordinates=dynamics.control_coordinates,
    )  # fmt: skip
    return by_hand(plan, policy)


def funnel_by_hand(
    solution: ls.Solution, shape: npt.ArrayLike, *, knots: Sequence[int] = (0,), levels: Sequence[float] = (1.0,)
) -> ls.types.Funnel:
    """Of the first d states, with one shape (d, d) or one per knot (T+1, d, d)."""
    shape, space = np.asarray(shape, dtype=float), solution.policy.state_coordinates
    tried = 1000 * (np.asarray(levels) > 0)  # enough to show any rate that is asked for
    return ls.types.Funnel(
        plan=solution.trajectory, state_coordinates=space, control_coordinates=solution.policy.control_coordinates,
        states=space.names[: shape.shape[-1]], family="given",
        shape=np.broadcast_to(shape, (solution.trajectory.steps + 1, *shape.shape[-2:])),
        knots=np.array(knots), levels=np.array(levels), trials=tried, successes=tried, reasons=("",) * len(knots),
        rate=0.9, confidence=0.95, simulated=1, policy_digest="", goal_radius=0.1, disturbances=(), seed=0,
    )  # fmt: skip


def weave(steps: int = 150) -> ls.Solution:
    """A drive to the left along the arena's wall, to and fro across the cut at heading pi."""
    turn = 0.05 * np.cos(np.arange(steps) / 6)
    return track(ls.DifferentialDrive(), (0.9, -2.5, np.pi), np.stack([0.08 - turn, 0.08 + turn], axis=1), 1 / 6)


def hover(steps: int = 60) -> ls.Solution:
    """A hover in the middle of the cage that rocks for two seconds."""
    robot, time = ls.Quadrotor(), np.arange(steps) / 30
    rock = 0.02 * np.sin(2 * np.pi * time)
    controls = robot.hover_force + np.stack([rock, -rock / 2, -rock, rock / 2], axis=1)
    return track(robot, np.zeros(12), controls, 1 / 30)
