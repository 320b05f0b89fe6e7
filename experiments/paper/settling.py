"""How fast the interior point settles: its last steps, without a barrier, are Newton's on the optimality conditions.

Smoothing and Newton's method without constraints are measured by their costs, in `rates.py`. Next to an optimum with
constraints a cost says little, for a plan may be cheaper that misses them; here the error is that of the plan itself.
"""

from collections.abc import Iterator

import numpy as np
from league.problems import FAMILIES, Start
from numpy.random import Generator

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.kernels.records import Motion
from lqrsim.solvers.stages import ActiveSet, Barrier, InteriorPoint, InteriorResult, Measures, Stages
from paper.common import numbers

ASIDE = (1e-2, 1e-3, 1e-4)  # of what states and controls change by: how far from the optimum it settles from, in turn
NEAR = 0.01  # the first barrier parameter and slacks, as the strategy begins near an answer
MOST = 100  # iterations with the barrier
CLOSE, ROUNDING = 0.1, 1e-11  # relative to what changes: errors that say something of the order
FEWEST = 3  # of these, for an order


def errors(problem: ls.Problem, solution: ls.Solution, rng: Generator) -> Array:
    """Errors of the plan (K,) from step to step: the largest of a control, relative to what that changes by.

    From as far beside the optimum as leads back to it; empty if nothing does.
    """
    stages, plan = Stages(problem), Motion(solution.trajectory.states, solution.trajectory.controls)
    found = InteriorPoint(stages, plan, Barrier(NEAR, NEAR)).run(tolerance=1e-8, violation=1e-6, most=MOST)
    best, (of_states, of_controls, *_) = found.plan, found.sizes
    if not found.solved:
        return np.array([])
    inside = (best.controls > stages.low) & (best.controls < stages.high)
    shifts = [rng.uniform(-1, 1, part.shape) for part in best]
    shifts[0][0] = 0.0  # the start is given
    for aside in ASIDE:
        states = best.states + aside * of_states * shifts[0]
        controls = best.controls + aside * of_controls * inside * shifts[1]
        steps = settle(stages, Motion(states, controls), found)
        if steps and _apart(steps[-1], best, of_controls) < 1e-6:
            return np.array([_apart(one, steps[-1], of_controls) for one in steps[:-1]])
    return np.array([])


def settle(stages: Stages, plan: Motion, found: InteriorResult) -> list[Motion]:
    """The plan, and those after each step from there with the multipliers of the optimum; nothing is good enough."""
    plans = [plan]
    with np.errstate(all="ignore"):
        active = ActiveSet(stages, plan, found.multipliers, 1e-6)
        active.held[(stages.owners == -1) & (stages.values(found.plan) <= 0) & stages.live] = 1.0

        def watch(measures: Measures) -> bool:
            plans.append(Motion(*map(np.copy, active.plan)))
            return False

        active.run(0.0, watch, lambda seconds: False)
    return plans


def problems(planar: int) -> Iterator[tuple[str, ls.Problem, Start | None]]:
    """Name, problem, and what a solve begins with: of Altro.jl's, then of the planar quadrotor with a clearance."""
    for name in ("pendulum", "cartpole", "acrobot", "parallel_park", "three_obstacles"):
        yield name, *FAMILIES[name].make(0)
    for seed in range(planar):
        yield f"planar quadrotor {seed}", FAMILIES["planar"].make(seed)[0], None


def measure(planar: int) -> dict[str, float | None]:
    """The order of each problem's errors; None where too few of them say something of it."""
    found: dict[str, float | None] = {}
    for name, problem, start in problems(planar):
        solution, rng = ls.smooth(problem, start=start), np.random.default_rng(0)
        each = errors(problem, solution, rng) if solution.success else np.array([])
        found[name] = numbers([order(each)])[0]
    return found


def _apart(one: Motion, other: Motion, size: Array) -> float:
    return float((np.abs(one.controls - other.controls) / size).max())


def order(found: Array) -> float:
    """p of `e[k+1] = C e[k]^p`, by least squares over errors that say something of it; NaN where these are too few."""
    far = np.flatnonzero(~(found < CLOSE))
    found = found[far[-1] + 1 :] if len(far) else found
    lost = np.flatnonzero(~(found > ROUNDING))
    left = np.log(found[: lost[0]] if len(lost) else found)
    return float(np.polyfit(left[:-1], left[1:], 1)[0]) if len(left) >= FEWEST else np.nan
