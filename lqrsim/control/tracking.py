"""`track`: a policy that keeps a robot on a plan, whatever the plan was for."""

import numpy as np

from lqrsim.control.collision_chance import Surroundings
from lqrsim.control.loop_moments import Loop
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.tolerances import Prediction, choose_tolerances, prediction_of
from lqrsim.control.tracking_laws import AT_END, Averse, Weights, check_plan, effort_of, tracking_laws
from lqrsim.control.uncertainty import PerEntry, Uncertainty
from lqrsim.errors import Array, InputError, check_kind, check_number
from lqrsim.problem.problem import Problem
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution


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
    """The policy that keeps to a plan: least squares of the deviations from it.

    The policy of `smooth` is optimal for the problem's cost, which mostly does not mind being off the plan. This one is
    optimal for staying on it. `dataclasses.replace(solution, policy=track(...))` is a solution that is saved, run and
    drawn as any other.

    Args:
      problem: that was solved.
      solution: its solution, or any with a plan of the same system.
      tolerate: how far each state may be off, by unit or name: {"m": 0.05, "m/s": 0.2, "rad": 0.2, "rad/s": 0.2}. Only
        the ratios to one another and to `effort` matter. By default those under which the robot is least likely to fail
        under the uncertainty; see `tolerances.py`.
      effort: what may be added to each control to get back; by default a quarter of its range.
      at_end: the tolerances of the position at the plan's end, relative to before; of all states where there is none.
      uncertainty: what runs will meet, as `uncertainty_of` makes it; only for choosing tolerances.
      risk: theta: minimise (1/theta) log E exp(theta/2 the sum of squares) under the problem's noise, as that is along
        the plan; above 0 large deviations are dreaded. Tolerances must then be given.

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
    model = PlanModel.of(dynamics, plan, Uncertainty())
    efforts = effort_of(effort, dynamics)
    if tolerate is not None:
        weights = Weights.of(tolerate, efforts, dynamics, at_end=at_end)
    elif uncertainty is None:
        raise InputError(
            "track: tolerate: got none, want how far each state may be off, such as {'m': 0.05, 'm/s': 0.2}, or"
            " uncertainty=, from which it is chosen"
        )
    else:
        check_kind("track: uncertainty", uncertainty, Uncertainty, "an Uncertainty, such as uncertainty_of(...)")
        truth = PlanModel.of(dynamics, plan, uncertainty)
        space = solution.policy.control_coordinates
        limits = np.array(space.low), np.array(space.high)
        surroundings = Surroundings.of(problem, uncertainty.obstacles)

        def predicted(tried: Weights) -> list[Prediction]:
            moments, n = Loop(truth, *tracking_laws(model, tried), None, *limits).moments(), model.n
            saturation = moments.saturation.mean(axis=(1, 2)).tolist()
            return [
                prediction_of(
                    truth, moments.mean[i, :, :n], moments.covariance[i, :, :n, :n], moments.across[i],
                    saturation[i], surroundings, solution.goal_radius,
                )
                for i in range(len(saturation))
            ]  # fmt: skip

        weights = choose_tolerances(model, predicted, efforts, at_end).weights
    gain, offset = _laws(problem, solution, model, weights, risk)
    return AffinePolicy(
        gain=gain,
        offset=plan.controls + offset - np.einsum("tij,tj->ti", gain, plan.states[:-1]),
        nominal=plan.states[:-1],
        dt=plan.dt,
        state_coordinates=dynamics.state_coordinates,
        control_coordinates=solution.policy.control_coordinates,
    )


def _laws(problem: Problem, solution: Solution, model: PlanModel, weights: Weights, risk: float) -> tuple[Array, Array]:
    """The laws with a risk, if there is one. Raises InputError where it is too high, and says what is not."""
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
        f"track: risk: got {risk:g}, want at most {low * (1 - 1e-5):.5g}: with more there is no expectation"
    )
