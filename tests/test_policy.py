"""Running a policy: time, angles, limits."""

import dataclasses
import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.control.controllers import Feedback, evaluator, turn_to_nearest
from lqrsim.scenarios.solutions import digest_of_solution
from lqrsim.solvers import compiled


def test_on_the_plan_it_plays_the_plan(drive_solution: ls.Solution) -> None:
    plan = drive_solution.trajectory
    for t in (0, 1, 77, 149):
        control = drive_solution.policy(plan.states[t], plan.times[t])
        np.testing.assert_allclose(control, plan.controls[t], rtol=0, atol=1e-12)


def test_where_a_law_leads(drive_solution: ls.Solution, differential_drive: ls.Scenario) -> None:
    """Compiled, as in plain Python, also beside the plan and at the limits."""
    policy, problem = drive_solution.policy, differential_drive.problem
    state = drive_solution.trajectory.states[0] + (0.6, -0.5, 2.0)
    states, controls = compiled.rollout(problem, policy.gain, policy.offset, state)
    for t in range(problem.steps):
        np.testing.assert_allclose(states[t], state, rtol=0, atol=1e-9)
        control = problem.control_coordinates.clip(policy.control(state, t))
        np.testing.assert_allclose(controls[t], control, rtol=0, atol=1e-9)
        state = problem.dynamics.step(state, control, problem.dt)
    np.testing.assert_allclose(states[-1], state, rtol=0, atol=1e-9)
    low, high = problem.control_coordinates.low, problem.control_coordinates.high
    assert ((controls == low) | (controls == high)).any()


def test_knots_belong_to_the_law_that_begins_there(drive_solution: ls.Solution) -> None:
    """At t = k dt, however it was rounded, and until the next knot; after the horizon the last law stays."""
    policy, state = drive_solution.policy, drive_solution.trajectory.states[60]
    for step in range(150):
        for t in (step * policy.dt, step / 6, np.nextafter(step / 6, 0) if step else 0.0, (step + 0.99) * policy.dt):
            expected = policy.control_coordinates.clip(
                policy.control(policy.state_coordinates.nearest(state, policy.nominal[step]), step)
            )
            assert (policy(state, t) == expected).all()
    assert (policy(state, 25.0) == policy(state, 24.9)).all()
    assert (policy(state, 1e6) == policy(state, 24.9)).all()


def test_interpolation_meets_the_laws_at_the_knots(drive_solution: ls.Solution) -> None:
    policy, state = drive_solution.policy, drive_solution.trajectory.states[60] + 0.001
    for step in (0, 60, 149):
        assert policy(state, step / 6, interpolate=True) == pytest.approx(policy(state, step / 6), abs=1e-12)
    between = policy(state, 60.5 / 6, interpolate=True)
    expected = (policy.control(state, 60) + policy.control(state, 61)) / 2
    assert between == pytest.approx(np.clip(expected, -0.5, 0.5), abs=1e-9)


def test_whole_turns_change_nothing(drive_solution: ls.Solution, quadrotor_solution: ls.Solution) -> None:
    state = drive_solution.trajectory.states[10]
    for turns in (-3, 1, 2):
        turned = state + np.array([0, 0, 2 * np.pi * turns])
        assert drive_solution.policy(turned, 10 / 6) == pytest.approx(drive_solution.policy(state, 10 / 6), abs=1e-12)
    state = quadrotor_solution.trajectory.states[75]
    turned = state.copy()
    angle = np.linalg.norm(state[6:9])
    turned[6:9] *= (angle - 2 * np.pi) / angle
    assert (Rotation.from_rotvec(turned[6:9]) * Rotation.from_rotvec(state[6:9]).inv()).magnitude() < 1e-7
    assert quadrotor_solution.policy(turned, 2.5) == pytest.approx(quadrotor_solution.policy(state, 2.5), abs=1e-9)


def solved_by_lq(form: str) -> ls.Solution:
    stage = ls.lq.Stage(A=np.tile(np.eye(3), (9, 1, 1)), B=np.eye(3)[:, :2], R=np.eye(2), Q=np.eye(3))
    ends = ls.types.Quadratic(np.eye(3), np.ones(3), np.array(0.0))
    return ls.lq.smooth_lq(stage, initial=ends, final=ends, form=form)


@pytest.mark.parametrize(
    "solve",
    [
        lambda problem, solution: ls.smooth(problem, starts=1),
        lambda problem, solution: ls.smooth(problem, starts=1, form="primal"),
        lambda problem, solution: ls.ilqr(problem),
        lambda problem, solution: ls.prepare(problem).solve(solution.trajectory.states[0], solution),
        lambda problem, solution: solved_by_lq("dual"),
        lambda problem, solution: solved_by_lq("primal"),
        lambda problem, solution: (solution.trajectory, ls.track(problem, solution, tolerate=0.1)),
    ],
)
def test_what_is_written_into_a_plan_does_not_reach_its_policy(
    drive_solution: ls.Solution, differential_drive: ls.Scenario, solve: Callable[..., Any]
) -> None:
    """As angles that are converted in place for a plot; nor does it reach what a solution computes later."""
    found = solve(differential_drive.problem, drive_solution)
    plan, policy = found if isinstance(found, tuple) else (found.trajectory, found.policy)
    records = [policy]
    if not isinstance(found, tuple):
        others = (getattr(found, name, None) for name in ("inverse_policy", "cost_to_go", "cost_to_come"))
        records += [one for one in others if one is not None]
    arrays = [array for one in records for array in vars(one).values() if isinstance(array, np.ndarray)]
    assert len(arrays) >= 3
    assert not any(np.shares_memory(one, array) for one in (plan.states, plan.controls) for array in arrays)
    if isinstance(found, ls.Solution):
        again = solve(differential_drive.problem, drive_solution)
        state, before = plan.states[3].copy(), policy(plan.states[3], 0.5)
        again.trajectory.states[...] *= 180 / np.pi
        np.testing.assert_array_equal(again.policy(state, 0.5), before)
        if found.clearance is not None:
            np.testing.assert_array_equal(again.clearance, found.clearance)


def test_commands_keep_the_limits(drive_solution: ls.Solution) -> None:
    state = drive_solution.trajectory.states[0] + [5.0, 5.0, 0.0]
    control = drive_solution.policy(state, 0.0)
    assert (np.abs(control) <= 0.5).all()
    assert (np.abs(drive_solution.policy.control(state, 0)) > 0.5).any()


def test_many_states_at_once(quadrotor_solution: ls.Solution) -> None:
    policy, rng = quadrotor_solution.policy, np.random.default_rng(0)
    states = quadrotor_solution.trajectory.states[30] + 0.1 * rng.normal(size=(7, 12))
    together = policy(states, 1.0)
    for state, control in zip(states, together, strict=True):
        np.testing.assert_allclose(policy(state, 1.0), control, rtol=0, atol=1e-12)


@pytest.mark.parametrize("fixture", ["drive_solution", "quadrotor_solution"])
def test_the_compiled_law_is_the_one_in_numpy(request: pytest.FixtureRequest, fixture: str) -> None:
    """For states beside the plan, in any representative, within the limits and beyond them."""
    solution: ls.Solution = request.getfixturevalue(fixture)
    policy, rng = solution.policy, np.random.default_rng(0)
    space, limits = policy.state_coordinates, policy.control_coordinates
    evaluate = evaluator(policy)
    at_limits = []
    for step in (0, 40, policy.steps - 1):
        states = policy.nominal[step] + rng.normal(size=(50, len(space))) * rng.choice([0.01, 3.0], size=(50, 1))
        for i in space.angles:
            states[:, i] += 2 * np.pi * rng.integers(-2, 3, size=50)
        for i in space.rotation_vectors:
            angle = np.linalg.norm(states[:, i : i + 3], axis=1, keepdims=True)
            states[:, i : i + 3] *= 1 + 2 * np.pi * rng.integers(-2, 3, size=(50, 1)) / angle
        compiled_controls = evaluate(policy, step, states)
        controls = policy(states, step * policy.dt)
        # Gains of up to 3 on a dozen states of up to 20: rounding, not more.
        np.testing.assert_allclose(compiled_controls, controls, rtol=0, atol=1e-12)
        at_limits.append((controls == limits.low) | (controls == limits.high))
        near = states[None].copy()
        turn_to_nearest(space, near, policy.nominal[step : step + 1])
        np.testing.assert_allclose(near[0], space.nearest(states, policy.nominal[step]), rtol=0, atol=1e-12)
    assert 0.1 < np.mean(at_limits) < 0.9


def test_digest_tells_laws_apart(drive_solution: ls.Solution) -> None:
    policy = drive_solution.policy
    parts = policy.gain, policy.offset, policy.nominal, np.array(policy.dt)
    numbers = b"".join(part.tobytes() for part in parts)
    rules = policy.state_coordinates.rules + policy.control_coordinates.rules
    assert policy.digest == hashlib.sha256(numbers + rules.encode()).hexdigest()[:16]
    assert Feedback(policy).digest == policy.digest
    others = [
        dataclasses.replace(policy, **{name: getattr(policy, name) * (1 + 1e-15)})
        for name in ("gain", "offset", "nominal", "dt")
    ]
    assert len({policy.digest, *(other.digest for other in others)}) == 5
    assert dataclasses.replace(policy, gain=np.asfortranarray(policy.gain)).digest == policy.digest


@pytest.mark.parametrize("seed", range(20))
def test_digests_differ_where_controls_do(drive_solution: ls.Solution, seed: int) -> None:
    """Drawn limits and wrapping: a digest is the same exactly if both are."""
    rng, policy = np.random.default_rng(seed), drive_solution.policy
    controls = policy.control_coordinates.limited((-rng.uniform(0.01, 0.4), rng.uniform(0.01, 0.4)))
    limited = dataclasses.replace(policy, control_coordinates=controls)
    straight = dataclasses.replace(policy.state_coordinates, angles=())
    unwrapped = dataclasses.replace(policy, state_coordinates=straight)
    state = policy.nominal[0] + (0.0, 0.0, 2 * np.pi)
    assert not np.array_equal(policy(state, 0.0), unwrapped(state, 0.0))
    far = policy.nominal[0] + rng.uniform(5, 9, 3)
    assert not np.array_equal(policy(far, 0.0), limited(far, 0.0))
    others = [dataclasses.replace(drive_solution, policy=one) for one in (policy, limited, unwrapped)]
    assert len({one.policy.digest for one in others}) == 3
    assert len({digest_of_solution(one) for one in others}) == 3
    same = policy.control_coordinates.limited((policy.control_coordinates.low, policy.control_coordinates.high))
    again = dataclasses.replace(policy, control_coordinates=same)
    assert again.digest == policy.digest


@pytest.mark.parametrize(
    ("state", "t", "message"),
    [
        (np.zeros(3), -0.1, "t: got -0.1, want a finite number >= 0"),
        (np.zeros(3), np.nan, "t: got nan"),
        (np.zeros(4), 0.0, r"state: got shape \(4,\), want \(..., 3\)"),
        (np.array([0, np.nan, 0]), 0.0, "state: got .*nan.*, want finite numbers"),
    ],
)
def test_bad_calls_get_one_line(drive_solution: ls.Solution, state, t: float, message: str) -> None:
    with pytest.raises(ls.InputError, match=message):
        drive_solution.policy(state, t)
