"""Costs and limits of the rates of controls, against problems in which they are written out."""

import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_plans import DT, Linear, linear
from mechanisms import arm
from sampling import examples, rarely
from scipy.optimize import minimize

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.solvers.control_rates import bounding_cost, feedback

SIZES = [(2, 1), (2, 2)]  # states and controls


def drawn(rng: np.random.Generator, n: int, m: int, steps: int = 8) -> Linear:
    rates, start = rng.normal(size=(n, n)), 2 * rng.normal(size=n)
    controls = np.zeros((steps, m))
    return linear(rates, 2 * rng.normal(size=(n, m)), np.zeros((n, 1)), start=start, controls=controls)


def standing() -> Linear:
    """A pendulum that stands on its pivot, linearised, pushed by one control."""
    return linear(
        [[0.0, 1.0], [9.81, 0.0]], [[0.0], [1.0]], np.zeros((2, 1)), start=[0.1, 0.0], controls=np.zeros((60, 1))
    )


def quadratic_program(problem: ls.Problem, one: Linear) -> tuple[Array, Array, float]:
    """Hessian, gradient and constant of the cost of the controls, in a row; the weights of a `linear` problem are 1."""
    steps, m = one.plan.controls.shape
    reached, rate = np.linalg.matrix_power(one.A, steps) @ one.plan.states[0], problem.control_rate
    assert rate is not None
    moves = np.hstack([np.linalg.matrix_power(one.A, steps - 1 - t) @ one.B for t in range(steps)])
    weight = np.tile(np.zeros(m) if rate.weight is None else np.asarray(rate.weight), (steps, 1))
    zero, units = rates_of(problem, np.zeros((steps, m))), np.eye(steps * m).reshape(-1, steps, m)
    slopes = np.array([(rates_of(problem, unit) - zero).ravel() for unit in units]).T
    weights = weight[steps - len(zero) :].ravel()
    hessian = np.eye(steps * m) + moves.T @ moves + slopes.T @ (weights[:, None] * slopes)
    gradient = moves.T @ reached + slopes.T @ (weights * zero.ravel())
    return hessian, gradient, 0.5 * float(reached @ reached + weights @ zero.ravel() ** 2)


def rates_of(problem: ls.Problem, controls: Array) -> Array:
    assert problem.control_rate is not None
    last = problem.control_rate.previous
    return np.diff(controls if last is None else np.vstack([np.asarray(last), controls]), axis=0) / problem.dt


@given(
    size=st.sampled_from(SIZES), seed=st.integers(0, 1000), weighed=st.booleans(), limited=st.booleans(),
    known=st.booleans(),
)  # fmt: skip
@settings(max_examples=examples(24))
def test_a_plan_is_that_of_the_quadratic_program(
    size: tuple[int, int], seed: int, weighed: bool, limited: bool, known: bool
) -> None:
    """SciPy's SLSQP finds the controls to some 1e-5; costs then agree to the square of that."""
    (n, m), rng = size, np.random.default_rng(seed)
    one = drawn(rng, n, m)
    weight, high = rng.uniform(0.001, 0.1, size=m), rng.uniform(0.5, 4.0, size=m)
    low = -rng.uniform(0.5, 4.0, size=m)
    rate = ls.ControlRate(
        weight=weight if weighed or not limited else None, limits=(low, high) if limited else None,
        previous=rng.normal(size=m) if known else None,
    )  # fmt: skip
    problem = replace(one.problem, control_rate=rate)
    solution = ls.smooth(problem)
    assert solution.success
    shape, (H, g, constant) = one.plan.controls.shape, quadratic_program(problem, one)
    kept: list[Any] = []
    if limited:
        kept = [
            {"type": "ineq", "fun": lambda u: (rates_of(problem, u.reshape(shape)) - low).ravel()},
            {"type": "ineq", "fun": lambda u: (high - rates_of(problem, u.reshape(shape))).ravel()},
        ]

    def cost(u: Array) -> float:
        return 0.5 * float(u @ H @ u) + float(g @ u) + constant

    found = minimize(
        cost, -np.linalg.solve(H, g), jac=lambda u: H @ u + g, method="SLSQP", constraints=kept,
        options={"ftol": 1e-14, "maxiter": 500},
    )  # fmt: skip
    controls = solution.trajectory.controls
    assert solution.cost == pytest.approx(cost(controls.ravel()), rel=1e-9, abs=1e-12)
    assert solution.cost == pytest.approx(found.fun, rel=1e-7, abs=1e-9)
    np.testing.assert_allclose(controls, found.x.reshape(shape), atol=2e-4)
    if limited:
        rates = rates_of(problem, controls)
        assert (rates >= low).all()
        assert (rates <= high).all()


def swinging(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import sin

    return [x.speed, 2 * u.torque - 9.81 * sin(x.angle)]


def pendulum(**parts: Any) -> ls.Problem:
    dynamics = ls.Dynamics(
        swinging, states={"angle": "rad", "speed": "rad/s"}, controls={"torque": "N m"}, angles=("angle",)
    )
    return ls.Problem(
        dynamics=dynamics, dt=0.05, steps=20, initial=ls.FixedState([0.0, 0.0]), stage_cost=ls.ControlCost([0.05]),
        final_cost=ls.QuadraticCost([20.0, 1.0], about=[1.5, 0.0]), **parts,
    )  # fmt: skip


SOLUTIONS: dict[str, ls.Solution] = {}  # by the problem's hash, for problems that several tests solve
SOLVERS: dict[str, ls.types.PreparedSolver] = {}


def solved(problem: ls.Problem) -> ls.Solution:
    if problem.digest not in SOLUTIONS:
        SOLUTIONS[problem.digest] = ls.smooth(problem)
    return SOLUTIONS[problem.digest]


def prepared(problem: ls.Problem) -> ls.types.PreparedSolver:
    if problem.digest not in SOLVERS:
        SOLVERS[problem.digest] = ls.prepare(problem)
    return SOLVERS[problem.digest]


def swinging_plainly(x: Array, u: Array) -> list[float]:
    return [x[1], 2 * u[0] - 9.81 * np.sin(x[0])]


def step(x: Array, u: float, dt: float) -> Array:
    """One Runge-Kutta step of the pendulum."""

    def rate(x: Array) -> Array:
        return np.array(swinging_plainly(x, np.array([u])))

    a = rate(x)
    b = rate(x + dt / 2 * a)
    c = rate(x + dt / 2 * b)
    d = rate(x + dt * c)
    return x + dt / 6 * (a + 2 * b + 2 * c + d)


@pytest.mark.parametrize("solver", [ls.smooth, ls.ilqr])
def test_a_nonlinear_plan_is_that_of_single_shooting(solver: Any) -> None:
    """BFGS with differences finds the cost to some 1e-9, and so do both solvers with their own tolerances."""
    problem = pendulum(control_rate=ls.ControlRate(weight=0.002, previous=0.3))

    def cost(u: Array) -> float:
        x, total = np.zeros(2), 0.0
        for now, last in zip(u, [0.3, *u[:-1]], strict=True):
            total += 0.5 * 0.05 * now**2 + 0.5 * 0.002 * ((now - last) / 0.05) ** 2
            x = step(x, now, 0.05)
        return total + 0.5 * (20 * (x[0] - 1.5) ** 2 + x[1] ** 2)

    found = minimize(cost, np.zeros(20), method="BFGS", options={"gtol": 1e-7})
    solution = solver(problem, tolerance=1e-10)
    assert solution.success
    assert solution.cost == pytest.approx(found.fun, rel=1e-7)
    np.testing.assert_allclose(solution.trajectory.controls[:, 0], found.x, atol=1e-3)
    many = ls.smooth_many([problem, problem], tolerance=1e-10)
    assert solver is ls.ilqr or [one.cost for one in many] == [solution.cost] * 2


@pytest.mark.parametrize("level", ["symbolic", *rarely("plain")])
def test_balls_at_places_that_depend_on_parameters_keep_clear(level: str) -> None:
    """The end of a pendulum stops at a post, at the distance that its angle and its length say."""

    def end(x: Any, p: Any) -> list[list[Any]]:
        from sympy import cos, sin

        wide, high = (sin, cos) if level == "symbolic" else (np.sin, np.cos)
        return [[p.length * wide(x[0]), 0, -p.length * high(x[0])]]

    def rate(x: Any, u: Any, p: Any) -> list[Any]:
        from sympy import sin

        return [x.speed, (u.torque - sin(x.angle)) / p.length]

    dynamics = ls.Dynamics(
        rate, states={"angle": "rad", "speed": "rad/s"}, controls={"torque": "N m"}, parameters={"length": 0.5}
    )
    post = ls.Obstacle("post", "sphere", np.array([0.55, 0.0, 0.0]), np.eye(3), np.array([0.1, 0.0, 0.0]))
    balls = ls.CollisionSpheres(end, [0.05], level=level)
    clear = ls.Clearance(ls.World([post]), balls=balls)
    final = ls.QuadraticCost([100.0, 1.0], about=[1.55, 0.0])
    rates = ls.ControlRate(weight=1e-3)
    problem = replace(pendulum(), dynamics=dynamics, constraints=[clear], final_cost=final, control_rate=rates)
    solution = ls.smooth(problem)
    assert solution.success
    ends = 0.5 * np.stack([np.sin(solution.trajectory.states[:, 0]), -np.cos(solution.trajectory.states[:, 0])], axis=1)
    distances = np.linalg.norm(ends - [0.55, 0.0], axis=1) - 0.15
    assert solution.clearance is not None
    np.testing.assert_allclose(solution.clearance, distances, atol=1e-12)
    assert 0 <= distances.min() < 1e-5


class TestPolicies:
    def test_the_policy_is_that_of_separate_charges_for_each_change(self) -> None:
        one = standing()
        problem = replace(one.problem, control_rate=ls.ControlRate(weight=0.02, previous=0.0))
        solution, charge = ls.smooth(problem), 0.02 / DT**2
        S, gains = np.eye(2), []
        for t in range(problem.steps - 1, -1, -1):
            charged = 1.0 + charge * ((1 if t == 0 else 2) + (2 if t < problem.steps - 1 else 0))
            gains.append(-np.linalg.solve(charged * np.eye(1) + one.B.T @ S @ one.B, one.B.T @ S @ one.A))
            S = one.A.T @ S @ one.A + one.A.T @ S @ one.B @ gains[-1]
        np.testing.assert_allclose(solution.policy.gain, gains[::-1], rtol=1e-8)
        assert solution.cost_to_go is not None
        np.testing.assert_allclose(solution.cost_to_go.hessian[0], S, rtol=1e-8)
        states, controls = solution.trajectory.states, solution.trajectory.controls
        for t in range(problem.steps):
            np.testing.assert_allclose(solution.policy.control(states[t], t), controls[t], atol=1e-9)

    @given(seed=st.integers(0, 1000), known=st.booleans())
    @settings(max_examples=examples(40))
    def test_the_charges_bound_the_cost_of_rates_and_touch_it_at_the_plan(self, seed: int, known: bool) -> None:
        rng = np.random.default_rng(seed)
        rate = ls.ControlRate(weight=rng.uniform(0, 1, size=2), previous=rng.normal(size=2) if known else None)
        problem = replace(drawn(rng, 1, 2).problem, control_rate=rate)
        plan, moved = rng.normal(size=(2, problem.steps, 2))

        def charged(controls: Array) -> float:
            off = controls - bound.about
            return 0.5 * float(np.einsum("ti,tij,tj", off, bound.weight, off))

        def paid(controls: Array) -> float:
            return 0.5 * float((np.asarray(rate.weight) * rates_of(problem, controls) ** 2).sum())

        bound = bounding_cost(problem, plan)
        h = 1e-5  # at the plan, differences of quadratics are exact to rounding
        slopes = [(one(plan + h * moved) - one(plan - h * moved)) / (2 * h) for one in (charged, paid)]
        assert slopes[0] == pytest.approx(slopes[1], rel=1e-5, abs=1e-4)
        above = charged(plan + moved) - charged(plan) - (paid(plan + moved) - paid(plan))
        assert above >= -1e-9 * paid(plan + moved)

    def test_what_the_policy_costs_in_closed_loop(self) -> None:
        """Expected costs of deviations under pushes, by their covariance: with the best gains, on the state and the
        last command; with those without their part on the last command; and with the policy of the solution.
        """
        one, weight = standing(), 0.2
        problem = replace(one.problem, control_rate=ls.ControlRate(weight=weight, previous=0.0))
        charge, T = weight / DT**2, problem.steps
        A, B = np.zeros((3, 3)), np.vstack([one.B, [[1.0]]])
        A[:2, :2] = one.A
        # The stage cost of (x, z, u) with charge (u - z)^2, and a Riccati recursion.
        Q, cross, R = np.diag([0.0, 0.0, charge]), np.array([[0.0, 0.0, -charge]]), np.array([[1.0 + charge]])
        S, best = np.diag([1.0, 1.0, 0.0]), np.zeros((T, 1, 3))
        for t in range(T - 1, -1, -1):
            H, G = R + B.T @ S @ B, cross + B.T @ S @ A
            best[t] = -np.linalg.solve(H, G)
            S = Q + A.T @ S @ A + G.T @ best[t]

        def expected(gains: Array) -> float:
            cov, total, push = np.zeros((3, 3)), 0.0, np.diag([0.0, 1e-2, 0.0])
            for gain in gains:
                whole = Q + gain.T @ cross + cross.T @ gain + gain.T @ R @ gain
                total += 0.5 * float(np.trace(whole @ cov))
                cov = (A + B @ gain) @ cov @ (A + B @ gain).T + push
            return total + 0.5 * float(np.trace(np.diag([1.0, 1.0, 0.0]) @ cov))

        own = np.pad(ls.smooth(problem).policy.gain, [(0, 0), (0, 0), (0, 1)])
        dropped = best * [1.0, 1.0, 0.0]
        least = expected(best)
        assert least < expected(own) < 4 * least
        assert expected(dropped) > 1000 * least  # the pendulum falls
        remembering = ls.lq.rate_feedback(problem, ls.smooth(problem))
        best[0, :, 2] = 0.0  # the first last command does not deviate
        np.testing.assert_allclose(remembering.gain, best, rtol=1e-8, atol=1e-12)


class TestReplans:
    @given(seed=st.integers(0, 1000))
    @settings(max_examples=examples(12))
    def test_a_replan_goes_on_from_the_last_command(self, seed: int) -> None:
        problem = pendulum(control_rate=ls.ControlRate(weight=1e-4, limits=4.0))
        before, rng = solved(problem), np.random.default_rng(seed)
        state = before.trajectory.states[3] + 0.05 * rng.normal(size=2)
        last = before.trajectory.controls[2] + 0.1 * rng.normal(size=1)
        start = before.shifted(3, horizon="shrinking")
        again = prepared(problem).solve(state, start, after=3, previous=last)
        assert again.success
        controls = np.vstack([last, again.trajectory.controls])
        assert np.abs(np.diff(controls, axis=0)).max() <= 4.0 * 0.05
        fresh = ls.smooth(problem.from_state(state, after=3, previous=last))
        assert again.cost == pytest.approx(fresh.cost, rel=1e-5)

    @pytest.mark.parametrize("options", [{"deadline": 0.0}, {}, {"horizon": "moving"}, {"predict": False}])
    def test_commands_never_jump_more_than_the_limit(self, options: dict[str, Any]) -> None:
        problem = pendulum(control_rate=ls.ControlRate(weight=1e-4, limits=4.0))
        run = ls.Replanner(problem, solved(problem), every=0.1, **options).start(2)
        rng, x, commands = np.random.default_rng(3), np.zeros((2, 2)), []
        for t in range(16):
            commands.append(run.control(t, x + 0.03 * rng.normal(size=x.shape)))
            x = np.array([step(one, float(u[0]), 0.05) for one, u in zip(x, commands[-1], strict=True)])
        assert np.abs(np.diff(commands, axis=0)).max() <= 4.0 * 0.05 + 1e-12
        assert run.log.solved >= 10

    def test_other_numbers_of_rates_need_no_compiling(self) -> None:
        problem = pendulum(control_rate=ls.ControlRate(weight=1e-4, limits=4.0))
        solver, start, state = prepared(problem), solved(problem), np.zeros(2)
        tight = replace(problem, control_rate=ls.ControlRate(weight=2e-4, limits=3.0))
        found = solver.solve(state, start, problem=tight)
        assert found.cost == pytest.approx(ls.smooth(tight).cost, rel=1e-5)
        for rate in (None, ls.ControlRate(weight=1e-4)):
            with pytest.raises(ls.InputError, match="another structure"):
                solver.check(replace(problem, control_rate=rate))
        with pytest.raises(ls.InputError, match="another structure"):
            ls.prepare(pendulum()).check(problem)

    def test_a_live_replanner_keeps_the_limit_too(self) -> None:
        problem = pendulum(control_rate=ls.ControlRate(limits=4.0))
        with ls.Replanner(problem, solved(problem), every=0.1).live(clock=lambda: 0.0) as live:
            first = live.step([0.0, 0.0], 0.0)
            assert np.abs(live.step([0.5, 2.0], 0.05) - first).max() <= 4.0 * 0.05 + 1e-12


ARM = arm(
    0.3, names=["elbow"], end='<site name="tip" pos="0.3 0 0"/>', geom='size="0.02" mass="0.5"',
    actuators='<position name="servo" joint="elbow" kp="40" forcerange="-6 6" ctrlrange="-3 3"/>',
    things='<geom name="post" type="sphere" size="0.05" pos="0.45 0 -0.2"/>',
)  # fmt: skip


def test_an_arm_from_an_mjcf(tmp_path: Path) -> None:
    """With limits of forces, obstacles and a site, whose terms MuJoCo computes; carried out by MuJoCo."""
    (tmp_path / "arm.xml").write_text(ARM, encoding="utf-8")
    robot = ls.MjcfRobot(tmp_path / "arm.xml")
    start = robot.at(elbow=-0.4)
    rate = ls.ControlRate(weight=1e-3, limits={"servo": 2.0}, previous=robot.hold(start))
    problem = robot.problem(start, robot.at(elbow=-1.4), steps=40, dt=0.02, clearance=0.05, control_rate=rate)
    kinds = {type(one).__name__ for one in problem.constraints}
    assert kinds == {"Clearance", "ForceLimits"}
    tip = ls.SiteCost("tip", position=(0.05, 0.0, 0.29), weight=100.0)
    problem = problem.with_costs(final_cost=problem.final_cost + tip)
    solution = ls.smooth(problem)
    assert solution.success
    assert solution.clearance is not None
    assert solution.clearance.min() >= 0.05
    rates = rates_of(problem, solution.trajectory.controls)
    assert 1.9 < np.abs(rates).max() <= 2.0  # the limit holds back
    rollout = ls.simulate(ls.Plant(robot, robot.scene), solution)
    np.testing.assert_allclose(rollout.states[0, -1], solution.trajectory.states[-1], atol=1e-4)
    assert all((worst == 0).all() for worst in problem.violations(rollout).values())
    noise = [ls.disturbances.MeasurementNoise(0.2)]
    shaken = ls.simulate(ls.Plant(robot, robot.scene), solution, disturbances=noise, seed=1)
    found = problem.violations(shaken)
    beyond = np.abs(rates_of(problem, shaken.commanded[0])).max() - 2.0
    assert max(found[f"ControlRate: servo {side}"][0, 0] for side in ("low", "high")) == pytest.approx(beyond)
    assert beyond > 0  # feedback adds to the rates of the plan
    remembering = ls.lq.rate_feedback(problem, solution)
    followed = ls.simulate(ls.Plant(robot, robot.scene), solution, controller=remembering)
    np.testing.assert_allclose(followed.commanded[0], solution.trajectory.controls, atol=1e-4)
    again = ls.prepare(problem).solve(start, solution, previous=robot.hold(start))
    assert np.abs(rates_of(problem, again.trajectory.controls)).max() <= 2.0


class TestProblems:
    def test_limits_that_leave_no_plan_are_named(self) -> None:
        tight = ls.ControlRate(limits={"torque": 0.5}, previous=0.0)
        solution = ls.smooth(pendulum(control_rate=tight, constraints=[ls.GoalState(angle=1.5)]))
        assert solution.status is ls.Status.INFEASIBLE
        assert "a rate of torque of at most 0.5 N m/s" in solution.detail

    def test_a_plan_that_is_not_finite_has_no_feedback(self) -> None:
        problem = pendulum(control_rate=ls.ControlRate(weight=0.002))
        solution = solved(problem)
        lost = ls.Trajectory(np.full((21, 3), np.nan), np.full((20, 1), np.nan), problem.dt)
        policy, cost_to_go = feedback(problem, lost)
        assert cost_to_go is None
        assert not policy.gain.any()
        failed = replace(solution, status=ls.Status.NOT_FINITE, trajectory=replace(lost, states=lost.states[:, :2]))
        with pytest.raises(ls.InputError, match="without feedback"):
            ls.lq.rate_feedback(problem, failed)

    def test_limits_of_rates_may_have_a_price(self) -> None:
        """The cost of a plan that pays to exceed them is below that of one that keeps them, and the detail says so."""
        rate = ls.ControlRate(limits={"torque": 0.5}, previous=0.0)
        problem = pendulum(control_rate=rate)
        cheap, kept = ls.smooth(problem, elastic=1e-3), solved(problem)
        assert cheap.success
        assert cheap.cost < kept.cost
        assert np.abs(rates_of(problem, cheap.trajectory.controls)).max() > 0.5
        assert "a rate of torque" in cheap.detail

    def test_what_is_stated_is_said_kept_and_told_apart(self, tmp_path: Path) -> None:
        rate = ls.ControlRate(weight={"N m": 0.002}, limits={"torque": (-3.0, 4.0)})
        problem = pendulum(control_rate=rate)
        assert "control rate:  ControlRate(weight=[0.002], limits=([-3], [4]))" in str(problem)
        others = [None, replace(rate, weight=0.003), replace(rate, limits=4.0), replace(rate, previous=0.0)]
        assert len({problem.digest, *(pendulum(control_rate=one).digest for one in others)}) == 5
        assert pickle.loads(pickle.dumps(problem)).digest == problem.digest
        solution = solved(problem)
        assert solution.problem_digest == problem.digest
        ls.save(solution, tmp_path / "solution.npz")
        kept = ls.load(tmp_path / "solution.npz", kind=ls.Solution)
        np.testing.assert_array_equal(kept.policy.gain, solution.policy.gain)
        assert kept.policy.gain.shape == (20, 1, 2)
        assert len(ls.smooth(problem, start=kept).iterations) <= len(solution.iterations)

    @pytest.mark.parametrize(
        "start", [[0.1], ls.InitialPrior([1.0, 1.0], about=[1.0, 0.0]), lambda problem: problem.nominal_control]
    )
    def test_starts_are_those_of_the_problem(self, start: Any) -> None:
        problem = pendulum(control_rate=ls.ControlRate(weight=0.002, limits=5.0))
        assert ls.smooth(problem, start=start).cost == pytest.approx(solved(problem).cost, rel=1e-7)
        for given_one in (solved(problem).trajectory, solved(problem).policy):
            assert ls.smooth(problem, start=given_one).cost == pytest.approx(solved(problem).cost, rel=1e-7)

    def test_a_soft_start(self) -> None:
        """Weights on the start add a cost that vanishes as they grow: relative to 1e8, by some 1e-7."""
        rate = ls.ControlRate(weight=0.002, limits=5.0, previous=0.1)
        soft = ls.QuadraticCost([1e8, 1e8], about=[0.0, 0.0])
        found = ls.smooth(replace(pendulum(control_rate=rate), initial=soft))
        assert found.success
        assert found.cost == pytest.approx(solved(pendulum(control_rate=rate)).cost, rel=1e-5)

    @pytest.mark.parametrize(
        ("stated", "message"),
        [
            ({}, "neither a weight nor limits"),
            ({"weight": -1.0}, "want numbers >= 0"),
            ({"limits": (1.0, 2.0)}, "want a range with 0 inside"),
            ({"limits": -1.0}, "want a range with 0 inside"),
            ({"weight": [1.0, 2.0]}, "got 2 numbers, want 1"),
            ({"limits": {"torque": ([-1.0, -2.0], 1.0)}}, "want one range for a control"),
            ({"weight": {"force": 1.0}}, "'force'"),
            ({"limits": 1.0, "previous": np.nan}, "want finite numbers"),
        ],
    )
    def test_rates_that_do_not_fit(self, stated: dict[str, Any], message: str) -> None:
        with pytest.raises(ls.InputError, match=message):
            pendulum(control_rate=ls.ControlRate(**stated))

    @pytest.mark.parametrize("rates", [None, ls.ControlRate(weight=0.1), ls.ControlRate(limits=9.0)])
    @pytest.mark.parametrize("states", [1, 2, 3])
    @pytest.mark.parametrize("steps", [19, 20, 21])
    def test_starts_of_other_shapes_are_refused_as_those_of_the_problem(
        self, rates: ls.ControlRate | None, states: int, steps: int
    ) -> None:
        """The last command is no state that a caller could give."""
        if (states, steps) == (2, 20):
            return
        problem = pendulum(control_rate=rates)
        plan = ls.Trajectory(np.zeros((steps + 1, states)), np.zeros((steps, 1)), problem.dt)
        starts: list[tuple[Any, str]] = [(plan, f"states: got shape ({steps + 1}, {states}), want (21, 2)")]
        if states != 2:
            prior = ls.InitialPrior(np.ones(states), about=np.zeros(states))
            starts.append((prior, f"got shape ({states},), want (2,)"))
        else:
            other = solved(replace(pendulum(), steps=steps))
            starts += [(start, f"gain: got shape ({steps}, 1, 2), want (20, 1, 2)") for start in (other, other.policy)]
        for start, said in starts:
            with pytest.raises(ls.InputError, match=re.escape(said)):
                ls.smooth(problem, start=start)

    def test_what_rates_do_not_go_with(self) -> None:
        rate = ls.ControlRate(weight=1.0, limits=1.0)
        for parts in ({"noise": ls.Noise(np.eye(2))}, {"duration": (0.5, 2.0)}):
            with pytest.raises(ls.InputError, match=r"control_rate: got ControlRate.* with "):
                pendulum(control_rate=rate, **parts)
        problem = pendulum(control_rate=rate)
        with pytest.raises(ls.InputError, match="form: got 'primal' with control_rate"):
            ls.smooth(replace(problem, initial=ls.QuadraticCost([1.0, 1.0], about=[0.0, 0.0])), form="primal")
        with pytest.raises(ls.InputError, match="want none for ilqr"):
            ls.ilqr(problem)
        with pytest.raises(ls.InputError, match="control_rate: got a FunctionCost"):
            ls.smooth(problem.with_costs(stage_cost=problem.stage_cost + ls.FunctionCost(lambda x, u, p: x[0] ** 2)))
        with pytest.raises(ls.InputError, match="for a problem without control_rate"):
            pendulum().from_state([0.0, 0.0], previous=[0.0])
