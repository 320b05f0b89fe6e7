"""Check the claims of solutions, on whole problems drawn at random and on a user's own robot.

    python tests/tools/benchmark_claims.py                         # 10,000 problems, some 6 minutes on two cores
    python tests/tools/benchmark_claims.py --sections planar       # some of it
    python tests/tools/benchmark_claims.py --quick                 # bounded, and too few to trust

Every claim is held against the problem alone, by whole_problems/claims.py, which shares nothing with the solvers.

drawn        Random systems with fixed and soft starts, limits, constraints, warm starts, few and many iterations.
planar       A planar quadrotor that has to get over a wall: 60 starts and goals, with a clearance and without, and for
             each sharpness of its ObstacleCost; to an optimality of 1e-8.
known        Problems of which the answer is known beforehand, whole_problems/known.py: 100 of each kind.
families     Families in which solvers mislead, whole_problems/families.py: given starts, saddles, saturating and flat
             costs, overflow, scales, least time, contacts; against dense derivatives, whole_problems/dense.py.
certificate  What the certificate costs of a solve, on the paper's queries and on warm starts.
"""

import itertools
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, get_args
from unittest.mock import patch

import numpy as np
from tqdm import tqdm

import lqrsim as ls
from lqrsim.machine import processors
from lqrsim.solvers import augmented_lagrangian, finish, strategy
from lqrsim.solvers.certify import certified
from lqrsim.solvers.engine import RunResult, SolveRun

sys.path.append(str(Path(__file__).parents[2] / "experiments"))  # has the runner, the systems and the independent judge

from oracle import planar_quadrotor
from runner import Result, Settings, at_most, opening, run
from whole_problems import dense, families, known
from whole_problems.claims import contradictions
from whole_problems.draws import KINDS, draw, solve

SHARPNESS = (5.0, 10.0, 20.0, 40.0)  # 1/m, of the cost of obstacles

Section = Literal["drawn", "planar", "known", "families", "certificate"]


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    sections: tuple[Section, ...] = get_args(Section)
    """What to measure."""
    problems: int = 10_000
    """How many random problems at least, of all kinds together; of each kind as many."""
    kinds: tuple[str, ...] = tuple(KINDS)
    """Of random problems."""
    seed: int = 0
    """Of the random problems."""
    members: int = 2_000
    """How many problems of families at least, of all together; of each family as many."""
    queries: int = 100
    """How many of the quadrotor's for what the certificate costs."""


def main(config: Config) -> Result:
    config = at_most(config, problems=110, members=80, queries=10)
    sections = {"drawn": _drawn, "planar": _planar, "known": _known, "families": _families, "certificate": _certificate}
    result = opening(config)
    for name in config.sections:
        result[name] = sections[name](config)
    return result


def look(kind: str, number: int, seed: int) -> tuple[list[str], list[str]]:
    """The statuses of a draw's solutions, and their false claims."""
    drawn = draw(kind, number, seed=seed)
    solutions = solve(drawn)
    false = [
        f"{drawn} (seed {seed}), {solution.status.name}: {wrong}"
        for solution in solutions
        for wrong in contradictions(drawn.problem, solution, drawn.rate)
    ]
    return [solution.status.name for solution in solutions], false


def _look_at(task: tuple[str, int, int]) -> tuple[str, list[str], list[str]]:
    return task[0], *look(*task)


def _drawn(config: Config) -> dict[str, Any]:
    each = -(-config.problems // len(config.kinds))  # at least as many as asked for, of each kind as many
    tasks = [(kind, number, config.seed) for number in range(each) for kind in config.kinds]
    statuses, false = {kind: Counter[str]() for kind in config.kinds}, list[str]()
    # One after the other, so that each kind is compiled once before all begin.
    for kind in tqdm(config.kinds, desc="compiling", leave=False, disable=None):
        draw(kind, 0, seed=config.seed)
        look(kind, 0, config.seed)
    with tqdm(total=len(tasks), desc="drawn", disable=None) as bar:
        for kind, ended, wrong in _on_all_processors(_look_at, tasks):
            statuses[kind].update(ended)
            false += wrong
            bar.update()
    return {"problems": len(tasks), "statuses": statuses, "false": false}


Task = tuple[str, int, int]
Judged = tuple[str, list[str], list[str]]


def _on_all_processors(judge: Callable[[Task], Judged], tasks: list[Task]) -> Iterator[Judged]:
    with ProcessPoolExecutor(processors(), mp_context=get_context("spawn")) as pool:
        yield from pool.map(judge, tasks, chunksize=20)


def _judge(task: Task) -> Judged:
    """The status and curvature of a member of a family, and what misleads."""
    kind, number, seed = task
    case = families.draw(kind, number, seed=seed)
    solution = ls.smooth(case.problem, start=case.given, threads=1)
    false = [f"{case} (seed {seed}): {wrong}" for wrong in dense.contradictions(case, solution)]
    return kind, [f"{solution.status.name}, {solution.curvature}"], false


def _families(config: Config) -> dict[str, Any]:
    each = -(-config.members // len(families.KINDS))
    tasks = [(kind, number, config.seed) for number in range(each) for kind in families.KINDS]
    statuses, false = {kind: Counter[str]() for kind in families.KINDS}, list[str]()
    for kind in tqdm(families.KINDS, desc="compiling", leave=False, disable=None):
        _judge((kind, 0, config.seed))
    with tqdm(total=len(tasks), desc="families", disable=None) as bar:
        for kind, ended, wrong in _on_all_processors(_judge, tasks):
            statuses[kind].update(ended)
            false += wrong
            bar.update()
    return {"problems": len(tasks), "statuses": statuses, "false": false}


def _planar(config: Config) -> dict[str, Any]:
    count = 6 if config.quick else 60
    result: dict[str, Any] = {}
    for clearance, sharpness in itertools.product((False, True), SHARPNESS):
        rng = np.random.default_rng(config.seed)
        problems = [planar_quadrotor.draw(rng, clearance=clearance, sharpness=sharpness) for _ in range(count)]
        clock = time.perf_counter()
        solutions = ls.smooth_many(problems, tolerance=1e-8, constraint_tolerance=1e-6)
        seconds = time.perf_counter() - clock
        away = [
            one.trajectory.states[-1][:2] - _goal(problem)[:2] for problem, one in zip(problems, solutions, strict=True)
        ]
        iterations = [len(solution.iterations) for solution in solutions]
        result[f"{'with' if clearance else 'without'} a clearance, sharpness {sharpness:g}"] = {
            "solved": sum(solution.status.name == "CONVERGED" for solution in solutions),
            "problems": count,
            "at_goal": sum(float(np.linalg.norm(one)) <= planar_quadrotor.RADIUS for one in away),
            "false": [wrong for pair in zip(problems, solutions, strict=True) for wrong in contradictions(*pair)],
            "median": statistics.median(iterations),
            "most": max(iterations),
            "cost": statistics.median(solution.cost for solution in solutions),
            "seconds": seconds,
        }
    return result


def _known(config: Config) -> dict[str, Any]:
    count, result = 10 if config.quick else 100, dict[str, Any]()
    for kind in known.KINDS:
        ended, wrong = Counter[str](), list[str]()
        for number in tqdm(range(count), desc=kind, leave=False, disable=None):
            drawn = known.draw(kind, number, seed=config.seed)
            solution = ls.smooth(drawn.problem, start=drawn.start, threads=1)
            ended[f"{solution.status.name}, {'with' if drawn.possible else 'without'} a plan"] += 1
            says = [*known.false(drawn, solution), *contradictions(_settled(drawn.problem, solution), solution)]
            wrong += [f"{kind} {number} (seed {config.seed}): {one}" for one in says]
        result[kind] = {"problems": count, "statuses": ended, "false": wrong}
    return result


def _settled(problem: ls.Problem, solution: ls.Solution) -> ls.Problem:
    """With the solution's duration, where that was free."""
    if problem.duration is None:
        return problem
    return replace(problem, dt=solution.trajectory.dt, duration=None, time_weight=0.0)


def _goal(problem: ls.Problem) -> np.ndarray:
    assert problem.goal is not None
    return problem.goal


def _certificate(config: Config) -> dict[str, Any]:
    """Each query solved with and without the certificate, in turns, on one thread."""
    problems = [ls.scenarios.quadrotor(query=query).problem for query in range(config.queries)]
    problems = [
        replace(problem, initial=ls.FixedState(problem.start)) for problem in problems if problem.start is not None
    ]
    spent = 0.0

    def timed(run: SolveRun, found: RunResult) -> RunResult:
        nonlocal spent
        clock = time.perf_counter()
        answer = certified(run, found)
        spent += time.perf_counter() - clock
        return answer

    shares: dict[str, list[float]] = {"search": [], "hover": [], "warm": []}
    with ExitStack() as stack:
        for module in (augmented_lagrangian, finish, strategy):
            stack.enter_context(patch.object(module, "certified", timed))
        for problem in tqdm(problems, desc="certificate", leave=False, disable=None):
            solution = ls.smooth(problem, threads=1)
            starts = {"search": None, "hover": problem.nominal_control, "warm": solution.shifted(1)}
            for name, start in starts.items():
                spent, clock = 0.0, time.perf_counter()
                ls.smooth(problem, start=start, threads=1)
                shares[name].append(spent / (time.perf_counter() - clock))
    return {name: statistics.median(values) for name, values in shares.items()}


def report(result: dict[str, Any]) -> str:
    lines = []
    for section, what in (("drawn", "problems drawn"), ("families", "problems of families")):
        if drawn := result.get(section):
            lines.append(f"{drawn['problems']} {what}: {len(drawn['false'])} false claims")
            for kind, counts in drawn["statuses"].items():
                ended = "; ".join(f"{count} {status}" for status, count in Counter(counts).most_common())
                lines.append(f"  {kind:<12} {ended}")
            lines += [f"  FALSE: {wrong}" for wrong in drawn["false"]]
    for name, row in result.get("planar", {}).items():
        lines.append(
            f"planar quadrotor, {name}: {row['solved']} of {row['problems']} converged, {row['at_goal']} at the goal,"
            f" {len(row['false'])} false claims; iterations {row['median']:g} in the median, {row['most']} at most;"
            f" median cost {row['cost']:.4g}; {row['seconds']:.1f} s"
        )
        lines += [f"  FALSE: {wrong}" for wrong in row["false"]]
    for kind, row in result.get("known", {}).items():
        ended = "; ".join(f"{count} {how}" for how, count in Counter(row["statuses"]).most_common())
        lines.append(f"known, {kind}: {row['problems']} problems, {len(row['false'])} false claims: {ended}")
        lines += [f"  FALSE: {wrong}" for wrong in row["false"]]
    if certificate := result.get("certificate"):
        shares = ", ".join(f"{100 * share:.1f} % ({name})" for name, share in certificate.items())
        lines.append(f"the certificate's share of a solve, in the median: {shares}")
    return "\n".join(lines)


def failures(result: Result) -> list[str]:
    rows = [
        *(result.get(name, {"false": []}) for name in ("drawn", "families")),
        *result.get("planar", {}).values(),
        *result.get("known", {}).values(),
    ]
    return [false for row in rows for false in row["false"]]


if __name__ == "__main__":
    run(Config, main, report, __doc__, failures=failures)
