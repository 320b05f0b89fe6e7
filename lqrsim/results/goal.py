"""The goal of a trial, distances from goal and plan, and the ways in which a trial ends, for every robot. NumPy only.

Distances are in metres for robots with a position. For other robots they are a scaled error: the largest difference
among the states that count, from the goal relative to the way from the start (`Target.scale`), from the plan relative
to the state's range along it (at least 1 unit). Whole turns are left out.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lqrsim.annotations import Positive, checked
from lqrsim.errors import Array, InputError, check_number, excerpt, keep, shaped
from lqrsim.results.coordinates import Coordinates

OUTCOMES = ("reached", "timed out", "collided", "diverged", "error")
TOLERANCE = 0.1  # default tolerance of the scaled error
NEAR_GOAL = 4.0  # robot radii within which a start is so near its goal that the radius says little
AT_GOAL = 1e-3  # fraction of a radius; a plan that begins closer to its goal is to stay there
NEGLIGIBLE = 1e-6  # in the units of a state; a shorter way is rounding
ON_PLAN = 1e-4  # of the ranges, in `departure`
SHORT_WAY = 0.01  # of the longest way in a unit; a state with a shorter way starts at its goal
OF_RANGE, OF_WAY = "of the plan's range", "of the way"


def scale_of(plan: Array) -> Array:
    """The scale (n,) of each state's differences: its range along a plan (T+1, n), at least 1 unit."""
    return np.maximum(np.ptp(plan, axis=0), 1.0)


def worst_of(space: Coordinates, off: Array, scale: Array, tolerance: float | None = None) -> str:
    """The state with the largest of the differences (n,), relative to their scale (n,), as text: "elbow -0.1 rad".

    Empty if none differs. With a tolerance, which is relative to the scale, also what it allows that state.
    """
    if not off.any():
        return ""
    worst = int(np.argmax(np.abs(off) / scale))
    unit = space.units[worst]
    allowed = "" if tolerance is None else f", allowed {tolerance * scale[worst]:.3g} {unit}".rstrip()
    return f"{space.names[worst]} {off[worst]:+.3g} {unit}".rstrip() + allowed


def departure(space: Coordinates, states: Array, plan: Array, dt: float) -> str:
    """Where a run (T+1, n) leaves a plan (T+1, n), as text: "LEAVES the plan at 0.4 s: ..."; empty if it does not.

    It leaves the plan where a state is not finite, or off by more than TOLERANCE of the largest range along the plan in
    its unit. A run that was still on the plan a period before, to within ON_PLAN of that, met a step that jumps.
    """
    units, ranges = np.array(space.units), np.ptp(plan, axis=0)
    alike = (units[:, None] == units) & (units != "") | np.eye(len(units), dtype=bool)
    scale = (alike * ranges).max(axis=1)
    scale = np.where(scale > NEGLIGIBLE, scale, 1.0)
    off = space.difference(states, plan)
    error = np.max(np.abs(off) / scale, axis=1)
    left = ~(error <= TOLERANCE)
    if not left.any():
        return ""
    knot = int(np.argmax(left))
    if not np.isfinite(error[knot]):
        return f"does not get beyond {(knot - 1) * dt:.4g} s of the plan"
    text = f"LEAVES the plan at {knot * dt:.4g} s: {worst_of(space, off[knot], scale, TOLERANCE)}"
    if knot and error[knot - 1] <= ON_PLAN:
        why = "that step jumps, as where a contact or a limit begins, and a rounding error decides which way"
        text += f"; a period before, no state was off by more than {error[knot - 1]:.1g} of its range: {why}"
    return text


def tracking_unit(space: Coordinates) -> str:
    """The unit of tracking errors: m, or OF_RANGE for robots without a position."""
    return "m" if space.position else OF_RANGE


@dataclass(frozen=True, eq=False)
class Target:
    """The goal of a run, or the end of its plan if the final cost names no goal."""

    space: Coordinates
    goal: Array | None  # (n,), NaN in the states that do not count
    plan: Array

    def __post_init__(self) -> None:
        if self.goal is None:
            return
        goal = shaped("goal", self.goal, (len(self.space),))
        if np.isinf(goal).any():
            raise InputError(f"goal: got {excerpt(goal.tolist())}, want finite numbers, or NaN for any state")
        if np.isnan(goal).all():
            raise InputError("goal: got NaN for every state, want a number for at least one, or None without a goal")
        keep(self, goal=goal)

    @property
    def state(self) -> Array:
        """(n,), the goal or the end of the plan; NaN in the states that do not count."""
        return self.plan[-1] if self.goal is None else self.goal

    @property
    def name(self) -> str:
        return "plan's end" if self.goal is None else "goal"

    @property
    def places(self) -> list[int]:
        """Indices of the position that count; none if the distance is a scaled error."""
        return [i for i in self.space.position if np.isfinite(self.state[i])]

    @property
    def unit(self) -> str:
        """Unit of `distance`: m, or OF_WAY."""
        return "m" if self.places else OF_WAY

    @cached_property
    def scale(self) -> Array:
        """What the scaled error divides the difference of each state by, (n,).

        It is the state's way, from the start of the plan to the goal. A state whose way is within TOLERANCE of its
        range along the plan, or SHORT_WAY of the longest way in its unit or of the distance between its own limits,
        starts at its goal: it has its range, and at least the longest way in its unit. If no state in that unit has a
        way, it has at least their largest range, and 1 rad, or the distance between its own limits, such as those of a
        gripper's finger; and its rate as much in a second. If all states start at their goals there is nothing to be
        relative to, and each has at least 1 unit.
        """
        counts, start, ranges = np.isfinite(self.state), self.plan[0], np.ptp(self.plan, axis=0)
        way = np.abs(self._off(start)) * (np.abs(self._off(start)) > NEGLIGIBLE)
        units = np.array(self.space.units)
        alike = (units[:, None] == units) & (units != "") & counts | np.eye(len(units), dtype=bool)
        between = np.subtract(self.space.high, self.space.low)
        between = np.where(np.isfinite(between), between, 0.0)
        little = np.maximum(TOLERANCE * ranges, SHORT_WAY * np.maximum(between, (alike * way).max(axis=1)))
        moves = counts & (way > little)
        longest = (alike * np.where(moves, way, 0.0)).max(axis=1)
        least = np.where(longest > 0, longest, (alike * ranges).max(axis=1))
        held = np.where(longest == 0, np.where(units == "rad", 1.0, between), 0.0)
        rates = units[:, None] == np.char.add(units, "/s")
        rested = np.where((rates & (longest > 0)).any(axis=1) | (longest > 0), 0.0, (rates * held).max(axis=1))
        least = np.maximum(least, np.maximum(held, rested))
        if (way <= AT_GOAL * ranges).all():
            least = np.maximum(least, 1.0)
        scale = np.where(moves, way, np.maximum(ranges, least))
        return np.where(scale > NEGLIGIBLE, scale, 1.0)

    def _off(self, states: Array) -> Array:
        """Differences (..., n) of states from the target, zero in the states that do not count.

        Those keep their value in between, because the turns of a rotation vector follow from all three entries.
        """
        counts = np.isfinite(self.state)
        return np.where(counts, self.space.difference(states, np.where(counts, self.state, states)), 0.0)

    def distance(self, states: Array) -> Array:
        """Distance (...) of states (..., n) from the target; NaN for states that are not finite."""
        state = self.state
        if self.places:
            return np.linalg.norm(states[..., self.places] - state[self.places], axis=-1)
        error = np.max(np.abs(self._off(states)) / self.scale, axis=-1)
        return np.where(np.isfinite(states).all(axis=-1), error, np.nan)

    @checked
    def radius(
        self, robot_radius: float | None, goal_radius: Positive | None, goal_tolerance: Positive | None
    ) -> float:
        """The distance within which the target counts as reached.

        Args:
          robot_radius: radius of the robot, the default goal radius if distances are in metres; see `on_the_way`.
          goal_tolerance: bound of the scaled error, by default TOLERANCE; see `on_the_way`.
        """
        if self.places:
            if goal_tolerance is not None:
                want = f"goal_radius, in metres: the {self.name} has a position"
                raise InputError(f"goal_tolerance: got {excerpt(goal_tolerance)}, want {want}")
            if goal_radius is not None:
                return goal_radius
            return self.on_the_way(check_number("goal_radius", robot_radius, above=0.0))
        if goal_radius is not None:
            why = f"relative to the way: the {self.name} has no position among {', '.join(self.space.names)}"
            raise InputError(f"goal_radius: got {excerpt(goal_radius)}, want goal_tolerance, {why}")
        if goal_tolerance is not None:
            return goal_tolerance
        return self.on_the_way(TOLERANCE)

    def radius_of_plan(self, radius: float | None) -> float | None:
        """The radius if it is given; else that of the scaled error. None in metres: the robot's is the default."""
        return self.on_the_way(TOLERANCE) if radius is None and not self.places else radius

    def on_the_way(self, radius: float) -> float:
        """The radius; for a plan that starts near its target, a tenth of the distance between the two.

        A plan starts near its target within four radii in metres, because the radius of a robot with arms is their
        reach, or within one radius if the error is scaled. A plan that starts at its target keeps the radius.
        """
        way, near = float(self.distance(self.plan[0])), NEAR_GOAL * radius if self.places else radius
        return TOLERANCE * way if AT_GOAL * radius < way <= near else radius

    def describe(self, distance: float) -> str:
        """A distance as text: "0.1 m from the goal", "10 % of the way from the goal"."""
        return f"{self._measured(distance)} from the {self.name}"

    def _measured(self, distance: float) -> str:
        return f"{distance:.3g} m" if self.places else f"{100 * distance:.3g} % {OF_WAY}"

    def misses(self, radius: float | None) -> bool:
        """Whether the plan ends outside the radius; False if the radius is not known."""
        return radius is not None and not float(self.distance(self.plan[-1])) <= radius

    def misses_goal(self, radius: float | None) -> bool:
        """Whether the problem names a goal and the plan ends outside the radius.

        Without a radius, a plan misses if it ends farther from the goal than a tenth of the way from its start; of the
        farthest on the way, if it starts at the goal.
        """
        if radius is None:
            away = self.distance(self.plan)
            radius = max(TOLERANCE * float(away[0] if away[0] > NEGLIGIBLE else away.max()), NEGLIGIBLE)
        return self.goal is not None and self.misses(radius)

    def of_plan(self, radius: float | None) -> list[str]:
        """Lines on the end of the plan: its distance from the goal, and another line if the plan misses the goal."""
        if self.goal is None:
            return ["the final cost names no goal; the plan's end stands in for it"]
        within = ""
        if radius is not None:
            within = f", which is reached within {self._measured(radius).removesuffix(f' {OF_WAY}')}"
        worst = self.worst(self.plan[-1], radius)
        end = self.describe(float(self.distance(self.plan[-1])))
        lines = [f"the plan ends {end}{within}{f': {worst}' if worst else ''}"]
        if self.misses_goal(radius):
            by = "" if radius is not None else f" by more than {TOLERANCE:.0%} of the way"
            mend = "raise the weights of the final cost or, if controls are at their limits, the number of steps"
            lines.append(f"the plan MISSES the goal{by}: {mend}")
        return lines

    def worst(self, state: Array, radius: float | None) -> str:
        """The state that counts and is farthest from the target, by how much, and how far it may be.

        Empty for a target with a position, and for a state that is at the target.

        Args:
          radius: the scaled error within which the target counts as reached; None if it is not known.
        """
        return "" if self.places else worst_of(self.space, self._off(state), self.scale, radius)
