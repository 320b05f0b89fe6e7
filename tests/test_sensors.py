"""Sensors of the MJCF: readings, errors and timing in runs, and the filter that estimates from them."""

import dataclasses
from typing import Any

import hypothesis.strategies as st
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from mechanisms import sled
from sampling import examples
from tracking import hover

import lqrsim as ls
from lqrsim.control.offset_free import SensorFilter, SensorRun
from lqrsim.disturbances import (
    ControlNoise,
    Disturbance,
    Effect,
    Gusts,
    InitialStateError,
    MassMismatch,
    MeasurementNoise,
    Sensor,
    SensorErrors,
    Uncertainty,
    Unknown,
)
from lqrsim.errors import InputError
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.simulation.closed_loop import simulate_from
from lqrsim.stress.study import disturbances_as_json, disturbances_from_json

IMU = [
    Sensor("quadrotor_gyro", noise=0.01, bias=0.01, bias_walk=1e-3, rate=200.0),
    Sensor("quadrotor_accelerometer", noise=0.1, bias=0.05, bias_walk=0.01, rate=200.0),
    Sensor("quadrotor_magnetometer", noise=0.01, rate=50.0),
    Sensor("quadrotor_position", noise=0.02, rate=10.0, delay=0.04),
]
MET = [ControlNoise(0.02), Gusts(0.1), InitialStateError({"m": 0.02, "m/s": 0.02, "rad": 0.02, "rad/s": 0.02})]
CART = sled(
    joint='damping="0.3"', limits=[50], option='timestep="0.02"',
    things='<body name="post" pos="0 5 0"><geom size=".1"/><site name="lamp"/></body>', more="""<sensor>
    <jointpos name="place" joint="x" noise="0.2" nsample="3" interval="0.04" delay="0.02"/>
    <jointvel name="speed" joint="x"/><jointvel name="slow" joint="x" cutoff="0.5"/>
    <framepos name="lamp" objtype="site" objname="lamp"/><clock name="time"/></sensor>""",
)  # fmt: skip


class Reading(ls.Controller):
    """The plan's policy without feedback, which notes what it reads."""

    def __init__(self, plan, sensors):
        self._plan, self._sensors = plan, sensors

    def start(self, trials):
        return _Notes(self._plan.trajectory.controls, trials)

    @property
    def digest(self):
        return "reading"

    @property
    def sensors(self):
        return self._sensors

    @property
    def plan(self):
        return self._plan

    @property
    def coordinates(self):
        return self._plan.policy.state_coordinates, self._plan.policy.control_coordinates


class _Notes(ls.types.ControllerRun):
    def __init__(self, controls, trials):
        self.controls, self.trials, self.read = controls, trials, []

    def control(self, step, measured):
        self.read.append(measured)
        return np.tile(self.controls[step], (self.trials, 1))


@pytest.fixture(scope="module")
def plan():
    return hover(60)


@pytest.fixture(scope="module")
def problem(plan):
    robot = ls.Quadrotor()
    goal = ls.QuadraticCost(np.full(12, 10.0), about=np.zeros(12))
    return ls.Problem(
        dynamics=robot.dynamics, dt=1 / 30, steps=60, initial=ls.FixedState(np.zeros(12)),
        stage_cost=ls.ControlCost(np.ones(4), about=np.full(4, robot.hover_force)), final_cost=goal,
    )  # fmt: skip


@pytest.fixture(scope="module")
def law(cage, plan, problem):
    effort = 0.5
    return ls.OffsetFree(
        problem, plan, ls.uncertainty_of(cage, MET), sensors=cage.sensors(IMU), record=True, effort=effort,
        tolerate={"m": 0.1, "m/s": 0.2, "rad": 0.1, "rad/s": 0.3},
    )  # fmt: skip


@pytest.fixture(scope="module")
def cart(tmp_path_factory):
    path = tmp_path_factory.mktemp("cart") / "cart.xml"
    path.write_text(CART)
    return ls.MjcfRobot(path)


@pytest.fixture(scope="module")
def on_track(cart):
    problem = cart.problem(np.zeros(2), np.array([1.0, 0.0]), steps=30, dt=0.02)
    return problem, ls.smooth(problem), ls.Plant(cart, cart.scene)


def sensordata(plant, states, controls, forces):
    """MuJoCo's readings, by its own calls, of the file's model without the plant's additions."""
    model = plant.scene.model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = plant.robot.configuration(states)
    data.ctrl[:], data.xfrc_applied[plant.body] = controls, forces
    mujoco.mj_forward(model, data)
    return {model.sensor(i).name: data.sensor(i).data.copy() for i in range(model.nsensor)}


# A puck between a floor and a wall, with rays along each axis and a camera with rays to both sides of the horizon.
LOOKING = sled(
    name="puck", place="0 0 1",
    carried='{sites}<camera name="eye" pos="0.2 0 0" xyaxes="0 -1 0 0 0 1" resolution="2 4"/>',
    things='<geom type="plane" size="0 0 1"/><geom type="box" size="0.1 1 2" pos="-2 0 0"/>',
    more="<sensor>{sensors}</sensor>",
)  # fmt: skip
DIRECTIONS = {"down": "0 0 -1", "up": "0 0 1", "back": "-1 0 0", "ahead": "1 0 0", "aside": "0 1 0"}
FIELDS = ("dist", "dir", "origin", "point", "normal", "depth")


@pytest.mark.parametrize("fields", [*FIELDS, "dist dir", "dir normal", "origin depth", " ".join(FIELDS)])
def test_a_ray_that_meets_nothing_has_no_reading_and_any_other_is_mujocos(fields):
    """A direction of -1 is one, whatever a distance of -1 means."""
    sites = "".join(f'<site name="{name}" zaxis="{way}"/>' for name, way in DIRECTIONS.items())
    finders = [*((name, f'site="{name}"') for name in DIRECTIONS), ("eye", 'camera="eye"')]
    elements = (f'<rangefinder name="{name}" {where} data="{fields}"/>' for name, where in finders)
    robot = ls.MjcfRobot(scene_from_xml(LOOKING.format(sites=sites, sensors="".join(elements)), "puck"))
    sensors = ls.Plant(robot, robot.scene).sensors([Sensor(name) for name, _ in finders])
    model, columns = robot.scene.model, [field for field in FIELDS if field in fields.split()]
    widths = [1 if field in ("dist", "depth") else 3 for field in columns]
    tells = np.repeat([field != "origin" for field in columns], widths)
    for x in (-0.3, 0.1, 1.0):
        data = mujoco.MjData(model)
        data.qpos[:] = x
        mujoco.mj_forward(model, data)
        expected = data.sensordata.reshape(-1, len(tells)).copy()
        puck, hit = model.body("puck").id, np.zeros(1, np.int32)
        ways = np.array([way.split() for way in DIRECTIONS.values()], dtype=np.float64)
        met = [mujoco.mj_ray(model, data, [x, 0.0, 1.0], way, None, 1, puck, hit) >= 0 for way in ways]
        met += [False] * 4 + [True] * 4  # the rows of pixels, the upper ones first
        expected[np.ix_(~np.array(met), tells)] = np.nan
        read = sensors.reader()(np.array([[x, 0.0]]), np.zeros((1, 1)), np.zeros((1, 6)))
        np.testing.assert_allclose(read[0].reshape(expected.shape), expected, rtol=0, atol=1e-12)


def test_what_is_read_is_mujocos_sensordata_at_its_time(cage, plan):
    """Bits differ by MuJoCo's warm start alone, which these few constraints do not have: 1e-9."""
    sensors = cage.sensors([dataclasses.replace(one, noise=0.0) for one in IMU])
    run = ls.simulate(cage, controller=Reading(plan, sensors), disturbances=MET, trials=2, seed=4)
    read = np.array(run.controller_run.read)
    for step in (0, 1, 7, 29, 41):
        wrench = np.concatenate([run.forces, run.torques], axis=2)
        for k in range(2):
            before = run.applied[k, step - 1] if step else plan.trajectory.controls[0]
            pushed = wrench[k, step - 1] if step else np.zeros(6)
            now = sensordata(cage, run.states[k, step], before, pushed)
            for one, at in zip(sensors.sensors[:3], sensors.columns, strict=False):
                np.testing.assert_allclose(read[step, k, at], now[one.name], atol=1e-9)
    # Ten times in a second, at each third knot; 40 ms are two periods, rounded up.
    place = read[:, :, sensors.columns[3]]
    arrived = np.flatnonzero(np.isfinite(place).all(axis=(1, 2)))
    assert arrived.tolist() == list(range(2, 60, 3))
    np.testing.assert_allclose(place[arrived], run.states[:, arrived - 2, :3].transpose(1, 0, 2), atol=1e-12)


def test_a_trials_own_model_is_the_one_that_is_read(cage, plan):
    """The thrust of a heavier robot accelerates it less; an accelerometer at rest in the air reads the thrust alone."""
    sensors = cage.sensors([Sensor("quadrotor_accelerometer")])
    run = ls.simulate(cage, controller=Reading(plan, sensors), disturbances=[MassMismatch(factor=2.0)])
    thrust = plan.trajectory.controls[0].sum()
    np.testing.assert_allclose(run.controller_run.read[0][0], [0, 0, thrust / (2 * cage.robot.mass)], atol=1e-9)


def test_reading_does_not_change_a_run(cage, plan):
    calm = ls.simulate(cage, controller=Reading(plan, None), disturbances=MET, seed=2)
    read = ls.simulate(cage, controller=Reading(plan, cage.sensors(IMU)), disturbances=MET, seed=2)
    np.testing.assert_array_equal(calm.states, read.states)


def test_errors_have_the_stated_moments_and_scale(cage, plan):
    """Within five standard errors; 100 trials of independent numbers."""
    stated = [Sensor("quadrotor_position", noise=0.1, bias=0.3, bias_walk=0.4, loss=0.2)]
    sensors, trials = cage.sensors(stated), 100

    def errors(strength, trials=1):
        met = [SensorErrors(stated).scaled(strength)]
        run = ls.simulate(cage, controller=Reading(plan, sensors), disturbances=met, trials=trials, frames=False)
        return np.array(run.controller_run.read) - run.states[:, :-1, :3].transpose(1, 0, 2)

    off = errors(1.0, trials)
    assert np.isnan(off).mean() == pytest.approx(0.2, abs=5 * np.sqrt(0.16 / (trials * 60)))
    np.testing.assert_array_equal(np.isnan(off).any(axis=2), np.isnan(off).all(axis=2))  # readings, not numbers
    for knot in (0, 30, 59):
        variance = 0.1**2 + 0.3**2 + 0.4**2 * knot / 30
        assert np.nanvar(off[knot]) == pytest.approx(variance, rel=5 * np.sqrt(2 / (3 * 0.8 * trials)))
    fresh = np.diff(off, axis=0)
    assert np.nanvar(fresh) == pytest.approx(2 * 0.1**2 + 0.4**2 / 30, rel=5 * np.sqrt(3 / (59 * 3 * 0.6 * trials)))
    assert (errors(0.0) == 0).all()
    assert np.isnan(errors(6.0)).all()  # a chance of 1.2


def test_derivatives_along_the_plan_are_those_of_mujoco(cage, law, plan):
    """Central differences of MuJoCo's own readings with another step; both are good to 1e-6 of numbers up to 10."""
    filter_: SensorFilter = law._sensing
    states, controls, wrench = filter_._slopes
    rng = np.random.default_rng(0)
    for t in (1, 17, 60):
        x, u = plan.trajectory.states[t], plan.trajectory.controls[t - 1]
        dx, du, df = rng.standard_normal(12), rng.standard_normal(4), rng.standard_normal(6)
        sides = []
        for h in (1e-4, -1e-4):
            found = sensordata(cage, x + h * dx, u + h * du, h * df)
            sides.append(np.concatenate([found[one.name] for one in IMU]))
        wanted = (sides[0] - sides[1]) / 2e-4
        np.testing.assert_allclose(states[t] @ dx + controls[t] @ du + wrench[t] @ df, wanted, atol=2e-5)


def test_of_unknowns_only_white_ones_are_noise_of_readings(cage, plan, problem):
    """Variances of controls and white forces, by MuJoCo's own readings, are added; what lasts is estimated."""
    sensors, t = cage.sensors(IMU), 17

    def filter_of(*unknowns) -> Any:
        return ls.OffsetFree(problem, plan, Uncertainty(unknowns=list(unknowns)), sensors=sensors)._sensing

    def slope(*step):  # of the readings, which are linear in controls and forces
        du, df = np.split(np.array(step), [4])
        sides = [sensordata(cage, plan.trajectory.states[t], u + sign * du, sign * df) for sign in (1, -1)]
        return (np.subtract(*(np.concatenate([side[one.name] for one in IMU]) for side in sides))) / 2

    u, exact = plan.trajectory.controls[t - 1], filter_of()
    control = [slope(*(row * exact.model.uncertainty.control), *np.zeros(6)) for row in np.eye(4)]
    wanted = sensors.per_reading("noise") ** 2 + np.square(control).sum(axis=0)
    lasting = Unknown("force_x", 0.3), Unknown("force_z", 0.3, time_constant=0.5)
    white = Unknown({"force_y": 0.6, "force_z": 0.8}, 0.3, time_constant=0.0)
    for sensing in (exact, filter_of(*lasting)):
        np.testing.assert_allclose(sensing.noise[t], wanted, atol=1e-6)
    pushed = slope(*np.zeros(4), 0, 0.18, 0.24, 0, 0, 0)
    np.testing.assert_allclose(filter_of(*lasting, white).noise[t], wanted + pushed**2, atol=1e-6)


@settings(max_examples=examples(25))
@given(
    rates=st.lists(st.sampled_from([None, 50.0, 25.0, 12.0, 7.0]), min_size=2, max_size=2),
    late=st.lists(st.integers(0, 4), min_size=2, max_size=2),
    biased=st.booleans(), loss=st.sampled_from([0.0, 0.3, 0.8]), seed=st.integers(0, 1000),
)  # fmt: skip
def test_estimates_are_least_squares(on_track, rates, late, biased, loss, seed):
    """Against one dense conditional mean of everything; to 1e-6 of estimates of the size 1, by differenced slopes."""
    problem, solution, plant = on_track
    numbers = {"bias": 0.3, "bias_walk": 0.2} if biased else {}
    stated = [
        Sensor("place", noise=0.1, rate=rates[0], delay=0.02 * late[0], **numbers),
        Sensor("speed", noise=0.2, rate=rates[1], delay=0.02 * late[1]),
    ]
    sensors = plant.sensors(stated)
    told = Uncertainty(start=(0.3, 0.4), control=0.5)
    law = ls.OffsetFree(
        problem, solution, told, sensors=sensors, tolerate={"m": 1.0, "m/s": 1.0}, effort=1.0, memory=np.inf
    )
    model, steps, rng = law.model, problem.steps, np.random.default_rng(seed)
    run = law.start(1)
    assert isinstance(run, SensorRun)
    # Unknown: the start, the noise of each period, the bias and its steps, as one vector of deviations.
    n, count = 2, 2 + 2 * steps + 1 + steps
    prior = np.zeros((count, count))
    prior[:2, :2] = np.diag([0.3**2, 0.4**2])
    for t in range(steps):
        prior[2 + 2 * t : 4 + 2 * t, 2 + 2 * t : 4 + 2 * t] = model.process_noise[t]
    prior[2 + 2 * steps, 2 + 2 * steps] = 0.3**2 * biased
    own = np.arange(3 + 2 * steps, count)
    prior[own, own] = 0.2**2 * 0.02 * biased
    onto, mean = np.zeros((n, count)), solution.trajectory.states[0].copy()
    onto[:, :n] = np.eye(n)
    rows, values, variances, maps, nominal = [], [], [], [onto], [mean]
    taken_at = [
        set(range(steps)) if rate is None else {int(np.ceil(j / rate / 0.02 - 1e-9)) for j in range(steps)}
        for rate in rates
    ]
    for t in range(steps):
        arriving = np.full((1, 2), np.nan)
        for i in range(2):
            taken = t - late[i]
            if taken not in taken_at[i] or rng.random() < loss:
                continue
            arriving[0, i] = nominal[taken][i] + 0.3 * rng.standard_normal()
            row = maps[taken][i].copy()
            if i == 0:
                row[2 + 2 * steps] = 1.0
                row[own[:taken]] = 1.0
            rows.append(row)
            values.append(arriving[0, i] - nominal[taken][i])
            variances.append(sensors.per_reading("noise")[i] ** 2)
        u = run.control(t, arriving)[0]
        if rows:
            A, R = np.array(rows), np.diag(variances)
            gain = np.linalg.solve(A @ prior @ A.T + R, A @ prior).T
            deviation, covariance = gain @ np.array(values), prior - gain @ A @ prior
        else:
            deviation, covariance = np.zeros(count), prior
        np.testing.assert_allclose(run.z[0], nominal[t] + maps[t] @ deviation, atol=1e-6)
        np.testing.assert_allclose(
            run.estimate.covariance[0, :2, :2], maps[t] @ covariance @ maps[t].T, rtol=1e-5, atol=1e-9
        )
        following = model.step.F[t] @ maps[t]
        following[:, 2 + 2 * t : 4 + 2 * t] += np.eye(n)
        maps.append(following)
        x_next = solution.trajectory.states[t + 1]
        x_next = x_next + model.step.F[t] @ (nominal[t] - solution.trajectory.states[t])
        nominal.append(x_next + model.step.G[t] @ (u - solution.trajectory.controls[t]))


def test_errors_of_estimates_are_as_large_as_the_filter_says(cage, law):
    """The mean of e' P^-1 e over the number of states is 1; with biases, gusts and linearised readings within 15 %."""
    run = ls.simulate(cage, controller=law, disturbances=[*MET, SensorErrors(IMU)], trials=60, seed=5, frames=False)
    estimates, knots = run.controller_run.estimates, np.arange(5, 60, 6)
    off = (estimates[knots, :, :12] - run.states[:, knots].transpose(1, 0, 2)).transpose(0, 2, 1)
    squares = off * np.linalg.solve(law.filter.corrected[knots, :12, :12], off)
    assert squares.sum(axis=1).mean() / 12 == pytest.approx(1.0, abs=0.15)
    kept = run.controller_run.estimate.covariance
    np.testing.assert_allclose(kept[:, :12, :12], np.tile(law.filter.corrected[59, :12, :12], (60, 1, 1)), rtol=1e-6)


@given(name=st.from_regex(r"wind_[a-z]{0,3}", fullmatch=True))
@settings(max_examples=examples(8))
def test_a_load_on_a_body_whose_name_begins_like_a_wind_is_no_wind(tmp_path_factory, name):
    """The parameter of such a load, `wind_vane_load`, moves no reading as a force of the wind would."""
    path = tmp_path_factory.mktemp("vane") / "cart.xml"
    path.write_text(CART.replace('body name="sled"', f'body name="{name}"'))
    robot = ls.MjcfRobot(path)
    problem = robot.problem(np.zeros(2), np.array([1.0, 0.0]), steps=10, dt=0.02)
    solution = ls.smooth(problem)
    load = Uncertainty(unknowns=[Unknown(f"{name}_load", 0.1)], start=0.1)
    sensors = ls.Plant(robot, robot.scene).sensors([Sensor("place")])
    law = ls.OffsetFree(problem, solution, load, sensors=sensors, tolerate={"m": 0.1, "m/s": 0.2}, effort=5.0)
    assert law.model.parameters == (f"{name}_load",)
    acting = SensorFilter(law.model, sensors).acting(np.ones((1, law.model.size)), np.zeros((1, 1)))
    np.testing.assert_array_equal(acting[1], np.zeros((1, 6)))


def test_a_trial_is_the_same_alone_and_among_others(cage, law):
    lossy = [dataclasses.replace(one, loss=0.3) for one in IMU]
    met = [*MET, SensorErrors(lossy)]
    together = ls.simulate(cage, controller=law, disturbances=met, trials=4, seed=6)
    alone = ls.simulate(cage, controller=law, disturbances=met, first_trial=2, seed=6, threads=1)
    np.testing.assert_array_equal(alone.states[0], together.states[2])
    np.testing.assert_array_equal(alone.commanded[0], together.commanded[2])


def test_a_run_from_a_knot_has_its_past(cage, law, plan):
    """With exact readings of the plan before, the estimate at the knot is the plan's state; to 1e-6, by MuJoCo."""
    run = simulate_from(cage, plan, plan.trajectory.states[[20]], knot=20, controller=law, frames=False)
    np.testing.assert_allclose(run.controller_run.estimates[20, 0, :12], plan.trajectory.states[20], atol=1e-6)
    assert run.outcome == ("reached",)


class Noting(Disturbance):
    """No disturbance: it notes the steps in which readings are asked for."""

    def __init__(self):
        self.steps = []

    def start(self, plant, plan, generators):
        def read(step, readings):
            self.steps.append(step)
            return readings

        return Effect(read=read)


@given(knot=st.integers(0, 29))
@settings(max_examples=examples(6))
def test_hooks_of_readings_have_the_past_of_a_run_from_a_knot(on_track, knot):
    """They are called in each period from the plan's first one on, as those of measured states are."""
    _, solution, plant = on_track
    noting, controller = Noting(), Reading(solution, plant.sensors([Sensor("place")]))
    states = solution.trajectory.states[[knot]]
    run = simulate_from(plant, solution, states, knot=knot, controller=controller, disturbances=[noting], frames=False)
    assert run.reasons == ("",)
    assert noting.steps == list(range(30))


def test_the_file_says_what_is_not_given(cart, on_track):
    """Noise, interval and delay of the file are the sensor's; MuJoCo's own readings are those of the present."""
    plant, solution = on_track[2], on_track[1]
    sensors = plant.sensors([Sensor("place"), Sensor("slow")])
    assert sensors.sensors[0] == Sensor("place", noise=0.2, rate=25.0, delay=0.02)
    assert sensors.delay_periods(0.02) == [1, 0]
    run = ls.simulate(plant, controller=Reading(solution, sensors))
    read = np.array(run.controller_run.read)[:, 0]
    assert np.flatnonzero(np.isfinite(read[:, 0])).tolist() == list(range(1, 30, 2))
    np.testing.assert_allclose(read[1::2, 0], run.states[0, :-1:2, 0], atol=1e-12)
    np.testing.assert_allclose(read[:, 1], np.clip(run.states[0, :-1, 1], -0.5, 0.5), atol=1e-12)
    assert run.states[0, :, 1].max() > 0.6


def test_errors_of_sensors_are_stored_as_plain_data():
    one = SensorErrors(IMU, strength=0.5)
    scenario = ls.scenarios.quadrotor()
    assert disturbances_from_json(disturbances_as_json([one], scenario), scenario) == (one,)


@given(names=st.lists(st.sampled_from([one.name for one in IMU]), max_size=4))
def test_errors_of_a_sensor_are_stated_once(names):
    """Two of the same name are refused, where the last of them alone would act."""
    stated = [Sensor(name, noise=0.1 * i) for i, name in enumerate(names)]
    if len({*names}) < len(names):
        with pytest.raises(InputError, match=r"SensorErrors: sensors: got .*, want each at most once"):
            SensorErrors(stated)
    else:
        assert [one.noise for one in SensorErrors(stated).sensor_records] == [one.noise for one in stated]


def test_what_cannot_be_read_is_refused_by_name(on_track, cage, law, plan, problem):
    cart_problem, solution, plant = on_track
    with pytest.raises(InputError, match=r"sensors: got 'gyro', want .*place.*speed"):
        plant.sensors([Sensor("gyro")])
    with pytest.raises(InputError, match="'time' of the kind clock, which has no smooth reading"):
        plant.sensors([Sensor("time")])
    with pytest.raises(InputError, match="each at most once"):
        plant.sensors([Sensor("place"), Sensor("place")])
    with pytest.raises(InputError, match="got 'lamp', whose reading is the same in all states"):
        ls.OffsetFree(cart_problem, solution, Uncertainty(start=0.1), sensors=plant.sensors([Sensor("lamp")]))
    with pytest.raises(InputError, match="got those of robot quadrotor"):
        ls.OffsetFree(cart_problem, solution, Uncertainty(), sensors=cage.sensors(IMU))
    measured = ls.uncertainty_of(cage, [MeasurementNoise(0.1)])
    with pytest.raises(InputError, match=r"measurement .* with sensors of the MJCF"):
        ls.OffsetFree(problem, plan, measured, sensors=cage.sensors(IMU))
    with pytest.raises(InputError, match=r"replan_every: got 0\.5 with sensors"):
        ls.OffsetFree(problem, plan, Uncertainty(), sensors=cage.sensors(IMU), replan_every=0.5)
    with pytest.raises(InputError, match="loop: got a law that reads sensors"):
        law.loop()
    with pytest.raises(InputError, match="policy: got a law that reads sensors"):
        _ = law.policy
    with pytest.raises(InputError, match=r"got measurements of shape .1, 13., want"):
        law.start(1).control(0, np.zeros((1, 13)))
    with pytest.raises(InputError, match="SensorErrors: sensors: place: got 'volume', want"):
        SensorErrors({"place": {"volume": 1.0}})
