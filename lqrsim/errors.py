"""The one exception that bad input raises, and the checks that raise it.

Every message is one line that names the field, what it got and what it wanted (and, where there is a
list to choose from, the valid names). The command line prints that line and exits with 2.
"""

import difflib
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating]


class InputError(ValueError):
    """Something a caller passed is wrong; the message is one line that says what and what to do."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))  # what a user's function says may have several


def check_array(field: str, value: npt.ArrayLike, shape: tuple[int | None, ...], *, infinite: bool = False) -> Array:
    """`value` as a read-only C-ordered float64 copy of the given shape (None matches any length).

    Raises:
      InputError: not numeric, the wrong shape, or a NaN (or, unless allowed, infinite) entry.
    """
    try:
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        raise InputError(f"{field}: got {excerpt(value)}, want numbers of shape {_shape(shape)}") from None
    if len(array.shape) != len(shape) or any(
        want is not None and got != want for got, want in zip(array.shape, shape, strict=True)
    ):
        raise InputError(f"{field}: got shape {_shape(array.shape)}, want {_shape(shape)}")
    bad = np.isnan(array) if infinite else ~np.isfinite(array)
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        place = f" at index {list(where)}" if where else ""
        raise InputError(f"{field}: got {array[where]}{place}, want {'a number' if infinite else 'finite numbers'}")
    array.setflags(write=False)
    return array


def check_number(
    field: str,
    value: object,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
) -> float:
    """`value` as a finite float within the stated bounds. Raises InputError otherwise."""
    wants = ["a finite number"]
    wants += [f"> {above:g}"] if above is not None else []
    wants += [f">= {at_least:g}"] if at_least is not None else []
    wants += [f"<= {at_most:g}"] if at_most is not None else []
    wants += [f"< {below:g}"] if below is not None else []
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        number = float("nan")
    good = (
        np.isfinite(number)
        and (above is None or number > above)
        and (at_least is None or number >= at_least)
        and (at_most is None or number <= at_most)
        and (below is None or number < below)
    )
    if not good:
        raise InputError(f"{field}: got {excerpt(value)}, want {' '.join(wants)}")
    return number


def check_count(field: str, value: object, *, at_least: int = 1) -> int:
    """`value` as an int that is not smaller than `at_least`. Raises InputError otherwise."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < at_least:
        raise InputError(f"{field}: got {excerpt(value)}, want a whole number >= {at_least}")
    return int(value)


def check_weight(field: str, value: npt.ArrayLike, size: int | None = None, *, definite: bool = False) -> Array:
    """`value` as a symmetric positive-semidefinite (or definite) matrix; a vector is read as its diagonal.

    Raises:
      InputError: wrong shape, NaN or infinite entries, not symmetric, or an eigenvalue of the wrong sign.
    """
    try:
        raw = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{field}: got {excerpt(value)}, want a matrix of numbers or its diagonal") from None
    matrix = check_array(field, np.diag(raw) if raw.ndim == 1 else raw, (size, size))
    if matrix.shape[0] != matrix.shape[1]:
        raise InputError(f"{field}: got shape {_shape(matrix.shape)}, want a square matrix or its diagonal")
    scale = max(float(np.abs(matrix).max(initial=0.0)), np.finfo(float).tiny)
    skew = np.abs(matrix - matrix.T)
    if skew.max(initial=0.0) > 1e-9 * scale:
        i, j = (int(k) for k in np.argwhere(skew == skew.max())[0])
        raise InputError(
            f"{field}: got {matrix[i, j]:g} at [{i}, {j}] and {matrix[j, i]:g} at [{j}, {i}], want a symmetric matrix"
        )
    smallest = float(np.linalg.eigvalsh(matrix).min(initial=np.inf))
    if definite and smallest <= 0.0:
        raise InputError(f"{field}: got smallest eigenvalue {smallest:g}, want a positive-definite matrix")
    if smallest < -1e-9 * scale:
        raise InputError(f"{field}: got smallest eigenvalue {smallest:g}, want a positive-semidefinite matrix")
    symmetric = np.ascontiguousarray(0.5 * (matrix + matrix.T))
    symmetric.setflags(write=False)
    return symmetric


def check_name(field: str, name: str, valid: Iterable[str]) -> str:
    """`name` if it is one of `valid`; otherwise an InputError that lists them and guesses the meant one."""
    names = list(valid)
    if isinstance(name, str) and name in names:
        return name
    near = difflib.get_close_matches(str(name), names, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    raise InputError(f"{field}: got {name!r}, want one of: {', '.join(names) or '(there are none)'}{hint}")


def _shape(shape: tuple[int | None, ...]) -> str:
    sizes = ["any" if size is None else str(size) for size in shape]
    return f"({', '.join(sizes)}{',' if len(sizes) == 1 else ''})"


def excerpt(value: object) -> str:
    """A value for a message, cut where it gets long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
