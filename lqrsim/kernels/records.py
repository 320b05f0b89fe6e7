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
    own = given or {}
    return kind(*(own[name] if name in own else _zeros(hint, sizes) for name, hint in _hints(kind).items()))


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _zeros(hint: Any, sizes: Mapping[str, int]) -> Any:
    """An array of zeros; or a record of these, all of one size if the annotation says so."""
    if get_origin(hint) is not Annotated:
        return zeros_of(hint, **sizes)
    kind, (text,) = hint.__origin__, hint.__metadata__
    pairs = (one.partition("+") for one in text.split())
    shape = [(int(name) if name.isdigit() else sizes[name]) + int(more or 0) for name, _, more in pairs]
    return np.zeros(shape) if kind is Arrays else kind(*(np.zeros(shape) for _ in kind._fields))


class Limits(NamedTuple):
    """Limits of the controls, (M,) each; infinite for no limit."""

    low: Arrays
    high: Arrays


class DynamicsModel(NamedTuple):
    """Addresses of the functions of the dynamics, and their parameters (any,).

    `step_curvature` is the address of a step's second derivatives; 0 if they vanish or are not needed. `all_steps` is
    that of all steps of a plan; 0 if there is only one step at a time.
    """

    advance: float
    step_jacobian: float
    step_curvature: float
    all_steps: float
    parameters: Arrays


class Constraints(NamedTuple):
    """The constraints that act on a cost.

    Attributes:
      functions: (C, 5) addresses of each constraint's functions, and 1 if it uses the control; see
        `model_functions.py`.
      data, multipliers: a vector for each; see `augmented_lagrangian.py`.
      size: C.
    """

    functions: Arrays
    data: Any
    multipliers: Any
    size: int


class CostModel(NamedTuple):
    """A cost as the sum of its terms, and the constraints that act with it.

    Attributes:
      functions: (K, 2) addresses of each term's value and derivatives; terms that may be indefinite come first.
      data: a vector for each term. size: K. indefinite: number of terms that may be indefinite.
      project: address of the projection of the sum of these terms; 0 if there are none.
    """

    functions: Arrays
    data: Any
    size: int
    indefinite: int
    project: float
    constraints: Constraints


class NoiseModel(NamedTuple):
    """Noise: addresses of its functions, and what they read.

    Attributes:
      data: (any,). risk: (3,) the risk; 1 if it was too high; and 1 if a given cost-to-go weighs the noise.
      hessian, gradient: (T+1, N, N) and (T+1, N), that cost-to-go; see `SolveRun.weigh_noise`.
    """

    value: float
    quadratic: float
    data: Arrays
    risk: Arrays
    hessian: Arrays
    gradient: Arrays


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
    """The points about which a pass linearises: a fraction `reach` of the way from the plan to the smoothed states.

    With `guided`, the forward pass linearises about the plan. `damping` weighs changes of the controls, relative to the
    control's own curvature.
    """

    plan: Motion
    guided: bool
    reach: float
    damping: float
    prior: Prior


class ModelOrder(NamedTuple):
    """The models of a pass about a plan.

    Attributes:
      damping: weight on changes of the controls.
      share: fraction of the second-order terms: 0 for iLQR's models, with projected costs and linearised dynamics; 1
        for Newton's, with true Hessians of the costs, and Hessians of the dynamics times the costate.
      known: the cost-to-go that weighs noise, if `share` is above 0.
    """

    damping: float
    share: float
    known: CostToGo


class LinearStep(NamedTuple):
    """A linearised step: [A B] (N, W) and c (N,)."""

    jacobian: Arrays
    offset: Arrays


class NextStep(NamedTuple):
    """The rest of the problem after a step: its Jacobian [A B] (N, W), the next state (N,), and the cost-to-go there,
    Hessian (N, N) and gradient at the origin (N,).
    """

    jacobian: Arrays
    arrived: Arrays
    hessian: Arrays
    gradient: Arrays


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
    """Models of all stages at a plan, which need not satisfy the dynamics.

    Attributes:
      hessian: of the Lagrangian. convex: of the cost alone, projected. gradient: of the cost.
      jacobian: of the steps. arrived: next states. slopes: gradients of the rows.
      learned: what secants say that the Hessians lack; see `secants.py`.
    """

    hessian: Annotated[Arrays, "T+1 W W"]
    convex: Annotated[Arrays, "T+1 W W"]
    gradient: Annotated[Arrays, "T+1 W"]
    jacobian: Annotated[Arrays, "T N W"]
    arrived: Annotated[Arrays, "T N"]
    slopes: Annotated[Arrays, "K W"]
    learned: Annotated[Arrays, "T+1 W W"]


class StageRows(NamedTuple):
    """The rows of all constraints, then those of the control limits, R at each step.

    Attributes:
      size: R.
      limits: for rows that are limits of a control: the control, 1 for a lower or -1 for an upper limit, and its value.
        For rows of constraints: the distance between their bounds, and whether they are linear.
      first: the first row of each constraint, of C. support: 0 where a row does not depend on that entry.
      acts, live: 1 for rows that can act, and for those that do at the plan, else 0.
      held: what rows do in an active set; see `active_set.py`.
      kinds: INEQUALITY, LIMIT or EQUALITY. sizes: typical sizes. targets: the values at which rows are held.
      prices: the largest multipliers, infinite unless the row is elastic.
      numbers: values. force: multipliers.
    """

    size: int
    limits: Annotated[Arrays, "R 5"]
    first: Annotated[Arrays, "C"]
    support: Annotated[Arrays, "R W"]
    acts: Annotated[Arrays, "K"]
    live: Annotated[Arrays, "K"]
    held: Annotated[Arrays, "K"]
    kinds: Annotated[Arrays, "K"]
    sizes: Annotated[Arrays, "K"]
    targets: Annotated[Arrays, "K"]
    prices: Annotated[Arrays, "K"]
    numbers: Annotated[Arrays, "K"]
    force: Annotated[Arrays, "K"]


class PlanStages(NamedTuple):
    """A problem as stages about a plan: its numbers, its models and rows, and the last step.

    Attributes:
      steps: T. soft: 1 if there is an initial cost. free: 0 for the states that the start fixes, else 1.
      jumps: 1 at the knots at which the last state is free again, as the start is: it may jump there. At the start,
        whether there are any. reset: the law of its change there.
      reach: distances from the start to the goal. state_size, control_size: typical sizes.
      projected: 1 if the projected Hessians are those of the last plan.
      keeps: 1 if models of a plan keep the derivatives of the dynamics that are there.
      learns: 1 if the dynamics have no second derivatives. slow: 1 if the Hessians have what is learned of them.
      values: a vector for each constraint.
      policy, to_go, changes: see `direction` of `stages.py`.
    """

    steps: int
    soft: int
    free: Annotated[Arrays, "N"]
    jumps: Annotated[Arrays, "T+1"]
    reset: Annotated[Arrays, "T+1 N+1"]
    reach: Annotated[Arrays, "N"]
    state_size: Annotated[Arrays, "N"]
    control_size: Annotated[Arrays, "M"]
    projected: Annotated[Arrays, "1"]
    keeps: Annotated[Arrays, "1"]
    learns: int
    slow: Annotated[Arrays, "1"]
    model: ProblemModel
    values: Any
    rows: StageRows
    models: StageModels
    policy: Policy
    to_go: CostToGo
    changes: Motion


class ActiveSetArrays(NamedTuple):
    """All arrays of an active set.

    Attributes:
      plan: the iterate. costates, gaps: there. out, limits: of its rollout.
      curves, forces: see `direction` of `stages.py`. pressing: multipliers after a step.
      wrong: relative distance by which a row is on the wrong side after a step, negative; else 0.
      before, chosen: the rows that were held before the step, and that convex models choose.
    """

    plan: Motion
    costates: Annotated[Arrays, "T+1 N"]
    gaps: Annotated[Arrays, "T N"]
    out: Motion
    limits: Annotated[Limits, "T M"]
    curves: Annotated[Arrays, "K"]
    forces: Annotated[Arrays, "K"]
    pressing: Annotated[Arrays, "K"]
    wrong: Annotated[Arrays, "K"]
    before: Annotated[Arrays, "K"]
    chosen: Annotated[Arrays, "K"]


class Slacks(NamedTuple):
    """The two slacks of each row d, or numbers that belong to these: `d = slack - excess`.

    A row without a price has no excess, and an equality without a price has neither.
    """

    slack: Annotated[Arrays, "K"]
    excess: Annotated[Arrays, "K"]


class PlanPoint(NamedTuple):
    """A plan, the states at which its steps arrive, the values of its rows, and their slacks."""

    plan: Motion
    arrived: Annotated[Arrays, "T N"]
    numbers: Annotated[Arrays, "K"]
    slacks: Slacks


class PlanStep(NamedTuple):
    """A step in plan, slacks and multipliers, and the costates after it."""

    changes: Motion
    slacks: Slacks
    force: Annotated[Arrays, "K"]
    costates: Annotated[Arrays, "T+1 N"]


class PlanBeginning(NamedTuple):
    """What an interior point begins with.

    Attributes:
      plan: within the limits of its controls. known: ((T+1) size,) multipliers. informed: whether these are known.
      barrier: the first barrier parameter of each row, as a fraction of the cost divided by the number of rows.
      room: the least first slack, relative to a row's size.
      oldest: the largest number of steps for which derivatives of the dynamics serve after the step that they are for.
    """

    plan: Motion
    known: Arrays
    informed: bool
    barrier: float
    room: float
    oldest: float


class InteriorArrays(NamedTuple):
    """All arrays of an interior point.

    Attributes:
      now: the iterate. costates, gaps: there.
      tried, closer: trials of a line search. kept, kept_force, kept_costates: a point to go back to.
      step: the step of an iteration. other: another that may take its place.
      curves, forces: see `direction` of `stages.py`.
      corrections, others: corrections of the products of slacks and multipliers.
      beyond: further residuals of the rows. wider: further gaps.
      moves, turns: the last step, and the change of the Lagrangian's gradients by it.
      active: the arrays of the crossover to an active set. active_memory: (1,) row of `ACTIVE_SET`.
      filter: violations and merits that a trial must not both exceed, any number. errors: the last LATELY errors.
    """

    now: PlanPoint
    costates: Annotated[Arrays, "T+1 N"]
    gaps: Annotated[Arrays, "T N"]
    tried: PlanPoint
    closer: PlanPoint
    kept: PlanPoint
    kept_force: Annotated[Arrays, "K"]
    kept_costates: Annotated[Arrays, "T+1 N"]
    step: PlanStep
    other: PlanStep
    curves: Annotated[Arrays, "K"]
    forces: Annotated[Arrays, "K"]
    corrections: Slacks
    others: Slacks
    beyond: Annotated[Arrays, "K"]
    wider: Annotated[Arrays, "T N"]
    moves: Annotated[Arrays, "T+1 W"]
    turns: Annotated[Arrays, "T+1 W"]
    active: ActiveSetArrays
    active_memory: Arrays
    filter: Annotated[Arrays, "0 2"]
    errors: Annotated[Arrays, "LATELY"]


class RestorationArrays(NamedTuple):
    """All arrays of a restoration.

    Attributes:
      plan: the iterate, a trajectory. trial: of the line search. limits: of the controls in one step.
      gaps: zero. arrived, numbers: of the trial. curves: see `direction` of `stages.py`.
      duals, aims: multipliers, and those after the whole step. shares: multipliers relative to the price.
    """

    plan: Motion
    trial: Motion
    limits: Annotated[Limits, "T M"]
    costates: Annotated[Arrays, "T+1 N"]
    gaps: Annotated[Arrays, "T N"]
    arrived: Annotated[Arrays, "T N"]
    numbers: Annotated[Arrays, "K"]
    curves: Annotated[Arrays, "K"]
    duals: Annotated[Arrays, "K"]
    aims: Annotated[Arrays, "K"]
    shares: Annotated[Arrays, "K"]


class EliminatedControl(NamedTuple):
    """A step and its stage with the control eliminated by u = w - F x - h, for the dual form.

    `factor` (M, M) is the Cholesky factor of R, AT (N, N) and BT (M, N) are the step's matrices transposed, Q (N, N)
    and q (N,) the cost of the state, and `size` (N,) the diagonal of its Hessian before.
    """

    factor: Arrays
    F: Arrays
    h: Arrays
    AT: Arrays
    BT: Arrays
    Q: Arrays
    q: Arrays
    size: Arrays


class Descent(NamedTuple):
    """How steps from a plan are made, accepted and regularised; see `descent.py`.

    Attributes:
      method: DAMPED or NEWTON.
      changes: number of small changes of cost in a row after which the plan is judged; 0 to judge each plan.
      idle: number of steps in a row that improve by rounding which ends the descent.
      share: fraction of second-order terms in the first models of a plan. reach: that of the first step.
      smallest, armijo: the smallest fraction of a step that the line search tries, and the fraction of the predicted
        decrease that a step must achieve; of models at reach 0 without second-order terms SHORTEST and 0, if `patient`.
      lightest, factor: the first weight on changes of the controls, for Newton's method relative to the merit and for
        damped steps to their curvature; and the factor to the next.
      weights: number of weights that are tried where a pass fails. heaviest: largest weight that is tried where steps
        are rejected.
    """

    method: int
    changes: int
    idle: float = inf
    share: float = 0.0
    reach: float = 0.0
    smallest: float = 0.0
    armijo: float = 0.0
    lightest: float = 0.0
    factor: float = 0.0
    weights: int = 0
    heaviest: float = 0.0
    patient: bool = True


NO_DESCENT = Descent(method=0, changes=0)


class IterationSettings(NamedTuple):
    """Limits of a solve's iterations, and tolerances of convergence.

    Attributes:
      steps: T. tolerance, gap_tolerance: tolerances of relative changes of cost, and of the gap.
      optimal: whether a settled cost must also be optimal. fixed: whether the start is given exactly.
      guided: whether the first iteration linearises about the guess. prior_iterations: number of iterations with the
        prior.
      rounding: negligible cost relative to the stages' constants, of which it is left where the least cost is zero.
      valley: the gap below which Newton's method takes over from smoothing; 0 for never.
      descent: the steps of a descent.
    """

    steps: int
    max_iterations: int
    tolerance: float
    gap_tolerance: float
    optimal: bool
    fixed: bool
    guided: bool
    prior_iterations: int
    rounding: float
    valley: float = 0.0
    descent: Descent = NO_DESCENT


class SmootherArrays(NamedTuple):
    """All arrays of a smoother.

    Attributes:
      start: the first state. x_hat: the smoothed state that a pass has reached. x_hats: all of them.
      homotopy_scaled: the stage cost of the passes; not the true one in the first iterations of a homotopy.
      given: the trajectory that guides the first pass. best: the best one so far. last: that of the last policy.
      certificate: (1,) row of `CERTIFICATE`.
    """

    start: Annotated[Arrays, "N"]
    x_hat: Annotated[Arrays, "N"]
    x_hats: Annotated[Arrays, "T+1 N"]
    policy: Policy
    to_go: CostToGo
    to_come: CostToCome
    smoothing: SmootherGains
    homotopy_scaled: Any
    prior: Prior
    given: Motion
    best: Motion
    last: Motion
    last_policy: Policy
    certificate: Arrays


class FilterSizes(NamedTuple):
    """Sizes of a Kalman filter; see `square_root_filter.py`.

    Attributes:
      knots: T+1. entries: Z. measured: Y. states: n. disturbing: D, number of columns of the process noise's root.
      used: whether the filter begins after the first measurement.
      resolution, nothing: the least noise of a measurement, relative to its std and absolute.
    """

    knots: int
    entries: int
    measured: int
    states: int
    disturbing: int
    used: bool
    resolution: float
    nothing: float


class FilterModel(NamedTuple):
    """F (T, Z, Z), H (T+1, Y, n), and roots of the noise: of measurements (T+1, Y, n), of the process (T, Z, D)."""

    F: Arrays
    H: Arrays
    noise: Arrays
    disturbing: Arrays


class FilterRoots(NamedTuple):
    """Square roots of a Kalman filter's covariances; the first is given, the others are written.

    Attributes:
      root: (Z, Z) at the start; overwritten. before, after: before and after each measurement, (T+1, Z, Z).
      innovation: S, (T+1, Y, Y). learned: K S, (T+1, Z, Y). work: ((Y+Z) (n+Y+Z),) and at least (Z (Z+D),).
    """

    root: Arrays
    before: Arrays
    after: Arrays
    innovation: Arrays
    learned: Arrays
    work: Arrays


class LoopSizes(NamedTuple):
    """Sizes of C laws in L systems; see `loop_moments.py`.

    Attributes:
      steps: T. systems: L. laws: C. moved: Y. entries: X. controls: m. shown: number of entries of y whose moments are
        written.
      stated: number of the first entries of y that are the system's own. With losses, the last m of these are the
        actuators' states.
      rows, columns: of the noise.
      correlated: whether noise of the commands is correlated with that of y. lossy: whether commands get lost.
      lost: number of lost commands for each that arrives.
    """

    steps: int
    systems: int
    laws: int
    moved: int
    entries: int
    controls: int
    shown: int
    stated: int
    rows: int
    columns: int
    correlated: bool
    lossy: bool
    lost: float


class LoopArrays(NamedTuple):
    """The loops y' = F X + G' (u - planned) + c + w under the commands K X + command + r, which are limited to u.

    X = (y, d) are Y numbers that commands move, and X - Y that they do not.

    Attributes:
      F: (T, L, Y, X). G: (T, L, m, Y). c: (T, L, Y).
      noise: covariance of the first entries of y with the first entries of X: at the start, and then of w, (T+1, L,
        rows, columns).
      fresh: covariance of d at the start, and then of its noise, (T+1, L, X - Y, X - Y).
      transition: d' is this times d and noise, (X - Y, X - Y).
      K: (T, C, m, X). command: (T, C, m). planned: (T, m).
      shaking: covariance of r, (T, C, m, m). jointly: covariance of r with w, (T, C, m, Y); empty if it is zero.
      reached: nominal actuators' states, (T+1, L, m). low, high: limits of the controls, (m,).
    """

    F: Arrays
    G: Arrays
    c: Arrays
    noise: Arrays
    fresh: Arrays
    transition: Arrays
    K: Arrays
    command: Arrays
    planned: Arrays
    shaking: Arrays
    jointly: Arrays
    reached: Arrays
    low: Arrays
    high: Arrays


class LoopWork(NamedTuple):
    """Work arrays of closed loops.

    Attributes:
      P: covariance of X, (L, C, X, X). M: of X' = M X and noise, (L, C, X, X). moved: M P for y alone, (L, C, Y, X).
      given: covariance of d, (L, X - Y, X - Y). half: the transition times it, (X - Y, X - Y).
      mean: of y, (L, C, Y). ahead: of y at the next knot, (Y,).
      response: K P, (L, C, m, X). law: K times the slopes, (L, C, m, X).
      pushed, shaken, held: G times the noise of the commands, their correlation with w, and G times the change by
        a loss, (L, C, m, Y).
      slope, level, left: of the limited commands, (L, C, m).
    """

    P: Arrays
    M: Arrays
    moved: Arrays
    given: Arrays
    half: Arrays
    mean: Arrays
    ahead: Arrays
    response: Arrays
    law: Arrays
    pushed: Arrays
    shaken: Arrays
    held: Arrays
    slope: Arrays
    level: Arrays
    left: Arrays


class LoopMoments(NamedTuple):
    """Moments of the first N entries of y about the plan; of several loops, by axes before these or after that of time.

    Attributes:
      mean: mean of y, (T+1, N).
      covariance: covariance of y, (T+1, N, N).
      across: covariance of y with y at the previous knot, (T, N, N).
      command: standard deviation of each command, before it is limited, (T, m).
      saturation: fraction of the commands that are beyond the limits, (T, m).
    """

    mean: Arrays
    covariance: Arrays
    across: Arrays
    command: Arrays
    saturation: Arrays


class PassSizes(NamedTuple):
    """Sizes of the backward pass of C tracking laws; see `tracking_law.py`.

    Attributes:
      laws: C. moved: Y, the states that controls move. entries: Z, of z = (y, d). controls: m.
      lost: fraction of the commands that get lost. The last m of y are then the actuators' states.
    """

    laws: int
    moved: int
    entries: int
    controls: int
    lost: float


class PassArrays(NamedTuple):
    """What tracking laws are of, by columns for (y, d, 1).

    Attributes:
      control: diagonal of R, (m,). state: diagonals of Q, (C, Y).
      undo: R times the controls that cancel the unknowns, (T, C, m, Z+1). held: a lost command, (T, m, Z+1).
      laws: the laws, written, (T, C, m, Z+1).
    """

    control: Arrays
    state: Arrays
    undo: Arrays
    held: Arrays
    laws: Arrays


class PassWork(NamedTuple):
    """Work arrays of the backward pass.

    Attributes:
      cost: the cost-to-go (S, D, s), (C, Y, Z+1).
      products: [F G]' (S [F E c G] + (0, D, s, 0)), (C, Y+m, Z+1+m).
      curve: R + G'SG, then its elimination, (C, m, m). mean: a mean of laws, (m, Z+1).
    """

    cost: Arrays
    products: Arrays
    curve: Arrays
    mean: Arrays


class RiccatiArrays(NamedTuple):
    """Results of the passes of a linear-quadratic problem; `x_hats` are the smoothed states."""

    policy: Policy
    to_go: CostToGo
    to_come: CostToCome
    smoothing: SmootherGains
    x_hats: Annotated[Arrays, "T+1 N"]


class Predictor(NamedTuple):
    """The model that predicts estimates over a control period; see `estimation.py`.

    Attributes:
      dynamics, dt: as in `ProblemModel`. places: (P,) indices of the unknown parameters.
      lag: (2,) remaining fraction of the difference to a command at the end of a period, and on average over the
        period.
      transition: (D, D), for the unknowns' states. output: (V, D), from these to the unknowns.
    """

    dynamics: DynamicsModel
    dt: float
    places: Arrays
    lag: Arrays
    transition: Arrays
    output: Arrays


class SensorModel(NamedTuple):
    """Addresses of the measurement and of its Jacobian, and their data (any,)."""

    measure: float
    slope: float
    data: Arrays


class Measurements(NamedTuple):
    """Measured states (count, N), and (count,) 1 where a measurement was lost, else 0."""

    shown: Arrays
    lost: Arrays


class AngularStates(NamedTuple):
    """Indices (any,) of the angles; of rotation vectors (any, 2) the index, and which entry is an angle, or -1; and
    their numbers.
    """

    angles: Arrays
    angle_count: int
    rotations: Arrays
    rotation_count: int


def _row(*names: str) -> np.dtype[np.void]:
    return np.dtype([(name, np.float64) for name in names])


# The state of the iterations between calls.
# plan_cost, merit: cost and merit of the plan; the merit includes the augmented Lagrangian. started: 1 once the start
# was rolled out. watched: 1 if undamped iterations end without progress, because the safeguard can take over.
# Of a descent: small_changes: number of small changes of cost in a row; idle: number of steps in a row that improved by
# rounding. failed: the step at which the last pass failed, or -1. negligible: the negligible cost; least: the least
# cost to which an optimality is relative. final_gap: gap between smoothed states and plan at the end.
# Of damped steps: reach of the next; weight on changes of the controls, which iLQR has, too; for steps at reach 0,
# iLQR's, how many remain, how many there will be the next time, and how many others there were since.
# Of passes about the plan: known: 1 if the next step's was made; its fraction of second-order terms (share), weight on
# changes of the controls (damping), predicted slope of the merit (decrease) and predicted decrease, relative to the
# merit (promised). more: number of steps that followed an optimal plan.
MEMORY = _row(
    "plan_cost", "merit", "started", "watched", "small_changes", "idle", "failed", "negligible", "least", "final_gap",
    "reach", "weight", "ilqr_left", "ilqr_next", "since_ilqr", "known", "share", "damping", "decrease", "promised",
    "more",
)  # fmt: skip

# The state of an interior point between calls. cost, stationarity, violation, gap, complementarity: the measures of the
# iterate; see `interior_point.Measures` of the solvers. miss: largest difference of a row's value and its slacks,
# relative to the row's size. product: largest product of a slack and its multiplier. scale: the cost to which measures
# are relative. typical: the typical cost of a change. parameter, highest, barrier: the barrier parameter; its largest
# value; and that as a fraction of the cost of a row. pairs: number of slacks. elastic: 1 if a row has a price. rung:
# that of the step's models on the ladder of regularisation. share: fraction of the projected Hessian in these. soft:
# softness of equalities. part: the fraction of the last step that was taken. forced: number of steps that were taken
# although the filter rejected them. filtered, failed: numbers of rows of the filter and of the last errors. farthest,
# farthest_gap: largest violations. violated, merit, slope: of the iterate, for the line search. tried: the cost of its
# trial. solved: 1 once the measures are within tolerance. target: the tolerance towards which the barrier falls. since:
# number of iterations since the last attempt to cross over. short: number of short steps in a row. before: cost at the
# first of these. unchanged, level: number of iterations in a row in which the constraints were kept and the cost was
# that of the first, `level`. kept, kept_scale: cost and scale of the point to go back to. whole: the largest fraction
# of the last step with which slacks stay positive. age: number of steps since the dynamics were linearised; oldest: its
# largest value.
INTERIOR = _row(
    "cost", "stationarity", "violation", "gap", "complementarity", "miss", "product", "scale", "typical", "parameter",
    "highest", "barrier", "pairs", "elastic", "rung", "share", "soft", "part", "forced", "filtered", "failed",
    "farthest", "farthest_gap", "violated", "merit", "slope", "tried", "solved", "target", "since", "short", "before",
    "unchanged", "level", "kept", "kept_scale", "whole", "age", "oldest",
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
# the iterate, and the predicted slope of its merit. promised: its predicted decrease, relative to the merit. part: the
# fraction of the step that was accepted; 0 for none. violation, near: of the iterate, and whether it is nearly
# feasible. close: number of times in a row that it was, and its cost `before` hardly different. informed: 1 once
# multipliers are known. looking: 1 if the last iteration is not yet completed.
RESTORATION = _row(
    "rows", "parameter", "least", "damping", "level", "cost", "merit", "decrease", "promised", "part", "violation",
    "near", "close", "before", "informed", "looking",
)  # fmt: skip

# An iteration of a restoration.
RESTORED = _row("cost", "violation", "promised")

# A row of the log; NaN where something was not computed.
LOG = _row("cost", "improvement", "gap", "optimality", "residual", "method")

# The results of `certificate.certify`; and of `certificate.reduced_curvature`, the curvature.
CERTIFICATE = _row(
    "cost", "scale", "typical", "dynamics_residual", "policy_residual", "beyond_limits", "decrease", "curvature"
)  # fmt: skip
