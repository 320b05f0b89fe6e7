"""Time and memory of an iteration as the states and the horizon grow."""

import dataclasses
import math
import os
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any
from unittest import mock

import numpy as np
from runner import progress

import lqrsim as ls
from solver_benchmark.common import MANY, Config, median

# As many iterations as are asked for, and no safeguard that goes on after.
SOLVERS: dict[str, Callable[..., ls.Solution]] = {
    "smooth": partial(ls.smooth, safeguard=False, finish=None),
    "ilqr": ls.ilqr,
}


def measure(config: Config) -> dict[str, Any]:
    """Both solvers on chains of masses: more of them, and more steps."""
    masses = (1,) if config.quick else (1, 2, 4, 8, 16)
    steps = (1000, 3000, 10_000) if config.quick else (1000, 3000, 10_000, 30_000, 100_000)
    result: dict[str, Any] = {"states": [], "steps": []}
    for count in progress(masses, "scaling, states"):
        problem = chain_of_masses(count)
        for solver in ("smooth", "ilqr"):
            with tempfile.TemporaryDirectory() as folder:
                # To compile takes long, so a quick run may use what is cached.
                nothing_cached = {} if config.quick else {"LQRSIM_CACHE_DIR": folder}
                with mock.patch.dict(os.environ, nothing_cached):
                    clock = time.perf_counter()
                    SOLVERS[solver](problem, max_iterations=1)
                    compiling = time.perf_counter() - clock
            seconds = _iteration_seconds(solver, problem, 10, config.rounds)
            result["states"].append(
                {"solver": solver, "states": 3 * count, "first_call_seconds": compiling, "milliseconds": 1e3 * seconds}
            )
    for count in progress(steps, "scaling, steps"):
        problem = dataclasses.replace(chain_of_masses(1 if config.quick else 4), steps=count)
        for solver in ("smooth", "ilqr"):
            seconds = _iteration_seconds(solver, problem, 3, config.rounds)
            solve = partial(SOLVERS[solver], problem, max_iterations=3, stop="cost")
            result["steps"].append(
                {
                    "solver": solver,
                    "states": len(problem.dynamics.state_coordinates),
                    "steps": count,
                    "milliseconds": 1e3 * seconds,
                    "bytes": _peak_bytes(solve),
                }
            )
    return result


def _iteration_seconds(solver: str, problem: ls.Problem, iterations: int, rounds: int) -> float:
    """Median time of the iterations between: the first meets untouched memory, the last works out the optimality."""
    seconds: list[float] = []
    for _ in range(rounds):
        solution = SOLVERS[solver](problem, max_iterations=iterations, stop="cost", tolerance=1e-300)
        if not math.isfinite(solution.cost):
            raise AssertionError(f"{solver}, {problem.steps} steps: {solution.status}")
        seconds += [iteration.seconds for iteration in solution.iterations[1:-1]]
    return median(seconds)


def _peak_bytes(run: Callable[[], object]) -> int:
    """The most memory that Python and NumPy take while it runs, what it returns included; compiled code takes none."""
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        run()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


def chain_of_masses(count: int) -> ls.Problem:
    """Masses in a row, the first on a wall, held by springs that harden; a lagging force acts on each. 3 states each.

    All are to move by 0.5 m.
    """
    names = (("place", "m"), ("speed", "m/s"), ("force", "N"))
    dynamics = ls.Dynamics(
        _chain_rate,
        states={f"{kind}_{i}": unit for kind, unit in names for i in range(1, count + 1)},
        controls={f"command_{i}": "N" for i in range(1, count + 1)},
        parameters={"mass": 1.0, "stiffness": 2.0, "hardening": 0.5, "drag": 0.2, "lag": 0.1},
    )
    start, goal = np.zeros(3 * count), np.zeros(3 * count)
    goal[:count] = 0.5
    return ls.Problem(
        dynamics=dynamics,
        dt=0.05,
        steps=150,
        initial=ls.QuadraticCost(np.full(3 * count, 500.0), about=start),
        stage_cost=ls.ControlCost(np.ones(count), about=np.zeros(count)),
        final_cost=ls.QuadraticCost(np.full(3 * count, 500.0), about=goal),
    )


def _chain_rate(x: Any, u: Any, p: Any) -> list[Any]:
    count = len(u)
    place, speed, force = x[:count], x[count : 2 * count], x[2 * count :]
    stretch = [place[0], *(b - a for a, b in pairwise(place))]
    pull = [p.stiffness * s + p.hardening * s**3 for s in stretch]
    pull.append(0)  # beyond the last there is nothing
    acceleration = [(force[i] - p.drag * speed[i] - pull[i] + pull[i + 1]) / p.mass for i in range(count)]
    return [*speed, *acceleration, *((u[i] - force[i]) / p.lag for i in range(count))]


def report(found: dict[str, Any]) -> list[str]:
    rows = [f"scaling: {'states':>8} {'ms/iteration':>13} {'grows as n to the':>18} {'first call s':>13}   (150 steps)"]
    for solver in MANY:
        lines = [line for line in found["states"] if line["solver"] == solver]
        for before, line in zip([None, *lines], lines, strict=False):
            power = "" if before is None else f"{_power(before, line, 'states', 'milliseconds'):.2f}"
            rows.append(
                f"  {solver:<7} {line['states']:>7} {line['milliseconds']:>13.3f} {power:>18}"
                f" {line['first_call_seconds']:>13.1f}"
            )
    rows.append(f"         {'steps':>8} {'ms/iteration':>13} {'us/step':>18} {'MB':>13} {'bytes/step':>11}")
    for solver in MANY:
        lines = [line for line in found["steps"] if line["solver"] == solver]
        for line in lines:
            rows.append(
                f"  {solver:<7} {line['steps']:>7} {line['milliseconds']:>13.2f}"
                f" {1e3 * line['milliseconds'] / line['steps']:>18.3f} {line['bytes'] / 1e6:>13.1f}"
                f" {line['bytes'] / line['steps']:>11.0f}   ({line['states']} states)"
            )
        powers = [_power(lines[0], lines[-1], "steps", what) for what in ("milliseconds", "bytes")]
        rows.append(f"  {solver:<7} time grows as T to the {powers[0]:.2f}, memory as T to the {powers[1]:.3f}")
    return ["\n".join(rows)]


def _power(a: dict[str, Any], b: dict[str, Any], along: str, what: str) -> float:
    return math.log(b[what] / a[what]) / math.log(b[along] / a[along])
