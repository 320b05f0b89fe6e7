"""Parking: what is known about each case is so, nothing false is said about it, and what is false is noticed."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from parking import cases, descent, judge, outcomes
from parking.cases import Case, Plan
from parking.task import Shape, Task, problem_of
from sampling import rarely

import lqrsim as ls

# Half of them have a plan that is hard to find: without any trailer, with one and with two, beside the road and along
# it, some begin in an obstacle. Of the others each has none for another reason. benchmark_parking.py has two thousand.
SAMPLE = (34, 94, 119, 201, 222, 554, 38, 42, 61, 69, 95, 133)
SOLVED = (34, 42)  # of these: with a plan and without, each of another structure


@pytest.mark.long
def test_nothing_false_is_said() -> None:
    """However few are solved within so many iterations."""
    found = [outcomes.look(one, improve=True, time_limit=None, max_iterations=80) for one in SOLVED]
    assert [(one.number, one.verdict, one.said) for one in found if one.verdict not in ("right", "unsolved")] == []
    assert "CONVERGED" in {one.status for one in found if one.verdict == "right"}


@pytest.mark.parametrize("number", rarely(1, 5))
def test_a_goal_that_is_reached_exactly_may_have_any_weight(number: int) -> None:
    """The final cost is the same for all plans that end there, so weights from 1 to 5000 lead to one plan."""
    task = cases.draw(number).task
    assert task.exact
    plans = [ls.smooth(problem_of(replace(task, weight=weight)), threads=1) for weight in (1.0, 50.0, 5000.0)]
    assert {plan.status for plan in plans} == {ls.Status.CONVERGED}
    np.testing.assert_allclose([plan.cost for plan in plans], plans[0].cost, rtol=1e-6)


@pytest.mark.parametrize("number", [94, *rarely(49, 68, 178)])
def test_a_plan_that_is_hard_to_find_is_found(number: int) -> None:
    """What is missed can be stationary, or a descent at a price end at the first plan, which costs a thousand times as
    much.
    """
    found = outcomes.look(number)
    assert (found.verdict, found.status) == ("right", "CONVERGED"), found.said
    assert found.known is not None
    assert found.cost < found.known


def test_where_all_starts_are_stuck_at_one_obstacle_a_motion_around_it_is_found() -> None:
    """The least violation behind a post is stationary, and all controls that do not steer around it lead there."""
    found = outcomes.look(1709, time_limit=None)
    assert (found.verdict, found.status) == ("right", "CONVERGED"), found.said


def backed(
    *start: float, weight: float, gap: float = 6.0, steps: int = 20, repulsion: tuple[float, float] | None = None
) -> Task:
    """A car that backs its trailer between two parked cars from a place, with a heading along the road."""
    cars = [Shape(f"{x:+}", False, np.array([x * gap / 2, -0.5]), np.pi / 2, (1.3, 0.9)) for x in (-1, 1)]
    return Task(
        wheelbase=2.7, trailers=(3.0,), dt=20.0 / steps, steps=steps, start=np.array([*start, 0.0, 0.0, 0.0]),
        goal=np.array([0.0, 1.5, np.pi / 2, 0.0, 0.0]), exact=True, weight=weight, effort=np.array([0.5, 0.5]),
        obstacles=tuple(cars), repulsion=repulsion, clearance=0.02, top=np.array([1.5, 0.8]),
        bounds=np.array([0.6, 0.8]), road=(-100.0, 100.0),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("gap", "weight", "steps"), rarely((6.0, 20.0, 20), (6.0, 1.0, 20), (5.0, 500.0, 20), (5.0, 5000.0, 25))
)
def test_a_car_beside_a_gap_backs_its_trailer_into_it(gap: float, weight: float, steps: int) -> None:
    """It has to drive on first. What is missed by plans that only turn is stationary, and they are where all other
    starts lead.
    """
    task = backed(-1.0, 4.5, gap=gap, weight=weight, steps=steps)
    solution = ls.smooth(problem_of(task), threads=1)
    assert solution.status is ls.Status.CONVERGED, solution
    assert judge.examine(task, solution.trajectory.states, solution.trajectory.controls).wrong == []


@pytest.mark.parametrize(
    ("x", "y", "weight"), [(6.0, 5.0, 5000.0), *rarely((4.0, 4.5, 5000.0), (6.0, 5.0, 20.0), (-1.0, 4.5, 20.0))]
)
def test_of_plans_that_miss_something_the_best_is_returned_and_says_it(x: float, y: float, weight: float) -> None:
    """A few iterations from seven starts miss no more than from one of them, to two digits, by the judge's measure."""
    task = backed(x, y, weight=weight, repulsion=(1.0, 10.0))
    for most in (10, 20, 40):
        missed: list[float] = []
        for starts in (None, 1):
            solution = ls.smooth(problem_of(task), starts=starts, max_iterations=most, threads=1)
            assert solution.status is ls.Status.MAX_ITERATIONS
            found = judge.examine(task, solution.trajectory.states, solution.trajectory.controls)
            missed.append(max(found.kept, found.goal))
            assert missed[-1] == pytest.approx(solution.violation, rel=1e-6)
            assert f"violation: {solution.violation:.1e}" in str(solution)
        assert missed[0] <= 1.05 * missed[1]


@pytest.mark.parametrize("number", rarely(13, 133))
def test_what_has_no_plan_is_infeasible(number: int) -> None:
    found = outcomes.look(number)
    assert (found.verdict, found.status) == ("right", "INFEASIBLE"), found.said


def test_what_is_known_is_so() -> None:
    drawn = [cases.draw(number) for number in SAMPLE]
    assert all(case.proved for case in drawn)
    assert [case.plan is None for case in drawn] == [bool(case.reason) for case in drawn] == [False] * 6 + [True] * 6
    possible, impossible = drawn[:6], drawn[6:]
    assert {case.impossible for case in impossible} == set(cases.PROOFS) - {"occupied", "road"}
    assert {len(case.task.trailers) for case in possible} == {0, 1, 2}
    assert {case.task.exact for case in possible} == {False, True}
    assert {case.task.repulsion is None for case in possible} == {False, True}
    assert {case.begins for case in possible} == {"clear", "in a margin", "in an obstacle"}
    for case in possible:
        assert (judge.spare(case.task, case.task.start).min() >= 0) == (case.begins == "clear")


def test_a_case_does_not_depend_on_what_else_is_drawn() -> None:
    assert problem_of(cases.draw(5).task).digest == problem_of(cases.draw(5).task).digest
    assert len({problem_of(cases.draw(number).task).digest for number in range(3)}) == 3


@pytest.mark.parametrize("name", cases.PROOFS)
def test_each_proof_can_fail(name: str) -> None:
    """Of a case that has a plan no proof says that it has none."""
    drawn = (cases.draw(number, impossible=0.0) for number in itertools.count())
    assert all(cases.PROOFS[name](case.task) < 0 for case in itertools.islice(drawn, 3))


@pytest.fixture(scope="module")
def case() -> Case:
    """With a trailer, and a goal that is to be reached exactly."""
    drawn = (cases.draw(number, impossible=0.0) for number in itertools.count())
    return next(one for one in drawn if one.task.exact and one.task.trailers)


class TestTheJudge:
    """It knows the problem's geometry, motion and cost, and refuses a plan that is off by a little."""

    def test_geometry_is_the_package_s(self, case: Case) -> None:
        world = ls.World([shape.obstacle for shape in case.task.obstacles])
        places = np.random.default_rng(0).uniform(-8, 8, size=(200, 2))
        away = np.stack([judge.distance(shape, places) for shape in case.task.obstacles], axis=-1)
        np.testing.assert_allclose(away, [world.distances([*place, 0.0]) for place in places], rtol=0, atol=1e-12)
        assert case.plan is not None
        problem = problem_of(case.task)
        clearance = problem.constraints[0]
        assert isinstance(clearance, ls.Clearance)
        assert clearance.balls is not None
        centres = clearance.balls.centres(problem.dynamics, case.plan.states)
        np.testing.assert_allclose(centres[..., :2], judge.balls(case.task, case.plan.states), rtol=0, atol=1e-12)

    def test_motion_is_the_package_s(self, case: Case) -> None:
        assert case.plan is not None
        dynamics, plan = problem_of(case.task).dynamics, case.plan
        stepped = [dynamics.step(*pair, case.task.dt) for pair in zip(plan.states[:-1], plan.controls, strict=True)]
        np.testing.assert_allclose(stepped, plan.states[1:], rtol=0, atol=1e-12)

    @pytest.mark.parametrize(
        ("spoil", "says"),
        [
            (lambda case, plan: replace(plan, states=_moved(plan, 0, 2, 1e-12)), "start"),
            (lambda case, plan: replace(plan, states=_moved(plan, 7, 3, 1e-6)), "motion"),
            (lambda case, plan: replace(plan, controls=1.1 * plan.controls), "motion"),
            (lambda case, plan: replace(plan, controls=plan.controls + case.task.top), "limits"),
            (lambda case, plan: replace(plan, states=_moved(plan, -1, 0, 1e-5)), "goal"),
            (lambda case, plan: replace(plan, states=_moved(plan, 9, 4, 2 * case.task.bounds[1])), "kept"),
            (lambda case, plan: replace(plan, states=_moved(plan, 9, 1, 50.0)), "kept"),
            (lambda case, plan: replace(plan, states=np.full_like(plan.states, np.nan)), "kept"),
        ],
    )
    def test_and_says_what_is_missed(self, case: Case, spoil: Callable[[Case, Plan], Plan], says: str) -> None:
        assert case.plan is not None
        assert judge.examine(case.task, case.plan.states, case.plan.controls).wrong == []
        spoiled = spoil(case, case.plan)
        wrong = judge.examine(case.task, spoiled.states, spoiled.controls).wrong
        assert any(one.startswith(says) for one in wrong)

    @pytest.mark.parametrize("index", range(4))
    def test_a_plan_through_an_obstacle_is_refused(self, case: Case, index: int) -> None:
        assert case.plan is not None
        place = judge.balls(case.task, case.plan.states)[case.task.steps // 2, 1]
        shapes = list(case.task.obstacles)
        shapes[index] = replace(shapes[index], place=place)
        task = replace(case.task, obstacles=tuple(shapes))
        assert judge.examine(task, case.plan.states, case.plan.controls).kept > 0.5

    def test_a_plan_that_is_not_the_cheapest_is_noticed(self, case: Case) -> None:
        """What the known plan costs more than it has to, and what is cheaper keeps all there is to keep."""
        assert case.plan is not None
        assert descent.saved(case.task, case.plan.controls) > outcomes.COULD_BE_SAVED


def test_false_answers_are_called_so(case: Case) -> None:
    """Of a task that is easy: nothing is in the way, and the goal is only weighed."""
    shapes = tuple(replace(shape, place=shape.place - np.array([0.0, 200.0])) for shape in case.task.obstacles)
    free = {"obstacles": shapes, "bounds": np.full(len(case.task.bounds), 1.2), "road": (-100.0, 100.0)}
    easy = replace(case, task=replace(case.task, **free, exact=False, weight=10.0, repulsion=None))
    solution = ls.smooth(problem_of(easy.task), threads=1)
    assert solution.status is ls.Status.CONVERGED
    plan = solution.trajectory
    np.testing.assert_allclose(judge.cost(easy.task, plan.states, plan.controls), solution.cost, rtol=1e-9)
    assert outcomes.verdict_of(easy, solution, improve=True) == ("right", "")
    infeasible = replace(solution, status=ls.Status.INFEASIBLE)
    assert outcomes.verdict_of(easy, infeasible)[0] == "false INFEASIBLE"
    without = replace(easy, plan=None, impossible="road")
    assert outcomes.verdict_of(without, infeasible)[0] == "right"
    assert outcomes.verdict_of(without, solution)[0] == "false CONVERGED"
    bent = replace(solution, trajectory=replace(plan, states=plan.states + 1e-4))
    assert outcomes.verdict_of(easy, bent)[0] == "false CONVERGED"
    stopped = replace(solution, status=ls.Status.MAX_ITERATIONS)
    assert outcomes.verdict_of(easy, stopped)[0] == "unsolved"


def _moved(plan: Plan, step: int, index: int, by: float) -> np.ndarray:
    states = plan.states.copy()
    states[step, index] += by
    return states
