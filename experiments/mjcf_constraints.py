"""Constraints with MuJoCo's own dynamics: the default solve beside smoothing with multipliers alone.

    python experiments/mjcf_constraints.py
    python experiments/mjcf_constraints.py --models iiwa14.xml    # and arms of your own, within limits of speed
    python experiments/mjcf_constraints.py --quick

Each problem is solved by default, where the interior point is tried first, and with `finish=None`, by smoothing with an
augmented Lagrangian. Both in turns, in one process and on one thread; medians of processor time, without compiling.
Smoothing with multipliers keeps constraints to a margin, so its costs differ where a constraint acts.
"""

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mjcf.files import ARM, CART_POLE, TWO_LINKS
from runner import Result, Settings, at_most, opening, progress, run, table

import lqrsim as ls
from lqrsim.scenes.scene import scene_from_xml

HAND = '<geom type="capsule" fromto="0.08 0 0 0.35 0 0" mass="0.5"/>'  # of TWO_LINKS, behind which a site is added
PENDULUM = """<mujoco><option timestep="0.01" integrator="implicitfast"/><worldbody><body>
  <joint name="hinge" axis="0 1 0" damping="0.05"/><geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="1"/>
  </body></worldbody><actuator><motor joint="hinge" ctrlrange="-1.5 1.5"/></actuator></mujoco>"""
HAND_AT = (0.2, 0.0, -0.4)  # m, 8 cm from where the hand is at the goal
METHODS: dict[str, dict[str, Any]] = {"default": {}, "multipliers": {"finish": None}}
COLUMNS = {"status": "{}", "iterations": "{}", "seconds": "{:.2f}", "cost": "{:.6g}"}
FAST = 0.7  # of the mean speed that the farthest joint needs, twice: the limit of all joints


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    models: tuple[Path, ...] = ()
    """MJCFs of arms that are added."""
    rounds: int = 3
    """Of measurements that alternate; medians are printed."""
    time_limit: float = 60.0
    """Seconds for each solve."""


def main(config: Config) -> Result:
    """Status, iterations, cost and seconds of each problem, by each method."""
    config = at_most(config, rounds=1, time_limit=10.0)
    problems = {name: make() for name, make in PROBLEMS.items()}
    problems |= {path.stem: slow(ls.MjcfRobot(path)) for path in config.models}
    return opening(config) | {
        "problems": {name: solved(config, problem) for name, problem in progress(list(problems.items()), "problems")}
    }


def solved(config: Config, problem: ls.Problem) -> dict[str, dict[str, object]]:
    """What each method makes of a problem."""
    found, seconds = dict[str, ls.Solution](), {name: list[float]() for name in METHODS}
    for options in METHODS.values():
        ls.smooth(problem, max_iterations=1, threads=1, **options)
    for _ in range(config.rounds):
        for name, options in METHODS.items():
            clock = time.process_time()
            found[name] = ls.smooth(problem, time_limit=config.time_limit, threads=1, **options)
            seconds[name].append(time.process_time() - clock)
    return {
        name: {
            "status": one.status.name, "iterations": len(one.iterations), "cost": one.cost, "violation": one.violation,
            "seconds": float(np.median(seconds[name])),
        }
        for name, one in found.items()
    }  # fmt: skip


# The problems.


def cart_pole(goal: dict[str, Any], *kept: ls.Constraint) -> ls.Problem:
    """A cart with a pole that hangs moves to a goal in 2 s."""
    robot = ls.MjcfRobot(scene_from_xml(CART_POLE, "cart-pole"))
    return ls.Problem(
        dynamics=robot.dynamics, dt=0.02, steps=100, initial=ls.FixedState(robot.at(pole=np.pi)),
        stage_cost=ls.ControlCost([1.0]), final_cost=ls.QuadraticCost([100, 100, 10, 10], about=robot.at(**goal)),
        control_limits=(-1, 1), constraints=list(kept),
    )  # fmt: skip


def swing_up(bound: float) -> ls.Problem:
    """The pole swings up, while the cart stays between bounds in m."""
    return cart_pole({}, ls.StateBounds(slider=(-bound, bound)))


def moves_on() -> ls.Problem:
    """The cart moves by 1 m, exactly, and its pole hangs."""
    kept = ls.StateBounds(pole=(2.8, 3.5)), ls.GoalState(slider=1.0)
    return cart_pole({"slider": 1.0, "pole": np.pi}, *kept)


def pendulum() -> ls.Problem:
    """A pendulum that its motor cannot lift at once ends upright, and at rest."""
    robot = ls.MjcfRobot(scene_from_xml(PENDULUM, "pendulum"))
    upright = robot.at(hinge=np.pi)
    kept = [ls.GoalState(hinge=np.pi, hinge_velocity=0.0), ls.StateBounds(hinge_velocity=(-7.0, 7.0))]
    return ls.Problem(
        dynamics=robot.dynamics, dt=0.02, steps=150, initial=ls.FixedState(robot.at()), control_limits=(-1.5, 1.5),
        stage_cost=ls.QuadraticCost([1.0, 0.1], about=upright) + ls.ControlCost([0.1]),
        final_cost=ls.QuadraticCost([1.0, 1.0], about=upright), constraints=kept,
    )  # fmt: skip


def two_links(*kept: ls.Constraint, margin: float | None = None) -> ls.Problem:
    """The arm of `docs/arms.md` passes its post."""
    robot = ls.MjcfRobot(
        scene_from_xml(TWO_LINKS.replace(HAND, HAND + '<site name="hand" pos="0.4 0 0"/>'), "two links")
    )
    start, goal = robot.at(shoulder=0.6, elbow=-1.2), robot.at(shoulder=-1.2, elbow=-0.3)
    if margin is not None:
        kept = (ls.Clearance(robot.scene.world, geoms=robot.geoms, margin=margin), robot.joint_limits)
    return replace(robot.problem(start, goal, steps=60, dt=0.02), constraints=list(kept))


def slow(robot: ls.MjcfRobot) -> ls.Problem:
    """An arm turns, within limits of its joints and of their speeds."""
    start, count = robot.at(), len(robot.joints)
    goal = start.copy()
    goal[:count] += np.random.default_rng(1).uniform(-0.7, 0.7, count)
    problem = robot.problem(start, goal, steps=50, dt=robot.dynamics.period_near(0.02) or robot.dynamics.period)
    speed = 2 * FAST * np.abs(goal - start).max() / (problem.dt * problem.steps)
    names = robot.dynamics.state_coordinates.names[count : 2 * count]
    kept = [ls.StateBounds(**dict.fromkeys(names, (-speed, speed)))]
    kept += [robot.joint_limits] if any(one.limits for one in robot.mjcf.joints) else []
    return replace(problem, constraints=[*problem.constraints, *kept])


PROBLEMS: dict[str, Callable[[], ls.Problem]] = {
    "cart-pole moves on": moves_on,
    "cart-pole swings up within 0.5 m": lambda: swing_up(0.5),
    "cart-pole swings up within 0.3 m": lambda: swing_up(0.3),
    "pendulum, upright at the end": pendulum,
    "arm of two hinges, 5 cm from its post": lambda: two_links(margin=0.05),
    "arm of two hinges, 10 cm from its post": lambda: two_links(margin=0.1),
    "the same arm, exactly at its goal": lambda: two_links(ls.GoalState(shoulder=-1.2, elbow=-0.3)),
    "the same arm, its hand at a place": lambda: two_links(ls.SiteConstraint("hand", position=HAND_AT)),
    "arm of six hinges, slow": lambda: slow(ls.MjcfRobot(scene_from_xml(ARM, "arm"))),
}


def report(result: Result) -> str:
    head = ("problem", *(f"{what}, {name}" for what in COLUMNS for name in METHODS))
    rows = []
    for name, one in result["problems"].items():
        each = [one[method] for method in METHODS]
        texts = [[form.format(found[what]) for found in each] for what, form in COLUMNS.items()]
        rows.append([name, *itertools.chain(*texts)])
    return table(head, rows)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
