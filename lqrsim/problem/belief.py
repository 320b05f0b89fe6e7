"""Belief-space planning: what the robot knows of its state, as the state of dynamics.

A belief is the mean m (n,) of the robot's state and the lower triangular root L of its covariance, L L'. It moves by an
extended Kalman filter under maximum-likelihood readings (van den Berg, Patil and Alterovitz, 2012): the mean by the
robot's dynamics F, the covariance by

    L- = chol(A L L' A' + M M'),    A = dF/dm    and for each reading    L+ = L C,    C C' = I - v v' / s,

where v = L' h, s = r^2 + v'v, h is the gradient of the reading at F and r its standard deviation there. C has a closed
form without subtractions or inverses. Readings move the mean by v / sqrt(s) times L and a standard normal number, which
is the noise of the belief. Everything is formulas, with exact first and second derivatives.
"""

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain, product
from statistics import NormalDist
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, Positive, checked
from lqrsim.codegen import symbolic
from lqrsim.codegen.compiled_module import in_c_order, module_of
from lqrsim.codegen.edge_pushing import Operations, hessian_of, jacobian_of
from lqrsim.codegen.sources import text_source
from lqrsim.codegen.user_functions import level_of, name_of, rows_of
from lqrsim.errors import (
    Array,
    InputError,
    check_array,
    check_items,
    check_name,
    check_symmetric,
    excerpt,
    free_name,
    real,
    shaped,
    vectors_of,
)  # fmt: skip
from lqrsim.problem.dynamics import MOST_STEPS, Dynamics
from lqrsim.problem.formulas import SymbolicConstraint
from lqrsim.problem.noise import Noise

# Of the compiled filter, over trials. What they call is outlined: a trial gets the same bits in any batch.
_LOOPS = """
def corrected(count, p, states, controls, readings, out):
    for k in range(count):
        correct(states[k], controls[k], p, readings[k], out[k])


def read(count, p, states, out):
    for k in range(count):
        sense(states[k], p, out[k])
"""


class NoisySensors:
    """Sensors whose noise depends on the state, as formulas: light, distances to beacons, a field of view.

        def beacon(x, u, p):  # the distance to a beacon, measured the better the nearer it is
            distance = sqrt((x.x - p.x) ** 2 + (x.y - p.y) ** 2 + p.height**2)
            return [(distance, p.noise * distance)]

    Args:
      function: `function(x, u, p)` of SymPy symbols, as in `Dynamics`, that does not depend on u; returns for each
        reading a pair: what is read in this state, and the standard deviation of its noise, which must be positive.
        Noises are independent. Read an angle by its sine and cosine, which do not count turns.
      parameters: name -> value, as in `Dynamics`.
      delay: control periods after which readings arrive in a run. The filter takes them at their time; a plan takes
        them as if they came at once.
    """

    @checked
    def __init__(
        self, function: Callable[[Any, Any, Any], Any], *, parameters: Mapping[str, float] | None = None,
        delay: Annotated[int, Bounds(at_least=0, at_most=1000)] = 0,
    ) -> None:  # fmt: skip
        if level_of(function, None) == "compiled":
            raise InputError(f"NoisySensors: got the numba function {name_of(function)}, want one of SymPy symbols")
        self.function, self.parameters, self.delay = function, symbolic.check_parameters(parameters), delay


class _Step(NamedTuple):
    """A step of a belief in operations: their names."""

    operations: Operations
    x: list[Any]
    u: list[Any]
    after: list[Any]  # mean and root, (N,)
    columns: list[list[Any]]  # of the noise of the uncertain means, Y of them


class Belief(Dynamics):
    """The dynamics of a belief: a map of the mean and of the root of the covariance, for `Problem(dynamics=...)`.

    The states are those of the robot, which are now means, followed by the root's lower triangle, row by row:
    `root_x_x`, `root_y_x`, `root_y_y`, .... Row i has the unit of state i. A variance is the sum of the squares of its
    row, so a `QuadraticCost` with the same weight on a state and on its row is the expectation of that cost of the
    robot's state; see `uncertainty`. Obstacles and limits act on the mean; see `chance_constraint`.

    Args:
      dynamics: the robot's, stated as a formula: a rate or a map.
      dt: control period in s.
      noise: noise on the robot's state in each period, a formula or a matrix.
      sensors: what is read at the end of each period.
      averaged: whether the noise of a reading is its mean over the belief, rather than that at the mean: wherever the
        noise changes over the covariance, the filter is too sure without it.
      uncertain: the states of the robot with a covariance; by default all. The others are taken as known: in a run they
        are the measured ones. With position and velocity alone a quadrotor has 12 + 21 states in place of 90.

    Attributes:
      size: n, the number of the robot's states. rows: the numbers of the uncertain states. known: those of the others.
    """

    @checked
    def __init__(
        self, dynamics: Dynamics, *, dt: Positive, noise: Noise, sensors: NoisySensors, averaged: bool = False,
        uncertain: Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        for field, level in (("dynamics", dynamics.level), ("noise", noise.level)):
            if level != "symbolic" or dynamics.by_mujoco:
                raise InputError(f"Belief: {field}: got a function of arrays, want a formula")
        dynamics.check_period(dt)
        noise.bind(dynamics)  # raises an exception if it does not fit
        self.robot, self.process, self.sensors, self.averaged = dynamics, noise, sensors, averaged
        self.size = len(dynamics.state_coordinates)
        space, controls = dynamics.state_coordinates, dynamics.control_coordinates
        names, units = space.names, space.units
        chosen = names if uncertain is None else check_items("Belief: uncertain", uncertain, str, "names of states")
        if not chosen or len({*chosen}) < len(chosen):
            raise InputError(f"Belief: uncertain: got {excerpt(chosen)}, want at least one state, each at most once")
        self.rows = sorted(names.index(check_name("Belief: uncertain", name, names)) for name in chosen)
        self.known = [i for i in range(len(names)) if i not in self.rows]
        pairs = [(i, j) for i in self.rows for j in self.rows if j <= i]
        super().__init__(
            _key(dynamics, dt, noise, sensors, averaged, self.rows),
            states=dict(zip(names, units, strict=True)) | {f"root_{names[i]}_{names[j]}": units[i] for i, j in pairs},
            controls=dict(zip(controls.names, controls.units, strict=True)),
            parameters=_together(dynamics.parameters, noise.parameters, sensors.parameters),
            disturbances=dynamics.constants, control_limits=(controls.low, controls.high), period=dt,
            position=[names[i] for i in space.position], plane=space.plane if len(space.position) == 2 else "",
            offset=space.offset, angles=[names[i] for i in space.angles],
            rotation_vectors=[names[i : i + 3] for i in space.rotation_vectors],
        )  # fmt: skip

    def state(self, mean: npt.ArrayLike, covariance: npt.ArrayLike) -> Array:
        """The belief (N,) of a mean (n,) and a covariance (n, n), or deviations (n,), above 0 for uncertain states."""
        n, rows = self.size, self.rows
        numbers = real("covariance", covariance)
        if numbers.ndim == 1:
            numbers = np.diag(check_array("covariance", numbers, (n,)))
            if (numbers < 0).any():
                raise InputError(f"covariance: got {numbers.min():g}, want standard deviations >= 0")
            numbers = numbers**2
        full = check_symmetric("covariance", check_array("covariance", numbers, (n, n)))
        try:
            root = np.linalg.cholesky(full[np.ix_(rows, rows)])
        except np.linalg.LinAlgError:
            raise InputError("covariance: got one that is not positive definite, want every deviation > 0") from None
        return np.concatenate([check_array("mean", mean, (n,)), root[np.tril_indices(len(rows))]])

    def covariance(self, states: npt.ArrayLike) -> Array:
        """The covariances (..., n, n) of beliefs (..., N), zero in states that are known."""
        n, rows = self.size, np.array(self.rows)
        beliefs = vectors_of("states", states, len(self.state_coordinates))
        root = np.zeros((*beliefs.shape[:-1], n, n))
        i, j = np.tril_indices(len(rows))
        root[..., rows[i], rows[j]] = beliefs[..., n:]
        return root @ root.swapaxes(-1, -2)

    def uncertainty(self, weights: Mapping[str, float]) -> dict[str, float]:
        """The weights of a `QuadraticCost`, by entry of the root, that is half the weighted sum of some variances.

        Args:
          weights: name of a state of the robot -> weight of its variance.
        """
        names, entries = [self.robot.state_coordinates.names[i] for i in self.rows], {}
        for name, weight in weights.items():
            before = names.index(check_name("weights", name, names)) + 1
            entries |= {f"root_{name}_{other}": weight for other in names[:before]}
        return entries

    @property
    def innovations(self) -> Noise:
        """The noise of the belief, for `Problem(noise=...)`: by how much readings will move the mean."""
        return _Innovations(self)

    @checked
    def chance_constraint(
        self,
        function: Callable[[Any, Any, Any], Any],
        *,
        chance: Annotated[float, Bounds(above=0.0, below=0.5)],
        parameters: Mapping[str, float] | None = None,
        name: str | None = None,
    ) -> SymbolicConstraint:
        """The constraint that `function(x, u, p) >= 0` in the robot's state, but for a chance at each step.

        The function is linearised about the mean, so that it is normally distributed: it must be larger than the
        standard deviation along its gradient times a quantile.

        Args:
          function: as in `SymbolicConstraint`, with x the robot's state.
          chance: largest chance that an entry of it is negative, below a half.
        """
        values = symbolic.check_parameters(parameters)
        n, rows, names = self.size, self.rows, tuple(self.robot.state_coordinates.names)
        quantile, deviations = -NormalDist().inv_cdf(chance), free_name("deviations", values)

        @functools.wraps(function)
        def margin(x: Any, u: Any, p: Any) -> list[Any] | None:
            from sympy import sqrt, sympify

            if (returned := function(symbolic.Vector(x[:n], names), u, p)) is None:
                return None  # which is refused
            root, margins = _lower(x[n:], len(rows)), []
            for entry in symbolic.entries_of(returned):
                slopes = [sympify(entry).diff(x[i]) for i in rows]
                spread = sum(sum(slopes[i] * root[i][j] for i in range(j, len(rows))) ** 2 for j in range(len(rows)))
                margins.append(entry - getattr(p, deviations) * sqrt(spread))
            return margins

        return SymbolicConstraint(margin, parameters={**values, deviations: quantile}, name=name)

    def corrected(self, states: Array, controls: Array, readings: Array) -> Array:
        """The beliefs (K, N) of the filter one period later, after readings (K, Y) at its end; NaN are lost ones."""
        size = len(self.state_coordinates)
        states = shaped("states", states, (None, size))
        controls = shaped("controls", controls, (len(states), len(self.control_coordinates)))
        readings = shaped("readings", readings, (len(states), self.readings))
        lost = np.isnan(readings)
        return self._each("corrected", size, states, controls, np.hstack([np.where(lost, 0.0, readings), 1.0 - lost]))

    def read(self, states: Array) -> tuple[Array, Array]:
        """The exact readings (K, Y) in states (K, n) of the robot, and the standard deviations of their noise."""
        entries = self._each("read", 2 * self.readings, shaped("states", states, (None, self.size)))
        return entries[:, ::2], entries[:, 1::2]

    @property
    def readings(self) -> int:
        """Y, the number of readings."""
        return self._made["readings"]

    def _each(self, name: str, size: int, *given: Array) -> Array:
        out, n = np.empty((len(given[0]), size)), len(self.state_coordinates)
        module = module_of(text_source(self._made["filter"], f"filter of {self.name}"), self.name, N=n)
        getattr(module, name)(len(out), self._numbers(), *map(in_c_order, given), out)
        return out

    @functools.cached_property
    def _made(self) -> dict[str, Any]:
        details = ("filter", self.state_coordinates.names, tuple(self.parameters), *self.constants.items())
        return symbolic.kept(self.f, details, self._trace_filter, filter=str, readings=int)

    def _trace(self) -> str:
        step = self._step()
        n, of = len(step.x), f"{self.name}(x, u, p)"
        values = {f"out[{i}]": entry for i, entry in enumerate(step.after)}
        value = _written("rate", "x, u, p, out", values, step, of)
        for (i, j), slope in jacobian_of(step.operations, step.after, [*step.x, *step.u]).items():
            values[f"fx[{i}, {j}]" if j < n else f"fu[{i}, {j - n}]"] = slope
        return f"{value}\n\n{_written('rate_jacobian', 'x, u, p, out, fx, fu', values, step, of)}"

    def _weighted_hessian(self) -> tuple[list[tuple[Any, Any]], dict[tuple[int, int], Any]] | None:
        step = self._step()
        weights = symbolic.weights(len(step.after))
        hessian = hessian_of(step.operations, step.after, weights, [*step.x, *step.u], most=MOST_STEPS)
        return None if hessian is None else (_needed(step, hessian[1].values()), hessian[1])

    def _trace_filter(self) -> dict[str, Any]:
        step, of = self._step(read=True), f"{self.name}(x, u, p)"
        values = {f"out[{i}]": entry for i, entry in enumerate(step.after)}
        pairs, _, _ = self._sensing()
        sense = {f"out[{i}]": entry for i, entry in enumerate(pairs)}
        correct = _written("correct", "x, u, p, w, out", values, step, of)
        sense = symbolic.write_function("sense", "x, p, out", "p", sense, of=of)
        text = "\n\n".join([f"@outline\n{correct}", f"@outline\n{sense}", _LOOPS])
        return {"filter": text, "readings": len(pairs) // 2}

    def _sensing(self) -> tuple[list[Any], list[Any], list[Any]]:
        """The formulas of readings and their deviations, in turn, of the robot's state."""
        function = self.sensors.function

        @functools.wraps(function)
        def listed(x: Any, u: Any, p: Any) -> list[Any]:
            returned, wanted = function(x, u, p), "pairs of a reading and the standard deviation of its noise"
            pairs = rows_of(returned, None, wanted)
            if not pairs or any(len(pair) != 2 for pair in pairs):
                raise InputError(f"got {returned}, want {wanted}, at least one")
            return [entry for pair in pairs for entry in pair]

        entries, x, u = self._formulas(listed)
        if set().union(*(entry.free_symbols for entry in entries)) & set(u):
            raise InputError(f"{name_of(function)}(x, u, p): got a reading that depends on u, want one of the state")
        return entries, x, u

    def _formulas(self, function: Callable[..., Any]) -> tuple[list[Any], list[Any], list[Any]]:
        names = self.robot.state_coordinates.names, self.control_coordinates.names
        return symbolic.trace(function, *names, list(self.parameters), constants=self.constants)

    def _step(self, *, read: bool = False) -> _Step:
        """A step, in operations; with `read`, of a filter: w are its readings, then 1 for each that is not lost."""
        import sympy

        size, rows, operations = self.size, self.rows, Operations()
        name, n = operations.name, len(rows)
        x = [sympy.Symbol(f"x{i}", real=True) for i in range(len(self.state_coordinates))]
        rates, means, u = self._formulas(self.robot.f)
        process = self.process
        if process.matrix is None:
            entries, _, _ = self._formulas(lambda x, u, p: [*chain(*process._rows(process.function(x, u, p), size))])
        else:
            numbers = process.matrix.ravel().tolist()
            entries = [sympy.Float(number) if number else sympy.Integer(0) for number in numbers]
        strength = sympy.Float(process.strength) if process.strength != 1 else sympy.Integer(1)
        shaken = [[name(strength * entry) for entry in entries[i * process.size :][: process.size]] for i in rows]
        mean, slopes = _step_jacobian(operations, rates, means, rows, self.robot, float(self.period or 0))
        root = _lower(x[size:], n)
        turned = [[name(sum(slopes[i][k] * root[k][j] for k in range(j, n))) for j in range(n)] for i in range(n)]
        root = _cholesky(operations, [a + b for a, b in zip(turned, shaken, strict=True)], n)
        pairs, _, _ = self._sensing()
        at = dict(zip(means, mean, strict=True))
        columns, now, before = [], mean, root
        for row, (reading, deviation) in enumerate(zip(pairs[::2], pairs[1::2], strict=True)):
            slope = [name(sympy.sympify(reading.diff(means[i])).xreplace(at)) for i in rows]
            variance = self._variance(operations, deviation, means, mean, before)
            arrived = sympy.Symbol(f"w{len(pairs) // 2 + row}", real=True) if read else sympy.Integer(1)
            seen = [name(arrived * sum(slope[i] * root[i][j] for i in range(j, n))) for j in range(n)]
            sums = [variance]  # of the squares from the last to each
            for entry in reversed(seen):
                sums.insert(0, name(sums[0] + entry**2))
            column = [name(sum(root[i][j] * seen[j] for j in range(i + 1))) for i in range(n)]
            columns.append([name(entry / sympy.sqrt(sums[0])) for entry in column])
            if read:
                off = name(reading.xreplace(at))
                off += sum(s * (now[i] - mean[i]) for s, i in zip(slope, rows, strict=True))
                factor = name((sympy.Symbol(f"w{row}", real=True) - off) / sums[0])
                now = list(now)
                for i, entry in zip(rows, column, strict=True):
                    now[i] = name(now[i] + entry * factor)
            root = _root_after_reading(operations, root, seen, sums)
        return _Step(operations, x, u, [*now, *(entry for row in root for entry in row)], columns)

    def _variance(
        self, operations: Operations, deviation: Any, means: list[Any], mean: list[Any], root: list[list[Any]]
    ) -> Any:
        """The variance of a reading of this deviation, in the belief before readings.

        An average is that of two points on each column of the root, as of an unscented filter: exact where the variance
        is a polynomial of degree 3, and always positive. Only columns that reach a state on which it depends count.
        """
        import sympy

        name = operations.name
        rows, symbols = self.rows, deviation.free_symbols if self.averaged else set[Any]()
        depends = [i for i, row in enumerate(rows) if means[row] in symbols]
        at = dict(zip(means, mean, strict=True))
        if not depends:
            return name(deviation.xreplace(at) ** 2)
        count, total = depends[-1] + 1, sympy.Integer(0)
        for j, side in product(range(count), (1, -1)):
            off = side * sympy.sqrt(sympy.Integer(count)).evalf()
            moved = {means[rows[i]]: name(mean[rows[i]] + off * root[i][j]) for i in depends if j <= i}
            total += name(deviation.xreplace(at | moved) ** 2)
        return name(total / (2 * count))


class _Innovations(Noise):
    """How readings move the mean of a belief: a column for each reading."""

    def __init__(self, belief: Belief) -> None:
        super().__init__(belief.f, size=belief.readings, parameters=belief.parameters)
        self._belief = belief

    def _trace(self, states: Any, controls: Any) -> dict[str, Any]:
        import sympy

        step, belief = self._belief._step(), self._belief
        strength = sympy.Symbol(f"p{len(self.parameters)}", real=True)
        rows, name = belief.rows, step.operations.name
        flat = [name(strength * entry) for column in step.columns for entry in column]
        slopes = jacobian_of(step.operations, flat, [*step.x, *step.u])
        active = sorted({j for _, j in slopes})
        values = {f"out[{i}, {k}]": flat[k * len(rows) + i] for i in range(len(rows)) for k in range(self.size)}
        changes = values.copy()
        for (at, j), slope in slopes.items():
            changes[f"slopes[{at // len(rows)}, {at % len(rows)}, {active.index(j)}]"] = slope
        write = functools.partial(_written, step=step, of=f"innovations of {belief.name}", data="data")
        source = [write("noise_values", "x, u, data, out", values)]
        source.append(write("noise_slopes", "x, u, data, out, slopes", changes))
        return {"source": "\n\n".join(source), "rows": rows, "active": active}


def _key(
    dynamics: Dynamics, dt: float, noise: Noise, sensors: NoisySensors, averaged: bool, rows: list[int]
) -> Callable[[Any, Any, Any], Any]:
    """A function that refers to all that a belief is made of, by which its formulas are kept; nothing calls it."""
    shaken = noise.function if noise.matrix is None else noise.matrix
    steps = dynamics.f, dynamics.discrete, dynamics.substeps, float(dt)
    parts = *steps, noise.strength, shaken, sensors.function, averaged, rows

    def belief(x: Any, u: Any, p: Any) -> Any:
        return parts

    belief.__name__ = belief.__qualname__ = f"belief of {name_of(dynamics.f)}"
    return belief


def _together(*given: Mapping[str, float]) -> dict[str, float]:
    """The parameters of all. Raises InputError if two have one name and not one value."""
    parameters: dict[str, float] = {}
    for mapping in given:
        for name, value in mapping.items():
            if (first := parameters.setdefault(name, value)) != value:
                raise InputError(f"Belief: parameters: got {name!r} twice, {first:g} and {value:g}, want one")
    return parameters


def _written(name: str, arguments: str, values: dict[str, Any], step: _Step, of: str, data: str = "p") -> str:
    """Source of a function of the operations that these values need."""
    return symbolic.write_function(name, arguments, data, values, of=of, steps=_needed(step, values.values()))


def _needed(step: _Step, values: Iterable[Any]) -> list[tuple[Any, Any]]:
    """The operations that these values need, in order."""
    needed, steps = {symbol for value in values for symbol in value.free_symbols}, []
    for symbol, operation in reversed(step.operations.steps):
        if symbol in needed:
            needed |= operation.free_symbols
            steps.append((symbol, operation))
    return steps[::-1]


def _lower(entries: Any, n: int) -> list[list[Any]]:
    return [list(entries[i * (i + 1) // 2 :][: i + 1]) for i in range(n)]


def _step_jacobian(
    operations: Operations, rates: list[Any], x: list[Any], rows: list[int], robot: Dynamics, dt: float
) -> tuple[list[Any], list[list[Any]]]:
    """The robot's state after a period, (n,), and the Jacobian of some states by these: those of `Dynamics.step`."""
    import sympy

    name, moved = operations.name, {*rows}  # with those that they move in turn
    while more := {i for i, rate in enumerate(rates) if i not in moved and rate.free_symbols & {x[j] for j in moved}}:
        moved |= more
    jacobian = {i: {k: slope for k in moved if (slope := sympy.sympify(rates[i].diff(x[k]))) != 0} for i in moved}
    identity = {i: [sympy.Integer(int(i == row)) for row in rows] for i in moved}
    states, columns = range(len(x)), range(len(rows))

    def at(state: list[Any], slopes: dict[int, list[Any]]) -> tuple[list[Any], dict[int, list[Any]]]:
        place = dict(zip(x, state, strict=True))
        partials = {i: {k: name(slope.xreplace(place)) for k, slope in row.items()} for i, row in jacobian.items()}
        changes = {
            i: [name(sum(slope * slopes[k][j] for k, slope in row.items())) for j in columns]
            for i, row in partials.items()
        }
        return [name(rate.xreplace(place)) for rate in rates], changes

    if robot.discrete:
        state, slopes = at(x, identity)
        return state, [slopes[row] for row in rows]
    state, slopes, h = x, identity, sympy.Float(dt / robot.substeps)
    for _ in range(robot.substeps):
        stages: list[tuple[list[Any], dict[int, list[Any]]]] = []
        for factor in (0, h / 2, h / 2, h):
            shifted, slopes_shifted = state, slopes
            if factor:
                k, K = stages[-1]
                shifted = [name(a + factor * b) for a, b in zip(state, k, strict=True)]
                slopes_shifted = {i: [name(slopes[i][j] + factor * K[i][j]) for j in columns] for i in moved}
            stages.append(at(shifted, slopes_shifted))
        weights = (h / 6, h / 3, h / 3, h / 6)
        weighed = list(zip(weights, stages, strict=True))
        state = [name(state[i] + sum(w * k[i] for w, (k, _) in weighed)) for i in states]
        slopes = {i: [name(slopes[i][j] + sum(w * K[i][j] for w, (_, K) in weighed)) for j in columns] for i in moved}
    return state, [slopes[row] for row in rows]


def _cholesky(operations: Operations, B: list[list[Any]], n: int) -> list[list[Any]]:
    """The lower triangular root of B B'."""
    import sympy

    name, L = operations.name, list[list[Any]]()
    for i in range(n):
        row: list[Any] = []
        for j in range(i + 1):
            product = sum(a * b for a, b in zip(B[i], B[j], strict=True))
            remainder = name(product - sum(row[k] * (L[j][k] if j < i else row[k]) for k in range(j)))
            row.append(name(remainder / L[j][j]) if j < i else name(sympy.sqrt(remainder)))
        L.append(row)
    return L


def _root_after_reading(operations: Operations, L: list[list[Any]], v: list[Any], sums: list[Any]) -> list[list[Any]]:
    """L C, with the lower triangular C of C C' = I - v v' / sums[0], for the sums of r^2 and v_j^2 from each j on.

    C_jj = sqrt(sums_j+1 / sums_j), and below it C_ij = -v_i v_j / sqrt(sums_j sums_j+1).
    """
    import sympy

    name, n = operations.name, len(v)
    after = [list[Any](row) for row in L]
    for j in range(n):
        diagonal = name(sympy.sqrt(name(sums[j + 1] / sums[j])))
        factor = name(v[j] / name(sums[j] * diagonal))
        for i in range(j, n):
            below = name(sum(L[i][k] * v[k] for k in range(j + 1, i + 1)))
            after[i][j] = name(L[i][j] * diagonal - factor * below)
    return after
