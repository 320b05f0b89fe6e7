"""What linearisations and iterations on MuJoCo's own steps cost, how exact the Jacobians are, and what a second thread
brings.

    python experiments/benchmark_mjcf.py            # a cart-pole, a free box, an arm, and the packaged quadrotor
    python experiments/benchmark_mjcf.py --models panda.xml iiwa14.xml
    python experiments/benchmark_mjcf.py --quick

A linearisation by central differences over a control period would take 2 (n + m) + 1 periods of `mj_step`. How long
these take alone is measured along the same plan, where a box that slides needs more than one at rest, in the same
process, in turns, from compiled code, too. An iteration linearises twice about a trajectory and runs the policy once.
All is in processor time, but what a second thread brings. The error is the largest of an entry of Jacobians along the
plan, against central differences over a whole period, relative to the largest entry.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mjcf.files import FILES
from runner import Result, Settings, at_most, opening, run, table

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml

WIDE = 1e-6  # of the central differences: wider ones would often reach across a kink, as of a clamped force
LOOKED_AT = 5  # knots of a plan at which these are compared


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    models: tuple[Path, ...] = ()
    """MJCFs of robots; by default those in the repository."""
    steps: int = 150
    """Of the horizon."""
    rounds: int = 15
    """Of measurements that alternate; medians are printed."""


def main(config: Config) -> Result:
    """Milliseconds of each robot, on one thread and on two, and of the steps that central differences need alone."""
    config = at_most(config, steps=10, rounds=2)
    robots = {path.stem: ls.MjcfRobot(path, obstacles=False) for path in config.models}
    if not robots:
        robots = {name: ls.MjcfRobot(scene_from_xml(xml, name)) for name, xml in FILES.items()}
        robots["quadrotor"] = ls.MjcfRobot("cage")
    found = {name: measure(config, robot) for name, robot in robots.items()}
    if not config.models:
        found["quadrotor, with distances"] = measure(config, robots["quadrotor"], distances=True)
    return opening(config) | {"robots": found}


def measure(config: Config, robot: ls.MjcfRobot, *, distances: bool = False) -> dict[str, float]:
    """One iteration about the same trajectory again and again, on one thread and on two, and the steps alone."""
    dynamics, model = robot.dynamics, robot.scene.model
    timestep = float(model.opt.timestep)
    dt = max(1, round(0.02 / timestep)) * timestep
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    start = robot.at(model.key(0).name) if model.nkey else robot.at()
    held, cost = robot.hold(start), ls.ControlCost(np.ones(m))
    if distances:
        cost = cost + ls.ObstacleCost(robot.scene.world, geoms=robot.geoms, sharpness=20.0, weight=0.1)
    problem = ls.Problem(
        dynamics=dynamics, dt=dt, steps=config.steps, initial=ls.FixedState(start),
        stage_cost=cost, final_cost=ls.QuadraticCost(np.ones(n), about=towards(robot, start)),
    )  # fmt: skip
    times: dict[str, list[float]] = {which: [] for which in ("linearisation", "needed", "iteration", "one", "two")}
    controls = np.tile(held, (config.steps, 1))
    plan = np.tile(start, (config.steps, 1)), controls
    for _ in range(config.rounds + 1):
        for which, threads in (("one", 1), ("two", 2)):
            ends: list[float] = []
            solution = ls.smooth(
                problem, max_iterations=4, tolerance=1e-15, threads=threads, start=controls, safeguard=False,
                callback=lambda iteration, ends=ends: ends.append(time.process_time()),
            )  # fmt: skip
            # Not the first, which has a pass more, nor the last, which may be certified.
            times[which].append(1000 * solution.iterations[1].seconds)
            if threads == 1:
                times["iteration"].append(1000 * (ends[1] - ends[0]))
                plan = solution.trajectory.states[:-1], solution.trajectory.controls
                times["needed"].append(1000 * seconds_of(dynamics, plan, dt) * (2 * (n + m) + 1))
                times["linearisation"].append(1000 * seconds_of(dynamics, plan, dt, jacobian=True))
    return {which: float(np.median(values[1:])) for which, values in times.items()} | {
        "error": largest_error(dynamics, plan, dt), "steps": config.steps,
    }  # fmt: skip


def towards(robot: ls.MjcfRobot, start: Array) -> Array:
    """A goal nearby: each position 0.02 on, or a fiftieth of the way to the middle of its range."""
    model, goal = robot.scene.model, start.copy()
    for joint in range(model.njnt):
        dof = int(model.jnt_dofadr[joint])
        away = model.jnt_range[joint].mean() - start[dof] if model.jnt_limited[joint] else 1.0
        goal[dof] += 0.02 * away
    return goal


def seconds_of(dynamics: ls.Dynamics, plan: tuple[Array, Array], dt: float, *, jacobian: bool = False) -> float:
    """Processor seconds of all control periods of a plan, or of their linearisations, called from compiled code."""
    data, n, m = dynamics.data, plan[0].shape[1], plan[1].shape[1]
    out, seconds = (np.empty(n), np.empty((n, n + m)))[: 2 if jacobian else 1], []
    function = dynamics.compiled.step_jacobian if jacobian else dynamics.compiled.advance
    for sign in (1, -1):  # backwards nothing is done but the call
        clock = time.process_time()
        for x, u in zip(*plan, strict=True):
            function(x, u, data, sign * dt, *out)
        seconds.append(time.process_time() - clock)
    return seconds[0] - seconds[1]


def largest_error(dynamics: ls.Dynamics, plan: tuple[Array, Array], dt: float) -> float:
    """The largest error of an entry of a Jacobian, relative to the largest entry, at some knots."""
    worst, n = 0.0, plan[0].shape[1]
    for t in np.linspace(0, len(plan[1]) - 1, LOOKED_AT).astype(int):
        joint = np.concatenate([plan[0][t], plan[1][t]])
        columns = []
        for move in WIDE * np.eye(len(joint)):
            ahead, behind = (dynamics.step(one[:n], one[n:], dt) for one in (joint + move, joint - move))
            columns.append((ahead - behind) / (2 * WIDE))
        expected = np.stack(columns, axis=1)
        found = np.hstack(dynamics.linearize(joint[:n], joint[n:], dt)[:2])
        worst = max(worst, float(np.abs(found - expected).max() / np.abs(expected).max()))
    return worst


def report(result: Result) -> str:
    head = (
        "robot", "ms of a linearisation", "of central differences", "ratio", "error", "ms of an iteration",
        "two threads against one",
    )  # fmt: skip
    return table(head, [
        [name, f"{one['linearisation'] / one['steps']:.3f}", f"{one['needed'] / one['steps']:.3f}",
         f"{one['linearisation'] / one['needed']:.2f}", f"{one['error']:.0e}", f"{one['iteration']:.1f}",
         f"{one['one'] / one['two']:.2f}"] for name, one in result["robots"].items()
    ])  # fmt: skip


if __name__ == "__main__":
    run(Config, main, report, __doc__)
