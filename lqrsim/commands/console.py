"""What the commands share: what they print, progress, and an early look at whether the outputs can be written."""

import contextlib
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from lqrsim import process
from lqrsim.commands import as_json
from lqrsim.errors import InputError
from lqrsim.results.archive import excerpt_of

if TYPE_CHECKING:
    from lqrsim.results.solution import Solution
    from lqrsim.results.solution_parts import Iteration
    from lqrsim.scenarios.packaged import Scenario

# What the command that runs has to print with `--json`; None without.
_RESULT: ContextVar[dict[str, Any] | None] = ContextVar("result", default=None)


class Runnable(Protocol):
    """A command."""

    def run(self) -> int: ...


def run(command: Runnable) -> int:
    """Run a command; with `--json` its result is all that is printed, and everything else goes to stderr.

    Returns:
      The exit code.

    Raises:
      InputError: the command's. Nothing is printed then.
      process.Unprintable: it cannot be written.
    """
    if not getattr(command, "json", False):
        return command.run()
    result: dict[str, Any] = {"format": f"lqrsim {type(command).__name__.lower()}", "version": 1}
    token = _RESULT.set(result)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            result["exit_code"] = command.run()
    finally:
        _RESULT.reset(token)
    with process.printing():
        print(as_json.text_of(result), flush=True)
    return result["exit_code"]


def result(**parts: object) -> None:
    """Add to what `--json` prints; nothing without it."""
    found = _RESULT.get()
    if found is not None:
        found.update(parts)


def wants_result() -> bool:
    """Whether it is asked for, where it takes time to make."""
    return _RESULT.get() is not None


def wrote(path: Path) -> None:
    """Say that a file or folder was written."""
    say(f"wrote {path}")
    found = _RESULT.get()
    if found is not None:
        found.setdefault("wrote", []).append(path)


def say(text: str = "") -> None:
    """Print at once, also where the output goes to a file or a pipe, and above any progress bar.

    Raises:
      process.Unprintable: it cannot be written.
    """
    bars = sys.modules.get("tqdm")
    with process.printing():
        if bars is None:
            print(text, flush=True)
        else:
            bars.tqdm.write(text)
            sys.stdout.flush()


def check_output(field: str, folder: Path, name: str = "") -> None:
    """Find out before the work starts whether `folder`, or a file of that name in it, can be written.

    Raises:
      InputError: it cannot.
    """
    existing = folder.absolute()
    while not os.path.exists(existing) and existing != existing.parent:
        existing = existing.parent
    try:
        tempfile.TemporaryFile(dir=existing).close()
        with contextlib.suppress(FileNotFoundError):
            os.lstat(folder / name)  # fails otherwise for what no file can be called
    except (OSError, ValueError) as error:
        reason, what = getattr(error, "strerror", None) or error, "file" if name else "folder"
        place = excerpt_of(folder / name)
        raise InputError(f"{field}: got {place}, want a {what} that can be written ({reason})") from None


def solve(scenario: "Scenario", solver: str = "smooth", **options: object) -> "Solution":
    """Solve a scenario; print each iteration as it ends, then the status. The options are those of the solver."""
    from lqrsim.results.solution_parts import Iteration
    from lqrsim.scenarios import solutions

    count = 0

    def show(iteration: "Iteration") -> None:
        nonlocal count
        count += 1
        say(iteration.row(count))

    say(Iteration.HEADER)
    solution = solutions.solve(scenario, solver, callback=show, **options)
    say(solution.summary())
    return solution


@contextlib.contextmanager
def progress(what: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on a terminal, one line elsewhere, for what takes long; call it with how many are done of all."""
    from tqdm import tqdm

    watched = sys.stderr.isatty()
    begun = time.monotonic()
    announced = False
    with tqdm(desc=what, unit=unit, leave=False, delay=1.0, disable=not watched) as bar:

        def update(done: int, total: int) -> None:
            nonlocal announced
            bar.total = total
            bar.update(done - bar.n)
            if not (watched or announced) and time.monotonic() - begun > 1.0:
                announced = True
                say(f"{what} {total} {unit}s ...")

        yield update


@contextlib.contextmanager
def long_progress(what: str, unit: str, every: float = 10.0) -> Iterator[Callable[[int, int], None]]:
    """For what takes minutes or hours, and may have been begun before: how fast it goes, and how long it will take.

    A bar on a terminal; elsewhere a line now and then. The first call says how many are done already, and starts the
    clock: what is prepared before it, such as compiling, is not counted.
    """
    from tqdm import tqdm

    watched = sys.stderr.isatty()
    bar: tqdm[Any] | None = None
    begun = last_line = 0.0
    before = 0
    with contextlib.ExitStack() as stack:

        def update(done: int, total: int) -> None:
            nonlocal bar, begun, before, last_line
            now = time.monotonic()
            if bar is None:
                begun, last_line, before = now, now, done
                options: dict[str, Any] = {"initial": done, "leave": False, "delay": 1.0, "disable": not watched}
                bar = stack.enter_context(tqdm(desc=what, unit=f" {unit}s", total=total, **options))
                if done and done < total:
                    say(f"{done} of {total} {unit}s are there, {total - done} to go")
            bar.update(done - bar.n)
            finished = done == total and now - begun > every
            if not watched and done > before and (now - last_line > every or finished):
                last_line = now
                rate = (done - before) / (now - begun)
                left = tqdm.format_interval((total - done) / rate)
                say(f"{what}: {done} of {total} {unit}s, {rate:.3g} {unit}s/s, {left} left")

        yield update
