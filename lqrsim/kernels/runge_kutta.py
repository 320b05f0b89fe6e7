"""One Runge-Kutta step with the control held, and its Jacobian.

A negative `h` steps backwards in time: the approximate inverse `gbar` of the step, exact to O(h^5).
"""

from lqrsim.kernels.declarations import M, N, W, compact, rate, rate_jacobian, stack, zeros


def advance(x, u, p, h, out):
    """Write the state (N,) after `h` seconds."""
    z, k = stack(N), stack(N)
    for i in range(N):
        out[i] = z[i] = x[i]
    for stage in range(4):
        weight = h / 6 if stage == 0 or stage == 3 else h / 3
        ahead = 0.5 * h if stage < 2 else h
        rate(z, u, p, k)
        for i in range(N):
            out[i] += weight * k[i]
            z[i] = x[i] + ahead * k[i]


def chain(fx, fu, previous, a, out):
    """Write `fx ([1 0] + a previous) + [0 fu]`, (N, W): the Jacobian of one Runge-Kutta stage in (x, u).

    Dynamics with known zeros have their own `chain`; see `write_chain` in `codegen/symbolic.py`.

    Args:
      fx: (N, N). fu: (N, M). previous: (N, W) of the previous stage. a: time of the stage after x, in s.
    """
    row = stack(W)  # a local array instead of out[i] stays in registers
    for i in range(N):
        for j in range(N):
            row[j] = fx[i, j]
        for j in range(M):
            row[N + j] = fu[i, j]
        for k in range(N):
            if fx[i, k] != 0:  # most systems couple few states
                factor = a * fx[i, k]
                for j in range(W):
                    row[j] += factor * previous[k, j]
        for j in range(W):
            out[i, j] = row[j]


def step_jacobian(x, u, p, h, out, jacobian):
    """Write the state (N,) after `h` seconds, and its Jacobian `[A B]` (N, W).

    The four stages are written out, because a loop over them is slower.
    """
    k, z = stack(N), stack(N)
    fx, fu, first, second = zeros(N, N), zeros(N, M), stack(N, W), stack(N, W)
    rate_jacobian(x, u, p, k, fx, fu)
    for i in range(N):
        out[i] = k[i]
        z[i] = x[i] + 0.5 * h * k[i]
        for j in range(N):
            first[i, j] = fx[i, j]
        for j in range(M):
            first[i, N + j] = fu[i, j]
        for j in range(W):
            jacobian[i, j] = first[i, j]
    rate_jacobian(z, u, p, k, fx, fu)
    chain(fx, fu, first, 0.5 * h, second)
    for i in range(N):
        out[i] += 2 * k[i]
        z[i] = x[i] + 0.5 * h * k[i]
        for j in range(W):
            jacobian[i, j] += 2 * second[i, j]
    rate_jacobian(z, u, p, k, fx, fu)
    chain(fx, fu, second, 0.5 * h, first)
    for i in range(N):
        out[i] += 2 * k[i]
        z[i] = x[i] + h * k[i]
        for j in range(W):
            jacobian[i, j] += 2 * first[i, j]
    rate_jacobian(z, u, p, k, fx, fu)
    chain(fx, fu, first, h, second)
    for i in range(N):
        out[i] = x[i] + h / 6 * (out[i] + k[i])
        for j in range(W):
            jacobian[i, j] = h / 6 * (jacobian[i, j] + second[i, j])
        jacobian[i, i] += 1


@compact
def state_jacobians(count, states, controls, p, slopes):
    """Write df/dx to slopes (count, N, N), which are zero on entry, at states (count, N) and controls (count, M)."""
    for t in range(count):
        k, fu = stack(N), zeros(N, M)
        rate_jacobian(states[t], controls[t], p, k, slopes[t], fu)
