"""The pictures of README.md and docs/gallery.md, by the command lines that the pages show beside them.

    python experiments/readme_pictures.py            # writes videos/readme_* and docs/figures/policy_*

Each line is run once, in the order of the list.
"""

import contextlib
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from runner import Result, Settings, opening, progress, run

from lqrsim import cli

DRIVE, QUADROTOR = "runs/differential_drive", "runs/quadrotor"
SOLVE_DRIVE, SOLVE_QUADROTOR = "lqrsim solve differential_drive", "lqrsim solve quadrotor"
RUN_DRIVE = f"lqrsim simulate {DRIVE}/solution.npz --disturbances scenario"
RUN_QUADROTOR = f"lqrsim simulate {QUADROTOR}/solution.npz --disturbances scenario"
STILL = "--quality publication --size 1280 720"

# What each picture takes: the one truth for this script, the pages and the tests.
PICTURES = {
    "videos/readme_quadrotor.gif": (
        SOLVE_QUADROTOR,
        RUN_QUADROTOR,
        f"lqrsim render {QUADROTOR}/rollout.npz --camera chase --inset top side"
        " --overlays plan ghost trace forces tube caption --size 680 382 --fps 12 --out videos/readme_quadrotor.gif",
    ),
    "videos/readme_feedback.gif": (
        SOLVE_DRIVE,
        RUN_DRIVE,
        f"{RUN_DRIVE} --open-loop --out runs/open_loop",
        f"lqrsim render {DRIVE}/rollout.npz runs/open_loop/rollout.npz --title 'with feedback' 'open loop'"
        " --speed 4 --size 800 340 --fps 12 --out videos/readme_feedback.gif",
    ),
    "videos/readme_wind.gif": (
        SOLVE_QUADROTOR,
        f"lqrsim simulate {QUADROTOR}/solution.npz --disturbances calm:Dryden --out runs/calm",
        f"lqrsim simulate {QUADROTOR}/solution.npz --disturbances severe:Dryden --out runs/severe",
        "lqrsim render runs/calm/rollout.npz runs/severe/rollout.npz --title calm severe --camera chase"
        " --size 640 360 --fps 12 --out videos/readme_wind.gif",
    ),
    "videos/readme_differential_drive.png": (
        SOLVE_DRIVE,
        RUN_DRIVE,
        f"lqrsim render {DRIVE}/rollout.npz --every 2 {STILL} --out videos/readme_differential_drive.png",
    ),
    "videos/readme_quadrotor.png": (
        SOLVE_QUADROTOR,
        RUN_QUADROTOR,
        f"lqrsim render {QUADROTOR}/rollout.npz --every 0.5 {STILL} --out videos/readme_quadrotor.png",
    ),
    "videos/readme_funnel.png": (
        SOLVE_QUADROTOR,
        RUN_QUADROTOR,
        "lqrsim funnel quadrotor --rate 0.9 --confidence 0.9",
        f"lqrsim render {QUADROTOR}/rollout.npz --overlays plan ghost trace forces funnel caption"
        f" --funnel runs/funnel/quadrotor/funnel.npz --time 3.2 {STILL} --out videos/readme_funnel.png",
    ),
    "docs/figures/policy_differential_drive.png": (
        f"{SOLVE_DRIVE} --figure docs/figures/policy_differential_drive.png",
    ),
    "docs/figures/policy_quadrotor.png": (f"{SOLVE_QUADROTOR} --figure docs/figures/policy_quadrotor.png",),
}


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    out: Path = Path()
    """Folder that the lines are run in."""


def main(config: Config) -> Result:
    """Run the lines; megabytes of each file that they made."""
    lines = dict.fromkeys(line for of_picture in PICTURES.values() for line in of_picture)
    config.out.mkdir(parents=True, exist_ok=True)
    with contextlib.chdir(config.out):
        for line in progress(lines, "pictures", unit="line"):
            if code := cli.main(shlex.split(_small(line) if config.quick else line)[1:]):
                raise SystemExit(code)
    made = [config.out / picture for picture in PICTURES]
    return opening(config) | {"made": {str(path): path.stat().st_size / 1e6 for path in made}}


def report(result: Result) -> str:
    return "\n".join(f"wrote {path}: {size:.2f} MB" for path, size in result["made"].items())


def _small(line: str) -> str:
    line = line.replace("--rate 0.9 --confidence 0.9", "--rate 0.5 --confidence 0.5 --knots 96 149")
    return re.sub(r"--fps \d+", "--fps 0.5", re.sub(r"--size \d+ \d+", "--size 320 240", line))


if __name__ == "__main__":
    run(Config, main, report, __doc__)
