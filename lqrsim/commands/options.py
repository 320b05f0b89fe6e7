"""What the options of several commands share."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, arg


def optional(metavar: str) -> object:
    """An option whose default its own help text tells."""
    return arg(metavar=metavar, help_behavior_hint="")


Policy = Literal["smooth", "ilqr", "open_loop", "replan", "track", "offset_free"]
ControllerName = Literal["feedback", "track", "offset_free", "replan"]
SolutionFile = Annotated[
    Path | None,
    arg(
        metavar="FILE.npz",
        help_behavior_hint="",
        help="Run this solution, from `lqrsim solve`, instead of solving the scenario. It must be of the scenario's"
        " robot, horizon and goal.",
    ),
]
Json = FlagCreatePairsOff[bool]
Folder = Annotated[Path | None, optional("FOLDER")]
