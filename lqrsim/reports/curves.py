"""The figures of a stress test: success and tracking error over strength, with bands."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lqrsim.errors import Array
from lqrsim.stress.analysis import Success
from lqrsim.view import style
from lqrsim.view.style import RUNS

SIZE = 5.2, 3.7
# One for each policy; lines and markers distinguish them in grey.
COLOURS = (*RUNS, "#e69f00", "#882255")
LINES = ("-", "--", "-.", ":", (0, (6, 1.5, 1, 1.5, 1, 1.5)), (0, (8, 2)))
MARKERS = ("o", "s", "^", "D", "v", "P")


def plot_success(curves: Mapping[str, Sequence[Success]], path: str | os.PathLike[str]) -> Path:
    """Write a figure (png, pdf or svg) of each policy's success over strength, with a band; returns its path."""
    with style.figure(path, size=SIZE) as figure:
        axes = figure.add_subplot()
        for number, (policy, points) in enumerate(curves.items()):
            strengths = [point.cell.strength for point in points]
            value, low, high = 100 * np.array([(p.band.value, p.band.low, p.band.high) for p in points]).T
            _draw(axes, number, policy, strengths, (low, value, high))
        axes.set(xlabel="strength", ylabel="trials that reached their goal (%)", ylim=(-3, 103))
        axes.set_yticks(np.linspace(0, 100, 6))
        _finish(figure, axes, curves)
    return Path(path)


def plot_errors(curves: Mapping[str, Mapping[float, Array]], path: str | os.PathLike[str], *, label: str) -> Path:
    """Write a figure of three quantiles over strength for each policy; logarithmic if they span decades.

    Args:
      curves: policy -> strength -> low, middle and high.
      label: label of the vertical axis.
    """
    with style.figure(path, size=SIZE) as figure:
        axes = figure.add_subplot()
        disturbed = [band for of_strength in curves.values() for strength, band in of_strength.items() if strength > 0]
        known = np.array([value for band in disturbed for value in band if np.isfinite(value) and value > 0])
        decades = len(known) > 0 and known.max() > 100 * known.min()
        for number, (policy, of_strength) in enumerate(curves.items()):
            # Undisturbed errors are tiny, and would take up most of a logarithmic axis.
            shown = {strength: band for strength, band in of_strength.items() if strength > 0 or not decades}
            if shown:
                _draw(axes, number, policy, list(shown), np.array(list(shown.values())).T)
        if decades:
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
        axes.set(xlabel="strength", ylabel=label)
        _finish(figure, axes, curves)
    return Path(path)


def _draw(axes: Axes, number: int, name: str, strengths: Sequence[float], band: Sequence[Array] | Array) -> None:
    low, value, high = band
    colour = COLOURS[number % len(COLOURS)]
    axes.fill_between(strengths, low, high, color=colour, alpha=0.15, linewidth=0)
    # Curves may coincide: lower ones are wider, with larger markers.
    wide = max(4 - number, 1)
    axes.plot(
        strengths, value, linestyle=LINES[number % len(LINES)], color=colour, marker=MARKERS[number % len(MARKERS)],
        markersize=3 + 1.3 * wide, linewidth=0.8 + 0.4 * wide, markerfacecolor="white", label=name, clip_on=False,
    )  # fmt: skip


def _finish(figure: Figure, axes: Axes, curves: Mapping[str, object]) -> None:
    ticks = sorted({round(float(x), 12) for line in axes.lines for x in np.asarray(line.get_xdata())})
    if len(ticks) <= 8:
        axes.set_xticks(ticks)
    axes.margins(x=0.02)
    figure.legend(*axes.get_legend_handles_labels(), loc="upper center", ncols=min(len(curves), 4), handlelength=3)
    rows = -(-len(curves) // 4)
    figure.set_layout_engine("tight", rect=(0, 0, 1, 0.98 - 0.055 * rows))
