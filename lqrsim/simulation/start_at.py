"""Runs that begin at a knot of the plan in given states: the rest of a run that followed the plan until then.

Before the run begins, disturbances and controller are called with the plan, period by period. A delay then has its
past, a filter its estimate, and events occur at their given times. The physics begins at the knot.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lqrsim.control.controllers import Controller, ControllerLike, ControllerRun, Feedback, as_controller
from lqrsim.errors import Array, InputError, check_array, check_count, check_kind
from lqrsim.problem.noise import Noise
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.plan import Plan
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance, Effect, as_disturbances
from lqrsim.simulation.plant import Plant


def simulate_from(
    plant: Plant,
    plan: Plan,
    states: Array,
    *,
    knot: int = 0,
    disturbances: Sequence[Disturbance | Noise] = (),
    controller: ControllerLike | None = None,
    **options: Any,
) -> Rollout:
    """Run the rest of a plan after `knot` periods, one trial from each of the states (K, n).

    Until the knot, states and measurements are assumed to be the plan's.

    Args:
      plant, plan, controller: as in `simulate`.
      states: (K, n), where the trials begin.
      knot: number of the knot.
      disturbances: as in `simulate`, without those that change the start, such as `InitialStateError`.
      options: other options of `simulate`, except `trials`. Times of the rollout count from the knot.

    Raises:
      InputError: as `simulate`; a disturbance changes the start; or the knot is not before the plan's end.
    """
    check_kind("plant", plant, Plant, "a Plant, such as scenario.plant()")
    law, plan = as_controller(controller, plan, plant.robot.dynamics)
    whole = plan.trajectory
    if check_count("knot", knot, at_least=0) >= whole.steps:
        raise InputError(f"knot: got {knot}, want one from 0 to {whole.steps - 1}, before the plan's end")
    starts = check_array("states", states, (None, whole.states.shape[1]))
    given = as_disturbances(disturbances, "disturbances, such as ControlNoise(0.05)")
    later: list[Disturbance] = [_Later(one, whole, knot) for one in given]
    rollout = simulate(
        plant,
        plan.shifted(knot, horizon="shrinking"),
        disturbances=[*later, _Start(starts)],
        controller=_LaterController(law, whole, knot) if knot else law,
        trials=len(starts),
        **options,
    )
    run = rollout.controller_run
    return replace(rollout, controller_run=run.of) if isinstance(run, _LaterRun) else rollout


@dataclass(frozen=True, eq=False)
class _Start(Disturbance):
    """Puts the trials into their first states."""

    states: Array

    def describe(self, plant: Plant) -> str:
        return "given first states"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        return Effect(initial_states=lambda planned: self.states)


@dataclass(frozen=True, eq=False)
class _Later(Disturbance):
    """A disturbance of the whole plan, in a run that begins at one of its knots."""

    of: Disturbance
    plan: Trajectory
    knot: int

    def describe(self, plant: Plant) -> str:
        return self.of.describe(plant)

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        effect = self.of.start(plant, self.plan, generators)
        if not isinstance(effect, Effect):  # `simulate` refuses it
            return effect
        states, controls, trials = self.plan.states, self.plan.controls, len(generators)
        if effect.initial_states is not None:
            planned = np.tile(states[0], (trials, 1))
            if not np.array_equal(effect.initial_states(planned.copy()), planned):
                raise InputError(
                    f"disturbances: got {type(self.of).__name__}, which changes the start of a run, want others: the"
                    " runs begin in given states"
                )
            effect = replace(effect, initial_states=None)
        if self.knot == 0:
            return effect
        past: dict[str, tuple[Array, ...]] = {  # in the order of a control period
            "measure": (states,), "actuate": (controls,), "force": (states,), "torque": (states,), "wind": (states,),
            "kick": (states, controls),
        }  # fmt: skip
        hooks = {name: hook for name in past if (hook := getattr(effect, name)) is not None}
        led = [False]

        def lead() -> None:
            """Call the hooks with the plan until the knot: once, after the models have been altered."""
            led[0] = True
            for step in range(self.knot):
                for name, hook in hooks.items():
                    hook(step, *(np.tile(values[step], (trials, 1)) for values in past[name]))

        def later(hook: Callable[..., Array]) -> Callable[..., Array]:
            def called(step: int, *values: Array) -> Array:
                if not led[0]:
                    lead()
                return hook(step + self.knot, *values)

            return called

        return replace(effect, **{name: later(hook) for name, hook in hooks.items()})


class _LaterController(Controller):
    """A controller of the whole plan, in a run that begins at one of its knots."""

    def __init__(self, of: Controller, whole: Trajectory, knot: int) -> None:
        self.of, self.whole, self.knot = of, whole, knot

    def start(self, trials: int) -> ControllerRun:
        run = self.of.start(trials)
        if not isinstance(self.of, Feedback):  # a Feedback has no memory
            for step in range(self.knot):
                run.control(step, np.tile(self.whole.states[step], (trials, 1)))
        return _LaterRun(run, self.knot)

    @property
    def digest(self) -> str:
        return self.of.digest

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        return self.of.coordinates


class _LaterRun(ControllerRun):
    def __init__(self, of: ControllerRun, knot: int) -> None:
        self.of, self._knot = of, knot

    def control(self, step: int, measured: Array) -> Array:
        return self.of.control(step + self._knot, measured)

    def estimator_diverged(self) -> Mapping[int, str]:
        return self.of.estimator_diverged()

    def summary(self) -> str:
        return self.of.summary()
