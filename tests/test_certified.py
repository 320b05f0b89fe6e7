"""What a solve may say, and when it ends: certificates, limits of iterations and time, exceptions on the way."""

import dataclasses
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy
from oracle import planar_quadrotor
from sampling import rarely
from whole_problems.claims import contradictions

import lqrsim as ls
from lqrsim.codegen import compiled_module
from lqrsim.results.solution_parts import Certificate, Iteration, Status
from lqrsim.solvers import budget, certify
from lqrsim.solvers.certify import faults

GOOD = Certificate(
    cost=36.0, start=0.0, dynamics_residual=1e-15, policy_residual=1e-15, limits=0.0, violation=0.0, optimality=1e-6
)


WAGON = ls.Dynamics(lambda x, u, p: [x.v, u.a], states={"x": "m", "v": "m/s"}, controls={"a": "m/s^2"}, position=())
RATE, BETWEEN = {"control_rate": ls.ControlRate(weight=[1.0])}, {"between_knots": True}
FREE = {"duration": (1.0, 8.0), "time_weight": 1.0}
# What a problem may ask beside its plan, for each of which loops are around solves.
LOOPS: list[dict[str, Any]] = [{}, RATE, BETWEEN, FREE, BETWEEN | FREE]


class TestCertificate:
    @pytest.mark.parametrize(
        ("field", "value", "says"),
        [
            ("start", 1e-15, "begins 1e-15 off the fixed start"),
            ("dynamics_residual", 1e-7, "1e-07 off the dynamics"),
            ("policy_residual", 1e-10, "1e-10 off the policy's"),
            ("limits", 1e-15, "1e-15 beyond its limit"),
            ("violation", 1e-15, "a constraint is missed by 1e-15"),
            ("cost", 36.00001, "it costs 36.00001, not 36"),
            ("optimality", 3e-4, "its optimality is 0.0003, not below 0.0001"),
            ("dynamics_residual", float("nan"), "nan off the dynamics"),
            ("optimality", float("nan"), "its optimality is nan"),
        ],
    )
    def test_each_of_its_numbers_can_fail(self, field: str, value: float, says: str) -> None:
        assert faults(GOOD, claimed=36.0, rounding=0.0, tolerance=1e-4) == ""
        bad = dataclasses.replace(GOOD, **{field: value})
        assert says in faults(bad, claimed=36.0, rounding=0.0, tolerance=1e-4)

    @pytest.mark.parametrize("solver", [ls.smooth, ls.ilqr])
    def test_a_plan_that_fails_it_is_no_success(
        self, monkeypatch: pytest.MonkeyPatch, drive: ls.Problem, solver
    ) -> None:
        """A fault is injected between the method and its certificate: the policy is another one."""
        assert solver(drive).status is Status.CONVERGED
        honest = certify.certificate_of

        def spoilt(*arguments: Any) -> tuple[Certificate, float]:
            certificate, scale = honest(*arguments)
            return dataclasses.replace(certificate, policy_residual=1e-6), scale

        monkeypatch.setattr(certify, "certificate_of", spoilt)
        solution = solver(drive)
        assert solution.status is Status.NOT_CERTIFIED
        assert not solution.success
        assert "its controls are 1e-06 off the policy's" in solution.detail
        assert solution.remedy in solution.summary()

    def test_its_numbers_are_those_of_the_plan(self, drive: ls.Problem) -> None:
        """Cost and motion against plain Python: the dynamics' own step, and the terms of the cost summed up."""
        solution = ls.smooth(drive)
        plan = solution.trajectory
        steps = [drive.dynamics.step(x, u, drive.dt) for x, u in zip(plan.states[:-1], plan.controls, strict=True)]
        np.testing.assert_allclose(steps, plan.states[1:], atol=1e-12)
        assert solution.certificate.dynamics_residual < 1e-12
        assert solution.certificate.optimality == pytest.approx(solution.iterations[-1].optimality, rel=0.05)
        assert contradictions(drive, solution) == []


@pytest.fixture(scope="module")
def drive() -> ls.Problem:
    problem = ls.scenarios.differential_drive().problem
    assert problem.start is not None
    return dataclasses.replace(problem, initial=ls.FixedState(problem.start))


class TestPlanarQuadrotor:
    """A robot of somebody's own, on which solves once said what was not so."""

    def test_a_fixed_start_is_kept(self) -> None:
        """After a damped phase, the iterations with the constraint began where the forward pass had ended."""
        problem = planar_quadrotor.problem(
            (-1.42, 0.16), (1.94, 0.04), steps=257, effort=10.0, weight=1000.0, sharpness=20.0
        )
        solution = ls.smooth(problem)
        np.testing.assert_array_equal(solution.trajectory.states[0], problem.start)
        assert solution.status is Status.CONVERGED
        assert contradictions(problem, solution) == []

    def test_where_the_search_ends_before_the_wall_another_way_is_found(self) -> None:
        """The seven starts end 2.3 m short of the goal, or at a cost of thousands; over the wall it costs 60.9.

        There is an optimum for each pair of steps at which the wall's corners may be passed, at up to 72.
        """
        problem = planar_quadrotor.problem(
            (-1.02, 0.62), (1.92, 0.63), steps=247, effort=10.0, weight=500.0, sharpness=5.0
        )
        short = ls.smooth(problem, starts=7)
        solution = ls.smooth(problem)
        for one in (short, solution):
            assert one.status is Status.CONVERGED
            assert contradictions(problem, one) == []
        assert short.cost > 1000
        assert solution.cost < 61.1
        assert np.linalg.norm(solution.trajectory.states[-1][:2] - (1.92, 0.63)) < planar_quadrotor.RADIUS
        assert "times the weight of obstacles and goal" in solution.summary()

    def test_another_way_is_taken_to_all_its_digits(self) -> None:
        """The seven starts end 1.7 m short of the goal at a cost of 777; over a steep wall it costs 17.6."""
        problem = planar_quadrotor.problem(
            (-1.948, 0.2855), (1.4184, -0.0911), steps=161, clearance=False, sharpness=40.0
        )
        solution = ls.smooth(problem)
        assert solution.status is Status.CONVERGED
        assert contradictions(problem, solution) == []
        assert solution.cost < 17.7
        assert np.linalg.norm(solution.trajectory.states[-1][:2] - (1.4184, -0.0911)) < planar_quadrotor.RADIUS

    def test_what_does_not_get_anywhere_hands_over(self) -> None:
        """Undamped, it swings about until the limit of 500 iterations comes."""
        problem = planar_quadrotor.problem((-1.42, 0.16), (1.94, 0.04), steps=257, clearance=False, effort=10.0)
        bare = ls.smooth(problem, safeguard=False, finish=None)
        assert bare.status is Status.MAX_ITERATIONS
        solution = ls.smooth(problem, finish=None)
        assert solution.status is Status.CONVERGED
        assert len(solution.iterations) < 100
        assert len(ls.smooth(problem).iterations) < 30  # the valley was found long before


class TestLimits:
    @pytest.mark.parametrize("most", [1, 2, 3, 10, 60])
    @pytest.mark.parametrize("clearance", [False, True])
    def test_max_iterations_bounds_all_of_them(self, most: int, clearance: bool) -> None:
        problem = planar_quadrotor.problem(
            (-1.42, 0.16), (1.94, 0.04), steps=257, clearance=clearance, effort=10.0, weight=1000.0
        )
        solution = ls.smooth(problem, max_iterations=most)
        assert len(solution.iterations) <= most
        assert contradictions(problem, solution) == []
        if not solution.success:
            assert solution.status in (Status.MAX_ITERATIONS, Status.INFEASIBLE)

    def test_a_slack_constraint_behind_a_solve_that_fails_ends(self) -> None:
        """Once it called itself until Python gave up."""
        scenario = ls.scenarios.differential_drive()
        slack = ls.Clearance(scenario.scene.world, radius=scenario.robot.radius, margin=-1.0)
        problem = dataclasses.replace(scenario.problem, constraints=[slack])
        solution = ls.smooth(problem, max_iterations=3)
        assert solution.status is Status.MAX_ITERATIONS
        assert len(solution.iterations) <= 3

    @pytest.mark.parametrize("clearance", [False, True])
    def test_the_cost_is_that_of_the_plan_when_the_iterations_run_out(self, clearance: bool) -> None:
        for most in range(4, 40, 3):
            problem = planar_quadrotor.problem((-1.42, 0.16), (1.94, 0.04), clearance=clearance, effort=10.0)
            solution = ls.smooth(problem, max_iterations=most, starts=1)
            assert contradictions(problem, solution) == []

    @pytest.mark.parametrize("solver", [ls.smooth, ls.ilqr])
    def test_the_time_limit_leaves_the_best_plan(self, drive: ls.Problem, solver) -> None:
        solver(drive)  # so that everything is compiled
        solution = solver(drive, time_limit=1e-9)
        assert solution.status is Status.TIME_LIMIT
        assert solution.iterations == ()
        assert contradictions(drive, solution) == []
        # The clock stops in the third iteration.
        late = solver(drive, start=drive.nominal_control, time_limit=0.5, callback=Sleepy(0.3))
        assert late.status is Status.TIME_LIMIT
        assert 1 <= len(late.iterations) <= 2
        assert late.cost <= min(iteration.cost for iteration in late.iterations) * (1 + 1e-12)
        assert contradictions(drive, late) == []

    @pytest.mark.parametrize("solver", [ls.smooth, ls.ilqr])
    @pytest.mark.parametrize("iterations", [1.5, 2.9, 4.2])
    def test_no_iteration_is_begun_that_would_end_after_the_time_limit(
        self, drive: ls.Problem, solver: Any, iterations: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """By a clock that only the callback moves, as where an iteration of an MJCF takes seconds: 10 s for each."""
        now = 0.0

        def tick(iteration: Iteration) -> None:
            nonlocal now
            now += 10.0

        monkeypatch.setattr(budget, "time", SimpleNamespace(perf_counter=lambda: now))
        solution = solver(drive, start=drive.nominal_control, time_limit=10 * iterations, callback=tick)
        assert solution.status is Status.TIME_LIMIT
        assert now == 10 * len(solution.iterations) == 10 * int(iterations)


class Sleepy:
    """A callback that takes its time, so that a limit of time is met however fast the machine is."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def __call__(self, iteration: Iteration) -> None:
        time.sleep(self.seconds)


class TestExceptionsOnTheWay:
    @pytest.mark.parametrize("solver", [ls.smooth, ls.ilqr])
    @pytest.mark.parametrize("error", [RuntimeError("enough"), KeyboardInterrupt()])
    def test_what_the_callback_raises_has_the_plan(self, drive: ls.Problem, solver, error: BaseException) -> None:
        seen: list[Iteration] = []

        def callback(iteration: Iteration) -> None:
            seen.append(iteration)
            if len(seen) == 3:
                raise error

        with pytest.raises(type(error)) as caught:
            solver(drive, start=drive.nominal_control, callback=callback)
        solution = caught.value.solution  # pyright: ignore[reportAttributeAccessIssue]
        assert solution.status is Status.INTERRUPTED
        assert len(solution.iterations) == 3
        assert solution.cost <= min(iteration.cost for iteration in seen) * (1 + 1e-12)
        assert contradictions(drive, solution) == []

    @pytest.mark.parametrize("when", [1, 5, 8, 15])  # of smoothing, and of the interior point
    def test_with_constraints_too(self, when: int) -> None:
        problem = planar_quadrotor.problem((-1.42, 0.16), (1.94, 0.04), steps=257, effort=10.0, weight=1000.0)
        seen: list[Iteration] = []

        def callback(iteration: Iteration) -> None:
            seen.append(iteration)
            if len(seen) == when:
                raise RuntimeError("enough")

        with pytest.raises(RuntimeError, match="enough") as caught:
            ls.smooth(problem, callback=callback)
        solution = caught.value.solution  # pyright: ignore[reportAttributeAccessIssue]
        assert solution.status is Status.INTERRUPTED
        assert contradictions(problem, solution) == []

    @pytest.mark.parametrize("when", [1, 2, *rarely(5, 9, 14, 20)])
    @pytest.mark.parametrize("loops", LOOPS, ids=" ".join)
    def test_in_loops_around_solves_the_plan_is_one_of_the_whole_problem(
        self, loops: dict[str, Any], when: int
    ) -> None:
        """With a `control_rate`, the solves inside have the last command as a state."""
        seen: list[Iteration] = []

        def callback(iteration: Iteration) -> None:
            seen.append(iteration)
            if len(seen) == when:
                raise KeyboardInterrupt

        slow = ls.SymbolicConstraint(lambda x, u, p: 0.6 - x.v)
        for solver, constraints in ((ls.smooth, [slow]), (ls.smooth, []), (ls.ilqr, [])):
            if solver is ls.ilqr and loops.keys() != {"control_rate"}:
                continue
            problem = ls.Problem(
                dynamics=WAGON, dt=0.2, steps=20, initial=ls.FixedState([0.0, 0.0]), stage_cost=ls.ControlCost([0.1]),
                final_cost=ls.QuadraticCost([1.0, 1.0], about=[1.0, 0.0]), constraints=constraints, **loops,
            )  # fmt: skip
            seen.clear()
            try:
                solution = solver(problem, callback=callback)
            except KeyboardInterrupt as error:
                solution = error.solution  # pyright: ignore[reportAttributeAccessIssue]
                assert solution.status is Status.INTERRUPTED
            assert solution.trajectory.states.shape == (21, 2)
            assert solution.policy.gain.shape == (20, 1, 2)
            assert solver(problem, start=solution).success


def test_nothing_is_compiled_in_mid_solve() -> None:
    """The damped iterations once were, where the first solve came to need them; and so might the interior point be."""
    easy = planar_quadrotor.problem((-1.2, 0.1), (1.6, 0.3), steps=150)
    ls.smooth(easy)
    before = len(compiled_module.compilations)
    hard = planar_quadrotor.problem((-1.42, 0.16), (1.94, 0.04), steps=257, effort=10.0, weight=1000.0)
    solution = ls.smooth(hard)
    bare = ls.smooth(hard, finish=None)
    assert "interior point" in {iteration.method for iteration in solution.iterations}
    assert "damped" in {iteration.method for iteration in bare.iterations}
    assert compiled_module.compilations[before:] == []


@pytest.mark.parametrize("weight", [1.0, 1e-4])
def test_a_cost_of_the_end_alone_is_certified(weight: float) -> None:
    """Catalyst mixing, whose best control is singular for a while: Jackson's closed form is a bang, an arc, a bang.

    Nothing in this cost is curved, so its size is what the slopes are compared with. COPS 3 publishes .0480556 for 100
    steps of the trapezoidal rule. A step of Runge-Kutta, as here, differs from that by less than 1e-6.
    """

    def mixing(x: Any, u: Any, p: Any) -> list[Any]:
        a, b = x
        return [u[0] * (10 * b - a), u[0] * (a - 10 * b) - (1 - u[0]) * b]

    dynamics = ls.Dynamics(mixing, states={"a": "", "b": ""}, controls={"u": ""}, control_limits=(0.0, 1.0))
    left = ls.SymbolicCost(lambda x, u, p: p.weight * (x.a + x.b - 1), parameters={"weight": weight})
    problem = ls.Problem(
        dynamics=dynamics, dt=0.01, steps=100, initial=ls.FixedState([1.0, 0.0]),
        stage_cost=ls.QuadraticCost([0.0, 0.0], about=[0.0, 0.0]), final_cost=left,
    )  # fmt: skip
    solution = ls.smooth(problem)
    assert solution.status is Status.CONVERGED
    assert solution.cost == pytest.approx(-0.0480556 * weight, rel=2e-5)
    assert solution.certificate.optimality < 1e-8


@pytest.mark.parametrize("sharpness", [8.0, 13.0, 20.0, 50.0])
def test_a_plan_at_rest_on_a_plateau_is_certified(sharpness: float) -> None:
    """The slope of 600 (1 - exp(-s d^2)) is rounding there, and so are controls of 1e-14: they are no size of one."""
    wanted = ls.SymbolicCost(
        lambda x, u, p: 600 * (1 - sympy.exp(-p.sharpness * (x.q - 1.8) ** 2)), parameters={"sharpness": sharpness}
    )
    dynamics = ls.Dynamics(lambda x, u, p: [x[1], u[0]], states={"q": "m", "v": "m/s"}, controls={"f": "N"})
    problem = ls.Problem(
        dynamics=dynamics, dt=0.05, steps=20, initial=ls.FixedState([0.0, 0.0]),
        stage_cost=ls.ControlCost([0.015]), final_cost=wanted,
    )  # fmt: skip
    assert 2 * sharpness * 1.8 * np.exp(-sharpness * 1.8**2) < 1e-8  # the final slope, relative to the cost
    for size in (0.0, 1e-16, 1e-14, 1e-12, 1e-10):
        start = size * np.random.default_rng(0).standard_normal((20, 1))
        solution = ls.smooth(problem, start=start, starts=1, safeguard=False)
        assert solution.status is Status.CONVERGED, f"{size}: {solution.detail}"
