"""`track`, a policy that keeps a robot on a plan; and the choice of tolerances for `track` and `OffsetFree`.

The chosen tolerances have the smallest predicted chance of failure: of a collision, or of an end farther from the
plan's end than the goal's radius. All of them follow from one number, the time in which a deviation should vanish: each
state may deviate by as much as random controls of the tolerated effort move it in that time. Units therefore do not
matter, and no state is held much more tightly than the controls permit. Weights that are tuned one by one can have
better predictions, but only with the linear model for which they are tuned.

The linear model is wrong where controls are often at their limits. Saturation therefore also counts against a law.

If collisions are what makes a law fail, laws with an emphasis on the deviations that lead to them compete with it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from lqrsim.control.collision_chance import Surroundings, collision_chance
from lqrsim.control.emphasis import emphasis_of
from lqrsim.control.kalman import KalmanFilter
from lqrsim.control.linear_loop import limited
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.tracking_laws import AT_END, Averse, Weights, check_plan, effort_of, tracking_laws
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import Array, InputError, check_kind, check_number
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import PerEntry
from lqrsim.results.goal import Target, scale_of
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution

PERIODS = (4, 6, 8, 10, 12, 14, 17, 20, 24, 29, 35, 42)  # numbers of control periods in which a deviation may decay
WIDE = 10.0  # factor on the tolerances of states that the goal leaves free
# By how much the emphasis may count: deviations at the most critical knot count this many times as much.
EMPHASIS = (100.0, 30.0, 10.0, 5.0, 2.0, 0.0)
# The largest fraction of commands beyond the limits with which there is an emphasis. With more, the linear model
# promises fewer collisions than there are, because more trials leave their plan for good.
MODELLED = 0.12
# The chance of failure that a tube of twice the narrowest width is charged. It is small, so that width decides only if
# the plan is far from all obstacles, or collides with any law.
NARROW = 0.02
# Factor of the squared fraction of commands beyond the limits, as an addition to the chance of failing. The linear
# model knows nothing of trials that stay at their limits and leave the plan. This value is our choice: with a smaller
# one, under moderate disturbances, the emphasis causes more such trials than it prevents collisions.
FRAGILE = 5.0


class StateMoments(NamedTuple):
    """Moments of the states' deviations from the plan under C laws, as in `collision_chance`.

    Attributes:
      mean: (C, T+1, n). covariance: (C, T+1, n, n). across: (C, T, n, n).
      saturation: fraction of the commands beyond the limits, (C,).
    """

    mean: Array
    covariance: Array
    across: Array
    saturation: Array


@dataclass(frozen=True)
class Prediction:
    """Prediction for a law: chance of failure, mean width of the tube, fraction of commands beyond the limits."""

    chance: float
    width: float
    saturation: float


def choose_tolerances(
    problem: Problem, solution: Solution, uncertainty: Uncertainty, model: PlanModel, effort: Array, at_end: float,
    moments: Callable[[Weights, tuple[Array, Array]], StateMoments],
) -> Weights:  # fmt: skip
    """Choose the tolerances whose law is predicted to fail least often.

    Args:
      effort: largest change of each control, (m,).
      at_end: as in `track`.
      moments: predicts the moments under the laws of C weights and the limits of the controls.
    """
    tried, space = tolerances_to_try(model, effort, at_end, solution.target), solution.policy.control_coordinates
    limits = np.array(space.low), np.array(space.high)
    found = moments(tried, limits)
    told = predictions(problem, solution, uncertainty, model, found)
    least = narrowest(model, told)
    best = gentlest_of_best(worth_of(told, least))
    weights, (mean, covariance, across, _) = tried.pick(best), (one[best] for one in found)
    surroundings = Surroundings.of(problem, uncertainty.obstacles)
    emphasis = emphasis_of(surroundings, model.plan.states + mean, covariance, across, weights.state)
    if told[best].saturation > MODELLED or not emphasis.any():
        return weights
    stressing = weights.stressing(emphasis, EMPHASIS)
    told = predictions(problem, solution, uncertainty, model, moments(stressing, limits))
    return stressing.pick(gentlest_of_best(worth_of(told, least)))


def gentlest_of_best(worth: list[float]) -> int:
    """The index of the smallest number; of equals the last."""
    return min(reversed(range(len(worth))), key=worth.__getitem__)


def tolerances_to_try(model: PlanModel, effort: Array, at_end: float, target: Target) -> Weights:
    """Weights for each number of periods that a deviation may take to decay, the tightest first.

    If the goal leaves states free, the same with wide tolerances for these follow: a satellite that must take up an
    unplanned spin can only do so by other speeds of its wheels.
    """
    longest = max(model.plan.steps // 2, PERIODS[0])
    reach, units = reach_of(model, effort, PERIODS[-1]), model.dynamics.state_coordinates.units
    tried = [unit_means(units, reach[periods]) for periods in PERIODS if periods <= longest]
    if (free := np.isnan(target.state)).any():
        tried += [np.where(free, WIDE * one, one) for one in tried]
    each = [Weights.of(tuple(one.tolist()), effort, model.dynamics, at_end=at_end) for one in tried]
    return Weights(np.array([one.state for one in each]), each[0].control, np.array([one.end for one in each]))


def predictions(
    problem: Problem, solution: Solution, uncertainty: Uncertainty, model: PlanModel, moments: StateMoments
) -> list[Prediction]:
    """The predictions for C laws with these moments."""
    surroundings = Surroundings.of(problem, uncertainty.obstacles)
    return [prediction_of(model, *one, surroundings, solution) for one in zip(*moments, strict=True)]


def narrowest(model: PlanModel, told: list[Prediction]) -> float:
    """The width of the narrowest tube; a thousandth of the plan's extent is narrow enough."""
    extent = float(np.ptp(model.plan.states, axis=0).max()) or 1.0
    return max(min(one.width for one in told), 1e-3 * extent)


def worth_of(told: list[Prediction], least: float) -> list[float]:
    """How bad each law is: its chance to fail, more with saturation and with a tube wider than `least`."""
    return [one.chance + FRAGILE * one.saturation**2 + NARROW * max(one.width / least, 1.0) for one in told]


def reach_of(model: PlanModel, effort: Array, periods: int) -> dict[int, Array]:
    """The motion of each state, (n,), by random controls of an effort, in each number of periods: rms over the plan."""
    n, steps = model.n, model.plan.steps
    A, B = model.jacobian[:, :, :n], model.jacobian[:, :, n:]
    moved, total, reach = B * effort, np.zeros(n), dict[int, Array]()
    for k in range(1, periods + 1):
        if len(moved):
            total = total + (moved**2).sum(axis=2).mean(axis=0)
        reach[k] = np.sqrt(np.maximum(total, 1e-24))
        moved = A[k:] @ moved[: max(steps - k, 0)]
    return reach


def unit_means(units: tuple[str, ...], numbers: Array) -> Array:
    """Replace numbers (n,) by the rms over all states of the same unit."""
    squares = {unit: [number**2 for number, own in zip(numbers, units, strict=True) if own == unit] for unit in units}
    return np.array([np.sqrt(np.mean(squares[unit])) for unit in units])


def prediction_of(
    model: PlanModel, mean: Array, covariance: Array, across: Array, saturation: float, surroundings: Surroundings,
    solution: Solution,
) -> Prediction:  # fmt: skip
    """The prediction for a law's moments."""
    plan = model.plan.states
    place = list(model.dynamics.state_coordinates.position)
    collide = collision_chance(plan + mean, covariance, across, surroundings)[1]
    counts = np.array(place) if place else np.flatnonzero(np.isfinite(solution.target.state))
    scale = np.ones(len(place)) if place else scale_of(plan)[counts]
    squares = (np.diagonal(covariance, axis1=1, axis2=2)[:, counts] + mean[:, counts] ** 2) / scale**2
    width = float(np.sqrt(squares.sum(axis=1).mean()))
    return Prediction(collide + _miss(mean[-1], covariance[-1], solution), width, float(saturation))


def _miss(mean: Array, covariance: Array, solution: Solution) -> float:
    """About the chance to end farther from the plan's end than the goal's radius, by the moments there.

    Of a position it is that of its most uncertain direction. Without one, each state that counts has its own bound.
    """
    target, radius = solution.target, solution.goal_radius
    if place := target.places:
        widest = float(np.sqrt(max(np.linalg.eigvalsh(covariance[place][:, place])[-1], 0.0)))
        off = float(np.linalg.norm(mean[place]))
        return 0.0 if radius is None else float(_beyond(radius, off, widest))
    radius = target.radius(None, None, None) if radius is None else radius
    counts = np.isfinite(target.state)
    bounds, std = radius * scale_of(solution.trajectory.states), np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    return float(1 - np.prod(1 - _beyond(bounds, np.abs(mean), std)[counts]))


def _beyond(bound: Array | float, off: Array | float, std: Array | float) -> Array:
    """The chance that normal numbers with these means exceed a bound in size."""
    std = np.maximum(std, 1e-12)
    return ndtr((off - bound) / std) + ndtr((-off - bound) / std)


def with_filter(model: PlanModel, kalman: KalmanFilter, weights: Weights, limits: tuple[Array, Array]) -> StateMoments:
    """Moments under the laws of C weights that follow a filter's estimates.

    The filter is assumed to be right about the noise. Its error is then independent of its estimate, which needs less
    computation than `linear_loop.py`.
    """
    n, own, steps, count = model.n, model.n + model.lagging, model.plan.steps, len(weights.state)
    gain, offset = tracking_laws(model, weights)
    learned = kalman.gain @ kalman.innovation @ kalman.gain.transpose(0, 2, 1)
    unlearned = model.F[:, :n] @ kalman.corrected[:-1, :, :n]
    # Covariance and mean of the estimate's deviation from the plan. As in `of_states`, no law moves the unknowns.
    size, transition = model.size, model.transition
    estimate, mean = np.zeros((count, size, size)), np.zeros((count, own))
    covariance, across = np.empty((count, steps + 1, n, n)), np.empty((count, steps, n, n))
    means, beyond = np.empty((count, steps + 1, n)), np.zeros((count, model.m))
    for t in range(steps + 1):
        covariance[:, t], means[:, t] = estimate[:, :n, :n] + kalman.predicted[t, :n, :n], mean[:, :n]
        estimate += learned[t]
        if t == steps:
            break
        law, F, G, planned = gain[:, t], model.F[t, :own], model.G[t, :own], model.plan.controls[t]
        response = law @ estimate
        std = np.sqrt(np.maximum((response * law).sum(axis=2), 0.0))
        centre = planned + offset[:, t] + (law[:, :, :own] @ mean[:, :, None])[:, :, 0]
        slope, level, left = limited(centre, std, *limits)
        beyond += (1 - slope) / steps
        # M estimate M' of M = F + G slope law. The estimate is symmetric, so one product serves all laws.
        moved = np.ascontiguousarray((estimate.reshape(-1, size) @ F.T).reshape(count, size, own).swapaxes(1, 2))
        moved += G @ (slope[:, :, None] * response)
        pushed = moved @ (slope[:, :, None] * law).transpose(0, 2, 1) + G * left[:, None, :]
        # The true state is the estimate plus its error; the control moves only the estimate.
        across[:, t] = moved[:, :n, :n] + unlearned[t]
        meet = moved[:, :, own:] @ transition.T
        estimate[:, own:, own:] = transition @ estimate[0, own:, own:] @ transition.T
        estimate[:, :own, :own] = (moved.reshape(-1, size) @ F.T).reshape(count, own, own) + pushed @ G.T
        estimate[:, :own, own:], estimate[:, own:, :own] = meet, meet.transpose(0, 2, 1)
        mean = mean @ F[:, :own].T + model.c[t, :own] + (level - planned) @ G.T
    return StateMoments(means, covariance, across, beyond.mean(axis=1))


def of_states(model: PlanModel, gain: Array, offset: Array, limits: tuple[Array, Array]) -> StateMoments:
    """Moments under C laws of the measured states, (C, T, m, n) and (C, T, m), in deviations from the plan.

    `linear_loop.py` defines the moments. No law moves the unknowns: their rows are the same for all, and of the
    covariance's next one only the rows for the state and the actuators are computed.
    """
    n, own, steps, count, size = model.n, model.n + model.lagging, model.plan.steps, len(gain), model.size
    covariance, mean = np.tile(model.start_root @ model.start_root.T, (count, 1, 1)), np.zeros((count, own))
    states, across = np.empty((count, steps + 1, n, n)), np.empty((count, steps, n, n))
    means, beyond = np.empty((count, steps + 1, n)), np.zeros((count, model.m))
    shown, transition, unknowns = model.shown_std**2, model.transition, covariance[0, own:, own:]
    arrives, *lost = model.steps_of_commands
    for t in range(steps + 1):
        states[:, t], means[:, t] = covariance[:, :n, :n], mean[:, :n]
        if t == steps:
            break
        law, planned, noise = gain[:, t], model.plan.controls[t], model.process_noise[t]
        F, G = arrives.F[t, :own], arrives.G[t, :own]
        response = law @ covariance[:, :n]
        std = np.sqrt(np.maximum((response[:, :, :n] * law).sum(axis=2) + law**2 @ shown, 0.0))
        centre = planned + offset[:, t] + (law @ mean[:, :n, None])[:, :, 0]
        slope, level, left = limited(centre, std, *limits)
        beyond += (1 - slope) / steps
        law, response = slope[:, :, None] * law, slope[:, :, None] * response
        # M P for M = F + G law: the covariance with the previous deviation. P is symmetric, so one product serves all
        # laws.
        free = np.ascontiguousarray((covariance.reshape(-1, size) @ F.T).reshape(count, size, own).swapaxes(1, 2))
        moved, base = free + G @ response, mean @ F[:, :own].T
        pushed = moved[:, :, :n] @ law.swapaxes(1, 2)
        pushed += G @ ((law * shown) @ law.swapaxes(1, 2))
        pushed[:] += G * left[:, None, :]
        ahead, spread = base + (level - planned) @ G.T + arrives.c[t, :own], 0.0
        if lost:  # the command in force stays, as if the law requested it
            (other,), kept = lost, slice(n, own)
            moved_on, ahead_on = free + G @ covariance[:, kept], base + mean[:, kept] @ G.T + other.c[t, :own]
            off = (ahead_on - ahead)[:, :, None]
            spread = arrives.share * other.share * off * off.swapaxes(1, 2)
            moved = arrives.share * moved + other.share * moved_on
            pushed = arrives.share * pushed + other.share * moved_on[:, :, kept]
            ahead = arrives.share * ahead + other.share * ahead_on
        across[:, t], mean = moved[:, :n, :n], ahead
        own_next = (moved.reshape(-1, size) @ F.T).reshape(count, own, own) + pushed @ G.T + spread
        meet = moved[:, :, own:] @ transition.T + noise[:own, own:]
        unknowns = transition @ unknowns @ transition.T + noise[own:, own:]
        covariance[:, :own, :own], covariance[:, :own, own:] = own_next + noise[:own, :own], meet
        covariance[:, own:, :own], covariance[:, own:, own:] = meet.swapaxes(1, 2), unknowns
    return StateMoments(means, states, across, beyond.mean(axis=1))


def track(
    problem: Problem,
    solution: Solution,
    *,
    tolerate: PerEntry | None = None,
    effort: PerEntry | None = None,
    at_end: float = AT_END,
    uncertainty: Uncertainty | None = None,
    risk: float = 0.0,
) -> AffinePolicy:
    """Return the policy that minimises squared deviations from a plan.

    The policy of `smooth` is optimal for the problem's cost, which often does not penalise deviations from the plan.
    The policy of `track` is optimal for staying on the plan. Run it with `simulate(plant, solution,
    controller=track(...))`; it is saved and drawn like any other policy.

    Args:
      problem: the problem that was solved.
      solution: its solution, or another solution with a plan of the same system.
      tolerate: the tolerated deviation of each state, by unit or name: {"m": 0.05, "m/s": 0.2, "rad": 0.2, "rad/s":
        0.2}. Only the ratios to one another and to `effort` matter. By default, the tolerances with which the robot is
        least likely to fail under the uncertainty.
      effort: the largest change of each control for returning to the plan; by default a quarter of its range.
      at_end: factor on the tolerances of the position at the end of the plan; on the tolerances of all states if there
        is no position.
      uncertainty: the uncertainty in a run, as from `uncertainty_of`. It serves for choosing tolerances, and for the
        effect of lost commands.
      risk: theta: minimise (1/theta) log E exp(theta/2 * sum of squares) under the problem's noise along the plan. A
        theta above 0 penalises large deviations more. Tolerances must then be given.

    Returns:
      The policy.

    Raises:
      InputError: the solution is of another system; tolerances or uncertainty do not fit it, or neither is given.
    """
    check_plan("track", problem, solution)
    risk = check_number("track: risk", risk)
    if risk and (problem.noise is None or tolerate is None):
        missing = "a problem without noise" if problem.noise is None else "no tolerances"
        raise InputError(f"track: risk: got {risk:g} and {missing}, want noise=Noise(...) and tolerate=, or 0")
    plan, dynamics = solution.trajectory, problem.dynamics
    if uncertainty is not None:
        check_kind("track: uncertainty", uncertainty, Uncertainty, "an Uncertainty, such as uncertainty_of(...)")
    command_loss = 0.0 if uncertainty is None else uncertainty.command_loss
    model = PlanModel.of(dynamics, plan, Uncertainty(command_loss=command_loss))
    efforts = effort_of(effort, dynamics)
    if tolerate is not None:
        weights = Weights.of(tolerate, efforts, dynamics, at_end=at_end)
    elif uncertainty is None:
        raise InputError(
            "track: tolerate: got none, want how far each state may be off, such as {'m': 0.05, 'm/s': 0.2}, or"
            " uncertainty=, from which it is chosen"
        )
    else:
        truth = PlanModel.of(dynamics, plan, uncertainty)

        def moments(tried: Weights, limits: tuple[Array, Array]) -> StateMoments:
            gain, offset = tracking_laws(model, tried)
            return of_states(truth, gain[..., : model.n], offset, limits)

        weights = choose_tolerances(problem, solution, uncertainty, model, efforts, at_end, moments)
    gain, offset = _laws(problem, solution, model, weights, risk)
    gain = gain[..., : model.n]  # the command in force has no effect on a command that arrives
    return AffinePolicy(
        gain=gain,
        offset=plan.controls + offset - np.einsum("tij,tj->ti", gain, plan.states[:-1]),
        nominal=plan.states[:-1],
        dt=plan.dt,
        state_coordinates=dynamics.state_coordinates,
        control_coordinates=solution.policy.control_coordinates,
    )


def _laws(problem: Problem, solution: Solution, model: PlanModel, weights: Weights, risk: float) -> tuple[Array, Array]:
    """The laws, with the risk if it is not 0. If the risk is too high, raises InputError with the largest possible."""
    if not risk or problem.noise is None:
        return tracking_laws(model, weights)
    plan = solution.trajectory
    matrices = problem.noise.matrices(problem.dynamics, plan.states[:-1], plan.controls)

    def laws(tried: float) -> tuple[Array, Array] | None:
        try:
            return tracking_laws(model, weights, Averse(matrices, tried))
        except np.linalg.LinAlgError:
            return None

    if (found := laws(risk)) is not None:
        return found
    low, high = 0.0, risk
    while high - low > 1e-6 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if laws(middle) is None else (middle, high)
    raise InputError(
        f"track: risk: got {risk:g}, want at most {low * (1 - 1e-5):.5g}: with more the expected cost is infinite"
    )
