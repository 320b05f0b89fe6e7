"""What the peers share: what they are told of a problem, what they answer, and how their C and C++ is compiled."""

import ctypes
import importlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim.codegen import disk_cache as disk
from lqrsim.errors import Array
from lqrsim.machine import versions_of
from lqrsim.problem.parts import terms_of

# Rounding as in lqrsim's compiled functions: sums may be reordered, NaN and infinity stay meaningful.
FLAGS = (
    "-O3", "-march=native", "-ffp-contract=fast", "-fassociative-math", "-fno-signed-zeros", "-fno-trapping-math",
    "-freciprocal-math", "-fno-math-errno", "-shared", "-fPIC",
)  # fmt: skip


class Unavailable(Exception):
    """A solver that cannot be had here; the message says in a line what is missing."""


@dataclass(frozen=True)
class Answer:
    """States (T+1, n), controls (T, m), their cost as the solver has it, and how many iterations it took.

    `duration` is in s where that was free; its price is in the cost. `seconds` are those of a call that is timed.
    """

    states: Array
    controls: Array
    cost: float
    iterations: int
    converged: bool
    duration: float | None = None
    seconds: float = float("nan")


@dataclass(frozen=True)
class Parts:
    """A problem taken apart: one control cost, one obstacle cost, a quadratic final cost, a start that is given.

    Attributes:
      robot: its name, as lqrsim has it. parameters: of its dynamics, by name.
      start, goal: (n,). nominal: (m,) the control that costs nothing.
      control_weight (m, m), final_weight (n, n): of the quadratic costs.
      world: the obstacles as the robot sees them; the other three are the obstacle cost's.
    """

    robot: str
    parameters: dict[str, float]
    start: Array
    goal: Array
    nominal: Array
    control_weight: Array
    final_weight: Array
    world: ls.World
    radius: float
    sharpness: float
    obstacle_weight: float


def parts(problem: ls.Problem) -> Parts:
    """Raises NotImplementedError if the problem is of another make."""
    robots = {robot.dynamics.f: robot.name for robot in (ls.Quadrotor(), ls.DifferentialDrive())}
    if problem.dynamics.f not in robots:
        raise NotImplementedError(f"the dynamics {problem.dynamics.name}")
    stage, final = terms_of(problem.stage_cost), terms_of(problem.final_cost)
    kinds = sorted(type(cost).__name__ for cost in stage), [type(cost).__name__ for cost in final]
    if kinds != (["ControlCost", "ObstacleCost"], ["QuadraticCost"]) or problem.start is None:
        raise NotImplementedError(f"stage and final cost of {kinds}, and the start {problem.start}")
    (control,) = [cost for cost in stage if isinstance(cost, ls.ControlCost)]
    (obstacles,) = problem.obstacle_costs
    (arrival,) = [cost for cost in final if isinstance(cost, ls.QuadraticCost)]
    return Parts(
        robot=robots[problem.dynamics.f],
        parameters=problem.dynamics.parameters,
        start=problem.start,
        goal=arrival.about,
        nominal=control.about,
        control_weight=control.weight,
        final_weight=arrival.weight,
        world=obstacles.world.seen_by(problem.dynamics.state_coordinates.plane),
        radius=obstacles.radius,
        sharpness=obstacles.sharpness,
        obstacle_weight=obstacles.weight,
    )


def ends(problem: ls.Problem) -> tuple[Array, Array]:
    """Start and goal (n,), in no time."""
    assert problem.start is not None
    assert problem.goal is not None
    return problem.start, problem.goal


def line(problem: ls.Problem) -> tuple[Array, Array]:
    """States on the line from start to goal and the nominal control, which do not belong together."""
    along, (start, goal) = np.linspace(0, 1, problem.steps + 1)[:, None], ends(problem)
    return start + along * (goal - start), np.tile(problem.nominal_control, (problem.steps, 1))


@cache
def casadi() -> Any:
    """The module. Raises Unavailable where it is not installed."""
    try:
        return importlib.import_module("casadi")
    except ImportError:
        raise Unavailable("CasADi is not installed: pip install 'lqrsim[bench]'") from None


def versions() -> dict[str, str]:
    """Name -> version of the peers and of what their speed depends on."""
    return versions_of("crocoddyl", "libcrocoddyl", "cmeel-eigen", "casadi")


def compiled(what: str, sources: Sequence[Path], flags: Sequence[str], link: Sequence[str] = ()) -> Path:
    """The library made of the first of the sources, which the others are included in; kept on disk."""
    if shutil.which("g++") is None:
        raise Unavailable(f"g++ is not installed, which compiles {what}")
    key = disk.key(*(source.read_bytes() for source in sources), *flags, *link, str(versions()))
    target = disk.folder() / "peers" / f"{sources[0].stem}_{key}.so"
    if target.is_file():
        return target
    print(f"compiling {what}, once ...", file=sys.stderr, flush=True)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        unfinished = Path(folder) / target.name
        command = ["g++", *flags, str(sources[0]), "-o", str(unfinished), *link]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise Unavailable(f"{what} does not compile: {done.stderr.strip().splitlines()[0]}")
        os.replace(unfinished, target)
    return target


def at(array: Array) -> ctypes.c_void_p:
    """Where its numbers are, for C."""
    assert array.flags.c_contiguous
    assert array.dtype == np.float64
    return array.ctypes.data_as(ctypes.c_void_p)
