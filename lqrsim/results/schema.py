"""Checks of JSON from untrusted files; each reports in one line what is wrong.

A check takes the name of a field and its value, and returns the value. `parse` reads the text, `canonical` writes it.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from lqrsim.errors import InputError, check_count, check_name, check_number, excerpt
from lqrsim.results.fields import LARGEST_COUNT, LINE, check_string

Check = Callable[[str, Any], Any]
_DEPTH = 6  # nested lists and objects in `anything`


def parse(text: str | bytes) -> Any:
    """Parse a JSON text. Raises ValueError if it is none, is nested too deeply, or has a name twice in an object."""
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError:
        raise ValueError("lists or objects too deep within each other") from None


def canonical(value: Any) -> str:
    """The canonical JSON text of a value: sorted names, no spaces. Raises TypeError or ValueError."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a name twice in one object")
    return found


def text(field: str, value: Any) -> str:
    """Any text that can be encoded."""
    return check_string(field, value)


def line(field: str, value: Any) -> str:
    """One printable line of text, not too long for a name."""
    return check_string(field, value, LINE)


def number(*, at_least: float | None = None, above: float | None = None, at_most: float | None = None) -> Check:
    """The check for a finite number within bounds."""

    def check(field: str, value: Any) -> Any:
        check_number(field, value, at_least=at_least, above=above, at_most=at_most)
        return value  # as it was, for a hash depends on whether it is a whole number

    return check


def count(field: str, value: Any) -> int:
    """A whole number >= 0."""
    return check_count(field, value, at_least=0, at_most=LARGEST_COUNT)


def one_of(names: Iterable[str]) -> Check:
    """The check for one of these texts."""
    valid = list(names)
    return lambda field, value: check_name(field, value[:100] if isinstance(value, str) else value, valid)


def optional(check: Check) -> Check:
    """The check for null, or what another check allows."""
    return lambda field, value: None if value is None else check(field, value)


def listed(check: Check) -> Check:
    """The check for a list whose entries all pass a check."""

    def each(field: str, value: Any) -> list[Any]:
        if not isinstance(value, list):
            raise InputError(f"{field}: got {excerpt(value)}, want a list")
        return [check(f"{field}[{place}]", one) for place, one in enumerate(value)]

    return each


def row(*checks: Check) -> Check:
    """The check for a list with one entry for each check."""

    def each(field: str, value: Any) -> list[Any]:
        if not isinstance(value, list) or len(value) != len(checks):
            raise InputError(f"{field}: got {excerpt(value)}, want a list of {len(checks)}")
        return [check(f"{field}[{i}]", one) for i, (check, one) in enumerate(zip(checks, value, strict=True))]

    return each


def mapped(check: Check) -> Check:
    """The check for an object with any names whose values all pass a check."""

    def each(field: str, value: Any) -> dict[str, Any]:
        _object(field, value)
        return {line(f"{field}: a name", name): check(f"{field}.{name}", one) for name, one in value.items()}

    return each


def record(checks: Mapping[str, Check]) -> Check:
    """The check for an object with exactly these names, each with its own check."""

    def each(field: str, value: Any) -> dict[str, Any]:
        _object(field, value)
        if missing := sorted(checks.keys() - value.keys()):
            raise InputError(f"{field}: got none of {excerpt(missing[0])}, want it")
        if unknown := sorted(value.keys() - checks.keys()):
            raise InputError(f"{field}: got {excerpt(unknown[0])}, want only {', '.join(checks)}")
        return {name: check(f"{field}.{name}", value[name]) for name, check in checks.items()}

    return each


def anything(field: str, value: Any, depth: int = _DEPTH) -> Any:
    """Any JSON value, with a limit to nested lists and objects."""
    if isinstance(value, str):
        return text(field, value)
    if isinstance(value, list | dict):
        if depth == 0:
            raise InputError(f"{field}: got more nested lists or objects, want at most {_DEPTH}")
        if isinstance(value, list):
            return [anything(f"{field}[{i}]", one, depth - 1) for i, one in enumerate(value)]
        return {
            text(f"{field}: a name", name): anything(f"{field}.{name}", one, depth - 1) for name, one in value.items()
        }
    return value


def _object(field: str, value: Any) -> None:
    if not isinstance(value, dict):
        raise InputError(f"{field}: got {excerpt(value)}, want an object")
