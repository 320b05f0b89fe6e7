"""A point mass in the plane with constraints; its plans are checked against SciPy and the KKT conditions.

Its Runge-Kutta step is exact: positions and speeds are linear in the controls. Nothing of the solvers is used.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.solution_parts import Status

DT, RADIUS, MARGIN = 0.1, 0.2, 0.1


def mass(x, u, p):
    return [x[2], x[3], u[0], u[1]]


class Effort(ls.Constraint):
    """|u| <= most and power u'v <= `power`, written as a user may write it."""

    def __init__(self, most: float, power: float = 1e3) -> None:
        self.most, self.power = most, power

    def bind(self, dynamics: ls.Dynamics) -> ls.types.ConstraintTerm:
        source = """\
def value(x, u, t, row, data):
    if row == 0:
        return data[0] * data[0] - u[0] * u[0] - u[1] * u[1]
    return data[1] - x[2] * u[0] - x[3] * u[1]


def slope(x, u, t, row, data, gradient):
    for i in range(2):
        if row == 0:
            gradient[4 + i] -= 2 * u[i]
        else:
            gradient[2 + i] -= u[i]
            gradient[4 + i] -= x[2 + i]
"""
        numbers = np.array([self.most, self.power])
        return ls.types.ConstraintTerm(source, numbers, 2, lambda row: ("effort", "power")[row], uses_control=True)


def balls(*places: tuple[float, float, float], velocity: tuple[float, float] = (0.0, 0.0)) -> ls.World:
    """Balls at x, y with a radius, all with this velocity."""
    return ls.World(
        [ls.Obstacle(f"ball {i}", "sphere", np.array([x, y, 0.0]), np.eye(3), np.array([radius, 0, 0]),
                     velocity=np.array([*velocity, 0.0]))
         for i, (x, y, radius) in enumerate(places)]
    )  # fmt: skip


ONE = balls((0.0, 0.1, 0.5))


def problem(
    world: ls.World = ONE, *, weight: float = 0.0, margin: float = MARGIN, steps: int = 20, soft: bool = False,
    start: tuple[float, ...] = (-2, 0, 0, 0), goal: tuple[float, ...] = (2, 0, 0, 0), limit: float = 20.0,
    others: tuple[ls.Constraint, ...] = (),
) -> ls.Problem:  # fmt: skip
    """A way past the balls. Without an obstacle cost, only the constraint keeps it away from them."""
    dynamics = ls.Dynamics(
        mass, states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}, controls={"ax": "m/s^2", "ay": "m/s^2"},
        position=("x", "y"),
    )  # fmt: skip
    obstacles = ls.ObstacleCost(world, radius=RADIUS / 2, sharpness=10.0, weight=weight)
    return ls.Problem(
        dynamics=dynamics, dt=DT, steps=steps, control_limits=(-limit, limit),
        initial=ls.QuadraticCost([100.0] * 4, about=start) if soft else ls.FixedState(start),
        stage_cost=ls.ControlCost([0.1, 0.1], about=[0.0, 0.0]) + obstacles,
        final_cost=ls.QuadraticCost([100.0] * 4, about=goal),
        constraints=(ls.Clearance(world, radius=RADIUS, margin=margin), *others),
    )  # fmt: skip


class Oracle:
    """The same problem as a function of its unknowns: the controls, and with a soft start the first state."""

    def __init__(self, problem: ls.Problem) -> None:
        steps, self.soft = problem.steps, not isinstance(problem.initial, ls.FixedState)
        A = np.eye(4) + DT * np.eye(4, k=2)
        B = np.vstack([DT**2 / 2 * np.eye(2), DT * np.eye(2)])
        self.free = 4 * self.soft
        self.slopes = np.zeros((steps + 1, 4, self.free + 2 * steps))
        self.offset = np.zeros((steps + 1, 4))
        assert problem.start is not None
        self.slopes[0, :, : self.free], self.offset[0] = np.eye(4)[:, : self.free], problem.start * (not self.soft)
        for t in range(steps):
            self.slopes[t + 1], self.offset[t + 1] = A @ self.slopes[t], A @ self.offset[t]
            self.slopes[t + 1, :, self.free + 2 * t : self.free + 2 * t + 2] += B
        self.times = problem.begin + DT * np.arange(steps + 1)
        self.problem, self.limit = problem, problem.control_coordinates.high[0]

    def unpack(self, z: Array) -> tuple[Array, Array]:
        return self.slopes @ z + self.offset, z[self.free :].reshape(-1, 2)

    def pack(self, plan: ls.Trajectory) -> Array:
        z = np.concatenate([plan.states[0][: self.free], plan.controls.ravel()])
        np.testing.assert_allclose(self.unpack(z)[0], plan.states, rtol=0, atol=1e-9)
        return z

    def cost(self, z: Array) -> float:
        states, controls = self.unpack(z)
        goal, start = self.problem.goal, self.problem.start
        assert goal is not None
        total = 0.05 * (controls**2).sum() + 50 * ((states[-1] - goal) ** 2).sum()
        total += 50 * ((states[0] - start) ** 2).sum()
        for cost in self.problem.obstacle_costs:
            away = self.distances(states[1:-1], cost.world, self.times[1:-1]) - cost.radius
            total += cost.weight * np.exp(-10 * away).sum()
        return float(total)

    @staticmethod
    def distances(states: Array, world: ls.World, times: Array | float = 0.0) -> Array:
        """Distances to each ball, from its centre and size, at times (T,) in s."""
        places = np.array([ball.position[:2] for ball in world.obstacles]).reshape(-1, 2)
        velocities = np.array([ball.velocity[:2] for ball in world.obstacles]).reshape(-1, 2)
        centres = places + np.reshape(times, (-1, 1, 1)) * velocities
        sizes = np.array([ball.size[0] for ball in world.obstacles])
        return np.linalg.norm(states[:, None, :2] - centres, axis=2) - sizes

    def spare(self, z: Array) -> list[Array]:
        """Each constraint's values, which must not be negative, (T or T+1, rows)."""
        states, controls = self.unpack(z)
        values: list[Array] = []
        for one in self.problem.constraints:
            if isinstance(one, ls.Clearance):
                values.append(self.distances(states, one.world, self.times) - one.radius - one.margin)
            elif isinstance(one, Effort):
                square = one.most**2 - (controls**2).sum(axis=1)
                values.append(np.stack([square, one.power - (controls * states[:-1, 2:]).sum(axis=1)], axis=1))
        if values and not self.soft:
            values[0] = values[0][1:]  # a fixed start has no gradient
        return values

    def least(self, z: Array) -> float:
        """The optimum that SLSQP finds from z."""
        bounds = [(None, None)] * self.free + [(-self.limit, self.limit)] * (len(z) - self.free)
        kept = {"type": "ineq", "fun": lambda z: np.concatenate([np.zeros(0), *(one.ravel() for one in self.spare(z))])}
        options = {"maxiter": 300, "ftol": 1e-10}
        return minimize(self.cost, z, method="SLSQP", constraints=kept, bounds=bounds, options=options).fun

    def differences(self, function: Callable[[Array], Any], z: Array) -> Array:
        moves = 1e-6 * np.eye(len(z))
        return np.array([(function(z + move) - function(z - move)) / 2e-6 for move in moves])


def check(solution: ls.Solution, problem: ls.Problem, *, cost: float = 1e-3, spare: float = 1e-5) -> None:
    """Assert that a plan keeps the constraints and is first-order optimal, and that SLSQP saves `cost` at most."""
    oracle = Oracle(problem)
    z = oracle.pack(solution.trajectory)
    assert solution.status is Status.CONVERGED, solution.summary()
    assert solution.cost == pytest.approx(oracle.cost(z), rel=1e-9)
    values = oracle.spare(z)
    assert min(one.min(initial=np.inf) for one in values) >= -1e-12
    assert solution.violation == 0
    pull, scale = oracle.differences(oracle.cost, z), 0.0
    for k, (one, multipliers) in enumerate(zip(values, solution.multipliers, strict=True)):
        press = multipliers.values
        assert (press >= 0).all()
        first = len(press) - len(one) if k == 0 else 0
        acts = press[first : first + len(one)]
        assert np.count_nonzero(press) == np.count_nonzero(acts)  # none where there is no constraint
        assert one[acts > 0].max(initial=0.0) < 3 * spare  # only active constraints have multipliers
        slopes = oracle.differences(lambda z, k=k: oracle.spare(z)[k].ravel(), z)
        pull = pull - slopes @ acts.ravel()
        scale = max(scale, np.abs(slopes @ acts.ravel()).max())
    assert scale > 0
    inside = np.abs(z[oracle.free :]) < oracle.limit
    left = np.concatenate([pull[: oracle.free], pull[oracle.free :][inside]])
    assert np.abs(left).max() < 1e-2 * scale
    out = (pull[oracle.free :] * np.sign(z[oracle.free :]))[~inside]
    assert (out < 1e-2 * scale).all()
    assert solution.cost < oracle.least(z) * (1 + cost)
