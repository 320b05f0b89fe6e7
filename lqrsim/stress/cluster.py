"""Running a campaign on a dask cluster. Tables come back as bytes, so no folder needs to be shared.

Dask starts workers, distributes tasks, and repeats those of dead workers, up to its `allowed-failures`. Added here are:
a time limit that counts from the moment when a worker begins a task; restarting a worker that hangs, since `cancel()`
does not stop a running task; one task at a time per worker; and at most two queued tasks per worker, so that the
scheduler never holds a whole campaign.
"""

import asyncio
import contextlib
import itertools
import logging
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from typing import Any

from lqrsim.errors import InputError, format_error
from lqrsim.stress.executors import FinishedShards
from lqrsim.stress.specification import Shard
from lqrsim.stress.trials import Job
from lqrsim.versions import versions

_POLL = 0.5  # s between two checks of the time limit
RESUME = "run the same command again to resume"
_lock = threading.Lock()


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """Connect a dask client. Raises InputError if there is no cluster, or its workers have other versions."""
    try:
        import distributed
    except ImportError:
        raise InputError(
            "scheduler: got one without dask, want it installed: pip install 'lqrsim[distributed]'"
        ) from None
    try:
        client = distributed.Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"scheduler: got {address}, want a dask scheduler that answers ({error})") from None
    with _silenced(), contextlib.closing(client):
        try:
            versions_there: Any = client.run(versions)
        except Exception as error:  # a worker may raise anything
            raise InputError(f"scheduler: got {address}, whose workers do not run lqrsim ({error})") from None
        if not versions_there:
            raise InputError(f"scheduler: got {address}, which has no workers, want at least one")
        for worker, theirs in versions_there.items():
            if theirs != versions():
                other = ", ".join(
                    f"{name} {theirs.get(name)}" for name, own in versions().items() if theirs.get(name) != own
                )
                raise InputError(f"scheduler: got worker {worker} with {other}, want the versions of this machine")
        yield client


def run_on_cluster(job: Job, shards: list[Shard], client: Any, time_limit: float) -> FinishedShards:
    """Run the shards on the cluster; yield each with its file. Raises InputError if the scheduler is lost."""
    from distributed import wait

    waiting = iter(shards)
    submitted: dict[Any, Shard] = {}
    started: dict[Shard, tuple[str, float]] = {}  # where and when a worker began it
    client.subscribe_topic(
        job.run, lambda event: started.update({Shard(*event[1][1]): (event[1][0], time.monotonic())})
    )
    try:
        while True:
            room = 2 * max(1, sum(client.nthreads().values())) - len(submitted)  # one running and one waiting each
            for shard in itertools.islice(waiting, max(0, room)):
                submitted[client.submit(_task, job, shard, key=f"{job.run}-{shard.file}")] = shard
            if not submitted:
                return
            with contextlib.suppress(TimeoutError), client.as_current():
                wait(list(submitted), timeout=_POLL, return_when="FIRST_COMPLETED")
            for future, shard in list(submitted.items()):
                if future.done():
                    del submitted[future]
                    yield shard, _contents(job, shard, future)
                elif time.monotonic() - started.get(shard, ("", time.monotonic()))[1] > time_limit:
                    del submitted[future]
                    _restart_worker(client, future, started[shard][0])
                    yield shard, job.failed(shard, f"took longer than {time_limit:g} s, and was stopped")
    except (CancelledError, asyncio.CancelledError):
        raise InputError(f"scheduler: got one that lost its tasks or was restarted, {RESUME}") from None
    except OSError as error:  # dask's connection errors are OSErrors, too
        raise InputError(f"scheduler: got no answer any more ({error}), {RESUME}") from None
    finally:
        with contextlib.suppress(Exception):  # the scheduler may have ended
            client.unsubscribe_topic(job.run)
            client.cancel(list(submitted))


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """In this block dask prints no tracebacks; errors that matter are raised."""

    def silent(record: logging.LogRecord) -> bool:
        return False

    known = [one for one in logging.Logger.manager.loggerDict.values() if isinstance(one, logging.Logger)]
    loggers = [one for one in known if one.name.split(".")[0] == "distributed"]
    for logger in loggers:
        logger.addFilter(silent)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeFilter(silent)


def _contents(job: Job, shard: Shard, future: Any) -> bytes:
    if future.status == "finished":
        return future.result()
    if future.status in ("cancelled", "lost"):
        raise CancelledError
    return job.failed(shard, format_error(future.exception()))


def _restart_worker(client: Any, future: Any, worker: str) -> None:
    """Restart a worker by its nanny: a thread that hangs cannot be stopped otherwise."""
    future.cancel()
    with contextlib.suppress(Exception):  # it may have ended, or have no nanny
        client.restart_workers([worker], timeout=30, raise_for_error=False)


def _task(job: Job, shard: Shard) -> bytes:
    """Run a shard in a worker; one at a time, because a process has one set of workspaces."""
    from distributed import get_worker

    with _lock:
        worker = get_worker()
        worker.log_event(job.run, [worker.address, [shard.cell, shard.first, shard.count]])
        return job.work(shard)
