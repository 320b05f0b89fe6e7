"""`weight * sum over obstacles of exp(-sharpness * (distance - radius))`. Written in the kernels' subset.

The robot is a point at its position, or a set of balls; the cost is then summed over these. From AT on, `data` has the
numbers below, and the tables of obstacles. The last table holds for all later steps. The data for `places` comes before
AT.
"""

from lqrsim.kernels.declarations import ROW, N, places, places_jacobian, stack, zeros
from lqrsim.kernels.exponential import exponential
from lqrsim.kernels.signed_distance import signed_distance, signed_distance_derivatives

AT = 0
# From there on: sharpness, weight, numbers of obstacles and of steps with a table of these; then the radius of each
# ball, or of the point.
SHARPNESS, WEIGHT, OBSTACLES, TABLES, RADII = 0, 1, 2, 3, 4
BALLS = 0  # number of balls; 0 for a point
AXES = (0, 1, 2)  # states that are the position, two in a plane with third coordinate 0; or states that move the balls
BLOCK = 8  # number of obstacles whose exponentials are computed together, as vectors


def value(x, u, t, data):
    """The cost; zero at the first step, whose state is given."""
    total = 0.0
    if t > 0:
        tables = tables_at(t, data)
        if BALLS:
            centres = stack(3 * BALLS)
            places(x, data, centres)
            for k in range(BALLS):
                c = 3 * k
                total += cost_of_ball(centres[c], centres[c + 1], centres[c + 2], data[AT + RADII + k], tables, data)
        else:
            height = x[AXES[2]] if len(AXES) == 3 else 0.0
            total = cost_of_ball(x[AXES[0]], x[AXES[1]], height, data[AT + RADII], tables, data)
    return data[AT + WEIGHT] * total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and the gradient (W,), and return the cost. The curvature of the centres is left out."""
    total = 0.0
    if t > 0:
        sharpness, tables = data[AT + SHARPNESS], tables_at(t, data)
        force, stiffness, product = stack(3), stack(3, 3), stack(3)
        if BALLS:
            centres, jacobian = stack(3 * BALLS), zeros(3 * BALLS, N)
            places_jacobian(x, data, centres, jacobian)
            for k in range(BALLS):
                c = 3 * k
                total += derivatives_of_ball(
                    centres[c], centres[c + 1], centres[c + 2], data[AT + RADII + k], tables, data, force, stiffness
                )
                for a in range(len(AXES)):
                    for j in range(3):
                        product[j] = 0.0
                        for m in range(3):
                            product[j] += sharpness * stiffness[j, m] * jacobian[c + m, AXES[a]]
                    for j in range(3):
                        gradient[AXES[a]] += sharpness * force[j] * jacobian[c + j, AXES[a]]
                    for b in range(len(AXES)):
                        for j in range(3):
                            hessian[AXES[a], AXES[b]] += jacobian[c + j, AXES[b]] * product[j]
        else:
            height = x[AXES[2]] if len(AXES) == 3 else 0.0
            total = derivatives_of_ball(
                x[AXES[0]], x[AXES[1]], height, data[AT + RADII], tables, data, force, stiffness
            )
            for j in range(len(AXES)):
                gradient[AXES[j]] += sharpness * force[j]
                for k in range(len(AXES)):
                    hessian[AXES[j], AXES[k]] += sharpness * stiffness[j, k]
    return total


def tables_at(t, data):
    """The index at which the table of obstacles at step t begins."""
    return AT + RADII + max(BALLS, 1) + ROW * int(data[AT + OBSTACLES]) * min(t, int(data[AT + TABLES]) - 1)


def cost_of_ball(a, b, c, radius, table, data):
    """The cost of a ball at (a, b, c), divided by the weight."""
    costs, count, total = stack(BLOCK), int(data[AT + OBSTACLES]), 0.0
    for block in range(0, count, BLOCK):
        size = min(BLOCK, count - block)
        for i in range(BLOCK):
            costs[i] = 0.0
        for i in range(size):
            distance = signed_distance(data, table + ROW * (block + i), a, b, c)
            costs[i] = -data[AT + SHARPNESS] * (distance - radius)
        for i in range(BLOCK):
            costs[i] = exponential(costs[i])
        for i in range(size):
            total += costs[i]
    return total


def derivatives_of_ball(a, b, c, radius, table, data, force, stiffness):
    """The cost of a ball at (a, b, c); write its gradient (3,) and Hessian (3, 3) there, divided by the sharpness."""
    slope, curve, slopes, curves = stack(BLOCK, 3), stack(BLOCK, 3, 3), zeros(3), zeros(3, 3)
    costs, count, total = stack(BLOCK), int(data[AT + OBSTACLES]), 0.0
    for block in range(0, count, BLOCK):
        size = min(BLOCK, count - block)
        for i in range(BLOCK):
            costs[i] = 0.0
        for i in range(size):
            distance = signed_distance_derivatives(data, table + ROW * (block + i), a, b, c, slope[i], curve[i])
            costs[i] = -data[AT + SHARPNESS] * (distance - radius)
        for i in range(BLOCK):
            costs[i] = exponential(costs[i])
        for i in range(size):
            cost = data[AT + WEIGHT] * costs[i]
            total += cost
            for j in range(3):
                slopes[j] -= cost * slope[i, j]
                for k in range(3):
                    curves[j, k] += cost * (data[AT + SHARPNESS] * slope[i, j] * slope[i, k] - curve[i, j, k])
    for j in range(3):
        force[j] = slopes[j]
        for k in range(3):
            stiffness[j, k] = curves[j, k]
    return total
