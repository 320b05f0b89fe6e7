"""Any problem that is stated by formulas, as functions of CasADi's: a step, the costs and the constraints at a knot.

What differs between problems of one kind is a parameter, so that one compiled solver serves all of them: the start, the
state and control that costs are about, and the numbers of formulas. Obstacles and weights are constants. A free
duration is one more state, in s, that a step leaves as it is.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim.codegen.symbolic import Vector
from lqrsim.errors import Array
from lqrsim.problem.parts import Cost, goals_of, terms_of
from peers.common import casadi


@dataclass(frozen=True)
class Formulas:
    """The functions, of a state, a control and the parameters; those at the last knot have no control.

    Attributes:
      step: the next state.
      costs: at the first knot, at those between, and at the last.
      rows: of constraints at the same three; inequalities are not to be negative.
      equalities: whether each of these rows is one.
    """

    step: Any
    costs: tuple[Any, Any, Any]
    rows: tuple[Any, Any, Any]
    equalities: Sequence[list[bool]]


def formulas(problem: ls.Problem) -> Formulas:
    """Raises NotImplementedError for what is no formula, and Unavailable without CasADi."""
    ca, dynamics = casadi(), problem.dynamics
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    numbers = parameters(problem)
    x, u, p = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("p", len(numbers))
    duration = ca.SX.sym("duration", 0 if problem.duration is None else 1)
    given = _Given(p)
    given(n)  # the start
    values = given(len(dynamics.parameters))

    def rate(x: Any) -> Any:
        names = tuple(dynamics.parameters)
        return ca.vertcat(*evaluate(_by_name(problem, dynamics.f), names, x, u, values, dynamics.constants))

    h = problem.dt if problem.duration is None else duration / problem.steps
    first = rate(x)
    second = rate(x + h / 2 * first)
    third = rate(x + h / 2 * second)
    after = x + h / 6 * (first + 2 * second + 2 * third + rate(x + h * third))
    begin, between, end = ca.SX(0), ca.SX(0), ca.SX(0)
    for one in terms_of(problem.stage_cost):
        cost = _cost(problem, one, x, u, given)
        between += cost
        begin += 0 if isinstance(one, ls.ObstacleCost) else cost  # which does not act there
    for one in terms_of(problem.final_cost):
        end += _cost(problem, one, x, u, given)
    if problem.duration is not None:
        end += problem.time_weight * duration
    rows = [_constraint(problem, one, x, u, given) for one in problem.constraints]
    kinds = [
        [one for one in rows if one.with_control],
        [one for one in rows if not one.at_end],
        [one for one in rows if not one.with_control],
    ]
    stacked = [ca.vertcat(*[one.values for one in kind]) for kind in kinds]
    after, x = ca.vertcat(after, duration), ca.vertcat(x, duration)
    return Formulas(
        step=ca.Function("step", [x, u, p], [after]),
        costs=(
            ca.Function("begin", [x, u, p], [begin]),
            ca.Function("between", [x, u, p], [between]),
            ca.Function("end", [x, p], [end]),
        ),
        rows=(
            ca.Function("begin_rows", [x, u, p], [stacked[0]]),
            ca.Function("rows", [x, u, p], [stacked[1]]),
            ca.Function("end_rows", [x, p], [stacked[2]]),
        ),
        equalities=[[one.equality for one in kind for _ in range(one.values.numel())] for kind in kinds],
    )


def parameters(problem: ls.Problem) -> Array:
    """The numbers that `Formulas` take, in their order: the start first."""
    if not isinstance(problem.initial, ls.FixedState):
        raise NotImplementedError("a start that is not given exactly")
    found = [problem.initial.numbers, np.array(list(problem.dynamics.parameters.values()))]
    for one in (*terms_of(problem.stage_cost), *terms_of(problem.final_cost)):
        if isinstance(one, ls.QuadraticCost | ls.ControlCost):
            if one.by_knot:
                raise NotImplementedError("a reference with a row for each knot")
            found.append(one.about)
        elif isinstance(one, ls.SymbolicCost):
            found.append(np.array(list(one.parameters.values())))
    for one in problem.constraints:
        if isinstance(one, ls.SymbolicConstraint):
            found.append(np.array(list(one.parameters.values())))
        elif isinstance(one, ls.GoalState):
            found.append(np.array(list(one.final_states(problem.dynamics).values())))
    return np.concatenate(found)


class _Given:
    """Hands out the parameters, in their order."""

    def __init__(self, symbols: Any) -> None:
        self._symbols, self._used = symbols, 0

    def __call__(self, count: int) -> Any:
        self._used += count
        return self._symbols[self._used - count : self._used]


@dataclass(frozen=True)
class _Rows:
    """Numbers of a constraint. They act at the knots that have a control, or at all but the first, or at the last."""

    values: Any
    equality: bool = False
    with_control: bool = False
    at_end: bool = False


def _cost(problem: ls.Problem, cost: Cost, x: Any, u: Any, given: _Given) -> Any:
    ca = casadi()
    if isinstance(cost, ls.QuadraticCost):
        return _quadratic(cost.weight, x - given(len(cost.about)))
    if isinstance(cost, ls.ControlCost):
        return _quadratic(cost.weight, u - given(len(cost.about)))
    if isinstance(cost, ls.SymbolicCost):
        function = _by_name(problem, cost.function)
        return evaluate(function, tuple(cost.parameters), x, u, given(len(cost.parameters)))[0]
    if isinstance(cost, ls.ObstacleCost) and cost.balls is None:
        away = _from_obstacles(problem, cost.world, x) - cost.radius
        return cost.weight * ca.sum1(ca.exp(-cost.sharpness * away))
    raise NotImplementedError(f"the cost {cost.name}")


def _constraint(problem: ls.Problem, constraint: ls.Constraint, x: Any, u: Any, given: _Given) -> _Rows:
    ca = casadi()
    if isinstance(constraint, ls.StateBounds):  # which are bounds of the variables
        return _Rows(ca.SX(0, 1))
    if isinstance(constraint, ls.GoalState):
        places = list(constraint.final_states(problem.dynamics))
        return _Rows(x[places] - given(len(places)), equality=True, at_end=True)
    if isinstance(constraint, ls.SymbolicConstraint):
        numbers = given(len(constraint.parameters))
        function = _by_name(problem, constraint.function)
        values = ca.vertcat(*evaluate(function, tuple(constraint.parameters), x, u, numbers))
        with_control = bool(ca.depends_on(values, u))
        return _Rows(values, constraint.equality, with_control, constraint.at == "final")
    if isinstance(constraint, ls.Clearance) and isinstance(constraint.margin, float):
        if constraint.balls is None:
            return _Rows(_from_obstacles(problem, constraint.world, x) - constraint.radius - constraint.margin)
        balls, dynamics = constraint.balls, problem.dynamics
        values = ca.DM(list(dynamics.parameters.values()))
        places = evaluate(_coordinates(balls), tuple(dynamics.parameters), x, u, values, dynamics.constants)
        rows = [
            _distance(obstacle, ca.vertcat(*places[3 * ball : 3 * ball + 3])) - radius - constraint.margin
            for ball, radius in enumerate(balls.radii)
            for obstacle in constraint.world.obstacles
        ]
        return _Rows(ca.vertcat(*rows))
    raise NotImplementedError(f"the constraint {type(constraint).__name__}")


def _coordinates(balls: ls.CollisionSpheres) -> Callable[[Any, Any, Any], list[Any]]:
    """The coordinates of all balls as a formula of x, u and p, three a ball."""

    def places(x: Any, u: Any, p: Any) -> list[Any]:
        return [entry for place in balls.function(x, p) for entry in place]

    return places


def _from_obstacles(problem: ls.Problem, world: ls.World, x: Any) -> Any:
    ca, space = casadi(), problem.dynamics.state_coordinates
    place = ca.vertcat(x[list(space.position)], *[0.0] * (3 - len(space.position)))
    seen = world.seen_by(space.plane, space.offset)
    return ca.vertcat(*[_distance(obstacle, place) for obstacle in seen.obstacles])


def state_bounds(problem: ls.Problem) -> tuple[Array, Array]:
    """Bounds (T+1, n) of the states; infinite where there is none, and at the given start.

    One column more with a free duration.
    """
    names = problem.dynamics.state_coordinates.names
    fixed = goals_of(problem.constraints, problem.dynamics)
    low = np.full((problem.steps + 1, len(names)), -np.inf)
    high = -low
    for one in problem.constraints:
        if isinstance(one, ls.StateBounds):
            for i, (least, most) in one.state_bounds(problem.dynamics).items():
                last = problem.steps if i in fixed else problem.steps + 1
                low[1:last, i] = np.maximum(low[1:last, i], least)
                high[1:last, i] = np.minimum(high[1:last, i], most)
    if problem.duration is not None:
        low, high = (
            np.column_stack([side, np.full(len(side), bound)])
            for side, bound in zip((low, high), problem.duration, strict=True)
        )
    return low, high


def _by_name(problem: ls.Problem, function: Any) -> Any:
    """The formula with states and controls that it may also read by their names."""
    dynamics = problem.dynamics
    names = dynamics.state_coordinates.names, dynamics.control_coordinates.names

    def named(x: Any, u: Any, p: Any) -> Any:
        return function(Vector(x, names[0]), Vector(u, names[1]), p)

    return named


def evaluate(
    function: Any, names: tuple[str, ...], x: Any, u: Any, numbers: Any, constants: Mapping[str, float] | None = None
) -> list[Any]:
    """A formula `function(x, u, p)` of SymPy's, evaluated with CasADi's symbols; its entries, or its only one.

    Of p, `names` have the numbers as their values, and constants their own.
    """
    ca = casadi()
    translated = _translated(function, x.numel(), u.numel(), names, constants or {})
    values = translated(ca.vertsplit(x), ca.vertsplit(u), ca.vertsplit(numbers) if names else [])
    return [ca.SX(value) for value in values]


def _translated(
    function: Any, n: int, m: int, names: tuple[str, ...], constants: Mapping[str, float]
) -> Callable[..., Sequence[Any]]:
    import sympy

    symbols = [sympy.symbols([f"{letter}{i}" for i in range(size)]) for letter, size in (("x", n), ("u", m))]
    values = sympy.symbols([f"p_{name}" for name in names])
    namespace = type("Parameters", (), {**constants, **dict(zip(names, values, strict=True))})
    found = function(*symbols, namespace)
    entries = [sympy.sympify(one) for one in (found if isinstance(found, list | tuple) else [found])]
    return sympy.lambdify([*symbols, values], entries, modules=[_words()], printer=_printer(), cse=True)


@cache
def _printer() -> Any:
    """SymPy's printer with CasADi's words for what Python's own operators do not do with symbols."""
    from sympy.printing.lambdarepr import LambdaPrinter

    class Printer(LambdaPrinter):
        def _print_Piecewise(self, expr: Any) -> Any:
            *others, (value, _) = expr.args  # the last is for all other cases
            chosen = self._print(value)
            for other, condition in reversed(others):
                chosen = f"if_else({self._print(condition)}, {self._print(other)}, {chosen})"
            return chosen

        def _print_And(self, expr: Any) -> str:
            return self._joined("logic_and", expr.args)

        def _print_Or(self, expr: Any) -> str:
            return self._joined("logic_or", expr.args)

        def _joined(self, word: str, parts: Sequence[Any]) -> str:
            first, *others = (self._print(part) for part in parts)
            for other in others:
                first = f"{word}({first}, {other})"
            return first

    return Printer({"fully_qualified_modules": False, "inline": True, "allow_unknown_functions": True})


def _words() -> dict[str, Any]:
    ca = casadi()
    names = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "exp", "log", "sqrt", "tanh", "if_else")
    words = {name: getattr(ca, name) for name in (*names, "logic_and", "logic_or")}
    turns = ("sine_ratio", "cosine_ratio", "cotangent_ratio")
    return words | {name: lambda s, i=i: _ratios(s)[i] for i, name in enumerate(turns)} | {"abs": ca.fabs, "pi": np.pi}


def _quadratic(weight: Array, off: Any) -> Any:
    ca = casadi()
    return 0.5 * ca.bilin(ca.sparsify(ca.DM(weight)), off, off)


def _ratios(s: Any) -> list[Any]:
    """sin t / t, (1 - cos t) / t^2 and (1 - t/2 cot(t/2)) / t^2 at t^2 = s; below 1/4 by their series."""
    ca = casadi()
    t = ca.sqrt(ca.fmax(s, 0.25))  # both cases are always evaluated, so neither may be singular
    sine, cosine = ca.sin(t) / t, (1 - ca.cos(t)) / (t * t)
    large = sine, cosine, (1 - sine / (2 * cosine)) / (t * t)
    series = (
        [1 / 6, 1 / 20, 1 / 42, 1 / 72, 1 / 110, 1 / 156, 1 / 210],
        [1 / 12, 1 / 30, 1 / 56, 1 / 90, 1 / 132, 1 / 182],
    )
    small = []
    for factors in series:
        value = 1.0
        for factor in reversed(factors):
            value = 1 - factor * s * value
        small.append(value)
    tail = 1 / 47900160 + s * (691 / 1307674368000 + s * (1 / 74724249600 + s * 3617 / 10670622842880000))
    small = small[0], small[1] / 2, 1 / 12 + s * (1 / 720 + s * (1 / 30240 + s * (1 / 1209600 + s * tail)))
    return [ca.if_else(s > 0.25, *pair) for pair in zip(large, small, strict=True)]


def _distance(obstacle: ls.Obstacle, place: Any) -> Any:
    """Signed distance in metres; where it has no derivative it has one of zero."""
    ca = casadi()
    local = ca.sparsify(ca.DM(obstacle.rotation.T)) @ (place - obstacle.position)
    side, height = _length(local[:2]), ca.fabs(local[2])
    radius, half, _ = obstacle.size
    match obstacle.kind:
        case "plane":
            return local[2]
        case "sphere":
            return _length(place - obstacle.position) - radius
        case "capsule":
            return _length(ca.vertcat(local[:2], ca.fmax(height - half, 0))) - radius
        case "cylinder" if np.isinf(half):
            return side - radius
        case "cylinder":
            return _outside(ca.vertcat(side - radius, height - half))
    finite = [axis for axis in range(3) if np.isfinite(obstacle.size[axis])]
    return _outside(ca.fabs(local[finite]) - obstacle.size[finite])


def _outside(beyond: Any) -> Any:
    """Distance to a convex body from how far a point is beyond each of its mutually perpendicular faces."""
    ca = casadi()
    return _length(ca.fmax(beyond, 0)) + ca.fmin(ca.mmax(beyond), 0)


def _length(vector: Any) -> Any:
    ca = casadi()
    return ca.sqrt(ca.fmax(ca.sumsqr(vector), 1e-24))
