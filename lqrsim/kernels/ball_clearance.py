"""The distance of each ball of a robot to each obstacle, less what there must be of it. The kernels' subset.

`data` has what `places` reads, and from AT on for how many steps there are margins, of which the last hold from there
on, how many at a step, of which row r has number r modulo that, how many obstacles there are, and at how many steps
they are told, of which the last holds from there on; then the radius of each ball, the margins, a step after the other,
and for each step the ROW numbers of each obstacle. The rows are those of the first ball, an obstacle after the other,
then those of the second. What `places` and `places_jacobian` are, `SphereCenters` says.
"""

from lqrsim.kernels.declarations import ROW, N, stack
from lqrsim.kernels.signed_distance import signed_distance, signed_distance_derivatives

AT = 0
BALLS = 1  # how many there are


def value(at, u, t, row, data):
    """What the obstacle of that row leaves to spare for its ball, of all balls' places."""
    steps, each, obstacles = int(data[AT]), int(data[AT + 1]), int(data[AT + 2])
    ball, margins = row // obstacles, AT + 4 + BALLS
    least = data[AT + 4 + ball] + data[margins + min(t, steps - 1) * each + row % each]
    where = margins + steps * each + ROW * (obstacles * min(t, int(data[AT + 3]) - 1) + row % obstacles)
    return signed_distance(data, where, at[3 * ball], at[3 * ball + 1], at[3 * ball + 2]) - least


def slope(at, moves, t, row, data, gradient):
    """Add its gradient, of all places and their derivatives in the states."""
    normal, curve = stack(3), stack(3, 3)
    obstacles = int(data[AT + 2])
    ball, before = row // obstacles, obstacles * min(t, int(data[AT + 3]) - 1)
    where = AT + 4 + BALLS + int(data[AT]) * int(data[AT + 1]) + ROW * (before + row % obstacles)
    signed_distance_derivatives(data, where, at[3 * ball], at[3 * ball + 1], at[3 * ball + 2], normal, curve)
    for i in range(N):
        for j in range(3):
            gradient[i] += normal[j] * moves[3 * ball + j, i]
