"""The function that `kernels/user_functions.py` calls: Runge-Kutta steps of a function of JAX, one or all of a plan."""

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from lqrsim.codegen.jitted import Jitted, in_double_precision
from lqrsim.codegen.user_functions import UserFunction, c_function, parameters_class, view
from lqrsim.errors import Array
from lqrsim.kernels.declarations import HESSIANS, JACOBIANS, STATES


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

    @cached_property
    def called_back(self) -> tuple[Any, int]:
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
