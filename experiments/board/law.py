"""The law that is tried: a swing-up plan, solved again on the way, and from anew where it does not lead up any more."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_discrete_are

import lqrsim as ls
from board.double_pendulum import ACTUATED, LIMIT, MODELS, UNKNOWN, UPRIGHT, Robot, advance, dynamics
from board.trials import DT
from lqrsim.errors import Array

PLANNED = 0.02  # s, a step of the plans
EACH = round(PLANNED / DT)  # of the board's steps
AGAIN = 2  # steps of the plan between two solves
SHORTEST = 25  # steps of the plan: from there on it is as long again and again
# The end of a plan, and from SHORTEST on all of it, may cost this, or it does not lead up.
WORST_END, WORST_PLAN = 20.0, 20.0
OBSERVER = 0.3, 20.0  # of an error in the angle, how much of it goes into the angle and, in 1/s, into the velocity


@dataclass(frozen=True, kw_only=True)
class Aim:
    """What plans are for.

    Attributes:
      effort: weight of the torque, a step. state: of each state.
      horizons: s that a swing-up may take. a_second: what one of them is worth.
      blend: whether the laws of two steps of a plan are blended between them, for a smooth torque.
    """

    effort: float
    state: tuple[float, float, float, float]
    horizons: tuple[float, ...]
    a_second: float
    blend: bool = False


ROBUST = Aim(effort=0.1, state=(0.3, 0.3, 0.03, 0.03), horizons=(1.5, 2.0, 2.5), a_second=5.0)
# With less effort a law bears more delay, and less of what is wrong in the model of a double pendulum with a long end.
GENTLE = replace(ROBUST, effort=0.3)


@dataclass
class Plan:
    """What one run goes by: a plan, the step of the plans at which it began, and the turns to upright as it is."""

    law: ls.Solution | ls.types.Replan
    first: int
    turns: tuple[int, int]

    def row(self, step: int) -> int:
        return min(step - self.first, self.law.trajectory.steps - 1)


class SwingUp:
    """Of many runs, each with a plan of its own. It knows the model without what is wrong in the run."""

    def __init__(self, robot: Robot, version: int, count: int, aim: Aim | None = None) -> None:
        self._aim = aim or (GENTLE if (robot, version) == ("pendubot", 1) else ROBUST)
        self._motor, self._dynamics, self._step = ACTUATED[robot], dynamics(robot, version), 0
        self._end = self._cost_to_go()
        self._problems: dict[tuple[int, tuple[int, int]], ls.Problem] = {}
        self._solver = ls.prepare(self._problem(SHORTEST, (0, 0)))
        self._plans: list[Plan | None] = [None] * count
        self._known = {name: np.full(count, value) for name, value in {**MODELS[robot, version], **UNKNOWN}.items()}
        self._state, self._torque = np.zeros((count, 4)), np.zeros(count)
        self._gain, self._offset = np.zeros((count, 4)), np.zeros(count)

    def __call__(self, measured: Array) -> Array:
        """Torques (K,) for measured states (K, 4), once in each of the board's steps."""
        self._observe(measured)
        step, part = divmod(self._step, EACH)
        if part == 0 and step % AGAIN == 0:
            self._plans = [self._planned(plan, x, step) for plan, x in zip(self._plans, self._state, strict=True)]
        if part == 0 or self._aim.blend:
            for run, plan in enumerate(self._plans):
                assert plan is not None
                policy, row, after = plan.law.policy, plan.row(step), plan.row(step + 1)
                share = part / EACH
                self._gain[run] = (1 - share) * policy.gain[row, 0] + share * policy.gain[after, 0]
                self._offset[run] = (1 - share) * policy.offset[row, 0] + share * policy.offset[after, 0]
        self._step += 1
        self._torque = np.clip((self._gain * self._state).sum(axis=1) + self._offset, -LIMIT, LIMIT)
        return self._torque

    def _observe(self, measured: Array) -> None:
        """The state by the model, corrected by the angles: they are exact, and velocities are not."""
        if self._step == 0:
            self._state = measured.copy()
            return
        torques = np.zeros((len(measured), 2))
        torques[:, self._motor] = self._torque
        state = advance(self._state, torques, self._known, DT)
        missed = measured[:, :2] - state[:, :2]
        self._state = state + np.hstack([OBSERVER[0] * missed, OBSERVER[1] * missed])

    def _planned(self, plan: Plan | None, state: Array, step: int) -> Plan:
        """The plan that goes on from a state; another one from anew where that does not lead up."""
        if plan is not None:
            done, steps = step - plan.first, plan.law.trajectory.steps
            balancing = steps - done < SHORTEST
            start = plan.law.shifted(done, horizon="moving" if balancing else "shrinking")
            problem = self._problem(start.trajectory.steps, plan.turns)
            found = self._solver.solve(state, start, problem=problem)
            leads_up = self._missed(found, plan.turns) < WORST_END and np.isfinite(found.cost)
            if leads_up and not (balancing and found.cost > WORST_PLAN):
                return Plan(found, step, plan.turns)
        return self._from_anew(state, step)

    def _from_anew(self, state: Array, step: int) -> Plan:
        """The cheapest swing-up from a state, to upright after as few turns as may be, of a few horizons."""
        turns, found = (state[0] - np.pi) / (2 * np.pi), list[tuple[float, Plan]]()
        for first in sorted({int(np.floor(turns)), int(np.ceil(turns))}):
            to = first, round(state[1] / (2 * np.pi))
            for seconds in self._aim.horizons:
                problem = self._problem(round(seconds / PLANNED), to).from_state(state)
                solution = ls.smooth(problem, starts=1, max_iterations=150, threads=1)
                missed = self._missed(solution, to)
                worth = solution.cost + self._aim.a_second * seconds + (1e4 * missed if missed > WORST_END else 0.0)
                found.append((worth if np.isfinite(worth) else np.inf, Plan(solution, step, to)))
        return min(found, key=lambda one: one[0])[1]

    def _missed(self, law: ls.Solution | ls.types.Replan, turns: tuple[int, int]) -> float:
        off = law.trajectory.states[-1] - _upright(turns)
        with np.errstate(over="ignore"):  # a plan that is no good may end anywhere; what it misses is then infinite
            missed = float(off @ self._end @ off)
        return missed if np.isfinite(missed) else np.inf

    def _problem(self, steps: int, turns: tuple[int, int]) -> ls.Problem:
        if (steps, turns) not in self._problems:
            about = _upright(turns)
            self._problems[steps, turns] = ls.Problem(
                dynamics=self._dynamics, dt=PLANNED, steps=steps, initial=ls.FixedState(np.zeros(4)),
                stage_cost=ls.ControlCost([self._aim.effort]) + ls.QuadraticCost(self._aim.state, about=about),
                final_cost=ls.QuadraticCost(self._end, about=about), control_limits=(-LIMIT, LIMIT),
            )  # fmt: skip
        return self._problems[steps, turns]

    def _cost_to_go(self) -> Array:
        """Of balancing for ever, as the linear-quadratic regulator has it: what a plan's end is worth."""
        h = 1e-5

        def step(x: Array, u: float) -> Array:
            return self._dynamics.step(x, [u], PLANNED)

        A = np.column_stack([(step(UPRIGHT + e, 0.0) - step(UPRIGHT - e, 0.0)) / (2 * h) for e in h * np.eye(4)])
        B = ((step(UPRIGHT, h) - step(UPRIGHT, -h)) / (2 * h))[:, None]
        return solve_discrete_are(A, B, np.diag(self._aim.state), np.array([[self._aim.effort]]))


def _upright(turns: tuple[int, int]) -> Array:
    return UPRIGHT + 2 * np.pi * np.array([*turns, 0, 0])
