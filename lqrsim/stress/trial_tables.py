"""Tables of trials as parquet files: written whole or not at all, and checked when they are read.

A file has the columns of `Outcomes`, and `reason`, the cause of an error. Its metadata names the campaign, the cell and
the trials, and has a hash of these and of the columns.
"""

import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from lqrsim.results.hashing import sha256
from lqrsim.results.save_load import replacing
from lqrsim.stress.specification import Shard

Table = dict[str, npt.NDArray[np.generic]]
_KEY = b"lqrsim shard"


class Damaged(Exception):
    """A file that differs from what was written."""


def pack(table: Table, shard: Shard, campaign: str) -> bytes:
    """Encode a table as a file; `campaign` is the digest of its campaign."""
    about = _about(shard, campaign)
    meta = json.dumps(about | {"sha256": _digest(table, about)}).encode()
    arrow = pa.table({name: pa.array(column) for name, column in table.items()}).replace_schema_metadata({_KEY: meta})
    file = io.BytesIO()
    pq.write_table(arrow, file, write_page_checksum=True)
    return file.getvalue()


def unpack(contents: bytes, shard: Shard, campaign: str) -> Table:
    """Decode a table. Raises Damaged unless it is, to the bit, what `pack` was given for this shard."""
    about = _about(shard, campaign)
    try:
        file = pq.ParquetFile(io.BytesIO(contents), page_checksum_verification=True)
        if file.metadata.num_rows != shard.count:  # checked before memory is allocated for the rows
            raise ValueError(f"{file.metadata.num_rows} rows")
        arrow = file.read(use_threads=False)
        meta = json.loads((arrow.schema.metadata or {})[_KEY])
        table = {name: _column(arrow[name]) for name in arrow.column_names}
        good = meta == about | {"sha256": _digest(table, about)}
    except Exception as error:  # a parser may raise anything for damaged bytes
        raise Damaged(" ".join(f"{type(error).__name__}: {error}".split())[:200]) from None
    if not good or any(len(column) != shard.count for column in table.values()):
        raise Damaged("its contents have changed")
    return table


def write(contents: bytes, path: Path) -> None:
    """Write a file to the disk, whole or not at all. Raises InputError if it cannot, as on a full disk."""
    with replacing(path) as unfinished, unfinished.open("wb") as file:
        file.write(contents)
        file.flush()
        os.fsync(file.fileno())


def read(path: Path, shard: Shard, campaign: str) -> Table:
    """Read the table of a file. Raises Damaged if it has changed or cannot be read."""

    try:
        contents = path.read_bytes()
    except OSError as error:
        raise Damaged(f"it cannot be read ({error.strerror or error})") from None
    return unpack(contents, shard, campaign)


def _about(shard: Shard, campaign: str) -> dict[str, Any]:
    return {"campaign": campaign, "cell": shard.cell, "first": shard.first, "count": shard.count}


def _column(column: pa.ChunkedArray) -> npt.NDArray[np.generic]:
    if pa.types.is_string(column.type):
        return np.array(column.to_pylist(), dtype=np.str_)
    return column.to_numpy()


def _digest(table: Table, about: Mapping[str, Any]) -> str:
    parts: list[str | bytes] = [json.dumps(about)]
    for name, column in table.items():
        text = column.dtype.kind == "U"
        kind = "text" if text else column.dtype.str
        data = json.dumps(column.tolist()).encode() if text else np.ascontiguousarray(column).tobytes()
        parts += [f"{name} {kind} {len(data)}:", data]
    return sha256(*parts)
