"""Affine laws for many trials at once, compiled: each trial gets what it gets alone, to the last bit.

`AffinePolicy` has the same law in NumPy, for a robot; its module's docstring says why there are two.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from lqrsim.codegen.jit import Core, compiling, in_c_order
from lqrsim.codegen.kernel_source import source_of
from lqrsim.errors import Array
from lqrsim.kernels import policy_evaluation
from lqrsim.results.coordinates import Coordinates


def evaluator(states: Coordinates, controls: Coordinates) -> Callable[..., Array]:
    """What evaluates laws: (shown (K, n), gain (m, n), offset (m,), nominal (n,)) -> controls (K, m).

    As `AffinePolicy.__call__`, but that each trial gets what it gets alone, to the last bit.
    """
    low, high = np.array(controls.low), np.array(controls.high)
    with compiling:
        core_of_laws = _policy_core(len(states), len(controls), states.angles, states.rotation_vectors)

    def evaluate(shown: Array, gain: Array, offset: Array, nominal: Array) -> Array:
        near, out = np.array(shown, dtype=np.float64), np.empty((len(shown), len(controls)))
        law = (in_c_order(part) for part in (gain, offset, nominal))
        core_of_laws.apply_law(len(shown), near, *law, low, high, out)
        return out

    return evaluate


def turn_to_nearest(space: Coordinates, states: Array, nominal: Array) -> None:
    """As `space.nearest`, compiled and in place: states (T+1, K, n), C-ordered, become those nearest to (T+1, n)."""
    with compiling:
        core_of_laws = _policy_core(len(space), 1, space.angles, space.rotation_vectors)
    core_of_laws.turn_all(len(states), states.shape[1], states.reshape(-1, len(space)), in_c_order(nominal))


@cache
def _policy_core(n: int, m: int, angles: tuple[int, ...], rotation_vectors: tuple[int, ...]) -> Core:
    own = source_of(policy_evaluation, "apply_law", "turn_all")
    source = f"{turn_source(angles, rotation_vectors)}\n{own}"
    return Core(source, {"N": n, "M": m}, f"policies of {n} states and {m} controls")


def turn_source(angles: tuple[int, ...], rotation_vectors: tuple[int, ...]) -> str:
    """Source of `turn` of `kernels/policy_evaluation.py`."""
    turns = [f"    nearest_angle(x, nominal, {i})" for i in angles]
    turns += [f"    nearest_rotation(x, nominal, {i})" for i in rotation_vectors]
    functions = source_of(policy_evaluation, "nearest_angle", "nearest_rotation")
    return "\n".join([functions, "def turn(x, nominal):", *(turns or ["    pass"])])
