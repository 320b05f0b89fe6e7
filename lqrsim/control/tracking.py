"""`track`, a policy that keeps a robot on a plan; and the choice of tolerances for `track` and `OffsetFree`.

A tracking law is a further backward pass that minimises deviations from a plan instead of its cost. With z = (e, a, d)
as in `plan_model.py` and u the deviation of the command, it minimises

    sum_t  e' (Q + E_t) e + (u + M_t d)' R (u + M_t d)  +  e_T' (Q_T + E_T) e_T.

E_t is the emphasis on deviations that lead to a collision; see `Surroundings.emphasis`. M_t d is the control that
cancels the unknowns' effect on the next state as far as controls can. It costs nothing; otherwise a steady disturbance
would leave a steady error. For the same reason a law assumes that the current disturbance continues: a law that expects
a wind to abate yields to one that does not.

If commands get lost, the law minimises the expected sum over the losses (Schenato 2009: LQG with a hold). When a
command is lost, the previous one is held. It may be large, which makes the law gentle. The effort of a lost command
does not count.

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
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from lqrsim.annotations import Positive, checked
from lqrsim.control.controllers import Feedback, check_plan
from lqrsim.control.plan_model import KalmanFilter, PlanDerivatives, PlanModel, recursions
from lqrsim.control.prediction import DeviationNorm, LinearLoop, Surroundings, sample_loop, with_filter
from lqrsim.control.uncertainty import Uncertainty, per_entry
from lqrsim.errors import Array, InputError, check_kind, check_number
from lqrsim.kernels.records import LoopMoments, PassArrays, PassSizes, PassWork
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import PerEntry
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution
from lqrsim.solvers.compiled import policy_about, rollout

CONTROL_SHARE = 0.25  # default of the largest change of a control, relative to the range between its limits
# The tolerances of the position at the plan's end, relative to those before. Reaching a goal depends on the position
# alone; controls that also bring the velocity to rest there have less effort left for it.
AT_END = 0.1
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
# not if the model gets farther from the plan than FARTHEST times the widest part of the tube. The same counts for the
# trials with unknowns that are drawn, which are run if more than LIMITED of the commands are beyond the limits.
KNOTS, PAIRS, FARTHEST = 3, 3, 6.0
TRIALS, LIMITED = 100, 1e-3
WORST = (1.0, 1e30, 1.0)  # the `Predictions` for a loop whose moments are not finite
OPEN = Surroundings((), (), (), 0.0)


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of deviations from a plan: a deviation that is just tolerated costs 1."""

    state: Array  # the diagonal of Q, (n,); or C diagonals to compare, (C, n)
    control: Array  # the diagonal of R, (m,)
    end: Array  # the diagonal of Q_T, (n,) or (C, n)
    emphasis: Array | None = None  # E, further weights at each knot, (T+1, n, n) or (C, T+1, n, n); None for none

    @classmethod
    @checked
    def of(cls, tolerate: PerEntry, effort: Array, dynamics: Dynamics, *, at_end: Positive = AT_END) -> "Weights":
        """The weights for tolerances in the states' units and efforts (m,); `at_end` as in `track`."""
        space = dynamics.state_coordinates
        state = per_entry("tolerate", tolerate, space, above=0.0)
        end, last = state.copy(), list(space.position) or slice(None)
        end[last] *= at_end
        return cls(state**-2.0, effort**-2.0, end**-2.0)


class DeviationLaw(NamedTuple):
    """A law u = gain z + offset in deviations from a plan, or C laws to compare, with their weights."""

    gain: Array  # (T, m, Z), or (C, T, m, Z)
    offset: Array  # (T, m), or (C, T, m)
    weights: Weights

    def pick(self, i: int) -> "DeviationLaw":
        """One of C laws."""
        weights = self.weights
        emphasis = None if weights.emphasis is None else weights.emphasis[i]
        picked = Weights(weights.state[i], weights.control, weights.end[i], emphasis)
        return DeviationLaw(self.gain[i], self.offset[i], picked)


def effort_of(effort: PerEntry | None, dynamics: Dynamics) -> Array:
    """Return the tolerated effort of each control, (m,); by default a fraction of its range."""
    controls = dynamics.control_coordinates
    if effort is not None:
        return per_entry("effort", effort, controls, above=0.0)
    ranges = np.subtract(controls.high, controls.low)
    for name, size in zip(controls.labels, ranges, strict=True):
        if not np.isfinite(size):
            raise InputError(f"effort: got none, and {name} has no limits to derive it from, want effort= in its unit")
    return CONTROL_SHARE * ranges


def tracking_law(model: PlanModel, weights: Weights, noise: Array | None = None, risk: float = 0.0) -> DeviationLaw:
    """The law for these weights, or the laws for C of them.

    With noise on the states, M (T, n, k), a law is averse to large deviations; the risk is theta, for half the sum that
    it minimises. Raises LinAlgError if the risk is too high.

    The cost-to-go 1/2 y' S y + y' (D d + s) of y = (e, a) is a quadratic of (y, d, 1, u) at the previous knot. The cost
    of d alone does not change the law.
    """
    n, m, steps, lost = model.n, model.m, model.plan.steps, model.uncertainty.command_loss
    movable, width = n + model.lagging, model.size + 1  # the states that controls can move, and numbers of (y, d, 1)
    state, end = np.atleast_2d(weights.state), np.atleast_2d(weights.end)
    # (y', d, 1) of (y, d, 1, u): the law assumes that d goes on as it is.
    (F, G, c), forward = model.step_with(model.arrived), np.zeros((steps, width, width + m))
    forward[:, :movable] = np.concatenate([F, c[:, :, None], G], axis=2)[:, :movable]
    forward[:, range(movable, width), range(movable, width)] = 1.0
    adjoint = np.concatenate([F[:, :movable, :movable], G[:, :movable]], axis=2).transpose(0, 2, 1)
    held = np.zeros((steps, m, width))
    if lost:  # a lost command is that in force, which is a
        held[:, range(m), range(n, movable)], held[:, :, -1] = 1.0, model.reached[:-1] - model.plan.controls
    compensation = np.zeros((steps, len(state), m, width))
    # M_t, (C, T, m, D), by Q.
    B = model.derivatives.jacobian[:, :, n:]
    weighed = B.transpose(0, 2, 1) * state[:, None, None, :]
    curve = weighed @ B
    efforts = np.sqrt(weights.control.min() / weights.control)  # the units in which all controls are alike
    least = 1e-9 * np.vecdot(np.diagonal(curve, axis1=-2, axis2=-1), efforts**2) + 1e-300
    cancelling = np.linalg.inv(curve + least[..., None, None] * np.diag(efforts**-2)) @ (weighed @ F[:, :n, movable:])
    compensation[..., movable:-1] = weights.control[:, None] * cancelling.swapaxes(0, 1)
    cost, products = np.zeros((len(state), movable, width)), np.empty((len(state), movable + m, width + m))
    cost[:, range(n), range(n)] = end
    emphasis = None if weights.emphasis is None else weights.emphasis.reshape(len(state), steps + 1, n, n)
    if emphasis is not None:
        cost[:, :n, :n] += emphasis[:, steps]
    stage = np.zeros((len(state), movable))
    stage[:, :n] = state
    sizes, laws = PassSizes(len(state), movable, model.size, m, lost), np.empty(compensation.shape)
    arrays = PassArrays(weights.control, stage.ravel(), compensation.ravel(), held.ravel(), laws.ravel())
    work = PassWork(cost.ravel(), products.ravel(), np.empty(len(state) * m * m), np.empty(m * width))
    improve = recursions().lay_out("improve", 0, sizes, arrays, work)
    for t in range(steps - 1, -1, -1):
        if noise is not None:  # under the worst of it, the Hessian is S + S Y S, and the gradient s + S Y s
            S, M = cost[0, :, :movable], np.zeros((movable, noise.shape[2]))
            M[:n] = noise[t]
            inner = np.eye(M.shape[1]) - risk * M.T @ S @ M
            np.linalg.cholesky(inner)
            spread = risk * S @ M @ np.linalg.solve(inner, M.T)
            cost[0, :, :movable], cost[0, :, -1] = S + spread @ S, cost[0, :, -1] + spread @ cost[0, :, -1]
        np.matmul(adjoint[t], cost @ forward[t], out=products)
        improve(t, sizes, arrays, work)
        if emphasis is not None:
            cost[:, :n, :n] += emphasis[:, t]
    laws = laws.swapaxes(0, 1) if weights.state.ndim == 2 else laws[:, 0]
    return DeviationLaw(laws[..., :-1], laws[..., -1], weights)


class Predictions(NamedTuple):
    """Predictions for laws: chance of failure, mean width of the tube, fraction of commands beyond the limits."""

    chance: Array
    width: Array
    saturation: Array

    def scores(self, least: float) -> Array:
        """What a choice of laws minimises: chance of failure, and terms for saturation and tubes wider than `least`."""
        return self.chance + FRAGILE * self.saturation**2 + NARROW * np.maximum(self.width / least, 1.0)


@dataclass(frozen=True, eq=False)
class Judge:
    """Judges laws about the plan of a solution, by the moments of their states and by runs, in a true system.

    With a filter, the true system is as it assumes, and the laws act on its estimates, else on the measured states.
    """

    problem: Problem
    solution: Solution
    truth: PlanModel
    filter: KalmanFilter | None = None

    @cached_property
    def surroundings(self) -> Surroundings:
        return Surroundings.of(self.problem, self.truth.uncertainty.obstacles)

    @cached_property
    def norm(self) -> DeviationNorm:
        return DeviationNorm.of(self.solution, self.problem.dynamics.state_coordinates.position)

    @property
    def limits(self) -> tuple[Array, Array]:
        return self.solution.policy.control_coordinates.limits

    def moments(self, laws: DeviationLaw) -> LoopMoments:
        """The moments of the states under C laws, (C, ...)."""
        n = self.truth.n
        with np.errstate(over="ignore", invalid="ignore"):  # loops that are not stable
            if self.filter is not None:
                return with_filter(self.truth, self.filter, laws.gain, laws.offset, self.limits)
            return LinearLoop(self.truth, laws.gain[..., :n], laws.offset, None, self.limits).moments(n)

    def predictions(self, moments: LoopMoments) -> Predictions:
        """What follows from moments of the states, (..., T+1, n) and so on: the worst if they are not finite."""
        finite = np.isfinite(moments.covariance).all(axis=(-3, -2, -1))
        if not finite.all():
            moments = LoopMoments(*(moment.copy() for moment in moments))
            for moment in moments:
                moment[~finite] = 0.0
        mean, covariance, plan = moments.mean, moments.covariance, self.solution.trajectory
        collide = self.surroundings.spread(plan.states + mean, covariance, moments.across).chance()[1]
        width = np.sqrt((self.norm.squares(covariance) + self.norm(mean) ** 2).mean(axis=-1))
        miss = self._chance_of_miss(mean[..., -1, :], covariance[..., -1, :, :])
        values = collide + miss, width, moments.saturation.mean(axis=(-2, -1))
        return Predictions(*(np.where(finite, value, worst) for value, worst in zip(values, WORST, strict=True)))

    def _chance_of_miss(self, mean: Array, covariance: Array) -> Array:
        """About the chance to end farther from the plan's end than the goal's radius, by the moments there.

        Of a position it is that of its most uncertain direction. Without one, each state that counts has its own bound.
        """
        target, radius = self.solution.target, self.solution.goal_radius
        if place := target.places:
            if radius is None:
                return np.zeros(mean.shape[:-1])
            bounds, off = radius, np.linalg.norm(mean[..., place], axis=-1)
            variance = np.linalg.eigvalsh(covariance[..., place, :][..., place])[..., -1]
        else:
            bounds = (target.radius(None, None, None) if radius is None else radius) * target.scale
            off, variance = np.abs(mean), np.diagonal(covariance, axis1=-2, axis2=-1)
        std = np.maximum(np.sqrt(np.maximum(variance, 0.0)), 1e-12)
        outside = ndtr((off - bounds) / std) + ndtr((-off - bounds) / std)  # of normal numbers with these means
        return outside if place else 1 - np.prod(1 - outside[..., np.isfinite(target.state)], axis=-1)

    def narrowest(self, widths: Array) -> float:
        """The width of the narrowest tube; a thousandth of the plan's extent by the norm is narrow enough."""
        extents = np.ptp(self.solution.trajectory.states[:, self.norm.states], axis=0) / self.norm.scale
        return max(float(widths.min()), 1e-3 * (float(extents.max()) or 1.0))

    def strays(self, laws: DeviationLaw, moments: LoopMoments, i: int) -> int:
        """The number of runs under one of C laws that get too far from the plan, from likely deviations.

        The law acts on the true state, in the nonlinear model. If all of these return to the plan, and the law acts on
        measured states and often reaches the limits, trials with unknowns that are drawn count as well.
        """
        plan, rng, count = self.solution.trajectory, np.random.default_rng(0), 0
        mean, covariance = moments.mean[i], moments.covariance[i]
        farthest, n = FARTHEST * np.sqrt(self.norm.squares(covariance).max()), mean.shape[1]
        policy = _absolute_policy(self.solution, laws.pick(i))
        for t in (plan.steps * k // KNOTS for k in range(KNOTS)):
            variances, axes = np.linalg.eigh(covariance[t])
            off = rng.standard_normal((PAIRS, n)) * np.sqrt(np.maximum(variances, 0.0)) @ axes.T
            for start in plan.states[t] + mean[t] + np.concatenate([off, -off]):
                states, _ = rollout(self.problem, policy.gain[t:], policy.offset[t:], start)
                with np.errstate(over="ignore", invalid="ignore"):  # of runs that diverge
                    distance = self.norm(states - plan.states[t:])
                count += not (distance <= farthest).all()
        limited = moments.saturation[i].mean() > LIMITED
        if count or not limited or self.filter is not None or not self.truth.uncertainty.unknowns:
            return count
        run = Feedback(policy)
        return int((sample_loop(self.truth, run, self.limits, OPEN, self.norm, TRIALS, 0).farthest > farthest).sum())


def choose_tolerances(judge: Judge, model: PlanModel, effort: Array, at_end: float, *, call: str) -> DeviationLaw:
    """Choose the tolerances whose law is predicted to fail least often, and that law.

    Args:
      model: what the laws assume.
      call: name of the user's call, for warnings.
    """
    tried = tracking_law(model, tolerances_to_try(model, effort, at_end, judge.solution))
    moments = judge.moments(tried)
    predicted = judge.predictions(moments)
    least = judge.narrowest(predicted.width)
    scores = predicted.scores(least)
    strays = dict[int, int]()  # the number of runs that stray under each law
    for best in sorted(range(len(scores)), key=lambda i: (scores[i], -i)):  # of equals the gentlest first
        strays[best] = judge.strays(tried, moments, best)
        if not strays[best]:
            break
    else:
        best = min(strays, key=lambda i: strays[i])
        _log.warning(
            "%s: each law that was tried loses the plan from some deviations of the predicted size; the plan's own"
            " policy or tolerances of your own (tolerate=) may do better",
            call,
        )
    chosen = tried.pick(best)
    # The same with emphasis, if it is predicted to fail less often.
    if predicted.saturation[best] > MODELLED:
        return chosen
    mean, covariance, across = moments.mean[best], moments.covariance[best], moments.across[best]
    emphasis = judge.surroundings.emphasis(model.plan.states + mean, covariance, across, chosen.weights.state)
    if not emphasis.any():
        return chosen
    weights, many, factors = chosen.weights, np.ones((len(EMPHASIS), 1)), np.array(EMPHASIS)[:, None, None, None]
    emphasised = Weights(many * weights.state, weights.control, many * weights.end, factors * emphasis)
    stressed = tracking_law(model, emphasised)
    moments = judge.moments(stressed)
    stressed_scores = judge.predictions(moments).scores(least)
    i = int(np.argmin(stressed_scores))
    better = stressed_scores[i] < scores[best] and judge.strays(stressed, moments, i) <= strays[best]
    return stressed.pick(i) if better else chosen


def tolerances_to_try(model: PlanModel, effort: Array, at_end: float, solution: Solution) -> Weights:
    """Weights for each number of periods that a deviation may take to decay, the tightest first.

    If the goal leaves states free, the same with wide tolerances for these follow: a satellite that must take up an
    unplanned spin can only do so by other speeds of its wheels.
    """
    longest = max(model.plan.steps // 2, PERIODS[0])
    periods = [period for period in PERIODS if period <= longest]
    tried = list(model.derivatives.reach(effort, periods))
    if (free := np.isnan(solution.target.state)).any():
        tried += [np.where(free, WIDE * tolerances, tolerances) for tolerances in tried]
    choices = [Weights.of(tuple(tolerances.tolist()), effort, model.dynamics, at_end=at_end) for tolerances in tried]
    return Weights(
        np.array([choice.state for choice in choices]), choices[0].control, np.array([choice.end for choice in choices])
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
    derivatives = PlanDerivatives(dynamics, plan)
    model = PlanModel(derivatives, Uncertainty(command_loss=command_loss))
    efforts = effort_of(effort, dynamics)
    if tolerate is not None:
        law = _law(problem, solution, model, Weights.of(tolerate, efforts, dynamics, at_end=at_end), risk)
    elif uncertainty is None:
        raise InputError("track: tolerate: got none, want deviations, such as {'m': 0.05, 'm/s': 0.2}, or uncertainty=")
    else:
        judge = Judge(problem, solution, PlanModel(derivatives, uncertainty))
        law = choose_tolerances(judge, model, efforts, at_end, call="track(...)")
    return _absolute_policy(solution, law)


def _absolute_policy(solution: Solution, law: DeviationLaw) -> AffinePolicy:
    """The policy of a law about the solution's plan. The command in force has no effect on a command that arrives."""
    plan = solution.trajectory
    gain, offset = policy_about(plan.states, plan.controls + law.offset, law.gain[..., : plan.states.shape[1]])
    return replace(solution.policy, gain=gain, offset=offset, nominal=plan.states[:-1].copy(), dt=plan.dt)


def _law(problem: Problem, solution: Solution, model: PlanModel, weights: Weights, risk: float) -> DeviationLaw:
    """The law, with the risk if it is not 0. If the risk is too high, raises InputError with the largest possible."""
    if not risk or problem.noise is None:
        return tracking_law(model, weights)
    plan = solution.trajectory
    matrices = problem.noise.matrices(problem.dynamics, plan.states[:-1], plan.controls)

    def law_of(tried: float) -> DeviationLaw | None:
        try:
            return tracking_law(model, weights, matrices, tried)
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
