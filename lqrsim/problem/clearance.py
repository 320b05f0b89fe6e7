"""The constraint that keeps a robot away from obstacles: class and kernel."""

import copy
from collections.abc import Callable, Mapping
from typing import Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import NonNegative, checked
from lqrsim.errors import Array, InputError, check_array, check_number, real
from lqrsim.kernels.declarations import ROW, N, stack
from lqrsim.kernels.distances import hull_distance, signed_distance, signed_distance_derivatives
from lqrsim.problem.collision_shape import CollisionGeoms, KeepsClear
from lqrsim.problem.collision_spheres import CollisionSpheres
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.dynamics import Dynamics
from lqrsim.scenes.world import World


class Clearance(KeepsClear, Constraint):
    """`distance(x_t, obstacle) - radius >= margin` for each obstacle of the world, at the knots.

        ls.Clearance(scene.world, radius=robot.radius, margin=0.05)

    The constraint does not act at a start that is given exactly. Between two knots a plan can come nearer: by `v^2 dt^2
    / 8 r` at the speed v, where r is the sum of the radii of robot and obstacle. It can also jump over obstacles that
    are thinner than the way between two knots. Add an ObstacleCost, even one with a small weight: it guides the search
    around the obstacles.

    Args:
      world: the obstacles. For a robot in a plane they are reduced to that plane; see `World.seen_by`.
      radius, balls, geoms: exactly one of them, as for an ObstacleCost: one distance for each ball, each hull of
        several, or each body, and obstacle.
      margin: margin in metres: a number, or one per knot, (T + 1,), or one per knot and obstacle, (T + 1, O). Margins
        of knots move with time when a `Replanner` plans again, as the rows of a `QuadraticCost`.
    """

    @checked
    def __init__(
        self,
        world: World,
        *,
        radius: NonNegative | None = None,
        balls: CollisionSpheres | None = None,
        geoms: CollisionGeoms | None = None,
        margin: float | npt.ArrayLike = 0.0,
    ) -> None:
        self._set_shape(world, radius, balls, geoms)
        self.margin: float | Array
        if axes := min(real("Clearance: margin", margin).ndim, 2):
            self.margin = check_array("Clearance: margin", margin, (None,) * axes)
            if not self.margin.size:
                raise InputError("Clearance: margin: got no numbers, want one, or one for each knot")
        else:
            self.margin = check_number("Clearance: margin", margin)

    @property
    def by_knot(self) -> bool:
        return isinstance(self.margin, np.ndarray)

    def _at_other_knots(self, select: Callable[[Array], Array]) -> Self:
        other = copy.copy(self)
        other.margin = select(np.asarray(self.margin))
        return other

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        return self._bind_at(dynamics, np.zeros(len(np.atleast_1d(self.margin))), {})

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> ConstraintTerm:
        margins = np.atleast_1d(self.margin)
        margins = margins.reshape(len(margins), -1)
        shape = self.in_world(dynamics)
        world = shape.world
        if len(margins) not in (1, len(times)):
            want = f"one, or one for each of {len(times)} knots"
            raise InputError(f"Clearance: margin: got {len(margins)} numbers, want {want}")
        if margins.shape[1] not in (1, len(world)):
            want = f"{len(world)}, one per obstacle: {', '.join(world.names)}"
            raise InputError(f"Clearance: margin: got {margins.shape[1]} numbers for a knot, want {want}")
        rows = [(name, number) for name in shape.names for number in range(len(world))]

        def describe(row: int) -> str:
            part, number = rows[row]
            row_margins, who = margins[:, number % margins.shape[1]], f" of {part!r}" if part else ""
            low, high = f"{row_margins.min():g}", f"{row_margins.max():g}"
            amount = low if low == high else f"{low} to {high}"
            where = f"obstacle {world.names[number]!r}" if number >= 0 else "all obstacles"
            return f"a clearance of {amount} m{who} to {where}"

        distances = shape.distances(float(margins.max()) + 2 * float(shape.radii.max()))
        if distances is not None:
            if -1 in distances.obstacles and margins.shape[1] > 1:
                want = f"one number for a knot, as there are {len(world)} obstacles"
                raise InputError(f"Clearance: margin: got {margins.shape[1]} numbers for a knot, want {want}")
            rows = list(zip(distances.parts, distances.obstacles, strict=True))
            columns = [max(number, 0) % margins.shape[1] for number in distances.obstacles]
            return ConstraintTerm.of_residual(distances, margins, columns, describe)
        (tables, count), shared = world.tables(times), 0 if shape.centers is None else 3 * shape.balls
        numbers = np.concatenate([[*margins.shape, len(world), count], shape.parts, margins.ravel(), tables])
        source, data, functions = shape.placed(__name__, numbers)
        return ConstraintTerm(source, data, len(rows), describe, shared=shared, functions=functions)


# The kernel: distances to obstacles minus the required distances. The robot is a point at its position, or a set of
# parts: balls, or convex hulls of some of these. For parts, `value` and `slope` take the centres of all balls and their
# Jacobian in place of state and control; see `augmented_lagrangian.py`.
#
# From AT on, `data` has the numbers below; then the margins, step by step; then tables of obstacles, which may move,
# step by step. The last margins and the last table hold from their step on. There is a row for each obstacle, first for
# the first part, then for the next. Its margin has the index `row` modulo the number of margins per step. AT is 0 for a
# point. For balls, the entries before AT are those that `places` reads.
AT = 0
# From there on: numbers of steps with margins, of margins at a step, of obstacles, and of steps with a table of these;
# then the radius of each part, or of the point; for hulls the first ball of each, and the end of the last.
STEPS, EACH, OBSTACLES, TABLES, RADII = 0, 1, 2, 3, 4
BALLS = 0  # number of balls; 0 for a point
PARTS = 1  # number of parts
HULLS = 0  # 1 if parts are hulls
AXES = (0, 1, 2)  # states that are the position of a point; two in a plane, with third coordinate 0


def value(x, u, t, row, data):
    """The distance from one part to one obstacle, minus the part's radius and the margin."""
    part, steps, each = part_of(row, data), int(data[AT + STEPS]), int(data[AT + EACH])
    least = data[AT + RADII + part] + data[margins_from() + min(t, steps - 1) * each + row % each]
    if HULLS:
        first, size = corners_of(part, data)
        return hull_distance(data, obstacle_at(t, row, data), x, first, size, stack(3 * BALLS)) - least
    a, b, c = place(x, row, data)
    return signed_distance(data, obstacle_at(t, row, data), a, b, c) - least


def slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    if HULLS:
        corner_slopes = stack(3 * BALLS)
        first, size = corners_of(part_of(row, data), data)
        hull_distance(data, obstacle_at(t, row, data), x, first, size, corner_slopes)
        for i in range(N):
            for k in range(3 * size):
                gradient[i] += corner_slopes[k] * u[3 * first + k, i]
        return
    normal, curve = stack(3), stack(3, 3)
    a, b, c = place(x, row, data)
    signed_distance_derivatives(data, obstacle_at(t, row, data), a, b, c, normal, curve)
    if BALLS:
        first = 3 * part_of(row, data)
        for i in range(N):
            for j in range(3):
                gradient[i] += normal[j] * u[first + j, i]
    else:
        for i in range(len(AXES)):
            gradient[AXES[i]] += normal[i]


def place(x, row, data):
    """The centre of a row's ball, or the position of a robot that is a point."""
    if BALLS:
        first = 3 * part_of(row, data)
        return x[first], x[first + 1], x[first + 2]
    return x[AXES[0]], x[AXES[1]], x[AXES[2]] if len(AXES) == 3 else 0.0


def part_of(row, data):
    """The index of a row's part; 0 for a point."""
    return row // int(data[AT + OBSTACLES]) if BALLS else 0


def corners_of(part, data):
    """The first ball of a hull, and the number of its balls."""
    at = AT + RADII + PARTS + part
    return int(data[at]), int(data[at + 1]) - int(data[at])


def margins_from():
    """The index at which the margins begin."""
    return AT + RADII + PARTS + HULLS * (PARTS + 1)


def obstacle_at(t, row, data):
    """The index at which the numbers of a row's obstacle begin."""
    obstacles, margins = int(data[AT + OBSTACLES]), int(data[AT + STEPS]) * int(data[AT + EACH])
    obstacle = obstacles * min(t, int(data[AT + TABLES]) - 1) + (row % obstacles if BALLS else row)
    return margins_from() + margins + ROW * obstacle
