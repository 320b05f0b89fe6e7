"""Funnels: whether their confidence is what it says, where the packaged robots' policies work, and how long it takes.

    python experiments/funnels.py                              # everything, some fifteen minutes
    python experiments/funnels.py --sections coverage          # some of it
    python experiments/funnels.py --quick                      # as little as shows how it works

coverage    How often a stated level is right where the share of successes at each level is known.
robots      Both robots: levels, fresh trials inside and just outside, and how long it takes.
replanning  Planning again when the funnel is left, against planning again at every period.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from replan.common import scenario_of
from replan.delay import firm
from runner import FolderSettings, Result, at_most, between, counting, interval, opening, run, table

import lqrsim as ls
from lqrsim.stress.funnels import find_level, run_test, smallest_test
from lqrsim.stress.statistics import compare, paired_difference
from lqrsim.stress.statistics import rate as rate_of

ROBOTS = ("differential_drive", "quadrotor")
NOISE = 0.05  # of the controls, relative
SHELLS = ((0.0, 1.0), (1.0, 1.3), (1.3, 1.6))  # of the level, where fresh trials begin
EVERY = 0.1  # s, between two plans
EACH = "at every period"
# Gusts in which it is planned again, m/s, standard deviation, and the rates of the funnels that are watched.
WATCHED = {1.25: (0.85, 0.9), 1.6: (0.7,)}
SHARES = (1.0, 0.5)  # of the level at which it is planned again
LOOSE = 0.9  # confidence of these funnels

Section = Literal["coverage", "robots", "replanning"]


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    sections: tuple[Section, ...] = ("coverage", "robots", "replanning")
    """Which of them."""
    repetitions: int = 2000
    """Searches whose answer is known."""
    rate: float = 0.99
    """Wished share of successes."""
    confidence: float = 0.95
    """Of all levels of a funnel at once."""
    trials: int = 1000
    """Fresh ones at each knot, inside and in each shell outside."""
    replanned: int = 600
    """Trials of each way of planning again, for each strength of the gusts."""
    failures: int = 150
    """Trials of a test that may fail, for the funnels that are watched: with many the levels are near the largest."""
    seed: int = 0
    """Of all draws."""

    def bounded(self) -> Self:
        """The settings, reduced by `--quick`."""
        return at_most(self, repetitions=20, rate=0.8, confidence=0.8, trials=20, replanned=4, failures=5)


# The share of successes at a level: all succeed up to level 1. In a ball of d states of which those in a smaller ball
# succeed, and where disturbances decide, from a level on more and more often.
KNOWN: dict[str, Callable[[float], float]] = {
    "1 state": lambda level: min(1.0, 1 / level) if level > 0 else 1.0,
    "12 states": lambda level: min(1.0, level**-12.0) if level > 0 else 1.0,
    "disturbed": lambda level: 1 / (1 + 1e-3 * (1 + level**6)),
}


def coverage(config: Config) -> dict[str, Any]:
    """How often the share at the level that is found is at least the rate."""
    test = smallest_test(config.rate, config.confidence, 3)
    right: dict[str, Any] = {}
    for name, share in KNOWN.items():
        held, ratios = 0, []
        most = _edge(share, config.rate)
        for number in range(config.repetitions):
            drawn = np.random.default_rng([config.seed, number]).random(2 * test.trials)
            found = find_level(
                lambda level, which, drawn=drawn, share=share: drawn[which] < share(level),
                test, guess=0.3, largest=1e6, rate=config.rate,
            )  # fmt: skip
            held += share(found.level) >= config.rate
            ratios.append(found.level / most)
        right[name] = {
            "right": interval(_percent(held, config.repetitions)), "of the largest": float(np.median(ratios)),
            "none": float(np.mean(np.array(ratios) == 0)),
        }  # fmt: skip
    # One level alone whose share is just the rate: how often the test of it does not pass, as it must not.
    refused = 0
    for number in range(config.repetitions):
        drawn = np.random.default_rng([config.seed, number, 1]).random(2 * test.trials)
        failed, _ = run_test(lambda level, which, drawn=drawn: drawn[which] < config.rate, 1.0, test)
        refused += failed > test.failures
    return {
        "known": right, "test": interval(_percent(refused, config.repetitions)), "trials": test.trials,
        "repetitions": config.repetitions, "rate": config.rate, "confidence": config.confidence,
    }  # fmt: skip


def _edge(share: Callable[[float], float], rate: float) -> float:
    """The largest level at which the share is the rate."""
    low, high = 0.0, 1e3
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if share(middle) >= rate else (low, middle)
    return low


def _percent(successes: int, trials: int) -> Any:
    found = rate_of(successes, trials)
    return replace(found, value=100 * found.value, low=100 * found.low, high=100 * found.high)


def robots(config: Config) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for robot in ROBOTS:
        scenario = ls.scenarios.get(robot)
        solution, plant = ls.smooth(scenario.problem), scenario.plant()
        how: dict[str, Any] = {"disturbances": [ls.disturbances.ControlNoise(NOISE)]}
        begun = time.perf_counter()
        with counting(f"funnel of the {robot}") as progress:
            funnel = ls.funnel(
                plant, solution, rate=config.rate, confidence=config.confidence, seed=config.seed,
                progress=lambda done, of, _, progress=progress: progress(done, of),
                **how,
            )  # fmt: skip
        took = time.perf_counter() - begun
        checks = [
            ls.stress.check_funnel(
                funnel, plant, solution, trials=config.trials, between=shell, seed=config.seed + 1 + i, **how
            )
            for i, shell in enumerate(SHELLS)
        ]
        found[robot] = {
            "seconds": took, "simulated": funnel.simulated, "times": funnel.times.tolist(),
            "levels": funnel.levels.tolist(),
            "reached": [
                [interval(_percent(int(one.successes.sum()), config.trials)) for one in shell] for shell in checks
            ],
        }  # fmt: skip
    return {"robots": found, "trials": config.trials, "rate": config.rate, "confidence": config.confidence}


def replanning(config: Config) -> dict[str, Any]:
    """The same trials by several laws: the policy, plans at every period, and plans when a funnel is left."""
    watched = dict(list(WATCHED.items())[: 1 if config.quick else None])
    return {"gusts": [in_gusts(config, gusts, rates) for gusts, rates in watched.items()], "trials": config.replanned}


def in_gusts(config: Config, gusts: float, rates: tuple[float, ...]) -> dict[str, Any]:
    scenario = scenario_of("quadrotor", 0)
    problem = firm(scenario)
    solution, plant = ls.smooth(problem), scenario.plant()
    wrong = [ls.disturbances.Gusts(gusts)]
    laws: dict[str, ls.Replanner | None] = {
        EACH: ls.Replanner(problem, solution, every=EVERY, deadline=0.0), "never, the policy alone": None,
    }  # fmt: skip
    for rate in rates[: 1 if config.quick else None]:
        funnel = ls.funnel(
            plant, solution, disturbances=wrong, rate=rate, confidence=LOOSE, failures=config.failures, seed=config.seed
        )  # fmt: skip
        for share in SHARES:
            name = f"beyond {share:g} of the level, rate {rate:g}"
            laws[name] = ls.Replanner(problem, solution, every=EVERY, deadline=0.0, when=funnel, share=share)
    found: dict[str, Any] = {}
    ended: dict[str, Any] = {}
    for name, law in laws.items():
        run = ls.simulate(
            plant, solution, controller=law, disturbances=wrong, trials=config.replanned, seed=config.seed + 10,
            frames=False, contacts=False,
        )  # fmt: skip
        ended[name] = np.array([one == "reached" for one in run.outcome])
        pairs = compare(ended[name], ended[EACH])
        apart = paired_difference(pairs.only_first, pairs.only_second, config.replanned)
        found[name] = {
            "reached": interval(_percent(int(ended[name].sum()), config.replanned)),
            "solves": 0 if law is None else len(run.controller_run.log.records),
            "more": [100 * part for part in interval(apart)],
        }  # fmt: skip
    return {"strength": gusts, "laws": found}


def report_replanning(found: dict[str, Any]) -> list[str]:
    head = ("plans again", "reached (%)", "solves a trial", "share of the solves (%)", "reached more (points)")
    said = [
        f"The quadrotor in gusts, {found['trials']} trials, the same for all laws. A law plans again every {EVERY:g} s,"
        f" or only where the trial is then beyond a share of a funnel's level. Reached more is against {EACH},"
        " with Tango's intervals for pairs."
    ]
    for one in found["gusts"]:
        every = one["laws"][EACH]["solves"]
        rows = [
            [
                name, between(law["reached"], ".1f"), f"{law['solves'] / found['trials']:.1f}",
                f"{100 * law['solves'] / every:.0f}", "" if name == EACH else between(law["more"], "+.1f"),
            ]
            for name, law in one["laws"].items()
        ]  # fmt: skip
        said += [
            f"Gusts of {one['strength']:g} m/s:",
            table(head, rows),
        ]
    return said


def report_coverage(found: dict[str, Any]) -> list[str]:
    rows = [
        [name, between(one["right"], ".1f"), f"{one['of the largest']:.2f}", f"{100 * one['none']:.1f}"]
        for name, one in found["known"].items()
    ]
    return [
        f"{found['repetitions']:,} searches for the largest level with a share of successes of {found['rate']:g} at"
        f" confidence {found['confidence']:g}, where the share at each level is known. A level whose share is just the"
        f" rate is refused by its test in {between(found['test'], '.1f')} %; the whole search seldom aims so high.",
        table(("share known in closed form", "right (%)", "of the largest such level, median", "no level (%)"), rows),
    ]


def report_robots(found: dict[str, Any]) -> list[str]:
    rows = []
    for robot, one in found["robots"].items():
        kept = [i for i, level in enumerate(one["levels"]) if level > 0]
        for row, i in enumerate(kept):
            shares = (f"{shell[row][0]:.1f}" for shell in one["reached"])
            rows.append([f"{robot}, {one['times'][i]:g} s", f"{one['levels'][i]:.3g}", *shares])
    took = ", ".join(f"{one['simulated']:,} in {one['seconds']:.0f} s" for one in found["robots"].values())
    head = ("knot", "level", *(f"{low:g} to {high:g} of it: reached (%)" for low, high in SHELLS))
    return [
        f"Controls with a noise of {100 * NOISE:g} % of themselves; rate {found['rate']:g}, confidence"
        f" {found['confidence']:g} at all knots at once. Trials that found the levels: {took}. Then {found['trials']:,}"
        " fresh ones at each knot and in each shell:",
        table(head, rows),
    ]


SECTIONS: dict[Section, tuple[Any, Any, str]] = {
    "coverage": (coverage, report_coverage, "Whether the confidence is what it says"),
    "robots": (robots, report_robots, "Where the packaged robots' policies work"),
    "replanning": (replanning, report_replanning, "Planning again when the funnel is left"),
}


def main(config: Config) -> Result:
    config = config.bounded()
    result = opening(config)
    for name in config.sections:
        result[name] = SECTIONS[name][0](config)
    return result


def report(result: Result) -> str:
    parts = ["## Funnels"]
    for name, (_, told, title) in SECTIONS.items():
        if name in result:
            parts += [f"### {title}", *told(result[name])]
    return "\n\n".join(parts)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
