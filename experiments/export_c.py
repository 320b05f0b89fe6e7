"""Policies as C: whether compiled code flies as Python does, and what it takes on a microcontroller.

    python experiments/export_c.py                      # everything, some ten minutes
    python experiments/export_c.py --sections campaign  # some of it
    python experiments/export_c.py --quick              # as little as shows how it works

campaign    Trials in `simulate` whose controller is the exported C, compiled by this machine's compiler: its commands
            beside those of the law in Python for the same measurements, and how often the goal is reached.
board       The same code by arm-none-eabi-gcc for an STM32F405, along recorded measurements in QEMU: commands,
            instructions a step, bytes of flash, RAM and stack. Skipped where the tools are not installed.
"""

import ctypes
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from peers.common import Unavailable
from runner import FolderSettings, Result, at_most, between, interval, judge, opening, progress, run, table

import lqrsim as ls
from lqrsim.control.controllers import OutputFeedback, as_controller
from lqrsim.errors import Array
from lqrsim.results.coordinates import Coordinates
from lqrsim.scenarios.references import disturbance_set
from lqrsim.stress.statistics import rate
from lqrsim.stress.study import make_controller
from lqrsim.types import OutputFeedbackPolicy

ROBOTS = ("differential_drive", "quadrotor")
LAWS = ("smooth", "track", "offset_free")
SETS = ("light", "moderate")
VARIANTS: dict[str, dict[str, str]] = {
    "double": {"number": "double"}, "float": {"number": "float"}, "16 bits": {"number": "float", "gains": "int16"},
}  # fmt: skip
EXACT = 1e-12  # that commands in double may differ by
FLASH, RAM = 1 << 20, 192 << 10  # bytes of an STM32F405

# The last ones are those of the firmwares of Crazyflie and PX4 that C99 with constant tables could break.
WARNINGS = (
    "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-Wdouble-promotion", "-Wfloat-equal",
    "-Wshadow", "-Wundef",
)  # fmt: skip
ARM = ("arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-O2")
QEMU = ("qemu-system-arm", "-machine", "netduinoplus2", "-nographic", "-semihosting")
REAL = {"float": ctypes.c_float, "double": ctypes.c_double}
# The exported source, and what exchanges the state of its filter, if it has one, so that one object serves many trials.
SWAP = """#include "policy.c"
void swap(real *other)
{
#ifdef SIZE
    for (int i = 0; i < SIZE; i++) {
        const real here = z[i];
        z[i] = other[i];
        other[i] = here;
    }
#else
    (void)other;
#endif
}
"""


class CompiledLaw(ls.Controller):
    """A policy that was exported and compiled by the host's compiler.

    Args:
      policy: what is exported.
      folder: for the files.
      number: as `export_c` takes it; so are further options.
    """

    def __init__(
        self,
        policy: ls.AffinePolicy | OutputFeedbackPolicy,
        folder: Path,
        *,
        number: Any = "double",  # "float" or "double"
        **options: Any,
    ) -> None:
        self.policy, self.number, self.sees_losses = policy, number, isinstance(policy, OutputFeedbackPolicy)
        self.exported = ls.export_c(policy, folder, number=number, **options)
        (folder / "swap.c").write_text(SWAP, encoding="utf-8")
        source, library = folder / "swap.c", folder / "policy.so"
        said = ["cc", *WARNINGS, "-O2", "-shared", "-fPIC", "-o", str(library), str(source), "-lm"]
        subprocess.run(said, check=True)
        self._library, self._real = ctypes.CDLL(str(library)), REAL[number]
        self._library.policy_step.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_void_p]
        self._library.swap.argtypes = [ctypes.c_void_p]
        self._library.policy_init()

    def __call__(self, measured: Array | None, t: float) -> Array:
        """The commands (m,). Raises ValueError where C refuses."""
        shown = None if measured is None else np.ascontiguousarray(measured, dtype=self._real)
        command = np.full(len(self.policy.control_coordinates), np.nan, dtype=self._real)
        if self._library.policy_step(None if shown is None else shown.ctypes.data, t, command.ctypes.data):
            assert np.isnan(command).all(), "refused, but changed the command"
            raise ValueError("refused")
        return command.astype(np.float64)

    def init(self) -> None:
        self._library.policy_init()

    def swap(self, z: Array) -> None:
        """Exchange the state of the filter with z (Z,), of the number type."""
        assert z.dtype == np.dtype(self._real)
        self._library.swap(z.ctypes.data)

    def start(self, trials: int) -> "_Run":
        return _Run(self, trials)

    @property
    def digest(self) -> str:
        return f"C of {self.exported.sha256}"

    @property
    def coordinates(self) -> tuple[Coordinates, Coordinates]:
        return self.policy.state_coordinates, self.policy.control_coordinates


class _Run(ls.types.ControllerRun):
    def __init__(self, law: CompiledLaw, trials: int) -> None:
        self._law, self.shown = law, list[Array]()  # (K, n) each
        self._filters = isinstance(law.policy, OutputFeedbackPolicy)
        self._z = np.tile(law.policy.nominal[0], (trials, 1)).astype(REAL[law.number])
        self._chosen = OutputFeedback(law.policy).measures if isinstance(law.policy, OutputFeedbackPolicy) else []

    def control(self, step: int, measured: Array) -> Array:
        law, commands = self._law, []
        self.shown.append(measured.copy())
        for k, shown in enumerate(measured):
            if not self._filters:
                commands.append(law(shown, step * law.policy.dt))
                continue
            law.swap(self._z[k])
            lost = np.isnan(shown).all()
            commands.append(law(None if lost else shown[self._chosen], step * law.policy.dt))
            law.swap(self._z[k])
        return np.array(commands)


Section = Literal["campaign", "board"]


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    sections: tuple[Section, ...] = ("campaign", "board")
    """Which of them."""
    trials: int = 400
    """Of each law under each set of disturbances."""
    seed: int = 0
    """Of all trials."""

    def bounded(self) -> Self:
        """The settings, reduced by `--quick`."""
        return at_most(self, trials=8)


def laws_of(robot: str) -> tuple[ls.Scenario, ls.Solution, dict[str, Any]]:
    """The scenario, its solution, and the laws: that of `smooth`, `track`, and `OffsetFree` with its filter."""
    scenario = getattr(ls.scenarios, robot)()
    solution = ls.smooth(scenario.problem)
    offset_free = make_controller("offset_free", scenario, solution)
    assert isinstance(offset_free, ls.OffsetFree)
    laws = {"smooth": solution.policy, "track": make_controller("track", scenario, solution)}
    return scenario, solution, laws | {"offset_free": offset_free.policy}


def campaign(config: Config) -> list[Result]:
    """A row for each robot, law and set: how often the goal is reached, in Python and by each variant of the C."""
    rows = []
    for robot in progress(ROBOTS[:1] if config.quick else ROBOTS, "campaign", unit="robot"):
        scenario, solution, laws = laws_of(robot)
        plant = scenario.plant()
        for law, policy in laws.items():
            for name in SETS:
                flown = partial(
                    ls.simulate, plant, solution, disturbances=disturbance_set(name, scenario), seed=config.seed,
                    trials=config.trials,
                )  # fmt: skip
                python = rate(flown(controller=policy).outcome.count("reached"), config.trials)
                row: Result = {"robot": robot, "law": law, "set": name, "python": interval(python)}
                for variant, options in VARIANTS.items():
                    with tempfile.TemporaryDirectory() as folder:
                        compiled = flown(controller=CompiledLaw(policy, Path(folder), **options))
                    reached = compiled.outcome.count("reached") / config.trials
                    row[variant] = {"rate": reached, "off": difference(compiled, policy, solution)}
                rows.append(row)
    return rows


def difference(rollout: ls.Rollout, policy: Any, solution: ls.Solution) -> float:
    """The largest difference between a run's commands and those of the law in Python for the same measurements."""
    whole = np.isfinite(rollout.commanded).all(axis=(1, 2)) & np.isfinite(rollout.measured).all(axis=(1, 2))
    commanded = rollout.commanded[whole]
    again = as_controller(policy, solution, None)[0].start(len(commanded))  # type: ignore[arg-type] - not of a function
    assert isinstance(rollout.controller_run, _Run)
    commands = [again.control(step, shown[whole]) for step, shown in enumerate(rollout.controller_run.shown)]
    return float(np.abs(commanded - np.array(commands).swapaxes(0, 1)).max())


BOARD = r"""#include <stdint.h>
#include <stdio.h>
#include "policy.h"

static const policy_real recorded[][POLICY_MEASURED] = {
%s
};
static const int lost[] = {%s};

/* SysTick counts down at 168 MHz; in QEMU time passes with the instructions. */
static volatile uint32_t *const systick = (volatile uint32_t *)0xE000E010u;

static uint32_t since(uint32_t before)
{
    return (before - systick[2]) & 0xFFFFFFu;
}

int main(void)
{
    policy_real command[POLICY_CONTROLS];
    uint32_t before, loops = 100000;

    systick[1] = 0xFFFFFFu;
    systick[2] = 0;
    systick[0] = 5;
    before = systick[2];
    __asm volatile("1: subs %%0, #1\n bne 1b" : "+r"(loops) : : "cc");
    printf("%%lu\n", (unsigned long)since(before)); /* of 200000 instructions */
    policy_init();
    before = systick[2];
    for (int k = 0; k < (int)(sizeof lost / sizeof lost[0]); k++)
        policy_step(lost[k] ? NULL : recorded[k], k * POLICY_PERIOD, command);
    printf("%%lu\n", (unsigned long)since(before)); /* of all steps */
    policy_init();
    for (int k = 0; k < (int)(sizeof lost / sizeof lost[0]); k++) {
        policy_step(lost[k] ? NULL : recorded[k], k * POLICY_PERIOD, command);
        for (int i = 0; i < POLICY_CONTROLS; i++)
            printf("%%.17g ", (double)command[i]);
        printf("\n");
    }
    return 0;
}
"""


def board(config: Config) -> list[Result]:
    """A row for each law of the quadrotor, or with --quick of the drive, in float and with 16 bits."""
    missing = [name for name in ("arm-none-eabi-gcc", "arm-none-eabi-size", QEMU[0]) if shutil.which(name) is None]
    if missing:
        raise Unavailable(f"needs {', '.join(missing)}")
    robot = ROBOTS[0] if config.quick else ROBOTS[1]
    scenario, solution, laws = laws_of(robot)
    disturbances = disturbance_set("moderate", scenario)
    rows = []
    for law, policy in laws.items():
        for variant in ("float", "16 bits"):
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                here = CompiledLaw(policy, folder, **VARIANTS[variant])
                run = ls.simulate(
                    scenario.plant(), solution, controller=here, disturbances=disturbances, seed=config.seed
                )
                rows.append({"law": law, "variant": variant, **on_board(here, run, solution, folder)})
    return rows


def on_board(law: CompiledLaw, rollout: ls.Rollout, solution: ls.Solution, folder: Path) -> Result:
    """What the law takes on the emulated board along a run, and its commands beside the host's and Python's."""
    measured, commanded = rollout.measured[0, :-1].astype(np.float32), rollout.commanded[0]
    assert isinstance(rollout.controller_run, _Run)
    lost = [int(np.isnan(shown[0]).all()) for shown in rollout.controller_run.shown]
    if isinstance(law.policy, OutputFeedbackPolicy):
        measured = measured[:, OutputFeedback(law.policy).measures]
    rows = ",\n".join("{" + ", ".join(f"{value!s}f" for value in row) + "}" for row in measured)
    (folder / "board.c").write_text(BOARD % (rows, ", ".join(map(str, lost))), encoding="utf-8")
    compile_law = [*ARM, *WARNINGS, "-fstack-usage", "-c", "policy.c"]
    link = [
        *ARM,
        "--specs=rdimon.specs",
        "-T",
        "stm32f405.ld",
        "board.c",
        "stm32f405.c",
        "policy.o",
        "-lm",
        "-o",
        "board",
    ]
    for command in (compile_law, link):
        subprocess.run(command, cwd=folder, check=True)
    sizes = subprocess.run(["arm-none-eabi-size", "policy.o"], cwd=folder, check=True, capture_output=True, text=True)
    text, data, bss = map(int, sizes.stdout.splitlines()[1].split()[:3])
    # The largest frame of the law's functions and those that it calls, one after the other.
    frames = [int(line.split("\t")[1]) for line in (folder / "policy.su").read_text(encoding="utf-8").splitlines()]
    said = subprocess.run(
        [*QEMU, "-icount", "shift=0", "-kernel", "board"], cwd=folder, check=True, capture_output=True, text=True,
        timeout=300,
    ).stdout.split("\n")  # fmt: skip
    instructions = 200_000 * int(said[1]) / int(said[0]) / len(lost)
    commands = np.array([[float(one) for one in line.split()] for line in said[2 : len(lost) + 2]])
    return {
        "host": float(np.abs(commands - commanded).max()), "python": difference(rollout, law.policy, solution),
        "instructions": round(instructions),
        "flash": text + data, "tables": law.exported.table_bytes, "ram": data + bss, "stack": sum(frames),
        "states": law.policy.nominal.shape[1], "knots": law.policy.steps,
        "fits": text + data <= FLASH and data + bss + sum(frames) <= RAM,
    }  # fmt: skip


SECTIONS = {"campaign": campaign, "board": board}


def main(config: Config) -> Result:
    config = config.bounded()
    result = opening(config)
    for name in config.sections:
        try:
            result[name] = SECTIONS[name](config)
        except Unavailable as error:
            result[name] = {"skipped": str(error)}
    return result


def report(result: Result) -> str:
    parts = [
        "## Policies as C",
        "What `lqrsim export` writes, by this machine's C compiler, and by `arm-none-eabi-gcc` in `qemu-system-arm`.",
    ]
    if "campaign" in result:
        rows, exact, inside = [], [], []
        for row in result["campaign"]:
            _, low, high = row["python"]
            cells = [f"{row[variant]['off']:.1e}" for variant in VARIANTS]
            rows.append([f"{row['robot']}, {row['law']}, {row['set']}", between(row["python"], ".3f"), *cells])
            exact.append(row["double"]["off"] <= EXACT)
            inside += [low <= row[variant]["rate"] <= high for variant in VARIANTS]
        parts += [
            f"Trials that reach the goal in Python, of {result['config']['trials']}, and the largest difference of a"
            " command of the C from Python's for the same measurements, in m/s and N:",
            table(["robot, law, disturbances", "reached", *VARIANTS], rows),
            f"Commands in double, {judge(all(exact), f'within {EXACT:g} of those of Python')}. Rates,"
            f" {judge(all(inside), 'all within the interval of Python')}.",
        ]
    if isinstance(found := result.get("board"), dict):
        parts.append(f"board: skipped: {found['skipped']}")
    elif found:
        rows = [
            [
                f"{row['law']}, {row['variant']}", row["states"], row["knots"], f"{row['instructions']:,}",
                *(f"{row[name]:,}" for name in ("flash", "ram", "stack")),
                *(f"{row[name]:.1e}" for name in ("host", "python")),
            ]
            for row in found
        ]  # fmt: skip
        parts += [
            "On an STM32F405 in QEMU, along a run under moderate disturbances: instructions a step, bytes, and the"
            " largest differences of the commands from those of the same C here, and from those of Python:",
            table(["law", "size", "knots", "instructions", "flash", "RAM", "stack", "here", "Python"], rows),
            f"All, {judge(all(row['fits'] for row in found), 'in 1 MiB of flash and 192 KiB of RAM')}.",
        ]
    return "\n\n".join(parts)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
