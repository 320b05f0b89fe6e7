"""Constant wind, gusts, and Dryden turbulence; in a liquid, currents.

They act through the robot's linear drag, F = drag * wind, as the velocity of the fluid of an MJCF (`density`,
`viscosity`), or as the wind of a simulator that simulates wind.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from lqrsim.annotations import Bounds, Finite, Positive, checked
from lqrsim.control.uncertainty import Uncertainty, Unknown
from lqrsim.errors import Array, InputError, check_array, check_name, check_number, keep
from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.disturbances.base import Disturbance, Effect, GaussianDisturbance, Numbers, normal, words
from lqrsim.simulation.plant import Plant

FOOT = 0.3048  # m
KNOT = 1852 / 3600  # m/s
SEVERITIES = {"light": 15 * KNOT, "moderate": 30 * KNOT, "severe": 45 * KNOT}  # m/s at 20 ft, MIL-F-8785C
ROUGHNESS = 0.15  # ft, roughness length of the ground in MIL-F-8785C's mean wind near landing


class Wind(Disturbance):
    """Base class of winds, which need a robot with drag, an MJCF with a fluid, or a simulator with a wind."""

    def check(self, plant: Plant) -> None:
        if not plant.robot.drag > 0 and not plant.has_medium:
            wanted = "one with a `drag` in N s/m, or an MJCF with the density or viscosity of a fluid"
            robot = f"robot {plant.robot.name}, which wind cannot push without drag"
            raise InputError(f"{type(self).__name__}: got {robot}, want {wanted}")

    def blow(self, wind: Array) -> Effect:
        """The effect of winds (K, T, 3) in m/s, held over each control period."""
        return Effect(wind=lambda step, states: wind[:, step])


@dataclass(frozen=True)
class MeanWind(Wind):
    """A constant wind, or a current.

    Args:
      velocity: velocity of the wind in m/s along the world's axes, (3,). In an MJCF with a fluid it is added to the
        file's own `wind`.
    """

    velocity: Sequence[float]

    _scales = "velocity"

    def __post_init__(self) -> None:
        keep(self, velocity=tuple(check_array("MeanWind: velocity", self.velocity, (3,)).tolist()))

    def describe(self, plant: Plant) -> str:
        return f"wind of {words(self.velocity)} m/s"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        return self.blow(np.broadcast_to(self.velocity, (len(generators), plan.steps, 3)))

    def _together(self, other: Disturbance) -> "MeanWind | None":
        return MeanWind(np.add(self.velocity, other.velocity).tolist()) if isinstance(other, MeanWind) else None

    def uncertainty(self, plant: Plant) -> Uncertainty:
        """An unknown constant along each axis, of mean zero, with the size of the wind's part there as std."""
        winds = zip("xyz", self.velocity, strict=True)
        return self._unknowns(plant, [Unknown(f"wind_{axis}", abs(speed)) for axis, speed in winds])


@checked
@dataclass(frozen=True)
class Gusts(Wind, GaussianDisturbance):
    """Gusts, or currents, that rise and fade: an Ornstein-Uhlenbeck process on each axis.

    It is in its stationary state from the start.

    Args:
      std: standard deviation of the wind in m/s; one number, or three along the world's axes.
      time_constant: seconds in which the correlation falls to 1/e.
    """

    std: Numbers = 1.0
    time_constant: Positive = 1.0

    along = "xyz"

    def describe(self, plant: Plant) -> str:
        return f"gusts, std {words(self.std)} m/s, time constant {self.time_constant:g} s"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        noise = normal(generators, plan.steps, 3)
        return self.blow(self._fit(self.std, self.along) * first_order(noise, plan.dt / self.time_constant))

    def uncertainty(self, plant: Plant) -> Uncertainty:
        winds = zip(self.along, self._fit(self.std, self.along), strict=True)
        return self._unknowns(plant, [Unknown(f"wind_{axis}", std, self.time_constant) for axis, std in winds])


@checked
@dataclass(frozen=True)
class Dryden(Wind):
    """Dryden turbulence near the ground, without its mean wind (MIL-F-8785C, below 1000 ft).

    The robot is assumed to be slow relative to the wind: the turbulence passes with the mean wind at its altitude.

    Args:
      wind: mean wind at 20 ft in m/s, or "light", "moderate" or "severe": 15, 30 or 45 knots.
      altitude: altitude above the ground in m; below 10 ft it counts as 10 ft.
      direction: direction towards which the mean wind blows, in rad from the world's x axis towards its y axis.
    """

    wind: float | str = "light"
    altitude: Annotated[float, Bounds(at_least=0.0, at_most=1000 * FOOT)] = 2.0
    direction: Finite = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.wind, str):
            check_name("Dryden: wind", self.wind, SEVERITIES)
        else:
            keep(self, wind=check_number("Dryden: wind", self.wind, at_least=0.0))

    @property
    def wind_at_20_ft(self) -> float:
        """Mean wind at 20 ft in m/s."""
        return SEVERITIES[self.wind] if isinstance(self.wind, str) else self.wind

    @property
    def airspeed(self) -> float:
        """Mean wind at the altitude in m/s."""
        return self.wind_at_20_ft * np.log(self._feet / ROUGHNESS) / np.log(20 / ROUGHNESS)

    @property
    def std(self) -> tuple[float, float, float]:
        """Standard deviations along the mean wind, across it and upward, in m/s."""
        upward = 0.1 * self.wind_at_20_ft
        level = upward / (0.177 + 0.000823 * self._feet) ** 0.4
        return level, level, upward

    @property
    def lengths(self) -> tuple[float, float, float]:
        """Length scales along the mean wind, across it and upward, in m."""
        level = self._feet / (0.177 + 0.000823 * self._feet) ** 1.2
        return level * FOOT, level * FOOT, self._feet * FOOT

    @property
    def _feet(self) -> float:
        return max(self.altitude / FOOT, 10.0)

    def describe(self, plant: Plant) -> str:
        severity = f"{self.wind} " if isinstance(self.wind, str) else ""
        return f"{severity}Dryden turbulence at {self.altitude:g} m, wind {self.wind_at_20_ft:.3g} m/s at 20 ft"

    def scaled(self, strength: float) -> "Dryden":
        return replace(self, wind=self._times(self.wind_at_20_ft, strength))

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        noise = normal(generators, plan.steps, 5)
        steps = self.airspeed * plan.dt / np.array(self.lengths)
        along = self.std[0] * first_order(noise[..., :1], steps[0])[..., 0]
        across = self.std[1] * second_order(noise[..., 1:3], steps[1])
        upward = self.std[2] * second_order(noise[..., 3:], steps[2])
        cosine, sine = np.cos(self.direction), np.sin(self.direction)
        return self.blow(np.stack([cosine * along - sine * across, sine * along + cosine * across, upward], -1))

    def uncertainty(self, plant: Plant) -> Uncertainty:
        if self.wind_at_20_ft == 0:
            return Uncertainty()
        constants = np.array(self.lengths) / self.airspeed
        cosine, sine = np.cos(self.direction), np.sin(self.direction)
        # The cosine of a right angle is a rounding error instead of zero.
        along, across = (
            {name: float(share) for name, share in zip(("wind_x", "wind_y"), shares, strict=True) if abs(share) > 1e-12}
            for shares in ((cosine, sine), (-sine, cosine))
        )
        parts = zip(((along, 1), (across, 2), ("wind_z", 2)), self.std, constants, strict=True)
        return self._unknowns(plant, [Unknown(of, std, constant, order) for (of, order), std, constant in parts])


def first_order(noise: Array, step: float) -> Array:
    """White noise (K, T, d) through 1 / (1 + s), stationary with variance 1; `step` is in time constants."""
    values, keep = np.empty_like(noise), np.exp(-step)
    strength = np.sqrt(-np.expm1(-2 * step))
    values[:, 0] = noise[:, 0]
    for t in range(1, noise.shape[1]):
        values[:, t] = keep * values[:, t - 1] + strength * noise[:, t]
    return values


def second_order(noise: Array, step: float) -> Array:
    """White noise (K, T, 2) through (1 + sqrt(3) s) / (1 + s)^2: (K, T), stationary with variance 1.

    The state is (p, p'), with p'' + 2 p' + p = 2 w. In the stationary state both have variance 1 and are uncorrelated.
    """
    decay = np.exp(-step)
    a, b, c, d = decay * (1 + step), decay * step, -decay * step, decay * (1 - step)
    # The covariance of a step's noise, I - F F', preserves the stationary covariance I.
    covariance = np.eye(2) - np.array([[a * a + b * b, a * c + b * d], [a * c + b * d, c * c + d * d]])
    variances, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(variances, 0.0))
    values = np.empty(noise.shape[:2])
    place, rate = noise[:, 0, 0], noise[:, 0, 1]
    for t in range(noise.shape[1]):
        if t:
            first, second = noise[:, t, 0], noise[:, t, 1]
            place, rate = (
                a * place + b * rate + root[0, 0] * first + root[0, 1] * second,
                c * place + d * rate + root[1, 0] * first + root[1, 1] * second,
            )
        values[:, t] = (place + np.sqrt(3) * rate) / 2
    return values
