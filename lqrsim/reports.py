"""The report of a stress test: one self-contained page with tables, curves and videos of the worst trials."""

import base64
import json
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files as packaged
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any

import jinja2
import numpy as np
from PIL import Image

from lqrsim.annotations import Bounds, Progress, checked
from lqrsim.errors import Array, InputError, check_path
from lqrsim.results.archive import write_text
from lqrsim.results.goal import OUTCOMES, Target, tracking_unit
from lqrsim.scenarios.packaged import Scenario
from lqrsim.simulation.disturbances import Disturbance, uncertainty_of
from lqrsim.stress import analysis
from lqrsim.stress.results import Results, replay
from lqrsim.stress.statistics import Estimate
from lqrsim.stress.study import DESIGNED, Cell, design_disturbances
from lqrsim.view import gl, style
from lqrsim.view.style import RUNS

SIZE = 5.2, 3.7
# One style for each policy; lines and markers distinguish policies in grey.
COLOURS = (*RUNS, "#e69f00", "#882255", "#56b4e9", "#44aa99")
LINES = ("-", "--", "-.", ":", (0, (6, 1.5, 1, 1.5, 1, 1.5)), (0, (8, 2)), (0, (3, 3)), (0, (8, 2, 1, 2)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
LARGEST = 1_500_000  # bytes, largest video
SIZES = (640, 360), (480, 270), (320, 180)  # the first whose video is small enough is taken
FPS = 15
MOST_VIDEOS = 100  # a page with more videos is too large for a browser
BROKEN_BELOW = 0.95  # success rate below which a policy counts as broken
WORST_EACH = 3  # number of trials that are listed for each policy and sweep
Curves = Mapping[str, Mapping[float, Array]]  # policy -> strength -> low, middle and high
Breaks = Sequence[tuple[str, str, Cell | None]]  # of `analysis.breaks`


def plot_curves(curves: Curves, path: Path, label: str, **scale: Any) -> Path:
    """Write a figure of a band over strength for each policy, with these properties of its vertical axis."""
    with style.figure(path, size=SIZE) as figure:
        axes = figure.add_subplot()
        axes.set(xlabel="strength", ylabel=label)
        for number, (policy, of_strength) in enumerate(curves.items()):
            if not of_strength:
                continue
            strengths, (low, value, high) = list(of_strength), np.array(list(of_strength.values())).T
            colour, line, marker = (styles[number % len(styles)] for styles in (COLOURS, LINES, MARKERS))
            axes.fill_between(strengths, low, high, color=colour, alpha=0.15, linewidth=0)
            wide = max(4 - number, 1)  # curves may coincide, so lower curves are wider, with larger markers
            axes.plot(
                strengths, value, linestyle=line, color=colour, marker=marker, markersize=3 + 1.3 * wide,
                linewidth=0.8 + 0.4 * wide, markerfacecolor="white", label=policy, clip_on=False,
            )  # fmt: skip
        axes.set(**scale)
        ticks = sorted({round(float(x), 12) for of_strength in curves.values() for x in of_strength})
        if len(ticks) <= 8:
            axes.set_xticks(ticks)
        axes.margins(x=0.02)
        figure.legend(*axes.get_legend_handles_labels(), loc="upper center", ncols=min(len(curves), 4), handlelength=3)
        figure.set_layout_engine("tight", rect=(0, 0, 1, 0.98 - 0.055 * -(-len(curves) // 4)))
    return path


def plot_errors(curves: Curves, path: Path, label: str) -> Path:
    """Write a figure of three quantiles over strength for each policy; logarithmic if they span decades."""
    disturbed = [band for of_strength in curves.values() for strength, band in of_strength.items() if strength > 0]
    known = np.array([value for band in disturbed for value in band if np.isfinite(value) and value > 0])
    if not len(known) or known.max() <= 100 * known.min():
        return plot_curves(curves, path, label, ylim=(0, None))
    # Undisturbed errors are tiny, and would take up most of a logarithmic axis.
    curves = {name: {at: band for at, band in curve.items() if at > 0} for name, curve in curves.items()}
    return plot_curves(curves, path, label, yscale="log")


def _video(results: Results, trial: analysis.Trial, problem: str, folder: Path) -> dict[str, Any]:
    """The video of a trial as text, unless there is a problem, with its label and the command that repeats it."""
    command = results.command_of("replay", "--cell", str(trial.cell), "--trial", str(trial.trial))
    title = f"{trial.cell.policy}, {trial.cell.sweep} at strength {trial.cell.strength:g}, trial {trial.trial}"
    outcome = f"{trial.outcome} with {trial.obstacle}" if trial.obstacle else trial.outcome
    label = f"{title}: {outcome} after {trial.ended:.2f} s, least clearance {trial.clearance:.3f} m."
    video = {"label": label, "command": command, "data": "", "problem": problem}
    if problem:
        return video
    from lqrsim.view.render import render  # needs MuJoCo's OpenGL to be chosen

    try:
        rollout = replay(results, trial.cell, trial.trial)
        for width, height in SIZES:
            path = render(rollout, folder / "video.mp4", titles=[title], size=(width, height), fps=FPS)
            if path.stat().st_size <= LARGEST:
                return video | {"data": base64_text(path), "width": width, "height": height}
    except InputError as error:
        return video | {"problem": str(error)}
    return video | {"problem": f"it takes more than {LARGEST / 1e6:g} MB."}


def base64_text(path: Path) -> str:
    """A file in base64, for a page."""
    return base64.b64encode(path.read_bytes()).decode("ascii")


@checked
def report(
    results: Results,
    out: str | os.PathLike[str],
    *,
    videos: Annotated[int, Bounds(at_least=0, at_most=MOST_VIDEOS)] = 4,
    progress: Progress | None = None,
) -> Path:
    """Write a campaign as one self-contained HTML page; returns its path.

    Args:
      videos: number of the worst trials to repeat and render. Without OpenGL the page has no videos, and says so.
    """
    path = check_path("out", out, "the path of a page")
    begun = sorted({shard.cell_number for shard in results.shards_on_disk()})
    table = {cell: results.outcomes(cell, partial=True) for cell in map(results.cells.__getitem__, begun)}
    if not table:
        raise InputError(f"results: got {results.folder}, in which no trial has ended yet, want at least one")
    parts = 2 + videos
    tell = progress or (lambda done, total: None)
    tell(0, parts)
    broken = analysis.breaks(table, below=BROKEN_BELOW)
    # The worst trials of each policy and sweep, by breaking strength, alternating between policies.
    turns = zip_longest(*([group for *group, _ in broken if group[0] == policy] for policy in policies(table)))
    worst = [
        analysis.worst({cell: table[cell] for cell in table if [cell.policy, cell.sweep] == group}, WORST_EACH)
        for turn in turns
        for group in turn
        if group is not None
    ]
    page = _text_and_tables(results, table, broken, worst)
    tell(1, parts)
    with tempfile.TemporaryDirectory() as folder:
        page["sweeps"] = [_sweep(name, results, table, Path(folder)) for name in results.campaign.sweeps]
        tell(2, parts)
        worst_of_each = (next((trial for trial in trials if trial.outcome != "error"), None) for trials in worst)
        shown = [trial for trial in worst_of_each if trial is not None][:videos]
        problem, page["videos"] = gl.missing() if shown else "", []
        if problem:
            page["videos_note"] = f"There are none, for this machine cannot draw pictures: {problem}"
        elif shown:
            page["videos_note"] = (
                "The worst trial of each policy and sweep, alternating between policies, repeated from its number"
                " alone. Line: the plan; trace: the path, coloured by tracking error."
            )
        else:
            page["videos_note"] = "There is no trial to render." if videos else "No videos were requested."
        for number, trial in enumerate(shown):
            page["videos"].append(_video(results, trial, problem, Path(folder)))
            tell(3 + number, parts)
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = packaged("lqrsim.templates").joinpath("page.html.j2").read_text(encoding="utf-8")
    write_text(path, environment.from_string(template).render(page))
    tell(parts, parts)
    return path


def _text_and_tables(
    results: Results, table: analysis.OutcomesByCell, broken: Breaks, worst: Sequence[list[analysis.Trial]]
) -> dict[str, Any]:
    campaign, scenario = results.campaign, results.runner.scenario
    unit = tracking_unit(scenario.problem.dynamics.state_coordinates)
    finished = {cell: outcomes for cell, outcomes in table.items() if len(outcomes) == campaign.trials}
    erred = sum(int((outcomes.outcome == "error").sum()) for outcomes in table.values())
    done, all_trials = sum(map(len, table.values())), len(results.cells) * campaign.trials
    warnings = [] if done == all_trials else [f"Not finished: {done} of {all_trials} trials have been run."]
    if erred:
        warnings.append(f"{erred} trials ended with an error; they count as failures.")
    warnings += [f"{line}." for line in results.stop_reasons()]
    first = campaign.policies[0]
    target, radius = results.solution(first).target, results.goal_radius(first)
    return {
        "title": f"Stress test of {scenario.name}",
        "warnings": warnings,
        "facts": _facts(results, table),
        "commands": {"To resume or repair the campaign": results.command, "This page": results.command_of("report")},
        "asked": json.dumps(results.manifest.campaign, indent=2, ensure_ascii=False),
        "breaks": breaks_table(table, broken),
        "broken_below": f"{100 * BROKEN_BELOW:g} %",
        "reach": f"{radius:g} {target.unit} of the {target.name}",
        "compared": comparison_tables(finished, unit),
        "modes": failure_table(table),
        "measures": measure_tables(table, scenario, target),
        "worst": worst_table(worst, unit),
        "worst_each": WORST_EACH,
        "ranking": analysis.RANKING,
    }


def _facts(results: Results, table: analysis.OutcomesByCell) -> dict[str, list[str]]:
    campaign, manifest, scenario = results.campaign, results.manifest, results.runner.scenario
    problem = scenario.problem
    facts = {
        "Scenario": [
            f"{campaign.scenario}: {scenario.summary}",
            f"Robot {scenario.robot.name} in scene {scenario.scene.name}; {problem.steps} steps of {problem.dt:.4g} s.",
        ],
        "Disturbances, at strength 1": [f"{name}: {_describe(of, scenario)}" for name, of in campaign.sweeps.items()],
        "Strengths": [", ".join(f"{strength:g}" for strength in sorted({cell.strength for cell in table}))],
        "Policies": [", ".join(policies(table)), *filter(None, [manifest.left_out, *manifest.remarks])],
        "Plans": results.plans(),
        "Trials": [
            f"{campaign.trials} of each combination, {sum(map(len, table.values()))} in all, with the same random"
            f" numbers in each combination, of seed {campaign.seed}."
        ],
    }
    designs, designed = results.designs(), [policy for policy in policies(table) if policy in DESIGNED]
    lines = [f"{policy}: {designs[policy]}." for policy in policies(table) if policy in designs.keys() - designed]
    if designed:
        disturbances = design_disturbances(scenario, campaign.design_disturbances)
        unknown = uncertainty_of(scenario.plant(), disturbances).left_out
        lines.append(f"{' and '.join(designed)}: designed for {_describe(disturbances, scenario)}.")
        lines += [f"Left out of the design: {'; '.join(unknown)}."] if unknown else []
    if lines:
        facts["Design disturbances"] = lines
    facts["Versions"] = [", ".join(f"{name} {version}" for name, version in manifest.versions.items())]
    facts["Machine"] = [manifest.machine]
    return facts


def _describe(disturbances: Sequence[Disturbance], scenario: Scenario) -> str:
    plant = scenario.plant()
    return "; ".join(disturbance.describe(plant) for disturbance in disturbances) or "none"


def _sweep(name: str, results: Results, table: analysis.OutcomesByCell, folder: Path) -> dict[str, Any]:
    scenario = results.runner.scenario
    unit = tracking_unit(scenario.problem.dynamics.state_coordinates)
    of_sweep = {cell: outcomes for cell, outcomes in table.items() if cell.sweep == name}
    rates, errors = ({policy: dict[float, Array]() for policy in policies(of_sweep)} for _ in range(2))
    for cell in sorted(of_sweep, key=lambda cell: cell.strength):
        band = table[cell].success.band
        rates[cell.policy][cell.strength] = 100 * np.array([band.low, band.value, band.high])
        errors[cell.policy][cell.strength] = analysis.quantiles(table[cell], "rms")

    def in_words(curves: Curves, spec: str, unit: str = "") -> str:
        """The middles of curves, in words."""
        texts = {name: [f"{curve[at][1]:{spec}}{unit} at {at:g}" for at in curve] for name, curve in curves.items()}
        return "; ".join(f"{name}: {', '.join(middles)}" for name, middles in texts.items())

    percent = {"ylim": (-3, 103), "yticks": np.linspace(0, 100, 6)}
    return {
        "name": name,
        "words": _describe(results.campaign.sweeps[name], scenario),
        "figures": [
            _picture(
                plot_curves(rates, folder / "success.png", "trials that reached their goal (%)", **percent),
                caption="Trials that reached their goal over the strength of the disturbances, 95 % bands.",
                alt=f"Success over strength. {in_words(rates, '.0f', ' %')}.",
            ),
            _picture(
                plot_errors(errors, folder / "errors.png", f"tracking error, rms ({unit})"),
                caption="Root mean square of a trial's distance from the plan, until it ends or collides: median, and"
                " from 5 to 95 % of the trials.",
                alt=f"Median tracking error ({unit}) over strength. {in_words(errors, '.2g')}.",
            ),
        ],
        "success": success_table(name, of_sweep),
    }


def _picture(path: Path, *, caption: str, alt: str) -> dict[str, Any]:
    with Image.open(path) as image:
        width, height = image.size
    return {"data": base64_text(path), "width": width, "height": height, "caption": caption, "alt": alt}


@dataclass(frozen=True)
class PageTable:
    """A table of the page."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def policies(table: Iterable[Cell]) -> list[str]:
    """The names of the policies, in the order of the campaign."""
    return list(dict.fromkeys(cell.policy for cell in table))


def breaks_table(table: analysis.OutcomesByCell, broken: Breaks) -> PageTable:
    """The strength at which each policy breaks in each sweep."""
    rows = list[list[str]]()
    for policy, sweep, cell in broken:
        rate = ["not at any", ""] if cell is None else [f"{cell.strength:g}", _percent(table[cell].success.exact)]
        rows.append([policy, sweep, *rate])
    return PageTable("Where policies break", ("policy", "sweep", "at strength", "success there"), rows)


def _percent(rate: Estimate, unit: str = " %") -> str:
    """A rate with its interval, if the interval has a width."""
    interval = "" if rate.low == rate.high else f" ({100 * rate.low:.1f} to {100 * rate.high:.1f})"
    return f"{100 * rate.value:.1f}{interval}{unit}"


def comparison_tables(table: analysis.OutcomesByCell, unit: str) -> list[PageTable]:
    """Pairs of policies on the same trials, a table for each pair and sweep; `unit` is the unit of tracking errors."""
    factor, unit = (1e3, "mm") if unit == "m" else (1.0, unit)
    head = (
        "strength", "only the first", "only the second", "p", "difference in success (%)", "both reached",
        f"difference in rms ({unit})",
    )  # fmt: skip
    tables = dict[str, list[list[str]]]()
    for pair in analysis.comparisons(table):
        caption = f"{pair.first.sweep}: {pair.first.policy} against {pair.second.policy}"
        tables.setdefault(caption, []).append([
            f"{pair.first.strength:g}", str(pair.only_first), str(pair.only_second),
            f"{pair.adjusted:.2g}", _percent(pair.success, unit=""), str(pair.both),
            "" if pair.rms is None else _between(pair.rms.value, pair.rms.low, pair.rms.high, factor),
        ])  # fmt: skip
    return [PageTable(caption, head, rows) for caption, rows in tables.items()]


def _between(value: float, low: float, high: float, scale: float = 1.0) -> str:
    if not np.isfinite(value):
        return "none" if np.isnan(value) else "infinite"
    return f"{scale * value:.3g}" if low == high else f"{scale * value:.3g} ({scale * low:.3g} to {scale * high:.3g})"


def failure_table(table: analysis.OutcomesByCell) -> PageTable:
    """The numbers of failures of each kind in each cell, and the obstacles that were hit."""
    kinds = [outcome for outcome in OUTCOMES if outcome != "reached"]
    rows = []
    for cell, outcomes in table.items():
        modes = analysis.modes(outcomes)
        counts = [sum(n for (outcome, _), n in modes.items() if outcome == kind) for kind in kinds]
        hit = [f"{obstacle} {count}" for (_, obstacle), count in modes.items() if obstacle]
        more = f", and {len(hit) - 4} more" if len(hit) > 4 else ""
        if modes:
            rows.append([
                cell.policy, cell.sweep, f"{cell.strength:g}", str(len(outcomes)), *map(str, counts),
                ", ".join(hit[:4]) + more,
            ])  # fmt: skip
    head = ("policy", "sweep", "strength", "trials", *kinds, "collided with")
    return PageTable("Failures by how they ended, and the obstacles that were hit most", head, rows)


def measure_tables(table: analysis.OutcomesByCell, scenario: Scenario, target: Target) -> list[PageTable]:
    """Quantiles of all measures, a table for each sweep."""
    units = dict(analysis.MEASURES)
    of_controls = set(scenario.robot.dynamics.control_coordinates.units)
    if len(of_controls) == 1:
        unit = of_controls.pop()
        units["effort"] = f"{unit}² s" if unit.isalpha() else f"({unit})² s"
    units["saturated"] = "share of periods"
    units |= dict.fromkeys(("worst", "rms", "final"), tracking_unit(scenario.problem.dynamics.state_coordinates))
    units["goal"] = target.unit
    head = ["policy", "strength", *(f"{name} ({unit})" if unit else name for name, unit in units.items())]
    tables = dict[str, list[list[str]]]()
    for cell, outcomes in table.items():
        quantiles = [analysis.quantiles(outcomes, name) for name in units]
        values = [_between(middle, low, high) for low, middle, high in quantiles]
        tables.setdefault(cell.sweep, []).append([cell.policy, f"{cell.strength:g}", *values])
    return [PageTable(sweep, head, rows) for sweep, rows in tables.items()]


def worst_table(worst: Sequence[list[analysis.Trial]], unit: str) -> PageTable:
    """The worst trials of each policy and sweep; `unit` is the unit of tracking errors."""
    rows = [
        [
            trial.cell.policy, trial.cell.sweep, f"{trial.cell.strength:g}", str(trial.trial), trial.outcome,
            trial.obstacle, f"{trial.ended:.2f}", f"{trial.clearance:.3f}", f"{trial.worst:.3f}",
        ]
        for trials in worst
        for trial in trials
    ]  # fmt: skip
    head = (
        "policy", "sweep", "strength", "trial", "outcome", "collided with", "ended (s)", "least clearance (m)",
        f"largest error ({unit})",
    )  # fmt: skip
    return PageTable("Worst trials", head, rows)


def success_table(sweep: str, table: analysis.OutcomesByCell) -> PageTable:
    """The numbers of trials of each policy that reached the goal in a sweep, a row for each strength."""

    def entry(cell: Cell) -> str:
        if cell not in table:
            return "not run"
        rate = table[cell].success
        return f"{rate.reached}/{rate.trials}, {'deterministic: 1 run' if rate.alike else _percent(rate.exact)}"

    names, strengths = policies(table), sorted({cell.strength for cell in table})
    rows = [[f"{s:g}", *(entry(Cell(policy, sweep, s)) for policy in names)] for s in strengths]
    return PageTable(f"{sweep}: trials that reached their goal", ("strength", *names), rows)
