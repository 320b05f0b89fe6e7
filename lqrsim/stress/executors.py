"""Worker processes for a campaign, on this machine or a dask cluster. If they die or hang, the campaign continues.

On this machine each worker has its own pipe. On a cluster dask starts workers, distributes tasks, and repeats the tasks
of dead workers, up to its `allowed-failures`. Tables come back as bytes, so no folder needs to be shared. This module
adds four things: a time limit that counts from the moment when a worker begins a task; restarts of workers that hang,
because `cancel()` does not stop a running task; one task at a time per worker; and at most two queued tasks per worker,
so that the scheduler never holds a whole campaign. CONTRIBUTING.md explains why no library does all of this.
"""

import asyncio
import contextlib
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
from dataclasses import dataclass, field, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np

from lqrsim import process
from lqrsim.errors import InputError, format_error
from lqrsim.machine import versions
from lqrsim.results.solution import Solution
from lqrsim.scenarios.references import resolve
from lqrsim.simulation.closed_loop import simulate
from lqrsim.stress.analysis import COLUMNS, outcomes
from lqrsim.stress.policies import POLICY_KINDS, make_controller
from lqrsim.stress.results import Columns, pack
from lqrsim.stress.study import Campaign, Cell, Shard, Trials

FinishedShards = Generator[tuple[Shard, bytes]]
_POLL = 0.5  # s between two checks of the time limit
RESUME = "run the same command again to resume"
_lock = threading.Lock()  # a process has one set of workspaces

ATTEMPTS = 3  # number of attempts to run a shard, or to start a process
_START_TIMEOUT = 300.0  # s
_ONE_THREAD = ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMBA")
_context = multiprocessing.get_context("spawn")  # forking a process that has threads is not safe
_NAME = "lqrsim worker"
_RUNS_THE_SCRIPT = 79  # exit code of a worker that, by importing the caller's script, would start the campaign again
_GUARD = 'run_campaign() called under `if __name__ == "__main__":`, or workers=0'
_starting = threading.Lock()  # the environment is that of all threads
_serving = False  # whether this process is a worker that has imported the caller's script


@dataclass(frozen=True, eq=False)
class Job:
    """Everything that a worker needs for a campaign."""

    campaign: Mapping[str, Any]  # as in its manifest
    digest: str  # of the manifest
    solutions: Mapping[str, Solution]  # by policy
    batch: int
    # An identifier that differs in every run, even of the same campaign.
    run: str = field(default_factory=lambda: f"lqrsim-{uuid.uuid4().hex}")

    @classmethod
    def of(cls, trials: Trials, manifest: Mapping[str, Any], batch: int) -> "Job":
        """The job of running these trials elsewhere. Its solutions lack the logs of their solves."""
        unused: dict[str, Any] = {"inverse_policy": None, "cost_to_come": None, "iterations": (), "candidates": ()}
        solutions = {policy: replace(solution, **unused) for policy, solution in trials.solutions.items()}
        return cls(manifest["campaign"], manifest["digest"], solutions, batch)

    def prepare(self) -> Trials:
        """The trials of this job, kept in this process until there is another job."""
        if self.run not in _prepared:
            _prepared.clear()
            campaign = Campaign.from_json(self.campaign, resolve(self.campaign["scenario"]))
            trials = Trials(campaign, self.solutions)
            warm_up(trials)
            _prepared[self.run] = trials
        return _prepared[self.run]

    def work(self, shard: Shard, trials: Trials | None = None) -> bytes:
        """Run a shard in this process, with these trials if given. Returns its file.

        It is simulated in batches. If a batch fails, its trials are run again one by one.
        """
        trials = trials or self.prepare()
        cell, last = trials.campaign.cells[shard.cell_number], shard.first + shard.count
        parts: list[Columns] = []
        for first in range(shard.first, last, self.batch):
            count = min(self.batch, last - first)
            rows = _rows(trials, cell, first, count)
            alone = count > 1 and bool((rows["outcome"] == "error").any())
            parts += [_rows(trials, cell, trial, 1) for trial in range(first, first + count)] if alone else [rows]
        return pack({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, shard, self.digest)

    def failed(self, shard: Shard, reason: str) -> bytes:
        """The file of a shard that could not be run: each of its trials is an error with this reason."""
        return pack(_failed_rows(shard.first, shard.count, reason), shard, self.digest)


_prepared: dict[str, Trials] = {}  # trials of the last job that this process worked for


def warm_up(trials: Trials) -> None:
    """Compile everything, by running undisturbed trials."""
    options: dict[str, Any] = {"frames": False, "contacts": False, "threads": 1}
    first = next(iter(trials.solutions.values()))
    law = make_controller("feedback", trials.scenario, first)
    outcomes(simulate(trials.plant, first, controller=law, **options), trials.scenario.problem)
    filters = [cell for cell in trials.campaign.cells if POLICY_KINDS[cell.policy].controller == "offset_free"]
    for cell in filters[:1]:  # its filter is also compiled
        simulate(trials.plant, trials.solutions[cell.policy], controller=trials.controller(cell), **options)


def _rows(trials: Trials, cell: Cell, first: int, count: int) -> Columns:
    try:
        rollout = trials.run(cell, first, count, frames=False, contacts=False)
        table = outcomes(rollout, trials.scenario.problem).columns()
    except Exception as error:  # a disturbance or a scenario may raise anything; it counts as failed trials
        return _failed_rows(first, count, format_error(error))
    reasons = np.array(rollout.reasons, dtype=np.str_)
    return table | {"reason": np.where(np.isin(table["outcome"], ("diverged", "error")), reasons, "")}


def _failed_rows(first: int, count: int, reason: str) -> Columns:
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
                worker = _Worker(job, waiting.popleft(), time_limit)
                busy[worker.connection] = worker
            wait(busy, max(min(worker.deadline for worker in busy.values()) - time.monotonic(), 0.0))
            for worker in [*busy.values()]:
                task = worker.task
                try:
                    file = worker.receive()
                except (EOFError, OSError) as error:
                    file = task.failed(worker, error)
                    del busy[worker.connection]
                    worker.end()
                    if file is None:
                        waiting.appendleft(task)
                else:
                    if file is not None and waiting:
                        worker.begin(waiting.popleft())
                    elif file is not None:
                        del busy[worker.connection]
                        worker.end()
                if file is not None:
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

    def failed(self, worker: "_Worker", error: Exception) -> bytes | None:
        """The file of a shard that has failed too often, or None. Raises InputError if no worker starts."""
        if late := isinstance(error, TimeoutError):
            reason = f"took longer than {worker.time_limit if worker.ready else _START_TIMEOUT:g} s, and was stopped"
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
        if self.died == ATTEMPTS or (late and worker.ready):
            return worker.job.failed(self.shard, reason)
        return None


def end_if_started_by_import() -> None:
    """End this process if it is a worker, and its import of the caller's script has started the campaign again.

    Python would refuse to start processes there, but only after all earlier work of the script, and with a page of text
    from each worker. The driver recognises the exit code.
    """
    if multiprocessing.current_process().name == _NAME and not _serving:
        sys.exit(_RUNS_THE_SCRIPT)


class _Worker:
    """A worker process, which runs one shard after the other.

    It says that it has imported the caller's script, then receives the job, says that it can begin, and receives
    shards. The job is not an argument of the process: Python writes arguments to a pipe whose other end it keeps open,
    and if the process dies before it reads them, the writer waits forever.
    """

    def __init__(self, job: Job, task: _Task, time_limit: float) -> None:
        self.job, self.task, self.time_limit = job, task, time_limit  # s
        self.ready, self.deadline = False, time.monotonic() + _START_TIMEOUT
        self.connection, theirs = _context.Pipe()
        self.process = _context.Process(target=_serve, args=(theirs,), name=_NAME, daemon=True)
        with _starting, _worker_environment(), _without_ctrl_c():
            self.process.start()
        theirs.close()  # then the end of the process closes the pipe

    def receive(self) -> bytes | None:
        """The file of its shard, or None before. Raises EOFError or OSError if the process has died; TimeoutError."""
        if not self.connection.poll():
            if time.monotonic() > self.deadline:
                raise TimeoutError
            return None
        message = self.connection.recv()
        if self.ready:
            return message
        if message == "started":
            self.deadline = time.monotonic() + _START_TIMEOUT
            self.connection.send(self.job)
        else:
            self.ready = True
            self.begin(self.task)
        return None

    def begin(self, task: _Task) -> None:
        self.task, self.deadline = task, time.monotonic() + self.time_limit
        with contextlib.suppress(OSError):  # if the process has died, the next to receive from it sees that
            self.connection.send(task.shard)

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
    job.prepare()
    with contextlib.suppress(EOFError, OSError):
        connection.send("ready")
        while True:
            connection.send(job.work(connection.recv()))


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
    started: dict[Shard, tuple[str, float]] = {}  # the worker that began a shard, and the time
    client.subscribe_topic(
        job.run, lambda event: started.update({Shard(*event[1][1]): (event[1][0], time.monotonic())})
    )
    try:
        while True:
            # One running and one waiting for each worker.
            free_slots = 2 * max(1, sum(client.nthreads().values())) - len(submitted)
            for shard in itertools.islice(waiting, max(0, free_slots)):
                submitted[client.submit(_task, job, shard, key=f"{job.run}-{shard.file}")] = shard
            if not submitted:
                return
            with contextlib.suppress(TimeoutError), client.as_current():
                distributed.wait(list(submitted), timeout=_POLL, return_when="FIRST_COMPLETED")
            for future, shard in list(submitted.items()):
                if future.done():
                    del submitted[future]
                    if future.status in ("cancelled", "lost"):
                        raise CancelledError
                    failed = future.status != "finished"
                    yield shard, job.failed(shard, format_error(future.exception())) if failed else future.result()
                elif time.monotonic() - started.get(shard, ("", time.monotonic()))[1] > time_limit:
                    del submitted[future]
                    future.cancel()
                    # A thread that hangs cannot be stopped otherwise; the worker may have ended, or have no nanny.
                    with contextlib.suppress(Exception):
                        client.restart_workers([started[shard][0]], timeout=30, raise_for_error=False)
                    yield shard, job.failed(shard, f"took longer than {time_limit:g} s, and was stopped")
    except (CancelledError, asyncio.CancelledError):
        raise InputError(f"scheduler: got a scheduler that lost its tasks or was restarted, {RESUME}") from None
    except OSError as error:  # dask's connection errors are also OSErrors
        raise InputError(f"scheduler: got no answer ({error}), {RESUME}") from None
    finally:
        with contextlib.suppress(Exception):  # the scheduler may have ended
            client.unsubscribe_topic(job.run)
            client.cancel(list(submitted))


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """In this block dask prints no tracebacks; errors that matter are raised."""
    known = [logger for logger in logging.Logger.manager.loggerDict.values() if isinstance(logger, logging.Logger)]
    loggers = [logger for logger in known if logger.name.split(".")[0] == "distributed"]
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    finally:
        for logger in loggers:
            logger.disabled = False


def _task(job: Job, shard: Shard) -> bytes:
    """Run a shard in a worker, one at a time."""
    from distributed import get_worker

    with _lock:
        worker = get_worker()
        worker.log_event(job.run, [worker.address, [shard.cell_number, shard.first, shard.count]])
        return job.work(shard)
