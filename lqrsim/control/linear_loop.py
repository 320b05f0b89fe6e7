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
from lqrsim.kernels import recursions
from lqrsim.kernels.records import LoopArrays, LoopMoments, LoopSizes, LoopWork, zeros_of


def moments_of(loops: LoopArrays, stated: int, count: int | None, lost: float = 0.0) -> LoopMoments:
    """The moments of the first entries of y, or of all, in each of L systems under each of C laws, (L, C, ...).

    The first `stated` entries of y are the system's own; with losses, the last m of these are a.
    """
    (steps, laws, m, width), (systems, size) = loops.K.shape, loops.F.shape[1:3]
    first = size if count is None else count
    rows, columns, lossy = *loops.noise.shape[2:], 0 < lost < 1
    sizes = LoopSizes(
        steps, systems, laws, size, width, m, first, stated, rows, columns, bool(loops.jointly.size), lossy,
        lost / (1 - lost) if lossy else 0.0,
    )  # fmt: skip
    lengths = {"T": steps, "L": systems, "C": laws, "Y": size, "X": width, "R": width - size, "m": m, "N": first}
    work, moments = zeros_of(LoopWork, **lengths), zeros_of(LoopMoments, **lengths)
    P, M = work.P, work.M
    M[..., size:, size:] = loops.transition
    arguments = sizes, *(type(arrays)(*map(np.ravel, arrays)) for arrays in (loops, work, moments))
    advance = kernels().lay_out("advance", 0, *arguments)
    for t in range(steps + 1):
        advance(t, *arguments)
        if t < steps:
            np.matmul(M[..., :size, :], P, out=work.driven)
            np.matmul(work.driven, M.swapaxes(-1, -2), out=P[..., :size, :])
    return LoopMoments(*(np.moveaxis(moment, 0, 2) for moment in moments))


def kernels() -> CompiledModule:
    """`kernels/recursions.py`, which is compiled once for all sizes."""
    return module_of(source_of(recursions), "moments of closed loops")


@dataclass(eq=False)
class LinearLoop:
    """A closed loop about a plan."""

    model: PlanModel
    gain: Array  # (T, m, Z or n) of a law in deviations from the plan, or (C, T, m, Z or n) of C laws
    offset: Array  # (T, m)
    filter_gain: Array | None  # of a Kalman filter, (T+1, Z, Y); None for a law of the measured states
    limits: tuple[Array, Array]  # of the controls, (m,) each
    assumed: PlanModel | None = None  # by the filter, whose estimates have its Z; by default the true system's

    def moments(self, count: int | None = None) -> LoopMoments:
        """The moments of the first entries of y, or of all, from the start to the plan's end."""
        moments = self.in_systems([self.model], count)
        return LoopMoments(*(moment[0, 0] if self.gain.ndim == 3 else moment[0] for moment in moments))

    def in_systems(self, models: Sequence[PlanModel], count: int | None) -> LoopMoments:
        """The moments in several true systems, which differ in no sizes, and in neither sensors nor losses."""
        first, steps, m = models[0], self.model.plan.steps, self.model.m
        n, stated, unknown = first.n, first.n + first.lagging, len(first.transition)
        gain = self.gain.reshape(-1, *self.gain.shape[-3:]).swapaxes(0, 1)
        offset = self.offset.reshape(-1, steps, m).swapaxes(0, 1)
        size = stated if self.filter_gain is None else stated + gain.shape[-1]
        F, K = np.zeros((steps, len(models), size, size + unknown)), np.zeros((*gain.shape[:-1], size + unknown))
        G, c = np.empty((steps, len(models), m, size)), np.empty((steps, len(models), size))
        noise, jointly = np.zeros((steps + 1, len(models), size, size)), np.zeros(0)
        drawn = np.empty((steps + 1, len(models), unknown, unknown))
        if self.filter_gain is None:
            K[..., :n], on_command = gain, gain * first.measurement_std
        else:
            # F and K act on the corrected estimate. With losses, all measurements count less.
            assumed, received = self.assumed or first, 1 - first.uncertainty.loss
            seen = received * (self.filter_gain @ first.H)[:-1, None]
            measured = np.sqrt(received) * (self.filter_gain @ first.measurement_root)[:-1, None]
            for after, on in ((gain, K), (assumed.F[:, None], F[..., stated:, :])):
                on[..., stated:size], on[..., :n] = after, after @ seen
                on[..., stated : stated + n] -= on[..., :n]
            G[..., stated:], c[..., stated:] = assumed.G[:, None].swapaxes(-1, -2), assumed.c[:, None]
            on_command, measured = gain @ measured, assumed.F[:, None] @ measured
            noise[1:, :, stated:, stated:] = measured @ measured.swapaxes(-1, -2)
            jointly = np.zeros((*gain.shape[:-1], size))
            jointly[..., stated:] = on_command @ measured.swapaxes(-1, -2)
        for i, model in enumerate(models):
            F[:, i, :stated, :stated] = model.F[:, :stated, :stated]
            F[:, i, :stated, size:] = model.F[:, :stated, stated:]
            G[:, i, :, :stated], c[:, i, :stated] = model.G[:, :stated].swapaxes(1, 2), model.c[:, :stated]
            start, process = model.start_root @ model.start_root.T, model.process_noise
            noise[0, i, :stated, :stated], drawn[0, i] = start[:stated, :stated], start[stated:, stated:]
            noise[1:, i, :stated, :stated], drawn[1:, i] = process[:, :stated, :stated], process[:, stated:, stated:]
        planned, reached = first.plan.controls, np.stack([model.reached for model in models], axis=1)
        arrays = LoopArrays(
            F, G, c, noise, drawn, first.transition, K, planned[:, None] + offset, planned,
            on_command @ on_command.swapaxes(-1, -2), jointly, reached, *self.limits,
        )  # fmt: skip
        return moments_of(arrays, stated, count, first.uncertainty.command_loss)
