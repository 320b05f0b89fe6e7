"""Trace Python functions with symbols, and write the source to compile. SymPy is imported only when needed."""

import contextlib
import functools
import json
import keyword
import threading
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from lqrsim.codegen import disk_cache
from lqrsim.codegen.fingerprint import fingerprint
from lqrsim.errors import InputError, check_kind, check_name, check_number, excerpt
from lqrsim.rotations import RATIOS

MOST = 1000  # largest number of parameters of a function
_TRACING = threading.RLock()  # what a trace changes in SymPy


class Parameters(SimpleNamespace):
    """The `p` of `f(x, u, p)`, with an attribute for each parameter; errors for unknown names list the valid names."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        check_name("parameter", name, vars(self))


class Vector(tuple[Any, ...]):
    """The `x` or `u` of `f(x, u, p)`: symbols by index, `x[1]`, or by name, `x.speed`."""

    names: tuple[str, ...]

    def __new__(cls, symbols: Iterable[Any], names: Sequence[str]) -> "Vector":
        vector = super().__new__(cls, symbols)
        vector.names = tuple(unicodedata.normalize("NFKC", name) for name in names)  # as Python does in x.µ
        return vector

    def __getattribute__(self, name: str) -> Any:  # names come first: a state may be called `count`
        names = super().__getattribute__("__dict__").get("names", ())
        return self[names.index(name)] if name in names else super().__getattribute__(name)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        check_name("name", name, self.names)

    def __getitem__(self, place: Any) -> Any:
        entries = super().__getitem__(place)
        return Vector(entries, self.__dict__["names"][place]) if isinstance(place, slice) else entries


def check_parameters(parameters: Mapping[str, float] | None) -> dict[str, float]:
    """The parameters as floats. Raises InputError unless each is finite and its name can be written `p.name`."""
    if parameters is None:
        return {}
    check_kind("parameters", parameters, Mapping, "a dictionary of name: value")
    if len(parameters) > MOST:
        raise InputError(f"parameters: got {len(parameters)}, want at most {MOST}")
    normal: dict[str, float] = {}
    for name, value in parameters.items():
        if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name) or name.startswith("_"):
            want = "a Python name without a leading underscore, for p.name"
            raise InputError(f"parameters: got the name {excerpt(name)}, want {want}")
        if (same := unicodedata.normalize("NFKC", name)) in normal:  # Python normalises the name in p.µ
            raise InputError(f"parameters: got two names that are p.{same} in Python, want different ones")
        normal[same] = check_number(f"parameters: {same}", value)
    return normal


def kept(
    function: Callable[..., Any], details: object, make: Callable[[], dict[str, Any]], **kinds: type
) -> dict[str, Any]:
    """The result of `make`, JSON values by name of these kinds, if possible from the cache, without importing SymPy.

    `details` are all that it depends on beside the user's function. A function without a fingerprint is not cached.
    """
    print_of_it = fingerprint(function)
    if print_of_it is None:
        return make()
    key = disk_cache.key("derivatives", _writers(), print_of_it, repr(details))
    values = disk_cache.made_of(disk_cache.load(key), lambda stored, _: json.loads(stored))
    if isinstance(values, dict) and all(isinstance(values.get(name), kind) for name, kind in kinds.items()):
        return values
    values = make()
    name = getattr(function, "__qualname__", repr(function))
    disk_cache.save(key, json.dumps(values).encode(), f"derivatives of {name}(x, u, p)")
    return values


@functools.cache
def _writers() -> str:
    """The source of the modules that write the cached files, because these depend on it."""
    package = Path(__file__).parents[1]
    names = (
        "codegen/edge_pushing", "codegen/symbolic", "control/plan_model", "problem/belief",
        "problem/collision_shape", "problem/dynamics", "problem/formulas", "problem/noise",
    )  # fmt: skip
    return "".join((package / f"{name}.py").read_text(encoding="utf-8") for name in names)


def weights(count: int) -> list[Any]:
    """The symbols w0, w1, ... of a weighted sum."""
    import sympy

    return [sympy.Symbol(f"w{i}", real=True) for i in range(count)]


def trace(
    function: Callable[..., Any], states: Sequence[str], controls: Sequence[str] | None, parameters: Sequence[str], *,
    constants: Mapping[str, float] | None = None,
) -> tuple[list[Any], list[Any], list[Any]]:  # fmt: skip
    """The expressions that `function(x, u, p)` returns for symbols, the symbols of x, and those of u.

    Args:
      states, controls, parameters: names; without controls, of a `function(x, p)`.
      constants: further attributes of p, with numbers in place of symbols.
    """
    import sympy

    x = [sympy.Symbol(f"x{i}", real=True) for i in range(len(states))]
    u = [sympy.Symbol(f"u{i}", real=True) for i in range(len(controls or ()))]
    p = Parameters(**{name: sympy.Symbol(f"p{i}", real=True) for i, name in enumerate(parameters)})
    for constant, value in (constants or {}).items():  # Integers, so that x + 0 and 1 * x simplify to x
        setattr(p, constant, sympy.Integer(int(value)) if float(value).is_integer() else sympy.Float(value))
    arguments = (Vector(x, states), p) if controls is None else (Vector(x, states), Vector(u, controls), p)
    of, counted = ("x", "") if controls is None else ("x, u", f" and {len(u)} in u")
    called = f"{getattr(function, '__qualname__', repr(function))}({of}, p)"
    try:
        with _unsorted_extremes():
            returned = function(*arguments)
    except InputError as error:
        raise InputError(f"{called}: {error}") from None
    except Exception as error:  # any exception of a user's function becomes one line
        got = f"{type(error).__name__} ({error}) when called with symbols, {len(x)} in x{counted}"
        want = (
            "plain arithmetic and functions of SymPy (from sympy import sin, Max, ...); for NumPy's functions and for"
            " branches there is level='compiled' or 'plain', for JAX's level='jax'"
        )
        raise InputError(f"{called}: got {got}, want {want}") from None
    if returned is None:
        raise InputError(f"{called}: got None, want expressions: is a return missing?")
    expressions = []
    for i, entry in enumerate(entries_of(returned)):
        expression = None
        with contextlib.suppress(sympy.SympifyError):
            expression = sympy.sympify(entry, strict=True)
        if not isinstance(expression, sympy.Expr):
            raise InputError(f"{called}: got {excerpt(entry)} as entry {i}, want an expression")
        known = {*x, *u, *vars(p).values()}
        strange = sorted(str(symbol) for symbol in expression.free_symbols - known)
        if strange:
            raise InputError(f"{called}: got the unknown symbol {strange[0]} in entry {i}, want {of} and p only")
        if expression.has(sympy.zoo, sympy.nan, sympy.oo, -sympy.oo, sympy.I):
            raise InputError(f"{called}: got {expression} as entry {i}, want a finite real expression")
        if expression.has(sympy.Sum, sympy.Product, sympy.Integral, sympy.Derivative):
            expression = expression.doit()
        for piecewise in expression.atoms(sympy.Piecewise):
            if piecewise.args[-1][1] != sympy.true:  # pyright: ignore[reportIndexIssue]
                raise InputError(f"{called}: got {piecewise} in entry {i}, want its last case to be (expression, True)")
        expressions.append(without_kinks(expression))
    return expressions, x, u


def entries_of(returned: Any) -> list[Any]:
    """The entries of what a function returned: of a list, or row by row; of a single expression, itself."""
    if not hasattr(returned, "tolist"):
        return list(returned) if isinstance(returned, (list, tuple)) else [returned]
    listed = returned.tolist()  # of a NumPy array, which may be a single number, or of a SymPy matrix
    rows = listed if isinstance(listed, list) else [listed]
    return [entry for row in rows for entry in (row if isinstance(row, list) else [row])]


@contextlib.contextmanager
def _unsorted_extremes() -> Iterator[None]:
    """A context in which `Max` and `Min` keep their arguments: SymPy compares all pairs, for seconds."""
    from sympy.functions.elementary.miscellaneous import MinMaxBase

    def keep(cls: Any, *arguments: Any, **options: Any) -> Any:
        if any(getattr(argument, "free_symbols", ()) for argument in arguments):
            options = {"evaluate": False} | options
            arguments = tuple(argument for argument in arguments if argument != cls.identity)
        return original(cls, *arguments, **options)

    with _TRACING:
        original = MinMaxBase.__new__
        MinMaxBase.__new__ = keep
        try:
            yield
        finally:
            MinMaxBase.__new__ = original


@functools.cache
def own_functions() -> SimpleNamespace:
    """Functions with kinks and jumps, whose derivatives are those beside them: of the case that applies.

    Those of SymPy's functions have distributions, and conditions that SymPy simplifies, for minutes if there are many.
    `choice(condition, one, other)` is one where the condition is true, and else the other.
    """
    import sympy

    class choice(sympy.Function):
        is_commutative = True  # a condition says nothing of it

        @classmethod
        def eval(cls, *args: Any) -> Any:
            condition, chosen, otherwise = args
            if condition in (True, False):
                return chosen if condition else otherwise
            return chosen if chosen == otherwise else None

        def _eval_derivative(self: Any, s: Any) -> Any:
            condition, chosen, otherwise = self.args
            return choice(condition, chosen.diff(s), otherwise.diff(s))

    class max(sympy.Function):
        def _eval_derivative(self: Any, s: Any) -> Any:
            a, b = self.args
            return choice(sympy.Gt(b, a, evaluate=False), b.diff(s), a.diff(s))

    class min(sympy.Function):
        def _eval_derivative(self: Any, s: Any) -> Any:
            a, b = self.args
            return choice(sympy.Lt(b, a, evaluate=False), b.diff(s), a.diff(s))

    class abs(sympy.Function):
        def fdiff(self, argindex: int = 1) -> Any:
            return step(self.args[0], 0, -1)

    class floor(sympy.Function):
        def fdiff(self, argindex: int = 1) -> Any:
            return sympy.Integer(0)

    def step(a: Any, at_zero: Any, below: Any = 0) -> Any:
        return choice(sympy.Gt(a, 0, evaluate=False), 1, choice(sympy.Lt(a, 0, evaluate=False), below, at_zero))

    return SimpleNamespace(choice=choice, max=max, min=min, abs=abs, floor=floor, step=step)


@functools.cache
def _rules() -> dict[Any, Callable[..., Any]]:
    """What takes the place of SymPy's functions with kinks and jumps."""
    import sympy

    own = own_functions()

    def first_that_applies(*cases: Any) -> Any:
        return functools.reduce(lambda other, case: own.choice(case[1], case[0], other), cases[-2::-1], cases[-1][0])

    return {
        sympy.Max: lambda *entries: functools.reduce(own.max, entries),
        sympy.Min: lambda *entries: functools.reduce(own.min, entries),
        sympy.Abs: own.abs,
        sympy.sign: lambda a: own.step(a, 0, -1),
        sympy.Heaviside: own.step,
        sympy.DiracDelta: lambda *arguments: sympy.Integer(0),
        sympy.Piecewise: first_that_applies,
        sympy.Mod: lambda a, b: a - b * own.floor(a / b),
        sympy.frac: lambda a: a - own.floor(a),
        sympy.ceiling: lambda a: -own.floor(-a),
        sympy.floor: own.floor,
    }


def without_kinks(expression: Any) -> Any:
    """The expression with `own_functions` in the place of SymPy's with kinks and jumps."""
    rules, rewritten = _rules(), {}
    if not expression.has(*rules):
        return expression

    def remade(part: Any) -> Any:
        if part not in rewritten:
            parts = [remade(argument) for argument in part.args]
            rebuild = rules.get(part.func) or (part.func if parts != list(part.args) else lambda *_: part)
            rewritten[part] = rebuild(*parts)
        return rewritten[part]

    return remade(expression)


def write_function(
    name: str, arguments: str, data: str, assignments: Mapping[str, Any], *, of: str, returns: str | None = None,
    steps: Sequence[tuple[Any, Any]] | None = None,
) -> str:  # fmt: skip
    """Source of a function that evaluates SymPy expressions.

    Args:
      data: the argument with the parameters p0, p1, ....
      assignments: target (`out[0]`, `hessian[1, 2]`, ...; `+=` if it ends in `+`) -> expression.
      of: the name of the user's function in messages.
      returns: the target, among `assignments`, whose value is returned.
      steps: (symbol, expression), in order, which the expressions share; by default their common subexpressions.
    """
    import sympy
    from sympy.printing.codeprinter import PrintMethodNotImplementedError
    from sympy.printing.pycode import PythonCodePrinter

    class Printer(PythonCodePrinter):
        def _print_Function(self, expr: Any) -> str:
            head = expr.func.__name__
            if head.partition("_d")[0] in RATIOS or expr.func in vars(own_functions()).values():
                return f"{head}({', '.join(map(self._print, expr.args))})"
            return super()._print_Function(expr)  # pyright: ignore[reportAttributeAccessIssue]

        def _print_choice(self, expr: Any) -> str:
            condition, chosen, otherwise = map(self._print, expr.args)
            return f"({chosen} if {condition} else {otherwise})"

        def _print_Pow(self, expr: Any, rational: bool = False) -> str:
            base, exponent = expr.args
            if exponent.is_Integer and 2 <= abs(int(exponent)) <= 4:
                # Products are several times faster than pow.
                product = "*".join([self.parenthesize(base, 60)] * abs(int(exponent)))
                return f"({product})" if exponent > 0 else f"(1/({product}))"
            return super()._print_Pow(expr, rational=rational)

    values = [without_kinks(value) for value in assignments.values()]
    printer = Printer({"fully_qualified_modules": False})
    if steps is None:
        steps, values = sympy.cse(values, symbols=sympy.numbered_symbols("s"))
    used = set().union(*(e.free_symbols for e in [*values, *(value for _, value in steps)]))
    lines = [f"def {name}({arguments}):"]
    for letter, index in sorted((str(s)[0], int(str(s)[1:])) for s in used if str(s)[0] in "xupw"):
        lines.append(f"    {letter}{index} = {data if letter == 'p' else letter}[{index}]")
    try:
        lines += [f"    {symbol} = {printer.doprint(value)}" for symbol, value in steps]
        for target, value in zip(assignments, values, strict=True):
            sign = "+=" if target.endswith("+") else "="
            lines.append(f"    {target.rstrip('+')} {sign} {printer.doprint(value)}")
    except (PrintMethodNotImplementedError, ValueError, RecursionError) as error:
        why = " ".join(str(error).partition("Set the printer option")[0].rpartition("'>: ")[2].split())
        raise InputError(f"{of}: got a formula that cannot be compiled ({why}), want elementary functions") from None
    if returns is not None:
        lines.append(f"    return {returns}")
    return "\n".join(lines) + "\n"


def write_chain(states: int, slopes: Iterable[str]) -> str:
    """Source of `chain` of `kernels/runge_kutta.py` for a Jacobian with these nonzero entries, `fx[0, 3]`, `fu[1, 0]`.

    Known zeros make an iteration faster than zeros that are found at run time.
    """
    entries = [(target[:2], *map(int, target[3:-1].split(", "))) for target in slopes]
    inner = [(i, k) for matrix, i, k in entries if matrix == "fx"]
    lines = ["def chain(fx, fu, previous, a, out):"]
    lines += [f"    f{i}_{k} = a * fx[{i}, {k}]" for i, k in inner]
    lines.append("    for j in range(W):")
    for i in range(states):
        total = " + ".join(f"f{row}_{k} * previous[{k}, j]" for row, k in inner if row == i)
        lines.append(f"        out[{i}, j] = {total or '0.0'}")
    for matrix, i, k in entries:
        lines.append(f"    out[{i}, {k if matrix == 'fx' else states + k}] += {matrix}[{i}, {k}]")
    return "\n".join(lines) + "\n"
