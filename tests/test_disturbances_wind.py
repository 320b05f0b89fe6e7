"""Wind against its theory: moments, correlation in time, spectra, and the force that it exerts."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.signal import welch
from tracking import hover

from lqrsim.results.solution_parts import Trajectory
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Dryden, Gusts, MeanWind
from lqrsim.simulation.disturbances.wind import first_order, second_order

DT = 1 / 30


def blown(plant, wind, trials, steps, seed=0):
    """The wind in m/s, (trials, steps, 3), without running MuJoCo."""
    plan = Trajectory(np.zeros((steps + 1, 12)), np.zeros((steps, 4)), DT)
    effect = wind.start(plant, plan, [np.random.default_rng((seed, trial)) for trial in range(trials)])
    return np.stack([effect.wind(step, np.zeros((trials, 12))) for step in range(steps)], axis=1)


def test_wind_pushes_by_drag_times_its_speed(cage):
    rollout = simulate(cage, hover(), disturbances=[MeanWind((1.0, -0.5, 0.2))])
    np.testing.assert_allclose(rollout.forces[0], np.tile([0.15, -0.075, 0.03], (60, 1)), rtol=1e-15)
    # Who drifts with the wind feels none: with the feedback's help or not, one period on the drag is that of v - w.
    robot = cage.robot
    expected = robot.dynamics.step(rollout.states[0, 20], rollout.applied[0, 20], DT)
    decay = robot.drag / robot.mass
    gained = rollout.states[0, 21, 3:6] - expected[3:6]
    np.testing.assert_allclose(gained, np.array([1.0, -0.5, 0.2]) * (1 - np.exp(-decay * DT)), atol=1e-7)


@pytest.mark.parametrize("time_constant", [0.1, 1.0])
def test_gusts_have_their_std_at_every_time_and_the_correlation_of_an_ornstein_uhlenbeck_process(cage, time_constant):
    trials, std = 2000, np.array([1.0, 0.5, 2.0])
    winds = blown(cage, Gusts(std.tolist(), time_constant), trials, 60) / std
    # Over N independent trials the standard error of a variance is sqrt(2 / N), of a correlation at most sqrt(2 / N)
    # too, of a mean 1 / sqrt(N); the largest of 180 standard errors is beyond 4.5 of them once in a thousand times.
    assert np.abs(winds.mean(axis=0)).max() < 4.5 / np.sqrt(trials)
    assert np.abs((winds**2).mean(axis=0) - 1).max() < 4.5 * np.sqrt(2 / trials)
    lags = np.arange(60)
    for first in (0, 20):
        correlation = (winds[:, first : first + 1] * winds[:, first:]).mean(axis=0)
        expected = np.exp(-lags[: 60 - first] * DT / time_constant)
        assert np.abs(correlation - expected[:, None]).max() < 4.5 * np.sqrt(2 / trials)
    assert np.abs((winds[..., 0] * winds[..., 1]).mean(axis=0)).max() < 4.5 / np.sqrt(trials)


def test_dryden_has_the_numbers_of_the_standard():
    # MIL-F-8785C at 100 ft: by hand from its formulas.
    turbulence = Dryden("moderate", altitude=30.48)
    knots = 1852 / 3600
    np.testing.assert_allclose(turbulence.wind_at_20_ft, 30 * knots)
    np.testing.assert_allclose(turbulence.std[2], 3 * knots)
    np.testing.assert_allclose(turbulence.std[:2], 3 * knots / (0.177 + 0.0823) ** 0.4)
    np.testing.assert_allclose(turbulence.lengths, np.array([505.2, 505.2, 100]) * 0.3048, rtol=1e-3)
    np.testing.assert_allclose(turbulence.airspeed, 30 * knots * np.log(100 / 0.15) / np.log(20 / 0.15))
    assert Dryden("light", altitude=0.0).lengths == Dryden("light", altitude=3.048).lengths
    # At 1000 ft turbulence is the same in all directions.
    np.testing.assert_allclose(Dryden("severe", 304.8).std, 4.5 * knots, rtol=1e-3)
    np.testing.assert_allclose(Dryden("severe", 304.8).lengths, 304.8, rtol=1e-2)


def one_sided(frequency, std, length, airspeed, order):
    """MIL-F-8785C's spectra in (m/s)^2 per Hz: along the wind (order 1), and across it and upward (order 2)."""
    turn = (2 * np.pi * frequency * length / airspeed) ** 2
    if order == 1:
        return 4 * std**2 * length / airspeed / (1 + turn)
    return 2 * std**2 * length / airspeed * (1 + 3 * turn) / (1 + turn) ** 2


def test_the_spectrum_of_dryden_is_that_of_the_standard(cage):
    turbulence, trials, steps = Dryden("light", altitude=2.0), 200, 4096
    winds = blown(cage, turbulence, trials, steps)
    frequency, density = welch(winds, fs=1 / DT, window="hann", nperseg=1024, axis=1, detrend=False)  # pyright: ignore[reportArgumentType]
    mean, error = density.mean(axis=0), density.std(axis=0) / np.sqrt(trials)
    # Up to a tenth of the sampling rate: beyond it what is sampled folds back more than the tolerance. The lowest bins
    # are the window's width. Averages of 200 trials have standard errors near 3 %; folding adds up to
    # 2 (f / (f_s - f))^2 = 2.5 % at the end, and the window smears a slope by under 3 %.
    used = (frequency > 0.15) & (frequency < 3.0)
    for axis, order in enumerate((1, 2, 2)):
        stated = one_sided(frequency, turbulence.std[axis], turbulence.lengths[axis], turbulence.airspeed, order)
        tolerance = 4.5 * error[used, axis] + 0.055 * stated[used]
        assert (np.abs(mean[used, axis] - stated[used]) < tolerance).all()
        # And on the whole, where errors average out: the level within three per cent, folding included.
        assert abs(np.mean(mean[used, axis] / stated[used]) - 1) < 0.03
        # The integral of the stated spectrum is the variance.
        grid = np.geomspace(1e-6, 1e5, 200_000)
        whole = np.trapezoid(
            one_sided(grid, turbulence.std[axis], turbulence.lengths[axis], turbulence.airspeed, order), grid
        )
        assert whole == pytest.approx(turbulence.std[axis] ** 2, rel=1e-3)


def test_dryden_is_stationary_from_the_start_and_turns_with_its_direction(cage):
    trials = 4000
    winds = blown(cage, Dryden(5.0, altitude=3.0), trials, 60)
    std = np.array(Dryden(5.0, altitude=3.0).std)
    assert np.abs((winds**2).mean(axis=0) / std**2 - 1).max() < 4.5 * np.sqrt(2 / trials)
    turned = blown(cage, Dryden(5.0, altitude=3.0, direction=np.pi / 2), 3, 60)
    np.testing.assert_allclose(turned[..., 1], winds[:3, :, 0], atol=1e-14)
    np.testing.assert_allclose(turned[..., 0], -winds[:3, :, 1], atol=1e-14)
    np.testing.assert_array_equal(turned[..., 2], winds[:3, :, 2])


@pytest.mark.parametrize("step", [1e-3, 0.05, 0.7, 3.0])
def test_the_filters_are_discretised_exactly(step):
    """What noise goes through is linear: impulses tell the transition, and the covariance of what is new, all of it."""
    impulse = np.zeros((1, 3, 1))
    impulse[0, 0] = 1.0
    np.testing.assert_allclose(first_order(impulse, step)[0, :, 0], np.exp(-step * np.arange(3)), rtol=1e-14)
    a, b = np.array([[0.0, 1.0], [-1.0, -2.0]]), np.array([[0.0], [2.0]])
    output = np.array([1.0, np.sqrt(3.0)]) / 2
    stationary = solve_continuous_lyapunov(a, -b @ b.T)
    np.testing.assert_allclose(stationary, np.eye(2), atol=1e-14)
    assert output @ stationary @ output == pytest.approx(1.0)
    # Correlation in time of the output, exact from the responses to the impulses of all that is drawn.
    responses = []
    for t in range(40):
        for k in range(2):
            impulse = np.zeros((1, 40, 2))
            impulse[0, t, k] = 1.0
            responses.append(second_order(impulse, step)[0])
    covariance = np.array(responses).T @ np.array(responses)
    lags = np.abs(np.subtract.outer(np.arange(40), np.arange(40)))
    expected = np.array([output @ expm(a * step * lag) @ output for lag in range(40)])[lags]
    np.testing.assert_allclose(covariance, expected, atol=1e-9)
