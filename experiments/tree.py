"""Traps, mazes and a gap: the share solved, and how well, over time, by trees, the default search and 20 starts.

    python experiments/tree.py                            # all, some hours on one processor
    python experiments/tree.py --mazes 3 --seconds 20     # fewer, and less time for each
    python experiments/tree.py --quick                    # one maze, 5 s

The problems are in least time: dynobench's bugtraps and a parking space, and mazes of walls drawn at random, each with
a door 1 m wide, for a unicycle with accelerations and a planar quadrotor. Trees are grown from one seed after another;
each way that they find is the start of a solve, and the best plan so far is the answer. The other searches have the
time as their limit: they grow trees, too, where their paths lead nowhere, and end with the first plan of those. Times
are those of the processor, without compiling. Where a search is not at its end when the time is over, its plan of that
time counts.
"""

import itertools
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from kinodynamic.data import CASES, MODELS, Case
from kinodynamic.statements import in_least_time
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from paper.common import figure
from runner import FolderSettings, Kept, Result, at_most, opening, progress, run, table

import lqrsim as ls
from lqrsim.solvers.tree import grow, in_steps_of

NAMED = ("unicycle1_v0/bugtrap_0", "unicycle2_v0/bugtrap_0", "car1_v0/bugtrap_0", "quad2d_v0/quad_bugtrap",
         "car1_v0/parallelpark_0")  # fmt: skip
IN_MAZES = ("unicycle2_v0", "quad2d_v0")
SIDE, WALLS, THICK, DOOR = 6.0, (1.5, 3.0, 4.5), 0.2, 1.0  # m
MARKS = (5.0, 15.0, 60.0)  # s, at which the table says what is solved
EACH = 300  # iterations from a way: most that converge take fewer than 100


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    mazes: int = 20
    """Mazes for each robot."""
    seconds: float = 60.0
    """Processor time for a problem and a search."""
    out: Path = Path("runs/tree")
    """Folder for the figure, in a folder of that name."""
    keep: Path | None = None
    """File with what is done; a run with the same settings goes on from there."""


class OverError(Exception):
    """The time is over."""


def maze(robot: str, seed: int) -> Case:
    """Three walls from side to side, each with a door at a random place and a stub beside it; from end to end."""
    draws = np.random.default_rng(seed)
    boxes, sign = [], 1.0
    for x in WALLS:
        door, sign = draws.uniform(DOOR, SIDE - DOOR), -sign
        for low, high in ((0.0, door - DOOR / 2), (door + DOOR / 2, SIDE)):
            boxes.append((x, (low + high) / 2, THICK, high - low))
        boxes.append(
            (x + sign * 0.3, door + DOOR / 2 + THICK / 2 if sign > 0 else door - DOOR / 2 - THICK / 2, 0.6, THICK)
        )
    start, goal = np.zeros((2, len(MODELS[robot].states)))
    start[:2], goal[:2] = (0.6, draws.uniform(1, SIDE - 1)), (SIDE - 0.6, draws.uniform(1, SIDE - 1))
    low, high = np.zeros(2), np.full(2, SIDE)
    return Case(name=f"{robot}/maze_{seed}", start=start, goal=goal, low=low, high=high, boxes=np.array(boxes),
                published=None)  # fmt: skip


def within(seconds: float, solve: Callable[..., ls.Solution], problem: ls.Problem, **options: Any) -> ls.Solution:
    """The solution after so much processor time at most."""
    begun = time.process_time()

    def watch(iteration: object) -> None:
        if time.process_time() - begun > seconds:
            raise OverError

    try:
        return solve(problem, callback=watch, **options)
    except OverError as over:
        solution: ls.Solution = over.solution  # type: ignore[attr-defined]
        return solution


Progress = list[tuple[float, float]]  # processor seconds at which a plan was known, and its duration in s


def by_default(problem: ls.Problem, seconds: float, **options: Any) -> tuple[Progress, ls.Trajectory | None]:
    begun = time.process_time()
    solution = within(seconds, ls.smooth, problem, time_limit=seconds, **options)
    if not keeps_all(problem, solution):
        return [], None
    return [(time.process_time() - begun, solution.trajectory.horizon)], solution.trajectory


def by_trees(problem: ls.Problem, seconds: float) -> tuple[Progress, ls.Trajectory | None]:
    begun, found, best = time.process_time(), Progress(), None
    for seed in itertools.count():
        left = seconds - (time.process_time() - begun)
        if left <= 0:
            return found, best
        way = grow(problem, seed=seed)
        left = seconds - (time.process_time() - begun)
        if way is None or left <= 0:
            continue
        start = in_steps_of(problem, way)
        solution = within(left, ls.smooth, replace(problem, dt=start.dt), start=start, max_iterations=EACH)
        if keeps_all(problem, solution) and (best is None or solution.trajectory.horizon < best.horizon):
            best = solution.trajectory
            found.append((time.process_time() - begun, best.horizon))
    raise AssertionError


def keeps_all(problem: ls.Problem, solution: ls.Solution) -> bool:
    """Whether a plan keeps the constraints, even one that is no optimum."""
    return bool(np.isfinite(solution.trajectory.states).all()) and solution.violation <= 1e-6


SEARCHES: dict[str, Callable[[ls.Problem, float], tuple[Progress, ls.Trajectory | None]]] = {
    "default": by_default,
    "20 starts": lambda problem, seconds: by_default(problem, seconds, starts=20),
    "trees": by_trees,
}


def main(config: Config) -> Result:
    config = at_most(config, mazes=1, seconds=5.0)
    named = [] if config.quick else [CASES[name] for name in NAMED]
    robots = IN_MAZES[:1] if config.quick else IN_MAZES
    cases = [*named, *(maze(robot, seed) for robot in robots for seed in range(config.mazes))]
    kept = Kept(config.keep, {"seconds": config.seconds})
    rows = []
    for case, name in progress(list(itertools.product(cases, SEARCHES)), "solving", unit="solve", delay=0):
        row = kept.row(f"{case.name} {name}", lambda case=case, name=name: measured(case, name, config.seconds))
        rows.append({"case": case.name, "search": name} | row)
    result = opening(config) | {"rows": rows}
    drawn = [case for case in cases if case.name in {"quad2d_v0/quad_bugtrap", *(f"{one}/maze_0" for one in robots)}]
    with figure(config, result, "tree", (4.5 * len(drawn), 5.4)) as canvas:
        for axes, case in zip(canvas.subplots(1, len(drawn), squeeze=False)[0], drawn, strict=True):
            draw(axes, case, [row for row in rows if row["case"] == case.name])
        canvas.set_layout_engine("tight")
    return result


def measured(case: Case, search: str, seconds: float) -> Result:
    """What a search finds, over time."""
    problem = in_least_time(case)
    ls.smooth(problem, max_iterations=2, safeguard=False)  # compiles
    found, best = SEARCHES[search](problem, seconds)
    path = None if best is None else best.states[:, :2].tolist()
    return {"progress": found, "path": path}


def report(result: Result) -> str:
    groups: dict[str, list[Result]] = {}
    for row in result["rows"]:
        robot, name = row["case"].split("/")
        groups.setdefault(f"{robot}, mazes" if name.startswith("maze") else row["case"], []).append(row)
    marks = [mark for mark in MARKS if mark < result["config"]["seconds"]] + [result["config"]["seconds"]]
    lines = []
    for group, rows in groups.items():
        least = {row["case"]: min(cost(one, math.inf) for one in rows if one["case"] == row["case"]) for row in rows}
        for search in SEARCHES:
            own = [row for row in rows if row["search"] == search]
            cells = []
            for mark in marks:
                ratios = [cost(row, mark) / least[row["case"]] for row in own if math.isfinite(cost(row, mark))]
                cells += [f"{len(ratios)} of {len(own)}", f"{statistics.median(ratios):.3f}" if ratios else ""]
            lines.append([f"{group}: {search}", *cells])
    heads = [head for mark in marks for head in (f"solved in {mark:g} s", "time, of the least known")]
    return table(["", *heads], lines)


def cost(row: Result, mark: float) -> float:
    """The duration of the best plan that was known by then; infinite without one."""
    return min((duration for seconds, duration in row["progress"] if seconds <= mark), default=math.inf)


def draw(axes: Axes, case: Case, rows: Sequence[Result]) -> None:
    """The best path of each search among the walls."""
    for x, y, width, height in case.boxes:
        axes.add_patch(Rectangle((x - width / 2, y - height / 2), width, height, color="0.7"))
    for number, row in enumerate(rows):
        if row["path"] is not None:
            label = f"{row['search']}, {cost(row, math.inf):.2f} s"
            axes.plot(*np.array(row["path"]).T, f"C{number}", label=label, linewidth=2.5 - 0.6 * number)
    axes.plot(*case.start[:2], "ko")
    axes.plot(*case.goal[:2], "k*", markersize=10)
    axes.set(xlim=(0, SIDE), ylim=(0, SIDE), aspect="equal", title=case.name, xlabel="x (m)", ylabel="y (m)")
    if any(row["path"] is not None for row in rows):
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, -0.14))


if __name__ == "__main__":
    run(Config, main, report, __doc__)
