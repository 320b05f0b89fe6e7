"""Gains for RotorPy's SE(3) controller on the quadrotor's query, and how often it reaches the goal with them.

    python experiments/rotorpy_gains.py                               # the table, 100 trials a line at seed 5
    python experiments/rotorpy_gains.py --search                      # the coarse search first, some ten minutes
    python experiments/rotorpy_gains.py --search --searched moderate  # the same for another preset

The search is of all combinations on two grids, one after the other: first the horizontal gains, those of the attitude
and whether the drag is fed forward, then the vertical gains, beside the four best of the first. Damping is stated as a
ratio: a velocity gain is 2 zeta times the root of its position gain. Best is what reaches the goal undisturbed and in
most trials at that preset, and of equals what has the least sum of the worst tracking error undisturbed and its median
there; the trials are others than the table's. Needs the `bench` extra.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from itertools import product

import numpy as np
from peers.rotorpy import BEST_AT_LIGHT, BEST_AT_MODERATE, DEFAULT, Gains, RotorPy
from runner import Result, Settings, at_most, opening, progress, run, table

import lqrsim as ls
from lqrsim.simulation.disturbances import preset
from lqrsim.stress.analysis import Outcomes, outcomes

# Position gain and damping: horizontally, of the attitude, and vertically.
HORIZONTAL = (6.5, 10.0, 15.0, 22.0), (0.6, 0.8, 1.1)
ATTITUDE = (60.0, 100.0, 150.0), (0.55, 0.75, 1.0)
VERTICAL = (8.0, 15.0, 25.0), (0.6, 0.9, 1.2)


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    search: bool = False
    """Search for gains, too."""
    trials: int = 100
    """Of each line of the table."""
    seed: int = 5
    """Of the table's disturbances."""
    searched: str = "light"
    """The preset of the search."""
    search_trials: int = 100
    """Of each point of the search."""
    search_seed: int = 1
    """Of the search's disturbances."""


@dataclass(frozen=True)
class Tuning:
    """Gains, and whether the drag is fed forward."""

    gains: Gains
    feed_drag: bool


class Bench:
    """The quadrotor's query, its plan, and where it is run."""

    def __init__(self) -> None:
        scenario = ls.scenarios.quadrotor()
        self.plant, self.solution = scenario.plant(), ls.smooth(scenario.problem)

    def run(self, tuning: Tuning | None, name: str, trials: int, seed: int) -> Outcomes:
        """Outcomes at a preset, or "undisturbed"; without a tuning those of the solution's own policy."""
        controller, robot = None, self.plant.robot
        assert isinstance(robot, ls.Quadrotor)
        if tuning is not None:
            controller = RotorPy(robot, self.solution, tuning.gains, feed_drag=tuning.feed_drag)
        disturbed = name != "undisturbed"
        rollout = ls.simulate(
            self.plant,
            self.solution,
            controller=controller,
            disturbances=preset(name, self.plant) if disturbed else (),
            seed=seed,
            trials=trials if disturbed else 1,
            frames=False,
            contacts=False,
        )
        return outcomes(rollout)


def reached(table: Outcomes) -> int:
    return int((table.outcome == "reached").sum())


def damped(position: float, ratio: float) -> float:
    return float(np.round(2 * ratio * np.sqrt(position), 2))


def search(bench: Bench, config: Config) -> list[Tuning]:
    """The tunings of the second grid, best first; prints the best of both grids."""
    z, vz = DEFAULT.position[2], DEFAULT.velocity[2]
    first = [
        Tuning(Gains((p, p, z), (v, v, vz), attitude, damped(attitude, ratio)), feed)
        for p, d, attitude, ratio, feed in product(*HORIZONTAL, *ATTITUDE, (False, True))
        for v in [damped(p, d)]
    ]
    best = ranked(bench, first, config)[:4]
    second = [
        replace(one, gains=replace(one.gains, position=(x, y, p), velocity=(vx, vy, damped(p, d))))
        for one, p, d in product(best, *VERTICAL)
        for (x, y, _), (vx, vy, _) in [(one.gains.position, one.gains.velocity)]
    ]
    return ranked(bench, [*best, *second], config)


def ranked(bench: Bench, tunings: Iterable[Tuning], config: Config) -> list[Tuning]:
    """Best first."""
    scores: dict[Tuning, tuple[int, float, float]] = {}
    for tuning in dict.fromkeys(tunings):
        calm = bench.run(tuning, "undisturbed", 1, 0)
        disturbed = bench.run(tuning, config.searched, config.search_trials, config.search_seed)
        scores[tuning] = reached(calm) * reached(disturbed), calm.worst[0], float(np.median(disturbed.worst))
    best = sorted(scores, key=lambda one: (-scores[one][0], scores[one][1] + scores[one][2]))
    where = f"at {config.searched}"
    print(f"{len(best)} tunings: reached of {config.search_trials} {where}, worst error undisturbed, median {where}")
    for tuning in best[:8]:
        print("  {:3d}  {:.3f} m  {:.3f} m  ".format(*scores[tuning]), tuning, flush=True)
    return best


def main(config: Config) -> Result:
    """Successes by law and preset, with what else the table has."""
    bench = Bench()
    config = at_most(config, trials=4, search_trials=2)
    best = search(bench, config)[:8] if config.search else []
    laws = {
        "the solution's policy": None,
        "RotorPy, default gains": Tuning(DEFAULT, False),
        "RotorPy, best at light": Tuning(BEST_AT_LIGHT, False),
        "RotorPy, the same, drag fed forward": Tuning(BEST_AT_LIGHT, True),
        "RotorPy, best at moderate": Tuning(BEST_AT_MODERATE, True),
    }
    laws_at = list(product(laws, ("undisturbed", "calm", "light", "moderate", "severe")))
    rows = []
    for law, name in progress(laws_at, "laws"):
        one = bench.run(laws[law], name, config.trials, config.seed)
        rows.append(
            {
                "law": law, "preset": name, "reached": reached(one), "trials": len(one),
                "worst": float(np.median(one.worst)), "saturated": float(np.mean(one.saturated)),
            }
        )  # fmt: skip
    return opening(config) | {"rows": rows, "best": [asdict(tuning) for tuning in best]}


def report(result: Result) -> str:
    rows = [
        [one["law"], one["preset"], f"{one['reached']} of {one['trials']}", f"{one['worst']:.3f}",
         f"{one['saturated']:.0%}"] for one in result["rows"]
    ]  # fmt: skip
    head = ("law", "preset", "reached", "worst error (m), median", "saturated")
    return "\n".join([table(head, rows), *(f"found: {tuning}" for tuning in result["best"])])


if __name__ == "__main__":
    run(Config, main, report, __doc__)
