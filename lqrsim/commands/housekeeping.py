"""Commands that run the demo, and that manage the cache."""

import itertools
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

import lqrsim as ls
from lqrsim.commands import as_json, console
from lqrsim.commands.options import Json


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Solve, simulate and render both robots.

    Each is solved with smooth(), and its policy is run undisturbed and then disturbed. Writes the solution, both
    rollouts, figures of the policy and of the runs, and a video.

    Exits with 1 if a plan did not converge or an undisturbed run leaves its plan by more than the scenario's bound.
    """

    robots: Annotated[tuple[str, ...], arg(metavar="SCENARIO ...")] = ("differential_drive", "quadrotor")
    """Scenarios, by their names in `lqrsim list`; settings follow after commas: quadrotor,query=3."""
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("videos")
    """Output folder, with a folder for each scenario."""
    seed: int = 0
    """Seed of the disturbances."""
    video: bool = True
    """--no-video skips the videos."""
    quick: bool = False
    """Smaller videos with fewer frames, for a first look."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.control.belief_feedback import BeliefFeedback
        from lqrsim.scenarios.references import folder_name, from_anywhere, resolve
        from lqrsim.simulation.uncertainty_of import tube_under
        from lqrsim.stress.policies import make_controller
        from lqrsim.view import cameras, gl

        console.check_output("--out", self.out)
        scenarios, video = {reference: resolve(reference) for reference in self.robots}, self.video
        if video:
            try:
                gl.bind()
            except ls.InputError as error:
                console.say(f"No videos, everything else works: {error}")
                video = False
        folders = dict[Path, str]()
        for reference, scenario in scenarios.items():
            if (other := folders.setdefault(self.out / folder_name(scenario), reference)) != reference:
                wanted = f"want one of them: {self.out / folder_name(scenario)} is the folder of both"
                raise ls.InputError(f"--robots: got {other} and {reference}, {wanted}")
        rows, failures, misses = [TABLE], list[str](), list[str]()
        results = list[as_json.Object]()
        for reference, scenario in scenarios.items():
            folder = self.out / folder_name(scenario)
            console.say(f"\n== {reference}: {scenario.summary}")
            solution = replace(console.solve_and_print(scenario), scenario=from_anywhere(reference))
            console.save(solution, folder / "solution.npz")
            scenario = scenario.with_duration_of(solution)
            tube, remark = tube_under(scenario.problem, solution, scenario.plant(), scenario.disturbances)
            if remark:
                console.say(remark)
            law = make_controller("feedback", scenario, solution)
            plan, belief = (law.plan, law.belief) if isinstance(law, BeliefFeedback) else (solution, None)
            world, radius = scenario.scene.world, scenario.robot.shape.get("radius", 0.0)
            if solution.cost_to_go is not None:
                path = folder / "policy.png"
                options = {"world": world, "radius": radius, "tube": tube, "belief": belief}
                console.wrote(ls.view.plot_policy(solution, path, **options))
            if not solution.success:
                failures.append(f"{reference}: the plan did not converge ({solution.status.name})")
            runs = dict[str, ls.Rollout]()
            for name, disturbances in {"undisturbed": (), "disturbed": scenario.disturbances}.items():
                options = {"disturbances": disturbances, "seed": self.seed, **scenario.near_enough()}
                with console.progress("simulating", "step") as progress:
                    rollout = ls.simulate(scenario.plant(), plan, controller=law, progress=progress, **options)
                console.say(rollout.summary())
                runs[name] = tube.added_to(rollout) if tube is not None and name == "disturbed" else rollout
                console.save(runs[name], folder / f"{name}.npz")
                rows.append(_row(reference, name, solution, rollout))
            undisturbed = runs["undisturbed"]
            worst, unit = float(undisturbed.tracking_error.max()), undisturbed.tracking_unit
            if not worst <= scenario.tracking_bound:  # also true for the NaN of a diverged run
                bound = f"want <= {scenario.tracking_bound:g} {unit}"
                failures.append(f"{reference}: undisturbed up to {worst:.3g} {unit} off its plan, {bound}")
            console.wrote(ls.view.plot_run(plan, runs, folder / "figure.png", world=world, belief=belief))
            misses += [f"{reference}: {line}" for line in undisturbed.target.of_plan(undisturbed.goal_radius)[1:]]
            if video:  # with the calibrated panes that show the robot's position
                run, (quality, fps) = runs["disturbed"], ("draft", 5) if self.quick else ("standard", 30)
                options = {"insets": cameras.measuring(run.plane), "quality": quality, "fps": fps}
                with console.progress("rendering", "frame") as progress:
                    console.wrote(ls.render(run, folder / "video.mp4", progress=progress, **options))
            if console.wants_result():
                shown = {name: as_json.of_rollout(run, scenario.problem) for name, run in runs.items()}
                results.append({"solution": as_json.of_solution(solution), "runs": shown})
        console.say("\n" + "\n".join(rows))
        for line in [*misses, *(f"FAILED {failure}" for failure in failures)]:
            console.say(line)
        console.result(scenarios=results, misses=misses, failures=failures)
        return 1 if failures else 0


TABLE = (
    f"{'scenario':<20} {'run':<12} {'iterations':>10} {'cost':>10} {'gap':>9} {'clearance m':>12}"
    f" {'rms m':>9} {'max m':>9} {'final m':>9} {'goal m':>9} {'outcome':>9}"
)


def _row(reference: str, run: str, solution: "ls.Solution", rollout: "ls.Rollout") -> str:
    error = rollout.tracking_error[0, rollout.counts[0]]
    final, distance = (math.nan, math.nan) if not rollout.counts[0, -1] else (error[-1], rollout.goal_distance[0])
    return (
        f"{reference:<20} {run:<12} {len(solution.iterations):>10} {solution.cost:>10.4f} {solution.gap:>9.1e}"
        f" {rollout.least_clearance()[0]:>12.3f} {math.sqrt((error**2).mean()):>9.2e} {error.max():>9.2e} {final:>9.2e}"
        f" {distance if rollout.target.unit == 'm' else math.nan:>9.2e} {rollout.outcome[0]:>9}"
    )


@dataclass(frozen=True, kw_only=True)
class Cache:
    """Show or clear the cache of compiled solvers.

    The cache holds compiled code and derived formulas. Without it, the solver is compiled again for each number of
    states and controls, in two to five seconds.

    It holds programs, which are loaded and run: do not share the folder with people you do not trust.
    """

    clear: bool = False
    """Remove everything in it."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.codegen import disk_cache

        if self.clear:
            try:
                removed = disk_cache.clear()
                console.say(f"removed {removed} items from {disk_cache.folder()}")
                console.result(removed=removed, folder=disk_cache.folder())
            except OSError as error:
                raise ls.InputError(f"--clear: got {disk_cache.folder()}, want removable files ({error})") from None
            return 0
        items = disk_cache.items()
        groups = itertools.groupby(sorted(items, key=lambda item: item.what), key=lambda item: item.what)
        for kind, alike in sorted(((kind, list(group)) for kind, group in groups), key=lambda pair: -pair[1][0].used):
            used = time.strftime("%Y-%m-%d %H:%M", time.localtime(alike[0].used))
            count = f" ({len(alike)} items)" if len(alike) > 1 else ""
            console.say(f"{sum(item.size for item in alike) / 1e6:8.2f} MB  last used {used}  {kind}{count}")
        total = sum(item.size for item in items) / 1e6
        console.say(
            f"{len(items)} items, {total:.1f} of at most {disk_cache.LIMIT / 1e6:.0f} MB, in {disk_cache.folder()}"
        )
        listed = [{"what": item.what, "size": item.size, "used": item.used} for item in items]
        console.result(items=listed, limit=disk_cache.LIMIT, folder=disk_cache.folder())
        return 0
