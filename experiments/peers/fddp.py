"""Crocoddyl's FDDP and box-FDDP, by the fastest route that its wheel allows.

The wheel has the C++ library and its headers, so the model is C++ too (`crocoddyl.cpp` beside this file, derivatives by
hand in `robots.hpp` and `obstacles.hpp`, compiled with -O3 -march=native when first needed), and nothing calls Python
between the first iteration and the last. The library itself is used as it was compiled for everyone. One thread.
Crocoddyl's storage is made once and used for all queries.

The stop test is lqrsim's: a relative change of the true cost below TOLERANCE, between two feasible trajectories. The
obstacle cost's Hessian is projected as lqrsim does it; everything else is Crocoddyl's default.
"""

import ctypes
import importlib.util
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

import lqrsim as ls
from lqrsim.errors import Array
from peers.common import FLAGS, Answer, Unavailable, at, compiled, ends, line, parts

SOURCES = [Path(__file__).with_name(name) for name in ("crocoddyl.cpp", "robots.hpp", "obstacles.hpp")]
# Eigen must align its memory as the library does, which was compiled for processors of all kinds: the compiler
# vectorises, not Eigen. It inlines as much as it would if there were one robot only.
EIGEN = (
    "-DEIGEN_DONT_VECTORIZE", "-DEIGEN_MAX_ALIGN_BYTES=16", "-DEIGEN_MAX_STATIC_ALIGN_BYTES=16", "-std=c++17",
    "--param=inline-unit-growth=400",
)  # fmt: skip
TOLERANCE, MAX_ITERATIONS = 1e-4, 500  # as lqrsim has them


class Crocoddyl:
    """FDDP for problems that differ in their start and goal only.

    Args:
      problem: one of them, of either robot and in any world; weights are diagonal.
      box: whether to keep the limits of the controls, by box-FDDP; FDDP knows none.

    Raises:
      Unavailable: Crocoddyl, Eigen's headers or g++ is not installed, or they do not fit together.
      NotImplementedError: the problem is of another make.
    """

    def __init__(self, problem: ls.Problem, *, box: bool = False) -> None:
        told = parts(problem)
        for weight in (told.control_weight, told.final_weight):
            if np.count_nonzero(weight) > np.count_nonzero(np.diag(weight)):
                raise NotImplementedError("a weight that is no diagonal")
        scalars = [problem.dt, told.radius, told.sharpness, told.obstacle_weight, *told.parameters.values()]
        weights = [np.diag(told.control_weight), told.nominal, np.diag(told.final_weight), told.goal]
        space = problem.control_coordinates
        weights += [space.low, space.high] if box else [np.full(len(space), side) for side in (-np.inf, np.inf)]
        numbers, obstacles = np.concatenate([scalars, *weights]), told.world.table
        self._library = _library()
        self._steps = problem.steps
        self._workspace = ctypes.c_void_p(
            self._library.make(
                int(told.robot == ls.Quadrotor.name), int(box), problem.steps, at(numbers), len(told.world),
                at(obstacles),
            )
        )  # fmt: skip

    def __del__(self) -> None:
        if hasattr(self, "_workspace"):
            self._library.release(self._workspace)

    def from_hover(self, problem: ls.Problem) -> Answer:
        """Solve from the trajectory of the nominal control."""
        return self._solve(problem, *line(problem), rolled_out=True)

    def from_line(self, problem: ls.Problem) -> Answer:
        """Solve from states on the line from start to goal and the nominal control, which do not belong together."""
        return self._solve(problem, *line(problem), rolled_out=False)

    def solve(self, problem: ls.Problem, states: Array, controls: Array) -> Answer:
        """Solve from states (T+1, n) and controls (T, m), whether or not they belong together."""
        return self._solve(problem, np.array(states, dtype=float), np.array(controls, dtype=float), rolled_out=False)

    def _solve(self, problem: ls.Problem, states: Array, controls: Array, *, rolled_out: bool) -> Answer:
        assert len(controls) == self._steps
        (start, goal), cost = ends(problem), np.zeros(1)
        states[0] = start
        count = self._library.solve(
            self._workspace, at(goal), at(states), at(controls), int(rolled_out), ctypes.c_double(TOLERANCE),
            MAX_ITERATIONS, at(cost),
        )  # fmt: skip
        return Answer(states, controls, float(cost[0]), abs(count), count > 0)

    def look(self, step: int, state: Array, control: Array) -> list[Array]:
        """What FDDP is told at a step but the last state: cost, next state, Fx, Fu, Lx, Lu, Lxx, Luu."""
        n, m = len(state), len(control)
        shapes = [(), (n,), (n, n), (n, m), (n,), (m,), (n, n), (m, m)]
        sizes = [int(np.prod(shape)) for shape in shapes]
        out = np.zeros(sum(sizes))
        self._library.look(self._workspace, step, at(state), at(control), at(out))
        split = np.split(out, np.cumsum(sizes)[:-1])
        return [part.reshape(shape) for part, shape in zip(split, shapes, strict=True)]


@cache
def _library() -> ctypes.CDLL:
    """The model, compiled against the wheel's headers and linked with its library; kept on disk."""
    library = linked("Crocoddyl's model (some 15 seconds)", SOURCES)
    library.make.restype = ctypes.c_void_p
    library.solve.restype = ctypes.c_int
    library.release.restype = library.look.restype = None
    return library


def linked(what: str, sources: Sequence[Path]) -> ctypes.CDLL:
    """The library made of the first of the sources and of Crocoddyl. Raises Unavailable."""
    found = importlib.util.find_spec("crocoddyl")
    if found is None or not found.submodule_search_locations:
        raise Unavailable("Crocoddyl is not installed: pip install 'lqrsim[bench]'")
    prefix = Path(found.submodule_search_locations[0]).parents[3]  # <prefix>/lib/pythonX.Y/site-packages/crocoddyl
    if not (prefix / "include" / "eigen3").is_dir():
        raise Unavailable("Eigen's headers are not installed: pip install 'lqrsim[bench]'")
    lib = prefix / "lib"
    flags = [*FLAGS, *EIGEN, f"-I{prefix / 'include'}", f"-I{prefix / 'include' / 'eigen3'}"]
    # DT_RPATH instead of DT_RUNPATH, for the libraries that the library needs in turn.
    link = [f"-L{lib}", "-lcrocoddyl", f"-Wl,-rpath,{lib},--disable-new-dtags"]
    target = compiled(what, sources, flags, link)
    try:
        return ctypes.CDLL(str(target))
    except OSError as error:
        raise Unavailable(f"{what.split(' (')[0]} cannot be loaded: {error}") from None
