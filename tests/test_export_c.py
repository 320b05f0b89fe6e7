"""Policies as C: commands as in Python, within bounds that follow from the rounding of each operation."""

import ctypes
import itertools
import json
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_c import QEMU, VARIANTS, WARNINGS, CompiledLaw, difference
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples, rarely

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.control.controllers import as_controller
from lqrsim.errors import Array
from lqrsim.scenarios.references import disturbance_set
from lqrsim.stress.statistics import rate
from lqrsim.stress.study import make_controller

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler, cc")
needs_arm = pytest.mark.skipif(
    not all(map(shutil.which, ("arm-none-eabi-gcc", "qemu-system-arm", "cmake"))),
    reason="needs arm-none-eabi-gcc, qemu-system-arm and cmake",
)
# Names of anyone: in comments of C they must neither end the comment nor make it one of two lines.
NAMES = st.text(st.characters(exclude_categories=("C", "Z")), min_size=1, max_size=8) | st.sampled_from(
    ["*/", "/*", "a\\", "??/", "@T@"]
)


@dataclass(frozen=True)
class Case:
    """Options of an export, and numbers of all that is drawn at random."""

    number: str
    gains: str
    seed: int

    @property
    def rng(self) -> np.random.Generator:
        return np.random.default_rng(self.seed)

    @property
    def dtype(self) -> Any:
        return np.float32 if self.number == "float" else np.float64

    @property
    def rounding(self) -> float:
        """Of one operation, relative."""
        return 2.0**-24 if self.number == "float" else 2.0**-53


CASES = st.builds(
    Case, st.sampled_from(["float", "double"]), st.sampled_from(["full", "int16"]), st.integers(0, 2**32 - 1)
)


@st.composite
def coordinates(draw: st.DrawFn, sizes: st.SearchStrategy[int], *, turning: bool) -> ls.types.Coordinates:
    """Names, units, angles and rotation vectors, or limits on both sides, on one, or none."""
    names = draw(st.lists(NAMES, min_size=(size := draw(sizes)), max_size=size, unique=True))
    units = draw(st.lists(NAMES, min_size=size, max_size=size))
    if not turning:
        low = [draw(st.sampled_from([-np.inf, -1.1, -0.3])) for _ in names]
        high = [draw(st.sampled_from([np.inf, 0.7, 0.1])) for _ in names]
        return ls.types.Coordinates(names=tuple(names), units=tuple(units), low=tuple(low), high=tuple(high))
    vector = (size - 3,) if size >= 3 and draw(st.booleans()) else ()
    angles = tuple(i for i in range(size - 3 * len(vector)) if draw(st.booleans()))
    angles += tuple(first + draw(st.integers(0, 2)) for first in vector if draw(st.booleans()))
    for i in (*angles, *(first + k for first in vector for k in range(3))):
        units[i] = "rad"
    return ls.types.Coordinates(names=tuple(names), units=tuple(units), angles=angles, rotation_vectors=vector)


@st.composite
def affine_policies(draw: st.DrawFn) -> tuple[Case, ls.AffinePolicy]:
    case, space = draw(CASES), draw(coordinates(st.integers(1, 6), turning=True))
    controls, steps = draw(coordinates(st.integers(1, 3), turning=False)), draw(st.integers(1, 5))
    rng, n, m = case.rng, len(space), len(controls)
    scale = 10.0 ** rng.uniform(-2, 2, size=(m, n))
    policy = ls.AffinePolicy(
        gain=scale * rng.normal(size=(steps, m, n)), offset=rng.normal(size=(steps, m)),
        nominal=2 * rng.normal(size=(steps, n)), dt=draw(st.sampled_from([0.01, 1 / 30, 1 / 6])),
        state_coordinates=space, control_coordinates=controls,
    )  # fmt: skip
    return case, policy


@st.composite
def filters(draw: st.DrawFn) -> tuple[Case, ls.types.OutputFeedbackPolicy]:
    """Filters with random recursions that forget; some rows are the same in all steps, as those of unknowns."""
    case, space = draw(CASES), draw(coordinates(st.integers(1, 4), turning=True))
    controls, measured = (draw(coordinates(st.integers(1, 3), turning=turning)) for turning in (False, True))
    steps, rng = draw(st.integers(1, 4)), case.rng
    n, m, Y = len(space), len(controls), len(measured)
    Z = n + draw(st.integers(0, 3))

    def drawn(*shape: int, size: float = 1.0) -> Array:
        values = size * rng.normal(size=(steps, *shape)) / np.sqrt(shape[-1])
        same = draw(st.integers(0, shape[0]))
        values[:, shape[0] - same :] = values[0, shape[0] - same :]
        return values

    policy = ls.types.OutputFeedbackPolicy(
        gain=drawn(m, Z), offset=drawn(m), correction=drawn(Z, Y, size=0.2), sensor=drawn(Y, n), sensor_offset=drawn(Y),
        transition=drawn(Z, Z, size=0.5), input=drawn(Z, m), drift=drawn(Z), nominal=drawn(Z), dt=0.05,
        state_coordinates=space, control_coordinates=controls, measured_coordinates=measured,
    )  # fmt: skip
    return case, policy


def turned(space: ls.types.Coordinates, near: Array, rng: np.random.Generator, size: float) -> Array:
    """States by up to `size` beside others, with whole turns on top; what is nearest is clear, up to rounding."""
    state = near + rng.uniform(-size, size, size=len(space))
    for i in space.angles:
        state[i] = near[i] + rng.uniform(-3, 3) + 2 * np.pi * rng.integers(-3, 4)
    for i in space.rotation_vectors:
        own = [j for j in range(i, i + 3) if j not in space.angles]
        beside = near[own] + rng.uniform(-0.5, 0.5, size=len(own))
        state[own] = beside * (1 + 2 * np.pi * rng.integers(-2, 3) / np.linalg.norm(beside))
    return state


def magnitude(space: ls.types.Coordinates, *vectors: Array) -> Array:
    """The sum of absolute values, (n,); in a rotation vector, of lengths."""
    total = np.sum(np.abs(vectors), axis=0)
    for i in space.rotation_vectors:
        total[i : i + 3] = sum(np.linalg.norm(vector[i : i + 3]) for vector in vectors)
    return total


def beside(case: Case, space: ls.types.Coordinates, shown: Array, near: Array, off: Array) -> tuple[Array, Array]:
    """The deviation from the nearest representative, and a bound of its error, (n,) each; `off` is that of `near`.

    Up to second order: an angle is turned by two operations, whose constant is rounded, too, and the difference is one
    more; a rotation vector is normalised, its angle summed and turned, and scaled again, fewer than 16 roundings. All
    act on numbers no larger than the sum of the magnitudes of what is shown, what is nearest, and the nominal.
    """
    nearest = space.nearest(shown, near)
    return nearest - near, off + 16 * case.rounding * magnitude(space, shown, nearest, near)


def product(case: Case, matrices: Array, k: int, x: Array, off: Array) -> Array:
    """A bound of the error of `matrix_k x + b`, less that of b's own size, for an x that is `off`.

    Each term has the rounding of the entry (16 bits: also of its unit, and half a unit), of the product and of the sums
    after it, of which there are as many as columns, and b.
    """
    units = np.abs(matrices).max(axis=0) / 32767 if case.gains == "int16" else np.zeros(matrices.shape[1:])
    entries = np.abs(matrices[k])
    # A hundredth more than half a unit, for the unit is rounded.
    return entries @ off + (0.505 * units + (matrices.shape[2] + 5) * case.rounding * entries) @ (np.abs(x) + off)


@needs_compiler
@settings(max_examples=examples(20))
@given(drawn=affine_policies(), interpolate=st.booleans())
def test_policies_command_what_they_do_in_python(
    drawn: tuple[Case, ls.AffinePolicy], interpolate: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    case, policy = drawn
    law = CompiledLaw(
        policy, tmp_path_factory.mktemp("c"), number=case.number, gains=case.gains, interpolate=interpolate
    )
    rng, space, T, dt = case.rng, policy.state_coordinates, policy.steps, policy.dt
    knots = np.concatenate([np.arange(T + 2) * dt, np.nextafter(np.arange(1, T + 2) * dt, 0)])
    for t in [*knots, *rng.uniform(0, (T + 1) * dt, size=10), 1e6]:
        k = int(min(t / dt + 1e-9, T - 1))
        after, last = (max(t / dt - k, 0.0), min(k + 1, T - 1)) if interpolate else (0.0, k)
        weight = after if last > k else 0.0
        near = (1 - weight) * policy.nominal[k] + weight * policy.nominal[last]
        state = turned(space, near, rng, rng.choice([0.01, 3.0])).astype(case.dtype).astype(np.float64)
        python = policy(state, t, interpolate=interpolate)
        # Where two laws are blended, the errors are, too, and the weight and its products have three roundings more.
        bound = np.zeros(len(python))
        for i in {k, last}:
            off = 4 * case.rounding * (np.abs(policy.nominal[k]) + np.abs(policy.nominal[last]))
            _, off = beside(case, space, state, near, off)
            off += 4 * case.rounding * np.abs(policy.nominal[i])
            d = space.nearest(state, near) - policy.nominal[i]
            planned = np.abs(policy.offset[i] + policy.gain[i] @ policy.nominal[i])
            error = product(case, policy.gain, i, d, off)
            sums = planned + np.abs(policy.gain[i]) @ np.abs(d)
            error += (len(space) + 8) * case.rounding * sums
            # Python's own sums, which are not about the nominal.
            error += 1e-14 * (
                np.abs(policy.offset[i]) + np.abs(policy.gain[i]) @ (np.abs(state) + np.abs(policy.nominal[i]))
            )
            bound = np.maximum(bound, error)
        bound += 2 * case.rounding * np.abs(python)  # of a limit
        command = law(state, t)
        assert (np.abs(command - python) <= bound).all()
        if case.number == "double" and case.gains == "full":
            scale = np.abs(policy.offset).max(axis=0) + np.abs(policy.gain).max(axis=0) @ magnitude(space, state, near)
            np.testing.assert_array_less(np.abs(command - python), 1e-12 * (scale + 1))
        controls = policy.control_coordinates
        assert ((command >= controls.low) & (command <= controls.high)).all()


@needs_compiler
@settings(max_examples=examples(20))
@given(drawn=filters())
def test_filters_estimate_and_command_what_they_do_in_python(
    drawn: tuple[Case, ls.types.OutputFeedbackPolicy], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """One step from any estimate, with a measurement or without; in double also a whole run."""
    case, policy = drawn
    law = CompiledLaw(policy, tmp_path_factory.mktemp("c"), number=case.number, gains=case.gains)
    rng, space, seen, u = case.rng, policy.state_coordinates, policy.measured_coordinates, case.rounding
    n, T = len(space), policy.steps
    for step, lost in itertools.product([*range(T + 2), 1000], (False, True)):
        k, t = min(step, T - 1), step * policy.dt
        nominal = policy.nominal[k]
        state = np.concatenate([turned(space, nominal[:n], rng, 1.0), nominal[n:] + rng.normal(size=len(nominal) - n)])
        z = state.astype(case.dtype)
        state = z.astype(np.float64)
        d, off = state - nominal, 4 * u * (np.abs(state) + np.abs(nominal))
        d[:n], off[:n] = beside(case, space, state[:n], nominal[:n], 4 * u * np.abs(nominal[:n]))
        sensor = np.abs(policy.sensor[k])
        expected = policy.sensor[k] @ (d[:n] + nominal[:n]) + policy.sensor_offset[k]
        measured = turned(seen, expected, rng, 1.0).astype(case.dtype).astype(np.float64)
        if not lost:
            level = np.abs(policy.sensor[k] @ nominal[:n] + policy.sensor_offset[k])
            wrong = product(case, policy.sensor, k, d[:n], off[:n])
            wrong += (n + 5) * u * (level + sensor @ np.abs(d[:n]))
            innovation, wrong = beside(case, seen, measured, expected, wrong)
            off = off + product(case, policy.correction, k, innovation, wrong) + (len(seen) + 3) * u * np.abs(d)
            d = d + policy.correction[k] @ innovation
        python, after = policy.step(state, None if lost else measured, t)
        planned = policy.offset[k] + policy.gain[k] @ nominal
        wrong = (
            product(case, policy.gain, k, d, off) + (len(d) + 5) * u * (np.abs(planned) + 1) + 2 * u * np.abs(python)
        )
        moved = policy.transition[k] @ nominal + policy.input[k] @ planned + policy.drift[k]
        off = product(case, policy.transition, k, d, off)
        off += product(case, policy.input, k, python - planned, wrong + 4 * u * np.abs(planned))
        off += (len(d) + len(planned) + 5) * u * (np.abs(moved) + np.abs(policy.transition[k]) @ np.abs(d))
        law.swap(z)
        command = law(None if lost else measured, t)
        law.swap(z)
        # Python's own sums are of numbers that may be larger: some hundred roundings of double, of numbers below 100.
        assert (np.abs(command - python) <= wrong + 1e-12).all()
        assert (np.abs(z - after) <= off + 1e-12).all()
    if case.number == "double" and case.gains == "full":
        law.init()
        state = nudged = policy.start()
        for step in range(T + 20):
            t, k = step * policy.dt, min(step, T - 1)
            expected = policy.sensor[k] @ policy.nominal[k, :n] + policy.sensor_offset[k]
            measured = None if step % 3 == 1 else expected + 0.1 * rng.normal(size=len(seen))
            python, state = policy.step(state, measured, t)
            # Rounding errors grow from step to step, for the drawn filters need not be stable; these grow as fast.
            other, nudged = policy.step(nudged + 1e-13 * (1 + np.abs(nudged)), measured, t)
            assert (np.abs(law(measured, t) - python) <= 1e-9 + np.abs(other - python)).all()


@needs_compiler
@pytest.mark.parametrize("kind", ["feedback", "filter"])
def test_what_python_refuses_is_refused_and_changes_nothing(
    drive_solution: ls.Solution, differential_drive: ls.Scenario, tmp_path: Path, kind: str
) -> None:
    policy: ls.AffinePolicy | ls.types.OutputFeedbackPolicy = drive_solution.policy
    if kind == "filter":
        stated = ls.uncertainty_of(differential_drive.plant(), [ls.disturbances.MeasurementNoise(0.01)])
        law = ls.OffsetFree(differential_drive.problem, drive_solution, stated, tolerate={"m": 0.1, "rad": 0.2})
        policy = law.policy
    law = CompiledLaw(policy, tmp_path)
    state = policy.nominal[0, :3] + 0.01
    command = law(state, 0.0)
    law.init()
    refused = [(state, -1e-9), (state, np.nan), (state, np.inf), (np.array([0.0, np.nan, 0.0]), 0.0)]
    refused += [(np.array([0.0, 0.0, np.inf]), 0.0)]
    for measured, t in refused:
        with pytest.raises(ValueError, match="refused"):
            law(measured, t)
    assert (law(state, 0.0) == command).all()
    if kind == "feedback":
        with pytest.raises(ValueError, match="refused"):
            law(None, 0.0)
        return
    shutil.copy(tmp_path / "policy.so", tmp_path / "not_begun.so")  # with variables of its own
    other, commands = ctypes.CDLL(str(tmp_path / "not_begun.so")), np.full(2, np.nan)
    other.policy_step.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_void_p]
    assert other.policy_step(None, 0.0, commands.ctypes.data) == 1
    assert np.isnan(commands).all()
    other.policy_init()
    assert other.policy_step(None, 0.0, commands.ctypes.data) == 0


@needs_compiler
@settings(max_examples=examples(10))
@given(drawn=affine_policies() | filters(), size=st.floats(20.0, 38.5))
def test_numbers_that_overflow_are_refused_and_change_nothing(
    drawn: tuple[Case, ls.AffinePolicy | ls.types.OutputFeedbackPolicy],
    size: float,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Finite floats of up to 10**38.5, as of a broken packet: a command within its limits, or none."""
    case, policy = drawn
    law = CompiledLaw(policy, tmp_path_factory.mktemp("c"), number="float", gains=case.gains)
    filters = isinstance(policy, ls.types.OutputFeedbackPolicy)
    space = policy.measured_coordinates if filters else policy.state_coordinates
    controls = policy.control_coordinates

    def estimate() -> Array:
        z = np.zeros(policy.nominal.shape[1] if filters else 0, dtype=np.float32)
        law.swap(z)
        found = z.copy()
        law.swap(z)
        return found

    for step in range(20):
        before = estimate()
        largest = np.minimum(10.0 ** (size - case.rng.uniform(0, 3, len(space))), 3.4e38)
        try:
            command = law(largest * case.rng.choice([-1.0, 1.0], len(space)), step * policy.dt)
        except ValueError:
            assert (estimate() == before).all()
        else:
            assert np.isfinite([*command, *estimate()]).all()
            assert ((command >= controls.low) & (command <= controls.high)).all()


@needs_compiler
def test_a_difference_of_infinities_is_no_command(tmp_path: Path) -> None:
    """10 * 3e38 - 10 * 3e38 in float, which comparisons with the limits let through."""
    names = ls.types.Coordinates(names=("a", "b"), units=("m", "m"))
    controls = ls.types.Coordinates(names=("u",), units=("N",), low=(-1.0,), high=(1.0,))
    policy = ls.AffinePolicy(
        gain=np.full((2, 1, 2), 10.0), offset=np.zeros((2, 1)), nominal=np.arange(4.0).reshape(2, 2), dt=0.1,
        state_coordinates=names, control_coordinates=controls,
    )  # fmt: skip
    law = CompiledLaw(policy, tmp_path, number="float")
    with pytest.raises(ValueError, match="refused"):
        law(np.array([3e38, -3e38]), 0.0)
    assert law(np.array([3e30, -3e30]), 0.0) == 0


def built(folder: Path) -> subprocess.CompletedProcess[str]:
    """What the example says, as the host's compiler makes it."""
    subprocess.run(["cc", *WARNINGS, "-o", "example", "main.c", "policy.c", "-lm"], cwd=folder, check=True)
    return subprocess.run([folder / "example"], capture_output=True, text=True, check=False)


@needs_compiler
@pytest.mark.parametrize("gains", ["full", "int16"])
def test_the_command_writes_what_its_example_finds_to_be_as_in_python(
    drive_solution: ls.Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str], gains: str
) -> None:
    ls.save(drive_solution, tmp_path / "solution.npz")
    assert main(["export", str(tmp_path / "solution.npz"), "--c", str(tmp_path / "c"), "--gains", gains]) == 0
    said = capsys.readouterr().out
    with np.load(tmp_path / "solution.npz") as file:
        sha256 = json.loads(str(file["meta"]))["sha256"]
    header = (tmp_path / "c/policy.h").read_text(encoding="utf-8")
    assert f'#define POLICY_SHA256 "{sha256}"' in header
    assert f"SHA-256 {sha256}" in said
    for controls in ("left (m/s)", "right (m/s)"):
        bound = next(line for line in said.splitlines() if controls in line)
        assert bound.strip() in header
    nominal = drive_solution.policy.nominal[0]
    assert f" *   0: x (m), {nominal[0]:.6g}\n" in header
    assert f" *   2: heading (rad), an angle, {nominal[2]:.6g}\n" in header
    assert "The plan lasts 25 s." in header

    example = built(tmp_path / "c")
    assert example.returncode == 0
    assert example.stdout.endswith(f"{sha256}: as in Python\n")
    source = (tmp_path / "c/policy.c").read_text(encoding="utf-8")
    (tmp_path / "c/policy.c").write_text(source.replace("sum += GAIN", "sum -= GAIN"), encoding="utf-8")
    example = built(tmp_path / "c")
    assert example.returncode == 1
    assert "WRONG" in example.stdout


def test_sixteen_bits_are_off_by_what_is_said(drive_solution: ls.Solution, tmp_path: Path) -> None:
    """Half a unit an entry, of which 32767 are the largest magnitude: no more, and nearly as much."""
    gain = drive_solution.policy.gain
    most = (np.abs(gain).max(axis=0) / 32767 / 2).sum(axis=1)
    rounding = np.array(ls.export_c(drive_solution, tmp_path, number="double", gains="int16").rounding)
    assert (rounding <= most * (1 + 1e-9)).all()
    assert (rounding > 0.8 * most).all()  # of 150 gains some are nearly half a unit off
    assert ls.export_c(drive_solution, tmp_path, number="double").rounding == (0.0, 0.0)


@needs_compiler
def test_it_flies_as_python_does(drive_solution: ls.Solution, differential_drive: ls.Scenario, tmp_path: Path) -> None:
    """Trials in MuJoCo under disturbances, whose measurements come late and get lost."""
    problem, plant = differential_drive.problem, differential_drive.plant()
    hard = [
        ls.disturbances.ControlNoise(0.05), ls.disturbances.MeasurementNoise(0.01),
        ls.disturbances.MeasurementLatency(1), ls.disturbances.MeasurementDropouts(0.2),
    ]  # fmt: skip
    stated = ls.uncertainty_of(plant, hard)
    for name, policy in {
        "smooth": drive_solution.policy,
        "track": ls.track(problem, drive_solution, uncertainty=stated),
        "offset_free": ls.OffsetFree(problem, drive_solution, stated).policy,
    }.items():
        (tmp_path / name).mkdir()
        law = CompiledLaw(policy, tmp_path / name)
        compiled, python = (
            ls.simulate(plant, drive_solution, controller=one, disturbances=hard, trials=3) for one in (law, policy)
        )
        again = as_controller(policy, drive_solution, problem.dynamics)[0].start(3)
        for step in range(problem.steps):
            commands = again.control(step, compiled.controller_run.shown[step])
            np.testing.assert_allclose(compiled.commanded[:, step], commands, rtol=0, atol=1e-12)
        assert compiled.outcome == python.outcome
        assert np.isnan(compiled.controller_run.shown).any() == (name == "offset_free")


@needs_compiler
@pytest.mark.parametrize("preset", ["moderate", *rarely("light")])
def test_it_reaches_the_goal_as_often(
    preset: str, quadrotor: ls.Scenario, quadrotor_solution: ls.Solution, tmp_path: Path
) -> None:
    """Within the 95 % interval of Python's rate, which is neither 0 nor 1 here; `experiments/export_c.py` has more."""
    law, disturbances = make_controller("track", quadrotor, quadrotor_solution), disturbance_set(preset, quadrotor)
    assert isinstance(law, ls.AffinePolicy)
    flown = partial(ls.simulate, quadrotor.plant(), quadrotor_solution, disturbances=disturbances, trials=24)
    python = rate(flown(controller=law).outcome.count("reached"), 24)
    assert 0 < python.value < 1
    for variant, options in VARIANTS.items():
        (tmp_path / variant).mkdir()
        compiled = flown(controller=CompiledLaw(law, tmp_path / variant, **options))
        assert python.low <= compiled.outcome.count("reached") / 24 <= python.high
        if variant == "double":
            assert difference(compiled, law, quadrotor_solution) < 1e-12


@needs_arm
def test_the_example_on_an_emulated_stm32f405(drive_solution: ls.Solution, tmp_path: Path) -> None:
    """By the commands of the page; and what it prints is what it prints here, to the last bit of float."""
    folder = tmp_path / "firmware" / "policy"
    ls.export_c(drive_solution, folder, gains="int16", interpolate=True)
    here = built(folder)
    page = (Path(__file__).parent.parent / "docs" / "microcontrollers.md").read_text(encoding="utf-8")
    _, section = page.split("## On an emulated board\n")
    (commands,) = re.findall(r"^```\n(cmake .*?)^```$", section.split("\n## ")[0], re.MULTILINE | re.DOTALL)
    said = subprocess.run(
        ["sh", "-e", "-c", commands], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert said.returncode == 0, said.stdout + said.stderr
    assert "100% tests passed" in said.stdout
    assert said.stdout.endswith(here.stdout)  # of the last command
    assert here.stdout.endswith(": as in Python\n")

    faulty = 'int main(void)\n{\n    __asm volatile("udf #0");\n    return 0;\n}\n'
    (folder / "main.c").write_text(faulty, encoding="utf-8")
    subprocess.run(["cmake", "--build", "build-arm"], cwd=tmp_path, capture_output=True, check=True)
    board = [*QEMU, "-kernel", "build-arm/policy_example"]
    assert subprocess.run(board, cwd=tmp_path, timeout=60, check=False).returncode == 1  # and does not hang


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policy": lambda x, t: [0, 0]}, "policy: got <function .*want a Solution, an AffinePolicy"),
        ({"number": "half"}, "number: got 'half', want one of: float, double"),
        ({"gains": "int8"}, "gains: got 'int8', want one of: full, int16"),
        ({"interpolate": 1}, "interpolate: got 1, want"),
        ({"name": "my policy"}, "name: got 'my policy', want lower-case letters"),
        ({"name": "main"}, "name: got 'main', want lower-case letters"),
        ({"name": 41 * "a"}, "name: got 41 characters, .*, want a name of at most 40$"),
        ({"factor": np.nan}, "policy: planned: got NaN or infinity in it, want finite numbers"),
        ({"factor": 1e300}, "policy: planned: got .*, want numbers that a float holds"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_a_line(
    drive_solution: ls.Solution, tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    policy = drive_solution.policy
    if factor := options.pop("factor", None):
        policy = replace(policy, gain=factor * policy.gain)
    with pytest.raises(ls.InputError, match=message):
        ls.export_c(**{"policy": policy, "folder": tmp_path / "c"} | options)
    assert not (tmp_path / "c").exists()


def read_from_the_system(compiler: str, headers: list[str]) -> set[str]:
    """Names of the headers that a compiler reads for these from the folders that it searches, by its own account."""
    text = "".join(f"#include <{header}>\n" for header in headers)
    command = [compiler, "-x", "c++" if compiler == "c++" else "c", "-E", "-v", "-"]
    said = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    folders = {Path(one).resolve() for one in re.findall(r"^ (/.*)$", said.stderr, re.MULTILINE)}
    folders = {one for one in folders if one.name != "backward"}  # whose files are read as <backward/binders.h>
    files = {Path(one).resolve() for one in re.findall(r'^# \d+ "(/.*?)"', said.stdout, re.MULTILINE)}
    return {file.stem for file in files if file.parent in folders and file.suffix == ".h"}


@needs_compiler
@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other headers inside")
def test_names_of_headers_are_refused_and_keywords_are_not(drive_solution: ls.Solution, tmp_path: Path) -> None:
    """A file of such a name would be read in their place, with the folder on the include path."""
    own = "assert complex ctype errno fenv float inttypes limits locale math setjmp signal stdarg stdbool stddef stdint"
    standard = [f"{name}.h" for name in f"{own} stdio stdlib string time uchar wchar wctype".split()]
    found = read_from_the_system("cc", [*standard, "tgmath.h", "stdatomic.h", "threads.h"])
    if shutil.which("c++"):
        found |= read_from_the_system("c++", [*standard, "cmath", "string", "vector"])
    found = {name for name in found if re.fullmatch("[a-z][a-z0-9_]*", name)}
    assert {"math", "stddef", "features"} <= found
    for name in found:
        with pytest.raises(ls.InputError, match=f"name: got '{name}', the name of a header of C, want another"):
            ls.export_c(drive_solution, tmp_path / "c", name=name)
    for name in ("int", "register", "class", "maths", "vector"):
        ls.export_c(drive_solution, tmp_path / name, name=name)
        command = ["cc", *WARNINGS, "-I", ".", "-o", "example", "main.c", f"{name}.c", "-lm"]
        subprocess.run(command, cwd=tmp_path / name, check=True)


def test_controllers_that_solve_or_estimate_are_named(
    drive_solution: ls.Solution, differential_drive: ls.Scenario, tmp_path: Path
) -> None:
    problem = differential_drive.problem
    stated = ls.uncertainty_of(differential_drive.plant(), [ls.disturbances.ControlNoise(0.05)])
    plain, law = (
        ls.OffsetFree(problem, drive_solution, stated, tolerate={"m": 0.1, "rad": 0.2}, replan_every=every)
        for every in (None, 1.0)
    )
    given: Any
    for given in (ls.Replanner(problem, drive_solution, every=1.0), law):
        with pytest.raises(ls.InputError, match=f"got .*{type(given).__name__}.*, want a Solution"):
            ls.export_c(given, tmp_path)
    with pytest.raises(ls.InputError, match="policy: got a law with replan_every=1, want one without"):
        ls.export_c(law.policy, tmp_path)
    with pytest.raises(ls.InputError, match="interpolate: got True for an OutputFeedbackPolicy"):
        ls.export_c(plain.policy, tmp_path, interpolate=True)
    rollout = ls.simulate(differential_drive.plant(), drive_solution)
    ls.save(rollout, tmp_path / "rollout.npz")
    assert main(["export", str(tmp_path / "rollout.npz"), "--c", str(tmp_path / "c")]) == 2
