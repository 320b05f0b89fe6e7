"""Every public callable of lqrsim with arguments that it accepts, small and cheap, for `api.py` to spoil.

`public()` finds them by introspection: what `lqrsim.__all__` and `lqrsim.gym.__all__` list, the functions of its
modules, the public methods of its classes that take arguments. `subjects()` has arguments for each; a test fails where
one has none.
"""

import enum
import inspect
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import lqrsim as ls
from lqrsim import gym
from robustness.of_gym import environments
from robustness.of_policies import policies
from robustness.of_problems import problems, results, solving
from robustness.of_runs import campaigns, pictures, running
from robustness.place import Place

# Called by lqrsim itself, with what it has checked: what one overrides to add a cost, a disturbance or a controller.
HOOKS = {"bind", "start", "check", "describe", "blow", "fitting", "actuation", "multiply", "parts", "draw", "limits"}
HOOKS |= {"displace", "world_seen", "filling", "record_of_balls", "uncertainty", "spread", "KeepsClear.in_world"}
HOOKS |= {
    "solving",
    "softened",
    "touches",
    "grazed",
    "untouched_body",
    "approaches",
    "contact_modes",
    "check_period",
    "ControllerRun.control",
    "effect",
}
HOOKS |= {f"{kind}.{name}" for kind in ("Simulator", "RotorPy", "Crazyflow") for name in ("step", "states", "place")}
HOOKS |= {"with_added_state", "off_place", "Cost.scaled", "moved_to", "final_states", "state_bounds", "of_residual"}
HOOKS |= {"Crazyflow.quadrotor"}  # takes crazyflow
HOOKS |= {"TrialScore.failure"}  # a field, whose default is a function
HOOKS |= {"settled"}  # an earlier name


@dataclass(frozen=True)
class Subject:
    """A callable and arguments that it accepts.

    Attributes:
      weight: how often it is called beside the others, 1 being often: what takes longer is called less.
    """

    call: Callable[..., Any]
    arguments: Mapping[str, Any]
    weight: float = 1.0


def public() -> Iterator[tuple[str, Any]]:
    """Each public callable by its name: `smooth`, `Problem`, `AffinePolicy.control`, `rotations.rotate`."""
    offered = {name: getattr(ls, name) for name in ls.__all__}
    for room in (ls.belief, ls.disturbances, ls.lq, ls.simulators, ls.stress, ls.types, ls.view):
        del offered[room.__name__.removeprefix("lqrsim.")]
        offered |= {name: getattr(room, name) for name in room.__all__}
    offered |= {f"gym.{name}": getattr(gym, name) for name in gym.__all__}
    for name, item in offered.items():
        if isinstance(item, ModuleType):
            for key in getattr(item, "__all__", vars(item)):
                one = getattr(item, key)
                if inspect.isfunction(one) and one.__module__.startswith(item.__name__) and key[0] != "_":
                    yield f"{name}.{key}", one
        elif not callable(item):  # a table
            continue
        elif not inspect.isclass(item):
            yield name, item
        elif not issubclass(item, Exception | enum.Enum):
            if not inspect.isabstract(item) and inspect.signature(item).parameters:
                yield name, item
            for key, method in inspect.getmembers(item, callable):
                if method_of_users(item, key) and len(inspect.signature(method).parameters) > _own(item, key):
                    yield f"{name}.{key}", method


def method_of_users(item: type, key: str) -> bool:
    """Whether it is a method that a user calls."""
    if key[0] == "_" and key not in ("__call__", "__add__"):
        return False
    home = next(kind for kind in item.__mro__ if key in vars(kind))
    hook = key in HOOKS or f"{home.__name__}.{key}" in HOOKS
    return home.__module__.startswith("lqrsim.") and not hook and not inspect.isclass(getattr(item, key))


def _own(item: type, key: str) -> int:
    """How many parameters of a method are not the caller's: self, unless it is a class method."""
    return 0 if isinstance(inspect.getattr_static(item, key), classmethod | staticmethod) else 1


def _offered(name: str) -> Any:
    """A public name, in whichever room it is."""
    rooms = (ls.belief, ls.disturbances, ls.lq, ls.simulators, ls.stress, ls.types, ls.view)
    return getattr(next((room for room in rooms if name in room.__all__), ls), name)


def subjects(folder: Path) -> dict[str, Subject]:
    """Arguments for every public callable; some of them are solved for and run, and files of them written."""
    logging.getLogger("lqrsim").setLevel(logging.ERROR)
    place = Place(folder)
    found: dict[str, Subject] = {}
    for make in (problems, solving, results, policies, running, campaigns, pictures, environments):
        for name, (arguments, *weight) in make(place).items():
            owner, _, method = name.partition(".")
            if "call" in arguments:
                call = arguments.pop("call")
            elif method and not isinstance(_offered(owner), ModuleType):
                call = getattr(arguments.pop("self", _offered(owner)), method)
            else:
                call = getattr(_offered(owner), method) if method else _offered(owner)
            found[name] = Subject(call, arguments, *weight)
    return found
