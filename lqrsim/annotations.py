"""Checks of arguments by their annotations: `checked` adds them to a function, or to the constructor of a record.

    @checked
    @dataclass(frozen=True)
    class Trajectory:
        states: Annotated[Array, "T+1 n"]
        controls: Annotated[Array, "T m"]
        dt: Positive

    @checked
    def simulate(plant: Plant, *, trials: Count = 1, seed: Seed = 0): ...

A letter is a size, the same throughout a record and the records in it. `...` means any number of dimensions, `_` any
size. The letter of a tuple, or of `Coordinates`, is its length.

Classes, `bool`, `Literal` and `Callable` are checked as they stand; a callable has to take as many arguments as its
annotation has. `Want` is the end of a message where the name of the type is not enough. Other annotations, such as
`ArrayLike`, are not checked.
"""

import enum
import functools
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from types import NoneType, SimpleNamespace, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from lqrsim.errors import (
    LARGEST_COUNT,
    LARGEST_SEED,
    InputError,
    brief,
    check_count,
    check_flag,
    check_function,
    check_items,
    check_kind,
    check_name,
    check_number,
    check_text,
    excerpt,
    numbers_of,
    real,
)

Sizes = dict[str, int]
T = TypeVar("T")

LINE = 1000  # characters of a name or another line


class Bounds(NamedTuple):
    """The numbers that a field may hold, all finite. A field without bounds may also hold infinity and NaN."""

    above: float | None = None
    at_least: float | None = None
    at_most: float | None = None
    below: float | None = None


class Want(NamedTuple):
    """The end of a message, after "want", in place of the name of the type."""

    text: str


class OneOf:
    """The texts that an argument may be, if no `Literal` lists them."""

    def __init__(self, names: Collection[str]) -> None:
        self.names = names


Line = Annotated[str, LINE]  # one printable line
Finite = Annotated[float, Bounds()]
Positive = Annotated[float, Bounds(above=0.0)]
NonNegative = Annotated[float, Bounds(at_least=0.0)]
SHARE = Bounds(at_least=0.0, at_most=1.0)
Share = Annotated[float, SHARE]
Chance = Annotated[float, Bounds(above=0.0, below=1.0)]  # neither impossible nor certain
Count = Annotated[int, Bounds(at_least=1, at_most=LARGEST_COUNT)]
Index = Annotated[int, Bounds(at_least=0, at_most=LARGEST_COUNT)]
Seed = Annotated[int, Bounds(at_least=0, at_most=LARGEST_SEED)]
Progress = Annotated[Callable[[int, int], object], Want("a function progress(done, total)")]
TextProgress = Annotated[Callable[[int, int, str], object], Want("a function progress(done, total, text)")]


def repr_of(self: Any) -> str:
    """The repr of a record, in which arrays of many numbers are their shapes: `__repr__ = repr_of`."""
    parts = (f"{field.name}={brief(getattr(self, field.name))}" for field in fields(self))
    return f"{type(self).__name__}({', '.join(parts)})"


class Declared(NamedTuple):
    """The content of an annotation."""

    kinds: tuple[Any, ...]  # the allowed types, as `typing` names them
    dtype: type[np.generic] | None  # of an array, float64 or int64; None if it is no array
    letters: str  # the shape of an array, or the length of something else; empty if not given
    bounds: Bounds | None
    longest: int | None  # characters of a text that is one printable line, None for any text; or items of a sequence
    want: str  # the end of messages; empty for the name of the type
    names: Collection[str]  # the texts that it may be; empty for any
    optional: bool

    @property
    def plain(self) -> bool:
        """Whether there is no more than a type."""
        return not (self.letters or self.bounds or self.longest or self.want or self.names)


def checked(thing: T) -> T:
    """Decorator of a function or of a dataclass: check arguments by their annotations, and convert them.

    Numbers become Python's, for NumPy's are other types for the compiler, and JSON has no form for them; arrays become
    float64 and sequences tuples. Defaults are not checked. Messages begin with the argument's name; those of a
    constructor with the class or its `_prefix` before that. An integer is at least 0 unless its bounds say otherwise.
    """
    if isinstance(thing, type):
        thing.__init__ = _checking(thing.__init__, lambda: _of_fields(thing))
        return thing
    function: Any = thing
    return _checking(function, lambda: _of_parameters(function))


def _checking(function: Any, declare: Callable[[], dict[str, Declared]]) -> Any:
    code = function.__code__
    positions = {name: place for place, name in enumerate(code.co_varnames[: code.co_argcount])}
    makes = function.__name__ == "__init__"

    @cache  # at the first call, for annotations may name what is defined further down
    def wanted() -> tuple[list[tuple[str, int, Declared]], bool]:
        specs = sorted((item for item in declare().items() if _is_known(item[1])), key=_order)
        places = [(name, positions.get(name, sys.maxsize), spec) for name, spec in specs]
        return places, any(spec.letters for _, spec in specs)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        who = ""
        if makes:
            kind = type(arguments[0])
            who = getattr(kind, "_prefix", f"{kind.__name__}: ")
        placed, (places, sized) = list(arguments), wanted()
        sizes = Sizes() if sized else None
        check = _owned if makes else _checked
        for name, place, spec in places:
            if name in named:
                named[name] = check(who + name, named[name], spec, sizes)
            elif place < len(placed):
                placed[place] = check(who + name, placed[place], spec, sizes)
        return function(*placed, **named)

    return call


def _of_parameters(function: Any) -> dict[str, Declared]:
    """The declarations of parameters. A plain number, text or dictionary says too little: the function decides."""
    hints = get_type_hints(function, include_extras=True)
    specs = {name: declared(hint) for name, hint in hints.items() if name != "return"}
    plain = {name for name, spec in specs.items() if (get_origin(spec.kinds[0]) or spec.kinds[0]) in _PLAIN}
    return {name: spec for name, spec in specs.items() if not (spec.plain and name in plain)}


@cache
def declarations(kind: type) -> dict[str, Declared]:
    """The declaration of each field of a record, except fields that are no part of its value (`compare=False`)."""
    of_value = {field.name for field in fields(kind) if field.compare}
    return {name: spec for name, spec in _of_fields(kind).items() if name in of_value}


@cache
def _of_fields(kind: type) -> dict[str, Declared]:
    """The declarations of fields alone: what else a class is annotated with may be imported for type checkers only."""
    annotated = SimpleNamespace(__annotations__={field.name: field.type for field in fields(kind)})
    names: dict[str, Any] = {}
    for base in reversed(kind.__mro__):
        names |= vars(sys.modules[base.__module__])
    return {name: declared(hint) for name, hint in get_type_hints(annotated, names, include_extras=True).items()}


@cache
def declared(annotation: Any) -> Declared:
    """The content of an annotation."""
    metadata, optional = list[Any](), False
    kinds: tuple[Any, ...] = (annotation,)
    while len(kinds) == 1 and get_origin(kinds[0]) in (Annotated, Union, UnionType):
        inside = get_args(kinds[0])
        if get_origin(kinds[0]) is Annotated:
            metadata += inside[1:]
            kinds = inside[:1]
        else:
            kinds = tuple(kind for kind in inside if kind is not NoneType)
            optional = optional or len(kinds) < len(inside)

    def first(kind: type) -> Any:
        return next((item for item in metadata if isinstance(item, kind)), None)

    dtype = None
    if get_origin(kinds[0]) in (np.ndarray, npt.NDArray):  # the latter from NumPy 2.5 on, with Python 3.12
        dtype = np.int64 if "int64" in str(kinds[0]) else np.float64
    want, listed = first(Want), first(OneOf)
    names = get_args(kinds[0]) if get_origin(kinds[0]) is Literal else listed.names if listed else ()
    wanted = want.text if want else ""
    return Declared(kinds, dtype, first(str) or "", first(Bounds), first(int), wanted, names, optional)


def _is_known(spec: Declared) -> bool:
    """Whether the annotation says what to check; what it does not say, a function checks itself."""
    kind, origin = spec.kinds[0], get_origin(spec.kinds[0])
    if spec.dtype is not None:
        return bool(spec.letters)
    if len(spec.kinds) > 1:
        # One of several classes of the package; of others only where the message says more than their names.
        return all(_is_class(choice) and (spec.want or choice.__module__.startswith("lqrsim")) for choice in spec.kinds)
    if origin in _COLLECTIONS:
        return origin is tuple or bool(spec.want)
    if origin is Callable:
        return bool(spec.want)
    return origin in (Mapping, Literal) or (_is_class(kind) and kind is not object)


_COLLECTIONS = (tuple, Sequence, Iterable)
_PLAIN = (float, int, str, tuple, Mapping)


def _is_class(kind: Any) -> bool:
    return isinstance(kind, type) and kind is not Any and get_origin(kind) is None


def _order(item: tuple[str, Declared]) -> int:
    """Sort key: records first, which define sizes, then arrays, then optional records and tuples of a length."""
    spec = item[1]
    last = spec.letters if get_origin(spec.kinds[0]) is tuple else spec.optional and is_dataclass(spec.kinds[0])
    return 2 if last else int(spec.dtype is not None)


def _checked(field: str, value: Any, spec: Declared, sizes: Sizes | None) -> Any:
    """The value as declared, with sizes that agree if any are declared. Raises InputError for other values."""
    kind, bounds, want = spec.kinds[0], spec.bounds, spec.want
    if value is None and spec.optional:
        return None
    if spec.dtype is not None and sizes is not None:
        return _array(field, value, spec, sizes)
    if kind is float:
        return _number(field, value) if bounds is None else check_number(field, value, **bounds._asdict())
    if kind is int:
        _, least, most, _ = bounds or (None, 0, LARGEST_SEED, None)
        return check_count(field, value, at_least=int(least or 0), at_most=int(most or LARGEST_COUNT))
    if kind is bool:
        return check_flag(field, value)
    if spec.names:
        return check_name(field, value, spec.names)
    if kind is str and want:
        return check_text(field, value, want, at_most=spec.longest or 200)
    if kind is str:
        return check_string(field, value, spec.longest)
    origin, inside = get_origin(kind), get_args(kind)
    if origin is Callable:
        count = None if inside[0] is Ellipsis else len(inside[0])
        check_function(field, value, want or f"a function of {count} arguments", arguments=count)
        return value
    if origin in _COLLECTIONS:
        return _items(field, value, spec, sizes)
    if origin is Mapping:
        value = check_kind(field, value, Mapping, want or "a dictionary by name")
        inner = declared(inside[1])
        names = {name: check_string(f"{field}: a name", name, LINE) for name in value}
        if not _is_known(inner):
            return dict(value)
        return {name: _checked(f"{field}.{name}", value[name], inner, sizes) for name in names}
    value = check_kind(field, value, spec.kinds, want or _names(spec))
    if sizes is not None:
        if spec.letters:
            _check_length(field, len(value), spec.letters, sizes)
        elif is_dataclass(value):
            _unify_sizes(field, value, sizes)
    return value


def _owned(field: str, value: Any, spec: Declared, sizes: Sizes | None) -> Any:
    """As `_checked`; an array is a copy, for the caller may write into the given one later."""
    valid = _checked(field, value, spec, sizes)
    return valid.copy() if valid is value and isinstance(valid, np.ndarray) else valid


def _names(spec: Declared) -> str:
    """The end of a message about classes: `_want` of each, with how to get an object, or its name."""
    names = {kind: f"{'an' if kind.__name__[0] in 'AEIOU' else 'a'} {kind.__name__}" for kind in spec.kinds}
    wants = [getattr(kind, "_want", name) for kind, name in names.items()]
    want = (", or " if wants != [*names.values()] else " or ").join(wants)
    if issubclass(kind := spec.kinds[0], enum.Enum):
        return f"{want}, one of {', '.join(kind.__members__)}"
    return f"{want}, or None" if spec.optional else want


def _items(field: str, value: Any, spec: Declared, sizes: Sizes | None) -> tuple[Any, ...]:
    """A collection as a tuple, of which each item is as declared."""
    inner = get_args(spec.kinds[0])
    if spec.want and inner[0] is int:
        return tuple(map(int, check_items(field, value, (int, np.integer), spec.want)))
    if spec.want and _is_class(inner[0]) and inner[0] not in _PLAIN:
        return check_items(field, value, inner[0], spec.want, at_most=spec.longest or 1_000_000)
    items = check_items(field, value, object, spec.want or "a tuple")
    if spec.letters and sizes is not None:
        _check_length(field, len(items), spec.letters, sizes)
    kinds = inner[:1] * len(items) if len(inner) == 1 or inner[-1] is Ellipsis else inner
    if len(kinds) != len(items):
        raise InputError(f"{field}: got {len(items)} entries, want {len(kinds)}")
    checked_items = list(items)
    for i, of_item in enumerate(map(declared, kinds)):
        if _is_known(of_item):
            checked_items[i] = _checked(f"{field}[{i}]", items[i], of_item, sizes)
    return tuple(checked_items)


def _unify_sizes(field: str, record: Any, sizes: Sizes) -> None:
    """Raises InputError unless a record's sizes agree with the known sizes; its other sizes become known."""
    for name, spec in declarations(type(record)).items():
        value, inner = getattr(record, name), f"{field}.{name}"
        if value is None or spec.letters.startswith("..."):
            continue
        if isinstance(value, np.ndarray) and spec.letters:
            check_sizes(inner, value.shape, spec.letters, sizes)
        elif spec.letters:
            _check_length(inner, len(value), spec.letters, sizes)
        elif is_dataclass(value):
            _unify_sizes(inner, value, sizes)


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
        # The length that a letter stands for, such as 151 for T+1; the letter itself if its size is unknown.
        named, known = letters.split(), letters.split()
        for i, (name, more) in enumerate(_lengths(letters)):
            if name in before:
                known[i] = str(before[name] + more)
        meaning = "" if known == named else f" = ({', '.join(known)})"
        raise InputError(f"{field}: got shape {shape}, want ({', '.join(named)}){meaning}")


@cache
def _lengths(letters: str) -> tuple[tuple[str | int, int], ...]:
    """The letter of each length, or the length itself, and what is added to it."""
    parts = (letter.partition("+") for letter in letters.split())
    return tuple((int(name) if name.isdecimal() else name, int(more or 0)) for name, _, more in parts)


def _check_length(field: str, length: int, letter: str, sizes: Sizes) -> None:
    """Raises InputError unless the number of entries is the size that the letter stands for."""
    if length != (want := sizes.setdefault(letter, length)):
        raise InputError(f"{field}: got {length} entries, want {want}")


def _array(field: str, value: Any, spec: Declared, sizes: Sizes) -> Any:
    """An array of the declared numbers, shape and bounds."""
    array = real(field, value, f"numbers of shape ({', '.join(spec.letters.split())})")
    check_sizes(field, array.shape, spec.letters, sizes)
    if spec.dtype is np.int64:
        numbers = numbers_of(field, array)
        if not ((numbers >= 0) & (numbers == np.floor(numbers)) & (numbers < 2**53)).all():
            raise InputError(f"{field}: got {excerpt(numbers.tolist())}, want whole numbers >= 0")
        return numbers.astype(np.int64)
    if spec.bounds is not None:
        above, least, most, below = (np.nan if bound is None else bound for bound in spec.bounds)
        bad = ~np.isfinite(array) | (array <= above) | (array < least) | (array > most) | (array >= below)
        for place in np.argwhere(bad)[:1].tolist():
            check_number(f"{field}{place}", array[tuple(place)].item(), **spec.bounds._asdict())
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
    """
    check_kind(field, value, str, "text")
    if longest is not None and not (len(value) <= longest and value.isprintable()):
        raise InputError(f"{field}: got {excerpt(value)}, want one printable line of at most {longest} characters")
    if not value.isascii() and any("\ud800" <= letter <= "\udfff" for letter in value):
        raise InputError(f"{field}: got {excerpt(value)}, want text without halves of surrogate pairs")
    return value
