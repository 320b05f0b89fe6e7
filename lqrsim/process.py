"""A command in a process of its own: signals that stop it, and streams that it prints to.

A command that is stopped removes what it has not finished, whichever signal it was: Ctrl-C, `kill`, or a terminal that
is closed. In a process that only uses lqrsim nothing of this happens: signals and streams are the program's own there.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
WAKE = getattr(signal, "SIGURG", signal.SIGINT)  # which nobody else uses, and is ignored where it is not expected
MOST_WAKES = 100
GRACE = 2.0  # s after a signal in which another one means the same, and does not stop the tidying up


class Unprintable(Exception):
    """What is printed cannot be written. No OSError, which is what cannot be written of a command's results."""


class _Signals:
    """What has come to this process.

    Attributes:
      stopped_by: number of the signal that stopped it, 0 for none; and when.
      handled: how many signals. deferring: whether one is to wait, deferred: which one does.
      last_words: are written to stderr as it is stopped.
    """

    handled = 0
    deferring = False
    deferred = 0
    stopped_by = 0
    when = -GRACE
    last_words = ""


def handle_signals(last_words: str = "") -> None:
    """Make this process one that ends as a command does: call it once, before anything that takes time is imported.

    Args:
      last_words: what a signal has it write to stderr, a line.
    """
    _Signals.last_words = last_words
    _fill_streams()
    # Those that are ignored stay so: whoever started this, such as nohup, wants it.
    for number in SIGNALS:
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _end_at_once)
    if hasattr(signal, "pthread_kill"):
        _wake_for_signals()


def _wake_for_signals() -> None:
    """See to it that a signal is handled soon.

    The system may give it to any thread, of OpenBLAS say. Python handles it on the main one, which is not told then: it
    goes on with what it does, and if that is waiting, for as long as it waits. A signal of its own wakes it.
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
            got += sum(number in SIGNALS for number in os.read(arrived, 64))
            for _ in range(MOST_WAKES):
                if _Signals.handled >= got:
                    break
                signal.pthread_kill(main, WAKE)
                time.sleep(0.02)
            got = _Signals.handled  # several of a kind are handled as one

    threading.Thread(target=watch, name="signals", daemon=True).start()


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Within this block a signal raises KeyboardInterrupt, so that what is unfinished is removed."""
    ours = [number for number in SIGNALS if signal.getsignal(number) is _end_at_once]
    for number in ours:
        signal.signal(number, _raise_interrupt)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, _end_at_once)


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """What is done in this block is done as a whole; what would stop it stops it then."""
    _Signals.deferring = True
    try:
        yield
    finally:
        _Signals.deferring = False
        number, _Signals.deferred = _Signals.deferred, 0
        if number:
            _raise_interrupt(number, None)


def run_script(arguments: list[str]) -> None:
    """Run a Python file as a program, with its arguments; what stops it lets it tidy up, and is not told of."""
    handle_signals()
    import runpy

    sys.argv, sys.path[0] = arguments, os.path.dirname(arguments[0])
    try:
        with interruptible():
            runpy.run_path(arguments[0], run_name="__main__")
    except KeyboardInterrupt:
        end_stopped()


def end_stopped() -> NoReturn:
    """End this process, which a signal has stopped, and which has tidied up. Another signal makes no difference now."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    _end_at_once(_Signals.stopped_by or signal.SIGINT, None)


def discard_output() -> None:
    """Let what is still to be printed go nowhere: Python writes it as it ends, and would complain."""
    with contextlib.suppress(OSError, ValueError):  # a stream that is no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_error(text: str) -> None:
    """Print to stderr, if there is anyone who reads it."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def flush() -> None:
    """Write what has been printed, while what goes wrong can still be handled. Raises Unprintable."""
    with printing():
        sys.stdout.flush()


@contextlib.contextmanager
def printing() -> Iterator[None]:
    """Within this block an OSError is one of printing. Raises Unprintable in its place."""
    try:
        yield
    except OSError as error:
        raise Unprintable(error) from error


def _end_at_once(number: int, frame: FrameType | None) -> NoReturn:
    """At once: there is nothing to tidy up."""
    if _Signals.last_words:
        with contextlib.suppress(OSError):
            os.write(2, f"{_Signals.last_words}\n".encode())
    os._exit(128 + number)


def _raise_interrupt(number: int, frame: FrameType | None) -> None:
    _Signals.handled += 1
    if _Signals.deferring:
        _Signals.deferred = number
        return
    repeated = time.monotonic() - _Signals.when < GRACE
    if not repeated:
        _Signals.stopped_by, _Signals.when = number, time.monotonic()
        raise KeyboardInterrupt


def _fill_streams() -> None:
    """What was closed before this began goes nowhere; else the first file that is opened would be printed to."""
    for descriptor, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != descriptor:
                os.dup2(opened, descriptor)
                os.close(opened)
            setattr(sys, name, open(descriptor, mode, encoding="utf-8", closefd=False))  # noqa: SIM115 - it stays open
