"""Small dense linear algebra.

Loops over rows and columns have constant length where possible, so LLVM unrolls and vectorises them. Matrices are
(N, N) or, for states and controls joined, (W, W). `cholesky` reads the upper triangle only.
"""

from math import inf, sqrt

from lqrsim.kernels.declarations import M, N, W, inline, stack

SUPPORT = (0,)  # entries of (x, u) in which a cost may be nonconvex, for `project`


@inline
def copy(a, size, out):
    """Copy a vector."""
    for i in range(size):
        out[i] = a[i]


@inline
def copy_part(a, first, out, place, size):
    """Copy numbers of a vector, from the first on, to a place in another."""
    for i in range(size):
        out[place + i] = a[first + i]


@inline
def copy_matrix(a, rows, columns, out):
    """Copy a matrix."""
    for i in range(rows):
        for j in range(columns):
            out[i, j] = a[i, j]


@inline
def fill(a, size, number):
    """Set all entries of a vector to a number."""
    for i in range(size):
        a[i] = number


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


def entry(x, u, i):
    """Entry i of (x, u)."""
    return x[i] if i < N else u[i - N]


def set_entry(x, u, i, number):
    """Set entry i of (x, u)."""
    if i < N:
        x[i] = number
    else:
        u[i - N] = number


@inline
def affine(matrix, offset, x, rows, columns, out):
    """Write matrix x + offset, (rows,)."""
    for i in range(rows):
        total = offset[i]
        for j in range(columns):
            total += matrix[i, j] * x[j]
        out[i] = total


def clamp(u, limits):
    """Clamp a control to its limits; a NaN stays."""
    low, high = limits.low, limits.high
    for i in range(M):
        if u[i] < low[i]:
            u[i] = low[i]
        elif u[i] > high[i]:
            u[i] = high[i]


def cholesky(a, size):
    """Factor a = U'U in place: U in the upper triangle, reciprocals on its diagonal; False unless positive definite."""
    for k in range(size):
        if not a[k, k] > 0:  # also for a NaN
            return False
        inverse = 1 / sqrt(a[k, k])
        a[k, k] = inverse
        for j in range(k + 1, size):
            a[k, j] *= inverse
        for i in range(k + 1, size):
            multiplier = a[k, i]
            for j in range(i, size):
                a[i, j] -= multiplier * a[k, j]
    return True


def cholesky_solve(a, size, b):
    """Solve U'U y = b in place, given the factor."""
    for i in range(size):
        b[i] *= a[i, i]
        multiplier = b[i]
        for j in range(i + 1, size):
            b[j] -= a[i, j] * multiplier
    for i in range(size - 1, -1, -1):
        total = b[i]
        for j in range(i + 1, size):
            total -= a[i, j] * b[j]
        b[i] = total * a[i, i]


def about_origin(hessian, gradient, x, u, value):
    """Shift a quadratic from (x, u) to the origin: change the gradient in place, and return the constant. Eq. (27)."""
    constant = value
    for i in range(W):
        row_product = 0.0
        for j in range(N):
            row_product += hessian[i, j] * x[j]
        for j in range(M):
            row_product += hessian[i, N + j] * u[j]
        constant += (0.5 * row_product - gradient[i]) * entry(x, u, i)
        gradient[i] -= row_product
    return constant


def step_offset(jacobian, x, u, x_next, c):
    """Write c = x_next - A x - B u, (N,), the constant of a linearised step. Eq. (25)."""
    for i in range(N):
        total = x_next[i]
        for j in range(N):
            total -= jacobian[i, j] * x[j]
        for j in range(M):
            total -= jacobian[i, N + j] * u[j]
        c[i] = total


def congruence(jacobian, z, v, g, h):
    """Add `jacobian' z jacobian` to g (W, W), and `jacobian' v` to h (W,), for a symmetric z (N, N)."""
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
    """The value `1/2 c'zc + v'c`; z (N, N), v and c (N,)."""
    total = 0.0
    for i in range(N):
        row_product = 0.0
        for j in range(N):
            row_product += z[i, j] * c[j]
        total += (0.5 * row_product + v[i]) * c[i]
    return total


def project(hessian):
    """Project the SUPPORT's block of a symmetric Hessian (W, W): its negative eigenvalues become zero.

    It uses cyclic Jacobi rotations, which for the 3 x 3 blocks of obstacle costs are far faster than a call of LAPACK.
    """
    a, v = stack(len(SUPPORT), len(SUPPORT)), stack(len(SUPPORT), len(SUPPORT))
    for i in range(len(SUPPORT)):
        for j in range(len(SUPPORT)):
            a[i, j] = hessian[SUPPORT[i], SUPPORT[j]]
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off, diagonal = 0.0, 0.0
        for i in range(len(SUPPORT)):
            diagonal += a[i, i] * a[i, i]
            for j in range(i + 1, len(SUPPORT)):
                off += a[i, j] * a[i, j]
        if not off > 1e-32 * diagonal:
            break
        for i in range(len(SUPPORT) - 1):
            for j in range(i + 1, len(SUPPORT)):
                if abs(a[i, j]) > 1e-17 * (abs(a[i, i]) + abs(a[j, j])):  # smaller entries change nothing
                    theta = (a[j, j] - a[i, i]) / (2 * a[i, j])
                    tangent = (1.0 if theta >= 0 else -1.0) / (abs(theta) + sqrt(theta * theta + 1))
                    cosine = 1 / sqrt(tangent * tangent + 1)
                    sine = tangent * cosine
                    rotate_columns(a, i, j, cosine, sine)
                    rotate_columns(v, i, j, cosine, sine)
                    for k in range(len(SUPPORT)):
                        left, right = a[i, k], a[j, k]
                        a[i, k], a[j, k] = cosine * left - sine * right, sine * left + cosine * right
    indefinite = False
    for i in range(len(SUPPORT)):
        indefinite = indefinite or a[i, i] < 0
    if indefinite:
        for i in range(len(SUPPORT)):
            for j in range(len(SUPPORT)):
                total = 0.0
                for k in range(len(SUPPORT)):
                    if a[k, k] > 0:
                        total += v[i, k] * a[k, k] * v[j, k]
                hessian[SUPPORT[i], SUPPORT[j]] = total


def rotate_columns(a, i, j, cosine, sine):
    """Rotate two columns of a matrix."""
    for k in range(len(SUPPORT)):
        left, right = a[k, i], a[k, j]
        a[k, i], a[k, j] = cosine * left - sine * right, sine * left + cosine * right
