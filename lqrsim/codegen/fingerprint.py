"""A hash of a function's code, without running it: the cache key of everything derived from the function.

It covers the function's code, constants, defaults and closure, numba's options, and the functions, numbers and strings
that it refers to, recursively. NumPy, SymPy, numba and JAX count by their versions. A function that refers to anything
else (an object that may change, a module of the user's own, a file) has no fingerprint, and nothing derived from it is
cached.
"""

import contextlib
import dataclasses
import dis
import functools
import importlib.metadata
import inspect
import sys
import types
import weakref
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from lqrsim import outlines, rotations
from lqrsim.codegen import disk_cache
from lqrsim.kernels import rotation_ratios

# Modules that formulas may use; the hash includes their versions instead of their code.
_PACKAGES = ("jax", "math", "numba", "numpy", "sympy")
_MODULES = ("lqrsim", "lqrsim.rotations")
# Names that read files, other names or random numbers: a function that uses them has no hash. `getattr` is allowed,
# because everything that it can reach is covered, except through names like `__globals__`.
_REFUSED = {
    "open", "input", "eval", "exec", "compile", "globals", "locals", "vars", "setattr", "__import__",
    "random", "load", "loadtxt", "genfromtxt", "fromfile", "memmap", "frompyfunc", "vectorize",
}  # fmt: skip
_UNCOVERED = {"__globals__", "__dict__", "__builtins__", "__closure__", "__code__", "__subclasses__", "__class__"}
_PLAIN = (int, float, complex, str, bytes, bool, type(None), type(Ellipsis))


class _NoFingerprint(Exception):
    pass


def fingerprint(function: Any) -> str | None:
    """The hash, the same in every process; None if something cannot be covered."""
    try:
        return disk_cache.key(*_versions(), *_function(function, {}))
    except (_NoFingerprint, RecursionError):
        return None


def identity(function: Any) -> str:
    """A hash of what can be told of any callable, the same in every process.

    It covers what `fingerprint` covers where that is possible. Of other parts it covers the name, and the bytecode,
    arguments, closure and globals of functions, the fields of dataclasses, and digests. Two callables that differ only
    in something else, such as a file that they read, have the same identity.
    """
    return fingerprint(function) or disk_cache.key(*_versions(), *_described(function))


def _described(value: Any) -> Iterator[str]:
    """The parts of any value, as far as they can be told. A package's functions may lead a thousand deep."""
    left, seen = [("", value)], set[int]()
    while left:
        name, value = left.pop()
        yield from [name] if name else []
        try:
            yield from list(_value(value, {}))
        except (_NoFingerprint, RecursionError):
            yield f"{type(value).__qualname__} {getattr(value, '__module__', '')} {getattr(value, '__qualname__', '')}"
            left += reversed([] if id(value) in seen else [*_parts(value)])
            seen.add(id(value))


def _parts(value: Any) -> Iterator[tuple[str, Any]]:
    """The parts, by name, of a value that cannot be covered as a whole; of Python's and lqrsim's functions none."""
    value = getattr(value, "py_func", value)
    home = str(getattr(value, "__module__", "")).split(".")[0]
    if isinstance(value, types.FunctionType) and (home == "lqrsim" or home in sys.stdlib_module_names):
        return
    if isinstance(digest := getattr(value, "digest", None), str):
        yield "digest", digest
    elif isinstance(value, functools.partial):
        yield from (("func", value.func), ("args", value.args), ("keywords", value.keywords))
    elif isinstance(value, types.MethodType):
        yield from (("function", value.__func__), ("self", value.__self__))
    elif isinstance(value, types.FunctionType):
        code = value.__code__
        yield from (("code", code.co_code), ("names", code.co_names), ("defaults", value.__defaults__))
        yield from (("constant", constant) for constant in code.co_consts if not isinstance(constant, types.CodeType))
        yield from sorted((value.__kwdefaults__ or {}).items())
        for name, cell in zip(code.co_freevars, value.__closure__ or (), strict=True):
            with contextlib.suppress(ValueError):  # not yet assigned
                yield name, cell.cell_contents
        yield from ((name, value.__globals__[name]) for name in code.co_names if name in value.__globals__)
    elif isinstance(value, Mapping):
        yield from ((f"key {key}" if isinstance(key, str) else "key", entry) for key, entry in value.items())
    elif isinstance(value, list | tuple):
        yield from (("item", entry) for entry in value)
    elif not isinstance(value, type | types.ModuleType):
        if dataclasses.is_dataclass(value):
            yield from ((field.name, getattr(value, field.name, None)) for field in dataclasses.fields(value))
        if callable(value):
            yield "call", type(value).__call__


@functools.cache
def _versions() -> tuple[str, ...]:
    installed = list[str]()
    for name in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):  # no function refers to it then
            installed.append(f"{name} {importlib.metadata.version(name)}")
    return sys.version, *installed, *map(inspect.getsource, (outlines, rotations, rotation_ratios))


def _helpers(function: Any) -> list[Any]:
    """The numba functions that a function with a fingerprint refers to, directly or not."""
    seen: dict[int, Any] = {}
    for _ in _function(function, seen):
        pass
    return [helper for helper in seen.values() if helper is not function and hasattr(helper, "py_func")]


_seen_fresh: weakref.WeakKeyDictionary[Any, str | None] = weakref.WeakKeyDictionary()


def note_helpers(function: Any) -> None:
    """Remember which helpers are not yet compiled: numba will compile them with their present globals."""
    if fingerprint(function) is not None:
        fresh = (helper for helper in _helpers(function) if not helper.overloads)
        _seen_fresh.update((helper, fingerprint(helper)) for helper in fresh)


def stale(function: Any) -> bool:
    """Whether a helper may have been compiled with other values of its globals, which numba freezes."""
    return any(helper.overloads and _seen_fresh.get(helper, "") != fingerprint(helper) for helper in _helpers(function))


def _function(function: Any, seen: dict[int, Any]) -> Iterator[str]:
    """The parts of a Python or numba function."""
    if id(function) in seen:  # its position distinguishes it from other functions
        yield f"seen {list(seen).index(id(function))}"
        return
    seen[id(function)] = function
    if hasattr(function, "py_func"):
        yield from _value(getattr(function, "targetoptions", {}), seen)
        yield repr(getattr(function, "locals", {}))
        function = function.py_func
    if not isinstance(function, types.FunctionType) or vars(function):
        raise _NoFingerprint
    yield from _code(function.__code__)
    yield from _value(function.__defaults__, seen)
    for name, default in sorted((function.__kwdefaults__ or {}).items()):
        yield name
        yield from _value(default, seen)
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        yield name
        try:
            contents = cell.cell_contents
        except ValueError:  # not yet assigned
            raise _NoFingerprint from None
        yield from _value(contents, seen)
    for name in sorted(_names(function.__code__)):
        if name in function.__globals__:
            yield name
            yield from _value(function.__globals__[name], seen)


def _code(code: types.CodeType) -> Iterator[str]:
    yield repr((code.co_code, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, code.co_flags))
    yield repr((code.co_argcount, code.co_kwonlyargcount, code.co_posonlyargcount, code.co_exceptiontable))
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _code(constant)
        else:
            yield from _value(constant, {})


def _names(code: types.CodeType) -> set[str]:
    """The global names that code and functions inside it read. Raises for imports without a known version."""
    texts = {constant for constant in code.co_consts if isinstance(constant, str)}
    if _REFUSED & set(code.co_names) or _UNCOVERED & (texts | set(code.co_names)):
        raise _NoFingerprint
    names = set()
    instructions = list(dis.get_instructions(code))
    for i, instruction in enumerate(instructions):
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            names.add(instruction.argval)
        elif instruction.opname in ("STORE_GLOBAL", "DELETE_GLOBAL"):
            raise _NoFingerprint
        elif instruction.opname == "IMPORT_NAME":
            absolute = instructions[i - 2].argval == 0  # the level of the import
            if not (absolute and _known(instruction.argval)):
                raise _NoFingerprint
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            names |= _names(constant)
    return names


def _known(module: str) -> bool:
    return module in _MODULES or module.split(".")[0] in _PACKAGES


def _value(value: Any, seen: dict[int, Any]) -> Iterator[str]:
    """The parts of a value that a function refers to."""
    if isinstance(value, _PLAIN):
        yield f"{type(value).__name__} {value!r}"
    elif (type(value) is np.ndarray or isinstance(value, np.generic)) and not value.dtype.hasobject:
        yield repr((value.dtype.descr, value.shape, value.tobytes()))
    elif (type(value).__module__ or "").startswith("jaxlib."):  # an array: weights of a network
        yield from _value(np.asarray(value), seen)
    elif isinstance(value, tuple | list | frozenset | set):
        yield f"{type(value).__name__} {len(value)}"
        parts = ["\n".join(_value(part, seen)) for part in value]
        yield from sorted(parts) if isinstance(value, frozenset | set) else parts
    elif isinstance(value, dict):
        yield f"dict {len(value)}"
        for key, part in value.items():
            yield from _value(key, seen)
            yield from _value(part, seen)
    elif isinstance(value, slice):  # a constant of code since Python 3.14
        yield "slice"
        yield from _value((value.start, value.stop, value.step), seen)
    elif _packaged(value):
        owner = getattr(value, "__module__", None)
        yield f"{owner}.{getattr(value, '__qualname__', getattr(value, '__name__', ''))}"
    else:
        yield from _function(value, seen)


def _packaged(value: Any) -> bool:
    """Whether a module, function or class belongs to a known package or to Python."""
    if isinstance(value, types.ModuleType):
        return _known(value.__name__)
    if isinstance(value, types.BuiltinFunctionType):
        return True
    if isinstance(value, np.ufunc):
        return getattr(np, value.__name__, None) is value
    named = isinstance(value, types.FunctionType | type) or hasattr(value, "py_func")
    home = getattr(value, "__module__", None) or ""
    return named and (home.split(".")[0] in _PACKAGES or (home == "builtins" and isinstance(value, type)))
