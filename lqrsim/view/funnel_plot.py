"""The figure of a funnel: its projection onto the position, and its levels over time."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

from lqrsim.errors import check_kind, check_number
from lqrsim.results.funnel import Funnel
from lqrsim.scenes.world import World
from lqrsim.view import figure_parts, style
from lqrsim.view.ellipsoids import SIGMAS, Ellipsoids
from lqrsim.view.style import RUNS

FACE, EDGE, CERTIFIED = "#cfe3f5", "#5f97c9", RUNS[0]


def plot_funnel(funnel: Funnel, path: str | os.PathLike[str], *, world: World, radius: float) -> Path:
    """Writes a figure (png, pdf or svg, by the suffix) of a funnel; returns its path.

    Outlines are dark at certified knots and pale between them, where the level is interpolated. The ellipsoids of all
    states are projected onto the position: whether a run may begin at a place also depends on the other states. A robot
    in space is seen from above and from the side.

    Args:
      funnel: with the position among its states.
      path: FILE.png, .pdf or .svg.
      world: the obstacles, as the scene has them.
      radius: radius of the robot, in metres.

    Returns:
      The path.

    Raises:
      InputError: the position is not among the funnel's states, or the file cannot be written.
    """
    check_kind("funnel", funnel, Funnel, "a Funnel, such as funnel(...) returns")
    check_kind("world", world, World, "a World, such as scene.world")
    radius = check_number("radius", radius, at_least=0.0)
    covariances = funnel.position_covariance
    space = funnel.state_coordinates
    planes = [(0, 1)] if len(space.position) == 2 else [(0, 1), (0, 2)]
    columns = len(planes) + 1
    with style.figure(path, size=(4 * columns, 5.2 if columns == 2 else 4.6)) as figure:
        left = 0.09 if columns == 2 else 0.07
        grid = figure.add_gridspec(1, columns, left=left, right=0.98, bottom=0.2, top=0.92, wspace=0.24)
        drawn = [figure.add_subplot(grid[i]) for i in range(len(planes))]
        for axes, plane in zip(drawn, planes, strict=True):
            _shadow(axes, funnel, covariances, world, radius, plane)
        figure.legend(*drawn[0].get_legend_handles_labels(), loc="lower center", ncols=5)
        _levels(figure.add_subplot(grid[len(planes)]), funnel)
    return Path(path)


def _shadow(
    axes: Axes, funnel: Funnel, covariances: np.ndarray, world: World, radius: float, plane: tuple[int, int]
) -> None:
    """The projection, the plan and the obstacles, seen along the axis that is not in `plane`."""
    space = funnel.state_coordinates
    plan = funnel.plan.states[:, list(space.position)]
    figure_parts.draw_obstacles(axes, space, world, plan, radius, plane)
    if len(space.position) == 2:
        axes.set_title("funnel (pale grey: within a radius)")
    else:
        axes.set_title(f"funnel, from {'above' if plane == (0, 1) else 'the side'}")
    onto = np.eye(len(space.position))[list(plane)]
    every = Ellipsoids(plan, covariances / SIGMAS**2).seen_in(onto)  # so that outlines are those of the level
    last = int(funnel.knots[-1]) + 1
    whole = Ellipsoids(every.centres[:last], every.covariances[:last])
    figure_parts.draw_tube(axes, whole, "funnel, interpolated", face=FACE, edge=EDGE)
    held = funnel.knots[funnel.levels > 0]
    outlines = every.outlines()[held]
    axes.add_collection(
        PolyCollection(
            list(outlines), facecolors="none", edgecolors=CERTIFIED, linewidths=1.6, zorder=2.8, label="certified"
        )
    )
    figure_parts.draw_plan(axes, plan[:, list(plane)])


def _levels(axes: Axes, funnel: Funnel) -> None:
    times = funnel.times
    axes.plot(times, funnel.levels, "-", color=EDGE, linewidth=1.0)
    axes.plot(times, funnel.levels, "o", color=CERTIFIED, markersize=6)
    for time, level, trials, successes in zip(times, funnel.levels, funnel.trials, funnel.successes, strict=True):
        said = f"{successes}/{trials}" if trials else "none"
        axes.annotate(said, (time, level), xytext=(0, 8), textcoords="offset points", ha="center", fontsize=8)
    axes.set_xlim(-0.06 * funnel.plan.horizon, 1.02 * funnel.plan.horizon)
    axes.set_ylim(0, 1.2 * max(float(funnel.levels.max()), 1e-9))
    axes.set_xlabel("time (s)")
    axes.set_ylabel("level")
    axes.set_title(f"levels: {funnel.rate:g} succeed, confidence {funnel.confidence:g}")
