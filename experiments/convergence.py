"""How fast smoothing and iLQR converge, and what holds at convergence: Secs. V-C and VI-B.

    python experiments/convergence.py            # 100 of the quadrotor's queries, and the differential drive
    python experiments/convergence.py --quick    # 2 queries

Begun as in the paper (soft start, its priors, no limits of the controls; iLQR from hover), the iterations go on until
rounding stops them. Smoothing is without its safeguard, which would take over where costs no longer change; and once
more with Newton's method for the last iterations. Everything is done again with an obstacle weight of zero. Of problems
with constraints the last steps of the interior point are measured, by `paper/settling.py`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from paper import settling
from paper.common import as_in_the_paper, figure, numbers, picture
from paper.convergence_figures import ABOVE, EVERY, LINES, draw_ellipsoids, draw_iterations, draw_order
from paper.convergence_runs import (
    FINISHED,
    ILQR,
    PAPER_STOP,
    RUN_ON,
    SMOOTHING,
    STOPPED,
    STOPS,
    WITH,
    WITHOUT,
    Measured,
    measure,
    smooth,
)
from paper.rates import CLOSE, FEWEST, ROUNDING, rate
from runner import FolderSettings, Result, Statement, between, interval, opening, progress, run, table

import lqrsim as ls
from lqrsim.stress.statistics import bootstrap

SHOWN = (1, 2, 4, 8, 16, 32)  # iterations whose gap is told

CONSTANT, SECOND = (0.8, 1.3), 1.5  # orders that count as a constant factor; as second order, from there on
FEW = 0.05  # share of queries that does not count
EXPLAINED = 0.8, 1.25  # measured against predicted logarithm of the factor: a quarter more or less
PLANAR = 15  # problems of the planar quadrotor
EXACT = 1e-6  # in SI units: what counts as satisfying the dynamics


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    queries: int = 100
    """How many random starts and goals."""
    seed: int = 0
    """Of the queries."""


def main(config: Config) -> Result:
    count = min(config.queries, 2) if config.quick else config.queries
    robots = {
        "quadrotor": [ls.scenarios.quadrotor(query=query, seed=config.seed) for query in range(count)],
        "drive": [ls.scenarios.differential_drive()],
    }
    measured = {robot: [measure(one) for one in progress(them, robot)] for robot, them in robots.items()}
    result = opening(config)
    result["rates"] = {
        robot: {
            case: {solver: rates(found, case, solver) for solver in (SMOOTHING, ILQR, FINISHED)}
            for case in (WITH, WITHOUT)
        }
        for robot, found in measured.items()
    }
    result["discarded"] = {
        solver: explained(
            [one.discarded[solver] for one in measured["quadrotor"]],
            result["rates"]["quadrotor"][WITH][solver]["factor"],
        )
        for solver in (SMOOTHING, ILQR)
    }
    result["settling"] = settling.measure(1 if config.quick else PLANAR)
    result["gap"] = gaps([one.logs[WITH][SMOOTHING] for one in measured["quadrotor"]])
    result["consistency"] = {
        robot: {
            form: {
                stop: {
                    what: numbers((one.consistency[form][stop][what] for one in found), 4)
                    for what in ("residual", "controls")
                }
                for stop in STOPS
            }
            for form in ("dual", "primal")
        }
        for robot, found in measured.items()
    }
    logs = {robot: [one.logs for one in found] for robot, found in measured.items()}
    with figure(config, result, "convergence", (9, 3.2)) as drawn:
        draw_iterations(drawn, logs, WITH, (SMOOTHING, ILQR), PAPER_STOP)
    with figure(config, result, "convergence_order", (11, 3.9)) as drawn:
        draw_order(
            drawn,
            [one.logs for one in measured["quadrotor"]],
            (WITH, WITHOUT),
            {solver: result["rates"]["quadrotor"][WITH][solver] for solver in (SMOOTHING, ILQR)},
            result["discarded"],
        )
    with figure(config, result, "ellipsoids", (8.6, 5.6)) as drawn:
        (drive,) = robots["drive"]
        problem = as_in_the_paper(drive.problem)
        ends = {"after one iteration": smooth(drive, problem, most=1), "at the end": smooth(drive, problem)}
        draw_ellipsoids(drawn, drive, ends)
    return result


def rates(found: Sequence[Measured], case: str, solver: str) -> dict[str, Any]:
    """The rate of each query, and the medians."""
    logs = [one.logs[case][solver] for one in found]
    each = [rate(np.array([iteration.cost for iteration in log])) for log in logs]
    orders = np.array([one.order for one in each])
    return {
        "iterations": [len(log) for log in logs],
        "order": numbers(orders),
        "factor": numbers(one.factor for one in each),
        "determined": int(np.isfinite(orders).sum()),
        "second": int((orders > SECOND).sum()),
        "medians": {what: middle([getattr(one, what) for one in each]) for what in ("order", "factor", "spread")},
    }


def middle(values: Iterable[float]) -> list[float]:
    """The median of the known values, with its interval where there are several; empty without any."""
    known = [value for value in values if np.isfinite(value)]
    return interval(bootstrap(np.median, known)) if len(known) > 1 else known


def explained(factors: Sequence[float], measured: Sequence[float | None]) -> dict[str, Any]:
    """What is thrown away, by itself, against what was measured, and how many steps of Gauss-Newton an iteration is."""
    known = np.array([np.nan if factor is None else factor for factor in measured])
    with np.errstate(divide="ignore"):
        worth = np.log(known) / np.log(factors)
    return {"factor": numbers(factors), "median": middle(factors), "worth": middle(worth)}


def gaps(logs: Sequence[Sequence[ls.types.Iteration]]) -> dict[str, Any]:
    """Of smoothing: the gap at some iterations (the last one of those that ended before), and how it goes with cost."""
    at = [[log[min(number, len(log)) - 1].gap for log in logs] for number in SHOWN]
    slopes, stopped = [], []
    for log in logs:
        gap, improvement = (np.array([getattr(one, what) for one in log]) for what in ("gap", "improvement"))
        stopped.append(gap[np.flatnonzero(np.abs(improvement) < PAPER_STOP)[0]])
        small = (improvement < 1e-3) & (improvement > 1e-11)
        slopes.append(np.polyfit(np.log(improvement[small]), np.log(gap[small]), 1)[0] if small.sum() > 2 else np.nan)
    return {
        "iterations": {
            str(number): numbers(np.percentile(them, (5, 50, 95)), 3) for number, them in zip(SHOWN, at, strict=True)
        },
        STOPPED: numbers(np.percentile(stopped, (5, 50, 95)), 3),
        "slope": middle(slopes),
    }


def said(estimate: Sequence[float], spec: str = ".3f") -> str:
    if not estimate:
        return "-"
    return between(estimate, spec) if len(estimate) == 3 else f"{estimate[0]:{spec}}"


def settled(result: Result) -> tuple[list[float], int]:
    """The median order of the interior point's last steps with its interval, and of how many problems that is known."""
    orders = [np.nan if one["order"] is None else one["order"] for one in result["settling"].values()]
    return middle(orders), int(np.isfinite(orders).sum())


def worst(result: Result, stop: str, what: str, forms: Iterable[str] = ("dual", "primal")) -> float:
    """The worst value of all queries of both robots; infinite if one is unknown."""
    values = [value for robot in result["consistency"].values() for form in forms for value in robot[form][stop][what]]
    return float("inf") if None in values else max(values)


def report(result: Result) -> str:
    rows = []
    for robot, cases in result["rates"].items():
        for case, solvers in cases.items():
            for solver, found in solvers.items():
                medians, iterations = found["medians"], f"{np.median(found['iterations']):.0f}"
                determined = f"{found['determined']}/{len(found['order'])}"
                rates_said = said(medians["order"]), said(medians["factor"]), said(medians["spread"], ".2f")
                rows.append([f"{robot}, {case}, {solver}", iterations, determined, *rates_said, found["second"]])
    head = ("", "iterations", "determined", "order", "factor", "spread of the factor", f"order over {SECOND}")
    origin = [
        [
            solver,
            said(result["rates"]["quadrotor"][WITH][solver]["medians"]["factor"]),
            said(one["median"]),
            said(one["worth"], ".2f"),
        ]
        for solver, one in result["discarded"].items()
    ]
    gap = result["gap"]
    opened = [
        [f"iteration {number}", *(f"{value:.1e}" for value in them)] for number, them in gap["iterations"].items()
    ]
    opened.append([STOPPED, *(f"{value:.1e}" for value in gap[STOPPED])])
    closing = [
        [
            name,
            "-" if one["order"] is None else f"{one['order']:.2f}",
            " ".join(f"{error:.0e}" for error in one["errors"][:6]) or one["status"].lower(),
        ]
        for name, one in result["settling"].items()
    ]
    kept = [
        [f"{robot}, {form} form, {stop}", *(f"{np.max(found[stop][what]):.1e}" for what in ("residual", "controls"))]
        for robot, forms in result["consistency"].items()
        for form, found in forms.items()
        for stop in STOPS
    ]
    return "\n\n".join(
        [
            "## Convergence",
            picture(
                result,
                "convergence",
                f"Size of the relative improvement, and gap, by iteration: up to {LINES} queries, the median of all, in"
                " which those that have ended count as zero",
            ),
            "Iterations until rounding stops them. The order is the slope of log error against the log error before,"
            f" by least squares over the tail (relative errors in cost from {CLOSE:g} down to {ROUNDING:g}, or to a"
            " hundred times the last change, if that is more). The factor is what an iteration multiplies the error by"
            " at the end of the tail; its spread is the 90th over the 10th percentile of the factors in a tail. Medians"
            f" over queries, 95 % bootstrap intervals, of those that are determined: by {FEWEST} errors or more. A run"
            " that goes through its tail in fewer is too fast to have an order, and counts as one over"
            f" {SECOND} where the statements ask for it.",
            table(head, rows),
            picture(result, "convergence_order", "Each error against the one before, and what explains the factors"),
            "The curvature that the projection of the obstacle term throws away tells, at the optimum, what a step of"
            " Gauss-Newton would multiply the error by if everything else were exact. How many such steps an iteration"
            " is worth is the ratio of the logarithms:",
            table(("quadrotor", "factor, measured", "of what is thrown away", "steps an iteration is worth"), origin),
            "The interior point's last steps, without a barrier, from beside the optimum of problems with constraints:"
            " errors are those of the controls, relative to what these change by. Constraints are held by a weight and"
            " their multipliers follow, which leaves a small factor at the end. A dash: fewer than"
            f" {settling.FEWEST} errors from {settling.CLOSE:g} down to {settling.ROUNDING:g}, or the rows that press"
            " were others:",
            table(("problem", "order", "errors"), closing),
            "The gap of smoothing is the largest relative difference between minimal-total-cost states and rollout; in"
            f" the tail it goes as the improvement to the power of {said(gap['slope'])}. A query that ended before an"
            " iteration counts with its last gap:",
            table(("gap, quadrotor", "5 %", "median", "95 %"), opened),
            "By how much, at most over all queries and steps and in SI units, minimal-total-cost states miss one step"
            " of the true dynamics, integrated independently of the package, and the two policies differ there:",
            table(("", "dynamics", "policies"), kept),
            picture(
                result,
                "ellipsoids",
                f"Differential drive, every {EVERY:g} s of its plan: where cost-to-go, cost-to-come and total cost are"
                f" {ABOVE:g} above their least, whatever the heading, and, marked, where each is least",
            ),
        ]
    )


def statements(result: Result) -> list[Statement]:
    found = result["rates"]["quadrotor"]
    medians = {case: {solver: one["medians"] for solver, one in found[case].items()} for case in found}
    constant, orders = (
        medians[WITH][SMOOTHING],
        {case: {who: one["order"] for who, one in both.items()} for case, both in medians.items()},
    )
    # Second order leaves two errors in a tail of ten decades: what is too fast to have an order must not be left out.
    fast = {
        case: {
            who: (one["second"] + len(one["order"]) - one["determined"], len(one["order"])) for who, one in both.items()
        }
        for case, both in found.items()
    }
    newton = {case: both.pop(FINISHED) for case, both in fast.items()}
    mostly = {case: {who: 2 * some >= of for who, (some, of) in both.items()} for case, both in fast.items()}
    alone, worth = (result["discarded"][ILQR][what] for what in ("median", "worth"))
    order, known = settled(result)
    missed, apart = ({stop: worst(result, stop, what) for stop in STOPS} for what in ("residual", "controls"))
    return [
        Statement(
            where="Sec. VI-B",
            paper="the relative improvement typically declined by about a constant factor with each iteration",
            test=f"the median order of smoothing is from {CONSTANT[0]} to {CONSTANT[1]}",
            ours=f"order {said(constant['order'])}, factor {said(constant['factor'])}",
            holds=bool(constant["order"]) and CONSTANT[0] <= constant["order"][0] <= CONSTANT[1],
            figure="convergence",
        ),
        Statement(
            where="Sec. VI-B",
            paper="a second-order convergence rate was not observed, for neither iLQR nor smoothing",
            test=f"an order over {SECOND}, or too fast for one, in at most {100 * FEW:g} % of the queries of either",
            ours=", ".join(f"{who} {some} of {of}" for who, (some, of) in fast[WITH].items()),
            holds=all(some <= FEW * of for some, of in fast[WITH].values()),
            figure="convergence_order",
        ),
        Statement(
            where="Sec. VI-B",
            paper="a second-order convergence rate was not observed; Newton's method at the end has one",
            test=f"an order over {SECOND}, or too fast for one, in {100 - 100 * FEW:g} % of the queries",
            ours=", ".join(f"{case} {some} of {of}" for case, (some, of) in newton.items()),
            holds=all(some >= (1 - FEW) * of for some, of in newton.values()),
            figure="convergence_order",
        ),
        Statement(
            where="Sec. VI-B",
            paper="a second-order convergence rate was not observed; the interior point has one where constraints act",
            test=f"the median order of its last steps is over {SECOND}",
            ours=f"order {said(order)} of {known} of {len(result['settling'])} problems",
            holds=bool(order) and order[0] > SECOND,
            figure="convergence_order",
        ),
        Statement(
            where="Sec. VI-B",
            paper="that is likely due to how the obstacle term is quadratized: negative curvature is thrown away;"
            " it makes the constant factor",
            test=f"what is thrown away predicts iLQR's factor by itself: {EXPLAINED[0]} to {EXPLAINED[1]} steps of"
            " Gauss-Newton an iteration, in the median",
            ours=f"{said(worth, '.2f')} steps; predicted {said(alone)}, measured {said(medians[WITH][ILQR]['factor'])}",
            holds=bool(worth) and EXPLAINED[0] <= worth[0] <= EXPLAINED[1],
            figure="convergence_order",
        ),
        Statement(
            where="Sec. VI-B",
            paper="that is likely due to how the obstacle term is quadratized: negative curvature is thrown away;"
            " nothing else stands in the way of second order",
            test=f"without obstacles, the order of both is over {SECOND} in half of the queries",
            ours=", ".join(f"{who} {said(orders[WITHOUT][who])}" for who in (SMOOTHING, ILQR))
            + "; the second derivatives of the dynamics are left out, too, as in all Gauss-Newton methods",
            holds=all(mostly[WITHOUT].values()),
            figure="convergence_order",
        ),
        Statement(
            where="Sec. V-C",
            paper="the iterations are Gauss-Newton updates and should exhibit a rate approaching second order",
            test=f"the order of smoothing is over {SECOND} in half of the queries, with obstacles or without",
            ours=", ".join(f"{case} {said(orders[case][SMOOTHING])}" for case in orders),
            holds=any(both[SMOOTHING] for both in mostly.values()),
            figure="convergence_order",
        ),
        *(
            Statement(
                where="Sec. V-C, Eq. (22)",
                paper=f"upon convergence {claim}",
                test=f"to {EXACT:g} in SI units, in every query of both robots and forms, run on until rounding",
                ours=f"{them[RUN_ON]:.1e} at most; {them[STOPPED]:.1e} at the paper's stop",
                holds=them[RUN_ON] <= EXACT,
                figure="convergence",
            )
            for claim, them in (
                ("the minimal-total-cost states satisfy the true dynamics", missed),
                ("policy and inverse policy give the same controls there", apart),
            )
        ),
    ]


if __name__ == "__main__":
    run(Config, main, report, __doc__, statements=statements)
