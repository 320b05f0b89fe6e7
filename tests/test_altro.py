"""The problems of Altro.jl: their models against mass matrices and forces worked out otherwise, and what is counted."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import altro_problems
import numpy as np
import pytest
from altro import airplane, models
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import lqrsim as ls

SCRIPT = Path(__file__).parent.parent / "experiments" / "altro_problems.py"
TIGHT: dict[str, Any] = {"rtol": 1e-11, "atol": 1e-11}


def rate(dynamics: ls.Dynamics, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """By the formula, in numbers."""
    return np.array([float(one) for one in dynamics.f(x.tolist(), u.tolist(), SimpleNamespace(**dynamics.parameters))])


def drawn(seed: int, *sizes: int) -> list[np.ndarray]:
    generator = np.random.default_rng(seed)
    return [generator.standard_normal(size) for size in sizes]


@pytest.mark.parametrize("seed", range(3))
def test_cartpole_and_acrobot_have_the_published_mass_matrices(seed: int) -> None:
    x, u = drawn(seed, 4, 1)
    s, c, g = np.sin(x[1]), np.cos(x[1]), 9.81
    mass = np.array([[1.2, 0.1 * c], [0.1 * c, 0.05]])
    forces = np.array([u[0] + 0.1 * x[3] ** 2 * s, -0.2 * g * 0.5 * s])
    np.testing.assert_allclose(rate(models.cartpole(), x, u), [*x[2:], *np.linalg.solve(mass, forces)], **TIGHT)

    s, c, both = np.sin(x[1]), np.cos(x[1]), np.cos(x[0] + x[1])
    mass = np.array([[5 + 2 * c, 2 + c], [2 + c, 2]])
    bias = np.array([-(2 * x[2] * x[3] + x[3] ** 2) * s, s * x[2] ** 2])
    gravity = g * np.array([2 * np.cos(x[0]) + both, both])
    forces = np.array([0, u[0]]) - bias - gravity - x[2:]
    np.testing.assert_allclose(rate(models.acrobot(), x, u), [*x[2:], *np.linalg.solve(mass, forces)], **TIGHT)


@pytest.mark.parametrize("seed", range(3))
def test_quadrotor_is_a_rigid_body_under_its_rotors(seed: int) -> None:
    x, u = drawn(seed, 14, 4)
    x[3:7] /= np.linalg.norm(x[3:7])
    turned = Rotation.from_quat(np.roll(x[3:7], -1))  # SciPy has the scalar last
    found, w, inertia = rate(models.quadrotor(0.05), x, u), x[10:13], np.diag([0.0023, 0.0023, 0.004])
    np.testing.assert_allclose(found[7:10], turned.apply([0, 0, u.sum() / 0.5]) - [0, 0, 9.81], **TIGHT)
    torque = [0.175 * (u[1] - u[3]), 0.175 * (u[2] - u[0]), 0.0245 * (u[0] - u[1] + u[2] - u[3])]
    np.testing.assert_allclose(found[10:13], np.linalg.solve(inertia, torque - np.cross(w, inertia @ w)), **TIGHT)
    later = turned * Rotation.from_rotvec(1e-6 * w)
    np.testing.assert_allclose(x[3:7] + 1e-6 * found[3:7], np.roll(later.as_quat(), 1), atol=1e-11)
    assert found[13] == 20.0


@pytest.mark.parametrize("seed", range(3))
def test_airplane_has_the_forces_of_its_surfaces(seed: int) -> None:
    """Worked out once more from the published coefficients, with matrices that turn by the angles of attack."""
    noise, controls = drawn(seed, 13, 4)
    x = np.array([0, 0, 0, 0, 1, 0, 0, 5, 0, 0, 0, 0, 0]) + 0.1 * noise
    x[3:7] /= np.linalg.norm(x[3:7])
    u = np.array(airplane.TRIM_CONTROLS) + controls
    world, w = Rotation.from_quat(np.roll(x[3:7], -1)).as_matrix(), x[10:13]
    wash = np.array([5.568 * u[0] ** 0.199 - 8.859, 0, 0])
    flaps = (u[1:] - 106) * np.radians([15, 20, 35]) / 100
    wing, inner = 0.45 * (0.135 + 0.08) / 2, 2 * 0.06 * 0.135
    outer_arm = 0.45 / 6 * (1 + 2 * 0.08 / 0.135) / (1 + 0.08 / 0.135)
    places = [(0, side * arm, 0) for arm in (outer_arm, 0.06) for side in (1, -1)] + [(-0.22, 0, 0), (-0.24, 0, -0.02)]
    areas = [(wing - inner) / 2] * 2 + [inner / 2] * 2 + [0.16 * 0.05, 0.105 * 0.0525]
    turns = [0.63 * flaps[0], -0.63 * flaps[0]] * 2 + [0.88 * flaps[1], -0.76 * flaps[2]]
    total, torque = np.zeros(3), np.zeros(3)
    for i, (at, area, turn) in enumerate(zip(places, areas, turns, strict=True)):
        v = world.T @ x[7:10] + np.cross(w, at) + (wash if i > 1 else 0)
        axis = 1 if i == 5 else 2
        raw = np.arctan2(v[axis], v[0])
        a = raw + turn
        drag, lift = 2.08 * a**2 + 0.0612, -27.52 * a**3 - 0.6353 * a**2 + 6.089 * a
        if i >= 4:
            drag, lift = 4 * np.pi * a**2 / ((0.16, 0.105)[i - 4] ** 2 / area), 2 * np.pi * a
        about = Rotation.from_euler("z" if i == 5 else "y", raw if i == 5 else -raw)
        own = np.array([drag, lift, 0]) if i == 5 else np.array([drag, 0, lift])
        force = -0.6 * (v @ v) * area * about.apply(own)
        total, torque = total + force, torque + np.cross(at, force)
    total[0] += 0.006763 * (u[0] - 24)
    inertia = np.array([4.8944e-4, 6.3778e-4, 7.9509e-4])
    rotor = (0.007 * 0.0075**2 + 0.002 * 0.14**2 / 12) * 3000 * 2 * np.pi / 60 * 7 / 255 * u[0]
    spin = np.cross(inertia * w + [rotor, 0, 0], w)
    found = rate(airplane.airplane(), x, u)
    np.testing.assert_allclose(found[7:10], world @ total / 0.075 - [0, 0, 9.81], rtol=1e-9)
    np.testing.assert_allclose(found[10:13], (torque + spin) / inertia, rtol=1e-8, atol=1e-8)


def test_waypoints_cost_at_their_knots_alone() -> None:
    x, u = drawn(0, 14, 4)
    found = []
    for knot in (31, 32, 33, 65):
        x[13] = knot + 1e-9
        found.append(float(altro_problems.passing(x.tolist(), u.tolist(), SimpleNamespace(dt=0.05))))
    tilt, rest = np.sum((x[3:7] - [1, 0, 0, 0]) ** 2), np.sum(x[7:13] ** 2)
    for value, place, at, of_tilt, effort in (
        (found[0], (0, 0, 0), 1e-5, 1e-5, 0.05),
        (found[1], (10, 0, 1), 1.0, 1e-3, 1.0),
        (found[2], (0, 0, 0), 1e-5, 1e-5, 0.05),
        (found[3], (-10, 0, 1), 1.0, 1e-3, 1.0),
    ):
        states = at * np.sum((x[:3] - place) ** 2) + of_tilt * tilt + 1e-3 * rest
        assert value == pytest.approx(0.05 * states / 2 + effort * 1e-4 * (u @ u) / 2, rel=1e-12)


@pytest.mark.long
def test_quick_run_counts_what_keeps_the_constraints_at_least_cost() -> None:
    done = subprocess.run([sys.executable, SCRIPT, "--quick", "--json"], capture_output=True, text=True, check=True)
    said = json.loads(done.stdout)
    found = said["result"]["problems"]
    assert list(found) == ["double_integrator", "pendulum"]
    for one in found.values():
        assert one["status"] == "CONVERGED"
        assert 0 <= one["violation"] < 1e-6
        assert one["iterations"] > 1
    least = cheapest_double_integrator()
    assert found["double_integrator"]["cost"] == pytest.approx(least, rel=1e-5)
    counted = sum(one["to target"] <= one["theirs"] for one in found.values())
    assert counted == 2
    assert f"or fewer: in {counted} of 2" in said["report"]
    assert all(1 < one["to target"] <= one["iterations"] for one in found.values())
    assert [one["target"] for one in found.values()] == [0.74409, 0.02455]


def cheapest_double_integrator() -> float:
    """By SLSQP, over the forces."""
    dt = 0.1

    def states(forces: np.ndarray) -> np.ndarray:
        speeds = np.concatenate([[0], np.cumsum(forces) * dt])
        return np.stack([np.concatenate([[0], np.cumsum(speeds[:-1] * dt + forces * dt**2 / 2)]), speeds], axis=1)

    def cost(forces: np.ndarray) -> float:
        off = states(forces) - [1, 0]
        return float(dt / 2 * (np.sum(off[:-1] ** 2) + 0.1 * (forces @ forces)) + off[-1] @ off[-1] / 2)

    kept = [
        {"type": "eq", "fun": lambda forces: states(forces)[-1] - [1, 0]},
        {"type": "ineq", "fun": lambda forces: 0.6 - states(forces)[1:-1, 1]},
    ]
    found = minimize(
        cost, np.zeros(20), method="SLSQP", bounds=[(-3, 3)] * 20, constraints=kept, options={"ftol": 1e-12}
    )
    assert found.success
    return float(found.fun)
