"""Arguments that public callables accept: what runs policies, counts how they fail, and draws it. See `subjects.py`."""

import dataclasses
import functools
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim.disturbances import ControlNoise, Disturbance, Effect, GilbertElliott, Sensor
from robustness.of_problems import print_nothing
from robustness.place import Place

DISTURBANCES: dict[str, dict[str, Any]] = {
    "ActuatorLoss": {"actuator": "create_wheel_left", "at": 0.2}, "CommandDropouts": {"loss": 0.1},
    "ControlDelay": {"periods": 1}, "Dryden": {}, "Gusts": {}, "InitialStateError": {"std": (0.1, 0.1, 0.1)},
    "MeanWind": {"velocity": (1.0, 0.0, 0.0)}, "MeasurementDropouts": {"loss": 0.1},
    "MeasurementLatency": {"periods": 1}, "MotorLag": {"time_constant": 0.1},
    "Payload": {"mass": 0.1, "body": "create"},
    "Push": {"impulse": (1.0, 0.0, 0.0), "at": 0.1}, "Saturation": {"share": 0.5},
    "StateNoise": {"noise": ls.Noise(0.1 * np.eye(3))},
    "SensorErrors": {"sensors": [Sensor("create_position", noise=0.01)], "strength": 1.0},
    **{
        kind: {"std": 0.1}
        for kind in (
            "AxleMismatch", "ControlNoise", "ControlOffset", "DisplacedObstacles", "ForceNoise",
            "FrictionMismatch", "InertiaMismatch",
            "MassMismatch", "MeasurementBias", "MeasurementNoise", "ThrustMismatch", "TorqueNoise",
            "WheelRadiusMismatch",
        )
    },
}  # fmt: skip


class Hooked(Disturbance):
    """A user's own disturbance, whose effect is spoilt."""

    def __init__(self, effect: Any) -> None:
        self.effect = effect

    def scaled(self, strength: float) -> "Hooked":
        return self

    def start(self, plant: Any, plan: Any, generators: Any) -> Any:
        return self.effect


def simulate_effect(plant: ls.Plant, solution: ls.Solution, **effects: Any) -> ls.Rollout:
    """One trial of a user's own disturbance with that effect."""
    return ls.simulate(plant, solution, disturbances=[Hooked(Effect(**effects))])


def simulate_kind(kind: Any, plant: ls.Plant, solution: ls.Solution, **settings: Any) -> ls.Rollout:
    """Two trials of a packaged disturbance with those settings."""
    return ls.simulate(plant, solution, disturbances=[kind(**settings)], trials=2)


class Steering(ls.Controller):
    """A user's own controller, whose answers are spoilt."""

    def __init__(self, control: Any, digest: Any, coordinates: Any) -> None:
        self._parts = control, digest, coordinates

    def start(self, trials: int) -> Any:
        return SteeringRun(self._parts[0]) if callable(self._parts[0]) else self._parts[0]

    @property
    def digest(self) -> Any:
        return self._parts[1]

    @property
    def coordinates(self) -> Any:
        return self._parts[2]


class SteeringRun(ls.types.ControllerRun):
    def __init__(self, control: Any) -> None:
        self._control = control

    def control(self, step: int, measured: Any) -> Any:
        return self._control(step, measured)


def simulate_controller(
    plant: ls.Plant, solution: ls.Solution, control: Any, digest: Any, coordinates: Any
) -> ls.Rollout:
    """One trial of a user's own controller."""
    return ls.simulate(plant, solution, controller=Steering(control, digest, coordinates))


def steering(step: int, shown: Any) -> Any:
    return np.full((len(shown), 2), 0.1)


# A vehicle as RotorPy describes one, which takes no RotorPy.
MULTIROTOR = {
    "mass": 0.5, "Ixx": 0.004, "Iyy": 0.004, "Izz": 0.007, "k_eta": 6e-6, "k_m": 1e-7,
    "rotor_directions": [1, -1, 1, -1],
    "rotor_pos": {"r1": [0.1, 0.1, 0], "r2": [0.1, -0.1, 0], "r3": [-0.1, -0.1, 0], "r4": [-0.1, 0.1, 0]},
    "rotor_speed_min": 0.0, "rotor_speed_max": 1500.0,
}  # fmt: skip


def hook(step: int, values: Any) -> Any:
    return values


def nothing_of_three(step: int, states: Any) -> Any:
    return np.zeros((len(states), 3))


def fits(disturbance: Disturbance, place: Place) -> bool:
    """Whether the robot can have it: wind takes drag, for example."""
    try:
        ls.simulate(place.plant, place.solution, disturbances=[disturbance], trials=2)
    except ls.InputError:
        return False
    return True


def running(place: Place) -> dict[str, tuple[Any, ...]]:
    plant, solution, rollout = place.plant, place.solution, place.rollout
    effect = {"initial_states": lambda states: states, "alter": print_nothing, "measure": hook,
              "actuate": hook, "force": nothing_of_three, "torque": nothing_of_three,
              "displaced": np.zeros((1, len(plant.world), 3)), "wind": nothing_of_three,
              "factors": {"mass": np.ones((1, 1))}}  # fmt: skip
    disturbances = {name: getattr(ls.disturbances, name)(**arguments) for name, arguments in DISTURBANCES.items()}
    for name, one in disturbances.items():  # those whose arguments are all optional
        DISTURBANCES[name] = {field.name: getattr(one, field.name) for field in dataclasses.fields(one) if field.init}
    noise, robot = disturbances["ControlNoise"], place.scenario.robot
    return {
        **{name: (dict(DISTURBANCES[name]), 0.5) for name in DISTURBANCES},
        **{f"{name}.scaled": ({"self": one, "strength": 2.0}, 0.5) for name, one in disturbances.items()},
        "Disturbance.scaled": ({"self": noise, "strength": 2.0}, 0.5),
        "GilbertElliott": (dataclasses.asdict(GilbertElliott(0.1, 0.5)), 0.5),
        **{
            f"simulate {name}": (
                {"call": functools.partial(simulate_kind, type(one)), "plant": plant, "solution": solution}
                | DISTURBANCES[name],
                0.3,
            )
            for name, one in disturbances.items()
            if fits(one, place)
        },
        "preset": ({"name": "light", "plant": plant},),
        "uncertainty_of": ({"plant": plant, "disturbances": [noise]},),
        "Effect": (effect,),
        "Plant": ({"robot": robot, "scene": place.scenario.scene}, 0.3),
        "Plant.state": (
            {"self": plant, "qpos": np.eye(9)[3], "qvel": np.zeros(8), "act": np.zeros(0), "near": np.zeros(3)},
        ),
        "Plant.for_period": ({"self": plant, "period": 1 / 7},),
        "Plant.substeps": ({"self": plant, "period": 1 / 6},),
        "Plant.check_simulator": ({"self": plant, "what": "Mine", "parameter": "mass"},),
        "Crazyflow": ({"drone": "cf21B_500", "timestep": 0.002, "integrator": "rk4"},),
        "RotorPy": ({"vehicle": MULTIROTOR, "timestep": 0.01},),
        "RotorPy.quadrotor": ({"self": ls.simulators.RotorPy(MULTIROTOR), "drag": 0.2},),
        "Plant.clearance": ({"self": plant, "states": np.zeros((1, 5, 3)),
                             "displaced": np.zeros((1, len(plant.world), 3))},),
        "simulate": ({
            "plant": plant, "plan": solution, "disturbances": [noise], "controller": solution.policy,
            "seed": 0, "trials": 1, "first_trial": 0, "goal_radius": 0.1, "frames": True, "contacts": True,
            "threads": 1, "generators": lambda trial, stream: np.random.default_rng(trial), "progress": print_nothing,
            "watch": print_nothing,
            "moving": ls.World([ls.Obstacle("ball", "sphere", np.full(3, 9.0), np.eye(3), np.array([0.1, 0, 0]))]),
        }, 2.0),
        "simulate an Effect": ({"call": simulate_effect, "plant": plant, "solution": solution, **effect},),
        "simulate a Controller": ({
            "call": simulate_controller, "plant": plant, "solution": solution, "control": steering, "digest": "mine",
            "coordinates": (place.space, place.controls),
        },),
        "outcomes": ({"rollout": rollout, "problem": place.problem, "goal_radius": 0.1},),
        "check_plant": ({
            "robot": robot, "scene": place.scenario.scene, "problem": place.scenario.problem,
            "plan": place.solution, "period": 1 / 60, "around": np.zeros(3), "spread": 0.3,
            "controls": ([-0.1, -0.1], [0.1, 0.1]), "settle": 0.0, "samples": 1, "tolerance": 0.1, "seed": 0,
        }, 0.3),
    }  # fmt: skip


def campaigns(place: Place) -> dict[str, tuple[Any, ...]]:
    reference = "tiny.py:tiny"
    asked = {
        "scenario": reference, "sweeps": {"noise": (ControlNoise(0.1),)}, "strengths": (0.0, 1.0),
        "policies": ("open_loop",), "trials": 2, "seed": 0, "replan_every": 0.5, "goal_radius": 0.1,
        "goal_tolerance": None, "shard": 2, "time_limit": 60.0, "design_disturbances": None, "solution": None,
    }  # fmt: skip
    setup = {name: asked[name] for name in ("scenario", "solution", "goal_radius", "goal_tolerance", "seed")}
    campaign = ls.stress.Campaign(**asked)
    results = ls.stress.run_campaign(campaign, place.folder / "campaign", workers=0)
    score = ls.stress.TrialScore(place.plant, place.solution, [ControlNoise(0.5)], threads=1)
    cell, rates = results.cells[0], results.rates()
    searching = {"score": line, "size": 3, "seed": 0}
    # One in five or so fails.
    reliability = ls.stress.ReliabilityProblem(reference, policy="open_loop", failure="miss", goal_radius=0.0565)
    certificate = reliability.rare_failures(particles=20, repetitions=2, seed=0).certificate()
    return {
        "Setup": (setup | {"design_disturbances": None},),
        "Study": (setup | {"sweep": "light", "strength": 1.0, "policy": "smooth", "design_disturbances": None},),
        "Campaign": (asked,),
        "Campaign.of_sets": ({
            **setup, "sets": ["scenario"], "policies": ["open_loop"], "trials": 2
        },),
        "Campaign.disturbances": ({"self": campaign, "cell": cell},),
        "Campaign.from_json": ({"fields": campaign.as_json(), "scenario": campaign.resolved, "solution": None},),
        "Cell": ({"policy": "smooth", "sweep": "noise", "strength": 1.0},),
        "Cell.named": ({"text": "0", "cells": results.cells},),
        "run_campaign": ({
            "campaign": campaign, "folder": place.folder / "campaign", "workers": 0, "batch": 4, "scheduler": None,
            "progress": print_nothing,
        }, 0.1),
        "Results": ({"folder": place.folder / "campaign", "scenario": reference},),
        "Results.goal_radius": ({"self": results, "policy": cell.policy},),
        "replay": ({"results": results, "cell": cell, "trial": 0, "frames": False, "contacts": True},),
        **{
            f"Results.{name}": ({"self": results, "cell": cell, **more},)
            for name, more in {
                "outcomes": {"partial": True}, "reasons": {}, "shards": {}, "number": {},
            }.items()
        },
        "compare": ({"first": results, "second": results, "policies": ("open_loop", "open_loop")},),
        "DataTable": ({"columns": rates.columns, "formats": rates.formats, "notes": rates.notes},),
        "DataTable.select": ({"self": rates, "headings": ["policy", "success"]},),
        "Outcomes.first": ({"self": results.outcomes(cell), "count": 1},),
        "DataTable.save": ({"self": rates, "path": place.folder / "rates.csv"},),
        "Results.command_of": ({"self": results, "command": "replay"},),
        "Results.solution": ({"self": results, "policy": "open_loop"},),
        **{
            f"Results.{name}": ({"self": results, "shard": next(results.shards())},)
            for name in ("path", "table")
        },
        "TrialScore": ({field.name: getattr(score, field.name) for field in dataclasses.fields(score)}, 0.5),
        "TrialScore.__call__": ({"self": score, "numbers": np.zeros((2, score.size))},),
        "TrialScore.rollout": ({"self": score, "numbers": np.zeros((2, score.size)), "frames": False},),
        "collision_score": ({"rollout": place.rollout, "first": 1},),
        "miss_score": ({"rollout": place.rollout, "first": 1},),
        "failure_probability": (searching | {
            "particles": 20, "keep": 0.25, "moves": 1, "repetitions": 2, "most_levels": 5,
            "level": print_nothing, "progress": print_nothing,
        },),
        "smallest_failure": (searching | {
            "failures": [[2.0, 0.0, 0.0]], "particles": 20, "rounds": 1, "pairs": 4, "level": print_nothing,
            "progress": print_nothing,
        },),
        "ReliabilityProblem": ({
            "scenario": reference, "sweep": "light", "strength": 1.0, "policy": "smooth", "failure": "miss",
            "goal_radius": 0.1, "goal_tolerance": None, "design_disturbances": None, "solution": None, "seed": 0,
        },),
        **{
            f"ReliabilityProblem.{name}": ({
                "self": reliability, **more, "seed": 0, "report": print_nothing, "progress": print_nothing
            }, 0.1)
            for name, more in {
                "rare_failures": {"particles": 20, "repetitions": 2, "keep": 0.1},
                "smallest_failure": {"rounds": 1, "particles": 20}
            }.items()
        },
        "FailureCertificate": (vars(certificate),),
        "certify": ({
            "certificate": certificate, "repetitions": 2, "seed": 0, "scenario": reference, "report": print_nothing,
            "progress": print_nothing,
        }, 0.1),
        "harden": ({
            "problem": ls.stress.ReliabilityProblem(reference, solution=place.solution), "chance": 0.5, "rounds": 1,
            "particles": 20, "repetitions": 2, "seed": 0, "report": print_nothing, "progress": print_nothing,
        }, 0.05),
        "report": ({
            "results": results, "out": place.folder / "report.html", "videos": 0, "progress": print_nothing
        }, 0.05),
    }  # fmt: skip


def line(vectors: Any) -> Any:
    """A score: failure beyond a line."""
    return np.asarray(vectors)[:, 0] - 0.5


def pictures(place: Place) -> dict[str, tuple[Any, ...]]:
    world, rollout, solution = place.scenario.scene.world, place.rollout, place.solution
    options = {
        "runs": rollout, "trial": 0, "camera": "top", "insets": (), "titles": ("a title",),
        "overlays": ("plan", "cost_tube", "caption"), "solution": solution, "funnel": None,
        "quality": "draft", "size": (480, 270),
    }  # fmt: skip
    video = place.folder / "video.mp4"
    made: dict[str, tuple[Any, ...]] = {
        "plot_run": (
            {
                "solution": solution,
                "rollouts": {"run": rollout},
                "path": place.folder / "run.png",
                "world": world,
                "trial": 0,
                "style": "page",
            },
            0.1,
        ),
        "plot_policy": (
            {"solution": solution, "path": place.folder / "p.png", "world": world, "radius": 0.2, "style": "page"},
            0.1,
        ),
    }
    ls.render(rollout, video, camera="top", size=(128, 96), fps=6, overlays=())
    shown = ls.verify_run(rollout)
    return made | {
        "render": (options | {
            "path": place.folder / "still.png", "fps": None, "speed": 1.0, "time": 0.1, "every": 0.2,
            "progress": print_nothing,
        }, 0.15),
        "render_html": ({
            "rollout": rollout, "path": place.folder / "run.html", "trial": 0, "overlays": ("plan", "cost_tube"),
            "solution": solution, "funnel": None,
        }, 0.1),
        "verify_run": ({"rollout": rollout, "trial": 0, "solution": solution, "progress": print_nothing}, 0.15),
        "verify_video": ({
            "path": video, "rollout": rollout, "trial": 0, "solution": solution, "progress": print_nothing
        }, 0.15),
        "Verification": ({field.name: getattr(shown, field.name) for field in dataclasses.fields(shown)},),
    }  # fmt: skip
