"""The machine: processors, memory, the instruction set that code is compiled for, and the versions installed.

Saved results hold the versions and the processor, on which their bits depend.
"""

import contextlib
import functools
import hashlib
import os
import platform
import re
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path


def processors() -> int:
    """Number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS and Windows
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def description() -> str:
    """Number and name of the processors, and the system, as text."""
    try:
        match = re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:  # not on macOS and Windows
        match = None
    processor = match[1].strip() if match else platform.processor() or platform.machine()
    return f"{processors()} x {processor}, {platform.system()}"


def memory() -> int:
    """Bytes of memory that this process may use: the machine's memory, or less under a limit."""
    limits = [_physical()]
    with contextlib.suppress(ImportError, OSError, ValueError):  # not on Windows
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            limits.append(max(limit - pages * resource.getpagesize(), 0))
    return min(limits)


@functools.cache
def _physical() -> int:
    """Memory of the machine or its container in bytes; 16 GiB on Windows, where it is not determined."""
    limits = [1 << 34]
    with contextlib.suppress(AttributeError, OSError, ValueError):
        limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for place in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError):  # "max" where there is no limit
            limits.append(int(Path(place).read_text(encoding="ascii")))
    return min(limits)


@functools.cache
def instruction_set() -> tuple[str, str, str]:
    """The target of compiled code: LLVM's triple, the name of the processor, and its features.

    `LQRSIM_CPU_NAME` and `LQRSIM_CPU_FEATURES` replace the last two: with "generic" and "", machines of one
    architecture run the same instructions. AVX-512 is left out, because LLVM's loops are slower with it;
    `python experiments/benchmark_compiling.py --sections features` compares them.
    """
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    name = os.environ.get("LQRSIM_CPU_NAME", "")
    features = os.environ.get("LQRSIM_CPU_FEATURES")
    if features is None:
        features = "" if name else llvm.get_host_cpu_features().flatten()
        if "+avx512f" in features.split(","):
            features += ",-avx512f"
    return llvm.get_process_triple(), name or llvm.get_host_cpu_name(), features


@functools.cache
def processor() -> str:
    """The processor that code is compiled for, and a hash of its features; see `instruction_set`.

    If it differs, the same program may give other bits: instructions round differently, and sums have another order.
    The hash includes the actual processor, on which NumPy and MuJoCo depend, and the target of LLVM.
    """
    import llvmlite.binding as llvm

    here = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    triple, name, features = instruction_set()
    return f"{name} {hashlib.sha256(repr((triple, name, features, *here)).encode()).hexdigest()[:8]}"


def versions() -> dict[str, str]:
    """Name -> version of lqrsim, of the libraries that its numbers depend on, and of Python; and the `processor`.

    If all are equal, the same program gives the same bits.
    """
    return dict(_versions())  # one for each result, which its owner may change


@functools.cache
def _versions() -> dict[str, str]:
    installed = versions_of("lqrsim", "numpy", "llvmlite", "mujoco")
    return {"python": platform.python_version()} | installed | {"processor": processor()}


def changed(was: Mapping[str, str]) -> str:
    """The versions that have changed, as `name new (was old)`; empty if none has changed."""
    now = versions()
    names = [name for name in now | dict(was) if now.get(name) != was.get(name)]
    return ", ".join(f"{name} {now.get(name)} (was {was.get(name)})" for name in names)


def other_lqrsim(was: Mapping[str, str]) -> str:
    """The version of lqrsim that made a result, as `lqrsim 0.2.1`, if it is not this one; else empty.

    The hashes of the same problem or robot may then differ.
    """
    made_by = was.get("lqrsim", "")
    return f"lqrsim {made_by}" if made_by and made_by != versions()["lqrsim"] else ""


@functools.cache
def outdated(extra: str = "") -> str:
    """A line on the packages that are older than lqrsim, or an extra of it, needs; else empty.

    Another package may have asked for them, or they were installed by themselves.
    """
    try:
        needs = requires("lqrsim") or []
    except PackageNotFoundError:  # a copy of the source that is not installed
        return ""
    condition = f"; extra == [\"']{extra}[\"']" if extra else ""
    bounds = [re.fullmatch(rf"([\w.-]+)>=([\d.]+){condition}", need) for need in needs]
    least = {bound[1]: bound[2] for bound in bounds if bound}
    older = {
        name: present for name, present in versions_of(*least).items()
        if present != "not installed" and _numbers(present) < _numbers(least[name])
    }  # fmt: skip
    got = ", ".join(f"{name} {present}" for name, present in older.items())
    wanted = " ".join(f"'{name}>={least[name]}'" for name in older)
    return f"got {got}, want newer: pip install {wanted}" if older else ""


def _numbers(version: str) -> tuple[int, ...]:
    leading = re.match(r"\d+(\.\d+)*", version)
    return tuple(int(part) for part in leading[0].split(".")) if leading else ()


def versions_of(*names: str) -> dict[str, str]:
    """Name -> version of installed distributions, or "not installed"."""
    installed = {}
    for name in names:
        try:
            installed[name] = version(name)
        except PackageNotFoundError:
            installed[name] = "not installed"
    return installed
