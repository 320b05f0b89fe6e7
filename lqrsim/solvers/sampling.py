"""Costs of sampled runs under a problem's noise, for comparison with expected costs."""

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array, InputError, check_count, check_kind, check_memory, check_seed
from lqrsim.kernels.records import Policy
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution
from lqrsim.solvers import compiled
from lqrsim.solvers.settings import check_problem

MOST_TRIALS = 10_000_000


def sample_costs(problem: Problem, solution: Solution, *, trials: int = 1000, seed: int = 0) -> Array:
    """Costs of simulated runs of a solution's policy from the first state of its plan, with noise drawn at random.

    The robot moves by the formulas of the problem, x' = g(x, u) + M(x, u) w, not in MuJoCo, and obstacles do not stop
    it. The same seed draws the same noise for any solution, so that costs of two solutions can be compared trial by
    trial.

    Args:
      problem: a problem with noise.
      solution: a solution of that problem, or of another with as many states, controls and steps.
      trials: number of runs K.
      seed: seed of the noise.

    Returns:
      The costs, (K,).

    Raises:
      InputError: the problem has no noise, the solution does not fit it, or an argument is not as described.
    """
    check_problem(problem)
    if problem.noise_term is None:
        raise InputError("problem: got a problem without noise, want Problem(noise=...), or problem.driven_by(noise)")
    check_kind("solution", solution, Solution, "a Solution, such as smooth(problem)")
    shape = problem.steps, len(problem.control_coordinates), len(problem.dynamics.state_coordinates)
    if solution.policy.gain.shape != shape:
        got = solution.policy.gain.shape
        raise InputError(f"solution: got a policy of shape {got}, want {shape}: steps, controls, states")
    trials = check_count("trials", trials, at_most=MOST_TRIALS)
    seed, size = check_seed("seed", seed), problem.noise_term.size
    check_memory("trials", trials, 8 * (problem.steps * size + 1), "whose noise")
    draws = np.empty((trials, problem.steps, size))
    for trial in range(trials):
        stream = np.random.SeedSequence(seed, spawn_key=(trial,))
        draws[trial] = np.random.Generator(np.random.SFC64(stream)).standard_normal((problem.steps, size))
    policy = Policy(in_c_order(solution.policy.gain), in_c_order(solution.policy.offset))
    start = solution.trajectory.states[0].copy()
    return compiled.noisy_costs(problem, start, policy, draws)
