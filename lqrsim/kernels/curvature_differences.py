"""Second derivatives of a step by central differences, where there is no formula. The kernels' subset.

The step is the fourth root of the machine's precision, as a second derivative wants it.
"""

from lqrsim.kernels.declarations import M, N, W, stack
from lqrsim.kernels.linear_algebra import moved
from lqrsim.kernels.runge_kutta import advance, step_jacobian


def step_curvature(x, u, p, h, weights, out, jacobian, hessian):
    """Write a step and its Jacobian as `runge_kutta.py` does; add `sum_i weights[i] d2 out[i] / d(x, u)2`, (W, W)."""
    step_jacobian(x, u, p, h, out, jacobian)
    z, far, ahead, behind = stack(W), stack(W), stack(W), stack(W)
    for i in range(W):
        z[i] = x[i] if i < N else u[i - N]
        far[i] = 1.2e-4 * max(1.0, abs(z[i]))
    middle = weighted(z, 0, 0.0, 0, 0.0, p, h, weights)
    for i in range(W):
        ahead[i] = weighted(z, i, far[i], i, 0.0, p, h, weights)
        behind[i] = weighted(z, i, -far[i], i, 0.0, p, h, weights)
        hessian[i, i] += (ahead[i] - 2 * middle + behind[i]) / (far[i] * far[i])
    for i in range(W):
        for j in range(i):
            both = weighted(z, i, far[i], j, far[j], p, h, weights) + weighted(z, i, -far[i], j, -far[j], p, h, weights)
            mixed = (both + 2 * middle - ahead[i] - behind[i] - ahead[j] - behind[j]) / (2 * far[i] * far[j])
            hessian[i, j] += mixed
            hessian[j, i] += mixed


def weighted(z, i, a, j, b, p, h, weights):
    """The weighted sum of where a step leads from z, the entry i moved by a and the entry j by b; less z's own."""
    x, u, out = stack(N), stack(M), stack(N)
    moved(z, i, a, j, b, x, u)
    advance(x, u, p, h, out)
    total = 0.0
    for k in range(N):
        total += weights[k] * (out[k] - x[k])  # what is linear has no curvature, and would only be rounded
    return total
