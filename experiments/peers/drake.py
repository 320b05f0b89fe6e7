"""Drake's linear-quadratic regulators, as a second opinion on gains.

All are for x'Q x + u'R u, summed or integrated over time, and x'Qf x at the end, with the law u = -K x. There are none
of the halves that `Stage` and `Quadratic` have, nor in x'S x, what is left to pay: S is the Hessian of the cost-to-go
there, and the gains there are -K.
"""

import importlib
from functools import cache
from typing import Any

import numpy as np

from lqrsim.errors import Array
from peers.common import Unavailable


def finite_horizon_gains(A: Array, B: Array, Q: Array, R: Array, Qf: Array) -> tuple[Array, Array]:
    """K (T, m, n) and S (T+1, n, n) of the steps A x + B u, with A (T, n, n) and B (T, n, m).

    Q (n, n) and R (m, m) are the same at each step, or have a leading axis T.

    By Drake's `FiniteHorizonLinearQuadraticRegulator`, which is asked for one step at a time, from a symmetric S. Asked
    for all at once it does not keep S symmetric, and what rounding leaves grows without bound where A is not stable
    enough: over the 150 steps of the quadrotor's plan by half a step, until no digit is right.

    Raises:
      Unavailable: Drake is not installed.
    """
    trajectories = _drake("trajectories")
    times = np.arange(len(A) + 1.0)  # a second each, whose multiples are exact

    def held(matrices: Array) -> Any:
        return trajectories.PiecewisePolynomial.ZeroOrderHold(times, [*matrices, matrices[-1]])

    system = _system(held(A), held(B), period=1.0)
    steps, n, m = B.shape
    Qs, Rs = np.broadcast_to(Q, (steps, n, n)), np.broadcast_to(R, (steps, m, m))
    gains, values = np.empty((steps, m, n)), np.empty((steps + 1, n, n))
    values[-1] = Qf
    for t in reversed(range(steps)):
        found = _regulator(system, Qs[t], Rs[t], values[t + 1], t, t + 1)
        gains[t], value = found.K.value(t), found.S.value(t)
        values[t] = 0.5 * (value + value.T)
    return gains, values


def continuous_gains(
    A: Array, B: Array, Q: Array, R: Array, Qf: Array, times: Array, *, accuracy: float = 1e-9
) -> tuple[Array, Array]:
    """K (T+1, m, n) and S (T+1, n, n) at the times (T+1,) in seconds, for the rate A x + B u.

    A (T+1, n, n) and B (T+1, n, m) are those of these times, and linear in between; Q and R do not change, for
    Drake takes no others.

    Raises:
      Unavailable: Drake is not installed.
    """
    trajectories = _drake("trajectories")

    def linear(matrices: Array) -> Any:
        return trajectories.PiecewisePolynomial.FirstOrderHold(times, list(matrices))

    system = _system(linear(A), linear(B))
    found = _regulator(system, Q, R, Qf, times[0], times[-1], accuracy=accuracy)
    return np.array([found.K.value(t) for t in times]), np.array([found.S.value(t) for t in times])


def stationary_gains(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """K (m, n) and S (n, n) of the step A x + B u, for ever, by Drake's `DiscreteTimeLinearQuadraticRegulator`.

    Raises:
      Unavailable: Drake is not installed.
    """
    return _drake("systems.controllers").DiscreteTimeLinearQuadraticRegulator(A, B, Q, R)


def _system(A: Any, B: Any, *, period: float = 0.0) -> Any:
    """The linear system of A and B that are trajectories; in discrete time if it has a period."""
    # It must have an output, which nothing here looks at.
    nothing = [_drake("trajectories").PiecewisePolynomial(np.zeros((1, size))) for size in (B.rows(), B.cols())]
    return _drake("systems.primitives").TrajectoryLinearSystem(A, B, *nothing, period)


def _regulator(
    system: Any, Q: Array, R: Array, Qf: Array, start: float, end: float, *, accuracy: float | None = None
) -> Any:
    """Drake's result, about zero states and controls."""
    controllers = _drake("systems.controllers")
    context, inputs = system.CreateDefaultContext(), system.get_input_port(0)
    inputs.FixValue(context, np.zeros(inputs.size()))
    options = controllers.FiniteHorizonLinearQuadraticRegulatorOptions()
    options.Qf = Qf
    if accuracy is not None:
        options.simulator_config.accuracy = accuracy
    return controllers.FiniteHorizonLinearQuadraticRegulator(system, context, start, end, Q, R, options)


@cache
def _drake(module: str) -> Any:
    try:
        return importlib.import_module(f"pydrake.{module}")
    except ImportError:
        raise Unavailable("Drake is not installed: pip install 'lqrsim[bench]'") from None
