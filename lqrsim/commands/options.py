"""What the options of several commands share."""

from pathlib import Path
from typing import Annotated

from tyro.conf import arg


def optional(metavar: str) -> object:
    """An option whose default its own help text tells."""
    return arg(metavar=metavar, help_behavior_hint="")


Folder = Annotated[Path | None, optional("FOLDER")]
