"""What a compiled core knows about its problem: the names that the kernels are written against.

The modules of the numba subset, with one of `cost_to_come_dual.py` and `cost_to_come_primal.py`, and the sources that
dynamics and costs write are joined into one text for each structure (see `solvers/compiled.py`), with these sizes as
constants and these functions filled in. This module only declares them, so that each of those files can be read, linted
and type-checked on its own.
"""

import numpy as np

N = 0  # states
M = 0  # controls
W = N + M  # a state and a control, joined
K = 0  # of these, how many entries a cost is not convex in
NOISY = 0  # 1 for a problem with noise: what `if NOISY` guards is not in the cores of others

# How iterations end; see `Status`. Of those without a status of their own, NO_START is a first trajectory that is not
# finite, STALLED a line search that found no lower cost, CYCLING that the same costs come again and again, and
# NO_PROGRESS that the least cost so far does not fall. TIMED_OUT is for the drivers: no kernel looks at a clock.
# RISK_TOO_HIGH is a pass that failed because no expectation exists.
RUNNING, CONVERGED, COST_CONVERGED, MAX_ITERATIONS, DIVERGED = 0, 1, 2, 3, 4
NOT_POSITIVE_DEFINITE, NOT_FINITE, NO_START, STALLED, CYCLING = 5, 6, 7, 8, 9
NO_PROGRESS, TIMED_OUT, RISK_TOO_HIGH = 10, 11, 12
LONGEST_CYCLE = 8
# After how many iterations without a lower cost, and after how many in which it fell by less than a thousandth, there
# is no progress. `python experiments/benchmark_reliability.py --sections overhead` shows that neither is met where the
# method converges on the paper's queries.
NO_FALL, SLOW_FALL = 12, 30
ROW = 16  # numbers that an obstacle takes in `World.table`: kind, position (3), rotation (9, row by row), size (3)
HEADER = 4  # numbers that come before the multipliers; see `augmented_lagrangian.py`

# What an entry is to do; see `entry_points.py`.
ITERATE, DAMP, CERTIFY, EVALUATE = 0, 1, 2, 3

# What an iteration was; see `Iteration.method`.
SMOOTH, DAMPED, REJECTED, ILQR = 0, 1, 2, 3

# After how many damped iterations without an end iLQR has its turn.
PATIENCE = 50


def stack(*shape: int) -> np.ndarray:
    """An uninitialised float64 array of constant shape, on the stack of the compiled function."""
    return np.empty(shape)


def invoke(address, x, u, data, out) -> None:
    """Call the user's function at an address: it writes what it returns."""


def invoke_writing(address, x, u, data, first, second) -> None:
    """Call the user's function at an address that writes to two arrays, which it gets as they are."""


# Memory and functions of a C library; see `codegen/foreign.py`.


def at(address):
    """The float64 numbers at an address."""
    return np.empty(0)


def rows_at(address, width: int):
    """The same as rows of a constant width."""
    return np.empty((0, width))


def call(function, first, second) -> None:
    """Call the C function at an address with two pointers."""


def call_with_two(function, first, second, third: int, fourth: int) -> None:
    """Call the C function at an address with two pointers and two ints."""


def call_alone(function) -> None:
    """Call the C function at an address that takes nothing."""


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


def rate(x, u, p, out) -> None:
    """Write xdot = f(x, u), (N,)."""


def rate_jacobian(x, u, p, out, fx, fu) -> None:
    """Write f (N,), and the entries of df/dx (N, N) and df/du (N, M) that are not zero everywhere."""


def stage_value(x, u, t, data) -> float:
    """The stage cost c(x, u, t)."""
    return 0.0


def stage_quadratic(x, u, t, data, hessian, gradient) -> float:
    """Write the projected Hessian (W, W) and the gradient (W,) of the stage cost at (x, u); return its value."""
    return 0.0


def stage_added(x, u, t, data) -> float:
    """What the augmented Lagrangian adds to the stage cost for constraints."""
    return 0.0


def final_added(x, u, t, data) -> float:
    """What it adds to the final cost."""
    return 0.0


def constraint_value(x, u, t, row, data) -> float:
    """One of a constraint's numbers, which are not to be negative, or to be zero."""
    return 0.0


def constraint_slope(x, u, t, row, data, gradient) -> None:
    """Add its gradient (W,)."""


def places(x, data, out) -> None:
    """Write where the balls of a robot are, three coordinates each, ball by ball."""


def places_jacobian(x, data, out, slopes) -> None:
    """Write these, and those of their derivatives in the states (..., N) that are not zero everywhere."""


def initial_value(x, u, t, data) -> float:
    """The initial cost c_0(x)."""
    return 0.0


def initial_quadratic(x, u, t, data, hessian, gradient) -> float:
    """As `stage_quadratic`, of the initial cost."""
    return 0.0


def final_value(x, u, t, data) -> float:
    """The final cost c_l(x)."""
    return 0.0


def final_quadratic(x, u, t, data, hessian, gradient) -> float:
    """As `stage_quadratic`, of the final cost."""
    return 0.0


def noise_values(x, u, data, out) -> None:
    """Write M(x, u), the rows of it that `noise.py` takes."""


def noise_slopes(x, u, data, out, slopes) -> None:
    """Write these, and their derivatives, column by column, in the entries of (x, u) that `noise.py` takes."""


def noise_value(x, u, model, ahead) -> float:
    """What noise is expected to cost at (x, u); see `noise.py`."""
    return 0.0


def noise_quadratic(x, u, model, ahead, convex, stage) -> float:
    """The same, and its quadratic model added to the stage."""
    return 0.0


# What the form of the cost-to-come brings; see `cost_to_come_dual.py`, `cost_to_come_primal.py` and `records.py`.


def initial_cost_to_come(Q, q, constant, x, to_go, to_come) -> tuple[float, bool]:
    """Write the cost-to-come at 0."""
    return 0.0, True


def linearize(x, u, model, slopes, step) -> None:
    """Write where (x, u) leads, and the linearised step that `riccati_forward` takes."""


def forward_jacobian(x, u, model, slopes, step, spare):
    """The Jacobian (N, W) of the step forwards, after `linearize`; `spare` may be written to."""
    return step.jacobian


def riccati_forward(t, step, stage, constant, to_come, smoothing) -> bool:
    """One step of the cost-to-come, from t to t + 1."""
    return True


def minimizer(t, to_go, to_come, costate, x) -> bool:
    """Write the minimiser of the total cost at t, and the costate there."""
    return True


def backtrack(t, x_hat, costate, smoothing, model, x, u) -> None:
    """Write the state and control, within its limits, on the way to the minimiser at t + 1."""
