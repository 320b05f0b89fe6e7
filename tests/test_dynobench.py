"""The problems of dynobench, as stated for lqrsim, and the check that is independent of it."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import dynobench
import numpy as np
import pytest
from kinodynamic import check, outside, statements
from kinodynamic.data import CASES, MODELS, Case
from kinodynamic.variants import drawn, mirrored
from sampling import rarely
from scipy.optimize import minimize

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.solvers import free_duration
from lqrsim.solvers.multistart import Way

BY_ROBOT = {case.robot: case for case in CASES.values()}
PARKING, EMPTY = CASES["unicycle1_v0/parallelpark_0"], CASES["quad2d_v0/empty_0"]


def drawn_states(robot: str) -> tuple[Array, Array]:
    """States (20, n) and controls (20, m) within their limits."""
    rng, model = np.random.default_rng(0), MODELS[robot]
    low, high = np.array(list(model.limits.values())).T
    return rng.normal(size=(20, len(model.states))), rng.uniform(low, high, (20, len(low)))


def test_there_are_43() -> None:
    assert len(CASES) == 43
    assert all(case.published is not None for case in CASES.values())


@pytest.mark.parametrize("robot", [one for one in MODELS if one.endswith("v0")] + rarely("quadrotor_v1"))
def test_rates_and_steps_are_those_of_the_check(robot: str) -> None:
    """To 1e-12 of the largest entry: the formulas differ, so what remains is rounding."""
    case, model, dynamics = BY_ROBOT[robot], MODELS[robot], statements.dynamics(robot)
    for x, u in zip(*drawn_states(robot), strict=True):
        theirs = check.in_their_states(case, x)
        rate, wanted = dynamics.rate(x, u), check.rate(robot, theirs, u)
        if model.radius is not None:  # quaternions move as the rotation vector does
            ahead, behind = (check.quaternion(x[6:9] + side * 1e-6 * rate[6:9]) for side in (1, -1))
            np.testing.assert_allclose((ahead - behind) / 2e-6, wanted[3:7], atol=1e-8)
            rate, wanted = np.delete(rate, range(6, 9)), np.delete(wanted, range(3, 7))
        np.testing.assert_allclose(rate, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())
        step, wanted = statements.euler_dynamics(robot).step(theirs, u, model.period), check.euler_step(case, theirs, u)
        np.testing.assert_allclose(step, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())


@pytest.mark.parametrize("name", ["acrobot_v0/swing_up_obs_hard", *rarely("car1_v0/kink_0", "quad2dpole_v0/window")])
def test_boxes_of_the_statement_are_as_far_apart_as_those_of_the_check(name: str) -> None:
    """To rounding, apart and overlapping."""
    case, rng = CASES[name], np.random.default_rng(1)
    x = rng.uniform(-1.0, 1.0, (20, len(case.goal)))
    x[:, : len(case.low)] = rng.uniform(case.low, case.high, (20, len(case.low)))
    x[:, : 0 if len(case.low) else 2] *= np.pi
    (stated,) = statements.clear_of(case, 0.0)
    assert isinstance(stated, ls.Clearance)
    shape, wanted = stated.in_world(statements.dynamics(case.robot)), check.clearances(case, x)
    np.testing.assert_allclose(shape.clearance(shape.places(x)), wanted, atol=1e-12)
    assert wanted.min() < 0 < wanted.max()


def test_boxes_are_as_far_apart_as_a_minimiser_finds_them() -> None:
    """Over a point in each box: to 1e-6, SLSQP's accuracy of a distance."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        x, y, angle, *size = rng.uniform([-2, -2, 0, 0.2, 0.2], [2, 2, 3, 1, 1])
        box, other = check._corners(x, y, angle, *size), check._corners(0, 0, 0, 1.0, 0.5)
        sides, corner = np.stack([box[0] - box[1], box[1] - box[2]]), box[2]

        found = minimize(
            lambda z, sides=sides, corner=corner: np.sum((corner + z[:2] @ sides - z[2:]) ** 2),
            [0.5, 0.5, 0.0, 0.0], bounds=[(0, 1), (0, 1), (-0.5, 0.5), (-0.25, 0.25)], method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 500},
        )  # fmt: skip
        assert max(check.apart(box, other), 0.0) == pytest.approx(np.sqrt(found.fun), abs=1e-6)


@pytest.mark.parametrize("case", rarely(EMPTY, PARKING))
def test_all_statements_pass_and_none_is_slower_than_the_published(case: Case) -> None:
    row = dynobench.solve(case, statements=["exact", "euler"])
    for name in ("exact", "euler"):
        assert row[name]["status"] == "CONVERGED"
        assert not dynobench.passed(name, row[name])
        assert row[name]["time"] <= row["published"] + 1e-9
    assert not dynobench.false({"rows": [row]})
    assert "CONVERGED 1 of 1, 1 of them at or below" in dynobench.report({"rows": [row]})


@pytest.mark.long
def test_a_plan_between_corners_is_no_saddle() -> None:
    """The curvature of corners that touch has no bound. From beside the plan no faster one is found."""
    case = CASES["unicycle2_v0/kink_0"]
    problem = statements.in_least_time(case)
    solution = ls.smooth(problem, time_limit=600)
    assert solution.status is ls.Status.CONVERGED
    assert solution.curvature == "minimum"
    assert case.published is not None
    assert solution.trajectory.horizon < case.published
    rng, plan = np.random.default_rng(0), solution.trajectory
    for size in (1e-3, 1e-2):
        beside = replace(plan, controls=plan.controls + size * rng.normal(size=plan.controls.shape))
        again = ls.smooth(problem, start=beside, time_limit=600)
        assert again.trajectory.horizon > plan.horizon - 1e-4


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["unicycle1_v2/wall_0", "car1_v0/bugtrap_0", "acrobot_v0/swing_up_empty", "quadrotor_v0/recovery"]
)
def test_no_plan_of_these_is_found_along_the_first_sketches(name: str) -> None:
    """They take another duration, a duration a part of the way, or another axis; the published plan is no faster."""
    case = CASES[name]
    solution = ls.smooth(statements.in_least_time(case), time_limit=600)
    assert solution.status is ls.Status.CONVERGED
    assert case.published is not None
    assert solution.trajectory.horizon < case.published


@pytest.mark.long
def test_a_plan_that_pushes_against_many_limits_is_certified(monkeypatch: pytest.MonkeyPatch) -> None:
    """An acrobot that swings for long, along which errors grow 1e9-fold, so that no Newton step improves the plan.

    What the interior point leaves of each row then adds up to more than the tolerance, unless it goes on.
    """
    found = free_duration.ways

    def one(*arguments: Any) -> Iterator[Way]:
        yield from (way for way in found(*arguments) if way.name.endswith("a turn more of q1 and q2"))

    monkeypatch.setattr(free_duration, "ways", one)
    monkeypatch.setattr(free_duration, "SKETCHED", ((2.0, False),))
    solution = ls.smooth(statements.in_least_time(CASES["acrobot_v0/swing_up_empty"]), time_limit=600)
    assert solution.trajectory.horizon == pytest.approx(6.3658, abs=1e-4)
    assert solution.status is ls.Status.CONVERGED


@pytest.mark.long
def test_the_search_from_outside_leaves_a_trap() -> None:
    """A straight line leads nowhere there. Its first plan need not be the fastest, but one of its first two is."""
    case = CASES["unicycle1_v0/bugtrap_0"]
    plans = [
        ls.smooth(problem, start=start, threads=1, max_iterations=200)
        for problem, start in itertools.islice(outside.starts(case), 2)
    ]
    assert case.published is not None
    assert min(plan.trajectory.horizon for plan in plans if plan.success) < case.published
    plan = outside.found(case)
    assert plan is not None
    assert plan.success


def test_the_check_finds_what_is_wrong() -> None:
    straight = np.tile([0.5, 0.0], (31, 1))  # through the parked cars' side, and past the goal
    found = check.exactly(PARKING, straight, 0.1)
    assert found["goal"] > 0.1
    states = [PARKING.start]
    for u in straight:
        states.append(check.euler_step(PARKING, states[-1], u))
    plan = np.array(states)
    assert check.by_euler(PARKING, plan, straight)["jump"] == 0.0
    assert check.by_euler(PARKING, plan, 1.1 * straight)["controls"] == pytest.approx(0.05)
    plan[3] += [0.0, -0.4, 0.0]
    assert check.by_euler(PARKING, plan, straight)["jump"] == pytest.approx(0.4)
    assert check.failures(check.by_euler(PARKING, plan, straight), check.ACCEPTED)


@pytest.mark.parametrize("robot", ["car1_v0", "quad2dpole_v0", "quadrotor_v0", "acrobot_v0"])
def test_the_mirror_image_of_a_motion_is_one(robot: str) -> None:
    """To rounding, with the controls that turn it the other way."""
    case = BY_ROBOT[robot]
    signs = np.sign(mirrored(replace(case, start=np.ones_like(case.start))).start)
    turns = {"car1_v0": [1, -1], "acrobot_v0": [-1]}.get(robot)
    order = {"quad2dpole_v0": [1, 0], "quadrotor_v0": [1, 0, 3, 2]}.get(robot)
    for x, u in zip(*drawn_states(robot), strict=True):
        other = u[order] if order else u * turns
        rate = statements.dynamics(robot).rate
        np.testing.assert_allclose(rate(signs * x, other), signs * rate(x, u), atol=1e-9, rtol=1e-9)


def test_variants_begin_and_end_clear_of_their_boxes() -> None:
    for case in (one for one in CASES.values() if len(one.boxes)):
        first, second = drawn(case, 2, seed=0)
        assert first.name != second.name
        for one in (first, second):
            ends = check.in_their_states(one, np.stack([one.start, one.goal]))
            assert check.clearances(one, ends).min() > 0.04
            assert check.excess(one, ends) <= 0.0
