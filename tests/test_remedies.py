"""Each remedy that a solution prints is tried in a case for which it is printed, and the solve then ends better."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from failing_solves import CASES, UPRIGHT, mass, problem, reach, swing
from mechanisms import sled

import lqrsim as ls
from lqrsim.kernels.records import Motion, Policy
from lqrsim.results.solution_parts import Iteration, Status
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.solvers import budget
from lqrsim.solvers.assembly import remedy_of
from lqrsim.solvers.engine import RunResult


@pytest.mark.parametrize("name", CASES)
def test_a_remedy_helps_where_it_is_printed(name: str) -> None:
    case = CASES[name]
    failed = case.solver(case.of, **case.options)
    assert failed.status.name == case.status, failed.summary()
    assert case.remedy in failed.remedy
    assert f"  remedy:    {failed.remedy}" in failed.summary()
    assert "violation: " in failed.summary() or failed.violation <= 1e-6
    assert "MISSES" not in failed.summary()  # of a plan that failed, there is more to say than that
    for other, options in case.changes:
        better = case.solver(case.of if other is None else other, **options)
        assert better.success, better.summary()
        assert better.remedy == ""


@pytest.mark.parametrize("status", [Status.STALLED, Status.NOT_POSITIVE_DEFINITE])
@pytest.mark.parametrize("limits", [{}, {"limit": 0.5}])
def test_ilqr_is_not_told_of_options_that_it_lacks(status: Status, limits: dict[str, Any]) -> None:
    """It rarely fails so; the remedy is that for a result which says that it did."""
    of = problem(**limits)
    found = ls.ilqr(of, stop="cost")
    plan = Motion(found.trajectory.states, found.trajectory.controls)
    failed = RunResult(status=status, plan=plan, policy=Policy(found.policy.gain, found.policy.offset))
    remedy = remedy_of(of, failed, (), dict(found.options), shorter="")
    assert "finish" not in remedy
    if limits or status is Status.NOT_POSITIVE_DEFINITE:
        better = "the interior point" if limits else "Newton's method"
        assert remedy == f"solve with smooth: {better} finds plans where this method does not"


def test_an_interrupted_solve_goes_on_from_the_solution_of_the_exception() -> None:
    def stop(one: Iteration) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as raised:
        ls.smooth(UPRIGHT, callback=stop)
    stopped = raised.value.solution  # pyright: ignore[reportAttributeAccessIssue]
    assert stopped.remedy == "solve again, from start=solution"
    assert ls.smooth(UPRIGHT, start=stopped).success


@pytest.mark.parametrize("of", [UPRIGHT, reach(0.5)], ids=["swing", "limits"])
def test_a_solution_of_a_similar_problem_takes_less_time(of: ls.Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock that counts iterations, of which a start nearby saves some."""
    similar = ls.smooth(replace(of, initial=ls.FixedState([0.01, 0.0])))
    needed = len(ls.smooth(of).iterations)
    now = [0.0]
    monkeypatch.setattr(budget, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def tick(one: Iteration) -> None:
        now[0] += 1.0

    late = ls.smooth(of, time_limit=needed - 1.5, callback=tick)
    assert late.status is Status.TIME_LIMIT, late.summary()
    assert late.remedy.endswith("or begin with start=solution of a similar problem")
    now[0] = 0.0
    assert ls.smooth(of, time_limit=needed - 1.5, callback=tick, start=similar).success


def pump(**about: float) -> ls.Problem:
    """z flows only while both valves are open, and w not at all."""
    dynamics = ls.Dynamics(
        lambda x, u, p: [u[0] * u[0] * u[1], 0 * x[1]], states={"z": "m", "w": "m"}, controls={"a": "", "b": ""}
    )
    return ls.Problem(
        dynamics=dynamics, dt=0.1, steps=15, initial=ls.FixedState(np.zeros(2)), stage_cost=ls.ControlCost(np.ones(2)),
        final_cost=ls.QuadraticCost(dict.fromkeys(about, 100.0), about=about),
    )  # fmt: skip


def test_a_goal_that_no_control_comes_nearer_to() -> None:
    beyond = ls.smooth(pump(z=1.0, w=1.0))
    assert beyond.remedy == "leave w out of the goal, which no control that was tried changes"
    assert ls.smooth(pump(z=1.0)).remedy == ""
    shut = ls.smooth(pump(z=1.0), start=[0.0, 0.0], safeguard=False)
    assert shut.status is Status.STALLED
    assert shut.remedy == "begin with start=[...], controls that change z"
    opened = ls.smooth(pump(z=1.0), start=[0.5, 0.5])
    assert opened.success
    assert opened.remedy == ""
    assert opened.cost < shut.cost


def test_what_the_summary_of_a_success_advises_helps() -> None:
    """Coarse steps, bounds that are exceeded between knots, and goals that are missed with and without limits."""
    bounded = problem(
        mass, ls.StateBounds(x=(-1.0, 0.2)), ls.GoalState(x=0.0, v=0.0), start=(0.0, 1.0), goal=(0.0, 0.0), dt=0.7,
        steps=3,
    )  # fmt: skip
    coarse = problem(swing, pull=30.0, goal=(3.0, 0.0), final=100.0, dt=0.2, steps=8)
    lazy, weak = problem(effort=10.0), problem(limit=0.3, final=1e4)
    weights = "raise the weights of the final cost or, if controls are at their limits, the number of steps"
    for of, advice, better in (
        (bounded, "use Problem(between_knots=True)", replace(bounded, between_knots=True)),
        (coarse, "use Problem(accuracy=1e-6)", replace(coarse, accuracy=1e-6)),
        (lazy, weights, problem(effort=10.0, final=1e5)),
        (weak, weights, problem(limit=0.3, final=1e4, steps=60)),
    ):
        first, second = ls.smooth(of), ls.smooth(better)
        assert first.success
        assert second.success
        assert advice in first.summary()
        assert advice not in second.summary()


def escaping(pull: float, *, paid: float = 0.0) -> ls.Problem:
    """x' = pull x^3 + u from 1, which is infinite after 1 / (2 pull) seconds under no control."""
    dynamics = ls.Dynamics(
        lambda x, u, p: [p.pull * x[0] ** 3 + u[0]], states={"x": "m"}, controls={"u": "m/s"}, parameters={"pull": pull}
    )
    return ls.Problem(
        dynamics=dynamics, dt=0.05, steps=20, initial=ls.QuadraticCost([1.0], about=[1.0]),
        stage_cost=ls.ControlCost([1.0])
        + ls.SymbolicCost(lambda x, u, p: -p.paid * u.u**2, parameters={"paid": paid}, convex=True),
        final_cost=ls.QuadraticCost([1.0], about=[0.0]),
    )  # fmt: skip


def test_remedies_in_continuous_time() -> None:
    lost = ls.lq.smooth_continuous(escaping(3.0))
    assert lost.remedy == "solve with smooth, whose steps only lower the cost"
    assert ls.smooth(escaping(3.0)).success
    paid = ls.lq.smooth_continuous(escaping(0.1, paid=2.0))
    assert paid.remedy == "raise the control weight"
    assert ls.lq.smooth_continuous(escaping(0.1)).success
    early = ls.lq.smooth_continuous(escaping(0.1), max_iterations=1)
    assert early.remedy == "raise max_iterations"
    for found in (lost, paid, early):
        assert f"  remedy:    {found.remedy}" in str(found)


def test_each_status_that_is_no_success_has_a_case() -> None:
    untried = {
        Status.INTERRUPTED,  # below
        Status.NOT_CERTIFIED,  # a bug: tests/test_certified.py breaks the method to see one
    }
    assert {case.status for case in CASES.values()} == {
        status.name for status in Status if not status.success and status not in untried
    }


@pytest.mark.parametrize("rate", [None, ls.ControlRate(weight=1e-6)])
@pytest.mark.parametrize(("aside", "mass", "pillar"), [(0.2, 1.0, "pillar"), (-0.18, 3.0, "post")])
def test_what_a_plan_grazes_is_named_and_among_the_obstacles_it_is_passed(
    aside: float, mass: float, pillar: str, rate: ls.ControlRate | None
) -> None:
    """Without obstacles only MuJoCo's contacts keep a disc from a pillar: plans slide along it and do not converge.

    With elliptic cones, there is no descent within contact modes either.
    """
    text = sled(
        "xy",
        geom=f'size="0.1" mass="{mass}"',
        limits=(9, 9),
        option='timestep="0.02" cone="elliptic"',
        things=f'<geom name="{pillar}" type="cylinder" size="0.2 0.5" pos="0.5 {aside} 0"/>',
    )
    scene = scene_from_xml(text, "disc")

    def solved(clearance: float | None, **obstacles: Any) -> ls.Solution:
        robot = ls.MjcfRobot(scene, **obstacles)
        ends = robot.at(), robot.at(x=1.0)
        stated = robot.problem(*ends, steps=30, dt=0.04, clearance=clearance, control_rate=rate)
        return ls.smooth(stated, starts=1, max_iterations=60, threads=1)

    grazing, passing = solved(None, obstacles=False), solved(0.01, obstacles=[pillar])
    assert not grazing.success, grazing.summary()
    assert grazing.remedy.startswith(f"the plan grazes {pillar} at ")
    assert passing.success, passing.summary()
    away = np.linalg.norm(passing.trajectory.states[:, :2] - [0.5, aside], axis=1) - 0.3
    assert away.min() > 0.01 - 1e-6  # the tolerance of constraints
