"""Plans of the quadrotor that know what a trial meets, which bound what any law can do.

They know the wind and the forces to come, the mass, inertia and thrust, how the rotors lag, where the trial begins and
where the obstacles are.

Drag is linear, so a known force moves the robot by a known way whatever it does. In the frame that moves along, the
dynamics have no force, and the obstacles and the goal move instead.

Each plan is a local solution, so that their number is an estimate of the bound, from below. A plan counts if its
commands, without any feedback, reach the goal in MuJoCo, in the trial that it was made for. Noise and losses of
commands are left out there: feedback that knows them would undo them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim import rotations
from lqrsim.control.controllers import Controller, ControllerRun
from lqrsim.disturbances import CommandDropouts, ControlNoise, Disturbance, MotorLag
from lqrsim.errors import Array
from lqrsim.problem.parts import terms_of
from lqrsim.results.archive import sha256
from lqrsim.results.coordinates import Coordinates
from lqrsim.simulation.disturbances.base import seeded
from robust.common import Reached, reached, run

WEIGHTS = (10.0, 100.0)  # of the obstacles, relative to the problem's own: what is tried for each trial
HELD = 1e4  # weight of the place at the end
LEFT_OUT = CommandDropouts, ControlNoise


@dataclass(frozen=True)
class Fate:
    """What one trial meets.

    Attributes:
      start: (12,). force: in N, in each control period, (T, 3). displaced: of each obstacle in m, (O, 3).
      factors: of mass, inertia and each rotor's thrust, as `Effect.factors`.
    """

    start: Array
    force: Array
    displaced: Array
    factors: Mapping[str, Array]


def fates(
    plant: ls.Plant, plan: ls.Solution, disturbances: Sequence[Disturbance], trials: int, seed: int
) -> list[Fate]:
    """What the trials 0 to K - 1 of a run with that seed meet."""
    of, trajectory = seeded(seed), plan.trajectory
    starts = np.tile(trajectory.states[0], (trials, 1))
    planned = np.repeat(trajectory.states[:-1, None], trials, axis=1)
    force, displaced = np.zeros((trials, trajectory.steps, 3)), np.zeros((trials, len(plant.world), 3))
    factors = {"mass": np.ones((trials, 1)), "inertia": np.ones((trials, 1)), "thrust": np.ones((trials, 4))}
    for stream, one in enumerate(disturbances):
        effect = one.start(plant, trajectory, [of(trial, stream) for trial in range(trials)])
        if effect.initial_states is not None:
            starts = effect.initial_states(starts)
        if effect.displaced is not None:
            displaced = displaced + effect.displaced
        for name, factor in (effect.factors or {}).items():
            factors[name] = factors[name] * factor
        for hook, times in ((effect.force, 1.0), (effect.wind, plant.robot.drag)):
            if hook is not None:
                force += times * np.stack([hook(t, planned[t]) for t in range(trajectory.steps)], axis=1)
    each = ({name: factor[k] for name, factor in factors.items()} for k in range(trials))
    return [Fate(starts[k], force[k], displaced[k], own) for k, own in enumerate(each)]


def lagging(robot: ls.Quadrotor, lag: float, factors: Mapping[str, Array]) -> ls.Dynamics:
    """The quadrotor without forces, with rotors that follow their commands by a lag, as its last four states."""
    own, limits = robot.dynamics, robot.dynamics.control_coordinates
    space = own.state_coordinates

    def rate(x: Any, u: Any, p: Any) -> list[Any]:
        velocity, rotation, w, reached = x[3:6], x[6:9], x[9:12], x[12:16]
        f = [reached[i] * getattr(p, f"thrust_{i}") for i in range(4)]
        thrust = rotations.rotate(rotation, [0, 0, sum(f)])
        acceleration = [(thrust[i] - p.drag * velocity[i]) / p.mass for i in range(3)]
        acceleration[2] -= p.gravity
        torque = [p.arm * (f[1] - f[3]), p.arm * (f[2] - f[0]), p.torque_ratio * (f[0] - f[1] + f[2] - f[3])]
        turning = [*rotations.vector_rate(rotation, w), *(one / p.inertia for one in torque)]
        return [*velocity, *acceleration, *turning, *((u[i] - reached[i]) / p.lag for i in range(4))]

    numbers = dict(own.parameters) | {"lag": lag}
    numbers |= {name: own.parameters[name] * float(factors[name][0]) for name in ("mass", "inertia")}
    numbers |= {f"thrust_{i}": float(factors["thrust"][i]) for i in range(4)}
    return ls.Dynamics(
        rate,
        states=dict(zip(space.names, space.units, strict=True)) | {f"reached_{i}": "N" for i in range(4)},
        controls=dict(zip(limits.names, limits.units, strict=True)),
        parameters=numbers, position=("x", "y", "z"), rotation_vectors=(("rx", "ry", "rz"),),
        control_limits=(limits.low, limits.high),
    )  # fmt: skip


class Drifting(ls.World):
    """Obstacles that are where a table says, at multiples of the control period."""

    ways: Array  # (T+1, O, 3)
    dt: float
    moving = True  # pyright: ignore[reportAssignmentType, reportIncompatibleVariableOverride]

    @classmethod
    def of(cls, world: ls.World, ways: Array, dt: float) -> "Drifting":
        made = cls(world.obstacles)
        vars(made).update(ways=ways, dt=dt)
        return made

    def displacements(self, times: Any) -> Array:
        knots = np.rint(np.asarray(times) / self.dt).astype(int)
        return self.ways[np.clip(knots, 0, len(self.ways) - 1)]

    def moved(self, seconds: float) -> ls.World:
        away = self.displacements([seconds])[0]
        pairs = zip(self.obstacles, away, strict=True)
        return ls.World([replace(one, position=one.position + by) for one, by in pairs])


def way_of(force: Array, mass: float, drag: float, dt: float) -> tuple[Array, Array]:
    """By how much a force that is constant in each control period, (T, 3), moves what is at rest, and how fast.

    Returns:
      Way in m and velocity in m/s, (T+1, 3) each.
    """
    way, velocity, decay = np.zeros((len(force) + 1, 3)), np.zeros((len(force) + 1, 3)), drag / mass
    kept = np.exp(-decay * dt)
    for t, one in enumerate(force):
        last = one / drag  # the velocity that it would lead to
        way[t + 1] = way[t] + last * dt + (velocity[t] - last) * (1 - kept) / decay
        velocity[t + 1] = last + (velocity[t] - last) * kept
    return way, velocity


class Foreseen(Controller):
    """Commands (K, T, m), one sequence for each trial."""

    def __init__(self, commands: Array, coordinates: tuple[Coordinates, Coordinates]) -> None:
        self.commands, self._coordinates = commands, coordinates

    def start(self, trials: int) -> ControllerRun:
        return _Run(self.commands)

    @property
    def digest(self) -> str:
        return sha256(self.commands)[:16]

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        return self._coordinates


class _Run(ControllerRun):
    def __init__(self, commands: Array) -> None:
        self.commands = commands

    def control(self, step: int, measured: Array) -> Array:
        return self.commands[:, step].copy()


def commands_for(
    plant: ls.Plant, problem: ls.Problem, fate: Fate, begun: ls.Trajectory, first: Array, lag: float, times: float
) -> Array:  # fmt: skip
    """The commands (T, m) of a plan for one trial.

    Args:
      begun: states and commands of a run in that trial, to begin from.
      first: (m,), of the rotors at the start.
      times: factor of the obstacles' weight.
    """
    robot, goal = plant.robot, problem.goal
    assert isinstance(robot, ls.Quadrotor)
    assert goal is not None
    dynamics, dt = lagging(robot, lag, fate.factors), problem.dt
    way, drift = way_of(fate.force, dynamics.parameters["mass"], robot.drag, dt)
    obstacles = Drifting.of(plant.world, fate.displaced - way[:, None], dt)
    (cost,) = problem.obstacle_costs
    away = ls.ObstacleCost(obstacles, radius=robot.radius, sharpness=cost.sharpness, weight=times * cost.weight)
    (control,) = [one for one in terms_of(problem.stage_cost) if isinstance(one, ls.ControlCost)]
    weight, hover = np.zeros(16), np.full(4, robot.hover_force)
    weight[:3], weight[3:12] = HELD, 1.0
    reached = np.empty((problem.steps + 1, 4))
    reached[0] = first
    for t, command in enumerate(begun.controls):
        reached[t + 1] = command + np.exp(-dt / lag) * (reached[t] - command)
    start = np.concatenate([begun.states - np.pad(np.hstack([way, drift]), ((0, 0), (0, 6))), reached], axis=1)
    foreseen = ls.Problem(
        dynamics=dynamics, dt=dt, steps=problem.steps, initial=ls.FixedState(start[0]), stage_cost=control + away,
        final_cost=ls.QuadraticCost(weight, about=np.concatenate([goal[:3] - way[-1], np.zeros(9), hover])),
    )  # fmt: skip
    guess = ls.Trajectory(start, begun.controls, dt)
    return ls.smooth(foreseen, start=guess, max_iterations=100, threads=1).trajectory.controls


def possible(
    plant: ls.Plant, problem: ls.Problem, solution: ls.Solution, law: Controller, disturbances: Sequence[Disturbance],
    *, trials: int, seed: int,
) -> Reached:  # fmt: skip
    """Which of the trials have a plan that reaches the goal.

    It is sought from a run of a causal law in the trial, which counts, too, if it reaches the goal.
    """
    kept = [one.scaled(0.0) if isinstance(one, LEFT_OUT) else one for one in disturbances]
    (lag,) = [one.time_constant for one in disturbances if isinstance(one, MotorLag)]
    met, policy = fates(plant, solution, kept, trials, seed), solution.policy
    by_law = run(plant, solution, law, kept, trials=trials, seed=seed)
    found = np.array(ls.stress.outcomes(by_law).outcome) == "reached"
    for times in WEIGHTS:
        commands = by_law.commanded.copy()
        for k in np.flatnonzero(~found):
            finite = np.isfinite(by_law.states[k]).all() and np.isfinite(by_law.commanded[k]).all()
            own = ls.Trajectory(by_law.states[k], by_law.commanded[k], problem.dt)
            begun = own if finite else solution.trajectory
            commands[k] = commands_for(plant, problem, met[k], begun, solution.trajectory.controls[0], lag, times)
        foreseen = Foreseen(commands, (policy.state_coordinates, policy.control_coordinates))
        found |= reached(plant, solution, foreseen, kept, trials=trials, seed=seed)
    return found
