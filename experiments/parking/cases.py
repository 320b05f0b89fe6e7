"""Cases: tasks for which a plan is known, and tasks for which it is known that there is none.

A plan is found by driving out of the gap, for that is easy, and a car drives back as it came: kinematic rates are odd
in the controls. The goal is where the way back ends, and the obstacles are put where it does not come near them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.random import Generator

from parking import judge
from parking.task import RADIUS, Shape, Task

Array = np.ndarray
Side = Literal["parallel", "perpendicular"]

LEAST_SPARE = 0.01  # m or rad, by which a known plan keeps all inequalities
CLEARLY = 0.02  # m or rad, by which at least no plan can keep what an impossible case asks
DRIVES = 64  # at once


@dataclass(frozen=True)
class Plan:
    """States (T+1, n) and controls (T, 2)."""

    states: Array
    controls: Array


@dataclass(frozen=True, kw_only=True)
class Case:
    """A task, and what is known about it.

    Attributes:
      seed: of the cases.
      number: among those of the seed.
      side: how the cars beside the gap stand.
      begins: "clear", "in a margin" of an obstacle, "in an obstacle"; there no constraint acts on the start.
      task: the numbers.
      plan: one that keeps everything; None for a case that has none.
      impossible: which of `PROOFS` says why there is none; empty where there is one.
    """

    seed: int
    number: int
    side: Side
    begins: str
    task: Task
    plan: Plan | None
    impossible: str = ""

    @property
    def reason(self) -> str:
        """Why there is no plan, in words; empty where there is one."""
        return PROOFS[self.impossible].__doc__ or "" if self.impossible else ""

    @property
    def proved(self) -> bool:
        """Whether what is known about it holds, by the numbers of the task: nothing is solved for."""
        if self.plan is None:
            return PROOFS[self.impossible](self.task) >= CLEARLY
        found = judge.examine(self.task, self.plan.states, self.plan.controls)
        clear = judge.inequalities(self.task, self.plan.states).min() >= LEAST_SPARE
        return not found.wrong and found.motion < 1e-12 and found.goal == 0.0 and bool(clear)

    @property
    def features(self) -> tuple[str, ...]:
        """The rows of the table that it counts in."""
        if self.impossible:
            return ("impossible", f"impossible: {self.impossible}")
        task = self.task
        return (
            "possible",
            f"{len(task.trailers)} trailers, {self.side}",
            "goal exact" if task.exact else "goal weighed",
            f"begins {self.begins}",
            "with an ObstacleCost" if task.repulsion else "without an ObstacleCost",
            f"weight {10 ** int(np.log10(task.weight))} and up",
        )


def draw(number: int, *, seed: int = 0, impossible: float = 0.25) -> Case:
    """The case of that number: the same whatever else is drawn. `impossible` is the share of those without a plan."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    without, trailers = rng.random() < impossible, int(rng.integers(3))
    side: Side = "parallel" if rng.random() < 0.5 else "perpendicular"
    begins = str(rng.choice(["clear", "in a margin", "in an obstacle"], p=[0.7, 0.15, 0.15]))
    spoil = str(rng.choice([name for name in _SPOILED if trailers or name != "hitch"]))
    if without and spoil in ("turned", "hitch"):
        side = "perpendicular"  # along the road there is hardly a turn to be too large
    while True:
        found = _possible(rng, trailers, side, begins)
        if found is None:
            continue
        task, plan = found
        case = Case(seed=seed, number=number, side=side, begins=begins, task=task, plan=plan)
        if without:
            # A goal that is only weighed can be missed: then few of these would be impossible.
            task = _SPOILED[spoil](rng, replace(task, exact=True))
            case = replace(case, task=task, plan=None, impossible=spoil)
        if case.proved:
            return case


def _log_uniform(rng: Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


# Possible ones.


def _possible(rng: Generator, trailers: int, side: Side, begins: str) -> tuple[Task, Plan] | None:
    """A task with a plan; None where what was drawn does not lead out of the gap, or is no gap."""
    duration, steps = rng.uniform(8.0, 16.0), int(rng.integers(40, 101))
    bare = Task(
        wheelbase=rng.uniform(2.3, 2.9),
        trailers=tuple(rng.uniform(1.8, 3.0, size=trailers).tolist()),
        dt=duration / steps,
        steps=steps,
        start=np.zeros(0),
        goal=np.zeros(0),
        exact=bool(rng.random() < 0.6),
        weight=_log_uniform(rng, 1.0, 1e4),
        effort=duration / steps * _log_uniform(rng, 0.1, 3.0) * np.array([1.0, rng.uniform(0.3, 3.0)]),
        obstacles=(),
        repulsion=None if rng.random() < 0.5 else (duration / steps * _log_uniform(rng, 0.1, 3.0), rng.uniform(4, 20)),
        clearance=rng.uniform(0.0, 0.05),
        top=np.array([rng.uniform(1.0, 2.0), rng.uniform(0.5, 1.0)]),
        bounds=np.full(1 + trailers, np.inf),
        road=(-np.inf, np.inf),
    )
    plan = _way_back(rng, bare, side)
    return None if plan is None else _surrounded(rng, bare, plan, begins)


def _way_back(rng: Generator, task: Task, side: Side) -> Plan | None:
    """One of many drives out of the gap, backwards in time; None if none of them gets out."""
    n, heading = 4 + len(task.trailers), 0.0 if side == "parallel" else np.pi / 2
    gap = np.concatenate([[0.0, 0.0, heading + rng.uniform(-0.05, 0.05)], np.zeros(n - 3)])
    knots, times = np.linspace(0, 1, 6), np.linspace(0, 1, task.steps + 1)
    steering = rng.uniform(-0.6, 0.6, size=(DRIVES, 6))
    steering[:, 0] = 0.0
    if side == "parallel":  # out to the left, and straight again
        steering[:, 1:3], steering[:, 3:5] = np.abs(steering[:, 1:3]), -np.abs(steering[:, 3:5])
    speed = rng.uniform(0.3, 0.95, size=(DRIVES, 6)) * task.top[0]
    speed[: DRIVES // 2, 2] *= -1.0  # some change direction on the way
    angle = np.array([np.interp(times, knots, one) for one in steering])
    rates = np.clip(np.diff(angle) / task.dt, -0.95 * task.top[1], 0.95 * task.top[1])
    drives = np.stack([np.array([np.interp(times[1:], knots, one) for one in speed]), rates], axis=-1)
    outward = judge.rollout(task, gap, drives, task.dt)
    turned = np.abs(outward[..., 2] - heading).max(axis=1)
    out = (outward[:, -1, 1] > 2.5) & (np.abs(outward[..., 3]).max(axis=1) < 0.6) & (turned < 2.0)
    out &= np.abs(outward[..., 4:]).max(axis=(1, 2), initial=0.0) < 1.0
    if side == "parallel":
        out &= turned < 1.2
    if not out.any():
        return None
    chosen = int(rng.choice(np.flatnonzero(out)))
    controls = -drives[chosen, ::-1]
    return Plan(judge.rollout(task, outward[chosen, -1], controls, task.dt), controls)


def _surrounded(rng: Generator, task: Task, plan: Plan, begins: str) -> tuple[Task, Plan] | None:
    """The task with bounds and obstacles that the plan keeps, some of them only just."""
    spare, states = LEAST_SPARE + _log_uniform(rng, 0.001, 0.3), plan.states
    goal = states[-1]
    bounds = np.abs(states[1:, 3:]).max(axis=0) + spare + _log_uniform(rng, 0.001, 0.3)
    low = float(states[1:, 1].min()) - spare - _log_uniform(rng, 0.01, 5.0)
    high = float(states[1:, 1].max()) + spare + _log_uniform(rng, 0.01, 5.0)
    task = replace(task, start=states[0], goal=goal, bounds=bounds, road=(low, high))
    places = judge.balls(task, states[1:])
    least = RADIUS + task.clearance + spare  # from the middles of the balls
    boxes, turned = bool(rng.random() < 0.5), goal[2]
    half = (2.1, 0.85) if boxes else (1.3, 0.85)
    cars = []
    for name, direction in (("left car", -1.0), ("right car", 1.0)):
        middle = np.array([goal[0], judge.balls(task, goal)[:, 1].mean() + rng.uniform(-0.5, 0.5)])
        car = Shape(name, boxes, middle, turned + rng.uniform(-0.05, 0.05), half)
        moved = np.linspace(0.0, 14.0, 700)[:, None, None, None] * np.array([direction, 0.0])
        away = judge.distance(car, places, moved).min(axis=(1, 2))
        if not (away >= least).any():
            return None
        car = replace(car, place=middle + moved[int(np.argmax(away >= least)), 0, 0])
        if judge.distance(car, judge.balls(task, goal)).min() > RADIUS + 2.5:  # that is no gap
            return None
        cars.append(car)
    kerb_top = places[..., 1].min() - least - (0.0 if rng.random() < 0.5 else 10.0)
    kerb = Shape("kerb", True, np.array([0.0, kerb_top - 0.5]), 0.0, (40.0, 0.5))
    post = _post(rng, task, states, least, begins)
    if post is None:
        return None
    task = replace(task, obstacles=(*cars, kerb, post))
    at_start = judge.spare(task, states[0]).min()
    inside, margin = at_start + task.clearance < 0, at_start < 0
    found = "in an obstacle" if inside else "in a margin" if margin else "clear"
    return (task, plan) if found == begins else None


def _post(rng: Generator, task: Task, states: Array, least: float, begins: str) -> Shape | None:
    """A post beside the way; or where the vehicle begins, and out of its way with the first step."""
    radius, start = rng.uniform(0.1, 0.5), judge.balls(task, states[0])
    if begins == "clear":
        middle = rng.uniform(states[:, :2].min(axis=0) - 3.0, states[:, :2].max(axis=0) + 3.0)
    else:
        step = judge.balls(task, states[1]) - start
        direction = step.mean(axis=0) / np.linalg.norm(step.mean(axis=0))
        last = int(np.argmin(start @ direction))
        length = float(step[last] @ direction)
        deep = -rng.uniform(0.0, task.clearance) if begins == "in a margin" else rng.uniform(0.0, length)
        middle = start[last] - direction * (RADIUS + radius - deep)
    post = Shape("post", False, middle, 0.0, (0.0, radius))
    return post if judge.distance(post, judge.balls(task, states[1:])).min() >= least else None


# Impossible ones. Each is a proof: by how much, at least, any plan misses something, in metres or radians.


def _narrow(task: Task) -> float:
    """At the goal, which is to be reached exactly, the vehicle is nearer to an obstacle than the clearance."""
    return -float(judge.spare(task, task.goal).min()) if task.exact else -np.inf


def _occupied(task: Task) -> float:
    """At the goal, which is to be reached exactly, the vehicle is in an obstacle."""
    return -float(judge.spare(task, task.goal).min()) - task.clearance if task.exact else -np.inf


def _distant(task: Task) -> float:
    """The goal is farther away than the top speed times the duration."""
    away = np.linalg.norm(task.goal[:2] - task.start[:2])
    return float(away - task.top[0] * task.dt * task.steps) if task.exact else -np.inf


def _turned(task: Task) -> float:
    """The goal's heading is farther than the top speed turns the car within the bound of its steering."""
    # The steering changes linearly in a step, and so is within the bound where it is at both ends.
    steered = max(task.bounds[0], abs(task.start[3]), abs(task.goal[3]))
    most = task.top[0] * np.tan(steered) / task.wheelbase * task.dt * task.steps
    return float(abs(task.goal[2] - task.start[2]) - most) if task.exact and steered < 1.5 else -np.inf


def _road(task: Task) -> float:
    """The rear axle is to be above one line and below another, which is lower."""
    return (task.road[0] - task.road[1]) / 2


def _steering(task: Task) -> float:
    """The steering begins farther beyond its bound than the first step, after which it is to be within, can steer."""
    return float(abs(task.start[3]) - task.bounds[0] - task.dt * task.top[1])


def _hitch(task: Task) -> float:
    """The goal's heading of the first trailer is farther than the top speed turns it within the bound of its angle."""
    if not (task.exact and task.trailers):
        return -np.inf
    turned = (task.goal[2] - task.goal[4]) - (task.start[2] - task.start[4])
    steered = max(task.bounds[0], abs(task.start[3]), abs(task.goal[3]))
    angle = max(task.bounds[1], abs(task.start[4]), abs(task.goal[4]))
    # At Runge-Kutta's stages the angle can be beyond its bound by what half a step, in their mean, changes it.
    beyond = task.dt / 2 * task.top[0] * (np.tan(steered) / task.wheelbase + 1 / task.trailers[0])
    most = task.dt * task.steps * task.top[0] * (angle + beyond) / task.trailers[0]
    return float(abs(turned) - most) if steered < 1.5 else -np.inf


def _stuck(task: Task) -> float:
    """The rear axle begins deeper in an obstacle than the first step, after which it is to be clear, can go."""
    return -float(judge.spare(task, task.start)[0].min()) - task.top[0] * task.dt


PROOFS: dict[str, Callable[[Task], float]] = {
    "narrow": _narrow,
    "occupied": _occupied,
    "distant": _distant,
    "turned": _turned,
    "road": _road,
    "steering": _steering,
    "hitch": _hitch,
    "stuck": _stuck,
}


def _moved(task: Task, index: int, moved: Array) -> Task:
    shapes = list(task.obstacles)
    shapes[index] = replace(shapes[index], place=shapes[index].place + moved)
    return replace(task, obstacles=tuple(shapes))


def _spoil_narrow(rng: Generator, task: Task) -> Task:
    """A parked car is moved towards the goal, until it is too near by 2 to 20 cm."""
    index, deep = int(rng.integers(2)), rng.uniform(CLEARLY, 0.2)
    for far in np.arange(0.0, 4.0, 0.01):
        nearer = _moved(task, index, np.array([-far if index else far, 0.0]))
        if _narrow(nearer) >= deep:
            return nearer
    return task


def _spoil_occupied(rng: Generator, task: Task) -> Task:
    """The post stands where one of the balls is to end."""
    ends = judge.balls(task, task.goal)
    place = ends[int(rng.integers(len(ends)))] + rng.uniform(-0.5, 0.5, size=2)
    return _moved(task, 3, place - task.obstacles[3].place)


def _spoil_distant(rng: Generator, task: Task) -> Task:
    away = np.linalg.norm(task.goal[:2] - task.start[:2])
    top = away / (task.dt * task.steps) * rng.uniform(0.5, 0.98)
    return replace(task, top=np.array([top, task.top[1]]))


def _spoil_turned(rng: Generator, task: Task) -> Task:
    """The steering angle has so narrow a bound; where it begins and ends it is none."""
    start, goal = task.start.copy(), task.goal.copy()
    start[3] = goal[3] = 0.0
    least = np.arctan(abs(goal[2] - start[2]) * task.wheelbase / (task.top[0] * task.dt * task.steps))
    bounds = task.bounds.copy()
    bounds[0] = max(0.01, least * rng.uniform(0.5, 0.9))
    return replace(task, start=start, goal=goal, bounds=bounds)


def _spoil_road(rng: Generator, task: Task) -> Task:
    low, high = task.road
    return replace(task, road=(high + rng.uniform(2 * CLEARLY, 1.0), high)) if high > low else task


def _spoil_steering(rng: Generator, task: Task) -> Task:
    start = task.start.copy()
    start[3] = rng.choice([-1.0, 1.0]) * (task.bounds[0] + task.dt * task.top[1] + rng.uniform(CLEARLY, 0.2))
    return replace(task, start=start)


def _spoil_hitch(rng: Generator, task: Task) -> Task:
    """The angle of the first trailer has so narrow a bound; it begins straight."""
    start, bounds = task.start.copy(), task.bounds.copy()
    start[4], bounds[1] = 0.0, rng.uniform(0.01, 0.1)
    return replace(task, start=start, bounds=bounds)


def _spoil_stuck(rng: Generator, task: Task) -> Task:
    """A post as large as it takes, about the rear axle."""
    place = task.start[:2] + rng.uniform(-0.2, 0.2, size=2)
    size = max(0.1, task.top[0] * task.dt + rng.uniform(0.1, 0.5) - RADIUS)
    larger = replace(task.obstacles[3], place=place, half=(0.0, size))
    return replace(task, obstacles=(*task.obstacles[:3], larger))


_SPOILED: dict[str, Callable[[Generator, Task], Task]] = {
    "narrow": _spoil_narrow,
    "occupied": _spoil_occupied,
    "distant": _spoil_distant,
    "turned": _spoil_turned,
    "road": _spoil_road,
    "steering": _spoil_steering,
    "hitch": _spoil_hitch,
    "stuck": _spoil_stuck,
}
