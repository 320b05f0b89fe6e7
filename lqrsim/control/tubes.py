"""Tubes: the covariance of a closed loop's deviation from its plan, and its chance of collision.

LQG-MP (van den Berg, Abbeel and Goldberg 2011): with the linear model about the plan, the true state and the estimate
are jointly Gaussian, and their distribution is known before any run. The chance of collision follows from these
moments, unless trials of the nonlinear model refute it; `prediction.py` has both. In belief space the filter is part of
the plan, and its moments are the tube's.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from scipy.special import ndtr

from lqrsim.annotations import Share, checked, repr_of
from lqrsim.control.controllers import BeliefFeedback, ControllerLike, Feedback, check_plan
from lqrsim.control.offset_free import OffsetFree
from lqrsim.control.plan_model import PlanDerivatives, PlanModel
from lqrsim.control.prediction import DeviationNorm, LinearLoop, Surroundings, sample_loop
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import Array, InputError, check_count, check_kind, check_seed
from lqrsim.problem.belief import Belief
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory

# The default number of trials: such that all z at all steps are NUMBERS numbers, within these limits.
NUMBERS, FEWEST_TRIALS, MOST_TRIALS = 15_000_000, 4000, 20_000
STRAY = 6.0  # largest standard deviations of the position, over directions and knots


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Tube:
    """Predicted distribution of the closed loop about its plan.

    Attributes:
      mean: mean of the deviation of the state, (T+1, n).
      covariance: covariance of that deviation, (T+1, n, n).
      across: covariance of the deviation with the deviation at the previous knot, (T, n, n).
      estimate_covariance: covariance of the error of the estimate, before each measurement, (T+1, n, n); None without a
        filter.
      command: standard deviation of each command, before it is limited, (T, m).
      saturation: fraction of the commands that are beyond the limits, (T, m).
      step_chance: the chance of being in collision at each knot by these moments, (T+1,); bounded by the sum over
        obstacles.
      linear_chance: chance of colliding at all, by these moments.
      collision_chance: chance of colliding at all, by moments and sampled trials: the fraction of trials that collide,
        if it refutes the moments' chance, else both combined.
      strays: fraction of the trials that get farther from the plan than six of the position's largest standard
        deviations; without a position, of the states of the goal, each divided by its range over the plan. The moments
        do not describe them. None without trials.
    """

    _want = "a Tube, such as predict_tube(...) returns"

    plan: Trajectory
    state_coordinates: Annotated[Coordinates, "n"]
    mean: Annotated[Array, "T+1 n"]
    covariance: Annotated[Array, "T+1 n n"]
    across: Annotated[Array, "T n n"]
    estimate_covariance: Annotated[Array, "T+1 n n"] | None
    command: Annotated[Array, "T m"]
    saturation: Annotated[Array, "T m"]
    step_chance: Annotated[Array, "T+1"]
    linear_chance: Share
    collision_chance: Share
    samples: int = 0
    strays: Share | None = None

    __repr__ = repr_of

    @cached_property
    def position_covariance(self) -> Array:
        """Covariance of the position, (T+1, 2 or 3, 2 or 3)."""
        place = list(self.state_coordinates.position)
        return self.covariance[:, place][:, :, place]

    @checked
    def added_to(self, rollout: Rollout) -> Rollout:
        """The rollout with the covariance of the position and the chance of collision, for its figures and videos."""
        if not self.state_coordinates.position:
            raise InputError("Tube: state_coordinates.position: got none, want the 2 or 3 states that are the position")
        if not np.array_equal(rollout.plan.states, self.plan.states):
            raise InputError("rollout: got a run of another plan, want a run of the tube's plan")
        return replace(rollout, tube=self.position_covariance, collision_chance=self.step_chance)


def predict_tube(
    problem: Problem,
    solution: Solution,
    uncertainty: Uncertainty | None = None,
    controller: ControllerLike | None = None,
    *,
    samples: int | None = None,
    seed: int = 0,
) -> Tube:
    """Predict the distribution of a run about its plan, and its chance of collision.

    Args:
      uncertainty: the uncertainty in a run. With a latency or a delay, mean and covariance are computed from the
        samples that stay finite. None for a problem of a Belief, which states noise and readings itself.
      controller: an OffsetFree of this solution or an AffinePolicy; by default the solution's policy. It may have been
        designed for another uncertainty. In belief space the solution's BeliefFeedback.
      samples: number of trials with the nonlinear model, for the chance of collision. By default 4000, more for short
        plans of small systems, up to 20,000; none without obstacles, with dynamics that are stepped by MuJoCo or
        written in plain Python, with distances by MuJoCo, and in belief space.
    """
    check_plan("predict_tube", problem, solution)
    if isinstance(problem.dynamics, Belief):
        if uncertainty is not None or samples or not isinstance(controller, BeliefFeedback | None):
            raise InputError("predict_tube: got uncertainty, samples or another controller in belief space, want none")
        return _tube_of_belief(problem.dynamics, problem, solution if controller is None else controller.solution)
    wanted = "an Uncertainty, such as uncertainty_of(...)"
    check_kind("predict_tube: uncertainty", uncertainty, Uncertainty, wanted)
    assert uncertainty is not None
    check_count("predict_tube: samples", 0 if samples is None else samples, at_least=0, at_most=40_000)
    check_seed("predict_tube: seed", seed)
    plan = solution.trajectory
    if isinstance(controller, OffsetFree):
        other = controller.solution.trajectory
        if not (np.array_equal(other.states, plan.states) and np.array_equal(other.controls, plan.controls)):
            raise InputError("predict_tube: controller: got an OffsetFree of another plan, want one of the solution")
        loop, law = controller.loop(uncertainty), controller
    else:
        chosen: object = solution.policy if controller is None else controller
        policy = check_kind("predict_tube: controller", chosen, AffinePolicy, "an OffsetFree or an AffinePolicy")
        model = PlanModel(PlanDerivatives(problem.dynamics, plan), uncertainty)
        at_plan = policy.state_coordinates.nearest(plan.states[:-1], policy.nominal)
        offset = np.einsum("tij,tj->ti", policy.gain, at_plan) + policy.offset - plan.controls
        loop = LinearLoop(model, policy.gain, offset, None, policy.control_coordinates.limits)
        law = Feedback(policy)
    surroundings, modelled = Surroundings.of(problem, uncertainty.obstacles), loop.model.uncertainty
    norm = DeviationNorm.of(solution, problem.dynamics.state_coordinates.position)
    late = [f"{field} of {getattr(modelled, field)}" for field in ("latency", "delay") if getattr(modelled, field)]
    if samples is None:
        slow = problem.dynamics.by_mujoco or problem.dynamics.level in ("jax", "plain") or surroundings.by_mujoco
        affordable = min(max(NUMBERS // (plan.steps * loop.model.size), FEWEST_TRIALS), MOST_TRIALS)
        samples = 0 if slow or not (surroundings.kept or late) else affordable
    if samples and surroundings.by_mujoco:
        raise InputError(f"predict_tube: samples: got {samples} for distances by MuJoCo, want 0: trials lack them")
    if late and not samples:
        late_by = " and a ".join(late)
        raise InputError(f"predict_tube: samples: got 0, want more: moments leave out a {late_by} control periods")
    trials = sample_loop(loop.model, law, loop.limits, surroundings, norm, samples, seed) if samples else None
    moments, estimate = trials.moments if late and trials else loop.moments(), None
    model, n = loop.model, loop.model.n
    if not late and loop.filter_gain is not None:
        joint, guess = moments.covariance, slice(n + model.lagging, 2 * n + model.lagging)
        both = joint[:, :n, guess]
        estimate = joint[:, :n, :n] + joint[:, guess, guess] - both - both.transpose(0, 2, 1)
    mean, covariance, across = moments.mean[:, :n], moments.covariance[:, :n, :n], moments.across[:, :n, :n]
    chance, linear = surroundings.spread(plan.states + mean, covariance, across).chance()
    strays = None
    if trials is not None:
        scaled = covariance[:, norm.states][:, :, norm.states] / np.outer(norm.scale, norm.scale)
        widest = np.sqrt(max(np.linalg.eigvalsh(scaled).max(), 0.0))
        strays = float((trials.farthest > STRAY * widest).mean())
    return Tube(
        plan=model.plan, state_coordinates=model.dynamics.state_coordinates, mean=mean, covariance=covariance,
        across=across, estimate_covariance=estimate, command=moments.command, saturation=moments.saturation,
        step_chance=chance, linear_chance=float(linear), strays=strays,
        collision_chance=float(linear) if trials is None else trials.chance(float(linear)),
        samples=0 if trials is None else len(trials.collided),
    )  # fmt: skip


def _tube_of_belief(belief: Belief, problem: Problem, solution: Solution) -> Tube:
    """The mean strays as readings move it, and the state from the mean by what the filter does not know.

    To first order the two are independent.
    """
    n, plan, policy = belief.size, solution.trajectory, solution.policy
    knots = zip(plan.states[:-1], plan.controls, strict=True)
    A, B = map(np.array, zip(*(belief.linearize(x, u, plan.dt)[:2] for x, u in knots), strict=True))
    closed, known = A + B @ policy.gain, belief.covariance(plan.states)
    pushed = belief.innovations.matrices(belief, plan.states[:-1], plan.controls)
    pushed = pushed @ pushed.swapaxes(1, 2)
    strayed = np.zeros((plan.steps + 1, *A.shape[1:]))
    for t in range(plan.steps):
        strayed[t + 1] = closed[t] @ strayed[t] @ closed[t].T + pushed[t]
    covariance = strayed[:, :n, :n] + known
    across = closed[:, :n] @ strayed[:-1, :, :n] + A[:, :n, :n] @ known[:-1]
    command = np.sqrt(np.vecdot(policy.gain @ strayed[:-1], policy.gain))
    space, scale = policy.control_coordinates, np.maximum(command, 1e-12)
    saturation = ndtr((space.low - plan.controls) / scale) + ndtr((plan.controls - space.high) / scale)
    chance, linear = Surroundings.of(problem, 0.0).spread(plan.states, covariance, across).chance()
    return Tube(
        plan=Trajectory(plan.states[:, :n], plan.controls, plan.dt), state_coordinates=belief.robot.state_coordinates,
        mean=np.zeros((plan.steps + 1, n)), covariance=covariance, across=across,
        estimate_covariance=known + np.concatenate([np.zeros((1, n, n)), pushed[:, :n, :n]]), command=command,
        saturation=saturation, step_chance=chance, linear_chance=float(linear), collision_chance=float(linear),
    )  # fmt: skip
