"""Plans that see: the outlook of the paper on belief space, beside iLQG in belief space, and what seeing is worth.

    python experiments/belief_space.py                                        # some minutes
    python experiments/belief_space.py --video docs/figures/belief_space.gif --flight docs/figures/belief_flight.gif

light     The light-dark domain and its car: the smoother beside iLQR in belief space, from the same starts; with the
          most likely readings also IPOPT, where CasADi is installed.
spread    The predicted spread of runs of a light-dark plan, against drawn runs, with the noise of readings at the mean
          of the belief and averaged over it.
drive     The packaged drive among pillars, three of them beacons, in MuJoCo: how often plans fail.
fly       The same of the packaged quadrotor among beams, with a beacon, and a covariance of its position alone.

The domains are Platt, Tedrake, Kaelbling and Lozano-Perez (2010), and van den Berg, Patil and Alterovitz (2012), with
the numbers of the public code of Abdulsamad (github.com/hanyas/trajopt).
"""

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from matplotlib.patches import Circle
from paper.common import figure, picture
from peers.common import Unavailable, casadi
from runner import FolderSettings, Result, at_most, between, interval, opening, run, table

import lqrsim as ls
from lqrsim.belief import Belief, BeliefFeedback, NoisySensors, ReadingErrors
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.stress.statistics import rate

Nominal = Callable[[ls.Trajectory], float]  # the cost of controls and end

BEACONS = (-0.95, -0.5), (-1.2, 0.8), (-1.1, 2.1)  # on three pillars
MODELS = Path(__file__).parents[1] / "models"
STARTS = 10
STRAYS = float(np.sqrt(5)), 0.5, 0.05  # m, of the start in the dark
MOST = 200  # iterations
SEEING, AT_END = 50.0, 2000.0  # weights of the variance of the position, along the way and at the end
CHANCE = 1e-4  # of touching one obstacle at one step
STRAY = 0.03  # m and rad, of the start
GOAL = {"x": 0.0, "y": 2.5, "heading": np.pi}
ENDS = {"x": 5000.0, "y": 5000.0, "heading": 50.0}
WEIGHTS = 10.0 ** np.linspace(0.6, 1.2, 25)  # of obstacles, for a plan that goes round them more widely
BEACON = 0.2, 2.6, 0.0  # m, between two beams and a wall
PERIOD, STEPS = 1 / 15, 75  # s, of the quadrotor
AWAY, POSITION = 10.0, 200.0  # its weights of obstacles, and of the variance of the position
FLIGHTS = np.linspace(10.0, 16.0, 7)  # of obstacles
OFF, DRIFT = 0.05, 0.2  # m and m/s: standard deviations of its start, and of its measured velocities


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    out: Path = Path("runs/belief_space")
    """Folder for the figure, in a folder of that name."""
    trials: int = 300
    """Of each plan in MuJoCo."""
    drawn: int = 10_000
    """Runs of the light-dark plan."""
    video: Path | None = None
    """FILE.gif or FILE.mp4 of two plans of the drive."""
    flight: Path | None = None
    """The same of the quadrotor."""


def light(x: Any, u: Any, p: Any) -> list[Any]:
    """Both coordinates; the noise of the first grows with the distance from the light, as a variance."""
    from sympy import sqrt

    return [(x.x, sqrt(p.floor + (p.light - x.x) ** 2 / 2)), (x.y, sqrt(p.floor))]


LIGHT = NoisySensors(light, parameters={"floor": 1e-4, "light": 5.0})


def light_dark(stray: float = float(np.sqrt(5)), *, averaged: bool = False) -> ls.Problem:
    """A point that is told its velocity; light at 5 m, the start at 2 m, known within `stray`, and the goal at 0."""

    def point(x: Any, u: Any, p: Any) -> list[Any]:
        return [x.x + u.vx, x.y + u.vy]

    dynamics = ls.Dynamics(point, states={"x": "m", "y": "m"}, controls={"vx": "m/s", "vy": "m/s"}, period=1.0)
    belief = Belief(dynamics, dt=1.0, noise=ls.Noise(1e-4 * np.eye(2)), sensors=LIGHT, averaged=averaged)
    off = ls.QuadraticCost({"x": 1, "y": 1} | belief.uncertainty({"x": 400}), about={})
    return ls.Problem(
        dynamics=belief, dt=1.0, steps=25, initial=ls.FixedState(belief.state([2, 2], [stray, 1e-4])),
        stage_cost=ls.ControlCost([1.0, 1.0]) + off, final_cost=off, noise=belief.innovations,
    )  # fmt: skip


def car() -> ls.Problem:
    """A car, 0.1 m long, in the same light."""

    def step(x: Any, u: Any, p: Any) -> list[Any]:
        from sympy import cos, sin, tan

        way, turn = 0.5 * x.speed, 0.5 * x.speed * tan(u.steering) / 0.1
        return [x.x + way * cos(x.heading), x.y + way * sin(x.heading), x.heading + turn, x.speed + 0.5 * u.gas]

    states = {"x": "m", "y": "m", "heading": "rad", "speed": "m/s"}
    dynamics = ls.Dynamics(step, states=states, controls={"gas": "m/s^2", "steering": "rad"}, period=0.5)
    belief = Belief(dynamics, dt=0.5, noise=ls.Noise(0.01 * np.eye(4)), sensors=LIGHT)
    along, at_end = (belief.uncertainty(dict.fromkeys(states, weight)) for weight in (2.0, 200.0))
    return ls.Problem(
        dynamics=belief, dt=0.5, steps=30, initial=ls.FixedState(belief.state([2, 2, 0, 0], np.ones(4))),
        stage_cost=ls.ControlCost([2.0, 2.0]) + ls.QuadraticCost(along, about={}),
        final_cost=ls.QuadraticCost(dict.fromkeys(states, 200.0) | at_end, about={}), noise=belief.innovations,
    )  # fmt: skip


def starts_of(problem: ls.Problem, starts: int) -> list[np.ndarray]:
    """Zero controls, and drawn ones."""
    rng, size = np.random.default_rng(0), (problem.steps, len(problem.dynamics.control_coordinates))
    return [np.zeros(size), *(0.1 * rng.normal(size=size) for _ in range(starts - 1))]


def by_ipopt(name: str, problem: ls.Problem, starts: int) -> list[Result]:
    """IPOPT on `light_dark` with the most likely readings, by multiple shooting, from the trajectories of the starts.

    Its Kalman filter is one of matrices, written for itself. Raises Unavailable without CasADi.
    """
    ca, belief = casadi(), belief_of(problem)
    x, u, n = ca.SX.sym("x", 5), ca.SX.sym("u", 2), belief.size
    root, place = ca.SX(n, n), [(i, j) for i in range(n) for j in range(i + 1)]
    for entry, at in enumerate(place):
        root[at] = x[n + entry]
    mean, floor = x[:n] + u, LIGHT.parameters["floor"]
    noise = ca.diag(ca.vertcat(floor + (LIGHT.parameters["light"] - mean[0]) ** 2 / 2, floor))
    predicted = root @ root.T + 1e-8 * ca.SX.eye(n)
    after = ca.chol(predicted - predicted @ ca.solve(predicted + noise, predicted)).T
    step = ca.Function("step", [x, u], [ca.vertcat(mean, *[after[at] for at in place])])
    weights = ca.vertcat(1, 1, 400, 0, 0)
    w = ca.MX.sym("w", 7, problem.steps)  # of a step: its control, and the belief after it
    first = problem.start
    assert first is not None
    before = ca.horzcat(first, w[2:, :-1])
    cost = (ca.sumsqr(w[:2, :]) + ca.sum2(weights.T @ before**2) + weights.T @ w[2:, -1] ** 2) / 2
    gaps = ca.vec(w[2:, :] - step.map(problem.steps)(before, w[:2, :]))
    options = {"print_time": False, "expand": True, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": MOST}}
    solver = ca.nlpsol("solver", "ipopt", {"x": ca.vec(w), "f": cost, "g": gaps}, options)
    rows = []
    for start, controls in enumerate(starts_of(problem, starts)):
        states = [first]
        for control in controls:
            states.append(belief.step(states[-1], control, problem.dt))
        began = time.perf_counter()
        found = solver(x0=np.hstack([controls, states[1:]]).ravel(), lbg=0.0, ubg=0.0)
        seconds, stats = time.perf_counter() - began, solver.stats()
        rows.append({
            "problem": name, "solver": "IPOPT", "start": start,
            "status": "CONVERGED" if stats["success"] else stats["return_status"], "cost": float(found["f"]),
            "iterations": stats["iter_count"], "seconds": seconds,
        })  # fmt: skip
    return rows


def compared(name: str, problem: ls.Problem, starts: int) -> list[Result]:
    """Both solvers from the same controls. Each is compiled before it is timed."""
    given, rows = starts_of(problem, starts), []
    for solver, solve in (("smooth", ls.smooth), ("ilqr", ls.ilqr)):
        solve(problem, start=given[0], max_iterations=1)
        for start, controls in enumerate(given):
            began = time.perf_counter()
            found = solve(problem, start=controls, max_iterations=MOST)
            rows.append({
                "problem": name, "solver": solver, "start": start, "status": found.status.name,
                "cost": found.cost if np.isfinite(found.cost) else None, "iterations": len(found.iterations),
                "seconds": time.perf_counter() - began,
            })  # fmt: skip
    return rows


def spread(problem: ls.Problem, solution: ls.Solution, trials: int) -> Result:
    """Standard deviations of the light-dark plan's end: of the state about the plan, and of the filter's error."""
    belief, plan, rng = belief_of(problem), solution.trajectory, np.random.default_rng(1)
    n, policy = belief.size, solution.policy
    known = belief.covariance(plan.states[-1])
    beliefs = np.tile(plan.states[0], (trials, 1))
    root = np.linalg.cholesky(belief.covariance(plan.states[0]))
    states = plan.states[0, :n] + rng.normal(size=(trials, n)) @ root.T
    for t in range(plan.steps):
        controls = beliefs @ policy.gain[t].T + policy.offset[t]
        states = states + controls + 1e-4 * rng.normal(size=(trials, n))
        exact, deviations = belief.read(states)
        beliefs = belief.corrected(beliefs, controls, exact + deviations * rng.normal(size=exact.shape))
    found = {"of the state about the plan": states - plan.states[-1, :n], "of the filter": states - beliefs[:, :n]}
    said = {"of the state about the plan": ls.predict_tube(problem, solution).covariance[-1], "of the filter": known}
    return {what: {"said": float(np.sqrt(said[what][0, 0])), "found": deviation(off[:, 0])}
            for what, off in found.items()}  # fmt: skip


def deviation(sample: np.ndarray) -> list[float]:
    """A standard deviation about 0 with its interval of 95 %.

    The interval is by the sample's own fourth moment: a filter that is lost in some runs leaves tails that are heavier
    than a normal distribution's.
    """
    squares = sample**2
    variance = float(squares.mean())
    value, error = np.sqrt(variance), 1.96 * squares.std() / (2 * variance * np.sqrt(len(sample)))
    return [float(value * np.exp(side * error)) for side in (0, -1, 1)]


def belief_of(problem: ls.Problem) -> Belief:
    assert isinstance(problem.dynamics, Belief)
    return problem.dynamics


def beacons(x: Any, u: Any, p: Any) -> list[Any]:
    """The position relative to the beacons, measured the worse the farther these are."""
    found = []
    for a, b in BEACONS:
        deviation = p.least + p.growth * ((x.x - a) ** 2 + (x.y - b) ** 2)
        found += [(x.x - a, deviation), (x.y - b, deviation)]
    return found


def slips(x: Any, u: Any, p: Any) -> list[Any]:
    """Noise along the way, and of the heading."""
    from sympy import cos, sin

    return [[p.along * cos(x.heading), 0], [p.along * sin(x.heading), 0], [0, p.turn]]


def drives(world: ls.World) -> dict[str, ls.Problem]:
    """The packaged drive among its pillars: without an eye on what it will see, with one, and with chances."""
    scenario = ls.scenarios.differential_drive()
    problem, radius = scenario.problem, scenario.robot.radius
    sensors = NoisySensors(beacons, parameters={"least": 0.01, "growth": 0.4})
    noise = ls.Noise(slips, size=2, parameters={"along": 0.005, "turn": 0.01})
    belief = Belief(scenario.robot.dynamics, dt=problem.dt, noise=noise, sensors=sensors)
    blind = ls.Problem(
        dynamics=belief, dt=problem.dt, steps=problem.steps, stage_cost=problem.stage_cost,
        initial=ls.FixedState(belief.state([0.0, -2.5, np.pi], [STRAY] * 3)),
        final_cost=ls.QuadraticCost(ENDS, about=GOAL),
    )  # fmt: skip
    along, at_end = (belief.uncertainty({"x": weight, "y": weight}) for weight in (SEEING, AT_END))
    seeing = dataclasses.replace(
        blind, stage_cost=blind.stage_cost + ls.QuadraticCost(along, about={}), noise=belief.innovations,
        final_cost=ls.QuadraticCost(ENDS | at_end, about=GOAL),
    )  # fmt: skip
    pillars = [tuple(one.position[:2]) for one in world.obstacles if one.kind == "cylinder"]

    def clear(x: Any, u: Any, p: Any) -> list[Any]:
        from sympy import sqrt

        return [sqrt((x.x - a) ** 2 + (x.y - b) ** 2) - p.apart for a, b in pillars]

    chance = belief.chance_constraint(clear, chance=CHANCE, parameters={"apart": radius + 0.2})
    return {
        "without seeing": blind,
        "with seeing": seeing,
        "with seeing, chances of pillars": dataclasses.replace(seeing, constraints=[chance]),
    }


def nominal(plan: ls.Trajectory) -> float:
    """The cost of a plan's mean without obstacles and variances: that of controls and of the end."""
    off = plan.states[-1, :3] - list(GOAL.values())
    return float(30 * np.sum((plan.controls - 0.25) ** 2) + 0.5 * off @ (list(ENDS.values()) * off))


def wider(wide: Callable[[float], ls.Problem], weights: Array, measure: Nominal, cost: float) -> ls.Solution:
    """The plan without seeing, of those by weights of obstacles, whose nominal cost is nearest to this one."""
    found = [plan for weight in weights if (plan := ls.smooth(wide(float(weight)))).success]
    return min(found, key=lambda plan: abs(measure(plan.trajectory) - cost))


def scene() -> ls.Scene:
    """The arena, with the pillars that are beacons in another colour, and light about them, which is only drawn."""
    spec = mujoco.MjSpec.from_file(str(MODELS / "arena.xml"))
    for geom in spec.geoms:
        if any(np.allclose(geom.pos[:2], place) for place in BEACONS) and geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER:
            geom.material, geom.rgba = "", [1.0, 0.75, 0.1, 1.0]
    for i, (x, y) in enumerate(BEACONS):
        for k, size in enumerate((0.35, 0.5, 0.65)):
            spec.worldbody.add_geom(
                name=f"light_{i}_{k}", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[size, 0.001, 0],
                pos=[x, y, 0.001 * (k + 1)], rgba=[1.0, 0.8, 0.1, 0.25], contype=0, conaffinity=0,
            )  # fmt: skip
    return scene_from_xml(spec.to_xml(), "arena")


def driven(config: Config, result: Result) -> list[Result]:
    """How often each plan fails in MuJoCo, with the same filter, noise and readings."""
    plant = ls.Plant(ls.DifferentialDrive(), scene())
    problems = drives(plant.world)
    plans = {name: (problem, ls.smooth(problem)) for name, problem in problems.items()}
    blind, cost = problems["without seeing"], nominal(plans["with seeing"][1].trajectory)

    def wide(weight: float) -> ls.Problem:
        away = ls.ObstacleCost(plant.world, radius=plant.robot.radius, sharpness=10.0, weight=weight)
        return dataclasses.replace(blind, stage_cost=ls.ControlCost([60.0, 60.0], about=[0.25, 0.25]) + away)

    plans["without seeing, wider"] = blind, wider(wide, WEIGHTS, nominal, cost)
    belief = belief_of(blind)
    met = [ls.disturbances.InitialStateError(STRAY), belief.process, ReadingErrors(belief)]
    draw(config, result, plant.world, plans)
    view = {"camera": "top", "size": (560, 316), "fps": 8, "speed": 3.0}
    return tried(config, plant, plans, met, nominal, config.video, view)


def tried(
    config: Config, plant: ls.Plant, plans: dict[str, tuple[ls.Problem, ls.Solution]], met: list[Any], measure: Nominal,
    video: Path | None, view: dict[str, Any],
) -> list[Result]:  # fmt: skip
    """Rates of plans' outcomes, beside what is predicted; and a video of a trial that seeing saves."""
    rows, shown = list[Result](), dict[str, ls.Rollout]()
    for name, (problem, plan) in plans.items():
        law, tube, belief = BeliefFeedback(problem, plan), ls.predict_tube(problem, plan), belief_of(problem)
        runs = ls.simulate(plant, controller=law, disturbances=met, trials=config.trials, frames=video is not None)
        place = list(belief.robot.state_coordinates.position)
        known = np.sqrt(np.einsum("tii->ti", belief.covariance(plan.trajectory.states))[:, place].sum(axis=1))
        fails = {how: runs.outcome.count(how) for how in ("reached", "collided", "timed out")}
        rows.append({
            "plan": name, "status": plan.status.name, "iterations": len(plan.iterations),
            "nominal": measure(plan.trajectory), "deviation": float(known.max()), "end": float(known[-1]),
            "predicted": tube.collision_chance,
        } | {how: interval(rate(count, config.trials)) for how, count in fails.items()})  # fmt: skip
        shown[name] = tube.added_to(runs)
    if video is not None:
        names = "without seeing", "with seeing"
        lost = [np.array([one != "reached" for one in shown[name].outcome]) for name in names]
        trial = int(np.argmax(lost[0] & ~lost[1]))
        ls.render([shown[name] for name in names], video, trial=trial, titles=names,
                  overlays=("plan", "trace", "tube", "caption"), **view)  # fmt: skip
    return rows


def beacon(x: Any, u: Any, p: Any) -> list[Any]:
    """The position relative to the beacon, measured the worse the farther it is."""
    off = [one - there for one, there in zip((x.x, x.y, x.z), BEACON, strict=True)]
    deviation = p.least + p.growth * sum(one**2 for one in off)
    return [(one, deviation) for one in off]


def beacon_and_speed(x: Any, u: Any, p: Any) -> list[Any]:
    """The same, and the velocity."""
    return [*beacon(x, u, p), (x.vx, p.drift), (x.vy, p.drift), (x.vz, p.drift)]


def errors_of_filters(plant: ls.Plant, problem: ls.Problem, plan: ls.Solution, met: list[Any], trials: int) -> Result:
    """Root mean square errors of the position in runs: of the plan's filter, and of one with velocities, too.

    The second reads what the first takes as known, and assumes little noise: the model is that of the plant.
    """
    belief, law = belief_of(problem), BeliefFeedback(problem, plan)
    run = ls.simulate(plant, controller=law, disturbances=met, trials=trials, frames=False, contacts=False)
    good = np.array(run.outcome) == "reached"
    states, controls = run.states[good], run.applied[good]
    more = Belief(
        belief.robot, dt=PERIOD, noise=ls.Noise(np.diag(np.repeat([1e-3, 1e-2, 0.0, 0.0], 3))),
        sensors=NoisySensors(beacon_and_speed, parameters=belief.sensors.parameters | {"drift": DRIFT}),
        uncertain=belief.robot.state_coordinates.names[:6],
    )  # fmt: skip
    first = more.state(run.plan.states[0], np.repeat([OFF, 0.01, 0.0, 0.0], 3))
    beliefs, found, rng = np.tile(first, (len(states), 1)), list[Array](), np.random.default_rng(3)
    for t in range(problem.steps):
        found.append(beliefs[:, :3])
        exact, deviations = more.read(states[:, t + 1])
        beliefs = more.corrected(beliefs, controls[:, t], exact + deviations * rng.normal(size=exact.shape))
        beliefs[:, more.known] = states[:, t + 1, more.known]
    each = {"position": run.controller_run.beliefs[:, good, :3], "position and velocity": np.array(found)}
    true = states[:, :-1, :3].swapaxes(0, 1)
    return {what: float(np.sqrt(np.mean(np.sum((means - true) ** 2, axis=2)))) for what, means in each.items()}


def cage() -> ls.Scene:
    """The cage of beams with the beacon and light about it, which are only drawn."""
    spec = mujoco.MjSpec.from_file(str(MODELS / "cage.xml"))
    for k, (size, opacity) in enumerate(((0.1, 1.0), (0.4, 0.3), (0.7, 0.2))):
        spec.worldbody.add_geom(
            name=f"light_{k}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[size, 0, 0], pos=BEACON,
            rgba=[1.0, 0.8, 0.1, opacity], contype=0, conaffinity=0,
        )  # fmt: skip
    return scene_from_xml(spec.to_xml(), "cage")


def flown(config: Config) -> tuple[list[Result], Result]:
    """The same for the quadrotor, which measures its attitude well, its velocity badly, and its position by a beacon.

    The belief has a covariance of the position alone, which drifts with the noise of the measured velocity.
    """
    scenario = ls.scenarios.quadrotor()
    robot, plant = scenario.robot, ls.Plant(scenario.robot, cage())
    start, goal = scenario.problem.start, scenario.problem.weighed_goal
    assert start is not None
    assert goal is not None
    names, first = robot.dynamics.state_coordinates.names, np.repeat([OFF, 0.0, 0.0, 0.0], 3)
    belief = Belief(
        robot.dynamics, dt=PERIOD, noise=ls.Noise(np.diag(np.repeat([DRIFT * PERIOD, 0.0, 0.0, 0.0], 3))),
        sensors=NoisySensors(beacon, parameters={"least": 0.02, "growth": 0.3}), uncertain=("x", "y", "z"),
    )  # fmt: skip
    effort = ls.ControlCost(np.full(4, 20.0), about=np.full(4, ls.Quadrotor().hover_force))
    ends, about = dict.fromkeys(names, 500.0), dict(zip(names, goal.tolist(), strict=True))

    def wide(weight: float) -> ls.Problem:
        away = ls.ObstacleCost(plant.world, radius=robot.radius, sharpness=10.0, weight=weight)
        return ls.Problem(
            dynamics=belief, dt=PERIOD, steps=STEPS, initial=ls.FixedState(belief.state(start, first)),
            stage_cost=effort + away, final_cost=ls.QuadraticCost(ends, about=about),
        )  # fmt: skip

    def measure(plan: ls.Trajectory) -> float:
        off = plan.states[-1, :12] - goal
        return float(10 * np.sum((plan.controls - ls.Quadrotor().hover_force) ** 2) + 250 * off @ off)

    blind = wide(AWAY)
    along, at_end = (belief.uncertainty(dict.fromkeys("xyz", weight)) for weight in (POSITION, 500.0))
    seeing = dataclasses.replace(
        blind, stage_cost=blind.stage_cost + ls.QuadraticCost(along, about={}), noise=belief.innovations,
        final_cost=ls.QuadraticCost(ends | at_end, about=about),
    )  # fmt: skip
    plans = {name: (one, ls.smooth(one)) for name, one in (("without seeing", blind), ("with seeing", seeing))}
    cost = measure(plans["with seeing"][1].trajectory)
    plans["without seeing, wider"] = blind, wider(wide, FLIGHTS, measure, cost)
    met = [
        ls.disturbances.InitialStateError(tuple(first.tolist())), ReadingErrors(belief),
        ls.disturbances.MeasurementNoise((0.0,) * 3 + (DRIFT,) * 3 + (0.0,) * 6),
    ]  # fmt: skip
    view = {"camera": "top", "size": (640, 460), "fps": 8, "speed": 1.0}
    rows = tried(config, plant, plans, met, measure, config.flight, view)
    return rows, errors_of_filters(plant, *plans["with seeing"], met, config.trials)


def draw(config: Config, result: Result, world: ls.World, plans: dict[str, tuple[ls.Problem, ls.Solution]]) -> None:
    """The plans with two standard deviations of what they know, over how well the best beacon is seen."""
    x, y = np.meshgrid(np.linspace(-2, 2, 161), np.linspace(-3, 3, 241))
    near = np.min([(x - a) ** 2 + (y - b) ** 2 for a, b in BEACONS], axis=0)
    with figure(config, result, "belief_space", (10, 4.4)) as drawn:
        panes = drawn.subplots(1, len(plans), sharey=True)
        for pane, (name, (problem, plan)) in zip(panes, plans.items(), strict=True):
            pane.pcolormesh(x, y, np.log(0.01 + 0.4 * near), cmap="cividis_r", shading="gouraud", rasterized=True)
            for one in world.obstacles:
                if one.kind == "cylinder":
                    pane.add_patch(Circle(tuple(one.position[:2]), 0.2, color="0.35"))
            states = plan.trajectory.states
            for place, covariance in zip(
                states[::6, :2], belief_of(problem).covariance(states)[::6, :2, :2], strict=True
            ):
                circle = np.linspace(0, 2 * np.pi, 40)
                ring = place[:, None] + 2 * np.linalg.cholesky(covariance) @ [np.cos(circle), np.sin(circle)]
                pane.plot(*ring, color="white", linewidth=0.7)
            pane.plot(*states[:, :2].T, color="C3", linewidth=1.2)
            pane.plot(*np.transpose(BEACONS), "*", color="gold", markersize=9, markeredgecolor="black")
            pane.set(title=name, xlabel="x (m)", aspect="equal", xlim=(-2, 2), ylim=(-3, 3))
            pane.title.set_fontsize(8)
        panes[0].set_ylabel("y (m)")
        drawn.set_layout_engine("tight")


def main(config: Config) -> Result:
    config = at_most(config, trials=3, drawn=200)
    result, starts = opening(config), 2 if config.quick else STARTS
    problems = {"light-dark": light_dark()} | ({} if config.quick else {"car": car()})
    likely, problem = "light-dark, most likely readings", dataclasses.replace(light_dark(), noise=None)
    result["light"] = compared(likely, problem, starts)
    with contextlib.suppress(Unavailable):
        result["light"] += by_ipopt(likely, problem, starts)
    result["light"] += [row for name, one in problems.items() for row in compared(name, one, starts)]
    result["spread"] = []
    for averaged, stray in itertools.product((False, True), STRAYS):
        problem = light_dark(stray, averaged=averaged)
        said = {"noise": "averaged" if averaged else "at the mean", "stray": stray}
        result["spread"].append(said | spread(problem, ls.smooth(problem), config.drawn))
    result["drive"] = driven(config, result)
    result["fly"], result["filters"] = flown(config)
    return result


def report(result: Result) -> str:
    solvers = []
    for name, solver in dict.fromkeys((row["problem"], row["solver"]) for row in result["light"]):
        own = [row for row in result["light"] if (row["problem"], row["solver"]) == (name, solver)]
        good = [row for row in own if row["status"] == "CONVERGED"]
        middle = {
            key: np.median([row[key] for row in good]) if good else np.nan for key in ("cost", "iterations", "seconds")
        }
        least = min((row["cost"] for row in good), default=np.nan)
        most = max((row["cost"] for row in good), default=np.nan)
        solvers.append([
            name, f"`{solver}`", f"{len(good)} of {len(own)}", f"{least:.6g}", f"{most:.6g}",
            f"{middle['cost']:.6g}", f"{middle['iterations']:.0f}", f"{middle['seconds']:.3f}",
        ])  # fmt: skip
    spreads = [
        [f"{row['stray']:.2f}", row["noise"], what, f"{row[what]['said']:.4f}", between(row[what]["found"], ".4f")]
        for row in result["spread"] for what in row if what not in ("stray", "noise")
    ]  # fmt: skip
    tables = {
        name: [
            [row["plan"], f"{row['nominal']:.1f}", f"{row['deviation']:.3f}", f"{row['end']:.3f}",
             f"{100 * row['predicted']:.1f}",
             *(between([100 * part for part in row[how]], ".1f") for how in ("collided", "reached", "timed out"))]
            for row in result[name]
        ] for name in ("drive", "fly")
    }  # fmt: skip
    headings = ("plan", "nominal cost", "largest deviation (m)", "at the end (m)", "predicted to collide (%)",
                "collided (%)", "reached (%)", "timed out (%)")  # fmt: skip
    return "\n\n".join([
        "## Plans that see",
        "The light-dark domain and its car, from zero and random controls. Costs are expectations; medians are of the"
        f" solves that converged within {MOST} iterations.",
        table(("problem", "solver", "converged", "least cost", "highest cost", "median cost", "iterations", "s"),
              solvers),
        f"Standard deviation (m) of x at the end of the light-dark plan, predicted and in {result['config']['drawn']}"
        " drawn runs, by that of the start, with the noise of readings taken at the mean or averaged over the belief:",
        table(("start (m)", "noise of readings", "what", "predicted", "found, 95 %"), spreads),
        f"The differential drive in MuJoCo, {result['config']['trials']} trials of each plan, all with the same filter,"
        " noise and readings. The nominal cost is that of controls and end; deviations are of the position.",
        table(headings, tables["drive"]),
        "The quadrotor in the same way. It measures its attitude well and its velocity badly, and sees its position"
        " by a beacon; its belief has a covariance of the position alone.",
        table(headings, tables["fly"]),
        "Root mean square error of the position along runs with seeing that arrive, by what the filter has a covariance"
        f" of: {', '.join(f'{what} {error:.3f} m' for what, error in result['filters'].items())}.",
        picture(result, "belief_space",
                "Plans, what they know within two standard deviations, and how well beacons are seen"),
    ])  # fmt: skip


if __name__ == "__main__":
    run(Config, main, report, __doc__)
