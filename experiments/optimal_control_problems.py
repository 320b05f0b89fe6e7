"""Optimal control problems of two collections, by the default settings and beside IPOPT on the same discretisation.

    python experiments/optimal_control_problems.py                     # all, some minutes
    python experiments/optimal_control_problems.py --problems chain    # one of them
    python experiments/optimal_control_problems.py --quick             # two, on 20 steps

The first six are those of COPS 3, whose published costs are of other discretisations: trapezoids, with controls that
are linear in between, and collocation for `catmix`. The rest, without published costs, are of the twenty of
OptimalControlProblems.jl, which has five of COPS's, too. Here steps are RK4 with constant controls; costs, formulas,
bounds and ends are those of the collections, and a free duration has wide bounds.

IPOPT is called through CasADi, with exact Hessians, from states on the line from start to goal. What is not
installed is left out, and named. Each plan is recomputed apart from both solvers: SciPy integrates it under its
controls, and "exact" is its cost there, "missed" its largest violation of goals and bounds at the knots. A plan that
is CONVERGED and violates them by more than 1e-4 on the steps it was made with is a failure.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from peers import Unavailable
from peers.shooting import Shooting
from runner import Result, Settings, opening, progress, run, table
from scipy.integrate import solve_ivp

import lqrsim as ls
from lqrsim.codegen.symbolic import Vector
from lqrsim.errors import Array

QUICK = ("catmix", "van_der_pol")
LIMIT = 60.0  # s for one solve
ALLOWED = 1e-4  # a violation that rounding and the tolerance of 1e-6 of the solvers do not explain
Formula = Callable[[Any, Any, Any], Any]
Bounds = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A problem of a collection.

    Attributes:
      rate: xdot. start: states and where they begin. goal: where some of them end. controls: and their bounds.
      bounds: of states. running: integrand of the cost; end: the cost of the last state.
      duration: in units of time; the first guess if it is free, within `free`, at a price of `price` per unit.
      mean: the cost has the mean of `running` over the time, in place of its integral.
      steps: of the published value, or of the collection. published: None where none is.
    """

    rate: Formula
    start: Mapping[str, float]
    controls: Bounds
    steps: int
    duration: float
    goal: Mapping[str, float] = field(default_factory=dict)
    bounds: Bounds = field(default_factory=dict)
    running: Formula | None = None
    end: Formula | None = None
    free: tuple[float, float] | None = None
    price: float = 0.0
    mean: bool = False
    published: float | None = None

    def problem(self, steps: int) -> ls.Problem:
        """The problem in so many steps."""
        dynamics = ls.Dynamics(
            self.rate, states=dict.fromkeys(self.start, "1"), controls=dict.fromkeys(self.controls, "1")
        )
        dt = self.duration / steps
        origin = np.zeros(len(self.start))
        nothing = ls.QuadraticCost(origin, about=origin)
        stage: Any = nothing
        if self.running is not None:
            weight, running = 1 / steps if self.mean else dt, self.running
            stage = ls.SymbolicCost(lambda x, u, p: p.weight * running(x, u, p), parameters={"weight": weight})
        end = nothing if self.end is None else ls.SymbolicCost(self.end)
        goal = [ls.GoalState(self.goal)] if self.goal else []
        return ls.Problem(
            dynamics=dynamics, dt=dt, steps=steps, initial=ls.FixedState(list(self.start.values())), stage_cost=stage,
            final_cost=end, control_limits=dict(self.controls), duration=self.free, time_weight=self.price,
            constraints=[*goal, *([ls.StateBounds(dict(self.bounds))] if self.bounds else [])],
        )  # fmt: skip

    def line(self, steps: int) -> tuple[Array, Array]:
        """States on the line from start to goal, and controls amid their bounds, or zero."""
        ends = {**self.start, **self.goal}
        states = np.linspace(list(self.start.values()), [ends[name] for name in self.start], steps + 1)
        middle = [sum(pair) / 2 if np.isfinite(pair).all() else 0.0 for pair in self.controls.values()]
        return states, np.tile(middle, (steps, 1))


def arm(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import sin

    inertia = ((5 - x.rho) ** 3 + x.rho**3) / 3
    turn = u.theta / (inertia * sin(x.phi) ** 2)
    return [x.rho_rate, x.theta_rate, x.phi_rate, u.rho / 5, turn, u.phi / inertia]


def goddard(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import exp

    drag = 310 * x.v**2 * exp(-500 * (x.h - 1))
    return [x.v, (u.thrust - drag) / x.m - 1 / x.h**2, -2 * u.thrust]


def steering(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    return [x.vx, x.vy, 100 * cos(u.angle), 100 * sin(u.angle)]


def glider(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import exp, sqrt

    away = (x.x / 100 - 2.5) ** 2
    sink = x.vy - 2.5 * (1 - away) * exp(-away)
    speed = sqrt(x.vx**2 + sink**2)
    pressure = 0.5 * 1.13 * 14 * speed / 100  # by which a coefficient and a velocity give an acceleration
    lift, drag = pressure * u.lift, pressure * (0.034 + 0.069662 * u.lift**2)
    return [x.vx, x.vy, -lift * sink - drag * x.vx, lift * x.vx - drag * sink - 9.81]


def chain(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import sqrt

    length = sqrt(1 + u.slope**2)
    return [u.slope, x.height * length, length]


def catalyst(x: Any, u: Any, p: Any) -> list[Any]:
    flow = u.mixture * (10 * x.b - x.a)
    return [flow, -flow - (1 - u.mixture) * x.b]


def jackson(x: Any, u: Any, p: Any) -> list[Any]:
    flow, made = u.mixture * (x.a - 10 * x.b), (1 - u.mixture) * x.b
    return [-flow, flow - made, made]


def fan(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    across = (u.side * cos(x.tilt) - u.thrust * sin(x.tilt)) / 2.2
    up = (-4 + u.side * sin(x.tilt) + u.thrust * cos(x.tilt)) / 2.2
    return [x.vx, across, x.vy, up, x.spin, 0.2 * u.side / 0.05]


def lander(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    thrust = u.left + u.right
    return [x.vx, x.vy, -thrust * sin(x.tilt), thrust * cos(x.tilt) - 9.81, x.spin, 5 * (u.right - u.left)]


FREE, UNIT = (-np.inf, np.inf), (-1.0, 1.0)

CASES = {
    "arm": Case(
        rate=arm, steps=200, duration=9.0, free=(1.0, 30.0), price=1.0, published=9.14138,
        start={"rho": 4.5, "theta": 0, "phi": np.pi / 4, "rho_rate": 0, "theta_rate": 0, "phi_rate": 0},
        goal={"rho": 4.5, "theta": 2 * np.pi / 3, "phi": np.pi / 4, "rho_rate": 0, "theta_rate": 0, "phi_rate": 0},
        controls=dict.fromkeys(("rho", "theta", "phi"), UNIT),
        bounds={"rho": (0, 5), "theta": (-np.pi, np.pi), "phi": (0, np.pi)},
    ),
    "goddard": Case(
        rate=goddard, steps=400, duration=0.2, free=(0.05, 1.0), end=lambda x, u, p: -x.h, published=-1.01283,
        start={"h": 1, "v": 0, "m": 1}, goal={"m": 0.6}, controls={"thrust": (0, 3.5)},
        bounds={"h": (1, np.inf), "v": (0, np.inf), "m": (0.6, 1)},
    ),
    "steering": Case(
        rate=steering, steps=200, duration=1.0, free=(0.1, 5.0), price=1.0, published=0.554577,
        start={"x": 0, "y": 0, "vx": 0, "vy": 0}, goal={"y": 5, "vx": 45, "vy": 0},
        controls={"angle": (-np.pi / 2, np.pi / 2)},
    ),
    "glider": Case(
        rate=glider, steps=100, duration=100.0, free=(10.0, 200.0), end=lambda x, u, p: -x.x, published=-1255.05,
        start={"x": 0, "y": 1000, "vx": 13.23, "vy": -1.288}, goal={"y": 900, "vx": 13.23, "vy": -1.288},
        controls={"lift": (0, 1.4)}, bounds={"x": (0, np.inf), "vx": (0, np.inf)},
    ),
    "chain": Case(
        rate=chain, steps=199, duration=1.0, end=lambda x, u, p: x.energy, published=5.06891,
        start={"height": 1, "energy": 0, "length": 0}, goal={"height": 3, "length": 4}, controls={"slope": FREE},
    ),
    "catmix": Case(
        rate=catalyst, steps=100, duration=1.0, end=lambda x, u, p: x.a + x.b - 1, published=-0.0480556,
        start={"a": 1, "b": 0}, controls={"mixture": (0, 1)},
    ),
    "beam": Case(
        rate=lambda x, u, p: [x.slope, u.force], steps=100, duration=1.0, running=lambda x, u, p: u.force**2,
        start={"bend": 0, "slope": 1}, goal={"bend": 0, "slope": -1}, controls={"force": (-10, 10)},
        bounds={"bend": (0, 0.1)},
    ),
    "jackson": Case(
        rate=jackson, steps=100, duration=4.0, end=lambda x, u, p: -x.c, start={"a": 1, "b": 0, "c": 0},
        controls={"mixture": (0, 1)}, bounds=dict.fromkeys("abc", (0, 1.1)),
    ),
    "van_der_pol": Case(
        rate=lambda x, u, p: [x.v, (1 - x.x**2) * x.v - x.x + u.force], steps=100, duration=2.0,
        running=lambda x, u, p: (x.x**2 + x.v**2 + u.force**2) / 2, start={"x": 1, "v": 0}, controls={"force": FREE},
    ),
    "ducted_fan": Case(
        rate=fan, steps=100, duration=1.0, free=(0.1, 5.0), price=1000.0, mean=True,
        running=lambda x, u, p: 2 * u.side**2 + u.thrust**2,
        start={"x": 0, "vx": 0, "y": 0, "vy": 0, "tilt": 0, "spin": 0},
        goal={"x": 1, "vx": 0, "y": 0, "vy": 0, "tilt": 0, "spin": 0},
        controls={"side": (-5, 5), "thrust": (0, 17)}, bounds={"tilt": (-np.pi / 6, np.pi / 6)},
    ),
    "moon_lander": Case(
        rate=lander, steps=100, duration=2.0, free=(0.2, 10.0), price=1.0,
        start={"x": 0, "y": 0, "vx": 0, "vy": 0, "tilt": 0, "spin": 0}, goal={"x": 5, "y": 5, "vx": 0, "vy": 0},
        controls={"left": (0, 19.62), "right": (0, 19.62)},
    ),
    "particle": Case(
        rate=lambda x, u, p: [x.y * u.field - 0.75 * u.field**2, u.field - x.y], steps=100, duration=5.0,
        free=(0.5, 20.0), price=1.0, start={"x": 1, "y": 0}, goal={"x": 2}, controls={"field": UNIT},
    ),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    problems: tuple[str, ...] = tuple(CASES)
    """Which of them."""


def main(config: Config) -> Result:
    unknown = [name for name in config.problems if name not in CASES]
    if unknown:
        raise ls.InputError(f"--problems: got {unknown}, want some of {list(CASES)}")
    names = QUICK if config.quick else config.problems
    rows = [row(name, 20 if config.quick else CASES[name].steps) for name in progress(names, "problems")]
    return opening(config) | {"rows": rows}


def row(name: str, steps: int) -> Result:
    """Both solvers' plans of one problem."""
    case = CASES[name]
    problem = case.problem(steps)
    began = time.process_time()
    solution = ls.smooth(problem, threads=1, time_limit=LIMIT)
    ours = {"status": solution.status.name, "iterations": len(solution.iterations)}
    ours |= {"seconds": time.process_time() - began} | worth(case, problem, solution.trajectory)
    return {"problem": name, "steps": steps, "published": case.published, "ours": ours, "ipopt": ipopt(case, problem)}


def ipopt(case: Case, problem: ls.Problem) -> Result:
    try:
        solver = Shooting(problem, "ipopt", compile=False, max_cpu_time=LIMIT)
    except Unavailable as error:
        return {"skipped": str(error)}
    began = time.process_time()
    answer = solver.solve(problem, *case.line(problem.steps))
    seconds = time.process_time() - began
    plan = ls.Trajectory(answer.states, answer.controls, (answer.duration or case.duration) / problem.steps)
    found = {"status": "solved" if answer.converged else "failed", "iterations": answer.iterations, "seconds": seconds}
    return found | worth(case, problem, plan)


def worth(case: Case, problem: ls.Problem, plan: ls.Trajectory) -> Result:
    """Cost and violation of a plan by its knots, and of its controls in exact time, by NumPy and SciPy."""
    dynamics = problem.dynamics
    names, controls = dynamics.state_coordinates, dynamics.control_coordinates
    exact = [plan.states[0]]
    for u in plan.controls:
        last = solve_ivp(lambda _, z, u=u: dynamics.rate(z, u), (0, plan.dt), exact[-1], rtol=1e-10, atol=1e-12)
        exact.append(last.y[:, -1])
    found: Result = {}
    for label, states in (("", plan.states), ("exact_", np.array(exact))):
        at = {name: states[:, i] for i, name in enumerate(names.names)}
        used = {name: plan.controls[:, i] for i, name in enumerate(controls.names)}
        missed = [np.abs(at[name][-1:] - end) for name, end in case.goal.items()]
        for values, bounds in ((at, case.bounds), (used, case.controls)):
            missed += [side for key, (a, b) in bounds.items() for side in (a - values[key], values[key] - b)]
        cost = case.price * plan.horizon
        if case.end is not None:
            cost += case.end(Vector(states[-1], names.names), None, None)
        if case.running is not None:
            before = Vector(states[:-1].T, names.names)
            cost += np.sum(case.running(before, Vector(plan.controls.T, controls.names), None)) * (
                1 / problem.steps if case.mean else plan.dt
            )
        found |= {label + "cost": float(cost), label + "missed": float(max(0.0, *(one.max() for one in missed), 0.0))}
    return found


def false(result: Result) -> Sequence[str]:
    """The problems whose plan is CONVERGED and misses a goal or a bound."""
    found = [(one["problem"], one["ours"]) for one in result["rows"]]
    return [name for name, ours in found if ours["status"] == "CONVERGED" and ours["missed"] > ALLOWED]


def report(result: Result) -> str:
    lines = []
    for one in result["rows"]:
        told = "" if one["published"] is None else f"{one['published']:.6g}"
        for label, found in (("lqrsim", one["ours"]), ("IPOPT", one["ipopt"])):
            if "skipped" in found:
                continue
            lines.append([
                one["problem"], one["steps"], told, label, found["status"], f"{found['cost']:.6g}",
                found["iterations"], f"{found['seconds']:.2g}", f"{found['missed']:.1g}", f"{found['exact_cost']:.6g}",
                f"{found['exact_missed']:.1g}",
            ])  # fmt: skip
    head = ["problem", "steps", "published", "solver", "status", "cost", "iterations", "s", "missed"]
    text = table([*head, "exact cost", "exact missed"], lines)
    skipped = {one["ipopt"]["skipped"] for one in result["rows"] if "skipped" in one["ipopt"]}
    return "\n\n".join([text, *(f"IPOPT: skipped: {why}" for why in skipped)])


if __name__ == "__main__":
    run(Config, main, report, __doc__, failures=false)
