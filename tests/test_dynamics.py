"""The analytic models: derivatives against finite differences, flows against SciPy and closed forms."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim import rotations
from lqrsim.codegen import compiled_module
from lqrsim.errors import Array
from lqrsim.kernels import rotation_ratios

ROBOTS = [ls.DifferentialDrive(), ls.Quadrotor()]


def random_point(robot: ls.Robot, rng: np.random.Generator) -> tuple[Array, Array]:
    n, m = len(robot.dynamics.state_coordinates), len(robot.dynamics.control_coordinates)
    return rng.uniform(-1.5, 1.5, size=n), rng.uniform(0, 1.5, size=m)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
@pytest.mark.parametrize("dt", [1 / 6, 1 / 30, -1 / 30])
def test_jacobians_are_those_of_the_step(robot: ls.Robot, dt: float) -> None:
    """Central differences of step 1e-6 in double precision are good to 1e-6 at derivatives of order one."""
    rng, h = np.random.default_rng(0), 1e-6
    for _ in range(20):
        x, u = random_point(robot, rng)
        a, b, c = robot.dynamics.linearize(x, u, dt)
        np.testing.assert_allclose(a @ x + b @ u + c, robot.dynamics.step(x, u, dt), rtol=0, atol=1e-12)
        for i, unit in enumerate(np.eye(len(x))):
            ahead, behind = (robot.dynamics.step(x + s * h * unit, u, dt) for s in (1, -1))
            np.testing.assert_allclose(a[:, i], (ahead - behind) / (2 * h), rtol=0, atol=1e-6)
        for i, unit in enumerate(np.eye(len(u))):
            ahead, behind = (robot.dynamics.step(x, u + s * h * unit, dt) for s in (1, -1))
            np.testing.assert_allclose(b[:, i], (ahead - behind) / (2 * h), rtol=0, atol=1e-6)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_the_compiled_step_is_the_plain_one(robot: ls.Robot, request: pytest.FixtureRequest) -> None:
    scenario = request.getfixturevalue(robot.name)
    dynamics, rng = scenario.problem.dynamics, np.random.default_rng(1)
    for _ in range(20):
        x, u = random_point(robot, rng)
        n, m = len(x), len(u)
        out, jacobian = np.zeros(n), np.zeros((n, n + m))
        dynamics.compiled.step_jacobian(x, u, dynamics.data, 0.1, out, jacobian)
        a, b, _ = robot.dynamics.linearize(x, u, 0.1)
        # The same formulas, in an order that the compiler chose: rounding.
        np.testing.assert_allclose(out, robot.dynamics.step(x, u, 0.1), rtol=0, atol=1e-13)
        np.testing.assert_allclose(jacobian, np.hstack([a, b]), rtol=0, atol=1e-12)


def _jumping(x, u, p):
    from sympy import Derivative, Mod, Sum, Symbol, ceiling, floor, frac, pi, sin

    k = Symbol("k")
    return [
        (x.a + pi) % (2 * pi) - pi, Mod(x.b, p.period) * u.u, floor(2 * x.a) * x.b, x.c // p.period + x.a**2,
        ceiling(x.c) + frac(x.d) * x.a, Sum(x.d**k, (k, 1, 3)) + Derivative(sin(x.a), x.a),
    ]  # fmt: skip


def test_remainders_and_jumps_are_those_of_numpy_and_their_derivatives_those_beside_the_jumps() -> None:
    """To rounding, in Python and compiled; central differences of step 1e-6 are good to 1e-6, but across a jump."""
    names, period = "abcdef", 0.7
    dynamics = ls.Dynamics(_jumping, states=dict.fromkeys(names, ""), controls={"u": ""}, parameters={"period": period})

    def rate(x: Array, u: Array) -> Array:
        a, b, c, d, *_ = x
        return np.array([
            np.mod(a + np.pi, 2 * np.pi) - np.pi, np.mod(b, period) * u[0], np.floor(2 * a) * b, c // period + a**2,
            np.ceil(c) + (d - np.floor(d)) * a, d + d**2 + d**3 + np.cos(a),
        ])  # fmt: skip

    rng, h = np.random.default_rng(0), 1e-6
    for _ in range(20):
        x, u = 3 * rng.normal(size=6), rng.normal(size=1)
        np.testing.assert_allclose(dynamics.rate(x, u), rate(x, u), rtol=0, atol=1e-12 * (1 + abs(x[3]) ** 3))
        fx, fu = dynamics.rate_jacobian(x, u)
        slopes = [(rate(x + h * unit, u) - rate(x - h * unit, u)) / (2 * h) for unit in np.eye(6)]
        np.testing.assert_allclose(fx, np.transpose(slopes), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(fu[:, 0], (rate(x, u + h) - rate(x, u - h)) / (2 * h), rtol=1e-5, atol=1e-5)
        compiled = np.empty(6)
        dynamics.compiled.advance(x, u, dynamics.data, 0.1, compiled)
        np.testing.assert_allclose(compiled, dynamics.step(x, u, 0.1), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_the_step_is_of_order_four(robot: ls.Robot) -> None:
    """Against SciPy's integrator at 1e-12: halving the step divides the error of one step by 2^5, here by 28 to 36."""
    x, u = random_point(robot, np.random.default_rng(2))

    def error(dt: float) -> float:
        flow = solve_ivp(lambda _, y: robot.dynamics.rate(y, u), (0, dt), x, rtol=1e-12, atol=1e-13)
        return float(np.abs(robot.dynamics.step(x, u, dt) - flow.y[:, -1]).max())

    assert 28 < error(0.4) / error(0.2) < 36


def test_the_quadrotor_hovers_and_falls() -> None:
    robot = ls.Quadrotor()
    hover = robot.dynamics.step(np.zeros(12), np.full(4, robot.hover_force), 0.1)
    np.testing.assert_allclose(hover, 0, atol=1e-14)
    # From rest without thrust: v = -(g m / k) (1 - exp(-k t / m)), the fall of a body with linear drag.
    t, rate = 0.1, robot.drag / robot.mass
    fall = robot.dynamics.step(np.zeros(12), np.zeros(4), t)
    assert fall[5] == pytest.approx(-robot.gravity / rate * (1 - np.exp(-rate * t)), rel=1e-6)  # one step, order 4


def test_rotation_functions_are_the_matrix_exponential() -> None:
    import sympy

    r = sympy.symbols("r:3", real=True)
    turned = sympy.lambdify(r, rotations.rotate(r, [0, 0, 1]), modules=[vars(rotations), "math"])
    for vector in np.random.default_rng(3).normal(size=(50, 3)) * 2:
        x, y, z = vector
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        np.testing.assert_allclose(turned(*vector), expm(cross)[:, 2], rtol=0, atol=1e-12)


def test_the_rate_of_a_rotation_vector_is_that_of_the_rotation() -> None:
    """Turning on by w dt in body axes, composed by SciPy, moves the vector by its rate times dt, to second order."""
    import sympy

    r, w = sympy.symbols("r:3", real=True), sympy.symbols("w:3", real=True)
    rate = sympy.lambdify([*r, *w], rotations.vector_rate(r, w), modules=[vars(rotations), "math"])
    rng, dt = np.random.default_rng(4), 1e-5
    for _ in range(50):
        vector = rng.normal(size=3)
        vector *= rng.uniform(0, 2.9) / np.linalg.norm(vector)
        spin = rng.normal(size=3)
        ahead, behind = (
            (Rotation.from_rotvec(vector) * Rotation.from_rotvec(s * dt * spin)).as_rotvec() for s in (1, -1)
        )
        np.testing.assert_allclose(rate(*vector, *spin), (ahead - behind) / (2 * dt), rtol=0, atol=1e-7)


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.3, 3.0])
def test_rotation_functions_of_numbers_are_numbers(size: float) -> None:
    """1e-12: rounding of numbers of order one, against SciPy's rotations; 1e-5: of a difference of step 1e-6."""
    rng = np.random.default_rng(4)
    r, v, w = rng.normal(size=(3, 3))
    r *= size / np.linalg.norm(r)
    for convert in (np.array, lambda one: [float(number) for number in one]):
        turned, rate = rotations.rotate(convert(r), convert(v)), rotations.vector_rate(convert(r), convert(w))
        assert all(isinstance(number, float) for number in (*turned, *rate))
        np.testing.assert_allclose(turned, Rotation.from_rotvec(r).apply(v), rtol=0, atol=1e-12)
        if size == 3.0:  # the rate of R = exp([r]) in body axes is [w]: R(r + h rate) = R(r) exp(h [w])
            ahead = Rotation.from_rotvec(r + 1e-6 * np.array(rate))
            relative = (Rotation.from_rotvec(r).inv() * ahead).as_rotvec() / 1e-6
            np.testing.assert_allclose(relative, w, rtol=0, atol=1e-5)
    many = rotations.rotate(np.tile(r[:, None], 4), np.tile(v[:, None], 4))
    np.testing.assert_allclose(np.array(many).T, [turned] * 4, rtol=0, atol=1e-12)


def test_quaternions_and_rotation_vectors_are_scipys() -> None:
    """1e-12 for rounding; lengths and signs of quaternions do not matter, and one alone is as good as many."""
    found = Rotation.random(50, rng=np.random.default_rng(5))
    there = rotations.quaternion(found.as_rotvec())
    np.testing.assert_allclose(np.abs(np.sum(there * found.as_quat(scalar_first=True), axis=1)), 1, rtol=0, atol=1e-12)
    for factor in (1.0, -1.0, 3.0, 1e-13, 1e-200, -1e200):
        np.testing.assert_allclose(rotations.rotation_vector(factor * there), found.as_rotvec(), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rotations.rotation_vector(there[3]), rotations.rotation_vector(there)[3])
    np.testing.assert_array_equal(rotations.rotation_vector([1, 0, 0, 0]), np.zeros(3))
    np.testing.assert_array_equal(rotations.quaternion([0, 0, 0]), [1, 0, 0, 0])
    for function, bad in (
        (rotations.quaternion, np.zeros(4)),
        (rotations.rotation_vector, "turn"),
        (rotations.quaternion, 1),
    ):
        with pytest.raises(ls.InputError, match=r"(quaternion|rotation_vector): got .*, want .*\(\.\.\., [34]\)"):
            function(bad)


@pytest.mark.parametrize("axis", rotations.AXES)
@settings(max_examples=examples(100))
@given(seed=st.integers(0, 2**32 - 1))
def test_turns_after_tilts_are_scipys(axis: str, seed: int) -> None:
    """Any number of turns, and tilts of up to 170 degrees, where errors are some ten times as large as elsewhere."""
    rng, along = np.random.default_rng(seed), np.eye(3)[rotations.AXES.index(axis)]
    tilt = np.where(along, 0.0, rng.normal(size=(20, 3)))
    tilt *= np.deg2rad(rng.uniform(0, 170, (20, 1))) / np.linalg.norm(tilt, axis=1, keepdims=True)
    turn = rng.choice([1.0, 30.0]) * rng.normal(size=(20, 1))
    found = Rotation.from_rotvec(turn * along) * Rotation.from_rotvec(tilt)
    there = rotations.quaternion(turn * along + tilt, turns_about=axis)
    np.testing.assert_allclose(np.abs(np.sum(there * found.as_quat(scalar_first=True), axis=1)), 1, rtol=0, atol=1e-12)
    for factor in (1.0, -3.0, 1e-13, -1e-200, 1e200):
        back = rotations.rotation_vector(factor * there, turns_about=axis)
        np.testing.assert_allclose(np.where(along, 0.0, back), tilt, rtol=0, atol=1e-12)
        turned = back @ along
        np.testing.assert_allclose(np.exp(1j * turned), np.exp(1j * turn[:, 0]), rtol=0, atol=1e-12)
        assert (np.abs(turned) <= np.pi).all()


@pytest.mark.parametrize("level", ["symbolic", "compiled", "plain"])
def test_other_parameters_compile_nothing_and_change_what_they_are_in(level: str) -> None:
    def fall(x, u, p):
        return [x[1], u[0] / p.mass - p.gravity]

    fields: dict = {"states": {"z": "m", "vz": "m/s"}, "controls": {"push": "N"}}
    dynamics = ls.Dynamics(fall, **fields, parameters={"mass": 0.5, "gravity": 9.8}, level=level)
    assert dynamics.rate([1, 2], [3])[1] == pytest.approx(3 / 0.5 - 9.8, abs=1e-15)
    heavy = dynamics.with_parameters(mass=0.6)
    fresh = ls.Dynamics(fall, **fields, parameters={"mass": 0.6, "gravity": 9.8}, level=level)
    assert (heavy.parameters, heavy.source, heavy.functions) == (fresh.parameters, fresh.source, fresh.functions)
    np.testing.assert_array_equal(heavy.rate([1, 2], [3]), fresh.rate([1, 2], [3]))
    assert dynamics.parameters == {"mass": 0.5, "gravity": 9.8}
    assert dynamics.rate([1, 2], [3])[1] == pytest.approx(3 / 0.5 - 9.8, abs=1e-15)
    with pytest.raises(
        ls.InputError, match=r"parameters: got 'mas', want one of: mass, gravity \(did you mean mass\?\)"
    ):
        dynamics.with_parameters(mas=0.6)
    with pytest.raises(ls.InputError, match="parameters: mass: got nan"):
        dynamics.with_parameters(mass=np.nan)


def test_a_solve_with_other_parameters_uses_the_solver_there_is(differential_drive: ls.Scenario) -> None:
    problem = differential_drive.problem
    first = ls.smooth(problem, max_iterations=3)
    before = len(compiled_module.compilations)
    wider = ls.smooth(replace(problem, dynamics=problem.dynamics.with_parameters(axle_length=0.3)), max_iterations=3)
    assert len(compiled_module.compilations) == before
    fresh = ls.smooth(replace(problem, dynamics=ls.DifferentialDrive(0.3).dynamics), max_iterations=3)
    np.testing.assert_array_equal(wider.trajectory.states, fresh.trajectory.states)
    assert (wider.trajectory.states != first.trajectory.states).any()


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("name", rotations.RATIOS)
def test_ratios_are_smooth_at_zero(name: str, order: int) -> None:
    """Against 40 digits of mpmath, on both sides of the switch to the series; each differentiation costs digits."""
    exact = {
        "sine_ratio": lambda s: mpmath.sin(mpmath.sqrt(s)) / mpmath.sqrt(s),
        "cosine_ratio": lambda s: (1 - mpmath.cos(mpmath.sqrt(s))) / s,
        "cotangent_ratio": lambda s: (1 - mpmath.sqrt(s) / 2 * mpmath.cot(mpmath.sqrt(s) / 2)) / s,
    }[name]
    function = getattr(rotation_ratios, name + ("" if order == 0 else f"_d{order}"))
    tolerance = [1e-13, 1e-11, 1e-8][order]
    with mpmath.workdps(40):
        for s in [*np.logspace(-8, 1.4, 60), 0.2499999, 0.2500001]:
            want = mpmath.diff(exact, mpmath.mpf(float(s)), order)
            assert abs(function(float(s)) - want) < tolerance * max(1e-2, abs(want))


def _pendulum(x, u, p):
    from sympy import sin

    angle, speed = x
    return [speed, u[0] - p.stiffness * sin(angle)]


def _tangled(x, u, p):
    import sympy

    return [x[1], sympy.besselj(0, x[0]) + u[0]]


def _piece(x, u, p):
    import sympy

    return [x[1], sympy.Piecewise((x[0], x[0] > 1)) + u[0]]


FIELDS = {
    "states": {"angle": "rad", "speed": "rad/s"},
    "controls": {"torque": "N m"},
    "parameters": {"stiffness": 2.0},
    "angles": ("angle",),
}


@pytest.mark.parametrize(
    ("function", "fields", "message"),
    [
        (
            _pendulum,
            {"parameters": {}},
            r"_pendulum\(x, u, p\): parameter: got 'stiffness', want one of: \(there are none",
        ),
        (_pendulum, {"parameters": {"stiffness": np.nan}}, "parameters: stiffness: got nan, want a finite number"),
        (_pendulum, {"angles": ("angel",)}, r"angles: got 'angel', want one of: angle, speed \(did you mean angle\?\)"),
        (lambda x, u, p: [x[1]], {}, "got 1 entries, want 2: one for each of angle, speed"),
        (lambda x, u, p: [x[1], float(x[0])], {}, "got TypeError .* when called with symbols"),
        (lambda x, u, p: [x[1], x[2]], {}, "got IndexError"),
        (lambda x, u, p: [x[1], "fast"], {}, "got 'fast' as entry 1, want an expression"),
        (lambda x, u, p: [x[1], x[0] / (u[0] - u[0])], {}, "as entry 1, want a finite real expression"),
        (lambda x, u, p: [x[1], x[0] > 0], {}, "got x0 > 0 as entry 1, want an expression"),
        (lambda x, u, p: [x[1], x[0] * (-1) ** 0.5], {}, "as entry 1, want a finite real expression"),
        (_tangled, {}, r"_tangled\(x, u, p\): got a formula that cannot be compiled \(besselj\), want elementary"),
        (_piece, {}, r"_piece\(x, u, p\): got Piecewise.* in entry 1, want its last case to be \(expression, True\)"),
        (_pendulum, {"parameters": {"_k": 1.0}}, "got the name '_k', want a Python name without a leading underscore"),
        (_pendulum, {"parameters": {1: 1.0}}, "parameters: got the name 1, want a Python name"),
        (
            _pendulum,
            {"parameters": {"\u00b5": 1.0, "\u03bc": 2.0}},  # the micro sign, and the Greek letter
            "parameters: got two names that are p.\u03bc in Python, want different ones",
        ),
        (_pendulum, {"states": ["angle", "speed"]}, "states: got .*, want a dictionary of name: unit"),
        (_pendulum, {"control_limits": ("a", "b")}, r"control_limits: got .*, want \(lowest, highest\), each a number"),
        (_pendulum, {"level": 3}, "level: got 3, want one of: symbolic, compiled, jax, plain"),
        (
            _pendulum,
            {"control_limits": (1.0, -1.0)},
            "control_limits: got 1 to -1 for torque, want the first below",
        ),
    ],
)
def test_bad_dynamics_get_one_line(function, fields: dict, message: str) -> None:
    with pytest.raises(ls.InputError, match=message):
        _ = ls.Dynamics(function, **{**FIELDS, **fields}).source


@pytest.mark.parametrize("name", ["\u00b5", "\ufb01nal", "\u2115", "\u212b", "e\u0301"])
def test_formulas_find_names_that_python_writes_in_another_way(name: str) -> None:
    """The micro sign, a ligature, the sign of natural numbers, that of the angstrom, an accent of its own."""
    formula = eval(f"lambda x, u, p: [x.{name} + 2 * u.{name} + 3 * p.{name}, x[:1].{name}]")
    dynamics = ls.Dynamics(formula, states={name: "", "other": ""}, controls={name: ""}, parameters={name: 5.0})
    np.testing.assert_array_equal(dynamics.rate([1.0, 7.0], [2.0]), [20.0, 1.0])
