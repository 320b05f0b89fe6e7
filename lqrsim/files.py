"""Solutions and rollouts on disk: NumPy's .npz, data only, with everything that is not an array in one JSON text.

`docs/file_format.md` says what is in them and loads a policy elsewhere, with NumPy alone. Loading never runs code.
"""

import contextlib
import json
import os
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, astuple, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.coordinates import Coordinates
from lqrsim.errors import Array, InputError, check_array
from lqrsim.policy import AffinePolicy
from lqrsim.results import Candidate, Iteration, Multipliers, Solution, Status, Trajectory
from lqrsim.rollout import Rollout
from lqrsim.value_functions import Moments, Quadratic

VERSIONS = {"solution": 4, "rollout": 3}


def save(result: Solution | Rollout, path: str | os.PathLike[str]) -> Path:
    """Write a solution or a rollout; the file is whole or not there. Returns its path.

    Raises:
      InputError: the file cannot be written.
    """
    path = Path(path)
    kind, arrays, texts = _solution_parts(result) if isinstance(result, Solution) else _rollout_parts(result)
    meta = {"format": f"lqrsim {kind}", "version": VERSIONS[kind], **texts}
    with replacing(path) as unfinished, unfinished.open("wb") as file:
        # Through a file object: given a name, NumPy appends .npz to it.
        np.savez_compressed(file, allow_pickle=False, meta=np.array(json.dumps(meta)), **arrays)
    return path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name to write to, which takes the place of `path` when the block ends, and disappears if it fails.

    Raises:
      InputError: the folder or the file cannot be written, or the disk is full.
    """
    unfinished = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # A name of its own, so that two writers cannot meet; the suffix stays, for it says the format.
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=".unfinished-", suffix=path.suffix)
        os.close(handle)
        unfinished = Path(name)
        yield unfinished
        # mkstemp makes a file for its owner alone; a result is as readable as any other new file.
        mask = os.umask(0)
        os.umask(mask)
        unfinished.chmod(0o666 & ~mask)
        unfinished.replace(path)
    except OSError as error:
        raise InputError(f"output: got {path}, want a file that can be written ({error.strerror or error})") from None
    finally:
        if unfinished is not None:
            unfinished.unlink(missing_ok=True)


def load_solution(path: str | os.PathLike[str]) -> Solution:
    """Read what `save` wrote of a Solution.

    Raises:
      InputError: no such file, not a solution, damaged, or of another version.
    """
    arrays, meta = _read(Path(path), "solution")
    with _complete(path, "solution"):
        states, controls = _coordinates(meta["states"]), _coordinates(meta["controls"])
        n, m, steps, dt = len(states), len(controls), len(arrays["policy.gain"]), float(meta["dt"])

        def policy(name: str) -> AffinePolicy:
            return AffinePolicy(
                gain=check_array(f"{name}.gain", arrays[f"{name}.gain"], (steps, m, n)),
                offset=check_array(f"{name}.offset", arrays[f"{name}.offset"], (steps, m)),
                nominal=check_array(f"{name}.nominal", arrays[f"{name}.nominal"], (steps, n), infinite=True),
                dt=dt,
                state_coordinates=states,
                control_coordinates=controls,
            )

        def value(kind: type[Quadratic] | type[Moments], name: str) -> Any:
            shapes = (steps + 1, n, n), (steps + 1, n), (steps + 1,)
            keys = [field.name for field in fields(kind)]
            return kind(*(_array(arrays, f"{name}.{key}", shape) for key, shape in zip(keys, shapes, strict=True)))

        def cost_to_come() -> Quadratic | Moments | None:
            if "cost_to_come.covariance" in arrays:
                return value(Moments, "cost_to_come")
            return value(Quadratic, "cost_to_come") if "cost_to_come.hessian" in arrays else None

        log = _array(arrays, "iterations", (None, 7))

        def candidate(i: int, start: str, cost: float, count: int, status: str | None) -> Candidate:
            plan = Trajectory(
                _array(arrays, "candidates.states", (None, steps + 1, n))[i],
                _array(arrays, "candidates.controls", (None, steps, m))[i], dt,
            )  # fmt: skip
            return Candidate(start, float(cost), int(count), None if status is None else Status(status), plan)

        rows = zip(log.tolist(), meta["methods"], strict=True)
        return Solution(
            status=Status(meta["status"]),
            detail=meta["detail"],
            policy=policy("policy"),
            inverse_policy=policy("inverse_policy") if "inverse_policy.gain" in arrays else None,
            cost_to_go=value(Quadratic, "cost_to_go") if "cost_to_go.hessian" in arrays else None,
            cost_to_come=cost_to_come(),
            trajectory=_trajectory(arrays, steps, n, m, dt),
            iterations=tuple(Iteration(*numbers, method=str(method)) for numbers, method in rows),
            clearance=_array(arrays, "clearance", (steps + 1,)) if "clearance" in arrays else None,
            solver=meta["solver"],
            options=meta["options"],
            problem_digest=meta["problem_digest"],
            versions=meta["versions"],
            scenario=meta["scenario"],
            candidates=tuple(candidate(i, *one) for i, one in enumerate(meta["candidates"])),
            goal=_array(arrays, "goal", (n,)) if "goal" in arrays else None,
            goal_radius=meta["goal_radius"],
            multipliers=tuple(
                Multipliers(_array(arrays, f"multipliers.{i}", (steps + 1, None)), float(penalty))
                for i, penalty in enumerate(meta["penalties"])
            ),
        )


def load_rollout(path: str | os.PathLike[str]) -> Rollout:
    """Read what `save` wrote of a Rollout. Raises InputError as `load_solution` does."""
    arrays, meta = _read(Path(path), "rollout")
    with _complete(path, "rollout"):
        states, controls = _coordinates(meta["states"]), _coordinates(meta["controls"])
        n, m = len(states), len(controls)
        trials, knots, _ = arrays["states"].shape
        shapes = {
            "states": (trials, knots, n), "measured": (trials, knots, n), "commanded": (trials, knots - 1, m),
            "applied": (trials, knots - 1, m), "forces": (trials, knots - 1, 3), "torques": (trials, knots - 1, 3),
            "displaced": (trials, None, 3), "clearance": (trials, knots),
            "collided_at": (trials,), "diverged_at": (trials,), "failed_at": (trials,),
            "frame_times": (None,), "frames": (trials, len(arrays["frame_times"]), None),
        }  # fmt: skip
        return Rollout(
            **{name: _array(arrays, name, shape) for name, shape in shapes.items()},
            contacts=_array(arrays, "contacts", (trials,)).astype(np.int64),
            goal=_array(arrays, "goal", (n,)) if "goal" in arrays else None,
            obstacles=tuple(meta["obstacles"]),
            reasons=tuple(meta["reasons"]),
            plan=_trajectory(arrays, knots - 1, n, m, float(meta["dt"])),
            state_coordinates=states,
            control_coordinates=controls,
            disturbances=tuple(meta["disturbances"]),
            **{key: meta[key] for key in _ROLLOUT_TEXTS},
        )


_ROLLOUT_ARRAYS = (
    "states", "measured", "commanded", "applied", "forces", "torques", "displaced", "clearance", "contacts",
    "collided_at", "diverged_at", "failed_at", "frame_times", "frames",
)  # fmt: skip
_ROLLOUT_TEXTS = (
    "robot", "body", "scene", "model", "policy_digest", "radius", "goal_radius", "seed", "first_trial", "versions",
)  # fmt: skip


def _solution_parts(solution: Solution) -> tuple[str, dict[str, npt.NDArray[Any]], dict[str, Any]]:
    arrays: dict[str, npt.NDArray[Any]] = {
        "trajectory.states": solution.trajectory.states,
        "trajectory.controls": solution.trajectory.controls,
        "iterations": np.array([astuple(iteration)[:-1] for iteration in solution.iterations]).reshape(-1, 7),
    }
    for name, law in {"policy": solution.policy, "inverse_policy": solution.inverse_policy}.items():
        if law is not None:
            arrays |= {f"{name}.gain": law.gain, f"{name}.offset": law.offset, f"{name}.nominal": law.nominal}
    for name, value in {"cost_to_go": solution.cost_to_go, "cost_to_come": solution.cost_to_come}.items():
        if value is not None:
            arrays |= {f"{name}.{field.name}": getattr(value, field.name) for field in fields(value)}
    if solution.clearance is not None:
        arrays["clearance"] = solution.clearance
    if solution.goal is not None:
        arrays["goal"] = solution.goal
    if solution.candidates:
        plans = [candidate.trajectory for candidate in solution.candidates]
        arrays["candidates.states"] = np.array([plan.states for plan in plans])
        arrays["candidates.controls"] = np.array([plan.controls for plan in plans])
    arrays |= {f"multipliers.{i}": one.values for i, one in enumerate(solution.multipliers)}
    texts = {
        "status": solution.status.value, "detail": solution.detail, "dt": solution.trajectory.dt,
        "states": asdict(solution.policy.state_coordinates), "controls": asdict(solution.policy.control_coordinates),
        "solver": solution.solver, "options": dict(solution.options), "problem_digest": solution.problem_digest,
        "versions": dict(solution.versions), "scenario": solution.scenario,
        "methods": [iteration.method for iteration in solution.iterations],
        "candidates": [
            (one.start, one.cost, one.iterations, None if one.status is None else one.status.value)
            for one in solution.candidates
        ],
        "penalties": [one.penalty for one in solution.multipliers], "goal_radius": solution.goal_radius,
    }  # fmt: skip
    return "solution", arrays, texts


def _rollout_parts(rollout: Rollout) -> tuple[str, dict[str, npt.NDArray[Any]], dict[str, Any]]:
    arrays = {name: getattr(rollout, name) for name in _ROLLOUT_ARRAYS}
    arrays |= {"trajectory.states": rollout.plan.states, "trajectory.controls": rollout.plan.controls}
    arrays |= {} if rollout.goal is None else {"goal": rollout.goal}
    texts = {key: getattr(rollout, key) for key in _ROLLOUT_TEXTS}
    texts |= {
        "versions": dict(rollout.versions), "dt": rollout.plan.dt, "disturbances": list(rollout.disturbances),
        "obstacles": list(rollout.obstacles), "reasons": list(rollout.reasons),
        "states": asdict(rollout.state_coordinates), "controls": asdict(rollout.control_coordinates),
    }  # fmt: skip
    return "rollout", arrays, texts


def _read(path: Path, kind: str) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """All arrays of a file, and its JSON. Raises InputError unless it is a whole file of this kind and version."""
    if not path.is_file():
        raise InputError(f"{kind}: got {path}, want a file that exists")
    try:
        # Opened here, for NumPy leaves a file open that is no archive.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        meta = json.loads(str(arrays.pop("meta")))
        found, version = meta["format"], meta["version"]
    except OSError as error:
        raise InputError(f"{kind}: got {path}, want a file that can be read ({error.strerror or error})") from None
    except (  # of the archive, of the header of an array, which is Python's, or of the JSON
        ValueError, KeyError, TypeError, EOFError, AttributeError, SyntaxError, tokenize.TokenError,
        zipfile.BadZipFile, zlib.error,
    ):  # fmt: skip
        raise InputError(f"{kind}: got {path}, which is damaged, want a file that lqrsim wrote") from None
    if found != f"lqrsim {kind}":
        raise InputError(f"{kind}: got {path}, which holds a {found!r}, want a {f'lqrsim {kind}'!r}")
    if version != VERSIONS[kind]:
        raise InputError(f"{kind}: got {path} of version {version}, want version {VERSIONS[kind]}: write it again")
    return arrays, meta


@contextlib.contextmanager
def _complete(path: str | os.PathLike[str], kind: str) -> Iterator[None]:
    """Turn what a missing or misshapen part raises into one line."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError) as error:
        reason = f"{error}" if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{kind}: got {path}, which is damaged ({reason}), want a file that lqrsim wrote") from None


def _array(arrays: Mapping[str, npt.NDArray[Any]], name: str, shape: tuple[int | None, ...]) -> Array:
    """One array in the given shape; NaN is allowed, for it is what a diverged run or a failed solve holds."""
    array = arrays[name]
    if array.ndim != len(shape) or any(want not in (None, got) for got, want in zip(array.shape, shape, strict=True)):
        raise InputError(f"{name}: got shape {array.shape}, want {shape}")
    return np.asarray(array, dtype=np.float64)


def _trajectory(arrays: Mapping[str, npt.NDArray[Any]], steps: int, n: int, m: int, dt: float) -> Trajectory:
    states = _array(arrays, "trajectory.states", (steps + 1, n))
    return Trajectory(states, _array(arrays, "trajectory.controls", (steps, m)), dt)


def _coordinates(fields: Mapping[str, Any]) -> Coordinates:
    parts: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in fields.items()}
    return Coordinates(**parts)
