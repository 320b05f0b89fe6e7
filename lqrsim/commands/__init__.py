"""The commands of `lqrsim`, each a class: its docstring and its fields' are the help text, `run` carries it out.

Heavy modules are imported inside `run`, so that `--help` answers at once.
"""

import inspect
from typing import get_args

from lqrsim.commands.certifying import Funnel
from lqrsim.commands.creating import New
from lqrsim.commands.failures import Break, Rare
from lqrsim.commands.housekeeping import Cache, Demo, Reproduce
from lqrsim.commands.solving import List, Simulate, Solve
from lqrsim.commands.stressing import Replay, Report, Stress
from lqrsim.commands.verifying import Verify
from lqrsim.commands.viewing import Render, View

Command = (
    List
    | New
    | Solve
    | Simulate
    | Render
    | Verify
    | View
    | Demo
    | Stress
    | Replay
    | Report
    | Rare
    | Break
    | Funnel
    | Reproduce
    | Cache
)

# Name -> what it does, the first line of its help.
COMMANDS = {kind.__name__.lower(): (inspect.getdoc(kind) or "").partition("\n")[0] for kind in get_args(Command)}
