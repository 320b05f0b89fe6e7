"""From a recorded run to fitted masses and damping, to a plan, to a policy: where the MJCF on paper is wrong.

    pip install 'lqrsim[sysid]'                     # what mujoco.sysid needs beside MuJoCo
    python experiments/fit_to_data.py
    python experiments/fit_to_data.py --quick       # fewer runs
    python experiments/fit_to_data.py --models models --only Panda    # of robosuite, see experiments/mjcf/family.py

A plant differs from its MJCF in masses, damping, friction and motors. The plan for the MJCF fails in it. `mujoco.sysid`
fits the numbers to what that one run recorded, with noise; the plan for the fitted ones is run in the same plant, and
so is one for the true ones.
"""

import contextlib
import importlib
import io
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mjcf.family import FAMILY
from mjcf.files import CART_POLE, REACHER
from mjcf.packaged import quadrotor
from runner import Settings, opening, run, table

import lqrsim as ls
from lqrsim.scenes.scene import scene_from_xml

SHARES = 0.25, 0.5  # of the run, that numbers are fitted to one after the other, before the whole
FACTOR = 10.0  # how many times as much, and as little, as in the MJCF a number may be


@dataclass(frozen=True, kw_only=True)
class Case:
    """A robot, and how its MJCF is wrong.

    Attributes:
      name: of it. robot: as its MJCF has it. truth: the numbers that are others, by name. noise: standard deviation of
        what is measured of each state, in its unit. problem: what it is to do, with these numbers or others.
    """

    name: str
    robot: ls.MjcfRobot
    truth: Mapping[str, float]
    noise: tuple[float, ...]
    problem: Callable[[ls.MjcfRobot], ls.Problem]


def cart_pole() -> Case:
    """Swings up its pole; cart, pole and bearings are heavier and stiffer than drawn."""
    robot = ls.MjcfRobot(scene_from_xml(CART_POLE.replace("<mujoco>", '<mujoco model="cart-pole">'), "cart-pole"))

    def problem(robot: ls.MjcfRobot) -> ls.Problem:
        return ls.Problem(
            dynamics=robot.dynamics, dt=0.02, steps=150, initial=ls.FixedState(robot.at(pole=np.pi)),
            stage_cost=ls.ControlCost([0.1]), final_cost=ls.QuadraticCost(np.full(4, 100.0), about=robot.at()),
            control_limits=(-1, 1),
        )  # fmt: skip

    truth = {"cart_mass": 1.4, "pole_mass": 0.35, "slider_damping": 0.5, "pole_damping": 0.02}
    return Case(name="cart-pole", robot=robot, truth=truth, noise=(0.002, 0.005, 0.02, 0.05), problem=problem)


def loaded_quadrotor() -> Case:
    """Flies through the cage with a load, and with more drag than on paper."""
    scenario, robot = ls.scenarios.quadrotor(), ls.MjcfRobot("cage")
    drag = {f"quadrotor_{axis}_damping": 0.3 for axis in "xyz"}
    return Case(
        name="quadrotor", robot=robot, truth={"quadrotor_mass": 0.6, **drag},
        noise=(0.005,) * 3 + (0.005,) * 3 + (0.02,) * 3 + (0.02,) * 3,
        problem=lambda robot: quadrotor(scenario, robot.dynamics),
    )  # fmt: skip


def arm() -> Case:
    """Three joints: what it holds, its friction and its damping are not on paper, nor how weak a motor is."""
    robot = ls.MjcfRobot(scene_from_xml(REACHER, "reacher"))

    def problem(robot: ls.MjcfRobot) -> ls.Problem:
        start, goal = robot.at(shoulder=-0.8, elbow=1.6), robot.at(turn=1.5, shoulder=0.5, elbow=-0.6)
        return robot.problem(start, goal, steps=75, dt=0.02, weights=np.repeat((1000.0, 100.0), 3))

    truth = {
        "hand_mass": 0.8, "turn_damping": 0.6, "shoulder_damping": 0.5, "elbow_damping": 0.45,
        "turn_frictionloss": 0.5, "shoulder_frictionloss": 0.5, "elbow_frictionloss": 0.4, "elbow_motor_gear": 0.85,
    }  # fmt: skip
    return Case(name="arm", robot=robot, truth=truth, noise=(1e-3,) * 3 + (1e-2,) * 3, problem=problem)


def panda(folder: Path | None = None) -> Case:
    """The Panda of robosuite, with something in its hand, stiffer joints and a weak motor. Raises InputError."""
    (task,) = (one.found_in(folder) for one in FAMILY if one.name == "Panda")
    if task.path is None:
        raise ls.InputError("--models: got no folder with robosuite, want one as experiments/mjcf/family.py says")
    truth = {"right_hand_mass": 1.5, "link5_mass": 2.6, "torq_j4_gear": 0.9}
    truth |= {f"joint{number}_damping": 0.4 if number < 6 else 0.05 for number in range(1, 8)}
    return Case(
        name="Panda", robot=task.robot(), truth=truth, noise=(1e-3,) * 7 + (1e-2,) * 7, problem=task.problem
    )  # fmt: skip


CASES: dict[str, Callable[[], Case]] = {"cart-pole": cart_pole, "quadrotor": loaded_quadrotor, "arm": arm}


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    """What the script is told."""

    only: tuple[str, ...] = ()
    """Names of robots; by default all."""
    models: Path | None = None
    """Folder with robosuite's files, for the Panda, too; `experiments/mjcf/family.py` says how to get them."""
    trials: int = 100
    """Runs of each policy, with noise."""
    seed: int = 0
    """Of the noise."""


def library() -> Any:
    """mujoco.sysid. Raises InputError with what to install if it is not there."""
    try:
        importlib.import_module("tabulate")  # of what it needs; without, it is imported all the same, and is empty
        from mujoco import sysid

        if not hasattr(sysid, "optimize"):
            raise ModuleNotFoundError
    except ModuleNotFoundError:
        raise ls.InputError("mujoco.sysid: got none, want what it needs: pip install 'lqrsim[sysid]'") from None
    logging.getLogger("absl").setLevel(logging.ERROR)  # it warns of models without sensors
    return sysid


def fit(robot: ls.MjcfRobot, run: ls.Rollout, names: list[str]) -> dict[str, tuple[float, float]]:
    """Fit numbers of the robot's MJCF to what was measured in the first trial of a run.

    The trial begins where its plan does, and counts up to a collision. The fit begins with a quarter of it: a whole
    run of a wrong model is too far from what was recorded to lead to the right one.

    Args:
      names: of the numbers, as in `robot.dynamics.numbers`; where they are zero there is nothing to scale.

    Returns:
      By name: the number, and half the width of its 95 % interval.
    """
    sysid, dt = library(), run.plan.dt
    steps = int(min(run.plan.steps * dt, run.collided_at[0]) / dt)

    def build(parameters: Any, spec: mujoco.MjSpec) -> mujoco.MjModel:
        # The plan's physics: a model that is still wrong is not to end in an obstacle, where no number matters.
        values = {name: float(one.value[0]) for name, one in parameters.items()}
        return robot.dynamics.with_parameters(**values).physics.model

    assumed, parameters = robot.dynamics.numbers, sysid.ParameterDict()
    for name in names:
        parameters.add(sysid.Parameter(name, assumed[name], assumed[name] / FACTOR, assumed[name] * FACTOR))

    def fitted(parameters: Any, share: float) -> tuple[Any, Any, Any]:
        recorded = sequences(sysid, robot, run, max(1, round(share * steps)))
        residual = sysid.build_residual_fn(models_sequences=[recorded], build_model=build)
        with contextlib.redirect_stdout(io.StringIO()):  # its iterations
            return *sysid.optimize(parameters, residual, verbose=False), residual

    for share in SHARES:
        parameters = fitted(parameters, share)[0]
    parameters, ended, residual = fitted(parameters, 1.0)
    _, widths = sysid.calculate_intervals(residual(parameters.as_vector(), parameters)[0], ended.jac)
    return {name: (float(parameters[name].value[0]), float(width)) for name, width in zip(names, widths, strict=True)}


def sequences(sysid: Any, robot: ls.MjcfRobot, run: ls.Rollout, steps: int) -> Any:
    """So many control periods of the first trial, as the library takes them."""
    model, dt = robot.scene.model, run.plan.dt
    measured = run.measured[0, : steps + 1].copy()
    angles = list(robot.dynamics.state_coordinates.angles)
    measured[:, angles] = np.unwrap(measured[:, angles], axis=0)  # they are those nearest the plan
    controls = np.repeat(robot.actuation(run.applied[0, :steps]), round(dt / model.opt.timestep), axis=0)
    controls = np.concatenate([controls, controls[-1:]])
    positions, velocities, *_ = sysid.TimeSeries.compute_all_state_mappings(model)
    # It takes every body of six degrees of freedom for a free one, and would count those of slides and a ball twice.
    free = {model.body(model.jnt_bodyid[k]).name for k in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)}
    known = free | set(robot.joints)
    signals = {
        name: where for name, where in (positions | velocities).items() if name.rsplit("_", maxsplit=1)[0] in known
    }  # fmt: skip
    return sysid.ModelSequences(
        robot.name, mujoco.MjSpec.from_string(robot.scene.xml), "recorded",
        sysid.create_initial_state(model, *robot.configuration(run.plan.states[0])),
        sysid.TimeSeries.from_control_names(np.arange(len(controls)) * model.opt.timestep, controls, model),
        sysid.TimeSeries(
            np.arange(steps + 1) * dt, np.concatenate(robot.configuration(measured), axis=-1), signals
        ),
        allow_missing_sensors=True,
    )  # fmt: skip


def of_case(case: Case, trials: int, seed: int) -> dict[str, Any]:
    """Record, fit, solve with each of the models, and run all in the plant."""
    true = case.robot.with_parameters(**case.truth)
    plant, noise = ls.Plant(true, true.scene), [ls.disturbances.MeasurementNoise(case.noise)]
    on_paper = ls.smooth(case.problem(case.robot))
    recorded = ls.simulate(plant, on_paper, disturbances=noise, seed=seed)
    fitted = fit(case.robot, recorded, list(case.truth))
    assumed = case.robot.dynamics.numbers
    numbers = [
        {"name": name, "on paper": assumed[name], "true": value, "fitted": fitted[name][0], "within": fitted[name][1]}
        for name, value in case.truth.items()
    ]
    like_it = case.robot.with_parameters(**{name: value for name, (value, _) in fitted.items()})
    plans = {
        "on paper": on_paper, "fitted": ls.smooth(case.problem(like_it)),
        "true": ls.smooth(case.problem(true)),
    }  # fmt: skip
    return {
        "name": case.name, "seconds": float(min(recorded.times[-1], recorded.collided_at[0])), "numbers": numbers,
        "plans": [
            {"model": name} | outcome(plant, plan, noise, trials, seed + 1)
            for name, plan in plans.items()
        ],
    }  # fmt: skip


def outcome(plant: ls.Plant, plan: ls.Solution, noise: list[Any], trials: int, seed: int) -> dict[str, Any]:
    """Results of a plan's policy in the plant."""
    runs = ls.simulate(plant, plan, disturbances=noise, frames=False, trials=trials, seed=seed)
    counted = ls.stress.outcomes(runs)
    return {
        "status": plan.status.name, "cost": plan.cost, "trials": trials, "unit": runs.tracking_unit,
        "reached": int(runs.reached.sum()), "collided": int(np.isfinite(runs.collided_at).sum()),
        "off": float(np.median(counted.worst)),
    }  # fmt: skip


def main(config: Config) -> dict[str, Any]:
    library()
    cases = CASES if config.models is None else CASES | {"Panda": partial(panda, config.models)}
    names = ["cart-pole"] if config.quick and not config.only else [*cases]
    chosen = [name for name in names if not config.only or name in config.only]
    trials = min(config.trials, 10) if config.quick else config.trials
    return opening(config) | {"cases": [of_case(cases[name](), trials, config.seed) for name in chosen]}


def report(result: dict[str, Any]) -> str:
    """Two tables per robot: the numbers, and how policies made with them perform."""
    parts = []
    for case in result["cases"]:
        rows = [
            [
                one["name"], f"{one['on paper']:.4g}", f"{one['true']:.4g}",
                f"{one['fitted']:.4g} ± {one['within']:.1g}", f"{100 * (one['fitted'] / one['true'] - 1):+.1f} %",
            ]
            for one in case["numbers"]
        ]  # fmt: skip
        parts.append(f"{case['name']}: fitted to one run of {case['seconds']:.1f} s\n")
        parts.append(table(("number", "on paper", "true", "fitted", "error"), rows))
        rows = [
            [
                plan["model"], plan["status"], f"{plan['cost']:.4g}", f"{plan['reached']} of {plan['trials']}",
                plan["collided"], f"{plan['off']:.2g} {plan['unit']}",
            ]
            for plan in case["plans"]
        ]  # fmt: skip
        head = ("numbers of the plan", "status", "cost", "reached", "collided", "largest tracking error, median")
        parts += ["", table(head, rows), ""]
    return "\n".join(parts)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
