"""lqrsim against other people's solvers: time of a query, and what the plan costs from a start given exactly."""

import dataclasses
import time
from collections import namedtuple
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import peers

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.costs import terms_of
from solver_benchmark.by_hand import compiled, quadrotor_rate
from solver_benchmark.common import MANY, PAPER, Config, make_problems, median, take_turns


@dataclass(frozen=True)
class Solved:
    """One query: seconds of the whole call, iterations, whether it converged, and the controls: u = gain x + offset."""

    seconds: float
    iterations: int
    converged: bool
    gain: Array
    offset: Array
    cost: float
    """As the solver has it."""


def measure(config: Config) -> dict[str, Any]:
    """Query by query: lqrsim's solvers and Crocoddyl's, and what the plan of each costs from the given start."""
    # All from exactly the same start.
    problems = [exactly(problem) for problem in make_problems(config)]
    crocoddyl = peers.Crocoddyl(problems[0])

    def ours(solver: Callable[..., list[ls.Solution]], stop: str = "cost") -> Callable[[ls.Problem], Solved]:
        def run(problem: ls.Problem) -> Solved:
            clock = time.perf_counter()
            (solution,) = solver([problem], threads=1, stop=stop)
            seconds, policy = time.perf_counter() - clock, solution.policy
            return Solved(
                seconds, len(solution.iterations), solution.success, policy.gain, policy.offset, solution.cost
            )

        return run

    def theirs(solve: Callable[[ls.Problem], peers.Answer]) -> Callable[[ls.Problem], Solved]:
        def run(problem: ls.Problem) -> Solved:
            clock = time.perf_counter()
            answer = solve(problem)
            seconds = time.perf_counter() - clock
            no_gain = np.zeros((*answer.controls.shape, answer.states.shape[1]))
            return Solved(seconds, answer.iterations, answer.converged, no_gain, answer.controls, answer.cost)

        return run

    contestants = {
        "smooth, hover": ours(MANY["smooth"]),
        "Newton, hover": ours(partial(PAPER, finish="newton"), "optimal"),
        "ilqr, hover": ours(MANY["ilqr"]),
        "FDDP, hover": theirs(crocoddyl.from_hover),
        "FDDP, line": theirs(crocoddyl.from_line),
    }
    for run in contestants.values():
        run(problems[0])  # compile
    turns = take_turns(contestants, problems, config.rounds, "peers")
    result: dict[str, Any] = {}
    for name, queries in turns.items():
        first = [rounds[0] for rounds in queries]
        costs = [true_cost(*pair) for pair in zip(problems, first, strict=True)]
        own = np.array([solved.cost for solved in first])
        seconds = [median(solved.seconds for solved in rounds) for rounds in queries]
        result[name] = {
            "converged": [solved.converged for solved in first],
            "iterations": [solved.iterations for solved in first],
            "cost": costs,
            "cost_difference": float(np.abs(own / costs - 1).max()),
            "milliseconds": [1e3 * value for value in seconds],
        }
    return result


def exactly(problem: ls.Problem) -> ls.Problem:
    """The same from the start that is asked for, given."""
    assert problem.start is not None
    return dataclasses.replace(problem, initial=ls.FixedState(problem.start))


def true_cost(problem: ls.Problem, solved: Solved) -> float:
    """What the policy costs from exactly the start that the problem asks for, in NumPy."""
    assert problem.start is not None
    p = namedtuple("Parameters", problem.dynamics.parameters)(**problem.dynamics.parameters)
    states, controls = _rollout(problem.start, solved.gain, solved.offset, p, problem.dt)
    total = 0.0
    for cost in terms_of(problem.stage_cost):
        if isinstance(cost, ls.ControlCost):
            off = controls - cost.about
            total += 0.5 * float(np.einsum("ti,ij,tj->", off, cost.weight, off))
        elif isinstance(cost, ls.ObstacleCost):
            distances = np.array([cost.world.distances(state[:3]) for state in states[1:-1]])
            total += cost.weight * float(np.exp(-cost.sharpness * (distances - cost.radius)).sum())
        else:
            raise NotImplementedError(type(cost).__name__)
    for cost in terms_of(problem.final_cost):
        assert isinstance(cost, ls.QuadraticCost)
        off = states[-1] - cost.about
        total += 0.5 * float(off @ cost.weight @ off)
    return total


@compiled
def _rollout(start, gain, offset, p, dt):
    """States (T+1, n) and controls (T, m) under the policy."""
    states = np.zeros((len(offset) + 1, len(start)))
    controls = np.zeros_like(offset)
    states[0] = start
    for t in range(len(offset)):
        x = states[t]
        u = gain[t] @ x + offset[t]
        first = np.array(quadrotor_rate(x, u, p))
        second = np.array(quadrotor_rate(x + 0.5 * dt * first, u, p))
        third = np.array(quadrotor_rate(x + 0.5 * dt * second, u, p))
        fourth = np.array(quadrotor_rate(x + dt * third, u, p))
        states[t + 1] = x + dt / 6 * (first + 2 * second + 2 * third + fourth)
        controls[t] = u
    return states, controls


def report(found: dict[str, Any]) -> list[str]:
    rows = [f"peers, one thread: {'converged':>9} {'iterations':>11} {'ms/query':>9} {'(mean)':>8} {'mean cost':>10}"]
    for name, one in found.items():
        solved = f"{sum(one['converged'])}/{len(one['converged'])}"
        rows.append(
            f"  {name:<16} {solved:>9} {np.mean(one['iterations']):>11.2f} {np.median(one['milliseconds']):>9.1f}"
            f" {np.mean(one['milliseconds']):>8.1f} {np.mean(one['cost']):>10.2f}"
        )
    rows.append("  ms/query is the median; costs are from exactly the given start, recomputed in the same way for all")
    return ["\n".join(rows)]
