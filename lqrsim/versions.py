"""The versions that a result depends on; every saved result carries them."""

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version


@cache
def versions() -> dict[str, str]:
    """Name -> version of lqrsim, of the libraries that its numbers depend on, and of Python."""
    return {"python": platform.python_version()} | versions_of("lqrsim", "numpy", "numba", "mujoco")


def versions_of(*names: str) -> dict[str, str]:
    """Name -> version of installed distributions, or "not installed"."""
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
