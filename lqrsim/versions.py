"""The versions and the processor that the bits of a result depend on; every saved result has them."""

import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from lqrsim.machine import processor


@cache
def versions() -> dict[str, str]:
    """Name -> version of lqrsim, of the libraries that its numbers depend on, and of Python; and the `processor`.

    If all are equal, the same program gives the same bits.
    """
    installed = versions_of("lqrsim", "numpy", "llvmlite", "mujoco")
    return {"python": platform.python_version()} | installed | {"processor": processor()}


def changed(was: Mapping[str, str]) -> str:
    """The versions that have changed, as `name new (was old)`; empty if none has."""
    now = versions()
    names = [*now, *(name for name in was if name not in now)]
    return ", ".join(
        f"{name} {now.get(name)} (was {was.get(name)})" for name in names if now.get(name) != was.get(name)
    )


def versions_of(*names: str) -> dict[str, str]:
    """Name -> version of installed distributions, or "not installed"."""
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
