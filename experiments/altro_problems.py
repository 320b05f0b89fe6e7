"""The benchmark problems of Altro.jl, rebuilt from their published specification: our iterations beside theirs.

    python experiments/altro_problems.py                       # all nine, two minutes, most of it compiling
    python experiments/altro_problems.py --problems acrobot    # some of them
    python experiments/altro_problems.py --quick               # the first two

Altro.jl is an augmented Lagrangian method about iLQR, finished by projected Newton steps. Its tests say how many
iterations each problem takes until constraints are violated by less than 1e-6: those of commit d1b57ce of November
2020, and those of the last commit, 4864df2. Altro.jl is not run here. The models are those of RobotZoo.jl. A solve
begins with the controls that Altro.jl begins with, and for `escape` with its states.

Ours are those of `ls.smooth` with its default settings, all counted, in two columns: until the cost is no higher than
Altro.jl's and nothing is missed by more than 1e-6, and until the optimality is 1e-8. Altro.jl's costs are those of its
plans at the last commit, which are up to a third above the optimum. Where none is known, and where ours is a dearer
optimum, the first column counts to 1.001 times our final cost. Altro.jl's tests set a penalty, its growth and
tolerances for each problem. An iteration of one method is not an iteration of the other. One of ours is a
forward pass, a backward pass and a rollout, or a backward pass and the line search of the interior point; one of theirs
is a backward pass and the rollouts of a line search, or a projected Newton step.

What differs from the specification: the circles of `escape` are kept as distances, and its guess is made of splines
without a bend at the ends. `cartpole` is integrated by RK4, not RK3. `barrel_roll` has limits in place of clamps of the
controls, and of its final quaternion the vector alone is fixed, for the scalar follows from its length.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from altro import models
from altro.airplane import TRIM_CONTROLS, airplane, unclamped
from numpy.typing import NDArray
from runner import FolderSettings, Result, opening, run, table
from scipy.interpolate import CubicSpline
from tqdm import tqdm

import lqrsim as ls
from lqrsim.errors import check_name

VIOLATION = 1e-6  # what counts as kept, theirs and ours
ABOVE = 1.001  # times our final cost: the target where Altro.jl's is not known, or is of a better optimum
Start = NDArray[np.float64] | ls.Trajectory


@dataclass(frozen=True, kw_only=True)
class Case:
    """A problem.

    Attributes:
      make: the problem and what a solve begins with.
      theirs: iterations that the tests of November 2020 want. newest: those of the last commit, in words.
      published: iterations at the last commit, and the cost of the plan that they lead to; None where it is not known.
    """

    make: Callable[[], tuple[ls.Problem, Start]]
    theirs: int
    newest: str
    published: tuple[int, float] | None = None


def problem(
    dynamics: ls.Dynamics,
    seconds: float,
    knots: int,
    start: Any,
    goal: Any,
    weights: tuple[Any, Any, Any],
    **options: Any,
) -> ls.Problem:
    """What most of them are: quadratic costs about the goal, which is to be reached exactly.

    Args:
      weights: of a state and of a control, for a second, and of the end's state.
    """
    dt = seconds / (knots - 1)
    n, m = len(start), len(dynamics.control_coordinates)
    state, control, end = (np.broadcast_to(one, size) for one, size in zip(weights, (n, m, n), strict=True))
    kept = options.pop("constraints", ())
    return ls.Problem(
        dynamics=dynamics,
        dt=dt,
        steps=knots - 1,
        initial=ls.FixedState(start),
        stage_cost=ls.ControlCost(control * dt, about=options.pop("about", np.zeros(m)))
        + ls.QuadraticCost(state * dt, about=goal),
        final_cost=ls.QuadraticCost(end, about=goal),
        constraints=[*kept, *options.pop("end", [ls.GoalState(goal)])],
        **options,
    )


def same(problem: ls.Problem, *controls: float) -> NDArray[np.float64]:
    """The same controls at every step."""
    return np.tile(controls, (problem.steps, 1))


def double_integrator() -> tuple[ls.Problem, Start]:
    bounds = ls.StateBounds(v=(-0.6, 0.6))
    made = problem(
        models.double_integrator(), 2.0, 21, (0, 0), (1, 0), (1.0, 0.1, 1.0), control_limits=(-3, 3),
        constraints=[bounds],
    )  # fmt: skip
    return made, same(made, 0.0)


def pendulum() -> tuple[ls.Problem, Start]:
    made = problem(
        models.pendulum(), 3.0, 51, (0, 0), (np.pi, 0), (1e-3, 1e-3, 1.0), control_limits=(-3, 3)
    )  # fmt: skip
    return made, same(made, 0.1)


def cartpole() -> tuple[ls.Problem, Start]:
    weights = (1e-2, 1e-1, 100.0)
    made = problem(models.cartpole(), 5.0, 101, (0, 0, 0, 0), (0, np.pi, 0, 0), weights, control_limits=(-3, 3))
    return made, same(made, 0.01)


def acrobot() -> tuple[ls.Problem, Start]:
    begin, goal, weights = (-np.pi / 2, 0, 0, 0), (np.pi / 2, 0, 0, 0), (1.0, 0.01, 100.0)
    made = problem(models.acrobot(), 5.0, 101, begin, goal, weights, control_limits=(-15, 15))
    return made, same(made, 0.0)


def parallel_park() -> tuple[ls.Problem, Start]:
    bounds = ls.StateBounds(x=(-0.25, 0.25), y=(-0.001, 1.501))
    made = problem(
        models.car(), 3.0, 101, (0, 0, 0), (0, 1.5, 0), (0.01, 0.01, 100.0), control_limits=(-2, 2),
        constraints=[bounds],
    )  # fmt: skip
    return made, same(made, 0.1, 0.1)


def outside(x: Any, u: Any, p: Any) -> list[Any]:
    """Circles: the square of the distance from each centre less that of the radius."""
    return [(x[0] - at) ** 2 + (x[1] - at) ** 2 - p.radius**2 for at in (p.first, p.second, p.third)]


def three_obstacles() -> tuple[ls.Problem, Start]:
    places = {"first": 0.75, "second": 1.5, "third": 2.25}
    kept = ls.SymbolicConstraint(outside, parameters={**places, "radius": 0.25 + 0.175})
    made = problem(
        models.car(), 5.0, 101, (0, 0, 0), (3, 3, 0), (1.0, 0.5, 10.0), control_limits=((0, -3), (3, 3)),
        constraints=[kept],
    )  # fmt: skip
    return made, same(made, 0.01, 0.01)


CAR = 0.25  # m: of the radius of 0.5 m of the circles in `escape`, what is the car's


def walls() -> ls.World:
    """Rows of circles."""
    places = [(x, y) for x in (0.0, 5.0, 10.0) for y in np.linspace(0, 5, 30)]
    places += [(x, 0.0) for x in np.linspace(0, 10, 50)]
    places += [(x, 5.0) for first in (0, 5) for x in np.linspace(first, first + 3, 15)]
    size = np.array([0.5 - CAR, np.inf, 0])
    return ls.World(
        [ls.Obstacle(f"{i}", "cylinder", np.array([*at, 0]), np.eye(3), size) for i, at in enumerate(places)]
    )


def escape() -> tuple[ls.Problem, Start]:
    made = problem(
        models.car(), 3.0, 101, (2.5, 2.5, 0), (7.5, 2.5, 0), (1e-3, 1e-2, 100.0), control_limits=(-5, 5),
        constraints=[ls.Clearance(walls(), radius=CAR)],
    )  # fmt: skip
    guess = [(2.5, 2.5, 0), (4, 5, 0.785), (5, 6.25, 0), (7.5, 6.25, -0.261), (9, 5, -1.57), (7.5, 2.5, 0)]
    states = CubicSpline(np.linspace(0, 3, 6), guess, bc_type="natural")(np.linspace(0, 3, 101))
    return made, ls.Trajectory(states, same(made, 1.0, 1.0), made.dt)


KNOTS, WAYPOINTS = 101, {32: (10.0, 0.0, 1.0), 65: (-10.0, 0.0, 1.0)}  # numbers of knots, from 0


def passing(x: Any, u: Any, p: Any) -> Any:
    """What is paid at the knots of the waypoints, where it stands in place of what is paid at the others."""
    from sympy import Piecewise

    effort = 1e-4 * sum(entry**2 for entry in u) / 2

    def away(place: tuple[float, ...], position: float, turned: float) -> Any:
        off = sum((x[i] - place[i]) ** 2 for i in range(3))
        tilt = (x[3] - 1) ** 2 + sum(entry**2 for entry in x[4:7])
        return p.dt * (position * off + turned * tilt + 1e-3 * sum(entry**2 for entry in x[7:13])) / 2

    cases = [
        (away(place, 1.0, 1e-3) + effort, (x[13] > knot - 0.5) & (x[13] < knot + 0.5))
        for knot, place in WAYPOINTS.items()
    ]
    return Piecewise(*cases, (away((0, 0, 0), 1e-5, 1e-5) + p.dt * effort, True))


def zigzag() -> tuple[ls.Problem, Start]:
    dt = 5.0 / (KNOTS - 1)
    goal = (0, 10, 1, 1, *[0] * 9, 0)
    made = ls.Problem(
        dynamics=models.quadrotor(dt),
        dt=dt,
        steps=KNOTS - 1,
        initial=ls.FixedState((0, -10, 1, 1, *[0] * 9, 0)),
        stage_cost=ls.SymbolicCost(passing, parameters={"dt": dt}, convex=True),
        final_cost=ls.QuadraticCost((10, 10, 10, 100, 100, 100, 100, *[10] * 6, 0), about=goal),
        control_limits=(0, 12),
    )
    return made, same(made, *[0.5 * models.GRAVITY / 4] * 4)


def quaternion(a: float, b: float, c: float) -> list[float]:
    """Of modified Rodrigues parameters, scalar first."""
    square = a * a + b * b + c * c
    return [(1 - square) / (1 + square), *(2 * entry / (1 + square) for entry in (a, b, c))]


def barrel_roll() -> tuple[ls.Problem, Start]:
    begin = (-3, 0, 1.5, *quaternion(0.997156, 0, 0.075366), 5, 0, 0, 0, 0, 0)
    goal = np.array((3, 0, 1.5, *quaternion(0, -0.0366076, 0), 5, 0, 0, 0, 0, 0))
    end = (*[100.0] * 3, *[500.0] * 4, *[100.0] * 6)
    dynamics = airplane()
    # Of the quaternion its vector: the scalar follows, for it keeps its length.
    rest = dict(zip(dynamics.state_coordinates.names, goal, strict=True))
    del rest["q0"]
    made = problem(
        dynamics, 1.25, 101, begin, goal, (0.1, 1e-3, end), about=TRIM_CONTROLS,
        end=[ls.GoalState(rest)],
    )  # fmt: skip
    return made, same(made, *TRIM_CONTROLS)


CASES = {
    "double_integrator": Case(make=double_integrator, theirs=8, newest="8 or 9", published=(8, 0.74409)),
    "pendulum": Case(make=pendulum, theirs=19, newest="18", published=(17, 0.02455)),
    "cartpole": Case(make=cartpole, theirs=40, newest="41", published=(40, 1.5526)),
    "acrobot": Case(make=acrobot, theirs=50, newest="50", published=(50, 50.052)),
    "parallel_park": Case(make=parallel_park, theirs=13, newest="13", published=(13, 0.05558)),
    "three_obstacles": Case(make=three_obstacles, theirs=20, newest="20", published=(20, 9.4339)),
    "escape": Case(make=escape, theirs=13, newest="14", published=(13, 0.3344)),
    "zigzag": Case(make=zigzag, theirs=15, newest="14"),
    "barrel_roll": Case(make=barrel_roll, theirs=18, newest="20, of another cost"),
}


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    problems: tuple[str, ...] = tuple(CASES)
    """Which of them."""


def main(config: Config) -> Result:
    result = opening(config)
    result["problems"] = {}
    chosen = config.problems[:2] if config.quick else config.problems
    for name in chosen:
        check_name("--problems", name, CASES)
    for name in tqdm(chosen, "solving", unit="problem", leave=False, disable=None):
        case = CASES[name]
        made, start = case.make()
        solution = ls.smooth(made, start=start)
        if name == "barrel_roll" and not unclamped(solution.trajectory):
            raise ls.InputError("barrel_roll: got an angle of attack beyond a right angle, want none: no clamp is here")
        theirs = {"theirs": case.theirs, "newest": case.newest, "published": case.published}
        result["problems"][name] = theirs | outcome(solution, case.published)
    return result


def missed(iteration: ls.types.Iteration) -> float:
    """By how much constraints are missed; of the interior point, whose plans have gaps at first, the dynamics, too."""
    return max(iteration.violation, iteration.gap) if iteration.method == "interior point" else iteration.violation


def outcome(solution: ls.Solution, published: tuple[int, float] | None = None) -> Result:
    """What came of a solve, as JSON; `published` is what is known of Altro.jl's."""
    target = ABOVE * solution.cost if published is None or published[1] < solution.cost else published[1]
    kept = [(number, one) for number, one in enumerate(solution.iterations, 1) if missed(one) < VIOLATION]
    return {
        "status": solution.status.name,
        "target": target,
        "to target": next((number for number, one in kept if one.cost <= target), None) if solution.success else None,
        "iterations": len(solution.iterations),
        "violation": solution.violation,
        "cost": solution.cost,
        "milliseconds": 1e3 * sum(one.seconds for one in solution.iterations),
    }


def good(found: Result) -> bool:
    """Whether a solve succeeded, and was at the target within Altro.jl's iterations."""
    return (
        found["status"] == "CONVERGED" and found["violation"] <= VIOLATION
        and found["to target"] is not None and found["to target"] <= found["theirs"]
    )  # fmt: skip


def report(result: Result) -> str:
    head = (
        "problem", "Altro.jl", "its last commit", "its cost", "lqrsim, to that cost", "to 1e-8", "cost", "violation",
    )  # fmt: skip
    rows = []
    for name, one in result["problems"].items():
        solved = one["status"] == "CONVERGED"
        count = one["iterations"] if solved else one["status"].lower().replace("_", " ")
        cost = "-" if one["published"] is None else f"{one['published'][1]:.5g}"
        first = "-" if one["to target"] is None else one["to target"]
        rows.append(
            (name, one["theirs"], one["newest"], cost, first, count, f"{one['cost']:.5g}", f"{one['violation']:.1e}")
        )
    solved = sum(one["status"] == "CONVERGED" and one["violation"] <= VIOLATION for one in result["problems"].values())
    fewer = sum(map(good, result["problems"].values()))
    return (
        f"{table(head, rows)}\n\nSolved: {solved} of {len(rows)}. "
        f"At Altro.jl's cost in as many iterations as Altro.jl or fewer: in {fewer} of {len(rows)} problems."
    )


if __name__ == "__main__":
    run(Config, main, report, __doc__)
