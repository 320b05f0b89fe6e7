"""Cost terms; `+` composes them. Their structure is source text, their numbers are data.

To add a kind of cost, subclass `Cost` and write `bind`; or state it as a formula with `SymbolicCost`.
"""

import abc
import copy
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
import numpy.typing as npt

from lqrsim.codegen import symbolic
from lqrsim.codegen.sources import source_of
from lqrsim.codegen.user_functions import (
    Term,
    axes_of,
    check_depends_on,
    check_derivative,
    check_signature,
    level_of,
    name_of,
    with_derivatives,
)
from lqrsim.errors import (
    Array,
    InputError,
    brief,
    check_array,
    check_count,
    check_flag,
    check_items,
    check_memory,
    check_name,
    check_number,
    check_weight,
    excerpt,
    keep,
    numbers_of,
)
from lqrsim.kernels import (
    differences,
    distance_cost,
    limit_cost,
    obstacle_cost,
    quadratic_cost,
    reference_cost,
    user_functions,
)
from lqrsim.problem.collision_shape import CollisionGeoms, GeomsInWorld, KeepsClear
from lqrsim.problem.collision_spheres import CollisionSpheres
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.solution_parts import HORIZONS, left_after
from lqrsim.scenes.world import World

# One number for each entry, or by name or unit of an entry; each of them may have one row or number for each knot.
PerKnot = npt.ArrayLike | Mapping[str, npt.ArrayLike]

FAR = 16.0  # times 1 / sharpness: the distance beyond which geoms cost nothing in an ObstacleCost, instead of exp(-FAR)


@dataclass(frozen=True, eq=False)
class CostTerm(Term):
    """A cost term, for one system: the source to compile, and the numbers that it reads.

    The source defines `value(x, u, t, data)` and `derivatives(x, u, t, data, hessian, gradient)`, both returning the
    cost; the latter *adds* the Hessian (n+m, n+m) and gradient (n+m,) at the point, states before controls.

    Attributes:
      nonconvex_in: indices of the entries of (x, u) in which the Hessian may be indefinite: None for a convex term. The
        sum of all such terms is projected to the nearest positive-semidefinite matrix.
      uses_control: whether the term depends on u (only stage costs may).
      factor: index in `data` of a number that the whole term is proportional to, if the number may be reduced in the
        first iterations; see `InitialPrior`. Else None.
      exact_hessian: whether the Hessian is complete. If a part is left out on purpose, `check_derivatives` does not
        compare the Hessian with differences.
    """

    nonconvex_in: tuple[int, ...] | None = None
    uses_control: bool = False
    factor: int | None = None
    exact_hessian: bool = True

    @property
    def _defines(self) -> Mapping[str, int]:
        return {"value": 4, "derivatives": 6}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nonconvex_in is not None:
            wanted = "a tuple of indices, or None"
            given = check_items("CostTerm: nonconvex_in", self.nonconvex_in, (int, np.integer), wanted)
            keep(self, nonconvex_in=tuple(check_count("CostTerm: nonconvex_in", i, at_least=0) for i in given))
        for name in ("uses_control", "exact_hessian"):
            keep(self, **{name: check_flag(f"CostTerm: {name}", getattr(self, name))})
        if self.factor is not None:
            last = len(self.data) - 1
            keep(self, factor=check_count("CostTerm: factor", self.factor, at_least=0, at_most=last))


_BoundTerm = TypeVar("_BoundTerm", bound=Term)


class ProblemPart(abc.ABC, Generic[_BoundTerm]):
    """A cost or a constraint, which can be bound to any system that it fits.

    All that others ask of one is a method here, in `Cost` or in `Constraint`, with the answer of most; a kind with
    another answer overrides it.
    """

    @abc.abstractmethod
    def bind(self, dynamics: Dynamics) -> _BoundTerm:
        """Bind the term to a system.

        Args:
          dynamics: dynamics of the system.

        Raises:
          InputError: it does not fit the system.
        """

    @property
    def by_knot(self) -> bool:
        """Whether it has other numbers at each knot; initial and final costs may not."""
        return False

    @property
    def moving(self) -> bool:
        """Whether the term changes with time; see `bound_at`."""
        return self.by_knot

    @property
    def kept_clear(self) -> KeepsClear | None:
        """The obstacles that it keeps the robot clear of, with the robot's shape; None for others."""
        return None

    def with_added_state(self, dynamics: Dynamics) -> Self:
        """The same for a system with one more state, the last, of which it is independent: for a free duration.

        Args:
          dynamics: dynamics of the system without that state.

        Raises:
          InputError: its kind cannot be stated for one more state.
        """
        raise InputError(
            f"duration: got a {type(self).__name__} beside it, which cannot have one more state, want none"
        )

    def ahead(self, steps: int, *, horizon: str = "shrinking") -> Self:
        """The same for a plan that begins `steps` steps later: unchanged, unless it has numbers for each knot.

        Args:
          steps: number of steps that are over.
          horizon: "shrinking" for the rest of the plan, without the first rows; or "moving" for a plan of the same
            length, which repeats the last row.
        """
        check_count("steps", steps, at_least=0)
        check_name("horizon", horizon, HORIZONS)
        return self

    def _stated(self) -> Mapping[str, object]:
        """The arguments that it was made from, by name."""
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def __repr__(self) -> str:
        parts = [
            f"{name}={self._brief(name, value)}"
            for name, value in self._stated().items()
            if not (value is None or value is False or (isinstance(value, Mapping) and not value))
        ]
        return f"{type(self).__name__}({', '.join(parts)})"

    def _brief(self, name: str, value: object) -> str:
        """An argument as it is printed."""
        return brief(value)

    def _bind_at(self, dynamics: Dynamics, times: Array) -> _BoundTerm:
        """Bind the term to a system and the times (T+1,) in s of a problem's knots; for others this is `bound_at`."""
        return self.bind(dynamics)


def bound_at(part: ProblemPart[_BoundTerm], dynamics: Dynamics, times: Array) -> _BoundTerm:
    """A cost or constraint for a system and the times (T+1,) in s of a problem's knots.

    Raises:
      InputError: it does not fit the system.
    """
    return part._bind_at(dynamics, times)


class OfFunction:
    """A cost or a constraint that is stated as a function, with parameters."""

    function: Callable[..., Any]
    parameters: dict[str, float]

    @property
    def name(self) -> str:
        """The name of its function."""
        return f"{name_of(self.function)}(x, u, p)"

    @property
    def _data(self) -> Array:
        return np.array(list(self.parameters.values()), dtype=np.float64)


class OfFormula(OfFunction):
    """A cost or a constraint that is stated as a formula, with parameters."""

    def _set_formula(self, function: Callable[..., Any], parameters: Mapping[str, float] | None, instead: str) -> None:
        """Check and keep a function of symbols."""
        if level_of(function, None) == "compiled":
            raise InputError(f"{type(self).__name__}: got the numba function {name_of(function)}, want {instead}")
        check_signature(function, ("x", "u", "p"))
        self.function, self.parameters = function, symbolic.check_parameters(parameters)

    def with_added_state(self, dynamics: Dynamics) -> Self:
        other, function, n = copy.copy(self), self.function, len(dynamics.state_coordinates)
        other.function = lambda x, u, p: function(x[:n], u, p)
        return other


class Cost(ProblemPart[CostTerm]):
    """One term of a cost."""

    @property
    def name(self) -> str:
        """The name in messages."""
        return type(self).__name__

    @property
    def state_reference(self) -> "QuadraticCost | None":
        """What it is near the states that it draws to; None for a cost that draws to none.

        A problem's start and goal are those of its initial and its final cost.
        """
        return None

    @property
    def control_reference(self) -> "ControlCost | None":
        """What it is near the controls that it draws to, as solvers start from; None for a cost that draws to none."""
        return None

    @property
    def contact_curvature(self) -> float:
        """Its second derivative in the distance to an obstacle, in 1/m^2, at contact; 0 if it does not act.

        The search for ways round obstacles weighs paths by it.
        """
        return 0.0

    def times(self, factor: float) -> "Cost":
        """The cost times a number. Costs with a state reference or obstacles have it: the search changes their weights.

        Args:
          factor: the number, not negative.

        Raises:
          InputError: a cost of another kind.
        """
        raise InputError(f"{self.name}: got no method times(factor), want it to return the cost times a number")

    def moved_to(self, state: Array) -> "Cost":
        """The cost with another state as reference. Costs with a state reference have it: a viewer moves goals.

        Args:
          state: (n,).

        Raises:
          InputError: a cost of another kind.
        """
        raise InputError(f"{self.name}: got no method moved_to(state), want it to return the cost about a state")

    def _in(self, dynamics: Dynamics) -> "Cost":
        """This cost with numbers by name in the order of a system. Raises InputError if it does not fit the system."""
        return self

    def __add__(self, other: "Cost") -> "CostSum":
        return CostSum((*terms_of(self), *terms_of(other)))

    def __radd__(self, other: object) -> "Cost":
        """`sum(costs)` begins with 0."""
        return self if type(other) is int and other == 0 else NotImplemented


class CostSum(Cost):
    """The result of `+`: the terms, in order."""

    def __init__(self, terms: tuple[Cost, ...]) -> None:
        self.terms = terms

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.terms))

    def ahead(self, steps: int, *, horizon: str = "shrinking") -> "CostSum":
        return CostSum(tuple(term.ahead(steps, horizon=horizon) for term in self.terms))

    def with_added_state(self, dynamics: Dynamics) -> "CostSum":
        return CostSum(tuple(term.with_added_state(dynamics) for term in self.terms))

    def bind(self, dynamics: Dynamics) -> CostTerm:
        raise InputError("cost: got a sum of costs, want a single term: bind the `terms` one by one")


def terms_of(cost: Cost, field: str = "cost") -> tuple[Cost, ...]:
    """The terms of a sum; a single cost is its own. Raises InputError for an object that is no cost."""
    if isinstance(cost, CostSum):
        return cost.terms
    if not isinstance(cost, Cost):
        or_given = ", or a FixedState" if field == "initial" else ""
        wanted = f"a cost such as QuadraticCost(...) or a sum of costs{or_given}"
        raise InputError(f"{field}: got {excerpt(cost)}, want {wanted}")
    return (cost,)


def in_system(cost: Cost, dynamics: Dynamics, field: str = "cost") -> Cost:
    """The cost with numbers by name in the order of a system; the same object if it has no numbers by name.

    Raises:
      InputError: a term does not fit the system, or is no cost; or an initial or final cost has numbers for each knot.
    """
    terms = terms_of(cost, field)
    found = tuple(term._in(dynamics) for term in terms)
    for term in found:
        if field in ("initial", "final_cost") and term.by_knot:
            raise InputError(f"{field}: got a {term.name} with a row for each knot, want one row, such as rows[-1]")
    return cost if all(map(operator.is_, terms, found)) else CostSum(found)


class _SquareCost(Cost):
    """`1/2 (z - about)' weight (z - about)` of the states or the controls; both may change from knot to knot."""

    controls: ClassVar[bool]

    def __init__(self, weight: PerKnot, about: PerKnot | None, longer: bool) -> None:
        self.longer = check_flag(f"{self.name}: longer", longer)
        self._given = {"weight": weight, "about": about}
        self._numbers: tuple[Array, Array] | None = None
        if not any(isinstance(numbers, Mapping) for numbers in self._given.values()):
            self._numbers = self._checked(weight, about)

    def _stated(self) -> Mapping[str, object]:
        numbers = self._given if self._numbers is None else {"weight": self.weight, "about": self.about}
        return {**numbers, "longer": self.longer}

    def _brief(self, name: str, value: object) -> str:
        if isinstance(value, np.ndarray) and value.ndim == (2 if name == "about" else 3):
            each = ("controls" if self.controls else "states") if name == "about" else "matrices"
            return f"a trajectory of {len(value)} {each}"
        return brief(value)

    def _checked(self, weight: Any, about: Any) -> tuple[Array, Array]:
        """Weight ([K,] n, n) and reference ([K,] n), each with or without one row for each of K knots."""
        weight = check_weight(f"{self.name}: weight", weight, definite=self.controls)
        field, size = f"{self.name}: about", weight.shape[-1]
        about = np.zeros(size) if about is None else numbers_of(field, about, f"numbers of shape ({size},)")
        about = check_array(field, about, (None, size) if about.ndim == 2 else (size,))
        if not about.size:
            raise InputError(f"{field}: got no rows, want one, or one for each knot")
        return weight, about

    @property
    def weight(self) -> Array:
        """The weight matrix (n, n), or one for each knot, (K, n, n). Numbers by name are in no order before a Problem
        has the cost.
        """
        return self._known[0]

    @property
    def about(self) -> Array:
        """The point (n,) at which the cost is zero, or one for each knot, (K, n). Numbers by name are in no order
        before a Problem has the cost.
        """
        return self._known[1]

    @property
    def _known(self) -> tuple[Array, Array]:
        if self._numbers is None:
            raise InputError(f"{self.name}: got numbers by name, want the cost from a Problem: problem.final_cost")
        return self._numbers

    @property
    def by_knot(self) -> bool:
        return self.weight.ndim == 3 or self.about.ndim == 2

    def ahead(self, steps: int, *, horizon: str = "shrinking") -> Self:
        super().ahead(steps, horizon=horizon)
        if not self.by_knot:
            return self

        weight, about = self._known
        return self._with(
            rows_ahead(weight, steps, horizon) if weight.ndim == 3 else weight,
            rows_ahead(about, steps, horizon) if about.ndim == 2 else about,
        )

    def times(self, factor: float) -> Self:
        return self._with(factor * self.weight, self.about)

    def _with(self, weight: Array, about: Array) -> Self:
        other = copy.copy(self)
        other._numbers = weight, about
        return other

    def _in(self, dynamics: Dynamics) -> "_SquareCost":
        space = dynamics.control_coordinates if self.controls else dynamics.state_coordinates
        if self._numbers is None:
            weight = self._given["weight"]
            if self.controls and isinstance(weight, Mapping):
                weighed = space._by_name(f"{self.name}: weight", weight, _number_or_column)
                missing = [name for i, name in enumerate(space.names) if i not in weighed]
                if missing:
                    raise InputError(
                        f"{self.name}: weight: got none for {', '.join(missing)}, want one for each control"
                    )
            found = {
                field: _by_name(space, f"{self.name}: {field}", given) if isinstance(given, Mapping) else given
                for field, given in self._given.items()
            }
            if isinstance(weight, Mapping) and np.ndim(found["weight"]) == 2:  # diagonals, one for each knot
                found["weight"] = found["weight"][:, :, None] * np.eye(len(space))
            other = copy.copy(self)
            other._numbers = self._checked(**found)
            return other._in(dynamics)
        size = self.weight.shape[-1]
        if size != len(space):
            kind = "controls" if self.controls else "states"
            raise InputError(f"{self.name}: weight: got size {size}, want {len(space)}, the number of {kind}")
        return self

    def bind(self, dynamics: Dynamics) -> CostTerm:
        weight, about = self._in(dynamics)._known
        kernel, counts, size = quadratic_cost, [], weight.shape[-1]
        if weight.ndim == 3 or about.ndim == 2:
            kernel, counts = reference_cost, [about.size // size, weight.size // size**2]
        data = np.concatenate([counts, about.ravel(), weight.ravel()])
        return CostTerm(source_of(kernel, CONTROL=int(self.controls)), data, uses_control=self.controls)

    def _bind_at(self, dynamics: Dynamics, times: Array) -> CostTerm:
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


def rows_ahead(rows: Array, steps: int, horizon: str) -> Array:
    """The rows of the knots from `steps` steps later on; at least one. See `ProblemPart.ahead`."""
    return left_after(min(steps, len(rows) - 1), rows, filled=horizon == "moving")


def _number_or_column(field: str, given: object) -> float | Array:
    """A number; or numbers (K,), one for each knot. Raises InputError for anything else."""
    if isinstance(given, (list, tuple)) or (isinstance(given, np.ndarray) and given.ndim):
        return check_array(field, given, (None,))
    return check_number(field, given)


def _by_name(space: Coordinates, field: str, given: Mapping[str, object]) -> Array:
    """Numbers by name or unit as an array (n,), with 0 for the rest; (K, n) if some have one number for each knot."""
    found = space._by_name(field, given, _number_or_column)
    counts = {len(one) for one in found.values() if isinstance(one, np.ndarray)}
    if len(counts) > 1 or 0 in counts:
        got = " and ".join(map(str, sorted(counts)))
        raise InputError(f"{field}: got columns of {got} numbers, want one number for each knot in all of them")
    check_memory(field, max(counts, default=1), 16 * len(space) ** 2, "whose matrices")
    out = np.zeros((*counts, len(space)))
    for i, one in found.items():
        out[..., i] = one
    return out


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
        super().__init__(weight, about, longer)

    @property
    def state_reference(self) -> "QuadraticCost":
        return self

    def moved_to(self, state: Array) -> Self:
        return self._with(self.weight, state)

    def with_added_state(self, dynamics: Dynamics) -> Self:
        weight, about = (
            np.pad(array, [(0, 0)] * (array.ndim - axes) + [(0, 1)] * axes)
            for array, axes in ((self.weight, 2), (self.about, 1))
        )
        return self._with(weight, about)


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

    def __init__(self, weight: PerKnot, *, about: PerKnot | None = None, longer: bool = False) -> None:
        super().__init__(weight, about, longer)

    @property
    def control_reference(self) -> "ControlCost":
        return self

    def with_added_state(self, dynamics: Dynamics) -> Self:
        return self


class LimitCost(Cost):
    """`1/2 weight depth^2` for each state that is past a bound by some depth: a soft limit.

    Args:
      low, high: name of a state -> its bound.
      weight: weight of the square of each depth.
    """

    def __init__(
        self,
        low: Mapping[str, float] | None = None,
        high: Mapping[str, float] | None = None,
        *,
        weight: float,
    ) -> None:
        self.weight = check_number("LimitCost: weight", weight, at_least=0.0)
        self.bounds = [
            (name, sign, check_number(f"LimitCost: bound of {name}", bound))
            for sign, bounds in ((1.0, low), (-1.0, high))
            for name, bound in (bounds or {}).items()
        ]

    def bind(self, dynamics: Dynamics) -> CostTerm:
        names = dynamics.state_coordinates.names
        rows = [
            [names.index(check_name("LimitCost: state", name, names)), sign, bound, self.weight]
            for name, sign, bound in self.bounds
        ]
        numbers = np.array([len(rows), *np.ravel(rows)], dtype=np.float64)
        return CostTerm(source_of(limit_cost), numbers, exact_hessian=False)

    def with_added_state(self, dynamics: Dynamics) -> Self:
        return self


class ObstacleCost(KeepsClear, Cost):
    """`weight * sum over obstacles of exp(-sharpness * (distance - radius))`, from the first step on.

    Paper: Sec. VI-A, with the sharpness made explicit. The cost does not act at t = 0, where the state is given. For a
    robot in the plane (two position coordinates), the world is seen from above or cut by the plane; see
    `World.seen_by`.

    For a robot of several balls, the cost is summed over the balls, too. Its Hessian is then computed in the centres of
    the balls and mapped to the states by the Jacobian of the centres. Second derivatives of the centres are left out.

    Args:
      world: the obstacles.
      radius: radius of the robot at its position, in metres.
      balls: the robot's balls, in place of `radius`, as `robot.balls`. The attribute `radius` is then the largest one.
      geoms: the colliding geoms of a robot from an MJCF, as `robot.geoms`, with MuJoCo's distances. The sum is then
        over bodies and obstacles. Pairs farther apart than D = 16 / sharpness cost nothing; for the others, the
        exponential's tangent at D, `exp(-16) * (1 + sharpness * (D - distance))`, is taken off. Give exactly one of
        `radius`, `balls` and `geoms`.
      sharpness: sharpness in 1/m.
      weight: cost of touching one obstacle, with one ball, for one step.
    """

    def __init__(
        self,
        world: World,
        *,
        radius: float | None = None,
        balls: CollisionSpheres | None = None,
        geoms: CollisionGeoms | None = None,
        sharpness: float = 10.0,
        weight: float = 1.0,
    ) -> None:
        self._set_shape(world, radius, balls, geoms)
        self.sharpness = check_number("ObstacleCost: sharpness", sharpness, above=0.0)
        self.weight = check_number("ObstacleCost: weight", weight, at_least=0.0)

    def weighing(self, weight: float) -> "ObstacleCost":
        """The same cost with another weight.

        Args:
          weight: cost of touching one obstacle, with one ball, for one step.
        """
        other = copy.copy(self)
        other.weight = check_number("ObstacleCost: weight", weight, at_least=0.0)
        return other

    def times(self, factor: float) -> "ObstacleCost":
        return self.weighing(factor * self.weight)

    @property
    def contact_curvature(self) -> float:
        return self.weight * self.sharpness**2

    def bind(self, dynamics: Dynamics) -> CostTerm:
        return self._bind_at(dynamics, np.zeros(1))

    def _bind_at(self, dynamics: Dynamics, times: Array) -> CostTerm:
        shape, reach = self.in_world(dynamics), FAR / self.sharpness
        if isinstance(shape, GeomsInWorld):
            found = shape.geoms.bind(dynamics, self.world, reach)
            kernel = source_of(distance_cost, AT=found.numbers, ROWS=max(1, len(found.parts)), MOVED=found.moved)
            own, axes = np.array([self.sharpness, self.weight, reach]), tuple(range(found.moved))
        else:
            found, axes, tables = shape.centers, shape.moved_by, shape.world.tables(times)
            sizes = self.sharpness, self.weight, len(shape.world), len(tables)
            own = np.concatenate([sizes, shape.radii, tables.ravel()])
            if found is None:
                return CostTerm(
                    source_of(obstacle_cost, AXES=axes), own, nonconvex_in=axes, factor=obstacle_cost.WEIGHT
                )
            kernel = source_of(obstacle_cost, AT=found.numbers, BALLS=len(shape.radii), AXES=axes)
        return CostTerm(
            found.filling(kernel),
            np.concatenate([found.data, own]),
            nonconvex_in=axes or None,
            factor=len(found.data) + obstacle_cost.WEIGHT,
            functions=found.functions,
            exact_hessian=False,
        )


def weighing_obstacles(cost: Cost, times: float) -> CostSum:
    """The cost with the weights of its obstacles multiplied."""
    return CostSum(tuple(one if one.kept_clear is None else one.times(times) for one in terms_of(cost)))


class SymbolicCost(OfFormula, Cost):
    """A cost stated as a formula.

    Args:
      function: `function(x, u, p)` of SymPy symbols, as in `Dynamics`; returns one expression. For an initial or final
        cost it must not depend on u.
      parameters: name -> value, as in `Dynamics`.
      convex: set it if the Hessian is positive semidefinite everywhere, to save the projection.
    """

    def __init__(
        self,
        function: Callable[[Any, Any, Any], Any],
        *,
        parameters: Mapping[str, float] | None = None,
        convex: bool = False,
    ) -> None:
        self._set_formula(function, parameters, "FunctionCost for it")
        self.convex = check_flag("SymbolicCost: convex", convex)

    def bind(self, dynamics: Dynamics) -> CostTerm:
        names = dynamics.state_coordinates.names, dynamics.control_coordinates.names
        details = ("cost", *names, tuple(self.parameters))
        made = symbolic.kept(
            self.function, details, lambda: self._trace(*names), source=str, nonconvex_in=list, uses_control=bool
        )
        return CostTerm(
            made["source"],
            self._data,
            nonconvex_in=None if self.convex or not made["nonconvex_in"] else tuple(made["nonconvex_in"]),
            uses_control=made["uses_control"],
        )

    def _trace(self, states: Sequence[str], controls: Sequence[str]) -> dict[str, Any]:
        traced, x, u = symbolic.trace(self.function, states, controls, list(self.parameters))
        if len(traced) != 1:
            raise InputError(f"{self.name}: got {len(traced)} entries, want one: the cost")
        cost, z = traced[0], [*x, *u]
        slopes = [cost.diff(symbol) for symbol in z]
        curves = {(i, j): slope.diff(symbol) for i, slope in enumerate(slopes) for j, symbol in enumerate(z)}
        targets = {"cost": cost}
        targets |= {f"gradient[{i}]+": slope for i, slope in enumerate(slopes) if slope != 0}
        targets |= {f"hessian[{i}, {j}]+": curve for (i, j), curve in curves.items() if curve != 0}
        value = symbolic.write_function("value", "x, u, t, data", "data", {"cost": cost}, of=self.name, returns="cost")
        derivatives = symbolic.write_function(
            "derivatives", "x, u, t, data, hessian, gradient", "data", targets, of=self.name, returns="cost"
        )
        return {
            "source": f"{value}\n\n{derivatives}",
            "nonconvex_in": sorted({i for (i, _), curve in curves.items() if curve != 0}),
            "uses_control": bool(cost.free_symbols & set(u)),
        }


class FunctionCost(OfFunction, Cost):
    """A cost given as a numba or plain Python function, for costs that `SymbolicCost` cannot express.

    Args:
      function: `function(x, u, p)` of NumPy arrays x (n,) and u (m,), which must not be changed; returns the cost.
      derivatives: `derivatives(x, u, p, gradient, hessian)`, which writes to gradient (n+m,) and hessian (n+m, n+m),
        states before controls; both are zero on entry. Without derivatives, both are central differences, accurate to
        about six digits, at two evaluations for every pair of entries in `depends_on`.
      depends_on: names of the states and controls that the cost depends on; all by default. The fewer, the faster.
      parameters: name -> value, as in `Dynamics`.
      convex: set it if the Hessian is positive semidefinite everywhere, to save the projection.
      level: "compiled" or "plain"; by default compiled if the function is numba's, and plain otherwise.
    """

    def __init__(
        self,
        function: Callable[[Any, Any, Any], float],
        *,
        derivatives: Callable[..., None] | None = None,
        depends_on: Sequence[str] | None = None,
        parameters: Mapping[str, float] | None = None,
        convex: bool = False,
        level: str | None = None,
    ) -> None:
        self.function, self.derivatives = function, derivatives
        self.convex = check_flag("FunctionCost: convex", convex)
        self.level = level_of(function, level)
        if self.level == "symbolic":
            if level is not None:
                raise InputError("FunctionCost: level: got 'symbolic', want 'compiled' or 'plain'; or use SymbolicCost")
            self.level = "plain"
        self.depends_on = check_depends_on("FunctionCost", depends_on, "states and controls, at least one")
        if self.depends_on == ():  # a constant: nothing to minimise
            wanted = "a tuple of names of states and controls, at least one"
            raise InputError(f"FunctionCost: depends_on: got none, want {wanted}, or None for all of them")
        self.parameters = symbolic.check_parameters(parameters)
        check_signature(function, ("x", "u", "p"))
        if derivatives is not None:
            check_derivative(
                "FunctionCost: derivatives", derivatives, function, self.level, "x, u, p, gradient, hessian"
            )

    def bind(self, dynamics: Dynamics) -> CostTerm:
        n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
        names = (*dynamics.state_coordinates.names, *dynamics.control_coordinates.names)
        axes, unused = axes_of("FunctionCost", self.depends_on, names)
        functions = with_derivatives(
            self.function, {"values": 1, "unused": unused}, self.derivatives, ((n + m,), (n + m, n + m)),
            level=self.level, states=n, controls=m, parameters=tuple(self.parameters),
        )  # fmt: skip
        source = source_of(user_functions)
        if self.derivatives is None:
            source = source_of(differences, AXES=axes).filled(value=source)
        return CostTerm(
            source,
            self._data,
            nonconvex_in=None if self.convex else axes,
            uses_control=any(axis >= n for axis in axes),
            functions=functions,
        )
