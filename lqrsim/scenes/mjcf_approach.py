"""Motions of a robot that would take a body, which nothing touches, to its goal: by geometry alone.

A push comes to the far side of the body, round it if need be, and goes on along the body's way. A grasp comes with open
fingers, closes them, and goes along. Forces are not considered. Whether the body moves is for a rollout to say.
"""

import itertools
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from lqrsim.errors import Array
from lqrsim.scenes.mjcf_kinematics import carriers, colliding
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.mjcf_obstacles import touching_pairs
from lqrsim.scenes.mujoco_log import unlogged

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
        touching = self._reach(tool, point, centre, -forward)
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
        """A grasp by two tools, from straight where they are, on both sides of the body's way."""
        self._place(self._positions[0])
        points = [self._tip(tool, way[0]) for tool in pair]
        spots = np.array([self._spot(*tip) for tip in zip(pair, points, strict=True)])
        forward, line, sides = _unit(way[end] - way[begin]), spots[0] - spots[1], np.array([[1.0], [-1.0]])
        line = _unit(line - (line @ forward) * forward)
        tips = zip(pair, points, sides, strict=True)
        touching = [self._reach(tool, point, way[begin], side * line) for tool, point, side in tips]
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

    def _reach(self, tool: int, point: Array, centre: Array, side: Array) -> float:
        """How far to a side of the body's centre a tool's point is when the tool touches the body.

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
