"""Both passes of a linear-quadratic problem, whose stages are given. The numba subset; see `interface.py`."""

from lqrsim.kernels.interface import N, W, minimizer, riccati_forward, stack
from lqrsim.kernels.linear_algebra import riccati_backward


def lq_passes(
    steps, jacobian, c, inverse, c_inverse, cost, slope, constant,
    L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, x_hats,
):  # fmt: skip
    """The backward pass from (S[T], s[T], k[T]), the forward pass from (C[0], b[0], kbar[0]), and the minimisers.

    `jacobian` (T, N, W) = [A B] and c (T, N) are the steps, `inverse` and `c_inverse` what the form's forward pass
    takes; `cost` (T, W, W), `slope` (T, W) and `constant` (T,) the stages. Returns the step that failed, or -1, and of
    which: 0 the backward pass, 1 the forward pass, 2 the minimum of their sum.
    """
    hessian, gradient, costate = stack(W, W), stack(W), stack(N)
    for t in range(steps - 1, -1, -1):
        take(cost[t], slope[t], hessian, gradient)
        k[t], good = riccati_backward(
            jacobian[t], c[t], hessian, gradient, constant[t], S[t + 1], s[t + 1], k[t + 1], L[t], l[t], S[t], s[t]
        )
        if not good:
            return t, 0
    for t in range(steps):
        take(cost[t], slope[t], hessian, gradient)
        kbar[t + 1], good = riccati_forward(
            inverse[t], c_inverse[t], hessian, gradient, constant[t], C[t], b[t], kbar[t], G[t], a[t], Lbar[t], lbar[t],
            C[t + 1], b[t + 1],
        )  # fmt: skip
        if not good:
            return t, 1
    for t in range(steps + 1):
        if not minimizer(S[t], s[t], C[t], b[t], costate, x_hats[t]):
            return t, 2
    return -1, 0


def take(cost, slope, hessian, gradient):
    """Copy a stage, for the Riccati steps use theirs up."""
    for i in range(W):
        gradient[i] = slope[i]
        for j in range(W):
            hessian[i, j] = cost[i, j]
