"""The weights of a problem tuned so that its policy fails least in closed loop: the quadrotor in its cage.

    python experiments/tune_weights.py            # a minute and a half
    python experiments/tune_weights.py --quick

Five weights are tuned, in factors of those of the scenario. Each choice is planned, and the policy runs in MuJoCo under
a preset of disturbances. All choices meet the same trials, so that their rates differ by little chance. A count of
failures has steps, and a search sees no way on them. In its place stands a smooth one: a trial that passes the
obstacles closely counts as a part of a failure. Nelder and Mead's search needs no more. What it finds is compared with
the scenario's own weights on trials that the search has not seen, also under a harder preset.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from runner import Result, Settings, at_most, opening, run, table
from scipy.optimize import minimize
from scipy.special import expit

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.stress.statistics import rate

# The scenario has no weight on speed; this one is small beside the others.
OWN = {"effort": 20.0, "obstacles": 1.0, "sharpness": 10.0, "speed": 0.05, "goal": 500.0}
CLOSE = 0.03  # m: with this clearance a trial counts as a quarter of a failure. Half the spread of the clearances
STRETCH = 3.0  # the search begins with each weight times this, in turn
NEVER = 1e3  # worse than any plan that converged


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    preset: str = "calm"
    """Of the disturbances in the search."""
    harder: str = "light"
    """Of those for which the weights are not tuned."""
    trials: int = 200
    """That the search sees."""
    evaluations: int = 70
    """Plans that the search makes."""
    fresh: int = 2000
    """Trials on which the weights are compared."""
    seed: int = 0
    """Of the search's trials; the fresh ones have the next."""


def weights_of(factors: Array) -> list[float]:
    """The weights, given the logarithms (5,) of their factors."""
    return (np.array(list(OWN.values())) * np.exp(factors)).tolist()


def own_problem() -> ls.Problem:
    """The scenario's problem from exactly its start, which other weights would let plans leave."""
    stated = ls.scenarios.quadrotor().problem
    assert stated.start is not None
    return replace(stated, initial=ls.FixedState(stated.start))


def problem_of(factors: Array) -> ls.Problem:
    """The same with other weights."""
    scenario, own = ls.scenarios.quadrotor(), own_problem()
    effort, obstacles, sharpness, speed, goal = weights_of(factors)
    moves = np.array([unit in ("m/s", "rad/s") for unit in own.dynamics.state_coordinates.units])
    assert isinstance(own.final_cost, ls.QuadraticCost)
    return replace(
        own,
        stage_cost=ls.ControlCost(np.full(4, effort), about=own.nominal_control)
        + ls.ObstacleCost(scenario.scene.world, radius=scenario.robot.radius, sharpness=sharpness, weight=obstacles)
        + ls.QuadraticCost(speed * moves, about=np.zeros(len(moves))),
        final_cost=own.final_cost.scaled(goal / OWN["goal"]),
    )


def runs_of(solution: ls.Solution, preset: str, trials: int, seed: int) -> ls.Rollout:
    plant = ls.scenarios.quadrotor().plant()
    disturbances = ls.disturbances.preset(preset, plant)
    return ls.simulate(plant, solution, disturbances=disturbances, trials=trials, seed=seed, frames=False)


def smooth_failures(runs: ls.Rollout) -> float:
    """The share of failures, where a trial that reaches the goal counts by how closely it passes the obstacles."""
    close = expit(-runs.clearance.min(axis=1) / CLOSE)
    missed = np.isin(runs.outcome, ("reached", "collided"), invert=True)  # as timed out
    return float(np.where(missed, 1.0, close).mean())


def main(config: Config) -> Result:
    config = at_most(config, trials=20, evaluations=8, fresh=50)

    def failures(factors: Array) -> float:
        solution = ls.smooth(problem_of(factors))
        return (
            smooth_failures(runs_of(solution, config.preset, config.trials, config.seed)) if solution.success else NEVER
        )

    simplex = np.vstack([np.zeros(len(OWN)), np.log(STRETCH) * np.eye(len(OWN))])
    options = {"maxfev": config.evaluations, "initial_simplex": simplex, "xatol": 0.0, "fatol": 0.0}
    found = minimize(failures, np.zeros(len(OWN)), method="Nelder-Mead", options=options)
    problems = {"the scenario's": own_problem(), "tuned": problem_of(found.x)}
    return opening(config) | {
        "evaluations": found.nfev,
        "weights": dict(zip(OWN, weights_of(found.x), strict=True)),
        "rows": {name: row_of(problem, config) for name, problem in problems.items()},
    }


def row_of(problem: ls.Problem, config: Config) -> dict[str, Any]:
    """The plan, and how often its policy fails: on the search's trials, on fresh ones, and under the harder preset."""
    solution, goal = ls.smooth(problem), problem.goal
    fresh = config.fresh, config.seed + 1
    asked = (config.preset, config.trials, config.seed), (config.preset, *fresh), (config.harder, *fresh)
    found = [rate(failures_in(runs_of(solution, *one)), one[1]) for one in asked]
    assert solution.clearance is not None
    assert goal is not None
    return {
        "clearance": float(solution.clearance.min()),
        "off": float(np.linalg.norm((solution.trajectory.states[-1] - goal)[:3])),
        "fails": [[one.value, one.low, one.high] for one in found],
    }


def failures_in(runs: ls.Rollout) -> int:
    return sum(outcome != "reached" for outcome in runs.outcome)


def report(result: Result) -> str:
    rows = []
    for name, one in result["rows"].items():
        fails = [f"{100 * value:.1f} ({100 * low:.1f} to {100 * high:.1f})" for value, low, high in one["fails"]]
        rows.append([name, f"{one['clearance']:.3f}", f"{one['off']:.3f}", *fails])
    presets = result["config"]["preset"], result["config"]["harder"]
    head = (
        "weights",
        "clearance of the plan (m)",
        "its end off the goal (m)",
        "failures (%), in the search",
        *(f"fresh, {one}" for one in presets),
    )
    tuned = [[name, f"{own:g}", f"{result['weights'][name]:.3g}"] for name, own in OWN.items()]
    return "\n\n".join(
        [
            f"{result['evaluations']} plans in the search.",
            table(head, rows),
            table(("weight", "before", "tuned"), tuned),
        ]
    )


if __name__ == "__main__":
    run(Config, main, report, __doc__)
