"""Processes of this machine that do a campaign's work, watched over: they may die, or hang, and the work goes on.

What there is does not do that. A `ProcessPoolExecutor` of which one process is killed gives up every task that is not
done, and does not tell which one was at fault; a task that hangs cannot be cancelled, and before Python 3.14 no process
of it can be ended without reaching into private fields. A `LocalCluster` of dask does the work of dead workers again,
but its tasks have no time limit either and go on after `cancel()`; it does not say by which signal a worker ended,
takes seconds to start and is an extra to install. For clusters of machines see cluster.py.
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
from lqrsim.stress.trials import Job, Trials, failed_work, prepare, work

FinishedShards = Generator[tuple[Shard, bytes]]

ATTEMPTS = 3  # of a shard, and to start a process
_START_TIMEOUT = 300.0  # s; a process that is not ready by then never will be
_ONE_THREAD = ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMBA")
_context = multiprocessing.get_context("spawn")  # forking a process that has threads is not safe
_NAME = "lqrsim worker"
_RUNS_THE_SCRIPT = 79  # exit code of a worker that would start the campaign once more
_GUARD = 'run_campaign() called under `if __name__ == "__main__":`, or workers=0'
_serving = False  # whether this process is a worker that has imported the caller's script


def run_here(job: Job, shards: Iterable[Shard], trials: Trials) -> FinishedShards:
    """This process does the work; what ends it ends the campaign, until it is resumed."""
    for shard in shards:
        yield shard, work(job, shard, trials)


def run_in_processes(job: Job, shards: list[Shard], workers: int, time_limit: float) -> FinishedShards:
    """Processes do the work; the files of shards as they come.

    A process that dies is replaced, and its shard done again; a shard on which it dies thrice, or that takes longer
    than the time limit, is one of failed trials.

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
                    yield shard, failed_work(job, shard, answer)
                else:
                    queue.appendleft(shard)
    finally:
        for worker in [*idle, *busy]:
            worker.end()


def end_if_started_by_import() -> None:
    """End this process if it is a worker that imports the caller's script, which starts the campaign unguarded.

    Python refuses only that such a process starts others, with a page of text from each, and after all that the script
    does before. The driver reads the exit code.
    """
    if multiprocessing.current_process().name == _NAME and not _serving:
        sys.exit(_RUNS_THE_SCRIPT)


class _Worker:
    """A process, and the shard that it has.

    It says `STARTED` when it has imported the caller's script, is then given the job and the shard, and says `READY`
    when it can begin. The job is not among the process's arguments: Python writes those to a pipe whose other end it
    keeps open meanwhile, and if the process dies before it reads them it waits for ever, deaf to Ctrl-C.
    """

    STARTED, READY = "started", "ready"

    def __init__(self, job: Job) -> None:
        self.job = job
        self.connection, theirs = _context.Pipe()
        self.process = _context.Process(target=_serve, args=(theirs,), name=_NAME, daemon=True)
        with process.uninterrupted(), _surroundings(), _without_ctrl_c():
            self.process.start()
        theirs.close()  # so that its death is an end of file here
        self.ready = self.late = False
        self.deadline = time.monotonic() + _START_TIMEOUT

    def take(self, shard: Shard, time_limit: float) -> None:
        """Give it work."""
        self.shard = shard
        if self.ready:
            self.deadline = time.monotonic() + time_limit
            with contextlib.suppress(OSError):  # it has died, which its answer will tell
                self.connection.send(shard)

    def answer(self, time_limit: float) -> bytes | str | None:
        """The shard's file; or why there will be none; or None where it is still being done."""
        try:
            while self.connection.poll():
                message = self.connection.recv()
                if message == self.STARTED:
                    self.connection.send(self.job)
                    self.connection.send(self.shard)
                elif message == self.READY:
                    self.ready = True  # its clock starts now
                    self.deadline = time.monotonic() + time_limit
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
        """Stop the process, whatever it does."""
        self.connection.close()
        self.process.kill()
        self.process.join()


def _serve(connection: Connection) -> None:
    """What a worker does."""
    global _serving
    _serving = True
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all of a terminal's processes; the driver decides
    try:
        connection.send(_Worker.STARTED)
        job = connection.recv()
    except (EOFError, OSError):  # the driver is gone
        return
    prepare(job)
    with contextlib.suppress(EOFError, OSError):
        connection.send(_Worker.READY)
        while True:
            connection.send(work(job, connection.recv()))


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
def _surroundings() -> Iterator[None]:
    """What is started in this block computes with one thread: there are as many processes as processors.

    And it takes the GLFW that this process has. To find one, GLFW's package starts a process of its own as MuJoCo is
    imported, which would outlive a worker that is stopped then, and complain that nobody reads what it has found.
    """
    ours = dict.fromkeys([f"{name}_NUM_THREADS" for name in _ONE_THREAD], "1")
    glfw = getattr(sys.modules.get("glfw.library"), "glfw", None)
    if glfw is not None and sys.platform != "win32":  # there it starts none
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
    """What is started in this block is not interrupted while it starts either."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # It is started with the first process, and takes SIGINT out of the mask in which that is then started.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
