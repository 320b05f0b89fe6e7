"""Compare the results of two checkouts of this project, for a change that should not change them.

    python tests/tools/compare_checkouts.py ../before .        # some minutes
    python tests/tools/compare_checkouts.py ../before . --quick
    python tests/tools/compare_checkouts.py ../before . --tolerance 1e-10    # where rounding may differ

Each checkout computes in a process of its own, with the packages of this one and a cache of its own. Compared are the
solutions of the paper's 100 queries of the quadrotor and of the drive, in both forms, with and without the paper's
start, by smooth and ilqr, with a clearance, limits, noise and a risk, and of a robot from an MJCF: status, iterations,
cost, plan, policy and cost-to-go; every column of a small campaign; what small searches find for rare failures, the
smallest failure, a hardened plan and a funnel; a run that re-plans; and a policy as C. To the last bit; with a
tolerance, the same status and iterations, and costs that differ by less than that, relatively. Of the rest it then says
the largest difference, relative to the largest number of its array. Exits with 1 if anything differs.
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
    """Of each cell of the campaign, and at each level of a splitting, where they are 20 at least."""
    tolerance: float = 0.0
    """Of costs, relative; 0 for the same bits in everything."""
    quick: bool = False
    """2 queries, 2 trials."""
    json: bool = False
    """Print the result as JSON."""


def main(config: Config) -> dict[str, Any]:
    from lqrsim.machine import versions  # here, for another checkout, which runs this file too, may have it elsewhere

    if config.quick:
        config = replace(config, queries=2, trials=2)
    with tempfile.TemporaryDirectory() as kept:
        places = [Path(kept) / name for name in ("before", "after")]
        pairs = zip((config.before, config.after), places, strict=True)
        found = [_computed_by(folder, place, config) for folder, place in pairs]
        arrays = [dict(np.load(place / "arrays.npz")) for place in places]
    result: dict[str, Any] = {"compared": {}, "different": {}, "cost": {}, "arrays": {}}
    for name, before in found[0].items():
        pairs = list(zip(before, found[1][name], strict=True))
        result["compared"][name] = len(pairs)
        result["cost"][name] = max((_apart(one["cost"], other["cost"]) for one, other in pairs), default=0.0)
        own = [key for key in arrays[0] if key.startswith(f"{name}/")]
        result["arrays"][name] = max((_apart(arrays[0][key], arrays[1][key]) for key in own), default=0.0)
        result["different"][name] = [i for i, pair in enumerate(pairs) if not _same(*pair, config.tolerance)]
    settings = {name: str(value) for name, value in asdict(config).items()}
    return {"config": settings, "versions": versions(), **result}


def _same(one: dict[str, Any], other: dict[str, Any], tolerance: float) -> bool:
    if tolerance == 0:
        return one == other
    return one["what"] == other["what"] and _apart(one["cost"], other["cost"]) <= tolerance


def _apart(one: Any, other: Any) -> float:
    """The largest difference relative to the largest number; infinite for other shapes, or where one is not finite."""
    a, b = np.atleast_1d(np.asarray(one, dtype=np.float64)), np.atleast_1d(np.asarray(other, dtype=np.float64))
    if a.shape != b.shape or not np.array_equal(np.isfinite(a), np.isfinite(b)):
        return float("inf")
    good = np.isfinite(a)
    return float(np.abs(a[good] - b[good]).max(initial=0.0) / max(np.abs(a[good]).max(initial=0.0), 1e-300))


def _computed_by(folder: Path, place: Path, config: Config) -> dict[str, list[Any]]:
    """Results of a checkout, computed in a process that imports it alone; arrays are saved in `place`."""
    place.mkdir()
    if not (folder / "lqrsim" / "__init__.py").is_file():
        raise SystemExit(f"checkout: got {folder}, want a folder with lqrsim/ in it")
    with tempfile.TemporaryDirectory() as cache:
        code = f"import json, lqrsim, runpy; compute = runpy.run_path({__file__!r})['compute']"
        code += f"; print(json.dumps([lqrsim.__file__, compute({config.queries}, {config.trials}, {str(place)!r})]))"
        environment = {**os.environ, "LQRSIM_CACHE_DIR": cache, "PYTHONPATH": str(folder.resolve())}
        # -P: or the folder that this runs in would come before the checkout.
        done = subprocess.run([sys.executable, "-P", "-c", code], env=environment, stdout=subprocess.PIPE, check=False)
    if done.returncode:
        raise SystemExit(f"checkout: {folder} failed with exit code {done.returncode}")
    used, found = json.loads(done.stdout.splitlines()[-1])
    if not Path(used).resolve().is_relative_to(folder.resolve()):
        raise SystemExit(f"checkout: {folder} was not used, but {used}")
    return found


def compute(queries: int, trials: int, place: str) -> dict[str, list[Any]]:
    """Results by kind, one entry per problem; uses only names that `lqrsim` itself offers."""
    scenario, drive = ls.scenarios.quadrotor, ls.scenarios.differential_drive()
    soft = [scenario(query=query).problem for query in range(queries)]
    free = [replace(problem, control_limits=(-np.inf, np.inf)) for problem in soft]
    starts = [(problem, problem.start) for problem in soft]
    fixed = [replace(problem, initial=ls.FixedState(start)) for problem, start in starts if start is not None]
    paper = scenario().paper_start
    some = fixed[: max(queries // 10, 1)]
    world, radius = scenario().scene.world, scenario().robot.radius
    clear = [replace(one, constraints=[ls.Clearance(world, radius=radius)]) for one in some]
    tight = [replace(one, control_limits=(0.9, 1.6)) for one in some]
    shaken = ls.Noise(np.vstack([np.zeros((3, 2)), 0.01 * np.eye(9)[:, :2]]))
    solved = {
        "paper": ls.smooth_many(free, start=paper, stop="cost"),
        "primal": ls.smooth_many(free, start=paper, form="primal"),
        "search, soft start": ls.smooth_many(soft),
        "search, fixed start": ls.smooth_many(fixed),
        "ilqr": ls.ilqr_many(fixed),
        "drive": [ls.smooth(drive.problem), ls.smooth(drive.problem, start=drive.paper_start), ls.ilqr(drive.problem)],
        "clearance": ls.smooth_many(clear),
        "limits": ls.smooth_many(tight),
        "noise": ls.smooth_many(some, noise=shaken),
        "risk": ls.smooth_many(some, noise=shaken, risk=1e-3),
        "mjcf": [ls.smooth(_cart_pole(angle)) for angle in (0.5, 1.0, 2.0)],
    }
    arrays: dict[str, np.ndarray] = {}
    lines: dict[str, list[Any]] = {name: [] for name in solved}
    for name, solutions in solved.items():
        for i, solution in enumerate(solutions):
            lines[name].append(_line(solution, f"{name}/{i}", arrays))
    for name in ("differential_drive", "quadrotor"):
        sweeps = {
            kind: tuple(ls.disturbances.preset(kind, ls.scenarios.get(name).plant())) for kind in ("light", "severe")
        }
        with tempfile.TemporaryDirectory() as folder:
            results = ls.stress.run_campaign(
                ls.stress.Campaign(scenario=name, sweeps=sweeps, strengths=(0.5, 1.0), trials=trials), folder, workers=0
            )
            cells = [results.outcomes(cell).columns() for cell in results.campaign.cells]
        lines[f"campaign {name}"] = [_table(cell, f"campaign {name}/{i}", arrays) for i, cell in enumerate(cells)]
    for name, columns in _searches(max(trials, 20)).items():
        lines[name] = [_table(columns, name, arrays)]
    np.savez(Path(place) / "arrays.npz", **arrays)  # pyright: ignore[reportArgumentType]
    return lines


def _searches(particles: int) -> dict[str, dict[str, np.ndarray]]:
    """What studies of policies find, a run that re-plans, and the C files of a policy: arrays by name."""
    study = ls.stress.ReliabilityProblem("quadrotor", sweep="moderate", strength=2.0, policy="track")
    rare = study.rare_failures(particles=particles, repetitions=2).splitting
    smallest = study.smallest_failure(rounds=2, particles=particles)
    study = ls.stress.ReliabilityProblem("quadrotor", sweep="moderate")
    hard = ls.stress.harden(study, chance=0.3, rounds=1, particles=particles, repetitions=2)
    drive, noise = ls.scenarios.differential_drive(), [ls.disturbances.ControlNoise(0.05)]
    plant, plan = drive.plant(), ls.smooth(drive.problem)
    funnel = ls.funnel(plant, plan, disturbances=noise, rate=0.8, knots=[0], states=["x", "y"], failures=1)
    replanner = ls.Replanner(drive.problem, plan, every=5.0, deadline=0.0)
    again = ls.simulate(plant, plan, controller=replanner, disturbances=noise, frames=False)
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(file).read_text(encoding="utf-8") for file in ls.export_c(plan.policy, folder).files]
    return {
        "rare failures": {"repetitions": rare.repetitions, "levels": rare.levels, "failures": rare.failures},
        "smallest failure": {"numbers": smallest.point.numbers, "shares": np.array(smallest.shares)},
        "hardened plan": {
            "states": hard.solution.trajectory.states, "hit": np.array([*hard.rounds[0].hit.values()]),
            "probability": np.array([one.probability.value for one in hard.rounds]),
        },
        "funnel": {"levels": funnel.levels, "successes": funnel.successes, "shape": funnel.shape},
        "re-planned run": {"states": again.states, "applied": again.applied},
        "policy as C": {"files": np.array(files)},
    }  # fmt: skip


_CART_POLE = """
<mujoco>
  <option timestep="0.01" integrator="RK4"/>
  <worldbody><body>
    <joint name="cart" type="slide" axis="1 0 0" damping="0.1"/><geom type="box" size=".1 .1 .05" mass="1"/>
    <body><joint name="pole" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.6" mass=".2"/></body>
  </body></worldbody>
  <actuator><motor name="push" joint="cart" ctrlrange="-20 20"/></actuator>
</mujoco>
"""


def _cart_pole(angle: float) -> ls.Problem:
    """A cart-pole whose pole swings up by this angle."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cart_pole.xml"
        path.write_text(_CART_POLE, encoding="utf-8")
        robot = ls.MjcfRobot(ls.load_scene(path))
    return ls.Problem(
        dynamics=robot.dynamics, dt=0.02, steps=60, initial=ls.FixedState(np.zeros(4)),
        stage_cost=ls.ControlCost([0.01]),
        final_cost=ls.QuadraticCost([100.0, 100.0, 10.0, 10.0], about=[0.0, angle, 0.0, 0.0]),
    )  # fmt: skip


def _line(solution: ls.Solution, key: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    own = [solution.trajectory.states, solution.trajectory.controls, solution.policy.gain, solution.policy.offset]
    if solution.cost_to_go is not None:
        own.append(solution.cost_to_go.hessian)
    arrays.update({f"{key}/{i}": array for i, array in enumerate(own)})
    what = [solution.status.name, len(solution.iterations)]
    return {"what": what, "cost": float(solution.cost), "bits": _hash(own)}


def _table(columns: dict[str, np.ndarray], key: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Counts, which must be equal, and measured columns, which may differ by rounding."""
    measured = {name: column for name, column in columns.items() if column.dtype == np.float64}
    arrays.update({f"{key}/{name}": column for name, column in measured.items()})
    what = [[name, _hash([column])] for name, column in columns.items() if name not in measured]
    return {"what": what, "cost": 0.0, "bits": _hash(list(measured.values()))}


def _hash(arrays: Sequence[np.ndarray]) -> str:
    hasher = hashlib.sha256()
    for array in arrays:
        hasher.update(array.tobytes() if array.dtype != object else repr(array.tolist()).encode())
    return hasher.hexdigest()[:16]


def report(result: dict[str, Any]) -> str:
    exact = float(result["config"]["tolerance"]) == 0
    same = not any(result["different"].values())
    what = "bits" if exact else "status, iterations and counts, and cost within the tolerance"
    lines = [f"the same {what}" if same else f"NOT the same {what}; of each kind, how many are:"]
    for name, count in result["compared"].items():
        different = result["different"][name]
        which = f"; different: {', '.join(map(str, different[:10]))}" if different else ""
        apart = f"cost {result['cost'][name]:.1e}, arrays {result['arrays'][name]:.1e}"
        lines.append(f"  {name:<28} {count - len(different):>4} of {count:<4} {apart}{which}")
    return "\n".join(lines)


if __name__ == "__main__":
    from lqrsim.commands.console import text_of

    config = tyro.cli(Config, description=__doc__)
    result = main(config)
    print(text_of(result) if config.json else report(result))
    sys.exit(any(result["different"].values()))
    sys.exit(any(result["different"].values()))
