"""What the projection of the obstacle term costs in convergence, worked out at the optimum, without a solver.

A step of Gauss-Newton from an error d about an optimum leaves `(I - M^-1 H) d`, where H is the true Hessian of the cost
over all controls, and the start where that is free, and M the Hessian of the model. They differ by the curvature of
the dynamics and by what the projection threw away. With the latter alone, -D, the largest eigenvalue of M^-1 D is the
factor of the error, and its square that of the cost.
"""

import numpy as np
from peers import truth
from peers.common import Parts, parts

import lqrsim as ls
from lqrsim.errors import Array


def discarded(problem: ls.Problem, plan: ls.Trajectory, *, fixed: bool) -> float:
    """The factor by which a step of Gauss-Newton lowers the error in cost about a plan, for what is thrown away alone.

    Args:
      fixed: the start is given, whatever the problem's initial cost says.
    """
    told, place = parts(problem), list(problem.dynamics.state_coordinates.position)
    (n, m), steps = (plan.states.shape[1], plan.controls.shape[1]), plan.steps
    first = 0 if fixed else n
    values, axes = np.linalg.eigh(_obstacle_curvature(told, plan.states[1:-1, place]))  # at 0 it does not act
    slopes = np.zeros((steps + 1, n, first + steps * m))  # of each state, by the start and all controls
    slopes[0, :, :first] = np.eye(n)[:, :first]
    model = np.kron(np.eye(steps), told.control_weight)
    model = np.pad(model, ((first, 0), (first, 0)))
    if not fixed:
        assert isinstance(problem.initial, ls.QuadraticCost)
        model[:first, :first] = problem.initial.weight
    for t in range(steps):
        a, b, _ = problem.dynamics.linearize(plan.states[t], plan.controls[t], problem.dt)
        slopes[t + 1] = a @ slopes[t]
        slopes[t + 1, :, first + t * m : first + (t + 1) * m] = b
    model += slopes[-1].T @ told.final_weight @ slopes[-1]
    along = np.einsum("tij,tik->tjk", axes, slopes[1:-1, place])  # by how much each principal axis is moved along
    kept, lost = (np.sqrt(np.maximum(sign * values, 0))[:, :, None] * along for sign in (1, -1))
    kept, lost = kept.reshape(-1, kept.shape[-1]), lost[values < 0]
    model += kept.T @ kept
    if not len(lost):
        return 0.0
    return float(np.linalg.eigvalsh(lost @ np.linalg.solve(model, lost.T))[-1] ** 2)


def _obstacle_curvature(told: Parts, places: Array) -> Array:
    """Second differences (P, d, d) of the obstacle term at places (P, d)."""
    size, h = places.shape[1], 1e-4
    step = h * np.eye(size)

    def term(points: Array) -> Array:
        return told.obstacle_weight * np.exp(-told.sharpness * (truth.distances(told.world, points) - told.radius)).sum(
            axis=1
        )

    found = np.empty((len(places), size, size))
    for i in range(size):
        for j in range(size):
            corners = [a * b * term(places + a * step[i] + b * step[j]) for a in (1, -1) for b in (1, -1)]
            found[:, i, j] = sum(corners) / (4 * h**2)
    return found
