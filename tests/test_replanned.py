"""Output feedback that plans again: what its plans take for granted, how the estimates go on, bits, what fails."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from linear_plans import DT, Linear, double_integrator, linear

import lqrsim as ls
from lqrsim.disturbances import ForceNoise, MeanWind, MeasurementNoise, Uncertainty, Unknown
from lqrsim.errors import Array

PUSH = Unknown("d0", 0.5)
TOLERATE = {"m": 0.05, "m/s": 0.3, "rad": 0.2, "rad/s": 1.0}
STEPS, AGAIN = 30, 10


def rocking() -> Linear:
    """A double integrator with a plan that is no optimum."""
    return double_integrator(start=[1.0, 0.0], controls=np.cos(np.arange(STEPS) / 4)[:, None])


def stated(*unknowns: Unknown, lag: float = 0.0, latency: int = 0, delay: int = 0) -> Uncertainty:
    return Uncertainty(
        unknowns=unknowns, start=0.3, measurement=0.1, control=0.2, lag=lag, latency=latency, delay=delay
    )


def replanned(system: Linear, uncertainty: Uncertainty, every: float | None = AGAIN * DT) -> ls.OffsetFree:
    return ls.OffsetFree(
        system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0, record=True, replan_every=every,
        replan_always=every is not None,
    )  # fmt: skip


def run(system: Linear, law: ls.OffsetFree, *, push: float = 0.0, bias: float = 0.0) -> tuple[Array, Array, Any]:
    """What a trial is shown (T, n), with noise, its commands (T, m) and the law's run, of a linear system in NumPy."""
    rng, begun = np.random.default_rng(0), law.start(1)
    x, shown, commands = system.plan.states[0] + [0.2, -0.1], [], []
    for t in range(system.plan.steps):
        shown.append(x + 0.1 * rng.normal(size=len(x)))
        commands.append(begun.control(t, shown[-1][None])[0])
        x = system.A @ x + system.B @ (commands[-1] + bias) + push * system.E[:, 0]
    return np.array(shown), np.array(commands), begun


def optimal_controls(system: Linear, x: Array, push: float, steps: int) -> Array:
    """Minimises 1/2 sum u^2 + 1/2 |x_T|^2 for a constant push, by least squares."""
    onto, free = np.zeros((2, 0)), x
    for _ in range(steps):
        onto = np.concatenate([system.A @ onto, system.B], axis=1)
        free = system.A @ free + push * system.E[:, 0]
    stacked = np.concatenate([np.eye(steps), onto])
    return np.linalg.lstsq(stacked, np.concatenate([np.zeros(steps), -free]))[0]


def recorded(begun: Any) -> Array:
    return begun.estimates[:, 0]


# What a plan takes for granted.


def test_new_plans_are_optimal_for_what_is_estimated() -> None:
    """By least squares, to 1e-5; and each begins with what is commanded there, for there is nothing to correct."""
    system = rocking()
    law = replanned(system, stated(PUSH))
    _, commands, begun = run(system, law, push=0.4)
    assert (begun.log.solved, begun.log.kept) == (2, {})
    assert begun.summary() == "solved again 2 times"
    assert list(begun.plans[0]) == [AGAIN, 2 * AGAIN]
    for step, plan in begun.plans[0].items():
        z = recorded(begun)[step]
        assert abs(z[2]) > 0.1  # it matters
        wanted = optimal_controls(system, z[:2], z[2], STEPS - step)
        np.testing.assert_allclose(plan.controls[:, 0], wanted, rtol=0, atol=1e-5)
        np.testing.assert_allclose(commands[step], plan.controls[0], rtol=0, atol=1e-9)


def test_so_they_are_for_a_parameter_that_has_a_value() -> None:
    """The control pushes by a third more than it was planned with."""
    system = rocking()
    law = replanned(system, stated(Unknown("b10", 0.3)))
    _, commands, begun = run(replace(system, inputs=system.inputs * 4 / 3), law)
    assert (begun.log.solved, begun.log.kept) == (2, {})
    for step, plan in begun.plans[0].items():
        z = recorded(begun)[step]
        assert abs(z[2]) > 0.03  # it matters
        true = replace(system, inputs=system.inputs * (1 + z[2]))
        np.testing.assert_allclose(
            plan.controls[:, 0], optimal_controls(true, z[:2], 0.0, STEPS - step), rtol=0, atol=1e-5
        )
        np.testing.assert_allclose(commands[step], plan.controls[0], rtol=0, atol=1e-9)


def test_what_is_no_parameter_stays_with_the_law() -> None:
    """An offset of the control: the plan knows nothing of it, and the law takes it off the command, to 1e-5."""
    system = rocking()
    law = replanned(system, stated(Unknown("offset of u0", 0.5)))
    _, commands, begun = run(system, law, bias=0.4)
    assert begun.log.solved == 2
    for step, plan in begun.plans[0].items():
        z = recorded(begun)[step]
        assert abs(z[2]) > 0.1
        wanted = optimal_controls(system, z[:2], 0.0, STEPS - step)
        np.testing.assert_allclose(plan.controls[:, 0], wanted, rtol=0, atol=1e-5)
        np.testing.assert_allclose(commands[step], plan.controls[0] - z[2], rtol=0, atol=1e-5)


@pytest.mark.parametrize("lag", [0.0, 0.2])
def test_estimates_go_on(lag: float) -> None:
    """Of a linear system one filter does for all plans: its recursion in NumPy, over both solves, to 1e-6."""
    system = rocking()
    law = replanned(system, stated(PUSH, lag=lag))
    shown, commands, begun = run(system, law, push=0.4)
    assert begun.log.solved == 2
    left = np.exp(-DT / lag) if lag else 0.0
    mean = lag / DT * (1 - left)
    z = law.nominal[0].copy()
    for t in range(STEPS):
        z = z + law.filter.gain[t] @ (shown[t] - z[:2])
        np.testing.assert_allclose(recorded(begun)[t], z, rtol=0, atol=1e-6)
        reached = z[2:-1] if lag else commands[t]
        applied = commands[t] + mean * (reached - commands[t])
        after = commands[t] + left * (reached - commands[t])
        x = system.A @ z[:2] + system.B @ applied + system.E[:, 0] * z[-1]
        z = np.concatenate([x, after if lag else [], z[-1:]])


# A quadrotor in a steady wind.

WIND = MeanWind((3.0, 0.0, 0.0))


def flight(steps: int = 150) -> ls.Problem:
    """A metre to where it is to hover."""
    robot, weight = ls.Quadrotor(), np.repeat((50.0, 10.0, 1.0, 1.0), 3)
    return ls.Problem(
        # So that with and without a wind the same is compiled.
        dynamics=robot.dynamics.disturbed, dt=1 / 30, steps=steps, initial=ls.FixedState(np.eye(12)[0]),
        stage_cost=ls.QuadraticCost(weight, about=np.zeros(12))
        + ls.ControlCost(np.ones(4), about=np.full(4, robot.hover_force)),
        final_cost=ls.QuadraticCost(10 * weight, about=np.zeros(12)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def flown() -> tuple[ls.Solution, ls.OffsetFree]:
    """Its plan without a wind, and what flies it."""
    problem = flight()
    solution = ls.smooth(problem)
    assert solution.success
    return solution, flying(problem, solution, every=1.0)


def flying(problem: ls.Problem, solution: ls.Solution, every: float) -> ls.OffsetFree:
    measured = {"m": 5e-3, "m/s": 5e-2, "rad": 5e-3, "rad/s": 5e-3}
    unknowns = [Unknown(f"wind_{axis}", 1.5) for axis in "xyz"]
    uncertainty = Uncertainty(unknowns=unknowns, start=0.01, measurement=measured)
    return ls.OffsetFree(
        problem, solution, uncertainty, tolerate=TOLERATE, record=True, replan_every=every, replan_always=True
    )


def thrust(controls: Array, states: Array) -> npt.NDArray[np.float64]:
    """Of a plan, in the world's axes: (T, 3)."""
    turned = ls.rotations.quaternion(states[:-1, 6:9])
    w, x, y, z = turned.T
    upward = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    return controls.sum(axis=1)[:, None] * upward


def test_in_a_steady_wind_the_new_plan_leans_into_it(
    quadrotor: ls.Scenario, flown: tuple[ls.Solution, ls.OffsetFree]
) -> None:
    """Where its plan hovers, by atan(drag * wind / weight), within what the estimate is off."""
    solution, law = flown
    rollout = ls.simulate(quadrotor.plant(), controller=law, disturbances=[WIND], frames=False)
    begun = rollout.controller_run
    assert rollout.outcome == ("reached",)
    assert (begun.log.solved, begun.log.kept) == (4, {})
    assert list(begun.plans[0]) == [30, 60, 90, 120]
    robot, plan = ls.Quadrotor(), begun.plans[0][30]
    estimated = recorded(begun)[30, 12:]
    np.testing.assert_allclose(estimated, [3.0, 0.0, 0.0], rtol=0, atol=0.02)
    # It is a plan of the model with this wind: Newton's law, over each period, to second order.
    velocity = plan.states[:, 3:6]
    mean = (velocity[1:] + velocity[:-1]) / 2
    force = thrust(plan.controls, plan.states) - robot.drag * (mean - [3.0, 0.0, 0.0])
    force[:, 2] -= robot.mass * robot.gravity
    turning = np.abs(np.diff(plan.states[:, 6:9], axis=0)).max(axis=1)  # the thrust's direction changes on the way
    off = np.abs(robot.mass * np.diff(velocity, axis=0) * 30 - force).max(axis=1)
    assert (off < 0.01 + robot.mass * robot.gravity * turning).all()
    # Here it is as good as at rest, so that all that is left is what holds against weight and wind.
    middle = slice(80, 104)
    changes = robot.drag * np.abs(mean) + robot.mass * np.abs(np.diff(velocity, axis=0) * 30)
    assert changes[middle].max() < 0.003  # N
    weight, drag = robot.mass * robot.gravity, robot.drag * 3.0
    tilt, leans = np.arctan(drag / weight), thrust(plan.controls, plan.states)[middle]
    tolerance = 0.003 / weight + turning[middle].max() + 0.02 / 3.0 * tilt
    assert tolerance < 0.025 * tilt
    np.testing.assert_allclose(np.arctan2(-leans[:, 0], leans[:, 2]), tilt, rtol=0, atol=tolerance)
    np.testing.assert_allclose(np.linalg.norm(leans, axis=1), np.hypot(drag, weight), rtol=0, atol=0.005)
    # The first plan does not.
    first = thrust(solution.trajectory.controls, solution.trajectory.states)[30:][middle]
    assert np.abs(np.arctan2(-first[:, 0], first[:, 2])).max() < 0.05 * tilt


def test_each_trial_gets_what_it_gets_alone(quadrotor: ls.Scenario, flown: tuple[ls.Solution, ls.OffsetFree]) -> None:
    solution, _ = flown
    law = flying(flight(), solution, every=2.0)
    noise = [WIND, MeasurementNoise(0.003), ForceNoise(0.05)]
    plant = quadrotor.plant()
    together = ls.simulate(plant, solution, controller=law, disturbances=noise, trials=2, frames=False)
    assert together.controller_run.log.solved == 4
    plans, estimates = together.controller_run.plans, together.controller_run.estimates
    alone = ls.simulate(plant, solution, controller=law, disturbances=noise, first_trial=1, frames=False)
    begun = alone.controller_run
    assert begun.log.solved == 2
    np.testing.assert_array_equal(alone.states[0], together.states[1])
    np.testing.assert_array_equal(alone.commanded[0], together.commanded[1])
    np.testing.assert_array_equal(begun.plans[0][60].controls, plans[1][60].controls)
    np.testing.assert_array_equal(recorded(begun), estimates[:, 1])
    assert not np.array_equal(together.states[0], together.states[1])


def test_where_the_law_leads_to_the_goal_nothing_is_solved() -> None:
    """Without a push that is so at each look; with one the plan is left far behind, and a new one is made."""
    system = rocking()
    for push, some in ((0.0, False), (4.0, True)):
        law = ls.OffsetFree(
            replace(system.problem, final_cost=ls.QuadraticCost(np.eye(2), about=system.plan.states[-1])),
            replace(system.solution, goal=system.plan.states[-1], goal_radius=0.5), stated(PUSH), tolerate=2.0,
            effort=0.2, record=True, replan_every=AGAIN * DT,
        )  # fmt: skip
        _, _, begun = run(system, law, push=push)
        assert (begun.log.solved > 0) == some


# What fails, and what does not fit.


@pytest.mark.long
def test_where_no_solve_succeeds_the_law_goes_on() -> None:
    """Within an obstacle whose cost is beyond numbers: bit by bit the law that never solves again."""
    ball = ls.World([ls.Obstacle("ball", "sphere", np.zeros(3), np.eye(3), np.array([1.0, 0.0, 0.0]))])
    system = linear(
        np.zeros((2, 2)), np.eye(2), np.eye(2), controls=np.zeros((STEPS, 2)), start=[2.0, 0.0], position=("s0", "s1"),
        costs=(ls.ObstacleCost(ball, radius=0.1, sharpness=1e4, weight=1.0),),
    )  # fmt: skip
    commands: list[list[Array]] = []
    for every in (AGAIN * DT, None):
        law = replanned(system, stated(PUSH), every)
        begun: Any = law.start(1)
        rng = np.random.default_rng(0)
        shown = np.array([[0.5, 0.0]]) + 0.01 * rng.normal(size=(STEPS + 5, 1, 2))
        commands.append([begun.control(t, shown[t]) for t in range(STEPS + 5)])
        if every:
            assert begun.plans == [{}]
            assert begun.log.solved == 0
            assert begun.log.kept.total() == 2
            assert set(begun.log.kept) == {"NOT_FINITE, without a better plan"}
            assert begun.summary().startswith("solved again 0 times, kept the previous law 2 times: 2 times NOT_FIN")
        else:
            assert begun.summary() == ""
    np.testing.assert_array_equal(commands[0], commands[1])


@pytest.mark.parametrize(
    ("options", "every", "says"),
    [
        ({"latency": 2}, 1.0, "replan_every: got 1 with a latency of 2 and a delay of 0 periods, want None, or"),
        ({"delay": 1}, 1.0, "replan_every: got 1 with a latency of 0 and a delay of 1 periods, want None, or"),
        ({}, 0.05, "OffsetFree: replan_every: got 0.05 s, want at least a control period, 0.1 s"),
        ({}, "often", "OffsetFree: replan_every: got 'often', want"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_line(options: dict, every: float, says: str) -> None:
    with pytest.raises(ls.InputError) as caught:
        replanned(rocking(), stated(PUSH, **options), every)
    assert says in str(caught.value)


def test_a_plan_of_another_horizon_is_refused() -> None:
    system = rocking()
    shorter = replace(system, problem=replace(system.problem, steps=20))
    with pytest.raises(ls.InputError, match=r"OffsetFree: solution: got 30 steps of 0\.1 s, want the problem's: 20"):
        replanned(shorter, stated(PUSH))
    assert replanned(shorter, stated(PUSH), None).gain.shape[0] == 30


def test_what_is_of_one_plan_is_refused_and_the_digest_is_another() -> None:
    system, uncertainty = rocking(), stated(PUSH)
    law = replanned(system, uncertainty)
    with pytest.raises(ls.InputError, match="OffsetFree: policy: got a law with replan_every=1, want one without"):
        _ = law.policy
    with pytest.raises(ls.InputError, match="OffsetFree: loop: got a law with replan_every=1, want one without"):
        ls.predict_tube(system.problem, system.solution, uncertainty, law)
    assert len({replanned(system, uncertainty, every).digest for every in (None, 0.5, 1.0)}) == 3
