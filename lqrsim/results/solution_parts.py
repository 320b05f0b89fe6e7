"""Parts of a `Solution`: trajectory, status, log, certificate, multipliers, candidates. NumPy only."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Index, Line, NonNegative, OneOf, Positive, checked, repr_of
from lqrsim.errors import Array, InputError

# The end of a "moving" horizon moves along with the robot; the end of a "shrinking" horizon stays.
HORIZONS = ("moving", "shrinking")
Horizon = Annotated[str, OneOf(HORIZONS)]
COARSE = 1e-4  # error of a step that a solution mentions: over a hundred steps it may add up to a hundredth


def left_after(steps: int, array: npt.ArrayLike, *, filled: bool) -> Array:
    """An array (T, ...) without its first steps; with `filled` the last entry is repeated to keep the length."""
    array = np.asarray(array)
    remaining = array[steps:]
    return np.concatenate([remaining, np.repeat(array[-1:], steps, axis=0)]) if filled and steps else remaining


@checked
@dataclass(frozen=True, eq=False)
class Trajectory:
    """States and the controls held between them, `dt` seconds each. Failed solves contain NaN, which is allowed."""

    states: Annotated[Array, "T+1 n"]
    controls: Annotated[Array, "T m"]
    dt: Positive

    __repr__ = repr_of

    def __post_init__(self) -> None:
        sizes = {"T": self.steps, "n": self.states.shape[1], "m": self.controls.shape[1]}
        if not min(sizes.values()):
            raise InputError(f"Trajectory: got {sizes}, want at least one step, state and control")

    @property
    def steps(self) -> int:
        """T, the number of control periods."""
        return len(self.controls)

    @property
    def finite(self) -> bool:
        """Whether all states and controls are finite."""
        return bool(np.isfinite(self.states).all() and np.isfinite(self.controls).all())

    @property
    def horizon(self) -> float:
        """Duration in seconds; l in the paper."""
        return self.steps * self.dt

    @property
    def times(self) -> Array:
        """Times of the states in seconds, (T+1,)."""
        return self.dt * np.arange(self.steps + 1)


class Status(enum.StrEnum):
    """The way in which a solve ended, with a `remedy` to try; none for CONVERGED."""

    meaning: str
    remedy: str

    def __new__(cls, value: str, meaning: str, remedy: str = "") -> "Status":
        member = str.__new__(cls, value)
        member._value_, member.meaning, member.remedy = value, meaning, remedy
        return member

    CONVERGED = "converged", "optimality and, with a cost-to-come, the gap are within tolerance"
    COST_CONVERGED = ("cost converged", "the change of cost is within tolerance; gap and optimality were not tested",
                      'check the gap, or solve with stop="optimal"')  # fmt: skip
    MAX_ITERATIONS = "max iterations", "the iteration limit was reached", "raise max_iterations"
    STALLED = ("stalled", "no step makes the plan better, though it is not within tolerance",
               "begin with another start, or accept a larger tolerance")  # fmt: skip
    TIME_LIMIT = ("time limit", "the time limit was reached; the plan is the best so far",
                  "raise time_limit, or start nearer: start=solution of a similar problem")  # fmt: skip
    INTERRUPTED = ("interrupted",
                   "the callback raised an exception, or Ctrl-C was pressed; the plan is the best so far",
                   "solve again, from start=solution")  # fmt: skip
    INFEASIBLE = ("infeasible", "the constraints cannot be met, at least near the plan with the least violation",
                  "relax the constraint that is named, allow more time, or try another start")  # fmt: skip
    DIVERGED = ("diverged", "the cost of the policy grew, or fell, beyond all bounds",
                "raise the control weight, or give control_limits and StateBounds")  # fmt: skip
    NOT_FINITE = ("not finite", "a NaN or an infinity appeared",
                  "check the dynamics and the cost at the step that is named, or begin with another start")  # fmt: skip
    NOT_POSITIVE_DEFINITE = ("not positive definite", "a matrix that must be inverted was not positive definite",
                             "raise the control weight, or begin with another start")  # fmt: skip
    RISK_TOO_HIGH = ("risk too high",
                     "the expectation of exp(risk * cost) is infinite: the noise is too strong for this risk",
                     "lower the risk below the largest that is named, or lower the noise")  # fmt: skip
    NOT_CERTIFIED = ("not certified", "the method converged, but a check of its plan against the problem failed",
                     "try another start or form, and please report it: this is a bug in lqrsim")  # fmt: skip

    @property
    def success(self) -> bool:
        """True for CONVERGED, and for COST_CONVERGED, for which only the cost was tested."""
        return self in (Status.CONVERGED, Status.COST_CONVERGED)


class Curvature(enum.StrEnum):
    """The curvature of the cost at a plan, along all changes that keep dynamics, limits and active constraints.

    MINIMUM: positive along all, so that no nearby plan is as good. SINGULAR: zero along some, as for least time or
    costs that are flat. SADDLE: negative along some. NOT_CHECKED: the plan is not converged, or second derivatives are
    not exact, or noise adds to the cost.
    """

    MINIMUM = "minimum"
    SINGULAR = "singular"
    SADDLE = "saddle"
    NOT_CHECKED = "not checked"


@checked
@dataclass(frozen=True)
class Iteration:
    """One line of the log.

    Attributes:
      cost: cost of the policy's rollout under the true dynamics; with noise, its expectation. NaN while the iterations
        only try to satisfy the constraints.
      improvement: `(previous cost - cost) / |cost|`; infinite in the first iteration. In damped iterations with
        constraints this and the optimality refer to the augmented Lagrangian.
      gap: largest difference between the states of minimal total cost and the rollout, each state relative to its
        range along the rollout (at least 1 unit); after a partial step of the safeguard, the states of that step. 0
        for steps of iLQR, Newton's method and restoration. In the interior point method it is the largest defect of
        the dynamics between two steps of its plan, which is zero only at the end.
      optimality: the decrease that a linear-quadratic model about the rollout still predicts, relative to the cost. It
        is evaluated once the other tests pass, and after the last iteration; else it is NaN. In the interior
        point method it is the residual of the optimality conditions, relative to the cost: the larger of the gradient
        of the Lagrangian in a control times the control's range, and the product of a multiplier and its slack.
      dynamics_residual: largest defect of the dynamics between two states of minimal total cost, relative as the gap
        is, and evaluated when the optimality is. The plan itself is a rollout and has no defect. In the interior point
        method it equals the gap.
      violation: violation of the worst constraint at the steps, in its unit. 0 if all inequalities hold and there are
        no equalities, which have at least rounding errors. NaN if it was not evaluated.
      method: "smooth", the paper's; "newton", at the end; "contact modes", see `Certificate.contacts`; with
        constraints or limits "interior point", and "restoration", a descent on cost and penalised violation; in the
        safeguard "damped", or "ilqr" if its step is an iLQR step; in Newton's method and the safeguard "rejected"
        (the cost would have risen, or a pass failed; the cost belongs to the plan that was kept).
    """

    cost: float
    improvement: float
    gap: float
    optimality: float
    dynamics_residual: float
    violation: float
    seconds: float
    method: Line

    HEADER = (
        f"{'iteration':>9} {'cost':>14} {'improvement':>12} {'gap':>10} {'optimality':>11} {'violation':>10} {'ms':>8}"
        "  method"
    )

    @checked
    def row(self, number: Index) -> str:
        """The line of this iteration in the table under `HEADER`."""
        optimality = "-" if np.isnan(self.optimality) else f"{self.optimality:.1e}"
        improvement = "-" if np.isinf(self.improvement) else f"{self.improvement:.2e}"
        gap = "-" if np.isnan(self.gap) else f"{self.gap:.1e}"
        violation = "-" if np.isnan(self.violation) else f"{self.violation:.1e}"
        return (
            f"{number:>9} {self.cost:>14.9g} {improvement:>12} {gap:>10} {optimality:>11} {violation:>10}"
            f" {1e3 * self.seconds:>8.2f}  {self.method}"
        )


@checked
@dataclass(frozen=True, kw_only=True)
class ContactCertificate:
    """The costs around a plan that keeps to its contact modes, from rollouts of its policy with other offsets.

    At a *switch* a contact, a limit or an edge of friction begins to act or lets go; the cost jumps or has a kink
    there. All costs are relative to the cost of the plan.

    Attributes:
      pressed: number of switches that the plan is pressed against; without them, its cost would decrease.
      across: cost that the cheapest plan across a switch saves, on rays up to 128 times the radius. Negative if all
        cost more; minus infinity if there are no switches, or none can be crossed on its own.
      sampled: cost that the cheapest of the sampled plans saves; negative if all cost more.
      radius: largest change of a control in these plans, as a fraction of its range.
    """

    pressed: int
    across: float
    sampled: float
    radius: float
    samples: int

    def __str__(self) -> str:
        sides = f", across each the cheapest is {-self.across:+.1e}" if np.isfinite(self.across) else ""
        plans = f"of {self.samples} plans within {self.radius:g} of the controls' ranges the cheapest is"
        return f"optimal within the modes, against {self.pressed} switches{sides}; {plans} {-self.sampled:+.1e}"


@checked
@dataclass(frozen=True, kw_only=True)
class Certificate:
    """Measures of a plan, recomputed from the problem after the solve by code that the solvers do not use.

    If CONVERGED, optimality is within twice its tolerance, violation within its own, other residuals within rounding.

    Attributes:
      cost: cost of the plan; see `Solution.cost`.
      start: largest difference between the first state and a `FixedState`; 0 if the start is not fixed.
      dynamics_residual: largest difference between a state and one step of the dynamics from the state before, each
        state relative to its largest size along the plan, at least 1 unit.
      policy_residual: largest difference between a control and the policy's at that state, relative to the terms of
        `L x + l`.
      limits: largest distance of a control beyond its limits, in its unit.
      violation: violation of the worst constraint at the steps, in its unit; 0 if all inequalities hold and there are
        no equalities. At most `constraint_tolerance` if converged, 1e-6 for equalities, unless they are elastic.
      optimality: the decrease of cost that the gradient in the policy's offsets (and in a free start) still predicts,
        relative to the cost; infinite without a cost-to-go, which is needed to weigh the gradient. With `contacts` it
        is the decrease within the plan's contact modes, where switches bound the steps as limits bound controls.
      contacts: for a plan through contacts of an MJCF that ends at the edge of its contact modes; None otherwise.
      curvature: whether a converged plan is a minimum, by the exact second derivatives of problem and constraints.
    """

    cost: float
    start: float
    dynamics_residual: float
    policy_residual: float
    limits: float
    violation: float
    optimality: float
    contacts: ContactCertificate | None = None
    curvature: Curvature = Curvature.NOT_CHECKED


@checked
@dataclass(frozen=True, eq=False)
class Multipliers:
    """The multipliers of a constraint, one for each row at each step; zero where an inequality is inactive.

    Attributes:
      values: (T+1, rows): the change of cost with a unit of the constraint; not negative for an inequality.
      penalty: weight mu of the augmented Lagrangian.
    """

    values: Annotated[Array, "T+1 _"]
    penalty: NonNegative

    __repr__ = repr_of


@checked
@dataclass(frozen=True, eq=False)
class Candidate:
    """One of several starts that a search tried; or a plan for softer contacts, from which the next plan begins.

    Attributes:
      cost: cost of its last plan; infinite if a pass failed, or if the plan was only to meet the constraints.
      status: status at its end; None if it was dropped after a few iterations.
    """

    start: Line
    cost: float
    iterations: int
    status: Status | None
    trajectory: Trajectory

    __repr__ = repr_of

    def __post_init__(self) -> None:
        if np.isnan(self.cost):
            raise InputError("Candidate: cost: got nan, want a number, infinite where there is none")


@dataclass(frozen=True, eq=False)
class BetweenKnots:
    """What a plan does between its knots, in continuous time, with the controls held.

    Attributes:
      step_error: largest difference between a knot and the exact motion from the knot before, each state relative to
        its largest size along the plan, at least 1 unit. 0 for steps of MuJoCo, whose physics steps are the motion.
      end_error: the same for the last knot and the exact motion from the first knot under the plan's controls.
      violations: name of an inequality, as in `Problem.violations` -> its largest violation between the knots, in its
        unit, and when, in s; for all that are violated by more than rounding. Obstacles that move are left out.
    """

    step_error: float
    end_error: float
    violations: Mapping[str, tuple[float, float]]

    __repr__ = repr_of

    def _faults(self, tolerance: float, accuracy: float = COARSE) -> dict[str, str]:
        """What exceeds a tolerance of constraints or an accuracy of steps, in words, by the argument that helps."""
        faults = {}
        if self.step_error > accuracy:
            faults["accuracy"] = f"steps are off by up to {self.step_error:.1e}, the end by {self.end_error:.1e}"
        worst = max(self.violations, key=lambda name: self.violations[name][0], default="")
        if worst and self.violations[worst][0] > tolerance:
            by, time = self.violations[worst]
            faults["between_knots"] = f"{worst} is violated by {by:.2g} between knots, at {time:.3g} s"
        return faults
