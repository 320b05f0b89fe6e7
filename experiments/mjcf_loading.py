"""What it takes to make a robot of an MJCF, against MuJoCo's own loading of the same file.

    python experiments/mjcf_loading.py                                # the packaged scenes
    python experiments/mjcf_loading.py --models panda.xml iiwa14.xml  # any robots
    python experiments/mjcf_loading.py --quick

Both are measured in turn, in processor time; medians are printed. MuJoCo keeps meshes that it has read, for both.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from runner import Result, Settings, at_most, opening, run, table

import lqrsim as ls
from lqrsim.scenes.mjcf_text import MODELS, names


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    models: tuple[Path, ...] = tuple(MODELS / f"{name}.xml" for name in names())
    """MJCFs of robots."""
    rounds: int = 15
    """Of measurements that alternate."""


def main(config: Config) -> Result:
    """Milliseconds of each file, by MuJoCo and as a robot."""
    config = at_most(config, rounds=2)
    result = opening(config) | {"config": {"models": list(map(str, config.models)), "rounds": config.rounds}}
    return result | {"files": {str(path): measure(config, path) for path in config.models}}


def measure(config: Config, path: Path) -> dict[str, float]:
    loads: dict[str, Callable[[], Any]] = {
        "mujoco": lambda: mujoco.MjModel.from_xml_path(str(path)), "robot": lambda: ls.MjcfRobot(path),
    }  # fmt: skip
    times: dict[str, list[float]] = {which: [] for which in loads}
    for _ in range(config.rounds + 1):  # the first also imports modules
        for which, load in loads.items():
            clock = time.process_time()
            load()
            times[which].append(1000 * (time.process_time() - clock))
    return {which: float(np.median(values[1:])) for which, values in times.items()}


def report(result: Result) -> str:
    head = ("file", "ms by MuJoCo", "ms as a robot", "ratio")
    return table(head, [
        [file, f"{one['mujoco']:.1f}", f"{one['robot']:.1f}", f"{one['robot'] / one['mujoco']:.2f}"]
        for file, one in result["files"].items()
    ])  # fmt: skip


if __name__ == "__main__":
    run(Config, main, report, __doc__)
