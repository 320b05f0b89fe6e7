"""Checks of a record's fields by their annotations, when a record is made and when a file is read.

    @dataclass(frozen=True)
    class Trajectory:
        states: Annotated[Array, "T+1 n"]
        controls: Annotated[Array, "T m"]
        dt: Annotated[float, Bounds(above=0.0)]

        def __post_init__(self) -> None:
            check_fields(self)

A letter is a size, the same throughout a record and the records in it. `...` means any number of dimensions, `_` any
size. The letter of a tuple, or of `Coordinates`, is its length.
"""

import enum
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from lqrsim.errors import (
    InputError,
    brief,
    check_count,
    check_items,
    check_kind,
    check_number,
    excerpt,
    keep,
    numbers_of,
    real,
)

Sizes = dict[str, int]

LINE = 1000  # characters of a name or another line
Line = Annotated[str, LINE]  # one printable line
LARGEST_COUNT = 2**128 - 1  # the largest seed


class Bounds(NamedTuple):
    """The numbers that a field may hold, all finite. A field without bounds may also hold infinity and NaN."""

    above: float | None = None
    at_least: float | None = None
    at_most: float | None = None
    below: float | None = None


SHARE = Bounds(at_least=0.0, at_most=1.0)


def repr_of(self: Any) -> str:
    """The repr of a record, in which arrays of many numbers are their shapes: `__repr__ = repr_of`."""
    parts = (f"{field.name}={brief(getattr(self, field.name))}" for field in fields(self))
    return f"{type(self).__name__}({', '.join(parts)})"


class Declared(NamedTuple):
    """The content of a field's annotation.

    Attributes:
      kinds: the allowed types, as `typing` names them.
      dtype: type of an array, float64 or int64; None if it is no array.
      letters: the shape of an array, or the length of something else; empty if not given.
      longest: characters of a text that is one printable line; None for any text.
      optional: whether the field may be None.
    """

    kinds: tuple[Any, ...]
    dtype: type[np.generic] | None
    letters: str
    bounds: Bounds | None
    longest: int | None
    optional: bool


def check_fields(record: Any) -> Sizes:
    """Check the fields of a record and convert them as annotated: arrays to float64, sequences to tuples.

    Returns:
      The sizes, by letter.

    Raises:
      InputError: a field is of another kind, range or size.
    """
    sizes: Sizes = {}
    who = type(record).__name__
    for name, said in _in_order(type(record)):
        value = getattr(record, name)
        kept = _checked(f"{who}: {name}", value, said, sizes)
        if kept is not value:
            keep(record, **{name: kept})
    return sizes


@cache
def declarations(kind: type) -> dict[str, Declared]:
    """The declaration of each field of a record, except fields that are no part of its value (`compare=False`)."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: declared(hints[field.name]) for field in fields(kind) if field.compare}


@cache
def declared(annotation: Any) -> Declared:
    """The content of an annotation."""
    said: list[Any] = []
    optional = False
    kinds: tuple[Any, ...] = (annotation,)
    while len(kinds) == 1 and get_origin(kinds[0]) in (Annotated, Union, UnionType):
        inside = get_args(kinds[0])
        if get_origin(kinds[0]) is Annotated:
            said += inside[1:]
            kinds = inside[:1]
        else:
            kinds = tuple(one for one in inside if one is not NoneType)
            optional = optional or len(kinds) < len(inside)

    def first(kind: type) -> Any:
        return next((one for one in said if isinstance(one, kind)), None)

    dtype = None
    if get_origin(kinds[0]) in (np.ndarray, npt.NDArray):  # the latter from NumPy 2.5 on, with Python 3.12
        dtype = np.int64 if "int64" in str(kinds[0]) else np.float64
    return Declared(kinds, dtype, first(str) or "", first(Bounds), first(int), optional)


@cache
def _in_order(kind: type) -> list[tuple[str, Declared]]:
    """Sort key: records first, which define sizes, then arrays, then optional records and tuples of a length."""

    def order(item: tuple[str, Declared]) -> int:
        said = item[1]
        last = said.letters if get_origin(said.kinds[0]) is tuple else said.optional and is_dataclass(said.kinds[0])
        return 2 if last else int(said.dtype is not None)

    return sorted(declarations(kind).items(), key=order)


def _checked(field: str, value: Any, said: Declared, sizes: Sizes) -> Any:
    """The value as declared. Raises InputError for other values."""
    kind, bounds = said.kinds[0], said.bounds
    if value is None and said.optional:
        return None
    if said.dtype is not None:
        return _array(field, value, said, sizes)
    if kind is float:
        return _number(field, value) if bounds is None else check_number(field, value, **bounds._asdict())
    if kind is int:
        return check_count(field, value, at_least=0, at_most=LARGEST_COUNT)
    if kind is str:
        return check_string(field, value, said.longest)
    if kind is object:
        return value
    origin = get_origin(kind)
    if origin is tuple:
        items = check_items(field, value, object, "a tuple")
        if said.letters:
            _check_length(field, len(items), said.letters, sizes)
        inner = get_args(kind)
        each = inner[:1] * len(items) if inner[-1] is Ellipsis else inner
        if len(each) != len(items):
            raise InputError(f"{field}: got {len(items)} entries, want {len(each)}")
        pairs = enumerate(zip(items, each, strict=True))
        return tuple(_checked(f"{field}[{i}]", item, declared(one), sizes) for i, (item, one) in pairs)
    if origin is not None:  # a Mapping
        value = check_kind(field, value, Mapping, "a dictionary by name")
        inner = declared(get_args(kind)[1])
        names = {name: check_string(f"{field}: a name", name, LINE) for name in value}
        return {name: _checked(f"{field}.{name}", value[name], inner, sizes) for name in names}
    names = [one.__name__ for one in said.kinds]
    want = " or ".join(f"{'an' if name[0] in 'AEIOU' else 'a'} {name}" for name in names)
    if issubclass(kind, enum.Enum):
        want += f", one of {', '.join(kind.__members__)}"
    value = check_kind(field, value, said.kinds, want)
    if said.letters:
        _check_length(field, len(value), said.letters, sizes)
    elif is_dataclass(value):
        _share_sizes(field, value, sizes)
    return value


def _share_sizes(field: str, record: Any, sizes: Sizes) -> None:
    """Raises InputError unless a record's sizes agree with the known sizes; its other sizes become known."""
    for name, said in declarations(type(record)).items():
        value, inner = getattr(record, name), f"{field}.{name}"
        if value is None or said.letters.startswith("..."):
            continue
        if isinstance(value, np.ndarray):
            check_sizes(inner, value.shape, said.letters, sizes)
        elif said.letters:
            _check_length(inner, len(value), said.letters, sizes)
        elif is_dataclass(value):
            _share_sizes(inner, value, sizes)


def check_sizes(field: str, shape: tuple[int, ...], letters: str, sizes: Sizes) -> None:
    """Raises InputError unless a shape fits these letters and the known sizes; new letters get sizes."""
    wanted, before, alike = _lengths(letters), sizes.copy(), True
    if wanted[0][0] == "...":
        leading = len(shape) - len(wanted) + 1
        # As many as the record's other arrays have; a single number may stand for all.
        alike = (letters == "..." and not shape) or leading == sizes.setdefault("...", leading)
        wanted = (*((f"...{i}", 0) for i in range(leading)), *wanted[1:])
    fits = alike and len(wanted) == len(shape)
    for (name, more), length in zip(wanted, shape, strict=False):
        size = length - more
        expected = name if isinstance(name, int) else size if name == "_" else sizes.setdefault(name, size)
        fits = fits and size == expected and size >= 0
    if not fits:
        known = [_length_of(letter, before) for letter in letters.split()]
        meaning = "" if known == letters.split() else f" = ({', '.join(known)})"
        raise InputError(f"{field}: got shape {shape}, want ({', '.join(letters.split())}){meaning}")


@cache
def _lengths(letters: str) -> tuple[tuple[str | int, int], ...]:
    """The letter of each length, or the length itself, and what is added to it."""
    parts = (letter.partition("+") for letter in letters.split())
    return tuple((int(name) if name.isdecimal() else name, int(more or 0)) for name, _, more in parts)


def _length_of(letter: str, sizes: Sizes) -> str:
    """The length that a letter stands for, such as 151 for T+1; the letter itself if its size is unknown."""
    name, _, more = letter.partition("+")
    return str(sizes[name] + int(more or 0)) if name in sizes else letter


def _check_length(field: str, length: int, letter: str, sizes: Sizes) -> None:
    """Raises InputError unless the number of entries is the size that the letter stands for."""
    if length != (want := sizes.setdefault(letter, length)):
        raise InputError(f"{field}: got {length} entries, want {want}")


def _array(field: str, value: Any, said: Declared, sizes: Sizes) -> Any:
    """An array of the declared numbers, shape and bounds."""
    array = real(field, value, f"numbers of shape ({', '.join(said.letters.split())})")
    check_sizes(field, array.shape, said.letters, sizes)
    if said.dtype is np.int64:
        numbers = numbers_of(field, array)
        if not ((numbers >= 0) & (numbers == np.floor(numbers)) & (numbers < 2**53)).all():
            raise InputError(f"{field}: got {excerpt(numbers.tolist())}, want whole numbers >= 0")
        return numbers.astype(np.int64)
    if said.bounds is not None:
        above, least, most, below = (np.nan if bound is None else bound for bound in said.bounds)
        bad = ~np.isfinite(array) | (array <= above) | (array < least) | (array > most) | (array >= below)
        if bad.any():
            place = tuple(np.argwhere(bad)[0].tolist())
            check_number(f"{field}{list(place)}", array[place].item(), **said.bounds._asdict())
    return array


def _number(field: str, value: Any) -> float:
    """A number; it may be infinite or NaN."""
    if type(value) is float:
        return value
    array = real(field, value, "a number")
    if array.shape or isinstance(value, (bool, np.bool_)):
        raise InputError(f"{field}: got {excerpt(value)}, want a number")
    return float(array)


def check_string(field: str, value: Any, longest: int | None = None) -> str:
    """`value` if it is text that a file can hold; with `longest`, one printable line of at most that many characters.

    Lines are printed as they are, and a terminal obeys control characters.

    Raises:
      InputError: it is no such text.
    """
    if not isinstance(value, str):
        raise InputError(f"{field}: got {excerpt(value)}, want text")
    if longest is not None and not (len(value) <= longest and value.isprintable()):
        raise InputError(f"{field}: got {excerpt(value)}, want one printable line of at most {longest} characters")
    if not value.isascii() and any("\ud800" <= letter <= "\udfff" for letter in value):
        raise InputError(f"{field}: got {excerpt(value)}, want text without halves of surrogate pairs")
    return value
