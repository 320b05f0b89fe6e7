"""The figure of a policy: what is drawn is what the costs themselves say."""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from sampling import rarely

import lqrsim as ls
from lqrsim.control.tubes import Tube, predict_tube
from lqrsim.view.overlays import Ellipsoids
from lqrsim.view.plots import CLOSE, draw_policy, draw_projected, draw_tube, strength
from lqrsim.view.style import MARGIN


def drawn(solution: ls.Solution, scenario: ls.Scenario, tube: Tube | None = None) -> Figure:
    figure = Figure()
    draw_policy(figure, solution, scenario.scene.world, scenario.robot.radius, tube)
    return figure


def cost_from(scenario: ls.Scenario, solution: ls.Solution, knot: int) -> float:
    """What is paid from a knot on, summed up by the definition of the costs: obstacles cost from the first step on."""
    states, controls = solution.trajectory.states, solution.trajectory.controls
    world, radius = scenario.scene.world.seen_by("xy"), scenario.robot.radius
    goal, weight = np.array([0.0, 2.5, np.pi]), np.array([5000.0, 5000.0, 50.0])
    obstacles = np.exp(-10.0 * (np.array([world.distances(state[:2]) for state in states[max(knot, 1) : -1]]) - radius))
    steering = 0.5 * 60.0 * ((controls[knot:] - 0.25) ** 2).sum()
    return float(steering + obstacles.sum() + 0.5 * (weight * (states[-1] - goal) ** 2).sum())


def test_cost_to_go_is_what_the_plan_still_pays(drive_solution: ls.Solution, differential_drive: ls.Scenario) -> None:
    """At the optimum the quadratic's value on the plan is the plan's own cost."""
    finer = ls.smooth(differential_drive.problem, tolerance=1e-9)
    (curve,) = [line for axes in drawn(finer, differential_drive).axes for line in axes.lines
                if line.get_label() == "cost-to-go"]  # fmt: skip
    times, values = np.asarray(curve.get_xdata()), np.asarray(curve.get_ydata())
    np.testing.assert_array_equal(times, finer.trajectory.times)
    paid = [cost_from(differential_drive, finer, knot) for knot in range(len(times))]
    # The gap is 2e-6 by then, and the difference of second order in it.
    np.testing.assert_allclose(values, paid, atol=1e-7)
    assert values[0] - values[-1] > 20


@pytest.mark.parametrize("states", [(0, 1), (0, 2)])
def test_outlines_lie_where_the_total_cost_is_two_above_its_least(
    quadrotor_solution: ls.Solution, states: tuple[int, int]
) -> None:
    """Of all states with that place on the outline, the best has a total cost of two above the least of all."""
    solution = quadrotor_solution
    assert solution.cost_to_go is not None
    assert isinstance(solution.cost_to_come, ls.types.Moments)
    knots = np.array([20, 75, 130])
    go, come = solution.cost_to_go, solution.cost_to_come
    least = solution.total_cost.minimum()
    hidden = [i for i in range(12) if i not in states]
    for knot, outline in zip(knots, Ellipsoids.of_cost(solution, states).outlines()[knots], strict=True):
        hessian, gradient = go.hessian[knot], go.gradient[knot]
        precise = np.linalg.inv(come.covariance[knot])
        both, slope = hessian + precise, gradient - precise @ come.mean[knot]
        for place in outline[::7]:
            state = np.zeros(12)
            state[list(states)] = place
            state[hidden] = -np.linalg.solve(both[np.ix_(hidden, hidden)], (slope + both @ state)[hidden])
            off = state - come.mean[knot]
            cost = (
                0.5 * state @ hessian @ state + state @ gradient + np.asarray(go.constant)[knot]
                + 0.5 * off @ precise @ off + np.asarray(come.constant)[knot]
            )  # fmt: skip
            # Inverting the covariance costs some of the digits, and the terms are far larger than their sum.
            assert cost - least[knot] == pytest.approx(2.0, rel=1e-3)


def test_the_tube_of_the_cost_that_is_drawn_is_that_of_every_knot(
    drive_solution: ls.Solution, differential_drive: ls.Scenario
) -> None:
    """Against both value functions, whose minimum and curvature are worked out here: two standard deviations about it.

    Inverting the covariance costs some of the digits.
    """
    axes = drawn(drive_solution, differential_drive).axes[0]
    tube, _ = [one for one in axes.collections if isinstance(one, PolyCollection)]
    go, come = drive_solution.cost_to_go, drive_solution.cost_to_come
    assert go is not None
    assert isinstance(come, ls.types.Moments)
    assert len(tube.get_paths()) == 151
    for knot, path in enumerate(tube.get_paths()):
        precise = np.linalg.inv(come.covariance[knot])
        both = np.linalg.inv(go.hessian[knot] + precise)
        centre, block = (both @ (precise @ come.mean[knot] - go.gradient[knot]))[:2], both[:2, :2]
        away = np.unique(np.asarray(path.vertices), axis=0) - centre
        np.testing.assert_allclose(np.sum(away @ np.linalg.inv(block) * away, axis=1), 4.0, rtol=1e-3)
        # All the way round: evenly spread over the ellipse, points vary as much as half of its square.
        np.testing.assert_allclose(away.T @ away / len(away), 2 * block, rtol=0, atol=1e-3 * np.abs(block).max())


@pytest.fixture(scope="module")
def drive_tube(differential_drive: ls.Scenario, drive_solution: ls.Solution) -> Tube:
    uncertainty = ls.uncertainty_of(differential_drive.plant(), [ls.disturbances.ControlNoise(0.05)])
    return predict_tube(differential_drive.problem, drive_solution, uncertainty)


def test_a_predicted_tube_is_drawn_at_every_knot_with_the_half_axes_of_its_covariance(
    drive_solution: ls.Solution, differential_drive: ls.Scenario, drive_tube: Tube
) -> None:
    """Half axes: the farthest and the nearest point of an outline, against the eigenvalues of the covariance."""
    figure = drawn(drive_solution, differential_drive, drive_tube)
    tube, *_ = [one for one in figure.axes[0].collections if isinstance(one, PolyCollection)]
    assert len(tube.get_paths()) == 151
    assert str(tube.get_label()).startswith("predicted: 2 sigma")
    for knot, path in enumerate(tube.get_paths()):
        away = np.asarray(path.vertices) - drive_solution.trajectory.states[knot, :2]
        distances = np.linalg.norm(away, axis=1)
        half_axes = 2 * np.sqrt(np.maximum(np.linalg.eigvals(drive_tube.covariance[knot, :2, :2]).real, 0))
        # The outline of 48 points has one at each end of both axes.
        assert sorted(half_axes) == pytest.approx([distances.min(), distances.max()], rel=1e-9, abs=1e-12)
    (chance,) = [line for axes in figure.axes for line in axes.lines if axes.get_ylabel() == "chance"]
    shown = np.asarray(chance.get_ydata())
    np.testing.assert_array_equal(shown[drive_tube.step_chance > 0], drive_tube.step_chance[drive_tube.step_chance > 0])


def test_a_tube_ends_where_it_would_hide_the_picture(drive_solution: ls.Solution) -> None:
    """Ten times the plan's length at the end; drawn until its half axis is a fifth of the diagonal."""
    places = drive_solution.trajectory.states[:, :2]
    std = np.linspace(0, 30.0, 151)
    tube = Ellipsoids.predicted(places, np.einsum("t,ij->tij", std**2, np.eye(2)))
    largest = 0.2 * np.hypot(*np.ptp(places, axis=0))
    assert len(tube.centres) == np.count_nonzero(2 * std <= largest)
    assert 2 < len(tube.centres) < 20
    assert tube.label.endswith(f"drawn up to half axes of {largest:.2g} m")
    # One that is too wide from the first knot on leaves the plan alone.
    nothing = Ellipsoids.predicted(places, np.tile(1e6 * np.eye(2), (151, 1, 1)))
    assert nothing.outlines().shape == (0, 48, 2)
    assert len(nothing.overlapping(np.arange(0), 10)) == 0
    axes = Figure().add_subplot()
    draw_tube(axes, nothing, nothing.label, face="b", edge="k")
    assert not [path for one in axes.collections for path in one.get_paths()]
    assert Ellipsoids.predicted(places, np.zeros((151, 2, 2))).label == "predicted: 2 sigma, 95 % in each direction"


@pytest.mark.parametrize("moves", [0.0, 1e-12, 1e-6, 9e-4])
def test_a_tube_about_a_plan_that_stays_in_place_is_whole(moves: float) -> None:
    places = np.linspace((1.0, 2.0), (1.0 + moves, 2.0), 151)
    for std in (1e-9, 0.01, 3.0):
        tube = Ellipsoids.predicted(places, np.tile(std**2 * np.eye(2), (151, 1, 1)))
        assert len(tube.centres) == 151
        assert tube.label == "predicted: 2 sigma, 95 % in each direction"


def test_shadows_in_a_plane_are_marginals() -> None:
    """The shadow of an ellipsoid along a direction, against the silhouette of many of its points."""
    covariance = np.array([[0.05, 0.02, 0.0], [0.02, 0.09, -0.03], [0.0, -0.03, 0.04]])
    solid = Ellipsoids(np.zeros((1, 3)), covariance[None])
    half_axes, rotations = solid.axes()
    ball = np.random.default_rng(0).normal(size=(200_000, 3))
    surface = (ball / np.linalg.norm(ball, axis=1, keepdims=True) * half_axes[0]) @ rotations[0].T
    onto = np.linalg.qr(np.array([[1.0, 2.0], [0.5, -1.0], [0.3, 0.7]]))[0].T
    outline = solid.projected(onto).outlines()[0]
    for angle in np.linspace(0, np.pi, 7):
        look = np.array([np.cos(angle), np.sin(angle)])
        # 48 points see their farthest end within (pi / 48)^2 / 2 of it, 200,000 within a thousandth.
        assert (outline @ look).max() == pytest.approx((surface @ onto.T @ look).max(), rel=4e-3)


def test_a_tube_of_another_plan_is_refused(
    drive_solution: ls.Solution, differential_drive: ls.Scenario, drive_tube: Tube, tmp_path: Path
) -> None:
    look: dict = {"world": differential_drive.scene.world, "radius": 0.2}
    moved = replace(drive_tube.plan, states=drive_tube.plan.states + 0.1)
    with pytest.raises(ls.InputError, match="tube: got a tube of another plan"):
        ls.view.plot_policy(drive_solution, tmp_path / "p.png", tube=replace(drive_tube, plan=moved), **look)
    with pytest.raises(ls.InputError, match="tube: got 3, want a Tube"):
        ls.view.plot_policy(drive_solution, tmp_path / "p.png", tube=3, **look)  # pyright: ignore[reportArgumentType]
    assert not list(tmp_path.iterdir())


def test_strength_is_the_answer_in_the_worst_direction(quadrotor_solution: ls.Solution) -> None:
    """Against the policy itself: of many directions of a unit's states, none moves the control more, and one does."""
    policy, plan = quadrotor_solution.policy, quadrotor_solution.trajectory
    rng = np.random.default_rng(0)
    for unit, chosen in {"m": slice(0, 3), "rad/s": slice(9, 12)}.items():
        directions = rng.normal(size=(4000, 3))
        states = np.tile(plan.states[40], (4000, 1))
        states[:, chosen] += directions / np.linalg.norm(directions, axis=1, keepdims=True)
        answers = policy.control(states, 40) - policy.control(plan.states[40], 40)
        for control in range(4):
            most, said = np.abs(answers[:, control]).max(), strength(policy, control, unit)[40]
            # The nearest of 4000 directions is within 0.1 rad, whose cosine is 0.995.
            assert 0.995 * said <= most <= said * (1 + 1e-12)


def test_axes_have_units(
    drive_solution: ls.Solution,
    quadrotor_solution: ls.Solution,
    differential_drive: ls.Scenario,
    quadrotor: ls.Scenario,
    tmp_path: Path,
) -> None:
    def texts(solution: ls.Solution, scenario: ls.Scenario) -> list[str]:
        options = {"world": scenario.scene.world, "radius": scenario.robot.radius}
        path = ls.view.plot_policy(solution, tmp_path / "policy.svg", **options)
        return [re.sub(r"<[^>]+>", "", text) for text in re.findall(r"<text.*?</text>", path.read_text(), re.DOTALL)]

    drive = texts(drive_solution, differential_drive)
    assert {"x (m)", "y (m)", "time (s)", "cost", "m/s", "per m", "per rad", "left", "right"} <= set(drive)
    flight = texts(quadrotor_solution, quadrotor)
    assert {"x (m)", "y (m)", "z (m)", "N", "per m", "per m/s", "per rad", "per rad/s", "rotor 4"} <= set(flight)


@pytest.mark.parametrize("suffix", rarely(".pdf", ".png"))
def test_same_policy_gives_the_same_bytes(
    suffix: str, drive_solution: ls.Solution, differential_drive: ls.Scenario, tmp_path: Path
) -> None:
    options = {"world": differential_drive.scene.world, "radius": differential_drive.robot.radius}
    first, second = (
        ls.view.plot_policy(drive_solution, tmp_path / f"{n}{suffix}", **options).read_bytes() for n in "ab"
    )
    assert first == second


def test_solutions_without_a_cost_to_come_have_no_tube(differential_drive: ls.Scenario, tmp_path: Path) -> None:
    solution = ls.ilqr(differential_drive.problem)
    axes = drawn(solution, differential_drive).axes[0]
    assert not [one for one in axes.collections if isinstance(one, PolyCollection)]
    with pytest.raises(ls.InputError, match="solution: got no cost-to-go"):
        ls.view.plot_policy(replace(solution, cost_to_go=None), tmp_path / "policy.png", world=ls.World([]), radius=0.1)
    assert not list(tmp_path.iterdir())


def tank(states: int) -> ls.Problem:
    """Tanks in a row that drain into one another: a system without a position."""
    names = tuple(f"level_{i}" for i in range(states))
    dynamics = ls.Dynamics(
        lambda x, u, p: [u[0] - x[0], *(x[i - 1] - x[i] for i in range(1, states))],
        states=dict.fromkeys(names, "m3"), controls={"inflow": "m3/s"},
    )  # fmt: skip
    return ls.Problem(
        dynamics=dynamics, dt=0.1, steps=12, initial=ls.FixedState(np.zeros(states)),
        stage_cost=ls.ControlCost([1.0]), final_cost=ls.QuadraticCost(np.full(states, 50.0), about=np.ones(states)),
    )  # fmt: skip


@pytest.mark.parametrize("states", [1, 3])
def test_a_system_without_a_position_needs_no_world_and_no_radius(states: int, tmp_path: Path) -> None:
    solution = ls.smooth(tank(states))
    path = ls.view.plot_policy(solution, tmp_path / "policy.svg")
    assert all(f"level {i}" in path.read_text() for i in range(states))


@pytest.mark.parametrize("world", [True, False])
def test_without_a_radius_no_place_is_grey_and_the_plan_is_within_the_axes(
    world: bool, drive_solution: ls.Solution, differential_drive: ls.Scenario
) -> None:
    seen = differential_drive.scene.world if world else ls.World()
    figures = {radius: Figure() for radius in (0.0, 0.17)}
    for radius, figure in figures.items():
        draw_policy(figure, drive_solution, seen, radius)
        axes = figure.axes[0]
        assert (CLOSE in axes.get_legend_handles_labels()[1]) == (world and radius > 0)
        (low, high), plan = np.array([axes.get_xlim(), axes.get_ylim()]).T, drive_solution.trajectory.states[:, :2]
        assert (low < plan.min(axis=0)).all()
        assert (plan.max(axis=0) < high).all()
    greys = [
        [to_hex(tuple(colour)) for one in figure.axes[0].collections for colour in np.atleast_2d(one.get_facecolor())]
        for figure in figures.values()
    ]
    assert [MARGIN in colours for colours in greys] == [False, world]


def test_obstacles_cast_the_shadow_of_their_shape() -> None:
    """A box that is turned about the line of sight is seen as it is, and one turned about another axis is wider."""
    angle = 0.6
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    box = ls.Obstacle("box", "box", np.array([0.5, 0.2, 0.1]), turn, np.array([0.4, 0.3, 0.2]))
    low, high = np.full(3, -2.0), np.full(3, 2.0)

    def shadow(across: int, up: int) -> np.ndarray:
        axes = Figure().add_subplot()
        draw_projected(axes, ls.World([box]), low, high, [across, up])
        (patch,) = axes.patches
        return np.asarray(patch.get_path().vertices)

    above = shadow(0, 1)
    sides = sorted(np.hypot(*(b - a)) for a, b in pairwise(above))
    np.testing.assert_allclose(sides[-4:], [0.6, 0.6, 0.8, 0.8])
    side = shadow(0, 2)
    assert np.ptp(side[:, 0]) == pytest.approx(0.8 * np.cos(angle) + 0.6 * np.sin(angle))
    assert np.ptp(side[:, 1]) == pytest.approx(0.4)


@pytest.mark.parametrize("ratio", [1.0, 0.1, 0.01, 1e-4])
def test_no_planned_state_is_flat_beside_another(ratio: float) -> None:
    """Two motions of one unit: every curve takes at least a twentieth of its strip, if it moves at all."""
    dynamics = ls.Dynamics(
        lambda x, u, p: [u[0], p.ratio * u[0], x[0], 0 * x[0]], parameters={"ratio": ratio},
        states={"large": "m", "small": "m", "way": "m s", "still": "m"}, controls={"speed": "m/s"},
    )  # fmt: skip
    problem = ls.Problem(
        dynamics=dynamics, dt=0.1, steps=10, initial=ls.FixedState(np.zeros(4)), stage_cost=ls.ControlCost([0.1]),
        final_cost=ls.QuadraticCost([10.0, 0, 0, 0], about=[1.0, 0, 0, 0]),
    )  # fmt: skip
    figure = Figure()
    draw_policy(figure, ls.smooth(problem), ls.load_scene("arena").world, 0.1, None)
    names = {"large", "small", "way", "still"}
    seen = [(axes, line) for axes in figure.axes for line in axes.lines if line.get_label() in names]
    assert sorted(str(line.get_label()) for _, line in seen) == sorted(names)
    for axes, line in seen:
        bottom, top = axes.get_ylim()
        height = np.ptp(np.asarray(line.get_ydata(), dtype=np.float64))
        assert line.get_label() == "still" or height >= 0.05 * (top - bottom) / 1.2
