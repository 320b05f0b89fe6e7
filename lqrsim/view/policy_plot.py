"""The figure of a policy: a tube about its plan, cost-to-go along the plan, gains over time."""

import os
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lqrsim.control.tubes import Tube
from lqrsim.errors import Array, InputError, check_kind, check_number
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.solution import Solution
from lqrsim.scenes.world import World
from lqrsim.view import figure_parts, style
from lqrsim.view.ellipsoids import OF_COST, Ellipsoids
from lqrsim.view.style import PLAN, RUNS

# Face and edge, as in videos.
TUBE = {"face": "#8ad7d5", "edge": "#008f91"}
COST_TUBE = {"face": "#d5c8ec", "edge": "#7a4dc7"}
LINES = ("-", "--", "-.", ":")


def plot_policy(
    solution: Solution, path: str | os.PathLike[str], *, world: World, radius: float, tube: Tube | None = None
) -> Path:
    """Writes a figure (png, pdf or svg, by the suffix) of a solution's policy; returns its path.

    With a tube it shows the predicted region of 2 standard deviations about the plan, up to where it is too wide to be
    shown, and the chance of collision at each step. Without a tube it shows the positions whose total cost is near its
    least, which does not depend on disturbances; solutions of `ilqr` have no total cost, and show the plan alone. A
    robot in space is seen from above and from the side. A robot without a position has the plan's states instead.

    Args:
      solution: with a policy.
      path: FILE.png, .pdf or .svg.
      world: the obstacles, as the scene has them.
      radius: radius of the robot, in metres.
      tube: tube of the solution, from `predict_tube`.

    Returns:
      The path.

    Raises:
      InputError: the solution has no policy, the tube is of another plan or has no position, or the file cannot be
        written.
    """
    check_kind("solution", solution, Solution, "a Solution")
    check_kind("world", world, World, "a World, such as scene.world")
    radius = check_number("radius", radius, at_least=0.0)
    if solution.cost_to_go is None:
        raise InputError(
            f"solution: got one without a cost-to-go ({solution.status.name}), want one of a completed solve"
        )
    check_kind("tube", tube, (Tube, type(None)), "a Tube, such as predict_tube(...) returns, or None")
    if tube is not None and not np.array_equal(tube.plan.states, solution.trajectory.states):
        raise InputError("tube: got one of another plan, want one of the solution's plan")
    if tube is not None and not solution.policy.state_coordinates.position:
        raise InputError("tube: got one of a robot without a position, want None")
    with style.figure(path, size=(11, 7.5)) as figure:
        draw(figure, solution, world, radius, tube)
    return Path(path)


def draw(figure: Figure, solution: Solution, world: World, radius: float, tube: Tube | None = None) -> None:
    """Draw the figure of a policy."""
    policy = solution.policy
    grid = figure.add_gridspec(1, 2, left=0.07, right=0.97, bottom=0.12, top=0.95, wspace=0.2, width_ratios=(1, 1.1))
    if policy.state_coordinates.position:
        planes = [(0, 1)] if len(policy.state_coordinates.position) == 2 else [(0, 1), (0, 2)]
        places = grid[0].subgridspec(len(planes), 1, hspace=0.25)
        paths = [figure.add_subplot(place) for place in places]
        for axes, plane in zip(paths, planes, strict=True):
            _tube(axes, solution, world, radius, plane, tube)
        figure.legend(*paths[0].get_legend_handles_labels(), loc="lower center", ncols=4)
    else:
        units = list(dict.fromkeys(policy.state_coordinates.units))
        places = grid[0].subgridspec(len(units), 1, hspace=0.18)
        _states([figure.add_subplot(place) for place in places], units, solution)
    strips = list(
        product(dict.fromkeys(policy.control_coordinates.units), dict.fromkeys(policy.state_coordinates.units))
    )
    chances = [] if tube is None or not tube.step_chance.any() else [0.6]
    ratios = (1, *chances, 0.3 + 0.55 * len(strips))
    rows = grid[1].subgridspec(len(ratios), 1, hspace=0.42 if chances else 0.3, height_ratios=ratios)
    _cost(figure.add_subplot(rows[0]), solution)
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
    position = solution.policy.state_coordinates.position
    plan = solution.trajectory.states[:, list(position)]
    figure_parts.draw_obstacles(axes, solution.policy.state_coordinates, world, plan, radius, plane)
    if len(position) == 2:
        axes.set_title("tube (grey: closer than the robot's radius)")
    else:
        axes.set_title(f"tube, from {'above' if plane == (0, 1) else 'the side'}")
    onto = np.eye(len(position))[list(plane)]
    if tube is not None:
        ellipsoids = Ellipsoids.predicted(plan, tube.position_covariance)
        figure_parts.draw_tube(axes, ellipsoids.seen_in(onto), ellipsoids.label, **TUBE)
    elif solution.cost_to_come is not None:
        ellipses = Ellipsoids.of_cost(solution, position).seen_in(onto)
        figure_parts.draw_tube(axes, ellipses, OF_COST, **COST_TUBE)
    figure_parts.draw_plan(axes, plan[:, list(plane)], linewidth=1.4 if tube is None else 0.9)


def _states(strips: list[Axes], units: list[str], solution: Solution) -> None:
    """The planned states over time, one strip for each unit."""
    space, plan = solution.policy.state_coordinates, solution.trajectory
    for axes, unit in zip(strips, units, strict=True):
        for i, name in enumerate(space.names):
            if space.units[i] == unit:
                axes.plot(plan.times, plan.states[:, i], label=name.replace("_", " "))
        axes.set_ylabel(f"({unit})" if unit else "")
        axes.margins(x=0.01)
        axes.legend(loc="best")
    strips[0].set_title("planned states")
    strips[-1].set_xlabel("time (s)")


def _cost(axes: Axes, solution: Solution) -> None:
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
