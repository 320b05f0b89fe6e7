"""The drive and the quadrotor as fast as their motors allow: problems with a free final time.

    python experiments/least_time.py            # both, 10 s, and a figure in runs/least_time/figures
    python experiments/least_time.py --quick    # the drive alone

The controls cost next to nothing, and time does: motors stand at their limits most of the way. The paths keep clear of
all obstacles by a margin and end at the goal exactly. They take nine tenths of what the motors can do. The rest is for
a tracking law, which then runs in MuJoCo, with a physics step of which the period of the plan is a multiple.
"""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from paper.common import figure
from runner import FolderSettings, Result, opening, progress, run, table

import lqrsim as ls
from lqrsim.problem.obstacles import ObstacleCost
from lqrsim.problem.parts import CostSum


@dataclass(frozen=True, kw_only=True)
class Case:
    """What is asked of a robot.

    Attributes:
      scenario: its name. effort: weight of the controls, next to nothing.
      share: of what the motors can do, what the plan may take. longest: the longest duration in s.
      margin: to obstacles, in m. tolerate: how far the tracking law lets states be off, in their units.
      axes: the states that are drawn, and what the axes are called.
    """

    scenario: str
    effort: float
    share: float
    longest: float
    margin: float
    tolerate: dict[str, float]
    axes: tuple[tuple[int, str], tuple[int, str]]


CASES = (
    Case(
        scenario="differential_drive",
        effort=1e-3,
        share=0.9,
        longest=60.0,
        margin=0.1,
        tolerate={"m": 0.02, "rad": 0.05},
        axes=((0, "x (m)"), (1, "y (m)")),
    ),
    Case(
        scenario="quadrotor",
        effort=1e-3,
        share=0.9,
        longest=20.0,
        margin=0.05,
        tolerate={"m": 0.02, "m/s": 0.1, "rad": 0.1, "rad/s": 0.5},
        axes=((0, "x (m)"), (2, "z (m)")),
    ),
)


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    out: Path = Path("runs/least_time")
    """Folder for the figure, in a folder of that name."""


def problem_of(case: Case) -> tuple[ls.Scenario, ls.Problem]:
    """The scenario, and its problem with a weight on time in place of its costs."""
    scenario = getattr(ls.scenarios, case.scenario)()
    stated = scenario.problem
    (obstacles,) = stated.obstacle_costs
    effort = ls.ControlCost(np.full(len(stated.control_coordinates), case.effort), about=stated.nominal_control)
    # Obstacles cost a little, so that the search has something to go round.
    stage = CostSum((effort, ObstacleCost(obstacles.world, radius=obstacles.radius, sharpness=obstacles.sharpness,
                                          weight=1e-3 * obstacles.weight)))  # fmt: skip
    actuators = stated.dynamics.control_coordinates
    freed = dataclasses.replace(
        stated, stage_cost=stage,
        control_limits=(case.share * np.asarray(actuators.low), case.share * np.asarray(actuators.high)),
        constraints=[
            ls.GoalState(stated.goal), ls.Clearance(obstacles.world, radius=obstacles.radius, margin=case.margin),
        ],
        duration=(0.1, case.longest), time_weight=1.0,
    )  # fmt: skip
    return scenario, freed


def main(config: Config) -> Result:
    result = opening(config)
    chosen = CASES[:1] if config.quick else CASES
    rows, plans = [], []
    for case in progress(chosen, "solving", unit="robot", delay=0):
        scenario, problem = problem_of(case)
        clock = time.perf_counter()
        solution = ls.smooth(problem)
        seconds = time.perf_counter() - clock
        horizon = solution.trajectory.horizon
        plant = scenario.plant().for_period(solution.trajectory.dt)
        # A plan at its limits has no gains there: what is left for feedback a tracking law takes.
        ordinary = dataclasses.replace(problem.with_duration_of(solution), control_limits=None)
        law = ls.track(ordinary, solution, tolerate=case.tolerate)
        rollout = ls.simulate(plant, dataclasses.replace(solution, policy=law), seed=0)
        space, controls = problem.control_coordinates, solution.trajectory.controls
        limits = np.asarray(space.low), np.asarray(space.high)
        at_limits = np.mean(np.isclose(controls, limits[0]) | np.isclose(controls, limits[1]))
        assert solution.clearance is not None
        rows.append(
            [
                case.scenario, solution.status.name, f"{problem.steps * problem.dt:.3f}", f"{horizon:.4f}",
                str(len(solution.iterations)), f"{seconds:.2f}", f"{100 * at_limits:.0f}",
                f"{solution.clearance.min():.4f}", rollout.outcome[0],
            ]
        )  # fmt: skip
        plans.append((case, scenario, problem, solution))
    with figure(config, result, "least_time", (9, 3.4 * len(plans))) as drawn:
        grid = drawn.subplots(len(plans), 2, squeeze=False)
        for (path, motors), plan in zip(grid, plans, strict=True):
            draw_path(path, *plan)
            draw_controls(motors, *plan)
        drawn.set_layout_engine("tight")
    return result | {"rows": rows}


def report(result: Result) -> str:
    head = (
        "robot", "status", "stated duration (s)", "least time (s)", "iterations", "seconds",
        "controls at limits (%)", "clearance (m)", "in MuJoCo",
    )  # fmt: skip
    return table(head, result["rows"])


def draw_path(axes: Axes, case: Case, scenario: ls.Scenario, problem: ls.Problem, solution: ls.Solution) -> None:
    """The plan's path, seen from the side or from above, beside that of the scenario's own problem."""
    (i, across), (j, up) = case.axes
    usual = ls.smooth(scenario.problem).trajectory
    states = solution.trajectory.states
    axes.plot(usual.states[:, i], usual.states[:, j], color="0.7", label=f"as stated, {usual.horizon:.3g} s")
    axes.plot(states[:, i], states[:, j], color="C0", label=f"least time, {solution.trajectory.horizon:.3g} s")
    goal = states[-1]
    axes.plot(goal[i], goal[j], "k*")
    axes.set(xlabel=across, ylabel=up, aspect="equal", title=case.scenario.replace("_", " "))
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1.0))


def draw_controls(axes: Axes, case: Case, scenario: ls.Scenario, problem: ls.Problem, solution: ls.Solution) -> None:
    """The controls, and their limits."""
    space, plan = problem.control_coordinates, solution.trajectory
    for k, name in enumerate(space.names):
        axes.step(plan.times[:-1], plan.controls[:, k], where="post", label=name)
    for side in (*space.low, *space.high):
        axes.axhline(side, color="0.8", linewidth=0.8, zorder=0)
    axes.set(xlabel="time (s)", ylabel=f"controls ({space.units[0]})")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1.0))


if __name__ == "__main__":
    run(Config, main, report, __doc__)
