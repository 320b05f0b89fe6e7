"""A lag that is stated and is not there: designs keep near the plan without it, and lose little where it is there."""

from collections.abc import Sequence

import numpy as np
import pytest
from linear_plans import DT, Linear, linear
from mechanisms import arm
from tracking import open_loop

import lqrsim as ls
from lqrsim.control.plan_model import PlanDerivatives, PlanModel
from lqrsim.control.prediction import LinearLoop
from lqrsim.disturbances import MotorLag, Uncertainty, Unknown, preset
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml

LAG = 0.25  # s: two and a half control periods
SMALL = 1e-9  # so that no control comes to its limits, even in loops that are not stable


def joints(seed: int, *, steps: int = 40) -> Linear:
    """Two coupled joints with motors, held still: damped, and their inertias differ."""
    rng = np.random.default_rng(seed)
    inertia = np.diag(rng.uniform(0.5, 8.0, 2))
    inertia[0, 1] = inertia[1, 0] = 0.5 * rng.uniform(-1, 1) * np.sqrt(inertia[0, 0] * inertia[1, 1])
    push, damping = np.linalg.inv(inertia), np.diag(rng.uniform(0.3, 3.0, 2))
    rates, no = np.block([[np.zeros((2, 2)), np.eye(2)], [np.zeros((2, 2)), -push @ damping]]), np.zeros((2, 2))
    inputs = np.vstack([no, push])
    return linear(rates, inputs, inputs, controls=np.zeros((steps, 2)), limits=(-10.0, 10.0))


def told_of(lag: float) -> Uncertainty:
    unknowns = [Unknown("d0", 0.1), Unknown("d1", 0.1)]
    return Uncertainty(unknowns=unknowns, start=0.01, control=0.1, measurement=0.005, lag=lag)


def run(system: Linear, law: ls.OffsetFree, lag: float, off: Array) -> Array:
    """States (T+1, K, n) from these offsets (K, n) of a linear system in NumPy with this lag."""
    x, begun = system.plan.states[0] + off, law.start(len(off))
    reached, states = np.tile(system.plan.controls[0], (len(off), 1)), [x]
    step = DT / lag if lag else np.inf
    left, mean = np.exp(-step), (1 - np.exp(-step)) / step
    for t in range(system.plan.steps):
        command = begun.control(t, x)
        behind = reached - command
        x = x @ system.A.T + (command + mean * behind) @ system.B.T
        reached = command + left * behind
        states.append(x)
    return np.array(states)


@pytest.mark.parametrize("pose", [(0.6, -1.2), (0.0, 1.0)])
def test_without_its_lag_an_arm_stays_near_its_plan(pose: tuple[float, float]) -> None:
    """Held for a second under `severe` without its lag: off by 0.04 rad, rms; at its word, or before, by 0.13 to 0.2.

    With the lag it does as well as at its word, to a half.
    """
    robot, plan, problem = held(*pose)
    plant = ls.Plant(robot, robot.scene)
    given = preset("severe", plant)
    told = ls.uncertainty_of(plant, given)
    law, word = (ls.OffsetFree(problem, plan, told, memory=memory) for memory in (None, np.inf))
    assert word.model.uncertainty.lag == told.lag

    def off(controller: ls.OffsetFree, times: float) -> float:
        met = [one.scaled(times) if isinstance(one, MotorLag) else one for one in given]
        run = ls.simulate(plant, plan, controller=controller, disturbances=met, trials=10, frames=False, contacts=False)
        return float(np.sqrt(((run.states - plan.trajectory.states)[:, 20:, :2] ** 2).mean()))

    assert off(word, 0.0) > 0.1
    assert off(law, 0.0) < 0.06
    assert off(law, 1.0) < 1.5 * off(word, 1.0)


def held(shoulder: float, elbow: float) -> tuple[ls.MjcfRobot, ls.Solution, ls.Problem]:
    """An arm of two links, held still against gravity for a second."""
    xml = arm(
        0.4, 0.35, names=("shoulder", "elbow"), joint='axis="0 -1 0" damping="0.5" armature="0.02"', limits=(20, 8)
    )
    robot = ls.MjcfRobot(scene_from_xml(xml, "two_links"))
    state, steps, dt = robot.at(shoulder=shoulder, elbow=elbow), 50, 0.02
    plan = ls.Trajectory(np.tile(state, (steps + 1, 1)), np.tile(robot.hold(state), (steps, 1)), dt)
    return robot, open_loop(robot.dynamics, plan), robot.problem(state, state, steps=steps, dt=dt)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("lag", [0.0, np.finfo(np.float64).tiny, 0.1, 0.5])
def test_moments_with_another_lag_than_the_filters_are_those_of_runs(seed: int, lag: float) -> None:
    """What a start that is off leaves behind, in NumPy: its covariance is that of the moments, to 1e-9."""
    system = joints(seed, steps=12)
    law = ls.OffsetFree(system.problem, system.solution, told_of(LAG), tolerate=0.5, memory=np.inf)
    only = Uncertainty(unknowns=[Unknown("d0", 0.0)], start=SMALL, lag=lag)
    truth = PlanModel(PlanDerivatives(system.problem.dynamics, system.plan), only)
    limits = np.full(2, -1e6), np.full(2, 1e6)
    offset = law.offset - system.plan.controls + np.einsum("tij,tj->ti", law.gain, law.nominal[:-1])
    found = LinearLoop(truth, law.gain, offset, law.filter.gain, limits, law.model).moments()
    states = run(system, law, lag, SMALL * np.eye(4))
    wanted = np.einsum("tki,tkj->tij", states, states)
    np.testing.assert_allclose(found.covariance[:, :4, :4], wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("level", ["light", "severe"])
def test_designs_that_need_no_lag_are_those_without_margin(level: str, quadrotor: ls.Scenario) -> None:
    """Those of the quadrotor, which do well without it."""
    plant, plan = quadrotor.plant(), ls.smooth(quadrotor.problem)
    told = ls.uncertainty_of(plant, preset(level, plant))
    law = ls.OffsetFree(quadrotor.problem, plan, told)
    assert law.model.uncertainty.lag == told.lag
    assert law.filter.gain.shape == (plan.trajectory.steps + 1, law.model.size, 12)


ACTUATORS: Sequence[tuple[str, bool]] = (
    ("<motor", False),
    ('<position kp="20"', False),
    ('<position kp="20" timeconst="0.05"', True),
    ('<general dyntype="filter" dynprm="0.05"', True),
    ('<general dyntype="filterexact" dynprm="0.05"', True),
    ('<intvelocity kp="5" actrange="-1 1"', True),
)


@pytest.mark.parametrize(("actuator", "own"), ACTUATORS, ids=[one for one, _ in ACTUATORS])
def test_presets_have_no_second_lag(actuator: str, own: bool) -> None:
    """A robot whose actuators have states has their lag in its own model."""
    xml = arm(0.3, names=["turn"], actuators=f'{actuator} joint="turn" ctrlrange="-1 1"/>')
    robot = ls.MjcfRobot(scene_from_xml(xml, "turn"))
    plant = ls.Plant(robot, robot.scene)
    assert bool(robot.activations) == own
    for name in ("light", "severe"):
        kinds = [type(one) for one in preset(name, plant)]
        assert kinds.count(MotorLag) == (not own)
        assert (ls.uncertainty_of(plant, preset(name, plant)).lag > 0) == (not own)
