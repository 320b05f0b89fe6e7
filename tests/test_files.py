"""Files: what goes in comes out to the bit, needs only NumPy to read, and a bad one gets one line."""

import dataclasses
import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

import lqrsim as ls
from lqrsim import files


def same(a: object, b: object) -> bool:
    """Equal in every field, arrays to the bit."""
    if dataclasses.is_dataclass(a) and not isinstance(a, type):
        return type(a) is type(b) and all(
            same(getattr(a, field.name), getattr(b, field.name)) for field in dataclasses.fields(a)
        )
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b, equal_nan=True)
    if isinstance(a, tuple):
        return isinstance(b, tuple) and len(a) == len(b) and all(map(same, a, b))
    return a == b or (a != a and b != b)


@pytest.fixture
def saved(tmp_path: Path, drive_solution: ls.Solution) -> Path:
    return ls.save(drive_solution, tmp_path / "solution.npz")


def test_a_solution_survives(saved: Path, drive_solution: ls.Solution) -> None:
    assert same(ls.load_solution(saved), drive_solution)


def test_so_do_the_solutions_of_ilqr_and_failed_ones(tmp_path: Path, differential_drive: ls.Scenario) -> None:
    for max_iterations in (500, 1):
        solution = ls.ilqr(differential_drive.problem, max_iterations=max_iterations)
        assert same(ls.load_solution(ls.save(solution, tmp_path / "it.npz")), solution)


def test_the_same_solution_gives_the_same_bytes(tmp_path: Path, saved: Path, drive_solution: ls.Solution) -> None:
    assert ls.save(drive_solution, tmp_path / "again.npz").read_bytes() == saved.read_bytes()


def test_a_policy_is_read_with_numpy_alone(saved: Path, drive_solution: ls.Solution) -> None:
    """What docs/file_format.md tells people to do elsewhere."""
    with np.load(saved) as archive:
        gain, offset, nominal = (archive[f"policy.{name}"] for name in ("gain", "offset", "nominal"))
        meta = json.loads(str(archive["meta"]))
    assert (meta["format"], meta["version"]) == ("lqrsim solution", 4)
    state, t = drive_solution.trajectory.states[7] + [0.01, 0.02, 2 * np.pi], 7 / 6
    step = min(int(t / meta["dt"] + 1e-9), len(gain) - 1)
    for i in meta["states"]["angles"]:
        state[i] -= 2 * np.pi * np.round((state[i] - nominal[step, i]) / (2 * np.pi))
    control = np.clip(gain[step] @ state + offset[step], meta["controls"]["low"], meta["controls"]["high"])
    np.testing.assert_allclose(control, drive_solution.policy(state, t), rtol=0, atol=1e-12)


def rewrite(path: Path, **changes: object) -> None:
    """Change what a solution file says of itself."""
    with np.load(path) as archive:
        arrays = dict(archive)
    meta = json.loads(str(arrays.pop("meta"))) | {k: v for k, v in changes.items() if not isinstance(v, np.ndarray)}
    arrays |= {key: value for key, value in changes.items() if isinstance(value, np.ndarray)}
    np.savez(path, allow_pickle=False, meta=np.array(json.dumps(meta)), **arrays)


def _save_bare_array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.unlink(), "want a file that exists"),
        (lambda path: path.write_bytes(path.read_bytes()[:-4000]), "which is damaged, want a file that lqrsim wrote"),
        (lambda path: path.write_bytes(b""), "which is damaged"),
        (lambda path: path.write_text("gain: 3"), "which is damaged"),
        (lambda path: np.savez(path, a=np.zeros(3)), "which is damaged"),
        (lambda path: _save_bare_array(path), "which is damaged"),
        (lambda path: path.write_bytes(pickle.dumps({"gain": 1})), "which is damaged"),
        (lambda path: np.savez(path, meta=np.array([{}], dtype=object)), "which is damaged"),
        (lambda path: rewrite(path, version=1), "of version 1, want version 4"),
        (lambda path: rewrite(path, format="lqrsim rollout"), "holds a 'lqrsim rollout', want a 'lqrsim solution'"),
        (lambda path: rewrite(path, status="great"), "which is damaged .*'great' is not a valid Status"),
        (lambda path: rewrite(path, **{"policy.offset": np.zeros((150, 3))}), r"policy.offset: got shape \(150, 3\)"),
        (lambda path: rewrite(path, **{"policy.gain": np.full((150, 2, 3), np.nan)}), "policy.gain: got nan at index"),
        (lambda path: rewrite(path, dt=None), "which is damaged"),
    ],
)
def test_a_spoilt_file_gets_one_line(saved: Path, spoil, message: str) -> None:
    spoil(saved)
    with pytest.raises(ls.InputError, match=message) as caught:
        ls.load_solution(saved)
    assert "\n" not in str(caught.value)


def test_every_flipped_byte_is_harmless(saved: Path, drive_solution: ls.Solution) -> None:
    """The archive's check sums notice, or it did not matter: never another exception, never another policy."""
    original = saved.read_bytes()
    for place in np.random.default_rng(0).integers(len(original), size=60):
        spoilt = bytearray(original)
        spoilt[place] ^= 0x55
        saved.write_bytes(bytes(spoilt))
        try:
            loaded = ls.load_solution(saved)
        except ls.InputError:
            continue
        assert (loaded.policy.gain == drive_solution.policy.gain).all()


def test_loading_never_runs_code(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple:
            return (Path(tmp_path / "sprung").touch, ())

    meta, trap = np.array(json.dumps({})), {"policy.gain": np.array([Trap()], dtype=object)}
    np.savez(tmp_path / "trap.npz", allow_pickle=True, meta=meta, **trap)
    with pytest.raises(ls.InputError, match="which is damaged"):
        ls.load_solution(tmp_path / "trap.npz")
    assert not (tmp_path / "sprung").exists()


def test_a_failed_write_leaves_nothing_and_keeps_the_old_file(tmp_path: Path, drive_solution: ls.Solution) -> None:
    path = tmp_path / "solution.npz"
    path.write_text("old")

    def interrupted() -> None:
        with files.replacing(path) as unfinished:
            unfinished.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ls.InputError, match=r"output: got .*, want a file that can be written"):
        ls.save(drive_solution, tmp_path / "file" / "solution.npz")


def test_files_are_ordinary_zip_archives(saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        assert archive.testzip() is None
        assert all(name.endswith(".npy") for name in archive.namelist())
