"""Limits of forces as constraints of a plan: what is linear, by MuJoCo; and plans that the file itself repeats."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mechanisms import arm, sled
from sampling import examples
from scipy.optimize import LinearConstraint, minimize

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.problem import PlainTerm
from lqrsim.solvers.compiled import costs_of

# Two links that a floor does not stop, with what is filled in as actuators.
TENDON = """<tendon><fixed name="both"><joint joint="a" coef="1"/><joint joint="b" coef="-0.5"/></fixed></tendon>"""
SERVOS = """
<position name="pa" joint="a" kp="{kp}" kv="{kv}" ctrlrange="-3 3" forcerange="-{most} {most}"/>
<position name="pb" joint="b" kp="{kp}" kv="{kv}" ctrlrange="-3 3" forcerange="-{other} {other}"/>
"""


def robot(
    folder: Path, actuators: str, *, timestep: float = 0.002, integrator: str = "implicitfast", joint: str = ""
) -> ls.MjcfRobot:
    path = folder / "arm.xml"
    path.write_text(arm(
        0.3, 0.3, joint='axis="0 1 0" damping="0.2"', joints=(f'armature="0.05" {joint}', 'armature="0.02"'),
        geoms=('mass="1"', 'size="0.02" mass="0.5"'), option=f'timestep="{timestep}" integrator="{integrator}"',
        actuators=actuators, more=TENDON,
    ))  # fmt: skip
    return ls.MjcfRobot(path)


def replayed(arm: ls.MjcfRobot, plan: ls.Trajectory) -> tuple[Array, Array]:
    """The plan's controls by `mj_step` of the file as it is: the states at the knots, and all forces without limits."""
    model = arm.scene.model
    free = mujoco.MjModel.from_xml_string(arm.mjcf.xml)
    free.actuator_forcelimited[:] = free.jnt_actfrclimited[:] = 0
    data, shadow = mujoco.MjData(model), mujoco.MjData(free)
    data.qpos[:], data.qvel[:] = arm.configuration(plan.states[0])
    states, forces = [plan.states[0]], []
    for control in plan.controls:
        data.ctrl[:] = control
        for _ in range(round(plan.dt / model.opt.timestep)):
            shadow.qpos[:], shadow.qvel[:], shadow.ctrl[:] = data.qpos, data.qvel, data.ctrl
            mujoco.mj_forward(free, shadow)
            forces.append(np.concatenate([shadow.actuator_force, shadow.qfrc_actuator]))
            mujoco.mj_step(model, data)
        states.append(arm.state(data.qpos, data.qvel, near=plan.states[len(states)]))
    return np.array(states), np.array(forces)


@pytest.mark.parametrize(
    ("actuators", "joint", "linear", "others"),
    [
        (SERVOS.format(kp=900, kv=40, most=20, other=9), "", ["of pa", "of pb"], []),
        ('<motor name="m" joint="a" gear="3" ctrlrange="-1 1"/>', 'actuatorfrcrange="-2 2"', ["on a"], []),
        ('<motor name="t" tendon="both" gear="2" forcerange="-5 4"/>', "", ["of t"], []),
        ('<intvelocity name="i" joint="b" kp="50" kv="2" actrange="-2 2" forcerange="-5 5"/>', "", ["of i"], []),
        ('<damper name="d" joint="a" kv="3" ctrlrange="0 1" forcerange="-5 5"/>', "", [], ["of d"]),
        ('<muscle name="u" tendon="both" lengthrange="-1 1" forcerange="-5 5"/><motor joint="b"/>', "", [], ["of u"]),
        ('<motor name="m" joint="a"/>', "", [], []),
    ],
)  # fmt: skip
def test_a_force_is_a_constraint_if_it_is_linear(
    tmp_path: Path, actuators: str, joint: str, linear: list[str], others: list[str]
) -> None:
    """And the constraint's values are those of MuJoCo at random states, to rounding."""
    arm = robot(tmp_path, actuators, joint=joint)
    kept, rest = arm._forces
    assert [one.name for one in kept] == linear
    assert list(rest) == others
    told = str(arm)
    assert ("force limits, constraints of plans" in told) == bool(linear)
    assert ("force limits, clipped in plans as in runs" in told) == bool(others)
    if not linear:
        with pytest.raises(ls.InputError, match="force_limits: got none"):
            _ = arm.force_limits
        return
    free = arm.unlimited.physics.model
    assert not free.actuator_forcelimited.any()
    assert not free.jnt_actfrclimited.any()
    data, rng = mujoco.MjData(free), np.random.default_rng(0)
    for _ in range(20):
        state, control = rng.normal(size=len(arm.dynamics.state_coordinates)), rng.normal(size=free.nu)
        data.qpos[:], data.qvel[:] = arm.configuration(state)
        data.act[:], data.ctrl[:] = state[2 * free.nv :], control
        mujoco.mj_forward(free, data)
        for one in kept:
            force = data.qfrc_actuator[0] if one.of_joint else data.actuator_force[one.id]
            assert one.slopes @ [1.0, *state, *control] == pytest.approx(force, rel=1e-9, abs=1e-9)


@settings(max_examples=examples(4))
@given(nominal=st.floats(1e3, 1e8), most=st.floats(1.0, 50.0), negative=st.booleans())
def test_a_nominal_limit_leaves_the_other_as_it_is(
    tmp_path_factory: pytest.TempPathFactory, nominal: float, most: float, negative: bool
) -> None:
    low, high = (-most, nominal) if negative else (-nominal, most)
    arm = robot(tmp_path_factory.mktemp("nominal"), f'<motor name="m" joint="a" forcerange="{low} {high}"/>')
    term = arm.force_limits.bind(arm.dynamics)
    idle = np.zeros(len(arm.dynamics.state_coordinates) + 1)
    distance = PlainTerm(term, len(idle) - 1, 1).value(idle, 0 if negative else 1)
    assert 0.99 * most < distance < most


@settings(max_examples=examples(4))
@given(least=st.floats(-30.0, 30.0), negative=st.booleans(), force=st.floats(1.0, 50.0))
@example(least=0.0, negative=False, force=2.0)
@example(least=0.0, negative=True, force=2.0)
def test_a_force_with_one_limit_keeps_from_that_one(
    tmp_path_factory: pytest.TempPathFactory, least: float, negative: bool, force: float
) -> None:
    """By a thousandth of twice the limit; of a limit of 0, which tells no size, by a thousandth of 1 N m."""
    sides = f"-inf {-least}" if negative else f"{least} inf"
    arm = robot(tmp_path_factory.mktemp("one"), f'<motor name="m" joint="a" forcerange="{sides}"/>')
    term, away = arm.force_limits.bind(arm.dynamics), -1.0 if negative else 1.0
    z = np.append(np.zeros(len(arm.dynamics.state_coordinates)), away * (least + force))
    rows = [PlainTerm(term, len(z) - 1, 1).value(z, row) for row in (0, 1)]
    spared = 1e-3 * (2 * abs(least) if least else 1.0)
    assert rows[negative] == pytest.approx(force - spared, rel=1e-9)
    assert rows[not negative] == np.inf
    assert arm.force_limits._rough == pytest.approx(spared / 2)


# Limits that leave little: along the outline, no plan keeps them.
@example(servo=(4000.0, "implicitfast"), most=8.0, other=2.5, goal=(0.49, 0.74))
@settings(max_examples=examples(4))
@given(
    servo=st.sampled_from([(80.0, "Euler"), (80.0, "RK4"), (900.0, "implicitfast"), (4000.0, "implicitfast")]),
    most=st.floats(8.0, 20.0), other=st.floats(2.5, 6.0), goal=st.tuples(st.floats(-0.8, 0.8), st.floats(-0.8, 0.8)),
)  # fmt: skip
def test_the_file_repeats_a_plan_of_servos_that_press(
    tmp_path_factory: pytest.TempPathFactory, servo: tuple[float, str], most: float, other: float,
    goal: tuple[float, float],
) -> None:  # fmt: skip
    """MuJoCo clips nothing along it, at any physics step, so that the file's own steps are the plan's to rounding."""
    (kp, integrator), folder = servo, tmp_path_factory.mktemp("arm")
    arm = robot(folder, SERVOS.format(kp=kp, kv=kp / 20, most=most, other=other), integrator=integrator)
    start = arm.at(a=np.pi / 2)  # it hangs
    problem = arm.problem(start, arm.at(a=np.pi / 2 + goal[0], b=goal[1]), steps=25, dt=0.02)
    assert len(problem.constraints) == 1
    solution = ls.smooth(problem)
    assert solution.status is ls.Status.CONVERGED, solution.detail
    states, forces = replayed(arm, solution.trajectory)
    assert (np.abs(forces[:, :2]).max(axis=0) <= [most, other]).all()
    np.testing.assert_allclose(states, solution.trajectory.states, rtol=0, atol=1e-8)


def test_limits_stay_where_the_physics_without_them_is_unstable(tmp_path: Path) -> None:
    """A damping of 200 N m s/rad on 0.03 kg m2 is too much for an explicit step of 2 ms; clipped, it is bounded."""
    arm = robot(tmp_path, SERVOS.format(kp=4000, kv=200, most=20, other=9), integrator="RK4")
    assert not arm.problem(arm.at(a=1.5), arm.at(a=1.2), steps=20).constraints


def test_a_limit_that_no_control_keeps_at_the_start_stays_in_the_dynamics(tmp_path: Path) -> None:
    """The target is out of reach by 0.5 rad there, which is 450 N m of 20."""
    arm = robot(tmp_path, SERVOS.format(kp=900, kv=40, most=20, other=9).replace("-3 3", "-1 1"))
    problem = arm.problem(arm.at(a=1.5), arm.at(a=0.9), steps=20)
    kept: Any
    dynamics: Any = problem.dynamics
    (kept,) = problem.constraints
    assert [one.name for one in kept.limits] == ["of pb"]
    assert dynamics.physics.model.actuator_forcelimited.tolist() == [True, False]
    assert not arm.problem(arm.at(a=1.5), arm.at(a=0.9), steps=20, force_limits=False).constraints


@pytest.mark.parametrize(
    "bounds", [((-0.3, 0.6), (-1.2, 1.2)), ((-0.05, 0.35), (-0.9, 0.7)), ((-0.1, 0.5), (-0.6, 2.0))]
)
def test_constraints_with_a_linear_file_are_those_of_a_quadratic_program(
    tmp_path: Path, bounds: tuple[tuple[float, float], ...]
) -> None:
    """A mass on a slide, moved by a motor: against SciPy's trust region on the controls alone, to 1e-5 of the cost."""
    path = tmp_path / "slide.xml"
    path.write_text(sled("x", geom='size="0.1" mass="2"', limits=[6], option='timestep="0.02" gravity="0 0 0"'))
    cart, steps, h = ls.MjcfRobot(path), 30, 0.04
    goal = 0.3
    problem = ls.Problem(
        dynamics=cart.dynamics, dt=h, steps=steps, initial=ls.FixedState([0.0, 0.0]), stage_cost=ls.ControlCost([0.05]),
        final_cost=ls.QuadraticCost([80.0, 20.0], about=[goal, 0.0]), control_limits=(-6.0, 6.0),
        constraints=[ls.StateBounds(x=bounds[0], x_velocity=bounds[1]), ls.GoalState(x_velocity=0.0)],
    )  # fmt: skip
    solution = ls.smooth(problem)
    assert solution.status is ls.Status.CONVERGED, solution.detail
    # Two steps of semi-implicit Euler a period.
    step, push = np.array([[1.0, 0.02], [0.0, 1.0]]), np.array([0.02**2, 0.02]) / 2.0
    a, b = step @ step, step @ push + push
    by_control = np.zeros((steps + 1, 2, steps))
    for t in range(steps):
        by_control[t + 1] = a @ by_control[t]
        by_control[t + 1, :, t] += b

    def cost(u: Array) -> float:
        end = by_control[-1] @ u - [goal, 0.0]
        return 0.025 * float(u @ u) + 0.5 * float(end @ ([80.0, 20.0] * end))

    def slope(u: Array) -> Array:
        return 0.05 * u + by_control[-1].T @ ([80.0, 20.0] * (by_control[-1] @ u - [goal, 0.0]))

    kept = [LinearConstraint(by_control[1:, 0], *bounds[0]), LinearConstraint(by_control[1:-1, 1], *bounds[1])]
    kept.append(LinearConstraint(by_control[-1, 1], 0.0, 0.0))
    best = minimize(
        cost, np.zeros(steps), jac=slope, method="SLSQP", bounds=[(-6.0, 6.0)] * steps,
        constraints=kept, options={"maxiter": 500, "ftol": 1e-14},
    )  # fmt: skip
    assert best.success
    assert solution.cost == pytest.approx(best.fun, rel=2e-5)
    np.testing.assert_allclose(solution.trajectory.states[:, 1].clip(*bounds[1]), solution.trajectory.states[:, 1])


@pytest.mark.long
def test_a_plan_with_dry_friction_ends_where_the_cost_no_longer_changes(tmp_path: Path) -> None:
    """No gradient vanishes at a kink. Of plans beside it that clip nothing, none is cheaper by more than 2 %."""
    arm = robot(tmp_path, SERVOS.format(kp=900, kv=40, most=40, other=15), joint='frictionloss="0.3"')
    problem = arm.problem(arm.at(a=np.pi / 2), arm.at(a=np.pi / 2 + 0.5, b=0.5), steps=25, dt=0.02)
    solution, limits = ls.smooth(problem, time_limit=120.0), problem.control_coordinates
    assert solution.status is ls.Status.COST_CONVERGED, solution.detail
    assert "derivatives of the dynamics jump" in solution.detail
    draws, policy, kept = np.random.default_rng(0), solution.policy, []
    for size in [0.0, *np.geomspace(1e-7, 1e-3, 60)]:
        xs, us = [solution.trajectory.states[0]], []
        offsets = policy.offset + size * np.cumsum(draws.normal(size=policy.offset.shape), axis=0)
        for gain, offset in zip(policy.gain, offsets, strict=True):
            us.append(np.clip(gain @ xs[-1] + offset, limits.low, limits.high))
            xs.append(arm.dynamics.step(xs[-1], us[-1], problem.dt))
        plan = ls.Trajectory(np.array(xs), np.array(us), problem.dt)
        states, forces = replayed(arm, plan)
        np.testing.assert_allclose(states, plan.states, rtol=0, atol=1e-8)
        if (np.abs(forces[:, :2]).max(axis=0) <= [40, 15]).all():
            kept.append(plan)
    costs = costs_of(problem, np.array([one.states for one in kept]), np.array([one.controls for one in kept]))
    assert costs[0] == pytest.approx(solution.cost, rel=1e-9)
    assert len(costs) > 20
    assert costs.min() > (1 - 0.02) * solution.cost


# Re-plans of an arm with stiff servos, which cannot keep their forces within their limits after a push.

Armed = tuple[ls.MjcfRobot, ls.Problem]


@pytest.fixture(scope="module")
def stated(tmp_path_factory: pytest.TempPathFactory) -> Armed:
    arm = robot(tmp_path_factory.mktemp("arm"), SERVOS.format(kp=2000, kv=200, most=8, other=3))
    start = arm.at(a=np.pi / 2)  # it hangs
    return arm, arm.problem(start, arm.at(a=np.pi / 2 + 0.5, b=-0.4), steps=20, dt=0.02)


@pytest.fixture(scope="module")
def first_plan(stated: Armed) -> ls.Solution:
    found = ls.smooth(stated[1])
    assert found.success
    return found


@pytest.fixture(scope="module")
def solver(stated: Armed) -> ls.types.PreparedSolver:
    return ls.prepare(stated[1], threads=1)


def test_limits_hold_where_a_plan_can_keep_them(
    stated: Armed, first_plan: ls.Solution, solver: ls.types.PreparedSolver
) -> None:
    """The price of a violation is then too high to pay: a fine tolerance leads to the plan of `smooth`.

    Its limits are refined along the plan, and those of a re-plan are not; that changes the cost by less than 1 %.
    """
    replan = ls.prepare(stated[1], tolerance=1e-6).solve(first_plan.trajectory.states[0], first_plan.shifted(0))
    assert replan.status is ls.Status.CONVERGED
    assert replan.violation <= 1e-6  # the tolerance of constraints
    assert replan.cost == pytest.approx(first_plan.cost, rel=1e-2)


@settings(max_examples=examples(12))
@given(push=st.tuples(st.floats(-3, 3), st.floats(-3, 3)), after=st.integers(1, 10))
def test_after_a_push_they_give_way(
    stated: Armed, first_plan: ls.Solution, solver: ls.types.PreparedSolver,
    push: tuple[float, float], after: int,
) -> None:  # fmt: skip
    """In a bounded number of iterations, and the file, which clips forces, goes where the plan says.

    A quarter of these pushes have no plan within the limits: 3 rad/s times 200 N m s/rad are 600 N m of 8. A run is
    then off its plan by what is clipped, 0.06 rad at the end at most in 40 draws; it follows others to rounding.
    """
    (arm, problem), start = stated, first_plan.shifted(after)
    state = first_plan.trajectory.states[after] + [0, 0, *push]
    replan = solver.solve(state, start)
    assert replan.status is ls.Status.CONVERGED, replan.detail
    assert replan.iterations <= 40  # 5 to 29 in these draws
    assert ("elastic: the force" in replan.detail) == (replan.violation > 1e-6)
    run = state
    for step in range(problem.steps):
        run = arm.dynamics.step(run, np.clip(replan.policy.control(run, step), -3, 3), problem.dt)
    np.testing.assert_allclose(
        run[:2], replan.trajectory.states[-1, :2], rtol=0, atol=0.1 if replan.violation else 1e-9
    )


def test_a_solve_without_time_says_so(first_plan: ls.Solution, solver: ls.types.PreparedSolver) -> None:
    replan = solver.solve(first_plan.trajectory.states[0] + [0, 0, 0.5, 0.5], first_plan.shifted(0), time_limit=1e-6)
    assert replan.status is ls.Status.TIME_LIMIT
    assert not replan.improved


def test_threads_change_nothing(stated: Armed, first_plan: ls.Solution, solver: ls.types.PreparedSolver) -> None:
    state = first_plan.trajectory.states[2] + [0, 0, 0.3, -0.3]
    one, two = (made.solve(state, first_plan.shifted(2)) for made in (solver, ls.prepare(stated[1], threads=2)))
    np.testing.assert_array_equal(one.trajectory.states, two.trajectory.states)
