"""IPOPT through CasADi: direct multiple shooting, as a careful user of CasADi writes it.

The states at t = 1..T and all controls are variables, step by step; the Runge-Kutta steps are equality constraints. The
step and the costs are SX functions, mapped over the steps; derivatives, the Hessian of the Lagrangian among them, are
CasADi's, exact and sparse. IPOPT is as it comes, with MUMPS, on one thread, and stops at its own tolerance (1e-8). The
problem is built once and used for all queries; start and goal are parameters. CasADi either evaluates the expanded
problem in its virtual machine, or writes it as C, which is compiled with -O3 -march=native (some 15 seconds, kept on
disk).
"""

import importlib
import os
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim.errors import Array
from peers.common import FLAGS, Answer, Parts, Unavailable, compiled, ends, line, parts
from peers.truth import rollout

MAX_ITERATIONS = 500


class Ipopt:
    """IPOPT for problems that differ in their start and goal only.

    An answer has converged if IPOPT says that it is solved, if only to its acceptable level.

    Args:
      problem: one of them, of either robot and in any world, with the limits of its controls, and with a Clearance if
        that is its constraint.
      compile: to C and with g++, for speed; the answers differ by rounding.

    Raises:
      Unavailable: CasADi is not installed, or g++ where it is needed.
      NotImplementedError: the problem is of another make.
    """

    def __init__(
        self,
        problem: ls.Problem,
        *,
        compile: bool = False,
    ) -> None:
        margins = [one.margin for one in problem.constraints if isinstance(one, ls.Clearance)]
        margins = [margin for margin in margins if isinstance(margin, float)]
        if len(problem.constraints) > 1 or len(margins) < len(problem.constraints):
            raise NotImplementedError(f"the constraints {problem.constraints}")
        clearance = margins[0] if margins else None
        told, steps = parts(problem), problem.steps
        n, m = len(told.goal), len(told.nominal)
        self._controls = m
        bounds = np.full((2, steps, m + n), [[[-np.inf]], [[np.inf]]])
        bounds[0, :, :m], bounds[1, :, :m] = problem.control_coordinates.low, problem.control_coordinates.high
        self._limits = {"lbx": bounds[0].ravel(), "ubx": bounds[1].ravel(), "lbg": 0.0, "ubg": 0.0}
        nlp = _nlp(problem, told, clearance)
        if clearance is not None:
            # Rows of g, a step at a time: the n gaps of the step, then the obstacles.
            self._limits["ubg"] = np.tile(np.repeat([0.0, np.inf], [n, len(told.world)]), steps)
        # Bounds are kept exactly, and not to 1e-8 as IPOPT has them inside.
        options = {"print_level": 0, "sb": "yes", "max_iter": MAX_ITERATIONS, "honor_original_bounds": "yes"}
        self._solver = solver("ipopt", nlp, {"ipopt": options}, compile=compile)

    def from_hover(self, problem: ls.Problem) -> Answer:
        """Solve from the trajectory of the nominal control."""
        controls = np.tile(problem.nominal_control, (problem.steps, 1))
        return self.from_trajectory(problem, rollout(problem, controls), controls)

    def from_line(self, problem: ls.Problem) -> Answer:
        """Solve from states on the line from start to goal and the nominal control, which do not belong together."""
        return self.from_trajectory(problem, *line(problem))

    def from_trajectory(self, problem: ls.Problem, states: Array, controls: Array) -> Answer:
        """Solve from states (T+1, n) and controls (T, m), whether or not they belong together."""
        start, goal = ends(problem)
        guess = np.hstack([controls, states[1:]]).ravel()
        found = self._solver(x0=guess, p=np.concatenate([start, goal]), **self._limits)
        steps = found["x"].full().reshape(problem.steps, -1)
        stats = self._solver.stats()
        return Answer(
            states=np.vstack([start, steps[:, self._controls :]]),
            controls=steps[:, : self._controls].copy(),
            cost=float(found["f"]),
            iterations=stats["iter_count"],
            converged=bool(stats["success"]),
        )


@cache
def casadi() -> Any:
    """The module. Raises Unavailable where it is not installed."""
    try:
        return importlib.import_module("casadi")
    except ImportError:
        raise Unavailable("CasADi is not installed: pip install 'lqrsim[bench]'") from None


def _nlp(problem: ls.Problem, told: Parts, clearance: float | None) -> dict[str, Any]:
    ca, steps = casadi(), problem.steps
    n, m = len(told.goal), len(told.nominal)
    step, effort, obstacles, arrival, apart = functions(problem, told)
    variables = ca.MX.sym("w", m + n, steps)  # of a step: its control, and the state after it
    start, goal = ca.MX.sym("start", n), ca.MX.sym("goal", n)
    u, after = variables[:m, :], variables[m:, :]
    before = ca.horzcat(start, after[:, :-1])
    cost = ca.sum2(effort.map(steps)(u)) + arrival(after[:, -1], goal)
    if steps > 1:
        cost += ca.sum2(obstacles.map(steps - 1)(after[:, :-1]))
    g = after - step.map(steps)(before, u)
    if clearance is not None:
        g = ca.vertcat(g, apart.map(steps)(after) - clearance)
    return {"x": ca.vec(variables), "p": ca.vertcat(start, goal), "f": cost, "g": ca.vec(g)}


def solver(plugin: str, nlp: dict[str, Any], options: dict[str, Any], *, compile: bool) -> Any:
    """CasADi's function that solves the problem by that plugin; its functions expanded, or compiled from C."""
    return made(plugin, library(plugin, nlp, options) if compile else nlp, options)


def made(plugin: str, source: dict[str, Any] | Path, options: dict[str, Any]) -> Any:
    """CasADi's function that solves a problem, or one that is compiled, by that plugin."""
    options = {**_QUIET, **options}
    if isinstance(source, Path):
        return casadi().nlpsol("solver", plugin, str(source), options)
    return casadi().nlpsol("solver", plugin, source, {"expand": True, **options})


def library(plugin: str, nlp: dict[str, Any], options: dict[str, Any]) -> Path:
    """What the plugin needs of the problem, compiled from C; kept on disk."""
    name = f"{plugin}.c"
    with tempfile.TemporaryDirectory() as folder:
        # CasADi writes to the current folder only.
        here = Path.cwd()
        os.chdir(folder)
        try:
            casadi().nlpsol("solver", plugin, nlp, {**_QUIET, **options}).generate_dependencies(name)
        finally:
            os.chdir(here)
        return compiled(f"{plugin}'s problem (some 15 seconds)", [Path(folder) / name], FLAGS)


_QUIET = {"print_time": False, "show_eval_warnings": False}


def functions(problem: ls.Problem, told: Parts) -> tuple[Any, Any, Any, Any, Any]:
    """CasADi's functions of one step.

    The next state of (x, u), the cost of u, the cost of the obstacles at x, the final cost of (x, goal), and the
    distances (len(world),) of the robot's surface to the obstacles at x.
    """
    ca = casadi()
    n, m, h = len(told.goal), len(told.nominal), problem.dt
    x, u, goal = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("goal", n)
    rate_of = _quadrotor if told.robot == ls.Quadrotor.name else _drive
    rate = ca.Function("rate", [x, u], [rate_of(x, u, told.parameters)])
    first = rate(x, u)
    second = rate(x + h / 2 * first, u)
    third = rate(x + h / 2 * second, u)
    fourth = rate(x + h * third, u)
    after = x + h / 6 * (first + 2 * second + 2 * third + fourth)
    place = x[list(problem.dynamics.state_coordinates.position)]
    place = ca.vertcat(place, *[0.0] * (3 - place.numel()))
    apart = ca.vertcat(*[distance(obstacle, place) - told.radius for obstacle in told.world.obstacles])
    obstacles = told.obstacle_weight * ca.sum1(ca.exp(-told.sharpness * apart))
    effort, arrival = quadratic(told.control_weight, u - told.nominal), quadratic(told.final_weight, x - goal)
    return (
        ca.Function("step", [x, u], [after]),
        ca.Function("effort", [u], [effort]),
        ca.Function("obstacles", [x], [obstacles]),
        ca.Function("arrival", [x, goal], [arrival]),
        ca.Function("apart", [x], [apart]),
    )


def quadratic(weight: Array, off: Any) -> Any:
    ca = casadi()
    return 0.5 * ca.bilin(ca.sparsify(ca.DM(weight)), off, off)


def _drive(x: Any, u: Any, p: dict[str, float]) -> Any:
    ca = casadi()
    speed = (u[0] + u[1]) / 2
    return ca.vertcat(speed * ca.cos(x[2]), speed * ca.sin(x[2]), (u[1] - u[0]) / p["axle_length"])


def _quadrotor(x: Any, u: Any, p: dict[str, float]) -> Any:
    ca = casadi()
    velocity, r, w = x[3:6], x[6:9], x[9:12]
    sine, cosine, cotangent = ratios(ca.sumsqr(r))
    up = ca.vertcat(0, 0, 1)
    tilted = up + sine * ca.cross(r, up) + cosine * ca.cross(r, ca.cross(r, up))
    acceleration = (ca.sum1(u) * tilted - p["drag"] * velocity) / p["mass"] - p["gravity"] * up
    once = ca.cross(r, w)
    torque = ca.vertcat(
        p["arm"] * (u[1] - u[3]), p["arm"] * (u[2] - u[0]), p["torque_ratio"] * (u[0] - u[1] + u[2] - u[3])
    )
    return ca.vertcat(velocity, acceleration, w + once / 2 + cotangent * ca.cross(r, once), torque / p["inertia"])


def ratios(s: Any) -> list[Any]:
    """sin t / t, (1 - cos t) / t^2 and (1 - t/2 cot(t/2)) / t^2 at t^2 = s; below 1/4 by their series."""
    ca = casadi()
    t = ca.sqrt(ca.fmax(s, 0.25))  # both cases are always evaluated, so neither may be singular
    sine, cosine = ca.sin(t) / t, (1 - ca.cos(t)) / (t * t)
    large = sine, cosine, (1 - sine / (2 * cosine)) / (t * t)
    series = (
        [1 / 6, 1 / 20, 1 / 42, 1 / 72, 1 / 110, 1 / 156, 1 / 210],
        [1 / 12, 1 / 30, 1 / 56, 1 / 90, 1 / 132, 1 / 182],
    )
    small = []
    for factors in series:
        value = 1.0
        for factor in reversed(factors):
            value = 1 - factor * s * value
        small.append(value)
    tail = 1 / 47900160 + s * (691 / 1307674368000 + s * (1 / 74724249600 + s * 3617 / 10670622842880000))
    small = small[0], small[1] / 2, 1 / 12 + s * (1 / 720 + s * (1 / 30240 + s * (1 / 1209600 + s * tail)))
    return [ca.if_else(s > 0.25, *pair) for pair in zip(large, small, strict=True)]


def distance(obstacle: ls.Obstacle, place: Any) -> Any:
    """Signed distance in metres; where it has no derivative it has one of zero."""
    ca = casadi()
    local = ca.sparsify(ca.DM(obstacle.rotation.T)) @ (place - obstacle.position)
    side, height = _length(local[:2]), ca.fabs(local[2])
    radius, half, _ = obstacle.size
    match obstacle.kind:
        case "plane":
            return local[2]
        case "sphere":
            return _length(place - obstacle.position) - radius
        case "capsule":
            return _length(ca.vertcat(local[:2], ca.fmax(height - half, 0))) - radius
        case "cylinder" if np.isinf(half):
            return side - radius
        case "cylinder":
            return _outside(ca.vertcat(side - radius, height - half))
    finite = [axis for axis in range(3) if np.isfinite(obstacle.size[axis])]
    return _outside(ca.fabs(local[finite]) - obstacle.size[finite])


def _outside(beyond: Any) -> Any:
    """Distance to a convex body from how far a point is beyond each of its mutually perpendicular faces."""
    ca = casadi()
    return _length(ca.fmax(beyond, 0)) + ca.fmin(ca.mmax(beyond), 0)


def _length(vector: Any) -> Any:
    ca = casadi()
    return ca.sqrt(ca.fmax(ca.sumsqr(vector), 1e-24))
