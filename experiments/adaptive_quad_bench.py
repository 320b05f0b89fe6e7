"""AdaptiveQuadBench (arXiv 2510.03471) on RotorPy's wheel: our laws beside RotorPy's, on the same trials.

    pip install 'lqrsim[rotorpy]'
    python experiments/adaptive_quad_bench.py                        # a quarter of an hour
    python experiments/adaptive_quad_bench.py --sections when2fail --kinds wind torque    # some of it
    python experiments/adaptive_quad_bench.py --quick

Vehicle, references and ranges are those that the authors published. A reference is the polynomial of least jerk from
rest at the origin to a random position, velocity and acceleration, each component within 2 in SI units, in 5 s. A trial
has a reference of its own, and succeeds if the root mean square of its position's error is below 5 m, their test.

ranges     Each disturbance within its published range: successes, and the error of those that succeed.
when2fail  One disturbance alone, stronger and stronger, until no trial of a law succeeds or the ladder ends.
delay      The longest delay of the commands with which the error stays below 1 m, law by law, none told of it.

Where this differs from theirs: the vehicle has no noise of the motors, and rotors begin at hover speed. A wrong model
is a vehicle with another mass, inertia and thrust, where theirs tells the controller other numbers. A payload hangs
there all the time and its inertia does not count; theirs comes and goes. Their turbulence of 30 to 60 is a standard
deviation of 0.98 to 1.96 m/s at the 100 Hz at which RotorPy draws it, and ours fades with a time constant of 1 s.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, get_args

import numpy as np
from peers.rotorpy import DEFAULT
from peers.rotorpy import RotorPy as Se3
from runner import FolderSettings, Result, at_most, opening, progress, run, table
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.control.controllers import ControllerLike
from lqrsim.disturbances import ControlDelay, Disturbance, Effect
from lqrsim.errors import Array
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.parts import CostTerm
from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.disturbances.wind import first_order
from lqrsim.simulators import RotorPy

Kind = Literal["none", "wind", "force", "torque", "model", "rotors", "payload"]
Part = Literal["ranges", "when2fail", "delay"]

ARM, THRUST = 0.166, 7.64e-6  # m; N s2
VEHICLE: dict[str, Any] = {
    "mass": 0.826, "Ixx": 0.0047, "Iyy": 0.005, "Izz": 0.0074, "Ixy": 0.0, "Ixz": 0.0, "Iyz": 0.0,
    "num_rotors": 4, "rotor_directions": np.array([1, -1, 1, -1]),
    "rotor_pos": {
        f"r{i + 1}": ARM * np.sqrt(0.5) * np.array(corner)
        for i, corner in enumerate([(1, 1, 0), (1, -1, 0), (-1, -1, 0), (-1, 1, 0)])
    },
    "c_Dx": 0.0, "c_Dy": 0.0, "c_Dz": 0.0, "k_eta": THRUST, "k_m": 0.014 * THRUST, "k_d": 1.19e-4, "k_z": 2.32e-4,
    "k_flap": 0.0, "tau_m": 0.005, "rotor_speed_min": 0.0, "rotor_speed_max": 1000.0, "motor_noise_std": 0.0,
}  # fmt: skip
T, DT, REACH = 5.0, 0.01, 2.0  # s, s, and the SI units of the references' ends
FAILED = 5.0  # m, root mean square
LOST = 1.0  # m, at most, for the delay margin
# Largest strengths of the ranges, and the steps of when2fail: m/s, N, N m, share, share, share of the mass.
RANGES: dict[Kind, float] = {"wind": 3.0, "force": 1.0, "torque": 0.1, "model": 0.1, "rotors": 0.3, "payload": 0.5}
STEPS: dict[Kind, tuple[float, ...]] = {
    "wind": (6.0, 12.0, 18.0, 24.0, 36.0), "force": (2.0, 4.0, 6.0, 8.0), "torque": (0.1, 0.2, 0.3, 0.4),
    "model": (0.2, 0.4, 0.6, 0.8), "rotors": (0.4, 0.5, 0.6), "payload": (1.0, 1.5, 2.0),
}  # fmt: skip
GUSTS = (0.98, 1.96)  # m/s, range of the turbulence's standard deviation
# What the laws are told, whatever they meet; and what they may let each state deviate, with 0.2 of the hover force.
TOLD = ls.disturbances.Uncertainty(
    unknowns=[
        *(ls.disturbances.Unknown(f"force_{axis}", 0.5, 1.0) for axis in "xyz"),
        *(ls.disturbances.Unknown(f"torque_{axis}", 0.05, 1.0) for axis in "xyz"),
    ],
    lag=0.005,
)
TOLERATE, EFFORT = {"m": 0.05, "m/s": 0.2, "rad": 0.2, "rad/s": 2.0}, 0.2
EVERY = 0.5  # s, between re-plans


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    sections: tuple[Part, ...] = get_args(Part)
    """Which of them."""
    kinds: tuple[Kind, ...] = get_args(Kind)
    """Disturbances of the first two."""
    trials: int = 10
    """Of each disturbance, each with a reference of its own."""
    failing: int = 5
    """Trials of each strength of when2fail."""
    delayed: int = 5
    """References of the delay margin."""
    seed: int = 0
    """Of references and disturbances."""


@dataclass(frozen=True)
class Bench(Disturbance):
    """One of the benchmark's disturbances, drawn for each trial.

    Args:
      kind: which. least, most: range of its strength, in the units of RANGES.
    """

    kind: Kind
    least: float
    most: float

    def start(self, plant: ls.Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        parts = [self._drawn(one, plan) for one in generators]
        if self.kind in ("model", "rotors", "payload"):
            factors = {name: np.stack([part[name] for part in parts]) for name in parts[0] if name != "offset"}
            if self.kind != "payload":
                return Effect(factors=factors)
            offsets = np.stack([part["offset"] for part in parts])
            weights = (factors["mass"] - 1) * plant.weight

            def torque(step: int, states: Array) -> Array:
                arms = Rotation.from_rotvec(np.nan_to_num(states[:, 6:9])).apply(offsets)
                return np.cross(arms, weights * np.array([0.0, 0.0, -1.0]))

            return Effect(factors=factors, torque=torque)
        pushed = np.stack([part["over_time"] for part in parts])  # (K, T, 3)

        def push(step: int, states: Array) -> Array:
            return pushed[:, step]

        return {"wind": Effect(wind=push), "force": Effect(force=push), "torque": Effect(torque=push)}[self.kind]

    def _drawn(self, generator: np.random.Generator, plan: Trajectory) -> dict[str, Array]:
        low, high = self.least, self.most
        if self.kind == "model":
            mass, inertia, thrust = 1 + generator.uniform(-high, high, 3)
            return {"mass": np.array([mass]), "inertia": np.array([inertia]), "thrust": np.full(4, thrust)}
        if self.kind == "rotors":
            return {"thrust": 1 + generator.uniform(-high, high, 4)}
        if self.kind == "payload":
            offset = ARM * generator.uniform(-0.2, 0.2, 3)
            return {"mass": np.array([1 + generator.uniform(low, high)]), "offset": offset}
        if self.kind == "wind":
            direction = generator.uniform(-1, 1, 3)
            mean = generator.uniform(low, high) * direction / np.linalg.norm(direction)
            noise = generator.standard_normal((1, plan.steps, 3))
            return {"over_time": mean + generator.uniform(*GUSTS, 3) * first_order(noise, plan.dt / 1.0)[0]}
        # A force or a torque that is there between times at which it comes and goes.
        strength, times = generator.uniform(low, high, 3), plan.dt * np.arange(plan.steps)
        changes = generator.uniform(0.5, plan.horizon - 0.5, generator.integers(1, 5))
        there = (changes[:, None] <= times).sum(axis=0) % 2 == 1
        return {"over_time": there[:, None] * strength}


class ReferenceCost(ls.Cost):
    """`1/2 (z - reference(t))' weight (z - reference(t))` of position and velocity; (6,) weights.

    Args:
      reference: times (N,) in s -> (N, 6). weight: (6,).
    """

    def __init__(self, reference: Callable[[Array], Array], weight: Sequence[float]) -> None:
        self.reference, self.weight = reference, np.array(weight, dtype=float)

    @property
    def moving(self) -> bool:
        return True

    def bind(self, dynamics: Dynamics) -> CostTerm:
        return self._bind_at(dynamics, np.zeros(1), {})

    def _bind_at(self, dynamics: Dynamics, times: Array, goals: Mapping[int, float]) -> CostTerm:
        return CostTerm(SOURCE, np.concatenate([[len(times)], self.weight, self.reference(times).ravel()]))


SOURCE = """
def value(x, u, t, data):
    total = 0.0
    row = 7 + 6 * min(t, int(data[0]) - 1)
    for i in range(6):
        total += 0.5 * data[1 + i] * (x[i] - data[row + i]) * (x[i] - data[row + i])
    return total


def derivatives(x, u, t, data, hessian, gradient):
    total = 0.0
    row = 7 + 6 * min(t, int(data[0]) - 1)
    for i in range(6):
        off = x[i] - data[row + i]
        hessian[i, i] += data[1 + i]
        gradient[i] += data[1 + i] * off
        total += 0.5 * data[1 + i] * off * off
    return total
"""


@dataclass(frozen=True)
class Primitive:
    """The polynomial of least jerk from rest at the origin; ends (3, 3): position, velocity, acceleration after 5 s."""

    coefficients: Array  # (3, 3): of t^3, t^4, t^5, for each axis

    @classmethod
    def drawn(cls, seed: int, trial: int) -> "Primitive":
        ends = np.random.default_rng([seed, trial]).uniform(-REACH, REACH, (3, 3))
        powers = np.array([[T**p, p * T ** (p - 1), p * (p - 1) * T ** (p - 2)] for p in (3, 4, 5)]).T
        return cls(np.linalg.solve(powers, ends))

    def __call__(self, times: Array) -> Array:
        """Position and velocity, (N, 6)."""
        t = np.clip(times, 0.0, T)[:, None]
        place = sum(c * t**p for c, p in zip(self.coefficients, (3, 4, 5), strict=True))
        speed = sum(p * c * t ** (p - 1) for c, p in zip(self.coefficients, (3, 4, 5), strict=True))
        return np.concatenate([place, speed], axis=1)


@cache
def plant() -> ls.Plant:
    simulator = RotorPy(VEHICLE, timestep=DT)
    return ls.Plant(simulator.quadrotor(), ls.load_scene("cage", obstacles=False), simulator)


def problem_of(reference: Callable[[Array], Array]) -> ls.Problem:
    """Follow a reference from rest at the origin."""
    robot = plant().robot
    assert isinstance(robot, ls.Quadrotor)
    force = robot.hover_force
    end = np.concatenate([reference(np.array([T]))[0], np.zeros(6)])
    weight = [1000.0] * 3 + [10.0] * 3
    return ls.Problem(
        dynamics=robot.dynamics, dt=DT, steps=round(T / DT), initial=ls.FixedState(np.zeros(12)),
        stage_cost=ls.ControlCost(np.full(4, 1 / force**2), about=np.full(4, force)) + ReferenceCost(reference, weight),
        final_cost=ls.QuadraticCost(np.concatenate([weight, np.zeros(6)]), about=end),
    )  # fmt: skip


LAWS = ("the policy of `smooth`", "`track`", "`OffsetFree`", "`Replanner`, every 0.5 s", "RotorPy's SE(3)")


@cache
def flown_by(trial: int, seed: int) -> tuple[Primitive, ls.Solution, dict[str, ControllerLike | None]]:
    """Reference, plan and laws of a trial."""
    reference, robot = Primitive.drawn(seed, trial), plant().robot
    assert isinstance(robot, ls.Quadrotor)
    problem, effort = problem_of(reference), EFFORT * robot.hover_force
    plan = ls.smooth(problem)
    laws = (
        None,
        ls.track(problem, plan, tolerate=TOLERATE, effort=effort),
        ls.OffsetFree(problem, plan, TOLD, tolerate=TOLERATE, effort=effort),
        ls.Replanner(problem, plan, every=EVERY, deadline=0.0),
        Se3(robot, plan, DEFAULT),
    )
    return reference, plan, dict(zip(LAWS, laws, strict=True))


def errors(law: str, disturbances: Sequence[Disturbance], trial: int, seed: int) -> Array:
    """Distance from the reference at each knot, (T+1,), in m; NaN from where the trial was lost."""
    reference, plan, laws = flown_by(trial, seed)
    flown = ls.simulate(
        plant(), plan, controller=laws[law], disturbances=disturbances, seed=seed, first_trial=trial, frames=False
    )
    return np.linalg.norm(flown.states[0, :, :3] - reference(flown.times)[:, :3], axis=1)


def cell(law: str, disturbance: Disturbance | None, trials: int, seed: int) -> dict[str, Any]:
    """The share of successes, and the mean error of these in m; None without any."""
    given = [] if disturbance is None else [disturbance]
    rms = np.array([np.sqrt(np.mean(errors(law, given, trial, seed) ** 2)) for trial in range(trials)])
    good = rms < FAILED  # NaN is none
    return {"law": law, "share": float(good.mean()), "mean": float(rms[good].mean()) if good.any() else None}


def ranges(config: Config) -> list[dict[str, Any]]:
    kinds: dict[Kind, Bench | None] = {"none": None}
    kinds |= {kind: Bench(kind, 0.0, most) for kind, most in RANGES.items()}
    return [
        cell(law, bench, config.trials, config.seed) | {"kind": kind}
        for kind, bench in progress([one for one in kinds.items() if one[0] in config.kinds], "ranges")
        for law in LAWS
    ]


def when2fail(config: Config) -> list[dict[str, Any]]:
    found = []
    for kind, strengths in progress([one for one in STEPS.items() if one[0] in config.kinds], "when2fail"):
        flying = list(LAWS)
        for strength in strengths[:1] if config.quick else strengths:
            for law in list(flying):
                one = cell(law, Bench(kind, strength, strength), config.failing, config.seed)
                found.append(one | {"kind": kind, "strength": strength})
                if one["share"] == 0:
                    flying.remove(law)
    return found


def delay(config: Config) -> list[dict[str, Any]]:
    found = []
    for law in progress(LAWS, "delays"):
        margins = []
        for trial in range(config.delayed):
            periods = 0
            while periods < 50 and np.max(errors(law, [ControlDelay(periods + 1)], trial, config.seed)) < LOST:
                periods += 1
            margins.append(periods * DT)
        found.append({"law": law, "margins": margins})
    return found


PARTS: dict[Part, Callable[[Config], list[dict[str, Any]]]] = {"ranges": ranges, "when2fail": when2fail, "delay": delay}


def main(config: Config) -> Result:
    config = at_most(config, trials=1, failing=1, delayed=1)
    result = opening(config)
    try:
        RotorPy()  # reads its vehicle from the package
    except ls.InputError as error:
        return result | {"skipped": str(error)}
    return result | {name: PARTS[name](config) for name in config.sections}


def report(result: Result) -> str:
    lines = [
        "## AdaptiveQuadBench",
        "The benchmark of arXiv 2510.03471, rebuilt on RotorPy's wheel, with the extra `rotorpy`;"
        " `experiments/adaptive_quad_bench.py` says where it differs.",
    ]
    if "skipped" in result:
        return "\n\n".join([*lines, f"skipped: {result['skipped']}"])
    config = result["config"]
    if "ranges" in result:
        rows = [
            [name, *("-" if cells[law]["mean"] is None else f"{cells[law]['mean']:.3f}" for law in LAWS)]
            for name, cells in by_law(result["ranges"]).items()
        ]
        few = [f"{one['kind']}, {one['law']}, {percent(one)}" for one in result["ranges"] if one["share"] < 1]
        lines += [
            "### Within the published ranges",
            f"{config['trials']} trials each, the same for all laws: the root mean square of the position's error in m,"
            f" mean of those that succeed. Successes below 100 %: {'; '.join(few) or 'none'}.",
            table(("disturbance", *LAWS), rows),
        ]
    if "when2fail" in result:
        rows = [
            [name, *(percent(cells[law]) if law in cells else "-" for law in LAWS)]
            for name, cells in by_law(result["when2fail"]).items()
        ]
        lines += [
            "### Until it fails",
            f"{config['failing']} trials of each strength: successes in %. A law is not run beyond the strength at"
            " which none succeed. Strengths are the mean speed of the wind in m/s; each component of the force in N,"
            " and of the torque in N m; by what share a number of the model, or a rotor's efficiency, is off at most;"
            " and the payload as a share of the mass. Theirs end at 0.6 for rotors and at 2 for the payload, too.",
            table(("strength", *LAWS), rows),
        ]
    if "delay" in result:
        rows = [
            [one["law"], *(f"{1e3 * of(one['margins']):.0f}" for of in (np.mean, min, max))] for one in result["delay"]
        ]
        lines += [
            "### Delay margin",
            f"{config['delayed']} references. In ms, in steps of {1000 * DT:g}.",
            table(("law", "mean", "least", "most"), rows),
        ]
    return "\n\n".join(lines)


def by_law(cells: Sequence[dict[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    """The cells of each kind, with its strength if it has one, by law."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for one in cells:
        name = f"{one['kind']} {one['strength']:g}" if "strength" in one else one["kind"]
        found.setdefault(name, {})[one["law"]] = one
    return found


def percent(one: dict[str, Any]) -> str:
    return f"{100 * one['share']:.0f}"


if __name__ == "__main__":
    run(Config, main, report, __doc__)
