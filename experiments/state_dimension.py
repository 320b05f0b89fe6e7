"""How the time of an iteration grows with the dimension of the state: Sec. VI-B.

    python experiments/state_dimension.py            # drive and quadrotor, chains of 1 to 8 masses
    python experiments/state_dimension.py --quick    # chains of 1 and 2, dual form only, fewer rounds

The differential drive has 3 states and 2 controls, the quadrotor 12 and 4. Both have 150 steps, the same iterations are
timed of both, and they take turns. Their obstacles differ in number and kind, so all is timed without any, too. A chain
of masses has 3 states and a control a mass, and no obstacles. One thread.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator, StrMethodFormatter
from paper.common import as_in_the_paper, bootstrap, figure, numbers, picture
from runner import FolderSettings, Result, Statement, between, interval, opening, run, table
from solver_benchmark.common import median, take_turns
from solver_benchmark.scaling import chain_of_masses

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.parts import CostSum, terms_of
from lqrsim.view.style import LIMIT, PLAN, RUNS, plain_decades

ROBOTS = ("drive", "quadrotor")
AS_THEY_ARE, EQUAL = "with their obstacles", "without obstacles"
DUAL, PRIMAL, ILQR = "smoothing, dual form", "smoothing, primal form", "iLQR"
SOLVERS: dict[str, Callable[..., ls.Solution]] = {
    DUAL: partial(ls.smooth, safeguard=False, finish=None),
    PRIMAL: partial(ls.smooth, safeguard=False, finish=None, form="primal"),
    ILQR: ls.ilqr,
}
MARKERS = {DUAL: "o", PRIMAL: "s", ILQR: "D"}
# Of these, the first meets untouched memory, and the last works out more than the others. A chain can be solved to the
# last bit before.
ITERATIONS, FEWEST = 6, 4
PAPER, WITHIN = 18, (9, 36)  # times the time of the drive; what counts as that, within a factor of two


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    masses: tuple[int, ...] = (1, 2, 4, 8)
    """Of the chains."""
    rounds: int = 60
    """How often each is timed."""


def main(config: Config) -> Result:
    masses, rounds = (config.masses[:2], 10) if config.quick else (config.masses, config.rounds)
    solvers = (DUAL,) if config.quick else (DUAL, ILQR)
    drive, quadrotor = ls.scenarios.differential_drive(), ls.scenarios.quadrotor()
    result = opening(config) | {"robots": {}, "chains": {}}
    cases: dict[str, Callable[[ls.Problem], ls.Problem]] = {AS_THEY_ARE: as_in_the_paper, EQUAL: without_obstacles}
    for case, made in cases.items():
        contestants = {
            (robot, solver): iterating(solver, made(scenario.problem), start=scenario.paper_start)
            for robot, scenario in zip(ROBOTS, (drive, quadrotor), strict=True)
            for solver in SOLVERS
        }
        times = timed(contestants, rounds, case)
        result["robots"][case] = {
            solver: {
                "milliseconds": {robot: numbers([1e3 * median(times[robot, solver])], 4)[0] for robot in ROBOTS},
                "ratio": interval(bootstrap(of_medians, *(times[robot, solver] for robot in reversed(ROBOTS)))),
            }
            for solver in SOLVERS
        }
    chains = {(3 * count, solver): iterating(solver, chain_of_masses(count)) for count in masses for solver in solvers}
    times = timed(chains, rounds, "chains")
    for solver in solvers:
        sizes = [3 * count for count in masses]
        smallest, largest = sizes[0], max(size for size in sizes if size <= 12)
        ratio = bootstrap(of_medians, times[largest, solver], times[smallest, solver])
        power = [math.log(value) / math.log(largest / smallest) for value in interval(ratio)]
        result["chains"][solver] = {
            "states": sizes,
            "milliseconds": [1e3 * median(times[size, solver]) for size in sizes],
            "power": power,
            "between": [smallest, largest],
        }
    draw(config, result)
    return result


def without_obstacles(problem: ls.Problem) -> ls.Problem:
    """The problem in an empty world; this compiles nothing new."""
    terms = [
        ls.ObstacleCost(ls.World(), radius=term.radius) if isinstance(term, ls.ObstacleCost) else term
        for term in terms_of(problem.stage_cost)
    ]
    return replace(as_in_the_paper(problem), stage_cost=CostSum(tuple(terms)))


def iterating(solver: str, problem: ls.Problem, *, start: ls.InitialPrior | None = None) -> Callable[[object], float]:
    """A function that times an iteration in seconds: the median without the first and the last."""
    begin: dict[str, Any] = {} if solver == ILQR else {"start": start or problem.nominal_control}

    def once(_: object) -> float:
        solution = SOLVERS[solver](problem, stop="cost", tolerance=1e-300, max_iterations=ITERATIONS, **begin)
        assert len(solution.iterations) >= FEWEST
        return median(iteration.seconds for iteration in solution.iterations[1:-1])

    return once


def timed(contestants: dict[Any, Callable[[object], float]], rounds: int, name: str) -> dict[Any, Array]:
    """Seconds (rounds,) of each contestant, after a run that compiles."""
    for contestant in contestants.values():
        contestant(None)
    turns = take_turns(contestants, [None], rounds, name)
    return {who: np.array(taken[0]) for who, taken in turns.items()}


def of_medians(a: Array, b: Array, axis: int) -> Array:
    return np.median(a, axis) / np.median(b, axis)


def draw(config: Config, result: Result) -> None:
    colours = dict(zip(SOLVERS, RUNS, strict=False))
    with figure(config, result, "state_dimension", (7.2, 4.2)) as drawn:
        axes = drawn.subplots()
        for solver, chain in result["chains"].items():
            axes.plot(chain["states"], chain["milliseconds"], ".-", color=colours[solver])
        for (solver, marker), aside in zip(MARKERS.items(), (0.93, 1.0, 1.07), strict=True):
            for case, face in ((EQUAL, colours[solver]), (AS_THEY_ARE, "white")):
                values = list(result["robots"][case][solver]["milliseconds"].values())
                at = aside * np.array([3, 12])
                axes.plot(at, values, marker, color=colours[solver], markerfacecolor=face, markersize=6, zorder=3)
        sizes, first = np.array([3.0, 12.0]), list(result["chains"].values())[-1]["milliseconds"][0]
        axes.plot(sizes, first * (sizes / 3) ** 3, ":", color=LIMIT, zorder=0)
        axes.set(xscale="log", yscale="log", xlim=(2.5, 1.15 * max(12, *result["chains"][DUAL]["states"])))
        axes.set(xlabel="states (the drive has 3, the quadrotor 12)", ylabel="time of an iteration (ms)")
        axes.set_title("150 steps, one thread")
        plain_decades(axes.yaxis)
        axes.set_xticks([3, 6, 12, 24][: 4 if axes.get_xlim()[1] > 24 else 3])
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_locator(NullLocator())
        key = [Line2D([], [], marker=MARKERS[solver], color=colours[solver], label=solver, ls="") for solver in SOLVERS]
        key += [
            Line2D([], [], marker="o", color=PLAN, linestyle="", label=f"filled: robots {EQUAL}"),
            Line2D([], [], marker="o", color=PLAN, markerfacecolor="white", linestyle="", label=f"open: {AS_THEY_ARE}"),
            Line2D([], [], marker=".", color=PLAN, label="chains of masses"),
            Line2D([], [], color=LIMIT, linestyle=":", label="cubic"),
        ]
        axes.legend(handles=key, loc="center left", bbox_to_anchor=(1.02, 0.5))
        drawn.set_layout_engine("tight")


def report(result: Result) -> str:
    rows = [
        [
            f"{solver}, {case}",
            *(f"{each:.4f}" for each in found["milliseconds"].values()),
            between(found["ratio"], ".1f"),
        ]
        for case, solvers in result["robots"].items()
        for solver, found in solvers.items()
    ]
    chains = [
        [solver, *(f"{value:.4f}" for value in found["milliseconds"]), between(found["power"])]
        for solver, found in result["chains"].items()
    ]
    chain = next(iter(result["chains"].values()))
    first, last = chain["between"]
    return "\n\n".join(
        [
            "## Time of an iteration and the dimension of the state",
            picture(result, "state_dimension", "Time of an iteration against the number of states"),
            "Milliseconds an iteration, medians:",
            table(("", "drive, 3 states", "quadrotor, 12 states", "ratio"), [*rows, ["the paper", "", "", PAPER]]),
            "Chains of masses, which differ in nothing but their length; the power of the number of states that time"
            f" grows as from {first} to {last} states:",
            table(("ms an iteration", *(f"{size} states" for size in chain["states"]), "power"), chains),
        ]
    )


def statements(result: Result) -> list[Statement]:
    ratios = {
        case: {solver: found["ratio"] for solver, found in them.items()} for case, them in result["robots"].items()
    }
    equal, as_they_are = (tuple(ratios[case][form] for form in (DUAL, PRIMAL)) for case in (EQUAL, AS_THEY_ARE))

    def forms(them: Sequence[Sequence[float]]) -> str:
        return f"dual form {between(them[0], '.1f')}, primal {between(them[1], '.1f')}"

    return [
        Statement(
            where="Sec. VI-B",
            paper=f"an iteration for the quadrotor takes about {PAPER} times that for the drive, other factors equal",
            test=f"{WITHIN[0]} to {WITHIN[1]} times in both forms of smoothing, without obstacles",
            ours=f"{forms(equal)}; with their obstacles {forms(as_they_are)}",
            holds=all(WITHIN[0] <= ratio[0] <= WITHIN[1] for ratio in equal),
            figure="state_dimension",
        )
    ]


if __name__ == "__main__":
    run(Config, main, report, __doc__, statements=statements)
