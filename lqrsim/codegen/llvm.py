"""LLVM: compile IR to machine code for this processor, and load machine code into memory."""

import contextlib
import ctypes.util
import os
import threading
from functools import cache
from typing import Any

from lqrsim.machine import instruction_set

_loading = threading.Lock()


@cache
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
