"""Solves that fail, each with its remedy and with what the remedy names.

They are small enough to be told what is wrong with them: without a minimum, out of reach, out of their domain.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from sympy import log

import lqrsim as ls

Solver = Callable[..., ls.Solution]
FIELDS: dict[str, Any] = {"states": {"x": "m", "v": "m/s"}, "controls": {"u": "N"}}


def mass(x, u, p):
    return [x[1], u[0]]


def swing(x, u, p):
    from sympy import sin

    return [x[1], u[0] - p.pull * sin(x[0])]


def cube(x, u, p):
    return [x[1], p.pull * x[0] ** 3 + u[0]]


def brake(x, u, p):
    return [x[1], u[0] - x[1] ** 3]


def inside(x, u, p):
    return [x[1], u[0] + log(x[0])]


def problem(
    rate: Any = mass, *constraints: ls.Constraint, pull: float | None = None, start: Any = (0.0, 0.0),
    goal: Any = (1.0, 0.0), stage: ls.Cost | None = None, effort: float = 1.0, final: float = 1.0,
    limit: float | None = None, dt: float = 0.1, steps: int = 15, **others: Any,
) -> ls.Problem:  # fmt: skip
    """From a start to a goal, by default a mass on a line in 1.5 s."""
    dynamics = ls.Dynamics(rate, parameters={} if pull is None else {"pull": pull}, **FIELDS)
    return ls.Problem(
        dynamics=dynamics, dt=dt, steps=steps, initial=ls.FixedState(start),
        stage_cost=ls.ControlCost([effort]) if stage is None else stage,
        final_cost=ls.QuadraticCost([final, final], about=goal), constraints=constraints,
        control_limits=None if limit is None else (-limit, limit), **others,
    )  # fmt: skip


def cost(of: Callable[[Any], Any]) -> ls.Cost:
    """A stage cost by a formula of u and x."""
    return ls.SymbolicCost(lambda x, u, p: of(SimpleNamespace(x=x.x, u=u.u)))


def reach(x: float, **others: Any) -> ls.Problem:
    """To stand at x, with 1 N for 1 kg and 1.5 s: 0.5625 m can be reached."""
    options: dict[str, Any] = {"limit": 1.0} | others
    return problem(mass, ls.GoalState(x=x, v=0.0), **options)


@dataclass
class Case:
    """A solve that fails, what its remedy says, and what the remedy names: other problems, and other options.

    Each change is a problem, or None for the same, and options; a function of the failed solution makes options.
    """

    status: str
    remedy: str
    of: ls.Problem
    options: dict[str, Any]
    changes: list[tuple[ls.Problem | None, Any]] = field(default_factory=list[tuple[ls.Problem | None, Any]])
    solver: Solver = ls.smooth


FALLS, BENT = cost(lambda z: z.u**2 - 3 * z.x**2), cost(lambda z: z.u**4 - 0.5 * z.u**2)
UPRIGHT = problem(swing, pull=4.0, goal=(3.0, 0.0), final=100.0, steps=40)
STIFF = problem(swing, ls.GoalState(x=3.0, v=0.0), pull=4.0, goal=(3.0, 0.0), final=100.0, steps=40)
CUBE = problem(cube, pull=1.0, start=(2.0, 0.0), goal=(0.0, 0.0), steps=40)
INSIDE = problem(inside, start=(1.0, -3.0))
RISKY = problem().driven_by(ls.Noise(0.1 * np.eye(2)), 500.0)
BALL = ls.Obstacle("ball", "sphere", np.array([1.0, 0.0, 0.0]), np.eye(3), np.array([0.2, 0.0, 0.0]))


def walk(*, place: float) -> ls.Problem:
    """A point in the plane is to end beside or in a ball."""
    dynamics = ls.Dynamics(
        lambda x, u, p: [u[0], u[1]], states={"x": "m", "y": "m"}, controls={"vx": "m/s", "vy": "m/s"},
        position=("x", "y"),
    )  # fmt: skip
    return ls.Problem(
        dynamics=dynamics, dt=0.1, steps=15, initial=ls.FixedState(np.zeros(2)), stage_cost=ls.ControlCost(np.ones(2)),
        final_cost=ls.QuadraticCost(np.ones(2), about=np.zeros(2)),
        constraints=[ls.Clearance(ls.World([BALL]), radius=0.1), ls.GoalState(x=1.0, y=place)],
    )  # fmt: skip


def fragile(limit: float) -> ls.Problem:
    """A user's function that raises beyond a limit."""

    def rate(x, u, p):
        if x[0] > limit:
            raise ZeroDivisionError("beyond the table")
        return [x[1], u[0]]

    return replace(problem(final=100.0), dynamics=ls.Dynamics(rate, level="plain", **FIELDS))


def rattled(*, steps: int = 4, accuracy: float = 1e-6) -> ls.Problem:
    """A position that a forced vibration of 160 Hz shakes, for two seconds; a clock is among the states."""
    from sympy import cos

    dynamics = ls.Dynamics(
        lambda x, u, p: [1.0, p.w * cos(p.w * x.clock) + u.v], states={"clock": "s", "x": "m"}, controls={"v": "m/s"},
        parameters={"w": 1e3},
    )  # fmt: skip
    return ls.Problem(
        dynamics=dynamics, dt=2.0 / steps, steps=steps, initial=ls.FixedState(np.zeros(2)), accuracy=accuracy,
        stage_cost=ls.ControlCost([1.0]), final_cost=ls.QuadraticCost({"x": 100.0}, about={"x": 1.0}),
    )  # fmt: skip


def combed(steps: int, teeth: float, height: float) -> ls.Problem:
    """A point passes over a comb that has many teeth in a period, without touching any."""
    dynamics = ls.Dynamics(lambda x, u, p: [u[0], u[1]], states={"x": "m", "y": "m"}, controls={"a": "", "b": ""})

    def above(x, u, p):
        from sympy import cos

        return x.y - p.height * cos(p.teeth * x.x)

    return ls.Problem(
        dynamics=dynamics, dt=2.0 / steps, steps=steps, initial=ls.FixedState([0.0, 2 * height]), between_knots=True,
        stage_cost=ls.ControlCost([0.1, 0.1]) + ls.QuadraticCost({"y": 5.0}, about={"y": 0.0}),
        final_cost=ls.QuadraticCost({"x": 100.0}, about={"x": 1.0}),
        constraints=[ls.SymbolicConstraint(above, parameters={"height": height, "teeth": teeth})],
    )  # fmt: skip


CASES = {
    "too late": Case(
        "INFEASIBLE", "allow more time than 1.5 s, relax the limits of u, or ask for less of what is missed",
        reach(1.0), {}, [(reach(1.0, steps=25), {}), (reach(1.0, limit=2.0), {}), (reach(0.5), {})],
    ),
    "too slow": Case(
        "INFEASIBLE", "relax v of at most 0.2 m/s",
        problem(mass, ls.GoalState(x=1.0), ls.StateBounds(v=(-0.2, 0.2))), {},
        [(problem(mass, ls.GoalState(x=1.0), ls.StateBounds(v=(-4.0, 4.0))), {})],
    ),
    "too late, whatever the duration": Case(
        "INFEASIBLE", "allow more time than 2 s, relax ", reach(2.0, duration=(0.5, 2.0), time_weight=1.0), {},
        [(reach(2.0, duration=(0.5, 4.0), time_weight=1.0), {})],
    ),
    "a goal in an obstacle": Case(
        "INFEASIBLE", "move the goal, which is at (1, 0.1) m", walk(place=0.1), {}, [(walk(place=0.5), {})]
    ),
    "a cost that falls for ever": Case(
        "DIVERGED", "raise the control weight, or give control_limits and StateBounds",
        problem(stage=FALLS, steps=30), {},
        [(problem(stage=FALLS + ls.ControlCost([100.0]), steps=30), {}),
         (problem(mass, ls.StateBounds(x=(-5.0, 5.0)), stage=FALLS, steps=30, limit=10.0), {})],
    ),
    "a cost of effort that is bent down": Case(
        "NOT_POSITIVE_DEFINITE", "raise the control weight, or begin with another start", problem(stage=BENT), {},
        [(problem(stage=BENT + ls.ControlCost([2.0])), {}), (None, {"start": [0.5]})],
    ),
    "a cost that falls with the control": Case(
        "NOT_POSITIVE_DEFINITE", "the cost is not curved in u: give control_limits, or add a ControlCost",
        problem(stage=cost(lambda z: -z.u**2)), {},
        [(problem(stage=cost(lambda z: -z.u**2), limit=1.0), {}),
         (problem(stage=cost(lambda z: -z.u**2) + ls.ControlCost([10.0])), {})],
    ),
    "the paper's method needs a curved cost": Case(
        "NOT_POSITIVE_DEFINITE", 'solve with finish="newton" and stop="optimal": Newton\'s method',
        problem(stage=cost(lambda z: z.u**4)), {"finish": None}, [(None, {})],
    ),
    "the paper's method and limits": Case(
        "STALLED", 'solve with finish="newton" and stop="optimal": the interior point',
        reach(0.5, stage=cost(lambda z: z.u**4)), {"finish": None}, [(None, {})],
    ),
    "a motion that escapes": Case(
        "NOT_FINITE", "solve with safeguard=True", CUBE, {"finish": None, "safeguard": False},
        [(None, {"finish": None})],
    ),
    "a first rollout that escapes": Case(
        "NOT_FINITE",
        "solve with smooth, or begin with start=[...], controls under which the states stay in their domain",
        INSIDE, {}, [(None, {"start": [6.0]})], ls.ilqr,
    ),
    "a function that raises": Case(
        "NOT_FINITE", "check the dynamics and the cost at the step that is named, or begin with another start",
        fragile(0.5), {}, [(fragile(9.0), {})],
    ),
    "steps that are unstable": Case(
        "NOT_FINITE", "use dt of at most 0.00103 s, with 98 times as many steps", problem(brake, start=(0.0, 30.0)), {},
        [(problem(brake, start=(0.0, 30.0), dt=0.001, steps=1500), {})], ls.ilqr,
    ),
    "steps that are too few for the accuracy": Case(
        "STALLED", "use 3 times as many steps, or a larger accuracy than 1e-06", rattled(), {},
        [(rattled(steps=12), {}), (rattled(accuracy=1e-4), {})],
    ),
    "steps that are too few for what is between them": Case(
        "STALLED", "use twice as many steps", combed(7, 732.0, 0.41), {"starts": 1},
        [(combed(14, 732.0, 0.41), {"starts": 1})],
    ),
    "too few iterations": Case(
        "MAX_ITERATIONS", "raise max_iterations: the cost still fell in the last one, by ", UPRIGHT,
        {"max_iterations": 3}, [(None, {})],
    ),
    "too few iterations with constraints": Case(
        "MAX_ITERATIONS", "raise max_iterations", STIFF, {"max_iterations": 2, "safeguard": False}, [(None, {})]
    ),
    "too little time": Case("TIME_LIMIT", "raise time_limit", UPRIGHT, {"time_limit": 1e-9}, [(None, {})]),
    "a tolerance below rounding": Case(
        "STALLED", "accept a larger tolerance", UPRIGHT, {"tolerance": 1e-30}, [(None, {"tolerance": 1e-8})], ls.ilqr
    ),
    "a start on a ridge": Case(
        "STALLED", "begin with another start", problem(stage=BENT), {}, [(None, {"start": [0.5]})], ls.ilqr
    ),
    "a risk that is too high": Case(
        "RISK_TOO_HIGH", "lower the risk below the largest that is named, or lower the noise", RISKY, {},
        [(replace(RISKY, risk=3.0), {}), (problem().driven_by(ls.Noise(1e-3 * np.eye(2)), 500.0), {})],
    ),
}  # fmt: skip
