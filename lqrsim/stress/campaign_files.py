"""The files of a campaign's folder: its lock, the tables of its trials, and its manifest.

A table is a parquet file with the columns of `Outcomes`, and `reason`, the cause of an error. It is written whole or
not at all. Its metadata names the campaign, the cell and the trials, and contains a hash of these and of the columns.

`manifest.json` contains specification, versions and hashes. `sha256` covers the whole file, so that an edited file is
refused. `digest` covers everything that the rows depend on. It is also in each shard, so that a manifest with new
settings and a renewed hash does not fit the shards.

The system releases the lock when the process dies, however it dies. File systems without locks are refused.
"""

import contextlib
import errno
import io
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from lqrsim.annotations import Line, checked
from lqrsim.errors import LONGEST, InputError, excerpt
from lqrsim.results.archive import Other, blamed, canonical, parse, replacing, sha256
from lqrsim.results.solution import Solution
from lqrsim.stress.analysis import COLUMNS
from lqrsim.stress.study import CAMPAIGN_FIELDS, Campaign, Shard

_HELD = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}  # another process has the lock; EDEADLK on Windows
Columns = dict[str, npt.NDArray[np.generic]]  # of the table of a shard, by name
_KEY = b"lqrsim shard"
_TEXTS = "outcome", "obstacle", "reason"
_TYPES = dict.fromkeys((*COLUMNS, "reason"), pa.float64()) | {"trial": pa.int64()} | dict.fromkeys(_TEXTS, pa.string())
_MAGIC = b"PAR1"  # of parquet; its footer has values of these kinds
_DEEPEST = 21  # values within each other; a footer has fewer
_BOOLEANS, _BYTE, _INTEGERS, _DOUBLE, _TEXT, _LISTS, _MAP, _STRUCT = (1, 2), 3, (4, 5, 6), 7, 8, (9, 10), 11, 12
FORMAT, VERSION, NAME = "lqrsim campaign", 8, "manifest.json"
SOLUTION_FILE = "solution.npz"  # the solution that was given instead of solving; the manifest has its hash
_LARGEST, _LARGEST_TABLE = 1 << 26, 1 << 29  # bytes, largest manifest and table


@contextlib.contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Make the folder if it does not exist, and lock it during the block."""
    path = folder / "campaign.lock"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise InputError(f"folder: got {folder}, want one that can be written ({error.strerror})") from None
    try:
        try:
            _lock(handle)
        except OSError as error:
            got = f"{folder}, which another process writes (see {path.name}), want one at a time"
            if error.errno not in _HELD:
                got = f"{folder}, want one whose files can be locked ({error.strerror or error})"
            raise InputError(f"folder: got {got}") from None
        with contextlib.suppress(OSError):  # shows which process has the lock
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"{os.getpid()}\n".encode(), 0) if hasattr(os, "pwrite") else None
        yield
    finally:
        os.close(handle)


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int) -> None:
        os.lseek(handle, 1 << 20, os.SEEK_SET)  # a byte that is never read: locked bytes cannot be read

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


class Damaged(Exception):
    """The exception for a file that differs from what was written."""


def pack(table: Columns, shard: Shard, digest: str) -> bytes:
    """Encode a table as a file; `digest` is that of its campaign."""
    about = _about(shard, digest)
    meta = json.dumps(about | {"sha256": _digest(table, about)}).encode()
    arrow = pa.table({name: pa.array(column) for name, column in table.items()}).replace_schema_metadata({_KEY: meta})
    file = io.BytesIO()
    pq.write_table(arrow, file, write_page_checksum=True)
    return file.getvalue()


def unpack(contents: bytes, shard: Shard, digest: str) -> Columns:
    """Decode a table. Raises Damaged unless it is, to the bit, what `pack` was given for this shard."""
    about = _about(shard, digest)
    try:
        groups = _chunks(contents)
        rows = [[count for _, count in group] for group in groups]
        if any(codec not in (0, 1) for group in groups for codec, _ in group):
            raise ValueError("another compression than Snappy's")  # a few bytes of it may be gigabytes
        file = pq.ParquetFile(io.BytesIO(contents))
        if not file.metadata.num_rows == shard.count == sum(group[0] for group in rows):
            raise ValueError(f"{file.metadata.num_rows} rows")
        if file.schema_arrow.names != [*_TYPES] or file.schema_arrow.types != [*_TYPES.values()]:
            raise ValueError("other columns than those of outcomes")
        if any(len(group) != len(_TYPES) or len({*group}) > 1 for group in rows):
            raise ValueError("columns of different lengths")
        meta = json.loads((file.schema_arrow.metadata or {})[_KEY])
        file = pq.ParquetFile(io.BytesIO(contents), read_dictionary=[*_TEXTS], page_checksum_verification=True)
        read = file.read(use_threads=False)
        table: Columns = {name: _texts(read[name]) if name in _TEXTS else read[name].to_numpy() for name in _TYPES}
        good = meta == about | {"sha256": _digest(table, about)}
    except Exception as error:  # a parser may raise anything for damaged bytes
        raise Damaged(" ".join(f"{type(error).__name__}: {error}".split())[:200]) from None
    if not good or any(len(column) != shard.count for column in table.values()):
        raise Damaged("its contents have changed")
    return table


def write(contents: bytes, path: Path) -> None:
    """Write a file to the disk, all or nothing. Raises InputError if this fails, as on a full disk."""
    with replacing(path) as unfinished, unfinished.open("wb") as file:
        file.write(contents)
        file.flush()
        os.fsync(file.fileno())


def read_table(path: Path, shard: Shard, digest: str) -> Columns:
    """Read the table of a file. Raises Damaged if it has changed or cannot be read."""
    if not os.path.isfile(path):
        raise Damaged("it is no regular file")
    try:
        if (size := path.stat().st_size) > _LARGEST_TABLE:
            raise Damaged(f"it has {size:,} bytes, want at most {_LARGEST_TABLE:,}")
        contents = path.read_bytes()
    except OSError as error:
        raise Damaged(f"it cannot be read ({error.strerror or error})") from None
    return unpack(contents, shard, digest)


def _about(shard: Shard, digest: str) -> dict[str, Any]:
    return {"campaign": digest, "cell": shard.cell_number, "first": shard.first, "count": shard.count}


def _texts(column: pa.ChunkedArray) -> npt.NDArray[np.str_]:
    """The texts of a column that is read as a dictionary: a text that rows have in common is unpacked once."""
    parts = list[npt.NDArray[np.str_]]()
    for part in column.chunks:
        texts = part.dictionary.to_pylist()
        if (longest := max(map(len, texts), default=0)) > LONGEST:
            raise ValueError(f"a text of {longest} characters")
        parts.append(np.array(texts, dtype=np.str_)[part.indices.to_numpy()])
    return np.concatenate(parts)


def _digest(table: Columns, about: Mapping[str, Any]) -> str:
    parts: list[str | bytes] = [json.dumps(about)]
    for name, column in table.items():
        text = column.dtype.kind == "U"
        kind = "text" if text else column.dtype.str
        data = json.dumps(column.tolist()).encode() if text else np.ascontiguousarray(column).tobytes()
        parts += [f"{name} {kind} {len(data)}:", data]
    return sha256(*parts)


def _chunks(contents: bytes) -> list[list[tuple[int, int]]]:
    """Codec (0 none, 1 Snappy) and number of values of each column of each row group, by the footer.

    Raises an exception of any kind where the footer is damaged.

    PyArrow's own objects of a footer end the process where it is damaged, so it is read here, as far as it bounds the
    memory that a file takes. The format is Thrift's compact protocol: https://github.com/apache/parquet-format and
    https://github.com/apache/thrift/blob/master/doc/specs.
    """
    length = int.from_bytes(contents[-8:-4], "little")
    if contents[-4:] != _MAGIC or not 0 < length <= len(contents) - 12:
        raise ValueError("no footer of parquet")
    footer = _value(io.BytesIO(contents[-8 - length : -8]), _STRUCT, _DEEPEST)
    columns = [[chunk[3] for chunk in group[1]] for group in footer[4]]
    return [[(chunk[4], chunk[5]) for chunk in group] for group in columns]


def _value(data: io.BytesIO, kind: int, depth: int) -> Any:
    """A value of Thrift; of a structure its fields by their numbers."""
    if depth == 0:
        raise ValueError("structures too deep within each other")
    if kind in (*_BOOLEANS, _BYTE):
        return data.read(1)[0]
    if kind in _INTEGERS:
        return _integer(data)
    if kind in (_DOUBLE, _TEXT):
        length = 8 if kind == _DOUBLE else _unsigned(data)
        if len(read := data.read(length)) < length:
            raise ValueError("the end is missing")
        return read
    if kind in _LISTS:
        head = data.read(1)[0]
        count = head >> 4 if head >> 4 < 15 else _unsigned(data)
        return [_value(data, head & 15, depth - 1) for _ in range(count)]
    if kind == _MAP:
        kinds = data.read(1)[0] if (count := _unsigned(data)) else 0
        return [(_value(data, kinds >> 4, depth - 1), _value(data, kinds & 15, depth - 1)) for _ in range(count)]
    if kind == _STRUCT:
        values, number = dict[int, Any](), 0
        while head := data.read(1)[0]:
            number = number + (head >> 4) if head >> 4 else _integer(data)
            kind = head & 15
            values[number] = kind == _BOOLEANS[0] if kind in _BOOLEANS else _value(data, kind, depth - 1)
        return values
    raise ValueError(f"a field of kind {kind}")


def _integer(data: io.BytesIO) -> int:
    number = _unsigned(data)
    return (number >> 1) ^ -(number & 1)


def _unsigned(data: io.BytesIO) -> int:
    number = shift = 0
    while (byte := data.read(1)[0]) & 128:
        number, shift = number | (byte & 127) << shift, shift + 7
        if shift > 63:
            raise ValueError("a number of more than 64 bits")
    return number | byte << shift


@checked
@dataclass(frozen=True)
class _Manifest:
    """The fields of the manifest; `Campaign` checks the campaign's fields."""

    format: Line
    version: int
    campaign: Mapping[str, object]
    model: Line
    problem: Line
    start: Line | None
    solution: Line | None
    code: Mapping[str, Line | None]
    policies: Mapping[str, Mapping[str, Line]]
    cells: object
    deterministic: object
    versions: Mapping[str, Line]
    digest: Line
    machine: Line
    left_out: Line
    remarks: tuple[Line, ...]
    sha256: Line


def write_manifest(folder: Path, contents: dict[str, Any]) -> None:
    """Write the manifest: `contents`, with format, cells and hashes added. Raises InputError."""
    manifest = {"format": FORMAT, "version": VERSION, **contents, "cells": _cells(contents["campaign"])}
    manifest["digest"] = digest_of_rows(manifest)
    manifest["sha256"] = _seal(manifest)
    _check(parse(json.dumps(manifest)))  # without sorting: the sweeps define the order of the cells
    write(json.dumps(manifest, indent=1).encode(), folder / NAME)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of a folder. Raises InputError if it is missing, damaged, edited, or of another version."""
    path = folder / NAME
    if not os.path.isfile(path):
        raise InputError(f"folder: got {excerpt(str(folder))}, want one that `lqrsim stress` wrote, with a {NAME}")
    with blamed(path, "folder"):
        if path.stat().st_size > _LARGEST:
            raise InputError(f"size: got {path.stat().st_size:,} bytes, want at most {_LARGEST:,}")
        manifest = parse(path.read_text(encoding="utf-8"))
        if not isinstance(manifest, dict):
            raise InputError(f"manifest: got {excerpt(manifest)}, want an object")
        if (manifest.get("format"), manifest.get("version")) != (FORMAT, VERSION):
            was = f"a {excerpt(manifest.get('format'))} {excerpt(manifest.get('version'))}"
            raise Other(f"folder: got {path}, {was}, want a {FORMAT!r} {VERSION}")
        _check(manifest)
    return manifest


def _check(manifest: dict[str, Any]) -> None:
    """Raise InputError unless all fields are there, and the hashes fit."""
    _check_names("manifest", manifest, [field.name for field in fields(_Manifest)])
    _Manifest(**manifest)
    if manifest["sha256"] != _seal(manifest):
        raise InputError("sha256: got a hash that does not fit the content, want an unchanged file")
    campaign = manifest["campaign"]
    _check_names("campaign", campaign, CAMPAIGN_FIELDS)
    if canonical(manifest["cells"]) != canonical(_cells(campaign)):
        raise InputError("cells: got cells of another campaign, want each sweep, strength and policy")
    pairs = [[sweep, strength] for _, sweep, strength in manifest["cells"]]
    if not isinstance(fixed := manifest["deterministic"], list) or any(pair not in pairs for pair in fixed):
        raise InputError(f"deterministic: got {excerpt(fixed)}, want a list of pairs of a sweep and a strength")
    if set(manifest["policies"]) != set(campaign["policies"]):
        raise InputError(f"policies: got {', '.join(manifest['policies'])}, want {', '.join(campaign['policies'])}")
    for policy, hashes in manifest["policies"].items():
        if hashes.keys() != {"digest", "sha256"}:
            raise InputError(f"policies: {policy}: got {excerpt(dict(hashes))}, want digest and sha256")
    if manifest["digest"] != digest_of_rows(manifest):
        raise InputError("digest: got a hash that does not fit the campaign, want an unchanged file")


def _check_names(field: str, part: Mapping[str, Any], names: Sequence[str]) -> None:
    """Raise InputError unless an object of JSON has exactly these fields."""
    if wrong := sorted(part.keys() ^ set(names)):
        got = f"{'' if wrong[0] in part else 'none of '}{excerpt(wrong[0])}"
        raise InputError(f"{field}: got {got}, want exactly {', '.join(names)}")


def _cells(campaign: Mapping[str, Any]) -> list[list[Any]]:
    """Policy, sweep and strength of each cell, in order. Raises InputError if a field of the campaign is invalid."""
    # Disturbances are left out: they may be a user's, and the user's file is not loaded here.
    bare = Campaign(**{**campaign, "sweeps": dict.fromkeys(campaign["sweeps"], ()), "design_disturbances": None})
    return [[cell.policy, cell.sweep, cell.strength] for cell in bare.cells]


def _seal(manifest: Mapping[str, Any]) -> str:
    return sha256(canonical({name: value for name, value in manifest.items() if name != "sha256"}))


def digest_of_rows(manifest: Mapping[str, Any]) -> str:
    """Hash of everything that the rows and their intervals depend on. A campaign that is begun again has the same."""
    fields = ("cells", "deterministic", "model", "problem", "start", "solution", "code", "versions")
    hashed = {name: manifest[name] for name in fields} | {
        "campaign": {name: value for name, value in manifest["campaign"].items() if name != "time_limit"},
        "policies": {policy: hashes["digest"] for policy, hashes in manifest["policies"].items()},
    }
    return sha256(canonical(hashed))


def digest_of_solution(solution: Solution) -> str:
    """Hash of everything in a solution that its runs depend on, which excludes the log of its solve."""
    plan, policy = solution.trajectory, solution.policy
    goal = np.zeros(0) if solution.goal is None else solution.goal
    arrays = [plan.states, plan.controls, policy.gain, policy.offset, policy.nominal, np.array([plan.dt]), goal]
    if solution.cost_to_go is not None:  # re-planning begins with the cost-to-go and the multipliers
        arrays += [np.asarray(part) for part in vars(solution.cost_to_go).values()]
    arrays += [multiplier.values for multiplier in solution.multipliers]
    rules = policy.state_coordinates.rules, policy.control_coordinates.rules
    return sha256(*(part for array in arrays for part in (f"{array.shape}", array)), *rules)
