"""Plans that collide no more often than is asked, for a point mass that passes a pillar; and margins of each knot."""

import os
import signal
import sys
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pillars
import pytest
from pillars import RADIUS, STEPS
from sampling import rarely
from scipy.stats import norm

import lqrsim as ls
from lqrsim.control import chance_constrained
from lqrsim.control.chance_constrained import chances_instead
from lqrsim.disturbances import Uncertainty
from lqrsim.errors import Array

PLACE = (0.0, 0.1)
PILLAR = pillars.pillars(PLACE)
NOISE = pillars.Noise(start=0.05, control=1.5, measurement=0.03)
UNCERTAINTY = NOISE.told
TOLERATE = {"m": 0.5, "m/s": 1.0}


@pytest.fixture(scope="module")
def problem() -> ls.Problem:
    return pillars.problem(ls.ObstacleCost(PILLAR, radius=RADIUS, sharpness=10.0))


def tracked(problem: ls.Problem, solution: ls.Solution) -> ls.AffinePolicy:
    return ls.track(problem, solution, tolerate=TOLERATE)


@pytest.mark.parametrize("asked", [0.1, 0.01, 1e-3])
@pytest.mark.long
def test_a_plan_collides_as_often_as_predicted_and_no_more_than_asked(problem: ls.Problem, asked: float) -> None:
    """Of 200,000 runs 1e-3 are 200, with a standard error of 7 %; a factor of 1.5 is for the linear clearance."""
    plan = ls.smooth_chance_constrained(problem, UNCERTAINTY, chance=asked, controller=tracked)
    assert plan.success
    assert 0.3 * asked <= plan.tube.collision_chance <= asked
    assert isinstance(plan.controller, ls.AffinePolicy)
    measured = pillars.collisions(plan.controller, NOISE, [PLACE], 200_000)
    assert plan.tube.collision_chance / 1.5 < measured < plan.tube.collision_chance * 1.5
    assert "as asked" in str(plan)


def test_less_chance_costs_more_and_keeps_farther(problem: ls.Problem) -> None:
    plans = [ls.smooth_chance_constrained(problem, UNCERTAINTY, chance=c, controller=tracked) for c in (0.1, 1e-3)]
    assert plans[0].solution.cost < plans[1].solution.cost
    nearest = [float(pillars.clearances(plan.solution.trajectory.states, PLACE).min()) for plan in plans]
    assert nearest[0] < nearest[1]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT to send to a process")
def test_ctrl_c_keeps_the_best_plan_so_far(problem: ls.Problem) -> None:
    told: list[tuple[int, int, str]] = []

    def progress(done: int, of: int, found: str) -> None:
        told.append((done, of, found))
        if done == 2:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt) as stopped:
        ls.smooth_chance_constrained(problem, UNCERTAINTY, chance=1e-3, controller=tracked, progress=progress)
    plan = stopped.value.found  # pyright: ignore[reportAttributeAccessIssue]
    assert isinstance(plan, ls.types.SafePlan)
    assert [one[:2] for one in told] == [(0, 14), (0, 14), (1, 14), (2, 14)]  # with six weights after the rounds
    assert told[1][2].startswith(f"chance {plan.rounds[0][-1]:.2g} with margins of")
    assert plan.tube.collision_chance == min(one[-1] for one in plan.rounds)


@pytest.mark.parametrize("sharpness", [10.0, *rarely(100.0)])
def test_a_plan_is_not_much_safer_than_asked(
    problem: ls.Problem, sharpness: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where one clearance for all directions, as the second plan has, is too much: noise is along the way, not across.

    Without a margin the plan collides too often; with one as large across as along it is five times safer than asked,
    and costs more than it need.
    """
    monkeypatch.setattr("lqrsim.control.tubes.MOST_TRIALS", 20_000)  # as without the few of the short run
    cost = ls.ControlCost((1.0, 1.0)) + ls.ObstacleCost(PILLAR, radius=RADIUS, sharpness=sharpness)
    changed: dict[str, Any] = {"stage_cost": cost}
    narrow = Uncertainty(start=0.02, control={"ax": 2.0, "ay": 0.8}, measurement=0.01)
    asked = ls.Problem(**(fields(problem) | changed))
    plan = ls.smooth_chance_constrained(asked, narrow, chance=1e-3, controller=tracked)
    assert 0.5e-3 <= plan.tube.collision_chance <= 1e-3
    second = plan.rounds[1]
    assert second[3] < 0.2e-3  # or this would be no such case
    assert plan.solution.cost < second[2]


@pytest.mark.parametrize("seed", range(4))
def test_a_robot_of_millimetres_is_not_kept_farther_away_than_one_of_metres(seed: int) -> None:
    """All clearances were within a millimetre of their margin there, so the first margin was taken for too small."""
    rng = np.random.default_rng(seed)
    place, noise, plans = np.append(rng.uniform(-0.4, 0.4, 2), 0.0), rng.uniform(0.02, 0.08, 3), []
    for unit in (1.0, 1e-3):
        pillar = ls.Obstacle("pillar", "cylinder", unit * place, np.eye(3), unit * np.array([0.4, 2.0, 0.0]))
        dynamics = ls.Dynamics(
            pillars.moves, states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}, position=("x", "y"),
            controls={"ax": "m/s2", "ay": "m/s2"}, control_limits=(-5 * unit, 5 * unit),
        )  # fmt: skip
        near = ls.ObstacleCost(ls.World([pillar]), radius=RADIUS * unit, sharpness=10 / unit, weight=0.1)
        problem = replace(
            pillars.problem(), dynamics=dynamics, initial=ls.FixedState(unit * np.array(pillars.START)),
            stage_cost=ls.ControlCost(np.full(2, unit**-2)) + near,
            final_cost=ls.QuadraticCost(np.full(4, 500 * unit**-2), about=(1.5 * unit, 0.0, 0.0, 0.0)),
        )  # fmt: skip
        told = Uncertainty(start=noise[0] * unit, control=3 * noise[1] * unit, measurement=0.5 * noise[2] * unit)
        law = partial(ls.track, tolerate={name: unit * number for name, number in TOLERATE.items()})
        plans.append(ls.smooth_chance_constrained(problem, told, chance=1e-3, controller=law))
    usual, small = (plan.tube.collision_chance for plan in plans)
    assert all(plan.success for plan in plans)
    assert usual / 2 < small < 2 * usual


def test_what_is_safe_enough_stays_as_it_is(problem: ls.Problem) -> None:
    calm = Uncertainty(start=1e-6)
    plan = ls.smooth_chance_constrained(problem, calm, chance=0.5, controller=tracked)
    assert len(plan.rounds) == 1
    np.testing.assert_array_equal(plan.solution.trajectory.states, ls.smooth(problem).trajectory.states)


def test_what_cannot_be_is_said_to_fail(problem: ls.Problem) -> None:
    """Noise so strong that no way round is safe enough."""
    wild = Uncertainty(start=1.0, control=3.0, measurement=0.5)
    plan = ls.smooth_chance_constrained(problem, wild, chance=1e-4, controller=tracked, rounds=3)
    assert not plan.success
    assert plan.tube.collision_chance > 1e-4
    assert list(plan.instead) == ["no lag", "twice the range of controls", "exact sensors", "all of these"]
    assert plan.instead["no lag"] == plan.tube.collision_chance  # there is none
    assert plan.instead["exact sensors"] < plan.tube.collision_chance
    assert f"{plan.instead['exact sensors']:.3g} with exact sensors" in str(plan)


def test_improvements_keep_the_laws_own_sensors_tolerances_and_memory(problem: ls.Problem) -> None:
    """Each chance is that of a law which is designed by hand for the improved condition, to the last bit."""
    settings: dict[str, Any] = {
        "sensors": ("x", "y"), "tolerate": {"m": 0.3, "m/s": 2.0}, "effort": 2.0, "at_end": 3.0, "memory": np.inf,
    }  # fmt: skip
    met = Uncertainty(start=0.1, control=2.0, measurement=0.2, lag=0.2, loss=0.2)
    designed, solution = replace(met, control=1.0), ls.smooth(problem)
    law = ls.OffsetFree(problem, solution, designed, **settings)
    tube = ls.predict_tube(problem, solution, met, law)
    plan = ls.types.SafePlan(problem=problem, solution=solution, controller=law, tube=tube, asked=1e-3, rounds=())
    found = chances_instead(plan, met)
    space = solution.policy.control_coordinates
    wider = replace(space, low=(-10.0, -10.0), high=(10.0, 10.0))  # ±5 m/s2, twice
    strong = replace(solution, policy=replace(solution.policy, control_coordinates=wider))
    expected = {}
    for what, own, changes in (
        ("no lag", solution, {"lag": 0.0}), ("twice the range of controls", strong, {}),
        ("exact sensors", solution, {"measurement": 0.0, "loss": 0.0}),
        ("all of these", strong, {"measurement": 0.0, "loss": 0.0, "lag": 0.0}),
    ):  # fmt: skip
        improved, better = replace(met, **changes), replace(designed, **changes)
        by_hand = ls.OffsetFree(problem, own, better, **settings)
        expected[what] = ls.predict_tube(problem, own, improved, by_hand).collision_chance
    assert found == expected


@pytest.mark.parametrize("linear", [*rarely(1e-3, 1e-9, 1e-60), 1e-300, *rarely(0.0)])
def test_collisions_of_which_the_moments_know_nothing_widen_no_margin_beyond_twice(
    problem: ls.Problem, monkeypatch: pytest.MonkeyPatch, linear: float
) -> None:
    """Such are collisions of trials that stray. The margins asked for are counted along a search."""
    asked = 1e-3
    margins: list[float] = []

    def judged(*given: Any) -> ls.types.Tube:
        tube = ls.predict_tube(*given)
        return replace(tube, linear_chance=linear, collision_chance=0.01 / (len(margins) + 1))

    real = chance_constrained._Search.solve

    def solve(search: Any, deviations: float | None) -> None:
        margins.append(deviations or 0.0)
        real(search, deviations)

    monkeypatch.setattr(chance_constrained, "predict_tube", judged)
    monkeypatch.setattr(chance_constrained._Search, "solve", solve)
    ls.smooth_chance_constrained(problem, UNCERTAINTY, chance=asked, controller=tracked, rounds=3)
    assert margins[1] == pytest.approx(norm.isf(asked))  # of the normal distribution
    assert len(margins) >= 4
    growth = np.divide(margins[2:], margins[1:-1])
    assert (growth <= 2.0 + 1e-12).all()
    assert (growth > 1.0).all()


def test_obstacles_become_heavier_where_margins_do_not_do(problem: ls.Problem) -> None:
    """One round of margins between two pillars is not enough; heavier ones lead round them."""
    pillars = [
        ls.Obstacle(f"pillar {side}", "cylinder", np.array([0.0, side, 0.0]), np.eye(3), np.array([0.6, 2.0, 0.0]))
        for side in (-1.0, 1.0)
    ]
    stage = ls.ControlCost((1.0, 1.0)) + ls.ObstacleCost(ls.World(pillars), radius=RADIUS, sharpness=10.0)
    narrow, wild = (
        replace(problem, stage_cost=stage),
        Uncertainty(start=0.2, control=3.0, measurement=0.2),
    )
    told: list[tuple[int, int, str]] = []
    plan = ls.smooth_chance_constrained(
        narrow, wild, chance=1e-3, controller=tracked, rounds=1, progress=lambda *one: told.append(one)
    )
    assert plan.success
    assert plan.weight > 1
    # Each plan is told once it is there, the heavier ones too, and they are counted among what there may be.
    assert {one[2].split(" ")[1] for one in told[1:]} == {f"{line[-1]:.2g}" for line in plan.rounds}
    assert [one[:2] for one in told if "the weight of obstacles" in one[2]][-1] == (7, 7)
    assert sorted(told, key=lambda one: one[0]) == told
    (cost,) = plan.problem.obstacle_costs
    assert cost.weight == plan.weight
    assert f"with {plan.weight:g} times the weight of obstacles" in str(plan)

    # The cost is that of the problem as given: in NumPy, to rounding. Obstacles cost nothing at the given start.
    states, controls = plan.solution.trajectory.states, plan.solution.trajectory.controls
    away = np.hypot(states[1:-1, None, 0], states[1:-1, None, 1] - np.array([-1.0, 1.0])) - 0.6 - RADIUS
    assert isinstance(narrow.final_cost, ls.QuadraticCost)
    end = states[-1] - np.asarray(narrow.final_cost.about)
    own = 0.5 * (controls**2).sum() + np.exp(-10.0 * away).sum() + 0.5 * end @ narrow.final_cost.weight @ end
    np.testing.assert_allclose(plan.cost, own, rtol=1e-9)
    assert plan.cost < plan.solution.cost
    assert plan.rounds[-1][2] == plan.cost


def test_a_margin_of_each_knot_is_kept(problem: ls.Problem) -> None:
    """At each knot but the given first, against the closed form: 1e-6 m, to which constraints are solved."""
    margin = np.linspace(0.0, 0.3, STEPS + 1)
    for given in (margin, margin[:, None]):
        kept = ls.Clearance(PILLAR, radius=RADIUS, margin=given)
        plan = ls.smooth(ls.Problem(**fields(problem), constraints=[kept]))
        assert plan.success
        assert (pillars.clearances(plan.trajectory.states, PLACE)[1:] > margin[1:] - 1e-6).all()
    np.testing.assert_array_equal(kept.ahead(3).margin, margin[3:, None])


def fields(problem: ls.Problem) -> dict[str, Any]:
    names = ("dynamics", "dt", "steps", "initial", "stage_cost", "final_cost")
    return {name: getattr(problem, name) for name in names}


@pytest.mark.parametrize(
    ("margin", "wanted"),
    [
        (np.zeros(7), "got 7 numbers, want one, or one for each of 41 knots"),
        (np.zeros((41, 3)), "got 3 numbers for a knot, want 1, one per obstacle: pillar"),
        (np.zeros(0), "got no numbers"),
    ],
)
def test_margins_that_do_not_fit_are_refused(problem: ls.Problem, margin: Array, wanted: str) -> None:
    with pytest.raises(ls.InputError, match=wanted):
        ls.Problem(**fields(problem), constraints=[ls.Clearance(PILLAR, radius=RADIUS, margin=margin)])


@pytest.mark.parametrize(("name", "value"), [("chance", 0.0), ("chance", 1.0), ("rounds", 0), ("uncertainty", None)])
def test_options_out_of_range_are_refused(problem: ls.Problem, name: str, value: object) -> None:
    options: dict[str, Any] = {"uncertainty": UNCERTAINTY, name: value}
    with pytest.raises(ls.InputError, match=name):
        ls.smooth_chance_constrained(problem, **options)


def test_without_obstacles_there_is_nothing_to_ask(problem: ls.Problem) -> None:
    changed: dict[str, Any] = {"stage_cost": ls.ControlCost((1.0, 1.0))}
    free = ls.Problem(**(fields(problem) | changed))
    with pytest.raises(ls.InputError, match="without obstacles"):
        ls.smooth_chance_constrained(free, UNCERTAINTY)


def test_the_law_is_chosen_for_the_plan_that_it_runs(problem: ls.Problem) -> None:
    """With more room a gentler law fails less often than the one that was chosen for a plan with less."""
    strong = Uncertainty(start=0.02, control=4.0, measurement=0.05)
    plan = ls.smooth_chance_constrained(problem, strong, chance=1e-2)
    assert len(plan.rounds) > 2
    assert isinstance(plan.controller, ls.OffsetFree)
    assert plan.controller.digest == ls.OffsetFree(plan.problem, plan.solution, strong).digest
