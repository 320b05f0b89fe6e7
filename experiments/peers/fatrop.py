"""Fatrop through CasADi: an interior-point method for problems in stages, as a careful user of CasADi sets it up.

The states at t = 0..T and all controls are variables, one stage after the other. The Runge-Kutta steps and the given
start are equality constraints, the limits of the controls are bounds; CasADi finds the stages itself. The functions of
a step are those that IPOPT gets, with exact derivatives, written as C and compiled with -O3 -march=native (some 15
seconds, kept on disk). Fatrop is used as the wheel has it, on one thread. The problem is built once and used for all
queries; start and goal are parameters.

Each solve begins with a plan that is nearly optimal, so the barrier begins low. Fatrop's tolerance is of the residuals
of the optimality conditions; the number is the one that lqrsim and FDDP have.
"""

from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim.errors import Array
from peers import ipopt
from peers.common import Answer, Parts, ends, parts

TOLERANCE, MAX_ITERATIONS = 1e-4, 500
BARRIER = 1e-4  # at the start; Fatrop's own 0.1 takes an iteration more from such a plan


class Fatrop:
    """Fatrop for problems that differ in their start and goal only.

    Args:
      problem: one of them, of either robot and in any world, with the limits of its controls and no constraints.

    Raises:
      Unavailable: CasADi or g++ is not installed.
      NotImplementedError: the problem is of another make.
    """

    def __init__(self, problem: ls.Problem) -> None:
        if problem.constraints:
            raise NotImplementedError(f"the constraints {problem.constraints}")
        ca, told, space = ipopt.casadi(), parts(problem), problem.control_coordinates
        self._states = n = len(told.goal)
        bounds = []
        for limits, beyond in ((space.low, -np.inf), (space.high, np.inf)):
            stage = np.append(np.full(n, beyond), limits)
            bounds.append(ca.DM(np.append(np.tile(stage, problem.steps), np.full(n, beyond))))
        self._limits = {"lbx": bounds[0], "ubx": bounds[1], "lbg": 0.0, "ubg": 0.0}
        options = {"print_level": 0, "max_iter": MAX_ITERATIONS, "tol": TOLERANCE, "mu_init": BARRIER}
        structure = {"structure_detection": "auto", "equality": [True] * (n * (problem.steps + 1))}
        self._solver = ipopt.solver("fatrop", _nlp(problem, told), {"fatrop": options, **structure}, compile=True)

    def from_trajectory(self, problem: ls.Problem, states: Array, controls: Array) -> Answer:
        """Solve from states (T+1, n) and controls (T, m), whether or not they belong together."""
        n = self._states
        guess = np.append(np.hstack([states[:-1], controls]), states[-1])
        found = self._solver(x0=guess, p=np.concatenate(ends(problem)), **self._limits)
        values, stats = found["x"].full().ravel(), self._solver.stats()
        stages = values[:-n].reshape(problem.steps, -1)
        return Answer(
            states=np.vstack([stages[:, :n], values[-n:]]),
            controls=stages[:, n:].copy(),
            cost=float(found["f"]),
            iterations=stats["iter_count"],
            converged=bool(stats["success"]),
        )


def _nlp(problem: ls.Problem, told: Parts) -> dict[str, Any]:
    """Variables x0, u0, x1, u1 ... xT; constraints stage by stage, the given start after the first step."""
    ca, steps = ipopt.casadi(), problem.steps
    n, m = len(told.goal), len(told.nominal)
    step, effort, obstacles, arrival, _ = ipopt.functions(problem, told)
    stages, last = ca.MX.sym("w", n + m, steps), ca.MX.sym("last", n)
    start, goal = ca.MX.sym("start", n), ca.MX.sym("goal", n)
    states, controls = stages[:n, :], stages[n:, :]
    cost = ca.sum2(effort.map(steps)(controls)) + arrival(last, goal)
    if steps > 1:
        cost += ca.sum2(obstacles.map(steps - 1)(states[:, 1:]))
    gaps = ca.horzcat(states[:, 1:], last) - step.map(steps)(states, controls)
    g = ca.vertcat(gaps[:, 0], states[:, 0] - start, ca.vec(gaps[:, 1:]))
    return {"x": ca.vertcat(ca.vec(stages), last), "p": ca.vertcat(start, goal), "f": cost, "g": g}
