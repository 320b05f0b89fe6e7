"""Other people's solvers on the quadrotor's problem, to compare with: for now Crocoddyl's FDDP.

It runs by the fastest route that Crocoddyl's wheel allows: the wheel has the C++ library and its headers, so the model
is C++ too (`crocoddyl_quadrotor.cpp` beside this file, derivatives by hand in `solver_benchmark/quadrotor.hpp`,
compiled with -O3 -march=native when first needed), and nothing calls Python between the first iteration and the last.
The library itself is used as it was compiled for everyone. One thread. Crocoddyl's storage is made once and used for
all queries.

The problem is the one that lqrsim solves, but for the start: FDDP has no soft start, so the state at t = 0 is given.
The stop test is the same: a relative change of the true cost below TOLERANCE, between two feasible trajectories. The
obstacle cost's Hessian is projected as lqrsim does it; everything else is Crocoddyl's default.
"""

import ctypes
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

import lqrsim as ls
from lqrsim import cache as disk
from lqrsim.costs import terms_of
from lqrsim.errors import Array

SOURCE = Path(__file__).with_name("crocoddyl_quadrotor.cpp")
HEADER = SOURCE.parent / "solver_benchmark" / "quadrotor.hpp"
# Rounding as in lqrsim's compiled functions: sums may be reordered, NaN and infinity stay meaningful. Eigen must align
# its memory as the library does, which was compiled for processors of all kinds: the compiler vectorises, not Eigen.
FLAGS = (
    "-O3", "-march=native", "-ffp-contract=fast", "-fassociative-math", "-fno-signed-zeros", "-fno-trapping-math",
    "-freciprocal-math", "-fno-math-errno", "-DEIGEN_DONT_VECTORIZE", "-DEIGEN_MAX_ALIGN_BYTES=16",
    "-DEIGEN_MAX_STATIC_ALIGN_BYTES=16", "-std=c++17", "-shared", "-fPIC",
)  # fmt: skip
TOLERANCE, MAX_ITERATIONS = 1e-4, 500  # as lqrsim has them


class Unavailable(Exception):
    """A solver that can not be had here; the message says in a line what is missing."""


@dataclass(frozen=True)
class Answer:
    """States (T+1, n), controls (T, m), their cost as the solver has it, and how many iterations it took."""

    states: Array
    controls: Array
    cost: float
    iterations: int
    converged: bool


class Crocoddyl:
    """FDDP for quadrotor problems that differ in their start and goal only.

    Args:
      problem: one of them.

    Raises:
      Unavailable: Crocoddyl, Eigen's headers or g++ is not installed, or they do not fit together.
    """

    def __init__(self, problem: ls.Problem) -> None:
        (control,) = [cost for cost in terms_of(problem.stage_cost) if isinstance(cost, ls.ControlCost)]
        (obstacles,) = problem.obstacle_costs
        (final,) = [cost for cost in terms_of(problem.final_cost) if isinstance(cost, ls.QuadraticCost)]
        robot = [problem.dynamics.parameters[name] for name in ("mass", "inertia", "arm", "torque_ratio")]
        robot += [problem.dynamics.parameters[name] for name in ("drag", "gravity")]
        scalars = [*robot, problem.dt, obstacles.radius, obstacles.sharpness, obstacles.weight]
        weights = [np.diag(control.weight), control.about, np.diag(final.weight), final.about]
        bars, walls = [], []
        for obstacle in obstacles.world.obstacles:
            axis = obstacle.rotation[:, 2]
            if obstacle.kind == "cylinder" and np.isinf(obstacle.size[1]):
                bars.append([*obstacle.position, *axis, obstacle.size[0]])
            elif obstacle.kind == "plane":
                walls.append([*obstacle.position, *axis])
            else:
                raise NotImplementedError(f"obstacle {obstacle.name!r}: a {obstacle.kind}")
        self._library = _library()
        numbers, bar, wall = np.concatenate([scalars, *weights]), np.array(bars, float), np.array(walls, float)
        self._steps = problem.steps
        self._workspace = ctypes.c_void_p(
            self._library.make(problem.steps, _at(numbers), len(bars), _at(bar), len(walls), _at(wall))
        )

    def __del__(self) -> None:
        if hasattr(self, "_workspace"):
            self._library.release(self._workspace)

    def from_hover(self, problem: ls.Problem) -> Answer:
        """Solve from the trajectory of the nominal control."""
        return self._solve(problem, np.tile(_start(problem), (self._steps + 1, 1)), rolled_out=True)

    def from_line(self, problem: ls.Problem) -> Answer:
        """Solve from states on the line from start to goal and the nominal control, which do not belong together."""
        along = np.linspace(0, 1, self._steps + 1)[:, None]
        start = _start(problem)
        return self._solve(problem, start + along * (_goal(problem) - start), rolled_out=False)

    def _solve(
        self,
        problem: ls.Problem,
        states: Array,
        *,
        rolled_out: bool,
    ) -> Answer:
        controls = np.tile(problem.nominal_control, (self._steps, 1))
        cost, goal = np.zeros(1), _goal(problem)
        count = self._library.solve(
            self._workspace, _at(goal), _at(states), _at(controls), int(rolled_out), ctypes.c_double(TOLERANCE),
            MAX_ITERATIONS, _at(cost),
        )  # fmt: skip
        return Answer(states, controls, float(cost[0]), abs(count), count > 0)


def versions() -> dict[str, str]:
    """Name -> version of Crocoddyl and of what its speed depends on."""
    found = {}
    for name in ("crocoddyl", "libcrocoddyl", "cmeel-eigen"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _start(problem: ls.Problem) -> Array:
    assert problem.start is not None
    return problem.start


def _goal(problem: ls.Problem) -> Array:
    (goal,) = [cost.about for cost in terms_of(problem.final_cost) if isinstance(cost, ls.QuadraticCost)]
    return goal


def _at(array: Array) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    assert array.dtype == np.float64
    return array.ctypes.data_as(ctypes.c_void_p)


@cache
def _library() -> ctypes.CDLL:
    """The model, compiled against the wheel's headers and linked with its library; kept on disk."""
    found = importlib.util.find_spec("crocoddyl")
    if found is None or not found.submodule_search_locations:
        raise Unavailable("Crocoddyl is not installed: pip install 'lqrsim[bench]'")
    prefix = Path(found.submodule_search_locations[0]).parents[3]  # <prefix>/lib/pythonX.Y/site-packages/crocoddyl
    if not (prefix / "include" / "eigen3").is_dir():
        raise Unavailable("Eigen's headers are not installed: pip install 'lqrsim[bench]'")
    if shutil.which("g++") is None:
        raise Unavailable("g++ is not installed, which compiles Crocoddyl's model")
    lib = prefix / "lib"
    # DT_RPATH instead of DT_RUNPATH, for the libraries that the library needs in turn.
    flags = [*FLAGS, f"-I{prefix / 'include'}", f"-I{prefix / 'include' / 'eigen3'}"]
    link = [f"-L{lib}", "-lcrocoddyl", f"-Wl,-rpath,{lib},--disable-new-dtags"]
    key = disk.key(SOURCE.read_bytes(), HEADER.read_bytes(), *flags, *link, str(versions()))
    target = disk.folder() / "peers" / f"crocoddyl_{key}.so"
    if not target.is_file():
        print("compiling Crocoddyl's model: some 10 seconds, once ...", file=sys.stderr, flush=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            unfinished = Path(folder) / target.name
            done = subprocess.run(
                ["g++", *flags, str(SOURCE), "-o", str(unfinished), *link], capture_output=True, text=True, check=False
            )
            if done.returncode:
                raise Unavailable(f"Crocoddyl's model does not compile: {done.stderr.strip().splitlines()[0]}")
            os.replace(unfinished, target)
    try:
        library = ctypes.CDLL(str(target))
    except OSError as error:
        raise Unavailable(f"Crocoddyl's model can not be loaded: {error}") from None
    library.make.restype = ctypes.c_void_p
    library.solve.restype = ctypes.c_int
    library.release.restype = None
    return library
