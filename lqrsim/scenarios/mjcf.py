"""A scenario from any MJCF: `lqrsim solve "cartpole.xml,start={'pole': 3.14}"`."""

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from lqrsim.annotations import Want, checked
from lqrsim.control.uncertainty import per_entry
from lqrsim.errors import Array, InputError, check_kind, excerpt
from lqrsim.results.coordinates import PerEntry
from lqrsim.robots.mjcf import MjcfRobot
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenes.scene import load_scene
from lqrsim.scenes.urdf import Base, Servos

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
