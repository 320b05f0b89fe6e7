"""The compiled passes of a problem, and their arguments: addresses of the problem's functions, and its numbers.

Passes and iterations are compiled once per size. Dynamics, each cost term, each constraint and the noise are compiled
separately, behind the C signatures of `codegen/compiled_module.py`, and called by address. Everything that is a number
(goal, weights, masses, obstacles, horizon) is an argument.
"""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from lqrsim.codegen.compiled_module import CompiledModule, in_c_order, module_of
from lqrsim.codegen.sources import Source, source_of
from lqrsim.codegen.user_functions import numbers_of
from lqrsim.errors import Array
from lqrsim.kernels import augmented_lagrangian, iterations, linear_algebra, model_functions, passes, records
from lqrsim.kernels.declarations import FIRST, MARGIN, MULTIPLIERS, PENALTY, PRICE, ROWS
from lqrsim.kernels.records import CostModel, DynamicsModel, Motion, NoiseModel, Policy, ProblemModel
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.noise import NoiseTerm
from lqrsim.problem.parts import ConstraintTerm, CostTerm
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.policy import AffinePolicy

FORMS = ("dual", "primal")  # of the cost-to-come


def core(problem: Problem, form: str = "dual") -> CompiledModule:
    """The compiled passes and iterations for problems of this size; see `kernels/iterations.py`."""
    noisy = problem.noise_term is not None
    sizes = _sizes(problem.dynamics)
    description = f"{sizes['N']} states and {sizes['M']} controls{' with noise' if noisy else ''}"
    description += "" if form == "dual" else f", {form} form"
    return module_of(source_of(iterations), description, **sizes, NOISY=int(noisy), PRIMAL=int(form == "primal"))


def linear_quadratic(n: int, m: int, form: str) -> CompiledModule:
    """The compiled passes for linear-quadratic problems of that size; see `lq_passes` of `kernels/passes.py`."""
    description = f"linear-quadratic problems, {n} states and {m} controls"
    return module_of(source_of(passes), description, N=n, M=m, NOISY=0, PRIMAL=int(form == "primal"))


def _sizes(dynamics: Dynamics) -> dict[str, int]:
    return {"N": len(dynamics.state_coordinates), "M": len(dynamics.control_coordinates)}


def structure(problem: Problem) -> tuple[Any, ...]:
    """A key that is equal for problems that share all their compiled code."""
    fields = "initial", "stage_cost", "final_cost"
    costs = tuple(tuple((term.code, term.nonconvex_in) for term in problem.terms(field)) for field in fields)
    constraints = tuple((term.code, term.uses_control, term.equality, term.shared) for term in problem.constraint_terms)
    noise = None if problem.noise_term is None else problem.noise_term.code
    return problem.dynamics.step_source, tuple(_sizes(problem.dynamics).items()), costs, constraints, noise


def compile_problem(
    problem: Problem, *, multipliers: Sequence["ConstraintMultipliers"] = (), second_order: bool = False
) -> ProblemModel:
    """Compile the functions of a problem that are new; returns the problem as an argument of the passes.

    Without multipliers no constraint acts. With `second_order` there are second derivatives of the dynamics.
    """
    acting = multipliers or [ConstraintMultipliers(problem, term) for term in problem.constraint_terms]
    space, noise = problem.control_coordinates, ()
    if (term := problem.noise_term) is not None:
        value, quadratic = noise_module(problem, term).addresses("noise_value", "noise_quadratic")
        n, knots, risk = len(problem.dynamics.state_coordinates), problem.steps + 1, np.array([problem.risk, 0.0, 0.0])
        zeros = np.zeros((knots, n, n)), np.zeros((knots, n))  # the cost-to-go by which it may be weighed
        noise = NoiseModel(value, quadratic, numbers_of(term), risk, *zeros)
    return ProblemModel(
        dynamics_model(problem.dynamics, second_order=second_order), float(problem.dt),
        initial=_cost(problem, "initial", []), stage=_cost(problem, "stage_cost", acting),
        final=_cost(problem, "final_cost", [constraint for constraint in acting if not constraint.term.uses_control]),
        limits=records.Limits(np.array(space.low, dtype=np.float64), np.array(space.high, dtype=np.float64)),
        noise=noise,
    )  # fmt: skip


def dynamics_model(dynamics: Dynamics, *, second_order: bool = False) -> DynamicsModel:
    """The dynamics' functions and parameters for compiled code."""
    advance, step_jacobian = dynamics.compiled.addresses("advance", "step_jacobian")
    curvature = dynamics.step_curvature if second_order else 0.0
    many = dynamics.step_source.has("all_steps")
    (all_steps,) = dynamics.compiled.addresses("all_steps") if many else (0.0,)
    return DynamicsModel(advance, step_jacobian, curvature, all_steps, numbers_of(dynamics))


def cost_terms(problem: Problem, field: str) -> list[CostTerm]:
    """The terms of a cost in the order of `CostModel`: terms that may be indefinite come first."""
    return sorted(problem.terms(field), key=lambda term: term.nonconvex_in is None)


def _cost(problem: Problem, field: str, constraints: Sequence["ConstraintMultipliers"]) -> CostModel:
    terms, sizes = cost_terms(problem, field), tuple(_sizes(problem.dynamics).items())
    functions, project = _term_functions(tuple((term.code, term.nonconvex_in) for term in terms), sizes)
    kept = (constraint.term for constraint in constraints)
    stated = tuple((term.code, term.shared, term.equality, term.uses_control) for term in kept)
    acting = records.Constraints(
        _constraint_functions(stated, sizes), tuple(numbers_of(constraint.term) for constraint in constraints),
        tuple(constraint.array for constraint in constraints), len(constraints),
    )  # fmt: skip
    indefinite = sum(term.nonconvex_in is not None for term in terms)
    return CostModel(functions, tuple(map(numbers_of, terms)), len(terms), indefinite, project, acting)


_Sizes = tuple[tuple[str, int], ...]


@functools.lru_cache(maxsize=1024)
def _term_functions(terms: tuple[tuple[Source, tuple[int, ...] | None], ...], sizes: _Sizes) -> tuple[Array, float]:
    """`CostModel.functions` and `project` of the terms of a cost."""
    modules = [module_of(code, f"a cost: {code.what}", **dict(sizes)) for code, _ in terms]
    rows = [module.addresses("value", "derivatives") for module in modules]
    support = tuple(sorted({i for _, entries in terms for i in entries or ()}))
    project = 0.0
    if support:
        source = source_of(linear_algebra, SUPPORT=support)
        (project,) = module_of(source, "the projection of a cost", **dict(sizes)).addresses("project")
    return np.array(rows, dtype=np.float64).reshape(-1, 2), project


@functools.lru_cache(maxsize=1024)
def _constraint_functions(constraints: tuple[tuple[Source, int, bool, bool], ...], sizes: _Sizes) -> Array:
    rows = []
    for code, shared, equality, uses_control in constraints:
        pairs = {"constraint_value": (code, "value"), "constraint_slope": (code, "slope")}
        source = source_of(augmented_lagrangian, SHARED=shared)
        if shared:
            pairs |= {name: (code, name) for name in ("shared_values", "shared_jacobian")}
        module = module_of(source.filled(**pairs), f"a constraint: {code.what}", **dict(sizes), EQUALITY=int(equality))
        addresses = module.addresses("augment", "augmentation", "constraint_values", "add_slope")
        rows.append([*addresses, float(uses_control)])
    return np.array(rows, dtype=np.float64).reshape(-1, 5)


def noise_module(problem: Problem, term: NoiseTerm) -> CompiledModule:
    """The compiled noise of a problem; see `problem/noise.py`."""
    return module_of(term.code, "noise", **_sizes(problem.dynamics))


def costs_module(problem: Problem) -> CompiledModule:
    """The compiled `kernels/model_functions.py`, which evaluates costs and constraints for Python."""
    sizes = _sizes(problem.dynamics)
    return module_of(source_of(model_functions), f"costs of {sizes['N']} states and {sizes['M']} controls", **sizes)


def costs_of(problem: Problem, states: Array, controls: Array) -> Array:
    """Stage and final costs (K,) of K trajectories with states (K, T+1, n) and controls (K, T, m)."""
    costs = np.empty(len(states))
    flat = (in_c_order(array).reshape(-1, array.shape[2]) for array in (states, controls))
    costs_module(problem).costs_of(len(states), problem.steps, Motion(*flat), compile_problem(problem), costs)
    return costs


def cost_of(problem: Problem, states: Array, controls: Array) -> float:
    """Stage and final costs of one trajectory, states (T+1, n) and controls (T, m)."""
    return float(costs_of(problem, states[None], controls[None])[0])


def quadratic_at(problem: Problem, cost: CostModel, x: Array, u: Array, step: int) -> tuple[float, Array, Array]:
    """A cost at one step: its value, gradient (n+m,) and Hessian (n+m, n+m)."""
    gradient, hessian = np.zeros(len(x) + len(u)), np.zeros((len(x) + len(u),) * 2)
    value = costs_module(problem).cost_quadratic(x.copy(), u.copy(), step, cost, hessian, gradient)
    return value, gradient, hessian


class CostsByStep:
    """Evaluates a problem's costs one step at a time."""

    def __init__(self, problem: Problem) -> None:
        self._module, self._steps, self._model = costs_module(problem), problem.steps, compile_problem(problem)

    def stage(self, t: int, states: Array, controls: Array) -> Array:
        """Stage costs (K,) of step t in states (K, n) under controls (K, m)."""
        return self._each(t, states, controls, self._model.stage)

    def final(self, states: Array, controls: Array) -> Array:
        """Final costs (K,) of states (K, n), reached by controls (K, m)."""
        return self._each(self._steps, states, controls, self._model.final)

    def _each(self, t: int, states: Array, controls: Array, cost: CostModel) -> Array:
        costs = np.empty(len(states))
        self._module.cost_of_each(len(states), t, Motion(in_c_order(states), in_c_order(controls)), cost, costs)
        return costs


def rollout(problem: Problem, gain: Array, offset: Array, state: Array, *, dt: float | None = None) -> Motion:
    """Roll out the policy u_t = gain_t x + offset_t from a state; gains (T, m, n), offsets (T, m)."""
    model = compile_problem(problem)
    model = model if dt is None else model._replace(dt=float(dt))
    steps = len(gain)
    plan = Motion(np.empty((steps + 1, len(state))), np.empty((steps, offset.shape[1])))
    policy = Policy(in_c_order(gain), in_c_order(offset))
    with problem.dynamics.quiet():
        core(problem).rollout(steps, in_c_order(state), policy, model, plan)
    return plan


def policy_about(states: Array, controls: Array, gain: Array) -> Policy:
    """The policy with these gains (T, m, n) that tracks a plan: the gains, and its offsets (T, m)."""
    return Policy(gain, controls - np.einsum("tij,tj->ti", gain, states[:-1]))


def policy_of(problem: Problem, gain: Array, offset: Array, nominal: Array) -> AffinePolicy:
    """The policy u_t = gain_t x + offset_t for a problem's system, about nominal states (T, n)."""
    return AffinePolicy(
        gain=gain, offset=offset, nominal=nominal, dt=problem.dt,
        state_coordinates=problem.dynamics.state_coordinates, control_coordinates=problem.applied_coordinates,
    )  # fmt: skip


class ConstraintMultipliers:
    """A constraint's multipliers, in the memory that compiled code reads. Initially the constraint does not act.

    Attributes:
      margin: with which an inequality is to be kept. price: of a violation, in cost per unit. first: step at which it
        acts. array: all numbers, as in `kernels/augmented_lagrangian.py`. values: ((T+1) rows,) multipliers in it.
    """

    def __init__(self, problem: Problem, term: ConstraintTerm, margin: float = 0.0, price: float = np.inf) -> None:
        self.term = term
        # A fixed start cannot change; its control can.
        first = 1 if isinstance(problem.initial, FixedState) and not term.uses_control else 0
        self.first = problem.steps if term.final_only else first
        self.margin, self.price = 0.0 if term.equality else margin, price
        self.array = np.zeros(MULTIPLIERS + (problem.steps + 1) * term.rows)
        self.array[[ROWS, FIRST, MARGIN, PRICE]] = term.rows, self.first, self.margin, price
        self.values = self.array[MULTIPLIERS:]

    @property
    def penalty(self) -> float:
        """The penalty, in cost per square of the constraint's unit; 0 if the constraint does not act."""
        return float(self.array[PENALTY])

    @penalty.setter
    def penalty(self, penalty: float) -> None:
        self.array[PENALTY] = penalty
