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
from lqrsim.solvers.engine import SolveRun
from lqrsim.solvers.settings import SmootherSettings, resolve

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
    start, flat, costs = solution.trajectory.states[0].copy(), draws.reshape(-1, size), np.empty(trials)
    module, model = compiled.noise_module(problem, problem.noise_term), compiled.compile_problem(problem)
    module.noisy_costs(trials, problem.steps, start, policy, model, flat, costs)
    return costs


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
    return run.largest_risk(high)
