"""Tries what people install: builds the sdist, and the wheel from it, and runs both in empty environments, offline.

    python3 run.py release                                     # each Python from 3.11 on that is on the path
    python3 run.py release --pythons python3.13 /opt/python3.14/bin/python3
    python3 run.py release --quick                             # without the demo

For each Python it makes a virtual environment with the wheel and its dependencies alone, and another for the
sdist. Then, without a network and with nothing compiled, it runs the README's Python, where warnings of lqrsim's lines
are errors, and the commands `lqrsim --version`, `lqrsim reproduce --quick figure_3`, `lqrsim demo --quick`.

Exits with 1 if anything failed; build/release/ has the environments, and dist/ what was built.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NAMESPACES = ("unshare", "--net", "--map-root-user")  # a Linux command: without any network, not even this machine's
NOWHERE = dict.fromkeys(("http_proxy", "https_proxy", "all_proxy"), "http://127.0.0.1:9")

# The README renders 25 s in 720p, which takes over a minute; small and coarse it is the same code.
README = r"""
import sys
import warnings
from functools import partial
from importlib.metadata import distributions

warnings.filterwarnings("error", module=r"lqrsim\b")  # what Python is about to drop

import lqrsim as ls

assert not {"pytest", "hatchling"} & {distribution.name for distribution in distributions()}, "not an empty environment"
assert ls.__file__.startswith(sys.prefix), ls.__file__
ls.render = partial(ls.render, size=(320, 180), fps=5)
"""


class Failed(Exception):
    """A command failed; has what it printed."""


@dataclass(frozen=True)
class Config:
    """What to try."""

    pythons: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PYTHON ...")] = ()
    """Names or paths. By default each from 3.11 on that is on the path and has venv."""
    quick: bool = False
    """Without the demo."""


def pythons() -> dict[str, str]:
    """This Python, and others on the path that lqrsim runs on, by their versions."""
    found = {f"python3.{sys.version_info.minor}": sys.executable}
    for name in (f"python3.{minor}" for minor in range(11, 20)):
        works = shutil.which(name) and subprocess.run([name, "-c", "import venv"], capture_output=True).returncode == 0
        found.setdefault(name, name) if works else None
    return found


def run(command: Sequence[object], folder: Path, *, offline: bool = False) -> str:
    """Run a command in a folder and return what it prints. Raises Failed."""
    words, environment = [str(part) for part in command], dict(os.environ)
    environment.pop("PYTHONPATH", None)
    if offline:
        environment |= NOWHERE | {"XDG_CACHE_HOME": str(folder / "cache")}
        words = [*NAMESPACES, *words] if has_namespaces() else words
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise Failed(f"{' '.join(words)}\n{done.stdout}{done.stderr}")
    return done.stdout


def has_namespaces() -> bool:
    """Whether this user may run a command without a network."""
    return bool(shutil.which("unshare")) and not subprocess.run([*NAMESPACES, "true"], capture_output=True).returncode


def build(folder: Path) -> tuple[Path, Path]:
    """Build the sdist, and the wheel from it, which proves it whole; return their paths, the wheel first."""
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT], ROOT)
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


def installed(python: str, package: Path, folder: Path) -> Path:
    """Install a package with its dependencies in a new environment; return the folder of its programs."""
    run([python, "-m", "venv", "--without-pip", folder], folder.parent)
    programs = folder / ("Scripts" if sys.platform == "win32" else "bin")
    pip = [sys.executable, "-m", "pip", "--python", programs / "python", "install", "--quiet", "--no-compile"]
    run([*pip, package], folder.parent)
    return programs


def works(programs: Path, version: str, folder: Path, *, quick: bool = False) -> None:
    """Run the README's Python and the commands in a folder, offline. Raises Failed."""
    blocks = BLOCK.findall((ROOT / "README.md").read_text(encoding="utf-8"))
    (folder / "readme.py").write_text("\n".join([README, *blocks]), encoding="utf-8")
    run([programs / "python", "readme.py"], folder, offline=True)
    package = run([programs / "python", "-c", "import lqrsim; print(lqrsim.__path__[0])"], folder).strip()
    run([programs / "python", "-W", "error", "-m", "compileall", "-qf", package], folder)  # what its syntax warns of
    printed = run([programs / "lqrsim", "--version"], folder, offline=True)
    if printed.split() != ["lqrsim", version]:
        raise Failed(f"lqrsim --version: got {printed.strip()}, want lqrsim {version}")
    commands = ["reproduce --quick figure_3"] + ([] if quick else ["demo --quick"])
    for command in commands:
        run([programs / "lqrsim", *command.split()], folder, offline=True)
    left = [path for path in ("solution.npz", "runs/paper/figures/figure_3.pdf") if not (folder / path).is_file()]
    if left:
        raise Failed(f"{', '.join(left)}: not written")


def main(config: Config) -> int:
    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    shutil.rmtree(ROOT / "build" / "release", ignore_errors=True)
    wheel, sdist = build(ROOT / "dist")
    version, chosen, failed = wheel.name.split("-")[1], config.pythons or tuple(pythons().values()), 0
    offline = "without a network" if has_namespaces() else "with proxies that do not answer"
    tries = [(python, wheel) for python in chosen] + [(chosen[-1], sdist)]
    for number, (python, package) in enumerate(tries):
        folder = ROOT / "build" / "release" / str(number)
        folder.mkdir(parents=True)
        found = run([python, "-c", "import platform; print(platform.python_version())"], folder).strip()
        try:
            works(installed(python, package, folder / "empty"), version, folder, quick=config.quick)
        except Failed as error:
            failed += 1
            print(f"Python {found}, {package.name}: FAILED\n{error}", flush=True)
        else:
            print(f"Python {found}, {package.name}: installed, and ran {offline}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Config, description=__doc__)))
    except KeyboardInterrupt:
        sys.exit(130)
