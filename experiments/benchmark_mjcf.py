"""What an iteration on MuJoCo's own steps costs, against these steps alone, and what a second thread brings.

    python experiments/benchmark_mjcf.py            # a cart-pole, a free box, an arm, and the packaged quadrotor
    python experiments/benchmark_mjcf.py --quick

An iteration linearises twice about a trajectory and runs the policy once. By central differences each linearisation of
a step takes 2 (n + m) + 1 control periods of `mj_step`, and the run one. How long these take alone is measured in the
same process, in turns, from compiled code, too.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from mjcf.files import FILES
from paper.common import table

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml


@dataclass(frozen=True, kw_only=True)
class Config:
    steps: int = 150
    """Of the horizon."""
    rounds: int = 15
    """Of measurements that alternate; medians are printed."""
    quick: bool = False
    """Few steps and rounds."""


@dataclass(frozen=True)
class Row:
    """Of a robot: what an iteration takes in ms on one thread and on two, and the steps that it needs."""

    name: str
    alone: float
    together: float
    needed: float


def main(config: Config) -> list[Row]:
    """Measure each robot."""
    if config.quick:
        config = Config(steps=10, rounds=2)
    robots = {name: ls.MjcfRobot(scene_from_xml(xml, name)) for name, xml in FILES.items()}
    robots["quadrotor"] = ls.MjcfRobot("cage")
    return [measure(config, name, robot) for name, robot in robots.items()]


def measure(config: Config, name: str, robot: ls.MjcfRobot) -> Row:
    """One iteration about the same trajectory again and again, on one thread and on two, and the steps alone."""
    dynamics, timestep = robot.dynamics, float(robot.scene.model.opt.timestep)
    dt = max(1, round(0.02 / timestep)) * timestep
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    goal = robot.at() + 0.1
    problem = ls.Problem(
        dynamics=dynamics, dt=dt, steps=config.steps, initial=ls.FixedState(robot.at()),
        stage_cost=ls.ControlCost(np.ones(m)), final_cost=ls.QuadraticCost(np.ones(n), about=goal),
    )  # fmt: skip
    times: dict[str, list[float]] = {"alone": [], "together": [], "needed": []}
    states, controls = np.tile(robot.at(), (config.steps, 1)), np.zeros((config.steps, m))
    for _ in range(config.rounds + 1):
        for which, threads in (("alone", 1), ("together", 2)):
            solution = ls.smooth(
                problem, max_iterations=4, threads=threads, start=controls, safeguard=False, finish=None
            )
            # Not the first, which has a pass more, nor the last, which may be certified.
            times[which].append(1000 * solution.iterations[1].seconds)
        one = steps_alone(dynamics, states, controls, dt)
        times["needed"].append(1000 * one * (2 * (2 * (n + m) + 1) + 1))
    return Row(name, *(float(np.median(times[which][1:])) for which in ("alone", "together", "needed")))


def steps_alone(dynamics: Any, states: Array, controls: Array, dt: float) -> float:
    """Seconds that a control period of `mj_step` at each of the states takes, called from compiled code."""
    data, out, advance = dynamics.data, np.empty(states.shape[1]), dynamics._core.advance
    seconds = []
    for sign in (1, -1):  # backwards nothing is done but the call
        clock = time.perf_counter()
        for x, u in zip(states, controls, strict=True):
            advance(x, u, data, sign * dt, out)
        seconds.append(time.perf_counter() - clock)
    return seconds[0] - seconds[1]


def report(rows: list[Row]) -> str:
    head = ("robot", "ms of an iteration", "of the steps that it needs", "ratio", "two threads against one")
    return table(head, [
        [row.name, f"{row.alone:.1f}", f"{row.needed:.1f}", f"{row.alone / row.needed:.2f}",
         f"{row.alone / row.together:.2f}"] for row in rows
    ])  # fmt: skip


if __name__ == "__main__":
    print(report(main(tyro.cli(Config, description=__doc__))))
