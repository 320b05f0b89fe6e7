"""What the sections share: what they are told, how contestants take turns, and what is to be met."""

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar, get_args

import numpy as np
from runner import Settings, progress

import lqrsim as ls

Job = TypeVar("Job")
Taken = TypeVar("Taken")
Section = Literal["speed", "peers", "scaling", "threads", "startup"]
# The smoother as in the paper, which is what the reference does.
PAPER = partial(ls.smooth_many, start=ls.scenarios.quadrotor().paper_start, finish=None)
MANY: dict[str, Callable[..., list[ls.Solution]]] = {"smooth": PAPER, "ilqr": ls.ilqr_many}
PRIMAL = {"primal": partial(PAPER, form="primal")}  # the form that the reference has

# What is to be met: times the reference's, times one another's, or seconds.
TARGETS = {
    "smooth / reference": 1.6,
    "primal / reference": 1.35,
    "ilqr / reference": 1.5,
    "symbolic / by hand": 1.08,
    "two threads": 1.6,
    "--help": 0.4,
    "warm": 2.0,
    "cold": 12.0,
}


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    sections: tuple[Section, ...] = get_args(Section)
    """What to measure."""
    queries: int = 100
    """How many random starts and goals."""
    seed: int = 0
    """Of the queries."""
    rounds: int = 5
    """How often each contestant has its turn at a query."""
    batch: int = 4
    """Queries a turn, where the time of a single one does not matter."""
    reference: Path | None = None
    """Folder of the C++ reference."""


def make_problems(config: Config) -> list[ls.Problem]:
    """As in the paper: without limits of the controls, which the reference and FDDP do not have."""
    problems = [ls.scenarios.quadrotor(query=q, seed=config.seed).problem for q in range(config.queries)]
    return [replace(problem, control_limits=(-np.inf, np.inf)) for problem in problems]


def make_batches(config: Config) -> list[slice]:
    return [slice(first, first + config.batch) for first in range(0, config.queries, config.batch)]


def take_turns(
    contestants: Mapping[str, Callable[[Job], Taken]], jobs: Sequence[Job], rounds: int, name: str
) -> dict[str, list[list[Taken]]]:
    """What each contestant returned, by job and round; each job is done by all in turn, and each has its turn first."""
    taken: dict[str, list[list[Taken]]] = {who: [[] for _ in jobs] for who in contestants}
    order = list(contestants)
    for place, job in progress(rounds * list(enumerate(jobs)), name):
        for who in order:
            taken[who][place].append(contestants[who](job))
        order = order[1:] + order[:1]
    return taken


def median(values: Iterable[float]) -> float:
    return float(statistics.median(values))


def judge(value: float, target: str, *, at_least: bool = False) -> str:
    wanted = TARGETS[target]
    met = value >= wanted if at_least else value <= wanted
    return f"{'met' if met else 'MISSED'}: want {'>=' if at_least else '<='} {wanted:g}"
