"""What a prepared solver returns: a plan, and how the solve went. NumPy only."""

from dataclasses import dataclass

from lqrsim.results.plan import Plan


@dataclass(frozen=True, kw_only=True)
class Replan(Plan):
    """A plan from a given state that is no worse than where the law led that the solve began with.

    No worse means: it keeps the constraints if that did, misses them by no more if that did not, and of two plans that
    keep them it is not the more expensive one. It can be used whatever its status, unless `cost` is not finite. What it
    shares with a `Solution` is in `Plan`.

    Attributes:
      improved: whether there is a new plan; else this is where the law leads that the solve began with.
      cost: of the plan, start and end included.
      before: of where the law led that the solve began with.
      violation: by how much the worst constraint is missed at the steps; 0 where none is.
      iterations: how many there were.
      seconds: how long the solve took.
      iterating: how much of that, in seconds, the iterations took, and to see where the law leads that the solve began
        with.
    """

    improved: bool
    cost: float
    before: float
    violation: float
    iterations: int
    seconds: float
    iterating: float
