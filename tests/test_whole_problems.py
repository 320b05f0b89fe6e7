"""Whole problems drawn at random: nothing that a solution claims is false; and what once was is not any more."""

import dataclasses
from collections.abc import Callable

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from oracle import planar_quadrotor
from sampling import examples, rarely
from whole_problems import dense, draws, families, known
from whole_problems.claims import contradictions

import lqrsim as ls
from lqrsim.results.solution_parts import Curvature, Status

# Each kind is compiled where nothing is cached, some 5 seconds. Most of these are so by other tests, too; those that
# are left out have nothing that these have not, and benchmark_claims.py draws them by the hundred.
KINDS = ("linear", "pendulum", "parking", "planar", "tracking", "drive", "quadrotor")


@pytest.mark.parametrize(
    ("kinds", "count"), [(KINDS[-4:], 12), pytest.param(KINDS, 200, marks=pytest.mark.long)], ids=("some", "all")
)
def test_nothing_that_a_solution_claims_is_false(kinds: tuple[str, ...], count: int) -> None:
    @settings(max_examples=count, suppress_health_check=[HealthCheck.too_slow])
    @given(kind=st.sampled_from(kinds), number=st.integers(0, 2**32 - 1))
    def holds(kind: str, number: int) -> None:
        drawn = draws.draw(kind, number)
        for solution in draws.solve(drawn):
            assert contradictions(drawn.problem, solution, drawn.rate) == [], f"{drawn}: {solution.status.name}"

    holds()


def test_a_large_penalty_does_not_spoil_the_certified_cost() -> None:
    """Far from a goal the augmented Lagrangian adds 1e13 times the cost, of which rounding was left."""
    drawn = draws.draw("parking", 4285210)
    for solution in draws.solve(drawn):
        assert contradictions(drawn.problem, solution, drawn.rate) == []


def test_rows_without_an_obstacle_give_no_warning() -> None:
    """Their size is infinite and their multiplier 0: the product was an invalid value."""
    drawn = draws.draw("parking", 255)
    for solution in draws.solve(drawn):
        assert contradictions(drawn.problem, solution, drawn.rate) == []


def test_a_plan_that_needs_one_more_iteration_says_so() -> None:
    """The interior point had ended with the last iteration that was allowed, inside the constraints: NOT_CERTIFIED."""
    drawn = draws.draw("tracking", 1501)
    solutions = draws.solve(drawn)
    assert [contradictions(drawn.problem, solution, drawn.rate) for solution in solutions] == [[] for _ in solutions]
    assert Status.MAX_ITERATIONS in {solution.status for solution in solutions}


def test_every_kind_can_be_drawn() -> None:
    assert set(KINDS) < set(draws.KINDS)
    for kind in draws.KINDS:
        assert draws.draw(kind, 0).problem.steps > 0


def test_a_draw_does_not_depend_on_what_else_is_drawn() -> None:
    assert draws.draw("car", 5).problem.digest == draws.draw("car", 5).problem.digest
    digests = {draws.draw("car", number).problem.digest for number in range(20)}
    assert len(digests) == 20


@pytest.mark.parametrize("kind", known.KINDS)
def test_what_is_known_beforehand_is_found(kind: str) -> None:
    """A sample of what benchmark_claims.py draws: all that can be solved is, and nothing that is said is false."""
    for number in range(examples(4)):
        drawn = known.draw(kind, number)
        solution = ls.smooth(drawn.problem, start=drawn.start)
        assert known.false(drawn, solution) == [], f"{kind} {number}"
        assert solution.success == drawn.possible, f"{kind} {number}"


SLOW = "contact", "overflow", "scales", "saturating", "units", "wide"  # seconds each


@pytest.mark.parametrize("kind", [*(one for one in families.KINDS if one not in SLOW), *rarely(*SLOW)])
def test_no_family_misleads(kind: str) -> None:
    """No plan is worse than its start, a saddle, improved by a step of iLQR though STALLED, or NaN without a word."""

    @settings(
        max_examples=examples(40) if kind != "time" else examples(12), suppress_health_check=[HealthCheck.too_slow]
    )
    @given(number=st.integers(0, 2**32 - 1))
    def holds(number: int) -> None:
        case = families.draw(kind, number)
        solution = ls.smooth(case.problem, start=case.given, threads=1)
        assert dense.contradictions(case, solution) == [], f"{case}: {solution}"

    holds()


@pytest.mark.parametrize("number", [7040, 7048, 7084, 7090, 7250, 7269, 65536])
def test_states_of_micrometres_have_sizes_of_their_own(number: int) -> None:
    """Typical sizes of 1 m made curvatures of minima count as zero."""
    case = families.draw("scales", number)
    solution = ls.smooth(case.problem, start=case.given, threads=1)
    assert solution.curvature is Curvature.MINIMUM
    assert dense.contradictions(case, solution) == []


@pytest.mark.parametrize("number", [6, 17, 18, 26, 33, 37, 38, 42, 46])
def test_saddles_are_seen_in_all_units(number: int) -> None:
    """A length at rest had a size of 1 beside others of 1e5: the curvature along it counted as zero."""
    case = families.draw("units", number)
    solution = ls.smooth(case.problem, start=case.given, threads=1)
    assert dense.contradictions(case, solution) == []


@pytest.mark.parametrize("number", [1, 6, 7, 9, 17, 18, 20, 27, 34, 36])
def test_limits_far_beyond_what_is_needed_measure_nothing(number: int) -> None:
    """With 1e9 in place of infinity, all curvatures counted as zero, and plans began far from the answer."""
    case = families.draw("wide", number)
    solution = ls.smooth(case.problem, start=case.given, threads=1)
    assert solution.success
    assert dense.contradictions(case, solution) == []


@pytest.mark.long
def test_a_plan_beside_a_cheaper_one_leaves_its_contact_modes() -> None:
    """Within its contact modes the plan was optimal; of the plans beside it one was cheaper, and it was STALLED."""
    case = families.draw("contact", 1080)
    solution = ls.smooth(case.problem, start=case.given, threads=1)
    assert dense.contradictions(case, solution) == []


def test_the_check_of_families_can_fail() -> None:
    """iLQR keeps to a symmetric start, and so ends at the saddle; other claims are made false by hand."""
    case = next(one for one in (families.draw("symmetric", i) for i in range(99)) if not one.problem.constraints)
    saddle, minimum = ls.ilqr(case.problem), ls.smooth(case.problem)
    assert saddle.success
    assert minimum.curvature is Curvature.MINIMUM
    assert minimum.cost < saddle.cost
    assert ["a saddle" in one for one in dense.contradictions(case, saddle)] == [True]
    worse = dataclasses.replace(case, given=minimum)
    assert "worse than its start" in dense.contradictions(worse, dataclasses.replace(saddle, status=Status.STALLED))[0]
    several = ((one, ls.smooth(one.problem)) for one in (families.draw("flat", i) for i in range(99)))
    flat, plateau = next(pair for pair in several if pair[1].curvature is Curvature.SINGULAR)
    claimed = dataclasses.replace(plateau.certificate, curvature=Curvature.MINIMUM)
    assert "no minimum" in dense.contradictions(flat, dataclasses.replace(plateau, certificate=claimed))[0]
    early = dataclasses.replace(ls.smooth(case.problem, max_iterations=1, safeguard=False), status=Status.STALLED)
    assert "a step lowers the cost" in dense.contradictions(case, early)[0]
    lost = np.full_like(early.trajectory.states, np.nan)
    assert "not finite" in dense.contradictions(case, _with_plan(early, states=lost))[0]


@pytest.mark.parametrize("kind", ["given", "symmetric", "flat", *rarely("saturating", "scales")])
def test_a_plan_beside_an_optimum_is_none(kind: str) -> None:
    """Controls that are inside their limits are moved by a hundredth; where that costs nothing, nothing is said."""

    @settings(max_examples=examples(20), suppress_health_check=[HealthCheck.too_slow])
    @given(number=st.integers(0, 2**32 - 1))
    def holds(number: int) -> None:
        case = dataclasses.replace(families.draw(kind, number), given=None)
        solution = ls.smooth(case.problem, threads=1)
        controls, rng = solution.trajectory.controls, np.random.default_rng(number)
        inside = (controls > case.low) & (controls < case.high)
        moved = controls + 1e-2 * np.abs(controls).max() * rng.normal(size=controls.shape) * inside
        moved = np.clip(moved, case.low, case.high)
        cost = float(case.cost(moved))
        if solution.status is not Status.CONVERGED or case.problem.constraints or not cost > 1.001 * solution.cost > 0:
            return
        beside = _with_plan(solution, states=case.roll(moved), controls=moved)
        certificate = dataclasses.replace(solution.certificate, cost=cost)
        found = dense.contradictions(case, dataclasses.replace(beside, certificate=certificate))
        assert any("could still be saved" in one or "saddle" in one for one in found), f"{case}: {found}"

    holds()


def test_what_is_known_otherwise_is_noticed() -> None:
    drawn = known.draw("weights", 0)
    solution = ls.smooth(drawn.problem)
    assert drawn.controls is not None
    other = dataclasses.replace(drawn, controls=1.0001 * drawn.controls)
    assert "off by" in known.false(other, solution)[0]
    assert "no plan" in known.false(dataclasses.replace(drawn, possible=False), solution)[0]
    assert (
        "takes" in known.false(dataclasses.replace(drawn, duration=1.0001 * solution.trajectory.horizon), solution)[0]
    )
    refused = dataclasses.replace(solution, status=Status.INFEASIBLE)
    assert "INFEASIBLE" in known.false(drawn, refused)[0]


Case = tuple[ls.Problem, ls.Solution]


@pytest.fixture(scope="module")
def case() -> Case:
    problem = planar_quadrotor.problem((-1.2, 0.1), (1.6, 0.3), steps=150)
    solution = ls.smooth(problem)
    assert solution.status is Status.CONVERGED
    assert contradictions(problem, solution) == []
    return problem, solution


class TestTheCheckCanFail:
    """Each claim of a right solution, made false by a little."""

    @pytest.mark.parametrize(
        ("spoil", "says"),
        [
            (lambda s: _with_plan(s, states=s.trajectory.states + 1e-6), "begins at"),
            (lambda s: _with_plan(s, controls=s.trajectory.controls + 7.0), "beyond its limits"),
            (lambda s: _with_plan(s, controls=s.trajectory.controls * (1 - 1e-6)), "not the policy's"),
            (lambda s: _with_plan(s, states=_bent(s.trajectory.states)), "off the dynamics"),
            (lambda s: _certified(s, cost=s.cost * (1 + 1e-6)), "costs"),
            (lambda s: _certified(s, violation=1e-6), "misses a constraint"),
            (lambda s: _slack(s), "could still be saved"),
            (lambda s: dataclasses.replace(s, options={**s.options, "max_iterations": 2}), "iterations, with"),
        ],
    )
    def test_and_says_what_is_false(self, case: Case, spoil: Callable, says: str) -> None:
        problem, solution = case
        assert any(says in wrong for wrong in contradictions(problem, spoil(solution)))


def _with_plan(solution: ls.Solution, **parts: np.ndarray) -> ls.Solution:
    return dataclasses.replace(solution, trajectory=dataclasses.replace(solution.trajectory, **parts))


def _bent(states: np.ndarray) -> np.ndarray:
    bent = states.copy()
    bent[7, 3] += 1e-4
    return bent


def _certified(solution: ls.Solution, **numbers: float) -> ls.Solution:
    return dataclasses.replace(solution, certificate=dataclasses.replace(solution.certificate, **numbers))


def _slack(solution: ls.Solution) -> ls.Solution:
    """A plan that is run exactly, and not the best."""
    controls = np.clip(solution.trajectory.controls + np.array([0.05, 0.05]), 0.0, 6.0)
    states = [solution.trajectory.states[0]]
    for control in controls:
        states.append(planar_quadrotor.dynamics().step(states[-1], control, planar_quadrotor.DT))
    policy = dataclasses.replace(solution.policy, gain=np.zeros_like(solution.policy.gain), offset=controls)
    return dataclasses.replace(_with_plan(solution, states=np.array(states), controls=controls), policy=policy)


@pytest.mark.parametrize(("kind", "number"), [("quadrotor", 14610)])
def test_a_failed_interior_point_leaves_a_failed_plan_and_its_policy_as_they_were(kind: str, number: int) -> None:
    """Found by many draws: smoothing from a start of a cost of 1e115 fails, and then the interior point, too."""
    drawn = draws.draw(kind, number)
    for solution in draws.solve(drawn):
        assert contradictions(drawn.problem, solution, drawn.rate) == []
        assert solution.cost <= solution.iterations[0].cost
