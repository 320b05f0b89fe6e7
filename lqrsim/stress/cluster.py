"""A running dask cluster that does a campaign's work. Tables come back as bytes, so that no folder need be shared.

Dask itself starts workers, hands out the work, and does that of a dead worker again, up to its `allowed-failures`. What
is added is what it does not have: a time limit of a task that counts from when a worker begins it, and the end of one
that hangs, for `cancel()` leaves a task that runs running; one task at a time in a worker; and a window of two tasks a
worker, so that the scheduler does not hold a whole campaign.
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

from lqrsim.errors import InputError, told
from lqrsim.stress.executors import FinishedShards
from lqrsim.stress.specification import Shard
from lqrsim.stress.trials import Job, failed_work, work
from lqrsim.versions import versions

_POLL = 0.5  # s between two looks at what takes too long
RESUME = "run the same command again to resume"
_lock = threading.Lock()


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """A dask client. Raises InputError where there is no cluster with workers that can do the work to the bit."""
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
        except Exception as error:  # whatever a worker has
            raise InputError(f"scheduler: got {address}, whose workers do not run lqrsim ({error})") from None
        if not versions_there:
            raise InputError(f"scheduler: got {address}, which has no workers, want at least one")
        for worker, theirs in versions_there.items():
            if theirs != versions():
                other = ", ".join(
                    f"{name} {theirs.get(name)}" for name, own in versions().items() if theirs.get(name) != own
                )
                raise InputError(f"scheduler: got worker {worker} with {other}, want the versions that are here")
        yield client


def run_on_cluster(job: Job, shards: list[Shard], client: Any, time_limit: float) -> FinishedShards:
    """The files of shards as they come. Dask does the work of dead workers again, and gives it up if they die on it.

    Raises:
      InputError: the scheduler is gone.
    """
    from distributed import wait

    waiting = iter(shards)
    submitted: dict[Any, Shard] = {}
    started: dict[Shard, tuple[str, float]] = {}  # where and when; a worker counts from when it begins
    client.subscribe_topic(
        job.run, lambda event: started.update({Shard(*event[1][1]): (event[1][0], time.monotonic())})
    )
    try:
        while True:
            room = 2 * max(1, sum(client.nthreads().values())) - len(submitted)  # one to do, and one to do next
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
                    yield shard, failed_work(job, shard, f"took longer than {time_limit:g} s, and was stopped")
    except (CancelledError, asyncio.CancelledError):  # of what it was given
        raise InputError(f"scheduler: got it lost or restarted, want it to keep what it is given: {RESUME}") from None
    except OSError as error:  # also dask's own, of connections
        raise InputError(f"scheduler: got none any more ({error}), want it to answer: {RESUME}") from None
    finally:
        with contextlib.suppress(Exception):  # it may be gone
            client.unsubscribe_topic(job.run)
            client.cancel(list(submitted))


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Within this block dask does not write tracebacks to the screen; what matters of them is raised."""

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
    error = future.exception()
    return failed_work(job, shard, told(error))


def _restart_worker(client: Any, future: Any, worker: str) -> None:
    """End the worker, for nothing else ends a thread; its nanny starts another."""
    future.cancel()
    with contextlib.suppress(Exception):  # it may be gone, or have no nanny
        client.restart_workers([worker], timeout=30, raise_for_error=False)


def _task(job: Job, shard: Shard) -> bytes:
    """In a worker; one at a time, for a process has one set of workspaces."""
    from distributed import get_worker

    with _lock:
        worker = get_worker()
        worker.log_event(job.run, [worker.address, [shard.cell, shard.first, shard.count]])
        return work(job, shard)
