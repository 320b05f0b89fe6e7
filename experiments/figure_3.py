"""Fig. 3: the quadrotor through the cage, as planned, as MuJoCo draws it, and as it is executed there.

    python experiments/figure_3.py            # 200 runs with noise and a push
    python experiments/figure_3.py --quick    # 10

Begun, solved and stopped as in the paper, softly from the start of a random query. The rotors have no limits in the
plan, and have them when it is executed.
"""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d import Axes3D
from paper.common import as_in_the_paper, draw_in_space, figure, numbers, picture, render_still
from runner import FolderSettings, Result, Statement, between, interval, opening, run, table
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.goal import OUTCOMES
from lqrsim.stress.statistics import rate
from lqrsim.view import plots
from lqrsim.view.style import MARGIN, PLAN, RUNS, SOLID

EVERY = 0.5  # seconds between two robots, as in the paper
DRAWN = 30  # disturbed runs


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    query: int = 0
    """Which of the random queries."""
    seed: int = 0
    """Of the query, and of the disturbances."""
    trials: int = 200
    """Runs with disturbances."""


def main(config: Config) -> Result:
    result = opening(config)
    scenario = ls.scenarios.quadrotor(query=config.query, seed=config.seed)
    solution = ls.smooth(as_in_the_paper(scenario.problem), start=scenario.paper_start, stop="cost")
    plan, clearance = solution.trajectory, solution.clearance
    assert clearance is not None
    result["plan"] = {
        "status": solution.status.name,
        "iterations": len(solution.iterations),
        "cost": solution.cost,
        "clearance": float(clearance.min()),
        "start": numbers(plan.states[0, :3], 3),
        "end": numbers(plan.states[-1, :3], 3),
        "speed": float(np.linalg.norm(plan.states[:, 3:6], axis=1).max()),
        "tilt": float(np.degrees(np.linalg.norm(plan.states[:, 6:9], axis=1)).max()),
        "rotors": [float(plan.controls.min()), float(plan.controls.max())],
        "milliseconds": 1e3 * sum(iteration.seconds for iteration in solution.iterations),
    }
    trials = 10 if config.quick else config.trials
    calm = ls.simulate(scenario.plant(), solution)
    runs = ls.simulate(scenario.plant(), solution, disturbances=scenario.disturbances, seed=config.seed, trials=trials)
    error = runs.tracking_error[runs.counts]
    result["executed"] = {
        "undisturbed": float(calm.tracking_error.max()),
        "bound": scenario.tracking_bound,
        "disturbances": list(runs.disturbances),
        "trials": trials,
        "outcomes": {name: runs.outcome.count(name) for name in OUTCOMES},
        "reached": interval(rate(int(runs.reached.sum()), trials)),
        "rms": float(np.sqrt(np.mean(error**2))),
        "worst": float(error.max()),
        "clearance": float(runs.least_clearance().min()),
    }
    draw(config, result, scenario, solution, runs)
    render_still(config, result, "figure_3_rendered", calm, every=EVERY)
    return result


def draw(config: Config, result: Result, scenario: ls.Scenario, solution: ls.Solution, runs: ls.Rollout) -> None:
    plan, world = solution.trajectory, scenario.scene.world
    arm = ls.Quadrotor().arm
    with figure(config, result, "figure_3", (11, 4.4)) as drawn:
        space = drawn.add_axes((0.0, 0.07, 0.38, 0.93), projection="3d")
        assert isinstance(space, Axes3D)
        low, high = plots.bounds(plan.states[:, :3], world)
        draw_in_space(space, world, low, high)
        space.set(xticks=(-2, 0, 2), yticks=(-2, 0, 2), zticks=(-2, 0, 2))  # those of the corners would touch
        space.plot(*plan.states[:, :3].T, color=PLAN)
        for step in range(0, plan.steps + 1, round(EVERY / plan.dt)):
            for outline in craft(plan.states[step], arm):
                space.plot(*outline, color=RUNS[0], linewidth=0.8)
        views = ((0, 1, "x (m)", "y (m)", "from above"), (0, 2, "x (m)", "z (m)", "from the front"))
        for number, (across, up, label, other, title) in enumerate(views):
            axes = drawn.add_axes((0.43 + 0.305 * number, 0.13, 0.255, 0.78))
            beams(axes, world, across, up, low, high)
            for states in runs.states[:DRAWN]:
                axes.plot(states[:, across], states[:, up], color=RUNS[1], linewidth=0.4, alpha=0.6)
            axes.plot(plan.states[:, across], plan.states[:, up], color=PLAN)
            for step in range(0, plan.steps + 1, round(EVERY / plan.dt)):
                for outline in craft(plan.states[step], arm):
                    axes.plot(outline[across], outline[up], color=RUNS[0], linewidth=0.8)
            axes.set(xlabel=label, ylabel=other, title=title, aspect="equal")
            axes.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]))


def craft(state: Array, arm: float) -> list[Array]:
    """The quadrotor's two arms and four rotors as lines (3, k)."""
    around = np.linspace(0, 2 * np.pi, 25)
    disc = 0.6 * arm * np.array([np.cos(around), np.sin(around), 0 * around])
    ends = arm * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    lines = [ends[::2].T, ends[1::2].T, *(disc + end[:, None] for end in ends)]
    rotation = Rotation.from_rotvec(state[6:9]).as_matrix()
    return [rotation @ line + state[:3, None] for line in lines]


def beams(axes: Axes, world: ls.World, across: int, up: int, low: Array, high: Array) -> None:
    """The cage's beams along the axes, seen along the third: those across as bands, those end on as discs."""
    for obstacle in world.obstacles:
        if obstacle.kind != "cylinder":
            continue
        along, radius = int(np.argmax(np.abs(obstacle.rotation[:, 2]))), obstacle.size[0]
        x, y = obstacle.position[across], obstacle.position[up]
        if along == across:
            axes.fill_between([low[across], high[across]], y - radius, y + radius, color=MARGIN, linewidth=0, zorder=0)
        elif along == up:
            axes.fill_betweenx([low[up], high[up]], x - radius, x + radius, color=MARGIN, linewidth=0, zorder=0)
        else:
            around = np.linspace(0, 2 * np.pi, 60)
            axes.fill(x + radius * np.cos(around), y + radius * np.sin(around), color=SOLID, linewidth=0, zorder=0.5)


def report(result: Result) -> str:
    plan, executed = result["plan"], result["executed"]
    drawn = min(executed["trials"], DRAWN)
    rows = [
        ("iterations", plan["iterations"]),
        ("time of the iterations (ms)", f"{plan['milliseconds']:.1f}"),
        ("cost", f"{plan['cost']:.2f}"),
        ("least clearance (m)", f"{plan['clearance']:.3f}"),
        ("rotor forces (N)", f"{plan['rotors'][0]:.2f} to {plan['rotors'][1]:.2f}"),
        ("executed undisturbed: largest error (m)", f"{executed['undisturbed']:.1e}"),
        (f"executed {executed['trials']} times, disturbed: reached", between(executed["reached"], ".3f")),
        ("tracking error, rms (m)", f"{executed['rms']:.3f}"),
        ("largest tracking error (m)", f"{executed['worst']:.3f}"),
        ("least clearance of these runs (m)", f"{executed['clearance']:.3f}"),
    ]
    return "\n\n".join(
        [
            "## Fig. 3: the quadrotor in the cage",
            picture(
                result,
                "figure_3",
                f"Black: the plan; blue: the robot every half second; orange: {drawn} disturbed runs",
            ),
            picture(result, "figure_3_rendered", "The same as executed undisturbed in MuJoCo, every half second"),
            table(("", "value"), rows),
            f"Disturbances: {'; '.join(executed['disturbances'])}.",
        ]
    )


def statements(result: Result) -> list[Statement]:
    plan = result["plan"]
    return [
        Statement(
            where="Fig. 3",
            paper="a trajectory through the cage, without an initial one",
            test="converged by the paper's test, clear of all beams and walls",
            ours=f"{plan['status']} after {plan['iterations']} iterations, clearance {plan['clearance']:.3f} m",
            holds=plan["status"] == "COST_CONVERGED" and plan["clearance"] >= 0,
            figure="figure_3",
        ),
    ]


if __name__ == "__main__":
    run(Config, main, report, __doc__, statements=statements)
