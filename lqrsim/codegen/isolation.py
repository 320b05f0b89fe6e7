"""How numba is made to compile: one function with all that it calls, apart from whatever else is loaded."""

import contextlib
import gc
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Without garbage collection, which takes its share of the time to compile."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def named(text: str, name: str, key: str) -> str:
    """A function with its key in its name: what is compiled is known by that in all that this process ever loads."""
    return text.replace(f"def {name}(", f"def {name}_{key}(", 1)


@contextlib.contextmanager
def as_one() -> Iterator[None]:
    """Optimise and make machine code of the entry alone, into which all is linked that it calls, and not of each part.

    numba does both, which takes far longer.
    """
    with apart("entry", parts=False):
        yield


@contextlib.contextmanager
def apart(name: str, *, parts: bool = True) -> Iterator[None]:
    """Whatever is compiled under a name that begins so keeps to itself the functions that it has of what it calls.

    numba gives each function a number that it counts up within a process, and lets the linker choose among functions of
    the same name. Two processes count alike: what each keeps on disk has functions of the same name that do something
    else, and where a third process loads both, one would run those of the other. For the same reason it would be up to
    the linker which of two copies runs, and the run that compiles and the one that loads could differ in the last bit.

    That is why numba's own class is replaced here, as long as something is compiled, and only where it is as expected.

    Args:
      parts: whether what is called is made machine code of, too, as numba does.
    """
    from numba.core import codegen, registry
    from numba.core.compiler_lock import global_compiler_lock

    class Library(codegen.JITCodeLibrary):
        @property
        def whole(self) -> bool:
            return self.name.startswith(f"{name}_")

        def _optimize_final_module(self) -> None:
            if parts or self.whole:
                super()._optimize_final_module()

        def _finalize_final_module(self) -> None:
            if self.whole:
                for function in self._final_module.functions:
                    # After optimising: how the functions are inlined, and so their bits, is as it was.
                    if not function.is_declaration and f"{name}_" not in function.name:
                        function.linkage = "internal"
            if parts or self.whole:
                super()._finalize_final_module()
            else:
                self._finalize_dynamic_globals()
                self._verify_declare_only_symbols()
                self._finalized = True

    target: Any = registry.cpu_target
    generator = target.target_context.codegen()
    if not hasattr(generator, "_library_class") or not hasattr(generator, "set_env"):
        yield  # another numba, arranged otherwise: slower, and not as sure
        return
    usual, set_env = generator._library_class, generator.set_env

    def set_env_if_there(name: str, env: Any) -> None:
        if generator._engine.get_global_value_address(name):  # parts have no memory of their own
            set_env(name, env)

    with global_compiler_lock:  # so that nothing else is compiled meanwhile
        generator._library_class, generator.set_env = Library, set_env_if_there
        try:
            yield
        finally:
            generator._library_class, generator.set_env = usual, set_env
