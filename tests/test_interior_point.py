"""Constraints and limits to the end: against conditions of first order worked out anew, SciPy's SLSQP, closed forms."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import hypothesis.strategies as st
import numpy as np
import point_mass
import pytest
from hypothesis import HealthCheck, given, settings
from shooting import Shooting

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.solution_parts import Iteration, Status

DT = 0.1
# A state, a speed, a control and the cost in another unit: by how much their numbers are larger.
UNITS: Mapping[str, float] = {"place": 1.0, "speed": 1.0, "force": 1.0, "cost": 1.0}


def swing(x, u, p):
    """A pendulum, or without `pull` a mass on a line; in any units."""
    from sympy import sin

    push = p.push * u[0] / p.force - p.pull * sin(x[0] / p.place) - p.drag * x[1] / p.speed
    return [p.place / p.speed * x[1], p.speed * push]


def power(x, u, p):
    """No more power than that, nor more effort and speed together."""
    return [p.power - u[0] * x[1] / (p.force * p.speed), p.most - (u[0] / p.force) ** 2 - p.beside * (x[1] / p.speed) ** 2]


def meeting(x, u, p):
    return x[0] / p.place + p.share * x[1] / p.speed + p.bent * (x[0] / p.place) ** 2 - p.there


def system(*, pull: float = 0.0, push: float = 1.0, drag: float = 0.0, units: Mapping[str, float] = UNITS) -> ls.Dynamics:
    numbers = {name: units[name] for name in ("place", "speed", "force")}
    return ls.Dynamics(
        swing, states={"x": "m", "v": "m/s"}, controls={"u": "N"},
        parameters={"pull": pull, "push": push, "drag": drag, **numbers},
    )  # fmt: skip


def problem(
    *constraints: ls.Constraint, dynamics: ls.Dynamics | None = None, start: Any = (0.0, 0.0), goal: Any = (1.0, 0.0),
    effort: float = 1.0, final: Any = (1.0, 1.0), on_the_way: Any = (0.0, 0.0), limit: float = np.inf, steps: int = 15,
    soft: float | None = None, more: ls.Cost | None = None,
) -> ls.Problem:  # fmt: skip
    stage = ls.ControlCost([effort], about=[0.0]) + ls.QuadraticCost(on_the_way, about=goal)
    return ls.Problem(
        dynamics=system() if dynamics is None else dynamics, dt=DT, steps=steps,
        initial=ls.FixedState(start) if soft is None else ls.QuadraticCost([soft, soft], about=start),
        stage_cost=stage, final_cost=ls.QuadraticCost(final, about=goal) if more is None else more,
        constraints=constraints, control_limits=(-limit, limit) if np.isfinite(limit) else None,
    )  # fmt: skip


def solved(of: ls.Problem, **options: Any) -> ls.Solution:
    solution = ls.smooth(of, **options)
    assert solution.status is Status.CONVERGED, solution.summary()
    return solution


def is_optimal(of: ls.Problem, solution: ls.Solution, tolerance: float = 1e-5) -> None:
    found = Shooting(of).conditions(solution)
    assert found.violation <= solution.options["constraint_tolerance"], found  # pyright: ignore[reportOperatorIssue]
    assert found.sign == 0, found
    assert max(found.slope, found.pressing, found.spare) < (tolerance if of.constraints else 1e-3), found


# Whole problems that can be solved: what is asked for is kept by a motion that was drawn first.

decades = st.floats(0, 4).map(lambda power: 10.0**power)


@st.composite
def solvable(draw: st.DrawFn) -> ls.Problem:
    limit = draw(st.sampled_from([np.inf, 2.0, 5.0]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    dynamics = system(
        pull=draw(st.sampled_from([0.0, 4.0])), push=draw(st.floats(0.5, 2)), drag=draw(st.sampled_from([0.0, 0.5]))
    )
    steps, start = draw(st.integers(8, 20)), rng.uniform(-1, 1, 2)
    times = np.arange(steps) * DT
    most = min(limit, 4.0) * 0.9
    controls = most * np.sin(rng.uniform(0.5, 4) * times + rng.uniform(0, 6))[:, None]
    bare = problem(dynamics=dynamics, start=start, steps=steps)
    z = Shooting(bare).points(controls.ravel())
    kept: list[ls.Constraint] = []
    (x, v), u, room = z[:, :2].T, controls[:, 0], draw(st.sampled_from([0.02, 0.3]))
    if draw(st.booleans()):
        kept.append(ls.StateBounds(low={"x": x.min() - room}, high={"v": v.max() + room}))
    if draw(st.booleans()):
        strongest, beside = float((u * v[:-1]).max()) + room, 0.5
        most = float((u**2 + beside * v[:-1] ** 2).max()) + room
        numbers = {"power": strongest, "most": most, "beside": beside, "force": 1.0, "speed": 1.0}
        kept.append(ls.SymbolicConstraint(power, parameters=numbers))
    end = draw(st.sampled_from(["none", "all", "place", "met"]))
    if end == "all":
        kept.append(ls.GoalState(z[-1, :2]))
    elif end == "place":
        kept.append(ls.GoalState([x[-1]], states=["x"]))
    elif end == "met":
        numbers = {"share": 0.3, "bent": 0.2, "place": 1.0, "speed": 1.0}
        there = x[-1] + 0.3 * v[-1] + 0.2 * x[-1] ** 2
        kept.append(ls.SymbolicConstraint(meeting, parameters=numbers | {"there": there}, equality=True, at="final"))
    return problem(
        *kept, dynamics=dynamics, start=start, goal=rng.uniform(-3, 3, 2), steps=steps, limit=limit,
        effort=draw(decades) * 1e-2, final=[draw(decades), draw(decades)],
        on_the_way=[draw(st.sampled_from([0.0, 1.0])), 0.0], soft=draw(st.sampled_from([None, 100.0])),
    )  # fmt: skip


drawn = settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])


@drawn
@given(of=solvable())
def test_what_can_be_solved_is(of: ls.Problem) -> None:
    solution = solved(of)
    is_optimal(of, solution)


@settings(drawn, max_examples=15)
@given(of=solvable(), seed=st.integers(0, 2**32 - 1), size=st.sampled_from([1.0, 10.0]))
def test_what_can_be_solved_is_not_called_infeasible_from_any_start(of: ls.Problem, seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    solution = ls.smooth(of, start=size * rng.normal(size=(of.steps, 1)))
    assert solution.status is not Status.INFEASIBLE, solution.summary()
    if solution.success:
        is_optimal(of, solution)
    states = size * rng.normal(size=(of.steps + 1, 2))
    guess = ls.Trajectory(states, size * rng.normal(size=(of.steps, 1)), DT)
    assert ls.smooth(of, start=guess).status is not Status.INFEASIBLE
