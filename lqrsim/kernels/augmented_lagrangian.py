"""The augmented Lagrangian: the cost that is added for a constraint.

For inequalities d >= 0, with multipliers lambda >= 0 and a penalty mu, it is

    sum (max(0, lambda - mu d)^2 - lambda^2) / (2 mu)

and for equalities d = 0, with multipliers of either sign, the same without the max: sum -lambda d + mu/2 d^2. At the
optimum the multipliers are the forces `max(0, lambda - mu d)` and `lambda - mu d`. For inequalities d is the value
minus the tolerance to which the constraint is solved. A plan within the tolerance therefore satisfies the constraint
itself. A constraint may have a price, in cost per unit of violation. No force exceeds the price; where it would, the
Lagrangian is linear. Of the curvature only the part `mu n n'` is used, with n the gradient of d: the rest can be
negative.

`multipliers` is one array per constraint: the penalty mu (0 where the constraint does not act yet), the number of rows
at a step, the first step at which they act, the margin, which is the tolerance, the price (infinite if there is none),
and from MULTIPLIERS on lambda, step by step. The indices are names in `declarations.py`; Python uses the class
`ConstraintMultipliers` in `solvers/compiled.py`.

A constraint whose rows share numbers, such as the centres of a robot's balls, computes them once per step, by
`shared_values`. Its value and its slope then take the numbers (SHARED,) and their Jacobian (SHARED, N) in place of
state and control.
"""

from math import inf

from lqrsim.kernels.declarations import (
    EQUALITY,
    FIRST,
    MARGIN,
    MULTIPLIERS,
    PENALTY,
    PRICE,
    ROWS,
    N,
    W,
    constraint_slope,
    constraint_value,
    shared_jacobian,
    shared_values,
    stack,
    zeros,
)
from lqrsim.kernels.linear_algebra import fill

SHARED = 0  # number of values that the rows share; 0 for a constraint on state and control


def augment(x, u, t, data, multipliers, hessian, gradient):
    """Add the quadratic model at (x, u) to hessian (W, W) and gradient (W,), and return the value."""
    if not multipliers[PENALTY] > 0 or t < multipliers[FIRST]:
        return 0.0
    shared, jacobian = stack(SHARED), zeros(SHARED, N)
    if SHARED:
        shared_jacobian(x, data, shared, jacobian)
    y, v = (shared, jacobian) if SHARED else (x, u)
    slope, total = stack(W), 0.0
    for row in range(int(multipliers[ROWS])):
        force, capped, value = force_of(y, v, t, row, data, multipliers)
        total += value
        if EQUALITY or force > 0:
            curvature = multipliers[PENALTY] if capped == force else 0.0
            fill(slope, W, 0.0)
            constraint_slope(y, v, t, row, data, slope)
            for i in range(W):
                gradient[i] -= capped * slope[i]
                for j in range(W):
                    hessian[i, j] += curvature * slope[i] * slope[j]
    return total / (2 * multipliers[PENALTY])


def augmentation(x, u, t, data, multipliers):
    """The value alone."""
    if not multipliers[PENALTY] > 0 or t < multipliers[FIRST]:
        return 0.0
    shared, total = stack(SHARED), 0.0
    if SHARED:
        shared_values(x, data, shared)
    for row in range(int(multipliers[ROWS])):
        _, _, value = force_of(shared if SHARED else x, u, t, row, data, multipliers)
        total += value
    return total / (2 * multipliers[PENALTY])


def force_of(x, u, t, row, data, multipliers):
    """The force lambda - mu d of one value, that force limited by the price, and the Lagrangian's part times 2 mu."""
    multiplier = multipliers[MULTIPLIERS + int(multipliers[ROWS]) * t + row]
    force = multiplier - multipliers[PENALTY] * (constraint_value(x, u, t, row, data) - multipliers[MARGIN])
    capped, value = 0.0, -multiplier * multiplier
    if EQUALITY or force > 0:
        capped = min(max(force, -multipliers[PRICE]), multipliers[PRICE])
        value += capped * (2 * force - capped)
    return force, capped, value


def constraint_values(x, u, t, acts, data, multipliers, values):
    """Write a constraint's values at step t, ordered as the multipliers are.

    Where the constraint does not act, they are those of one that is satisfied: infinite for an inequality, else zero.
    """
    shared, rows = stack(SHARED), int(multipliers[ROWS])
    if SHARED:
        shared_values(x, data, shared)
    for row in range(rows):
        values[rows * t + row] = 0.0 if EQUALITY else inf
        if acts:
            values[rows * t + row] = constraint_value(shared if SHARED else x, u, t, row, data)


def add_slope(x, u, t, row, data, gradient):
    """Add the gradient (W,) of one of a constraint's values."""
    shared, jacobian = stack(SHARED), zeros(SHARED, N)
    if SHARED:
        shared_jacobian(x, data, shared, jacobian)
    y, v = (shared, jacobian) if SHARED else (x, u)
    constraint_slope(y, v, t, row, data, gradient)
