"""Contacts of an MJCF: which act in a control period, and motions of a robot that would bring about others.

The contact mode is what acts at each physics step of a control period. A contact or a limit begins to act when its
distance crosses zero. An active one, or an edge of its friction cone, lets go when its force crosses zero. Each of
these *switches* is a number that changes sign at the event. As long as no switch changes sign, a control period is a
smooth function of its state and control. If a distance changes sign, the period is in general discontinuous. If a force
changes sign, it has a kink.

Where nothing touches a body, no mode takes it to its goal. An approach is a motion that would, by geometry alone. A
push comes to the far side of the body, round it if need be, and goes on along the body's way. A grasp comes with open
fingers, closes them, and goes along. Forces are not considered. Whether the body moves is for a rollout to say.
"""

import copy
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array
from lqrsim.scenes.mjcf_kinematics import carriers, colliding
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.mujoco_log import unlogged
from lqrsim.scenes.scene import touching_pairs

_WATCHED = 0.02  # m or rad; smaller distances are watched
_SMALLER = 1.0, 1e-2, 1e-4  # steps of differences, relative to the first; tried until one stays in the mode
_KIND = mujoco.mjtConstraint
_LIMITS = np.array([int(_KIND.mjCNSTR_LIMIT_JOINT), int(_KIND.mjCNSTR_LIMIT_TENDON)])
_CONTACTS = np.array([int(_KIND.mjCNSTR_CONTACT_FRICTIONLESS), int(_KIND.mjCNSTR_CONTACT_PYRAMIDAL)])
# The name of a switch as a number: its stage, whether it is a force, the kind of element, and the element.
_STAGE, _FORCE, _CONTACT, _GEOM, _NUMBER, _EDGE = 1 << 48, 1 << 47, 1 << 46, 1 << 14, 1 << 16, 1 << 4

# Fractions of the time at which the robot touches the body, and at which the body is at its goal: without time
# left to return, with it, and with more time to push what is heavy.
_TIMES = (0.6, 1.0), (0.35, 0.7), (0.4, 1.0)
_TOOLS, _PAIRS = 2, 1  # numbers of geoms that push and of pairs of geoms that grasp, the nearest first
_ROUND = 1.3  # distance at which a tool goes round a body, relative to that at which it touches
# Distances of fingers from the body's centre, relative to that at which they touch: open, and pressed, lightly or more.
_OPEN, _PRESSED = 1.4, (0.8, 0.4)
_CLOSING = 0.15  # fraction of the time in which fingers close
_ALONG, _ACROSS = 0.95, 0.8  # cosines: directions that count as the same, and as along the line of two fingers
_TOUCHING, _SEARCHES = 1e-4, 50  # m that count as touching, and steps to find where a tool touches
# Inverse kinematics: damping relative to the largest entry, iterations at the first knot and at others, and the largest
# change in m or rad. What goes round a body may be off its path by this fraction of the distance at which it touches.
_DAMPING, _FIRST, _OTHERS, _CHANGE, _OFF = 1e-3, 30, 4, 0.3, 0.5

Names = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Switches:
    """Switches of a control period, (k,): their names, ascending, and their values, negative for active ones."""

    names: Names
    values: Array

    def at(self, names: Names, numbers: Array | None = None) -> Array:
        """The values of the switches of these names, NaN where there is none; or other numbers of them, (k, ...)."""
        numbers = self.values if numbers is None else numbers
        if np.array_equal(names, self.names):
            return numbers
        values = np.full((len(names), *numbers.shape[1:]), np.nan)
        _, places, own_places = np.intersect1d(names, self.names, assume_unique=True, return_indices=True)
        values[places] = numbers[own_places]
        return values

    @property
    def forces(self) -> npt.NDArray[np.bool_]:
        """Flags of the switches that are forces; their change of sign is a kink, not a jump."""
        return (self.names & _FORCE) != 0

    def before_jump(self, crossed: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Flags of those that are evaluated no later than the first crossed distance can act; all without one."""
        jumps = self.names[crossed & ~self.forces]
        return self.names < (jumps[0] // _FORCE + 1) * _FORCE if len(jumps) else np.ones(len(self.names), np.bool_)

    def same_mode(self, other: "Switches") -> bool:
        """Whether the same elements act in both. An element that is out of sight does not act."""
        if not np.array_equal(self.names[self.forces], other.names[other.forces]):
            return False
        acts_there, acts_here = other.at(self.names) < 0, self.at(other.names) < 0
        return np.array_equal(self.values < 0, acts_there) and np.array_equal(other.values < 0, acts_here)


class Period(NamedTuple):
    """A control period, linearised in its contact mode."""

    state: Array  # (n,) at its end
    jacobian: Array  # (n, n+m)
    switches: Switches
    slopes: Array  # (k, n+m) of the switches, NaN if unknown


class ContactModes:
    """Control periods of an MJCF by MuJoCo's bindings, with the switches of each stage of each physics step."""

    # Called before each part of a long computation, which its exception ends.
    check_time: Callable[[], None] = staticmethod(lambda: None)

    def __init__(self, model: mujoco.MjModel, substeps: int) -> None:
        self._model, self._substeps = copy.copy(model), substeps
        self._model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)  # limits are told by their rows
        self._data, self._wide_model = mujoco.MjData(self._model), copy.copy(self._model)
        for margins in (self._wide_model.jnt_margin, self._wide_model.tendon_margin, self._wide_model.geom_margin):
            margins[:] += _WATCHED
        self._wide_data, self._nv = mujoco.MjData(self._wide_model), model.nv
        self._four = model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4)

    @staticmethod
    def known_for(model: mujoco.MjModel) -> bool:
        """Whether all switches are known: of joints that slide or turn, and of friction cones that are pyramids."""
        scalar_joints = np.isin(model.jnt_type, [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)])
        dry = model.dof_frictionloss.any() or model.tendon_frictionloss.any()
        elliptic = model.opt.cone == int(mujoco.mjtCone.mjCONE_ELLIPTIC)
        return bool(scalar_joints.all()) and not (dry or elliptic or model.na or model.npair or model.geom_gap.any())

    def step(self, state: Array, control: Array) -> tuple[Array, Switches]:
        """The state (n,) after a control period, and its switches."""
        data, observed = self._data, list[tuple[Names, Array]]()
        data.qpos[:], data.qvel[:] = state[: self._nv], state[self._nv :]
        data.ctrl[:], data.qacc_warmstart[:], data.time = control, 0.0, 0.0
        for step in range(self._substeps):
            if self._four:
                self._runge_kutta(4 * step, observed)
            else:
                qpos = data.qpos.copy()
                mujoco.mj_step(self._model, data)
                self._observe(step, qpos, observed)
        names = np.concatenate([np.zeros(0, np.int64), *(switch_names for switch_names, _ in observed)])
        values = np.concatenate([np.zeros(0), *(switch_values for _, switch_values in observed)])
        order = np.argsort(names)
        return np.concatenate([data.qpos, data.qvel]), Switches(names[order], values[order])

    def _runge_kutta(self, stage: int, switches: list[tuple[Names, Array]]) -> None:
        """A physics step of `mj_RungeKutta`, whose four stages each have their own contacts."""
        model, data, h = self._model, self._data, self._model.opt.timestep
        qpos, qvel, time = data.qpos.copy(), data.qvel.copy(), data.time
        mujoco.mj_forward(model, data)
        self._observe(stage, data.qpos, switches)
        speeds, rates = [qvel], [data.qacc.copy()]
        for number, fraction in enumerate((0.5, 0.5, 1.0)):
            data.qpos[:] = qpos + h * fraction * speeds[number]
            data.qvel[:], data.time = qvel + h * fraction * rates[number], time + h * fraction
            mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_NONE, 1)
            self._observe(stage + number + 1, data.qpos, switches)
            speeds.append(data.qvel.copy())
            rates.append(data.qacc.copy())
        weights = np.array([1.0, 2.0, 2.0, 1.0]) / 6
        data.qpos[:], data.qvel[:] = qpos + h * weights @ speeds, qvel + h * weights @ rates
        data.time = time + h

    def _observe(self, stage: int, qpos: Array, switches: list[tuple[Names, Array]]) -> None:
        """Add the switches of a stage at these positions (nq,), whose forces are in the data."""
        model, seen = self._model, self._wide_data
        seen.qpos[:] = qpos
        mujoco.mj_fwdPosition(self._wide_model, seen)
        limits, first = _among(seen.efc_type, _LIMITS), stage * _STAGE
        if limits.any():
            distances = (seen.efc_pos - seen.efc_margin)[limits] + _WATCHED
            switches.append((first + _limits(self._wide_model, seen, limits), distances))
        if seen.ncon:
            geoms, wide_margin, geom_margin = seen.contact.geom, self._wide_model.geom_margin, model.geom_margin
            # Versions of MuJoCo differ in whether the margin of two geoms is their sum or their maximum.
            summed = np.abs(seen.contact.includemargin - wide_margin[geoms].sum(axis=1)) < 1e-9
            margins = np.where(summed, geom_margin[geoms].sum(axis=1), geom_margin[geoms].max(axis=1))
            switches.append((first + _contacts(geoms), seen.contact.dist - margins))
        data = self._data
        if data.nefc == 0:
            return
        limits, contacts = _among(data.efc_type, _LIMITS), _among(data.efc_type, _CONTACTS)
        excess = np.empty(data.nefc)  # acceleration minus the constraint's reference; it pushes if this is negative
        mujoco.mj_mulJacVec(model, data, excess, data.qacc)
        excess -= data.efc_aref
        if limits.any():
            switches.append((first + _FORCE + _limits(model, data, limits), excess[limits]))
        if contacts.any():
            numbers = data.efc_id[contacts]
            edges = np.arange(len(numbers)) - np.searchsorted(numbers, numbers)
            names = first + _FORCE + _contacts(data.contact.geom)[numbers] + edges
            switches.append((names, excess[contacts]))

    def linearize(self, state: Array, control: Array) -> Period:
        """The control period and its derivatives, by differences that stay in its contact mode.

        Differences are central if both sides stay in the mode, one-sided if one side does, and smaller if neither does;
        if none stays in it, they are the smallest, across its end.
        """
        n, point = len(state), np.concatenate([state, control])
        end, switches = self.step(state, control)
        jacobian, slopes = np.empty((n, len(point))), np.empty((len(switches.names), len(point)))
        for k in range(len(point)):
            ends, sides, width = dict[int, tuple[Array, Switches]](), dict[int, tuple[Array, Switches]](), 0.0
            for fraction in _SMALLER:
                width = fraction * 1e-6 * max(1.0, abs(point[k]))
                for sign in (1, -1):
                    shifted = point.copy()
                    shifted[k] += sign * width
                    ends[sign] = self.step(shifted[:n], shifted[n:])
                sides = {sign: side for sign, side in ends.items() if side[1].same_mode(switches)}
                if sides:
                    break
            else:
                sides = ends
            high, low = sides.get(1, (end, switches)), sides.get(-1, (end, switches))
            width *= len(sides)
            jacobian[:, k] = (high[0] - low[0]) / width
            slopes[:, k] = (high[1].at(switches.names) - low[1].at(switches.names)) / width
        return Period(end, jacobian, switches, slopes)


def _among(types: npt.NDArray[np.int32], kinds: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """`np.isin`, which takes long for so few."""
    return np.asarray((types[:, None] == kinds).any(axis=1))


def _limits(model: mujoco.MjModel, data: mujoco.MjData, rows: npt.NDArray[np.bool_]) -> Names:
    """Names of the limits in these rows: a joint or a tendon, its number, and which of its two limits."""
    numbers, joints = data.efc_id[rows].astype(np.int64), data.efc_type[rows] == _LIMITS[0]
    lower = data.efc_J.reshape(data.nefc, -1)[rows].sum(axis=1) > 0  # of a joint
    tendons = numbers[~joints]
    lower[~joints] = np.isclose(data.efc_pos[rows][~joints], data.ten_length[tendons] - model.tendon_range[tendons, 0])
    return 4 * numbers + 2 * joints + lower


def _contacts(geoms: npt.NDArray[np.int32]) -> Names:
    """Names of contacts: the two geoms, and a number; they leave room for the edges of a friction pyramid."""
    pairs = (geoms[:, 0].astype(np.int64) * _GEOM + geoms[:, 1]) * _NUMBER
    earlier = np.tril(pairs[:, None] == pairs, -1).sum(axis=1, dtype=np.int64)
    return _CONTACT + pairs + earlier * _EDGE


class Approaches:
    """The approaches to a body: iterating gives each in words, and as positions (T+1, nv) in the form of states.

    Positions are NaN where the robot is free to move otherwise. `body_geoms` are the ids of the body's geoms that can
    collide, `tools` those of the driven geoms that can collide with them, the nearest first.

    Args:
      states: (T+1, n) of a plan in which nothing touches the body.
      change: (nv,) by how much the positions of the body are to change until the end.
    """

    def __init__(self, mjcf: MjcfModel, states: Array, change: Array) -> None:
        self._mjcf, self._model, self._steps = mjcf, mjcf.model, len(states) - 1
        model = self._model
        self._data, self._positions, self._change = mujoco.MjData(model), states[:, : model.nv], change
        root = int(model.body_weldid[model.dof_bodyid[np.argmax(np.abs(change))]])
        carried = np.array([root in carriers(model, body) for body in range(model.nbody)])
        self.body_geoms = np.flatnonzero(carried[model.geom_bodyid] & colliding(model)).tolist()
        self._place(self._positions[0])
        driven = np.unique(model.dof_treeid[self._data.moment_colind[: self._data.moment_rownnz.sum()]])
        self._dofs = np.isin(model.dof_treeid, driven) & ~carried[model.dof_bodyid]
        movers = touching_pairs(model, self.body_geoms)[:, 0]
        bodies = model.geom_bodyid[movers]
        tools = movers[np.isin(model.body_treeid[bodies], driven) & ~carried[bodies]]
        self.tools = sorted(set(tools.tolist()), key=self._gap)

    def __iter__(self) -> Iterator[tuple[str, Array]]:
        for times in _TIMES if self.tools else ():
            begin, end = (int(part * self._steps) for part in times)
            way = self._way(begin, end)
            if np.linalg.norm(way[end] - way[begin]) > _TOUCHING:
                attempts = [push for tool in self.tools[:_TOOLS] for push in self._pushes(tool, way, begin, end)]
                pairs = itertools.product(self._pairs()[:_PAIRS], _PRESSED)
                attempts += [self._grasp(*grasp, way, begin, end) for grasp in pairs]
                for words, positions in attempts:
                    drawn = np.where(self._dofs, positions, np.nan)
                    drawn[end + 1 :] = np.nan
                    yield words, drawn

    def _place(self, positions: Array) -> None:
        self._data.qpos[:] = self._mjcf.qpos_of(positions)
        with unlogged():
            mujoco.mj_fwdPosition(self._model, self._data)

    def _gap(self, tool: int) -> float:
        return min(mujoco.mj_geomDistance(self._model, self._data, tool, geom, 1e3, None) for geom in self.body_geoms)

    def _way(self, begin: int, end: int) -> Array:
        """Places (T+1, 3) of the body's centre: those of the plan, moved on from rest to rest between two knots."""
        fractions = np.clip((np.arange(self._steps + 1) - begin) / max(end - begin, 1), 0.0, 1.0)
        way = np.empty((self._steps + 1, 3))
        for t, fraction in enumerate(fractions**2 * (3 - 2 * fractions)):
            self._place(self._positions[t] + fraction * self._change)
            way[t] = self._data.geom_xpos[self.body_geoms].mean(axis=0)
        return way

    def _pushes(self, tool: int, way: Array, begin: int, end: int) -> Iterator[tuple[str, Array]]:
        """Pushes by a tool, along each path to the far side of the body that it can follow."""
        forward, centre = _unit(way[end] - way[begin]), way[begin]
        self._place(self._positions[0])
        point = self._tip(tool, way[0])
        offset = self._spot(tool, point) - centre
        touching = self._reach(tool, point, -forward)
        radii = np.linspace(max(float(np.linalg.norm(offset)), touching), touching, begin + 1)
        radii[1:-1] = np.maximum(radii[1:-1], _ROUND * touching)
        for words, directions in _paths(_unit(offset), -forward):
            spots = way - touching * forward
            knots = np.linspace(0, len(directions) - 1, begin + 1)
            parts = [np.interp(knots, range(len(directions)), part) for part in np.transpose(directions)]
            mixed = np.stack(parts, axis=1)
            spots[: begin + 1] = centre + radii[:, None] * (mixed / np.linalg.norm(mixed, axis=1, keepdims=True))
            positions, misses = self._follow([tool], [point], spots[:, None])
            if misses[:begin].max(initial=0.0) <= _OFF * touching:
                yield f"a push by {self._model.geom(tool).name}{words}", positions

    def _grasp(self, pair: tuple[int, int], pressed: float, way: Array, begin: int, end: int) -> tuple[str, Array]:
        """A grasp by two tools, which come straight from where they are to both sides of the body's way, and close."""
        self._place(self._positions[0])
        points = [self._tip(tool, way[0]) for tool in pair]
        spots = np.array([self._spot(*tip) for tip in zip(pair, points, strict=True)])
        forward, line, sides = _unit(way[end] - way[begin]), spots[0] - spots[1], np.array([[1.0], [-1.0]])
        line = _unit(line - (line @ forward) * forward)
        tips = zip(pair, points, sides, strict=True)
        touching = [self._reach(tool, point, side * line) for tool, point, side in tips]
        begin_closing = max(begin - round(_CLOSING * self._steps), 1)
        centres = way.copy()
        centres[:begin_closing] = np.linspace(spots.mean(axis=0), way[begin], begin_closing)
        knots = np.arange(self._steps + 1)
        widths = np.interp(knots, [begin_closing, begin], [_OPEN, pressed])[:, None, None]
        targets = centres[:, None] + widths * (sides * np.array(touching)[:, None] * line)
        positions, _ = self._follow(pair, points, targets)
        first, second = (self._model.geom(tool).name for tool in pair)
        return f"a grasp by {first} and {second}", positions

    def _pairs(self) -> list[tuple[int, int]]:
        """Pairs of tools that can close along the line between them, the nearest first."""
        model, pairs = self._model, list[tuple[float, tuple[int, int]]]()
        self._place(self._positions[0])
        place = self._data.geom_xpos[self.body_geoms].mean(axis=0)
        spots = [self._spot(tool, self._tip(tool, place)) for tool in self.tools]
        slopes = np.zeros((len(self.tools), 3, model.nv))
        for slope, tool, spot in zip(slopes, self.tools, spots, strict=True):
            mujoco.mj_jac(model, self._data, slope, None, spot, int(model.geom_bodyid[tool]))
        for i, first in enumerate(self.tools):
            for j, second in enumerate(self.tools[:i]):
                line, motion = spots[i] - spots[j], (slopes[i] - slopes[j])[:, self._dofs]
                sizes = np.linalg.norm(motion, axis=0)
                closes = (sizes > 0) & (np.abs(line @ motion) > _ACROSS * np.linalg.norm(line) * sizes)
                if closes.any():
                    pairs.append((self._gap(first) + self._gap(second), (first, second)))
        return [pair for _, pair in sorted(pairs)]

    def _tip(self, tool: int, place: Array) -> Array:
        """The point of a tool, in its own axes, that is to touch: on its long axis, nearest to a place."""
        middle, half = np.split(self._model.geom_aabb[tool], 2)
        reach = np.where(half == half.max(), half - np.sort(half)[1], 0.0)
        local = self._axes(tool).T @ (place - self._data.geom_xpos[tool])
        return np.clip(local, middle - reach, middle + reach)

    def _axes(self, tool: int) -> Array:
        return self._data.geom_xmat[tool].reshape(3, 3)

    def _spot(self, tool: int, point: Array) -> Array:
        return self._data.geom_xpos[tool] + self._axes(tool) @ point

    def _reach(self, tool: int, point: Array, side: Array) -> float:
        """How far to a side of the body's centre a tool's point is when the tool touches the body, where it is now.

        The tool comes from afar, by its distance from the body at each step, as it then cannot pass through.
        """
        model, places = self._model, self._data.geom_xpos
        place, offset = places[tool].copy(), self._spot(tool, point) - places[tool]
        bounds = float(model.geom_rbound[tool] + np.linalg.norm(point) + model.geom_rbound[self.body_geoms].max())
        middle, distance = places[self.body_geoms].mean(axis=0), 2 * bounds
        for _ in range(_SEARCHES):
            places[tool] = middle + distance * side - offset
            gap = self._gap(tool)
            if gap < _TOUCHING:
                break
            distance -= gap
        places[tool] = place
        return max(distance, _TOUCHING)

    def _follow(self, tools: Sequence[int], points: Sequence[Array], targets: Array) -> tuple[Array, Array]:
        """Positions (T+1, nv) with points of k tools at targets (T+1, k, 3), or near them, and how far off (T+1,)."""
        model, data, moving = self._model, self._data, np.flatnonzero(self._dofs)
        self._place(self._positions[0])
        limited = np.flatnonzero((model.jnt_limited != 0) & (model.jnt_type >= mujoco.mjtJoint.mjJNT_SLIDE.value))
        places, ranges = model.jnt_qposadr[limited], model.jnt_range[limited].T
        positions, misses = np.empty((len(targets), model.nv)), np.empty(len(targets))
        slopes, change = np.zeros((len(tools), 3, model.nv)), np.zeros(model.nv)
        for t, target in enumerate(targets):
            for _ in range(_OTHERS if t else _FIRST):
                spots = np.array([self._spot(*tip) for tip in zip(tools, points, strict=True)])
                for slope, tool, spot in zip(slopes, tools, spots, strict=True):
                    mujoco.mj_jac(model, data, slope, None, spot, int(model.geom_bodyid[tool]))
                slope = slopes[:, :, moving].reshape(-1, len(moving))
                square = slope @ slope.T
                square += _DAMPING * max(float(square.max()), 1e-12) * np.eye(len(square))
                step = slope.T @ np.linalg.solve(square, (target - spots).ravel())
                change[moving] = np.clip(step, -_CHANGE, _CHANGE)
                mujoco.mj_integratePos(model, data.qpos, change, 1.0)
                data.qpos[places] = np.clip(data.qpos[places], *ranges)
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
            positions[t] = self._mjcf.positions_of(data.qpos)
            spots = np.array([self._spot(*tip) for tip in zip(tools, points, strict=True)])
            misses[t] = np.linalg.norm(target - spots, axis=1).max()
        return positions, misses


def _unit(vector: Array) -> Array:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _paths(first: Array, last: Array) -> Iterator[tuple[str, list[Array]]]:
    """Directions through which a tool goes round a body, from the first to the last, in words: the short way first."""
    if first @ last > -_ALONG:
        yield "", [first, last]
    left = np.cross([0.0, 0.0, 1.0], last)
    others = {"over": np.array([0.0, 0.0, 1.0]), "to the left of": left, "to the right of": -left}
    for words, other in others.items() if first @ last < 0.5 else ():
        if np.linalg.norm(other) > 0.1 and np.abs(np.array([first, last]) @ _unit(other)).max() < _ALONG:
            yield f", {words} the body", [first, _unit(other), last]
