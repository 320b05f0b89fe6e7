"""Text in the numba subset to machine code, kept on disk by content.

A core is one text. Each function in it that Python calls is compiled when it is first needed, together with all that it
calls, and kept under a hash of that text and its own name, so nothing kept can be stale.
"""

import ast
import contextlib
import inspect
import logging
import platform
import re
import threading
import time
import uuid
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from lqrsim.codegen import disk_cache as disk
from lqrsim.codegen.arguments import converted, kind_of, leaves, signature_of
from lqrsim.codegen.fingerprint import fingerprint, note_helpers, stale
from lqrsim.codegen.isolation import apart, as_one, named, uncollected
from lqrsim.codegen.user_functions import UserFunction
from lqrsim.errors import Array, InputError
from lqrsim.kernels import records

logger = logging.getLogger("lqrsim")

# `contract` and the like let LLVM fuse and reorder sums, but keep NaN and infinity meaningful.
_FAST = ("contract", "reassoc", "nsz", "arcp")

# The functions that take long to compile, which is worth a message.
LONG = ("smoother", "ilqr")

# What kernels may call of `foreign.py`.
FOREIGN = ("at", "rows_at", "call", "call_alone", "call_with_two", "claim", "load", "store", "fetch_add")

# Compilations in this process; what was loaded from disk does not count.
compilations: list[str] = []
compiling = threading.RLock()


class Core:
    """The functions of one text, compiled for what they are called with.

    Calling `core.name(...)` calls the function of that name: arrays of float64, C-ordered, go in as pointers to blocks
    of constant shape, alone, in tuples of vectors or in the named tuples of `kernels/records.py`; numbers and rows with
    fields as they are. `core.entry(name, ...)` only compiles it.

    Args:
      what: what it is for, as the progress message and `lqrsim cache` say it.
    """

    def __init__(self, source: str, sizes: dict[str, int], what: str) -> None:
        tree = ast.fix_missing_locations(_Specialise(sizes).visit(ast.parse(source)))
        self._texts = {node.name: ast.unparse(node) for node in tree.body}
        self.what = what
        self._entries: dict[tuple[Any, ...], Any] = {}
        self._compilable: dict[str, Any] = {}
        self._keys: dict[str, str] = {}

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *arguments: self.entry(name, *arguments)(*arguments)

    def entry(self, name: str, *arguments: Any) -> Callable[..., Any]:
        """The compiled function for arguments like these."""
        kinds = tuple(kind_of(argument) for argument in arguments)
        found = self._entries.get((name, kinds))
        if found is None:
            with compiling:
                found = self._entries.get((name, kinds)) or self._make(name, kinds)
                self._entries[name, kinds] = found
        return found

    def _make(self, name: str, kinds: tuple[Any, ...]) -> Callable[..., Any]:
        import numba

        text = self._entry_source(name, kinds)
        key = disk.key(_machine(), self._key_of(name), text, repr(kinds))
        namespace: dict[str, Any] = {"__name__": __name__}
        exec(compile(named(text, "entry", key), "<lqrsim>", "exec"), namespace)
        dispatcher: Any = numba.njit(namespace[f"entry_{key}"], nogil=True, **_options())
        stored = disk.load(key)
        if stored is None or not _restore(dispatcher, stored):
            what = f"{name} for {self.what}"
            compilations.append(what)
            # A warning is what a script shows that has not set up logging, and a long silence is worse.
            log = logger.warning if name in LONG else logger.debug
            last = disk.noted(name)
            took = "which can take a minute" if last is None else f"which took {last:.0f} s the last time"
            log(f"compiling {what}, once for this kind of problem, {took} ...")
            clock = time.perf_counter()
            namespace.update(self._namespace())
            with uncollected(), as_one():
                dispatcher.compile(signature_of(kinds))
            if name in LONG:
                disk.note(name, time.perf_counter() - clock)
            if _lasting(dispatcher):
                _keep(key, dispatcher, what)
        dispatcher.disable_compile()
        return lambda *arguments: dispatcher(*leaves(arguments))

    def _entry_source(self, name: str, kinds: tuple[Any, ...]) -> str:
        """The function of that name under the name `entry`, which makes pointers and records of its arguments first."""
        (node,) = ast.parse(self._texts[name]).body
        assert isinstance(node, ast.FunctionDef)
        names = [f"leaf_{number}" for number in range(len(signature_of(kinds)))]
        leaf = iter(names)
        lines = [f"{one.arg} = {converted(kind, leaf)}" for one, kind in zip(node.args.args, kinds, strict=True)]
        node.args.args = [ast.arg(name) for name in names]
        node.name, node.decorator_list = "entry", []
        node.body = [*ast.parse("\n".join(lines)).body, *node.body]
        return ast.unparse(node)

    def _namespace(self) -> dict[str, Any]:
        """The functions that the entries call, each made of its text and what it calls."""
        if not self._compilable:
            self._compilable.update(_vocabulary(), **{name: self._part(name) for name in self._texts})
        return self._compilable

    def _part(self, name: str) -> Any:
        """The function of that name, made once in a process."""
        key = self._key_of(name)
        if key not in _parts:
            namespace = {**_vocabulary(), **{callee: self._part(callee) for callee in self._callees(name)}}
            exec(compile(self._texts[name], "<lqrsim core>", "exec"), namespace)
            _parts[key] = namespace[name]
        return _parts[key]

    def _key_of(self, name: str) -> str:
        """A hash of the function's text and of all that it calls: what is not called makes no other function of it."""
        if name not in self._keys:
            self._keys[name] = disk.key(self._texts[name], *map(self._key_of, self._callees(name)))
        return self._keys[name]

    def _callees(self, name: str) -> list[str]:
        names = {node.id for node in ast.walk(ast.parse(self._texts[name])) if isinstance(node, ast.Name)}
        return sorted(names & self._texts.keys() - {name})


# The functions that this process has made, under a hash of their text and of all that they call. Cores share them: the
# second problem with the same dynamics, or only with as many states and controls, takes less time to compile.
_parts: dict[str, Any] = {}


@cache
def _vocabulary() -> dict[str, Any]:
    """What a core's functions may call that is not their own."""
    import math

    import numba

    from lqrsim.codegen import foreign, pointers

    jit: Any = numba.njit
    inner = jit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_options())
    inlined = jit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **_options())
    names = {**vars(math), "__name__": __name__, "inner": inner, "inlined": inlined}
    names |= {name: record for name, record in vars(records).items() if inspect.isclass(record)}
    names |= {name: getattr(pointers, name) for name in ("stack", "pointer", "invoke", "invoke_writing")}
    return names | {name: getattr(foreign, name) for name in FOREIGN}


def in_c_order(array: Array) -> Array:
    """In C's order, and not read-only, as arrays from files are: compiled functions take no other."""
    if array.dtype == np.float64 and array.flags.carray:
        return array  # at once: in the loop it is most of what this takes
    return np.require(array, np.float64, ["C", "W"])


def address_of(function: UserFunction) -> float:
    """Where compiled code finds a user's function."""
    with compiling:
        if not function.held:
            function.held.append(_compile(function) if function.level == "compiled" else function.called_back)
    return float(function.held[0][1])


def _compile(function: UserFunction) -> tuple[Any, int]:
    """A numba function behind C's calling convention: what must be kept alive, and its address.

    Raises:
      InputError: numba cannot compile it.
    """
    import numba
    from numba import carray  # pyright: ignore[reportPrivateImportUsage]

    from lqrsim.codegen.pointers import readonly

    # Compiled anew, for numba keeps the globals of a function as they were when it was first compiled.
    plain = getattr(function.function, "py_func", function.function)
    options = getattr(function.function, "targetoptions", _options())
    try:
        own: Any = numba.njit(**{name: value for name, value in options.items() if name != "nopython"})(plain)
    except Exception as error:
        raise InputError(f"{function.name}: got code that numba cannot compile ({error}), want a function") from error
    text, names = function.adapter()
    names |= {"function": own, "carray": carray, "readonly": readonly, "nan": float("nan"), "__name__": __name__}
    print_of_it = fingerprint(function.function)
    key = disk.key(_machine(), print_of_it or uuid.uuid4().hex, text, repr(function.parameters))
    exec(compile(named(text, "adapter", key), "<lqrsim>", "exec"), names)
    dispatcher: Any = numba.njit(names[f"adapter_{key}"], **_options())
    stored = disk.load(key) if print_of_it else None
    if stored is None or not _restore(dispatcher, stored):
        what = f"{function.name}"
        compilations.append(what)
        logger.debug(f"compiling {what} ...")
        note_helpers(function.function)
        lasting = print_of_it is not None and not stale(function.function)
        pointer = numba.types.CPointer(numba.types.float64)
        try:
            with uncollected(), apart("adapter"):
                dispatcher.compile((pointer,) * (3 + (len(function.writes) or 1)))
        except Exception as error:  # mostly NumbaError, and whatever else goes wrong within numba
            raise InputError(f"{function.name}: got code that numba cannot compile, want {_reason(error)}") from error
        # The same holds of the functions it calls, which are as they were: what was made of them is not kept then.
        if print_of_it and lasting and _lasting(dispatcher):
            _keep(key, dispatcher, what)
    (result,) = dispatcher.overloads.values()
    return result, result.library.get_pointer_to_function(result.fndesc.llvm_cfunc_wrapper_name)


def _reason(error: Exception) -> str:
    """The line of numba's pages of explanation that says what is wrong."""
    if isinstance(error, AttributeError) and "NoneType" in str(error):
        return "a function that returns on every path, and does not change x and u"
    if "readonly" in str(error) and "setitem" in str(error):
        return "a function that does not change x and u, which are readonly"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    telling = [
        line for line in lines if not re.match(r"Failed in|During:|File |\^|- Resolution|<source|raised from", line)
    ]
    return f"its subset of Python ({' '.join(telling[:3])})"


class _Specialise(ast.NodeTransformer):
    """Puts the sizes in as constants and shapes as tuples; drops docstrings and annotations; decorates."""

    def __init__(self, sizes: dict[str, int]) -> None:
        self.sizes = sizes

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return ast.Constant(self.sizes[node.id]) if node.id in self.sizes else node

    def visit_Call(self, node: ast.Call) -> ast.expr:
        self.generic_visit(node)
        if isinstance(node.func, ast.Name) and node.func.id == "stack":
            shape = tuple(ast.literal_eval(argument) for argument in node.args)
            return ast.parse(f"stack({shape})", mode="eval").body
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        self.generic_visit(node)
        if ast.get_docstring(node) is not None:
            node.body = node.body[1:]
        node.returns = None
        for argument in node.args.args:
            argument.annotation = None
        node.decorator_list = [ast.Name("inlined" if node.name in _INLINED else "inner")]
        return node


def _options() -> dict[str, Any]:
    return {"fastmath": set(_FAST), "error_model": "numpy"}


# LLVM finds most of what is worth inlining, and to force all of it takes longer to compile. These are called at every
# stage of every step: the first four are small, the others parts of one function that read better apart.
_INLINED = (
    "rate",
    "rate_jacobian",
    "signed_distance",
    "signed_distance_derivatives",
    "eliminate_control",
    "control_response",
)


@cache
def _machine() -> str:
    """What compiled code depends on besides its source: the compiler, the processor, and how pointers are compiled."""
    from numba.core import registry

    from lqrsim.codegen import foreign, pointers

    target: Any = registry.cpu_target
    parts = [version("numba"), version("llvmlite"), platform.python_version(), *_FAST]
    parts.append(repr(target.target_context.codegen().magic_tuple()))
    parts.append("functions of their own")  # what was kept before could run those of others: see `isolation.py`
    texts = (Path(str(module.__file__)).read_text(encoding="utf-8") for module in (pointers, foreign, records))
    return "\n".join([*parts, *texts])


def _lasting(dispatcher: Any) -> bool:
    """Whether another process can use the machine code: not if there are addresses of this one in it."""
    (result,) = dispatcher.overloads.values()
    return not result.library.has_dynamic_globals and not result.lifted


def _keep(key: str, dispatcher: Any, what: str) -> None:
    from numba.core import serialize

    (result,) = dispatcher.overloads.values()
    with contextlib.suppress(Exception):  # what cannot be kept is made again; a Ctrl-C within LLVM can be the cause
        disk.save(key, serialize.dumps(result._reduce()), what)


def _restore(dispatcher: Any, stored: bytes) -> bool:
    """Give the dispatcher what `_keep` kept; False if that does not work out."""
    import pickle

    from numba.core.compiler import CompileResult

    try:
        dispatcher.targetctx.refresh()
        dispatcher.add_overload(CompileResult._rebuild(dispatcher.targetctx, *pickle.loads(stored)))
    except Exception as error:  # whatever is wrong with it, it can be compiled again
        logger.debug(f"a compiled function in the cache could not be used ({error})")
        return False
    return True
