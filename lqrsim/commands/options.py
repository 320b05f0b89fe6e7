"""Options that several commands share."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args

from tyro.conf import FlagCreatePairsOff, Positional, arg
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo


def optional(metavar: str, text: str | None = None) -> object:
    """An option whose help text describes its default."""
    return arg(metavar=metavar, help_behavior_hint="", help=text)


RULES = ConstructorRegistry()


@RULES.primitive_rule
def _value_or_default(info: PrimitiveTypeInfo) -> Any:
    """What is given for a `T | None` is a T. tyro would try None as well, and name types and markup if both fail."""
    kinds = set(get_args(info.type))
    if len(kinds) != 2 or NoneType not in kinds:
        return None
    (kind,) = kinds - {NoneType}
    found = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, info.markers))
    if not isinstance(found, PrimitiveConstructorSpec):
        return found
    return replace(
        found,
        is_instance=lambda value: value is None or found.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else found.str_from_instance(value),
    )


PolicyName = Literal["smooth", "ilqr", "open_loop", "replan", "track", "offset_free"]
CampaignPolicyName = Literal[PolicyName, "track_per_cell", "offset_free_per_cell"]
ControllerName = Literal["feedback", "track", "offset_free", "replan"]
Strength = Annotated[float, arg(metavar="FACTOR", help="Factor by which the disturbances are scaled.")]
DesignSet = Annotated[
    str | None,
    optional(
        "NAME",
        "The set of disturbances for which track and offset_free are designed, named as in `lqrsim stress --sweep`. By"
        " default moderate.",
    ),
]
SolutionFile = Annotated[
    Path | None,
    optional(
        "FILE.npz",
        "Run this solution, from `lqrsim solve`, instead of solving the scenario. It must be of the scenario's robot,"
        " horizon and goal.",
    ),
]
GoalRadius = Annotated[
    float | None,
    optional(
        "METRES",
        "Distance from the goal within which it counts as reached. By default the scenario's or robot's radius.",
    ),
]
GoalTolerance = Annotated[
    float | None,
    optional(
        "SHARE", "The same for goals without a position, relative to each state's way to the goal. By default 0.1."
    ),
]
Seed = Annotated[int, arg(help="Seed of all random numbers. The same seed gives the same output.")]
Folder = Annotated[Path | None, optional("FOLDER")]
OwnScenario = Annotated[
    str | None,
    optional("SCENARIO", "The campaign's scenario if it is your own function: files never choose code to run."),
]
Json = Annotated[
    FlagCreatePairsOff[bool],
    arg(help="Print the result as one JSON object, and everything else to stderr; see docs/json.md."),
]


def stated(command: Any, function: Callable[..., Any]) -> dict[str, Any]:
    """The options of a command that a function or a record takes, by name."""
    return {name: getattr(command, name) for name in inspect.signature(function).parameters if hasattr(command, name)}


@dataclass(frozen=True, kw_only=True)
class SetupOptions:
    """The options that state a `Setup`, for commands that run a scenario under disturbances."""

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """As in `lqrsim solve`."""
    design_disturbances: DesignSet = None
    solution: SolutionFile = None
    goal_radius: GoalRadius = None
    goal_tolerance: GoalTolerance = None
    seed: Seed = 0
    json: Json = False


@dataclass(frozen=True, kw_only=True)
class StudyOptions(SetupOptions):
    """The options that state a `Study`, for commands that examine one policy."""

    strength: Strength = 1.0
    policy: PolicyName = "smooth"
    """As in `lqrsim stress`."""
