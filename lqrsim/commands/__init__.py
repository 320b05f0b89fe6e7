"""The commands of `lqrsim`, one class each: the docstrings of class and fields are its help, `run` executes it.

Heavy modules are imported inside `run`, so that `--help` answers at once.
"""

import inspect
from typing import Annotated, Any, Union

from tyro.conf import subcommand

from lqrsim.commands import reproduce, solving, stressing, viewing

_ALL = (
    solving.List, solving.New, solving.Solve, solving.Simulate, viewing.Render, viewing.Verify, viewing.View,
    solving.Demo, stressing.Stress, stressing.Replay, stressing.Report, stressing.Compare, stressing.Rare,
    stressing.Certify, stressing.Harden, stressing.Break, stressing.FunnelCommand, viewing.Export, solving.Bridge,
    reproduce.Reproduce, solving.Cache,
)  # fmt: skip
NAMES: dict[type, str] = {kind: kind.__name__.removesuffix("Command").lower() for kind in _ALL}
# Name -> the first line of its help.
COMMANDS = {name: (inspect.getdoc(kind) or "").partition("\n")[0] for kind, name in NAMES.items()}
Command: Any = Union[tuple(Annotated[kind, subcommand(name)] for kind, name in NAMES.items())]  # noqa: UP007 - computed
