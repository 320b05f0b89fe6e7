"""How long fresh processes take."""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from runner import progress

from solver_benchmark.common import Config, judge, median, take_turns

_FIRST = "import lqrsim as ls; assert ls.smooth(ls.scenarios.quadrotor().problem).success"


def measure(config: Config) -> dict[str, Any]:
    """Wall-clock seconds of fresh processes."""
    program = shutil.which("lqrsim", path=str(Path(sys.executable).parent))
    show_help = [program, "--help"] if program else [sys.executable, "-m", "lqrsim.cli", "--help"]
    solve = [sys.executable, "-c", _FIRST]
    for command in (show_help, solve):
        _wall(command)  # warm caches
    turns = take_turns(
        {"--help": lambda _: _wall(show_help), "warm": lambda _: _wall(solve)}, [None], config.rounds, "startup"
    )
    seconds = {name: jobs[0] for name, jobs in turns.items()}
    if not config.quick:  # it compiles each time
        seconds["cold"] = []
        for _ in progress(range(3), "startup, nothing cached"):
            with tempfile.TemporaryDirectory() as folder:
                seconds["cold"].append(_wall(solve, LQRSIM_CACHE_DIR=folder))
    found: dict[str, Any] = {name: {"seconds": median(taken), "all": taken} for name, taken in seconds.items()}
    if config.quick:
        found["cold"] = {"skipped": "it takes too long for --quick"}
    return found


def _wall(command: list[str], **environment: str) -> float:
    clock = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment, check=False)
    seconds = time.perf_counter() - clock
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()}")
    return seconds


def report(found: dict[str, Any]) -> list[str]:
    what = {
        "--help": "lqrsim --help",
        "warm": "import, and solve a known structure",
        "cold": "import, and solve with nothing cached",
    }
    rows = [f"startup, seconds of a process: {'median':>14} {'least':>7} {'most':>7}"]
    for name, one in found.items():
        if "skipped" in one:
            rows.append(f"  {what[name]:<38} skipped: {one['skipped']}")
            continue
        rows.append(
            f"  {what[name]:<38} {one['seconds']:>5.2f} {min(one['all']):>7.2f} {max(one['all']):>7.2f}"
            f"  {judge(one['seconds'], name)}"
        )
    return ["\n".join(rows)]
