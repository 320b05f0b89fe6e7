"""From a problem to its compiled core and back: which text, which numbers.

The text is the structure: the sources that the dynamics and the cost terms wrote, and those of the package's own
numba-subset modules, joined, with the sizes as constants. Everything that is a number (goal, weights, masses,
obstacles, horizon) is an argument.
"""

import ast
import hashlib
import inspect
import re
from collections.abc import Callable, Sequence
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim import integration, laws, rotations, world
from lqrsim.constraints import Inequalities
from lqrsim.coordinates import Coordinates
from lqrsim.core import Core, address_of, compiling
from lqrsim.costs import Term
from lqrsim.dynamics import Dynamics
from lqrsim.errors import Array
from lqrsim.problem import FixedState, Problem
from lqrsim.solvers import (
    augmented,
    certificate,
    dual,
    entries,
    interface,
    kernels,
    limits,
    loops,
    lq_passes,
    passes,
    primal,
    projection,
    rollouts,
    safeguard,
)
from lqrsim.world import World

# The terms of a cost as far as they are structure: the source of each, and what it may bend in (see `Term`).
Structure = tuple[tuple[str, tuple[int, ...] | None], ...]
# The constraints: the source of each, and whether it uses the control.
Constraints = tuple[tuple[str, bool], ...]

_FIELDS = {"initial": "initial", "stage": "stage_cost", "final": "final_cost"}


# The forms of the cost-to-come, and what brings each.
FORMS = {"dual": dual, "primal": primal}


def core(problem: Problem, form: str = "dual") -> Core:
    """The compiled passes for problems of this structure; see `solvers/loops.py` and `passes.py` for what it offers."""
    with compiling:  # not only against doing it twice: Python 3.11 can not parse in two threads at once
        return _core(form, *_structure(problem))


def _structure(problem: Problem) -> tuple[Any, ...]:
    dynamics = problem.dynamics
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    costs = [(name, tuple((t.source, t.bends) for t in problem.terms(field))) for name, field in _FIELDS.items()]
    constraints = tuple((inequalities.source, inequalities.uses_control) for inequalities in problem.inequalities)
    return n, m, dynamics.source, tuple(costs), constraints, f"{dynamics.name} ({n} states, {m} controls)"


@cache
def _core(
    form: str,
    n: int,
    m: int,
    dynamics: str,
    costs: tuple[tuple[str, Structure], ...],
    constraints: Constraints,
    what: str,
) -> Core:
    parts = [_functions(module) for module in (rotations, world, kernels, integration, FORMS[form], *_SHARED)]
    parts += [dynamics, _constraint_source(constraints, len(dict(costs)["stage"]))]
    parts += [_cost_source(name, terms, () if name == "initial" else constraints) for name, terms in costs]
    sizes = {"N": n, "M": m, "W": n + m, "LIMITS": len(dict(costs)["stage"]) + 2 * len(constraints)}
    return Core("\n\n".join(parts), {**_NAMES, **sizes}, what)


_SHARED = limits, passes, rollouts, loops, safeguard, certificate, entries


@cache
def linear_quadratic(n: int, m: int, form: str) -> Core:
    """The compiled passes for linear-quadratic problems of n states and m controls; see `solvers/lq_passes.py`."""
    with compiling:
        parts = [_functions(module) for module in (kernels, FORMS[form], lq_passes)]
        return Core("\n\n".join(parts), {"N": n, "M": m, "W": n + m}, f"linear-quadratic, {n} states, {m} controls")


# The numbers that have names: outcomes, methods, and the places of what is remembered.
_NAMES = {name: value for name, value in vars(interface).items() if name.isupper() and len(name) > 1}


def arguments(problem: Problem, *, multipliers: Sequence[Array] = ()) -> dict[str, Any]:
    """The problem's numbers, as the passes take them: before its own, each part has the addresses of its functions.

    Args:
      multipliers: of each constraint, as `augmented.py` has them; by default none act.
    """

    def numbers(part: Dynamics | Term) -> Array:
        return np.array([*(address_of(function) for function in part.functions), *part.data], dtype=np.float64)

    data = {name: tuple(numbers(term) for term in problem.terms(field)) for name, field in _FIELDS.items()}
    multipliers = multipliers or [no_multipliers(problem, inequalities) for inequalities in problem.inequalities]
    pairs = [(part.data.copy(), own) for part, own in zip(problem.inequalities, multipliers, strict=True)]
    data["stage"] += tuple(array for pair in pairs for array in pair)
    data["final"] += tuple(array for pair in pairs for array in pair)
    data["stage"] += (np.array([*problem.control_coordinates.low, *problem.control_coordinates.high]),)
    return {"p": numbers(problem.dynamics), "dt": problem.dt, **data}


def costs_of(problem: Problem, states: Array, controls: Array) -> Array:
    """Stage and final cost (K,) of each of K trajectories, states (K, T+1, n) and controls (K, T, m)."""
    costs = np.empty(len(states))
    told = arguments(problem)
    flat = (_plain(array).reshape(-1, array.shape[2]) for array in (states, controls))
    core(problem).costs_of(len(states), problem.steps, *flat, told["stage"], told["final"], costs)
    return costs


def rollout(problem: Problem, gain: Array, offset: Array, state: Array) -> tuple[Array, Array]:
    """Where the laws u_t = gain_t x + offset_t lead from a state, by the model: states (T+1, n) and controls (T, m)."""
    states, controls = np.empty((problem.steps + 1, len(state))), np.empty((problem.steps, offset.shape[1]))
    told, law = arguments(problem), (_plain(gain), _plain(offset))
    costs = (told[name] for name in ("initial", "stage", "final"))
    core(problem).rollout(problem.steps, state, *law, told["p"], told["dt"], *costs, states, controls)
    return states, controls


def no_multipliers(problem: Problem, inequalities: Inequalities, tolerance: float = 0.0) -> Array:
    """Those of a constraint that does not act yet; see `solvers/augmented.py`."""
    rows = inequalities.rows
    # Nothing can be done about a start that is given; but about its control.
    first = 1 if isinstance(problem.initial, FixedState) and not inequalities.uses_control else 0
    return np.concatenate([[0.0, rows, first, tolerance], np.zeros((problem.steps + 1) * rows)])


def signed_distance(world_seen: World, points: npt.ArrayLike) -> Array:
    """As `world_seen.distance(points)`, compiled: (...) from points (..., 2 or 3)."""
    points = np.asarray(points, dtype=np.float64)
    flat = np.zeros((points[..., 0].size, 3))
    flat[:, : points.shape[-1]] = points.reshape(-1, points.shape[-1])
    out = np.empty(len(flat))
    table = np.array(world_seen.table)
    with compiling:
        distances = _distance_core()
    distances.nearest(len(table), len(flat), table.ravel(), flat, out)
    return out.reshape(points.shape[:-1])


def signed_distance_displaced(world_seen: World, points: Array, displaced: Array) -> Array:
    """The same with obstacles that are elsewhere: (K, k) from points (K, k, 2 or 3), displaced (K, obstacles, 3)."""
    trials, count, size = points.shape
    flat = np.zeros((trials * count, 3))
    flat[:, :size] = points.reshape(-1, size)
    out, table = np.empty(len(flat)), np.array(world_seen.table)
    away = np.ascontiguousarray(displaced, dtype=np.float64).reshape(trials, -1)
    with compiling:
        distances = _distance_core()
    distances.nearest_displaced(len(table), len(flat), count, table.ravel(), flat, away, out)
    return out.reshape(trials, count)


def policy(states: Coordinates, controls: Coordinates) -> Callable[..., Array]:
    """What evaluates laws: (shown (K, n), gain (m, n), offset (m,), nominal (n,)) -> controls (K, m).

    As `AffinePolicy.__call__`, but that each trial gets what it gets alone, to the last bit.
    """
    low, high = np.array(controls.low), np.array(controls.high)
    with compiling:
        core_of_laws = _policy_core(len(states), len(controls), states.angles, states.rotation_vectors)

    def evaluate(shown: Array, gain: Array, offset: Array, nominal: Array) -> Array:
        near, out = np.array(shown, dtype=np.float64), np.empty((len(shown), len(controls)))
        law = (_plain(part) for part in (gain, offset, nominal))
        core_of_laws.apply_law(len(shown), near, *law, low, high, out)
        return out

    return evaluate


def _plain(array: Array) -> Array:
    """In C's order, and not read-only, as arrays from files are: compiled functions take no other."""
    if array.dtype == np.float64 and array.flags.carray:
        return array  # at once: in the loop it is most of what this takes
    return np.require(array, np.float64, ["C", "W"])


def turn_to_nearest(space: Coordinates, states: Array, nominal: Array) -> None:
    """As `space.nearest`, compiled and in place: states (T+1, K, n), C-ordered, become those nearest to (T+1, n)."""
    with compiling:
        core_of_laws = _policy_core(len(space), 1, space.angles, space.rotation_vectors)
    core_of_laws.turn_all(len(states), states.shape[1], states.reshape(-1, len(space)), _plain(nominal))


@cache
def _policy_core(n: int, m: int, angles: tuple[int, ...], rotation_vectors: tuple[int, ...]) -> Core:
    turns = [f"    nearest_angle(x, nominal, {i})" for i in angles]
    turns += [f"    nearest_rotation(x, nominal, {i})" for i in rotation_vectors]
    source = "\n".join([_functions(laws), "def turn(x, nominal):", *(turns or ["    pass"])])
    return Core(source, {"N": n, "M": m}, f"policies of {n} states and {m} controls")


@cache
def _distance_core() -> Core:
    source = f"""\
def nearest(obstacles, count, data, points, out):
    for i in range(count):
        out[i] = inf
        for row in range(0, {world.ROW} * obstacles, {world.ROW}):
            distance = signed_distance(data, row, points[i, 0], points[i, 1], points[i, 2])
            if not distance >= out[i]:  # NaN, too: nowhere is not far away
                out[i] = distance
"""
    source += f"""

def nearest_displaced(obstacles, count, each, data, points, displaced, out):
    for i in range(count):
        out[i] = inf
        trial = i // each
        for k in range(obstacles):
            x = points[i, 0] - displaced[trial, 3 * k]
            y = points[i, 1] - displaced[trial, 3 * k + 1]
            z = points[i, 2] - displaced[trial, 3 * k + 2]
            distance = signed_distance(data, {world.ROW} * k, x, y, z)
            if not distance >= out[i]:
                out[i] = distance
"""
    return Core(f"{_functions(world)}\n\n{source}", {}, "distances to obstacles")


def _constraint_source(constraints: Constraints, terms: int) -> str:
    """Source of what the augmented Lagrangian needs of each constraint, and to look at them from outside."""
    parts = []
    look = "def look_at_constraints(steps, states, controls, data, values):\n    for t in range(steps + 1):\n"
    look += "        u = controls[min(t, steps - 1)]\n"
    slope = "def slope_of_constraint(which, row, x, u, t, data, gradient):\n"
    for k, (source, uses_control) in enumerate(constraints):
        prefix = _prefix(source)
        names = {"constraint_value": f"{prefix}_value", "constraint_slope": f"{prefix}_slope"}
        names |= {name: f"{prefix}_{name}" for name in ("augment", "augmentation", "look")}
        parts += [_own(source), _rename(_functions(augmented), names)]
        at = terms + 2 * k
        slope += f"    if which == {k}:\n        {prefix}_slope(x, u, t, row, data[{at}], gradient)\n"
        acts = "t < steps" if uses_control else "True"  # there is no last control
        look += f"        {prefix}_look(states[t], u, t, {acts}, data[{at}], data[{at + 1}], values[{k}])\n"
    return "\n\n".join([*parts, look, slope] if constraints else [])


def _prefix(source: str) -> str:
    # Terms of the same source are the same functions: those of an initial and a final cost, say.
    return f"term_{hashlib.sha256(source.encode()).hexdigest()[:8]}"


def _own(source: str) -> str:
    """A source with its functions renamed, so that several can stand side by side."""
    own = re.findall(r"^def (\w+)\(", source, flags=re.MULTILINE)
    return _rename(source, {name: f"{_prefix(source)}_{name}" for name in own})


def _cost_source(name: str, terms: Structure, constraints: Constraints) -> str:
    """Source of `<name>_value`, the sum of the terms, of `<name>_added`, what the augmented Lagrangian adds, and of
    `<name>_quadratic`, which models both.
    """
    parts, values, convex, bent = [], [], [], []
    for i, (source, bends) in enumerate(terms):
        prefix = _prefix(source)
        parts.append(_own(source))
        values.append(f"    total += {prefix}_value(x, u, t, data[{i}])")
        call = f"    total += {prefix}_derivatives(x, u, t, data[{i}], hessian, gradient)"
        (convex if bends is None else bent).append(call)
    support = tuple(sorted({i for _, bends in terms for i in bends or ()}))
    if support:
        # The sum of what may be indefinite is projected once; what is convex is added after.
        parts.append(_rename(_functions(projection), {"project": f"{name}_project", "K": str(len(support))}))
        bent.append(f"    {name}_project(hessian, {support})")
    added = []
    for k, (source, uses_control) in enumerate(constraints):
        if not (uses_control and name == "final"):
            pair = f"data[{len(terms) + 2 * k}], data[{len(terms) + 2 * k + 1}]"
            convex.append(f"    total += {_prefix(source)}_augment(x, u, t, {pair}, hessian, gradient)")
            added.append(f"    total += {_prefix(source)}_augmentation(x, u, t, {pair})")
    if name != "initial":
        parts.append("\n".join([f"def {name}_added(x, u, t, data):\n    total = 0.0", *added, "    return total"]))
    summed = f"def {name}_value(x, u, t, data):\n    total = 0.0\n" + "\n".join(values)
    parts.append(f"{summed}\n    return total")
    modelled = f"def {name}_quadratic(x, u, t, data, hessian, gradient):\n    clear(hessian, W, W)\n"
    modelled += "    for i in range(W):\n        gradient[i] = 0.0\n    total = 0.0\n"
    parts.append("\n".join([modelled.rstrip(), *bent, *convex, "    return total"]))
    return "\n\n".join(parts)


def _functions(module: ModuleType) -> str:
    """The text of a module's functions that are in the numba subset: those below the line that says so, or all."""
    source = inspect.getsource(module)
    marks = [i for i, line in enumerate(source.splitlines(), start=1) if line.startswith("# The numba subset")]
    nodes = [node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)]
    return "\n\n".join(ast.unparse(node) for node in nodes if node.lineno > (marks[0] if marks else 0))


def _rename(source: str, names: dict[str, str]) -> str:
    return re.sub(r"\b(" + "|".join(names) + r")\b", lambda match: names[match.group(1)], source)
