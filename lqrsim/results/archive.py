"""Arrays by name and one JSON text in a file: NumPy's .npz, with a hash of its content.

A file may come from anyone. Nothing in it is run. Nothing is unpacked before its size is known to fit the stated shape.
Every exception of a parser becomes a one-line error.
"""

import contextlib
import dataclasses
import enum
import hashlib
import json
import math
import os
import re
import secrets
import time
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import check_string
from lqrsim.errors import InputError, check_path, excerpt, printable

Arrays = dict[str, npt.NDArray[Any]]
META, DIGEST = "meta", "sha256"
UNFINISHED = ".unfinished-"  # beginning of the name of a file that is being written
ABANDONED = 24 * 3600.0  # s since the last change of an unfinished file; no file takes so long to write

# Largest amounts that are read, in bytes, or relative to the size of the file.
_LARGEST_TEXT = 1 << 26
_LARGE, _TIMES = 1 << 30, 100
_DEPTH = 6  # largest depth of lists and objects in `anything`
# NumPy's header of an array of numbers, or of a text; other headers are not parsed.
_HEADER = re.compile(
    rb"\{'descr': '(<f8|<i8|\|b1|<U[0-9]{1,9})', 'fortran_order': False,"
    rb" 'shape': \(([0-9]{1,18}(?:, [0-9]{1,18})*,?)?\), \} *\n"
)


def sha256(*parts: str | bytes | npt.NDArray[np.generic] | np.generic) -> str:
    """SHA-256 of the concatenated parts, in hexadecimal: text as UTF-8, arrays as their numbers in C order.

    There is no separator. If shape or type of an array may differ, put them before it as text: they do not count.
    """
    hasher = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            hasher.update(part.encode())
        elif isinstance(part, bytes):
            hasher.update(part)
        else:  # a view of its bytes, because a copy may be large
            hasher.update(np.ascontiguousarray(part).reshape(-1).view(np.uint8).data)
    return hasher.hexdigest()


def parse(text: str | bytes) -> Any:
    """Parse a JSON text. Raises ValueError if it is not JSON, is nested too deeply, or repeats a name in an object."""
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError:
        raise ValueError("lists or objects too deep within each other") from None


def canonical(value: Any) -> str:
    """The canonical JSON text of a value: sorted names, no spaces. Raises TypeError or ValueError."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def plain(value: Any) -> Any:
    """Convert a value to types of JSON; null for numbers that are not finite."""
    if hasattr(value, "tolist"):  # an array or a number of NumPy
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        raise ValueError("a name twice in one object")
    return members


def anything(field: str, value: Any, depth: int = _DEPTH) -> Any:
    """Any JSON value, with a limit on the depth of lists and objects."""
    if isinstance(value, str):
        return check_string(field, value)
    if isinstance(value, list | dict):
        if depth == 0:
            raise InputError(f"{field}: got more nested lists or objects, want at most {_DEPTH}")
        if isinstance(value, list):
            return [anything(f"{field}[{i}]", item, depth - 1) for i, item in enumerate(value)]
        return {
            check_string(f"{field}: a name", name): anything(f"{field}.{name}", entry, depth - 1)
            for name, entry in value.items()
        }
    return value


class Header(NamedTuple):
    """The header of an array: NumPy's name for the type of its numbers, and the shape."""

    dtype: str
    shape: tuple[int, ...]


class Other(InputError):
    """The exception for an intact file of another format or version."""


def digest(arrays: Mapping[str, npt.NDArray[Any]], meta: Mapping[str, Any]) -> str:
    """SHA-256 of the JSON text without its hash, and of each array with its name, type and shape."""
    parts: list[str | npt.NDArray[Any]] = [canonical({name: value for name, value in meta.items() if name != DIGEST})]
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        parts += [f"\n{name} {array.dtype.str} {array.shape}\n", array]
    return sha256(*parts)


def write(path: Path, arrays: Mapping[str, npt.NDArray[Any]], meta: Mapping[str, Any]) -> None:
    """Write arrays and text with their hash, all or nothing. Raises InputError if this fails."""
    text = np.array(canonical({**meta, DIGEST: digest(arrays, meta)}))
    if text.nbytes > _LARGEST_TEXT:
        raise InputError(f"output: got {text.nbytes:,} bytes of text for {path}, want at most {_LARGEST_TEXT:,}")
    entries: dict[str, Any] = {META: text, **{name: np.ascontiguousarray(array) for name, array in arrays.items()}}
    with replacing(path) as unfinished:
        for save in (np.savez_compressed, np.savez):
            # Through a file object: given a name, NumPy appends .npz to it.
            with unfinished.open("wb") as file:
                save(file, allow_pickle=False, **entries)
            if sum(array.nbytes for array in entries.values()) < _limit(unfinished.stat().st_size):
                break  # otherwise the file is compressed so well that reading would refuse it as a zip bomb


class Archive:
    """A file that is open for reading, of which the arrays have not been read yet."""

    def __init__(self, archive: zipfile.ZipFile, size: int) -> None:
        self._archive = archive
        self._members: dict[str, zipfile.ZipInfo] = {}
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if name == member.filename or member.orig_filename != member.filename:
                raise InputError(f"{excerpt(member.orig_filename)}: got a part that is no array, want arrays only")
            if name in self._members:
                raise InputError(f"{excerpt(name)}: got two parts of this name, want one")
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or member.flag_bits & 0x1:
                raise InputError(f"{excerpt(name)}: got an array in another compression, want it deflated or stored")
            self._members[name] = member
        if META not in self._members:
            raise InputError(f"{META}: got a file without it, want a file that lqrsim wrote")
        if (total := sum(member.file_size for member in self._members.values())) > _limit(size):
            raise InputError(f"size: got {total:,} bytes, want at most {_limit(size):,} in a file of {size:,}")
        self.headers = {name: self._header(name) for name in self._members if name != META}
        self.meta = self._text()  # unchecked

    def arrays(self) -> Arrays:
        """All arrays. Raises InputError unless the hash of the content is the hash in the file."""
        arrays = {name: self._array(name) for name in self.headers}
        if self.meta.get(DIGEST) != digest(arrays, self.meta):
            raise InputError(f"{DIGEST}: got another hash than that of the content, want an unchanged file")
        return arrays

    def _header(self, name: str) -> Header:
        with self._archive.open(self._members[name]) as file:
            start = file.read(10)
            length = int.from_bytes(start[8:10], "little")
            match = _HEADER.fullmatch(file.read(length)) if start[:8] == b"\x93NUMPY\x01\x00" else None
        if match is None:
            raise InputError(f"{excerpt(name)}: got an array in another format, want one that lqrsim wrote")
        shape = tuple(int(length) for length in (match[2] or b"").decode().replace(",", " ").split())
        dtype = match[1].decode()
        bytes_each = 4 * int(dtype[2:]) if dtype.startswith("<U") else int(dtype[2:])
        if 10 + length + math.prod(shape) * bytes_each != self._members[name].file_size or len(shape) > 32:
            raise InputError(f"{excerpt(name)}: got a size that does not fit, want the size of {excerpt(shape)}")
        return Header(dtype, shape)

    def _text(self) -> dict[str, Any]:
        header, size = self._header(META), self._members[META].file_size
        if not header.dtype.startswith("<U") or header.shape or size > _LARGEST_TEXT:
            raise InputError(f"{META}: got {header.dtype} of shape {header.shape}, want one text")
        meta = parse(str(self._array(META)))
        if not isinstance(meta, dict):
            raise InputError(f"{META}: got {excerpt(meta)}, want an object")
        return meta

    def _array(self, name: str) -> npt.NDArray[Any]:
        with self._archive.open(self._members[name]) as file:
            array = np.lib.format.read_array(file, allow_pickle=False, max_header_size=1000)
            if file.read(1):  # reads to the end, where zipfile compares the checksum
                raise InputError(f"{excerpt(name)}: got more bytes than its shape takes, want exactly as many")
        array.setflags(write=False)  # so that the record that gets it makes no copy
        return array


@contextlib.contextmanager
def opened(path: Path, kind: str | None, versions: Mapping[str, tuple[int, ...]]) -> Iterator[Archive]:
    """Open a file of this kind, or of any in `versions`, in one of its versions there.

    Exceptions in the block are reported as faults of the file.
    """
    field = kind or "path"
    with blamed(path, field), path.open("rb") as file, zipfile.ZipFile(file) as archive:
        reader = Archive(archive, os.fstat(file.fileno()).st_size)
        said = reader.meta.get("format")
        wanted = [f"lqrsim {name}" for name in versions if kind in (None, name)]
        if said not in wanted:
            names = " or ".join(repr(label) for label in wanted)
            raise Other(f"{field}: got {path}, which holds a {excerpt(said)}, want a {names}")
        known = versions[str(said).removeprefix("lqrsim ")]
        if (version := reader.meta.get("version")) not in known:
            raise of_other_version(path, field, version, known)
        yield reader


def of_other_version(path: Path, field: str, version: object, known: tuple[int, ...]) -> Other:
    """The exception for a file of another version than the known ones."""
    want = " or ".join(map(str, known))
    return Other(f"{field}: got {path} of version {excerpt(version)}, want version {want}: write it again")


@contextlib.contextmanager
def blamed(path: Path, kind: str) -> Iterator[None]:
    """Turn any exception from reading `path` into one line about the file.

    Parsers raise exceptions of all kinds for foreign bytes. Everything is therefore caught here, and only here.
    """
    if not os.path.isfile(path):  # not the method of Path, which raises for names that are too long
        raise InputError(f"{kind}: got {excerpt_of(path)}, want a file that exists")
    try:
        yield
    except Other:
        raise
    except OSError as error:
        raise InputError(f"{kind}: got {path}, want a file that can be read ({error.strerror or error})") from None
    except Exception as error:
        reason = f"{error}" if isinstance(error, InputError) else f"{type(error).__name__}: {excerpt(str(error))}"
        raise InputError(f"{kind}: got {path}, which is damaged ({reason}), want a file that lqrsim wrote") from None


def excerpt_of(path: Path) -> str:
    """A path for a message, as printable text; a long one is cut in the middle."""
    name = printable(str(path))
    return name if len(name) <= 200 else f"{name[:80]}...{name[-80:]}"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file to write to, which replaces `path` when the block ends and is removed if the block fails.

    Files that a killed process has left in the same folder are removed once they are a day old.
    """
    check_path("output", path)
    try:
        target = Path(os.path.realpath(path))  # the target of a link is replaced, not the link
    except OSError as error:  # the working folder was removed
        got = excerpt_of(path)
        raise InputError(f"output: got {got}, want a file that can be written ({error.strerror})") from None
    looped = target.is_symlink()  # after all links have been followed
    if looped or (target.exists() and not target.is_file()):
        existing = "a folder" if target.is_dir() else "a link to itself" if looped else "neither a file nor a folder"
        raise InputError(f"output: got {excerpt_of(path)}, which is {existing}, want the name of a regular file")
    # A random name, so that two writers do not collide. It is known before the file exists, so that Ctrl-C at any
    # moment removes the file. The suffix stays, because writers choose the format by it.
    unfinished = target.parent / f"{UNFINISHED}{secrets.token_hex(8)}{path.suffix}"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(target.parent)
        unfinished.touch(exist_ok=False)
        yield unfinished
        unfinished.replace(target)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"output: got {excerpt_of(path)}, want a file that can be written ({reason})") from None
    finally:
        with contextlib.suppress(OSError):  # the error that matters has been raised already
            unfinished.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8, all or nothing."""
    with replacing(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8", newline="\n")


def _remove_abandoned(folder: Path) -> None:
    """Remove files of `replacing` that killed processes have left, after a day without a change."""
    oldest = time.time() - ABANDONED
    for path in folder.glob(f"{UNFINISHED}{'[0-9a-f]' * 16}*"):
        with contextlib.suppress(OSError):  # another process may have removed it
            if path.stat(follow_symlinks=False).st_mtime < oldest:
                path.unlink()


def _limit(size: int) -> int:
    """The largest number of bytes that a file of this size may hold."""
    return max(_LARGE, _TIMES * size)
