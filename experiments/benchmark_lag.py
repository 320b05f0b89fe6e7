"""Whether a lag that is stated has to be there: output feedback for each preset, with another lag than its own.

    python experiments/benchmark_lag.py                              # 4 robots, 3 presets, 4 lags: some 10 minutes
    python experiments/benchmark_lag.py --robots arm --trials 20     # less
    python experiments/benchmark_lag.py --quick                      # too few to trust

`OffsetFree` is told of a preset, and runs in it with 1, 0.5, 0 and 2 times its `MotorLag`. The other disturbances of a
trial are the same whatever the lag. Tolerances are chosen; what the filter is told of the lag is printed, and how far
the robot is from its plan with the lag and without it, rms over the plan, in m or relative to the plan's range. Rows
"the same, at its word" are those of designs that take the lag for certain, with `memory=np.inf`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from benchmark_sensors import PRESETS, planned
from mjcf.files import TWO_LINKS
from runner import Settings, at_most, between, opening, progress, run, table

import lqrsim as ls
from lqrsim.disturbances import Disturbance, MotorLag
from lqrsim.stress.statistics import rate

ROBOTS = ("quadrotor", "differential drive", "cart-pole", "arm")
TIMES = (1.0, 0.5, 0.0, 2.0)


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    trials: int = 200
    """Of each robot, preset and lag."""
    robots: tuple[str, ...] = ROBOTS
    """Which: quadrotor, "differential drive", cart-pole, arm, or my_robot, the template."""
    presets: tuple[str, ...] = PRESETS
    """Which."""
    seed: int = 0
    """Of the disturbances."""


def main(config: Config) -> dict[str, Any]:
    config = at_most(config, trials=5)
    cases = [(*case, memory) for case in product(config.robots, config.presets) for memory in (None, np.inf)]
    return opening(config) | {"rows": [measure(*case, config) for case in progress(cases, "cases")]}


def measure(robot: str, preset: str, memory: float | None, config: Config) -> dict[str, Any]:
    """How many trials reach the goal with each lag."""
    problem, plan, plant = arm() if robot == "arm" else planned(robot)
    given = ls.disturbances.preset(preset, plant)
    law = ls.OffsetFree(problem, plan, ls.uncertainty_of(plant, given), memory=memory)
    reached, errors = list[int](), list[float]()
    for times in TIMES:
        rollout = ls.simulate(
            plant, plan, controller=law, disturbances=with_lag(given, times), trials=config.trials, seed=config.seed,
            frames=False, contacts=False,
        )  # fmt: skip
        errors.append(float(np.sqrt(np.nanmean(rollout.tracking_error**2))))
        reached.append(int((np.array(ls.stress.outcomes(rollout).outcome) == "reached").sum()))
    told = law.model.uncertainty.lag / law.uncertainty.lag
    return {
        "robot": robot, "preset": preset, "periods": law.uncertainty.lag / problem.dt, "told": told,
        "at_its_word": memory is not None, "trials": config.trials, "reached": reached, "errors": errors,
    }  # fmt: skip


def with_lag(disturbances: Sequence[Disturbance], times: float) -> list[Disturbance]:
    """The disturbances with their lag times a number."""
    return [one.scaled(times) if isinstance(one, MotorLag) else one for one in disturbances]


@cache
def arm() -> tuple[ls.Problem, ls.Solution, ls.Plant]:
    """Problem, plan and plant of an arm of two links."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "two_links.xml"
        path.write_text(TWO_LINKS, encoding="utf-8")
        robot = ls.MjcfRobot(str(path))
    start, goal = robot.at(shoulder=0.6, elbow=-1.2), robot.at(shoulder=-1.2, elbow=-0.3)
    problem = robot.problem(start, goal, steps=60, dt=0.02)
    return problem, ls.smooth(problem), ls.Plant(robot, robot.scene)


def report(result: dict[str, Any]) -> str:
    rows = []
    for row in result["rows"]:
        shares = [rate(count, row["trials"]) for count in row["reached"]]
        cells = [between([100 * one.value, 100 * one.low, 100 * one.high], ".0f") for one in shares]
        label = "the same, at its word" if row["at_its_word"] else f"{row['robot']}, {row['preset']}"
        rows.append((label, f"{row['periods']:.2g}", f"{row['told']:g}", *cells))
        rows[-1] += tuple(f"{row['errors'][TIMES.index(times)]:.2g}" for times in (1.0, 0.0))
    reached = f"reached of {result['rows'][0]['trials']}, %"
    heads = (f"{times:g} of it" for times in TIMES)
    return table((reached, "lag in periods", "told", *heads, "error with it", "without"), rows)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
