"""Cost terms; `+` composes them. Their structure is source text, their numbers are data.

To add a kind of cost, subclass `Cost` and write `bind`; or state it as a formula with `SymbolicCost`.
"""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim import tracing
from lqrsim.dynamics import Dynamics
from lqrsim.errors import Array, InputError, check_array, check_number, check_weight
from lqrsim.world import ROW, World


@dataclass(frozen=True)
class Term:
    """A cost term, made for one system: what gets compiled, and the numbers it reads.

    Attributes:
      source: defines `value(x, u, t, data)` and `derivatives(x, u, t, data, hessian, gradient)`, both returning the
        cost; the latter *adds* the Hessian (n+m, n+m) and gradient (n+m,) at the point, states before controls. The
        numba subset; the names of `world.py` and `rotations.py`, and N, M, W, sqrt, exp and the like are at hand.
      data: (any,) float64.
      bends: indices of the entries of (x, u) in which the Hessian may be indefinite: None for a convex term. The sum of
        all such terms is projected to the nearest positive-semidefinite matrix.
      uses_control: whether it depends on u (only stage costs may).
    """

    source: str
    data: Array
    bends: tuple[int, ...] | None = None
    uses_control: bool = False


class Cost(abc.ABC):
    """One term of a cost."""

    @abc.abstractmethod
    def bind(self, dynamics: Dynamics) -> Term:
        """This cost for a system. Raises InputError if it does not fit (a weight of the wrong size, say)."""

    def __add__(self, other: "Cost") -> "CostSum":
        return CostSum((*terms_of(self), *terms_of(other)))


class CostSum(Cost):
    """What `+` makes: the terms, in order."""

    def __init__(self, terms: tuple[Cost, ...]) -> None:
        self.terms = terms

    def bind(self, dynamics: Dynamics) -> Term:
        raise TypeError("a sum is bound term by term")


def terms_of(cost: Cost) -> tuple[Cost, ...]:
    """The terms of a sum; a single cost is its own. Raises InputError for what is no cost."""
    if isinstance(cost, CostSum):
        return cost.terms
    if not isinstance(cost, Cost):
        raise InputError(f"cost: got {cost!r}, want a cost such as QuadraticCost(...) or a sum of costs")
    return (cost,)


class QuadraticCost(Cost):
    """`1/2 (x - about)' weight (x - about)`.

    Args:
      weight: (n, n) symmetric positive semidefinite, or its diagonal (n,).
      about: (n,) the state where it is zero.
    """

    def __init__(self, weight: npt.ArrayLike, *, about: npt.ArrayLike) -> None:
        self.weight = check_weight("QuadraticCost: weight", weight)
        self.about = check_array("QuadraticCost: about", about, (len(self.weight),))

    def bind(self, dynamics: Dynamics) -> Term:
        _check_size("QuadraticCost: weight", self.weight, len(dynamics.state_coordinates), "states")
        return Term(_QUADRATIC.format(first="0", size="N", z="x"), np.concatenate([self.about, self.weight.ravel()]))


class ControlCost(Cost):
    """`1/2 (u - about)' weight (u - about)`.

    Args:
      weight: (m, m) symmetric positive definite, or its diagonal (m,).
      about: (m,) the nominal control, where it is zero; the solvers start from it unless told otherwise.
    """

    def __init__(self, weight: npt.ArrayLike, *, about: npt.ArrayLike) -> None:
        self.weight = check_weight("ControlCost: weight", weight, definite=True)
        self.about = check_array("ControlCost: about", about, (len(self.weight),))

    def bind(self, dynamics: Dynamics) -> Term:
        _check_size("ControlCost: weight", self.weight, len(dynamics.control_coordinates), "controls")
        source = _QUADRATIC.format(first="N", size="M", z="u")
        return Term(source, np.concatenate([self.about, self.weight.ravel()]), uses_control=True)


class ObstacleCost(Cost):
    """`weight * sum over obstacles of exp(-sharpness * (distance - radius))`, from the first step on.

    Paper: Sec. VI-A, with the sharpness made explicit. At t = 0, where the state is given, it does not act. A robot in
    the plane (two position coordinates) sees the world from above; see `World.seen_by`.

    Args:
      world: the obstacles. radius: of the robot, in metres.
      sharpness: in 1/m. weight: cost of touching one obstacle for one step.
    """

    def __init__(self, world: World, *, radius: float, sharpness: float = 10.0, weight: float = 1.0) -> None:
        if not isinstance(world, World):
            raise InputError(f"ObstacleCost: world: got {type(world).__name__}, want a World, such as scene.world")
        self.world = world
        self.radius = check_number("ObstacleCost: radius", radius, at_least=0.0)
        self.sharpness = check_number("ObstacleCost: sharpness", sharpness, above=0.0)
        self.weight = check_number("ObstacleCost: weight", weight, at_least=0.0)

    def bind(self, dynamics: Dynamics) -> Term:
        position = dynamics.state_coordinates.position
        if not position:
            raise InputError("ObstacleCost: got dynamics without a position, want Dynamics(..., position=(names))")
        world = self.world.seen_by(len(position))
        place = [f"x[{i}]" for i in position] + (["0.0"] if len(position) == 2 else [])
        source = _OBSTACLES.format(place=", ".join(place), axes=repr(position), size=len(position), row=ROW)
        data = np.concatenate([[self.radius, self.sharpness, self.weight, len(world)], world.table.ravel()])
        return Term(source, data, bends=position)


class SymbolicCost(Cost):
    """A cost stated as a formula.

    Args:
      function: `function(x, u, p)` of SymPy symbols, as in `Dynamics`; returns one expression. For an initial or final
        cost it must not depend on u.
      parameters: name -> value, as in `Dynamics`.
      convex: set it where the Hessian is positive semidefinite everywhere, to save the projection.
    """

    def __init__(
        self,
        function: Callable[[Any, Any, Any], Any],
        *,
        parameters: Mapping[str, float] | None = None,
        convex: bool = False,
    ) -> None:
        self.function = function
        self.parameters = tracing.check_parameters(parameters or {})
        self.convex = convex

    def bind(self, dynamics: Dynamics) -> Term:
        n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
        traced, x, u = tracing.trace(self.function, n, m, list(self.parameters))
        if len(traced) != 1:
            name = getattr(self.function, "__qualname__", repr(self.function))
            raise InputError(f"{name}(x, u, p): got {len(traced)} entries, want one: the cost")
        cost, z = traced[0], [*x, *u]
        slopes = [cost.diff(symbol) for symbol in z]
        curves = {(i, j): slope.diff(symbol) for i, slope in enumerate(slopes) for j, symbol in enumerate(z)}
        targets = {"cost": cost}
        targets |= {f"gradient[{i}]+": slope for i, slope in enumerate(slopes) if slope != 0}
        targets |= {f"hessian[{i}, {j}]+": curve for (i, j), curve in curves.items() if curve != 0}
        value = tracing.write_function("value", "x, u, t, data", "data", {"cost": cost}, returns="cost")
        derivatives = tracing.write_function(
            "derivatives", "x, u, t, data, hessian, gradient", "data", targets, returns="cost"
        )
        bends = tuple(sorted({i for (i, _), curve in curves.items() if curve != 0}))
        return Term(
            f"{value}\n\n{derivatives}",
            np.array(list(self.parameters.values()), dtype=np.float64),
            bends=None if self.convex or not bends else bends,
            uses_control=bool(cost.free_symbols & set(u)),
        )


def _check_size(field: str, weight: Array, want: int, what: str) -> None:
    if len(weight) != want:
        raise InputError(f"{field}: got size {len(weight)}, want {want}, the number of {what}")


_QUADRATIC = """\
def value(x, u, t, data):
    total = 0.0
    for i in range({size}):
        slope = 0.0
        for j in range({size}):
            slope += data[{size} + {size} * i + j] * ({z}[j] - data[j])
        total += 0.5 * slope * ({z}[i] - data[i])
    return total


def derivatives(x, u, t, data, hessian, gradient):
    total = 0.0
    for i in range({size}):
        slope = 0.0
        for j in range({size}):
            weight = data[{size} + {size} * i + j]
            slope += weight * ({z}[j] - data[j])
            hessian[{first} + i, {first} + j] += weight
        gradient[{first} + i] += slope
        total += 0.5 * slope * ({z}[i] - data[i])
    return total
"""

_OBSTACLES = """\
def value(x, u, t, data):
    total = 0.0
    if t > 0:
        for i in range(int(data[3])):
            distance = signed_distance(data, 4 + {row} * i, {place})
            total += exp(-data[1] * (distance - data[0]))
    return data[2] * total


def derivatives(x, u, t, data, hessian, gradient):
    total = 0.0
    if t > 0:
        axes = {axes}
        slope, curve, slopes, curves = stack(3), stack(3, 3), stack(3), stack(3, 3)
        clear(curves, 3, 3)
        for j in range(3):
            slopes[j] = 0.0
        for i in range(int(data[3])):
            distance = signed_distance_derivatives(data, 4 + {row} * i, {place}, slope, curve)
            cost = data[2] * exp(-data[1] * (distance - data[0]))
            total += cost
            for j in range(3):
                slopes[j] -= cost * slope[j]
                for k in range(3):
                    curves[j, k] += cost * (data[1] * slope[j] * slope[k] - curve[j, k])
        for j in range({size}):
            gradient[axes[j]] += data[1] * slopes[j]
            for k in range({size}):
                hessian[axes[j], axes[k]] += data[1] * curves[j, k]
    return total
"""
