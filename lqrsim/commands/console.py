"""Functions that the commands share: output, progress, and an early check that the results can be written."""

import contextlib
import os
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lqrsim as ls
from lqrsim import process
from lqrsim.commands import as_json

if TYPE_CHECKING:
    from tqdm import tqdm


LINE_EVERY = 10.0  # s between lines of progress where there is no terminal

# The result that the running command prints with `--json`; None without.
_RESULT: ContextVar[dict[str, Any] | None] = ContextVar("result", default=None)


# The options of `lqrsim solve`, for those of the solver in the texts of remedies.
_OPTIONS = {
    r"\bstart=(solution|\[\.\.\.\])": "--start FILE.npz",
    r'\b(stop|finish)="(\w+)"': r"--\1 \2",
    r"\btime_limit\b": "--time-limit",
    r"\bmax_iterations\b": "--max-iterations",
    r"\bcontrol_limits\b": "--control-limits",
}


def run(command: Any, name: str) -> int:
    """Run a command; returns its exit code. With `--json` it prints one JSON object, and all else to stderr."""
    if not getattr(command, "json", False):
        return command.run()
    result: dict[str, Any] = {"format": f"lqrsim {name}", "version": 1}
    token = _RESULT.set(result)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            result["exit_code"] = command.run()
    finally:
        _RESULT.reset(token)
    print_json(result)
    return result["exit_code"]


def print_json(result: Mapping[str, Any]) -> None:
    """Print one JSON object. Raises process.Unprintable if stdout cannot be written."""
    with process.printing():
        print(as_json.text_of(result), flush=True)


def result(**parts: object) -> None:
    """Add to the output of `--json`; without it, do nothing."""
    output = _RESULT.get()
    if output is not None:
        output.update(parts)


def wants_result() -> bool:
    """Whether `--json` was given, for results that take time to compute."""
    return _RESULT.get() is not None


def save(result: Any, path: Path) -> None:
    """Save a result. An older file of that name is replaced, and the line about it says so."""
    is_older = path.exists()
    wrote(ls.save(result, path), remark=" in place of an older one" if is_older else "")


def wrote(path: Path, *, remark: str = "") -> None:
    """Say that a file or folder was written."""
    say(f"wrote {path}{remark}")
    output = _RESULT.get()
    if output is not None:
        output.setdefault("wrote", []).append(path)


def say(text: str = "") -> None:
    """Print immediately, even to a file or a pipe, and above any progress bar. Raises process.Unprintable."""
    bars = sys.modules.get("tqdm")
    with process.printing():
        if bars is None:
            print(text, flush=True)
        else:
            bars.tqdm.write(text)
            sys.stdout.flush()


def check_output(field: str, path: Path, kind: str = "folder", *, suffixes: Collection[str] = ()) -> None:
    """Check before the work starts that a folder or a file, whose name has to end in a suffix, can be written."""
    from lqrsim.errors import check_path
    from lqrsim.results.archive import excerpt_of

    check_path(field, path, "the path of an output", suffixes=suffixes)
    absolute = (path if kind == "folder" else path.parent).absolute()
    existing = next((place for place in (absolute, *absolute.parents) if os.path.exists(place)), absolute)
    try:
        tempfile.TemporaryFile(dir=existing).close()
        with contextlib.suppress(FileNotFoundError):
            os.lstat(path)  # fails for invalid names
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ls.InputError(f"{field}: got {excerpt_of(path)}, want a {kind} that can be written ({reason})") from None


@contextlib.contextmanager
def keeping(write: Callable[[Any], object]) -> Iterator[None]:
    """Run a block. If Ctrl-C ends it and leaves a partial result, call `write` with that; see `process.keeping`."""
    try:
        yield
    except KeyboardInterrupt as stop:
        if (partial_result := getattr(stop, "found", None)) is not None:
            write(partial_result)
        raise


def solve_and_print(scenario: "ls.Scenario", solver: str = "smooth", **options: object) -> "ls.Solution":
    """Solve a scenario; print iterations as they end, then the status. The options are the solver's.

    Of the hundredth to the thousandth iteration every tenth is printed, then every hundredth, and so on.
    """
    from lqrsim.results.solution_parts import Iteration
    from lqrsim.scenarios import solutions

    count = 0

    def show(iteration: Iteration) -> None:
        nonlocal count
        count += 1
        if count % 10 ** max(len(str(count)) - 2, 0) == 0:
            say(iteration.row(count))

    say(Iteration.HEADER)
    solution = solutions.solve(scenario, solver, callback=show, **options)
    say(summary_of(solution))
    return solution


def summary_of(solution: "ls.Solution") -> str:
    """The summary of a solution, whose remedy has the options of `lqrsim solve` where it has those of the solver."""
    remedy = solution.remedy
    for pattern, option in _OPTIONS.items():
        remedy = re.sub(pattern, option, remedy)
    return replace(solution, remedy=remedy).summary()


def load_with_scenario(path: Path, named: str | None) -> "tuple[ls.Solution, ls.Scenario]":
    """The solution in a file, and its scenario: the named one, else its own if `lqrsim list` has it."""
    from lqrsim.scenarios.references import resolve

    solution = ls.load(path, ls.Solution)
    if not named and not solution.scenario:
        raise ls.InputError("--scenario: got none, and the solution names none, want the one with robot and scene")
    return solution, resolve(named or solution.scenario, registered_only=not named).with_duration_of(solution)


def bar(**options: Any) -> "tqdm[Any]":
    """A progress bar, with the options of tqdm."""
    from tqdm import tqdm

    # tqdm's own lock also locks processes: it is a named semaphore, about which Python complains if a signal ends this
    # process.
    tqdm.set_lock(threading.RLock())
    return tqdm(**options)


class Progress:
    """The progress of some work: a bar on a terminal, elsewhere occasional lines. Call it with the amount done.

    The first call starts the clock: preparations before it, such as compiling, do not count.
    """

    def __init__(self, what: str, unit: str) -> None:
        self._what, self._unit = what, unit
        self._watched = sys.stderr.isatty()
        self._bar: tqdm[Any] | None = None
        self._begun = self._last_line = 0.0
        self._before = 0

    def __call__(self, done: int, total: int, status: str = "") -> None:
        """Show that `done` of `total` are done, and the result so far."""
        now = time.monotonic()
        if self._bar is None:
            self._begun, self._last_line, self._before = now, now, done
            options: dict[str, Any] = {"initial": done, "leave": False, "delay": 1.0, "disable": not self._watched}
            self._bar = bar(desc=self._what, unit=f" {self._unit}s", total=total, **options)
            if 1 < done < total:  # a campaign that is resumed
                say(f"{done} of {total} {self._unit}s are done, {total - done} to go")
        self._bar.set_postfix_str(status, refresh=False)
        self._bar.update(done - self._bar.n)
        last = done == total and now - self._begun > LINE_EVERY
        if self._watched or not (now - self._last_line > LINE_EVERY or last):
            return
        self._last_line = now
        line = f"{self._what}: {done} of {total} {self._unit}s"
        if done > self._before:
            rate = (done - self._before) / (now - self._begun)
            line += f", {rate:.3g} {self._unit}s/s, {self._bar.format_interval((total - done) / rate)} left"
        say(line + (f"; {status}" if status else ""))

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()


def progress(what: str, unit: str) -> contextlib.AbstractContextManager[Progress]:
    """Progress during a block."""
    return contextlib.closing(Progress(what, unit))
