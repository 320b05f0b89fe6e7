"""Arrays of constant shape for compiled code, as C has them: a bare pointer whose type knows the shape.

`a[i, j]` of a numba array unpacks a structure, wraps negative indices and counts references; LLVM removes all that
again, in seconds. A `Pointer` to blocks of constant shape is one address, and indexing it is one multiplication and one
addition; the compiled functions are as fast, and sooner compiled. Imported by compiled cores only.
"""

import math
import operator
from typing import Any

# numba's decorators have no types of their own.
# pyright: reportOptionalCall=false, reportGeneralTypeIssues=false
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

_DOUBLE = ir.DoubleType()


class Pointer(types.Type):
    """A pointer to float64 blocks of the shape `block`: `()` for a vector, `(W,)` for a matrix with rows of W."""

    def __init__(self, block: tuple[int, ...]) -> None:
        self.block = block
        super().__init__(name=f"Pointer{block}")

    def peel(self, indices: int) -> types.Type | None:
        """What is left after so many indices; None if there are too many."""
        if indices > len(self.block) + 1:
            return None
        return types.float64 if indices == len(self.block) + 1 else Pointer(self.block[indices:])

    def strides(self) -> list[int]:
        """In entries, an index at a time."""
        return [math.prod(self.block[i:]) for i in range(len(self.block) + 1)]


@register_model(Pointer)
class _PointerModel(models.PrimitiveModel):
    def __init__(self, manager: Any, pointer: Pointer) -> None:
        super().__init__(manager, pointer, _DOUBLE.as_pointer())


def _count(index: types.Type) -> int | None:
    if isinstance(index, types.Integer):
        return 1
    whole = isinstance(index, types.BaseTuple) and all(isinstance(part, types.Integer) for part in index)
    return len(index) if whole else None  # pyright: ignore[reportArgumentType]


@infer_global(operator.getitem)
class _GetItem(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        pointer, index = args
        if isinstance(pointer, Pointer) and (count := _count(index)) and (left := pointer.peel(count)):
            return signature(left, pointer, index)
        return None


@infer_global(operator.setitem)
class _SetItem(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        pointer, index, _ = args
        if isinstance(pointer, Pointer) and (count := _count(index)) and pointer.peel(count) == types.float64:
            return signature(types.none, pointer, index, types.float64)
        return None


def _address(context: Any, builder: Any, pointer: Pointer, kind: types.Type, address: Any, index: Any) -> Any:
    if isinstance(kind, types.BaseTuple):
        parts = list(zip(cgutils.unpack_tuple(builder, index, len(kind)), kind, strict=True))  # pyright: ignore
    else:
        parts = [(index, kind)]
    total = None
    for (part, of), stride in zip(parts, pointer.strides(), strict=False):
        wide = context.cast(builder, part, of, types.intp)
        scaled = builder.mul(wide, wide.type(stride)) if stride != 1 else wide
        total = scaled if total is None else builder.add(total, scaled)
    return builder.gep(address, [total], inbounds=True)


@lower_builtin(operator.getitem, Pointer, types.Any)
def _get(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    address = _address(context, builder, *sig.args, *args)
    return builder.load(address) if sig.return_type == types.float64 else address


@lower_builtin(operator.setitem, Pointer, types.Any, types.Any)
def _set(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    builder.store(args[2], _address(context, builder, *sig.args[:2], *args[:2]))
    return context.get_dummy_value()


@intrinsic(prefer_literal=True)
def stack(typingctx: Any, shape: Any) -> Any:
    """An uninitialised array of constant shape, on the stack."""
    sizes = tuple(size.literal_value for size in shape)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        block = cgutils.alloca_once(builder, ir.ArrayType(_DOUBLE, math.prod(sizes)))
        block.align = 64
        return builder.bitcast(block, _DOUBLE.as_pointer())

    return Pointer(sizes[1:])(shape), generate


@intrinsic(prefer_literal=True)
def pointer(typingctx: Any, array: Any, block: Any) -> Any:
    """The contiguous numba array `array`, whose blocks array[0], array[1], ... have that constant shape."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return context.make_array(sig.args[0])(context, builder, args[0]).data

    return Pointer(tuple(size.literal_value for size in block))(array, block), generate


@intrinsic
def readonly(typingctx: Any, array: Any) -> Any:
    """The same numba array, of a type that refuses to be written to."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return args[0]

    return array.copy(readonly=True)(array), generate


def _call(typingctx: Any, address: Any, *pointers: Any) -> Any:
    """Call the C function whose address the number `address` is, with pointers to float64."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [arg.type for arg in args[1:]])
        function = builder.inttoptr(builder.fptosi(args[0], ir.IntType(64)), kind.as_pointer())
        builder.call(function, args[1:])
        return context.get_dummy_value()

    return types.none(address, *pointers), generate


@intrinsic
def invoke(typingctx: Any, address: Any, x: Any, u: Any, data: Any, out: Any) -> Any:
    """Call the function at `address`, which writes to one array."""
    return _call(typingctx, address, x, u, data, out)


@intrinsic
def invoke_writing(typingctx: Any, address: Any, x: Any, u: Any, data: Any, a: Any, b: Any) -> Any:
    """Call the function at `address`, which writes to two arrays."""
    return _call(typingctx, address, x, u, data, a, b)
