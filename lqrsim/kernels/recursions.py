"""Recursions along a plan: moments of closed loops, a Kalman filter in square-root form, and tracking laws.

`control/prediction.py`, `control/plan_model.py` and `control/tracking.py` have their forms. A step of the moments and
of the laws lacks only products of large matrices, which BLAS does faster. One compiled function serves all sizes, so
every array is flat. In the names below Y, X, Z, m, ... are sizes, and the arrays have the shapes of their records.
"""

from math import copysign, erfc, exp, pi, sqrt

from lqrsim.kernels.declarations import inline, outline
from lqrsim.kernels.linear_algebra import copy_part, fill


def advance(t, sizes, loops, work, moments):
    """Complete the moments of all loops at knot t, after the products; unless t is T, prepare those of step t."""
    for i in range(sizes.systems):
        spread(t, i, sizes, loops, work)
        for j in range(sizes.laws):
            if t > 0:
                disturb(t - 1, i, j, sizes, loops, work)
            arrive(t, i, j, sizes, loops, work, moments)
            if t < sizes.steps:
                act(t, i, j, sizes, loops, work, moments)


@outline
def add_row(factor, a, i, out, k, count):
    """Add factor times a[i:] to out[k:]."""
    for j in range(count):
        out[k + j] += factor * a[i + j]


@outline
def add_rows(rows, factors, f, apart, a, i, width, out, k, count):
    """Add the rows of a[i:], each of this width, times factors[f:], which are some places apart, to out[k:]."""
    r = 0
    while r + 4 <= rows:
        p, q = factors[f + apart * r], factors[f + apart * (r + 1)]
        u, v = factors[f + apart * (r + 2)], factors[f + apart * (r + 3)]
        at = i + width * r
        for j in range(count):
            out[k + j] += (p * a[at + j] + q * a[at + width + j]) + (
                u * a[at + 2 * width + j] + v * a[at + 3 * width + j]
            )
        r += 4
    while r < rows:
        add_row(factors[f + apart * r], a, i + width * r, out, k, count)
        r += 1


@outline
def dot(a, i, b, k, count):
    """The sum of products of a[i:] and b[k:]."""
    total = 0.0
    for j in range(count):
        total += a[i + j] * b[k + j]
    return total


@outline
def spread(t, system, sizes, loops, work):
    """Write the covariance of d at knot t."""
    R = sizes.entries - sizes.driven
    first, noise = R * R * system, R * R * (sizes.systems * t + system)
    fill(work.half, R * R, 0.0)
    for i in range(R if t > 0 else 0):
        for a in range(R):
            if loops.transition[R * i + a] != 0.0:
                add_row(loops.transition[R * i + a], work.exogenous, first + R * a, work.half, R * i, R)
    for i in range(R):
        copy_part(loops.fresh, noise + R * i, work.exogenous, first + R * i, R)
        for a in range(R if t > 0 else 0):
            if loops.transition[R * i + a] != 0.0:
                for j in range(R):
                    work.exogenous[first + R * i + j] += loops.transition[R * i + a] * work.half[R * j + a]


@outline
def disturb(t, system, law, sizes, loops, work):
    """Add the effects of limits, losses and the commands' noise in step t to the covariance of y."""
    Y, X, m, S = sizes.driven, sizes.entries, sizes.controls, sizes.stated
    k = sizes.laws * system + law
    G, P, pushed = m * Y * (sizes.systems * t + system), X * X * k, m * Y * k
    for i in range(Y):
        add_rows(m, loops.G, G + i, Y, work.pushed, pushed, Y, work.P, P + X * i, Y)
        if sizes.correlated:
            add_rows(m, work.shaken, pushed + i, Y, loops.G, G, Y, work.P, P + X * i, Y)
        if sizes.lossy and i < S:
            add_rows(m, loops.G, G + i, Y, work.held, pushed, Y, work.P, P + X * i, S)


@outline
def arrive(t, system, law, sizes, loops, work, moments):
    """Add the noise that leads to knot t, fill in the rest of the symmetric covariance, and write the moments."""
    Y, X, rows, columns, count = sizes.driven, sizes.entries, sizes.rows, sizes.columns, sizes.shown
    k, loop = sizes.laws * system + law, sizes.systems * t + system
    P, R = X * X * k, X - Y
    for i in range(rows):
        add_row(1.0, loops.noise, columns * (rows * loop + i), work.P, P + X * i, columns)
    for i in range(R):
        for j in range(Y):
            work.P[P + X * (Y + i) + j] = work.P[P + X * j + Y + i]
        copy_part(work.exogenous, R * (R * system + i), work.P, P + X * (Y + i) + Y, R)
    at = sizes.systems * sizes.laws * t + k
    last = at - sizes.systems * sizes.laws
    for i in range(count):
        moments.mean[count * at + i] = work.mean[Y * k + i]
        copy_part(work.P, P + X * i, moments.covariance, count * (count * at + i), count)
        if t > 0:
            copy_part(work.driven, X * (Y * k + i), moments.across, count * (count * last + i), count)


@outline
def act(t, system, law, sizes, loops, work, moments):
    """Write M of X' = M X and noise under the limited commands of step t, the next mean, and what noise is left."""
    Y, X, m = sizes.driven, sizes.entries, sizes.controls
    k, loop = sizes.laws * system + law, sizes.systems * t + system
    P, x, first, at = X * X * k, Y * k, m * k, m * (sizes.systems * sizes.laws * t + k)
    K, F, G, c = m * X * (sizes.laws * t + law), Y * X * loop, m * Y * loop, Y * loop
    for a in range(m):
        row, slopes, chosen = X * (first + a), K + X * a, m * (sizes.laws * t + law) + a
        for j in range(X):
            work.response[row + j] = 0.0
        add_rows(X, loops.K, slopes, 1, work.P, P, X, work.response, row, X)
        variance = dot(work.response, row, loops.K, slopes, X) + loops.shaking[m * chosen + a]
        std = sqrt(max(variance, 0.0))
        centre = loops.command[chosen] + dot(loops.K, slopes, work.mean, x, Y)
        slope, level, left = limit(centre, std, loops.low[a], loops.high[a])
        moments.command[at + a], moments.saturation[at + a] = std, 1.0 - slope
        work.slope[first + a], work.level[first + a], work.left[first + a] = slope, level, left
        for j in range(X):
            work.law[row + j] = slope * loops.K[slopes + j]
    for i in range(Y):
        row = P + X * i
        copy_part(loops.F, F + X * i, work.M, row, X)
        add_rows(m, loops.G, G + i, Y, work.law, X * first, X, work.M, row, X)
        total = loops.c[c + i] + dot(loops.F, F + X * i, work.mean, x, Y)
        for a in range(m):
            total += loops.G[G + Y * a + i] * (work.level[first + a] - loops.planned[m * t + a])
        work.ahead[i] = total
    shake(t, system, law, sizes, loops, work)
    copy_part(work.ahead, 0, work.mean, x, Y)


@inline
def shake(t, system, law, sizes, loops, work):
    """Write the products with G of the commands' noise, and of what a loss changes, for `disturb`."""
    Y, X, m, S = sizes.driven, sizes.entries, sizes.controls, sizes.stated
    k, loop, of_law = sizes.laws * system + law, sizes.systems * t + system, sizes.laws * t + law
    first, G, force = m * k, m * Y * loop, S - m
    for a in range(m):
        row = Y * (first + a)
        for i in range(Y):
            work.pushed[row + i] = 0.0
            work.held[row + i] = 0.0
            if sizes.correlated:
                work.shaken[row + i] = work.slope[first + a] * loops.jointly[Y * (m * of_law + a) + i]
                work.pushed[row + i] = work.shaken[row + i]
        for b in range(m):
            noise = work.slope[first + a] * loops.shaking[m * (m * of_law + a) + b] * work.slope[first + b]
            if a == b:
                noise += work.left[first + a]
            add_row(noise, loops.G, G + Y * b, work.pushed, row, Y)
            if sizes.lossy:
                # E[(u - a) (u - a)'] of the command u and the one in force, a.
                apart = work.level[first + a] - loops.reached[m * loop + a] - work.mean[Y * k + force + a]
                apart *= work.level[first + b] - loops.reached[m * loop + b] - work.mean[Y * k + force + b]
                square = noise + apart - work.slope[first + a] * work.response[X * (first + a) + force + b]
                square -= work.slope[first + b] * work.response[X * (first + b) + force + a]
                square += work.P[X * (X * k + force + a) + force + b]
                square += work.slope[first + a] * dot(work.response, X * (first + a), work.law, X * (first + b), X)
                add_row(sizes.lost * square, loops.G, G + Y * b, work.held, row, S)


@inline
def limit(centre, std, low, high):
    """Mean slope, mean and remaining variance of a normal number that is clipped to its limits.

    With x standard normal and a limit at a distance of z std inside, E max(x - z, 0) is the excess over it.
    """
    sigma = max(std, 1e-12)
    below, above = min((centre - low) / sigma, 40.0), min((high - centre) / sigma, 40.0)  # beyond 40, as without limit
    clipped_low, clipped_high = 0.5 * erfc(below / sqrt(2.0)), 0.5 * erfc(above / sqrt(2.0))
    excess_low = exp(-0.5 * below * below) / sqrt(2.0 * pi) - below * clipped_low
    excess_high = exp(-0.5 * above * above) / sqrt(2.0 * pi) - above * clipped_high
    slope, first = 1.0 - clipped_low - clipped_high, excess_low - excess_high
    second = slope - below * excess_low - above * excess_high
    return slope, centre + sigma * first, max(second - first * first - slope * slope, 0.0) * sigma * sigma


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
    fill(roots.work, (Y + Z) * width, 0.0)
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


def improve(t, sizes, arrays, work):
    """Write the laws of step t and the costs-to-go at t of all weights; the `products` are given."""
    for k in range(sizes.laws):
        eliminate(t, k, sizes, arrays, work)
        go_back(t, k, sizes, arrays, work)


@outline
def eliminate(t, k, sizes, arrays, work):
    """Write the law, -(R + G'SG)^-1 (G'S [F E c] + undo): Gaussian elimination, which needs no pivots here."""
    Y, m, width = sizes.driven, sizes.controls, sizes.entries + 1
    row = width + m
    law, curve, right = m * width * (sizes.laws * t + k), m * m * k, row * ((Y + m) * k + Y)
    for a in range(m):
        for j in range(width):
            arrays.laws[law + width * a + j] = -work.products[right + row * a + j]
        for j in range(width):
            arrays.laws[law + width * a + j] -= arrays.undo[law + width * a + j]
        for b in range(m):
            work.curve[curve + m * a + b] = work.products[right + row * a + width + b]
        work.curve[curve + m * a + a] += arrays.control[a]
    for a in range(m):
        for b in range(a + 1, m):
            factor = -work.curve[curve + m * b + a] / work.curve[curve + m * a + a]
            add_row(factor, work.curve, curve + m * a, work.curve, curve + m * b, m)
            add_row(factor, arrays.laws, law + width * a, arrays.laws, law + width * b, width)
    for a in range(m - 1, -1, -1):
        for b in range(a + 1, m):
            factor = -work.curve[curve + m * a + b]
            add_row(factor, arrays.laws, law + width * b, arrays.laws, law + width * a, width)
        for j in range(width):
            arrays.laws[law + width * a + j] /= work.curve[curve + m * a + a]


@outline
def go_back(t, k, sizes, arrays, work):
    """Write the cost-to-go (S, D, s): its mean over commands that arrive and commands that get lost."""
    Y, m, width, lost = sizes.driven, sizes.controls, sizes.entries + 1, sizes.lost
    row, force = width + m, Y - m
    law, held, first, cost = m * width * (sizes.laws * t + k), m * width * t, row * (Y + m) * k, width * Y * k
    for j in range(m * width):
        work.mean[j] = (1.0 - lost) * arrays.laws[law + j] + lost * arrays.held[held + j]
    for i in range(Y):
        copy_part(work.products, first + row * i, work.cost, cost + width * i, width)
        add_rows(m, work.products, first + row * i + width, 1, work.mean, 0, width, work.cost, cost + width * i, width)
    for a in range(m if lost > 0.0 else 0):
        pushed, at = first + row * (Y + a), cost + width * (force + a)
        add_row(lost, work.products, pushed, work.cost, at, width)
        for j in range(m * width):
            work.mean[j] = lost * arrays.held[held + j]
        add_rows(m, work.products, pushed + width, 1, work.mean, 0, width, work.cost, at, width)
    for i in range(Y):
        for j in range(i):
            mean = 0.5 * (work.cost[cost + width * i + j] + work.cost[cost + width * j + i])
            work.cost[cost + width * i + j], work.cost[cost + width * j + i] = mean, mean
        work.cost[cost + (width + 1) * i] += arrays.state[Y * k + i]
