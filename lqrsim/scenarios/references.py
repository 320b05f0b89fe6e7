"""Scenarios and sets of disturbances from a user's input.

A scenario is the name of a registered scenario, a user's function, or an MJCF, with settings:

  quadrotor                     a name that `lqrsim list` prints
  quadrotor,query=3,seed=1      the same with settings: the keyword arguments of the scenario's function
  my_robot.py:hallway,width=2   a function in a file of yours that returns a Scenario; it may import files beside it
  my_package.robots:hallway     a function in a module of yours
  my_robot.xml,start={'x': 1}   any MJCF or URDF, with the settings of `lqrsim.scenarios.mjcf`

A set of disturbances is `scenario`, for the disturbances of the scenario's demo, or the name of a preset. NAME:Kind is
one kind of disturbance in a set.
"""

import ast
import contextlib
import importlib
import inspect
import logging
import os
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import numpy as np

from lqrsim.annotations import Want, checked
from lqrsim.control.uncertainty import per_entry
from lqrsim.errors import Array, InputError, check_kind, check_name, excerpt
from lqrsim.results.coordinates import PerEntry
from lqrsim.robots.mjcf import MjcfRobot
from lqrsim.scenarios import packaged
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenes.scene import load_scene
from lqrsim.scenes.urdf import Base, Servos
from lqrsim.simulation.disturbances import PRESETS, Disturbance, preset


def resolve(reference: str, *, registered_only: bool = False) -> Scenario:
    """The scenario that `reference` names; see the top of this file for its forms.

    With `registered_only`, users' functions are refused: a reference from a file must not choose the code that runs.
    """
    target, settings = _parts(reference)
    if _is_mjcf(target):
        return mjcf(target, **_keywords(target, mjcf, settings))  # pyright: ignore[reportArgumentType]
    if names_code(reference):
        if registered_only:
            option = shlex.join(["--scenario", reference])
            raise InputError(f"scenario: got a file that needs your code in {target!r}, which runs only with {option}")
        make = _own_function(target)
    else:
        try:
            make = getattr(packaged, check_name("scenario", target, packaged.names()))
        except InputError as error:
            raise InputError(f"{error}; or the path of an .xml or .urdf file, or FILE.py:FUNCTION") from None
    scenario = make(**_keywords(target, make, settings))
    if not isinstance(scenario, Scenario):
        raise InputError(f"scenario: got a {type(scenario).__name__} from {target}, want a lqrsim Scenario")
    return scenario


def disturbance_set(name: str, scenario: Scenario) -> tuple[Disturbance, ...]:
    """The disturbances of a set at strength 1; see the top of this file for its names."""
    set_name, colon, kind = name.partition(":")
    check_name("disturbances", set_name, ["scenario", *PRESETS])
    disturbances = scenario.disturbances if set_name == "scenario" else tuple(preset(set_name, scenario.plant()))
    if not disturbances:
        why = f"scenario {scenario.name} states none" if set_name == "scenario" else "the robot has none of them"
        wanted = "a preset, such as --sweep light (of lqrsim simulate: --disturbances light)"
        raise InputError(f"disturbances: got {name!r}, but {why}, want a set with disturbances: {wanted}")
    if not colon:
        return disturbances
    kinds = dict.fromkeys(type(disturbance).__name__ for disturbance in disturbances)
    check_name(f"kind of disturbance in {set_name}", kind, kinds)
    return tuple(disturbance for disturbance in disturbances if type(disturbance).__name__ == kind)


def names_code(reference: str) -> bool:
    """Whether the reference names a user's function. Files never choose code to run; MJCFs and names may come from one.

    A colon alone does not tell: settings may have one, and paths on Windows.
    """
    target, _ = _parts(reference)
    return ":" in target and not _is_mjcf(target)


def _is_mjcf(target: str) -> bool:
    return target.lower().endswith((".xml", ".urdf"))


def from_anywhere(reference: str) -> str:
    """The same reference with absolute paths, so that it works in any working directory."""
    target, settings = _parts(reference)
    place, colon, name = target.rpartition(":")
    if colon and place.endswith(".py"):
        target = f"{Path(place).absolute()}:{name}"
    if _is_mjcf(target):
        target = str(Path(target).absolute())
    return ",".join([target, *settings])


def folder_name(scenario: Scenario) -> str:
    """The scenario's name as a folder name that is valid on any system."""
    return re.sub(r"[^\w.-]+", "_", scenario.name)[:100].strip("._ ") or "scenario"


def _parts(reference: str) -> tuple[str, list[str]]:
    """The target and its settings. A comma inside a value, as in `goal=(1, 2)`, does not separate settings."""
    target, *settings = re.split(r",(?=\s*\w+=)", reference)
    return target, settings


def _own_function(target: str) -> Callable[..., object]:
    place, _, name = target.rpartition(":")  # the last colon: C:\robots\mine.py:hallway
    module = _load_file(Path(place)) if place.endswith(".py") else _import(place)
    functions = {key: value for key, value in vars(module).items() if inspect.isfunction(value) and key[0] != "_"}
    if name not in functions:  # offered are the module's own, those that need arguments only if there are no others
        defined = {key: make for key, make in functions.items() if make.__module__ == module.__name__}
        callable_so = []  # without arguments
        for key, make in defined.items():
            with contextlib.suppress(TypeError):
                inspect.signature(make).bind()
                callable_so.append(key)
        check_name(f"function in {place}", name, callable_so or defined)
    return functions[name]


def _load_file(path: Path) -> ModuleType:
    if not os.path.isfile(path):  # Path.is_file raises for names that are too long
        raise InputError(f"scenario: got {path}, want a Python file that exists")
    name = str(path.resolve())  # the stem may be the name of another module
    module = ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module  # dataclasses look up their module while it runs
    folder = str(path.resolve().parent)
    if folder not in sys.path:  # for the modules beside it, as if Python ran the file; last, to hide no other module
        sys.path.append(folder)
    # Not by a loader: it takes bytecode on disk for current if the file was changed within a second.
    exec(compile(path.read_bytes(), path, "exec", dont_inherit=True), vars(module))
    return module


def _import(name: str) -> ModuleType:
    if not all(part.isidentifier() for part in name.split(".")):  # a relative name, or none
        raise InputError(f"scenario: got module {excerpt(name)}, want the name of one, as in package.module:function")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # `python -m` does this, an installed command does not

    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(f"scenario: got module {name!r}, want one that can be imported ({error})") from None


def _keywords(target: str, make: Callable[..., object], settings: list[str]) -> dict[str, object]:
    parameters = inspect.signature(make).parameters.items()
    valid = [name for name, p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) and name != "path"]
    keywords: dict[str, object] = {}
    for setting in settings:
        name, _, text = setting.strip().partition("=")
        check_name(f"setting of {target}", name, valid)
        if name in keywords:
            raise InputError(f"setting of {target}: got {name} twice, want it once")
        try:
            keywords[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):  # the last three of odd brackets
            keywords[name] = text
    if missing := [name for name, p in parameters if p.default is p.empty and name in valid and name not in keywords]:
        raise InputError(f"scenario: got {target} without {', '.join(missing)}, want {target},{missing[0]}=VALUE")
    return keywords


_log = logging.getLogger("lqrsim")

Place = str | Mapping[str, float] | None


@checked
def mjcf(
    path: str,
    *,
    start: Place = None,
    goal: Place = None,
    weights: PerEntry = 100.0,
    effort: PerEntry | None = None,
    dt: float | None = None,
    steps: int = 150,
    body: str | None = None,
    floors: bool = True,
    at_rest: bool = False,
    turns_about: str | None = None,
    obstacles: bool | Sequence[str] = True,
    clearance: float | None = None,
    parameters: Annotated[Mapping[str, float], Want("numbers by name: {'mass': 0.6}")] | None = None,
    base: Base | None = None,
    servos: Servos | None = None,
    efforts: Mapping[str, float] | None = None,
    armature: float | Mapping[str, float] | None = None,
) -> Scenario:
    """Make a scenario that moves the robot of an MJCF or a URDF from a start to a goal, within its actuators' limits.

    What is not named here is as in `MjcfRobot`, and of a URDF as in `load_scene`.

    Args:
      start: the name of a keyframe, or states by name, {"pole": 3.14}, possibly with a keyframe, {"keyframe": "home",
        "pole": 3.14}. Other states are at rest, as in the MJCF. Mocap bodies are where the keyframe has them.
      goal: the goal, in the same form. Without a start and a goal, the robot is to stay at rest, and a warning says
        this.
      weights: weights of the final error: a number for all states, or by name or unit, as {"m": 100, "rad": 100};
        states that are not named have no weight.
      effort: weights of the controls, about those that hold the robot: a number, or by name or unit; see
        `MjcfRobot.problem`.
      dt: control period in s, by default about 0.02.
      at_rest: whether start and goal are moved to where contacts carry the robot, as by `MjcfRobot.at_rest`.
      obstacles: names of geoms or bodies to keep clear of, or False for none; by default as in `MjcfRobot`.
      clearance: least distance to obstacles in metres, as in `MjcfRobot.problem`.
      parameters: other parameters of the MJCF, as in `MjcfRobot.with_parameters`: {"pole_mass": 0.3}.
    """
    keyframe = start.get("keyframe") if isinstance(start, Mapping) else start
    mocap = keyframe if isinstance(keyframe, str) and not keyframe.lstrip().startswith("{") else None
    of_urdf: dict[str, Any] = {"base": base, "servos": servos, "efforts": efforts, "armature": armature}
    is_stated = any(setting is not None for setting in of_urdf.values())
    file = load_scene(path, **of_urdf) if is_stated else path
    robot = MjcfRobot(file, body=body, floors=floors, turns_about=turns_about, obstacles=obstacles, mocap=mocap)
    if parameters:
        robot = robot.with_parameters(**parameters)
    space, controls = robot.dynamics.state_coordinates, robot.dynamics.control_coordinates
    begin, end = _state(robot, "start", start), _state(robot, "goal", goal)
    if at_rest:
        begin, end = robot.at_rest(begin), robot.at_rest(end)
    if np.array_equal(begin, end):
        _log.warning(
            "%s: start and goal are the same, so there is nothing to do; say one by name, as goal={'%s': 0.1}",
            Path(path).name, space.names[0],
        )  # fmt: skip
    per_entry("weights", weights, space)  # whose messages name the setting
    problem = robot.problem(
        begin, end, steps=steps, dt=dt, weights=weights,
        effort=None if effort is None else per_entry("effort", effort, controls, above=0.0),
        clearance=clearance,
    )  # fmt: skip
    return Scenario(
        name=Path(path).stem, summary=f"{robot.name}, with the dynamics of MuJoCo", robot=robot, scene=robot.scene,
        problem=problem, tracking_bound=robot.radius or 0.1,
    )  # fmt: skip


def _state(robot: MjcfRobot, field: str, place: Place) -> Array:
    """The state for `start` or `goal`. Raises InputError for an unknown keyframe or state."""
    check_kind(field, place, (str, Mapping, type(None)), "a keyframe's name, or states by name: {'x': 1.0}")
    named = {"keyframe": place} if isinstance(place, str) else dict(place or {})
    keyframe = named.pop("keyframe", None)
    if isinstance(keyframe, str) and keyframe.lstrip().startswith("{"):  # not a dictionary that Python can read
        space = robot.dynamics.state_coordinates
        units = dict(zip(space.names, space.units, strict=True))
        meant = [f"{name} in {units[name]}" for name in re.findall(r"\w+", keyframe) if units.get(name)]
        hint = f": {', '.join(meant)}" if meant else ""
        raise InputError(f"{field}: got {excerpt(keyframe)}, want {{'x': 1.0}}, numbers without units{hint}")
    if not isinstance(keyframe, str | None):
        raise InputError(f"{field}: keyframe: got {excerpt(keyframe)}, want its name")
    try:
        return robot.at(keyframe, **named)  # pyright: ignore[reportArgumentType]
    except TypeError:
        raise InputError(f"{field}: got {excerpt(place)}, want states by name: {{'x': 1.0}}") from None
