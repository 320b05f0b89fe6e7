"""What it costs to bring the quadrotor's measured probability of failure below a request.

Three plans of each query. The first has the requested chance by prediction. The second is that plan, hardened. The
third has wider margins at all obstacles: it is predicted to have a chance lower by a factor, the smallest of those
tried with which its measured probability is as requested. "As requested" means that the whole 95 % interval is below
the request.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from runner import interval, progress, table

import lqrsim as ls
from lqrsim.stress import statistics
from robust.common import Config

LESS = (1.0, 3.0, 10.0, 30.0, 100.0, 1000.0)  # factors on the predicted chance of the third plan


class Case(NamedTuple):
    """What runs meet: a preset by a strength. Plans and laws are told of the preset as it is."""

    preset: str
    strength: float


CASES = {
    "'moderate', as told": Case("moderate", 1.0),
    "twice the 'light' that was told": Case("light", 2.0),
}


def measure(config: Config) -> dict[str, Any]:
    kept, found = config.kept(), {name: list[Any]() for name in CASES}
    for query in progress(range(config.queries), "harden"):
        for name, rows in found.items():
            rows.append(kept.row(f"harden, {name}, {query}", partial(of_query, config, query, CASES[name])))
    return found


def of_query(config: Config, query: int, case: Case) -> dict[str, Any]:
    asked, seed = 10 / config.hardened, config.seed
    problem = ls.stress.ReliabilityProblem(
        f"quadrotor,query={query}", sweep=case.preset, strength=case.strength, policy="offset_free",
        design_disturbances=case.preset,
    )  # fmt: skip
    plant = problem.resolved.plant()
    told = ls.uncertainty_of(plant, ls.disturbances.preset(case.preset, plant))

    def predicted(chance: float) -> ls.types.SafePlan:
        return ls.smooth_chance_constrained(problem.resolved.problem, told, chance=chance)

    def measured(solution: ls.Solution) -> list[float]:
        own = replace(problem, solution=solution)
        try:
            return interval(own.rare_failures(particles=config.hardened, keep=0.0, seed=seed).probability)
        except ls.stress.NoFailure as none:
            return interval(statistics.rate(0, none.trials))  # counted

    first = predicted(asked)
    found = ls.stress.harden(
        replace(problem, solution=first.solution), chance=asked, particles=config.hardened, seed=seed
    )
    row: dict[str, Any] = {"query": query, "asked": asked}
    chosen = found.rounds[found.chosen]
    row["hardened"] = {"cost": chosen.cost, "measured": interval(chosen.probability)}
    row["first"] = {"cost": first.cost, "predicted": first.tube.collision_chance, "measured": measured(first.solution)}
    row["wider"] = None
    for less in LESS if config.hardened >= 100 else LESS[:2]:  # `--quick` tries two
        plan = first if less == 1 else predicted(asked / less)
        rate = row["first"]["measured"] if less == 1 else measured(plan.solution)
        if rate[2] <= asked:
            row["wider"] = {"cost": plan.cost, "measured": rate}
            break
    return row


def report(found: dict[str, Any]) -> list[str]:
    head = ("query, meets", "first plan: cost", "predicted", "measured", "hardened: cost", "measured",
            "wider margins: cost", "measured")  # fmt: skip
    asked = next(row["asked"] for rows in found.values() for row in rows)
    return [
        f"OffsetFree on plans that are asked for a probability of failure of {asked:g}, measured by counting. Wider"
        " margins are those of the first plan that is as requested when it is asked for less.",
        table(head, [[f"{row['query']}, {name}", *cells(row)] for name, rows in found.items() for row in rows]),
    ]


def cells(row: dict[str, Any]) -> list[Any]:
    first, hardened, wider = row["first"], row["hardened"], row["wider"]
    others = (f"{wider['cost']:.4g}", text(wider["measured"])) if wider else None
    return [
        f"{first['cost']:.4g}", f"{first['predicted']:.2g}", text(first["measured"]), f"{hardened['cost']:.4g}",
        text(hardened["measured"]), *(others or ["none"] * 2),
    ]  # fmt: skip


def text(rate: list[float]) -> str:
    return f"{rate[0]:.2g} ({rate[1]:.2g} to {rate[2]:.2g})"
