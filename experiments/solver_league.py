"""A league of solvers at equal accuracy: iterations and time until the same cost, and until 1e-8, on the same problems.

    python experiments/solver_league.py    # everything, 15 minutes, half of it compiling
    python experiments/solver_league.py --problems acrobot concar --solvers lqrsim FATROP --seeds 10    # some of it
    python experiments/solver_league.py --quick    # the first two problems, and too little to trust

Problems: the nine of Altro.jl as `altro_problems.py` has them, with RK4 for the cart-pole as everywhere here, where the
original has RK3; `concar`, a car among four random circles, of InteriorPointDDP.jl; a planar quadrotor with a wall to
get over and a clearance; the paper's quadrotor, whose obstacles are a cost; an arm of three links among posts; a planar
quadrotor through a gap that it passes tilted, and a rocket that lands, each with a given duration and with a free one.
All solvers but the second begin with the same: controls and the states that they lead to, or for `escape` and the gap
states that do not belong together. A free duration begins as the one that is stated, its price is in the cost, and of
lqrsim the end alone is compared: all of its iterations, with shorter durations that it tries.

lqrsim            ls.smooth with the start that is given, and otherwise its default settings.
lqrsim, search    ls.smooth with starts of its own; the iterations of all of them are counted.
lqrsim, no finish the first with finish=None and tolerance=1e-8: no Newton steps, and the augmented Lagrangian, with
                  1e-6 to spare, in place of the interior point.
ilqr              ls.ilqr with tolerance=1e-8; it keeps no constraints but the limits of the controls.
box-FDDP          Crocoddyl's, which keeps as much.
FATROP, IPOPT     through CasADi, with exact Hessians and a tolerance of 1e-8, in at most 3,000 iterations; FATROP with
                  the default first barrier parameter, 0.1, and with that of its older versions, 100.

The target is Altro.jl's published cost where a verified plan of the league costs no more, and otherwise 1.001 times the
least cost of the verified plans of all that begin with the same, whether or not they are said to be optimal. It is
reached at the first iteration with no higher cost and every constraint kept to 1e-6; of the interior point, FATROP and
IPOPT the dynamics, too. A solver whose final plan costs more is not asked when it was there. "To 1e-8" is by each
solver's own measure of optimality, which are not the same: the decrease of the cost that is still promised, relative to
the cost, or the residuals of the optimality conditions. "Optimality reached" is the same for all: the residual of the
first-order conditions of the plan that is returned, recomputed in NumPy with the multipliers that make it least, and
relative to the slope of the cost.

Each plan that is returned is recomputed in NumPy, apart from all solvers: dynamics and constraints are to be kept to
1e-6, and the cost is to be the claimed one. What is claimed but not so counts as not solved, and reaches nothing. Of
random problems iterations, times and costs are medians; an instance where something is never reached counts as
infinitely long. Times are processor times of whole calls, on one thread and without compiling, the least of up to five
calls; FATROP and IPOPT are called through CasADi, their functions compiled from C, which takes a while once. With
--quick they are evaluated in CasADi. "Beside FATROP" is the ratio of these times, FATROP's the better of its two
settings, for the instances that both solve in the same optimum. What is not installed is left out, and named.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

if __name__ == "__main__":  # before NumPy looks: times are on one thread
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")

import numpy as np
from league.contestants import CONTESTANTS, FATROPS, SEARCH, Run, Solve
from league.problems import FAMILIES, Instance, instances
from league.verification import VIOLATION, Verified, verify
from peers import Unavailable
from peers import versions as versions_of_peers
from peers.shooting import Moment
from runner import FolderSettings, Result, opening, run, table
from tqdm import tqdm

from lqrsim.errors import check_count, check_name

ABOVE_BEST = 1.001  # times the least cost of all: the target where Altro.jl's is not reached or known
SAME = 1e-3  # relative difference of costs up to which two plans are of one optimum


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    problems: tuple[str, ...] = tuple(FAMILIES)
    """Which of them."""
    solvers: tuple[str, ...] = tuple(CONTESTANTS)
    """Which of them; the target is the best of these."""
    seeds: int = 100
    """The most instances of each random problem."""


@dataclass(frozen=True)
class Outcome:
    """A solver's run on an instance, and what its plan is by itself."""

    run: Run
    verified: Verified

    @property
    def solved(self) -> bool:
        return self.run.solved and not self.verified.faults

    @property
    def refuted(self) -> bool:
        """Whether it claims what is not so."""
        return self.run.solved and bool(self.verified.faults)


def main(config: Config) -> Result:
    for field, chosen, names in (("problems", config.problems, FAMILIES), ("solvers", config.solvers, CONTESTANTS)):
        for name in chosen:
            check_name(f"--{field}", name, names)
    check_count("--seeds", config.seeds)
    result = opening(config) | {"peers": versions_of_peers(), "problems": {}}
    chosen = config.problems[:2] if config.quick else config.problems
    most = min(config.seeds, 2) if config.quick else config.seeds
    with tqdm(total=len(chosen) * len(config.solvers), desc="league", leave=False, disable=None) as bar:
        for name in chosen:
            result["problems"][name] = _family(name, config, most, bar)
    return result


def _family(name: str, config: Config, most: int, bar: Any) -> Result:
    """All solvers on all instances of a family."""
    problems, found, absent = instances(name, most), {}, {}
    for solver in config.solvers:
        bar.set_postfix_str(f"{name}, {solver}")
        try:
            solve = CONTESTANTS[solver](problems[0][0], compile=not config.quick)
        except Unavailable as error:
            absent[solver] = f"for {error}"
        except NotImplementedError as error:
            absent[solver] = f"which does not take {error}"
        else:
            found[solver] = _solve_all(solve, problems, f"{name}, {solver}")
        bar.update()
    from_start = _least([outcomes for solver, outcomes in found.items() if solver != SEARCH], len(problems))
    published = FAMILIES[name].published
    targets = [ABOVE_BEST * cost for cost in from_start]
    by_altro = False
    if published is not None and from_start[0] <= published[1]:
        targets, by_altro = [published[1]], True
    return {
        "instances": len(problems),
        "published": published,
        "target": "Altro.jl" if by_altro else "best",
        "targets": _numbers(targets),
        "absent": absent,
        "solvers": {solver: _summary(outcomes, targets, f"{name}, {solver}") for solver, outcomes in found.items()},
    }


def _least(found: Sequence[Sequence[Outcome]], instances: int) -> list[float]:
    """The least cost of all verified plans of each instance."""
    return [
        min((outcomes[i].verified.cost for outcomes in found if not outcomes[i].verified.faults), default=np.nan)
        for i in range(instances)
    ]


def _solve_all(solve: Solve, problems: Sequence[Instance], name: str) -> list[Outcome]:
    solve(*problems[0])  # compile
    outcomes = []
    for problem, start in _progress(problems, name):
        answer = solve(problem, start)
        outcomes.append(Outcome(answer, verify(problem, answer.plan, answer.cost)))
    return outcomes


def _summary(outcomes: Sequence[Outcome], targets: Sequence[float], name: str) -> Result:
    """What came of a solver's runs, instance by instance, as JSON."""
    reached = [
        one.run.first(_reaching(target)) if not one.verified.faults and one.verified.cost <= target else None
        for one, target in _progress(list(zip(outcomes, targets, strict=True)), f"{name}, to the target")
    ]
    exact = [one.run.exact if one.solved else None for one in outcomes]
    return {
        "solved": [one.solved for one in outcomes],
        "faults": [list(one.verified.faults) for one in outcomes],
        "refuted": [one.refuted for one in outcomes],
        "cost": _numbers(np.nan if one.verified.faults else one.verified.cost for one in outcomes),
        "optimality": _numbers(one.verified.optimality if one.solved else np.nan for one in outcomes),
        "target": _moments(reached),
        "exact": _moments(exact),
    }


def _reaching(target: float) -> Callable[[Moment], bool]:
    return lambda moment: moment.cost <= target and moment.violation < VIOLATION


def _moments(moments: Sequence[Moment | None]) -> Result:
    return {
        "iterations": [None if one is None else one.iterations for one in moments],
        "milliseconds": _numbers(np.nan if one is None else 1e3 * one.seconds for one in moments),
    }


def _numbers(values: Any) -> list[float | None]:
    """As JSON has them; None for what is not finite."""
    return [float(f"{value:.9g}") if np.isfinite(value) else None for value in values]


def _progress(items: Sequence[Any], name: str) -> Any:
    return tqdm(items, name, leave=False, delay=2.0, position=1, disable=None)


def report(result: Result) -> str:
    problems, notes, absent = result["problems"], [], dict[str, list[str]]()
    unsolved = []
    for name, family in problems.items():
        for solver, one in family["solvers"].items():
            if not all(one["solved"]):
                unsolved.append(f"{name} by {solver} ({sum(one['solved'])} of {family['instances']})")
            notes += [
                f"{name}, {solver}, instance {i}: claimed, but {'; '.join(faults)}."
                for i, (faults, refuted) in enumerate(zip(one["faults"], one["refuted"], strict=True))
                if refuted
            ]
        for solver, why in family["absent"].items():
            absent.setdefault(f"Without {solver}, {why}", []).append(name)
    solvers = [name for name in CONTESTANTS if any(name in one["solvers"] for one in problems.values())]
    main = [one for one in ("lqrsim", "FATROP", "IPOPT") if one in solvers]
    brief = ("iterations to 1e-8", "ms to 1e-8", "optimality reached")
    peers = ", ".join(" ".join(one) for one in result["peers"].items())
    parts = [
        "## A league of solvers",
        "`experiments/solver_league.py` states problems, solvers and measures. In brackets is a number of instances,"
        f" whose medians are told; a dash stands where no more than half get there. {peers or 'No peers installed.'}",
        table(("problem", *(f"{one}, {what}" for what in brief for one in main)), _rows(problems, main, brief)),
    ]
    for what in BY_SOLVER:
        parts += [f"{what[0].upper()}{what[1:]}:", table(("problem", *solvers), _rows(problems, solvers, [what]))]
    return "\n\n".join(
        [
            *parts,
            f"Not solved: {'; '.join(unsolved) or 'none'}.",
            *notes,
            *(f"{what}: {', '.join(names)}." for what, names in absent.items()),
            *_beside_fatrop(problems),
        ]
    )


def _rows(problems: dict[str, Any], solvers: Sequence[str], measures: Sequence[str]) -> list[list[str]]:
    """A row a problem: a cell for each measure of each solver, empty where it does not take the problem."""
    return [
        [
            name + (f" ({family['instances']})" if family["instances"] > 1 else ""),
            *(
                MEASURES[what](family["solvers"][one]) if one in family["solvers"] else ""
                for what in measures
                for one in solvers
            ),
        ]
        for name, family in problems.items()
    ]


def _beside_fatrop(problems: dict[str, Any]) -> list[str]:
    """Times of whole calls beside the better of FATROP's two settings, and the geometric mean of their ratios."""
    rows, logs = [], []
    for name, family in problems.items():
        ours = family["solvers"].get("lqrsim")
        theirs = [family["solvers"][one] for one in FATROPS if one in family["solvers"]]
        if ours is None or len(theirs) < len(FATROPS):
            continue
        pairs = []
        for i, cost in enumerate(ours["cost"]):
            times = [
                one["exact"]["milliseconds"][i]
                for one in theirs
                if one["solved"][i] and ours["solved"][i] and abs(one["cost"][i] / cost - 1) < SAME
            ]
            if times and ours["exact"]["milliseconds"][i] is not None:
                pairs.append((ours["exact"]["milliseconds"][i], min(times)))
        solved = [any(each) for each in zip(*(one["solved"] for one in theirs), strict=True)]
        row = [name, family["instances"], sum(ours["solved"]), sum(solved), len(pairs)]
        if pairs:
            logs.append(np.mean([np.log(mine / other) for mine, other in pairs]))
            row += [_median([pair[i] for pair in pairs], ".1f") for i in (0, 1)] + [f"{np.exp(logs[-1]):.2f}"]
        rows.append([*row, *["-"] * (8 - len(row))])
    if not rows:
        return []
    head = (
        "problem",
        "instances",
        "lqrsim solves",
        "FATROP solves",
        "both, one optimum",
        "lqrsim, ms",
        "FATROP, ms",
        "ratio",
    )
    mean = f"Geometric mean of the ratios: {np.exp(np.mean(logs)):.2f}, over {len(logs)} problems." if logs else ""
    return ["Beside FATROP, whole calls:", table(head, rows), mean]


MEASURES: dict[str, Callable[[Result], str]] = {
    "iterations to 1e-8": lambda one: _median(one["exact"]["iterations"], "g"),
    "ms to 1e-8": lambda one: _median(one["exact"]["milliseconds"], ".1f"),
    "optimality reached": lambda one: _median(one["optimality"], ".0e"),
    "final cost": lambda one: _median(one["cost"], ".4g"),
    "iterations to the target": lambda one: _median(one["target"]["iterations"], "g"),
}
BY_SOLVER = ("iterations to 1e-8", "ms to 1e-8", "final cost", "iterations to the target")


def _median(values: Sequence[float | None], spec: str) -> str:
    """Of numbers of which those that are missing are the largest."""
    ordered = sorted(np.inf if value is None else value for value in values)
    middle = np.mean([ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]])
    return f"{middle:{spec}}" if np.isfinite(middle) else "-"


if __name__ == "__main__":
    run(Config, main, report, __doc__)
