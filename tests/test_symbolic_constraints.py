"""Constraints as formulas, equalities, goal states and bounds on states: against closed forms, dense KKT and SLSQP."""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shooting import Shooting
from whole_problems.claims import contradictions

import lqrsim as ls
from lqrsim.errors import Array, InputError
from lqrsim.problem.problem import PlainTerm
from lqrsim.results.solution_parts import Status

anything: Any = ls  # whose types nobody checks
EXACT: dict[str, Any] = {"tolerance": 1e-10, "gap_tolerance": 1e-6, "constraint_tolerance": 1e-9}


def mass(x, u, p):
    return [x[1], u[0]]


DYNAMICS = ls.Dynamics(mass, states={"x": "m", "v": "m/s"}, controls={"a": "m/s^2"})


def problem(
    *constraints: ls.Constraint, soft: bool = False, steps: int = 20, dt: float = 0.1, weight: float = 0.0, **rest: Any
) -> ls.Problem:
    """A mass on a rail, from rest at 0; nothing but constraints sends it anywhere, unless there is a weight."""
    return ls.Problem(
        dynamics=DYNAMICS, dt=dt, steps=steps,
        initial=ls.QuadraticCost([100.0, 100.0], about=[0, 0]) if soft else ls.FixedState([0, 0]),
        stage_cost=ls.ControlCost([1.0]), final_cost=ls.QuadraticCost([weight, weight], about=[1, 0]),
        constraints=constraints, **rest,
    )  # fmt: skip


class Dense:
    """The same in what is free: of a soft start the first state, and the controls. `1/2 z'Hz + g'z`, states `G z`."""

    def __init__(self, case: ls.Problem) -> None:
        steps, dt, self.free = case.steps, case.dt, 0 if isinstance(case.initial, ls.FixedState) else 2
        A, B = np.array([[1, dt], [0, 1]]), np.array([dt**2 / 2, dt])
        self.states = np.zeros((steps + 1, 2, self.free + steps))
        self.states[0, :, : self.free] = np.eye(2)[:, : self.free]
        for t in range(steps):
            self.states[t + 1] = A @ self.states[t]
            self.states[t + 1, :, self.free + t] += B
        final: Any = case.final_cost
        self.H = np.diag([100.0] * self.free + [1.0] * steps) + self.states[-1].T @ final.weight @ self.states[-1]
        self.g = -self.states[-1].T @ final.weight @ final.about
        self.constant = 0.5 * final.about @ final.weight @ final.about
        self.controls = np.eye(self.free + steps)[self.free :]

    def pack(self, plan: ls.Trajectory) -> Array:
        return np.concatenate([plan.states[0][: self.free], plan.controls.ravel()])

    def cost(self, z: Array) -> float:
        return float(0.5 * z @ self.H @ z + self.g @ z + self.constant)

    def optimum(self, C: Array, d: Array) -> tuple[Array, Array]:
        """z and the multipliers of `C z = d`, from the KKT conditions `Hz + g = C'lambda`."""
        system = np.block([[self.H, -C.T], [C, np.zeros((len(C), len(C)))]])
        found = np.linalg.solve(system, np.concatenate([-self.g, d]))
        return found[: len(self.g)], found[len(self.g) :]


class TestGoalState:
    @pytest.mark.parametrize("soft", [False, pytest.param(True, marks=pytest.mark.long)])
    def test_is_the_dense_kkt_solution(self, soft: bool) -> None:
        case = problem(ls.GoalState([1, -0.5]), soft=soft, weight=0.3)
        solution, dense = ls.smooth(case, **EXACT), Dense(case)
        z, multipliers = dense.optimum(dense.states[-1], np.array([1, -0.5]))
        assert solution.status is Status.CONVERGED, solution.summary()
        np.testing.assert_allclose(dense.pack(solution.trajectory), z, rtol=0, atol=1e-6)
        np.testing.assert_allclose(solution.multipliers[0].values[-1], multipliers, rtol=1e-6)
        assert (multipliers < 0).any()
        assert (multipliers > 0).any()
        assert not solution.multipliers[0].values[:-1].any()
        assert solution.violation <= 1e-9

    @pytest.mark.parametrize("penalty", [0.1, 10.0, 1e4])
    def test_any_penalty_leads_there(self, penalty: float) -> None:
        """From the first iteration on; whatever it is, the optimum is that of the KKT conditions."""
        case = problem(ls.GoalState([1, -0.5]), soft=False, weight=0.3)
        logged: list[ls.types.Iteration] = []
        start = np.zeros((case.steps, 1))
        solution = ls.smooth(case, start=start, penalty=penalty, callback=logged.append, **EXACT)
        dense = Dense(case)
        z, multipliers = dense.optimum(dense.states[-1], np.array([1, -0.5]))
        assert solution.status is Status.CONVERGED, solution.summary()
        np.testing.assert_allclose(dense.pack(solution.trajectory), z, rtol=0, atol=1e-6)
        np.testing.assert_allclose(solution.multipliers[0].values[-1], multipliers, rtol=1e-6)
        assert solution.options["penalty"] == penalty
        # The first plan is the optimum of the cost with the penalty.
        end = dense.states[-1]
        penalised = dense.H + penalty * end.T @ end, dense.g - penalty * end.T @ [1, -0.5]
        missed = np.abs(end @ np.linalg.solve(penalised[0], -penalised[1]) - [1, -0.5]).max()
        assert logged[0].violation == pytest.approx(missed, rel=1e-6)

    def test_a_penalty_that_does_not_fit_is_refused(self) -> None:
        case = problem(ls.GoalState([1, -0.5]), soft=False)
        start = np.zeros((case.steps, 1))
        refused: tuple[tuple[dict[str, Any], str], ...] = (
            ({"penalty": 3.0}, "penalty: got 3 without a start, want start=... beside it"),
            ({"penalty": 0.0, "start": start}, "penalty: got 0.0, want a finite number > 0"),
            ({"penalty": 3.0, "start": ls.InitialPrior([1, 1], about=[0, 0])}, "penalty: got 3 beside an InitialPrior"),
        )
        for options, line in refused:
            with pytest.raises(InputError) as caught:
                ls.smooth(case, **options)
            assert str(caught.value).startswith(line)
        with pytest.raises(InputError, match="penalty: got 3 for a problem without constraints, want None"):
            ls.smooth(dataclasses.replace(case, constraints=()), start=start, penalty=3.0)

    def test_is_the_cubic_of_least_energy(self) -> None:
        """From rest to rest x = 3 s^2 - 2 s^3; held controls approach it with the square of the step."""
        steps = 100
        solution = ls.smooth(problem(ls.GoalState([1, 0]), steps=steps, dt=2 / steps))
        s = np.linspace(0, 1, steps + 1)
        np.testing.assert_allclose(solution.trajectory.states[:, 0], 3 * s**2 - 2 * s**3, rtol=0, atol=1e-4)
        middles = (s[1:] + s[:-1]) / 2
        np.testing.assert_allclose(solution.trajectory.controls[:, 0], (6 - 12 * middles) / 2**2, rtol=0, atol=1e-3)
        # 1/2 integral of u^2 is 6 / T^3, and a stage cost is per step.
        assert solution.cost * 2 / steps == pytest.approx(6 / 2**3, rel=1e-3)

    @pytest.mark.parametrize(("tolerance", "kept"), [(1e-3, 1e-6), (1e-5, 1e-6), (1e-8, 1e-8)])
    def test_is_kept_to_a_millionth_or_closer(self, tolerance: float, kept: float) -> None:
        solution = ls.smooth(problem(ls.GoalState([1, 0])), constraint_tolerance=tolerance)
        assert solution.status is Status.CONVERGED
        off = np.abs(solution.trajectory.states[-1] - [1, 0]).max()
        assert off <= kept
        assert solution.violation == pytest.approx(off, abs=1e-15)

    def test_of_some_states_leaves_the_others(self) -> None:
        case = problem(ls.GoalState(x=1.0))
        solution, dense = ls.smooth(case, **EXACT), Dense(case)
        z, multiplier = dense.optimum(dense.states[-1, :1], np.array([1.0]))
        np.testing.assert_allclose(dense.pack(solution.trajectory), z, rtol=0, atol=1e-6)
        assert solution.trajectory.states[-1, 1] > 0.5
        np.testing.assert_allclose(solution.multipliers[0].values[-1], multiplier, rtol=1e-6)
        assert solution.goal is not None
        np.testing.assert_array_equal(solution.goal, [1, np.nan])

    def test_multipliers_are_what_a_unit_more_costs(self) -> None:
        moved = [ls.smooth(problem(ls.GoalState([1 + e, 0]), weight=1.0), **EXACT).cost for e in (-1e-3, 1e-3)]
        solution = ls.smooth(problem(ls.GoalState([1, 0]), weight=1.0), **EXACT)
        slope = (moved[1] - moved[0]) / 2e-3
        # The cost's own slope is at the goal: it wants to be at 1, and is.
        assert solution.multipliers[0].values[-1, 0] == pytest.approx(slope, rel=1e-5)


def steered(x, u, p):
    return [u[0] - p.gain * (1 - x[0])]


def line(x, u, p):
    return x[0] + p.slope * x[1] - 1


class TestEquality:
    @pytest.mark.parametrize(
        ("form", "soft"), [("dual", False), ("dual", True), pytest.param("primal", True, marks=pytest.mark.long)]
    )
    def test_at_the_end_is_the_dense_kkt_solution(self, form: str, soft: bool) -> None:
        constraint = ls.SymbolicConstraint(line, parameters={"slope": -0.3}, equality=True, at="final")
        case = problem(constraint, soft=soft, weight=20.0)
        solution, dense = ls.smooth(case, form=form, **EXACT), Dense(case)
        z, multipliers = dense.optimum((dense.states[-1, 0] - 0.3 * dense.states[-1, 1])[None], np.ones(1))
        assert solution.status is Status.CONVERGED, solution.summary()
        np.testing.assert_allclose(dense.pack(solution.trajectory), z, rtol=0, atol=1e-6)
        np.testing.assert_allclose(solution.multipliers[0].values[-1], multipliers, rtol=1e-4)
        assert contradictions(case, solution) == []

    @pytest.mark.parametrize("soft", [False, pytest.param(True, marks=pytest.mark.long)])
    def test_of_state_and_control_is_the_dense_kkt_solution(self, soft: bool) -> None:
        """At all steps but the last, which has no control. From a given start it leaves nothing free."""
        constraint = ls.SymbolicConstraint(steered, parameters={"gain": 0.4}, equality=True)
        case = problem(constraint, soft=soft, weight=20.0)
        solution, dense = ls.smooth(case, **EXACT), Dense(case)
        C, d = dense.controls + 0.4 * dense.states[:-1, 0], np.full(case.steps, 0.4)
        z, multipliers = dense.optimum(C, d)
        assert solution.status is Status.CONVERGED, solution.summary()
        np.testing.assert_allclose(dense.pack(solution.trajectory), z, rtol=0, atol=1e-6)
        np.testing.assert_allclose(solution.multipliers[0].values[:-1, 0], multipliers, rtol=0, atol=1e-4)
        assert contradictions(case, solution) == []


def effort(x, u, p):
    return [p.most - u[0], p.most + u[0]]


def power_left(x, u, p):
    return p.room - x[1] * u[0]  # the power


def past(x, u, p):
    return x[0] - p.least


class TestInequality:
    @pytest.mark.parametrize(
        ("soft", "most", "room"), [(False, 1.35, 0.35), pytest.param(True, 1.1, 0.25, marks=pytest.mark.long)]
    )
    def test_of_state_and_control_with_a_goal(self, soft: bool, most: float, room: float) -> None:
        kept = [
            ls.GoalState([1, 0]),
            ls.SymbolicConstraint(effort, parameters={"most": most}),
            ls.SymbolicConstraint(power_left, parameters={"room": room}),
        ]
        case = problem(*kept, soft=soft)
        solution, shooting = ls.smooth(case, tolerance=1e-8, constraint_tolerance=1e-6), Shooting(case)
        values = shooting.rows(shooting.pack(solution.trajectory), equality=False)
        least = shooting.least(np.zeros(shooting.size))[1]
        assert solution.status is Status.CONVERGED, solution.summary()
        assert solution.cost == pytest.approx(least, rel=1e-4)
        assert 0 <= values.min() <= 2e-6  # it acts
        assert all(one.values.any() for one in solution.multipliers)
        assert all((one.values >= 0).all() for one in solution.multipliers[1:])
        assert contradictions(case, solution) == []

    def test_at_the_final_step_alone(self) -> None:
        case = problem(ls.SymbolicConstraint(past, parameters={"least": 1.0}, at="final"))
        solution, dense = ls.smooth(case, constraint_tolerance=1e-6), Dense(case)
        z, multiplier = dense.optimum(dense.states[-1, :1], np.array([1.0]))
        np.testing.assert_allclose(dense.pack(solution.trajectory), z, rtol=0, atol=1e-4)
        np.testing.assert_allclose(solution.multipliers[0].values[-1], multiplier, rtol=1e-3)
        assert solution.trajectory.states[-1, 0] >= 1


class TestStateBounds:
    @pytest.mark.parametrize("soft", [False, pytest.param(True, marks=pytest.mark.long)])
    def test_are_kept_at_every_step(self, soft: bool) -> None:
        case = problem(ls.GoalState([1, 0]), ls.StateBounds(v=(-0.1, 0.55)), soft=soft)
        solution, shooting = ls.smooth(case, tolerance=1e-8, constraint_tolerance=1e-6), Shooting(case)
        speeds = solution.trajectory.states[:, 1]
        least = shooting.least(np.zeros(shooting.size))[1]
        assert solution.status is Status.CONVERGED, solution.summary()
        assert speeds.min() >= -0.1
        assert 0.55 - 2e-6 <= speeds.max() <= 0.55
        assert solution.cost == pytest.approx(least, rel=1e-4)
        assert contradictions(case, solution) == []

    def test_may_be_where_the_goal_is(self) -> None:
        """A bound wants some room, and the goal leaves none: at the end it does not act."""
        solution = ls.smooth(problem(ls.GoalState([1, 0]), ls.StateBounds(v=(0.0, np.inf), x=(-np.inf, 1.0))))
        assert solution.status is Status.CONVERGED, solution.summary()
        np.testing.assert_allclose(solution.trajectory.states[-1], [1, 0], rtol=0, atol=1e-6)
        assert solution.trajectory.states[:-1, 1].min() >= 0


def swing(x, u, p):
    from sympy import sin

    return [x[1], u[0] - p.gravity * sin(x[0])]


def test_a_pendulum_up_within_its_power() -> None:
    """Not linear, and far from the goal where it begins: SLSQP finds nothing better from there."""

    def power(x, u, p):
        return p.most - (x[1] * u[0]) ** 2 / p.most

    pendulum = ls.Dynamics(
        swing, states={"angle": "rad", "turn": "rad/s"}, controls={"push": "1/s^2"}, parameters={"gravity": 2.0}
    )
    case = ls.Problem(
        dynamics=pendulum, dt=0.1, steps=30, initial=ls.FixedState([0, 0]), stage_cost=ls.ControlCost([0.1]),
        final_cost=ls.QuadraticCost([1.0, 1.0], about=[np.pi, 0]),
        constraints=[ls.GoalState([np.pi, 0]), ls.SymbolicConstraint(power, parameters={"most": 2.5})],
    )  # fmt: skip
    solution = ls.smooth(case, tolerance=1e-7, constraint_tolerance=1e-6)
    assert solution.status is Status.CONVERGED, solution.summary()
    assert contradictions(case, solution) == []

    _, least = Shooting(case).least(solution.trajectory.controls.ravel())
    assert solution.cost <= least * (1 + 1e-4)
    assert solution.multipliers[1].values.any()  # the power acts


class TestInfeasible:
    @pytest.mark.parametrize(
        ("constraints", "said"),
        [
            ([ls.GoalState([1, 0])], "the goal of 1 m for x is missed by"),
            ([ls.SymbolicConstraint(line, parameters={"slope": 0.0}, equality=True, at="final")],
             "line(x, u, p) = 0 is missed by"),
            ([ls.SymbolicConstraint(line, parameters={"slope": 0.0}, equality=True, at="final", name="the line")],
             "the line = 0 is missed by"),
            ([ls.SymbolicConstraint(lambda x, u, p: x.v - p.least, parameters={"least": 0.5})],
             "-p.least + v >= 0 is missed by"),
            ([ls.GoalState(x=0.3), ls.StateBounds(v=(0.5, np.inf))],
             "v of at least 0.5 m/s is missed by 0.47 at 0.10 s (step 1)"),
        ],
    )  # fmt: skip
    def test_what_cannot_be_kept_is_named(self, constraints: list[ls.Constraint], said: str) -> None:
        solution = ls.smooth(problem(*constraints, control_limits=(-0.3, 0.3)))
        assert solution.status is Status.INFEASIBLE, solution.summary()
        assert said in solution.detail
        assert solution.violation > 1e-3


def test_a_lambda_is_called_by_its_expressions() -> None:
    """Beside a free duration, too; long ones are cut, and numbered so that none counts as another."""
    many = ls.SymbolicConstraint(lambda x, u, p: [x.x + sum(x.v**i for i in range(3, 20 + k)) for k in range(2)])
    two = ls.SymbolicConstraint(lambda x, u, p: [1 - x.x, 2 + x.v * x.x], name="two")
    names = [name for term in problem(many, two).constraint_terms for name in term.names]
    assert [name[-6:] for name in names[:2]] == ["...[0]", "...[1]"]
    assert names[2:] == ["two[0]", "two[1]"]
    dynamics = problem().dynamics
    one = ls.SymbolicConstraint(lambda x, u, p: 1 - x.x)
    assert one.bind(dynamics).names == one.with_added_state(dynamics).bind(dynamics).names == ("1 - x",)
    assert "name='two'" in repr(two)
    with pytest.raises(ls.InputError, match="SymbolicCost: name: got '', want text: one printable line"):
        ls.SymbolicCost(line, name="")


@pytest.mark.parametrize("form", [lambda one: one, np.array, lambda one: np.array([one]), lambda one: [one]])
def test_one_expression_is_itself_or_an_array_or_a_list(form: Callable[[Any], Any]) -> None:
    """An array without axes, too, such as a number of NumPy's."""
    z = np.array([0.25, 0.0, 0.0])
    constraint = ls.SymbolicConstraint(lambda x, u, p: form(1 - x.x**2))
    assert PlainTerm(constraint.bind(DYNAMICS), 2, 1).value(z, 0) == 1 - 0.25**2
    for expected, cost in (
        (1 - 0.25**2, lambda x, u, p: form(1 - x.x**2)),
        (2.0, lambda x, u, p: form(np.float64(2.0))),
    ):
        assert PlainTerm(ls.SymbolicCost(cost).bind(DYNAMICS), 2, 1).cost(z)[0] == expected


def test_a_file_and_a_warm_start_keep_multipliers_of_either_sign(tmp_path: Path) -> None:
    case = problem(ls.GoalState([1, 0]), ls.StateBounds(v=(-np.inf, 0.6)))
    solution = ls.smooth(case)
    loaded = ls.load(ls.save(solution, tmp_path / "solution.npz"), ls.Solution)
    assert loaded.multipliers[0].values.min() < 0
    for one, other in zip(loaded.multipliers, solution.multipliers, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
    assert loaded.violation == solution.violation
    again = ls.smooth(case, start=loaded)
    assert again.status is Status.CONVERGED
    assert len(again.iterations) <= 3


def test_derivatives_are_right() -> None:
    kept = [
        ls.GoalState([1, 0]), ls.SymbolicConstraint(power_left, parameters={"room": 0.3}),
        ls.StateBounds(x=(-1, np.inf)),
    ]  # fmt: skip
    checks = [check for check in ls.check_derivatives(problem(*kept)) if "slope of" in check.what]
    assert len(checks) == 4
    assert all(check.good for check in checks)


@pytest.mark.parametrize("seed", range(5))
def test_goals_and_bounds_by_unit_are_those_by_name(seed: int) -> None:
    """A chain of masses: what is said of a unit is said of each state in it, and a name wins over a unit."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 5))
    places, speeds = [f"x{i}" for i in range(count)], [f"v{i}" for i in range(count)]
    chain = ls.Dynamics(
        lambda x, u, p: [*x[count:], *u],
        states=dict.fromkeys(places, "m") | dict.fromkeys(speeds, "m/s"),
        controls={f"a{i}": "m/s^2" for i in range(count)},
    )

    def of(*constraints: ls.Constraint) -> ls.Problem:
        return ls.Problem(
            dynamics=chain, dt=0.1, steps=10, initial=ls.FixedState(np.zeros(2 * count)),
            stage_cost=ls.ControlCost(np.ones(count)),
            final_cost=ls.QuadraticCost(np.ones(2 * count), about=np.zeros(2 * count)), constraints=constraints,
        )  # fmt: skip

    wide, own, goal = rng.uniform(1, 2), rng.uniform(3, 4), rng.uniform(0, 0.5)
    short = of(ls.StateBounds({"m/s": (-wide, wide), "v1": (-own, own)}), ls.GoalState({"m/s": 0.0, "m": goal}, x1=0.1))
    bounds = dict.fromkeys(speeds, (-wide, wide)) | {"v1": (-own, own)}
    long = of(
        ls.StateBounds(bounds), ls.GoalState(dict.fromkeys(speeds, 0.0) | dict.fromkeys(places, goal) | {"x1": 0.1})
    )
    assert short.digest == long.digest
    with pytest.raises(InputError, match=r"got v0 of at least 5 and at most"):
        of(*short.constraints, ls.StateBounds({"m/s": (5.0, 6.0)}))
    with pytest.raises(InputError, match=r"StateBounds: states: got 'rad', want one of: x0, .*, m, m/s"):
        of(ls.StateBounds({"rad": (0.0, 1.0)}))


def test_knots_have_parameters_of_their_own() -> None:
    """A floor under x at three knots: values, slopes and names are those of a constraint at all of them."""
    knots, floors = [2, 5, 9], [0.1, 0.3, 0.2]
    some = ls.SymbolicConstraint(lambda x, u, p: x[0] - p.floor, parameters={"floor": floors}, at=knots, name="floor")
    stated = problem(some, weight=1.0)
    (term,) = stated.constraint_terms
    plain, z = PlainTerm(term, 2, 1), np.array([0.7, -0.2, 0.4])
    for knot in range(stated.steps + 1):
        if knot in knots:
            assert plain.value(z, 0, knot) == pytest.approx(0.7 - floors[knots.index(knot)], rel=1e-15)
        else:
            assert plain.value(z, 0, knot) == np.inf
    bare = ls.smooth(dataclasses.replace(stated, constraints=[]))
    kept = ls.smooth(stated)
    assert kept.success
    assert (bare.trajectory.states[knots, 0] < np.array(floors)).any()
    assert (kept.trajectory.states[knots, 0] >= np.array(floors) - 1e-6).all()
    # The rest of the problem has the rest of the knots, each two steps earlier.
    later = stated.from_state([0.0, 0.0], after=3).constraints[0]
    assert repr(later).startswith("SymbolicConstraint(at=(2, 6), ")


def test_kinds_and_steps_are_part_of_the_digest() -> None:
    kinds = [{}, {"equality": True}, {"at": "final"}, {"equality": True, "at": "final"}]
    cases = [problem(ls.SymbolicConstraint(line, parameters={"slope": 0.1}, **kind)) for kind in kinds]
    assert len({case.digest for case in cases}) == 4


@pytest.mark.parametrize(
    ("state", "line"),
    [
        (lambda: problem(ls.SymbolicConstraint(steered, parameters={"gain": 1.0}, at="final")),
         "steered(x, u, p): got an entry that depends on u, want none at the final step, which has no u"),
        (lambda: problem(ls.SymbolicConstraint(lambda x, u, p: [x[0], u[0]])),
         "got 2 entries of which 1 depend on u, want all of them or none"),
        (lambda: problem(ls.SymbolicConstraint(lambda x, u, p: [])), "got no entries, want at least one"),
        (lambda: problem(ls.SymbolicConstraint(lambda x, u, p: p.a, parameters={"a": 1.0})),
         "got p0 as entry 0, want it to depend on x or u"),
        (lambda: ls.SymbolicConstraint(line, at="start"),
         "SymbolicConstraint: at: got 'start', want one of: all, final"),
        (lambda: ls.SymbolicConstraint(line, at=[3, 2]),
         "SymbolicConstraint: at: got [3, 2], want 'all' or 'final', or whole numbers in order, the indices of knots"),
        (lambda: problem(ls.SymbolicConstraint(line, parameters={"slope": 1.0}, at=[10_000])),
         "SymbolicConstraint: at: got knot 10000, want knots up to"),
        (lambda: ls.SymbolicConstraint(line, parameters={"slope": [1.0, 2.0]}, at=[3]),
         "parameters: slope: got shape (2,), want (1,)"),
        (lambda: ls.SymbolicConstraint(line, at=[3], equality=True), "equality: got True at some knots"),
        (lambda: anything.SymbolicConstraint(line, equality="yes"), "SymbolicConstraint: equality: got 'yes'"),
        (lambda: problem(ls.GoalState([1, 2, 3])), "GoalState: goal: got 3 numbers, want 2, one for each of x, v"),
        (lambda: ls.GoalState(), "GoalState: got nothing, want a number by name of a state, as GoalState(x=...)"),
        (lambda: ls.GoalState({"x": 1}, x=2), "GoalState: got 'x' twice, want each state once"),
        (lambda: anything.GoalState([1, 0], x=2), "GoalState: got [1, 0], want a number by name of a state"),
        (lambda: anything.GoalState({0: 1}), "GoalState: got 0 at 0, want a number by name of a state"),
        (lambda: ls.GoalState(x=np.inf), "GoalState: 'x': got inf, want a finite number"),
        (lambda: problem(ls.GoalState(y=1)), "GoalState: states: got 'y', want one of: x, v"),
        (lambda: problem(ls.GoalState([1, 0]), ls.GoalState(x=2)),
         "constraints: got goals of 1 and 2 for x, want one"),
        (lambda: ls.StateBounds(), "StateBounds: got nothing, want (low, high) by name of a state"),
        (lambda: ls.StateBounds(x=(1, -1)), "StateBounds: 'x': got 1 to -1, want low below high"),
        (lambda: ls.StateBounds(x=(-np.inf, np.inf)), "StateBounds: 'x': got -inf to inf, want low below high, and"),
        (lambda: anything.StateBounds([0, 0]), "StateBounds: got [0, 0], want (low, high) by name of a state"),
        (lambda: anything.StateBounds(x=1.0), "StateBounds: 'x': got 1.0, want (low, high)"),
        (lambda: ls.StateBounds(x=(np.nan, 1)), "StateBounds: 'x': low: got nan"),
        (lambda: problem(ls.StateBounds(y=(0, 1))), "StateBounds: states: got 'y', want one of: x, v"),
        (lambda: problem(ls.StateBounds(x=(-np.inf, 0.5)), ls.GoalState([1, 0])),
         "constraints: got a goal of 1 m for x, want x of at most 0.5 m"),
        (lambda: ls.ilqr(problem(ls.GoalState([1, 0]))), "constraints: got a problem with constraints"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_a_line(state: Callable[[], object], line: str) -> None:
    with pytest.raises(InputError, match=re.escape(line)):
        state()


def test_a_constraint_that_is_kept_anyway_changes_nothing() -> None:
    bare = problem(weight=10.0)
    kept = dataclasses.replace(bare, constraints=[ls.SymbolicConstraint(past, parameters={"least": -5.0})])
    one, other = ls.smooth(bare), ls.smooth(kept)
    # Not to the bit: the two are compiled apart, and a compiler may add in another order.
    np.testing.assert_allclose(one.trajectory.states, other.trajectory.states, rtol=1e-12, atol=1e-14)
    assert other.multipliers == ()
