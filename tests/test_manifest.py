"""What a campaign's folder says of itself: it is what was written, or it is refused in one line."""

import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from llvmlite.binding import FeatureMap
from refusing import error_line

import lqrsim as ls
from lqrsim import machine
from lqrsim.cli import main
from lqrsim.stress.campaign import run_campaign
from lqrsim.stress.results import Results
from lqrsim.stress.study import Campaign

CAMPAIGN = Campaign(
    scenario="differential_drive",
    sweeps={"gusts": (ls.disturbances.ForceNoise(0.2),), "slips": (ls.disturbances.ControlNoise(0.02),)},
    strengths=(0.0, 1.0),
    policies=("smooth", "open_loop"),
    trials=4,
    shard=2,
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_campaign(CAMPAIGN, tmp_path_factory.mktemp("campaign") / "finished", workers=0).folder


@pytest.fixture
def folder(finished: Path, tmp_path: Path) -> Path:
    """A copy that may be spoilt, and that is not finished."""
    copy = Path(shutil.copytree(finished, tmp_path / "folder"))
    (copy / "shards" / "0000-000000002.parquet").unlink()
    return copy


def canonical(value: object) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


def edit(folder: Path, change: Callable[[dict[str, Any]], object], *, seals: tuple[str, ...] = ()) -> None:
    """Change what a manifest says; and make its hashes anew as someone would who knows how they are made."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8"))
    change(manifest)
    if "digest" in seals:
        names = ("cells", "deterministic", "model", "problem", "start", "solution", "code", "versions")
        lasting = {name: manifest[name] for name in names}
        lasting["campaign"] = {name: one for name, one in manifest["campaign"].items() if name != "time_limit"}
        lasting["policies"] = {name: hashes["digest"] for name, hashes in manifest["policies"].items()}
        manifest["digest"] = hashlib.sha256(canonical(lasting)).hexdigest()
    if "sha256" in seals:
        rest = {name: one for name, one in manifest.items() if name != "sha256"}
        manifest["sha256"] = hashlib.sha256(canonical(rest)).hexdigest()
    path.write_text(json.dumps(manifest, indent=1), encoding="utf-8")


def test_the_hashes_are_those_that_this_file_makes(folder: Path) -> None:
    before = (folder / "manifest.json").read_bytes()
    edit(folder, lambda manifest: None, seals=("digest", "sha256"))
    assert (folder / "manifest.json").read_bytes() == before


def test_no_flipped_bit_is_missed(folder: Path) -> None:
    path = folder / "manifest.json"
    original, draws, refused = path.read_bytes(), random.Random(0), 0
    manifest = Results(folder).manifest
    for _ in range(400):
        flipped = bytearray(original)
        flipped[draws.randrange(len(flipped))] ^= 1 << draws.randrange(8)
        path.write_bytes(bytes(flipped))
        try:
            read = Results(folder).manifest
        except ls.InputError:
            refused += 1
        else:
            assert read == manifest  # a space became another one
    assert refused > 300


EDITS: dict[str, Callable[[dict[str, Any]], object]] = {
    "another std": lambda m: m["campaign"]["sweeps"]["gusts"][0]["settings"].update(std=0.4),
    "another seed": lambda m: m["campaign"].update(seed=1),
    "more trials": lambda m: m["campaign"].update(trials=40),
    "a cell relabelled": lambda m: m["cells"][3].__setitem__(2, 9.0),
    "cells in another order": lambda m: m["cells"].reverse(),
    "another strength": lambda m: (
        m["campaign"].update(strengths=[0.0, 9.0]),
        [cell.__setitem__(2, 9.0) for cell in m["cells"] if cell[2]],
    ),
    "sweeps exchanged": lambda m: (
        m["campaign"].update(sweeps=dict(reversed(m["campaign"]["sweeps"].items()))),
        m.update(cells=m["cells"][4:] + m["cells"][:4]),
    ),
    "trials that draw nothing": lambda m: m["deterministic"].append(["gusts", 1.0]),
    "another model": lambda m: m.update(model="0" * 64),
    "another policy": lambda m: m["policies"]["smooth"].update(digest="0" * 64),
    "other versions": lambda m: m["versions"].update(numpy="1.0"),
}


@pytest.mark.parametrize("name", EDITS)
@pytest.mark.parametrize("seals", [(), ("sha256",), ("digest",)])
def test_what_was_edited_is_refused(
    folder: Path, name: str, seals: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    edit(folder, EDITS[name], seals=seals)
    with pytest.raises(ls.InputError, match=r"manifest.json, which is damaged \((sha256|digest|cells): got"):
        Results(folder)
    shards = sorted((folder / "shards").iterdir())
    commands: list[list[str]] = [
        ["stress", "differential_drive", "--resume", "--workers", "0", "--out", str(folder)],
        ["report", str(folder)],
        ["replay", str(folder), "--cell", "0", "--trial", "0"],
    ]
    for command in commands:
        assert main(command) == 2
        assert error_line(capsys).startswith("lqrsim: error: folder: got ")
    assert sorted((folder / "shards").iterdir()) == shards


@pytest.mark.parametrize("name", [name for name in EDITS if name != "cells in another order"])
def test_what_was_edited_with_all_its_hashes_has_no_shards(folder: Path, name: str) -> None:
    """Nobody can be kept from beginning another campaign, but its numbers are not those of the shards."""
    if name == "a cell relabelled":  # which no campaign has
        edit(folder, EDITS[name], seals=("digest", "sha256"))
        with pytest.raises(ls.InputError, match="cells: got cells of another campaign"):
            Results(folder)
        return
    edit(folder, EDITS[name], seals=("digest", "sha256"))
    results = Results(folder)
    for cell in results.cells:
        with pytest.raises(ls.InputError, match=r"shard: got .* which is damaged|without trials"):
            results.outcomes(cell)
    with pytest.raises(ls.InputError, match=r"shard: got .* which is damaged"):
        results.summary()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m["campaign"].update(strengths=[True]), r"strengths\[0\]: got True, want a finite number"),
        (lambda m: m["campaign"].update(trials=10**9), "trials: got 1000000000 in shards of 2"),
        (lambda m: m["campaign"].update(trials="4"), "trials: got '4', want a whole number"),
        (lambda m: m["campaign"].update(scenario=None), "scenario: got None, want a reference"),
        (lambda m: m["campaign"].update(policies=["best"]), r"policies\[0\]: got 'best', want one of: smooth"),
        (lambda m: m["campaign"].update(sweeps=[]), "sweeps: got none, want at least one"),
        (lambda m: m["campaign"]["sweeps"].update(gusts=[1]), "digest: got a hash that does not fit"),
        (lambda m: m["campaign"].update(time_limit=float("nan")), "time_limit: got nan, want a finite"),
        (lambda m: m.update(campaign=None), "campaign: got None, want a dictionary by name"),
        (lambda m: m.update(cells={}), "cells: got cells of another campaign"),
        (lambda m: m.update(policies={"smooth": 1}), "policies.smooth: got 1, want a dictionary by name"),
        (lambda m: m["policies"].pop("smooth"), "policies: got open_loop, want smooth, open_loop"),
        (lambda m: m.update(versions={"numpy": None}), "versions.numpy: got None, want text"),
        (lambda m: m.update(machine=["a"]), "machine: got .*, want text"),
        (lambda m: m.update(more=1), "got 'more', want exactly format"),
        (lambda m: m["campaign"].pop("shard"), "campaign: got none of 'shard', want exactly scenario"),
        (lambda m: m.pop("model"), "got none of 'model', want exactly format"),
    ],
)
def test_what_is_in_it_is_what_it_must_be(
    folder: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    edit(folder, change, seals=("sha256",))
    with pytest.raises(ls.InputError, match=message):
        Results(folder)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "null",
        "{",
        "[" * 9999,
        "9" * 5000,
        '{"a": 1, "a": 1}',
        "\ufeff{}",
        "NaN",
        '{"format": {}, "version": []}',
    ],
)
def test_any_text_is_one_line(folder: Path, text: str) -> None:
    (folder / "manifest.json").write_text(text, encoding="utf-8")
    with pytest.raises(ls.InputError, match=r"which is damaged|want a 'lqrsim campaign'"):
        Results(folder)


def test_bytes_that_are_no_text_are_one_line(folder: Path) -> None:
    (folder / "manifest.json").write_bytes(b"\xff\xfe{}")
    with pytest.raises(ls.InputError, match="which is damaged"):
        Results(folder)


def test_a_policy_of_another_campaign_is_refused(folder: Path, finished: Path) -> None:
    shutil.copy(finished / "policies" / "open_loop.npz", folder / "policies" / "smooth.npz")
    with pytest.raises(ls.InputError, match=r"smooth.npz, which is damaged"):
        Results(folder).solution("smooth")
    # Also where the manifest has the hash of the other file.
    path = folder / "policies" / "smooth.npz"
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    edit(folder, lambda m: m["policies"]["smooth"].update(sha256=found), seals=("sha256",))
    with pytest.raises(ls.InputError, match=r"smooth.npz, which is damaged"):
        Results(folder).solution("smooth")


# The processor.


def test_results_name_the_processor(finished: Path, drive_solution: ls.Solution) -> None:
    assert drive_solution.versions["processor"] == machine.processor()
    assert Results(finished).manifest.versions["processor"] == machine.processor()


def test_the_processor_is_the_one_that_code_is_compiled_for() -> None:
    """LLVM is told what LQRSIM_CPU_NAME says; every LLVM knows "generic"."""
    program = "from lqrsim.machine import processor; print(processor())"
    told = {}
    for name in ("", "generic"):
        environment = {**os.environ, "LQRSIM_CPU_NAME": name} if name else dict(os.environ)
        done = subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
        )
        told[name] = done.stdout.strip()
    assert told[""] == machine.processor()
    assert told["generic"] != told[""]
    assert told["generic"].startswith("generic ")


@pytest.mark.parametrize(
    ("host", "told", "features"),
    [
        ({"avx2": True, "avx512f": True}, None, "+avx2,+avx512f,-avx512f"),  # of two, LLVM takes the last
        ({"avx2": True, "avx512f": False}, None, "+avx2,-avx512f"),
        ({"avx2": True, "avx512f": True}, "+avx2,+avx512f", "+avx2,+avx512f"),  # whoever asks for it has it
        ({"avx2": True, "avx512f": True}, "", ""),
    ],
)
def test_avx_512_is_left_out_unless_asked_for(
    host: dict[str, bool], told: str | None, features: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a processor has it, whole calls would take longer with it."""
    monkeypatch.setattr("llvmlite.binding.get_host_cpu_features", lambda: FeatureMap(host))
    monkeypatch.delenv("LQRSIM_CPU_NAME", raising=False)
    monkeypatch.delenv("LQRSIM_CPU_FEATURES", raising=False)
    if told is not None:
        monkeypatch.setenv("LQRSIM_CPU_FEATURES", told)
    assert machine.instruction_set.__wrapped__()[2] == features


def test_what_is_changed_in_the_versions_of_one_result_is_not_in_others() -> None:
    stage = ls.lq.Stage(A=[[[1.0]], [[1.0]]], B=[[1.0]], R=[[1.0]])
    end: Any = ls.types.Quadratic([[1.0]], [0.0], 0.0)  # pyright: ignore[reportArgumentType]
    one, other = (ls.lq.smooth_lq(stage, initial=end, final=end) for _ in range(2))
    before = dict(other.versions)
    changed: Any = one.versions
    changed["numpy"] = "0.1"
    assert before == other.versions == machine.versions()


def test_a_campaign_does_not_go_on_with_another_processor(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    here = machine.versions()
    monkeypatch.setattr(machine, "versions", lambda: here | {"processor": "other 01234567"})
    with pytest.raises(
        ls.InputError,
        match=f"processor other 01234567 \\(was {here['processor']}\\), which may change the last bits, want",
    ):
        run_campaign(CAMPAIGN, folder, workers=0)
    assert main(["replay", str(folder), "--cell", "0", "--trial", "0", "--out", str(folder.parent / "one.npz")]) == 0
    printed = capsys.readouterr().out
    other = f"other 01234567 (was {here['processor']})"
    assert f"values may differ from the table in the last bits: got processor {other}" in printed
    monkeypatch.undo()
    assert run_campaign(CAMPAIGN, folder, workers=0).complete
    assert main(["replay", str(folder), "--cell", "0", "--trial", "0", "--out", str(folder.parent / "one.npz")]) == 0
    assert "bits can differ" not in capsys.readouterr().out
