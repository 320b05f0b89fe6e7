"""Plants with another simulator: the seam against MuJoCo and a closed form, and RotorPy's and crazyflow's vehicles."""

import dataclasses
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracking import track

import lqrsim as ls
from lqrsim.simulation.disturbances import Effect
from lqrsim.simulators.quadrotors import Frame, package

PAGE = Path(__file__).parent.parent / "docs" / "other_simulators.md"
DT = 1 / 50


def hover(robot: ls.Robot, steps: int) -> ls.Solution:
    assert isinstance(robot, ls.Quadrotor)
    return track(robot, np.zeros(12), np.full((steps, 4), robot.hover_force), DT, feedback=False)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the page's program defines: a puck, which `Exact` moves in closed form."""
    namespace: dict[str, Any] = {"__name__": "other_simulators"}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("page"))
        for block in re.findall(r"^```python\n(.*?)^```$", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL):
            exec(compile(block, str(PAGE), "exec"), namespace)
    return namespace


EVERYTHING = [
    ls.disturbances.InitialStateError(0.01),
    ls.disturbances.MassMismatch(0.1),
    ls.disturbances.MeasurementNoise(0.01),
    ls.disturbances.ControlDelay(1),
    ls.disturbances.CommandDropouts(0.05),
    ls.disturbances.ControlNoise(0.1),
    ls.disturbances.ForceNoise((0.2, 0.2, 0.0)),
    ls.disturbances.Push((0.3, 0.1, 0.0), at=1.0),
]


def test_the_puck_is_as_on_the_page(page: dict[str, Any]) -> None:
    rollout = page["rollout"]
    assert rollout.outcome == ("reached",) * 3
    # In closed form: what pushes is constant in each period, the mass 1.2 times 2 kg.
    rate = (rollout.applied + rollout.forces[..., :2]) / 2.4 * 0.05
    speed = np.concatenate([np.zeros((3, 1, 2)), np.cumsum(rate, axis=1)], axis=1)
    place = np.cumsum((speed[:, :-1] + speed[:, 1:]) / 2 * 0.05, axis=1)
    np.testing.assert_allclose(rollout.states[:, 1:, 2:], speed[:, 1:], atol=1e-12)
    np.testing.assert_allclose(rollout.states[:, 1:, :2], place, atol=1e-12)
    np.testing.assert_array_equal(rollout.frames[:, :, :2], rollout.states[:, :, :2])


def test_all_disturbances_do_what_they_do_in_mujoco(page: dict[str, Any]) -> None:
    """RK4 is exact for a mass that is pushed, so that the two differ by rounding."""
    plan, options = page["solution"], {"disturbances": EVERYTHING, "trials": 5, "seed": 3}
    exact = ls.simulate(page["plant"], plan, **options)
    mujoco = ls.simulate(ls.Plant(page["puck"], page["puck"].scene), plan, contacts=False, **options)
    for name in ("states", "measured", "commanded", "applied", "forces", "clearance"):
        np.testing.assert_allclose(getattr(exact, name), getattr(mujoco, name), atol=1e-9, err_msg=name)
    assert exact.outcome == mujoco.outcome


def test_a_trial_has_the_same_bits_whatever_is_beside_it(page: dict[str, Any]) -> None:
    options = {"disturbances": EVERYTHING, "seed": 1}
    all_of_them = ls.simulate(page["plant"], page["solution"], trials=4, **options)
    again = ls.simulate(page["plant"], page["solution"], trials=2, first_trial=2, **options)
    np.testing.assert_array_equal(all_of_them.states[2:], again.states)


def test_a_collision_is_found_where_the_states_lead(page: dict[str, Any]) -> None:
    class Frictionless(page["Exact"]):
        """It glides at 1 m/s along x, whatever the controls."""

        def step(self, simulations: Any, controls: Any, wrench: Any, wind: Any, steps: int) -> None:
            simulations["states"][:, 0] += steps * simulations["timestep"]

    puck = page["puck"]
    rollout = ls.simulate(ls.Plant(puck, puck.scene, Frictionless()), page["solution"])
    # Centres 0.1 m apart across the way; radii of 0.1 and 0.2 m.
    assert rollout.collided_at[0] == pytest.approx(1.5 - np.sqrt(0.3**2 - 0.1**2), abs=2e-3)
    assert rollout.obstacles == ("pillar",)
    assert rollout.states[0, -1, 0] == pytest.approx(3.0)  # it went on through it


def test_a_simulation_that_is_lost_ends_its_trial_alone(page: dict[str, Any]) -> None:
    class Exploding(page["Exact"]):
        def step(self, simulations: Any, controls: Any, wrench: Any, wind: Any, steps: int) -> None:
            super().step(simulations, controls, wrench, wind, steps)
            simulations["states"][1] = np.inf

    puck, plan, options = page["puck"], page["solution"], {"disturbances": EVERYTHING, "trials": 3}
    rollout, usual = (
        ls.simulate(ls.Plant(puck, puck.scene, simulator), plan, **options)
        for simulator in (Exploding(), page["Exact"]())
    )
    assert rollout.outcome[1] == "diverged"
    assert rollout.diverged_at[1] == 0.05
    np.testing.assert_array_equal(rollout.states[[0, 2]], usual.states[[0, 2]])


@pytest.mark.parametrize(
    "kind", [ls.disturbances.InertiaMismatch(0.1), ls.disturbances.ThrustMismatch(0.1), ls.disturbances.ActuatorLoss()]
)
def test_what_it_cannot_have_is_refused_by_name(page: dict[str, Any], kind: ls.disturbances.Disturbance) -> None:
    name = type(kind).__name__
    with pytest.raises(ls.InputError, match=f"^{name}: got a plant simulated by exact, want one that can have it$"):
        ls.simulate(page["plant"], page["solution"], disturbances=[kind])
    assert name not in {type(one).__name__ for one in ls.disturbances.preset("light", page["plant"])}


def test_changes_of_mujocos_models_and_jumps_are_refused(page: dict[str, Any]) -> None:
    class Alters(ls.disturbances.Disturbance):
        def start(self, plant: Any, plan: Any, generators: Any) -> Effect:
            return Effect(alter=lambda simulations: None)

    with pytest.raises(ls.InputError, match=r"^Alters: got a plant simulated by exact"):
        ls.simulate(page["plant"], page["solution"], disturbances=[Alters()])
    jumps = ls.Noise(np.eye(4)[:, :2] * 0.01)
    with pytest.raises(ls.InputError, match=r"^StateNoise: got a plant simulated by exact"):
        ls.simulate(page["plant"], page["solution"], disturbances=[jumps])


def test_dynamics_are_compared_with_a_simulator(page: dict[str, Any]) -> None:
    """The puck's dynamics are exact, as its simulator is; one of another mass changes speeds by a sixth less."""
    puck, exact = page["puck"], page["Exact"]
    check = ls.check_plant(puck, puck.scene, simulator=exact(), period=0.1, settle=0.2)
    assert check.good
    assert check.errors.max() < 1e-12
    heavy = ls.check_plant(puck, puck.scene, simulator=exact(mass=2.4), period=0.1)
    assert not heavy.good
    assert heavy.relative[2:] == pytest.approx(1 / 6, rel=1e-9)  # of the speeds that change most
    assert f", exact {heavy.simulated[puck.dynamics.state_coordinates.names.index(heavy.worst)]:.6g}" in str(heavy)


def test_a_simulator_that_does_not_fit_is_refused_in_a_line(page: dict[str, Any]) -> None:
    class Short(page["Exact"]):
        def states(self, simulations: Any) -> Any:
            return simulations["states"][:, :2]

    class Nowhere(page["Exact"]):
        def states(self, simulations: Any) -> Any:
            return np.nan * simulations["states"]

    class Nameless(page["Exact"]):
        name = ""

    puck, plan = page["puck"], page["solution"]
    with pytest.raises(ls.InputError, match=r"^exact: states: got shape \(3, 2\), want \(3, 4\): trials, states$"):
        ls.simulate(ls.Plant(puck, puck.scene, Short()), plan, trials=3)
    with pytest.raises(ls.InputError, match=r"^exact: states: got shape \(1, 2\), want \(1, 4\)"):
        ls.check_plant(puck, puck.scene, simulator=Short())
    with pytest.raises(ls.InputError, match=r"^exact: got a state that is not finite, from x = "):
        ls.check_plant(puck, puck.scene, simulator=Nowhere())
    with pytest.raises(ls.InputError, match=r"^simulator: name: got '', want text: one printable line$"):
        ls.Plant(puck, puck.scene, Nameless())


def test_a_period_that_is_no_multiple_of_the_timestep(page: dict[str, Any]) -> None:
    with pytest.raises(ls.InputError, match=r"want a multiple of the physics step of exact, 0.05 s: plant.for_period"):
        page["plant"].substeps(0.07)
    assert page["plant"].for_period(0.07).substeps(0.07) == 2


def test_a_scenario_runs_in_its_simulator(page: dict[str, Any]) -> None:
    scenario = dataclasses.replace(
        ls.scenarios.differential_drive(), robot=page["puck"], scene=page["puck"].scene, problem=page["problem"],
        simulator=page["plant"].simulator,
    )  # fmt: skip
    assert scenario.plant().simulator is page["plant"].simulator
    with pytest.raises(ls.InputError, match=r"^Scenario: simulator: got 'exact', want a Simulator"):
        dataclasses.replace(scenario, simulator="exact")


def test_a_missing_package_is_named_with_its_extra() -> None:
    with pytest.raises(ls.InputError, match=r"^no_such_simulator: got no such package, want it .*'lqrsim\["):
        package("no_such_simulator.vehicles", "rotorpy")


# Rotors of RotorPy's vehicles, and those of crazyflow's, with the signs of their torques.
CORNERS = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * 0.1


@pytest.mark.parametrize("first", range(4))
def test_frames_put_our_rotors_where_theirs_are(first: int) -> None:
    places, turning = np.roll(CORNERS, first, axis=0), np.roll([1, -1, 1, -1], first)
    frame = Frame.of("vehicle", places, turning)
    assert frame.arm == pytest.approx(0.1 * np.sqrt(2))
    states = np.random.default_rng(0).normal(size=(5, 12))
    x, v, q, w = frame.theirs(states)
    np.testing.assert_allclose(frame.ours(x, v, q, w), states, atol=1e-12)
    own = frame.arm * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    for state, attitude, rates in zip(states, q, w, strict=True):
        ours, theirs = Rotation.from_rotvec(state[6:9]), Rotation.from_quat(attitude)
        in_world = theirs.apply(np.column_stack([places[frame.order], np.zeros(4)]))
        np.testing.assert_allclose(ours.apply(own), in_world, atol=1e-12)
        np.testing.assert_allclose(ours.apply(state[9:]), theirs.apply(rates), atol=1e-12)
    np.testing.assert_array_equal(turning[frame.order], [1, -1, 1, -1])


def test_rotors_that_are_no_square_are_refused() -> None:
    with pytest.raises(ls.InputError, match=r"^vehicle: got rotors at .* want a square with alternating spin$"):
        Frame.of("vehicle", CORNERS * [1, 2], np.array([1, -1, 1, -1]))
    with pytest.raises(ls.InputError, match="alternating spin"):
        Frame.of("vehicle", CORNERS, np.array([1, 1, -1, -1]))


def test_a_quadrotor_with_two_inertias_turns_as_euler_says() -> None:
    robot = ls.Quadrotor(inertia=0.02, yaw_inertia=0.05)
    w, u = np.array([1.0, -0.7, 0.4]), np.array([1.0, 1.4, 1.3, 0.9])
    found = robot.dynamics.rate(np.concatenate([np.zeros(9), w]), u)[9:]
    inertia = np.diag([0.02, 0.02, 0.05])
    torque = [robot.arm * (u[1] - u[3]), robot.arm * (u[2] - u[0]), robot.torque_ratio * (u[0] - u[1] + u[2] - u[3])]
    np.testing.assert_allclose(
        found, np.linalg.solve(inertia, torque - np.cross(w, inertia @ w)), rtol=1e-12, atol=1e-12
    )
    same = ls.Quadrotor(inertia=0.02, yaw_inertia=0.02).dynamics.rate(np.concatenate([np.zeros(9), w]), u)
    np.testing.assert_allclose(same, ls.Quadrotor(inertia=0.02).dynamics.rate(np.r_[np.zeros(9), w], u), atol=1e-12)


@pytest.fixture(scope="module")
def plant() -> ls.Plant:
    """RotorPy's Hummingbird."""
    pytest.importorskip("rotorpy", reason="needs the `rotorpy` extra")
    simulator = ls.simulators.RotorPy(timestep=DT)
    return ls.Plant(simulator.quadrotor(drag=0.0), ls.load_scene("cage", obstacles=False), simulator)


class TestRotorPy:
    """RotorPy's vehicles."""

    def test_it_hovers(self, plant: ls.Plant) -> None:
        rollout = ls.simulate(plant, hover(plant.robot, 20))
        np.testing.assert_allclose(rollout.states, 0.0, atol=1e-9)
        assert rollout.versions["rotorpy"] != "not installed"

    def test_it_turns_where_our_model_turns(self, plant: ls.Plant) -> None:
        """After 20 ms rotors of 5 ms have lost a quarter of what ours have: the integral of 1 - exp(-t / 5 ms)."""
        robot = plant.robot
        assert isinstance(robot, ls.Quadrotor)
        for rotor in range(4):
            controls = np.full((1, 4), robot.hover_force)
            controls[0, rotor] *= 1.02
            plan = track(robot, np.zeros(12), controls, DT, feedback=False)
            turned, planned = ls.simulate(plant, plan).states[0, 1, 9:], plan.trajectory.states[1, 9:]
            large = np.abs(planned) > 1e-4
            np.testing.assert_allclose(turned[large] / planned[large], 0.755, atol=0.03)

    def test_forces_torques_and_masses_are_newtons(self, plant: ls.Plant) -> None:
        robot, factor = plant.robot, 1.25
        assert isinstance(robot, ls.Quadrotor)
        plan = hover(robot, 1)
        lighter = [ls.disturbances.MassMismatch(factor=factor), ls.disturbances.Push((0.01, 0.0, 0.0), at=0.0)]
        moved = ls.simulate(plant, plan, disturbances=lighter).states[0, 1]
        assert moved[3] == pytest.approx(0.01 / (factor * robot.mass), rel=2e-2)  # less the drag that it has
        assert moved[5] == pytest.approx((1 / factor - 1) * robot.gravity * DT, rel=2e-2)
        pushed = ls.simulate(plant, plan, disturbances=[ls.disturbances.TorqueNoise(1e-4)])
        expected = pushed.torques[0, 0] * DT / [robot.inertia, robot.inertia, robot.yaw_inertia]
        np.testing.assert_allclose(pushed.states[0, 1, 9:], expected, rtol=0.05)  # they damp rotations

    def test_wind_is_its_own(self, plant: ls.Plant) -> None:
        rollout = ls.simulate(plant, hover(plant.robot, 2), disturbances=[ls.disturbances.MeanWind((1, 0, 0))])
        assert not rollout.forces.any()
        drag = 4 * 1.19e-4 * plant.simulator.hover_speed  # type: ignore[union-attr] # of the rotors; the body's is 0.005
        assert rollout.states[0, 2, 3] == pytest.approx((drag + 0.005) / 0.5 * 2 * DT, rel=0.03)

    def test_same_seed_same_bits(self, plant: ls.Plant) -> None:
        options = {"disturbances": ls.disturbances.preset("light", plant), "frames": False}
        plan = hover(plant.robot, 5)
        first = ls.simulate(plant, plan, trials=3, **options)
        np.random.default_rng().random()
        np.testing.assert_array_equal(first.states[2:], ls.simulate(plant, plan, first_trial=2, **options).states)

    def test_what_it_cannot_simulate_is_refused(self, plant: ls.Plant) -> None:
        with pytest.raises(ls.InputError, match=r"^RotorPy: vehicle: got 'zeppelin', want 'hummingbird'"):
            ls.simulators.RotorPy("zeppelin")
        numbers = dict(plant.simulator.vehicle) | {"motor_noise_std": 50}  # type: ignore[union-attr]
        with pytest.raises(ls.InputError, match=r"^RotorPy: vehicle: got motor_noise_std 50, want 0"):
            ls.simulators.RotorPy(numbers)
        with pytest.raises(ls.InputError, match=r"^RotorPy: robot: got"):
            ls.Plant(ls.DifferentialDrive(), ls.load_scene("arena"), plant.simulator)


CRAZYFLIE = """
import numpy as np, lqrsim as ls
simulator = ls.simulators.Crazyflow()
robot = simulator.quadrotor()
plant = ls.Plant(robot, ls.load_scene("cage", obstacles=False), simulator)
start = {states}
simulation = simulator.start(start, {factors}, 0.002)
simulator.step(simulation, np.array({controls}) * robot.hover_force, np.zeros((1, 6)), np.zeros((1, 3)), 50)
print(*simulator.states(simulation)[0])
"""


@pytest.mark.parametrize(("name", "first"), [("crazyflow", "Crazyflow().weight"), ("rotorpy", "RotorPy()")])
def test_a_simulator_that_is_too_old_is_named(name: str, first: str, tmp_path: Path) -> None:
    """Before anything of it is imported, which may fail in other words."""
    folder = tmp_path / f"{name}-0.3.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.3\n")
    code = f"import lqrsim as ls; from lqrsim.simulators import *; {first}"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    line = f"lqrsim.errors.InputError: {name}: got {name} 0.3, want newer: pip install '{name}>="
    assert done.stderr.splitlines()[-1].startswith(line)


@pytest.mark.long
@pytest.mark.skipif(importlib.util.find_spec("crazyflow") is None, reason="needs the `crazyflow` extra")
def test_a_crazyflie_hovers_and_falls() -> None:
    """In a process of its own, for it wants SCIPY_ARRAY_API before SciPy is imported."""

    def after(factors: str, controls: str) -> Any:
        code = CRAZYFLIE.format(states="np.zeros((1, 12))", factors=factors, controls=controls)
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"SCIPY_ARRAY_API": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return np.array(done.stdout.split()[-12:], dtype=float)

    np.testing.assert_allclose(after("{}", "[[1, 1, 1, 1]]"), 0.0, atol=1e-6)
    heavy = after("{'mass': np.array([[1.25]])}", "[[1, 1, 1, 1]]")
    assert heavy[5] == pytest.approx((1 / 1.25 - 1) * 9.81 * 0.1, rel=0.03)  # its drag is 2 % by then
    assert after("{}", "[[1.1, 1, 1, 1]]")[10] < -0.5  # more force of the rotor at +x turns it about -y
