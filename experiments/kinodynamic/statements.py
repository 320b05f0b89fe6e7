"""The problems of dynobench for lqrsim: with a free duration in exact time, and by its Euler steps, so many of them."""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import numpy as np

import lqrsim as ls
from kinodynamic.check import ACCEPTED, frames
from kinodynamic.data import GRAVITY, MODELS, STEEPEST, Case, Model

Formula = Callable[[Any, Any, Any], Sequence[Any]]

STEPS = 100  # of a plan with a free duration
DURATIONS = (0.1, 100.0)  # in s
# Cost in s of a step with a control as far from rest as its limits are apart: what makes a plan of least time one of
# many alike. All steps together cost at most a millisecond per control.
EFFORT = 1e-5
KEPT = 0.03  # m, the clearance that published plans keep
# Largest error of a step. Some of 100 steps add up, and motions about the upright fall away from it by e^(3 s t).
ACCURACY = 1e-7
ROUND = 1e-4  # what makes a norm smooth where it is 0
NEAR = 0.99  # of the accepted distance to the goal: the plan is right to rounding, and the angle of a quaternion is not


def unicycle1(x: Any, u: Any, p: Any) -> Sequence[Any]:
    from sympy import cos, sin

    return [u.v * cos(x.a), u.v * sin(x.a), u.w]


def unicycle2(x: Any, u: Any, p: Any) -> Sequence[Any]:
    from sympy import cos, sin

    return [x.v * cos(x.a), x.v * sin(x.a), x.w, u.acc, u.turn]


def car1(x: Any, u: Any, p: Any) -> Sequence[Any]:
    from sympy import cos, sin, tan

    return [u.v * cos(x.a), u.v * sin(x.a), u.v / 0.25 * tan(u.steer), u.v / 0.5 * sin(x.a - x.b)]


def quad2d(x: Any, u: Any, p: Any) -> Sequence[Any]:
    from sympy import cos, sin

    lift, turning = (u.f1 + u.f2) * GRAVITY / 2, 0.1 / 1e-4 * 0.034 * GRAVITY / 2 * (u.f1 - u.f2)
    return [x.vx, x.vy, x.w, -lift * sin(x.a), lift * cos(x.a) - GRAVITY, turning]


def quad2dpole(x: Any, u: Any, p: Any) -> Sequence[Any]:
    """A quadrotor of 2.5 kg with a pole that hangs down at q = 0, at whose end there is a tenth of its mass."""
    from sympy import cos, sin

    m, end, unit = 2.5, 0.25, 2.5 * GRAVITY / 2
    thrust, tilt, turning = (u.f1 + u.f2) * unit, x.a + x.q, 0.25 * (u.f1 - u.f2) * unit / 1.2
    # Along the pole the masses move together, across it the quadrotor moves alone.
    pull = (m * (x.w + x.wq) ** 2 + thrust * cos(x.q)) * end / (m * (m + end))
    ax, ay = -thrust * sin(x.a) / m + pull * sin(tilt), thrust * cos(x.a) / m - pull * cos(tilt) - GRAVITY
    return [x.vx, x.vy, x.w, x.wq, ax, ay, turning, -thrust * sin(x.q) / m - turning]


def acrobot(x: Any, u: Any, p: Any) -> Sequence[Any]:
    """Two links of 1 m and 1 kg, of the same inertia about their pivots; the mass matrix is inverted by hand."""
    from sympy import cos, sin

    inertia, half = 0.33333, 0.5
    one, two = 2 * inertia + 1 + cos(x.q2), inertia + half * cos(x.q2)
    whole = one * inertia - two**2
    weight = half * GRAVITY * sin(x.q1 + x.q2)
    first = half * sin(x.q2) * x.w2 * (2 * x.w1 + x.w2) - 1.5 * GRAVITY * sin(x.q1) - weight
    second = u.t - half * sin(x.q2) * x.w1**2 - weight
    return [x.w1, x.w2, (inertia * first - two * second) / whole, (one * second - two * first) / whole]


def _wrench(robot: str, u: Any) -> tuple[Any, list[Any]]:
    """The acceleration along a quadrotor's axis in m/s^2, and its torques in N m."""
    if robot == "quadrotor_v1":
        return u.lift * GRAVITY, [20 * u.tx, 20 * u.ty, 20 * u.tz]
    unit, arm, drag = 0.034 * GRAVITY / 4, 0.707106781 * 0.046, 0.006
    f1, f2, f3, f4 = (unit * one for one in u)
    torques = [arm * (f3 + f4 - f1 - f2), arm * (f2 + f3 - f1 - f4), drag * (f2 + f4 - f1 - f3)]
    return (f1 + f2 + f3 + f4) / 0.034, torques


INERTIA = {"quadrotor_v0": (16.571710e-6, 16.655602e-6, 29.261652e-6), "quadrotor_v1": (1.0, 1.0, 1.0)}


def _spin(robot: str, w: Sequence[Any], torques: Sequence[Any]) -> list[Any]:
    """Euler's equations in body axes."""
    a, b, c = INERTIA[robot]
    gyroscopic = (b - c) * w[1] * w[2], (c - a) * w[2] * w[0], (a - b) * w[0] * w[1]
    return [(one + torque) / inertia for one, torque, inertia in zip(gyroscopic, torques, (a, b, c), strict=True)]


def _quadrotor(robot: str, x: Any, u: Any, p: Any) -> Sequence[Any]:
    lift, torques = _wrench(robot, u)
    v, r, w = x[3:6], x[6:9], x[9:12]
    ax, ay, az = ls.rotations.rotate(r, [0, 0, lift])
    return [*v, ax, ay, az - GRAVITY, *ls.rotations.vector_rate(r, w), *_spin(robot, w, torques)]


def quadrotor_v0(x: Any, u: Any, p: Any) -> Sequence[Any]:
    return _quadrotor("quadrotor_v0", x, u, p)


def quadrotor_v1(x: Any, u: Any, p: Any) -> Sequence[Any]:
    return _quadrotor("quadrotor_v1", x, u, p)


RATES: dict[str, Formula] = {
    "unicycle1_v0": unicycle1, "unicycle1_v1": unicycle1, "unicycle1_v2": unicycle1, "unicycle2_v0": unicycle2,
    "car1_v0": car1, "quad2d_v0": quad2d, "quad2dpole_v0": quad2dpole, "quadrotor_v0": quadrotor_v0,
    "quadrotor_v1": quadrotor_v1, "acrobot_v0": acrobot,
}  # fmt: skip


@cache
def dynamics(robot: str) -> ls.Dynamics:
    """The motion in exact time."""
    model = MODELS[robot]
    planar = model.radius is None
    return ls.Dynamics(
        RATES[robot], states=model.states, controls=model.controls, control_limits=dict(model.limits),
        position=model.position, angles=[name for name, unit in model.states.items() if planar and unit == "rad"],
        rotation_vectors=[] if planar else [("rx", "ry", "rz")],
    )  # fmt: skip


@cache
def euler_dynamics(robot: str) -> ls.Dynamics:
    """The Euler step as a map. A quadrotor's attitude is a quaternion here, as in dynobench: it becomes q exp(w dt)."""
    model = MODELS[robot]
    if model.radius is not None:
        states = {"x": "m", "y": "m", "z": "m", "qw": "1", "qx": "1", "qy": "1", "qz": "1"}
        states |= {name: unit for name, unit in model.states.items() if name[0] in "vw"}
        return ls.Dynamics(
            partial(_quadrotor_step, robot, model.period), states=states, controls=model.controls,
            control_limits=dict(model.limits), position=model.position, period=model.period,
        )  # fmt: skip
    return ls.Dynamics(
        partial(_euler_step, RATES[robot], model.period), states=model.states, controls=model.controls,
        control_limits=dict(model.limits), position=model.position, period=model.period,
        angles=[name for name, unit in model.states.items() if unit == "rad"],
    )  # fmt: skip


def _euler_step(rate: Formula, period: float, x: Any, u: Any, p: Any) -> Sequence[Any]:
    return [one + period * slope for one, slope in zip(x, rate(x, u, p), strict=True)]


def _quadrotor_step(robot: str, period: float, x: Any, u: Any, p: Any) -> Sequence[Any]:
    lift, torques = _wrench(robot, u)
    q, v, w = x[3:7], x[7:10], x[10:13]
    a, b, c, d = q
    push = 2 * (b * d + a * c) * lift, 2 * (c * d - a * b) * lift, (1 - 2 * (b**2 + c**2)) * lift - GRAVITY
    # Half the angle is at most 0.07: these powers are sine and cosine to rounding.
    square = sum(one**2 for one in w) * period**2 / 4
    cosine = 1 - square / 2 * (1 - square / 12 * (1 - square / 30 * (1 - square / 56)))
    sine = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)))
    e, f, g = (sine * period / 2 * one for one in w)
    turned = [
        a * cosine - b * e - c * f - d * g, b * cosine + a * e + c * g - d * f,
        c * cosine + a * f + d * e - b * g, d * cosine + a * g + b * f - c * e,
    ]  # fmt: skip
    moved, slopes = [*x[:3], *v, *w], [*v, *push, *_spin(robot, w, torques)]
    after = [one + period * slope for one, slope in zip(moved, slopes, strict=True)]
    return [*after[:3], *turned, *after[3:]]


def clear_of(case: Case, margin: float) -> list[ls.Constraint]:
    """The robot's shape keeps clear of the boxes by a margin in m."""
    if not len(case.boxes):
        return []
    radius = case.model.radius
    shape: dict[str, Any] = {"balls": outline(case.robot)} if radius is None else {"radius": radius}
    return [ls.Clearance(_world(case), margin=margin, **shape)]


@cache
def outline(robot: str) -> ls.CollisionSpheres:
    """The boxes of a robot in the plane."""
    boxes = [ls.types.Box(*size) for size in MODELS[robot].boxes]

    def corners(x: Any, p: Any) -> list[list[Any]]:
        from sympy import cos, sin

        places = zip(boxes, frames(robot, x, cos, sin), strict=True)
        return [corner for box, (*centre, angle) in places for corner in box.corners(centre, angle)]

    return ls.CollisionSpheres(corners, 0.0, hulls=[4] * len(boxes))


def _world(case: Case) -> ls.World:
    places = case.boxes.shape[1] // 2
    made = []
    for number, box in enumerate(case.boxes):
        centre, size = np.zeros(3), np.ones(3)
        centre[:places], size[:places] = box[:places], box[places:] / 2
        made.append(ls.Obstacle(f"box {number}", "box", centre, np.eye(3), size))
    return ls.World(made)


def _not_folded(x: Any, u: Any, p: Any) -> Sequence[Any]:
    return [p.most - x.a + x.b, p.most + x.a - x.b]


def _constraints(case: Case, margin: float) -> list[ls.Constraint]:
    rows: list[ls.Constraint] = [ls.StateBounds(case.bounds)] if case.bounds else []
    if case.robot == "car1_v0":
        rows.append(ls.SymbolicConstraint(_not_folded, parameters={"most": STEEPEST}, name="fold"))
    return [*rows, *clear_of(case, margin)]


def _effort(model: Model) -> ls.ControlCost:
    spans = np.array([high - low for low, high in model.limits.values()])
    return ls.ControlCost(EFFORT / spans**2, about=model.rest)


def in_least_time(case: Case, *, margin: float = 0.0, right: bool = False) -> ls.Problem:
    """The problem with a free duration, for the default search.

    Args:
      margin: to obstacles, in m. right: whether steps are as accurate as exact time asks, and conditions hold between
        the knots, too.
    """
    return ls.Problem(
        dynamics=dynamics(case.robot), dt=case.model.guess / STEPS, steps=STEPS, initial=ls.FixedState(case.start),
        # The goal has no weights: they would count whole turns of angles, which the goal itself does not.
        stage_cost=_effort(case.model), final_cost=ls.QuadraticCost(np.zeros(len(case.goal)), about=case.goal),
        constraints=[ls.GoalState(case.goal), *_constraints(case, margin)], duration=DURATIONS, time_weight=1.0,
        accuracy=ACCURACY if right else None, between_knots=right,
    )  # fmt: skip


def by_euler_steps(case: Case, plan: ls.Trajectory, steps: int) -> tuple[ls.Problem, ls.Trajectory]:
    """The problem in so many Euler steps of dynobench, and the plan, with a free duration, stretched to them: a start.

    The end may be as far from the goal as dynobench accepts, with the whole turns with which the plan ends.
    """
    model = case.model
    share = np.linspace(0.0, plan.steps, steps + 1)
    states = np.stack([np.interp(share, np.arange(plan.steps + 1), one) for one in plan.states.T], axis=1)
    controls = plan.controls[np.minimum(share[:-1].astype(int), plan.steps - 1)]
    if model.radius is not None:
        turned = ls.rotations.quaternion(states[:, 6:9])
        states = np.concatenate([states[:, :3], turned, states[:, 3:6], states[:, 9:]], axis=1)
    goal = {f"goal{number}": float(one) for number, one in enumerate(states[-1])}
    problem = ls.Problem(
        dynamics=euler_dynamics(case.robot), dt=model.period, steps=steps, initial=ls.FixedState(states[0]),
        stage_cost=_effort(model), final_cost=ls.QuadraticCost(np.ones(states.shape[1]), about=states[-1]),
        constraints=[
            ls.SymbolicConstraint(_near_goal(case.robot), parameters=goal, at="final", name="goal"),
            *_constraints(case, KEPT),
        ],
    )  # fmt: skip
    return problem, ls.Trajectory(states, controls, model.period)


@cache
def _near_goal(robot: str) -> Formula:
    """The weighted distance to the goal, its norms rounded upwards, is at most what dynobench accepts."""
    model = MODELS[robot]
    names = list(euler_dynamics(robot).state_coordinates.names)
    # An angle of a quaternion near the goal's is twice the norm of the difference.
    groups = [
        (2 * weight, "qw qx qy qz") if group == "rx ry rz" else (weight, group) for weight, group in model.distance
    ]

    def near(x: Any, u: Any, p: Any) -> Any:
        from sympy import sqrt

        norms = [
            weight * sqrt(ROUND**2 + sum((x[i] - getattr(p, f"goal{i}")) ** 2 for i in map(names.index, group.split())))
            for weight, group in groups
        ]
        return NEAR * ACCEPTED["goal"] - sum(norms)

    return near
