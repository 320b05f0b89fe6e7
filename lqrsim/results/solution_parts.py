"""What a `Solution` is made of: trajectory, status, log, certificate, multipliers, candidates. NumPy only."""

import enum
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_count, check_kind, check_number, check_text, shaped

# How a horizon goes on: it moves along with the robot, or its end stays where it is.
HORIZONS = ("moving", "shrinking")


def left_after(steps: int, array: npt.ArrayLike, *, filled: bool) -> Array:
    """What is left of an array (T, ...) after so many steps; `filled` up with the last to the same length."""
    array = np.asarray(array)
    rest = array[steps:]
    return np.concatenate([rest, np.repeat(array[-1:], steps, axis=0)]) if filled and steps else rest


@dataclass(frozen=True)
class Trajectory:
    """States and the controls held between them.

    Attributes:
      states: (T+1, n).
      controls: (T, m).
      dt: seconds between two states.

    Raises:
      InputError: they do not fit together, there is no step, or dt is not above 0. NaN is what a failed solve has.
    """

    states: Array
    controls: Array
    dt: float

    def __post_init__(self) -> None:
        controls = shaped("Trajectory: controls", self.controls, (None, None))
        if not controls.size:
            raise InputError(f"Trajectory: controls: got shape {controls.shape}, want (T, m), at least one of each")
        states = shaped("Trajectory: states", self.states, (len(controls) + 1, None))
        if not states.size:
            raise InputError(f"Trajectory: states: got shape {states.shape}, want ({len(states)}, n), at least one n")
        object.__setattr__(self, "states", states)
        object.__setattr__(self, "controls", controls)
        object.__setattr__(self, "dt", check_number("Trajectory: dt", self.dt, above=0.0))

    @property
    def steps(self) -> int:
        """T, the number of control periods."""
        return len(self.controls)

    @property
    def horizon(self) -> float:
        """Duration in seconds; the paper's l."""
        return self.steps * self.dt

    @property
    def times(self) -> Array:
        """Times of the states in seconds, (T+1,)."""
        return self.dt * np.arange(self.steps + 1)


class Status(enum.StrEnum):
    """How a solve ended. `meaning` says it in words, `remedy` what to try."""

    CONVERGED = "converged"
    COST_CONVERGED = "cost converged"
    MAX_ITERATIONS = "max iterations"
    STALLED = "stalled"
    TIME_LIMIT = "time limit"
    INTERRUPTED = "interrupted"
    INFEASIBLE = "infeasible"
    DIVERGED = "diverged"
    NOT_FINITE = "not finite"
    NOT_POSITIVE_DEFINITE = "not positive definite"
    RISK_TOO_HIGH = "risk too high"
    NOT_CERTIFIED = "not certified"

    @property
    def success(self) -> bool:
        """True for CONVERGED, and for COST_CONVERGED, where only the cost was asked for."""
        return self in (Status.CONVERGED, Status.COST_CONVERGED)

    @property
    def meaning(self) -> str:
        return _STATUS_TEXT[self][0]

    @property
    def remedy(self) -> str:
        """What to try; empty where nothing needs to be."""
        return _STATUS_TEXT[self][1]


_STATUS_TEXT = {
    Status.CONVERGED: ("optimality and, with a cost-to-come, the gap are within tolerance", ""),
    Status.COST_CONVERGED: (
        "the change of cost is within tolerance; gap and optimality were not asked for",
        'look at the gap, or solve with stop="optimal"',
    ),
    Status.MAX_ITERATIONS: (
        "the iteration limit came first",
        "raise max_iterations if the improvements still shrink; if they do not, try another start",
    ),
    Status.STALLED: (
        "no step makes the plan better, though it is not within tolerance",
        "try another start; scale states, controls and costs to similar sizes; or accept a larger tolerance",
    ),
    Status.TIME_LIMIT: (
        "the time limit came first; the plan is the best so far",
        "raise time_limit, or begin nearer: start=solution of a similar problem",
    ),
    Status.INTERRUPTED: (
        "the callback raised, or Ctrl-C; the plan is the best so far",
        "solve again, from start=solution",
    ),
    Status.INFEASIBLE: (
        "the constraints cannot be met, at least not near the plan that misses them least",
        "relax the constraint that is named, give more time, or try another start",
    ),
    Status.DIVERGED: (
        "the cost of the policy grew beyond all bounds",
        "try a start nearer to a solution or an InitialPrior, shorten dt, or try the other solver",
    ),
    Status.NOT_FINITE: (
        "a NaN or an infinity appeared",
        "check the dynamics and the cost at the step that is named; try another start; shorten dt",
    ),
    Status.NOT_POSITIVE_DEFINITE: (
        "a matrix that must be inverted was not positive definite",
        "raise the control weight, start with an InitialPrior, shorten dt, or try the other solver",
    ),
    Status.RISK_TOO_HIGH: (
        "the expectation of exp(risk * cost) does not exist: the noise is too strong for so much risk aversion",
        "lower the risk, below the largest that is named, or the noise; or begin with start=solution of a lower risk",
    ),
    Status.NOT_CERTIFIED: (
        "the method converged, but its plan, checked against the problem, is not what it claims",
        "try another start or form; and please report it, for it is a fault of lqrsim",
    ),
}


ITERATION_NUMBERS = ("cost", "improvement", "gap", "optimality", "dynamics_residual", "violation", "seconds")


@dataclass(frozen=True)
class Iteration:
    """One line of the log.

    Attributes:
      cost: true cost of rolling the policy out under the true dynamics, with noise that which is expected; NaN where it
        was only to keep the constraints.
      improvement: `(previous cost - cost) / |cost|`; infinite in the first iteration. Of damped iterations with
        constraints it is of the cost with the augmented Lagrangian, and so is the optimality.
      gap: largest difference between the minimal-total-cost states and that rollout, each state relative to its
        range along the rollout (at least 1 unit). Where the safeguard went part of the way, they are taken there; 0 for
        steps of iLQR, Newton's method and restoration, which have none. Of the interior point it is the largest between
        two steps of its plan, which need not obey the dynamics until the end.
      optimality: the decrease that a linear-quadratic model about the rollout still predicts, relative to the cost; NaN
        where it was not evaluated (it is once the other tests pass, and after the last iteration). Of the interior
        point it is what is left of the optimality conditions: the slope of the Lagrangian in a control, times the
        control's range, or the product of a multiplier and its slack, the larger one, relative to the cost.
      dynamics_residual: how far one step of the true dynamics takes a minimal-total-cost state from the next one, at
        most; relative as the gap is, and evaluated where the optimality is. The plan itself is a rollout, and has none.
        Of the interior point it is the gap.
      violation: by how much the worst constraint is missed at the steps, in its unit; 0 where all inequalities are
        kept and there are no equalities, which are off by rounding at least; NaN where it was not evaluated.
      seconds: time this iteration took.
      method: "smooth", the paper's; "newton", at the end; with constraints or limits "interior point", and
        "restoration", a descent in which constraints may be missed at a price; of the safeguard's "damped", or "ilqr"
        where its step is that of iLQR; of Newton's method and the safeguard "rejected" (it would have cost more, or a
        pass failed; cost is that of the plan that was kept).
    """

    cost: float
    improvement: float
    gap: float
    optimality: float
    dynamics_residual: float
    violation: float
    seconds: float
    method: str

    def __post_init__(self) -> None:
        for name in ITERATION_NUMBERS:
            if type(value := getattr(self, name)) is not float:
                object.__setattr__(self, name, float(shaped(f"Iteration: {name}", value, ())))
        check_kind("Iteration: method", self.method, str, "text")

    HEADER = (
        f"{'iteration':>9} {'cost':>14} {'improvement':>12} {'gap':>10} {'optimality':>11} {'violation':>10} {'ms':>8}"
        "  method"
    )

    def row(self, number: int) -> str:
        """This iteration as a line under `HEADER`.

        Args:
          number: of the iteration, from 1.

        Returns:
          A line of text.
        """
        number = check_count("number", number, at_least=0)
        optimality = "-" if np.isnan(self.optimality) else f"{self.optimality:.1e}"
        improvement = "-" if np.isinf(self.improvement) else f"{self.improvement:.2e}"
        gap = "-" if np.isnan(self.gap) else f"{self.gap:.1e}"
        violation = "-" if np.isnan(self.violation) else f"{self.violation:.1e}"
        return (
            f"{number:>9} {self.cost:>14.9g} {improvement:>12} {gap:>10} {optimality:>11} {violation:>10}"
            f" {1e3 * self.seconds:>8.2f}  {self.method}"
        )


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """What the plan is, recomputed from the problem after the solve, on a path that the solvers do not use.

    A solution that says CONVERGED has passed: optimality and violation are within tolerance, the rest within rounding.

    Attributes:
      cost: of the plan; see `Solution.cost`.
      start: largest difference between its first state and a `FixedState`; 0 where the start is not fixed.
      dynamics_residual: largest difference between a state and one step of the dynamics from the state before, each
        state relative to its largest size along the plan, at least 1 unit.
      policy_residual: largest difference between a control and the policy's at that state, relative to the terms of
        `L x + l`.
      limits: how far a control is beyond its limits, in its unit.
      violation: by how much the worst constraint is missed at the steps, in its unit; 0 where all inequalities are
        kept and there are no equalities. Of a converged plan it is at most `constraint_tolerance`, of equalities at
        most 1e-6, unless constraints are elastic.
      optimality: the decrease of cost that the slopes of the cost in the policy's offsets (and in a start that is not
        fixed) still promise, relative to the cost; infinite where there is no cost-to-go to weigh them with.
    """

    cost: float
    start: float
    dynamics_residual: float
    policy_residual: float
    limits: float
    violation: float
    optimality: float

    def __post_init__(self) -> None:
        for field in fields(self):
            value = float(shaped(f"Certificate: {field.name}", getattr(self, field.name), ()))
            object.__setattr__(self, field.name, value)


@dataclass(frozen=True)
class Multipliers:
    """What a constraint presses with, at each step: zero where an inequality is kept with room to spare.

    Attributes:
      values: (T+1, rows): what a unit more of the constraint would cost; of an inequality not negative.
      penalty: mu of the augmented Lagrangian, which holds the policy to the constraint.
    """

    values: Array
    penalty: float

    def __post_init__(self) -> None:
        values = shaped("Multipliers: values", self.values, (None, None))
        if not len(values):
            raise InputError(f"Multipliers: values: got shape {values.shape}, want (T+1, rows)")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "penalty", check_number("Multipliers: penalty", self.penalty, at_least=0.0))


@dataclass(frozen=True)
class Candidate:
    """One of several starts that a search tried.

    Attributes:
      start: what it was.
      cost: true cost of the last plan that it led to; infinite if a pass failed, or the plan is only to keep the
        constraints.
      iterations: how many it took until then.
      status: how it ended; None where it was dropped after a few iterations.
      trajectory: that plan.
    """

    start: str
    cost: float
    iterations: int
    status: Status | None
    trajectory: Trajectory

    def __post_init__(self) -> None:
        check_text("Candidate: start", self.start, "what it was", at_most=1000, empty=True)
        if np.isnan(cost := float(shaped("Candidate: cost", self.cost, ()))):
            raise InputError("Candidate: cost: got nan, want a number, infinite where there is none")
        object.__setattr__(self, "cost", cost)
        check_count("Candidate: iterations", self.iterations, at_least=0)
        check_kind("Candidate: status", self.status, (Status, type(None)), "a Status or None")
        check_kind("Candidate: trajectory", self.trajectory, Trajectory, "a Trajectory")
