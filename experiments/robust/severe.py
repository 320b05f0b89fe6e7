"""What keeps the quadrotor from its goal under severe disturbances: the plan, the lag, the thrust or the sensors.

What is possible at all is bounded by plans that know what each trial meets; `clairvoyant.py` has them.
"""

import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from runner import between, interval, progress, table

import lqrsim as ls
from lqrsim.disturbances import Disturbance, MeasurementDropouts, MeasurementNoise, MotorLag
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.stress.statistics import rate
from robust.clairvoyant import possible
from robust.common import ASKED, Config, reach_exactly, reached, safe_plan

PRESET = "severe"
KNOWN, STATED = "clairvoyant", "the same, uncertainty as stated"
SENSORS, LAG = (MeasurementNoise, MeasurementDropouts), (MotorLag,)


@dataclass(frozen=True)
class Change:
    """What is better than it is.

    Attributes:
      without: disturbances that do not act. thrust: least and most of each rotor, relative to the most that it has.
    """

    without: tuple[type[Disturbance], ...] = ()
    thrust: tuple[float, float] = (0.0, 1.0)


CHANGES = {
    "exact sensors": Change(SENSORS),
    "no lag": Change(LAG),
    "twice the thrust": Change(thrust=(0.0, 2.0)),
    "thrust both ways": Change(thrust=(-1.0, 1.0)),
    "exact sensors, no lag": Change((*SENSORS, *LAG)),
}


def measure(config: Config) -> dict[str, Any]:
    kept = config.kept()
    rows = [
        kept.row(f"severe, {query}", partial(of_query, config, query))
        for query in progress(range(config.plans), "severe")
    ]
    return {"rows": rows}


def of_query(config: Config, query: int) -> dict[str, Any]:
    """Numbers of trials that reach the goal, each with that of all trials."""
    scenario, few = ls.scenarios.quadrotor(query), min(config.world_trials, config.without)
    plant, problem = scenario.plant(), scenario.problem
    disturbances = ls.disturbances.preset(PRESET, plant)
    told, safe = ls.uncertainty_of(plant, disturbances), safe_plan(query, PRESET, ASKED[PRESET])
    plan = ls.smooth(problem)
    flown: dict[str, tuple[ls.Plant, ls.Solution, ls.OffsetFree, list[Disturbance], int]] = {
        "safe plan": (plant, safe.solution, of(safe), disturbances, config.world_trials),
        STATED: (
            plant, safe.solution, ls.OffsetFree(safe.problem, safe.solution, told, memory=np.inf), disturbances,
            config.world_trials,
        ),
        "default plan": (plant, plan, ls.OffsetFree(problem, plan, told), disturbances, few),
    }  # fmt: skip
    for name, change in CHANGES.items():
        met = [one.scaled(0.0) if isinstance(one, change.without) else one for one in disturbances]
        where, solution = with_thrust(plant, safe.solution, change.thrust)
        law = ls.OffsetFree(safe.problem, solution, ls.uncertainty_of(plant, met))
        flown[name] = where, solution, law, met, few
    counts = {
        name: [int(reached(where, solution, law, met, trials=trials, seed=config.seed).sum()), trials]
        for name, (where, solution, law, met, trials) in flown.items()
    }
    exact = reach_exactly(problem)
    known = possible(plant, exact, safe.solution, of(safe), disturbances, trials=few, seed=config.seed)
    counts[KNOWN] = [int(known.sum()), few]
    return {"predicted": safe.tube.collision_chance, "counts": counts}


def of(safe: ls.types.SafePlan) -> ls.OffsetFree:
    """Its controller."""
    assert isinstance(safe.controller, ls.OffsetFree)
    return safe.controller


@dataclass(frozen=True)
class BothWays(ls.Quadrotor):
    """With rotors that may pull downward: as far as to `lowest`, in N."""

    lowest: float = 0.0

    @cached_property
    def dynamics(self) -> ls.Dynamics:  # pyright: ignore[reportIncompatibleMethodOverride]
        made = copy.copy(super().dynamics)
        made.control_coordinates = replace(made.control_coordinates, low=(self.lowest,) * 4)
        return made


def with_thrust(plant: ls.Plant, solution: ls.Solution, thrust: tuple[float, float]) -> tuple[ls.Plant, ls.Solution]:
    """The plant with another range of its rotors, relative to the most that they have, and the same plan for it."""
    own = plant.robot
    assert isinstance(own, ls.Quadrotor)
    low, high = (own.max_force * share for share in thrust)
    robot, given = BothWays(max_force=high, lowest=low), f'ctrlrange="0 {own.max_force:g}"'
    assert given in plant.scene.xml
    xml = plant.scene.xml.replace(given, f'ctrlrange="{low} {high}"')
    policy = replace(solution.policy, control_coordinates=robot.dynamics.control_coordinates)
    return ls.Plant(robot, scene_from_xml(xml, plant.scene.name)), replace(solution, policy=policy)


def report(found: dict[str, Any]) -> list[str]:
    plans = found["rows"]
    rows = []
    for name in plans[0]["counts"]:
        good, trials = (sum(plan["counts"][name][i] for plan in plans) for i in (0, 1))
        rows.append([name, between([100 * value for value in interval(rate(good, trials))], ".1f"), f"{trials:,}"])
    chance = np.mean([plan["predicted"] for plan in plans])
    return [
        f"Preset 'severe', {len(plans)} queries, `OffsetFree`. Better conditions are on the safe plan, whose predicted"
        f" chance of collision is {100 * chance:.1f} %, with a law made for them. {KNOWN.capitalize()} counts trials"
        " that have a plan which reaches the goal and knows what the trial meets, apart from noise and losses of"
        " commands: no law can have more, except by what a local solution misses.",
        table(("", "reached (%)", "trials"), rows),
    ]
