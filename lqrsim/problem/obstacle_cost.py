"""The cost of coming near obstacles: class and kernel."""

import copy
from collections.abc import Mapping
from math import floor, inf

import numpy as np

from lqrsim.annotations import NonNegative, Positive, checked
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, check_number
from lqrsim.kernels.declarations import ROW, N, exact, places, places_jacobian, power_of_two, stack, zeros
from lqrsim.kernels.distances import hull_distance, signed_distance, signed_distance_derivatives
from lqrsim.problem.collision_shape import CollisionGeoms, KeepsClear
from lqrsim.problem.collision_spheres import CollisionSpheres
from lqrsim.problem.costs import Cost, CostTerm
from lqrsim.problem.dynamics import Dynamics
from lqrsim.scenes.world import World

CUTOFF = 16.0  # times 1 / sharpness: the distance beyond which geoms cost nothing, instead of exp(-CUTOFF)


class ObstacleCost(KeepsClear, Cost):
    """`weight * sum over obstacles of exp(-sharpness * (distance - radius))`, from the first step on.

    Paper: Sec. VI-A, with the sharpness made explicit. For a robot in the plane (two position coordinates), the world
    is seen from above or cut by the plane; see `World.seen_by`.

    For a robot of several balls, the cost is summed over the balls, too. Its Hessian is then that in the centres of the
    balls, mapped to the states by the Jacobian of the centres, without their second derivatives.

    Args:
      radius: radius of the robot at its position, in metres. Give exactly one of `radius`, `balls` and `geoms`.
      balls: the robot's balls, as `robot.balls`. The attribute `radius` is then the largest one.
      geoms: the colliding geoms of a robot from an MJCF, as `robot.geoms`, with MuJoCo's distances. The sum is then
        over bodies and obstacles. Pairs farther apart than D = 16 / sharpness cost nothing; for the others, the
        exponential's tangent at D, `exp(-16) * (1 + sharpness * (D - distance))`, is taken off.
      sharpness: sharpness in 1/m.
      weight: cost of touching one obstacle, with one ball, for one step.
    """

    @checked
    def __init__(
        self,
        world: World,
        *,
        radius: NonNegative | None = None,
        balls: CollisionSpheres | None = None,
        geoms: CollisionGeoms | None = None,
        sharpness: Positive = 10.0,
        weight: NonNegative = 1.0,
    ) -> None:
        self._set_shape(world, radius, balls, geoms)
        self.sharpness = sharpness
        self.weight = weight

    def weighing(self, weight: float) -> "ObstacleCost":
        """The same cost with another weight."""
        other = copy.copy(self)
        other.weight = check_number("ObstacleCost: weight", weight, at_least=0.0)
        return other

    def times(self, factor: float) -> "ObstacleCost":
        return self.weighing(factor * self.weight)

    @property
    def contact_curvature(self) -> float:
        return self.weight * self.sharpness**2

    def bind(self, dynamics: Dynamics) -> CostTerm:
        return self._bind_at(dynamics, np.zeros(1), {})

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> CostTerm:
        shape, reach = self.in_world(dynamics), CUTOFF / self.sharpness
        distances = shape.distances(reach)
        if distances is not None:
            numbers, axes = np.array([self.sharpness, self.weight, reach]), tuple(range(distances.leading_states))
            return CostTerm.of_residual(
                distances, source_of(__name__, AT=distances.numbers), numbers, first=1, nonconvex_in=axes, factor=WEIGHT
            )
        tables, count = shape.world.tables(times)
        numbers = np.concatenate([[self.sharpness, self.weight, len(shape.world), count], shape.parts, tables])
        source, data, functions = shape.placed(__name__, numbers)
        return CostTerm(
            source, data, nonconvex_in=shape.depends_on or None, factor=len(data) - len(numbers) + WEIGHT,
            functions=functions, exact_hessian=shape.centers is None,
        )  # fmt: skip


# The kernel. The robot is a point at its position, or a set of balls; the cost is then summed over these. From AT on,
# `data` has the numbers below, and the tables of obstacles. The last table holds for all later steps. The data for
# `places` comes before AT.
AT = 0
FARTHEST = 2  # for geoms; see `loss`
# From there on: sharpness, weight, numbers of obstacles and of steps with a table of these; then the radius of each
# part, or of the point; for hulls the first ball of each, and the end of the last.
SHARPNESS, WEIGHT, OBSTACLES, TABLES, RADII = 0, 1, 2, 3, 4
BALLS = 0  # number of balls; 0 for a point
PARTS = 1  # number of balls, or of hulls
HULLS = 0  # 1 if the parts are hulls of balls
AXES = (0, 1, 2)  # states that are the position, two in a plane with third coordinate 0; or states that move the balls
BLOCK = 8  # number of obstacles whose exponentials are computed together, as vectors
LOG2_E = 1.4426950408889634
LN2_HIGH, LN2_LOW = 0.693145751953125, 1.4286068203094173e-06  # ln 2 in two parts; products with the first are exact
LEAST, MOST = -708.0, 709.0  # below, exp x counts as zero; above, as infinite


def value(x, u, t, data):
    """The cost; zero at the first step, whose state is given."""
    total = 0.0
    if t > 0:
        tables = tables_at(t, data)
        if BALLS:
            centres = stack(3 * BALLS)
            places(x, data, centres)
            if HULLS:
                for k in range(PARTS):
                    total += cost_of_hull(centres, k, tables, data)
            else:
                for k in range(BALLS):
                    c, radius = 3 * k, data[AT + RADII + k]
                    total += cost_of_ball(centres[c], centres[c + 1], centres[c + 2], radius, tables, data)
        else:
            height = x[AXES[2]] if len(AXES) == 3 else 0.0
            total = cost_of_ball(x[AXES[0]], x[AXES[1]], height, data[AT + RADII], tables, data)
    return data[AT + WEIGHT] * total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian (W, W) and the gradient (W,), and return the cost. The curvature of the centres is left out."""
    total = 0.0
    if t > 0:
        sharpness, tables = data[AT + SHARPNESS], tables_at(t, data)
        force, stiffness = stack(3), stack(3, 3)
        if BALLS:
            centres, jacobian = stack(3 * BALLS), zeros(3 * BALLS, N)
            places_jacobian(x, data, centres, jacobian)
            if HULLS:
                for k in range(PARTS):
                    total += derivatives_of_hull(centres, jacobian, k, tables, data, hessian, gradient)
            else:
                for k in range(BALLS):
                    c, radius = 3 * k, data[AT + RADII + k]
                    total += derivatives_of_ball(
                        centres[c], centres[c + 1], centres[c + 2], radius, tables, data, force, stiffness
                    )
                    add_in_states(sharpness, force, stiffness, jacobian, c, hessian, gradient)
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


def add_in_states(sharpness, force, stiffness, jacobian, first, hessian, gradient):
    """Add the derivatives in the states of a ball's cost, given those in its centre, divided by the sharpness."""
    product = stack(3)
    for a in range(len(AXES)):
        for j in range(3):
            product[j] = 0.0
            for m in range(3):
                product[j] += sharpness * stiffness[j, m] * jacobian[first + m, AXES[a]]
        for j in range(3):
            gradient[AXES[a]] += sharpness * force[j] * jacobian[first + j, AXES[a]]
        for b in range(len(AXES)):
            for j in range(3):
                hessian[AXES[a], AXES[b]] += jacobian[first + j, AXES[b]] * product[j]


def tables_at(t, data):
    """The index at which the table of obstacles at step t begins."""
    parts = AT + RADII + PARTS + HULLS * (PARTS + 1)
    return parts + ROW * int(data[AT + OBSTACLES]) * min(t, int(data[AT + TABLES]) - 1)


def cost_of_hull(centres, part, table, data):
    """The cost of a hull, divided by the weight."""
    at, total, corner_slopes = AT + RADII + PARTS + part, 0.0, stack(3 * max(BALLS, 1))
    first, size = int(data[at]), int(data[at + 1]) - int(data[at])
    for k in range(int(data[AT + OBSTACLES])):
        distance = hull_distance(data, table + ROW * k, centres, first, size, corner_slopes) - data[AT + RADII + part]
        total += exponential(-data[AT + SHARPNESS] * distance)
    return total


def derivatives_of_hull(centres, jacobian, part, table, data, hessian, gradient):
    """The cost of a hull; add its derivatives, without the curvature of the distances."""
    at, total, corner_slopes, moves = AT + RADII + PARTS + part, 0.0, stack(3 * max(BALLS, 1)), stack(len(AXES))
    first, size, sharpness = int(data[at]), int(data[at + 1]) - int(data[at]), data[AT + SHARPNESS]
    for k in range(int(data[AT + OBSTACLES])):
        distance = hull_distance(data, table + ROW * k, centres, first, size, corner_slopes) - data[AT + RADII + part]
        cost = data[AT + WEIGHT] * exponential(-sharpness * distance)
        total += cost
        for a in range(len(AXES)):
            moves[a] = 0.0
            for i in range(3 * size):
                moves[a] += sharpness * corner_slopes[i] * jacobian[3 * first + i, AXES[a]]
        for a in range(len(AXES)):
            gradient[AXES[a]] -= cost * moves[a]
            for b in range(len(AXES)):
                hessian[AXES[a], AXES[b]] += cost * moves[a] * moves[b]
    return total


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


def loss(distance, row, data):
    """The cost of a distance of geoms, its first and its second derivative.

    From AT on, `data` has the sharpness, the weight, and the distance beyond which there is no cost. The tangent there
    is subtracted, so that neither the cost nor its slope jumps.
    """
    sharpness, weight, farthest = data[AT + SHARPNESS], data[AT + WEIGHT], data[AT + FARTHEST]
    cost, least, beyond = exponential(-sharpness * distance), exponential(-sharpness * farthest), farthest - distance
    if beyond > 0:
        return (
            weight * (cost - least * (1 + sharpness * beyond)),
            -weight * sharpness * (cost - least),
            weight * sharpness * sharpness * cost,
        )
    return 0.0, 0.0, 0.0


@exact
def exponential(x):
    """exp x by arithmetic alone, with a relative error of about 2e-16.

    Loops over it vectorise, which calls of the C library do not; and its bits are the same with every C library. With k
    the whole number nearest to x / ln 2 it is 2^k exp r; Taylor's series for r, which is at most 0.35, has an error of
    1e-17 after the twelfth power.
    """
    k = floor(x * LOG2_E + 0.5)
    r = x - k * LN2_HIGH - k * LN2_LOW
    high = 1 / 5040 + r * (1 / 40320 + r * (1 / 362880 + r * (1 / 3628800 + r * (1 / 39916800 + r / 479001600))))
    series = 1.0 + r * (1.0 + r * (0.5 + r * (1 / 6 + r * (1 / 24 + r * (1 / 120 + r * (1 / 720 + r * high))))))
    result = series * power_of_two(k)
    return inf if x > MOST else 0.0 if x < LEAST else result
