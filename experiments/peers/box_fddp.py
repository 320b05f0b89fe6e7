"""Crocoddyl's box-FDDP for any problem of formulas without constraints but the limits of its controls.

CasADi writes the formulas and their derivatives as C, which is compiled together with the action model in
`formulas.cpp`; nothing calls Python between the first iteration and the last. Hessians of costs are projected stage by
stage, as lqrsim does it; second derivatives of the dynamics are not for this method. It stops where the decrease of the
cost that it expects, as a share of the cost, is below its tolerance.
"""

import ctypes
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim.errors import Array
from peers import formulas
from peers.common import Answer, at, casadi
from peers.fddp import linked
from peers.shooting import MAX_ITERATIONS, TOLERANCE, Moment

SOURCE = Path(__file__).with_name("formulas.cpp")


class BoxFddp:
    """Box-FDDP for problems that differ in parameters only.

    Args:
      problem: of the kind that is to be solved.

    Raises:
      Unavailable: CasADi, Crocoddyl, Eigen's headers or g++ is not installed, or they do not fit together.
      NotImplementedError: the problem has constraints, or something of it is no formula.
    """

    def __init__(self, problem: ls.Problem) -> None:
        if problem.constraints:
            raise NotImplementedError("constraints")
        with tempfile.TemporaryDirectory() as folder:
            source = Path(shutil.copy(SOURCE, folder))
            generated = _generate(problem, Path(folder))
            self._library = linked("Crocoddyl's model (some 15 seconds)", [source, generated])
        self._library.solve.restype = ctypes.c_int

    def solve(self, problem: ls.Problem, states: Array, controls: Array) -> tuple[Answer, list[Moment]]:
        """Solve from states (T+1, n) and controls (T, m); and how far it was after each iteration."""
        space, numbers = problem.control_coordinates, formulas.parameters(problem)
        states, controls = np.array(states, dtype=float, order="C"), np.array(controls, dtype=float, order="C")
        states[0] = problem.start
        cost, log = np.zeros(1), np.zeros((MAX_ITERATIONS + 1, 3))
        count = self._library.solve(
            states.shape[1], controls.shape[1], len(controls), at(numbers), len(numbers),
            at(np.array(space.low, dtype=float)), at(np.array(space.high, dtype=float)), at(states), at(controls),
            ctypes.c_double(TOLERANCE), MAX_ITERATIONS, at(cost), at(log),
        )  # fmt: skip
        moments = [
            Moment(number, seconds, value, 0.0 if together else np.inf)
            for number, (seconds, value, together) in enumerate(log[: abs(count)].tolist(), 1)
        ]
        return Answer(states, controls, float(cost[0]), abs(count), count > 0), moments


def _generate(problem: ls.Problem, folder: Path) -> Path:
    """Writes `generated.c` to the folder, with how much scratch memory its functions need."""
    ca, told = casadi(), formulas.formulas(problem)
    n, m = len(problem.dynamics.state_coordinates), len(problem.control_coordinates)
    x, u, p = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("p", len(formulas.parameters(problem)))
    made = []
    for name, cost in zip(("begin", "between"), told.costs, strict=False):
        z, after, value = ca.vertcat(x, u), told.step(x, u, p), cost(x, u, p)
        hessian, gradient = ca.hessian(value, z)
        slopes = [ca.jacobian(after, x), ca.jacobian(after, u), gradient, hessian]
        made.append(_dense(f"calc_{name}", [x, u, p], [after, value]))
        made.append(_dense(f"slopes_{name}", [x, u, p], slopes))
    value = told.costs[2](x, p)
    hessian, gradient = ca.hessian(value, x)
    made += [_dense("calc_end", [x, p], [value]), _dense("slopes_end", [x, p], [gradient, hessian])]
    generator = ca.CodeGenerator("generated.c")
    for function in made:
        generator.add(function)
    sizes = {
        "POINTERS": max(max(one.sz_arg(), one.sz_res()) for one in made),
        "INTEGERS": max(one.sz_iw() for one in made),
        "NUMBERS": max(one.sz_w() for one in made),
    }
    target = folder / "generated.c"
    target.write_text(
        generator.dump() + "".join(f"#define SCRATCH_{name} {size + 1}\n" for name, size in sizes.items()),
        encoding="utf-8",
    )
    return target


def _dense(name: str, arguments: list[Any], results: list[Any]) -> Any:
    ca = casadi()
    return ca.Function(name, arguments, [ca.densify(one) for one in results])
