"""Results on disk: arrays by name, and everything that is not an array in one JSON text.

`docs/file_format.md` says what is in them and loads a policy elsewhere, with NumPy alone; `results/archive.py` has the
rest. The tables here say what belongs into a file. What is saved and what is loaded are both held to them.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, astuple, fields
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
import numpy.typing as npt

from lqrsim.errors import InputError, check_array, check_kind, check_path, excerpt
from lqrsim.results import funnel_file, schema
from lqrsim.results.archive import Arrays, Header, opened, write
from lqrsim.results.archive import replacing as replacing
from lqrsim.results.ball_record import BallRecord
from lqrsim.results.coordinates_file import COORDINATES, coordinates_of
from lqrsim.results.funnel import Funnel
from lqrsim.results.output_feedback import SHAPES as OUTPUT_FEEDBACK
from lqrsim.results.output_feedback import OutputFeedbackPolicy
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Candidate, Certificate, Iteration, Multipliers, Status, Trajectory
from lqrsim.results.value_functions import Moments, Quadratic

VERSIONS = {"solution": 5, "rollout": 4, "policy": 1, "funnel": 1}

# Shapes in letters: T steps, n states, m controls; the others stand for whatever it is, but the same in all of a file.
_PLAN = {"trajectory.controls": "T m", "trajectory.states": "T+1 n"}

_SOLUTION_ARRAYS = _PLAN | {
    "policy.gain": "T m n", "policy.offset": "T m", "policy.nominal": "T n", "iterations": "iterations 7",
    "certificate": "8",
}  # fmt: skip
# Each of these is there as a whole, or not at all.
_SOLUTION_OPTIONAL: tuple[dict[str, str], ...] = (
    {"inverse_policy.gain": "T m n", "inverse_policy.offset": "T m", "inverse_policy.nominal": "T n"},
    {"cost_to_go.hessian": "T+1 n n", "cost_to_go.gradient": "T+1 n", "cost_to_go.constant": "T+1"},
    {"cost_to_come.hessian": "T+1 n n", "cost_to_come.gradient": "T+1 n", "cost_to_come.constant": "T+1"},
    {"cost_to_come.covariance": "T+1 n n", "cost_to_come.mean": "T+1 n", "cost_to_come.constant": "T+1"},
    {"clearance": "T+1"},
    {"goal": "n"},
    {"candidates.states": "candidates T+1 n", "candidates.controls": "candidates T m"},
)
_ROLLOUT_ARRAYS = {  # of the same names in a Rollout
    "states": "K T+1 n", "measured": "K T+1 n", "commanded": "K T m", "applied": "K T m", "forces": "K T 3",
    "torques": "K T 3", "displaced": "K obstacles 3", "clearance": "K T+1", "contacts": "K",
    "collided_at": "K", "diverged_at": "K", "failed_at": "K", "frame_times": "F", "frames": "K F nq",
}  # fmt: skip
_BALLS = {"balls.driven": "K T+1 B 3", "balls.planned": "T+1 B 3", "balls.radii": "B", "balls.anchors": "B 4"}
_ROLLOUT_OPTIONAL: tuple[dict[str, str], ...] = (
    {"goal": "n"}, {"tube": "T+1 p p"}, {"collision_chance": "T+1"}, _BALLS,
)  # fmt: skip
_POLICY_ARRAYS = {  # of each kind; of the same names in the classes
    "affine": {"gain": "T m n", "offset": "T m", "nominal": "T n"},
    "output feedback": OUTPUT_FEEDBACK,
}
_CERTIFICATE = tuple(field.name for field in fields(Certificate))  # before the gap, in the array of that name
_DTYPES: Mapping[str, str] = dict.fromkeys(("contacts", *funnel_file.WHOLE_NUMBERS), "<i8")  # all others are <f8

_COMMON = {
    "format": schema.line, "version": schema.count, "sha256": schema.line,
    "states": COORDINATES, "controls": COORDINATES,
    "dt": schema.number(at_least=1e-9, at_most=1e9),
}  # fmt: skip
_STATUS = schema.one_of(Status)
_SOLUTION_TEXTS: dict[str, schema.Check] = {  # of the same names in a Solution
    "detail": schema.text, "solver": schema.line, "options": schema.mapped(schema.anything),
    "problem_digest": schema.line, "versions": schema.mapped(schema.line), "scenario": schema.line,
    "goal_radius": schema.optional(schema.number(above=0.0)),
}  # fmt: skip
_SOLUTION_LISTS: dict[str, schema.Check] = {
    "status": _STATUS, "methods": schema.listed(schema.line), "penalties": schema.listed(schema.number(at_least=0.0)),
    "candidates": schema.listed(schema.row(schema.line, schema.any_number, schema.count, schema.optional(_STATUS))),
}  # fmt: skip
_ROLLOUT_TEXTS: dict[str, schema.Check] = {  # of the same names in a Rollout
    "robot": schema.line, "body": schema.line, "scene": schema.line, "model": schema.text, "policy_digest": schema.line,
    "radius": schema.number(at_least=0.0), "goal_radius": schema.number(above=0.0), "seed": schema.count,
    "first_trial": schema.count, "versions": schema.mapped(schema.line), "disturbances": schema.listed(schema.text),
    "obstacles": schema.listed(schema.line), "reasons": schema.listed(schema.line),
}  # fmt: skip
_POLICY_TEXTS: dict[str, schema.Check] = {
    "kind": schema.one_of(_POLICY_ARRAYS), "measured": schema.optional(COORDINATES),
}  # fmt: skip

Saved = Solution | Rollout | AffinePolicy | OutputFeedbackPolicy | Funnel
_Kind = TypeVar("_Kind", Solution, Rollout, AffinePolicy, OutputFeedbackPolicy, Funnel)


def save(result: Saved, path: str | os.PathLike[str]) -> Path:
    """Write a solution, a rollout, a policy alone or a funnel; the file is whole or not there. Returns its path.

    Args:
      result: a Solution, a Rollout, a policy or a Funnel.
      path: FILE.npz.

    Returns:
      The path.

    Raises:
      InputError: the file cannot be written; or what it would hold could not be read again.
    """
    path = check_path("output", path)
    wanted = "a Solution, a Rollout, an AffinePolicy, an OutputFeedbackPolicy or a Funnel"
    check_kind("result", result, tuple(_PARTS), wanted)
    kind, parts = next(found for one, found in _PARTS.items() if isinstance(result, one))
    try:
        arrays, texts = parts(result)
        meta = schema.parse(schema.canonical({"format": f"lqrsim {kind}", "version": VERSIONS[kind], **texts}))
        arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        headers = {name: Header(array.dtype.str, array.shape) for name, array in arrays.items()}
        _check(kind, headers, meta | {"sha256": ""})
        _MAKERS[kind](arrays, meta)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(
            f"result: got a {kind} that cannot be written ({error}), want one as lqrsim makes it"
        ) from None
    write(path, arrays, meta)
    return path


@overload
def load(path: str | os.PathLike[str]) -> Saved: ...
@overload
def load(path: str | os.PathLike[str], kind: type[_Kind]) -> _Kind: ...
def load(path: str | os.PathLike[str], kind: type[Saved] | None = None) -> Saved:
    """Read what `save` wrote. Loading never runs code.

        solution = ls.load("plan.npz", ls.Solution)

    Args:
      path: of a file that `save` wrote.
      kind: what it has to be: `ls.Solution`, `ls.Rollout`, `ls.AffinePolicy`, `ls.OutputFeedbackPolicy` or `ls.Funnel`.
        By default, whatever it is.

    Returns:
      What was saved.

    Raises:
      InputError: the file is missing, damaged, of another version or of another kind.
    """
    if kind is not None and kind not in _PARTS:
        raise InputError(f"kind: got {excerpt(kind)}, want one of {', '.join(f'ls.{one.__name__}' for one in _PARTS)}")
    wanted = None if kind is None else _PARTS[kind][0]
    path = check_path(wanted or "path", path)
    if path.is_dir():
        known = "; the folder of a campaign is opened with ls.stress.Results(folder)"
        raise InputError(f"{wanted or 'path'}: got {path}, a folder, want a file{known}")
    with opened(path, wanted, VERSIONS) as archive:
        found = str(archive.meta["format"]).removeprefix("lqrsim ")
        _check(found, archive.headers, archive.meta)
        result = _MAKERS[found](archive.arrays(), archive.meta)
    if kind is not None and not isinstance(result, kind):
        raise InputError(f"{wanted}: got {path}, which holds an {type(result).__name__}, want an {kind.__name__}")
    return result


def _check(kind: str, headers: Mapping[str, Header], meta: dict[str, Any]) -> None:
    """Raise InputError unless the text is as it must be, and the arrays are those, of those shapes, that go with it."""
    schema.record(_COMMON | _TEXTS[kind])("meta", meta)
    sizes = {"n": len(meta["states"]["names"]), "m": len(meta["controls"]["names"])}
    if kind == "rollout":
        wanted, groups = _PLAN | _ROLLOUT_ARRAYS, _ROLLOUT_OPTIONAL
        sizes["p"] = len(meta["states"]["position"])
    elif kind == "policy":
        wanted, groups = _POLICY_ARRAYS[meta["kind"]], ()
        if (meta["measured"] is None) != (meta["kind"] == "affine"):
            raise InputError("meta.measured: got none of output feedback, or some of an affine policy")
        sizes |= {"Y": len(meta["measured"]["names"])} if meta["measured"] else {}
    elif kind == "funnel":
        wanted, groups = funnel_file.ARRAYS, ()
        sizes |= {"d": len(meta["off_plan"]), "k": len(meta["reasons"])}
    else:
        sizes |= {"iterations": len(meta["methods"]), "candidates": len(meta["candidates"])}
        wanted = _SOLUTION_ARRAYS | {f"multipliers.{i}": f"T+1 rows{i}" for i in range(len(meta["penalties"]))}
        groups = _SOLUTION_OPTIONAL
    for group in groups:
        if group.keys() <= headers.keys() - wanted.keys():
            wanted |= group
    if kind == "solution":
        ended = [status for _, _, _, status in meta["candidates"] if status is not None]
        if bool(meta["candidates"]) != ("candidates.states" in wanted) or (meta["candidates"] and not ended):
            raise InputError("meta.candidates: got some without plans, plans without them, or none that ended")
    if missing := sorted(wanted.keys() - headers.keys()):
        raise InputError(f"{missing[0]}: got none, want it")
    if unknown := sorted(headers.keys() - wanted.keys()):
        raise InputError(f"{excerpt(unknown[0])}: got it, want only what belongs to this {kind}")
    for name, letters in wanted.items():
        _check_array(name, headers[name], letters.split(), sizes)
    if min(sizes[letter] for letter in ("T", "m", "n") + (("K",) if kind == "rollout" else ())) < 1:
        raise InputError(f"shapes: got {sizes}, want at least one step, state, control and trial")


def _check_array(name: str, header: Header, letters: list[str], sizes: dict[str, int]) -> None:
    """Raise InputError unless an array has its kind of numbers, and its shape; its letters get their sizes."""
    dtype = _DTYPES.get(name, "<f8")
    if header.dtype != dtype:
        raise InputError(f"{name}: got numbers of type {header.dtype}, want {dtype}")
    fits = len(header.shape) == len(letters)
    for letter, length in zip(letters, header.shape, strict=False):
        base = letter.removesuffix("+1")
        more = int(base != letter)
        fits &= length == (int(base) if base.isdecimal() else sizes.setdefault(base, length - more)) + more
    if not fits:
        raise InputError(f"{name}: got shape {header.shape}, want ({', '.join(letters)}), where {sizes}")


def _solution_parts(solution: Solution) -> tuple[Arrays, dict[str, Any]]:
    log = [astuple(iteration)[:-1] for iteration in solution.iterations]
    arrays: Arrays = {
        "trajectory.states": solution.trajectory.states, "trajectory.controls": solution.trajectory.controls,
        "iterations": np.array(log, dtype=np.float64).reshape(-1, 7),
        "certificate": np.array([*astuple(solution.certificate), solution.gap]),
    }  # fmt: skip
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
    texts = {name: getattr(solution, name) for name in _SOLUTION_TEXTS}
    texts |= {
        "status": solution.status.value, "dt": solution.trajectory.dt,
        "options": dict(solution.options), "versions": dict(solution.versions),
        "states": asdict(solution.policy.state_coordinates), "controls": asdict(solution.policy.control_coordinates),
        "methods": [iteration.method for iteration in solution.iterations],
        "candidates": [
            (one.start, one.cost, one.iterations, None if one.status is None else one.status.value)
            for one in solution.candidates
        ],
        "penalties": [one.penalty for one in solution.multipliers],
    }  # fmt: skip
    return arrays, texts


def _solution(arrays: Arrays, meta: dict[str, Any]) -> Solution:
    states, controls, dt = coordinates_of(meta["states"]), coordinates_of(meta["controls"]), float(meta["dt"])

    def policy(name: str) -> AffinePolicy | None:
        if f"{name}.gain" not in arrays:
            return None
        parts = {part: arrays[f"{name}.{part}"] for part in ("gain", "offset", "nominal")}
        for part, array in parts.items():
            check_array(f"{name}.{part}", array, (None,) * array.ndim, infinite=part == "nominal")
        return AffinePolicy(**parts, dt=dt, state_coordinates=states, control_coordinates=controls)

    def value(kind: type[Any], name: str) -> Any:
        parts = [f"{name}.{field.name}" for field in fields(kind)]
        return kind(*(arrays[part] for part in parts)) if parts[0] in arrays else None

    law = policy("policy")
    assert law is not None  # its arrays are there, or the file was refused
    rows = zip(arrays["iterations"].tolist(), meta["methods"], strict=True)
    candidates = (
        Candidate(
            start,
            float(cost),
            iterations,
            None if status is None else Status(status),
            Trajectory(arrays["candidates.states"][i], arrays["candidates.controls"][i], dt),
        )
        for i, (start, cost, iterations, status) in enumerate(meta["candidates"])
    )
    multipliers = (
        Multipliers(arrays[f"multipliers.{i}"], float(penalty)) for i, penalty in enumerate(meta["penalties"])
    )
    return Solution(
        status=Status(meta["status"]),
        policy=law,
        inverse_policy=policy("inverse_policy"),
        cost_to_go=value(Quadratic, "cost_to_go"),
        cost_to_come=value(Quadratic, "cost_to_come") or value(Moments, "cost_to_come"),
        trajectory=Trajectory(arrays["trajectory.states"], arrays["trajectory.controls"], dt),
        iterations=tuple(Iteration(*numbers, method=method) for numbers, method in rows),
        clearance=arrays.get("clearance"),
        goal=arrays.get("goal"),
        certificate=Certificate(**dict(zip(_CERTIFICATE, arrays["certificate"].tolist(), strict=False))),
        gap=float(arrays["certificate"][-1]),
        candidates=tuple(candidates),
        multipliers=tuple(multipliers),
        **{name: meta[name] for name in _SOLUTION_TEXTS},
    )


def _rollout_parts(rollout: Rollout) -> tuple[Arrays, dict[str, Any]]:
    arrays: dict[str, npt.NDArray[Any]] = {name: getattr(rollout, name) for name in _ROLLOUT_ARRAYS}
    arrays |= {"trajectory.states": rollout.plan.states, "trajectory.controls": rollout.plan.controls}
    for name in (name for group in _ROLLOUT_OPTIONAL for name in group):
        owner, _, part = name.rpartition(".")
        found = getattr(getattr(rollout, owner), part, None) if owner else getattr(rollout, name)
        arrays |= {} if found is None else {name: found}
    texts = {name: getattr(rollout, name) for name in _ROLLOUT_TEXTS}
    texts |= {
        "versions": dict(rollout.versions), "dt": rollout.plan.dt,
        "states": asdict(rollout.state_coordinates), "controls": asdict(rollout.control_coordinates),
    }  # fmt: skip
    return arrays, texts


def _rollout(arrays: Arrays, meta: dict[str, Any]) -> Rollout:
    times = arrays["frame_times"]
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise InputError("frame_times: got times that are not in order, want each after the one before")
    return Rollout(
        **{name: arrays[name] for name in _ROLLOUT_ARRAYS},
        **{name: arrays.get(name) for group in _ROLLOUT_OPTIONAL for name in group if "." not in name},
        balls=BallRecord(**{name.split(".")[1]: arrays[name] for name in _BALLS}) if "balls.radii" in arrays else None,
        plan=Trajectory(arrays["trajectory.states"], arrays["trajectory.controls"], float(meta["dt"])),
        state_coordinates=coordinates_of(meta["states"]),
        control_coordinates=coordinates_of(meta["controls"]),
        **{name: meta[name] for name in _ROLLOUT_TEXTS},
    )


def _policy_parts(policy: AffinePolicy | OutputFeedbackPolicy) -> tuple[Arrays, dict[str, Any]]:
    kind, measured = "affine", None
    if isinstance(policy, OutputFeedbackPolicy):
        kind, measured = "output feedback", asdict(policy.measured_coordinates)
    arrays: Arrays = {name: getattr(policy, name) for name in _POLICY_ARRAYS[kind]}
    return arrays, {
        "kind": kind, "measured": measured, "dt": policy.dt,
        "states": asdict(policy.state_coordinates), "controls": asdict(policy.control_coordinates),
    }  # fmt: skip


def _policy(arrays: Arrays, meta: dict[str, Any]) -> AffinePolicy | OutputFeedbackPolicy:
    states, controls = coordinates_of(meta["states"]), coordinates_of(meta["controls"])
    rest: dict[str, Any] = {"dt": float(meta["dt"]), "state_coordinates": states, "control_coordinates": controls}
    for name, array in arrays.items():
        check_array(name, array, (None,) * array.ndim, infinite=name == "nominal")
    if meta["kind"] == "affine":
        return AffinePolicy(**arrays, **rest)
    return OutputFeedbackPolicy(**arrays, **rest, measured_coordinates=coordinates_of(meta["measured"]))


_PARTS: Mapping[type, tuple[str, Callable[[Any], tuple[Arrays, dict[str, Any]]]]] = {
    Solution: ("solution", _solution_parts), Rollout: ("rollout", _rollout_parts),
    AffinePolicy: ("policy", _policy_parts), OutputFeedbackPolicy: ("policy", _policy_parts),
    Funnel: ("funnel", funnel_file.parts),
}  # fmt: skip
_MAKERS = {"solution": _solution, "rollout": _rollout, "policy": _policy, "funnel": funnel_file.funnel_of}
_TEXTS = {
    "solution": _SOLUTION_TEXTS | _SOLUTION_LISTS, "rollout": _ROLLOUT_TEXTS, "policy": _POLICY_TEXTS,
    "funnel": funnel_file.TEXTS | funnel_file.CHOSEN,
}  # fmt: skip
