"""The nearest positive-semidefinite matrix. The kernels' subset."""

from math import sqrt

from lqrsim.kernels.declarations import stack

SUPPORT = (0,)  # the entries of (x, u) in which a cost may not be convex
K = 1  # how many these are


def project(hessian):
    """Set the negative eigenvalues of the symmetric block of `hessian` (W, W) on the SUPPORT to zero.

    Cyclic Jacobi rotations: for the 3 x 3 blocks of obstacle costs far faster than a call to LAPACK.
    """
    a, v = stack(K, K), stack(K, K)
    for i in range(K):
        for j in range(K):
            a[i, j] = hessian[SUPPORT[i], SUPPORT[j]]
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off, diagonal = 0.0, 0.0
        for i in range(K):
            diagonal += a[i, i] * a[i, i]
            for j in range(i + 1, K):
                off += a[i, j] * a[i, j]
        if not off > 1e-32 * diagonal:
            break
        for i in range(K - 1):
            for j in range(i + 1, K):
                if abs(a[i, j]) > 1e-17 * (abs(a[i, i]) + abs(a[j, j])):  # what is smaller changes nothing
                    theta = (a[j, j] - a[i, i]) / (2 * a[i, j])
                    tangent = (1.0 if theta >= 0 else -1.0) / (abs(theta) + sqrt(theta * theta + 1))
                    cosine = 1 / sqrt(tangent * tangent + 1)
                    sine = tangent * cosine
                    for k in range(K):
                        left, right = a[k, i], a[k, j]
                        a[k, i], a[k, j] = cosine * left - sine * right, sine * left + cosine * right
                    for k in range(K):
                        left, right = a[i, k], a[j, k]
                        a[i, k], a[j, k] = cosine * left - sine * right, sine * left + cosine * right
                    for k in range(K):
                        left, right = v[k, i], v[k, j]
                        v[k, i], v[k, j] = cosine * left - sine * right, sine * left + cosine * right
    indefinite = False
    for i in range(K):
        indefinite = indefinite or a[i, i] < 0
    if indefinite:
        for i in range(K):
            for j in range(K):
                total = 0.0
                for k in range(K):
                    if a[k, k] > 0:
                        total += v[i, k] * a[k, k] * v[j, k]
                hessian[SUPPORT[i], SUPPORT[j]] = total
