"""The report of a stress test: one self-contained page with tables, curves and videos of the worst trials."""

import json
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from importlib.resources import files as packaged
from pathlib import Path
from typing import Any

import jinja2
from PIL import Image

from lqrsim.errors import InputError, check_count, check_function, check_kind, check_path
from lqrsim.reports import tables
from lqrsim.reports.curves import plot_errors, plot_success
from lqrsim.reports.videos import base64_text, videos_of_worst
from lqrsim.results.goal import tracking_unit
from lqrsim.results.save_load import replacing
from lqrsim.scenarios.packaged import Scenario
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.uncertainty_of import uncertainty_of
from lqrsim.stress import analysis
from lqrsim.stress.policies import DESIGNED, design_disturbances
from lqrsim.stress.results import Results
from lqrsim.stress.specification import Campaign, Cell

MOST_VIDEOS = 100  # a page with more is too large for a browser


def report(
    results: Results,
    out: str | os.PathLike[str],
    *,
    videos: int = 4,
    progress: Callable[[int, int], object] | None = None,
) -> Path:
    """Write a campaign as one self-contained HTML page; returns its path.

    Args:
      results: the campaign.
      out: FILE.html.
      videos: number of the worst trials to repeat and render. Without OpenGL the page has none, and says so.
      progress: called with the numbers of parts that are done and of all parts.

    Returns:
      The path of the page.

    Raises:
      InputError: no trial has been run yet; a file is damaged; `results` was not given a scenario of your own; or the
        page cannot be written.
    """
    check_kind("results", results, Results, "Results, such as run_campaign(...) returns")
    check_count("videos", videos, at_least=0, at_most=MOST_VIDEOS)
    check_function("progress", progress, "a function of the numbers of parts that are done and of all", arguments=2)
    path = check_path("out", out, "the path of a page")
    scenario, missing = results.trials.scenario, Counter[Cell]()
    for cell, _, count in results.missing:
        missing[cell] += count
    begun = [cell for cell in results.cells if missing[cell] < results.campaign.trials]
    table = {cell: results.outcomes(cell, partial=True) for cell in begun}
    if not table:
        raise InputError(f"results: got {results.folder}, in which no trial has ended yet, want at least one")
    parts = 2 + videos
    tell = progress or (lambda done, total: None)
    tell(0, parts)
    page = _text_and_tables(results, table, scenario)
    tell(1, parts)
    with tempfile.TemporaryDirectory() as folder:
        page["sweeps"] = [
            _sweep(name, table, scenario, results.campaign, Path(folder)) for name in results.campaign.sweeps
        ]
        tell(2, parts)
        rendered = videos_of_worst(results, table, videos, Path(folder))
        page["videos_note"] = next(rendered)
        page["videos"] = []
        for number, video in enumerate(rendered):
            page["videos"].append(video)
            tell(3 + number, parts)
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(packaged("lqrsim.reports").joinpath("page.html.j2").read_text(encoding="utf-8"))
    with replacing(path) as unfinished:
        unfinished.write_text(template.render(page), encoding="utf-8")
    tell(parts, parts)
    return path


def _text_and_tables(results: Results, table: analysis.Table, scenario: Scenario) -> dict[str, Any]:
    """All of the page except pictures."""
    campaign, manifest = results.campaign, results.manifest
    whole = {cell: one for cell, one in table.items() if len(one) == campaign.trials}
    erred = sum(int((one.outcome == "error").sum()) for one in table.values())
    done, all_trials = sum(map(len, table.values())), len(results.cells) * campaign.trials
    warnings = [] if done == all_trials else [f"Not finished: {done} of {all_trials} trials have been run."]
    if erred:
        warnings.append(f"{erred} trials ended with an error; they count as failures.")
    warnings += [f"{line}." for line in results.came_to_nothing()]
    commands = {
        "To resume or repair the campaign": results.command,
        "This page": results.command_of("report"),
    }
    return {
        "title": f"Stress test of {scenario.name}",
        "warnings": warnings,
        "facts": _facts(results, table, scenario),
        "commands": commands,
        "asked": json.dumps(manifest.get("campaign"), indent=2, ensure_ascii=False),
        "breaks": tables.breaks_table(table),
        "breaks_note": f"The lowest tested strength at which the 95 % interval of the success rate is entirely"
        f" below {100 * tables.BROKEN_BELOW:g} %, in ascending order.",
        "success_note": f"A trial succeeds if it ends within {_reach(results, scenario)}, without a collision"
        " until then. Tables have exact (Clopper-Pearson) intervals of 95 %, the bands of the curves are Wilson's."
        " If nothing is random all trials are the same run, and there is no interval.",
        "compared": tables.comparison_tables(whole, tracking_unit(tables.state_coordinates(scenario))),
        "compared_note": "Trials of the same number have the same random numbers for all policies. Policies differ in"
        " the trials in which only one of them succeeded: p is from McNemar's exact test, corrected for the number of"
        " comparisons on this page (Holm). Differences are first minus second, with 95 % intervals: Tango's score"
        " interval for success, Student's for the rms of trials in which both succeeded. If nothing is random there is"
        " nothing to compare.",
        "modes": tables.failure_table(table),
        "measures": tables.measure_tables(table, scenario),
        "measures_note": "Median, and 5 to 95 % quantiles in parentheses, until a trial collides or diverges. Final"
        " error, distance from the goal and cost are those of trials that ran to the end.",
        "worst": tables.worst_table(table, tracking_unit(tables.state_coordinates(scenario))),
        "worst_note": f"Of each policy and sweep the {tables.WORST_EACH} worst. {analysis.RANKING}",
    }


def _reach(results: Results, scenario: Scenario) -> str:
    """The distance from the goal, as text, within which a trial has reached it."""
    target = next(iter(results.trials.solutions.values())).target
    campaign = results.campaign
    radius = scenario.target_radius(campaign.goal_radius, campaign.goal_tolerance)
    return f"{radius:g} {target.unit} of the {target.name}"


def _facts(results: Results, table: analysis.Table, scenario: Scenario) -> dict[str, list[str]]:
    campaign, manifest = results.campaign, results.manifest
    facts = {
        "Scenario": [
            f"{campaign.scenario}: {scenario.summary}",
            f"Robot {scenario.robot.name} in scene {scenario.scene.name}; {scenario.problem.steps} control periods of"
            f" {scenario.problem.dt:.4g} s.",
        ],
        "Disturbances, at strength 1": [
            f"{name}: {_describe(disturbances, scenario)}" for name, disturbances in campaign.sweeps.items()
        ],
        "Strengths": [", ".join(f"{strength:g}" for strength in sorted({cell.strength for cell in table}))],
        "Policies": [
            ", ".join(tables.policies(table)),
            *([manifest["left_out"]] if manifest.get("left_out") else []),
            *manifest["remarks"],
        ],
        "Plans": results.plans(),
        "Trials": [
            f"{campaign.trials} of each combination, {sum(map(len, table.values()))} in all, with the same random"
            f" numbers in each combination, of seed {campaign.seed}."
        ],
    }
    if designed := [policy for policy in tables.policies(table) if policy in DESIGNED]:
        disturbances = design_disturbances(scenario, campaign.design_disturbances)
        unknown = uncertainty_of(scenario.plant(), disturbances).left_out
        facts["Design disturbances"] = [
            f"{' and '.join(designed)}: designed for {_describe(disturbances, scenario)}.",
            *([f"Left out of the design: {'; '.join(unknown)}."] if unknown else []),
        ]
    if manifest.get("versions"):
        facts["Versions"] = [", ".join(f"{name} {version}" for name, version in manifest["versions"].items())]
    if manifest.get("machine"):
        facts["Machine"] = [str(manifest["machine"])]
    return facts


def _describe(disturbances: Sequence[Disturbance], scenario: Scenario) -> str:
    plant = scenario.plant()
    return "; ".join(disturbance.describe(plant) for disturbance in disturbances) or "none"


def _sweep(name: str, table: analysis.Table, scenario: Scenario, campaign: Campaign, folder: Path) -> dict[str, Any]:
    """The figures and the table of one sweep."""
    policies = list(dict.fromkeys(cell.policy for cell in table if cell.sweep == name))
    unit = tracking_unit(tables.state_coordinates(scenario))
    curves = {policy: analysis.degradation(table, policy, name) for policy in policies}
    errors = {
        policy: {point.cell.strength: analysis.quantiles(table[point.cell], "rms") for point in points}
        for policy, points in curves.items()
    }
    shares = "; ".join(
        f"{policy}: {', '.join(f'{100 * point.band.value:.0f} % at {point.cell.strength:g}' for point in points)}"
        for policy, points in curves.items()
    )
    medians = "; ".join(
        f"{policy}: {', '.join(f'{values[1]:.2g} at {strength:g}' for strength, values in of_strength.items())}"
        for policy, of_strength in errors.items()
    )
    return {
        "name": name,
        "words": _describe(campaign.sweeps[name], scenario),
        "figures": [
            _picture(
                plot_success(curves, folder / "success.png"),
                caption="Trials that reached their goal over the strength of the disturbances, 95 % bands.",
                alt=f"Success over strength. {shares}.",
            ),
            _picture(
                plot_errors(errors, folder / "errors.png", label=f"tracking error, rms ({unit})"),
                caption="Root mean square of a trial's distance from the plan, until it ends or collides: median, and"
                " from 5 to 95 % of the trials.",
                alt=f"Median tracking error ({unit}) over strength. {medians}.",
            ),
        ],
        "success": tables.success_table(name, curves),
    }


def _picture(path: Path, *, caption: str, alt: str) -> dict[str, Any]:
    with Image.open(path) as image:
        width, height = image.size
    return {"data": base64_text(path), "width": width, "height": height, "caption": caption, "alt": alt}
