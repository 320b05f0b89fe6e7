"""An MJCF by its path, where a scenario's name could stand."""

from dataclasses import replace
from pathlib import Path

import mechanisms
import numpy as np
import pytest
from mechanisms import motors, sled

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.errors import InputError
from lqrsim.problem.parts import terms_of
from lqrsim.problem.state_bounds import LimitCost
from lqrsim.scenarios.references import from_anywhere, names_code, resolve


@pytest.fixture
def cart(tmp_path: Path) -> Path:
    file = tmp_path / "cart.xml"
    key = '<keyframe><key name="tilted" qpos="0.1 0.5"/></keyframe></mujoco>'
    file.write_text(mechanisms.draw("cart", 3, "implicitfast").xml.replace("</mujoco>", key), encoding="utf-8")
    return file


def test_start_goal_and_weights_are_by_name_unit_and_keyframe(cart: Path) -> None:
    settings = "start=tilted,goal={'keyframe': 'tilted', 'pole': 3.0},weights={'rad': 7, 'slider': 5},steps=20,effort=2"
    scenario = resolve(f"{cart},{settings}")
    problem = scenario.problem
    assert (problem.steps, problem.dt) == (20, pytest.approx(0.02))
    np.testing.assert_array_equal(problem.start, [0.1, 0.5, 0, 0])
    np.testing.assert_array_equal(problem.goal, [0.1, 3.0, 0, 0])
    (weighed,) = terms_of(problem.final_cost)
    assert isinstance(weighed, ls.QuadraticCost)
    np.testing.assert_array_equal(np.diag(weighed.weight), [5, 7, 0, 0])
    efforts, velocities, limits = terms_of(problem.stage_cost)
    assert isinstance(efforts, ls.ControlCost)
    np.testing.assert_array_equal(efforts.weight, [[2.0]])
    assert isinstance(velocities, ls.QuadraticCost)
    np.testing.assert_array_equal(np.diag(velocities.weight), [0, 0, 1e-3, 1e-3])
    assert isinstance(limits, LimitCost)
    assert (problem.control_coordinates.low, problem.control_coordinates.high) == ((-1.0,), (1.0,))
    assert scenario.name == "cart"


def test_start_and_goal_are_at_rest_where_contacts_carry_the_robot(tmp_path: Path) -> None:
    """A box on a slide, above its floor: MuJoCo's contact is a spring, which its weight pushes in."""
    file = tmp_path / "box.xml"
    file.write_text(
        sled(
            "z",
            geom='type="box" size="0.1 0.1 0.1" mass="2"',
            place="0 0 0.3",
            option='timestep="0.002"',
            carried='<body><joint name="arm" axis="0 0 1"/><geom size="0.05"/></body>',
            actuators=motors(("arm",)),
            things='<geom type="plane" size="5 5 1"/>',
        ),
        encoding="utf-8",
    )
    problem = resolve(f"{file},goal={{'arm': 0.5}},at_rest=True").problem
    for state, arm in ((problem.start, 0.0), (problem.goal, 0.5)):
        assert state is not None
        np.testing.assert_allclose(state[:2], [-0.2, arm], rtol=0, atol=1e-3)
    with pytest.raises(InputError, match="at_rest: got 1, want True or False"):
        resolve(f"{file},at_rest=1")


def test_a_box_among_posts_keeps_clear_of_them(tmp_path: Path) -> None:
    file = tmp_path / "box.xml"
    post = '<geom name="post" type="cylinder" size="0.1 1" pos="2 0 1"/></worldbody>'
    file.write_text(mechanisms.draw("box", 3, "Euler").xml.replace("</worldbody>", post), encoding="utf-8")
    scenario = ls.scenarios.mjcf(str(file), start={"z": 1.0}, goal={"x": 3.0, "z": 1.0})
    (cost,) = scenario.problem.obstacle_costs
    assert cost.world.names == ("post",)  # a box can stand on the floor
    assert not ls.scenarios.mjcf(str(file), start={"z": 1.0}, obstacles=False).problem.obstacle_costs


SLIDER = sled(
    "xz", geom='type="box" size="0.1 0.1 0.1"', things='<geom name="post" type="cylinder" size="0.1 1" pos="2 0 1"/>'
)


@pytest.mark.parametrize("margin", [0.0, 0.02, 0.3])
def test_a_clearance_is_the_same_in_python_in_a_setting_and_as_an_option(tmp_path: Path, margin: float) -> None:
    file = tmp_path / "slider.xml"
    file.write_text(SLIDER, encoding="utf-8")
    robot = ls.MjcfRobot(file)
    start, goal = robot.at(z=1.0), robot.at(x=3.0, z=1.0)
    problem = robot.problem(start, goal, steps=5, clearance=margin)
    by_hand = ls.Clearance(robot.scene.world, geoms=robot.geoms, margin=margin)
    plain = robot.problem(start, goal, steps=5)
    assert problem.digest == replace(plain, constraints=[by_hand]).digest != plain.digest
    setting = f"{file},start={{'z': 1.0}},goal={{'x': 3.0, 'z': 1.0}},steps=5"
    assert resolve(f"{setting},clearance={margin}").problem.digest == problem.digest
    main(["solve", setting, "--clearance", str(margin), "--max-iterations", "1", "--out", str(tmp_path)])
    assert ls.load(tmp_path / "solution.npz", ls.Solution).problem_digest == problem.digest
    with pytest.raises(InputError, match="clearance: got 'near', want a finite number"):
        robot.problem(start, goal, clearance="near")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("settings", "told"),
    [("", True), (",steps=20", True), (",start=tilted,goal=tilted", True), (",start=tilted", False),
     (",goal={'pole': 0.1}", False)],
)  # fmt: skip
def test_a_goal_that_is_the_start_is_said(
    cart: Path, settings: str, told: bool, caplog: pytest.LogCaptureFixture
) -> None:
    resolve(f"{cart}{settings}")
    said = [one.message for one in caplog.records if "start and goal are the same" in one.message]
    assert len(said) == told
    assert all("goal={'slider': 0.1}" in one for one in said)


def test_numbers_of_the_mjcf_are_by_name(cart: Path) -> None:
    scenario = resolve(f"{cart},parameters={{'cart_mass': 2.5, 'pole_damping': 0.03}},steps=20")
    plain = resolve(f"{cart},steps=20")
    np.testing.assert_allclose(scenario.plant().model.body("cart").mass, [2.5], rtol=1e-15)
    assert scenario.problem.digest != plain.problem.digest
    for wrong, message in ((0.6, "parameters: got 0.6, want numbers by name"), ({"weight": 1.0}, "want one of: mass")):
        with pytest.raises(InputError, match=message):
            ls.scenarios.mjcf(str(cart), parameters=wrong)  # pyright: ignore[reportArgumentType]


def test_the_path_is_found_from_any_folder(cart: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(cart.parent)
    assert from_anywhere("cart.xml,steps=5") == f"{cart},steps=5"


@pytest.mark.parametrize("settings", ["", ",start={'slide_x': 1.0}", ",a=1,b={'c': (1, 2)}", ",place=C:/x.py:f"])
@pytest.mark.parametrize(
    ("target", "code"),
    [
        ("robot.xml", False), (r"C:\robots\arm.xml", False), ("quadrotor", False), ("a/B.XML", False),
        ("robots.py:arm", True), (r"C:\robots\mine.py:arm", True), ("my_package.robots:hallway", True),
    ],
)  # fmt: skip
def test_what_names_code(target: str, code: bool, settings: str) -> None:
    """A colon in a setting or a drive's letter does not."""
    assert names_code(target + settings) == code
    if code:
        with pytest.raises(InputError, match="needs your code in"):
            resolve(target + settings, registered_only=True)


def test_an_mjcf_is_certified_and_stressed_without_naming_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By a relative path with settings that have colons, found from any folder."""
    (tmp_path / "slider.xml").write_text(SLIDER, encoding="utf-8")
    reference = "slider.xml,start={'z': 1.0},goal={'x': 0.5, 'z': 1.0},steps=5"
    monkeypatch.chdir(tmp_path)
    problem = ls.stress.ReliabilityProblem(reference, failure="miss", sweep="light", goal_radius=1e-3)
    assert problem.scenario == ls.stress.Campaign(scenario=reference, sweeps={"none": ()}).scenario
    assert problem.scenario == f"{tmp_path / 'slider.xml'}{reference[len('slider.xml') :]}"
    rare = problem.rare_failures(particles=20, repetitions=2, keep=0.0)
    ls.save(rare.certificate(), tmp_path / "certificate.npz")
    capsys.readouterr()
    few = ["--strengths", "1", "--trials", "2", "--policies", "smooth", "--workers", "0", "--out", "run"]
    assert main(["stress", reference, *few]) == 0
    report = capsys.readouterr().out.splitlines()[-1].split()
    monkeypatch.chdir("/")
    assert main(["certify", str(tmp_path / "certificate.npz")]) == 0
    assert "as certified, to the last bit" in capsys.readouterr().out
    results = ls.stress.Results(tmp_path / "run")
    assert "--scenario" not in (*report, *results.command_of("report").split())
    assert results.campaign.resolved.problem.digest == problem.resolved.problem.digest


def test_solve_and_simulate_on_the_command_line(
    cart: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also by a reference of thousands of characters, as one of a robot with many states is."""
    monkeypatch.chdir(cart.parent)
    start, goal, weights = "{'pole': 2.9}", f"{{'pole': 3.14159{'0' * 5000}}}", "{'m': 1e4, 'rad': 1e3}"
    assert main(["solve", f"{cart.name},start={start},goal={goal},weights={weights},steps=40"]) == 0
    assert main(["simulate", "runs/cart/solution.npz"]) == 0
    assert "1 of 1 trials reached the goal" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("start={'hinge': 1}", "state: got 'hinge', want one of: slider, pole"),
        ("start=upright", "keyframe: got 'upright', want one of: tilted"),
        ("start=3", "start: got 3, want a keyframe's name, or states by name"),
        ("start={1: 2}", "start: got {1: 2}, want states by name"),
        ("start={'keyframe': 3}", "start: keyframe: got 3, want its name"),
        ("start={'slider': -0.08 mm}", "start: got \"{'slider': -0.08 mm}\", want {'x': 1.0}, numbers without units"),
        ("goal={'slider': 1cm,'pole': 3}", "numbers without units: slider in m, pole in rad"),
        ("weights={'kg': 1}", "weights: got 'kg', want one of"),
        ("effort=0", "effort: got 0"),
        ("dt=0.003", "dt: got 0.003 s, want a multiple of the physics step"),
        ("speed=3", "got 'speed', want one of: start, goal, weights"),
    ],
)
def test_what_does_not_fit_is_named(cart: Path, settings: str, message: str) -> None:
    with pytest.raises(InputError) as refused:
        resolve(f"{cart},{settings}")
    assert message in str(refused.value)
