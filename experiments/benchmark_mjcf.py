"""What an iteration on MuJoCo's own steps costs, against these steps alone, and what a second thread brings.

    python experiments/benchmark_mjcf.py            # a cart-pole, a free box, an arm, and the packaged quadrotor
    python experiments/benchmark_mjcf.py --quick

An iteration linearises twice about a trajectory and runs the policy once. By central differences a linearisation of a
step takes 2 (n + m) + 1 control periods of `mj_step`, and the run one. How long these take alone is measured along the
plan, where a box that slides needs more than one at rest, in the same process, in turns, from compiled code, too. All
is in processor time, but what a second thread brings.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from mjcf.files import FILES
from runner import Result, Settings, at_most, opening, run, table

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    steps: int = 150
    """Of the horizon."""
    rounds: int = 15
    """Of measurements that alternate; medians are printed."""


def main(config: Config) -> Result:
    """Milliseconds of each robot: of an iteration on one thread and on two, and of the steps that it needs alone."""
    config = at_most(config, steps=10, rounds=2)
    robots = {name: ls.MjcfRobot(scene_from_xml(xml, name)) for name, xml in FILES.items()}
    robots["quadrotor"] = ls.MjcfRobot("cage")
    found = {name: measure(config, robot) for name, robot in robots.items()}
    found["quadrotor, with distances"] = measure(config, robots["quadrotor"], distances=True)
    return opening(config) | {"robots": found}


def measure(config: Config, robot: ls.MjcfRobot, *, distances: bool = False) -> dict[str, float]:
    """One iteration about the same trajectory again and again, on one thread and on two, and the steps alone."""
    dynamics, timestep = robot.dynamics, float(robot.scene.model.opt.timestep)
    dt = max(1, round(0.02 / timestep)) * timestep
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    goal, cost = robot.at() + 0.1, ls.ControlCost(np.ones(m))
    if distances:
        cost = cost + ls.ObstacleCost(robot.scene.world, geoms=robot.geoms, sharpness=20.0, weight=0.1)
    problem = ls.Problem(
        dynamics=dynamics, dt=dt, steps=config.steps, initial=ls.FixedState(robot.at()),
        stage_cost=cost, final_cost=ls.QuadraticCost(np.ones(n), about=goal),
    )  # fmt: skip
    times: dict[str, list[float]] = {"alone": [], "needed": [], "wall": [], "together": []}
    controls = np.zeros((config.steps, m))
    for _ in range(config.rounds + 1):
        for which, threads in (("wall", 1), ("together", 2)):
            ends: list[float] = []
            solution = ls.smooth(
                problem, max_iterations=4, threads=threads, start=controls, safeguard=False, finish=None,
                callback=lambda iteration, ends=ends: ends.append(time.process_time()),
            )  # fmt: skip
            # Not the first, which has a pass more, nor the last, which may be certified.
            times[which].append(1000 * solution.iterations[1].seconds)
            if threads == 1:
                times["alone"].append(1000 * (ends[1] - ends[0]))
                one = steps_alone(dynamics, solution.trajectory.states[:-1], solution.trajectory.controls, dt)
                times["needed"].append(1000 * one * (2 * (2 * (n + m) + 1) + 1))
    return {which: float(np.median(values[1:])) for which, values in times.items()}


def steps_alone(dynamics: Any, states: Array, controls: Array, dt: float) -> float:
    """Processor seconds of a control period of `mj_step` at each of the states, called from compiled code."""
    data, out, advance = dynamics.data, np.empty(states.shape[1]), dynamics.compiled.advance
    seconds = []
    for sign in (1, -1):  # backwards nothing is done but the call
        clock = time.process_time()
        for x, u in zip(states, controls, strict=True):
            advance(x, u, data, sign * dt, out)
        seconds.append(time.process_time() - clock)
    return seconds[0] - seconds[1]


def report(result: Result) -> str:
    head = ("robot", "ms of an iteration", "of the steps that it needs", "ratio", "two threads against one")
    return table(head, [
        [name, f"{one['alone']:.1f}", f"{one['needed']:.1f}", f"{one['alone'] / one['needed']:.2f}",
         f"{one['wall'] / one['together']:.2f}"] for name, one in result["robots"].items()
    ])  # fmt: skip


if __name__ == "__main__":
    run(Config, main, report, __doc__)
