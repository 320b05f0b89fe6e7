"""The descent of `kernels/restoration.py`, in slices between which its caller is told."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lqrsim.codegen.user_functions import interrupt_of
from lqrsim.errors import Array
from lqrsim.kernels.declarations import NO_PROGRESS, NOT_FINITE, RUNNING
from lqrsim.kernels.records import RESTORED, Motion
from lqrsim.problem.derivative_check import functions_of
from lqrsim.solvers.budget import ATTENTION
from lqrsim.solvers.stages import Sizes, Stages


class Restored(NamedTuple):
    """A trajectory, and two facts about it."""

    plan: Motion
    stationary: bool  # whether its violation is
    near: bool  # whether it is nearly feasible


def restore(
    stages: Stages, plan: Motion, sizes: Sizes, *, price: float, most: int,
    watch: Callable[[float, float, float, float], bool], stationary: Callable[[Motion, list[Array]], bool],
    hurried: bool = True,
) -> Restored | None:  # fmt: skip
    """Descend from the rollout of a plan's controls (T, m); None if a trajectory is not finite, or there is no step.

    Args:
      price: of violating a constraint by its typical size, in units of the typical cost.
      watch: called with cost, violation, relative predicted decrease and seconds of each iteration; True ends it.
      stationary: called once the predicted decrease is negligible; returns whether the violation of a trajectory is
        stationary, which ends it. It gets each constraint's multipliers relative to the price, (T+1, rows), in -1 to 1.
      hurried: whether `watch` is to be called after each iteration, rather than after `ATTENTION` seconds.
    """
    work, memory = stages.restoration
    stages.resize(sizes)
    work.plan.states[...], work.plan.controls[...] = plan
    log, price = np.zeros(most, RESTORED), float(price * sizes.cost)
    functions = functions_of(stages.problem)

    def run(first: int, last: int) -> tuple[int, int]:
        return stages.call("restoration", first, last, price, stages.about, work, memory, log)

    run(0, 0)
    done, outcome, ended, at_minimum, size = 0, RUNNING, False, False, 1
    while outcome in (RUNNING, NO_PROGRESS) and not ended and done < most:
        first, clock = done, time.perf_counter()
        done, outcome = run(first, min(first + size, most))
        seconds = (time.perf_counter() - clock) / max(done - first, 1)
        for row in log[first:done].tolist():
            ended = watch(*row, seconds) or ended
        if error := interrupt_of(functions):
            raise error
        if outcome == NO_PROGRESS and not ended:
            shares = stages.by_constraint(work.relative_multipliers.reshape(stages.live.shape))
            at_minimum = ended = stationary(Motion(*map(np.copy, work.plan)), shares)
        if not hurried and not functions:
            size = max(1, int(ATTENTION / max(seconds, 1e-9)))
    if outcome == NOT_FINITE:
        return None
    return Restored(Motion(*map(np.copy, work.plan)), at_minimum, bool(memory["nearly_feasible"][0]))
