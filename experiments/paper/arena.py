"""What Fig. 2 and its neighbours show: the arena from above, the robot in it, and which way its paths go."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.view import plots
from lqrsim.view.style import LIMIT, PLAN, RUNS

COLOURS = (*RUNS, "#e69f00", "#56b4e9", "#f0e442")  # of the commonest ways
WALL = 0.06  # metres that are shown of them
RARE = "#c9ced5"  # the others have their letter alone
DISTURBED, UNDISTURBED = RUNS[0], RUNS[1]


def arena(axes: Axes, scenario: ls.Scenario) -> None:
    """Pillars and walls from above, and the wished start and goal."""
    ends = np.array([scenario.problem.start, scenario.problem.goal])[:, :2]
    world = scenario.scene.world.seen_by("xy")
    plots.draw_in_plane(axes, world, *plots.bounds(ends, world, WALL), scenario.robot.radius)
    axes.spines[:].set_visible(False)
    axes.set(xticks=range(-2, 3), yticks=range(-3, 4))


def draw_plan(axes: Axes, scenario: ls.Scenario, plan: ls.Trajectory, colour: str, every: float = 1.0) -> None:
    """A plan in the arena, with the robot every so many seconds: its outline, and where it faces."""
    arena(axes, scenario)
    axes.plot(*plan.states[:, :2].T, color=colour)
    shown = plan.states[np.rint(np.arange(0, plan.horizon + 1e-9, every) / plan.dt).astype(int)]
    middle, radius = shown[:, :2], scenario.robot.radius
    size = np.full(len(shown), 2 * radius)
    axes.add_collection(
        EllipseCollection(
            size, size, np.zeros(len(shown)), units="xy", offsets=middle, offset_transform=axes.transData,
            facecolors=to_rgba(colour, 0.15), edgecolors=colour, linewidths=0.7, zorder=3,
        )
    )  # fmt: skip
    rim = middle + radius * np.stack([np.cos(shown[:, 2]), np.sin(shown[:, 2])], axis=1)
    axes.add_collection(LineCollection(list(np.stack([middle, rim], axis=1)), colors=PLAN, linewidths=1.0, zorder=3))


def draw_runs(drawn: Figure, scenario: ls.Scenario, undisturbed: ls.Rollout, disturbed: ls.Rollout) -> None:
    """A plan and its runs from above, and over time how far they are from it, and from the obstacles."""
    left, right = drawn.add_gridspec(1, 2, width_ratios=(1, 1.5), left=0.06, right=0.98, bottom=0.1, top=0.88)
    above = drawn.add_subplot(left)
    arena(above, scenario)
    above.add_collection(LineCollection(list(disturbed.states[:, :, :2]), colors=DISTURBED, linewidths=0.4, alpha=0.2))
    above.plot(*disturbed.plan.states[:, :2].T, "--", color=PLAN, linewidth=1.0)
    above.set_title(f"{disturbed.trials} disturbed runs; dashed: plan")
    rows = right.subgridspec(2, 1, hspace=0.4)
    off, free = drawn.add_subplot(rows[0]), drawn.add_subplot(rows[1])
    spread(off, disturbed.times, 1e3 * disturbed.tracking_error, highest=True)
    off.plot(undisturbed.times, 1e3 * undisturbed.tracking_error[0], ":", color=UNDISTURBED, label="undisturbed")
    off.set(ylabel="off the plan (mm)", title="tracking error")
    spread(free, disturbed.times, disturbed.clearance, highest=False)
    free.plot(undisturbed.times, undisturbed.clearance[0], ":", color=UNDISTURBED)
    free.set(xlabel="time (s)", ylabel="clearance (m)", title="distance to the nearest obstacle")
    off.set_ylim(bottom=0)
    free.set_ylim(bottom=min(0.0, float(np.nanmin(disturbed.clearance))))
    for axes in (off, free):
        axes.margins(x=0.01)
    drawn.legend(*off.get_legend_handles_labels(), loc="upper right", ncols=4)


def spread(axes: Axes, seconds: Array, values: Array, *, highest: bool) -> None:
    """Over time, how values of runs (K, T+1) are spread, and the worst of them."""
    low, middle, high = np.nanpercentile(values, (5, 50, 95), axis=0)
    worst = np.nanmax(values, axis=0) if highest else np.nanmin(values, axis=0)
    axes.fill_between(seconds, low, high, color=DISTURBED, alpha=0.25, linewidth=0, label="5 to 95 %")
    axes.plot(seconds, middle, color=DISTURBED, label="median")
    axes.plot(seconds, worst, color=LIMIT, linewidth=0.9, label="worst")


def draw_map(axes: Axes, factors: Sequence[float], cells: Sequence[Mapping[str, Any]], ways: Sequence[str]) -> None:
    """Which way a plan goes for each pair of weights, row by row: hatched where it collides, crossed where none is."""
    side, colours = len(factors), coloured(ways)
    for number, cell in enumerate(cells):
        y, x = divmod(number, side)
        name = cell["way"]
        axes.add_patch(
            Rectangle(
                (x - 0.5, y - 0.5), 1, 1, linewidth=0.4, edgecolor=LIMIT, facecolor=colours.get(name, "white"),
                hatch=None if name or not cell["converged"] else "////",
            )
        )  # fmt: skip
        label = name if cell["converged"] else "x"
        axes.text(x, y, label, fontsize=8, ha="center", va="center_baseline", color=ink(colours.get(name, "white")))
    authors = side // 2
    axes.add_patch(Rectangle((authors - 0.5, authors - 0.5), 1, 1, linewidth=2, edgecolor=PLAN, facecolor="none"))
    ticks = [place for place, factor in enumerate(factors) if np.isclose(np.log2(factor) % 1, 0)]
    labels = [f"{factors[tick]:g}" if factors[tick] >= 1 else f"1/{1 / factors[tick]:g}" for tick in ticks]
    axes.set(xlim=(-0.5, side - 0.5), ylim=(-0.5, side - 0.5), aspect="equal")
    axes.set_xticks(ticks, labels)
    axes.set_yticks(ticks, labels)
    axes.set(xlabel="control weight, times the authors'", ylabel="obstacle weight, times the authors'")


def coloured(ways: Sequence[str]) -> dict[str, str]:
    """A colour for each way, of which the first are the commonest."""
    return {name: COLOURS[number] if number < len(COLOURS) else RARE for number, name in enumerate(ways)}


def ink(colour: str) -> str:
    """Black or white, whichever reads better on a colour."""
    red, green, blue = to_rgb(colour)
    return "white" if 0.3 * red + 0.59 * green + 0.11 * blue < 0.5 else "black"


def draw_ways(places: Sequence[Axes], scenario: ls.Scenario, paths: Mapping[str, Array]) -> None:
    """A small arena for each way, with a path (k, 2) that goes it."""
    colours = coloured(list(paths))
    for axes, (name, path) in zip(places, paths.items(), strict=False):
        arena(axes, scenario)
        axes.plot(*path.T, color=PLAN, linewidth=2.6)
        axes.plot(*path.T, color=colours[name], linewidth=1.6)
        axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
        axes.set_title(name, loc="center", pad=1)
    for axes in places[len(paths) :]:
        axes.set_axis_off()
