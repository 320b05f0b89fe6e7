"""Policies that are made for stated disturbances, by name: in campaigns, searches for failures, and commands."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from refusing import error_line
from sampling import is_short

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.commands.options import ControllerName
from lqrsim.commands.stressing import CampaignPolicyName, PolicyName
from lqrsim.disturbances import AxleMismatch, ControlNoise, MeasurementNoise, MotorLag
from lqrsim.errors import InputError
from lqrsim.reports import COLOURS, LINES, MARKERS
from lqrsim.stress.campaign import _code
from lqrsim.stress.results import read_manifest
from lqrsim.stress.study import (
    CAMPAIGN_POLICIES,
    CONTROLLERS,
    DEFAULT_POLICIES,
    DESIGNED,
    POLICIES,
    POLICY_KINDS,
    make_controller,
    solve_policies,
)

LIGHT = (
    ControlNoise(0.02),
    MeasurementNoise(0.01),
    AxleMismatch(0.01),
    MotorLag(0.05),
)
CAMPAIGN = ls.stress.Campaign(
    scenario="differential_drive",
    sweeps={"own": LIGHT},
    strengths=(2.0,),
    policies=POLICIES,
    replan_every=12.0,
    trials=2,
    shard=1,
    design_disturbances=LIGHT,
)


def shards(results: ls.stress.Results) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((results.folder / "shards").iterdir())}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> ls.stress.Results:
    return ls.stress.run_campaign(CAMPAIGN, tmp_path_factory.mktemp("design_disturbances") / "here", workers=0)


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory, differential_drive: ls.Scenario, drive_solution: ls.Solution):
    path = tmp_path_factory.mktemp("solved") / "solution.npz"
    return ls.save(replace(drive_solution, scenario="differential_drive"), path)


# Campaigns.


@pytest.mark.parametrize(("workers", "batch"), [pytest.param(1, 3, marks=pytest.mark.long), (2, 1)])
@pytest.mark.long
def test_all_six_have_the_same_bits_in_other_processes_and_in_any_batch(
    results: ls.stress.Results, tmp_path: Path, workers: int, batch: int
) -> None:
    again = ls.stress.run_campaign(CAMPAIGN, tmp_path, workers=workers, batch=batch)
    assert len(shards(again)) == 12
    assert shards(again) == shards(results)


@pytest.mark.long
def test_trials_are_those_of_the_controllers_as_users_make_them(
    results: ls.stress.Results, differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    plant, problem = differential_drive.plant(), differential_drive.problem
    stated, wrong = ls.uncertainty_of(plant, LIGHT), [one.scaled(2.0) for one in LIGHT]
    plan = replace(drive_solution, goal_radius=differential_drive.target_radius())
    made = {
        "track": ls.track(problem, plan, uncertainty=stated),
        "offset_free": ls.OffsetFree(problem, plan, stated),
    }
    for policy, law in made.items():
        rollout = ls.simulate(plant, plan, controller=law, disturbances=wrong, trials=2, contacts=False, frames=False)
        rows, own = results.outcomes(ls.stress.Cell(policy, "own", 2.0)), ls.stress.outcomes(rollout, problem)
        np.testing.assert_array_equal(rows.rms, own.rms)
        np.testing.assert_array_equal(rows.clearance, own.clearance)
        np.testing.assert_array_equal(rows.outcome, own.outcome)
    assert results.solution("track").policy.digest == made["track"].digest
    again = ls.stress.replay(results, ls.stress.Cell("offset_free", "own", 2.0), 1)
    wanted = ls.simulate(plant, plan, controller=made["offset_free"], disturbances=wrong, first_trial=1)
    np.testing.assert_array_equal(again.states, wanted.states)


def test_what_is_stated_is_written_down_and_part_of_the_digest(tmp_path: Path) -> None:
    assert ls.stress.Campaign.from_json(CAMPAIGN.as_json(), ls.scenarios.quadrotor()) == CAMPAIGN
    small = replace(CAMPAIGN, policies=("track",), strengths=(1.0,), trials=1)
    manifests = []
    for number, stated in enumerate((None, (ControlNoise(0.1), MeasurementNoise(0.01)), LIGHT)):
        ls.stress.run_campaign(replace(small, design_disturbances=stated), tmp_path / str(number), workers=0)
        manifests.append(read_manifest(tmp_path / str(number)))
    assert len({manifest.digest for manifest in manifests}) == 3
    with pytest.raises(InputError, match=r"^design_disturbances: got .*want .* or another folder"):
        ls.stress.run_campaign(replace(small, design_disturbances=LIGHT), tmp_path / "1", workers=0)
    assert manifests[-1].campaign["design_disturbances"][2] == {
        "kind": "AxleMismatch",
        "settings": {"std": 0.01, "factor": None},
    }


def test_by_default_the_preset_in_the_middle_is_stated(
    differential_drive: ls.Scenario, drive_solution: ls.Solution
) -> None:
    moderate = ls.disturbances.preset("moderate", differential_drive.plant())
    for policy in DESIGNED:
        digests = []
        for stated in (None, moderate):
            solution = solve_policies((policy,), differential_drive, stated)[policy]
            name = POLICY_KINDS[policy].controller
            digests.append(make_controller(name, differential_drive, solution, design=stated).digest)
        assert digests[0] == digests[1]


@dataclass(frozen=True)
class Own(ControlNoise):
    """One of a user's own."""


def test_the_file_of_a_stated_disturbance_of_ones_own_is_hashed_too() -> None:
    assert list(_code(replace(CAMPAIGN, design_disturbances=(Own(0.1),)))) == ["Own"]


def test_a_design_is_made_for_what_the_summary_says(differential_drive: ls.Scenario, tmp_path: Path) -> None:
    """Laws that are made by hand for the same disturbances run the same trials, bit for bit."""
    campaign = replace(
        CAMPAIGN,
        policies=("track", "track_per_cell"),
        strengths=(4.0,) if is_short() else (0.0, 4.0),
        trials=2,
        design_disturbances=None,
    )
    results = ls.stress.run_campaign(campaign, tmp_path / "here", workers=0)
    plant, solution = differential_drive.plant(), results.solution("track_per_cell")
    assert solution.policy.digest != results.solution("track").policy.digest
    designs = {"track": lambda cell: ls.disturbances.preset("moderate", plant), "track_per_cell": campaign.disturbances}
    for cell in results.cells:
        uncertainty = ls.uncertainty_of(plant, designs[cell.policy](cell))
        law = ls.track(differential_drive.problem, solution, uncertainty=uncertainty)
        met = campaign.disturbances(cell)
        run = ls.simulate(plant, solution, controller=law, disturbances=met, trials=2, contacts=False)
        again = ls.stress.replay(results, cell, 1, contacts=False)
        np.testing.assert_array_equal(run.states[1], again.states[0])
        assert run.policy_digest == again.policy_digest
    for said in (results.summary(), results.rates().markdown(), results._repr_html_()):
        assert "track: designed for the preset moderate, whatever the disturbances of a cell" in said
        assert "track_per_cell: designed anew for the disturbances of each cell" in said
    assert ls.stress.Results(tmp_path / "here").designs() == results.designs()
    named = replace(campaign, design_disturbances=LIGHT)
    results.manifest = replace(results.manifest, campaign=named.as_json())
    assert results.designs()["track"].startswith("designed for ControlNoise(std=0.02), MeasurementNoise(std=0.01), ")


def test_a_cell_that_no_law_can_be_designed_for_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    campaign = replace(
        CAMPAIGN, policies=("track_per_cell",), sweeps={"wind": (ls.disturbances.Gusts(),)}, design_disturbances=None
    )
    with pytest.raises(InputError, match="differential_drive, which wind cannot push"):
        ls.stress.run_campaign(campaign, tmp_path / "here", workers=0)
    assert not (tmp_path / "here").exists()


def test_the_usual_four_are_run_unless_others_are_asked_for() -> None:
    assert ls.stress.Campaign(scenario="quadrotor", sweeps={"own": LIGHT}).policies == DEFAULT_POLICIES == POLICIES[:4]
    assert len({*COLOURS}) == len({*LINES}) == len({*MARKERS}) == len(CAMPAIGN_POLICIES)
    assert get_args(PolicyName) == POLICIES
    assert get_args(CampaignPolicyName) == CAMPAIGN_POLICIES
    assert get_args(ControllerName) == CONTROLLERS
    assert {kind.controller for kind in POLICY_KINDS.values()} <= {*CONTROLLERS}


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"design_disturbances": ()}, "^design_disturbances: got none, want at least one disturbance"),
        ({"design_disturbances": "light"}, "^design_disturbances: got 'light', want a tuple of disturbances"),
        (
            {"policies": ("smooth", "replan")},
            "^design_disturbances: got them with smooth, replan, want track or offset_free",
        ),
        ({"policies": ("tracking",)}, r"^policies\[0\]: got 'tracking', want .*track"),
    ],
)
def test_campaigns_that_make_no_sense_are_refused(changes: dict[str, object], line: str) -> None:
    with pytest.raises(InputError, match=line):
        replace(CAMPAIGN, **changes)  # pyright: ignore[reportArgumentType]


def test_what_the_robot_cannot_have_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"^design_disturbances: Gusts: got robot differential_drive, which wind cannot push"
    ):
        ls.stress.run_campaign(
            replace(CAMPAIGN, design_disturbances=(ls.disturbances.Gusts(),)), tmp_path / "new", workers=0
        )
    assert not (tmp_path / "new").exists()


# Searches for failures.


@pytest.mark.parametrize("policy", DESIGNED)
def test_rare_and_break_run_them(policy: str, differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
    problem = ls.stress.ReliabilityProblem(
        "differential_drive", sweep="light", policy=policy, design_disturbances="severe"
    )
    severe = ls.uncertainty_of(differential_drive.plant(), ls.disturbances.preset("severe", differential_drive.plant()))
    plan = replace(drive_solution, goal_radius=differential_drive.target_radius())
    law = (
        ls.track(differential_drive.problem, plan, uncertainty=severe)
        if policy == "track"
        else ls.OffsetFree(differential_drive.problem, plan, severe)
    )
    assert isinstance(problem.score.controller, (ls.AffinePolicy, ls.OffsetFree))
    assert problem.score.controller.digest == law.digest
    numbers = np.random.default_rng(0).standard_normal((2, problem.score.size))
    rollout = problem.score.rollout(numbers, frames=False)
    assert rollout.policy_digest == law.digest
    assert (problem.score(numbers) < 0).all()  # they do not collide


# The command line.


@pytest.mark.parametrize("name", CONTROLLERS)
def test_simulate_runs_a_controller_by_its_name(
    name: str, solved: Path, tmp_path: Path, differential_drive: ls.Scenario
) -> None:
    told = ["--design-disturbances", "light"] if name in DESIGNED else []
    options = ["--disturbances", "light", "--trials", "1", "--out", str(tmp_path), "--controller", name, *told]
    assert main(["simulate", str(solved), *options]) == 0
    solution, plant = ls.load(solved, ls.Solution), differential_drive.plant()
    light = ls.disturbances.preset("light", plant)
    stated, problem = ls.uncertainty_of(plant, light), differential_drive.problem
    law = {
        "feedback": lambda: solution.policy,
        "track": lambda: ls.track(problem, solution, uncertainty=stated),
        "offset_free": lambda: ls.OffsetFree(problem, solution, stated),
        "replan": lambda: ls.Replanner(problem, solution, every=problem.steps * problem.dt / 10, deadline=0.0),
    }[name]()
    wanted = ls.simulate(plant, solution, controller=law, disturbances=light)
    found = ls.load(tmp_path / "rollout.npz", ls.Rollout)
    np.testing.assert_array_equal(found.states, wanted.states)
    assert found.policy_digest == law.digest


@pytest.mark.parametrize(("told", "said"), [([], True), (["--design-disturbances", "calm"], False)])
def test_a_law_that_was_designed_for_the_default_says_so(
    told: list[str], said: bool, solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A law for moderate disturbances may lose what one for those of the run would not."""
    assert main(["simulate", str(solved), "--out", str(tmp_path), "--controller", "track", *told]) == 0
    line = "track was designed for moderate; for others: --design-disturbances NAME"
    assert (line in capsys.readouterr().out) == said


def test_a_plan_with_a_clearance_is_tracked_but_not_planned_again_without_it(
    differential_drive: ls.Scenario,
) -> None:
    clear = ls.Clearance(differential_drive.scene.world, radius=differential_drive.robot.radius, margin=0.05)
    solution = ls.smooth(replace(differential_drive.problem, constraints=[clear]))
    assert make_controller("track", differential_drive, solution).digest
    with pytest.raises(InputError, match=r"^controller: got replan for a solution of another problem"):
        make_controller("replan", differential_drive, solution)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ("--controller track --open-loop", "--open-loop: got --controller track as well, want one of the two"),
        ("--design-disturbances light", "design_disturbances: got them with feedback, want track or offset_free"),
        ("--controller track --design-disturbances gale", "disturbances: got 'gale', want one of: scenario, calm"),
    ],
)
def test_commands_that_make_no_sense_are_refused(
    options: str, line: str, solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", str(solved), "--out", str(tmp_path), *options.split()]) == 2
    assert error_line(capsys).startswith(f"lqrsim: error: {line}")


def test_view_takes_a_controller_for_live_runs_only(solved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = str(solved.with_name("rollout.npz"))
    solution = ls.load(solved, ls.Solution)
    ls.save(ls.simulate(ls.scenarios.differential_drive().plant(), solution), run)
    assert main(["view", run, "--controller", "track"]) == 2
    assert "--controller: got track with" in capsys.readouterr().err
    assert main(["view", "differential_drive", "--viewer", "browser", "--design-disturbances", "light"]) == 2
    assert "design_disturbances: got them with feedback, want track or offset_free" in capsys.readouterr().err


def test_stress_takes_the_new_ones_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = "--policies smooth track offset_free --design-disturbances calm --strengths 1 --trials 1 --workers 0"
    assert main(["stress", "differential_drive", *options.split(), "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out.splitlines()
    rows = [line for line in printed if line.startswith("light")]
    assert [line.split()[2] for line in rows] == ["smooth", "track", "offset_free"]
    assert len({len(line) for line in rows}) == 1  # in columns, though a name is longer than others
    plant = ls.scenarios.differential_drive().plant()
    assert ls.stress.Results(tmp_path).campaign.design_disturbances == tuple(ls.disturbances.preset("calm", plant))
