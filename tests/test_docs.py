"""The pages in docs/ are programs: what they build outside the package plugs in, unchanged."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from linear_plans import double_integrator, law_of

import lqrsim as ls
from lqrsim import robots
from lqrsim.cli import main
from lqrsim.commands import COMMANDS
from lqrsim.simulation.disturbances import KINDS, PRESETS
from lqrsim.view import gl

DOCS = Path(__file__).parent.parent / "docs"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def run_page(name: str, **shorter: str) -> dict[str, Any]:
    """Run the Python blocks of a page, in order, in one namespace, with some arguments of calls changed, by name.

    Tracebacks have the page's line numbers.
    """
    page = DOCS / name
    text = page.read_text(encoding="utf-8")
    for argument, new in shorter.items():
        text, count = re.subn(rf"\b{argument}=[\w.]+", f"{argument}={new}", text)
        assert count
    namespace: dict[str, Any] = {"__name__": page.stem}
    for block in BLOCK.finditer(text):
        line = text.count("\n", 0, block.start(1))
        exec(compile("\n" * line + block.group(1), str(page), "exec"), namespace)
    return namespace


def blocks_for_an_extra(name: str, part: str = "") -> list[str]:
    """The blocks of a page that `run_page` leaves out, with this text in them."""
    page = (DOCS / name).read_text(encoding="utf-8")
    return [block for block in re.findall(r"^```py\n(.*?)^```$", page, re.MULTILINE | re.DOTALL) if part in block]


def test_getting_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page("getting_started.md")
    packaged = ls.scenarios.differential_drive().problem
    assert names["problem"].digest == packaged.digest  # the page says that the scenario has this problem
    assert names["rollout"].outcome == ("reached",) * 5
    assert names["control"].shape == (2,)


@pytest.mark.long
def test_a_robot_from_an_mjcf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page("mjcf_robots.md")
    solution, kept = names["solution"], names["kept"]
    assert solution.success
    assert names["rollout"].outcome == ("reached",)
    # The pole stands at the end, and the plan is what MuJoCo did.
    assert np.abs(solution.trajectory.states[-1]).max() < 0.05
    assert names["rollout"].tracking_error.max() < 1e-6
    assert kept.constraints[0].bounds == {"slider": (-3.0, 3.0)}


def test_a_robot_from_a_urdf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page("urdf_robots.md")
    assert names["solution"].success
    assert names["rollout"].outcome == ("reached",)
    assert names["rollout"].tracking_error.max() < 1e-6  # the plan is what MuJoCo did
    assert names["robot"].joint_limits.bounds["elbow_velocity"] == (-3.0, 3.0)
    assert [one.forces for one in names["servoed"].mjcf.actuators] == [(-30.0, 30.0), (-10.0, 10.0)]
    assert names["cell"].scene.world.names == ("post",)


def test_fitting_to_data_as_on_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tabulate", reason="needs the `sysid` extra")
    monkeypatch.chdir(tmp_path)
    names = run_page("mjcf_robots.md", max_iterations="1")  # of a hop, of which the page prints how far it has come
    (block,) = blocks_for_an_extra("mjcf_robots.md", "sysid")
    exec(compile(block, "mjcf_robots.md", "exec"), names)
    fitted = {name: one.value[0] for name, one in names["fitted"].items()}
    # The plant has 1.5 kg in place of 1.2, in cart and pole alike.
    assert fitted == pytest.approx({"cart_mass": 1.25, "pole_mass": 0.25, "slider_damping": 0.1}, rel=0.1)
    assert ls.simulate(names["plant"], names["again"]).outcome == ("reached",)


def test_a_robot_scene_cost_and_disturbance_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page("adding_a_robot.md")
    solution, rollout, windy = (names[name] for name in ("solution", "rollout", "windy"))
    assert isinstance(solution, ls.Solution)
    assert solution.status is ls.Status.CONVERGED
    assert isinstance(rollout, ls.Rollout)
    assert isinstance(windy, ls.Rollout)
    # The puck is linear and MuJoCo integrates with the same RK4: rounding is all that is left.
    assert rollout.tracking_error.max() < 1e-12
    assert rollout.clearance.min() > 0.1
    assert rollout.outcome == ("reached",)
    # The wind blows east, only east of the middle, as much as it says.
    expected = 0.2 * np.maximum(windy.states[:, :-1, 0], 0)
    np.testing.assert_allclose(windy.forces[..., 0], expected, rtol=0, atol=1e-15)
    assert windy.tracking_error.max() > 0.01
    # Told of the wind, it keeps nearer to the plan in the same gusts.
    assert {one.name for one in names["stated"].unknowns} == {"wind_x", "wind_y"}
    assert "wind_z" in names["stated"].left_out[0]
    loose = ls.simulate(names["plant"], solution, disturbances=names["gusts"], trials=3)
    assert (names["held"].tracking_error.max(axis=1) < loose.tracking_error.max(axis=1)).all()
    # Its own cost acts: the plan keeps the speed limit better than one without it.
    speeds = np.linalg.norm(solution.trajectory.states[:, 2:], axis=1)
    assert speeds.max() < 1.05
    assert "puck" not in robots.names()
    assert names["robot"].dynamics is names["robot"].dynamics  # made once

    page = (DOCS / "adding_a_robot.md").read_text(encoding="utf-8")
    (tmp_path / "rink.py").write_text("\n".join(BLOCK.findall(page)), encoding="utf-8")
    assert main(["solve", "rink.py:rink"]) == 0
    assert main(["simulate", "runs/rink/solution.npz", "--scenario", "rink.py:rink"]) == 0
    assert "puck in rink, undisturbed" in capsys.readouterr().out
    if not gl.missing():
        assert ls.render(rollout, tmp_path / "rink.mp4", size=(320, 240), fps=5).stat().st_size > 1000


def test_environments_of_gymnasium(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The blocks hold what they assert, and print what they say."""
    pytest.importorskip("minari", reason="needs the `minari` extra")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    names = run_page("gymnasium.md")
    single, many = capsys.readouterr().out.split("\n", 1)
    assert single == "reached"
    assert many.endswith("16 (151, 4) (150, 2)\n")
    assert many.count("reached") == len(names["ended"]) == 16


def test_wheels_as_on_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's numbers, to a quarter: wheels that slip amplify rounding."""
    monkeypatch.chdir(tmp_path)
    page = (DOCS / "wheels_and_servos.md").read_text(encoding="utf-8")
    told = re.findall(r"^\| ([^|]+) \| (\d+) (c?m) \|$", page, re.MULTILINE)
    errors = run_page("wheels_and_servos.md")["errors"]
    assert [name for name, *_ in told] == list(errors)
    for name, number, unit in told:
        assert errors[name] == pytest.approx(float(number) * (1 if unit == "cm" else 100), rel=0.25)


@pytest.mark.long
def test_the_gear_that_the_plan_chooses_is_that_of_the_formula() -> None:
    names = run_page("gradients.md")
    assert names["best"].x[0] == pytest.approx(20.0, rel=1e-4)  # BFGS stops at slopes of 1e-5
    assert names["predicted"] == pytest.approx(names["again"].trajectory.controls, abs=1e-7)
    pytest.importorskip("jax", reason="needs the `jax` extra")
    (block,) = blocks_for_an_extra("gradients.md", "import jax")
    exec(compile(block, "gradients.md", "exec"), names)
    # JAX computes in single precision here, and the optimum is off by 1e-8 of itself.
    above, below = (float(names["cost_and_gradient"]([(180 + h) / 12, 1.5])[0]) for h in (0.1, -0.1))
    assert float(names["teeth"]) == pytest.approx((above - below) / 0.2, rel=1e-4)


@pytest.mark.long
def test_least_time_is_that_of_the_formula() -> None:
    names = run_page("least_time.md")
    assert names["fast"].trajectory.horizon == pytest.approx(2 * np.sqrt(2), rel=1e-4)
    assert names["quick"].success


def test_what_does_not_converge_and_what_helps(capsys: pytest.CaptureFixture[str]) -> None:
    """0.56 m of 2 m can be gone in 1.5 s: ahead for one half, back for the other, in steps of 0.1 s."""
    names = run_page("not_converging.md")
    assert names["failed"].remedy in capsys.readouterr().out
    assert names["priced"].violation == pytest.approx(2 - 0.56, abs=1e-3)


def test_an_arm_goes_round_a_post(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page("arms.md")
    assert names["plan"].success
    assert names["careful"].clearance.min() >= 0.1 - 1e-3
    assert names["run"].outcome == ("reached",) * 5


@pytest.mark.long
def test_one_system_at_every_level(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page("stating_a_system.md")
    # A plan that depends on time runs in MuJoCo: its clock is exact, and the mass follows the sine as is planned.
    followed = names["followed"]
    assert followed.outcome == ("reached",) * 3
    np.testing.assert_allclose(followed.states[:, :, 2], np.tile(followed.times, (3, 1)), rtol=0, atol=1e-12)
    assert np.abs(followed.states[:, :, 0] - np.sin(followed.times)).max() < 0.03
    found = ls.check_plant(names["plant"].robot, names["plant"].scene, controls=([-2.0], [2.0]))
    assert found.good
    by_joint = ls.MjcfRobot("rail.xml")
    after = by_joint.dynamics.step(by_joint.at(place_velocity=0.3, clock_velocity=1.0), [2.0], 0.5)
    np.testing.assert_allclose(after, [0.4, 0.5, 1.3, 1.0], rtol=0, atol=1e-12)
    assert names["solution"].status is names["same"].status is ls.Status.CONVERGED
    # The compiled statement has central differences: eight digits of a derivative, twice that of a minimum.
    assert names["same"].cost == pytest.approx(names["solution"].cost, rel=1e-7)
    assert names["rough_solution"].cost > names["solution"].cost
    carried = names["carried"]
    states, force = carried.trajectory.states, carried.trajectory.controls[:, 0]
    assert carried.status is ls.Status.CONVERGED
    np.testing.assert_allclose(states[-1], [0.8, 0, 0, 0], rtol=0, atol=1e-6)
    # All three act: to within the tolerance that is left to spare they are as large as they may be.
    for largest, most in (
        (np.abs(states[:, 1]).max(), 0.08), (states[:, 2].max(), 0.42), ((force * states[:-1, 2]).max(), 0.08)
    ):  # fmt: skip
        assert most - 2e-3 < largest <= most
    assert all(check.good for check in ls.check_derivatives(names["pendulum"]))
    assert all(found.status is ls.Status.CONVERGED for found in names["solutions"])
    pytest.importorskip("jax", reason="needs the `jax` extra")
    (block,) = blocks_for_an_extra("stating_a_system.md", 'level="jax"')
    exec(compile(block, "stating_a_system.md", "exec"), names)
    assert names["learned_solution"].status is ls.Status.CONVERGED
    learned, crane = names["learned"], names["symbolic"]
    x = np.array([0.1, 0.2, 0.5, -0.3])
    drag = names["outer"] @ np.tanh(names["inner"] @ x[2:])
    np.testing.assert_allclose(learned.rate(x, [1.0]), crane.rate(x, [1.0 - drag]), rtol=1e-13)


def test_a_policy_is_loaded_with_numpy_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drive_solution: ls.Solution
) -> None:
    monkeypatch.chdir(tmp_path)
    ls.save(drive_solution, "solution.npz")
    ls.save(law_of(double_integrator(limits=(-1.0, 1.0))).policy, "policy.npz")
    control = run_page("file_format.md")["control"]
    for t in (0.0, 3.3, 24.99, 30.0):
        state = drive_solution.trajectory.states[min(int(6 * t), 149)] + [0.02, -0.01, 6 * np.pi + 0.1]
        np.testing.assert_allclose(control(state, t), drive_solution.policy(state, t), rtol=0, atol=1e-12)


@pytest.mark.long
def test_forms_starts_and_endings() -> None:
    names = run_page("solving.md")
    np.testing.assert_allclose(names["least"], names["solution"].cost, rtol=1e-3)
    assert "pass of iteration" in names["safe"].detail
    assert names["control"].shape == (2,)


@pytest.mark.long
def test_robust_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page("robust_policies.md")
    tubes, run = names["tubes"], names["run"]
    assert tubes["offset_free"].collision_chance < tubes["track"].collision_chance < tubes["smooth"].collision_chance
    assert names["shown"].tube.shape == (names["problem"].steps + 1, 3, 3)
    # The recursion of the file gives what the filter gave in the simulation, shown the same.
    np.testing.assert_allclose(names["control"], run.commanded[0, 0], rtol=0, atol=1e-9)
    with pytest.raises(ls.InputError, match=r"wind_z.*wind_x"):
        ls.disturbances.Uncertainty(unknowns=[ls.disturbances.Unknown("wind_z", std=1.0)]).check(names["mass"])


def presets() -> str:
    """The table of docs/stress_testing.md."""
    plants = {name: ls.scenarios.get(name).plant() for name in ls.scenarios.names()}
    words = {name: {type(one).__name__: one.describe(plant) for one in ls.disturbances.preset("light", plant)}
             for name, plant in plants.items()}  # fmt: skip
    kinds = dict.fromkeys(kind for of_plant in words.values() for kind in of_plant)
    lines = [
        f"| `light` has | {' | '.join(plants)} |",
        "|---" * (1 + len(plants)) + "|",
        *(f"| `{kind}` | {' | '.join(words[name].get(kind, 'none') for name in plants)} |" for kind in kinds),
        "",
        ", ".join(f"`{name}` is {factor:g} times `light`" for name, factor in PRESETS.items() if factor != 1) + ".",
    ]
    return "\n".join(lines)


@pytest.mark.long
def test_stress_testing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = (DOCS / "stress_testing.md").read_text(encoding="utf-8")
    assert presets() in page
    names = run_page("stress_testing.md")
    assert names["results"].complete
    assert names["rare"].probability.value > 0
    assert set(KINDS) <= set(re.findall(r"`(\w+)`", page.split("## Presets")[0]))
    small = ["--trials", "4", "--strengths", "1", "--policies", "smooth", "--workers", "0"]
    assert main(["stress", "draught.py:draughty", "--sweep", "scenario", *small]) == 0
    assert ls.stress.Results("runs/stress/draughty").cells == [ls.stress.Cell("smooth", "scenario", 1.0)]


def test_every_field_of_an_effect_has_its_row_in_their_order() -> None:
    page = (DOCS / "stress_testing.md").read_text(encoding="utf-8")
    table = page.split("returns an `Effect`")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    assert rows == [field.name for field in dataclasses.fields(ls.disturbances.Effect)]


def test_commands_of_pages_exist() -> None:
    for page in DOCS.glob("*.md"):
        assert set(re.findall(r"^`*lqrsim (\w+)", page.read_text(encoding="utf-8"), re.MULTILINE)) <= COMMANDS.keys(), (
            page
        )


def test_replanning_in_simulations_and_on_a_robot() -> None:
    names = run_page("replanning.md")
    assert names["replan"].trajectory.steps == 150
    assert names["rollout"].controller_run.log.solved > 40
    assert names["windy"].problem.dynamics.parameters["wind_x"] == 2.0


@pytest.mark.long
def test_funnels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page("funnels.md")
    assert (names["funnel"].levels > 0).all()
    assert (names["places"].levels > 0).all()
    assert 0 < len(names["run"].controller_run.log.records) < 9
    assert names["chosen"].reached.value > 0.5
    assert Path("funnel.png").stat().st_size > 0
    (block,) = re.findall(r"^```py\n(.*?)^```$", (DOCS / "funnels.md").read_text("utf-8"), re.MULTILINE | re.DOTALL)
    if not gl.missing():
        exec(compile(block, "funnels.md", "exec"), names)
        assert Path("run.png").stat().st_size > 0


@pytest.mark.long
def test_noise_in_the_plan() -> None:
    names = run_page("noise.md")
    problem, solution, costs = names["problem"], names["solution"], names["costs"]
    assert solution.status is ls.Status.CONVERGED
    assert solution.cost == pytest.approx(costs.mean(), rel=0.03)
    assert names["extra"].mean() > 2 * names["extra"].std() / len(costs) ** 0.5
    assert problem.digest != names["scenario"].problem.digest
    assert names["spreads"][1] < names["spreads"][0]
    assert "is too high at step" in names["beyond"].detail
    # Noise that is always the same changes the expectation and nothing else.
    np.testing.assert_allclose(names["calm"].trajectory.states, names["plain"].trajectory.states, atol=1e-3)
    assert names["calm"].cost > names["plain"].cost


def test_a_filter_becomes_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run_page("microcontrollers.md")
    assert main(["export", "policy.npz", "--c", "firmware/filter"]) == 0
    assert "#define POLICY_MEASURED 12\n" in (tmp_path / "firmware" / "filter" / "policy.h").read_text(encoding="utf-8")


@pytest.mark.long
def test_beliefs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page("belief_space.md")  # which has assertions of its own
    assert names["solution"].success
    assert names["plan"].success
