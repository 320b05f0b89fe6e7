"""The force limits of an MJCF as constraints: class and kernel.

MuJoCo clips forces. Past a limit, a control has no effect, and a solver cannot tell how to come back: a servo with a
stiffness of 4,500 N m/rad and 87 N m is past it at 0.02 rad from its target. So plans are made with dynamics without
these limits and with the limits as constraints, where forces are linear in the state and the control. Such a plan
never clips, and both models are the same along it.
"""

from collections.abc import Sequence

import numpy as np

from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError
from lqrsim.kernels.declarations import M, N, W
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.solution_parts import Trajectory
from lqrsim.robots.mjcf_dynamics import MjcfDynamics
from lqrsim.scenes.mjcf_holding import ForceLimit

# Fraction of its range that a plan keeps a force from its limits: MuJoCo's implicit integrators step differently where
# a force is clipped, by however little.
SPARED = 1e-3
MORE = 0.02  # largest further fraction that is spared for a force that was beyond its limit at another physics step


class ForceLimits(Constraint):
    """The forces of actuators and joints within their limits, at two instants of each control period.

    One is its beginning. The other is the physics step at which a plan's force is nearest to a limit, or beyond it: a
    stiff servo's force can change its sign within a period. The state there is predicted by its derivatives along a
    plan, and before there is one by those at the start. `smooth` chooses instants and derivatives again along its own
    plan as long as a force is beyond its limit at a physics step.

    `MjcfRobot.force_limits` makes it, for problems with `MjcfRobot.unlimited` as their dynamics. Limits of actuators
    whose forces are not linear, such as those of muscles, stay in the dynamics.

    Attributes:
      limits: the limited forces, L of them.
      later: (K, L, 1+n+m) each force at the second instant, of each of K steps or of all: its value at zero, and its
        slopes in state and control; None for the beginning alone.
      spared: (K, L) further distances from the limits there: what earlier plans went beyond them, at whatever step, but
        at most `MORE` of the range for each.
    """

    def __init__(
        self, limits: Sequence[ForceLimit], later: Array | None = None, spared: Array | float = 0.0
    ) -> None:  # fmt: skip
        self.limits, self.later, self.spared = tuple(limits), later, spared

    def removed_from(self, dynamics: MjcfDynamics) -> MjcfDynamics:
        """Dynamics without these limits."""
        actuators, joints = (tuple(one.id for one in self.limits if one.of_joint is joint) for joint in (False, True))
        return dynamics.unlimited(actuators, joints)

    def with_ends(self, dynamics: MjcfDynamics, state: Array, control: Array, dt: float) -> "ForceLimits":
        """These limits at the last physics step of each period, too, predicted by the derivatives at a state."""
        last = dt - dynamics.period
        if last <= 0:
            return self
        return ForceLimits(self.limits, _ahead(self._slopes, *dynamics.linearize(state, control, last))[None])

    @property
    def _slopes(self) -> Array:
        """(L, 1+n+m)."""
        return np.stack([one.slopes for one in self.limits])

    def _refined(self, dynamics: Dynamics, plan: Trajectory) -> "ForceLimits | None":
        assert isinstance(dynamics, MjcfDynamics)
        count, slopes = round(plan.dt / dynamics.period), self._slopes
        if count < 2:
            return None
        low, high = (np.array([getattr(one, side) for one in self.limits]) for side in ("low", "high"))
        beyond = False
        later, spared = np.empty((plan.steps, *slopes.shape)), np.zeros((plan.steps, len(slopes)))
        for t in range(plan.steps):
            state, control = plan.states[t], plan.controls[t]
            places = [dynamics.step(state, control, k * dynamics.period) for k in range(1, count)]
            forces = np.array([slopes[:, 0] + slopes[:, 1:] @ np.concatenate([place, control]) for place in places])
            excess = np.maximum(forces - high, low - forces)
            worst = excess.argmax(axis=0)
            beyond |= bool((excess > 0).any())
            spared[t] = np.clip(excess.max(axis=0), 0.0, MORE * (high - low))
            for k in set(worst.tolist()):
                ahead = _ahead(slopes, *dynamics.linearize(state, control, (k + 1) * dynamics.period))
                later[t, worst == k] = ahead[worst == k]
        first = self.later is None or len(self.later) == 1  # whose derivatives are not those along a plan
        return ForceLimits(self.limits, later, 0.0 if first else self.spared + spared) if beyond else None

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
        for one in self.limits:
            if len(one.slopes) != 1 + n + m:
                got = f"forces of {len(one.slopes) - 1} states and controls"
                raise InputError(f"ForceLimits: got {got}, want {n + m}, as the dynamics have")
        later = self._slopes[None] if self.later is None else self.later
        table = np.concatenate([np.broadcast_to(self._slopes, later.shape), later], axis=1)
        limits, described = (*self.limits, *self.limits), []
        for side, word in (("low", "at least"), ("high", "at most")):
            described += [f"the force {one.name} of {word} {getattr(one, side):g} {one.unit}" for one in limits]
        low, high = (table.copy(), -table)
        ranges = np.array([one.high - one.low for one in limits])
        spared = np.broadcast_to(SPARED * ranges, low.shape[:2]).copy()
        spared[:, len(self.limits) :] += self.spared
        low[..., 0] -= [one.low for one in limits] + spared
        high[..., 0] += [one.high for one in limits] - spared
        rows = np.concatenate([low, high], axis=1)
        return ConstraintTerm(
            source_of(__name__), np.concatenate([rows.shape[:2], rows.ravel()]), rows.shape[1], described.__getitem__,
            uses_control=True, convex=True, ranges=np.tile(ranges, 2),
        )  # fmt: skip


def _ahead(slopes: Array, a: Array, b: Array, c: Array) -> Array:
    """Forces (L, 1+n+m) of the state A x + B u + c, by x and u."""
    n = len(c)
    by_state, by_control = slopes[:, 1 : 1 + n], slopes[:, 1 + n :]
    return np.hstack([slopes[:, :1] + (by_state @ c)[:, None], by_state @ a, by_state @ b + by_control])


# The kernel. `data` has the numbers of steps and rows, and for each step and row its value at zero and its slopes.


def value(x, u, t, row, data):
    """The distance to a limit."""
    first = row_at(t, row, data)
    total = data[first]
    for i in range(N):
        total += data[first + 1 + i] * x[i]
    for i in range(M):
        total += data[first + 1 + N + i] * u[i]
    return total


def slope(x, u, t, row, data, gradient):
    """Add its gradient (W,)."""
    first = row_at(t, row, data)
    for i in range(W):
        gradient[i] += data[first + 1 + i]


def row_at(t, row, data):
    """The index at which the numbers of a row at a step begin."""
    return 2 + (min(t, int(data[0]) - 1) * int(data[1]) + row) * (1 + W)
