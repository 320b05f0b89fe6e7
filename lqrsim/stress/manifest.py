"""What a campaign's folder says of itself, `manifest.json`: sealed when it is written, checked whenever it is read.

It has two hashes. `sha256` is of all of it: whatever is edited is refused. `digest` is of what rows depend on, and each
shard has it too: a manifest that is sealed anew, with other numbers, has shards that are not its own.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lqrsim.errors import InputError, excerpt
from lqrsim.results import schema
from lqrsim.results.archive import Other, blamed
from lqrsim.results.hashing import sha256
from lqrsim.results.solution import Solution
from lqrsim.stress.specification import POLICIES, Campaign, Cell
from lqrsim.stress.trial_tables import write

FORMAT, VERSION, NAME = "lqrsim campaign", 5, "manifest.json"
GIVEN = "solution.npz"  # beside it: what was given in place of a solve, whose hash is `solution`
_LARGEST = 1 << 26  # bytes

_HASH = schema.line
_POLICY = schema.one_of(POLICIES)
_STRENGTH = schema.number(at_least=0.0)
_DISTURBANCE = schema.record({"kind": schema.line, "settings": schema.mapped(schema.anything)})
_CAMPAIGN = schema.record(
    {  # the fields of Campaign
        "scenario": schema.line, "sweeps": schema.mapped(schema.listed(_DISTURBANCE)),
        "strengths": schema.listed(_STRENGTH), "policies": schema.listed(_POLICY),
        "trials": schema.count, "seed": schema.count,
        **dict.fromkeys(
            ("replan_every", "goal_radius", "goal_tolerance"), schema.optional(schema.number(above=0.0))
        ),
        "shard": schema.count, "time_limit": schema.number(above=0.0),
        "stated": schema.optional(schema.listed(_DISTURBANCE)),
    }
)  # fmt: skip
_MANIFEST = schema.record(
    {
        "format": schema.line, "version": schema.count, "campaign": _CAMPAIGN, "model": _HASH, "problem": _HASH,
        "start": schema.optional(_HASH), "solution": schema.optional(_HASH),
        "code": schema.mapped(schema.optional(_HASH)),
        "policies": schema.mapped(schema.record({"digest": _HASH, "sha256": _HASH})),
        "cells": schema.listed(schema.row(_POLICY, schema.line, _STRENGTH)), "versions": schema.mapped(schema.line),
        "digest": _HASH, "machine": schema.line, "left_out": schema.line,
        "remarks": schema.listed(schema.line), "sha256": _HASH,
    }
)  # fmt: skip


def write_manifest(folder: Path, contents: dict[str, Any]) -> None:
    """Seal and write it: `contents` is all but its format, its cells and its hashes. Raises InputError."""
    manifest = {"format": FORMAT, "version": VERSION, **contents, "cells": _cells(contents["campaign"])}
    manifest["digest"] = digest_of_rows(manifest)
    manifest["sha256"] = _seal(manifest)
    _check(schema.parse(json.dumps(manifest)))  # in this order: that of the sweeps is that of the cells
    write(json.dumps(manifest, indent=1).encode(), folder / NAME)


def read_manifest(folder: Path) -> dict[str, Any]:
    """What a campaign's folder says of itself. Raises InputError unless it is, in content, what was written."""
    path = folder / NAME
    if not os.path.isfile(path):
        raise InputError(f"folder: got {excerpt(str(folder))}, want one that `lqrsim stress` wrote, with a {NAME}")
    with blamed(path, "folder"):
        if path.stat().st_size > _LARGEST:
            raise InputError(f"size: got {path.stat().st_size:,} bytes, want at most {_LARGEST:,}")
        manifest = schema.parse(path.read_text(encoding="utf-8"))
        if not isinstance(manifest, dict):
            raise InputError(f"manifest: got {excerpt(manifest)}, want an object")
        if (manifest.get("format"), manifest.get("version")) != (FORMAT, VERSION):
            was = f"a {excerpt(manifest.get('format'))} {excerpt(manifest.get('version'))}"
            raise Other(f"folder: got {path}, {was}, want a {FORMAT!r} {VERSION}")
        _check(manifest)
    return manifest


def _check(manifest: dict[str, Any]) -> None:
    """Raise InputError unless it is whole, and its hashes are those of what it says."""
    _MANIFEST("manifest", manifest)
    if manifest["sha256"] != _seal(manifest):
        raise InputError("sha256: got another than that of the content, want a file that has not been changed")
    campaign = manifest["campaign"]
    if schema.canonical(manifest["cells"]) != schema.canonical(_cells(campaign)):
        raise InputError("cells: got others than those of the campaign, want each sweep, strength and policy")
    if set(manifest["policies"]) != set(campaign["policies"]):
        raise InputError(f"policies: got {', '.join(manifest['policies'])}, want {', '.join(campaign['policies'])}")
    if manifest["digest"] != digest_of_rows(manifest):
        raise InputError("digest: got another than that of the campaign, want a file that has not been changed")


def _cells(campaign: Mapping[str, Any]) -> list[list[Any]]:
    """Each policy, sweep and strength, in the order of their numbers. Raises InputError if it is no campaign."""
    # Its disturbances may be a user's, and are made only where that user's file was named.
    bare = Campaign(**{**campaign, "sweeps": dict.fromkeys(campaign["sweeps"], ()), "stated": None})
    return [[cell.policy, cell.sweep, cell.strength] for cell in bare.cells]


def cells_of(manifest: Mapping[str, Any]) -> list[Cell]:
    """Its cells."""
    return [Cell(*cell) for cell in manifest["cells"]]


def _seal(manifest: Mapping[str, Any]) -> str:
    return sha256(schema.canonical({name: one for name, one in manifest.items() if name != "sha256"}))


def digest_of_rows(manifest: Mapping[str, Any]) -> str:
    """Hash of all that rows depend on, and of nothing that differs where the same is begun again."""
    lasting = {
        name: manifest[name] for name in ("cells", "model", "problem", "start", "solution", "code", "versions")
    } | {
        "campaign": {name: value for name, value in manifest["campaign"].items() if name != "time_limit"},
        "policies": {policy: hashes["digest"] for policy, hashes in manifest["policies"].items()},
    }
    return sha256(schema.canonical(lasting))


def digest_of_solution(solution: Solution) -> str:
    """Hash of what running it depends on: not of how long it took to find."""
    plan, policy = solution.trajectory, solution.policy
    goal = np.zeros(0) if solution.goal is None else solution.goal
    arrays = [plan.states, plan.controls, policy.gain, policy.offset, policy.nominal, np.array([plan.dt]), goal]
    if solution.cost_to_go is not None:  # which solving again begins with, and with the multipliers
        arrays += [np.asarray(part) for part in vars(solution.cost_to_go).values()]
    arrays += [one.values for one in solution.multipliers]
    return sha256(*(part for array in arrays for part in (f"{array.shape}", array)))
