"""What the solvers share: settings, the stop test, and putting the answer together."""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim import compiled
from lqrsim.errors import Array, InputError, check_array, check_count, check_name, check_number
from lqrsim.problem import Problem
from lqrsim.results import AffinePolicy, Iteration, Quadratic, Solution, Status, Trajectory
from lqrsim.versions import versions

Callback = Callable[[Iteration], object]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """When to stop, and from where to start; see `smooth` for what each means."""

    stop: str
    tolerance: float
    max_iterations: int
    initial_controls: npt.ArrayLike | None
    gap_tolerance: float | None = None  # None where there can be no gap

    def __post_init__(self) -> None:
        check_name("stop", self.stop, ("optimal", "cost"))
        check_number("tolerance", self.tolerance, above=0.0)
        if self.gap_tolerance is not None:
            check_number("gap_tolerance", self.gap_tolerance, above=0.0)
        check_count("max_iterations", self.max_iterations)

    def controls(self, problem: Problem) -> Array:
        """The controls (T, m) that the first pass starts from: the nominal control unless told otherwise."""
        shape = (problem.steps, len(problem.dynamics.control_coordinates))
        given = problem.nominal_control if self.initial_controls is None else self.initial_controls
        try:
            controls = np.broadcast_to(np.asarray(given, dtype=np.float64), shape)
        except (TypeError, ValueError):
            raise InputError(
                f"initial_controls: got shape {np.shape(given)}, want ({shape[1]},) or ({shape[0]}, {shape[1]})"
            ) from None
        return check_array("initial_controls", controls, shape).copy()


class Log:
    """The iterations so far, and whether they are enough.

    Args:
      first_cost: of what the first iteration improves on, where there is such a thing.
    """

    def __init__(self, settings: Settings, callback: Callback | None, *, first_cost: float = np.inf) -> None:
        self.settings, self.callback = settings, callback
        self.iterations: list[Iteration] = []
        self._cost = first_cost
        self._clock = time.perf_counter()

    def add(self, cost: float, gap: float, optimality: Callable[[], float]) -> Status | None:
        """Record an iteration; the status if it is to be the last. `optimality` is called only where it matters."""
        asked = self.settings
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            improvement = float(np.subtract(self._cost, cost) / np.abs(cost))
        if cost == self._cost:
            improvement = 0.0  # also at a cost of zero
        settled = abs(improvement) < asked.tolerance
        if asked.stop == "optimal" and asked.gap_tolerance is not None:
            settled = settled and gap < asked.gap_tolerance
        full = len(self.iterations) + 1 >= asked.max_iterations
        left = optimality() if settled or full else float("nan")
        self.iterations.append(Iteration(cost, improvement, gap, left, time.perf_counter() - self._clock))
        self._cost = cost
        if self.callback is not None:
            self.callback(self.iterations[-1])
        self._clock = time.perf_counter()
        if settled and asked.stop == "cost":
            return Status.COST_CONVERGED
        if settled and left < asked.tolerance:
            return Status.CONVERGED
        if full:
            return Status.MAX_ITERATIONS if np.isfinite(cost) else Status.DIVERGED
        return None


@dataclass
class Workspace:
    """The arrays that the passes work on; names as in `solvers/passes.py`."""

    x_hat: Array
    x_hats: Array
    L: Array
    l: Array
    S: Array
    s: Array
    k: Array
    Lbar: Array
    lbar: Array
    Sbar: Array
    sbar: Array
    kbar: Array
    states: Array
    controls: Array

    @classmethod
    def of(cls, problem: Problem, start: Array, controls: Array) -> "Workspace":
        """All zero, but for the start and a policy that plays the given controls."""
        steps, (n, m) = problem.steps, (len(start), controls.shape[1])
        zeros = np.zeros
        return cls(
            start.copy(), zeros((steps + 1, n)),
            zeros((steps, m, n)), controls.copy(),
            zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1),
            zeros((steps, m, n)), zeros((steps, m)),
            zeros((steps + 1, n, n)), zeros((steps + 1, n)), zeros(steps + 1),
            zeros((steps + 1, n)), controls.copy(),
        )  # fmt: skip


def predicted_decrease(
    core: ModuleType, data: Mapping[str, Any], states: Array, controls: Array, *, soft: bool
) -> float:
    """The decrease of cost that a linear-quadratic model about a feasible trajectory promises; infinite if it fails.

    This is the backward pass of iLQR: what is left to gain to second order. With a soft start, moving it counts too.
    """
    if not (np.isfinite(states).all() and np.isfinite(controls).all()):
        return float("inf")
    steps, n = len(controls), states.shape[1]
    m = controls.shape[1]
    value = np.zeros((steps + 1, n, n)), np.zeros((steps + 1, n)), np.zeros(steps + 1)
    law = np.zeros((steps, m, n)), np.zeros((steps, m))
    failed, _, decrease = core.differential_pass(
        states, controls, data["p"], data["dt"], data["stage"], data["final"], 0.0, *law, *value
    )
    if failed >= 0:
        return float("inf")
    if soft:
        decrease += core.initial_decrease(states[0], data["initial"], value[0][0], value[1][0])
    return decrease if np.isfinite(decrease) else float("inf")


def assemble(
    problem: Problem,
    *,
    solver: str,
    settings: Settings,
    status: Status,
    detail: str,
    log: Log,
    states: Array,
    controls: Array,
    law: tuple[Array, Array],
    inverse_law: tuple[Array, Array] | None,
    cost_to_go: Quadratic | None,
    cost_to_come: Quadratic | None,
) -> Solution:
    """The Solution of what a solver found."""

    def policy(gain: Array, offset: Array, nominal: Array) -> AffinePolicy:
        return AffinePolicy(
            gain=gain, offset=offset, nominal=nominal, dt=problem.dt,
            state_coordinates=problem.dynamics.state_coordinates,
            control_coordinates=problem.dynamics.control_coordinates,
        )  # fmt: skip

    options: dict[str, object] = {key: value for key, value in asdict(settings).items() if key != "initial_controls"}
    options["initial_controls"] = np.asarray(settings.controls(problem)[0]).tolist()
    return Solution(
        status=status,
        detail=detail,
        policy=policy(*law, states[:-1]),
        inverse_policy=policy(*inverse_law, states[1:]) if inverse_law is not None else None,
        cost_to_go=cost_to_go,
        cost_to_come=cost_to_come,
        trajectory=Trajectory(states, controls, problem.dt),
        iterations=tuple(log.iterations),
        clearance=_clearance(problem, states),
        solver=solver,
        options=options,
        problem_digest=problem.digest,
        versions=versions(),
    )


def _clearance(problem: Problem, states: Array) -> Array | None:
    position = list(problem.dynamics.state_coordinates.position)
    costs = [cost for cost in problem.obstacle_costs if len(cost.world)]
    if not costs:
        return None
    place = states[:, position]
    return np.min([compiled.signed_distance(c.world.seen_by(len(position)), place) - c.radius for c in costs], axis=0)
