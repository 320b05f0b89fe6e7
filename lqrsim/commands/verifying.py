"""The command that verifies runs from pixels."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lqrsim.commands.options import Json, optional


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Check a run against its rendered frames.

    A run is rendered in calibrated fixed views. A video is decoded, and the robot's mark is located in its panes `top`
    and `side`. Positions from pixels are compared with the simulator's and with the plan. See docs/verifying.md.

      lqrsim verify runs/quadrotor/rollout.npz
      lqrsim verify videos/quadrotor/video.mp4
    """

    file: Annotated[Positional[Path], arg(metavar="RUN.npz|VIDEO.mp4")]
    """A file from `lqrsim simulate`, or its video from `lqrsim render` with the cameras or insets top and side."""
    run_file: Annotated[Path | None, optional("RUN.npz"), arg(name="run")] = None
    """The run that the video shows. By default the run in its folder that the video names."""
    trial: Annotated[int | None, optional("N")] = None
    """Row of the rollout, from 0. By default 0, or the first that the video shows."""
    solution: Annotated[Path | None, optional("SOLUTION.npz")] = None
    """Solution of the run, to check the recorded plan. By default solution.npz beside the run."""
    json: Json = False

    def run(self) -> int:
        """Run the command. Returns the exit code: 1 if a test failed."""
        from lqrsim.commands import as_json, console
        from lqrsim.results import save_load
        from lqrsim.results.rollout import Rollout
        from lqrsim.results.solution import Solution
        from lqrsim.verify.ground_truth import ran_policy_of
        from lqrsim.verify.rollout_check import verify_run
        from lqrsim.verify.video_check import run_beside, verify_video

        is_run = self.file.suffix.lower() == ".npz"
        path = self.file if is_run else self.run_file or run_beside(self.file)
        rollout, beside = save_load.load(path, Rollout), path.with_name("solution.npz")
        solution = None
        if self.solution or os.path.isfile(beside):
            solution = save_load.load(self.solution or beside, Solution)
            # The solution file beside a run may belong to another run; one that is given is used in any case.
            solution = solution if self.solution or ran_policy_of(solution, rollout) else None
        with console.progress("verifying", "frame") as progress:
            if is_run:
                found = verify_run(rollout, self.trial or 0, solution=solution, progress=progress)
            else:
                found = verify_video(self.file, rollout, trial=self.trial, solution=solution, progress=progress)
        console.say(found.summary())
        console.result(verification=as_json.of_verification(found))
        return 0 if found.passed else 1
