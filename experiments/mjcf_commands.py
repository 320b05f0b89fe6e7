"""Robots of other packages by the command line alone: solve, simulate, render, stress and view, each with its MJCF.

    python experiments/mjcf_commands.py --models models       # `experiments/mjcf/family.py` says how to get the files
    python experiments/mjcf_commands.py --models models --only Panda point

Start and goal are those of `experiments/mjcf_robots.py --family`, without the shelf, whose pose is no setting of a
command. What a task adds to a file, such as a post, is in a file of its own in the folder of the output. Each row is
kept as soon as it is done: the same command goes on where it was stopped.
"""

import json
import subprocess
import sys
import time
import urllib.request
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mjcf.family import FAMILY, FamilyTask, ShelfTask
from runner import FolderSettings, Result, kept, opening, progress, run, table
from tqdm import tqdm

import lqrsim as ls

QUICKEST, TRIALS = "point", 20
POLICIES = "smooth", "track"
ANSWERS = 120.0  # s, in which a page is to be served


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    out: Path = Path("runs/mjcf_commands")
    """Folder for what the commands write."""
    models: Path | None = None
    """Folder with unpacked packages, for those that are not installed."""
    only: tuple[str, ...] = ()
    """Names of robots; by default all."""
    time_limit: float = 120.0
    """Seconds of each solve at most."""


def main(config: Config) -> Result:
    names = (QUICKEST,) if config.quick else config.only
    tasks = [one.found_in(config.models) for one in FAMILY if not isinstance(one, ShelfTask)]
    chosen = [one for one in tasks if not names or one.name in names]
    here = [one for one in chosen if one.path is not None]
    result = opening(config) | {"rows": [], "missing": [one.name for one in chosen if one not in here]}
    for task in progress(here, "robots"):
        settings = {"time_limit": config.time_limit, "task": repr(replace(task, folder=None))}
        row = kept(config.out / "rows", task.name, settings, lambda task=task: of_task(config, task))
        result["rows"].append(row)
        if not config.json:
            tqdm.write(line(row))
    return result


def reference(task: FamilyTask, folder: Path) -> str:
    """The robot's file with start, goal and weights, as commands take it."""
    robot = task.robot()
    problem, path, more = task.problem(robot), task.path, ""
    if task.post or task.excluded:
        path, more = folder / f"{task.name.replace(' ', '_')}.xml", f",obstacles={list(robot.scene.world.names)}"
        path.write_text(robot.scene.xml, encoding="utf-8")
    assert isinstance(problem.final_cost, ls.QuadraticCost)
    assert problem.start is not None
    assert problem.goal is not None
    names, rest = robot.dynamics.state_coordinates.names, robot.at()
    start, goal = (
        {name: float(value) for name, value, own in zip(names, state, rest, strict=True) if value != own}
        for state in (problem.start, problem.goal)
    )
    diagonal = np.diag(problem.final_cost.weight)
    weights = {name: float(weight) for name, weight in zip(names, diagonal, strict=True) if weight > 0}
    return f"{path},start={start},goal={goal},weights={weights},steps={task.steps},dt={task.dt}{more}"


def of_task(config: Config, task: FamilyTask) -> dict[str, Any]:
    """What each command returned: its exit code, and what says how it went."""
    folder = config.out / task.name.replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    robot = reference(task, folder)
    solution, rollout, still = folder / "solution.npz", folder / "rollout.npz", folder / "still.png"
    limit = ("--time-limit", f"{config.time_limit:g}")
    row: dict[str, Any] = {"name": task.name}
    solved = command("solve", robot, "--out", str(folder), "--json", *limit)
    row["solve"] = told(solved, lambda found: f"{found['solution']['status']}, {len(found['solution']['iterations'])}")
    if not solution.is_file():
        return row
    simulated = command("simulate", str(solution), "--scenario", robot, "--json")
    row["simulate"] = told(simulated, lambda found: found["run"]["trials"][0]["outcome"])
    size = ("--size", "480", "270", "--quality", "draft")
    rendered = command("render", str(rollout), "--out", str(still), *size)
    row["render"] = f"{still.stat().st_size // 1000} kB" if rendered.returncode == 0 else error_of(rendered)
    cell = ("--policies", *POLICIES, "--sweep", "light", "--strengths", "1", "--trials", str(TRIALS), "--workers", "1")
    campaign = ("--out", str(folder / "stress"), "--no-resume", "--solution", str(solution))
    stressed = command("stress", robot, *cell, *campaign, "--json")
    row["stress"] = told(stressed, _reached)
    row["view"] = viewed(robot, solution)
    return row


def _reached(found: dict[str, Any]) -> str:
    """How many trials of each policy reach the goal."""
    reached = {cell["policy"]: cell["outcomes"]["reached"] for cell in found["campaign"]["cells"]}
    return f"{', '.join(str(reached[policy]) for policy in POLICIES)} of {TRIALS}"


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `lqrsim`."""
    return subprocess.run(
        [sys.executable, "-m", "lqrsim.cli", *arguments], capture_output=True, text=True, check=False
    )  # fmt: skip


def told(ended: subprocess.CompletedProcess[str], what: Any) -> str:
    """What a command's JSON says; or its error."""
    try:
        return str(what(json.loads(ended.stdout)))
    except (json.JSONDecodeError, KeyError):
        return error_of(ended)


def error_of(ended: subprocess.CompletedProcess[str]) -> str:
    lines = ended.stderr.strip().splitlines()
    return f"exit {ended.returncode}: {lines[-1] if lines else ''}"


def viewed(robot: str, solution: Path) -> str:
    """Whether `view` serves a page on this machine, and ends by itself."""
    arguments = ("view", robot, "--solution", str(solution), "--viewer", "browser", "--seconds", "5")
    with subprocess.Popen(
        [sys.executable, "-m", "lqrsim.cli", *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:  # fmt: skip
        assert process.stdout is not None
        try:
            lines = []
            for line in process.stdout:
                lines.append(line)
                at = next((word for word in line.split() if word.startswith("http://")), None)
                if at is not None:
                    with urllib.request.urlopen(at.rstrip(".,"), timeout=ANSWERS) as page:
                        served = page.status
                    began = time.monotonic()
                    code = process.wait(ANSWERS)
                    return f"page {served}, exit {code} after {time.monotonic() - began:.0f} s"
            return f"exit {process.wait(ANSWERS)}: {lines[-1].strip() if lines else ''}"
        finally:
            if process.poll() is None:
                process.kill()


HEAD = "robot", "solve: status, iterations", "simulate", "render", f"stress: {', '.join(POLICIES)}", "view"


def cells(row: dict[str, Any]) -> list[Any]:
    """What the table has of a robot."""
    return [row["name"], *(row.get(part, "") for part in ("solve", "simulate", "render", "stress", "view"))]


def line(row: dict[str, Any]) -> str:
    """A row of the table on its own."""
    return table(HEAD, [cells(row)]).splitlines()[-1]


def report(result: Result) -> str:
    missing = f"\nNot installed, and left out: {', '.join(result['missing'])}." if result["missing"] else ""
    return table(HEAD, [cells(row) for row in result["rows"]]) + missing


if __name__ == "__main__":
    run(Config, main, report, __doc__)
