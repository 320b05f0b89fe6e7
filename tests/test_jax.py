"""Functions of JAX against formulas of the same equations, closed forms and differences."""

import copy
import pickle
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples

import lqrsim as ls
from lqrsim.codegen.user_functions import JaxSteps
from lqrsim.errors import Array
from lqrsim.problem.derivative_check import evaluate

jax = pytest.importorskip("jax", reason="needs the `jax` extra")
jnp = jax.numpy

COUPLING = {f"a{i}": 0.0 for i in range(8)}
FIELDS: dict[str, Any] = {
    "states": {"angle": "rad", "speed": "rad/s"}, "controls": {"torque": "N m"}, "parameters": COUPLING,
}  # fmt: skip


def rates(x, u, p, sin, tanh):
    """Every kind of second derivative: of states, of controls, and mixed."""
    a = list(p)
    return [
        x[1] + a[0] * sin(a[1] * x[0]) * u[0] + a[2] * x[1] ** 2,
        u[0] * (1 + a[3] * u[0]) + a[4] * sin(x[0]) + a[5] * tanh(a[6] * x[0] + x[1] + a[7] * u[0]),
    ]


def formula(x, u, p):
    from sympy import sin, tanh

    return rates(x, u, [getattr(p, name) for name in COUPLING], sin, tanh)


def of_jax(x, u, p):
    return rates(x, u, p, jnp.sin, jnp.tanh)


FORMULA, OF_JAX = ls.Dynamics(formula, **FIELDS), ls.Dynamics(of_jax, level="jax", **FIELDS)
PENDULUM = {"a4": -9.0, "a5": -0.2, "a6": 0.1}
NUMBERS = st.floats(-2.0, 2.0)


def compiled_step(dynamics: ls.Dynamics, x: Array, u: Array, weights: Array) -> list[Array]:
    """The step of 0.1 s, its Jacobian, and its weighted Hessian, by the functions that solvers call."""
    from lqrsim.codegen.compiled_module import module_of
    from lqrsim.codegen.user_functions import numbers_of

    assert dynamics.curvature_source is not None
    out, jacobian, hessian = np.zeros(2), np.zeros((2, 3)), np.zeros((3, 3))
    module = module_of(dynamics.curvature_source, "a test", N=2, M=1)
    module.step_curvature(x, u, numbers_of(dynamics), 0.1, weights, out, jacobian, hessian)
    return [out, jacobian, hessian]


@settings(max_examples=examples(40))
@given(st.lists(NUMBERS, min_size=8, max_size=8), st.lists(NUMBERS, min_size=5, max_size=5))
def test_steps_and_their_derivatives_are_those_of_the_formula(coupling: list[float], point: list[float]) -> None:
    """To 1e-12 of the largest entry: sums are rounded in another order."""
    x, u, weights = np.array(point[:2]), np.array(point[2:3]), np.array(point[3:])
    values = dict(zip(COUPLING, coupling, strict=True))
    wanted, found = (one.with_parameters(**values) for one in (FORMULA, OF_JAX))
    for a, b in zip(compiled_step(found, x, u, weights), compiled_step(wanted, x, u, weights), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1.0, np.abs(b).max()))
    for a, b in zip(found.linearize(x, u, -0.1), wanted.linearize(x, u, -0.1), strict=True):  # backwards, in Python
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1.0, np.abs(b).max()))
    for a, b in zip(found.rate_jacobian(x, u), wanted.rate_jacobian(x, u), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1.0, np.abs(b).max()))


def test_derivatives_against_differences() -> None:
    """Central differences with a step of 1e-5 are good to 1e-9 here."""
    dynamics, x, u, weights = OF_JAX.with_parameters(**PENDULUM), np.array([0.4, -0.7]), np.array([0.3]), np.ones(2)
    _, jacobian, hessian = compiled_step(dynamics, x, u, weights)
    for i, away in enumerate(1e-5 * np.eye(3)):
        above, below = (compiled_step(dynamics, x + s * away[:2], u + s * away[2:], weights) for s in (1, -1))
        np.testing.assert_allclose(jacobian[:, i], (above[0] - below[0]) / 2e-5, rtol=0, atol=1e-9)
        slopes = weights @ (above[1] - below[1]) / 2e-5
        np.testing.assert_allclose(hessian[i], slopes, rtol=0, atol=1e-9)


def swing(dynamics: ls.Dynamics, **changes: Any) -> ls.Problem:
    fields: dict[str, Any] = {
        "dynamics": dynamics, "dt": 0.1, "steps": 25, "initial": ls.FixedState([0.0, 0.0]),
        "stage_cost": ls.ControlCost([0.1]), "final_cost": ls.QuadraticCost([10.0, 1.0], about=[2.0, 0.0]),
    }  # fmt: skip
    return ls.Problem(**{**fields, **changes})


KEPT = {"constraints": [ls.GoalState(angle=2.0, speed=0.0), ls.StateBounds(speed=(-1.5, 1.5))]}


@pytest.mark.parametrize("changes", [{}, KEPT], ids=["free", "constrained"])
def test_the_optimum_is_that_of_the_formula(changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """By the same iterations. Those that know all points do all steps in one call."""
    calls: list[int] = []
    write = JaxSteps._write

    def counted(self, what, x, *rest):
        calls.append(len(x))
        write(self, what, x, *rest)

    monkeypatch.setattr(JaxSteps, "_write", counted)
    wanted, found = (ls.smooth(swing(one.with_parameters(**PENDULUM), **changes)) for one in (FORMULA, OF_JAX))
    assert found.status is wanted.status is ls.Status.CONVERGED
    assert len(found.iterations) == len(wanted.iterations)
    assert found.cost == pytest.approx(wanted.cost, rel=1e-10)
    np.testing.assert_allclose(found.trajectory.states, wanted.trajectory.states, rtol=0, atol=1e-8)
    at_once = [count for count in calls if count > 1]
    assert set(at_once) == ({25} if changes else set())
    if changes:
        interior = sum(one.method == "interior point" for one in found.iterations)
        assert interior < len(at_once) < 8 * interior  # a trial or several, and the derivatives


def test_costs_and_places_of_jax() -> None:
    """Against their closed forms, to rounding."""

    def bump(x, u, p):
        return p.height * jnp.exp(-4 * (x[0] - 1.5) ** 2) + x[1] * u[0]

    term = ls.FunctionCost(bump, level="jax", parameters={"height": 0.5}).bind(OF_JAX)
    value, gradient, hessian = evaluate(term, np.array([1.2, -0.3]), np.array([0.4]))
    height = 0.5 * np.exp(-4 * 0.3**2)
    assert value == pytest.approx(height - 0.12, rel=1e-14)
    np.testing.assert_allclose(gradient, [2.4 * height, 0.4, -0.3], rtol=1e-13)
    curved = np.array([[(64 * 0.09 - 8) * height, 0, 0], [0, 0, 1], [0, 1, 0]])
    np.testing.assert_allclose(hessian, curved, rtol=1e-13, atol=1e-15)

    cart: Any = {"states": {"x": "m", "y": "m"}, "controls": {"u": "N"}, "position": ("x", "y")}
    still = ls.Dynamics(lambda x, u, p: [u[0], x[0]], **cart)
    balls = ls.CollisionSpheres(lambda x, p: [[x[0], x[1]], [x[0] + jnp.sin(x[1]), 1.0]], [0.1, 0.2], level="jax")
    np.testing.assert_allclose(balls.centres(still, [0.3, 0.5])[:, :2], [[0.3, 0.5], [0.3 + np.sin(0.5), 1.0]])
    from lqrsim.problem.collision_shape import evaluate_slopes

    slopes = evaluate_slopes(balls.bind(still), 2, np.array([[0.3, 0.5]]))[1]
    np.testing.assert_allclose(slopes[0, 1, :2], [[1.0, np.cos(0.5)], [0.0, 0.0]], rtol=1e-14)

    noise = ls.Noise(lambda x, u, p: jnp.array([[0.1 * u[0]], [0.2]]), size=1, level="jax")
    np.testing.assert_allclose(noise.matrices(still, [[0.3, 0.5]], [[2.0]])[0], [[0.2], [0.2]], rtol=1e-14)


WEIGHTS = np.array([[0.3, -0.2, 0.5], [0.1, 0.4, -0.6]])
KEYS = {"weights": jnp.asarray(WEIGHTS, dtype=jnp.float32)}


def network(x, u, p):
    return jnp.tanh(KEYS["weights"] @ jnp.concatenate([x, u])) * p.size


def networked() -> ls.Problem:
    return swing(ls.Dynamics(network, level="jax", **{**FIELDS, "parameters": {"size": 2.0}}))


def test_double_precision_is_local() -> None:
    """Neither the user's flag nor the dtype of the user's arrays changes."""
    x, u = np.array([0.3, 0.5]), np.array([0.2])
    wanted = 2.0 * np.tanh(np.asarray(KEYS["weights"], np.float64) @ np.append(x, u))
    np.testing.assert_allclose(networked().dynamics.rate(x, u), wanted, rtol=1e-15)
    assert jnp.ones(2).dtype == np.float32
    assert not jax.config.jax_enable_x64


@pytest.mark.long
def test_a_problem_with_a_network_is_copied_and_sent_to_another_process(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, x, u = networked(), [0.3, 0.5], [0.2]
    for other in (pickle.loads(pickle.dumps(problem)), copy.deepcopy(problem)):
        assert other.digest == problem.digest
        np.testing.assert_array_equal(other.dynamics.step(x, u, 0.1), problem.dynamics.step(x, u, 0.1))
    monkeypatch.setitem(KEYS, "weights", 2 * KEYS["weights"])
    assert networked().digest != problem.digest


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x, u, p: [np.sin(x[0]), u[0]], "got an operation that JAX cannot trace .*, want those of jax.numpy"),
        (lambda x, u, p: [x[1], u[0] if x[0] > 0 else 0.0], "cannot trace .*, want .*jnp.where for branches"),
        (lambda x, u, p: [x[1]], "got 1 entries, want 2: one for each of angle, speed"),
        (lambda x, u, p: [x[1], p.drag], "parameter: got 'drag', want one of: a0, a1"),
        (lambda x, u, p: [x[1], 1j * u[0]], "got .*j.*, want 2: one for each of angle, speed"),
        (lambda x, u, p: None, "got ValueError .*, want no exception"),
        (lambda x, u, p: [x[1], jnp.sqrt(-1 - x[0] ** 2)], "got nan as entry 1 .speed. at the start"),
    ],
)
def test_what_is_wrong_gets_one_line(function: Any, message: str) -> None:
    with pytest.raises(ls.InputError, match=message):
        ls.ilqr(swing(ls.Dynamics(function, level="jax", **FIELDS)))


def test_what_does_not_fit_the_level_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ls.InputError, match="jacobian: got a derivative of of_jax, which is jax, want none"):
        ls.Dynamics(of_jax, level="jax", jacobian=lambda x, u, p, fx, fu: None, **FIELDS)
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(ls.InputError, match=r"of_jax: level: .* needs JAX, want pip install 'lqrsim\[jax\]'"):
        ls.Dynamics(of_jax, level="jax", **FIELDS)
