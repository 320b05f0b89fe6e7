"""Kernels as machine code: compiled when they are first asked for, kept on disk by content, and called.

Functions that Python calls are *entries*: they are compiled for the types of what they are called with, and get it laid
out as one block of memory, a number or an address every 8 bytes. Functions that compiled code calls are C functions
behind the signatures below, by their addresses.
"""

import ctypes
import functools
import importlib
import json
import logging
import operator
import threading
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from lqrsim import kernels
from lqrsim.codegen import disk_cache as disk
from lqrsim.codegen.language import (
    BOOL,
    FLOAT,
    INT,
    VECTOR,
    Group,
    Pointer,
    Pointers,
    Rows,
    Scalar,
    Type,
    scalars,
    type_of,
)
from lqrsim.codegen.llvm import Loaded, object_code
from lqrsim.codegen.printer import Program
from lqrsim.codegen.sources import Scope, Source
from lqrsim.errors import Array
from lqrsim.kernels import records
from lqrsim.machine import instruction_set
from lqrsim.results.hashing import sha256

logger = logging.getLogger("lqrsim")

# Compilations in this process; what was loaded from disk does not count.
compilations: list[str] = []
compiling = threading.RLock()

# The functions that take long to compile, which is worth a message.
LONG = ("smoother", "ilqr")

# The C functions that a model brings: what each is called with, in order. A letter is the size of an array's rows:
# `W` that of a state and a control joined, `N` that of a state; "" is a vector, and a name a record, taken apart.
_SIGNATURES: dict[str, tuple[str | Scalar, ...]] = {
    "advance": ("", "", "", FLOAT, ""),  # x, u, p, h, out
    "step_jacobian": ("", "", "", FLOAT, "", "W"),  # x, u, p, h, out, jacobian
    "step_curvature": ("", "", "", FLOAT, "", "", "W", "W"),  # x, u, p, h, weights, out, jacobian, hessian
    "value": ("", "", INT, ""),  # x, u, t, data
    "derivatives": ("", "", INT, "", "W", ""),  # x, u, t, data, hessian, gradient
    "project": ("W",),  # hessian
    "augment": ("", "", INT, "", "", "W", ""),  # x, u, t, data, multipliers, hessian, gradient
    "augmentation": ("", "", INT, "", ""),  # x, u, t, data, multipliers
    "constraint_values": ("", "", INT, INT, "", "", ""),  # x, u, t, acts, data, multipliers, values
    "add_slope": ("", "", INT, INT, "", ""),  # x, u, t, row, data, gradient
    "noise_value": ("", "", "", "", "NextStep"),  # x, u, data, risk, ahead
    "noise_quadratic": ("", "", "", "", "NextStep", INT, "QuadraticStage"),  # x, u, data, risk, ahead, convex, stage
    "measure": ("", "", ""),  # x, data, out
    "measure_slope": ("", "", "N"),  # x, data, out
}
_RECORDS = {"NextStep": ("W", "", "N", ""), "QuadraticStage": ("W", "")}


class CompiledModule:
    """The functions of one source for one set of sizes.

    Calling `module.name(...)` calls the function of that name: with arrays of float64, C-ordered, also in tuples and in
    the named tuples of `kernels/records.py`; numbers and rows with fields as they are. The shape of an array's blocks
    is part of its type; its first dimension is not, and nothing looks whether an index is within it.

    Args:
      source: the functions. sizes: name -> number, of what `kernels/declarations.py` declares.
      what: what it is for, as the progress message and `lqrsim cache` say it.
    """

    def __init__(self, source: Source, sizes: Mapping[str, int], what: str) -> None:
        self._source, self._sizes, self.what = source, dict(sizes), what
        self._entries: dict[Any, Entry] = {}
        self._last: dict[str, Entry] = {}
        self._addresses: dict[tuple[str, ...], tuple[float, ...]] = {}
        self._loaded: list[Loaded] = []

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *arguments: self.lay_out(name, *arguments)()

    def lay_out(self, name: str, *arguments: Any) -> "Call":
        """A call of the function with these arguments, to be made any number of times by one thread at a time."""
        entry = self._last.get(name)
        if entry is not None:
            try:
                return Call(entry, arguments)  # which looks at the types, too
            except TypeError:
                pass
        entry = self._last[name] = self.entry(name, *arguments)
        return Call(entry, arguments)

    def entry(self, name: str, *arguments: Any) -> "Entry":
        """The compiled function for arguments like these."""
        types = tuple(map(type_of, arguments))
        found = self._entries.get((name, types))
        if found is None:
            with compiling:
                found = self._entries.get((name, types)) or self._make_entry(name, types)
                self._entries[name, types] = found
        return found

    def addresses(self, *names: str) -> tuple[float, ...]:
        """Where the C functions of these names are, compiled together; for compiled code to call."""
        found = self._addresses.get(names)
        if found is None:
            with compiling:
                found = self._addresses.get(names) or self._make_functions(names)
                self._addresses[names] = found
        return found

    def _make_entry(self, name: str, types: tuple[Type, ...]) -> "Entry":
        def write(program: Program, scope: Scope) -> Type | None:
            return program.entry(scope.function(name), types, "entry")

        loaded, returns = self._load(f"{name} for {self.what}", repr((name, types)), write, name in LONG)
        return Entry(types, loaded.address("entry"), returns)

    def _make_functions(self, names: tuple[str, ...]) -> tuple[float, ...]:
        def write(program: Program, scope: Scope) -> None:
            for name in names:
                program.export(scope.function(name), self._signature(name), name)

        loaded, _ = self._load(f"{' and '.join(names[:2])} of {self.what}", repr(names), write, False)
        return tuple(float(loaded.address(name)) for name in names)

    def _signature(self, name: str) -> tuple[Type, ...]:
        kinds: dict[str | Scalar, Type] = {"": VECTOR, INT: INT, FLOAT: FLOAT}
        kinds |= {letter: Pointer((self._sizes.get(letter, 0),)) for letter in "NW"}
        for record, parts in _RECORDS.items():
            fields = getattr(records, record)._fields
            kinds[record] = Group(tuple(kinds[part] for part in parts), record, fields)
        return tuple(kinds[one] for one in _SIGNATURES[name])

    def _load(
        self, what: str, functions: str, write: Callable[[Program, Scope], Type | None], long: bool
    ) -> tuple[Loaded, Type | None]:
        """Machine code of some of the functions, from disk or compiled now; and what the entry among them returns."""
        sizes = repr(sorted(self._sizes.items()))
        key = disk.key(_toolchain(), repr(instruction_set()), self._source.digest, sizes, functions)
        kept = disk.load(key)
        found = None if kept is None else _unpacked(kept)
        if found is None:
            found = self._compiled(what, write, long, key)
        self._loaded.append(found[0])
        return found

    def _compiled(
        self, what: str, write: Callable[[Program, Scope], Type | None], long: bool, key: str
    ) -> tuple[Loaded, Type | None]:
        compilations.append(what)
        # A warning is what a script shows that has not set up logging, and a long silence is worse.
        log, timed = logger.warning if long else logger.debug, f"{what} on {instruction_set()[1]}"
        last = disk.noted(timed)
        took = "some seconds" if last is None else f"which took {last:.0f} s the last time"
        log(f"compiling {what}, once for this size, {took} ...")
        clock = time.perf_counter()
        program = Program()
        returns = write(program, Scope(self._source, self._sizes))
        code, libraries = object_code(program.text), tuple(program.libraries)
        loaded = Loaded(code, libraries)
        if long:
            disk.note(timed, time.perf_counter() - clock)
        header = {"libraries": libraries, "returns": _encoded(returns), "code": sha256(code)}
        disk.save(key, json.dumps(header).encode() + b"\n" + code, what)
        return loaded, returns


@functools.cache
def _module_of(source: Source, sizes: tuple[tuple[str, int], ...], what: str) -> CompiledModule:
    return CompiledModule(source, dict(sizes), what)


def module_of(source: Source, what: str, **sizes: int) -> CompiledModule:
    """The module of a source and sizes, one in a process.

    Args:
      source: the functions. what: as for CompiledModule. **sizes: of what `kernels/declarations.py` declares.
    """
    with compiling:  # not only against doing it twice: Python 3.11 cannot parse in two threads at once
        return _module_of(source, tuple(sizes.items()), what)


class Entry:
    """A compiled function that Python calls, laid out as a `Call`.

    Args:
      types: of the arguments. address: of the machine code. returns: the type of what it returns.
    """

    def __init__(self, types: tuple[Type, ...], address: int, returns: Type | None) -> None:
        self.returns = returns
        self.run = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(address)
        self.layout = _Layout(Group(types))
        self.size = self.layout.size + (0 if returns is None else len(scalars(returns)))


class Call:
    """A call of an entry, its arguments laid out once.

    `call()` makes it; `call(...)` makes it with other arguments, of which only those are laid out anew that are other
    objects than before. Arrays are where they are: what is written to them counts at the next call.
    """

    def __init__(self, entry: Entry, arguments: tuple[Any, ...]) -> None:
        self._run, self._returns, self._layout = entry.run, entry.returns, entry.layout
        self._words = (ctypes.c_int64 * max(entry.size, 1))()
        self._floats = (ctypes.c_double * max(entry.size, 1)).from_buffer(self._words)
        self._address = ctypes.addressof(self._words)
        self._tables: dict[int, Any] = {}  # the addresses of the vectors in tuples, by their place
        self._arguments = arguments  # kept alive by that
        self._lay(self._layout, arguments, 0)

    def __call__(self, *arguments: Any) -> Any:
        if arguments:
            try:
                self._lay_changes(self._layout, arguments, self._arguments, 0)
            except Exception:  # so that nothing is left of what is not kept alive
                self._lay(self._layout, self._arguments, 0)
                raise
            self._arguments = arguments
        self._run(self._address)
        returns, place = self._returns, self._layout.size
        if returns is None:
            return None
        if isinstance(returns, Group):
            return tuple(self._returned(kind, place + i) for i, kind in enumerate(returns.members))
        return self._returned(returns, place)

    def _returned(self, kind: Type, place: int) -> Any:
        if kind is FLOAT:
            return self._floats[place]
        return bool(self._words[place]) if kind is BOOL else self._words[place]

    def _lay_changes(self, layout: "_Layout", arguments: tuple[Any, ...], before: tuple[Any, ...], place: int) -> None:
        if len(arguments) != len(before):
            raise TypeError(f"got {len(arguments)} arguments, want {len(before)}")
        for part, argument, old in zip(layout.parts, arguments, before, strict=True):
            if argument is not old:
                if part.parts:
                    self._lay_changes(part, argument, old, place)
                elif not (part.vectors and _same_vectors(argument, old)):
                    self._lay(part, argument, place)
            place += part.size

    def _lay(self, layout: "_Layout", argument: Any, place: int) -> None:
        """Write the words of an argument from a place on."""
        kind = layout.kind
        if layout.block is not None:
            self._words[place] = _address_of(argument, layout.block)
        elif layout.parts or isinstance(kind, Group):
            if not isinstance(argument, tuple) or len(argument) != len(layout.parts):
                raise TypeError(f"got {type(argument).__name__}, want {layout.what}")
            for part, one in zip(layout.parts, argument, strict=True):
                self._lay(part, one, place)
                place += part.size
        elif kind is FLOAT:
            self._floats[place] = argument
        elif kind is INT:
            self._words[place] = operator.index(argument)
        elif kind is BOOL:
            if not isinstance(argument, bool | np.bool_):
                raise TypeError(f"got {type(argument).__name__}, want a bool")
            self._words[place] = bool(argument)
        elif isinstance(kind, Pointers):
            table = (ctypes.c_int64 * max(len(argument), 1))(*(_address_of(array, ()) for array in argument))
            self._tables[place] = table
            self._words[place] = ctypes.addressof(table)
        else:
            assert isinstance(kind, Rows)
            if not isinstance(argument, np.ndarray) or argument.dtype != layout.row or not argument.ndim:
                raise TypeError(f"got {type(argument).__name__}, want rows of float64: {', '.join(kind.fields)}")
            if not argument.flags.c_contiguous:
                raise TypeError("got rows that are not one after the other")
            self._words[place] = argument.ctypes.data


class _Layout:
    """How many words a type takes, and its parts; of an array, the shape of its blocks; of rows, what one is."""

    def __init__(self, kind: Type) -> None:
        self.kind = kind
        self.parts = tuple(_Layout(member) for member in kind.members) if isinstance(kind, Group) else ()
        self.size = len(scalars(kind))
        self.block = kind.block if isinstance(kind, Pointer) else None
        self.vectors = isinstance(kind, Pointers)
        self.row = np.dtype([(name, np.float64) for name in kind.fields]) if isinstance(kind, Rows) else None
        self.what = (kind.record or "a tuple") if isinstance(kind, Group) else ""


def _same_vectors(one: Any, other: tuple[Array, ...]) -> bool:
    """Whether a tuple has the same arrays as another one."""
    return isinstance(one, tuple) and len(one) == len(other) and all(map(operator.is_, one, other))


_FLOAT64 = np.dtype(np.float64)


def _address_of(array: Array, block: tuple[int, ...]) -> int:
    """Where the numbers of an array of such blocks are. Raises TypeError for what is none."""
    if not isinstance(array, np.ndarray):
        raise TypeError(f"got {type(array).__name__}, want an array")
    if array.dtype != _FLOAT64 or not array.ndim or array.shape[1:] != block or not array.flags.c_contiguous:
        raise TypeError(f"got an array {array.shape} of {array.dtype}, want blocks {block} of float64 in C's order")
    try:  # in a quarter of the time that array.ctypes.data takes
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):  # nothing in it, or read-only
        return array.ctypes.data


def in_c_order(array: Array) -> Array:
    """In C's order, and not read-only, as arrays from files are: compiled functions take no other."""
    if array.dtype == np.float64 and array.flags.carray:
        return array  # at once: in the loop it is most of what this takes
    return np.require(array, np.float64, ["C", "W"])


def _encoded(returns: Type | None) -> Any:
    """The type of a result as JSON has it."""
    if returns is None:
        return None
    return [one.name for one in scalars(returns) if isinstance(one, Scalar)], isinstance(returns, Group)


def _unpacked(kept: bytes) -> tuple[Loaded, Type | None] | None:
    """What was kept, in memory; None if it cannot be used: then it is compiled again."""
    header, _, code = kept.partition(b"\n")
    try:
        known = json.loads(header)
        returns = None
        if known["returns"] is not None:
            names, several = known["returns"]
            kinds = tuple({one.name: one for one in (FLOAT, INT, BOOL)}[name] for name in names)
            returns = Group(kinds) if several else kinds[0]
        if known["code"] != sha256(code):  # LLVM ends the process over what is no object file
            raise ValueError("it has another code")
        return Loaded(code, tuple(map(str, known["libraries"]))), returns
    except (ValueError, KeyError, TypeError, RuntimeError, RecursionError) as error:
        logger.debug(f"a compiled function in the cache could not be used ({error})")
        return None


@functools.cache
def _toolchain() -> str:
    """A hash of what machine code depends on besides its source: all kernels, and what prints and compiles them."""
    own = (f"{__package__}.{name}" for name in ("language", "sources", "printer", "llvm", "compiled_module"))
    folders = [Path(str(importlib.import_module(name).__file__)) for name in own]
    folders += sorted(Path(str(kernels.__file__)).parent.glob("*.py"))
    texts = (path.read_bytes() for path in folders)
    return disk.key(version("llvmlite"), *texts)
