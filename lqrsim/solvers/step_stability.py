"""Runge-Kutta steps that are too long: what decays by the dynamics grows by the steps.

A step of h seconds multiplies what has the eigenvalue L of df/dx by R(h L) = 1 + z + z^2/2 + z^3/6 + z^4/24, z = h L.
If it decays, Re L < 0, but |R(h L)| > 1, then a plan is one of the steps, and not of the system.
"""

import math
from typing import NamedTuple

import numpy as np

from lqrsim.errors import Array
from lqrsim.problem.problem import Problem
from lqrsim.solvers import compiled

# |R(z)| <= 1 for all z of Re z <= 0 within this distance, and on each ray up to one root further away.
STABLE = 2.61
LONGEST = 100_000  # number of shorter steps that are tried
ROUNDING = 1e-6  # of an eigenvalue by MuJoCo's differences, relative to its size: of an oscillation without damping


class UnstableStep(NamedTuple):
    """The step of a plan that is unstable by the most: in words, what happens there, and what to do."""

    detail: str
    remedy: str


def unstable_step(problem: Problem, states: Array, controls: Array, *, sound: bool) -> UnstableStep | None:
    """The step at which a plan, states (T+1, n) and controls (T, m), needs the shortest Runge-Kutta steps, if shorter.

    It is the first such step if the plan is not sound: what follows may be beyond all bounds because of it. None if the
    same controls lead there with shorter steps as well.
    """
    known = np.flatnonzero(np.isfinite(states[:-1]).all(axis=1) & np.isfinite(controls).all(axis=1))
    runge_kutta = problem.dynamics._runge_kutta(states[known], controls[known], problem.dt) if len(known) else None
    if runge_kutta is None:
        return None
    step, slopes = runge_kutta
    # The norm bounds all eigenvalues, and mostly decides.
    with np.errstate(over="ignore"):
        fast = (step * np.linalg.norm(slopes, axis=(1, 2)) > STABLE) & np.isfinite(slopes).all(axis=(1, 2))
    if not fast.any():
        return None
    known, slopes = known[fast], slopes[fast]
    rates = np.linalg.eigvals(slopes)
    excess, reach = np.zeros(rates.shape), step * np.abs(rates)
    for i, j in np.argwhere((reach > STABLE) & (rates.real <= ROUNDING * np.abs(rates))):
        excess[i, j] = reach[i, j] / _reach(complex(rates[i, j]))
    worst = excess.max(axis=1)
    if not (worst > 1).any():
        return None
    knot = int(np.argmax(worst if sound else worst > 1))
    mode = int(np.argmax(excess[knot]))
    rate, t = rates[knot, mode], int(known[knot])
    with np.errstate(over="ignore"):
        growth = abs(np.polyval(_TAYLOR[::-1], step * rate))
    shorter = step / float(worst[knot])
    unit = 10.0 ** (math.floor(math.log10(shorter)) - 2)  # of three digits
    longest = math.floor(shorter / unit) * unit
    if not sound and not _stays_finite(problem, states[0], controls, math.ceil(step / longest)):
        return None
    # The state that takes part the most in the eigenvalue, whatever the units of states.
    eigenvalues, right = np.linalg.eig(slopes[knot])
    mode = int(np.argmin(np.abs(eigenvalues - rate)))
    carrier = int(np.argmax(np.abs(np.linalg.pinv(right)[mode] * right[:, mode])))
    name = problem.dynamics.state_coordinates.names[carrier]
    value = f"{rate.real:.3g}" + (f" +- {abs(rate.imag):.3g}i" if rate.imag else "")
    return UnstableStep(
        f"Runge-Kutta steps of {step:g} s are unstable: at {t * problem.dt:g} s (step {t + 1} of"
        f" {problem.steps}) df/dx has the stable eigenvalue {value} 1/s, mostly of {name}, whose deviations a"
        f" step multiplies by {growth:.3g}",
        problem.dynamics._with_finer_steps(step, longest),
    )


def _stays_finite(problem: Problem, start: Array, controls: Array, times: int) -> bool:
    """Whether controls (T, m) lead to finite states if each is held for so many control periods as much shorter.

    Controls that are not finite are the nominal one. True for MuJoCo's steps, and false for more than `LONGEST`.
    """
    steps, n = times * len(controls), len(start)
    if problem.dynamics.by_mujoco or steps > LONGEST:
        return problem.dynamics.by_mujoco
    held = np.repeat(np.where(np.isfinite(controls), controls, problem.nominal_control), times, axis=0)
    gain = np.zeros((steps, held.shape[1], n))
    states, _ = compiled.rollout(problem, gain, held, start, dt=problem.dt / times)
    return bool(np.isfinite(states).all())


_TAYLOR = np.array([1.0, 1.0, 1 / 2, 1 / 6, 1 / 24])


def _reach(rate: complex) -> float:
    """The distance from zero, in the direction of an eigenvalue that decays, at which |R(z)| is 1."""
    powers = _TAYLOR * (rate / abs(rate)) ** np.arange(5)
    square = np.convolve(powers, powers.conj()).real  # |R|^2 as a polynomial of the distance, the constant first
    square[0] -= 1.0
    roots = np.roots(square[:0:-1])
    return float(roots.real[(np.abs(roots.imag) < ROUNDING) & (roots.real > STABLE)].min(initial=np.inf))
