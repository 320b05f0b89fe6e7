"""Whether two checkouts of this project compute the same, to the last bit: for a change that is not to change results.

    python experiments/compare_checkouts.py ../before .        # some minutes, most of them for compiling
    python experiments/compare_checkouts.py ../before . --quick

Each checkout computes in a process of its own, with the packages of this one and a cache of its own. Compared are the
solutions of the paper's 100 queries of the quadrotor and of the drive, in both forms, with and without the paper's
start, by smooth and ilqr: status, iterations, cost, plan, policy and cost-to-go; and every column of a small campaign.
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import lqrsim as ls
from lqrsim.versions import versions


@dataclass(frozen=True)
class Config:
    """What is compared."""

    before: tyro.conf.Positional[Path]
    """Folder of one checkout."""
    after: tyro.conf.Positional[Path]
    """Folder of the other."""
    queries: int = 100
    """Of the quadrotor."""
    trials: int = 50
    """Of each cell of the campaign."""
    quick: bool = False
    """2 queries, 2 trials."""
    json: bool = False
    """Print the result as JSON."""


def main(config: Config) -> dict[str, Any]:
    if config.quick:
        config = replace(config, queries=2, trials=2)
    found = [_computed_by(folder, config) for folder in (config.before, config.after)]
    different = {
        name: [number for number, (one, other) in enumerate(zip(*lines, strict=True)) if one != other]
        for name, lines in ((name, (found[0][name], found[1][name])) for name in found[0])
    }
    counts = {name: len(lines) for name, lines in found[0].items()}
    settings = {name: str(value) for name, value in asdict(config).items()}
    return {"config": settings, "versions": versions(), "compared": counts, "different": different}


def _computed_by(folder: Path, config: Config) -> dict[str, list[Any]]:
    """What a checkout computes, in a process that imports nothing of another."""
    if not (folder / "lqrsim" / "__init__.py").is_file():
        raise SystemExit(f"checkout: got {folder}, want a folder with lqrsim/ in it")
    with tempfile.TemporaryDirectory() as cache:
        code = f"import json, runpy; compute = runpy.run_path({__file__!r})['compute']"
        code += f"; print(json.dumps(compute({config.queries}, {config.trials})))"
        environment = {**os.environ, "LQRSIM_CACHE_DIR": cache, "PYTHONPATH": str(folder.resolve())}
        done = subprocess.run([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, check=False)
    if done.returncode:
        raise SystemExit(f"checkout: {folder} failed with exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def compute(queries: int, trials: int) -> dict[str, list[Any]]:
    """Of each kind of result one line each; only names that `lqrsim` itself offers are used."""
    scenario, drive = ls.scenarios.quadrotor, ls.scenarios.differential_drive()
    soft = [scenario(query=query).problem for query in range(queries)]
    free = [replace(problem, control_limits=(-np.inf, np.inf)) for problem in soft]
    starts = [(problem, problem.start) for problem in soft]
    fixed = [replace(problem, initial=ls.FixedState(start)) for problem, start in starts if start is not None]
    paper = scenario().paper_start
    solved = {
        "paper": ls.smooth_many(free, start=paper, stop="cost"),
        "primal": ls.smooth_many(free, start=paper, form="primal"),
        "search, soft start": ls.smooth_many(soft),
        "search, fixed start": ls.smooth_many(fixed),
        "ilqr": ls.ilqr_many(fixed),
        "drive": [ls.smooth(drive.problem), ls.smooth(drive.problem, start=drive.paper_start), ls.ilqr(drive.problem)],
    }
    lines: dict[str, list[Any]] = {name: [_line(one) for one in solutions] for name, solutions in solved.items()}
    for name in ("differential_drive", "quadrotor"):
        sweeps = {kind: tuple(ls.preset(kind, ls.scenarios.get(name).plant())) for kind in ("light", "severe")}
        with tempfile.TemporaryDirectory() as folder:
            results = ls.run_campaign(
                ls.Campaign(scenario=name, sweeps=sweeps, strengths=(0.5, 1.0), trials=trials), folder, workers=0
            )
            lines[f"campaign {name}"] = [_table(vars(results.outcomes(cell))) for cell in results.campaign.cells]
    return lines


def _line(solution: ls.Solution) -> list[Any]:
    arrays = [solution.trajectory.states, solution.trajectory.controls, solution.policy.gain, solution.policy.offset]
    if solution.cost_to_go is not None:
        arrays.append(solution.cost_to_go.hessian)
    return [solution.status.name, len(solution.iterations), float(solution.cost).hex(), _hash(arrays)]


def _table(columns: dict[str, np.ndarray]) -> list[Any]:
    return [[name, _hash([column])] for name, column in columns.items()]


def _hash(arrays: Sequence[np.ndarray]) -> str:
    hasher = hashlib.sha256()
    for array in arrays:
        hasher.update(array.tobytes() if array.dtype != object else repr(array.tolist()).encode())
    return hasher.hexdigest()[:16]


def report(result: dict[str, Any]) -> str:
    lines = ["same bits"]
    for name, count in result["compared"].items():
        different = result["different"][name]
        which = f"; different: {', '.join(map(str, different[:10]))}" if different else ""
        lines.append(f"  {name:<28} {count - len(different)} of {count}{which}")
    return "\n".join(lines)


if __name__ == "__main__":
    config = tyro.cli(Config, description=__doc__)
    result = main(config)
    print(json.dumps(result) if config.json else report(result))
    sys.exit(any(result["different"].values()))
