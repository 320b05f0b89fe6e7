"""The shell completes what the command line takes, by the script that `docs/getting_started.md` names."""

import shutil
import subprocess
from pathlib import Path

import pytest

from lqrsim.cli import main
from lqrsim.commands import COMMANDS

GIVEN = ("stress", "rare", "harden", "break", "funnel", "view")  # which run a stored solution
BASH = shutil.which("bash")


@pytest.fixture
def script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    with pytest.raises(SystemExit) as ended:
        main(["--tyro-print-completion", "bash"])
    assert not ended.value.code
    path = tmp_path / "lqrsim"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    return path


@pytest.mark.skipif(BASH is None, reason="no bash here")
@pytest.mark.parametrize(
    ("typed", "wanted"),
    [
        (["lqrsim", "so"], {"solve"}),
        (["lqrsim", "re"], {name for name in COMMANDS if name.startswith("re")}),
        (["lqrsim", "solve", "quadrotor", "--so"], {"--solver"}),
        (["lqrsim", "solve", "quadrotor", "--solver", ""], {"smooth", "ilqr"}),
        (["lqrsim", "simulate", "x.npz", "--js"], {"--json"}),
        *((["lqrsim", name, "quadrotor", "--solu"], {"--solution"}) for name in GIVEN),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bash_completes_commands_options_and_values(script: Path, typed: list[str], wanted: set[str]) -> None:
    assert BASH is not None
    program = 'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _tyro_lqrsim; echo "${COMPREPLY[@]}"'
    done = subprocess.run([BASH, "-c", program, "bash", script, *typed], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == wanted, done.stderr


def test_zsh_has_a_script_too(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--tyro-print-completion", "zsh"])
    assert not ended.value.code
    printed = capsys.readouterr().out
    assert printed.startswith("#compdef lqrsim")
    assert all(name in printed for name in COMMANDS)
