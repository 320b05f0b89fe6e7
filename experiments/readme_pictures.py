"""The pictures of the README: each robot on its way, drawn every two seconds or every half.

    python experiments/readme_pictures.py            # writes videos/readme_<scenario>.png

The runs are the demo's disturbed ones, seed 0.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro
from tqdm import tqdm

import lqrsim as ls

EVERY = {"differential_drive": 2.0, "quadrotor": 0.5}  # seconds between two robots


@dataclass(frozen=True, kw_only=True)
class Config:
    out: Path = Path("videos")
    """Folder for the pictures."""
    quick: bool = False
    """Small ones."""


def main(config: Config) -> dict[str, Path]:
    pictures: dict[str, Path] = {}
    for name, every in tqdm(EVERY.items(), unit="picture", leave=False, delay=2.0, disable=None):
        scenario = ls.scenarios.get(name)
        solution = ls.smooth(scenario.problem)
        rollout = ls.simulate(scenario.plant(), solution, disturbances=scenario.disturbances, seed=0)
        size = (320, 180) if config.quick else (1280, 720)
        pictures[name] = ls.still(rollout, config.out / f"readme_{name}.png", every=every, size=size)
    return pictures


if __name__ == "__main__":
    for picture in main(tyro.cli(Config, description=__doc__)).values():
        print(f"wrote {picture}")
