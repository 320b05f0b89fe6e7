"""What smooth() can begin with, and in which form and order; what its safeguard changes, and what it does not."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import sympy
import systems
from comparing import fixed, same
from scipy.optimize import minimize

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.kernels import declarations
from lqrsim.results.solution_parts import Status
from lqrsim.solvers.engine import Ending, SolveRun
from lqrsim.solvers.settings import StartLike

FORMS = ("dual", "primal")


@pytest.fixture(scope="module")
def solution(differential_drive: ls.Scenario) -> ls.Solution:
    """Not the best optimum of the differential drive."""
    prior = differential_drive.paper_start
    assert prior is not None
    start = ls.InitialPrior(prior.weight, about=prior.about, iterations=prior.iterations, controls=(0.0, 0.0))
    return ls.smooth(fixed(differential_drive.problem), start=start, tolerance=1e-8)


@pytest.fixture(scope="module")
def stiff() -> ls.Problem:
    """Drag that acts within a step: k_v / m dt = 1."""
    dynamics = ls.Quadrotor(drag=15.0).dynamics
    return dataclasses.replace(fixed(ls.scenarios.quadrotor(query=3).problem), dynamics=dynamics)


class TestForms:
    def test_they_agree_on_the_differential_drive(self, differential_drive: ls.Scenario) -> None:
        """Iterated to 1e-10: the primal form is off by its inverse step, O(dt^5), 1e-6 here."""
        dual, primal = (
            ls.smooth(differential_drive.problem, form=form, tolerance=1e-10, gap_tolerance=1e-7) for form in FORMS
        )
        assert dual.status is Status.CONVERGED
        assert primal.cost == pytest.approx(dual.cost, rel=1e-9)
        np.testing.assert_allclose(primal.trajectory.states, dual.trajectory.states, rtol=0, atol=1e-5)
        np.testing.assert_allclose(primal.policy.gain, dual.policy.gain, rtol=0, atol=1e-4)
        assert isinstance(dual.cost_to_come, ls.types.Moments)
        assert isinstance(primal.cost_to_come, ls.types.Quadratic)
        converted = dual.cost_to_come.quadratic()
        scale = np.abs(primal.cost_to_come.hessian).max()
        np.testing.assert_allclose(converted.hessian, primal.cost_to_come.hessian, rtol=0, atol=1e-4 * scale)
        assert dual.inverse_policy is not None
        assert primal.inverse_policy is not None
        np.testing.assert_allclose(dual.inverse_policy.gain, primal.inverse_policy.gain, rtol=0, atol=1e-4)

    def test_a_fixed_start_is_kept_exactly(self, quadrotor: ls.Scenario) -> None:
        problem = fixed(quadrotor.problem)
        solution = ls.smooth(problem)
        assert solution.status is Status.CONVERGED
        assert problem.start is not None
        np.testing.assert_array_equal(solution.trajectory.states[0], problem.start)
        np.testing.assert_array_equal(solution.total_cost.minimizer()[0], problem.start)
        assert solution.inverse_policy is None
        assert max(solution.gap, solution.dynamics_residual) < 1e-3
        # The least total cost is the cost, at every step (Eq. (20)); the constants know nothing of the rollout.
        np.testing.assert_allclose(solution.total_cost.minimum(), solution.cost, rtol=1e-3)
        with pytest.raises(ls.InputError, match="singular"):
            solution.cost_to_come.quadratic()  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]

    def test_a_fixed_start_is_the_limit_of_a_soft_one(self, differential_drive: ls.Scenario) -> None:
        problem = differential_drive.problem
        assert problem.start is not None
        heavy = ls.QuadraticCost(np.full(3, 1e8), about=problem.start)
        soft, hard = ls.smooth(dataclasses.replace(problem, initial=heavy)), ls.smooth(fixed(problem))
        assert soft.cost == pytest.approx(hard.cost, rel=1e-4)  # 1e8 still moves it a little
        np.testing.assert_allclose(soft.trajectory.states, hard.trajectory.states, rtol=0, atol=1e-3)


class TestStarts:
    """Each of these leads to the optimum next to it: a plan that is nearly optimal to that plan."""

    @pytest.mark.parametrize("first_pass", ["forward", "backward"])
    @pytest.mark.parametrize("kind", ["controls", "policy", "trajectory", "bent", "solution"])
    def test_it_goes_on_from_what_it_is_given(
        self, differential_drive: ls.Scenario, solution: ls.Solution, kind: str, first_pass: str
    ) -> None:
        assert solution.cost > 50  # not the optimum that it finds from nothing, of 30
        problem = fixed(differential_drive.problem)
        plan = solution.trajectory
        bent = plan.states + 0.02 * np.random.default_rng(0).normal(size=plan.states.shape)  # no motion at all
        starts: dict[str, StartLike] = {
            "controls": plan.controls,
            "policy": solution.policy,
            "trajectory": plan,
            "bent": ls.Trajectory(bent, plan.controls, plan.dt),
            "solution": solution,
        }
        found = ls.smooth(problem, start=starts[kind], first_pass=first_pass)
        assert found.status is Status.CONVERGED
        if kind in ("controls", "policy"):
            # Alone they say where to begin, not where the optimum is: any will do. But after one iteration, nothing
            # better than their own rollout is there yet, where from nothing it costs more.
            found = ls.smooth(problem, start=starts[kind], first_pass=first_pass, max_iterations=1)
            nothing = ls.smooth(problem, start=problem.nominal_control, first_pass=first_pass, max_iterations=1)
            assert nothing.cost > 1.2 * solution.cost
            np.testing.assert_allclose(found.trajectory.states, plan.states, rtol=0, atol=1e-3)
        else:
            assert len(found.iterations) <= 4
        assert found.cost == pytest.approx(solution.cost, rel=1e-4)

    @pytest.mark.parametrize("form", FORMS)
    def test_either_pass_may_come_first_from_nothing(self, differential_drive: ls.Scenario, form: str) -> None:
        """They are not the same iterations, and lead to the same optimum: to 1e-6, where 1e-4 is promised."""
        forward, backward = (
            ls.smooth(differential_drive.problem, form=form, first_pass=first) for first in ("forward", "backward")
        )
        for solution, first in ((forward, "forward"), (backward, "backward")):
            assert solution.status is Status.CONVERGED
            assert solution.cost == pytest.approx(30.14, rel=5e-3)
            assert solution.options["first_pass"] == first
        assert forward.iterations[0].cost != pytest.approx(backward.iterations[0].cost, rel=1e-2)
        assert forward.cost == pytest.approx(backward.cost, rel=1e-6)

    def test_a_linear_quadratic_problem_is_solved_in_one_iteration_from_anywhere(self) -> None:
        """One pass each way is exact, whatever was linearised about; a second iteration sees that nothing changes."""
        problem = smooth_ends(curved=False)
        reference = ls.smooth(problem).cost
        rng = np.random.default_rng(0)
        anywhere = ls.Trajectory(rng.normal(size=(21, 2)), rng.normal(size=(20, 1)), 0.1)
        for start in (None, rng.normal(size=(20, 1)), anywhere):
            for first_pass in ("forward", "backward"):
                for form in FORMS:
                    found = ls.smooth(problem, start=start, first_pass=first_pass, form=form)
                    assert len(found.iterations) == 2
                    assert found.iterations[0].cost == pytest.approx(reference, rel=1e-10)

    def test_the_log_says_what_it_began_with(self, differential_drive: ls.Scenario, solution: ls.Solution) -> None:
        plain = ls.smooth(differential_drive.problem, start=(0.25, 0.25), max_iterations=1)
        assert plain.options["start"] == [0.25, 0.25]
        searched = ls.smooth(differential_drive.problem, max_iterations=1)
        assert str(searched.options["start"]).startswith("InitialPrior ")
        started = ls.smooth(fixed(differential_drive.problem), start=solution, max_iterations=1)
        assert str(started.options["start"]).startswith("Solution ")

    @pytest.mark.parametrize("solver", [ls.smooth, ls.ilqr])
    def test_a_start_of_another_shape_gets_one_line(self, quadrotor: ls.Scenario, solution, solver) -> None:
        for start, message in (
            (solution, r"start: gain: got shape \(150, 2, 3\), want \(150, 4, 12\)"),
            (solution.policy, r"start: gain: got shape"),
            (solution.trajectory, r"start: states: got shape \(151, 3\), want \(151, 12\)"),
        ):
            with pytest.raises(ls.InputError, match=message):
                solver(quadrotor.problem, start=start)

    def test_ilqr_begins_with_the_policy_of_a_solution(self, differential_drive: ls.Scenario, solution) -> None:
        found = ls.ilqr(fixed(differential_drive.problem), start=solution)
        assert found.cost == pytest.approx(solution.cost, rel=1e-6)
        assert len(found.iterations) == 1


def _curved_end(x, u, p):
    return p.weight * sympy.log(sympy.cosh(2 * (x[0] - p.about))) + p.other * (x[1] - p.speed) ** 2


def smooth_ends(*, curved: bool, singular: bool = False) -> ls.Problem:
    """A double integrator whose initial and final costs are not quadratic, or are; whose start may be partly free."""

    def end(about: float, weight: float, singular: bool) -> ls.Cost:
        other = 0.0 if singular else weight
        if not curved:
            return ls.QuadraticCost([2 * weight, 2 * other], about=[about, 0.3])
        numbers = {"about": about, "speed": 0.3, "weight": weight, "other": other}
        return ls.SymbolicCost(_curved_end, parameters=numbers, convex=True)

    return ls.Problem(
        dynamics=systems.DOUBLE_INTEGRATOR, dt=0.1, steps=20, initial=end(-1.0, 2.0, singular),
        stage_cost=systems.stage_cost(
            ls.ControlCost([0.5], about=[0.0]), ls.QuadraticCost([0.1, 0.2], about=[2.0, 0.0])
        ),
        final_cost=end(1.0, 3.0, False),
    )  # fmt: skip


def optimum(singular: bool) -> tuple[float, Array]:
    """The same by SciPy's BFGS over the start and the controls, the motion and the cost written out."""

    def value(z: Array) -> float:
        x, v = z[:2]
        total = ends(x, v, -1.0, 2.0, singular)
        for a in z[2:]:
            total += 0.25 * a * a + 0.05 * (x - 2) ** 2 + 0.1 * v * v
            x, v = x + 0.1 * v + 0.005 * a, v + 0.1 * a
        return total + ends(x, v, 1.0, 3.0, False)

    def ends(x: float, v: float, about: float, weight: float, singular: bool) -> float:
        along = np.log(np.cosh(2 * (x - about)))
        return weight * (along if singular else along + (v - 0.3) ** 2)

    found = minimize(value, np.zeros(22), method="BFGS", options={"gtol": 1e-9})
    return float(found.fun), found.x


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("singular", [False, True], ids=["whole", "singular"])
def test_ends_that_are_not_quadratic_or_leave_a_state_free(form: str, singular: bool) -> None:
    """Eqs. (23), (31). SciPy's optimum to 1e-6, its own accuracy at finite differences."""
    problem = smooth_ends(curved=True, singular=singular)
    solution = ls.smooth(problem, form=form, tolerance=1e-10, gap_tolerance=1e-7, safeguard=False)
    assert solution.status is Status.CONVERGED
    cost, z = optimum(singular)
    assert solution.cost == pytest.approx(cost, rel=1e-6)
    np.testing.assert_allclose(solution.trajectory.states[0], z[:2], rtol=0, atol=1e-4)
    np.testing.assert_allclose(solution.trajectory.controls.ravel(), z[2:], rtol=0, atol=1e-4)


class TestSafeguard:
    @pytest.mark.parametrize("form", ["dual", pytest.param("primal", marks=pytest.mark.long)])
    def test_it_changes_nothing_where_the_method_converges(self, form: str) -> None:
        problems = [ls.scenarios.quadrotor(query=query).problem for query in range(8)]
        bare = ls.smooth_many(problems, form=form, safeguard=False)
        guarded = ls.smooth_many(problems, form=form)
        assert all(solution.status is Status.CONVERGED for solution in bare)
        assert all(same(one, other) for one, other in zip(bare, guarded, strict=True))

    def test_it_solves_what_the_method_does_not(self, stiff: ls.Problem) -> None:
        bare, guarded = ls.smooth(stiff, finish=None, safeguard=False), ls.smooth(stiff)
        assert bare.status in (Status.NOT_POSITIVE_DEFINITE, Status.NOT_FINITE)
        assert guarded.status is Status.CONVERGED
        assert guarded.detail == f"the undamped method failed ({bare.detail})"
        methods = [row.method for row in guarded.iterations]
        assert "damped" in methods
        assert "ilqr" not in methods
        # Its iterations only ever lower the cost, and a rejected one leaves it as it was.
        costs = [row.cost for row in guarded.iterations if row.method != "smooth"]
        assert (np.diff(costs) <= 1e-12 * np.abs(costs[:-1])).all()
        # iLQR from there finds next to nothing.
        further = ls.ilqr(stiff, start=guarded.trajectory, tolerance=1e-9, max_iterations=2000)
        assert guarded.cost - further.cost < 1e-3 * guarded.cost

    @pytest.mark.parametrize(
        "outcome", [declarations.NOT_FINITE, declarations.NO_START, declarations.DIVERGED, declarations.NO_PROGRESS]
    )
    def test_a_finite_plan_that_no_step_betters_has_stalled(
        self, stiff: ls.Problem, monkeypatch: pytest.MonkeyPatch, outcome: int
    ) -> None:
        """However the undamped method ended: the status is of the plan, which can be run. The detail has the rest."""

        real = SolveRun.damped

        def damped(run: SolveRun, **options: Any) -> Ending:
            run.ending = Ending(outcome, failed=3)
            return dataclasses.replace(real(run, **options), outcome=declarations.STALLED)

        monkeypatch.setattr(SolveRun, "damped", damped)
        solution = ls.smooth(stiff, finish=None, start=np.tile(stiff.nominal_control, (stiff.steps, 1)))
        assert np.isfinite(solution.trajectory.states).all()
        assert np.isfinite(solution.cost)
        assert solution.status is Status.STALLED
        assert "the undamped method failed" in solution.detail
        assert "no step lowers the cost" in solution.detail
        assert "NaN" not in str(solution)

    def test_its_answer_is_whole(self, stiff: ls.Problem) -> None:
        """The policy is undamped and makes the plan; the value functions are of the plan."""
        solution = ls.smooth(stiff, finish=None)
        plan = solution.trajectory
        x = plan.states[0]
        for t in range(stiff.steps):
            u = solution.policy.control(x, t)
            np.testing.assert_allclose(u, plan.controls[t], rtol=0, atol=1e-8)
            x = stiff.dynamics.step(x, u, stiff.dt)
        # Gains and cost-to-go are those of iLQR about the same plan, worked out by other code.
        about = ls.ilqr(stiff, start=plan, max_iterations=1, tolerance=1e-30)
        np.testing.assert_allclose(solution.policy.gain, about.policy.gain, rtol=0, atol=1e-2)
        assert solution.cost_to_go is not None
        assert solution.cost_to_go(plan.states)[0] == pytest.approx(solution.cost, rel=1e-3)
        np.testing.assert_allclose(solution.total_cost.minimum(), solution.cost, rtol=1e-3)

    def test_many_and_one_give_the_same_bits(self, stiff: ls.Problem) -> None:
        assert same(ls.smooth(stiff), *ls.smooth_many([stiff], threads=2))
        seen: list[ls.types.Iteration] = []
        solution = ls.smooth(stiff, callback=seen.append)
        # Of all that were run to their end, one after the other.
        costs, told = [row.cost for row in solution.iterations], [row.cost for row in seen]
        assert costs in [told[i : i + len(costs)] for i in range(len(told))]
        assert {row.method for row in seen} >= {"damped"}

    @pytest.mark.parametrize("form", ["dual", pytest.param("primal", marks=pytest.mark.long)])
    def test_a_motion_that_cannot_even_be_rolled_out_at_first(self, form: str) -> None:
        """The nominal control drives the state beyond all numbers; only with feedback does it stay."""
        problem = ls.Problem(
            dynamics=systems.scalar(cubic=1.0), dt=0.1, steps=40, initial=ls.QuadraticCost([10.0], about=[1.0]),
            stage_cost=systems.scalar_cost(weight=0.1),
            final_cost=ls.QuadraticCost([10.0], about=[0.5]),
        )  # fmt: skip
        assert not np.isfinite(ls.ilqr(problem).cost)
        solution = ls.smooth(problem, form=form)
        assert solution.status is Status.CONVERGED
        assert np.isfinite(solution.cost)

    def test_a_file_keeps_how_each_iteration_came_about(self, stiff: ls.Problem, tmp_path) -> None:
        solution = ls.smooth(stiff)
        loaded = ls.load(ls.save(solution, tmp_path / "stiff.npz"), ls.Solution)
        np.testing.assert_array_equal(
            [row.cost for row in loaded.iterations], [row.cost for row in solution.iterations]
        )
        assert [row.method for row in loaded.iterations] == [row.method for row in solution.iterations]
        assert isinstance(loaded.cost_to_come, ls.types.Moments)
        np.testing.assert_array_equal(loaded.total_cost.minimizer(), solution.total_cost.minimizer())
