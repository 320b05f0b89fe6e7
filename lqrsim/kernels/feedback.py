"""Feedback for many trials at once: a policy, and the steps of a Kalman filter. `AffinePolicy` does the first in NumPy.

An estimate is one row of Z numbers: the state x (N), the actuators' lagging controls (LAG: M numbers, or none), and the
states of the unknowns' model (D). `output` maps these D states to the V = P + 2 M unknowns: changes of P parameters of
the dynamics, and of the gain and the offset of each control.
"""

from math import floor, nan, pi, sqrt

from lqrsim.kernels.declarations import M, N, call, outline, stack
from lqrsim.kernels.linear_algebra import affine, clear, copy, copy_part, fill
from lqrsim.kernels.riccati import limited_control

LAG, D, Y = 0, 1, 1  # counts of lagging controls, states of unknowns, measured numbers
P, Z, V = 1, 1, 1  # unknown parameters; N + LAG + D; P + 2 M
NUMBERS, PADDED_D = 1, 1  # number of parameters of the dynamics; D, but at least 1
FAR = 1e9  # an entry of an estimate beyond this has diverged, whatever its unit


def sensor_slopes(count, states, sensor, out):
    """Write the Jacobians (count, Y, N) of the measurement at states (count, N)."""
    for t in range(count):
        clear(out[t], Y, N)
        call(sensor.slope, states[t], sensor.data, out[t])


def measurements(count, states, sensor, out):
    """Write the measurements (count, Y) at states (count, N)."""
    for t in range(count):
        call(sensor.measure, states[t], sensor.data, out[t])


def slopes_along(steps, states, controls, dynamics, dt, arrived, jacobian):
    """Write the next state (steps, N) and the Jacobian [A B] (steps, N, W) of each step of a plan."""
    for t in range(steps):
        call(dynamics.step_jacobian, states[t], controls[t], dynamics.parameters, dt, arrived[t], jacobian[t])


def parameter_slopes(steps, states, controls, dynamics, dt, parameter_indices, changes, slopes):
    """Write the derivatives (steps, N, P) of the steps of a plan in parameters, by differences with `changes` (P,)."""
    p, q, more, less = dynamics.parameters, stack(NUMBERS), stack(N), stack(N)
    copy(p, NUMBERS, q)
    for j in range(P):
        k, h = int(parameter_indices[j]), changes[j]
        for t in range(steps):
            q[k] = p[k] + h
            call(dynamics.advance, states[t], controls[t], q, dt, more)
            q[k] = p[k] - h
            call(dynamics.advance, states[t], controls[t], q, dt, less)
            for i in range(N):
                slopes[t, i, j] = (more[i] - less[i]) / (2.0 * h)
        q[k] = p[k]


def correct(count, measured, lost, nominal, gain, limit, limit_factors, sensor, angular, estimates, innovations):
    """Update estimates (count, Z) with measurements, except where these were lost.

    Args:
      measured: (count, N) measured states, of which the representatives nearest to the estimates count.
      lost: (count,) 1 where a measurement was lost, else 0.
      nominal: (N,) a state; the estimates are first replaced by the representatives nearest to it. gain: (Z, Y).
      limit: (D,) largest corrections of the unknowns' states; if one is exceeded, all of these are scaled down.
      limit_factors: (count,) factors on the limit, doubled where it is exceeded, and 1 again after the next correction
        within it.
      innovations: (count, Y) measurements minus expectations, written; NaN where the measurement was lost.
    """
    for k in range(count):
        z, innovation = estimates[k], innovations[k]
        fraction = correct_one(
            measured[k], lost[k], nominal, gain, limit, limit_factors[k], sensor, angular, z, innovation
        )
        if fraction < 1.0:
            limit_factors[k] *= 2.0
        elif lost[k] == 0.0:
            limit_factors[k] = 1.0


@outline
def correct_one(measured, lost, nominal, gain, limit, limit_factor, sensor, angular, z, innovation):
    """Update the estimate z (Z,) of one trial. Returns the fraction of the unknowns' correction that was made."""
    x, seen, expected, corrected = stack(N), stack(Y), stack(Y), stack(Z)
    fraction = 1.0
    to_nearest(z, nominal, angular)
    if lost != 0.0:
        fill(innovation, Y, nan)
        return fraction
    copy(measured, N, x)
    to_nearest(x, z, angular)
    call(sensor.measure, x, sensor.data, seen)
    call(sensor.measure, z, sensor.data, expected)
    for j in range(Y):
        innovation[j] = seen[j] - expected[j]
    for i in range(Z):
        total = z[i]
        for j in range(Y):
            total += gain[i, j] * innovation[j]
        corrected[i] = total
    for i in range(D):
        change = abs(corrected[N + LAG + i] - z[N + LAG + i])
        if change * fraction > limit_factor * limit[i]:
            fraction = limit_factor * limit[i] / change
    for i in range(Z):
        if fraction < 1.0 and i >= N + LAG:
            z[i] += fraction * (corrected[i] - z[i])
        else:
            z[i] = corrected[i]
    return fraction


def predict(count, controls, predictor, estimates):
    """Predict estimates (count, Z) over one control period, under the commanded controls (count, M)."""
    for k in range(count):
        predict_one(controls[k], predictor, estimates[k])


@outline
def predict_one(control, predictor, z):
    """Predict the estimate z (Z,) of one trial."""
    p, parameter_indices, lag = predictor.dynamics.parameters, predictor.parameter_indices, predictor.lag
    q, v, after, value, next_states = stack(NUMBERS), stack(M), stack(N), stack(V), stack(PADDED_D)
    for i in range(V):
        total = 0.0
        for j in range(D):
            total += predictor.output[i, j] * z[N + LAG + j]
        value[i] = total
    copy(p, NUMBERS, q)
    for i in range(P):
        q[int(parameter_indices[i])] += value[i]
    for i in range(M):
        u = control[i]
        if LAG > 0:
            behind = z[N + i] - u
            z[N + i] = u + lag[0] * behind
            u += lag[1] * behind
        v[i] = u * (1.0 + value[P + i]) + value[P + M + i]
    call(predictor.dynamics.advance, z, v, q, predictor.dt, after)
    copy(after, N, z)
    for i in range(D):
        total = 0.0
        for j in range(D):
            total += predictor.transition[i, j] * z[N + LAG + j]
        next_states[i] = total
    copy_part(next_states, 0, z, N + LAG, D)


def command(count, estimates, nominal, policy, limits, angular, out):
    """Write the controls (count, M), within their limits, of a policy with gains (M, Z) on the estimates (count, Z).

    The estimates' angles are replaced by the representatives nearest to `nominal` (N,).
    """
    for k in range(count):
        command_one(estimates[k], nominal, policy, limits, angular, out[k])


@outline
def command_one(z, nominal, policy, limits, angular, u):
    """Write the control u (M,) of one trial's estimate z (Z,)."""
    to_nearest(z, nominal, angular)
    affine(policy.gain, policy.offset, z, M, Z, u)
    for j in range(M):
        u[j] = min(max(u[j], limits.low[j]), limits.high[j])


def diverged(count, estimates, out):
    """Write the first entry of each estimate that is not finite or beyond `FAR`, (count,); Z if there is none."""
    for k in range(count):
        out[k] = Z
        for i in range(Z - 1, -1, -1):
            if not abs(estimates[k, i]) <= FAR:
                out[k] = i


def apply_policy(count, states, policy, nominal, angular, limits, out):
    """Write the controls (count, M), within their limits, at states (count, N).

    The states are overwritten by their representatives nearest to the nominal (N,).
    """
    for k in range(count):
        apply_one(states[k], policy, nominal, angular, limits, out[k])


@outline
def apply_one(x, policy, nominal, angular, limits, u):
    """Write the control (M,) at one state (N,)."""
    to_nearest(x, nominal, angular)
    limited_control(policy.gain, policy.offset, x, limits, u)


def all_to_nearest(steps, count, states, nominal, angular):
    """Replace states (steps count, N) by their representatives nearest to the nominal of their step, (steps, N)."""
    for t in range(steps):
        for k in range(count):
            to_nearest(states[t * count + k], nominal[t], angular)


@outline
def to_nearest(x, nominal, angular):
    """Replace a state by its representative nearest to the nominal: its angles and its rotation vectors."""
    for k in range(angular.angle_count):  # to within half a turn
        i = int(angular.angles[k])
        x[i] -= 2.0 * pi * floor((x[i] - nominal[i]) / (2.0 * pi) + 0.5)
    for k in range(angular.rotation_count):
        nearest_rotation(x, nominal, int(angular.rotations[k, 0]), int(angular.rotations[k, 1]))


def nearest_rotation(x, nominal, first, turn):
    """Replace the rotation vector at x[first] by the equivalent (angle + 2 pi k) axis that is nearest to the nominal.

    If `turn` is 0 to 2, that entry is a separate angle and is left alone; -1 if there is none. See coordinates.py.
    """
    axis, reference, square, reference_square, along = stack(3), stack(3), 0.0, 0.0, 0.0
    for i in range(3):
        axis[i], reference[i] = 0.0, 0.0
        if i != turn:
            axis[i], reference[i] = x[first + i], nominal[first + i]
        square += axis[i] * axis[i]
        reference_square += reference[i] * reference[i]
    angle, reference_length = sqrt(square), sqrt(reference_square)
    for i in range(3):
        if angle < 1e-12:  # the identity has every axis
            axis[i] = reference[i] / reference_length if reference_length > 0.0 else 0.0
        else:
            axis[i] /= angle
        along += axis[i] * reference[i]
    turns = floor((along - angle) / (2.0 * pi) + 0.5)
    if turns != 0:
        for i in range(3):
            if i != turn:
                x[first + i] = (angle + 2.0 * pi * turns) * axis[i]
