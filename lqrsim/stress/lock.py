"""One writer of a folder at a time. The system takes the lock from a process that dies, however it dies.

The package filelock was weighed, 4.2: it passes the same tests with the same system calls. What it would save are the
two functions at the end of this file; the folder, the messages and the number of the process remain, and a dependency
comes in. Where a file system has no such locks, its `FileLock` by default falls back to a file whose existence is the
lock, which a process that is killed leaves behind: here that is refused.
"""

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from lqrsim.errors import InputError

_HELD = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}  # of a lock that another process has; EDEADLK on Windows


@contextlib.contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Makes the folder if need be, and is its only writer as long as the block lasts.

    Raises:
      InputError: another process is, or the folder cannot be written, or locked.
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
            if error.errno in _HELD:
                raise InputError(
                    f"folder: got {folder}, which another process writes (see {path.name}), want one at a time"
                ) from None
            reason = error.strerror or error
            raise InputError(f"folder: got {folder}, want one whose files can be locked ({reason})") from None
        with contextlib.suppress(OSError):  # of use to people only
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"{os.getpid()}\n".encode(), 0) if hasattr(os, "pwrite") else None
        yield
    finally:
        os.close(handle)


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int) -> None:
        os.lseek(handle, 1 << 20, os.SEEK_SET)  # a byte that nobody reads, for locked ones cannot be read
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
