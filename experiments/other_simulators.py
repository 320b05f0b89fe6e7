"""Plans from our model, run in simulators that we did not write: RotorPy's Hummingbird, crazyflow's Crazyflie.

    pip install 'lqrsim[rotorpy,crazyflow]'
    python experiments/other_simulators.py                         # a quarter of an hour
    python experiments/other_simulators.py --simulators rotorpy    # one of them
    python experiments/other_simulators.py --quick

The model is `Quadrotor` with the vehicle's numbers. What it does not have, such as the lag of the rotors, shows in a
recorded run: the numbers that explain it best are fitted, and the plan and its law are made again with them. All run
the queries of Fig. 3, in the cage, undisturbed and under the presets.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

if __name__ == "__main__":  # before SciPy looks: crazyflow asks for it
    os.environ.setdefault("SCIPY_ARRAY_API", "1")

import numpy as np
from runner import FolderSettings, Result, at_most, between, interval, judge, opening, progress, run, table
from scipy.optimize import least_squares

import lqrsim as ls
from lqrsim.control.controllers import ControllerLike
from lqrsim.disturbances import Uncertainty
from lqrsim.errors import Array
from lqrsim.simulators import Crazyflow, RotorPy, Simulator
from lqrsim.stress.statistics import rate

Name = Literal["rotorpy", "crazyflow"]
# What is simulated, and the control period in s.
SIMULATORS: dict[Name, tuple[Callable[[], RotorPy | Crazyflow], float]] = {
    "rotorpy": (lambda: RotorPy(timestep=1 / 50), 1 / 50),
    "crazyflow": (Crazyflow, 1 / 50),
}
NOISE = {"m": 0.001, "m/s": 0.005, "rad": 0.002, "rad/s": 0.01}  # of the recorded run, as of motion capture
CHANCE = 1e-3  # of a collision, that a plan may have
# What the law may let each state deviate, and the share of the hover force that it may add for that: far less than the
# choice of `OffsetFree` for the predicted chance, which trusts the model of the actuators.
TOLERATE, EFFORT = {"m": 0.1, "m/s": 0.3, "rad": 0.3, "rad/s": 3.0}, 0.2
PRESETS = ("undisturbed", "calm", "light")
WANTED = {"calm": 95.0, "light": 90.0}  # % of the trials that reach the goal


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    simulators: tuple[Name, ...] = get_args(Name)
    """Which of them."""
    queries: int = 10
    """A start and a goal each."""
    trials: int = 10
    """Of each query, law and preset; undisturbed there is one."""
    seed: int = 0
    """Of the disturbances."""


def problem_of(robot: ls.Quadrotor, query: int, dt: float) -> ls.Problem:
    """A query of Fig. 3 for this robot, from exactly its start; forces cost as much relative to those in hover."""
    scenario, force = ls.scenarios.quadrotor(query), robot.hover_force
    assert scenario.problem.start is not None
    weight = 20.0 * (ls.Quadrotor().hover_force / force) ** 2
    return replace(
        scenario.problem, dynamics=robot.dynamics, dt=dt, steps=round(5.0 / dt),
        initial=ls.FixedState(scenario.problem.start),
        stage_cost=ls.ControlCost(np.full(4, weight), about=np.full(4, force))
        + ls.ObstacleCost(scenario.scene.world, radius=robot.radius, sharpness=10.0),
    )  # fmt: skip


def gentle(robot: ls.Quadrotor, stated: Uncertainty) -> Callable[[ls.Problem, ls.Solution], ls.OffsetFree]:
    """Makes an OffsetFree with the stated tolerances."""
    effort = EFFORT * robot.hover_force
    return lambda problem, plan: ls.OffsetFree(problem, plan, stated, tolerate=TOLERATE, effort=effort)


def lagged(controls: Array, hover: float, dt: float, lag: float) -> Array:
    """The mean force of each rotor in each control period, (T, m), if it follows its command with a first-order lag."""
    reached, means = np.full(controls.shape[1], hover), np.empty_like(controls)
    left, mean = np.exp(-dt / lag), -np.expm1(-dt / lag) * lag / dt
    for t, command in enumerate(controls):
        means[t] = command + mean * (reached - command)
        reached = command + left * (reached - command)
    return means


def fit(robot: ls.Quadrotor, recorded: ls.Rollout) -> dict[str, list[float]]:
    """Mass, inertia, drag and the rotors' lag that predict each measured state best from the one before.

    The intervals take residuals for independent. The noise of a measurement is in two of them with opposite signs, so
    that runs with other noise spread far less. It also is in the commands of the policy, which biases the inertia: by
    2 % for the Hummingbird.

    Returns:
      By name: the number on paper, the fitted one, and half the width of its 95 % interval.
    """
    plan, measured, controls = recorded.plan, recorded.measured[0], recorded.applied[0]
    names = ("mass", "inertia", "drag")
    paper = np.array([*(getattr(robot, name) for name in names), 0.02])
    std = np.array([NOISE[unit] for unit in recorded.state_coordinates.units])

    def residuals(factors: Array) -> Array:
        *numbers, lag = factors * paper
        model = robot.dynamics.with_parameters(**dict(zip(names, numbers, strict=True)))
        forces = lagged(controls, robot.hover_force, plan.dt, lag)
        predicted = [model.step(x, u, plan.dt) for x, u in zip(measured[:-1], forces, strict=True)]
        return ((np.array(predicted) - measured[1:]) / std).ravel()

    found = least_squares(residuals, np.ones(4), bounds=(0.01, 100.0), x_scale=0.1)
    spread = float(np.sum(found.fun**2)) / (found.fun.size - 4)
    width = 1.96 * np.sqrt(spread * np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    paper_has = [*paper[:3], 0.0]
    return {
        name: [float(was), float(factor * scale), float(half * scale)]
        for name, was, factor, scale, half in zip((*names, "lag"), paper_has, found.x, paper, width, strict=True)
    }


def laws(
    plant: ls.Plant, robots: dict[str, ls.Quadrotor], lag: float, query: int, dt: float
) -> Iterator[tuple[str, str, ls.Solution, Callable[[str], ControllerLike | None]]]:
    """Numbers of the model, name, plan, and what flies it under a preset: a law is made for that which it meets."""
    for numbers, robot in robots.items():
        problem, known = problem_of(robot, query, dt), lag if numbers == "fitted" else 0.0
        stated = dict[str, Uncertainty]()
        for preset in PRESETS:
            disturbances = ls.disturbances.preset("calm" if preset == "undisturbed" else preset, plant)
            told = ls.uncertainty_of(ls.Plant(robot, plant.scene, plant.simulator), disturbances)
            stated[preset] = replace(told, lag=told.lag + known)
        if numbers == "on paper":
            yield numbers, "the policy of `smooth`", ls.smooth(problem), lambda preset: None
        make = gentle(robot, stated["light"])
        safe = ls.smooth_chance_constrained(problem, stated["light"], chance=CHANCE, controller=make)
        made = {preset: gentle(robot, told)(safe.problem, safe.solution) for preset, told in stated.items()}
        yield numbers, "`OffsetFree` on a safe plan", safe.solution, made.__getitem__


def of_query(
    plant: ls.Plant, robots: dict[str, ls.Quadrotor], lag: float, query: int, dt: float, config: Config
) -> list[tuple[str, str, str, list[bool], list[float]]]:
    """Numbers of the model, law, preset, whether each trial reaches the goal, and its largest error in m."""
    found = []
    for model, law, plan, controller_for in laws(plant, robots, lag, query, dt):
        for preset in PRESETS:
            disturbed = preset != "undisturbed"
            flown = ls.simulate(
                plant, plan, controller=controller_for(preset), seed=config.seed, frames=False,
                disturbances=ls.disturbances.preset(preset, plant) if disturbed else (),
                trials=config.trials if disturbed else 1, first_trial=query * config.trials if disturbed else 0,
            )  # fmt: skip
            counted = ls.stress.outcomes(flown)
            found.append((model, law, preset, (counted.outcome == "reached").tolist(), counted.worst.tolist()))
    return found


def of_simulator(name: Name, config: Config) -> dict[str, Any]:
    make, dt = SIMULATORS[name]
    simulator: Simulator = make()
    paper = make().quadrotor()
    plant = ls.Plant(paper, ls.load_scene("cage"), simulator)
    units = paper.dynamics.state_coordinates.units
    noise = [ls.disturbances.MeasurementNoise([NOISE[unit] for unit in units])]
    recorded = ls.simulate(plant, ls.smooth(problem_of(paper, 0, dt)), disturbances=noise, seed=config.seed)
    if not np.isfinite(recorded.measured).all():
        raise ls.InputError(f"{name}: got a recorded run that ended early, want a whole one")
    numbers = fit(paper, recorded)
    fitted = replace(paper, **{field: numbers[field][1] for field in ("mass", "inertia", "drag")})
    robots = {"on paper": paper, "fitted": fitted}
    rows: dict[tuple[str, str], dict[str, list[bool]]] = {}
    worst: dict[tuple[str, str], dict[str, list[float]]] = {}
    for query in progress(range(config.queries), name):
        for model, law, preset, reached, errors in of_query(plant, robots, numbers["lag"][1], query, dt, config):
            rows.setdefault((model, law), {}).setdefault(preset, []).extend(reached)
            worst.setdefault((model, law), {}).setdefault(preset, []).extend(errors)
    return {
        "simulator": simulator.name, "versions": dict(simulator.versions), "numbers": numbers,
        "rows": [
            {
                "model": model, "law": law,
                "reached": {
                    name: [100 * share for share in interval(rate(sum(ended), len(ended)))]
                    for name, ended in found.items()
                },
                "worst": float(np.median(worst[model, law]["light"])),
            }
            for (model, law), found in rows.items()
        ],
    }  # fmt: skip


def main(config: Config) -> Result:
    config = at_most(config, queries=1, trials=2)
    result = opening(config)
    for name in config.simulators:
        try:
            result[name] = of_simulator(name, config)
        except ls.InputError as error:
            result[name] = {"skipped": str(error)}
    return result


def report(result: Result) -> str:
    config = result["config"]
    noise = ", ".join(f"{value:g} {unit}" for unit, value in NOISE.items())
    lines = [
        "## Other simulators",
        "Plans and laws from `Quadrotor` with a vehicle's numbers, in the simulator that the vehicle is from:"
        f" {config['queries']} queries, {config['trials']} trials each. The numbers are fitted to one undisturbed run"
        f" of `smooth`'s policy, measured with a noise of {noise}; mass in kg, inertia about the level axes in kg m2,"
        " drag in N s/m, the rotors' lag in s, which the model does not have. The 95 % take residuals for independent,"
        " though each measurement is in two of them, and are wider than the spread of runs with other noise. Laws are"
        " made for the preset that they meet, undisturbed for calm.",
    ]
    for name in config["simulators"]:
        of = result[name]
        if "skipped" in of:
            lines.append(f"{name}: skipped: {of['skipped']}")
            continue
        numbers = [
            [field, f"{paper:.4g}", f"{found:.4g}", f"{half:.1g}"]
            for field, (paper, found, half) in of["numbers"].items()
        ]
        rows = [
            [f"{row['law']}, numbers {row['model']}"]
            + [f"{row['reached'][preset][0]:.0f}" for preset in PRESETS]
            + [f"{row['worst']:.2f}"]
            for row in of["rows"]
        ]
        best = of["rows"][-1]["reached"]
        wanted = "; ".join(
            f"{preset}: {between(best[preset], '.0f')} %, {judge(best[preset][0] >= least, f'{least:g} %')}"
            for preset, least in WANTED.items()
        )
        lines += [
            f"### {of['simulator']} {of['versions'][name]}",
            table(("number", "on paper", "fitted", "95 %, plus or minus"), numbers),
            table(("reached (%)", *PRESETS, "largest error at light (m), median"), rows),
            f"The last line, {wanted}.",
        ]
    return "\n\n".join(lines)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
