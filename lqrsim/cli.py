"""The command line. Each command reads what the one before wrote; `lqrsim COMMAND --help` documents each."""

import logging
import os
import sys
from collections.abc import Sequence

import tyro

from lqrsim.commands.failures import Break, Rare
from lqrsim.commands.housekeeping import Cache, Demo, Reproduce
from lqrsim.commands.solving import List, Simulate, Solve
from lqrsim.commands.stressing import Replay, Report, Stress
from lqrsim.commands.verifying import Verify
from lqrsim.commands.viewing import Render, View

DESCRIPTION = """Feedback policies by iterated LQR smoothing, executed in MuJoCo under disturbances and shown on video.

The whole chain, for both robots, is `lqrsim demo`. Step by step, each command reading what the one before wrote:
  lqrsim solve quadrotor --out runs/quadrotor
  lqrsim simulate runs/quadrotor/solution.npz --force-noise 0.1 --seed 1
  lqrsim render runs/quadrotor/rollout.npz
  lqrsim verify runs/quadrotor/rollout.npz
Push the robot and watch the policy recover: `lqrsim view quadrotor`.
How often policies fail, under what, and how sure that is: `lqrsim stress quadrotor`; where that is too seldom to be
seen, `lqrsim rare quadrotor`; and how little it takes, `lqrsim break quadrotor`.
The paper's results, beside what came out here: `lqrsim reproduce`.

Exit codes: 0 done, 1 not converged or out of bounds, 2 bad input. The version is printed by `lqrsim --version`."""

Command = (
    List
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
    | Reproduce
    | Cache
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
      arguments: what follows `lqrsim` on the command line; those of this process by default.

    Returns:
      The exit code: 0 done; 1 not converged or out of bounds; 2 bad input; 130 stopped with Ctrl-C;
      141 nobody reads what it prints.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments == ["--version"]:
        from importlib.metadata import version

        print(f"lqrsim {version('lqrsim')}")
        return 0
    command = tyro.cli(Command, prog="lqrsim", description=DESCRIPTION, args=arguments)

    from lqrsim.errors import InputError

    notices = logging.StreamHandler()  # on stderr: what takes its time, such as compiling for a new kind of problem
    logger = logging.getLogger("lqrsim")
    logger.addHandler(notices)
    logger.setLevel(logging.INFO)
    try:
        code = command.run()
        sys.stdout.flush()  # while a broken pipe can still be handled
        return code
    except InputError as error:
        print(f"lqrsim: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("lqrsim: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever reads what is printed, such as `head`, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is flushed at the end
        return 141
    finally:
        logger.removeHandler(notices)


if __name__ == "__main__":
    sys.exit(main())
