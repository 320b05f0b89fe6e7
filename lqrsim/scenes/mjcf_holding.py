"""The controls that hold a robot from an MJCF still, by MuJoCo's own forces and rates of activations at rest."""

import contextlib
import copy
import itertools
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array
from lqrsim.scenes.mjcf_kinematics import Equalities, placed
from lqrsim.scenes.mjcf_model import MjcfModel, ranges
from lqrsim.scenes.mujoco_log import unlogged

_HELD = 1e-6  # largest missing force, relative to the largest force that acts, of a robot that counts as held
_STEPS, _HALVES, _NUDGE = 60, 12, 1e-6  # limits of steps and halvings; relative size of difference quotients
_EXACT, _PROGRESS = 1e-12, 0.99  # of the score: small enough, and the factor by which a step must lower it to go on
_LIGHT = 1e-4  # weight of controls relative to forces: selects the smallest that hold
_HEAVY = 1e2  # weight of the force that a limit cuts off: actuators do not push against their limits
_DISTANCES = 2.0 ** np.arange(-3, 20)  # distances at which an activation may be at rest
_DRIFTS = 2  # mode of an activation that cannot rest
_REST, _TIGHT = 1e-7, 1e-4  # what is no rate, relative; weight of rates that may be left over
_SCALES = 10.0 ** np.arange(13)  # relative lengths of a step that bounds make
_WELL_SCALED = 0.1  # least 1 / (1 + square) of a length that is right
_END = 1e-9  # relative distance from the end of its range within which an activation is there
_RATHER, _RANK = 1e3, 1e-6  # preference for joints without actuators as those that follow, and what is no slope
_NEWTON, _SMALL = 100, 1e-7  # largest number of steps to a settled position; m or rad of difference quotients
_VERTICAL = 1 - 1e-6  # least part of a slide's axis along gravity, of one by which a base is let down
_OFF = 1e-9  # slope of a least-squares problem that is no rounding, relative to the lengths of column and target
_FALLS = 200  # heights at which a body that is let down may touch: thinner supports are not found


class Holding(NamedTuple):
    """Controls that come nearest to holding the robot still, and the forces that they leave."""

    controls: Array  # (nu,), within their limits
    activations: Array  # (na,), the states of actuators, at rest with these controls
    missed: Array  # (nv,), the missing force of each joint in N or N m; 0 for joints that follow others
    drifting: npt.NDArray[np.bool_]  # actuators with activations not at rest: integrators whose control cannot be 0
    held: bool


class _Linear(NamedTuple):
    """Forces of actuators (nout,), without limits, and rates of activations (na,), about some z; and their slopes."""

    forces: Array
    rates: Array
    forces_by: Array
    rates_by: Array


class _AtRest:
    """The actuators of a model at positions qpos, without velocity: what they exert, as MuJoCo computes it.

    Everything is a function of z (nz,), all controls and then all activations, within the ranges `low` and `high`.
    """

    def __init__(self, mjcf: MjcfModel, model: mujoco.MjModel, qpos: Array) -> None:
        self.model, self._actuators, self._free = model, mjcf.actuators, without_limits(model)
        self.data = data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_inverse(model, data)
        self.wanted = data.qfrc_inverse.copy()  # (nv,), the forces of actuators with which nothing accelerates
        parts = self.wanted, data.qfrc_bias, data.qfrc_passive, data.qfrc_constraint
        self.largest = max(float(np.abs(part).max(initial=0.0)) for part in parts)  # that acts, in N or N m
        self.moments = np.zeros((model.nout, model.nv))
        if model.nout:
            places = data.moment_rownnz, data.moment_rowadr, data.moment_colind
            mujoco.mju_sparse2dense(self.moments, data.actuator_moment, *places)
        numbers = np.arange(model.nactuator)
        acting = np.repeat(numbers, model.actuator_actnum)
        self.of = np.concatenate([np.repeat(numbers, model.actuator_ctrlnum), acting])  # (nz,), the actuator of each
        act = ranges(model.actuator_actlimited[acting].astype(bool), model.actuator_actrange[acting])
        for number, entry, place in _integrals(model):
            if (most := model.actuator_dynprm[number, entry]) > 0:
                act[0][place], act[1][place] = -most, most
        self.low = np.array([*(control.low for control in mjcf.controls), *act[0]])
        self.high = np.array([*(control.high for control in mjcf.controls), *act[1]])
        inputs = [name for actuator in mjcf.actuators for name in actuator.inputs]
        self.slow = np.array([*(name == "vel" for name in inputs), *np.zeros(model.na)], dtype=bool)  # of velocity
        # The smallest z, with targets of position where the robot is.
        self.neutral = np.clip(np.concatenate([self._targets(), np.zeros(model.na)]), self.low, self.high)
        self.neutral = np.clip(self.rested(self.neutral, np.arange(model.na)), self.low, self.high)
        self._apply(self._free, self.neutral)
        # (nv,), what is exerted beside the forces of actuators, against gravity.
        self.compensated = data.qfrc_actuator - data.actuator_force @ self.moments

    def _targets(self) -> Array:
        """Controls (nu,) of 0, or for targets of position those of the actuators' lengths."""
        controls = np.zeros(self.model.nu)
        for actuator in self._actuators:
            entries, lengths = controls[actuator.controls], self.data.actuator_length[actuator.outputs]
            if actuator.inputs == ("rx", "ry", "rz"):
                entries[:] = lengths
            elif actuator.inputs == ("qw", "qx", "qy", "qz"):
                turn = np.linalg.norm(lengths)
                mujoco.mju_axisAngle2Quat(entries, lengths / max(turn, 1e-300), turn)
            elif "pos" in actuator.inputs:
                entries[actuator.inputs.index("pos")] = lengths[0]
        return controls

    def rested(self, z: Array, which: npt.NDArray[np.intp]) -> Array:
        """The same controls with these activations (k,) where their rates are 0, if there is such a place."""
        from scipy.optimize import brentq

        z = z.copy()
        for place in (self.model.nu + which).tolist():

            def rate(act: float, place: int = place) -> float:
                z[place] = act
                return float(self._unlimited(z)[place - len(z)])

            begin = float(z[place])
            if (first_rate := rate(begin)) != 0:
                ends = (begin + np.sign(first_rate) * distance for distance in _DISTANCES)
                end = next((end for end in ends if rate(end) * first_rate <= 0), None)
                z[place] = begin if end is None else float(brentq(rate, begin, end, xtol=1e-15))  # pyright: ignore[reportArgumentType]
        return z

    def _apply(self, model: mujoco.MjModel, z: Array) -> None:
        self.data.ctrl[:], self.data.act[:] = z[: model.nu], z[model.nu :]
        mujoco.mj_fwdActuation(model, self.data)

    def exerted(self, z: Array) -> tuple[Array, Array]:
        """The forces on the joints (nv,), within all limits, and the rates (na,) at which activations change."""
        model, data, act = self.model, self.data, z[self.model.nu :]
        self._apply(model, z)
        step, inside = model.opt.timestep, slice(model.nu, None)
        held = model.actuator_actlimited[self.of[inside]].astype(bool)  # their next value stays within the range
        following = act + step * data.act_dot
        following = np.where(held, np.clip(following, self.low[inside], self.high[inside]), following)
        return data.qfrc_actuator.copy(), (following - act) / step

    def _unlimited(self, z: Array) -> Array:
        """Forces of actuators and rates of activations, (nout + na,), without limits of either."""
        self._apply(self._free, z)
        return np.concatenate([self.data.actuator_force, self.data.act_dot])

    def linear(self, z: Array) -> _Linear:
        """Forces and rates without limits about z, with slopes by differences within the range."""
        nudge = _NUDGE * np.maximum(1.0, np.abs(z))
        above, below = (np.clip(z + side * nudge, self.low, self.high) for side in (1, -1))
        stuck = above == below
        above[stuck], below[stuck] = (z + nudge)[stuck], (z - nudge)[stuck]
        slopes = np.zeros((self.model.nout + self.model.na, len(z)))
        for k in range(len(z)):
            sides = [np.concatenate([z[:k], side[k : k + 1], z[k + 1 :]]) for side in (above, below)]
            slopes[:, k] = (self._unlimited(sides[0]) - self._unlimited(sides[1])) / (above[k] - below[k])
        values, outs = self._unlimited(z), self.model.nout
        return _Linear(values[:outs], values[outs:], slopes[:outs], slopes[outs:])

    def driven(self, linear: _Linear) -> npt.NDArray[np.bool_]:
        """Which joints (nv,) actuators move, if forces had no limits."""
        return np.asarray((self.moments.T @ linear.forces_by).any(axis=1))


@unlogged()
def holding(mjcf: MjcfModel, model: mujoco.MjModel, qpos: Array) -> Holding:
    """The smallest controls with which nothing accelerates at rest and activations stay, by a model at positions (nq,).

    If there are none, those with the least sum of squared remaining forces nearby.
    """
    rest = _AtRest(mjcf, model, qpos)
    search = _Search(rest)
    # Targets of velocity are left at 0 if other controls can hold.
    low, high = (np.where(rest.slow, rest.neutral, side) for side in (rest.low, rest.high))
    solution = search.solve(low, high)
    if rest.slow.any() and not solution.held:
        solution = search.solve(rest.low, rest.high)
    return solution


class _Search:
    """Gauss-Newton steps to controls and activations that hold, each a least-squares problem with bounds.

    Each activation has a mode: 0 if its rate is zero; 1 or -1 if it is at the upper or lower end of its range and its
    rate would take it further; `_DRIFTS` if it can do neither.
    """

    def __init__(self, rest: _AtRest) -> None:
        self._rest, model = rest, rest.model
        first = rest.linear(rest.neutral)
        self._free_dofs, self._to_free = _free_joints(model, rest.data.qpos, rest.driven(first))
        self._modes = np.zeros(model.na, dtype=np.intp)
        # What nothing changes at rest, such as the bristles of a model of dry friction, is not to carry anything.
        self._idle = np.asarray(~first.rates_by.any(axis=1))
        self._steepness = np.where(self._idle, 1.0, np.linalg.norm(first.rates_by, axis=1))
        self._size = max(rest.largest, float(np.abs(first.forces @ rest.moments).max(initial=0.0)), 1e-12)
        effects = np.abs(rest.moments.T @ first.forces_by).max(axis=0, initial=0.0)
        most = np.array([effects[rest.of == number].max() for number in rest.of])  # of an actuator, all count alike
        self._weights = np.where(most > 0, most, 1.0) / self._size
        self._sparing = _LIGHT * self._weights
        limited = model.actuator_forcelimited.astype(bool)
        for tendon in np.flatnonzero(model.tendon_actfrclimited).tolist():
            limited |= _on_tendon(model, tendon)
        self._limited = np.flatnonzero(np.repeat(limited, model.actuator_outnum))
        self._limited_dofs = model.jnt_dofadr[np.flatnonzero(model.jnt_actfrclimited)]

    def _remaining(self, z: Array) -> tuple[Array, Array]:
        """The missing forces of the free joints in N or N m, and how far activations (na,) are from rest."""
        forces, rates = self._rest.exerted(z)
        return self._to_free @ (self._rest.wanted - forces), rates / self._steepness

    def _score(self, z: Array) -> float:
        missing, moving = self._remaining(z)
        missing, moving = missing / self._size, moving * self._weights[self._rest.model.nu :]
        return float(missing @ missing) + float(moving @ moving)

    def solve(self, low: Array, high: Array) -> Holding:
        """The controls and activations that hold within these ranges (nz,), or a least score nearby."""
        rest, model = self._rest, self._rest.model
        self._low, self._high = low, high
        self._modes[:] = 0
        z = rest.neutral.copy()
        score = self._score(z) if (np.abs(self._remaining(z)[1]) < _REST).all() else np.inf
        first = True
        for _ in range(_STEPS):
            linear = rest.linear(z)
            aim = self._aim(z, linear, rest.neutral if first else z)
            if aim is None:  # some activations cannot be at rest within their ranges
                if not self._give_up_rest(z, linear):
                    break
                score = np.inf
                continue
            first = False
            last_score, shorter = score, False
            for fraction in 0.5 ** np.arange(_HALVES):
                resting = np.flatnonzero((self._modes == 0) & ~self._idle)
                trial = rest.rested(np.clip(z + fraction * (aim - z), low, high), resting).clip(low, high)
                if (trial_score := self._score(trial)) < score:
                    z, score, shorter = trial, trial_score, fraction < 1
                    break
            stuck = score > _PROGRESS * last_score and not shorter
            if score <= _EXACT**2 or (stuck and not self._fix_at_ends(z[model.nu :])):
                break
        z = np.clip(np.where(np.abs(z) * self._weights < _EXACT, 0.0, z), low, high)  # rounding
        missing, moving = self._remaining(z)
        missed, drifting = np.zeros(model.nv), np.zeros(model.nactuator, dtype=bool)
        missed[self._free_dofs] = missing
        drifting[rest.of[model.nu :][np.abs(moving) > _HELD * np.maximum(1.0, np.abs(z[model.nu :]))]] = True
        held = bool((np.abs(missing) <= _HELD * rest.largest).all()) and not drifting.any()
        return Holding(z[: model.nu], z[model.nu :], missed, drifting, held)

    def _fix_at_ends(self, act: Array) -> bool:
        """Let activations that are at the ends of their ranges (na,) stay there; whether there are any."""
        nu = self._rest.model.nu
        lower, upper = (np.isclose(act, side[nu:], rtol=_END, atol=_END) for side in (self._low, self._high))
        ends = (lower | upper) & (self._modes == 0) & ~self._idle
        self._modes[ends] = np.where(upper, 1, -1)[ends]
        return bool(ends.any())

    def _aim(self, z: Array, linear: _Linear, neutral: Array) -> Array | None:
        """The z that holds if forces and rates are linear, or comes nearest; None if activations cannot do as said.

        Of several it is the one nearest to `neutral`. The unknowns are the change of z and, for each limit of a force,
        the part of the force that it cuts off.
        """
        rest, model, nu, count = self._rest, self._rest.model, self._rest.model.nu, len(z)
        width = count + len(self._limited) + len(self._limited_dofs)
        identity = np.eye(width)
        change, cut = identity[:count], identity[count:]
        forces = linear.forces_by @ change
        forces[self._limited] -= cut[: len(self._limited)]
        joints, now = rest.moments.T @ forces, rest.compensated + rest.moments.T @ linear.forces
        joints[self._limited_dofs] -= cut[len(self._limited) :]
        # Where more is wanted than a joint takes, an actuator of several joints may push against its limit for others.
        limited = model.jnt_actfrclimited.astype(bool)
        required, joint_range = rest.wanted[self._limited_dofs], model.jnt_actfrcrange[limited].T
        beyond = (required > joint_range[1]).astype(float) - (required < joint_range[0])
        price = np.concatenate([np.ones(len(self._limited)), np.where(beyond != 0, _LIGHT / _HEAVY, 1.0)])
        price *= _HEAVY / self._size
        rows = self._to_free @ joints / self._size, self._sparing[:, None] * change, price[:, None] * cut
        aims = [self._to_free @ (rest.wanted - now) / self._size, self._sparing * (neutral - z), np.zeros(len(cut))]
        rates, rates_now = linear.rates_by @ change / self._steepness[:, None], linear.rates / self._steepness
        follows, at_end = (self._modes == 0) & ~self._idle, np.isin(self._modes, (-1, 1))
        stays = at_end | self._idle
        ends = np.where(self._modes > 0, self._high[nu:], self._low[nu:])
        ends = np.where(self._idle, rest.neutral[nu:], ends)
        met = np.concatenate([rates[follows], change[nu:][stays]])
        met_at = np.concatenate([-rates_now[follows], (ends - z[nu:])[stays]])
        sign, (least, most) = self._modes[at_end], joint_range - now[self._limited_dofs]
        sides = [
            (change, self._low - z, self._high - z),
            (sign[:, None] * rates[at_end], -sign * rates_now[at_end], np.full(len(sign), np.inf)),
            (joints[self._limited_dofs], least, most),
            (beyond[:, None] * cut[len(self._limited) :], np.zeros(len(beyond)), np.full(len(beyond), np.inf)),
            *_force_limits(model, forces, linear.forces),
        ]
        if len(cut):  # what must be cut off in any case is not to cost anything
            least = _least_squares(np.concatenate(rows[1:]), np.concatenate(aims[1:]), (met, met_at), sides)
            if least is None:
                return None
            aims[2] = price * least[count:]
        solution = _least_squares(np.concatenate(rows), np.concatenate(aims), (met, met_at), sides)
        return None if solution is None else z + solution[:count]

    def _give_up_rest(self, z: Array, linear: _Linear) -> bool:
        """Let activations that cannot be at rest within their ranges go to the ends, or drift; whether there are any.

        Of an actuator's activations as few as may be, the last first, which follow the others.
        """
        rest, nu, any_left = self._rest, self._rest.model.nu, False
        for number in np.unique(rest.of[nu:]):
            entries = np.flatnonzero(rest.of == number)
            acts = entries[entries >= nu] - nu
            acts = acts[(self._modes[acts] == 0) & ~self._idle[acts]]
            now = linear.rates[acts] / self._steepness[acts]
            rates = linear.rates_by[np.ix_(acts, entries)] / self._steepness[acts, None]
            remaining, left_out = _left_nonzero(rates, now, (self._low - z)[entries], (self._high - z)[entries])
            end = np.where(remaining > 0, self._high[nu + acts], self._low[nu + acts])
            modes = np.where(np.isfinite(end), np.where(remaining > 0, 1, -1), _DRIFTS)
            self._modes[acts[left_out]] = modes[left_out]
            any_left = any_left or bool(left_out.any())
        return any_left


def _left_nonzero(rates: Array, now: Array, low: Array, high: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """The rates now + rates x of an actuator, low <= x <= high; and those left nonzero: the fewest, rather the last."""
    from scipy.optimize import lsq_linear

    tight = np.where(low == high, _TIGHT, 0.0)  # lsq_linear refuses such bounds
    rows, remaining = range(len(now)), now
    for left in itertools.chain.from_iterable(itertools.combinations(rows[::-1], count) for count in range(len(now))):
        left_out = np.isin(rows, left)
        weights = np.where(left_out, _TIGHT, 1.0)
        remaining = now + rates @ lsq_linear(weights[:, None] * rates, -weights * now, (low - tight, high + tight)).x
        if (np.abs(remaining[~left_out]) < _REST).all():
            return remaining, left_out
    return remaining, np.ones(len(now), dtype=bool)


def _force_limits(model: mujoco.MjModel, forces: Array, now: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Limits of forces (nout,), with slopes (nout, k), of actuators and tendons: rows, least and largest change."""
    limited, single = model.actuator_forcelimited.astype(bool), model.actuator_outnum == 1
    outs, least, most = model.actuator_outadr, *model.actuator_forcerange.T
    actuators = np.flatnonzero(limited & single)
    yield forces[outs[actuators]], least[actuators] - now[outs[actuators]], most[actuators] - now[outs[actuators]]
    for number in np.flatnonzero(limited & ~single).tolist():  # a torque, whose size is limited
        outputs = slice(outs[number], outs[number] + model.actuator_outnum[number])
        largest = float(np.linalg.norm(now[outputs]))
        if largest > 0:
            along = (now[outputs] / largest @ forces[outputs])[None]
            yield along, np.array([-np.inf]), np.array([most[number] - largest])
    for tendon in np.flatnonzero(model.tendon_actfrclimited).tolist():
        outputs = outs[_on_tendon(model, tendon)]
        least, most = model.tendon_actfrcrange[tendon, :, None] - now[outputs].sum()
        yield forces[outputs].sum(axis=0)[None], least, most


def _on_tendon(model: mujoco.MjModel, tendon: int) -> npt.NDArray[np.bool_]:
    """Which actuators pull at a tendon."""
    return (model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON.value) & (model.actuator_trnid[:, 0] == tendon)


def _least_squares(
    rows: Array, aims: Array, equal: tuple[Array, Array], sides: Iterable[tuple[Array, Array, Array]]
) -> Array | None:
    """The x with the least |rows x - aims|, for which equalities hold and rows of `sides` are within their limits.

    Equalities are eliminated; what remains is a least-distance problem. None if there is no such x.
    """
    from scipy.linalg import null_space, solve_triangular

    start = np.linalg.lstsq(*equal, rcond=None)[0]
    if np.abs(equal[0] @ start - equal[1]).max(initial=0.0) > _REST * (1 + np.abs(equal[1]).max(initial=0.0)):
        return None
    basis = null_space(equal[0]) if len(equal[0]) else np.eye(rows.shape[1])
    orthogonal, triangle = np.linalg.qr(rows @ basis)
    nearest = orthogonal.T @ (aims - rows @ start)
    above = [(block[np.isfinite(least)], least[np.isfinite(least)]) for block, least, _ in sides]
    below = [(-block[np.isfinite(most)], -most[np.isfinite(most)]) for block, _, most in sides]
    bound, least = (np.concatenate(part) for part in zip(*above, *below, strict=True))
    least = least - bound @ start
    bound = solve_triangular(triangle, (bound @ basis).T, trans=1).T
    least = least - bound @ nearest
    norms = np.linalg.norm(bound, axis=1)
    fixed = norms <= 1e-12 * norms.max(initial=0.0)
    if (least[fixed] > _REST).any():
        return None
    bound, least = bound[~fixed] / norms[~fixed, None], least[~fixed] / norms[~fixed]
    farthest = float(least.max(initial=0.0))
    for distance in farthest * _SCALES if farthest > 0 else ():
        residual, _ = least_distance(bound, least / distance)
        if -residual[-1] > _WELL_SCALED:
            nearest = nearest - distance * residual[:-1] / residual[-1]
            break
    else:
        if farthest > 0:
            return None
    return start + basis @ solve_triangular(triangle, nearest)


def least_distance(rows: Array, least: Array) -> tuple[Array, Array]:
    """For the shortest y (n,) with `rows y >= least`: a residual (n+1,) and forces (K,) of the rows, not negative.

    y is -residual[:-1] / residual[-1], a sum of rows times their multipliers -forces / residual[-1]. If no y satisfies
    all rows, the residual is zero. Lawson and Hanson, Solving Least Squares Problems, ch. 23.
    """
    matrix, target = np.vstack([rows.T, least]), np.append(np.zeros(rows.shape[1]), 1.0)
    forces = nonnegative_least_squares(matrix, target)
    return matrix @ forces - target, forces


def nonnegative_least_squares(matrix: Array, target: Array) -> Array:
    """The x >= 0 (K,) with the least |matrix x - target|.

    SciPy's `nnls` is ten times as fast as its other solver, but may end elsewhere: scipy/scipy#25389.
    """
    from scipy.optimize import lsq_linear, nnls

    most = 30 * matrix.shape[1]
    with contextlib.suppress(RuntimeError):  # more iterations
        x, _ = nnls(matrix, target, maxiter=most)
        with np.errstate(over="ignore"):  # against a size beyond all floats, each slope is small
            slopes = (matrix @ x - target) @ matrix
            size = np.linalg.norm(matrix, axis=0) * np.linalg.norm(target)
        if (np.where(x > 0, np.abs(slopes), -slopes) <= _OFF * size).all():
            return x
    return lsq_linear(matrix, target, (0.0, np.inf), method="bvls", tol=1e-15, max_iter=most).x


def without_limits(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model without limits of forces, and of what integrates errors of position."""
    free = copy.copy(model)
    free.actuator_forcelimited[:] = 0
    free.jnt_actfrclimited[:] = 0
    free.tendon_actfrclimited[:] = 0
    for number, entry, _ in _integrals(model):
        free.actuator_dynprm[number, entry] = 0.0
    return free


def _integrals(model: mujoco.MjModel) -> Iterator[tuple[int, int, int]]:
    """What integrates an error of position: its actuator, the place of its limit in dynprm, and its activation."""
    for number, kind in enumerate(model.actuator_dyntype):
        if kind == mujoco.mjtDyn.mjDYN_PID.value:
            gain, slew, limit = model.actuator_gainprm[number, 0], 1, 0
        elif kind == mujoco.mjtDyn.mjDYN_DCMOTOR.value:
            gain, slew, limit = model.actuator_gainprm[number, 5], 7, 8
        else:
            continue
        if gain != 0:  # a limit of the rate of targets adds an activation before it
            yield number, limit, int(model.actuator_actadr[number]) + int(model.actuator_dynprm[number, slew] > 0)


@unlogged()
def at_rest(mjcf: MjcfModel, model: mujoco.MjModel, qpos: Array) -> tuple[Array, float]:
    """Positions (nq,) nearby at which the undriven joints are at rest, and the largest force (N, N m) left on them.

    A base that touches nothing is let down first. Then Newton's method with steps of least norm: contacts are springs,
    and nothing moves in a free direction, such as along a floor.
    """
    data, actuators = mujoco.MjData(model), _AtRest(mjcf, model, qpos)
    driven = actuators.driven(actuators.linear(actuators.neutral))
    qpos, free = _let_down(model, qpos, driven), np.flatnonzero(~driven)
    if not len(free):
        return qpos.copy(), 0.0

    def missing(moved: Array) -> tuple[Array, Array]:
        positions, motion = qpos.copy(), np.zeros(model.nv)
        motion[free] = moved
        mujoco.mj_integratePos(model, positions, motion, 1.0)
        data.qpos[:], data.qvel[:], data.qacc[:] = positions, 0, 0
        mujoco.mj_inverse(model, data)
        return positions, data.qfrc_inverse[free].copy()

    displacement = np.zeros(len(free))
    positions, forces = missing(displacement)
    for _ in range(_NEWTON):
        changes = _SMALL * np.eye(len(free))
        slopes = [missing(displacement + change)[1] - missing(displacement - change)[1] for change in changes]
        step = -np.linalg.lstsq(np.array(slopes).reshape(len(free), -1).T / (2 * _SMALL), forces, rcond=1e-6)[0]
        for fraction in 0.5 ** np.arange(_HALVES):
            trial, trial_forces = missing(displacement + fraction * step)
            if np.linalg.norm(trial_forces) < np.linalg.norm(forces):
                displacement, positions, forces = displacement + fraction * step, trial, trial_forces
                break
        else:
            break
    return positions, float(np.abs(forces).max(initial=0.0))


def falling(model: mujoco.MjModel, qpos: Array) -> dict[int, Array | float]:
    """The joints by which bases fall, free joints and vertical slides, each with what it moves for a metre down."""
    data, gravity = placed(model, qpos), model.opt.gravity
    down = gravity / max(float(np.linalg.norm(gravity)), mujoco.mjMINVAL)
    falls = dict[int, Array | float]()
    for joint in np.flatnonzero(model.body_parentid[model.jnt_bodyid] == 0).tolist():
        along = float(data.xaxis[joint] @ down)
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            falls[joint] = down
        elif model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE and abs(along) > _VERTICAL:
            falls[joint] = along
    return falls


def _let_down(model: mujoco.MjModel, qpos: Array, driven: npt.NDArray[np.bool_]) -> Array:
    """Positions (nq,) with each base that touches nothing let down to what is below it, within the model's size."""
    data, lowered, most = mujoco.MjData(model), qpos.copy(), model.stat.extent

    def touches(joint: int, down: Array | float, fall: float) -> bool:
        data.qpos[:] = lowered
        data.joint(joint).qpos[:3] += fall * down
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        roots = model.body_rootid[model.geom_bodyid[data.contact.geom]]
        of_body = (roots == model.body_rootid[model.jnt_bodyid[joint]]).any(axis=1)
        return bool((of_body & (data.contact.dist <= 0)).any())

    falls = np.linspace(0, most, _FALLS)
    for joint, down in falling(model, qpos).items():
        if driven[model.jnt_dofadr[joint]]:
            continue
        first = next((k for k, fall in enumerate(falls) if touches(joint, down, fall)), 0)
        if first:
            low, high = falls[first - 1], falls[first]
            while high - low > _SMALL * most:
                middle = 0.5 * (low + high)
                low, high = (low, middle) if touches(joint, down, middle) else (middle, high)
            touches(joint, down, high)
            lowered = data.qpos.copy()
    return lowered


def _free_joints(
    model: mujoco.MjModel, qpos: Array, driven: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.intp], Array]:
    """The free joints, and the map from forces on all joints to those on them, (free, nv), through equalities.

    In a loop, undriven joints follow the others as far as there are enough of them.
    """
    if not model.eq_active0.any():
        return np.arange(model.nv), np.eye(model.nv)
    from scipy.linalg import qr

    _, slopes = Equalities(model).at(qpos)
    _, triangle, order = qr(slopes * np.where(driven, 1.0, _RATHER), mode="economic", pivoting=True)  # pyright: ignore[reportAssignmentType]
    rank = int((np.abs(np.diagonal(triangle)) > _RANK * np.abs(slopes).max(initial=0.0)).sum())
    follow, free = (np.sort(dofs).astype(np.intp) for dofs in (order[:rank], order[rank:]))
    moves = np.eye(model.nv)[:, free]
    moves[follow] = -np.linalg.lstsq(slopes[:, follow], slopes[:, free], rcond=None)[0]
    return free, moves.T
