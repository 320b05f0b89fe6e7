"""Problems of which the answer is known beforehand, drawn at random, and what is false of a solution of one.

weights    A plan to a `GoalState` under a final cost of any weight, from 1 to 10,000: the plan does not depend on it,
           for the cost is settled where the goal is. The answer is that of the dense quadratic program.
inside     A point among discs, from a guess that leads through their middles: there is a plan around them.
way        A cart as far as its push can take it in the time, a little less, or more: 1/4 push T^2 is as far as it goes.
buried     A point to a place at some depth inside a disc that it has to keep clear of, or as far outside of it.
least      A cart in least time, 2 sqrt(way / push) with as many steps of either push.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator

import lqrsim as ls
from lqrsim.errors import Array

NEAR = 0.03  # as a share: how near to what is just possible a problem is drawn at most
PLAN, TIME = 1e-5, 1e-6  # how closely plans, relative to their size, and least times, relative, are the known ones


@dataclass(frozen=True)
class Known:
    """A problem, what to begin with, and what is known of it.

    Attributes:
      possible: whether there is a plan. controls: of the optimum, (T, m). duration: the least, in s; None: not known.
    """

    problem: ls.Problem
    possible: bool
    start: Any = None
    controls: Array | None = None
    duration: float | None = None


def draw(kind: str, number: int, *, seed: int = 0) -> Known:
    """The draw of that kind and number, the same whatever else is drawn."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(list(KINDS).index(kind), number)))
    return KINDS[kind](rng)


def false(known: Known, solution: ls.Solution) -> list[str]:
    """What is false of a solution; empty also where it is honest and no answer."""
    plan, found = solution.trajectory, []
    if solution.status is ls.Status.INFEASIBLE and known.possible:
        return ["INFEASIBLE, but there is a plan"]
    if not solution.success:
        return []
    if not known.possible:
        return [f"{solution.status.name}, but there is no plan"]
    if known.controls is not None:
        off = float(np.abs(plan.controls - known.controls).max() / np.abs(known.controls).max())
        found += [f"a control is off by {off:.1g}"] if off > PLAN else []
    if known.duration is not None and abs(plan.horizon / known.duration - 1) > TIME:
        found.append(f"takes {plan.horizon:.9g} s, not {known.duration:.9g}")
    return found


def _cart_rate(x: Any, u: Any, p: Any) -> list[Any]:
    return [x[1], p.push * u[0]]


def _cart(way: float, push: float, steps: int, dt: float, **options: Any) -> ls.Problem:
    dynamics = ls.Dynamics(
        _cart_rate, states={"x": "m", "v": "m/s"}, controls={"push": ""}, parameters={"push": push},
        control_limits=(-1, 1),
    )  # fmt: skip
    weight = options.pop("weight", 1e-6)
    final = ls.QuadraticCost(np.full(2, options.pop("final", 0.0)), about=(way, 0.0))
    return ls.Problem(
        dynamics=dynamics, dt=dt, steps=steps, initial=ls.FixedState((0.0, 0.0)), stage_cost=ls.ControlCost([weight]),
        final_cost=final, constraints=[ls.GoalState((way, 0.0))], **options,
    )  # fmt: skip


def weights(rng: Generator) -> Known:
    steps, dt, push = int(rng.integers(10, 60)), 0.1, float(rng.uniform(0.5, 2.0))
    way = float(rng.uniform(0.05, 0.5)) * push * (steps * dt) ** 2 / 6  # so far, limits do not act: the most is a third
    heavy = float(10 ** rng.uniform(0, 4))
    problem = _cart(way, push, steps, dt, weight=1.0, final=heavy)
    # The least squares of pushes that end there, at rest: a step's push moves it on for all steps that are left.
    left = steps - 0.5 - np.arange(steps)
    rows = push * dt * np.stack([left * dt, np.ones(steps)])
    return Known(problem, True, controls=(np.linalg.pinv(rows) @ [way, 0.0])[:, None])


def way(rng: Generator) -> Known:
    half, push, dt = int(rng.integers(5, 25)), float(rng.uniform(0.5, 2.0)), 0.1
    farthest = push * (half * dt) ** 2
    possible = bool(rng.random() < 0.5)
    share = rng.uniform(0.3, 1 - NEAR) if possible else rng.uniform(1 + NEAR, 3.0)
    return Known(_cart(float(share * farthest), push, 2 * half, dt, weight=1.0), possible)


def least(rng: Generator) -> Known:
    half, push, far = int(rng.integers(5, 20)), float(rng.uniform(0.3, 3.0)), float(rng.uniform(0.1, 5.0))
    problem = _cart(far, push, 2 * half, 4.0 / (2 * half), duration=(0.1, 20.0), time_weight=1.0)
    return Known(problem, True, duration=2 * float(np.sqrt(far / push)))


def _point_rate(x: Any, u: Any, p: Any) -> list[Any]:
    return [u[0], u[1]]


def _point(world: ls.World, start: Array, goal: Array) -> ls.Problem:
    dynamics = ls.Dynamics(
        _point_rate, states={"x": "m", "y": "m"}, controls={"vx": "m/s", "vy": "m/s"}, position=("x", "y"),
        control_limits=(-2.0, 2.0),
    )  # fmt: skip
    return ls.Problem(
        dynamics=dynamics, dt=0.1, steps=60, initial=ls.FixedState(start), stage_cost=ls.ControlCost((1.0, 1.0)),
        final_cost=ls.QuadraticCost(np.zeros(2), about=goal),
        constraints=[ls.Clearance(world, radius=0.1), ls.GoalState(goal)],
    )  # fmt: skip


def _disc(name: str, place: Array, radius: float) -> ls.Obstacle:
    return ls.Obstacle(name, "cylinder", np.array([*place, 0.0]), np.eye(3), np.array([radius, np.inf, 0.0]))


def inside(rng: Generator) -> Known:
    """Discs in a row, each with room enough to go round it in the time."""
    places = [np.array([x, rng.uniform(-0.3, 0.3)]) for x in (-1.0, 1.0)]
    discs = [_disc(f"disc {i}", place, float(rng.uniform(0.2, 0.6))) for i, place in enumerate(places)]
    start, goal = np.array([-2.5, rng.uniform(-0.5, 0.5)]), np.array([2.5, rng.uniform(-0.5, 0.5)])
    problem = _point(ls.World(discs), start, goal)
    corners, times = np.array([start, *places, goal]), (0.0, 2.0, 4.0, 6.0)
    at = np.linspace(0, 6.0, problem.steps + 1)
    guess = np.stack([np.interp(at, times, corners[:, i]) for i in range(2)], axis=1)
    return Known(problem, True, start=ls.Trajectory(guess, np.diff(guess, axis=0) / problem.dt, problem.dt))


def buried(rng: Generator) -> Known:
    radius, possible = float(rng.uniform(0.3, 1.0)), bool(rng.random() < 0.5)
    share = rng.uniform(1 + NEAR, 1.5) if possible else rng.uniform(0.3, 1 - NEAR)
    towards = rng.uniform(-np.pi, np.pi)
    goal = share * (radius + 0.1) * np.array([np.cos(towards), np.sin(towards)])
    world = ls.World([_disc("disc", np.zeros(2), radius)])
    return Known(_point(world, np.array([-2.0, 0.0]), goal), possible)


KINDS: dict[str, Callable[[Generator], Known]] = {
    "weights": weights, "inside": inside, "way": way, "buried": buried, "least": least,
}  # fmt: skip
