"""Commands that write source files: a new robot, or a policy as C."""

import builtins
import importlib.util
import keyword
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from lqrsim.commands.options import Json

TEMPLATE, CLASS = "my_robot", "MyRobot"
TEMPLATES = Path(__file__).parent.parent / "templates" / TEMPLATE
# Names with another meaning: those used in the written files, MuJoCo's first body, pytest's own file, Windows' devices.
TAKEN = {
    "any", "path", "self", "world", "conftest", "con", "prn", "aux", "nul",
    *(f"{port}{number}" for port in ("com", "lpt") for number in range(10)),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class New:
    """Write the files of a new robot.

    The folder contains an MJCF, dynamics, a scenario and a test. They work unchanged: a disc is pushed round a crate.
    Prints the commands that solve, simulate, render and test it. docs/new_robot.md explains the changes to make.
    """

    name: Annotated[Positional[str], arg(metavar="NAME")]
    """Name of the robot, a name that Python can import: lower-case letters, digits and underscores."""
    out: Annotated[Path, arg(metavar="FOLDER")] = Path(".")
    """Folder in which the robot's folder is made."""

    def run(self) -> int:
        from lqrsim.commands import console
        from lqrsim.errors import InputError
        from lqrsim.results.archive import excerpt_of

        check_robot_name(self.name)
        folder = self.out / self.name
        console.check_output("--out", self.out)
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise InputError(f"name: got {self.name!r}, want one without a folder {excerpt_of(folder)}") from None
        except OSError as error:
            raise InputError(
                f"--out: got {excerpt_of(self.out)}, want a folder that can be written ({error})"
            ) from None
        for template in sorted(TEMPLATES.glob("*.*")):
            path = folder / _named(template.name, self.name)
            path.write_text(_named(template.read_text(encoding="utf-8"), self.name), encoding="utf-8", newline="\n")
            console.wrote(path)
        console.say("\nnext:")
        for command in next_commands(self.name, folder):
            console.say(f"  {shlex.join(command)}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a policy as C99, for a microcontroller.

    The folder gets a header and a source file that need math.h alone and allocate nothing, an example that compares
    commands with Python's, and a CMake file for this machine and for an STM32F405, which QEMU emulates.
    docs/microcontrollers.md says how to put it on a Crazyflie or into PX4.

      lqrsim export runs/quadrotor/solution.npz --c firmware/policy
      cmake -S firmware/policy -B build && cmake --build build && ctest --test-dir build
    """

    policy: Annotated[Positional[Path], arg(metavar="POLICY.npz")]
    """A file from `lqrsim solve`, or a policy from `ls.save`: of ls.track, or of ls.OffsetFree with its filter."""
    c: Annotated[Path, arg(metavar="FOLDER")]
    """Folder for the C files. Files of their names are replaced."""
    number: Literal["float", "double"] = "float"
    """Type of the numbers, except the time, which is a double."""
    gains: Literal["full", "int16"] = "full"
    """int16: matrices take 16 bits an entry. The largest change of the commands is printed and in the header."""
    interpolate: bool = False
    """Blend the laws of two knots, for loops that are faster than the plan; not with a filter."""
    name: str = "policy"
    """Name of the files and the functions: lower-case letters, digits and underscores."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.commands import console
        from lqrsim.results import save_load
        from lqrsim.results.export_c import export_c

        console.check_output("--c", self.c)
        policy: Any = save_load.load(self.policy)  # `export_c` refuses anything that cannot be exported
        found = export_c(
            policy, self.c, number=self.number, gains=self.gains, interpolate=self.interpolate, name=self.name
        )
        for path in found.files:
            console.wrote(path)
        console.say(found.summary())
        console.result(sha256=found.sha256, table_bytes=found.table_bytes, rounding=found.rounding)
        return 0


def check_robot_name(name: str) -> None:
    """Raise InputError unless a new module can have this name."""
    from lqrsim.errors import InputError, excerpt

    wanted = "lower-case letters, digits and underscores, beginning with a letter, such as my_robot"
    plain = name.isascii() and name.isidentifier() and name == name.lower() and name[0] != "_" and len(name) <= 60
    if not plain or keyword.iskeyword(name):
        raise InputError(f"name: got {excerpt(name)}, want {wanted}")
    reserved = TAKEN | {one.lower() for one in (*dir(builtins), *keyword.kwlist)}
    if name in reserved:
        raise InputError(
            f"name: got {name!r}, which has another meaning in Python, MuJoCo or Windows, want another name"
        )
    found = importlib.util.find_spec(name)
    if found is not None and found.origin is not None:  # a folder without modules has no origin
        raise InputError(f"name: got {name!r}, which is a module of Python or of a package, want another name")


def next_commands(name: str, folder: Path) -> list[list[str]]:
    """Commands that solve, simulate, render and test the robot in that folder."""
    scenario, runs = f"{(folder / name).as_posix()}.py:scenario", f"runs/{name}"
    return [
        ["lqrsim", "solve", scenario],
        ["lqrsim", "simulate", f"{runs}/solution.npz", "--scenario", scenario, "--disturbances", "scenario"],
        ["lqrsim", "render", f"{runs}/rollout.npz"],
        ["python", "-m", "pytest", folder.as_posix()],
    ]


def _named(text: str, name: str) -> str:
    """Replace the names in the text of a template."""
    return text.replace(TEMPLATE, name).replace(CLASS, "".join(part.capitalize() for part in name.split("_")))
