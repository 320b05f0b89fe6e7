"""Measurements and commands that are late, lost or off, and actuators that are slow, weak or lost."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from comparing import assert_white
from scipy.integrate import solve_ivp
from tracking import hover, track

from lqrsim.errors import InputError
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import (
    ActuatorLoss,
    CommandDropouts,
    ControlDelay,
    ControlNoise,
    GilbertElliott,
    MeasurementBias,
    MeasurementDropouts,
    MeasurementLatency,
    MeasurementNoise,
    MotorLag,
    Saturation,
    TorqueNoise,
)
from lqrsim.simulation.disturbances.base import seeded

DT = 1 / 30
RESTLESS = MeasurementNoise(1e-3)  # so that no two states or commands are equal


def test_torque_noise_turns_by_torque_over_inertia(cage):
    rollout = simulate(cage, hover(), disturbances=[TorqueNoise((0.001, 0.002, 0.003))], trials=40)
    assert_white(rollout.torques, [0.001, 0.002, 0.003])
    expected = cage.robot.dynamics.step(rollout.states[0, 0], rollout.applied[0, 0], DT)
    gained = rollout.states[0, 1, 9:] - expected[9:]
    np.testing.assert_allclose(gained, rollout.torques[0, 0] / cage.robot.inertia * DT, rtol=1e-3)  # begins upright


def test_a_bias_is_constant_in_a_trial_and_differs_between_trials(cage):
    std, trials = np.repeat([0.02, 0.05, 0.01, 0.03], 3), 300
    rollout = simulate(cage, hover(10), disturbances=[MeasurementBias(std.tolist())], trials=trials)
    bias = rollout.measured - rollout.states
    np.testing.assert_allclose(bias, np.broadcast_to(bias[:, :1], bias.shape), atol=1e-14)
    scaled = bias[:, 0] / std
    assert np.abs(scaled.mean(axis=0)).max() < 4 / np.sqrt(trials)
    assert np.abs(scaled.std(axis=0) - 1).max() < 4 / np.sqrt(2 * trials)


@pytest.mark.parametrize("periods", [0, 1, 3])
def test_latency_shows_the_state_of_so_many_periods_ago(cage, periods):
    rollout = simulate(cage, hover(20), disturbances=[MeasurementLatency(periods), RESTLESS], trials=2)
    late = simulate(cage, hover(20), disturbances=[MeasurementLatency(periods)], trials=2)
    np.testing.assert_array_equal(late.measured, late.states[:, np.maximum(np.arange(21) - periods, 0)])
    # What comes after it in the list is not late.
    shown = rollout.states[:, np.maximum(np.arange(21) - periods, 0)]
    assert 0 < np.abs(rollout.measured - shown).max() < 0.01


@pytest.mark.parametrize("periods", [0, 1, 3])
def test_delayed_commands_arrive_whole_periods_late_after_the_plans_own(cage, periods):
    rollout = simulate(cage, hover(20), disturbances=[RESTLESS, ControlDelay(periods)], trials=2)
    np.testing.assert_array_equal(rollout.applied[:, periods:], rollout.commanded[:, : 20 - periods])
    for trial in range(2):
        np.testing.assert_array_equal(rollout.applied[trial, :periods], rollout.plan.controls[:periods])


def received(lost, first, sent):
    """By hand: the last that came."""
    last, out = first, []
    for gone, one in zip(lost, sent, strict=True):
        last = last if gone else one
        out.append(last)
    return np.array(out)


@pytest.mark.parametrize("loss", [0.3, GilbertElliott(0.1, 0.4, lost_when_good=0.05, lost_when_bad=0.9)])
def test_what_is_lost_is_replaced_by_the_last_that_came(cage, loss):
    trials, steps = 200, 60
    solution = hover(steps)
    rollout = simulate(cage, solution, disturbances=[RESTLESS, MeasurementDropouts(loss)], trials=trials)
    held = (rollout.measured[:, 1:] == rollout.measured[:, :-1]).all(axis=-1)
    lost = np.column_stack([(rollout.measured[:, 0] == solution.trajectory.states[0]).all(axis=-1), held])
    noisy = simulate(cage, solution, disturbances=[RESTLESS], trials=trials)  # the noise alone, its stream the same
    noise = noisy.measured - noisy.states
    for trial in (0, 7):
        sent = rollout.states[trial] + noise[trial]
        expected = received(lost[trial], solution.trajectory.states[0], sent)
        np.testing.assert_allclose(rollout.measured[trial], expected, atol=1e-12)
    commands = simulate(cage, solution, disturbances=[RESTLESS, CommandDropouts(loss)], trials=trials)
    held = (commands.applied[:, 1:] == commands.applied[:, :-1]).all(axis=-1)
    gone = np.column_stack([(commands.applied[:, 0] == solution.trajectory.controls[0]).all(axis=-1), held])
    for trial in (0, 7):
        expected = received(gone[trial], solution.trajectory.controls[0], commands.commanded[trial])
        np.testing.assert_array_equal(commands.applied[trial], expected)
    # The share that is lost, within four standard errors of trials that are independent.
    stated = loss.lost if isinstance(loss, GilbertElliott) else loss
    for losses in (lost, gone):
        share = losses.mean(axis=1)
        assert abs(share.mean() - stated) < 4 * share.std() / np.sqrt(trials)


def test_bursts_are_as_long_as_they_say_and_stationary_from_the_start():
    link = GilbertElliott(to_bad=0.05, to_good=0.25)
    trials, steps = 2000, 200
    lost = link.draw(steps, [np.random.default_rng(trial) for trial in range(trials)])
    assert link.lost == pytest.approx(1 / 6)
    error = np.sqrt(link.lost * (1 - link.lost) / trials)
    assert np.abs(lost.mean(axis=0) - link.lost).max() < 4.5 * error  # at each time
    after_loss, after_none = lost[:, 1:][lost[:, :-1]], lost[:, 1:][~lost[:, :-1]]
    assert abs(after_loss.mean() - 0.75) < 4 * np.sqrt(0.75 * 0.25 / after_loss.size)
    assert abs(after_none.mean() - 0.05) < 4 * np.sqrt(0.05 * 0.95 / after_none.size)
    # Losses on their own have no memory.
    plain = MeasurementDropouts(0.2).draw(steps, [np.random.default_rng(trial) for trial in range(trials)])
    again = plain[:, 1:][plain[:, :-1]]
    assert abs(again.mean() - 0.2) < 4 * np.sqrt(0.2 * 0.8 / again.size)


@pytest.mark.parametrize("time_constant", [0.005, 0.072, 0.5])
def test_motor_lag_is_the_mean_of_the_differential_equation_over_each_period(cage, time_constant):
    solution = hover(20)
    rollout = simulate(cage, solution, disturbances=[ControlNoise(0.3), MotorLag(time_constant)])
    quick = simulate(cage, solution, disturbances=[ControlNoise(0.3)])  # noise of the same stream
    noise = (quick.applied - quick.commanded)[0]
    reached = solution.trajectory.controls[0]
    for step in range(20):
        command = rollout.commanded[0, step] + noise[step]

        def rate(_, both, command=command):
            return np.concatenate([(command - both[:4]) / time_constant, both[:4]])

        solved = solve_ivp(rate, (0, DT), np.concatenate([reached, np.zeros(4)]), rtol=1e-10, atol=1e-12)
        reached, mean = solved.y[:4, -1], solved.y[4:, -1] / DT
        np.testing.assert_allclose(rollout.applied[0, step], mean, rtol=0, atol=1e-8)
    assert not rollout.saturated.any()


@pytest.mark.parametrize("seed", range(4))
def test_limits_that_meet_stay_where_they_met(arena, seed):
    """At each strength as at the one found by small steps, within the robot's own limits, on one side or both."""
    rng, space = np.random.default_rng(seed), arena.robot.dynamics.control_coordinates

    def limits_at(narrowed: Saturation, strength: float) -> Any:
        scaled = narrowed.scaled(strength)
        assert isinstance(scaled, Saturation)
        return scaled.limits(arena)

    low, high = np.sort(rng.uniform(-0.5, 0.5, 2))
    for sides in ({"lowest": low}, {"highest": high}, {"lowest": low, "highest": high}, {"share": 0.3}):
        narrowed = Saturation(**sides)
        found = next(limits for s in np.arange(1, 200, 1e-3) if np.ptp(limits := limits_at(narrowed, float(s))) < 2e-3)
        for strength in (200.0, 1e6, 1e308):
            limits = limits_at(narrowed, strength)
            np.testing.assert_array_equal(limits[0], limits[1])
            np.testing.assert_allclose(limits, found, atol=4e-3)
            np.testing.assert_array_equal(limits, np.clip(limits, space.low, space.high))


def test_saturation_narrows_the_limits(arena, cage):
    space = cage.robot.dynamics.control_coordinates
    np.testing.assert_allclose(Saturation(share=0.8).limits(cage), [[0.0] * 4, [0.8 * 3.71] * 4])
    np.testing.assert_allclose(Saturation(share=0.8).limits(arena), [[-0.4] * 2, [0.4] * 2])
    np.testing.assert_allclose(Saturation(highest=(0.2, 0.3)).limits(arena), [[-0.5] * 2, [0.2, 0.3]])
    half, none = Saturation(lowest=1.0).scaled(0.5), Saturation(share=0.5).scaled(0.0)
    assert isinstance(half, Saturation)
    assert isinstance(none, Saturation)
    np.testing.assert_allclose(half.limits(cage), [[0.5] * 4, [3.71] * 4])
    np.testing.assert_allclose(none.limits(cage), [space.low, space.high])
    rollout = simulate(cage, hover(), disturbances=[ControlNoise(0.5), Saturation(lowest=1.0, highest=1.4)], trials=3)
    assert rollout.applied.min() == 1.0
    assert rollout.applied.max() == 1.4
    for wide, message in (
        (
            Saturation(highest=4.0),
            "^Saturation: got 0 to 4 for rotor_1, want a range within that of quadrotor, 0 to 3.71$",
        ),
        (Saturation(lowest=2.0, highest=1.0), "^Saturation: got 2 to 1 for rotor_1"),
        (Saturation(lowest=(1.0, 2.0)), "^Saturation: lowest: got 2 numbers, want 1 or 4"),
    ):
        with pytest.raises(InputError, match=message):
            simulate(cage, hover(5), disturbances=[wide])


@pytest.mark.parametrize("remaining", [0.0, 0.4])
def test_a_rotor_that_is_lost_turns_the_quadrotor_by_what_it_no_longer_lifts(cage, remaining):
    steady = track(cage.robot, np.zeros(12), np.full((10, 4), cage.robot.hover_force), DT, feedback=False)
    loss = ActuatorLoss("quadrotor_rotor_1", at=5 * DT, remaining=remaining)
    rollout = simulate(cage, steady, disturbances=[loss])
    np.testing.assert_allclose(rollout.states[0, :6], 0, atol=1e-9)  # hovers until then
    # Its force 0.17 m ahead of the centre holds the nose up: without it, it pitches down, about y by the right hand.
    robot, missing = cage.robot, (1 - remaining) * cage.robot.hover_force
    rates = np.array([0, robot.arm, -robot.torque_ratio]) * missing / robot.inertia * DT
    np.testing.assert_allclose(rollout.states[0, 6, 9:], rates, rtol=1e-6, atol=1e-9)
    falling = (1 - np.exp(-robot.drag / robot.mass * DT)) / (robot.drag / robot.mass) * missing / robot.mass
    np.testing.assert_allclose(rollout.states[0, 6, 5], -falling, rtol=1e-2)  # it tilts meanwhile
    # Which one is drawn for each trial.
    drawn = simulate(cage, steady, disturbances=[ActuatorLoss()], trials=40)
    directions = {tuple(np.sign(np.round(rates, 4))) for rates in drawn.states[:, 1, 9:]}
    assert len(directions) == 4


def test_a_wheel_that_lost_its_drive_turns_freely(arena):
    straight = track(arena.robot, (0.0, -2.5, np.pi / 2), np.full((12, 2), 0.2), 1 / 6, feedback=False)
    rollout = simulate(arena, straight, disturbances=[ActuatorLoss("create_wheel_left", at=1.0)])
    driven = simulate(arena, straight)
    np.testing.assert_array_equal(rollout.states[0, :7], driven.states[0, :7])
    left = arena.model.joint("create_wheel_left").qposadr[0]
    turned = np.diff(rollout.frames[0, :, left])[-10:]
    assert (turned > 0).all()  # it rolls along
    # Nothing brakes it but the masses that it carries: it goes on nearly straight, where a braked wheel would stop
    # and the robot would turn about it, by 0.2 / 0.258 rad/s, 0.78 rad in that second.
    assert abs(rollout.states[0, -1, 2] - np.pi / 2) < 0.05
    # Told to stop, the other wheel stops and this one does not: the robot turns to the right.
    controls = np.full((18, 2), 0.2)
    controls[9:] = 0.0
    braking = track(arena.robot, (0.0, -2.5, np.pi / 2), controls, 1 / 6, feedback=False)
    free = simulate(arena, braking, disturbances=[ActuatorLoss("create_wheel_left", at=1.0)])
    held = simulate(arena, braking)
    assert abs(held.states[0, -1, 2] - np.pi / 2) < 0.01
    assert free.states[0, -1, 2] < np.pi / 2 - 0.1


@pytest.mark.parametrize("seed", range(8))
def test_a_controller_that_sees_losses_is_told_which_measurements_got_lost(cage, seed):
    """In any order with noise, a bias and a latency, and where the robot stands still; others get the last that came.

    The losses are drawn again by hand. Behind the dropouts a latency delays them, too.
    """
    rng, steps, trials = np.random.default_rng(seed), 20, 3
    loss = [0.4, GilbertElliott(0.2, 0.4)][seed % 2]
    latency, further = int(rng.integers(1, 4)), [MeasurementNoise(0.01), MeasurementBias(0.01)][: int(rng.integers(3))]
    links = [MeasurementDropouts(loss), *([MeasurementLatency(latency)] if rng.random() < 0.7 else []), *further]
    links = [links[i] for i in rng.permutation(len(links))]
    place = next(i for i, link in enumerate(links) if isinstance(link, MeasurementDropouts))
    behind = sum(link.periods for link in links[place:] if isinstance(link, MeasurementLatency))
    make, plan = seeded(seed), hover(steps)
    drawn = MeasurementDropouts(loss).draw(steps + 1, [make(trial, place) for trial in range(trials)])
    lost = drawn[:, np.maximum(np.arange(steps) - behind, 0)]
    shown = {True: [], False: []}

    @dataclass(frozen=True)
    class Hovering:
        sees_losses: bool

        def __call__(self, state, t):
            shown[self.sees_losses].append(state)
            return plan.trajectory.controls[0]

    measured = [
        simulate(cage, plan, controller=Hovering(sees), disturbances=links, trials=trials, seed=seed).measured
        for sees in shown
    ]
    assert np.isfinite(measured).all()
    told, held = (np.reshape(seen, (steps, trials, 12)).swapaxes(0, 1) for seen in shown.values())
    np.testing.assert_array_equal(np.isnan(told), np.repeat(lost[:, :, None], 12, axis=2))
    for k in range(trials):
        expected = received(lost[k], plan.trajectory.states[0], told[k])
        np.testing.assert_array_equal(held[k], expected)
    np.testing.assert_array_equal(held, measured[-1][:, :-1])
