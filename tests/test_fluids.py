"""Wind and currents in the fluid of an MJCF: its velocity, on every body on which MuJoCo's fluid forces act."""

import copy
import itertools
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mechanisms import motors, sled
from sampling import examples
from tracking import track

import lqrsim as ls
from lqrsim.disturbances import Dryden, Effect, Gusts, MeanWind, preset

SPHERE = sled(
    geom='size="{radius}" mass="{mass}" {shape}',
    option='density="{density}" viscosity="{viscosity}" gravity="0 0 0" timestep="0.002" integrator="RK4" {more}',
)
DT, STEPS = 0.02, 50
ANY = settings(max_examples=examples(20), suppress_health_check=[HealthCheck.function_scoped_fixture])


def drift(folder: Path, stream: float, **numbers: object) -> np.ndarray:
    """Positions and velocities (T+1, 2) of a sphere that is at rest when the stream begins."""
    values = {"density": 0.0, "viscosity": 0.0, "radius": 0.1, "mass": 4.0, "shape": "", "more": ""} | numbers
    (folder / "sphere.xml").write_text(SPHERE.format(**values))
    robot = ls.MjcfRobot(folder / "sphere.xml")
    plan = track(robot, [0.0, 0.0], np.zeros((STEPS, 1)), DT, feedback=False)
    return ls.simulate(ls.Plant(robot, robot.scene), plan, disturbances=[MeanWind((stream, 0.0, 0.0))]).states[0]


@ANY
@given(
    st.floats(0.05, 2.0), st.sampled_from([-1.0, 1.0]), st.floats(200.0, 1500.0), st.floats(0.05, 0.2),
    st.floats(1.0, 20.0), st.sampled_from(["inertia box", "ellipsoid"]),
)  # fmt: skip
def test_a_sphere_drifts_in_a_stream_by_the_closed_form(
    tmp_path: Path, speed: float, way: float, density: float, radius: float, mass: float, shape: str
) -> None:
    """m s' = -F |s| s of the velocity s through the medium: s = w / (1 + k |w| t) with k = F / m, from s = w."""
    # A box with the inertia of the sphere has sides of r sqrt(2.4), and a drag of 1/2 density A; an ellipsoid has one
    # of 1/2 density A as well, with MuJoCo's coefficient of 0.5, but projected twice.
    shapes = {
        "inertia box": ("", 0.5 * 2.4 * radius**2),
        "ellipsoid": ('fluidshape="ellipsoid"', 0.5 * np.pi * radius**2),
    }
    text, area = shapes[shape]
    rate, stream = density * area / mass * speed, speed * way
    times = DT * np.arange(STEPS + 1)
    states = drift(tmp_path, stream, density=density, radius=radius, mass=mass, shape=text)
    # Of RK4, with steps of at most 0.38 time constants, for the largest and lightest sphere.
    tolerance = 1e-4 * speed
    np.testing.assert_allclose(states[:, 1], stream * (1 - 1 / (1 + rate * times)), rtol=0, atol=tolerance)
    np.testing.assert_allclose(states[:, 0], stream * (times - np.log1p(rate * times) / rate), rtol=0, atol=tolerance)


@ANY
@given(st.floats(-2.0, 2.0), st.floats(0.1, 20.0))
def test_a_sphere_drifts_in_oil_by_stokes(tmp_path: Path, stream: float, viscosity: float) -> None:
    """m s' = -3 pi d viscosity s, with the side d of the box of the same inertia for a diameter."""
    states = drift(tmp_path, stream, viscosity=viscosity)
    rate = 3 * np.pi * 0.1 * np.sqrt(2.4) * viscosity / 4.0
    expected = stream * -np.expm1(-rate * DT * np.arange(STEPS + 1))
    np.testing.assert_allclose(states[:, 1], expected, rtol=0, atol=1e-9)  # of RK4


ARM = sled(
    "", geom='type="ellipsoid" size="0.3 0.2 0.1" mass="20" fluidshape="ellipsoid"',
    carried="""<freejoint/><site name="thruster"/>
      <body name="arm" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.5"/>
        <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1"/></body>""",
    actuators=motors(["elbow"]) + '<general name="thrust" site="thruster" gear="1 0 0 0 0 0"/>',
    option='density="1000" viscosity="0.01" timestep="0.005" wind="0.1 0 0" integrator="implicitfast"',
)  # fmt: skip


@pytest.fixture
def swimmer(tmp_path: Path) -> ls.MjcfRobot:
    (tmp_path / "swimmer.xml").write_text(ARM)
    return ls.MjcfRobot(tmp_path / "swimmer.xml")


def test_gusts_are_the_wind_of_mujoco_beside_the_wind_of_the_file(swimmer: ls.MjcfRobot) -> None:
    """Bit for bit the steps of `mj_step` with this `opt.wind`, in each trial its own, on hull and arm alike."""
    plant, gusts, steps = ls.Plant(swimmer, swimmer.scene), Gusts(0.5, time_constant=0.3), 20
    plan = track(swimmer, swimmer.at(), np.full((steps, 2), 0.1), DT, feedback=False)
    rollout = ls.simulate(plant, plan, disturbances=[gusts], trials=3, seed=4)
    starts = [np.random.Generator(np.random.SFC64(np.random.SeedSequence(4, spawn_key=(k, 0)))) for k in range(3)]
    winds = gusts.start(plant, plan.trajectory, starts).wind
    assert winds is not None
    for trial in range(3):
        model, data = copy.copy(swimmer.mjcf.model), mujoco.MjData(swimmer.mjcf.model)
        for step in range(steps):
            model.opt.wind[:] = winds(step, rollout.states[:, step])[trial] + [0.1, 0.0, 0.0]
            data.ctrl[:] = 0.1
            mujoco.mj_step(model, data, 4)
        np.testing.assert_array_equal(rollout.states[trial, -1, 7:], data.qvel)
    assert np.ptp(rollout.states[:, -1], axis=0).min() > 1e-4  # and the three drift apart
    assert not rollout.forces.any()  # MuJoCo's fluid forces are none that a disturbance applies


def test_nothing_blows_a_body_that_swims_with_the_stream(swimmer: ls.MjcfRobot) -> None:
    """`mj_passive` has no fluid force at the velocity of the medium."""
    model = copy.copy(swimmer.mjcf.model)
    data = mujoco.MjData(model)
    current = np.array([0.4, -0.2, 0.1])
    model.opt.wind[:], data.qvel[:3] = current, current
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_fluid, 0.0, atol=1e-12)
    data.qvel[:3] = 0.0
    mujoco.mj_forward(model, data)
    assert np.abs(data.qfrc_fluid[:3]).min() > 1.0


@pytest.mark.parametrize(
    ("numbers", "kind"),
    [({"density": 1.2}, Dryden), ({"density": 1000.0}, Gusts), ({"viscosity": 0.1}, Dryden), ({}, None)],
)
def test_presets_have_what_blows_there(tmp_path: Path, numbers: dict[str, float], kind: type | None) -> None:
    values = {"density": 0.0, "viscosity": 0.0, "radius": 0.1, "mass": 4.0, "shape": "", "more": ""} | numbers
    (tmp_path / "sphere.xml").write_text(SPHERE.format(**values))
    robot = ls.MjcfRobot(tmp_path / "sphere.xml")
    plant = ls.Plant(robot, robot.scene)
    assert [type(one) for one in preset("light", plant) if isinstance(one, (Dryden, Gusts))] == [kind] * (
        kind is not None
    )
    if kind is None:
        with pytest.raises(
            ls.InputError, match=r"cannot push without drag, want one with .* or an MJCF with the density"
        ):
            MeanWind((1.0, 0.0, 0.0)).check(plant)
    else:
        assert "wind_x" in str(ls.uncertainty_of(plant, [MeanWind((1.0, 0.0, 0.0))]).left_out)


def test_a_medium_without_passive_forces_pushes_nothing(tmp_path: Path) -> None:
    flags = '><flag spring="disable" damper="disable"/></option><option'
    with pytest.raises(ls.InputError, match="cannot push without drag"):
        drift(tmp_path, 1.0, density=1000.0, more=flags)


class _Stream(ls.disturbances.Disturbance):
    def start(self, plant, plan, generators) -> Effect:
        return Effect(wind=lambda step, states: np.tile([0.3, 0.0, 0.0], (len(states), 1)))


def test_a_wind_of_ones_own_blows_too(swimmer: ls.MjcfRobot) -> None:
    plant = ls.Plant(swimmer, swimmer.scene)
    plan = track(swimmer, swimmer.at(), np.zeros((5, 2)), DT, feedback=False)
    own, ours = (ls.simulate(plant, plan, disturbances=[one]) for one in (_Stream(), MeanWind((0.3, 0.0, 0.0))))
    np.testing.assert_array_equal(own.states, ours.states)


class _Dragged(ls.MjcfRobot):
    drag = 0.4


class _Rising(ls.disturbances.Disturbance):
    def start(self, plant, plan, generators) -> Effect:
        speeds = itertools.count(1.0)
        return Effect(wind=lambda step, states: np.full((len(states), 3), next(speeds)))


@pytest.mark.parametrize("density", [0.0, 1.2])
def test_a_wind_that_remembers_blows_once_in_a_period(tmp_path: Path, density: float) -> None:
    """By a drag alone, and where a fluid is beside it."""
    numbers = {"density": density, "viscosity": 0.0, "radius": 0.1, "mass": 4.0, "shape": "", "more": ""}
    (tmp_path / "sphere.xml").write_text(SPHERE.format(**numbers))
    robot = _Dragged(tmp_path / "sphere.xml")
    plan = track(robot, [0.0, 0.0], np.zeros((STEPS, 1)), DT, feedback=False)
    rollout = ls.simulate(ls.Plant(robot, robot.scene), plan, disturbances=[_Rising()])
    np.testing.assert_array_equal(rollout.forces[0], 0.4 * np.tile(np.arange(1.0, STEPS + 1), (3, 1)).T)
