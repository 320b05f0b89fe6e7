"""Plans in continuous time: what they do between their knots is found, and kept to what is asked."""

import pickle
from dataclasses import replace
from pathlib import Path

import between_knots
import numpy as np
import pytest
from failing_solves import rattled
from mechanisms import arm
from sampling import rarely
from scipy.integrate import solve_ivp

import lqrsim as ls
from lqrsim.codegen.plain import plain_functions
from lqrsim.errors import Array
from lqrsim.problem.problem import PlainTerm
from lqrsim.solvers import between_knots as solver
from lqrsim.solvers.between_knots import TIMES, WithinPeriods

TOLERANCE = between_knots.TOLERANCE


def exactly(dynamics: ls.Dynamics, state: Array, control: Array, seconds: float) -> Array:
    """The motion by SciPy, to 1e-12."""
    return solve_ivp(
        lambda _, x: dynamics.rate(x, control), (0.0, seconds), state, method="DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]


def swung(x, u, p):
    from sympy import sin

    return [x.speed, u.torque - 9.81 * sin(x.angle) - u.torque * x.speed**2 / 50]


PENDULUM = ls.Dynamics(swung, states={"angle": "rad", "speed": "rad/s"}, controls={"torque": "1/s^2"})
SWING = ls.Problem(
    dynamics=PENDULUM, dt=0.15, steps=20, initial=ls.FixedState([0.0, 0.0]), stage_cost=ls.ControlCost([0.01]),
    final_cost=ls.QuadraticCost([1.0, 1.0], about=[np.pi, 0.0]), constraints=[ls.GoalState([np.pi, 0.0])],
    control_limits=(-12.0, 12.0),
)  # fmt: skip


class TestSubsteps:
    STATE, CONTROL = np.array([1.0, 2.0]), np.array([0.7])

    def test_twice_as_many_have_a_sixteenth_of_the_error(self) -> None:
        """Runge-Kutta's order, to a fifth: the next order is an eighth of the step."""
        exact = exactly(PENDULUM, self.STATE, self.CONTROL, 0.3)
        errors = [
            np.abs(PENDULUM.with_substeps(count).step(self.STATE, self.CONTROL, 0.3) - exact).max() for count in (8, 16)
        ]
        assert errors[0] / errors[1] == pytest.approx(16, rel=0.2)

    def test_derivatives_are_those_of_the_period(self) -> None:
        """Against central differences over 1e-5, right to some 1e-9 for slopes of size 1."""
        finer, z, weights = PENDULUM.with_substeps(3), np.append(self.STATE, self.CONTROL), np.array([0.6, -1.3])

        def slopes(z: Array) -> Array:
            return np.hstack(finer.linearize(z[:2], z[2:], 0.3)[:2])

        moved = [(z + 1e-5 * one, z - 1e-5 * one) for one in np.eye(3)]
        steps = [[finer.step(each[:2], each[2:], 0.3) for each in pair] for pair in moved]
        np.testing.assert_allclose(slopes(z).T, [(a - b) / 2e-5 for a, b in steps], atol=1e-8)
        assert finer.curvature_source is not None
        curvature = plain_functions(finer.curvature_source, {"N": 2, "M": 1, "W": 3}, ["step_curvature"])
        hessian, jacobian = np.zeros((3, 3)), np.zeros((2, 3))
        curvature["step_curvature"](z[:2], z[2:], finer.data, 0.3, weights, np.zeros(2), jacobian, hessian)
        np.testing.assert_allclose(jacobian, slopes(z), rtol=1e-12)
        by_differences = [weights @ (slopes(a) - slopes(b)) / 2e-5 for a, b in moved]
        np.testing.assert_allclose(hessian, by_differences, atol=1e-7)


def test_accuracy_takes_as_many_substeps_as_it_needs() -> None:
    asked = 1e-7
    rough, fine = ls.smooth(SWING), ls.smooth(replace(SWING, accuracy=asked))
    assert rough.success
    assert fine.success
    plan = fine.trajectory
    ends = [exactly(PENDULUM, x, u, plan.dt) for x, u in zip(plan.states, plan.controls, strict=False)]
    sizes = np.maximum(np.abs(plan.states).max(axis=0), 1.0)
    assert (np.abs(ends - plan.states[1:]) / sizes).max() <= asked
    assert rough.between_knots().step_error > 100 * asked
    assert "use Problem(accuracy=1e-6)" in str(rough)
    assert "between:" not in str(fine)
    substeps = fine.options["substeps"]
    assert isinstance(substeps, int)
    # It is the plan of dynamics with so many: from there nothing is left to do.
    again = ls.smooth(replace(SWING, dynamics=PENDULUM.with_substeps(substeps)), start=fine)
    np.testing.assert_allclose(again.trajectory.states, plan.states, atol=1e-6)


@pytest.mark.parametrize("steps", [16, 40, *rarely(20)])
def test_a_plan_of_many_substeps_is_looked_at_with_them(steps: int) -> None:
    """With one step in a period of many vibrations nothing of the motion is seen, and the plan was called coarse."""
    found = ls.smooth(rattled(steps=steps))
    assert found.success
    looked = found.between_knots()
    assert looked.step_error <= 1e-6
    assert "accuracy=" not in str(found)
    # The vibration's amplitude is 1, and what one step in a period makes of it has nothing to do with that.
    plan, shaken = found.trajectory, np.sin(1e3 * found.trajectory.states[:, 0])
    moved = plan.states[0, 1] + np.append(0.0, np.cumsum(plan.controls[:, 0]) * plan.dt) + shaken
    assert np.abs(plan.states[:, 1] - moved).max() == pytest.approx(looked.end_error, abs=1e-6)


def test_errors_are_those_by_scipy() -> None:
    """The error of a step to a thousandth, that of the end to a hundredth of itself."""
    found, plan = ls.smooth(SWING).between_knots(), ls.smooth(SWING).trajectory
    sizes = np.maximum(np.abs(plan.states).max(axis=0), 1.0)
    ends, last = [], plan.states[0]
    for x, u in zip(plan.states, plan.controls, strict=False):
        ends.append(exactly(PENDULUM, x, u, plan.dt))
        last = exactly(PENDULUM, last, u, plan.dt)
    assert found.step_error == pytest.approx((np.abs(ends - plan.states[1:]) / sizes).max(), rel=1e-3)
    assert found.end_error == pytest.approx((np.abs(last - plan.states[-1]) / sizes).max(), rel=1e-2)


# A drive, with a fixed duration and with a free one; and with `--long` all robots.
@pytest.mark.parametrize("number", [1, 49, *rarely(*range(2, 40))])
def test_what_is_kept_between_knots_is_kept_in_continuous_time(number: int) -> None:
    case = between_knots.draw(number)
    loose = ls.smooth(case.problem, threads=1)
    kept = ls.smooth(replace(case.problem, between_knots=True), threads=1)
    assert loose.status is kept.status is ls.Status.CONVERGED
    seen = between_knots.violation(case, loose.trajectory)
    found = max((by for by, _ in loose.between_knots().violations.values()), default=0.0)
    assert found == pytest.approx(seen, rel=0.01, abs=1e-5)  # at 16 times with a parabola, and at 60 times
    if seen > 1e-5:
        assert "between_knots=True)" in str(loose)
    assert between_knots.violation(case, kept.trajectory) <= TOLERANCE
    assert "between_knots=True)" not in str(kept)  # the steps may be off: no accuracy is asked for


# A drive, with a fixed duration and with free ones: what is compiled for the others takes seconds.
@pytest.mark.parametrize("number", [1, 4, 49, *rarely(2, 3)])
@pytest.mark.parametrize("begin", [-2.0, 5.0])
def test_times_between_knots_are_those_of_the_plan(number: int, begin: float) -> None:
    """As those of knots: from the plan's first one, whenever it begins."""
    problem = between_knots.draw(number).problem
    found = ls.smooth(problem, threads=1).between_knots().violations
    later = ls.smooth(replace(problem, begin=begin), threads=1)
    assert later.between_knots().violations == found
    assert all(0 <= time <= later.trajectory.horizon for _, time in found.values())


@pytest.mark.parametrize("margin", [0.02, np.linspace(0.0, 0.04, 5)], ids=["margin", "by knot"])
@pytest.mark.parametrize("speed", [0.0, 0.03, -0.5])
def test_obstacles_that_move_are_left_out(margin: float | Array, speed: float) -> None:
    """Whatever the margins: their places between the knots are not looked at, where the plan meets the ball."""
    point = ls.Dynamics(
        lambda x, u, p: [u[0], u[1]], states={"x": "m", "y": "m"}, controls={"a": "m/s", "b": "m/s"},
        position=("x", "y"),
    )  # fmt: skip
    ball = ls.Obstacle(
        "ball", "sphere", np.array([-0.25, 0.0, 0.0]), np.eye(3), np.array([0.1, 0, 0]),
        velocity=np.array([0.0, speed, 0.0]),
    )  # fmt: skip
    problem = ls.Problem(
        dynamics=point, dt=1.0, steps=4, initial=ls.FixedState([-1.0, 0.0]), stage_cost=ls.ControlCost([1.0, 1.0]),
        final_cost=ls.QuadraticCost([1e3, 1e3], about=[1.0, 0.0]),
        constraints=[ls.Clearance(ls.World([ball]).seen_by("xy"), radius=0.05, margin=margin)],
    )  # fmt: skip
    violations = ls.smooth(problem).between_knots().violations
    assert bool(violations) == (speed == 0)


def test_a_plan_that_is_right_between_its_knots_stays_as_it_is() -> None:
    case = between_knots.draw(9)  # a point with much room
    plans = [ls.smooth(replace(case.problem, between_knots=asked), threads=1) for asked in (False, True)]
    assert not plans[0].between_knots().violations
    assert (plans[0].trajectory.states == plans[1].trajectory.states).all()
    assert (plans[0].policy.gain == plans[1].policy.gain).all()


def test_without_time_the_last_plan_is_not_called_converged() -> None:
    case = between_knots.draw(1)
    begin = ls.smooth(case.problem, threads=1)
    found = ls.smooth(replace(case.problem, between_knots=True), threads=1, start=begin, time_limit=1e-9)
    assert found.status is ls.Status.TIME_LIMIT


@pytest.mark.parametrize("margin", [0.02, np.linspace(0.0, 0.1, 5)])
def test_rows_within_periods_are_the_constraint_on_the_way(margin: float | Array) -> None:
    """Their values against SciPy's motion, to the Runge-Kutta step's 1e-7; their slopes against differences."""
    world = ls.World([ls.Obstacle("ball", "sphere", np.array([1.0, 0.3, 0.0]), np.eye(3), np.array([0.2, 0.0, 0.0]))])
    dynamics, clear = between_knots.ROBOTS["drive"].dynamics, ls.Clearance(world, radius=0.1, margin=margin)
    term = WithinPeriods(clear, np.array([[1.0], [0.0], [1.0], [1.0]]), np.array([0.01]))._bind_at(
        dynamics, 0.2 * np.arange(5), {}
    )
    plain, z = PlainTerm(term, 4, 2), np.array([0.2, -0.1, 0.4, 1.2, 0.5, -0.8])
    for row in range(TIMES):
        x = exactly(dynamics, z[:4], z[4:], 0.2 * (row + 1) / TIMES)
        asked = np.min(margin[2:4]) if isinstance(margin, np.ndarray) else margin
        apart = np.linalg.norm(x[:2] - [1.0, 0.3]) - 0.3 - asked - 0.01
        assert plain.value(z, row, knot=2) == pytest.approx(apart, abs=1e-7)
        by_differences = [
            (plain.value(z + 1e-6 * one, row, knot=2) - plain.value(z - 1e-6 * one, row, knot=2)) / 2e-6
            for one in np.eye(6)
        ]
        gradient = np.zeros(6)
        plain._functions["slope"](z[:4], z[4:], 2, row, plain._data, gradient)
        np.testing.assert_allclose(gradient, by_differences, atol=1e-8)
    assert plain.value(z, 0, knot=1) == plain.value(z, 0, knot=4) == np.inf


def test_a_robot_of_an_mjcf_is_looked_at_after_each_physics_step(tmp_path: Path) -> None:
    (tmp_path / "pole.xml").write_text(arm(0.4, names=("pole",)), encoding="utf-8")
    robot = ls.MjcfRobot(tmp_path / "pole.xml")
    n, m = len(robot.dynamics.state_coordinates), len(robot.dynamics.control_coordinates)
    name = robot.dynamics.state_coordinates.names[-1]
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=5 * robot.dynamics.period, steps=3, initial=ls.FixedState(np.full(n, 0.1)),
        stage_cost=ls.ControlCost(np.ones(m)), final_cost=ls.QuadraticCost(np.ones(n), about=np.zeros(n)),
        constraints=[ls.StateBounds({name: (-np.inf, -1.0)})],
    )  # fmt: skip
    states, controls = [np.full(n, 0.1)], np.full((3, m), 0.3)
    between = []
    for u in controls:
        between += [robot.dynamics.step(states[-1], u, k * robot.dynamics.period)[-1] for k in range(1, 6)]
        states.append(robot.dynamics.step(states[-1], u, problem.dt))
    found = solver.between_knots(problem, ls.Trajectory(np.array(states), controls, problem.dt))
    assert found.step_error == 0
    ((by, _),) = found.violations.values()
    assert by == pytest.approx(max(between) + 1.0, rel=1e-6)


def test_what_has_no_problem_with_it_can_not_be_looked_at(tmp_path: Path) -> None:
    plan = ls.smooth(SWING)
    for other in (pickle.loads(pickle.dumps(plan)), ls.load(ls.save(plan, tmp_path / "plan.npz"))):
        assert isinstance(other, ls.Solution)
        assert "between:" not in str(other)
        with pytest.raises(ls.InputError, match="between_knots: got a solution from a file"):
            other.between_knots()


def test_what_can_not_be_kept_between_knots_is_refused() -> None:
    plain = ls.Dynamics(lambda x, u, p: [u[0]], states={"x": "m"}, controls={"u": "m/s"}, level="plain")
    problem = ls.Problem(
        dynamics=plain, dt=0.1, steps=3, initial=ls.FixedState([0.0]), stage_cost=ls.ControlCost([1.0]),
        final_cost=ls.QuadraticCost([1.0], about=[1.0]),
    )  # fmt: skip
    with pytest.raises(ls.InputError, match="between_knots: got True with dynamics that are not a formula"):
        replace(problem, between_knots=True)
    with pytest.raises(ls.InputError, match="accuracy"):
        replace(problem, accuracy=0.0)
    with pytest.raises(ls.InputError, match="between_knots: got True without an interior point"):
        ls.smooth(replace(SWING, between_knots=True), stop="cost")
    with pytest.raises(ls.InputError, match="accuracy, between_knots"):
        ls.ilqr(replace(SWING, constraints=(), accuracy=1e-6))
