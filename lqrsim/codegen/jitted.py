"""A user's functions of JAX as functions of NumPy arrays: jitted, with derivatives by automatic differentiation.

All is computed on the processor and in double precision, whatever the user's settings are.
"""

import contextlib
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np

from lqrsim.errors import InputError


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

    def __call__(self, *given: Any) -> Any:
        with in_double_precision():
            return np.asarray(self._jitted(*given))

    def traced(self, *given: Any) -> Any:
        import jax.numpy as jnp

        return jnp.asarray(self.py_func(*given))

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

    def __call__(self, *given: Any) -> Any:
        count = len(self.shapes)
        with in_double_precision():
            for array, values in zip(given[-count:], self._jitted(*given[:-count]), strict=True):
                array[...] = values

    def traced(self, *given: Any) -> tuple[Any, ...]:
        import jax
        import jax.numpy as jnp

        *parts, p = given
        ends = np.cumsum([len(part) for part in parts])[:-1]

        def joined(z: Any) -> Any:
            return jnp.ravel(super(JittedDerivatives, self).traced(*jnp.split(z, ends), p)).astype(float)

        z = jnp.concatenate(parts)
        if len(self.shapes[0]) == 1:
            value = lambda z: joined(z)[0]  # noqa: E731
            return jax.grad(value)(z), jax.hessian(value)(z)
        columns = jnp.split(jax.jacfwd(joined)(z), ends, axis=1)
        return tuple(part.reshape(shape) for part, shape in zip(columns, self.shapes, strict=True))
