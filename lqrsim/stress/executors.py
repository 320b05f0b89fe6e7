"""Worker processes on this machine for a campaign. They may die or hang; the campaign continues.

Weighed against libraries:

- `ProcessPoolExecutor`: when one process is killed, all unfinished tasks are lost, without a hint which one was at
  fault. A task that hangs cannot be stopped before Python 3.14.
- pebble 5.2 has time limits and names the task of a killed worker. But its workers share one pipe and its lock: a
  worker that is killed while it sends a result keeps the lock, and after two minutes all other tasks are lost, too.
  A worker that dies before it has read its arguments leaves the pool waiting for ever if they are larger than a pipe.
- A `LocalCluster` of dask repeats the work of dead workers, but it has no time limits either, does not say by which
  signal a worker ended, takes seconds to start, and is an extra to install. cluster.py uses dask for many machines.

Here each worker has a pipe of its own.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Generator, Iterable, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait

from lqrsim import process
from lqrsim.errors import InputError
from lqrsim.stress.specification import Shard
from lqrsim.stress.trials import Job, Trials

FinishedShards = Generator[tuple[Shard, bytes]]

ATTEMPTS = 3  # to run a shard, and to start a process
_START_TIMEOUT = 300.0  # s
_ONE_THREAD = ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMBA")
_context = multiprocessing.get_context("spawn")  # forking a process that has threads is not safe
_NAME = "lqrsim worker"
_RUNS_THE_SCRIPT = 79  # exit code of a worker whose import of the caller's script starts the campaign again
_GUARD = 'run_campaign() called under `if __name__ == "__main__":`, or workers=0'
_serving = False  # whether this process is a worker that has imported the caller's script


def run_here(job: Job, shards: Iterable[Shard], trials: Trials) -> FinishedShards:
    """Run the shards in this process; yield each with its file. If the process dies, the campaign must be resumed."""
    for shard in shards:
        yield shard, job.work(shard, trials)


def run_in_processes(job: Job, shards: list[Shard], workers: int, time_limit: float) -> FinishedShards:
    """Run the shards in worker processes; yield each with its file as it is finished.

    If a process dies, another one runs its shard again. The trials of a shard count as failed if its process dies three
    times, or if it exceeds the time limit.

    Raises:
      InputError: processes cannot be started.
    """
    queue, attempts, failed_starts = deque(shards), Counter[Shard](), 0
    busy: list[_Worker] = []
    idle: list[_Worker] = []
    try:
        while queue or busy:
            while queue and len(busy) < workers:
                worker = idle.pop() if idle else _Worker(job)
                worker.take(queue.popleft(), time_limit)
                busy.append(worker)
            nearest = min(worker.deadline for worker in busy)
            wait([worker.connection for worker in busy], max(0.0, nearest - time.monotonic()))
            for worker in list(busy):
                shard, answer = worker.shard, worker.answer(time_limit)
                if answer is None:
                    continue
                busy.remove(worker)
                if isinstance(answer, bytes):
                    idle.append(worker)
                    yield shard, answer
                    continue
                worker.end()
                attempts[shard] += worker.ready
                if worker.process.exitcode == _RUNS_THE_SCRIPT:
                    raise InputError(f"workers: got a script that each worker runs as it starts, want {_GUARD}")
                failed_starts = 0 if worker.ready else failed_starts + 1
                if failed_starts == ATTEMPTS:
                    raise InputError(f"workers: got processes that do not start ({answer}), want {_GUARD}")
                if worker.late or attempts[shard] == ATTEMPTS:
                    yield shard, job.failed(shard, answer)
                else:
                    queue.appendleft(shard)
    finally:
        for worker in [*idle, *busy]:
            worker.end()


def end_if_started_by_import() -> None:
    """End this process if it is a worker, and its import of the caller's script has started the campaign again.

    Python would refuse to start processes there only after everything that the script does before, and with a page of
    text from each worker. The driver recognises the exit code.
    """
    if multiprocessing.current_process().name == _NAME and not _serving:
        sys.exit(_RUNS_THE_SCRIPT)


class _Worker:
    """A worker process and the shard that it runs.

    It sends `STARTED` once it has imported the caller's script, then receives the job and the shard, and sends `READY`
    when it can begin. The job is not an argument of the process: Python writes arguments to a pipe whose other end it
    keeps open, and if the process dies before it reads them, the writer waits for ever, deaf to Ctrl-C.
    """

    STARTED, READY = "started", "ready"

    def __init__(self, job: Job) -> None:
        self.job = job
        self.connection, theirs = _context.Pipe()
        self.process = _context.Process(target=_serve, args=(theirs,), name=_NAME, daemon=True)
        with process.uninterrupted(), _worker_environment(), _without_ctrl_c():
            self.process.start()
        theirs.close()  # so that the end of the process closes the pipe
        self.ready = self.late = False
        self.deadline = time.monotonic() + _START_TIMEOUT

    def take(self, shard: Shard, time_limit: float) -> None:
        """Assign a shard."""
        self.shard = shard
        if self.ready:
            self.deadline = time.monotonic() + time_limit
            with contextlib.suppress(OSError):  # if it has died, `answer` says so
                self.connection.send(shard)

    def answer(self, time_limit: float) -> bytes | str | None:
        """The shard's file; or the reason why there will be none; or None while the shard is being run."""
        try:
            while self.connection.poll():
                message = self.connection.recv()
                if message == self.STARTED:
                    self.connection.send(self.job)
                    self.connection.send(self.shard)
                elif message == self.READY:
                    self.ready = True
                    self.deadline = time.monotonic() + time_limit  # counts from now on
                else:
                    return message
        except (EOFError, OSError):
            self.process.join(5.0)
            return f"its worker ended {ATTEMPTS} times, at last with {_exit(self.process.exitcode)}"
        if time.monotonic() < self.deadline:
            return None
        self.late = self.ready
        return f"took longer than {time_limit if self.ready else _START_TIMEOUT:g} s, and was stopped"

    def end(self) -> None:
        """Stop the process, also in the middle of a task."""
        self.connection.close()
        self.process.kill()
        self.process.join()


def _serve(connection: Connection) -> None:
    """The main function of a worker."""
    global _serving
    _serving = True
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to all processes; the driver handles it
    try:
        connection.send(_Worker.STARTED)
        job: Job = connection.recv()
    except (EOFError, OSError):  # the driver has ended
        return
    job.prepare()
    with contextlib.suppress(EOFError, OSError):
        connection.send(_Worker.READY)
        while True:
            connection.send(job.work(connection.recv()))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _exit(code: int | None) -> str:
    if code is not None and code < 0:
        return f"signal {-code} ({signal.strsignal(-code)})"
    return f"exit code {code}"


@contextlib.contextmanager
def _worker_environment() -> Iterator[None]:
    """Processes started in this block use one thread each, and the GLFW library that this process has loaded.

    Without the latter, importing MuJoCo starts a process that looks for GLFW. It would outlive a worker that is stopped
    meanwhile, and complain that nobody reads its result.
    """
    ours = dict.fromkeys([f"{name}_NUM_THREADS" for name in _ONE_THREAD], "1")
    glfw = getattr(sys.modules.get("glfw.library"), "glfw", None)
    if glfw is not None and sys.platform != "win32":  # it starts none there
        ours["PYGLFW_LIBRARY"] = glfw._name
    before = {name: os.environ.get(name) for name in ours}
    os.environ.update(ours)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


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
