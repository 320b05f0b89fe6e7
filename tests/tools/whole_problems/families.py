"""Families of problems in which solvers mislead, drawn at random, each with its functions in plain NumPy.

given       Controls, a trajectory, a policy or a solution is given; smoothing alone would leave its optimum.
symmetric   A disc or a bump lies symmetrically on the way: straight through is a saddle.
saturating  A goal that saturates, 1 - exp(-d^2) or d^2 / (1 + d^2); little effort.
flat        Costs without curvature: u^4, no effort, pure feasibility.
overflow    With the nominal control the state overflows or leaves its domain within the horizon.
scales      Costs and states from 1e-8 to 1e8 of the usual size.
time        Least time, without an effort.
contact     A slide of an MJCF that is to push another, with controls that do so, or without.
units       As symmetric, with lengths in units from 1e-6 to 1e6 of the usual.
wide        As symmetric, with limits of 100 to 1e9 that no control reaches.

Each kind has few structures, so that little is compiled; all else is numbers.
"""

import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import sympy
from numpy.random import Generator

import lqrsim as ls
from lqrsim.errors import Array

Formula = Callable[..., Any]  # of states, controls, numbers and a library of functions: NumPy's or SymPy's


@dataclass(frozen=True, eq=False)
class Row:
    """A constraint on states and controls in NumPy: function(x, u) >= 0 or = 0, at all knots or at the last alone."""

    function: Callable[[Array, Array], Array]
    equality: bool
    final: bool


@dataclass(frozen=True, eq=False)
class Case:
    """A problem, what to begin with, and its functions in NumPy, which take complex numbers and batches.

    Attributes:
      rate: of x (n, ...) and u (m, ...). stage, final: costs of a knot. given: what is given as start, None for none.
      model: that of an MJCF, whose steps are MuJoCo's and take neither complex numbers nor batches; None for formulas.
    """

    kind: str
    number: int
    problem: ls.Problem
    rate: Callable[[Array, Array], Sequence[Array]]
    stage: Callable[[Array, Array], Array]
    final: Callable[[Array], Array]
    rows: tuple[Row, ...] = ()
    given: Any = None
    model: mujoco.MjModel | None = None

    def __repr__(self) -> str:
        return f"draw({self.kind!r}, {self.number})"

    @property
    def low(self) -> Array:
        return np.array(self.problem.control_coordinates.low)

    @property
    def high(self) -> Array:
        return np.array(self.problem.control_coordinates.high)

    def roll(self, controls: Array, dt: float | None = None) -> Array:
        """States (T+1, n, ...) under controls (T, m, ...), by RK4 with the controls held."""
        if self.model is not None:
            return _by_mujoco(self.model, controls, self.problem.dt)
        problem, h = self.problem, self.problem.dt if dt is None else dt
        assert isinstance(problem.initial, ls.FixedState)
        start = np.asarray(problem.initial.numbers)
        x = np.broadcast_to(start.reshape(-1, *[1] * (controls.ndim - 2)), (len(start), *controls.shape[2:]))
        states = [x.astype(controls.dtype)]
        with np.errstate(all="ignore"):
            for u in controls:
                states.append(_rk4(self.rate, states[-1], u, h))
        return np.array(states)

    def cost(self, controls: Array, states: Array | None = None) -> Array:
        """The cost of controls (T, m, ...), of one plan or a batch."""
        states = self.roll(controls) if states is None else states
        with np.errstate(all="ignore"):
            total = self.final(states[-1])
            for x, u in zip(states[:-1], controls, strict=True):
                total = total + self.stage(x, u)
        return total + 0 * controls[0, 0]

    def constraints(self, controls: Array, dt: float | None = None) -> tuple[Array, Array]:
        """Values of all inequalities (K, ...) and of all equalities (L, ...), limits of controls left out."""
        states, found, shape = self.roll(controls, dt), {False: [], True: []}, controls.shape[2:]
        for row in self.rows:
            for t in range(len(states)):
                if t == len(states) - 1 or (t > 0 and not row.final):  # a fixed start keeps none
                    u = controls[min(t, len(controls) - 1)]
                    found[row.equality] += list(np.reshape(row.function(states[t], u), (-1, *shape)))
        shape = (0, *shape)
        return tuple(np.array(found[kind]) if found[kind] else np.zeros(shape) for kind in (False, True))  # type: ignore[return-value]


def _by_mujoco(model: mujoco.MjModel, controls: Array, dt: float) -> Array:
    """States (T+1, nq + nv) by MuJoCo's own steps, from its initial state, each from a fresh warm start."""
    data = mujoco.MjData(model)
    states = [np.concatenate([data.qpos - model.qpos0, data.qvel])]
    for control in controls:
        data.ctrl[:] = control
        for _ in range(round(dt / model.opt.timestep)):
            mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos - model.qpos0, data.qvel]))
    return np.array(states)


def _rk4(rate: Callable[[Array, Array], Sequence[Array]], x: Array, u: Array, h: float) -> Array:
    def f(at: Array) -> Array:
        return np.array(np.broadcast_arrays(*rate(at, u)))

    a = f(x)
    b = f(x + h / 2 * a)
    c = f(x + h / 2 * b)
    d = f(x + h * c)
    return x + h / 6 * (a + 2 * b + 2 * c + d)


def draw(kind: str, number: int, *, seed: int = 0) -> Case:
    """The draw of that kind and number, the same whatever else is drawn."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(list(KINDS).index(kind), number)))
    return replace(KINDS[kind](rng), kind=kind, number=number)


class _Numbers(dict):
    """Numbers by name, read as attributes, as formulas get them."""

    __getattr__ = dict.__getitem__


def _case(
    rate: Formula, states: dict[str, str], controls: dict[str, str], *, numbers: dict[str, float],
    start: Sequence[float], dt: float, steps: int, stage: Formula, final: Formula,
    limits: tuple[Any, Any] | None = None, rows: Sequence[tuple[Formula, bool, bool]] = (),
    goal: dict[str, float] | None = None, given: Any = None, unit: float = 1.0, **others: Any,
) -> Case:  # fmt: skip
    """A case of formulas of (x, u, p, library); rows are formulas, whether equalities, and whether at the end only.

    With a unit, lengths and speeds among the states are in 1 / unit metres.
    """
    names = list(states)
    if unit != 1.0:
        long, numbers = [of.startswith("m") for of in states.values()], {**numbers, "unit": unit}
        rate, stage, final = _in_unit(rate, long, is_rate=True), _in_unit(stage, long), _in_unit(final, long)
        rows = [(_in_unit(row, long), equality, last) for row, equality, last in rows]
        start = [unit * number if is_long else number for is_long, number in zip(long, start, strict=True)]
        goal = goal and {name: unit * goal[name] if long[names.index(name)] else goal[name] for name in goal}
    p, none = _Numbers(numbers), np.zeros(len(controls))

    def stated(formula: Formula) -> Any:
        return _named(lambda x, u, p: formula(x, u, p, sympy), formula.__name__)

    def ended(x: Any, u: Any, p: Any, lib: Any) -> Any:
        return final(x, none, p, lib)

    constraints: list[Any] = [
        ls.SymbolicConstraint(
            stated(row), parameters=numbers, equality=equality, **({"at": "final"} if last else {})
        )
        for row, equality, last in rows
    ]  # fmt: skip
    own = [Row(lambda x, u, row=row: row(x, u, p, np), equality, last) for row, equality, last in rows]
    if goal is not None:
        constraints.append(ls.GoalState(goal))
        places = [names.index(name) for name in goal]
        own += [
            Row(lambda x, u, i=i, value=value: x[i] - value, equality=True, final=True)
            for i, value in zip(places, goal.values(), strict=True)
        ]
    problem = ls.Problem(
        dynamics=ls.Dynamics(stated(rate), states=states, controls=controls, parameters=numbers), dt=dt, steps=steps,
        initial=ls.FixedState(start), stage_cost=ls.SymbolicCost(stated(stage), parameters=numbers),
        final_cost=ls.SymbolicCost(stated(ended), parameters=numbers), control_limits=limits, constraints=constraints,
        **others,
    )  # fmt: skip
    return Case(
        kind="", number=0, problem=problem, rate=lambda x, u: rate(x, u, p, np),
        stage=lambda x, u: stage(x, u, p, np), final=lambda x: final(x, none, p, np), rows=tuple(own), given=given,
    )  # fmt: skip


def _in_unit(formula: Formula, long: list[bool], *, is_rate: bool = False) -> Formula:
    """A formula of states some of which are multiples `p.unit` of its own, as are then rates of these."""

    def scaled(x: Any, u: Any, p: Any, lib: Any) -> Any:
        found = formula([x[i] / p.unit if is_long else x[i] for i, is_long in enumerate(long)], u, p, lib)
        return (
            [p.unit * one if is_long else one for is_long, one in zip(long, found, strict=True)] if is_rate else found
        )

    return _named(scaled, formula.__name__)


def _named(function: Any, name: str) -> Any:
    function.__name__ = name
    return function


def _log(rng: Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


# Systems.

_CART: dict[str, Any] = {"states": {"q": "m", "v": "m/s"}, "controls": {"f": "N"}}
_PLANE: dict[str, Any] = {"states": {"x": "m", "y": "m"}, "controls": {"a": "m/s", "b": "m/s"}}


def cart(x: Any, u: Any, p: Any, lib: Any) -> list[Any]:
    return [x[1], u[0] - p.drag * x[1]]


def plane(x: Any, u: Any, p: Any, lib: Any) -> list[Any]:
    return [u[0], u[1]]


def car(x: Any, u: Any, p: Any, lib: Any) -> list[Any]:
    return [u[0] * lib.cos(x[2]), u[0] * lib.sin(x[2]), u[1]]


def effort(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return p.effort / 2 * sum(one * one for one in u)


def nothing(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return 0 * u[0]


def quartic(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return p.effort * sum(one**4 for one in u)


def gauss(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return p.weight * (1 - lib.exp(-p.sharp * (x[0] - p.goal) ** 2)) + p.rest / 2 * x[1] ** 2


def rational(x: Any, u: Any, p: Any, lib: Any) -> Any:
    d = p.sharp * (x[0] - p.goal) ** 2
    return p.weight * d / (1 + d) + p.rest / 2 * x[1] ** 2


def square(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return p.weight / 2 * ((x[0] - p.goal) ** 2 + p.rest * x[1] ** 2)


def _pushes(rng: Generator, steps: int, size: float, m: int = 1) -> Array:
    """Controls that push one way, then the other."""
    first = np.arange(steps)[:, None] < steps * rng.uniform(0.3, 0.7)
    return np.where(first, size * rng.uniform(0.5, 1.5, m), -size * rng.uniform(0.5, 1.5, m))


def saturating(rng: Generator) -> Case:
    goal = float(rng.uniform(0.3, 2.0) * rng.choice([-1, 1]))
    numbers = {
        "drag": float(rng.choice([0.0, 0.3])), "effort": _log(rng, 1e-4, 0.1), "weight": _log(rng, 1.0, 1e4),
        "sharp": _log(rng, 0.3, 100.0), "goal": goal, "rest": float(rng.choice([0.0, 1.0])),
    }  # fmt: skip
    final = (gauss, rational)[int(rng.integers(2))]
    steps, dt = int(rng.integers(15, 45)), float(rng.uniform(0.04, 0.1))
    case = _case(cart, **_CART, numbers=numbers, start=[0.0, 0.0], dt=dt, steps=steps, stage=effort, final=final)
    if rng.random() < 0.7:  # controls that lead somewhere near the goal
        controls = _pushes(rng, steps, 1.0)
        end = case.roll(controls)[-1, 0]
        near = goal + float(rng.normal()) * numbers["sharp"] ** -0.5
        return replace(case, given=controls * (near / end if abs(end) > 1e-3 else 1.0))
    return case


def bump(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return p.effort / 2 * sum(one * one for one in u) + p.height * lib.exp(
        -((x[0] - p.at) ** 2 + x[1] ** 2) / (2 * p.radius**2)
    )


def arrive(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return p.weight / 2 * ((x[0] - p.goal) ** 2 + x[1] ** 2)


def outside(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return (x[0] - p.at) ** 2 + x[1] ** 2 - p.radius**2


def symmetric(rng: Generator, *, unit: float = 1.0, limits: tuple[float, float] | None = None) -> Case:
    goal, radius = float(rng.uniform(0.8, 2.0)), float(rng.uniform(0.1, 0.35))
    numbers = {
        "effort": _log(rng, 1e-2, 1.0), "goal": goal, "at": goal * float(rng.uniform(0.4, 0.6)), "radius": radius,
        "height": _log(rng, 0.01, 10.0), "weight": _log(rng, 1.0, 100.0), "drag": 0.0,
    }  # fmt: skip
    steps, dt = int(rng.integers(10, 30)), 0.1
    kind = int(rng.integers(3))
    common: dict[str, Any] = {
        "numbers": numbers,
        "dt": dt,
        "steps": steps,
        "final": arrive,
        "unit": unit,
        "limits": limits,
    }
    ends = {"x": goal, "y": 0.0} if rng.random() < 0.5 else None
    if kind == 2:  # beside an angle of usual size, small lengths have no size of their own
        common["unit"] = max(unit, 1.0)
    if kind == 0:
        return _case(plane, **_PLANE, **common, start=[0.0, 0.0], stage=bump, goal=ends)
    if kind == 1:
        return _case(
            plane, **_PLANE, **common, start=[0.0, 0.0], stage=effort, rows=[(outside, False, False)], goal=ends
        )
    return _case(
        car, {"x": "m", "y": "m", "theta": "rad"}, {"v": "m/s", "w": "rad/s"}, **common, start=[0.0, 0.0, 0.0],
        stage=effort, rows=[(outside, False, False)], goal=ends,
    )  # fmt: skip


def units(rng: Generator) -> Case:
    return symmetric(rng, unit=float(10 ** rng.uniform(-6, 6)))


def wide(rng: Generator) -> Case:
    far = float(10 ** rng.uniform(2, 9))
    return symmetric(rng, limits=(-far if rng.random() < 0.5 else -50.0, far))


def flat(rng: Generator) -> Case:
    numbers = {
        "drag": float(rng.choice([0.0, 0.3])), "effort": _log(rng, 1e-3, 1.0), "weight": _log(rng, 1.0, 1e3),
        "goal": float(rng.uniform(-2, 2)), "rest": float(rng.choice([0.0, 1.0])),
    }  # fmt: skip
    limits = (-_log(rng, 1.0, 10.0), _log(rng, 1.0, 10.0)) if rng.random() < 0.5 else None
    stage = (quartic, nothing)[int(rng.integers(2))]
    two = rng.random() < 0.4
    states, controls = _CART["states"], {"f": "N", "g": "N"} if two else {"f": "N"}
    rate = pair if two else cart
    goal = {"q": numbers["goal"]} if rng.random() < 0.3 else None
    return _case(
        rate, states, controls, numbers=numbers, start=[0.0, float(rng.choice([0.0, 0.5]))],
        dt=float(rng.uniform(0.05, 0.15)), steps=int(rng.integers(3, 35)), stage=stage, final=square, limits=limits,
        goal=goal,
    )  # fmt: skip


def pair(x: Any, u: Any, p: Any, lib: Any) -> list[Any]:
    return [x[1], u[0] + u[1] - p.drag * x[1]]


def escape(x: Any, u: Any, p: Any, lib: Any) -> list[Any]:
    return [p.a * x[0] ** 2 + u[0]]


def tank(x: Any, u: Any, p: Any, lib: Any) -> list[Any]:
    return [-p.a * lib.sqrt(x[0]) + u[0]]


def grow(x: Any, u: Any, p: Any, lib: Any) -> list[Any]:
    return [lib.exp(p.a * x[0]) + u[0]]


def level(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return p.weight / 2 * (x[0] - p.goal) ** 2


def overflow(rng: Generator) -> Case:
    rate = (escape, tank, grow)[int(rng.integers(3))]
    numbers = {"a": float(rng.uniform(0.6, 2.0)), "effort": _log(rng, 1e-3, 0.1), "weight": _log(rng, 1.0, 1e3)}
    limits, horizon = (-6.0, 6.0), 2.5
    numbers["goal"] = float(rng.uniform(-0.5, 0.3))
    if rate is tank:
        empty = 2.0 / numbers["a"]  # seconds until it is, without an inflow
        limits, horizon, numbers["goal"] = (
            (0.0, 2.5),
            empty * float(rng.uniform(1.05, 2.0)),
            float(rng.uniform(0.3, 1.5)),
        )
    steps = int(rng.integers(30, 70))
    kind = rng.integers(3)
    rows = [(lambda x, u, p, lib: x[0] + (0.0 if rate is tank else 3.0), False, False)] if kind == 1 else []
    return _case(
        rate, {"q": "m"}, {"f": "m/s"}, numbers=numbers, start=[1.0], dt=horizon / steps, steps=steps, stage=effort,
        final=level, limits=limits, rows=rows, goal={"q": numbers["goal"]} if kind == 2 else None,
    )  # fmt: skip


def pendulum(x: Any, u: Any, p: Any, lib: Any) -> list[Any]:
    return [x[1], p.size * (-9.81 * lib.sin(x[0] / p.size) + u[0] / p.force) - p.drag * x[1]]


def turn(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return p.weight / 2 * (((x[0] - p.goal) / p.size) ** 2 + p.rest * (x[1] / p.size) ** 2)


def torque(x: Any, u: Any, p: Any, lib: Any) -> Any:
    return p.effort / 2 * (u[0] / p.force) ** 2


def scales(rng: Generator, *, sized: bool = True) -> Case:
    size, force, money = (float(10 ** rng.uniform(-8, 8)) if sized and rng.random() < 0.5 else 1.0 for _ in range(3))
    numbers = {
        "size": size, "force": force, "drag": 0.1, "effort": money * _log(rng, 1e-2, 1.0),
        "weight": money * _log(rng, 10.0, 1e3), "goal": size * float(rng.uniform(-3, 3)), "rest": 0.1,
    }  # fmt: skip
    limits = (-force * 20.0, force * 20.0) if rng.random() < 0.4 else None
    goal = {"q": numbers["goal"]} if rng.random() < 0.3 else None
    return _case(
        pendulum, {"q": "m", "v": "m/s"}, {"f": "N"}, numbers=numbers, start=[0.0, 0.0], dt=0.05,
        steps=int(rng.integers(20, 50)), stage=torque, final=turn, limits=limits, goal=goal,
    )  # fmt: skip


def bead(x: Any, u: Any, p: Any, lib: Any) -> list[Any]:
    return [x[2] * lib.sin(u[0]), -x[2] * lib.cos(u[0]), p.g * lib.cos(u[0])]


def time(rng: Generator) -> Case:
    steps = int(rng.integers(20, 80))
    if rng.random() < 0.5:
        g, far, deep = float(rng.uniform(1.0, 20.0)), float(rng.uniform(2.0, 12.0)), float(rng.uniform(2.0, 8.0))
        numbers = {"g": g, "effort": 0.0, "weight": 1.0, "goal": far}
        guess = float(np.sqrt(2 * np.hypot(far, deep) ** 2 / (g * deep)))
        return _case(
            bead, {"x": "m", "y": "m", "v": "m/s"}, {"slope": "rad"}, numbers=numbers, start=[0.0, 10.0, 0.0],
            dt=guess / steps, steps=steps, stage=nothing, final=level,
            limits=(0.0, np.pi), goal={"x": far, "y": 10.0 - deep}, duration=(0.2 * guess, 4 * guess), time_weight=1.0,
        )  # fmt: skip
    way, push = float(rng.uniform(0.3, 5.0)), float(rng.uniform(0.5, 5.0))
    numbers = {"drag": float(rng.choice([0.0, 0.3])), "effort": 0.0, "weight": 1.0, "goal": way, "rest": 0.0}
    guess = 2.0 * float(np.sqrt(way / push)) * float(rng.uniform(1.1, 1.6))
    return _case(
        cart, **_CART, numbers=numbers, start=[0.0, 0.0], dt=guess / steps, steps=steps, stage=nothing, final=square,
        limits=(-push, push), goal={"q": way, "v": 0.0}, duration=(0.2 * guess, 4 * guess), time_weight=1.0,
    )  # fmt: skip


def pushed(rng: Generator) -> Case:
    """A pendulum of usual size: constraints have tolerances in their units, within which a given plan may miss them."""
    return scales(rng, sized=False)


def given(rng: Generator) -> Case:
    """A saturating goal, a bump on the way, or an escape, with a plan that is good already."""
    base = (saturating, symmetric, pushed)[int(rng.integers(3))](rng)
    problem, m = base.problem, len(base.low)
    kind = int(rng.integers(4))
    low, high = np.maximum(base.low, -1e300), np.minimum(base.high, 1e300)
    if base.given is not None:
        controls = np.clip(base.given, low, high)
    else:
        size = numbers_size(base)
        controls = np.clip(size * np.cumsum(rng.normal(size=(problem.steps, m)), axis=0) / 5, low, high)
    given: Any = controls
    states = base.roll(controls)
    if kind == 1:
        given = ls.Trajectory(states, controls, problem.dt)
    elif kind == 2:
        # A policy about the plan, with gains that are not those of an optimum.
        gain = 0.0 * rng.normal(size=(problem.steps, m, states.shape[1]))
        given = ls.AffinePolicy(
            gain=gain,
            offset=controls,
            nominal=states[:-1],
            dt=problem.dt,
            state_coordinates=problem.dynamics.state_coordinates,
            control_coordinates=problem.control_coordinates,
        )
    elif kind == 3:
        given = ls.ilqr(replace(problem, constraints=()), start=controls, max_iterations=int(rng.integers(1, 20)))
    return replace(base, given=given)


def contact(rng: Generator) -> Case:
    away, heavy, light = float(rng.uniform(0.03, 0.12)), float(rng.uniform(0.1, 1.0)), float(rng.uniform(0.1, 1.0))
    xml = f"""<mujoco model="pushing"><option timestep="0.01" integrator="implicitfast" gravity="0 0 0"/><worldbody>
      <body name="pusher" pos="{-0.08 - away:.4f} 0 0"><joint name="a" type="slide" axis="1 0 0" damping="1"/>
        <geom type="sphere" size="0.02" mass="{heavy:.4f}"/></body>
      <body name="pushed"><joint name="b" type="slide" axis="1 0 0" damping="{rng.uniform(1, 4):.4f}"/>
        <geom type="box" size="0.06 0.06 0.06" mass="{light:.4f}"/></body></worldbody>
      <actuator><motor name="f" joint="a" ctrlrange="-4 4" ctrllimited="true"/></actuator></mujoco>"""
    folder = Path(tempfile.gettempdir()) / f"lqrsim-pushing-{os.getpid()}"
    folder.mkdir(exist_ok=True)
    path = folder / "pushing.xml"
    path.write_text(xml)
    robot, goal = ls.MjcfRobot(path), float(rng.uniform(0.1, 0.4))
    shutil.rmtree(folder)
    numbers, steps = {"effort": 0.01, "weight": 1000.0, "rest": 10.0}, int(rng.integers(25, 50))
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=0.04, steps=steps, initial=ls.FixedState(np.zeros(4)),
        stage_cost=ls.ControlCost([numbers["effort"]]),
        final_cost=ls.QuadraticCost({"b": numbers["weight"], "b_velocity": numbers["rest"]}, about={"b": goal}),
        control_limits=(-4, 4),
    )  # fmt: skip
    case = Case(
        "", 0, problem, rate=lambda x, u: [], stage=lambda x, u: numbers["effort"] / 2 * u[0] ** 2,
        final=lambda x: numbers["weight"] / 2 * (x[1] - goal) ** 2 + numbers["rest"] / 2 * x[3] ** 2,
        model=mujoco.MjModel.from_xml_string(xml),
    )  # fmt: skip
    if rng.random() < 0.3:
        return case
    push = float(rng.uniform(0.3, 2.0))
    controls = np.where(np.arange(steps)[:, None] < steps * rng.uniform(0.5, 1.0), push, 0.0)
    given: Any = controls
    if rng.random() < 0.5:
        given = ls.Trajectory(case.roll(controls), controls, problem.dt)
    return replace(case, given=given)


def numbers_size(case: Case) -> float:
    """A typical control: that of the limits, or of the force of a pendulum."""
    parameters = case.problem.dynamics.parameters
    return float(parameters["force"]) if "force" in parameters else 1.0


KINDS: dict[str, Callable[[Generator], Case]] = {
    "given": given, "symmetric": symmetric, "saturating": saturating, "flat": flat, "overflow": overflow,
    "scales": scales, "time": time, "contact": contact,
    "units": units, "wide": wide,
}  # fmt: skip
