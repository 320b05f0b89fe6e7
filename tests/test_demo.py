"""The main job: everything it promises to leave behind, and when it must fail."""

import os
import subprocess
import sys
from pathlib import Path

import av
import pytest
from sampling import rarely

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.view import gl


@pytest.mark.parametrize("asked", [["--robots", "quadrotor"], *rarely([])])
def test_demo_leaves_everything_it_promises(
    asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By default of both robots."""
    if gl.missing():
        pytest.skip("no OpenGL here")
    assert main(["demo", "--quick", "--out", str(tmp_path), "--seed", "3", *asked]) == 0
    printed = capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == (asked[1:] or ["differential_drive", "quadrotor"])
    for name in asked[1:] or ("differential_drive", "quadrotor"):
        folder = tmp_path / name
        solution, scenario = ls.load(folder / "solution.npz", ls.Solution), ls.scenarios.get(name)
        assert solution.status is ls.Status.CONVERGED
        assert solution.log in printed
        undisturbed, disturbed = (ls.load(folder / f"{run}.npz", ls.Rollout) for run in ("undisturbed", "disturbed"))
        assert undisturbed.disturbances == ()
        assert undisturbed.outcome == ("reached",)
        assert undisturbed.tracking_error.max() <= scenario.tracking_bound
        # The disturbances are plain to see, and the policy copes with them.
        assert disturbed.tracking_error.max() > 0.05
        assert disturbed.outcome == ("reached",)
        assert disturbed.seed == 3
        for figure in ("figure.png", "policy.png"):
            assert (folder / figure).read_bytes().startswith(b"\x89PNG")
        with av.open(str(folder / "video.mp4")) as video:
            stream = video.streams.video[0]
            assert stream.codec_context.name == "h264"
            assert stream.duration is not None
            assert stream.time_base is not None
            # Real time, to within one frame at either end.
            frame = 1 / float(stream.average_rate or 0)
            assert abs(float(stream.duration * stream.time_base) - disturbed.times[-1]) <= 2 * frame
        rows = [line for line in printed.splitlines() if line.startswith(f"{name} ") and " reached" in line]
        assert len([row for row in rows if f"{solution.cost:.4f}" in row]) == 2


@pytest.mark.long
def test_demo_fails_when_an_undisturbed_run_leaves_its_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The plan of query 3 cuts through a beam: a local optimum that the physics does not allow."""
    assert main(["demo", "--robots", "quadrotor,query=3", "--no-video", "--out", str(tmp_path)]) == 1
    assert "FAILED quadrotor,query=3: undisturbed" in capsys.readouterr().out
    assert not (tmp_path / "quadrotor" / "video.mp4").exists()


@pytest.mark.long
def test_demo_without_opengl_does_the_rest(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "lqrsim.cli", "demo", "--robots", "differential_drive", "--out", str(tmp_path)]
    environment = os.environ | {"MUJOCO_GL": "disable"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("No videos, everything else works") == 1
    files = {path.name for path in (tmp_path / "differential_drive").iterdir()}
    assert files == {"solution.npz", "undisturbed.npz", "disturbed.npz", "figure.png", "policy.png"}
