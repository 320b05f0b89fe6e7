"""Derivatives of a cost by central differences, where there are none. The kernels' subset.

The step is the fourth root of the machine's precision, as a second derivative wants it.
"""

from lqrsim.kernels.declarations import M, N, W, stack
from lqrsim.kernels.function_cost import value
from lqrsim.kernels.linear_algebra import moved

AXES = (0,)  # the entries of (x, u) that the cost depends on


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, and return the cost."""
    z, h, ahead, behind = stack(W), stack(W), stack(W), stack(W)
    for i in range(W):
        z[i] = x[i] if i < N else u[i - N]
        h[i] = 1.2e-4 * max(1.0, abs(z[i]))
    middle = value(x, u, t, data)
    for i in range(len(AXES)):
        a = AXES[i]
        ahead[a] = shifted(z, a, h[a], a, 0.0, t, data)
        behind[a] = shifted(z, a, -h[a], a, 0.0, t, data)
        gradient[a] += (ahead[a] - behind[a]) / (2 * h[a])
        hessian[a, a] += (ahead[a] - 2 * middle + behind[a]) / (h[a] * h[a])
    for i in range(len(AXES)):
        for j in range(i):
            a, b = AXES[i], AXES[j]
            both = shifted(z, a, h[a], b, h[b], t, data) + shifted(z, a, -h[a], b, -h[b], t, data)
            mixed = (both + 2 * middle - ahead[a] - behind[a] - ahead[b] - behind[b]) / (2 * h[a] * h[b])
            hessian[a, b] += mixed
            hessian[b, a] += mixed
    return middle


def shifted(z, i, a, j, b, t, data):
    """The cost at z, the entry i moved by a and the entry j by b."""
    x, u = stack(N), stack(M)
    moved(z, i, a, j, b, x, u)
    return value(x, u, t, data)
