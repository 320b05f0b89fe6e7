"""A solution that is given in place of a solve: it is what runs, it stays with what was run, and it has to fit."""

import dataclasses
import hashlib
import json
import logging
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusing import error_line
from sampling import examples, is_short

import lqrsim as ls
import lqrsim.gym
from lqrsim.cli import main
from lqrsim.commands.options import arguments_for
from lqrsim.commands.stressing import Break, Rare
from lqrsim.scenarios.solutions import remarks
from lqrsim.stress.study import solve_policies
from lqrsim.verify import ran_policy_of
from lqrsim.view import viewer

DRIVE, LIGHT = "differential_drive", (ls.disturbances.ControlNoise(0.02), ls.disturbances.MeasurementNoise(0.01))
CAMPAIGN = ls.stress.Campaign(
    scenario=DRIVE, sweeps={"light": LIGHT}, strengths=(1.0,),
    policies=("smooth", "ilqr", "open_loop", "replan", "track", "offset_free"), replan_every=12.0, trials=2, shard=1,
    design_disturbances=LIGHT,
)  # fmt: skip
FEW = ["--sweep", "scenario", "--strengths", "1", "--trials", "2", "--workers", "0"]


@pytest.fixture(scope="module")
def left(differential_drive: ls.Scenario) -> ls.Solution:
    """Another optimum of the scenario's problem than the search finds: along the left wall."""
    problem = differential_drive.problem
    about = np.zeros((problem.steps + 1, 3))
    about[:, 0] = -1.2 * np.sin(np.linspace(0, np.pi, problem.steps + 1))
    about[:, 1] = np.linspace(-2.5, 2.5, problem.steps + 1)
    solution = ls.smooth(problem, start=ls.InitialPrior((10, 10, 0), about=about, obstacles=(0, 0.1, 0.4, 0.7)))
    assert solution.success
    return solution


@pytest.fixture(scope="module")
def stored(left: ls.Solution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ls.save(left, tmp_path_factory.mktemp("left") / "left.npz")


@pytest.fixture(scope="module")
def results(left: ls.Solution, tmp_path_factory: pytest.TempPathFactory) -> ls.stress.Results:
    return ls.stress.run_campaign(
        dataclasses.replace(CAMPAIGN, solution=left), tmp_path_factory.mktemp("given") / "here", workers=0
    )


def test_a_campaign_refuses_a_solution_with_other_limits_or_angles(
    results: ls.stress.Results, left: ls.Solution
) -> None:
    controls, states = left.policy.control_coordinates, left.policy.state_coordinates
    for changed in (
        {"control_coordinates": controls.limited((-0.1, 0.1))},
        {"state_coordinates": dataclasses.replace(states, angles=())},
    ):
        other = dataclasses.replace(left, policy=dataclasses.replace(left.policy, **changed))
        with pytest.raises(ls.InputError, match="solution: got another, want "):
            ls.stress.run_campaign(dataclasses.replace(CAMPAIGN, solution=other), results.folder, workers=0)


def test_replanners_are_told_apart_by_what_changes(left: ls.Solution, differential_drive: ls.Scenario) -> None:
    """Functions that no fingerprint covers."""

    def to(x: float) -> ls.Replanner:
        def changes(t: float, problem: ls.Problem) -> ls.Problem:
            return dataclasses.replace(problem, final_cost=ls.QuadraticCost((1.0, 1.0, 1.0), about=(x, 0.0, 0.0)))

        return ls.Replanner(differential_drive.problem, left, every=1.0, changes=changes)

    assert to(1.0).digest == to(1.0).digest != to(2.0).digest


def test_rollouts_with_earlier_hashes_are_of_their_policy(left: ls.Solution, differential_drive: ls.Scenario) -> None:
    """Such a hash leaves out limits and angles; the rollout has them."""
    policy, run = left.policy, ls.simulate(differential_drive.plant(), left, frames=False)
    numbers = b"".join(part.tobytes() for part in (policy.gain, policy.offset, policy.nominal, np.array(policy.dt)))
    earlier = dataclasses.replace(run, policy_digest=hashlib.sha256(numbers).hexdigest()[:16])
    controls = policy.control_coordinates.limited((-0.1, 0.1))
    limited = dataclasses.replace(left, policy=dataclasses.replace(policy, control_coordinates=controls))
    for rollout in (run, earlier):
        assert ran_policy_of(left, rollout)
        assert not ran_policy_of(limited, rollout)


def shards(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "shards").iterdir())}


# What runs.


def test_the_trials_of_a_campaign_are_those_of_the_given_solution(
    results: ls.stress.Results, left: ls.Solution, differential_drive: ls.Scenario
) -> None:
    problem, plant = differential_drive.problem, differential_drive.plant()
    stated = ls.uncertainty_of(plant, LIGHT)
    laws = {
        "smooth": left.policy,
        "ilqr": None,
        "open_loop": left.open_loop().policy,
        "replan": ls.Replanner(problem, left, every=12.0, deadline=0.0),
        "track": ls.track(problem, left, uncertainty=stated),
        "offset_free": ls.OffsetFree(problem, left, stated),
    }
    assert laws.keys() == {*CAMPAIGN.policies}
    for policy, law in laws.items():
        plan = left if law else ls.ilqr(problem)  # which is the baseline, from its own plan
        rollout = ls.simulate(plant, plan, controller=law, disturbances=LIGHT, trials=2, contacts=False, frames=False)
        wanted, rows = ls.stress.outcomes(rollout, problem), results.outcomes(ls.stress.Cell(policy, "light", 1.0))
        np.testing.assert_array_equal(rows.clearance, wanted.clearance, err_msg=policy)
        np.testing.assert_array_equal(rows.outcome, wanted.outcome)
        np.testing.assert_array_equal(rows.cost, wanted.cost)


def test_a_path_and_other_processes_give_the_same_bits(
    results: ls.stress.Results, stored: Path, tmp_path: Path
) -> None:
    again = ls.stress.run_campaign(
        dataclasses.replace(CAMPAIGN, solution=stored), tmp_path, workers=0 if is_short() else 1, batch=3
    )
    assert again.manifest.digest == results.manifest.digest
    assert shards(tmp_path) == shards(results.folder)


def test_the_other_commands_run_it_too(
    stored: Path, left: ls.Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[ls.Trajectory] = []

    def opened(kind: str, port: int, *, title: str, **options: Any) -> None:
        shown.append(options["plan"])
        raise ls.InputError("viewer: none here")

    for kind in (Rare, Break):
        asked = arguments_for(ls.stress.ReliabilityProblem, kind(scenario=DRIVE, solution=stored, policy="track"))
        shown.append(ls.stress.ReliabilityProblem(**asked).score.solution.trajectory)
    monkeypatch.setattr(viewer, "open_viewer", opened)
    assert main(["view", DRIVE, "--solution", str(stored)]) == 2
    few = ["--rate", "0.5", "--confidence", "0.5", "--knots", "149", "--failures", "0", "--out", str(tmp_path)]
    main(["funnel", DRIVE, "--solution", str(stored), *few])
    shown.append(ls.load(tmp_path / "funnel.npz", ls.types.Funnel).plan)
    for solution in (left, str(stored)):
        shown.append(lqrsim.gym.Environment(DRIVE, solution=solution).solution.trajectory)
    assert len(shown) == 6
    for plan in shown:
        np.testing.assert_array_equal(plan.states, left.trajectory.states)


def test_a_solution_of_ilqr_is_that_of_the_policy_ilqr(differential_drive: ls.Scenario) -> None:
    begun = ls.ilqr(differential_drive.problem, max_iterations=3)
    found = solve_policies(("smooth", "ilqr"), differential_drive, given=begun)
    np.testing.assert_array_equal(found["ilqr"].trajectory.states, begun.trajectory.states)
    np.testing.assert_array_equal(
        found["smooth"].trajectory.states, ls.smooth(differential_drive.problem).trajectory.states
    )


# What stays.


def test_the_folder_has_all_that_it_takes_to_replay_and_to_go_on(
    stored: Path, left: ls.Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine, folder = tmp_path / "mine.npz", tmp_path / "out"
    shutil.copy(stored, mine)
    words = [*FEW, "--policies", "open_loop", "track", "--out", str(folder)]
    assert main(["stress", DRIVE, *words, "--solution", str(mine)]) == 0
    mine.unlink()
    whole = shards(folder)
    kept = ls.load(folder / "solution.npz", ls.Solution)
    np.testing.assert_array_equal(kept.trajectory.states, left.trajectory.states)
    for cell in ("0", "1"):
        replayed = ["--cell", cell, "--trial", "1", "--out", str(tmp_path / "trial.npz")]
        assert main(["replay", str(folder), *replayed]) == 0
        assert "identical to the table" in capsys.readouterr().out
    (folder / "shards" / "0001-000000000.parquet").unlink()
    assert main(["stress", DRIVE, "--resume", "--workers", "0", "--out", str(folder)]) == 0
    assert shards(folder) == whole
    # The same command without it, or with another, is another campaign.
    capsys.readouterr()
    assert main(["stress", DRIVE, *words]) == 2
    assert f"solution: got none, want {folder / 'solution.npz'}, as {folder} was begun with" in error_line(capsys)
    other = ls.save(dataclasses.replace(left, policy=left.open_loop().policy), tmp_path / "other.npz")
    for asked in (words, ["--resume", "--out", str(folder)]):
        assert main(["stress", DRIVE, *asked, "--solution", str(other)]) == 2
        assert "solution: got another, want " in error_line(capsys)
    assert shards(folder) == whole


def test_a_campaign_that_solves_does_not_go_on_with_a_solution(left: ls.Solution, tmp_path: Path) -> None:
    campaign = dataclasses.replace(CAMPAIGN, policies=("smooth",), design_disturbances=None, trials=1)
    solved = ls.stress.run_campaign(campaign, tmp_path / "solved", workers=0)
    assert solved.campaign.solution is None
    with pytest.raises(ls.InputError, match=r"^solution: got another, want none, as .*solved was begun with"):
        ls.stress.run_campaign(dataclasses.replace(campaign, solution=left), solved.folder, workers=0)
    # Even that which it would find itself is something else that was asked for.
    found = solved.solution("smooth")
    given = ls.stress.run_campaign(dataclasses.replace(campaign, solution=found), tmp_path / "given", workers=0)
    assert ls.stress.Results(given.folder).campaign.solution == tmp_path / "given" / "solution.npz"
    assert given.manifest.policies["smooth"]["digest"] == solved.manifest.policies["smooth"]["digest"]
    assert given.manifest.digest != solved.manifest.digest


def test_the_hash_is_of_all_that_solving_again_begins_with(left: ls.Solution, tmp_path: Path) -> None:
    """Plans and policies of the same numbers are planned again in another way with another cost-to-go."""
    campaign = dataclasses.replace(CAMPAIGN, policies=("replan",), design_disturbances=None, trials=1)
    assert left.cost_to_go is not None
    steeper = dataclasses.replace(left.cost_to_go, hessian=2 * left.cost_to_go.hessian)
    digests = {
        ls.stress.run_campaign(
            dataclasses.replace(campaign, solution=one), tmp_path / str(number), workers=0
        ).manifest.digest
        for number, one in enumerate((left, dataclasses.replace(left, cost_to_go=steeper)))
    }
    assert len(digests) == 2


# What is said.


def test_a_plan_that_did_not_converge_is_run_and_said_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["solve", DRIVE, "--max-iterations", "2", "--out", str(tmp_path)]) == 1
    path, says = str(tmp_path / "solution.npz"), "did not converge (MAX_ITERATIONS); its plan is run as it is"
    out = tmp_path / "out"
    with caplog.at_level(logging.WARNING, logger="lqrsim"):
        words = [*FEW, "--policies", "smooth", "open_loop", "--out", str(out)]
        assert main(["stress", DRIVE, *words, "--solution", path]) == 0
    assert [record.getMessage() for record in caplog.records].count(f"the solution of smooth {says}") == 1
    assert f"\nsmooth {says}\nopen_loop {says}\n" in capsys.readouterr().out
    assert json.loads((out / "manifest.json").read_text())["remarks"] == [f"smooth {says}", f"open_loop {says}"]
    assert main(["report", str(out), "--videos", "0"]) == 0
    assert f"open_loop {says}" in (out / "report.html").read_text(encoding="utf-8")
    caplog.clear()
    with caplog.at_level(logging.WARNING, logger="lqrsim"):
        lqrsim.gym.Environment(DRIVE, solution=path)
    assert [record.getMessage() for record in caplog.records] == [f"the given solution {says}"]


def test_a_plan_of_another_problem_is_run_but_not_planned_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["solve", DRIVE, "--clearance", "0.05", "--out", str(tmp_path)]) == 0
    path, out = str(tmp_path / "solution.npz"), tmp_path / "out"
    capsys.readouterr()
    assert main(["stress", DRIVE, *FEW, "--solution", path, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    world = "World(16 obstacles: 'floor', 'wall_west', 'wall_east', ...)"
    other = f": constraints Clearance(world={world}, margin=0.05, radius=0.17) instead of none"
    says = f"is of another problem than that of {DRIVE} (solved as {DRIVE}){other}; its plan is run as it is"
    why = f"replan, which re-plans the scenario's problem, while the solution is of another problem{other}"
    assert f"\nsmooth {says}\n" in printed
    assert f"\nleft out: {why}\n" in printed
    assert ls.stress.Results(out).campaign.policies == ("smooth", "ilqr", "open_loop")
    again = [*FEW, "--solution", path, "--policies", "replan", "--out", str(tmp_path / "new")]
    assert main(["stress", DRIVE, *again]) == 2
    assert f"policies: got {why}, want some of smooth, ilqr, open_loop, track" in error_line(capsys)
    assert not (tmp_path / "new").exists()


@settings(max_examples=examples(40), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    weights=st.lists(st.sampled_from([1.0, 30.0, 60.0]), min_size=2, max_size=2), limit=st.sampled_from([0.4, 0.5]),
    obstacles=st.sampled_from([0.0, 1.0, 2.5]), margin=st.sampled_from([None, 0.0, 0.05]),
)  # fmt: skip
def test_what_differs_in_another_problem_is_named_from_what_to_what(
    differential_drive: ls.Scenario, weights: list[float], limit: float, obstacles: float, margin: float | None
) -> None:
    """Each part that was changed and no other, whatever was changed together; and after a file has been read."""
    own, scene, robot = differential_drive.problem, differential_drive.scene, differential_drive.robot
    cost = ls.ControlCost(weights, about=(0.25, 0.25))
    if obstacles:
        cost = cost + ls.ObstacleCost(scene.world, radius=robot.radius, sharpness=10.0, weight=obstacles)
    clear = [] if margin is None else [ls.Clearance(scene.world, radius=robot.radius, margin=margin)]
    problem = dataclasses.replace(own, stage_cost=cost, control_limits=(-limit, limit), constraints=clear)
    solution = ls.smooth(problem, max_iterations=1, starts=1)
    said = remarks(differential_drive, solution)[not solution.success :]
    if same := weights == [60.0, 60.0] and limit == 0.5 and obstacles == 1 and margin is None:
        assert said == []
    else:
        (line,) = said
        assert ("stage cost " in line) == (weights != [60.0, 60.0] or obstacles != 1)
        assert ("limits left -0.4 to 0.4, right -0.4 to 0.4 instead of left -0.5" in line) == (limit == 0.4)
        wanted = "" if margin is None else f", margin={margin:g}, radius=0.17) instead of none"
        assert ("constraints Clearance(" in line, wanted in line) == (margin is not None, True)
        assert not any(f"{part} " in line for part in ("start", "final cost", "dynamics", "states", "noise"))
        if weights == [60.0, 60.0] and obstacles == 2.5:
            assert "stage cost ... weight=2.5 ... instead of ... weight=1 ..." in line
    with tempfile.TemporaryDirectory() as folder:
        stored = ls.load(ls.save(solution, Path(folder) / "one.npz"), ls.Solution)
    assert remarks(differential_drive, stored)[not solution.success :] == said
    older = remarks(differential_drive, dataclasses.replace(stored, problem_parts={}))
    assert same or older[-1] == f"is of another problem than that of {DRIVE}; its plan is run as it is"


def test_numbers_that_no_description_has_are_said_to_differ(differential_drive: ls.Scenario) -> None:
    """An obstacle that is elsewhere, of the same name."""
    own, scene = differential_drive.problem, differential_drive.scene
    *others, last = scene.world.obstacles
    world = ls.World([*others, dataclasses.replace(last, position=last.position + 0.01)])
    cost = ls.ControlCost((60.0, 60.0), about=(0.25, 0.25)) + ls.ObstacleCost(
        world, radius=differential_drive.robot.radius, sharpness=10.0, weight=1.0
    )
    moved = ls.smooth(dataclasses.replace(own, stage_cost=cost), max_iterations=1, starts=1)
    line = remarks(differential_drive, moved)[-1]
    says = f"is of another problem than that of {DRIVE}, in numbers that a description of it leaves out; its plan is"
    assert line == f"{says} run as it is"
    older = dataclasses.replace(moved, versions={"lqrsim": "0.1.0"})
    says = "or of the same: it is described alike, but lqrsim 0.1.0 hashes problems otherwise; solve it again to know"
    assert says in remarks(differential_drive, older)[-1]


# What is refused.


@pytest.mark.parametrize("command", ["stress", "rare", "harden", "break", "funnel", "view"])
def test_a_solution_of_another_system_is_refused_by_every_command(
    command: str, stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([command, "quadrotor", "--solution", str(stored)]) == 2
    says = f"solution: got {stored} with the states x, y, heading, want x, y, z, vx,"
    assert says in error_line(capsys)
    assert not any(tmp_path.iterdir())


def test_what_does_not_fit_is_refused_by_name(
    left: ls.Solution, stored: Path, differential_drive: ls.Scenario, tmp_path: Path
) -> None:
    problem = differential_drive.problem
    goal = dataclasses.replace(problem, final_cost=ls.QuadraticCost((5000.0, 5000.0, 50.0), about=(0.0, 2.4, np.pi)))
    broken = left.trajectory.states.copy()
    broken[7] = np.nan
    unfit: dict[str, Any] = {
        "of 100 steps, want 150, as differential_drive": ls.smooth(
            dataclasses.replace(problem, steps=100), max_iterations=1
        ),
        "with a control period of 0.2 s, want 0.166667 s": ls.smooth(
            dataclasses.replace(problem, dt=0.2), max_iterations=1
        ),
        r"with the goal y = 2.4, want 2.5 \(nan: none\)": ls.smooth(goal, max_iterations=1),
        r"whose plan is not finite \(DIVERGED\)": dataclasses.replace(
            left, status=ls.Status.DIVERGED, trajectory=dataclasses.replace(left.trajectory, states=broken)
        ),
        "3, want a Solution": 3,
        "nothing.npz, want a file that exists": tmp_path / "nothing.npz",
    }
    campaign = dataclasses.replace(CAMPAIGN, policies=("smooth",), design_disturbances=None)
    for says, solution in unfit.items():
        with pytest.raises(ls.InputError, match=f"^solution: .*({says})"):
            ls.stress.run_campaign(dataclasses.replace(campaign, solution=solution), tmp_path / "out", workers=0)
        with pytest.raises(ls.InputError, match=f"^solution: .*({says})"):
            lqrsim.gym.Environment(DRIVE, solution=solution)
        with pytest.raises(ls.InputError, match=f"^solution: .*({says})"):
            _ = ls.stress.ReliabilityProblem(DRIVE, solution=solution).score
    assert not (tmp_path / "out").exists()
    with pytest.raises(ls.InputError, match=r"^solution: got a solution of smooth with ilqr, want it with smooth"):
        ls.stress.run_campaign(
            dataclasses.replace(campaign, policies=("ilqr",), solution=stored), tmp_path / "out", workers=0
        )
    baseline = ls.ilqr(problem, max_iterations=1)
    with pytest.raises(ls.InputError, match=r"^solution: got a solution of ilqr with smooth, want it with ilqr"):
        _ = ls.stress.ReliabilityProblem(DRIVE, solution=baseline).score
    assert not (tmp_path / "out").exists()


def test_a_recorded_run_has_its_own(stored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path / "rollout.npz"), "--solution", str(stored)]) == 2
    assert "--solution: got" in error_line(capsys)
