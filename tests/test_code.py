"""Test files stand alone, and their types are right."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent


def test_no_test_file_imports_another() -> None:
    """What several of them need is in tests/helpers/, the only folder of tests/ from which they can import."""
    names = {path.stem for path in TESTS.glob("*.py")}
    for path in TESTS.rglob("*.py"):
        lines = re.findall(r"^ *(?:from|import) +([\w., ]+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        for module in (part.split()[0] for line in lines for part in line.split(",") if part.strip()):
            first, *rest = module.split(".")
            assert first not in names, f"{path.name} imports {module}"
            assert first != "tests", f"{path.name} imports {module}"
            assert not rest or rest[-1] not in names, f"{path.name} imports {module}"


@pytest.mark.long
def test_types_of_tests() -> None:
    """The types of everything else are a part of `run.py check`."""
    command = [sys.executable, "-m", "basedpyright", "--pythonpath", sys.executable, "tests"]
    done = subprocess.run(command, cwd=TESTS.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
