"""What an iteration takes with noise, against one without."""

import time
from statistics import median
from typing import Any

from runner import table

import lqrsim as ls
from stochastic.common import Config, drive, gusts, jolts, quadrotor, rotors, slip

NOISES = {
    "drive, slip": (drive, slip(0.1), 0.0),
    "drive, displaced": (drive, jolts(0.004), 0.0),
    "drive, displaced, risk": (drive, jolts(0.004), 0.1),
    "quadrotor, rotors": (quadrotor, rotors(0.1), 0.0),
    "quadrotor, gusts": (quadrotor, gusts(0.02), 0.0),
    "quadrotor, gusts, risk": (quadrotor, gusts(0.02), 0.05),
}
SOLVERS = {
    "smoother": lambda problem: ls.smooth_many([problem] * 5, starts=1, threads=1, finish=None),
    "iLQR": lambda problem: ls.ilqr_many([problem] * 5, threads=1),
}


def measure(config: Config) -> dict[str, Any]:
    rows = []
    names = list(NOISES)[:1] if config.quick else list(NOISES)
    for name in names:
        stated, noise, risk = NOISES[name]
        for solver in list(SOLVERS)[:1] if config.quick or risk else SOLVERS:  # iLQR's first plans risk too much
            plain, noisy = stated(), stated().driven_by(noise, risk)
            each = [(iteration(solver, plain), iteration(solver, noisy)) for _ in range(config.rounds + 1)][1:]
            rows.append({"name": name, "solver": solver, "ratio": median(b / a for a, b in each)})
    return {"rows": rows, "rounds": config.rounds}


def iteration(solver: str, problem: ls.Problem) -> float:
    """Seconds of the processor that an iteration takes, on one thread: what else runs does not count."""
    clock = time.process_time()
    solutions = SOLVERS[solver](problem)
    return (time.process_time() - clock) / sum(len(one.iterations) for one in solutions)


def report(found: dict[str, Any]) -> list[str]:
    rows = [[f"{one['name']}, {one['solver']}", f"{one['ratio']:.2f}"] for one in found["rows"]]
    return [
        "Time of the processor, of an iteration with noise over one without: one thread, one start, by turns, medians"
        f" of {found['rounds']}.",
        table(("noise, solver", "times"), rows),
    ]
