"""Files of lqrsim changed as another program could change them, with a matching hash or the old one."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np


def content_hash(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> str:
    """A file's content hash, computed as docs/file_format.md describes it, not by the package."""
    text = json.dumps({k: v for k, v in meta.items() if k != "sha256"}, sort_keys=True, separators=(",", ":"))
    found = hashlib.sha256(text.encode())
    for name, array in sorted(arrays.items()):
        found.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode() + array.tobytes())
    return found.hexdigest()


def contents(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    with np.load(path) as archive:
        arrays = dict(archive)
    return arrays, json.loads(str(arrays.pop("meta")))


def rewrite(path: Path, *, sealed: Any = True, **changes: Any) -> None:
    """Change a file as another program could: with a matching hash, or the old one.

    An array replaces one, None takes one out, and a function changes it; anything else is metadata, by its path.
    """
    arrays, meta = contents(path)
    for name, change in changes.items():
        if name in arrays:
            array = arrays.pop(name)
            if change is not None:
                changed: Any = change(array) if callable(change) else change
                arrays[name] = np.asarray(changed)
        elif isinstance(change, np.ndarray):
            arrays[name] = change
        else:
            *outer, last = name.split(".")
            inner: Any = meta
            for part in outer:
                inner = inner[int(part) if part.isdigit() else part]
            inner[last] = change(inner[last]) if callable(change) else change
    if sealed:
        meta["sha256"] = content_hash(arrays, meta)
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, meta=np.array(json.dumps(meta)), **arrays)
