"""Rotation vectors for dynamics and costs in SymPy, smooth at zero; and conversions to and from MuJoCo's quaternions.

A rotation vector r turns by |r| radians about its axis. The formulas need three ratios that are analytic in s = |r|^2,
although they are 0/0 at the identity when written with |r|:

    sine_ratio(s)      = sin|r| / |r|
    cosine_ratio(s)    = (1 - cos|r|) / |r|^2
    cotangent_ratio(s) = (1 - |r|/2 cot(|r|/2)) / |r|^2

Each is a SymPy function with derivatives `<name>_d1` and `<name>_d2` in s. Compiled code evaluates them by the
functions of the same names in `kernels/rotation_ratios.py`, with a power series near zero. Rotation vectors of length 2
pi are singular.

A body that turns about one axis on and on has other coordinates, which are not singular there. The entry along the axis
is the angle of a turn about it; the other two are the rotation vector, perpendicular to the axis, of a tilt that comes
before the turn. Without a turn or without a tilt they are the rotation vector; a tilt by half a turn is singular.
"""

import sys
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_items, check_memory, check_name, excerpt, vectors_of
from lqrsim.kernels.rotation_ratios import cosine_ratio, cotangent_ratio, sine_ratio

Vector = Sequence[Any] | npt.NDArray[Any]

RATIOS = ("sine_ratio", "cosine_ratio", "cotangent_ratio")
AXES = "x", "y", "z"


def rotate(r: Vector, v: Vector) -> list[Any]:
    """The vector `exp([r]) v`, v rotated by the rotation vector r: three SymPy expressions, or three numbers."""
    r, v = _three("r", r), _three("v", v)
    sine, cosine, _ = (_ratio(name, _dot(r, r)) for name in RATIOS)
    once = _cross(r, v)
    twice = _cross(r, once)
    return [v[i] + sine * once[i] + cosine * twice[i] for i in range(3)]


def vector_rate(r: Vector, w: Vector) -> list[Any]:
    """The rate of the rotation vector r of a body with angular velocity w: three SymPy expressions or numbers.

    Paper: Sec. VI-B, `rdot = w + 1/2 [r] w + (1 - 1/2 |r| / tan(1/2 |r|)) [r]^2 w / |r|^2`, with w in rad/s in the axes
    of the body.
    """
    r, w = _three("r", r), _three("w", w)
    cotangent = _ratio("cotangent_ratio", _dot(r, r))
    once = _cross(r, w)
    twice = _cross(r, once)
    return [w[i] + once[i] / 2 + cotangent * twice[i] for i in range(3)]


def quaternion(rotation_vector: npt.ArrayLike, *, turns_about: str | None = None) -> Array:
    """The unit quaternions (..., 4), scalar first as in MuJoCo, of rotation vectors (..., 3).

    Args:
      turns_about: "x", "y" or "z", if the entry along this axis is a turn about it, after a tilt by the vector of the
        other two.
    """
    rotation = vectors_of("rotation_vector", rotation_vector, 3)
    if turns_about is not None:
        along = _index(turns_about)
        tilt = rotation * (np.arange(3) != along)
        return _turned(quaternion(tilt), along, 0.5 * rotation[..., along])
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    # np.sinc(t) is sin(pi t) / (pi t), and 1 at 0: here sin(angle / 2) / angle.
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * rotation], axis=-1)


def rotation_vector(quaternion: npt.ArrayLike, *, turns_about: str | None = None) -> Array:
    """The rotation vectors (..., 3), at most half a turn in radians, of quaternions (..., 4), scalar first.

    Quaternions may have any size but zero, whose vector is NaN.

    Args:
      turns_about: "x", "y" or "z", for a turn about this axis in the entry along it, after a tilt by the vector of the
        other two; both are at most half a turn.
    """
    rows = vectors_of("quaternion", quaternion, 4)
    # Times a power of two, which is exact, so that squares neither underflow nor overflow.
    _, exponents = np.frexp(np.abs(rows).max(axis=-1, keepdims=True))
    rows = np.ldexp(rows, 1 - exponents)
    if turns_about is not None:
        along = _index(turns_about)
        sign = np.copysign(1.0, rows[..., 0])
        half = np.arctan2(sign * rows[..., 1 + along], sign * rows[..., 0])
        vector = rotation_vector(_turned(rows, along, -half))
        vector[..., along] = 2 * half
        return vector
    # q and -q are the same rotation; with a scalar part >= 0 it is at most half a turn.
    scalar, x, y, z = (rows[..., i] for i in range(4))
    sine = np.sqrt(x * x + y * y + z * z)
    # atan2 is exact at both ends, unlike acos near no turn and asin near half a turn.
    angle = 2 * np.arctan2(sine, np.abs(scalar))
    # At the identity, where angle / sine is 0/0, the ratio is 2 / scalar.
    small = np.asarray(sine < 1e-12)
    limit = np.asarray(2.0 / np.abs(scalar)) if small.any() else None
    ratio = angle / sine if limit is None else np.divide(angle, sine, out=limit, where=~small)
    return np.copysign(ratio, scalar)[..., None] * rows[..., 1:]


def _index(turns_about: str) -> int:
    """The entry along an axis, 0 to 2. Raises InputError if there is no such axis."""
    return AXES.index(check_name("turns_about", turns_about, AXES))


def _turned(quaternion: Array, along: int, half: Array) -> Array:
    """The quaternions (..., 4), followed by a turn about an axis, 0 to 2, by twice the angles `half` (...)."""
    turn = np.zeros(3)
    turn[along] = 1.0
    cosine, sine = np.cos(half)[..., None], np.sin(half)[..., None]
    scalar, vector = quaternion[..., :1], quaternion[..., 1:]
    turned = cosine * scalar - sine * vector[..., along : along + 1]
    return np.concatenate([turned, cosine * vector + sine * (scalar * turn + np.cross(turn, vector))], axis=-1)


def _three(field: str, vector: Vector) -> tuple[Any, ...]:
    """The three entries of a vector: numbers, arrays or expressions. Raises InputError for anything else."""
    parts = check_items(field, vector, object, "three expressions or numbers", at_most=3)
    too_large = any(isinstance(part, int) and abs(part) > sys.float_info.max for part in parts)
    if len(parts) != 3 or too_large or any(isinstance(part, str) for part in parts):
        raise InputError(f"{field}: got {excerpt(vector)}, want three expressions or numbers")
    if all(_numeric(part) for part in parts):
        for part in parts:
            if isinstance(part, np.ndarray):  # a broadcast array takes little memory itself
                check_memory(field, part.size, 32, "arrays made from it")
        return parts
    import sympy

    try:
        expressions = [sympy.sympify(part, strict=True) for part in parts]
    except Exception:  # SympifyError, or anything that an object raises
        expressions = [None]
    if not all(isinstance(part, sympy.Expr) for part in expressions):
        raise InputError(f"{field}: got {excerpt(vector)}, want three expressions or numbers")
    return tuple(expressions)


def _numeric(value: object) -> bool:
    """Whether a value is a number of Python or NumPy, or an array of numbers."""
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype.kind in "iuf"
    return isinstance(value, float | int) and not isinstance(value, bool)


def _dot(a: Vector, b: Vector) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _ratio(name: str, s: Any) -> Any:
    """A ratio at s: numeric for a number or an array, otherwise a SymPy function."""
    if isinstance(s, float | int | np.number):
        if s > sys.float_info.max:
            raise InputError("r: got a rotation vector whose squared length is beyond all floats, want a shorter one")
        return _NUMERIC[name](float(s))
    if isinstance(s, np.ndarray) and s.dtype != object:
        return np.vectorize(_NUMERIC[name], otypes=[np.float64])(s)
    return _symbolic(name)(s)


@cache
def _symbolic(name: str) -> Any:
    """The SymPy function of that name, whose derivative is the function of the next order."""
    import sympy

    def fdiff(self: Any, argindex: int = 1) -> Any:
        base, _, order = name.partition("_d")
        if order == "2":
            raise NotImplementedError(f"{base}: third derivatives are not provided")
        return _symbolic(f"{base}_d{int(order or 0) + 1}")(self.args[0])

    return type(name, (sympy.Function,), {"fdiff": fdiff, "nargs": 1, "is_real": True})


_NUMERIC = {"sine_ratio": sine_ratio, "cosine_ratio": cosine_ratio, "cotangent_ratio": cotangent_ratio}
