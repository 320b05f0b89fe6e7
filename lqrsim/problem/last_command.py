"""A problem with costs or limits of rates as one with the last command among the states, which solvers can solve.

With `x = (y, z)`, `y_{t+1} = g(y_t, u_t)` and `z_{t+1} = u_t`, a rate is that of u_t and z_t. The kernels are its step.
"""

from collections.abc import Iterator
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.sources import Source, source_of
from lqrsim.codegen.user_functions import numbers_of
from lqrsim.errors import Array, free_name
from lqrsim.kernels.declarations import M, N, W, at, call, stack, zeros
from lqrsim.problem.constraints import bind_all
from lqrsim.problem.control_rate import RateCost, RateLimits
from lqrsim.problem.costs import Cost, ProblemPart, terms_of
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.problem.quadratic_cost import QuadraticCost
from lqrsim.results.coordinates import Coordinates

Part = TypeVar("Part", bound=ProblemPart[Any])


class LastCommand(Dynamics):
    """Dynamics `of` a system, with the last command as their last m states."""

    def __init__(self, of: Dynamics) -> None:
        self.of, self.level, self.functions = of, of.level, ()
        self.parameters, self.disturbances = dict[str, float](), dict[str, float]()  # those of `of` are its own
        # The steps are those of `of`, and so is what is told of them: its states come first.
        self._period, self.by_mujoco, self.rounding = of.period, of.by_mujoco, of.rounding
        self.period_near, self.check_period = of.period_near, of.check_period
        self.solving, self.quiet, self._with_finer_steps = of.solving, of.quiet, of._with_finer_steps
        self.touches, self._cause_of_failure = of.touches, of._cause_of_failure
        space, controls = of.state_coordinates, of.control_coordinates
        names = list(space.names)
        for name in controls.names:
            names.append(free_name(f"last_{name}", names))
        self.control_coordinates = controls
        self.state_coordinates = Coordinates(
            names=tuple(names), units=(*space.units, *controls.units), position=space.position, plane=space.plane,
            offset=space.offset, angles=space.angles, rotation_vectors=space.rotation_vectors,
        )  # fmt: skip

    @property
    def name(self) -> str:
        return self.of.name

    @property
    def calling(self) -> Dynamics:
        return self.of.calling

    @cached_property
    def step_source(self) -> Source:
        return source_of(__name__)

    @cached_property
    def curvature_source(self) -> Source | None:
        return self.step_source if self.of.step_curvature else None

    @property
    def data(self) -> Array:
        """The addresses that the kernels read."""
        functions = *self.of.compiled.addresses("advance", "step_jacobian"), self.of.step_curvature
        return np.array([*functions, self._own_numbers.ctypes.data], dtype=np.float64)

    @cached_property
    def _own_numbers(self) -> Array:
        """The numbers of the dynamics without, kept where their address is in use."""
        return numbers_of(self.of)

    def _own(self, states: npt.ArrayLike) -> Array:
        """States (..., n) without the last command."""
        return np.asarray(states)[..., : len(self.of.state_coordinates)]

    def untouched_body(self, states: Array, state: int) -> str:
        return self.of.untouched_body(self._own(states), state) if state < len(self.of.state_coordinates) else ""

    def softened(self, states: Array) -> Iterator[tuple[str, Dynamics]]:
        return ((name, LastCommand(softer)) for name, softer in self.of.softened(self._own(states)))

    def approaches(self, states: Array, change: Array) -> Iterator[tuple[str, Dynamics, Array]]:
        m = len(self.control_coordinates)
        for words, dynamics, motion in self.of.approaches(self._own(states), self._own(change)):
            yield words, LastCommand(dynamics), np.pad(motion, [(0, 0), (0, m)], constant_values=np.nan)

    def _runge_kutta(self, states: Array, controls: Array, dt: float) -> tuple[float, Array] | None:
        return self.of._runge_kutta(self._own(states), controls, dt)

    def rate(self, state: npt.ArrayLike, control: npt.ArrayLike) -> Array:
        """That of the dynamics; 0 for the last command, which jumps."""
        return np.pad(self.of.rate(self._own(state), control), (0, len(self.control_coordinates)))

    def rate_jacobian(self, state: npt.ArrayLike, control: npt.ArrayLike) -> tuple[Array, Array]:
        fx, fu = self.of.rate_jacobian(self._own(state), control)
        m = len(self.control_coordinates)
        return np.pad(fx, (0, m)), np.pad(fu, [(0, m), (0, 0)])

    def step(self, state: npt.ArrayLike, control: npt.ArrayLike, dt: float) -> Array:
        return np.concatenate([self.of.step(self._own(state), control, dt), np.asarray(control, dtype=np.float64)])

    def linearize(self, state: npt.ArrayLike, control: npt.ArrayLike, dt: float) -> tuple[Array, Array, Array]:
        a, b, c = self.of.linearize(self._own(state), control, dt)
        m = len(self.control_coordinates)
        return np.pad(a, (0, m)), np.vstack([b, np.eye(m)]), np.pad(c, (0, m))


def with_last_command(problem: Problem) -> Problem:
    """The problem of a problem with a `control_rate`, with the last command as its last m states.

    That before the first step is no state: the cost and the limits of rates have it.
    """
    rate, dynamics, m = problem.control_rate, problem.dynamics, len(problem.control_coordinates)
    assert rate is not None
    wide = LastCommand(dynamics)

    def added(part: Part) -> Part:
        for _ in range(m):
            part = part.with_added_state(dynamics)
        return part

    begun: Cost
    if isinstance(problem.initial, FixedState):
        initial = problem.initial._extended(np.zeros(m))
        begun = initial._cost
    else:
        # A weight, which costs nothing: a cost-to-come needs one of each state.
        weight = np.diag(np.pad(np.ones(m), (len(dynamics.state_coordinates), 0)))
        begun = added(problem.initial)
        if isinstance(begun, QuadraticCost):  # else the problem's start would be no longer known
            begun = QuadraticCost(begun.weight + weight, about=begun.about)
        else:
            begun += QuadraticCost(weight, about=np.zeros(len(weight)))
        initial = begun
    stage, constraints = added(problem.stage_cost), list(map(added, problem.constraints))
    if rate.weight is not None:
        stage += RateCost(rate, problem.dt)
    if rate.limits is not None:
        constraints.append(RateLimits(rate, problem.dt))
    final = added(problem.final_cost)
    # Without new checks, as the rest of a problem may begin where a new problem may not.
    other = problem._with(dynamics=wide, initial=initial, stage_cost=stage, final_cost=final, control_rate=None)
    parts = {"initial": begun, "stage_cost": stage, "final_cost": final}
    terms = {name: other._bound(terms_of(cost)) for name, cost in parts.items()}
    bound = bind_all(constraints, wide, problem.times)
    return other._with(_terms=terms, constraints=tuple(constraints), constraint_terms=bound)


# The kernels. g is called at its address, with sizes of its own, so that it may be any: a formula's Runge-Kutta step, a
# user's function, or MuJoCo's steps. `p` has the addresses below.
ADVANCE, STEP_JACOBIAN, STEP_CURVATURE, NUMBERS = 0, 1, 2, 3  # of g's functions, and of the numbers that they call p


def advance(x, u, p, h, out):
    """Write the state (N,) after `h` seconds."""
    call(p[ADVANCE], x, u, at(p[NUMBERS]), h, out)
    for i in range(M):
        out[N - M + i] = u[i]


def step_jacobian(x, u, p, h, out, jacobian):
    """Write the same step, and its Jacobian [A B] (N, W)."""
    own = stack(N - M, N)
    call(p[STEP_JACOBIAN], x, u, at(p[NUMBERS]), h, out, own)
    write_jacobian(u, own, out, jacobian)


def step_curvature(x, u, p, h, weights, out, jacobian, hessian):
    """Write the same; add the Hessian (W, W) of the next state times weights (N,)."""
    own, curve = stack(N - M, N), zeros(N, N)
    call(p[STEP_CURVATURE], x, u, at(p[NUMBERS]), h, weights, out, own, curve)
    write_jacobian(u, own, out, jacobian)
    for i in range(N):
        row = i if i < N - M else i + M
        for j in range(N):
            column = j if j < N - M else j + M
            hessian[row, column] += curve[i, j]


def write_jacobian(u, inner, out, jacobian):
    """Write the last M states, and the Jacobian of all, given that of the others, (N - M, N)."""
    for i in range(N):
        for j in range(W):
            jacobian[i, j] = 0.0
    for i in range(N - M):
        for j in range(N - M):
            jacobian[i, j] = inner[i, j]
        for j in range(M):
            jacobian[i, N + j] = inner[i, N - M + j]
    for i in range(M):
        out[N - M + i] = u[i]
        jacobian[N - M + i, N + i] = 1.0
