"""Results on disk: arrays by the paths of their fields, and everything else as JSON with the structure of the record.

`docs/file_format.md` describes the files, and shows how to load a policy with NumPy alone. The annotations of the
records state the permitted contents of a file; see `annotations.py`. `save` and `load` check this.
"""

import enum
import os
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, overload

import numpy as np

from lqrsim.annotations import Declared, Sizes, check_sizes, declarations, declared
from lqrsim.errors import InputError, check_kind, check_name, check_path, excerpt
from lqrsim.results import archive
from lqrsim.results.certified import FailureCertificate, Funnel
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.policy import AffinePolicy, OutputFeedbackPolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution

Saved = Solution | Rollout | AffinePolicy | OutputFeedbackPolicy | Funnel | FailureCertificate
_Kind = TypeVar("_Kind", Solution, Rollout, AffinePolicy, OutputFeedbackPolicy, Funnel, FailureCertificate)

# The name in the file, and the version.
FORMATS: dict[type, tuple[str, int]] = {
    Solution: ("solution", 7),
    Rollout: ("rollout", 5),
    AffinePolicy: ("policy", 2),
    OutputFeedbackPolicy: ("output feedback policy", 1),
    Funnel: ("funnel", 2),
    FailureCertificate: ("certificate", 2),
}
# A file in which an entry of a rotation vector is an angle, a turn about its axis, has the next version, for lqrsim 0.2
# would read it as part of the vector. When a version is raised, it is by two.
VERSIONS = {name: (version, version + 1) for name, version in FORMATS.values()}


def save(result: Saved, path: str | os.PathLike[str]) -> Path:
    """Write a solution, a rollout, a policy, a funnel or a certificate, all or nothing. Returns its path.

    If the path is a link, the file that it points to changes. Only regular files are replaced.
    """
    path = check_path("output", path)
    archive.write(path, *_content(result))
    return path


def hash_of(result: Saved) -> str:
    """The `sha256` of the file that `save` would write. Raises InputError as `save` does."""
    return archive.digest(*_content(result))


def _content(result: Saved) -> tuple[archive.Arrays, dict[str, Any]]:
    """The arrays and the JSON tree of a file. Raises InputError if the result could not be read again."""
    kinds = ", ".join(f"{'an' if kind.__name__[0] in 'AO' else 'a'} {kind.__name__}" for kind in FORMATS)
    check_kind("result", result, tuple(FORMATS), f"one of: {kinds}")
    kind = next(kind for kind in FORMATS if isinstance(result, kind))
    name, version = FORMATS[kind]
    arrays: archive.Arrays = {}
    try:
        tree = archive.parse(archive.canonical(tree_of(result, "", arrays)))
        _check_arrays(kind, {name: archive.Header(array.dtype.str, array.shape) for name, array in arrays.items()})
        record_from(kind, tree, "", dict(arrays))
    except (TypeError, ValueError) as error:
        reason = f"which cannot be written ({error})"
        raise InputError(f"result: got a {name}, {reason}, want an unchanged result of lqrsim") from None
    return arrays, {"format": f"lqrsim {name}", "version": version + _has_turns(result), **tree}


@overload
def load(path: str | os.PathLike[str]) -> Saved: ...
@overload
def load(path: str | os.PathLike[str], kind: type[_Kind]) -> _Kind: ...
def load(path: str | os.PathLike[str], kind: type[Saved] | None = None) -> Saved:
    """The result that `save` wrote. Loading never runs code.

        solution = ls.load("plan.npz", ls.Solution)

    Args:
      kind: the required kind: `ls.Solution`, `ls.Rollout`, `ls.AffinePolicy`, `ls.types.OutputFeedbackPolicy`,
        `ls.types.Funnel` or `ls.stress.FailureCertificate`. By default, any.
    """
    if kind is not None and not any(kind is allowed for allowed in FORMATS):  # it may have no hash
        homes = {OutputFeedbackPolicy: "types.", Funnel: "types.", FailureCertificate: "stress."}
        names = (f"ls.{homes.get(allowed, '')}{allowed.__name__}" for allowed in FORMATS)
        raise InputError(f"kind: got {excerpt(kind)}, want one of {', '.join(names)}")
    wanted = None if kind is None else FORMATS[kind][0]
    path = check_path(wanted or "path", path)
    if path.is_dir():
        known = "; the folder of a campaign is opened with ls.stress.Results(folder)"
        raise InputError(f"{wanted or 'path'}: got {path}, a folder, want a file{known}")
    with archive.opened(path, wanted, VERSIONS) as file:
        format_name = str(file.meta["format"]).removeprefix("lqrsim ")
        kind = next(kind for kind, (name, _) in FORMATS.items() if name == format_name)
        _check_arrays(kind, file.headers)
        outside = ("format", "version", "sha256")
        arrays, tree = file.arrays(), {name: entry for name, entry in file.meta.items() if name not in outside}
        record = record_from(kind, tree, "", arrays)
        if arrays:
            raise InputError(f"{min(arrays)}: got an array that meta does not mention, want it mentioned there")
        if (version := file.meta["version"]) != (expected := VERSIONS[format_name][_has_turns(record)]):
            raise archive.of_other_version(path, format_name, version, (expected,))
        return record


def _has_turns(value: Any) -> bool:
    """Whether coordinates in a record have a rotation vector of which one entry is an angle."""
    if isinstance(value, Coordinates):
        return max(value.turns, default=-1) >= 0
    inside = (getattr(value, name) for name in declarations(type(value))) if is_dataclass(value) else value
    return any(map(_has_turns, inside)) if is_dataclass(value) or isinstance(value, tuple) else False


def tree_of(value: Any, path: str, arrays: archive.Arrays) -> Any:
    """The JSON tree of a value, for `record_from`. Its arrays are put into `arrays`, by the paths of their fields."""
    if is_dataclass(value):
        tree = {}
        for name in declarations(type(value)):
            inner, field = getattr(value, name), _join(path, name)
            if isinstance(inner, np.ndarray):
                arrays[field] = np.ascontiguousarray(inner)
            else:
                tree[name] = tree_of(inner, field, arrays)
        return tree
    if isinstance(value, tuple):
        return [tree_of(item, _join(path, i), arrays) for i, item in enumerate(value)]
    return dict(value) if isinstance(value, Mapping) else value


def _check_arrays(kind: type, headers: Mapping[str, archive.Header]) -> None:
    """Raises InputError unless each array belongs to a record of this kind, with its type and sizes."""
    sizes: Sizes = {}
    for name, header in headers.items():
        said = _declared_at(kind, name)
        if said is None or said.dtype is None:
            raise InputError(f"{excerpt(name)}: got an unknown array, want only arrays of this format")
        if header.dtype != (dtype := np.dtype(said.dtype).str):
            raise InputError(f"{name}: got numbers of type {header.dtype}, want {dtype}")
        check_sizes(name, header.shape, said.letters, {} if said.letters.startswith("...") else sizes)


def _declared_at(kind: type, path: str) -> Declared | None:
    """The declaration at a path of fields of a record; None if there is none."""
    declaration, kinds = None, (kind,)
    for name in path.split("."):
        if name.isascii() and name.isdigit():
            inside = [declared(get_args(choice)[0]) for choice in kinds if get_origin(choice) is tuple]
        else:
            records = [declarations(choice) for choice in kinds if is_dataclass(choice)]
            inside = [record[name] for record in records if name in record]
        declaration = inside[0] if inside else None
        kinds = declaration.kinds if declaration else ()
    return declaration


def record_from(kind: Any, tree: Any, path: str, arrays: archive.Arrays) -> Any:
    """Build a record of this kind from a file, taking its arrays out of `arrays`. Raises InputError if it cannot."""
    if not isinstance(tree, dict):
        raise InputError(f"{path}: got {excerpt(tree)}, want an object")
    known = declarations(kind)
    if unknown := sorted(tree.keys() - known.keys()):
        raise InputError(f"{path or 'meta'}: got {excerpt(unknown[0])}, want only {', '.join(known)}")
    values = {}
    # A field that is added later has a default: older files of the same version lack it.
    needed = {field.name for field in fields(kind) if field.default is field.default_factory is MISSING}
    for name, said in known.items():
        field = _join(path, name)
        if name in tree:
            values[name] = _value(said, tree[name], field, arrays)
        elif said.dtype is not None and field in arrays:
            values[name] = arrays.pop(field)
        elif name in needed:
            raise InputError(f"{field}: got nothing, want this field")
    if kind is AffinePolicy and not (np.isfinite(values["gain"]).all() and np.isfinite(values["offset"]).all()):
        raise InputError(f"{_join(path, 'gain')}: got NaN or infinity in gain or offset, want finite numbers")
    try:
        return kind(**values)
    except InputError as error:
        raise InputError(f"{path}: {error}" if path else f"{error}") from None


def _value(said: Declared, tree: Any, path: str, arrays: archive.Arrays) -> Any:
    """Build the value of a field; the constructor of its record checks the rest."""
    if tree is None and said.optional:
        return None
    kind = said.kinds[0]
    if len(said.kinds) > 1:  # records that are told apart by their arrays
        kind = next((choice for choice in said.kinds if _join(path, next(iter(declarations(choice)))) in arrays), kind)
    if is_dataclass(kind):
        return record_from(kind, tree, path, arrays)
    if get_origin(kind) is tuple:
        if not isinstance(tree, list):
            raise InputError(f"{path}: got {excerpt(tree)}, want a list")
        inner = declared(get_args(kind)[0])
        return tuple(_value(inner, item, _join(path, i), arrays) for i, item in enumerate(tree))
    if isinstance(kind, type) and issubclass(kind, enum.Enum):
        named = tree[:100] if isinstance(tree, str) else tree
        return kind(check_name(path, named, [str(member.value) for member in kind]))
    if said.dtype is not None:
        raise InputError(f"{path}: got {excerpt(tree)} in meta, want an array")
    return archive.anything(path, tree)


def _join(path: str, name: str | int) -> str:
    return f"{path}.{name}" if path else f"{name}"
