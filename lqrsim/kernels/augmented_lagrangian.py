"""The augmented Lagrangian: what is added to the cost for constraints. The kernels' subset.

For inequalities d >= 0, with multipliers lambda >= 0 and a penalty mu, it is

    sum (max(0, lambda - mu d)^2 - lambda^2) / (2 mu)

and for equalities d = 0, with multipliers of either sign, the same without the max, which is

    sum -lambda d + mu/2 d^2

At the optimum the multipliers are the forces `max(0, lambda - mu d)` and `lambda - mu d`. For inequalities d is what a
constraint has to spare beyond the tolerance to which it is solved, so that what is within the tolerance keeps the
constraint itself. A constraint may have a price, in cost a unit, for which it may be missed: no force is larger, and
beyond what one of that size keeps the Lagrangian goes on as a straight line. Of the curvature only `mu n n'` is taken,
n the slope of d: the rest can be negative.
These functions are compiled with each constraint.

`multipliers` is one array a constraint: mu, how many numbers there are at a step, the first step at which they act, the
tolerance that is to be left to spare, the price, infinite where there is none, and from HEADER on lambda, step by step.
With mu of zero there is nothing.
"""

from math import inf

from lqrsim.kernels.declarations import EQUALITY, HEADER, W, constraint_slope, constraint_value, stack


def augment(x, u, t, data, multipliers, hessian, gradient):
    """Add the quadratic model at (x, u) to hessian (W, W) and gradient (W,), and return the value."""
    penalty, rows = multipliers[0], int(multipliers[1])
    slope = stack(W)
    total = 0.0
    if penalty > 0 and t >= multipliers[2]:
        for row in range(rows):
            multiplier = multipliers[HEADER + rows * t + row]
            force = multiplier - penalty * (constraint_value(x, u, t, row, data) - multipliers[3])
            total -= multiplier * multiplier
            if EQUALITY or force > 0:
                held = min(max(force, -multipliers[4]), multipliers[4])
                total += held * (2 * force - held)
                curvature = penalty if held == force else 0.0
                for i in range(W):
                    slope[i] = 0.0
                constraint_slope(x, u, t, row, data, slope)
                for i in range(W):
                    gradient[i] -= held * slope[i]
                    for j in range(W):
                        hessian[i, j] += curvature * slope[i] * slope[j]
        total /= 2 * penalty
    return total


def augmentation(x, u, t, data, multipliers):
    """The value alone."""
    penalty, rows = multipliers[0], int(multipliers[1])
    total = 0.0
    if penalty > 0 and t >= multipliers[2]:
        for row in range(rows):
            multiplier = multipliers[HEADER + rows * t + row]
            force = multiplier - penalty * (constraint_value(x, u, t, row, data) - multipliers[3])
            total -= multiplier * multiplier
            if EQUALITY or force > 0:
                held = min(max(force, -multipliers[4]), multipliers[4])
                total += held * (2 * force - held)
        total /= 2 * penalty
    return total


def add_slope(x, u, t, row, data, gradient):
    """Add the gradient (W,) of one of a constraint's numbers."""
    constraint_slope(x, u, t, row, data, gradient)


def constraint_values(x, u, t, acts, data, multipliers, values):
    """Write a constraint's numbers at a step, step by step as the multipliers are.

    Where they do not act they are kept: an inequality's is infinite, an equality's zero.
    """
    rows = int(multipliers[1])
    for row in range(rows):
        kept = 0.0 if EQUALITY else inf
        values[rows * t + row] = constraint_value(x, u, t, row, data) if acts and t >= multipliers[2] else kept
