"""Second derivatives of a step by central differences of its Jacobian, where their formula would be too long.

The kernels' subset. The step is the cube root of the machine's precision, as in `finite_differences.py`.
"""

from lqrsim.kernels.declarations import M, N, W, stack
from lqrsim.kernels.runge_kutta import step_jacobian


def step_curvature(x, u, p, h, weights, out, jacobian, hessian):
    """Write a step and its Jacobian as `runge_kutta.py` does; add `sum_i weights[i] d2 out[i] / d(x, u)2`, (W, W)."""
    y, v, spare = stack(N), stack(M), stack(N)
    for i in range(N):
        y[i] = x[i]
    for i in range(M):
        v[i] = u[i]
    for j in range(W):
        z = x[j] if j < N else u[j - N]
        far = 6e-6 * max(1.0, abs(z))
        for side in range(2):
            moved = z + far if side == 0 else z - far
            if j < N:
                y[j] = moved
            else:
                v[j - N] = moved
            step_jacobian(y, v, p, h, spare, jacobian)
            share = 0.25 / far if side == 0 else -0.25 / far  # half of the difference's, for both triangles get it
            for k in range(W):
                total = 0.0
                for i in range(N):
                    total += weights[i] * jacobian[i, k]
                hessian[j, k] += share * total
                hessian[k, j] += share * total
        if j < N:
            y[j] = z
        else:
            v[j - N] = z
    step_jacobian(x, u, p, h, out, jacobian)
