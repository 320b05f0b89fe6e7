"""What every disturbance has in common: found by name, validated, scaled, repeatable to the last bit, composable."""

import dataclasses
import itertools
import re

import numpy as np
import pytest
from tracking import hover, weave

import lqrsim as ls
from lqrsim.disturbances import (
    ActuatorLoss,
    AxleMismatch,
    CommandDropouts,
    ControlDelay,
    ControlNoise,
    ControlOffset,
    DisplacedObstacles,
    Dryden,
    ForceNoise,
    FrictionMismatch,
    Gusts,
    InertiaMismatch,
    InitialStateError,
    MassMismatch,
    MeanWind,
    MeasurementBias,
    MeasurementDropouts,
    MeasurementLatency,
    MeasurementNoise,
    MotorLag,
    Payload,
    Push,
    Saturation,
    Sensor,
    SensorErrors,
    ThrustMismatch,
    TorqueNoise,
    WheelRadiusMismatch,
)
from lqrsim.errors import InputError
from lqrsim.robots.packaged import DifferentialDrive, Quadrotor
from lqrsim.scenes.scene import load_scene
from lqrsim.simulation import disturbances
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import KINDS, PRESETS, Disturbance, GilbertElliott, preset
from lqrsim.simulation.plant import Plant

RECORDS = (
    "states", "measured", "commanded", "applied", "forces", "torques", "displaced", "clearance", "contacts", "frames",
)  # fmt: skip

# One of each that both robots can have, and those of the one and the other.
BOTH = [
    InitialStateError(0.01), DisplacedObstacles(0.05), MassMismatch(0.1), InertiaMismatch(0.1),
    MeasurementNoise(0.005), MeasurementBias(0.005), MeasurementLatency(1),
    MeasurementDropouts(GilbertElliott(0.2, 0.5)), ControlNoise(0.02), ControlOffset(0.02), CommandDropouts(0.2),
    ControlDelay(1), MotorLag(0.05), Saturation(share=0.9), ActuatorLoss(at=0.2, remaining=0.7),
    ForceNoise(0.1), TorqueNoise(0.002), Push((0.1, 0.0, 0.0), at=0.1),
]  # fmt: skip
OWN = {
    "cage": [
        ThrustMismatch(0.05),
        MeanWind((0.5, 0.2, 0.0)),
        Gusts(0.5, 0.5),
        Dryden("light"),
        Payload(0.02, "quadrotor"),
        SensorErrors([Sensor("quadrotor_gyro", noise=0.1)]),
    ],
    "arena": [
        WheelRadiusMismatch(0.01),
        AxleMismatch(0.02),
        FrictionMismatch(0.1),
    ],
}
EXAMPLES = {type(one).__name__: one for one in (*BOTH, *OWN["cage"], *OWN["arena"])}
FITTING = [(name, one) for name, own in OWN.items() for one in (*BOTH, *own)]
NAMED = [f"{type(one).__name__} in the {name}" for name, one in FITTING]


@pytest.fixture(scope="module")
def plants():
    return {"arena": Plant(DifferentialDrive(), load_scene("arena")), "cage": Plant(Quadrotor(), load_scene("cage"))}


@pytest.fixture(scope="module")
def solutions():
    return {"arena": weave(10), "cage": hover(10)}


@pytest.fixture(scope="module")
def calm(plants, solutions):
    return {name: simulate(plants[name], solutions[name], trials=2) for name in plants}


def assert_same(one, other, trials=slice(None)):
    for name in RECORDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name)[trials], err_msg=name)


def test_every_class_is_found_by_its_name_and_exported():
    assert set(EXAMPLES) == set(KINDS)
    for name, kind in KINDS.items():
        assert kind.__name__ == name
        assert kind is getattr(ls.disturbances, name) is getattr(disturbances, name)
        assert dataclasses.is_dataclass(kind)
        assert dataclasses.fields(kind)
        assert kind.__doc__
        assert "describe" in {key for base in kind.__mro__[:-3] for key in vars(base)}
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(EXAMPLES[name], dataclasses.fields(kind)[0].name, 0)
    assert "GilbertElliott" in disturbances.__all__
    assert set(disturbances.__all__) >= set(KINDS)


@pytest.mark.parametrize("kind", [*KINDS.values(), ls.belief.ReadingErrors], ids=lambda kind: kind.__name__)
def test_what_decides_on_losses_is_discrete(kind):
    """A splitting then says that it may miss failures by them."""
    assert kind.discrete or "loss" not in {field.name for field in dataclasses.fields(kind)}


@pytest.mark.parametrize(("fixture", "one"), FITTING, ids=NAMED)
def test_a_trial_is_the_same_alone_and_among_four_and_each_trial_is_its_own(plants, solutions, calm, fixture, one):
    plant, solution = plants[fixture], solutions[fixture]
    together = simulate(plant, solution, disturbances=[one], seed=3, trials=4)
    assert not together.diverged.any()
    for trial in (0, 3):
        alone = simulate(plant, solution, disturbances=[one], seed=3, first_trial=trial)
        assert_same(alone, together, slice(trial, trial + 1))
    assert_same(simulate(plant, solution, disturbances=[one], seed=3, trials=4), together)
    # It does something.
    changed = any((getattr(together, name) != getattr(calm[fixture], name)[:1]).any() for name in RECORDS)
    # These plans keep the limits of the one, and this policy does not read the sensors of the other.
    assert changed or isinstance(one, Saturation | SensorErrors)


@pytest.mark.parametrize("fixture", ["arena", pytest.param("cage", marks=pytest.mark.long)])
def test_all_compose(plants, solutions, fixture):
    plant, solution, every = plants[fixture], solutions[fixture], [*BOTH, *OWN[fixture]]
    together = simulate(plant, solution, disturbances=every, seed=1, trials=9)
    assert not together.diverged.any()
    assert len(set(together.disturbances)) == len(every)
    for trial in (0, 8):
        alone = simulate(plant, solution, disturbances=every, seed=1, first_trial=trial)
        assert_same(alone, together, slice(trial, trial + 1))
    # In any order, twice over, and each with each other.
    assert not simulate(plant, solution, disturbances=[*every[::-1], *every], trials=2).diverged.any()
    short = weave(4) if fixture == "arena" else hover(8)
    for pair in itertools.combinations_with_replacement(every, 2):
        assert not simulate(plant, short, disturbances=pair).diverged.any()


def test_what_changes_the_same_thing_multiplies_and_adds(plants):
    cage, solution = plants["cage"], hover(6)
    twice = simulate(
        cage,
        solution,
        disturbances=[MassMismatch(factor=1.1), MassMismatch(factor=1.2)],
    )
    once = simulate(cage, solution, disturbances=[MassMismatch(factor=1.32)])
    np.testing.assert_allclose(twice.states, once.states, atol=1e-12)
    lost = [
        ActuatorLoss("quadrotor_rotor_2", remaining=0.5),
        ThrustMismatch(factor=0.8),
    ]
    both = simulate(cage, solution, disturbances=lost)
    same = simulate(cage, solution, disturbances=[ThrustMismatch(factor=(0.8, 0.4, 0.8, 0.8))])
    np.testing.assert_allclose(both.states, same.states, atol=1e-12)
    winds = simulate(
        cage,
        solution,
        disturbances=[
            MeanWind((1, 0, 0)),
            MeanWind((0, 2, 0)),
            Push((0, 0, 1), 0),
        ],
    )
    np.testing.assert_allclose(winds.forces[0, :2], [[0.15, 0.3, 30], [0.15, 0.3, 0]])


@pytest.mark.parametrize(("fixture", "one"), FITTING, ids=NAMED)
def test_strength_0_is_no_effect_and_strength_1_itself(plants, solutions, calm, fixture, one):
    plant, solution = plants[fixture], solutions[fixture]
    none = simulate(plant, solution, disturbances=[one.scaled(0)], trials=2)
    for name in RECORDS:
        # The constants that MuJoCo derives from an altered model are rounded anew.
        wanted = getattr(calm[fixture], name)
        np.testing.assert_allclose(getattr(none, name), wanted, rtol=0, atol=1e-9, err_msg=name)
    itself = simulate(plant, solution, disturbances=[one], trials=2)
    assert_same(simulate(plant, solution, disturbances=[one.scaled(1)], trials=2), itself)
    assert type(one.scaled(2)) is type(one)
    assert one.scaled(2) != one
    simulate(plant, solution, disturbances=[one.scaled(2)])
    for bad in (-1.0, np.nan, np.inf, "twice"):
        with pytest.raises(InputError, match=f"^{type(one).__name__}: strength: got .*, want a finite number >= 0$"):
            one.scaled(bad)


def test_strengths_in_between():
    assert MeasurementNoise((0.1, 0.2)).scaled(0.5) == MeasurementNoise((0.05, 0.1))
    assert MassMismatch(factor=1.21).scaled(0.5).factor == pytest.approx(1.1)
    assert MassMismatch(0.1).scaled(2) == MassMismatch(0.2)
    assert ControlDelay(1).scaled(2.5) == ControlDelay(3)
    assert MeasurementDropouts(0.4).scaled(3) == MeasurementDropouts(1.0)
    assert ActuatorLoss(remaining=0.6).scaled(0.5).remaining == pytest.approx(0.8)
    assert ActuatorLoss(remaining=0.6).scaled(4).remaining == 0.0
    assert Dryden("light").scaled(3).std == pytest.approx(Dryden("severe").std)  # pyright: ignore[reportAttributeAccessIssue]
    wanted = r"^MassMismatch: std: got 0.4, want a finite number >= 0 and < 0.3333333333333333$"
    with pytest.raises(InputError, match=wanted):
        MassMismatch(0.1).scaled(4)

    class Silent(Disturbance):
        def start(self, plant, plan, generators):
            return disturbances.Effect()

    with pytest.raises(InputError, match=r"^Silent: got strength 2, want one that overrides `scaled`$"):
        Silent().scaled(2)


SIGNED = {"impulse", "velocity", "lowest", "highest", "direction"}  # numbers that may be negative
BAD = [(name, field.name) for name, one in EXAMPLES.items() for field in dataclasses.fields(one)]


@pytest.mark.parametrize(("name", "field"), BAD)
def test_a_bad_number_is_refused_in_one_line_that_names_class_and_field(name, field):
    one = EXAMPLES[name]
    values = {f.name: getattr(one, f.name) for f in dataclasses.fields(one)}
    # Of fields that exclude each other, the others are left out.
    apart = {"lowest": {"share"}, "highest": {"share"}, "factor": {"std"}}.get(field, set())
    values |= dict.fromkeys(apart)
    bad = [np.nan, np.inf, -np.inf, [np.nan] * 3, object()] + ([] if field in SIGNED else [-1.0, -1])
    if (name, field) not in {("ActuatorLoss", "actuator"), ("Payload", "body")}:
        bad.append("much")
    for value in bad:
        with pytest.raises(InputError) as caught:
            type(one)(**values | {field: value})
        message = str(caught.value)
        assert re.match(rf"{name}: {field}: got .*, want ", message), message
        assert "\n" not in message


def test_descriptions_are_in_words_and_units(plants):
    words = {name: [one.describe(plant) for one in (*BOTH, *OWN[name])] for name, plant in plants.items()}
    assert words["cage"] == [
        "initial state off, std 0.01 m, 0.01 m/s, 0.01 rad, 0.01 rad/s",
        "obstacles displaced, std 0.05 m",
        "mass off by 10 % (std, cut at 3 std)",
        "inertia off by 10 % (std, cut at 3 std)",
        "measurement noise, std 0.005 m, 0.005 m/s, 0.005 rad, 0.005 rad/s",
        "measurement bias, std 0.005 m, 0.005 m/s, 0.005 rad, 0.005 rad/s",
        "measurements late by 1 control period",
        "28.6 % of measurements lost, in bad spells of 2 control periods on average",
        "control noise, std 0.02 N",
        "control offset, std 0.02 N",
        "20 % of commands lost",
        "commands late by 1 control period",
        "motor lag, time constant 0.05 s",
        "controls limited to 90 % of the robot's own",
        "one of quadrotor_rotor_1, quadrotor_rotor_2, quadrotor_rotor_3, quadrotor_rotor_4 down to 70 % from 0.2 s on",
        "force noise, std 0.1 N",
        "torque noise, std 0.002 N m",
        "push of (0.1, 0, 0) N s at 0.1 s",
        "thrust off by 5 % (std, cut at 3 std)",
        "wind of (0.5, 0.2, 0) m/s",
        "gusts, std 0.5 m/s, time constant 0.5 s",
        "light Dryden turbulence at 2 m, wind 7.72 m/s at 20 ft",
        "a load of 0.02 kg on quadrotor",
        "errors of sensors, times 1: quadrotor_gyro (noise 0.1, bias 0 and 0 in 1 s, loss 0)",
    ]
    assert words["arena"][-3:] == [
        "wheel radius off by 1 % (std, cut at 3 std)",
        "axle length off by 2 % (std, cut at 3 std)",
        "friction of the wheels off by 10 % (std, cut at 3 std)",
    ]
    assert Saturation(lowest=0.5, highest=2.0).describe(plants["cage"]) == "controls limited from 0.5 N to 2 N"
    assert AxleMismatch(factor=1.1).describe(plants["arena"]) == "axle length times 1.1"


@pytest.mark.parametrize("fixture", ["arena", "cage"])
def test_presets_have_what_a_plant_can_have_and_grow(plants, solutions, fixture):
    plant, worst = plants[fixture], []
    for name in PRESETS:
        chosen = preset(name, plant)
        rollout = simulate(plant, weave(60) if fixture == "arena" else hover(), disturbances=chosen, trials=20)
        assert not rollout.diverged.any()
        worst.append(np.median(rollout.tracking_error.max(axis=1)))
    assert list(PRESETS) == ["calm", "light", "moderate", "strong", "severe"]
    assert worst == sorted(worst)
    kinds = {type(one).__name__ for one in preset("moderate", plant)}
    assert ("Dryden" in kinds, "ThrustMismatch" in kinds) == (fixture == "cage",) * 2
    assert ("AxleMismatch" in kinds) == (fixture == "arena")
    with pytest.raises(InputError, match=r"^preset: got 'mild', want one of: calm, light, moderate, strong, severe"):
        preset("mild", plant)


@pytest.mark.parametrize("fixture", ["arena", "cage"])
@pytest.mark.parametrize("name", PRESETS)
def test_presets_can_be_twice_as_strong(plants, solutions, fixture, name):
    """The strengths that `lqrsim stress` sweeps over by default."""
    twice = [one.scaled(2.0) for one in preset(name, plants[fixture])]
    rollout = simulate(plants[fixture], solutions[fixture], disturbances=twice, trials=3)
    assert len(rollout.disturbances) == len(twice)
