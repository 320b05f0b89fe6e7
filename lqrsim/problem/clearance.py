"""The constraint that a robot keeps clear of obstacles."""

import copy

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError, check_array, check_count, check_number, excerpt, real
from lqrsim.kernels import clearance, distance_constraint
from lqrsim.problem.collision_geoms import CollisionGeoms
from lqrsim.problem.collision_spheres import CollisionSpheres, bind_outline, check_outline
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.dynamics import Dynamics
from lqrsim.scenes.world import World


class Clearance(Constraint):
    """`distance(x_t, obstacle) - radius >= margin` for each obstacle, walls included, at the steps.

        ls.Clearance(scene.world, radius=robot.radius, margin=0.05)

    It does not act at a start that is given exactly. Between two steps a plan can come nearer, by `v^2 dt^2 / 8 r` at
    the speed v along an obstacle of radius r, and it can step over obstacles thinner than a step. Add an ObstacleCost,
    if only of a small weight: it guides the search around the obstacles.

    Args:
      world: the obstacles; a robot in the plane sees them as for an ObstacleCost.
      radius: radius of the robot in metres, as for an ObstacleCost; one of this, `balls` and `geoms`.
      balls: the robot's balls, as for an ObstacleCost.
      geoms: the colliding geoms of a robot from an MJCF, as for an ObstacleCost: one distance for each body and
        obstacle.
      margin: in metres; a number, or one per knot, (T + 1,), or one per knot and obstacle, (T + 1, O).
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
        if not isinstance(world, World):
            raise InputError(f"Clearance: world: got {excerpt(world)}, want a World, such as scene.world")
        self.world, self.balls, self.geoms = world, balls, geoms
        self.radius = check_outline("Clearance", radius, balls, geoms)
        self.margin = _checked_margin(margin)

    def ahead(self, steps: int) -> "Clearance":
        steps = check_count("steps", steps, at_least=0)
        if not isinstance(self.margin, np.ndarray):
            return self
        return self._keeping(self.margin[min(steps, len(self.margin) - 1) :])

    def _keeping(self, margin: float | npt.ArrayLike) -> "Clearance":
        """The same constraint with another margin."""
        other = copy.copy(self)
        other.margin = _checked_margin(margin)
        return other

    @property
    def moving(self) -> bool:
        return self.world.moving

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        return self._bind_at(dynamics, np.zeros(len(np.atleast_1d(self.margin))))

    def _bind_at(self, dynamics: Dynamics, times: Array) -> ConstraintTerm:
        margins = np.atleast_1d(self.margin).reshape(np.shape(self.margin)[0] if np.ndim(self.margin) else 1, -1)
        world = self.world if self.geoms is not None else bind_outline("Clearance", self.balls, dynamics, self.world)[1]
        if len(margins) not in (1, len(times)):
            want = f"one, or one for each of {len(times)} knots"
            raise InputError(f"Clearance: margin: got {len(margins)} numbers, want {want}")
        if margins.shape[1] not in (1, len(world)):
            want = f"{len(world)}, one per obstacle: {', '.join(world.names)}"
            raise InputError(f"Clearance: margin: got {margins.shape[1]} numbers for a knot, want {want}")
        if self.geoms is not None:
            return _bind_geoms(self.geoms, dynamics, world, margins)
        balls, tables = self.balls, world.tables(times)
        places, _ = bind_outline("Clearance", balls, dynamics, self.world)

        def describe(row: int) -> str:
            ball, place = divmod(row, len(world))
            own, who = margins[:, place % margins.shape[1]], "" if balls is None else f" of {balls.names[ball]!r}"
            low, high = f"{own.min():g}", f"{own.max():g}"
            said = low if low == high else f"{low} to {high}"
            return f"a clearance of {said} m{who} to obstacle {world.names[place]!r}"

        if balls is None or places is None:
            first = [*margins.shape, len(world), len(tables)]
            data = np.concatenate([first, (self.radius + margins).ravel(), tables.ravel()])
            source = source_of(clearance, AXES=dynamics.state_coordinates.position)
            return ConstraintTerm(source, data, len(world), describe)
        own = [*margins.shape, len(world), len(tables), *balls.radii, *margins.ravel(), *tables.ravel()]
        return ConstraintTerm(
            source=source_of(clearance, AT=places.numbers, BALLS=len(balls)).filled(
                places=places.code, places_jacobian=places.code
            ),
            data=np.concatenate([places.data, own]),
            rows=len(balls) * len(world),
            describe=describe,
            shared=3 * len(balls),
            functions=places.functions,
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


def _bind_geoms(geoms: CollisionGeoms, dynamics: Dynamics, world: World, margins: Array) -> ConstraintTerm:
    """The constraint on a simulator's distances, with margins (1 or T + 1, 1 or O)."""
    found = geoms.bind(dynamics, world, float(margins.max()) + 2 * geoms.size)
    if -1 in found.obstacles and margins.shape[1] > 1:
        want = f"one number for a knot, as there are {len(world)} obstacles"
        raise InputError(f"Clearance: margin: got {margins.shape[1]} numbers for a knot, want {want}")

    def describe(row: int) -> str:
        number = found.obstacles[row]
        own = margins[:, number % margins.shape[1]]
        low, high = f"{own.min():g}", f"{own.max():g}"
        said, what = low if low == high else f"{low} to {high}", f"obstacle {world.names[number]!r}"
        return f"a clearance of {said} m of {found.parts[row]!r} to {what if number >= 0 else 'all obstacles'}"

    rows, numbers = len(found.parts), np.maximum(found.obstacles, 0)
    return ConstraintTerm(
        source=found.filling(source_of(distance_constraint, AT=found.numbers, ROWS=max(1, rows))),
        data=np.concatenate([found.data, margins.shape, numbers, margins.ravel()]),
        rows=rows,
        describe=describe,
        shared=max(1, rows),
        functions=found.functions,
    )
