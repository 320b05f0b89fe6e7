"""Output feedback: what is late, lost or beyond the limits, steady disturbances, filters that diverge, bad input."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from linear_plans import DT, Linear, double_integrator, linear
from sampling import rarely
from tracking import hover, track

import lqrsim as ls
from lqrsim.control.controllers import OutputFeedback
from lqrsim.control.offset_free import FilterRun
from lqrsim.disturbances import (
    CommandDropouts,
    ControlDelay,
    Disturbance,
    Effect,
    ForceNoise,
    MassMismatch,
    MeanWind,
    MeasurementDropouts,
    MeasurementLatency,
    MeasurementNoise,
    Uncertainty,
    Unknown,
)
from lqrsim.errors import Array
from lqrsim.simulation.disturbances import GilbertElliott
from lqrsim.simulation.plant import Plant

TOLERATE = {"m": 0.05, "m/s": 0.3, "rad": 0.2, "rad/s": 1.0}
PUSH = Unknown("d0", 0.5)


def generators(count: int) -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in range(count)]


def run(
    system: Linear, law: ls.OffsetFree, effects: list[Effect], *, off: Array, push: float = 0.0,
    limit: float = np.inf,
) -> tuple[Array, Array, Any]:  # fmt: skip
    """States (T+1, K, n), commands (T, K, m) and the law's run, of a linear system in NumPy, with disturbances."""
    x, begun = system.plan.states[0] + off, law.start(len(off))
    states, commands = [x], []
    for t in range(system.plan.steps):
        shown, command = x.copy(), None
        for effect in effects:
            shown = effect.measure(t, shown) if effect.measure else shown
        command = begun.control(t, shown)
        commands.append(command)
        for effect in effects:
            command = effect.actuate(t, command) if effect.actuate else command
        applied = np.clip(command, -limit, limit)
        x = x @ system.A.T + applied @ system.B.T + push * system.E[:, 0]
        states.append(x)
    return np.array(states), np.array(commands), begun


def plant_of() -> Plant:
    """What of a plant ControlDelay, MeasurementLatency and MeasurementDropouts look at: nothing."""
    return None  # type: ignore[return-value]


@pytest.mark.parametrize(("latency", "delay"), [(0, 0), (3, 2), *rarely((2, 0), (0, 3))])
def test_what_is_late_is_taken_in_where_it_belongs(latency: int, delay: int) -> None:
    """Without noise each command is the law's of the true state when it acts, to 1e-9."""
    steps = 30
    system = double_integrator(start=[1.0, 0.0], controls=np.cos(np.arange(steps) / 4)[:, None])
    uncertainty = Uncertainty(unknowns=[PUSH], start=0.3, latency=latency, delay=delay)
    law = ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0)
    late = [MeasurementLatency(latency), ControlDelay(delay)]
    effects = [one.start(plant_of(), system.plan, generators(2)) for one in late]
    states, commands, _ = run(system, law, effects, off=np.array([[0.3, -0.2], [-0.1, 0.4]]))
    true = np.concatenate([states, np.zeros((steps + 1, 2, 1))], axis=2)
    for step in range(latency, steps - delay):
        t = step + delay
        wanted: Array = true[t] @ law.gain[t].T + law.offset[t]
        np.testing.assert_allclose(commands[step], wanted, rtol=0, atol=1e-9 * (1 + np.abs(wanted).max()))
    # A law that is told nothing of it does something else.
    unaware = replace(uncertainty, latency=0, delay=0)
    other = ls.OffsetFree(system.problem, system.solution, unaware, tolerate=0.5, effort=2.0)
    effects = [one.start(plant_of(), system.plan, generators(2)) for one in late]
    _, theirs, _ = run(system, other, effects, off=np.array([[0.3, -0.2], [-0.1, 0.4]]))
    assert (np.abs(theirs - commands).max() > 0.1) == bool(latency + delay)


def test_lost_measurements_are_predicted() -> None:
    """Half of them get lost, in bursts: without noise the estimate stays that of the true state, to 1e-9."""
    steps = 40
    system = double_integrator(start=[1.0, 0.0], controls=np.cos(np.arange(steps) / 4)[:, None])
    uncertainty = Uncertainty(start=0.3, loss=0.5)
    law = ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0, record=True)
    dropouts = MeasurementDropouts(GilbertElliott(0.3, 0.3)).start(plant_of(), system.plan, generators(20))
    states, _, begun = run(system, law, [dropouts], off=0.3 * np.random.default_rng(0).normal(size=(20, 2)))
    lost = np.any(np.isnan(begun.innovations[:-1]), axis=2)
    assert 0.3 < lost.mean() < 0.7
    came_first = ~lost[0]
    assert 0 < came_first.sum() < 20
    errors = np.abs(begun.estimates[:-1, :, :2] - states[:-1])[:, came_first]
    assert errors.max() < 1e-9
    # Until the first measurement comes, the estimate is the plan's first state.
    first = np.argmin(lost, axis=0)
    for k in np.flatnonzero(~came_first):
        np.testing.assert_allclose(begun.estimates[0, k], system.plan.states[0], rtol=0, atol=1e-12)
        assert np.isnan(begun.innovations[: first[k], k]).all()


@pytest.mark.parametrize("seed", range(6))
def test_a_measurement_that_equals_the_last_one_is_a_measurement(seed: int) -> None:
    """A robot that stands still, with exact sensors: its filter takes in each of them, and so does its policy."""
    rng, latency, steps = np.random.default_rng(seed), seed % 3, 20
    system = double_integrator(start=rng.normal(size=2), controls=rng.normal(size=(steps, 1)))
    uncertainty = Uncertainty(unknowns=[PUSH], start=0.3, latency=latency)
    law = ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0, record=True)
    state = system.plan.states[0] + (seed > 2) * np.array([0.2, 0.0])
    of_law, of_policy, z = law.start(1), OutputFeedback(law.policy).start(1), law.policy.start()
    for t in range(steps):
        of_law.control(t, state[None])
        command, z = law.policy.step(z, state, t * DT)
        np.testing.assert_array_equal(of_policy.control(t, state[None])[0], command)
    assert isinstance(of_law, FilterRun)
    assert of_law.estimates is not None
    assert of_law.innovations is not None
    used = slice(0, steps - latency)
    assert np.isfinite(of_law.innovations[used]).all()
    # RESOLUTION is the noise that the filter assumes of exact sensors, relative to what it predicts.
    np.testing.assert_allclose(of_law.estimates[used, 0, :2], np.tile(state, (steps - latency, 1)), rtol=0, atol=1e-5)


@pytest.mark.parametrize("stated", [0.2, 0.0])
def test_an_error_of_the_start_is_not_taken_for_a_mass(stated: float) -> None:
    """Exact sensors, of which the first measurement gets lost, or a start that is off and was not stated to be.

    The filter believes that it knows the state, and what it then measures is off by hundreds of its standard
    deviations. Estimates of the mass stay within half of it, and all 200 carts end within 0.02 m of the plan.
    """
    cart = ls.Dynamics(
        lambda x, u, p: [x[1], u[0] / (1 + p.load)], states={"x": "m", "v": "m/s"}, controls={"push": "N"},
        disturbances={"load": 0.0}, control_limits=(-20.0, 20.0),
    )  # fmt: skip
    steps, dt, trials = 40, 0.05, 200
    problem = ls.Problem(
        dynamics=cart, dt=dt, steps=steps, initial=ls.FixedState([0.0, 0.0]),
        stage_cost=ls.ControlCost([0.01], about=[0.0]), final_cost=ls.QuadraticCost([100.0, 100.0], about=[1.0, 0.0]),
    )  # fmt: skip
    solution = ls.smooth(problem)
    plan = solution.trajectory
    uncertainty = Uncertainty(unknowns=[Unknown("load", 0.06)], start=stated, lag=0.05, loss=0.03)
    law = ls.OffsetFree(problem, solution, uncertainty, tolerate={"m": 0.05, "m/s": 0.2}, record=True)
    rng = np.random.default_rng(0)
    run, x, load = law.start(trials), 0.2 * rng.normal(size=(trials, 2)), 0.06 * rng.normal(size=trials)
    reached, left = np.tile(plan.controls[0], (trials, 1)), np.exp(-dt / 0.05)
    for t in range(steps):
        shown = np.full((trials, 2), np.nan) if t == 0 and stated else x
        command = run.control(t, shown)
        applied = command + (1 - left) * 0.05 / dt * (reached - command)
        reached = command + left * (reached - command)
        speed = applied[:, 0] / (1 + load)
        x = x + np.column_stack([dt * x[:, 1] + dt**2 / 2 * speed, dt * speed])
    assert not run.estimator_diverged()
    assert run.estimates is not None
    assert np.abs(run.estimates[:steps, :, -1]).max() < 0.5
    assert np.abs(x[:, 0] - plan.states[-1, 0]).max() < 0.02


def test_commands_that_get_lost_are_no_cliff(quadrotor: ls.Scenario) -> None:
    """Of 60 flights with 4 in 5 commands lost at least 50 arrive: 98 % do of 200; told of nothing, 41 %."""
    plan, lost = ls.smooth(quadrotor.problem), [CommandDropouts(0.8)]
    law = ls.OffsetFree(quadrotor.problem, plan, ls.uncertainty_of(quadrotor.plant(), lost))
    flights = ls.simulate(quadrotor.plant(), plan, controller=law, disturbances=lost, trials=60, frames=False)
    assert flights.outcome.count("reached") >= 50


def test_nothing_winds_up_at_the_limits() -> None:
    """Two seconds at the limit: the filter knows what was applied. One that is told the unclipped command does not."""
    steps, limit = 60, 1.0
    far, push = np.array([[2.5, 0.0]]), 0.3
    errors, estimates, at_limit = {}, {}, None
    for name, limits in (("clipped", (-limit, limit)), ("unclipped", (-1e6, 1e6))):
        system = double_integrator(controls=np.zeros((steps, 1)), limits=limits)
        uncertainty = Uncertainty(unknowns=[PUSH], start=0.5, measurement=0.01)
        law = ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=0.1, effort=1.0, record=True)
        states, commands, begun = run(system, law, [], off=far, push=push, limit=limit)
        estimates[name], errors[name] = begun.estimates[:, 0, -1], states[:, 0, 0]
        if name == "clipped":
            at_limit = int(np.argmax(np.abs(commands[:, 0, 0]) < limit))
    assert at_limit is not None
    assert at_limit >= 8  # on the way there; the way to brake is at the other limit
    assert abs(estimates["clipped"][20] - push) < 0.01
    assert abs(estimates["unclipped"][20] - push) > 1.0
    assert np.abs(errors["clipped"][45:]).max() < 0.1
    assert np.abs(errors["unclipped"][45:]).max() > 0.5


@pytest.fixture(scope="module")
def standing(quadrotor: ls.Scenario) -> ls.Solution:
    """Fourteen seconds of hovering in the middle of the cage."""
    return track(quadrotor.robot, np.zeros(12), np.full((420, 4), ls.Quadrotor().hover_force), 1 / 30)


@pytest.mark.parametrize(
    "disturbance",
    [
        MeanWind((3.0, 0.0, 0.0)),
        *rarely(MeanWind((-1.7, 1.7, 1.7)), MassMismatch(factor=0.8), MassMismatch(factor=1.2)),
    ],
    ids=str,
)
def test_steady_disturbances_leave_no_error(
    quadrotor: ls.Scenario, standing: ls.Solution, disturbance: Disturbance
) -> None:
    """Hovering for 14 s in MuJoCo without noise: below 1 cm from 10 s on.

    In wind it hovers tilted, where the law's linear model is a little wrong: some millimetres stay. The estimates are
    right: it is the law that has the model about the plan alone.
    """
    unknowns = [Unknown(f"wind_{axis}", 1.0) for axis in "xyz"] + [Unknown("mass", 0.05)]
    measured = {"m": 5e-3, "m/s": 5e-2, "rad": 5e-3, "rad/s": 5e-3}
    uncertainty = Uncertainty(unknowns=unknowns, start=0.01, measurement=measured)
    law = ls.OffsetFree(quadrotor.problem, standing, uncertainty, tolerate=TOLERATE)
    rollout = ls.simulate(quadrotor.plant(), standing, controller=law, disturbances=[disturbance], frames=False)
    error = rollout.tracking_error[0]
    assert error.max() > 0.005  # it is a disturbance
    assert error[300:].max() < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_a_memory_without_end_takes_the_statement_as_it_is(seed: int) -> None:
    """The filter then is as wrong as it thinks, to rounding; and where that is so, no other filter errs less.

    How wrong it is comes from the joint recursion of state and estimate, which knows no filter but by its gains.
    """
    rng = np.random.default_rng(seed)
    rates, inputs, pushes = (rng.normal(size=(2, columns)) for columns in (2, 1, 1))
    system = linear(rates, inputs, pushes, steps=15)
    unknowns = [Unknown("d0", 0.7), Unknown("d0", 0.5, time_constant=0.4, order=2)]
    told = Uncertainty(unknowns=unknowns, lag=0.05, measurement=0.1, start=0.3, control=0.2, model_error=0.3)
    errors = []
    for memory in (np.inf, None):
        law = ls.OffsetFree(system.problem, system.solution, told, tolerate=0.5, effort=2.0, memory=memory)
        tube = ls.predict_tube(system.problem, system.solution, told, law, samples=0)
        assert tube.estimate_covariance is not None
        errors.append(tube.estimate_covariance)
        if memory == np.inf:
            np.testing.assert_allclose(tube.estimate_covariance, law.filter.predicted[:, :2, :2], rtol=1e-9, atol=1e-12)
    best, offset_free = (np.trace(one, axis1=1, axis2=2) for one in errors)
    assert (offset_free >= best * (1 - 1e-9)).all()
    assert offset_free[-1] > 1.001 * best[-1]


def test_after_the_horizon_the_last_laws_stay_in_force() -> None:
    """For as long again as the plan is: a start that is off is forgotten, and a push is held."""
    system = double_integrator(controls=np.zeros((30, 1)))
    uncertainty = Uncertainty(unknowns=[PUSH], start=0.3, measurement=0.01, latency=1)
    law = ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0, record=True)
    begun, x = law.start(2), np.array([[0.3, -0.2], [-0.1, 0.4]])
    late = x
    for t in range(90):
        shown, late = late, x
        x = x @ system.A.T + begun.control(t, shown) @ system.B.T + 0.3 * system.E[:, 0]
    assert np.abs(x).max() < 0.01
    assert begun.estimator_diverged() == {}


# Filters that diverge.


def diverging(quadrotor: ls.Scenario) -> tuple[ls.Solution, ls.OffsetFree, list[Disturbance]]:
    """It believes that it knows nothing of its drag: estimates of it that are negative make predictions explode."""
    plan, uncertainty = (
        hover(),
        Uncertainty(unknowns=[Unknown("drag", 5.0)], measurement=0.02, start=0.01),
    )
    law = ls.OffsetFree(quadrotor.problem, plan, uncertainty, tolerate=TOLERATE)
    return plan, law, [MeasurementNoise(0.02), ForceNoise(1.0)]


def test_a_filter_that_diverges_ends_its_trial_and_says_so(quadrotor: ls.Scenario) -> None:
    plan, law, noise = diverging(quadrotor)
    rollout = ls.simulate(quadrotor.plant(), plan, controller=law, disturbances=noise, trials=8)
    ended = np.array(rollout.outcome) == "diverged"
    assert 0 < ended.sum() < 8
    for k in range(8):
        alone = ls.simulate(quadrotor.plant(), plan, controller=law, disturbances=noise, first_trial=k)
        np.testing.assert_array_equal(alone.states[0], rollout.states[k])
        assert alone.reasons == (rollout.reasons[k],)
        if not ended[k]:
            continue
        step = round(rollout.diverged_at[k] / plan.trajectory.dt)
        assert rollout.reasons[k].startswith(f"filter at {step / 30:.4g} s: the estimate of ")
        assert rollout.reasons[k].endswith((" is not finite", " is beyond 1e+09"))
        assert np.isfinite(rollout.states[k, :step]).all()
        assert np.isnan(rollout.states[k, step:]).all()
        assert np.isnan(rollout.applied[k, step:]).all()
        assert f"trial {k}: diverged after {rollout.diverged_at[k]:.2f} s: filter at" in rollout.summary()
    assert ls.stress.outcomes(rollout).outcome.tolist() == list(rollout.outcome)


def test_so_says_its_file(quadrotor: ls.Scenario, tmp_path) -> None:
    plan, law, noise = diverging(quadrotor)
    rollout = ls.simulate(quadrotor.plant(), plan, controller=law, disturbances=noise, trials=8)
    again = ls.load(ls.save(rollout, tmp_path / "rollout.npz"), ls.Rollout)
    assert again.reasons == rollout.reasons
    assert again.outcome == rollout.outcome
    with pytest.raises(ls.InputError, match="Rollout: reasons: got 'it is'"):
        replace(rollout, reasons=("it is",) * 8)


# What does not fit.


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"sensors": "x"}, "sensors: got 'x', want a tuple of names"),
        ({"sensors": ("x", "q")}, "sensors: got 'q', want one of: x, y, z, vx"),
        ({"sensors": ("x", "x")}, "sensors: got ('x', 'x'), want at least one state, each at most once"),
        ({"sensors": ()}, "sensors: got (), want at least one state"),
        ({"sensors": np.ones((2, 3))}, "sensors: got shape (2, 3), want (any, 12)"),
        ({"sensors": np.ones((0, 12))}, "sensors: got no rows"),
        ({"sensors": lambda x, u, p: []}, "which returns nothing, want at least one number that is measured"),
        ({"replan_always": True}, "replan_always: got True without replan_every, want seconds between solves"),
        ({"sensors": np.full((1, 12), np.nan)}, "sensors: got nan at index"),
        ({"sensors": lambda x: x}, "want a function of (x, u, p)"),
        ({"sensors": lambda x, u, p: [x[0] * u[0]]}, "u"),
        ({"sensors": 3.0}, "sensors: got"),
        ({"tolerate": {"m": 0.05}}, "tolerate: got none for vx, vy"),
        ({"tolerate": {"feet": 0.05}}, "tolerate: got 'feet', want one of: x, y"),
        ({"effort": [1.0, 2.0]}, "effort: got 2 numbers, want 4: rotor_1"),
        ({"at_end": -1.0}, "at_end: got -1"),
        ({"memory": 0.0}, "OffsetFree: memory: got 0.0, want a finite number > 0"),
        ({"record": "yes"}, "OffsetFree: record: got 'yes', want"),
        ({"uncertainty": {"start": 0.1}}, "OffsetFree: uncertainty: got {'start': 0.1}, want an Uncertainty"),
        (
            {"uncertainty": Uncertainty(unknowns=[Unknown("gain of rotor_7", 0.1)])},
            "Uncertainty: unknowns: got 'gain of rotor_7', want one of: mass",
        ),
        (
            {"uncertainty": Uncertainty(unknowns=[Unknown("force_x", 0.1)]), "sensors": ("rx", "ry", "rz")},
            "OffsetFree: unknowns: got force_x, want one that a measurement sees: rx, ry, rz",
        ),
        (
            {"uncertainty": Uncertainty(unknowns=[Unknown({"wind_x": 1, "wind_y": 1}, 0.1)]), "sensors": ("z",)},
            "OffsetFree: unknowns: got wind_x and wind_y, want one that a measurement sees: z",
        ),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_a_line(quadrotor: ls.Scenario, options: dict, says: str) -> None:
    given = {"uncertainty": Uncertainty(start=0.1, measurement=0.01), "tolerate": TOLERATE} | options
    with pytest.raises(ls.InputError) as caught:
        ls.OffsetFree(quadrotor.problem, hover(), **given)
    assert says in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_what_has_no_spread_is_no_reason_to_refuse(quadrotor: ls.Scenario) -> None:
    """A Dryden wind of strength 0 changes nothing, and nobody wants to see it."""
    calm = Unknown("wind_x", 0.0, time_constant=1.0, order=2)
    law = ls.OffsetFree(quadrotor.problem, hover(), Uncertainty(unknowns=[calm], measurement=0.01), tolerate=TOLERATE)
    assert np.isfinite(law.gain).all()


def test_the_digest_is_of_all_that_the_controls_depend_on() -> None:
    system, digests = double_integrator(steps=5), set()
    base = {"unknowns": [PUSH], "start": 0.1, "measurement": 0.1}
    late = [{"latency": 1}, {"delay": 1}, {"lag": 0.1}, {"command_loss": 0.1}]
    changes = [{}, *late, {"measurement": 0.2}, {"unknowns": []}]
    for change in changes:
        uncertainty = Uncertainty(**(base | change))  # type: ignore[arg-type]
        digests.add(ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=0.5, effort=1.0).digest)
    limited = double_integrator(steps=5, limits=(-1.0, 1.0))
    uncertainty = Uncertainty(**base)  # type: ignore[arg-type]
    for sensors in (None, ("s0",), [[1.0, DT]]):
        law = ls.OffsetFree(limited.problem, limited.solution, uncertainty, tolerate=0.5, effort=1.0, sensors=sensors)
        digests.add(law.digest)
    assert len(digests) == len(changes) + 3


# Better sensors.


@pytest.mark.parametrize("level", ["severe", *rarely("light")])
def test_exact_sensors_keep_nearer_to_the_plan_than_noisy_ones(level: str, quadrotor: ls.Scenario) -> None:
    """Hovering for 2 s, 12 flights in a whole preset and in a drawn half of it. None without noise diverges.

    `experiments/benchmark_sensors.py` has 240 subsets, other robots and noises between.
    """
    plant, plan = quadrotor.plant(), hover()
    preset = ls.disturbances.preset(level, plant)
    noise = next(one for one in preset if isinstance(one, MeasurementNoise))
    others = [one for one in preset if one is not noise]
    drawn = np.random.default_rng(len(level)).random(len(others)) < 0.5
    for chosen in (others, [one for one, own in zip(others, drawn, strict=True) if own]):
        errors = []
        for run in (chosen, [*chosen, noise]):
            law = ls.OffsetFree(quadrotor.problem, plan, ls.uncertainty_of(plant, run), tolerate=TOLERATE)
            rollout = ls.simulate(plant, plan, controller=law, disturbances=run, trials=12, contacts=False)
            assert not np.isfinite(rollout.diverged_at).any()
            errors.append(float(rollout.tracking_error.mean()))
        assert errors[0] < errors[1]
