"""The robots. To add one, add a file here and its MJCF in models/. Every subclass of `Robot` in the file is found."""

import importlib
import inspect
import pkgutil
from functools import cache

from lqrsim.errors import check_name
from lqrsim.robots.base import Robot


@cache
def _registry() -> dict[str, type[Robot]]:
    modules = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    classes = [item for module in modules for item in vars(module).values() if inspect.isclass(item)]
    robots = [item for item in classes if issubclass(item, Robot) and not inspect.isabstract(item)]
    return {robot.name: robot for robot in robots if hasattr(robot, "name")}  # the others are made from a file


def names() -> list[str]:
    """The names of the robots, sorted."""
    return sorted(_registry())


def get(name: str) -> Robot:
    """The robot of that name, with its default constants."""
    return _registry()[check_name("robot", name, names())]()
