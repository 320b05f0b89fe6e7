"""Campaigns: the same bits whatever happens on the way, and one line for what cannot be."""

import contextlib
import errno
import io
import itertools
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from refusing import error_line
from sampling import is_short, rarely

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.control.controllers import Controller, ControllerRun, Feedback
from lqrsim.errors import Array, InputError
from lqrsim.scenarios.references import resolve
from lqrsim.simulation.disturbances import ControlNoise, ForceNoise
from lqrsim.stress.analysis import outcomes
from lqrsim.stress.campaign import Job, _code, _sole_writer, run_campaign, run_on_cluster
from lqrsim.stress.results import Columns, Damaged, Results, differences, replay, unpack
from lqrsim.stress.study import Campaign, Cell, Shard, TrialRunner

OWN = """
import dataclasses
import os
import signal
import time

import numpy as np

import lqrsim as ls
from lqrsim.simulation.disturbances import Disturbance, Effect


@dataclasses.dataclass(frozen=True)
class Trouble(Disturbance):
    kind: str
    share: float

    def scaled(self, strength):
        return self

    def start(self, plant, plan, generators):
        bad = np.array([generator.random() < self.share for generator in generators])

        def actuate(step, controls):
            if step == 10 and bad.any():
                if self.kind == "raise":
                    raise RuntimeError("two\\nlines")
                if self.kind == "shapes":
                    np.stack([np.zeros(2), np.zeros(3)])
                if self.kind == "sleep":
                    open(os.path.join(os.path.dirname(__file__), f"asleep.{os.getpid()}"), "w").close()
                    time.sleep(600)
                if self.kind == "die":
                    os.kill(os.getpid(), signal.SIGKILL)
            return controls

        return Effect(actuate=actuate)


def troubled(kind: str = "raise", share: float = 0.17) -> ls.Scenario:
    given = ls.scenarios.quadrotor()
    return dataclasses.replace(given, disturbances=(ls.disturbances.ControlNoise(0.05), Trouble(kind, share)))


def malformed() -> ls.Scenario:
    with open(os.path.join(os.path.dirname(__file__), "bad.xml"), "w") as file:
        file.write("<mujoco><worldbody><geom")
    return dataclasses.replace(ls.scenarios.quadrotor(), scene=ls.load_scene(file.name))
"""

CAMPAIGN = Campaign(
    scenario="quadrotor",
    sweeps={"scenario": ls.scenarios.quadrotor().disturbances},
    strengths=(1.0,),
    policies=("smooth", "open_loop"),
    trials=18,
    shard=4,
)
OPTIONS = "--sweep scenario --strengths 1 --policies smooth open_loop --trials 18 --shard 4"
COMMAND = ["quadrotor", *OPTIONS.split()]  # the same
LINUX = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "shards").iterdir())}


def same_bits(folder: Path, reference: Results) -> None:
    assert Results(folder).complete
    assert files(folder) == files(reference.folder)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Run in this process, one trial at a time."""
    return run_campaign(CAMPAIGN, tmp_path_factory.mktemp("campaign") / "reference", workers=0, batch=1)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("own") / "own.py"
    path.write_text(OWN, encoding="utf-8")
    return path


def troubled(own: Path, kind: str, **changes: object) -> Campaign:
    reference = f"{own}:troubled,kind={kind}"
    disturbances = resolve(reference).disturbances
    return replace(
        CAMPAIGN,
        scenario=reference,
        sweeps={"own": disturbances},
        policies=("smooth",),
        trials=24,
        shard=8,
        **changes,
    )


def damage(path: Path, how: str) -> None:
    contents = bytearray(path.read_bytes())
    if how == "truncated":
        contents = contents[: len(contents) // 2]
    elif how == "empty":
        contents = bytearray()
    else:
        table = pq.read_table(path)
        datum = contents.index(np.float64(table["worst"][3].as_py()).tobytes())
        contents[{"tail": -1, "datum": datum}[how]] ^= 4
    path.write_bytes(contents)


# The same bits.


def test_rows_are_those_of_one_rollout(reference: Results, quadrotor: ls.Scenario) -> None:
    cell = Cell("smooth", "scenario", 1.0)
    table = reference.outcomes(cell)
    rollout = ls.simulate(
        quadrotor.plant(), reference.solution("smooth"), disturbances=CAMPAIGN.disturbances(cell), trials=18,
        contacts=False, frames=False,
    )  # fmt: skip
    assert table.trial.tolist() == list(range(18))
    assert tuple(table.outcome) == rollout.outcome
    assert reference.cell_summaries()[cell].tally.total() == 18
    assert reference.complete
    assert reference.campaign == CAMPAIGN


@pytest.mark.parametrize(("workers", "batch"), [(0, 256), (2, 7), *rarely((0, 7), (1, 256))])
def test_workers_and_batches_do_not_matter(reference: Results, tmp_path: Path, workers: int, batch: int) -> None:
    run_campaign(CAMPAIGN, tmp_path, workers=workers, batch=batch)
    same_bits(tmp_path, reference)


@LINUX
@pytest.mark.long
def test_a_killed_worker_is_replaced(reference: Results, tmp_path: Path) -> None:
    killed = []

    def kill(done: int, total: int) -> None:
        children = [child for child in multiprocessing.active_children() if child.name == "lqrsim worker"]
        if children and len(killed) < 2:
            killed.append(children[0].pid)
            children[0].kill()

    run_campaign(CAMPAIGN, tmp_path, workers=2, progress=kill)
    assert len(killed) == 2
    same_bits(tmp_path, reference)
    assert not multiprocessing.active_children()


@LINUX
def test_a_killed_driver_is_resumed(reference: Results, tmp_path: Path) -> None:
    folder, draws = tmp_path / "killed", random.Random(3)
    command = [sys.executable, "-m", "lqrsim.cli", "stress", *COMMAND, "--workers", "2", "--out", str(folder)]
    counts = []
    for _ in range(1 if is_short() else 2):
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        ) as driver:
            begun, before = time.monotonic(), len(list(folder.glob("shards/[!.]*")))
            while time.monotonic() < begun + 20 and len(list(folder.glob("shards/[!.]*"))) == before:
                time.sleep(0.01)
            time.sleep(draws.uniform(0, 0.2))
            driver.kill()
            driver.wait()
            counts.append(len(list(folder.glob("shards/[!.]*.parquet"))))
            gone = time.monotonic() + 600
            while time.monotonic() < gone:
                try:
                    os.killpg(driver.pid, 0)
                except ProcessLookupError:
                    break
                time.sleep(0.05)
            else:
                pytest.fail("workers outlive the driver")
    assert counts == sorted(counts)
    assert main(["stress", *COMMAND, "--workers", "0", "--out", str(folder)]) == 0
    same_bits(folder, reference)


def test_finished_is_finished(reference: Results, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError

    before = {path: path.stat().st_mtime_ns for path in reference.folder.glob("shards/*")}
    monkeypatch.setattr(Job, "work", never)
    run_campaign(CAMPAIGN, reference.folder)
    run_campaign(replace(CAMPAIGN, time_limit=1.0), reference.folder)  # not a part of what is asked
    assert before == {path: path.stat().st_mtime_ns for path in reference.folder.glob("shards/*")}


@LINUX
@pytest.mark.long
def test_dask_does_the_same(reference: Results, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    killed = []
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:

        def kill(done: int, total: int) -> None:
            if done and not killed:
                killed.append(cluster.workers[0].process.pid)
                os.kill(killed[0], signal.SIGKILL)

        run_campaign(CAMPAIGN, tmp_path, scheduler=cluster.scheduler_address, progress=kill)
    assert killed
    same_bits(tmp_path, reference)


class Cluster:
    """A client of a dask cluster of one worker at a time, which runs shards by a script of attempts, in time made up.

    An attempt waits, then begins, and dies or ends after so many seconds: (wait, duration, whether its worker dies).
    """

    def __init__(self, scripts: Mapping[Shard, Sequence[tuple[float, float, bool]]]) -> None:
        self.now, self.handlers, self.done = 0.0, dict[str, Callable[[tuple[float, Any]], object]](), set[Shard]()
        self.restarted, self.workers, events = list[str](), itertools.count(), list[tuple[float, str, Any]]()
        for shard, attempts in scripts.items():
            at = 0.0
            for wait, duration, dies in attempts:
                worker, began = f"worker {next(self.workers)}", at + wait
                at = began + duration
                events.append((began, "job", [worker, [shard.cell_number, shard.first, shard.count]]))
                events.append((at, "all", {"action": "remove-worker", "worker": worker}) if dies else (at, "", shard))
        self.events = deque(sorted(events, key=lambda event: event[0]))

    def subscribe_topic(self, topic: str, handler: Callable[[tuple[float, Any]], object]) -> None:
        self.handlers[topic] = handler

    def wait(self, *_: object, **__: object) -> None:
        self.now += 0.5
        while self.events and self.events[0][0] <= self.now:
            at, topic, message = self.events.popleft()
            if topic:
                self.handlers.get(topic, lambda event: None)((at, message))
            else:
                self.done.add(message)

    def submit(self, function: object, job: object, shard: Shard, **_: object) -> Any:
        future = Mock(status="finished")
        future.done, future.result = lambda: shard in self.done, lambda: b""
        return future

    def nthreads(self) -> dict[str, int]:
        return dict.fromkeys(map(str, range(100)), 1)

    def as_current(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def restart_workers(self, workers: list[str], **_: object) -> None:
        self.restarted += workers

    def unsubscribe_topic(self, topic: str) -> None:
        del self.handlers[topic]

    def cancel(self, futures: object) -> None: ...


def test_only_the_time_of_a_living_worker_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shard whose worker dies waits until another begins it: only a run of more than the limit is stopped."""
    distributed, limit, stopped = pytest.importorskip("distributed"), 10.0, 0
    for seed in range(40):
        draws = random.Random(seed)
        scripts = dict[Shard, list[tuple[float, float, bool]]]()
        for number in range(draws.randint(1, 4)):
            deaths = [(draws.uniform(0, 30), draws.uniform(0, 9), True) for _ in range(draws.randint(0, 3))]
            duration = draws.choice((draws.uniform(0, 9), draws.uniform(11, 30)))
            scripts[Shard(0, number, 1)] = [*deaths, (draws.uniform(0, 30), duration, False)]
        cluster = Cluster(scripts)
        monkeypatch.setattr(distributed, "wait", cluster.wait)
        monkeypatch.setattr("lqrsim.stress.campaign.time", SimpleNamespace(monotonic=lambda made=cluster: made.now))
        job: Any = SimpleNamespace(name="job", errors=lambda shard, reason: reason.encode())
        files = dict(run_on_cluster(job, [*scripts], cluster, limit))
        for shard, attempts in scripts.items():
            late = attempts[-1][1] > limit
            assert files[shard] == (b"took longer than 10 s, and was stopped" if late else b"")
            stopped += late
        assert not cluster.handlers  # a scheduler complains of a client that is closed and wants to know more
        assert len(cluster.restarted) == sum(attempts[-1][1] > limit for attempts in scripts.values())
    assert 20 < stopped < 80


@LINUX
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.long
def test_a_lost_scheduler_is_one_line_and_what_is_done_stays(
    reference: Results, tmp_path: Path, number: int, capfd: pytest.CaptureFixture[str]
) -> None:
    distributed = pytest.importorskip("distributed")
    told = tmp_path / "scheduler.json"

    def start(module: str, *options: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options, "--scheduler-file", str(told)]
        return subprocess.Popen([*command, "--no-dashboard"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    scheduler, worker = start("dask_scheduler", "--port", "0"), start("dask_worker", "--nthreads", "1")
    try:
        until = time.monotonic() + 600
        while not told.is_file():
            assert time.monotonic() < until
            time.sleep(0.05)
        with distributed.Client(scheduler_file=str(told)) as client:
            client.wait_for_workers(1, timeout=600)
            address = client.scheduler.address

        def lose(done: int, total: int) -> None:
            if done:
                scheduler.send_signal(number)
                scheduler.wait(600)

        capfd.readouterr()
        with pytest.raises(InputError, match=r"scheduler: got .*run the same command again"):
            run_campaign(CAMPAIGN, tmp_path / "run", scheduler=address, progress=lose)
        assert capfd.readouterr() == ("", "")
    finally:
        for process in (worker, scheduler):
            process.kill()
            process.wait()
    assert list((tmp_path / "run" / "shards").glob("*.parquet"))
    run_campaign(CAMPAIGN, tmp_path / "run", workers=0)
    same_bits(tmp_path / "run", reference)


def test_the_scenario_is_made_once(own: Path, tmp_path: Path) -> None:
    """What is checked is what runs, also where a function makes something else each time."""
    counted = tmp_path / "counted.py"
    lines = [
        "def counted() -> ls.Scenario:",
        f"    with open({str(tmp_path / 'calls')!r}, 'a') as file:",
        "        print('made', file=file)",
        "    return troubled('none')",
    ]
    counted.write_text("\n".join([OWN, *lines, ""]), encoding="utf-8")
    campaign = replace(troubled(own, "none"), scenario=f"{counted}:counted", sweeps=CAMPAIGN.sweeps, trials=2)
    results = run_campaign(campaign, tmp_path / "out", workers=0)
    assert replay(results, results.cells[0], 1).trials == 1
    assert (tmp_path / "calls").read_text(encoding="utf-8") == "made\n"


def test_workers_do_not_run_another_scenario_than_was_made(tmp_path: Path) -> None:
    """They load its code, which may have changed since."""
    path = tmp_path / "own.py"
    path.write_text(OWN, encoding="utf-8")
    options: dict[str, Any] = {"policies": ("smooth",), "strengths": (1.0,), "trials": 2}
    campaign = Campaign.of_sets(f"{path}:troubled,kind=none", ["light"], **options)
    changed = "dataclasses.replace(ls.scenarios.quadrotor(), goal_radius=0.1)"
    path.write_text(OWN.replace("given = ls.scenarios.quadrotor()", f"given = {changed}"), encoding="utf-8")
    says = r"scenario: got a worker for which .*own.py:troubled,kind=none is another than the campaign's, want code"
    with pytest.raises(InputError, match=says):
        run_campaign(campaign, tmp_path / "out", workers=1)
    assert not multiprocessing.active_children()
    assert not list((tmp_path / "out").glob("shards/*"))


# What goes wrong in trials.


def test_an_exception_costs_its_own_trials_only(own: Path, tmp_path: Path) -> None:
    campaign = troubled(own, "raise")
    results = run_campaign(campaign, tmp_path, workers=0, batch=5)
    (cell,) = results.cells
    reasons = results.reasons(cell)
    table = results.outcomes(cell)
    assert 0 < len(reasons) < 6
    said = f"RuntimeError: two lines ({own.name}, line {line_of('raise RuntimeError')})"
    assert set(reasons.values()) == {said}
    assert sorted(reasons) == np.flatnonzero(table.outcome == "error").tolist()
    assert results.cell_summaries()[cell].tally["reached"] == 24 - len(reasons)
    assert np.isnan(table.worst[sorted(reasons)]).all()
    assert f"{len(reasons)} trials were stopped: {said}" in results.summary()


def line_of(text: str) -> int:
    return next(number for number, line in enumerate(OWN.splitlines(), 1) if text in line)


def test_where_every_trial_fails_the_line_is_named_and_no_disturbance_blamed(own: Path, tmp_path: Path) -> None:
    """The error is NumPy's, in a line of the user's; nothing was run, so that no run is alike."""
    campaign = troubled(own, "shapes,share=1.0")
    results = run_campaign(replace(campaign, sweeps={"light": campaign.sweeps["own"]}), tmp_path, workers=0)
    summary = results.summary()
    where = f"({own.name}, line {line_of('np.stack')})"
    assert f"24 trials were stopped: ValueError: all input arrays must have the same shape {where}" in summary
    assert "alone: --sweep" not in summary
    assert "deterministic" not in summary
    assert "0/24" in summary


@LINUX
@pytest.mark.parametrize(
    ("kind", "workers", "says"),
    [("sleep", 1, "took longer than 2 s"), ("die", 2, "its worker ended 3 times, at last with signal 9")],
)
@pytest.mark.long
def test_what_hangs_or_kills_its_worker_costs_its_shard(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, workers: int, says: str
) -> None:
    """Time passes only where the one worker hangs, so that no healthy shard is too late, however busy the machine."""

    def clock() -> float:
        return 3.0 * len(list(own.parent.glob("asleep.*")))

    healthy = run_campaign(troubled(own, "none"), tmp_path / "healthy", workers=0)
    monkeypatch.setattr("lqrsim.stress.campaign.time", SimpleNamespace(monotonic=clock))
    results = run_campaign(troubled(own, kind, time_limit=2.0), tmp_path / kind, workers=workers)
    (cell,) = results.cells
    for shard in results.shards(cell):
        table, good = results.table(shard), healthy.table(shard)
        if (table["outcome"] == "error").any():
            assert all(reason.startswith(says) for reason in table["reason"].tolist())
        else:
            assert all(table[name].tobytes() == good[name].tobytes() for name in ("trial", "worst", "cost"))
    assert 0 < results.cell_summaries()[cell].tally["error"] < 24


def test_a_policy_that_returns_nan_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Mad(Feedback):
        def start(self, trials: int) -> ControllerRun:
            return MadRun(super().start(trials))

    class MadRun(ControllerRun):
        def __init__(self, sane: ControllerRun) -> None:
            self.sane = sane

        def control(self, step: int, measured: Array) -> Array:
            return np.where(step == 20, np.nan, self.sane.control(step, measured))

    def mad(own: TrialRunner, cell: Cell) -> Controller | ls.AffinePolicy:
        plain = own.solutions[cell.policy].policy
        return Mad(plain) if cell.policy == "open_loop" else plain

    monkeypatch.setattr(TrialRunner, "controller", mad)
    results = run_campaign(CAMPAIGN, tmp_path, workers=0)
    nan = Cell("open_loop", "scenario", 1.0)
    tally = results.cell_summaries()[nan].tally
    assert tally["error"] > 15  # the others collide before
    assert tally["error"] + tally["collided"] == 18
    assert set(results.reasons(nan).values()) == {"controller at 0.6667 s: got nan for rotor_1, want a finite number"}
    assert results.cell_summaries()[Cell("smooth", "scenario", 1.0)].tally["reached"] > 13


def test_a_simulation_that_blows_up_is_diverged(tmp_path: Path) -> None:
    campaign = replace(CAMPAIGN, sweeps={"storm": (ForceNoise(1e12),)}, trials=8)
    results = run_campaign(campaign, tmp_path, workers=0)
    for cell in results.cells:
        assert results.cell_summaries()[cell].tally == {"diverged": 8}


# What goes wrong with the folder.


@pytest.mark.parametrize("how", ["truncated", "empty", "tail", "datum"])
def test_a_damaged_shard_is_named_and_repaired(reference: Results, tmp_path: Path, how: str) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(reference.folder, folder)
    shard = folder / "shards" / "0001-000000012.parquet"
    damage(shard, how)
    with pytest.raises(
        InputError, match=r"0001-000000012\.parquet, which is damaged .* lqrsim stress quadrotor --resume"
    ):
        Results(folder).outcomes(Cell("open_loop", "scenario", 1.0))
    Results(folder).outcomes(Cell("smooth", "scenario", 1.0))
    run_campaign(CAMPAIGN, folder, workers=0)
    same_bits(folder, reference)
    assert (folder / "damaged" / shard.name).exists()


def test_no_flipped_bit_is_missed(reference: Results) -> None:
    shard = next(reference.shards())
    contents, draws = reference.path(shard).read_bytes(), random.Random(0)
    whole = unpack(contents, shard, reference.manifest.digest)
    for _ in range(300):
        flipped = bytearray(contents)
        flipped[draws.randrange(len(flipped))] ^= 1 << draws.randrange(8)
        try:
            table = unpack(bytes(flipped), shard, reference.manifest.digest)
        except Damaged:
            continue
        assert all(table[name].tobytes() == whole[name].tobytes() for name in whole)  # in what nothing depends on


ROWS = 4
LONG = pa.DictionaryArray.from_arrays(pa.array(np.zeros(ROWS, np.int32)), pa.array(["x" * 30_000_000]))


@pytest.mark.parametrize(
    ("changes", "options", "says"),
    [
        ({"reason": LONG}, {"compression": "zstd"}, "another compression"),
        ({"reason": LONG}, {"compression": "brotli"}, "another compression"),
        ({}, {"compression": {"cost": "gzip", "reason": "snappy"}}, "another compression"),
        ({"reason": LONG}, {}, "other columns"),
        ({"reason": pa.array(["x" * 2_000_000] * ROWS)}, {}, "a text of 2000000 characters"),
        ({"reason": pa.array(["x" * 2_000_000] * ROWS)}, {"use_dictionary": False}, "a text of 2000000 characters"),
        ({"cost": pa.array([[1.0] * 100] * ROWS)}, {}, "other columns"),
        ({"cost": pa.array(range(ROWS))}, {}, "other columns"),
        ({"more": pa.array(range(ROWS))}, {}, "other columns"),
        ({"trial": None}, {}, "other columns"),
        ({"reason": pa.array([None] * ROWS, pa.string())}, {}, "ArrowInvalid"),
    ],
)
def test_what_is_in_a_shard_is_bounded_before_it_is_unpacked(
    reference: Results, changes: dict[str, pa.Array | None], options: dict[str, Any], says: str
) -> None:
    """Texts of a file of some kilobytes would take gigabytes."""
    shard = next(reference.shards())
    whole = pq.read_table(io.BytesIO(reference.path(shard).read_bytes()))
    assert len(whole) == ROWS
    columns = {name: whole[name] for name in whole.column_names} | changes
    table = pa.table({name: column for name, column in columns.items() if column is not None})
    file = io.BytesIO()
    pq.write_table(table.replace_schema_metadata(whole.schema.metadata), file, **options)
    pool = pa.default_memory_pool()
    before = pool.bytes_allocated()
    with pytest.raises(Damaged, match=says):
        unpack(file.getvalue(), shard, reference.manifest.digest)
    assert pool.bytes_allocated() - before < 1 << 20


@pytest.mark.skipif(os.name == "nt", reason="Windows has no pipes in folders")
def test_a_pipe_in_place_of_a_shard_is_moved_aside(reference: Results, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(reference.folder, folder)
    shard = folder / "shards" / "0001-000000012.parquet"
    shard.unlink()
    os.mkfifo(shard)
    with pytest.raises(InputError, match="without trials 12 to"):
        Results(folder).outcomes(Cell("open_loop", "scenario", 1.0))
    run_campaign(CAMPAIGN, folder, workers=0)
    same_bits(folder, reference)


def test_a_stopped_campaign_says_how_to_go_on(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """In Python below the traceback, and as a line of the command."""

    def stop(done: int, total: int) -> None:
        if done:
            raise KeyboardInterrupt

    folder = tmp_path / "folder"
    with pytest.raises(KeyboardInterrupt) as stopped:
        run_campaign(CAMPAIGN, folder, workers=0, progress=stop)
    (note,) = stopped.value.__notes__
    command = f"lqrsim stress {CAMPAIGN.scenario} --resume --out {folder}"
    assert note == f"{folder} has what is done; to go on, call run_campaign again, or run: {command}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "lqrsim.commands.console.Progress.__call__", lambda self, done, total, found="": stop(done, total)
        )
        assert main([*command.split()[1:], "--workers", "0"]) == 130
    assert capfd.readouterr().err.endswith(f"lqrsim: {note}\nlqrsim: stopped\n")


def test_a_shard_of_another_campaign_is_not_taken(reference: Results, tmp_path: Path) -> None:
    campaign = replace(CAMPAIGN, seed=1)
    other = run_campaign(campaign, tmp_path, workers=0)
    name = "0000-000000000.parquet"
    good = (other.folder / "shards" / name).read_bytes()
    (other.folder / "shards" / name).write_bytes((reference.folder / "shards" / name).read_bytes())
    run_campaign(campaign, tmp_path, workers=0)
    assert (other.folder / "shards" / name).read_bytes() == good


SCRIPT = """
import sys
if {dies} and __name__ == "__mp_main__":
    sys.exit(3)
import lqrsim as ls
force = {{"force": (ls.disturbances.ForceNoise(0.1),)}}
campaign = ls.stress.Campaign(scenario="quadrotor", sweeps=force, policies=("smooth",), trials=1)
ls.stress.run_campaign(campaign, sys.argv[1], workers=1)
"""


@pytest.mark.parametrize(
    ("dies", "got"),
    [
        (False, "a script that each worker runs as it starts"),
        pytest.param(
            True,
            "processes that do not start (its worker ended 3 times, at last with exit code 3)",
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_script_that_its_workers_run_too_is_refused(dies: bool, got: str, tmp_path: Path) -> None:
    """In one line, and without waiting for ever for a process that has died to take what no pipe holds at once."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(dies=dies), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, script, tmp_path / "run"], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1  # the script's own; none of a worker
    wanted = 'run_campaign() called under `if __name__ == "__main__":`, or workers=0'
    assert done.stderr.splitlines()[-1] == f"lqrsim.errors.InputError: workers: got {got}, want {wanted}"


def test_a_full_disk_stops_it_until_there_is_room(
    reference: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fsync, calls = os.fsync, []

    def full(handle: int) -> None:
        calls.append(handle)
        if len(calls) > 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        run_campaign(CAMPAIGN, tmp_path, workers=1)
    monkeypatch.undo()
    assert not multiprocessing.active_children()
    partial = Results(tmp_path)
    assert len(partial.missing) == 10 - 3
    assert len(partial.outcomes(CAMPAIGN.cells[0], partial=True)) in (4, 8, 12)
    with pytest.raises(InputError, match="without trials"):
        partial.outcomes(CAMPAIGN.cells[0])
    run_campaign(CAMPAIGN, tmp_path, workers=0)
    same_bits(tmp_path, reference)


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    code = "import sys, time; from pathlib import Path; from lqrsim.stress.campaign import _sole_writer\n"
    code += "with _sole_writer(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    campaign = replace(CAMPAIGN, trials=2)
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="another process writes"):
            run_campaign(campaign, tmp_path, workers=0)
        holder.kill()
        holder.wait()
    assert run_campaign(campaign, tmp_path, workers=0).complete  # the lock of a dead process is none


def test_the_lock_names_its_process_wherever_the_locked_byte_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lqrsim.stress.campaign._lock", lambda handle: os.lseek(handle, 1 << 20, os.SEEK_SET))
    with _sole_writer(tmp_path):
        assert (tmp_path / "campaign.lock").read_bytes() == f"{os.getpid()}\n".encode()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows locks in another way")
def test_a_file_system_without_locks_is_not_another_writer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import fcntl

    def missing(handle: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", missing)  # as NFS does whose server has no lock daemon
    with pytest.raises(InputError, match=r"want one whose files can be locked \(No locks available\)"):
        run_campaign(replace(CAMPAIGN, trials=2), tmp_path, workers=0)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"trials": 19}, "trials: got 19, want 18"),
        ({"seed": 1}, "seed: got 1, want 0"),
        ({"sweeps": {"scenario": (ControlNoise(0.1),)}}, "sweeps: scenario: got"),
        ({"scenario": "quadrotor,query=1"}, "scenario: got 'quadrotor,query=1', want 'quadrotor'"),
    ],
)
def test_another_campaign_is_refused(reference: Results, changes: dict[str, object], says: str) -> None:
    before = files(reference.folder)
    with pytest.raises(InputError) as refused:
        run_campaign(replace(CAMPAIGN, **changes), reference.folder)  # pyright: ignore[reportArgumentType]
    assert says in str(refused.value)
    assert files(reference.folder) == before


@pytest.mark.parametrize(
    "change",
    [
        lambda one: replace(one, goal_radius=0.1),
        lambda one: replace(one, robot=replace(one.robot, radius=0.25)),
        lambda one: replace(one, robot=replace(one.robot, drag=0.3)),
        lambda one: replace(one, robot=replace(one.robot, max_force=1.5)),
        lambda one: replace(one, scene=ls.load_scene("cage", obstacles=["wall_east"])),
    ],
    ids=["goal", "radius", "drag", "limits", "obstacles"],
)
def test_a_scenario_whose_runs_differ_is_refused(
    reference: Results, quadrotor: ls.Scenario, change: Callable[[ls.Scenario], ls.Scenario]
) -> None:
    """A function may return another scenario each time. Here the MJCF, the problem and the plans are the same."""
    other, strong = change(quadrotor), (ls.disturbances.MeanWind((3.0, 0.0, 0.0)), ControlNoise(0.5))
    of_quadrotor, of_other = (Campaign.from_json(CAMPAIGN.as_json(), scenario) for scenario in (quadrotor, other))
    run_campaign(of_quadrotor, reference.folder, workers=0, batch=1)
    with pytest.raises(InputError, match="robot, MJCF, choice of obstacles, simulator or goal radius"):
        run_campaign(of_other, reference.folder, workers=0, batch=1)
    plan, near = reference.solution("smooth"), (quadrotor.near_enough(), other.near_enough())
    one, two = (
        ls.simulate(scenario.plant(), plan, disturbances=strong, frames=False, **radius)
        for scenario, radius in zip((quadrotor, other), near, strict=True)
    )
    same = one.goal_radius == two.goal_radius and np.array_equal(one.clearance, two.clearance)
    assert not (same and np.array_equal(one.applied, two.applied))


def test_code_of_ones_own_that_has_changed_is_refused(own: Path, tmp_path: Path) -> None:
    copy = tmp_path / "own.py"
    shutil.copy(own, copy)
    campaign, folder = replace(troubled(copy, "none"), trials=2), tmp_path / "out"
    run_campaign(campaign, folder, workers=0)
    run_campaign(campaign, folder, workers=0)
    copy.write_text(OWN.replace("< self.share", "> self.share"), encoding="utf-8")
    with pytest.raises(InputError, match=r"^Trouble: got a file that has changed since .*out was begun, want it as it"):
        run_campaign(replace(troubled(copy, "none"), trials=2), folder, workers=0)


def test_a_change_of_either_of_two_classes_of_one_name_is_noticed(own: Path, tmp_path: Path) -> None:
    copies = [tmp_path / name for name in ("first.py", "second.py")]
    for copy in copies:
        shutil.copy(own, copy)
    sweep = tuple(troubled(copy, "none").sweeps["own"][1] for copy in copies)
    campaign = replace(CAMPAIGN, sweeps={"own": sweep})
    found = [_code(campaign)]
    for copy in copies:
        copy.write_text(f"{OWN}\n# changed", encoding="utf-8")
        found.append(_code(campaign))
    assert len({repr(digests) for digests in found}) == 3


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda path: path.mkdir(), "with a manifest.json"),
        (lambda path: path.write_text("x"), "with a manifest.json"),
        (lambda path: (path.mkdir(), (path / "manifest.json").write_text("{")), "damaged"),
        (lambda path: (path.mkdir(), (path / "manifest.json").write_text('{"format": 1, "version": 1}')), "want a"),
    ],
)
def test_what_is_no_campaign_is_not_opened(tmp_path: Path, make: Callable[[Path], object], says: str) -> None:
    make(tmp_path / "folder")
    with pytest.raises(InputError) as refused:
        Results(tmp_path / "folder")
    assert says in str(refused.value)


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("stress quadrotr", ["scenario: got 'quadrotr'"]),
        ("stress quadrotor --sweep hurricane", ["hurricane"]),
        ("stress quadrotor --sweep scenario:Gust", ["kind of disturbance in scenario: got 'Gust'", "ControlNoise"]),
        ("stress quadrotor --trials 0", ["trials: got 0"]),
        ("stress quadrotor --strengths -1", ["strengths[0]: got -1"]),
        ("stress quadrotor --strengths 1 1", ["strengths: got (1.0, 1.0)", "each at most once"]),
        ("stress quadrotor --replan-every 0.001", ["replan_every: got 0.001 s"]),
        ("stress quadrotor --workers -1", ["workers: got -1"]),
        ("stress quadrotor --batch 0", ["batch: got 0"]),
        ("stress quadrotor --resume", ["with a manifest.json"]),
        ("stress {own}:malformed", ["MJCF"]),
        ("replay {out} --cell 0 --trial 0", ["with a manifest.json"]),
        ("replay {reference} --cell smooth,gusts,1 --trial 0", ["cell: got 'smooth,gusts,1'", "smooth,scenario,1"]),
        ("replay {reference} --cell 0 --trial 18", ["trial: got 18"]),
    ],
)
def test_bad_input_is_one_line(
    command: str, says: list[str], own: Path, reference: Results, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = [word.format(own=own, out=out, reference=reference.folder) for word in command.split()]
    words += ["--out", str(out)] if words[0] == "stress" else []
    assert main(words) == 2
    error = error_line(capsys)
    assert all(part in error for part in says), error
    assert not out.exists()


def test_a_folder_with_other_things_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis.tex").touch()
    assert main(["stress", *COMMAND, "--out", str(tmp_path)]) == 2
    assert "thesis.tex" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_scheduler_that_does_not_answer_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="a dask scheduler that answers"):
        run_campaign(CAMPAIGN, tmp_path / "out", scheduler="nonsense://here")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"lqrsim\[distributed\]"):
        run_campaign(CAMPAIGN, tmp_path / "out", scheduler="tcp://127.0.0.1:1")
    assert not (tmp_path / "out").exists()


# The commands.


def test_stress_and_replay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, rollout = tmp_path / "out", tmp_path / "trial.npz"
    assert main(["stress", *COMMAND, "--workers", "0", "--out", str(folder)]) == 0
    results = Results(folder)
    printed = capsys.readouterr().out
    for cell in results.cells:
        assert f"{results.outcomes(cell).outcome.tolist().count('reached')}/18" in printed
    assert f"wrote {folder}" in printed
    cell = results.cells[1]
    collided = int(np.flatnonzero(results.outcomes(cell).outcome == "collided")[0])
    for name in ("1", str(cell)):
        assert main(["replay", str(folder), "--cell", name, "--trial", str(collided), "--out", str(rollout)]) == 0
        assert "identical to the table" in capsys.readouterr().out
    again = ls.load(rollout, ls.Rollout)
    assert (again.first_trial, again.outcome) == (collided, ("collided",))
    assert again.frames.shape[1] > 100
    assert main(["stress", "quadrotor", "--resume", "--workers", "0", "--out", str(folder)]) == 0


@pytest.mark.parametrize("command", ["stress", "report --out a.html --videos 0", "report --out a.csv"])
def test_a_table_is_read_once(command: str, own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a run, too, which says what is on disk; and where trials were stopped, whose reasons are told."""
    monkeypatch.chdir(tmp_path)
    campaign = troubled(own, "raise")
    read, first = Counter[Shard](), unpack

    def counted(contents: bytes, shard: Shard, digest: str) -> Columns:
        read[shard] += 1
        return first(contents, shard, digest)

    if command != "stress":
        run_campaign(campaign, "out", workers=0)
    monkeypatch.setattr("lqrsim.stress.results.unpack", counted)
    if command == "stress":
        options = "--sweep scenario --strengths 1 --policies smooth --trials 24 --shard 8 --workers 0 --out out --json"
        assert main(["stress", campaign.scenario, *options.split()]) == 1
    else:
        what, *options = command.split()
        assert main([what, "out", "--scenario", campaign.scenario, *options, "--json"]) == 0
    assert read == dict.fromkeys(Results("out").shards(), 1)


def test_what_was_read_does_not_hide_what_is_written_later(reference: Results, tmp_path: Path) -> None:
    folder, later = tmp_path / "copy", tmp_path / "later"
    shutil.copytree(reference.folder, folder)
    later.mkdir()
    for shard in [*reference.shards()][1:-2]:
        Results(folder).path(shard).rename(later / shard.file)
    part = Results(folder)

    def done() -> list[int]:
        return [so_far.tally.total() for so_far in part.cell_summaries().values()]

    assert done() == [4, 6]
    for path in later.iterdir():
        before = sum(done())
        path.rename(folder / "shards" / path.name)
        assert sum(done()) > before
    assert part.rates().columns == reference.rates().columns
    assert part.summary() == reference.summary()


def test_a_replay_says_how_often_it_planned_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every 2 of 5 s: after 2 and after 4."""
    run_campaign(replace(CAMPAIGN, policies=("smooth", "replan"), replan_every=2.0, trials=1), tmp_path, workers=0)
    for cell, said in (("0", False), ("1", True)):
        out = str(tmp_path / f"{cell}.npz")
        assert main(["replay", str(tmp_path), "--cell", cell, "--trial", "0", "--out", out]) == 0
        printed = capsys.readouterr().out
        assert ("solved again 2 times" in printed) == said
        assert ("solved again" in printed) == said


def test_a_trial_again_is_the_same_until_it_collides(reference: Results) -> None:
    for cell in reference.cells:
        for trial in (0, 9, 17):
            free, solid = (
                replay(reference, cell, trial, frames=contacts, contacts=contacts) for contacts in (False, True)
            )
            assert differences(reference, cell, trial, free) == differences(reference, cell, trial, solid) == []
            np.testing.assert_array_equal(free.states[free.counts], solid.states[solid.counts])


@pytest.mark.parametrize("seed", range(12))
def test_a_trial_that_hits_another_obstacle_differs(reference: Results, seed: int) -> None:
    """Also one whose name begins as that of the other does."""
    draws, cell = random.Random(seed), reference.cells[0]
    names = ["".join(draws.choices("ab", k=draws.randint(1, 4))) for _ in range(2)]
    run = replay(reference, cell, 0, frames=False)
    was, now = (replace(run, collided_at=np.array([1.0]), obstacles=(name,)) for name in names)
    row = outcomes(was, reference.runner.scenario.problem).columns()
    results: Any = SimpleNamespace(
        shards=lambda cell: [Shard(0, 0, 1)], table=lambda shard: row, runner=reference.runner
    )
    said = [f"obstacle: {names[1]} (in the table: {names[0]})"] if names[1] != names[0] else []
    assert differences(results, cell, 0, now) == said


def test_a_file_does_not_choose_what_code_runs(own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    campaign = troubled(own, "none")
    run_campaign(replace(campaign, trials=2), tmp_path, workers=0)
    results = Results(tmp_path)
    assert results.cell_summaries()[results.cells[0]].tally.total() == 2
    with pytest.raises(InputError, match="which runs only with --scenario"):
        replay(results, results.cells[0], 0)
    assert replay(Results(tmp_path, scenario=campaign.scenario), results.cells[0], 0).trials == 1
