"""The names that kernels are written against, and that mean something only when they are compiled.

Sizes become constants; words of the language are what `codegen/language.py` says; functions are filled in, by what the
form of the cost-to-come, dynamics, constraints and noise bring (see `codegen/sources.py`). This module only declares
them, so that each kernel can be read, linted and type-checked on its own.
"""

from collections.abc import Callable

import numpy as np

N = 0  # states
M = 0  # controls
W = N + M  # a state and a control, joined
NOISY = 0  # 1 for a problem with noise: what `if NOISY` guards is not compiled for others
EQUALITY = 0  # 1 for a constraint whose numbers are to be zero

# How iterations end; see `Status`. Of those without a status of their own, NO_START is a first trajectory that is not
# finite, STALLED a line search that found no lower cost, CYCLING that the same costs come again and again, and
# NO_PROGRESS that the least cost so far does not fall. TIMED_OUT is for the drivers: no kernel looks at a clock.
# RISK_TOO_HIGH is a pass that failed because no expectation exists. IN_VALLEY is where Newton's method can go on.
RUNNING, CONVERGED, COST_CONVERGED, MAX_ITERATIONS, DIVERGED = 0, 1, 2, 3, 4
NOT_POSITIVE_DEFINITE, NOT_FINITE, NO_START, STALLED, CYCLING = 5, 6, 7, 8, 9
NO_PROGRESS, TIMED_OUT, RISK_TOO_HIGH, IN_VALLEY = 10, 11, 12, 13
LONGEST_CYCLE = 8
# After how many iterations without a lower cost, and after how many in which it fell by less than a thousandth, there
# is no progress. `python experiments/benchmark_reliability.py --sections overhead` shows that neither is met where the
# method converges on the paper's queries.
NO_FALL, SLOW_FALL = 12, 30
ROW = 16  # numbers that an obstacle takes in `World.table`: kind, position (3), rotation (9, row by row), size (3)
HEADER = 5  # numbers that come before the multipliers; see `augmented_lagrangian.py`

# What an entry is to do; see `entry_points.py`.
ITERATE, DAMP, FINISH, CERTIFY, EVALUATE = 0, 1, 2, 3, 4

# What an iteration was; see `Iteration.method`.
SMOOTH, DAMPED, REJECTED, ILQR, NEWTON = 0, 1, 2, 3, 4

# After how many damped iterations without an end iLQR has its turn.
PATIENCE = 50


# Words of the language; see `codegen/language.py`.


def stack(*shape: int) -> np.ndarray:
    """An uninitialised float64 array of constant shape, on the stack of the compiled function."""
    return np.empty(shape)


def inline(function: Callable) -> Callable:
    """Decorates a kernel that becomes part of its callers. LLVM finds most of what is worth it by itself."""
    return function


def outline(function: Callable) -> Callable:
    """Decorates a kernel that stays a function of its own, called for one thing after the other.

    In a loop LLVM might work on several at once, and for the last few round otherwise: then the bits of a trial would
    depend on how many there are.
    """
    return function


def exact(function: Callable) -> Callable:
    """Decorates a kernel whose sums are taken in the order in which they stand."""
    return function


def call(function, *arguments) -> None:
    """Call the C function at an address with arrays, by their addresses, floats, ints of 64 bits, and `int32`; records
    are taken apart."""


def call_for_value(function, *arguments) -> float:
    """The same for one that returns a float."""
    return 0.0


def at(address):
    """The float64 numbers at an address."""
    return np.empty(0)


def rows_at(address, width: int):
    """The same as rows of a constant width."""
    return np.empty((0, width))


def int32(number: int) -> int:
    """An int of 32 bits, to call a C function with."""
    return number


def power_of_two(exponent: float) -> float:
    """2 to a whole number from -1022 to 1023, which is a float; beyond, any number."""
    return 2.0**exponent


def claim(flags, index) -> int:
    """Set a flag, one of the int64 at an address, from 0 to 1; 1 if it was this thread that did, else 0."""
    return 1


def load(words, index) -> int:
    """One of the int64 at an address, which threads share."""
    return 0


def store(words, index, value: int) -> None:
    """Write one of them; what was written before it is there for who then loads it."""


def fetch_add(words, index, value: int) -> int:
    """Add to one of them, and return what it was before."""
    return 0


# What dynamics, constraints, balls, noise and sensors bring.


def rate(x, u, p, out) -> None:
    """Write xdot = f(x, u), (N,)."""


def rate_jacobian(x, u, p, out, fx, fu) -> None:
    """Write f (N,), and the entries of df/dx (N, N) and df/du (N, M) that are not zero everywhere."""


def rate_curvature(x, u, p, w, curve) -> None:
    """Write the second derivatives of `sum_i w[i] f[i]` in the entries that `step_curvature.py` takes, but zeros."""


def constraint_value(x, u, t, row, data) -> float:
    """One of a constraint's numbers, which are not to be negative, or to be zero."""
    return 0.0


def constraint_slope(x, u, t, row, data, gradient) -> None:
    """Add its gradient (W,)."""


def places(x, data, out) -> None:
    """Write where the balls of a robot are, three coordinates each, ball by ball."""


def places_jacobian(x, data, out, slopes) -> None:
    """Write these, and those of their derivatives in the states (..., N) that are not zero everywhere."""


def noise_values(x, u, data, out) -> None:
    """Write M(x, u), the rows of it that `noise.py` takes."""


def noise_slopes(x, u, data, out, slopes) -> None:
    """Write these, and their derivatives, column by column, in the entries of (x, u) that `noise.py` takes."""


def measure(x, data, out) -> None:
    """Write what the sensors say of a state, (Y,)."""


def measure_slope(x, data, out) -> None:
    """Write those entries of its Jacobian (Y, N) that are not zero everywhere, to zeros."""


# What the form of the cost-to-come brings; see `cost_to_come_dual.py`, `cost_to_come_primal.py` and `records.py`.


def initial_cost_to_come(Q, q, constant, x, to_go, to_come) -> tuple[float, bool]:
    """Write the cost-to-come at 0."""
    return 0.0, True


def linearize(x, u, model, arrived, step) -> None:
    """Write where (x, u) leads, and the linearised step that `riccati_forward` takes."""


def forward_jacobian(x, u, model, arrived, step, spare):
    """The Jacobian (N, W) of the step forwards, after `linearize`; `spare` may be written to."""
    return step.jacobian


def riccati_forward(t, step, stage, constant, to_come, smoothing) -> bool:
    """One step of the cost-to-come, from t to t + 1."""
    return True


def smoothed_state(t, to_go, to_come, costate, x) -> bool:
    """Write the minimiser of the total cost at t, and the costate there."""
    return True


def previous_state(t, x_hat, costate, smoothing, model, x, u) -> None:
    """Write the state and control, within its limits, on the way to the minimiser at t + 1."""
