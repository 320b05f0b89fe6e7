"""lqrsim against the C++ reference, and symbolic dynamics against the same by hand: time of an iteration."""

import dataclasses
import importlib.util
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from peers import Unavailable

import lqrsim as ls
from solver_benchmark import by_hand
from solver_benchmark.common import (
    MANY,
    PRIMAL,
    TARGETS,
    Config,
    judge,
    make_batches,
    make_problems,
    median,
    take_turns,
)


@dataclass(frozen=True)
class Turn:
    """A few queries solved: seconds of the whole call and of the iterations alone; of each query, iterations, cost."""

    seconds: float
    loop: float
    iterations: list[int]
    costs: list[float]


SOLVERS = MANY | PRIMAL
# Whose time is divided by whose.
PAIRS = ("symbolic / reference", "symbolic / by hand", "compiled level / symbolic")


def measure(config: Config) -> dict[str, Any]:
    """Both solvers, symbolic and by hand, and the reference; the latter says why if it is not there."""
    problems = make_problems(config)
    symbolic = problems[0].dynamics
    restated = {"by hand": by_hand.inlined(symbolic), "compiled level": by_hand.compiled_level(symbolic)}
    differences = [by_hand.check(symbolic, dynamics) for dynamics in restated.values()]
    result: dict[str, Any] = {"derivative_difference": max(differences)}
    stated = {"symbolic": problems}
    for name, dynamics in restated.items():
        stated[name] = [dataclasses.replace(problem, dynamics=dynamics) for problem in problems]
    try:
        reference = load_reference(config)
    except Unavailable as error:
        reference = None
        result["reference"] = {"skipped": str(error)}

    def ours(solver: str, queries: list[ls.Problem]) -> Callable[[slice], Turn]:
        def run(batch: slice) -> Turn:
            clock = time.perf_counter()
            solutions = SOLVERS[solver](queries[batch], threads=1, stop="cost")
            seconds = time.perf_counter() - clock
            loop = sum(iteration.seconds for solution in solutions for iteration in solution.iterations)
            counts = [len(solution.iterations) for solution in solutions]
            return Turn(seconds, loop, counts, [solution.cost for solution in solutions])

        return run

    for solver in SOLVERS:
        # In the primal form nothing is restated; and a quick run is not to compile six solvers, but two.
        both = solver == "ilqr" if config.quick else solver in MANY
        contestants = {name: ours(solver, one) for name, one in stated.items() if name == "symbolic" or both}
        if reference is not None:
            contestants["reference"] = _reference_turn(reference, solver, config)
        for run in contestants.values():
            run(slice(0, 1))  # compile
        turns = take_turns(contestants, make_batches(config), config.rounds, f"speed, {solver}")
        result[solver] = _compare(turns)
    return result


def _compare(turns: Mapping[str, list[list[Turn]]]) -> dict[str, Any]:
    """Medians over the turns of the time of an iteration, and of its ratios."""
    found: dict[str, Any] = {}
    for name, jobs in turns.items():
        found[name] = {
            "iterations": [count for rounds in jobs for count in rounds[0].iterations],
            "cost": [cost for rounds in jobs for cost in rounds[0].costs],
            "milliseconds": 1e3 * median(t.seconds / sum(t.iterations) for rounds in jobs for t in rounds),
            "milliseconds_loop": 1e3 * median(t.loop / sum(t.iterations) for rounds in jobs for t in rounds),
        }

    def ratio(one: str, other: str, part: str) -> float:
        pairs = zip(*([turn for rounds in turns[name] for turn in rounds] for name in (one, other)), strict=True)
        return median(getattr(a, part) / sum(a.iterations) / (getattr(b, part) / sum(b.iterations)) for a, b in pairs)

    for pair in PAIRS:
        one, other = pair.split(" / ")
        if one in turns and other in turns:
            found[pair] = ratio(one, other, "seconds")
            found[f"{pair}, loop"] = ratio(one, other, "loop")
    if "reference" in turns:
        found["same_iterations"] = found["symbolic"]["iterations"] == found["reference"]["iterations"]
        costs = np.array([found[name]["cost"] for name in ("symbolic", "reference")])
        found["cost_difference"] = float(np.abs(costs[0] / costs[1] - 1).max())
    return found


def _reference_turn(reference: ModuleType, solver: str, config: Config) -> Callable[[slice], Turn]:
    starts, goals = ls.scenarios.quadrotor_queries(config.queries, seed=config.seed)
    # The prior is a hint to the smoother; lqrsim's iLQR has none.
    name, prior = ("ilqr", 0.0) if solver == "ilqr" else ("smoother", 0.3)

    def run(batch: slice) -> Turn:
        iterations, costs, seconds = reference.solve(starts[batch], goals[batch], name, prior=prior)
        # Its iLQR logs the cost of the first rollout too, before the iterations.
        last = iterations if solver == "ilqr" else iterations - 1
        return Turn(seconds, seconds, iterations.tolist(), [costs[i, k] for i, k in enumerate(last)])

    return run


def reference_folder(given: Path | None) -> Path:
    """Where the reference is: as told, or else named by the environment, or beside the repository."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "reference"
    return given or Path(os.environ.get("LQRSIM_REFERENCE") or beside)


def load_reference(config: Config) -> ModuleType:
    """The module reference.py, compiled and ready."""
    path = reference_folder(config.reference) / "reference.py"
    if not path.is_file():
        raise Unavailable("no reference.py there: name its folder with --reference or LQRSIM_REFERENCE")
    if shutil.which("g++") is None:
        raise Unavailable("g++ is not installed, which compiles the reference")
    specification = importlib.util.spec_from_file_location("lqrsim_reference", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    try:
        module.library()
    except (OSError, subprocess.CalledProcessError) as error:
        raise Unavailable(f"the reference does not compile: {error}") from None
    return module


def report(found: dict[str, Any]) -> list[str]:
    rows = [f"speed, one thread: {'ms/iteration':>22} {'in the loop':>12} {'iterations':>11} {'mean cost':>10}"]
    for solver in SOLVERS:
        for name in ("reference", "symbolic", "by hand", "compiled level"):
            if name in found[solver]:
                one = found[solver][name]
                rows.append(
                    f"  {solver:<8} {name:<16} {one['milliseconds']:>12.3f} {one['milliseconds_loop']:>12.3f}"
                    f" {np.mean(one['iterations']):>11.2f} {np.mean(one['cost']):>10.3f}"
                )
    for solver in SOLVERS:
        for pair in PAIRS:
            if pair in found[solver]:
                ratio, loop = found[solver][pair], found[solver][f"{pair}, loop"]
                target = pair if pair in TARGETS else f"{solver} / {pair.split(' / ')[1]}"
                verdict = judge(ratio, target) if target in TARGETS else ""
                rows.append(f"  {solver:<8} {pair:<26} {ratio:>6.3f}  (loop alone {loop:.3f})  {verdict}".rstrip())
        if "same_iterations" in found[solver]:
            same = "the same" if found[solver]["same_iterations"] else "DIFFERENT"
            rows.append(
                f"  {solver:<8} iterations are {same} as the reference's in each query, costs differ by"
                f" {found[solver]['cost_difference']:.1e} at most"
            )
    if "reference" in found:
        rows.append(f"  reference: skipped: {found['reference']['skipped']}")
    return ["\n".join(rows)]
