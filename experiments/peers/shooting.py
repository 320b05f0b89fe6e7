"""IPOPT and Fatrop for any problem of formulas, through CasADi, with all that the problem asks for.

Direct multiple shooting, as a careful user of CasADi writes it: the states and controls of all knots are variables,
knot by knot, the Runge-Kutta steps and the given start are equality constraints, limits of controls and bounds of
states are bounds of the variables. The step and the costs are SX functions, mapped over the knots; derivatives are
CasADi's, exact and sparse, the Hessian of the Lagrangian among them. CasADi either evaluates the expanded problem in
its virtual machine, or writes it as C, which is compiled with -O3 -march=native (some 15 seconds, kept on disk).

Both stop at their own tolerance of 1e-8 or after 3,000 iterations, IPOPT's default, and are otherwise as they come,
IPOPT with MUMPS, on one thread. Times are processor times. A solver is made for one problem and serves all that differ
in parameters only.
"""

import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.process import SIGNALS
from peers import formulas
from peers.common import FLAGS, Answer, casadi, compiled, line
from peers.truth import rollout

TOLERANCE, MAX_ITERATIONS = 1e-8, 3000


@dataclass(frozen=True)
class Moment:
    """How far a solver had come.

    Attributes:
      iterations: how many it had made. seconds: processor time since the call.
      cost, violation: of the plan at that time; the violation is the largest, that of the dynamics among them.
    """

    iterations: int
    seconds: float
    cost: float
    violation: float


class Shooting:
    """One of the two solvers.

    Args:
      problem: of the kind that is to be solved.
      plugin: "ipopt" or "fatrop".
      compile: to C and with g++, for speed.
      **settings: options of IPOPT or FATROP, in place of these.

    Raises:
      Unavailable: CasADi is not installed, or g++ where it is needed.
      NotImplementedError: something of the problem is no formula.
    """

    def __init__(
        self, problem: ls.Problem, plugin: Literal["ipopt", "fatrop"], *, compile: bool, **settings: Any
    ) -> None:
        nlp, self._equal = _nlp(problem, formulas.formulas(problem))
        self._plugin: str = plugin
        self._nlp = nlp
        self._limits = {"lbg": 0.0, "ubg": casadi().DM(np.where(self._equal, 0.0, np.inf))}
        settings = {"print_level": 0, "max_iter": MAX_ITERATIONS, "tol": TOLERANCE, **settings}
        self._options: dict[str, Any] = {"print_time": False, "show_eval_warnings": False, plugin: settings}
        if plugin == "ipopt":
            # Bounds are kept exactly, and not to 1e-8 as IPOPT has them inside.
            settings |= {"sb": "yes", "honor_original_bounds": "yes"}
        else:
            self._options |= {"structure_detection": "auto", "equality": self._equal.tolist()}
        if compile:
            self._source = str(_library(plugin, nlp, self._options))
        else:
            self._source, self._options["expand"] = nlp, True
        self._solver = self._made({})
        self._values = casadi().Function("values", [nlp["x"], nlp["p"]], [nlp["f"], nlp["g"]])

    def from_hover(self, problem: ls.Problem) -> Answer:
        """Solve from the trajectory of the nominal control, of either robot."""
        controls = np.tile(problem.nominal_control, (problem.steps, 1))
        return self.solve(problem, rollout(problem, controls), controls)

    def from_line(self, problem: ls.Problem) -> Answer:
        """Solve from states on the line from start to goal and the nominal control, which do not belong together."""
        return self.solve(problem, *line(problem))

    def solve(self, problem: ls.Problem, states: Array, controls: Array) -> Answer:
        """Solve from states (T+1, n) and controls (T, m), whether or not they belong together."""
        found = self._run(self._solver, problem, states, controls)
        stats = self._solver.stats()
        states, controls = self._unpacked(problem, found["x"].full().ravel())
        n = len(problem.dynamics.state_coordinates)
        return Answer(
            states[:, :n].copy(),
            controls,
            cost=float(found["f"]),
            iterations=stats["iter_count"],
            # No more than its acceptable level is not what was asked for.
            converged=bool(stats["success"]) and "Acceptable" not in str(stats["return_status"]),
            duration=None if problem.duration is None else float(states[-1, n]),
        )

    def first(
        self, problem: ls.Problem, states: Array, controls: Array, iterations: int, enough: Callable[[Moment], bool]
    ) -> Moment | None:
        """When a solve of so many iterations from there had first come far enough, by solving again; None if never.

        IPOPT shows its plan as it goes. Fatrop does not: it is stopped after one iteration, after two, and so on.
        """
        moments = self._shown if self._plugin == "ipopt" else self._stopped
        return next((moment for moment in moments(problem, states, controls, iterations) if enough(moment)), None)

    def _shown(self, problem: ls.Problem, states: Array, controls: Array, iterations: int) -> Iterator[Moment]:
        shown: list[tuple[float, Array]] = []
        watch = _watch(self._nlp, shown)
        solver = self._made({}, iteration_callback=watch)
        begun = time.process_time()
        self._run(solver, problem, states, controls)
        # Counted back from the last: IPOPT shows its plan once more wherever it begins to restore feasibility.
        for count, (when, plan) in enumerate(shown, iterations + 1 - len(shown)):
            if count > 0:
                yield Moment(count, when - begun, *self._worth(problem, plan))

    def _stopped(self, problem: ls.Problem, states: Array, controls: Array, iterations: int) -> Iterator[Moment]:
        for count in range(1, iterations + 1):
            # As Fatrop counts, in its last iteration it only looks at what it has.
            solver = self._made({"max_iter": count - 1})
            begun = time.process_time()
            plan = self._run(solver, problem, states, controls)["x"].full().ravel()
            yield Moment(count, time.process_time() - begun, *self._worth(problem, plan))

    def worth(self, problem: ls.Problem, states: Array, controls: Array) -> tuple[float, float]:
        """Cost and largest violation of a plan, the dynamics included, as the solver is told of them.

        A free duration is the stated one.
        """
        return self._worth(problem, _packed(_stated(problem, states), controls))

    def _made(self, settings: dict[str, Any], **options: Any) -> Any:
        """CasADi's function that solves the problem, with other settings and options than its own."""
        own = {**self._options, self._plugin: self._options[self._plugin] | settings, **options}
        return casadi().nlpsol("solver", self._plugin, self._source, own)

    def _run(self, solver: Any, problem: ls.Problem, states: Array, controls: Array) -> Any:
        guess = _packed(_stated(problem, states), controls)
        low, high = _bounds(problem)
        with _signals_wait():
            return solver(x0=guess, p=formulas.parameters(problem), lbx=low, ubx=high, **self._limits)

    def _unpacked(self, problem: ls.Problem, values: Array) -> tuple[Array, Array]:
        n = _stage_states(problem)
        stages = values[:-n].reshape(problem.steps, -1)
        return np.vstack([stages[:, :n], values[-n:]]), stages[:, n:].copy()

    def _worth(self, problem: ls.Problem, values: Array) -> tuple[float, float]:
        """Cost and violation."""
        cost, g = self._values(values, formulas.parameters(problem))
        rows = g.full().ravel()
        low, high = _bounds(problem)
        missed = [np.where(self._equal, np.abs(rows), -rows), low - values, values - high]
        return float(cost), float(max(0.0, *(one.max(initial=0.0) for one in missed)))


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Ctrl-C comes when this is over: CasADi would take it for a failure of the solver, and go on."""
    came: list[int] = []
    # Others end the process without asking Python.
    before = {number: handler for number in SIGNALS if callable(handler := signal.getsignal(number))}
    for number in before:
        signal.signal(number, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in came[:1]:
            signal.raise_signal(number)


def _stage_states(problem: ls.Problem) -> int:
    """How many states a knot has, a free duration among them."""
    return len(problem.dynamics.state_coordinates) + (problem.duration is not None)


def _stated(problem: ls.Problem, states: Array) -> Array:
    """States (T+1, n) with the stated duration, if that is free."""
    if problem.duration is None:
        return states
    return np.column_stack([states, np.full(len(states), problem.steps * problem.dt)])


def _packed(states: Array, controls: Array) -> Array:
    """As the variables are: knot by knot, and the last state."""
    return np.append(np.hstack([states[:-1], controls]), states[-1])


def _bounds(problem: ls.Problem) -> tuple[Array, Array]:
    """Of all variables."""
    sides = []
    for states, controls in zip(
        formulas.state_bounds(problem), (problem.control_coordinates.low, problem.control_coordinates.high), strict=True
    ):
        sides.append(_packed(states, np.tile(controls, (problem.steps, 1))))
    return sides[0], sides[1]


def _nlp(problem: ls.Problem, told: formulas.Formulas) -> tuple[dict[str, Any], Array]:
    """Variables x0, u0, x1, u1 ... xT; constraints knot by knot, each step before what else is asked of its knot.

    Besides, which of the constraints are equalities.
    """
    ca, steps = casadi(), problem.steps
    n, m = _stage_states(problem), len(problem.control_coordinates)
    given = len(problem.dynamics.state_coordinates)  # of the start: all but a free duration
    stages, last = ca.MX.sym("w", n + m, steps), ca.MX.sym("last", n)
    p = ca.MX.sym("p", len(formulas.parameters(problem)))
    x, u = stages[:n, :], stages[n:, :]
    every = ca.repmat(p, 1, steps)
    gaps = ca.horzcat(x[:, 1:], last) - told.step.map(steps)(x, u, every)
    begin, between, end = told.costs
    cost = begin(x[:, 0], u[:, 0], p) + end(last, p)
    first, rows, final = told.rows
    g = [gaps[:, 0], x[:given, 0] - p[:given], first(x[:, 0], u[:, 0], p)]
    equal = [True] * (n + given) + told.equalities[0]
    if steps > 1:
        rest = ca.repmat(p, 1, steps - 1)
        cost += ca.sum2(between.map(steps - 1)(x[:, 1:], u[:, 1:], rest))
        kept = rows.map(steps - 1)(x[:, 1:], u[:, 1:], rest) if rows.numel_out(0) else ca.MX(0, steps - 1)
        g.append(ca.vec(ca.vertcat(gaps[:, 1:], kept)))
        equal += ([True] * n + told.equalities[1]) * (steps - 1)
    g.append(final(last, p))
    equal += told.equalities[2]
    return {"x": ca.vertcat(ca.vec(stages), last), "p": p, "f": cost, "g": ca.vertcat(*g)}, np.array(equal)


def _library(plugin: str, nlp: dict[str, Any], options: dict[str, Any]) -> Path:
    """What the plugin needs of the problem, compiled from C; kept on disk."""
    name = f"{plugin}.c"
    with tempfile.TemporaryDirectory() as folder:
        # CasADi writes to the current folder only.
        here = Path.cwd()
        os.chdir(folder)
        try:
            casadi().nlpsol("solver", plugin, nlp, options).generate_dependencies(name)
        finally:
            os.chdir(here)
        return compiled(f"{plugin}'s problem (some 15 seconds)", [Path(folder) / name], FLAGS)


def _watch(nlp: dict[str, Any], shown: list[tuple[float, Array]]) -> Any:
    """What IPOPT calls at the start and after each iteration: it notes when that was, and the variables."""
    ca, variables, rows = casadi(), nlp["x"].numel(), nlp["g"].numel()
    sizes = {"f": 1, "x": variables, "lam_x": variables, "g": rows, "lam_g": rows}

    class Watch(ca.Callback):
        def __init__(self) -> None:
            super().__init__()
            self.construct("watch", {})

        def get_n_in(self) -> int:
            return ca.nlpsol_n_out()

        def get_n_out(self) -> int:
            return 1

        def get_name_in(self, i: int) -> str:
            return ca.nlpsol_out(i)

        def get_sparsity_in(self, i: int) -> Any:
            return ca.Sparsity.dense(sizes[name]) if (name := ca.nlpsol_out(i)) in sizes else ca.Sparsity(0, 0)

        def eval(self, arguments: Any) -> list[int]:
            shown.append((time.process_time(), arguments[0].full().ravel()))
            return [0]

    return Watch()
