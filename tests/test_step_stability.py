"""Runge-Kutta steps that are too long for what decays are named, with steps that would do."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mechanisms import row
from sampling import examples

import lqrsim as ls

END = 2.785293563405282  # the real root of 1 - z + z^2/2 - z^3/6 + z^4/24 = 1 above zero
CLEAR = 1e-3  # relative distance from the end of stability, within which three digits do not tell the two sides apart


def plan(rate: float, dt: float, begin: float = 0.0) -> ls.Solution:
    """A plan for x' = rate x + u."""
    lag = ls.Dynamics(
        lambda x, u, p: [p.rate * x[0] + u[0]], states={"x": "m"}, controls={"u": "m/s"}, parameters={"rate": rate}
    )
    problem = ls.Problem(
        dynamics=lag, dt=dt, steps=5, initial=ls.FixedState([0.1]), stage_cost=ls.ControlCost([1.0]),
        final_cost=ls.QuadraticCost([1.0], about=[0.0]), begin=begin,
    )  # fmt: skip
    return ls.smooth(problem)


@settings(max_examples=examples(100))
@given(st.floats(-3, 3).map(lambda power: 10**power), st.floats(0.2, 20))
def test_a_lag_is_stable_up_to_the_closed_form(rate: float, product: float) -> None:
    assume(abs(product / END - 1) > CLEAR)
    solution = plan(-rate, product / rate)
    assert ("are unstable" in solution.detail) == (product > END)
    if product > END:
        growth = 1 - product + product**2 / 2 - product**3 / 6 + product**4 / 24
        assert float(solution.detail.rpartition(" ")[2]) == pytest.approx(growth, rel=1e-2)  # three digits
        named = re.fullmatch(r"use dt of at most (\S+) s, with (\d+) times as many steps", solution.remedy)
        assert named is not None
        longest = float(named[1])
        assert END * (1 - 1e-2) < longest * rate <= END  # three digits, rounded down
        assert product / (int(named[2]) * rate) <= longest < product / ((int(named[2]) - 1) * rate)
        assert "are unstable" not in plan(-rate, longest).detail


@settings(max_examples=examples(100))
@given(st.floats(0.0, 1.0), st.floats(1.5, 6.0))
def test_an_oscillator_is_stable_where_its_steps_do_not_grow(damping: float, product: float) -> None:
    """Against the eigenvalues of the step itself."""
    frequency, dt = 50.0, product / 50.0
    spring = ls.Dynamics(
        lambda x, u, p: [x[1], u[0] - p.stiffness * x[0] - p.damping * x[1]],
        states={"x": "m", "v": "m/s"}, controls={"u": "m/s^2"},
        parameters={"stiffness": frequency**2, "damping": 2 * damping * frequency},
    )  # fmt: skip
    growth = np.abs(np.linalg.eigvals(spring.linearize([0.0, 0.0], [0.0], dt)[0])).max()
    assume(abs(growth - 1) > CLEAR)
    problem = ls.Problem(
        dynamics=spring, dt=dt, steps=3, initial=ls.FixedState([0.0, 0.0]), stage_cost=ls.ControlCost([1.0]),
        final_cost=ls.QuadraticCost([1.0, 1.0], about=[0.01, 0.0]),
    )  # fmt: skip
    for solution in (ls.smooth(problem), ls.ilqr(problem)):
        assert ("are unstable" in solution.detail) == (growth > 1)


@pytest.mark.parametrize("begin", [-3.0, 0.0, 7.0])
def test_its_time_is_that_of_the_plan(begin: float) -> None:
    """As those of knots: from the plan's first one, whenever it begins."""
    assert "are unstable: at 0 s (step 1 of 5)" in plan(-10.0, 1.0, begin=begin).detail


def test_what_grows_by_the_dynamics_is_not_named() -> None:
    assert "are unstable" not in plan(4.0, 1.0).detail


def test_a_step_from_which_nothing_follows_is_named() -> None:
    """x' = u - x^3 from 30: the slope is -2700 1/s, and the second step is beyond all numbers."""
    cube = ls.Dynamics(lambda x, u, p: [u[0] - x[0] ** 3], states={"x": "m"}, controls={"u": "m/s"})
    problem = ls.Problem(
        dynamics=cube, dt=0.1, steps=10, initial=ls.FixedState([30.0]), stage_cost=ls.ControlCost([1.0]),
        final_cost=ls.QuadraticCost([1.0], about=[0.0]),
    )  # fmt: skip
    solution = ls.ilqr(problem)
    assert not solution.success
    assert "at 0 s (step 1 of 10) df/dx has the stable eigenvalue -2.7e+03 1/s" in solution.detail
    assert solution.remedy == "use dt of at most 0.00103 s, with 98 times as many steps"


CART = row(
    ("x", "turn"), joint="", joints=('type="slide" axis="1 0 0" damping="{damping}"', 'type="ball"'),
    geoms=('mass="2"', 'pos="0.2 0 0"'), option='integrator="{integrator}" timestep="{timestep}"',
    actuators='<motor name="push" joint="x"/><motor name="turn" joint="turn" gear="0 0 1"/>',
)  # fmt: skip


@pytest.mark.parametrize("product", [0.99 * END, 1.01 * END, 3.7 * END])
@pytest.mark.parametrize("integrator", ["RK4", "Euler", "implicitfast"])
def test_physics_steps_of_an_mjcf(tmp_path: Path, integrator: str, product: float) -> None:
    def solved(timestep: float | str) -> ls.Solution:
        (tmp_path / "cart.xml").write_text(
            CART.format(integrator=integrator, timestep=timestep, damping=2 * product / 0.01)
        )
        robot = ls.MjcfRobot(tmp_path / "cart.xml")
        return ls.smooth(robot.problem(robot.at(), robot.at(x=0.01), steps=10, dt=0.02), time_limit=20)

    solution = solved(0.01)
    assert ("are unstable" in solution.detail) == (integrator == "RK4" and product > END)
    if "are unstable" in solution.detail:
        assert "mostly of x_velocity" in solution.detail
        named = re.match(r'set <option timestep="(\S+)"/>', solution.remedy)
        assert named is not None
        assert float(named[1]) == pytest.approx(0.01 / np.ceil(product / END), rel=1e-8)
        assert "are unstable" not in solved(named[1]).detail


@pytest.mark.parametrize(("start", "pull"), [(1.5, 2.0), (3.0, 0.5)])
def test_of_a_motion_that_escapes_by_itself_no_step_is_named(start: float, pull: float) -> None:
    """x'' = pull x^3: with ten times as many steps it escapes as well, although one eigenvalue of each pair decays."""
    cube = ls.Dynamics(
        lambda x, u, p: [x[1], p.pull * x[0] ** 3 + u[0]],
        states={"x": "m", "v": "m/s"}, controls={"u": "m/s^2"}, parameters={"pull": pull},
    )  # fmt: skip
    for dt, steps in ((0.1, 60), (0.01, 600)):
        problem = ls.Problem(
            dynamics=cube, dt=dt, steps=steps, initial=ls.FixedState([start, 0.0]), stage_cost=ls.ControlCost([1.0]),
            final_cost=ls.QuadraticCost([1.0, 1.0], about=[0.0, 0.0]),
        )  # fmt: skip
        solution = ls.ilqr(problem)
        assert solution.status is ls.Status.NOT_FINITE
        assert "are unstable" not in solution.detail
        assert "controls under which the states stay in their domain" in solution.remedy
