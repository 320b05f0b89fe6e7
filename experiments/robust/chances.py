"""Predicted chances of collision against what is measured, for four robots: by splitting where they are small."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator
from runner import interval, progress, table

import lqrsim as ls
from lqrsim.disturbances import ControlNoise, Disturbance, ForceNoise, MeasurementNoise, MotorLag
from lqrsim.errors import Array
from lqrsim.stress.statistics import rate
from lqrsim.templates.my_robot.my_robot import MJCF, MyRobot
from robust import common
from robust.common import Config, run, safe_plan

# In turns. In this order: few plans collide as often as 1e-1 without any clearance, and are not safer than asked.
ASKED = (1e-2, 1e-3, 1e-4, 1e-1)
COUNTED = 5e-3  # the predicted chance from which trials are counted
ROOM = 0.15  # m, at least, about a robot at its start and its goal


class Case(NamedTuple):
    """A plan, where it runs, and what it meets."""

    plant: ls.Plant
    disturbances: list[Disturbance]
    plan: ls.types.SafePlan


def measure(config: Config) -> dict[str, Any]:
    chosen = [name for name in CASES if not config.cases or any(word in name for word in config.cases)]
    if not chosen:
        raise ls.InputError(f"--cases: got {' '.join(config.cases)}, want words of these: {'; '.join(CASES)}")
    kept, found = config.kept(), {name: list[Any]() for name in chosen}
    for number in progress(range(config.plans), "chances"):
        for name in chosen:
            row = kept.row(f"chances, {name}, {number}", partial(of_number, config, CASES[name], number))
            found[name].append(row)
    return found


def of_number(config: Config, make: Callable[[int], Case], number: int) -> dict[str, Any]:
    case = make(number)
    plan = case.plan
    return {"asked": plan.asked, "predicted": plan.tube.collision_chance, "measured": measured_chance(config, case)}


def measured_chance(config: Config, case: Case) -> list[float] | None:
    """The chance of collision with its interval; None if splitting found no collision."""
    plan = case.plan
    if plan.tube.collision_chance < COUNTED:
        score = ls.stress.TrialScore(case.plant, plan.solution, case.disturbances, controller=plan.controller)
        options: dict[str, Any] = {"particles": config.particles, "repetitions": 6, "moves": 3}
        try:
            split = ls.stress.failure_probability(score, score.size, seed=config.seed, **options)
        except ls.stress.NoFailure:
            return None
        return interval(split.probability)
    trials = config.world_trials
    rollout = run(case.plant, plan.solution, plan.controller, case.disturbances, trials=trials, seed=config.seed)
    return interval(rate(int(np.isfinite(rollout.collided_at).sum()), trials))


def quadrotor(preset: str, number: int) -> Case:
    plant = ls.scenarios.quadrotor(number).plant()
    asked = ASKED[number % len(ASKED)] if preset == "light" else common.ASKED[preset]
    return Case(plant, ls.disturbances.preset(preset, plant), safe_plan(number, preset, asked))


def drive(number: int) -> Case:
    """Between places drawn in the arena, at six times the disturbances of 'light'."""
    scenario, rng = ls.scenarios.differential_drive(), np.random.default_rng(number)
    plant, problem = scenario.plant(), scenario.problem
    start, goal = ends(rng, plant, (1.6, 2.6))
    toward = np.arctan2(goal[1] - start[1], goal[0] - start[0])
    problem = replace(
        problem, initial=ls.FixedState((*start, toward)),
        final_cost=ls.QuadraticCost((5000.0, 5000.0, 50.0), about=(*goal, toward)),
    )  # fmt: skip
    return planned(number, plant, problem, [one.scaled(6.0) for one in ls.disturbances.preset("light", plant)])


class Bar(MyRobot):
    """The template's robot with a bar before it."""

    @property
    def balls(self) -> ls.CollisionSpheres:  # pyright: ignore[reportIncompatibleVariableOverride]
        def places(x: Any, p: Any) -> list[tuple[Any, Any]]:
            return [(x[0], x[1]), *((x[0] + 0.18, x[1] + beside) for beside in (-0.12, 0.0, 0.12))]

        return ls.CollisionSpheres(places, [self.radius, 0.06, 0.06, 0.06])


def template(robot: MyRobot, number: int) -> Case:
    """The template's robot, or the one with a bar, past its crate, with forces that its motors cannot always resist."""
    scene, rng = ls.load_scene(MJCF), np.random.default_rng(number)
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=0.05, steps=80, initial=ls.FixedState((-1.2, rng.uniform(-0.6, 0.6), 0.0, 0.0)),
        stage_cost=ls.ControlCost((1.0, 1.0)) + ls.ObstacleCost(scene.world, sharpness=20.0, **robot.shape),
        final_cost=ls.QuadraticCost((5000.0,) * 4, about=(1.4, rng.uniform(-0.2, 0.6), 0.0, 0.0)),
    )  # fmt: skip
    disturbances = [
        MeasurementNoise((0.02, 0.02, 0.2, 0.2)), ControlNoise(0.5), MotorLag(0.1), ForceNoise((1.5, 1.5, 0.0)),
    ]  # fmt: skip
    return planned(number, ls.Plant(robot, scene), problem, disturbances)


def planned(number: int, plant: ls.Plant, problem: ls.Problem, disturbances: list[Disturbance]) -> Case:
    asked = ASKED[number % len(ASKED)]
    plan = ls.smooth_chance_constrained(problem, ls.uncertainty_of(plant, disturbances), chance=asked)
    return Case(plant, disturbances, plan)


def ends(rng: Generator, plant: ls.Plant, half: tuple[float, float]) -> Array:
    """A start and a goal, (2, 2), clear of everything, 3 m apart or more."""
    while True:
        places = rng.uniform(-1.0, 1.0, size=(2, 2)) * half
        clear = plant.world.distance(places).min() > plant.robot.radius + ROOM
        if clear and np.linalg.norm(places[1] - places[0]) > 3:
            return places


CASES: dict[str, Callable[[int], Case]] = {
    **{f"quadrotor, '{preset}'": partial(quadrotor, preset) for preset in common.PRESETS},
    "differential drive, six times 'light'": drive,
    "the template's disc": partial(template, MyRobot()),
    "the disc with a bar": partial(template, Bar()),
}


def report(found: dict[str, Any]) -> list[str]:
    rows, without = [], 0
    for name, plans in found.items():
        ratios = [row["predicted"] / row["measured"][0] for row in plans if row["measured"] and row["measured"][0] > 0]
        shares = [f"{pick(ratios):.2f}" if ratios else "-" for pick in (min, np.median, max)]
        asked = ", ".join(f"{chance:g}" for chance in sorted({row["asked"] for row in plans}))
        rows.append([name, len(ratios), asked, *shares])
        without += len(plans) - len(ratios)
    return [
        "OffsetFree on safe plans: the predicted chance over the measured one. Predictions below"
        f" {COUNTED:g} are held against splitting, others are counted."
        + f" Left out: {without} plans of which none collided."
        * (without > 0),
        table(("robot, preset", "plans", "asked", "least", "median", "most"), rows),
    ]
