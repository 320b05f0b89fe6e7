"""The solvers of the league: each is told a problem and what to begin with, and says when it had come how far."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np
from altro_problems import missed
from peers.box_fddp import BoxFddp
from peers.shooting import TOLERANCE, Moment, Shooting

import lqrsim as ls
from league.problems import Start
from league.verification import VIOLATION, rolled_out
from lqrsim.errors import Array

T = TypeVar("T")

REPEATS, LITTLE = 5, 1.0  # calls of which the shortest counts; seconds of processor time after which none follows

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
    """`ls.smooth` or `ls.ilqr`."""
    if solver is ls.ilqr and problem.constraints:
        raise NotImplementedError("constraints")
    if problem.duration is not None:
        if solver is ls.ilqr or options.get("finish", "newton") is None:
            raise NotImplementedError("a free duration")
        return _ours_in_free_time(partial(solver, **options))

    def solve(problem: ls.Problem, start: Start) -> Run:
        solution, took = _timed(lambda: solver(problem, start=start, **options))
        moments = _moments(solution.iterations, took)
        exact = (
            replace(moment, seconds=took.processor)
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
        solution, took = _timed(lambda: solver(problem, start=start, callback=_emptied(log)))
        cost = solution.cost + problem.time_weight * solution.trajectory.horizon
        end = Moment(len(log), took.processor, cost, solution.violation)
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
        solution, took = _timed(
            lambda: ls.smooth(problem, constraint_tolerance=VIOLATION, threads=1, callback=_emptied(log))
        )
        # Starts that are dropped after a few iterations tell the callback nothing. They come first.
        dropped = max(sum(one.iterations for one in solution.candidates) - len(log), 0)
        moments = _moments(log, took, dropped)
        exact = solution.success and solution.optimality <= TOLERANCE and solution.violation < VIOLATION
        return Run(
            plan=solution.trajectory, cost=solution.cost, status=solution.status.name, solved=solution.success,
            exact=moments[-1] if exact else None, first=partial(_first, moments),
        )  # fmt: skip

    return solve


@dataclass(frozen=True)
class _Took:
    """The processor time and the time by the clock of a call, in seconds."""

    processor: float
    wall: float


def _timed(call: Callable[[], T]) -> tuple[T, _Took]:
    """What a call returns, and the least processor time of up to REPEATS calls, as many as take little together."""
    calls: list[tuple[T, _Took]] = []
    while not calls or (len(calls) < REPEATS and sum(took.processor for _, took in calls) < LITTLE):
        processor, wall = time.process_time(), time.perf_counter()
        returned = call()
        calls.append((returned, _Took(time.process_time() - processor, time.perf_counter() - wall)))
    return calls[-1][0], min((took for _, took in calls), key=lambda took: took.processor)


def _moments(log: Sequence[ls.types.Iteration], took: _Took, before: int = 0) -> list[Moment]:
    """The moment after each iteration, which follow `before` others: all of the call but what came later counts."""
    later = np.cumsum([0.0, *(one.seconds for one in reversed(log))])[-2::-1]
    share = np.maximum(1 - later / took.wall, 0)
    return [
        Moment(before + number, took.processor * float(part), one.cost, missed(one))
        for number, (part, one) in enumerate(zip(share, log, strict=True), 1)
    ]


def _emptied(log: list[ls.types.Iteration]) -> Callable[[ls.types.Iteration], None]:
    """The callback that writes a log of the call that it is given to."""
    log.clear()
    return log.append


def _first(moments: list[Moment], enough: Enough) -> Moment | None:
    return next((moment for moment in moments if enough(moment)), None)


def _shooting(plugin: Literal["ipopt", "fatrop"], problem: ls.Problem, *, compile: bool, **settings: Any) -> Solve:
    solver = Shooting(problem, plugin, compile=compile, **settings)

    def solve(problem: ls.Problem, start: Start) -> Run:
        guess = _guess(problem, start)
        answer, took = _timed(lambda: solver.solve(problem, *guess))
        dt = problem.dt if answer.duration is None else answer.duration / problem.steps
        return Run(
            plan=ls.Trajectory(answer.states, answer.controls, dt), cost=answer.cost,
            status="solved" if answer.converged else "failed", solved=answer.converged,
            exact=Moment(answer.iterations, took.processor, answer.cost, 0.0) if answer.converged else None,
            first=partial(solver.first, problem, *guess, answer.iterations),
        )  # fmt: skip

    return solve


def _box_fddp(problem: ls.Problem, *, compile: bool) -> Solve:
    solver = BoxFddp(problem)

    def solve(problem: ls.Problem, start: Start) -> Run:
        guess = _guess(problem, start)
        (answer, moments), took = _timed(lambda: solver.solve(problem, *guess))
        share = took.processor / moments[-1].seconds if moments else 1.0  # its own are by the clock, and of one call
        moments = [replace(moment, seconds=share * moment.seconds) for moment in moments]
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

FATROPS = ("FATROP", "FATROP, mu_init 100")  # the default first barrier parameter of 0.1, and that of older versions
SEARCH = "lqrsim, search"  # begins with starts of its own, where others begin with the one they are given

# How each is made for problems of a kind. It raises peers.Unavailable where it is not installed, and
# NotImplementedError where it does not take such problems.
CONTESTANTS: dict[str, Callable[..., Solve]] = {
    "lqrsim": _smooth,
    SEARCH: _search,
    "lqrsim, no finish": partial(_smooth, finish=None, tolerance=TOLERANCE),
    "ilqr": partial(_ours, ls.ilqr, tolerance=TOLERANCE),
    "box-FDDP": _box_fddp,
    FATROPS[0]: partial(_shooting, "fatrop"),
    FATROPS[1]: partial(_shooting, "fatrop", mu_init=100.0),
    "IPOPT": partial(_shooting, "ipopt"),
}
