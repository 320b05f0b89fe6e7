"""A Kalman filter's steps for many trials at once, and slopes along a plan. The kernels' subset.

An estimate is one row: the state x (N), what the actuators have reached (LAG: M numbers, or none), and the states of
the unknowns (D). The unknowns' values, `output` times these, are of so many parameters of the dynamics (P), and the
gain and the offset of each control.
"""

from math import nan

from lqrsim.kernels.declarations import M, N, call, outline, stack
from lqrsim.kernels.policy_evaluation import to_nearest

LAG, D, Y = 0, 1, 1  # lagging actuators, states of unknowns, measured numbers
P, Z, V = 1, 1, 1  # unknown parameters; N + LAG + D; P + 2 M
NUMBERS, HELD = 1, 1  # that the dynamics have; D, and at least 1
FAR = 1e9  # of an estimate, in its unit: nothing of a robot is


def sensor_slopes(count, states, sensor, out) -> None:
    """Write the Jacobians of the sensors at states (count, N): (count, Y, N)."""
    for t in range(count):
        for i in range(Y):
            for j in range(N):
                out[t, i, j] = 0.0
        call(sensor.slope, states[t], sensor.data, out[t])


def measurements(count, states, sensor, out) -> None:
    """Write the measurements at states (count, N): (count, Y)."""
    for t in range(count):
        call(sensor.measure, states[t], sensor.data, out[t])


def slopes_along(steps, states, controls, dynamics, dt, ahead, jacobian) -> None:
    """Write where each step of a plan leads, (steps, N), and its Jacobian [A B], (steps, N, W)."""
    for t in range(steps):
        call(dynamics.step_jacobian, states[t], controls[t], dynamics.parameters, dt, ahead[t], jacobian[t])


def parameter_slopes(steps, states, controls, dynamics, dt, which, changes, slopes) -> None:
    """Write how the steps of a plan depend on parameters, (steps, N, P), by central differences."""
    p, q, more, less = dynamics.parameters, stack(NUMBERS), stack(N), stack(N)
    for i in range(NUMBERS):
        q[i] = p[i]
    for j in range(P):
        k, h = int(which[j]), changes[j]
        for t in range(steps):
            q[k] = p[k] + h
            call(dynamics.advance, states[t], controls[t], q, dt, more)
            q[k] = p[k] - h
            call(dynamics.advance, states[t], controls[t], q, dt, less)
            for i in range(N):
                slopes[t, i, j] = (more[i] - less[i]) / (2.0 * h)
        q[k] = p[k]


def correct(count, measured, near, gain, sensor, turning, estimates, innovations) -> None:
    """Correct the estimates (count, Z) by a measurement, except those of trials that lost it.

    The states that are shown (count, N) are taken to the representatives nearest to the estimates, and these nearest to
    `near` (N,). Writes what measurements differ by from what was expected, (count, Y); NaN where they were lost.
    """
    for k in range(count):
        correct_one(measured.shown[k], measured.lost[k], near, gain, sensor, turning, estimates[k], innovations[k])


@outline
def correct_one(shown, lost, near, gain, sensor, turning, z, innovation) -> None:
    """The same for one trial, z (Z,)."""
    x, seen, expected = stack(N), stack(Y), stack(Y)
    to_nearest(z, near, turning)
    if lost != 0.0:
        for j in range(Y):
            innovation[j] = nan
        return
    for i in range(N):
        x[i] = shown[i]
    to_nearest(x, z, turning)
    call(sensor.measure, x, sensor.data, seen)
    call(sensor.measure, z, sensor.data, expected)
    for j in range(Y):
        seen[j] -= expected[j]
        innovation[j] = seen[j]
    for i in range(Z):
        total = z[i]
        for j in range(Y):
            total += gain[i, j] * seen[j]
        z[i] = total


def predict(count, controls, predictor, estimates) -> None:
    """Predict the estimates (count, Z) by one control period under the commands (count, M)."""
    for k in range(count):
        predict_one(controls[k], predictor, estimates[k])


@outline
def predict_one(control, predictor, z) -> None:
    """The same for one trial, z (Z,)."""
    p, places, lag = predictor.dynamics.parameters, predictor.places, predictor.lag
    q, v, after, value, fresh = stack(NUMBERS), stack(M), stack(N), stack(V), stack(HELD)
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
        u = control[i]
        if LAG > 0:
            behind = z[N + i] - u
            z[N + i] = u + lag[0] * behind
            u += lag[1] * behind
        v[i] = u * (1.0 + value[P + i]) + value[P + M + i]
    call(predictor.dynamics.advance, z, v, q, predictor.dt, after)
    for i in range(N):
        z[i] = after[i]
    for i in range(D):
        total = 0.0
        for j in range(D):
            total += predictor.transition[i, j] * z[N + LAG + j]
        fresh[i] = total
    for i in range(D):
        z[N + LAG + i] = fresh[i]


def command(count, estimates, near, law, limits, turning, out) -> None:
    """Controls (count, M) within the limits, of the estimates, whose angles are taken nearest to `near`."""
    for k in range(count):
        command_one(estimates[k], near, law, limits, turning, out[k])


@outline
def command_one(z, near, law, limits, turning, u) -> None:
    """The same for one trial, z (Z,) and u (M,)."""
    to_nearest(z, near, turning)
    for j in range(M):
        total = law.offset[j]
        for i in range(Z):
            total += law.gain[j, i] * z[i]
        u[j] = min(max(total, limits.low[j]), limits.high[j])


def diverged(count, estimates, out) -> None:
    """Write the first entry of each estimate that is not finite or beyond `FAR`, (count,); Z if there is none."""
    for k in range(count):
        out[k] = Z
        for i in range(Z - 1, -1, -1):
            if not abs(estimates[k, i]) <= FAR:
                out[k] = i
