"""What a plan must keep to, besides the limits of the controls: inequalities at the steps.

To add a kind, subclass `Constraint` and write `bind`, as for a cost.
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lqrsim.codegen.kernel_source import source_of
from lqrsim.errors import Array, InputError, check_array, check_count, check_flag, check_function, check_number, excerpt
from lqrsim.kernels import clearance
from lqrsim.problem.costs import check_source
from lqrsim.problem.dynamics import Dynamics
from lqrsim.scenes.world import World


@dataclass(frozen=True)
class Inequalities:
    """A constraint, made for one system: so many numbers at each step that are not to be negative.

    Attributes:
      source: defines `value(x, u, t, row, data)`, which returns one of the numbers, and `slope(x, u, t, row, data,
        gradient)`, which *adds* its gradient (n+m,), states before controls. The numba subset; see `costs.Term`.
        Functions go by their bare names: `cos`, not `math.cos` or `np.cos`, which are refused.
      data: (any,) float64.
      rows: how many numbers there are at a step.
      says: what a message calls a row.
      uses_control: whether they depend on u; if so, they do not act at the last step, which has none.
    """

    source: str
    data: Array
    rows: int
    says: Callable[[int], str]
    uses_control: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "data", check_array("Inequalities: data", self.data, (None,), infinite=True))
        object.__setattr__(self, "rows", check_count("Inequalities: rows", self.rows, at_least=0))
        check_function("Inequalities: says", self.says, "a function of a row", optional=False)
        object.__setattr__(self, "uses_control", check_flag("Inequalities: uses_control", self.uses_control))
        check_source("Inequalities", self.source, {"value": 5, "slope": 6})


class Constraint(abc.ABC):
    """One constraint."""

    @abc.abstractmethod
    def bind(self, dynamics: Dynamics) -> Inequalities:
        """This constraint for a system. Raises InputError if it does not fit."""


class Clearance(Constraint):
    """At least `margin` between the robot and each obstacle, at the steps; walls are obstacles too.

    An ObstacleCost keeps away from obstacles as far as that pays, and can end inside one; this does not. Only at a
    start that is given exactly, about which nothing can be done, it does not act. Between two steps a plan can come a
    little nearer, by `v^2 dt^2 / 8 r` at the speed v along an obstacle of radius r, and what is thinner than a step is
    long it can step over. Which way round is better only a cost says: have an ObstacleCost, too, if only of a small
    weight, and the search has something to go by.

    Args:
      world: the obstacles; a robot in the plane sees them as for an ObstacleCost.
      radius: of the robot, in metres. margin: what is to be left beyond that, in metres.
    """

    def __init__(self, world: World, *, radius: float, margin: float = 0.0) -> None:
        if not isinstance(world, World):
            raise InputError(f"Clearance: world: got {excerpt(world)}, want a World, such as scene.world")
        self.world = world
        self.radius = check_number("Clearance: radius", radius, at_least=0.0)
        self.margin = check_number("Clearance: margin", margin)

    def bind(self, dynamics: Dynamics) -> Inequalities:
        space = dynamics.state_coordinates
        position = space.position
        if not position:
            raise InputError("Clearance: got dynamics without a position, want Dynamics(..., position=(names))")
        world = self.world.seen_by(space.plane, space.offset)
        return Inequalities(
            source=source_of(clearance, AXES=position),
            data=np.concatenate([[self.radius + self.margin], world.table.ravel()]),
            rows=len(world),
            says=lambda row: f"a clearance of {self.margin:g} m to obstacle {world.names[row]!r}",
        )
