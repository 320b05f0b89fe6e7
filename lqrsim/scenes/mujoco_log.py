"""MuJoCo: what is wrong if it cannot be imported, and what it logs by itself, switched off."""

import contextlib
import threading
from collections.abc import Iterator

from lqrsim.errors import check_opengl

try:
    import mujoco
except Exception as error:
    check_opengl(error)
    raise

_quiet, _count, _before = threading.Lock(), 0, None


@contextlib.contextmanager
def unlogged() -> Iterator[None]:
    """MuJoCo writes neither to MUJOCO_LOG.TXT nor to the console: its warnings are reported or recorded otherwise.

    Several threads may be in this context. The last to leave restores the state before the first.
    """
    global _count, _before
    with _quiet:
        if _count == 0:
            _before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
            quiet.logto_file = quiet.logto_console = False
            quiet.set()
        _count += 1
    try:
        yield
    finally:
        with _quiet:
            _count -= 1
            if _count == 0 and _before is not None:
                _before.set()
