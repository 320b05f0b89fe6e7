"""Re-plans past obstacles: against conditions of first order worked out anew, and SciPy's SLSQP; see `point_mass.py`.

Those of other constraints are in `test_interior_point.py`.
"""

import numpy as np
import pytest
from point_mass import Oracle, balls, problem

import lqrsim as ls
from lqrsim.results.solution_parts import Status

START = problem(weight=1.0)


@pytest.fixture(scope="module")
def solution() -> ls.Solution:
    return ls.smooth(START)


@pytest.fixture(scope="module")
def solver() -> ls.PreparedSolver:
    return ls.prepare(START)


def changed(rng: np.random.Generator) -> ls.Problem:
    """Another goal, and other balls: how many, where, and how fast."""
    count = int(rng.integers(1, 4))
    places = np.column_stack(
        [rng.uniform(-1.2, 1.2, count), rng.uniform(-0.8, 0.8, count), rng.uniform(0.2, 0.5, count)]
    )
    world = balls(*map(tuple, places), velocity=tuple(rng.uniform(-0.2, 0.2, 2)))
    return problem(
        world, weight=rng.choice([0.0, 1.0]), goal=(2, rng.uniform(-0.5, 0.5), 0, 0), limit=rng.choice([8.0, 20.0])
    )


def is_optimal(oracle: Oracle, found: ls.Replan) -> None:
    """Slopes in the controls times their range to twice 1e-6 of the cost, for differences are exact to about 1e-8."""
    z = oracle.pack(found.trajectory)
    (values,), (press,) = oracle.spare(z), (one.values for one in found.multipliers)
    assert values.min() >= 0
    assert found.violation == 0
    assert (press >= 0).all()
    acts = press[len(press) - len(values) :]
    assert np.count_nonzero(press) == np.count_nonzero(acts)
    assert np.abs(acts * values).max(initial=0.0) < 1e-6 * found.cost
    cost = oracle.differences(oracle.cost, z)
    held = oracle.differences(lambda z: oracle.spare(z)[0].ravel(), z) @ acts.ravel()
    left, inside = (cost - held) * 2 * oracle.limit / found.cost, np.abs(z) < oracle.limit
    assert np.abs(left[inside]).max() < 2e-6
    assert (left * np.sign(z))[~inside].max(initial=0.0) < 2e-6


def test_drawn_re_plans_of_a_mass_are_optima(solution: ls.Solution, solver: ls.PreparedSolver) -> None:
    """From near the plan, whatever the goal and the balls; where the start is not hit, there is a plan."""
    converged, asked = 0, 0
    for number in range(30):
        rng = np.random.default_rng(number)
        of, step = changed(rng), int(rng.integers(0, 8))
        state = solution.trajectory.states[step] + 0.05 * rng.normal(size=4)
        oracle = Oracle(of.from_state(state))
        world = of.obstacle_costs[0].world
        if Oracle.distances(state[None], world).min() < 0.5:
            continue
        asked += 1
        found = solver.solve(state, solution.shifted(step), problem=of)
        if found.status is not Status.CONVERGED:
            continue
        converged += 1
        is_optimal(oracle, found)
        if number % 3 == 0:  # the same optimum, to what SLSQP's own tolerance leaves
            assert found.cost < oracle.least(oracle.pack(found.trajectory)) * (1 + 1e-5)
    assert asked >= 15
    assert converged >= 0.9 * asked


def test_one_after_the_other_they_take_few_steps(solution: ls.Solution, solver: ls.PreparedSolver) -> None:
    """As a robot does that is pushed about: each begins with the answer before."""
    rng, before, taken = np.random.default_rng(1), solution, []
    for _ in range(12):
        start = before.shifted(1, horizon="moving")
        state = start.trajectory.states[0] + 0.01 * rng.normal(size=4)
        found = solver.solve(state, start)
        assert found.status is Status.CONVERGED, found.detail
        is_optimal(Oracle(START.from_state(state)), found)
        taken.append(found.iterations)
        before = found
    assert np.median(taken) <= 4
