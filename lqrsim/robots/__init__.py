"""The robots: `packaged.py` has those of the package, `mjcf.py` makes one from any MJCF."""

import inspect
from functools import cache

from lqrsim.errors import check_name
from lqrsim.robots.base import Robot


@cache
def _registry() -> dict[str, type[Robot]]:
    from lqrsim.robots import packaged

    classes = [item for item in vars(packaged).values() if inspect.isclass(item)]
    return {item.name: item for item in classes if issubclass(item, Robot) and item is not Robot}


def names() -> list[str]:
    """The names of the robots, sorted."""
    return sorted(_registry())


def get(name: str) -> Robot:
    """The robot of that name, with its default constants."""
    return _registry()[check_name("robot", name, names())]()
