"""The noises and problems that all sections share, and how two plans are compared on the same trials."""

from dataclasses import dataclass
from math import erfc, sqrt
from typing import Any, Self

import numpy as np
from runner import FolderSettings, at_most

import lqrsim as ls
from lqrsim import rotations

PLACE, WIDTH = (0.6, 0.2), 0.5  # of the oil, in m: on the drive's way


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    trials: int = 10_000
    """Of each plan, by the problem's own model."""
    queries: int = 20
    """Of the quadrotor: plans that know of the noise against plans that do not."""
    iterated: int = 100
    """Of the quadrotor: the smoother against iLQR, both under the noise."""
    rounds: int = 9
    """How often an iteration is timed."""
    seed: int = 0
    """Of what is drawn."""

    def bounded(self) -> Self:
        """The settings, reduced by `--quick`."""
        return at_most(self, trials=500, queries=2, iterated=3, rounds=2)


def drive() -> ls.Problem:
    return ls.scenarios.differential_drive().problem


def quadrotor(query: int = 0) -> ls.Problem:
    return ls.scenarios.quadrotor(query).problem


def slipping(x: Any, u: Any, p: Any) -> Any:
    """Each wheel's speed is off by a share of itself."""
    return slips(x, u, p, p.share)


def oil(x: Any, u: Any, p: Any) -> Any:
    """The same, and on oil by far more."""
    from sympy import exp

    away = (x[0] - p.x) ** 2 + (x[1] - p.y) ** 2
    return slips(x, u, p, p.share * (1 + p.more * exp(-away / (2 * p.width**2))))


def slips(x: Any, u: Any, p: Any, share: Any) -> Any:
    from sympy import cos, sin

    ahead = [[p.dt * share * wheel * part / 2 for wheel in u] for part in (cos(x[2]), sin(x[2]))]
    return [*ahead, [-p.dt * share * u[0] / p.axle_length, p.dt * share * u[1] / p.axle_length]]


def unsteady(x: Any, u: Any, p: Any) -> Any:
    """Each rotor's force is off by a share of itself."""
    pushes = [rotations.rotate(x[6:9], [0, 0, p.share * force]) for force in u]
    speeds = [[p.dt / p.mass * push[i] for push in pushes] for i in range(3)]
    forces = [p.dt / p.inertia * p.share * force for force in u]
    arms, turns = ((0, p.arm, 0, -p.arm), (-p.arm, 0, p.arm, 0)), (1, -1, 1, -1)
    spins = [[length * force for length, force in zip(arm, forces, strict=True)] for arm in arms]
    spins.append([p.torque_ratio * turn * force for turn, force in zip(turns, forces, strict=True)])
    return [[0] * 4] * 3 + speeds + [[0] * 4] * 3 + spins


def slip(share: float) -> ls.Noise:
    robot, problem = ls.DifferentialDrive(), drive()
    given = {"share": share, "dt": problem.dt, "axle_length": robot.axle_length}
    return ls.Noise(slipping, size=2, parameters=given)


def on_oil(share: float, more: float) -> ls.Noise:
    robot, problem = ls.DifferentialDrive(), drive()
    given = {"share": share, "dt": problem.dt, "axle_length": robot.axle_length, "more": more, "width": WIDTH}
    return ls.Noise(oil, size=2, parameters=given | {"x": PLACE[0], "y": PLACE[1]})


def rotors(share: float) -> ls.Noise:
    robot = ls.Quadrotor()
    given = {name: getattr(robot, name) for name in ("mass", "inertia", "arm", "torque_ratio")}
    return ls.Noise(unsteady, size=4, parameters=given | {"share": share, "dt": quadrotor().dt})


def gusts(speed: float) -> ls.Noise:
    """Velocity that changes by so many m/s in each direction, always alike."""
    matrix = np.zeros((12, 3))
    matrix[3:6] = speed * np.eye(3)
    return ls.Noise(matrix)


def jolts(metres: float) -> ls.Noise:
    """The drive is displaced, always alike: so many m, and as many times 2.5 rad."""
    return ls.Noise(metres * np.diag([1.0, 1.0, 2.5]))


def paired(problem: ls.Problem, one: ls.Solution, other: ls.Solution, config: Config) -> dict[str, float]:
    """Mean costs of two plans on the same trials, and the chance (one-sided) that the first is no better."""
    costs = [ls.sample_costs(problem, plan, trials=config.trials, seed=config.seed) for plan in (one, other)]
    difference = costs[1] - costs[0]
    error = float(difference.std(ddof=1) / sqrt(len(difference)))
    means = [float(cost.mean()) for cost in costs]
    chance = 0.5 * erfc(float(difference.mean()) / error / sqrt(2)) if error > 0 else 1.0
    return {"mean": means[0], "other": means[1], "chance": chance}


def clearance(solution: ls.Solution) -> float:
    assert solution.clearance is not None
    return float(solution.clearance.min())
