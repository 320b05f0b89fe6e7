"""Every public callable of lqrsim with arguments that it accepts, small and cheap, for `api.py` to spoil.

`public()` finds them by introspection: what `lqrsim.__all__` lists, the functions of its modules, the public methods of
its classes that take arguments. `subjects()` has arguments for each; a test fails where one has none.
"""

import dataclasses
import enum
import functools
import inspect
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim.stress.shards import Damaged

# Called by lqrsim itself, with what it has checked: what one overrides to add a cost, a disturbance or a controller.
HOOKS = {"bind", "start", "check", "describe", "blow", "fitting", "actuation", "multiply", "parts", "draw", "limits"}
HOOKS |= {"displace"}
# Text that compiled cores contain: numbers in, numbers out.
KERNELS = {f"{ratio}{order}" for ratio in ls.rotations.RATIOS for order in ("", "_d1", "_d2")}

RAISES = {"Results.read": (Damaged,)}

TINY = """
import dataclasses
import lqrsim as ls

def tiny():
    scenario = ls.scenarios.differential_drive()
    drive = scenario.problem
    end = ls.QuadraticCost(drive.final_cost.weight, about=(0.0, -2.4, 3.1))
    return dataclasses.replace(scenario, problem=dataclasses.replace(drive, steps=4, final_cost=end), paper_start=None)
"""


@dataclass(frozen=True)
class Subject:
    """A callable and arguments that it accepts.

    Attributes:
      weight: how often it is called beside the others, 1 being often: what takes longer is called less.
      raises: what it may raise besides InputError, as its docstring says.
    """

    call: Callable[..., Any]
    arguments: Mapping[str, Any]
    weight: float = 1.0
    raises: tuple[type[Exception], ...] = ()


def public() -> Iterator[tuple[str, Any]]:
    """Each public callable by its name: `smooth`, `Problem`, `AffinePolicy.control`, `rotations.rotate`."""
    for name in ls.__all__:
        item = getattr(ls, name)
        if isinstance(item, ModuleType):
            for key, one in vars(item).items():
                if inspect.isfunction(one) and one.__module__ == item.__name__ and key[0] != "_" and key not in KERNELS:
                    yield f"{name}.{key}", one
        elif not inspect.isclass(item):
            yield name, item
        elif not issubclass(item, Exception | enum.Enum):
            if not inspect.isabstract(item) and inspect.signature(item).parameters:
                yield name, item
            for key, method in inspect.getmembers(item, callable):
                if method_of_users(item, key) and len(inspect.signature(method).parameters) > _own(item, key):
                    yield f"{name}.{key}", method


def method_of_users(item: type, key: str) -> bool:
    """Whether it is a method that a user calls."""
    if key[0] == "_" and key not in ("__call__", "__add__"):
        return False
    home = next(kind for kind in item.__mro__ if key in vars(kind))
    return home.__module__.startswith("lqrsim.") and key not in HOOKS and not inspect.isclass(getattr(item, key))


def _own(item: type, key: str) -> int:
    """How many parameters of a method are not the caller's: self, unless it is a class method."""
    return 0 if isinstance(inspect.getattr_static(item, key), classmethod | staticmethod) else 1


def subjects(folder: Path) -> dict[str, Subject]:
    """Arguments for every public callable; some of them are solved for and run, and files of them written."""
    logging.getLogger("lqrsim").setLevel(logging.ERROR)
    place = _Place(folder)
    found: dict[str, Subject] = {}
    for make in (_problems, _solving, _results, _running, _campaigns, _pictures):
        for name, (arguments, *weight) in make(place).items():
            owner, _, method = name.partition(".")
            if "call" in arguments:
                call = arguments.pop("call")
            elif method and not isinstance(getattr(ls, owner), ModuleType):
                call = getattr(arguments.pop("self", getattr(ls, owner)), method)
            else:
                call = getattr(getattr(ls, owner), method) if method else getattr(ls, owner)
            found[name] = Subject(call, arguments, *weight, raises=RAISES.get(name, ()))
    return found


class _Place:
    """What the subjects are made of."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "tiny.py").write_text(TINY, encoding="utf-8")
        namespace: dict[str, Any] = {}
        exec(TINY, namespace)
        self.scenario: ls.Scenario = namespace["tiny"]()
        self.problem = self.scenario.problem
        self.plant = self.scenario.plant()
        self.solution = ls.smooth(self.problem, starts=1)
        self.rollout = ls.simulate(self.plant, self.solution, disturbances=[ls.ControlNoise(0.01)])
        self.space = self.problem.dynamics.state_coordinates
        self.controls = self.problem.dynamics.control_coordinates
        # Of one kind with the packaged scenario's, so that nothing else is compiled.
        self.second = dataclasses.replace(
            self.problem, initial=ls.FixedState((0.0, -2.5, np.pi)), control_limits=(-0.4, 0.4)
        )


def rate(x: Any, u: Any, p: Any) -> list[Any]:
    return [x[1], u[0] / p.mass]


def jacobian(x: Any, u: Any, p: Any, fx: Any, fu: Any) -> None:
    fx[0, 1], fu[1, 0] = 1.0, 1.0 / p.mass


def bowl(x: Any, u: Any, p: Any) -> Any:
    return x[0] ** 2 + 0.1 * u[0] ** 2


def slope(x: Any, u: Any, p: Any, gradient: Any, hessian: Any) -> None:
    gradient[0], gradient[2], hessian[0, 0], hessian[2, 2] = 2 * x[0], 0.2 * u[0], 2.0, 0.2


def _problems(place: _Place) -> dict[str, tuple[Any, ...]]:
    cart = ls.Dynamics(
        rate, states={"x": "m", "v": "m/s"}, controls={"force": "N"}, parameters={"mass": 1.0}, level="plain"
    )
    world, box = place.scenario.scene.world, ls.Obstacle("box", "box", np.zeros(3), np.eye(3), np.ones(3))
    term = ls.QuadraticCost([1.0, 1.0], about=[0.0, 0.0]).bind(cart)
    limits = ls.Coordinates(
        names=("x", "y", "angle"), units=("m", "m", "rad"), position=(0, 1), angles=(2,), low=(-1.0,) * 3, high=(1.0,) * 3
    )
    cost = ls.QuadraticCost([1.0, 1.0, 1.0], about=[0.0, 0.0, 0.0])
    at, there = {"state": [0.1, 0.2], "control": [0.3]}, {"vector": [0.1, 0.2, 9.0], "near": [0.0, 0.0, 0.0]}
    source = "def value(x, u, t, row, data):\n    return x[0]\n\n\ndef slope(x, u, t, row, data, gradient):\n    pass\n"
    stated = {
        name: getattr(place.problem, name) for name in ("dynamics", "dt", "steps", "initial", "stage_cost", "final_cost")
    }
    return {
        "Dynamics": ({
            "f": rate, "states": {"x": "m", "v": "m/s"}, "controls": {"force": "N"}, "parameters": {"mass": 1.0},
            "position": (), "angles": ("x",), "rotation_vectors": (), "control_limits": (-1.0, 1.0),
            "jacobian": jacobian, "level": "plain",
        },),
        "Dynamics.rate": ({"self": cart, **at},),
        "Dynamics.rate_jacobian": ({"self": cart, **at},),
        "Dynamics.step": ({"self": cart, **at, "dt": 0.1},),
        "Dynamics.linearize": ({"self": cart, **at, "dt": 0.1},),
        "Coordinates": ({field.name: getattr(limits, field.name) for field in dataclasses.fields(limits)},),
        "Coordinates.nearest": ({"self": limits, **there},),
        "Coordinates.difference": ({"self": limits, **there},),
        "Coordinates.limited": ({"self": limits, "low": -1.0, "high": (1.0, 2.0, 3.0)},),
        "Coordinates.within": ({"self": limits, "other": limits},),
        "Coordinates.clip": ({"self": limits, "vector": [2.0, 0.0, 0.0]},),
        "QuadraticCost": ({"weight": [1.0, 2.0], "about": [0.0, 0.0]},),
        "ControlCost": ({"weight": [[1.0]], "about": [0.0]},),
        "ObstacleCost": ({"world": world, "radius": 0.2, "sharpness": 10.0, "weight": 1.0},),
        "SymbolicCost": ({"function": bowl, "parameters": {"a": 1.0}, "convex": True},),
        "FunctionCost": ({
            "function": bowl, "derivatives": slope, "depends_on": ("x", "force"), "parameters": {"a": 1.0},
            "convex": True, "level": "plain",
        },),
        **{
            f"{kind}.__add__": ({"self": one, "other": cost},)
            for kind, one in {
                "Cost": cost, "QuadraticCost": cost, "ControlCost": ls.ControlCost([1.0], about=[0.0]),
                "ObstacleCost": ls.ObstacleCost(world, radius=0.2), "SymbolicCost": ls.SymbolicCost(bowl),
                "FunctionCost": ls.FunctionCost(bowl),
            }.items()
        },
        "Term": ({field.name: getattr(term, field.name) for field in dataclasses.fields(term)},),
        "Clearance": ({"world": world, "radius": 0.2, "margin": 0.1},),
        "Inequalities": ({"source": source, "data": [1.0], "rows": 1, "says": str, "uses_control": False},),
        "FixedState": ({"state": [0.0, 1.0]},),
        "Problem": (stated | {"control_limits": (-0.4, 0.4), "constraints": []},),
        "Problem.terms": ({"self": place.problem, "which": "initial"},),
        "Obstacle": ({
            "name": "box", "kind": "box", "position": np.zeros(3), "rotation": np.eye(3), "size": np.ones(3)
        },),
        "World": ({"obstacles": [box]},),
        "World.seen_by": ({"self": world, "dimension": 2},),
        "World.distances": ({"self": world, "point": [0.0, 1.0, 2.0]},),
        "World.distance": ({"self": world, "points": [[0.0, 1.0, 2.0]]},),
        "World.nearest": ({"self": world, "points": [[0.0, 1.0, 2.0]]},),
        "load_scene": ({"name_or_path": "arena"}, 0.3),
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
        "rotations.rotate": ({"r": [0.1, 0.2, 0.3], "v": [1.0, 0.0, 0.0]},),
        "rotations.vector_rate": ({"r": [0.1, 0.2, 0.3], "w": [1.0, 0.0, 0.0]},),
        "DifferentialDrive": (dataclasses.asdict(ls.DifferentialDrive()),),
        "Quadrotor": (dataclasses.asdict(ls.Quadrotor()),),
        **{
            f"{kind}.{method}": ({"self": robot, **arguments},)
            for kind, robot in {
                "Robot": ls.Quadrotor(), "Quadrotor": ls.Quadrotor(), "DifferentialDrive": ls.DifferentialDrive()
            }.items()
            for method, arguments in {
                "state": dict(zip(("qpos", "qvel"), robot.configuration(np.zeros(len(robot.dynamics.state_coordinates))),
                                  strict=True)) | {"near": np.zeros(len(robot.dynamics.state_coordinates))},
                "configuration": {"state": np.zeros(len(robot.dynamics.state_coordinates))},
            }.items()
        },
        "check_derivatives": ({"subject": cart, "samples": 2, "spread": 0.3, "tolerance": 1e-5, "seed": 0}, 0.5),
    }  # fmt: skip


def _solving(place: _Place) -> dict[str, tuple[Any, ...]]:
    eye, n = np.eye(2), 3
    stages = ls.Stage(A=np.tile(eye, (4, 1, 1)), B=np.ones((2, 1)), R=[[1.0]], Q=eye)
    stage = ls.Stage(A=-eye, B=np.ones((2, 1)), R=[[1.0]], Q=eye)
    end = ls.Quadratic(eye, np.ones(2), 0.0)
    tests = {"stop": "cost", "tolerance": 1e-3, "max_iterations": 2}
    both = tests | {
        "form": "dual", "first_pass": "forward", "safeguard": False, "gap_tolerance": 1e-3, "starts": 1,
        "constraint_tolerance": 1e-3, "threads": 1,
    }  # fmt: skip
    prior = ls.InitialPrior(np.ones(n), about=np.zeros(n))
    made: dict[str, tuple[Any, ...]] = {
        "smooth": ({"problem": place.problem, **both, "callback": print_nothing}, 2.0),
        "smooth_many": ({"problems": [place.problem, place.second], **both, "progress": print_nothing}, 2.0),
        "ilqr": ({"problem": place.problem, **tests, "callback": print_nothing}, 2.0),
        "ilqr_many": ({"problems": [place.problem], "threads": 1, **tests, "progress": print_nothing}, 2.0),
        "smooth_lq": ({"stage": stages, "initial": end, "final": end, "form": "dual", "dt": 0.1},),
        "smooth_lq_continuous": ({
            "stage": stage, "horizon": 0.1, "initial": end, "final": end, "rtol": 1e-4, "atol": 1e-4
        },),
        "smooth_continuous": ({
            "problem": place.problem, "tolerance": 1.0, "gap_tolerance": 1.0, "max_iterations": 1, "start": [0.2, 0.2],
            "rtol": 1e-3, "atol": 1e-3, "callback": print_nothing,
        }, 0.1),
        "InitialPrior": ({
            "weight": np.ones(n), "about": np.zeros(n), "iterations": 1, "obstacles": (0.5,), "controls": [0.1, 0.1]
        },),
        "InitialPrior.at": ({"self": ls.InitialPrior(np.ones(n), about=np.zeros((5, n))), "step": 1.5},),
        "Stage": ({field.name: getattr(stages, field.name) for field in dataclasses.fields(stages)},),
    }
    for name in ("smooth", "ilqr"):
        made[name][0]["start"] = place.solution if name == "smooth" else [0.25, 0.25]
        made[f"{name}_many"][0]["start"] = prior if name == "smooth" else place.solution.trajectory
    return made


def print_nothing(*_: object) -> None:
    """A callback."""


def _results(place: _Place) -> dict[str, tuple[Any, ...]]:
    solution, rollout = place.solution, place.rollout
    policy, plan, total = solution.policy, solution.trajectory, solution.total_cost
    go, come = solution.cost_to_go, solution.cost_to_come
    eye = np.eye(2)
    flowing = ls.smooth_lq_continuous(
        ls.Stage(A=-eye, B=np.ones((2, 1)), R=[[1.0]], Q=eye), horizon=0.1, initial=ls.Quadratic(eye, np.ones(2), 0.0),
        final=ls.Quadratic(eye, np.ones(2), 0.0), rtol=1e-4, atol=1e-4,
    )  # fmt: skip
    candidate = ls.Candidate("straight", 1.0, 3, ls.Status.CONVERGED, plan)
    checks = {
        "DerivativeCheck": ls.check_derivatives(place.problem.dynamics, samples=1)[0],
        "PlantCheck": ls.check_plant(ls.DifferentialDrive(), ls.load_scene("arena"), samples=1),
    }
    built: dict[str, Any] = {
        "AffinePolicy": policy, "Trajectory": plan, "Quadratic": go, "Moments": come, "TotalCost": total,
        "Candidate": candidate, "Iteration": solution.iterations[-1], "Rollout": rollout,
        "Multipliers": ls.Multipliers(np.zeros((5, 2)), 1.0), "ContinuousSolution": flowing,
        "Solution": dataclasses.replace(solution, candidates=(candidate,)),
        "Outcomes": ls.outcomes(rollout, place.plant), **checks,
    }  # fmt: skip
    at = {"x": np.zeros(2), "t": 0.05}
    return {
        **{
            name: ({field.name: getattr(one, field.name) for field in dataclasses.fields(one) if field.init},)
            for name, one in built.items()
        },
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
        "load_solution": ({"path": ls.save(solution, place.folder / "solution.npz")},),
        "load_rollout": ({"path": ls.save(rollout, place.folder / "rollout.npz")},),
    }  # fmt: skip


DISTURBANCES: dict[str, dict[str, Any]] = {
    "ActuatorLoss": {"actuator": "create_wheel_left", "at": 0.2}, "CommandDropouts": {"loss": 0.1},
    "ControlDelay": {"periods": 1}, "Dryden": {}, "Gusts": {}, "InitialStateError": {"std": (0.1, 0.1, 0.1)},
    "MeanWind": {"velocity": (1.0, 0.0, 0.0)}, "MeasurementDropouts": {"loss": 0.1},
    "MeasurementLatency": {"periods": 1}, "MotorLag": {"time_constant": 0.1},
    "Push": {"impulse": (1.0, 0.0, 0.0), "at": 0.1}, "Saturation": {"share": 0.5},
    **{
        kind: {"std": 0.1}
        for kind in (
            "AxleMismatch", "ControlNoise", "DisplacedObstacles", "ForceNoise", "FrictionMismatch", "InertiaMismatch",
            "MassMismatch", "MeasurementBias", "MeasurementNoise", "ThrustMismatch", "TorqueNoise",
            "WheelRadiusMismatch",
        )
    },
}  # fmt: skip


class Hooked(ls.Disturbance):
    """A user's own disturbance, whose effect is spoilt."""

    def __init__(self, effect: Any) -> None:
        self.effect = effect

    def scaled(self, strength: float) -> "Hooked":
        return self

    def start(self, plant: Any, plan: Any, generators: Any) -> Any:
        return self.effect


def simulate_effect(plant: ls.Plant, solution: ls.Solution, **effects: Any) -> ls.Rollout:
    """One trial of a user's own disturbance with that effect."""
    return ls.simulate(plant, solution, disturbances=[Hooked(ls.Effect(**effects))])


def simulate_kind(kind: Any, plant: ls.Plant, solution: ls.Solution, **settings: Any) -> ls.Rollout:
    """Two trials of a packaged disturbance with those settings."""
    return ls.simulate(plant, solution, disturbances=[kind(**settings)], trials=2)


class Steering(ls.Controller):
    """A user's own controller, whose answers are spoilt."""

    def __init__(self, control: Any, digest: Any, spaces: Any) -> None:
        self._parts = control, digest, spaces

    def start(self, trials: int) -> Any:
        return self._parts[0]

    @property
    def digest(self) -> Any:
        return self._parts[1]

    @property
    def spaces(self) -> Any:
        return self._parts[2]


def simulate_controller(plant: ls.Plant, solution: ls.Solution, control: Any, digest: Any, spaces: Any) -> ls.Rollout:
    """One trial of a user's own controller."""
    return ls.simulate(plant, solution, controller=Steering(control, digest, spaces))


def steering(step: int, shown: Any) -> Any:
    return np.full((len(shown), 2), 0.1)


def hook(step: int, values: Any) -> Any:
    return values


def nothing_of_three(step: int, states: Any) -> Any:
    return np.zeros((len(states), 3))


def _running(place: _Place) -> dict[str, tuple[Any, ...]]:
    plant, solution, rollout = place.plant, place.solution, place.rollout
    effect = {"begin": lambda states: states, "alter": print_nothing, "measure": hook, "actuate": hook,
              "force": nothing_of_three, "torque": nothing_of_three,
              "displaced": np.zeros((1, len(plant.world), 3))}  # fmt: skip
    disturbances = {name: getattr(ls, name)(**arguments) for name, arguments in DISTURBANCES.items()}
    for name, one in disturbances.items():  # those whose arguments are all optional
        DISTURBANCES[name] = {field.name: getattr(one, field.name) for field in dataclasses.fields(one) if field.init}
    noise, robot = disturbances["ControlNoise"], place.scenario.robot
    return {
        **{name: (dict(DISTURBANCES[name]), 0.5) for name in DISTURBANCES},
        **{f"{name}.scaled": ({"self": one, "strength": 2.0}, 0.5) for name, one in disturbances.items()},
        "Disturbance.scaled": ({"self": noise, "strength": 2.0}, 0.5),
        "GilbertElliott": (dataclasses.asdict(ls.GilbertElliott(0.1, 0.5)), 0.5),
        **{
            f"simulate {name}": ({"call": functools.partial(simulate_kind, getattr(ls, name)), "plant": plant, "solution": solution,
                                  **DISTURBANCES[name]}, 0.3)
            for name in DISTURBANCES
        },
        "preset": ({"name": "light", "plant": plant},),
        "Effect": (effect,),
        "Plant": ({"robot": robot, "scene": place.scenario.scene}, 0.3),
        "Plant.substeps": ({"self": plant, "period": 1 / 6},),
        "Plant.clearance": ({"self": plant, "states": np.zeros((1, 5, 3)),
                             "displaced": np.zeros((1, len(plant.world), 3))},),
        "Feedback": ({"policy": solution.policy},),
        "Replanning": ({"problem": place.problem, "solution": solution, "every": 1 / 3},),
        "simulate": ({
            "plant": plant, "solution": solution, "disturbances": [noise], "controller": ls.Feedback(solution.policy),
            "seed": 0, "trials": 1, "first_trial": 0, "goal_radius": 0.1, "frames": True, "contacts": True,
            "threads": 1, "generators": lambda trial, stream: np.random.default_rng(trial), "progress": print_nothing,
            "watch": print_nothing,
        }, 2.0),
        "simulate an Effect": ({"call": simulate_effect, "plant": plant, "solution": solution, **effect},),
        "simulate a Controller": ({
            "call": simulate_controller, "plant": plant, "solution": solution, "control": steering, "digest": "mine",
            "spaces": (place.space, place.controls),
        },),
        "outcomes": ({"rollout": rollout, "plant": plant, "problem": place.problem},),
        "check_plant": ({
            "robot": robot, "scene": place.scenario.scene, "period": 1 / 60, "around": np.zeros(3), "spread": 0.3,
            "controls": ([-0.1, -0.1], [0.1, 0.1]), "settle": 0.0, "samples": 1, "tolerance": 0.1, "seed": 0,
        }, 0.3),
    }  # fmt: skip


def _campaigns(place: _Place) -> dict[str, tuple[Any, ...]]:
    reference = "tiny.py:tiny"
    asked = {
        "scenario": reference, "sweeps": {"noise": (ls.ControlNoise(0.1),)}, "strengths": (0.0, 1.0),
        "policies": ("open_loop",), "trials": 2, "seed": 0, "replan_every": 0.5, "shard": 2, "time_limit": 60.0,
    }  # fmt: skip
    campaign = ls.Campaign(**asked)
    results = ls.run_campaign(campaign, place.folder / "campaign", workers=0)
    score = ls.TrialScore(place.plant, place.solution, [ls.ControlNoise(0.5)], threads=1)
    cell = results.cells[0]
    fields = ("plant", "solution", "disturbances", "controller", "failure", "contacts", "batch", "threads", "simulations")
    searching = {"score": line, "size": 3, "seed": 0}
    return {
        "Campaign": (asked,),
        "Campaign.disturbances": ({"self": campaign, "cell": cell},),
        "Campaign.from_json": ({"fields": campaign.as_json()},),
        "Cell": ({"policy": "smooth", "sweep": "noise", "strength": 1.0},),
        "Cell.named": ({"text": "0", "cells": results.cells},),
        "run_campaign": ({
            "campaign": campaign, "folder": place.folder / "campaign", "workers": 0, "batch": 4, "scheduler": None,
            "progress": print_nothing,
        }, 0.1),
        "Results": ({"folder": place.folder / "campaign", "scenario": reference},),
        "replay": ({"results": results, "cell": cell, "trial": 0, "frames": False, "contacts": True},),
        **{
            f"Results.{name}": ({"self": results, "cell": cell, **more},)
            for name, more in {
                "outcomes": {"partial": True}, "tally": {"partial": True}, "reasons": {}, "shards": {}, "number": {},
                "tables": {"partial": True},
            }.items()
        },
        "Results.solution": ({"self": results, "policy": "open_loop"},),
        **{f"Results.{name}": ({"self": results, "shard": next(results.shards())},) for name in ("path", "read", "table")},
        "TrialScore": ({field: getattr(score, field) for field in fields}, 0.5),
        "TrialScore.__call__": ({"self": score, "numbers": np.zeros((2, score.size))},),
        "TrialScore.rollout": ({"self": score, "numbers": np.zeros((2, score.size)), "frames": False},),
        "collision": ({"rollout": place.rollout},),
        "miss": ({"rollout": place.rollout},),
        "split": (searching | {
            "particles": 20, "keep": 0.25, "moves": 1, "repetitions": 2, "confidence": 0.9, "most_levels": 5,
            "level": print_nothing, "progress": print_nothing,
        },),
        "smallest_failure": (searching | {
            "failures": [[2.0, 0.0, 0.0]], "rounds": 1, "pairs": 4, "spread": 0.5, "tolerance": 1e-3,
            "progress": print_nothing,
        },),
        "report": ({"results": results, "out": place.folder / "report.html", "videos": 0, "progress": print_nothing}, 0.05),
    }  # fmt: skip


def line(vectors: Any) -> Any:
    """A score: failure beyond a line."""
    return np.asarray(vectors)[:, 0] - 0.5


def _pictures(place: _Place) -> dict[str, tuple[Any, ...]]:
    world, rollout, solution = place.scenario.scene.world, place.rollout, place.solution
    options = {
        "runs": rollout, "trial": 0, "camera": "top", "insets": (), "titles": ("a title",), "overlays": ("plan",),
        "solution": solution, "quality": "draft", "size": (128, 96),
    }  # fmt: skip
    video = place.folder / "video.mp4"
    made: dict[str, tuple[Any, ...]] = {
        "plot_run": ({
            "solution": solution, "rollouts": {"run": rollout}, "path": place.folder / "run.png", "world": world,
            "trial": 0,
        }, 0.1),
        "plot_policy": ({"solution": solution, "path": place.folder / "p.png", "world": world, "radius": 0.2}, 0.1),
    }
    ls.render(rollout, video, camera="top", size=(128, 96), fps=6, overlays=())
    shown = ls.verify_run(rollout)
    return made | {
        "render": (options | {"path": video.with_name("v.gif"), "fps": 5.0, "speed": 1.0, "progress": print_nothing}, 0.1),
        "still": (options | {"path": place.folder / "still.png", "time": 0.1, "every": 0.2}, 0.15),
        "verify_run": ({"rollout": rollout, "trial": 0, "solution": solution, "progress": print_nothing}, 0.15),
        "verify_video": ({
            "path": video, "rollout": rollout, "trial": 0, "solution": solution, "progress": print_nothing
        }, 0.15),
        "Verification": ({field.name: getattr(shown, field.name) for field in dataclasses.fields(shown)},),
    }  # fmt: skip
