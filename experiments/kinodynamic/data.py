"""The numbers of dynobench: eight robots, 43 problems, and the least times that its planners found.

From https://github.com/quimortiz/dynobench at 4ddf752 (`models/`, `envs/`, `src/*.cpp`), which comes with Ortiz-Haro et
al., "iDb-A*: iterative search and optimization for optimal kinodynamic motion planning", arXiv 2311.03553. Lengths are
in m, angles in rad, times in s. An attitude is a rotation vector; there it is a quaternion.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

Array = np.ndarray
Range = tuple[float, float]

GRAVITY = 9.81
STEEPEST = np.pi / 4  # angle between a car and its trailer


@dataclass(frozen=True, kw_only=True)
class Model:
    """A robot.

    Attributes:
      states, controls: name -> unit.
      limits: of the controls. bounds: of the states. rest: controls from which a search may begin.
      period: of its Euler steps in s.
      distance: (weight, names): the distance of two states is the sum of weighted norms of their differences.
      boxes: (length, width) of its bodies in the plane; see `check.frames`. radius: of a ball in space.
      guess: duration of a first guess in s, alike for all of its problems.
    """

    states: Mapping[str, str]
    controls: Mapping[str, str]
    limits: Mapping[str, Range]
    rest: Sequence[float]
    period: float
    distance: Sequence[tuple[float, str]]
    guess: float
    bounds: Mapping[str, Range] = field(default_factory=dict)
    boxes: Sequence[tuple[float, float]] = ()
    radius: float | None = None

    @property
    def position(self) -> tuple[str, ...]:
        return tuple(name for name in ("x", "y", "z") if name in self.states)

    def number(self, name: str) -> int:
        """The place of a state."""
        return list(self.states).index(name)


@dataclass(frozen=True, kw_only=True)
class Case:
    """A problem: from rest at the start to rest at the goal in the least time.

    Attributes:
      name: of the model, a slash, and the problem's own. start, goal: (n,) states.
      low, high: of the position. boxes: (B, 2 d) centres and sizes of obstacles in d dimensions.
      published: least time of the feasible plans that come with dynobench, of either planner. None for a variant.
    """

    name: str
    start: Array
    goal: Array
    low: Array
    high: Array
    boxes: Array
    published: float | None

    @property
    def robot(self) -> str:
        return self.name.split("/")[0]

    @property
    def model(self) -> Model:
        return MODELS[self.robot]

    @property
    def bounds(self) -> dict[str, Range]:
        """The bounds of states, those of the position included."""
        return dict(self.model.bounds) | {
            name: (float(low), float(high))
            for name, low, high in zip(self.model.position, self.low, self.high, strict=True)
        }


def _in(unit: str, names: str) -> dict[str, str]:
    return dict.fromkeys(names.split(), unit)


def _within(low: float, high: float, names: str) -> dict[str, Range]:
    return dict.fromkeys(names.split(), (low, high))


def _unicycle(v: Range, w: Range) -> Model:
    return Model(
        states=_in("m", "x y") | _in("rad", "a"), controls={"v": "m/s", "w": "rad/s"}, limits={"v": v, "w": w},
        rest=[max(0.0, sum(v) / 2), 0.0], period=0.1, distance=[(1.0, "x y"), (0.5, "a")], guess=20.0,
        boxes=[(0.5, 0.25)],
    )  # fmt: skip


def _quadrotor(controls: str, limits: Mapping[str, Range], rest: Sequence[float]) -> Model:
    return Model(
        states=_in("m", "x y z") | _in("m/s", "vx vy vz") | _in("rad", "rx ry rz") | _in("rad/s", "wx wy wz"),
        controls=_in("1", controls), limits=limits, rest=rest, period=0.01, guess=4.0, radius=0.25,
        distance=[(1.0, "x y z"), (0.5, "rx ry rz"), (0.1, "vx vy vz"), (0.05, "wx wy wz")],
        bounds=_within(-4.0, 4.0, "vx vy vz") | _within(-8.0, 8.0, "wx wy wz"),
    )  # fmt: skip


MODELS: dict[str, Model] = {
    "unicycle1_v0": _unicycle((-0.5, 0.5), (-0.5, 0.5)),
    "unicycle1_v1": _unicycle((0.25, 0.5), (-0.5, 0.5)),
    "unicycle1_v2": _unicycle((0.25, 0.5), (-0.25, 0.5)),
    "unicycle2_v0": Model(
        states=_in("m", "x y") | {"a": "rad", "v": "m/s", "w": "rad/s"}, controls={"acc": "m/s^2", "turn": "rad/s^2"},
        limits=_within(-0.25, 0.25, "acc turn"), bounds=_within(-0.5, 0.5, "v w"), rest=[0.0, 0.0], period=0.1,
        distance=[(1.0, "x y"), (0.5, "a"), (0.25, "v"), (0.25, "w")], guess=20.0, boxes=[(0.5, 0.25)],
    ),
    "car1_v0": Model(
        states=_in("m", "x y") | _in("rad", "a b"), controls={"v": "m/s", "steer": "rad"}, rest=[0.0, 0.0],
        limits={"v": (-0.1, 0.5), "steer": (-1.047198, 1.047198)}, period=0.1,
        distance=[(1.0, "x y"), (0.5, "a"), (0.5, "b")], guess=20.0, boxes=[(0.5, 0.25), (0.3, 0.25)],
    ),
    "quad2d_v0": Model(
        states=_in("m", "x y") | {"a": "rad"} | _in("m/s", "vx vy") | {"w": "rad/s"}, controls=_in("1", "f1 f2"),
        limits=_within(0.0, 1.3, "f1 f2"), bounds=_within(-4.0, 4.0, "vx vy") | _within(-8.0, 8.0, "w"),
        rest=[1.0, 1.0], period=0.01, distance=[(1.0, "x y"), (0.5, "a"), (0.2, "vx vy"), (0.2, "w")], guess=4.0,
        boxes=[(0.6, 0.2)],
    ),
    "quad2dpole_v0": Model(
        states=_in("m", "x y") | _in("rad", "a q") | _in("m/s", "vx vy") | _in("rad/s", "w wq"),
        controls=_in("1", "f1 f2"), limits=_within(0.0, 3.0, "f1 f2"), rest=[1.0, 1.0], period=0.01,
        bounds={"a": (-1.570796, 1.570796)} | _within(-3.0, 3.0, "vx vy") | _within(-5.0, 5.0, "w wq"),
        distance=[(1.0, "x y"), (0.5, "a"), (0.5, "q"), (0.2, "vx vy"), (0.2, "w"), (0.2, "wq")], guess=4.0,
        boxes=[(0.5, 0.25), (1.0, 0.1)],
    ),
    "quadrotor_v0": _quadrotor("f1 f2 f3 f4", _within(0.0, 1.3, "f1 f2 f3 f4"), [1.0] * 4),
    "quadrotor_v1": _quadrotor(
        "lift tx ty tz", {"lift": (0.0, 1.5)} | _within(-2.0, 2.0, "tx ty tz"), [1.0, 0.0, 0.0, 0.0]
    ),
    "acrobot_v0": Model(
        states=_in("rad", "q1 q2") | _in("rad/s", "w1 w2"), controls={"t": "N m"}, limits={"t": (-10.0, 10.0)},
        bounds=_within(-8.0, 8.0, "w1 w2"), rest=[0.0], period=0.01, guess=5.0, boxes=[(1.0, 0.1), (1.0, 0.1)],
        distance=[(0.5, "q1"), (0.5, "q2"), (0.2, "w1 w2")],
    ),
}  # fmt: skip

TRAP = [(4.5, 3, 0.2, 3.2), (3, 1.5, 3.2, 0.2), (3, 4.5, 3.2, 0.2), (1.5, 4.05, 0.2, 1.1), (1.5, 1.95, 0.2, 1.1)]
KINK = [(3, 5.2, 3, 1.6), (3.9, 4, 1.2, 0.8), (2.1, 3.4, 1.2, 0.8), (3, 2, 3, 2)]
WINDOW = [(4, 3, 2, 2, 0.3, 2), (1.1, 3, 1.9, 0.2, 0.3, 1), (2, 3, 2.7, 2, 0.3, 0.6), (2, 3, 1.2, 2, 0.3, 0.4)]
PARKED = [(0.3, 0.5, 0.25), (1.1, 0.5, 0.25), (2.7, 0.5, 0.25)]  # x and size
POST, OTHER_POST = (-1.4, 1.4, 0.5, 0.5), (1.4, 1.4, 0.5, 0.5)
# The attitude from which quadrotors recover: turned about x by some 175 degrees, 0.0436194 - 0.9990482 i.
TURNED = (-2 * float(np.arctan2(0.9990482, 0.0436194)), 0.0, 0.0)

Numbers = Sequence[float]
# start, goal; lowest and highest position; boxes; published. States that are not given are 0.
Row = tuple[Numbers, Numbers, Numbers, Numbers, Sequence[Numbers], float]

ROWS: dict[str, dict[str, Row]] = {
    "unicycle1_v0": {
        "parallelpark_0": (
            (0.7, 0.8), (1.9, 0.3), (0, 0), (3, 1.2), [(x, 0.3, *size) for x, *size in PARKED], 3.1,
        ),
        "kink_0": ((0.5, 4, 1.55), (5.5, 4, 1.55), (0, 0), (6, 6), KINK, 13.2),
        "bugtrap_0": ((3.8, 3), (5.2, 3), (0, 0), (6, 6), TRAP, 20.7),
    },
    "unicycle1_v1": {"kink_0": ((0.5, 4.5, 1.55), (5.5, 4, 1.55), (0, 0), (6, 6), KINK, 21.1)},
    "unicycle1_v2": {"wall_0": ((1.5, 2.5), (4, 2.5), (0, 0), (5, 6), [(2.5, 2.5, 0.2, 1.4)], 18.5)},
    "unicycle2_v0": {
        "parallelpark_0": (
            (0.7, 0.7), (1.9, 0.2), (0, -0.5), (3, 1.5), [(x, 0.2, *size) for x, *size in PARKED], 5.8,
        ),
        "kink_0": ((0.5, 4, 1.55), (5.5, 4, 1.55), (0, 0), (6, 6), KINK, 17.7),
        "bugtrap_0": ((3.8, 3), (5.2, 3), (0, 0), (6, 6), TRAP, 25.1),
    },
    "car1_v0": {
        "parallelpark_0": (
            (0.7, 0.6), (1.9, 0.2), (0, -0.5), (3.5, 2.5), [(0.7, 0.2, 0.5, 0.25), (2.7, 0.2, 0.5, 0.25)], 4.1,
        ),
        "kink_0": ((0.5, 4, 1.55, 1.55), (5.5, 4, 1.55, 1.55), (-1, 0), (6, 6), KINK, 14.3),
        "bugtrap_0": ((3.4, 3, 3.14, 3.14), (5.2, 3, 1.55, 1.55), (0, 0), (6, 6), TRAP, 19.0),
    },
    "quad2d_v0": {
        "empty_0": ((0, 0), (0, 1), (-1, -1), (1, 2), [], 0.96),
        "empty_1": ((0, 0), (1, 1), (-1, -1), (2, 2), [], 1.28),
        "fall_through": ((1, 4), (4, 1), (0, 0), (6, 6), [(1, 3, 3.4, 0.3), (5, 3, 3.4, 0.3)], 3.43),
        "quad2d_recovery_wo_obs": ((0, 1, 3.14), (1, 1), (-1, -2), (2, 3), [], 3.11),
        "quad2d_recovery_obs": ((0, 1, -3.14), (0, 2), (-1, -2), (2, 3), [(0, 1.5, 2, 0.3)], 4.44),
        "quad_obs_column": ((2, 1), (4, 1), (0, 0), (6, 5), [(3, 1, 0.4, 4)], 3.30),
        "quad_bugtrap": ((3.8, 3), (5.2, 3), (0, 0), (6, 6), TRAP, 5.15),
    },
    "quad2dpole_v0": {
        "down": ((0, 0, 0, 3.14), (), (-2, -2), (2, 2), [], 3.22),
        "up": ((), (0.6, 0, 0, 3.14), (-3, -3), (3, 5), [], 3.07),
        "move_with_down": ((), (1,), (-1, -1), (2, 2), [], 2.36),
        "move_with_up": ((0, 0, 0, 3.14), (1, 0, 0, 3.14), (-1, -1), (2, 2), [], 3.06),
        "up_obs": ((0, 0, 0, 0.1), (0, 2, 0, 3.14), (-2, -1), (2, 4), [(-1, 1, 3, 0.2)], 3.91),
        "window": ((0, 1), (3.5, 1, 0, 3.14), (-1, 0), (5, 3.5), [(2, -0.5, 0.4, 4.5), (2, 4, 0.4, 2)], 4.33),
        "window_easy": ((), (3, 0, 0, 3.14), (-1, -1), (5, 3), [(2, -0.5, 0.4, 4)], 3.32),
        "window_hard": ((0, 1), (4, 1, 0, 3.14), (-1, 0), (5, 3.5), [(2, -0.5, 0.4, 4.5), (2, 4, 0.4, 2.5)], 4.48),
    },
    "acrobot_v0": {
        "swing_up_empty": ((), (3.1415926,), (), (), [], 3.60),
        "swing_up_obs": ((), (3.141593,), (), (), [POST], 3.19),
        "swing_up_obs_hard": ((), (3.141593,), (), (), [POST, OTHER_POST], 2.93),
        "swing_down": ((3.141593,), (), (), (), [], 3.26),
        "swing_down_easy": ((1.55,), (), (), (), [], 2.19),
    },
}  # fmt: skip


def _in_space(goal: Numbers, low: Numbers, high: Numbers, floor: float, published: Numbers) -> dict[str, Row]:
    """The problems of a quadrotor; these numbers of the recoveries differ between the two."""

    def turned(z: float) -> Numbers:
        return (0, 0, z, 0, 0, 0, *TURNED)

    plate = [(0.25, 0.25, 1.5, 1.5, 1.5, 0.3)]
    rows: dict[str, tuple[Numbers, Numbers, Numbers, Numbers, Sequence[Numbers]]] = {
        "empty_0_easy": ((0, 0, 1), (0, 0, 2), (-1, -1, 0.8), (1, 1, 3), []),
        "empty_1_easy": ((0, 0, 1), (0.5, 0.5, 2), (-1, -1, 0.8), (1, 1, 2.5), []),
        "quad_one_obs": ((1, 1, 3), (5, 5, 3), (0, 0, 0), (6, 6, 6), [(3, 3, 3, 3, 3, 2)]),
        "window": ((4, 1, 2), (4, 5, 2), (1, 0.5, 1), (5, 5.5, 3), WINDOW),
        "recovery": (turned(1), goal, low, high, []),
        "recovery_with_obs": (turned(0.8), (0, 0, 2.5), (-2, -2, floor), (2, 2, 3), plate),
    }
    return {name: (*row, cost) for (name, row), cost in zip(rows.items(), published, strict=True)}


ROWS["quadrotor_v0"] = _in_space((0, 0.8, 1), (-1, -1, -2), (1, 2, 2), -2, (0.97, 1.20, 2.99, 2.49, 2.61, 3.52))
ROWS["quadrotor_v1"] = _in_space((0, 0.15, 1), (-2, -2, -2), (2, 2, 2), -3, (0.80, 0.89, 2.28, 2.18, 2.00, 3.01))


def _case(robot: str, name: str, row: Row) -> Case:
    start, goal, low, high, boxes, published = row
    model = MODELS[robot]
    states = [np.pad(np.array(one, dtype=float), (0, len(model.states) - len(one))) for one in (start, goal)]
    size = 2 * (len(model.position) or 2)
    return Case(
        name=f"{robot}/{name}", start=states[0], goal=states[1], low=np.array(low, dtype=float),
        high=np.array(high, dtype=float), boxes=np.array(boxes, dtype=float).reshape(-1, size), published=published,
    )  # fmt: skip


CASES = {case.name: case for robot, rows in ROWS.items() for case in (_case(robot, *row) for row in rows.items())}
