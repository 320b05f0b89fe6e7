"""Monte Carlo trials of a closed loop in a filter's nonlinear model, and the chance of collision by them.

The moments of `linear_loop.py` are valid for small deviations. A robot whose commands stay at their limits leaves its
plan, and far from the plan its dynamics are not those linearised there. These trials run the nonlinear dynamics without
MuJoCo, with limits, lag, delays, and lost commands and measurements. A seed draws the same numbers for all plans and
laws, so that two of them are compared on the same trials.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
from scipy.special import betaincinv

from lqrsim.control.collision_chance import Surroundings
from lqrsim.control.controllers import Controller, turn_to_nearest
from lqrsim.control.plan_model import Lag, PlanModel
from lqrsim.control.uncertainty import per_entry, triangular_root
from lqrsim.errors import Array
from lqrsim.kernels.records import LoopMoments
from lqrsim.results.goal import scale_of
from lqrsim.results.solution import Solution

# The number of collisions that the linear model's chance counts as, when it is combined with those of the trials: with
# fewer in the trials, it weighs more than they do.
PRIOR = 4.0
REFUTED = 0.025  # tail probability, on either side, of the trials' collisions below which they refute that chance


class DeviationNorm(NamedTuple):
    """The norm of deviations from a plan: of the position in m, or without one of the goal's states, each scaled."""

    states: list[int]  # indices of the states that count
    scale: Array  # (C,) what each is divided by: 1, or its range over the plan

    @classmethod
    def of(cls, solution: Solution, position: Sequence[int]) -> Self:
        if position:
            return cls(list(position), np.ones(len(position)))
        counts = np.flatnonzero(np.isfinite(solution.target.state)).tolist()
        return cls(counts, scale_of(solution.trajectory.states)[counts])

    def __call__(self, off: Array) -> Array:
        """The norms (...) of deviations (..., n)."""
        return np.linalg.norm(off[..., self.states] / self.scale, axis=-1)


@dataclass(frozen=True, eq=False)
class SampledLoop:
    """The result of K trials."""

    moments: LoopMoments  # of the deviations from the plan and the commands, over the trials whose states stay finite
    collided: npt.NDArray[np.bool_]  # (K,) whether each trial collides at a knot, or its state is not finite
    farthest: Array  # (K,) largest deviation of each trial from its plan, by the `DeviationNorm`

    def chance(self, predicted: float) -> float:
        """The chance of collision by these trials and the linear model's, `predicted`. 0 only if both have none."""
        trials, collisions = len(self.collided), int(self.collided.sum())
        low = float(betaincinv(collisions, trials - collisions + 1, REFUTED)) if collisions else 0.0
        high = float(betaincinv(collisions + 1, trials - collisions, 1 - REFUTED)) if collisions < trials else 1.0
        if not low <= predicted <= high:
            return max(collisions, 0.5) / trials  # no number of trials shows a chance of 0
        return (PRIOR + collisions) / (PRIOR / predicted + trials) if predicted else 0.0


def sample_loop(
    model: PlanModel, controller: Controller, limits: tuple[Array, Array], surroundings: Surroundings,
    norm: DeviationNorm, trials: int, seed: int,
) -> SampledLoop:  # fmt: skip
    """Run K trials of a controller about its plan, in the true system `model`."""
    plan, n = model.plan, model.n
    robots, run = _Robots(model, limits, trials, np.random.default_rng(seed)), controller.start(trials)
    displaced = surroundings.displacements(robots.rng, trials)
    collided, farthest = np.zeros(trials, dtype=bool), np.zeros(trials)
    states, commands = np.empty((plan.steps + 1, trials, n)), np.empty((plan.steps, trials, model.m))
    with np.errstate(over="ignore", invalid="ignore"):  # of lost trials
        for t in range(plan.steps + 1):
            states[t] = robots.states(t)
            finite = np.isfinite(states[t]).all(axis=1)
            collided |= ~finite
            collided[finite] |= surroundings.nearest(states[t, finite], [moved[finite] for moved in displaced]) < 0
            off = norm(states[t] - plan.states[t])
            farthest = np.maximum(farthest, np.where(finite, off, np.inf))
            if t < plan.steps:
                commands[t] = robots.advance(t, run.control(t, robots.measure(t)))
    stayed = np.isfinite(farthest)
    off, commands = (states - plan.states[:, None])[:, stayed], commands[:, stayed]
    mean = off.mean(axis=1)
    off -= mean[:, None]
    count = max(off.shape[1], 1)
    at_limit = (commands <= limits[0]) | (commands >= limits[1])
    moments = LoopMoments(
        mean, off.transpose(0, 2, 1) @ off / count, off[1:].transpose(0, 2, 1) @ off[:-1] / count,
        commands.std(axis=1), at_limit.mean(axis=1),
    )  # fmt: skip
    return SampledLoop(moments, collided, farthest)


class _Robots:
    """K simulated robots, and the links that carry measurements and commands.

    Their z is that of `plan_model.py`, but of states themselves in place of deviations from the plan.
    """

    def __init__(self, model: PlanModel, limits: tuple[Array, Array], trials: int, rng: np.random.Generator) -> None:
        plan, uncertainty = model.plan, model.uncertainty
        self.model, self.limits, self.rng, self._trials = model, limits, rng, trials
        start = np.concatenate([plan.states[0], model.reached[0], np.zeros(len(model.transition))])
        self.z = start + self._normal(model.size) @ model.start_root.T
        # Noise on controls is added before the limits, so it does not count as noise on states.
        self._control_std = per_entry("Uncertainty: control", uncertainty.control, model.dynamics.control_coordinates)
        process = replace(model, uncertainty=replace(uncertainty, control=0.0))
        self._process_roots = triangular_root(process.disturbing)
        arrived = Lag.of(uncertainty.lag, plan.dt)
        predictor = model.predictor._replace(lag=np.array([arrived.left, arrived.mean]))
        self._command = np.zeros((trials, model.m))
        self._predict = model.compiled.lay_out("predict", trials, self._command, predictor, self.z)
        # Measurements and commands under way. The first measurement is repeated until it arrives. The plan's controls
        # are applied until the first command arrives.
        self._late_measured = deque[Array]()
        first = [np.tile(plan.controls[min(i, plan.steps - 1)], (trials, 1)) for i in range(uncertainty.delay)]
        self._late_commands = deque(first)
        self._measured, self._applied = np.tile(plan.states[0], (trials, 1)), np.tile(plan.controls[0], (trials, 1))

    def _normal(self, size: int) -> Array:
        return self.rng.standard_normal((self._trials, size))

    def states(self, t: int) -> Array:
        """The states (K, n), angles near the plan's."""
        model = self.model
        x = self.z[:, : model.n].copy()
        turn_to_nearest(model.dynamics.state_coordinates, x[None], model.plan.states[t : t + 1])
        self.z[:, : model.n] = x
        return x

    def measure(self, t: int) -> Array:
        uncertainty, measured = self.model.uncertainty, self._late_measured
        measured.append(self.z[:, : self.model.n] + self._normal(self.model.n) * self.model.measurement_std)
        arrived = measured.popleft() if t >= uncertainty.latency else measured[0]
        lost = self.rng.random((self._trials, 1)) < uncertainty.loss
        self._measured = np.where(lost, self._measured, arrived)
        return self._measured

    def advance(self, t: int, commands: Array) -> Array:
        """Advance by a control period, under commands (K, m). Returns the applied commands."""
        uncertainty, model = self.model.uncertainty, self.model
        self._late_commands.append(commands)
        lost = self.rng.random((self._trials, 1)) < uncertainty.command_loss
        self._applied = np.where(lost, self._applied, self._late_commands.popleft())
        np.clip(self._applied + self._normal(model.m) * self._control_std, *self.limits, out=self._command)
        with model.dynamics.quiet():
            self._predict()
        self.z += self._normal(model.size) @ self._process_roots[t].T
        return self._command
