"""`lqrsim reproduce`: all experiments of the paper, the page that sums them up, and what happens when one fails."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from lqrsim import reproduce
from lqrsim.cli import main

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "experiments"

GOOD = """
import argparse, json, pathlib
parser = argparse.ArgumentParser()
parser.add_argument("--out", type=pathlib.Path); parser.add_argument("--json", action="store_true")
parser.add_argument("--quick", action="store_true")
told = parser.parse_args()
(told.out / "figures").mkdir(parents=True, exist_ok=True)
(told.out / "figures" / "table_1.png").touch()
statement = dict(where="Sec. X", paper="it works", test="1 is 1", ours="1", holds=True, figure="table_1")
result = dict(versions=dict(lqrsim="0"), figures=["table_1.png"], quick=told.quick)
print(json.dumps(dict(result=result, report="## It works", statements=[statement])))
"""


@pytest.fixture
def scripts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for scripts that stand in for the experiments, which take long."""
    folder = tmp_path / "experiments"
    folder.mkdir()
    monkeypatch.setattr(reproduce, "EXPERIMENTS", folder)
    return folder


def test_a_script_that_fails_does_not_stop_the_others(
    scripts: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (scripts / "table_1.py").write_text(GOOD)
    (scripts / "figure_3.py").write_text("import sys; sys.exit('no such robot')")
    assert main(["reproduce", "figure_3", "table_1", "--out", str(tmp_path / "out")]) == 1
    printed = capfd.readouterr()
    assert "no such robot" in printed.err
    assert "FAILED figure_3: exit code 1" in printed.out
    assert "HOLDS          Sec. X: it works" in printed.out
    saved = json.loads((tmp_path / "out" / "results.json").read_text())
    assert list(saved["results"]) == ["table_1"]
    text = (tmp_path / "out" / "results.md").read_text()
    assert "| it works (Sec. X) | 1 is 1 | 1 | holds | [table_1](figures/table_1.png) |" in text
    assert "Of 1 statements, 1 hold and 0 do not." in text
    assert main(["reproduce", "table_1", "--out", str(tmp_path / "out")]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["table_2"], "results: got 'table_2', want one of: figure_2, .*did you mean table_1"),
        (["--out", "/proc/nowhere"], "--out: got /proc/nowhere, want a folder that can be written"),
    ],
)
def test_bad_arguments_get_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(message, line)


@pytest.mark.skipif(os.name != "posix", reason="signals of process groups are POSIX's")
def test_ctrl_c_ends_the_script_too_and_leaves_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "experiments"
    folder.mkdir()
    (folder / "table_1.py").write_text(
        "import os, pathlib, time\npathlib.Path(__file__).with_name('pid').write_text(str(os.getpid()))\ntime.sleep(60)"
    )
    code = "import sys, pathlib; from lqrsim import cli, reproduce; reproduce.EXPERIMENTS = pathlib.Path(sys.argv[1])\n"
    code += "sys.exit(cli.main(['reproduce', 'table_1', '--out', sys.argv[2]]))"
    command = [sys.executable, "-c", code, str(folder), str(tmp_path / "out")]
    with subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 60
        while not (folder / "pid").exists() or not (folder / "pid").read_text():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(30) == 130
        assert process.stderr is not None
        assert "lqrsim: stopped" in process.stderr.read()
    with pytest.raises(ProcessLookupError):
        os.kill(int((folder / "pid").read_text()), 0)
    assert not (tmp_path / "out").exists()


def test_every_script_has_its_place_on_the_page() -> None:
    """A script that reproduces something of the paper makes statements, and is run by `lqrsim reproduce`."""
    made = {path.stem for path in FOLDER.glob("*.py") if "def statements(" in path.read_text(encoding="utf-8")}
    assert made == set(reproduce.SCRIPTS)


def same_page(folder: Path) -> dict[str, Any]:
    """Checks that the page and what is said in it follow from the numbers beside it; the numbers."""
    saved = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    for name, found in saved["results"].items():
        script = import_module(name)
        assert script.report(found["result"]) == found["report"], name
        said = [vars(statement) for statement in script.statements(found["result"])]
        assert said == found["statements"], name
        for file in found["result"]["figures"]:
            assert (folder / "figures" / file).stat().st_size > 0 or file.endswith(".pdf")
        for statement in found["statements"]:
            assert f"{statement['figure']}.png" in found["result"]["figures"]
    assert (folder / "results.md").read_text(encoding="utf-8") == reproduce.page(saved)
    return saved


def test_the_published_page_is_what_the_scripts_wrote() -> None:
    saved = same_page(ROOT / "docs")
    assert not saved["quick"]
    assert list(saved["results"]) == list(reproduce.SCRIPTS)
