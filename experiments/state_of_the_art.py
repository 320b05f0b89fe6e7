"""Other people's solvers on the quadrotor's random queries: Crocoddyl's FDDP, and IPOPT through CasADi.

    python experiments/state_of_the_art.py            # 100 queries
    python experiments/state_of_the_art.py --quick    # 4

All begin at exactly the given start, on one thread, in turns; rotors without limits. "hover" is the paper's beginning,
the nominal control; "line" is the straight line of states to the goal. All stop when the cost changes by less than
1e-4, but for the search with smooth()'s own test, which asks for more, and IPOPT, which has a test of its own (1e-8).
With --quick IPOPT evaluates its functions in CasADi, which is slower, and compiles nothing.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from paper.common import as_in_the_paper, figure, fixed, numbers, picture
from paper.contestants import draw_excess, draw_means
from peers import Answer
from peers.common import line
from peers.common import versions as versions_of_peers
from quality.common import PEERS, all_iterations, clearance, cost, others
from quality.common import Config as Asked
from runner import FolderSettings, Result, Statement, between, interval, opening, progress, run, table
from solver_benchmark.common import take_turns

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.stress.statistics import bootstrap

PAPER, FROM_LINE = "smoothing, hover", "smoothing, line"
SEARCH, SEARCH_COST, ILQR = "smoothing, search", "smoothing, search (1e-4)", "iLQR, hover"
FDDP, FDDP_LINE, IPOPT, IPOPT_LINE = PEERS
MOST = 0.40  # iterations as a share of a peer's: as in Table I from a fixed start
SAME = 0.01  # costs that differ by less, as a share, are the same
# What is compared, less being better, and how it is written.
MEASURES: dict[str, tuple[Callable[[Mapping[str, Array]], float], str]] = {
    "iterations, mean": (lambda one: float(np.mean(one["iterations"])), ".1f"),
    "time, median (ms)": (lambda one: float(np.median(one["milliseconds"])), ".1f"),
    "cost, mean": (lambda one: float(np.nanmean(one["cost"])), ".1f"),
    "plans not within 1 % of the cheapest": (lambda one: len(one["excess"]) - near(one), ".0f"),
    "plans that collide": (lambda one: collisions(one), ".0f"),
}


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    queries: int = 100
    """How many random starts and goals."""
    seed: int = 0
    """Of the queries."""
    peers: bool = True
    """Whether other people's solvers are asked, too."""


@dataclass(frozen=True)
class Solved:
    controls: Array
    iterations: int
    solved: bool
    seconds: float


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
    contestants |= {name: theirs(solver) for name, solver in solvers.items()}
    for contestant in contestants.values():
        contestant(problems[0])  # compile
    turns = take_turns(contestants, problems, 1, "state of the art")
    result = opening(config) | {"queries": count, "skipped": skipped, "contestants": {}}
    result["peers"] = versions_of_peers()
    for name, rounds in progress(turns.items(), "recomputing costs"):
        answers = [answer for (answer,) in rounds]
        plans = list(zip(problems, (answer.controls for answer in answers), strict=True))
        result["contestants"][name] = {
            "solved": [answer.solved for answer in answers],
            "iterations": [answer.iterations for answer in answers],
            "milliseconds": numbers((1e3 * answer.seconds for answer in answers), 4),
            "cost": numbers((cost(*plan) for plan in plans), 9),
            "clearance": numbers(clearance(*plan) for plan in plans),
        }
    result["ratios"] = ratios(result)
    draw(config, result)
    return result


def ours(solver: Callable[..., list[ls.Solution]], **options: Any) -> Callable[[ls.Problem], Solved]:
    def solve(problem: ls.Problem) -> Solved:
        clock = time.perf_counter()
        (solution,) = solver([problem], threads=1, **options)
        seconds = time.perf_counter() - clock
        return Solved(solution.trajectory.controls, all_iterations(solution), solution.success, seconds)

    return solve


def theirs(solver: Callable[[ls.Problem], Answer]) -> Callable[[ls.Problem], Solved]:
    def solve(problem: ls.Problem) -> Solved:
        clock = time.perf_counter()
        answer = solver(problem)
        return Solved(answer.controls, answer.iterations, answer.converged, time.perf_counter() - clock)

    return solve


def straight(problem: ls.Problem) -> ls.Trajectory:
    """The straight line that the other solvers start with."""
    return ls.Trajectory(*line(problem), problem.dt)


def ratios(result: Result) -> dict[str, dict[str, list[float]]]:
    """The paper's smoothing relative to each contestant, with bootstrap intervals over the queries."""

    def of_means(a: Array, b: Array, axis: int) -> Array:
        return a.mean(axis) / b.mean(axis)

    def of_medians(a: Array, b: Array, axis: int) -> Array:
        return np.median(a, axis) / np.median(b, axis)

    found = arrays(result)
    return {
        name: {
            "iterations, mean": interval(bootstrap(of_means, found[PAPER]["iterations"], one["iterations"])),
            "time, mean": interval(bootstrap(of_means, found[PAPER]["milliseconds"], one["milliseconds"])),
            "time, median": interval(bootstrap(of_medians, found[PAPER]["milliseconds"], one["milliseconds"])),
        }
        for name, one in found.items()
        if name != PAPER
    }


def arrays(result: Result) -> dict[str, dict[str, Array]]:
    """The contestants' numbers, query by query, and what each plan costs more than the cheapest, as a share.

    A plan that leads nowhere has no cost, which is NaN, and counts as a collision.
    """
    found = {
        name: {what: np.array(values, dtype=float) for what, values in one.items()}
        for name, one in result["contestants"].items()
    }
    cheapest = np.nanmin([one["cost"] for one in found.values()], axis=0)
    for one in found.values():
        one["excess"] = one["cost"] / cheapest - 1
    return found


def near(one: Mapping[str, Array]) -> int:
    """How many plans cost at most `SAME` more than the cheapest."""
    return int(np.sum(one["excess"] <= SAME))


def collisions(one: Mapping[str, Array]) -> int:
    return int(np.sum(~(one["clearance"] >= 0)))


def draw(config: Config, result: Result) -> None:
    found = arrays(result)
    with figure(config, result, "state_of_the_art", (10, 4.6)) as drawn:
        spread, means = drawn.subplots(1, 2, width_ratios=(3, 2))
        draw_excess(spread, {name: one["excess"] for name, one in found.items()}, SAME)
        draw_means(means, found)
        drawn.set_layout_engine("tight", w_pad=2)


def report(result: Result) -> str:
    found = arrays(result)
    rows = [
        [
            name, f"{one['solved'].sum():.0f}/{len(one['solved'])}", f"{np.mean(one['iterations']):.1f}",
            f"{np.median(one['iterations']):g}", f"{np.mean(one['milliseconds']):.1f}",
            f"{np.median(one['milliseconds']):.1f}", f"{np.nanmean(one['cost']):.2f}", near(one), collisions(one),
            f"{100 * max(-np.nanmin(one['clearance']), 0):.1f}",
        ]
        for name, one in found.items()
    ]  # fmt: skip
    head = (
        "", "converged", "iterations, mean", "median", "ms, mean", "median", "cost, mean",
        "within 1 % of the cheapest", "collide", "deepest (cm)",
    )  # fmt: skip
    multiples = [[name, *(between(one[what]) for what in one)] for name, one in result["ratios"].items()]
    wins = [ahead(found, name) for name in (PAPER, SEARCH)] if set(PEERS) & set(found) else []
    least = min(collisions(one) for one in found.values())
    return "\n\n".join(
        [
            "## Against the state of the art",
            picture(
                result, "state_of_the_art", "Cost above the cheapest plan by solver, and mean cost against median time"
            ),
            table(head, rows),
            f"{result['queries']} queries; {', '.join(' '.join(peer) for peer in result['peers'].items())}. Costs, and"
            " clearances at the steps, are recomputed from the controls, from exactly the start. The cheapest plan of a"
            " query is the cheapest of all contestants'. Iterations of a search are those of all its starts. IPOPT"
            " iterates on, to a test of its own; the search without (1e-4) has smooth()'s. Obstacles are a cost here,"
            " which nothing forbids to pay: no contestant has fewer than"
            f" {least} plans that collide.",
            *(f"Left out: {who}: {why}." for who, why in result["skipped"].items()),
            f'"{PAPER}", as in the paper, as a multiple of each other one, with 95 % bootstrap intervals over the'
            " queries, each of which is timed once:",
            table(("", "iterations, mean", "time, mean", "time, median"), multiples),
            "Who is best:",
            table(("", PAPER, SEARCH, "best of the peers", "best of all"), best(found)),
            *wins,
            f"In how many queries a plan costs more than {100 * SAME:g} % less, or more, than that of smoothing:",
            table(("", f"less than {PAPER}", "more", f"less than {SEARCH}", "more"), duels(found)),
        ]
    )


def measured(found: Mapping[str, Mapping[str, Array]]) -> dict[str, dict[str, str]]:
    """Each measure of each contestant, rounded as printed, so that equal numbers compare equal."""
    return {
        what: {name: f"{measure(one):{spec}}" for name, one in found.items()}
        for what, (measure, spec) in MEASURES.items()
    }


def best(found: Mapping[str, Mapping[str, Array]]) -> list[list[str]]:
    rows = []
    for what, values in measured(found).items():
        row = [what, values[PAPER], values[SEARCH]]
        for some in ({name: values[name] for name in PEERS if name in values}, values):
            least = min(some.values(), key=float, default="")
            first = "; ".join(name for name, value in some.items() if value == least)
            row.append(f"{first}: {least}" if some else "-")
        rows.append(row)
    return rows


def ahead(found: Mapping[str, Mapping[str, Array]], name: str) -> str:
    """Measures in which a peer beats one of ours, one line each."""
    wins = []
    for what, values in measured(found).items():
        peers = [peer for peer in PEERS if peer in values]
        winners = [f"{peer} ({values[peer]})" for peer in peers if float(values[peer]) < float(values[name])]
        if winners:
            wins.append(f"- {what}: {'; '.join(winners)}; against {values[name]}")
    return "\n".join([f'Where peers are ahead of "{name}":', "", *(wins or ["- nowhere"])])


def duels(found: Mapping[str, Mapping[str, Array]]) -> list[list[object]]:
    rows: list[list[object]] = []
    for name, one in found.items():
        row: list[object] = [name]
        for other in (PAPER, SEARCH):
            relation = one["cost"] / found[other]["cost"] - 1
            row += [int(np.sum(relation < -SAME)), int(np.sum(relation > SAME))] if name != other else ["", ""]
        rows.append(row)
    return rows


def statements(result: Result) -> list[Statement]:
    found = arrays(result)

    def mean(name: str) -> str:
        return f"{np.mean(found[name]['iterations']):.1f}"

    def against(names: Sequence[str], where: str, *more: str) -> Statement:
        missing = {name for name in names if name not in found}
        ratio = {name: result["ratios"][name]["iterations, mean"] for name in names if name not in missing}
        said = [f'{between(ratio[name])} times those of "{name}", {mean(name)}' for name in ratio]
        return Statement(
            where="abstract",
            paper="smoothing takes about a third of the iterations of existing approaches such as iterative LQR;"
            f" {where}",
            test=f"mean iterations at most {MOST} times those of each",
            ours="; ".join([*said, *(f'no "{name}" here' for name in sorted(missing)), *more]),
            holds=None if missing else max(value for value, _, _ in ratio.values()) <= MOST,
            figure="state_of_the_art",
        )

    shares = [
        f"{np.mean(found[FROM_LINE]['iterations']) / np.mean(found[name]['iterations']):.2f} times those of {name}"
        for name in (FDDP_LINE, IPOPT_LINE)
        if name in found
    ]
    line_too = f"begun on that line, too, smoothing takes {', '.join([mean(FROM_LINE), *shares])}"
    return [
        against([FDDP], "against FDDP, both from hover"),
        against([IPOPT], "against IPOPT, both from hover", "IPOPT has a stricter test"),
        against([FDDP_LINE, IPOPT_LINE], "from hover, against FDDP and IPOPT from the straight line", line_too),
    ]


if __name__ == "__main__":
    run(Config, main, report, __doc__, statements=statements)
