"""A lock for the one process that writes a folder. The system releases it when the process dies, however it dies.

The package filelock 4.2 passes the same tests with the same system calls, but it would replace only the two functions
at the end of this file. On a file system without locks its `FileLock` falls back to a file whose existence is the lock,
which a killed process leaves behind; here such file systems are refused.
"""

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from lqrsim.errors import InputError

_HELD = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}  # another process has the lock; EDEADLK on Windows


@contextlib.contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Make the folder if it does not exist, and lock it during the block.

    Raises:
      InputError: another process has locked it, or the folder cannot be written or locked.
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
        with contextlib.suppress(OSError):  # for people who look who has the lock
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"{os.getpid()}\n".encode(), 0) if hasattr(os, "pwrite") else None
        yield
    finally:
        os.close(handle)


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int) -> None:
        os.lseek(handle, 1 << 20, os.SEEK_SET)  # a byte that nobody reads: locked bytes cannot be read

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
