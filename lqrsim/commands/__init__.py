"""The commands of `lqrsim`, one class each: the docstrings of class and fields are its help, `run` executes it.

Heavy modules are imported inside `run`, so that `--help` answers at once.
"""

import inspect
from typing import Annotated, Any, Union

from tyro.conf import subcommand

from lqrsim.commands.creating import Export, New
from lqrsim.commands.reliability import Break, Certify, FunnelCommand, Harden, Rare
from lqrsim.commands.reproduce import Reproduce
from lqrsim.commands.solving import Bridge, Cache, Demo, List, Simulate, Solve
from lqrsim.commands.stressing import Compare, Replay, Report, Stress
from lqrsim.commands.viewing import Render, Verify, View

_ALL = (
    List, New, Solve, Simulate, Render, Verify, View, Demo, Stress, Replay, Report, Compare, Rare, Certify, Harden,
    Break, FunnelCommand, Export, Bridge, Reproduce, Cache,
)  # fmt: skip
NAMES: dict[type, str] = {kind: kind.__name__.removesuffix("Command").lower() for kind in _ALL}
# Name -> the first line of its help.
COMMANDS = {name: (inspect.getdoc(kind) or "").partition("\n")[0] for kind, name in NAMES.items()}
Command: Any = Union[tuple(Annotated[kind, subcommand(name)] for kind, name in NAMES.items())]  # noqa: UP007 - computed
