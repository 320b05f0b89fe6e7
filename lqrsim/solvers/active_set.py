"""Newton steps with constraints to an optimum that is near, as that of a problem that was solved a moment ago.

Each step goes to the optimum of the quadratic problem that models of second order make about the plan, with linearised
dynamics and constraints; gaps between the steps of the plan are closed on the way. The interior point would find it
from inside; here the rows that press are known but for a few, and are held at zero. Pivoting finds the others: rows
that pull are let go and rows that are missed are held, of neighbouring steps only the worst, for what holds one holds
them all. Where that does not bring fewer wrong ones, they change one at a time, which ends if the models are convex.

Models of second order have a minimum only where the right rows are held. So which these are is first asked of convex
models, where those that pressed before do not do; the step itself is of second order as far as that has a minimum.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.errors import Array
from lqrsim.kernels.records import Limits, Motion
from lqrsim.solvers.common import INSIDE
from lqrsim.solvers.interior_point import AT_LIMIT, MIXES, REGULARISATION, Measures, Stages

Flags = npt.NDArray[np.bool_]

STEPS = 12  # at most: what takes more does not get there
PIVOTS, FEW = 15, 4  # of the rows in a convex problem, at most; and in one that need not be
PATIENCE = 3  # pivots that do not bring fewer wrong rows, before they change one at a time
SHARES = (0.0, 0.3)  # of the convex models in those of a step, tried in turn
PENALTY = 8.0  # that holds the policy to the constraints, in cost for a change by a row's size
ROUNDING = 1e-10  # of a row's size, by which it may be missed by a model


class ActiveSet:
    """The steps from one plan.

    Args:
      stages: of the problem.
      plan: states (T+1, n) and controls (T, m) to begin with, which need not be a motion; the first state is the start.
      multipliers: of the constraints, (T+1, rows) each, or none.
      violation: by how much equalities may be missed; a share of that is what inequalities are to have to spare.

    Attributes:
      plan: where the steps have come to. measures: of that. force, held: of the live rows (K,) the multipliers, and
        which are held at zero. sizes: by how much things change. hopeless: whether it is an optimum but for rows that
        no multiplier brings to be kept.
    """

    def __init__(self, stages: Stages, plan: Motion, multipliers: tuple[Array, ...], violation: float) -> None:
        self.stages, self.plan, self._violation = stages, plan, violation
        self.hopeless = False
        stages.act_at(plan)
        shape, live = stages.live.shape, stages.live
        force = np.zeros(shape)
        for k, one in enumerate(multipliers):
            force[:, stages.owners == k] = one
        self.force = force[live]
        self._equality = np.broadcast_to(stages.equality, shape)[live]
        self._limit = np.broadcast_to(stages.owners == -1, shape)[live]
        self._aim = np.where(self._equality | self._limit, 0.0, INSIDE * violation)
        self._costates = np.zeros((stages.steps + 1, stages.n))
        self._where = np.nonzero(live)
        stages.second_order(plan, self._costates, np.zeros(shape), np.inf, second=False)
        self.sizes = stages.sizes_of(plan, stages.models.hessian)
        self._size = np.broadcast_to(self.sizes.rows, shape)[live]
        self._costates, _ = self._adjoint()
        self.held = self._equality | (self.force > 0)
        self.held |= self._limit & (stages.values(plan)[live] <= AT_LIMIT * self._size)
        self._measure()

    def run(self, tolerance: float, watch: Callable[[Measures], bool], due: Callable[[], bool]) -> bool:
        """Go on until the measures are within tolerance; whether they are.

        Args:
          tolerance: of stationarity, gaps and complementarity.
          watch: called with the measures after each step; True ends it.
          due: called before each pivot; True ends it where the plan was before that step.
        """
        self._due = due
        ended = False
        for _ in range(STEPS):
            before = self.measures
            if self._within(tolerance) or ended or not self._step():
                break
            ended = watch(self.measures) or not np.isfinite(self.measures.cost)
            # Where all else is right, what is still missed cannot be kept.
            idle = max(before.stationarity, before.gap) < tolerance
            self.hopeless = idle and self.measures.violation > 0.5 * before.violation > self._violation
            ended = ended or self.hopeless
        return self._within(tolerance)

    def law(self) -> tuple[Motion, Array]:
        """The motion that the plan comes to with gains about it (T, m, n), and these.

        The gains are those of a step with a price on missing the rows that press, and zero at limits.
        """
        stages, low, high = self.stages, self.stages.low, self.stages.high
        sigma = np.where(self._limit, 1 / REGULARISATION, PENALTY) * self._scale / self._size**2
        none = np.zeros((stages.steps, stages.n))
        for share in MIXES:
            models = self._with(self._hessian(share), stages.models.gradient, self.held, sigma, np.zeros(len(sigma)))
            if stages.direction(*models, none):
                break
        else:
            stages.gain[...] = 0.0
        held = stages.spread((self.held & self._limit).astype(np.float64))[:-1, stages.owners == -1]
        controls, gain = np.clip(self.plan.controls, low, high), stages.gain.copy()
        for (_, i, side), at in zip(stages.limits, held.T > 0, strict=True):
            controls[at, i], gain[at, i] = side, 0.0
        box = Limits(*(np.tile(side, (stages.steps, 1)) for side in (low, high)))
        plan = Motion(self.plan.states, controls)
        return stages.follow(plan, 0.0, (gain, np.zeros_like(controls)), box), gain

    def multipliers(self) -> list[tuple[Array, float]]:
        """Of each constraint the multipliers (T+1, rows), and the price that the policy has."""
        spread, owners = self.stages.spread(self.force), self.stages.owners
        sizes = [self.sizes.rows[owners == k] for k in range(len(self.stages.problem.constraint_terms))]
        prices = [PENALTY * self._scale / float(np.median(size**2)) if len(size) else 1.0 for size in sizes]
        return [(spread[:, owners == k].copy(), price) for k, price in enumerate(prices)]

    def _adjoint(self) -> tuple[Array, Array]:
        return self.stages.adjoint(in_c_order(self.stages.models.gradient - self.stages.pull(self.force)))

    def _measure(self) -> None:
        """Make the models about the plan, and work out the measures."""
        stages = self.stages
        cost = stages.second_order(self.plan, self._costates, stages.spread(self.force), 0.0)
        self._convex = False
        self._numbers = stages.values(self.plan)[stages.live]
        self._gaps = stages.models.arrived - self.plan.states[1:]
        self._scale = max(abs(cost), 1e-6 * self.sizes.cost) if np.isfinite(cost) else np.nan
        _, slopes = self._adjoint()
        missed = np.where(self._equality, np.abs(self._numbers), -self._numbers)
        product = np.where(self._equality, 0.0, np.abs(self._numbers) * self.force)
        self.measures = Measures(
            cost=cost, stationarity=float((np.abs(slopes) * self.sizes.controls).max()) / self._scale,
            violation=float(missed.max(initial=0.0)), gap=float((np.abs(self._gaps) / self.sizes.states).max()),
            complementarity=float(product.max(initial=0.0)) / self._scale,
        )  # fmt: skip

    def _within(self, tolerance: float) -> bool:
        found = self.measures
        # What leads from the plan to a motion must not take constraints beyond what they have to spare.
        right = max(found.stationarity, found.gap / INSIDE, found.complementarity) < tolerance
        kept = np.where(self._equality, np.abs(self._numbers) <= self._violation, self._numbers >= 0)
        return right and bool(kept.all())

    def _step(self) -> bool:
        """One step; False where there is none."""
        found = self._pivoted(0.0, self.held, 0)
        if found is None or found[2]:
            convex = self._pivoted(1.0, self.held, PIVOTS)
            if convex is None:
                return False
            for share in (*SHARES, 1.0):
                found = self._pivoted(share, convex[0], FEW if share < 1 else 0)
                if self._due():
                    return False
                if found is not None and (share == 1 or not found[2]):
                    break
            else:
                return False
        stages = self.stages
        self.held, force, _ = found
        self.force = np.where(self._equality, force, np.maximum(force, 0.0))
        self._costates = stages.to_go.gradient.copy()
        self.plan = Motion(self.plan.states + stages.changes.states, self.plan.controls + stages.changes.controls)
        self._measure()
        return True

    def _pivoted(self, share: float, held: Flags, most: int) -> tuple[Flags, Array, int] | None:
        """Solve the quadratic problem by so many pivots at most, from rows (K,) that are held.

        The change of the plan is in `stages`.

        Returns:
          The rows that are held, the multipliers (K,), and how many of the rows are wrong; None without a minimum.
        """
        stages, hessian = self.stages, self._hessian(share)
        numbers = self._numbers - self._aim
        fewest, patience = len(held) + 1, PATIENCE
        for pivot in range(most + 1):
            if pivot > 0 and self._due():
                return None
            sigma = np.where(held, self._scale / (REGULARISATION * self._size**2), 0.0)
            force = np.where(held, self.force, 0.0)
            models = self._with(hessian, stages.models.gradient, held, sigma, sigma * numbers - force)
            if not stages.direction(*models, self._gaps):
                return None
            ahead = numbers + np.matmul(stages.slopes, stages.joined()[:, :, None])[:, :, 0][stages.live]
            force = force - sigma * ahead
            pulls = np.where(held & ~self._equality, force * self._size / self._scale, 0.0)
            misses = np.where(held, 0.0, ahead / self._size)
            wrong = (pulls < -ROUNDING) | (misses < -ROUNDING)
            count = int(wrong.sum())
            if count == 0 or pivot == most:
                return held, force, count
            fewest, patience = (count, PATIENCE) if count < fewest else (fewest, patience - 1)
            held = held ^ (self._worst(pulls) | self._worst(misses) if patience > 0 else _last(wrong))
        return None

    def _worst(self, numbers: Array) -> Flags:
        """Which of the live rows are below zero, and no higher than at the steps before and after."""
        below = np.pad(self.stages.spread(np.where(numbers < -ROUNDING, numbers, 0.0)), ((1, 1), (0, 0)))
        here = below[1:-1]
        return ((here < 0) & (here <= below[:-2]) & (here < below[2:]))[self.stages.live]

    def _hessian(self, share: float) -> Array:
        models = self.stages.models
        if share == 0:
            return models.hessian
        if not self._convex:
            self.stages.convexify(self.plan)
            self._convex = True
        return (1 - share) * models.hessian + share * models.convex if share < 1 else models.convex

    def _with(self, hessian: Array, gradient: Array, held: Flags, weights: Array, pulls: Array) -> tuple[Array, Array]:
        """A Hessian and a gradient with what the rows (K,) that are held add: by a weight, and by a slope."""
        rows = np.flatnonzero(held)
        steps = self._where[0][rows]
        slopes = self.stages.slopes[steps, self._where[1][rows]]
        hessian, gradient = hessian.copy(), gradient.copy()
        np.add.at(hessian, steps, weights[rows, None, None] * slopes[:, :, None] * slopes[:, None, :])
        np.add.at(gradient, steps, pulls[rows, None] * slopes)
        return hessian, gradient


def _last(wrong: Flags) -> Flags:
    """Of rows, the last one that is wrong."""
    last = np.zeros_like(wrong)
    last[np.flatnonzero(wrong)[-1]] = True
    return last
