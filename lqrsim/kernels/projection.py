"""The nearest positive-semidefinite matrix."""

from math import sqrt

from lqrsim.kernels.declarations import stack

SUPPORT = (0,)  # entries of (x, u) in which a cost may be nonconvex


def project(hessian):
    """Set the negative eigenvalues of the SUPPORT's block of a symmetric Hessian (W, W) to zero.

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
