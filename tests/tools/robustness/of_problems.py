"""Arguments that public callables accept: what states problems, solves them, and comes of it. See `subjects.py`."""

import dataclasses
from typing import Any

import numpy as np

import lqrsim as ls
from robustness.place import Place


def rate(x: Any, u: Any, p: Any) -> list[Any]:
    return [x[1], u[0] / p.mass]


def jacobian(x: Any, u: Any, p: Any, fx: Any, fu: Any) -> None:
    fx[0, 1], fu[1, 0] = 1.0, 1.0 / p.mass


def bowl(x: Any, u: Any, p: Any) -> Any:
    return x[0] ** 2 + 0.1 * u[0] ** 2


def slope(x: Any, u: Any, p: Any, gradient: Any, hessian: Any) -> None:
    gradient[0], gradient[2], hessian[0, 0], hessian[2, 2] = 2 * x[0], 0.2 * u[0], 2.0, 0.2


def shaken(x: Any, u: Any, p: Any) -> list[list[Any]]:
    return [[0.0], [p.share * u[0]]]


def reach(x: Any, p: Any) -> list[list[Any]]:
    return [[x[0], 0.0, 1.0]]


def reach_slopes(x: Any, p: Any, slopes: Any) -> None:
    slopes[0, 0, 0] = 1.0


def check_functions(
    f: Any, jacobian: Any, function: Any, derivatives: Any, depends_on: Any, formula: Any, parameters: Any
) -> list[ls.types.DerivativeCheck]:
    """A problem of a user's own functions, each of which is called."""
    dynamics = ls.Dynamics(
        f,
        states={"x": "m", "v": "m/s"},
        controls={"force": "N"},
        parameters=parameters,
        jacobian=jacobian,
        level="plain",
    )
    own = ls.FunctionCost(function, derivatives=derivatives, depends_on=depends_on, parameters=parameters)
    end = ls.QuadraticCost([1.0, 1.0], about=[0.0, 0.0])
    cost = own + ls.SymbolicCost(formula, parameters=parameters)
    problem = ls.Problem(dynamics=dynamics, dt=0.1, steps=2, initial=end, stage_cost=cost, final_cost=end)
    return ls.check_derivatives(problem, samples=1)


def smooth_stated(**stated: Any) -> ls.Solution:
    """A problem, and two iterations."""
    return ls.smooth(ls.Problem(**stated), starts=1, max_iterations=2)


def ilqr_stated(**stated: Any) -> ls.Solution:
    """A problem, and two iterations of the other solver."""
    return ls.ilqr(ls.Problem(**stated), max_iterations=2)


CART = """<mujoco><worldbody><body name="cart"><joint name="slider" type="slide" axis="1 0 0" range="-1 1"
  limited="true"/><geom size="0.1"/></body></worldbody><actuator><motor name="push" joint="slider"/></actuator>
  <keyframe><key name="left" qpos="-0.5"/></keyframe></mujoco>"""
HEAVY = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
POLE = f"""<robot name="pole"><link name="cart">{HEAVY}</link><link name="pole">{HEAVY}</link>
  <joint name="pole" type="continuous"><parent link="cart"/><child link="pole"/></joint></robot>"""
FOLDED = """
<mujoco>
  <worldbody><body name="a"><joint name="a"/><geom size="0.1"/>
    <body name="b" pos="0.5 0 0"><joint name="b"/><geom size="0.1"/>
      <body name="c" pos="0.5 0 0"><joint name="c"/><geom size="0.1"/></body></body></body></worldbody>
  <actuator><motor joint="b"/></actuator>
</mujoco>
"""


def light(x: Any, u: Any, p: Any) -> list[Any]:
    return [(x.x, p.least + x.x**2)]


def problems(place: Place) -> dict[str, tuple[Any, ...]]:
    cart = ls.Dynamics(
        rate, states={"x": "m", "v": "m/s"}, controls={"force": "N"}, parameters={"mass": 1.0}, level="plain"
    )
    world, box = place.scenario.scene.world, ls.Obstacle("box", "box", np.zeros(3), np.eye(3), np.ones(3))
    around = ls.ObstacleCost(world, radius=0.2)
    term = ls.QuadraticCost([1.0, 1.0], about=[0.0, 0.0]).bind(cart)
    limits = ls.types.Coordinates(
        names=("x", "y", "angle"),
        units=("m", "m", "rad"),
        position=(0, 1),
        angles=(2,),
        low=(-1.0,) * 3,
        high=(1.0,) * 3,
    )
    cost = ls.QuadraticCost([1.0, 1.0, 1.0], about=[0.0, 0.0, 0.0])
    balls = ls.CollisionSpheres(reach, [0.1], level="plain")
    places = balls.bind(cart)
    short = dataclasses.replace(place.problem, steps=3)
    at, there = {"state": [0.1, 0.2], "control": [0.3]}, {"vector": [0.1, 0.2, 9.0], "near": [0.0, 0.0, 0.0]}
    source = "def value(x, u, t, row, data):\n    return x[0]\n\n\ndef slope(x, u, t, row, data, gradient):\n    pass\n"
    file = place.folder / "cart.xml"
    file.write_text(CART, encoding="utf-8")
    slider = ls.MjcfRobot(file)
    rated = slider.problem(
        slider.at(), slider.at(slider=0.3), steps=4, control_rate=ls.ControlRate(weight=1e-3, previous=[0.0])
    )
    links = place.folder / "folded.xml"
    links.write_text(FOLDED, encoding="utf-8")
    folded = ls.MjcfRobot(links)
    urdf = place.folder / "pole.urdf"
    urdf.write_text(POLE, encoding="utf-8")
    noise = ls.Noise(shaken, size=1, parameters={"share": 0.1}, level="plain")
    known: dict[str, ls.Robot] = {
        "Robot": ls.Quadrotor(), "Quadrotor": ls.Quadrotor(), "DifferentialDrive": ls.DifferentialDrive(),
        "MjcfRobot": slider,
    }  # fmt: skip
    rests = {kind: np.zeros(len(robot.dynamics.state_coordinates)) for kind, robot in known.items()}
    robots = [(kind, robot, rests[kind], robot.configuration(rests[kind])) for kind, robot in known.items()]
    seen = ls.belief.NoisySensors(light, parameters={"least": 0.1})
    of_belief = {"dynamics": place.problem.dynamics, "dt": 0.1, "noise": ls.Noise(0.1 * np.eye(3)), "sensors": seen}
    belief = ls.belief.Belief(**of_belief, uncertain=("x",))  # few states: less to compile
    known_at = {"state": np.arange(1.0, 5.0), "control": [0.1, 0.2]}
    planned = ls.Problem(
        dynamics=belief, dt=0.1, steps=2, initial=ls.FixedState(belief.state(np.zeros(3), np.ones(3))),
        stage_cost=ls.ControlCost([1.0, 1.0]), final_cost=ls.QuadraticCost({"m": 1.0}, about={}),
    )  # fmt: skip
    stated = {
        name: getattr(place.problem, name)
        for name in ("dynamics", "dt", "steps", "initial", "stage_cost", "final_cost")
    }
    return {
        "Dynamics": ({
            "f": rate, "states": {"x": "rad", "v": "rad/s"}, "controls": {"force": "N"}, "parameters": {"mass": 1.0},
            "position": (), "angles": ("x",), "rotation_vectors": (), "control_limits": (-1.0, 1.0),
            "jacobian": jacobian, "level": "plain",
        },),
        "MjcfRobot": (
            {"file": file, "body": "cart", "position": (), "radius": 0.2, "outline": False, "floors": True}, 0.2,
        ),
        "scenarios.mjcf": ({
            "path": str(file), "start": "left", "goal": {"slider": 0.5}, "weights": {"m": 10.0}, "effort": 1.0,
            "dt": 0.02, "steps": 5, "body": "cart", "floors": True, "obstacles": True,
            "parameters": {"mass": 2.0},
        }, 0.2),
        "MjcfRobot.with_parameters": ({"self": slider, "mass": 2.0, "slider_damping": 0.1},),
        "MjcfRobot.at_rest": ({"self": slider, "state": slider.at(slider=0.1)},),
        "MjcfRobot.hold": ({"self": slider, "state": slider.at(slider=0.1)},),
        "MjcfRobot.problem": ({
            "self": slider, "start": slider.at(), "goal": slider.at(slider=0.2), "steps": 5, "dt": 0.02,
            "weights": 10.0, "effort": [1.0], "damping": 1e-3,
        }, 0.3),
        "MjcfRobot.self_clearance": ({"self": folded, "margin": 0.01},),
        "MjcfRobot.problem of links": ({
            "call": folded.problem, "start": folded.at(), "goal": folded.at(b=0.2), "steps": 5, "self_clearance": 0.01,
        }, 0.3),
        **{f"{kind}.among": ({"self": robot, "world": place.plant.world},) for kind, robot in known.items()},
        "MjcfRobot.at": ({"self": slider, "keyframe": "left", "slider": 0.2},),
        "NoisySensors": ({"function": light, "parameters": {"least": 0.1}, "delay": 1},),
        "Belief": (of_belief | {"averaged": True, "uncertain": ("x", "y")},),
        "Belief.state": ({"self": belief, "mean": np.zeros(3), "covariance": np.eye(3)},),
        "Belief.covariance": ({"self": belief, "states": np.ones((2, 4))},),
        "Belief.chance_constraint": (
            {"self": belief, "function": light, "chance": 0.1, "parameters": {"least": 0.1}, "name": "light"},
        ),
        "Belief.read": ({"self": belief, "states": np.ones((2, 3))},),
        "Belief.corrected": (
            {"self": belief, "states": np.ones((2, 4)), "controls": np.ones((2, 2)), "readings": np.ones((2, 1))},
        ),
        "Belief.rate": ({"self": belief, **known_at},),
        "Belief.rate_jacobian": ({"self": belief, **known_at},),
        "Belief.step": ({"self": belief, **known_at, "dt": 0.1},),
        "Belief.linearize": ({"self": belief, **known_at, "dt": 0.1},),
        "Belief.period_near": ({"self": belief, "dt": 0.11},),
        "Belief.with_parameters": ({"self": belief, "least": 0.2},),
        "Belief.with_substeps": ({"self": place.problem.dynamics, "count": 2},),  # a map has none
        "BeliefFeedback": ({"problem": planned, "solution": ls.smooth(planned)}, 0.5),
        "ReadingErrors": ({"belief": belief, "loss": 0.1, "strength": 1.0},),
        "ReadingErrors.scaled": ({"self": ls.belief.ReadingErrors(belief), "strength": 2.0},),
        "Dynamics.rate": ({"self": cart, **at},),
        "Dynamics.rate_jacobian": ({"self": cart, **at},),
        "Dynamics.step": ({"self": cart, **at, "dt": 0.1},),
        "Dynamics.linearize": ({"self": cart, **at, "dt": 0.1},),
        "Coordinates": ({field.name: getattr(limits, field.name) for field in dataclasses.fields(limits)},),
        "Dynamics.with_substeps": ({"self": place.problem.dynamics, "count": 2},),
        "Dynamics.with_parameters": ({"self": place.problem.dynamics, "axle_length": 0.3},),
        "Coordinates.in_world": ({"self": place.space, "places": np.zeros((4, 2)), "height": 0.1},),
        "Coordinates.of_world": ({"self": place.space, "points": np.zeros((4, 3))},),
        "Coordinates.nearest": ({"self": limits, **there},),
        "Coordinates.difference": ({"self": limits, **there},),
        "Coordinates.limited": ({"self": limits, "limits": (-1.0, (1.0, 2.0, 3.0))},),
        "Coordinates.limited by name": (
            {"call": limits.limited, "limits": {limits.names[0]: (-1.0, 1.0)}},
        ),
        "Coordinates.within": ({"self": limits, "other": limits},),
        "Coordinates.clip": ({"self": limits, "vector": [2.0, 0.0, 0.0]},),
        "QuadraticCost by name": ({
            "call": lambda weight, about: dataclasses.replace(
                place.problem, final_cost=ls.QuadraticCost(weight, about=about)
            ),
            "weight": {"m": 1.0}, "about": {place.space.names[0]: 0.5},
        },),
        "ControlCost by name": ({
            "call": lambda weight: dataclasses.replace(place.problem, stage_cost=ls.ControlCost(weight)),
            "weight": {"m/s": 1.0},
        },),
        "QuadraticCost": ({"weight": [1.0, 2.0], "about": [0.0, 0.0], "longer": False},),
        "ControlCost": ({"weight": [[1.0]], "about": [0.0], "longer": False},),
        "QuadraticCost of rows": ({
            "call": lambda **stated: dataclasses.replace(short, stage_cost=ls.QuadraticCost(**stated)).from_state(
                [0.0, 0.0, 0.0], after=1
            ),
            "weight": np.tile(np.eye(3), (4, 1, 1)), "about": np.zeros((4, 3)), "longer": False,
        },),
        "QuadraticCost of rows by name": ({
            "call": lambda weight, about: dataclasses.replace(
                short, stage_cost=ls.QuadraticCost(weight, about=about)
            ).later(place.problem.dt),
            "weight": {"m": [1.0, 2.0, 3.0]}, "about": {place.space.names[0]: [0.5, 0.6, 0.7, 0.8]},
        },),
        "ControlCost of rows": ({
            "call": lambda **stated: dataclasses.replace(short, stage_cost=ls.ControlCost(**stated)),
            "weight": np.tile(np.eye(2), (5, 1, 1)), "about": np.zeros((5, 2)), "longer": True,
        },),
        "ObstacleCost": ({"world": world, "radius": 0.2, "sharpness": 10.0, "weight": 1.0},),
        "ObstacleCost of balls": ({"call": ls.ObstacleCost, "world": world, "balls": balls, "weight": 1.0},),
        "ObstacleCost.weighing": ({"self": around, "weight": 2.0},),
        "CollisionSpheres": ({
            "places": reach, "radii": [0.1], "names": ("hand",), "sites": ("tip",), "jacobian": reach_slopes,
            "depends_on": ("x",), "level": "plain",
        },),
        "CollisionSpheres.centres": ({"self": balls, "dynamics": cart, "states": [[0.1, 0.2]]},),
        "SphereCenters": ({field.name: getattr(places, field.name) for field in dataclasses.fields(places)},),
        "Box": ({"length": 0.4, "width": 0.2},),
        "Box.corners": ({"self": ls.types.Box(0.4, 0.2), "center": (0.0, 1.0), "turn": 0.3},),
        "Capsule": ({"length": 0.4, "radius": 0.03, "tolerance": 0.002},),
        "Capsule.between": ({"self": ls.types.Capsule(0.4, 0.1, 0.02), "start": (0, 0, 0), "end": [1.0, 2.0, 3.0]},),
        "SymbolicCost": ({"function": bowl, "parameters": {"a": 1.0}, "convex": True},),
        "FunctionCost": ({
            "function": bowl, "derivatives": slope, "depends_on": ("x", "force"), "parameters": {"a": 1.0},
            "convex": True, "level": "plain",
        },),
        **{
            f"{kind}.{method}": ({"self": one, **given},)
            for kind, one in {
                "Cost": cost, "QuadraticCost": ls.QuadraticCost([1.0, 1.0], about=np.eye(5, 2)),
                "ControlCost": ls.ControlCost([1.0], about=np.ones((4, 1))),
                "ObstacleCost": around, "SymbolicCost": ls.SymbolicCost(bowl),
                "FunctionCost": ls.FunctionCost(bowl), "SiteCost": ls.SiteCost("tip", position=(0.0, 0.0, 0.0)),
            }.items()
            for method, given in (("__add__", {"other": cost}), ("ahead", {"steps": 2, "horizon": "moving"}))
        },
        **{
            f"{type(one).__name__}.scaled": ({"self": one, "factor": 2.0},)
            for one in (ls.QuadraticCost([1.0, 1.0], about=[0.0, 1.0]), ls.ControlCost([1.0]), around, term)
        },
        "source_of": ({"module": "lqrsim.problem.quadratic_cost", "CONTROL": True},),
        "CostTerm": ({field.name: getattr(term, field.name) for field in dataclasses.fields(term)},),
        "Clearance": ({"world": world, "radius": 0.2, "margin": 0.1},),
        "Clearance of balls": ({"call": ls.Clearance, "world": world, "balls": balls, "margin": 0.1},),
        "ConstraintTerm": ({
            "source": source, "data": [1.0], "rows": 1, "describe": str, "uses_control": False, "equality": True,
            "final_only": False, "shared": 0, "functions": (), "names": ("row",),
        },),
        "SymbolicConstraint": ({"function": bowl, "parameters": {"a": 1.0}, "equality": True, "at": "all"},),
        "Clearance.ahead": ({"self": ls.Clearance(world, radius=0.2, margin=np.linspace(0, 0.1, 5)), "steps": 2},),
        "SymbolicConstraint.ahead": ({"self": ls.SymbolicConstraint(bowl, parameters={"a": 1.0}), "steps": 2},),
        "Constraint.ahead": ({"self": ls.GoalState(x=0.0, v=1.0), "steps": 2},),
        "GoalState.ahead": ({"self": ls.GoalState(x=0.0, v=1.0), "steps": 2},),
        "SiteConstraint.ahead": ({"self": ls.SiteConstraint("tip", position=(0.0, 0.0, 0.0)), "steps": 2},),
        "StateBounds.ahead": ({"self": ls.StateBounds(x=(-1.0, 1.0)), "steps": 2},),
        "GoalState": ({"call": lambda goal, v: ls.GoalState(goal, v=v), "goal": {"x": 0.0}, "v": 1.0},),
        "GoalState of a state": ({"call": lambda goal: ls.GoalState(goal), "goal": [0.0, 1.0]},),
        "StateBounds": ({
            "call": lambda bounds, v: ls.StateBounds(bounds, v=v), "bounds": {"x": (-1.0, 1.0)}, "v": (-np.inf, 1.0),
        },),
        "SiteCost": ({
            "site": "tool", "position": np.zeros(3), "orientation": [1.0, 0, 0, 0], "weight": 1.0, "turn_weight": 2.0,
        },),
        "SiteConstraint": ({
            "site": "tool", "position": np.zeros(3), "orientation": [1.0, 0, 0, 0], "at": "final",
        },),
        "FixedState": ({"call": lambda state, v: ls.FixedState(state, v=v), "state": {"x": 0.0}, "v": 1.0},),
        "FixedState of a state": ({"call": lambda state: ls.FixedState(state), "state": [0.0, 1.0]},),
        "Problem": (stated | {
            "control_limits": (-0.4, 0.4), "constraints": [], "noise": ls.Noise(np.eye(3)), "risk": 0.1,
            "accuracy": 1e-6, "between_knots": True,
        },),
        "ControlRate": ({"weight": 1.0, "limits": (-2.0, 3.0), "previous": [0.0, 0.0]},),
        "ControlRate of a Problem": ({
            "call": lambda **stated: dataclasses.replace(place.problem, control_rate=ls.ControlRate(**stated)),
            "weight": {"m/s": 1.0}, "limits": {"left": 2.0, "right": (-1.0, 2.0)}, "previous": {"left": 0.1},
        },),
        "rate_feedback": ({"problem": rated, "solution": ls.smooth(rated)},),
        "Problem.driven_by": ({"self": place.problem, "noise": ls.Noise(np.eye(3)), "risk": 0.1},),
        "Noise": ({
            "function": shaken, "size": 1, "parameters": {"share": 0.1}, "depends_on": ("force",), "level": "plain",
        },),
        "Noise of a matrix": ({"call": ls.Noise, "function": [[0.1], [0.2]]},),
        "Noise.scaled": ({"self": noise, "strength": 2.0},),
        "Noise.with_parameters": ({"self": noise, "share": 0.2},),
        "Noise.matrices": ({"self": noise, "dynamics": cart, "states": [[0.1, 0.2]], "controls": [[0.3]]},),
        "smooth of a Problem": (stated | {"call": smooth_stated, "control_limits": (-0.4, 0.4)},),
        "ilqr of a Problem": (stated | {"call": ilqr_stated, "control_limits": (-0.4, 0.4)},),
        "check_derivatives of functions": ({
            "call": check_functions, "f": rate, "jacobian": jacobian, "function": bowl, "derivatives": slope,
            "depends_on": ("x", "force"), "formula": bowl, "parameters": {"mass": 1.0},
        },),
        "Problem.with_costs": ({
            "self": place.problem, "stage_cost": place.problem.stage_cost, "final_cost": place.problem.final_cost,
        },),
        "Problem.with_constraints": ({"self": place.problem, "constraints": [ls.StateBounds({"m": (-9.0, 9.0)})]},),
        "Problem.terms": ({"self": place.problem, "which": "initial"},),
        "Obstacle": ({
            "name": "box", "kind": "box", "position": np.zeros(3), "rotation": np.eye(3), "size": np.ones(3)
        },),
        "World": ({"obstacles": [box]},),
        "Obstacle.of_corners": (
            {"call": ls.Obstacle.of_corners, "name": "rock", "corners": np.eye(3), "velocity": np.ones(3)},
        ),
        "World.seen_by": ({"self": world, "plane": "xz", "offset": 0.5},),
        "World.moved": ({"self": world, "seconds": 0.5},),
        "World.displacements": ({"self": world, "times": [0.0, 0.5]},),
        "Problem.site_errors": ({"self": place.problem, "states": place.rollout.states[:, -1]},),
        "Problem.violations": ({"self": place.problem, "rollout": place.rollout},),
        "World.tables": ({"self": world, "times": [0.0, 0.5]},),
        "World.distances": ({"self": world, "point": [0.0, 1.0, 2.0]},),
        "World.distance": ({"self": world, "points": [[0.0, 1.0, 2.0]]},),
        "World.nearest": ({"self": world, "points": [[0.0, 1.0, 2.0]]},),
        "load_scene": ({"name_or_path": "arena"}, 0.3),
        "load_scene of a URDF": ({
            "call": ls.load_scene, "name_or_path": urdf, "base": "free", "servos": {"pole": (20.0, 1.0)},
            "efforts": {"pole": 5.0}, "armature": {"pole": 0.01},
        }, 0.3),
        "Scene": ({
            field.name: getattr(place.scenario.scene, field.name) for field in dataclasses.fields(place.scenario.scene)
        },),
        "Scenario": ({field.name: getattr(place.scenario, field.name) for field in dataclasses.fields(ls.Scenario)},),
        "scenarios.get": ({"name": "differential_drive"}, 0.3),
        "scenarios.quadrotor": ({"query": 1, "seed": 2}, 0.3),
        "scenarios.quadrotor_queries": ({"count": 2, "seed": 0},),
        "scenarios.differential_drive": ({}, 0.1),
        "scenarios.names": ({}, 0.1),
        "robots.names": ({}, 0.1),
        "robots.get": ({"name": "quadrotor"},),
        "Scenario.near_enough": ({"self": place.scenario, "goal_radius": 0.1, "goal_tolerance": None},),
        "Scenario.with_duration_of": ({"self": place.scenario, "plan": place.solution},),
        "Scenario.target_radius": ({"self": place.scenario, "goal_radius": 0.1, "goal_tolerance": None},),
        "rotations.quaternion": ({"rotation_vector": [0.1, 0.2, 0.3]},),
        "rotations.rotation_vector": ({"quaternion": [1.0, 0.1, 0.2, 0.3]},),
        "rotations.rotate": ({"r": [0.1, 0.2, 0.3], "v": [1.0, 0.0, 0.0]},),
        "rotations.vector_rate": ({"r": [0.1, 0.2, 0.3], "w": [1.0, 0.0, 0.0]},),
        "DifferentialDrive": (dataclasses.asdict(ls.DifferentialDrive()),),
        "Quadrotor": (dataclasses.asdict(ls.Quadrotor()),),
        **{
            f"{kind}.state": ({"self": robot, "qpos": qpos, "qvel": qvel, "near": at_rest},)
            for kind, robot, at_rest, (qpos, qvel) in robots
        },
        **{f"{kind}.configuration": ({"self": robot, "state": at_rest},) for kind, robot, at_rest, _ in robots},
        **{
            f"{kind}.with_closed_loops": ({"self": robot, "states": [at_rest]},)
            for kind, robot, at_rest, _ in [*robots, ("Robot", *robots[0][1:])]
        },
        "check_derivatives": ({"subject": cart, "samples": 2, "spread": 0.3, "tolerance": 1e-5, "seed": 0}, 0.5),
    }  # fmt: skip


def solving(place: Place) -> dict[str, tuple[Any, ...]]:
    eye, n = np.eye(2), 3
    stages = ls.lq.Stage(A=np.tile(eye, (4, 1, 1)), B=np.ones((2, 1)), R=[[1.0]], Q=eye)
    stage = ls.lq.Stage(A=-eye, B=np.ones((2, 1)), R=[[1.0]], Q=eye)
    end = ls.types.Quadratic(eye, np.ones(2), 0.0)
    tests = {"stop": "cost", "tolerance": 1e-3, "max_iterations": 2}
    both = tests | {
        "form": "dual", "first_pass": "forward", "safeguard": False, "gap_tolerance": 1e-3, "starts": 1,
        "constraint_tolerance": 1e-3, "penalty": None, "threads": 1, "noise": ls.Noise(0.01 * np.eye(3)), "risk": 0.01,
    }  # fmt: skip
    noisy = place.problem.driven_by(both["noise"], 0.01)
    prior = ls.InitialPrior(np.ones(n), about=np.zeros(n))
    made: dict[str, tuple[Any, ...]] = {
        "smooth": ({"problem": place.problem, **both, "callback": print_nothing}, 2.0),
        "smooth_many": ({"problems": [place.problem, place.second], **both, "progress": print_nothing}, 2.0),
        "ilqr": ({"problem": place.problem, **tests, "callback": print_nothing, "noise": None, "risk": None}, 2.0),
        "ilqr_many": ({"problems": [place.problem], "threads": 1, **tests, "progress": print_nothing}, 2.0),
        "gradients": (
            {
                "make": lambda p: place.problem.from_state([p[0], -2.5, np.pi]),
                "at": [0.0],
                "plan": True,
                "scale": [1.0],
                "solution": ls.smooth(place.problem.from_state([0.0, -2.5, np.pi]), starts=1),
            },
        ),
        "sample_costs": ({"problem": noisy, "solution": place.solution, "trials": 2, "seed": 0},),
        "largest_risk": ({"problem": noisy, "solution": place.solution}, 0.2),
        "smooth_lq": ({"stage": stages, "initial": end, "final": end, "form": "dual", "dt": 0.1},),
        "smooth_lq_continuous": (
            {"stage": stage, "horizon": 0.1, "initial": end, "final": end, "rtol": 1e-4, "atol": 1e-4},
        ),
        "smooth_continuous": (
            {
                "problem": place.problem,
                "tolerance": 1.0,
                "gap_tolerance": 1.0,
                "max_iterations": 1,
                "start": [0.2, 0.2],
                "rtol": 1e-3,
                "atol": 1e-3,
                "callback": print_nothing,
            },
            0.1,
        ),
        "InitialPrior": (
            {"weight": np.ones(n), "about": np.zeros(n), "iterations": 1, "obstacles": (0.5,), "controls": [0.1, 0.1]},
        ),
        "InitialPrior.at": ({"self": ls.InitialPrior(np.ones(n), about=np.zeros((5, n))), "step": 1.5},),
        "Stage": ({field.name: getattr(stages, field.name) for field in dataclasses.fields(stages)},),
    }
    for name in ("smooth", "ilqr"):
        made[name][0]["start"] = place.solution if name == "smooth" else [0.25, 0.25]
        made[f"{name}_many"][0]["start"] = prior if name == "smooth" else place.solution.trajectory
    return made


def print_nothing(*_: object) -> None:
    """A callback."""


def results(place: Place) -> dict[str, tuple[Any, ...]]:
    solution, rollout = place.solution, place.rollout
    policy, plan, total = solution.policy, solution.trajectory, solution.total_cost
    go, come = solution.cost_to_go, solution.cost_to_come
    eye = np.eye(2)
    flowing = ls.lq.smooth_lq_continuous(
        ls.lq.Stage(A=-eye, B=np.ones((2, 1)), R=[[1.0]], Q=eye), horizon=0.1,
        initial=ls.types.Quadratic(eye, np.ones(2), 0.0), final=ls.types.Quadratic(eye, np.ones(2), 0.0),
        rtol=1e-4, atol=1e-4,
    )  # fmt: skip
    candidate = ls.types.Candidate("straight", 1.0, 3, ls.Status.CONVERGED, plan)
    checks = {
        "DerivativeCheck": ls.check_derivatives(place.problem.dynamics, samples=1)[0],
        "PlantCheck": ls.check_plant(ls.DifferentialDrive(), ls.load_scene("arena"), samples=1),
    }
    built: dict[str, Any] = {
        "AffinePolicy": policy, "Trajectory": plan, "Quadratic": go, "Moments": come, "TotalCost": total,
        "Candidate": candidate, "Iteration": solution.iterations[-1], "Rollout": rollout,
        "Gradients": ls.types.Gradients(np.ones(1), np.zeros(1), (), np.zeros((5, 3, 1)), np.zeros((4, 2, 1))),
        "Multipliers": ls.types.Multipliers(np.zeros((5, 2)), 1.0), "ContinuousSolution": flowing,
        "Certificate": solution.certificate, "BetweenKnots": place.solution.between_knots(),
        "ContactCertificate": ls.types.ContactCertificate(
            pressed=1, across=-0.1, sampled=-0.2, radius=1e-3, samples=50
        ),
        "Solution": dataclasses.replace(solution, candidates=(candidate,)),
        "Outcomes": ls.stress.outcomes(rollout), **checks,
    }  # fmt: skip
    at = {"x": np.zeros(2), "t": 0.05}
    return {
        **{
            name: ({field.name: getattr(one, field.name) for field in dataclasses.fields(one) if field.init},)
            for name, one in built.items()
        },
        "Rollout.places": ({"self": rollout, "trial": 0},),
        "Rollout.in_world": ({"self": rollout, "places": np.zeros((4, 2)), "height": 0.1},),
        "Rollout.of_world": ({"self": rollout, "points": np.zeros((4, 3))},),
        "AffinePolicy.control": ({"self": policy, "state": np.zeros(3), "step": 0},),
        "AffinePolicy.__call__": ({"self": policy, "state": np.zeros(3), "t": 0.3, "interpolate": True},),
        "Quadratic.__add__": ({"self": go, "other": go},),
        "Quadratic.__call__": ({"self": go, "states": plan.states},),
        "Iteration.row": ({"self": solution.iterations[-1], "number": 3},),
        "Solution.shifted": ({"self": solution, "steps": 1},),
        **{f"ContinuousSolution.{name}": ({"self": flowing, **at},) for name in ("policy", "inverse_policy")},
        **{
            f"ContinuousSolution.{name}": ({"self": flowing, "t": [0.0, 0.1]},)
            for name in ("cost_to_go", "cost_to_come", "total_cost", "x_hat", "u_hat")
        },
        "save": ({"result": solution, "path": place.folder / "saved.npz"},),
        "load": ({"path": ls.save(solution, place.folder / "solution.npz")},),
    }  # fmt: skip
