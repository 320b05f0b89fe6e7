"""The optimal control problem of Eqs. (1)-(2), in discrete time."""

import hashlib
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lqrsim.costs import ControlCost, Cost, ObstacleCost, QuadraticCost, Term, terms_of
from lqrsim.dynamics import Dynamics
from lqrsim.errors import Array, InputError, check_array, check_count, check_number


@dataclass(frozen=True)
class FixedState:
    """An initial state (n,) that is given exactly, in place of an initial cost."""

    state: npt.ArrayLike

    def __post_init__(self) -> None:
        object.__setattr__(self, "state", check_array("FixedState: state", self.state, (None,)))


class InitialPrior:
    """`1/2 (x - about)' diag(weight) (x - about)` at all steps but the first, in the first iterations only.

    It is no part of the cost: it keeps the first linearisations of the smoother sensible, and so has a say in which
    local optimum is found.

    Args:
      weight: (n,) not negative. iterations: how many it acts in.
      about: where it is zero: (n,), or (T+1, n) for a trajectory to be drawn to.
    """

    def __init__(self, weight: npt.ArrayLike, *, about: npt.ArrayLike, iterations: int = 1) -> None:
        self.weight = check_array("InitialPrior: weight", weight, (None,))
        if (self.weight < 0).any():
            raise InputError(f"InitialPrior: weight: got {self.weight.min():g}, want numbers >= 0")
        time = () if np.ndim(about) == 1 else (None,)
        self.about = check_array("InitialPrior: about", about, (*time, len(self.weight)))
        self.iterations = check_count("InitialPrior: iterations", iterations)

    def at(self, step: float) -> Array:
        """Where it is zero, (n,), at a step or between two."""
        if self.about.ndim == 1:
            return self.about
        before = min(int(step), len(self.about) - 2)
        share = step - before
        return (1 - share) * self.about[before] + share * self.about[before + 1]


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Minimise `c_0(x_0) + sum_t c(x_t, u_t, t) + c_T(x_T)` subject to `x_{t+1} = g(x_t, u_t)`.

    Attributes:
      dynamics: whose Runge-Kutta step over `dt`, control held, is g.
      dt: the control period in seconds. steps: T, the number of them.
      initial: c_0, the cost of starting elsewhere than wished (the paper's soft start); or `FixedState(x)`.
      stage_cost: c, per step: it is *not* multiplied by dt.
      final_cost: c_T.
      prior: a hint to `smooth`, not a part of the problem; see `InitialPrior`.

    Raises:
      InputError: dt or steps not positive, a cost that does not fit the dynamics, an initial or final cost that depends
        on the control, or a start that collides.
    """

    dynamics: Dynamics
    dt: float
    steps: int
    initial: Cost | FixedState
    stage_cost: Cost
    final_cost: Cost
    prior: InitialPrior | None = None
    _terms: dict[str, tuple[Term, ...]] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "dt", check_number("dt", self.dt, above=0.0))
        object.__setattr__(self, "steps", check_count("steps", self.steps))
        if not isinstance(self.dynamics, Dynamics):
            raise InputError(
                f"dynamics: got {type(self.dynamics).__name__}, want Dynamics(...), such as robot.dynamics"
            )
        costs = {"stage_cost": terms_of(self.stage_cost), "final_cost": terms_of(self.final_cost)}
        if isinstance(self.initial, FixedState):
            state = check_array("initial: FixedState", self.initial.state, (len(self.dynamics.state_coordinates),))
            # Costs nothing, and lets a fixed and a soft start share what is compiled.
            costs["initial"] = (QuadraticCost(np.zeros(len(state)), about=state),)
        else:
            costs["initial"] = terms_of(self.initial)
        bound = {name: tuple(cost.bind(self.dynamics) for cost in terms) for name, terms in costs.items()}
        for name in ("initial", "final_cost"):
            if any(term.uses_control for term in bound[name]):
                raise InputError(f"{name}: got a cost that depends on the control, want one of the state alone")
        if self.prior is not None:
            n = len(self.dynamics.state_coordinates)
            check_array("prior: weight", self.prior.weight, (n,))
            if self.prior.about.ndim == 2:
                check_array("prior: about", self.prior.about, (self.steps + 1, n))
        object.__setattr__(self, "_terms", bound)
        self._check_start_clear()

    @property
    def start(self) -> Array | None:
        """The state (n,) that the initial cost or FixedState asks for; None where it names none."""
        if isinstance(self.initial, FixedState):
            return np.asarray(self.initial.state)
        abouts = [cost.about for cost in terms_of(self.initial) if isinstance(cost, QuadraticCost)]
        return abouts[0] if len(abouts) == 1 else None

    @property
    def nominal_control(self) -> Array:
        """u*, where the control cost is zero, (m,); zeros where there is none."""
        abouts = [cost.about for cost in terms_of(self.stage_cost) if isinstance(cost, ControlCost)]
        return abouts[0] if abouts else np.zeros(len(self.dynamics.control_coordinates))

    @property
    def obstacle_costs(self) -> tuple[ObstacleCost, ...]:
        """The terms that keep the robot clear of obstacles."""
        return tuple(cost for cost in terms_of(self.stage_cost) if isinstance(cost, ObstacleCost))

    def terms(self, which: str) -> tuple[Term, ...]:
        """The bound terms of `initial`, `stage_cost` or `final_cost`."""
        return self._terms[which]

    @property
    def digest(self) -> str:
        """Hash of everything that defines the problem: structure and numbers. The prior does not."""
        hasher = hashlib.sha256(f"{self.dynamics.source} {self.dt!r} {self.steps}".encode())
        hasher.update(repr(self.dynamics.parameters).encode())
        functions = [*self.dynamics.functions]
        if isinstance(self.initial, FixedState):
            hasher.update(np.asarray(self.initial.state).tobytes())
        for name in ("initial", "stage_cost", "final_cost"):
            for term in self.terms(name):
                hasher.update(term.source.encode() + term.data.tobytes())
                functions += term.functions
        hasher.update("\n".join(function.identity for function in functions).encode())
        return hasher.hexdigest()[:16]

    def _check_start_clear(self) -> None:
        position = list(self.dynamics.state_coordinates.position)
        if self.start is None or not position:
            return
        for cost in self.obstacle_costs:
            world = cost.world.seen_by(len(position))
            if not len(world):
                continue
            place = self.start[position]
            distances = world.distances(place) - cost.radius
            if distances.min() < 0:
                where = ", ".join(f"{value:g}" for value in place)
                name = world.names[int(distances.argmin())]
                raise InputError(
                    f"initial: got a start at ({where}) m, {-distances.min():.3g} m inside obstacle {name!r},"
                    f" want it clear of obstacles by the robot's radius of {cost.radius:g} m"
                )
