"""Plans at the edges of contact modes: switches and derivatives of periods, and what is called optimal there."""

from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import arm, row, sled
from sampling import examples, rarely

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.mjcf_dynamics import MjcfDynamics
from lqrsim.scenes.contacts import ContactModes, Switches
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.solvers.budget import Budget, Stop
from lqrsim.solvers.contact_modes import (
    CostedPlan,
    Descent,
    ModeModel,
    minimize,
    optimality_in_mode,
    rolled_out,
    secant_curvature,
    surroundings,
)

H, DT, STEPS = 0.005, 0.02, 12  # s; a physics step, a control period, and how many of these
# A slide that a motor pushes to its limit at 1 m, and a ball over the floor.
OPTION, MOTOR = (
    'timestep="0.005" tolerance="1e-14" integrator="INTEGRATOR"',
    '<motor joint="x" gear="50" ctrlrange="-1 1"/>',
)
SLIDE = sled(joint='range="-1 1"', geom='size="0.1" mass="MASS"', actuators=MOTOR, option=f'{OPTION} gravity="0 0 0"')
BALL = sled(
    "z", names="x", place="0 0 0.1", geom='size="0.1" mass="MASS"', things='<geom type="plane" size="5 5 1"/>',
    actuators=MOTOR, option=OPTION,
)  # fmt: skip
# A pendulum that a motor swings, with a limit.
SWING = arm(
    0.5, along=(0, 0, -1), names="x", joint='axis="0 1 0" range="-4 LIMIT"', geom='size="0.03" mass="MASS"',
    actuators='<motor joint="x" gear="10" ctrlrange="-1 1"/>', option=OPTION,
)  # fmt: skip
FILES = {"slide": SLIDE, "ball": BALL}
GRAVITY = {"slide": 0.0, "ball": 9.81}
MASSES, SPEEDS = st.floats(0.5, 3.0), st.floats(0.2, 2.0)


@cache
def robot_of(kind: str, mass: float, integrator: str = "Euler") -> ls.MjcfRobot:
    return ls.MjcfRobot(scene_from_xml(FILES[kind].replace("MASS", repr(mass)).replace("INTEGRATOR", integrator), kind))


def modes_of(robot: ls.MjcfRobot) -> ContactModes:
    assert isinstance(robot.dynamics, MjcfDynamics)
    modes = robot.dynamics.contact_modes(DT)
    assert modes is not None
    return modes


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
@settings(max_examples=examples(6))
@given(mass=MASSES, speed=SPEEDS, depth=st.floats(-0.015, 0.015))
def test_a_period_is_that_of_the_dynamics_and_its_first_switch_the_distance(
    kind: str, integrator: str, mass: float, speed: float, depth: float
) -> None:
    robot, control = robot_of(kind, mass, integrator), np.array([0.1])
    state = np.array([1 + depth, speed] if kind == "slide" else [-depth, -speed])
    end, switches = modes_of(robot).step(state, control)
    # The compiled steps are MuJoCo's own; four stages of Runge and Kutta are added in another order here.
    np.testing.assert_allclose(end, robot.dynamics.step(state, control, DT), rtol=0, atol=1e-11)
    first = switches.values[~switches.forces][0]
    assert first == pytest.approx(-depth, abs=1e-12)


@settings(max_examples=examples(6))
@given(st.lists(st.sampled_from([-1.01, 0.5, 1.01]), min_size=2, max_size=3))
def test_switches_of_limits_have_the_same_names_with_sparse_jacobians(positions: list[float]) -> None:
    names = "abc"[: len(positions)]
    coupled = "".join(f'<joint joint="{name}" coef="1"/>' for name in names)
    tendon = f'<tendon><fixed range="-0.4 0.4">{coupled}</fixed></tendon>'
    found: list[Switches] = []
    for jacobian in ("dense", "sparse"):
        option = f'gravity="0 0 0" jacobian="{jacobian}"'
        text = row(names, joint='type="slide" axis="1 0 0" range="-1 1"', more=tendon, option=option)
        modes = ContactModes(mujoco.MjModel.from_xml_string(text), 2)
        found.append(modes.step(np.concatenate([positions, np.zeros(len(positions))]), np.zeros(0))[1])
    np.testing.assert_array_equal(found[0].names, found[1].names)


@pytest.mark.parametrize("kind", FILES)
@settings(max_examples=examples(6))
@given(mass=MASSES, speed=SPEEDS, part=st.floats(0.1, 0.9))
def test_derivatives_beside_a_jump_are_those_of_free_flight(kind: str, mass: float, speed: float, part: float) -> None:
    robot, control = robot_of(kind, mass), np.array([0.0])
    # The last physics step begins a nanometre before the contact: three steps of semi-implicit Euler are flown.
    gravity = GRAVITY[kind]
    way = 3 * H * speed + gravity * H * H * 6 + 1e-9
    state = np.array([1 - way, speed] if kind == "slide" else [way, -speed])
    period = modes_of(robot).linearize(state, control)
    push = 50 / mass
    want = np.array([[1, 4 * H, push * 10 * H * H], [0, 1, push * 4 * H]])
    np.testing.assert_allclose(period.jacobian, want, rtol=0, atol=1e-6)  # differences by 1e-6 of a linear step
    gone = np.argmin(np.abs(period.switches.values))
    sign = -1 if kind == "slide" else 1
    np.testing.assert_allclose(period.slopes[gone], sign * np.array([1, 3 * H, push * 6 * H * H]), rtol=0, atol=1e-6)
    a, b, _ = robot.dynamics.linearize(state, control, DT)
    assert np.abs(np.hstack([a, b]) - want).max() > 1e3  # central differences straddle the jump


@settings(max_examples=8)
@given(mass=MASSES, speed=st.floats(0.2, 1.2), number=st.integers(0, 3), part=st.floats(0.1, 0.9))  # in sight
def test_what_is_before_a_jump_is_free_flight(mass: float, speed: float, number: int, part: float) -> None:
    begin = 1 - (number - part) * H * speed  # it is beyond its limit from this physics step on
    switches = modes_of(robot_of("slide", mass)).step(np.array([begin, speed]), np.array([0.0]))[1]
    before = switches.before_jump(switches.values < 0)
    assert switches.forces.any()
    assert not switches.forces[before].any()
    distances = 1 - begin - H * speed * np.arange(number + 1)
    np.testing.assert_allclose(switches.values[before], distances, rtol=0, atol=1e-12)
    assert switches.before_jump(np.zeros(len(before), bool)).all()


def pushed(mass: float, goal: float, speed: float) -> ls.Problem:
    """The slide is to be beyond its limit, and cannot without hitting it."""
    robot = robot_of("slide", mass)
    return ls.Problem(
        dynamics=robot.dynamics, dt=DT, steps=STEPS, initial=ls.FixedState(np.array([1 - 0.2 * speed, speed])),
        stage_cost=ls.ControlCost([0.1]), final_cost=ls.QuadraticCost([100.0, 1.0], about=np.array([goal, 0.0])),
        control_limits=(-1, 1),
    )  # fmt: skip


def flown(mass: float, speed: float) -> tuple[Array, Array, Array, Array]:
    """Positions at each physics step, and the last speed, linear in the controls: M, c of each."""
    count = 4 * STEPS
    responses, offsets = np.zeros((count + 1, 2, STEPS)), np.zeros((count + 1, 2))
    offsets[0] = 1 - 0.2 * speed, speed
    for k in range(count):
        responses[k + 1, 1], offsets[k + 1, 1] = responses[k, 1], offsets[k, 1]
        responses[k + 1, 1, k // 4] += H * 50 / mass
        for one in (responses, offsets):
            one[k + 1, 0] = one[k, 0] + H * one[k + 1, 1]
    return responses[:, 0], offsets[:, 0], responses[-1, 1], offsets[-1, 1]


def least_cost(mass: float, goal: float, speed: float) -> float:
    """The least cost without touching the limit, by SciPy: a quadratic program."""
    where, about, fast, begun = flown(mass, speed)

    def cost(u: Array) -> tuple[float, Array]:
        off, rate = where[-1] @ u + about[-1] - goal, fast @ u + begun
        value = 0.05 * float(u @ u) + 50 * float(off) ** 2 + 0.5 * float(rate) ** 2
        return value, 0.1 * u + 100 * off * where[-1] + rate * fast

    keep = {"type": "ineq", "fun": lambda u: 1.0 - about[:-1] - where[:-1] @ u, "jac": lambda u: -where[:-1]}
    found = scipy.optimize.minimize(
        cost, np.zeros(STEPS), jac=True, method="SLSQP", bounds=[(-1, 1)] * STEPS, constraints=[keep],
        options={"ftol": 1e-14, "maxiter": 500},
    )  # fmt: skip
    assert found.success
    return float(found.fun)


@pytest.mark.parametrize("seed", [0, 3, *rarely(1, 2)])
def test_nothing_beside_a_plan_that_is_called_optimal_is_cheaper(seed: int) -> None:
    draws = np.random.default_rng(seed)
    mass, goal, speed = draws.uniform(0.7, 2), draws.uniform(1.03, 1.2), draws.uniform(0.5, 1.0)
    problem = pushed(mass, goal, speed)
    assert problem.start is not None
    # A brake that stops it short of the limit.
    controls = np.full((STEPS, 1), -mass * speed / (50 * DT * STEPS))
    begin = rolled_out(problem, np.tile(problem.start, (STEPS + 1, 1)), controls, np.zeros((STEPS, 1, 2)))
    modes = modes_of(robot_of("slide", mass))
    descent = Descent(problem, modes, begin, 1e-6, Budget(50, Stop()))
    assert descent.run() is ls.Status.CONVERGED
    pulls, limits = descent.switch_multipliers()
    parts = surroundings(descent.model, descent.plan, pulls)
    assert parts.pressed > 0
    assert parts.across < 1e-6

    def cost_of(controls: Array) -> float:
        state, cost = problem.start, 0.05 * float(np.sum(controls**2))
        for control in controls:
            assert state is not None
            state = problem.dynamics.step(state, control, DT)
        assert state is not None
        return cost + 50 * (state[0] - goal) ** 2 + 0.5 * state[1] ** 2

    own = cost_of(descent.plan.controls)
    assert own == pytest.approx(descent.plan.cost, rel=1e-9)
    # Other controls, from far less than the distance to a switch to far more: rounding, and no more, may be gained.
    for size in np.repeat([1e-9, 1e-7, 1e-5, 1e-3], 40):
        other = np.clip(descent.plan.controls + size * draws.standard_normal((STEPS, 1)), -1, 1)
        assert cost_of(other) >= own * (1 - 1e-6)
    # The gradient says that it is not optimal, by far more than the tolerance of the descent, 1e-6: only with the
    # multipliers of its switches it is. The part of the cost that they hold back is 9e-4 for a goal near the limit.
    none = [Switches(one.names, 0 * one.values) for one in pulls]
    assert optimality_in_mode(problem, modes, descent.plan, descent.model.gain, none, limits)[0] > 1e-4
    assert optimality_in_mode(problem, modes, descent.plan, descent.model.gain, pulls, limits)[0] < 2e-6


def test_smooth_converges_beside_a_jump_and_says_what_is_there(tmp_path: Path) -> None:
    problem = pushed(1.0, 1.05, 0.8)
    solution = ls.smooth(problem, max_iterations=30)
    assert solution.status is ls.Status.CONVERGED, solution.detail
    contacts = solution.certificate.contacts
    assert contacts is not None
    assert contacts.pressed > 0
    assert contacts.across < 0
    assert contacts.sampled <= 1e-4
    assert solution.optimality < 2e-4
    assert "contacts:" in solution.summary()
    plain = ls.smooth(problem, max_iterations=30, safeguard=False)
    assert not plain.success
    # The plan is MuJoCo's own motion, and costs what it says.
    state, cost = solution.trajectory.states[0], 0.0
    for control, planned in zip(solution.trajectory.controls, solution.trajectory.states[1:], strict=True):
        state, cost = problem.dynamics.step(state, control, DT), cost + 0.05 * float(control @ control)
        np.testing.assert_allclose(state, planned, rtol=0, atol=1e-9)
    off, rate = state - np.array([1.05, 0.0])
    assert solution.cost == pytest.approx(cost + 50 * off**2 + 0.5 * rate**2, rel=1e-9)
    ls.save(solution, tmp_path / "pushed.npz")
    loaded = ls.load(tmp_path / "pushed.npz")
    assert isinstance(loaded, ls.Solution)
    assert loaded.certificate == solution.certificate


@settings(max_examples=examples(8))
@given(seed=st.integers(0, 10_000))
def test_the_optimality_in_a_mode_bounds_what_the_mode_allows(seed: int) -> None:
    draws = np.random.default_rng(seed)
    mass, goal, speed = draws.uniform(0.7, 2), draws.uniform(1.03, 1.2), draws.uniform(0.5, 1.0)
    problem = pushed(mass, goal, speed)
    modes = modes_of(robot_of("slide", mass))
    assert problem.start is not None
    controls = draws.uniform(-0.05, 0.0, (STEPS, 1))
    plan = rolled_out(problem, np.tile(problem.start, (STEPS + 1, 1)), controls, np.zeros((STEPS, 1, 2)))
    where, about, *_ = flown(mass, speed)
    if (where[:-1] @ plan.controls[:, 0] + about[:-1] > 1).any():
        return  # it touches
    model = ModeModel(problem, modes, CostedPlan(plan.states, plan.controls, plan.cost))
    step = minimize(model, model.hessian)
    assert step is not None
    parts = np.split(step.multipliers, model.first[1:-1])
    pulls = [Switches(one.switches.names, part) for one, part in zip(model.periods, parts, strict=True)]
    optimality, _ = optimality_in_mode(problem, modes, plan, model.gain, pulls, step.limits)
    fall = (plan.cost - least_cost(mass, goal, speed)) / plan.cost
    # Without limits of the controls, and with all switches in sight, it is the fall itself, in a linear mode.
    assert optimality >= fall - 1e-6


def swung(mass: float, limit: float, start: float, goal: float, effort: float, steps: int) -> ls.Problem:
    """The pendulum is to swing up and stop at the goal."""
    text = SWING.replace("MASS", repr(mass)).replace("LIMIT", repr(limit)).replace("INTEGRATOR", "Euler")
    robot = ls.MjcfRobot(scene_from_xml(text, "swing"))
    return ls.Problem(
        dynamics=robot.dynamics, dt=DT, steps=steps, initial=ls.FixedState(np.array([start, 0.0])),
        stage_cost=ls.ControlCost([effort]), final_cost=ls.QuadraticCost([1.0, 1.0], about=np.array([goal, 0.0])),
        control_limits=(-1, 1),
    )  # fmt: skip


def modes_for(problem: ls.Problem) -> ContactModes:
    assert isinstance(problem.dynamics, MjcfDynamics)
    modes = problem.dynamics.contact_modes(DT)
    assert modes is not None
    return modes


def swings(problem: ls.Problem, controls: Array, plan: CostedPlan | None = None, gain: Array | None = None) -> Array:
    """Angles at each physics step, and the last speed, by plain `mj_step`: of controls, or changed about a plan."""
    assert isinstance(problem.dynamics, MjcfDynamics)
    assert problem.start is not None
    data, seen = mujoco.MjData(problem.dynamics.physics.model), []
    data.qpos[:], data.qvel[:] = problem.start
    for t, control in enumerate(controls):
        data.ctrl[:] = control
        if plan is not None and gain is not None:
            data.ctrl[:] += plan.controls[t] + gain[t] @ (np.concatenate([data.qpos, data.qvel]) - plan.states[t])
        control[:] = data.ctrl
        for _ in range(round(DT / H)):
            seen.append(data.qpos[0])
            mujoco.mj_step(problem.dynamics.physics.model, data)
    return np.array([*seen, data.qpos[0], data.qvel[0]])


@pytest.mark.parametrize("seed", range(3))
def test_secants_are_the_second_derivatives_that_mujoco_does_not_have(seed: int) -> None:
    draws, steps, effort, goal, limit = np.random.default_rng(seed), 6, 0.1, 1.6, 1.0
    mass = draws.uniform(0.7, 1.5)
    problem = swung(mass, limit, draws.uniform(0.986, 0.99), goal, effort, steps)
    modes, held = modes_for(problem), 0.206 * mass + 0.01 * draws.standard_normal((steps, 1))  # against its weight
    assert problem.start is not None
    begin = rolled_out(problem, np.tile(problem.start, (steps + 1, 1)), held, np.zeros((steps, 1, 2)))
    model, earlier = ModeModel(problem, modes, begin), []
    for _ in range(5):  # plans beside it, which need not lie on the way to it
        other = begin.controls + 3e-3 * draws.standard_normal((steps, 1))
        beside = ModeModel(problem, modes, rolled_out(problem, begin.states, other, model.gain))
        earlier.append((beside.points, beside.periods))
    # Any multipliers of the switches will do: of the angle at each physics step, which is near its limit all the time.
    step = minimize(model, model.hessian)
    assert step is not None
    assert len(model.values) == 4 * steps
    pulls = draws.uniform(0, 100, len(model.values))
    lacking = secant_curvature(model, earlier, step._replace(multipliers=pulls, limits=0 * step.limits))

    def lagrangian(change: Array) -> float:
        controls = change.reshape(steps, 1).copy()
        angles = swings(problem, controls, begin, model.gain)
        cost = 0.5 * effort * float(np.sum(controls**2)) + 0.5 * (angles[-2] - goal) ** 2 + 0.5 * angles[-1] ** 2
        return cost - float(pulls @ (limit - angles[:-2]))

    # Second differences by 1e-3: rounding of 1e-14 over 1e-6. Plans 3e-3 away know curvature to some thousandths.
    wrong, missed = [], []
    for _ in range(6):
        way = draws.standard_normal(steps)
        way *= 1e-3 / np.linalg.norm(way)
        true = (lagrangian(way) - 2 * lagrangian(0 * way) + lagrangian(-way)) / (way @ way)
        missed.append(abs(float(way @ model.hessian @ way / (way @ way)) - true))
        wrong.append(abs(float(way @ (model.hessian + lacking) @ way / (way @ way)) - true))
    assert max(wrong) < 0.05 * max(missed)


@pytest.mark.parametrize("seed", range(3))
def test_the_end_of_a_descent_is_quick_where_curvature_counts(seed: int) -> None:
    draws, steps = np.random.default_rng(seed), 40
    effort = draws.uniform(0.7, 1.3)
    problem = swung(draws.uniform(1.3, 1.7), 10.0, 0.0, np.pi, effort, steps)
    assert problem.start is not None
    begin = rolled_out(
        problem, np.tile(problem.start, (steps + 1, 1)), np.full((steps, 1), 0.02), np.zeros((steps, 1, 2))
    )
    budget = Budget(12, Stop())  # 6 to 8 iterations are enough; Gauss and Newton need 21 to 32
    descent = Descent(problem, modes_for(problem), begin, 1e-10, budget)
    assert descent.run() is ls.Status.CONVERGED

    def cost_of(controls: Array) -> float:
        angles = swings(problem, controls[:, None].copy())
        return 0.5 * effort * float(controls @ controls) + 0.5 * (angles[-2] - np.pi) ** 2 + 0.5 * angles[-1] ** 2

    own = descent.plan.controls[:, 0]
    assert cost_of(own) == pytest.approx(descent.plan.cost, rel=1e-9)
    found = scipy.optimize.minimize(cost_of, own, method="L-BFGS-B", bounds=[(-1, 1)] * steps, options={"maxiter": 20})
    assert found.fun > descent.plan.cost * (1 - 1e-8)  # quotients of differences are wrong by 1e-8
