"""The cost of obstacles for a robot of several balls: that of `obstacle_cost.py`, of each ball. The kernels' subset.

`data` has what `places` reads, and from AT on the sharpness, the weight, how many obstacles there are and at how many
steps they are told, of which the last holds from there on; the radius of each ball, and for each step the ROW numbers
of each obstacle. What `places` and `places_jacobian` are, `SphereCenters` says.
"""

from lqrsim.kernels.declarations import ROW, N, places, places_jacobian, stack
from lqrsim.kernels.exponential import exponential
from lqrsim.kernels.linear_algebra import clear
from lqrsim.kernels.signed_distance import signed_distance, signed_distance_derivatives

AT = 0
BALLS = 1  # how many there are
PLACES = 3  # coordinates of them all
AXES = (0,)  # the states that the places depend on


def value(x, u, t, data):
    """The cost; none at the first step, whose state is given."""
    total = 0.0
    if t > 0:
        at = stack(PLACES)
        obstacles = AT + 4 + BALLS + ROW * int(data[AT + 2]) * min(t, int(data[AT + 3]) - 1)
        places(x, data, at)
        for k in range(BALLS):
            radius = data[AT + 4 + k]
            for i in range(int(data[AT + 2])):
                distance = signed_distance(data, obstacles + ROW * i, at[3 * k], at[3 * k + 1], at[3 * k + 2])
                total += exponential(-data[AT] * (distance - radius))
    return data[AT + 1] * total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, and return the cost. The places' own curvature is left out."""
    total = 0.0
    if t > 0:
        at, moves = stack(PLACES), stack(PLACES, N)
        obstacles = AT + 4 + BALLS + ROW * int(data[AT + 2]) * min(t, int(data[AT + 3]) - 1)
        normal, curve, force, stiffness, sides = stack(3), stack(3, 3), stack(3), stack(3, 3), stack(3)
        sharpness = data[AT]
        clear(moves, PLACES, N)
        places_jacobian(x, data, at, moves)
        for k in range(BALLS):
            for i in range(3):
                force[i] = 0.0
            clear(stiffness, 3, 3)
            for i in range(int(data[AT + 2])):
                distance = signed_distance_derivatives(
                    data, obstacles + ROW * i, at[3 * k], at[3 * k + 1], at[3 * k + 2], normal, curve
                )
                cost = data[AT + 1] * exponential(-sharpness * (distance - data[AT + 4 + k]))
                total += cost
                for j in range(3):
                    force[j] -= cost * normal[j]
                    for m in range(3):
                        stiffness[j, m] += cost * (sharpness * normal[j] * normal[m] - curve[j, m])
            for a in range(len(AXES)):
                for j in range(3):
                    sides[j] = 0.0
                    for m in range(3):
                        sides[j] += sharpness * stiffness[j, m] * moves[3 * k + m, AXES[a]]
                for j in range(3):
                    gradient[AXES[a]] += sharpness * force[j] * moves[3 * k + j, AXES[a]]
                for b in range(len(AXES)):
                    for j in range(3):
                        hessian[AXES[a], AXES[b]] += moves[3 * k + j, AXES[b]] * sides[j]
    return total
