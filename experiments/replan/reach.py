"""Arms from MJCFs that plan again at 10 Hz while they are pushed, in MuJoCo on the file as it is."""

from collections import Counter
from typing import Any

import mjcf_postures as postures
import mujoco
import numpy as np
from mjcf.files import ARM
from runner import progress, table

import lqrsim as ls
from lqrsim.scenes.scene import scene_from_xml
from replan.common import Config

EVERY = 0.1  # s, between two plans, and from a measured state until the plan from there comes into force
STEPS, LASTS = 20, 80  # control periods of 20 ms, of a plan and of a run
PUSHES, IMPULSE = 3, 1.0  # number in a run, and size in N s, of a standard deviation along each axis, on the last link


def measure(config: Config) -> dict[str, Any]:
    arms = {path.parent.name + "/" + path.stem: path for path in config.arms} or {
        "arm of six hinges": scene_from_xml(ARM, "arm")
    }
    return {"rows": [{"arm": name, **of_one(config, name, file)} for name, file in arms.items()]}


def of_one(config: Config, name: str, file: Any) -> dict[str, Any]:
    """The re-plans of runs to all goals of an arm."""
    last = last_link(ls.MjcfRobot(file).scene.model)
    robot = ls.MjcfRobot(file, body=last)
    model, start = robot.scene.model, postures.beginning(robot)
    plant, width = ls.Plant(robot, robot.scene), postures.widths(robot.scene.model)
    dt = robot.dynamics.period_near(0.02)
    seconds, iterations, missed, ended = list[float](), list[int](), list[float](), Counter[str]()
    for seed in progress(range(min(config.queries, 10)), name):
        goal = postures.drawn(postures.Config(), robot, start, dt, seed)
        problem = robot.problem(start, goal, steps=STEPS, dt=dt)
        # A coarse plan will do: the first re-plan follows at once.
        first = ls.smooth(problem, tolerance=1e-2, time_limit=20)
        law = ls.Replanner(problem, first, every=EVERY, horizon="moving", computing=EVERY)
        rng = np.random.default_rng([config.seed, seed])
        pushes = [
            ls.disturbances.Push(impulse=(rng.normal(size=3) * IMPULSE).tolist(), at=float(at))
            for at in rng.uniform(EVERY, 0.6 * LASTS * dt, PUSHES)
        ]
        # A plan that only says how long the run is, and from where.
        whole = ls.smooth(robot.problem(start, goal, steps=LASTS, dt=dt), max_iterations=1)
        rollout = ls.simulate(plant, whole, controller=law, disturbances=pushes, frames=False)
        records = rollout.controller_run.log.records
        seconds += [one.seconds for one in records]
        iterations += [one.iterations for one in records]
        ended.update(one.status if one.used else one.reason for one in records)
        missed.append(float((np.abs(rollout.states[0, -1] - goal)[: model.nv] / width[: model.nv]).max()))
    took = 1000 * np.array(seconds)
    return {
        "plans": len(took), "median": float(np.median(took)), "p95": float(np.quantile(took, 0.95)),
        "most": float(took.max()), "iterations": float(np.median(iterations)), "ended": dict(ended),
        "in_time": float((took <= 1000 * EVERY).mean()), "reached": sum(one <= postures.REACHED for one in missed),
        "runs": len(missed),
    }  # fmt: skip


def last_link(model: mujoco.MjModel) -> str:
    """The body of the last joint that an actuator drives."""
    return model.body(int(model.jnt_bodyid[postures.driven(model)[-1]])).name


def report(found: dict[str, Any]) -> list[str]:
    head = (
        "arm", "re-plans", "median (ms)", "95 % (ms)", "most (ms)", "iterations, median", "in time (%)",
        "converged (%)", "at their goals",
    )  # fmt: skip
    rows = [
        [
            one["arm"], one["plans"], f"{one['median']:.0f}", f"{one['p95']:.0f}", f"{one['most']:.0f}",
            f"{one['iterations']:.0f}", f"{100 * one['in_time']:.1f}",
            f"{100 * one['ended'].get('CONVERGED', 0) / one['plans']:.1f}", f"{one['reached']} of {one['runs']}",
        ]
        for one in found["rows"]
    ]  # fmt: skip
    return [
        f"Runs of {LASTS * 0.02:g} s from posture to posture, with {PUSHES} pushes on the last link of {IMPULSE:g} N s"
        f" along each axis, a standard deviation. Every {1000 * EVERY:g} ms a plan of {STEPS} periods of 20 ms, from"
        " where the robot will be as much later. Solves run to their ends, and are in time if they took no longer.",
        table(head, rows),
        *(f"{one['arm']}: " + ", ".join(f"{n} {name}" for name, n in sorted(one["ended"].items())) + "."
          for one in found["rows"]),
    ]  # fmt: skip
