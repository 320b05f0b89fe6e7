"""Gradients of optima, against closed forms and against differences of optima that are solved for anew."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import point_mass
import pytest
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from mechanisms import arm
from numpy.typing import NDArray
from sampling import examples

import lqrsim as ls
from lqrsim.errors import Array

Make = Callable[[Array], ls.Problem]


def along(make: Make, at: Array, solution: ls.Solution, far: float, **options: Any) -> list[tuple[float, Array, Array]]:
    """Central differences of cost, states and controls of plans solved for anew, for each parameter.

    NaN for one along which a row becomes active, or ceases to be, as that is the gradient on neither side; or if a
    plan does not converge.
    """
    found = []
    for move in far * np.eye(len(at)):
        ahead, behind = (ls.smooth(make(at + side), start=solution, **options) for side in (move, -move))
        same = ahead.status is behind.status is ls.Status.CONVERGED
        if same and np.array_equal(acting(make(at + move), ahead), acting(make(at - move), behind)):
            pairs = [(one.cost, one.trajectory.states, one.trajectory.controls) for one in (ahead, behind)]
            found.append(tuple((one - other) / (2 * far) for one, other in zip(*pairs, strict=True)))
        else:
            found.append((np.nan, np.nan * solution.trajectory.states, np.nan * solution.trajectory.controls))
    return found


def acting(problem: ls.Problem, solution: ls.Solution) -> NDArray[np.bool_]:
    """Which limits and constraints act."""
    space, controls = problem.control_coordinates, solution.trajectory.controls
    parts = [controls <= space.low, controls >= space.high, *(one.values > 0 for one in solution.multipliers)]
    return np.concatenate([part.ravel() for part in parts])


def compare(found: ls.types.Gradients, wanted: list[tuple[float, Array, Array]], tolerance: float) -> None:
    """Compare each with differences, relative to the largest number of its kind."""
    kinds = [(found.cost, [cost for cost, _, _ in wanted])]
    if found.states is not None and found.controls is not None:
        kinds += [(found.states, [states for _, states, _ in wanted])]
        kinds += [(found.controls, [controls for *_, controls in wanted])]
    known = ~np.isnan([cost for cost, _, _ in wanted])
    assert known.any()
    for own, differences in kinds:
        own, other = own[..., known], np.stack(differences, axis=-1)[..., known]
        np.testing.assert_allclose(own, other, rtol=0, atol=tolerance * np.abs(other).max())


def test_a_linear_quadratic_problem_has_closed_forms() -> None:
    """Double integrators: the plan is linear in the start, and the Riccati recursion has the cost."""
    steps, A = 12, np.eye(4) + point_mass.DT * np.eye(4, k=2)
    B = np.vstack([point_mass.DT**2 / 2 * np.eye(2), point_mass.DT * np.eye(2)])
    final = np.diag([100.0] * 4)

    def make(p: Array) -> ls.Problem:
        whole = point_mass.problem(steps=steps, start=tuple(p[:4]), goal=(0, 0, 0, 0), limit=np.inf)
        return replace(whole, stage_cost=ls.ControlCost([p[4]] * 2, about=[0.0, 0.0]), constraints=())

    def riccati(weight: float) -> Array:
        S = final
        for _ in range(steps):
            S = A.T @ S @ A - A.T @ S @ B @ np.linalg.solve(weight * np.eye(2) + B.T @ S @ B, B.T @ S @ A)
        return S

    at = np.array([1.0, -2.0, 0.0, 0.5, 0.3])
    found = ls.gradients(make, at, ls.smooth(make(at)), plan=True)
    slopes = riccati(0.3) @ at[:4]
    step = 1e-4  # the error of the difference is about its square
    weighed = at[:4] @ (riccati(0.3 + step) - riccati(0.3 - step)) @ at[:4] / (4 * step)
    np.testing.assert_allclose(found.cost, [*slopes, weighed], rtol=1e-6)
    assert (found.error < 1e-6 * np.abs(found.cost)).all()
    # With all controls as one vector, u = -(R + E'QE)^-1 E'Q A^T x, where E is their effect on the last state.
    effect = np.hstack([np.linalg.matrix_power(A, steps - 1 - t) @ B for t in range(steps)])
    curved = 0.3 * np.eye(2 * steps) + effect.T @ final @ effect
    controls = -np.linalg.solve(curved, effect.T @ final @ np.linalg.matrix_power(A, steps))
    assert found.controls is not None
    assert found.states is not None
    # Rounding of differences by 1e-4 of a parameter.
    np.testing.assert_allclose(
        found.controls[..., :4].reshape(-1, 4), controls, rtol=0, atol=1e-8 * np.abs(controls).max()
    )
    np.testing.assert_allclose(found.states[0], np.eye(4, 5), rtol=0, atol=1e-9)


@settings(
    max_examples=examples(24), phases=[Phase.generate],
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)  # fmt: skip
@given(
    ball=st.tuples(st.floats(0.05, 0.3), st.floats(0.2, 0.6)), start=st.floats(-2.2, -1.5), goal=st.floats(1.5, 2.2),
    limit=st.sampled_from([3.7, 4.5, 6.0, 20.0]), soft=st.booleans(), weight=st.sampled_from([0.0, 0.1]),
)  # fmt: skip
def test_limits_clearance_goal_and_start(
    ball: tuple[float, float], start: float, goal: float, limit: float, soft: bool, weight: float
) -> None:
    """All parameters at once: the obstacle's place and radius, the margin, start and goal, the controls' limit."""

    def make(p: Array) -> ls.Problem:
        world = point_mass.balls((0.0, p[0], p[1]))
        return point_mass.problem(
            world, margin=p[2], start=(p[3], 0, 0, 0), goal=(p[4], 0, 0, 0), limit=p[5], soft=soft, weight=weight
        )

    at = np.array([*ball, 0.1, start, goal, limit])
    solution = ls.smooth(make(at), tolerance=1e-12)
    assume(solution.success and solution.curvature is ls.types.Curvature.MINIMUM)
    found = ls.gradients(make, at, solution, plan=True)
    assume(not found.changing)
    wanted = along(make, at, solution, 5e-4, tolerance=1e-12)
    assume(not np.isnan([cost for cost, _, _ in wanted]).all())
    # The differences' error is about 1e-7 of third derivatives, which are a thousand times as large for balls that both
    # ways round are nearly as good for; it falls with the square of their step.
    compare(found, wanted, 5e-4)


@pytest.mark.parametrize("query", [1, 2])
def test_a_quadrotor_its_mass_and_the_weights(query: int) -> None:
    """A robot's own numbers, the sharpness and weight of obstacles, the weights of controls and states."""
    scenario = ls.scenarios.quadrotor(query=query)

    def make(p: Array) -> ls.Problem:
        given = scenario.problem
        (shown,) = given.obstacle_costs
        dynamics = ls.Quadrotor(mass=p[0], drag=p[1]).dynamics
        avoid = ls.ObstacleCost(shown.world, radius=shown.radius, weight=p[3], sharpness=p[4])
        stage = ls.ControlCost([p[2]] * 4, about=given.nominal_control) + avoid
        goal = np.append(p[5:8], np.zeros(9))
        return replace(
            given, dynamics=dynamics, steps=60, stage_cost=stage, final_cost=ls.QuadraticCost([p[8]] * 12, about=goal)
        )

    assert scenario.problem.goal is not None
    at = np.array([0.5, 0.15, 20.0, 1.0, 5.0, *scenario.problem.goal[:3], 50.0])
    solution = ls.smooth(make(at), tolerance=1e-12)
    found = ls.gradients(make, at, solution, plan=True)
    # The least parameter is the drag, 0.15: the error of these differences is about 1e-6 of third derivatives.
    compare(found, along(make, at, solution, 1e-4, tolerance=1e-12), 1e-5)


def test_a_robot_from_an_mjcf(tmp_path: Path) -> None:
    """Its mass in the file, a damping, a goal: the dynamics are MuJoCo's, of which only steps are taken."""

    def make(p: Array) -> ls.Problem:
        path = tmp_path / "arm.xml"
        path.write_text(
            arm(
                0.5,
                0.4,
                joint='axis="0 1 0" damping="0.5"',
                joints=(f'damping="{p[1]}"', ""),
                limits=(20, 8),
                geoms=(f'mass="{p[0]}"', 'mass="0.2"'),
                option='timestep="0.01" integrator="RK4"',
            ),
            encoding="utf-8",
        )
        return ls.Problem(
            dynamics=ls.MjcfRobot(path).dynamics, dt=0.05, steps=15, initial=ls.FixedState([0.0] * 4),
            stage_cost=ls.ControlCost([0.01, 0.01], about=[0.0, 0.0]),
            final_cost=ls.QuadraticCost([100.0, 100.0, 10.0, 10.0], about=[p[2], 0.3, 0.0, 0.0]),
        )  # fmt: skip

    at = np.array([0.2, 0.5, -0.8])
    solution = ls.smooth(make(at), tolerance=1e-8)
    # Plans of MuJoCo's steps, whose derivatives are differences, are within 1e-4 of their optima.
    compare(ls.gradients(make, at, solution), along(make, at, solution, 1e-3, tolerance=1e-8), 1e-3)
    with pytest.raises(ls.InputError, match="curvature is NOT_CHECKED, want MINIMUM, or plan=False"):
        ls.gradients(make, at, solution, plan=True)


def near_point(p: Array, **changed: Any) -> ls.Problem:
    """A point mass without obstacles; its goal and its limit."""
    return replace(point_mass.problem(goal=(p[0], 0, 0, 0), limit=p[1]), constraints=(), **changed)


def test_ilqr_has_the_start_of_the_initial_cost() -> None:
    def make(p: Array) -> ls.Problem:
        return replace(point_mass.problem(start=(p[0], 0, 0, 0), soft=True), constraints=())

    at = np.array([-2.0])
    found = ls.gradients(make, at, ls.ilqr(make(at), tolerance=1e-10))
    ahead, behind = (ls.ilqr(make(at + side), tolerance=1e-10).cost for side in (1e-3, -1e-3))
    np.testing.assert_allclose(found.cost, (ahead - behind) / 2e-3, rtol=1e-6)  # exact for a quadratic cost


def test_elastic_constraints_count_by_their_price() -> None:
    """A bound that is too dear to keep: the cost has its price, and the plan is not held there."""
    price = 1.0

    def make(p: Array) -> ls.Problem:
        fast = ls.StateBounds(vx=(-p[0], p[0]))
        return near_point(np.array([2.0, 20.0])).with_constraints([fast])

    def priced(p: Array) -> ls.Solution:
        return ls.smooth(make(p), elastic=price, tolerance=1e-10)

    def cost(solution: ls.Solution, p: Array) -> float:
        return solution.cost + price * np.maximum(np.abs(solution.trajectory.states[:, 2]) - p[0], 0.0).sum()

    at = np.array([2.1])
    solution = priced(at)
    assert solution.violation > 0.1
    found = ls.gradients(make, at, solution, plan=True)
    ahead, behind = (priced(at + side) for side in (1e-3, -1e-3))
    np.testing.assert_allclose(found.cost, (cost(ahead, at + 1e-3) - cost(behind, at - 1e-3)) / 2e-3, rtol=1e-6)
    assert found.controls is not None
    wanted = (ahead.trajectory.controls - behind.trajectory.controls) / 2e-3
    np.testing.assert_allclose(found.controls[..., 0], wanted, rtol=0, atol=1e-5)


def test_where_a_limit_is_about_to_act_it_is_named() -> None:
    """With just more than the plan uses, the limit is not active; with just less it is, and the plan follows it."""
    free = ls.smooth(near_point(np.array([2.0, 1e3]))).trajectory.controls
    used = float(np.abs(free).max())
    step = int(np.abs(free).max(axis=1).argmax())
    found = {}
    for part in (-1e-2, -1e-6, 1e-6, 1e-2):
        at = np.array([2.0, used * (1 + part)])
        found[part] = ls.gradients(near_point, at, ls.smooth(near_point(at)), plan=True)
        assert any(f"at step {step}" in line for line in found[part].changing) == (abs(part) < 1e-3)
    # The gradient of the cost is continuous, that of the plan jumps.
    assert found[-1e-6].cost == pytest.approx(found[1e-6].cost, rel=1e-4, abs=1e-4)
    below, above = found[-1e-6].controls, found[1e-6].controls
    assert below is not None
    assert above is not None
    assert np.abs(below[step, 0, 1]) == pytest.approx(1.0)
    assert not above[..., 1].any()


def test_what_has_no_gradient_is_refused() -> None:
    at = np.array([2.0, 20.0])
    solution = ls.smooth(near_point(at))
    noise = ls.Noise(lambda x, u, p: [[0], [0], [1], [1]], size=1)
    cases: list[tuple[str, Any, Any, ls.Solution, dict[str, Any]]] = [
        ("CONVERGED one", near_point, at, ls.smooth(near_point(at), stop="cost"), {}),
        ("want that of make", near_point, at + 0.5, solution, {}),
        ("of another problem", lambda p: near_point(p, steps=7), at, solution, {}),
        ("of another problem", near_point, at, ls.smooth(point_mass.problem()), {}),
        ("with noise", lambda p: near_point(p, noise=noise), at, solution, {}),
        ("free duration", lambda p: near_point(p, duration=(1.0, 3.0)), at, solution, {}),
        ("want the same", lambda p: near_point(p, control_limits=None if p[0] > 2 else (-20, 20)), at, solution, {}),
        ("a function that returns a Problem", lambda p: p, at, solution, {}),
        ("one at least", near_point, [], solution, {}),
        ("scale: got -1", near_point, at, solution, {"scale": [1.0, -1.0]}),
    ]
    for line, make, point, of, options in cases:
        with pytest.raises(ls.InputError, match=line):
            ls.gradients(make, point, of, **options)
