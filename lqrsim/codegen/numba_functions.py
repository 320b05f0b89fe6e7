"""A numba function as a C function, cached on disk if it has a fingerprint.

numba compiles it once, to LLVM IR. An object file of that is cached, in which everything except the function itself is
internal: numba numbers its functions within a process, so that files of two processes would have different functions of
the same name.
"""

import json
import logging
import re
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from typing import Any

from lqrsim.codegen import disk_cache as disk
from lqrsim.codegen.compiled_module import compilations
from lqrsim.codegen.fingerprint import fingerprint, note_helpers, stale
from lqrsim.codegen.llvm import Loaded, are_there, object_code_of_one
from lqrsim.errors import InputError
from lqrsim.machine import instruction_set
from lqrsim.results.hashing import sha256

logger = logging.getLogger("lqrsim")

# `contract` and the like let LLVM fuse and reorder sums, as in kernels, but keep NaN and infinity meaningful.
_OPTIONS: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz", "arcp"}, "error_model": "numpy"}
_SYMBOL = "function"

# Functions loaded in this process, by key.
_loaded: dict[str, tuple[Any, int]] = {}


def compiled(
    function: Callable[..., Any], adapter: str, names: dict[str, Any], pointers: int, what: str
) -> tuple[Any, int]:
    """Compile a function to a C function of this number of pointers to float64.

    Args:
      function: a numba function, or one that numba can compile.
      adapter: source of `adapter`, which calls it by the name `function`.
      names: others that the adapter uses, among them the named tuple `Parameters`. what: how messages call it.

    Returns:
      The object that must be kept alive, and the address.

    Raises:
      InputError: numba is missing, or cannot compile it.
    """
    try:
        import numba
    except ImportError as error:
        raise InputError(
            f"{what}: level: got 'compiled', which needs numba, want pip install 'lqrsim[numba]'"
        ) from error
    own = fingerprint(function)
    options = getattr(function, "targetoptions", _OPTIONS)
    parts = [version("numba"), version("llvmlite"), repr(instruction_set()), adapter, repr(names["Parameters"]._fields)]
    key = disk.key(*parts, own) if own else ""
    if key in _loaded:
        return _loaded[key]
    kept = disk.load(key) if key else None
    found = _unpacked(kept) if kept is not None else None
    if found is None:
        note_helpers(function)
        # numba compiled helpers with the globals of that time: if these have changed, the result is not cached.
        lasting = bool(key) and not stale(function)
        compilations.append(what)
        logger.debug(f"compiling {what} ...")
        pointer = numba.types.CPointer(numba.types.float64)
        try:
            # Compiled again, because numba freezes the globals of a function when it first compiles it.
            plain = getattr(function, "py_func", function)
            again = numba.njit(**{name: value for name, value in options.items() if name != "nopython"})(plain)
            namespace = names | _numba_names() | {"function": again, "nan": float("nan")}
            exec(compile(adapter, "<lqrsim>", "exec"), namespace)
            made: Any = numba.cfunc(numba.types.void(*[pointer] * pointers), **_OPTIONS)(namespace["adapter"])
        except Exception as error:  # mostly NumbaError, but numba raises others, too
            raise InputError(f"{what}: got code that numba cannot compile, want {_reason(error)}") from error
        found = made, made.address
        text = made.inspect_llvm()
        if lasting and not re.search(r"inttoptr \(i64 \d", text):  # an address in this process
            code, needed = object_code_of_one(text, made.native_name, _SYMBOL)
            header = {"needed": needed, "code": sha256(code)}
            packed = json.dumps(header).encode() + b"\n" + code
            disk.save(key, packed, what)
            found = _unpacked(packed) or found
    if key:
        _loaded[key] = found
    return found


def _unpacked(kept: bytes) -> tuple[Any, int] | None:
    """Load a cached function; None if it cannot be used."""
    from numba.core import registry

    header, _, code = kept.partition(b"\n")
    try:
        known = json.loads(header)
        # Creating numba's target registers the functions of its runtime.
        if known["code"] != sha256(code) or not (registry.cpu_target.target_context and are_there(known["needed"])):
            raise ValueError("its checksum does not fit, or it needs a function that is missing")
        loaded = Loaded(code, ())
        return loaded, loaded.address(_SYMBOL)
    except (ValueError, KeyError, TypeError, RuntimeError, RecursionError) as error:
        logger.debug(f"a cached compiled function cannot be used ({error})")
        return None


@cache
def _numba_names() -> dict[str, Any]:
    """Functions that an adapter uses: `carray`, and `readonly`, which makes an array read-only."""
    from numba import carray  # pyright: ignore[reportPrivateImportUsage]
    from numba.extending import intrinsic

    def readonly(typingctx: Any, array: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return args[0]

        return array.copy(readonly=True)(array), generate

    decorate: Any = intrinsic
    return {"carray": carray, "readonly": decorate(readonly)}


def _reason(error: Exception) -> str:
    """The lines of numba's long error message that describe the error."""
    if isinstance(error, AttributeError) and "NoneType" in str(error):
        return "a function that returns on every path, and does not change x and u"
    if "readonly" in str(error) and "setitem" in str(error):
        return "a function that does not change x and u, which are readonly"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    telling = [
        line for line in lines if not re.match(r"Failed in|During:|File |\^|- Resolution|<source|raised from", line)
    ]
    return f"its subset of Python ({' '.join(telling[:3])})"
