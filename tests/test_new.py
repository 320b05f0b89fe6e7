"""`lqrsim new`: what it writes works as it is, by the commands that it prints."""

import dataclasses
import os
import pickle
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.commands.solving import TEMPLATES
from lqrsim.templates.my_robot.my_robot import MyRobot
from lqrsim.view import gl

ROOT = Path(__file__).parent.parent


def test_a_new_robot_solves_runs_renders_and_passes_by_the_printed_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "hover_disc"]) == 0
    printed = capsys.readouterr().out
    folder = tmp_path / "hover_disc"
    files = {path.name for path in folder.iterdir()}
    assert files == {"hover_disc.py", "hover_disc.xml", "test_hover_disc.py"}
    assert all(f"wrote {Path('hover_disc') / name}" in printed for name in files)
    texts = "".join(path.read_text(encoding="utf-8") for path in folder.iterdir())
    assert "class HoverDisc(ls.Robot)" in texts
    assert not re.search("my_?robot", texts, re.IGNORECASE)
    commands = [shlex.split(line) for line in printed.partition("next:\n")[2].splitlines()]
    assert [command[:2] for command in commands] == [
        ["lqrsim", "solve"], ["lqrsim", "simulate"], ["lqrsim", "render"], ["python", "-m"],
    ]  # fmt: skip
    page = (ROOT / "docs" / "new_robot.md").read_text(encoding="utf-8")
    assert all(shlex.join(command).replace("hover_disc", "my_robot") in page for command in commands)
    for name, *arguments in commands:
        if name == "python":
            environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTEST_ADDOPTS": "-p no:cacheprovider"}
            done = subprocess.run(
                [sys.executable, *arguments], capture_output=True, text=True, check=False, env=environment
            )
            assert done.returncode == 0, done.stdout + done.stderr
            assert "2 passed" in done.stdout
        elif arguments[0] != "render":
            assert main(arguments) == 0
        elif not gl.missing():
            assert main([*arguments, "--fps", "3"]) == 0  # a tenth of the pictures
    assert ls.load("runs/hover_disc/solution.npz", ls.Solution).success
    assert ls.load("runs/hover_disc/rollout.npz", ls.Rollout).outcome == ("reached",)
    if not gl.missing():
        (video,) = Path("runs/hover_disc").glob("*.mp4")
        assert video.stat().st_size > 1000


NO_NAMES = ["", "my-robot", "my robot", "../robot", "MyRobot", "3d", "_robot", "class", "röbot", "a" * 61]
TAKEN = ["numpy", "lqrsim", "any", "path", "world", "conftest", "con", "lpt1", "print", "self", "none", "valueerror"]


@pytest.mark.parametrize("name", [*NO_NAMES, *TAKEN])
def test_what_can_be_no_module_of_its_own_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", name]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("lqrsim: error: name: got ")
    assert not list(tmp_path.iterdir())


def test_what_is_there_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out" / "kept_disc").mkdir(parents=True)
    assert main(["new", "kept_disc", "--out", "out"]) == 2
    assert capsys.readouterr().err == (
        f"lqrsim: error: name: got 'kept_disc', want one without a folder {Path('out') / 'kept_disc'}\n"
    )
    assert not list((tmp_path / "out" / "kept_disc").iterdir())
    assert main(["new", "other", "--out", "out"]) == 0
    assert "lqrsim solve out/other/other.py:scenario" in capsys.readouterr().out


def test_the_robot_of_the_template_makes_its_dynamics_once() -> None:
    """Also in another process, where it is made anew."""
    robot = MyRobot(mass=0.7)
    assert robot.dynamics is robot.dynamics
    assert robot.dynamics.parameters["mass"] == 0.7
    assert dataclasses.replace(robot, mass=0.9).dynamics.parameters["mass"] == 0.9
    step = robot.dynamics.step(np.zeros(4), np.ones(2), 0.1)
    there = pickle.loads(pickle.dumps(robot))
    np.testing.assert_array_equal(there.dynamics.step(np.zeros(4), np.ones(2), 0.1), step)


def test_the_template_is_checked_as_the_package_is() -> None:
    """Its files are those of the package: ruff and the type checker see them, and the wheel carries them."""
    assert {path.suffix for path in TEMPLATES.iterdir() if path.is_file()} == {".py", ".xml"}
    assert TEMPLATES.is_relative_to(Path(ls.__file__).parent)
