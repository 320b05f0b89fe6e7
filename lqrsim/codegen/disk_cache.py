"""What took long to make, kept on disk by content: compiled functions, and the sources traced from formulas.

An item's name is a hash of all that it depends on, so an item cannot be stale; its first line is a checksum, so a
damaged one is as good as none. A cache that cannot be read or written costs time, never an error. When the items
outgrow `LIMIT`, those that were used longest ago go.

Items are programs: compiled functions are run, and sources are executed. The checksum keeps off damage, not people.
Who can write the folder can have code run by whoever reads it: share it with nobody whom you do not trust.
"""

import contextlib
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from lqrsim.errors import InputError
from lqrsim.results.archive import replacing
from lqrsim.results.hashing import sha256

LIMIT = 512 * 1024 * 1024  # bytes; a solver for a system of 12 states takes about 100 kB
_SUFFIX = ".item"
_DURATIONS = "durations.json"
_LONGEST_HEADER = 10_000  # bytes
_ABANDONED = 3600.0  # s, after which a file that is not finished never will be


@dataclass(frozen=True)
class Item:
    """One thing in the cache: what it is, its size in bytes, and when it was last used (seconds since 1970)."""

    what: str
    path: Path
    size: int
    used: float


def folder() -> Path:
    """Where the items are: $LQRSIM_CACHE_DIR, or the user's cache folder."""
    override = os.environ.get("LQRSIM_CACHE_DIR")
    return Path(override).expanduser() if override else Path(platformdirs.user_cache_dir("lqrsim", appauthor=False))


def key(*parts: str | bytes) -> str:
    """A name for what is made of these parts, in this order."""
    encoded = [part.encode() if isinstance(part, str) else part for part in parts]
    return sha256(*(piece for part in encoded for piece in (f"{len(part)}:", part)))[:32]


def load(name: str) -> bytes | None:
    """The contents of an item; None if there is none, or it is damaged or cannot be read."""
    path = folder() / f"{name}{_SUFFIX}"
    try:
        header, _, contents = path.read_bytes().partition(b"\n")
    except OSError:
        return None
    if _described(header).get("sha256") != sha256(contents):
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # it was used now
    return contents


def save(name: str, contents: bytes, what: str) -> None:
    """Keep an item if that is possible; two processes that keep the same one do not disturb each other."""
    header = json.dumps({"what": what, "sha256": sha256(contents)}).encode()
    with contextlib.suppress(OSError, InputError):
        with replacing(folder() / f"{name}{_SUFFIX}") as unfinished:
            unfinished.write_bytes(header + b"\n" + contents)
        _shrink()


def note(name: str, seconds: float) -> None:
    """Keep how long something took on this machine, if that is possible; the last time counts."""
    with contextlib.suppress(OSError, InputError, ValueError), replacing(folder() / _DURATIONS) as unfinished:
        unfinished.write_text(json.dumps(_durations() | {name: seconds}), encoding="utf-8")


def noted(name: str) -> float | None:
    """How many seconds that took the last time; None if that is not known."""
    seconds = _durations().get(name)
    return seconds if isinstance(seconds, float) and 0 < seconds < 1e5 else None


def _durations() -> dict[str, object]:
    try:
        found = json.loads((folder() / _DURATIONS).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _described(header: bytes) -> dict[str, object]:
    """What the first line of an item says; nothing if it is damaged."""
    try:
        found = json.loads(header[:_LONGEST_HEADER])
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def items() -> list[Item]:
    """What there is, the last used first."""
    found = []
    for path in _files(f"[!.]*{_SUFFIX}"):
        with contextlib.suppress(OSError):  # another process may remove it meanwhile
            status = path.stat()
            with path.open("rb") as file:
                what = _described(file.readline(_LONGEST_HEADER)).get("what", "damaged; it will be made again")
            found.append(Item(str(what), path, status.st_size, status.st_mtime))
    return sorted(found, key=lambda item: -item.used)


def clear() -> int:
    """Remove all items, and what was left unfinished; how many items there were. Raises OSError if one stays."""
    removed = items()
    for path in [*(item.path for item in removed), *_unfinished(0.0)]:
        path.unlink(missing_ok=True)
    with contextlib.suppress(NotADirectoryError):
        (folder() / _DURATIONS).unlink(missing_ok=True)
    return len(removed)


def _shrink() -> None:
    """Remove what was used longest ago, as far as there is too much, and what killed processes left."""
    found = []
    for path in _files(f"[!.]*{_SUFFIX}"):
        with contextlib.suppress(OSError):  # another process may remove it meanwhile
            status = path.stat()
            found.append((status.st_mtime, status.st_size, path))
    total = 0
    for _, size, path in sorted(found, reverse=True):
        total += size
        if total > LIMIT:
            path.unlink(missing_ok=True)
    for path in _unfinished(_ABANDONED):
        path.unlink(missing_ok=True)


def _files(pattern: str) -> list[Path]:
    try:
        return list(folder().glob(pattern))
    except OSError:  # a folder that may not be looked into
        return []


def _unfinished(age: float) -> list[Path]:
    """What a process that was killed did not finish, at least `age` seconds ago."""
    found = []
    for path in _files(".unfinished-*"):
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime >= age:
                found.append(path)
    return found
