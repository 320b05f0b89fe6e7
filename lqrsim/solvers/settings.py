"""What the caller says of a solve beside the problem: the options, with defaults and checks, and the start.

A start is nothing, controls, a prior, a policy, a trajectory or another plan; `resolve` makes an `InitialGuess` of it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, NamedTuple, TypeGuard

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, Count, OneOf, Positive, checked
from lqrsim.errors import Array, InputError, check_array, check_function, check_number, excerpt, numbers_of
from lqrsim.kernels.records import Motion
from lqrsim.problem.problem import Problem
from lqrsim.results.archive import sha256
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Plan
from lqrsim.results.solution_parts import Iteration, Multipliers, Quadratic, Trajectory
from lqrsim.solvers import compiled

if TYPE_CHECKING:
    from lqrsim.solvers.stages import InteriorResult

MOST_STARTS = 10_000
ROUGH, FINE = 1e-4, 1e-8  # default tolerances of smoothing and of Newton's method
LEARNED = 1e-5  # the same of the interior point with MuJoCo's steps: their derivatives are right to some 1e-6
INSIDE = 1e-3  # margin of active constraints for rounding, as a fraction of the tolerance
MISSED, SPARED = 1e-6, 1e-3  # default tolerances of constraints: interior point, augmented Lagrangian


class InitialPrior:
    """`1/2 (x - about)' diag(weight) (x - about)` at all steps but the first, in the first iterations only.

    The prior is not part of the cost. It keeps the first linearisations of the smoother reasonable, and thereby
    influences which local optimum is found.

    Args:
      weight: (n,) weights, not negative.
      about: the state (n,), or trajectory (T+1, n), at which the prior is zero.
      obstacles: fractions of the obstacle costs in the first iterations, one per iteration; 1 afterwards.
      controls: the controls (m,) or (T, m) of the first pass; by default the problem's nominal control.
    """

    @checked
    def __init__(
        self,
        weight: npt.ArrayLike,
        *,
        about: npt.ArrayLike,
        iterations: Count = 1,
        obstacles: Sequence[float] = (),
        controls: npt.ArrayLike | None = None,
    ) -> None:
        self.weight = check_array("InitialPrior: weight", weight, (None,))
        if not len(self.weight) or (self.weight < 0).any():
            raise InputError(
                f"InitialPrior: weight: got {excerpt(self.weight.tolist())}, want numbers >= 0, one a state"
            )
        array = numbers_of("InitialPrior: about", about, f"numbers ({len(self.weight)},) or (T+1, {len(self.weight)})")
        self.about = check_array("InitialPrior: about", array, (*[None] * (array.ndim == 2), len(self.weight)))
        if len(self.about) < 2 and self.about.ndim == 2:
            raise InputError(
                f"InitialPrior: about: got {len(self.about)} rows, want one for each of at least two times"
            )
        self.iterations = iterations
        fractions = check_array("InitialPrior: obstacles", obstacles, (None,))
        if ((fractions < 0) | (fractions > 1)).any():
            raise InputError(f"InitialPrior: obstacles: got {excerpt(obstacles)}, want numbers from 0 to 1")
        self.obstacles = tuple(fractions.tolist())
        self.controls = controls
        if controls is not None:
            self.controls = numbers_of("InitialPrior: controls", controls, "controls (m,) or (T, m)")

    def at(self, step: float) -> Array:
        """The state (n,) at which the prior is zero, at a step or between two."""
        most = None if self.about.ndim == 1 else len(self.about) - 1
        step = check_number("step", step, at_least=0.0, at_most=most)
        if self.about.ndim == 1:
            return self.about
        before = min(int(step), len(self.about) - 2)
        fraction = step - before
        return (1 - fraction) * self.about[before] + fraction * self.about[before + 1]

    @checked
    def fitting(self, problem: Problem) -> "InitialPrior":
        """The prior itself, which is checked to have one entry per state of a problem."""
        n = len(problem.dynamics.state_coordinates)
        check_array("start: InitialPrior: weight", self.weight, (n,))
        if self.about.ndim == 2:
            check_array("start: InitialPrior: about", self.about, (problem.steps + 1, n))
        return self


# Controls (m,) or (T, m), or a richer start; or a function of a problem that makes one of these.
Beginning = npt.ArrayLike | InitialPrior | AffinePolicy | Trajectory | Plan | None
StartLike = Beginning | Callable[[Problem], Beginning]


@dataclass(frozen=True, eq=False)
class InitialGuess:
    """The initial guess of a solve, from which the first pass starts."""

    gain: Array  # (T, m, n) and (T, m), the policy to begin with
    offset: Array
    summary: object = ""  # its entry in the options of a solution
    cost_to_go: Quadratic | None = None
    trajectory: Trajectory | None = None  # that the first pass linearises about, feasible or not; None for the policy's
    prior: InitialPrior | None = None
    multipliers: tuple[Multipliers, ...] = ()  # of the constraints; empty if unknown
    # A result of the interior point, with the iterations in `log`: only finishing remains.
    interior: "InteriorResult | None" = None
    log: tuple[Iteration, ...] = ()

    @property
    def digest(self) -> str:
        """Hash of everything that the first pass starts from."""
        parts: dict[str, object] = {"gain": self.gain, "offset": self.offset}
        for name, record in (("cost_to_go", self.cost_to_go), ("trajectory", self.trajectory)):
            parts |= {} if record is None else {f"{name}.{part}": value for part, value in vars(record).items()}
        if self.prior is not None:
            prior = self.prior
            parts |= {"weight": prior.weight, "about": prior.about}
            parts |= {"iterations": prior.iterations, "obstacles": prior.obstacles}
        for number, record in enumerate(self.multipliers):
            parts |= {f"multipliers.{number}": record.values, f"penalty.{number}": record.penalty}
        arrays = ((name, np.asarray(value, dtype=np.float64)) for name, value in parts.items())
        return sha256(*(part for name, array in arrays for part in (f"{name} {array.shape}", array)))

    def rolled_out(self, problem: Problem, x: Array) -> "InitialGuess":
        """This guess with the trajectory of its policy from a state (n,), about which a backward pass can begin.

        It need not be feasible: if the rollout is not finite, the last finite state and control are repeated.
        """
        states, controls = [x], []
        with np.errstate(all="ignore"):
            for gain, offset in zip(self.gain, self.offset, strict=True):
                control = gain @ states[-1] + offset
                state = (
                    problem.dynamics.step(states[-1], control, problem.dt) if np.isfinite(control).all() else control
                )
                finite = np.isfinite(state).all()
                controls.append(control if finite else controls[-1] if controls else offset)
                states.append(state if finite else states[-1])
        return replace(self, trajectory=Trajectory(np.array(states), np.array(controls), problem.dt))

    def penalised(self, problem: Problem, penalty: float | None) -> "InitialGuess":
        """This guess with a penalty for all constraints from the first iteration on; unchanged for None."""
        if penalty is None:
            return self
        if not problem.constraints:
            raise InputError(f"penalty: got {penalty:g} for a problem without constraints, want None")
        if self.prior is not None:  # during whose iterations constraints are off
            raise InputError(f"penalty: got {penalty:g} beside an InitialPrior, want another start")
        known = [multipliers.values for multipliers in self.multipliers]
        values = known or [np.zeros((problem.steps + 1, term.rows)) for term in problem.constraint_terms]
        return replace(self, multipliers=tuple(Multipliers(numbers, penalty) for numbers in values))


def resampled(states: Array, controls: Array, at: Array) -> Motion:
    """A plan of other knots: states (T+1, n) at knots `at` (K+1,), which may be between its own, and controls (K, m).

    Means of controls, not samples: what they drive, such as rates of rotation, then ends where the states are.
    """
    knots = np.arange(len(states))

    def there(table: Array) -> Array:
        return np.column_stack([np.interp(at, knots, column) for column in table.T])

    applied = np.vstack([np.zeros(controls.shape[1]), np.cumsum(controls, axis=0)])
    return Motion(there(states), np.diff(there(applied), axis=0) / np.diff(at)[:, None])


def is_function(start: object) -> TypeGuard[Callable[[Problem], Beginning]]:
    """Whether a start is a function of the problem. An AffinePolicy is also callable, but is itself a start."""
    return callable(start) and not isinstance(start, AffinePolicy)


def resolve(start: "StartLike | InitialGuess", problem: Problem) -> InitialGuess:
    """The initial guess for a caller's start; by default the problem's nominal controls."""
    n, m, steps = len(problem.dynamics.state_coordinates), len(problem.dynamics.control_coordinates), problem.steps
    if isinstance(start, InitialGuess):
        return start
    if is_function(start):
        start = start(problem)
    if isinstance(start, InitialPrior):
        prior, controls = start.fitting(problem), resolve(start.controls, problem)
        acting = np.array([prior.iterations, *prior.obstacles])
        return replace(
            controls, prior=prior, summary=_summary(start, prior.weight, prior.about, controls.offset, acting)
        )
    if isinstance(start, Plan):
        policy, value = resolve(start.policy, problem), start.cost_to_go
        if value is not None:
            hessian = check_array("start: cost_to_go.hessian", value.hessian, (steps + 1, n, n))
            value = Quadratic(hessian, check_array("start: cost_to_go.gradient", value.gradient, (steps + 1, n)),
                              check_array("start: cost_to_go.constant", value.constant, (steps + 1,)))  # fmt: skip
        multipliers = start.multipliers
        shapes = [(steps + 1, term.rows) for term in problem.constraint_terms]
        if [known.values.shape for known in multipliers] != shapes:
            multipliers = ()  # they belong to other constraints
        summary = _summary(start, policy.gain, policy.offset)
        return InitialGuess(policy.gain, policy.offset, summary, value, multipliers=multipliers)
    if isinstance(start, AffinePolicy):
        gain = check_array("start: gain", start.gain, (steps, m, n))
        offset = check_array("start: offset", start.offset, (steps, m))
        return InitialGuess(gain, offset, _summary(start, gain, offset))
    if isinstance(start, Trajectory):
        states = check_array("start: states", start.states, (steps + 1, n))
        controls = check_array("start: controls", start.controls, (steps, m))
        given = Trajectory(states, controls, problem.dt)
        return InitialGuess(np.zeros((steps, m, n)), controls, _summary(start, states, controls), trajectory=given)
    wanted, given = problem.nominal_controls if start is None else start, None
    try:
        given = numbers_of("start", wanted)
        controls = np.broadcast_to(given, (steps, m))
    except ValueError:  # InputError too
        got = excerpt(wanted) if given is None else f"shape {given.shape}"
        raise InputError(
            f"start: got {got}, want controls ({m},) or ({steps}, {m}), an InitialPrior, a Trajectory, an AffinePolicy"
            " or a Plan, such as a Solution"
        ) from None
    controls = check_array("start", controls, (steps, m))
    summary = controls[0] if (controls == controls[0]).all() else controls
    return InitialGuess(np.zeros((steps, m, n)), controls, summary.tolist())


def _summary(start: object, *arrays: Array) -> str:
    return f"{type(start).__name__} {sha256(*arrays)[:16]}"


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Settings:
    """Options that all solvers share; see `ilqr`."""

    _prefix = ""

    stop: Annotated[str, OneOf(("optimal", "cost"))] = "optimal"
    tolerance: Positive | None = None
    max_iterations: Annotated[int, Bounds(at_least=1, at_most=1_000_000)] = 500  # a log of this length takes 48 MB
    time_limit: Positive | None = None
    start: StartLike | InitialGuess = None

    def __post_init__(self) -> None:
        if is_function(self.start):
            check_function("start", self.start, "a function of a Problem, or what it returns", arguments=1)

    def options(self, start: InitialGuess) -> dict[str, object]:
        return {field.name: getattr(self, field.name) for field in fields(self)} | {"start": start.summary}


class Method(NamedTuple):
    """What ends the solve of a problem, and with which tolerances."""

    exact: bool  # Newton's method or, with constraints, the interior point; else smoothing and the augmented Lagrangian
    interior: bool  # the interior point
    curved: bool  # with second derivatives of the dynamics
    tolerance: float  # of the answer
    rough: float  # of the smoothing before it, coarser if another method follows
    violation: float  # allowed of constraints, or the margin of inequalities at which the augmented Lagrangian aims
    price: float  # of violating constraints, in cost per unit; infinite unless they are elastic


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class SmootherSettings(Settings):
    """Options of `smooth`."""

    gap_tolerance: Positive = 1e-3
    form: Annotated[str, OneOf(compiled.FORMS)] = "dual"
    first_pass: Annotated[str, OneOf(("forward", "backward"))] = "forward"
    safeguard: bool = True
    starts: Annotated[int, Bounds(at_least=1, at_most=MOST_STARTS)] | None = None
    constraint_tolerance: Positive | None = None
    penalty: Positive | None = None
    finish: Annotated[str, OneOf(("newton",))] | None = "newton"
    elastic: Positive | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.starts or 1) > 1 and self.start is not None:
            raise InputError(f"starts: got {self.starts} beside a start, want one of the two")
        if self.penalty is not None and self.start is None:
            raise InputError(f"penalty: got {self.penalty:g} without a start, want start=... beside it")

    def method(self, problem: Problem) -> Method:
        """How a problem is solved; with stop="cost" by the paper's method."""
        exact = self.finish is not None and self.stop == "optimal" and can_be_exact(problem)
        interior, curved = exact and bool(problem.constraints), exact and not problem.dynamics.by_mujoco
        tolerance = self.tolerance or (FINE if curved else LEARNED if exact else ROUGH)
        rough = max(tolerance, ROUGH) if exact else tolerance
        violation = self.constraint_tolerance or (MISSED if exact else SPARED)
        price = np.inf if self.elastic is None else self.elastic
        return Method(exact, interior, curved, tolerance, rough, violation, price)


def can_be_exact(problem: Problem) -> bool:
    """Whether Newton's method, or with constraints the interior point, can solve a problem.

    The expected cost of noise has no second derivatives: with it, constraints are left to smoothing. Nor have the steps
    of an MJCF. Without constraints, an iteration of smoothing is then worth several of Newton's; see
    `experiments/convergence.py`. With constraints, the interior point learns from secants what is missing.
    """
    return problem.noise_term is None if problem.constraints else not problem.dynamics.by_mujoco
