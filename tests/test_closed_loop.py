"""Running policies in MuJoCo: tracking, repeatability, what is recorded, and what bad input is told."""

import inspect
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mechanisms import Jointed, motors, row, scene
from sampling import examples
from tracking import hover, track, weave

from lqrsim.errors import InputError
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results import save_load
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Status, Trajectory
from lqrsim.robots.mjcf import MjcfRobot
from lqrsim.robots.packaged import DifferentialDrive, Quadrotor
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenes.scene import load_scene, scene_from_xml
from lqrsim.simulation.closed_loop import ClosedLoop, simulate
from lqrsim.simulation.disturbances import ControlNoise, Disturbance, Effect, ForceNoise, MeasurementNoise, Push
from lqrsim.simulation.plant import Plant
from lqrsim.simulation.plant_check import check_plant

NOISE = (ControlNoise(0.02), ForceNoise(0.1), MeasurementNoise(0.005))
RECORDS = ("states", "measured", "commanded", "applied", "forces", "clearance", "contacts", "collided_at", "frames")


def test_undisturbed_quadrotor_keeps_to_its_plan_within_a_micrometre(cage):
    rollout = simulate(cage, hover())
    assert rollout.tracking_error.max() < 1e-6
    assert rollout.outcome == ("reached",)
    # The plan is worth tracking: it moves, and tilts.
    assert np.ptp(rollout.plan.states[:, :3], axis=0).max() > 0.01


def test_undisturbed_differential_drive_keeps_to_its_plan_within_a_centimetre_across_the_cut_at_pi(arena):
    rollout = simulate(arena, weave())
    assert rollout.tracking_error.max() < 0.01
    headings = rollout.states[0, :, 2]
    assert headings.min() < np.pi < headings.max()
    assert np.abs(np.diff(headings)).max() < 0.2  # no jump by a whole turn
    assert rollout.outcome == ("reached",)
    assert rollout.contacts.tolist() == [0]  # the wheels on the floor do not count


@pytest.mark.parametrize(("fixture", "plan"), [("arena", weave), ("cage", hover)])
def test_a_trial_is_the_same_to_the_last_bit_whatever_runs_beside_it(request, fixture, plan):
    plant, solution = request.getfixturevalue(fixture), plan(30)
    # Nine, so that vector instructions of any width have a remainder.
    together = simulate(plant, solution, disturbances=NOISE, seed=3, trials=9)
    again = simulate(plant, solution, disturbances=NOISE, seed=3, trials=9)
    for name in RECORDS:
        np.testing.assert_array_equal(getattr(again, name), getattr(together, name), err_msg=name)
    for trial in (0, 5, 8):
        alone = simulate(plant, solution, disturbances=NOISE, seed=3, first_trial=trial)
        assert alone.first_trial == trial
        for name in RECORDS:
            np.testing.assert_array_equal(getattr(alone, name)[0], getattr(together, name)[trial], err_msg=name)
    other = simulate(plant, solution, disturbances=NOISE, seed=4, trials=9)
    assert (other.states[:, -1] != together.states[:, -1]).all()
    assert (together.states[1:, -1] != together.states[:-1, -1]).all()


@pytest.mark.parametrize("noise", [0.3, 0.6, 1.0])
def test_periods_in_contact_are_those_of_a_trial_alone(arena, noise):
    """Robots bounce off a wall within a period, while others run theirs again because they collide in it."""
    ahead = track(DifferentialDrive(), (0.5, -2.4, 0.0), np.full((60, 2), 0.3), 1 / 6)
    disturbances = [ControlNoise(noise)]
    together = simulate(arena, ahead, disturbances=disturbances, trials=12, frames=False)
    assert len({*together.contacts.tolist()}) > 3
    for trial in range(12):
        alone = simulate(arena, ahead, disturbances=disturbances, first_trial=trial, frames=False)
        for name in RECORDS[:-1]:
            np.testing.assert_array_equal(getattr(alone, name)[0], getattr(together, name)[trial], err_msg=name)


def test_adding_a_disturbance_leaves_the_draws_of_those_before_it(cage):
    one = simulate(cage, hover(10), disturbances=[ForceNoise(0.1)])
    two = simulate(cage, hover(10), disturbances=[ForceNoise(0.1), MeasurementNoise(0.01)])
    np.testing.assert_array_equal(one.forces, two.forces)


def test_records_are_of_what_happened(cage):
    solution = hover()
    rollout = simulate(cage, solution, disturbances=[ControlNoise(3.0), MeasurementNoise(0.01)], trials=2)
    low, high = 0.0, cage.robot.max_force
    assert rollout.applied.min() == low
    assert rollout.applied.max() == high
    for trial in range(2):
        for step in (0, 17):
            command = solution.policy(rollout.measured[trial, step], rollout.times[step])
            np.testing.assert_allclose(rollout.commanded[trial, step], command, rtol=1e-12)
    # The states follow from the controls that were applied, not from those that were commanded.
    before, control = rollout.states[0, 8], rollout.applied[0, 8]
    expected = cage.robot.dynamics.step(before, control, 1 / 30)
    difference = cage.robot.dynamics.state_coordinates.difference(rollout.states[0, 9], expected)
    np.testing.assert_allclose(difference, 0, atol=1e-5)
    np.testing.assert_allclose(rollout.clearance, cage.world.distance(rollout.states[..., :3]) - 0.3)
    assert rollout.disturbances == (
        "control noise, std 3 N",
        "measurement noise, std 0.01 m, 0.01 m/s, 0.01 rad, 0.01 rad/s",
    )
    assert rollout.model == cage.scene.xml
    assert (rollout.robot, rollout.scene) == ("quadrotor", "cage")
    # The plan is shorter than the robot's radius of 0.3 m, so a tenth of its way is the radius.
    way = np.linalg.norm(solution.trajectory.states[-1, :3] - solution.trajectory.states[0, :3])
    assert 0.0 < way < 0.3
    assert rollout.goal_radius == pytest.approx(0.1 * way, rel=1e-12)


@pytest.mark.parametrize(("fixture", "plan"), [("arena", weave), ("cage", hover)])
def test_frames_are_frequent_and_belong_to_the_states(request, fixture, plan):
    plant, solution = request.getfixturevalue(fixture), plan(30)
    rollout = simulate(plant, solution, disturbances=NOISE)
    model = mujoco.MjModel.from_xml_string(rollout.model)
    assert rollout.frames.shape == (1, len(rollout.frame_times), model.nq)
    assert np.diff(rollout.frame_times).max() < 1 / 30 + 1e-9
    np.testing.assert_allclose(rollout.frame_times[[0, -1]], rollout.times[[0, -1]])
    each = (len(rollout.frame_times) - 1) // rollout.plan.steps
    at_knots = rollout.frames[:, ::each][..., plant.qpos]
    states = plant.robot.state(at_knots, np.zeros((*at_knots.shape[:-1], model.nv)), near=rollout.states)
    position = list(plant.robot.dynamics.state_coordinates.position)
    np.testing.assert_allclose(states[..., position], rollout.states[..., position], atol=1e-12)


def test_a_wall_stops_the_robot_and_is_counted_as_contact(arena):
    ahead = track(DifferentialDrive(), (0.5, -2.4, 0.0), np.full((60, 2), 0.3), 1 / 6)  # 3 m ahead, and the wall in 1.5
    rollout = simulate(arena, ahead)
    assert rollout.contacts[0] > 20
    assert rollout.outcome == ("collided",)
    # Held by the wall: contacts give way by millimetres, not by the 1.7 m that the plan goes on.
    assert 2 - 0.17 - 0.01 < rollout.states[0, -1, 0] < 2 - 0.17 + 0.01


def test_the_loop_has_the_arguments_of_simulate_with_their_defaults():
    given = {name: one.default for name, one in inspect.signature(simulate).parameters.items() if name != "plant"}
    own = {one.name: one.default for one in fields(ClosedLoop) if one.init and one.name != "plant"}
    assert own == given | {"starts": None, "knot": 0}


def test_progress_counts_the_control_periods(cage):
    seen = []
    simulate(cage, hover(5), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 5), (2, 5), (3, 5), (4, 5), (5, 5)]


# A robot, a scene and disturbances of a user's own, outside the package.

SLED = scene(
    """<body name="sled">
      <joint name="along" type="slide" axis="1 0 0"/> <joint name="across" type="slide" axis="0 1 0"/>
      <geom type="sphere" size="0.1" mass="2"/>
    </body>""",
    motors(("along", "across"), (5, 5)).replace('name="along"', 'name="push"').replace('name="across"', 'name="steer"'),
    things='<geom type="box" size="0.1 1 1" pos="3 0 0"/>', option='timestep="0.01"',
)  # fmt: skip


@dataclass(frozen=True)
class Sled(Jointed):
    radius: float = 0.1

    name = "sled"
    body = "sled"
    joints = ("across", "along")  # not in the order of the file
    actuators = ("steer", "push")

    @cached_property
    def dynamics(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return Dynamics(
            lambda x, u, p: [x[2], x[3], u[0] / p.mass, u[1] / p.mass],
            states={"y": "m", "x": "m", "vy": "m/s", "vx": "m/s"},
            controls={"steer": "N", "push": "N"},
            parameters={"mass": 2.0},
            position=("x", "y"),
            control_limits=(-5, 5),
        )


@dataclass(frozen=True)
class Wind(Disturbance):
    """Blows harder the farther the robot is to the left, in one trial only: a force that depends on the state."""

    strength: float

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        def blow(step, states):
            force = np.zeros((len(states), 3))
            force[1, 0] = self.strength * states[1, 1]
            return force

        return Effect(force=blow)


@dataclass(frozen=True)
class Delay(Disturbance):
    """Commands arrive one period late: something that remembers."""

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        last = [np.zeros((len(generators), plan.controls.shape[1]))]

        def actuate(step, controls):
            last.append(controls)
            return last.pop(0)

        return Effect(actuate=actuate)


@pytest.fixture
def sled(tmp_path):
    (tmp_path / "ice.xml").write_text(SLED)
    return Plant(Sled(), load_scene(tmp_path / "ice.xml"))


def test_a_robot_and_disturbances_of_ones_own_plug_in(sled):
    controls = np.tile([0.1, -0.2], (40, 1))
    solution = track(sled.robot, (0.0, 1.0, 0.0, 0.0), controls, 0.1, feedback=False)
    rollout = simulate(sled, solution, disturbances=[Wind(-2.0), Delay()], trials=2)
    assert rollout.disturbances == ("Wind(strength=-2.0)", "Delay()")
    np.testing.assert_array_equal(rollout.applied[:, 0], 0)
    np.testing.assert_array_equal(rollout.applied[:, 1:], rollout.commanded[:, :-1])
    # Trial 0 is late by one period; a double integrator then runs behind the plan by known amounts.
    times = rollout.times[1:] - 0.1
    np.testing.assert_allclose(rollout.states[0, 1:, 1], 1 - 0.1 * times**2 / 2, atol=0.003)  # semi-implicit Euler
    np.testing.assert_array_equal(rollout.forces[1, :, 0], -2.0 * rollout.states[1, :-1, 1])
    # A box without a name is an obstacle all the same, 3 - 0.1 - 0.1 m from the origin.
    np.testing.assert_allclose(rollout.clearance[0, 0], 2.8 - 1.0)


def test_a_trial_that_blows_up_is_lost_and_the_others_are_not(sled, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    solution = track(sled.robot, (0.0, 1.0, 0.0, 0.0), np.zeros((40, 2)), 0.1)
    calm = simulate(sled, solution, trials=3)
    rollout = simulate(sled, solution, disturbances=[Wind(1e9)], trials=3)
    assert rollout.diverged.tolist() == [False, True, False]
    assert rollout.outcome == ("reached", "diverged", "reached")
    np.testing.assert_array_equal(rollout.states[[0, 2]], calm.states[[0, 2]])
    alive = np.isfinite(rollout.states[1]).all(axis=1)
    assert alive[0]
    assert not alive[-1]
    assert (np.diff(alive.astype(int)) <= 0).all()  # once lost, lost
    for name in ("measured", "clearance"):
        lost = np.isnan(getattr(rollout, name)[1]).reshape(41, -1).all(axis=1)
        np.testing.assert_array_equal(lost, ~alive, err_msg=name)
    assert np.isnan(rollout.frames[1, -1]).all()
    assert "trial 1: diverged after" in rollout.summary()
    assert [path.name for path in tmp_path.iterdir()] == ["ice.xml"]  # and no log of MuJoCo's


class Weightless(Disturbance):
    """Takes nearly all mass away, of which MuJoCo warns as it works out what follows from the masses."""

    def start(self, plant: Plant, plan: Trajectory, generators: Sequence[np.random.Generator]) -> Effect:
        def alter(simulations):
            simulations.expand("body_mass")[:] = 1e-300

        return Effect(alter=alter)


def test_what_mujoco_warns_of_while_a_model_is_altered_leaves_no_file(sled, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = sorted(path.name for path in tmp_path.iterdir())
    simulate(sled, track(sled.robot, (0.0, 1.0, 0.0, 0.0), np.zeros((5, 2)), 0.1), disturbances=[Weightless()])
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_policy_that_returns_nan_fails_and_is_not_taken_for_zero(sled):
    solution = track(sled.robot, (0.0, 1.0, 0.0, 0.0), np.zeros((10, 2)), 0.1)
    offset = solution.policy.offset.copy()
    offset[4] = np.nan
    broken = replace(solution.policy, offset=offset)
    rollout = simulate(sled, replace(solution, status=Status.MAX_ITERATIONS, policy=broken))
    assert rollout.outcome == ("error",)
    assert rollout.reasons == ("controller at 0.4 s: got nan for steer, want a finite number",)
    assert np.isfinite(rollout.states[0, :5]).all()
    assert np.isnan(rollout.states[0, 5:]).all()


@dataclass(frozen=True)
class _Pushed(Disturbance):
    """Pushes the second of three trials by a number, from the fifth period on."""

    kind: str
    number: float

    def start(self, plant, plan, generators):
        hooks: dict[str, Any] = {
            self.kind: lambda step, states: np.outer([0.0, self.number if step >= 5 else 0.0, 0.0], [0, 1, 0])
        }
        return Effect(**hooks)


@pytest.mark.parametrize("number", [1e400, -1e400, 1e400 - 1e400], ids=str)
@pytest.mark.parametrize(("kind", "with_drag"), [("force", False), ("torque", False), ("wind", True)])
def test_a_force_that_is_not_finite_loses_its_trial(cage, arena, number, kind, with_drag):
    for plant, plan in ((cage, hover(12)), (arena, weave(12)))[: 1 if with_drag else 2]:
        if np.isinf(number):
            pushed = _Pushed(kind, 1.0)
            assert "diverged" not in simulate(plant, plan, disturbances=[pushed], trials=3, frames=False).outcome
        with np.errstate(invalid="ignore"):  # infinity times zero
            rollout = simulate(plant, plan, disturbances=[_Pushed(kind, number)], trials=3)
        assert [one == "diverged" for one in rollout.outcome] == [False, True, False]
        assert rollout.reasons[0] == rollout.reasons[2] == ""
        assert rollout.reasons[1].startswith(
            f"disturbances at {5 * rollout.plan.dt:.4g} s: got a force, torque or wind"
        )
        np.testing.assert_array_equal(rollout.states[[0, 2]], simulate(plant, plan, trials=2).states)


def test_controls_that_mujoco_ignores_lose_the_trial(tmp_path):
    """Beyond 1e10 MuJoCo sets all controls to zero, and only warns; the record would say that they were applied."""

    class Strong(Sled):
        @cached_property
        def dynamics(self):
            return Dynamics(
                super().dynamics.f,
                states={"y": "m", "x": "m", "vy": "m/s", "vx": "m/s"},
                controls={"steer": "N", "push": "N"},
                parameters={"mass": 2.0},
                position=("x", "y"),
            )

    robot = Strong()
    solution = track(robot, (0.0, 1.0, 0.0, 0.0), np.zeros((5, 2)), 0.1, feedback=False)
    strong = replace(solution, policy=replace(solution.policy, offset=np.full((5, 2), 1e12)))
    (tmp_path / "ice.xml").write_text(SLED.replace(' ctrlrange="-5 5"', ""))
    assert simulate(Plant(robot, load_scene(tmp_path / "ice.xml")), strong).outcome == ("diverged",)


@pytest.mark.parametrize("seed", range(examples(20)))
def test_a_bumper_touches_whichever_body_has_it(seed: int, tmp_path: Path) -> None:
    """On the sled, or on a carriage that carries it; it reaches further than the sled's radius."""
    rng, runs = np.random.default_rng(seed), []
    bumper = f'<geom type="box" pos="{rng.uniform(0.2, 0.5)} 0 0" size="0.05 0.1 0.1" mass="0.5"/>'
    push = rng.uniform(1.5, 3.0, (40, 1)) * [0, 1]
    across, ball = re.findall(r'<joint name="across"[^>]*>|<geom type="sphere"[^>]*>', SLED)
    for body in (f"{across}{ball}{bumper}", f'{bumper}<body name="sled">{across}{ball}</body>'):
        text = SLED.replace(ball, "").replace(across, body)
        if text.count('"sled"') > 1:
            text = text.replace('"sled"', '"carriage"', 1)
        (tmp_path / "ice.xml").write_text(text)
        plant = Plant(Sled(), load_scene(tmp_path / "ice.xml"))
        runs.append(simulate(plant, track(plant.robot, np.zeros(4), push, 0.1, feedback=False)))
    assert runs[0].outcome == runs[1].outcome == ("collided",)
    np.testing.assert_allclose(runs[1].collided_at, runs[0].collided_at, atol=1e-9)
    before = [run.states[run.counts] for run in runs]  # the softness of MuJoCo's contacts is that of a body
    np.testing.assert_allclose(before[1], before[0], atol=1e-9)
    assert min(run.contacts[0] for run in runs) > 0


# Bad input


def fitted(was: str = "", instead: str = "", **fields: object) -> Plant:
    """A plant of a sled with other fields, in a scene with another text."""
    robot = Sled()
    vars(robot).update(fields)
    return Plant(robot, scene_from_xml(re.sub(was, instead, SLED) if was else SLED, "ice"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        *[(partial(fitted, f'"{name}"', f'"other_{name}"'),
           f"^scene ice: got no robot sled in it, want its {part} '{name}';.*other_")
          for part, name in (("body", "sled"), ("joint", "across"), ("actuator", "steer"))],
        (lambda: fitted(r' name="across"|<\w+ [^<]*joint="across"[^<]*/>'),
         r"want its joint 'across'; it has: along, 1 without a name \(joint \d has none, counted from 0: name"),
        (lambda: fitted(' name="steer"'),
         r"want its actuator 'steer'; it has: push, 1 without a name \(actuator \d has none, counted from 0"),
        (lambda: fitted(joints="across"), "robot sled: joints: got 'across', want names of the MJCF in a tuple"),
        (lambda: fitted(joints=("across", "")), r"robot sled: joints: got \('across', ''\), want names"),
        (lambda: fitted(joints=("across", "across")), "robot sled: joints: got a name twice in across, across"),
        (lambda: fitted(drag=-1.0), "robot sled: drag: got -1.0, want a finite number >= 0"),
        (lambda: fitted(actuators=()), r"robot sled: actuation: got shape \(2,\), want \(0,\) for no actuators"),
        (lambda: fitted(radius=-1.0), "robot sled: radius: got -1.0, want a finite number >= 0"),
        (lambda: fitted(radius=None),
         "robot sled: radius: got none, want a number >= 0, in m: .* its size in pictures"),
        (lambda: fitted("<worldbody>", '<option><flag sleep="enable"/></option><worldbody>'),
         "scene ice: got an MJCF that cannot be run in batches: sleep and IPC"),
        (lambda: fitted('timestep="[^"]*"', 'timestep="3e-8"').substeps(0.09),
         "control period: got 0.09 s, 3,000,000 physics steps of scene ice, want at most 20,000"),
    ],
)  # fmt: skip
def test_a_robot_that_does_not_fit_is_told_why(make: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()


def test_a_control_period_that_is_no_multiple_of_the_physics_step_is_told_both(cage):
    solution = track(Quadrotor(), np.zeros(12), np.full((5, 4), 1.225), 0.05)
    with pytest.raises(
        InputError, match=r"^control period: got 0.05 s, want a multiple of .* cage, 0.0333333 s: plant.for_period"
    ):
        simulate(cage, solution)
    with pytest.raises(InputError, match=r"^control period: got 0.01 s, .*timestep=\"0.01"):
        cage.substeps(0.01)
    assert cage.substeps(1 / 10) == 3


def test_what_the_plant_adds_has_names_of_its_own(tmp_path):
    """Sensors and geoms that are called as the plant would call its own."""
    text = SLED.replace(
        "</mujoco>", '<sensor><clock name="contact with wall"/><clock name="contact with box 0"/></sensor></mujoco>'
    )
    (tmp_path / "ice.xml").write_text(text)
    plant = Plant(Sled(), load_scene(tmp_path / "ice.xml"))
    named = [plant.model.sensor(number).name for number in range(plant.model.nsensor)]
    assert named[:2] == ["contact with wall", "contact with box 0"]
    assert len(named) == len(set(named)) == 2 + len(plant.world)


def test_a_saved_policy_runs_as_the_one_that_was_saved(
    differential_drive: Scenario, drive_solution: Solution, tmp_path: Path
) -> None:
    """What is loaded is read-only."""
    loaded = save_load.load(save_load.save(drive_solution, tmp_path / "solution.npz"), Solution)
    runs = [simulate(differential_drive.plant(), solution) for solution in (drive_solution, loaded)]
    np.testing.assert_array_equal(runs[0].states, runs[1].states)


OUT_OF_THE_ARENA = track(DifferentialDrive(), (0.9, -2.5, np.pi), np.full((60, 2), 0.45), 1 / 6, feedback=False)


@pytest.mark.parametrize("chosen", [False, True], ids=["none", "one"])
@pytest.mark.parametrize(
    ("robot", "name", "one", "plan", "pushed"),
    [
        (Quadrotor(), "cage", "wall_south", hover(), (3.0, 0.5, 0.2)),
        (DifferentialDrive(), "arena", "pillar_4", OUT_OF_THE_ARENA, (0.0, 5.0, 0.0)),
    ],
    ids=["cage", "arena"],
)
def test_the_robot_passes_through_what_a_choice_of_obstacles_leaves_out(robot, name, one, plan, pushed, chosen):
    """As through nothing: the same runs as where these geoms are deleted. It still stands on its floor."""
    choice, whole = (one,) if chosen else False, load_scene(name)
    root = ElementTree.fromstring(whole.xml)
    for parent in list(root.iter()):
        for geom in parent.findall("geom"):
            if geom.get("name") in {*whole.world.names} - {"floor", *(choice or ())}:
                parent.remove(geom)
    bare = scene_from_xml(ElementTree.tostring(root, encoding="unicode"), name, obstacles=choice)
    push = Push(pushed, at=0.5)
    run, wanted = (
        simulate(Plant(robot, scene), plan, disturbances=[push]) for scene in (load_scene(name, obstacles=choice), bare)
    )
    np.testing.assert_allclose(run.states, wanted.states, rtol=0, atol=1e-9)
    assert Plant(robot, whole).clearance(run.states).min() < -0.1  # it went through something
    assert run.outcome == wanted.outcome
    assert (run.collided_at == wanted.collided_at).all()


def test_what_a_choice_of_obstacles_leaves_out_still_carries_other_bodies(tmp_path):
    path = tmp_path / "room.xml"
    things = """<geom name="table" type="box" size=".3 .3 .1" pos="0 0 -.9"/>
      <geom name="shelf" type="box" size=".1 .1 .1" pos="0 0 .9"/>
      <body name="crate" pos="0 0 -.7"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>"""
    pair = '<contact><pair geom1="quadrotor_sphere" geom2="shelf"/></contact>'
    path.write_text(scene(things, before='<include file="quadrotor.xml"/>', more=pair))
    plant, plan = Plant(Quadrotor(), load_scene(path, obstacles=False)), hover()
    run = simulate(plant, plan, disturbances=[Push((0.0, 0.0, 3.0), at=0.0)])
    assert run.states[0, :, 2].max() > 0.9  # through the shelf
    crate = plant.model.joint(plant.model.body("crate").jntadr[0]).qposadr[0] + 2
    np.testing.assert_allclose(run.frames[0, :, crate], -0.7, atol=0.01)


@pytest.mark.parametrize("impulse", [2.0, 3.0])
@pytest.mark.parametrize("attributes", ["", 'condim="1"', 'solref="0.002 1"'])
def test_a_pair_of_the_mjcf_is_no_wall_without_contacts(attributes, impulse, tmp_path):
    """The robot passes through, at the same time and to the same depth, as where contype and conaffinity collide."""
    runs = []
    for pair in ("", f'<contact><pair geom1="quadrotor_sphere" geom2="shelf" {attributes}/></contact>'):
        path = tmp_path / "room.xml"
        shelf = '<geom name="shelf" type="box" size=".5 .5 .1" pos="0 0 .9"/>'
        path.write_text(scene(shelf, before='<include file="quadrotor.xml"/>', more=pair))
        plant, push = Plant(Quadrotor(), load_scene(path)), Push((0.0, 0.0, impulse), at=0.0)
        runs.append(simulate(plant, hover(), disturbances=[push], contacts=False))
    assert runs[0].outcome == ("collided",)
    assert runs[0].obstacles == runs[1].obstacles
    np.testing.assert_allclose(runs[1].states, runs[0].states, rtol=0, atol=1e-9)
    np.testing.assert_allclose(runs[1].collided_at, runs[0].collided_at, atol=plant.timestep)


# Plans that their own undisturbed run leaves, and MuJoCo's warnings.

BILLIARD = row(
    "xy", joint='type="slide" axis="1 0 0"', joints=("", 'ref="1"'), places=("0 0 0", "1 0 0"), geom="",
    geoms=('size="0.05" mass="1"', 'type="box" size=".05 .05 .05" mass="5"'), actuators=motors("x", [9]),
    option='timestep="0.005" gravity="0 0 0"',
)  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_a_plan_on_a_contact_switch_says_that_its_run_leaves_it_where_and_by_how_much(seed: int) -> None:
    """A ball rolls to a block; it gets there a nanometre too late for the last physics step of a period, or in time."""
    rng = np.random.default_rng(seed)
    robot, speed, knot, dt = MjcfRobot(scene_from_xml(BILLIARD, "billiard")), *rng.uniform((0.5, 5), (2.0, 20)), 0.01
    knot = int(knot)
    first = np.array([1 - 0.1 - speed * dt * knot, 1.0, speed, 0.0])
    late, early = (first + np.array([off, 0, 0, 0]) for off in (-1e-9, 1e-9))
    solution = track(robot, late, np.zeros((30, 1)), dt, feedback=False)
    plant, plan = Plant(robot, robot.scene), solution.trajectory
    begun = replace(solution, trajectory=replace(plan, states=np.vstack([early, plan.states[1:]])))
    for disturbances in ([], [ControlNoise(1e-6)]):
        assert simulate(plant, solution, disturbances=disturbances).departure() == ""
        assert "LEAVES" not in str(simulate(plant, solution, disturbances=disturbances))
        run = simulate(plant, begun, disturbances=disturbances, trials=2)
        assert run.undisturbed is not None
        # What is said is where MuJoCo's own steps from that state first are off by a tenth of the range in a unit.
        data = mujoco.MjData(plant.model)
        data.qpos[:], data.qvel[:] = early[:2], early[2:]
        ran = [early]
        for _ in range(30):
            mujoco.mj_step(plant.model, data, 2)
            ran.append(np.array([*data.qpos, *data.qvel]))
        allowed = 0.1 * np.repeat(np.ptp(plan.states, axis=0).reshape(2, 2).max(axis=1), 2)
        t = int(np.argmax((np.abs(ran - plan.states) > allowed).any(axis=1)))
        off = ran[t] - plan.states[t]
        worst = int(np.argmax(np.abs(off) / allowed))
        name, unit = (("x", "m"), ("y", "m"), ("x_velocity", "m/s"), ("y_velocity", "m/s"))[worst]
        said = f"{name} {off[worst]:+.3g} {unit}, allowed {allowed[worst]:.3g} {unit}; a period before, no state was"
        assert run.departure().startswith(f"LEAVES the plan at {t * dt:.4g} s: {said} off by more than ")
        assert t == knot + 1
        assert f"  undisturbed, the plan's policy {run.departure()}\n" in run.summary()


def test_a_plan_of_another_model_is_left_gradually() -> None:
    robot = MjcfRobot(scene_from_xml(BILLIARD, "billiard"))
    solution = track(robot, [0.0, 1.0, 0.0, 0.0], np.full((30, 1), 1.0), 0.01, feedback=False)
    other = replace(solution.trajectory, states=0.8 * solution.trajectory.states + np.array([0.0, 0.2, 0.0, 0.0]))
    run = simulate(Plant(robot, robot.scene), replace(solution, trajectory=other))
    said = run.departure()
    assert re.fullmatch(r"LEAVES the plan at 0\.\d+ s: x\S* \+\S+ \S+, allowed \S+ \S+", said)
    assert f"policy {said}\n" in run.summary()
    formulas = replace(run, scene="a scene for a robot of formulas")
    assert f"policy {said}; ls.check_plant compares the plan's dynamics" in formulas.summary()


JOINTS = {
    "inertia": '<joint name="a" axis="0 1 0"/><joint name="b" axis="0 1 0"/><geom size=".05" pos=".2 0 0" mass="1"/>',
    "memory": '<joint name="a" type="slide" axis="0 0 1"/>'
    + "".join(f'<geom size=".051" pos="{0.2 * i} 0 0" mass="1"/>' for i in range(40)),
}


@pytest.mark.parametrize(("kind", "said"), [("inertia", "nearly singular"), ("memory", "too many contacts")])
def test_warnings_of_mujoco_are_counted_and_neither_printed_nor_left_in_a_file(
    kind: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Against the counters of MuJoCo's own loop. A handler of the user's stays."""
    monkeypatch.chdir(tmp_path)
    xml = scene(
        f'<body pos="0 0 0.05">{JOINTS[kind]}</body>', motors("a", [1]), before='<size memory="20K"/>',
        things='<geom type="plane" size="9 9 1"/>', option='timestep="0.005"',
    )  # fmt: skip
    robot = MjcfRobot(scene_from_xml(xml, kind))
    plan = track(robot, np.zeros(len(robot.dynamics.state_coordinates)), np.zeros((6, 1)), 0.01, feedback=False)
    assert str(robot)
    run = simulate(Plant(robot, robot.scene), plan, trials=3, threads=2)
    assert run.warnings is not None
    assert capfd.readouterr().err == ""
    assert list(tmp_path.iterdir()) == []
    messages: list[str] = []
    mujoco.set_mju_user_warning(messages.append)
    try:
        again = simulate(Plant(robot, robot.scene), plan)
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, 12)
        assert mujoco.get_mju_user_warning() == messages.append
    finally:
        mujoco.set_mju_user_warning(None)
    counted = [one.number for one in data.warning]
    assert sum(counted) > 0
    np.testing.assert_array_equal(run.warnings, [counted] * 3)
    np.testing.assert_array_equal(again.warnings, [counted])
    assert f"  MuJoCo warned {3 * sum(counted)} times in 3 of 3 trials: {said}" in run.summary()
    path = save_load.save(run, tmp_path / "run.npz")
    np.testing.assert_array_equal(save_load.load(path, Rollout).warnings, run.warnings)
    older = replace(run, warnings=None, undisturbed=None)
    assert older.warned() == older.departure() == ""


LINK = 'type="capsule" fromto="0 0 0 .4 0 0" size=".04" mass="1"'


@pytest.mark.parametrize("seed", range(examples(20)))
def test_contacts_are_those_of_the_whole_robot_whichever_body_disturbances_act_on(seed: int, tmp_path: Path) -> None:
    """Also of trees without that body, whatever their order; a margin makes a contact a collision."""
    rng = np.random.default_rng(seed)
    at, margin = rng.uniform(0.1, 0.7, (2, 2)), rng.choice([0.0, 0.03])
    arms = [
        f'<body name="{name}1" pos="0 {y} .5"><joint name="{name}a" axis="0 1 0"/><geom {LINK}/>'
        f'<body name="{name}2" pos=".4 0 0"><joint name="{name}b" axis="0 1 0"/><geom {LINK}/>'
        f'<body name="{name}3" pos=".4 0 0"><joint name="{name}c" axis="0 1 0"/><geom {LINK}/></body></body></body>'
        for name, y in (("p", 0), ("q", 2))
    ]
    balls = [
        f'<geom name="{name}" size=".1" pos="{x} {y} {0.35 - depth / 3}" margin="{margin}"/>'
        for name, y, (x, depth) in zip("ij", (0, 2), at, strict=True)
    ]
    found = []
    for order, body in [(1, None), (1, "p2"), (1, "q1"), (1, "q2"), (-1, None)]:
        path = tmp_path / "arms.xml"
        path.write_text(scene("".join(arms[::order] + balls), motors(["pa"], [1])))
        robot = MjcfRobot(path, body=body, position=())
        plan = track(robot, robot.at(), np.zeros((30, 1)), 0.02, feedback=False)
        run = simulate(Plant(robot, robot.scene), plan)
        folded = robot.at(pb=2.2, pc=2.2, qb=2.2, qc=2.2)
        check = check_plant(robot, robot.scene, samples=3, around=folded, spread=0.01)
        touched = sorted({tuple(sorted(pair[:2])) for pair in check.contacts})
        found.append((run.outcome, run.obstacles, run.contacts.tolist(), run.collided_at.round(9).tolist(), touched))
    assert found[0][2] != [0]
    assert all(one == found[0] for one in found)
