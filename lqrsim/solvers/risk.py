"""Costs under noise: of sampled runs; and the largest risk for which the expectation of exp(risk * cost) exists."""

from typing import Annotated

import numpy as np

from lqrsim.annotations import Bounds, Seed, checked
from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array, InputError, check_memory
from lqrsim.kernels.records import Motion, Policy
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution
from lqrsim.solvers import compiled
from lqrsim.solvers.budget import Budget
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.settings import SmootherSettings, resolve

DIGITS = 1e-12  # relative accuracy of the bisection
MOST_TRIALS = 10_000_000


@checked
def sample_costs(
    problem: Problem,
    solution: Solution,
    *,
    trials: Annotated[int, Bounds(at_least=1, at_most=MOST_TRIALS)] = 1000,
    seed: Seed = 0,
) -> Array:
    """Costs of simulated runs of a solution's policy from the first state of its plan, with noise drawn at random.

    The robot moves by the formulas of the problem, x' = g(x, u) + M(x, u) w, not in MuJoCo, and obstacles do not stop
    it. The same seed draws the same noise for any solution, so that costs of two solutions can be compared trial by
    trial.

    Args:
      solution: a solution of that problem, or of another with as many states, controls and steps.

    Returns:
      (K,) the costs.

    Raises:
      InputError: the problem has no noise, or the solution does not fit it.
    """
    if problem.noise_term is None:
        raise InputError("problem: got a problem without noise, want Problem(noise=...), or problem.driven_by(noise)")
    shape = problem.steps, len(problem.control_coordinates), len(problem.dynamics.state_coordinates)
    if solution.policy.gain.shape != shape:
        got = solution.policy.gain.shape
        raise InputError(f"solution: got a policy of shape {got}, want {shape}: steps, controls, states")
    size = problem.noise_term.size
    check_memory("trials", trials, 8 * (problem.steps * size + 1), "whose noise")
    draws = np.empty((trials, problem.steps, size))
    for trial in range(trials):
        stream = np.random.SeedSequence(seed, spawn_key=(trial,))
        draws[trial] = np.random.Generator(np.random.SFC64(stream)).standard_normal((problem.steps, size))
    policy = Policy(in_c_order(solution.policy.gain), in_c_order(solution.policy.offset))
    start = solution.trajectory.states[0].copy()
    return compiled.noisy_costs(problem, start, policy, draws)


@checked
def largest_risk(problem: Problem, solution: Solution) -> float:
    """The largest `risk` for which a backward pass about a solution's plan succeeds, found by bisection.

    For a linear-quadratic problem with noise that does not depend on the state, the plan does not matter.

    Args:
      problem: a problem with noise; its own risk does not count.

    Returns:
      The risk, in units of 1/cost; infinite if no risk is too high, as when the noise costs nothing.

    Raises:
      InputError: the problem has no noise, the solution is not of such a problem, or the pass fails even without risk.
    """
    if problem.noise is None:
        raise InputError("problem: got a problem without noise, want Problem(noise=...), or problem.driven_by(noise)")
    plan = solution.trajectory
    wanted = (problem.steps, len(problem.control_coordinates), len(problem.dynamics.state_coordinates))
    if (got := (*plan.controls.shape, plan.states.shape[1])) != wanted:
        raise InputError(f"solution: got a plan of {got} steps, controls and states, want {wanted}")
    settings = SmootherSettings(tolerance=1e-4, max_iterations=1, constraint_tolerance=1e-3)
    run = SolveRun(problem, settings, resolve(plan.controls, problem), plan.states[0].copy(), Budget(1))
    run.work.set_best(Motion(plan.states, plan.controls))
    if run.fails_at(0.0) >= 0:
        raise InputError("solution: got a plan about which no backward pass succeeds, want one that converged")
    high = 1e-6 / max(abs(solution.cost), 1e-100) if np.isfinite(solution.cost) else 1.0
    while run.fails_at(high) < 0:
        high *= 2
        if high > 1e200:
            return float("inf")
    return _bisect(run, high)


def name_risk(run: SolveRun, result: RunResult) -> str:
    """The detail of an answer whose risk was too high: at which step, and which risk is not, if that can be told."""
    work, risk, steps = run.work, run.problem.risk, run.problem.steps
    if not np.isfinite(work.cost):
        work.set_best(work.last)
    if not np.isfinite(work.best.states).all():
        return result.detail
    failed = run.fails_at(risk)
    if failed < 0 or run.fails_at(0.0) >= 0:
        return result.detail
    most = _bisect(run, risk) * (1 - 1e-5)  # so that even the rounded number works
    too_high = f"about the best plan a risk of {risk:g} is too high at step {failed} of {steps}"
    too_high += f", and at most {most:.5g} will do"
    return f"{too_high}; {result.detail}" if result.detail else too_high


def _bisect(run: SolveRun, high: float) -> float:
    """The largest risk with which a pass about the plan of a run does not fail, given one above it."""
    low = 0.0
    while high - low > DIGITS * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if run.fails_at(middle) < 0 else (low, middle)
    return low
