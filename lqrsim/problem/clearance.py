"""The constraint that a robot keeps clear of obstacles."""

import copy
from typing import Self

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError, check_array, check_number, real
from lqrsim.kernels import clearance, distance_constraint
from lqrsim.problem.collision_shape import CollisionGeoms, GeomsInWorld, KeepsClear
from lqrsim.problem.collision_spheres import CollisionSpheres
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.costs import rows_ahead
from lqrsim.problem.dynamics import Dynamics
from lqrsim.scenes.world import World


class Clearance(KeepsClear, Constraint):
    """`distance(x_t, obstacle) - radius >= margin` for each obstacle, walls included, at the steps.

        ls.Clearance(scene.world, radius=robot.radius, margin=0.05)

    The constraint does not act at a start that is given exactly. Between two steps a plan can come nearer: by `v^2 dt^2
    / 8 r` at the speed v, where r is the sum of the radii of robot and obstacle. It can also step over obstacles
    thinner than a step. Add an ObstacleCost, even one with a small weight: it guides the search around the obstacles.

    Args:
      world: the obstacles; a robot in the plane sees them as for an ObstacleCost.
      radius: radius of the robot in metres, as for an ObstacleCost. Give exactly one of `radius`, `balls` and `geoms`.
      balls: the robot's balls, as for an ObstacleCost.
      geoms: the colliding geoms of a robot from an MJCF, as for an ObstacleCost: one distance for each body and
        obstacle.
      margin: margin in metres: a number, or one per knot, (T + 1,), or one per knot and obstacle, (T + 1, O).
        Those of knots move with time when a `Replanner` plans again, as a reference does; see `QuadraticCost`.
    """

    def __init__(
        self,
        world: World,
        *,
        radius: float | None = None,
        balls: CollisionSpheres | None = None,
        geoms: CollisionGeoms | None = None,
        margin: float | npt.ArrayLike = 0.0,
    ) -> None:
        self._set_shape(world, radius, balls, geoms)
        self.margin = _checked_margin(margin)

    @property
    def by_knot(self) -> bool:
        return isinstance(self.margin, np.ndarray)

    def ahead(self, steps: int, *, horizon: str = "shrinking") -> Self:
        super().ahead(steps, horizon=horizon)
        if not isinstance(self.margin, np.ndarray):
            return self
        other = copy.copy(self)
        other.margin = rows_ahead(self.margin, steps, horizon)
        return other

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        return self._bind_at(dynamics, np.zeros(len(np.atleast_1d(self.margin))))

    def _bind_at(self, dynamics: Dynamics, times: Array) -> ConstraintTerm:
        margins = np.atleast_1d(self.margin).reshape(np.shape(self.margin)[0] if np.ndim(self.margin) else 1, -1)
        shape = self.in_world(dynamics)
        world = shape.world
        if len(margins) not in (1, len(times)):
            want = f"one, or one for each of {len(times)} knots"
            raise InputError(f"Clearance: margin: got {len(margins)} numbers, want {want}")
        if margins.shape[1] not in (1, len(world)):
            want = f"{len(world)}, one per obstacle: {', '.join(world.names)}"
            raise InputError(f"Clearance: margin: got {margins.shape[1]} numbers for a knot, want {want}")
        if isinstance(shape, GeomsInWorld):
            found = shape.geoms.bind(dynamics, world, float(margins.max()) + 2 * shape.geoms.size)
            if -1 in found.obstacles and margins.shape[1] > 1:
                want = f"one number for a knot, as there are {len(world)} obstacles"
                raise InputError(f"Clearance: margin: got {margins.shape[1]} numbers for a knot, want {want}")
            rows, shared = list(zip(found.parts, found.obstacles, strict=True)), max(1, len(found.parts))
            kernel = source_of(distance_constraint, AT=found.numbers, ROWS=shared)
            own = [*margins.shape, *np.maximum(found.obstacles, 0), *margins.ravel()]
        else:
            found, tables, count = shape.centers, world.tables(times), len(shape.radii)
            rows, shared = [(name, number) for name in shape.names for number in range(len(world))], 3 * count
            kernel = source_of(clearance, AXES=shape.moved_by)
            if found is not None:
                kernel = source_of(clearance, AT=found.numbers, BALLS=count)
            own = [*margins.shape, len(world), len(tables), *shape.radii, *margins.ravel(), *tables.ravel()]

        def describe(row: int) -> str:
            part, number = rows[row]
            own, who = margins[:, number % margins.shape[1]], f" of {part!r}" if part else ""
            low, high = f"{own.min():g}", f"{own.max():g}"
            said = low if low == high else f"{low} to {high}"
            where = f"obstacle {world.names[number]!r}" if number >= 0 else "all obstacles"
            return f"a clearance of {said} m{who} to {where}"

        if found is None:
            return ConstraintTerm(kernel, np.array(own), len(rows), describe)
        return ConstraintTerm(
            source=found.filling(kernel),
            data=np.concatenate([found.data, own]),
            rows=len(rows),
            describe=describe,
            shared=shared,
            functions=found.functions,
        )


def _checked_margin(margin: float | npt.ArrayLike) -> float | Array:
    """A number, or numbers (T+1,) or (T+1, O). Raises InputError for anything else."""
    given = real("Clearance: margin", margin)
    if given.ndim == 0:
        return check_number("Clearance: margin", margin)
    margins = check_array("Clearance: margin", margin, (None,) * min(given.ndim, 2))
    if not margins.size:
        raise InputError("Clearance: margin: got no numbers, want one, or one for each knot")
    return margins
