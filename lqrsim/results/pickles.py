"""Pickles of what has code and models inside: they are for the version of lqrsim that wrote them.

Each pickle names `_empty` by the address of this module, which therefore stays.
"""

from typing import Any, Self

from lqrsim.errors import InputError
from lqrsim.machine import versions


class OneVersion:
    """Base of what is pickled for workers only. Its parts move from module to module, so that another version of lqrsim
    could not find them; it says so before it looks for any. Results are for good: `lqrsim.save`.
    """

    def __new__(cls, *arguments: Any, **named: Any) -> Self:
        if not (arguments or named):  # a pickle of lqrsim 0.2, which says no version, makes it without arguments
            raise _refusal(cls, "no arguments, as from a pickle of another version of lqrsim")
        return super().__new__(cls)

    def __reduce__(self) -> tuple[Any, ...]:
        return _empty, (type(self), versions()["lqrsim"]), self.__getstate__()


def _empty(kind: type, version: str) -> Any:
    """An object without attributes. Raises InputError for a pickle of another version."""
    if version != versions()["lqrsim"]:
        raise _refusal(kind, f"a pickle of lqrsim {version}")
    return object.__new__(kind)


def _refusal(kind: type, got: str) -> InputError:
    return InputError(f"{kind.__name__}: got {got}, want it made anew, by the calls that made it, and a pickle of that")
