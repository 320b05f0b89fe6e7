"""Other people's solvers on the same work: what a re-plan takes, and what the closed loop costs."""

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import peers
from peers.contestants import installed
from runner import progress, table

import lqrsim as ls
from lqrsim.errors import Array
from replan.common import Config, scenario_of, stated

OURS, ILQR, FDDP, FATROP = "lqrsim, prepare", "lqrsim, ilqr", "Crocoddyl, box-FDDP", "Fatrop, by CasADi"
HORIZONS = 2  # how long a run is: with a moving horizon the robot is not at its goal after one
# Of Fatrop, as lqrsim and FDDP have them. Each solve begins with a plan that is nearly optimal, so the barrier begins
# low: with Fatrop's own 0.1 it takes an iteration more from such a plan.
OPTIONS: dict[str, Any] = {"tol": peers.TOLERANCE, "max_iter": peers.MAX_ITERATIONS, "mu_init": 1e-4}
NO_ACADOS = "there is no wheel of it or of its interface to Python, and CasADi's wheel has no interface to it"


@dataclass(frozen=True)
class Made:
    """What a solver answers with.

    Attributes:
      control: (m,) the first of its plan. following: what it begins with one control period later.
    """

    control: Array
    iterations: int
    converged: bool
    following: Any


Again = Callable[[Array, Any], Made]
"""From a state (n,) and what to begin with, the new plan."""


@dataclass(frozen=True)
class Contestant:
    """A solver for one query; `first` is the plan that all begin with, as this solver wants it."""

    again: Again
    first: Any


class EveryPeriod:
    """The first control of a new plan in each control period, at once, however long the solve took. For one trial.

    The plan begins at the state that is measured, so that gains have nothing to correct.
    """

    def __init__(self, contestant: Contestant) -> None:
        self._again, self._begin = contestant.again, contestant.first
        self.seconds: list[float] = []
        self.made: list[tuple[int, bool]] = []

    def __call__(self, state: Array, t: float) -> Array:
        clock = time.perf_counter()
        made = self._again(state, self._begin)
        self.seconds.append(time.perf_counter() - clock)
        self.made.append((made.iterations, made.converged))
        self._begin = made.following
        return made.control


def prepared(problem: ls.Problem, solution: ls.Solution) -> Contestant:
    solver = ls.prepare(problem, tolerance=1e-4)

    def again(state: Array, begin: ls.Solution | ls.types.Replan) -> Made:
        found = solver.solve(state, begin)
        return Made(found.trajectory.controls[0], found.iterations, found.success, found.shifted(1))

    return Contestant(again, solution)


def ilqr(problem: ls.Problem, solution: ls.Solution) -> Contestant:
    def again(state: Array, begin: ls.Solution) -> Made:
        found = ls.ilqr(problem.from_state(state), start=begin)
        return Made(found.trajectory.controls[0], len(found.iterations), found.success, found.shifted(1))

    return Contestant(again, solution)


def theirs(solver: peers.Crocoddyl | peers.Shooting, problem: ls.Problem, solution: ls.Solution) -> Contestant:
    """Begins with states and controls shifted by a step, the last repeated; a plan that is not finite is not used."""

    def again(state: Array, begin: tuple[Array, Array]) -> Made:
        answer = solver.solve(problem.from_state(state), *begin)
        states, controls = answer.states, answer.controls
        if not (np.isfinite(states).all() and np.isfinite(controls).all()):
            states, controls = begin
        return Made(controls[0], answer.iterations, answer.converged, (shifted(states), shifted(controls)))

    return Contestant(again, (solution.trajectory.states, solution.trajectory.controls))


def shifted(rows: Array) -> Array:
    return np.concatenate([rows[1:], rows[-1:]])


def measure(config: Config) -> dict[str, Any]:
    first = stated(scenario_of("quadrotor", 0), "control limits")
    makers: dict[str, Callable[[], peers.Crocoddyl | peers.Shooting]] = {
        FDDP: lambda: peers.Crocoddyl(first, box=True),
        FATROP: lambda: peers.Shooting(first, "fatrop", compile=True, **OPTIONS),
    }
    solvers, skipped = installed(makers)
    skipped = {"acados": NO_ACADOS} | skipped
    taken: dict[str, list[dict[str, Any]]] = {name: [] for name in (OURS, ILQR, *solvers)}
    order, periods = list(taken), HORIZONS * first.steps
    runs = -(-config.plans // (config.queries * periods))
    for query in progress(range(config.queries), "peers"):
        scenario = scenario_of("quadrotor", query)
        problem = stated(scenario, "control limits")
        solution = ls.smooth(problem)
        contestants = {OURS: prepared(problem, solution), ILQR: ilqr(problem, solution)}
        contestants |= {name: theirs(solver, problem, solution) for name, solver in solvers.items()}
        for one in contestants.values():
            one.again(solution.trajectory.states[0], one.first)  # all is compiled and has its storage
        # Of this only the start and the length are used.
        whole = ls.smooth(replace(problem, steps=periods))
        gc.collect()
        gc.freeze()
        for run in range(runs):
            for name in order:
                taken[name].append(flown(config, scenario, problem, whole, contestants[name], query * runs + run))
            order = order[1:] + order[:1]
    return {
        "rows": {name: summary(flights, taken, first.dt) for name, flights in taken.items()},
        "skipped": skipped, "queries": config.queries, "runs": runs, "seconds": periods * first.dt,
        "period": 1000 * first.dt, "peers": peers.versions(),
    }  # fmt: skip


def flown(
    config: Config, scenario: ls.Scenario, problem: ls.Problem, whole: ls.Solution, contestant: Contestant, trial: int
) -> dict[str, Any]:
    """One run."""
    law = EveryPeriod(contestant)
    rollout = ls.simulate(
        scenario.plant(), whole, controller=law, disturbances=scenario.disturbances, seed=config.seed,
        first_trial=trial, frames=False, contacts=False, threads=1,
    )  # fmt: skip
    return {
        "seconds": law.seconds, "iterations": [count for count, _ in law.made],
        "converged": [converged for _, converged in law.made], "collided": bool(rollout.collided[0]),
        "cost": peers.cost_along(problem, rollout.states[0], rollout.commanded[0]),
    }  # fmt: skip


def summary(flights: list[dict[str, Any]], taken: dict[str, list[dict[str, Any]]], period: float) -> dict[str, Any]:
    """Of all runs of a solver. Costs are of the runs in which no solver's robot became unstable."""
    seconds = np.concatenate([one["seconds"] for one in flights])
    costs = np.array([[one["cost"] for one in others] for others in taken.values()])
    own, ours = np.array([one["cost"] for one in flights]), costs[0]
    kept = np.isfinite(costs).all(axis=0)
    return {
        "plans": len(seconds), "median": 1000 * float(np.median(seconds)),
        "p999": 1000 * float(np.quantile(seconds, 0.999)), "most": 1000 * float(seconds.max()),
        "late": 100 * float((seconds > period).mean()),
        "iterations": float(np.median(np.concatenate([one["iterations"] for one in flights]))),
        "converged": 100 * float(np.mean(np.concatenate([one["converged"] for one in flights]))),
        "cost": float(own[kept].mean()) if kept.any() else None,
        "more": 100 * float(np.median(own[kept] / ours[kept] - 1)) if kept.any() else None,
        "collided": sum(one["collided"] for one in flights), "lost": int((~np.isfinite(own)).sum()),
        "runs": len(flights), "compared": int(kept.sum()),
    }  # fmt: skip


def report(found: dict[str, Any]) -> list[str]:
    head = (
        "solver", "re-plans", "median (ms)", "99.9 % (ms)", "most (ms)", "longer than a period (%)",
        "iterations, median", "converged (%)", "cost of the loop, mean", "more than lqrsim's, median (%)",
        "runs that collided",
    )  # fmt: skip
    rows = []
    for name, one in found["rows"].items():
        costs = ("-", "-") if one["cost"] is None else (f"{one['cost']:.1f}", f"{one['more']:+.2f}")
        rows.append([
            name, one["plans"], f"{one['median']:.1f}", f"{one['p999']:.1f}", f"{one['most']:.1f}",
            f"{one['late']:.2f}", f"{one['iterations']:.0f}", f"{one['converged']:.1f}", *costs,
            f"{one['collided']} of {one['runs']}",
        ])  # fmt: skip
    (compared,) = {one["compared"] for one in found["rows"].values()}
    lost = [f"{name}: {one['lost']} runs became unstable" for name, one in found["rows"].items() if one["lost"]]
    left_out = [f"{name} is not among them: {why}" for name, why in found["skipped"].items()]
    return [
        "The quadrotor with its actuators' limits and the obstacles' cost, in MuJoCo under all of the scenario's noise:"
        f" {found['queries']} queries, {found['runs']} runs of {found['seconds']:g} s each, the same noise for all"
        " solvers, which take turns run by run in one process, on one thread each. Every"
        f" {found['period']:.0f} ms a plan for the next 5 s from the measured state, begun with the solver's own last"
        " plan, shifted by a step; all begin with one first plan. Its first control is commanded at once, however long"
        " the solve took, so that costs compare plans and not times. A time is of the whole call, shifting included."
        " lqrsim's solves end at a tolerance of 1e-4, FDDP at as small a change of the cost, Fatrop at as small"
        " residuals. The cost of the loop is what the true states and the commanded controls cost: controls and"
        " obstacles along the run, and the final cost at its end,"
        f" over {compared} runs of each; obstacles do not stop the robot. All but Fatrop answer with gains, too.",
        table(head, rows),
        *("\n".join(f"- {line}." for line in lines) for lines in (lost, left_out) if lines),
    ]
