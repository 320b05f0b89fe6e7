"""Robots of MJCFs that others wrote: solved from rest without a guess, compared with iLQR, and run in the same MJCF.

    pip install 'lqrsim[models]'                    # dm_control, gymnasium and crazyflow bring the files
    python experiments/mjcf_robots.py               # all eleven, with pictures
    python experiments/mjcf_robots.py --only acrobot swimmer
    python experiments/mjcf_robots.py --quick       # a few iterations of each
    python experiments/mjcf_robots.py --family --models models    # arms, hands, legs and vehicles, as they come
    python experiments/mjcf_robots.py --rounding --iterations 60  # what a change of the start by 1e-12 does

`experiments/mjcf/tasks.py` says what each is to do, `experiments/mjcf/family.py` what the family is, and how to get its
files. What is not installed is left out, and named. Each row is kept as soon as it is done: the same command goes on
where it was stopped, and a row is measured again when its file in the folder of the output is deleted.
"""

import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mjcf.common import least_distance, pose_error, sheet, without_friction
from mjcf.family import FAMILY, FamilyTask, ShelfTask
from mjcf.tasks import TASKS, Task
from paper.common import render_still
from runner import FIGURES, FolderSettings, Result, kept, opening, progress, run, table
from tqdm import tqdm

import lqrsim as ls
from lqrsim.errors import Array

OUT = Path("runs/mjcf_robots")
WORSE, BETTER = 1.01, 0.99  # of iLQR's cost: from where a cost is worse, and below what it is better
ROUNDING = 1e-12  # standard deviation of a change of controls
EXACT = 1e-14  # tolerance of MuJoCo's constraint solver in plans
CLOSE = 0.01  # rad or m; a robot is at its goal if no joint is farther from it


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    out: Path = OUT
    """Folder for the pictures, in a folder of that name."""
    only: tuple[str, ...] = ()
    """Names of robots; or, of those that are no name, words of them. By default all."""
    iterations: int = 300
    """At most, of each solver."""
    time_limit: float = 120.0
    """Seconds of each solve at most, without compiling."""
    family: bool = False
    """The family of arms, hands, legs and vehicles, and not the eleven."""
    models: Path | None = None
    """Folder with unpacked packages, for those that are not installed."""
    pictures: bool = True
    """Draw each run."""
    frictionless: bool = False
    """Begin with a plan without dry friction, which hides from a plan at rest that controls have an effect."""
    rounding: bool = False
    """Only the costs from three starts that differ by rounding: the default controls, changed by 1e-12."""


def main(config: Config) -> Result:
    most = min(config.iterations, 2) if config.quick else config.iterations
    tasks = [task.found_in(config.models) for task in FAMILY] if config.family else TASKS
    names = {task.name for task in tasks}
    words = [word for word in config.only if word not in names]
    wanted = [
        one for one in tasks if not config.only or one.name in config.only or any(word in one.name for word in words)
    ]
    here = [task for task in wanted if task.path is not None]
    result = opening(config) | {"rows": [], "missing": [task.name for task in wanted if task not in here]}
    for task in progress(here, "robots"):
        if config.rounding:
            result["rows"].append({"name": task.name, "costs": costs_by_rounding(task, most)})
            continue
        limits = {"iterations": most, "time_limit": config.time_limit}
        row = row_of(config, task, limits | ({"frictionless": True} if config.frictionless else {}))
        result["rows"].append(row)
        result["figures"] += row["figures"]
        if not config.json:
            tqdm.write(line(row))
    if result["figures"]:
        pictures = [config.out / FIGURES / name for name in result["figures"]]
        result["figures"].append("mjcf_family.png" if config.family else "mjcf_robots.png")
        sheet(pictures, config.out / FIGURES / result["figures"][-1])
    return result


def row_of(config: Config, task: Task | FamilyTask, limits: dict[str, Any]) -> dict[str, Any]:
    """The row that was kept, if it is of the same settings; or a new one, which is kept."""
    if config.quick:
        return of_task(config, task, limits)
    settings = limits | {"task": repr(replace(task, folder=None) if isinstance(task, FamilyTask) else task)}
    return kept(config.out / "rows", task.name, settings, lambda: of_task(config, task, limits))


def of_task(config: Config, task: Task | FamilyTask, limits: dict[str, Any]) -> dict[str, Any]:
    """Solve by both methods from the same start, and run the plan."""
    row = {"name": task.name, "file": f"{task.package}/{task.file}", "figures": []}
    try:
        robot = task.robot()
        problem, plant = task.problem(robot), ls.Plant(robot, robot.scene)
    except ls.InputError as error:
        return row | {"refused": str(error)}
    assert problem.start is not None
    # iLQR begins at rest, where what holds the robot between start and goal would let it fall.
    held = np.tile(robot.hold(problem.start), (problem.steps, 1)) if isinstance(task, FamilyTask) else None
    ways = task.moves.values() if isinstance(task, FamilyTask) else ()
    most, seconds = limits["iterations"], limits["time_limit"]
    begin = ls.smooth(without_friction(problem), max_iterations=most) if config.frictionless else None
    solution = ls.smooth(problem, max_iterations=most, time_limit=seconds, start=begin)
    other = None  # iLQR keeps no constraints
    if not problem.constraints:
        other = ls.ilqr(problem, max_iterations=most, time_limit=seconds, start=held)
    row |= {
        "states": len(robot.dynamics.state_coordinates), "controls": len(robot.dynamics.control_coordinates),
        "status": solution.status.name, "success": solution.success, "cost": solution.cost,
        "ilqr_cost": None if other is None else other.cost, "iterations": len(solution.iterations),
        "ms": float(np.median([1000 * one.seconds for one in solution.iterations])),
    }  # fmt: skip
    if not np.isfinite(solution.trajectory.states).all():
        return row
    rollout = ls.simulate(plant, solution)
    outcome = ls.stress.outcomes(rollout)
    row |= {
        "off": float(outcome.worst[0]), "replayed": replayed(robot, solution),
        "exact": replayed(robot, solution, EXACT), "unit": rollout.tracking_unit,
        "clearance": None if solution.clearance is None else float(solution.clearance[1:].min()),
        "bindings": None if solution.clearance is None else least_distance(robot, solution.trajectory.states[1:]),
        "close": min([CLOSE, *(0.1 * abs(way) for way in ways)]),
        "missed": missed(task, robot, problem, solution.trajectory.states[-1]),
    }  # fmt: skip
    if config.pictures:
        (config.out / FIGURES).mkdir(parents=True, exist_ok=True)
        name = task.name.replace(" ", "_")
        camera = "overview" if isinstance(task, FamilyTask) else camera_of(robot)
        render_still(
            config, row, name, rollout, every=rollout.times[-1] / 8, camera=camera, overlays=("trace", "caption"),
            titles=(task.name,),
        )  # fmt: skip
    return row


def costs_by_rounding(task: Task | FamilyTask, most: int) -> list[float]:
    """The costs of plans from the default controls, changed by `ROUNDING`; with a start, nothing is softened."""
    problem, costs = task.problem(task.robot()), []
    for seed in (1, 2, 3):
        controls = np.tile(problem.nominal_control, (problem.steps, 1))
        controls += ROUNDING * np.random.default_rng(seed).standard_normal(controls.shape)
        costs.append(ls.smooth(problem, start=controls, max_iterations=most).cost)
    return costs


def missed(task: Task | FamilyTask, robot: ls.MjcfRobot, problem: ls.Problem, last: Array) -> dict[str, float]:
    """How far each joint that is wanted somewhere ends from there; of a tool its place (m) and turn (rad)."""
    if isinstance(task, ShelfTask):
        return dict(zip(("tool", "tool's turn"), pose_error(robot, last, "tool", (task.place, task.turn)), strict=True))
    assert problem.goal is not None
    return {
        name: float(last[i] - problem.goal[i])
        for i, name in enumerate(robot.dynamics.state_coordinates.names)
        if (task.ends.get(name, 0) >= 10 if task.ends else i < robot.scene.model.nv)
    }


def replayed(robot: ls.MjcfRobot, solution: ls.Solution, tolerance: float | None = None) -> float:
    """How far a run of the policy by plain `mj_step`, in the whole MJCF, comes from the plan's positions at most.

    Args:
      tolerance: of MuJoCo's constraint solver, in place of the MJCF's, within which friction and contacts are wrong.
    """
    model, plan = copy.copy(robot.scene.model), solution.trajectory
    model.opt.tolerance = model.opt.tolerance if tolerance is None else tolerance
    data, nv = mujoco.MjData(model), robot.scene.model.nv
    data.qpos[:], data.qvel[:] = robot.configuration(plan.states[0])
    data.act[:] = plan.states[0, 2 * nv :]
    worst, substeps = 0.0, robot_steps(robot, plan.dt)
    for step, nominal in enumerate(plan.states[:-1]):
        state = np.concatenate([robot.state(data.qpos, data.qvel, near=nominal), data.act])
        data.ctrl[:] = solution.policy(state, step * plan.dt)
        mujoco.mj_step(model, data, substeps)
        there = robot.state(data.qpos, data.qvel, near=plan.states[step + 1])
        worst = max(worst, float(np.abs(there[:nv] - plan.states[step + 1, :nv]).max()))
    return worst


def robot_steps(robot: ls.MjcfRobot, dt: float) -> int:
    """Physics steps of a control period."""
    return round(dt / float(robot.scene.model.opt.timestep))


def camera_of(robot: ls.MjcfRobot) -> str:
    """One of the scene's cameras."""
    model = robot.scene.model
    names = [model.camera(number).name for number in range(model.ncam)]
    return next((name for name in ("overview", "fixed", *names) if name in names), "overview")


HEAD = (
    "robot", "states", "controls", "status", "cost", "iLQR's cost", "iterations", "ms an iteration",
    "tracking error in MuJoCo", "by plain mj_step", "with a solver to 1e-14",
    "clearance (m)", "less the bindings'", "farthest from the goal",
)  # fmt: skip


def cells(row: dict[str, Any]) -> list[Any]:
    """What the table has of a robot."""
    if "refused" in row:
        return [row["name"], "", "", f"refused: {row['refused']}", *[""] * (len(HEAD) - 4)]
    known = [
        *(row[name] for name in ("name", "states", "controls", "status")),
        f"{row['cost']:.4g}",
        "" if row["ilqr_cost"] is None else f"{row['ilqr_cost']:.4g}",
        row["iterations"],
        f"{row['ms']:.1f}",
    ]
    if "off" not in row:
        return [*known, *[""] * (len(HEAD) - len(known))]
    name, missed = farthest(row)
    apart = ["", ""]
    if row["clearance"] is not None:
        apart = [f"{row['clearance']:.4f}", f"{row['clearance'] - row['bindings']:+.0e}"]
    return [
        *known,
        f"{row['off']:.1e} {row['unit']}",
        f"{row['replayed']:.1e}",
        f"{row['exact']:.1e}",
        *apart,
        f"{name} {missed:+.2g}",
    ]


def farthest(row: dict[str, Any]) -> tuple[str, float]:
    """The joint that is farthest from the goal, and how far."""
    return max(row["missed"].items(), key=lambda pair: abs(pair[1]), default=("", 0.0))


def line(row: dict[str, Any]) -> str:
    """A row of the table on its own."""
    return table(HEAD, [cells(row)]).splitlines()[-1]


def report(result: Result) -> str:
    if any("costs" in row for row in result["rows"]):
        rows = [[row["name"], *(f"{cost:.4g}" for cost in row["costs"])] for row in result["rows"]]
        return table(("robot", "cost", "of the second", "of the third"), rows)
    lines = [table(HEAD, [cells(row) for row in result["rows"]]), ""]
    solved = [row for row in result["rows"] if "cost" in row]
    there = sum(row["success"] and "off" in row and abs(farthest(row)[1]) <= row["close"] for row in solved)
    near = f"{CLOSE} rad or m, and a tenth of the way,"
    lines.append(f"Solved, and within {near} of their goals: {there} of {len(result['rows'])}.")
    ratios = [row["cost"] / row["ilqr_cost"] for row in solved if row["ilqr_cost"] is not None]
    lines.append(
        f"Cost not more than 1 % above iLQR's from the same start: {sum(one <= WORSE for one in ratios)} of"
        f" {len(ratios)}; at least 1 % below: {sum(one < BETTER for one in ratios)}."
    )
    if result["missing"]:
        lines.append(f"Not installed, and left out: {', '.join(result['missing'])}.")
    return "\n".join(lines)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
