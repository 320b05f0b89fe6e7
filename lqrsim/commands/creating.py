"""Commands that write files for other tools: a new robot, a policy as C, runs as a data set of Minari."""

import builtins
import importlib.util
import keyword
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import lqrsim as ls
from lqrsim.commands import console
from lqrsim.commands.options import Json, optional, options_of, refuse, stated

TEMPLATE, CLASS = "my_robot", "MyRobot"
OF_C, OF_MINARI = ("number", "gains", "interpolate", "name"), ("actions", "cell", "solution", "scenario")
TEMPLATES = Path(__file__).parent.parent / "templates" / TEMPLATE
# Names with another meaning: those used in the written files, MuJoCo's first body, pytest's own file, Windows' devices.
RESERVED = {
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
        from lqrsim.results.archive import excerpt_of, write_text

        check_robot_name(self.name)
        folder = self.out / self.name
        console.check_output("--out", self.out)
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise ls.InputError(f"name: got {self.name!r}, want one without a folder {excerpt_of(folder)}") from None
        except OSError as error:
            got = excerpt_of(self.out)
            raise ls.InputError(f"--out: got {got}, want a folder that can be written ({error})") from None
        try:
            for template in sorted(TEMPLATES.glob("*.*")):
                path = folder / _named(template.name, self.name)
                write_text(path, _named(template.read_text(encoding="utf-8"), self.name))
                console.wrote(path)
        except BaseException:  # as on a full disk: the same command can then be given again
            shutil.rmtree(folder, ignore_errors=True)
            raise
        scenario, runs = f"{(folder / self.name).as_posix()}.py:scenario", f"runs/{self.name}"
        console.say("\nnext:")
        for command in (
            ["lqrsim", "solve", scenario],
            ["lqrsim", "simulate", f"{runs}/solution.npz", "--scenario", scenario, "--disturbances", "scenario"],
            ["lqrsim", "render", f"{runs}/rollout.npz"],
            ["python", "-m", "pytest", folder.as_posix()],
        ):
            console.say(f"  {shlex.join(command)}")
        return 0


@dataclass(frozen=True, kw_only=True)
@options_of("results/export_c.py", "export_c", interpolate="", name="NAME")
class Export:
    """Write a policy as C99, or runs as a data set of Minari.

    With --c, for a microcontroller, the folder gets a header and a source file that need math.h alone and allocate
    nothing, an example that compares commands with Python's, and a CMake file for this machine and for an STM32F405,
    which QEMU emulates. docs/microcontrollers.md says how to put it on a Crazyflie or into PX4.

    With --minari, to learn from, each trial becomes an episode; see docs/gymnasium.md. The data set is written to the
    folder of Minari, which MINARI_DATASETS_PATH names.

      lqrsim export runs/quadrotor/solution.npz --c firmware/policy
      cmake -S firmware/policy -B build && cmake --build build && ctest --test-dir build
      lqrsim export runs/quadrotor/rollout.npz --minari quadrotor/light-v0
      lqrsim export runs/stress/quadrotor --minari quadrotor/stressed-v0 --cell smooth,light,1
    """

    source: Annotated[Positional[Path], arg(metavar="FILE.npz|FOLDER")]
    """For --c a file from `lqrsim solve`, or a policy from `ls.save`: of ls.track, or of ls.OffsetFree with its filter.
    For --minari a file from `lqrsim simulate`, or a folder from `lqrsim stress`, whose trials are run again."""
    c: Annotated[Path | None, optional("FOLDER")] = None
    """Folder for the C files. Files of their names are replaced."""
    number: Literal["float", "double"] = "float"
    """Type of the numbers in C, except the time, which is a double."""
    gains: Literal["full", "int16"] = "full"
    """int16: matrices in C take 16 bits an entry. The largest change of the commands is printed and in the header."""
    minari: Annotated[str | None, optional("NAMESPACE/NAME-vVERSION")] = None
    """Name of the data set, which must be new."""
    actions: Literal["normalized", "controls"] = "normalized"
    """Of the data set: from -1 to 1 between the limits of each control, or in the controls' own units."""
    cell: Annotated[tuple[str, ...], optional("CELL ...")] = ()
    """Cells of a stress test, as in `lqrsim replay`. By default all."""
    solution: Annotated[Path | None, optional("SOLUTION.npz")] = None
    """Solution of the run. By default solution.npz beside it."""
    scenario: Annotated[str | None, optional("SCENARIO")] = None
    """Scenario of the run, for the rewards, as in `lqrsim simulate` or `lqrsim replay`."""
    json: Json = False

    def run(self) -> int:
        if (self.c is None) == (self.minari is None):
            raise ls.InputError(f"--c, --minari: got {'none' if self.c is None else 'both'}, want one of the two")
        unused, target = (OF_C, "--c") if self.c is None else (OF_MINARI, "--minari")
        refuse(self, unused, f"without {target}, want it with that")
        if self.c is not None:
            self._to_c(self.c)
        if self.minari is not None:
            self._to_minari(self.minari)
        return 0

    def _to_c(self, folder: Path) -> None:
        console.check_output("--c", folder)
        policy: Any = ls.load(self.source)  # `export_c` refuses anything that cannot be exported
        exported = ls.export_c(policy, folder, **stated(self, ls.export_c))
        for path in exported.files:
            console.wrote(path)
        console.say(exported.summary())
        console.result(sha256=exported.sha256, table_bytes=exported.table_bytes, rounding=exported.rounding)

    def _to_minari(self, name: str) -> None:
        try:
            from lqrsim.gym import make_env, write_minari
        except ImportError as error:
            raise ls.InputError(f"--minari: {error}, and 'lqrsim[minari]'") from None
        if self.source.is_dir():
            results = ls.stress.Results(self.source, scenario=self.scenario)
            cells = [ls.stress.Cell.named(cell_name, results.cells) for cell_name in self.cell] or results.cells
            shards = ((cell, shard) for cell in cells for shard in results.shards(cell))
            runs = (ls.stress.replay(results, cell, one.first, trials=one.count, frames=False) for cell, one in shards)
            solution = self.solution or results.folder / "policies" / f"{cells[0].policy}.npz"
            named = self.scenario or results.manifest["campaign"]["scenario"]
            _ = results.campaign  # raises an exception if that is code which was not named
        else:
            if self.cell:
                raise ls.InputError(f"--cell: got {self.cell[0]} with {self.source}, want the folder of a stress test")
            runs = ls.load(self.source, ls.Rollout)
            solution = self.solution or self.source.with_name("solution.npz")
            named = self.scenario or console.load_with_scenario(solution, None)[0].scenario
        # A path as text, from which `recover_environment` can make it.
        env = make_env(named, solution=str(solution.absolute()), actions=self.actions)
        dataset = write_minari(name, env, runs)
        console.wrote(dataset.spec.data_path)
        console.say(f"{dataset.total_episodes} episodes of {dataset.total_steps} control periods")
        console.result(episodes=dataset.total_episodes, steps=dataset.total_steps)


def check_robot_name(name: str) -> None:
    """Raise InputError unless a new module can have this name."""
    from lqrsim.errors import excerpt

    wanted = "lower-case letters, digits and underscores, beginning with a letter, such as my_robot"
    plain = name.isascii() and name.isidentifier() and name == name.lower() and name[0] != "_" and len(name) <= 60
    if not plain or keyword.iskeyword(name):
        raise ls.InputError(f"name: got {excerpt(name)}, want {wanted}")
    reserved = RESERVED | {word.lower() for word in (*dir(builtins), *keyword.kwlist)}
    if name in reserved:
        raise ls.InputError(f"name: got {name!r}, which has another meaning in Python, MuJoCo or Windows, want another")
    spec = importlib.util.find_spec(name)
    if spec is not None and spec.origin is not None:  # a folder without modules has no origin
        raise ls.InputError(f"name: got {name!r}, which is a module of Python or of a package, want another name")


def _named(text: str, name: str) -> str:
    return text.replace(TEMPLATE, name).replace(CLASS, "".join(part.capitalize() for part in name.split("_")))
