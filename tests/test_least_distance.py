"""Non-negative least squares: the conditions of an optimum, and those of the shortest vector that satisfies rows."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from sampling import examples
from scipy.optimize import linprog

from lqrsim.errors import Array
from lqrsim.scenes.mjcf_holding import least_distance, nonnegative_least_squares


def drawn(seed: int) -> tuple[Array, Array]:
    """Rows of length 1 with few directions, as of symmetric robots, and numbers that some of them exceed."""
    rng = np.random.default_rng(seed)
    size, count = int(rng.integers(2, 9)), int(rng.integers(2, 41))
    rows = rng.integers(-1, 2, size=(count, size)) * (rng.random((count, size)) < rng.uniform(0.1, 0.7))
    rows[0, 0] = 1
    rows = rows[rows.any(axis=1)] / np.linalg.norm(rows[rows.any(axis=1)], axis=1)[:, None]
    return rows, np.append(1.0, rng.integers(-3, 4, size=len(rows) - 1))


# At these SciPy's `nnls` ended elsewhere.
@example(seed=2791, scale=-6)
@example(seed=4066, scale=-6)
@example(seed=6840, scale=3)
@example(seed=11748, scale=-3)
@settings(max_examples=examples(200))
@given(seed=st.integers(0, 2**32 - 1), scale=st.integers(-6, 4))
def test_no_entry_can_be_better(seed: int, scale: int) -> None:
    """KKT conditions: a slope is zero where x is above zero, and not negative where it is zero."""
    rows, least = drawn(seed)
    matrix, target = np.vstack([rows.T, 10.0**scale * least]), np.append(np.zeros(rows.shape[1]), 1.0)
    x = nonnegative_least_squares(matrix, target)
    slopes = (matrix @ x - target) @ matrix / np.linalg.norm(matrix, axis=0)
    assert (x >= 0).all()
    assert slopes.min() > -1e-8
    assert np.abs(slopes[x > 0]).max(initial=0.0) < 1e-8


@settings(max_examples=examples(100))
@given(seed=st.integers(0, 2**32 - 1))
def test_the_shortest_vector_is_a_sum_of_rows_that_it_just_satisfies(seed: int) -> None:
    rows, least = drawn(seed)
    residual, forces = least_distance(rows, least)
    feasible = linprog(np.zeros(rows.shape[1]), -rows, -least, bounds=(None, None)).status == 0
    assert feasible == (abs(residual[-1]) > 1e-9)
    if feasible:
        y, multipliers = -residual[:-1] / residual[-1], -forces / residual[-1]
        size = np.abs(y).max()
        assert (rows @ y >= least - 1e-9 * size).all()
        assert (multipliers >= 0).all()
        np.testing.assert_allclose(multipliers @ rows, y, rtol=0, atol=1e-9 * size)
        assert np.abs(multipliers * (rows @ y - least)).max() < 1e-9 * size**2
