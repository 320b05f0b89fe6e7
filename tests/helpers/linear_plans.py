"""Linear systems with a plan, for the tests of tracking, estimation and tubes. They use none of the solvers.

One step of Runge and Kutta of linear dynamics is linear: A = 1 + hF + ... + (hF)^4 / 24. All entries are parameters,
so that systems of one size compile once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from tracking import open_loop

import lqrsim as ls
from lqrsim.errors import Array

DT = 0.1


@dataclass(frozen=True)
class Linear:
    """xdot = rates x + inputs u + pushes d, with a plan from `start`. A, B and E are those of a control period."""

    rates: Array
    inputs: Array
    pushes: Array
    problem: ls.Problem
    solution: ls.Solution

    @property
    def plan(self) -> ls.Trajectory:
        return self.solution.trajectory

    @property
    def A(self) -> Array:
        step = DT * self.rates
        return np.eye(len(step)) + step @ self._inner

    @property
    def B(self) -> Array:
        return DT * self._inner @ self.inputs

    @property
    def E(self) -> Array:
        return DT * self._inner @ self.pushes

    @property
    def _inner(self) -> Array:
        step, one = DT * self.rates, np.eye(len(self.rates))
        return one + step @ (one / 2 + step @ (one / 6 + step / 24))


def linear(
    rates: npt.ArrayLike, inputs: npt.ArrayLike, pushes: npt.ArrayLike, *, start: npt.ArrayLike | None = None,
    controls: npt.ArrayLike | None = None, steps: int = 12, limits: tuple[float, float] = (-np.inf, np.inf),
    position: Sequence[str] = (), costs: tuple[ls.Cost, ...] = (),
) -> Linear:  # fmt: skip
    """A system with the plan of these controls (T, m), zeros by default."""
    rates, inputs, pushes = (np.atleast_2d(np.asarray(one, dtype=float)) for one in (rates, inputs, pushes))
    (n, m), k = inputs.shape, pushes.shape[1]
    numbers = {f"a{i}{j}": rates[i, j] for i in range(n) for j in range(n)}
    numbers |= {f"b{i}{j}": inputs[i, j] for i in range(n) for j in range(m)}
    numbers |= {f"e{i}{j}": pushes[i, j] for i in range(n) for j in range(k)}
    dynamics = ls.Dynamics(
        _rate(n, m, k), states={f"s{i}": "m" for i in range(n)}, controls={f"u{i}": "N" for i in range(m)},
        parameters=numbers, disturbances={f"d{i}": 0.0 for i in range(k)}, control_limits=limits, position=position,
        plane="xy" if position else "",
    )  # fmt: skip
    controls = np.zeros((steps, m)) if controls is None else np.asarray(controls, dtype=float)
    states = [np.zeros(n) if start is None else np.asarray(start, dtype=float)]
    stage: Any = ls.ControlCost(np.ones(m), about=np.zeros(m))
    for cost in costs:
        stage = stage + cost
    problem = ls.Problem(
        dynamics=dynamics, dt=DT, steps=len(controls), initial=ls.FixedState(states[0]), stage_cost=stage,
        final_cost=ls.QuadraticCost(np.ones(n), about=np.zeros(n)),
    )  # fmt: skip
    system = Linear(rates, inputs, pushes, problem, None)  # type: ignore[arg-type]
    for control in controls:
        states.append(system.A @ states[-1] + system.B @ control)
    plan = ls.Trajectory(np.array(states), controls, DT)
    return Linear(rates, inputs, pushes, problem, open_loop(dynamics, plan))


@cache
def _rate(n: int, m: int, k: int) -> Callable[[Any, Any, Any], list[Any]]:
    """The dynamics of one size; cached, so that each is traced once."""

    def rate(x: Any, u: Any, p: Any) -> list[Any]:
        def entry(i: int) -> Any:
            parts = [getattr(p, f"a{i}{j}") * x[j] for j in range(n)]
            parts += [getattr(p, f"b{i}{j}") * u[j] for j in range(m)]
            parts += [getattr(p, f"e{i}{j}") * getattr(p, f"d{j}") for j in range(k)]
            return sum(parts[1:], parts[0])

        return [entry(i) for i in range(n)]

    return rate


def double_integrator(**options: Any) -> Linear:
    """A mass of 1 kg along a line, pushed by its control and by d0."""
    return linear([[0, 1], [0, 0]], [[0], [1]], [[0], [1]], **options)


def law_of(
    system: Linear,
    *,
    unknowns: Sequence[ls.disturbances.Unknown] = (ls.disturbances.Unknown("d0", 0.5),),
    **options: Any,
) -> ls.OffsetFree:
    """Output feedback for the double integrator, with noise; the options are those of Uncertainty, and `sensors`."""
    sensors = options.pop("sensors", None)
    stated: dict[str, Any] = {"unknowns": unknowns, "start": 0.3, "measurement": 0.1, "control": 0.2}
    uncertainty = ls.disturbances.Uncertainty(**(stated | options))
    return ls.OffsetFree(
        system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0, sensors=sensors, record=True
    )
