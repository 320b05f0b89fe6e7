"""The packaged robots by their own MJCFs: MuJoCo's steps in place of formulas, and the same optima.

    python experiments/mjcf_packaged.py             # both; the drive takes some minutes
    python experiments/mjcf_packaged.py --quick     # the drive for two iterations

The quadrotor's formulas are those of its MJCF, so its problem has the same optimum. The drive's are not: they have no
wheels that slip and no casters. It is solved from exactly the scenario's start: by the default search; with a straight
path to the goal that keeps it level on the floor in the first iterations; and from the controls of the formulas' plan.
"""

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mjcf.packaged import FRAME, ORDER, drive, quadrotor
from paper.homotopy import way
from runner import FolderSettings, Result, opening, run, table

import lqrsim as ls

# How much each state is drawn to a path on the floor.
DRAWN = {f"create_base_{name}": weight for name, weight in {
    "x": 10.0, "y": 10.0, "z": 1e4, "rx": 1e3, "ry": 1e3, "vz": 1e2, "wx": 10.0, "wy": 10.0,
}.items()}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    only: tuple[str, ...] = ()
    """Of quadrotor and drive; by default both."""
    iterations: int = 60
    """At most, of the drive's solves."""


def main(config: Config) -> Result:
    result, most = opening(config), 2 if config.quick else config.iterations
    if not config.only or "quadrotor" in config.only:
        result["quadrotor"] = of_quadrotor()
    if not config.only or "drive" in config.only:
        result["drive"] = of_drive(most)
    return result


def of_quadrotor() -> dict[str, Any]:
    """Both optima of the scenario's problem, from where the search of each begins."""
    scenario, robot = ls.scenarios.quadrotor(), ls.MjcfRobot("cage")
    # Both by the paper's method: the formulas have second derivatives for Newton's, and MuJoCo's steps do not.
    problems = scenario.problem, quadrotor(scenario, robot.dynamics)
    formulas, steps = (ls.smooth(problem, finish=None) for problem in problems)
    apart = steps.trajectory.states - formulas.trajectory.states[:, list(ORDER)]
    return {
        "formulas": _of(formulas), "MJCF": _of(steps), "relative": abs(steps.cost / formulas.cost - 1),
        "apart": float(np.abs(apart).max()),
    }  # fmt: skip


def of_drive(most: int) -> dict[str, Any]:
    """The formulas' optimum from exactly the start, and what the MJCF's steps lead to, from two beginnings."""
    scenario = ls.scenarios.differential_drive()
    robot = ls.MjcfRobot("arena", position=FRAME[:2], radius=scenario.robot.radius)
    assert isinstance(scenario.problem.initial, ls.QuadraticCost)
    exact = replace(scenario.problem, initial=ls.FixedState(np.asarray(scenario.problem.initial.about)))
    formulas, problem = ls.smooth(exact), drive(scenario, robot)
    names = robot.dynamics.state_coordinates.names
    place = [names.index(name) for name in FRAME[:2]]
    pillars = np.array([one.position[:2] for one in scenario.scene.world.obstacles if one.kind == "cylinder"])
    start, goal = problem.start, problem.goal
    assert start is not None
    assert goal is not None
    other = formulas.trajectory.states[:, :2]
    found: dict[str, Any] = {"formulas": _of(formulas)}
    begun = {
        "the default search": None,
        "a path on the floor": on_a_path(problem),
        "the formulas' controls": formulas.trajectory.controls,
    }
    for name, beginning in begun.items():
        solution = ls.smooth(problem, start=beginning, max_iterations=most)
        path = solution.trajectory.states[:, place]
        ways = [
            way(np.vstack([start[place], one, goal[place]]), pillars) for one in (path, other)
        ]  # ways keep their ends
        runs = ls.simulate(ls.Plant(robot, robot.scene), solution)
        found[name] = _of(solution) | {
            "apart": float(np.linalg.norm(path - other, axis=1).max()), "same way": ways[0] == ways[1],
            "off": float(ls.stress.outcomes(runs).worst[0]), "outcome": runs.outcome[0],
        }  # fmt: skip
    return found


def on_a_path(problem: ls.Problem) -> ls.InitialPrior:
    """What draws the first iterations: straight to the goal, blind to obstacles at first, and level on the floor.

    The method linearises about states of least total cost, which no motion has to lead through. Above the floor, wheels
    drive nothing.
    """
    start, goal = problem.start, problem.goal
    assert start is not None
    assert goal is not None
    weight = np.array([DRAWN.get(name, 0.0) for name in problem.dynamics.state_coordinates.names])
    return ls.InitialPrior(
        weight, about=np.linspace(start, goal, problem.steps + 1), iterations=4, obstacles=(0.0, 0.1, 0.4, 0.7)
    )


def _of(solution: ls.Solution) -> dict[str, Any]:
    return {"status": solution.status.name, "cost": solution.cost, "iterations": len(solution.iterations)}


def report(result: Result) -> str:
    parts = []
    if found := result.get("quadrotor"):
        rows = [[name, *_cells(found[name])] for name in ("formulas", "MJCF")]
        parts.append(table(("quadrotor by its", "status", "cost", "iterations"), rows))
        parts.append(f"\nCosts differ by {found['relative']:.0e} of them, states by {found['apart']:.0e} at most.\n")
    if found := result.get("drive"):
        rows = [["formulas", *_cells(found["formulas"]), "", "", ""]]
        rows += [
            [
                f"MJCF, from {name}", *_cells(one), "yes" if one["same way"] else "no", f"{one['apart']:.3f} m",
                f"{one['off']:.1e} m",
            ]
            for name, one in itertools.islice(found.items(), 1, None)
        ]  # fmt: skip
        head = ("drive by its", "status", "cost", "iterations", "same way round", "apart at most", "off plan in MuJoCo")
        parts.append(table(head, rows))
    return "\n".join(parts)


def _cells(one: dict[str, Any]) -> list[Any]:
    return [one["status"], f"{one['cost']:.6g}", one["iterations"]]


if __name__ == "__main__":
    run(Config, main, report, __doc__)
