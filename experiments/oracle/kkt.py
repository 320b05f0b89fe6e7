"""An independent check that a plan satisfies the first-order conditions of its problem, in plain NumPy.

Nothing of the package's solvers, kernels, integration, derivatives or distances is used. What a problem says (its
formulas, weights, obstacles) is evaluated anew: formulas through SymPy's `lambdify`, distances from geometry. First
derivatives are complex steps, good to rounding; second ones are central differences of those.

About the plan the problem is modelled by linear dynamics and a cost whose Hessian is that of the true cost, negative
curvature removed stage by stage. The least of that model is found from its KKT system, banded, by LU with pivoting:
neither a Riccati recursion nor a smoother. For a linear-quadratic problem the model is the problem, and the solution
exact.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.linalg import solve_banded

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.parts import Cost, terms_of

Values = Any  # an array of real or complex numbers
Rate = Callable[[list[Values], list[Values], Any], list[Any]]
Function = Callable[[Values], Values]  # of points (..., size) to values (...)


@dataclass(frozen=True)
class Report:
    """What there is to say of a plan.

    Attributes:
      cost: recomputed from the plan's states and controls.
      scale: what the curved part of the cost would be if nothing in it cancelled; rounding is a share of this.
      residual: largest error of a step of the plan: each state relative to its range along the plan, at least 1.
      decrease: what the model predicts that can still be saved, 1/2 g'H^-1 g with the reduced gradient and Hessian, as
        a share of the cost. This is what CONVERGED promises to be below the tolerance. Where the least cost is zero,
        there is nothing to take a share of but rounding: states and controls are asked for ten digits, and no more.
      stationarity: size of the reduced gradient relative to the terms it is the sum of: how well they cancel.
      states, controls: the least of the model; for a linear-quadratic problem the optimum.
    """

    cost: float
    scale: float
    residual: float
    decrease: float
    stationarity: float
    states: Array
    controls: Array


def check(problem: ls.Problem, solution: ls.Solution, rate: Rate | None = None) -> Report:
    """Look at a solution. `rate` is xdot in NumPy, for dynamics that are more than a formula of SymPy's."""
    plan, gain = solution.trajectory, solution.policy.gain
    n, z = plan.states.shape[1], np.hstack([plan.states[:-1], plan.controls])
    arrived, jacobian = step_jacobian(rate_of(problem, rate), z, n, numbers_of(problem), problem.dt)
    A, B, defect = jacobian[..., :n], jacobian[..., n:], arrived - plan.states[1:]
    stage, gradient, hessian = cost_model(problem, problem.stage_cost, z, n, first=0)
    end, end_slope, end_curve = (
        part[0] for part in cost_model(problem, problem.final_cost, plan.states[-1:], n, first=-1)
    )
    if fixed := isinstance(problem.initial, ls.FixedState):
        start, start_slope, start_curve = 0.0, np.zeros(n), np.zeros((n, n))
    else:
        initial: Cost = problem.initial  # pyright: ignore[reportAssignmentType]
        start, start_slope, start_curve = (
            part[0] for part in cost_model(problem, initial, plan.states[:1], n, first=0)
        )
    cost = stage.sum() + start + end
    hessian[0, :n, :n] += start_curve
    gradient[0, :n] += start_slope
    dx, du = _least(A, B, defect, hessian, gradient, end_curve, end_slope, fixed=fixed)
    # In this form it is a sum of squares: nothing cancels. It is 1/2 g'H^-1 g where the dynamics are met.
    dz = np.hstack([dx[:-1], du])
    saved = 0.5 * np.einsum("ti,tij,tj->", dz, hessian, dz) + 0.5 * dx[-1] @ end_curve @ dx[-1]
    scale = 0.5 * np.einsum("ti,tij,tj->", np.abs(z), np.abs(hessian), np.abs(z))
    scale += 0.5 * np.abs(plan.states[-1]) @ np.abs(end_curve) @ np.abs(plan.states[-1])
    return Report(
        cost=float(cost),
        scale=float(scale),
        residual=_residual(plan, arrived),
        decrease=float(saved / (abs(cost) + 1e-26 * scale + 1e-300)),
        stationarity=_stationarity(A, B, gain, gradient, hessian, start_slope, end_slope, end_curve, fixed=fixed),
        states=plan.states + dx,
        controls=plan.controls + du,
    )


def recompute(problem: ls.Problem, plan: ls.Trajectory, rate: Rate | None = None) -> tuple[float, float]:
    """Cost and residual alone, of plans that may be too far out for anything more."""
    n, z = plan.states.shape[1], np.hstack([plan.states[:-1], plan.controls])
    with np.errstate(all="ignore"):
        cost = cost_values(problem, problem.stage_cost, z, n, first=0).sum()
        cost += cost_values(problem, problem.final_cost, plan.states[-1:], n, first=-1)[0]
        if not isinstance(problem.initial, ls.FixedState):
            cost += cost_values(problem, problem.initial, plan.states[:1], n, first=0)[0]
        arrived = step(rate_of(problem, rate), z[:, :n], z[:, n:], numbers_of(problem), problem.dt)
        return float(cost), _residual(plan, arrived)


def _residual(plan: ls.Trajectory, arrived: Array) -> float:
    return float((np.abs(arrived - plan.states[1:]) / np.maximum(np.ptp(plan.states, axis=0), 1.0)).max())


def _stationarity(
    A: Array,
    B: Array,
    gain: Array,
    gradient: Array,
    hessian: Array,
    start: Array,
    end: Array,
    end_curve: Array,
    *,
    fixed: bool,
) -> float:
    """The adjoint recursion, and how far from zero the slopes in the controls and in a free first state are.

    Later controls respond with the gains, as they do on the robot: the slopes in the offsets of the policy. They are
    zero where the slopes in the controls are, and rounding does not grow along an unstable motion.

    Each slope is a sum of two terms, that of the cost of the control (or start) itself and that of all it leads to,
    which cancel at an optimum. Slopes have units, and are large where little moves much: r'H^-1 r, with the second
    derivative H of the cost in this one offset while all others are held, is a cost. The root of the sum of these,
    relative to that of the terms, has no unit.
    """
    n, costate, curve, left, terms = A.shape[1], end, end_curve, 0.0, 0.0

    def add(own: Array, rest: Array, curve: Array) -> None:
        nonlocal left, terms
        inverse = np.linalg.pinv(curve, hermitian=True)
        left += (own + rest) @ inverse @ (own + rest)
        terms += own @ inverse @ own + rest @ inverse @ rest

    for t in range(len(A) - 1, -1, -1):
        add(gradient[t, n:], B[t].T @ costate, hessian[t, n:, n:] + B[t].T @ curve @ B[t])
        closed, both = A[t] + B[t] @ gain[t], np.vstack([np.eye(n), gain[t]])
        costate = closed.T @ costate + both.T @ gradient[t]
        curve = closed.T @ curve @ closed + both.T @ hessian[t] @ both
    if not fixed:
        add(start, costate - start, curve)
    return float(np.sqrt(left / max(terms, 1e-300)))


# The model about a plan.


def step(rate: Rate, x: Values, u: Values, p: tuple[float, ...], dt: float) -> Values:
    """One Runge-Kutta step of states (..., n) under controls (..., m)."""
    controls = list(np.moveaxis(u, -1, 0))

    def f(x: Values) -> Values:
        rates = rate(list(np.moveaxis(x, -1, 0)), controls, p)
        return np.stack([np.broadcast_to(entry, x.shape[:-1]) for entry in rates], axis=-1)

    k1 = f(x)
    k2 = f(x + dt / 2 * k1)
    k3 = f(x + dt / 2 * k2)
    k4 = f(x + dt * k3)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def step_jacobian(rate: Rate, z: Array, n: int, p: tuple[float, ...], dt: float) -> tuple[Array, Array]:
    """The step from each of the points (T, n+m), and its Jacobian (T, n, n+m), by complex steps."""
    tiny = 1e-30
    moved = z + 1j * tiny * np.eye(z.shape[1])[:, None, :]  # (n+m, T, n+m): moved along each entry in turn
    x = step(rate, moved[..., :n], moved[..., n:], p, dt)
    return x[0].real, np.moveaxis(x.imag, 0, -1) / tiny


def functions_of(problem: ls.Problem, cost: Cost, n: int, size: int, first: int) -> Iterator[tuple[Any, ...]]:
    """Of each term: a function of some entries of the points, which entries, the first point it acts at, convexity."""
    for term in terms_of(cost):
        if isinstance(term, ls.QuadraticCost | ls.ControlCost):
            place = range(n) if isinstance(term, ls.QuadraticCost) else range(n, size)
            yield partial(_quadratic, term), list(place), 0, True
        elif isinstance(term, ls.ObstacleCost):
            # It does not act on the first state.
            place = problem.dynamics.state_coordinates.position
            yield partial(_obstacles, term), list(place), int(first == 0), False
        elif isinstance(term, ls.SymbolicCost):
            formula = _formula_cost(term, n, size, len(problem.dynamics.control_coordinates))
            yield formula, list(range(size)), 0, term.convex
        else:
            raise TypeError(f"no check for {term.name}")


def cost_values(problem: ls.Problem, cost: Cost, z: Array, n: int, *, first: int) -> Array:
    """Values (k,) of a sum of costs at points (k, size), as `cost_model`."""
    value = np.zeros(len(z))
    for function, place, skip, _ in functions_of(problem, cost, n, z.shape[1], first):
        value[skip:] += function(z[skip:][:, place])
    return value


def cost_model(problem: ls.Problem, cost: Cost, z: Array, n: int, *, first: int) -> tuple[Array, Array, Array]:
    """Value (k,), gradient (k, size) and convex Hessian (k, size, size) of a sum of costs at points (k, size).

    The points are of the states alone, or of states and controls; `first` is the step that the first of them is at.
    """
    count, size = z.shape
    gradient, hessian = np.zeros((count, size)), np.zeros((count, size, size))
    bent = np.zeros((count, size, size))
    for function, place, skip, convex in functions_of(problem, cost, n, size, first):
        slope, curve = _differentiate(function, z[skip:][:, place])
        gradient[skip:, place] += slope
        (hessian if convex else bent)[np.ix_(range(skip, count), place, place)] += curve
    values, vectors = np.linalg.eigh(bent)
    hessian += vectors * np.maximum(values, 0)[:, None, :] @ np.swapaxes(vectors, 1, 2)
    return cost_values(problem, cost, z, n, first=first), gradient, hessian


def _differentiate(function: Function, z: Array) -> tuple[Array, Array]:
    """Gradient and Hessian at points (k, size): complex steps, and central differences of complex steps."""
    tiny, small, axes = 1e-30, 1e-5, np.eye(z.shape[1])

    def gradient(z: Array) -> Array:
        along = axes.reshape(-1, *(1,) * (z.ndim - 1), len(axes))
        return np.moveaxis(function(z + 1j * tiny * along).imag, 0, -1) / tiny

    moved = small * axes[:, None, :]
    curve = np.moveaxis(gradient(z + moved) - gradient(z - moved), 0, -1) / (2 * small)
    return gradient(z), (curve + np.swapaxes(curve, -1, -2)) / 2


# What a problem says, in NumPy.


@cache
def numeric(function: Any, n: int, m: int, parameters: tuple[str, ...], several: bool) -> Any:
    """A user's formula `function(x, u, p)` as a function of arrays: its entries, or its only one."""
    import sympy

    x, u, p = sympy.symbols(f"x:{n}"), sympy.symbols(f"u:{m}"), sympy.symbols([f"p_{name}" for name in parameters])
    namespace = type("Parameters", (), {})()
    for name, symbol in zip(parameters, p, strict=True):
        setattr(namespace, name, symbol)
    formula = function(x, u, namespace)
    modules = [{"atan2": _atan2}, "numpy"]
    return sympy.lambdify([x, u, p], list(formula) if several else formula, modules=modules, cse=True)


def _atan2(y: Values, x: Values) -> Values:
    """The angle, with its complex step, which NumPy's `arctan2` does not have."""
    angle = np.arctan2(np.real(y), np.real(x))
    if not (np.iscomplexobj(y) or np.iscomplexobj(x)):
        return angle
    turned = np.real(x) * np.imag(y) - np.real(y) * np.imag(x)
    return angle + 1j * turned / (np.real(x) ** 2 + np.real(y) ** 2)


def rate_of(problem: ls.Problem, rate: Rate | None) -> Rate:
    dynamics = problem.dynamics
    if rate is not None:
        return rate
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    return numeric(dynamics.f, n, m, tuple(dynamics.parameters), True)


def numbers_of(problem: ls.Problem) -> tuple[float, ...]:
    return tuple(problem.dynamics.parameters.values())


def _quadratic(cost: ls.QuadraticCost | ls.ControlCost, z: Values) -> Values:
    about, weight = quadratic_at(cost, z.shape[-2])
    return 0.5 * np.einsum("...i,...ij,...j->...", z - about, weight, z - about)


def quadratic_at(cost: ls.QuadraticCost | ls.ControlCost, count: int) -> tuple[Array, Array]:
    """Reference and weight at the first points: (count, n) and (count, n, n), or (n,) and (n, n) if always the same."""
    about, weight = cost.about, cost.weight
    return about[:count] if about.ndim == 2 else about, weight[:count] if weight.ndim == 3 else weight


def _formula_cost(cost: ls.SymbolicCost, n: int, size: int, m: int) -> Function:
    formula = numeric(cost.function, n, m, tuple(cost.parameters), False)
    numbers = tuple(cost.parameters.values())

    def function(z: Values) -> Values:
        entries = list(np.moveaxis(z, -1, 0))
        controls = entries[n:] if size > n else [0.0] * m  # an initial or final cost has none
        return np.broadcast_to(formula(entries[:n], controls, numbers), z.shape[:-1])

    return function


def _obstacles(cost: ls.ObstacleCost, place: Values) -> Values:
    total = np.zeros(place.shape[:-1])
    for obstacle in cost.world.obstacles:
        if place.shape[-1] == 2 and obstacle.kind == "plane" and abs(obstacle.rotation[2, 2]) > 1 - 1e-9:
            continue  # seen from above, a floor bounds nothing
        total = total + np.exp(-cost.sharpness * (distance(obstacle, place) - cost.radius))
    return cost.weight * total


def distance(obstacle: ls.Obstacle, place: Values) -> Values:
    """Signed distance of places (..., 2 or 3), which may be complex, to an obstacle. In the plane, seen from above."""
    if flat := place.shape[-1] == 2:
        place = np.concatenate([place, np.broadcast_to(obstacle.position[2], (*place.shape[:-1], 1))], axis=-1)
    local: Values = (place - obstacle.position) @ obstacle.rotation
    a, b, c = np.moveaxis(local, -1, 0)
    first, second, third = obstacle.size
    if obstacle.kind == "plane":
        return c
    if obstacle.kind == "box" and (not flat or abs(obstacle.rotation[2, 2]) > 1 - 1e-9):
        sides = [_absolute(a) - first, _absolute(b) - second, *([] if flat else [_absolute(c) - third])]
        beyond: Values = np.stack(sides, axis=-1)
        deepest: Values = np.take_along_axis(beyond, beyond.real.argmax(axis=-1)[..., None], axis=-1)[..., 0]
        outside = np.where(beyond.real > 0, beyond, 0)
        return np.where(deepest.real > 0, _length(outside, deepest.real > 0), deepest)
    if obstacle.kind == "cylinder":
        upright = abs(obstacle.rotation[2, 2]) > 1 - 1e-9
        if np.isinf(second) or (flat and upright):
            return np.sqrt(a * a + b * b) - first
    if obstacle.kind == "capsule" and not flat:
        c = np.where(np.abs(c.real) < second, 0, _absolute(c) - second)
        return np.sqrt(a * a + b * b + c * c) - first
    if obstacle.kind == "sphere" and not flat:
        return np.sqrt(a * a + b * b + c * c) - first
    raise TypeError(f"no check for a {obstacle.kind} of size {obstacle.size}, in the plane: {flat}")


def _absolute(a: Values) -> Values:
    return np.where(a.real < 0, -a, a)


def _length(vectors: Values, where: Values) -> Values:
    """Lengths of vectors (..., 3) where it says; elsewhere anything, but no warning."""
    return np.sqrt(np.where(where, (vectors * vectors).sum(axis=-1), 1))


def quadrotor_rate(x: list[Values], u: list[Values], p: tuple[float, ...]) -> list[Any]:
    """The quadrotor's rates: Sec. VI-B, with the rotation as an exponential map."""
    mass, inertia, arm, torque_ratio, drag, gravity = p
    velocity, r, w = (np.stack(np.broadcast_arrays(*x[i : i + 3])) for i in (3, 6, 9))
    square = (r * r).sum(axis=0)
    small = np.abs(square) < 1e-4
    angle = np.sqrt(np.where(small, 1, square))  # where it is small, the series below is good to 1e-16
    sine = np.where(small, 1 - square / 6 + square**2 / 120 - square**3 / 5040, np.sin(angle) / angle)
    half = np.where(small, 1 - square / 24 + square**2 / 1920 - square**3 / 322560, np.sin(angle / 2) / (angle / 2))
    cosine = half * half / 2
    turning = np.where(small, 1 / 12 + square / 720 + square**2 / 30240, (1 - angle / 2 / np.tan(angle / 2)) / angle**2)

    def cross(a: Values, b: Values) -> Values:
        return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])

    thrust = np.stack(np.broadcast_arrays(0 * square, 0 * square, u[0] + u[1] + u[2] + u[3]))
    force = thrust + sine * cross(r, thrust) + cosine * cross(r, cross(r, thrust)) - drag * velocity
    turn = w + cross(r, w) / 2 + turning * cross(r, cross(r, w))
    torque = [arm * (u[1] - u[3]), arm * (u[2] - u[0]), torque_ratio * (u[0] - u[1] + u[2] - u[3])]
    lift = force / mass
    return [*velocity, lift[0], lift[1], lift[2] - gravity, *turn, *(t / inertia for t in torque)]


# The least of the model.


def _least(
    A: Array,
    B: Array,
    defect: Array,
    hessian: Array,
    gradient: Array,
    end_curve: Array,
    end_slope: Array,
    *,
    fixed: bool,
) -> tuple[Array, Array]:
    """Changes of states (T+1, n) and controls (T, m) that minimise the model, from its KKT conditions.

    The unknowns are, step by step, the multiplier of the state's equation, the state, the control. Of the first state
    the equation is that it does not change, if it is fixed, and otherwise there is none.
    """
    steps, n, m = B.shape
    size = 2 * n + m  # of a step
    own, next_ = np.zeros((steps + 1, size, size)), np.zeros((steps, size, n))
    right = np.zeros((steps + 1, size))
    one = np.eye(n)
    own[:, :n, n : 2 * n] = own[:, n : 2 * n, :n] = -one
    if not fixed:
        own[0, :n, n : 2 * n] = own[0, n : 2 * n, :n] = 0
        own[0, :n, :n] = one
    own[:-1, n:, n:] = hessian
    own[-1, n : 2 * n, n : 2 * n] = end_curve
    own[-1, 2 * n :, 2 * n :] = np.eye(m)  # there is no last control: it is zero
    next_[:, n : 2 * n] = np.swapaxes(A, 1, 2)
    next_[:, 2 * n :] = np.swapaxes(B, 1, 2)
    right[1:, :n] = -defect
    right[:-1, n:] = -gradient
    right[-1, n : 2 * n] = -end_slope
    width = size + n - 1
    band = np.zeros((2 * width + 1, (steps + 1) * size))

    def put(block: Array, row: Any, column: Any) -> None:
        rows, columns = row[:, :, None], column[:, None, :]
        band[width + rows - columns, np.broadcast_to(columns, block.shape)] = block

    place = np.arange((steps + 1) * size).reshape(steps + 1, size)
    put(own, place, place)
    put(next_, place[:-1], place[1:, :n])
    put(np.swapaxes(next_, 1, 2), place[1:, :n], place[:-1])
    found = solve_banded((width, width), band, right.ravel()).reshape(steps + 1, size)
    return found[:, n : 2 * n], found[:-1, 2 * n :]
