"""Whatever a solution claims, held against the problem alone, in plain NumPy; `kkt.py` evaluates problems.

What must be so of any plan, whatever the status; what a success claims besides; and what the other statuses say.
"""

import numpy as np
from oracle import constraints, kkt
from scipy.optimize import lsq_linear

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.parts import terms_of
from lqrsim.results.solution_parts import Status

# Rounding, of sums of a few hundred terms, and of a step that may amplify it a thousandfold.
COST, MOTION, LAW = 1e-7, 1e-7, 1e-9
# The decrease that is still promised is worked out with other gains and Hessians than the method's, and a constraint's
# multiplier is right to the tolerance to which it is solved.
SLACK = 10.0
EQUALITY, ROUNDING = 1e-6, 1e-12  # how closely equalities are kept at least; and what rounding may make of a constraint


def contradictions(problem: ls.Problem, solution: ls.Solution, rate: kkt.Rate | None = None) -> list[str]:
    """What a solution claims that is not so; empty where all of it is."""
    with np.errstate(all="ignore"):
        found = _of_any_plan(problem, solution, rate)
        if solution.success:
            found += _of_a_success(problem, solution, rate)
    if solution.status is not Status.CONVERGED and not solution.status.success and not solution.remedy:
        found.append(f"{solution.status.name} has no remedy")
    limit = solution.options["max_iterations"]
    assert isinstance(limit, int)
    if len(solution.iterations) > limit:
        found.append(f"{len(solution.iterations)} iterations, with max_iterations={limit}")
    return found


def _of_any_plan(problem: ls.Problem, solution: ls.Solution, rate: kkt.Rate | None) -> list[str]:
    """The plan is the rollout of its policy from where it must start, inside the limits, and costs what is said."""
    plan, policy, found = solution.trajectory, solution.policy, []
    if isinstance(problem.initial, ls.FixedState) and not np.array_equal(plan.states[0], problem.initial.numbers):
        found.append(f"begins at {plan.states[0]}, not at {problem.initial.numbers}")
    low, high = np.array(problem.control_coordinates.low), np.array(problem.control_coordinates.high)
    if ((plan.controls < low) | (plan.controls > high)).any():
        found.append("a control is beyond its limits")
    if not np.isfinite(plan.states).all():
        return found if not solution.success else [*found, "the plan is not finite"]
    raw = np.einsum("tij,tj->ti", policy.gain, plan.states[:-1]) + policy.offset
    terms = np.einsum("tij,tj->ti", np.abs(policy.gain), np.abs(plan.states[:-1])) + np.abs(policy.offset) + 1e-300
    if not (np.abs(np.clip(raw, low, high) - plan.controls) <= LAW * (terms + np.abs(plan.controls))).all():
        found.append("the controls are not the policy's")
    cost, residual = kkt.recompute(problem, plan, rate)
    if not residual < MOTION * max(1.0, float(np.abs(plan.states).max())):
        found.append(f"a state is {residual:.2g} off the dynamics")
    # Of a cost of zero, squares of rounding errors remain, each weighed by what the problem weighs it with.
    # Where one is beyond all numbers, so is the other, but for what overflows on the way.
    beyond = not abs(cost) < 1e250 and not abs(solution.cost) < 1e250
    if not (beyond or abs(cost - solution.cost) <= COST * abs(cost) + 1e-20 * _size(problem, plan)):
        found.append(f"costs {cost:.9g}, not {solution.cost:.9g}")
    violation = max(_missed(problem, plan, equality=kind) for kind in (False, True))
    if not abs(violation - solution.violation) <= 1e-9:
        found.append(f"misses a constraint by {violation:.3g}, not {solution.violation:.3g}")
    return found


def _of_a_success(problem: ls.Problem, solution: ls.Solution, rate: kkt.Rate | None) -> list[str]:
    # Rounding: numbers that are zero here may be less than it there.
    short, off = (_missed(problem, solution.trajectory, equality=kind) for kind in (False, True))
    found = [f"misses an inequality by {short:.3g}"] if short > ROUNDING else []
    tolerance = solution.options["constraint_tolerance"]
    assert isinstance(tolerance, float)
    if off > min(tolerance, EQUALITY) + ROUNDING:
        found.append(f"misses an equality by {off:.3g}")
    pairs = zip(constraints.of(problem), solution.multipliers, strict=False)
    if any((multipliers.values < 0).any() for one, multipliers in pairs if not one.equality):
        found.append("the multiplier of an inequality is negative")
    tolerance = solution.options["tolerance"]
    assert isinstance(tolerance, float)
    if solution.status is Status.CONVERGED:
        decrease = _decrease(problem, solution, rate)
        promised = decrease / (abs(solution.cost) + 1e-20 * _size(problem, solution.trajectory) + 1e-300)
        if not promised < SLACK * tolerance:
            found.append(f"{promised:.2g} of the cost could still be saved")
    return found


def _size(problem: ls.Problem, plan: ls.Trajectory) -> float:
    """Squares of the states and controls, weighed as the problem's quadratic terms weigh them."""
    total = 0.0
    for cost, places in ((problem.stage_cost, plan.states[:-1]), (problem.final_cost, plan.states[-1:])):
        for term in terms_of(cost):
            if isinstance(term, ls.QuadraticCost | ls.ControlCost):
                sizes = np.abs(places if isinstance(term, ls.QuadraticCost) else plan.controls)
                _, weight = kkt.quadratic_at(term, len(sizes))
                total += float(np.einsum("ti,...ij,tj->...", sizes, np.abs(weight), sizes).sum())
            else:
                total += len(places) * max(float(np.abs(places).max()) ** 2, 1.0)
    return total


def _missed(problem: ls.Problem, plan: ls.Trajectory, *, equality: bool) -> float:
    """By how much the worst of the equalities, or of the inequalities, is missed."""
    z = constraints.points(plan)
    return max((one.violation(z) for one in constraints.of(problem) if one.equality == equality), default=0.0)


def _decrease(problem: ls.Problem, solution: ls.Solution, rate: kkt.Rate | None) -> float:
    """`1/2 sum e' H^-1 e`: with the slopes e of the Lagrangian in the offsets of the policy, later controls responding.

    H is the curvature of the cost in one offset, all others held. Controls go no further than their limits, and at one
    they do not respond. Multipliers are the solution's, and what leaves a constraint that acts costs its penalty: else
    a small error of a multiplier would count as cost that could be saved by leaving it.
    """
    plan, gain = solution.trajectory, solution.policy.gain
    n, m = plan.states.shape[1], plan.controls.shape[1]
    z = np.hstack([plan.states[:-1], plan.controls])
    _, jacobian = kkt.step_jacobian(kkt.rate_of(problem, rate), z, n, kkt.numbers_of(problem), problem.dt)
    A, B = jacobian[..., :n], jacobian[..., n:]
    _, gradient, hessian = kkt.cost_model(problem, problem.stage_cost, z, n, first=0)
    _, end_slope, end_curve = kkt.cost_model(problem, problem.final_cost, plan.states[-1:], n, first=-1)
    pull, along = np.zeros((problem.steps + 1, n + m)), constraints.points(plan)
    bend = np.zeros((problem.steps + 1, n + m, n + m))
    for one, multipliers in zip(constraints.of(problem), solution.multipliers, strict=False):
        slopes = one.slopes(along)
        pull -= np.einsum("tr,tri->ti", multipliers.values, slopes)
        acting = multipliers.penalty * np.logical_and(one.acts, one.equality | (multipliers.values > 0))
        bend += np.einsum("tr,tri,trj->tij", acting, slopes, slopes)
    gradient += pull[:-1]
    hessian = hessian + bend[:-1]
    costate, curve, total = end_slope[0] + pull[-1, :n], end_curve[0] + bend[-1, :n, :n], 0.0
    low, high = np.array(problem.control_coordinates.low), np.array(problem.control_coordinates.high)
    for t in range(len(A) - 1, -1, -1):
        slope = gradient[t, n:] + B[t].T @ costate
        u, H = plan.controls[t], hessian[t, n:, n:] + B[t].T @ curve @ B[t]
        free = (u > low) & (u < high)
        total += _least_within(H, slope, low - u, high - u)
        law = np.where(free[:, None], gain[t], 0.0)
        closed, both = A[t] + B[t] @ law, np.vstack([np.eye(n), law])
        costate = closed.T @ costate + both.T @ gradient[t]
        curve = closed.T @ curve @ closed + both.T @ hessian[t] @ both
    if not isinstance(problem.initial, ls.FixedState):
        _, slope, own = kkt.cost_model(problem, problem.initial, plan.states[:1], n, first=0)
        e = slope[0] + costate
        total += 0.5 * float(e @ np.linalg.pinv(own[0] + curve, hermitian=True) @ e)
    assert m == len(low)
    return total


def _least_within(H: Array, slope: Array, low: Array, high: Array) -> float:
    """By how much `1/2 x'Hx + slope'x` can be lowered within a box about zero. SciPy's bounded least squares."""
    step = -np.linalg.pinv(H, hermitian=True) @ slope
    if not ((low <= step) & (step <= high)).all():
        values, vectors = np.linalg.eigh(H)
        root = np.sqrt(np.maximum(values, 1e-14 * values.max()))[:, None] * vectors.T  # H = root' root
        low, high = np.minimum(low, -1e-300), np.maximum(high, 1e-300)  # it takes no empty box
        step = lsq_linear(root, -np.linalg.solve(root.T, slope), bounds=(low, high), tol=1e-12).x
    return max(0.0, -float(0.5 * step @ H @ step + slope @ step))
