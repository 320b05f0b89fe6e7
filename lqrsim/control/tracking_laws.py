"""Tracking laws: a further backward pass that minimises deviations from a plan instead of its cost.

With z = (e, a, d) as in `plan_model.py` and u the deviation of the command, it minimises

    sum_t  e' (Q + E_t) e + (u + M_t d)' R (u + M_t d)  +  e_T' (Q_T + E_T) e_T.

E_t is the emphasis on deviations that lead to a collision; see `Surroundings.emphasis`. M_t d is the control that
cancels the unknowns' effect on the next state as far as controls can. It costs nothing; otherwise a steady disturbance
would leave a steady error. For the same reason a law assumes that the current disturbance continues: a law that expects
a wind to abate yields to one that does not.

If commands get lost, the law minimises the expected sum over the losses (Schenato 2009: LQG with a hold). When a
command is lost, the previous one is held. It may be large, which makes the law gentle. The effort of a lost command
does not count.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lqrsim.annotations import Positive, checked
from lqrsim.codegen.compiled_module import module_of
from lqrsim.codegen.sources import source_of
from lqrsim.control.plan_model import PlanModel
from lqrsim.control.uncertainty import per_entry
from lqrsim.errors import Array, InputError, check_kind
from lqrsim.kernels import recursions
from lqrsim.kernels.records import PassArrays, PassSizes, PassWork
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.problem import Problem
from lqrsim.results.coordinates import PerEntry, check_same_system, spaces_of
from lqrsim.results.solution import Solution

CONTROL_SHARE = 0.25  # default of the largest change of a control, relative to the range between its limits
# The tolerances of the position at the plan's end, relative to those before. Reaching a goal depends on the position
# alone; controls that also bring the velocity to rest there have less effort left for it.
AT_END = 0.1


class Laws(NamedTuple):
    """A law u = gain z + offset in deviations from a plan, or C laws to compare."""

    gain: Array  # (T, m, Z), or (C, T, m, Z)
    offset: Array  # (T, m), or (C, T, m)

    def pick(self, i: int) -> "Laws":
        """One of C."""
        return Laws(self.gain[i], self.offset[i])


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of deviations from a plan: a deviation that is just tolerated costs 1."""

    state: Array  # the diagonal of Q, (n,); or C diagonals to compare, (C, n)
    control: Array  # the diagonal of R, (m,)
    end: Array  # the diagonal of Q_T, (n,) or (C, n)
    emphasis: Array | None = None  # E, further weights at each knot, (T+1, n, n) or (C, T+1, n, n); None for none

    @classmethod
    @checked
    def of(cls, tolerate: PerEntry, effort: Array, dynamics: Dynamics, *, at_end: Positive = AT_END) -> "Weights":
        """The weights for tolerances in the states' units and efforts (m,); `at_end` as in `track`."""
        space = dynamics.state_coordinates
        state = per_entry("tolerate", tolerate, space, above=0.0)
        end, last = state.copy(), list(space.position) or slice(None)
        end[last] *= at_end
        return cls(state**-2.0, effort**-2.0, end**-2.0)

    def pick(self, i: int | None) -> "Weights":
        """One of C; with None, those of a single law as the only ones of C = 1."""
        emphasis = None if self.emphasis is None else self.emphasis[i]
        return Weights(self.state[i], self.control, self.end[i], emphasis)

    def stressing(self, emphasis: Array, factors: tuple[float, ...]) -> "Weights":
        """These with an emphasis (T+1, n, n) times each of C factors, as those of C laws to compare."""
        many, factor = np.ones((len(factors), 1)), np.array(factors)[:, None, None, None]
        return Weights(many * self.state, self.control, many * self.end, factor * emphasis)


def effort_of(effort: PerEntry | None, dynamics: Dynamics) -> Array:
    """Return the tolerated effort of each control, (m,); by default a fraction of its range."""
    controls = dynamics.control_coordinates
    if effort is not None:
        return per_entry("effort", effort, controls, above=0.0)
    ranges = np.subtract(controls.high, controls.low)
    for name, size in zip(controls.labels, ranges, strict=True):
        if not np.isfinite(size):
            raise InputError(f"effort: got none, and {name} has no limits to derive it from, want effort= in its unit")
    return CONTROL_SHARE * ranges


def tracking_laws(model: PlanModel, weights: Weights, noise: Array | None = None, risk: float = 0.0) -> Laws:
    """The law for these weights, or the laws for C of them.

    With noise on the states, M (T, n, k), a law is averse to large deviations; the risk is theta, for half the sum that
    it minimises. Raises LinAlgError if the risk is too high.

    The cost-to-go 1/2 y' S y + y' (D d + s) of y = (e, a) is a quadratic of (y, d, 1, u) at the previous knot. The cost
    of d alone does not change the law.
    """
    n, m, steps, lost = model.n, model.m, model.plan.steps, model.uncertainty.command_loss
    movable, width = n + model.lagging, model.size + 1  # the states that controls can move, and numbers of (y, d, 1)
    state, end = np.atleast_2d(weights.state), np.atleast_2d(weights.end)
    # (y', d, 1) of (y, d, 1, u): the law assumes that d goes on as it is.
    (F, G, c), forward = model.arriving, np.zeros((steps, width, width + m))
    forward[:, :movable] = np.concatenate([F, c[:, :, None], G], axis=2)[:, :movable]
    forward[:, range(movable, width), range(movable, width)] = 1.0
    adjoint = np.concatenate([F[:, :movable, :movable], G[:, :movable]], axis=2).transpose(0, 2, 1)
    held = np.zeros((steps, m, width))
    if lost:  # a lost command is that in force, which is a
        held[:, range(m), range(n, movable)], held[:, :, -1] = 1.0, model.reached[:-1] - model.plan.controls
    compensation = np.zeros((steps, len(state), m, width))
    # M_t, (C, T, m, D), by Q.
    B = model.jacobian[:, :, n:]
    weighed = B.transpose(0, 2, 1) * state[:, None, None, :]
    curve = weighed @ B
    efforts = np.sqrt(weights.control.min() / weights.control)  # the units in which all controls are alike
    least = 1e-9 * np.vecdot(np.diagonal(curve, axis1=-2, axis2=-1), efforts**2) + 1e-300
    cancelling = np.linalg.inv(curve + least[..., None, None] * np.diag(efforts**-2)) @ (weighed @ model.E)
    compensation[..., movable:-1] = weights.control[:, None] * cancelling.swapaxes(0, 1)
    cost, products = np.zeros((len(state), movable, width)), np.empty((len(state), movable + m, width + m))
    cost[:, range(n), range(n)] = end
    emphasis = None if weights.emphasis is None else weights.emphasis.reshape(len(state), steps + 1, n, n)
    if emphasis is not None:
        cost[:, :n, :n] += emphasis[:, steps]
    stage = np.zeros((len(state), movable))
    stage[:, :n] = state
    sizes, laws = PassSizes(len(state), movable, model.size, m, lost), np.empty(compensation.shape)
    arrays = PassArrays(weights.control, stage.ravel(), compensation.ravel(), held.ravel(), laws.ravel())
    work = PassWork(cost.ravel(), products.ravel(), np.empty(len(state) * m * m), np.empty(m * width))
    improve = module_of(source_of(recursions), "tracking laws").lay_out("improve", 0, sizes, arrays, work)
    for t in range(steps - 1, -1, -1):
        if noise is not None:  # under the worst of it, the Hessian is S + S Y S, and the gradient s + S Y s
            S, M = cost[0, :, :movable], np.zeros((movable, noise.shape[2]))
            M[:n] = noise[t]
            inner = np.eye(M.shape[1]) - risk * M.T @ S @ M
            np.linalg.cholesky(inner)
            spread = risk * S @ M @ np.linalg.solve(inner, M.T)
            cost[0, :, :movable], cost[0, :, -1] = S + spread @ S, cost[0, :, -1] + spread @ cost[0, :, -1]
        np.matmul(adjoint[t], cost @ forward[t], out=products)
        improve(t, sizes, arrays, work)
        if emphasis is not None:
            cost[:, :n, :n] += emphasis[:, t]
    chosen = Laws(laws.swapaxes(0, 1)[..., :-1], laws.swapaxes(0, 1)[..., -1])
    return chosen if weights.state.ndim == 2 else chosen.pick(0)


def check_plan(who: str, problem: Problem, solution: Solution) -> None:
    """Raise InputError unless the solution has a finite plan of the problem's system and control period."""
    check_kind(f"{who}: problem", problem, Problem, "a Problem, such as scenario.problem")
    check_kind(f"{who}: solution", solution, Solution, "a Solution of it")
    plan, want = solution.trajectory, spaces_of(problem.dynamics)
    check_same_system(f"{who}: solution", "a plan", spaces_of(solution.policy), want, "the problem")
    if plan.dt != problem.dt:
        raise InputError(f"{who}: solution: got a control period of {plan.dt:g} s, want the problem's {problem.dt:g} s")
    if not plan.finite:
        raise InputError(f"{who}: solution: got a plan that is not finite ({solution.status.name}), want one that is")
