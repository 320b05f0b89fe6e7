"""Kernels compiled by themselves, without the cache, to compare them with plain Python."""

from typing import Any

from lqrsim.codegen.compiled_module import Call, Entry, Loaded, object_code
from lqrsim.codegen.language import type_of
from lqrsim.codegen.printer import Program
from lqrsim.codegen.sources import Scope, ScopedFunction, text_source


class Compiled:
    """A function compiled for arguments of these types."""

    def __init__(self, function: ScopedFunction, *arguments: Any) -> None:
        program = Program()
        types = tuple(map(type_of, arguments))
        self.returns = program.entry(function, types, "entry")
        self._loaded = Loaded(object_code(program.text))
        self._entry = Entry(types, self._loaded.address("entry"), self.returns)

    def __call__(self, *arguments: Any) -> Any:
        return Call(self._entry, arguments)()


def compiled(text: str, name: str, *arguments: Any, **sizes: int) -> Compiled:
    """Compile a function of a source text."""
    return Compiled(Scope(text_source(text), sizes).function(name), *arguments)


def run(text: str, name: str, *arguments: Any, **sizes: int) -> Any:
    """Compile and call a function; its result."""
    return compiled(text, name, *arguments, **sizes)(*arguments)
