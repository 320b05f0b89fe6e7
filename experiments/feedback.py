"""The value of feedback: the policy against its plan without feedback, in MuJoCo, under the same disturbances.

    python experiments/feedback.py            # 200 trials of each
    python experiments/feedback.py --quick    # 4

Both robots meet the demo's disturbances, at several times their strength. A trial has the same random numbers with
feedback and without. Without, nothing is measured, so that the noise of measurements is met by the feedback alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d import Axes3D
from paper.common import draw_in_space, figure, numbers, picture
from runner import FolderSettings, Result, Statement, between, interval, opening, progress, run, table

import lqrsim as ls
from lqrsim.stress.statistics import compare, rate
from lqrsim.view import plots
from lqrsim.view.style import LIMIT, PLAN, RUNS

FEEDBACK, OPEN_LOOP = "with feedback", "open loop"
LOOK = {FEEDBACK: (RUNS[0], "-", "o"), OPEN_LOOP: (RUNS[1], "--", "s")}  # colour, line, marker
NAMES = {"differential_drive": "differential drive", "quadrotor": "quadrotor"}
FULL = 1.0  # the strength that the disturbances have in the demo


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    trials: int = 200
    """Of each robot, strength and policy."""
    strengths: tuple[float, ...] = (0.0, 0.5, FULL, 2.0)
    """Of the disturbances, as multiples of the demo's."""
    seed: int = 0
    """Of the disturbances."""
    paths: int = 30
    """How many trials of each are drawn."""


def main(config: Config) -> Result:
    trials = min(config.trials, 4) if config.quick else config.trials
    strengths = sorted({*config.strengths, FULL})
    result = opening(config) | {"trials": trials, "robots": {}}
    scenarios = [ls.scenarios.get(name) for name in NAMES]
    solutions = [ls.smooth(scenario.problem) for scenario in scenarios]
    jobs = [(*pair, strength) for pair in zip(scenarios, solutions, strict=True) for strength in strengths]
    drawn: dict[str, dict[str, ls.Rollout]] = {}
    for scenario, solution, strength in progress(jobs, "feedback and open loop"):
        policies = {FEEDBACK: solution, OPEN_LOOP: solution.open_loop()}
        # Undisturbed, every trial is the same.
        count = trials if strength > 0 else 1
        disturbances = [disturbance.scaled(strength) for disturbance in scenario.disturbances]
        rollouts = {
            name: ls.simulate(scenario.plant(), policy, disturbances=disturbances, seed=config.seed, trials=count)
            for name, policy in policies.items()
        }
        robot = result["robots"].setdefault(scenario.name, {"strengths": {}})
        robot["strengths"][f"{strength:g}"] = {
            **{name: measured(rollout) for name, rollout in rollouts.items()},
            "p_value": compare(*(rollout.reached for rollout in rollouts.values())).p_value,
        }
        if strength == FULL:
            one = rollouts[FEEDBACK]
            robot |= {"disturbances": one.disturbances, "goal_radius": one.goal_radius}
            drawn[scenario.name] = rollouts
    draw(config, result, drawn)
    draw_paths(config, result, scenarios, drawn)
    return result


def measured(rollout: ls.Rollout) -> dict[str, Any]:
    """How far from the plan in metres, until each trial ended, and how many reached the goal."""
    error = np.where(rollout.counts, rollout.tracking_error, np.nan)
    rms, worst = np.sqrt(np.nanmean(error**2, axis=1)).mean(), np.nanmax(error)
    return {
        "trials": rollout.trials,
        "rms": numbers([rms])[0],
        "worst": numbers([worst])[0],
        "collided": rollout.outcome.count("collided"),
        "success": interval(rate(int(rollout.reached.sum()), rollout.trials)),
    }


def draw(config: Config, result: Result, rollouts: dict[str, dict[str, ls.Rollout]]) -> None:
    with figure(config, result, "feedback", (10, 6)) as drawn:
        for row, (name, robot) in zip(drawn.subplots(2, 2, width_ratios=(3, 2)), result["robots"].items(), strict=True):
            over_time, success = row
            draw_errors(over_time, rollouts[name])
            over_time.set_title(f"{NAMES[name]} at strength {FULL:g}: median, 5 to 95 %")
            draw_success(success, robot)
            success.set_title(f"{NAMES[name]}: goal reached")
        drawn.set_layout_engine("tight", w_pad=3)


def draw_errors(axes: Axes, rollouts: dict[str, ls.Rollout]) -> None:
    times, radius = rollouts[FEEDBACK].times[1:], rollouts[FEEDBACK].goal_radius
    for policy, (colour, line, _) in LOOK.items():
        # All begin on the plan, at an error that a logarithmic axis has no place for.
        low, middle, high = np.nanpercentile(rollouts[policy].tracking_error, (5, 50, 95), axis=0)[:, 1:]
        axes.fill_between(times, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(times, middle, line, color=colour)
        axes.annotate(policy, (times[-1], middle[-1]), (4, 0), textcoords="offset points", color=colour, va="center")
    axes.axhline(radius, color=LIMIT, linestyle=":", linewidth=1.0)
    axes.annotate("goal radius", (times[-1], radius), (4, 0), textcoords="offset points", color=LIMIT, va="center")
    axes.set(yscale="log", xlim=(0, times[-1]), xlabel="time (s)", ylabel="distance from the plan (m)")


def draw_success(axes: Axes, robot: dict[str, Any]) -> None:
    strengths = [float(strength) for strength in robot["strengths"]]
    for policy, (colour, line, marker) in LOOK.items():
        cells = [cell[policy] for cell in robot["strengths"].values()]
        value, low, high = np.array([cell["success"] for cell in cells]).T
        sampled = np.array([cell["trials"] > 1 for cell in cells])
        reach = np.where(sampled, [value - low, high - value], 0)
        axes.errorbar(strengths, value, reach, linestyle=line, color=colour, marker=marker, markersize=4, capsize=3)
        last = strengths[-1], value[-1]
        axes.annotate(policy, last, (8, 0), textcoords="offset points", color=colour, va="center")
    axes.set(xlabel="strength of the disturbances", ylabel="share of trials", ylim=(-0.03, 1.05), xticks=strengths)
    axes.set_yticks(np.linspace(0, 1, 6))


def draw_paths(
    config: Config, result: Result, scenarios: Sequence[ls.Scenario], rollouts: dict[str, dict[str, ls.Rollout]]
) -> None:
    with figure(config, result, "feedback_paths", (8.6, 4.8)) as drawn:
        grid = drawn.add_gridspec(1, 2, left=0.06, right=0.96, bottom=0.17, top=0.94, wspace=0.05, width_ratios=(2, 3))
        for number, scenario in enumerate(scenarios):
            place = list(scenario.robot.dynamics.state_coordinates.position)
            plan = rollouts[scenario.name][FEEDBACK].plan.states[:, place]
            low, high = plots.bounds(plan, scenario.scene.world, 0.5 if len(place) == 3 else 0.0)
            if len(place) == 3:
                axes = drawn.add_subplot(grid[number], projection="3d")
                assert isinstance(axes, Axes3D)
                draw_in_space(axes, scenario.scene.world, low, high)
                axes.set(xticks=(-2, 0, 2), yticks=(-2, 0, 2), zticks=(-2, 0, 2))
            else:
                axes = drawn.add_subplot(grid[number])
                plots.draw_in_plane(axes, scenario.scene.world.seen_by("xy"), low, high, scenario.robot.radius)
            for name in (OPEN_LOOP, FEEDBACK):
                draw_runs(axes, rollouts[scenario.name][name], config.paths, name)
            axes.plot(*plan.T, color=PLAN, label="plan")
            axes.plot(*plan[:1].T, "o", color=PLAN, markersize=6, label="start")
            axes.plot(*plan[-1:].T, "*", color=PLAN, markersize=10, label="end of the plan")
            axes.set_title(NAMES[scenario.name], loc="left")
        drawn.legend(
            *drawn.axes[0].get_legend_handles_labels(),
            loc="lower center",
            ncols=6,
            columnspacing=1.2,
            handletextpad=0.5,
        )


def draw_runs(axes: Axes, rollout: ls.Rollout, count: int, name: str) -> None:
    """The first trials, each to its end or to where it first collides."""
    colour, line, _ = LOOK[name]
    states = rollout.states[:count, :, list(rollout.state_coordinates.position)]
    ends = [int(counted.sum()) for counted in rollout.counts[:count]]
    for number, (path, end) in enumerate(zip(states, ends, strict=True)):
        axes.plot(*path[: end + 1].T, line, color=colour, linewidth=0.7, alpha=0.8, label=None if number else name)
    crosses = np.array([path[end] for path, end in zip(states, ends, strict=True) if end < len(path)])
    if len(crosses):
        label = f"{name}, first collision"
        axes.plot(*crosses.T, "x", color=colour, markersize=4, markeredgewidth=0.9, label=label)


def report(result: Result) -> str:
    count = min(result["config"]["paths"], result["trials"])
    parts = [
        "## Feedback against open loop",
        picture(
            result, "feedback", "Distance from the plan over time, and success against the strength of the disturbances"
        ),
        picture(result, "feedback_paths", f"The first {count} trials of each, up to their first collision"),
        f"{result['trials']} trials of each strength and policy, one undisturbed; p is McNemar's exact test of feedback"
        " against open loop. Errors are distances from the plan, until a trial collides or is lost; rms is the mean"
        " over the trials of each one's.",
    ]
    for name, robot in result["robots"].items():
        rows = [
            [
                f"{strength}, {policy}", f"{cell[policy]['rms']:.3g}", f"{cell[policy]['worst']:.3g}",
                reached(cell[policy]), cell[policy]["collided"],
                f"{cell['p_value']:.1g}" if policy == FEEDBACK and float(strength) else "",
            ]
            for strength, cell in robot["strengths"].items()
            for policy in LOOK
        ]  # fmt: skip
        parts += [
            f"{NAMES[name].capitalize()}; at strength 1: {'; '.join(robot['disturbances'])}. The goal is reached within"
            f" {robot['goal_radius']:g} m, without a collision.",
            table(("strength, policy", "error, rms (m)", "largest (m)", "reached (%)", "collided", "p"), rows),
        ]
    return "\n\n".join(parts)


def reached(one: dict[str, Any]) -> str:
    """The share in %; of a single trial, as undisturbed, without an interval."""
    percent = [100 * value for value in one["success"]]
    return between(percent, ".1f") if one["trials"] > 1 else f"{percent[0]:.0f}"


def statements(result: Result) -> list[Statement]:
    said = []
    for name, robot in result["robots"].items():
        cell = robot["strengths"][f"{FULL:g}"]
        (value, low, high), (bare, bare_low, bare_high) = (cell[policy]["success"] for policy in LOOK)
        said.append(
            Statement(
                where="Sec. VI-A",
                paper=f"the policy can account for disturbances; {NAMES[name]}",
                test="the goal reached more often than without feedback, intervals apart",
                ours=f"{100 * value:.1f} % ({100 * low:.1f} to {100 * high:.1f}) with feedback,"
                f" {100 * bare:.1f} % ({100 * bare_low:.1f} to {100 * bare_high:.1f}) without",
                holds=low > bare_high,
                figure="feedback",
            )
        )
    return said


if __name__ == "__main__":
    run(Config, main, report, __doc__, statements=statements)
