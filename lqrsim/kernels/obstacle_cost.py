"""`weight * sum over obstacles of exp(-sharpness * (distance - radius))`. The kernels' subset.

The robot is a point at its position, or balls, over which the cost is summed, too. From AT on, `data` has the
sharpness, the weight, the number of obstacles, the number of steps with a table of obstacles, of which the last holds
from its step on, the radius of each ball (of a point, one), and the tables. What `places` reads comes before AT.
"""

from math import floor, inf

from lqrsim.kernels.declarations import ROW, N, exact, places, places_jacobian, power_of_two, stack, zeros
from lqrsim.kernels.signed_distance import signed_distance, signed_distance_derivatives

AT = 0
BALLS = 0  # 0 for a point
AXES = (0, 1, 2)  # states that are the position, two in a plane, whose third coordinate is 0; or that move the balls
BLOCK = 8  # obstacles whose exponentials are computed together, as vectors

LOG2_E = 1.4426950408889634
LN2_HIGH, LN2_LOW = 0.693145751953125, 1.4286068203094173e-06  # ln 2 in two parts; products with the first are exact
LEAST, MOST = -708.0, 709.0  # below, exp x is taken to be zero; above, infinite


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
                total += cost_of_ball(centres[c], centres[c + 1], centres[c + 2], data[AT + 4 + k], tables, data)
        else:
            height = x[AXES[2]] if len(AXES) == 3 else 0.0
            total = cost_of_ball(x[AXES[0]], x[AXES[1]], height, data[AT + 4], tables, data)
    return data[AT + 1] * total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and the gradient (W,), and return the cost. The curvature of the centres is left out."""
    total = 0.0
    if t > 0:
        sharpness, tables = data[AT], tables_at(t, data)
        force, stiffness, product = stack(3), stack(3, 3), stack(3)
        if BALLS:
            centres, jacobian = stack(3 * BALLS), zeros(3 * BALLS, N)
            places_jacobian(x, data, centres, jacobian)
            for k in range(BALLS):
                c = 3 * k
                total += derivatives_of_ball(
                    centres[c], centres[c + 1], centres[c + 2], data[AT + 4 + k], tables, data, force, stiffness
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
            total = derivatives_of_ball(x[AXES[0]], x[AXES[1]], height, data[AT + 4], tables, data, force, stiffness)
            for j in range(len(AXES)):
                gradient[AXES[j]] += sharpness * force[j]
                for k in range(len(AXES)):
                    hessian[AXES[j], AXES[k]] += sharpness * stiffness[j, k]
    return total


def tables_at(t, data):
    """Where the table of obstacles at step t begins."""
    radii = BALLS if BALLS else 1
    return AT + 4 + radii + ROW * int(data[AT + 2]) * min(t, int(data[AT + 3]) - 1)


def cost_of_ball(a, b, c, radius, table, data):
    """The cost of a ball at (a, b, c), divided by the weight."""
    costs, count, total = stack(BLOCK), int(data[AT + 2]), 0.0
    for block in range(0, count, BLOCK):
        size = min(BLOCK, count - block)
        for i in range(BLOCK):
            costs[i] = 0.0
        for i in range(size):
            distance = signed_distance(data, table + ROW * (block + i), a, b, c)
            costs[i] = -data[AT] * (distance - radius)
        for i in range(BLOCK):
            costs[i] = exponential(costs[i])
        for i in range(size):
            total += costs[i]
    return total


def derivatives_of_ball(a, b, c, radius, table, data, force, stiffness):
    """The cost of a ball at (a, b, c); write its gradient (3,) and Hessian (3, 3) there, divided by the sharpness."""
    slope, curve, slopes, curves = stack(BLOCK, 3), stack(BLOCK, 3, 3), zeros(3), zeros(3, 3)
    costs, count, total = stack(BLOCK), int(data[AT + 2]), 0.0
    for block in range(0, count, BLOCK):
        size = min(BLOCK, count - block)
        for i in range(BLOCK):
            costs[i] = 0.0
        for i in range(size):
            distance = signed_distance_derivatives(data, table + ROW * (block + i), a, b, c, slope[i], curve[i])
            costs[i] = -data[AT] * (distance - radius)
        for i in range(BLOCK):
            costs[i] = exponential(costs[i])
        for i in range(size):
            cost = data[AT + 1] * costs[i]
            total += cost
            for j in range(3):
                slopes[j] -= cost * slope[i, j]
                for k in range(3):
                    curves[j, k] += cost * (data[AT] * slope[i, j] * slope[i, k] - curve[i, j, k])
    for j in range(3):
        force[j] = slopes[j]
        for k in range(3):
            stiffness[j, k] = curves[j, k]
    return total


@exact
def exponential(x):
    """exp x, to some 2e-16 of it: arithmetic alone, so that loops vectorise, and every C library gives the same bits.

    With k the whole number nearest to x / ln 2 it is 2^k exp r; Taylor's series for r, which is at most 0.35, has an
    error of 1e-17 after the twelfth power.
    """
    k = floor(x * LOG2_E + 0.5)
    r = x - k * LN2_HIGH - k * LN2_LOW
    high = 1 / 5040 + r * (1 / 40320 + r * (1 / 362880 + r * (1 / 3628800 + r * (1 / 39916800 + r / 479001600))))
    series = 1.0 + r * (1.0 + r * (0.5 + r * (1 / 6 + r * (1 / 24 + r * (1 / 120 + r * (1 / 720 + r * high))))))
    result = series * power_of_two(k)
    return inf if x > MOST else 0.0 if x < LEAST else result
