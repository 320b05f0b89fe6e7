"""Certificates: before a solver reports success, its plan is checked against the problem itself.

`kernels/certificate.py` recomputes cost, dynamics, policy and optimality on a separate code path. `certified` compares
them with the solver's claims.

Second-order optimality says whether a plan is a minimum, and gives a direction down from a saddle. The Hessian of the
Lagrangian is reduced to the changes that keep the dynamics and all rows that are at zero. Its inertia is that of the
control blocks of a Riccati recursion, in which later controls respond at their best. If a block has a negative
eigenvalue, its eigenvector and these responses are a direction of negative curvature.

The recursion takes long, so compiled ones come first, which can only say that a plan is a minimum beyond doubt: without
constraints that of `kernels/certificate.py` (`curvature_of`), else `Stages.least_curvatures`.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array
from lqrsim.kernels import declarations
from lqrsim.kernels.records import CERTIFICATE, CostToGo, Motion
from lqrsim.problem.problem import FixedState
from lqrsim.results.solution_parts import Certificate, Curvature, Status
from lqrsim.solvers.engine import RunResult, SolveRun, no_value
from lqrsim.solvers.stages import Stages

# Tolerances for rounding: of the residuals of policy and dynamics, and of the cost, relative to it. A policy's control
# is a sum of a few terms; a step of the dynamics is some hundred operations, which amplify each other's rounding.
LAW, MOTION, COST = 1e-11, 1e-8, 1e-8
CANCELLATION = 1e-13  # rounding error of a cost, relative to the size of its terms, which may cancel
# An optimal cost may be almost zero. Optimality is then relative to this fraction of the cost of typical changes.
TYPICAL = 1e-6
# Factor by which a certificate's optimality may exceed the tolerance. It is computed about the plan; the solver's own,
# about states that are within the gap tolerance of the plan.
SLACK = 2.0

# Second order.
# Weight of a row that is at zero, for a change by its size: of the plan's cost or, if it is more, the largest force.
# Forces check the Lagrangian by the rows' own curvature; where the duration was free, they are in the cost of time.
HELD = 1e6
AT_ZERO = 1e-5  # value of a row, relative to its size, that counts as zero
TANGENT = 1e-3  # change of a held row, relative to its size and that of the direction, that is only the weight's
FLAT = 1e-6  # curvature of a direction that counts as zero, relative to its terms without cancellation
FLATTER = 1e-10  # the same relative to the typical cost of a change
CLEAR = 1e-7  # curvature of a control that is positive beyond doubt, relative to what the weights are
PRESSING = 1e-9  # cost of a change by a row's size, relative to the typical cost, from which on the row presses
USED, UNUSED = 100.0, 1e-3  # typical size of a control, at most, by its largest; what is less than that by another's
SUSPECT = 1e-4  # curvature of a control block, relative to its terms, below which its direction is looked at

Flags = npt.NDArray[np.bool_]


def certified(run: SolveRun, result: RunResult) -> RunResult:
    """The result with its certificate; NOT_CERTIFIED if that contradicts a success."""
    violation, value, wrong = run.work.violation_of(result.plan), result.values.get("cost_to_go"), ""
    to_go = no_value(result.states)
    if value is not None:
        to_go = CostToGo(*map(in_c_order, (value.hessian, value.gradient, np.asarray(value.constant))))
    # Without a cost-to-go, the cost of noise is weighed by the policy's own.
    weighed = value is None and run.problem.noise_term is not None
    task = declarations.EVALUATE if weighed else declarations.CERTIFY
    certificate, scale = certificate_of(run, task, result, to_go, violation)
    if value is None:
        certificate = replace(certificate, optimality=np.inf)
    if result.success:
        tolerance = run.method.tolerance if result.status is Status.CONVERGED else None
        if tolerance is not None and not certificate.optimality < SLACK * tolerance:
            # If controls are at their limits, the Hessians of the Riccati pass are not the Hessians of the policy.
            evaluated, _ = certificate_of(run, declarations.EVALUATE, result, no_value(result.states), violation)
            certificate = replace(certificate, optimality=evaluated.optimality)
        wrong = faults(
            certificate, claimed=run.budget.log[-1].cost, rounding=CANCELLATION * scale,
            tolerance=tolerance, kept=run.work.keeps(result.plan),
        )  # fmt: skip
    if run.problem.noise_term is not None and run.problem.constraint_terms:
        certificate = replace(certificate, cost=expected_cost(run, result))
    cost = certificate.cost if np.isfinite(certificate.cost) else np.inf
    result = replace(result, certificate=certificate, cost=cost, violation=violation)
    curvature = Curvature.NOT_CHECKED if wrong else curvature_of(run, result)[0]
    run.release_stages()
    if not wrong:
        return replace(result, certificate=replace(certificate, curvature=curvature))
    if run.work.memory["damping"] > 0:  # Newton's method needed weights: the cost is flat or falls for ever
        return replace(result, status=Status.NOT_POSITIVE_DEFINITE)
    if result.status is Status.CONVERGED and not run.budget.left:  # where more iterations might have gone on
        return replace(result, status=Status.MAX_ITERATIONS)
    return replace(result, status=Status.NOT_CERTIFIED, detail=f"of the plan that converged: {wrong}")


def certificate_of(
    run: SolveRun, task: int, result: RunResult, to_go: CostToGo, violation: float
) -> tuple[Certificate, float]:
    """The certificate of a plan and its policy with a cost-to-go, and the size of the cost's terms.

    The optimality is the predicted decrease of the cost relative to the cost, or with a free duration, to the cost of
    time if that is more.
    """
    numbers, interior = np.zeros(1, CERTIFICATE), run.initial_guess.interior
    numbers["typical"] = least = 0.0 if interior is None else interior.scale
    run.check(task, result, to_go, numbers)
    cost, scale, typical, motion, policy, beyond, decrease, _ = numbers[0].item()
    start, initial = 0.0, run.problem.initial
    if isinstance(initial, FixedState):
        start = float(np.abs(result.states[0] - initial.numbers).max())
    if not np.isfinite(cost):
        decrease = np.inf
    # Where typical changes are less than the rounding of the cost, as beside the cost of noise that no control damps,
    # the decrease is relative to them.
    size = typical if 0 < typical < CANCELLATION * abs(cost) else abs(cost)
    least = max(size, least, TYPICAL * typical, 1e-26 * scale, 1e-300)
    certificate = Certificate(
        cost=cost, start=start, dynamics_residual=motion, policy_residual=policy, limits=max(beyond, 0.0),
        violation=violation, optimality=decrease / least if np.isfinite(decrease) else np.inf,
    )  # fmt: skip
    return certificate, scale


def curvature_of(run: SolveRun, result: RunResult) -> tuple[Curvature, Motion | None]:
    """The curvature of the Lagrangian at a result by exact second derivatives.

    At a saddle also a direction of negative curvature, scaled to the typical sizes.
    """
    problem = run.problem
    if result.status is not Status.CONVERGED or not run.method.curved or problem.noise_term is not None:
        return Curvature.NOT_CHECKED, None
    if not problem.constraints:
        out = np.zeros(1, CERTIFICATE)
        run.check(declarations.CURVE, result, no_value(result.states), out)
        if out["curvature"][0] > FLAT:
            return Curvature.MINIMUM, None
    stages, plan = run.stages, Motion(*map(in_c_order, result.plan))
    multipliers = stages.of_constraints([multipliers.values for multipliers in result.multipliers])
    with np.errstate(all="ignore"):
        return _Reduced(stages, plan, result.policy.gain, multipliers).check()


def expected_cost(run: SolveRun, result: RunResult) -> float:
    """The cost under noise without penalties of constraints, which the cost-to-go of the solver has."""
    out, none = np.zeros(1, CERTIFICATE), no_value(result.states)
    run.check(declarations.EVALUATE, result, none, out, run.work.without_penalties())
    return float(out[0]["cost"])


def faults(
    certificate: Certificate, *, claimed: float, rounding: float, tolerance: float | None, kept: bool = False
) -> str:
    """List, in words, all contradictions to a claim of convergence; empty if there are none.

    The cost is to be the last in the log, but for the rounding of terms that cancel. The tolerance of the optimality is
    None if only the cost was tested. If all constraints are kept within tolerances, a violation above 0 is no fault.
    """
    contradictions = []
    if certificate.start != 0:
        contradictions.append(f"it begins {certificate.start:.2g} off the fixed start")
    if not certificate.dynamics_residual <= MOTION:
        contradictions.append(f"it is {certificate.dynamics_residual:.2g} off the dynamics")
    if not certificate.policy_residual <= LAW:
        contradictions.append(f"its controls are {certificate.policy_residual:.2g} off the policy's")
    if certificate.limits > 0:
        contradictions.append(f"a control is {certificate.limits:.2g} beyond its limit")
    if certificate.violation > 0 and not kept:
        contradictions.append(f"a constraint is missed by {certificate.violation:.2g}")
    if not abs(certificate.cost - claimed) <= COST * abs(certificate.cost) + rounding:
        contradictions.append(f"it costs {certificate.cost:.9g}, not {claimed:.9g}")
    if tolerance is not None and not certificate.optimality < SLACK * tolerance:
        contradictions.append(f"its optimality is {certificate.optimality:.2g}, not below {tolerance:g}")
    return ", ".join(contradictions)


class _Reduced:
    """The models about a plan, which are overwritten, and which rows are held.

    The gains (T, m, n) are those of a policy about the plan; multipliers (T+1, R) are those of the constraints' rows,
    those of limits are worked out here.
    """

    def __init__(self, stages: Stages, plan: Motion, gain: Array, multipliers: Array) -> None:
        # Between wide limits, the size of a control is no more than `USED` times what is used of it.
        used, sizes = np.abs(plan.controls).max(axis=0), stages.sizes(plan)
        used = np.where(used > UNUSED * used.max(), used, used.max() or np.inf)
        sizes = sizes._replace(controls=np.minimum(sizes.controls, USED * used))
        self._stages, self._sizes = stages, sizes
        # The costates need no multipliers of limits, which hold controls alone.
        stages.linearize(plan, np.zeros_like(plan.states), multipliers, np.inf)
        inside = (stages.low < plan.controls) & (plan.controls < stages.high)
        costates, slopes = stages.adjoint(np.where(inside[:, :, None], gain, 0.0))
        stages.linearize(plan, costates, multipliers, 0.0)
        if (sizes.controls < stages.about.control_size).any():
            changes = np.concatenate([sizes.states, sizes.controls])
            curves = np.einsum("tii,i->", np.abs(stages.models.hessian), changes**2)
            sizes = self._sizes = sizes._replace(cost=min(sizes.cost, float(curves) / 2))
        forces, limit = multipliers.copy(), stages.owners == -1
        for row, (sign, i, _) in zip(np.flatnonzero(limit), stages.limits, strict=True):
            forces[:-1, row] = sign * slopes[:, i]
        numbers = stages.values(plan) / sizes.rows
        at_zero = stages.live & (stages.equality | (numbers <= AT_ZERO) | ((forces > 0) & ~limit))
        pressing: Flags = forces * sizes.rows / sizes.cost > PRESSING
        self._scale = max(sizes.cost, float(np.abs(forces * sizes.rows).max(initial=0.0, where=at_zero)))
        self._all: Flags = at_zero
        self._strict: Flags = at_zero & (stages.equality | pressing)

    def check(self) -> tuple[Curvature, Motion | None]:
        """A saddle if it bends down with all rows held that are at zero; a minimum if it bends up with fewer held."""
        if self._surely_convex(self._strict):
            return Curvature.MINIMUM, None
        kind, direction = self._recursion(self._all)
        if kind is Curvature.MINIMUM and (self._all & ~self._strict).any():
            kind = self._recursion(self._strict)[0]
            kind = Curvature.SINGULAR if kind is Curvature.SADDLE else kind
        return kind, direction

    def _weights(self, held: Flags) -> Array:
        """Weights (T+1, R) on these rows."""
        return np.where(held & self._stages.live, HELD * self._scale / self._sizes.rows**2, 0.0)

    def _surely_convex(self, held: Flags) -> bool:
        """Whether the curvature is positive beyond doubt, by compiled code, as along most plans."""
        stages, fixed = self._stages, np.zeros((self._stages.steps, self._stages.m), dtype=bool)
        for row, (_, i, _) in zip(np.flatnonzero(stages.owners == -1), stages.limits, strict=True):
            fixed[:, i] |= held[:-1, row]
        least = stages.least_curvatures(self._weights(held & (stages.owners >= 0)), fixed)
        return least is not None and bool((least * self._sizes.controls**2 > CLEAR * self._scale).all())

    def _recursion(self, held: Flags) -> tuple[Curvature, Motion | None]:
        stages, sizes, n = self._stages, self._sizes, self._stages.n
        weighed = self._weights(held)[:, :, None] * stages.slopes
        hessian = stages.models.hessian + np.matmul(weighed.transpose(0, 2, 1), stages.slopes)
        jacobian = stages.models.jacobian
        curve, gains, singular = hessian[-1][:n, :n], np.zeros((stages.steps, stages.m, n)), False
        for t in range(stages.steps - 1, -1, -1):
            both = hessian[t] + jacobian[t].T @ curve @ jacobian[t]
            terms = np.abs(hessian[t]) + np.abs(jacobian[t].T) @ np.abs(curve) @ np.abs(jacobian[t])
            block = both[n:, n:] * sizes.controls[:, None] * sizes.controls
            cross = sizes.controls[:, None] * both[n:, :n]
            if not np.isfinite(block).all():
                return Curvature.NOT_CHECKED, None
            values, vectors = np.linalg.eigh((block + block.T) / 2)
            size = float((sizes.controls**2 * np.diag(terms)[n:]).max(initial=0.0))
            usable = values > 0
            for k in np.flatnonzero(values <= max(SUSPECT * size, FLATTER * sizes.cost)):
                bent, direction = self._along(t, sizes.controls * vectors[:, k], gains, held)
                if bent < 0:
                    return Curvature.SADDLE, direction
                singular |= bent == 0
                usable[k] &= bent > 0
            basis = vectors[:, usable]
            inverse = (basis / values[usable]) @ basis.T
            gains[t] = -sizes.controls[:, None] * (inverse @ cross)
            curve = both[:n, :n] - cross.T @ inverse @ cross
            curve = (curve + curve.T) / 2
        start = curve[np.ix_(stages.free > 0, stages.free > 0)]
        if len(start):
            scaled = start * sizes.states[stages.free > 0][:, None] * sizes.states[stages.free > 0]
            singular |= bool(np.linalg.eigvalsh(scaled).min() <= FLATTER * sizes.cost)
        return Curvature.SINGULAR if singular else Curvature.MINIMUM, None

    def _along(self, begin: int, control: Array, gains: Array, held: Flags) -> tuple[int, Motion]:
        """The sign of the curvature along a change of the control (m,) at a step to which later controls respond.

        1 also for a direction that leaves rows which are held; 0 where only rounding is left. And the direction.
        """
        stages, sizes, n = self._stages, self._sizes, self._stages.n
        changes = np.zeros((stages.steps + 1, n + stages.m))
        changes[begin, n:] = control
        for t in range(begin, stages.steps):
            if t > begin:
                changes[t, n:] = gains[t] @ changes[t, :n]
            changes[t + 1, :n] = stages.models.jacobian[t] @ changes[t]
        typical = np.concatenate([sizes.states, sizes.controls])
        largest = float((np.abs(changes) / typical).max())
        changes /= largest
        moved = np.abs(np.einsum("trw,tw->tr", stages.slopes, changes)) / sizes.rows
        direction = Motion(changes[:, :n].copy(), changes[:-1, n:].copy())
        if (moved[held] > TANGENT).any():
            return 1, direction
        along = float(np.einsum("ti,tij,tj->", changes, stages.models.hessian, changes))
        terms = float(np.einsum("ti,tij,tj->", *(np.abs(part) for part in (changes, stages.models.hessian, changes))))
        flat = max(FLAT * terms, FLATTER * sizes.cost)
        return (0 if abs(along) <= flat else 1 if along > 0 else -1), direction
