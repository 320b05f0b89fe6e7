"""Every script in experiments/ runs, and says what it is there to say."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

FOLDER = Path(__file__).parent.parent / "experiments"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py"))


def load(name: str) -> ModuleType:
    specification = importlib.util.spec_from_file_location(f"experiments.{name}", FOLDER / f"{name}.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module
    specification.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_explain_themselves(name: str) -> None:
    done = subprocess.run([sys.executable, FOLDER / f"{name}.py", "--help"], capture_output=True, text=True, check=True)
    assert "--quick" in done.stdout


def test_smoothing_takes_under_half_of_the_iterations_of_ilqr() -> None:
    """The paper's claim, on the first 20 queries, at the paper's stop test, with the paper's soft start."""
    script = load("iterations")
    result = script.main(script.Config(quick=True))
    for name in ("smooth", "ilqr"):
        assert result[name]["status"] == ["COST_CONVERGED"] * 20
    assert np.mean(result["smooth"]["iterations"]) < 0.5 * np.mean(result["ilqr"]["iterations"])
    assert "smooth" in script.report(result)
