"""The hash of arrays and text that all files, caches and digests use."""

import hashlib

import numpy as np
import numpy.typing as npt


def sha256(*parts: str | bytes | npt.NDArray[np.generic] | np.generic) -> str:
    """SHA-256 of the concatenated parts, in hexadecimal: text as UTF-8, arrays as their numbers in C order.

    There is no separator, and an array's shape and type do not count: where they may differ, put them before the array
    as text.
    """
    hasher = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            hasher.update(part.encode())
        elif isinstance(part, bytes):
            hasher.update(part)
        else:  # a view of its bytes, for a copy may be large
            hasher.update(np.ascontiguousarray(part).reshape(-1).view(np.uint8).data)
    return hasher.hexdigest()
