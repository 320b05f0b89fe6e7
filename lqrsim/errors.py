"""`InputError`, the exception for bad input, and the checks that raise it.

Every message is one line with the field, the value that it got, the value that it wants, and valid names, if any.
The command line prints that line and exits with 2.
"""

import contextlib
import dataclasses
import difflib
import inspect
import itertools
import math
import os
import re
import sys
import sysconfig
import types
import warnings
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.machine import memory, outdated

if outdated():  # here, because every module imports this one
    raise ImportError(f"lqrsim: {outdated()}")

Array = npt.NDArray[np.floating]

_FLOAT64 = np.dtype(np.float64)
_ADDRESS = re.compile(r" at 0x[0-9A-Fa-f]+")
_OBJECT = re.compile(r"<(?:[\w.]|<locals>)*?(\w+) object>")
_LARGE = 10**7  # entries above which the memory for an array is checked first
LONGEST = 1010  # largest number of characters of a message
LARGEST_SEED = 2**128 - 1
LARGEST_COUNT = 10**9  # limit of counts without their own limit: a longer loop takes more than a day


class InputError(ValueError):
    """Bad input from the caller; the message is one line that says what is wrong and what is wanted."""

    def __init__(self, message: str) -> None:
        line = " ".join(message.splitlines())  # the message of a user's function may be pages long
        super().__init__(line if len(line) <= LONGEST else f"{line[:700]} ... {line[-300:]}")


def check_opengl(error: BaseException) -> None:
    """Raises InputError if an import of MuJoCo failed with this exception because of MUJOCO_GL.

    MuJoCo chooses its OpenGL while it is imported; without the chosen one it may raise any exception. Its submodules
    that were imported then stay in `sys.modules`, and `mujoco` itself does not.
    """
    failed = "mujoco" not in sys.modules and any(name.startswith("mujoco.") for name in sys.modules)
    if failed and "MUJOCO_GL" in os.environ and not isinstance(error, InputError):
        why = f"with which MuJoCo cannot be imported here ({' '.join(str(error).split())})"
        want = "it unset: lqrsim finds an OpenGL by itself"
        raise InputError(f"MUJOCO_GL: got {os.environ['MUJOCO_GL']!r}, {why}, want {want}") from None


def keep(record: object, **values: object) -> None:
    """Set fields of a frozen record to the values that its `__post_init__` has checked."""
    for name, value in values.items():
        object.__setattr__(record, name, value)


def check_array(field: str, value: npt.ArrayLike, shape: tuple[int | None, ...], *, infinite: bool = False) -> Array:
    """Real numbers without NaN as a read-only C-ordered float64 copy of the given shape (None matches any length)."""
    array = numbers_of(field, value, f"numbers of shape {_shape(shape)}")
    check_shape(field, array, shape)
    bad = np.isnan(array) if infinite else ~np.isfinite(array)
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        place = f" at index {list(where)}" if where else ""
        raise InputError(f"{field}: got {array[where]}{place}, want {'a number' if infinite else 'finite numbers'}")
    array.setflags(write=False)
    return array


def numbers_of(field: str, value: object, want: str = "numbers") -> Array:
    """`value` as a new C-ordered float64 array of any shape, NaN included. Raises InputError if it is not numbers."""
    try:
        array = np.asarray(value)
        if array.size > _LARGE:
            check_memory(field, array.size, 32, "arrays made from it")
        if array.dtype.kind not in "biufO":  # text, complex numbers, dates, records
            raise TypeError
        if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):  # masked entries are no numbers
            raise TypeError
        if array.dtype.kind == "O" and any(isinstance(entry, (str, bytes)) for entry in array.flat):
            raise TypeError
        return np.array(array, dtype=np.float64, order="C")
    except InputError:
        raise
    except MemoryError:
        raise InputError(f"{field}: got {excerpt(value)}, which does not fit into memory, want {want}") from None
    except Exception:  # an object may raise anything in its conversion
        raise InputError(f"{field}: got {excerpt(value)}, want {want}") from None


def check_shape(field: str, array: npt.NDArray[Any], shape: tuple[int | None, ...]) -> None:
    """Raises InputError unless the array has that shape (None matches any length)."""
    actual = array.shape
    if len(actual) != len(shape) or any(w is not None and g != w for g, w in zip(actual, shape, strict=True)):
        raise InputError(f"{field}: got shape {_shape(actual)}, want {_shape(shape)}")


def real(field: str, value: npt.ArrayLike, want: str = "numbers") -> Array:
    """As `numbers_of`, but a float64 array is returned as it is."""
    if type(value) is not np.ndarray or value.dtype != np.float64:
        return numbers_of(field, value, want)
    if value.size > _LARGE:  # a broadcast array takes little memory, but arrays made from it take all
        check_memory(field, value.size, 32, "arrays made from it")
    return value


def shaped(field: str, value: npt.ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """`value` as float64 of the given shape (None: any length), NaN included; copied only if necessary."""
    if type(value) is np.ndarray and value.dtype is _FLOAT64 and value.shape == shape and value.size <= _LARGE:
        return value  # the fast path, for arrays of solvers
    array = real(field, value, f"numbers of shape {_shape(shape)}")
    check_shape(field, array, shape)
    return array


def check_weight_vector(field: str, value: npt.ArrayLike, size: int) -> Array:
    """Weights (size,), from one number for all or an array. Raises InputError unless they are finite and >= 0."""
    try:
        single = np.ndim(value) == 0  # pyright: ignore[reportArgumentType]
    except Exception:  # lists of different lengths, which `check_array` refuses
        single = False
    if single:
        return np.full(size, check_number(field, value, at_least=0.0))
    weights = check_array(field, value, (size,))
    if (weights < 0).any():
        raise InputError(f"{field}: got {excerpt(weights.tolist())}, want numbers >= 0")
    return weights


def vectors_of(field: str, value: npt.ArrayLike, size: int) -> Array:
    """`value` as float64 of shape (..., size), NaN included; copied only if necessary. Raises InputError."""
    array = real(field, value, f"numbers of shape (..., {size})")
    if array.shape[-1:] != (size,):
        raise InputError(f"{field}: got shape {_shape(array.shape)}, want (..., {size})")
    return array


def check_number(
    field: str, value: object, *, above: float | None = None, at_least: float | None = None,
    at_most: float | None = None, below: float | None = None,
) -> float:  # fmt: skip
    """`value` as a finite float within the bounds. Raises InputError otherwise, including for text and bools."""
    number = math.nan
    with contextlib.suppress(Exception):  # an object may raise anything in its conversion
        if type(value) is float:  # the most frequent
            number = value
        elif not isinstance(value, (str, bytes, bytearray, bool, np.bool_)) and np.ndim(value) == 0:  # pyright: ignore
            number = float(value)  # pyright: ignore[reportArgumentType]
    good = (
        math.isfinite(number)
        and (above is None or number > above)
        and (at_least is None or number >= at_least)
        and (at_most is None or number <= at_most)
        and (below is None or number < below)
    )
    if not good:
        bounds = ((">", above), (">=", at_least), ("<=", at_most), ("<", below))
        wants = " and ".join(f"{sign} {_short(bound)}" for sign, bound in bounds if bound is not None)
        raise InputError(f"{field}: got {excerpt(value)}, want {f'a finite number {wants}'.strip()}")
    return number


def _short(bound: float) -> str:
    """A bound as text, with all its digits if it has more than six: a number just beyond 1/3 must not look good."""
    return text if float(text := f"{bound:g}") == bound else repr(float(bound))


def check_count(field: str, value: object, *, at_least: int = 1, at_most: int = LARGEST_COUNT) -> int:
    """`value` as an int from `at_least` to `at_most`. Raises InputError otherwise."""
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.bool_))
    if not is_integer or value < at_least:  # pyright: ignore[reportOperatorIssue]
        raise InputError(f"{field}: got {excerpt(value)}, want a whole number >= {at_least}")
    if value > at_most:  # pyright: ignore[reportOperatorIssue]
        raise InputError(f"{field}: got {excerpt(value)}, want a whole number from {at_least} to {at_most}")
    return int(value)  # pyright: ignore[reportArgumentType]


def check_seed(field: str, value: object) -> int:
    """`value` as an int >= 0 of at most 128 bits. Raises InputError otherwise."""
    return check_count(field, value, at_least=0, at_most=LARGEST_SEED)


def check_memory(field: str, count: int, each: int, what: str = "whose arrays") -> None:
    """Raises InputError if `count` items of `each` bytes do not fit into this machine's memory."""
    if count * each > (available := memory()):
        want = f"at most {available // each} for the {_bytes(available)} of this machine"
        raise InputError(f"{field}: got {excerpt(count)}, {what} would take {_bytes(count * each)}, want {want}")


def check_kind(field: str, value: object, kind: type | tuple[type, ...], want: str) -> Any:
    """`value` if it is an instance of `kind`. Raises InputError with `want` otherwise."""
    if not isinstance(value, kind):
        raise InputError(f"{field}: got {excerpt(value)}, want {want}")
    return value


def check_function(field: str, value: object, want: str, *, arguments: int | None = None) -> None:
    """Raises InputError unless `value` can be called with this number of arguments.

    Exceptions that it raises when it is called are not turned into InputErrors.
    """
    if not callable(value):
        raise InputError(f"{field}: got {excerpt(value)}, want {want}")
    if arguments is None:
        return
    try:
        inspect.signature(value).bind(*[None] * arguments)
    except ValueError:  # a built-in function without a signature
        return
    except TypeError as error:
        got = f"{excerpt(value)}, which does not take {arguments} arguments ({error})"
        raise InputError(f"{field}: got {got}, want {want}") from None
    except Exception:  # an object may raise anything when it is inspected
        raise InputError(f"{field}: got {excerpt(value)}, want {want}") from None


def check_flag(field: str, value: object) -> bool:
    """`value` as a bool. Raises InputError unless it is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{field}: got {excerpt(value)}, want True or False")
    return bool(value)


def check_text(field: str, value: object, want: str = "text", *, at_most: int = 200, empty: bool = False) -> str:
    """`value` if it is one printable line of text. Raises InputError otherwise."""
    if not isinstance(value, str) or not (value or empty) or not value.isprintable():
        raise InputError(f"{field}: got {excerpt(value)}, want {want}: one printable line")
    if len(value) > at_most:
        raise InputError(f"{field}: got {len(value)} characters, {excerpt(value)}, want {want} of at most {at_most}")
    return value


def check_path(field: str, value: object, want: str = "the path of a file", *, suffixes: Collection[str] = ()) -> Path:
    """`value` as a valid path of a file, with names in UTF-8 of at most 255 bytes. Raises InputError otherwise.

    With `suffixes`, such as (".html",), its name has to end in one of them.
    """
    name: object = value
    try:
        if not isinstance(value, (str, os.PathLike)):
            raise TypeError
        name = os.fspath(value)
        good = isinstance(name, str) and name and "\0" not in name
        good = good and all(len(part.encode()) <= 255 for part in Path(name).parts) and len(name.encode()) < 4096
    except Exception:  # not a path, or not UTF-8, in which files and JSON hold names
        good = False
    if not good:
        raise InputError(f"{field}: got {excerpt(name)}, want {want}, of names in UTF-8 of at most 255 bytes")
    path = Path(name)  # pyright: ignore[reportArgumentType]
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"{field}: got {excerpt(path.name)}, want a name that ends in {', '.join(suffixes)}")
    return path


def check_items(
    field: str, value: object, kind: type | tuple[type, ...], want: str, *, at_most: int = 1_000_000
) -> tuple[Any, ...]:
    """The items of a collection, all of `kind`, as a tuple. Raises InputError for text, mappings and other kinds."""
    try:
        if isinstance(value, (str, bytes, dict)):
            raise TypeError
        items = tuple(itertools.islice(iter(value), at_most + 1))  # pyright: ignore[reportCallIssue, reportArgumentType]
    except InputError:
        raise
    except Exception:  # not a collection, or one that raises anything
        raise InputError(f"{field}: got {excerpt(value)}, want {want}") from None
    if len(items) > at_most:
        raise InputError(f"{field}: got more than {at_most} items, want {want}")
    for place, item in enumerate(items):
        if not isinstance(item, kind):
            raise InputError(f"{field}: got {excerpt(item)} at {place}, want {want}")
    return items


def check_weight_matrix(field: str, value: npt.ArrayLike, *, definite: bool = False) -> Array:
    """`value` as a symmetric positive-semidefinite (or definite) matrix; a vector is read as its diagonal.

    Three axes are matrices (K, n, n), one for each knot.
    """
    raw = numbers_of(field, value, "a matrix of numbers or its diagonal")
    if raw.ndim == 3 and len(raw):
        weights = np.array([check_weight_matrix(f"{field}: row {k}", w, definite=definite) for k, w in enumerate(raw)])
        weights.setflags(write=False)
        return weights
    if raw.ndim == 1:
        check_memory(field, len(raw), 16 * len(raw), "whose square matrix")
    matrix = np.diag(raw) if raw.ndim == 1 else raw
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not matrix.size:
        got = f"the number {raw:g}" if raw.ndim == 0 else f"shape {_shape(raw.shape)}"
        wanted = "a square matrix or its diagonal, such as (1.0,)"
        if raw.ndim >= 2:
            wanted += "; for weights that change with time, one matrix for each knot: rows[:, :, None] * np.eye(n)"
        raise InputError(f"{field}: got {got}, want {wanted}")
    matrix = check_array(field, matrix, matrix.shape)
    symmetric = check_symmetric(field, matrix)
    smallest = float(np.linalg.eigvalsh(symmetric).min(initial=np.inf))
    if definite and smallest <= 0.0:
        raise InputError(f"{field}: got smallest eigenvalue {smallest:g}, want a positive-definite matrix")
    if smallest < -1e-9 * np.abs(symmetric).max():
        raise InputError(f"{field}: got smallest eigenvalue {smallest:g}, want a positive-semidefinite matrix")
    return symmetric


def check_symmetric(field: str, matrices: Array) -> Array:
    """Finite matrices (..., n, n) that are symmetric up to rounding, without that rounding, as a read-only array.

    Entries across the diagonal may differ by 1e-9 of the largest entry of their matrix.
    """
    across = np.swapaxes(matrices, -1, -2)
    skew = np.abs(matrices - across)
    wrong = skew > 1e-9 * np.abs(matrices).max(axis=(-2, -1), keepdims=True, initial=0.0)
    if wrong.any():
        # The worst entry of the first matrix that is wrong.
        *first, _, _ = (int(k) for k in np.argwhere(wrong)[0])
        worst = np.argmax(skew[(*first,)])
        i, j = (int(k) for k in np.unravel_index(worst, skew.shape[-2:]))
        place, mirror = [*first, i, j], [*first, j, i]
        got = f"{matrices[tuple(place)]:g} at {place} and {matrices[tuple(mirror)]:g} at {mirror}"
        raise InputError(f"{field}: got {got}, want a symmetric matrix")
    symmetric = np.ascontiguousarray(0.5 * (matrices + across))
    symmetric.setflags(write=False)
    return symmetric


def check_name(field: str, name: object, valid: Iterable[str]) -> str:
    """`name` if it is one of `valid`. Raises InputError with the list and the nearest name otherwise."""
    names = list(valid)
    if isinstance(name, str) and name in names:
        return name
    near = difflib.get_close_matches(excerpt(name).strip("'"), names, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    raise InputError(f"{field}: got {excerpt(name)}, want one of: {', '.join(names) or '(there are none)'}{hint}")


def _shape(shape: tuple[int | None, ...]) -> str:
    sizes = ["any" if size is None else str(size) for size in shape]
    return f"({', '.join(sizes)}{',' if len(sizes) == 1 else ''})"


def _bytes(count: int) -> str:
    for unit in ("bytes", "kB", "MB", "GB", "TB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count = count / 1000  # pyright: ignore[reportAssignmentType]
    return f"{count:.3g} PB" if count < 1e6 else f"{count:.1e} PB"


def renamed(old: str, new: str) -> Callable[..., Any]:
    """The earlier name of a method, which warns, for programs of the version before."""

    def method(self: Any, *arguments: Any, **options: Any) -> Any:
        warnings.warn(f"{old} is {new} now; the old name will be removed in lqrsim 0.4", FutureWarning, stacklevel=2)
        return getattr(self, new)(*arguments, **options)

    method.__doc__ = f"The earlier name of `{new}`."
    return method


def free_name(name: str, taken: Container[str]) -> str:
    """The name, with underscores appended if it is taken."""
    while name in taken:
        name += "_"
    return name


def printable(text: str) -> str:
    """The text with a question mark for each letter that cannot be printed."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def excerpt(value: object) -> str:
    """A value as one short line for a message, even if its `__repr__` fails."""
    try:
        if isinstance(value, (str, bytes, bytearray)):
            value = value[:200]
        elif type(value) in (list, tuple, set, frozenset, dict) and len(value) > 100:  # pyright: ignore[reportArgumentType]
            return f"{type(value).__name__} of {len(value)}"  # pyright: ignore[reportArgumentType]
        elif isinstance(value, int) and value.bit_length() > 1000:
            return f"an int of {value.bit_length()} bits"
        elif isinstance(value, np.number):
            value = value.item()  # 0.5, not np.float64(0.5)
        elif dataclasses.is_dataclass(value):  # its repr may have megabytes
            return value.__name__ if isinstance(value, type) else f"{type(value).__name__}(...)"
        text = " ".join(without_addresses(repr(value)).split())
    except Exception:  # a __repr__ that fails, or recurses without end
        return f"a {type(value).__name__}"
    text = printable(text[:200])
    return text if len(text) <= 60 else f"{text[:57]}..."


def listed(names: Sequence[str], most: int = 12) -> str:
    """Names in a line, or none; only the first ones if there are many."""
    return (", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")) or "none"


def brief(value: object, depth: int = 0) -> str:
    """A value within the text of a record: numbers in six digits, long arrays by their shape, functions by name."""
    if isinstance(value, (bool, str)) or value is None:
        return repr(value)
    if isinstance(value, (int, float, np.number)):
        with contextlib.suppress(OverflowError):  # of an int beyond all floats
            return f"{value + 0:.6g}"  # no -0
        return excerpt(value)
    if isinstance(value, np.ndarray):
        square = value.ndim == 2 and value.shape[0] == value.shape[1]
        if square and not (value - np.diag(np.diag(value))).any():
            return f"diag({brief(np.diag(value).tolist())})"
        return brief(value.tolist()) if value.ndim <= 1 and value.size <= 12 else f"array {value.shape}"
    if isinstance(value, (Mapping, list, tuple)) and depth > 5:  # lists within lists without end
        return f"a {type(value).__name__}"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {brief(entry, depth + 1)}" for name, entry in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        entries = [brief(item, depth + 1) for item in value]
        same = len(entries) > 3 and len(set(entries)) == 1
        text = f"{entries[0]}, ... {len(entries)} times" if same else ", ".join(entries)
        return f"[{text}]" if isinstance(value, list) else f"({text})"
    return getattr(value, "__qualname__", None) or without_addresses(repr(value))


def without_addresses(text: str) -> str:
    """A repr with objects named by their kind, such as "a Replanner", in place of Python's name and address."""

    def kind(match: re.Match[str]) -> str:
        name = match[1]
        return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"

    return _OBJECT.sub(kind, _ADDRESS.sub("", text))


def format_error(error: BaseException) -> str:
    """An exception as one printable line for a message: its type and text, and where it is in a user's file."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # raised by its own __str__
        text = ""
    text = printable(text[:500])
    where = _line_of_user(error.__traceback__)
    return (f"{type(error).__name__}: {text}" if text else type(error).__name__) + (f" ({where})" if where else "")


_INSTALLED = (sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib"))
_NOT_USERS = tuple(os.path.realpath(folder) + os.sep for folder in (os.path.dirname(__file__), *_INSTALLED))


def _line_of_user(trace: types.TracebackType | None) -> str:
    """The innermost line of a traceback that is in no package and not in Python's library; empty if there is none."""
    where = ""
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if os.path.isfile(file) and not os.path.realpath(file).startswith(_NOT_USERS):
            where = f"{os.path.basename(file)}, line {trace.tb_lineno}"
        trace = trace.tb_next
    return printable(where)
