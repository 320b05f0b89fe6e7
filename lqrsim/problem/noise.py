"""Process noise, which may depend on state and control: x' = g(x, u) + M(x, u) w, w ~ N(0, I).

The same object serves for planning, as `Problem(noise=...)`, and in trials, as one of the disturbances of `simulate`.
"""

import copy
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
from lqrsim.kernels import noise as noise_kernel
from lqrsim.problem.dynamics import Dynamics

MOST = 100  # largest number of independent normal numbers


@dataclass(frozen=True, eq=False)
class NoiseTerm(Term):
    """A noise, for one system.

    The source defines `noise_values(x, u, data, out)` and `noise_slopes(x, u, data, out, slopes)`; see
    `kernels/declarations.py`. The data are the parameters or the matrix, then the strength.

    Attributes:
      rows: the states that noise acts on at once. size: number of entries of w.
      active: the entries of (x, u), states before controls, that M depends on.
    """

    source: Source
    rows: tuple[int, ...]
    size: int
    active: tuple[int, ...]

    @functools.cached_property
    def code(self) -> Source:
        """The source of `kernels/noise.py` with this noise."""
        rows, active = len(self.rows), len(self.active)
        kernel = source_of(
            noise_kernel, ROWS=self.rows, COUNT=rows, CONTIGUOUS=int(self.rows == tuple(range(rows))),
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
            kernel = source_of(noise_kernel, COUNT=n, COLUMNS=self.size)
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
