"""The quadrotor's dynamics with derivatives by hand: as a user would write them for numba, or in SymPy's place."""

import inspect
import re
from math import cos, sin, sqrt
from typing import Any

import numba
import numpy as np

import lqrsim as ls
from lqrsim.codegen.sources import text_source
from lqrsim.codegen.symbolic import write_chain

# numba is told what lqrsim tells LLVM.
compiled: Any = numba.njit(fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy")


def compiled_level(symbolic: ls.Dynamics) -> ls.Dynamics:
    """The quadrotor's dynamics as functions for numba, otherwise like the symbolic ones."""
    return _restated(symbolic, quadrotor_rate, quadrotor_jacobian)


def inlined(symbolic: ls.Dynamics) -> ls.Dynamics:
    """The symbolic dynamics with the functions by hand in place of the text that SymPy wrote, and the same zeros."""
    dynamics = _restated(symbolic, symbolic.f)
    slopes = symbolic.rate_jacobian(np.linspace(0.1, 0.9, 12), np.linspace(1.0, 1.3, 4))
    filled = [
        f"{name}[{i}, {j}]" for name, slope in zip(("fx", "fu"), slopes, strict=True) for i, j in np.argwhere(slope)
    ]
    ratios, rate, jacobian = (_body(f, symbolic) for f in (_ratios, quadrotor_rate, quadrotor_jacobian))
    rate = rate.replace("return (", "rates = (") + "".join(f"    out[{i}] = rates[{i}]\n" for i in range(12))
    # The Jacobian needs what the rate begins with, three lines, and should not work it out twice.
    jacobian += rate.split("\n", 3)[3]
    source = f"def _ratios(s):\n{ratios}\ndef rate(x, u, p, out):\n{rate}\n"
    source += f"def rate_jacobian(x, u, p, out, fx, fu):\n{jacobian}\n"
    vars(dynamics)["source"] = text_source(
        source + write_chain(12, filled)
    )  # what cached_property would trace otherwise
    return dynamics


def _restated(symbolic: ls.Dynamics, f: Any, jacobian: Any = None) -> ls.Dynamics:
    states, controls = symbolic.state_coordinates, symbolic.control_coordinates
    return ls.Dynamics(
        f,
        jacobian=jacobian,
        states=dict(zip(states.names, states.units, strict=True)),
        controls=dict(zip(controls.names, controls.units, strict=True)),
        parameters=symbolic.parameters,
        position=states.names[:3],
        rotation_vectors=(states.names[6:9],),
    )


def _body(function: Any, dynamics: ls.Dynamics) -> str:
    """A function's text below its decorator and signature, with parameters by number."""
    text = inspect.getsource(function.py_func).split("\n", 2)[2]
    for place, name in enumerate(dynamics.parameters):
        text = re.sub(rf"\bp\.{name}\b", f"p[{place}]", text)
    return text


def check(symbolic: ls.Dynamics, by_hand: ls.Dynamics) -> float:
    """The largest difference in the rates and their derivatives, at turns from nothing to beyond a half."""
    rng, difference = np.random.default_rng(0), 0.0
    for size in (0.0, 1e-3, 0.1, 0.5, 1.5):
        x, u = size * rng.normal(size=12), 1.2 + 0.3 * rng.normal(size=4)
        pairs = [(symbolic.rate(x, u), by_hand.rate(x, u))]
        pairs += zip(symbolic.rate_jacobian(x, u), by_hand.rate_jacobian(x, u), strict=True)
        difference = max(difference, *(float(np.abs(a - b).max()) for a, b in pairs))
    if not difference < 1e-10:
        raise AssertionError(f"derivatives by hand: off by {difference:.1e} from the symbolic ones, want 1e-10")
    return difference


@compiled
def _ratios(s: float) -> tuple[float, float, float, float, float, float]:
    """sin t / t, (1 - cos t) / t^2 and (1 - t/2 cot(t/2)) / t^2 at t^2 = s, and their derivatives in s."""
    if s < 0.04:
        a = 1 + s * (-1 / 6 + s * (1 / 120 + s * (-1 / 5040 + s * (1 / 362880 - s / 39916800))))
        b = 0.5 + s * (-1 / 24 + s * (1 / 720 + s * (-1 / 40320 + s * (1 / 3628800 - s / 479001600))))
        c4, c5 = 1 / 47900160, 691 / 1307674368000
        c = 1 / 12 + s * (1 / 720 + s * (1 / 30240 + s * (1 / 1209600 + s * (c4 + s * c5))))
        da = -1 / 6 + s * (2 / 120 + s * (-3 / 5040 + s * (4 / 362880 - s * 5 / 39916800)))
        db = -1 / 24 + s * (2 / 720 + s * (-3 / 40320 + s * (4 / 3628800 - s * 5 / 479001600)))
        dc = 1 / 720 + s * (2 / 30240 + s * (3 / 1209600 + s * (4 * c4 + s * 5 * c5)))
        return a, b, c, da, db, dc
    t = sqrt(s)
    cosine = cos(t)
    a, b = sin(t) / t, (1 - cosine) / s
    c = (1 - a / (2 * b)) / s
    da, db = (cosine - a) / (2 * s), (a - 2 * b) / (2 * s)
    return a, b, c, da, db, (-(da * b - a * db) / (2 * b * b) - c) / s


@compiled
def quadrotor_rate(x, u, p):
    r0, r1, r2, w0, w1, w2 = x[6], x[7], x[8], x[9], x[10], x[11]
    s = r0 * r0 + r1 * r1 + r2 * r2
    a, b, c, _, _, _ = _ratios(s)
    thrust, drag = (u[0] + u[1] + u[2] + u[3]) / p.mass, p.drag / p.mass
    along, tilt = r0 * w0 + r1 * w1 + r2 * w2, p.arm / p.inertia
    return (
        x[3],
        x[4],
        x[5],
        thrust * (a * r1 + b * r0 * r2) - drag * x[3],
        thrust * (b * r1 * r2 - a * r0) - drag * x[4],
        thrust * (1 + b * (r2 * r2 - s)) - drag * x[5] - p.gravity,
        w0 + 0.5 * (r1 * w2 - r2 * w1) + c * (r0 * along - s * w0),
        w1 + 0.5 * (r2 * w0 - r0 * w2) + c * (r1 * along - s * w1),
        w2 + 0.5 * (r0 * w1 - r1 * w0) + c * (r2 * along - s * w2),
        tilt * (u[1] - u[3]),
        tilt * (u[2] - u[0]),
        p.torque_ratio / p.inertia * (u[0] - u[1] + u[2] - u[3]),
    )


@compiled
def quadrotor_jacobian(x, u, p, fx, fu):
    r0, r1, r2, w0, w1, w2 = x[6], x[7], x[8], x[9], x[10], x[11]
    s = r0 * r0 + r1 * r1 + r2 * r2
    a, b, c, da, db, dc = _ratios(s)
    thrust, along = (u[0] + u[1] + u[2] + u[3]) / p.mass, r0 * w0 + r1 * w1 + r2 * w2
    for i in range(3):
        fx[i, 3 + i] = 1.0
        fx[3 + i, 3 + i] = -p.drag / p.mass
    e0, e1, e2 = da * r1 + db * r0 * r2, db * r1 * r2 - da * r0, db * (r2 * r2 - s)
    d0, d1, d2 = r0 * along - s * w0, r1 * along - s * w1, r2 * along - s * w2
    for j in range(3):
        rj, wj = x[6 + j], x[9 + j]
        fx[3, 6 + j], fx[4, 6 + j], fx[5, 6 + j] = 2 * thrust * e0 * rj, 2 * thrust * e1 * rj, 2 * thrust * e2 * rj
        fx[6, 6 + j] = 2 * dc * d0 * rj + c * (r0 * wj - 2 * w0 * rj)
        fx[7, 6 + j] = 2 * dc * d1 * rj + c * (r1 * wj - 2 * w1 * rj)
        fx[8, 6 + j] = 2 * dc * d2 * rj + c * (r2 * wj - 2 * w2 * rj)
        fx[6, 9 + j], fx[7, 9 + j], fx[8, 9 + j] = c * r0 * rj, c * r1 * rj, c * r2 * rj
        fx[6 + j, 6 + j] += c * along
        fx[6 + j, 9 + j] += 1 - c * s
    fx[3, 6] += thrust * b * r2
    fx[3, 7] += thrust * a
    fx[3, 8] += thrust * b * r0
    fx[4, 6] -= thrust * a
    fx[4, 7] += thrust * b * r2
    fx[4, 8] += thrust * b * r1
    fx[5, 6] -= 2 * thrust * b * r0
    fx[5, 7] -= 2 * thrust * b * r1
    fx[6, 7] += 0.5 * w2
    fx[6, 8] -= 0.5 * w1
    fx[7, 6] -= 0.5 * w2
    fx[7, 8] += 0.5 * w0
    fx[8, 6] += 0.5 * w1
    fx[8, 7] -= 0.5 * w0
    fx[6, 10] -= 0.5 * r2
    fx[6, 11] += 0.5 * r1
    fx[7, 9] += 0.5 * r2
    fx[7, 11] -= 0.5 * r0
    fx[8, 9] -= 0.5 * r1
    fx[8, 10] += 0.5 * r0
    for j in range(4):
        fu[3, j] = (a * r1 + b * r0 * r2) / p.mass
        fu[4, j] = (b * r1 * r2 - a * r0) / p.mass
        fu[5, j] = (1 + b * (r2 * r2 - s)) / p.mass
        fu[11, j] = p.torque_ratio / p.inertia * (1 - 2 * (j % 2))
    fu[9, 1], fu[9, 3] = p.arm / p.inertia, -p.arm / p.inertia
    fu[10, 2], fu[10, 0] = p.arm / p.inertia, -p.arm / p.inertia
