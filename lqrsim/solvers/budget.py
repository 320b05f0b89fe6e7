"""The budget of a solve: time, iterations, threads, and requests by the caller to stop."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np

from lqrsim.annotations import Want
from lqrsim.codegen.compiled_module import compilations
from lqrsim.codegen.user_functions import UserFunction, interrupt_of
from lqrsim.errors import check_count
from lqrsim.kernels.records import StructuredArray
from lqrsim.machine import processors
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Iteration, Status

Callback = Annotated[Callable[[Iteration], object], Want("a function of an Iteration")]

_log = logging.getLogger("lqrsim")
ATTENTION = 0.1  # s, after which compiled code returns to check for Ctrl-C
SILENT = 2.0  # s without a message after which a solve reports its progress; later reports come at growing intervals
SELDOM = 60.0  # s
SHORTEST = 1e-3  # s, the least time between two looks at what is reported
MOST_THREADS = 1024
NOTED = 10.0  # compiling is mentioned if it takes longer than the time limit divided by this


@dataclass
class Stop:
    """What all runs of a solve share: its caller's callback and threads, and the reason to end early.

    The reason is a deadline on the clock of `time.perf_counter`, or an exception. An exception of the callback, or
    Ctrl-C, ends a solve like a deadline, with the best plan so far. `deliver` raises it again, with that plan as its
    `solution`.
    """

    callback: Callback | None = None  # called with the iterations of runs that are finished
    threads: int = 1  # for the choice among starts, and for derivatives along a trajectory
    # Whether compiled code returns regularly, so that Ctrl-C ends it. If many problems are solved at once, it does not.
    attentive: bool = False
    deadline: float = np.inf
    begun: float = field(default_factory=time.perf_counter)
    error: BaseException | None = None
    # Expected duration of the next iteration in s: an iteration that would end after the deadline is not begun. By
    # default it is the duration of the last iteration.
    reserve: float = 0.0
    pace: float = 0.0
    # For all runs: the number of iterations, the last iteration, and the time at which the callback was last called.
    iterations: int = 0
    last: Iteration | None = None
    called: float = -np.inf
    _stopped: float | None = None  # when the clock was stopped, if it does not count now

    def begin(self, seconds: float | None) -> None:
        """Start the clock, with a deadline this many seconds from now; None for no deadline."""
        self.begun = time.perf_counter()
        self.deadline = np.inf if seconds is None else self.begun + seconds

    @contextlib.contextmanager
    def not_counting(self) -> Iterator[None]:
        """A block that may compile, whose time does not count. If it compiles for long, a log line says so."""
        if self._stopped is not None:  # within another
            yield
            return
        began, limit, compiled = time.perf_counter(), self.deadline - self.begun, len(compilations)
        self._stopped = began
        try:
            yield
        finally:
            self._stopped = None
            seconds = time.perf_counter() - began
            self.begun += seconds
            self.deadline += seconds
            if len(compilations) > compiled and np.inf > limit < NOTED * seconds:
                _log.warning("compiled in %.1f s, which the time_limit of %g s does not count", seconds, limit)

    @property
    def elapsed(self) -> float:
        return time.perf_counter() - self.begun

    @property
    def due(self) -> bool:
        return self.error is not None or time.perf_counter() + (self.reserve or self.pace) >= self.deadline

    @property
    def progress(self) -> str:
        """The progress of the solve as text: the results so far, and the time that is left."""
        now, last = time.perf_counter() if self._stopped is None else self._stopped, self.last
        left = "" if self.deadline == np.inf else f"; at most {max(self.deadline - now, 0.0):.0f} s left"
        if last is None:
            return f"in the first iteration{left}"
        parts = [f"iteration {self.iterations}: {last.method}"]
        for name, value in (("cost", last.cost), ("violation", last.violation)):
            if value and not np.isnan(value):
                parts.append(f"{name} {value:.4g}")
        return ", ".join(parts) + left

    def reporting(self, what: str) -> contextlib.AbstractContextManager[None]:
        """A block that reports the progress if the caller hears nothing for long, unless many problems are solved."""
        if not self.attentive:
            return contextlib.nullcontext()
        return reported(what, lambda: self.progress, lambda: self.called, self.begun)

    @contextlib.contextmanager
    def heeding(self) -> Iterator[None]:
        """A block whose exception, even Ctrl-C, is kept; `deliver` raises it."""
        try:
            yield
        except BaseException as error:
            self.error = error

    def deliver(self, solution: Solution) -> Solution:
        """Return the solution; or raise the exception that ended the solve, with the solution attached."""
        if self.error is None:
            return solution
        with contextlib.suppress(AttributeError, TypeError):  # some exceptions take no attributes
            self.error.solution = replace(solution, status=Status.INTERRUPTED, remedy=Status.INTERRUPTED.remedy)  # pyright: ignore[reportAttributeAccessIssue]
            self.error.add_note("lqrsim: the best plan so far is this exception's `solution`")
        raise self.error


class Budget:
    """Iterations, time and callback of one run. Runs of one solve share a `Stop`; each has its own iterations."""

    def __init__(self, most: int, stop: Stop | None = None) -> None:
        self._most, self._callback, self._reported = most, None, 0
        self.stop = Stop() if stop is None else stop
        self.log: list[Iteration] = []  # the iterations so far, by any method

    @property
    def left(self) -> int:
        return max(self._most - len(self.log), 0)

    @property
    def over(self) -> bool:
        return self.stop.due or not self.left

    @property
    def watched(self) -> bool:
        return self._callback is not None

    @property
    def hurried(self) -> bool:
        """Whether compiled code must return after each iteration: for a callback, or for a deadline."""
        return self.watched or self.stop.deadline < np.inf

    def record(self, iteration: Iteration) -> None:
        self.log.append(iteration)
        self.stop.iterations, self.stop.last = self.stop.iterations + 1, iteration
        self._call((iteration,))

    def report(self) -> None:
        """Call the callback with the iterations so far, and from now on with each: this run goes on to its end."""
        self._callback = self.stop.callback
        self._call(self.log[self._reported :])

    def _call(self, iterations: Iterable[Iteration]) -> None:
        if self._callback is None:
            return
        self._reported = len(self.log)
        self.stop.called = time.perf_counter()
        with self.stop.heeding():
            for iteration in iterations:
                self._callback(iteration)

    @contextlib.contextmanager
    def limited(self, most: int | None) -> Iterator[None]:
        """Temporarily allow at most this number of further iterations; None for as many as before."""
        before, self._most = self._most, self._most if most is None else min(self._most, len(self.log) + most)
        try:
            yield
        finally:
            self._most = before

    @contextlib.contextmanager
    def without_costs(self) -> Iterator[None]:
        """Temporarily treat iterations as iterations of another problem, whose costs are not logged."""
        begin, callback = len(self.log), self._callback

        def hidden(iteration: Iteration) -> Iteration:
            return replace(iteration, cost=np.nan, improvement=np.nan)

        self._callback = None if callback is None else lambda iteration: callback(hidden(iteration))
        try:
            yield
        finally:
            self._callback = callback
            self.log[begin:] = [hidden(iteration) for iteration in self.log[begin:]]

    @contextlib.contextmanager
    def joined_with_last(self, method: str) -> Iterator[None]:
        """Temporarily count a single further iteration, which only evaluates the plan, as part of the last iteration.

        The last of several is joined only if it is one more than are allowed. The callback hears of several at the end.
        """
        begin, callback, self._callback = len(self.log), self._callback, None
        try:
            yield
        finally:
            self._callback = callback
            alone = len(self.log) == begin + 1
            if begin and (alone or len(self.log) > max(begin, self._most)):
                last, look = self.log[-2:]
                self.log[-2:] = [replace(look, method=method, seconds=last.seconds + look.seconds)]
            if not (begin and alone):
                self._call(self.log[begin:])


class Laps:
    """Records iterations of a method with their seconds and their improvements on the previous cost, at first `cost`.

    `ended` is the time of `time.perf_counter` at which the last of them ended.
    """

    def __init__(self, budget: Budget, cost: float = np.inf) -> None:
        self._budget, self._cost, self.ended = budget, cost, time.perf_counter()

    def record(
        self, method: str, cost: float, *, optimality: float, gap: float = 0.0, violation: float = 0.0,
        seconds: float | None = None,
    ) -> None:  # fmt: skip
        """Record an iteration; by default it took all the time since the last one."""
        now, improvement = time.perf_counter(), (self._cost - cost) / max(abs(cost), 1e-300)
        seconds, self._cost, self.ended = now - self.ended if seconds is None else seconds, cost, now
        self._budget.record(Iteration(cost, improvement, gap, optimality, gap, violation, seconds, method))


def in_slices(
    run: Callable[[int, int], Sequence[Any]], log: StructuredArray, watch: Callable[[tuple[Any, ...], float], bool],
    functions: Sequence[UserFunction], attention: float, *, first: int = 0,
) -> Iterator[tuple[Sequence[Any], bool]]:  # fmt: skip
    """Run compiled iterations from `first` on, as long as the log has room for their rows.

    Each slice lasts about `attention` seconds; 0 means one iteration, as always with plain Python functions, infinity
    all. After each slice the result of `run(begin, end)` is yielded, which begins with the number of iterations, and
    whether `watch`, called with a row and the seconds of an iteration, was true for one of its rows.
    """
    last, over = len(log), False
    attention, size = (np.inf, last) if attention == np.inf else (0.0 if functions else attention, 1)
    while not over and first < last:
        begin, clock = first, time.perf_counter()
        ended = run(begin, min(begin + size, last))
        first = ended[0]
        seconds = (time.perf_counter() - clock) / max(first - begin, 1)
        for row in log[begin:first].tolist():
            over = watch(row, seconds) or over
        if error := interrupt_of(functions):
            raise error
        if attention < np.inf:
            size = max(1, int(attention / max(seconds, 1e-9)))
        yield ended, over


class _Watch:
    """The thread that reports progress, one for all activities of the process, for starting one takes long.

    It looks at them at least every `SILENT` seconds, and ends when there was none for as long.
    """

    def __init__(self) -> None:
        self._lock, self._activities = threading.Lock(), list[_Activity]()
        self._thread: threading.Thread | None = None
        self._woken, self._sleeps_until = threading.Event(), 0.0

    @contextlib.contextmanager
    def watching(self, activity: "_Activity") -> Iterator[None]:
        try:
            with self._lock:
                self._activities.append(activity)
                if self._thread is None or not self._thread.is_alive():  # also after a fork
                    self._thread = threading.Thread(target=self._run, name="progress", daemon=True)
                    self._thread.start()
                elif activity.due < self._sleeps_until:
                    self._woken.set()
            yield
        finally:
            with self._lock:
                self._activities.remove(activity)

    def _run(self) -> None:
        idle = False
        while True:
            with self._lock:
                activities = list(self._activities)
                if idle and not activities:
                    self._thread = None
                    return
            idle = not activities
            now = time.perf_counter()
            for activity in activities:
                activity.report(now)
            wait = max(min((activity.due - now for activity in activities), default=SILENT), SHORTEST)
            self._sleeps_until = now + min(wait, SILENT)
            self._woken.wait(min(wait, SILENT))
            self._woken.clear()


@dataclass(eq=False)
class _Activity:
    """What a block of `reported` does: its name, and functions as there; the time of the next report, and the wait."""

    what: str
    progress: Callable[[], str]
    called: Callable[[], float]
    begun: float
    wait: float = field(default_factory=lambda: SILENT)
    due: float = field(default_factory=lambda: time.perf_counter() + SILENT)

    def report(self, now: float) -> None:
        if now < self.due:
            return
        if now - self.called() >= SILENT:
            _log.warning("%s: %.0f s, %s", self.what, now - self.begun, self.progress())
            self.wait = min(2 * self.wait, SELDOM)
        self.due = now + self.wait


_watch = _Watch()


def reported(
    what: str, progress: Callable[[], str], called: Callable[[], float] = lambda: -np.inf, begun: float | None = None
) -> contextlib.AbstractContextManager[None]:
    """A block that reports its progress after two silent seconds, as a warning of the logger `lqrsim`.

    Args:
      what: name of the activity, such as "smooth".
      progress: returns the results so far, and the time that is left, as text.
      called: returns the time at which a callback was last called, on the clock of `time.perf_counter`.
      begun: time at which the activity began, on the same clock; by default now.
    """
    return _watch.watching(_Activity(what, progress, called, time.perf_counter() if begun is None else begun))


@contextlib.contextmanager
def workers(threads: int, functions: Iterable[UserFunction]) -> Iterator[ThreadPoolExecutor]:
    """A pool of threads. After an error or Ctrl-C plain Python functions are told to stop; compiled code ends soon."""
    with ThreadPoolExecutor(threads, thread_name_prefix="lqrsim") as pool:
        try:
            yield pool
        except BaseException:
            for function in functions:
                function.stopped.set()
            pool.shutdown(wait=True, cancel_futures=True)
            for function in functions:
                function.stopped.clear()
            raise


def check_threads(threads: int | None) -> int:
    """Check a number of threads; by default the number of processors. Raises InputError."""
    return processors() if threads is None else check_count("threads", threads, at_most=MOST_THREADS)
