"""The kernels' subset of Python. `printer.py` prints it to LLVM IR.

A kernel is a function of positional arguments. It also runs as plain Python on NumPy arrays, with the same results to
rounding. Anything else is refused with file and line.

Types
    float           float64. Arithmetic may be fused and reordered, but NaN and infinity keep their meaning.
    int             64 bits. An overflow is undefined.
    bool            The result of comparisons.
    pointer         A C-ordered float64 array; the shape of its blocks a[0], a[1], ... is constant. Fewer indices than
                    dimensions give a pointer to a block.
    pointers        A tuple of vectors; its length is not part of the type.
    struct array    A structured array whose fields are float64; its entries are structs, as in `log[i].cost`.
    tuple, record   Of any of these; records are the named tuples of `kernels/records.py`.

Statements
    assignments     To names, entries and fields; several at once, chained and augmented ones are allowed. A name has
                    one type; a name that gets ints and floats is a float.
    control flow    if, for over range, while, break, continue, return, pass. A constant condition is decided when
                    compiling, and the other branch is not compiled.
    calls           Of other kernels. No recursion, no keywords.

Expressions
    + - * / // %    As in Python, including signs. A division by zero gives infinity or NaN; // and % of ints give 0.
    **              Of any float; whole exponents should be constant.
    < <= == ...     May be chained; all parts are evaluated. and, or, not of bools, and of ints in conditions.
                    Conditional expressions.
    a[i, j]         Indices are nonnegative ints; of a tuple, any int if its entries have one type.
    min, max        Of two or more. abs, int, float, len of a tuple.
    math            The functions in `UNARY`, `BINARY` and `TESTS`, of which floor, ceil and trunc return floats; and
                    inf, nan, pi, e.

Kernels may also use the functions of `kernels/declarations.py`: `stack` and `zeros` for work arrays of constant shape,
`call` and `call_for_value` for C functions at an address, `at` and `rows_at` for memory at an address, atomic access to
words that threads share, and `power_of_two`. An address is an int or a float64, which represents all integers up to
2^53, beyond any address of a process. The decorators `inline`, `outline`, `compact` and `exact` say how a kernel is
compiled.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lqrsim.errors import InputError

# Functions of one float, by their names in `math`: functions that LLVM knows, and functions of the C library.
UNARY = {
    name: f"llvm.{name}.f64" for name in ("sqrt", "sin", "cos", "exp", "log", "log10", "log2", "floor", "ceil", "trunc")
} | {name: name for name in (
    "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "expm1", "log1p", "exp2", "cbrt",
    "erf", "erfc", "lgamma",
)} | {"fabs": "llvm.fabs.f64", "gamma": "tgamma"}  # fmt: skip
BINARY = {
    "copysign": "llvm.copysign.f64", "pow": "llvm.pow.f64", "atan2": "atan2", "hypot": "hypot", "fmod": "fmod",
}  # fmt: skip
SCALES = {"degrees": 180 / np.pi, "radians": np.pi / 180}
TESTS = ("isnan", "isinf", "isfinite")
CONSTANTS = ("inf", "nan", "pi", "e", "tau")
MATH = (*UNARY, *BINARY, *SCALES, *TESTS, *CONSTANTS)


class SubsetError(InputError):
    """The exception for code outside of the subset, with its position."""


@dataclass(frozen=True)
class Scalar:
    """A number."""

    name: str
    llvm: str


FLOAT, INT, BOOL = Scalar("float", "double"), Scalar("int", "i64"), Scalar("bool", "i1")
INT32 = Scalar("32-bit int", "i32")  # only for arguments of C functions


@dataclass(frozen=True)
class Pointer:
    """A pointer to float64 blocks of the shape `block`: `()` for a vector, `(W,)` for a matrix with rows of W.

    The entries of a row may have names, `fields`: a structured array is a matrix of named columns, a struct its row.
    """

    block: tuple[int, ...] = ()
    fields: tuple[str, ...] = ()


@dataclass(frozen=True)
class Pointers:
    """A table of addresses of vectors."""


@dataclass(frozen=True)
class Group:
    """A tuple; a record if it has names."""

    members: tuple["Type", ...]
    record: str = ""
    fields: tuple[str, ...] = ()


Type = Scalar | Pointer | Pointers | Group

VECTOR = Pointer()


def describe(kind: Type | None) -> str:
    """Name of a type in messages."""
    match kind:
        case None:
            return "nothing"
        case Scalar(name=name):
            return f"a {name}" if name != "int" else "an int"
        case Pointer(block=block, fields=fields) if fields:
            return "a structured array" if block else "a struct"
        case Pointer(block=block):
            return f"an array of {len(block) + 1} dimensions"
        case Pointers():
            return "a tuple of vectors"
        case Group(record=record):
            return f"a {record}" if record else "a tuple"


def scalars(kind: Type) -> list[Scalar | Pointer | Pointers]:
    """The parts of a type that are neither tuples nor records."""
    if isinstance(kind, Group):
        return [scalar for member in kind.members for scalar in scalars(member)]
    return [kind]


def llvm_type(kind: Type) -> str:
    """LLVM's name of a type."""
    if isinstance(kind, Group):
        return "{" + ", ".join(llvm_type(member) for member in kind.members) + "}"
    return kind.llvm if isinstance(kind, Scalar) else "ptr"


def join(one: Type, other: Type) -> Type | None:
    """The type that holds values of both types; None if there is none."""
    if one == other:
        return one
    if isinstance(one, Scalar) and isinstance(other, Scalar) and INT32 not in (one, other):
        return min((one, other), key=(FLOAT, INT, BOOL).index)
    if isinstance(one, Group) and isinstance(other, Group):
        if (one.record, len(one.members)) != (other.record, len(other.members)):
            return None
        members = tuple(join(a, b) for a, b in zip(one.members, other.members, strict=True))
        return None if None in members else Group(members, one.record, one.fields)  # pyright: ignore[reportArgumentType]
    return None


def type_of(argument: Any) -> Type:
    """The type of an argument from Python. Raises TypeError if the subset has no such type."""
    if isinstance(argument, np.ndarray):
        names = argument.dtype.names or ()
        return Pointer((*argument.shape[1:], len(names)), names) if names else Pointer(argument.shape[1:])
    if isinstance(argument, (bool, np.bool_)):
        return BOOL
    if isinstance(argument, (int, np.integer)):
        return INT
    if isinstance(argument, (float, np.floating)):
        return FLOAT
    if isinstance(argument, tuple):
        members = tuple(map(type_of, argument))
        if hasattr(argument, "_fields"):
            return Group(members, type(argument).__name__, argument._fields)  # pyright: ignore[reportAttributeAccessIssue]
        return Pointers()
    raise TypeError(f"got {type(argument).__name__}, want an array, a number or a tuple of these")
