"""Robots of other packages by the command line alone: solve, simulate, render, stress and view, each with its MJCF.

    python experiments/mjcf_commands.py --models models       # `experiments/mjcf/family.py` says how to get the files
    python experiments/mjcf_commands.py --models models --only Panda point

Start and goal are those of `experiments/mjcf_robots.py --family`, for robots whose files need nothing added.
"""

import json
import subprocess
import sys
import time
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjcf.family import FAMILY, FamilyTask, ShelfTask
from runner import FolderSettings, Result, opening, progress, run, table

QUICKEST, TRIALS = "point", 20
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
    plain = [one for one in FAMILY if not (isinstance(one, ShelfTask) or one.post or one.excluded or one.ends)]
    names = (QUICKEST,) if config.quick else config.only
    chosen = [one.found_in(config.models) for one in plain if not names or one.name in names]
    here = [one for one in chosen if one.path is not None]
    result = opening(config) | {"rows": [], "missing": [one.name for one in chosen if one not in here]}
    for task in progress(here, "robots"):
        result["rows"].append(of_task(config, task))
    return result


def reference(task: FamilyTask) -> str:
    """The robot's file with start, goal and weights, as commands take it."""
    robot = task.robot()
    names, nv = robot.dynamics.state_coordinates.names, robot.scene.model.nv
    rest = robot.at()[:nv].tolist()
    start = dict(zip(names, [*task.start, *rest[len(task.start) :]], strict=False))
    goal = start | {names[joint]: start[names[joint]] + move for joint, move in task.moves.items()}
    units = robot.dynamics.state_coordinates.units
    weights = {unit: task.weights[i >= nv] for i, unit in enumerate(units)}
    return f"{task.path},start={start},goal={goal},weights={weights},steps={task.steps},dt={task.dt}"


def of_task(config: Config, task: FamilyTask) -> dict[str, Any]:
    """What each command returned: its exit code, and what says how it went."""
    folder, robot = config.out / task.name.replace(" ", "_"), reference(task)
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
    cell = ("--policies", "smooth", "--sweep", "light", "--strengths", "1", "--trials", str(TRIALS), "--workers", "1")
    campaign = ("--out", str(folder / "stress"), "--no-resume", "--solution", str(solution))
    stressed = command("stress", robot, *cell, *campaign, "--json")
    row["stress"] = told(stressed, lambda found: f"{found['campaign']['cells'][0]['outcomes']['reached']} of {TRIALS}")
    row["view"] = viewed(robot, solution)
    return row


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


def report(result: Result) -> str:
    parts = ("solve", "simulate", "render", "stress", "view")
    rows = [[one["name"], *(one.get(part, "") for part in parts)] for one in result["rows"]]
    missing = f"\nNot installed, and left out: {', '.join(result['missing'])}." if result["missing"] else ""
    return table(("robot", *parts), rows) + missing


if __name__ == "__main__":
    run(Config, main, report, __doc__)
