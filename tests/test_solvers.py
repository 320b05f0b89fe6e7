"""smooth() and ilqr() on the two systems: numbers known from elsewhere, costs recomputed here, honest endings."""

import dataclasses
import re
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import systems
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples, rarely
from scipy.optimize import minimize

import lqrsim as ls
from lqrsim.codegen import compiled_module
from lqrsim.errors import Array
from lqrsim.results.goal import TOLERANCE
from lqrsim.results.solution_parts import Status
from lqrsim.scenarios.packaged import quadrotor_queries
from lqrsim.solvers import budget, smoother
from lqrsim.solvers.settings import SmootherSettings

PILLARS = [
    (0, -1.35), (1, -0.5), (-0.95, -0.5), (-0.2, 0.3), (0.8, 0.7), (1.1, 2.0), (-1.2, 0.8), (-1.1, 2.1), (-0.1, 1.6),
    (-1.1, -1.9), (1.1414, -1.6414),
]  # fmt: skip


def drive_cost(states: Array, controls: Array) -> float:
    """The cost of Sec. VI-A with the authors' weights, written out in NumPy."""
    cost = 30 * np.sum((controls - 0.25) ** 2)
    for x, about in ((states[0], (0, -2.5, np.pi)), (states[-1], (0, 2.5, np.pi))):
        cost += 0.5 * np.sum(np.array([5000, 5000, 50]) * (x - about) ** 2)
    return cost + np.sum(np.exp(-10 * drive_clearances(states[1:-1])))


def drive_clearances(states: Array) -> Array:
    """Distances to each pillar and wall less the robot's radius."""
    x, y = states[:, 0], states[:, 1]
    pillars = [np.hypot(x - px, y - py) - 0.2 for px, py in PILLARS]
    return np.array([*pillars, x + 2, 2 - x, y + 3, 3 - y]) - 0.17


def quadrotor_cost(states: Array, controls: Array, start: Array, goal: Array) -> float:
    """The cost of Sec. VI-B, written out in NumPy."""
    cost = 10 * np.sum((controls - 0.5 * 9.8 / 4) ** 2)
    cost += 250 * np.sum((states[0] - start) ** 2) + 250 * np.sum((states[-1] - goal) ** 2)
    position = states[1:-1, :3]
    for axis in range(3):
        across = np.delete(position, axis, axis=1)
        for a in (-1.25, 1.25):
            for b in (-1.25, 1.25):
                distance = np.hypot(across[:, 0] - a, across[:, 1] - b) - 0.4 - 0.3
                cost += np.sum(np.exp(-10 * distance))
        for side in (-1, 1):
            cost += np.sum(np.exp(-10 * (3 - side * position[:, axis] - 0.3)))
    return cost


def drive_rollout(start: Array, controls: Array) -> Array:
    """The exact motion of the differential drive at held wheel speeds: arcs of circles."""
    states = [np.asarray(start, dtype=float)]
    for left, right in controls:
        x, y, heading = states[-1]
        speed, turn = (left + right) / 2, (right - left) / 0.258
        half = turn / 12
        length = speed / 6 * np.sinc(half / np.pi)
        states.append(
            np.array([x + length * np.cos(heading + half), y + length * np.sin(heading + half), heading + 2 * half])
        )
    return np.array(states)


@pytest.mark.parametrize("form", ["dual", "primal"])
@pytest.mark.parametrize(("controls", "cost", "iterations"), [(None, 30.14, 4), ((0.0, 0.0), 54.98, 11)])
def test_the_differential_drive_reproduces_the_known_costs(
    differential_drive: ls.Scenario, form: str, controls: tuple[float, float] | None, cost: float, iterations: int
) -> None:
    """0.5 %: costs found by an independent implementation at the paper's stop test."""
    prior = differential_drive.paper_start
    assert prior is not None
    start = ls.InitialPrior(prior.weight, about=prior.about, iterations=prior.iterations, controls=controls)
    # As in the paper, where controls have no limits.
    problem = dataclasses.replace(differential_drive.problem, control_limits=(-np.inf, np.inf))
    solution = ls.smooth(problem, form=form, stop="cost", start=start)
    assert solution.status is Status.COST_CONVERGED
    assert solution.cost == pytest.approx(cost, rel=5e-3)
    assert len(solution.iterations) == iterations
    clearance = drive_clearances(solution.trajectory.states)
    assert clearance.min() > 0
    assert solution.clearance is not None
    np.testing.assert_allclose(solution.clearance, clearance.min(axis=0), rtol=0, atol=1e-12)


def test_the_reported_cost_is_the_true_cost_of_the_plan(
    drive_solution: ls.Solution, quadrotor: ls.Scenario, quadrotor_solution: ls.Solution
) -> None:
    """Recomputed here to rounding, 1e-10; for the drive also on the exact motion, which RK4 is 1e-6 from in 25 s."""
    plan = drive_solution.trajectory
    assert drive_solution.cost == pytest.approx(drive_cost(plan.states, plan.controls), rel=1e-10)
    exact = drive_rollout(plan.states[0], plan.controls)
    np.testing.assert_allclose(plan.states, exact, rtol=0, atol=1e-4)
    plan = quadrotor_solution.trajectory
    start, goal = (ends[0] for ends in quadrotor_queries(1))
    assert quadrotor_solution.cost == pytest.approx(quadrotor_cost(plan.states, plan.controls, start, goal), rel=1e-10)


@pytest.mark.parametrize("solver", [ls.smooth, *rarely(ls.ilqr)])
def test_converged_means_locally_optimal(differential_drive: ls.Scenario, solver) -> None:
    """SciPy's L-BFGS, on the exact motion and the cost written here, cannot improve a CONVERGED plan by 0.1 %."""
    solution = solver(differential_drive.problem)
    assert solution.status is Status.CONVERGED
    assert solution.optimality < 1e-4
    plan = solution.trajectory
    soft = solution.solver == "smooth"

    def cost(z: Array) -> float:
        start, controls = (z[:3], z[3:]) if soft else (plan.states[0], z)
        controls = controls.reshape(-1, 2)
        return drive_cost(drive_rollout(start, controls), controls)

    z = np.concatenate([plan.states[0] if soft else [], plan.controls.ravel()])
    found = minimize(cost, z, method="L-BFGS-B", options={"maxiter": 3, "maxfun": 3 * (len(z) + 1)})
    assert found.fun > solution.cost * (1 - 1e-3)


def test_at_convergence_the_states_of_least_total_cost_are_the_plan(quadrotor: ls.Scenario) -> None:
    """Sec. V-C. Iterated to 1e-9, what is left is the error of the inverse step, 1e-8 here."""
    solution = ls.smooth(quadrotor.problem, tolerance=1e-9, gap_tolerance=1e-6)
    assert solution.status is Status.CONVERGED
    states, controls = solution.total_cost.minimizer(), solution.trajectory.controls
    np.testing.assert_allclose(states, solution.trajectory.states, rtol=0, atol=1e-5)
    dynamics = quadrotor.robot.dynamics
    for t in range(0, 150, 15):
        np.testing.assert_allclose(dynamics.step(states[t], controls[t], 1 / 30), states[t + 1], rtol=0, atol=1e-5)
    # The minimum of the total cost is one number, the cost, at every step (Eq. (20)).
    np.testing.assert_allclose(solution.total_cost.minimum(), solution.cost, rtol=1e-5)
    # Both policies give the same controls there (Eq. (22)).
    assert solution.inverse_policy is not None
    inverse = [solution.inverse_policy.control(states[t + 1], t) for t in range(150)]
    np.testing.assert_allclose(inverse, controls, rtol=0, atol=1e-4)


def test_the_plan_is_the_rollout_of_the_policy(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    x = quadrotor_solution.trajectory.states[0]
    for t in range(150):
        control = quadrotor_solution.policy.control(x, t)
        np.testing.assert_allclose(control, quadrotor_solution.trajectory.controls[t], rtol=0, atol=1e-9)
        x = quadrotor.robot.dynamics.step(x, control, 1 / 30)
        np.testing.assert_allclose(x, quadrotor_solution.trajectory.states[t + 1], rtol=0, atol=1e-9)


def test_cost_to_go_predicts_what_is_left(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """Along the plan the quadratic cost-to-go is the true cost of the rest: 0.1 %, the distance from convergence."""
    plan, value = quadrotor_solution.trajectory, quadrotor_solution.cost_to_go
    assert value is not None
    goal = quadrotor_queries(1)[1][0]
    predicted = value(plan.states)

    def rest(t: int) -> float:
        """The true cost from t on: nothing for the start, and the obstacle cost of every state but the first."""
        cost = quadrotor_cost(plan.states[t:], plan.controls[t:], plan.states[t], goal)
        if t == 0:
            return cost
        # The function above left out the obstacles at t, for they do not act on the first state.
        hover = np.full((2, 4), 0.5 * 9.8 / 4)
        return cost + quadrotor_cost(plan.states[[0, t, -1]], hover, plan.states[0], plan.states[-1])

    for t in (0, 40, 100, 149):
        assert predicted[t] == pytest.approx(rest(t), rel=1e-3)


def test_ilqr_starts_where_it_is_told_and_never_lets_the_cost_rise(quadrotor: ls.Scenario) -> None:
    start = quadrotor_queries(1)[0][0]
    problem = dataclasses.replace(quadrotor.problem, initial=ls.FixedState(start))
    solution = ls.ilqr(problem)
    assert (solution.trajectory.states[0] == start).all()
    assert solution.status is Status.CONVERGED
    costs = [iteration.cost for iteration in solution.iterations]
    assert (np.diff(costs) <= 0).all()
    assert solution.cost_to_come is None
    assert solution.inverse_policy is None
    with pytest.raises(ls.InputError, match="without both value functions"):
        _ = solution.total_cost


def test_another_goal_weight_mass_or_obstacle_compiles_nothing(differential_drive: ls.Scenario) -> None:
    problem = differential_drive.problem
    for solver in (ls.smooth, ls.ilqr):
        solver(problem)
    robot = ls.DifferentialDrive(axle_length=0.3)
    fewer = ls.World(differential_drive.scene.world.obstacles[:7])
    other = ls.Problem(
        dynamics=robot.dynamics,
        dt=0.2,
        steps=120,
        initial=ls.QuadraticCost((4000.0, 4000.0, 40.0), about=(0.1, -2.4, 3.0)),
        stage_cost=ls.ControlCost((50.0, 70.0), about=(0.2, 0.2))
        + ls.ObstacleCost(fewer, radius=0.2, sharpness=8.0, weight=2.0),
        final_cost=ls.QuadraticCost((4000.0, 4000.0, 40.0), about=(0.2, 2.4, 3.0)),
    )
    before = len(compiled_module.compilations)
    for solver in (ls.smooth, ls.ilqr):
        assert solver(other).iterations
    assert compiled_module.compilations[before:] == []


def test_the_same_problem_gives_the_same_bits(drive_solution: ls.Solution) -> None:
    again = ls.smooth(ls.scenarios.differential_drive().problem)
    assert (again.policy.gain == drive_solution.policy.gain).all()
    assert (again.trajectory.states == drive_solution.trajectory.states).all()
    assert again.problem_digest == drive_solution.problem_digest


def scalar_problem(*, paid: float = 0.0, about: float = 1.0, **rate: float) -> ls.Problem:
    """A scalar integrator that can be made to escape, to begin at a pole, or to be paid for effort."""
    return ls.Problem(
        dynamics=systems.scalar(**rate), dt=0.5, steps=20, initial=ls.QuadraticCost([1.0], about=[about]),
        stage_cost=systems.scalar_cost(paid=paid), final_cost=ls.QuadraticCost([1.0], about=[0.0]),
    )  # fmt: skip


POLE = {"pole": 1.0, "at": 1.0}  # where it begins


def creased(steep: float) -> ls.Problem:
    """Two controls whose cost has a crease where they are equal, along which it falls to zero."""

    def cost(x, u, p):
        from sympy import Piecewise

        across = u.a - u.b
        return (u.a**2 + u.b**2) / 2 + p.steep * Piecewise((across, across >= 0), (-across, True))

    return ls.Problem(
        dynamics=ls.Dynamics(lambda x, u, p: [u.a - u.b], states={"x": "m"}, controls={"a": "m/s", "b": "m/s"}),
        dt=0.1, steps=5, initial=ls.FixedState([0.0]), final_cost=ls.QuadraticCost([1.0], about=[0.0]),
        stage_cost=ls.SymbolicCost(cost, parameters={"steep": steep}, convex=True),
    )  # fmt: skip


class TestEndings:
    """A hard problem never raises; its status is true and says what to do."""

    @pytest.mark.parametrize("solver", [ls.smooth, ls.ilqr])
    def test_a_motion_that_escapes_to_infinity(self, solver) -> None:
        solution = solver(scalar_problem(cubic=100.0), max_iterations=30)
        assert not solution.success
        assert "remedy" in str(solution)
        assert solution.remedy in str(solution)

    def test_a_cost_without_a_minimum(self) -> None:
        solution = ls.smooth(scalar_problem(paid=1.0), safeguard=False)
        assert solution.status is Status.NOT_POSITIVE_DEFINITE
        assert solution.detail == "forward pass of iteration 1, step 0 of 20"
        assert solution.iterations == ()
        assert solution.cost == pytest.approx(0.5)  # of what the start leads to: at rest at 1, u = 0
        assert solution.cost_to_go is None

    @pytest.mark.parametrize("solver", [ls.smooth, ls.ilqr])
    def test_a_formula_outside_its_domain_at_the_start(self, solver) -> None:
        message = (
            r"scalar_rate\(x, u, p\): got inf as entry 0 \(x\) at the start, x = \(1\), u = \(0\), want a finite number"
        )
        with pytest.raises(ls.InputError, match=message):
            solver(scalar_problem(**POLE))

    @pytest.mark.parametrize("solver", [ls.smooth, ls.ilqr])
    def test_a_cost_of_zero(self, solver) -> None:
        solution = solver(scalar_problem(about=0.0))
        assert solution.status is Status.CONVERGED
        assert solution.cost == 0

    def test_a_first_trajectory_of_ilqr_that_is_infinite(self) -> None:
        solution = ls.ilqr(scalar_problem(cubic=1e6))
        assert solution.status is Status.NOT_FINITE
        assert solution.detail == "rollout of the initial controls"

    @pytest.mark.parametrize(("solver", "options"), [(ls.smooth, {}), (ls.smooth, {"safeguard": False}), (ls.ilqr, {})])
    def test_too_few_iterations(self, differential_drive: ls.Scenario, solver, options: dict) -> None:
        solution = solver(differential_drive.problem, max_iterations=2, **options)
        assert solution.status is Status.MAX_ITERATIONS
        assert len(solution.iterations) == 2
        assert np.isfinite(solution.optimality)

    @pytest.mark.parametrize("stop", ["cost", "optimal"])
    @pytest.mark.parametrize("seed", range(4))
    def test_a_plan_that_no_step_improves_has_not_converged(self, seed: int, stop: str) -> None:
        """On a crease the step is steeply up the other side, however short it is: far above the least cost, of zero.

        Where the plan is optimal, no step lowers its cost either.
        """
        rng = np.random.default_rng(seed)
        at, ratio = rng.uniform(0.1, 10.0), rng.uniform(1.5, 20.0)
        solution = ls.ilqr(creased(ratio * at), start=[at, at], stop=stop)
        assert solution.status is Status.STALLED
        assert solution.cost == pytest.approx(5 * at**2)
        assert solution.optimality > 0.1
        flat = scalar_problem(about=rng.normal())
        again = ls.ilqr(flat, start=ls.ilqr(flat), stop=stop)
        assert again.status is (Status.COST_CONVERGED if stop == "cost" else Status.CONVERGED)

    def test_the_cost_test_alone_is_not_called_converged(self, differential_drive: ls.Scenario) -> None:
        solution = ls.smooth(differential_drive.problem, stop="cost", tolerance=0.5)
        assert solution.status is Status.COST_CONVERGED
        assert solution.gap > 1e-3
        strict = ls.smooth(differential_drive.problem, tolerance=0.5)
        assert strict.gap < 1e-3
        assert len(strict.iterations) > len(solution.iterations)


class TestMany:
    @pytest.mark.parametrize("many", [ls.smooth_many, ls.ilqr_many])
    @pytest.mark.parametrize("threads", [1, 5, *rarely(2)])
    def test_each_is_what_one_would_be_to_the_last_bit(self, many, threads: int) -> None:
        one = {ls.smooth_many: ls.smooth, ls.ilqr_many: ls.ilqr}[many]
        problems = [ls.scenarios.quadrotor(query=query).problem for query in range(6)]
        told: list[tuple[int, int]] = []
        solutions = many(problems, threads=threads, progress=lambda done, of: told.append((done, of)))
        assert told == [(done, 6) for done in range(1, 7)]
        for problem, solution in zip(problems, solutions, strict=True):
            alone = one(problem)
            assert solution.status is alone.status
            assert [row.cost for row in solution.iterations] == [row.cost for row in alone.iterations]
            np.testing.assert_array_equal(solution.policy.gain, alone.policy.gain)
            np.testing.assert_array_equal(solution.trajectory.states, alone.trajectory.states)

    def test_each_has_a_status_of_its_own(self) -> None:
        problems = [scalar_problem(), scalar_problem(paid=1.0), scalar_problem(cubic=100.0)]
        first, second, third = ls.smooth_many(problems, max_iterations=30)
        assert first.status is Status.CONVERGED
        assert second.status is Status.NOT_POSITIVE_DEFINITE
        assert not third.success
        assert ls.smooth_many([]) == []

    def test_bad_input_is_named_by_its_place(self, differential_drive: ls.Scenario) -> None:
        good = differential_drive.problem
        fixed = dataclasses.replace(good, initial=ls.FixedState((0, -2.5, np.pi)))
        with pytest.raises(ls.InputError, match=r"^problems\[1\]: initial: got a FixedState, want an initial cost"):
            ls.smooth_many([good, fixed], form="primal")
        with pytest.raises(ls.InputError, match=r"^problems\[0\]: problem: got 'quadrotor', want a Problem"):
            ls.ilqr_many(["quadrotor"])  # pyright: ignore[reportArgumentType]
        with pytest.raises(ls.InputError, match=r"^threads: got 0, want a whole number >= 1"):
            ls.smooth_many([good], threads=0)
        for many in (ls.smooth_many, ls.ilqr_many):
            good, lost = many([scalar_problem(), scalar_problem(**POLE)])
            assert good.status is Status.CONVERGED
            assert lost.status is Status.NOT_FINITE
            assert "scalar_rate(x, u, p): got inf as entry 0 (x) at the start" in lost.detail
        with pytest.raises(ls.InputError, match=r"^problem: got None, want a Problem"):
            ls.smooth(None)  # pyright: ignore[reportArgumentType]


class TestProgress:
    """Whoever hears nothing for long is told how far a solve is; here after a millisecond, not after two seconds."""

    @pytest.fixture
    def slow(self, monkeypatch: pytest.MonkeyPatch) -> ls.Problem:
        """Some 300 calls of Python an iteration, of a hundredth of a millisecond each at least."""
        monkeypatch.setattr(budget, "SILENT", 1e-3)
        monkeypatch.setattr(budget, "SELDOM", 0.05)

        def rate(x: Any, u: Any, p: Any) -> list[Any]:
            time.sleep(1e-5)
            return [x[1], u[0] - np.sin(x[0])]

        dynamics = ls.Dynamics(
            rate, states={"angle": "rad", "rate": "rad/s"}, controls={"torque": "N m"}, level="plain", angles=("angle",)
        )
        return ls.Problem(
            dynamics=dynamics, dt=0.1, steps=10, initial=ls.FixedState(np.zeros(2)), stage_cost=ls.ControlCost([0.01]),
            final_cost=ls.QuadraticCost([100.0, 100.0], about=[3.0, 0.0]),
        )  # fmt: skip

    @pytest.mark.parametrize(("solver", "name"), [(ls.smooth, "smooth"), (ls.ilqr, "ilqr")])
    def test_it_says_what_has_been_found(
        self, slow: ls.Problem, solver: Any, name: str, caplog: pytest.LogCaptureFixture
    ) -> None:
        solution = solver(slow)
        told = 0
        for record in caplog.records:
            if record.getMessage().startswith("compiling "):  # if nothing is cached
                continue
            line = re.fullmatch(rf"{name}: \d+ s, (.*)", record.getMessage())
            assert line
            if line[1] != "in the first iteration":
                said = re.fullmatch(r"iteration (\d+): ([a-z]+), cost ([^,]+)", line[1])
                assert said, line
                iteration = solution.iterations[int(said[1]) - 1]
                assert (iteration.method, f"{iteration.cost:.4g}") == (said[2], said[3])
                told += 1
        assert told > 0

    def test_it_says_what_is_left_of_the_time(self, slow: ls.Problem, caplog: pytest.LogCaptureFixture) -> None:
        ls.smooth(slow, time_limit=5000.2)
        told = [record.getMessage() for record in caplog.records]
        first = next(line for line in told if not line.startswith("compiling "))  # if nothing is cached
        assert re.fullmatch(r"smooth: \d+ s, in the first iteration; at most 5000 s left", first)

    @pytest.mark.parametrize("solver", [ls.smooth, *rarely(ls.ilqr)])
    def test_it_says_how_long_it_compiled_if_that_does_not_count(
        self, solver: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        """Dynamics that no cache has: the time is within that of the call, beyond the limit, and said once."""
        monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))

        def solved(number: float, limit: float | None) -> tuple[list[float], float]:
            """The times of compiling that are said in a solve, and how long it took, in s."""
            dynamics = ls.Dynamics(
                lambda x, u, p: [x[1], u[0] - number * x[0]], states={"x": "m", "v": "m/s"}, controls={"a": "m/s^2"}
            )
            problem = ls.Problem(
                dynamics=dynamics, dt=0.1, steps=10, initial=ls.FixedState([1, 0]), stage_cost=ls.ControlCost([1.0]),
                final_cost=ls.QuadraticCost([10.0, 10.0], about=[0, 0]),
            )  # fmt: skip
            caplog.clear()
            clock = time.perf_counter()
            solver(problem, time_limit=limit)
            taken = time.perf_counter() - clock
            line = rf"compiled in ([\d.]+) s, which the time_limit of {limit or 0:g} s does not count"
            found = [re.fullmatch(line, record.getMessage()) for record in caplog.records]
            return [float(one[1]) for one in found if one], taken

        for seed in range(3):
            number = float(np.random.default_rng(seed).uniform(0.5, 2.0)) + 2 * (solver is ls.ilqr)
            told, taken = solved(number, 0.001)
            (compiled,) = told
            assert compiled <= taken + 0.05  # it is rounded
            assert solved(number, 0.001)[0] == []  # nothing is compiled
            assert solved(number + 0.125, None)[0] == []
            assert solved(number + 0.25, 5000.0)[0] == []  # a tenth of that is more than compiling takes

    @pytest.mark.parametrize(("kind", "m"), [("soft start", 5), ("fixed start", 6), ("constraint", 7)])
    def test_nothing_that_a_search_compiles_counts(
        self, kind: str, m: int, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """For sizes that no other test has, and with an empty cache. What is compiled after the search may count."""
        monkeypatch.setenv("LQRSIM_CACHE_DIR", str(tmp_path))
        stop, compiled, counted = budget.Stop(), list[str](), list[str]()
        compilations = SimpleNamespace(
            append=lambda what: (counted if stop._stopped is None else compiled).append(what)
        )
        monkeypatch.setattr(compiled_module, "compilations", compilations)
        dynamics = ls.Dynamics(
            lambda x, u, p: [sum(u) - x[0] ** 3], states={"x": "m"}, controls={f"v{i}": "m/s" for i in range(m)}
        )
        problem = ls.Problem(
            dynamics=dynamics, dt=0.1, steps=10, stage_cost=ls.ControlCost([1.0] * m),
            initial=ls.QuadraticCost([1.0], about=[1]) if kind == "soft start" else ls.FixedState([1]),
            final_cost=ls.QuadraticCost([5.0], about=[0]),
            constraints=[ls.StateBounds(x=(-0.5, 2.0))] if kind == "constraint" else [],
        )  # fmt: skip
        assert smoother.solve(problem, SmootherSettings(), stop).success
        assert len(compiled) > 3
        assert not [what for what in counted if not what.startswith("state_jacobians ")]

    def test_whoever_hears_of_iterations_is_not_told(
        self, slow: ls.Problem, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setattr(budget, "SILENT", 1e3)
        ls.smooth(slow, callback=lambda iteration: None)
        monkeypatch.setattr(budget, "SILENT", 1e-3)
        stop = budget.Stop(attentive=True, called=np.inf)
        with stop.reporting("smooth"):
            time.sleep(0.02)
        assert not caplog.records
        ls.smooth_many([slow], progress=lambda done, of: None)
        assert not caplog.records
        solved = ls.smooth_many([slow] * 2, threads=1)
        lines = [record.getMessage() for record in caplog.records]
        assert {re.sub(r"\d+ s", "0 s", line) for line in lines} <= {
            f"solving: 0 s, {k} of 2 problems done" for k in range(3)
        }
        assert len(lines) > 0
        assert all(one.success for one in solved)

    def test_no_thread_is_left(self, slow: ls.Problem, monkeypatch: pytest.MonkeyPatch) -> None:
        def stop(iteration: ls.types.Iteration) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(budget, "SILENT", 0.01)
        for _ in range(3):
            with pytest.raises(KeyboardInterrupt):
                ls.smooth(slow, callback=stop)
        watching = [thread for thread in threading.enumerate() if thread.name == "progress"]
        assert len(watching) <= 1
        for thread in watching:
            thread.join(60)
            assert not thread.is_alive()


@pytest.mark.parametrize("ended", ["time", "iterations"])
def test_a_plan_that_is_not_finished_says_how_far_it_is_from_an_optimum(
    differential_drive: ls.Scenario, ended: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The decrease that it predicts is the one to the optimum, to a factor of 3: its model is quadratic."""
    problem = differential_drive.problem
    optimum, near = ls.smooth(problem, starts=1), 0
    for last in range(1, len(optimum.iterations)):
        seen = list[ls.types.Iteration]()
        with monkeypatch.context() as patch:
            if ended == "time":
                patch.setattr(budget.Stop, "due", property(lambda _, seen=seen, last=last: len(seen) >= last))
            limit: dict[str, Any] = {} if ended == "time" else {"max_iterations": last}
            found = ls.smooth(problem, starts=1, callback=seen.append, **limit)
        assert found.status.name == ("TIME_LIMIT" if ended == "time" else "MAX_ITERATIONS")
        left = (found.cost - optimum.cost) / found.cost
        said = re.search(r"the plan can be used, .* could still fall by a relative (\S+), where 1e-08", found.detail)
        if said:
            near += 1
            assert left / 3 < float(said[1]) < 3 * left
        else:
            assert "but is far from an optimum" in found.detail
            assert left > 0.005
    assert near >= 1
    # A plan that misses a constraint is of no use, and says by how much.
    kept = ls.Clearance(differential_drive.scene.world, **differential_drive.robot.shape, margin=0.2)
    missed = ls.smooth(dataclasses.replace(problem, constraints=[kept]), max_iterations=2, starts=1)
    assert missed.violation > 1e-6
    assert "can be used" not in missed.detail


@settings(max_examples=examples(20))
@given(seed=st.integers(0, 2**32 - 1))
def test_an_unfinished_plan_that_misses_its_goal_is_not_called_of_use(seed: int) -> None:
    """A pendulum whose controls cost more or less, so that the plan ends nearer to its goal or farther off."""
    draws = np.random.default_rng(seed)
    pendulum = ls.Dynamics(
        lambda x, u, p: [x.turn, u.push - p.pull * x.angle**3],
        states={"angle": "rad", "turn": "rad/s"}, controls={"push": "1/s^2"}, parameters={"pull": 1.0},
    )  # fmt: skip
    problem = ls.Problem(
        dynamics=pendulum, dt=0.1, steps=20, initial=ls.FixedState([0.0, 0.0]),
        stage_cost=ls.ControlCost([10 ** draws.uniform(-3, 2)]),
        final_cost=ls.QuadraticCost([10.0, 1.0], about=[draws.uniform(0.5, 2.0), 0.0]),
    )  # fmt: skip
    for most in (2, 3, 4):
        found = ls.smooth(problem, max_iterations=most, safeguard=False)
        away = found.target.distance(found.trajectory.states[-1])
        if "the plan can be used" in found.detail:
            assert away <= TOLERANCE
        if "misses the goal" in found.detail:
            assert away > TOLERANCE


def test_the_callback_sees_every_iteration_and_may_stop_the_solve(differential_drive: ls.Scenario) -> None:
    seen: list[ls.types.Iteration] = []
    solution = ls.smooth(differential_drive.problem, callback=seen.append)
    assert tuple(seen) == solution.iterations

    def interrupt(iteration: ls.types.Iteration) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ls.smooth(differential_drive.problem, callback=interrupt)


def test_the_summary_says_what_matters(drive_solution: ls.Solution) -> None:
    text = str(drive_solution)
    assert len(text.splitlines()) <= 15
    assert "CONVERGED after 6 iterations of smooth" in text
    assert "the plan is from the start 'straight', one of 7; 6 were dropped" in text
    assert "clearance: 0.141 m" in text


@pytest.mark.parametrize("optimality", [np.inf, np.nan, 0.0, 2.5e-3])
def test_the_summary_has_an_optimality_only_if_it_is_known(drive_solution: ls.Solution, optimality: float) -> None:
    status, plan = Status.COST_CONVERGED, dataclasses.replace(drive_solution.certificate, optimality=optimality)
    text = str(dataclasses.replace(drive_solution, status=status, certificate=plan))
    assert f"optimality: {f'{optimality:.1e}' if np.isfinite(optimality) else 'unknown'}" in text


@pytest.mark.parametrize("seed", range(20))
def test_the_time_that_is_left_only_falls(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """Also while the clock is stopped, and when it goes on."""
    draws, now = np.random.default_rng(seed), [0.0]
    monkeypatch.setattr(budget, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    stop, said, counted = budget.Stop(), list[int](), 0.0
    stop.begin(100.0)

    def wait(*, counts: bool) -> None:
        nonlocal counted
        seconds = float(draws.uniform(0.0, 5.0))
        now[0], counted = now[0] + seconds, counted + seconds * counts
        said.append(int(stop.progress.split("at most ")[1].split(" s ")[0]))
        assert said[-1] == round(100 - counted)

    for _ in range(6):
        wait(counts=True)
        with stop.not_counting():
            wait(counts=False)
            wait(counts=False)
    wait(counts=True)
    assert said == sorted(said, reverse=True)


def test_the_summary_says_how_many_iterations_all_starts_took() -> None:
    for query in range(3):
        solution = ls.smooth(ls.scenarios.quadrotor(query=query).problem, starts=3)
        total = sum(one.iterations for one in solution.candidates)
        assert total > len(solution.iterations)
        assert f"; {total} iterations in all\n" in f"{solution}\n"
    alone = ls.smooth(ls.scenarios.quadrotor().problem, starts=1)
    assert "in all" not in str(alone)
