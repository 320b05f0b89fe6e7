"""Running a campaign: trials of policies under disturbances of growing strength, stored in a folder.

    campaign = Campaign(scenario="quadrotor", sweeps={"gusts": (ls.disturbances.ForceNoise(0.2),)})
    results = run_campaign(campaign, "runs/stress/quadrotor")

A campaign can be interrupted at any time. On equal processors the rows of a trial depend on the campaign alone, not on
the number of workers, the batch size or interruptions. If workers die or hang, it continues.

On this machine each worker is a process with its own pipe. On a cluster dask starts workers, distributes tasks, and
repeats the tasks of dead workers, up to its `allowed-failures`. Tables come back as bytes, so no folder needs to be
shared. This module adds four things: a time limit that counts from the moment when a worker begins a task; restarts of
workers that hang, because `cancel()` does not stop a running task; one task at a time per worker; and at most two
queued tasks per worker, so that the scheduler never holds a whole campaign. CONTRIBUTING.md explains why no library
does all of this.
"""

import asyncio
import contextlib
import errno
import itertools
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import CancelledError
from copy import copy
from dataclasses import dataclass, field, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from lqrsim import process
from lqrsim.annotations import Bounds, Progress, Want, checked
from lqrsim.errors import InputError, check_path, excerpt, format_error, free_name, without_addresses
from lqrsim.machine import changed, description, other_lqrsim, processors, versions
from lqrsim.results import save_load
from lqrsim.results.archive import sha256
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Trajectory
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import resolve
from lqrsim.scenarios.solutions import digest_of_solution, digest_of_start, remarks
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.stress.analysis import COLUMNS, outcomes
from lqrsim.stress.results import (
    MANIFEST,
    SOLUTION_FILE,
    Columns,
    Damaged,
    Manifest,
    Results,
    pack,
    read_manifest,
    read_table,
    write,
    write_manifest,
)
from lqrsim.stress.study import (
    CAMPAIGN_POLICIES,
    DEFAULT_POLICIES,
    DESIGNED,
    POLICY_KINDS,
    Campaign,
    Cell,
    Shard,
    TrialRunner,
    check_used,
    design_uncertainty,
    impossible_policies,
    make_controller,
    solve_policies,
)

_log = logging.getLogger("lqrsim")

MOST_WORKERS, LARGEST_BATCH = 1024, 100_000
_HELD = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}  # another process has the lock; EDEADLK on Windows
_CAMPAIGN_FILES = {MANIFEST, SOLUTION_FILE, "campaign.lock", "policies", "shards", "damaged"}
FinishedShards = Generator[tuple[Shard, bytes]]
_POLL = 0.5  # s between two checks of the time limit
RESUME = "run the same command again to resume"
_one_at_a_time = threading.Lock()  # a process has one set of workspaces
ATTEMPTS = 3  # number of attempts to run a shard, or to start a process
_START_TIMEOUT = 300.0  # s
_ONE_THREAD = ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMBA")
_context = multiprocessing.get_context("spawn")  # forking a process that has threads is not safe
_NAME = "lqrsim worker"
_RUNS_THE_SCRIPT = 79  # exit code of a worker that, by importing the caller's script, would start the campaign again
_GUARD = 'run_campaign() called under `if __name__ == "__main__":`, or workers=0'
_starting = threading.Lock()  # the environment is that of all threads
_serving = False  # whether this process is a worker that has imported the caller's script


@checked
def run_campaign(
    campaign: Campaign,
    folder: str | os.PathLike[str],
    *,
    workers: Annotated[int, Bounds(at_least=0, at_most=MOST_WORKERS)] | None = None,
    batch: Annotated[int, Bounds(at_least=1, at_most=LARGEST_BATCH)] = 256,
    scheduler: Annotated[str, Want("an address, such as tcp://host:8786")] | None = None,
    progress: Progress | None = None,
) -> Results:
    """Run the trials of a campaign that are not in its folder yet. Call it again to resume after an interruption.

    Args:
      folder: where everything is stored, the campaign's `solution` too.
      workers: number of processes on this machine, at most one per shard that is left; by default one per processor. 0
        runs everything in this process.
      batch: number of trials that a worker simulates together; affects only time and memory.
      scheduler: address of a dask cluster that does the work instead of this machine, such as tcp://10.0.0.1:8786.

    Raises:
      InputError: a script calls this with workers and without `if __name__ == "__main__":`, so that each worker would
        call it again.
    """
    end_if_started_by_import()
    # A copy, so that what is resolved here is resolved again in the next run: its code may have changed.
    campaign, folder = copy(campaign), check_path("folder", folder, "the path of a folder")
    workers = processors() if workers is None else workers
    tell = progress or (lambda done, total: None)
    _check_runnable(campaign)
    specification = _specification(campaign)
    if os.path.isdir(folder) and not os.path.exists(folder / MANIFEST):
        names = (name for name in os.listdir(folder) if not name.startswith(".unfinished-"))
        if others := sorted({*names} - _CAMPAIGN_FILES):
            raise InputError(f"folder: got {folder}, which has {excerpt(others)}, want an empty folder or a campaign's")
    with contextlib.ExitStack() as stack:
        client = None if scheduler is None else stack.enter_context(connected(scheduler))
        stack.enter_context(_sole_writer(folder))
        stack.enter_context(_resumable(folder, campaign.scenario))
        if os.path.exists(folder / MANIFEST):
            _check_same_campaign(specification, read_manifest(folder), folder)
        else:
            _begin(campaign, specification, folder)
        results = Results(folder, scenario=campaign.scenario)
        # What is run is what is replayed, also where a function makes another scenario each time.
        results.campaign = campaign
        unfinished = _unfinished(results)
        if unfinished and (others := changed(results.manifest.versions)):
            want = f"the versions of {folder}, or another folder"
            raise InputError(f"versions: got {others}, which may change the last bits, want {want}")
        if unfinished:
            warm_up(results.runner)  # done here first, so that the workers find everything compiled
        # Without the logs of their solves, which workers do not need.
        unused: dict[str, Any] = {"inverse_policy": None, "cost_to_come": None, "iterations": (), "candidates": ()}
        solutions = {policy: replace(solution, **unused) for policy, solution in results.runner.solutions.items()}
        job = Job(results.manifest, solutions, batch)
        total = campaign.trials * len(results.cells)
        done = total - sum(shard.count for shard in unfinished)
        tell(done, total)
        if client is not None:
            work = run_on_cluster(job, unfinished, client, campaign.time_limit)
        elif workers:
            work = run_in_processes(job, unfinished, min(workers, len(unfinished)), campaign.time_limit)
        else:
            work = ((shard, job.work(shard, results.runner)) for shard in unfinished)
        for shard, contents in stack.enter_context(contextlib.closing(work)):
            write(contents, results.path(shard))
            done += shard.count
            tell(done, total)
        for cell, so_far in results.cell_summaries().items():
            if (counted := so_far.tally.total()) != campaign.trials:
                raise InputError(f"folder: got {counted} trials of {cell}, want {campaign.trials}: {results.command}")
    return results


@contextlib.contextmanager
def _sole_writer(folder: Path) -> Iterator[None]:
    """Make the folder if it does not exist, and lock it during the block.

    The system releases the lock when the process dies, however it dies. File systems without locks are refused.
    """
    path = folder / "campaign.lock"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise InputError(f"folder: got {folder}, want one that can be written ({error.strerror})") from None
    try:
        try:
            _lock(handle)
        except OSError as error:
            got = f"{folder}, which another process writes (see {path.name}), want one at a time"
            if error.errno not in _HELD:
                got = f"{folder}, want one whose files can be locked ({error.strerror or error})"
            raise InputError(f"folder: got {got}") from None
        with contextlib.suppress(OSError):  # shows which process has the lock
            os.ftruncate(handle, 0)
            os.lseek(handle, 0, os.SEEK_SET)  # on Windows a lock is far behind
            os.write(handle, f"{os.getpid()}\n".encode())
        yield
    finally:
        os.close(handle)


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int) -> None:
        os.lseek(handle, 1 << 20, os.SEEK_SET)  # a byte that is never read: locked bytes cannot be read

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def _resumable(folder: Path, scenario: str) -> Iterator[None]:
    """A block whose KeyboardInterrupt says how to go on, once the folder has a campaign."""
    try:
        yield
    except KeyboardInterrupt as stop:
        if (folder / MANIFEST).exists():
            command = Results(folder, scenario=scenario).command
            stop.add_note(f"{folder} has what is done; to go on, call run_campaign again, or run: {command}")
        raise


def _check_runnable(campaign: Campaign) -> None:
    """Raise InputError for errors that would occur in every trial, before anything is solved or written."""
    scenario, given = campaign.resolved, campaign.given
    problem, plant = scenario.problem, scenario.plant()
    impossible = impossible_policies(scenario, given)
    for policy in campaign.policies:
        if policy in impossible:
            possible = ", ".join(name for name in CAMPAIGN_POLICIES if name not in impossible)
            raise InputError(f"policies: got {policy}, {impossible[policy]}, want some of {possible}")
    check_used(given, campaign.policies)
    if problem.duration is None:
        plant.substeps(problem.dt)
    _ = campaign.goal_options  # raises InputError if they do not fit
    if {*DESIGNED} & {*campaign.policies}:
        design_uncertainty(scenario, campaign.design_disturbances)
    for cell in campaign.cells:
        if POLICY_KINDS[cell.policy].per_cell:
            try:
                design_uncertainty(scenario, campaign.disturbances(cell))
            except InputError as error:
                raise InputError(f"policies: {cell.policy} for {cell.sweep}: {error}") from None
    if campaign.replan_every is not None and campaign.replan_every < 0.999 * problem.dt:
        raise InputError(f"replan_every: got {campaign.replan_every:g} s, want at least {problem.dt:g}")


def _drawing_nothing(campaign: Campaign) -> list[list[Any]]:
    """The sweeps and strengths at which nothing is drawn. Raises InputError if a disturbance does not fit the robot."""
    problem, plant = campaign.resolved.problem, campaign.resolved.plant()
    states, m = np.tile(problem._start_or_zero, (problem.steps + 1, 1)), len(problem.control_coordinates)
    standing = Trajectory(states, np.zeros((problem.steps, m)), problem.dt)

    def may_draw(disturbance: Disturbance) -> bool:
        """Whether trials may draw numbers for it: lqrsim's own do so as they start, others perhaps during a run."""
        generator = np.random.default_rng(campaign.seed)
        untouched = generator.bit_generator.state
        try:
            disturbance.check(plant)
            disturbance.start(plant, standing, [generator])
        except InputError:
            raise
        except Exception:  # it may depend on the trial or the plan, and then counts as an error of those trials
            _log.debug("%s cannot be started beforehand", disturbance, exc_info=True)
            return True
        return not _is_packaged(type(disturbance)) or generator.bit_generator.state != untouched

    deterministic = list[list[Any]]()
    for sweep, strength in itertools.product(campaign.sweeps, campaign.strengths):
        try:
            drawn = [may_draw(disturbance.scaled(strength)) for disturbance in campaign.sweeps[sweep]]
        except InputError as error:
            raise InputError(f"sweeps: {sweep} at strength {strength:g}: {error}") from None
        deterministic += [] if any(drawn) else [[sweep, strength]]
    return deterministic


def _is_packaged(kind: type[Disturbance]) -> bool:
    return kind.__module__.partition(".")[0] == "lqrsim"


def _specification(campaign: Campaign) -> dict[str, Any]:
    """The fields of the manifest that need no solve; they stay the same when the campaign is resumed.

    Raises InputError if a disturbance does not fit the robot.
    """
    scenario, given = campaign.resolved, campaign.given
    return {
        "campaign": campaign.as_json(),
        "model": _digest_of_runs(scenario),
        "problem": scenario.problem.digest,
        "start": digest_of_start(scenario),
        "solution": None if given is None else digest_of_solution(given),
        "code": _code(campaign),
        "deterministic": _drawing_nothing(campaign),
    }


def _begin(campaign: Campaign, specification: dict[str, Any], folder: Path) -> None:
    """Solve; write the solutions and, at last, the manifest, with which the folder is that of a campaign."""
    scenario, given, design = campaign.resolved, campaign.given, campaign.design_disturbances
    solutions = solve_policies(campaign.policies, scenario, design, given)
    for policy in {*DESIGNED} & {*campaign.policies}:  # nothing is written if a controller cannot be made
        make_controller(POLICY_KINDS[policy].controller, scenario, solutions[policy], design=design)
    hashes = dict[str, dict[str, str]]()
    for policy, solution in solutions.items():
        path = save_load.save(solution, folder / "policies" / f"{policy}.npz")
        hashes[policy] = {"digest": digest_of_solution(solution), "sha256": sha256(path.read_bytes())}
    if given is not None:
        save_load.save(given, folder / SOLUTION_FILE)
    lines = [f"{name} {line}" for name, plan in solutions.items() for line in remarks(scenario, plan)]
    impossible = impossible_policies(scenario, given)
    missing = "; ".join(f"{name}, {impossible[name]}" for name in DEFAULT_POLICIES if name in impossible)
    # Policies that were chosen leave out others on purpose.
    by_default = {*campaign.policies} == {*DEFAULT_POLICIES} - {*impossible}
    write_manifest(folder, specification | {
        "policies": hashes, "versions": versions(), "machine": description(), "remarks": lines,
        "left_out": f"left out: {missing}" if missing and by_default else "",
        "cells": [[cell.policy, cell.sweep, cell.strength] for cell in campaign.cells],
    })  # fmt: skip


def _check_same_campaign(specification: dict[str, Any], manifest: Manifest, folder: Path) -> None:
    # Each sweep is compared as one field.
    now, before = (
        {f"sweeps: {name}": sweep for name, sweep in stated["sweeps"].items()} | {**stated, "sweeps": None}
        for stated in (specification["campaign"], manifest.campaign)
    )
    for name in [*now, *before]:
        value, was = now.get(name), before.get(name)
        if name != "time_limit" and value != was:
            raise InputError(f"{name}: got {excerpt(value)}, want {excerpt(was)}, as in {folder}, or another folder")
    for name, parts in (
        ("model", "robot, MJCF, choice of obstacles, simulator or goal radius"), ("problem", "problem"),
        ("start", "start"),
    ):  # fmt: skip
        if specification[name] != getattr(manifest, name):
            older = other_lqrsim(manifest.versions)
            got = f"a {parts} other than the one {folder} was begun with"
            got += f", or with the hashes of {older}" if older else ""
            raise InputError(f"scenario: got {got}, want the same, or another folder")
    if specification["solution"] != manifest.solution:
        got = "none" if specification["solution"] is None else "another"
        want = "none" if manifest.solution is None else folder / SOLUTION_FILE
        raise InputError(f"solution: got {got}, want {want}, as {folder} was begun with, or another folder")
    for kind, digest in specification["code"].items():
        if digest != manifest.code.get(kind):
            raise InputError(f"{kind}: got a file that has changed since {folder} was begun, want it as it was then")


def _digest_of_runs(scenario: Scenario) -> str:
    """Hash of everything in a scenario that runs depend on, besides its problem, its start and the disturbances."""
    scene, robot, plant = scenario.scene, scenario.robot, scenario.plant()
    dynamics = robot.dynamics
    states, controls = dynamics.state_coordinates, dynamics.control_coordinates
    # Maps are code: their values at zero and at each unit vector stand for them.
    probes = [[*np.zeros((1, len(space))), *np.eye(len(space))] for space in (states, controls)]
    maps = [np.concatenate(robot.configuration(row)) for row in probes[0]], [robot.actuation(row) for row in probes[1]]
    spheres = robot.balls
    balls = [] if spheres is None else [spheres.radii, *(spheres.centres(dynamics, row) for row in probes[0])]
    names = robot.name, robot.body, robot.joints, robot.actuators, robot.wheels, dynamics.model_digest
    numbers = robot.drag, robot.radius, plant.timestep, robot.activations, scene.geoms, dynamics.parameters
    stated: tuple[Any, ...] = (names, numbers, scenario.near_enough(), without_addresses(str(scenario.simulator)))
    stated += (scenario.sensors,) * bool(scenario.sensors)  # folders from before there were sensors stay valid
    rules = states.rules, controls.rules
    arrays = (np.asarray(values, dtype=np.float64) for values in (*maps[0], *maps[1], *balls))
    return sha256(scene.xml, repr(stated), *rules, *(part for array in arrays for part in (f"{array.shape}", array)))


def _code(campaign: Campaign) -> dict[str, str | None]:
    """The hash of the file that defines each of the user's disturbances; None if no file defines it."""
    used = itertools.chain(*campaign.sweeps.values(), campaign.design_disturbances or ())
    kinds = {kind for kind in map(type, used) if not _is_packaged(kind)}
    files = dict[str, list[str | None]]()  # by name, for two modules may have classes of one name
    for kind in sorted(kinds, key=lambda kind: (kind.__qualname__, kind.__module__)):
        file = getattr(sys.modules.get(kind.__module__), "__file__", None)
        files.setdefault(kind.__qualname__, []).append(file)
    contents = {name: [Path(path).read_bytes() for path in paths if path] for name, paths in files.items()}
    return {name: sha256(*parts) if len(parts) == len(files[name]) else None for name, parts in contents.items()}


def _unfinished(results: Results) -> list[Shard]:
    """The shards that are still to be run. Removes half-written files, and moves damaged ones aside."""
    for remains in results.folder.glob("**/.unfinished-*"):
        remains.unlink(missing_ok=True)
    on_disk, unfinished = results.shards_on_disk(), list[Shard]()
    for shard in results.shards():
        path = results.path(shard)
        try:
            if shard in on_disk:
                read_table(path, shard, results.manifest.digest)
                continue
        except Damaged as error:
            folder = results.folder / "damaged"
            try:
                folder.mkdir(exist_ok=True)
                aside = path.replace(folder / free_name(path.name, os.listdir(folder)))
            except OSError as problem:
                got = f"{path}, which is damaged and cannot be moved ({problem.strerror})"
                raise InputError(f"shard: got {got}, want it removed") from None
            _log.warning("%s was damaged (%s); moved it to %s, its trials run again", path.name, error, aside)
        unfinished.append(shard)
    return unfinished


@dataclass(frozen=True, eq=False)
class Job:
    """Everything that a worker needs for a campaign."""

    manifest: Manifest
    solutions: Mapping[str, Solution]  # by policy
    batch: int
    # Differs in every run, even of the same campaign.
    name: str = field(default_factory=lambda: f"lqrsim-{uuid.uuid4().hex}")

    def prepare(self, *, here: bool = False) -> TrialRunner:
        """Make the runner of this job's trials, with everything compiled.

        Raises InputError if this is the driver's machine, and the code of the scenario has changed meanwhile. Elsewhere
        the files of its meshes may be in other folders, so that it is not compared.
        """
        manifest, reference = self.manifest, self.manifest.settings.scenario
        scenario = resolve(reference)
        if here and (_digest_of_runs(scenario), scenario.problem.digest) != (manifest.model, manifest.problem):
            got = f"a worker for which {reference} is another than the campaign's"
            raise InputError(f"scenario: got {got}, want code that has not changed since the campaign was made")
        runner = TrialRunner(Campaign.from_json(manifest.campaign, scenario), self.solutions)
        warm_up(runner)
        return runner

    def work(self, shard: Shard, runner: TrialRunner) -> bytes:
        """Run a shard in this process. Returns its file.

        It is simulated in batches. If a trial of a batch is an error, all its trials are run again one by one.
        """
        cell, end = runner.campaign.cells[shard.cell_number], shard.first + shard.count
        parts: list[Columns] = []
        for first in range(shard.first, end, self.batch):
            count = min(self.batch, end - first)
            rows = _rows(runner, cell, first, count)
            alone = count > 1 and bool((rows["outcome"] == "error").any())
            parts += [_rows(runner, cell, trial, 1) for trial in range(first, first + count)] if alone else [rows]
        table = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return pack(table, shard, self.manifest.digest)

    def errors(self, shard: Shard, reason: str) -> bytes:
        """The file of a shard that could not be run: each of its trials is an error with this reason."""
        return pack(_error_rows(shard.first, shard.count, reason), shard, self.manifest.digest)


def warm_up(runner: TrialRunner) -> None:
    """Compile everything, by running undisturbed trials."""
    options: dict[str, Any] = {"frames": False, "contacts": False, "threads": 1}
    first = next(iter(runner.solutions.values()))
    law = make_controller("feedback", runner.scenario, first)
    outcomes(simulate(runner.plant, first, controller=law, **options), runner.scenario.problem)
    filtered = [cell for cell in runner.campaign.cells if POLICY_KINDS[cell.policy].controller == "offset_free"]
    for cell in filtered[:1]:  # to compile its filter, too
        simulate(runner.plant, runner.solutions[cell.policy], controller=runner.controller(cell), **options)


def _rows(runner: TrialRunner, cell: Cell, first: int, count: int) -> Columns:
    try:
        rollout = runner.run(cell, first, count, frames=False, contacts=False)
        table = outcomes(rollout, runner.scenario.problem).columns()
    except Exception as error:  # a disturbance or a scenario may raise anything; it counts as failed trials
        return _error_rows(first, count, format_error(error))
    reasons = np.array(rollout.reasons, dtype=np.str_)
    return table | {"reason": np.where(np.isin(table["outcome"], ("diverged", "error")), reasons, "")}


def _error_rows(first: int, count: int, reason: str) -> Columns:
    """The rows of trials that could not be run: errors with this reason."""
    columns: Columns = dict.fromkeys(COLUMNS, np.full(count, np.nan))
    columns |= {"trial": np.arange(first, first + count), "outcome": np.full(count, "error")}
    return columns | {"obstacle": np.full(count, ""), "reason": np.full(count, reason)}


def run_in_processes(job: Job, shards: list[Shard], workers: int, time_limit: float) -> FinishedShards:
    """Run the shards in worker processes; yield each shard with its file.

    If a process dies, another one runs its shard again. The trials of a shard count as failed if its process dies three
    times, or if it exceeds the time limit. One thread waits for all processes: with several, Ctrl-C at the wrong moment
    would leave a lock locked forever.
    """
    waiting, busy = deque(map(_Task, shards)), dict[Any, _Worker]()
    try:
        while waiting or busy:
            while waiting and len(busy) < max(workers, 1):
                worker = _Worker(waiting.popleft())
                busy[worker.connection] = worker
            wait(busy, max(min(worker.deadline for worker in busy.values()) - time.monotonic(), 0.0))
            for worker in [*busy.values()]:
                task = worker.task
                try:
                    message = worker.receive()
                except (EOFError, OSError) as error:
                    reason = task.given_up(worker, error)
                    del busy[worker.connection]
                    worker.end()
                    if reason:
                        yield task.shard, job.errors(task.shard, reason)
                    else:
                        waiting.appendleft(task)
                    continue
                match message:
                    case "started":
                        worker.send(job, _START_TIMEOUT)
                    case "ready":
                        worker.ready = True
                        worker.send(task.shard, time_limit)
                    case InputError():
                        raise message
                    case bytes(file):
                        if waiting:
                            worker.task = waiting.popleft()
                            worker.send(worker.task.shard, time_limit)
                        else:
                            del busy[worker.connection]
                            worker.end()
                        yield task.shard, file
    finally:
        for worker in busy.values():
            worker.end()


@dataclass
class _Task:
    """A shard to be run in processes, and how often that has failed."""

    shard: Shard
    died: int = 0
    failed_starts: int = 0  # one after the other

    def given_up(self, worker: "_Worker", error: Exception) -> str:
        """The reason to run the shard no more, or nothing. Raises InputError if no worker starts."""
        if late := isinstance(error, TimeoutError):
            reason = f"took longer than {worker.limit:g} s, and was stopped"
        else:
            worker.process.join(5.0)
            code = worker.process.exitcode
            end = f"exit code {code}"
            if code is not None and code < 0:
                end = f"signal {-code} ({signal.strsignal(-code)})"
            reason = f"its worker ended {ATTEMPTS} times, at last with {end}"
            if code == _RUNS_THE_SCRIPT:
                raise InputError(f"workers: got a script that each worker runs as it starts, want {_GUARD}") from None
        self.died += worker.ready
        self.failed_starts = 0 if worker.ready else self.failed_starts + 1
        if self.failed_starts == ATTEMPTS:
            raise InputError(f"workers: got processes that do not start ({reason}), want {_GUARD}") from None
        return reason if self.died == ATTEMPTS or (late and worker.ready) else ""


def end_if_started_by_import() -> None:
    """End this process if it is a worker, and its import of the caller's script has started the campaign again.

    Python would refuse to start processes there, but only after all earlier work of the script, and with a page of text
    from each worker. The driver recognises the exit code.
    """
    if multiprocessing.current_process().name == _NAME and not _serving:
        sys.exit(_RUNS_THE_SCRIPT)


class _Worker:
    """A worker process, which runs one shard after the other.

    It says that it has imported the caller's script, then receives the job, says that it can begin, or why it cannot,
    and receives shards. The job is not an argument of the process: Python writes arguments to a pipe whose other end it
    keeps open, and if the process dies before it reads them, the writer waits forever.
    """

    def __init__(self, task: _Task) -> None:
        self.task, self.ready = task, False
        self.limit, self.deadline = _START_TIMEOUT, time.monotonic() + _START_TIMEOUT  # s
        self.connection, theirs = _context.Pipe()
        self.process = _context.Process(target=_serve, args=(theirs,), name=_NAME, daemon=True)
        with _starting, _worker_environment(), _without_ctrl_c():
            self.process.start()
        theirs.close()  # then the end of the process closes the pipe

    def receive(self) -> bytes | str | InputError | None:
        """What it says, or None if nothing yet. Raises EOFError or OSError if the process has died; TimeoutError."""
        if self.connection.poll():
            return self.connection.recv()
        if time.monotonic() > self.deadline:
            raise TimeoutError
        return None

    def send(self, what: Job | Shard, limit: float) -> None:
        """Send what it is to answer within so many seconds."""
        self.limit, self.deadline = limit, time.monotonic() + limit
        with contextlib.suppress(OSError):  # if the process has died, the next to receive from it sees that
            self.connection.send(what)

    def end(self) -> None:
        """Stop the process, even in the middle of a task."""
        self.connection.close()
        self.process.kill()
        self.process.join()


def _serve(connection: Connection) -> None:
    global _serving
    _serving = True
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to all processes; the driver handles it
    try:
        connection.send("started")
        job: Job = connection.recv()
    except (EOFError, OSError):  # the driver has ended
        return
    with contextlib.suppress(EOFError, OSError):
        try:
            runner = job.prepare(here=True)
        except InputError as error:
            connection.send(error)
            return
        connection.send("ready")
        while True:
            connection.send(job.work(connection.recv(), runner))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _worker_environment() -> contextlib.AbstractContextManager[None]:
    """Processes started in this block use one thread each, and the GLFW library that this process has loaded.

    Without the latter, importing MuJoCo starts a process that looks for GLFW. That process would outlive a worker that
    is stopped meanwhile, and complain that nobody reads its result.
    """
    variables = dict.fromkeys([f"{name}_NUM_THREADS" for name in _ONE_THREAD], "1")
    glfw = getattr(sys.modules.get("glfw.library"), "glfw", None)
    if glfw is not None and sys.platform != "win32":  # on Windows it starts no process
        variables["PYGLFW_LIBRARY"] = glfw._name
    return process.environment(**variables)


@contextlib.contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Processes started in this block are not interrupted by Ctrl-C while they start."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # The tracker starts with the first process, and would unblock SIGINT for it.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """Connect a dask client. Raises InputError if there is no cluster, or its workers have other versions."""
    try:
        import distributed
    except ImportError:
        raise InputError("scheduler: got an address, want dask installed: pip install 'lqrsim[distributed]'") from None
    try:
        client = distributed.Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"scheduler: got {address}, want a dask scheduler that answers ({error})") from None
    with _silenced(), contextlib.closing(client):
        try:
            versions_there: Any = client.run(versions)
        except Exception as error:  # a worker may raise anything
            raise InputError(f"scheduler: got {address}, want workers that can run lqrsim ({error})") from None
        if not versions_there:
            raise InputError(f"scheduler: got {address}, which has no workers, want at least one")
        here = versions()
        for worker, there in versions_there.items():
            if other := ", ".join(f"{name} {there.get(name)}" for name in here if there.get(name) != here[name]):
                raise InputError(f"scheduler: got worker {worker} with {other}, want the versions of this machine")
        yield client


def run_on_cluster(job: Job, shards: list[Shard], client: Any, time_limit: float) -> FinishedShards:
    """Run the shards on the cluster; yield each shard with its file. Raises InputError if the scheduler is lost."""
    import distributed

    waiting = iter(shards)
    submitted: dict[Any, Shard] = {}
    running: dict[Shard, tuple[str, float]] = {}  # the worker that runs a shard, and when it began

    def forget(event: tuple[float, Any]) -> None:
        """A worker has died: what it ran waits for another, and no time counts until that begins it."""
        for shard, (worker, _) in [*running.items()]:
            if event[1] == event[1] | {"action": "remove-worker", "worker": worker}:
                del running[shard]

    client.subscribe_topic("all", forget)
    client.subscribe_topic(
        job.name, lambda event: running.update({Shard(*event[1][1]): (event[1][0], time.monotonic())})
    )
    try:
        while True:
            # One running and one waiting for each worker.
            free_slots = 2 * max(1, len(client.nthreads())) - len(submitted)
            for shard in itertools.islice(waiting, max(0, free_slots)):
                submitted[client.submit(_run_on_worker, job, shard, key=f"{job.name}-{shard.file}")] = shard
            if not submitted:
                return
            with contextlib.suppress(TimeoutError), client.as_current():
                distributed.wait(list(submitted), timeout=_POLL, return_when="FIRST_COMPLETED")
            for future, shard in list(submitted.items()):
                if future.done():
                    del submitted[future]
                    if future.status in ("cancelled", "lost"):
                        raise CancelledError
                    done = future.status == "finished"
                    yield shard, future.result() if done else job.errors(shard, format_error(future.exception()))
                elif (begun := running.get(shard)) and time.monotonic() - begun[1] > time_limit:
                    del submitted[future]
                    future.cancel()
                    # A thread that hangs cannot be stopped otherwise; the worker may have ended, or have no nanny.
                    with contextlib.suppress(Exception):
                        client.restart_workers([begun[0]], timeout=30, raise_for_error=False)
                    yield shard, job.errors(shard, f"took longer than {time_limit:g} s, and was stopped")
    except (CancelledError, asyncio.CancelledError):
        raise InputError(f"scheduler: got a scheduler that lost its tasks or was restarted, {RESUME}") from None
    except OSError as error:  # dask's connection errors are also OSErrors
        raise InputError(f"scheduler: got no answer ({error}), {RESUME}") from None
    finally:
        with contextlib.suppress(Exception):  # the scheduler may have ended
            for topic in ("all", job.name):
                client.unsubscribe_topic(topic)
            client.cancel(list(submitted))


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """In this block dask prints no tracebacks; errors that matter are raised."""
    known = [logger for logger in logging.Logger.manager.loggerDict.values() if isinstance(logger, logging.Logger)]
    loggers = [logger for logger in known if logger.name.split(".")[0] == "distributed" and not logger.disabled]
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    finally:
        for logger in loggers:
            logger.disabled = False


_prepared: dict[str, TrialRunner] = {}  # of the last job of which this process got a task


def _run_on_worker(job: Job, shard: Shard) -> bytes:
    """Run a shard in a worker, one at a time. Tasks of dask share nothing else, so that the runner is kept here."""
    from distributed import get_worker

    with _one_at_a_time:
        worker = get_worker()
        worker.log_event(job.name, [worker.address, [shard.cell_number, shard.first, shard.count]])
        if job.name not in _prepared:
            _prepared.clear()
            _prepared[job.name] = job.prepare()
        return job.work(shard, _prepared[job.name])
