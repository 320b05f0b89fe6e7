"""LQR smoothing of linear-quadratic problems: Sec. IV of the paper."""

import contextlib
import time
from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np
import numpy.typing as npt
from scipy.linalg import matrix_balance

from lqrsim.annotations import OneOf, Positive, checked
from lqrsim.errors import Array, InputError, check_array, check_memory, check_symmetric, excerpt, keep
from lqrsim.kernels.records import LinearStep, QuadraticStage, RiccatiArrays, zeros_of
from lqrsim.machine import versions
from lqrsim.problem.problem import FixedState
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Certificate, Iteration, Moments, Quadratic, Status, Trajectory
from lqrsim.solvers import compiled

ACCURACY = 1e-6  # relative accuracy of cost and states that a solved problem must have
ROUNDING = 1e-14  # of a cost in which larger terms cancel, the part of these terms that is taken for rounding
_WHICH = ("backward pass", "forward pass", "minimum of the total cost")  # the passes that `lq_passes` numbers
WEIGH_MORE = "raise the weights of states or controls, or shorten the horizon: the cost has no single minimum"


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """Linear dynamics and a quadratic cost.

        step (discrete) or rate (continuous) of x:   A x + B u + c
        cost of the step, or a second of it:         1/2 x'Q x + 1/2 u'R u + u'P x + q'x + r'u + constant

    An array with a leading axis of T has one entry per step; an array without that axis is the same at every step. All
    arrays except A, B and R may be left out and are then zero. Paper: Eqs. (4), (7).

    B is (..., n, m), A and Q (..., n, n), P (..., m, n), R (..., m, m), c and q (..., n), r (..., m), constant (...). Q
    and R are symmetric, R positive definite.
    """

    A: npt.ArrayLike
    B: npt.ArrayLike
    R: npt.ArrayLike
    c: npt.ArrayLike | None = None
    Q: npt.ArrayLike | None = None
    P: npt.ArrayLike | None = None
    q: npt.ArrayLike | None = None
    r: npt.ArrayLike | None = None
    constant: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        shape = _shape(self.B)
        if len(shape) not in (2, 3):
            raise InputError(f"Stage: B: got {excerpt(self.B)}, want an array (n, m) or, one per step, (T, n, m)")
        if 0 in shape:
            raise InputError(f"Stage: B: got shape {shape}, want at least one of each")
        n, m = shape[-2:]
        check_memory("Stage: B", n, 8 * n * (shape[0] if len(shape) == 3 else 1), "whose A")
        shapes = {
            "A": (n, n), "B": (n, m), "c": (n,), "Q": (n, n), "P": (m, n), "R": (m, m), "q": (n,), "r": (m,),
            "constant": (),
        }  # fmt: skip
        # Time is the leading axis of any of the arrays; arrays without that axis are the same at each step.
        given = {name: _shape(getattr(self, name)) for name in shapes if getattr(self, name) is not None}
        time = max((shape[:1] for name, shape in given.items() if len(shape) == len(shapes[name]) + 1), default=())
        for field in fields(self):
            value, want = getattr(self, field.name), shapes[field.name]
            if value is None:
                if field.name in ("A", "R"):
                    raise InputError(f"Stage: {field.name}: got None, want an array of shape {shapes[field.name]}")
                value = np.zeros(want)
            with contextlib.suppress(Exception):  # ragged, or no array: refused below for its shape
                if time and np.ndim(value) == len(want):  # the same at each step
                    value = np.broadcast_to(value, (*time, *np.shape(value)))
            array = check_array(f"Stage: {field.name}", value, (*time, *want))
            if field.name in ("Q", "R"):
                array = check_symmetric(f"Stage: {field.name}", array)
            keep(self, **{field.name: array})

    @property
    def states(self) -> int:
        return np.shape(self.B)[-2]

    @property
    def controls(self) -> int:
        return np.shape(self.B)[-1]


@checked
def smooth_lq(
    stage: Stage,
    *,
    initial: Quadratic | FixedState,
    final: Quadratic,
    form: Annotated[str, OneOf(compiled.FORMS)] = "dual",
    dt: Positive = 1.0,
) -> Solution:
    """Solve a linear-quadratic problem exactly, by one backward pass and one forward pass. Paper: Sec. IV.

    The states of least total cost are the optimal trajectory, x_hat: Eqs. (21)-(22), Lemma 1.

    Args:
      stage: one stage per step, as arrays with a leading axis T; see `Stage`.
      initial: c_0, a `Quadratic` of arrays (n, n), (n,), (); or a `FixedState`, which only the dual form takes.
      final: c_l, a `Quadratic` of the same form.
      form: "dual" represents the cost-to-come by its moments and needs a positive-definite initial Hessian; "primal" is
        the paper's form and needs an invertible A.
      dt: seconds per step, for the times of the trajectory and the policy.

    Returns:
      A Solution with one iteration. The trajectory is the rollout of the policy. CONVERGED says that its cost equals
      the predicted cost-to-go to a relative accuracy of ACCURACY, which is recorded as the optimality.
      NOT_POSITIVE_DEFINITE says that there is no unique minimum, or none to working precision; the detail says where.
      If the states of least total cost deviate from the plan by more than ACCURACY, rounding has spoilt the
      cost-to-come, which is then left out.
    """
    clock = time.perf_counter()
    parts = _parts(stage)
    passes, failure = _passes(parts, initial, final, form)
    for part in passes.policy if failure else ():
        part[~np.isfinite(part)] = 0.0  # as where the pass did not get, for a policy in a file is finite
    start, detail = _start(passes, failure, initial)
    states, controls, value = _rollout(parts, passes.policy, start)
    begun = float(initial(states[0])) if isinstance(initial, Quadratic) else 0.0
    value += float(final(states[-1])) + begun
    gap, residual, optimality = np.inf, np.inf, np.inf
    if not detail:
        predicted = float(Quadratic(*(part[0] for part in passes.to_go))(start)) + begun
        with np.errstate(all="ignore"):
            # If terms of the cost at the origin or of the cost-to-go cancel, a rounding error relative to them remains.
            terms = float(np.abs(parts[-1]).sum()) + abs(float(final.constant))
            terms += abs(float(initial.constant)) if isinstance(initial, Quadratic) else 0.0
            terms += float(Quadratic(*(np.abs(part[0]) for part in passes.to_go))(np.abs(start)))
            optimality = abs(value - predicted) / max(abs(value), ROUNDING / ACCURACY * terms, 1e-300)
            gap, residual = _off_plan(parts, passes, states)
        if not optimality < ACCURACY:
            detail = f"too ill-conditioned: the plan costs {value:.9g}, the cost-to-go promised {predicted:.9g}"
    solved = not detail
    close = solved and max(gap, residual) < ACCURACY
    if solved and not close:
        detail = f"the states of least total cost are {gap:.1g} off the plan, so the cost-to-come is left out"
    exact = dict.fromkeys(("start", "dynamics_residual", "policy_residual", "limits", "violation"), 0.0)  # a rollout
    iteration = Iteration(
        cost=value, improvement=np.inf, gap=gap, optimality=optimality, dynamics_residual=residual, violation=0.0,
        seconds=time.perf_counter() - clock, method="smooth",
    )  # fmt: skip
    return Solution(
        status=Status.CONVERGED if solved else Status.NOT_POSITIVE_DEFINITE,
        detail=detail,
        remedy="" if solved else WEIGH_MORE,
        policy=_policy(*passes.policy, states[:-1].copy(), dt),
        inverse_policy=_policy(*passes.smoothing[2:], states[1:].copy(), dt) if close and form == "primal" else None,
        cost_to_go=Quadratic(*passes.to_go) if solved else None,
        cost_to_come=(Moments if form == "dual" else Quadratic)(*passes.to_come) if close else None,
        trajectory=Trajectory(states, controls, dt),
        iterations=(iteration,) if solved else (),
        clearance=None,
        certificate=Certificate(cost=value, optimality=optimality, **exact),
        gap=gap,
        solver="smooth_lq",
        options={"form": form},
        problem_digest=_digest(parts, initial, final),
        versions=versions(),
    )


def _passes(
    parts: tuple[Array, ...], initial: Quadratic | FixedState, final: Quadratic, form: str
) -> tuple[RiccatiArrays, str]:
    """Do one backward and one forward pass; return also the pass that failed, and the step, or an empty text.

    Raises InputError for an end cost, or an A, that the form cannot handle.
    """
    A, B, c, Q, P, R, q, r, constant = parts
    steps, n, m = B.shape
    check_memory("stage: steps", steps, 8 * (6 * n * n + 5 * m * n + 3 * m * m))
    jacobian = np.ascontiguousarray(np.concatenate([A, B], axis=2))
    inverse, c_inverse = (jacobian, c.copy()) if form == "dual" else _inverse(A, B, c)
    cost = np.ascontiguousarray(np.block([[Q, np.swapaxes(P, 1, 2)], [P, R]]))
    slope = np.ascontiguousarray(np.concatenate([q, r], axis=1))
    passes = zeros_of(RiccatiArrays, T=steps, N=n, M=m, S=steps)
    for array, end in zip(passes.to_go, check_end("final", final, n), strict=True):
        array[-1] = end
    for array, begin in zip(passes.to_come, _initial_cost_to_come(initial, n, form), strict=True):
        array[0] = begin
    failed, which = compiled.linear_quadratic(n, m, form).lq_passes(
        steps, LinearStep(jacobian, c.copy()), LinearStep(inverse, c_inverse), QuadraticStage(cost, slope),
        constant.copy(), passes,
    )  # fmt: skip
    failure = f"{_WHICH[which]}, step {failed} of {steps}" if failed >= 0 else ""
    if which > 0 and failed >= 0 and form == "dual" and isinstance(initial, Quadratic) and _invertible(A).all():
        failure += '; try form="primal"'
    return passes, failure


def _start(passes: RiccatiArrays, failure: str, initial: Quadratic | FixedState) -> tuple[Array, str]:
    """The state of least total cost at step 0, and a reason if there is none, else an empty text."""
    if failure or isinstance(initial, FixedState):
        return passes.x_hats[0], failure
    # If every step of the cost-to-go is definite, this alone ensures a unique minimum.
    curve = initial.hessian + passes.to_go.hessian[0]
    if not definite(curve, 0.0):
        return passes.x_hats[0], "minimum of the total cost, step 0"
    return -np.linalg.solve(curve, initial.gradient + passes.to_go.gradient[0]), ""


def _off_plan(parts: tuple[Array, ...], passes: RiccatiArrays, states: Array) -> tuple[float, float]:
    """Gap and dynamics residual of the states of least total cost; see `Iteration`."""
    A, B, c = parts[:3]
    x_hat, (gain, offset) = passes.x_hats, passes.policy
    scale = np.maximum(np.ptp(states, axis=0), 1.0)
    gap = float((np.abs(x_hat - states) / scale).max())
    u_hat = np.einsum("tij,tj->ti", gain, x_hat[:-1]) + offset
    reached = np.einsum("tij,tj->ti", A, x_hat[:-1]) + np.einsum("tij,tj->ti", B, u_hat) + c
    return gap, float((np.abs(x_hat[1:] - reached) / scale).max())


def _policy(gain: Array, offset: Array, nominal: Array, dt: float) -> AffinePolicy:
    _, m, n = gain.shape
    return AffinePolicy(
        gain=gain, offset=offset, nominal=nominal, dt=dt,
        state_coordinates=Coordinates(names=tuple(f"x{i}" for i in range(n)), units=("",) * n),
        control_coordinates=Coordinates(names=tuple(f"u{i}" for i in range(m)), units=("",) * m),
    )  # fmt: skip


@checked
def _parts(stage: Stage) -> tuple[Array, ...]:
    """The stage's arrays. Raises InputError unless there is one stage per step."""
    if np.ndim(stage.B) != 3:
        raise InputError("stage: got a single stage, want one stage per step: B of shape (T, n, m)")
    return tuple(np.asarray(getattr(stage, name)) for name in ("A", "B", "c", *"QPRqr", "constant"))


def _digest(parts: tuple[Array, ...], initial: Quadratic | FixedState, final: Quadratic) -> str:
    ends = [
        np.asarray(part, dtype=np.float64)
        for end in (initial, final)
        for part in ((end.state,) if isinstance(end, FixedState) else (end.hessian, end.gradient, end.constant))
    ]
    return sha256(*parts, *ends)[:16]


def _initial_cost_to_come(initial: Quadratic | FixedState, n: int, form: str) -> tuple[Array, Array, float]:
    """The cost-to-come at step 0: (hessian, gradient, constant), or in the dual form (covariance, mean, constant)."""
    if isinstance(initial, FixedState):
        if form == "primal":
            raise InputError(
                'initial: got a FixedState, want a Quadratic: the primal form has no fixed start; "dual" has'
            )
        return np.zeros((n, n)), check_array("initial: state", initial.numbers, (n,)), 0.0
    hessian, gradient, constant = check_end("initial", initial, n)
    if form == "primal":
        return hessian, gradient, constant
    if not definite(hessian, 1e-12):
        least = np.linalg.eigvalsh(hessian)[0]
        raise InputError(
            f'initial: hessian: got smallest eigenvalue {least:g}, want a positive-definite one; or form="primal"'
        )
    covariance = np.linalg.inv(hessian)
    covariance = 0.5 * (covariance + covariance.T)
    mean = -covariance @ gradient
    return covariance, mean, constant + 0.5 * float(gradient @ mean)


def _invertible(A: Array) -> npt.NDArray[np.bool_]:
    """Whether each step has inverse dynamics, (T,), without which there is no primal form; in any units of states."""
    return np.array([np.linalg.cond(matrix_balance(step, permute=False)[0]) < 1e12 for step in A])


def definite(hessians: Array, least: float) -> npt.NDArray[np.bool_]:
    """Whether Hessians (..., n, n), in any units, have a least eigenvalue beyond `least` times the largest."""
    sizes = np.sqrt(np.maximum(np.diagonal(hessians, axis1=-2, axis2=-1), 0.0))
    sizes = np.where((sizes > 0) & np.isfinite(sizes), sizes, 1.0)
    spectrum = np.linalg.eigvalsh(hessians / sizes[..., :, None] / sizes[..., None, :])
    return spectrum[..., 0] > (least * np.maximum(spectrum[..., -1], 0.0) if least else 0.0)


def _inverse(A: Array, B: Array, c: Array) -> tuple[Array, Array]:
    """The inverse dynamics x_t = Abar x_{t+1} + Bbar u_t + cbar, as [Abar Bbar] (T, n, n+m) and cbar (T, n)."""
    invertible = _invertible(A)
    if not invertible.all():
        step = int(np.argmin(invertible))
        raise InputError(f'stage: A: got a singular matrix at step {step}, want an invertible one, or form="dual"')
    inverse = np.linalg.inv(A)
    return np.ascontiguousarray(np.concatenate([inverse, -inverse @ B], axis=2)), -np.einsum("tij,tj->ti", inverse, c)


def _rollout(parts: tuple[Array, ...], law: tuple[Array, Array], start: Array) -> tuple[Array, Array, float]:
    """States and controls of the policy, and the sum of the stage costs."""
    A, B, c, Q, P, R, q, r, constant = parts
    steps, n, m = B.shape
    states, controls, spent = np.zeros((steps + 1, n)), np.zeros((steps, m)), 0.0
    states[0] = start
    for t in range(steps):
        x = states[t]
        u = controls[t] = law[0][t] @ x + law[1][t]
        spent += 0.5 * x @ Q[t] @ x + 0.5 * u @ R[t] @ u + u @ P[t] @ x + q[t] @ x + r[t] @ u + constant[t]
        states[t + 1] = A[t] @ x + B[t] @ u + c[t]
    return states, controls, float(spent)


def check_end(field: str, cost: Quadratic, n: int) -> tuple[Array, Array, float]:
    """Hessian (n, n), gradient (n,) and constant of an initial or final cost."""
    if not isinstance(cost, Quadratic):
        raise InputError(f"{field}: got {excerpt(cost)}, want a Quadratic")
    hessian = check_symmetric(f"{field}: hessian", check_array(f"{field}: hessian", cost.hessian, (n, n)))
    gradient = check_array(f"{field}: gradient", cost.gradient, (n,))
    return hessian, gradient, float(check_array(f"{field}: constant", cost.constant, ()))


def _shape(value: npt.ArrayLike) -> tuple[int, ...]:
    """The shape; () for ragged input, which has no shape."""
    try:
        return np.asarray(value).shape
    except Exception:  # or an object that raises anything
        return ()
