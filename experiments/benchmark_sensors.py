"""Whether a better sensor does harm: output feedback in subsets of the presets, with less and less measurement noise.

    python experiments/benchmark_sensors.py                    # 240 subsets, each at four noises: some 40 minutes
    python experiments/benchmark_sensors.py --subsets 24       # fewer of them
    python experiments/benchmark_sensors.py --only 17 203      # these, by their numbers
    python experiments/benchmark_sensors.py --quick            # four: too few to trust

A subset is drawn for a robot and a preset: each of the preset's disturbances is in it with a chance of one half, the
measurement noise always. Every fourth subset of a robot and a preset is the whole preset. The noise is scaled by 1,
1e-3, 1e-9 and 0, for the run and for what the filter is told. The other disturbances of a trial are the same whatever
the noise, so trials are compared in pairs.

A loss is a subset in which fewer trials reach the goal with less noise, by more than chance: one-sided exact McNemar
test. Of so many tests 5 % have p below 5 % by chance alone if noise made no difference; the smallest p is held against
the number of tests (Bonferroni).
"""

import dataclasses
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mjcf.files import CART_POLE
from runner import Settings, at_most, opening, run
from scipy import stats
from tqdm import tqdm

import lqrsim as ls
from lqrsim.disturbances import Disturbance, MeasurementNoise
from lqrsim.machine import processors
from lqrsim.templates.my_robot import my_robot

SCALES = (1.0, 1e-3, 1e-9, 0.0)
PRESETS = ("light", "moderate", "severe")
ROBOTS = ("quadrotor", "differential drive", "my_robot", "cart-pole")


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    subsets: int = 240
    """How many: those of the numbers below."""
    only: tuple[int, ...] = ()
    """The numbers of the subsets in place of that."""
    trials: int = 40
    """Of each subset and noise."""
    seed: int = 0
    """Of the subsets and of the disturbances."""
    workers: int | None = None
    """How many processes; by default as many as there are processors."""


def main(config: Config) -> dict[str, Any]:
    if config.quick:
        config = dataclasses.replace(at_most(config, subsets=len(ROBOTS), trials=10), workers=1)
    numbers = config.only or tuple(range(config.subsets))
    with tqdm(total=len(numbers), desc="subsets", disable=None) as bar:
        rows = []
        for row in _measured(config, numbers):
            rows.append(row)
            bar.update()
    return opening(config) | {"rows": rows, "summary": summary(rows)}


def _measured(config: Config, numbers: tuple[int, ...]) -> Iterator[dict[str, Any]]:
    one = partial(measure, trials=config.trials, seed=config.seed)
    workers = min(config.workers or processors(), len(numbers))
    if workers == 1:
        yield from map(one, numbers)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(one, numbers)


def measure(number: int, *, trials: int, seed: int) -> dict[str, Any]:
    """How many trials of one subset reach the goal, at each noise, and how it compares with more noise."""
    robot, preset, disturbances = subset(number, seed)
    problem, plan, plant = planned(robot)
    reached = []
    for scale in SCALES:
        met = [one for one in (_scaled(one, scale) for one in disturbances) if one is not None]
        law = ls.OffsetFree(problem, plan, ls.uncertainty_of(plant, met))
        rollout = ls.simulate(
            plant, plan, controller=law, disturbances=met, trials=trials, seed=seed, first_trial=1000 * number,
            frames=False, contacts=False,
        )  # fmt: skip
        reached.append(np.array(ls.stress.outcomes(rollout).outcome) == "reached")
    comparisons = [
        {"noise": SCALES[less], "more": SCALES[more], "p": p_worse(reached[less], reached[more])}
        for less in range(1, len(SCALES))
        for more in range(less)
    ]
    return {
        "number": number, "robot": robot, "preset": preset, "disturbances": [str(one) for one in disturbances],
        "trials": trials, "reached": [int(one.sum()) for one in reached], "comparisons": comparisons,
    }  # fmt: skip


def subset(number: int, seed: int) -> tuple[str, str, list[Disturbance]]:
    """Robot, preset and disturbances of a number."""
    robot, turn = ROBOTS[number % len(ROBOTS)], number // len(ROBOTS)
    preset, whole = PRESETS[turn % len(PRESETS)], turn // len(PRESETS) % 4 == 0
    rng = np.random.default_rng([seed, number])
    given = ls.disturbances.preset(preset, planned(robot)[2])
    chosen = [
        one for one, drawn in zip(given, rng.random(len(given)) < 0.5, strict=True)
        if whole or drawn or isinstance(one, MeasurementNoise)
    ]  # fmt: skip
    return robot, preset, chosen


def _scaled(one: Disturbance, scale: float) -> Disturbance | None:
    """The disturbance, its noise scaled if it is that of measurements; None for no noise."""
    if not isinstance(one, MeasurementNoise):
        return one
    return one.scaled(scale) if scale else None


def p_worse(less: np.ndarray, more: np.ndarray) -> float:
    """Chance of as many losses as with less noise, among the trials in which only one succeeded, if it did no harm."""
    lost, won = int((more & ~less).sum()), int((less & ~more).sum())
    return float(stats.binomtest(lost, lost + won, 0.5, alternative="greater").pvalue) if lost + won else 1.0


@cache
def planned(robot: str) -> tuple[ls.Problem, ls.Solution, ls.Plant]:
    """Problem, plan and plant of a robot."""
    match robot:
        case "quadrotor":
            scenario = ls.scenarios.quadrotor()
        case "differential drive":
            scenario = ls.scenarios.differential_drive()
        case "my_robot":
            scenario = my_robot.scenario()
        case _:
            with TemporaryDirectory() as folder:
                path = Path(folder) / "cartpole.xml"
                path.write_text(CART_POLE, encoding="utf-8")
                weights = {"m": 100.0, "rad": 100.0, "m/s": 10.0, "rad/s": 10.0}
                scenario = ls.scenarios.mjcf(str(path), start={"pole": np.pi}, weights=weights)
                plan, plant = ls.smooth(scenario.problem), scenario.plant()
            return scenario.problem, plan, plant
    return scenario.problem, ls.smooth(scenario.problem), scenario.plant()


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of all subsets: how many lose by more than chance, the smallest p, and the share of trials at each noise."""
    tests = [(one["p"], row["number"]) for row in rows for one in row["comparisons"]]
    below, (least, where) = sum(p < 0.05 for p, _ in tests), min(tests)
    trials = sum(row["trials"] for row in rows)
    return {
        "tests": len(tests), "below_5_percent": below, "least": least, "least_of": where,
        "harm": bool(least < 0.05 / len(tests)),
        "reached": (100 * np.sum([row["reached"] for row in rows], axis=0) / trials).tolist(),
    }  # fmt: skip


def report(result: dict[str, Any]) -> str:
    rows, total = result["rows"], result["summary"]
    lines = ["reached, %, with the noise times  " + "  ".join(f"{scale:>6g}" for scale in SCALES)]
    for robot in ROBOTS:
        for preset in PRESETS:
            of = [row for row in rows if (row["robot"], row["preset"]) == (robot, preset)]
            if of:
                share = 100 * np.sum([row["reached"] for row in of], axis=0) / sum(row["trials"] for row in of)
                lines.append(f"{robot + ', ' + preset:<28} ({len(of):>3}) " + "  ".join(f"{one:6.1f}" for one in share))
    lines.append(f"{'all':<28} ({len(rows):>3}) " + "  ".join(f"{one:6.1f}" for one in total["reached"]))
    verdict = "less noise HURTS" if total["harm"] else "none by more than chance"
    lines.append(
        f"{total['tests']} comparisons with more noise: p < 5 % in {total['below_5_percent']}, by chance at most about"
        f" {0.05 * total['tests']:.0f}; the smallest is {total['least']:.2g}, of subset {total['least_of']}: {verdict}"
    )
    for row in rows:
        if min(one["p"] for one in row["comparisons"]) < 0.05:
            names = ", ".join(one.split("(")[0] for one in row["disturbances"])
            lines.append(f"  {row['number']:>3} {row['robot']}, {row['preset']}: {row['reached']}: {names}")
    return "\n".join(lines)


if __name__ == "__main__":
    run(Config, main, report, __doc__, failures=lambda result: [result] if result["summary"]["harm"] else [])
