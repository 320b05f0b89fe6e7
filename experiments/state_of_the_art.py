"""Other people's solvers on the quadrotor's random queries: Crocoddyl's FDDP, and IPOPT through CasADi.

    python experiments/state_of_the_art.py            # 100 queries
    python experiments/state_of_the_art.py --quick    # 4

All begin at exactly the given start, on one thread, in turns; rotors without limits. "hover" is the paper's beginning,
the nominal control; "line" is the straight line of states to the goal. All stop when the cost changes by less than
1e-4, but for the search with smooth()'s own test, which asks for more, and IPOPT, which has a test of its own (1e-8).
With --quick IPOPT evaluates its functions in CasADi, which is slower, and compiles nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from paper.common import as_in_the_paper, bootstrap, figure, fixed, picture
from paper.contestants import draw_excess, draw_means
from peers.common import line
from peers.common import versions as versions_of_peers
from peers.contestants import ours, timed
from quality.common import PEERS, clearance, cost, others
from quality.common import Config as Asked
from runner import FolderSettings, Result, Statement, between, interval, opening, progress, run, table
from solver_benchmark.common import take_turns

import lqrsim as ls
from lqrsim.errors import Array

PAPER, FROM_LINE = "smoothing, hover", "smoothing, line"
SEARCH, SEARCH_COST, ILQR = "smoothing, search", "smoothing, search (1e-4)", "iLQR, hover"
FDDP, FDDP_LINE, IPOPT, IPOPT_LINE = PEERS
MOST = 0.40  # iterations as a share of a peer's: as in Table I from a fixed start
SAME = 0.01  # costs that differ by less, as a share, are the same


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    queries: int = 100
    """How many random starts and goals."""
    seed: int = 0
    """Of the queries."""
    peers: bool = True
    """Whether other people's solvers are asked, too."""


def main(config: Config) -> Result:
    count = min(config.queries, 4) if config.quick else config.queries
    scenarios = [ls.scenarios.quadrotor(query=query, seed=config.seed) for query in range(count)]
    problems = [fixed(as_in_the_paper(scenario.problem)) for scenario in scenarios]
    contestants = {
        PAPER: ours(ls.smooth_many, stop="cost", start=scenarios[0].paper_start),
        FROM_LINE: ours(ls.smooth_many, stop="cost", start=straight),
        SEARCH_COST: ours(ls.smooth_many, stop="cost"),
        SEARCH: ours(ls.smooth_many),
        ILQR: ours(ls.ilqr_many, stop="cost"),
    }
    solvers, skipped = others(Asked(peers=config.peers), problems[0], PEERS, compile=not config.quick)
    contestants = {name: timed(solver) for name, solver in (contestants | solvers).items()}
    for contestant in contestants.values():
        contestant(problems[0])  # compile
    turns = take_turns(contestants, problems, 1, "state of the art")
    result = opening(config) | {"queries": count, "skipped": skipped, "peers": versions_of_peers()}
    found = {}
    for name, rounds in progress(turns.items(), "recomputing costs"):
        answers = [answer for (answer,) in rounds]
        plans = list(zip(problems, (answer.controls for answer in answers), strict=True))
        found[name] = {
            "solved": np.array([answer.converged for answer in answers]),
            "iterations": np.array([answer.iterations for answer in answers]),
            "milliseconds": np.array([1e3 * answer.seconds for answer in answers]),
            "cost": np.array([cost(*plan) for plan in plans]),
            "clearance": np.array([clearance(*plan) for plan in plans]),
        }
    result["contestants"] = summed(found)
    with figure(config, result, "state_of_the_art", (10, 4.6)) as drawn:
        spread, means = drawn.subplots(1, 2, width_ratios=(3, 2))
        draw_excess(spread, excesses(found), SAME)
        draw_means(means, found)
        drawn.set_layout_engine("tight", w_pad=2)
    return result


def straight(problem: ls.Problem) -> ls.Trajectory:
    """The straight line that the other solvers start with."""
    return ls.Trajectory(*line(problem), problem.dt)


def excesses(found: Mapping[str, Mapping[str, Array]]) -> dict[str, Array]:
    """What each plan costs more than the cheapest of its query, as a share; one that leads nowhere has no cost: NaN."""
    cheapest = np.nanmin([one["cost"] for one in found.values()], axis=0)
    return {name: one["cost"] / cheapest - 1 for name, one in found.items()}


def summed(found: Mapping[str, Mapping[str, Array]]) -> dict[str, dict[str, Any]]:
    """What is said of each contestant; `fewer` is how the paper's smoothing's iterations relate to its own."""

    def of_means(a: Array, b: Array, axis: int) -> Array:
        return a.mean(axis) / b.mean(axis)

    excess = excesses(found)
    return {
        name: {
            "solved": int(one["solved"].sum()),
            "iterations": float(np.mean(one["iterations"])),
            "milliseconds": float(np.median(one["milliseconds"])),
            "cost": float(np.nanmean(one["cost"])),
            "near": int(np.sum(excess[name] <= SAME)),
            "collide": int(np.sum(~(one["clearance"] >= 0))),
            "fewer": interval(bootstrap(of_means, found[PAPER]["iterations"], one["iterations"])),
        }
        for name, one in found.items()
    }


def report(result: Result) -> str:
    found = result["contestants"]
    rows = [
        [
            name, one["solved"], f"{one['iterations']:.1f}", f"{one['milliseconds']:.1f}", f"{one['cost']:.2f}",
            one["near"], one["collide"],
        ]
        for name, one in found.items()
    ]  # fmt: skip
    head = (
        "", "converged", "iterations, mean", "ms, median", "cost, mean", "within 1 % of the cheapest", "collide",
    )  # fmt: skip
    return "\n\n".join(
        [
            "## Against the state of the art",
            picture(
                result, "state_of_the_art", "Cost above the cheapest plan by solver, and mean cost against median time"
            ),
            table(head, rows),
            f"{result['queries']} queries; {', '.join(' '.join(peer) for peer in result['peers'].items())}. Costs and"
            " clearances are recomputed from the controls, from exactly the start. The cheapest plan of a query is that"
            " of all contestants. Iterations of a search are those of all its starts. IPOPT iterates on, to a test of"
            " its own; the search without (1e-4) has smooth()'s.",
            *(f"Left out: {who}: {why}." for who, why in result["skipped"].items()),
        ]
    )


def statements(result: Result) -> list[Statement]:
    found = result["contestants"]

    def against(names: Sequence[str], where: str, *more: str) -> Statement:
        there, missing = ([name for name in names if (name in found) is here] for here in (True, False))
        said = [f'{between(found[name]["fewer"])} times those of "{name}"' for name in there]
        return Statement(
            where="abstract",
            paper=f"a third of the iterations of existing approaches; {where}",
            test=f"mean iterations at most {MOST} times those of each",
            ours="; ".join([*said, *(f'no "{name}" here' for name in missing), *more]),
            holds=None if missing else max(found[name]["fewer"][0] for name in names) <= MOST,
            figure="state_of_the_art",
        )

    return [
        against([FDDP], "against FDDP, both from hover"),
        against([IPOPT], "against IPOPT, both from hover", "IPOPT has a stricter test"),
        against([FDDP_LINE, IPOPT_LINE], "from hover, against FDDP and IPOPT from the straight line"),
    ]


if __name__ == "__main__":
    run(Config, main, report, __doc__, statements=statements)
