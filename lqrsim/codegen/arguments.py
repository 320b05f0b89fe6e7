"""How arguments reach compiled code: arrays as pointers to blocks of constant shape, records of these, rows."""

from typing import Any

import numpy as np

from lqrsim.kernels import records


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


def converted(name: str, kind: tuple[Any, ...]) -> str:
    """The expression that makes of an argument what kernels take: pointers of arrays."""
    match kind[0]:
        case "array":
            return f"pointer({name}, {kind[1:]})"
        case "vectors":
            return f"({' '.join(f'pointer({name}[{i}], ()),' for i in range(kind[1]))})"
        case "record":
            fields = getattr(records, kind[1])._fields
            parts = (converted(f"{name}.{field}", part) for field, part in zip(fields, kind[2:], strict=True))
            return f"{kind[1]}({', '.join(parts)})"
    return name


def signature_of(kinds: tuple[tuple[Any, ...], ...]) -> Any:
    """The types of numba for arguments of these kinds."""
    import numba
    from numba import types

    def one(kind: tuple[Any, ...]) -> Any:
        match kind[0]:
            case "array":
                return types.Array(types.float64, len(kind), "C")
            case "rows":
                row = np.dtype([(name, np.float64) for name in kind[1:]])
                return types.Array(numba.from_dtype(row), 1, "C")
            case "vectors":
                vector = types.Array(types.float64, 1, "C")
                return types.UniTuple(vector, kind[1]) if kind[1] else types.Tuple(())
            case "record":
                return types.BaseTuple.from_types([one(part) for part in kind[2:]], getattr(records, kind[1]))
            case "bool":
                return types.boolean
            case "int":
                return types.int64
        return types.float64

    return tuple(one(kind) for kind in kinds)
