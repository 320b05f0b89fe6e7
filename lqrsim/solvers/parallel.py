"""Threads, and their number."""

import contextlib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

from lqrsim.codegen.user_functions import UserFunction
from lqrsim.errors import check_count
from lqrsim.machine import processors

MOST_THREADS = 1024


@contextlib.contextmanager
def workers(threads: int, functions: Iterable[UserFunction]) -> Iterator[ThreadPoolExecutor]:
    """A pool of threads. After an error or Ctrl-C plain Python functions are told to stop; compiled code ends soon."""
    with ThreadPoolExecutor(threads, thread_name_prefix="lqrsim") as pool:
        try:
            yield pool
        except BaseException:
            for function in functions:
                function.stopped.set()
            pool.shutdown(wait=True, cancel_futures=True)
            for function in functions:
                function.stopped.clear()
            raise


def check_threads(threads: int | None) -> int:
    """Check a number of threads; by default the number of processors. Raises InputError."""
    return processors() if threads is None else check_count("threads", threads, at_most=MOST_THREADS)
