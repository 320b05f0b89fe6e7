"""The recursion of a Kalman filter in square-root form; `control/kalman.py` has its idea. In the kernels' subset.

One compiled function serves all sizes, so every array is flat.
"""

from math import copysign, sqrt

from lqrsim.kernels.declarations import outline
from lqrsim.kernels.linear_algebra import copy_part
from lqrsim.kernels.loop_moments import add_row, dot


def filter_along(sizes, model, roots):
    """Write the roots of all knots, from the root before the first measurement, or after it if that was `used`."""
    Z = sizes.entries
    for t in range(sizes.knots):
        copy_part(roots.root, 0, roots.before, Z * Z * t, Z * Z)
        measure(t, sizes, model, roots)
        copy_part(roots.root, 0, roots.after, Z * Z * t, Z * Z)
        if t + 1 < sizes.knots:
            predict(t, sizes, model, roots)


@outline
def measure(t, sizes, model, roots):
    """Update the root by a measurement.

    [noise H root; 0 root] times an orthogonal matrix is [S 0; K S root'], of which S S' is the innovation's.
    """
    Z, Y, n = sizes.entries, sizes.measured, sizes.states
    width = n + Y + Z
    for i in range((Y + Z) * width):
        roots.work[i] = 0.0
    for i in range(Y):
        noise, expected = width * i, width * i + n + Y
        add_row(1.0, model.noise, n * (Y * t + i), roots.work, noise, n)
        for j in range(n):
            add_row(model.H[n * (Y * t + i) + j], roots.root, Z * j, roots.work, expected, Z)
        variance = dot(roots.work, noise, roots.work, noise, n) + dot(roots.work, expected, roots.work, expected, Z)
        roots.work[noise + n + i] = max(sizes.resolution * sqrt(variance), sizes.nothing)
    for i in range(Z):
        add_row(1.0, roots.root, Z * i, roots.work, width * (Y + i) + n + Y, Z)
    triangularize(roots.work, Y + Z, width)
    for i in range(Y):
        copy_part(roots.work, width * i, roots.innovation, Y * (Y * t + i), Y)
    if t > 0 or not sizes.used:
        for i in range(Z):
            copy_part(roots.work, width * (Y + i), roots.learned, Y * (Z * t + i), Y)
            copy_part(roots.work, width * (Y + i) + Y, roots.root, Z * i, Z)


@outline
def predict(t, sizes, model, roots):
    """Move the root to the next knot: [F root, disturbing] times an orthogonal matrix is [root' 0]."""
    Z, D = sizes.entries, sizes.disturbing
    width = Z + D
    for i in range(Z):
        for j in range(Z):
            roots.work[width * i + j] = 0.0
        for j in range(Z):
            if model.F[Z * (Z * t + i) + j] != 0.0:
                add_row(model.F[Z * (Z * t + i) + j], roots.root, Z * j, roots.work, width * i, Z)
        copy_part(model.disturbing, D * (Z * t + i), roots.work, width * i + Z, D)
    triangularize(roots.work, Z, width)
    for i in range(Z):
        copy_part(roots.work, width * i, roots.root, Z * i, Z)


@outline
def triangularize(a, rows, columns):
    """Make a matrix with at least as many columns as rows lower triangular, with a nonnegative diagonal.

    It is done by reflections of the columns. Squares are of numbers relative to the largest of their row, so that none
    underflows.
    """
    for i in range(rows):
        first, rest = columns * i + i, columns - i - 1
        largest = 0.0
        for j in range(rest):
            largest = max(largest, abs(a[first + 1 + j]))
        if largest > 0.0:
            largest = max(largest, abs(a[first]))
            for j in range(rest + 1):
                a[first + j] /= largest
            size = sqrt(dot(a, first, a, first, rest + 1))
            diagonal = -copysign(size, a[first])
            factor, scale = (diagonal - a[first]) / diagonal, 1.0 / (a[first] - diagonal)
            for j in range(rest):
                a[first + 1 + j] *= scale
            for k in range(i + 1, rows):
                at = columns * k + i
                along = -factor * (a[at] + dot(a, first + 1, a, at + 1, rest))
                a[at] += along
                add_row(along, a, first + 1, a, at + 1, rest)
            a[first] = diagonal * largest
            for j in range(rest):
                a[first + 1 + j] = 0.0
        if a[first] < 0.0:
            for k in range(i, rows):
                a[columns * k + i] *= -1.0
