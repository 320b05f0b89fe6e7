"""Mean and covariance of a closed loop about its plan, by the recursion of LQG-MP.

The true state and the estimate are jointly Gaussian. Their deviation from the plan is X = (y, d). Commands move
y = (e, a, zhat), with zhat before the measurement of the same knot; for a law without an estimate, y = (e, a). Nothing
moves the unknowns d, whose covariance is therefore the same for all laws.

Control limits enter by statistical linearisation: for u normal with mean mu and std sigma, the limited control has the
mean slope P(low < u < high), and the rest of its variance is noise.
For lost commands the moments of the mixture are exact; the distribution itself is not Gaussian.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lqrsim.codegen.compiled_module import CompiledModule, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.control.plan_model import PlanModel
from lqrsim.errors import Array
from lqrsim.kernels import loop_moments
from lqrsim.kernels.records import LoopArrays, LoopMoments, LoopSizes, LoopWork, zeros_of


def moments_of(loops: LoopArrays, stated: int, count: int | None = None, lost: float = 0.0) -> LoopMoments:
    """The moments of the first entries of y, or of all, in each of L systems under each of C laws, (L, C, ...).

    Args:
      stated: number of the first entries of y that are the system's own; with losses, the last m of these are a.
      lost: fraction of the commands that get lost.
    """
    (steps, laws, m, width), (systems, own) = loops.K.shape, loops.F.shape[1:3]
    first = own if count is None else count
    rows, columns, lossy = *loops.noise.shape[2:], 0 < lost < 1
    sizes = LoopSizes(
        steps, systems, laws, own, width, m, first, stated, rows, columns, bool(loops.jointly.size), lossy,
        lost / (1 - lost) if lossy else 0.0,
    )  # fmt: skip
    lengths = {"T": steps, "L": systems, "C": laws, "Y": own, "X": width, "R": width - own, "m": m, "N": first}
    work, found = zeros_of(LoopWork, **lengths), zeros_of(LoopMoments, **lengths)
    P, M = work.P, work.M
    M[..., own:, own:] = loops.transition
    arguments = sizes, *(type(one)(*map(np.ravel, one)) for one in (loops, work, found))
    advance = kernels().lay_out("advance", 0, *arguments)
    for t in range(steps + 1):
        advance(t, *arguments)
        if t < steps:
            np.matmul(M[..., :own, :], P, out=work.moved)
            np.matmul(work.moved, M.swapaxes(-1, -2), out=P[..., :own, :])
    return LoopMoments(*(np.moveaxis(one, 0, 2) for one in found))


def kernels() -> CompiledModule:
    """`kernels/loop_moments.py`, which is compiled once for all sizes."""
    return module_of(source_of(loop_moments), "moments of closed loops")


@dataclass(eq=False)
class LinearLoop:
    """A closed loop about a plan."""

    model: PlanModel
    gain: Array  # (T, m, Z or n) of a law in deviations from the plan, or (C, T, m, Z or n) of C laws
    offset: Array  # (T, m)
    filter_gain: Array | None  # of a Kalman filter, (T+1, Z, Y); None for a law of the measured states
    low: Array
    high: Array
    assumed: PlanModel | None = None  # by the filter, whose estimates have its Z; by default the true system's

    def moments(self, count: int | None = None) -> LoopMoments:
        """The moments of the first entries of y, or of all, from the start to the plan's end."""
        found = self.in_systems([self.model], count)
        return LoopMoments(*(one[0, 0] if self.gain.ndim == 3 else one[0] for one in found))

    def in_systems(self, models: Sequence[PlanModel], count: int | None = None) -> LoopMoments:
        """The moments in several true systems, which differ in no sizes, and in neither sensors nor losses."""
        first, steps, m = models[0], self.model.plan.steps, self.model.m
        n, stated, unknown = first.n, first.n + first.lagging, len(first.transition)
        gain = self.gain.reshape(-1, *self.gain.shape[-3:]).swapaxes(0, 1)
        offset = self.offset.reshape(-1, steps, m).swapaxes(0, 1)
        own = stated if self.filter_gain is None else stated + gain.shape[-1]
        F, K = np.zeros((steps, len(models), own, own + unknown)), np.zeros((*gain.shape[:-1], own + unknown))
        G, c = np.empty((steps, len(models), m, own)), np.empty((steps, len(models), own))
        noise, jointly = np.zeros((steps + 1, len(models), own, own)), np.zeros(0)
        fresh = np.empty((steps + 1, len(models), unknown, unknown))
        if self.filter_gain is None:
            K[..., :n], shaking = gain, gain * first.shown_std
        else:
            # F and K act on the corrected estimate. With losses, all measurements count less.
            assumed, received = self.assumed or first, 1 - first.uncertainty.loss
            seen = received * (self.filter_gain @ first.H)[:-1, None]
            shown = np.sqrt(received) * (self.filter_gain @ first.measurement_root)[:-1, None]
            for after, on in ((gain, K), (assumed.F[:, None], F[..., stated:, :])):
                on[..., stated:own], on[..., :n] = after, after @ seen
                on[..., stated : stated + n] -= on[..., :n]
            G[..., stated:], c[..., stated:] = assumed.G[:, None].swapaxes(-1, -2), assumed.c[:, None]
            shaking, shown = gain @ shown, assumed.F[:, None] @ shown
            noise[1:, :, stated:, stated:] = shown @ shown.swapaxes(-1, -2)
            jointly = np.zeros((*gain.shape[:-1], own))
            jointly[..., stated:] = shaking @ shown.swapaxes(-1, -2)
        for i, one in enumerate(models):
            F[:, i, :stated, :stated], F[:, i, :stated, own:] = one.F[:, :stated, :stated], one.F[:, :stated, stated:]
            G[:, i, :, :stated], c[:, i, :stated] = one.G[:, :stated].swapaxes(1, 2), one.c[:, :stated]
            start, process = one.start_root @ one.start_root.T, one.process_noise
            noise[0, i, :stated, :stated], fresh[0, i] = start[:stated, :stated], start[stated:, stated:]
            noise[1:, i, :stated, :stated], fresh[1:, i] = process[:, :stated, :stated], process[:, stated:, stated:]
        planned, reached = first.plan.controls, np.stack([one.reached for one in models], axis=1)
        arrays = LoopArrays(
            F, G, c, noise, fresh, first.transition, K, planned[:, None] + offset, planned,
            shaking @ shaking.swapaxes(-1, -2), jointly, reached, self.low, self.high,
        )  # fmt: skip
        return moments_of(arrays, stated, count, first.uncertainty.command_loss)
