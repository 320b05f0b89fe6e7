"""Costs and constraints that are stated as functions: formulas of symbols, and numba, JAX or plain Python functions.

The kernel is that of a formula at some knots, with numbers of its own at each.
"""

import copy
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import inf
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import checked
from lqrsim.codegen import symbolic
from lqrsim.codegen.sources import source_of
from lqrsim.codegen.user_functions import (
    axes_of,
    check_depends_on,
    check_derivative,
    level_of,
    name_of,
    with_derivatives,
)
from lqrsim.errors import Array, InputError, check_kind, check_name, check_shape, check_text, excerpt, numbers_of
from lqrsim.kernels import differences, user_functions
from lqrsim.kernels.declarations import constraint_slope, constraint_value, stack
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.parts import STEPS, Constraint, ConstraintTerm, Cost, CostTerm

WANTED = "one of SymPy symbols"  # for a numba function in place of a formula
MOST_LETTERS = 60  # of an expression that stands for a name: half a line


class OfFunction:
    """A cost or a constraint that is stated as a function, with parameters."""

    function: Callable[..., Any]
    parameters: dict[str, float]
    _name: str = ""  # the given name

    @property
    def name(self) -> str:
        return self._name or f"{name_of(self.function)}(x, u, p)"

    def _stated(self) -> Mapping[str, object]:
        return {**super()._stated(), "name": self._name or None}  # pyright: ignore[reportAttributeAccessIssue]

    def _set_name(self, name: str | None) -> None:
        if name is not None:
            self._name = check_text(f"{type(self).__name__}: name", name)

    @property
    def _data(self) -> Array:
        return np.array(list(self.parameters.values()), dtype=np.float64)


class OfFormula(OfFunction):
    """A cost or a constraint that is stated as a formula."""

    def _set_formula(
        self, function: Callable[..., Any], parameters: Mapping[str, float] | None, name: str | None, instead: str
    ) -> None:
        self._set_name(name)
        if level_of(function, None) == "compiled":
            raise InputError(f"{type(self).__name__}: got the numba function {name_of(function)}, want {instead}")
        self.function, self.parameters = function, symbolic.check_parameters(parameters)

    def with_added_state(self, dynamics: Dynamics) -> Self:
        other, function, n = copy.copy(self), self.function, len(dynamics.state_coordinates)
        other.function = functools.update_wrapper(lambda x, u, p: function(x[:n], u, p), function)
        return other


class SymbolicCost(OfFormula, Cost):
    """A cost stated as a formula.

    Args:
      function: `function(x, u, p)` of SymPy symbols, as in `Dynamics`; returns one expression. For an initial or final
        cost it must not depend on u.
      parameters: name -> value, as in `Dynamics`.
      convex: set it if the Hessian is positive semidefinite everywhere, to save the projection.
      name: the name in messages; by default that of the function.
    """

    @checked
    def __init__(
        self,
        function: Callable[[Any, Any, Any], Any],
        *,
        parameters: Mapping[str, float] | None = None,
        convex: bool = False,
        name: str | None = None,
    ) -> None:
        self._set_formula(function, parameters, name, "FunctionCost for it")
        self.convex = convex

    def bind(self, dynamics: Dynamics) -> CostTerm:
        names = dynamics.state_coordinates.names, dynamics.control_coordinates.names
        details = ("cost", *names, tuple(self.parameters))
        kinds = {"source": str, "nonconvex_in": list, "uses_control": bool}
        traced = symbolic.kept(self.function, details, lambda: self._trace(*names), **kinds)
        curved = None if self.convex or not traced["nonconvex_in"] else tuple(traced["nonconvex_in"])
        return CostTerm(traced["source"], self._data, nonconvex_in=curved, uses_control=traced["uses_control"])

    def _trace(self, states: Sequence[str], controls: Sequence[str]) -> dict[str, Any]:
        traced, x, u = symbolic.trace(self.function, states, controls, list(self.parameters))
        if len(traced) != 1:
            raise InputError(f"{self.name}: got {len(traced)} entries, want one: the cost")
        cost, z = traced[0], [*x, *u]
        slopes = [cost.diff(symbol) for symbol in z]
        curves = {(i, j): slope.diff(symbol) for i, slope in enumerate(slopes) for j, symbol in enumerate(z)}
        curves = {pair: curve for pair, curve in curves.items() if curve != 0}
        targets = {"cost": cost}
        targets |= {f"gradient[{i}]+": slope for i, slope in enumerate(slopes) if slope != 0}
        targets |= {f"hessian[{i}, {j}]+": curve for (i, j), curve in curves.items()}
        write = functools.partial(symbolic.write_function, data="data", of=self.name, returns="cost")
        value = write("value", "x, u, t, data", assignments={"cost": cost})
        derivatives = write("derivatives", "x, u, t, data, hessian, gradient", assignments=targets)
        curved, uses_control = sorted({i for i, _ in curves}), bool(cost.free_symbols & set(u))
        return {"source": f"{value}\n\n{derivatives}", "nonconvex_in": curved, "uses_control": uses_control}


class SymbolicConstraint(OfFormula, Constraint):
    """A constraint stated as a formula: `f(x, u) >= 0`, or `f(x, u) = 0` with `equality`.

        def slower_than_2(x, u, p):  # a planar speed, in m/s
            return p.speed**2 - x.vx**2 - x.vy**2

        ls.SymbolicConstraint(slower_than_2, parameters={"speed": 2.0})

    A constraint that depends on the control does not act at the last knot, which has none. A constraint on the state
    alone does not act at a start that is given exactly, because that cannot change.

    An inequality may act at some knots alone, with parameters of their own: a waypoint, or a gate.

        def near(x, u, p):  # within 0.3 m of the waypoints (1, 2) at knot 20 and (3, 2) at knot 40
            return p.radius**2 - (x.x - p.x) ** 2 - (x.y - p.y) ** 2

        ls.SymbolicConstraint(near, parameters={"x": [1.0, 3.0], "y": 2.0, "radius": 0.3}, at=[20, 40])

    Args:
      function: `function(x, u, p)` of SymPy symbols, as in `Dynamics`; returns one expression, or a list of them, that
        must be nonnegative. Either all of them depend on u, or none does. All are solved to the same tolerance, so
        choose units in which values of about 1 matter.
      parameters: name -> value, as in `Dynamics`. With knots, a value may be (K,) numbers, one for each.
      equality: whether the expressions must be zero, within 1e-6, or `constraint_tolerance` if that is smaller.
      at: "all" steps; or only the "final" step, at which the expressions must not depend on u; or the indices (K,) of
        knots, in order. Those move with time when a `Replanner` plans again, as rows of a `StateBounds`.
      name: the name in messages and in `Problem.violations`; by default that of the function, or a lambda's expression.
    """

    @checked
    def __init__(
        self,
        function: Callable[[Any, Any, Any], Any],
        *,
        parameters: Mapping[str, Any] | None = None,
        equality: bool = False,
        at: str | npt.ArrayLike = "all",
        name: str | None = None,
    ) -> None:
        self.equality = equality
        self.at = check_name("SymbolicConstraint: at", at, STEPS) if isinstance(at, str) else _knots(at)
        self._table = np.zeros((0, 0))  # (K, P) of the knots
        if self.by_knot:
            if self.equality:
                raise InputError("SymbolicConstraint: equality: got True at some knots, want False, or at='all'")
            check_kind("parameters", parameters, (Mapping, type(None)), "a dictionary of name: value")
            want = "a number, or one for each of its knots"
            columns = {key: numbers_of(f"parameters: {key}", entry, want) for key, entry in (parameters or {}).items()}
            for key, column in columns.items():
                check_shape(f"parameters: {key}", column, (len(self.at),) if column.ndim else ())
            parameters = {key: float(column.ravel()[0]) for key, column in columns.items()}
            rows = [np.broadcast_to(column, len(self.at)) for column in columns.values()]
            self._table = np.array(rows, dtype=np.float64).reshape(len(rows), len(self.at)).T
        self._set_formula(function, parameters, name, WANTED)

    @property
    def by_knot(self) -> bool:
        return not isinstance(self.at, str)

    def _stated(self) -> Mapping[str, object]:
        columns = dict(zip(self.parameters, self._table.T, strict=True)) if self.by_knot else self.parameters
        return {**super()._stated(), "parameters": columns}

    def _at_other_knots(self, select: Callable[[Array], Array]) -> Self:
        # As for any array of rows: at knots from the first to the last of all, which row holds at each, or none.
        assert not isinstance(self.at, str)
        rows = np.full(max(self.at, default=-1) + 2, -1.0)  # a row that is repeated says that none does
        rows[list(self.at)] = np.arange(len(self.at))
        row_at = select(rows)
        other = copy.copy(self)
        other.at = tuple(np.flatnonzero(row_at >= 0).tolist())
        other._table = self._table[row_at[row_at >= 0].astype(int)]
        return other

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        names = dynamics.state_coordinates.names, dynamics.control_coordinates.names
        details = ("constraint", *names, tuple(self.parameters))
        kinds = {"source": str, "rows": int, "with_control": list, "texts": list}
        traced = symbolic.kept(self.function, details, lambda: self._trace(*names), **kinds)
        with_control, rows = traced["with_control"], traced["rows"]
        if self.at == "final" and with_control:
            got, want = "an entry that depends on u", "none at the final step, which has no u"
            raise InputError(f"{self.name}: got {got}, want {want}")
        if 0 < len(with_control) < rows:
            got, want = f"{rows} entries of which {len(with_control)} depend on u", "all of them or none"
            raise InputError(f"{self.name}: got {got}, want {want}: state the others as another SymbolicConstraint")
        kind = "=" if self.equality else ">="
        parts = [f"[{row}]" for row in range(rows)] if rows > 1 else [""]
        name = self._name or getattr(self.function, "__name__", type(self.function).__name__)
        names, texts = ([f"{prefix}{part}" for part in parts] for prefix in (name, self.name))
        if name == "<lambda>":
            names = texts = traced["texts"]
        term = ConstraintTerm(
            traced["source"], self._data, rows, lambda row: f"{texts[row]} {kind} 0", names=tuple(names),
            uses_control=bool(with_control), equality=self.equality, final_only=self.at == "final",
        )  # fmt: skip
        if isinstance(self.at, str):
            return term
        kernel = source_of(__name__, COUNT=self._table.shape[1])
        filled = {"constraint_value": (term.code, "value"), "constraint_slope": (term.code, "slope")}
        numbers = np.concatenate([[len(self.at)], self.at, self._table.ravel()])
        return replace(term, source=kernel.filled(**filled), data=numbers)

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> ConstraintTerm:
        if not isinstance(self.at, str) and self.at and self.at[-1] >= len(times):
            got, want = f"knot {self.at[-1]}", f"knots up to {len(times) - 1}, the number of steps"
            raise InputError(f"SymbolicConstraint: at: got {got}, want {want}")
        return self.bind(dynamics)

    def _trace(self, states: Sequence[str], controls: Sequence[str]) -> dict[str, Any]:
        traced, x, u = symbolic.trace(self.function, states, controls, list(self.parameters))
        if not traced:
            raise InputError(f"{self.name}: got no entries, want at least one: each must be nonnegative, or zero")
        parts, choices = [], {"value": [], "slope": []}
        write = functools.partial(symbolic.write_function, data="data", of=self.name)
        for row, entry in enumerate(traced):
            if not entry.free_symbols & {*x, *u}:
                raise InputError(f"{self.name}: got {entry} as entry {row}, want it to depend on x or u")
            slopes = {f"gradient[{i}]+": entry.diff(symbol) for i, symbol in enumerate([*x, *u])}
            slopes = {target: slope for target, slope in slopes.items() if slope != 0}
            parts.append(write(f"value_{row}", "x, u, data", assignments={"entry": entry}, returns="entry"))
            parts.append(write(f"slope_{row}", "x, u, data, gradient", assignments=slopes))
            choices["value"].append(f"    if row == {row}:\n        return value_{row}(x, u, data)")
            choices["slope"].append(f"    if row == {row}:\n        slope_{row}(x, u, data, gradient)")
        words = {f"x{i}": name for i, name in enumerate(states)} | {f"u{i}": name for i, name in enumerate(controls)}
        words |= {f"p{i}": f"p.{name}" for i, name in enumerate(self.parameters)}
        texts = [re.sub(r"\b[xup]\d+\b", lambda match: words[match[0]], str(entry)) for entry in traced]
        value = "\n".join(["def value(x, u, t, row, data):", *choices["value"], "    return 0.0"])
        slope = "\n".join(["def slope(x, u, t, row, data, gradient):", *choices["slope"]])
        for row, text in enumerate(texts):
            if len(text) > MOST_LETTERS:
                texts[row] = f"{text[:MOST_LETTERS]}...[{row}]"
        with_control = [row for row, entry in enumerate(traced) if entry.free_symbols & set(u)]
        source = "\n\n".join([*parts, value, slope]) + "\n"
        return {"source": source, "rows": len(traced), "texts": texts, "with_control": with_control}


class FunctionCost(OfFunction, Cost):
    """A cost given as a numba, JAX or plain Python function, for costs that `SymbolicCost` cannot express.

    Args:
      function: `function(x, u, p)` of arrays x (n,) and u (m,), which must not be changed; returns the cost.
      derivatives: `derivatives(x, u, p, gradient, hessian)`, which writes to gradient (n+m,) and hessian (n+m, n+m),
        states before controls; both are zero on entry. Without derivatives, both are central differences, accurate to
        about six digits, at two evaluations for every pair of entries in `depends_on`; JAX derives them.
      depends_on: names of the states and controls that the cost depends on; all by default. The fewer, the faster.
      parameters: name -> value, as in `Dynamics`.
      convex: this and `name` are as in `SymbolicCost`.
      level: "compiled", "jax" or "plain"; by default compiled if the function is numba's, and plain otherwise.
    """

    @checked
    def __init__(
        self,
        function: Callable[[Any, Any, Any], float],
        *,
        derivatives: Callable[..., None] | None = None,
        depends_on: Sequence[str] | None = None,
        parameters: Mapping[str, float] | None = None,
        convex: bool = False,
        level: str | None = None,
        name: str | None = None,
    ) -> None:
        self._set_name(name)
        self.function, self.derivatives = function, derivatives
        self.convex = convex
        self.level = level_of(function, level)
        if level == "symbolic":
            wanted = "'compiled', 'jax' or 'plain'; or use SymbolicCost"
            raise InputError(f"FunctionCost: level: got 'symbolic', want {wanted}")
        if self.level == "symbolic":
            self.level = "plain"
        self.depends_on = check_depends_on("FunctionCost", depends_on, "states and controls, at least one")
        if self.depends_on == ():  # a constant: nothing to minimise
            wanted = "a tuple of names of states and controls, at least one"
            raise InputError(f"FunctionCost: depends_on: got none, want {wanted}, or None for all of them")
        self.parameters = symbolic.check_parameters(parameters)
        if derivatives is not None:
            arguments = "x, u, p, gradient, hessian"
            check_derivative("FunctionCost: derivatives", derivatives, function, self.level, arguments)

    def bind(self, dynamics: Dynamics) -> CostTerm:
        n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
        names = (*dynamics.state_coordinates.names, *dynamics.control_coordinates.names)
        axes, unused = axes_of("FunctionCost", self.depends_on, names)
        functions = with_derivatives(
            self.function, {"values": 1, "unused": unused}, self.derivatives, ((n + m,), (n + m, n + m)),
            level=self.level, states=n, controls=m, parameters=tuple(self.parameters),
        )  # fmt: skip
        source = source_of(user_functions)
        if len(functions) == 1:
            source = source_of(differences, ACTIVE=axes).filled(value=source)
        curved, uses_control = None if self.convex else axes, any(axis >= n for axis in axes)
        return CostTerm(source, self._data, nonconvex_in=curved, uses_control=uses_control, functions=functions)


def _knots(at: npt.ArrayLike) -> tuple[int, ...]:
    """The indices of knots. Raises InputError unless they are whole numbers in order, from 0 on."""
    want = f"{' or '.join(map(repr, STEPS))}, or whole numbers in order, the indices of knots"
    knots = numbers_of("SymbolicConstraint: at", at, want)
    if knots.ndim != 1 or not knots.size or (knots != np.floor(knots)).any() or (np.diff(knots, prepend=-1) <= 0).any():
        raise InputError(f"SymbolicConstraint: at: got {excerpt(at)}, want {want}")
    return tuple(knots.astype(int).tolist())


# The kernel. `data` has the number of knots, the knots, and for each its COUNT numbers.
COUNT = 0


def value(x, u, t, row, data):
    """The constraint; infinite at other knots."""
    numbers = stack(COUNT + 1)
    return constraint_value(x, u, t, row, numbers) if read_numbers(t, data, numbers) else inf


def slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    numbers = stack(COUNT + 1)
    if read_numbers(t, data, numbers):
        constraint_slope(x, u, t, row, numbers, gradient)


def read_numbers(t, data, numbers):
    """Write the numbers of a knot; return whether it has some."""
    knots = int(data[0])
    for k in range(knots):
        if int(data[1 + k]) == t:
            for i in range(COUNT):
                numbers[i] = data[1 + knots + k * COUNT + i]
            return True
    return False
