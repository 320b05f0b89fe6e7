"""Time of rendering a video, relative to drawing its frames alone.

    python experiments/benchmark_rendering.py            # some minutes
    python experiments/benchmark_rendering.py --quick    # too few frames to trust
    python experiments/benchmark_rendering.py --json     # all that is measured, for other programs

Three take turns in one process, round by round, with the same frames of each robot's disturbed run at 1280 x 720: the
sum of bare `mujoco.Renderer.render` calls of the scene, and nothing else; `lqrsim.render` without overlays; and with
all of them, tube and caption too. Videos count from the call to the finished file, encoding and all set-up included.
What counts are medians of the ratios of a round. They are to be at most 1.15 and at most 1.40.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from runner import Settings, judge, opening, progress, run
from solver_benchmark.common import median

import lqrsim as ls
from lqrsim.view import gl
from lqrsim.view.picture import QUALITIES

ROBOTS = {"differential_drive": 6.0, "quadrotor": 30.0}  # frames a second, for as many frames of both
PLAIN, FULL = "without overlays", "all overlays"
MOST = {PLAIN: 1.15, FULL: 1.40}
SIZE = 1280, 720


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    rounds: int = 5
    """How often each has its turn."""
    seed: int = 0
    """Of the disturbances."""


class Contest:
    """One robot's run, which all contestants draw."""

    def __init__(self, name: str, rate: float, seed: int) -> None:
        scenario = ls.scenarios.get(name)
        self.rate, self.solution = rate, ls.smooth(scenario.problem)
        plant, wrong = scenario.plant(), scenario.disturbances
        tube = ls.predict_tube(scenario.problem, self.solution, ls.uncertainty_of(plant, wrong))
        self.rollout = tube.added_to(ls.simulate(plant, self.solution, disturbances=wrong, seed=seed))
        self.frames = int(self.rollout.times[-1] * rate + 1e-9) + 1

    def bare(self) -> float:
        """Seconds in `Renderer.render`, for all frames."""
        model = mujoco.MjModel.from_xml_string(self.rollout.model)
        look = QUALITIES["standard"]
        model.vis.quality.shadowsize, model.vis.quality.offsamples = look.shadows, look.samples
        model.vis.global_.offwidth, model.vis.global_.offheight = SIZE
        data, spent = mujoco.MjData(model), 0.0
        nearest = np.abs(self.rollout.frame_times - np.arange(self.frames)[:, None] / self.rate).argmin(axis=1)
        with mujoco.Renderer(model, SIZE[1], SIZE[0]) as renderer:
            for qpos in self.rollout.frames[0, nearest]:
                data.qpos[:] = qpos
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, "overview")
                begun = time.perf_counter()
                renderer.render()
                spent += time.perf_counter() - begun
        return spent

    def video(self, folder: Path, **options: Any) -> float:
        """Seconds of `lqrsim.render`."""
        begun = time.perf_counter()
        ls.render(self.rollout, folder / "video.mp4", fps=self.rate, size=SIZE, **options)
        return time.perf_counter() - begun


def main(config: Config) -> dict[str, Any]:
    gl.bind()
    rounds = 1 if config.quick else config.rounds
    contests = {name: Contest(name, rate / 10 if config.quick else rate, config.seed) for name, rate in ROBOTS.items()}
    seconds = {name: {"bare": [], PLAIN: [], FULL: []} for name in contests}
    turns = [(number, name) for number in range(rounds) for name in contests]
    with tempfile.TemporaryDirectory() as folder:
        for number, name in progress(turns, "rendering", unit="round"):
            contest, spent = contests[name], seconds[name]
            take = {
                "bare": contest.bare,
                PLAIN: lambda contest=contest: contest.video(Path(folder), overlays=()),
                FULL: lambda contest=contest: contest.video(Path(folder)),
            }
            if number == 0:
                take["bare"]()  # the first of a process is slow
            # Each begins a round once in three.
            order = list(take)
            for who in order[number % 3 :] + order[: number % 3]:
                spent[who].append(take[who]())
    ratios = {
        name: {who: median([a / b for a, b in zip(spent[who], spent["bare"], strict=True)]) for who in MOST}
        for name, spent in seconds.items()
    }
    return opening(config) | {
        "frames": {name: contest.frames for name, contest in contests.items()},
        "seconds": seconds,
        "ratios": ratios,
    }


def report(result: dict[str, Any]) -> str:
    rows = [f"{'':<20} {'frames':>7} {'':<17} {'ms/frame':>9} {'ratio':>7}"]
    for name, spent in result["seconds"].items():
        frames = result["frames"][name]
        for who, taken in spent.items():
            row = f"{name:<20} {frames:>7} {who:<17} {1e3 * median(taken) / frames:>9.1f}"
            if who in MOST:
                ratio = result["ratios"][name][who]
                row += f" {ratio:>7.3f}  {judge(ratio <= MOST[who], f'<= {MOST[who]:g}')}"
            rows.append(row)
    return "\n".join([result["machine"], *rows])


if __name__ == "__main__":
    run(Config, main, report, __doc__)
