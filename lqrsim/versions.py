"""The versions that a result depends on; every saved result carries them."""

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version


@cache
def versions() -> dict[str, str]:
    """Name -> version of lqrsim, of the libraries that its numbers depend on, and of Python."""
    found = {"python": platform.python_version()}
    for name in ("lqrsim", "numpy", "numba", "mujoco"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
