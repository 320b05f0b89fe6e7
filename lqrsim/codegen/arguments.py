"""How arguments reach compiled code: arrays as pointers to blocks of constant shape, records of these, rows."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np


def kind_of(argument: Any) -> tuple[Any, ...]:
    """What the type of an argument is to be: an array's is its block, for the number of blocks is not known."""
    if isinstance(argument, np.ndarray):
        if argument.dtype.names:
            return ("rows", *argument.dtype.names)
        return ("array", *argument.shape[1:])
    if isinstance(argument, tuple) and hasattr(argument, "_fields"):
        return ("record", type(argument).__name__, *map(kind_of, argument))
    if isinstance(argument, tuple):
        return ("vectors", len(argument))
    kinds = ((bool, np.bool_), "bool"), ((int, np.integer), "int"), ((float, np.floating), "float")
    return (next(name for types, name in kinds if isinstance(argument, types)),)


def leaves(arguments: Iterable[Any]) -> list[Any]:
    """The arguments with records taken apart: numba looks at named tuples in Python, at what is in them in C."""
    found: list[Any] = []
    _take_apart(arguments, found)
    return found


def _take_apart(arguments: Iterable[Any], found: list[Any]) -> None:
    for argument in arguments:
        if isinstance(argument, tuple) and hasattr(argument, "_fields"):
            _take_apart(argument, found)
        else:
            found.append(argument)


def converted(kind: tuple[Any, ...], names: Iterator[str]) -> str:
    """The expression that makes of the next leaves, by their names, what kernels take: pointers, records of these."""
    match kind[0]:
        case "array":
            return f"pointer({next(names)}, {kind[1:]})"
        case "vectors":
            name = next(names)
            return f"({' '.join(f'pointer({name}[{i}], ()),' for i in range(kind[1]))})"
        case "record":
            return f"{kind[1]}({', '.join(converted(part, names) for part in kind[2:])})"
    return next(names)


def signature_of(kinds: Iterable[tuple[Any, ...]]) -> Any:
    """The types of numba for the leaves of arguments of these kinds."""
    import numba
    from numba import types

    def each(kind: tuple[Any, ...]) -> Iterator[Any]:
        match kind[0]:
            case "array":
                yield types.Array(types.float64, len(kind), "C")
            case "rows":
                row = np.dtype([(name, np.float64) for name in kind[1:]])
                yield types.Array(numba.from_dtype(row), 1, "C")
            case "vectors":
                vector = types.Array(types.float64, 1, "C")
                yield types.UniTuple(vector, kind[1]) if kind[1] else types.Tuple(())
            case "record":
                for part in kind[2:]:
                    yield from each(part)
            case "bool":
                yield types.boolean
            case "int":
                yield types.int64
            case _:
                yield types.float64

    return tuple(one for kind in kinds for one in each(kind))
