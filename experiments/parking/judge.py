"""What is true of a plan by the numbers of the task alone, in plain NumPy: nothing here calls the package.

A plan is its states (T+1, n) and controls (T, 2). All functions take any batch of states: (..., n).
"""

from dataclasses import dataclass

import numpy as np

from parking.task import ALONG_CAR, ALONG_TRAILER, RADIUS, Shape, Task

Array = np.ndarray

# As documented: all constraints to within constraint_tolerance, which is 1e-6; and rounding of a long rollout.
INEQUALITY, EQUALITY, MOTION = 1.001e-6, 1.001e-6, 1e-8


@dataclass(frozen=True)
class Found:
    """By how much a plan misses what it has to keep; 0 where it keeps it.

    Attributes:
      start: the largest distance of a number of the first state from the given one.
      motion: of a state from the step of the dynamics from the state before.
      limits: by how much a control is beyond its limits.
      kept: by how much the worst inequality is missed.
      goal: how far a number of the last state is from the goal, if that is to be reached exactly.
    """

    start: float
    motion: float
    limits: float
    kept: float
    goal: float

    @property
    def wrong(self) -> list[str]:
        """What is beyond the tolerances, in words."""
        tolerances = {"start": 0.0, "motion": MOTION, "limits": 0.0, "kept": INEQUALITY, "goal": EQUALITY}
        missed = {name: getattr(self, name) for name in tolerances}
        return [f"{name} by {missed[name]:.3g}" for name, most in tolerances.items() if not missed[name] <= most]


def rate(task: Task, x: Array, u: Array) -> Array:
    speed, turn = u[..., 0], u[..., 0] * np.tan(x[..., 3]) / task.wheelbase
    rates = [speed * np.cos(x[..., 2]), speed * np.sin(x[..., 2]), turn, u[..., 1] + 0 * speed]
    for i, length in enumerate(task.trailers):
        drawn = speed * np.sin(x[..., 4 + i]) / length
        rates.append(turn - drawn)
        speed, turn = speed * np.cos(x[..., 4 + i]), drawn
    return np.stack(rates, axis=-1)


def step(task: Task, x: Array, u: Array, dt: float) -> Array:
    """Runge-Kutta's step of fourth order, the control held."""
    a = rate(task, x, u)
    b = rate(task, x + dt / 2 * a, u)
    c = rate(task, x + dt / 2 * b, u)
    d = rate(task, x + dt * c, u)
    return x + dt / 6 * (a + 2 * b + 2 * c + d)


def rollout(task: Task, start: Array, controls: Array, dt: float) -> Array:
    """States (..., T+1, n) from starts (..., n) under controls (..., T, 2)."""
    states = [np.broadcast_to(start, (*controls.shape[:-2], start.shape[-1]))]
    for t in range(controls.shape[-2]):
        states.append(step(task, states[-1], controls[..., t, :], dt))
    return np.stack(states, axis=-2)


def balls(task: Task, states: Array) -> Array:
    """The middles of the balls, (..., K, 2)."""
    place, heading = states[..., :2], states[..., 2]
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    found = [place + share * task.wheelbase * direction for share in ALONG_CAR]
    for i, length in enumerate(task.trailers):
        heading = heading - states[..., 4 + i]
        direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        found += [place - share * length * direction for share in ALONG_TRAILER]
        place = found[-1]
    return np.stack(found, axis=-2)


def distance(shape: Shape, places: Array, moved: Array | float = 0.0) -> Array:
    """Signed distance of places (..., 2) to a shape, which may be moved by as many (..., 2); in a box by its faces."""
    x, y = np.moveaxis(places - shape.place - moved, -1, 0)
    c, s = np.cos(shape.turned), np.sin(shape.turned)
    along, across = c * x + s * y, c * y - s * x
    length, width = shape.half
    if not shape.box:
        return np.hypot(np.maximum(np.abs(along) - length, 0.0), across) - width
    a, b = np.abs(along) - length, np.abs(across) - width
    return np.hypot(np.maximum(a, 0.0), np.maximum(b, 0.0)) + np.minimum(np.maximum(a, b), 0.0)


def spare(task: Task, states: Array) -> Array:
    """How far each ball is from each obstacle, (..., K, obstacles), over the clearance."""
    places = balls(task, states)
    away = np.stack([distance(shape, places) for shape in task.obstacles], axis=-1)
    return away - RADIUS - task.clearance


def inequalities(task: Task, states: Array) -> Array:
    """All numbers that are not to be negative, of states (..., T+1, n): (..., numbers).

    They act from step 1 on; bounds not at the last one, if the goal fixes it.
    """
    later = states[..., 1:, :]
    bounded = later[..., :-1, 3:] if task.exact else later[..., 3:]
    low, high = task.road
    parts = [
        spare(task, later), task.bounds - bounded, task.bounds + bounded, later[..., 1] - low, high - later[..., 1],
    ]  # fmt: skip
    return np.concatenate([part.reshape(*states.shape[:-2], -1) for part in parts], axis=-1)


def examine(task: Task, states: Array, controls: Array) -> Found:
    """By how much a plan misses what the task asks of it."""
    motion = np.abs(step(task, states[:-1], controls, task.dt) - states[1:]).max()
    return Found(
        start=float(np.abs(states[0] - task.start).max()),
        motion=float(motion),
        limits=float(np.maximum(0.0, (np.abs(controls) - task.top).max())),  # NaN where that is one
        kept=float(np.maximum(0.0, -inequalities(task, states).min())),
        goal=float(np.abs(states[-1] - task.goal).max()) if task.exact else 0.0,
    )


def cost(task: Task, states: Array, controls: Array) -> Array:
    """Of plans (..., T+1, n) and (..., T, 2)."""
    total = 0.5 * (task.effort * controls**2).sum(axis=(-2, -1))
    total = total + 0.5 * task.weight * ((states[..., -1, :] - task.goal) ** 2).sum(axis=-1)
    if task.repulsion is not None:
        weight, sharpness = task.repulsion
        away = spare(task, states[..., 1:-1, :]) + task.clearance  # a stage cost, and not at a given start
        total = total + weight * np.exp(-sharpness * away).sum(axis=(-3, -2, -1))
    return total
