"""From a problem to its compiled core and back: which text, which numbers.

The text is the structure: the sources that the dynamics and the cost terms wrote, and those of the package's own
numba-subset modules, joined, with the sizes as constants. Everything that is a number (goal, weights, masses,
obstacles, horizon) is an argument.
"""

import hashlib
import re
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from lqrsim.codegen.jit import Core, address_of, compiling, in_c_order
from lqrsim.codegen.kernel_source import source_of
from lqrsim.errors import Array
from lqrsim.kernels import (
    augmented_lagrangian,
    ball_constraint,
    certificate,
    control_limits,
    cost_to_come_dual,
    cost_to_come_primal,
    cost_to_go,
    damped_iterations,
    declarations,
    entry_points,
    iterations,
    linear_algebra,
    linear_quadratic_passes,
    passes,
    projection,
    rollouts,
    rotation_ratios,
    runge_kutta,
    signed_distance,
)
from lqrsim.kernels import noise as noise_kernel
from lqrsim.kernels.records import Limits, Model, Plan, Policy
from lqrsim.problem.constraints import ConstraintTerm
from lqrsim.problem.costs import Term
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.noise import numbers_of
from lqrsim.problem.problem import FixedState, Problem

# The terms of a cost as far as they are structure: the source of each, and what it is not convex in (see `Term`).
Structure = tuple[tuple[str, tuple[int, ...] | None], ...]
# The constraints: the source of each, whether it uses the control, whether it is an equality, and of how many balls.
Constraints = tuple[tuple[str, bool, bool, int], ...]
# The noise: its source, and the constants that `kernels/noise.py` leaves open; none without noise.
Noise = tuple[str, tuple[tuple[str, Any], ...]] | None

_FIELDS = {"initial": "initial", "stage": "stage_cost", "final": "final_cost"}


# The forms of the cost-to-come, and what brings each.
FORMS = {"dual": cost_to_come_dual, "primal": cost_to_come_primal}


def core(problem: Problem, form: str = "dual") -> Core:
    """The compiled passes for problems of this structure; `kernels/` has what it offers."""
    with compiling:  # not only against doing it twice: Python 3.11 cannot parse in two threads at once
        return _core(form, *_structure(problem))


def _structure(problem: Problem) -> tuple[Any, ...]:
    dynamics = problem.dynamics
    n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
    costs = [(name, tuple((t.source, t.nonconvex_in) for t in problem.terms(field))) for name, field in _FIELDS.items()]
    constraints = tuple((one.source, one.uses_control, one.equality, one.balls) for one in problem.constraint_terms)
    term = problem.noise_term
    noise = None if term is None else (term.source, tuple(term.filled.items()))
    return n, m, dynamics.source, tuple(costs), constraints, noise, f"{dynamics.name} ({n} states, {m} controls)"


@cache
def _core(
    form: str,
    n: int,
    m: int,
    dynamics: str,
    costs: tuple[tuple[str, Structure], ...],
    constraints: Constraints,
    noise: Noise,
    what: str,
) -> Core:
    parts = [source_of(module) for module in (*_BASE, FORMS[form], *_SHARED)]
    parts += [dynamics, _constraint_source(constraints, len(dict(costs)["stage"]))]
    parts += [_cost_source(name, terms, () if name == "initial" else constraints) for name, terms in costs]
    if noise is not None:
        parts += [noise[0], source_of(noise_kernel, **dict(noise[1]))]
    sizes = {"N": n, "M": m, "W": n + m, "NOISY": int(noise is not None)}
    return Core("\n\n".join(parts), {**_NAMES, **sizes}, what)


_BASE = rotation_ratios, signed_distance, linear_algebra, cost_to_go, runge_kutta
_SHARED = control_limits, passes, rollouts, iterations, damped_iterations, certificate, entry_points


@cache
def linear_quadratic(n: int, m: int, form: str) -> Core:
    """Those for linear-quadratic problems of that size; see `kernels/linear_quadratic_passes.py`."""
    with compiling:
        parts = [source_of(module) for module in (linear_algebra, cost_to_go, FORMS[form], linear_quadratic_passes)]
        return Core("\n\n".join(parts), {"N": n, "M": m, "W": n + m}, f"linear-quadratic, {n} states, {m} controls")


# The numbers that have names: outcomes, methods, and the places of what is remembered.
_NAMES = {name: value for name, value in vars(declarations).items() if name.isupper() and len(name) > 1}


def arguments(problem: Problem, *, multipliers: Sequence[Array] = ()) -> Model:
    """The problem's numbers, as the passes take them: before its own, each part has the addresses of its functions.

    Args:
      multipliers: of each constraint, as `augmented_lagrangian.py` has them; by default none act.
    """

    def numbers(part: Dynamics | Term | ConstraintTerm) -> Array:
        return np.array([*(address_of(function) for function in part.functions), *part.data], dtype=np.float64)

    data = {name: tuple(numbers(term) for term in problem.terms(field)) for name, field in _FIELDS.items()}
    multipliers = multipliers or [no_multipliers(problem, term) for term in problem.constraint_terms]
    pairs = [(numbers(part), own) for part, own in zip(problem.constraint_terms, multipliers, strict=True)]
    data["stage"] += tuple(array for pair in pairs for array in pair)
    data["final"] += tuple(array for pair in pairs for array in pair)
    space = problem.control_coordinates
    limits = Limits(np.array(space.low, dtype=np.float64), np.array(space.high, dtype=np.float64))
    noise = () if problem.noise_term is None else (numbers_of(problem.noise_term), np.array([problem.risk, 0.0]))
    return Model(numbers(problem.dynamics), float(problem.dt), limits=limits, noise=noise, **data)


def costs_of(problem: Problem, states: Array, controls: Array) -> Array:
    """Stage and final cost (K,) of each of K trajectories, states (K, T+1, n) and controls (K, T, m)."""
    costs = np.empty(len(states))
    flat = (in_c_order(array).reshape(-1, array.shape[2]) for array in (states, controls))
    core(problem).costs_of(len(states), problem.steps, Plan(*flat), arguments(problem), costs)
    return costs


def rollout(
    problem: Problem, gain: Array, offset: Array, state: Array, *, dt: float | None = None
) -> tuple[Array, Array]:
    """Where the laws u_t = gain_t x + offset_t lead from a state, by the model.

    Gains (T, m, n), offsets (T, m); returns states (T+1, n) and controls (T, m). T is the number of laws, and `dt` how
    long each is in force, by default the problem's control period.
    """
    model = arguments(problem)
    model = model if dt is None else model._replace(dt=float(dt))
    steps = len(gain)
    states, controls = np.empty((steps + 1, len(state))), np.empty((steps, offset.shape[1]))
    policy, plan = Policy(in_c_order(gain), in_c_order(offset)), Plan(states, controls)
    core(problem).rollout(steps, in_c_order(state), policy, model, plan)
    return states, controls


def no_multipliers(problem: Problem, term: ConstraintTerm, tolerance: float = 0.0) -> Array:
    """Those of a constraint that does not act yet; see `kernels/augmented_lagrangian.py`."""
    # Nothing can be done about a start that is given; but about its control.
    first = 1 if isinstance(problem.initial, FixedState) and not term.uses_control else 0
    first, spare = problem.steps if term.final_only else first, 0.0 if term.equality else tolerance
    return np.concatenate([[0.0, term.rows, first, spare], np.zeros((problem.steps + 1) * term.rows)])


def _constraint_source(constraints: Constraints, terms: int) -> str:
    """Source of what the augmented Lagrangian needs of each constraint, and to evaluate them from outside."""
    parts = []
    values = "def evaluate_constraints(steps, states, controls, data, values):\n    for t in range(steps + 1):\n"
    values += "        u = controls[min(t, steps - 1)]\n"
    slope = "def slope_of_constraint(which, row, x, u, t, data, gradient):\n"
    for k, (source, uses_control, equality, balls) in enumerate(constraints):
        prefix, own = _prefix(source), _constraint_prefix(source, equality)
        names = {"constraint_value": f"{prefix}_value", "constraint_slope": f"{prefix}_slope"}
        names |= {name: f"{own}_{name}" for name in ("augment", "augmentation", "constraint_values")}
        slope_name = names["constraint_slope"]
        parts.append(_own(source))
        if balls:
            parts.append(_of_state(prefix, own, balls))
            names |= {name: f"{own}_{inner}" for name, inner in _OF_PLACES.items()}
            slope_name = f"{own}_constraint_slope"
        parts.append(_rename(source_of(augmented_lagrangian, EQUALITY=equality), names))
        at = terms + 2 * k
        slope += f"    if which == {k}:\n        {slope_name}(x, u, t, row, data[{at}], gradient)\n"
        acts = "t < steps" if uses_control else "True"  # there is no last control
        pair = f"data[{at}], data[{at + 1}]"
        values += f"        {own}_constraint_values(states[t], u, t, {acts}, {pair}, values[{k}])\n"
    return "\n\n".join([*parts, values, slope] if constraints else [])


# What `ball_constraint.py` calls the functions of a constraint that get the places of balls in place of the state.
_OF_PLACES = {
    "augment": "augment_places", "augmentation": "augmentation_places", "constraint_values": "values_of_places",
}  # fmt: skip


def _of_state(prefix: str, own: str, balls: int) -> str:
    """Source of what evaluates a constraint of balls at a state, by its functions of their places."""
    names = {name: f"{prefix}_{name}" for name in ("places", "places_jacobian")}
    names["slope_of_places"] = f"{prefix}_slope"
    names |= {name: f"{own}_{name}" for name in (*_OF_PLACES, *_OF_PLACES.values(), "constraint_slope")}
    return _rename(source_of(ball_constraint, PLACES=3 * balls), names)


def _constraint_prefix(source: str, equality: bool) -> str:
    return f"{_prefix(source)}_{'equality' if equality else 'inequality'}"


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
    parts, values, convex, nonconvex = [], [], [], []
    for i, (source, nonconvex_in) in enumerate(terms):
        prefix = _prefix(source)
        parts.append(_own(source))
        values.append(f"    total += {prefix}_value(x, u, t, data[{i}])")
        call = f"    total += {prefix}_derivatives(x, u, t, data[{i}], hessian, gradient)"
        (convex if nonconvex_in is None else nonconvex).append(call)
    support = tuple(sorted({i for _, entries in terms for i in entries or ()}))
    if support:
        # The sum of what may be indefinite is projected once; what is convex is added after.
        parts.append(_rename(source_of(projection, K=len(support)), {"project": f"{name}_project"}))
        nonconvex.append(f"    {name}_project(hessian, {support})")
    added = []
    for k, (source, uses_control, equality, _) in enumerate(constraints):
        if not (uses_control and name == "final"):
            own = _constraint_prefix(source, equality)
            pair = f"data[{len(terms) + 2 * k}], data[{len(terms) + 2 * k + 1}]"
            convex.append(f"    total += {own}_augment(x, u, t, {pair}, hessian, gradient)")
            added.append(f"    total += {own}_augmentation(x, u, t, {pair})")
    if name != "initial":
        parts.append("\n".join([f"def {name}_added(x, u, t, data):\n    total = 0.0", *added, "    return total"]))
    summed = f"def {name}_value(x, u, t, data):\n    total = 0.0\n" + "\n".join(values)
    parts.append(f"{summed}\n    return total")
    modelled = f"def {name}_quadratic(x, u, t, data, hessian, gradient):\n    clear(hessian, W, W)\n"
    modelled += "    for i in range(W):\n        gradient[i] = 0.0\n    total = 0.0\n"
    parts.append("\n".join([modelled.rstrip(), *nonconvex, *convex, "    return total"]))
    return "\n\n".join(parts)


def _rename(source: str, names: dict[str, str]) -> str:
    return re.sub(r"\b(" + "|".join(names) + r")\b", lambda match: names[match.group(1)], source)
