"""The report of a stress test: one page that needs no network, with tables, curves and videos of the worst trials."""

import base64
import json
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files as packaged
from itertools import zip_longest
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from PIL import Image

from lqrsim.errors import InputError, check_count, check_function, check_kind, check_path
from lqrsim.reports.curves import plot_errors, plot_success
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.files import replacing
from lqrsim.results.goal import Target, tracking_unit
from lqrsim.scenarios.packaged import Scenario
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.outcomes import OUTCOMES
from lqrsim.stress import analysis
from lqrsim.stress.results import Results, replay
from lqrsim.stress.specification import Campaign, Cell
from lqrsim.stress.statistics import Estimate
from lqrsim.view import gl

BELOW = 0.95  # success below which a policy counts as broken
LARGEST = 1_500_000  # bytes of a video
SIZES = (640, 360), (480, 270), (320, 180)  # the first with which a video is small enough
FPS = 15
MOST_VIDEOS = 100  # a page with more is too large for a browser
EACH = 3  # worst trials that are listed of each policy and sweep


@dataclass(frozen=True)
class Rows:
    """A table of the page."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def report(
    results: Results,
    out: str | os.PathLike[str],
    *,
    videos: int = 4,
    progress: Callable[[int, int], object] | None = None,
) -> Path:
    """Writes one HTML page of a campaign, with everything in it; returns its path.

    Args:
      videos: how many of the worst trials to run again and film. Without OpenGL the page says that there are none.
      progress: called with the parts that are done, and all of them.

    Raises:
      InputError: nothing has been run yet; something is damaged; the scenario is one of yours, and `results` was not
        given it; or the page cannot be written.
    """
    check_kind("results", results, Results, "Results, such as run_campaign(...) returns")
    check_count("videos", videos, at_least=0, at_most=MOST_VIDEOS)
    check_function("progress", progress, "a function of how many parts are done, of how many", arguments=2)
    path = check_path("out", out, "the path of a page")
    scenario, missing = results.trials.scenario, Counter[Cell]()
    for cell, _, count in results.missing:
        missing[cell] += count
    begun = [cell for cell in results.cells if missing[cell] < results.campaign.trials]
    table = {cell: results.outcomes(cell, partial=True) for cell in begun}
    if not table:
        raise InputError(f"results: got {results.folder}, in which no trial has ended yet, want some that have")
    parts = 2 + videos
    tell = progress or (lambda done, total: None)
    tell(0, parts)
    page = _page(results, table, scenario)
    tell(1, parts)
    with tempfile.TemporaryDirectory() as folder:
        page["sweeps"] = [
            _sweep(name, table, scenario, results.campaign, Path(folder)) for name in results.campaign.sweeps
        ]
        tell(2, parts)
        films = _films(results, table, videos, Path(folder))
        page["videos_note"] = next(films)
        page["videos"] = []
        for number, film in enumerate(films):
            page["videos"].append(film)
            tell(3 + number, parts)
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(packaged("lqrsim.reports").joinpath("page.html.j2").read_text(encoding="utf-8"))
    with replacing(path) as unfinished:
        unfinished.write_text(template.render(page), encoding="utf-8")
    tell(parts, parts)
    return path


def _page(results: Results, table: analysis.Table, scenario: Scenario) -> dict[str, Any]:
    """All of the page but for pictures."""
    campaign, manifest = results.campaign, results.manifest
    whole = {cell: one for cell, one in table.items() if len(one) == campaign.trials}
    erred = sum(int((one.outcome == "error").sum()) for one in table.values())
    done, all_trials = sum(map(len, table.values())), len(results.cells) * campaign.trials
    warnings = [] if done == all_trials else [f"Not finished: {done} of {all_trials} trials have been run."]
    if erred:
        warnings.append(f"{erred} trials did not run through; they count as failures.")
    commands = {
        "To go on with the campaign, or to repair it": results.command,
        "This page": results.command_of("report"),
    }
    return {
        "title": f"Stress test of {scenario.name}",
        "warnings": warnings,
        "facts": _facts(results, table, scenario),
        "commands": commands,
        "asked": json.dumps(manifest.get("campaign"), indent=2, ensure_ascii=False),
        "breaks": _breaks(table),
        "breaks_note": f"The least strength that was tried at which the 95 % interval of the success rate lies wholly"
        f" below {100 * BELOW:g} %, the least first.",
        "success_note": f"A trial succeeds if it ends within {_reach(results, scenario)}, without a collision"
        " until then. Tables have exact (Clopper-Pearson) intervals of 95 %, the bands of the curves are Wilson's."
        " Where nothing is random all trials are one run, and there is no interval.",
        "compared": _compared(whole, tracking_unit(_space(scenario))),
        "compared_note": "Trials of the same number have the same random numbers, whatever the policy. What tells"
        " policies apart are the trials that only one of them reached: p is McNemar's exact test, raised for the number"
        " of comparisons on this page (Holm). Differences are the first less the second, with 95 % intervals: of"
        " success Tango's score interval, of rms Student's, among the trials that both reached. Where nothing is random"
        " there is nothing to compare.",
        "modes": _modes(table),
        "measures": _measures(table, scenario),
        "measures_note": "Median, and from 5 to 95 % of the trials in parentheses. Until a trial collides or is lost;"
        " final error, distance from the goal and cost are of those that ran to the end.",
        "worst": _worst(table, tracking_unit(_space(scenario))),
        "worst_note": f"Of each policy and sweep the {EACH} worst. {analysis.RANKING}",
    }


def _space(scenario: Scenario) -> Coordinates:
    return scenario.problem.dynamics.state_coordinates


def _reach(results: Results, scenario: Scenario) -> str:
    """Within which distance of what a trial has reached its goal."""
    target = next(iter(results.trials.solutions.values())).target
    asked = results.campaign
    return f"{scenario.reach(asked.goal_radius, asked.goal_tolerance):g} {target.unit} of the {target.name}"


def _facts(results: Results, table: analysis.Table, scenario: Scenario) -> dict[str, list[str]]:
    campaign, manifest = results.campaign, results.manifest
    facts = {
        "Scenario": [
            f"{campaign.scenario}: {scenario.summary}",
            f"Robot {scenario.robot.name} in scene {scenario.scene.name}; {scenario.problem.steps} control periods of"
            f" {scenario.problem.dt:.4g} s.",
        ],
        "Disturbances, at strength 1": [
            f"{name}: {_words(disturbances, scenario)}" for name, disturbances in campaign.sweeps.items()
        ],
        "Strengths": [", ".join(f"{strength:g}" for strength in sorted({cell.strength for cell in table}))],
        "Policies": [", ".join(_policies(table)), *([manifest["left_out"]] if manifest.get("left_out") else [])],
        "Plans": results.plans(),
        "Trials": [
            f"{campaign.trials} of each combination, {sum(map(len, table.values()))} in all, with the same random"
            f" numbers in each, of seed {campaign.seed}."
        ],
    }
    if manifest.get("versions"):
        facts["Versions"] = [", ".join(f"{name} {version}" for name, version in manifest["versions"].items())]
    if manifest.get("machine"):
        facts["Machine"] = [str(manifest["machine"])]
    return facts


def _words(disturbances: Sequence[Disturbance], scenario: Scenario) -> str:
    plant = scenario.plant()
    return "; ".join(disturbance.describe(plant) for disturbance in disturbances) or "none"


def _policies(table: analysis.Table) -> list[str]:
    return list(dict.fromkeys(cell.policy for cell in table))


def _breaks(table: analysis.Table) -> Rows:
    rows = [
        [
            one.policy, one.sweep, "not at any" if one.strength is None else f"{one.strength:g}",
            "" if one.success is None else _percent(one.success),
        ]
        for one in analysis.breaks(table, below=BELOW)
    ]  # fmt: skip
    return Rows("Where policies break", ("policy", "sweep", "at strength", "success there"), rows)


def _percent(one: Estimate, scale: float = 100.0, unit: str = " %") -> str:
    """A share with its interval, which is left out where it is known."""
    if one.low == one.high:
        return f"{scale * one.value:.1f}{unit}"
    return f"{scale * one.value:.1f} ({scale * one.low:.1f} to {scale * one.high:.1f}){unit}"


def _compared(table: analysis.Table, unit: str) -> list[Rows]:
    found = analysis.comparisons(table)
    factor, unit = (1e3, "mm") if unit == "m" else (1.0, unit)
    head = (
        "strength", "only the first", "only the second", "p", "difference in success (%)", "both reached",
        f"difference in rms ({unit})",
    )  # fmt: skip
    groups = dict.fromkeys((one.first.sweep, one.first.policy, one.second.policy) for one in found)
    return [
        Rows(
            f"{sweep}: {first} against {second}",
            head,
            [
                [
                    f"{one.first.strength:g}", str(one.pairs.only_first), str(one.pairs.only_second),
                    f"{one.adjusted:.2g}", _percent(one.success, unit=""), str(one.both),
                    "" if one.rms is None else _between(one.rms.value, one.rms.low, one.rms.high, factor),
                ]
                for one in found
                if (one.first.sweep, one.first.policy, one.second.policy) == (sweep, first, second)
            ],
        )
        for sweep, first, second in groups
    ]  # fmt: skip


def _between(value: float, low: float, high: float, scale: float = 1.0) -> str:
    if not np.isfinite(value):
        return "none" if np.isnan(value) else "infinite"
    return f"{scale * value:.3g}" if low == high else f"{scale * value:.3g} ({scale * low:.3g} to {scale * high:.3g})"


def _modes(table: analysis.Table) -> Rows:
    kinds = [outcome for outcome in OUTCOMES if outcome != "reached"]
    rows = []
    for cell, outcomes in table.items():
        modes = analysis.modes(outcomes)
        counts = [sum(n for (outcome, _), n in modes.items() if outcome == kind) for kind in kinds]
        hit = [f"{obstacle} {count}" for (_, obstacle), count in modes.items() if obstacle]
        more = f", and {len(hit) - 4} more" if len(hit) > 4 else ""
        if modes:
            rows.append([*_name(cell), str(len(outcomes)), *map(str, counts), ", ".join(hit[:4]) + more])
    head = ("policy", "sweep", "strength", "trials", *kinds, "collided with")
    return Rows("Failures by how they ended, and the obstacles that were hit most", head, rows)


def _name(cell: Cell) -> list[str]:
    return [cell.policy, cell.sweep, f"{cell.strength:g}"]


def _measures(table: analysis.Table, scenario: Scenario) -> list[Rows]:
    units = dict(analysis.MEASURES)
    of_controls = set(scenario.robot.dynamics.control_coordinates.units)
    if len(of_controls) == 1:
        unit = of_controls.pop()
        units["effort"] = f"{unit}² s" if unit.isalpha() else f"({unit})² s"
    units["saturated"] = "share of periods"
    units |= dict.fromkeys(("worst", "rms", "final"), tracking_unit(_space(scenario)))
    units["goal"] = Target(_space(scenario), scenario.problem.weighed_goal, np.zeros((1, len(_space(scenario))))).unit
    head = ["policy", "strength", *(f"{name} ({unit})" if unit else name for name, unit in units.items())]
    tables = []
    for sweep in dict.fromkeys(cell.sweep for cell in table):
        rows = []
        for cell, outcomes in table.items():
            if cell.sweep == sweep:
                quantiles = [analysis.quantiles(outcomes, name) for name in units]
                values = [_between(middle, low, high) for low, middle, high in quantiles]
                rows.append([cell.policy, f"{cell.strength:g}", *values])
        tables.append(Rows(sweep, head, rows))
    return tables


def _groups(table: analysis.Table) -> list[tuple[str, str]]:
    """Policies and sweeps, what breaks first first, policies taking turns."""
    order = [(one.policy, one.sweep) for one in analysis.breaks(table, below=BELOW)]
    turns = zip_longest(*([group for group in order if group[0] == policy] for policy in _policies(table)))
    return [group for turn in turns for group in turn if group is not None]


def _worst_of(table: analysis.Table, group: tuple[str, str]) -> list[analysis.Trial]:
    return analysis.worst({cell: one for cell, one in table.items() if (cell.policy, cell.sweep) == group}, EACH)


def _worst(table: analysis.Table, unit: str) -> Rows:
    rows = [
        [
            *_name(one.cell), str(one.trial), one.outcome, one.obstacle, f"{one.ended:.2f}",
            f"{one.clearance:.3f}", f"{one.worst:.3f}",
        ]
        for group in _groups(table)
        for one in _worst_of(table, group)
    ]  # fmt: skip
    head = (
        "policy", "sweep", "strength", "trial", "outcome", "collided with", "ended (s)", "least clearance (m)",
        f"largest error ({unit})",
    )  # fmt: skip
    return Rows("Worst trials", head, rows)


def _sweep(name: str, table: analysis.Table, scenario: Scenario, campaign: Campaign, folder: Path) -> dict[str, Any]:
    """The figures and the table of one sweep."""
    policies = list(dict.fromkeys(cell.policy for cell in table if cell.sweep == name))
    unit = tracking_unit(_space(scenario))
    curves = {policy: analysis.degradation(table, policy, name) for policy in policies}
    errors = {
        policy: {point.cell.strength: analysis.quantiles(table[point.cell], "rms") for point in points}
        for policy, points in curves.items()
    }
    strengths = sorted({point.cell.strength for points in curves.values() for point in points})
    of_cell = {(point.cell.policy, point.cell.strength): point for points in curves.values() for point in points}
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
        "words": _words(campaign.sweeps[name], scenario),
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
        "success": Rows(
            f"{name}: trials that reached their goal",
            ("strength", *policies),
            [[f"{s:g}", *(_share(of_cell.get((policy, s))) for policy in policies)] for s in strengths],
        ),
    }


def _share(point: analysis.Success | None) -> str:
    if point is None:
        return "not run"
    count = f"{point.reached}/{point.trials}"
    return f"{count}, deterministic: 1 run" if point.alike else f"{count}, {_percent(point.exact)}"


def _picture(path: Path, *, caption: str, alt: str) -> dict[str, Any]:
    with Image.open(path) as image:
        width, height = image.size
    return {"data": _text(path), "width": width, "height": height, "caption": caption, "alt": alt}


def _text(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode("ascii")


def _films(results: Results, table: analysis.Table, count: int, folder: Path) -> Iterator[Any]:
    """What there is to say of them all, and then each of them."""
    chosen = [
        next((one for one in _worst_of(table, group) if one.outcome != "error"), None) for group in _groups(table)
    ]
    chosen = [one for one in chosen if one is not None][:count]
    problem = ""
    if chosen:
        try:
            gl.bind()
        except InputError as error:
            problem = str(error)
    if not chosen:
        yield "None were asked for." if count == 0 else "There is no trial to film."
    elif problem:
        yield f"There are none, for no pictures can be drawn here: {problem}"
    else:
        yield (
            "The worst trial of a policy and a sweep, policies taking turns, run again from its number alone. Line:"
            " the plan; trace: what was driven, coloured by tracking error."
        )
    for one in chosen:
        film = {
            "label": _label(one),
            "command": results.command_of("replay", "--cell", str(one.cell), "--trial", str(one.trial)),
            "data": "",
            "problem": problem,
        }
        yield film if problem else film | _film(results, one, folder)


def _label(one: analysis.Trial) -> str:
    what = f" with {one.obstacle}" if one.obstacle else ""
    return (
        f"{one.cell.policy}, {one.cell.sweep} at strength {one.cell.strength:g}, trial {one.trial}:"
        f" {one.outcome}{what} after {one.ended:.2f} s, least clearance {one.clearance:.3f} m."
    )


def _film(results: Results, one: analysis.Trial, folder: Path) -> dict[str, Any]:
    """The video as text, or why there is none."""
    from lqrsim.view.render import render  # needs MuJoCo's OpenGL to be chosen

    try:
        rollout = replay(results, one.cell, one.trial)
        title = f"{one.cell.policy}, {one.cell.sweep} at strength {one.cell.strength:g}, trial {one.trial}"
        for width, height in SIZES:
            path = render(rollout, folder / "video.mp4", titles=[title], size=(width, height), fps=FPS)
            if path.stat().st_size <= LARGEST:
                return {"data": _text(path), "width": width, "height": height}
    except InputError as error:
        return {"problem": str(error)}
    return {"problem": f"it takes more than {LARGEST / 1e6:g} MB."}
