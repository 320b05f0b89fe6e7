"""Costs and constraints in plain Python: for checks of derivatives, and of runs."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.plain import plain_functions
from lqrsim.codegen.user_functions import address_of
from lqrsim.errors import Array
from lqrsim.problem.constraints import ConstraintTerm
from lqrsim.problem.costs import CostTerm


class PlainTerm:
    """A cost or constraint term in plain Python, at points z = (x, u)."""

    def __init__(self, term: CostTerm | ConstraintTerm, states: int, controls: int) -> None:
        self.shared = term.shared if isinstance(term, ConstraintTerm) else 0
        self.states, self.size = states, states + controls
        named = term.functions[0].parameters if term.functions else ()
        parameters = dict(zip(named, term.data.tolist(), strict=False))
        wanted = [name for name in ("derivatives", "value", "slope", "places_jacobian") if term.code.has(name)]
        sizes, calls = {"N": states, "M": controls}, [function.plain_call(parameters) for function in term.functions]
        self._functions = plain_functions(term.code, sizes, wanted, calls)
        places = [address_of(function) if function.is_memory else float(i) for i, function in enumerate(term.functions)]
        self._data = np.concatenate([places, term.data])

    def cost(self, z: Array) -> tuple[float, Array, Array]:
        """The cost, its gradient (n+m,) and its Hessian (n+m, n+m), before any projection."""
        x, u = z[: self.states], z[self.states :]
        gradient, hessian = np.zeros(self.size), np.zeros((self.size, self.size))
        return float(self._functions["derivatives"](x, u, 1, self._data, hessian, gradient)), gradient, hessian

    def value(self, z: Array, row: int, knot: int = 1) -> float:
        """One row of the constraint at a knot."""
        return float(self._functions["value"](*self._point(z), knot, row, self._data))

    def slope(self, z: Array, row: int) -> Array:
        """The gradient (n+m,) of one row of the constraint."""
        gradient = np.zeros(self.size)
        self._functions["slope"](*self._point(z), 1, row, self._data, gradient)
        return gradient

    def _point(self, z: Array) -> tuple[Array, Array]:
        """State and control; or, in their place, the values that all rows share and their derivatives."""
        x, u = z[: self.states], z[self.states :]
        if not self.shared:
            return x, u
        at, moves = np.zeros(self.shared), np.zeros((self.shared, self.states))
        self._functions["places_jacobian"](x, self._data, at, moves)
        return at, moves


def violated(
    term: ConstraintTerm, states: Array, controls: Array, counts: npt.NDArray[np.bool_], tolerance: float
) -> Iterator[tuple[Array, npt.NDArray[np.intp]]]:
    """The largest violation (K,) of each run and its knot (K,), zeros for a run without one, row by row.

    Args:
      states: (K, T+1, n). controls: (K, T, m). counts: (K, T+1), whether a knot counts.
    """
    steps, (n, m) = controls.shape[1], (states.shape[2], controls.shape[2])
    plain = PlainTerm(term, n, m)
    knots = range(steps) if term.uses_control else range(steps if term.final_only else 1, steps + 1)
    for row in range(term.rows):
        largest, when = np.zeros(len(states)), np.zeros(len(states), dtype=np.intp)
        for k, knot in zip(*np.nonzero(counts[:, knots.start : knots.stop]), strict=True):
            t = int(knot) + knots.start
            value = plain.value(np.concatenate([states[k, t], controls[k, min(t, steps - 1)]]), row, t)
            missed = abs(value) if term.equality else -value
            if missed > max(tolerance, largest[k]):
                largest[k], when[k] = missed, t
        yield largest, when
