"""The demo: solve, simulate and render each scenario, and print a table of the results."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lqrsim.commands import as_json, console
from lqrsim.control.tubes import Tube
from lqrsim.errors import InputError
from lqrsim.results import save_load
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import folder_name, from_anywhere, resolve
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.uncertainty_of import tube_under
from lqrsim.view import gl
from lqrsim.view.plots import plot_policy, plot_run

TABLE = (
    f"{'scenario':<20} {'run':<12} {'iterations':>10} {'cost':>10} {'gap':>9} {'clearance m':>12}"
    f" {'rms m':>9} {'max m':>9} {'final m':>9} {'goal m':>9} {'outcome':>9}"
)


def demo(references: Sequence[str], *, out: Path, seed: int, video: bool, quick: bool) -> int:
    """Run the demo for each scenario.

    Returns:
      1 if a plan did not converge, or an undisturbed run left its plan by more than the scenario's bound; else 0.
    """
    console.check_output("--out", out)
    scenarios = {reference: resolve(reference) for reference in references}
    if video:
        try:
            gl.bind()
        except InputError as error:
            console.say(f"No videos, everything else works: {error}")
            video = False
    rows: list[str] = []
    failures: list[str] = []
    misses: list[str] = []
    results: list[as_json.Object] = []
    for reference, scenario in scenarios.items():
        folder = out / folder_name(scenario)
        console.say(f"\n== {reference}: {scenario.summary}")
        solved = console.solve(scenario)
        solution = replace(solved, scenario=from_anywhere(reference))
        console.wrote(save_load.save(solution, folder / "solution.npz"))
        tube, remark = tube_under(scenario.problem, solution, scenario.plant(), scenario.disturbances)
        if remark:
            console.say(remark)
        if solution.cost_to_go is not None:
            world, robot = scenario.scene.world, scenario.robot
            radius = robot.shape.get("radius", 0.0)
            console.wrote(plot_policy(solution, folder / "policy.png", world=world, radius=radius, tube=tube))
        if not solution.success:
            failures.append(f"{reference}: the plan did not converge ({solution.status.name})")
        runs = {
            "undisturbed": _execute(scenario, solution, folder / "undisturbed.npz", seed, ()),
            "disturbed": _execute(scenario, solution, folder / "disturbed.npz", seed, scenario.disturbances, tube),
        }
        worst, unit = float(runs["undisturbed"].tracking_error.max()), runs["undisturbed"].tracking_unit
        if not worst <= scenario.tracking_bound:  # also true for the NaN of a diverged run
            bound = f"want <= {scenario.tracking_bound:g} {unit}"
            failures.append(f"{reference}: undisturbed up to {worst:.3g} {unit} off its plan, {bound}")
        figure = plot_run(solution, runs, folder / "figure.png", world=scenario.scene.world)
        console.wrote(figure)
        plan, reach = runs["undisturbed"].target, runs["undisturbed"].goal_radius
        misses += [f"{reference}: {line}" for line in plan.of_plan(reach)[1:]]
        if video:
            _render_video(runs["disturbed"], folder / "video.mp4", quick=quick)
        rows += [_row(reference, name, solution, rollout) for name, rollout in runs.items()]
        if console.wants_result():
            shown = {name: as_json.of_rollout(run, scenario.problem) for name, run in runs.items()}
            results.append({"solution": as_json.of_solution(solution), "runs": shown})
    console.say("\n" + "\n".join([TABLE, *rows]))
    for miss in misses:
        console.say(miss)
    for failure in failures:
        console.say(f"FAILED {failure}")
    console.result(scenarios=results, misses=misses, failures=failures)
    return 1 if failures else 0


def _execute(
    scenario: Scenario,
    solution: Solution,
    path: Path,
    seed: int,
    disturbances: Sequence[Disturbance],
    tube: Tube | None = None,
) -> Rollout:
    """Run the closed loop once, save it with the predicted tube, and print a line."""
    with console.progress("simulating", "step") as progress:
        rollout = simulate(
            scenario.plant(), solution, disturbances=disturbances, seed=seed, progress=progress,
            **scenario.near_enough(),
        )  # fmt: skip
    console.say(rollout.summary())
    rollout = rollout if tube is None else tube.added_to(rollout)
    console.wrote(save_load.save(rollout, path))
    return rollout


def _render_video(rollout: Rollout, path: Path, *, quick: bool) -> None:
    """Render a video with the calibrated panes that show the robot's position."""
    from lqrsim.view import cameras
    from lqrsim.view.render import render

    insets = cameras.measuring(rollout.plane)
    quality, fps = ("draft", 5) if quick else ("standard", 30)
    with console.progress("rendering", "frame") as progress:
        render(rollout, path, insets=insets, quality=quality, fps=fps, progress=progress)
    console.wrote(path)


def _row(reference: str, run: str, solution: Solution, rollout: Rollout) -> str:
    error = rollout.tracking_error[0, rollout.counts[0]]
    final, away = (np.nan, np.nan) if not rollout.counts[0, -1] else (error[-1], rollout.goal_distance[0])
    return (
        f"{reference:<20} {run:<12} {len(solution.iterations):>10} {solution.cost:>10.4f} {solution.gap:>9.1e}"
        f" {rollout.least_clearance()[0]:>12.3f} {np.sqrt(np.mean(error**2)):>9.2e} {error.max():>9.2e} {final:>9.2e}"
        f" {away if rollout.target.unit == 'm' else np.nan:>9.2e} {rollout.outcome[0]:>9}"
    )
