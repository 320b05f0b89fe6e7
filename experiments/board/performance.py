"""The boards of performance: one run without anything wrong, its published criteria and the score of each version."""

from dataclasses import replace

import numpy as np

from board.double_pendulum import ACTUATED, MODELS, UNKNOWN, Robot, advance
from board.law import GENTLE, Aim, SwingUp
from board.trials import DT, STEPS
from lqrsim.errors import Array

LENGTHS, HIGH = 0.5, 0.9  # m of both links together; of which the end has to be above to count as up
LINK = {("pendubot", 1): 0.2}  # m of the second link, which is 0.3 m otherwise
CRITERIA = ("time (s)", "energy (J)", "torque (Nm)", "torque (Nms)", "torque cost", "smoothness (Nm)", "velocity cost")
# By version, of each criterion: its weight and what it is divided by. 0 is for those that do not count.
WEIGHTS = {1: (0.2, 0.1, 0.1, 0.1, 0.1, 0.2, 0.2), 2: (1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0)}
SCALES = {1: (10.0, 100.0, 6.0, 60.0, 360.0, 12.0, 1000.0), 2: (20.0, 60.0, 1.0, 1.0, 20.0, 0.1, 400.0)}
# Version 1 of the board pays for time, where the pendubot may be fast; else torques and velocities cost more.
_CHEAP = Aim(effort=1.0, state=(0.1, 0.1, 0.05, 0.05), horizons=(0.8, 1.0, 1.2, 1.5, 2.0), a_second=10.0, blend=True)
AIMS = dict.fromkeys(MODELS, _CHEAP)
AIMS["pendubot", 1] = replace(GENTLE, blend=True)


def run(robot: Robot, version: int) -> tuple[Array, Array]:
    """States (T, 4) and torques (T,) of a run by a law that measures them exactly."""
    law, x = SwingUp(robot, version, 1, AIMS[robot, version]), np.zeros((1, 4))
    p = {name: np.array([value]) for name, value in {**MODELS[robot, version], **UNKNOWN}.items()}
    states, torques = np.empty((STEPS, 4)), np.empty(STEPS)
    for step in range(STEPS):
        states[step], torques[step] = x[0], law(x)[0]
        applied = np.zeros((1, 2))
        applied[:, ACTUATED[robot]] = torques[step]
        x = advance(x, applied, p, DT)
    return states, torques


def criteria(states: Array, torques: Array, robot: Robot, version: int) -> Array:
    """The criteria of a run, in their order: (7,). The time is that from which on the end is up to the end."""
    second, motor = LINK.get((robot, version), 0.3), ACTUATED[robot]
    height = -(LENGTHS - second) * np.cos(states[:, 0]) - second * np.cos(states[:, 0] + states[:, 1])
    down = np.flatnonzero(height <= HIGH * LENGTHS)
    up_at = DT * min(down[-1] + 1 if len(down) else 0, len(states) - 1)
    u = torques[:-1]
    energy = np.abs(np.diff(states[:, motor]) * u).sum()
    costs = DT * np.abs(u).sum(), DT * (u**2).sum(), np.diff(torques).std(), DT * (states[:-1, 2:] ** 2).sum()
    return np.array([up_at, energy, np.abs(torques).max(), *costs])


def score(found: Array, version: int) -> float:
    """The score of criteria (7,); 0 for a run that does not end up."""
    weights, shares = np.array(WEIGHTS[version]), found / np.array(SCALES[version])
    if found[0] >= DT * (STEPS - 1):
        return 0.0
    return float(1 - (weights @ shares if version == 1 else np.tanh(np.pi * weights * shares)[weights > 0].mean()))
