"""Figures of the stress test: success over strength, and what breaks first."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from runner import FolderSettings, Result

from lqrsim.reports import COLOURS, LINES, MARKERS
from lqrsim.simulation.disturbances import PRESETS
from lqrsim.stress.study import POLICIES
from lqrsim.view import style
from lqrsim.view.style import LIMIT, PLAN, RUNS
from paper.common import figure

NAMES = {"differential_drive": "differential drive", "quadrotor": "quadrotor"}
ASIDE = {"moderate": -3, "severe": 3}  # points; the last three presets are so close that their names would touch
WORDS = {
    "smooth": "smoothing", "ilqr": "iLQR", "open_loop": "open loop", "replan": "replanning", "track": "tracking",
    "offset_free": "offset-free",
}  # fmt: skip


def draw_together(config: FolderSettings, result: Result) -> None:
    with figure(config, result, "stress_test", (10, 4.5)) as drawn:
        both = drawn.subplots(1, 2, sharey=True)
        for axes, (name, robot) in zip(both, result["robots"].items(), strict=True):
            draw_success(axes, robot["together"])
            axes.set_title(NAMES[name], pad=50)
        both[0].set_ylabel("trials that reached their goal (%)")
        drawn.legend(*both[0].get_legend_handles_labels(), loc="upper center", ncols=len(POLICIES), handlelength=3)
        drawn.set_layout_engine("tight", rect=(0, 0, 1, 0.93), w_pad=3)


def draw_success(axes: Axes, cells: Sequence[dict[str, Any]]) -> None:
    there = {cell["policy"] for cell in cells}
    for number, policy in enumerate(policy for policy in POLICIES if policy in there):
        mine = [cell for cell in cells if cell["policy"] == policy]
        strengths = [cell["strength"] for cell in mine]
        value, low, high = 100 * np.array([cell["band"] for cell in mine]).T
        axes.fill_between(strengths, low, high, color=COLOURS[number], alpha=0.15, linewidth=0)
        # Curves may lie on each other: those below are wider, and their markers larger.
        thin = min(number, 3)
        axes.plot(
            strengths, value, linestyle=LINES[number], color=COLOURS[number], marker=MARKERS[number],
            markersize=8 - 1.2 * thin, linewidth=2.4 - 0.4 * thin, markerfacecolor="white", label=WORDS[policy],
            clip_on=False, zorder=3,
        )  # fmt: skip
    for name, strength in PRESETS.items():
        axes.axvline(strength, color=LIMIT, linestyle=":", linewidth=0.8)
        above(axes, strength, name)
    axes.set(xscale="log", xlabel="strength of all disturbances together", ylim=(-3, 103))
    style.plain_decades(axes.xaxis)


def above(axes: Axes, strength: float, name: str) -> None:
    """The name of a preset above the axes."""
    axes.annotate(
        name, (strength, 1), (ASIDE.get(name, 0), 3), xycoords=("data", "axes fraction"),
        textcoords="offset points", color=LIMIT, fontsize=8, rotation=90, ha="center", va="bottom",
    )  # fmt: skip


def draw_alone(config: FolderSettings, result: Result) -> None:
    with figure(config, result, "stress_test_alone", (10, 4.6)) as drawn:
        for axes, (name, robot) in zip(drawn.subplots(1, 2, sharex=True), result["robots"].items(), strict=True):
            draw_halves(axes, robot["alone"])
            axes.set_title(NAMES[name], pad=50)
        drawn.set_layout_engine("tight", w_pad=3)


def draw_halves(axes: Axes, kinds: Sequence[dict[str, Any]]) -> None:
    for row, kind in enumerate(kinds):
        half, low, high = (kind["half"][name] for name in ("value", "above", "below"))
        first, last = kind["range"]
        axes.plot([low or first, high or last], [row, row], color=RUNS[0], linewidth=2.4, solid_capstyle="butt")
        if half is not None:
            axes.plot(half, row, "o", color=RUNS[0], markersize=6)
        if high is None:  # beyond all that can be, or was tried
            axes.plot(last, row, ">", color=RUNS[0], markersize=6, markerfacecolor="white")
    for name, strength in PRESETS.items():
        axes.axvline(strength, color=LIMIT, linestyle=":", linewidth=0.8)
        above(axes, strength, name)
    axes.set_yticks(range(len(kinds)), [kind["kind"] for kind in kinds], color=PLAN)
    axes.invert_yaxis()
    axes.margins(x=0.03)
    axes.set(xscale="log", xlabel="strength at which half of the trials fail")
    style.plain_decades(axes.xaxis)
    axes.grid(axis="x", color="#e8ebee", linewidth=0.8)
    axes.set_axisbelow(True)
