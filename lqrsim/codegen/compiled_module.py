"""Kernels as machine code, compiled by LLVM for this processor when first used, and cached on disk by content.

Functions that Python calls are *entries*: they are compiled for the types of their arguments, which they get as one
block of memory, a number or an address every 8 bytes. Functions that compiled code calls are C functions with the
signatures below, called by their addresses.
"""

import contextlib
import ctypes
import ctypes.util
import functools
import importlib
import logging
import operator
import os
import threading
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from lqrsim import kernels
from lqrsim.codegen import disk_cache as disk
from lqrsim.codegen.language import BOOL, FLOAT, INT, VECTOR, Group, Pointer, Pointers, Scalar, Type, scalars, type_of
from lqrsim.codegen.printer import Program
from lqrsim.codegen.sources import Scope, Source
from lqrsim.errors import Array
from lqrsim.kernels.model_functions import SIGNATURES
from lqrsim.machine import instruction_set

logger = logging.getLogger("lqrsim")

# Functions that were compiled in this process instead of loaded from disk.
compilations: list[str] = []
compiling = threading.RLock()
_loading = threading.Lock()

# Functions that take long to compile, for which a message is printed.
LONG = ("smoother", "ilqr")


# LLVM.


@functools.cache
def _binding() -> Any:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    # Where LLVM finds the C library's functions, those of its own intrinsics, too.
    for library in ("ucrtbase", "msvcrt") if os.name == "nt" else (ctypes.util.find_library("m") or "libm.so.6",):
        with contextlib.suppress(RuntimeError):
            llvm.load_library_permanently(library)
    return llvm


def _machine(level: int = 3) -> Any:
    llvm = _binding()
    _, name, features = instruction_set()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(
        cpu=name, features=features, opt=level, jit=True, reloc="default", codemodel="jitdefault"
    )


def object_code(text: str, level: int = 3) -> bytes:
    """Compile IR to an object file, optimized as by -O0 to -O3."""
    return _emitted(_binding().parse_assembly(text), level)


def object_code_of_one(text: str, name: str, symbol: str) -> tuple[bytes, list[str]]:
    """An object file that exports only the function `name` of the IR, as `symbol`, and the names that it needs."""
    module = _binding().parse_assembly(text)
    needed = []
    for part in (*module.functions, *module.global_variables):
        if part.is_declaration:
            needed += [] if part.name.startswith("llvm.") else [part.name]
        elif part.name == name:
            part.name = symbol
        else:
            part.linkage = "internal"
    return _emitted(module), needed


def has_symbols(names: list[str]) -> bool:
    """Whether LLVM finds functions or variables of all these names."""
    llvm = _binding()
    return all(llvm.address_of_symbol(name) for name in names)


def _emitted(module: Any, level: int = 3) -> bytes:
    llvm, machine = _binding(), _machine(level)
    module.triple, module.data_layout = llvm.get_process_triple(), str(machine.target_data)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=level)
    options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = True
    passes = llvm.create_pass_builder(machine, options)
    passes.getModulePassManager().run(module, passes)
    return machine.emit_object(module)


class Loaded:
    """An object file in memory; keep it alive as long as it is in use.

    Raises RuntimeError if the contents are no object file for this processor, or a function is not found.
    """

    def __init__(self, contents: bytes) -> None:
        llvm = _binding()
        with _loading:
            self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
            self._engine.add_object_file(llvm.ObjectFileRef.from_data(contents))
            self._engine.finalize_object()

    def address(self, symbol: str) -> int:
        """The address of a function. Raises RuntimeError if no function has this name."""
        address = self._engine.get_function_address(symbol)
        if not address:
            raise RuntimeError(f"the object file has no {symbol}")
        return address


# Modules of kernels.


class CompiledModule:
    """The functions of one source for one set of sizes.

    `module.name(...)` calls the function of that name, with numbers, C-ordered float64 arrays, tuples and records of
    these, and structured arrays. The shape of an array's blocks is part of its type; the first dimension is not, and
    indices are not checked against it. `what` is its purpose, for progress messages and `lqrsim cache`.
    """

    def __init__(self, source: Source, sizes: Mapping[str, int], what: str) -> None:
        self._source, self._sizes, self.what = source, dict(sizes), what
        self._made: dict[Any, Any] = {}  # entries and addresses
        self._last: dict[str, Entry] = {}
        self._loaded: list[Loaded] = []  # kept alive

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *arguments: self.lay_out(name, *arguments)()

    def lay_out(self, name: str, *arguments: Any) -> "Call":
        """Lay out a call of a function, to be made any number of times, by one thread at a time."""
        with contextlib.suppress(KeyError, TypeError):  # the first call, or other types, which a Call checks
            return Call(self._last[name], arguments)
        types = tuple(map(type_of, arguments))
        entry = self._last[name] = self._once((name, types), lambda: self._make_entries({name: types})[name])
        return Call(entry, arguments)

    def addresses(self, *names: str) -> tuple[float, ...]:
        """The addresses of C functions, compiled together, for compiled code to call."""

        def make() -> tuple[float, ...]:
            loaded, _ = self._load(f"{' and '.join(names[:2])} of {self.what}", {}, names)
            return tuple(float(loaded.address(name)) for name in names)

        return self._once(names, make)

    def _once(self, key: Any, make: Callable[[], Any]) -> Any:
        if key not in self._made:
            with compiling:
                if key not in self._made:
                    self._made[key] = make()
        return self._made[key]

    def prepare(self, **calls: tuple[Any, ...]) -> None:
        """Compile functions for such arguments, name -> arguments, together: what they share is compiled once."""
        types = {name: tuple(map(type_of, arguments)) for name, arguments in calls.items()}
        entries = self._once(tuple(types.items()), lambda: self._make_entries(types))
        self._last |= entries
        self._made |= {(name, types[name]): entry for name, entry in entries.items()}

    def _make_entries(self, types: dict[str, tuple[Type, ...]]) -> dict[str, "Entry"]:
        loaded, returns = self._load(f"{' and '.join(list(types)[:2])} for {self.what}", types, ())
        pairs = zip(types.items(), returns, strict=True)
        return {name: Entry(of, loaded.address(f"entry_{name}"), kinds) for (name, of), kinds in pairs}

    def _load(
        self, what: str, entries: Mapping[str, tuple[Type, ...]], exported: tuple[str, ...]
    ) -> tuple[Loaded, list[list[Scalar]]]:
        """Machine code of entries or of C functions, from disk or newly compiled, and the types that entries return."""
        sizes = repr(sorted(self._sizes.items()))
        key = disk.key(_toolchain(), repr(instruction_set()), self._source.digest, sizes, repr(entries or exported))
        if (unpacked := disk.made_of(disk.load(key), _unpacked)) is not None:
            self._loaded.append(unpacked[0])
            return unpacked
        compilations.append(what)
        # It is a warning, because scripts show warnings without setting up logging: a long silence would be worse.
        log = logger.debug if entries.keys().isdisjoint(LONG) else logger.warning
        log(f"compiling {what}, once for this size (some seconds) ...")
        program, scope = Program(), Scope(self._source, self._sizes)
        returns = [program.entry(scope.function(name), types, f"entry_{name}") for name, types in entries.items()]
        for name in exported:
            program.export(scope.function(name), _signature(name, scope.sizes).members, name)
        code = object_code(program.text)
        loaded = Loaded(code)
        self._loaded.append(loaded)
        disk.save(key, code, what, returns=[[kind.name for kind in kinds] for kinds in returns])
        return loaded, returns


_modules: dict[Any, CompiledModule] = {}


def module_of(source: Source, what: str, **sizes: int) -> CompiledModule:
    """The CompiledModule of a source and sizes, those of `kernels/declarations.py`, one per process."""
    key = source, what, *sizes.items()
    with compiling:  # a further reason: Python 3.11 cannot parse in two threads at once
        if key not in _modules:
            _modules[key] = CompiledModule(source, sizes, what)
        return _modules[key]


def _signature(name: str, sizes: Mapping[str, int]) -> Group:
    """The types of the arguments of a C function, or of the fields of a record."""
    kinds: dict[str, Type] = {"": VECTOR, "int": INT, "float": FLOAT}
    kinds |= {size: Pointer((sizes.get(size, 0),)) for size in "NW"}
    parts = [part.partition(":") for part in SIGNATURES[name].split()]
    members = tuple(kinds[kind] if kind in kinds else _signature(kind, sizes) for _, _, kind in parts)
    return Group(members, name, tuple(part for part, _, _ in parts))


class Entry:
    """A compiled function that Python calls, with the types of its arguments and of the numbers that it returns."""

    def __init__(self, types: tuple[Type, ...], address: int, returns: list[Scalar]) -> None:
        self.returns = returns
        self.run = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(address)
        self.layout = _Layout(Group(types))
        self.size = self.layout.size + len(returns)


class Call:
    """A call of an entry, with its arguments laid out once.

    `call()` repeats the call, and `call(...)` takes other arguments. Only arguments that are new objects are laid out
    again. Arrays are passed by reference.
    """

    def __init__(self, entry: Entry, arguments: tuple[Any, ...]) -> None:
        self._run, self._returns, self._layout = entry.run, entry.returns, entry.layout
        self._words = (ctypes.c_int64 * max(entry.size, 1))()
        self._floats = (ctypes.c_double * max(entry.size, 1)).from_buffer(self._words)
        self._address = ctypes.addressof(self._words)
        self._tables: dict[int, Any] = {}  # tables of the addresses of vectors, by their place
        self._arguments = arguments  # kept alive
        self._lay(self._layout, arguments, 0)

    def __call__(self, *arguments: Any) -> Any:
        if arguments:
            try:
                self._lay_changes(self._layout, arguments, self._arguments, 0)
            except Exception:  # must not leave the address of an array that is not kept alive
                self._lay(self._layout, self._arguments, 0)
                raise
            self._arguments = arguments
        self._run(self._address)
        numbers = tuple(
            self._floats[place] if kind is FLOAT else bool(self._words[place]) if kind is BOOL else self._words[place]
            for place, kind in enumerate(self._returns, start=self._layout.size)
        )
        return numbers if len(numbers) > 1 else numbers[0] if numbers else None

    def _lay_changes(self, layout: "_Layout", arguments: tuple[Any, ...], before: tuple[Any, ...], place: int) -> None:
        if len(arguments) != len(before):
            raise TypeError(f"got {len(arguments)} arguments, want {len(before)}")
        for part, argument, old in zip(layout.parts, arguments, before, strict=True):
            if argument is not old:
                if part.parts:
                    self._lay_changes(part, argument, old, place)
                elif not (part.vectors and isinstance(argument, tuple) and [*map(id, argument)] == [*map(id, old)]):
                    self._lay(part, argument, place)
            place += part.size

    def _lay(self, layout: "_Layout", argument: Any, place: int) -> None:
        """Write the words of an argument, beginning at an index."""
        kind = layout.kind
        if layout.block is not None:
            self._words[place] = _address_of(argument, layout.block, layout.dtype)
        elif isinstance(kind, Group):
            if not isinstance(argument, tuple) or len(argument) != len(layout.parts):
                raise TypeError(f"got {type(argument).__name__}, want {kind.record or 'a tuple'}")
            for part, member in zip(layout.parts, argument, strict=True):
                self._lay(part, member, place)
                place += part.size
        elif kind is FLOAT:
            self._floats[place] = argument
        elif kind is INT:
            self._words[place] = operator.index(argument)
        elif kind is BOOL:
            if not isinstance(argument, bool | np.bool_):
                raise TypeError(f"got {type(argument).__name__}, want a bool")
            self._words[place] = bool(argument)
        else:
            assert isinstance(kind, Pointers)
            table = (ctypes.c_int64 * max(len(argument), 1))(*(_address_of(array, (), _FLOAT64) for array in argument))
            self._tables[place] = table
            self._words[place] = ctypes.addressof(table)


class _Layout:
    """The layout of a type: size in words, parts; of an array, the shape of its blocks and the dtype of its entries."""

    def __init__(self, kind: Type) -> None:
        self.kind = kind
        self.parts = tuple(_Layout(member) for member in kind.members) if isinstance(kind, Group) else ()
        self.size = len(scalars(kind))
        self.block, self.dtype = kind.block if isinstance(kind, Pointer) else None, _FLOAT64
        if isinstance(kind, Pointer) and kind.fields:
            self.block, self.dtype = kind.block[:-1], np.dtype([(name, np.float64) for name in kind.fields])
        self.vectors = isinstance(kind, Pointers)


_FLOAT64 = np.dtype(np.float64)


def _address_of(array: Array, block: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    """The address of an array of blocks of that shape and of that dtype. Raises TypeError for anything else."""
    if not isinstance(array, np.ndarray):
        raise TypeError(f"got {type(array).__name__}, want an array")
    if array.dtype != dtype or not array.ndim or array.shape[1:] != block or not array.flags.c_contiguous:
        raise TypeError(f"got an array {array.shape} of {array.dtype}, want C-ordered {dtype} blocks {block}")
    try:  # four times as fast as array.ctypes.data
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):  # empty, or read-only
        return array.ctypes.data


def in_c_order(array: Array) -> Array:
    """The array, or a copy that is C-ordered float64 and writable, as compiled functions require."""
    if array.dtype == np.float64 and array.flags.carray:
        return array  # returned directly: np.require would take most of the time of a control step
    return np.require(array, np.float64, ["C", "W"])


def _unpacked(code: bytes, known: dict[str, Any]) -> tuple[Loaded, list[list[Scalar]]]:
    kinds = {kind.name: kind for kind in (FLOAT, INT, BOOL)}
    return Loaded(code), [[kinds[name] for name in names] for names in known["returns"]]


@functools.cache
def _toolchain() -> str:
    """A hash of all that machine code depends on, except the source: all kernels, and the compiler's own modules."""
    modules = (f"{__package__}.{name}" for name in ("language", "sources", "printer", "compiled_module"))
    paths = [Path(str(importlib.import_module(name).__file__)) for name in modules]
    paths += sorted(Path(str(kernels.__file__)).parent.glob("*.py"))
    texts = (path.read_bytes() for path in paths)
    return disk.key(version("llvmlite"), *texts)
