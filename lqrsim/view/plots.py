"""The figures of runs, of a policy, and of a funnel."""

import os
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from lqrsim.control.tubes import Tube
from lqrsim.errors import Array, InputError, check_count, check_kind, check_number, check_text
from lqrsim.results.coordinates import Coordinates, check_same_system, spaces_of
from lqrsim.results.funnel import Funnel
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory
from lqrsim.scenes.world import World
from lqrsim.view import figure_parts, style
from lqrsim.view.ellipsoids import OF_COST, SIGMAS, Ellipsoids
from lqrsim.view.style import LIMIT, PLAN, RUNS

MOMENTS = 7  # number of times at which the balls of a robot are drawn
AREA = "area: "  # prefix of the label of a tube


def plot_run(
    solution: Solution, rollouts: Mapping[str, Rollout], path: str | os.PathLike[str], *, world: World, trial: int = 0
) -> Path:
    """Writes a figure (png, pdf or svg, by the suffix) of a solution and of runs of its policy; returns its path.

    For a robot without a position it shows the balls at several times.

    A predicted tube is drawn about the plan, 2 standard deviations wide, up to where it is too wide to be shown. The
    chance of collision at each step is drawn below.

    Args:
      solution: the solution with the plan that the rollouts follow.
      rollouts: by their labels, for example `{"undisturbed": ..., "disturbed": ...}`; at most four.
      path: FILE.png, .pdf or .svg.
      world: the obstacles, such as `scene.world`.
      trial: row of each rollout.

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
        low = 0.13 if len(list(_tubes(rollouts))) <= 2 else 0.155  # above the legend, which has two tubes in a row
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
        _convergence(figure.add_subplot(right[2]), solution)
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
    for name, run in rollouts.items():
        check_text("rollouts: label", name, "a label", at_most=100)
        check_kind(f"rollouts[{name!r}]", run, Rollout, "a Rollout, such as simulate(...) returns")
        check_same_system(f"rollouts[{name!r}]", "a run", spaces_of(run), spaces_of(solution.policy), "the solution")
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
    # Runs that differ by decades need a logarithmic axis, from which the zero at the start is left out.
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


def _convergence(axes: Axes, solution: Solution) -> None:
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


# Colours of faces and edges, as in videos.
TUBE = {"face": "#8ad7d5", "edge": "#008f91"}
COST_TUBE = {"face": "#d5c8ec", "edge": "#7a4dc7"}
LINES = ("-", "--", "-.", ":")
FLAT = 0.05  # a curve whose range is a smaller part of the largest one's in its unit has another strip


def plot_policy(
    solution: Solution,
    path: str | os.PathLike[str],
    *,
    world: World | None = None,
    radius: float = 0.0,
    tube: Tube | None = None,
) -> Path:
    """Writes a figure (png, pdf or svg, by the suffix) of a solution's policy; returns its path.

    With a tube it shows the predicted region of 2 standard deviations about the plan, up to where it is too wide to be
    shown, and the chance of collision at each step. Without a tube it shows the positions whose total cost is near its
    least, which does not depend on disturbances; solutions of `ilqr` have no total cost, and show the plan alone. A
    robot in space is seen from above and from the side. For a system without a position, which need not be a robot,
    the plan's states are shown instead, without `world` and `radius`.

    Args:
      solution: a solution with a policy.
      path: FILE.png, .pdf or .svg.
      world: the obstacles, such as `scene.world`; none by default.
      radius: radius in metres of a robot in the plane that is one ball about its position; places closer to an obstacle
        are grey. 0 leaves the grey out, which would be wrong for a robot of several balls.
      tube: tube of the solution, from `predict_tube`.

    Raises:
      InputError: the solution has no policy, the tube is of another plan or has no position, or the file cannot be
        written.
    """
    check_kind("solution", solution, Solution, "a Solution")
    world = World() if world is None else world
    check_kind("world", world, World, "a World, such as scene.world")
    radius = check_number("radius", radius, at_least=0.0)
    if solution.cost_to_go is None:
        raise InputError(f"solution: got no cost-to-go ({solution.status.name}), want a solution of a completed solve")
    check_kind("tube", tube, (Tube, type(None)), "a Tube, such as predict_tube(...) returns, or None")
    if tube is not None and not np.array_equal(tube.plan.states, solution.trajectory.states):
        raise InputError("tube: got a tube of another plan, want one of the solution's plan")
    if tube is not None and not solution.policy.state_coordinates.position:
        raise InputError("tube: got a tube of a robot without a position, want None")
    with style.figure(path, size=(11, 7.5)) as figure:
        draw_policy(figure, solution, world, radius, tube)
    return Path(path)


def draw_policy(figure: Figure, solution: Solution, world: World, radius: float, tube: Tube | None = None) -> None:
    """Draw the figure of a policy."""
    policy = solution.policy
    grid = figure.add_gridspec(1, 2, left=0.07, right=0.97, bottom=0.12, top=0.95, wspace=0.2, width_ratios=(1, 1.1))
    if policy.state_coordinates.position:
        planes = _planes(policy.state_coordinates)
        places = grid[0].subgridspec(len(planes), 1, hspace=0.25)
        paths = [figure.add_subplot(place) for place in places]
        for axes, plane in zip(paths, planes, strict=True):
            _tube(axes, solution, world, radius, plane, tube)
        figure.legend(*paths[0].get_legend_handles_labels(), loc="lower center", ncols=4)
    else:
        together = _drawn_together(solution)
        places = grid[0].subgridspec(len(together), 1, hspace=0.18)
        _states([figure.add_subplot(place) for place in places], together, solution)
    strips = list(
        product(dict.fromkeys(policy.control_coordinates.units), dict.fromkeys(policy.state_coordinates.units))
    )
    chances = [] if tube is None or not tube.step_chance.any() else [0.6]
    ratios = (1, *chances, 0.3 + 0.55 * len(strips))
    rows = grid[1].subgridspec(len(ratios), 1, hspace=0.42 if chances else 0.3, height_ratios=ratios)
    _cost_to_go(figure.add_subplot(rows[0]), solution)
    if tube is not None and chances:
        axes = figure.add_subplot(rows[1])
        figure_parts.draw_chances(axes, [(tube.plan.times, tube.step_chance, TUBE["edge"])])
        axes.set_title(f"predicted chance of collision ({tube.collision_chance:.2g} in all)")
    of_gains = rows[len(ratios) - 1].subgridspec(len(strips), 1, hspace=0.18)
    _gains([figure.add_subplot(row) for row in of_gains], strips, policy, solution.trajectory.times)


def _tube(
    axes: Axes, solution: Solution, world: World, radius: float, plane: tuple[int, int], tube: Tube | None
) -> None:
    """The tube, the plan and the obstacles, seen along the axis that is not in `plane`."""
    space = solution.policy.state_coordinates
    plan = solution.trajectory.states[:, list(space.position)]
    legend = "grey: closer than the robot's radius" if radius > 0 else ""
    onto = _begin_projection(axes, space, world, plan, radius, plane, "tube", legend)
    if tube is not None:
        ellipsoids = Ellipsoids.predicted(plan, tube.position_covariance)
        figure_parts.draw_tube(axes, ellipsoids.seen_in(onto), ellipsoids.label, **TUBE)
    elif solution.cost_to_come is not None:
        ellipses = Ellipsoids.of_cost(solution, space.position).seen_in(onto)
        figure_parts.draw_tube(axes, ellipses, OF_COST, **COST_TUBE)
    figure_parts.draw_plan(axes, plan[:, list(plane)], linewidth=1.4 if tube is None else 0.9)


def _planes(space: Coordinates) -> list[tuple[int, int]]:
    """The planes in which a path is shown: from above and, in space, from the side."""
    return [(0, 1)] if len(space.position) == 2 else [(0, 1), (0, 2)]


def _begin_projection(
    axes: Axes, space: Coordinates, world: World, places: Array, radius: float, plane: tuple[int, int], title: str,
    legend: str,
) -> Array:  # fmt: skip
    """Draw the obstacles around places (k, d), and the title of a projection; returns its axes (2, d).

    The legend explains flat obstacles.
    """
    figure_parts.draw_obstacles(axes, space, world, places, radius, plane)
    side = f"{title}, from {'above' if plane == (0, 1) else 'the side'}"
    in_plane = f"{title} ({legend})" if legend else title
    axes.set_title(in_plane if len(space.position) == 2 else side)
    return np.eye(len(space.position))[list(plane)]


def _drawn_together(solution: Solution) -> list[list[int]]:
    """The states of each strip: of one unit, and with ranges along the plan that can be seen beside one another."""
    space, found = solution.policy.state_coordinates, list[list[int]]()
    sizes = np.ptp(solution.trajectory.states, axis=0)
    for unit in dict.fromkeys(space.units):
        strip = list[int]()
        for i in sorted((i for i, one in enumerate(space.units) if one == unit), key=lambda i: -sizes[i]):
            if strip and 0 < sizes[i] < FLAT * sizes[strip[0]]:
                found.append(sorted(strip))
                strip = []
            strip.append(i)
        found.append(sorted(strip))
    return sorted(found)


def _states(strips: list[Axes], together: list[list[int]], solution: Solution) -> None:
    """The planned states over time, in strips."""
    space, plan = solution.policy.state_coordinates, solution.trajectory
    for axes, drawn in zip(strips, together, strict=True):
        for i in drawn:
            axes.plot(plan.times, plan.states[:, i], label=space.names[i].replace("_", " "))
        unit = space.units[drawn[0]]
        axes.set_ylabel(f"({unit})" if unit else "")
        axes.margins(x=0.01)
        axes.legend(loc="best")
    strips[0].set_title("planned states")
    strips[-1].set_xlabel("time (s)")


def _cost_to_go(axes: Axes, solution: Solution) -> None:
    """The cost-to-go at the planned states and, above it, the cost-to-come up to the total."""
    times, states = solution.trajectory.times, solution.trajectory.states
    assert solution.cost_to_go is not None
    to_go = solution.cost_to_go(states)
    axes.plot(times, to_go, color=RUNS[0], label="cost-to-go")
    axes.fill_between(times, 0, to_go, color=RUNS[0], alpha=0.15, linewidth=0)
    if solution.cost_to_come is not None:
        axes.plot(times, solution.total_cost.minimum(), "--", color=PLAN, label="least total cost")
    axes.set(xlabel="time (s)", ylabel="cost", title="cost-to-go along the plan")
    axes.set_ylim(bottom=min(0.0, float(to_go.min())), top=1.12 * float(to_go.max()))
    axes.margins(x=0.01)
    axes.legend(loc="lower left")


def _gains(strips: list[Axes], units: list[tuple[str, str]], policy: AffinePolicy, times: Array) -> None:
    """The gains of each control, for each unit of the states."""
    controls = policy.control_coordinates
    for axes, (answer, deviation) in zip(strips, units, strict=True):
        for number, (name, unit) in enumerate(zip(controls.names, controls.units, strict=True)):
            if unit == answer:
                norm = strength(policy, number, deviation)
                line, colour = LINES[number % len(LINES)], RUNS[number % len(RUNS)]
                looks = {"baseline": None, "color": colour, "linestyle": line, "linewidth": 1.2}
                axes.stairs(norm, times, label=name.replace("_", " "), **looks)
        axes.set_ylabel(f"{answer or '1'}\nper {deviation or '1'}")
        axes.set_ylim(bottom=0)
        axes.margins(x=0.01)
        axes.tick_params(labelbottom=axes is strips[-1])
    strips[0].set_title("feedback gains")
    handles = {label: one for axes in strips for one, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    strips[0].legend(
        handles.values(), handles.keys(), loc="lower right", bbox_to_anchor=(1, 1), ncols=4, borderaxespad=0.2,
        columnspacing=1.0, handlelength=1.8, handletextpad=0.5,
    )  # fmt: skip
    strips[-1].set_xlabel("time (s)")


def strength(policy: AffinePolicy, control: int, unit: str) -> Array:
    """Norm (T,) of a control's gains on the states of a unit: its largest response to a unit deviation."""
    chosen = [number for number, one in enumerate(policy.state_coordinates.units) if one == unit]
    return np.linalg.norm(policy.gain[:, control, chosen], axis=-1)


FACE, EDGE, CERTIFIED = "#cfe3f5", "#5f97c9", RUNS[0]


def plot_funnel(funnel: Funnel, path: str | os.PathLike[str], *, world: World, radius: float) -> Path:
    """Writes a figure (png, pdf or svg, by the suffix) of a funnel; returns its path.

    Outlines are dark at certified knots and pale between them, where the level is interpolated. The ellipsoids of all
    states are projected onto the position: whether a run may begin at a place also depends on the other states. A robot
    in space is seen from above and from the side.

    Args:
      funnel: a funnel with the position among its states.
      path: FILE.png, .pdf or .svg.
      world: the obstacles, such as `scene.world`.
      radius: radius of the robot, in metres.

    Raises:
      InputError: the position is not among the funnel's states, or the file cannot be written.
    """
    check_kind("funnel", funnel, Funnel, "a Funnel, such as funnel(...) returns")
    check_kind("world", world, World, "a World, such as scene.world")
    radius = check_number("radius", radius, at_least=0.0)
    covariances = funnel.position_covariance
    planes = _planes(funnel.state_coordinates)
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
    held, last = funnel.knots[funnel.levels > 0], int(funnel.knots[-1]) + 1
    reach = np.sqrt(np.diagonal(covariances[held], axis1=1, axis2=2))
    shown = np.vstack([plan, plan[held] - reach, plan[held] + reach])  # the certified outlines are seen as a whole
    onto = _begin_projection(axes, space, world, shown, radius, plane, "funnel", "pale grey: within a radius")
    every = Ellipsoids(plan, covariances / SIGMAS**2).seen_in(onto)  # gives the outlines at the level
    whole = Ellipsoids(every.centres[:last], every.covariances[:last])
    figure_parts.draw_tube(axes, whole, "funnel, interpolated", face=FACE, edge=EDGE)
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
