"""Affine laws for many trials at once, compiled: each trial gets what it gets alone, to the last bit.

`AffinePolicy` has the same law in NumPy, for a robot; its module's docstring says why there are two.
"""

from collections.abc import Callable

import numpy as np

from lqrsim.codegen.compiled_module import CompiledModule, in_c_order, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels import policy_evaluation
from lqrsim.kernels.records import AngularStates, Limits, Policy
from lqrsim.results.coordinates import Coordinates


def evaluator(states: Coordinates, controls: Coordinates) -> Callable[..., Array]:
    """What evaluates laws: (shown (K, n), gain (m, n), offset (m,), nominal (n,)) -> controls (K, m).

    As `AffinePolicy.__call__`, but that each trial gets what it gets alone, to the last bit.
    """
    limits, turning = Limits(np.array(controls.low), np.array(controls.high)), turning_of(states)
    laws = _laws(len(states), len(controls))

    def evaluate(shown: Array, gain: Array, offset: Array, nominal: Array) -> Array:
        near, out = np.array(shown, dtype=np.float64), np.empty((len(shown), len(controls)))
        law = Policy(in_c_order(gain), in_c_order(offset))
        laws.apply_policy(len(shown), near, law, in_c_order(nominal), turning, limits, out)
        return out

    return evaluate


def turn_to_nearest(space: Coordinates, states: Array, nominal: Array) -> None:
    """As `space.nearest`, compiled and in place: states (T+1, K, n), C-ordered, become those nearest to (T+1, n)."""
    flat, turning = states.reshape(-1, len(space)), turning_of(space)
    _laws(len(space), 1).all_to_nearest(len(states), states.shape[1], flat, in_c_order(nominal), turning)


def _laws(n: int, m: int) -> CompiledModule:
    return module_of(source_of(policy_evaluation), f"policies of {n} states and {m} controls", N=n, M=m, W=n + m)


def turning_of(space: Coordinates) -> AngularStates:
    """Which states are to be turned to the nearest, as `kernels/policy_evaluation.py` takes it."""
    angles, rotations = (np.array(one, dtype=np.float64) for one in (space.angles, space.rotation_vectors))
    return AngularStates(angles, len(angles), rotations, len(rotations))
