"""The multipliers and penalties of the constraints while they are solved for; see `constrained.py`.

What the compiled loops make of them is in `kernels/augmented_lagrangian.py`.
"""

from collections.abc import Callable, Iterator

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels import declarations
from lqrsim.problem.constraints import ConstraintTerm, allowed_violation, violation_of
from lqrsim.results.solution_parts import Multipliers
from lqrsim.results.value_functions import Moments
from lqrsim.solvers.attempt import Attempt

PENALTY = 8.0  # at first, relative to what it costs to change what is constrained
GROWTH, LARGEST = 5.0, 1e4  # of the penalty; and how far it grows before that is given up


def _forces(term: ConstraintTerm, array: Array, values: Array) -> Array:
    """What the multipliers become: lambda - mu d, of inequalities not below 0; 0 where they do not act."""
    acting = np.where(np.isinf(values), 0.0, values)
    forces = np.clip(array[declarations.HEADER :] - array[0] * acting, -array[4] if term.equality else 0.0, array[4])
    return np.where(np.isinf(values), 0.0, forces)


def _missed(term: ConstraintTerm, array: Array, values: Array) -> float:
    """By how much a constraint is missed, or an inequality's multipliers are off, at most."""
    if term.equality:
        return float(np.abs(values).max(initial=0.0))
    forces = array[declarations.HEADER :] / array[0] if array[0] > 0 else 0.0
    return float(np.abs(np.minimum(values, forces)).max(initial=0.0))


class AugmentedLagrangian:
    """The multipliers of all constraints, in the memory that the compiled loops read.

    Inequalities and equalities each have a tolerance, and their penalties grow on their own.

    Attributes:
      kept: whether the plan that was evaluated last keeps the constraints.
      solved: whether it does so as well as is aimed at: inequalities with the tolerance to spare, and where more than
        that is left, with a multiplier that is not off by more: `|min(d, lambda / mu)|`; equalities `|d|`.
      nearly: whether it would if equalities could be missed by as much as inequalities have to spare.
      grown: by how much a penalty has grown. stuck: how often in a row that did not help.
    """

    def __init__(self, attempt: Attempt) -> None:
        self._problem, self._work = attempt.problem, attempt.work
        self._terms = attempt.problem.constraint_terms
        self._near = tolerance = attempt.settings.missed(attempt.problem)
        # Of inequalities and of equalities, if there are any.
        self._tolerance = {term.equality: allowed_violation(term, tolerance) or tolerance for term in self._terms}
        self.kept = self.solved = self.nearly = False
        self._restart()
        self._first = [array[0] for array in self._work.multipliers]  # zero, but for those of another solution

    def _restart(self) -> None:
        self._grown, self._last = dict.fromkeys(self._tolerance, 1.0), dict.fromkeys(self._tolerance, np.inf)
        self.stuck = 0

    @property
    def grown(self) -> float:
        return max(self._grown.values())

    def evaluate(self, states: Array, controls: Array) -> None:
        """Evaluate the constraints of a plan."""
        self._plan = states, controls
        stated = self._work.constraint_values(states, controls)
        self.kept = self._work.keeps(stated)
        self._values = [values.ravel() - array[3] for values, array in zip(stated, self._work.multipliers, strict=True)]
        missed = zip(self._terms, self._each(_missed), strict=True)
        self.solved = all(off <= self._tolerance[term.equality] for term, off in missed)
        pairs = zip(self._terms, stated, strict=True)
        beyond = max((violation_of(term, values) - term.equality * self._near for term, values in pairs), default=0.0)
        self.nearly = not self.kept and beyond <= 0

    def start(self) -> None:
        """No multipliers, and a penalty for each constraint that fits what it costs to change it."""
        self._restart()
        for which, (array, values) in enumerate(zip(self._work.multipliers, self._values, strict=True)):
            array[declarations.HEADER :] = 0.0
            if not self._first[which] > 0:
                # Only now: once there is a penalty, it is what the passes say of curvature.
                self._first[which] = PENALTY * self._curvature(which) if len(values) else 1.0
            array[0] = self._first[which]

    def update(self, growth: float = GROWTH) -> None:
        """Take the forces for the multipliers; let the penalty grow where that helps too little."""
        for term, array, values in self._constraints():
            array[declarations.HEADER :] = _forces(term, array, values)
        missed = dict.fromkeys(self._tolerance, -np.inf)
        for term, _, values in self._constraints():
            short = np.abs(values).max(initial=0.0) if term.equality else -values.min(initial=np.inf)
            missed[term.equality] = max(missed[term.equality], short)
        worst = max(missed, key=lambda kind: missed[kind])
        # Equalities that are nearly kept can be: what they wait for is a better minimum.
        near = {kind: kind and short <= self._near for kind, short in missed.items()}
        self.stuck = self.stuck + 1 if missed[worst] > 0.9 * self._last[worst] and not near[worst] else 0
        for kind, tolerance in self._tolerance.items():
            more = growth * self._grown[kind] <= LARGEST or not near[kind]
            if more and missed[kind] > max(0.5 * self._last[kind], tolerance):
                self._grown[kind] *= growth
                for term, array, _ in self._constraints():
                    array[0] *= growth if term.equality == kind else 1.0
        self._last = missed

    def added(self) -> float:
        """What the augmented Lagrangian adds to the cost of the plan."""

        def one(term: ConstraintTerm, array: Array, values: Array) -> float:
            known, acting = array[declarations.HEADER :], np.where(np.isinf(values), 0.0, values)
            forces = _forces(term, array, values)
            return float((forces @ (2 * (known - array[0] * acting) - forces) - known @ known) / (2 * array[0]))

        return sum(self._each(one))

    def multipliers(self) -> tuple[Multipliers, ...]:
        """As a solution has them: with the last plan taken into account."""

        def one(term: ConstraintTerm, array: Array, values: Array) -> Multipliers:
            return Multipliers(_forces(term, array, values).reshape(self._problem.steps + 1, -1), float(array[0]))

        return tuple(self._each(one))

    def worst(self) -> str:
        """Which constraint is missed most, by how much and when."""
        if self.kept and not self._work.priced:
            return "the plan keeps the constraints, but there are better ones"
        missed = [
            (np.abs(values) if term.equality else -(values + array[3])).max(initial=-np.inf)
            for term, array, values in self._constraints()
        ]
        beyond = [one - allowed_violation(term, self._near) for one, term in zip(missed, self._terms, strict=True)]
        which = int(np.argmax(beyond))
        step, row = divmod(self._worst_of(which), self._terms[which].rows)
        time = step * self._problem.dt
        return f"{self._terms[which].describe(row)} is missed by {missed[which]:.2g} at {time:.2f} s (step {step})"

    def _constraints(self) -> Iterator[tuple[ConstraintTerm, Array, Array]]:
        """Of each what it is, its multipliers, and its numbers as they are aimed at."""
        return zip(self._terms, self._work.multipliers, self._values, strict=True)

    def _each(self, function: Callable[[ConstraintTerm, Array, Array], "float | Multipliers"]) -> list:
        return [function(*one) for one in self._constraints()]

    def _worst_of(self, which: int) -> int:
        """Which of a constraint's numbers is missed most; of equals the first, or an equality's last, which acts."""
        values = self._values[which]
        if self._terms[which].equality:
            return len(values) - 1 - int(np.abs(values[::-1]).argmax())
        return int(values.argmin())

    def _curvature(self, which: int) -> float:
        """What it costs to change what is missed most: of an equality the most that it costs for any of its numbers."""
        step, row = divmod(self._worst_of(which), self._terms[which].rows)
        rows = range(self._terms[which].rows) if self._terms[which].equality else (row,)
        return max(self._curvature_of(which, step, row) for row in rows)

    def _curvature_of(self, which: int, step: int, row: int) -> float:
        """What it costs to change one of a constraint's numbers: twice the total cost of a change by 1 unit.

        `1 / n' (S + Sbar)^-1 n` of its slope n: the curvature of the total cost, the rest of the trajectory giving way.
        """
        states, controls = self._plan
        n, steps = states.shape[1], len(controls)
        slope = self._work.constraint_slope(which, row, states[step], controls[min(step, steps - 1)], step)
        values = self._work.value_functions()
        go, come = values["cost_to_go"], values["cost_to_come"]
        try:
            if isinstance(come, Moments):
                given = np.linalg.solve(np.eye(n) + come.covariance[step] @ go.hessian[step], come.covariance[step])
            else:
                given = np.linalg.inv(go.hessian[step] + come.hessian[step])
        except np.linalg.LinAlgError:
            return 1.0
        spread = np.zeros((len(slope), len(slope)))
        gain = self._work.arrays.policy.gain[min(step, steps - 1)]
        spread[:n, :n], spread[n:, n:] = given, gain @ given @ gain.T
        spread[:n, n:], spread[n:, :n] = given @ gain.T, gain @ given
        response = float(slope @ spread @ slope)
        return 1 / response if response > 0 else 1.0
