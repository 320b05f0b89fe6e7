"""References and weights that change from knot to knot: plans against dense solves, and what moves them with time."""

import dataclasses
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_quadratic import matrices_of, solve_dense
from sampling import examples
from systems import linear

import lqrsim as ls
from lqrsim.codegen import compiled_module
from lqrsim.errors import Array

DT = 0.1
CART = ls.Dynamics(lambda x, u, p: [x.v, u.push], states={"x": "m", "v": "m/s"}, controls={"push": "m/s^2"})


def definite(rng: np.random.Generator, rows: int, size: int) -> Array:
    """Positive-definite matrices (rows, size, size)."""
    roots = rng.normal(size=(rows, size, size))
    return roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(size)


@dataclasses.dataclass(frozen=True)
class Numbers:
    """A linear problem, `x' = a x + b u`, with other weights and references at each step."""

    a: Array
    b: Array
    start: Array
    states: Array
    state_weights: Array
    controls: Array
    control_weights: Array
    end_weight: Array

    @classmethod
    def drawn(cls, seed: int, steps: int, n: int, m: int) -> "Numbers":
        rng = np.random.default_rng(seed)
        return cls(
            rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=n), rng.normal(size=(steps + 1, n)),
            definite(rng, steps + 1, n), rng.normal(size=(steps, m)), definite(rng, steps, m), definite(rng, 1, n)[0],
        )  # fmt: skip

    def problem(self, **changed: Any) -> ls.Problem:
        stage = ls.QuadraticCost(self.state_weights, about=self.states)
        return ls.Problem(
            dynamics=linear(self.a, self.b), dt=DT, steps=len(self.controls), initial=ls.FixedState(self.start),
            stage_cost=stage + ls.ControlCost(self.control_weights, about=self.controls),
            final_cost=ls.QuadraticCost(self.end_weight, about=self.states[-1]), **changed,
        )  # fmt: skip

    def least(self) -> tuple[Array, Array, float]:
        """States, controls and cost of the optimum, by one dense KKT system of all states and controls."""
        return solve_dense(matrices_of(self.problem()))


class TestPlans:
    @settings(max_examples=examples(40))
    @given(
        seed=st.integers(0, 2**31), steps=st.integers(1, 25), size=st.sampled_from([(2, 1), (3, 2)]),
        way=st.sampled_from(["smooth", "paper", "ilqr", "noise", "constraint", "primal"]),
    )  # fmt: skip
    def test_it_is_the_least_by_a_dense_solve(self, seed: int, steps: int, size: tuple[int, int], way: str) -> None:
        """The optimum is unique; solvers end within a relative decrease of 1e-10, the root of which states are off by.

        Additive noise changes the cost, but not the plan.
        """
        numbers = Numbers.drawn(seed, steps, *size)
        states, controls, cost = numbers.least()
        options: dict[str, Any] = {"tolerance": 1e-12} | ({"finish": None} if way == "paper" else {})
        if way == "noise":
            solution = ls.smooth(numbers.problem(noise=ls.Noise(0.1 * np.eye(size[0]))), **options)
            cost = solution.cost
        elif way == "constraint":  # far away, so that the interior point or the active set answers for nothing else
            bound = ls.StateBounds(x0=(-1e3, 1e3))
            solution = ls.smooth(numbers.problem(constraints=[bound]), constraint_tolerance=1e-6, **options)
        elif way == "ilqr":
            solution = ls.ilqr(numbers.problem(), **options)
        elif way == "primal":
            solution = ls.smooth(numbers.problem(), first_pass="backward", **options)
        else:
            solution = ls.smooth(numbers.problem(), **options)
        assert solution.success
        assert solution.cost == pytest.approx(cost, rel=1e-9)
        scale = 1 + np.abs(states).max() + np.abs(controls).max()
        np.testing.assert_allclose(solution.trajectory.states, states, rtol=0, atol=1e-5 * scale)
        np.testing.assert_allclose(solution.trajectory.controls, controls, rtol=0, atol=1e-5 * scale)

    @settings(max_examples=examples(40))
    @given(
        seed=st.integers(0, 2**31), steps=st.integers(1, 25), size=st.sampled_from([(2, 1), (3, 2)]),
        soft=st.booleans(), off=st.sampled_from([0.0, 0.1, 1.0]),
    )  # fmt: skip
    def test_what_can_be_followed_is_followed(
        self, seed: int, steps: int, size: tuple[int, int], soft: bool, off: float
    ) -> None:
        """The optimum costs nothing: what is left are squares of rounding errors, which no step lowers."""
        numbers, rng = Numbers.drawn(seed, steps, *size), np.random.default_rng(seed)
        states, controls, _ = numbers.least()
        of = dataclasses.replace(numbers, states=states, controls=controls).problem()
        if soft:
            of = dataclasses.replace(of, initial=ls.QuadraticCost(np.ones(size[0]), about=states[0]))
        solution = ls.smooth(of, start=controls + off * rng.normal(size=controls.shape) if off else None)
        assert solution.status is ls.Status.CONVERGED, solution.detail
        scale = 1 + np.abs(states).max() + np.abs(controls).max()
        assert solution.cost < 1e-20 * scale**2 * (1 + np.abs(numbers.end_weight).max())
        np.testing.assert_allclose(solution.trajectory.controls, controls, rtol=0, atol=1e-9 * scale)

    @pytest.mark.parametrize("rows", [7, 8])
    def test_the_same_row_at_each_knot_is_no_row(self, rows: int) -> None:
        """To the last bit, though another kernel computes it."""
        drawn = Numbers.drawn(5, 7, 3, 2)
        stated = drawn.problem()
        weight, about, effort, nominal = (
            array[2] for array in (drawn.state_weights, drawn.states, drawn.control_weights, drawn.controls)
        )
        once = dataclasses.replace(
            stated, stage_cost=ls.QuadraticCost(weight, about=about) + ls.ControlCost(effort, about=nominal)
        )
        state = ls.QuadraticCost(np.tile(weight, (rows, 1, 1)), about=np.tile(about, (rows, 1)))
        control = ls.ControlCost(np.tile(effort, (7, 1, 1)), about=np.tile(nominal, (7, 1)))
        each = dataclasses.replace(stated, stage_cost=state + control)
        one, other = ls.smooth(once), ls.smooth(each)
        assert one.cost == other.cost
        np.testing.assert_array_equal(one.trajectory.states, other.trajectory.states)
        np.testing.assert_array_equal(one.policy.gain, other.policy.gain)

    def test_it_is_what_a_clock_among_the_states_says(self) -> None:
        """A formula of the time, with the time as a state: the same least cost to what both tolerances allow."""

        def follow(x: Any, u: Any, p: Any) -> Any:
            from sympy import cos, sin

            return p.weight * (1 + cos(x.clock)) / 2 * (x.x - sin(x.clock)) ** 2

        timed = ls.Dynamics(
            lambda x, u, p: [x.v, u.push, 1], states={"x": "m", "v": "m/s", "clock": "s"}, controls={"push": "m/s^2"}
        )
        shared: dict[str, Any] = {"dt": DT, "steps": 30}
        end, effort = {"x": 5.0}, ls.ControlCost([0.01])
        clock = ls.Problem(
            dynamics=timed, initial=ls.FixedState(v=1.0), final_cost=ls.QuadraticCost(end, about={"x": np.sin(3.0)}),
            stage_cost=effort + ls.SymbolicCost(follow, parameters={"weight": 8.0}), **shared,
        )  # fmt: skip
        times = clock.times
        rows = ls.QuadraticCost({"x": 8.0 * (1 + np.cos(times))}, about={"x": np.sin(times)})
        knots = ls.Problem(
            dynamics=CART, initial=ls.FixedState(v=1.0), final_cost=ls.QuadraticCost(end, about={"x": np.sin(3.0)}),
            stage_cost=effort + rows, **shared,
        )  # fmt: skip
        one, other = (ls.smooth(problem, tolerance=1e-10) for problem in (clock, knots))
        assert one.cost == pytest.approx(other.cost, rel=1e-9)
        np.testing.assert_allclose(one.trajectory.states[:, :2], other.trajectory.states, rtol=0, atol=1e-5)

    def test_the_first_controls_are_the_nominal_ones(self) -> None:
        controls = np.sin(np.arange(8.0))[:, None]
        stated = follows(8, stage_cost=ls.ControlCost([1.0], about=controls))
        solution = ls.smooth(stated, max_iterations=1)
        assert solution.options["start"] == controls.tolist()
        assert stated.nominal_control == pytest.approx([controls.mean()])

    @pytest.mark.parametrize("turns", [1, -2])
    def test_angles_count_whole_turns(self, turns: int) -> None:
        """A reference that turns on and on is followed, and one by whole turns further is followed alike."""
        steps, rng = 40, np.random.default_rng(3)
        wheel = ls.Dynamics(
            lambda x, u, p: [x.rate, u.torque], states={"angle": "rad", "rate": "rad/s"}, controls={"torque": "Nm"},
            angles=("angle",),
        )  # fmt: skip
        way = np.linspace(0, 4 * np.pi, steps + 1) + rng.normal(size=steps + 1) / 10

        def plan(more: float) -> ls.Trajectory:
            return ls.smooth(
                ls.Problem(
                    dynamics=wheel, dt=DT, steps=steps, initial=ls.FixedState(angle=more),
                    stage_cost=ls.ControlCost([1e-3]) + ls.QuadraticCost({"angle": 10.0}, about={"angle": way + more}),
                    final_cost=ls.QuadraticCost({"angle": 10.0}, about={"angle": way[-1] + more}),
                ), tolerance=1e-10,
            ).trajectory  # fmt: skip

        first, other = plan(0.0), plan(2 * np.pi * turns)
        assert first.states[-1, 0] == pytest.approx(4 * np.pi, abs=0.5)
        np.testing.assert_allclose(other.states[:, 0] - 2 * np.pi * turns, first.states[:, 0], rtol=0, atol=1e-5)


def follows(steps: int, *, about: Any = None, stage: ls.Cost | None = None, **changed: Any) -> ls.Problem:
    """A cart that follows a reference."""
    rows = np.column_stack([np.sin(DT * np.arange(steps + 1)), np.zeros(steps + 1)]) if about is None else about
    follow = ls.QuadraticCost([10.0, 0.0], about=rows)
    stated: dict[str, Any] = {
        "dynamics": CART, "dt": DT, "steps": steps, "initial": ls.FixedState([0.3, 0.0]),
        "stage_cost": ls.ControlCost([0.1]) + (stage or follow), "final_cost": ls.QuadraticCost([5, 1], about=[0, 0]),
    }  # fmt: skip
    return ls.Problem(**stated | changed)


class TestLater:
    @settings(max_examples=examples(40))
    @given(seed=st.integers(0, 2**31), steps=st.integers(2, 20), data=st.data())
    def test_the_rest_of_an_optimum_is_one(self, seed: int, steps: int, data: st.DataObject) -> None:
        """Bellman's principle: from where the plan passes, the rest of the problem has the rest of the plan."""
        numbers, after = Numbers.drawn(seed, steps, 3, 2), data.draw(st.integers(1, steps - 1))
        states, controls, _ = numbers.least()
        rest = numbers.problem().from_state(states[after], after=after)
        solution, scale = ls.smooth(rest, tolerance=1e-12), 1 + np.abs(states).max() + np.abs(controls).max()
        np.testing.assert_allclose(solution.trajectory.states, states[after:], rtol=0, atol=1e-5 * scale)
        again = dataclasses.replace(
            numbers, start=states[after], states=numbers.states[after:], state_weights=numbers.state_weights[after:],
            controls=numbers.controls[after:], control_weights=numbers.control_weights[after:],
        )  # fmt: skip
        assert rest.digest == again.problem().digest
        dataclasses.replace(rest, risk=0.0)  # as many rows as steps are left

    def test_a_moving_horizon_repeats_the_last_row(self) -> None:
        rows = np.arange(12.0).reshape(6, 2)
        stated = follows(5, about=rows)
        later = stated.later(3 * DT)
        cost = later.stage_cost.terms[1]  # pyright: ignore[reportAttributeAccessIssue]
        np.testing.assert_array_equal(cost.about, rows[[3, 4, 5, 5, 5, 5]])
        assert later.digest == dataclasses.replace(stated, stage_cost=later.stage_cost).digest
        np.testing.assert_array_equal(cost.ahead(100, horizon="moving").about, np.tile(rows[-1], (6, 1)))
        np.testing.assert_array_equal(cost.ahead(100).about, rows[-1:])
        for seconds in (0.25, -DT):
            with pytest.raises(ls.InputError, match=f"seconds: got {seconds}, want a multiple of dt, 0.1 s, not neg"):
                stated.later(seconds)

    def test_a_longer_reference_is_moved_along(self) -> None:
        rows = np.arange(40.0).reshape(20, 2)
        with pytest.raises(ls.InputError, match="got 20 rows, want 6, one for each knot; for a moving horizon, more w"):
            follows(5, about=rows)
        cost = ls.QuadraticCost([10.0, 0.0], about=rows, longer=True)
        moved = follows(5, stage=cost).later(7 * DT)
        assert moved.digest == follows(5, stage=cost.ahead(7, horizon="moving")).digest
        one, other = ls.smooth(moved), ls.smooth(follows(5, about=rows[7:13]))
        np.testing.assert_array_equal(one.trajectory.states, other.trajectory.states)

    def test_another_reference_compiles_nothing(self) -> None:
        """Nor do other weights, or a longer one, in the solver that a robot uses."""
        stated = follows(10)
        solver, start = ls.prepare(stated), ls.smooth(stated)
        before = len(compiled_module.compilations)
        for seed in range(3):
            rng = np.random.default_rng(seed)
            cost = ls.QuadraticCost(definite(rng, 15, 2), about=rng.normal(size=(15, 2)), longer=True)
            other = follows(10, stage=cost)
            answer = solver.solve([0.1, 0.2], start, problem=other)
            expected = ls.smooth(other.from_state([0.1, 0.2]), tolerance=1e-10)
            assert answer.cost == pytest.approx(expected.cost, rel=1e-6)
        assert len(compiled_module.compilations) == before

    @pytest.mark.parametrize("horizon", ["shrinking", "moving"])
    def test_a_quadrotor_flies_a_figure_of_eight_in_mujoco(self, horizon: str) -> None:
        """Re-planned every half second. A moving horizon of 3 s looks further and further along a longer reference."""
        robot, scene = ls.Quadrotor(), ls.load_scene("cage", obstacles=False)
        dt, whole = 1 / 30, 180
        steps = whole if horizon == "shrinking" else whole // 2
        weights = {"m": 200.0, "rad": 1.0, "rad/s": 0.1}  # of angles too: else nothing holds yaw
        share = np.linspace(0, 1, whole + 1)
        phase = 2 * np.pi * share**3 * (10 - 15 * share + 6 * share**2)  # from rest to rest
        way = np.column_stack([0.8 * np.sin(phase), 0.4 * np.sin(2 * phase), np.zeros(whole + 1)])
        space = robot.dynamics.state_coordinates
        names = [space.names[i] for i in space.position]

        def places(rows: Array) -> dict[str, Any]:
            return dict(zip(names, rows.T, strict=True))

        def end_at(knot: int) -> ls.QuadraticCost:
            return ls.QuadraticCost(weights, about=places(way[min(knot, whole)]))

        problem = ls.Problem(
            dynamics=robot.dynamics, dt=dt, steps=steps, initial=ls.FixedState(places(way[0])),
            stage_cost=ls.QuadraticCost(weights, about=places(way), longer=horizon == "moving")
            + ls.ControlCost(np.full(4, 0.5), about=np.full(4, robot.hover_force)),
            final_cost=end_at(steps),
        )  # fmt: skip
        solution = ls.smooth(problem)

        def changes(t: float, known: ls.Problem) -> ls.Problem:
            return known.with_costs(final_cost=end_at(round(t / dt) + 1 + steps))

        law = ls.Replanner(
            problem, solution, every=0.5, deadline=dt, horizon=horizon, changes=changes if horizon == "moving" else None
        )
        rollout = ls.simulate(
            ls.Plant(robot, scene), solution, controller=law, seed=1,
            disturbances=[ls.disturbances.ControlNoise(0.02), ls.disturbances.InitialStateError({"m": 0.02})],
        )  # fmt: skip
        at = rollout.states[0][:, list(space.position)]
        run = rollout.controller_run
        assert np.linalg.norm(at - way[: steps + 1], axis=1).max() < 0.15  # m, of an eight that is 1.6 m wide
        assert run.log.solved == len(run.log.records) > 4
        (active,) = run.active
        end = active.first + active.plan.trajectory.steps
        assert end == (whole if horizon == "shrinking" else active.first + steps) > steps - 1
        ends = active.plan.trajectory.states[-1, list(space.position)]
        assert np.linalg.norm(ends - way[end]) < 0.15


class TestStated:
    def test_a_free_duration_keeps_rows_at_their_knots(self) -> None:
        """The duration that is found costs less than others near it, each solved with the same rows."""
        weights = np.linspace(5, 20, 16)[:, None, None] * np.diag([1.0, 0.1])
        rows = np.column_stack([np.sin(DT * np.arange(16)), np.zeros(16)])
        stated = follows(15, stage=ls.QuadraticCost(weights, about=rows), duration=(0.8, 4.0), time_weight=1.0)
        found = ls.smooth(stated, tolerance=1e-8)
        assert found.success

        def price(horizon: float) -> float:
            fixed = dataclasses.replace(stated, dt=horizon / 15, duration=None, time_weight=0.0)
            return ls.smooth(fixed, tolerance=1e-8).cost + horizon

        best = found.trajectory.horizon
        assert 0.8 < best < 4.0
        assert price(best) < min(price(0.97 * best), price(1.03 * best))

    def test_it_is_printed_pickled_and_hashed(self) -> None:
        stated = follows(100)
        assert "about=a trajectory of 101 states" in str(stated)
        assert "array" not in str(stated)
        assert pickle.loads(pickle.dumps(stated.stage_cost)).terms[1].about.shape == (101, 2)
        rows = np.array(stated.stage_cost.terms[1].about)  # pyright: ignore[reportAttributeAccessIssue]
        assert follows(100, about=rows).digest == stated.digest
        rows[40, 0] += 1e-9
        assert follows(100, about=rows).digest != stated.digest
        given = ls.QuadraticCost({"x": 10.0}, about={"x": rows[:, 0], "v": 0.0})
        assert follows(100, stage=given).digest == follows(100, about=rows * [1, 0]).digest

    def test_weights_by_name_are_diagonals(self) -> None:
        ramp = np.linspace(1, 2, 5)
        cost = follows(4, stage=ls.QuadraticCost({"x": ramp, "v": 3.0}, about={})).stage_cost
        expected = np.array([np.diag([one, 3.0]) for one in ramp])
        np.testing.assert_array_equal(cost.terms[1].weight, expected)  # pyright: ignore[reportAttributeAccessIssue]

    @pytest.mark.parametrize(
        ("stated", "line"),
        [
            (lambda: follows(5, about=np.zeros((5 + 2, 2))), "QuadraticCost: about: got 7 rows, want 6, one for each"),
            (lambda: follows(5, about=np.zeros((4, 2))), "QuadraticCost: about: got 4 rows, want 6, one for each knot"),
            (
                lambda: follows(5, stage=ls.QuadraticCost(np.tile(np.eye(2), (3, 1, 1)), about=[0, 0])),
                "QuadraticCost: weight: got 3 rows, want 6, one for each knot",
            ),
            (
                lambda: follows(5, stage=ls.ControlCost([1.0], about=np.zeros((6, 1)))),
                "ControlCost: about: got 6 rows, want 5, one for each step",
            ),
            (
                lambda: follows(5, stage=ls.QuadraticCost([1, 1], about=np.zeros((4, 2)), longer=True)),
                "QuadraticCost: about: got 4 rows, want 6, one for each knot",
            ),
            (
                lambda: follows(5, final_cost=ls.QuadraticCost([1, 1], about=np.zeros((6, 2)))),
                "final_cost: got a QuadraticCost with a row for each knot, want one row, such as rows",
            ),
            (
                lambda: follows(5, initial=ls.QuadraticCost([1, 1], about=np.zeros((6, 2)))),
                "initial: got a QuadraticCost with a row for each knot, want one",
            ),
            (
                lambda: dataclasses.replace(follows(5), steps=8),
                "QuadraticCost: about: got 6 rows, want 9, one for each",
            ),
            (lambda: follows(5, about=np.full((6, 2), np.nan)), r"about: got nan at index \[0, 0\], want finite num"),
            (lambda: ls.QuadraticCost([1, 1], about=np.zeros((0, 2))), "about: got no rows, want one, or one for eac"),
            (lambda: ls.QuadraticCost(np.ones((6, 2)), about=[0, 0]), "want a square matrix .* one matrix for each k"),
            (
                lambda: follows(5, stage=ls.QuadraticCost({"x": 1}, about={"x": [1, 2], "v": [1, 2, 3]})),
                "about: got columns of 2 and 3 numbers, want one number for each knot in all",
            ),
            (
                lambda: ls.lq.smooth_continuous(follows(5, initial=ls.QuadraticCost([1, 1], about=[0, 0]))),
                "stage_cost: got a QuadraticCost with a row for each knot, want one; or use `smooth`",
            ),
        ],
    )
    def test_what_does_not_fit_gets_one_line(self, stated: Any, line: str) -> None:
        with pytest.raises(ls.InputError, match=line):
            stated()
