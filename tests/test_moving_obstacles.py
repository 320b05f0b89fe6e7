"""Obstacles that move: plans for where they will be, against places, velocities and SLSQP; see `point_mass.py`."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from live_solves import ready
from point_mass import DT, MARGIN, RADIUS, Oracle, balls, check, problem
from sampling import examples

import lqrsim as ls
from lqrsim.codegen import compiled_module
from lqrsim.kernels.declarations import ROW
from lqrsim.simulation.closed_loop import FINEST, simulate_from

ACROSS = balls((0.0, -2.0, 0.5), velocity=(0.0, 2.0))  # in the middle of the way when the mass would be there


class TestWorld:
    @given(
        velocity=st.lists(st.floats(-3, 3), min_size=3, max_size=3), seconds=st.floats(-5, 5),
        plane=st.sampled_from(["xyz", "xy", "yx", "xz", "zy"]), seed=st.integers(0, 100),
    )  # fmt: skip
    def test_it_is_seen_as_it_moves(self, velocity: list[float], seconds: float, plane: str, seed: int) -> None:
        """Moved and then seen in a plane is the same as seen and then moved, whatever the plane: to rounding."""
        rng = np.random.default_rng(seed)
        ball = ls.Obstacle(
            "ball", "sphere", rng.uniform(-1, 1, 3), np.eye(3), np.array([0.3, 0, 0]), velocity=np.array(velocity)
        )
        world, offset = ls.World([ball]), None if plane in ("xyz", "xy", "yx") else 0.2
        points = rng.uniform(-2, 2, (4, len(plane)))
        first, last = world.moved(seconds).seen_by(plane, offset), world.seen_by(plane, offset).moved(seconds)
        np.testing.assert_allclose(first.distance(points), last.distance(points), rtol=0, atol=1e-12)
        by_tables = ls.World([replace(ball, position=world.tables([0.0, seconds])[0][-ROW:][1:4])])
        np.testing.assert_allclose(
            by_tables.seen_by(plane, offset).distance(points), first.distance(points), rtol=0, atol=1e-12
        )

    def test_a_velocity_that_is_none_is_refused(self) -> None:
        ball = balls((0, 0, 1)).obstacles[0]
        with pytest.raises(ls.InputError, match="obstacle 'ball 0': velocity: got shape"):
            replace(ball, velocity=np.zeros(2))
        with pytest.raises(ls.InputError, match="seconds: got nan"):
            ACROSS.moved(np.nan)


class TestPlans:
    @pytest.mark.parametrize("way", ["clearance", "cost", "both"])
    def test_it_is_an_optimum_past_where_the_ball_will_be(self, way: str) -> None:
        """By SLSQP, which has the ball's place at each knot; where a plan for a ball that stands still would hit it."""
        stated = problem(ACROSS, weight=0.0 if way == "clearance" else 1.0)
        if way == "cost":
            stated = replace(stated, constraints=())
        solution = ls.smooth(stated, tolerance=1e-6, constraint_tolerance=1e-5)
        if way == "cost":
            oracle = Oracle(stated)
            z = oracle.pack(solution.trajectory)
            assert solution.cost == pytest.approx(oracle.cost(z), rel=1e-9)
            assert solution.cost < oracle.least(z) * (1 + 1e-3)
        else:
            check(solution, stated)
        clearance = Oracle.distances(solution.trajectory.states, ACROSS, stated.times)[:, 0]
        assert solution.clearance is not None
        cost = stated.obstacle_costs[0].radius
        radii = [cost] if way == "cost" else [cost, RADIUS]
        np.testing.assert_allclose(solution.clearance, clearance - max(radii), rtol=0, atol=1e-9)
        still = ls.smooth(problem(balls((0.0, -2.0, 0.5)), weight=1.0))
        assert Oracle.distances(still.trajectory.states, ACROSS, stated.times).min() < 0

    @settings(max_examples=examples(15))
    @given(
        place=st.tuples(st.floats(-1, 1), st.floats(-1.5, 1.5)), velocity=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
        begin=st.floats(-2, 2), after=st.integers(0, 10),
    )  # fmt: skip
    def test_the_rest_of_it_begins_later(
        self, place: tuple[float, float], velocity: tuple[float, float], begin: float, after: int
    ) -> None:
        """What a plan of the rest costs and clears, by the oracle; and as if the ball had begun farther on.

        To 1e-9 of the numbers: the times are sums in another order.
        """
        world, start = balls((*place, 0.3), velocity=velocity), np.array([[-2.0, 0, 0, 0]])
        assume(min(Oracle.distances(start, world, begin + i * DT).min() for i in (0, after)) > 0.1)
        stated = replace(problem(balls((9, 9, 0.3))), begin=begin)
        stated = replace(
            stated,
            stage_cost=ls.ControlCost([0.1, 0.1]) + ls.ObstacleCost(world, radius=0.1),
            constraints=[ls.Clearance(world.moved(-begin), radius=RADIUS, margin=MARGIN)],
        ).from_state((-2, 0, 0, 0), after=after)  # fmt: skip
        there = world.moved(begin + after * DT)
        same = replace(
            stated,
            begin=0.0,
            stage_cost=ls.ControlCost([0.1, 0.1]) + ls.ObstacleCost(there, radius=0.1),
            constraints=[ls.Clearance(world.moved(after * DT), radius=RADIUS, margin=MARGIN)],
        )
        assert stated.steps == 20 - after
        found = [ls.smooth(one, starts=1, max_iterations=1) for one in (stated, same)]
        np.testing.assert_allclose(found[0].trajectory.states, found[1].trajectory.states, rtol=0, atol=1e-9)
        oracle = Oracle(stated)
        assert found[0].cost == pytest.approx(oracle.cost(oracle.pack(found[0].trajectory)), rel=1e-9)
        for one, other in zip(stated.constraint_terms, same.constraint_terms, strict=True):
            np.testing.assert_allclose(one.data, other.data, rtol=0, atol=1e-9)


class TestReplanner:
    @pytest.mark.parametrize("horizon", ["moving", "shrinking"])
    def test_a_planner_takes_them_on(self, horizon: str) -> None:
        """A ball that begins to move while the robot is on its way is passed, and nothing is compiled for it.

        The loop is that of a robot, its motion the point mass's own; the ball is where its velocity takes it.
        """
        parked = balls((0.0, -2.0, 0.5))
        stated = problem(parked, weight=1.0)
        replanner = ls.Replanner(stated, ls.smooth(stated), every=DT, deadline=DT, horizon=horizon)
        seen = balls((0.0, -2.0, 0.5), velocity=(0.0, 2.0)).moved(-0.2)  # it sets off at 0.2 s
        made, state, clearances = len(compiled_module.compilations), np.array([-2.0, 0, 0, 0]), []
        with replanner.live(clock=lambda: 0.0) as planner:
            for step in range(20):
                if step == 2:
                    cost, clear = (
                        ls.ObstacleCost(seen, radius=RADIUS / 2),
                        ls.Clearance(seen, radius=RADIUS, margin=MARGIN),
                    )
                    planner.change(stage_cost=ls.ControlCost([0.1, 0.1]) + cost, constraints=[clear])
                u = planner.step(state, step * DT)
                ready(planner)
                state = np.concatenate([state[:2] + DT * state[2:] + DT**2 / 2 * u, state[2:] + DT * u])
                where = seen if step >= 1 else parked
                clearances.append(float(Oracle.distances(state[None], where, (step + 1) * DT).min()) - RADIUS)
        assert len(compiled_module.compilations) == made
        assert min(clearances) > 0

    def test_chances_of_collision_are_for_what_stands_still(self) -> None:
        stated = problem(ACROSS, weight=1.0)
        with pytest.raises(ls.InputError, match="got obstacles that move, want ones that stand still"):
            ls.smooth_chance_constrained(stated, ls.disturbances.Uncertainty(start=0.01), chance=0.01)


@pytest.fixture(scope="module")
def alone(differential_drive: ls.Scenario, drive_solution: ls.Solution) -> ls.Rollout:
    """A run among the obstacles of the scene alone."""
    return ls.simulate(differential_drive.plant(), drive_solution)


class TestRuns:
    """Obstacles that MuJoCo does not have, in a run: contact where they are at that time."""

    @settings(max_examples=examples(16), suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(
        steps=st.integers(0, 150), aside=st.lists(st.floats(-0.5, 0.5), min_size=2, max_size=2),
        velocity=st.lists(st.floats(-0.6, 0.6), min_size=2, max_size=2), size=st.floats(0.05, 0.3),
        contacts=st.booleans(),
    )  # fmt: skip
    def test_it_collides_when_a_ball_meets_it(
        self, differential_drive: ls.Scenario, drive_solution: ls.Solution, alone: ls.Rollout, steps: int,
        aside: list[float], velocity: list[float], size: float, contacts: bool,
    ) -> None:  # fmt: skip
        """At the first moment at which they touch, and at no earlier one, from 20,000 places of both.

        To the finest step of the search, and 1 mm for paths between frames. The ball is near the plan at a drawn step.
        Clearances are those to the ball or to what stands, to rounding; and nothing else differs from a run without.
        """
        plan, radius = drive_solution.trajectory, differential_drive.robot.radius
        move = np.array([*velocity, 0.0])
        there = np.array([*(plan.states[steps, :2] + aside), 0.0])
        ball = ls.Obstacle("ball", "sphere", there, np.eye(3), np.array([size, 0, 0]), velocity=move)
        world = ls.World([ball]).moved(-steps * plan.dt)
        run = ls.simulate(differential_drive.plant(), drive_solution, moving=world, contacts=contacts)
        start, times = np.array(world.obstacles[0].position[:2]), np.linspace(0, plan.horizon, 20_001)
        path = np.stack([np.interp(times, run.frame_times, run.frames[0, :, i]) for i in range(2)], axis=1)
        apart = np.hypot(*(path - start - times[:, None] * move[:2]).T) - radius - size
        assert not np.isfinite(alone.collided_at).any()
        at, finest = run.collided_at[0], FINEST * radius
        assert apart[times < at].min(initial=np.inf) > -finest - 1e-3
        if np.isfinite(at):
            assert (apart[0] if at == 0 else abs(np.interp(at, times, apart))) < finest + 1e-3
            assert (run.outcome, run.obstacles) == (("collided",), ("ball",))
        else:
            assert run.outcome == ("reached",)
        knots = np.arange(plan.steps + 1) * plan.dt
        to_ball = np.hypot(*(run.states[0, :, :2] - start - knots[:, None] * move[:2]).T) - radius - size
        wanted = np.minimum(alone.clearance[0], to_ball)
        until = np.flatnonzero(knots <= run.collided_at[0])
        np.testing.assert_allclose(run.clearance[0, until], wanted[until], rtol=0, atol=1e-9)
        np.testing.assert_array_equal(run.states[0, until], alone.states[0, until])

    def test_a_run_from_a_later_knot_has_them_where_they_are_then(
        self, differential_drive: ls.Scenario, drive_solution: ls.Solution
    ) -> None:
        """The clearance in closed form to the ball, which is nearer than what stands."""
        plan = drive_solution.trajectory
        place, velocity = np.array([plan.states[20, 0] + 0.28, plan.states[20, 1], 0.0]), np.array([0.5, 0.1, 0])
        ball = ls.Obstacle("ball", "sphere", place, np.eye(3), np.array([0.1, 0, 0]), velocity=velocity)
        world = ls.World([ball]).moved(-20 * plan.dt)
        whole = ls.simulate(differential_drive.plant(), drive_solution, moving=world)
        rest = simulate_from(differential_drive.plant(), drive_solution, whole.states[:, 20], knot=20, moving=world)
        away = np.hypot(*(whole.states[0, 20, :2] - place[:2])) - 0.1 - differential_drive.robot.radius
        assert whole.clearance[0, 20] == pytest.approx(away, abs=1e-9)
        assert rest.clearance[0, 0] == pytest.approx(away, abs=1e-9)

    def test_what_cannot_be_is_refused(self, differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
        same = balls((5.0, 5.0, 0.1)).obstacles[0]
        with pytest.raises(ls.InputError, match="moving: got pillar_1, which is an obstacle of the scene"):
            ls.simulate(differential_drive.plant(), drive_solution, moving=ls.World([replace(same, name="pillar_1")]))
        with pytest.raises(ls.InputError, match="moving: got 3, want a World"):
            ls.simulate(differential_drive.plant(), drive_solution, moving=3)  # pyright: ignore[reportArgumentType]
