"""Memory and functions of a C library, for compiled code: numbers as addresses, and words that threads share.

An address is kept in a float64, which has all integers up to 2^53, beyond any address of a process. Imported by
compiled cores only.
"""

from typing import Any

# numba's decorators have no types of their own.
# pyright: reportOptionalCall=false
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from lqrsim.codegen.pointers import Pointer

_WORD, _INT = ir.IntType(64), ir.IntType(32)


def _pointer(builder: Any, address: Any, to: Any) -> Any:
    return builder.inttoptr(builder.fptosi(address, _WORD), to.as_pointer())


def _word(builder: Any, address: Any, index: Any) -> Any:
    return builder.gep(_pointer(builder, address, _WORD), [index])


@intrinsic
def at(typingctx: Any, address: Any) -> Any:
    """The float64 numbers at an address, as a pointer to index."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _pointer(builder, args[0], ir.DoubleType())

    return Pointer(())(address), generate


@intrinsic(prefer_literal=True)
def rows_at(typingctx: Any, address: Any, width: Any) -> Any:
    """The same as rows of a constant width."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _pointer(builder, args[0], ir.DoubleType())

    return Pointer((width.literal_value,))(address, width), generate


@intrinsic
def call(typingctx: Any, function: Any, first: Any, second: Any) -> Any:
    """Call the C function at an address with two pointers."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        byte = ir.IntType(8)
        kind = ir.FunctionType(ir.VoidType(), [byte.as_pointer()] * 2)
        builder.call(_pointer(builder, args[0], kind), [_pointer(builder, one, byte) for one in args[1:3]])
        return context.get_dummy_value()

    return types.none(function, first, second), generate


@intrinsic
def call_with_two(typingctx: Any, function: Any, first: Any, second: Any, third: Any, fourth: Any) -> Any:
    """Call the C function at an address with two pointers and two ints."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        byte = ir.IntType(8)
        kind = ir.FunctionType(ir.VoidType(), [byte.as_pointer(), byte.as_pointer(), _INT, _INT])
        numbers = [builder.trunc(one, _INT) for one in args[3:]]
        pointers = [_pointer(builder, one, byte) for one in args[1:3]]
        builder.call(_pointer(builder, args[0], kind), [*pointers, *numbers])
        return context.get_dummy_value()

    return types.none(function, first, second, types.int64, types.int64), generate


@intrinsic
def call_alone(typingctx: Any, function: Any) -> Any:
    """Call the C function at an address that takes nothing."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.call(_pointer(builder, args[0], ir.FunctionType(_INT, [])), [])
        return context.get_dummy_value()

    return types.none(function), generate


@intrinsic
def claim(typingctx: Any, flags: Any, index: Any) -> Any:
    """Set a flag, an int64 at an address, from 0 to 1; 1 if it was this thread that did, else 0."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        word, none, one = _word(builder, *args), ir.Constant(_WORD, 0), ir.Constant(_WORD, 1)
        outcome = builder.cmpxchg(word, none, one, "acq_rel", "acquire")
        return builder.zext(builder.extract_value(outcome, 1), _WORD)

    return types.int64(flags, types.int64), generate


@intrinsic
def load(typingctx: Any, words: Any, index: Any) -> Any:
    """One of the int64 at an address, which threads share."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load_atomic(_word(builder, *args), "acquire", 8)

    return types.int64(words, types.int64), generate


@intrinsic
def store(typingctx: Any, words: Any, index: Any, value: Any) -> Any:
    """Write one of them; what was written before it is there for who then loads it."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store_atomic(args[2], _word(builder, *args[:2]), "release", 8)
        return context.get_dummy_value()

    return types.none(words, types.int64, types.int64), generate


@intrinsic
def fetch_add(typingctx: Any, words: Any, index: Any, value: Any) -> Any:
    """Add to one of them, and return what it was before."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.atomic_rmw("add", _word(builder, *args[:2]), args[2], "acq_rel")

    return types.int64(words, types.int64, types.int64), generate
