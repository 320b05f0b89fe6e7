"""A cache on disk, by content: compiled functions, and sources traced from formulas.

An item's name is a hash of everything that it depends on, so it cannot be stale. Its first line contains a checksum, so
a damaged item counts as missing. A cache that cannot be read or written costs time, never an error. When the items
exceed `LIMIT`, the least recently used are removed, now and then.

Items are programs: compiled functions are run, and sources are executed. The checksum protects against damage, not
against people: anyone who can write to the folder can run code in the name of its readers.
"""

import contextlib
import json
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import platformdirs

from lqrsim.errors import InputError
from lqrsim.results.archive import UNFINISHED, replacing, sha256

LIMIT = 512 * 1024 * 1024  # bytes; a solver for a system of 12 states takes about 100 kB
_SUFFIX = ".item"
# The items after which the cache is shrunk begin so. Names are hashes: one in 256 does, after some 25 MB of solvers.
_SHRINKING = "00"
_LONGEST = 100_000  # largest size in bytes of a header

Made = TypeVar("Made")
logger = logging.getLogger("lqrsim")


@dataclass(frozen=True)
class Item:
    """An item of the cache: its description, its size in bytes, and the time of its last use (seconds since 1970)."""

    what: str
    path: Path
    size: int
    used: float


def folder() -> Path:
    """The folder of the items: $LQRSIM_CACHE_DIR, or the user's cache folder."""
    override = os.environ.get("LQRSIM_CACHE_DIR")
    return Path(override).expanduser() if override else Path(platformdirs.user_cache_dir("lqrsim", appauthor=False))


def key(*parts: str | bytes) -> str:
    """An item's name, from the parts that it depends on, in order."""
    encoded = [part.encode() if isinstance(part, str) else part for part in parts]
    return sha256(*(piece for part in encoded for piece in (f"{len(part)}:", part)))[:32]


def load(name: str) -> tuple[bytes, dict[str, Any]] | None:
    """The contents of an item, and their details; None if it is missing, damaged or cannot be read."""
    path = folder() / f"{name}{_SUFFIX}"
    try:
        header, _, contents = path.read_bytes().partition(b"\n")
    except OSError:
        return None
    header_fields = _object_of(header)
    details = header_fields.get("details", {})
    if header_fields.get("sha256") != sha256(json.dumps(details), contents):
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # marks it as used now
    return contents, details


def made_of(stored: tuple[bytes, dict[str, Any]] | None, make: Callable[[bytes, dict[str, Any]], Made]) -> Made | None:
    """What `make` makes of an item; None if there is none, or it cannot be used, as of another compiler."""
    try:
        return None if stored is None else make(*stored)
    except (ValueError, KeyError, TypeError, RuntimeError, RecursionError) as error:
        logger.debug(f"a cached item cannot be used ({error})")
        return None


def save(name: str, contents: bytes, what: str, **details: Any) -> None:
    """Store an item if possible, with details of its contents; two processes may store the same one."""
    header = json.dumps({"what": what, "details": details, "sha256": sha256(json.dumps(details), contents)}).encode()
    with contextlib.suppress(OSError, InputError):
        with replacing(folder() / f"{name}{_SUFFIX}") as unfinished:
            unfinished.write_bytes(header + b"\n" + contents)
        if name.startswith(_SHRINKING):
            _shrink()


def _object_of(text: bytes) -> dict[str, Any]:
    """The object of a JSON text, such as the header in an item's first line; empty if it is damaged."""
    try:
        fields = json.loads(text[:_LONGEST])
    except (ValueError, RecursionError):
        return {}
    return fields if isinstance(fields, dict) else {}


def items() -> list[Item]:
    """All items, the most recently used first."""
    cached = []
    for used, path, size in _files():
        with contextlib.suppress(OSError), path.open("rb") as file:
            description = _object_of(file.readline(_LONGEST)).get("what", "damaged; will be made again")
            cached.append(Item(str(description), path, size, used))
    return sorted(cached, key=lambda item: -item.used)


def clear() -> int:
    """Remove all items and unfinished files; return the number of items. Raises OSError if one cannot be removed."""
    removed = items()
    for path in [*(item.path for item in removed), *folder().glob(f"{UNFINISHED}*")]:
        path.unlink(missing_ok=True)
    return len(removed)


def _shrink() -> None:
    """Remove the least recently used items beyond `LIMIT`. It opens no file: there may be tens of thousands."""
    files = _files()
    total = sum(size for _, _, size in files)
    for _, path, size in sorted(files) if total > LIMIT else ():
        if total <= LIMIT:
            break
        path.unlink(missing_ok=True)
        total -= size


def _files() -> list[tuple[float, Path, int]]:
    """The times of the last use of all items, in seconds since 1970, their files, and their sizes in bytes."""
    files = []
    with contextlib.suppress(OSError):
        for path in folder().glob(f"[!.]*{_SUFFIX}"):
            with contextlib.suppress(OSError):  # another process may have removed it
                status = path.stat()
                files.append((status.st_mtime, path, status.st_size))
    return files
