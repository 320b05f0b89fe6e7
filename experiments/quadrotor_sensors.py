"""The quadrotor on an IMU at 200 Hz and positions at 10 Hz, 40 ms late: how often it arrives, and by what it fails.

    python experiments/quadrotor_sensors.py            # a minute
    python experiments/quadrotor_sensors.py --quick

`OffsetFree` reads the `<sensor>` elements of models/quadrotor.xml, and flies through the cage of Fig. 3. Gusts, noise
of the rotors and a wrong start are the same throughout, at the strength for which it is designed. What is swept is the
errors of all sensors, those of one at a time, and the share of positions that get lost.
"""

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from runner import Result, Settings, at_most, between, counting, interval, opening, run, table

import lqrsim as ls
from lqrsim.disturbances import ControlNoise, Disturbance, Gusts, InitialStateError, Sensor, SensorErrors

SENSORS = (
    Sensor("quadrotor_gyro", noise=0.01, bias=0.01, bias_walk=1e-3, rate=200.0),
    Sensor("quadrotor_accelerometer", noise=0.1, bias=0.05, bias_walk=0.01, rate=200.0),
    Sensor("quadrotor_magnetometer", noise=0.01, rate=50.0),
    Sensor("quadrotor_position", noise=0.02, rate=10.0, delay=0.04),
)
START = {"m": 0.02, "m/s": 0.02, "rad": 0.02, "rad/s": 0.02}
MET: tuple[Disturbance, ...] = (ControlNoise(0.05), Gusts(0.1), InitialStateError(START))
STRENGTHS = 1.0, 2.0, 4.0, 8.0
LOSSES = 0.3, 0.6, 0.9
FAILURES = "collided", "timed out", "diverged", "error"


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    trials: int = 200
    """Of each cell."""
    seed: int = 0
    """Of the disturbances."""


def scenario() -> ls.Scenario:
    """The quadrotor in its cage, with these sensors."""
    return dataclasses.replace(ls.scenarios.quadrotor(), name="quadrotor on sensors", sensors=SENSORS)


def cells() -> dict[str, tuple[Disturbance, ...]]:
    """What is met in each cell of the campaign, beside what is always met."""
    found: dict[str, tuple[Disturbance, ...]] = {"exact sensors": ()}
    found |= {f"errors of all times {k:g}": (SensorErrors(SENSORS, k),) for k in STRENGTHS}
    for one in SENSORS:
        others = tuple(other for other in SENSORS if other is not one)
        found[f"errors of {short(one)} times 8"] = SensorErrors([one], STRENGTHS[-1]), SensorErrors(others)
    for loss in LOSSES:
        lossy = (*SENSORS[:-1], dataclasses.replace(SENSORS[-1], loss=loss))
        found[f"{100 * loss:g} % of the positions lost"] = (SensorErrors(lossy),)
    return found


def short(sensor: Sensor) -> str:
    return sensor.name.removeprefix("quadrotor_")


def main(config: Config) -> Result:
    config = at_most(config, trials=3)
    campaign = ls.stress.Campaign(
        scenario=f"{Path(__file__)}:scenario", sweeps={name: MET + met for name, met in cells().items()},
        strengths=(1.0,), policies=("offset_free",), design_disturbances=MET, trials=config.trials, seed=config.seed,
        shard=100,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder, counting("quadrotor on sensors") as told:
        results = ls.stress.run_campaign(campaign, folder, workers=0, progress=told)
        rows = []
        for cell, summary in results.cell_summaries().items():
            assert summary.success is not None
            failures = {how: summary.tally[how] for how in FAILURES}
            rows.append({"cell": cell.sweep, "reached": interval(summary.success.exact)} | failures)
    return opening(config) | {"rows": rows} | {"estimates": estimates(config)}


def estimates(config: Config) -> dict[str, list[float]]:
    """Errors of the estimated states, rms over trials and knots, and what the filter says of them."""
    flown = scenario()
    solution, plant = ls.smooth(flown.problem), flown.plant()
    law = ls.OffsetFree(
        flown.problem, solution, ls.uncertainty_of(plant, MET), sensors=plant.sensors(SENSORS), record=True
    )
    met = [*MET, SensorErrors(SENSORS)]
    run = ls.simulate(plant, controller=law, disturbances=met, trials=config.trials, seed=config.seed, frames=False)
    knots = slice(0, solution.trajectory.steps)  # at the last one no measurement is used
    off = run.controller_run.estimates[knots, :, :12] - run.states[:, knots].transpose(1, 0, 2)
    said = law.filter.corrected[knots, range(12), range(12)]
    return {
        name: [float(np.sqrt(np.nanmean(off[..., i : i + 3] ** 2))), float(np.sqrt(said[:, i : i + 3].mean()))]
        for name, i in (("position (m)", 0), ("velocity (m/s)", 3), ("rotation (rad)", 6), ("rate (rad/s)", 9))
    }


def report(result: Result) -> str:
    rows = [
        [one["cell"], between([100 * part for part in one["reached"]], ".0f"), *(f"{one[how]}" for how in FAILURES)]
        for one in result["rows"]
    ]
    errors = [[name, f"{rms:.4f}", f"{said:.4f}"] for name, (rms, said) in result["estimates"].items()]
    return "\n\n".join([
        "## A quadrotor on its sensors",
        "IMU at 200 Hz, of which a policy at 30 Hz has the newest reading, magnetometer at 50 Hz, positions at 10 Hz"
        f" that are 40 ms late. {result['config']['trials']} trials of each cell.",
        table(("met", "reached its goal (%), 95 %", *FAILURES), rows),
        "Errors of the estimates under the stated errors of the sensors, root mean squares:",
        table(("estimate", "found", "by the filter"), errors),
    ])  # fmt: skip


if __name__ == "__main__":
    run(Config, main, report, __doc__)
