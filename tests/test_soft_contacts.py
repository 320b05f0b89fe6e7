"""Plans through contacts: models with softer contacts and limits, and what `smooth` does with them."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mechanisms import NO_CONTACT, arm, sled
from sampling import examples, rarely

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.solvers import budget, smoother, strategy
from lqrsim.solvers.settings import SmootherSettings

OPTION, FLOOR = 'timestep="0.005" tolerance="1e-14"', '<geom type="plane" size="5 5 1"/>'
# A ball over the floor, a leg of two joints that hops, a pendulum that hangs between stops.
SOFT: dict[str, Any] = {"before": '<default><geom solimp="SOLIMP"/></default>', "option": OPTION, "things": FLOOR}
FALLING = sled(
    "z", place="0 0 0.1", geom='size="0.1" mass="MASS"', actuators='<motor joint="z" gear="10"/>', **SOFT,
)  # fmt: skip
LEG = sled(
    "z", place="0 0 0.6", geom='type="box" size="0.1 0.1 0.1" mass="MASS"',
    carried="""<body><joint name="leg" type="slide" axis="0 0 1" range="-0.15 0.15" damping="2" stiffness="200"/>
      <geom type="sphere" pos="0 0 -0.5" size="0.05" mass="0.2"/></body>""",
    actuators='<motor joint="leg" gear="60" ctrlrange="-1 1"/>', **SOFT,
)  # fmt: skip
STOPS = arm(
    0.5, along=(0, 0, -1), names=["swing"], geom='size="0.03" mass="MASS"',
    joint=f'axis="0 1 0" range="{-np.pi / 3} {np.pi / 3}" damping="0.01" solimplimit="SOLIMP"',
    actuators='<motor joint="swing" gear="5" ctrlrange="-1 1"/>', option=OPTION,
)  # fmt: skip
FILES = {"falling": FALLING, "leg": LEG, "stops": STOPS}
# A state of each that touches, with its depth as the first argument, and its speed as the second.
TOUCHING = {
    "falling": lambda depth, speed: [-depth, -speed],
    "leg": lambda depth, speed: [-0.05 - depth, 0.0, -speed, 0.0],
    "stops": lambda depth, speed: [np.pi / 3 + depth, speed],
}
MASSES, SPEEDS, STARTS = st.floats(0.2, 5.0), st.floats(0.5, 3.0), st.floats(0.5, 0.95)


def text_of(kind: str, mass: float, solimp: str) -> str:
    return FILES[kind].replace("MASS", repr(mass)).replace("SOLIMP", solimp)


@cache
def robot_of(kind: str, mass: float, solimp: str = "0.9 0.95 0.001") -> ls.MjcfRobot:
    return ls.MjcfRobot(scene_from_xml(text_of(kind, mass, solimp), kind))


def softer(robot: ls.MjcfRobot, state: Array) -> dict[str, ls.Dynamics]:
    return dict(robot.dynamics.softened(state[None, :]))


def stepped(xml: str, state: Array, control: Array, steps: int) -> Array:
    """By MuJoCo's bindings; all joints are slides and hinges."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = *np.split(state, 2), control
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel])


@pytest.mark.parametrize("kind", FILES)
@settings(max_examples=examples(8))
@given(mass=MASSES, speed=SPEEDS, begin=STARTS, depth=st.floats(1e-4, 0.02), which=st.sampled_from((0.1, 0.01)))
def test_a_softer_model_is_mujocos_with_another_solimp(
    kind: str, mass: float, speed: float, begin: float, depth: float, which: float
) -> None:
    robot = robot_of(kind, mass, f"{begin} 0.95 0.002")
    state, control = np.array(TOUCHING[kind](depth, speed)), np.array([0.3])
    dynamics = softer(robot, state)[f"{which:g}"]
    want = stepped(text_of(kind, mass, f"0 0.95 {which}"), state, control, 4)
    # Both are MuJoCo's, with its solver to 1e-14.
    np.testing.assert_allclose(dynamics.step(state, control, 0.02), want, rtol=0, atol=1e-11)
    own = stepped(text_of(kind, mass, f"{begin} 0.95 0.002"), state, control, 4)
    np.testing.assert_allclose(robot.dynamics.step(state, control, 0.02), own, rtol=0, atol=1e-11)


@pytest.mark.parametrize("kind", FILES)
@settings(max_examples=examples(8))
@given(mass=MASSES, speed=SPEEDS)
def test_a_softer_step_is_continuous_where_a_contact_or_a_limit_is_just_reached(
    kind: str, mass: float, speed: float
) -> None:
    robot, control = robot_of(kind, mass), np.zeros(1)

    def jump(dynamics: ls.Dynamics) -> float:
        sides = [dynamics.step(np.array(TOUCHING[kind](depth, speed)), control, 0.005) for depth in (1e-6, -1e-6)]
        return float(np.abs(sides[0] - sides[1]).max())

    # A micrometre in, a spring of the default stops a good part of the speed. The impedance of a soft one is MuJoCo's
    # least, 1e-4, of forces that change speed by half of itself in a step, on each of four edges of a friction cone.
    assert jump(robot.dynamics) > 0.05 * speed
    for dynamics in softer(robot, np.array(TOUCHING[kind](1e-3, speed))).values():
        assert jump(dynamics) < 5e-4 * max(speed, 1.0)


@pytest.mark.parametrize("kind", FILES)
@settings(max_examples=examples(8))
@given(mass=MASSES, speed=SPEEDS)
@example(mass=1.0, speed=3.0)
@example(mass=2.75, speed=2.8803348969127454)  # comes to half of the softness
def test_derivatives_of_a_softer_step_are_its_differences(kind: str, mass: float, speed: float) -> None:
    robot, control = robot_of(kind, mass), np.array([0.2])
    state = np.array(TOUCHING[kind](0.01, speed))
    dynamics = softer(robot, state)["0.1"]
    xml, n, far = text_of(kind, mass, "0 0.95 0.1"), len(state), 2e-6
    for steps in (1, 4):
        a, b, _ = dynamics.linearize(state, control, 0.005 * steps)
        ends = [
            [stepped(xml, state + move[:n], control + move[n:], steps) for move in sign * far * np.eye(n + 1)]
            for sign in (1, -1)
        ]
        want = (np.array(ends[0]) - ends[1]).T / (2 * far)
        # Derivatives of a step are good to 1e-5 of the largest entry, which is up to 60; errors of neighbouring steps
        # nearly cancel. The differences here are good to 5e-6 of it where a depth is half of the softness, at which the
        # second derivative of MuJoCo's impedance jumps, and elsewhere to 1e-8.
        np.testing.assert_allclose(np.hstack([a, b]), want, rtol=0, atol=1e-5 * np.abs(want).max())


@pytest.mark.long
def test_a_plan_that_is_softened_again_comes_to_a_cheaper_optimum() -> None:
    robot = robot_of("leg", 2.0)
    problem = hop(robot)
    solution = ls.smooth(problem, max_iterations=12)
    assert solution.success
    # From a single start at each softness, without softening again, smoothing ended at 0.006142.
    assert solution.cost < 0.0059
    state, cost = solution.trajectory.states[0], 0.0
    for control in solution.trajectory.controls:
        state, cost = stepped(robot.scene.xml, state, control, 4), cost + 0.005 * float(control @ control)
    off = state - robot.at(z=0.1)
    # The steps one after the other, from the plan's start: rounding grows at contacts.
    assert solution.cost == pytest.approx(cost + 0.5 * np.array([100.0, 1.0, 1.0, 0.1]) @ off**2, rel=1e-6)


def test_where_nothing_touches_there_is_nothing_to_soften() -> None:
    robot = robot_of("falling", 1.0)
    assert softer(robot, robot.at(z=0.5)) == {}
    (first, *_) = softer(robot, robot.at(z=-0.01)).values()
    assert list(first.softened(robot.at(z=-0.01)[None, :])) == []  # nor of what is soft already


def hop(robot: ls.MjcfRobot) -> ls.Problem:
    """The leg falls, and is to be higher than where it stands at the end."""
    low, high = robot.dynamics.control_coordinates.low, robot.dynamics.control_coordinates.high
    return ls.Problem(
        dynamics=robot.dynamics, dt=0.02, steps=30, initial=ls.FixedState(robot.at(z=0.05)),
        stage_cost=ls.ControlCost([0.01]), final_cost=ls.QuadraticCost([100.0, 1.0, 1.0, 0.1], about=robot.at(z=0.1)),
        control_limits=(low, high),
    )  # fmt: skip


@pytest.mark.long
def test_a_plan_that_does_not_converge_among_contacts_goes_on_through_softer_ones(tmp_path: Path) -> None:
    robot = robot_of("leg", 1.0)
    problem = hop(robot)
    solution = ls.smooth(problem, max_iterations=12)
    assert solution.candidates[0].status is not ls.Status.CONVERGED  # or nothing is softened
    names = [one.start for one in solution.candidates]
    soft = [name.removeprefix("contacts of softness ") for name in names if name.startswith("contacts of softness")]
    periods = ("1 period", "2 periods", "4 periods", "8 periods")
    origins = ["", *(f", sinusoidal controls of {one}{side}" for one in periods for side in ("", ", mirrored"))]
    assert [name for name in soft if name.startswith("0.1")] == [f"0.1{origin}" for origin in origins]
    assert {name for name in soft if name.startswith("0.03")} <= {f"0.03{origin}" for origin in origins}
    first = [name for name in soft if "again" not in name]
    assert [sum(name.startswith(f"{width}") for name in first) for width in ("0.01", "0.003")] == [3, 1]
    # With a start, as here the one that it has by default, nothing is softened.
    plain = ls.smooth(problem, max_iterations=12, start=problem.nominal_control)
    assert all("softness" not in one.start for one in plain.candidates)
    # Nothing is lost by softening: the plan of the default start, cut off after as many iterations, costs more. That
    # plan's own descent within its modes ends at another optimum, here one that costs less by an eighth.
    assert solution.cost <= solution.candidates[0].cost
    assert solution.cost == pytest.approx(plain.cost, rel=0.2)
    # The answer is the cheapest plan for the true contacts of those that have converged.
    assert solution.success
    true = [one for one in solution.candidates if not one.start.startswith("contacts of softness")]
    assert solution.cost == min(one.cost for one in true if one.status is ls.Status.CONVERGED)
    # The plan is of the true model: MuJoCo's own steps from its controls.
    state = solution.trajectory.states[0]
    for control, planned in zip(solution.trajectory.controls, solution.trajectory.states[1:], strict=True):
        state = stepped(robot.scene.xml, state, control, 4)
        np.testing.assert_allclose(state, planned, rtol=0, atol=1e-8)
        state = planned
    assert solution.certificate is not None
    assert solution.certificate.dynamics_residual <= 1e-8
    ls.save(solution, tmp_path / "hop.npz")
    loaded = ls.load(tmp_path / "hop.npz")
    assert isinstance(loaded, ls.Solution)
    assert loaded.detail == solution.detail
    assert [(one.start, one.cost, one.status) for one in loaded.candidates] == [
        (one.start, one.cost, one.status) for one in solution.candidates
    ]


TURN = f'axis="0 0 1" range="{-np.pi / 9} {np.pi / 9}"'
SWIMMER = sled(
    "xy", geom='fromto="1.5 0 0 0.5 0 0"', carried=f"""<joint name="turn" axis="0 0 1"/>
      <body pos="0.5 0 0"><geom fromto="0 0 0 -1 0 0"/><joint name="a" {TURN}/>
      <body pos="-1 0 0"><geom fromto="0 0 0 -1 0 0"/><joint name="b" {TURN}/></body></body>""",
    before=f'<default><geom type="capsule" size="0.1" {NO_CONTACT}/><joint armature="0.1"/></default>',
    actuators="".join(f'<motor joint="{name}" gear="150" ctrlrange="-1 1"/>' for name in "ab"),
    option='timestep="0.01" density="4000" viscosity="0.1" integrator="RK4"',
)  # fmt: skip


@pytest.mark.long
def test_a_swimmer_does_not_rest() -> None:
    """Where it rests, no small control moves it forward: at first order, a plan that does nothing is optimal."""
    robot = ls.MjcfRobot(scene_from_xml(SWIMMER, "swimmer"))
    low, high = robot.dynamics.control_coordinates.low, robot.dynamics.control_coordinates.high
    ends = [100.0, *[0.0] * 9]
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=0.04, steps=25, initial=ls.FixedState(robot.at()),
        stage_cost=ls.ControlCost([0.01, 0.01]), final_cost=ls.QuadraticCost(ends, about=robot.at(x=0.5)),
        control_limits=(low, high),
    )  # fmt: skip
    solution = ls.smooth(problem, max_iterations=12)
    at_rest = 0.5 * 100 * 0.5**2  # that of the goal alone
    true = [one for one in solution.candidates if not one.start.startswith("contacts of softness")]
    assert len(true) < len(solution.candidates)  # the first plan has not converged
    assert solution.status is ls.Status.CONVERGED
    assert solution.cost == min(one.cost for one in true if one.status is ls.Status.CONVERGED)
    assert solution.cost < 0.75 * at_rest


def test_the_time_limit_ends_the_solves_for_softer_contacts_too() -> None:
    robot = robot_of("leg", 1.0)
    solution = ls.smooth(hop(robot), time_limit=1e-6)
    assert solution.status is ls.Status.TIME_LIMIT
    assert all("softness" not in one.start for one in solution.candidates)


@pytest.mark.parametrize("limit", [100.0, *rarely(200.0)])
def test_a_failed_plan_among_contacts_says_that_time_was_over(monkeypatch: pytest.MonkeyPatch, limit: float) -> None:
    """On a clock that advances whenever it is read; without a limit, the solve takes some 400 readings."""
    now = [0.0]

    def read() -> float:
        now[0] += 1.0
        return now[0]

    monkeypatch.setattr(budget, "time", SimpleNamespace(perf_counter=read))
    problem, options = hop(robot_of("leg", 1.0)), SmootherSettings(max_iterations=12)
    real = strategy.Search.solve_from_starts

    def run(search: strategy.Search) -> None:
        """As if no step had lowered the cost of the first plan any more."""
        real(search)
        first, found = search.runs.finished[0]
        search.runs.finished[0] = first, replace(found, status=ls.Status.STALLED, detail="no step lowers the cost")

    monkeypatch.setattr(strategy.Search, "solve_from_starts", run)
    solution = smoother.solve(problem, replace(options, time_limit=limit), budget.Stop())
    assert solution.status is ls.Status.TIME_LIMIT
    assert np.isfinite(solution.cost)
    assert solution.remedy.startswith("raise time_limit")


@pytest.mark.parametrize("limit", [5, 9])
def test_a_plan_for_softer_contacts_is_a_start_with_iterations_of_its_own(
    monkeypatch: pytest.MonkeyPatch, limit: int
) -> None:
    """However many the first start has used."""
    for attempt in ("alternate", "leave_contact_modes"):
        monkeypatch.setattr(strategy.Softening, attempt, lambda softening: None)
    solution = ls.smooth(hop(robot_of("leg", 1.0)), max_iterations=limit)
    used = {one.start: one.iterations for one in solution.candidates}
    assert used["nominal control"] == used["a plan for softer contacts"] == limit
