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
from paper.common import as_in_the_paper, bootstrap, figure, numbers, picture
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
from paper.rates import CLOSE, FEWEST, ROUNDING, Rate, rate
from runner import FolderSettings, Result, Statement, between, interval, opening, progress, run, table

import lqrsim as ls

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
        case: {solver: rates(measured["quadrotor"], case, solver) for solver in (SMOOTHING, ILQR, FINISHED)}
        for case in (WITH, WITHOUT)
    }
    both = (SMOOTHING, ILQR)
    predicted = {solver: [one.discarded[solver] for one in measured["quadrotor"]] for solver in both}
    factors = {solver: [one.factor for one in rates_of(measured["quadrotor"], WITH, solver)] for solver in both}
    result["discarded"] = {solver: explained(predicted[solver], factors[solver]) for solver in both}
    result["settling"] = settling.measure(1 if config.quick else PLANAR)
    result["slope"] = slope([one.logs[WITH][SMOOTHING] for one in measured["quadrotor"]])
    result["consistency"] = {
        robot: {
            form: {
                stop: {
                    what: numbers([np.max([one.consistency[form][stop][what] for one in found])], 4)[0]
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
        draw_iterations(drawn, logs, WITH, both, PAPER_STOP)
    with figure(config, result, "convergence_order", (11, 3.9)) as drawn:
        draw_order(
            drawn,
            [one.logs for one in measured["quadrotor"]],
            (WITH, WITHOUT),
            factors,
            predicted,
        )
    with figure(config, result, "ellipsoids", (8.6, 5.6)) as drawn:
        (drive,) = robots["drive"]
        problem = as_in_the_paper(drive.problem)
        ends = {"after one iteration": smooth(drive, problem, most=1), "at the end": smooth(drive, problem)}
        draw_ellipsoids(drawn, drive, ends)
    return result


def rates_of(found: Sequence[Measured], case: str, solver: str) -> list[Rate]:
    """The rate of each query."""
    return [rate(np.array([iteration.cost for iteration in one.logs[case][solver]])) for one in found]


def rates(found: Sequence[Measured], case: str, solver: str) -> dict[str, Any]:
    """What is said of the rates of all queries."""
    each = rates_of(found, case, solver)
    orders = np.array([one.order for one in each])
    return {
        "queries": len(each),
        "iterations": float(np.median([len(one.logs[case][solver]) for one in found])),
        "determined": int(np.isfinite(orders).sum()),
        "second": int((orders > SECOND).sum()),
        "medians": {what: middle([getattr(one, what) for one in each]) for what in ("order", "factor")},
    }


def middle(values: Iterable[float]) -> list[float]:
    """The median of the known values, with its interval where there are several; empty without any."""
    known = [value for value in values if np.isfinite(value)]
    return interval(bootstrap(np.median, known)) if len(known) > 1 else known


def explained(predicted: Sequence[float], measured: Sequence[float]) -> dict[str, list[float]]:
    """The factor that what is thrown away predicts, and how many such steps of Gauss-Newton an iteration is worth."""
    with np.errstate(divide="ignore"):
        worth = np.log(measured) / np.log(predicted)
    return {"median": middle(predicted), "worth": middle(worth)}


def slope(logs: Sequence[Sequence[ls.types.Iteration]]) -> list[float]:
    """The power of the improvement that smoothing's gap goes with."""
    slopes = []
    for log in logs:
        gap, improvement = (np.array([getattr(one, what) for one in log]) for what in ("gap", "improvement"))
        small = (improvement < 1e-3) & (improvement > 1e-11)
        slopes.append(np.polyfit(np.log(improvement[small]), np.log(gap[small]), 1)[0] if small.sum() > 2 else np.nan)
    return middle(slopes)


def said(estimate: Sequence[float], spec: str = ".3f") -> str:
    if not estimate:
        return "-"
    return between(estimate, spec) if len(estimate) == 3 else f"{estimate[0]:{spec}}"


def settled(result: Result) -> tuple[list[float], int]:
    """The median order of the interior point's last steps with its interval, and of how many problems that is known."""
    orders = [order for order in result["settling"].values() if order is not None]
    return middle(orders), len(orders)


def worst(result: Result, stop: str, what: str) -> float:
    """The worst value of all queries of both robots; infinite if one is unknown."""
    values = [found[stop][what] for robot in result["consistency"].values() for found in robot.values()]
    return float("inf") if None in values else max(values)


def report(result: Result) -> str:
    rows = [
        [
            f"{case}, {solver}", f"{found['iterations']:g}", f"{found['determined']}/{found['queries']}",
            said(found["medians"]["order"]), said(found["medians"]["factor"]),
        ]
        for case, solvers in result["rates"].items()
        for solver, found in solvers.items()
    ]  # fmt: skip
    kept = [
        [f"{robot}, {form} form, {stop}", *(f"{found[stop][what]:.1e}" for what in ("residual", "controls"))]
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
                f"Size of the relative improvement, and gap, by iteration: up to {LINES} queries and the median of all",
            ),
            "Iterations until rounding stops them. The order is the slope of log error against the log error before,"
            f" over relative errors in cost from {CLOSE:g} down to {ROUNDING:g}; the factor is what an iteration"
            " multiplies the error by at the end. Medians over the queries in which they are determined, by"
            f" {FEWEST} errors or more. A run with fewer is too fast to have an order: it counts as one over {SECOND}.",
            table(("quadrotor", "iterations", "determined", "order", "factor"), rows),
            picture(
                result,
                "convergence_order",
                "Each error against the one before, and the factors against those that the curvature which is thrown"
                " away predicts",
            ),
            "The interior point's orders are those of the errors of its controls, from beside the optimum, without a"
            f" barrier, where {settling.FEWEST} errors lie between {settling.CLOSE:g} and {settling.ROUNDING:g}.",
            "By how much, at most over all queries and steps and in SI units, minimal-total-cost states miss one step"
            " of the true dynamics, integrated independently of the package, and the two policies differ there; the gap"
            f" goes as the improvement to the power of {said(result['slope'])}:",
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
    found = result["rates"]
    medians = {case: {solver: one["medians"] for solver, one in found[case].items()} for case in found}
    constant, orders = (
        medians[WITH][SMOOTHING],
        {case: {who: one["order"] for who, one in both.items()} for case, both in medians.items()},
    )
    # Second order leaves two errors in a tail of ten decades: what is too fast to have an order must not be left out.
    fast = {
        case: {who: (one["second"] + one["queries"] - one["determined"], one["queries"]) for who, one in both.items()}
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
            paper="the improvement declines by about a constant factor an iteration",
            test=f"the median order of smoothing is from {CONSTANT[0]} to {CONSTANT[1]}",
            ours=f"order {said(constant['order'])}, factor {said(constant['factor'])}",
            holds=bool(constant["order"]) and CONSTANT[0] <= constant["order"][0] <= CONSTANT[1],
            figure="convergence",
        ),
        Statement(
            where="Sec. VI-B",
            paper="second order was not observed, for neither iLQR nor smoothing",
            test=f"an order over {SECOND} in at most {100 * FEW:g} % of the queries",
            ours=", ".join(f"{who} {some} of {of}" for who, (some, of) in fast[WITH].items()),
            holds=all(some <= FEW * of for some, of in fast[WITH].values()),
            figure="convergence_order",
        ),
        Statement(
            where="Sec. VI-B",
            paper="second order was not observed; Newton's method at the end has it",
            test=f"an order over {SECOND} in {100 - 100 * FEW:g} % of the queries",
            ours=", ".join(f"{case} {some} of {of}" for case, (some, of) in newton.items()),
            holds=all(some >= (1 - FEW) * of for some, of in newton.values()),
            figure="convergence_order",
        ),
        Statement(
            where="Sec. VI-B",
            paper="second order was not observed; the interior point has it where constraints act",
            test=f"the median order of its last steps is over {SECOND}",
            ours=f"order {said(order)} of {known} of {len(result['settling'])} problems",
            holds=bool(order) and order[0] > SECOND,
            figure="convergence_order",
        ),
        Statement(
            where="Sec. VI-B",
            paper="that is due to the negative curvature of obstacles, which is thrown away: it makes the factor",
            test=f"it predicts iLQR's factor: {EXPLAINED[0]} to {EXPLAINED[1]} steps of Gauss-Newton an iteration",
            ours=f"{said(worth, '.2f')} steps; predicted {said(alone)}, measured {said(medians[WITH][ILQR]['factor'])}",
            holds=bool(worth) and EXPLAINED[0] <= worth[0] <= EXPLAINED[1],
            figure="convergence_order",
        ),
        Statement(
            where="Sec. VI-B",
            paper="nothing else stands in the way of second order",
            test=f"without obstacles, the order of both is over {SECOND} in half of the queries",
            ours=", ".join(f"{who} {said(orders[WITHOUT][who])}" for who in (SMOOTHING, ILQR))
            + "; the second derivatives of the dynamics are left out, too",
            holds=all(mostly[WITHOUT].values()),
            figure="convergence_order",
        ),
        Statement(
            where="Sec. V-C",
            paper="the rate of the iterations, Gauss-Newton updates, approaches second order",
            test=f"the order of smoothing is over {SECOND} in half of the queries, with obstacles or without",
            ours=", ".join(f"{case} {said(orders[case][SMOOTHING])}" for case in orders),
            holds=any(both[SMOOTHING] for both in mostly.values()),
            figure="convergence_order",
        ),
        *(
            Statement(
                where="Sec. V-C, Eq. (22)",
                paper=f"upon convergence {claim}",
                test=f"to {EXACT:g} in SI units, run on until rounding",
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
