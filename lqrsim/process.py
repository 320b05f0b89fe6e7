"""Signals and output streams of a command.

A command removes its unfinished files when it is stopped, by Ctrl-C, `kill` or a closed terminal. A program that only
uses lqrsim as a library keeps its own handling of signals and streams.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, NoReturn

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
WAKE = getattr(signal, "SIGURG", signal.SIGINT)  # unused otherwise, and ignored by default
MOST_WAKES = 100
GRACE = 2.0  # s after a signal in which a second signal is ignored, so that it does not stop the tidying up


class Unprintable(Exception):
    """Standard output cannot be written. Not an OSError, which means that a result cannot be written."""


class _Signals:
    """The signals that this process has received."""

    handled = 0  # number of signals that were handled
    stopped_by = 0  # number of the signal that stopped the process, 0 for none
    when = -GRACE  # time at which that signal was handled, in seconds
    arrived = -GRACE  # time at which the last signal arrived; it is handled later if compiled code runs
    ending = 0  # number of the signal with which the process ends, 0 as long as it does not
    last_words = ""  # text for stderr when the process is stopped


def handle_signals(last_words: str = "") -> None:
    """Handle signals as a command does, with last words for stderr. Call it once, before slow imports."""
    _Signals.last_words = last_words
    _fill_streams()
    # Signals that are ignored stay ignored, as nohup requires.
    for number in SIGNALS:
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _end_at_once)
    if hasattr(signal, "pthread_kill"):
        _wake_for_signals()


def _wake_for_signals() -> None:
    """Make sure that signals are handled soon.

    The system may deliver a signal to any thread, such as a thread of OpenBLAS. Python handles it on the main thread,
    which is then not interrupted: if it waits, it continues to wait. A further signal to the main thread wakes it.
    """
    arrived, arrivals = os.pipe()
    os.set_blocking(arrivals, False)
    signal.set_wakeup_fd(arrivals, warn_on_full_buffer=False)
    signal.signal(WAKE, lambda number, frame: None)
    main = threading.main_thread().ident
    assert main is not None

    def watch() -> None:
        got = 0
        while True:
            numbers = os.read(arrived, 64)
            if new := sum(number in SIGNALS for number in numbers):
                _Signals.arrived = time.monotonic()
                got += new
            for _ in range(MOST_WAKES):
                if _Signals.handled >= got:
                    break
                signal.pthread_kill(main, WAKE)
                time.sleep(0.02)
            got = _Signals.handled  # several signals of a kind are handled as one

    threading.Thread(target=watch, name="signals", daemon=True).start()


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """A block in which a signal raises KeyboardInterrupt, so that unfinished files are removed."""
    ours = [number for number in SIGNALS if signal.getsignal(number) is _end_at_once]
    for number in ours:
        signal.signal(number, _raise_interrupt)
    try:
        yield
    except ImportError as error:
        # A module in C++ that is interrupted while it is imported raises an ImportError instead.
        cause = error
        while (cause := cause.__cause__) is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise cause from None
        raise
    finally:
        for number in ours:
            signal.signal(number, _end_at_once)


@contextlib.contextmanager
def on_interrupt(tell: Callable[[], None]) -> Iterator[None]:
    """A block in which another thread calls `tell` as soon as a signal arrives that raises KeyboardInterrupt.

    Python raises it only when compiled code returns; with `tell`, that code can be told to return early. Other signal
    handlers, which may not raise anything, are left alone. Outside of the main thread, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread() or os.name != "posix":
        yield
        return
    arrived, arrivals = os.pipe()
    os.set_blocking(arrivals, False)
    before = signal.set_wakeup_fd(arrivals, warn_on_full_buffer=False)

    def watch() -> None:
        while numbers := os.read(arrived, 64):
            if any(signal.getsignal(number) in (signal.default_int_handler, _raise_interrupt) for number in numbers):
                tell()
            if before >= 0:
                with contextlib.suppress(OSError):
                    os.write(before, numbers)

    watcher = threading.Thread(target=watch, name="interrupts", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before, warn_on_full_buffer=False)
        os.close(arrivals)
        watcher.join()
        os.close(arrived)


@contextlib.contextmanager
def keeping(make: Callable[[Any], Any]) -> Iterator[None]:
    """A block that adds results so far, `make(found of an inner block, or None)`, to an exception, as `found`."""
    try:
        yield
    except BaseException as error:
        error.found = make(getattr(error, "found", None))  # pyright: ignore[reportAttributeAccessIssue]
        raise


@contextlib.contextmanager
def environment(**values: str) -> Iterator[None]:
    """A block in which variables of the environment have these values."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def run_script(arguments: list[str]) -> None:
    """Run a Python file as a program with its arguments; a signal lets it tidy up, and ends it silently."""
    handle_signals()
    import runpy

    sys.argv, sys.path[0] = arguments, os.path.dirname(arguments[0])
    try:
        with interruptible():
            runpy.run_path(arguments[0], run_name="__main__")
    except KeyboardInterrupt:
        end_stopped()


def end_stopped() -> NoReturn:
    """End this process after a signal has stopped it and it has tidied up."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    number = _Signals.stopped_by or signal.SIGINT
    _end_at_once(number, None)
    os._exit(128 + number)  # not reached, which the line before cannot promise as a handler of signals


def discard_output() -> None:
    """Discard further output, which Python would otherwise try to write at exit, and complain."""
    with contextlib.suppress(OSError, ValueError):  # a stream without a file descriptor
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_error(text: str) -> None:
    """Print to stderr, if it can be written."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def flush() -> None:
    """Flush standard output while errors can still be handled. Raises Unprintable."""
    with printing():
        sys.stdout.flush()


@contextlib.contextmanager
def printing() -> Iterator[None]:
    """A block in which an OSError is raised as Unprintable."""
    try:
        yield
    except OSError as error:
        raise Unprintable(error) from error


def _end_at_once(number: int, frame: FrameType | None) -> None:
    """End the process at once, because there is nothing to tidy up."""
    if _Signals.ending:  # this signal came during the last words, and the call that it interrupted goes on
        return
    _Signals.ending = number
    if _Signals.last_words:
        with contextlib.suppress(OSError):
            os.write(2, f"{_Signals.last_words}\n".encode())
    os._exit(128 + number)


def _raise_interrupt(number: int, frame: FrameType | None) -> None:
    _Signals.handled += 1
    came = _Signals.arrived if _Signals.arrived > _Signals.when else time.monotonic()
    repeated = came - _Signals.when < GRACE
    if not repeated:
        _Signals.stopped_by, _Signals.when = number, time.monotonic()
        raise KeyboardInterrupt


def _fill_streams() -> None:
    """Open closed standard streams on the null device; otherwise the next opened file would take their place."""
    for descriptor, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != descriptor:
                os.dup2(opened, descriptor)
                os.close(opened)
            setattr(sys, name, open(descriptor, mode, encoding="utf-8", closefd=False))  # noqa: SIM115 - it stays open
