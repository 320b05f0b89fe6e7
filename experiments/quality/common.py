"""What the sections share: what they are told, the problems, who solves them, what is recomputed, what is to be met."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import peers
from peers.contestants import Solve, all_iterations, installed
from reliability.common import fixed
from runner import Settings, at_most, progress
from solver_benchmark.speed import reference_folder
from tqdm import tqdm

import lqrsim as ls
from lqrsim.errors import Array

Section = Literal["starts", "time", "clearance", "limits", "worlds", "resolve", "ingredients", "finish"]
Found = dict[str, Any]

NONE = (-np.inf, np.inf)  # limits of the controls, for FDDP has none
ALL = 100  # queries of a seed that the targets of mean costs are for


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    sections: tuple[Section, ...] = get_args(Section)
    """What to measure."""
    queries: int = ALL
    """How many of the quadrotor's random starts and goals, of each seed."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the queries; where one will do, it is the first."""
    clearance_seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """The same where a clearance is kept."""
    rounds: int = 5
    """How often each is timed."""
    ipopt_queries: int = 20
    """Queries that IPOPT is timed on."""
    worlds: int = 50
    """Random worlds of each robot."""
    world_seed: int = 0
    """Of the worlds."""
    ipopt_worlds: int = 50
    """How many of them IPOPT solves."""
    ipopt_clear_worlds: int = 10
    """How many of the quadrotor's it solves with a clearance to be kept, which can take half a minute each."""
    limited_worlds: int = 20
    """The drive's worlds in which its wheels are limited."""
    resolves: int = 50
    """Queries that are solved once more after a change."""
    threads: int | None = None
    """How many solve at once where nothing is timed; by default as many as there are processors."""
    reference: Path | None = None
    """Folder with best_known.json, the lowest costs known."""
    save: Path | None = None
    """Where to write the plans that cost less than the best known, an .npz with seed, query, cost and controls."""
    peers: bool = True
    """Whether other people's solvers are asked, too."""

    def bounded(self) -> "Config":
        """The settings; with `--quick` 4 queries of one seed, 5 worlds, 2 rounds."""
        if not self.quick:
            return self
        one = replace(self, seeds=self.seeds[:1], clearance_seeds=self.clearance_seeds[:1])
        return at_most(
            one, queries=4, rounds=2, ipopt_queries=2, worlds=5, ipopt_worlds=1, ipopt_clear_worlds=0,
            limited_worlds=2, resolves=4,
        )  # fmt: skip


def queries(count: int, seed: int, limits: tuple[float, float] | None = None) -> list[ls.Problem]:
    """The quadrotor's first problems of a seed, from exactly the start; by default with the limits of its rotors."""
    return [replace(query(index, seed), control_limits=limits) for index in range(count)]


@cache
def query(index: int, seed: int) -> ls.Problem:
    return fixed(ls.scenarios.quadrotor(index, seed).problem)


def clear(problem: ls.Problem, margin: float = 0.0) -> ls.Problem:
    """The same, with a clearance to be kept from all that the obstacle cost keeps away from."""
    (cost,) = problem.obstacle_costs
    return replace(problem, constraints=[ls.Clearance(cost.world, radius=cost.radius, margin=margin)])


def solve(config: Config, problems: Sequence[ls.Problem], name: str, **options: Any) -> list[ls.Solution]:
    """`smooth_many`, with a bar."""
    with tqdm(total=len(problems), desc=name, leave=False, delay=2.0, disable=None) as bar:
        options.setdefault("threads", config.threads)
        return ls.smooth_many(problems, progress=lambda *_: bar.update(), **options)


def is_damped(solution: ls.Solution) -> bool:
    return not {row.method for row in solution.iterations} <= {"smooth"}


def of_solutions(problems: Sequence[ls.Problem], solutions: Sequence[ls.Solution], name: str) -> Found:
    """One entry a solution of each thing there is to ask; the costs are recomputed."""
    return {
        "status": [solution.status.name for solution in solutions],
        "detail": [solution.detail for solution in solutions],
        "iterations": [len(solution.iterations) for solution in solutions],
        "all_iterations": [all_iterations(solution) for solution in solutions],
        "damped": [is_damped(solution) for solution in solutions],
        "claimed": [solution.cost for solution in solutions],
        "cost": costs(problems, [solution.trajectory.controls for solution in solutions], f"{name}, costs"),
    }


def of_answers(problems: Sequence[ls.Problem], answers: Sequence[peers.Answer], name: str) -> Found:
    """The same of what others answer."""
    return {
        "status": ["CONVERGED" if answer.converged else "failed" for answer in answers],
        "iterations": [answer.iterations for answer in answers],
        "all_iterations": [answer.iterations for answer in answers],
        "claimed": [answer.cost for answer in answers],
        "cost": costs(problems, [answer.controls for answer in answers], f"{name}, costs"),
    }


def costs(problems: Sequence[ls.Problem], controls: Sequence[Array], name: str) -> list[float]:
    return [cost(*pair) for pair in progress(list(zip(problems, controls, strict=True)), name)]


def cost(problem: ls.Problem, controls: Array) -> float:
    """Recomputed, from exactly the start; infinite for controls that lead nowhere."""
    try:
        with np.errstate(all="ignore"):
            value = peers.cost_of(problem, controls)
    except (ValueError, OverflowError):  # of Python's own functions, beyond all numbers
        return float("inf")
    return value if np.isfinite(value) else float("inf")


def clearance(problem: ls.Problem, controls: Array, parts: int = 1) -> float:
    """The least clearance in metres, recomputed: at the steps, or at so many parts of each, the control held."""
    fine = replace(problem, dt=problem.dt / parts, steps=problem.steps * parts)
    try:
        with np.errstate(all="ignore"):
            least = float(peers.clearance_of(fine, peers.rollout(fine, np.repeat(controls, parts, axis=0))).min())
    except (ValueError, OverflowError):
        return -float("inf")
    return least if np.isfinite(least) else -float("inf")


def others(
    config: Config, problem: ls.Problem, names: Iterable[str], *, compile: bool = True
) -> tuple[dict[str, Solve], dict[str, str]]:
    """Other people's solvers by the names of `PEERS` for one world, and why the rest of them is not there."""
    pairs = [tuple(name.split(", ")) for name in names]
    if not config.peers:
        return {}, {who: "not asked for" for who, _ in pairs}
    makers: dict[str, Callable[[], peers.Crocoddyl | peers.Shooting]] = {
        "FDDP": lambda: peers.Crocoddyl(problem),
        "IPOPT": lambda: ipopt(problem, compile=compile),
    }
    made, skipped = installed({who: makers[who] for who, _ in pairs})
    starts = {who: {"hover": one.from_hover, "line": one.from_line} for who, one in made.items()}
    return {f"{who}, {start}": starts[who][start] for who, start in pairs if who in made}, skipped


def ipopt(problem: ls.Problem, *, compile: bool) -> peers.Shooting:
    return peers.Shooting(problem, "ipopt", compile=compile, max_iter=peers.MAX_ITERATIONS)


PEERS = ("FDDP, hover", "FDDP, line", "IPOPT, hover", "IPOPT, line")


def best_known(config: Config) -> dict[int, list[float]]:
    """The lowest costs known, query by query, of some seeds. Raises Unavailable where nobody says."""
    path = reference_folder(config.reference) / "best_known.json"
    if not path.is_file():
        raise peers.Unavailable("no best_known.json there: name its folder with --reference or LQRSIM_REFERENCE")
    return {int(seed): known for seed, known in json.loads(path.read_text(encoding="utf-8")).items()}


def converged(found: Found) -> int:
    return found["status"].count("CONVERGED")


def endings(found: Found) -> str:
    """How those ended that did not converge, in words."""
    failed = Counter(status for status in found["status"] if status != "CONVERGED")
    return ", ".join(f"{count} {status}" for status, count in failed.most_common())


def skips(skipped: dict[str, str]) -> list[str]:
    """A line each of what was left out."""
    return [f"  {who}: skipped: {why}" for who, why in skipped.items()]
