"""Each disturbance does what its numbers say, in their units, and refuses what does not fit."""

import pickle
from typing import Any

import hypothesis
import numpy as np
import pytest
from comparing import assert_white
from hypothesis import strategies as st
from mechanisms import sled
from scipy import stats
from tracking import hover, weave

import lqrsim as ls
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import (
    ControlNoise,
    ControlOffset,
    ForceNoise,
    InitialStateError,
    MeasurementBias,
    MeasurementNoise,
    Push,
)
from lqrsim.stress.study import disturbances_as_json, disturbances_from_json

TRIALS = 40


def test_control_noise(arena, cage):
    rollout = simulate(cage, hover(), disturbances=[ControlNoise(0.05)], trials=TRIALS)
    assert not rollout.saturated.any()
    assert_white(rollout.applied - rollout.commanded, 0.05)
    rollout = simulate(arena, weave(60), disturbances=[ControlNoise((0.01, 0.03))], trials=TRIALS)
    assert_white(rollout.applied - rollout.commanded, [0.01, 0.03])


def test_a_control_offset_is_constant_in_a_trial_and_of_its_size_over_trials(arena):
    rollout = simulate(arena, weave(10), disturbances=[ControlOffset((0.01, 0.03))], trials=TRIALS)
    assert not rollout.saturated.any()
    offsets = rollout.applied - rollout.commanded
    np.testing.assert_allclose(offsets, np.broadcast_to(offsets[:, :1], offsets.shape), atol=1e-15)  # rounding
    # Sums of squares are chi-squared: outside of these two quantiles once in 500,000.
    sums = (offsets[:, 0] ** 2).sum(axis=0) / np.square([0.01, 0.03])
    low, high = stats.chi2.ppf([1e-6, 1 - 1e-6], TRIALS)
    assert ((low < sums) & (sums < high)).all()


def test_measurement_noise_is_in_the_unit_of_each_state_and_leaves_the_true_state(cage):
    std = np.repeat([0.02, 0.05, 0.01, 0.03], 3)
    rollout = simulate(cage, hover(), disturbances=[MeasurementNoise(std.tolist())], trials=TRIALS)
    assert_white(rollout.measured - rollout.states, std)
    undisturbed = simulate(cage, hover())
    np.testing.assert_array_equal(undisturbed.measured, undisturbed.states)


def test_force_noise_accelerates_by_force_over_mass(cage):
    rollout = simulate(cage, hover(), disturbances=[ForceNoise((0.1, 0.2, 0.3))], trials=TRIALS)
    assert_white(rollout.forces, [0.1, 0.2, 0.3])
    # One period on: the analytic step, plus force / mass for one period less what drag (0.3 / s) takes of it.
    robot, dt = cage.robot, 1 / 30
    expected = robot.dynamics.step(rollout.states[3, 7], rollout.applied[3, 7], dt)
    gained = rollout.states[3, 8, 3:6] - expected[3:6]
    decay = robot.drag / robot.mass
    np.testing.assert_allclose(gained, rollout.forces[3, 7] / robot.mass * (1 - np.exp(-decay * dt)) / decay, atol=1e-7)


def test_a_push_delivers_its_impulse_in_the_period_that_contains_it(cage):
    robot, impulse = cage.robot, np.array([0.05, -0.02, 0.03])
    rollout = simulate(cage, hover(), disturbances=[Push(impulse.tolist(), at=0.51)])
    period = 15  # from 0.5 s on
    np.testing.assert_array_equal(np.flatnonzero(rollout.forces[0].any(axis=1)), [period])
    np.testing.assert_allclose(rollout.forces[0].sum(axis=0) / 30, impulse)
    gained = rollout.states[0, period + 1, 3:6] - rollout.plan.states[period + 1, 3:6]
    np.testing.assert_allclose(gained, impulse / robot.mass, rtol=0.01)  # drag takes 0.5 % over the period
    # A time that is a knot belongs to the period that begins there, whatever its rounding.
    at_knot = simulate(cage, hover(), disturbances=[Push(impulse.tolist(), at=0.7)])
    np.testing.assert_array_equal(np.flatnonzero(at_knot.forces[0].any(axis=1)), [21])


def test_a_push_moves_the_differential_drive_at_its_centre_of_mass(arena):
    free = simulate(arena, weave(12))
    pushed = simulate(arena, weave(12), disturbances=[Push((0.0, 3.0, 0.0), at=1.0)])  # 18 N, friction holds 28 N
    shoved = simulate(arena, weave(12), disturbances=[Push((0.0, 9.0, 0.0), at=1.0)])  # 54 N
    aside = [abs(run.states[0, 7, 1] - free.states[0, 7, 1]) for run in (pushed, shoved)]
    assert aside[0] < 0.02
    assert aside[1] > 0.1
    assert np.abs(shoved.states[0, 7, 2] - free.states[0, 7, 2]) < 0.3


def test_descriptions_are_readable_and_in_units(arena, cage):
    assert ForceNoise(0.1).describe(cage) == "force noise, std 0.1 N"
    assert ControlNoise(0.05).describe(cage) == "control noise, std 0.05 N"
    assert ControlNoise((0.05, 0.1)).describe(arena) == "control noise, std (0.05, 0.1) m/s"
    assert MeasurementNoise((0.01, 0.01, 0.02)).describe(arena) == "measurement noise, std 0.01 m, 0.02 rad"
    assert Push((0.3, 0.0, 0.0), at=2.0).describe(cage) == "push of (0.3, 0, 0) N s at 2 s"


@pytest.mark.parametrize("gravity", ["0 0 -9.81", "0 0 0"])
def test_a_preset_has_no_disturbance_of_size_zero(gravity: str) -> None:
    """The force is a share of the weight, which there is not without gravity, and a control without limits has none."""
    robot = ls.MjcfRobot(scene_from_xml(sled(option=f'gravity="{gravity}"'), "puck"))
    found = {type(one).__name__ for one in ls.disturbances.preset("light", ls.Plant(robot, robot.scene))}
    assert ("ForceNoise" in found) == (gravity != "0 0 0")
    assert "MeasurementNoise" in found
    assert "ControlNoise" not in found


@hypothesis.given(
    st.dictionaries(st.sampled_from(["m", "rad", "x", "y", "heading"]), st.floats(0, 1), min_size=1),
    st.sampled_from([MeasurementNoise, MeasurementBias, InitialStateError]),
    st.floats(0, 2),
)
def test_numbers_by_name_or_unit_are_those_in_order(arena, named: dict[str, float], kind: Any, strength: float) -> None:
    """A name comes before a unit; what is not named is 0. The same bits, words, record and description for filters."""
    units = {"x": "m", "y": "m", "heading": "rad"}
    in_order = kind([named.get(name, named.get(unit, 0.0)) for name, unit in units.items()])
    one, other = kind(named).scaled(strength), in_order.scaled(strength)
    assert one.describe(arena) == other.describe(arena)
    assert one.uncertainty(arena) == other.uncertainty(arena)
    assert pickle.loads(pickle.dumps(one)) == one
    first, second = (simulate(arena, weave(4), disturbances=[each], seed=3).measured for each in (one, other))
    np.testing.assert_array_equal(first, second)
    scenario = ls.scenarios.differential_drive()
    (again,) = disturbances_from_json(disturbances_as_json([one], scenario), scenario)
    assert again == one
