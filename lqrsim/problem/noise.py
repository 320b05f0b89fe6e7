"""Process noise, which may depend on state and control: x' = g(x, u) + M(x, u) w, w ~ N(0, I).

The same object serves for planning, as `Problem(noise=...)`, and in trials, as one of the disturbances of `simulate`.

In planning, a quadratic cost-to-go v with Hessian S at t + 1 has the expectation

    E v(g + M w) = v(g) + 1/2 tr M'SM

so noise is an additional cost of the stage, which of the cost-to-go needs S alone. The backward pass has just computed
S; the forward pass uses S from the last backward pass. If dynamics and M are linear and costs quadratic, this is exact.
With constraints another S may be given, without their penalties; see `SolveRun.weigh_noise`.

With a risk theta, the expectation is replaced by (1/theta) log E exp(theta v(g + M w)). With d = S g + s, the gradient
of v at g, this is

    v(g) + theta/2 d'M C M'd - 1/(2 theta) log det(I - theta M'SM),    C = (I - theta M'SM)^-1

which exists if I - theta M'SM is positive definite. As theta goes to 0 it becomes the expectation. For theta above 0
the first two terms are v at g + y minus the cost of y, where y = theta M C M'd is the worst noise.

Gradients are exact. Hessians are Gauss-Newton approximations: second derivatives of M, and other parts that can be
negative, are left out.
"""

import copy
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, log1p, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import checked
from lqrsim.codegen import symbolic
from lqrsim.codegen.compiled_module import in_c_order, module_of
from lqrsim.codegen.sources import Source, source_of, text_source
from lqrsim.codegen.user_functions import (
    Term,
    axes_of,
    check_depends_on,
    level_of,
    name_of,
    numbers_of,
    raise_again,
    rows_of,
    with_derivatives,
)
from lqrsim.errors import Array, InputError, check_array, check_count, check_name, check_number, excerpt
from lqrsim.kernels import differences, user_functions
from lqrsim.kernels.declarations import M, N, W, noise_slopes, noise_values, outline, stack, zeros
from lqrsim.kernels.linear_algebra import copy as copied
from lqrsim.kernels.linear_algebra import fill
from lqrsim.kernels.model_functions import advance, cost_value
from lqrsim.kernels.riccati import limited_control
from lqrsim.problem.dynamics import Dynamics

MOST = 100  # largest number of independent normal numbers


@dataclass(frozen=True, eq=False)
class NoiseTerm(Term):
    """A noise, for one system.

    The source defines `noise_values(x, u, data, out)` and `noise_slopes(x, u, data, out, slopes)`; see
    `kernels/declarations.py`. The data are the parameters or the matrix, then the strength.

    Attributes:
      rows: the states that noise acts on directly. size: number of entries of w.
      active: the entries of (x, u), states before controls, that M depends on.
    """

    source: Source
    rows: tuple[int, ...]
    size: int
    active: tuple[int, ...]

    @functools.cached_property
    def code(self) -> Source:
        """The kernels below with this noise."""
        rows, active = len(self.rows), len(self.active)
        kernel = source_of(
            __name__, ROWS=self.rows, COUNT=rows, CONTIGUOUS=int(self.rows == tuple(range(rows))),
            COLUMNS=self.size, ACTIVE=self.active, ACTIVE_COUNT=active, PADDED_ACTIVE_COUNT=-4 * (active // -4),
        )  # fmt: skip
        return kernel.filled(noise_values=self.source, noise_slopes=self.source)


class Noise:
    """White noise on the states: each control period adds M(x, u) w to them, with w (k,) standard normal.

    For example, gusts that grow with the speed of a drone:

        def shaken(x, u, p):
            speed = sqrt(x.vx**2 + x.vy**2 + 1e-6)
            return [[0, 0], ..., [p.gust * speed, 0], ...]     # a row per state, an entry for each number in w

        ls.Noise(shaken, size=2, parameters={"gust": 0.02})

    M is in the units of the state, per control period, not per second. The effect of white noise in a period grows with
    the square root of dt: with half the dt, divide M by sqrt(2).

    Args:
      function: `function(x, u, p)` as in `Dynamics`; returns n rows of k entries. Derivatives of formulas follow; at
        other levels they are central differences. A constant M may be given as a matrix (n, k).
      size: k; not allowed with a matrix.
      parameters: name -> value, as in `Dynamics`.
      depends_on: names of the states and controls that M depends on, at other levels; all by default. The fewer, the
        faster.
      level: as in `Dynamics`.
    """

    def __init__(
        self,
        function: Callable[[Any, Any, Any], Any] | npt.ArrayLike,
        *,
        size: int | None = None,
        parameters: Mapping[str, float] | None = None,
        depends_on: Sequence[str] | None = None,
        level: str | None = None,
    ) -> None:
        self.parameters, self.strength = symbolic.check_parameters(parameters), 1.0
        self.matrix, self.level, self.depends_on = None, "symbolic", None
        if callable(function):
            self.level = level_of(function, level)
            if size is None:
                raise InputError("Noise: size: got none, want k, the number of entries of w and of each row of M")
            self.size = check_count("Noise: size", size, at_most=MOST)
            if depends_on is not None and self.level == "symbolic":
                raise InputError(f"Noise: depends_on: got {excerpt(depends_on)}, want none: it is derived")
            self.depends_on = check_depends_on("Noise", depends_on, "states and controls")
        else:
            self.matrix = check_array("Noise: function", function, (None, None))
            if not self.matrix.size or self.matrix.shape[1] > MOST:
                raise InputError(f"Noise: function: got shape {self.matrix.shape}, want (n, k), k from 1 to {MOST}")
            self.size = self.matrix.shape[1]
            others = {"size": size, "parameters": parameters, "depends_on": depends_on, "level": level}
            for name, value in others.items():
                if value is not None:
                    raise InputError(f"Noise: {name}: got {excerpt(value)} beside a matrix, want none")
        self.function: Any = function

    @property
    def name(self) -> str:
        return "a matrix" if self.matrix is not None else f"{name_of(self.function)}(x, u, p)"

    def __repr__(self) -> str:
        times = "" if self.strength == 1 else f", {self.strength:g} times as strong"
        return f"Noise({self.name}, size={self.size}{times})"

    def scaled(self, strength: float) -> "Noise":
        """The same noise with M multiplied by a number; strengths of several calls multiply. Nothing compiles again."""
        other = copy.copy(self)
        other.strength = self.strength * check_number("Noise: strength", strength, at_least=0.0)
        return other

    def with_parameters(self, **values: float) -> "Noise":
        """The same noise with other values of some parameters. Nothing is compiled again."""
        for name in values:
            check_name("parameters", name, self.parameters)
        other = copy.copy(self)
        other.parameters = self.parameters | symbolic.check_parameters(values)
        return other

    @checked
    def bind(self, dynamics: Dynamics) -> NoiseTerm:
        n = len(dynamics.state_coordinates)
        numbers = np.array([*self.parameters.values(), self.strength])
        if self.matrix is not None:
            if len(self.matrix) != n:
                raise InputError(f"Noise: function: got a matrix of {len(self.matrix)} rows, want {n}, one per state")
            kernel = source_of(__name__, COUNT=n, COLUMNS=self.size)
            source = kernel.filled(noise_values=(kernel, "constant_values"), noise_slopes=(kernel, "constant_slopes"))
            return NoiseTerm(source, np.append(self.matrix.ravel(), numbers), tuple(range(n)), self.size, ())
        names = dynamics.state_coordinates.names, dynamics.control_coordinates.names
        if self.level != "symbolic":
            active, unused = axes_of("Noise", self.depends_on, (*names[0], *names[1]))
            functions = with_derivatives(
                self.function,
                {"values": n * self.size, "entries": names[0], "columns": self.size, "unused": unused}, None, (),
                level=self.level, states=n, controls=len(names[1]), parameters=tuple(self.parameters),
            )  # fmt: skip
            user_source = source_of(user_functions, COLUMNS=self.size, STRENGTH=1 + len(self.parameters))
            source = source_of(differences, COLUMNS=self.size, ACTIVE=active).filled(noise_values=user_source)
            return NoiseTerm(source, numbers, tuple(range(n)), self.size, active, functions=functions)
        details = ("noise", *names, self.size, tuple(self.parameters))
        traced = symbolic.kept(self.function, details, lambda: self._trace(*names), source=str, rows=list, active=list)
        source = text_source(traced["source"], self.name)
        return NoiseTerm(source, numbers, tuple(traced["rows"]), self.size, tuple(traced["active"]))

    def _trace(self, states: Sequence[str], controls: Sequence[str]) -> dict[str, Any]:
        n = len(states)

        @functools.wraps(self.function)
        def listed(x: Any, u: Any, p: Any) -> list[Any]:
            return [entry for row in self._rows(self.function(x, u, p), n) for entry in row]

        entries, x, u = symbolic.trace(listed, states, controls, list(self.parameters))
        import sympy

        strength = sympy.Symbol(f"p{len(self.parameters)}", real=True)  # after the parameters, and without a name
        table = [[strength * entry for entry in entries[i * self.size : (i + 1) * self.size]] for i in range(n)]
        rows = [i for i, row in enumerate(table) if any(entry != 0 for entry in row)] or [0]
        z, used = [*x, *u], set().union(*(entry.free_symbols for entry in entries))
        active = [a for a, symbol in enumerate(z) if symbol in used]
        values = {f"out[{i}, {k}]": table[row][k] for i, row in enumerate(rows) for k in range(self.size)}
        slopes = {}
        for k, (i, row), (a, entry) in itertools.product(range(self.size), enumerate(rows), enumerate(active)):
            slopes[f"slopes[{k}, {i}, {a}]"] = table[row][k].diff(z[entry])
        write = functools.partial(symbolic.write_function, data="data", of=self.name)
        source = [write("noise_values", "x, u, data, out", assignments=values)]
        source.append(write("noise_slopes", "x, u, data, out, slopes", assignments=values | slopes))
        return {"source": "\n\n".join(source), "rows": rows, "active": active}

    def _rows(self, returned: Any, n: int) -> list[list[Any]]:
        wanted = f"{n} rows, one per state, of {self.size} entries"
        rows = rows_of(returned, n, wanted)
        for row in rows:
            if len(row) != self.size:
                raise InputError(f"got a row of {len(row)} entries, want {wanted}")
        return rows

    @checked
    def matrices(self, dynamics: Dynamics, states: npt.ArrayLike, controls: npt.ArrayLike) -> Array:
        """The matrices M (K, n, k) at states (K, n) and controls (K, m), in the states' units."""
        n, m = len(dynamics.state_coordinates), len(dynamics.control_coordinates)
        x = check_array("states", states, (None, n), infinite=True)
        u = check_array("controls", controls, (len(x), m), infinite=True)
        term = self.bind(dynamics)
        compact = np.zeros((len(x), len(term.rows), self.size))
        module = module_of(term.code, "noise", N=n, M=m)
        module.matrices_of(len(x), in_c_order(x), in_c_order(u), numbers_of(term), compact)
        raise_again(term.functions)
        full = np.zeros((len(x), n, self.size))
        full[:, list(term.rows)] = compact
        return full


# The kernels. The matrices are compact: they contain only the rows of M that are not zero everywhere, and only the
# entries of (x, u) that M depends on. Shapes: M (COUNT, COLUMNS), its derivatives by columns (COLUMNS, COUNT,
# PADDED_ACTIVE_COUNT), S (COUNT, COUNT). In formulas M is the noise matrix; in code M is the number of controls.
ROWS = (0,)  # the states that noise acts on directly
COUNT = 1  # their number
CONTIGUOUS = 0  # whether they are the first states, in order
COLUMNS = 1  # number of columns of M, and of entries of w
ACTIVE = (0,)  # entries of (x, u) that M depends on
ACTIVE_COUNT = 1  # their number
PADDED_ACTIVE_COUNT = 4  # this number, rounded up to a multiple of four for vector code


def constant_values(x, u, data, out):
    """Write a constant M: `data` has its entries, row by row, then the strength."""
    for i in range(COUNT):
        for k in range(COLUMNS):
            out[i, k] = data[COUNT * COLUMNS] * data[COLUMNS * i + k]


def constant_slopes(x, u, data, out, slopes):
    """Write a constant M, which has no derivatives."""
    constant_values(x, u, data, out)


def matrices_of(count, states, controls, data, out):
    """Write M (count, COUNT, COLUMNS) at states (count, N) and controls (count, M)."""
    for i in range(count):
        matrix_at(states[i], controls[i], data, out[i])


@outline
def matrix_at(x, u, data, out):
    """Write M at one state and control."""
    noise_values(x, u, data, out)


def noise_value(x, u, data, risk, next_step):
    """The expected cost of noise at (x, u); infinite unless I - theta M'SM is positive definite, theta = risk[0]."""
    values, MV, slope = stack(COUNT, COLUMNS), stack(COUNT, COLUMNS), stack(COUNT)
    factor, root, SM = stack(COLUMNS, COLUMNS), stack(COLUMNS), stack(COUNT, COLUMNS)
    S = stack(COUNT, COUNT)
    noise_values(x, u, data, values)
    noisy_block(next_step.hessian, S)
    times_hessian(S, values, SM)
    theta = risk[0]
    if theta == 0:
        return half_trace(values, SM)
    total, good = factor_of_risk(theta, values, SM, factor, root)
    if not good:
        return inf
    risk_columns(theta, factor, root, values, MV)
    next_slope(next_step, slope)
    return total + 0.5 * theta * square_along(MV, slope)


def noise_quadratic(x, u, data, risk, next_step, convex, stage):
    """Add the quadratic model of the expected cost to a stage at (x, u), and return its value.

    Args:
      risk: (3,); the second entry is written: 1 if the risk is too high. The Hessian is then made indefinite, so that
        the pass fails.
      convex: 1 to keep the added terms positive semidefinite even with a negative risk.
    """
    values, slopes = stack(COUNT, COLUMNS), zeros(COLUMNS, COUNT, PADDED_ACTIVE_COUNT)
    SM, factor, root = stack(COUNT, COLUMNS), stack(COLUMNS, COLUMNS), stack(COLUMNS)
    S = stack(COUNT, COUNT)
    noise_slopes(x, u, data, values, slopes)
    noisy_block(next_step.hessian, S)
    times_hessian(S, values, SM)
    theta = risk[0]
    if theta == 0:
        if ACTIVE_COUNT:
            add_trace_model(S, SM, slopes, stage)
        return half_trace(values, SM)
    total, good = factor_of_risk(theta, values, SM, factor, root)
    risk[1] = 0.0 if good else 1.0
    if not good:
        stage.hessian[W - 1, W - 1] = -inf
        return inf
    MV, slope = stack(COUNT, COLUMNS), stack(COUNT)
    risk_columns(theta, factor, root, values, MV)
    if ACTIVE_COUNT:
        times_hessian(S, MV, SM)  # from here on S M V
        risk_column_slopes(theta, factor, root, slopes)
        add_trace_model(S, SM, slopes, stage)
    next_slope(next_step, slope)
    add_risk(theta, next_step, MV, slopes, slope, convex, stage)
    return total + 0.5 * theta * square_along(MV, slope)


def noisy_costs(count, steps, start, policy, model, draws, costs):
    """Write the costs (count,) of rollouts of a policy with given noise: draws (count steps, COLUMNS), run by run."""
    x, u, arrived, values = stack(N), stack(M), stack(N), stack(COUNT, COLUMNS)
    for run in range(count):
        copied(start, N, x)
        total = cost_value(x, u, 0, model.initial)
        for t in range(steps):
            limited_control(policy.gain[t], policy.offset[t], x, model.limits, u)
            total += cost_value(x, u, t, model.stage)
            advance(x, u, model, model.dt, arrived)
            noise_values(x, u, model.noise.data, values)
            for i in range(COUNT):
                for k in range(COLUMNS):
                    arrived[i if CONTIGUOUS else ROWS[i]] += values[i, k] * draws[run * steps + t, k]
            copied(arrived, N, x)
        costs[run] = total + cost_value(x, u, steps, model.final)


def noisy_block(S, compact):
    """Copy the rows and columns of S that noise acts on, once, because looking them up takes longer than the sums."""
    for i in range(COUNT):
        row = i if CONTIGUOUS else ROWS[i]
        for j in range(COUNT):
            compact[i, j] = S[row, j if CONTIGUOUS else ROWS[j]]


def times_hessian(S, values, SM):
    """Write S M, (COUNT, COLUMNS)."""
    for i in range(COUNT):
        fill(SM[i], COLUMNS, 0.0)
        for j in range(COUNT):
            for k in range(COLUMNS):
                SM[i, k] += S[i, j] * values[j, k]


def half_trace(values, SM):
    """1/2 tr M'SM, given S M."""
    total = 0.0
    for i in range(COUNT):
        for k in range(COLUMNS):
            total += values[i, k] * SM[i, k]
    return 0.5 * total


def add_trace_model(S, SM, slopes, stage):
    """Add the model of 1/2 tr M'SM: of columns m_i and Jacobians J_i (slopes), with S M, sum J_i'S J_i and
    sum J_i'S m_i.
    """
    line, curve = stack(PADDED_ACTIVE_COUNT), zeros(ACTIVE_COUNT, PADDED_ACTIVE_COUNT)
    slope = zeros(PADDED_ACTIVE_COUNT)
    for k in range(COLUMNS):
        for i in range(COUNT):  # row by row, which stays in registers
            factor = SM[i, k]
            for b in range(PADDED_ACTIVE_COUNT):
                line[b] = 0.0
                slope[b] += slopes[k, i, b] * factor
            for j in range(COUNT):
                factor = S[i, j]
                for b in range(PADDED_ACTIVE_COUNT):
                    line[b] += factor * slopes[k, j, b]
            for a in range(ACTIVE_COUNT):
                factor = slopes[k, i, a]
                for b in range(PADDED_ACTIVE_COUNT):
                    curve[a, b] += factor * line[b]
    for a in range(ACTIVE_COUNT):
        entry = ACTIVE[a]
        stage.gradient[entry] += slope[a]
        for b in range(ACTIVE_COUNT):
            stage.hessian[entry, ACTIVE[b]] += curve[a, b]


def factor_of_risk(theta, values, SM, factor, root):
    """Factor I - theta M'SM = L D L'; return -1/(2 theta) log det, and whether the matrix is positive definite.

    Pivots are stored as their distance from 1, so that no digits are lost if theta is small.

    Args:
      factor: (COLUMNS, COLUMNS), gets I - L below the diagonal.
      root: (COLUMNS,), gets the reciprocal square roots of D.
    """
    X, total = stack(COLUMNS, COLUMNS), 0.0
    for k in range(COLUMNS):
        for j in range(COLUMNS):
            X[k, j] = 0.0
            for i in range(COUNT):
                X[k, j] += values[i, k] * SM[i, j]
    for k in range(COLUMNS):
        pivot = 1 - theta * X[k, k]
        if not pivot > 0:
            return total, False
        total -= log1p(-theta * X[k, k]) / (2 * theta)
        root[k] = 1 / sqrt(pivot)
        for i in range(k + 1, COLUMNS):
            factor[i, k] = theta * X[i, k] / pivot
            for j in range(k + 1, COLUMNS):
                X[i, j] += factor[i, k] * X[k, j]
    return total, True


def risk_columns(theta, factor, root, values, MV):
    """Write M V with V V' = C: columns with the covariance of noise under the risk."""
    for k in range(COLUMNS):
        for i in range(COUNT):
            MV[i, k] = values[i, k]
            for j in range(k):
                MV[i, k] += factor[k, j] * MV[i, j]
    for k in range(COLUMNS):
        for i in range(COUNT):
            MV[i, k] *= root[k]


def risk_column_slopes(theta, factor, root, slopes):
    """Convert the derivatives of the columns of M, in place, to derivatives of M V with fixed V."""
    for k in range(COLUMNS):
        for j in range(k):
            for i in range(COUNT):
                for a in range(PADDED_ACTIVE_COUNT):
                    slopes[k, i, a] += factor[k, j] * slopes[j, i, a]
    for k in range(COLUMNS):
        for i in range(COUNT):
            for a in range(PADDED_ACTIVE_COUNT):
                slopes[k, i, a] *= root[k]


def next_slope(next_step, slope):
    """Write the gradient (COUNT,) of the cost-to-go at the next state, in the states that noise acts on."""
    for i in range(COUNT):
        row = i if CONTIGUOUS else ROWS[i]
        total = next_step.gradient[row]
        for j in range(N):
            total += next_step.hessian[row, j] * next_step.arrived[j]
        slope[i] = total


def square_along(MV, slope):
    """d'M C M'd, given M V and d."""
    total = 0.0
    for k in range(COLUMNS):
        along = 0.0
        for i in range(COUNT):
            along += MV[i, k] * slope[i]
        total += along * along
    return total


def add_risk(theta, next_step, MV, slopes, slope, convex, stage):
    """Add the model of theta/2 d'M C M'd: its gradient, and theta D'D of its Hessian, D the Jacobian of V'M'd.

    D is evaluated at the worst noise y, for both M and d. With a negative risk it is the Jacobian for d alone, so that
    the sum with the cost-to-go's Hessian stays positive semidefinite.
    """
    S, jacobian, slopes_along, line = next_step.hessian, next_step.jacobian, stack(COLUMNS, W), stack(W)
    pulled, steered, along, compact = stack(COUNT), stack(N), stack(COLUMNS), stack(COUNT, COUNT)
    for k in range(COLUMNS):
        total = 0.0
        for i in range(COUNT):
            total += MV[i, k] * slope[i]
        along[k] = total
        fill(steered, N, 0.0)
        for i in range(COUNT):
            state, factor = i if CONTIGUOUS else ROWS[i], MV[i, k]
            for j in range(N):
                steered[j] += S[state, j] * factor
        fill(line, W, 0.0)
        for j in range(N):
            factor = steered[j]
            for a in range(W):
                line[a] += jacobian[j, a] * factor
        for a in range(W):
            slopes_along[k, a] = line[a]
            stage.gradient[a] += theta * total * line[a]
    if ACTIVE_COUNT:
        noisy_block(S, compact)
        for i in range(COUNT):  # the gradient at g + y
            pulled[i] = slope[i]
            for j in range(COUNT):
                for k in range(COLUMNS):
                    pulled[i] += theta * along[k] * compact[i, j] * MV[j, k]
        for k in range(COLUMNS):
            for a in range(ACTIVE_COUNT):
                pull, entry = 0.0, ACTIVE[a]
                for i in range(COUNT):
                    pull += slopes[k, i, a] * pulled[i]
                stage.gradient[entry] += theta * along[k] * pull
                if theta > 0:
                    slopes_along[k, entry] += pull
    if theta > 0 or convex == 0:
        for a in range(W):  # row by row, which stays in registers
            fill(line, W, 0.0)
            for k in range(COLUMNS):
                factor = theta * slopes_along[k, a]
                for b in range(W):
                    line[b] += factor * slopes_along[k, b]
            for b in range(W):
                stage.hessian[a, b] += line[b]
