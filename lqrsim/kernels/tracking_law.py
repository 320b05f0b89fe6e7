"""One step of the backward pass of tracking laws; `control/tracking_laws.py` has its cost. In the kernels' subset.

It does all of a step but the two products of matrices, which BLAS does faster. One compiled function serves all sizes,
so every array is flat.
"""

from lqrsim.kernels.declarations import outline
from lqrsim.kernels.linear_algebra import copy_part
from lqrsim.kernels.loop_moments import add_row, add_rows


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
        own, at = first + row * (Y + a), cost + width * (force + a)
        add_row(lost, work.products, own, work.cost, at, width)
        for j in range(m * width):
            work.mean[j] = lost * arrays.held[held + j]
        add_rows(m, work.products, own + width, 1, work.mean, 0, width, work.cost, at, width)
    for i in range(Y):
        for j in range(i):
            mean = 0.5 * (work.cost[cost + width * i + j] + work.cost[cost + width * j + i])
            work.cost[cost + width * i + j], work.cost[cost + width * j + i] = mean, mean
        work.cost[cost + (width + 1) * i] += arrays.state[Y * k + i]
