"""Numbers that know how far they may be off, however a compiler orders sums and products; and programs run on them.

A bound is what rounding adds up to, in units of the terms: of `a + b - a` those are a, b and a again, whatever cancels.
Numbers of few bits, as sums and products of multiples of 1/256 have, are exact in any order. Where rounding decides
what a comparison says, or to which side a number is rounded, `Unsure` is raised: then nothing can be compared.
"""

import ast
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

EPSILON = 2.0**-52
ULPS = 16  # of functions of the C library or NumPy; some are off by four


class Unsure(Exception):
    """The next step depends on rounding, or numbers are too large for useful bounds."""


def _few_bits(number: float, size: float) -> bool:
    return size < 2**18 and (256 * number).is_integer()


class Tracked:
    """A float64, a bound on its error, and the sum of the sizes of its terms."""

    __slots__ = ("error", "size", "value")

    def __init__(self, value: float, error: float, size: float) -> None:
        if not abs(size) < 1e12:
            raise Unsure
        exact = error == 0 and _few_bits(value, size)
        self.value, self.size = float(value), size
        self.error = 0.0 if exact else error + 2 * EPSILON * size

    def __add__(self, other: Any) -> "Tracked":
        b = tracked(other)
        return Tracked(self.value + b.value, self.error + b.error, self.size + b.size)

    def __sub__(self, other: Any) -> "Tracked":
        b = tracked(other)
        return Tracked(self.value - b.value, self.error + b.error, self.size + b.size)

    def __mul__(self, other: Any) -> "Tracked":
        b = tracked(other)
        return Tracked(self.value * b.value, self.size * b.error + b.size * self.error, self.size * b.size)

    def __rsub__(self, other: Any) -> "Tracked":
        return tracked(other) - self

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> "Tracked":
        return self * -1

    def __pos__(self) -> "Tracked":
        return self

    def __abs__(self) -> "Tracked":
        return -self if self.value < 0 else self

    def __floordiv__(self, other: Any) -> "Tracked":
        b = tracked(other)
        ratio = self.value / b.value
        off = (self.error + abs(ratio) * b.error) / (abs(b.value) - b.error) if abs(b.value) > b.error else math.inf
        if off and math.floor(ratio - off - 1e-9) != math.floor(ratio + off + 1e-9):
            raise Unsure
        whole = self.value // b.value
        return Tracked(whole, 0.0, abs(whole))

    def __mod__(self, other: Any) -> "Tracked":
        b, whole = tracked(other), self // other
        rest = self.value % b.value
        return Tracked(rest, self.error + abs(whole.value) * b.error, abs(self.value) + abs(b.value))

    def __rfloordiv__(self, other: Any) -> "Tracked":
        return tracked(other) // self

    def __rmod__(self, other: Any) -> "Tracked":
        return tracked(other) % self

    def _compared(self, other: Any) -> float:
        b = tracked(other)
        difference, error = self.value - b.value, self.error + b.error
        if error and abs(difference) <= 4 * error:
            raise Unsure
        return difference

    def __lt__(self, other: Any) -> bool:
        return self._compared(other) < 0

    def __le__(self, other: Any) -> bool:
        return self._compared(other) <= 0

    def __gt__(self, other: Any) -> bool:
        return self._compared(other) > 0

    def __ge__(self, other: Any) -> bool:
        return self._compared(other) >= 0

    def __eq__(self, other: object) -> bool:
        return self._compared(other) == 0

    def __ne__(self, other: object) -> bool:
        return self._compared(other) != 0

    __hash__ = None  # pyright: ignore[reportAssignmentType]


def tracked(number: Any) -> Tracked:
    return number if isinstance(number, Tracked) else Tracked(float(number), 0.0, abs(float(number)))


def divide(a: Any, b: Any) -> Tracked:
    a, b = tracked(a), tracked(b)
    if not abs(b.value) > 1e6 * b.error:
        raise Unsure
    size = a.size / abs(b.value)
    return Tracked(a.value / b.value, (a.error + size * b.error) / abs(b.value) * 1.01 + 2 * EPSILON * size, size)


def power(base: Any, exponent: Any) -> Any:
    """Power; compiled code multiplies where the exponent is whole."""
    if isinstance(exponent, int):
        if isinstance(base, int) and exponent >= 0:
            return base**exponent
        total = tracked(1.0)
        for _ in range(abs(exponent)):
            total = total * base
        return total if exponent >= 0 else divide(1.0, total)
    return _smooth(lambda x: math.pow(x, tracked(exponent).value))(base)


def _smooth(function: Callable[[float], float]) -> Callable[[Any], Tracked]:
    """A function of a number; its error is its change between the number's bounds."""

    def run(number: Any) -> Tracked:
        x = tracked(number)
        try:
            ends = [function(x.value + side * x.error) for side in (-1, 1)]
        except (ValueError, OverflowError):
            raise Unsure from None
        value = function(x.value)
        off = 2 * max(abs(end - value) for end in ends)
        return Tracked(value, off + ULPS * EPSILON * abs(value), abs(value))

    return run


def _extreme(plain: Callable[..., Any]) -> Callable[..., Any]:
    def run(*numbers: Any) -> Any:
        if not any(isinstance(one, float | Tracked) for one in numbers):
            return plain(numbers)
        each = [tracked(one) for one in numbers]
        value = plain(one.value for one in each)
        error = max(one.error for one in each)  # of whichever it is: those near to it are as good
        return Tracked(value, error, abs(value)) if error else tracked(value)

    return run


def _whole(number: Any) -> int:
    if not isinstance(number, Tracked):
        return int(number)
    if number.error and int(number.value - 2 * number.error) != int(number.value + 2 * number.error):
        raise Unsure
    return int(number.value)


class _Explicit(ast.NodeTransformer):
    """Floats, quotients and powers by the functions above: those of two ints are floats, too."""

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        return ast.Call(ast.Name("tracked", ast.Load()), [node], []) if isinstance(node.value, float) else node

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        self.generic_visit(node)
        name = {ast.Div: "divide", ast.Pow: "power"}.get(type(node.op))
        return ast.Call(ast.Name(name, ast.Load()), [node.left, node.right], []) if name else node

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.stmt:
        if not isinstance(node.op, ast.Div):
            return self.generic_visit(node)  # pyright: ignore[reportReturnType]
        old = ast.parse(ast.unparse(node.target), mode="eval").body
        return self.visit(ast.Assign([node.target], ast.BinOp(old, ast.Div(), node.value)))


def functions_on_tracked(text: str, names: Mapping[str, Any]) -> dict[str, Any]:
    """A program's functions for tracked numbers; arrays hold objects.

    Args:
      names: what else it uses.
    """
    math_functions = ("sin", "cos", "exp", "log", "sqrt", "tanh", "atan", "cbrt", "expm1", "log1p", "fabs")
    given: dict[str, Any] = {name: _smooth(getattr(math, name)) for name in math_functions}
    given |= {"tracked": tracked, "divide": divide, "power": power, "min": _extreme(min), "max": _extreme(max)}
    given |= {"int": _whole, "float": tracked, "stack": lambda *shape: np.empty(shape, dtype=object), **names}
    tree = ast.fix_missing_locations(_Explicit().visit(ast.parse(text)))
    exec(compile(tree, "<program>", "exec"), given)
    return given
