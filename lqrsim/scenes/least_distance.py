"""The shortest vector that satisfies inequalities, by non-negative least squares."""

import contextlib

import numpy as np

from lqrsim.errors import Array

_OFF = 1e-9  # slope that is no rounding, relative to the lengths of column and target


def least_distance(rows: Array, least: Array) -> tuple[Array, Array]:
    """For the shortest y (n,) with `rows y >= least`: a residual (n+1,) and forces (K,) of the rows, not negative.

    y is -residual[:-1] / residual[-1], a sum of rows times their multipliers -forces / residual[-1]. If no y satisfies
    all rows, the residual is zero. Lawson and Hanson, Solving Least Squares Problems, ch. 23.
    """
    matrix, target = np.vstack([rows.T, least]), np.append(np.zeros(rows.shape[1]), 1.0)
    forces = nonnegative_least_squares(matrix, target)
    return matrix @ forces - target, forces


def nonnegative_least_squares(matrix: Array, target: Array) -> Array:
    """The x >= 0 (K,) with the least |matrix x - target|.

    SciPy's `nnls` is ten times as fast as its other solver, but may end elsewhere: scipy/scipy#25389.
    """
    from scipy.optimize import lsq_linear, nnls

    most = 30 * matrix.shape[1]
    with contextlib.suppress(RuntimeError):  # more iterations
        x, _ = nnls(matrix, target, maxiter=most)
        slopes = (matrix @ x - target) @ matrix
        size = np.linalg.norm(matrix, axis=0) * np.linalg.norm(target)
        if (np.where(x > 0, np.abs(slopes), -slopes) <= _OFF * size).all():
            return x
    return lsq_linear(matrix, target, (0.0, np.inf), method="bvls", tol=1e-15, max_iter=most).x
