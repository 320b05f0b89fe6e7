"""Squares of states or controls, about a point or a trajectory: classes and kernel."""

import copy
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import NonNegative, checked
from lqrsim.codegen.sources import source_of
from lqrsim.errors import (
    Array,
    InputError,
    brief,
    check_array,
    check_flag,
    check_memory,
    check_number,
    check_weight_matrix,
    keep,
    numbers_of,
)
from lqrsim.kernels.declarations import M, N
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.parts import Cost, CostTerm, terms_of
from lqrsim.results.coordinates import Coordinates

# One number for each entry, or by name or unit of an entry; each of them may have one row or number for each knot.
PerKnot = npt.ArrayLike | Mapping[str, npt.ArrayLike]


class _SquareCost(Cost):
    """`1/2 (z - about)' weight (z - about)` of the states or the controls; both may change from knot to knot."""

    controls: ClassVar[bool]

    def __init__(self, weight: PerKnot, *, about: PerKnot | None = None, longer: bool = False) -> None:
        self.longer = check_flag(f"{self.name}: longer", longer)
        self._arguments = {"weight": weight, "about": about}
        self._numbers: tuple[Array, Array] | None = None
        if not any(isinstance(numbers, Mapping) for numbers in self._arguments.values()):
            self._numbers = self._checked(weight, about)

    def _stated(self) -> Mapping[str, object]:
        numbers = self._arguments if self._numbers is None else {"weight": self.weight, "about": self.about}
        return {**numbers, "longer": self.longer}

    def _brief(self, name: str, value: object) -> str:
        if isinstance(value, np.ndarray) and value.ndim == (2 if name == "about" else 3):
            kind = ("controls" if self.controls else "states") if name == "about" else "matrices"
            return f"a trajectory of {len(value)} {kind}"
        return brief(value)

    def _checked(self, weight: Any, about: Any) -> tuple[Array, Array]:
        """Weight ([K,] n, n) and reference ([K,] n), each with or without one row for each of K knots."""
        weight = check_weight_matrix(f"{self.name}: weight", weight, definite=self.controls)
        field, size = f"{self.name}: about", weight.shape[-1]
        about = np.zeros(size) if about is None else numbers_of(field, about, f"numbers of shape ({size},)")
        about = check_array(field, about, (None, size) if about.ndim == 2 else (size,))
        if not about.size:
            raise InputError(f"{field}: got no rows, want one, or one for each knot")
        return weight, about

    @property
    def weight(self) -> Array:
        """The weight matrix (n, n), or one for each knot, (K, n, n)."""
        return self._known[0]

    @property
    def about(self) -> Array:
        """The point (n,) at which the cost is zero, or one for each knot, (K, n)."""
        return self._known[1]

    @property
    def _known(self) -> tuple[Array, Array]:
        if self._numbers is None:  # by name, and so in no order before a Problem has the cost
            raise InputError(f"{self.name}: got numbers by name, want the cost from a Problem: problem.final_cost")
        return self._numbers

    @property
    def by_knot(self) -> bool:
        return self.weight.ndim == 3 or self.about.ndim == 2

    def _at_other_knots(self, select: Callable[[Array], Array]) -> Self:
        weight, about = self._known
        return self._with(select(weight) if weight.ndim == 3 else weight, select(about) if about.ndim == 2 else about)

    @checked
    def scaled(self, factor: NonNegative) -> Self:
        return self._with(factor * self.weight, self.about)

    def _with(self, weight: Array, about: Array) -> Self:
        other = copy.copy(self)
        other._numbers = weight, about
        return other

    def _in(self, dynamics: Dynamics) -> Self:
        space = dynamics.control_coordinates if self.controls else dynamics.state_coordinates
        cost = self if self._numbers is not None else self._with(*self._ordered(space))
        size = cost.weight.shape[-1]
        if size != len(space):
            kind = "controls" if self.controls else "states"
            raise InputError(f"{self.name}: weight: got size {size}, want {len(space)}, the number of {kind}")
        return cost

    def _ordered(self, space: Coordinates) -> tuple[Array, Array]:
        """Weight and reference, as `_checked`, with numbers by name in the order of the states or controls."""
        fields: dict[str, Any] = dict(self._arguments)
        for name, given in self._arguments.items():
            if isinstance(given, Mapping):
                of_each = self.controls and name == "weight"
                fields[name] = _by_name(space, f"{self.name}: {name}", given, of_each=of_each)
                if name == "weight" and fields[name].ndim == 2:  # diagonals, one for each knot
                    fields[name] = fields[name][:, :, None] * np.eye(len(space))
        return self._checked(**fields)

    def bind(self, dynamics: Dynamics) -> CostTerm:
        cost = self._in(dynamics)
        (weight, about), size = cost._known, cost.weight.shape[-1]
        counts = [about.size // size, weight.size // size**2] if cost.by_knot else []
        data = np.concatenate([counts, about.ravel(), weight.ravel()])
        kernel = source_of(__name__, CONTROL=self.controls, BY_KNOT=cost.by_knot)
        return CostTerm(kernel, data, uses_control=self.controls)

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> CostTerm:
        steps = len(times) - 1
        for name, array, single in (("about", self.about, 1), ("weight", self.weight, 2)):
            rows = len(array)
            if array.ndim == single or rows == steps or (rows == steps + 1 and not self.controls):
                continue
            if not (self.longer and rows > steps):
                want = f"{steps}, one for each step" if self.controls else f"{steps + 1}, one for each knot"
                more = "; for a moving horizon, more with longer=True" if rows > steps else ""
                raise InputError(f"{self.name}: {name}: got {rows} rows, want {want}{more}")
        return self.bind(dynamics)


class QuadraticCost(_SquareCost):
    """`1/2 (x - about)' weight (x - about)`.

        ls.QuadraticCost({"x": 100, "y": 100, "m/s": 10}, about={"x": 2.0})
        ls.QuadraticCost({"x": 100, "y": 100}, about={"x": xs, "y": ys})  # follows a reference

    As a stage cost it may have another reference or weight at each knot: T+1 rows, row t for the step that begins at
    knot t. A stage cost does not use row T, which may be left out; for the end, give a final cost about it. Rows belong
    to knots whatever dt is, also with a free duration. Angles count whole turns, so a reference must not jump by a
    turn. When a `Replanner` plans again, the rows move with time: a shrinking horizon uses those that are left, a
    moving one repeats the last row.

    Args:
      weight: (n, n) symmetric positive semidefinite, or its diagonal (n,), or a dictionary of name or unit of a state:
        number; states without a number have no weight. Or (T+1, n, n), one matrix for each knot; in a dictionary,
        numbers (T+1,).
      about: (n,) the state at which the cost is zero, or a dictionary of name or unit: number; the other states are 0.
        Or (T+1, n), one state for each knot; in a dictionary, numbers (T+1,).
      longer: whether there may be more rows than knots, for a moving horizon, which then goes on along them.
    """

    controls = False

    def __init__(self, weight: PerKnot, *, about: PerKnot | None = None, longer: bool = False) -> None:
        if about is None:  # zero is no state that one would expect, unlike a control
            want = "the state at which the cost is zero, such as [0.0, 1.0] or {'x': 1.0}"
            raise InputError(f"{self.name}: about: got none, want {want}")
        super().__init__(weight, about=about, longer=longer)

    @property
    def state_reference(self) -> "QuadraticCost":
        return self

    def moved_to(self, state: Array, dynamics: Dynamics) -> Self:
        return self._with(self.weight, state)

    def with_added_state(self, dynamics: Dynamics) -> Self:
        pairs = (self.weight, 2), (self.about, 1)
        return self._with(*(np.pad(array, [(0, 0)] * (array.ndim - axes) + [(0, 1)] * axes) for array, axes in pairs))


class ControlCost(_SquareCost):
    """`1/2 (u - about)' weight (u - about)`.

    It may have another nominal control or weight at each step, as a QuadraticCost at each knot.

    Args:
      weight: (m, m) symmetric positive definite, or its diagonal (m,), or a dictionary of name or unit of a control:
        number, with one for each control. Or (T, m, m), one matrix for each step; in a dictionary, numbers (T,).
      about: (m,) the nominal control, at which the cost is zero, or a dictionary of name or unit: number. Or (T, m),
        one for each step; in a dictionary, numbers (T,). The solvers start from it unless told otherwise. By default 0,
        also for controls that the dictionary leaves out.
      longer: whether there may be more rows than steps, as for a QuadraticCost.
    """

    controls = True
    _same_with_added_state = True

    @property
    def control_reference(self) -> "ControlCost":
        return self


def _number_or_column(field: str, value: object) -> float | Array:
    """A number; or numbers (K,), one for each knot. Raises InputError for anything else."""
    if isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.ndim):
        return check_array(field, value, (None,))
    return check_number(field, value)


def _by_name(space: Coordinates, field: str, numbers: Mapping[str, object], *, of_each: bool) -> Array:
    """Numbers by name or unit as an array (n,), with 0 for the rest, or none left out with `of_each`; (K, n) if some
    have one number for each knot.
    """
    entries = space._by_name(field, numbers, _number_or_column)
    if of_each and (missing := [name for i, name in enumerate(space.names) if i not in entries]):
        raise InputError(f"{field}: got none for {', '.join(missing)}, want one for each control")
    counts = {len(entry) for entry in entries.values() if isinstance(entry, np.ndarray)}
    if len(counts) > 1 or 0 in counts:
        got = " and ".join(map(str, sorted(counts)))
        raise InputError(f"{field}: got columns of {got} numbers, want one number for each knot in all of them")
    check_memory(field, max(counts, default=1), 16 * len(space) ** 2, "whose matrices")
    out = np.zeros((*counts, len(space)))
    for i, entry in entries.items():
        out[..., i] = entry
    return out


def references_of(cost: Cost, dynamics: Dynamics) -> list[tuple[Cost, QuadraticCost]]:
    """The terms of a cost that draw to states, each with its reference, in the order of a system."""
    references = [(term, term.state_reference) for term in terms_of(cost)]
    return [(term, reference._in(dynamics)) for term, reference in references if reference is not None]


def about_state(term: CostTerm, state: Array) -> CostTerm:
    """A bound QuadraticCost without rows for knots about another state (n,): four times as fast as a new one."""
    other = copy.copy(term)
    keep(other, data=np.concatenate([state, term.data[len(state) :]]))
    return other


# The kernel. With rows for knots, `data` has the numbers of rows of `about` and of `weight`; then `about` (size,) for
# each row, then `weight` (size, size) for each row. A single row, or the last one, holds from its step on.
CONTROL = False  # whether z is the control
BY_KNOT = False  # whether there are rows for knots; else `data` is `about` and `weight`
ABOUTS, WEIGHTS, NUMBERS = 0, 1, 2


def value(x, u, t, data):
    """The cost."""
    z, size = (u, M) if CONTROL else (x, N)
    about, weight, total = about_at(t, size, data), weight_at(t, size, data), 0.0
    for i in range(size):
        slope = 0.0
        for j in range(size):
            slope += data[weight + size * i + j] * (z[j] - data[about + j])
        total += 0.5 * slope * (z[i] - data[about + i])
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and the gradient (W,), and return the cost."""
    z, size, first = (u, M, N) if CONTROL else (x, N, 0)
    about, weight, total = about_at(t, size, data), weight_at(t, size, data), 0.0
    for i in range(size):
        slope = 0.0
        for j in range(size):
            entry = data[weight + size * i + j]
            slope += entry * (z[j] - data[about + j])
            hessian[first + i, first + j] += entry
        gradient[first + i] += slope
        total += 0.5 * slope * (z[i] - data[about + i])
    return total


def about_at(t, size, data):
    """The index at which the reference of a step begins."""
    if BY_KNOT:
        return NUMBERS + size * min(t, int(data[ABOUTS]) - 1)
    return 0


def weight_at(t, size, data):
    """The index at which the weight of a step begins."""
    if BY_KNOT:
        return NUMBERS + size * int(data[ABOUTS]) + size * size * min(t, int(data[WEIGHTS]) - 1)
    return size
