"""The manifest of a campaign's folder, `manifest.json`: specification, versions and hashes, checked when it is read.

It has two hashes. `sha256` covers the whole file, so that an edited one is refused. `digest` covers everything that the
rows depend on. Each shard has it, too, so that a manifest with new settings and a renewed hash does not fit the shards.
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
from lqrsim.stress.policies import POLICIES
from lqrsim.stress.specification import Campaign, Cell
from lqrsim.stress.trial_tables import write

FORMAT, VERSION, NAME = "lqrsim campaign", 6, "manifest.json"
GIVEN = "solution.npz"  # the solution that was given instead of solving; the manifest has its hash
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
        "design_disturbances": schema.optional(schema.listed(_DISTURBANCE)),
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
    """Write the manifest: `contents`, with format, cells and hashes added. Raises InputError."""
    manifest = {"format": FORMAT, "version": VERSION, **contents, "cells": _cells(contents["campaign"])}
    manifest["digest"] = digest_of_rows(manifest)
    manifest["sha256"] = _seal(manifest)
    _check(schema.parse(json.dumps(manifest)))  # without sorting: the order of the sweeps is that of the cells
    write(json.dumps(manifest, indent=1).encode(), folder / NAME)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of a folder. Raises InputError if it is missing, damaged, edited, or of another version."""
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
    """Raise InputError unless all fields are there, and the hashes fit."""
    _MANIFEST("manifest", manifest)
    if manifest["sha256"] != _seal(manifest):
        raise InputError("sha256: got one that does not fit the content, want a file that has not been changed")
    campaign = manifest["campaign"]
    if schema.canonical(manifest["cells"]) != schema.canonical(_cells(campaign)):
        raise InputError("cells: got some that are not the campaign's, want each sweep, strength and policy")
    if set(manifest["policies"]) != set(campaign["policies"]):
        raise InputError(f"policies: got {', '.join(manifest['policies'])}, want {', '.join(campaign['policies'])}")
    if manifest["digest"] != digest_of_rows(manifest):
        raise InputError("digest: got one that does not fit the campaign, want a file that has not been changed")


def _cells(campaign: Mapping[str, Any]) -> list[list[Any]]:
    """Policy, sweep and strength of each cell, in order. Raises InputError if a field of the campaign is invalid."""
    # Without the disturbances: they may be a user's, whose file is not loaded here.
    bare = Campaign(**{**campaign, "sweeps": dict.fromkeys(campaign["sweeps"], ()), "design_disturbances": None})
    return [[cell.policy, cell.sweep, cell.strength] for cell in bare.cells]


def cells_of(manifest: Mapping[str, Any]) -> list[Cell]:
    """The cells of a manifest."""
    return [Cell(*cell) for cell in manifest["cells"]]


def _seal(manifest: Mapping[str, Any]) -> str:
    return sha256(schema.canonical({name: one for name, one in manifest.items() if name != "sha256"}))


def digest_of_rows(manifest: Mapping[str, Any]) -> str:
    """Hash of all that the rows depend on; the same when the same campaign is begun again."""
    fields = ("cells", "model", "problem", "start", "solution", "code", "versions")
    hashed = {name: manifest[name] for name in fields} | {
        "campaign": {name: value for name, value in manifest["campaign"].items() if name != "time_limit"},
        "policies": {policy: hashes["digest"] for policy, hashes in manifest["policies"].items()},
    }
    return sha256(schema.canonical(hashed))


def digest_of_solution(solution: Solution) -> str:
    """Hash of everything in a solution that its runs depend on; not of the log of its solve."""
    plan, policy = solution.trajectory, solution.policy
    goal = np.zeros(0) if solution.goal is None else solution.goal
    arrays = [plan.states, plan.controls, policy.gain, policy.offset, policy.nominal, np.array([plan.dt]), goal]
    if solution.cost_to_go is not None:  # re-planning begins with it, and with the multipliers
        arrays += [np.asarray(part) for part in vars(solution.cost_to_go).values()]
    arrays += [one.values for one in solution.multipliers]
    return sha256(*(part for array in arrays for part in (f"{array.shape}", array)))
