"""The machine that this runs on: how many processors there are to use, and what to say of it beside times."""

import os
import platform
import re
from pathlib import Path


def processors() -> int:
    """How many processors this process may run on."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS and Windows
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def description() -> str:
    """The processor, how many of it this process may use, and the system, in words."""
    try:
        found = re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:  # there is none on macOS and Windows
        found = None
    processor = found[1].strip() if found else platform.processor() or platform.machine()
    return f"{processors()} x {processor}, {platform.system()}"
