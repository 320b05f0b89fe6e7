"""Every script in experiments/ runs, and says what it is there to say."""

import importlib.util
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).parent.parent / "experiments"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py") if "__main__" in path.read_text(encoding="utf-8"))


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


def benchmark(*arguments: str) -> dict[str, Any]:
    """The benchmark's results, from a process of its own: with the C++ reference in it, tiny numbers become zero."""
    script = FOLDER / "benchmark_solver.py"
    done = subprocess.run(
        [sys.executable, script, "--quick", "--json", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    """All sections, in two processes at once, for most of the time goes into compiling."""
    with ThreadPoolExecutor() as pool:
        speed = pool.submit(benchmark, "--sections", "speed", "--queries", "4", "--rounds", "1")
        others = ("peers", "scaling", "threads", "startup")
        return benchmark("--sections", *others, "--queries", "2", "--rounds", "1") | speed.result()


# Tests have no business with how long anything takes: what is asserted holds on any machine.


def test_benchmark_of_speed_compares_the_same_iterations(results: dict[str, Any]) -> None:
    assert results["config"]["seed"] == 0
    assert results["versions"]["lqrsim"]
    speed = results["speed"]
    assert speed["derivative_difference"] < 1e-10
    for solver in ("smooth", "primal", "ilqr"):
        found = speed[solver]
        for name in ("by hand", "compiled level") if solver != "primal" else ():
            assert found[name]["iterations"] == found["symbolic"]["iterations"]
            np.testing.assert_allclose(found[name]["cost"], found["symbolic"]["cost"], rtol=1e-8)
            assert found[name]["milliseconds"] >= found[name]["milliseconds_loop"] > 0
        if "reference" in speed:
            assert speed["reference"]["skipped"]
        else:
            assert found["same_iterations"]
            # The reference has the primal form; the dual takes another way to the same optimum.
            assert found["cost_difference"] < (1e-4 if solver == "smooth" else 1e-8)


def test_benchmark_of_peers_recomputes_what_they_claim(results: dict[str, Any]) -> None:
    """Needs the `bench` extra and g++, which few machines have; without them it says so."""
    peers = results["peers"]
    if "skipped" in peers:
        assert "installed" in peers["skipped"]
        return
    assert set(peers) == {"smooth, hover", "ilqr, hover", "FDDP, hover", "FDDP, line"}
    for found in peers.values():
        assert found["converged"] == [True, True]
        assert found["cost_difference"] < 1e-8
    # From a trajectory FDDP is iLQR, but for how it regularises and how far its line search looks.
    np.testing.assert_allclose(peers["FDDP, hover"]["cost"], peers["ilqr, hover"]["cost"], rtol=1e-3)


def test_benchmark_of_scaling_threads_and_startup(results: dict[str, Any]) -> None:
    scaling = results["scaling"]
    assert {line["states"] for line in scaling["states"]} == {3}
    for solver in ("smooth", "ilqr"):
        per_step = [line["bytes"] / line["steps"] for line in scaling["steps"] if line["solver"] == solver]
        assert max(per_step) < 1.02 * min(per_step), "memory does not grow linearly with the horizon"
    threads = results["threads"]
    if "skipped" not in threads:
        assert all(found["same_costs"] for found in threads.values())
    assert set(results["startup"]) == {"--help", "warm", "cold"}


def test_benchmark_says_what_it_skips(tmp_path: Path) -> None:
    sys.path.insert(0, str(FOLDER))  # it imports its neighbours
    try:
        script = load("benchmark_solver")
    finally:
        sys.path.remove(str(FOLDER))
    with pytest.raises(script.Unavailable, match="name its folder with --reference"):
        script.speed.load_reference(script.Config(reference=tmp_path))
    assert script.report({"peers": {"skipped": "no such thing"}}) == "peers: skipped: no such thing"


def test_benchmark_of_reliability() -> None:
    """On few problems: bad advice breaks the bare method and not the guarded one, which changes nothing elsewhere."""
    sys.path.insert(0, str(FOLDER))  # it imports its neighbours
    try:
        script = load("benchmark_reliability")
        # What else there is of random problems has tests of its own.
        result = script.main(script.Config(quick=True, kinds=("linear_2_1", "drive")))
    finally:
        sys.path.remove(str(FOLDER))
    assert result["versions"]["lqrsim"]
    for found in result["stiff"].values():
        assert found["status"] == ["CONVERGED"] * 8
        assert max(found["improvement"]) < 1e-3
    assert result["fragile"]["1, without"]["status"].count("CONVERGED") < 8
    assert result["fragile"]["1, with"]["status"] == ["CONVERGED"] * 8
    assert list(result["random"]) == ["linear_2_1", "drive"]
    for found in result["random"].values():
        assert set(found["status"]) == {"CONVERGED"}
    for found in result["overhead"].values():
        assert all(found["same_bits"])
        assert all(bare == guarded for bare, guarded in found["iterations"])
    ablation = result["ablation"]
    assert len(ablation) == 16
    assert sum("skipped" in found for found in ablation.values()) == 4
    exact = ablation["dual, fixed, prior, safeguard"]
    np.testing.assert_allclose(exact["cost_from_start"], exact["cost"], rtol=1e-9)
    assert "handed over" in script.report(result)
