"""A cart-pole whose formula lacks much of the plant: a network learns the rest, and plans with both swing the pole up.

    pip install 'lqrsim[jax]'
    python experiments/jax_residual.py            # a minute
    python experiments/jax_residual.py --quick

The plant is MuJoCo's. Its pole is heavier than the formula says, its hinge and slide have friction, and it moves in a
medium. Recorded is a minute of random pushes with noise in what is measured, in pieces of one control period. The
network is fitted to what the formula's steps miss of these. Both models then plan the same, and the policies of both
run in the plant from disturbed starts. Then the same formula is solved as SymPy's and as JAX's, in turn.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from runner import Result, Settings, at_most, opening, progress, run, table
from scipy.optimize import minimize

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.stress.statistics import rate

MODEL = """
<mujoco>
  <compiler autolimits="true"/>
  <option timestep="0.01" integrator="RK4" gravity="0 0 -9.81" density="{density}"/>
  <worldbody>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" damping="{slide}"/>
      <geom type="box" size="0.1 0.05 0.05" mass="1"/>
      <body name="pole">
        <joint name="pole" type="hinge" axis="0 1 0" damping="{hinge}"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.05" size="0.01" mass="0.001"/>
        <geom type="sphere" pos="0 0 0.5" size="0.05" mass="{bob}"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slider" ctrlrange="-15 15"/></actuator>
</mujoco>
"""
PLANT = {"density": 10.0, "slide": 0.3, "hinge": 0.01, "bob": 0.26}
DT, STEPS = 0.02, 100
FIELDS: dict[str, Any] = {
    "states": {"slider": "m", "pole": "rad", "slider_velocity": "m/s", "pole_velocity": "rad/s"},
    "controls": {"push": "N"},
    "parameters": {"cart": 1.0, "bob": 0.2, "length": 0.5, "gravity": 9.81},
    "angles": ("pole",),
    "control_limits": (-15.0, 15.0),
}
NOISE = np.array([1e-4, 1e-3, 1e-3, 5e-3])  # of what is measured, in the units of the states
HIDDEN = 16  # neurons: with half as many the fit is worse, with twice as many no better
DECAY = 1e-4  # weight of the squares of the network's weights: next to what noise adds to the misfit
UPRIGHT = {"slider": 0.1, "pole": 0.1, "slider_velocity": 0.3, "pole_velocity": 0.6}  # a run succeeds within these


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    samples: int = 3000
    """Recorded control periods."""
    trials: int = 400
    """Runs of each policy."""
    rounds: int = 15
    """Solves of each kind that are timed."""
    seed: int = 0
    """Of the recording, of the network's first weights, and of the runs."""


def accelerations(x: Any, u: Any, p: Any, sin: Callable[[Any], Any], cos: Callable[[Any], Any]) -> list[Any]:
    """Of cart and pole, whose mass is a point; the pole stands at an angle of 0."""
    force, angle, turn = u[0], x[1], x[3]
    s, c = sin(angle), cos(angle)
    mixed = p.cart + p.bob * s**2
    push = force + p.bob * s * (p.length * turn**2 - p.gravity * c)
    fall = (p.cart + p.bob) * p.gravity * s - c * (force + p.bob * p.length * turn**2 * s)
    return [push / mixed, fall / (p.length * mixed)]


def formula(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import cos, sin

    return [x[2], x[3], *accelerations(x, u, p, sin, cos)]


def of_jax(x: Any, u: Any, p: Any) -> list[Any]:
    import jax.numpy as jnp

    return [x[2], x[3], *accelerations(x, u, p, jnp.sin, jnp.cos)]


def network(weights: Array, x: Any, u: Any) -> Any:
    """Accelerations (2,) of a network with one hidden layer: of sine and cosine of the angle, velocities and force."""
    import jax.numpy as jnp

    inner, offset, outer = jnp.split(weights, np.cumsum([5 * HIDDEN, HIDDEN]))
    seen = jnp.stack([jnp.sin(x[1]), jnp.cos(x[1]), 0.3 * x[2], 0.1 * x[3], 0.1 * u[0]])
    return outer.reshape(2, HIDDEN) @ jnp.tanh(inner.reshape(HIDDEN, 5) @ seen + offset)


def learned(weights: Array) -> ls.Dynamics:
    """The formula with the network beside it."""

    def rate(x: Any, u: Any, p: Any) -> list[Any]:
        rates, more = of_jax(x, u, p), network(weights, x, u)
        return [*rates[:2], rates[2] + more[0], rates[3] + more[1]]

    return ls.Dynamics(rate, level="jax", **FIELDS)


def recorded(robot: ls.MjcfRobot, config: Config) -> tuple[Array, Array, Array]:
    """States (K, 4), controls (K, 1), and what was measured a control period later (K, 4)."""
    rng, count = np.random.default_rng(config.seed), config.samples
    states = rng.uniform([-1.0, -np.pi, -3.0, -9.0], [1.0, np.pi, 3.0, 9.0], size=(count, 4))
    controls = rng.uniform(-15.0, 15.0, size=(count, 1))
    after = [robot.dynamics.step(x, u, DT) for x, u in zip(states, controls, strict=True)]
    return states, controls, np.array(after) + NOISE * rng.normal(size=(count, 4))


def fitted(states: Array, controls: Array, after: Array, seed: int) -> tuple[Array, float, float]:
    """The weights, and the misfit of velocities after a period: of the formula alone, and of both, in noise's units."""
    import jax
    import jax.numpy as jnp

    p = type("Parameters", (), FIELDS["parameters"])

    def misfit(weights: Any, x: Any, u: Any, wanted: Any) -> Any:
        def rates(x: Any) -> Any:
            return jnp.stack(of_jax(x, u, p)) + jnp.concatenate([jnp.zeros(2), network(weights, x, u)])

        middle = x + 0.5 * DT * rates(x)  # the midpoint rule: its error is far below the noise
        return ((x + DT * rates(middle) - wanted) / NOISE)[2:]

    @jax.jit
    def loss(weights: Any, x: Any, u: Any, wanted: Any) -> Any:
        misses = jax.vmap(misfit, (None, 0, 0, 0))(weights, x, u, wanted)
        return jnp.mean(misses**2) + DECAY * jnp.sum(weights**2)

    begin = 0.3 * np.random.default_rng(seed).normal(size=8 * HIDDEN)
    begin[6 * HIDDEN :] = 0.0
    with jax.enable_x64(True):
        slope = jax.jit(jax.value_and_grad(loss))

        def of(weights: Array) -> tuple[float, Array]:
            value, gradient = slope(weights, states, controls, after)
            return float(value), np.asarray(gradient)

        alone = of(begin)[0] - DECAY * float(begin @ begin)
        found = minimize(of, begin, jac=True, method="L-BFGS-B", options={"maxiter": 2000, "maxfun": 4000})
    return found.x, float(np.sqrt(alone)), float(np.sqrt(found.fun - DECAY * float(found.x @ found.x)))


def swing_up(dynamics: ls.Dynamics, **kept: Any) -> ls.Problem:
    return ls.Problem(
        dynamics=dynamics, dt=DT, steps=STEPS, initial=ls.FixedState([0.0, np.pi, 0.0, 0.0]),
        stage_cost=ls.ControlCost([0.01]) + ls.QuadraticCost([1.0, 0.5, 0.1, 0.05], about=np.zeros(4)),
        final_cost=ls.QuadraticCost([500.0, 500.0, 50.0, 50.0], about=np.zeros(4)), **kept,
    )  # fmt: skip


def main(config: Config) -> Result:
    config = at_most(config, samples=600, trials=20, rounds=2)
    robot = ls.MjcfRobot(scene_from_xml(MODEL.format(**PLANT), "swing_up"))
    plant = ls.Plant(robot, robot.scene)
    weights, alone, both = fitted(*recorded(robot, config), config.seed)
    result = opening(config) | {"misfit": {"formula": alone, "with the network": both}, "runs": {}}
    models = {"formula": ls.Dynamics(formula, **FIELDS), "with the network": learned(weights)}
    for name, dynamics in progress(models.items(), "models"):
        result["runs"][name] = of_model(swing_up(dynamics), plant, config)
    return result | {"times": times(models, config)}


def of_model(problem: ls.Problem, plant: ls.Plant, config: Config) -> dict[str, Any]:
    """A plan of the model, how far the plant is from it, and how often the pole stands in the end."""
    solution = ls.smooth(problem)
    still = ls.simulate(plant, solution, frames=False)
    met = [ls.disturbances.InitialStateError((0.02, 0.05, 0.05, 0.1)), ls.disturbances.ControlNoise(0.05)]
    runs = ls.simulate(plant, solution, disturbances=met, trials=config.trials, seed=config.seed, frames=False)
    off = np.abs(plant.robot.dynamics.state_coordinates.difference(runs.states[:, -1], np.zeros(4)))
    stands = (off <= list(UPRIGHT.values())).all(axis=1)
    found = rate(int(stands.sum()), config.trials)
    planned, ran = solution.trajectory.states[:, 1], still.states[0, :, 1]
    return {
        "status": solution.status.name, "cost": solution.cost, "stands": [found.value, found.low, found.high],
        "apart": float(np.abs(ran - planned).max()), "median": float(np.median(off[:, 1])),
    }  # fmt: skip


def times(models: dict[str, ls.Dynamics], config: Config) -> dict[str, dict[str, Any]]:
    """Processor time of solves in turn: the formula by SymPy and by JAX, and with the network; free and constrained."""
    kinds = {"formula": models["formula"], "the same in JAX": ls.Dynamics(of_jax, level="jax", **FIELDS)}
    kinds["with the network"] = models["with the network"]
    kept = {"constraints": [ls.GoalState(np.zeros(4)), ls.StateBounds(slider=(-1.0, 1.0))]}
    found: dict[str, dict[str, Any]] = {}
    for task, more in {"smoothing and Newton": {}, "interior point": kept}.items():
        problems = {name: swing_up(one, **more) for name, one in kinds.items()}
        taken: dict[str, list[float]] = {name: [] for name in kinds}
        counts = {name: len(ls.smooth(problem, starts=1).iterations) for name, problem in problems.items()}
        for _ in progress(range(config.rounds), task):
            for name, problem in problems.items():
                begin = time.process_time()
                ls.smooth(problem, starts=1)
                taken[name].append((time.process_time() - begin) / counts[name])
        ratios = {name: np.median(np.array(each) / taken["formula"]) for name, each in taken.items()}
        found[task] = {
            name: {"ms": 1e3 * float(np.median(each)), "ratio": float(ratios[name]), "iterations": counts[name]}
            for name, each in taken.items()
        }
    return found


def report(result: Result) -> str:
    rows: list[Sequence[Any]] = []
    for name, one in result["runs"].items():
        stands, low, high = (f"{100 * part:.1f}" for part in one["stands"])
        misfit = f"{result['misfit'][name]:.1f}"
        rows.append([name, misfit, f"{one['apart']:.2f}", f"{one['median']:.3f}", f"{stands} ({low} to {high})"])
    head = ("model", "misfit (noise is 1)", "pole off the plan (rad)", "pole at the end (rad)", "stands (%)")
    speeds = [
        [task, name, str(one["iterations"]), f"{one['ms']:.2f}", f"{one['ratio']:.1f}"]
        for task, each in result["times"].items()
        for name, one in each.items()
    ]
    return "\n\n".join(
        [
            table(head, rows),
            table(("solver", "dynamics", "iterations", "ms an iteration", "times the formula"), speeds),
        ]
    )


if __name__ == "__main__":
    run(Config, main, report, __doc__)
