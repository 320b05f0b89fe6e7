"""The Hessian of a weighted sum of formulas, by one sweep backwards through their operations: edge pushing.

The formulas are taken apart into operations, equal ones into one. The sum depends on the last operations of the
formulas. The sweep replaces an operation v = f(a, b, ...), the last first, by its arguments, until the sum depends on
the variables. Each time its gradient g and Hessian H change by the chain rule:

    g[a] += g[v] f_a
    H[a, b] += g[v] f_ab + H[v, v] f_a f_b
    H[a, p] += H[v, p] f_a                              for all other p

So what formulas share is differentiated once, and the effort grows with the number of operations. Written out, a
formula and its derivatives can be a hundred times as long.

R. M. Gower and M. P. Mello, A new framework for the computation of Hessians, Optimization Methods and Software 27(2),
2012.
"""

import itertools
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from lqrsim.codegen.symbolic import own_functions, without_kinks


class Operations:
    """Operations on symbols and numbers, each once: `steps` (symbol, operation), as they can be done one by one."""

    def __init__(self) -> None:
        self.steps: list[tuple[Any, Any]] = []
        self._names: dict[Any, Any] = {}

    def of(self, formulas: Sequence[Any]) -> list[Any]:
        """The names of formulas: symbols, negative symbols or numbers. Common subexpressions become one.

        Formulas are real SymPy expressions, without kinks as SymPy writes them; see `without_kinks`.
        """
        import sympy

        shared, reduced = sympy.cse(formulas, symbols=sympy.numbered_symbols("c", real=True))
        for symbol, expression in shared:
            self._names[symbol] = self.name(expression)
        return [self.name(expression) for expression in reduced]

    def name(self, expression: Any) -> Any:
        """The name of an expression, after a step for each operation in it; a condition is no step."""
        import sympy

        if isinstance(expression, int):  # an empty sum
            return sympy.Integer(expression)
        if expression in self._names:
            return self._names[expression]
        if not expression.args:
            return expression
        operation = expression.func(*[self.name(part) for part in expression.args])
        symbol = self.step(operation) if isinstance(operation, sympy.Expr) else operation
        self._names[expression] = symbol
        return symbol

    def step(self, operation: Any) -> Any:
        """The name of one operation, or of a sum or product of names as a whole."""
        import sympy

        if not operation.args or (-operation).is_Symbol:
            return operation
        if operation not in self._names:
            self._names[operation] = sympy.Symbol(f"s{len(self.steps)}", real=True)
            self.steps.append((self._names[operation], operation))
        return self._names[operation]


class WeightedSum:
    """A weighted sum as a function of some symbols: its gradient and Hessian, whose entries are lists of terms.

    Args:
      operations: where steps are added. order: the symbols that depend on the variables, and their places.
    """

    def __init__(self, operations: Operations, order: dict[Any, int]) -> None:
        self._operations, self._order = operations, order
        self._gradient: dict[Any, list[Any]] = defaultdict(list)
        self._hessian: dict[Any, dict[Any, list[Any]]] = defaultdict(lambda: defaultdict(list))
        # Terms whose sum is positive where the sum depends on a symbol. It does not where the symbol is only in other
        # cases of a choice; its derivatives there may be infinite, and a product with zero would be NaN.
        self._uses: dict[Any, list[Any]] = defaultdict(list)

    def begin(self, result: Any, weight: Any) -> None:
        """Add a formula, given its name."""
        for symbol in result.free_symbols & self._order.keys():  # at most one
            self._gradient[symbol].append(weight * result.diff(symbol))
            self._uses[symbol].append(1)

    def replace(self, symbol: Any, operation: Any) -> None:
        """Replace a symbol by the operation that it names."""
        if symbol not in self._uses:
            return
        choice = own_functions().choice
        weight, uses = self._named(self._gradient.pop(symbol)), self._uses.pop(symbol)
        row = {other: self._named(terms) for other, terms in self._hessian.pop(symbol, {}).items()}
        curved = row.pop(symbol, 0)
        for other in row:
            del self._hessian[other][symbol]
        used = 1 if 1 in uses else self._named(uses)

        def slope_where_used(slope: Any) -> Any:
            if used != 1 and not slope.is_number:
                slope = choice(used > 0, slope, 0)
            return self._operations.name(slope)

        inputs = sorted(operation.free_symbols & self._order.keys(), key=self._order.__getitem__)
        slopes = {a: slope for a in inputs if (slope := without_kinks(operation.diff(a))) != 0}
        names = {a: slope_where_used(slope) for a, slope in slopes.items()}
        for i, a in enumerate(slopes):
            share = 1
            if isinstance(operation, choice):
                condition, *cases = operation.args
                share = self._operations.name(choice(condition, *[int(case.has(a)) for case in cases]))
            self._uses[a].append(self._named([used * share]))
            self._gradient[a].append(weight * names[a])
            for b in list(slopes)[i:]:
                self._add(a, b, weight * slope_where_used(slopes[a].diff(b)) + curved * names[a] * names[b])
            for other, value in row.items():
                self._add(a, other, (2 if other == a else 1) * value * names[a])

    def second(self, a: Any, b: Any) -> Any:
        """The name of the second derivative by two symbols."""
        return self._named(self._hessian[a].get(b, ()))

    def _add(self, a: Any, b: Any, term: Any) -> None:
        if term != 0:
            self._hessian[a][b].append(term)
            if a != b:
                self._hessian[b][a].append(term)

    def _named(self, terms: Sequence[Any]) -> Any:
        import sympy

        return self._operations.step(sympy.Add(*terms))


def hessian_of(
    operations: Operations, results: Sequence[Any], weights: Sequence[Any], variables: Sequence[Any], *, most: int
) -> tuple[list[tuple[Any, Any]], dict[tuple[int, int], Any]] | None:
    """The second derivatives of `sum_i weights[i] results[i]`; steps are added to the operations.

    `results` are names of formulas, as `operations.of` returns them, and `weights` are symbols that are in none.

    Returns:
      Steps (symbol, operation), in order, and in terms of these the second derivatives by variables i <= j that are not
      always zero, as (i, j) -> expression. None if there would be more than `most` steps.
    """
    order = {symbol: i for i, symbol in enumerate(variables)}
    forward = []
    for symbol, operation in operations.steps:
        if not operation.free_symbols.isdisjoint(order):
            order[symbol] = len(order)
            forward.append((symbol, operation))
    total = WeightedSum(operations, order)
    for result, weight in zip(results, weights, strict=True):
        total.begin(result, weight)
    for symbol, operation in reversed(forward):
        total.replace(symbol, operation)
        if len(operations.steps) > most:
            return None
    pairs = itertools.combinations_with_replacement(enumerate(variables), 2)
    curves = {(i, j): total.second(a, b) for (i, a), (j, b) in pairs}
    return operations.steps, {pair: curve for pair, curve in curves.items() if curve != 0}


def _cases_of(operation: Any) -> tuple[Any, ...]:
    """The condition of an operation that chooses, and what it chooses from if it holds and if not; else None alone."""
    import sympy

    own = own_functions()
    if isinstance(operation, own.choice):
        return operation.args
    if isinstance(operation, own.max | own.min):
        one, other = operation.args
        relation = sympy.Gt if isinstance(operation, own.max) else sympy.Lt
        return relation(other, one, evaluate=False), other, one
    return (None,)


def jacobian_of(operations: Operations, results: Sequence[Any], variables: Sequence[Any]) -> dict[tuple[int, int], Any]:
    """The first derivatives of formulas that are operations, by one sweep forward; steps are added to the operations.

    They are by (row, variable), where they are not always zero. Those of a choice are of the case that applies alone:
    in others they may be infinite, and a product with zero would be NaN.
    """
    import sympy

    slopes: dict[Any, dict[int, Any]] = {symbol: {j: sympy.Integer(1)} for j, symbol in enumerate(variables)}
    for symbol, operation in list(operations.steps):
        terms: dict[int, list[Any]] = defaultdict(list)
        condition, *cases = _cases_of(operation)
        if cases:
            # A case is a symbol or a number: at most one each.
            used = [(k, a) for k, case in enumerate(cases) for a in case.free_symbols & slopes.keys()]
            for j in sorted({j for _, a in used for j in slopes[a]}):
                parts = [sympy.Integer(0)] * 2
                for k, a in used:
                    parts[k] = operations.name(cases[k].diff(a) * slopes[a].get(j, 0))
                terms[j].append(own_functions().choice(condition, *parts))
        else:
            for a in sorted(operation.free_symbols & slopes.keys(), key=str):
                slope = operations.name(without_kinks(operation.diff(a)))
                for j, inner in slopes[a].items():
                    terms[j].append(slope * inner)
        derivatives = {j: operations.name(sympy.Add(*parts)) for j, parts in terms.items()}
        if derivatives:
            slopes[symbol] = {j: slope for j, slope in derivatives.items() if slope != 0}
    return {
        (i, j): slope * result.diff(symbol)
        for i, result in enumerate(results)
        for symbol in result.free_symbols & slopes.keys()  # at most one, perhaps negative
        for j, slope in slopes[symbol].items()
    }
