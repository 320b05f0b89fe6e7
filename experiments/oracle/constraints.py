"""A problem's constraints evaluated anew in plain NumPy: formulas by SymPy's `lambdify`, distances from geometry."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lqrsim as ls
from lqrsim.errors import Array
from oracle import kkt

Values = kkt.Values


@dataclass(frozen=True)
class Kept:
    """One constraint along a plan.

    Attributes:
      function: from points (..., T+1, n+m), which may be complex, to numbers (..., T+1, rows).
      acts: (T+1, rows) where they are to be kept.
      equality: whether they are to be zero, or else not negative.
    """

    function: Callable[[Values], Values]
    acts: NDArray[np.bool_]
    equality: bool

    def violation(self, z: Array) -> float:
        """By how much the worst number is missed."""
        values = self.function(z)[self.acts]
        return float((np.abs(values) if self.equality else -values).max(initial=0.0))

    def slopes(self, z: Array) -> Array:
        """Gradient of each number where it acts, (T+1, rows, n+m), by complex steps."""
        moved = z + 1e-30j * np.eye(z.shape[1])[:, None, :]
        return np.moveaxis(self.function(moved).imag, 0, -1) / 1e-30 * self.acts[..., None]


def points(plan: ls.Trajectory) -> Array:
    """The states and controls (T+1, n+m) of a plan; there is no last control: zero."""
    return np.hstack([plan.states, np.vstack([plan.controls, np.zeros(plan.controls.shape[1])])])


def of(problem: ls.Problem) -> list[Kept]:
    """The constraints, in order."""
    return [_one(problem, constraint) for constraint in problem.constraints]


def _one(problem: ls.Problem, constraint: ls.Constraint) -> Kept:
    dynamics, steps = problem.dynamics, problem.steps
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    # Of all steps; and of those that states can still be changed at, for of a start that is given nothing can.
    everywhere, changeable = np.ones(steps + 1, bool), np.ones(steps + 1, bool)
    changeable[0] = not isinstance(problem.initial, ls.FixedState)
    at_end = np.arange(steps + 1) == steps
    if isinstance(constraint, ls.Clearance):
        space = dynamics.state_coordinates
        if isinstance(constraint.margin, np.ndarray):
            raise NotImplementedError("a clearance with a margin for each knot")
        if constraint.balls is not None:
            obstacles, count = constraint.world.obstacles, len(constraint.balls)
            formula = kkt.numeric(_coordinates(constraint.balls), n, m, tuple(dynamics.parameters), True)
            least = constraint.balls.radii + constraint.margin
            function = partial(_spare_of_balls, obstacles, formula, n, kkt.numbers_of(problem), least)
            return Kept(function, np.tile(changeable[:, None], (1, count * len(obstacles))), False)
        obstacles = constraint.world.seen_by(space.plane, space.offset).obstacles
        function = partial(_spare, obstacles, list(space.position), constraint.radius + constraint.margin)
        return Kept(function, np.tile(changeable[:, None], (1, len(obstacles))), False)
    if isinstance(constraint, ls.GoalState):
        goal = constraint.final_states(dynamics)
        indices, wanted = list(goal), np.array(list(goal.values()))
        angles = () if constraint.count_turns else dynamics.state_coordinates.angles
        turn = np.where(np.isin(indices, list(angles)), 2 * np.pi, 0.0)  # an angle reaches it up to whole turns

        def missed(z: Values) -> Values:
            off = z[..., indices] - wanted
            return off - turn * np.round(off.real / (2 * np.pi))

        return Kept(missed, np.tile(at_end[:, None], (1, len(indices))), True)
    if isinstance(constraint, ls.StateBounds):
        bounds = constraint.state_bounds(dynamics).items()
        rows = [(i, sign, bound[side]) for side, sign in ((0, 1), (1, -1)) for i, bound in bounds]
        rows = [
            (i, sign, np.broadcast_to(bound, steps + 1))
            for i, sign, bound in rows
            if np.ndim(bound) or np.isfinite(bound)
        ]
        indices, signs = (np.array([row[column] for row in rows]) for column in (0, 1))
        numbers = np.stack([np.broadcast_to(bound, steps + 1) for *_, bound in rows], axis=1)
        goals = [one for one in problem.constraints if isinstance(one, ls.GoalState)]
        fixed = {i for one in goals for i in one.final_states(dynamics)}
        acts = np.stack([changeable & ~(at_end & (i in fixed)) for i in indices], axis=1) & np.isfinite(numbers)
        numbers = np.where(acts, numbers, 0.0)
        return Kept(lambda z: signs * (z[..., indices] - numbers), acts, False)
    if isinstance(constraint, ls.SymbolicConstraint):
        formula = kkt.numeric(_listed(constraint.function), n, m, tuple(constraint.parameters), True)
        rows = len(formula([0.1] * n, [0.1] * m, tuple(constraint.parameters.values())))
        with_control = _uses_control(constraint.function, n, m, tuple(constraint.parameters))
        acts = (everywhere & ~at_end) if with_control else changeable
        acts = acts & at_end if constraint.at == "final" else acts
        function = partial(_formula, formula, n, tuple(constraint.parameters.values()))
        return Kept(function, np.tile(acts[:, None], (1, rows)), constraint.equality)
    raise TypeError(f"no check for {type(constraint).__name__}")


def _spare(obstacles: Any, position: list[int], least: float, z: Values) -> Values:
    away = [kkt.distance(obstacle, z[..., position]) - least for obstacle in obstacles]
    return np.stack(away, axis=-1) if away else np.zeros((*z.shape[:-1], 0))


def _spare_of_balls(
    obstacles: Any, formula: Any, n: int, parameters: tuple[float, ...], least: Array, z: Values
) -> Values:
    """Ball by ball: what is left between it and each obstacle."""
    numbers = _formula(formula, n, parameters, z)
    places = numbers.reshape(*numbers.shape[:-1], -1, 3)
    away = [
        kkt.distance(obstacle, places[..., ball, :]) - radius
        for ball, radius in enumerate(least)
        for obstacle in obstacles
    ]
    return np.stack(away, axis=-1)


def _formula(formula: Any, n: int, parameters: tuple[float, ...], z: Values) -> Values:
    entries = list(np.moveaxis(z, -1, 0))
    numbers = formula(entries[:n], entries[n:], parameters)
    return np.stack([np.broadcast_to(number, z.shape[:-1]) for number in numbers], axis=-1)


@cache
def _listed(function: Any) -> Any:
    """The same function, its only entry as a list of one."""

    def listed(x: Any, u: Any, p: Any) -> list[Any]:
        returned = function(x, u, p)
        return list(returned) if isinstance(returned, (list, tuple)) else [returned]

    return listed


@cache
def _coordinates(balls: ls.CollisionSpheres) -> Any:
    """The middles of all balls as a formula of x, u and p, three numbers a ball."""

    def coordinates(x: Any, u: Any, p: Any) -> list[Any]:
        return [entry for place in balls.function(x, p) for entry in place]

    return coordinates


def _uses_control(function: Any, n: int, m: int, parameters: tuple[str, ...]) -> bool:
    import sympy

    x, u = sympy.symbols(f"x:{n}"), sympy.symbols(f"u:{m}")
    namespace = type("Parameters", (), {name: sympy.Symbol(f"p_{name}") for name in parameters})
    return any(entry.free_symbols & set(u) for entry in _listed(function)(x, u, namespace))
