"""One system at every level of statement: the same numbers, and one line for what cannot be right."""

import copy
import dataclasses
import pickle
import subprocess
import sys
import threading
import time
from typing import Any

import numba
import numpy as np
import pytest
from scipy.optimize import approx_fprime

import lqrsim as ls
from lqrsim.codegen import compiled_module
from lqrsim.problem.derivative_check import evaluate
from lqrsim.results.solution_parts import Status

FIELDS: dict[str, Any] = {
    "states": {"angle": "rad", "speed": "rad/s"},
    "controls": {"torque": "N m"},
    "parameters": {"inertia": 0.02, "gravity": 9.81, "length": 0.2},
    "angles": ("angle",),
}


def symbolic(x, u, p):
    from sympy import sin

    return [x[1], u[0] / p.inertia - p.gravity / p.length * sin(x[0])]


def pendulum(x, u, p):
    return x[1], u[0] / p.inertia - p.gravity / p.length * np.sin(x[0])


def pendulum_jacobian(x, u, p, fx, fu):
    fx[0, 1] = 1.0
    fx[1, 0] = -p.gravity / p.length * np.cos(x[0])
    fu[1, 0] = 1 / p.inertia


def symbolic_bump(x, u, p):
    from sympy import exp

    return p.height * exp(-4 * (x[0] - 1.5) ** 2) + x[1] ** 2 / 10


def bump(x, u, p):
    return p.height * np.exp(-4 * (x[0] - 1.5) ** 2) + x[1] ** 2 / 10


def bump_derivatives(x, u, p, gradient, hessian):
    away = x[0] - 1.5
    height = p.height * np.exp(-4 * away**2)
    gradient[0], gradient[1] = -8 * away * height, x[1] / 5
    hessian[0, 0], hessian[1, 1] = (64 * away**2 - 8) * height, 0.2


HEIGHT: dict[str, Any] = {"parameters": {"height": 0.5}}
DYNAMICS = {
    "symbolic": ls.Dynamics(symbolic, **FIELDS),
    "compiled": ls.Dynamics(numba.njit(pendulum), **FIELDS),
    "compiled with Jacobian": ls.Dynamics(numba.njit(pendulum), jacobian=numba.njit(pendulum_jacobian), **FIELDS),
    "compiled here": ls.Dynamics(pendulum, level="compiled", **FIELDS),
    "plain": ls.Dynamics(pendulum, level="plain", **FIELDS),
    "plain with Jacobian": ls.Dynamics(pendulum, jacobian=pendulum_jacobian, level="plain", **FIELDS),
}
COSTS = {
    "symbolic": ls.SymbolicCost(symbolic_bump, **HEIGHT),
    "compiled": ls.FunctionCost(numba.njit(bump), depends_on=("angle", "speed"), **HEIGHT),
    "plain with derivatives": ls.FunctionCost(
        bump, derivatives=bump_derivatives, depends_on=("angle", "speed"), **HEIGHT
    ),
}


def swing(dynamics: ls.Dynamics, cost: ls.Cost, **changes: object) -> ls.Problem:
    fields: dict = {
        "dynamics": dynamics,
        "dt": 0.05,
        "steps": 40,
        "initial": ls.QuadraticCost([100.0, 100.0], about=[0.0, 0.0]),
        "stage_cost": ls.ControlCost([5.0], about=[0.0]) + cost,
        "final_cost": ls.QuadraticCost([10.0, 1.0], about=[np.pi, 0.0]),
    }
    return ls.Problem(**{**fields, **changes})


# Every level of dynamics with one level of cost, and the other way round: each pair is a structure to compile.
PAIRS = [
    ("symbolic", "symbolic"),
    pytest.param("compiled", "compiled", marks=pytest.mark.long),
    ("compiled here", "compiled"),
    ("plain", "compiled"),
    pytest.param("compiled with Jacobian", "plain with derivatives", marks=pytest.mark.long),
    ("plain with Jacobian", "plain with derivatives"),
]


@pytest.mark.parametrize(("dynamics", "cost"), PAIRS)
@pytest.mark.parametrize("solver", [ls.ilqr])  # what it compiles takes a third of the time; the functions are the same
def test_every_level_finds_the_same(solver, dynamics: str, cost: str) -> None:
    """To the rounding of central differences, 1e-9, where derivatives are such; exact ones agree to 1e-12."""
    want = solver(swing(DYNAMICS["symbolic"], COSTS["symbolic"]))
    found = solver(swing(DYNAMICS[dynamics], COSTS[cost]))
    assert found.status is want.status is Status.CONVERGED
    assert len(found.iterations) == len(want.iterations)
    exact = "Jacobian" in dynamics or dynamics == "symbolic"
    assert found.cost == pytest.approx(want.cost, rel=1e-12 if exact else 1e-9)
    tolerance = 1e-9 if exact else 1e-5
    np.testing.assert_allclose(found.policy.gain, want.policy.gain, rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", DYNAMICS)
def test_derivatives_of_every_level(name: str) -> None:
    """The plain-Python face of each level against SciPy's differences, whose error is some 1e-7 here."""
    dynamics, rng = DYNAMICS[name], np.random.default_rng(0)
    for _ in range(5):
        x, u = rng.normal(size=2), rng.normal(size=1)
        np.testing.assert_allclose(dynamics.rate(x, u), DYNAMICS["symbolic"].rate(x, u), rtol=0, atol=1e-13)
        fx, fu = dynamics.rate_jacobian(x, u)
        slope: Any = approx_fprime(x, lambda y, u=u: dynamics.rate(y, u))
        np.testing.assert_allclose(fx, slope, rtol=0, atol=1e-5)
        slope = approx_fprime(u, lambda v, x=x: dynamics.rate(x, v))
        np.testing.assert_allclose(fu, slope, rtol=0, atol=1e-5)
        a, b, c = dynamics.linearize(x, u, 0.05)
        np.testing.assert_allclose(a @ x + b @ u + c, dynamics.step(x, u, 0.05), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", COSTS)
def test_derivatives_of_costs_of_every_level(name: str) -> None:
    """Second differences with a step of 1e-4 are good to 1e-6 here; the exact ones are compared as strictly."""
    dynamics = DYNAMICS["symbolic"]
    term = COSTS[name].bind(dynamics)
    x, u = np.array([1.2, -0.3]), np.array([0.4])
    value, gradient, hessian = evaluate(term, x, u)
    wanted_gradient, wanted_hessian = np.zeros(3), np.zeros((3, 3))
    p = type("P", (), HEIGHT["parameters"])
    bump_derivatives(x, u, p, wanted_gradient, wanted_hessian)
    assert value == pytest.approx(bump(x, u, p), rel=1e-14)
    np.testing.assert_allclose(gradient, wanted_gradient, rtol=0, atol=1e-6)
    np.testing.assert_allclose(hessian, wanted_hessian, rtol=0, atol=1e-6)


def test_goals_masses_obstacles_and_horizons_are_data(quadrotor: ls.Scenario) -> None:
    given = quadrotor.problem
    ls.smooth(given, max_iterations=2, safeguard=False)
    before = len(compiled_module.compilations)
    heavy, world = ls.Quadrotor(mass=0.7), quadrotor.scene.world
    fewer = ls.ObstacleCost(ls.World(world.obstacles[3:]), radius=0.25, sharpness=8.0, weight=2.0)
    control = ls.ControlCost([10.0] * 4, about=[heavy.hover_force] * 4)
    elsewhere = ls.QuadraticCost([400.0] * 12, about=[1.0, 0.5, -2.0, *[0.0] * 9])
    costs = {
        ls.smooth(problem, max_iterations=2, safeguard=False).cost
        for problem in (
            given,
            dataclasses.replace(given, dynamics=heavy.dynamics),
            dataclasses.replace(given, stage_cost=control + fewer),
            dataclasses.replace(given, final_cost=elsewhere),
            dataclasses.replace(given, steps=100, dt=0.04),
        )
    }
    assert len(costs) == 5
    assert compiled_module.compilations[before:] == []


@numba.njit
def swing_back(x, p):
    return p.gravity / p.length * np.sin(x[0])


def test_helpers_of_numba_can_be_given_p() -> None:
    def using_a_helper(x, u, p):
        return x[1], u[0] / p.inertia - swing_back(x, p)

    want = ls.ilqr(swing(DYNAMICS["compiled"], COSTS["compiled"]))
    for level in ("compiled", "plain"):
        found = ls.ilqr(swing(ls.Dynamics(using_a_helper, level=level, **FIELDS), COSTS["compiled"]))
        assert found.cost == pytest.approx(want.cost, rel=1e-12)


def test_a_cost_must_name_all_that_it_depends_on() -> None:
    forgetful = ls.FunctionCost(bump, depends_on=("angle",), **HEIGHT)
    with pytest.raises(
        ls.InputError, match=r"bump\(x, u, p\): got a value that depends on speed, want it in depends_on"
    ):
        ls.ilqr(swing(DYNAMICS["plain"], forgetful))


def test_numbers_and_plain_functions_are_data() -> None:
    """Other goals, weights, parameters, lengths, and plain functions compile nothing."""
    ls.ilqr(swing(DYNAMICS["plain"], COSTS["compiled"]))
    before = len(compiled_module.compilations)
    heavy = ls.Dynamics(pendulum, level="plain", **{**FIELDS, "parameters": {**FIELDS["parameters"], "inertia": 0.03}})
    other = ls.Dynamics(lambda x, u, p: [x[1], u[0] - x[0]], level="plain", **{**FIELDS, "parameters": {}})
    goal = ls.QuadraticCost([20.0, 2.0], about=[1.0, 0.0])
    costs = {
        ls.ilqr(problem).cost
        for problem in (
            swing(heavy, COSTS["compiled"]),
            swing(other, COSTS["compiled"]),
            swing(DYNAMICS["plain"], COSTS["compiled"], final_cost=goal, steps=30, dt=0.04),
        )
    }
    assert len(costs) == 3
    assert compiled_module.compilations[before:] == []


@pytest.mark.parametrize("level", ["compiled here", "plain with Jacobian"])
def test_a_problem_can_be_copied_and_sent_to_another_process(level: str) -> None:
    problem = swing(DYNAMICS[level], COSTS["plain with derivatives"])
    want = ls.ilqr(problem, max_iterations=2)
    for other in (pickle.loads(pickle.dumps(problem)), copy.deepcopy(problem)):
        assert other.digest == problem.digest
        np.testing.assert_array_equal(ls.ilqr(other, max_iterations=2).policy.gain, want.policy.gain)


def test_what_a_plain_function_raises_ends_the_solve_with_its_words() -> None:
    calls = []

    def fragile(x, u, p):
        calls.append(threading.get_ident())
        if x[0] > 0.5:
            raise ZeroDivisionError("the angle is beyond me")
        return pendulum(x, u, p)

    solution = ls.smooth(swing(ls.Dynamics(fragile, level="plain", **FIELDS), COSTS["compiled"]))
    assert solution.status is Status.NOT_FINITE
    assert "fragile(x, u, p) raised ZeroDivisionError: the angle is beyond me" in solution.detail
    assert set(calls) == {threading.get_ident()}


@pytest.mark.parametrize(
    ("start", "where"),
    [
        ([1.0], "rollout of the initial controls"),  # of which the angle grows from 0 beyond 0.5
        (None, "the line search found no lower cost"),  # for the pendulum that hangs is to stand up
    ],
)
def test_what_a_plain_function_raises_in_ilqr_is_said_in_its_words(start: list[float] | None, where: str) -> None:
    def fragile(x, u, p):
        if x[0] > 0.5:
            raise ZeroDivisionError("the angle is beyond me")
        return pendulum(x, u, p)

    problem = swing(ls.Dynamics(fragile, level="plain", **FIELDS), COSTS["compiled"])
    for solution in (ls.ilqr(problem, start=start), *ls.ilqr_many([problem], start=start)):
        assert not solution.status.success
        assert solution.detail.startswith(f"{where}: ")
        assert solution.detail.endswith("fragile(x, u, p) raised ZeroDivisionError: the angle is beyond me")


def test_ctrl_c_in_a_plain_function_stops_the_solve() -> None:
    calls = []

    def interrupted(x, u, p):
        calls.append(None)
        if len(calls) > 100:
            raise KeyboardInterrupt
        return pendulum(x, u, p)

    dynamics = ls.Dynamics(interrupted, level="plain", **FIELDS)
    with pytest.raises(KeyboardInterrupt):
        ls.ilqr(swing(dynamics, COSTS["compiled"]))
    assert len(calls) == 101  # it was not called again


def test_ctrl_c_stops_plain_functions_in_other_threads() -> None:
    calls = []

    def slow(x, u, p):
        calls.append(None)
        time.sleep(1e-4)
        return pendulum(x, u, p)

    dynamics = ls.Dynamics(slow, level="plain", **FIELDS)
    problems = [swing(DYNAMICS["compiled"], COSTS["compiled"]), *[swing(dynamics, COSTS["compiled"])] * 3]

    def interrupt(done: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ls.smooth_many(problems, threads=2, progress=interrupt)
    stopped = len(calls)
    time.sleep(0.05)
    assert len(calls) == stopped  # nothing runs on
    assert ls.ilqr(problems[1], max_iterations=1).iterations  # and nothing is left stopped


def _index(x, u, p):
    return x[1], x[5]


def _writes(x, u, p):
    x[0] = 0.0
    return x[1], u[0]


def _root(x, u, p):
    return x[1], np.sqrt(-1 - x[0] ** 2)


def _nan_jacobian(x, u, p, fx, fu):
    fx[0, 1], fx[1, 0], fu[1, 0] = 1.0, np.nan, 1 / p.inertia


def _jacobian_out_of_bounds(x, u, p, fx, fu):
    fx[2, 0] = 1.0


def _raising_jacobian(x, u, p, fx, fu):
    fx[0, 1], fx[1, 0], fu[1, 0] = 1.0, -p.gravity / p.length * np.cos(x[0]), 1 / p.inertia
    if x[0] > 0.3:
        raise ValueError("no further")


def _shrinking(x, u, p):
    return np.array([x[1], u[0]]) if x[0] < 0.3 else np.zeros(1)


@pytest.mark.parametrize("level", ["compiled", "plain"])
@pytest.mark.long
def test_what_a_function_does_only_later_is_not_taken_for_numbers(level: str) -> None:
    """A Jacobian that raises, and an array of another length: not finite, at either level."""
    raising = ls.Dynamics(pendulum, jacobian=_raising_jacobian, level=level, **FIELDS)
    shrinking = ls.Dynamics(_shrinking, level=level, **FIELDS)
    for dynamics in (raising, shrinking):
        solution = ls.ilqr(swing(dynamics, COSTS["compiled"]), start=(1.0,))
        assert solution.status is Status.NOT_FINITE


@pytest.mark.parametrize("level", ["compiled", "plain"])
@pytest.mark.parametrize(
    ("function", "fields", "message"),
    [
        (lambda x, u, p: (x[1],), {}, "got 1 entries, want 2: one for each of angle, speed"),
        (lambda x, u, p: (x[1], "fast"), {}, "got .*fast.*, want 2: one for each of angle, speed"),
        (lambda x, u, p: (x[1], p.drag), {}, r"parameter: got 'drag', want one of: inertia, gravity, length"),
        (_index, {}, r"_index\(x, u, p\): got IndexError .* at x = \(0, 0\)"),
        (_root, {}, r"_root\(x, u, p\): got nan as entry 1 \(speed\) at the start, x = \(0, 0\), u = \(0\)"),
        (pendulum, {"jacobian": _jacobian_out_of_bounds}, r"_jacobian_out_of_bounds.*got IndexError"),
        (lambda x, u, p: (x[1], 1j), {}, "got .*1j.*, want 2: one for each of angle, speed"),
        (lambda x, u, p: ("1", "2"), {}, "got .*, want 2: one for each of angle, speed"),
        (lambda x, u, p: None, {}, "got None, want 2: one for each of angle, speed"),
        (pendulum, {"jacobian": lambda x, u, p, fx, fu: (fx, fu)}, "returned, want the result written to the last two"),
        (pendulum, {"jacobian": _nan_jacobian}, r"got nan in df/dx, row speed, column angle, at the start"),
        (lambda x, u: x, {}, r"too many positional arguments, want a function of \(x, u, p\)"),
    ],
)
def test_bad_functions_get_one_line(level: str, function, fields: dict, message: str) -> None:
    with pytest.raises(ls.InputError, match=message):
        ls.ilqr(swing(ls.Dynamics(function, level=level, **FIELDS, **fields), COSTS["compiled"]))


def test_what_numba_can_not_compile_gets_one_line() -> None:
    with pytest.raises(ls.InputError, match=r"_writes\(x, u, p\): got code that numba cannot compile, want .*readonly"):
        ls.ilqr(swing(ls.Dynamics(_writes, level="compiled", **FIELDS), COSTS["compiled"]))
    with pytest.raises(ls.InputError, match="jacobian: got a derivative of symbolic, which is symbolic, want none"):
        ls.Dynamics(symbolic, jacobian=pendulum_jacobian, **FIELDS)
    with pytest.raises(ls.InputError, match="level: got 'fast', want one of: symbolic, compiled, jax, plain"):
        ls.Dynamics(symbolic, level="fast", **FIELDS)
    with pytest.raises(ls.InputError, match="level: got 'plain' for pendulum, want 'compiled' for a numba function"):
        ls.Dynamics(numba.njit(pendulum), level="plain", **FIELDS)
    with pytest.raises(ls.InputError, match="depends_on: got 'angel', want one of: angle, speed, torque"):
        swing(DYNAMICS["symbolic"], ls.FunctionCost(bump, depends_on=("angel",)))
    with pytest.raises(ls.InputError, match="final_cost: got a cost that depends on the control"):
        swing(DYNAMICS["symbolic"], COSTS["symbolic"], final_cost=ls.FunctionCost(bump))


def test_kinks_and_jumps_have_derivatives_almost_everywhere() -> None:
    def hinge(x, u, p):
        import sympy

        return sympy.Max(x[0], 0) ** 2 + sympy.Abs(x[1]) ** 3 + sympy.sign(x[1]) * x[1]

    cost = ls.SymbolicCost(hinge)
    for x in ([0.7, -0.4], [-0.7, 0.4]):
        term = cost.bind(DYNAMICS["symbolic"])
        value, gradient, hessian = evaluate(term, np.array(x), np.zeros(1))
        a, b = x
        assert value == pytest.approx(max(a, 0) ** 2 + abs(b) ** 3 + abs(b), rel=1e-14)
        np.testing.assert_allclose(gradient[:2], [2 * max(a, 0), 3 * b * abs(b) + np.sign(b)], rtol=0, atol=1e-12)
        np.testing.assert_allclose(hessian[:2, :2], np.diag([2.0 * (a > 0), 6 * abs(b)]), rtol=0, atol=1e-12)
    assert np.isfinite(ls.ilqr(swing(DYNAMICS["symbolic"], cost), max_iterations=3).cost)  # and it compiles


def test_a_cost_that_is_not_a_number_at_the_start_is_refused() -> None:
    def logarithm(x, u, p):
        from sympy import log

        return -log(x[0] - 5)

    with pytest.raises(ls.InputError, match=r"logarithm\(x, u, p\): got nan as its value at the start"):
        ls.ilqr(swing(DYNAMICS["symbolic"], ls.SymbolicCost(logarithm)))
    with pytest.raises(ls.InputError, match="SymbolicCost: got the numba function bump, want FunctionCost"):
        ls.SymbolicCost(numba.njit(bump))


def test_check_derivatives_weighs_each_entry() -> None:
    def steep(x, u, p, fx, fu):
        fx[0, 1], fx[1, 0] = 1e6, np.cos(x[0])  # the second has the wrong sign

    rate = ls.Dynamics(lambda x, u, p: [1e6 * x[1], -np.sin(x[0])], jacobian=steep, level="plain", **FIELDS)
    bad = [check for check in ls.check_derivatives(rate) if not check.good]
    assert [(check.row, check.column) for check in bad] == [("speed", "angle")]

    def offset_derivatives(x, u, p, gradient, hessian):
        gradient[0], hessian[0, 0] = 2 * x[0], 2.0

    offset = ls.FunctionCost(lambda x, u, p: 1e4 + x[0] ** 2, derivatives=offset_derivatives)
    assert all(check.good for check in ls.check_derivatives(swing(DYNAMICS["symbolic"], offset)))


def test_check_derivatives_names_the_worst_entry() -> None:
    def wrong(x, u, p, fx, fu):
        pendulum_jacobian(x, u, p, fx, fu)
        fx[1, 1] = 0.25

    dynamics = ls.Dynamics(pendulum, jacobian=wrong, level="plain", **FIELDS)
    good = ls.check_derivatives(swing(DYNAMICS["symbolic"], COSTS["plain with derivatives"]))
    assert all(check.good for check in good)
    assert {check.what for check in good} >= {"df/dx of symbolic", "Hessian of stage_cost: bump(x, u, p)"}
    bad = [check for check in ls.check_derivatives(dynamics) if not check.good]
    assert [(check.what, check.row, check.column) for check in bad] == [("df/dx of pendulum", "speed", "speed")]
    assert bad[0].stated == 0.25
    assert "DISAGREES; worst at row speed, column speed: 0.25 stated" in str(bad[0])


WITHOUT_NUMBA = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "numba":
            raise ModuleNotFoundError("No module named 'numba'")

sys.meta_path.insert(0, Refuse())
import lqrsim as ls

drive = ls.scenarios.differential_drive()
print(ls.smooth(drive.problem).status.name)
ls.simulate(drive.plant(), ls.ilqr(drive.problem), disturbances=[ls.disturbances.ControlNoise(0.05)], seed=0)
dynamics = ls.Dynamics(lambda x, u, p: (u[0] - x[0],), states={"x": ""}, controls={"u": ""}, level="compiled")
problem = ls.Problem(
    dynamics=dynamics, dt=0.1, steps=5, initial=ls.FixedState([1.0]), stage_cost=ls.ControlCost([1.0]),
    final_cost=ls.QuadraticCost([1.0], about=[0.0]),
)
try:
    ls.ilqr(problem)
except ls.InputError as error:
    print(error)
print("numba" in sys.modules)
"""


def test_only_functions_for_numba_need_it() -> None:
    command = [sys.executable, "-c", WITHOUT_NUMBA]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    status, refused, imported = done.stdout.splitlines()
    assert (status, imported) == ("CONVERGED", "False")
    assert "level: got 'compiled', which needs numba, want pip install 'lqrsim[numba]'" in refused
