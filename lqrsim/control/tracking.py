"""`track`, a policy that keeps a robot on a plan; and the choice of tolerances for `track` and `OffsetFree`.

The chosen tolerances have the smallest predicted chance of failure: of a collision, or of an end farther from the
plan's end than the goal's radius. All of them follow from one number, the time in which a deviation should vanish: each
state may deviate by as much as random controls of the tolerated effort move it in that time. Units therefore do not
matter, and no state is held much more tightly than the controls permit. Weights that are tuned one by one can have
better predictions, but only with the linear model for which they are tuned.

The linear model is wrong where controls are often at their limits. Saturation therefore also counts against a law. It
is also wrong where the dynamics are nonlinear within the tube: a tight law can turn a sailboat into the wind, and it
does not return. A law must therefore bring the nonlinear model back from a few likely deviations. And it does not show
what the limits do to a law that works against a wrong parameter, so `track` also runs a few trials with unknowns that
are drawn.

If collisions are what makes a law fail, laws with an emphasis on the deviations that lead to them compete with it.
"""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from lqrsim.control.collision_chance import Surroundings, collision_chance
from lqrsim.control.controllers import Feedback
from lqrsim.control.kalman import KalmanFilter
from lqrsim.control.linear_loop import LinearLoop, moments_of
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.sampled_loop import DeviationNorm, sample_loop
from lqrsim.control.tracking_laws import AT_END, Laws, Weights, check_plan, effort_of, tracking_laws
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import Array, InputError, check_kind, check_number
from lqrsim.kernels.records import LoopArrays, LoopMoments
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import PerEntry
from lqrsim.results.goal import Target
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory
from lqrsim.solvers.compiled import law_about, rollout

_log = logging.getLogger("lqrsim")
PERIODS = (4, 6, 8, 10, 12, 14, 17, 20, 24, 29, 35, 42)  # numbers of control periods in which a deviation may decay
WIDE = 10.0  # factor on the tolerances of states that the goal leaves free
# By how much the emphasis may count: deviations at the most critical knot count this many times as much.
EMPHASIS = (100.0, 30.0, 10.0, 5.0, 2.0)
# The largest fraction of commands beyond the limits with which there is an emphasis. With more, the linear model
# promises fewer collisions than there are, because more trials leave their plan for good.
MODELLED = 0.12
# The chance of failure that a tube of twice the narrowest width is charged. It is small, so that width decides only if
# the plan is far from all obstacles, or collides with any law.
NARROW = 0.02
# Factor of the squared fraction of commands beyond the limits, as an addition to the chance of failing. The linear
# model knows nothing of trials that stay at their limits and leave the plan. This value is our choice: the larger it
# is, the gentler the laws are, and the weaker their emphasis.
FRAGILE = 5.0
# The deviations from which a law must bring the model back: pairs drawn from the tube at this number of knots. It does
# not if the model gets farther from the plan than LOST times the widest part of the tube. The same counts for the
# trials with unknowns that are drawn, which are run if more than LIMITED of the commands are beyond the limits.
KNOTS, PAIRS, LOST = 3, 3, 6.0
TRIALS, LIMITED = 100, 1e-3
OPEN = Surroundings((), (), (), 0.0)


class Predictions(NamedTuple):
    """Predictions for laws: chance of failure, mean width of the tube, fraction of commands beyond the limits."""

    chance: Array
    width: Array
    saturation: Array

    @classmethod
    def of(
        cls, solution: Solution, surroundings: Surroundings, norm: DeviationNorm, moments: LoopMoments
    ) -> "Predictions":
        """The predictions for laws with these moments of the states, (..., T+1, n) and so on."""
        mean, covariance = moments.mean, moments.covariance
        collide = collision_chance(solution.trajectory.states + mean, covariance, moments.across, surroundings)[1]
        squares = _squares(norm, covariance) + norm(mean) ** 2
        width = np.sqrt(squares.mean(axis=-1))
        miss = _chance_of_miss(mean[..., -1, :], covariance[..., -1, :, :], solution)
        return cls(collide + miss, width, moments.saturation.mean(axis=(-2, -1)))

    def scores(self, least: float) -> Array:
        """What a choice of laws minimises: chance of failure, and terms for saturation and tubes wider than `least`."""
        return self.chance + FRAGILE * self.saturation**2 + NARROW * np.maximum(self.width / least, 1.0)


def choose_tolerances(
    problem: Problem, solution: Solution, uncertainty: Uncertainty, model: PlanModel, effort: Array, at_end: float,
    moments: Callable[[Laws], LoopMoments], truth: PlanModel | None = None, *, call: str,
) -> tuple[Weights, Laws]:  # fmt: skip
    """Choose the tolerances whose law is predicted to fail least often, and that law.

    Args:
      call: name of the user's call, for warnings.
      moments: predicts the states' moments under C laws.
      truth: model with the unknowns, for trials of laws that act on the measured state itself.
    """
    norm = DeviationNorm.of(solution, problem.dynamics.state_coordinates.position)
    surroundings = Surroundings.of(problem, uncertainty.obstacles)
    tried = tolerances_to_try(model, effort, at_end, solution.target)
    limits = solution.policy.control_coordinates.limits
    laws = tracking_laws(model, tried)
    loop_moments = moments(laws)
    predicted = Predictions.of(solution, surroundings, norm, loop_moments)
    least = narrowest(norm, model.plan, predicted.width)
    scores = predicted.scores(least)

    def lost(moments: LoopMoments, laws: Laws, i: int) -> int:
        law = laws.pick(i)
        limited = moments.saturation[i].mean() > LIMITED
        farthest = LOST * np.sqrt(_squares(norm, moments.covariance[i]).max())
        count = runs_lost(problem, solution, law, moments.mean[i], moments.covariance[i], norm, farthest)
        if count or not limited or truth is None or not truth.uncertainty.unknowns:
            return count
        run = Feedback(_policy_of(solution, law))
        return int((sample_loop(truth, run, limits, OPEN, norm, TRIALS, 0).farthest > farthest).sum())

    runs = dict[int, int]()  # the number of lost runs of each law
    for best in sorted(range(len(scores)), key=lambda i: (scores[i], -i)):  # of equals the gentlest first
        runs[best] = lost(loop_moments, laws, best)
        if not runs[best]:
            break
    else:
        best = min(runs, key=lambda i: runs[i])
        _log.warning(
            "%s: each law that was tried loses the plan from some deviations of the predicted size; the plan's own"
            " policy or tolerances of your own (tolerate=) may do better",
            call,
        )
    chosen = tried.pick(best), laws.pick(best)
    # The same with emphasis, if it is predicted to fail less often.
    if predicted.saturation[best] > MODELLED:
        return chosen
    mean, covariance, across = loop_moments.mean[best], loop_moments.covariance[best], loop_moments.across[best]
    emphasis = surroundings.emphasis(model.plan.states + mean, covariance, across, chosen[0].state)
    if not emphasis.any():
        return chosen
    stressing = chosen[0].stressing(emphasis, EMPHASIS)
    laws = tracking_laws(model, stressing)
    loop_moments = moments(laws)
    stressed = Predictions.of(solution, surroundings, norm, loop_moments).scores(least)
    i = int(np.argmin(stressed))
    better = stressed[i] < scores[best] and lost(loop_moments, laws, i) <= runs[best]
    return (stressing.pick(i), laws.pick(i)) if better else chosen


def tolerances_to_try(model: PlanModel, effort: Array, at_end: float, target: Target) -> Weights:
    """Weights for each number of periods that a deviation may take to decay, the tightest first.

    If the goal leaves states free, the same with wide tolerances for these follow: a satellite that must take up an
    unplanned spin can only do so by other speeds of its wheels.
    """
    longest = max(model.plan.steps // 2, PERIODS[0])
    periods = [period for period in PERIODS if period <= longest]
    tried = list(model.reach(effort, periods))
    if (free := np.isnan(target.state)).any():
        tried += [np.where(free, WIDE * tolerances, tolerances) for tolerances in tried]
    choices = [Weights.of(tuple(tolerances.tolist()), effort, model.dynamics, at_end=at_end) for tolerances in tried]
    return Weights(
        np.array([choice.state for choice in choices]), choices[0].control, np.array([choice.end for choice in choices])
    )


def runs_lost(
    problem: Problem, solution: Solution, law: Laws, mean: Array, covariance: Array, norm: DeviationNorm,
    farthest: float,
) -> int:  # fmt: skip
    """The number of deviations, drawn from a tube, from which the nonlinear model does not return to its plan.

    The law acts on the true state. The tube has these moments of the states, (T+1, n) and (T+1, n, n). A run that gets
    farther from the plan than `farthest` is lost.
    """
    plan, n, rng, lost = solution.trajectory, mean.shape[1], np.random.default_rng(0), 0
    gain, offset = law_about(plan.states, plan.controls + law.offset, law.gain[..., :n])
    for t in (plan.steps * k // KNOTS for k in range(KNOTS)):
        variances, axes = np.linalg.eigh(covariance[t])
        off = rng.standard_normal((PAIRS, n)) * np.sqrt(np.maximum(variances, 0.0)) @ axes.T
        for start in plan.states[t] + mean[t] + np.concatenate([off, -off]):
            states, _ = rollout(problem, gain[t:], offset[t:], start)
            with np.errstate(over="ignore", invalid="ignore"):  # of lost runs
                distance = norm(states - plan.states[t:])
            lost += not (distance <= farthest).all()
    return lost


def _squares(norm: DeviationNorm, covariance: Array) -> Array:
    """The mean squared distance from the mean, by covariances (..., n, n)."""
    return (np.diagonal(covariance, axis1=-2, axis2=-1)[..., norm.states] / norm.scale**2).sum(axis=-1)


def narrowest(norm: DeviationNorm, plan: Trajectory, widths: Array) -> float:
    """The width of the narrowest tube; a thousandth of the plan's extent by the norm is narrow enough."""
    extent = float((np.ptp(plan.states[:, norm.states], axis=0) / norm.scale).max()) or 1.0
    return max(float(widths.min()), 1e-3 * extent)


def _chance_of_miss(mean: Array, covariance: Array, solution: Solution) -> Array:
    """About the chance to end farther from the plan's end than the goal's radius, by the moments there.

    Of a position it is that of its most uncertain direction. Without one, each state that counts has its own bound.
    """
    target, radius = solution.target, solution.goal_radius
    if place := target.places:
        widest = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[..., place, :][..., place])[..., -1], 0.0))
        off = np.linalg.norm(mean[..., place], axis=-1)
        return np.zeros(off.shape) if radius is None else _chance_outside(radius, off, widest)
    radius = target.radius(None, None, None) if radius is None else radius
    counts, variance = np.isfinite(target.state), np.diagonal(covariance, axis1=-2, axis2=-1)
    bounds, std = radius * target.scale, np.sqrt(np.maximum(variance, 0.0))
    return 1 - np.prod(1 - _chance_outside(bounds, np.abs(mean), std)[..., counts], axis=-1)


def _chance_outside(bound: Array | float, off: Array, std: Array) -> Array:
    """The chance that normal numbers with these means exceed a bound in size."""
    std = np.maximum(std, 1e-12)
    return ndtr((off - bound) / std) + ndtr((-off - bound) / std)


def with_filter(model: PlanModel, kalman: KalmanFilter, limits: tuple[Array, Array], laws: Laws) -> LoopMoments:
    """Moments of the states under C laws that follow a filter's estimates.

    The filter is assumed to be right about the noise. Its error is then independent of its estimate, and what it learns
    from a measurement is noise that moves the estimate. The unknowns' estimates are moved by no law.
    """
    n, size = model.n, model.n + model.lagging
    learned = kalman.gain @ kalman.innovation @ kalman.gain.transpose(0, 2, 1)
    F, G, c, noise = (array[:, None, :size] for array in (model.F, model.G, model.c, learned))
    gain, offset = (part.swapaxes(0, 1) for part in laws)
    planned = model.plan.controls
    arrays = LoopArrays(
        F, G.swapaxes(-1, -2), c, noise, learned[:, size:, size:], model.transition, gain, planned[:, None] + offset,
        planned, np.zeros((*offset.shape, model.m)), np.zeros(0), model.reached, *limits,
    )  # fmt: skip
    moments = LoopMoments(*(moment[0] for moment in moments_of(arrays, size, n)))
    return moments._replace(
        covariance=moments.covariance + kalman.corrected[:, :n, :n],
        across=moments.across + model.F[:, :n] @ kalman.corrected[:-1, :, :n],
    )


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
      solution: its solution, or another solution with a plan of the same system.
      tolerate: the tolerated deviation of each state, by unit or name: {"m": 0.05, "m/s": 0.2, "rad": 0.2, "rad/s":
        0.2}. Only the ratios to one another and to `effort` matter. By default, the tolerances with which the robot is
        least likely to fail under the uncertainty, and an emphasis on deviations that lead to a collision.
      effort: the largest change of each control for returning to the plan; by default a quarter of its range.
      at_end: factor on the tolerances of the position at the end of the plan; on the tolerances of all states if there
        is no position.
      uncertainty: the uncertainty in a run, as from `uncertainty_of`. It serves for choosing tolerances, and for the
        effect of lost commands.
      risk: theta: minimise (1/theta) log E exp(theta/2 * sum of squares) under the problem's noise along the plan. A
        theta above 0 penalises large deviations more. Tolerances must then be given.
    """
    check_plan("track", problem, solution)
    risk = check_number("track: risk", risk)
    if risk and (problem.noise is None or tolerate is None):
        missing = "a problem without noise" if problem.noise is None else "no tolerances"
        raise InputError(f"track: risk: got {risk:g} and {missing}, want noise=Noise(...) and tolerate=, or 0")
    plan, dynamics = solution.trajectory, problem.dynamics
    kinds, wanted = (Uncertainty, type(None)), "an Uncertainty, such as uncertainty_of(...)"
    check_kind("track: uncertainty", uncertainty, kinds, wanted)
    command_loss = 0.0 if uncertainty is None else uncertainty.command_loss
    model = PlanModel.of(dynamics, plan, Uncertainty(command_loss=command_loss))
    efforts = effort_of(effort, dynamics)
    if tolerate is not None:
        law = _law(problem, solution, model, Weights.of(tolerate, efforts, dynamics, at_end=at_end), risk)
    elif uncertainty is None:
        raise InputError("track: tolerate: got none, want deviations, such as {'m': 0.05, 'm/s': 0.2}, or uncertainty=")
    else:
        truth = PlanModel.of(dynamics, plan, uncertainty)

        def moments(laws: Laws) -> LoopMoments:
            limits = solution.policy.control_coordinates.limits
            return LinearLoop(truth, laws.gain[..., : model.n], laws.offset, None, limits).moments(model.n)

        _, law = choose_tolerances(
            problem, solution, uncertainty, model, efforts, at_end, moments, truth, call="track(...)"
        )
    return _policy_of(solution, law)


def _policy_of(solution: Solution, law: Laws) -> AffinePolicy:
    """The policy of a law about the solution's plan. The command in force has no effect on a command that arrives."""
    plan, (gain, offset), policy = solution.trajectory, law, solution.policy
    gain = gain[..., : plan.states.shape[1]]
    offset = plan.controls + offset - np.einsum("tij,tj->ti", gain, plan.states[:-1])
    return replace(policy, gain=gain, offset=offset, nominal=plan.states[:-1].copy(), dt=plan.dt)


def _law(problem: Problem, solution: Solution, model: PlanModel, weights: Weights, risk: float) -> Laws:
    """The law, with the risk if it is not 0. If the risk is too high, raises InputError with the largest possible."""
    if not risk or problem.noise is None:
        return tracking_laws(model, weights)
    plan = solution.trajectory
    matrices = problem.noise.matrices(problem.dynamics, plan.states[:-1], plan.controls)

    def law_of(tried: float) -> Laws | None:
        try:
            return tracking_laws(model, weights, matrices, tried)
        except np.linalg.LinAlgError:
            return None

    if (averse := law_of(risk)) is not None:
        return averse
    low, high = 0.0, risk
    while high - low > 1e-6 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if law_of(middle) is None else (middle, high)
    most = low * (1 - 1e-5)
    raise InputError(f"track: risk: got {risk:g}, want at most {most:.5g}: with more the expected cost is infinite")
