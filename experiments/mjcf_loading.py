"""What it takes to make a robot of an MJCF, against MuJoCo's own loading of the same file.

    python experiments/mjcf_loading.py                                # the packaged scenes
    python experiments/mjcf_loading.py --models panda.xml iiwa14.xml  # any robots
    python experiments/mjcf_loading.py --quick

Both are measured in turn, in processor time; medians are printed. The first time is in a process of its own, after the
packages are imported; MuJoCo keeps meshes that it has read, so that it is faster again, for both.
"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from runner import Result, Settings, at_most, opening, run, table

from lqrsim.scenes.mjcf_model import MODELS, names

WAYS = {"mujoco": "mujoco.MjModel.from_xml_path", "robot": "ls.MjcfRobot"}
CODE = """
import sys, time, mujoco, lqrsim as ls
ls.MjcfRobot("cage")  # for its imports
for _ in range(int(sys.argv[2])):
    clock = time.process_time()
    LOAD(sys.argv[1])
    print(1000 * (time.process_time() - clock))
"""


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    models: tuple[Path, ...] = tuple(MODELS / f"{name}.xml" for name in names())
    """MJCFs of robots."""
    rounds: int = 5
    """Processes for each file and way, in turn."""
    loads: int = 8
    """How often each process loads it."""


def main(config: Config) -> Result:
    """Milliseconds of each file, by MuJoCo and as a robot, the first time and again."""
    config = at_most(config, rounds=1, loads=2)
    return opening(config) | {
        "config": {"rounds": config.rounds, "loads": config.loads},
        "files": {str(path): measure(config, path) for path in config.models},
    }


def measure(config: Config, path: Path) -> dict[str, list[float]]:
    """The first time and again, each way."""
    times: dict[str, list[list[float]]] = {way: [] for way in WAYS}
    for _ in range(config.rounds):
        for way, load in WAYS.items():
            command = [sys.executable, "-c", CODE.replace("LOAD", load), str(path), str(config.loads)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            times[way].append(list(map(float, done.stdout.split())))
    return {way: [float(np.median([one[0] for one in of])), float(np.median([one[1:] for one in of]))]
            for way, of in times.items()}  # fmt: skip


def report(result: Result) -> str:
    head = ("file", "ms by MuJoCo, first", "as a robot", "ratio", "ms by MuJoCo, again", "as a robot", "ratio")
    return table(head, [
        [file, *(f"{number:.{digits}f}" for own, ours in zip(one["mujoco"], one["robot"], strict=True)
                 for number, digits in ((own, 1), (ours, 1), (ours / own, 2)))]
        for file, one in result["files"].items()
    ])  # fmt: skip


if __name__ == "__main__":
    run(Config, main, report, __doc__)
