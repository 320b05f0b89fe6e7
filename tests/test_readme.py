"""What the README tells people to type works: its Python blocks run in order, in one namespace."""

import re
from functools import partial
from pathlib import Path

import pytest

import lqrsim as ls
from lqrsim.commands import COMMANDS

README = Path(__file__).parent.parent / "README.md"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def test_code_blocks_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # they write files
    # The README renders 25 s in 720p, which takes over a minute; small and coarse it is the same code.
    monkeypatch.setattr(ls, "render", partial(ls.render, size=(320, 180), fps=1), raising=False)
    text = README.read_text(encoding="utf-8")
    blocks = list(BLOCK.finditer(text))
    assert blocks, "the README has no Python"
    namespace: dict[str, object] = {"__name__": "readme"}
    for block in blocks:
        line = text.count("\n", 0, block.start(1))
        # Blank lines in front give a traceback the README's own line numbers.
        exec(compile("\n" * line + block.group(1), str(README), "exec"), namespace)


def test_commands_exist() -> None:
    """Every `python3 run.py X` and `lqrsim X` that it shows is a command."""
    text = README.read_text(encoding="utf-8")
    shown = set(re.findall(r"python3 run\.py (\w+)", text))
    assert {"demo", "test"} <= shown <= {"demo", "test", "check", "docs", "setup"}
    commands = set(COMMANDS)
    assert set(re.findall(r"^\$? ?lqrsim (\w+)", text, re.MULTILINE)) <= commands
