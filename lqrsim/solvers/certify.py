"""Certificates: before a solver reports success, its plan is checked against the problem itself.

`kernels/certificate.py` recomputes cost, dynamics, policy and optimality on a separate code path. This module compares
them with the solver's claims; `SolveRun.certified` calls both.
"""

import numpy as np

from lqrsim.errors import Array
from lqrsim.kernels.records import CERTIFICATE, CostToGo
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.results.solution_parts import Certificate

# Tolerances for rounding: of the residuals of policy and dynamics, and of the cost, relative to it. A policy's control
# is a sum of a few terms; a step of the dynamics is some hundred operations, which amplify each other's rounding.
LAW, MOTION, COST = 1e-11, 1e-8, 1e-8
CANCELLATION = 1e-13  # rounding error of a cost, relative to the size of its terms, which may cancel
# An optimal cost may be almost zero. Optimality is then relative to this fraction of the cost of typical changes.
TYPICAL = 1e-6
# Factor by which a certificate's optimality may exceed the tolerance. It is computed about the plan; the solver's own,
# about states that are within the gap tolerance of the plan.
SLACK = 2.0


def no_value(states: Array) -> CostToGo:
    """A cost-to-go of zero along states (T+1, n): arguments where there is none."""
    knots, n = states.shape
    return CostToGo(np.zeros((knots, n, n)), np.zeros((knots, n)), np.zeros(knots))


def certificate_of(
    problem: Problem, row: np.void, states: Array, *, violation: float, least: float = 0.0
) -> Certificate:
    """Make the certificate of a plan with states (T+1, n) from the numbers that `kernels/certificate.py` wrote.

    The optimality is the predicted decrease of the cost relative to the cost, or to `least` if that is more: with a
    free duration, the cost of time.
    """
    cost, scale, typical, motion, law, beyond, decrease, _ = (float(row[name]) for name in CERTIFICATE.names or ())
    start = 0.0
    if isinstance(problem.initial, FixedState):
        start = float(np.abs(states[0] - problem.initial.numbers).max())
    if not np.isfinite(cost):
        decrease = np.inf
    # Where typical changes are less than the rounding of the cost, as beside the cost of noise that no control damps,
    # the decrease is relative to them.
    size = typical if 0 < typical < CANCELLATION * abs(cost) else abs(cost)
    least = max(size, least, TYPICAL * typical, 1e-26 * scale, 1e-300)
    optimality = decrease / least if np.isfinite(decrease) else np.inf
    return Certificate(
        cost=cost, start=start, dynamics_residual=motion, policy_residual=law, limits=max(beyond, 0.0),
        violation=violation, optimality=optimality,
    )  # fmt: skip


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
