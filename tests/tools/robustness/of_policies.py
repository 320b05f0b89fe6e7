"""What laws, filters and tubes are given: see `subjects.py`."""

import dataclasses
import time
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim.disturbances import ControlNoise, Sensor, Unknown
from robustness.place import Place


def policies(place: Place) -> dict[str, tuple[Any, ...]]:
    unknown = Unknown("gain of left", 0.05)
    uncertainty = ls.disturbances.Uncertainty(unknowns=[unknown], start=0.01, measurement=0.01, control=0.01)
    common = {"problem": place.problem, "solution": place.solution, "uncertainty": uncertainty}
    chosen = {"tolerate": {"m": 0.05, "rad": 0.1}, "effort": 0.1, "at_end": 0.2}
    law = ls.OffsetFree(**common, **chosen)
    policy, tube = law.policy, ls.predict_tube(**common, controller=law)

    def fields(one: Any) -> dict[str, Any]:
        return {field.name: getattr(one, field.name) for field in dataclasses.fields(one) if field.init}

    return {
        "Unknown": (fields(unknown),),
        "Uncertainty": (fields(uncertainty),),
        "Sensor": (fields(Sensor("create_position", noise=0.1, rate=5.0, delay=0.2)),),
        "Plant.sensors": ({"self": place.plant, "sensors": [Sensor("create_position")]},),
        "Uncertainty.steady": ({"self": uncertainty, "memory": 5.0},),
        "track": (common | chosen, 0.5),
        "OffsetFree": (common | chosen | {"sensors": ("x", "y"), "memory": 5.0, "record": False}, 0.5),
        "OffsetFree.loop": ({"self": law, "uncertainty": uncertainty},),
        "predict_tube": (common | {"controller": law}, 0.5),
        "Tube": (fields(tube),),
        "OutputFeedbackPolicy": (fields(policy),),
        "export_c": (
            {
                "policy": policy,
                "folder": place.folder / "c",
                "number": "float",
                "gains": "full",
                "interpolate": False,
                "name": "policy",
            },
            0.1,
        ),
        "ExportedC": (fields(ls.export_c(place.solution, place.folder / "c")),),
        "OutputFeedbackPolicy.step": ({"self": policy, "z": policy.start(), "measurement": np.zeros(3), "t": 0.3},),
        "smooth_chance_constrained": (
            {
                "problem": place.problem,
                "uncertainty": uncertainty,
                "chance": 0.01,
                "controller": lambda problem, solution: solution.policy,
                "rounds": 1,
            },
            0.1,
        ),
        "SafePlan": (
            {
                "problem": place.problem,
                "solution": place.solution,
                "controller": law,
                "tube": tube,
                "asked": 0.01,
                "rounds": ((0.0, 0.1, 30.0, 0.001),),
            },
        ),
        "Tube.added_to": ({"self": tube, "rollout": place.rollout},),
        **replanning(place),
        **funnels(place),
    }


def funnels(place: Place) -> dict[str, tuple[Any, ...]]:
    common = {"plant": place.plant, "solution": place.solution, "disturbances": [ControlNoise(0.01)], "threads": 1,
              "controller": place.solution.policy, "goal_radius": 1.0, "goal_tolerance": None}  # fmt: skip
    asked = {"rate": 0.5, "confidence": 0.8, "knots": (0, 2), "states": ("x", "y"), "shape": None, "largest": 0.5,
             "failures": 2, "seed": 0, "progress": lambda done, of, found: None}  # fmt: skip
    funnel = ls.funnel(**common, **asked)
    check = {"trials": 3, "between": (0.0, 0.5), "seed": 1}
    chosen = {"problem": place.problem, "plant": place.plant, "disturbances": [ControlNoise(0.01)], "trials": 2,
              "starts": 2, "seed": 0, "goal_radius": 1.0, "goal_tolerance": None, "threads": 1}  # fmt: skip
    safest = ls.stress.smooth_safest(**chosen)
    state = place.solution.trajectory.states[0]
    where = {"self": funnel, "x": state, "t": 0.2, "about": state}
    return {
        "funnel": (common | asked, 0.3),
        "Funnel": ({field.name: getattr(funnel, field.name) for field in dataclasses.fields(funnel)},),
        "Funnel.level": ({"self": funnel, "t": 0.2},),
        "Funnel.contains": (dict(where),),
        "Funnel.deviation": (dict(where),),
        "Funnel.left_at": ({"self": funnel, "rollout": place.rollout},),
        "Funnel.states_at": ({"self": funnel, "knot": 0, "points": np.zeros((2, 2)), "level": 0.1},),
        "check_funnel": ({"funnel": funnel} | common | check, 0.3),
        "FunnelCheck": ({"knot": 0, "level": 1.0, "reached": safest.reached, "successes": np.ones(2, dtype=bool)},),
        "smooth_safest": (chosen, 0.1),
        "SafestPlan": ({"solution": safest.solution, "compared": safest.compared, "reached": safest.reached},),
        "ComparedPlan": (vars(safest.compared[0]),),
        "plot_funnel": (
            {"funnel": funnel, "path": place.folder / "funnel.png", "world": place.plant.world, "radius": 0.1},
            0.3,
        ),
    }


def replanning(place: Place) -> dict[str, tuple[Any, ...]]:
    solver, state = ls.prepare(place.problem), place.solution.trajectory.states[1]
    replan = solver.solve(state, place.solution.shifted(1))
    record = {"step": 3, "trial": 0, "status": "CONVERGED", "iterations": 2, "seconds": 0.01, "cost": 1.0,
              "before": 1.0, "used": True, "reason": ""}  # fmt: skip
    replanner = ls.Replanner(place.problem, place.solution, every=1 / 3)
    running = replanner.live()
    running.__enter__()  # its thread ends with the process
    parts = {field.name: getattr(replan, field.name) for field in dataclasses.fields(replan)}
    return {
        "prepare": ({"problem": place.problem, "tolerance": 1e-4, "max_iterations": 5}, 0.3),
        "PreparedSolver": ({"problem": place.problem, "settings": solver.settings}, 0.3),
        "PreparedSolver.solve": (
            {"self": solver, "state": state, "start": replan, "problem": place.problem, "after": 0, "time_limit": 0.01},
        ),
        "Plan": ({field.name: parts[field.name] for field in dataclasses.fields(ls.Plan)},),
        "Plan.shifted": ({"self": replan, "steps": 1, "horizon": "moving"},),
        "Replan": (parts,),
        "Replan.shifted": ({"self": replan, "steps": 1, "horizon": "moving"},),
        "ReplanRecord": (record,),
        "AffinePolicy.shifted": ({"self": place.solution.policy, "steps": 1, "horizon": "moving"},),
        "Problem.later": ({"self": place.problem, "seconds": 0.5},),
        "Problem.with_duration_of": ({"self": place.problem, "plan": place.solution},),
        "Problem.from_state": ({"self": place.problem, "state": state, "after": 1},),
        "Dynamics.period_near": ({"self": place.problem.dynamics, "dt": 0.1},),
        "Replanner": (
            {
                "problem": place.problem,
                "solution": place.solution,
                "every": 1 / 3,
                "deadline": 1 / 3,
                "horizon": "moving",
                "predict": True,
                "changes": None,
                "when": None,
                "share": 1.0,
                "computing": 0.0,
                "seed": 0,
            },
            0.3,
        ),
        "Replanner.live": ({"self": replanner, "interpolate": True, "clock": time.perf_counter},),
        "LiveReplanner": ({"rule": replanner.rule, "interpolate": True, "clock": time.perf_counter},),
        "LiveReplanner.step": ({"self": running, "state": state, "t": 0.2},),
        "LiveReplanner.change": ({"self": running, "initial": ls.FixedState(state)},),
    }
