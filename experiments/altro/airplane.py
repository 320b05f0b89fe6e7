"""The aeroplane of the barrel roll: a small aerobatic model with tapered wings, flaps and propeller wash.

Body axes: x out of the nose, y out of the right wing, z down. The original clamps controls to 0 to 255, which here are
their limits, and angles of attack to a right angle either way, which is left out: `unclamped` tells whether a plan is
the same with that.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import lqrsim as ls
from altro.models import GRAVITY, QUATERNION, added, cross, rotation, times, turning

MASS, INERTIA = 0.075, (4.8944e-4, 6.3778e-4, 7.9509e-4)  # kg, kg m^2
MOTOR = 0.007 * 0.0075**2 + 0.002 * 0.14**2 / 12  # kg m^2, with the propeller
AIR = 1.2  # kg/m^3
# Wing, m: its span is 0.45, from a chord of 0.135 at the root to 0.08 at the tip; the inner part is in the wash.
SPAN, WASHED, ROOT, TIP = 0.45, 0.06, 0.135, 0.08
INNER = 2 * WASHED * ROOT
OUTER = SPAN * (TIP + ROOT) / 2 - INNER
AILERON = SPAN / 6 * (1 + 2 * TIP / ROOT) / (1 + TIP / ROOT)  # arm
ELEVATOR, RUDDER = 0.16 * 0.05, 0.105 * 0.0525  # m^2
ELEVATOR_RATIO, RUDDER_RATIO = 0.16**2 / ELEVATOR, 0.105**2 / RUDDER
ELEVATOR_AT, RUDDER_AT = (-0.22, 0, 0), (-0.24, 0, -0.02)
TRIM, IDLE = 106, 24  # controls, of 0 to 255, without deflection and without thrust
# rad a unit of each control, times how much of it acts as an angle of attack
AILERON_GAIN = 0.63 * np.radians(15) / 100
ELEVATOR_GAIN = 0.88 * np.radians(20) / 100
RUDDER_GAIN = 0.76 * np.radians(35) / 100
THRUST, SPEED = 0.006763, 3000 * 2 * np.pi / 60 * 7 / 255  # N, and rad/s of the motor, a unit of throttle
TRIM_CONTROLS = (41.6666, 106.0, 74.6519, 106.0)


@dataclass(frozen=True)
class Surface:
    """A part of the wing, or of the tail.

    Attributes:
      at: where it is, in m. area: in m^2. velocity: against the air, with the wash, in m/s. deflection: of its flap, as
        an angle of attack, in rad. kind: "wing", "elevator" or "rudder", which stands upright.
    """

    at: Sequence[Any]
    area: float
    velocity: list[Any]
    deflection: Any
    kind: str

    @property
    def across(self) -> Any:
        """The velocity across it."""
        return self.velocity[1 if self.kind == "rudder" else 2]

    @property
    def angle(self) -> Any:
        """Of attack, with that of its flap."""
        from sympy import atan2

        return atan2(self.across, self.velocity[0]) + self.deflection

    @property
    def force(self) -> list[Any]:
        """Drag and lift: of the wing by fits to gliding tests, of the tail as of flat plates."""
        from sympy import pi, sqrt

        a, v = self.angle, self.velocity
        if self.kind == "wing":
            drag, lift = 2.08 * a**2 + 0.0612, -27.52 * a**3 - 0.6353 * a**2 + 6.089 * a
        else:
            ratio = ELEVATOR_RATIO if self.kind == "elevator" else RUDDER_RATIO
            drag, lift = 4 * pi * a**2 / ratio, 2 * pi * a
        pressure = AIR / 2 * self.area * (v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
        speed = sqrt(v[0] ** 2 + self.across**2)
        c, s = v[0] / speed, self.across / speed
        forward, side = -pressure * (c * drag - s * lift), -pressure * (s * drag + c * lift)
        return [forward, side, 0] if self.kind == "rudder" else [forward, 0, side]


def surfaces(x: Sequence[Any], u: Sequence[Any]) -> list[Surface]:
    """All of them, in the body's axes."""
    from sympy import Piecewise

    w, world = x[10:13], rotation(x[3:7])
    v = times([list(column) for column in zip(*world, strict=True)], x[7:10])
    throttle, aileron, elevator, rudder = u
    wash, still = [Piecewise((5.568 * throttle**0.199 - 8.859, throttle > IDLE), (0, True)), 0, 0], [0, 0, 0]
    found = []
    for side in (1, -1):
        for arm, area, blown in ((AILERON, OUTER / 2, still), (WASHED, INNER / 2, wash)):
            at = [0, side * arm, 0]
            flap = side * AILERON_GAIN * (aileron - TRIM)
            found.append(Surface(at, area, added(v, cross(w, at), blown), flap, "wing"))
    for kind, at, area, flap in (
        ("elevator", ELEVATOR_AT, ELEVATOR, ELEVATOR_GAIN * (elevator - TRIM)),
        ("rudder", RUDDER_AT, RUDDER, -RUDDER_GAIN * (rudder - TRIM)),
    ):
        found.append(Surface(at, area, added(v, cross(w, at), wash), flap, kind))
    return found


def _rate(x: Any, u: Any, p: Any) -> list[Any]:
    from sympy import Piecewise

    w, parts = x[10:13], surfaces(x, u)
    forces = [part.force for part in parts]
    force = added(*forces, [Piecewise((THRUST * (u[0] - IDLE), u[0] > IDLE), (0, True)), 0, 0])
    motor = Piecewise((MOTOR * SPEED * u[0], u[0] > IDLE), (0, True))
    spin = [INERTIA[0] * w[0] + motor, INERTIA[1] * w[1], INERTIA[2] * w[2]]
    torque = added(*[cross(part.at, one) for part, one in zip(parts, forces, strict=True)], cross(spin, w))
    acceleration = [entry / MASS for entry in times(rotation(x[3:7]), force)]
    acceleration[2] -= GRAVITY
    return [*x[7:10], *turning(x[3:7], w), *acceleration, *[torque[i] / INERTIA[i] for i in range(3)]]


def airplane() -> ls.Dynamics:
    """Position, quaternion, velocity in the world's axes, angular velocity in the body's."""
    states = {"x": "m", "y": "m", "z": "m", **QUATERNION, "vx": "m/s", "vy": "m/s", "vz": "m/s"}
    states |= {"wx": "rad/s", "wy": "rad/s", "wz": "rad/s"}
    return ls.Dynamics(
        _rate,
        states=states,
        controls=dict.fromkeys(("throttle", "aileron", "elevator", "rudder"), ""),
        control_limits=(0, 255),
    )


def unclamped(plan: ls.Trajectory) -> bool:
    """Whether a plan stays, at its knots, where no clamp of the original would act."""
    angles = [
        float(part.angle)
        for x, u in zip(plan.states[:-1], plan.controls, strict=True)
        for part in surfaces(x.tolist(), u.tolist())
    ]
    return bool(np.abs(angles).max() <= np.pi / 2)
