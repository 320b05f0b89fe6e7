"""The figures of `convergence.py`."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.solution_parts import Moments
from lqrsim.view import plots
from lqrsim.view.style import LIMIT, PLAN, RUNS
from paper.rates import tail

Log = Sequence[ls.types.Iteration]
Logs = Sequence[Mapping[str, Mapping[str, Log]]]  # of queries, by case and solver

LINES = 50  # queries with a line of their own
ABOVE = 1.0  # cost above the least, of the level sets
EVERY = 5.0  # seconds between them


def draw_iterations(
    drawn: Figure, logs: Mapping[str, Logs], case: str, solvers: tuple[str, str], paper_stop: float
) -> None:
    """The improvement of both solvers and the gap of smoothing, by iteration."""
    panels = drawn.subplots(1, 3)
    colours = dict(zip(solvers, (RUNS[0], RUNS[2]), strict=True))
    for axes, solver in zip(panels, solvers, strict=False):
        _lines(axes, [one[case][solver] for one in logs["quadrotor"]], "improvement", colours[solver])
        _drive(axes, logs["drive"][0][case][solver], "improvement")
        axes.axhline(paper_stop, color=LIMIT, linestyle=":", zorder=3)
        axes.text(axes.get_xlim()[1], paper_stop * 1.5, "the paper's stop", ha="right", va="bottom", color=PLAN)
        axes.set(ylim=(1e-13, 30), title=solver, ylabel="size of the relative improvement")
    smoothing = [one[case][solvers[0]] for one in logs["quadrotor"]]
    _lines(panels[2], smoothing, "gap", colours[solvers[0]])
    _drive(panels[2], logs["drive"][0][case][solvers[0]], "gap")
    panels[2].set(title="gap of smoothing", ylabel="gap", ylim=(1e-8, 30))
    panels[2].legend(
        handles=[
            Line2D([], [], color=colours[solvers[0]], alpha=0.5, label="a query"),
            Line2D([], [], color="black", linewidth=2, label="median"),
            Line2D([], [], color=RUNS[1], linestyle="--", label="differential drive"),
        ],
        loc="upper right",
    )
    drawn.set_layout_engine("tight")


def _lines(axes: Axes, logs: Sequence[Log], what: str, colour: str) -> None:
    """One line for each of the first queries, and the median of all, in which those that have ended count as zero."""
    lengths = [len(log) for log in logs]
    shown = int(np.percentile(lengths, 90))
    values = np.zeros((len(logs), max(lengths)))
    for row, log in zip(values, logs, strict=True):
        row[: len(log)] = np.abs([getattr(one, what) for one in log])
    for log in logs[:LINES]:
        found = np.abs([getattr(one, what) for one in log])
        found = np.where(np.isfinite(found) & (found > 0), found, np.nan)
        axes.semilogy(np.arange(1, len(log) + 1), found, color=colour, linewidth=0.5, alpha=0.5)
    median = np.percentile(values, 50, axis=0, method="higher")
    axes.semilogy(
        np.arange(1, len(median) + 1),
        np.where(np.isfinite(median) & (median > 0), median, np.nan),
        color="black",
        linewidth=2,
    )
    axes.set(xlim=(0, shown), xlabel="iteration")


def _drive(axes: Axes, log: Log, what: str) -> None:
    values = np.abs([getattr(one, what) for one in log])
    values = np.where(np.isfinite(values) & (values > 0), values, np.nan)
    axes.semilogy(np.arange(1, len(log) + 1), values, "--", color=RUNS[1], linewidth=1.4)


def draw_order(
    drawn: Figure,
    logs: Logs,
    cases: tuple[str, str],
    factors: Mapping[str, Sequence[float]],
    predicted: Mapping[str, Sequence[float]],
) -> None:
    """Each error against the one before, for both solvers, and measured factors against those that are explained."""
    panels = drawn.subplots(1, 3)
    for axes, solver in zip(panels, factors, strict=False):
        for case, colour, marker in zip(cases, (RUNS[0], RUNS[1]), ("o", "^"), strict=True):
            for one in logs:
                error = tail(np.array([iteration.cost for iteration in one[case][solver]]))
                axes.plot(
                    error[:-1],
                    error[1:],
                    marker,
                    color=colour,
                    markersize=2.2,
                    markeredgewidth=0,
                    alpha=0.35,
                    rasterized=True,
                )
        ends = np.array([1e-13, 1e-3])
        axes.plot(ends, ends, "-", color=LIMIT, linewidth=1, zorder=0)
        axes.plot(ends, ends**2 / 1e-3, "--", color=LIMIT, linewidth=1, zorder=0)
        axes.text(2e-11, 1.2e-10, "slope 1", rotation=45, rotation_mode="anchor", color=PLAN)
        axes.text(1e-7, 3e-13, "slope 2", rotation=63, rotation_mode="anchor", color=PLAN)
        axes.set(xscale="log", yscale="log", xlim=(3e-14, 3e-3), ylim=(3e-14, 3e-3))
        axes.set(xlabel="relative error in cost", ylabel="that of the next iteration", title=solver)
    handles = [
        Line2D([], [], marker=marker, linestyle="", color=colour, markersize=4, label=case)
        for case, colour, marker in zip(cases, (RUNS[0], RUNS[1]), ("o", "^"), strict=True)
    ]
    panels[0].legend(handles=handles, loc="upper left")
    axes = panels[2]
    for (solver, measured), colour, marker in zip(factors.items(), (RUNS[0], RUNS[2]), ("o", "x"), strict=True):
        axes.plot(predicted[solver], measured, marker, color=colour, markersize=4, alpha=0.7, label=solver)
    factor = np.linspace(0, 1, 101)
    axes.plot(factor, factor, "-", color=LIMIT, linewidth=1, zorder=0)
    axes.plot(factor, factor**3, "--", color=LIMIT, linewidth=1, zorder=0)
    axes.text(0.32, 0.36, "one step", rotation=45, rotation_mode="anchor", color=PLAN)
    axes.text(0.5, 0.06, "three steps", color=PLAN)
    axes.set(xlim=(0, 1), ylim=(0, 1), title="factor of an iteration, with obstacles")
    axes.set(
        xlabel="factor of a Gauss-Newton step, by what is\nthrown away alone", ylabel="factor of an iteration, measured"
    )
    axes.legend(loc="upper left")
    drawn.set_layout_engine("tight")


def draw_ellipsoids(drawn: Figure, scenario: ls.Scenario, solutions: Mapping[str, ls.Solution]) -> None:
    """Level sets of the value functions of a robot in the plane, a panel a solution."""
    panels = drawn.subplots(1, len(solutions), sharey=True)
    for axes, (name, solution) in zip(panels, solutions.items(), strict=True):
        _level_sets(axes, scenario, solution)
        axes.set_title(name)
    panels[0].label_outer()
    panels[1].set_ylabel("")
    drawn.legend(*panels[0].get_legend_handles_labels(), loc="lower center", ncols=4)
    drawn.set_layout_engine("tight", rect=(0, 0.05, 1, 1))


def _level_sets(axes: Axes, scenario: ls.Scenario, solution: ls.Solution) -> None:
    """Of cost-to-go, cost-to-come and their sum, along the rollout, with the states of least total cost."""
    go, come, total = solution.cost_to_go, solution.cost_to_come, solution.total_cost
    assert go is not None
    assert isinstance(come, Moments)
    steps = np.arange(0, solution.trajectory.steps + 1, round(EVERY / solution.trajectory.dt))
    of_go = np.linalg.pinv(go.hessian, hermitian=True)
    least_to_go = -np.einsum("tij,tj->ti", of_go, go.gradient)
    (cost,) = scenario.problem.obstacle_costs
    world, plan = cost.world.seen_by("xy"), solution.trajectory.states[:, :2]
    low, high = plots.bounds(plan, world, 0.2)
    plots.draw_in_plane(axes, world, low, high, cost.radius)
    axes.plot(*plan.T, color=LIMIT, linewidth=1, label="rollout")
    for name, colour, marker, centres, shapes in (
        ("cost-to-go", RUNS[0], "s", least_to_go, of_go),
        ("cost-to-come", RUNS[1], "^", come.mean, come.covariance),
        ("total cost", PLAN, "o", total.minimizer(), total.covariance()),
    ):
        for step in steps:
            axes.add_patch(_shadow(centres[step, :2], shapes[step, :2, :2], colour, filled=name == "total cost"))
        axes.plot(*centres[steps, :2].T, marker, color=colour, markersize=3.5, label=name)


def _shadow(centre: Array, shape: Array, colour: str, *, filled: bool) -> Ellipse:
    """What a level set of a quadratic function of the state, of that inverse Hessian, covers in the plane."""
    values, axes = np.linalg.eigh(2 * ABOVE * shape)
    minor, major = 2 * np.sqrt(np.maximum(values, 0))
    return Ellipse(
        (float(centre[0]), float(centre[1])), major, minor, angle=float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))),
        facecolor=to_rgba(colour, 0.25 if filled else 0), edgecolor=colour, linewidth=1.0,
    )  # fmt: skip
