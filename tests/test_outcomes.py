"""The table of trials: each entry against what the rollout says, worked out by hand; and solving again in the loop."""

import numpy as np
import pytest
from sampling import rarely

import lqrsim as ls
from lqrsim.control.replanner import Replanner
from lqrsim.disturbances import ForceNoise, MeasurementNoise, Push
from lqrsim.results.goal import OUTCOMES
from lqrsim.results.rollout import Rollout
from lqrsim.simulation.plant import Plant
from lqrsim.stress.analysis import outcomes


@pytest.fixture(scope="module")
def plant(quadrotor: ls.Scenario) -> Plant:
    return quadrotor.plant()


@pytest.fixture(scope="module")
def rough(plant: Plant, quadrotor_solution: ls.Solution) -> Rollout:
    """Rough enough for some to collide, and one to be lost."""
    noise = [ForceNoise(0.5), MeasurementNoise(0.02)]
    return ls.simulate(plant, quadrotor_solution, disturbances=noise, trials=20, contacts=False, frames=False)


def test_each_row_is_what_happened(plant: Plant, quadrotor: ls.Scenario, rough: Rollout) -> None:
    table = outcomes(rough, quadrotor.problem)
    assert table.trial.tolist() == list(range(20))
    assert {"reached", "collided"} <= set(table.outcome) <= set(OUTCOMES)
    plan, dt, goal = rough.plan, rough.plan.dt, quadrotor.problem.goal
    assert goal is not None
    for k in range(20):
        distances = np.array([plant.world.distances(state[:3]) for state in rough.states[k]]) - rough.radius
        hits = np.flatnonzero(distances.min(axis=1) < 0)
        last = hits[0] - 1 if len(hits) else plan.steps  # the last knot before it
        error = np.linalg.norm(rough.states[k, : last + 1, :3] - plan.states[: last + 1, :3], axis=1)
        assert table.worst[k] == pytest.approx(error.max(), rel=1e-12)
        assert table.rms[k] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)
        spent = np.clip(table.ended[k] - dt * np.arange(plan.steps), 0, dt)
        assert table.effort[k] == pytest.approx(np.sum(spent * np.sum(rough.applied[k] ** 2, axis=1)), rel=1e-12)
        if len(hits):
            assert table.outcome[k] == "collided"
            assert last * dt < table.ended[k] <= (last + 1) * dt
            assert table.obstacle[k] == plant.world.names[int(distances[last + 1].argmin())]
            assert table.clearance[k] == 0
            assert np.isnan(table.cost[k])
            assert np.isnan(table.final[k])
            assert np.isnan(table.goal[k])
        else:
            assert table.ended[k] == plan.horizon
            assert table.clearance[k] == pytest.approx(distances.min(), abs=1e-12)
            away = np.linalg.norm(rough.states[k, -1, :3] - goal[:3])
            assert table.outcome[k] == ("reached" if away <= rough.goal_radius else "timed out")
            assert table.obstacle[k] == ""
            assert table.final[k] == error[-1]
            assert table.goal[k] == pytest.approx(away, rel=1e-12)


def test_cost_is_that_of_the_plan_where_nothing_disturbs(
    plant: Plant, quadrotor: ls.Scenario, quadrotor_solution: ls.Solution
) -> None:
    """The plan is followed to 1e-10 m; what the soft start costs is not of the trial."""
    table = outcomes(ls.simulate(plant, quadrotor_solution, frames=False), quadrotor.problem)
    away = quadrotor_solution.trajectory.states[0] - quadrotor.problem.start
    initial = 0.5 * 500.0 * float(away @ away)
    assert table.cost[0] + initial == pytest.approx(quadrotor_solution.cost, rel=1e-6)


def test_contacts_change_nothing_before_the_first_collision(
    plant: Plant, quadrotor_solution: ls.Solution, rough: Rollout
) -> None:
    noise = [ForceNoise(0.5), MeasurementNoise(0.02)]
    solid = ls.simulate(plant, quadrotor_solution, disturbances=noise, trials=20)
    collided = 0
    for k in range(20):
        collided += bool(rough.collided[k])
        counts = rough.counts[k]
        np.testing.assert_array_equal(solid.counts[k], counts)
        np.testing.assert_array_equal(solid.states[k, counts], rough.states[k, counts])
    assert collided


def test_a_lost_trial_is_diverged_and_counts_until_then(plant: Plant, quadrotor_solution: ls.Solution) -> None:
    wild = ls.simulate(plant, quadrotor_solution, disturbances=[ForceNoise(1e12)], trials=3, contacts=False)
    table = outcomes(wild)
    assert set(table.outcome) <= {"diverged", "collided"}
    assert np.isfinite(table.worst).all()
    assert np.isnan(table.cost).all()


@pytest.fixture(scope="module")
def again(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> Replanner:
    return Replanner(quadrotor.problem, quadrotor_solution, every=1.0, deadline=0.0)


class TestReplanner:
    def test_undisturbed_it_keeps_to_the_plan(self, plant: Plant, again: Replanner, quadrotor_solution) -> None:
        """What is left of an optimum is optimal; plans stop within 1e-4 of the cost, which here is centimetres."""
        run = ls.simulate(plant, quadrotor_solution, controller=again, frames=False)
        assert run.tracking_error.max() < 0.03
        assert run.outcome == ("reached",)

    def test_each_trial_gets_what_it_gets_alone(self, plant: Plant, again: Replanner, quadrotor_solution) -> None:
        noise = [ForceNoise(0.2)]
        together = ls.simulate(plant, quadrotor_solution, controller=again, disturbances=noise, trials=3, frames=False)
        alone = ls.simulate(
            plant, quadrotor_solution, controller=again, disturbances=noise, first_trial=2, frames=False
        )
        np.testing.assert_array_equal(alone.states[0], together.states[2])

    def test_it_does_solve_again(self, plant: Plant, again: Replanner, quadrotor_solution) -> None:
        """A push that the first plan only fights; the controls differ from the policy's from the next solve on."""
        push = [Push((0.3, 0.0, 0.0), at=0.5)]
        policy = ls.simulate(plant, quadrotor_solution, disturbances=push, frames=False)
        solved = ls.simulate(plant, quadrotor_solution, controller=again, disturbances=push, frames=False)
        differ = np.abs(policy.commanded - solved.commanded)[0].max(axis=1) > 1e-6
        assert np.flatnonzero(differ)[0] == 30
        made = solved.controller_run
        assert (made.log.solved, made.log.kept) == (4, {})  # at 1, 2, 3 and 4 s
        assert made.summary() == "solved again 4 times"

    @pytest.mark.parametrize("name", ["quadrotor", *rarely("differential_drive")])
    def test_it_does_not_leave_for_a_worse_optimum(self, name: str, request: pytest.FixtureRequest) -> None:
        """On the same trials what was solved again costs as much as what was not, but for what the noise costs."""
        scenario: ls.Scenario = request.getfixturevalue(name)
        solution = ls.smooth(scenario.problem)
        again = Replanner(scenario.problem, solution, every=scenario.problem.dt * 15, deadline=0.0)
        plant, costs = scenario.plant(), []
        for controller in (None, again):
            run = ls.simulate(
                plant, solution, controller=controller, disturbances=scenario.disturbances, trials=20, contacts=False,
                frames=False,
            )  # fmt: skip
            assert set(run.outcome) == {"reached"}
            costs.append(outcomes(run, scenario.problem).cost)
        np.testing.assert_allclose(costs[1], costs[0], rtol=0.03)

    @pytest.mark.long
    def test_where_no_solve_succeeds_the_law_goes_on(
        self, plant: Plant, quadrotor: ls.Scenario, quadrotor_solution
    ) -> None:
        """Far outside of the cage costs are beyond numbers."""
        again = Replanner(quadrotor.problem, quadrotor_solution, every=0.1, deadline=0.0)
        push = [Push((10.0, 10.0, 0.0), at=0.0)]
        run = ls.simulate(plant, quadrotor_solution, controller=again, disturbances=push, contacts=False, frames=False)
        assert run.collided.all()
        assert np.isfinite(run.commanded).all()
        # It says how often, and why.
        log = run.controller_run.log
        assert log.solved + log.kept.total() == 49
        assert log.kept.total() > 0
        assert log.summary().startswith(f"solved again {log.solved} times")
        assert f"kept the previous law {log.kept.total()} times" in log.summary()
        assert all(reason in log.summary() for reason in log.kept)
