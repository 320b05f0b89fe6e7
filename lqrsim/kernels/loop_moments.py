"""One step of the recursion of a closed loop's moments; `control/linear_loop.py` has its form. In the kernels' subset.

It does all of a step but the two products of large matrices, which BLAS does faster. One compiled function serves all
sizes, so every array is flat. In the names below Y, X, m, ... are sizes, and the arrays have the shapes of
`LoopArrays`.
"""

from math import erfc, exp, pi, sqrt

from lqrsim.kernels.declarations import inline, outline
from lqrsim.kernels.linear_algebra import copy_part


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
    given, noise = R * R * system, R * R * (sizes.systems * t + system)
    for i in range(R * R):
        work.half[i] = 0.0
    for i in range(R if t > 0 else 0):
        for a in range(R):
            if loops.transition[R * i + a] != 0.0:
                add_row(loops.transition[R * i + a], work.given, given + R * a, work.half, R * i, R)
    for i in range(R):
        copy_part(loops.fresh, noise + R * i, work.given, given + R * i, R)
        for a in range(R if t > 0 else 0):
            if loops.transition[R * i + a] != 0.0:
                for j in range(R):
                    work.given[given + R * i + j] += loops.transition[R * i + a] * work.half[R * j + a]


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
        copy_part(work.given, R * (R * system + i), work.P, P + X * (Y + i) + Y, R)
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
    P, x, own, at = X * X * k, Y * k, m * k, m * (sizes.systems * sizes.laws * t + k)
    K, F, G, c = m * X * (sizes.laws * t + law), Y * X * loop, m * Y * loop, Y * loop
    for a in range(m):
        row, slopes, chosen = X * (own + a), K + X * a, m * (sizes.laws * t + law) + a
        for j in range(X):
            work.response[row + j] = 0.0
        add_rows(X, loops.K, slopes, 1, work.P, P, X, work.response, row, X)
        variance = dot(work.response, row, loops.K, slopes, X) + loops.shaking[m * chosen + a]
        std = sqrt(max(variance, 0.0))
        centre = loops.command[chosen] + dot(loops.K, slopes, work.mean, x, Y)
        slope, level, left = limit(centre, std, loops.low[a], loops.high[a])
        moments.command[at + a], moments.saturation[at + a] = std, 1.0 - slope
        work.slope[own + a], work.level[own + a], work.left[own + a] = slope, level, left
        for j in range(X):
            work.law[row + j] = slope * loops.K[slopes + j]
    for i in range(Y):
        row = P + X * i
        copy_part(loops.F, F + X * i, work.M, row, X)
        add_rows(m, loops.G, G + i, Y, work.law, X * own, X, work.M, row, X)
        total = loops.c[c + i] + dot(loops.F, F + X * i, work.mean, x, Y)
        for a in range(m):
            total += loops.G[G + Y * a + i] * (work.level[own + a] - loops.planned[m * t + a])
        work.ahead[i] = total
    shake(t, system, law, sizes, loops, work)
    copy_part(work.ahead, 0, work.mean, x, Y)


@inline
def shake(t, system, law, sizes, loops, work):
    """Write the products with G of the commands' noise, and of what a loss changes, for `disturb`."""
    Y, X, m, S = sizes.driven, sizes.entries, sizes.controls, sizes.stated
    k, loop, given = sizes.laws * system + law, sizes.systems * t + system, sizes.laws * t + law
    own, G, force = m * k, m * Y * loop, S - m
    for a in range(m):
        row = Y * (own + a)
        for i in range(Y):
            work.pushed[row + i] = 0.0
            work.held[row + i] = 0.0
            if sizes.correlated:
                work.shaken[row + i] = work.slope[own + a] * loops.jointly[Y * (m * given + a) + i]
                work.pushed[row + i] = work.shaken[row + i]
        for b in range(m):
            noise = work.slope[own + a] * loops.shaking[m * (m * given + a) + b] * work.slope[own + b]
            if a == b:
                noise += work.left[own + a]
            add_row(noise, loops.G, G + Y * b, work.pushed, row, Y)
            if sizes.lossy:
                # E[(u - a) (u - a)'] of the command u and the one in force, a.
                apart = work.level[own + a] - loops.reached[m * loop + a] - work.mean[Y * k + force + a]
                apart *= work.level[own + b] - loops.reached[m * loop + b] - work.mean[Y * k + force + b]
                square = noise + apart - work.slope[own + a] * work.response[X * (own + a) + force + b]
                square -= work.slope[own + b] * work.response[X * (own + b) + force + a]
                square += work.P[X * (X * k + force + a) + force + b]
                square += work.slope[own + a] * dot(work.response, X * (own + a), work.law, X * (own + b), X)
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
