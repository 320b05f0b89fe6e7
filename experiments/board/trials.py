"""The board's runs, as published: what is wrong in each, how it is simulated, when it has succeeded, and the score.

Ten parameters of the model at 21 values; noise of the velocities and of the torque at 21 levels, ten times; a motor
that answers slowly or too much, and measurements that come late, at 21 levels; and in version 2 fifty runs with six
pushes of the joints. A level of noise counts if more than half of its runs succeed. The score is the mean of the
shares.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from board.double_pendulum import ACTUATED, LIMIT, MODELS, UNKNOWN, Robot, advance, off_upright
from lqrsim.errors import Array

DT, SECONDS = 0.002, 10.0
STEPS = round(SECONDS / DT)
LEVELS, REPETITIONS, PUSHED = 21, 10, 50
MODEL = ("Ir", "m1r1", "I1", "b1", "cf1", "m2r2", "m2", "I2", "b2", "cf2")
CLOSE = {1: (0.1, 0.1, 0.5, 0.5), 2: (0.35, 0.35, 1.0, 1.0)}  # rad and rad/s: at any time; at the end
LONGEST = 25  # measurements that are kept for those that come late

Law = Callable[[Array], Array]  # from measured states (K, 4), once a step, to torques (K,)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One run: of which column of the board, at which level, and what is wrong in it.

    Attributes:
      velocity_noise: std in rad/s. torque_noise: std in Nm. response: of the motor, 1 at once. late: steps that
        measurements are late. pushed: whether joints are pushed. number: of its random numbers.
    """

    column: str
    level: float
    number: int
    parameters: dict[str, float] = field(default_factory=dict)
    velocity_noise: float = 0.0
    torque_noise: float = 0.0
    response: float = 1.0
    late: int = 0
    pushed: bool = False


def trials(robot: Robot, version: int) -> list[Trial]:
    """All of them."""
    known, found = MODELS[robot, version], list[Trial]()

    def add(column: str, level: float, **wrong: object) -> None:
        found.append(Trial(column=column, level=float(level), number=len(found), **wrong))  # pyright: ignore[reportArgumentType]

    spans = {"Ir": (0.0, 1e-4), "b1": (-0.1, 0.1), "b2": (-0.1, 0.1), "cf1": (-0.2, 0.2), "cf2": (-0.2, 0.2)}
    of = {"m1r1": "r1", "m2r2": "r2", "I1": "I1", "I2": "I2", "m2": "m2"}  # a first moment changes by its lever
    for name in MODEL:
        for level in np.linspace(*spans.get(name, (0.75, 1.25)), LEVELS):
            wrong = {name: float(level)} if name in spans else {of[name]: known[of[name]] * float(level)}
            add(name, level, parameters=wrong)
    for level in np.linspace(0.0, 0.5, LEVELS):
        for _ in range(REPETITIONS):
            add("velocity noise", level, velocity_noise=float(level))
    for level in np.linspace(0.0, 1.1, LEVELS):
        for _ in range(REPETITIONS):
            add("torque noise", level, torque_noise=float(level))
    for level in np.linspace(0.1, 2.0, LEVELS):
        add("response", level, response=float(level))
    for level in np.linspace(0.0, 0.04, LEVELS):
        add("delay", level, late=int(level / DT))
    for number in range(PUSHED if version == 2 else 0):
        add("pushes", number, pushed=True)
    return found


def simulate(chosen: list[Trial], law: Law, robot: Robot, version: int, seed: int) -> NDArray[np.bool_]:
    """Which of the trials succeed, (K,). Each has random numbers of its own, whatever others there are."""
    count, motor = len(chosen), ACTUATED[robot]
    rngs = [np.random.default_rng([seed, version, one.number]) for one in chosen]
    pushes = np.array(
        [_pushes(rng) if one.pushed else np.zeros((STEPS, 2)) for one, rng in zip(chosen, rngs, strict=True)]
    )
    noises = np.array([rng.standard_normal((STEPS, 3)) for rng in rngs])
    kinds = {**MODELS[robot, version], **UNKNOWN}
    p = {name: np.array([{**kinds, **one.parameters}[name] for one in chosen]) for name in kinds}
    velocity_noise, torque_noise, response, late = (
        np.array([getattr(one, name) for one in chosen])
        for name in ("velocity_noise", "torque_noise", "response", "late")
    )
    x, last, seen = np.zeros((count, 4)), np.zeros(count), [np.zeros((count, 4))]
    close, has_been = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    for step in range(STEPS):
        kept = np.array(seen[-LONGEST:])
        measured = kept[np.maximum(len(kept) - 1 - late, 0), np.arange(count)].copy()
        measured[:, 2:] += velocity_noise[:, None] * noises[:, step, :2]
        torque = last + response * (law(measured) - last) + torque_noise * noises[:, step, 2]
        torques = pushes[:, step].copy()
        torques[:, motor] += np.clip(torque, -LIMIT, LIMIT)
        last = torques[:, motor]
        x = advance(x, torques, p, DT)
        seen = [*seen[-LONGEST:], x]
        close = (off_upright(x) < CLOSE[version]).all(axis=1)
        has_been |= close
    return np.where(version == 1, has_been, close)


def _pushes(rng: np.random.Generator) -> Array:
    """Three pushes of each joint, at least a second apart, as torques (T, 2)."""
    count, apart = 3, 1.0
    room = (SECONDS - (2 * count + 1) * apart) / (2 * count)
    times = np.cumsum(apart + room * rng.random(2 * count))
    rng.shuffle(times)
    widths = rng.uniform(0.05, 0.1, 2 * count)
    heights = rng.uniform(-4.5, 4.5, 2 * count)
    heights += 0.5 * np.sign(heights)
    t = DT * np.arange(STEPS)[:, None]
    return (heights * np.exp(-((t - times) ** 2) / (2 * widths**2))).reshape(STEPS, 2, count).sum(axis=2)


def columns(chosen: list[Trial], succeeded: NDArray[np.bool_]) -> dict[str, float]:
    """The board's columns, each a share, and the score, their mean."""
    shares: dict[str, list[float]] = {}
    levels: dict[tuple[str, float], list[bool]] = {}
    for one, good in zip(chosen, succeeded.tolist(), strict=True):
        if one.column.endswith("noise"):
            levels.setdefault((one.column, one.level), []).append(good)
        else:
            shares.setdefault("model" if one.column in MODEL else one.column, []).append(float(good))
    for (column, _), good in levels.items():
        shares.setdefault(column, []).append(float(np.mean(good) > 0.5))
    means = {column: float(np.mean(one)) for column, one in shares.items()}
    return means | {"score": float(np.mean(list(means.values())))}


def of_parameters(chosen: list[Trial], succeeded: NDArray[np.bool_]) -> dict[str, float]:
    """The share of each parameter of the model, of which the column "model" is the mean."""
    good = {name: [bool(k) for one, k in zip(chosen, succeeded, strict=True) if one.column == name] for name in MODEL}
    return {name: float(np.mean(one)) for name, one in good.items() if one}
