"""One Runge-Kutta step with the control held, and its Jacobian. The numba subset; see `solvers/interface.py`.

A negative `h` steps backwards in time: the approximate inverse `gbar` of the step, exact to O(h^5).
"""

from lqrsim.solvers.interface import M, N, W, rate, rate_jacobian, stack


def step(x, u, p, h, out):
    """Write x after `h` seconds, (N,)."""
    k1, k2, k3, k4, z = stack(N), stack(N), stack(N), stack(N), stack(N)
    rate(x, u, p, k1)
    for i in range(N):
        z[i] = x[i] + 0.5 * h * k1[i]
    rate(z, u, p, k2)
    for i in range(N):
        z[i] = x[i] + 0.5 * h * k2[i]
    rate(z, u, p, k3)
    for i in range(N):
        z[i] = x[i] + h * k3[i]
    rate(z, u, p, k4)
    for i in range(N):
        out[i] = x[i] + h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i])


def chain(fx, fu, previous, a, out):
    """Write `fx ([1 0] + a previous) + [0 fu]`, (N, W): the slope of one Runge-Kutta stage in (x, u)."""
    for i in range(N):
        for j in range(N):
            out[i, j] = fx[i, j]
        for j in range(M):
            out[i, N + j] = fu[i, j]
        if a != 0:
            for k in range(N):
                # Most systems couple few states: skipping the zeros halves the time of an iteration.
                if fx[i, k] != 0:
                    factor = a * fx[i, k]
                    for j in range(W):
                        out[i, j] += factor * previous[k, j]


def step_jacobian(x, u, p, h, fx, fu, out, jacobian):
    """Write the step as above and its Jacobian `[A B]` (N, W); `fx`, `fu` are work arrays whose zeros are set."""
    k, z = stack(N), stack(N)
    first, second = stack(N, W), stack(N, W)
    rate_jacobian(x, u, p, k, fx, fu)
    chain(fx, fu, first, 0.0, first)
    for i in range(N):
        out[i] = k[i]
        z[i] = x[i] + 0.5 * h * k[i]
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
