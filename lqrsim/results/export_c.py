"""Policies as C99, for a microcontroller. This module fills in the templates in `templates/c/`.

Feedback laws are written about their nominal states, `planned + gain (state - nominal)`, which equals
`gain state + offset`. Rounding a gain to float or to 16 bits then acts on deviations only.
"""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Line, Want, checked
from lqrsim.errors import Array, InputError, check_path, excerpt
from lqrsim.results.archive import write_text
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.policy import AffinePolicy, OutputFeedbackPolicy
from lqrsim.results.save_load import hash_of
from lqrsim.results.solution import Solution

TEMPLATES = Path(__file__).parent.parent / "templates" / "c"
PREFIX = "my_policy"  # the name in the templates
STATIC = ("CMakeLists.txt", "main.c", "stm32f405.c", "stm32f405.ld")
# Headers of C and C++, and those that they include from the C library. A file of such a name would be included in
# their place wherever the folder is on the include path.
HEADERS = (
    "assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic"
    " stdbit stdbool stdckdint stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar wchar wctype"
    " alloca byteswap endian features libintl malloc memory newlib pthread reent sched strings syslimits unistd"
    " xlocale"
)
LARGEST = 32767  # largest integer in 16 bits
# The tolerance of main.c, relative to the largest sum of magnitudes in a command: well above rounding, about 1e-15
# in double and 1e-6 in float over some dozen sums, and above 1/65534, the rounding of one gain to 16 bits.
TOLERANCES = {"double": 1e-11, "float": 1e-5, "int16": 1e-3}
EXPORTED = "a Solution, an AffinePolicy, such as of track, or an OutputFeedbackPolicy, such as OffsetFree(...).policy"
DTYPES: dict[str, Any] = {"float": np.float32, "double": np.float64}
# The template of the source, and what the header says of it.
FEEDBACK = {"source": "feedback.c", "what": "A feedback law", "lost": "", "or": ", or measured is NULL"}
FILTER = {
    "source": "filter.c", "what": "A filter and the law of its estimates",
    "or": ", or my_policy_init()\n * has not been called",
    "lost": " NULL if the\n * measurement got lost; it is predicted then. Call it once in each control period.",
}  # fmt: skip
# The behaviour of feedback.c between two knots.
HELD = {"blend": "", "near": "NOMINAL(k, j)", "wanted": "law(k, i, state)"}
BLENDED = {
    "blend": """    const int next = k + 1 < MY_POLICY_STEPS ? k + 1 : k;
    const double after = knot - 1e-9 - k;
    const real weight = next > k && after > 0 ? (real)after : 0;
""",
    "near": "(1 - weight) * NOMINAL(k, j) + weight * NOMINAL(next, j)",
    "wanted": "(1 - weight) * law(k, i, state) + weight * law(next, i, state)",
}
# What `ExportedC.rounding` bounds, in words.
ROUNDING_MEANING = """\
Rounding the gains changes each command by at most this, where everything that they multiply is off its nominal
value by 1 in its unit"""


@checked
@dataclass(frozen=True, kw_only=True)
class ExportedC:
    """The result of `export_c`.

    Attributes:
      sha256: hash of the policy's content, as in its file; it is also in the header. controls: names with units.
      rounding: (m,), the largest change of each control by rounding the gains, in the control's unit, if every state,
        including the filter's, is off its nominal value by one unit.
    """

    files: tuple[Path, ...]
    sha256: Line
    table_bytes: int
    rounding: Annotated[tuple[float, ...], "m"]
    controls: Annotated[tuple[Line, ...], "m"]

    def summary(self) -> str:
        """The hash, the size of the tables, and by how much rounding the gains changes each control."""
        lines = [f"SHA-256 {self.sha256}, tables of {self.table_bytes:,} bytes", f"{ROUNDING_MEANING}:"]
        return "\n".join([*lines, *_bounds(self.controls, self.rounding)])


@checked
def export_c(
    policy: Annotated[Solution | AffinePolicy | OutputFeedbackPolicy, Want(EXPORTED)],
    folder: str | os.PathLike[str],
    *,
    number: Literal["float", "double"] = "float",
    gains: Literal["full", "int16"] = "full",
    interpolate: bool = False,
    name: Annotated[str, Want("a name"), 40] = "policy",
) -> ExportedC:
    """Write a policy as C99 with constant tables, and an example with a CMake file.

        ls.export_c(solution, "firmware/policy")
        ls.export_c(ls.OffsetFree(problem, solution, uncertainty).policy, "firmware/policy", gains="int16")

    `NAME.h` declares `NAME_init()` and `NAME_step(measured, t, command)`. `NAME.c` needs only `math.h` and allocates
    nothing. The commands are those that the policy computes in Python, including angles, limits and the time after the
    horizon. `main.c` compares some commands with Python's.

    Args:
      policy: a Solution, whose policy is exported; a policy, as from `track`; or a policy with a filter, as
        `OffsetFree(...).policy`. A controller that solves while it runs, or a function, cannot be exported.
      folder: the folder for the files. Files of these names are replaced.
      number: the type of all numbers except the time, which is a double.
      gains: how matrices are stored; int16 takes 16 bits an entry, relative to its largest magnitude.
      interpolate: whether to interpolate between the laws of two knots, as `AffinePolicy` does; not with a filter.
      name: name of the files and the functions: lower-case letters, digits and underscores, beginning with a letter;
        not that of a header of C, such as math.
    """
    folder = check_path("folder", folder, "the path of a folder")
    if not re.fullmatch("[a-z][a-z0-9_]*", name) or name in ("main", "stm32f405"):
        raise InputError(f"name: got {excerpt(name)}, want lower-case letters, digits and _, such as policy")
    if name in HEADERS.split():
        raise InputError(f"name: got {excerpt(name)}, the name of a header of C, want another, such as policy")
    law = policy.policy if isinstance(policy, Solution) else policy
    if interpolate and isinstance(law, OutputFeedbackPolicy):
        raise InputError("interpolate: got True for an OutputFeedbackPolicy, want False: a filter has one law a period")
    kind = FILTER if isinstance(law, OutputFeedbackPolicy) else FEEDBACK
    measured = law.measured_coordinates if isinstance(law, OutputFeedbackPolicy) else law.state_coordinates
    tables, values = _Tables(number, gains), _values(law)
    for field, array in values.items():
        tables.add(field, array)
    low, high = _limits(law.control_coordinates, DTYPES[number])
    tables.plain("lowest", low)
    tables.plain("highest", high)
    relative = TOLERANCES["int16" if gains == "int16" else number]
    rows, tolerance = _test_rows(law, measured, values, DTYPES[number], relative, interpolate)
    sha, parts = hash_of(policy), kind | (BLENDED if interpolate else HELD)
    parts |= {
        "version": version("lqrsim"), "rounding": _rounding_text(law, tables, number, gains), "sha256": sha,
        "entries": _entries(measured, values.get("expected", law.nominal)[0], law.control_coordinates),
        "period": repr(law.dt), "horizon": f"{law.steps * law.dt:.6g}", "T": str(law.steps),
        "n": str(len(law.state_coordinates)), "Y": str(len(measured)), "m": str(len(law.control_coordinates)),
        "Z": str(law.nominal.shape[1]), "bytes": str(tables.bytes), "real": number, "tables": tables.text(),
        "nearest": _nearest(law, number), "share": f"{relative:g}", "tolerance": _list(map(repr, tolerance.tolist())),
        "rows": rows,
    }  # fmt: skip
    files, templates = [], {f"{name}.h": "my_policy.h", f"{name}.c": kind["source"]} | {file: file for file in STATIC}
    for file, template in templates.items():
        text = (TEMPLATES / template).read_text(encoding="utf-8")
        text = re.sub("@([A-Za-z0-9]+)@", lambda match: parts[match[1]], text)
        text = text.replace(PREFIX, name).replace(PREFIX.upper(), name.upper())
        write_text(folder / file, text)
        files.append(folder / file)
    return ExportedC(
        files=tuple(files), sha256=sha, table_bytes=tables.bytes, rounding=tuple(tables.rounding["gain"].tolist()),
        controls=law.control_coordinates.labels,
    )  # fmt: skip


class _Tables:
    """The constant tables of a policy, as C text.

    Attributes:
      rounding: name of a table of matrices (T, rows, columns) -> the sum over the columns of the largest rounding error
        of each entry, (rows,).
      relative_error: the largest rounding error of an entry, relative to the entry's largest magnitude over the steps.
    """

    def __init__(self, number: str, gains: str) -> None:
        self._number, self._short = number, gains == "int16"
        self._lines: list[str] = []
        self.bytes, self.rounding, self.relative_error = 0, dict[str, Array](), 0.0

    def add(self, name: str, array: Array) -> None:
        """Add a table (T, rows) or (T, rows, columns), and the macro that reads it: NAME(k, i, j).

        Entries that are the same in all steps, as those of a filter's unknowns, are stored once.
        """
        if not np.isfinite(array).all():
            raise InputError(f"policy: {name}: got NaN or infinity in it, want finite numbers")
        short = self._short and array.ndim == 3
        if short:
            unit = self._rounded(name, np.abs(array).max(axis=0) / LARGEST)
            numbers = np.divide(array, unit, out=np.zeros_like(array), where=unit > 0).round().clip(-LARGEST, LARGEST)
            stored, kind = numbers * unit, "short"
            self.plain(f"{name}_unit", unit)
        else:
            stored = numbers = self._rounded(name, array)
            kind = "real"
        changes, at = (numbers != numbers[0]).any(axis=0), "[i][j]" if array.ndim == 3 else "[i]"
        if changes.all():
            read = f"{name}[k]{at}"
            self._write(name, numbers, kind)
        else:
            read = f"{name}_fixed{at}"
            self._write(f"{name}_fixed", numbers[0], kind)
        if 0 < changes.sum() < changes.size:
            read = f"({name}_at{at} < 0 ? {read} : {name}[k][{name}_at{at}])"
            self._write(f"{name}_at", np.where(changes, np.cumsum(changes).reshape(changes.shape), 0) - 1, "short")
            self._write(name, numbers[:, changes], kind)
        if short:
            read = f"((real){read} * {name}_unit[i][j])"
        self._lines.append(f"#define {name.upper()}({'k, i, j' if array.ndim == 3 else 'k, i'}) {read}\n")
        if array.ndim == 3:
            off, largest = np.abs(stored - array).max(axis=0), np.abs(array).max(axis=0)
            self.rounding[name] = off.sum(axis=-1)
            relative = np.divide(off, largest, out=np.zeros_like(off), where=largest > 0)
            self.relative_error = max(self.relative_error, float(relative.max()))

    def plain(self, name: str, array: Array) -> None:
        """Add an array whose numbers the type represents exactly."""
        self._write(name, array, "real")

    def text(self) -> str:
        real = self._number == "float"
        constants = [
            f"#define TURN {_number(2 * np.pi, self._number)}", f"#define RINT {'rintf' if real else 'rint'}",
            f"#define SQRT {'sqrtf' if real else 'sqrt'}", f"#define SMALL {_number(1e-12, self._number)}\n",
        ]  # fmt: skip
        return "\n".join([*constants, *self._lines])

    def _rounded(self, name: str, array: Array) -> Array:
        with np.errstate(over="ignore"):
            rounded = array.astype(DTYPES[self._number]).astype(np.float64)
        if not np.isfinite(rounded).all():
            raise InputError(f"policy: {name}: got {np.abs(array).max():g} in it, want numbers that a float holds")
        return rounded

    def _write(self, name: str, array: Array, kind: str) -> None:
        self.bytes += array.size * (2 if kind == "short" else np.dtype(DTYPES[self._number]).itemsize)
        sizes = "".join(f"[{length}]" for length in array.shape)

        def text_of(array: Array) -> str:
            if array.ndim == 1:
                return _list(f"{int(value)}" if kind == "short" else _number(value, self._number) for value in array)
            return "{" + (",\n" if array.ndim < 3 else ",\n\n").join(map(text_of, array)) + "}"

        self._lines.append(f"static const {kind} {name}{sizes} = {text_of(array)};")


def _number(value: float, number: str) -> str:
    """A number in C that reads as the same bits."""
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return f"{np.float32(value)!s}f" if number == "float" else repr(float(value))


def _list(parts: Iterable[str]) -> str:
    return "{" + ", ".join(parts) + "}"


def _values(law: AffinePolicy | OutputFeedbackPolicy) -> dict[str, Array]:
    """The tables by name: for a filter as in filter.c, for any other law as in feedback.c."""
    nominal, n = law.nominal, len(law.state_coordinates)
    planned = law.offset + np.einsum("tij,tj->ti", law.gain, nominal)
    values = {"planned": planned, "gain": law.gain, "nominal": nominal}
    if isinstance(law, AffinePolicy):
        return values
    moved = np.einsum("tij,tj->ti", law.transition, nominal) + np.einsum("tij,tj->ti", law.input, planned)
    return values | {
        "correction": law.correction, "sensor": law.sensor,
        "expected": law.sensor_offset + np.einsum("tij,tj->ti", law.sensor, nominal[:, :n]),
        "transition": law.transition, "input": law.input, "next": moved + law.drift,
    }  # fmt: skip


def _limits(controls: Coordinates, dtype: npt.DTypeLike) -> tuple[Array, Array]:
    """The limits in the number type, rounded inwards, (m,) each."""
    low, high = controls.limits
    with np.errstate(over="ignore"):
        lowest, highest = low.astype(dtype), high.astype(dtype)
    lowest = np.where(lowest < low, np.nextafter(lowest, np.array(np.inf, dtype)), lowest)
    highest = np.where(highest > high, np.nextafter(highest, np.array(-np.inf, dtype)), highest)
    return lowest.astype(np.float64), highest.astype(np.float64)


def _nearest(law: AffinePolicy | OutputFeedbackPolicy, number: str) -> str:
    """The C functions that replace angles and rotation vectors by the representatives nearest to others."""
    spaces = {"nearest_state": law.state_coordinates}
    if isinstance(law, OutputFeedbackPolicy):
        spaces["nearest_measured"] = law.measured_coordinates
    text = ""
    if any(space.rotation_vectors for space in spaces.values()):
        text = f"{(TEMPLATES / 'rotation.c').read_text(encoding='utf-8')}\n"
    for name, space in spaces.items():
        lines = ["(void)x;", "(void)near;"] if not (space.angles or space.rotation_vectors) else []
        lines += [f"x[{i}] -= TURN * RINT((x[{i}] - near[{i}]) / TURN);" for i in space.angles]
        rotations = zip(space.rotation_vectors, space.turns, strict=True)
        lines += [f"nearest_rotation(x + {i}, near + {i}, {turn});" for i, turn in rotations]
        inside = "".join(f"    {line}\n" for line in lines)
        text += "/* Replace angles and rotation vectors by their representatives nearest to others. */\n"
        text += f"static void {name}(real *x, const real *near)\n{{\n{inside}}}\n\n"
    return text


def _comment(text: str) -> str:
    """Any text, made safe for a comment in C: plain ASCII that neither ends the comment nor looks like a trigraph."""
    return re.sub(r"(?<=\*)(?=/)|(?<=/)(?=\*)", " ", re.sub(r"[^ -~]|[?\\]", "_", text))


def _entries(measured: Coordinates, start: Array, controls: Coordinates) -> str:
    """The lines of a comment that name measured numbers, with their values (Y,) at the start, and commands."""
    lines = ["measured, with what the plan expects at its start:"]
    turning = {i + j: ", of a rotation vector" for i in measured.rotation_vectors for j in range(3)}
    turning |= dict.fromkeys(measured.angles, ", an angle")
    for i, (label, value) in enumerate(zip(measured.labels, start.tolist(), strict=True)):
        lines.append(f"  {i}: {label}{turning.get(i, '')}, {value:.6g}")
    lines.append("command, with its limits:")
    limits = zip(controls.labels, controls.low, controls.high, strict=True)
    lines += [f"  {i}: {label}, {low:g} to {high:g}" for i, (label, low, high) in enumerate(limits)]
    return "\n".join(f" * {_comment(line)}" for line in lines)


def _rounding_text(law: AffinePolicy | OutputFeedbackPolicy, tables: _Tables, number: str, gains: str) -> str:
    lines = [f"Numbers are stored as {number}."]
    if gains == "int16":
        most = _rounded_up(tables.relative_error)
        lines = [f"Matrices are stored in 16 bits, each entry with an error of at most {most} of its"]
        lines += [f"largest magnitude over the steps; other numbers as {number}."]
    lines += [*f"{ROUNDING_MEANING}:".split("\n"), *_bounds(law.control_coordinates.labels, tables.rounding["gain"])]
    return "\n * ".join(map(_comment, lines))


def _bounds(labels: Iterable[str], rounding: Iterable[float]) -> list[str]:
    return [f"  {label}: {_rounded_up(most)}" for label, most in zip(labels, rounding, strict=True)]


def _rounded_up(value: float) -> str:
    """A bound with three digits, rounded up."""
    return f"{value * 1.005:.2e}"


def _test_rows(
    law: AffinePolicy | OutputFeedbackPolicy, space: Coordinates, values: dict[str, Array], dtype: npt.DTypeLike,
    relative: float, interpolate: bool,
) -> tuple[str, Array]:  # fmt: skip
    """The rows of main.c's test, Python's commands for random measurements; and the tolerance of each control (m,)."""
    rng, rows = np.random.default_rng(0), []
    largest = np.zeros(len(law.control_coordinates))
    filtered = isinstance(law, OutputFeedbackPolicy)
    periods = [0, 1, 1.5, law.steps // 2, law.steps - 1.25, law.steps - 1, law.steps, 2 * law.steps]
    times = np.arange(12.0) if filtered else np.abs(periods)
    z = law.start() if filtered else law.nominal[0]
    expected = values.get("expected", law.nominal)
    # A filter takes the scatter of its measurements for fast motion, so there is less of it.
    spread = np.minimum(0.1 * np.ptp(expected, axis=0) + 0.01, 0.3) / (100 if filtered else 1)
    for place, period in enumerate(times):
        t, k = float(period) * law.dt, min(int(period), law.steps - 1)
        measured = expected[k] + spread * rng.standard_normal(len(space))
        for i in space.angles:
            measured[i] += 2 * np.pi * rng.integers(-1, 2)
        measured = measured.astype(dtype).astype(np.float64)
        lost = filtered and place % 5 == 3
        state = z
        if filtered:
            command, z = law.step(z, None if lost else measured, t)
        else:
            command, state = law(measured, t, interpolate=interpolate), measured
        rows.append(
            f"    {{{t!r}, {int(lost)}, {_list(map(repr, measured.tolist()))}, {_list(map(repr, command.tolist()))}}},"
        )
        sums = np.abs(values["gain"][k]) @ (np.abs(state) + np.abs(law.nominal[k])) + np.abs(values["planned"][k])
        largest = np.maximum(largest, sums)
    return "\n".join(rows), relative * largest
