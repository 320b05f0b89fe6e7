"""The figure of a run: path and tube, tracking error, controls, and the convergence of the solver."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from lqrsim.errors import Array, InputError, check_count, check_kind, check_text
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory
from lqrsim.scenes.world import World
from lqrsim.view import figure_parts, style
from lqrsim.view.ellipsoids import Ellipsoids
from lqrsim.view.style import LIMIT, PLAN, RUNS

MOMENTS = 7  # at which the balls of a robot are drawn
AREA = "area: "  # begins the label of a tube


def plot_run(
    solution: Solution, rollouts: Mapping[str, Rollout], path: str | os.PathLike[str], *, world: World, trial: int = 0
) -> Path:
    """Writes a figure (png, pdf or svg, by the suffix) of a solution and of runs of its policy; returns its path.

    For a robot without a position it shows the balls at several times.

    A predicted tube is drawn about the plan, 2 standard deviations wide, up to where it is too wide to be shown; below
    is the chance of collision at each step.

    Args:
      solution: whose plan the rollouts follow.
      rollouts: by their labels, for example `{"undisturbed": ..., "disturbed": ...}`; at most four.
      path: FILE.png, .pdf or .svg.
      world: the obstacles, as the scene has them.
      trial: row of each rollout.

    Returns:
      The path.

    Raises:
      InputError: the rollouts are of other systems, or the file cannot be written.
    """
    _check(solution, rollouts, trial, world)
    with style.figure(path, size=(11, 7.5)) as figure:
        strips = len(solution.policy.control_coordinates)
        in_space = len(solution.policy.state_coordinates.position) == 3
        of_balls = not solution.policy.state_coordinates.position
        chances = [
            (run.times, run.collision_chance, color)
            for run, color in zip(rollouts.values(), RUNS, strict=False)
            if run.collision_chance is not None and run.collision_chance.any()
        ]
        low = 0.13 if len(list(_tubes(rollouts))) <= 2 else 0.155  # above the legend, which has two tubes a row
        under = low + 0.205 if chances else low
        left = figure.add_gridspec(1, 1, left=0.05 if in_space else 0.075, right=0.455, bottom=under, top=0.95)[0]
        right = figure.add_gridspec(
            3, 1, left=0.57, right=0.92, bottom=low, top=0.95, hspace=0.42, height_ratios=(1, 0.7 + 0.3 * strips, 1)
        )
        if in_space:
            path_axes = figure.add_subplot(left, projection="3d")
            assert isinstance(path_axes, Axes3D)
            _path_in_space(path_axes, solution, rollouts, world, trial)
        else:
            path_axes = figure.add_subplot(left)
            (_path_of_balls if of_balls else _path_in_plane)(path_axes, solution, rollouts, world, trial)
        if chances:
            below = figure.add_gridspec(1, 1, left=0.085, right=0.455, bottom=low, top=low + 0.1)[0]
            figure_parts.draw_chances(figure.add_subplot(below), chances)
        _tracking_error(figure.add_subplot(right[0]), rollouts, trial)
        rows = right[1].subgridspec(strips, 1, hspace=0.18)
        _controls([figure.add_subplot(row) for row in rows], solution.trajectory, rollouts, trial)
        _cost(figure.add_subplot(right[2]), solution)
        handles = dict(zip(*reversed(path_axes.get_legend_handles_labels()), strict=True))
        tubes = {label: handles.pop(label) for label in list(handles) if label.startswith(AREA)}
        figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=len(RUNS) + 3)
        if tubes:
            figure.legend(tubes.values(), tubes.keys(), loc="lower center", bbox_to_anchor=(0.5, 0.028), ncols=2)
    return Path(path)


def _check(solution: Solution, rollouts: Mapping[str, Rollout], trial: int, world: World) -> None:
    check_kind("solution", solution, Solution, "a Solution")
    check_kind("world", world, World, "a World, such as scene.world")
    check_kind("rollouts", rollouts, Mapping, "a dictionary of label: Rollout")
    check_count("trial", trial, at_least=0)
    if not 1 <= len(rollouts) <= len(RUNS):
        raise InputError(f"rollouts: got {len(rollouts)}, want 1 to {len(RUNS)}")
    spaces = solution.policy.state_coordinates, solution.policy.control_coordinates
    for name, run in rollouts.items():
        check_text("rollouts: label", name, "a label", at_most=100)
        check_kind(f"rollouts[{name!r}]", run, Rollout, "a Rollout, such as simulate(...) returns")
        if (run.state_coordinates, run.control_coordinates) != spaces:
            want = ", ".join(spaces[0].names)
            raise InputError(f"rollouts[{name!r}]: got a run of another system, want states {want}")
        if not 0 <= trial < run.trials:
            raise InputError(f"trial: got {trial}, want one of 0 to {run.trials - 1} of rollouts[{name!r}]")
        if not run.plane:
            wanted = "the 2 or 3 states that are the position, or runs of a robot with balls that have frames"
            raise InputError(f"state_coordinates.position: got none, want {wanted}")


def _paths(solution: Solution, rollouts: Mapping[str, Rollout], trial: int) -> list[tuple[str, str, str, Array]]:
    """Label, colour, line style and places (T+1, 2 or 3) of each path; the plan is last, on top."""
    position = list(solution.policy.state_coordinates.position)
    driven = [(name, color, "-", run.places(trial)) for (name, run), color in zip(rollouts.items(), RUNS, strict=False)]
    planned = solution.trajectory.states[:, position] if position else next(iter(rollouts.values())).planned_places
    return [*driven, ("planned", PLAN, "--", planned)]


def _tubes(rollouts: Mapping[str, Rollout]) -> Iterator[tuple[Ellipsoids, dict[str, str]]]:
    """The predicted tubes that have a width, with label and colours."""
    for (name, run), color in zip(rollouts.items(), RUNS, strict=False):
        if run.tube is not None and run.tube.any():
            plan = run.plan.states[:, list(run.state_coordinates.position)]
            ellipsoids = Ellipsoids.predicted(plan, run.tube)
            red, green, blue = to_rgb(color)
            paler = to_hex((0.4 * red + 0.6, 0.4 * green + 0.6, 0.4 * blue + 0.6))
            yield ellipsoids, {"label": f"{AREA}{name}, {ellipsoids.label}", "face": paler, "edge": color}


def _path_in_plane(axes: Axes, solution: Solution, rollouts: Mapping[str, Rollout], world: World, trial: int) -> None:
    paths, radius = _paths(solution, rollouts, trial), next(iter(rollouts.values())).radius
    places = np.vstack([points for *_, points in paths])
    figure_parts.draw_obstacles(axes, solution.policy.state_coordinates, world, places, radius, (0, 1))
    for ellipsoids, looks in _tubes(rollouts):
        figure_parts.draw_tube(axes, ellipsoids, **looks)
    for name, color, line, points in paths:
        axes.plot(*points.T, line, color=color, label=name)
    figure_parts.mark_ends(axes, paths[-1][-1])
    axes.set_title("path (pale: closer than the robot's radius)")


def _path_of_balls(axes: Axes, solution: Solution, rollouts: Mapping[str, Rollout], world: World, trial: int) -> None:
    """The balls of the first run at several times and the path of the last, seen along the axis of least motion."""
    first = next(iter(rollouts.values()))
    assert first.balls is not None
    driven, radii = first.balls.driven[trial], first.balls.radii
    low, high = np.nanmin(driven, axis=(0, 1)), np.nanmax(driven, axis=(0, 1))
    across, up = sorted(np.argsort(high - low, kind="stable")[1:].tolist())
    margin = float(radii.max()) + 0.1 * float((high - low).max())
    corners = figure_parts.bounds(driven[np.isfinite(driven).all(axis=(1, 2))].reshape(-1, 3), world, margin)
    figure_parts.draw_projected(axes, world, *corners, across, up)
    alive = np.flatnonzero(np.isfinite(driven).all(axis=(1, 2)))
    for number, knot in enumerate(np.unique(np.linspace(0, len(alive) - 1, MOMENTS).astype(int))):
        paler, (red, green, blue) = 0.75 * (1 - number / (MOMENTS - 1)), to_rgb(RUNS[0])
        face = to_hex((paler + (1 - paler) * red, paler + (1 - paler) * green, paler + (1 - paler) * blue))
        for centre, radius in zip(driven[alive[knot]], radii, strict=True):
            axes.add_patch(Circle(centre[[across, up]], radius, facecolor=face, edgecolor="none", zorder=2))
    paths = _paths(solution, rollouts, trial)
    for name, color, line, points in paths:
        axes.plot(*points[:, [across, up]].T, line, color=color, label=name, zorder=3)
    figure_parts.mark_ends(axes, paths[-1][-1][:, [across, up]])
    axes.set_title("balls, paler the earlier, and the path of the last")


def _path_in_space(axes: Axes3D, solution: Solution, rollouts: Mapping[str, Rollout], world: World, trial: int) -> None:
    paths = _paths(solution, rollouts, trial)
    figure_parts.draw_in_space(axes, world, *figure_parts.bounds(np.vstack([points for *_, points in paths]), world))
    for ellipsoids, looks in _tubes(rollouts):
        figure_parts.draw_tube_in_space(axes, ellipsoids, **looks)
    for name, color, line, points in paths:
        axes.plot(*points.T, line, color=color, label=name)
    figure_parts.mark_ends(axes, paths[-1][-1])
    axes.set_title("path")


def _tracking_error(axes: Axes, rollouts: Mapping[str, Rollout], trial: int) -> None:
    errors = {name: run.tracking_error[trial] for name, run in rollouts.items()}
    worst = np.array([np.nanmax(error) for error in errors.values()])
    # Runs that differ by decades need a logarithmic axis, where the zero at the start is left out.
    decades = bool(worst.max() > 30 * worst.min())
    of = next(iter(rollouts.values())).tracking_unit
    factor, unit = (1e3, "mm") if of == "m" and worst.max() < 1 and not decades else (1.0, of)
    for (name, error), color in zip(errors.items(), RUNS, strict=False):
        shown = np.where(error > 0, error, np.nan) if decades else error
        axes.plot(rollouts[name].times, factor * shown, color=color)
    if decades:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)
    axes.set(xlabel="time (s)", ylabel=f"distance from\nthe plan ({unit})", title="tracking error")
    axes.margins(x=0.01)


def _controls(strips: list[Axes], plan: Trajectory, rollouts: Mapping[str, Rollout], trial: int) -> None:
    space = next(iter(rollouts.values())).control_coordinates
    for number, axes in enumerate(strips):
        # Disturbed runs come first, so that the undisturbed one is not hidden.
        for (_, run), color in reversed(list(zip(rollouts.items(), RUNS, strict=False))):
            axes.stairs(run.commanded[trial, :, number], run.times, color=color, baseline=None, linewidth=1.0)
        axes.stairs(plan.controls[:, number], plan.times, color=PLAN, baseline=None, linestyle="--", linewidth=0.9)
        for limit in (space.low[number], space.high[number]):
            if np.isfinite(limit):
                axes.axhline(limit, color=LIMIT, linewidth=0.9, linestyle=":", gid="limit")
        axes.set_ylabel(space.labels[number].replace("_", " ").replace(" (", "\n("))
        axes.margins(x=0.01, y=0.12)
        axes.tick_params(labelbottom=number == len(strips) - 1)
    strips[0].set_title("commanded controls (dotted: limits)")
    strips[-1].set_xlabel("time (s)")


def _cost(axes: Axes, solution: Solution) -> None:
    number = np.arange(1, len(solution.iterations) + 1)
    cost = np.array([iteration.cost for iteration in solution.iterations])
    change = np.abs([iteration.improvement for iteration in solution.iterations])
    axes.plot(number, cost, "o-", color=PLAN, markersize=4)
    if len(cost) and np.nanmin(cost) > 0 and np.nanmax(cost) > 20 * np.nanmin(cost):
        axes.set_yscale("log")
    axes.set(xlabel=f"iteration of {solution.solver}", ylabel="cost (circles)", title="convergence of the solver")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    shown = np.isfinite(change) & (change > 0)
    if shown.any():
        other = axes.twinx()
        other.semilogy(number[shown], change[shown], "s:", color=LIMIT, markersize=3.5, linewidth=1.0)
        other.set_ylabel("relative change (squares)")
        other.spines["right"].set_visible(True)
