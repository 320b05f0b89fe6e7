"""Solvers against one another in a figure: what their plans cost, query by query, and how long they take."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from lqrsim.errors import Array
from lqrsim.view.style import LIMIT, PLAN, RUNS, plain_decades

# A contestant is called "solver, start".
COLOURS: dict[str, str] = {"smoothing": RUNS[0], "iLQR": PLAN, "FDDP": RUNS[1], "IPOPT": RUNS[2]}
MARKERS = {"hover": "o", "line": "s", "search": "D", "search (1e-4)": "d"}
LEAST = 0.1  # percent: a plan that costs less above the cheapest is drawn there


def draw_excess(axes: Axes, excess: Mapping[str, Array], same: float) -> None:
    """What each plan costs more than the cheapest, as a share, a row a contestant; a line at `same`."""
    for row, (name, shares) in enumerate(excess.items()):
        colour, marker = look(name)
        percent = np.maximum(100 * shares, LEAST)
        apart = 0.6 * (0.618 * np.arange(len(percent)) % 1 - 0.5)
        axes.plot(percent, row + apart, marker, color=colour, markersize=3, alpha=0.5, markeredgewidth=0)
        axes.plot([np.nanmedian(percent)] * 2, [row - 0.38, row + 0.38], color=PLAN, linewidth=2)
    axes.axvline(100 * same, color=LIMIT, linestyle=":", linewidth=1.0, zorder=0)
    axes.set(xscale="log", xlabel=f"cost above the cheapest plan found (%; left edge: {LEAST:g} or less)")
    axes.set_yticks(range(len(excess)), list(excess))
    axes.invert_yaxis()
    axes.set_title(f"query by query (bars: medians; dotted: {100 * same:g} %)")
    axes.xaxis.set_major_locator(LogLocator())
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))


def draw_means(axes: Axes, found: Mapping[str, Mapping[str, Array]]) -> None:
    """Mean cost against median time in milliseconds, a point a contestant."""
    middle = {
        name: (float(np.median(one["milliseconds"])), float(np.nanmean(one["cost"]))) for name, one in found.items()
    }
    for name, place in middle.items():
        colour, marker = look(name)
        # Of two that are about the same, one has its name below.
        below = name in ("smoothing, search (1e-4)", "FDDP, hover")
        axes.plot(*place, marker, color=colour, markersize=6)
        axes.annotate(
            name, place, (5, -3 if below else 3), textcoords="offset points", color=colour, fontsize=8,
            va="top" if below else "bottom",
        )  # fmt: skip
    axes.margins(y=0.1)
    axes.set(xscale="log", xlabel="time of a query, median (ms)", ylabel="cost, mean", title="cost and time")
    low, high = min(time for time, _ in middle.values()), max(time for time, _ in middle.values())
    axes.set_xlim(low / 1.3, 3.5 * high)  # room for the last name
    plain_decades(axes.xaxis)


def look(name: str) -> tuple[str, str]:
    """Colour and marker."""
    who, start = name.split(", ")
    return COLOURS[who], MARKERS[start]
