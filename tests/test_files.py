"""Files: what goes in comes out to the bit, needs only NumPy to read, and a bad one gets one line."""

import contextlib
import dataclasses
import importlib
import io
import json
import os
import pickle
import socket
import subprocess
import sys
import time
import tracemalloc
import warnings
import zipfile
from collections import Counter
from pathlib import Path
from types import GenericAlias, ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from refusing import error_line
from sampling import examples
from scipy import stats
from spoiling import content_hash, contents, rewrite
from tracking import funnel_by_hand

import lqrsim as ls
from lqrsim.annotations import declared
from lqrsim.cli import main
from lqrsim.results.archive import replacing

fuzzer: ModuleType = importlib.import_module("robustness.files")
same = fuzzer.same


@pytest.fixture
def saved(tmp_path: Path, drive_solution: ls.Solution) -> Path:
    return ls.save(drive_solution, tmp_path / "solution.npz")


def test_a_solution_survives(saved: Path, drive_solution: ls.Solution) -> None:
    assert same(ls.load(saved, ls.Solution), drive_solution)


def test_a_file_says_what_it_holds(saved: Path, drive_solution: ls.Solution, tmp_path: Path) -> None:
    """Without a kind it is whatever it is; with one, another is refused by name."""
    policy = ls.save(drive_solution.policy, tmp_path / "policy.npz")
    assert same(ls.load(saved), drive_solution)
    assert same(ls.load(policy), drive_solution.policy)
    with pytest.raises(ls.InputError, match="holds a 'lqrsim solution', want a 'lqrsim rollout'"):
        ls.load(saved, ls.Rollout)
    with pytest.raises(ls.InputError, match="holds a 'lqrsim policy', want a 'lqrsim output feedback policy'"):
        ls.load(policy, ls.types.OutputFeedbackPolicy)
    with pytest.raises(ls.InputError, match=r"kind: got .*, want one of ls.Solution, ls.Rollout"):
        ls.load(saved, ls.Trajectory)  # pyright: ignore[reportArgumentType, reportCallIssue]
    with pytest.raises(ls.InputError, match="a folder, want a file; the folder of a campaign is opened"):
        ls.load(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_a_link_is_written_through(drive_solution: ls.Solution, tmp_path: Path) -> None:
    """Also one whose target is not there yet, and one that leads to another link."""
    (tmp_path / "elsewhere").mkdir()
    target, link, second = tmp_path / "elsewhere" / "plan.npz", tmp_path / "link.npz", tmp_path / "second.npz"
    link.symlink_to(target)
    second.symlink_to(link)
    for name in (link, second):
        ls.save(drive_solution, name)
        assert name.is_symlink()
        assert same(ls.load(target), drive_solution)
        target.unlink()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no pipes in folders")
def test_only_regular_files_are_written_to(drive_solution: ls.Solution, tmp_path: Path) -> None:
    """A pipe would be replaced by a file, and whoever reads from it would wait for ever; a link to one likewise."""
    pipe, folder, listener = (tmp_path / f"{name}.npz" for name in ("pipe", "folder", "listener"))
    link, loop, ring = (tmp_path / f"{name}.npz" for name in ("link", "loop", "ring"))
    os.mkfifo(pipe)
    folder.mkdir()
    with socket.socket(socket.AF_UNIX) as opened:
        opened.bind(os.path.relpath(listener))  # a path of at most some 100 characters
    for one, to in ((link, pipe), (loop, ring), (ring, loop)):
        one.symlink_to(to)
    odd, itself = "neither a file nor a folder", "a link to itself"
    kinds = ((pipe, odd), (folder, "a folder"), (listener, odd), (link, odd), (loop, itself), (ring, itself))
    before = [path.lstat() for path, _ in kinds]
    for path, what in kinds:
        with pytest.raises(ls.InputError, match=f"output: got .*, which is {what}, want the name of a regular file"):
            ls.save(drive_solution, path)
    after = [path.lstat() for path, _ in kinds]
    assert [(one.st_ino, one.st_mode) for one in after] == [(one.st_ino, one.st_mode) for one in before]
    assert len(list(tmp_path.iterdir())) == len(kinds)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no pipes in folders")
def test_only_regular_files_are_read(tmp_path: Path) -> None:
    """Opening a pipe waits for ever if nobody writes to it; a device may have no end."""
    commands = []
    for name in ("run.npz", "robot.xml", "robot.urdf", "run.mp4"):
        pipe, link = tmp_path / f"pipe_{name}", tmp_path / f"link_{name}"
        os.mkfifo(pipe)
        link.symlink_to("/dev/zero")
        command = "list" if name.startswith("robot") else "verify"
        commands += [[command, str(pipe)], [command, str(link)]]
    code = "import json, sys; from lqrsim.cli import main; print([main(one) for one in json.loads(sys.argv[1])])"
    asked = [sys.executable, "-c", code, json.dumps(commands)]
    done = subprocess.run(asked, capture_output=True, text=True, timeout=300, check=True)
    assert json.loads(done.stdout) == [2] * len(commands)
    lines = done.stderr.splitlines()
    assert len(lines) == len(commands)
    assert all("want a file that exists" in line for line in lines)


def test_so_do_the_solutions_of_ilqr_and_failed_ones(tmp_path: Path, differential_drive: ls.Scenario) -> None:
    for max_iterations in (500, 1):
        solution = ls.ilqr(differential_drive.problem, max_iterations=max_iterations)
        assert same(ls.load(ls.save(solution, tmp_path / "it.npz"), ls.Solution), solution)


def test_the_same_solution_gives_the_same_bytes(tmp_path: Path, saved: Path, drive_solution: ls.Solution) -> None:
    assert ls.save(drive_solution, tmp_path / "again.npz").read_bytes() == saved.read_bytes()


@pytest.mark.parametrize(("angles", "version"), [((), 2), ((3,), 2), ((2,), 3)])
def test_turns_about_an_axis_have_a_version_of_their_own(angles: tuple[int, ...], version: int, tmp_path: Path) -> None:
    """lqrsim 0.2 wraps each angle and then the whole vector, and refuses another version than 2."""
    space = ls.types.Coordinates(names=tuple("abcd"), units=("rad",) * 4, rotation_vectors=(0,), angles=angles)
    controls = ls.types.Coordinates(names=("f",), units=("N",))
    arrays = {"gain": np.ones((1, 1, 4)), "offset": np.zeros((1, 1)), "nominal": np.zeros((1, 4))}
    policy = ls.AffinePolicy(**arrays, dt=0.1, state_coordinates=space, control_coordinates=controls)
    path = ls.save(policy, tmp_path / "policy.npz")
    assert contents(path)[1]["version"] == version
    assert same(ls.load(path), policy)
    rewrite(path, version=5 - version)
    with pytest.raises(ls.InputError, match=rf"of version {5 - version}, want version {version}: write it again"):
        ls.load(path)


def test_a_policy_is_read_with_numpy_alone(saved: Path, drive_solution: ls.Solution) -> None:
    """What docs/file_format.md tells people to do elsewhere."""
    with np.load(saved) as archive:
        gain, offset, nominal = (archive[f"policy.{name}"] for name in ("gain", "offset", "nominal"))
        meta = json.loads(str(archive["meta"]))
    assert (meta["format"], meta["version"]) == ("lqrsim solution", 7)
    state, t = drive_solution.trajectory.states[7] + [0.01, 0.02, 2 * np.pi], 7 / 6
    policy = meta["policy"]
    step = min(int(t / policy["dt"] + 1e-9), len(gain) - 1)
    for i in policy["state_coordinates"]["angles"]:
        state[i] -= 2 * np.pi * np.round((state[i] - nominal[step, i]) / (2 * np.pi))
    limits = policy["control_coordinates"]
    control = np.clip(gain[step] @ state + offset[step], limits["low"], limits["high"])
    np.testing.assert_allclose(control, drive_solution.policy(state, t), rtol=0, atol=1e-12)


def _save_bare_array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.unlink(), "want a file that exists"),
        (lambda path: path.write_bytes(path.read_bytes()[:-4000]), "which is damaged .*want a file that lqrsim wrote"),
        (lambda path: path.write_bytes(b""), "which is damaged"),
        (lambda path: path.write_text("gain: 3"), "which is damaged"),
        (lambda path: np.savez(path, a=np.zeros(3)), "which is damaged"),
        (lambda path: _save_bare_array(path), "which is damaged"),
        (lambda path: path.write_bytes(pickle.dumps({"gain": 1})), "which is damaged"),
        (lambda path: np.savez(path, meta=np.array([{}], dtype=object)), "which is damaged"),
        (lambda path: rewrite(path, version=1), "of version 1, want version 7 or 8"),
        (lambda path: rewrite(path, format="lqrsim rollout"), "holds a 'lqrsim rollout', want a 'lqrsim solution'"),
        (lambda path: rewrite(path, status="great"), r"status: got 'great', want one of: converged"),
        (lambda path: rewrite(path, **{"policy.offset": np.zeros((150, 3))}), r"policy.offset: got shape \(150, 3\)"),
        (
            lambda path: rewrite(path, **{"policy.gain": np.full((150, 2, 3), np.nan)}),
            "policy.gain: got NaN or infinity",
        ),
        (
            lambda path: rewrite(path, **{"policy.dt": None}),
            "policy: AffinePolicy: dt: got None, want",
        ),
    ],
)
def test_a_spoilt_file_gets_one_line(saved: Path, spoil, message: str) -> None:
    spoil(saved)
    with pytest.raises(ls.InputError, match=message):
        ls.load(saved, ls.Solution)


@pytest.fixture(scope="module")
def rollout(differential_drive: ls.Scenario, drive_solution: ls.Solution) -> ls.Rollout:
    plant, disturbances = (
        differential_drive.plant(),
        [ls.disturbances.ControlNoise(0.01), ls.disturbances.ForceNoise(0.1)],
    )
    return ls.simulate(plant, drive_solution, disturbances=disturbances, trials=2, seed=2**40)


@pytest.fixture
def run(tmp_path: Path, rollout: ls.Rollout) -> Path:
    return ls.save(rollout, tmp_path / "rollout.npz")


def test_a_rollout_survives_and_is_saved_again_as_it_was(saved: Path, run: Path, rollout: ls.Rollout) -> None:
    loaded = ls.load(run, ls.Rollout)
    assert same(loaded, rollout)
    for path, one in ((run, loaded), (saved, ls.load(saved, ls.Solution))):
        assert ls.save(one, path.with_name("again.npz")).read_bytes() == path.read_bytes()


@pytest.fixture
def predicted(rollout: ls.Rollout) -> ls.Rollout:
    """With a tube, as `Tube.added_to` makes it."""
    factors = np.random.default_rng(5).normal(size=(151, 2, 2))
    return dataclasses.replace(
        rollout, tube=factors @ factors.transpose(0, 2, 1), collision_chance=np.linspace(0.0, 1.0, 151)
    )


def test_a_predicted_tube_survives_and_files_without_it_have_none(
    tmp_path: Path, run: Path, predicted: ls.Rollout
) -> None:
    path = ls.save(predicted, tmp_path / "tube.npz")
    loaded = ls.load(path, ls.Rollout)
    assert same(loaded, predicted)
    assert ls.save(loaded, tmp_path / "again.npz").read_bytes() == path.read_bytes()
    arrays, meta = contents(path)
    assert (arrays["tube"].shape, arrays["collision_chance"].shape) == ((151, 2, 2), (151,))
    without, of_old = contents(run)
    assert arrays.keys() - without.keys() == {"tube", "collision_chance"}
    assert meta["version"] == of_old["version"] == 5
    assert (ls.load(run, ls.Rollout).tube, ls.load(run, ls.Rollout).collision_chance) == (None, None)


def skewed(tube: np.ndarray) -> np.ndarray:
    """One entry changed, and not the one across."""
    tube = tube.copy()
    tube[7, 0, 1] += 1e-3
    return tube


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tube": lambda a: a[:-1]}, r"tube: got shape \(150, 2, 2\), want \(T\+1, p, p\)"),
        ({"tube": lambda a: a[:, :1, :1].copy()}, r"tube: got shape \(151, 1, 1\), want 2 by 2 matrices"),
        ({"tube": lambda a: a.astype(np.int64)}, "tube: got numbers of type <i8, want <f8"),
        ({"tube": lambda a: a * np.nan}, r"tube\[0, 0, 0\]: got nan, want a finite number"),
        ({"tube": lambda a: a + np.inf}, r"tube\[0, 0, 0\]: got inf"),
        ({"tube": skewed}, r"tube: got .* at \[7, 0, 1\] and .* at \[7, 1, 0\], want a symmetric matrix"),
        ({"tube": lambda a: -a}, "tube: got .* at knot 0, want no negative variance"),
        (
            {"collision_chance": lambda a: a + 0.5},
            r"collision_chance\[76\]: got .*, want a finite number >= 0 and <= 1",
        ),
        ({"collision_chance": lambda a: a[1:]}, r"collision_chance: got shape \(150,\), want \(T\+1\)"),
        ({"collision_chance": lambda a: a * np.nan}, r"collision_chance\[0\]: got nan"),
    ],
)
def test_a_damaged_tube_gets_one_line(
    tmp_path: Path, predicted: ls.Rollout, changes: dict[str, Any], message: str
) -> None:
    path = ls.save(predicted, tmp_path / "tube.npz")
    rewrite(path, **changes)
    with pytest.raises(ls.InputError, match=message):
        ls.load(path, ls.Rollout)
    rewrite(ls.save(predicted, path), sealed=False, **changes)  # as damage is
    with pytest.raises(ls.InputError, match=r"tube\.npz"):
        ls.load(path, ls.Rollout)


@pytest.mark.parametrize(("number", "dtype"), [(np.floating, np.float64), (np.int64, np.int64)])
def test_annotations_of_arrays_are_understood_as_each_numpy_has_them(number: Any, dtype: type) -> None:
    """Up to NumPy 2.4 and Python 3.11 an alias of np.ndarray, from 2.5 and 3.12 on a type alias of its own."""
    forms = (npt.NDArray[number], np.ndarray[Any, np.dtype[number]], GenericAlias(npt.NDArray, (number,)))
    assert [declared(form).dtype for form in forms] == [dtype] * 3


def test_the_hash_is_of_the_content(saved: Path, run: Path) -> None:
    for path in (saved, run):
        arrays, meta = contents(path)
        assert meta["sha256"] == content_hash(arrays, meta)


def test_every_flipped_bit_is_harmless(saved: Path, drive_solution: ls.Solution) -> None:
    """It is noticed, or it did not matter: never another exception, and never another solution."""
    packed = saved.read_bytes()
    arrays, meta = contents(saved)
    with saved.open("wb") as file:
        np.savez(file, allow_pickle=False, meta=np.array(json.dumps(meta)), **arrays)
    rng = np.random.default_rng(0)
    for original in (packed, saved.read_bytes()):
        assert same(ls.load(saved, ls.Solution), drive_solution)
        # Half of them near the names and sizes at the end, where a bit makes a parser say most.
        for place in [
            *rng.integers(len(original), size=60),
            *rng.integers(len(original) - 1500, len(original), size=60),
        ]:
            spoilt = bytearray(original)
            spoilt[place] ^= 1 << int(rng.integers(8))
            saved.write_bytes(bytes(spoilt))
            with contextlib.suppress(ls.InputError):
                assert same(ls.load(saved, ls.Solution), drive_solution)
        saved.write_bytes(packed)


def test_a_sample_of_what_a_fuzzer_makes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some of what `tests/tools/benchmark_robustness.py` tries by the ten thousand; half have a hash that fits."""
    monkeypatch.setattr(fuzzer, "PATIENCE", 300.0)  # what hangs is found, and what a slow machine takes is no fault
    found = list(fuzzer.verdicts(examples(120), seed=3))
    assert [verdict for verdict in found if verdict.kind in fuzzer.FAILURES] == []
    kinds = Counter(verdict.kind for verdict in found)
    assert min(kinds[kind] for kind in ("refused", "identical", "accepted")) > 0, kinds


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        # Arrays that have the hash that belongs to them.
        ({"states": lambda a: a.astype(np.float32)}, "'states': got an array in another format"),
        ({"frames": lambda a: a.astype(np.float16)}, "which is damaged"),
        ({"clearance": lambda a: a.astype(int)}, "clearance: got numbers of type <i8, want <f8"),
        ({"clearance": lambda a: a > 0}, r"clearance: got numbers of type \|b1, want <f8"),
        ({"frame_times": lambda a: a.astype("M8[s]")}, "which is damaged"),
        ({"states": lambda a: a.astype(">f8")}, "which is damaged"),
        ({"states": np.asfortranarray}, "which is damaged"),
        ({"contacts": lambda a: a.astype(float)}, "contacts: got numbers of type <f8, want <i8"),
        ({"contacts": lambda a: a.astype(np.uint8)}, "which is damaged"),
        ({"diverged_at": lambda a: np.isfinite(a)}, r"diverged_at: got numbers of type \|b1, want <f8"),
        ({"goal": lambda a: a[:2]}, r"goal: got shape \(2,\), want \(n\) = \(3\)"),
        ({"goal": lambda a: a + np.inf}, "goal: got .* want finite numbers"),
        ({"goal": lambda a: a * np.nan}, "goal: got NaN for every state"),
        ({"obstacles": ["", "", ""]}, "obstacles: got 3 entries, want 2"),
        ({"reasons": ["", "\x1b[2J"]}, r"reasons\[1\]: got .*, want one printable line"),
        ({"plan.states": lambda a: a * np.nan}, "plan: got NaN or infinity, want finite states and controls"),
        ({"reasons": ["", 1]}, r"reasons\[1\]: got 1, want text"),
        ({"forces": lambda a: a.transpose(0, 2, 1).copy()}, r"forces: got shape \(2, 3, 150\), want \(K, T, 3\)"),
        ({"frames": lambda a: a[..., :0]}, None),
        ({"frames": lambda a: a[:, :0], "frame_times": lambda a: a[:0]}, None),
        ({"frame_times": lambda a: a[::-1].copy()}, "frame_times: got times that are not in order"),
        ({"contacts": lambda a: a - 10**6}, r"contacts: got .*, want whole numbers >= 0"),
        ({"states": lambda a: np.array(1.0)}, "states: got shape"),
        ({"torques": None}, "torques: got nothing, want this field"),
        ({"bomb": np.zeros(3)}, "'bomb': got an unknown array, want only arrays of this format"),
        # Text of another type or range.
        *(({name: 7}, f"{name}: got 7, want text") for name in ("robot", "scene", "model", "policy_digest")),
        *(({name: "7"}, f"{name}: got '7', want a finite number") for name in ("radius", "goal_radius")),
        *(({name: -1}, f"{name}: got -1, want") for name in ("radius", "goal_radius", "seed", "first_trial")),
        *(({name: True}, f"{name}: got True, want") for name in ("radius", "goal_radius", "seed", "first_trial")),
        *(({name: np.nan}, f"{name}: got nan, want") for name in ("radius", "goal_radius", "seed")),
        ({"plan.dt": -1}, "plan: Trajectory: dt: got -1, want a finite number > 0"),
        ({"seed": 1.5}, "seed: got 1.5, want a whole number"),
        ({"radius": 10**400}, "radius: got"),
        ({"robot": "a\nb"}, "robot: got 'a.nb', want one printable line"),
        ({"robot": "x" * 5000}, "robot: got 'xxx.*want one printable line of at most 1000 characters"),
        ({"robot": "\ud800"}, "robot: got .*, want"),
        ({"disturbances": "wind"}, "disturbances: got 'wind', want a list"),
        ({"disturbances": [1]}, r"disturbances\[0\]: got 1, want text"),
        ({"versions": ["1"]}, "versions: got .*, want a dictionary by name"),
        ({"versions": {"numpy": 2}}, "versions.numpy: got 2, want text"),
        ({"states": None, "control_coordinates": 3}, "which is damaged"),
        ({"more": 1}, "meta: got 'more', want only"),
    ],
)
def test_what_is_in_a_rollout_is_what_it_must_be(run: Path, changes: dict[str, Any], message: str | None) -> None:
    """Files that are whole, and have the hash that belongs to what is in them: an older or another program's."""
    rewrite(run, **changes)
    if message is None:  # without pictures, and so not to be drawn
        with pytest.raises(ls.InputError, match=r"frames|without a finite state"):
            ls.render(ls.load(run, ls.Rollout), run.with_suffix(".mp4"))
        return
    with pytest.raises(ls.InputError, match=message):
        ls.load(run, ls.Rollout)


STATES = "policy.state_coordinates"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({STATES: {"names": [1, 2, 3]}}, f"{STATES}.units: got nothing, want this field"),
        (
            {STATES: lambda one: one | {"names": [1, 2, 3]}},
            r"state_coordinates: names\[0\]: got 1, want a name",
        ),
        ({STATES: lambda one: one | {"names": ["x", "x", "y"]}}, "a name twice"),
        ({STATES: lambda one: one | {"position": [0, 7]}}, "position: got"),
        ({STATES: lambda one: one | {"low": [np.nan] * 3}}, "low: got nan"),
        ({STATES: lambda one: one | {"plane": "xz"}}, "plane: got 'xz' for the position"),
        ({STATES: lambda one: one | {"offset": np.inf}}, "state_coordinates: offset: got inf, want a finite number"),
        ({"goal_radius": -1.0}, "goal_radius: got -1.0, want a finite number > 0"),
        ({"goal": lambda a: a[:2]}, r"goal: got shape \(2,\), want \(n\) = \(3\)"),
        ({"policy.control_coordinates": "none"}, "control_coordinates: got 'none', want an object"),
        ({"candidates.0.iterations": np.inf}, r"candidates.0: Candidate: iterations: got inf"),
        ({"candidates.0.cost": np.nan}, r"candidates.0: Candidate: cost: got nan"),
        ({"candidates": lambda one: [row | {"status": None} for row in one]}, "candidates: got none that ended"),
        (
            {"candidates": lambda one: one[:-1]},
            r"candidates.\d+.trajectory.controls: got an array",
        ),
        ({"candidates": []}, "candidates.0.trajectory.controls: got an array that meta does not mention"),
        ({"iterations": lambda one: [row | {"method": 3} for row in one]}, "iterations.0: Iteration: method: got 3"),
        ({"multipliers": [{"penalty": 1.0}]}, "multipliers.0.values: got nothing, want this field"),
        *(
            ({name: spoil}, rf"{name.split('.')[0]}.*: got NaN or infinity in")
            for name in (
                "trajectory.states",
                "trajectory.controls",
                "policy.gain",
                "policy.nominal",
                "inverse_policy.nominal",
                "clearance",
                *(f"cost_to_go.{part}" for part in ("hessian", "gradient", "constant")),
                *(f"cost_to_come.{part}" for part in ("covariance", "mean", "constant")),
            )
            for spoil in (lambda a: a * np.nan, lambda a: np.where(a == a.flat[-1], np.inf, a))
        ),
        ({"detail": "\x1b[31mred"}, "detail: got .*, want one printable line"),
        ({"status": None}, "status: got None, want one of: converged"),
        ({"options": {"a": [[[[[[[[1]]]]]]]]}}, "options.*got more nested lists or objects, want at most 6"),
        ({"scenario": ["quadrotor"]}, "scenario: got .*, want text"),
        ({"version": 4.5}, "of version 4.5, want version 7 or 8"),
        ({"cost_to_go.gradient": None}, "cost_to_go.gradient: got nothing, want this field"),
        (
            {
                name: lambda a: a[:0]
                for name in ("policy.gain", "policy.offset", "policy.nominal", "trajectory.controls")
            },
            r"policy.gain: got shape \(0, 2, 3\), want",
        ),
    ],
)
def test_what_is_in_a_solution_is_what_it_must_be(saved: Path, changes: dict[str, Any], message: str) -> None:
    rewrite(saved, **changes)
    with pytest.raises(ls.InputError, match=message):
        ls.load(saved, ls.Solution)


def test_another_number_is_not_taken_for_what_was_saved(saved: Path) -> None:
    """An array that is dropped, or changed in its last bit, and the hash as it was."""
    _, meta = contents(saved)
    changes: list[dict[str, Any]] = [
        {"clearance": None},
        {"policy.offset": lambda a: np.nextafter(a, np.inf)},
        {"trajectory.states": lambda a: np.where(a == a[0, 1], -0.0, a)},
        {"detail": "it was fine"},
        {"policy.dt": np.nextafter(meta["policy"]["dt"], 1.0)},
    ]
    original = saved.read_bytes()
    for change in changes:
        saved.write_bytes(original)
        rewrite(saved, sealed=False, **change)
        with pytest.raises(ls.InputError, match="sha256: got another hash than that of the content"):
            ls.load(saved, ls.Solution)


def add_member(path: Path, name: str, data: bytes) -> None:
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")  # of a name that is there already
        archive.writestr(name, data)


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("policy.gain.npy", npy(np.zeros((150, 2, 3))), "'policy.gain': got two parts of this name, want one"),
        ("meta.npy", npy(np.array("{}")), "'meta': got two parts of this name"),
        ("readme.txt", b"hello", "'readme.txt': got a part that is no array, want arrays only"),
        ("multipliers.0.values.npy", b"hello", "'multipliers.0.values': got an array in another format"),
        (
            "multipliers.0.values.npy",
            b"\x93NUMPY\x01\x00\x10\x00" + b"(" * 16,
            "'multipliers.0.values': got an array in another format",
        ),
        ("multipliers.0.values.npy", npy(np.zeros((151, 1))), "sha256: got another hash than that of the content"),
        ("clearance ", b"", "got a part that is no array"),
    ],
)
def test_other_members_are_refused(saved: Path, name: str, data: bytes, message: str) -> None:
    add_member(saved, name, data)
    with pytest.raises(ls.InputError, match=message):
        ls.load(saved, ls.Solution)


def test_nothing_is_unpacked_before_it_is_known_to_belong(saved: Path, drive_solution: ls.Solution) -> None:
    """Members of a quarter of a gigabyte, a thousandth of it in the file; and one that says it has three."""
    zeros = npy(np.zeros(1 << 25))
    lie = npy(np.zeros(8)).replace(b"(8,), }" + b" " * 9, b"(400000000,), }" + b" ")
    original = saved.read_bytes()
    for name, data in (("bomb.npy", zeros), ("clearance.npy", zeros), ("multipliers.0.values.npy", lie)):
        saved.write_bytes(original)
        if name == "clearance.npy":
            with (
                zipfile.ZipFile(saved, "w", zipfile.ZIP_DEFLATED) as archive,
                zipfile.ZipFile(io.BytesIO(original)) as old,
            ):
                for member in old.namelist():
                    archive.writestr(member, data if member == name else old.read(member))
        else:
            add_member(saved, name, data)
        tracemalloc.start()
        try:
            with pytest.raises(ls.InputError, match="which is damaged"):
                ls.load(saved, ls.Solution)
            assert tracemalloc.get_traced_memory()[1] < 20e6  # bytes
        finally:
            tracemalloc.stop()


@pytest.mark.parametrize("text", ["[" * 1000 + "]" * 1000, '{"a":' * 5000, "9" * 5000, "[]", "NaN", "", '{"format"'])
def test_any_text_is_one_line(saved: Path, text: str) -> None:
    arrays, _ = contents(saved)
    with saved.open("wb") as file:
        np.savez(file, allow_pickle=False, meta=np.array(text), **arrays)
    with pytest.raises(ls.InputError, match="which is damaged"):
        ls.load(saved, ls.Solution)


def test_a_name_twice_in_the_text_is_refused(saved: Path) -> None:
    arrays, meta = contents(saved)
    with saved.open("wb") as file:
        text = json.dumps(meta)[:-1] + f', "gap": {meta["gap"]}}}'
        np.savez(file, allow_pickle=False, meta=np.array(text), **arrays)
    with pytest.raises(ls.InputError, match="a name twice in one object"):
        ls.load(saved, ls.Solution)


def test_what_could_not_be_read_again_is_not_written(tmp_path: Path, drive_solution: ls.Solution) -> None:
    path = tmp_path / "solution.npz"
    for change in (
        {"options": {"a": {1, 2}}},
        {"options": {"a": "\ud800"}},
        {"options": {"a": [[[[[[[1]]]]]]]}},
    ):
        changed = dataclasses.replace(drive_solution, **change)
        with pytest.raises(ls.InputError, match="result: got a solution, which cannot be written"):
            ls.save(changed, path)
    with pytest.raises(ls.InputError, match="result: got 'it', want one of: a Solution, a Rollout, an Aff"):
        ls.save("it", path)  # pyright: ignore[reportArgumentType]
    assert not path.exists()


def test_what_compresses_too_well_can_be_read_again(
    tmp_path: Path, rollout: ls.Rollout, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many trials that are all alike look like a bomb; they are written as they are, then."""
    monkeypatch.setattr("lqrsim.results.archive._LARGE", 1 << 20)
    calm = {name: np.zeros((400, *getattr(rollout, name).shape[1:])) for name in ("states", "measured", "commanded")}
    calm |= {name: np.zeros((400, *getattr(rollout, name).shape[1:])) for name in ("applied", "forces", "torques")}
    calm |= {name: np.zeros((400, *getattr(rollout, name).shape[1:])) for name in ("displaced", "clearance", "frames")}
    ends: dict[str, Any] = {name: np.full(400, np.inf) for name in ("collided_at", "diverged_at", "failed_at")}
    ends |= {"obstacles": ("",) * 400, "reasons": ("",) * 400}
    whole = dataclasses.replace(rollout, **calm, contacts=np.zeros(400, np.int64), warnings=None, **ends)
    path = ls.save(whole, tmp_path / "calm.npz")
    assert path.stat().st_size > 1 << 22
    assert same(ls.load(path, ls.Rollout), whole)


LONG = "x" * 300


@pytest.mark.parametrize(
    "command",
    [
        "render {bad}", "render {good} --overlays cost_tube --solution {bad} --out {out}.mp4",
        "verify {bad}", "verify {good} --solution {bad}", "simulate {bad}",
        "view {bad}", "report {bad}", "replay {bad} --cell 0 --trial 0",
        "stress differential_drive --resume --out {bad}",
    ],
)  # fmt: skip
@pytest.mark.parametrize("kind", ["damaged", "long", "missing", "folder"])
def test_commands_give_one_line(
    command: str, kind: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / {"long": f"{LONG}.npz"}.get(kind, f"{kind}.npz")
    if kind == "damaged":
        spoilt = bytearray(run.read_bytes())
        spoilt[len(spoilt) // 2] ^= 1
        bad.write_bytes(bytes(spoilt))
    elif kind == "folder":
        bad.mkdir()
        (bad / "manifest.json").write_text("[" * 9999)
    assert main([word.format(bad=bad, good=run, out=tmp_path / "out") for word in command.split()]) == 2
    error_line(capsys)


@pytest.mark.parametrize(
    "command",
    [
        "simulate {solution} --scenario differential_drive --out {long}", "render {run} --out {long}.mp4",
        "stress differential_drive --trials 1 --out {long}", "solve differential_drive --out {long}",
        "report {run} --out {long}.html",
    ],
)  # fmt: skip
def test_outputs_with_names_that_are_too_long_give_one_line(
    command: str, run: Path, saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    long = tmp_path / LONG
    assert main([word.format(solution=saved, run=run, long=long) for word in command.split()]) == 2
    error_line(capsys)


@pytest.mark.parametrize("name", [LONG, f"{LONG}/solution.npz", "a\0b.npz", f"x.{LONG}"])
def test_names_that_no_file_can_have(name: str, tmp_path: Path, drive_solution: ls.Solution) -> None:
    with pytest.raises(ls.InputError, match=r"output: got .*want the path of a file, of names in UTF-8 of at most 255"):
        ls.save(drive_solution, tmp_path / name)
    for load in (ls.load, ls.load):
        with pytest.raises(ls.InputError, match="want the path of a file, of names in UTF-8 of at most 255 bytes"):
            load(tmp_path / name)


def test_loading_never_runs_code(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple:
            return (Path(tmp_path / "sprung").touch, ())

    meta, trap = np.array(json.dumps({})), {"policy.gain": np.array([Trap()], dtype=object)}
    np.savez(tmp_path / "trap.npz", allow_pickle=True, meta=meta, **trap)
    with pytest.raises(ls.InputError, match="which is damaged"):
        ls.load(tmp_path / "trap.npz", ls.Solution)
    assert not (tmp_path / "sprung").exists()


def test_a_failed_write_leaves_nothing_and_keeps_the_old_file(tmp_path: Path, drive_solution: ls.Solution) -> None:
    path = tmp_path / "solution.npz"
    path.write_text("old")

    def interrupted() -> None:
        with replacing(path) as unfinished:
            unfinished.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ls.InputError, match=r"output: got .*, want a file that can be written"):
        ls.save(drive_solution, tmp_path / "file" / "solution.npz")


def test_what_a_killed_process_left_is_removed_after_a_day(tmp_path: Path, drive_solution: ls.Solution) -> None:
    """By the next that writes into the folder; files of others, and what may still be written to, stay."""
    names = [f".unfinished-{i:016x}.npz" for i in range(3)] + [".unfinished-mine.npz", "plan.npz"]
    for age, name in zip((90_000, 80_000, 0, 90_000, 90_000), names, strict=True):
        (tmp_path / name).write_text("half")
        now = time.time()
        os.utime(tmp_path / name, (now - age, now - age))
    ls.save(drive_solution, tmp_path / "solution.npz")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*names[1:], "solution.npz"])


def test_a_funnel_that_its_trials_do_not_show_is_refused(tmp_path: Path, drive_solution: ls.Solution) -> None:
    """The least that certifies a rate, by SciPy's Clopper-Pearson bound; one success less does not."""
    funnel = funnel_by_hand(drive_solution, np.eye(2), knots=(0, 50), levels=(1.0, 2.0))
    least = next(k for k in range(1001) if stats.beta.ppf(0.05 / 2, k, 1001 - k) >= funnel.rate)
    assert least > 900
    path = ls.save(dataclasses.replace(funnel, successes=np.array([least, 1000])), tmp_path / "funnel.npz")
    assert ls.load(path, ls.types.Funnel).successes[0] == least
    for successes in (least - 1, 0):
        rewrite(path, successes=np.array([successes, 1000]))
        with pytest.raises(ls.InputError, match=rf"successes: got {successes} of 1000 trials, which do not show"):
            ls.load(path)


@pytest.mark.parametrize("text", ["\x1b[2J", "\x9b31m", "\a", "fell\nover", "\u202eover", "\u2028"])
def test_a_funnel_with_text_that_acts_on_a_terminal_is_refused(
    tmp_path: Path, drive_solution: ls.Solution, text: str
) -> None:
    """Its summary prints the reasons and the disturbances."""
    funnel = funnel_by_hand(drive_solution, np.eye(2), knots=(0, 50), levels=(1.0, 2.0))
    for name, changed in (("reasons", ["", text]), ("disturbances", ["wind", text])):
        path = ls.save(dataclasses.replace(funnel, disturbances=("wind", "gusts")), tmp_path / "funnel.npz")
        rewrite(path, **{name: changed})
        with pytest.raises(ls.InputError, match=rf"{name}\[1\]: got .*, want one printable line") as refused:
            ls.load(path)
        assert str(refused.value).isprintable()


@pytest.mark.parametrize("status", ls.Status)
def test_a_solution_prints_as_a_summary_of_fifteen_lines_at_most(
    drive_solution: ls.Solution, status: ls.Status
) -> None:
    """Solutions of every status, with all that a solve may leave: starts, limits, clearance, goal, noise, NaN."""
    rng: Any = np.random.default_rng(36)
    plan, one = drive_solution.trajectory, drive_solution.candidates[0]
    for _ in range(12):
        ends = [status, *rng.choice([None, *ls.Status], size=rng.integers(0, 40))]
        starts = tuple(dataclasses.replace(one, start=f"start {i}", status=end) for i, end in enumerate(ends))
        controls = plan.controls * rng.choice([1.0, 1e3])
        states = plan.states + (np.nan if not status.success and rng.random() < 0.2 else 0.0)
        certificate = dataclasses.replace(drive_solution.certificate, violation=rng.choice([0.0, 0.3]))
        assert drive_solution.clearance is not None
        drawn = dataclasses.replace(
            drive_solution,
            status=status,
            detail="" if status.success else "why",
            remedy=status.remedy if rng.random() < 0.5 else "",
            candidates=starts,
            trajectory=dataclasses.replace(plan, states=states, controls=controls),
            certificate=certificate,
            clearance=drive_solution.clearance - rng.choice([0.0, 1.0]) if rng.random() < 0.7 else None,
            options=drive_solution.options
            | rng.choice([{}, {"noise": "of the wheels"}, {"noise": "a", "risk": 0.1}])
            | rng.choice([{}, {"duration": "1 to 3 s"}]),
            goal=rng.choice([0.0, 1.0]) * np.ones(3) if rng.random() < 0.7 else None,
        )
        lines = str(drawn).splitlines()
        assert 2 <= len(lines) <= 15, str(drawn)
        assert lines[0] == f"{status.name} after 6 iterations of smooth: {status.meaning}"
        assert [line for line in lines if line.startswith("  remedy:")] == [f"  remedy:    {drawn.remedy}"][
            : bool(drawn.remedy)
        ]
        assert sum("  cost: " in line for line in lines) == 1
        assert ("violation: 3.0e-01" in str(drawn)) == (certificate.violation > 0)
        assert len(drawn.log.splitlines()) == 1 + len(drawn.iterations)


def test_files_are_ordinary_zip_archives(saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        assert archive.testzip() is None
        assert all(name.endswith(".npy") for name in archive.namelist())


def test_pickles_of_problems_are_of_one_version(
    differential_drive: ls.Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of lqrsim 0.2 begin with the class alone; those of now, with the version."""
    problem = differential_drive.problem
    for made in (problem, differential_drive, differential_drive.plant(), ls.prepare(problem)):
        kind, written = type(made), pickle.dumps(made)
        assert isinstance(pickle.loads(written), kind)
        of_old = f"\x80\x02c{kind.__module__}\n{kind.__name__}\n)\x81.".encode("latin1")  # as of any plain class
        with pytest.raises(ls.InputError, match=f"^{kind.__name__}: got no arguments, as from a pickle of another"):
            pickle.loads(of_old)
        with monkeypatch.context() as patch:
            patch.setattr("lqrsim.results.pickles.versions", lambda: {"lqrsim": "9.0"})
            with pytest.raises(ls.InputError, match=f"^{kind.__name__}: got a pickle of lqrsim .*, want it made anew"):
                pickle.loads(written)
    assert pickle.loads(pickle.dumps(problem)).digest == problem.digest
