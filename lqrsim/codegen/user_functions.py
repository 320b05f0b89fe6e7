"""A user's own numba, JAX or plain Python function, at an address that compiled code can call.

Compiled code knows only the address, so it serves all functions of the same sizes. A function of JAX or plain Python is
called back through Python, at microseconds per call. A numba function is compiled to a C function, and cached on disk
if it has a fingerprint: numba compiles it once, to LLVM IR. An object file of this IR is cached. In the file everything
except the function itself is internal: numba numbers its functions within a process, so files of two processes would
contain different functions of the same name.

A function of JAX is jitted, with derivatives by automatic differentiation. All is computed on the processor and in
double precision, whatever the user's settings are. Whole Runge-Kutta steps of it, one or all of a plan, are a function,
too.
"""

import collections
import contextlib
import ctypes
import inspect
import logging
import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache, cached_property, partial
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np

from lqrsim.codegen import disk_cache as disk
from lqrsim.codegen.compiled_module import Loaded, compilations, compiling, has_symbols, object_code_of_one
from lqrsim.codegen.fingerprint import fingerprint, identity, note_helpers, stale
from lqrsim.codegen.sources import Source, check_source
from lqrsim.errors import Array, InputError, check_array, check_function, check_items, check_name, excerpt, keep
from lqrsim.kernels.declarations import HESSIANS, JACOBIANS, STATES
from lqrsim.machine import instruction_set

logger = logging.getLogger("lqrsim")

# Flags such as `contract` let LLVM fuse and reorder sums, as in kernels, but keep NaN and infinity meaningful.
_OPTIONS: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz", "arcp"}, "error_model": "numpy"}
_SYMBOL = "function"

# Functions loaded in this process, by key.
_loaded: dict[str, tuple[Any, int]] = {}


def _unpacked(code: bytes, known: dict[str, Any]) -> tuple[Any, int]:
    from numba.core import registry

    # Creating numba's target registers the functions of its runtime.
    if not (registry.cpu_target.target_context and has_symbols(known["needed"])):
        raise ValueError("it needs a function that is missing")
    loaded = Loaded(code)
    return loaded, loaded.address(_SYMBOL)


@cache
def _numba_names() -> dict[str, Any]:
    """Functions that an adapter uses: `carray`, and `readonly`, which makes an array read-only."""
    from numba import carray  # pyright: ignore[reportPrivateImportUsage]
    from numba.extending import intrinsic

    @intrinsic  # pyright: ignore[reportCallIssue, reportArgumentType]
    def readonly(typingctx: Any, array: Any) -> Any:
        return array.copy(readonly=True)(array), lambda context, builder, sig, args: args[0]

    return {"carray": carray, "readonly": readonly}


def _reason(error: Exception) -> str:
    """The lines of numba's long error message that describe the error."""
    if isinstance(error, AttributeError) and "NoneType" in str(error):
        return "a function that returns on every path, and does not change x and u"
    if "readonly" in str(error) and "setitem" in str(error):
        return "a function that does not change x and u, which are readonly"
    lines = (line.strip() for line in str(error).splitlines())
    where = r"$|Failed in|During:|File |\^|- Resolution|<source|raised from"
    return f"its subset of Python ({' '.join([line for line in lines if not re.match(where, line)][:3])})"


LEVELS = ("symbolic", "compiled", "jax", "plain")


def level_of(function: Any, level: str | None, arguments: Sequence[str] = ("x", "u", "p")) -> str:
    """The level of a function of these arguments; by default compiled for a numba function and symbolic for others."""
    check_signature(function, arguments)
    is_compiled = hasattr(function, "py_func")
    if level is None:
        return "compiled" if is_compiled else "symbolic"
    if check_name("level", level, LEVELS) != "compiled" and is_compiled:
        raise InputError(f"level: got {level!r} for {name_of(function)}, want 'compiled' for a numba function")
    if level == "jax":
        try:
            import jax  # noqa: F401
        except ImportError as error:
            got = "got 'jax', which needs JAX, want pip install 'lqrsim[jax]'"
            raise InputError(f"{name_of(function)}: level: {got}") from error
    return level


def name_of(function: Any) -> str:
    """The name of a function in messages."""
    plain = getattr(function, "py_func", function)
    name = getattr(plain, "__qualname__", None)
    return name if isinstance(name, str) and name else type(plain).__name__


@cache
def parameters_class(names: tuple[str, ...]) -> Any:
    """The class of `p`: a named tuple, which numba knows, so that p can be passed to numba helpers."""

    def unknown(self: Any, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        check_name("parameter", name, names)

    return type("Parameters", (collections.namedtuple("Parameters", names),), {"__slots__": (), "__getattr__": unknown})


@dataclass(frozen=True, kw_only=True)
class UserFunction:
    """One function of a user, and the form of its calls.

    With `values`, `function(x, u, p)` returns that many numbers; with `writes`, `function(x, u, p, a, b)` writes to one
    or two arrays of those shapes, which are zero on entry.

    Attributes:
      parameters: names in p; their values follow `offset` other numbers in the data.
      entries: names of the returned values in messages; empty for a single number.
      unused: (index, name) of the entries of (x, u) on which the value does not depend, according to the user.
      columns: size of the rows in which the values are returned; 0 for a flat list.
      with_control: False for a `function(x, p)`.
      is_memory: whether the address is that of numbers instead of a function.
      stopped: setting it ends the solves that call the function, in any thread.
    """

    function: Callable[..., Any]
    level: str
    states: int
    controls: int
    parameters: tuple[str, ...]
    offset: int
    values: int = 0
    writes: tuple[tuple[int, ...], ...] = ()
    entries: tuple[str, ...] = ()
    unused: tuple[tuple[int, str], ...] = ()
    columns: int = 0
    with_control: bool = True
    is_memory: ClassVar[bool] = False
    stopped: threading.Event = field(default_factory=threading.Event, init=False, repr=False, compare=False)
    _thread: threading.local = field(default_factory=threading.local, init=False, repr=False, compare=False)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it without its address, which is of no use to another process."""
        stated = {field.name: getattr(self, field.name) for field in fields(self) if field.init}
        return partial(type(self), **stated), ()

    @property
    def name(self) -> str:
        of = "x, u, p" if self.with_control else "x, p"
        return f"{name_of(self.function)}({of}{', ...' if self.writes else ''})"

    @cached_property
    def identity(self) -> str:
        """The function's part of a problem's digest."""
        return identity(self.function)

    def call(self, x: Array, u: Array, p: Mapping[str, float]) -> list[Array]:
        """Call the function in plain Python: the returned values as one vector, or the arrays that it wrote.

        Raises InputError if it fails, or returns an unsuitable result.
        """
        plain = self.function if self.level == "jax" else getattr(self.function, "py_func", self.function)
        if "held" not in vars(self):  # before the first call compiles its helpers
            note_helpers(self.function)
        try:
            with np.errstate(all="ignore"):  # callers handle NaN and infinity
                return self._values(plain, x, u, parameters_class(tuple(p))(*p.values()))
        except InputError:
            raise
        except Exception as error:  # any exception of a user's function becomes one line
            got, want = f"{type(error).__name__} ({error})", f"no exception at x = {first_numbers(x)}"
            raise InputError(f"{self.name}: got {got}, want {want}") from error

    def _values(self, function: Callable[..., Any], x: Array, u: Array, p: Any) -> list[Array]:
        """What it returns, as one vector, or writes; of copies, because it may keep them beyond the call."""
        inputs = (x.copy(), u.copy())[: 1 + self.with_control]
        written: list[Array] = [np.zeros(shape) for shape in self.writes]
        try:
            returned = function(*inputs, p, *written)
            if self.writes and returned is not None:
                last = "argument" if len(self.writes) == 1 else "two arguments"
                raise InputError(f"got {excerpt(returned)} returned, want the result written to the last {last}")
            return written or [self._vector(returned)]
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from None

    def plain_call(self, parameters: Mapping[str, float]) -> Callable[..., None]:
        """The function for kernels in plain Python: it writes the values that the user's function returns."""

        def run(x: Array, u: Array, data: Array, *outputs: Array) -> None:
            for output, value in zip(outputs, self.call(x, u, parameters), strict=True):
                output[...] = value.reshape(output.shape)

        return run

    def _vector(self, returned: Any) -> Array:
        try:
            array = np.array(returned)
            if array.dtype.kind not in "biufO":  # no text, no complex numbers
                raise TypeError
            vector = np.array([float(entry) for entry in array.reshape(-1)])
        except (TypeError, ValueError, OverflowError):  # OverflowError for an int beyond all floats
            raise InputError(f"got {excerpt(returned)}, want {self._wanted()}") from None
        if self.columns and array.shape != (wanted := (self.values // self.columns, self.columns)):
            raise InputError(f"got shape {array.shape}, want {wanted}: {self._wanted()}")
        if len(vector) != self.values:
            raise InputError(f"got {len(vector)} entries, want {self._wanted()}")
        return vector

    def _wanted(self) -> str:
        if self.columns:
            return f"{self.columns} coordinates for each of {', '.join(self.entries)}"
        return f"{self.values}: one for each of {', '.join(self.entries)}" if self.entries else "one number"

    @cached_property
    def held(self) -> tuple[Any, int]:
        """What to keep alive, and the address of `f(x, u, data, out)` or `f(x, u, data, a, b)`, of float64 pointers."""
        return self._compile() if self.level == "compiled" else self._call_back()

    def _call_back(self) -> tuple[Any, int]:
        """A C function that calls this one through Python."""
        sizes = [int(np.prod(shape)) for shape in self.writes] or [self.values]
        end = self.offset + len(self.parameters)

        def callback(x: int, u: int, data: int, *outputs: int) -> None:
            arrays = [view(address, size) for address, size in zip(outputs, sizes, strict=True)]

            def write() -> None:
                p = parameters_class(self.parameters)(*view(data, end)[self.offset :].tolist())
                results = self._values(self.function, view(x, self.states), view(u, self.controls), p)
                for array, values in zip(arrays, results, strict=True):
                    array[:] = values.reshape(-1)

            self._guarded(write, arrays)

        return c_function(callback, *[ctypes.c_void_p] * (3 + (len(self.writes) or 1)))

    def _guarded(self, write: Callable[[], None], outputs: Sequence[Array]) -> None:
        """Let a callback write its outputs. After an exception they are NaN, and the solver checks `raised`."""
        try:
            if self.stopped.is_set():
                raise KeyboardInterrupt
            if self.raised is not None:
                raise self.raised
            with np.errstate(all="ignore"):
                write()
        except BaseException as error:  # even Ctrl-C: C code cannot pass it on
            self._thread.raised = error
            for array in outputs:
                array[:] = np.nan

    @property
    def raised(self) -> BaseException | None:
        """The exception that the function raised in this thread. Until `forget`, the function is not called again."""
        return getattr(self._thread, "raised", None)

    def forget(self) -> None:
        """Forget the exception, so that the function is called again."""
        self._thread.raised = None

    def _compile(self) -> tuple[Any, int]:
        """A C function that numba makes of this one."""
        try:
            import numba
        except ImportError as error:
            got = "got 'compiled', which needs numba, want pip install 'lqrsim[numba]'"
            raise InputError(f"{self.name}: level: {got}") from error
        function, adapter = self.function, self._adapter()
        digest, parameters = fingerprint(function), parameters_class(self.parameters)
        parts = [version("numba"), version("llvmlite"), repr(instruction_set()), adapter, repr(parameters._fields)]
        key = disk.key(*parts, digest) if digest else ""
        if key in _loaded:
            return _loaded[key]
        compiled = disk.made_of(disk.load(key) if key else None, _unpacked)
        if compiled is None:
            note_helpers(function)
            # numba compiled helpers with their globals at that time. If these have changed, the result is not cached.
            lasting = bool(key) and not stale(function)
            compilations.append(self.name)
            logger.debug(f"compiling {self.name} ...")
            pointers = [numba.types.CPointer(numba.types.float64)] * (3 + (len(self.writes) or 1))
            options = getattr(function, "targetoptions", _OPTIONS)
            try:
                # Compiled again, because numba freezes the globals of a function when it first compiles it.
                plain = getattr(function, "py_func", function)
                again = numba.njit(**{name: value for name, value in options.items() if name != "nopython"})(plain)
                namespace = _numba_names() | {"function": again, "nan": float("nan"), "Parameters": parameters}
                exec(compile(adapter, "<lqrsim>", "exec"), namespace)
                adapted: Any = numba.cfunc(numba.types.void(*pointers), **_OPTIONS)(namespace["adapter"])
            except Exception as error:  # mostly NumbaError, but numba also raises others
                raise InputError(f"{self.name}: got code that numba cannot compile, want {_reason(error)}") from error
            compiled = adapted, adapted.address
            text = adapted.inspect_llvm()
            if lasting and not re.search(r"inttoptr \(i64 \d", text):  # an address in this process
                code, needed = object_code_of_one(text, adapted.native_name, _SYMBOL)
                disk.save(key, code, self.name, needed=needed)
                compiled = disk.made_of((code, {"needed": needed}), _unpacked) or compiled
        if key:
            _loaded[key] = compiled
        return compiled

    def _adapter(self) -> str:
        """Source of `adapter`, which numba compiles around `function`."""
        lines = [f"x, u = readonly(carray(x, {self.states})), readonly(carray(u, {self.controls}))"]
        numbers = "".join(f"data[{self.offset + i}], " for i in range(len(self.parameters)))
        lines.append(f"p = Parameters({numbers})")
        of = "x, u, p" if self.with_control else "x, p"
        if self.writes:
            outputs = ("a", "b")[: len(self.writes)]
            lines += [f"{name} = carray({name}, {shape})" for name, shape in zip(outputs, self.writes, strict=True)]
            # After an exception, all outputs are NaN, which the solver detects.
            lines += ["try:", f"    function({of}, {', '.join(outputs)})", "except Exception:"]
            lines += [f"    {name}[:] = nan" for name in outputs]
        else:
            outputs = ("out",)
            lines += ["try:", f"    returned = function({of})"]
            copies = [f"out[{i}] = returned{self._entry(i)}" for i in range(self.values)]
            if self.entries:  # an array may have a different length each time
                rows = self.values // (self.columns or 1)
                sizes = [f"len(returned) == {rows}"]
                sizes += [f"len(returned[{k}]) == {self.columns}" for k in range(rows if self.columns else 0)]
                lines.append(f"    if {' and '.join(sizes)}:")
                copies = [f"    {line}" for line in copies]
            lines += [f"    {line}" for line in copies]
            lines += ["except Exception:", "    out[0] = nan"]
        body = "\n".join(f"    {line}" for line in lines)
        return f"def adapter(x, u, data, {', '.join(outputs)}):\n{body}\n"

    def _entry(self, i: int) -> str:
        """The index of value i among the returned values."""
        if self.columns:
            return f"[{i // self.columns}][{i % self.columns}]"
        return f"[{i}]" if self.entries else ""


def c_function(callback: Callable[..., None], *kinds: Any) -> tuple[Any, int]:
    """A C function of arguments of these kinds that calls back: the object to keep alive, and its address."""
    held = ctypes.CFUNCTYPE(None, *kinds)(callback)
    return held, ctypes.cast(held, ctypes.c_void_p).value or 0


# Functions of JAX.


@contextlib.contextmanager
def in_double_precision() -> Iterator[None]:
    """The context of all calls of JAX."""
    import jax

    with jax.enable_x64(True), jax.default_device(jax.local_devices(backend="cpu")[0]):
        try:
            yield
        except jax.errors.JAXTypeError as error:  # many lines, with a link
            got = f"an operation that JAX cannot trace ({str(error).splitlines()[0].rstrip('.')})"
            raise InputError(f"got {got}, want those of jax.numpy, and jnp.where for branches") from None


class Jitted:
    """`f(x, u, p)` or `f(x, p)` of NumPy arrays, which returns an array; compiled at its first call.

    The user's function, of JAX arrays, is `py_func`, as it is in numba.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.py_func = function

    def __getstate__(self) -> dict[str, Any]:
        """Without what is compiled, which cannot be pickled."""
        return {name: value for name, value in vars(self).items() if name != "_jitted"}

    def __call__(self, *arguments: Any) -> Any:
        with in_double_precision():
            return np.asarray(self._jitted(*arguments))

    def traced(self, *arguments: Any) -> Any:
        import jax.numpy as jnp

        return jnp.asarray(self.py_func(*arguments))

    @cached_property
    def _jitted(self) -> Callable[..., Any]:
        import jax

        return jax.jit(self.traced)


class JittedDerivatives(Jitted):
    """`derivatives(x, u, p, a, b)`, or without `u` or `b`, which writes to one or two arrays of given shapes.

    They are the Jacobian, with its columns for x and for u apart; or, if the first has the size of (x, u), the gradient
    and the Hessian.
    """

    def __init__(self, function: Callable[..., Any], shapes: tuple[tuple[int, ...], ...]) -> None:
        super().__init__(function)
        self.shapes = shapes

    def __call__(self, *arguments: Any) -> Any:
        count = len(self.shapes)
        with in_double_precision():
            for array, values in zip(arguments[-count:], self._jitted(*arguments[:-count]), strict=True):
                array[...] = values

    def traced(self, *arguments: Any) -> tuple[Any, ...]:
        import jax
        import jax.numpy as jnp

        *parts, p = arguments
        ends = np.cumsum([len(part) for part in parts])[:-1]

        def joined(z: Any) -> Any:
            return jnp.ravel(super(JittedDerivatives, self).traced(*jnp.split(z, ends), p)).astype(float)

        z = jnp.concatenate(parts)
        if len(self.shapes[0]) == 1:
            value = lambda z: joined(z)[0]  # noqa: E731
            return jax.grad(value)(z), jax.hessian(value)(z)
        columns = jnp.split(jax.jacfwd(joined)(z), ends, axis=1)
        return tuple(part.reshape(shape) for part, shape in zip(columns, self.shapes, strict=True))


@dataclass(frozen=True, kw_only=True)
class JaxSteps(UserFunction):
    """Runge-Kutta steps of the rates `function`, which is `Jitted`, from as many states as compiled code gives."""

    _jitted: dict[int, Callable[[Array], Any]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def plain_call(self, parameters: Mapping[str, float]) -> Callable[..., None]:
        numbers = np.array(list(parameters.values()))

        def run(what: int, count: int, skipped: int, x: Array, u: Array, p: Array, h: float, *more: Array) -> None:
            pairs = zip((x, u, *more[: what + 2]), self._sizes, strict=False)
            x, u, weights, *outputs = (array.reshape(-1, size) for array, size in pairs)
            rows = slice(skipped, skipped + count)
            self._write(what, x[:count], u[:count], numbers, h, weights[rows], [output[:count] for output in outputs])

        return run

    @property
    def _sizes(self) -> tuple[int, ...]:
        """The sizes of a row of x, u, weights, and each output."""
        n, w = self.states, self.states + self.controls
        return n, self.controls, n, n, n * w, w * w

    def _call_back(self) -> tuple[Any, int]:
        n, m, end = self.states, self.controls, self.offset + len(self.parameters)

        def callback(
            what: int, count: int, skipped: int, x: int, u: int, data: int, h: float, weights: int, *outputs: int
        ) -> None:  # fmt: skip
            def rows(address: int, size: int, first: int = 0) -> Array:
                return view(address + 8 * first * size, count * size).reshape(count, size)

            arrays = list(map(rows, outputs[: what + 1], self._sizes[3:]))
            arguments = rows(x, n), rows(u, m), view(data, end)[self.offset :], h
            w = rows(weights, n, skipped) if what == HESSIANS else None
            self._guarded(lambda: self._write(what, *arguments, w, arrays), arrays)

        pointer = ctypes.c_void_p
        return c_function(callback, *[ctypes.c_int64] * 3, *[pointer] * 3, ctypes.c_double, *[pointer] * 4)

    def _write(
        self, what: int, x: Array, u: Array, p: Array, h: float, weights: Array | None, outputs: list[Array]
    ) -> None:
        """Write states (K, n) and Jacobians (K, n w), and add Hessians (K, w w), or do the first of this."""
        n, w, last = self.states, self.states + self.controls, len(p) + 1
        # A single array each way: several take twice as long to transfer.
        packed = np.empty((len(x), w + last + (n if what == HESSIANS else 0)))
        packed[:, :n], packed[:, n:w], packed[:, w], packed[:, w + 1 : w + last] = x, u, h, p
        packed[:, w + last :] = weights if what == HESSIANS else 0.0
        with in_double_precision():
            if what not in self._jitted:
                self._jitted[what] = self._compiled(what)
            outcome = np.asarray(self._jitted[what](packed))
        outputs[0][...] = outcome[:, :n]
        if what >= JACOBIANS:
            outputs[1][...] = outcome[:, n : n + n * w]
        if what == HESSIANS:
            outputs[2][...] += outcome[:, n + n * w :]

    def _compiled(self, what: int) -> Callable[[Array], Any]:
        import jax
        import jax.numpy as jnp

        assert isinstance(self.function, Jitted)
        n, w, last = self.states, self.states + self.controls, len(self.parameters) + 1
        rate, parameters = jax.jit(self.function.traced), parameters_class(self.parameters)  # traced once for 4 stages

        def step(z: Any, h: Any, p: Any) -> Any:
            x, u = z[:n], z[n:]
            first = rate(x, u, p)
            second = rate(x + 0.5 * h * first, u, p)
            third = rate(x + 0.5 * h * second, u, p)
            fourth = rate(x + h * third, u, p)
            return x + h / 6 * (first + 2 * second + 2 * third + fourth)

        def of_row(row: Any) -> Any:
            z, h, numbers, weights = row[:w], row[w], row[w + 1 : w + last], row[w + last :]
            p = parameters(*numbers)
            if what == STATES:
                return step(z, h, p)
            jacobian, after = jax.jacfwd(lambda z: (step(z, h, p),) * 2, has_aux=True)(z)
            results = [after, jacobian.ravel()]
            if what == HESSIANS:
                results.append(jax.hessian(lambda z: weights @ step(z, h, p))(z).ravel())
            return jnp.concatenate(results)

        return jax.jit(jax.vmap(of_row))


# What a part of a problem has of its functions.


def with_derivatives(
    function: Callable[..., Any], returned: Mapping[str, Any],
    derivatives: Callable[..., Any] | None, writes: tuple[tuple[int, ...], ...], *, more: int = 0, **both: Any,
) -> tuple[UserFunction, ...]:  # fmt: skip
    """A function that returns values, and one that writes its derivatives, unless that is None: `**both` is of both.

    Those of a function of JAX are derived, if there is something to write. `more` functions follow in the data.
    """
    if both["level"] == "jax":
        derivatives = JittedDerivatives(function, writes) if writes else None
        function = Jitted(function)
    both["offset"] = (1 if derivatives is None else 2) + more
    first = UserFunction(function=function, **returned, **both)
    return (first,) if derivatives is None else (first, UserFunction(function=derivatives, writes=writes, **both))


@dataclass(frozen=True, eq=False)
class Term:
    """A part of a problem, for one system: the source to compile, and the numbers that it reads.

    Attributes:
      source: text that defines the functions of its kind of term, or a Source, from a module of the package.
        `codegen/language.py` defines what it may contain. N, M, W, functions such as sqrt and exp, and those of
        `kernels/distances.py` and `kernels/rotation_ratios.py` are available by their bare names.
      data: (any,) float64; the source can index it, but cannot determine its length.
      functions: functions that the source calls with `call`; their addresses come first in its data.
    """

    source: str | Source
    data: Array
    functions: tuple[UserFunction, ...] = field(default=(), kw_only=True)

    @property
    def _defines(self) -> Mapping[str, int]:
        """The functions that the source must define, each with its number of arguments."""
        return {}

    @cached_property
    def code(self) -> Source:
        return check_source(type(self).__name__, self.source, self._defines)

    @property
    def digested(self) -> list[str | Array]:
        """What the hash of a problem has of it, besides its functions."""
        return [self.code.digest, self.data]

    @property
    def numbers(self) -> int:
        """Number of entries in compiled code's data that belong to this term."""
        return len(self.functions) + len(self.data)

    def __post_init__(self) -> None:
        kind, wanted = type(self).__name__, "a tuple of UserFunction, as FunctionCost makes them"
        data = check_array(f"{kind}: data", self.data, (None,), infinite=True)
        keep(self, data=data, functions=check_items(f"{kind}: functions", self.functions, UserFunction, wanted))
        _ = self.code  # which is checked


def rows_of(returned: Any, count: int | None, wanted: str, what: str = "rows") -> list[list[Any]]:
    """This number of rows, or any, that a user's function returned, in lists or arrays."""
    if returned is None:
        raise InputError(f"got None, want {wanted}: is a return missing?")
    listed = returned.tolist() if hasattr(returned, "tolist") else returned
    try:
        rows = [row.tolist() if hasattr(row, "tolist") else list(row) for row in listed]
    except TypeError:
        raise InputError(f"got {excerpt(returned)}, want {wanted}") from None
    if count is not None and len(rows) != count:
        raise InputError(f"got {len(rows)} {what}, want {wanted}")
    return rows


def numbers_of(part: Any) -> Array:
    """What compiled code reads of a Term or Dynamics: the addresses of its functions, then its own numbers."""
    if not part.functions:
        return part.data
    return np.concatenate([[address_of(function) for function in part.functions], part.data])


def raise_again(functions: Sequence[UserFunction]) -> None:
    """Raise the exception, if any, that one of the functions raised when compiled code called it."""
    for function in functions:
        if (error := function.raised) is not None:
            function.forget()
            raise error


def interrupt_of(functions: Sequence[UserFunction]) -> BaseException | None:
    """The KeyboardInterrupt, or other exception that is no error, of a function that compiled code called; or None."""
    raised = (function.raised for function in functions)
    return next((error for error in raised if error is not None and not isinstance(error, Exception)), None)


def raised_by(functions: Sequence[UserFunction]) -> str:
    """The exceptions of the functions, as text."""
    raised = [f"{f.name} raised {type(f.raised).__name__}: {f.raised}" for f in functions if f.raised is not None]
    return "; ".join(raised)


def check_depends_on(who: str, names: object, of: str) -> tuple[str, ...] | None:
    """The names that a user's function depends on; None for all."""
    if names is None:
        return None
    if isinstance(names, str):
        raise InputError(f"{who}: depends_on: got {excerpt(names)}, want a tuple of names: ({excerpt(names)},)")
    return check_items(f"{who}: depends_on", names, str, f"a tuple of names of {of}")


def axes_of(
    who: str, depends_on: Sequence[str] | None, names: Sequence[str]
) -> tuple[tuple[int, ...], tuple[tuple[int, str], ...]]:
    """The indices of the names that a function depends on, and the other names with indices."""
    wanted = names if depends_on is None else depends_on
    axes = tuple(sorted({names.index(check_name(f"{who}: depends_on", name, names)) for name in wanted}))
    return axes, tuple((i, name) for i, name in enumerate(names) if i not in axes)


def check_derivative(field: str, derivative: Any, function: Any, level: str, arguments: str) -> None:
    """Raises InputError unless a derivative takes these arguments, and is allowed at its function's level."""
    if level in ("symbolic", "jax"):
        got = f"a derivative of {name_of(function)}, which is {level}"
        raise InputError(f"{field}: got {got}, want none (it is derived) or level='compiled' or 'plain'")
    check_function(field, derivative, f"a function of ({arguments})")
    level_of(derivative, level, arguments.split(", "))


def address_of(function: UserFunction) -> float:
    """The address of a user's function, for compiled code."""
    with compiling:
        return float(function.held[1])


def view(address: int, size: int) -> Array:
    """The numbers at an address."""
    memory: Any = (ctypes.c_double * size).from_address(address)
    return np.frombuffer(memory, dtype=np.float64)


def first_numbers(x: Array) -> str:
    """The first few numbers, for a message."""
    return "(" + ", ".join(f"{value:g}" for value in x[:6]) + (", ...)" if len(x) > 6 else ")")


def check_signature(function: Any, wanted: Sequence[str]) -> None:
    """Raises InputError unless it is a function of these arguments."""
    want = f"a function of ({', '.join(wanted)})"
    check_function("function", function, want)
    try:
        inspect.signature(getattr(function, "py_func", function)).bind(*wanted)
    except TypeError as error:
        raise InputError(f"{name_of(function)}: {error}, want {want}") from None
    except ValueError:  # a built-in function has no signature
        return
    except Exception:  # an object whose attributes raise
        raise InputError(f"function: got {excerpt(function)}, want {want}") from None
