"""Bad input is named; where a file, a run or a robot is needed, with the tests of these. Messages are one line."""

import itertools
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracking import hover, weave

import lqrsim
from lqrsim import rotations
from lqrsim.codegen.sources import Source, source_of
from lqrsim.errors import LONGEST
from lqrsim.problem import quadratic_cost
from lqrsim.scenarios.references import resolve
from lqrsim.simulation.disturbances.base import Effect
from lqrsim.stress import statistics
from lqrsim.stress.failure_search import PrescribedDraws
from lqrsim.stress.reliability import failure_probability, smallest_failure

ls: Any = lqrsim  # any type is passed
of: Any = lqrsim.disturbances
NAN, INF = float("nan"), float("inf")

drive = cache(ls.scenarios.differential_drive)
quadrotor = cache(ls.scenarios.quadrotor)
UNIT = ls.types.Quadratic(np.eye(1), np.zeros(1), np.array(0.0))
STAGE = ls.lq.Stage(A=[[0.0]], B=[[1.0]], R=[[1.0]])
END = ls.types.Quadratic(np.eye(2), np.zeros(2), np.array(0.0))
FLAT = ls.types.Quadratic(np.diag([1.0, 0.0]), np.zeros(2), np.array(0.0))
PRIOR = ls.InitialPrior((1.0,) * 3, about=(0.0,) * 3)
STEP = ls.lq.Stage(A=np.eye(2), B=np.ones((4, 2, 1)), R=[[1.0]])
SPACE = ls.types.Coordinates(
    names=("x", "heading", "rx", "ry", "rz"), units=("m", *("rad",) * 4), angles=(1,), rotation_vectors=(2,)
)


@cache
def arena() -> Any:
    return drive().plant()


@cache
def cage() -> Any:
    return quadrotor().plant()


@cache
def lq_continuous() -> Any:
    return ls.lq.smooth_lq_continuous(STAGE, horizon=2.0, initial=UNIT, final=UNIT)


def smooth(**options: Any) -> Any:
    return ls.smooth(drive().problem, **options)


def smooth_lq_continuous(**changes: Any) -> Any:
    return ls.lq.smooth_lq_continuous(**{"stage": STAGE, "horizon": 1.0, "initial": UNIT, "final": UNIT} | changes)


def smooth_lq(**changes: Any) -> Any:
    return ls.lq.smooth_lq(**{"stage": STEP, "initial": END, "final": END} | changes)


def fly(*disturbances: Any, **options: Any) -> Any:
    return ls.simulate(cage(), hover(5), disturbances=disturbances, **options)


def roll(*disturbances: Any) -> Any:
    return ls.simulate(arena(), weave(30), disturbances=disturbances)


def lost_plan() -> Any:
    plan = hover(5)
    states = plan.trajectory.states.copy()
    states[3, 0] = INF
    return replace(plan, status=ls.Status.NOT_FINITE, trajectory=replace(plan.trajectory, states=states))


# The call, and its bad arguments with what the line says.
OPTIONS: list[tuple[Callable[..., object], list[tuple[dict[str, Any], str]]]] = [
    (smooth, [
        ({"stop": "soon"}, "stop: got 'soon', want one of: optimal, cost"),
        ({"stop": 3}, "stop: got 3, want one of: optimal, cost"),
        ({"tolerance": 0.0}, "tolerance: got 0.0, want a finite number > 0"),
        ({"gap_tolerance": -1.0}, "gap_tolerance: got -1.0, want a finite number > 0"),
        ({"gap_tolerance": None}, "gap_tolerance: got None, want a finite number > 0"),
        ({"max_iterations": 0}, "max_iterations: got 0, want a whole number >= 1"),
        ({"start": (0.1,) * 3}, r"start: got shape \(3,\), want controls \(2,\) or \(150, 2\), an InitialPrior"),
        ({"start": (INF, 0)}, r"start: got inf at index \[0, 0\], want finite numbers"),
        ({"start": "hover"}, r"start: got 'hover', want controls \(2,\) or \(150, 2\), an InitialPrior"),
        ({"start": [[1.0, 2.0], [3.0]]}, r"start: got \[\[1.0, 2.0\], \[3.0\]\], want controls"),
        ({"start": lambda problem: "there"}, "start: got 'there', want controls"),
        ({"starts": 0}, "starts: got 0, want a whole number >= 1"),
        ({"starts": 2.5}, "starts: got 2.5, want a whole number >= 1"),
        ({"starts": 3, "start": (0.0, 0.0)}, "starts: got 3 beside a start, want one of the two"),
        ({"threads": 0}, "threads: got 0, want a whole number >= 1"),
        ({"form": "Dual"}, r"form: got 'Dual', want one of: dual, primal \(did you mean dual\?\)"),
        ({"form": None}, "form: got None, want one of: dual, primal"),
        ({"first_pass": "back"}, "first_pass: got 'back', want one of: forward, backward"),
        ({"first_pass": None}, "first_pass: got None, want one of: forward, backward"),
        ({"safeguard": "yes"}, "safeguard: got 'yes', want True or False"),
        ({"safeguard": None}, "safeguard: got None, want True or False"),
        ({"safeguard": np.array([1, 2])}, r"safeguard: got array\(\[1, 2\]\), want True or False"),
        ({"callback": 3}, "callback: got 3, want a function of an Iteration"),
        *[({"finish": bad}, f"finish: got {bad!r}, want one of: newton") for bad in ("gauss", "", False, 0)],
        *[({"time_limit": bad}, "time_limit: got") for bad in (0, -1, "1", NAN, INF)],
    ]),
    (lambda **options: ls.ilqr(drive().problem, **options), [
        *[({"time_limit": bad}, "time_limit: got") for bad in (0, -1, "1", NAN, INF)],
        ({"tolerance": None}, "tolerance: got None, want"),
        ({"start": PRIOR}, "start: got an InitialPrior, want controls"),
        ({"start": lambda problem: PRIOR}, "start: got an InitialPrior, want controls"),
    ]),
    (lambda **options: ls.lq.smooth_continuous(drive().problem, **options), [
        ({"tolerance": 0.0}, "^tolerance: got 0.0, want a finite number > 0"),
        ({"gap_tolerance": -1.0}, "^gap_tolerance: got -1.0, want a finite number > 0"),
        ({"max_iterations": 0}, "^max_iterations: got 0, want a whole number >= 1"),
        ({"start": (0.1,) * 3}, r"^start: got shape \(3,\), want \(2,\)"),
        ({"atol": 0.0}, "^atol: got 0.0, want a finite number > 0"),
    ]),
    (smooth_lq_continuous, [
        ({"horizon": 0.0}, "^horizon: got 0.0, want a finite number > 0"),
        ({"rtol": 1e-16}, "^rtol: got 1e-16, want a finite number >= 1e-13"),
        ({"stage": 3}, "^stage: got 3, want a Stage without a leading axis"),
        ({"stage": STEP}, "^stage: got a Stage"),
        ({"stage": lambda t: ls.lq.Stage(A=np.eye(2), B=np.ones((2, 1)), R=[[1.0]]) if t else STAGE},
         r"^stage: got B of shape \(2, 1\), want \(1, 1\) at all times"),
        ({"initial": None}, "^initial: got None, want a Quadratic"),
        ({"final": END}, r"^final: hessian: got shape \(2, 2\), want"),
    ]),
    (smooth_lq, [
        ({"form": "both"}, "form: got 'both', want one of: dual, primal"),
        ({"dt": 0.0}, "dt: got 0.0, want a finite number > 0"),
        ({"initial": FLAT}, "initial: hessian: got smallest eigenvalue 0, want"),
        ({"initial": ls.FixedState([0, 0]), "form": "primal"}, "initial: got a FixedState, want"),
        ({"initial": ls.FixedState([0])}, r"initial: state: got shape \(1,\), want \(2,\)"),
        ({"final": np.eye(2)}, r"final: got array\(.*, want a Quadratic"),
        ({"stage": ls.lq.Stage(A=FLAT.hessian, B=np.ones((4, 2, 1)), R=[[1.0]]), "form": "primal"},
         r'stage: A: got a singular matrix at step 0, want an invertible one, or form="dual"'),
        ({"stage": ls.lq.Stage(A=np.eye(2), B=np.ones((2, 1)), R=[[1.0]])},
         "stage: got a single stage, want one stage per step"),
    ]),
    (lambda **changes: ls.lq.Stage(**{"A": np.eye(2), "B": np.ones((4, 2, 1)), "R": [[1.0]]} | changes), [
        ({"B": [[1.0], [2.0, 3.0]]}, "Stage: B: got"),
        ({"B": np.ones((0, 2, 1))}, r"Stage: B: got shape \(0, 2, 1\), want at least one of each"),
        ({"c": [[1.0], [2.0, 3.0]]}, "Stage: c: got"),
        ({"A": None}, r"Stage: A: got None, want an array of shape \(2, 2\)"),
        ({"R": None}, r"Stage: R: got None, want an array of shape \(1, 1\)"),
        ({"A": np.eye(3)}, r"Stage: A: got shape \(4, 3, 3\), want \(4, 2, 2\)"),
        ({"B": np.ones((2, 1)), "Q": [[0, 1], [0, 0]]},
         r"Stage: Q: got 1 at \[0, 1\] and 0 at \[1, 0\], want a symmetric matrix"),
    ]),
    (lambda **changes: replace(drive().problem, **changes), [
        *[({"dt": bad}, f"dt: got {bad!r}, want a finite number > 0") for bad in (0.0, -0.1, NAN, "fast")],
        *[({"steps": bad}, f"steps: got {bad}, want a whole number >= 1") for bad in (0, 1.5, True)],
        ({"dynamics": None}, "dynamics: got None, want Dynamics"),
        ({"stage_cost": 3.0}, "cost: got 3.0, want a cost such as QuadraticCost"),
        ({"stage_cost": ls.ControlCost(np.ones(3), about=np.zeros(3))}, "weight: got size 3, want 2, the number of"),
        ({"stage_cost": ls.ControlCost({})}, "ControlCost: weight: got none for left, right, want one for each"),
        ({"stage_cost": ls.SymbolicCost(lambda x, u, p: [x[0], x[1]])}, "got 2 entries, want one: the cost"),
        ({"stage_cost": ls.SymbolicCost(lambda x, u, p: p.gain * x[0])}, "parameter: got 'gain', want one of"),
        ({"final_cost": ls.ControlCost([1.0] * 2, about=[0.0] * 2)}, "final_cost: got a cost that depends on the con"),
        ({"final_cost": ls.QuadraticCost(np.ones(2), about=np.zeros(2))}, "weight: got size 2, want 3, the number of"),
        ({"final_cost": ls.QuadraticCost({"kg": 1.0}, about={})}, "got 'kg', want one of: x, y, heading, m"),
        ({"final_cost": ls.QuadraticCost({"x": -1.0}, about={})}, "weight: got smallest eigenvalue -1"),
        ({"final_cost": ls.QuadraticCost({"x": NAN}, about={})}, "'x': got nan, want a finite number"),
        ({"final_cost": ls.QuadraticCost({"x": 1.0}, about=[0.0])}, r"about: got shape \(1,\), want \(3,\)"),
        ({"constraints": ["far away"]}, "constraints: got .*, want a list of constraints"),
        ({"constraints": [lambda x, u, p: x[0]]}, r"constraints: got .*for a function, \[SymbolicConstraint"),
        ({"constraints": [ls.StateBounds(x=(0.5, 1.0)), ls.StateBounds({"x": (-1.0, 0.2), "y": (0, 1)})]},
         "constraints: got x of at least 0.5 and at most 0.2, want bounds with room between them"),
        ({"initial": [0.0, 0.0, 0.0]}, "initial: got .*, want a cost such as .*, or a FixedState"),
        ({"initial": ls.FixedState((1.0, 2.0))}, r"initial: FixedState: got shape \(2,\), want \(3,\)"),
        ({"initial": ls.FixedState((0.1, -1.35, 0.0))}, r"start at \(0.1, -1.35\) m, 0.27 m inside obstacle 'pillar_1"),
        ({"initial": ls.QuadraticCost(np.ones(3), about=(0.3, -1.35, 0.0))},
         "0.07 m inside obstacle 'pillar_1', want it clear of obstacles by the robot's radius of 0.17 m"),
        ({"initial": ls.FixedState(headin=1.0)}, "got 'headin', want one of: x, y, heading.*did you mean heading"),
        ({"control_limits": {"push": (0, 1)}}, "control_limits: got 'push', want one of: left, right, "),
        ({"control_limits": {"left": 1.0}}, "control_limits: 'left': got shape"),
        ({"control_limits": {"left": (1.0, 1.0)}},
         "control_limits: got 1 to 1 for left, want the first below the second; a control that cannot change is"),
        ({"control_limits": {"left": (1.0, -1.0)}}, "control_limits: got 1 to -1 for left, want the first below the"),
        ({"control_limits": 3.0}, r"control_limits: got 3.0, want \(lowest, highest\)"),
        ({"control_limits": ((0, 0), (1, 1), (2, 2))}, r"control_limits: got .*, want \(lowest, highest\), each a num"),
        ({"control_limits": (1.0, 1.0)}, "control_limits: got 1 to 1 for left, want the first below the second"),
        ({"control_limits": (-1.0, NAN)}, "control_limits: got -1 to nan for left, want the first below the second"),
        ({"control_limits": (INF, INF)}, "control_limits: got inf to inf for left, want the first below the second"),
        ({"control_limits": ((-1.0, 1.0), (1.0, 0.5))}, "control_limits: got 1 to 0.5 for right, want the first below"),
        ({"control_limits": (1.0, 2.0, 3.0)}, r"control_limits: got \(1.0, 2.0, 3.0\), want \(lowest, highest\)"),
        ({"control_limits": (-1.0, (1.0, 2.0, 3.0))},
         r"control_limits: got .*, want \(lowest, highest\), each a number or \(2,\)"),
        ({"control_limits": ("low", "high")},
         r"control_limits: got \('low', 'high'\), want \(lowest, highest\), each a number"),
    ]),
    (ls.StateBounds, [
        ({"x": (np.zeros(21), 1.0, 2.0)},
         "StateBounds: 'x': got 3 items, want .low, high., each a number or one for each"),
        ({"x": (np.zeros(21), np.ones(20))},
         "StateBounds: 'x': got 21 and 20 numbers, want one for each knot in both"),
        ({"x": (np.arange(21.0), 5.0)}, "StateBounds: 'x': got 5 to 5 at knot 5, want low below high"),
        ({"x": (np.full(21, -INF), INF)},
         "StateBounds: 'x': got -inf to inf, want low below high, and one of them fin"),
        ({"x": (np.full(21, NAN), 1.0)}, "StateBounds: 'x': low: got nan at index .0., want a number"),
        ({"x": ([], 1.0)}, "StateBounds: 'x': low: got no numbers, want one, or one for each knot"),
        ({"x": (np.zeros((3, 2)), 1.0)}, "StateBounds: 'x': low: got shape .3, 2., want"),
        ({"x": ("low", 1.0)}, "StateBounds: 'x': low: got 'low', want a number, or one for each knot"),
    ]),
    (lambda **changes: ls.InitialPrior(**{"weight": (1.0, 1.0), "about": (0.0, 0.0)} | changes), [
        ({"obstacles": 0.5}, r"InitialPrior: obstacles: got shape \(\), want \(any,\)"),
        ({"obstacles": (0.0, 1.5)}, "InitialPrior: obstacles: got .*, want numbers from 0 to 1"),
        ({"about": [[0.0, 0.0], [1.0]]}, "InitialPrior: about: got .*"),
        ({"controls": "none"}, "InitialPrior: controls: got 'none', want .*"),
        ({"weight": (-1.0, 0.0)}, r"InitialPrior: weight: got \[-1.0, 0.0\], want numbers >= 0"),
    ]),
    (lambda **changes: replace(drive(), **changes), [
        ({"start": np.zeros(3)}, r"start: got shape \(3,\), want controls \(2,\)"),
        ({"start": "left"}, "start: got 'left', want controls"),
        ({"start": ls.InitialPrior((1.0, 1.0), about=(0.0, 0.0))}, "start: InitialPrior: weight"),
        ({"start": ls.Trajectory(np.zeros((10, 3)), np.zeros((9, 2)), 0.1)}, "start: states"),
    ]),
    (lambda **changes: ls.types.Coordinates(**{"names": ("a", "b"), "units": ("", "")} | changes), [
        ({"units": ("m",)}, "units: got 1, want 2"),
        ({"names": ("a", "a")}, "names: got a name twice"),
        ({"position": (0,)}, "position: got 1 entries, want 2"),
        ({"angles": (2,)}, r"angles: got indices \(2,\), want them between 0 and 1"),
        ({"low": (1.0, 0.0), "high": (0.0, 1.0)}, "limits of a: got 1 to 0, want the first below the second"),
    ]),
    (lambda **options: ls.check_plant(ls.DifferentialDrive(), ls.load_scene("arena"), **options), [
        ({"controls": 2.0}, "controls: got 2.0, want .lowest, highest., each a number or .2,., or such pairs by"),
        ({"controls": ([0.0, 0.0, 0.0], 1.0)}, "controls: got .*, want .lowest, highest."),
        ({"controls": {"lft": (0, 1)}}, "controls: got 'lft'.* left"),
        ({"controls": {"left": 1.0}}, "controls: 'left': got "),
        ({"controls": (0.4, -0.4)}, "want the lowest first"),
    ]),
    (fly, [
        ({"trials": 0}, "^trials: got 0, want a whole number >= 1$"),
        ({"seed": -1}, "^seed: got -1, want a whole number >= 0$"),
        ({"first_trial": 0.5}, "^first_trial: got 0.5"),
        ({"goal_radius": NAN}, "^goal_radius: got nan"),
    ]),
    (ls.Quadrotor, [
        ({"yaw_inertia": 0.0}, "^Quadrotor: yaw_inertia: got"),
        ({"min_force": 4.0}, "^Quadrotor: min_force: got"),
        ({"min_force": -1.0}, "^Quadrotor: min_force: got"),
    ]),
    (lambda **changes: ls.stress.ReliabilityProblem(**{"scenario": "quadrotor"} | changes), [
        ({"solution": 3}, "solution: got 3, want a Solution, the path of one"),
        ({"scenario": 3}, "scenario: got 3"),
        ({"sweep": ""}, "sweep: got"),
        ({"strength": 0.0}, "strength: got 0"),
        ({"policy": "open"}, "policy: got 'open', want .*open_loop"),
        ({"failure": "crash"}, "failure: got 'crash', want .*collision"),
        ({"goal_radius": -1.0}, "goal_radius: got -1"),
        ({"design_disturbances": "light"}, "^design_disturbances: got them with smooth, want track or offset_free"),
    ]),
]  # fmt: skip

# Calls, and what the line says.
CALLS: list[tuple[Callable[[], object], str]] = [
    # Parts of problems.
    (lambda: ls.QuadraticCost([[1.0, 2.0], [3.0, 4.0]], about=[0, 0]),
     r"got 2 at \[0, 1\] and 3 at \[1, 0\], want a symmetric"),
    (lambda: ls.QuadraticCost([1.0, -1.0], about=[0, 0]), "got smallest eigenvalue -1, want a positive-semidefinite"),
    *[(partial(ls.QuadraticCost, [1.0, bad], about=[0, 0]), rf"got {bad} at index \[1, 1\], want finite numbers")
      for bad in (NAN, INF)],
    (lambda: ls.QuadraticCost([[1.0, 0.0]], about=[0]), r"got shape \(1, 2\), want a square matrix"),
    (lambda: ls.QuadraticCost("heavy", about=[0]), "got 'heavy', want a matrix of numbers or its diagonal"),
    (lambda: ls.QuadraticCost([1.0], about=[0, 0]), r"about: got shape \(2,\), want \(1,\)"),
    (lambda: ls.QuadraticCost([1.0] * 4), "QuadraticCost: about: got none, want the state at which"),
    (lambda: ls.ControlCost([1.0, 0.0], about=[0, 0]), "got smallest eigenvalue 0, want a positive-definite"),
    (lambda: ls.ControlCost(2.0), "^ControlCost: weight: got the number 2, want a square matrix or its diagonal"),
    (lambda: ls.ControlCost(np.ones((5, 2, 2))), "weight: row 0: got smallest eigenvalue 0, want a positive-def"),
    (lambda: ls.ControlCost(np.ones((1, 5, 2, 2))), r"got shape \(1, 5, 2, 2\), want a square matrix or its diag"),
    (lambda: ls.ObstacleCost(drive().scene.world, radius=-1.0), "radius: got -1.0, want a finite number >= 0"),
    (lambda: ls.ObstacleCost(drive().scene.world, radius=0.1, sharpness=0.0), "sharpness: got 0.0, want a finite"),
    (lambda: ls.ObstacleCost(None, radius=0.1), "world: got None, want a World"),
    (lambda: ls.FixedState({"x": 1.0}, x=2.0), "FixedState: got 'x' twice"),
    *[(partial(ls.FixedState, *none), "FixedState: got no numbers, want one at least, as FixedState")
      for none in ((), ({},))],
    (lambda: ls.Obstacle("it", "cone", np.zeros(3), np.eye(3), np.ones(3)), "kind: got 'cone', want one of: plane"),
    (lambda: ls.Obstacle("it", "box", np.zeros(3), np.ones((3, 3)), np.ones(3)), "want orthonormal axes"),
    (lambda: ls.Obstacle("it", "box", np.zeros(3), np.eye(3), np.zeros(3)), "want lengths above 0"),
    # Problems.
    (lambda: ls.ilqr_many([drive().problem], tolerance=None), "tolerance: got None, want"),
    (lambda: ls.lq.smooth_continuous("drive"), "^problem: got 'drive', want a Problem"),
    (lambda: ls.lq.smooth_continuous(replace(drive().problem, initial=ls.FixedState((0, -2.5, np.pi)))),
     "^initial: got a FixedState, want an initial cost"),
    (lambda: ls.lq.smooth_continuous(replace(drive().problem, duration=(9.0, 30.0), time_weight=0.1)),
     "^duration: got a free duration, want None"),
    (lambda: ls.lq.smooth_continuous(replace(drive().problem, accuracy=1e-6)),
     "^accuracy: got that of steps, want None"),
    *[(partial(ls.load, "plan.npz", kind), "^kind: got .*, want one of ls.Solution, .* ls.types.Funnel, ls.stress")
      for kind in ([], {}, np.zeros(2), "Solution", int)],
    *[(lambda far=far: replace(drive().problem, begin=far).later(far),
       rf"^seconds: got {far:g} after begin, {far:g}, want a finite sum".replace("+", r"\+"))
      for far in (1e308, -1.5e308)],
    (lambda: drive().problem.site_errors(np.zeros(3)), r"states: got shape \(3,\), want"),
    (lambda: drive().problem.site_errors(np.zeros((2, 4))), r"states: got shape \(2, 4\), want"),
    (lambda: ls.smooth(replace(drive().problem, initial=ls.FixedState((0, -2.5, np.pi))), form="primal"),
     "initial: got a FixedState, want an initial cost"),
    (lambda: replace(SPACE, angles=(2, 4)),
     "^angles: got rx, rz of one rotation vector, want at most one of the three"),
    *[(partial(function, numbers, turns_about="w"), "turns_about: got 'w', want one of: x, y, z")
      for function, numbers in ((rotations.quaternion, np.zeros(3)), (rotations.rotation_vector, np.ones(4)))],
    (lambda: ls.QuadraticCost({"x": 1.0}, about={}).weight.any(),
     "QuadraticCost: got numbers by name, want the cost from a Problem"),
    *[(partial(cost.scaled, factor), rf"^factor: got {factor}, want a finite number >= 0")
      for cost in (ls.ControlCost([1.0]), ls.ControlCost([1.0]) + ls.QuadraticCost([1.0], about=[0.0]))
      for factor in (-1.0, np.nan)],
    (lambda: ls.FixedState(x=1.0).numbers.any(), "FixedState: got numbers by name, want the state from a Problem"),
    *[(partial(source_of, module, **constants), wanted) for module, constants, wanted in (
        ("no_such_module", {}, "want a file that was imported"), ("sys", {}, "want a file that was imported"),
        (7, {}, "want __name__"), (quadratic_cost, {"UNKNOWN": 1}, "UNKNOWN: got 1, want a number"),
        (quadratic_cost, {"CONTROL": "no"}, "CONTROL: got 'no', want a number"),
    )],
    *[(lambda name=name: Source(module=name).digest, "source: module: got .*, want the name of one that can be")
      for name in ("no_such_module", "lqrsim." * 2000 + "kernels", "lqrsim..kernels")],
    # Solutions in continuous time.
    (lambda: lq_continuous().policy([0.0], -0.1), r"^t: got -0\.1, want seconds from 0 to 2"),
    (lambda: lq_continuous().x_hat([0.0, 2.1]), r"^t: got 2\.1, want seconds from 0 to 2"),
    (lambda: lq_continuous().total_cost(np.nan), "^t: got nan, want seconds from 0 to 2"),
    (lambda: lq_continuous().cost_to_go("now"), "^t: got 'now', want numbers"),
    (lambda: lq_continuous().policy([0.0, 1.0], 0.0), r"^x: got shape \(2,\), want \(\.\.\., 1\)"),
    (lambda: lq_continuous().policy(np.zeros((3, 1)), [0.0, 1.0]), r"^x: got shape \(3, 1\), want"),
    (lambda: lq_continuous().inverse_policy([INF], 0.0), "^x: got .*inf.*, want finite numbers"),
    # Scenes.
    (lambda: resolve("nowhere.xml"), "scene: got 'nowhere.xml', want a file that exists"),
    *[(lambda name=name: resolve(f"{name}:there"), f"^scenario: got module {re.escape(repr(name))}, want the name of")
      for name in ("", ".", ".mine", "mine.", "a..b", "a b", "9")],
    *[(lambda text=text: resolve(f"quadrotor,query={text}"), "^query: got '")
      for text in ("{[]: 1}", "{{}}", 20_000 * "-" + "1", 300 * "(", 5000 * "[", "1 +", "\0")],
    (lambda: resolve("quadrotor,query=3,seed=1,query=4"), "^setting of quadrotor: got query twice, want it once"),
    (lambda: resolve("json:loads"), "^scenario: got json:loads without s, want json:loads,s=VALUE"),
    (lambda: ls.load_scene("aren"), "^scene: got 'aren', want one of: arena, cage .*or the path of an .xml"),
    (lambda: ls.load_scene("somewhere/nowhere.xml"),
     "^scene: got '.*nowhere.xml', want a file that exists, or one of: arena"),
    *[(lambda height=height, turn=turn: ls.types.Box(1, 2, height).corners([0.0] * (3 if height else 2), turn()),
       "corners: got .*, want . coordinates and") for height in (None, 1.0) for turn in (itertools.count, object, str)],
    (lambda: ls.Obstacle.of_corners(object(), np.zeros(3)), "^obstacle: name: got an object, want a name"),
    (lambda: ls.World([ls.Obstacle(
        "ramp", "box", np.zeros(3), Rotation.from_euler("x", 30, degrees=True).as_matrix(), np.ones(3)
    )]).seen_by("xy"), "'ramp': got a tilted box, want it upright"),
    # Runs.
    (lambda: ls.Plant(ls.Quadrotor(), ls.load_scene("arena")),
     "^scene arena: got no robot quadrotor in it, want its body .* has: .*create"),
    (lambda: ls.simulate(cage(), weave(5)),
     "^controller: got a policy with the states x, y, heading, want .*, as robot"),
    (lambda: ls.simulate(cage(), lost_plan()), r"^plan: got a plan that is not finite \(NOT_FINITE\), want one"),
    (lambda: fly("wind"), "^disturbances: got 'wind' at 0, want disturbances"),
    (lambda: Effect(factors={"masses": np.ones((1, 1))}),
     "^Effect: factors: got 'masses', want one of: mass, inertia, thrust"),
    # Disturbances, as they are made.
    (lambda: of.ControlNoise(-0.1), "^ControlNoise: std: got -0.1, want a finite number >= 0$"),
    (lambda: of.ControlNoise((0.1, -0.1)), "^ControlNoise: std: got -0.1, want numbers >= 0$"),
    (lambda: of.MeasurementNoise(NAN), "^MeasurementNoise: std: got nan"),
    (lambda: of.MeasurementNoise("much"), "^MeasurementNoise: std: got 'much'"),
    (lambda: of.MeasurementNoise({}), "MeasurementNoise: std: got no numbers"),
    (lambda: of.MeasurementNoise({"m": -1.0}), "MeasurementNoise: std: m: got -1"),
    (lambda: of.MeasurementNoise({"m": "wide"}), "MeasurementNoise: std: m: got 'wide'"),
    (lambda: of.MeasurementNoise({3: 1.0}), "MeasurementNoise: std: name: got 3"),
    (lambda: of.ForceNoise((0.1, 0.1)), "^ForceNoise: std: got 2 numbers, want 1 or 3: x, y, z$"),
    (lambda: of.ForceNoise({"x": 0.1}), "ForceNoise: std: got numbers by name, want one number, or one for each"),
    (lambda: of.Push((1.0, 2.0), at=1.0), r"^Push: impulse: got shape \(2,\), want \(3,\)$"),
    (lambda: of.Push((1.0, 2.0, INF), at=1.0), "^Push: impulse: got inf"),
    (lambda: of.Push((1.0, 2.0, 3.0), at=-1.0), "^Push: at: got -1.0, want a finite number >= 0$"),
    (lambda: of.MeasurementLatency(-1), "^MeasurementLatency: periods: got -1, want a whole number >= 0$"),
    (lambda: of.ControlDelay(True), "^ControlDelay: periods: got True, want a whole number >= 0$"),
    (lambda: of.MeasurementDropouts(1.01), "^MeasurementDropouts: loss: got 1.01, want a finite number >= 0 and <= 1$"),
    (lambda: of.CommandDropouts(2), "^CommandDropouts: loss: got 2, want a finite number >= 0 and <= 1$"),
    (lambda: of.GilbertElliott(0.1, 0.0), "^GilbertElliott: to_good: got 0.0, want a finite number > 0 and <= 1$"),
    (lambda: of.GilbertElliott(1.1, 0.1), "^GilbertElliott: to_bad: got 1.1, want"),
    (lambda: of.GilbertElliott(0.1, 0.1, NAN), "^GilbertElliott: lost_when_good: got nan, want"),
    (lambda: of.GilbertElliott(0.1, 0.1, 0, -1), "^GilbertElliott: lost_when_bad: got -1, want"),
    (lambda: of.Gusts(1.0, 0.0), "^Gusts: time_constant: got 0.0, want a finite number > 0$"),
    (lambda: of.Dryden("sever"), r"^Dryden: wind: got 'sever', want one of: light, .* \(did you mean severe\?\)$"),
    (lambda: of.Dryden(altitude=400.0), "^Dryden: altitude: got 400.0, want a finite number >= 0 and <= 304.8$"),
    (lambda: of.Saturation(), "^Saturation: share: got neither share and limits, want"),
    (lambda: of.Saturation(share=1.1), "^Saturation: share: got 1.1, want"),
    (lambda: of.SensorErrors([of.Sensor("gyro", noise=1.0), of.Sensor("gyro")]),
     r"^SensorErrors: sensors: got \['gyro', 'gyro'\], want each at most once"),
    (lambda: of.ActuatorLoss(remaining=1.1), "^ActuatorLoss: remaining: got 1.1, want"),
    (lambda: of.MassMismatch(), "^MassMismatch: got neither of std and factor, want one of the two$"),
    (lambda: of.AxleMismatch(0.1, 1.1), "^AxleMismatch: got both std and factor, want one of the two$"),
    (lambda: of.ThrustMismatch(0.34),
     "^ThrustMismatch: std: got 0.34, want a finite number >= 0 and < 0.3333333333333333$"),
    (lambda: of.MassMismatch(factor=0.0), "^MassMismatch: factor: got 0, want numbers > 0$"),
    *[(partial(getattr(of, kind), factor=()), f"^{kind}: factor: got no numbers, want at least one$")
      for kind in dir(of) if kind.endswith("Mismatch")],
    *[(partial(getattr(of, kind), factor=factor), f"^{kind}: factor: got ")
      for kind in dir(of) if kind.endswith("Mismatch") for factor in ([], np.zeros(0), [[]], np.zeros((0, 3)))],
    # Disturbances of a plant that they do not fit.
    (lambda: roll(of.ControlNoise((0.1, 0.1, 0.1))), "^ControlNoise: std: got 3 numbers, want 1 or 2: left, right$"),
    (lambda: roll(of.ControlNoise({"m": 0.1})), "ControlNoise: std: got 'm', want"),
    (lambda: roll(of.MeasurementNoise((0.1, 0.1))),
     "^MeasurementNoise: std: got 2 numbers, want 1 or 3: x, y, heading$"),
    (lambda: roll(of.MeasurementNoise({"z": 0.1})), "MeasurementNoise: std: got 'z', want"),
    (lambda: roll(of.Push((1.0, 0.0, 0.0), at=5.0)),
     "^Push: at: got 5 s, want a time before the plan ends at 5 s$"),
    (lambda: roll(of.Push((1.0, 0.0, 0.0), at=1e308)), r"^Push: at: got 1e\+308 s, want a time before"),
    (lambda: fly(of.ActuatorLoss(at=1e308)), r"^ActuatorLoss: at: got 1e\+308 s, want a time before"),
    *[(lambda factor=factor: of.MassMismatch(factor=factor).scaled(1e6), r"^MassMismatch: strength: got 1e\+06, want")
      for factor in (0.5, 1.5)],
    (lambda: roll(of.ThrustMismatch(0.01)),
     "^ThrustMismatch: got robot differential_drive with servos"),
    *[(lambda kind=kind, numbers=numbers: roll(getattr(of, kind)(*numbers)),
       f"^{kind}: got robot differential_drive, which wind cannot push without drag")
      for kind, numbers in (("MeanWind", [(1.0, 0.0, 0.0)]), ("Gusts", []), ("Dryden", []))],
    (lambda: fly(of.ActuatorLoss("rotor_1")),
     "^ActuatorLoss: actuator of quadrotor: got 'rotor_1', want one of: quadrotor_"),
    (lambda: fly(of.ActuatorLoss(at=3.0)), "^ActuatorLoss: at: got 3 s, want a time before"),
    *[(lambda kind=kind: fly(getattr(of, kind)(0.01)), f"^{kind}: got robot quadrotor, which has no wheels")
      for kind in ("WheelRadiusMismatch", "AxleMismatch", "FrictionMismatch")],
    (lambda: fly(of.ThrustMismatch(factor=(1.0, 1.1))),
     "^ThrustMismatch: factor: got 2 numbers, want 1 or 4: quadrotor_"),
    (lambda: fly(of.MassMismatch(factor=(1.0, 1.1))), "^MassMismatch: factor: got 2 numbers, want 1 or 1: mass$"),
    (lambda: fly(of.InitialStateError((1.0, 1.1))), "^InitialStateError: std: got 2 numbers, want 1 or 12: x, y"),
    # Uncertainty of a plant.
    (lambda: ls.uncertainty_of(arena(), [of.MeanWind((1.0, 0.0, 0.0))]),
     "^MeanWind: got robot differential_drive, which wind cannot push"),
    (lambda: ls.uncertainty_of(cage(), [of.MeasurementNoise([0.1] * 3)]),
     "^MeasurementNoise: std: got 3 numbers, want 1 or 12"),
    (lambda: ls.uncertainty_of(cage(), "light"), "^disturbances: got 'light'"),
    (lambda: ls.uncertainty_of("cage", []), "^plant: got "),
    (lambda: of.Unknown("d0", -1.0), "^Unknown: std: got -1"),
    (lambda: of.Unknown("d0", 1.0, time_constant=-1.0), "^Unknown: time_constant: got -1"),
    (lambda: of.Unknown("d0", 1.0, order=3), "^Unknown: order: got 3"),
    (lambda: of.Unknown("d0", 1.0, order=2), "^Unknown: order: got 2 with a time constant of inf s, want 1"),
    (lambda: of.Unknown("d0", 1.0, time_constant=1.0, drift=0.1), "^Unknown: drift: got 0.1 with a time constant"),
    (lambda: of.Unknown({}, 1.0), "^Unknown: of: got no name"),
    (lambda: of.Uncertainty(lag=-0.1), "^Uncertainty: lag: got -0.1"),
    (lambda: of.Uncertainty(loss=1.5), "^Uncertainty: loss: got 1.5"),
    (lambda: of.Uncertainty(delay=1.5), "^Uncertainty: delay: got 1.5"),
    (lambda: of.Uncertainty(unknowns=["wind_x"]), "^Uncertainty: unknowns: got"),
    (lambda: of.Uncertainty(unknowns=of.Unknown("d0", 1.0)), "^Uncertainty: unknowns: got"),
    # Stress.
    (lambda: ls.stress.ReliabilityProblem("differential_drive", policy="track", design_disturbances="gale").score,
     "^disturbances: got 'gale', want .*light"),
    (lambda: smallest_failure(lambda z: z[:, 0], 0), "size: got 0"),
    (lambda: smallest_failure(lambda z: z[:, 0], 2, pairs=1), "pairs: got 1"),
    (lambda: smallest_failure(lambda z: z[:, 0] - 9, 2, failures=np.ones((1, 2))),
     "failures: got vectors that do not fail"),
    (lambda: smallest_failure(lambda z: z[:, 0], 2, failures=np.ones((0, 2))), "failures: got none, want"),
    (lambda: smallest_failure(lambda z: z[:, 0], 2, failures=np.ones((1, 3))), r"failures: got shape \(1, 3\)"),
    (lambda: failure_probability(lambda z: z[:, 0], 0), "size: got 0"),
    (lambda: failure_probability(lambda z: z[:, 0], 2, particles=3), "particles: got 3"),
    (lambda: failure_probability(lambda z: z[:, 0], 2, keep=0.9), "keep: got 0.9"),
    (lambda: failure_probability(lambda z: z[:, 0], 2, keep=-0.1), "keep: got -0.1"),
    (lambda: failure_probability(lambda z: z[:, 0], 2, particles=20, keep=0.09), "keep: got 0.09, want .* >= 0.1"),
    (lambda: failure_probability(lambda z: z[:, 0], 2, repetitions=1), "repetitions: got 1"),
    (lambda: failure_probability(lambda z: np.full(len(z), NAN), 2), "score: got NaN returned"),
    (lambda: failure_probability(lambda z: np.minimum(z[:, 0], 1.0) - 2.0, 2),
     "score: got scores that tie at -1 after .* levels, and none of 32,000 above it"),
    (lambda: PrescribedDraws(np.zeros(3)).poisson(2.0), "draws by poisson"),
    (lambda: PrescribedDraws(np.zeros(3)).standard_normal(4), "numbers: got 3"),
    (lambda: statistics.rate(3, 2), "successes: got 3"),
    (lambda: statistics.rate(0, 0), "trials: got 0"),
    (lambda: statistics.rate(1, 2, confidence=1.0), "confidence: got 1.0"),
    (lambda: statistics.compare([True], [True, False]), "second: got 2 trials"),
    (lambda: statistics.compare([], []), "first: got"),
    (lambda: statistics.paired_difference(0, 0, 0), "trials: got 0"),
    (lambda: statistics.paired_difference(3, 2, 4), "trials: got 4, want at least the 5"),
    (lambda: statistics.paired_difference(-1, 2, 4), "only_first: got -1"),
    (lambda: statistics.independent_difference((3, 2), (1, 2)), "successes: got 3"),
    (lambda: statistics.mean([1.0]), "sample: got 1 numbers"),
    # Tables of numbers.
    (lambda: ls.types.DataTable({}), "got none, want at least one column"),
    (lambda: ls.types.DataTable({"a": [1], "b": [1, 2]}), "got 1 in 'a', 2 in 'b', want at least one column"),
    (lambda: ls.types.DataTable({"a": [NAN]}), "columns: 'a': got nan"),
    (lambda: ls.types.DataTable({"a": ["two\nlines"]}), "columns: 'a': got"),
    (lambda: ls.types.DataTable({"a": [1.0]}, {"b": ".3f"}), "formats: got 'b', want one of: a"),
    (lambda: ls.types.DataTable({"a": [1.0]}, {"a": ".999f"}), r"formats: 'a': got '\.999f'"),
    (lambda: ls.types.DataTable({"a": [1.0]}).select(["b"]), "headings: got 'b', want one of: a"),
    (lambda: ls.types.DataTable({"a": [1.0]}).save("a.xlsx"), r"want a name that ends in \.csv, \.tex, \.md"),
]  # fmt: skip


def test_a_message_is_one_line_of_a_bounded_length() -> None:
    """Whatever is in it, such as the message of a user's function."""
    said = str(lqrsim.InputError("first\nsecond\r\n" + 5000 * "x" + "\u2028end"))
    assert said.startswith("first second xxx")
    assert said.endswith("xxx end")
    assert len(said.splitlines()) == 1
    assert len(said) <= LONGEST


@pytest.mark.parametrize(
    ("call", "message"),
    [(partial(call, **bad), message) for call, rows in OPTIONS for bad, message in rows] + CALLS,
)
def test_bad_input_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(lqrsim.InputError, match=message):
        call()
