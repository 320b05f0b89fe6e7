"""The names that kernels are written against. They get a meaning only when the kernels are compiled.

Sizes become constants, and words of the language what `codegen/language.py` says. Open functions, which are empty here,
are filled in. So each kernel can be read, linted and type-checked on its own.
"""

from collections.abc import Callable

import numpy as np

N = 0  # states
M = 0  # controls
W = N + M  # states and controls, joined
NOISY = 0  # 1 for a problem with noise; `if NOISY` is not compiled for others
PRIMAL = 0  # 1 for the primal form of the cost-to-come, 0 for the dual form
EQUALITY = 0  # 1 for a constraint whose values must be zero

# Outcomes of iterations; see `Status`. Some have no status of the same name: NO_START (the first trajectory is not
# finite), STALLED (the line search found no lower cost), CYCLING (the same costs repeat), NO_PROGRESS (the lowest cost
# so far no longer falls), TIMED_OUT (set by the callers: no kernel reads a clock), RISK_TOO_HIGH (the expectation does
# not exist) and IN_VALLEY (Newton's method can take over).
RUNNING, CONVERGED, COST_CONVERGED, MAX_ITERATIONS, DIVERGED = 0, 1, 2, 3, 4
NOT_POSITIVE_DEFINITE, NOT_FINITE, NO_START, STALLED, CYCLING = 5, 6, 7, 8, 9
NO_PROGRESS, TIMED_OUT, RISK_TOO_HIGH, IN_VALLEY = 10, 11, 12, 13
LONGEST_CYCLE = 8
# Numbers of iterations without a lower cost, with a decrease below a thousandth, and with a settled cost but a gap that
# does not halve, that count as no progress. None is reached if the method converges on the paper's queries:
# `python experiments/benchmark_reliability.py --sections overhead`.
NO_FALL, SLOW_FALL, LINGER = 12, 30, 10
# The ladder of regularisation begins with fractions of the convex models in a mixture with those of second order, tried
# in turn until one has a minimum. Weights on changes of the controls follow.
MIXES = (0.0, 0.03, 0.1, 0.25, 0.5, 1.0)
ROW = 16  # count of numbers per obstacle in `World.table`: kind, position (3), rotation (9, row by row), size (3)
# Indices of a constraint's numbers in its array, and of its first multiplier; see `augmented_lagrangian.py`.
PENALTY, ROWS, FIRST, MARGIN, PRICE, MULTIPLIERS = 0, 1, 2, 3, 4, 5

# Tasks of `smoother` and `ilqr`; see `iterations.py`.
ITERATE, DESCEND, LINEARIZE, CERTIFY, EVALUATE, CURVE = 0, 1, 2, 3, 4, 5

# What is written of many steps at once: the states after them, with their Jacobians, and with their Hessians.
STATES, JACOBIANS, HESSIANS = 0, 1, 2

# Methods of an iteration; see `Iteration.method`.
SMOOTH, DAMPED, REJECTED, ILQR, NEWTON = 0, 1, 2, 3, 4


# Words of the language; see `codegen/language.py`.


def stack(*shape: int) -> np.ndarray:
    """An uninitialised float64 array of constant shape, on the stack of the compiled function."""
    return np.empty(shape)


def zeros(*shape: int) -> np.ndarray:
    """The same, filled with zeros."""
    return np.zeros(shape)


def inline(function: Callable) -> Callable:
    """Decorate a kernel that is inlined into its callers. LLVM decides well about most others itself."""
    return function


def outline(function: Callable) -> Callable:
    """Decorate a kernel that is never inlined.

    If it were inlined into a loop over trials, LLVM might vectorise across trials and round the remainder differently.
    The bits of a trial would then depend on the number of trials.
    """
    return function


def compact(function: Callable) -> Callable:
    """Decorate a kernel that takes little of the time: it is not inlined, and its loops are not unrolled.

    Compiling it then takes a third of the time. In a file of kernels with `COMPACT = 1`, all without a decorator are.
    """
    return function


def exact(function: Callable) -> Callable:
    """Decorate a kernel whose sums are evaluated in the order in which they are written."""
    return function


def call(function, *arguments) -> None:
    """Call the C function at an address.

    Arrays are passed by address, numbers as doubles and 64-bit ints (or `int32`), records field by field.
    """


def call_for_value(function, *arguments) -> float:
    """Call a C function that returns a double."""
    return 0.0


def at(address):
    """The float64 numbers at an address."""
    return np.empty(0)


def rows_at(address, width: int):
    """The float64 numbers at an address, in rows of a constant width."""
    return np.empty((0, width))


def int32(number: int) -> int:
    """A 32-bit int, as an argument of a C function."""
    return number


def power_of_two(exponent: float) -> float:
    """2**exponent, for a whole number from -1022 to 1023 in a float; undefined beyond."""
    return 2.0**exponent


def claim(flags, index) -> int:
    """Atomically set the int64 flag at an address from 0 to 1; return 1 if this thread did, else 0."""
    return 1


def load(words, index) -> int:
    """Atomically read an int64 that threads share."""
    return 0


def store(words, index, value: int) -> None:
    """Atomically write an int64 that threads share; earlier writes are visible to every thread that loads it."""


def fetch_add(words, index, value: int) -> int:
    """Atomically add to an int64 that threads share; return its value before."""
    return 0


# Open functions: a kernel that imports one is compiled with what `Source.filled` of `codegen/sources.py` puts in its
# place: a formula's or a text's function of the same name, or that of a file in `kernels/`, which is named here.


def rate(x, u, p, out) -> None:
    """Write xdot = f(x, u), (N,): `user_functions.py`."""


def rate_jacobian(x, u, p, out, fx, fu) -> None:
    """Write f (N,), and the structurally nonzero entries of df/dx (N, N) and df/du (N, M).

    `user_functions.py`, `differences.py`.
    """


def rate_curvature(x, u, p, w, curve) -> None:
    """Write the second derivatives of `sum_i w[i] f[i]` that may be nonzero, in the entries that `runge_kutta.py`
    lists; of symmetric pairs the one below the diagonal.
    """


def value(x, u, t, data) -> float:
    """A cost: the files of costs, and what `differences.py` takes differences of."""
    return 0.0


def loss(r, row, data) -> tuple[float, float, float]:
    """The cost of a row of a residual, and its first and second derivative in r: the files of costs."""
    return 0.0, 0.0, 0.0


def constraint_value(x, u, t, row, data) -> float:
    """One value of a constraint: nonnegative, or zero for an equality, where it is satisfied.

    `value` of the files of constraints.
    """
    return 0.0


def constraint_slope(x, u, t, row, data, gradient) -> None:
    """Add the gradient (W,) of that value: `slope` of the same files."""


def places(x, data, out) -> None:
    """Write the centres of a robot's balls, three coordinates each, ball by ball.

    `user_functions.py`, `mjcf_dynamics.py`.
    """


def places_jacobian(x, data, out, slopes) -> None:
    """Write the centres, and the structurally nonzero entries of their Jacobian (3 balls, N).

    `differences.py`, `user_functions.py`.
    """


def shared_values(x, data, out) -> None:
    """Write the numbers that all rows of a cost or a constraint share.

    `residual` of the files of costs and constraints, and of `mjcf_dynamics.py`; or `places`, of a robot's balls.
    """


def shared_jacobian(x, data, out, slopes) -> None:
    """Write these numbers, and the structurally nonzero entries of their Jacobian (any, N).

    `residual_jacobian`, `places_jacobian`.
    """


def noise_values(x, u, data, out) -> None:
    """Write the rows of M(x, u) that `problem/noise.py` lists: `constant_values` there, and `user_functions.py`."""


def noise_slopes(x, u, data, out, slopes) -> None:
    """Write these rows, and their derivatives, column by column, in the entries of (x, u) that are listed there.

    `constant_slopes` there, and `differences.py`.
    """


def measure(x, data, out) -> None:
    """Write the measurement of a state, (Y,)."""


def measure_slope(x, data, out) -> None:
    """Write the structurally nonzero entries of the measurement's Jacobian (Y, N)."""
