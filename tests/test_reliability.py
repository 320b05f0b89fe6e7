"""Random problems: whatever a solution claims of itself is so, and nearly all of them are solved.

Claims are held against kkt.py, which shares nothing with the solvers.
"""

import importlib
from collections import Counter
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np
import pytest
from linear_quadratic import matrices_of, solve_dense
from oracle import kkt
from sampling import examples

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.results.solution_parts import Status

# Six of the eleven kinds, of each family some: each is compiled where nothing is cached, some 5 seconds, before the
# first test ends. benchmark_reliability.py draws all of them, by the hundred.
KINDS = ("linear_2_1", "linear_3_2", "drive", "quadrotor", "pendulum", "arm")

TOLERANCE = 1e-4  # the solvers' default, of the relative decrease that is still predicted
# The reduced gradient, relative to the terms that cancel in it, goes with the root of the decrease: measured once to
# three times it, and 16 times at worst (acrobots).
CANCELS = 20


@dataclass(frozen=True, repr=False)
class Case:
    """A problem, and what was found."""

    kind: str
    index: int
    problem: ls.Problem
    solution: ls.Solution

    @property
    def converged(self) -> bool:
        return self.solution.status is Status.CONVERGED

    def __repr__(self) -> str:
        return f"{self.kind} {self.index}: {self.solution.status.name} {self.solution.detail}"


def rate_of(kind: str) -> kkt.Rate | None:
    """The quadrotor's formula has functions of the package's own."""
    return kkt.quadrotor_rate if kind == "quadrotor" else None


@pytest.fixture(scope="module")
def problems() -> ModuleType:
    return importlib.import_module("reliability.problems")


@pytest.fixture(scope="module")
def cases(problems: ModuleType) -> list[Case]:
    drawn = list(problems.thousand(share=examples(100) / 1000, kinds=KINDS))
    solutions = ls.smooth_many([problem for _, problem in drawn])
    seen: Counter[str] = Counter()
    made = []
    for (kind, problem), solution in zip(drawn, solutions, strict=True):
        made.append(Case(kind, seen[kind], problem, solution))
        seen[kind] += 1
    return made


@pytest.fixture(scope="module")
def reports(cases: list[Case]) -> list[tuple[Case, kkt.Report]]:
    """Of those that are said to have converged."""
    return [(case, kkt.check(case.problem, case.solution, rate_of(case.kind))) for case in cases if case.converged]


def test_a_problem_does_not_depend_on_how_many_there_are(problems: ModuleType) -> None:
    few, many = list(problems.thousand(share=0.02)), list(problems.thousand(share=0.05))
    assert {kind for kind, _ in few} == set(problems.KINDS)
    digests = {problem.digest for _, problem in many}
    assert len(digests) == len(many)
    assert {problem.digest for _, problem in few} < digests
    assert problems.draw("car", 1).digest in digests
    assert problems.draw("car", 1, seed=1).digest not in digests
    assert sum(problems.COUNTS.values()) == 1000


@pytest.mark.parametrize(("family", "least"), [("linear", 1.0), ("world", 0.95), ("classic", 0.9)])
@pytest.mark.long
def test_nearly_all_are_solved(problems: ModuleType, cases: list[Case], family: str, least: float) -> None:
    mine = [case for case in cases if problems.family(case.kind) == family]
    failed = [str(case) for case in mine if not case.converged]
    assert len(failed) <= (1 - least) * len(mine), "\n".join(failed)


def test_converged_means_that_first_order_conditions_hold(reports: list[tuple[Case, kkt.Report]]) -> None:
    """The cost is that of the plan, the plan is a motion, and a model about it promises less than the tolerance."""
    for case, report in reports:
        solution = case.solution
        assert report.cost == pytest.approx(solution.cost, rel=1e-9, abs=1e-13 * report.scale), case
        assert report.residual < 1e-12, case
        assert report.decrease < TOLERANCE, case
        if solution.cost > 1e-26 * report.scale:  # of less, they are shares of rounding
            assert report.stationarity < CANCELS * TOLERANCE**0.5, case
            # 1 %: at a box's edge, curvature jumps. What Newton's own model promises is of second order.
            assert solution.optimality == pytest.approx(report.decrease, rel=1e-2, abs=1e-8), case
        last = solution.iterations[-1]
        if last.method == "smooth":  # a step of Newton's method may well have been large: what the next promises is not
            assert abs(last.improvement) < TOLERANCE, case
        assert last.gap < 1e-3, case


def test_linear_quadratic_problems_are_solved_exactly(reports: list[tuple[Case, kkt.Report]]) -> None:
    """Against the KKT system of the whole horizon, to 1e-7 of what each problem spans."""
    for case, report in reports:
        if case.kind.startswith("linear"):
            plan = case.solution.trajectory
            for found, exact in ((plan.states, report.states), (plan.controls, report.controls)):
                np.testing.assert_allclose(
                    found, exact, rtol=0, atol=1e-7 * max(1.0, np.abs(exact).max()), err_msg=str(case)
                )


def test_what_other_endings_claim_is_so(cases: list[Case]) -> None:
    for case in cases:
        if case.converged:
            continue
        solution = case.solution
        assert solution.status in (
            Status.MAX_ITERATIONS, Status.DIVERGED, Status.NOT_FINITE, Status.NOT_POSITIVE_DEFINITE,
        ), case  # fmt: skip
        assert solution.remedy
        if solution.status is Status.MAX_ITERATIONS:
            assert len(solution.iterations) >= 500 or "line search" in solution.detail, case
            last = solution.iterations[-1]
            passed = (abs(last.improvement) < TOLERANCE, last.gap < 1e-3, solution.optimality < TOLERANCE)
            assert not all(passed), case
        elif solution.status is Status.DIVERGED:
            assert not np.isfinite(solution.cost), case
        else:
            assert "pass of iteration" in solution.detail or "rollout" in solution.detail, case
        if np.isfinite(solution.cost):
            cost, residual = kkt.recompute(case.problem, solution.trajectory, rate_of(case.kind))
            assert cost == pytest.approx(solution.cost, rel=1e-6), case
            assert residual < 1e-9, case


def test_a_smaller_tolerance_is_met_too(problems: ModuleType, cases: list[Case]) -> None:
    """At 1e-9, the slopes cancel to 6e-4 of their terms: what is left above was the tolerance's, not an error's."""
    some = [case for case in cases if case.index < 3 and case.converged and problems.family(case.kind) != "linear"]
    solutions = ls.smooth_many([case.problem for case in some], tolerance=1e-9)
    converged = 0
    for case, solution in zip(some, solutions, strict=True):
        if solution.status is Status.CONVERGED:
            report = kkt.check(case.problem, solution, rate_of(case.kind))
            assert report.decrease < 1e-9 * (1 + 1e-3), case
            assert report.stationarity < CANCELS * 1e-9**0.5, case
            converged += 1
    assert converged > 0.8 * len(some)


class TestOracle:
    """What the claims are held against is right itself."""

    def test_it_notices_a_plan_that_is_not_optimal(self, differential_drive: ls.Scenario) -> None:
        problem = replace(differential_drive.problem, control_limits=(-np.inf, np.inf))
        early = ls.ilqr(problem, max_iterations=2)
        report = kkt.check(problem, early)
        assert report.decrease > TOLERANCE
        assert report.decrease == pytest.approx(early.optimality, rel=1e-3)
        assert report.stationarity > CANCELS * TOLERANCE**0.5

    def test_it_finds_the_optimum_of_linear_quadratic_problems(self, problems: ModuleType) -> None:
        """Against a dense solver, with the Runge-Kutta step of a linear system written as a Taylor polynomial."""
        compared = 0
        for kind in (kind for kind in KINDS if problems.family(kind) == "linear"):
            for index in range(examples(32)):
                problem = problems.draw(kind, index)
                if isinstance(problem.initial, ls.FixedState):
                    continue
                states, controls, cost = solve_dense(matrices_of(problem))
                # From anywhere at all: the model of such a problem is the problem.
                report = kkt.check(problem, ls.smooth(problem, max_iterations=1, safeguard=False))
                np.testing.assert_allclose(report.states, states, rtol=0, atol=1e-8 * max(1.0, np.abs(states).max()))
                np.testing.assert_allclose(
                    report.controls, controls, rtol=0, atol=1e-8 * max(1.0, np.abs(controls).max())
                )
                assert report.cost * (1 - report.decrease) == pytest.approx(cost, rel=1e-6, abs=1e-12)
                compared += 1
        assert compared >= 8

    def test_the_classics_obey_physics(self, problems: ModuleType) -> None:
        """Power in is power stored: along the stated rates, energies written out here change by the work done."""
        rng = np.random.default_rng(0)
        for kind, energy in (("pendulum", pendulum_energy), ("cart_pole", cart_pole_energy), ("arm", links_energy),
                             ("acrobot", links_energy)):  # fmt: skip
            for index in range(5):
                dynamics = problems.draw(kind, index).dynamics
                n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
                x, u = rng.normal(size=n), rng.normal(size=m)
                rate = dynamics.rate(x, u)
                changed = energy(x + 1e-30j * rate, dynamics.parameters).imag / 1e-30
                turns = x[n // 2 :]
                driven = turns[:1] if kind == "cart_pole" else turns[-m:]
                friction = dynamics.parameters.get("friction", 0.0)
                assert changed == pytest.approx(driven @ u - friction * turns @ turns, rel=1e-9, abs=1e-9), kind

    def test_the_car_rolls_where_its_front_wheels_point(self, problems: ModuleType) -> None:
        dynamics = problems.draw("car", 0).dynamics
        x, u, axles = np.array([0.3, -0.2, 0.7, 1.3]), np.array([0.4, 0.1]), dynamics.parameters["axles"]
        rate = dynamics.rate(x, u)
        front = rate[:2] + axles * rate[2] * np.array([-np.sin(x[2]), np.cos(x[2])])
        np.testing.assert_allclose(front, x[3] * np.array([np.cos(x[2] + u[0]), np.sin(x[2] + u[0])]), atol=1e-12)


def pendulum_energy(x: Array, p: dict[str, float]) -> Array:
    return p["mass"] * ((p["length"] * x[1]) ** 2 / 2 + p["gravity"] * p["length"] * np.cos(x[0]))


def cart_pole_energy(x: Array, p: dict[str, float]) -> Array:
    right, up = x[2] + p["length"] * x[3] * np.cos(x[1]), -p["length"] * x[3] * np.sin(x[1])
    moving = p["cart"] * x[2] ** 2 / 2 + p["pole"] * (right**2 + up**2) / 2
    return moving + p["pole"] * p["gravity"] * p["length"] * np.cos(x[1])


def links_energy(x: Array, p: dict[str, float]) -> Array:
    """Of two uniform rods that hang at zero."""
    along, turn, half = x[0] + x[1], x[2] + x[3], p["length"] / 2
    right = p["length"] * x[2] * np.cos(x[0]) + half * turn * np.cos(along)
    up = p["length"] * x[2] * np.sin(x[0]) + half * turn * np.sin(along)
    spinning = (x[2] ** 2 + turn**2) * p["length"] ** 2 / 12
    moving = ((half * x[2]) ** 2 + right**2 + up**2 + spinning) / 2
    height = -half * np.cos(x[0]) - p["length"] * np.cos(x[0]) - half * np.cos(along)
    return p["mass"] * (moving + p["gravity"] * height)
