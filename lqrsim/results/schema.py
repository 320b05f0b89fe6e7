"""Checks of what a JSON text holds, which is what anyone may have written: each says in one line what is wrong.

A check takes the name of a field and its value, and returns the value. `parse` reads the text, `canonical` writes it.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from lqrsim.errors import InputError, check_name, check_number, excerpt

Check = Callable[[str, Any], Any]
LINE = 1000  # characters of a name or another line; more is no name
_DEPTH = 6  # of lists and objects in each other, where they may be anything


def parse(text: str | bytes) -> Any:
    """What a JSON text says. Raises ValueError for what is none, is nested too deeply, or has a name twice."""
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError:
        raise ValueError("lists or objects too deep within each other") from None


def canonical(value: Any) -> str:
    """The one JSON text of what is equal: names in order, no spaces. Raises TypeError or ValueError."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a name twice in one object")
    return found


def text(field: str, value: Any) -> str:
    """Any text that can be written."""
    if not isinstance(value, str):
        raise InputError(f"{field}: got {excerpt(value)}, want text")
    if not value.isascii() and any("\ud800" <= letter <= "\udfff" for letter in value):
        raise InputError(f"{field}: got {excerpt(value)}, want text without halves of letters")
    return value


def line(field: str, value: Any) -> str:
    """A text of one line that is not too long for a name."""
    text(field, value)
    if len(value) > LINE or any(
        letter < " " or "\x7f" <= letter <= "\x9f" or letter in "\u2028\u2029" for letter in value
    ):
        raise InputError(f"{field}: got {excerpt(value)}, want one line of at most {LINE} characters")
    return value


def number(*, at_least: float | None = None, above: float | None = None, at_most: float | None = None) -> Check:
    """A finite number within these bounds."""

    def check(field: str, value: Any) -> float:
        check_number(field, _real(field, value), at_least=at_least, above=above, at_most=at_most)
        return value

    return check


def any_number(field: str, value: Any) -> float:
    """A number, infinite ones and NaN too."""
    return _real(field, value)


def _real(field: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{field}: got {excerpt(value)}, want a number")
    try:
        float(value)
    except OverflowError:
        raise InputError(f"{field}: got {excerpt(value)}, want a number that is not so large") from None
    return value


def count(field: str, value: Any) -> int:
    """A whole number, not negative."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError(f"{field}: got {excerpt(value)}, want a whole number >= 0")
    return value


def one_of(names: Iterable[str]) -> Check:
    """One of these texts."""
    valid = list(names)
    return lambda field, value: check_name(field, value[:100] if isinstance(value, str) else value, valid)


def optional(check: Check) -> Check:
    """The same, or null."""
    return lambda field, value: None if value is None else check(field, value)


def listed(check: Check) -> Check:
    """A list of such."""

    def each(field: str, value: Any) -> list[Any]:
        if not isinstance(value, list):
            raise InputError(f"{field}: got {excerpt(value)}, want a list")
        return [check(f"{field}[{place}]", one) for place, one in enumerate(value)]

    return each


def row(*checks: Check) -> Check:
    """A list with one entry for each check."""

    def each(field: str, value: Any) -> list[Any]:
        if not isinstance(value, list) or len(value) != len(checks):
            raise InputError(f"{field}: got {excerpt(value)}, want a list of {len(checks)}")
        return [check(f"{field}[{i}]", one) for i, (check, one) in enumerate(zip(checks, value, strict=True))]

    return each


def mapped(check: Check) -> Check:
    """An object with any names, and such values."""

    def each(field: str, value: Any) -> dict[str, Any]:
        _object(field, value)
        return {line(f"{field}: a name", name): check(f"{field}.{name}", one) for name, one in value.items()}

    return each


def record(checks: Mapping[str, Check]) -> Check:
    """An object with exactly these names; each has its check."""

    def each(field: str, value: Any) -> dict[str, Any]:
        _object(field, value)
        if missing := sorted(checks.keys() - value.keys()):
            raise InputError(f"{field}: got none of {excerpt(missing[0])}, want it")
        if unknown := sorted(value.keys() - checks.keys()):
            raise InputError(f"{field}: got {excerpt(unknown[0])}, want no other than {', '.join(checks)}")
        return {name: check(f"{field}.{name}", value[name]) for name, check in checks.items()}

    return each


def anything(field: str, value: Any, depth: int = _DEPTH) -> Any:
    """Whatever JSON can say, if not in too many lists and objects in each other."""
    if isinstance(value, str):
        return text(field, value)
    if isinstance(value, list | dict):
        if depth == 0:
            raise InputError(f"{field}: got lists or objects in each other, want at most {_DEPTH}")
        if isinstance(value, list):
            return [anything(f"{field}[{i}]", one, depth - 1) for i, one in enumerate(value)]
        return {
            text(f"{field}: a name", name): anything(f"{field}.{name}", one, depth - 1) for name, one in value.items()
        }
    return value


def _object(field: str, value: Any) -> None:
    if not isinstance(value, dict):
        raise InputError(f"{field}: got {excerpt(value)}, want an object")
