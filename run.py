#!/usr/bin/env python3
"""The commands of this project. Each first sets up what it needs; `python3 run.py --help` lists them."""

import sys

if sys.version_info < (3, 11):  # noqa: UP036 - this file is also what tells the owner of an older Python
    sys.exit("run.py: needs Python 3.11 or newer, got %d.%d" % sys.version_info[:2])  # noqa: UP031

import argparse
import ctypes.util
import hashlib
import importlib.util
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
PYTHON = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
STAMP = VENV / "installed-for"  # says what is installed; UNFINISHED while that is being changed
UNFINISHED = "an installation that was interrupted"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
GL_PACKAGES = ("libegl1", "libgl1-mesa-dri", "libopengl0")
ARM_PACKAGES = ("gcc-arm-none-eabi", "libnewlib-arm-none-eabi", "qemu-system-arm")

# All but the tests of packages, which are a third of what there is and are not run, and packages of which little is.
COMPILE = r"""
import compileall, re, sysconfig
rest = re.compile(r"[/\\](tests?|OpenGL|pip|plotly)[/\\]")
compileall.compile_dir(sysconfig.get_path("purelib"), rx=rest, quiet=2, workers=0)
"""

COMMANDS = {
    "demo": "solve, simulate and render both robots (arguments go to `lqrsim demo`)",
    "test": "run the tests; --long includes whole experiments (other arguments go to pytest: test -k solver)",
    "check": "check lint, formatting and types",
    "numbers": "print the numbers of the pages again; with --long those of long runs, too (numbers --help)",
    "release": "try the sdist and the wheel in empty environments of each Python on the path (release --help)",
    "docs": "build the documentation site into build/site; warnings are errors",
    "setup": "only set up what the other commands need",
}


def main() -> int:
    """Run the command that the arguments name and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="run.py",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="The commands of this project. Each first sets up what it needs.",
        epilog="commands:\n" + "\n".join(f"  {name:7} {text}" for name, text in COMMANDS.items()),
    )
    parser.add_argument("command", choices=COMMANDS, metavar="command", help=" | ".join(COMMANDS))
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="passed on to the command")
    options = parser.parse_args()
    rest: list[str] = options.arguments
    if options.command in ("check", "docs", "setup") and rest:
        asked_for_help = rest[0] in ("-h", "--help")
        print(f"run.py {options.command}: {COMMANDS[options.command]}; it takes no arguments")
        return 0 if asked_for_help else 2

    set_up_python(everything=options.command != "demo")
    if options.command not in ("check", "docs"):
        set_up_graphics()
    if options.command == "test":
        set_up_emulator()
        if rest:  # without arguments, the tests that need a browser are left out
            set_up_browser()
    if options.command == "demo":
        return run([PYTHON, "-m", "lqrsim.cli", "demo", *rest])
    if options.command == "test":
        # One process more than there are processors, for some tests wait for others; each file in one, so that what its
        # tests share is made once, in the order that tests/conftest.py puts them in.
        every = ["-n", str((os.cpu_count() or 1) + 1), "--dist", "loadfile", "--no-loadscope-reorder"]
        every += [] if rest == ["--long"] else ["-m", "not long"]
        # Matrices are small: more threads of theirs wait for each other, and keep processors busy with that.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        return run([PYTHON, "-m", "pytest", *(every if rest in ([], ["--long"]) else rest)])
    if options.command == "numbers":
        return run([PYTHON, "tests/tools/print_numbers.py", *rest])
    if options.command == "release":
        return run([PYTHON, "tests/tools/try_release.py", *rest])
    if options.command == "check":
        steps = (["ruff", "check"], ["ruff", "format", "--check"], ["basedpyright", "--pythonpath", str(PYTHON)])
        return max([run([PYTHON, "-m", *step]) for step in steps])
    if options.command == "docs":
        os.environ["NO_MKDOCS_2_WARNING"] = "1"  # an announcement of the theme's authors
        code = run([PYTHON, "-m", "mkdocs", "build", "--strict"])
        if code == 0:
            # Browsers do not let pages that are opened as files load the search index.
            say("The site is in build/site. To read it: python3 -m http.server --directory build/site")
        return code
    print(f"Ready. The command line is {PYTHON.parent / 'lqrsim'}")
    return 0


def set_up_python(*, everything: bool) -> None:
    """Make the virtual environment beside this file and install the project in it, unless that is done.

    Without `everything`, only what users of the package need, which takes half as long.
    """
    package = f"{hashlib.sha256((ROOT / 'pyproject.toml').read_bytes()).hexdigest()} {VENV}"
    extras = "[dev,docs]" if everything else ""
    stamp = STAMP.read_text(encoding="utf-8") if STAMP.is_file() else ""
    usable = interpreter_works() and stamp != UNFINISHED and (not stamp or f" {VENV}" in stamp)
    if usable and stamp.startswith(package + extras):
        return
    if not usable:
        make_environment()
    STAMP.write_text(UNFINISHED, encoding="utf-8")
    say("Installing lqrsim and what it depends on into .venv (a minute or two the first time) ...")
    pip = [PYTHON, "-m", "pip", "install", "--disable-pip-version-check"]
    code = run([*pip, *([] if sys.stdout.isatty() else ["--quiet"]), "--no-compile", "--editable", f".{extras}"])
    if code:
        sys.exit("run.py: the installation failed for the reason above; the next run starts it again")
    run([PYTHON, "-c", COMPILE])  # on all processors, where pip takes one; what it cannot compile it leaves
    STAMP.write_text(package + extras, encoding="utf-8")


def interpreter_works() -> bool:
    """Whether .venv holds a Python that runs, is new enough and has pip."""
    try:
        probe = [str(PYTHON), "-c", "import sys, pip; sys.exit(sys.version_info < (3, 11))"]
        return subprocess.run(probe, capture_output=True, env=environment(), check=False).returncode == 0
    except OSError:
        return False


def make_environment() -> None:
    """Make .venv anew."""
    # Where Debian splits the standard library, `venv` is there but cannot put pip into what it makes.
    if importlib.util.find_spec("ensurepip") is None:
        install_system_packages([f"python3.{sys.version_info.minor}-venv"], "Python's venv module is incomplete")
        importlib.invalidate_caches()
        if importlib.util.find_spec("ensurepip") is None:
            sys.exit("run.py: cannot make a virtual environment before that package is installed")
    say(f"Making a virtual environment in {VENV} ...")
    try:
        if VENV.is_dir() and not VENV.is_symlink():
            shutil.rmtree(VENV)
        VENV.mkdir()
        STAMP.write_text(UNFINISHED, encoding="utf-8")
    except OSError as error:
        sys.exit(f"run.py: cannot replace {VENV} ({error.strerror}); close what uses it, or remove it by hand")
    # The interpreter that an active virtual environment was made from: .venv may be the very one just removed.
    base = getattr(sys, "_base_executable", sys.executable)
    if run([base, "-m", "venv", VENV]):
        sys.exit("run.py: the virtual environment could not be made for the reason above")


def set_up_graphics() -> None:
    """Install the GL libraries that rendering without a display needs on Linux; without the rights, print how."""
    if sys.platform != "linux":
        return
    found = ctypes.util.find_library
    if not (found("EGL") and (found("OpenGL") or found("GL"))):
        install_system_packages(GL_PACKAGES, "No GL library, so no pictures; everything else works")


def set_up_browser() -> None:
    """Install a browser for the tests of pages; without the rights, print how: those tests are then skipped."""
    if sys.platform == "linux" and not any(map(shutil.which, BROWSERS)):
        install_system_packages(BROWSERS[:1], "No browser, so what the viewer's page shows is not tested")


def set_up_emulator() -> None:
    """Install what compiles and emulates the tests of exported C; without the rights, print how: they are skipped."""
    if sys.platform == "linux" and not all(map(shutil.which, ("arm-none-eabi-gcc", "qemu-system-arm"))):
        problem = "No compiler and emulator for ARM, so exported C is tested on this machine alone"
        install_system_packages(ARM_PACKAGES, problem, "--no-install-recommends")  # which would be ten times as many


def install_system_packages(packages: Sequence[str], problem: str, *options: str) -> None:
    """Install Debian packages with apt-get where this user may; otherwise print the line that does it."""
    install = ["apt-get", "install", "--yes", *options, *packages]
    if os.name == "posix" and os.geteuid() == 0 and shutil.which("apt-get"):
        say(f"Installing {' '.join(packages)} with apt-get ...")
        # The lists of a fresh machine are empty or stale; where they are not, fetching them is not needed.
        unattended = environment() | {"DEBIAN_FRONTEND": "noninteractive"}
        for step in (install, ["apt-get", "update"], install):
            done = subprocess.run(step, check=False, capture_output=True, stdin=subprocess.DEVNULL, env=unattended)
            if done.returncode == 0 and step is install:
                return
    say(f"{problem}. On Debian or Ubuntu this installs it: sudo {' '.join(install)}")


def environment() -> dict[str, str]:
    """The environment without variables that would lead a Python away from its own .venv."""
    stray = ("PYTHONHOME", "PYTHONPATH", "VIRTUAL_ENV", "__PYVENV_LAUNCHER__")
    return {name: value for name, value in os.environ.items() if name not in stray}


def run(command: Sequence[str | Path]) -> int:
    """Run a command in the project's folder and return its exit code."""
    with subprocess.Popen([str(part) for part in command], cwd=ROOT, env=environment()) as process:
        while True:
            try:
                code = process.wait()
                return code if code >= 0 else 128 - code  # a signal ended it
            except KeyboardInterrupt:
                pass  # the terminal has told the command too: let it tidy up


def say(text: str) -> None:
    """Print at once, also where the output is a file that other programs write to."""
    print(text, flush=True)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
