"""What linearisations and iterations on MuJoCo's own steps cost, how exact the Jacobians are, what a second thread
brings; and what whole solves cost against the same with formulas.

    python experiments/benchmark_mjcf.py            # a cart-pole, a free box, an arm, and the packaged quadrotor
    python experiments/benchmark_mjcf.py --models panda.xml iiwa14.xml --sections linearisations
    python experiments/benchmark_mjcf.py --sections formulas    # a body with eight thrusters, a slung load
    python experiments/benchmark_mjcf.py --quick

A linearisation by central differences over a control period would take 2 (n + m) + 1 periods of `mj_step`. How long
these take alone is measured along the same plan, where a box that slides needs more than one at rest, in the same
process, in turns, from compiled code, too. An iteration linearises twice about a trajectory and runs the policy once.
All is in processor time, but what a second thread brings. The error is the largest of an entry of Jacobians along the
plan, against central differences over a whole period, relative to the largest entry.

`experiments/mjcf/formulas.py` has two robots as formulas, which agree with their files to the error of MuJoCo's time
step. Solves by both alternate in this process, on one thread, in processor time; the first of each is not counted.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from mjcf.files import FILES, PILLARS, SLUNG_LOAD, THRUSTERS
from mjcf.formulas import GUARD, slung_load, thrusters
from runner import Result, Settings, at_most, opening, progress, run, table

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.parts import terms_of
from lqrsim.scenes.scene import scene_from_xml

WIDE = 1e-6  # of the central differences: wider ones would often reach across a kink, as of a clamped force
LOOKED_AT = 5  # knots of a plan at which these are compared
CLEARANCES = 0.0, 0.1, 0.15, 0.3  # m, of the body with eight thrusters among pillars
Section = Literal["linearisations", "formulas"]


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    sections: tuple[Section, ...] = get_args(Section)
    """What to measure."""
    models: tuple[Path, ...] = ()
    """MJCFs of robots; by default those in the repository."""
    steps: int = 150
    """Of the horizon."""
    rounds: int = 15
    """Of measurements that alternate; medians are printed."""


def main(config: Config) -> Result:
    """Of each robot, and of solves by MJCF and by formula."""
    config, result = at_most(config, steps=10, rounds=2), opening(config)
    if "linearisations" in config.sections:
        result["robots"] = linearisations(config)
    if "formulas" in config.sections:
        result["formulas"] = [by_both(config, *one) for one in progress(list(against_formulas()), "formulas")]
    return result


def linearisations(config: Config) -> Result:
    """Milliseconds of each robot, on one thread and on two, and of the steps that central differences need alone."""
    robots = {path.stem: ls.MjcfRobot(path, obstacles=False) for path in config.models}
    if not robots:
        robots = {name: ls.MjcfRobot(scene_from_xml(xml, name)) for name, xml in FILES.items()}
        robots["quadrotor"] = ls.MjcfRobot("cage")
    found = {name: measure(config, robot) for name, robot in robots.items()}
    if not config.models:
        found["quadrotor, with distances"] = measure(config, robots["quadrotor"], distances=True)
    return found


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


def against_formulas() -> Iterator[tuple[str, ls.Problem, ls.Problem]]:
    """Problems with names, by MJCF and by formula."""
    files = THRUSTERS, THRUSTERS.replace(PILLARS, "")
    body, free = (ls.MjcfRobot(scene_from_xml(xml, "thrusters")) for xml in files)
    goal, formula = {"rov_x": 5.0, "rov_y": 0.3, "rov_z": 1.4}, thrusters()
    bare = free.problem(free.at(), free.at(None, **goal), steps=80, dt=0.1)
    yield "eight thrusters, no obstacles", bare, replace(bare, dynamics=formula)
    for clearance in CLEARANCES:
        problem = body.problem(body.at(), body.at(None, **goal), steps=80, dt=0.1, clearance=clearance)
        guarded = ls.Clearance(body.scene.world, radius=GUARD, margin=clearance)
        cost = reduce(add, map(with_guard, terms_of(problem.stage_cost)))
        by_formula = replace(problem, dynamics=formula, stage_cost=cost, constraints=[guarded])
        yield f"among pillars, clearance {clearance:g} m", problem, by_formula
    load = ls.MjcfRobot(scene_from_xml(SLUNG_LOAD, "slung load"))
    carried = load.problem(load.at(), load.at(x=2.0, y=1.0, z=2.5), steps=100, dt=0.02)
    yield "quadrotor with a slung load", carried, replace(carried, dynamics=slung_load())


def with_guard(term: ls.Cost) -> ls.Cost:
    """The same by formula: a cost of distances has those of a ball."""
    if not isinstance(term, ls.ObstacleCost):
        return term
    return ls.ObstacleCost(term.world, radius=GUARD, sharpness=term.sharpness, weight=term.weight)


def by_both(config: Config, name: str, by_mjcf: ls.Problem, by_formula: ls.Problem) -> Result:
    """Seconds of processor time, statuses and costs."""
    problems, found, solutions = {"MJCF": by_mjcf, "formula": by_formula}, dict[str, list[float]](), {}
    most: dict[str, Any] = {"max_iterations": 3} if config.quick else {}
    for _ in range(config.rounds + 1):
        for which, problem in problems.items():
            clock = time.process_time()
            solutions[which] = ls.smooth(problem, threads=1, **most)
            found.setdefault(which, []).append(time.process_time() - clock)
    return {"name": name} | {
        which: {
            "seconds": float(np.median(found[which][1:])), "status": one.status.name, "cost": one.cost,
            "iterations": len(one.iterations),
        } for which, one in solutions.items()
    }  # fmt: skip


def report(result: Result) -> str:
    head = (
        "robot", "ms of a linearisation", "of central differences", "ratio", "error", "ms of an iteration",
        "two threads against one",
    )  # fmt: skip
    parts = [] if "robots" not in result else [table(head, [
        [name, f"{one['linearisation'] / one['steps']:.3f}", f"{one['needed'] / one['steps']:.3f}",
         f"{one['linearisation'] / one['needed']:.2f}", f"{one['error']:.0e}", f"{one['iteration']:.1f}",
         f"{one['one'] / one['two']:.2f}"] for name, one in result["robots"].items()
    ])]  # fmt: skip
    if "formulas" in result:
        head = ("problem", "by", "status", "iterations", "cost", "processor (s)", "MJCF against formula")
        parts.append(table(head, [
            [one["name"] if which == "MJCF" else "", which, one[which]["status"], one[which]["iterations"],
             f"{one[which]['cost']:.5g}", f"{one[which]['seconds']:.2f}",
             f"{one['MJCF']['seconds'] / one['formula']['seconds']:.1f}" if which == "formula" else ""]
            for one in result["formulas"] for which in ("MJCF", "formula")
        ]))  # fmt: skip
    return "\n\n".join(parts)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
