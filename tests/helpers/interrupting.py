"""Ctrl-C for a command in a process of its own, at some point of its progress."""

import signal
import subprocess
import sys

# The command as it is, which says at each step of its progress how far it is.
TELLING = """
import sys

from lqrsim.cli import main
from lqrsim.commands import console

console.Progress.__call__ = lambda self, done, total, found="": print(f"{done} of {total}; {found}", flush=True)
sys.exit(main())
"""


def interrupted(arguments: list[str], at: str) -> tuple[int, str, str]:
    """Run `lqrsim` with the arguments, and send SIGINT when its progress, "DONE of TOTAL", begins with `at`.

    Returns:
      Its exit code, what it printed from then on, and stderr.
    """
    words = [sys.executable, "-c", TELLING, *arguments]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        while not (line := process.stdout.readline()).startswith(at):
            assert process.poll() is None, line
        process.send_signal(signal.SIGINT)
        printed, error = process.communicate(timeout=60)
    return process.returncode, printed, error
