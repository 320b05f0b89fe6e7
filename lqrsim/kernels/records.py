"""Arguments of kernels: named tuples of arrays and numbers, and rows with named fields for states and logs.

Annotations give the shapes of arrays that `zeros_of` makes: T is the number of steps, R that of the rows of constraints
and limits at a step, and K = (T+1) R. Kernels see an array as a pointer to blocks of constant shape, and a tuple of
vectors as a table of addresses; see `codegen/language.py`. An address is a float64, which represents all integers up to
2^53.
"""

import functools
from collections.abc import Mapping
from math import inf
from typing import Annotated, Any, NamedTuple, TypeVar, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

Arrays = Any  # an ndarray for Python, a pointer for compiled code
StructuredArray = npt.NDArray[np.void]  # its dtype is one of those at the end of this file
Record = TypeVar("Record", bound=tuple[Any, ...])


def zeros_of(kind: type[Record], given: Mapping[str, Any] | None = None, /, **sizes: int) -> Record:
    """A record of what is given, and of arrays of zeros, as large as its annotations say for these sizes."""
    known = given or {}
    return kind(*(known[name] if name in known else _zeros(hint, sizes) for name, hint in _hints(kind).items()))


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _zeros(hint: Any, sizes: Mapping[str, int]) -> Any:
    """An array of zeros; or a record of these, all of one size if the annotation says so."""
    if get_origin(hint) is not Annotated:
        return zeros_of(hint, **sizes)
    kind, (text,) = hint.__origin__, hint.__metadata__
    pairs = (size.partition("+") for size in text.split())
    shape = [(int(name) if name.isdigit() else sizes[name]) + int(more or 0) for name, _, more in pairs]
    return np.zeros(shape) if kind is Arrays else kind(*(np.zeros(shape) for _ in kind._fields))


class Limits(NamedTuple):
    """Limits of the controls, (M,) each; infinite for no limit."""

    low: Arrays
    high: Arrays


class DynamicsModel(NamedTuple):
    """Addresses of the functions of the dynamics, and their parameters."""

    advance: float
    step_jacobian: float
    step_curvature: float  # second derivatives of a step; 0 if they vanish or are not needed
    all_steps: float  # of all steps of a plan; 0 if there is only one step at a time
    parameters: Arrays


class Constraints(NamedTuple):
    """The constraints that act on a cost."""

    functions: Arrays  # (C, 5) addresses of functions, and 1 if it uses the control; see `model_functions.py`
    data: Any  # a vector for each, as are the multipliers; see `augmented_lagrangian.py`
    multipliers: Any
    size: int  # C


class CostModel(NamedTuple):
    """A cost as the sum of its terms, and the constraints that act with it."""

    functions: Arrays  # (K, 2) addresses of each term's value and derivatives; those that may be indefinite come first
    data: Any  # a vector for each term
    size: int  # K
    indefinite: int  # number of terms that may be indefinite
    project: float  # address of the projection of the sum of these terms; 0 if there are none
    constraints: Constraints


class NoiseModel(NamedTuple):
    """Noise: addresses of its functions, and what they read."""

    value: float
    quadratic: float
    data: Arrays
    risk: Arrays  # (3,) the risk; 1 if it was too high; and 1 if a given cost-to-go weighs the noise:
    hessian: Arrays  # (T+1, N, N); see `SolveRun.weigh_noise`
    gradient: Arrays  # (T+1, N)


class ProblemModel(NamedTuple):
    """A problem as numbers and addresses; dt is in s, and `noise` is () if there is none."""

    dynamics: DynamicsModel
    dt: float
    initial: CostModel
    stage: CostModel
    final: CostModel
    limits: Limits
    noise: Any = ()


class Motion(NamedTuple):
    """States and controls."""

    states: Annotated[Arrays, "T+1 N"]
    controls: Annotated[Arrays, "T M"]


class Policy(NamedTuple):
    """The policy u = L x + l: gains L and offsets l."""

    gain: Annotated[Arrays, "T M N"]
    offset: Annotated[Arrays, "T M"]


class CostToGo(NamedTuple):
    """1/2 x'S x + s'x + s0: S, s and s0."""

    hessian: Annotated[Arrays, "T+1 N N"]
    gradient: Annotated[Arrays, "T+1 N"]
    constant: Annotated[Arrays, "T+1"]


class CostToCome(NamedTuple):
    """Covariances and means in the dual form, Sbar and sbar in the primal form."""

    matrix: Annotated[Arrays, "T+1 N N"]
    vector: Annotated[Arrays, "T+1 N"]
    constant: Annotated[Arrays, "T+1"]


class SmootherGains(NamedTuple):
    """The maps from the smoothed state at t + 1 to the state and control at t.

    In the dual form the state is `state - state_gain costate` and the control `control_gain costate + control`. In the
    primal form the control is `control_gain x + control`, the inverse policy, and the others are not used: S is then 1
    instead of T.
    """

    state_gain: Annotated[Arrays, "S N N"]
    state: Annotated[Arrays, "S N"]
    control_gain: Annotated[Arrays, "T M N"]
    control: Annotated[Arrays, "T M"]


class Prior(NamedTuple):
    """`1/2 (x - about)' diag(weight) (x - about)` at t >= 1."""

    weight: Annotated[Arrays, "N"]
    about: Annotated[Arrays, "T+1 N"]


class Linearization(NamedTuple):
    """The points about which a pass linearises: a fraction `reach` of the way from the plan to the smoothed states."""

    plan: Motion
    guided: bool  # whether the forward pass linearises about the plan
    reach: float
    damping: float  # weight on changes of the controls, relative to the control's own curvature
    prior: Prior


class ModelOrder(NamedTuple):
    """The models of a pass about a plan.

    The fraction of second-order terms is 0 for iLQR's models, with projected costs and linearised dynamics; 1 for
    Newton's, with true Hessians of the costs, and Hessians of the dynamics times the costate.
    """

    damping: float  # weight on changes of the controls
    second_order: float
    known: CostToGo  # that which weighs noise, if `second_order` is above 0


class LinearStep(NamedTuple):
    """A linearised step: [A B] (N, W) and c (N,)."""

    jacobian: Arrays
    offset: Arrays


class NextStep(NamedTuple):
    """The rest of the problem after a step."""

    jacobian: Arrays  # [A B] (N, W)
    arrived: Arrays  # (N,) the next state
    hessian: Arrays  # (N, N) of the cost-to-go there
    gradient: Arrays  # (N,) at the origin


class QuadraticStage(NamedTuple):
    """A cost about the origin, or about a point: Hessian (W, W) and gradient (W,) in states and controls."""

    hessian: Arrays
    gradient: Arrays


class WeightedStep(NamedTuple):
    """A step of dynamics with parameters (any,) and a duration in s, whose result is summed with weights (N,)."""

    parameters: Arrays
    duration: float
    weights: Arrays


class StageModels(NamedTuple):
    """Models of all stages at a plan, which need not satisfy the dynamics."""

    hessian: Annotated[Arrays, "T+1 W W"]  # of the Lagrangian
    convex: Annotated[Arrays, "T+1 W W"]  # of the cost alone, projected
    gradient: Annotated[Arrays, "T+1 W"]  # of the cost
    jacobian: Annotated[Arrays, "T N W"]
    arrived: Annotated[Arrays, "T N"]  # next states
    slopes: Annotated[Arrays, "K W"]  # gradients of the rows
    learned: Annotated[Arrays, "T+1 W W"]  # what secants say that the Hessians lack; see `learn`


class StageRows(NamedTuple):
    """The rows of all constraints, then those of the control limits, R at each step."""

    size: int  # R
    # For rows that are limits of a control: the control, 1 for a lower or -1 for an upper limit, and its value. For
    # rows of constraints: the distance between their bounds, and whether they are linear.
    limits: Annotated[Arrays, "R 5"]
    first: Annotated[Arrays, "C"]  # the first row of each constraint
    support: Annotated[Arrays, "R W"]  # 0 where a row does not depend on that entry
    acts: Annotated[Arrays, "K"]  # 1 for rows that can act, else 0
    live: Annotated[Arrays, "K"]  # 1 for those that do at the plan
    held: Annotated[Arrays, "K"]  # what rows do in an active set; see `active_set.py`
    kinds: Annotated[Arrays, "K"]  # INEQUALITY, LIMIT or EQUALITY
    sizes: Annotated[Arrays, "K"]  # typical sizes
    targets: Annotated[Arrays, "K"]  # the values at which rows are held
    prices: Annotated[Arrays, "K"]  # the largest multipliers, infinite unless the row is elastic
    numbers: Annotated[Arrays, "K"]  # values
    force: Annotated[Arrays, "K"]  # multipliers


class PlanStages(NamedTuple):
    """A problem as stages about a plan: its numbers, its models and rows, and the last step."""

    steps: int  # T
    free: Annotated[Arrays, "N"]  # 0 for the states that the start fixes, else 1
    jumps: Annotated[Arrays, "T+1"]  # 1 where the last state is free, and may jump
    reset: Annotated[Arrays, "T+1 N+1"]  # the law of its change there
    reach: Annotated[Arrays, "N"]  # distances from the start to the goal
    unit: Annotated[Arrays, "N"]  # a number for each unit; states without one have numbers of their own
    state_size: Annotated[Arrays, "N"]  # typical sizes
    control_size: Annotated[Arrays, "M"]
    projected: Annotated[Arrays, "1"]  # 1 if the projected Hessians are those of the last plan
    reuses_derivatives: Annotated[Arrays, "1"]  # 1 if models of a plan keep the derivatives of the dynamics
    learns: int  # 1 if the dynamics have no second derivatives
    uses_learned: Annotated[Arrays, "1"]  # 1 if the Hessians have what is learned of these
    model: ProblemModel
    values: Any  # a vector for each constraint
    rows: StageRows
    models: StageModels
    policy: Policy  # this and the next two: see `direction` of `stages.py`
    to_go: CostToGo
    changes: Motion


class ActiveSetArrays(NamedTuple):
    """All arrays of an active set."""

    plan: Motion  # the iterate
    costates: Annotated[Arrays, "T+1 N"]
    gaps: Annotated[Arrays, "T N"]
    out: Motion  # its rollout, within these limits
    limits: Annotated[Limits, "T M"]
    curves: Annotated[Arrays, "K"]  # this and the next: see `direction` of `stages.py`
    forces: Annotated[Arrays, "K"]
    pressing: Annotated[Arrays, "K"]  # multipliers after a step
    wrong: Annotated[Arrays, "K"]  # relative distance of a row on the wrong side after a step, negative; else 0
    before: Annotated[Arrays, "K"]  # the rows that were held before the step
    chosen: Annotated[Arrays, "K"]  # those that convex models choose


class PlanPoint(NamedTuple):
    """A plan, the states at which its steps arrive, the values of its rows, and their slacks."""

    plan: Motion
    arrived: Annotated[Arrays, "T N"]
    numbers: Annotated[Arrays, "K"]
    slacks: Annotated[Arrays, "K 2"]  # s and p of each row; see `interior_point.py`


class PlanStep(NamedTuple):
    """A step in plan, slacks and multipliers, and the costates after it."""

    changes: Motion
    slacks: Annotated[Arrays, "K 2"]
    force: Annotated[Arrays, "K"]
    costates: Annotated[Arrays, "T+1 N"]


class PlanBeginning(NamedTuple):
    """What an interior point begins with."""

    plan: Motion  # within the limits of its controls
    multipliers: Arrays  # (K,)
    has_multipliers: bool  # whether these are known
    barrier: float  # the first barrier parameter of each row, as a fraction of the cost divided by the number of rows
    least_slack: float  # the least first slack, relative to a row's size
    oldest: float  # most further steps for which derivatives of the dynamics serve


class InteriorArrays(NamedTuple):
    """All arrays of an interior point."""

    now: PlanPoint  # the iterate
    costates: Annotated[Arrays, "T+1 N"]
    gaps: Annotated[Arrays, "T N"]
    tried: PlanPoint  # trials of a line search
    closer: PlanPoint
    kept: PlanPoint  # a point to go back to
    kept_force: Annotated[Arrays, "K"]
    kept_costates: Annotated[Arrays, "T+1 N"]
    step: PlanStep  # of an iteration
    alternative: PlanStep  # may take its place
    curves: Annotated[Arrays, "K"]  # this and the next: see `direction` of `stages.py`
    forces: Annotated[Arrays, "K"]
    corrections: Annotated[Arrays, "K 2"]  # of the products of slacks and multipliers, for both steps
    centring: Annotated[Arrays, "K 2"]
    extra_residuals: Annotated[Arrays, "K"]  # further residuals of the rows
    extra_gaps: Annotated[Arrays, "T N"]
    last_step: Annotated[Arrays, "T+1 W"]  # the last step
    turns: Annotated[Arrays, "T+1 W"]  # the change of the Lagrangian's gradients by it
    active: ActiveSetArrays  # of the crossover
    active_memory: Arrays  # (1,) row of `ACTIVE_SET`
    filter: Annotated[Arrays, "0 2"]  # violations and merits that a trial must not both exceed, any number
    errors: Annotated[Arrays, "LATELY"]  # the last ones


class RestorationArrays(NamedTuple):
    """All arrays of a restoration."""

    plan: Motion  # the iterate, a trajectory
    trial: Motion  # of the line search
    limits: Annotated[Limits, "T M"]  # of the controls in one step
    costates: Annotated[Arrays, "T+1 N"]
    gaps: Annotated[Arrays, "T N"]  # zero
    arrived: Annotated[Arrays, "T N"]  # of the trial
    numbers: Annotated[Arrays, "K"]
    curves: Annotated[Arrays, "K"]  # see `direction` of `stages.py`
    duals: Annotated[Arrays, "K"]  # multipliers
    full_step_duals: Annotated[Arrays, "K"]  # those after the whole step
    relative_multipliers: Annotated[Arrays, "K"]  # to the price


class Descent(NamedTuple):
    """How steps from a plan are made, accepted and regularised; see `iterations.py`."""

    method: int  # DAMPED or NEWTON
    changes: int  # number of small changes of cost in a row after which the plan is judged; 0 to judge each plan
    idle: float = inf  # number of steps in a row that improve by rounding which ends the descent
    second_order: float = 0.0  # fraction of second-order terms in the first models of a plan
    reach: float = 0.0  # that of the first step
    # The smallest fraction of a step that the line search tries, and the fraction of the predicted decrease that a step
    # must achieve; of models at reach 0 without second-order terms SHORTEST and 0, if `patient`.
    smallest: float = 0.0
    armijo: float = 0.0
    # The first weight on changes of the controls, for Newton's method relative to the merit and for damped steps to
    # their curvature; and the factor to the next.
    lightest: float = 0.0
    factor: float = 0.0
    weights: int = 0  # number of weights that are tried where a pass fails
    heaviest: float = 0.0  # largest weight that is tried where steps are rejected
    patient: bool = True


NO_DESCENT = Descent(method=0, changes=0)


class IterationSettings(NamedTuple):
    """Limits of a solve's iterations, and tolerances of convergence."""

    steps: int  # T
    max_iterations: int
    tolerance: float  # of relative changes of cost
    gap_tolerance: float
    optimal: bool  # whether a settled cost must also be optimal
    fixed: bool  # whether the start is given exactly
    rounding: float  # negligible cost, relative to the stages' constants that cancel where the least cost is zero
    guided: bool = False  # whether the first iteration linearises about the guess
    prior_iterations: int = 0
    valley: float = 0.0  # the gap below which Newton's method takes over from smoothing; 0 for never
    descent: Descent = NO_DESCENT


class SmootherArrays(NamedTuple):
    """All arrays of a smoother."""

    start: Annotated[Arrays, "N"]
    x_hat: Annotated[Arrays, "N"]  # the smoothed state that a pass has reached
    x_hats: Annotated[Arrays, "T+1 N"]
    policy: Policy
    to_go: CostToGo
    to_come: CostToCome
    smoothing: SmootherGains
    homotopy_scaled: Any  # the stage cost of the passes; not the true one in the first iterations of a homotopy
    prior: Prior
    guess: Motion  # what guides the first pass
    best: Motion  # the best trajectory so far
    last: Motion  # that of the last policy
    last_policy: Policy
    certificate: Arrays  # (1,) row of `CERTIFICATE`


class FilterSizes(NamedTuple):
    """Sizes of a Kalman filter; see `recursions.py`."""

    knots: int  # T+1
    entries: int  # Z
    measured: int  # Y
    states: int  # n
    disturbing: int  # D, columns of the process noise's root
    used: bool  # whether the filter begins after the first measurement
    resolution: float  # the least noise of a measurement, relative to its std
    nothing: float  # the same, absolute


class FilterModel(NamedTuple):
    """F (T, Z, Z), H (T+1, Y, n), and roots of the noise: of measurements (T+1, Y, n), of the process (T, Z, D)."""

    F: Arrays
    H: Arrays
    noise: Arrays
    disturbing: Arrays


class FilterRoots(NamedTuple):
    """Square roots of a Kalman filter's covariances; the first is given, the others are written."""

    root: Annotated[Arrays, "Z Z"]  # at the start; overwritten
    before: Annotated[Arrays, "T+1 Z Z"]  # each measurement
    after: Annotated[Arrays, "T+1 Z Z"]
    innovation: Annotated[Arrays, "T+1 Y Y"]  # S
    learned: Annotated[Arrays, "T+1 Z Y"]  # K S
    work: Arrays  # ((Y+Z) (n+Y+Z),) and at least (Z (Z+D),)


class LoopSizes(NamedTuple):
    """Sizes of C laws in L systems; see `recursions.py`."""

    steps: int  # T
    systems: int  # L
    laws: int  # C
    driven: int  # Y
    entries: int  # X
    controls: int  # m
    shown: int  # number of entries of y whose moments are written
    stated: int  # first of y that are the system's own; with losses, the last m of these are the actuators' states
    rows: int  # of the noise, and its columns
    columns: int
    correlated: bool  # whether noise of the commands is correlated with that of y
    lossy: bool  # whether commands get lost
    lost: float  # number of lost commands for each that arrives


class LoopArrays(NamedTuple):
    """The loops y' = F X + G' (u - planned) + c + w under the commands K X + command + r, which are limited to u.

    X = (y, d) are Y numbers that commands move, and X - Y that they do not.
    """

    F: Arrays  # (T, L, Y, X)
    G: Arrays  # (T, L, m, Y)
    c: Arrays  # (T, L, Y)
    noise: Arrays  # (T+1, L, rows, columns), covariance of the first of y with those of X: at the start, then of w
    fresh: Arrays  # (T+1, L, X - Y, X - Y), covariance of d at the start, and then of its noise
    transition: Arrays  # (X - Y, X - Y): d' is this times d and noise
    K: Arrays  # (T, C, m, X)
    command: Arrays  # (T, C, m)
    planned: Arrays  # (T, m)
    shaking: Arrays  # (T, C, m, m), covariance of r
    jointly: Arrays  # (T, C, m, Y), covariance of r with w; empty if it is zero
    reached: Arrays  # (T+1, L, m), nominal actuators' states
    low: Arrays  # (m,), limits of the controls
    high: Arrays


class LoopWork(NamedTuple):
    """Work arrays of closed loops; R is X - Y."""

    P: Annotated[Arrays, "L C X X"]  # covariance of X
    M: Annotated[Arrays, "L C X X"]  # of X' = M X and noise
    driven: Annotated[Arrays, "L C Y X"]  # M P for y alone
    exogenous: Annotated[Arrays, "L R R"]  # covariance of d
    half: Annotated[Arrays, "R R"]  # the transition times it
    mean: Annotated[Arrays, "L C Y"]  # of y
    ahead: Annotated[Arrays, "Y"]  # of y at the next knot
    response: Annotated[Arrays, "L C m X"]  # K P
    law: Annotated[Arrays, "L C m X"]  # K times the slopes
    pushed: Annotated[Arrays, "L C m Y"]  # G times the noise of the commands
    shaken: Annotated[Arrays, "L C m Y"]  # their correlation with w
    held: Annotated[Arrays, "L C m Y"]  # G times the change by a loss
    slope: Annotated[Arrays, "L C m"]  # of the limited commands, as are the next two
    level: Annotated[Arrays, "L C m"]
    left: Annotated[Arrays, "L C m"]


class LoopMoments(NamedTuple):
    """Moments of the first N entries of y about the plan; L and C come first, are missing, or come after the time."""

    mean: Annotated[Arrays, "T+1 L C N"]
    covariance: Annotated[Arrays, "T+1 L C N N"]
    across: Annotated[Arrays, "T L C N N"]  # covariance with y at the previous knot
    command: Annotated[Arrays, "T L C m"]  # standard deviation of each command, before it is limited
    saturation: Annotated[Arrays, "T L C m"]  # fraction of the commands that are beyond the limits


class PassSizes(NamedTuple):
    """Sizes of the backward pass of C tracking laws; see `recursions.py`."""

    laws: int  # C
    driven: int  # Y, the states that controls move
    entries: int  # Z, of z = (y, d)
    controls: int  # m
    lost: float  # fraction of the commands that get lost; the last m of y are then the actuators' states


class PassArrays(NamedTuple):
    """What tracking laws are of, by columns for (y, d, 1)."""

    control: Arrays  # (m,) diagonal of R
    state: Arrays  # (C, Y) diagonals of Q
    undo: Arrays  # (T, C, m, Z+1) R times the controls that cancel the unknowns
    held: Arrays  # (T, m, Z+1) a lost command
    laws: Arrays  # (T, C, m, Z+1), written


class PassWork(NamedTuple):
    """Work arrays of the backward pass."""

    cost: Arrays  # (C, Y, Z+1) the cost-to-go (S, D, s)
    products: Arrays  # (C, Y+m, Z+1+m): [F G]' (S [F E c G] + (0, D, s, 0))
    curve: Arrays  # (C, m, m): R + G'SG, then its elimination
    mean: Arrays  # (m, Z+1), of laws


class RiccatiArrays(NamedTuple):
    """Results of the passes of a linear-quadratic problem; `x_hats` are the smoothed states."""

    policy: Policy
    to_go: CostToGo
    to_come: CostToCome
    smoothing: SmootherGains
    x_hats: Annotated[Arrays, "T+1 N"]


class Predictor(NamedTuple):
    """The model that predicts estimates over a control period; see `feedback.py`."""

    dynamics: DynamicsModel
    dt: float
    parameter_indices: Arrays  # (P,) of the unknowns
    lag: Arrays  # (2,) what is left of the difference to a command at the end of a period, and on average over it
    transition: Arrays  # (D, D), for the unknowns' states
    output: Arrays  # (V, D), from these to the unknowns


class SensorModel(NamedTuple):
    """Addresses of the measurement and of its Jacobian, and their data (any,)."""

    measure: float
    slope: float
    data: Arrays


class AngularStates(NamedTuple):
    """The states that are turned to the nearest, with the numbers of either kind."""

    angles: Arrays  # indices
    angle_count: int
    rotations: Arrays  # (any, 2): of rotation vectors the index, and which entry is an angle, or -1
    rotation_count: int


def _row(*names: str) -> np.dtype[np.void]:
    return np.dtype([(name, np.float64) for name in names])


# The state of the iterations between calls.
MEMORY = _row(
    # Cost and merit of the plan; the merit includes the augmented Lagrangian. 1 once the start was rolled out; 1 if
    # undamped iterations end without progress, because the safeguard can take over.
    "plan_cost", "merit", "started", "watched",
    # Of a descent: number of small changes of cost in a row; number of steps in a row that improved by rounding; the
    # step at which the last pass failed, or -1; the negligible cost; the least cost to which an optimality is relative;
    # gap between smoothed states and plan at the end.
    "small_changes", "idle", "failed", "negligible", "least", "final_gap",
    # Of damped steps: reach of the next; weight on changes of the controls, which iLQR has, too; for steps at reach 0,
    # iLQR's, how many remain, how many there will be the next time, and how many others there were since.
    "reach", "weight", "ilqr_left", "ilqr_next", "since_ilqr",
    # Of passes about the plan: 1 if the next step's was made; its fraction of second-order terms, weight on changes of
    # the controls, predicted slope of the merit, and predicted decrease relative to the merit; number of steps that
    # followed an optimal plan.
    "known", "second_order", "damping", "decrease", "relative_decrease", "extra_steps",
)  # fmt: skip

# The state of an interior point between calls.
INTERIOR = _row(
    # The measures of the iterate; see `interior_point.Measures` of the solvers.
    "cost", "stationarity", "violation", "gap", "complementarity",
    # Largest difference of a row's value and its slacks, relative to the row's size; largest product of a slack and its
    # multiplier; the cost to which measures are relative; the typical cost of a change.
    "miss", "product", "scale", "typical",
    # The barrier parameter; its largest value; that as a fraction of the cost of a row; number of slacks; 1 if a row
    # has a price; the tolerance towards which the barrier falls; number of last errors that Mehrotra's rule compares.
    "parameter", "highest", "barrier", "pairs", "elastic", "target", "falls",
    # The step: the rung of its models on the ladder of regularisation; the fraction of the projected Hessian in these;
    # softness of equalities.
    "rung", "convex_fraction", "soft",
    # The line search: violation, merit and slope of the iterate; rows of the filter; largest violations; the cost of
    # the trial; the largest fraction with which slacks stay positive; the fraction that was taken; number of steps
    # taken although the filter rejected them.
    "violated", "merit", "slope", "filter_rows", "farthest", "farthest_gap", "tried", "whole", "fraction", "forced",
    # Endings: 1 once the measures are within tolerance; number of iterations since the last attempt to cross over;
    # number of short steps in a row, and the cost at the first of these; number of iterations in a row in which the
    # constraints were kept and the cost was that of the first, `level`.
    "solved", "since", "short", "before", "unchanged", "level",
    # Cost and scale of the point to go back to; number of steps since the dynamics were linearised, at most `oldest`.
    "kept", "kept_scale", "age", "oldest",
)  # fmt: skip

# The state of an active set between calls. cost, stationarity, violation, gap, complementarity, scale, typical: as
# above. kept: 1 if the plan keeps the constraints. phase, pivots, fewest, patience: of a step; number of pivots in its
# phase, the least number of wrong rows so far, and the number of pivots that may pass without fewer.
ACTIVE_SET = _row(
    "cost", "stationarity", "violation", "gap", "complementarity", "scale", "typical", "kept", "phase", "pivots",
    "fewest", "patience",
)  # fmt: skip

# The measures of an iteration of the interior point.
MEASURES = _row("cost", "stationarity", "violation", "gap", "complementarity")

# The state of a restoration between calls. rows: number of rows that act. parameter, least: the barrier parameter, and
# its least value. damping: of the steps. level: the predicted decrease that is negligible. cost, merit, decrease: of
# the iterate, and the predicted slope of its merit. relative_decrease: its predicted decrease, relative to the merit.
# fraction: that of the step that was accepted; 0 for none. violation, nearly_feasible: of the iterate, and if it is
# nearly feasible. close: number of times in a row that it was, and its cost `before` hardly different. has_duals: 1
# once multipliers are known. unfinished: 1 if the last iteration is not yet completed.
RESTORATION = _row(
    "rows", "parameter", "least", "damping", "level", "cost", "merit", "decrease", "relative_decrease", "fraction",
    "violation", "nearly_feasible", "close", "before", "has_duals", "unfinished",
)  # fmt: skip

# An iteration of a restoration.
RESTORED = _row("cost", "violation", "relative_decrease")

# A row of the log; NaN where something was not computed.
LOG = _row("cost", "improvement", "gap", "optimality", "residual", "method")

# The results of `certificate.certify`; and of `certificate.reduced_curvature`, the curvature.
CERTIFICATE = _row(
    "cost", "scale", "typical", "dynamics_residual", "policy_residual", "beyond_limits", "decrease", "curvature"
)  # fmt: skip
