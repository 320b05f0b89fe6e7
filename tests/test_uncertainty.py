"""From disturbances to numbers for filters and tubes, against what the disturbances do when they are drawn."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
from tracking import hover, weave

import lqrsim as ls
from lqrsim.control.uncertainty import per_entry
from lqrsim.disturbances import (
    ActuatorLoss,
    AxleMismatch,
    CommandDropouts,
    ControlDelay,
    ControlNoise,
    ControlOffset,
    DisplacedObstacles,
    Disturbance,
    Dryden,
    Effect,
    ForceNoise,
    FrictionMismatch,
    GilbertElliott,
    Gusts,
    InertiaMismatch,
    InitialStateError,
    MassMismatch,
    MeanWind,
    MeasurementBias,
    MeasurementDropouts,
    MeasurementLatency,
    MotorLag,
    Payload,
    Push,
    Saturation,
    Sensor,
    SensorErrors,
    ThrustMismatch,
    TorqueNoise,
    Unknown,
    WheelRadiusMismatch,
)
from lqrsim.errors import InputError
from lqrsim.results.solution_parts import Trajectory
from lqrsim.robots.packaged import Quadrotor
from lqrsim.scenes.scene import load_scene
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import KINDS, PRESETS, preset
from lqrsim.simulation.plant import Plant

DT = 1 / 30
# One of each; "in words" are those that no linear model has.
EXAMPLES = [
    InitialStateError(0.01), DisplacedObstacles(0.05), MassMismatch(0.1), ls.disturbances.MeasurementNoise(0.005),
    MeasurementLatency(1), MeasurementDropouts(0.2), CommandDropouts(0.2), ControlNoise(0.02),
    ControlOffset(0.02), ControlDelay(1), MotorLag(0.05), ForceNoise(0.1), TorqueNoise(0.002), ThrustMismatch(0.05),
    MeanWind((0.5, 0.2, 0.0)), Gusts(0.5, 0.5), Dryden("light"), WheelRadiusMismatch(0.01),
    AxleMismatch(0.02), Payload(0.02, "quadrotor"),
]  # fmt: skip
IN_WORDS = [
    InertiaMismatch(0.1), MeasurementBias(0.005), Saturation(share=0.9),
    ActuatorLoss(at=0.2, remaining=0.7), Push((0.1, 0.0, 0.0), at=0.1), FrictionMismatch(0.1),
    SensorErrors([Sensor("quadrotor_gyro", noise=0.1)]),
]  # fmt: skip


@pytest.fixture(scope="module")
def plant_of(cage, arena):
    on_wheels = WheelRadiusMismatch, AxleMismatch, FrictionMismatch
    return lambda one: arena if isinstance(one, on_wheels) else cage


def named(uncertainty):
    return {one.name: one for one in uncertainty.unknowns}


@pytest.mark.parametrize("one", [*EXAMPLES, *IN_WORDS], ids=lambda one: type(one).__name__)
def test_each_disturbance_is_in_numbers_or_left_out_by_name_and_nothing_at_strength_zero(plant_of, one):
    plant, stated = plant_of(one), ls.uncertainty_of(plant_of(one), [one])
    if one in IN_WORDS:
        assert stated == ls.disturbances.Uncertainty()
        assert re.fullmatch(rf"{re.escape(one.describe(plant))}: .+", stated.left_out[0])
    else:
        assert stated != ls.disturbances.Uncertainty()
        assert stated.left_out == ()
    none = ls.uncertainty_of(plant, [one.scaled(0.0)])
    assert (none, none.left_out) == (ls.disturbances.Uncertainty(), ())


def test_no_kind_is_forgotten():
    assert {type(one).__name__ for one in (*EXAMPLES, *IN_WORDS)} == set(KINDS)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_of_the_quadrotor_are_the_numbers_written_out(cage, name):
    k, stated = PRESETS[name], ls.uncertainty_of(cage, preset(name, cage))
    units = cage.robot.dynamics.state_coordinates
    measured = {"m": 0.005 * k, "m/s": 0.05 * k, "rad": 0.005 * k, "rad/s": 0.005 * k}
    np.testing.assert_allclose(per_entry("", stated.measurement, units), per_entry("", measured, units), rtol=1e-12)
    np.testing.assert_allclose(per_entry("", stated.start, units), 0.01 * k, rtol=1e-12)
    controls = cage.robot.dynamics.control_coordinates
    np.testing.assert_allclose(per_entry("", stated.control, controls), 0.0371 * k, rtol=1e-12)  # 1 % of 3.71 N
    numbers = stated.lag, stated.loss, stated.command_loss, stated.obstacles, stated.delay, stated.latency
    np.testing.assert_allclose(numbers, (0.024 * k, 0.01 * k, 0.01 * k, 0.01 * k, 0, 0), rtol=1e-12)
    of = named(stated)
    cut = 0.98658  # the standard deviation of a standard normal number that is cut at 3
    np.testing.assert_allclose(of["mass"].std, 0.02 * k * 0.5 * cut, rtol=1e-5)
    for i in (1, 2, 3, 4):
        np.testing.assert_allclose(of[f"gain of rotor_{i}"].std, 0.04 * k * cut, rtol=1e-5)
    for axis in "xyz":
        assert of[f"force_{axis}"].white
        np.testing.assert_allclose(of[f"force_{axis}"].std, 0.01 * 0.5 * 9.8 * k, rtol=1e-12)
    wind = Dryden("light", altitude=2.0).scaled(k)
    for axis, std, length, order in zip("xyz", wind.std, wind.lengths, (1, 2, 2), strict=True):
        one = of[f"wind_{axis}"]
        assert one.order == order
        np.testing.assert_allclose((one.std, one.time_constant), (std, length / wind.airspeed), rtol=1e-12)
    assert len(of) == 11
    assert [words.split(" ")[0] for words in stated.left_out] == ["inertia"]


def test_the_cut_normal_numbers_have_the_standard_deviation_that_is_stated(cage):
    """Of 100,000 drawn factors: the standard error of their standard deviation is at most 1 / sqrt(2 N), 0.22 %."""
    from lqrsim.simulation.disturbances.mismatch import cut_normal

    drawn = np.array([cut_normal(generator) for generator in [np.random.default_rng(0)] * 100_000])
    (mass,) = ls.uncertainty_of(cage, [MassMismatch(0.1)]).unknowns
    np.testing.assert_allclose(mass.std, 0.1 * 0.5 * drawn.std(), rtol=0.01)
    assert mass.std != 0.05


def blown(plant, wind, trials, steps):
    """Winds as they are drawn, in m/s, (trials, steps, 3)."""
    plan = Trajectory(np.zeros((steps + 1, 12)), np.zeros((steps, 4)), DT)
    effect = wind.start(plant, plan, [np.random.default_rng((7, trial)) for trial in range(trials)])
    return np.stack([effect.wind(step, np.zeros((trials, 12))) for step in range(steps)], axis=1)


def covariance_of(unknowns, lag):
    """Of winds with those some seconds earlier, (3, 3), in closed form."""
    total = np.zeros((3, 3))
    for one in unknowns:
        share, past = np.array([one.shares.get(f"wind_{axis}", 0.0) for axis in "xyz"]), lag / one.time_constant
        # Dryden's longitudinal and lateral correlation functions.
        correlation = np.exp(-past) if one.order == 1 else np.exp(-past) * (1 - past / 2)
        total += one.std**2 * correlation * np.outer(share, share)
    return total


@pytest.mark.parametrize(
    "wind",
    [
        Gusts((1.0, 0.5, 2.0), 0.4),
        Dryden(4.0, altitude=3.0),
        Dryden("moderate", 6.0, direction=0.7),
    ],
    ids=["gusts", "dryden", "dryden, turned"],
)
def test_winds_have_the_covariance_and_autocorrelation_that_is_stated(cage, wind):
    trials, steps = 4000, 40
    winds, unknowns = blown(cage, wind, trials, steps), ls.uncertainty_of(cage, [wind]).unknowns
    scale = np.sqrt(np.diag(covariance_of(unknowns, 0.0)))
    for at, lag in ((0, 0), (0, 1), (10, 4), (10, 29)):
        found = np.einsum("ki,kj->ij", winds[:, at + lag], winds[:, at]) / trials
        # The standard error of each is at most sqrt(2 / N) of the product of the standard deviations.
        error = np.abs(found - covariance_of(unknowns, lag * DT)) / np.outer(scale, scale)
        assert error.max() < 4.5 * np.sqrt(2 / trials)


def test_a_constant_wind_is_a_constant_of_its_size(cage):
    x, y = ls.uncertainty_of(cage, [MeanWind((1.5, -0.5, 0.0))]).unknowns
    assert (x.name, x.std, x.constant, y.name, y.std, y.constant) == ("wind_x", 1.5, True, "wind_y", 0.5, True)


def test_one_simulated_step_scatters_as_stated(cage):
    """Covariance of where 3,000 trials are after a control period in MuJoCo, and of the model by differences."""
    trials, solution, robot = 3000, hover(1).open_loop(), cage.robot
    wrong = [
        InitialStateError([0.01] * 3 + [0.02] * 3 + [0.01] * 3 + [0.03] * 3), MassMismatch(0.08),
        ThrustMismatch(0.05), ControlNoise(0.03), ForceNoise((0.1, 0.2, 0.3)), TorqueNoise(0.01),
    ]  # fmt: skip
    stated = ls.uncertainty_of(cage, wrong)
    assert len(stated.unknowns) == 1 + 4 + 3 + 3
    ends = simulate(cage, solution, disturbances=wrong, trials=trials, seed=1, contacts=False, frames=False)
    deviation = ends.states[:, 1] - solution.trajectory.states[1]
    x, u, model = solution.trajectory.states[0], solution.trajectory.controls[0], robot.dynamics.disturbed
    a, b, _ = model.linearize(x, u, DT)
    spaces = robot.dynamics.state_coordinates, robot.dynamics.control_coordinates
    columns = [a * per_entry("", stated.start, spaces[0]), b * per_entry("", stated.control, spaces[1])]
    for one in stated.unknowns:
        if (control := one.name.removeprefix("gain of ")) != one.name:
            i = robot.dynamics.control_coordinates.names.index(control)
            columns.append(one.std * b[:, i : i + 1] * u[i])
        else:
            h = 1e-5
            ahead = (
                model.with_parameters(**{one.name: model.parameters[one.name] + d}).step(x, u, DT) for d in (h, -h)
            )
            columns.append(one.std * (next(ahead) - next(ahead))[:, None] / (2 * h))
    onto = np.concatenate(columns, axis=1)
    expected, found = onto @ onto.T, deviation.T @ deviation / trials
    scale = np.sqrt(np.diag(expected))
    # Sampling: 4.5 standard errors. Beyond it, what is not linear and MuJoCo's own integration, 1 %.
    assert (np.abs(found - expected) / np.outer(scale, scale)).max() < 4.5 * np.sqrt(2 / trials) + 0.01


@pytest.mark.parametrize(
    ("wrong", "name", "amount"),
    [
        (WheelRadiusMismatch(factor=(1.02, 1.0)), "gain of left", 0.02),
        (WheelRadiusMismatch(factor=(1.0, 0.98)), "gain of right", -0.02),
        (AxleMismatch(factor=1.03), "axle_length", 0.03 * 0.258),
    ],
)
def test_wheels_that_are_off_take_the_drive_where_the_unknown_that_is_stated_does(arena, wrong, name, amount):
    (stated,) = ls.uncertainty_of(arena, [wrong]).unknowns
    assert (stated.name, stated.constant) == (name, True)
    np.testing.assert_allclose(stated.std, abs(amount), rtol=1e-12)
    plan, dynamics = weave(36).open_loop(), arena.robot.dynamics
    controls = plan.trajectory.controls.copy()
    if name == "axle_length":
        dynamics = dynamics.with_parameters(axle_length=0.258 + amount)
    else:
        controls[:, dynamics.control_coordinates.names.index(name.removeprefix("gain of "))] *= 1 + amount
    states = [plan.trajectory.states[0]]
    for control in controls:
        states.append(dynamics.step(states[-1], control, plan.trajectory.dt))
    moved = np.array(states) - plan.trajectory.states
    calm, off = simulate(arena, plan), simulate(arena, plan, disturbances=[wrong])
    found = (off.states - calm.states)[0]
    # Wheels on a floor in MuJoCo slip a little, and follow their commands a little late.
    assert (np.abs(found - moved).max(axis=0) < 0.05 * np.abs(moved).max(axis=0)).all()


def test_obstacles_are_displaced_by_the_rms_of_the_axes_that_count(cage, arena):
    wrong = DisplacedObstacles((0.03, 0.04, 0.1))
    np.testing.assert_allclose(ls.uncertainty_of(cage, [wrong]).obstacles, np.sqrt(0.0125 / 3), rtol=1e-12)
    np.testing.assert_allclose(ls.uncertainty_of(arena, [wrong]).obstacles, np.sqrt(0.0025 / 2), rtol=1e-12)


def test_losses_in_bursts_count_by_their_share(cage):
    bursts = GilbertElliott(0.1, 0.3, 0.02, 0.9)
    assert ls.uncertainty_of(cage, [MeasurementDropouts(bursts)]).loss == pytest.approx(0.25 * 0.9 + 0.75 * 0.02)


def test_several_add_up(cage):
    twice = ls.uncertainty_of(
        cage,
        [ControlNoise(0.03), ControlNoise([0.04] * 4), ControlDelay(1)] * 2,
    )
    controls = cage.robot.dynamics.control_coordinates
    np.testing.assert_allclose(per_entry("", twice.control, controls), np.sqrt(2) * 0.05, rtol=1e-12)
    assert twice.delay == 2


@pytest.mark.parametrize("seed", range(6))
def test_parts_of_a_fixed_value_are_that_value(cage, arena, seed):
    """Winds that add up, even to none, factors that multiply and loads on one body, in any order with what is drawn."""
    rng = np.random.default_rng(seed)
    parts = 1 if seed == 0 else int(rng.integers(2, 5))
    winds, loads = rng.normal(size=(parts, 3)), rng.uniform(0.0, 0.02, size=parts)
    winds[-1] -= winds.sum(axis=0) * [1.0, 0.0, 0.0]
    factors, wheels = rng.uniform(0.9, 1.1, size=parts), rng.uniform(0.9, 1.1, size=(parts, 2))
    drawn = [Gusts(0.5), MassMismatch(0.1), Dryden("light")]
    for plant, split, whole in (
        (
            cage,
            [
                *(MeanWind(wind) for wind in winds), *(Payload(load, "quadrotor") for load in loads),
                *(MassMismatch(factor=factor) for factor in factors), *drawn,
            ],
            [
                MeanWind(winds.sum(axis=0)), Payload(loads.sum(), "quadrotor"), MassMismatch(factor=factors.prod()),
                *drawn,
            ],
        ),
        (
            arena, [WheelRadiusMismatch(factor=factor) for factor in wheels],
            [WheelRadiusMismatch(factor=wheels.prod(axis=0))],
        ),
    ):  # fmt: skip
        shuffled = [split[i] for i in rng.permutation(len(split))]
        found, wanted = (ls.uncertainty_of(plant, some).unknowns for some in (shuffled, whole))
        numbers = [
            sorted((unknown.name, unknown.time_constant, unknown.std) for unknown in some if unknown.std > 1e-12)
            for some in (found, wanted)
        ]
        assert [row[:2] for row in numbers[0]] == [row[:2] for row in numbers[1]]
        np.testing.assert_allclose([row[2] for row in numbers[0]], [row[2] for row in numbers[1]], rtol=1e-9)


def test_what_the_robot_does_not_declare_is_left_out_by_name(arena):
    stated = ls.uncertainty_of(
        arena,
        [
            ForceNoise(0.1),
            TorqueNoise((0.0, 0.0, 0.1)),
            MassMismatch(0.1),
        ],
    )
    assert stated == ls.disturbances.Uncertainty()
    missing = [re.search(r"have no (.*)$", words) for words in stated.left_out]
    assert [one and one[1] for one in missing] == ["force_x, force_y, force_z", "torque_z", "mass"]


@dataclasses.dataclass(frozen=True)
class Swept(Quadrotor):
    """Whose controls 1 and 2 both turn rotors 1 and 2, and whose third actuator goes with the square."""

    def actuation(self, control):
        one, two, three, four = np.moveaxis(np.asarray(control, dtype=float), -1, 0)
        return np.stack([(one + two) / 2, (one + 3 * two) / 4, three**2 / 4, four / 2], axis=-1)


def test_only_what_a_control_does_alone_and_in_proportion_is_its_gain():
    stated = ls.uncertainty_of(Plant(Swept(), load_scene("cage")), [ThrustMismatch(0.05)])
    assert list(named(stated)) == ["gain of rotor_4"]
    (words,) = stated.left_out
    assert words.endswith("no control drives quadrotor_rotor_1, quadrotor_rotor_2, quadrotor_rotor_3 alone")


@dataclasses.dataclass(frozen=True)
class Own(Disturbance):
    """One of a user's own."""

    told: Any = None

    def start(self, plant, plan, generators):
        return Effect()


@dataclasses.dataclass(frozen=True)
class OwnInNumbers(Own):
    def uncertainty(self, plant):
        return self.told


def test_those_of_ones_own(cage):
    assert ls.uncertainty_of(cage, [Own()]).left_out == ("Own(told=None): Own does not override `uncertainty`",)
    told = ls.disturbances.Uncertainty(unknowns=[Unknown("force_x", 0.2)])
    assert ls.uncertainty_of(cage, [OwnInNumbers(told)]) == told
    with pytest.raises(InputError, match=r"^OwnInNumbers: uncertainty: got 3, want a method that returns"):
        ls.uncertainty_of(cage, [OwnInNumbers(3)])
    two = ls.disturbances.Uncertainty(start=(0.1, 0.2))
    with pytest.raises(InputError, match=r"^Uncertainty: start: got 12 and 2 numbers, want as many of each$"):
        ls.uncertainty_of(cage, [ls.disturbances.InitialStateError(0.1), OwnInNumbers(two)])
    wrong = ls.disturbances.Uncertainty(unknowns=[Unknown("forse_x", 0.2)])
    with pytest.raises(InputError, match=r"^Uncertainty: unknowns: got 'forse_x', want .*force_x"):
        ls.uncertainty_of(cage, [OwnInNumbers(wrong)])
