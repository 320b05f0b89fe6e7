"""Kernels as plain Python on NumPy arrays: for single evaluations, and as the reference for compiled code."""

import __future__

import ast
import copy
import ctypes
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from types import CodeType
from typing import Any

import numpy as np

from lqrsim.codegen.sources import PYTHON, Record, Scope, ScopedFunction, Source, Word
from lqrsim.errors import Array
from lqrsim.kernels import records

_LONG = 1 << 24  # assumed length of the memory at an address, in entries

# Called with each kernel, its Python function, and its arguments.
Caller = Callable[[ScopedFunction, Callable[..., Any], tuple[Any, ...]], Any]


def plain_functions(
    source: Source, sizes: Mapping[str, int], names: Sequence[str], functions: Sequence[Callable[..., None]] = (),
    caller: Caller | None = None,
) -> dict[str, Callable[..., Any]]:  # fmt: skip
    """Functions of a source, by name, as plain Python functions.

    Args:
      functions: Python functions that kernels call by their index here, in place of an address.
      caller: if given, it calls each kernel.
    """
    scope, plain = Scope(source, sizes), {}
    return {name: _run(scope.function(name), _words(functions), plain, caller) for name in names}


def _run(
    function: ScopedFunction, words: Mapping[str, Any], functions: dict[Any, Any], caller: Caller | None
) -> Callable[..., Any]:
    """The Python function of a kernel; `functions` holds the functions that were made earlier."""
    key = id(function.scope), function.node.name
    if key in functions:
        return functions[key]
    code, names = _compiled(function.node, function.scope.source.what)
    namespace: dict[str, Any] = {}
    exec(code, namespace)
    run = namespace[function.node.name]
    called = run if caller is None else lambda *arguments: caller(function, run, arguments)
    functions[key] = called
    for name in names:
        match function.scope.find(name):
            case None:
                continue
            case ScopedFunction() as other:
                namespace[name] = _run(other, words, functions, caller)
            case Record():
                namespace[name] = getattr(records, name)
            case Word(name=word):
                if word not in PYTHON:
                    namespace[name] = words[word]
            case constant:
                namespace[name] = constant
    return called


@functools.lru_cache(maxsize=2048)  # a kernel is the same function in many problems, and each solve evaluates its own
def _compiled(node: ast.FunctionDef, what: str) -> tuple[CodeType, frozenset[str]]:
    """Python's code that defines a kernel, and the names in it."""
    function = copy.copy(node)
    function.decorator_list = []  # names in decorators are not defined, nor those in annotations, which the flag leaves
    module = ast.Module([function], [])
    names = frozenset(name.id for name in ast.walk(module) if isinstance(name, ast.Name))
    return compile(module, f"<{what}>", "exec", __future__.annotations.compiler_flag), names


def _words(functions: Sequence[Callable[..., None]]) -> dict[str, Any]:
    """Words of the language that Python lacks.

    Functions of math are NumPy's, because functions of `math` raise exceptions where compiled code continues with NaN
    or infinity.
    """

    def call(address: float, *arguments: Any) -> None:
        if address < len(functions):
            functions[int(address)](*arguments)
        else:
            _c_call(None, address, arguments)

    def call_for_value(address: float, *arguments: Any) -> float:
        return _c_call(ctypes.c_double, address, arguments)

    words = {name: getattr(np, name, getattr(math, name)) for name in vars(math) if not name.startswith("_")}
    return words | {
        "gamma": _gamma, "lgamma": _lgamma,
        "stack": lambda *shape: np.empty(shape), "zeros": lambda *shape: np.zeros(shape),
        "call": call, "call_for_value": call_for_value,
        "at": lambda address: _memory(address, ctypes.c_double),
        "rows_at": lambda at, width: _memory(at, ctypes.c_double)[: _LONG // width * width].reshape(-1, width),
        "power_of_two": lambda exponent: np.exp2(min(max(exponent, -1022.0), 1023.0)),
        "load": lambda words, index: int(_integers(words)[index]), "store": _store, "claim": _claim,
        "fetch_add": _fetch_add, "int32": ctypes.c_int32,
    }  # fmt: skip


def _gamma(number: float) -> float:
    """As the C library's: infinite beyond all floats and at zero, of its sign, and NaN at its other poles."""
    try:
        return math.gamma(number)
    except OverflowError:
        return math.copysign(math.inf, number)
    except ValueError:
        return math.copysign(math.inf, number) if number == 0 else math.nan


def _lgamma(number: float) -> float:
    """As the C library's: infinite at poles and beyond all floats."""
    try:
        return math.lgamma(number)
    except (ValueError, OverflowError):
        return math.inf


def _in_c(argument: Any) -> list[Any]:
    """An argument as C takes it: an array by its address, a record field by field."""
    if isinstance(argument, tuple):
        return [part for member in argument for part in _in_c(member)]
    if isinstance(argument, np.ndarray):
        return [ctypes.c_void_p(argument.ctypes.data)]
    if isinstance(argument, ctypes.c_int32):
        return [argument]
    if isinstance(argument, float | np.floating):
        return [ctypes.c_double(float(argument))]
    return [ctypes.c_int64(int(argument))]


def _c_call(returns: Any, address: float, arguments: tuple[Any, ...]) -> Any:
    passed = _in_c(arguments)
    return ctypes.CFUNCTYPE(returns, *map(type, passed))(int(address))(*passed)


def _memory(address: float, kind: Any) -> Array:
    return np.frombuffer((kind * _LONG).from_address(int(address)), dtype=kind)


def _integers(words: float) -> Array:
    return _memory(words, ctypes.c_int64)


def _claim(words: float, index: int) -> int:
    flags = _integers(words)
    free = flags[index] == 0
    flags[index] = 1
    return int(free)


def _store(words: float, index: int, value: int) -> None:
    _integers(words)[index] = value


def _fetch_add(words: float, index: int, value: int) -> int:
    numbers = _integers(words)
    before = int(numbers[index])
    numbers[index] += value
    return before
