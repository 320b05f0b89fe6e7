"""Settings of the sections, and a time limit."""

import contextlib
import signal
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

from runner import Settings

Section = Literal["api", "files"]


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    sections: tuple[Section, ...] = get_args(Section)
    """What to try."""
    calls: int = 20_000
    """How many hostile calls of the API."""
    mutations: int = 20_000
    """How many spoilt files."""
    seed: int = 0
    """Of all that is spoilt."""
    first: int = 0
    """Number of the first call or file: --first N --calls 1 repeats call N alone, --first N --mutations 1 file N."""
    only: str = ""
    """Only callables with this in their name."""

    def bounded(self) -> "Config":
        """The settings; with `--quick` a fiftieth of the calls and files."""
        few = {"calls": max(1, self.calls // 50), "mutations": max(1, self.mutations // 50)}
        return replace(self, **few) if self.quick else self


class Hang(BaseException):
    """A call or a file took too long."""


@contextlib.contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise Hang after so many seconds of the processor, where the system can."""
    if not hasattr(signal, "SIGPROF"):  # Windows
        yield
        return

    def hung(*_: object) -> None:
        raise Hang(f"more than {seconds:g} s")

    before = signal.signal(signal.SIGPROF, hung)
    signal.setitimer(signal.ITIMER_PROF, seconds, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
