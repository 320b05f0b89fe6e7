"""Whether the filter knows how wrong it is: NEES and NIS of the quadrotor's flights, against chi-square's bands.

NEES is the squared error of the estimated state, NIS that of the expected measurement, each in units of the covariance
that the filter predicts; divided by how many numbers there are, both are 1 in the mean if the filter is right. It is
told of the disturbances that it meets, but for those that no linear model has, and believes in more besides: see
`Uncertainty.steady`. Above 1 it is too sure of itself.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from runner import table
from scipy.stats import chi2

import lqrsim as ls
from robust.common import ASKED, PRESETS, Config, run, safe_plan


def measure(config: Config) -> dict[str, Any]:
    scenario = ls.scenarios.quadrotor()
    plant, trials = scenario.plant(), 2 * config.trials
    rows = {}
    for preset in PRESETS[:1] if config.quick else PRESETS:
        disturbances = ls.disturbances.preset(preset, plant)
        stated = ls.uncertainty_of(plant, disturbances)
        safe = safe_plan(0, preset, ASKED[preset])
        law = ls.OffsetFree(safe.problem, safe.solution, stated, record=True)
        rollout = run(plant, safe.solution, law, disturbances, trials=trials, seed=config.seed)
        well = np.flatnonzero(np.array(ls.stress.outcomes(rollout).outcome) == "reached")
        rows[preset] = of_run(law, rollout, well)
    return {"rows": rows, "trials": trials}


def of_run(law: ls.OffsetFree, rollout: ls.Rollout, well: npt.NDArray[np.intp]) -> dict[str, Any]:
    """Of the trials that reach the goal: others end anywhere."""
    run = rollout.controller_run
    n, space = rollout.states.shape[2], rollout.state_coordinates
    knots = len(run.estimates) - 1  # at the last there is nothing to decide, and nothing measured
    truth = rollout.states[well].transpose(1, 0, 2)[:knots]
    errors = space.difference(run.estimates[:knots, well, :n], truth)
    found = {}
    for name, off, covariance in (
        ("NEES", errors, law.filter.corrected[:knots, :n, :n]),
        ("NIS", run.innovations[:knots, well], law.filter.innovation[:knots]),
    ):
        squares = np.einsum("tki,tij,tkj->tk", off, np.linalg.inv(covariance), off)  # NaN where nothing came
        size, count = off.shape[2], np.isfinite(squares).sum(axis=1)
        each = np.nanmean(squares, axis=1)
        low, high = (chi2.ppf(tail, size * count) / count for tail in (0.025, 0.975))
        inside = float(((each > low) & (each < high)).mean())
        found[name] = {"mean": float(each.mean() / size), "inside": 100 * inside}
    return found | {"trials": len(well)}


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        [preset, row["trials"], *(f"{row[name][what]:{spec}}" for name in ("NEES", "NIS") for what, spec in SHOWN)]
        for preset, row in found["rows"].items()
    ]
    head = ("preset", "trials", "NEES / n", "inside its band (%)", "NIS / n", "inside its band (%)")
    return [
        f"Of {found['trials']} trials those that reach the goal. The band holds the mean over the trials at 95 % of the"
        " knots if the filter is exactly right.",
        table(head, rows),
    ]


SHOWN = (("mean", ".2f"), ("inside", ".0f"))
