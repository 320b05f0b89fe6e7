"""Robots that differ from the model for which the policy was designed.

Each class multiplies a parameter in the model of each trial by a factor: 1 plus a normal number, truncated at
three standard deviations and drawn for each trial; or a fixed factor. Filters and tubes also treat a fixed factor as
unknown: its mean is 1, and its standard deviation is its distance from 1.
"""

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco import batch

from lqrsim.annotations import Bounds, NonNegative, Want, checked
from lqrsim.control.uncertainty import GAIN, Uncertainty, Unknown, possible_unknowns
from lqrsim.errors import Array, InputError, check_name, keep
from lqrsim.results.solution_parts import Trajectory
from lqrsim.scenes.mjcf_kinematics import placed
from lqrsim.simulation.disturbances.actuation import check_gains
from lqrsim.simulation.disturbances.base import Disturbance, Effect, Numbers, words
from lqrsim.simulation.plant import Plant

CUT = 3.0  # standard deviations at which normal numbers are truncated
# The standard deviation of a truncated standard normal number.
CUT_STD = math.sqrt(1 - 2 * CUT * math.exp(-(CUT**2) / 2) / math.sqrt(2 * math.pi) / math.erf(CUT / math.sqrt(2)))


@checked
@dataclass(frozen=True)
class Mismatch(Disturbance):
    """Base class of mismatches.

    Args:
      std: relative standard deviation of the factor about 1, below 1/3, so that the factor is positive.
      factor: the factor itself, > 0, in place of `std`: one number, or one for each of `parts`.
    """

    std: Annotated[float, Bounds(at_least=0.0, below=1 / CUT)] | None = None
    factor: Numbers | None = None

    what: ClassVar[str]
    parameter: ClassVar[str]  # name of the simulator's parameter

    def __post_init__(self) -> None:
        name = type(self).__name__
        if (self.std is None) == (self.factor is None):
            got = "neither of" if self.std is None else "both"
            raise InputError(f"{name}: got {got} std and factor, want one of the two")
        if self.factor is not None:
            factor = self._checked("factor", self.factor)
            if not np.min(factor) > 0:
                raise InputError(f"{name}: factor: got {np.min(factor):g}, want numbers > 0")
            keep(self, factor=factor)

    def parts(self, plant: Plant) -> Sequence[str]:
        """The parts, each of which has its own factor."""
        return (self.what,)

    def check(self, plant: Plant) -> None:
        plant.check_simulator(type(self).__name__, self.parameter)

    def effect(self, plant: Plant, factors: Array) -> Effect:
        return Effect(factors={self.parameter: factors})

    def describe(self, plant: Plant) -> str:
        if self.factor is not None:
            return f"{self.what} times {words(self.factor)}"
        return f"{self.what} off by {100 * (self.std or 0.0):.3g} % (std, cut at {CUT:g} std)"

    def scaled(self, strength: float) -> "Mismatch":
        """The mismatch with `strength` times the standard deviation, or with a fixed factor raised to that power."""
        strength = self._strength(strength)
        if self.factor is None:
            return replace(self, std=strength * (self.std or 0.0))
        with np.errstate(over="ignore", under="ignore"):
            factor = np.asarray(self.factor) ** strength
        if not (np.isfinite(factor) & (factor > 0)).all():
            raise InputError(f"{type(self).__name__}: strength: got {strength:g}, want less: the result overflows")
        return replace(self, factor=float(factor) if factor.ndim == 0 else tuple(factor.tolist()))

    def _together(self, other: Disturbance) -> "Mismatch | None":
        if not isinstance(other, type(self)) or self.factor is None or other.factor is None:
            return None
        one, another = np.asarray(self.factor), np.asarray(other.factor)
        unlike = one.ndim and another.ndim and len(one) != len(another)
        return None if unlike else replace(self, factor=(one * another).tolist())

    def spread(self, plant: Plant) -> Array:
        """The standard deviation of each part's factor, (parts,). For a fixed factor, its distance from 1."""
        parts = self.parts(plant)
        if self.factor is None:
            return np.full(len(parts), CUT_STD * (self.std or 0.0))
        return np.abs(self._fit(self.factor, parts, "factor") - 1)

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        parts = self.parts(plant)
        if self.factor is None:
            factors = 1 + (self.std or 0.0) * np.array([[cut_normal(rng) for _ in parts] for rng in generators])
        else:
            factors = np.tile(self._fit(self.factor, parts, "factor"), (len(generators), 1))
        return self.effect(plant, factors)

    def _of_parameter(self, plant: Plant, name: str) -> Uncertainty:
        """The unknown of a mismatch that multiplies a parameter of the dynamics."""
        dynamics = plant.robot.dynamics
        nominal = abs((dynamics.disturbances | dynamics.parameters).get(name, 1.0))
        return self._unknowns(plant, [Unknown(name, nominal * float(self.spread(plant)[0]))])

    def _of_gains(self, plant: Plant, actuators: Sequence[str | None]) -> Uncertainty:
        """The unknowns of a mismatch that multiplies the effects of actuators, one per part."""
        controls, wanted, lost = controls_of(plant), list[Unknown](), list[str]()
        for part, actuator, std in zip(self.parts(plant), actuators, self.spread(plant), strict=True):
            if actuator in controls:
                wanted.append(Unknown(GAIN + controls[actuator], float(std)))
            elif std > 0:
                lost.append(part)
        left_out = self._left_out(plant, f"no control drives {', '.join(lost)} alone", acts=bool(lost))
        return replace(left_out, unknowns=self._unknowns(plant, wanted).unknowns)


class MassMismatch(Mismatch):
    """Another mass, as by a load at the centre of mass of each of the robot's bodies; the inertia does not change."""

    what = parameter = "mass"

    def uncertainty(self, plant: Plant) -> Uncertainty:
        dynamics, masses = plant.robot.dynamics, plant.model.body_mass
        loads = {load_of(plant, number): float(masses[number]) for number in plant.bodies if masses[number] > 0}
        if loads.keys() <= dynamics.disturbances.keys():  # true for a robot from an MJCF
            return self._unknowns(plant, [Unknown(loads, float(self.spread(plant)[0]))])
        return self._of_parameter(plant, "mass")


@checked
@dataclass(frozen=True)
class Payload(Disturbance):
    """A load in kg at the centre of mass of one body, unknown to the plan. For example, a gripper holds something.

    The load is the same in all trials. The body's inertia about its centre of mass does not change.
    """

    mass: NonNegative
    body: Annotated[str, Want("the name of a body")]

    _scales = "mass"

    def check(self, plant: Plant) -> None:
        plant.check_simulator(type(self).__name__)
        self._number(plant)

    def _number(self, plant: Plant) -> int:
        known = {plant.model.body(number).name: int(number) for number in plant.bodies}
        return known[check_name("Payload: body", self.body, known)]

    def describe(self, plant: Plant) -> str:
        return f"a load of {self.mass:g} kg on {self.body}"

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        number = self._number(plant)

        def alter(simulations: batch.Batch) -> None:
            simulations.expand("body_mass")[:, number] += self.mass

        return Effect(alter=alter)

    def _together(self, other: Disturbance) -> "Payload | None":
        if not isinstance(other, Payload) or other.body != self.body:
            return None
        return replace(self, mass=self.mass + other.mass)

    def uncertainty(self, plant: Plant) -> Uncertainty:
        load, total = load_of(plant, self._number(plant)), "mass"
        declared = possible_unknowns(plant.robot.dynamics)
        alone = load not in declared and total in declared and len(plant.bodies) == 1
        return self._unknowns(plant, [Unknown(total if alone else load, self.mass)])


class InertiaMismatch(Mismatch):
    """Another inertia of the robot's bodies about their centres of mass, by one factor for all axes; masses stay."""

    what = parameter = "inertia"

    def uncertainty(self, plant: Plant) -> Uncertainty:
        why = "it scales how fast torques turn the robot, for which predictions have no unknown"
        return self._left_out(plant, why, acts=bool(self.spread(plant).any()))


class ThrustMismatch(Mismatch):
    """Actuators that exert more or less force than commanded: their gains change. Not for servos."""

    what = parameter = "thrust"

    def check(self, plant: Plant) -> None:
        super().check(plant)
        check_gains(self, plant)
        if plant.model.actuator_biastype[plant.actuators].any():
            raise InputError(
                f"ThrustMismatch: got robot {plant.robot.name} with servos, want actuators that exert forces"
            )

    def parts(self, plant: Plant) -> Sequence[str]:
        return plant.robot.actuators

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return self._of_gains(plant, plant.robot.actuators)


class WheelMismatch(Mismatch):
    """Base class of the mismatches of wheels, which need a robot with wheels in MuJoCo."""

    @abc.abstractmethod
    def multiply(self, plant: Plant, simulations: batch.Batch, factors: Array) -> None:
        """Multiply fields of MuJoCo's models by factors (K, parts)."""

    def effect(self, plant: Plant, factors: Array) -> Effect:
        return Effect(alter=lambda simulations: self.multiply(plant, simulations, factors))

    def check(self, plant: Plant) -> None:
        plant.check_simulator(type(self).__name__)
        if not plant.robot.wheels:
            robot = f"robot {plant.robot.name}, which has no wheels"
            raise InputError(f"{type(self).__name__}: got {robot}, want one with their geoms in `wheels`")


class WheelRadiusMismatch(WheelMismatch):
    """Wheels that are larger or smaller, independently of each other; the robot stays level."""

    what = "wheel radius"

    def parts(self, plant: Plant) -> Sequence[str]:
        return plant.robot.wheels

    def multiply(self, plant: Plant, simulations: batch.Batch, factors: Array) -> None:
        wheels, hubs = wheel_geoms(plant)
        sizes = simulations.expand("geom_size")
        # Raise the axle by the difference of the radii, so that the wheel touches the floor and the casters do not.
        raised = sizes[:, wheels, 0] * (factors - 1)
        sizes[:, wheels] *= factors[:, :, None]
        parents = placed(plant.model).xmat[plant.model.body_parentid[hubs]].reshape(-1, 3, 3)
        simulations.expand("body_pos")[:, hubs] += raised[:, :, None] * parents[:, 2]  # upward, in their axes

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return self._of_gains(plant, [driven_by(plant, hub) for hub in wheel_geoms(plant)[1]])


class AxleMismatch(WheelMismatch):
    """Wheels that are further apart, or closer together."""

    what = "axle length"

    def multiply(self, plant: Plant, simulations: batch.Batch, factors: Array) -> None:
        _, hubs = wheel_geoms(plant)
        model, data, places = plant.model, placed(plant.model), simulations.expand("body_pos")
        parents = data.xmat[model.body_parentid[hubs]].reshape(-1, 3, 3)
        from_middle = np.einsum("hi,hij->hj", data.xpos[hubs] - data.xpos[hubs].mean(axis=0), parents)  # in their axes
        moved = places[:, hubs] - model.body_pos[hubs]  # by other mismatches
        longer = 1 + np.vecdot(moved, from_middle) / np.vecdot(from_middle, from_middle)
        places[:, hubs] += ((factors - 1) * longer)[:, :, None] * from_middle

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return self._of_parameter(plant, "axle_length")


class FrictionMismatch(WheelMismatch):
    """Another sliding friction between the wheels and the floor, the same for all wheels."""

    what = "friction of the wheels"

    def multiply(self, plant: Plant, simulations: batch.Batch, factors: Array) -> None:
        wheels, _ = wheel_geoms(plant)
        simulations.expand("geom_friction")[:, wheels, 0] *= factors

    def uncertainty(self, plant: Plant) -> Uncertainty:
        return self._left_out(plant, "the dynamics of plans have no friction", acts=bool(self.spread(plant).any()))


def load_of(plant: Plant, body: int) -> str:
    """The name of a load on that body, as robots from an MJCF use it."""
    return f"{plant.model.body(body).name}_load"


def controls_of(plant: Plant) -> dict[str | None, str]:
    """Map each actuator to the control that it is proportional to, if no other actuator depends on that control."""
    names = plant.robot.dynamics.control_coordinates.names
    commands = (level * np.eye(len(names)) for level in (0.0, 1.0, 2.0))
    at_zero, at_one, at_two = (np.array([plant.robot.actuation(row) for row in rows]) for rows in commands)
    follows = (at_one != at_zero) | (at_two != at_zero) | ~np.isfinite(at_one + at_two)  # (controls, MuJoCo's controls)
    controls: dict[str | None, str] = {}
    counts = plant.model.actuator_ctrlnum[plant.actuators]
    for j, actuator, count in zip(np.cumsum(counts) - counts, plant.robot.actuators, counts, strict=True):
        if count != 1:
            continue
        followed = np.flatnonzero(follows[:, j])
        if len(followed) == 1:
            i = followed[0]
            proportional = at_zero[i, j] == 0 and np.isclose(at_two[i, j], 2 * at_one[i, j], rtol=1e-9, atol=0)
            if proportional and follows[i].sum() == 1:
                controls[actuator] = names[i]
    return controls


def driven_by(plant: Plant, body: int) -> str | None:
    """The actuator that drives the joint of a body; None if there is none, or several."""
    model = plant.model
    actuators = [
        name
        for name, number in zip(plant.robot.actuators, plant.actuators, strict=True)
        if model.actuator_trntype[number] == mujoco.mjtTrn.mjTRN_JOINT
        and model.jnt_bodyid[model.actuator_trnid[number, 0]] == body
    ]
    return actuators[0] if len(actuators) == 1 else None


def cut_normal(generator: np.random.Generator) -> float:
    """A truncated standard normal number, from a single uniform number."""
    from scipy.special import ndtr, ndtri  # takes a fifth of a second to import

    low, high = ndtr((-CUT, CUT))
    return float(ndtri(low + (high - low) * generator.random()))


def wheel_geoms(plant: Plant) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Ids of the wheels' geoms, and of their bodies."""
    geoms = np.array([plant.model.geom(name).id for name in plant.robot.wheels], dtype=np.intp)
    return geoms, plant.model.geom_bodyid[geoms].astype(np.intp)
