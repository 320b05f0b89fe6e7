"""A Kalman filter's steps for many trials at once, and slopes along a plan. The numba subset; see `declarations.py`.

An estimate is one row: the state x (N), what the actuators have reached (LAG: M numbers, or none), and the states of
the unknowns (D). The unknowns' values, `output` times these, are of so many parameters of the dynamics (P), and the
gain and the offset of each control.
"""

from math import nan

from lqrsim.kernels.declarations import M, N, stack
from lqrsim.kernels.policy_evaluation import turn
from lqrsim.kernels.runge_kutta import advance, step_jacobian

LAG, D, Y = 0, 1, 1  # lagging actuators, states of unknowns, measured numbers; each core has its own
P, Z, V = 1, 1, 1  # unknown parameters; N + LAG + D; P + 2 M
NUMBERS, HELD = 1, 1  # that the dynamics have; D, and at least 1
FAR = 1e9  # of an estimate, in its unit: nothing of a robot is


def measure(x, data, out) -> None:
    """Write what the sensors say of a state, (Y,); each system's is written for it."""


def measure_slope(x, data, out) -> None:
    """Write its Jacobian, (Y, N)."""


# The numba subset.


def sensor_slopes(count, states, data, out) -> None:
    """Write the Jacobians of the sensors at states (count, N): (count, Y, N)."""
    for t in range(count):
        for i in range(Y):
            for j in range(N):
                out[t, i, j] = 0.0
        measure_slope(states[t], data, out[t])


def slopes_along(steps, states, controls, p, dt, ahead, jacobian) -> None:
    """Write where each step of a plan leads, (steps, N), and its Jacobian [A B], (steps, N, W)."""
    fx, fu = stack(N, N), stack(N, M)
    for i in range(N):
        for j in range(N):
            fx[i, j] = 0.0
        for j in range(M):
            fu[i, j] = 0.0
    for t in range(steps):
        step_jacobian(states[t], controls[t], p, dt, fx, fu, ahead[t], jacobian[t])


def parameter_slopes(steps, states, controls, p, dt, which, changes, slopes) -> None:
    """Write how the steps of a plan depend on parameters, (steps, N, P), by central differences."""
    q, more, less = stack(NUMBERS), stack(N), stack(N)
    for i in range(NUMBERS):
        q[i] = p[i]
    for j in range(P):
        k, h = int(which[j]), changes[j]
        for t in range(steps):
            q[k] = p[k] + h
            advance(states[t], controls[t], q, dt, more)
            q[k] = p[k] - h
            advance(states[t], controls[t], q, dt, less)
            for i in range(N):
                slopes[t, i, j] = (more[i] - less[i]) / (2.0 * h)
        q[k] = p[k]


def correct(count, shown, lost, near, gain, data, estimates, innovations) -> None:
    """Take a measurement into the estimates (count, Z), but where it was lost: lost (count,) is 1 there.

    The states that are shown (count, N) are taken to the representatives nearest to the estimates, and these nearest to
    `near` (N,). Writes what measurements differ by from what was expected, (count, Y); NaN where they were lost.
    """
    x, seen, expected = stack(N), stack(Y), stack(Y)
    for k in range(count):
        z = estimates[k]
        turn(z, near)
        if lost[k] != 0.0:
            for j in range(Y):
                innovations[k, j] = nan
            continue
        for i in range(N):
            x[i] = shown[k, i]
        turn(x, z)
        measure(x, data, seen)
        measure(z, data, expected)
        for j in range(Y):
            seen[j] -= expected[j]
            innovations[k, j] = seen[j]
        for i in range(Z):
            total = z[i]
            for j in range(Y):
                total += gain[i, j] * seen[j]
            z[i] = total


def predict(count, controls, predictor, estimates) -> None:
    """Take the estimates (count, Z) one control period on, in which the controls (count, M) are commanded."""
    p, places, lag = predictor.parameters, predictor.places, predictor.lag
    q, v, after, value, fresh = stack(NUMBERS), stack(M), stack(N), stack(V), stack(HELD)
    for k in range(count):
        z = estimates[k]
        for i in range(V):
            total = 0.0
            for j in range(D):
                total += predictor.output[i, j] * z[N + LAG + j]
            value[i] = total
        for i in range(NUMBERS):
            q[i] = p[i]
        for i in range(P):
            q[int(places[i])] += value[i]
        for i in range(M):
            u = controls[k, i]
            if LAG > 0:
                behind = z[N + i] - u
                z[N + i] = u + lag[0] * behind
                u += lag[1] * behind
            v[i] = u * (1.0 + value[P + i]) + value[P + M + i]
        advance(z, v, q, predictor.dt, after)
        for i in range(N):
            z[i] = after[i]
        for i in range(D):
            total = 0.0
            for j in range(D):
                total += predictor.transition[i, j] * z[N + LAG + j]
            fresh[i] = total
        for i in range(D):
            z[N + LAG + i] = fresh[i]


def command(count, estimates, near, law, limits, out) -> None:
    """Controls (count, M) within the limits, of the estimates, whose angles are taken nearest to `near`."""
    for k in range(count):
        z = estimates[k]
        turn(z, near)
        for j in range(M):
            total = law.offset[j]
            for i in range(Z):
                total += law.gain[j, i] * z[i]
            out[k, j] = min(max(total, limits.low[j]), limits.high[j])


def diverged(count, estimates, out) -> None:
    """Write which entry of each estimate is the first that is not finite or beyond `FAR`, (count,); Z where none is."""
    for k in range(count):
        out[k] = Z
        for i in range(Z - 1, -1, -1):
            if not abs(estimates[k, i]) <= FAR:
                out[k] = i
