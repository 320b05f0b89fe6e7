"""What a scenario begins with: everything that solves it begins there, and campaigns know it by its hash."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusing import error_line

import lqrsim as ls
import lqrsim.gym
from lqrsim.cli import main
from lqrsim.scenarios import solutions
from lqrsim.scenarios.references import resolve
from lqrsim.solvers import settings
from lqrsim.view import viewer

OWN = """
import dataclasses

import numpy as np

import lqrsim as ls

given = ls.scenarios.differential_drive()


def wall(side: float, bulge: float = 1.2) -> np.ndarray:
    steps = given.problem.steps
    about = np.zeros((steps + 1, 3))
    about[:, 0] = side * bulge * np.sin(np.linspace(0, np.pi, steps + 1))
    about[:, 1] = np.linspace(-2.5, 2.5, steps + 1)
    return about


def along(side: float = -1.0, bulge: float = 1.2) -> ls.Scenario:
    prior = ls.InitialPrior((10, 10, 0), about=wall(side, bulge), obstacles=(0, 0.1, 0.4, 0.7))
    return dataclasses.replace(given, name="along", start=prior)


def short() -> ls.Scenario:
    return dataclasses.replace(given, name="short", problem=dataclasses.replace(given.problem, steps=120))


def by_function(side: float = -1.0) -> ls.Scenario:
    return dataclasses.replace(given, name="by_function", start=lambda problem: along(side).start)
"""
FEW = ["--sweep", "scenario", "--strengths", "1", "--trials", "2", "--workers", "0"]


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("own") / "own.py"
    path.write_text(OWN, encoding="utf-8")
    return path


def keeps_left(plan: ls.Trajectory) -> bool:
    """Past the middle of the arena, where the search's plan is on the other side of two pillars."""
    return bool(plan.states[:, 0].min() < -0.9)


class Opened(Exception):
    """What a viewer was opened with."""


def seen(monkeypatch: pytest.MonkeyPatch, *words: str) -> ls.Trajectory:
    """The plan that `lqrsim view` shows."""

    def opened(kind: str, port: int, *, title: str, **options: Any) -> None:
        raise Opened(options["plan"])

    monkeypatch.setattr(viewer, "open_viewer", opened)
    with pytest.raises(Opened) as caught:
        main(["view", *words])
    return caught.value.args[0]


# Of a scenario.


def test_everything_that_solves_a_scenario_begins_with_its_start(
    own: Path, tmp_path: Path, drive_solution: ls.Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not keeps_left(drive_solution.trajectory)
    for name in ("along", "by_function"):
        reference, out = f"{own}:{name}", str(tmp_path / name)
        assert main(["solve", reference, "--out", out]) == 0
        assert keeps_left(ls.load(f"{out}/solution.npz", ls.Solution).trajectory)
    assert main(["stress", reference, *FEW, "--policies", "open_loop", "track", "--out", f"{out}/stress"]) == 0
    for policy in ("open_loop", "track"):
        assert keeps_left(ls.load(f"{out}/stress/policies/{policy}.npz", ls.Solution).trajectory)
    assert keeps_left(ls.stress.ReliabilityProblem(reference).score.solution.trajectory)
    assert keeps_left(seen(monkeypatch, reference))
    few = ["--rate", "0.5", "--confidence", "0.5", "--knots", "149", "--out", out]
    main(["funnel", reference, *few])
    assert keeps_left(ls.load(f"{out}/funnel.npz", ls.types.Funnel).plan)
    assert keeps_left(lqrsim.gym.Environment(reference).solution.trajectory)
    main(["demo", "--robots", reference, "--no-video", "--out", out])
    assert keeps_left(ls.load(f"{out}/by_function/solution.npz", ls.Solution).trajectory)


def test_the_command_line_can_ask_for_another(own: Path, tmp_path: Path, drive_solution: ls.Solution) -> None:
    for number, words in enumerate((["--starts", "7"], ["--paper-start"])):
        out = str(tmp_path / str(number))
        assert main(["solve", f"{own}:along", *words, "--out", out]) == 0
        assert not keeps_left(ls.load(f"{out}/solution.npz", ls.Solution).trajectory)


def test_ilqr_has_no_prior_and_begins_with_its_controls(own: Path) -> None:
    scenario = resolve(f"{own}:by_function")
    begun = solutions.solve(scenario, "ilqr", max_iterations=3)
    np.testing.assert_array_equal(
        begun.trajectory.states, ls.ilqr(scenario.problem, max_iterations=3).trajectory.states
    )
    turning = np.array([0.2, 0.25])
    controls = dataclasses.replace(scenario, start=turning)
    found = solutions.solve(controls, "ilqr", max_iterations=3)
    wanted = ls.ilqr(scenario.problem, start=turning, max_iterations=3)
    np.testing.assert_array_equal(found.trajectory.states, wanted.trajectory.states)
    assert (found.trajectory.states != begun.trajectory.states).any()
    assert found.goal_radius == scenario.target_radius()


# From a file.


@pytest.fixture(scope="module")
def left(own: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the solution along the left wall, its policy, a run of it, and a funnel."""
    folder, scenario = tmp_path_factory.mktemp("left"), resolve(f"{own}:along")
    solution, plant = solutions.solve(scenario), scenario.plant()
    ls.save(solution, folder / "solution.npz")
    ls.save(solution.policy, folder / "policy.npz")
    ls.save(ls.simulate(plant, solution, seed=0), folder / "rollout.npz")
    options: Any = {"rate": 0.5, "confidence": 0.5, "knots": (149,), "failures": 0}
    ls.save(ls.funnel(plant, solution, **options), folder / "funnel.npz")
    return folder


@pytest.mark.parametrize("name", ["solution", "policy", "rollout", "funnel"])
@pytest.mark.parametrize("solver", ["smooth", "ilqr"])
def test_a_solve_begins_with_what_was_stored(
    name: str, solver: str, left: Path, tmp_path: Path, differential_drive: ls.Scenario
) -> None:
    solution = ls.load(left / "solution.npz", ls.Solution)
    start = {"solution": solution, "policy": solution.policy}.get(name, solution.trajectory)
    words = ["--solver", solver, "--max-iterations", "4", "--start", str(left / f"{name}.npz")]
    main(["solve", "differential_drive", *words, "--out", str(tmp_path)])
    found = ls.load(tmp_path / "solution.npz", ls.Solution)
    call: Any = {"smooth": ls.smooth, "ilqr": ls.ilqr}[solver]
    wanted = call(differential_drive.problem, start=start, max_iterations=4)
    np.testing.assert_array_equal(found.trajectory.states, wanted.trajectory.states)
    assert found.options["start"] == wanted.options["start"]
    if name != "policy" and solver == "smooth":  # which knows nothing of the cost that follows it
        assert found.success
        assert keeps_left(found.trajectory)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("quadrotor --start {left}/solution.npz", ["start: got", "with the states x, y, heading, want x, y, z,"]),
        ("{own}:short --start {left}/solution.npz", ["of 150 steps, want 120, as short has them"]),
        ("{own}:short --start {left}/policy.npz", ["of 150 steps, want 120"]),
        ("{own}:short --start {left}/rollout.npz", ["of 150 steps, want 120"]),
        ("quadrotor --start {left}/funnel.npz", ["states x, y, heading, want"]),
        ("quadrotor --start {left}/nothing.npz", ["nothing.npz"]),
        ("quadrotor --start {own}", ["own.py"]),
        ("quadrotor --start {left}", ["a folder"]),
        ("differential_drive --start {left}/filter.npz", ["start: got", "estimator", "want a solution, a policy of"]),
        ("differential_drive --start {left}/policy.npz --paper-start", ["--start, --paper-start: got 2 of them"]),
        ("differential_drive --start {left}/policy.npz --starts 5", ["--start, --starts: got 2 of them"]),
        ("{own}:along --paper-start --starts 5", ["--paper-start, --starts: got 2 of them"]),
        ("quadrotor --solver ilqr --finish none", ["--finish: got none with --solver ilqr, want it with smooth"]),
    ],
)
def test_what_cannot_be_begun_with_is_one_line(
    words: str, says: list[str], left: Path, own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if "filter" in words:
        scenario, plan = resolve(f"{own}:along"), ls.load(left / "solution.npz", ls.Solution)
        calm = ls.uncertainty_of(scenario.plant(), ls.disturbances.preset("calm", scenario.plant()))
        ls.save(ls.OffsetFree(scenario.problem, plan, calm).policy, left / "filter.npz")
    out = tmp_path / "out"
    assert main(["solve", *words.format(left=left, own=own).split(), "--out", str(out)]) == 2
    error = error_line(capsys)
    assert all(part in error for part in says), error
    assert not out.exists()


# In a campaign.


def test_a_campaign_does_not_go_on_with_another_start(own: Path, tmp_path: Path) -> None:
    copy, folder = tmp_path / "own.py", tmp_path / "out"
    shutil.copy(own, copy)
    campaign = ls.stress.Campaign(
        scenario=f"{copy}:along", sweeps={"light": (ls.disturbances.ControlNoise(0.01),)}, strengths=(1.0,),
        policies=("smooth",), trials=1,
    )  # fmt: skip
    results = ls.stress.run_campaign(campaign, folder, workers=0)
    ls.stress.run_campaign(campaign, folder, workers=0)
    copy.write_text(OWN.replace("bulge: float = 1.2) -> ls", "bulge: float = 1.3) -> ls"), encoding="utf-8")
    with pytest.raises(ls.InputError, match=r"^scenario: got a start other than the one .*out was begun with"):
        ls.stress.run_campaign(campaign, folder, workers=0)
    other = ls.stress.run_campaign(campaign, tmp_path / "other", workers=0).manifest
    assert other.problem == results.manifest.problem
    assert other.digest != results.manifest.digest


def with_part(whole: Any, name: str) -> Any:
    """With one number of it another."""
    part = getattr(whole, name).copy()
    part.flat[5] += 1.0
    return dataclasses.replace(whole, **{name: part})


CHANGES: dict[str, Callable[[ls.Solution], Any]] = {
    "the solution": lambda one: one,
    "a gain": lambda one: dataclasses.replace(one, policy=with_part(one.policy, "gain")),
    "an offset": lambda one: dataclasses.replace(one, policy=with_part(one.policy, "offset")),
    "no cost-to-go": lambda one: dataclasses.replace(one, cost_to_go=None),
    "another cost-to-go": lambda one: dataclasses.replace(one, cost_to_go=with_part(one.cost_to_go, "constant")),
    "its plan": lambda one: one.trajectory,
    "its controls": lambda one: one.trajectory.controls,
    "a control": lambda one: one.trajectory.controls[3],
    "a prior": lambda one: ls.InitialPrior((1.0, 1.0, 0.0), about=one.trajectory.states),
    "another weight": lambda one: ls.InitialPrior((1.0, 1.0, 1.0), about=one.trajectory.states),
    "elsewhere": lambda one: ls.InitialPrior((1.0, 1.0, 0.0), about=one.trajectory.states + 1.0),
    "for longer": lambda one: ls.InitialPrior((1.0, 1.0, 0.0), about=one.trajectory.states, iterations=2),
    "with obstacles": lambda one: ls.InitialPrior((1.0, 1.0, 0.0), about=one.trajectory.states, obstacles=(0.5,)),
    "with controls": lambda one: ls.InitialPrior((1.0, 1.0, 0.0), about=one.trajectory.states, controls=(0.1, 0.1)),
}  # fmt: skip


def test_the_hash_is_of_everything_that_is_begun_with(
    differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    problem = differential_drive.problem
    digests = [settings.resolve(make(drive_solution), problem).digest for make in CHANGES.values()]
    again = [settings.resolve(make(drive_solution), problem).digest for make in CHANGES.values()]
    assert digests == again
    assert len(set(digests)) == len(CHANGES)
    policy = settings.resolve(drive_solution.policy, problem)  # all that is left without the cost-to-go
    assert policy.digest == digests[list(CHANGES).index("no cost-to-go")]
    made = dataclasses.replace(differential_drive, start=lambda problem: drive_solution.trajectory)
    assert solutions.digest_of_start(made) == digests[list(CHANGES).index("its plan")]
    assert solutions.digest_of_start(differential_drive) is None
