"""Small dense algebra. The kernels' subset.

The innermost loops are sums of constant length, which LLVM unrolls and turns into vector instructions. Matrices are
(N, N) or, with states and controls joined, (W, W); their upper triangle is what is read where they are symmetric.
"""

from math import inf, sqrt

from lqrsim.kernels.declarations import M, N, W, stack


def cholesky(a, size):
    """Factor a = U'U in place, upper triangle, reciprocals on the diagonal; False unless positive definite."""
    for k in range(size):
        if not a[k, k] > 0:  # a NaN too
            return False
        inverse = 1 / sqrt(a[k, k])
        a[k, k] = inverse
        for j in range(k + 1, size):
            a[k, j] *= inverse
        for i in range(k + 1, size):
            factor = a[k, i]
            for j in range(i, size):
                a[i, j] -= factor * a[k, j]
    return True


def clear(a, rows, columns):
    """Set a matrix to zero."""
    for i in range(rows):
        for j in range(columns):
            a[i, j] = 0.0


def finite(a, rows, columns):
    """Whether no entry of a matrix is NaN or infinite."""
    for i in range(rows):
        for j in range(columns):
            if not abs(a[i, j]) < inf:
                return False
    return True


def cholesky_solve(a, size, b):
    """Solve U'U y = b in place, given the factor."""
    for i in range(size):
        b[i] *= a[i, i]
        factor = b[i]
        for j in range(i + 1, size):
            b[j] -= a[i, j] * factor
    for i in range(size - 1, -1, -1):
        total = b[i]
        for j in range(i + 1, size):
            total -= a[i, j] * b[j]
        b[i] = total * a[i, i]


def moved(z, i, a, j, b, x, u):
    """Write the state and the control of z (W,), the entry i moved by a and the entry j by b."""
    for k in range(N):
        x[k] = z[k]
    for k in range(M):
        u[k] = z[N + k]
    if i < N:
        x[i] += a
    else:
        u[i - N] += a
    if j < N:
        x[j] += b
    else:
        u[j - N] += b


def about_origin(hessian, gradient, x, u, value):
    """Turn the gradient at (x, u) into the slope at the origin, in place; return the constant term. Eq. (27)."""
    constant = value
    for i in range(W):
        zi = x[i] if i < N else u[i - N]
        curved = 0.0
        for j in range(N):
            curved += hessian[i, j] * x[j]
        for j in range(M):
            curved += hessian[i, N + j] * u[j]
        constant += (0.5 * curved - gradient[i]) * zi
        gradient[i] -= curved
    return constant


def offset(jacobian, x_from, u, x_to, c):
    """Write c = x_to - A x_from - B u, the constant of a linearised step. Eq. (25)."""
    for i in range(N):
        total = x_to[i]
        for j in range(N):
            total -= jacobian[i, j] * x_from[j]
        for j in range(M):
            total -= jacobian[i, N + j] * u[j]
        c[i] = total


def congruence(jacobian, z, v, g, h):
    """Add `jacobian' z jacobian` to g (W, W) and `jacobian' v` to h (W,)."""
    product = stack(N, W)
    for i in range(N):
        for j in range(W):
            total = 0.0
            for k in range(N):
                total += z[i, k] * jacobian[k, j]
            product[i, j] = total
    for i in range(W):
        for j in range(W):
            total = g[i, j]
            for k in range(N):
                total += jacobian[k, i] * product[k, j]
            g[i, j] = total
        total = h[i]
        for k in range(N):
            total += v[k] * jacobian[k, i]
        h[i] = total


def quadratic_at(z, v, c):
    """The value `1/2 c'zc + v'c`."""
    total = 0.0
    for i in range(N):
        curved = 0.0
        for j in range(N):
            curved += z[i, j] * c[j]
        total += (0.5 * curved + v[i]) * c[i]
    return total


def affine(gain, feedforward, x, u):
    """Write u = gain x + feedforward, (M,)."""
    for i in range(M):
        total = feedforward[i]
        for j in range(N):
            total += gain[i, j] * x[j]
        u[i] = total


def within(u, limits):
    """Cut a control off at its limits; a NaN stays."""
    low, high = limits.low, limits.high
    for i in range(M):
        if u[i] < low[i]:
            u[i] = low[i]
        elif u[i] > high[i]:
            u[i] = high[i]
