"""The solvers of the league: each is told a problem and what to begin with, and says when it had come how far."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from altro_problems import missed
from peers.box_fddp import BoxFddp
from peers.shooting import TOLERANCE, Moment, Shooting

import lqrsim as ls
from league.problems import Start
from league.verification import VIOLATION, rolled_out
from lqrsim.errors import Array

Enough = Callable[[Moment], bool]


@dataclass(frozen=True)
class Run:
    """What came of a solve.

    Attributes:
      plan: what was returned. cost: of it, as the solver has it, with the price of a free duration.
      status: how it says that it ended. solved: whether that is a success.
      exact: when its own measure of optimality was below TOLERANCE; None if never.
      first: the first moment that is enough; None if there is none.
    """

    plan: ls.Trajectory
    cost: float
    status: str
    solved: bool
    exact: Moment | None
    first: Callable[[Enough], Moment | None]


Solve = Callable[[ls.Problem, Start], Run]


def _ours(solver: Callable[..., ls.Solution], problem: ls.Problem, *, compile: bool, **options: Any) -> Solve:
    """`ls.smooth` or `ls.ilqr`. The time is that of the iterations."""
    if solver is ls.ilqr and problem.constraints:
        raise NotImplementedError("constraints")
    if problem.duration is not None:
        if solver is ls.ilqr or options.get("finish", "newton") is None:
            raise NotImplementedError("a free duration")
        return _ours_in_free_time(partial(solver, **options))

    def solve(problem: ls.Problem, start: Start) -> Run:
        solution = solver(problem, start=start, **options)
        seconds = np.cumsum([one.seconds for one in solution.iterations]).tolist()
        moments = [
            Moment(number, when, one.cost, missed(one))
            for number, (when, one) in enumerate(zip(seconds, solution.iterations, strict=True), 1)
        ]
        exact = (
            moment
            for moment, one in zip(moments, solution.iterations, strict=True)
            if solution.success and one.optimality <= TOLERANCE and missed(one) < VIOLATION
        )
        return Run(
            plan=solution.trajectory, cost=solution.cost, status=solution.status.name, solved=solution.success,
            exact=next(exact, None), first=partial(_first, moments),
        )  # fmt: skip

    return solve


def _ours_in_free_time(solver: Callable[..., ls.Solution]) -> Solve:
    """With a free duration. Of its iterations, those with the stated one among them, the end alone is compared.

    The price of time is not in the costs of all of them.
    """

    def solve(problem: ls.Problem, start: Start) -> Run:
        log: list[ls.types.Iteration] = []
        solution = solver(problem, start=start, callback=log.append)
        cost = solution.cost + problem.time_weight * solution.trajectory.horizon
        end = Moment(len(log), sum(one.seconds for one in log), cost, solution.violation)
        return Run(
            plan=solution.trajectory, cost=cost, status=solution.status.name, solved=solution.success,
            exact=end if solution.success and solution.optimality <= TOLERANCE else None, first=partial(_first, [end]),
        )  # fmt: skip

    return solve


def _search(problem: ls.Problem, *, compile: bool) -> Solve:
    """`ls.smooth` with starts of its own, all of whose iterations count."""
    if problem.duration is not None:
        raise NotImplementedError("a free duration")
    try:
        ls.smooth(problem, max_iterations=1)
    except ls.InputError as error:
        raise NotImplementedError("dynamics without derivatives at the nominal control") from error

    def solve(problem: ls.Problem, start: Start) -> Run:
        log: list[ls.types.Iteration] = []
        solution = ls.smooth(problem, constraint_tolerance=VIOLATION, threads=1, callback=log.append)
        # Starts that are dropped after a few iterations tell the callback nothing. They come first.
        dropped = max(sum(one.iterations for one in solution.candidates) - len(log), 0)
        seconds = np.cumsum([log[0].seconds * dropped, *(one.seconds for one in log)])[1:].tolist()
        moments = [
            Moment(dropped + number, when, one.cost, missed(one))
            for number, (when, one) in enumerate(zip(seconds, log, strict=True), 1)
        ]
        exact = solution.success and solution.optimality <= TOLERANCE and solution.violation < VIOLATION
        return Run(
            plan=solution.trajectory, cost=solution.cost, status=solution.status.name, solved=solution.success,
            exact=moments[-1] if exact else None, first=partial(_first, moments),
        )  # fmt: skip

    return solve


def _first(moments: list[Moment], enough: Enough) -> Moment | None:
    return next((moment for moment in moments if enough(moment)), None)


def _shooting(plugin: Literal["ipopt", "fatrop"], problem: ls.Problem, *, compile: bool) -> Solve:
    solver = Shooting(problem, plugin, compile=compile)

    def solve(problem: ls.Problem, start: Start) -> Run:
        guess = _guess(problem, start)
        begun = time.perf_counter()
        answer = solver.solve(problem, *guess)
        seconds = time.perf_counter() - begun
        dt = problem.dt if answer.duration is None else answer.duration / problem.steps
        return Run(
            plan=ls.Trajectory(answer.states, answer.controls, dt), cost=answer.cost,
            status="solved" if answer.converged else "failed", solved=answer.converged,
            exact=Moment(answer.iterations, seconds, answer.cost, 0.0) if answer.converged else None,
            first=partial(solver.first, problem, *guess, answer.iterations),
        )  # fmt: skip

    return solve


def _box_fddp(problem: ls.Problem, *, compile: bool) -> Solve:
    solver = BoxFddp(problem)

    def solve(problem: ls.Problem, start: Start) -> Run:
        answer, moments = solver.solve(problem, *_guess(problem, start))
        return Run(
            plan=ls.Trajectory(answer.states, answer.controls, problem.dt), cost=answer.cost,
            status="converged" if answer.converged else "failed", solved=answer.converged,
            exact=moments[-1] if answer.converged else None, first=partial(_first, moments),
        )  # fmt: skip

    return solve


def _guess(problem: ls.Problem, start: Start) -> tuple[Array, Array]:
    """States and controls to begin with: of controls, where they lead."""
    if isinstance(start, ls.Trajectory):
        return start.states, start.controls
    return rolled_out(problem, start), start


_smooth = partial(_ours, ls.smooth, constraint_tolerance=VIOLATION, threads=1)

SEARCH = "lqrsim, search"  # begins with starts of its own, where others begin with the one they are given

# How each is made for problems of a kind. It raises peers.Unavailable where it is not installed, and
# NotImplementedError where it does not take such problems.
CONTESTANTS: dict[str, Callable[..., Solve]] = {
    "lqrsim": _smooth,
    SEARCH: _search,
    "lqrsim, no finish": partial(_smooth, finish=None, tolerance=TOLERANCE),
    "ilqr": partial(_ours, ls.ilqr, tolerance=TOLERANCE),
    "box-FDDP": _box_fddp,
    "FATROP": partial(_shooting, "fatrop"),
    "IPOPT": partial(_shooting, "ipopt"),
}
