"""The command line; `lqrsim COMMAND --help` documents each command."""

import collections
import contextlib
import io
import itertools
import logging
import os
import shutil
import sys
from collections.abc import Sequence
from typing import Any

from lqrsim import process

LEAST_MEMORY = 1_000_000_000  # bytes of address space, of which a short run takes some 800 MB on two processors
NARROWEST = 20  # columns of a terminal for which help and errors are laid out

DESCRIPTION = """Feedback policies by iterated LQR smoothing, executed in MuJoCo under
disturbances and shown on video.

`lqrsim demo` runs the whole chain for both robots. Step by step, each command
reads what the one before wrote:
  lqrsim solve quadrotor --out runs/quadrotor
  lqrsim simulate runs/quadrotor/solution.npz --force-noise 0.1 --seed 1
  lqrsim render runs/quadrotor/rollout.npz
  lqrsim verify runs/quadrotor/rollout.npz

commands:
{commands}

`lqrsim COMMAND --help` documents each command, `lqrsim --version` prints the
version. Exit codes: 0 done, 1 not converged or a check failed, 2 bad input,
130 stopped with Ctrl-C, 141 output pipe closed. With --json a command prints
one JSON object, and everything else goes to stderr."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
      arguments: the words after `lqrsim` on the command line. By default the arguments of this process, which then
        handles signals as a command does: it removes unfinished files and ends.

    Returns:
      The exit code: 0 done; 1 not converged or out of bounds; 2 bad input, or standard output cannot be written;
      130 stopped by Ctrl-C, 143 by SIGTERM; 141 standard output was closed.
    """
    as_command = arguments is None
    if as_command:
        process.handle_signals("lqrsim: stopped")
    try:
        try:
            code = _run(list(sys.argv[1:] if arguments is None else arguments))
        except SystemExit:  # after --help, and for arguments that cannot be parsed
            process.flush()
            raise
        process.flush()
        return code
    except KeyboardInterrupt as stop:
        for note in getattr(stop, "__notes__", ()):
            if not note.startswith("lqrsim: "):  # those are for users of Python
                process.print_error(f"lqrsim: {note}")
        if as_command:
            process.end_stopped()
        process.print_error("lqrsim: stopped")
        return 130
    except (BrokenPipeError, process.Unprintable) as error:
        process.discard_output()
        cause = error.__cause__ if isinstance(error, process.Unprintable) else error
        if isinstance(cause, BrokenPipeError):  # the reader, such as `head`, has closed the pipe
            return 141
        why = cause.strerror if isinstance(cause, OSError) else cause
        process.print_error(f"lqrsim: error: standard output: got {why}, want one that can be written")
        return 2


def _run(arguments: list[str]) -> int:
    if arguments == ["--version"]:
        from importlib.metadata import version

        with process.printing():
            print(f"lqrsim {version('lqrsim')}")
        return 0

    from lqrsim.commands import COMMANDS

    if arguments in (["--help"], ["-h"]):
        lines = "\n".join(f"  {name:<10} {text}" for name, text in COMMANDS.items())
        with process.printing():
            print(f"usage: lqrsim COMMAND ...\n\n{DESCRIPTION.format(commands=lines)}")
        raise SystemExit(0)
    # With a few columns, help would never be completed.
    too_narrow = shutil.get_terminal_size().columns < NARROWEST
    with process.printing(), process.environment(**{"COLUMNS": str(NARROWEST)} if too_narrow else {}):
        command = _parse(arguments)

    from lqrsim.machine import outdated

    if line := _too_little_memory() or outdated():  # before imports that fail in little memory or with old packages
        process.print_error(f"lqrsim: error: {line}")
        return 2

    from lqrsim.commands import NAMES, console
    from lqrsim.errors import InputError, check_opengl

    notices = logging.StreamHandler()  # on stderr: notices of slow work, such as compiling for a new kind of problem
    logger = logging.getLogger("lqrsim")
    logger.addHandler(notices)
    logger.setLevel(logging.INFO)
    try:
        if isinstance(command, str):
            raise InputError(command)
        try:
            os.getcwd()
        except OSError:
            want = "one that exists: change to another"
            raise InputError(f"working folder: got one that was removed, want {want}") from None
        with process.interruptible():
            try:
                return console.run(command, NAMES[type(command)])
            except MemoryError as error:
                why = f" ({' '.join(str(error).split())[:200]})" if str(error) else ""
                raise InputError(f"memory: got too little for this{why}, want more, or a smaller task") from None
            except Exception as error:
                check_opengl(error)
                raise
    except InputError as error:
        if "--json" in arguments:
            name = f"lqrsim {arguments[0]}" if arguments[0] in COMMANDS else "lqrsim"
            console.print_json({"format": name, "version": 1, "exit_code": 2, "error": str(error)})
        process.print_error(f"lqrsim: error: {error}")
        return 2
    finally:
        logger.removeHandler(notices)


def _too_little_memory() -> str:
    """A line if NumPy, SciPy, Numba and MuJoCo cannot be loaded within the limit of the address space; else empty.

    With less they end the process; or SciPy's OpenBLAS, as it is loaded, asks again for ever and no signal is heeded.
    """
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return ""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= LEAST_MEMORY:
        return ""
    return f"memory: got {limit / 1e6:.0f} MB of address space (ulimit -v), want at least {LEAST_MEMORY / 1e6:.0f} MB"


def _parse(arguments: list[str]) -> Any:
    """Parse the arguments into a command. What is wrong with them is returned as a line, or printed in a box by tyro.

    The line is that of an option that is given twice, and with `--json` of any usage error.
    """
    import tyro

    from lqrsim.commands import Command
    from lqrsim.commands.options import RULES

    printed = io.StringIO()
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(RULES)
            if "--json" in arguments:  # in lines so wide that no word is broken
                stack.enter_context(process.environment(COLUMNS="100000"))
                stack.enter_context(contextlib.redirect_stderr(printed))
            command = tyro.cli(Command, prog="lqrsim", args=arguments)
        return _repeated_option(command, arguments) or command
    except SystemExit as end:
        if "--json" not in arguments or end.code != 2:
            raise
    # The first line is the title; a rule follows it where stdout is not UTF-8. Another rule precedes the hints.
    lines = [line.strip("│╭╮╰╯ ") for line in printed.getvalue().splitlines()[1:]]
    message = [line for line in lines if line]
    if message and not message[0].strip("─-"):
        del message[0]
    text = " ".join(itertools.takewhile(lambda line: line.strip("─-"), message))
    text = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    return text or "got arguments that cannot be parsed"


def _repeated_option(command: Any, arguments: list[str]) -> str:
    """What is wrong with the first option that is given more than once, of which tyro takes the last; or nothing."""
    words = itertools.takewhile(lambda word: word != "--", arguments)
    # No value begins with "--": tyro takes it as a wrong option.
    options = [word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")]
    for option, count in collections.Counter(f"--{option[2:].removeprefix('no-')}" for option in options).items():
        if count > 1:
            several = isinstance(getattr(command, option[2:].replace("-", "_"), None), (tuple, list))
            return f"{option}: got it {count} times, want it once" + (", with all its values" if several else "")
    return ""


if __name__ == "__main__":
    sys.exit(main())
