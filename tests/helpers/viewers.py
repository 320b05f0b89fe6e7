"""A viewer without a window, and `lqrsim view` in a process of its own."""

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from lqrsim.codegen import disk_cache
from lqrsim.errors import Array
from lqrsim.view.viewer import Viewer


class Recorder(Viewer):
    """A viewer without a window: it records what it shows, and closes after a number of frames."""

    def __init__(self, frames: int, **options: object) -> None:
        super().__init__(speed=100.0, **options)  # pyright: ignore[reportArgumentType] of `arguments_for_plant`
        self.count, self.shown, self.errors, self.act = frames, [], [], lambda time: None
        self.shown: list[Array]
        self.errors: list[float]
        self.act: Callable[[float], object]

    def refresh(self) -> bool:
        return len(self.shown) < self.count

    def show(self, time: float, qpos: Array) -> Array:
        place = super().show(time, qpos)
        self.shown.append(self.data.qpos.copy())
        self.errors.append(float(np.linalg.norm(place - self.planned_position())))
        self.act(time)
        return place


@contextlib.contextmanager
def viewing(folder: Path, *arguments: str, before: str = "") -> Iterator[subprocess.Popen[str]]:
    """`lqrsim view` in a process of its own, for 20 minutes at most; Ctrl-C ends it.

    Args:
      before: what that process does first.
    """
    code = f"{before}\nimport sys; from lqrsim.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "view", *arguments, "--viewer", "browser", "--seconds", "1200"]
    # MuJoCo keeps the layout of its panels in the home; what is compiled stays where it is.
    environment = {**os.environ, "HOME": str(folder), "LQRSIM_CACHE_DIR": str(disk_cache.folder())}
    environment["PYTHONFAULTHANDLER"] = "1"
    outside = {"cwd": folder, "env": environment}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **outside) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=600)  # keeps reading: a process with a full pipe cannot end
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGABRT)  # its traceback then says where it hangs
                raise AssertionError(f"it did not end with Ctrl-C:\n{process.communicate()[0]}") from None


def said(process: subprocess.Popen[str], text: str) -> str:
    """The output of the process up to this text; waits for it."""
    assert process.stdout is not None
    found = ""
    for line in process.stdout:
        found += line
        if text in line:
            return found
    raise AssertionError(f"{text!r} is not in {found}")


def said_after(process: subprocess.Popen[str], text: str, act: Callable[[int], None]) -> str:
    """The output of the process up to this text; `act(i)` is repeated every few seconds until it comes.

    A browser that has just begun on a busy machine loses keys.
    """
    done = threading.Event()

    def again() -> None:
        for i in itertools.count():
            act(i)
            if done.wait(3.0):
                return

    thread = threading.Thread(target=again, daemon=True)
    thread.start()
    try:
        return said(process, text)
    finally:
        done.set()
        thread.join()
