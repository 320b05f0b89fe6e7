"""The versions and the processor that the bits of a result depend on; they are in every saved result."""

import platform
import re
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version

from lqrsim.machine import processor


def versions() -> dict[str, str]:
    """Name -> version of lqrsim, of the libraries that its numbers depend on, and of Python; and the `processor`.

    If all are equal, the same program gives the same bits.
    """
    return dict(_versions())  # one for each result, which its owner may change


@cache
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


@cache
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
    """The numbers with which a version begins."""
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
