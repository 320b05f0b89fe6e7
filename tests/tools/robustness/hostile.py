"""Values that replace arguments: other types, other shapes, extremes, nested values, and objects that raise."""

import contextlib
import dataclasses
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


class Deliberate(Exception):
    """An exception of a user's own function, which may come through as it is."""


class DeliberateValue(Deliberate, ValueError):
    """The same, as an exception of a usual kind."""


class Biting:
    """An object that raises whatever it is asked."""

    def __init__(self, where: str) -> None:
        self.where = where

    def bite(self, *_: object) -> Any:
        raise RuntimeError("no")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise RuntimeError("no")


def biting(where: str) -> Any:
    """An object whose method of that name raises."""
    return type("Biting", (Biting,), {where: raising if where == "__call__" else Biting.bite})(where)


class Text(str):
    """Text of a class of its own."""


class Unequal:
    """An object whose comparison raises."""

    def __eq__(self, other: object) -> Any:
        raise RuntimeError("no")

    __hash__ = None  # type: ignore[assignment]


class Kind:
    """A class in place of an object."""


def endless() -> Any:
    """A generator without an end."""
    while True:
        yield 1.0


def nested(depth: int) -> Any:
    found: Any = 1.0
    for _ in range(depth):
        found = [found]
    return found


def raising(*_: object, **__: object) -> Any:
    raise Deliberate("as it was told")


def failing(*_: object, **__: object) -> Any:
    raise DeliberateValue("two\nlines")


def answering(answer: Any) -> Callable[..., Any]:
    """A function that returns this value for all arguments."""

    def function(*_: object, **__: object) -> Any:
        return answer

    return function


def twisted(function: Callable[..., Any], seed: int) -> Callable[..., Any]:
    """The function, but that something is wrong with what it returns, or with when it does."""
    rng, calls = np.random.default_rng(seed), [0]
    late = int(rng.integers(3))  # as often, it is right

    def twisting(*arguments: Any) -> Any:
        calls[0] += 1
        returned = function(*arguments)
        if calls[0] <= late or returned is None:
            return returned
        if callable(returned):
            return twisted(returned, seed + 1)
        return spoilt(rng, returned, [None])

    with contextlib.suppress(Exception):  # what tells nothing about itself
        twisting.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]
    return twisting


PLAIN: list[Callable[[], Any]] = [
    lambda: None, lambda: True, lambda: 0, lambda: -1, lambda: 1, lambda: 3, lambda: 2.5, lambda: -0.0,
    lambda: 2**31, lambda: 10**20, lambda: 10**400, lambda: 1e20, lambda: 1e300, lambda: -1e300, lambda: 5e-324,
    lambda: 1e9, lambda: 10**6, lambda: 10**9,
    lambda: float("nan"), lambda: float("inf"), lambda: -float("inf"), lambda: 1j,
    lambda: "", lambda: "a", lambda: "1", lambda: "x" * 5000, lambda: "a\nb", lambda: "\0", lambda: "ünï☃",
    lambda: "\ud800",
    lambda: b"bytes", lambda: Text("smooth"), lambda: "../..", lambda: ".", lambda: "nan", lambda: "%s{}$x^",
    list, lambda: (), dict, lambda: set(), lambda: [[]], lambda: [None], lambda: ["a", "b"], lambda: {"a": 1},
    lambda: [1.0], lambda: [1.0, 2.0], lambda: [1.0, 2.0, 3.0], lambda: [[1.0, 2.0], [3.0]], lambda: range(3),
    lambda: {1: 2}, lambda: {"x": "m", "v": "m"}, lambda: {0.5}, lambda: nested(50), lambda: nested(5000),
    lambda: (i for i in range(3)), endless, lambda: iter([1.0]), lambda: [1.0] * 1000,
    lambda: np.zeros(0), lambda: np.zeros((0, 3)), lambda: np.zeros((3, 0)), lambda: np.array(1.0),
    lambda: np.float32(2),
    lambda: np.int64(3), lambda: np.zeros(3), lambda: np.zeros((3, 3)), lambda: np.ones((2, 2, 2)), lambda: -np.eye(3),
    lambda: np.zeros(3, dtype=complex), lambda: np.array(["a", "b"]), lambda: np.array([1, None], dtype=object),
    lambda: np.full(3, np.nan), lambda: np.full((2, 3), np.inf), lambda: np.zeros(2, dtype="datetime64[s]"),
    lambda: np.zeros((), dtype=[("a", "f8")]), lambda: np.ma.masked_array([1.0, 2.0, 3.0], mask=[True, False, False]),
    lambda: np.broadcast_to(0.0, (10**7, 10**4)), lambda: memoryview(b"abc"), lambda: np.full(3, 1e300),
    lambda: np.matrix("1 2"),
    lambda: object(), lambda: Kind, lambda: Ellipsis, lambda: NotImplemented, lambda: np,
    lambda: print, lambda: raising, lambda: failing, lambda: (lambda: 1), lambda: (lambda a: a),
    lambda: (lambda *a: a[0]), lambda: (lambda x, u, p: x[5]),
    *(lambda answer=answer: answering(answer) for answer in (
        None, 1.0, "text", [], [1.0, 2.0], np.zeros(3), np.full((1, 3), np.nan), np.zeros((7, 7)), 1j, object(), True,
    )),
    *(lambda where=where: biting(where) for where in (
        "__len__", "__iter__", "__array__", "__float__", "__index__", "__repr__", "__str__", "__call__", "__getitem__",
        "__bool__", "__fspath__", "__hash__", "__contains__", "keys", "__add__", "shape",
    )),
    lambda: Unequal(), lambda: lambda *_: biting("__repr__"),
]  # fmt: skip


def spoilt(rng: np.random.Generator, value: Any, others: list[Any], depth: int = 0) -> Any:
    """Something hostile in the place of a valid value: what it is not, or itself with something wrong."""
    if rng.random() < 0.3 or depth > 3:
        return PLAIN[rng.integers(len(PLAIN))]()
    if rng.random() < 0.12:
        return others[rng.integers(len(others))]
    if isinstance(value, np.ndarray):
        return _array(rng, value)
    if isinstance(value, bool) or value is None:
        return PLAIN[rng.integers(len(PLAIN))]()
    if isinstance(value, int | float):
        return _number(rng, value)
    if isinstance(value, tuple | list) and value:
        return _sequence(rng, value, others, depth)
    if isinstance(value, Mapping) and value:
        return _mapping(rng, dict(value), others, depth)
    if isinstance(value, str):
        return [
            value.upper(),
            value + " ",
            value[:-1],
            value * 500,
            [value],
            value.encode(),
            value + "\n",
            value + ",a",
        ][rng.integers(8)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [field.name for field in dataclasses.fields(value) if field.init]
        name = fields[rng.integers(len(fields))]
        # What refuses it refuses it here: an InputError is an answer, too.
        return dataclasses.replace(value, **{name: spoilt(rng, getattr(value, name), others, depth + 1)})
    if callable(value) and not isinstance(value, type) and rng.random() < 0.8:
        return twisted(value, int(rng.integers(2**31)))
    return [lambda: [value], lambda: (value, value), lambda: {"a": value}, lambda: Kind, lambda: answering(value)][
        rng.integers(5)
    ]()


def _number(rng: np.random.Generator, value: float) -> Any:
    spoil: list[Callable[[], Any]] = [
        lambda: -value, lambda: 0 * value, lambda: str(value), lambda: [value], lambda: 1e6 * value,
        lambda: complex(value),
        lambda: np.array([value]), lambda: np.array([[value]] * 2), lambda: float(value), lambda: int(value),
        lambda: value + 1, lambda: value - 1, lambda: 1e-9 * value, lambda: value + 0.5, lambda: np.float32(value),
        lambda: 1e9 * value, lambda: 1000 * value,
    ]  # fmt: skip
    return spoil[rng.integers(len(spoil))]()


def _array(rng: np.random.Generator, value: np.ndarray) -> Any:
    def changed(new: float) -> np.ndarray:
        copy = np.array(value, dtype=np.float64) if value.dtype.kind in "biuf" else value.astype(object)
        if copy.size:
            copy.flat[rng.integers(copy.size)] = new
        return copy

    spoil: list[Callable[[], Any]] = [
        lambda: value.T, lambda: value[..., :-1] if value.ndim else value, lambda: value[:0] if value.ndim else value,
        lambda: value[None], lambda: np.concatenate([value, value]) if value.ndim else value, lambda: value.ravel(),
        lambda: value.tolist(), lambda: value.astype(object), lambda: value.astype(str), lambda: changed(np.nan),
        lambda: changed(np.inf), lambda: changed(1e300),
        lambda: -changed(1.0) if value.dtype.kind in "iuf" else value,
        lambda: value[:-1] if value.ndim else value, lambda: dict(enumerate(value.ravel()[:5])),
        lambda: value[::-1] if value.ndim else value,
        lambda: value.reshape(-1, 1), lambda: value.astype(complex) if value.dtype.kind in "biuf" else value,
        lambda: changed(0.0),
        lambda: value.astype(np.float16) if value.dtype.kind in "biuf" else value,
        lambda: (row for row in value.ravel()), lambda: changed(2.0),
    ]  # fmt: skip
    return spoil[rng.integers(len(spoil))]()


def _sequence(rng: np.random.Generator, value: Any, others: list[Any], depth: int) -> Any:
    kind, items, place = type(value), list(value), int(rng.integers(len(value)))
    which = rng.integers(7)
    if which == 0:
        return items[:-1]
    if which == 1:
        return [*items, items[0]]
    if which == 2:
        return iter(items)
    if which == 3:
        return items[0]
    if which == 4:
        return items * 400
    items[place] = spoilt(rng, items[place], others, depth + 1)
    return items if kind is list or not hasattr(kind, "_fields") else kind(*items)


def _mapping(rng: np.random.Generator, value: dict[Any, Any], others: list[Any], depth: int) -> Any:
    key = list(value)[rng.integers(len(value))]
    which = rng.integers(6)
    if which == 0:
        return {name: one for name, one in value.items() if name != key}
    if which == 1:
        return value | {"another": value[key]}
    if which == 2:
        return list(value)
    if which == 3:
        return {
            (name if name != key else ["a\nb", 5, "", "x" * 3000, None][rng.integers(5)]): one
            for name, one in value.items()
        }
    return value | {key: spoilt(rng, value[key], others, depth + 1)}
