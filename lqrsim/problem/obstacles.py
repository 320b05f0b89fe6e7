"""What keeps a robot clear: a cost and a constraint on obstacles, a constraint on its own links; and the kernels."""

import copy
from collections.abc import Callable, Mapping, Sequence
from math import floor, inf
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Finite, NonNegative, Positive, checked
from lqrsim.codegen.sources import Source, source_of
from lqrsim.codegen.user_functions import UserFunction
from lqrsim.errors import Array, InputError, check_array, check_number, real
from lqrsim.kernels.declarations import ROW, N, exact, power_of_two, shared_jacobian, shared_values, stack, zeros
from lqrsim.kernels.distances import hull_distance, signed_distance, signed_distance_derivatives
from lqrsim.problem.collision_shape import (
    MOST_ROWS,
    CollisionGeoms,
    CollisionSpheres,
    GeomPairs,
    ShapeInWorld,
    shape_in,
)
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.mjcf_dynamics import MjcfDynamics
from lqrsim.problem.parts import Constraint, ConstraintTerm, Cost, CostTerm
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.scene import link_pairs
from lqrsim.scenes.world import World

CUTOFF = 16.0  # times 1 / sharpness: the distance beyond which geoms cost nothing, instead of exp(-CUTOFF)
# Distance beyond the margin from which on links have slopes, relative to the largest geom's bounding sphere. Links that
# are two joints apart are always within twice its radius, the reach of a Clearance; all these slopes take time.
SEEN = 0.25


class KeepsClear:
    """A cost or a constraint that keeps a robot clear of obstacles.

    Attributes:
      world: the obstacles. shape: the robot's shape, as the keyword that was given: radius, balls or geoms.
      radius: the given radius; for balls the largest, for geoms that of the largest bounding sphere.
      balls, geoms: None if not given.
    """

    _same_with_added_state = True

    def _set_shape(
        self, world: World, radius: float | None, balls: CollisionSpheres | None, geoms: CollisionGeoms | None
    ) -> None:
        shape: dict[str, Any] = {"radius": radius, "balls": balls, "geoms": geoms}
        self.shape = {name: stated for name, stated in shape.items() if stated is not None}
        if len(self.shape) != 1:
            got = " and ".join(self.shape) or "none of radius, balls and geoms"
            wanted = "one of them: radius=robot.radius, balls=robot.balls or geoms=robot.geoms"
            raise InputError(f"{type(self).__name__}: got {got}, want {wanted}")
        self.world, self.balls, self.geoms = world, balls, geoms
        largest = geoms.size if geoms is not None else 0.0 if balls is None else float(balls.radii.max())
        self.radius: float = self.shape.get("radius", largest)

    @property
    def kept_clear(self) -> "KeepsClear":
        return self

    @property
    def moving(self) -> bool:
        return self.world.moving

    def _stated(self) -> Mapping[str, object]:
        own = {name: value for name, value in vars(self).items() if name not in ("shape", "radius", "balls", "geoms")}
        return own | self.shape

    def in_world(self, dynamics: Dynamics, time: float = 0.0) -> ShapeInWorld:
        """The shape among the obstacles, at their positions at a time in s. Raises InputError if it does not fit."""
        if "radius" in self.shape and not dynamics.state_coordinates.position:
            wanted = "Dynamics(..., position=(names)), or balls="
            raise InputError(f"{type(self).__name__}: got dynamics without a position, want {wanted}")
        return shape_in(dynamics, self.world.moved(time) if time else self.world, **self.shape)


def _placed(shape: ShapeInWorld, numbers: Array) -> tuple[Source, Array, tuple[UserFunction, ...]]:
    """The kernels for the balls of a shape, with AT, BALLS and AXES; their data with the shape's; and its functions."""
    centers, axes = shape.centers, shape.depends_on
    if centers is None:
        return source_of(__name__, AXES=axes), numbers, ()
    kernels = source_of(
        __name__, AT=centers.numbers, BALLS=shape.balls, PARTS=len(shape.radii), AXES=axes, HULLS=int(bool(shape.hulls))
    )
    shared = {"shared_values": (centers.code, "places"), "shared_jacobian": (centers.code, "places_jacobian")}
    return kernels.filled(**shared), np.concatenate([centers.data, numbers]), centers.functions


def each_once(terms: Sequence[KeepsClear]) -> list[KeepsClear]:
    """The first of each kind: those with other obstacles, or another shape, than all before."""
    distinct: list[KeepsClear] = []
    for term in terms:
        if not any(term.shape == other.shape and _same(term.world, other.world) for other in distinct):
            distinct.append(term)
    return distinct


def _same(one: World, other: World) -> bool:
    """Whether two worlds have the same obstacles in the same order, such as those of one file that was read twice."""
    fields = "name", "kind", "position", "rotation", "size", "velocity", "corners"
    pairs = zip(one.obstacles, other.obstacles, strict=False)
    return len(one) == len(other) and all(mine._equals(its, *fields) for mine, its in pairs)


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

    @checked
    def scaled(self, factor: NonNegative) -> "ObstacleCost":
        return self.weighing(factor * self.weight)

    @property
    def contact_curvature(self) -> float:
        return self.weight * self.sharpness**2

    def bind(self, dynamics: Dynamics) -> CostTerm:
        return self._bind_at(dynamics, np.zeros(1), {})

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> CostTerm:
        shape, reach = self.in_world(dynamics), CUTOFF / self.sharpness
        found = shape.distances(reach)
        if found is not None:
            distances, _ = found
            numbers, axes = np.array([self.sharpness, self.weight, reach]), tuple(range(distances.leading_states))
            return CostTerm.of_residual(
                distances, source_of(__name__, AT=distances.numbers), numbers, first=1, nonconvex_in=axes, factor=WEIGHT
            )
        tables, count = shape.world.tables(times)
        numbers = np.concatenate([[self.sharpness, self.weight, len(shape.world), count], shape.parts, tables])
        source, data, functions = _placed(shape, numbers)
        return CostTerm(
            source, data, nonconvex_in=shape.depends_on or None, factor=len(data) - len(numbers) + WEIGHT,
            functions=functions, exact_hessian=shape.centers is None,
        )  # fmt: skip


class Clearance(KeepsClear, Constraint):
    """`distance(x_t, obstacle) - radius >= margin` for each obstacle of the world, at the knots.

        ls.Clearance(scene.world, radius=robot.radius, margin=0.05)

    The constraint does not act at a start that is given exactly. Between two knots a plan can come nearer: by `v^2 dt^2
    / 8 r` at the speed v, where r is the sum of the radii of robot and obstacle. It can also jump over obstacles that
    are thinner than the way between two knots. Add an ObstacleCost, even one with a small weight: it guides the search
    around the obstacles.

    Args:
      world: the obstacles. For a robot in a plane they are reduced to that plane; see `World.seen_by`.
      radius: exactly one of `radius`, `balls` and `geoms`, as for an ObstacleCost: one distance for each ball, each
        hull of several, or each body, and obstacle.
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

        found = shape.distances(float(margins.max()) + 2 * float(shape.radii.max()))
        if found is not None:
            distances, obstacles = found
            if -1 in obstacles and margins.shape[1] > 1:
                want = f"one number for a knot, as there are {len(world)} obstacles"
                raise InputError(f"Clearance: margin: got {margins.shape[1]} numbers for a knot, want {want}")
            rows = list(zip(distances.parts, obstacles, strict=True))
            columns = [max(number, 0) % margins.shape[1] for number in obstacles]
            return ConstraintTerm.of_residual(distances, margins, columns, describe)
        (tables, count), shared = world.tables(times), 0 if shape.centers is None else 3 * shape.balls
        numbers = np.concatenate([[*margins.shape, len(world), count], shape.parts, margins.ravel(), tables])
        source, data, functions = _placed(shape, numbers)
        source = source.filled(value=(source, "clearance_value"), slope=(source, "clearance_slope"))
        return ConstraintTerm(source, data, len(rows), describe, shared=shared, functions=functions)


class SelfClearance(Constraint):
    """`distance(link, other link) >= margin` at the steps, by MuJoCo's distances; `MjcfRobot.self_clearance` makes it.

    The links are those of `link_pairs` of `scenes/scene.py`; `links` has their pairs, by the names of their bodies.
    """

    _same_with_added_state = True

    @checked
    def __init__(self, mjcf: MjcfModel, body: str, margin: Finite = 0.0) -> None:
        model = mjcf.model
        self.margin, self._mjcf, self._pairs = margin, mjcf, link_pairs(model, model.body(body).id)
        geom_bodies = model.geom_bodyid[self._pairs]
        welds = model.body_weldid[geom_bodies]
        bodies = np.sort(np.where(welds != 0, welds, geom_bodies), axis=1)
        keys, rows = np.unique(bodies, axis=0, return_inverse=True)
        self._rows = np.asarray(rows, dtype=np.int64).ravel()
        self.links = tuple((model.body(first).name, model.body(second).name) for first, second in keys.tolist())

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        if not isinstance(dynamics.calling, MjcfDynamics):
            raise InputError(f"SelfClearance: got dynamics {dynamics.name}, want the robot's own, robot.dynamics")
        model = self._mjcf.model
        reach = self.margin + SEEN * float(model.geom_rbound[self._pairs].max(initial=0.0))
        described = [f"{first!r} and {second!r}" for first, second in self.links]
        rows, merged = self._rows, np.arange(len(described))
        if len(described) > MOST_ROWS:  # then one for each link, to those after it
            firsts = list(dict.fromkeys(first for first, _ in self.links))
            merged = np.array([firsts.index(first) for first, _ in self.links])
            described, rows = [f"{link!r} and other links" for link in firsts], merged[rows]
        pairs = GeomPairs(dynamics, model, self._pairs, rows, max(1, len(described)))

        def describe(row: int) -> str:
            return f"a clearance of {self.margin:g} m between {described[row]}"

        distances = pairs.residual(tuple(described), reach)
        return ConstraintTerm.of_residual(distances, np.array([[self.margin]]), [0] * len(described), describe)

    def distances(self, dynamics: MjcfDynamics, states: npt.ArrayLike) -> Array:
        """The distance (..., L) in m of the links of each pair in `links`, at states (..., n); at most 1 m."""
        pairs = GeomPairs(dynamics, self._mjcf.model, self._pairs, self._rows, len(self.links))
        return pairs.distances(states, reach=1.0)[0]

    def check(self, field: str, dynamics: MjcfDynamics, state: Array) -> None:
        """Raises InputError if links are nearer to each other than the margin at a state (n,), named `field`."""
        distances = self.distances(dynamics, state)
        if distances.min(initial=np.inf) < self.margin:
            first, second = self.links[int(distances.argmin())]
            raise InputError(
                f"{field}: got a state with {first!r} and {second!r} at {distances.min():.3g} m from each other, want"
                f" {self.margin:g} m; or, if they may touch, <contact><exclude"
                f' body1="{first}" body2="{second}"/></contact> in the MJCF'
            )


# The kernels. Their numbers begin in `data` at AT, after those that `shared_values` reads: sharpness and weight of a
# cost, and what one of two layouts says.
AT = 0
SHARPNESS, WEIGHT = 0, 1

# Of geoms: the distances of the geoms are a residual, and the cost has a `loss` of each.
FARTHEST = 2  # the distance beyond which there is no cost

# Of balls: the robot is a point at its position, or a set of parts: balls, or convex hulls of some of these. The shared
# values are the centres of all balls; `clearance_value` and `clearance_slope` take them and their Jacobian in place of
# state and control, see `augmented_lagrangian.py`. A Clearance begins with numbers of steps with margins and of margins
# at a step. Then follow numbers of obstacles, and of steps with a table of these; the radius of each part, or of the
# point; for hulls the first ball of each, and the end of the last; of a Clearance the margins, step by step; and tables
# of obstacles, which may move, step by step. The last margins and the last table hold from their step on.
STEPS, EACH = 0, 1
OBSTACLES, TABLES, RADII = 2, 3, 4
BALLS = 0  # number of balls; 0 for a point
PARTS = 1  # number of balls, or of hulls
HULLS = 0  # 1 if the parts are hulls of balls
AXES = (0, 1, 2)  # states that move the robot: of a point its position, two in a plane with third coordinate 0
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
            shared_values(x, data, centres)
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
        force, stiffness, tables = stack(3), stack(3, 3), tables_at(t, data)
        if BALLS:
            centres, jacobian = stack(3 * BALLS), zeros(3 * BALLS, N)
            shared_jacobian(x, data, centres, jacobian)
            if HULLS:
                for k in range(PARTS):
                    total += derivatives_of_hull(centres, jacobian, k, tables, data, hessian, gradient)
            else:
                for k in range(BALLS):
                    c, radius = 3 * k, data[AT + RADII + k]
                    total += derivatives_of_ball(
                        centres[c], centres[c + 1], centres[c + 2], radius, tables, data, force, stiffness
                    )
                    add_in_states(force, stiffness, jacobian, c, hessian, gradient)
        else:
            height = x[AXES[2]] if len(AXES) == 3 else 0.0
            total = derivatives_of_ball(
                x[AXES[0]], x[AXES[1]], height, data[AT + RADII], tables, data, force, stiffness
            )
            for j in range(len(AXES)):
                gradient[AXES[j]] += force[j]
                for k in range(len(AXES)):
                    hessian[AXES[j], AXES[k]] += stiffness[j, k]
    return total


def add_in_states(force, stiffness, jacobian, first, hessian, gradient):
    """Add the derivatives in the states of a ball's cost, given those in its centre."""
    product = stack(3)
    for a in range(len(AXES)):
        for j in range(3):
            product[j] = 0.0
            for m in range(3):
                product[j] += stiffness[j, m] * jacobian[first + m, AXES[a]]
        for j in range(3):
            gradient[AXES[a]] += force[j] * jacobian[first + j, AXES[a]]
        for b in range(len(AXES)):
            for j in range(3):
                hessian[AXES[a], AXES[b]] += jacobian[first + j, AXES[b]] * product[j]


def tables_at(t, data):
    """The index at which the table of obstacles of a cost at step t begins."""
    return after_parts() + ROW * int(data[AT + OBSTACLES]) * min(t, int(data[AT + TABLES]) - 1)


def after_parts():
    """The index after the numbers of the parts."""
    return AT + RADII + PARTS + HULLS * (PARTS + 1)


def corners_of(part, data):
    """The first ball of a hull, and the number of its balls."""
    at = AT + RADII + PARTS + part
    return int(data[at]), int(data[at + 1]) - int(data[at])


def cost_of_hull(centres, part, table, data):
    """The cost of a hull, divided by the weight."""
    total, corner_slopes = 0.0, stack(3 * max(BALLS, 1))
    first, size = corners_of(part, data)
    for k in range(int(data[AT + OBSTACLES])):
        distance = hull_distance(data, table + ROW * k, centres, first, size, corner_slopes) - data[AT + RADII + part]
        total += exponential(-data[AT + SHARPNESS] * distance)
    return total


def derivatives_of_hull(centres, jacobian, part, table, data, hessian, gradient):
    """The cost of a hull; add its derivatives, without the curvature of the distances."""
    total, corner_slopes, moves = 0.0, stack(3 * max(BALLS, 1)), stack(len(AXES))
    first, size = corners_of(part, data)
    sharpness = data[AT + SHARPNESS]
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
    """The cost of a ball at (a, b, c); write its gradient (3,) and Hessian (3, 3) there."""
    slope, curve, slopes, curves = stack(BLOCK, 3), stack(BLOCK, 3, 3), zeros(3), zeros(3, 3)
    sharpness, costs, count, total = data[AT + SHARPNESS], stack(BLOCK), int(data[AT + OBSTACLES]), 0.0
    for block in range(0, count, BLOCK):
        size = min(BLOCK, count - block)
        for i in range(BLOCK):
            costs[i] = 0.0
        for i in range(size):
            distance = signed_distance_derivatives(data, table + ROW * (block + i), a, b, c, slope[i], curve[i])
            costs[i] = -sharpness * (distance - radius)
        for i in range(BLOCK):
            costs[i] = exponential(costs[i])
        for i in range(size):
            cost = data[AT + WEIGHT] * costs[i]
            total += cost
            for j in range(3):
                slopes[j] -= cost * slope[i, j]
                for k in range(3):
                    curves[j, k] += cost * (sharpness * slope[i, j] * slope[i, k] - curve[i, j, k])
    for j in range(3):
        force[j] = sharpness * slopes[j]
        for k in range(3):
            stiffness[j, k] = sharpness * curves[j, k]
    return total


def loss(distance, row, data):
    """The cost of a distance of geoms, its first and its second derivative.

    The tangent at the farthest distance is subtracted, so that neither the cost nor its slope jumps.
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


# Of a Clearance there is a row for each obstacle, first for the first part, then for the next. Its margin has the index
# `row` modulo the number of margins per step.


def clearance_value(x, u, t, row, data):
    """The distance from one part to one obstacle, minus the part's radius and the margin."""
    part, steps, each = part_of(row, data), int(data[AT + STEPS]), int(data[AT + EACH])
    least = data[AT + RADII + part] + data[after_parts() + min(t, steps - 1) * each + row % each]
    if HULLS:
        first, size = corners_of(part, data)
        return hull_distance(data, obstacle_at(t, row, data), x, first, size, stack(3 * BALLS)) - least
    a, b, c = place(x, row, data)
    return signed_distance(data, obstacle_at(t, row, data), a, b, c) - least


def clearance_slope(x, u, t, row, data, gradient):
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


def obstacle_at(t, row, data):
    """The index at which the numbers of a row's obstacle begin."""
    obstacles, margins = int(data[AT + OBSTACLES]), int(data[AT + STEPS]) * int(data[AT + EACH])
    obstacle = obstacles * min(t, int(data[AT + TABLES]) - 1) + (row % obstacles if BALLS else row)
    return after_parts() + margins + ROW * obstacle
