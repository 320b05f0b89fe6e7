"""The linear-quadratic problem of Sec. IV, which `smooth_lq` solves and each iteration of `smooth` sets up."""

import contextlib
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_array, check_memory, check_symmetric, excerpt, keep
from lqrsim.results.value_functions import Quadratic


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """Linear dynamics and a quadratic cost.

        step (discrete) or rate (continuous) of x:   A x + B u + c
        cost of the step, or a second of it:         1/2 x'Q x + 1/2 u'R u + u'P x + q'x + r'u + constant

    An array with a leading axis of T has one entry per step; an array without that axis is the same at every step. All
    arrays except A, B and R may be left out and are then zero. Paper: Eqs. (4), (7).

    B is (..., n, m), A and Q (..., n, n), P (..., m, n), R (..., m, m), c and q (..., n), r (..., m), constant (...). Q
    and R are symmetric, R positive definite.
    """

    A: npt.ArrayLike
    B: npt.ArrayLike
    R: npt.ArrayLike
    c: npt.ArrayLike | None = None
    Q: npt.ArrayLike | None = None
    P: npt.ArrayLike | None = None
    q: npt.ArrayLike | None = None
    r: npt.ArrayLike | None = None
    constant: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        shape = _shape(self.B)
        if len(shape) not in (2, 3):
            raise InputError(f"Stage: B: got {excerpt(self.B)}, want an array (n, m) or, one per step, (T, n, m)")
        if 0 in shape:
            raise InputError(f"Stage: B: got shape {shape}, want at least one of each")
        n, m = shape[-2:]
        check_memory("Stage: B", n, 8 * n * (shape[0] if len(shape) == 3 else 1), "whose A")
        shapes = {
            "A": (n, n), "B": (n, m), "c": (n,), "Q": (n, n), "P": (m, n), "R": (m, m), "q": (n,), "r": (m,),
            "constant": (),
        }  # fmt: skip
        # Time is the leading axis of any of the arrays; arrays without that axis are the same at each step.
        given = {name: _shape(getattr(self, name)) for name in shapes if getattr(self, name) is not None}
        time = max((shape[:1] for name, shape in given.items() if len(shape) == len(shapes[name]) + 1), default=())
        for field in fields(self):
            value, want = getattr(self, field.name), shapes[field.name]
            if value is None:
                if field.name in ("A", "R"):
                    raise InputError(f"Stage: {field.name}: got None, want an array of shape {shapes[field.name]}")
                value = np.zeros(want)
            with contextlib.suppress(Exception):  # ragged, or no array: refused below for its shape
                if time and np.ndim(value) == len(want):  # the same at each step
                    value = np.broadcast_to(value, (*time, *np.shape(value)))
            array = check_array(f"Stage: {field.name}", value, (*time, *want))
            if field.name in ("Q", "R"):
                array = check_symmetric(f"Stage: {field.name}", array)
            keep(self, **{field.name: array})

    @property
    def states(self) -> int:
        return np.shape(self.B)[-2]

    @property
    def controls(self) -> int:
        return np.shape(self.B)[-1]


def check_end(field: str, cost: Quadratic, n: int) -> tuple[Array, Array, float]:
    """Hessian (n, n), gradient (n,) and constant of an initial or final cost."""
    if not isinstance(cost, Quadratic):
        raise InputError(f"{field}: got {excerpt(cost)}, want a Quadratic")
    hessian = check_symmetric(f"{field}: hessian", check_array(f"{field}: hessian", cost.hessian, (n, n)))
    gradient = check_array(f"{field}: gradient", cost.gradient, (n,))
    return hessian, gradient, float(check_array(f"{field}: constant", cost.constant, ()))


def _shape(value: npt.ArrayLike) -> tuple[int, ...]:
    """The shape; () for ragged input, which has no shape."""
    try:
        return np.asarray(value).shape
    except Exception:  # or an object that raises anything
        return ()
