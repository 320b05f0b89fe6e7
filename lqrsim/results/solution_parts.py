"""Parts of a `Solution`: trajectory, status, log, certificate, multipliers, candidates, value functions. NumPy only."""

import contextlib
import enum
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Index, Line, NonNegative, OneOf, Positive, checked, repr_of
from lqrsim.errors import Array, InputError, check_shape, vectors_of

# The end of a "moving" horizon moves along with the robot; the end of a "shrinking" horizon stays.
HORIZONS = ("moving", "shrinking")
Horizon = Annotated[str, OneOf(HORIZONS)]
COARSE = 1e-4  # error of a step that a solution mentions: over a hundred steps it may add up to a hundredth


def left_after(steps: int, array: npt.ArrayLike, *, filled: bool) -> Array:
    """An array (T, ...) without its first steps; with `filled` the last entry is repeated to keep the length."""
    array = np.asarray(array)
    remaining = array[steps:]
    return np.concatenate([remaining, np.repeat(array[-1:], steps, axis=0)]) if filled and steps else remaining


def joined(*parts: str) -> str:
    """The parts of a detail, those that say something, as one text."""
    return "; ".join(filter(None, parts))


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


@contextlib.contextmanager
def _invertible(what: str) -> Iterator[None]:
    """A block in which a singular matrix raises InputError."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise InputError(f"{what}: got a singular matrix ({error}), want an invertible one") from None


@checked
@dataclass(frozen=True, eq=False)
class Quadratic:
    """A quadratic function of the state, or one for each knot: `1/2 x'Hx + x'g + const`.

    Paper: Eqs. (8), (14), (20).

    Attributes:
      hessian: (T+1, n, n), symmetric; S, Sbar. A single function has no leading axis, here and below.
      gradient: (T+1, n), at the origin; bold s, bold sbar.
      constant: (T+1,), or a number; s, sbar.
    """

    hessian: Annotated[Array, "... n n"]
    gradient: Annotated[Array, "... n"]
    constant: Annotated[Array | float, "..."]

    __repr__ = repr_of

    def __post_init__(self) -> None:
        if not self.gradient.shape[-1]:
            raise InputError("Quadratic: got no state, want at least one")

    @checked
    def __add__(self, other: "Quadratic") -> "Quadratic":
        if other.hessian.shape != self.hessian.shape:
            raise InputError(f"other: got a hessian of shape {other.hessian.shape}, want {self.hessian.shape}")
        return Quadratic(self.hessian + other.hessian, self.gradient + other.gradient, self.constant + other.constant)

    def __call__(self, states: npt.ArrayLike) -> Array:
        """The values at these states (T+1, n), one for each knot."""
        x = vectors_of("states", states, self.gradient.shape[-1])
        try:
            np.broadcast_shapes(x.shape, self.gradient.shape)
        except ValueError:
            raise InputError(f"states: got shape {x.shape}, want one that goes with {self.gradient.shape}") from None
        curved = 0.5 * np.einsum("...i,...ij,...j->...", x, self.hessian, x)
        return curved + np.einsum("...i,...i->...", x, self.gradient) + self.constant

    def minimizer(self) -> Array:
        """The minimising states (T+1, n). Paper: Eq. (21). Raises InputError for a singular Hessian."""
        with _invertible("hessian"):
            return -np.linalg.solve(self.hessian, self.gradient[..., None])[..., 0]

    def minimum(self) -> Array:
        """The minimum at each knot, (T+1,)."""
        return self(self.minimizer())


@checked
@dataclass(frozen=True, eq=False)
class Moments:
    """Quadratic functions of the state by moments, for each knot: `1/2 (x - mean)' covariance^-1 (x - mean) + const`.

    It is the dual form's cost-to-come. In a direction in which no state can be reached, the covariance is zero and the
    cost infinite. The terms come from Kalman smoothing, to which LQR smoothing is dual.

    Attributes:
      covariance: (T+1, n, n), symmetric, positive semidefinite; zero at 0 after a fixed start. Sbar^-1.
      mean: (T+1, n), the states of least cost; -Sbar^-1 sbar.
      constant: (T+1,), the least cost.
    """

    covariance: Annotated[Array, "... n n"]
    mean: Annotated[Array, "... n"]
    constant: Annotated[Array | float, "..."]

    __repr__ = repr_of

    def __post_init__(self) -> None:
        if not self.mean.shape[-1]:
            raise InputError("Moments: got no state, want at least one")

    def quadratic(self) -> Quadratic:
        """The same functions in coefficients. Raises InputError for a singular covariance."""
        with _invertible("covariance"):
            hessian = np.linalg.inv(self.covariance)
        hessian = 0.5 * (hessian + np.swapaxes(hessian, -1, -2))
        gradient = -np.einsum("...ij,...j->...i", hessian, self.mean)
        return Quadratic(hessian, gradient, self.constant - 0.5 * np.einsum("...i,...i->...", gradient, self.mean))

    def minimizer(self) -> Array:
        """The minimising states (T+1, n): the means."""
        return self.mean

    def minimum(self) -> Array:
        """The minimum at each knot, (T+1,)."""
        return np.asarray(self.constant)


@checked
@dataclass(frozen=True, eq=False)
class TotalCost:
    """Cost-to-go plus cost-to-come: the least cost of a trajectory through a state, for each knot. Paper: Eq. (20)."""

    cost_to_go: Quadratic
    cost_to_come: Quadratic | Moments

    __repr__ = repr_of

    def __post_init__(self) -> None:
        come = self.cost_to_come.gradient if isinstance(self.cost_to_come, Quadratic) else self.cost_to_come.mean
        check_shape("TotalCost: cost_to_come", come, self.cost_to_go.gradient.shape)

    def minimizer(self) -> Array:
        """The states (T+1, n) of least total cost; x_hat. Paper: Eq. (21). Raises InputError if there is no minimum."""
        if isinstance(self.cost_to_come, Quadratic):
            return (self.cost_to_go + self.cost_to_come).minimizer()
        moved = np.einsum("...ij,...j->...i", self.cost_to_come.covariance, self.costate())
        return self.cost_to_come.mean - moved

    def costate(self) -> Array:
        """The gradients (T+1, n) of the cost-to-go at the minimisers."""
        go = self.cost_to_go
        if isinstance(self.cost_to_come, Quadratic):
            return np.einsum("...ij,...j->...i", go.hessian, self.minimizer()) + go.gradient
        covariance, mean = self.cost_to_come.covariance, self.cost_to_come.mean
        slope = np.einsum("...ij,...j->...i", go.hessian, mean) + go.gradient
        with _invertible("covariance"):
            return np.linalg.solve(np.eye(mean.shape[-1]) + go.hessian @ covariance, slope[..., None])[..., 0]

    def covariance(self) -> Array:
        """The inverses (T+1, n, n) of the Hessians, zero in a direction in which no state can be reached.

        As covariances of a normal distribution: at k standard deviations the total cost is `k^2/2` above its least.
        """
        come, curvature = self.cost_to_come, self.cost_to_go.hessian
        with _invertible("hessian"):
            if isinstance(come, Quadratic):
                return np.linalg.inv(come.hessian + curvature)
            return come.covariance @ np.linalg.inv(np.eye(curvature.shape[-1]) + curvature @ come.covariance)

    def minimum(self) -> Array:
        """The least total cost at each knot, (T+1,); the same at all knots for a linear-quadratic problem."""
        if isinstance(self.cost_to_come, Quadratic):
            return (self.cost_to_go + self.cost_to_come).minimum()
        costate, covariance = self.costate(), self.cost_to_come.covariance
        come = 0.5 * np.einsum("...i,...ij,...j->...", costate, covariance, costate) + self.cost_to_come.constant
        return come + self.cost_to_go(self.minimizer())
