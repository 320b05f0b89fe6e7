"""The options of the solvers, with defaults and checks."""

from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np

from lqrsim.annotations import Bounds, OneOf, Positive, checked
from lqrsim.errors import InputError, check_function
from lqrsim.problem.problem import Problem
from lqrsim.solvers import compiled
from lqrsim.solvers.initial_guess import InitialGuess, StartLike, is_function

MOST_STARTS = 10_000
ROUGH, FINE = 1e-4, 1e-8  # default tolerances of smoothing and of Newton's method
LEARNED = 1e-5  # the same of the interior point with MuJoCo's steps: their derivatives are right to some 1e-6
INSIDE = 1e-3  # margin of active constraints for rounding, as a fraction of the tolerance
MISSED, SPARED = 1e-6, 1e-3  # default tolerances of constraints: interior point, augmented Lagrangian


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

    def second_order(self, problem: Problem) -> bool:
        """Whether Newton's method or the interior point ends a solve; with stop="cost" the paper's method does."""
        return self.finish is not None and self.stop == "optimal" and can_be_exact(problem)

    @property
    def price(self) -> float:
        """Price of violating constraints, in cost per unit; infinite unless they are elastic."""
        return np.inf if self.elastic is None else self.elastic

    def violation_tolerance(self, problem: Problem) -> float:
        """Tolerance of constraints: the allowed violation, or the margin that the augmented Lagrangian aims at."""
        return self.constraint_tolerance or (MISSED if self.second_order(problem) else SPARED)

    def final(self, problem: Problem) -> float:
        default = ROUGH if not self.second_order(problem) else FINE if has_curvature(problem) else LEARNED
        return self.tolerance or default

    def rough(self, problem: Problem) -> float:
        """Tolerance at which smoothing ends, coarser if Newton's method follows."""
        final = self.final(problem)
        return max(final, ROUGH) if self.second_order(problem) else final


def can_be_exact(problem: Problem) -> bool:
    """Whether Newton's method, or with constraints the interior point, can solve a problem.

    The expected cost of noise has no second derivatives: with it, constraints are left to smoothing. Nor have the steps
    of an MJCF. Without constraints, an iteration of smoothing is then worth several of Newton's; see
    `experiments/convergence.py`. With constraints, the interior point learns from secants what is missing.
    """
    return problem.noise_term is None if problem.constraints else has_curvature(problem)


def has_curvature(problem: Problem) -> bool:
    """Whether the dynamics have second derivatives; the steps of an MJCF have none."""
    return not problem.dynamics.by_mujoco
