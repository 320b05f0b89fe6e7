"""What kernels are given: named tuples of arrays and numbers, and rows with fields for what is remembered or logged.

T is the number of steps. Kernels see an array as a pointer to blocks of constant shape, and a tuple of vectors as one
of addresses; see `codegen/language.py`. An address is a float64, which has all integers up to 2^53.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Arrays = Any  # an ndarray for Python, a pointer for compiled code
StructuredArray = npt.NDArray[np.void]  # with fields by name, of one of the types below


class Limits(NamedTuple):
    """Of the controls, (M,) each; infinite where there is none."""

    low: Arrays
    high: Arrays


class DynamicsModel(NamedTuple):
    """The addresses of what dynamics bring, and their parameters (any,).

    `step_curvature` is the place of the second derivatives of a step against a costate; 0 where there are none.
    """

    advance: float
    step_jacobian: float
    step_curvature: float
    parameters: Arrays


class Constraints(NamedTuple):
    """The constraints that act on a cost.

    Attributes:
      functions: (C, 6) of each the addresses of its functions, and whether it uses the control; see
        `model_functions.py`. data, multipliers: what these take, a vector each; see `augmented_lagrangian.py`.
      size: C.
    """

    functions: Arrays
    data: Any
    multipliers: Any
    size: int


class CostModel(NamedTuple):
    """A cost, as the sum of its terms, and the constraints that act where it does.

    Attributes:
      functions: (K, 2) of each term the addresses of its value and its derivatives; those that may be indefinite come
        first. data: what these take, a vector each. size: K. indefinite: how many may be.
      project: the address of the projection of their sum; 0 where none may be indefinite.
    """

    functions: Arrays
    data: Any
    size: int
    indefinite: int
    project: float
    constraints: Constraints


class NoiseModel(NamedTuple):
    """The addresses of what noise brings; what its function reads (any,); the risk, and if it was too high, (2,)."""

    value: float
    quadratic: float
    data: Arrays
    risk: Arrays


class ProblemModel(NamedTuple):
    """A problem as numbers and addresses; the time step is in s, and `noise` is empty where there is none."""

    dynamics: DynamicsModel
    dt: float
    initial: CostModel
    stage: CostModel
    final: CostModel
    limits: Limits
    noise: Any = ()


class Motion(NamedTuple):
    """States (T+1, N) and controls (T, M)."""

    states: Arrays
    controls: Arrays


class Policy(NamedTuple):
    """The law u = L x + l: gain L (T, M, N) and offset l (T, M)."""

    gain: Arrays
    offset: Arrays


class CostToGo(NamedTuple):
    """1/2 x'S x + s'x + s0: S (T+1, N, N), s (T+1, N) and the constants (T+1,)."""

    hessian: Arrays
    gradient: Arrays
    constant: Arrays


class CostToCome(NamedTuple):
    """In the dual form covariances and means, in the primal form Sbar and sbar; (T+1, N, N), (T+1, N), (T+1,)."""

    matrix: Arrays
    vector: Arrays
    constant: Arrays


class SmootherGains(NamedTuple):
    """What leads from the minimiser at t + 1 to that at t.

    In the dual form the state is `state - state_gain costate` and the control `control_gain costate + control`; in the
    primal form, the inverse policy: the control is `control_gain x + control`, and the others are not used.
    """

    state_gain: Arrays
    state: Arrays
    control_gain: Arrays
    control: Arrays


class Prior(NamedTuple):
    """`1/2 (x - about)' diag(weight) (x - about)` at t >= 1: weight (N,), about (T+1, N)."""

    weight: Arrays
    about: Arrays


class Linearization(NamedTuple):
    """What a pass linearises about: a fraction `reach` of the way from the plan to the minimisers.

    With `guided`, the forward pass stays at the plan. `damping` weighs changes of the controls, in units of the
    control's own curvature.
    """

    plan: Motion
    guided: bool
    reach: float
    damping: float
    prior: Prior


class ModelOrder(NamedTuple):
    """What the models of a pass about a plan are made of.

    `damping` is a weight on changes of the controls. `share` is how much of the second order there is: 0 for the models
    of iLQR, with costs projected and dynamics linearised; 1 for those of Newton's method, the Hessians of costs as they
    are and that of the dynamics times the costate. Noise is then weighed by a cost-to-go that is `known`.
    """

    damping: float
    share: float
    known: CostToGo


class LinearStep(NamedTuple):
    """A linearised step: [A B] (N, W) and c (N,)."""

    jacobian: Arrays
    offset: Arrays


class NextStep(NamedTuple):
    """What lies ahead of a step: its Jacobian [A B] (N, W), where it leads (N,), and the cost-to-go there, Hessian
    (N, N) and gradient at the origin (N,).
    """

    jacobian: Arrays
    arrived: Arrays
    hessian: Arrays
    gradient: Arrays


class QuadraticStage(NamedTuple):
    """A cost about the origin, or about a point: Hessian (W, W) and gradient (W,) in states and controls."""

    hessian: Arrays
    gradient: Arrays


class ConstraintRows(NamedTuple):
    """The numbers of all constraints, row by row, of which there are `size` at each step.

    Attributes:
      first: (C,) the row with which each constraint begins. support: (size, W) 0 where a row does not depend on that
        state or control. multipliers: ((T+1) size,); those of up to `least` are as good as none.
    """

    size: int
    least: float
    first: Arrays
    support: Arrays
    multipliers: Arrays


class StageModels(NamedTuple):
    """Of all stages, at a plan that need not be a motion.

    Attributes:
      hessian: (T+1, W, W) of the cost and of steps and constraints times costates and multipliers. convex: (T+1, W, W)
        of the cost alone, projected. gradient: (T+1, W) of the cost. jacobian: (T, N, W) of the steps.
      arrived: (T, N) where these lead. slopes: ((T+1) size, W) of the constraints, row by row.
    """

    hessian: Arrays
    convex: Arrays
    gradient: Arrays
    jacobian: Arrays
    arrived: Arrays
    slopes: Arrays


class ActiveRows(NamedTuple):
    """The rows of a plan of which some are held at zero, `size` at each step, limits of controls among them.

    Attributes:
      table: (size, 6) of each row what it is; see `active_set.py`. live, held: ((T+1) size,) 1 for those that act, and
        that are held, else 0. numbers: what they have to spare. force: their multipliers. pressing: those that a step
        leads to. wrong: by how much a row is on the wrong side there, relative; 0 where it is not.
    """

    size: int
    table: Arrays
    live: Arrays
    held: Arrays
    numbers: Arrays
    force: Arrays
    pressing: Arrays
    wrong: Arrays


class EliminatedControl(NamedTuple):
    """A step and its stage with the control eliminated by u = w - F x - h, for the dual form.

    `factor` (M, M) is that of R, AT (N, N) and BT (M, N) the step's matrices transposed, Q (N, N) and q (N,) the cost
    of the state, `size` (N,) the diagonal of its Hessian before.
    """

    factor: Arrays
    F: Arrays
    h: Arrays
    AT: Arrays
    BT: Arrays
    Q: Arrays
    q: Arrays
    size: Arrays


class IterationSettings(NamedTuple):
    """Of a solve: how long, and when it has converged.

    `optimal` asks for more than a cost that has settled; with `fixed` the start is given; with `guided` the first
    iteration linearises about the guess; the prior acts in the first `prior_iterations`. `valley` is the gap below
    which smoothing leaves the rest to Newton's method; 0 where it does not.
    """

    steps: int
    max_iterations: int
    tolerance: float
    gap_tolerance: float
    optimal: bool
    fixed: bool
    guided: bool
    prior_iterations: int
    valley: float = 0.0


class SmootherArrays(NamedTuple):
    """All that a smoother reads and writes.

    Attributes:
      start: (N,) where it begins. x_hat: (N,) the minimiser that a pass has come to. x_hats: (T+1, N) all of them.
      homotopy_scaled: the stage cost as the passes see it, which is not yet the true one in the first iterations of a
        continuation.
      guess: what the first pass can be guided by. plan: the best so far. rollout: where the last policy leads.
      kept: that policy. certificate: (1,) rows of `CERTIFICATE`.
    """

    start: Arrays
    x_hat: Arrays
    x_hats: Arrays
    policy: Policy
    to_go: CostToGo
    to_come: CostToCome
    smoothing: SmootherGains
    homotopy_scaled: Any
    prior: Prior
    guess: Motion
    plan: Motion
    rollout: Motion
    kept: Policy
    certificate: Arrays


class RiccatiArrays(NamedTuple):
    """What the passes of a linear-quadratic problem write; x_hats (T+1, N) are the minimisers."""

    policy: Policy
    to_go: CostToGo
    to_come: CostToCome
    smoothing: SmootherGains
    x_hats: Arrays


class IlqrArrays(NamedTuple):
    """All that iLQR reads and writes: the plan is the best so far, `trial` what a line search tries.

    `damping` (1,) is the weight on changes of the controls; `certificate` (1,) rows of `CERTIFICATE`.
    """

    start: Arrays
    policy: Policy
    to_go: CostToGo
    plan: Motion
    trial: Motion
    damping: Arrays
    certificate: Arrays


class Predictor(NamedTuple):
    """What takes estimates a control period on: see `estimation.py`.

    Attributes:
      dynamics, dt: as in `ProblemModel`. places: which of the parameters are unknown, (P,).
      lag: how much is left of the distance to a command at the end of a period, and in the mean over it, (2,).
      transition: of the unknowns' states, (D, D). output: from these to the unknowns' values, (V, D).
    """

    dynamics: DynamicsModel
    dt: float
    places: Arrays
    lag: Arrays
    transition: Arrays
    output: Arrays


class SensorModel(NamedTuple):
    """The addresses of what is measured of a state and of its slope, and what these read (any,)."""

    measure: float
    slope: float
    data: Arrays


class Measurements(NamedTuple):
    """What is shown of the states (count, N), and 1 where that was lost, else 0, (count,)."""

    shown: Arrays
    lost: Arrays


class AngularStates(NamedTuple):
    """Which states are angles, and where rotation vectors begin: their places, (any,), and how many there are."""

    angles: Arrays
    angle_count: int
    rotations: Arrays
    rotation_count: int


def _row(*names: str) -> np.dtype[np.void]:
    return np.dtype([(name, np.float64) for name in names])


# What one iteration of the safeguard leaves to the next: cost of the plan, and its merit, to which what the augmented
# Lagrangian adds belongs; how far the next iteration reaches, and the weight on changes of the controls; how many small
# changes there were in a row; of iterations at reach 0, iLQR's, how many are left, how many there will be the next
# time, and how many others there were since. At the end, how far the states of least total cost are from the plan; at
# the beginning, whether that was made. `watched` is 1 where undamped iterations are to end when they make no progress,
# because there is a safeguard to go on. Of Newton's method: the share of the second order that the next pass may have;
# the step at which the last one failed; what it promised, as the slope of the merit and as a share of it; a cost that
# is as good as none; and the weight on changes of controls without which it has no minimum.
MEMORY = _row(
    "plan_cost", "merit", "reach", "weight", "small_changes", "ilqr_left", "ilqr_next", "since_ilqr", "final_gap",
    "started", "watched", "share", "failed", "decrease", "promised", "negligible", "damping",
)  # fmt: skip

# A line of the log: NaN where something was not worked out.
LOG = _row("cost", "improvement", "gap", "optimality", "residual", "method")

# What `certificate.certify` writes; see there.
CERTIFICATE = _row("cost", "scale", "motion", "law", "limits", "decrease")

ROWS = {"MEMORY": MEMORY, "LOG": LOG, "CERTIFICATE": CERTIFICATE}
