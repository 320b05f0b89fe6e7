"""Constraint values: distances to obstacles minus the required distances. Written in the kernels' subset.

The robot is a point at its position, or a set of balls. For balls, `value` and `slope` take the centres and their
Jacobian in place of state and control; see `augmented_lagrangian.py`.

From AT on, `data` has the numbers below, then the margins and the tables, step by step. The last margins and the last
table hold from their step on. There is a row for each obstacle, first for the first ball, then for the next. Its margin
has the index `row` modulo the number of margins per step. AT is 0 for a point. For balls, the entries before AT are
those that `places` reads.
"""

from lqrsim.kernels.declarations import ROW, N, stack
from lqrsim.kernels.signed_distance import signed_distance, signed_distance_derivatives

AT = 0
# From there on: numbers of steps with margins, of margins at a step, of obstacles, and of steps with a table of these;
# then the radius of each ball, or of the point.
STEPS, EACH, OBSTACLES, TABLES, RADII = 0, 1, 2, 3, 4
BALLS = 0  # number of balls; 0 for a point
AXES = (0, 1, 2)  # states that are the position of a point; two in a plane, with third coordinate 0


def value(x, u, t, row, data):
    """The distance of one ball to one obstacle, minus its radius and the margin."""
    a, b, c = place(x, row, data)
    steps, each = int(data[AT + STEPS]), int(data[AT + EACH])
    margin = data[AT + RADII + max(BALLS, 1) + min(t, steps - 1) * each + row % each]
    least = data[AT + RADII + ball_of(row, data)] + margin
    return signed_distance(data, obstacle_at(t, row, data), a, b, c) - least


def slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    normal, curve = stack(3), stack(3, 3)
    a, b, c = place(x, row, data)
    signed_distance_derivatives(data, obstacle_at(t, row, data), a, b, c, normal, curve)
    if BALLS:
        first = 3 * ball_of(row, data)
        for i in range(N):
            for j in range(3):
                gradient[i] += normal[j] * u[first + j, i]
    else:
        for i in range(len(AXES)):
            gradient[AXES[i]] += normal[i]


def place(x, row, data):
    """The centre of a row's ball, or the position of a robot that is a point."""
    if BALLS:
        first = 3 * ball_of(row, data)
        return x[first], x[first + 1], x[first + 2]
    return x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0


def ball_of(row, data):
    """The number of the ball that a row is about; 0 for a point."""
    return row // int(data[AT + OBSTACLES]) if BALLS else 0


def obstacle_at(t, row, data):
    """The index at which the numbers of a row's obstacle begin."""
    obstacles, margins = int(data[AT + OBSTACLES]), int(data[AT + STEPS]) * int(data[AT + EACH])
    obstacle = obstacles * min(t, int(data[AT + TABLES]) - 1) + (row % obstacles if BALLS else row)
    return AT + RADII + max(BALLS, 1) + margins + ROW * obstacle
