"""Variants of the problems with obstacles, to which nobody tuned anything: mirrored, other boxes, other starts."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from kinodynamic.check import clearances, excess, in_their_states
from kinodynamic.data import Case

MOVED, GROWN, ELSEWHERE = 0.1, 0.1, 0.2  # boxes in m, and in shares of their sizes; the start in m
ROOM = 0.05  # m between the robot and obstacles, at the start and at the goal


def drawn(case: Case, count: int, seed: int) -> Iterator[Case]:
    """So many, the first of every two mirrored, with boxes that are moved and grown or shrunk, and another start."""
    for number in range(count):
        rng = np.random.default_rng([seed, number, *case.name.encode()])
        whole = mirrored(case) if number % 2 == 0 else case
        yield replace(_changed(whole, rng), name=f"{case.name} {number}", published=None)


def mirrored(case: Case) -> Case:
    """The mirror image: with wheels at a line along x, else at one along gravity, or at the plane x = 0."""
    names = list(case.model.states)
    wheels = case.robot.startswith(("unicycle", "car"))
    across = "y" if wheels else "x"
    along = [name for name in names if name.endswith(across) and not name.startswith(("r", "w"))]
    if case.model.radius is None:
        turned = [name for name, unit in case.model.states.items() if unit in ("rad", "rad/s")]
    else:
        turned = [name for name in names if name[0] in "rw" and name[-1] != across]
    signs = np.array([-1.0 if name in (*along, *turned) else 1.0 for name in names])
    axis = "xyz".index(across)
    flip = np.ones(case.boxes.shape[1])
    flip[axis] = -1.0
    low, high = case.low.copy(), case.high.copy()
    if len(low):
        low[axis], high[axis] = -case.high[axis], -case.low[axis]
    return replace(case, start=signs * case.start, goal=signs * case.goal, low=low, high=high, boxes=flip * case.boxes)


def _changed(case: Case, rng: Generator) -> Case:
    places = case.boxes.shape[1] // 2
    while True:
        boxes = case.boxes + 0.0
        boxes[:, :places] += rng.uniform(-MOVED, MOVED, (len(boxes), places))
        boxes[:, places:] *= rng.uniform(1 - GROWN, 1 + GROWN, (len(boxes), places))
        start = case.start + 0.0
        start[: len(case.low)] += rng.uniform(-ELSEWHERE, ELSEWHERE, len(case.low))
        changed = replace(case, boxes=boxes, start=start)
        ends = in_their_states(case, np.stack([changed.start, changed.goal]))
        if clearances(changed, ends).min() >= ROOM and excess(changed, ends) <= 0.0:
            return changed
