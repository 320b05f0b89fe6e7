"""What a filter gets to know of a state: all of it, some states, or any linear or symbolic function of them."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lqrsim.codegen import symbolic
from lqrsim.codegen.sources import Source, text_source
from lqrsim.codegen.user_functions import check_signature, name_of
from lqrsim.errors import Array, InputError, check_array, check_items, check_name, excerpt
from lqrsim.results.coordinates import Coordinates

# None for all states, names of states, a matrix (Y, n), or a function h(x, u, p) of SymPy symbols.
Sensors = None | Sequence[str] | npt.ArrayLike | Callable[[Any, Any, Any], Any]


class Sensor(NamedTuple):
    """What is measured of a state.

    Attributes:
      source: `measure(x, data, out)` and `measure_slope(x, data, out)`; see `kernels/declarations.py`.
      data: what these take. size: Y, how many numbers there are. names: what messages call them.
    """

    source: Source
    data: Array
    size: int
    names: tuple[str, ...]


def sensor_of(sensors: Sensors, space: Coordinates) -> Sensor:
    """The sensor that is meant.

    Raises:
      InputError: there is no such state, a matrix of another shape, or a function that depends on what is no state.
    """
    if sensors is None:
        sensors = space.names
    if callable(sensors):
        return _symbolic(sensors, len(space))
    if isinstance(sensors, str):
        raise InputError(f"sensors: got {excerpt(sensors)}, want a tuple of names: ({excerpt(sensors)},)")
    listed: Any = sensors
    if isinstance(listed, (list, tuple)) and all(isinstance(one, str) for one in listed):
        names = check_items("sensors", listed, str, f"a tuple of names of states, of {', '.join(space.names)}")
        if not names or len(set(names)) < len(names):
            raise InputError(f"sensors: got {excerpt(listed)}, want at least one state, and each once")
        chosen = [space.names.index(check_name("sensors", name, space.names)) for name in names]
        source = "def measure(x, data, out):\n" + "".join(f"    out[{i}] = x[{j}]\n" for i, j in enumerate(chosen))
        source += "def measure_slope(x, data, out):\n"
        source += "".join(f"    out[{i}, {j}] = 1.0\n" for i, j in enumerate(chosen))
        return Sensor(text_source(source, "sensors"), np.zeros(1), len(names), names)
    matrix = check_array("sensors", listed, (None, len(space)))
    if not len(matrix):
        raise InputError("sensors: got no rows, want a matrix with one for each number that is measured")
    rows = len(matrix)
    source = f"def measure(x, data, out):\n    for i in range({rows}):\n        out[i] = 0.0\n"
    source += "        for j in range(N):\n            out[i] += data[N * i + j] * x[j]\n"
    source += f"def measure_slope(x, data, out):\n    for i in range({rows}):\n        for j in range(N):\n"
    source += "            out[i, j] = data[N * i + j]\n"
    return Sensor(
        text_source(source, "sensors"), matrix.ravel().copy(), rows, tuple(f"row {i} of sensors" for i in range(rows))
    )


def _symbolic(function: Callable[[Any, Any, Any], Any], states: int) -> Sensor:
    """The sensor of a formula of the state."""
    check_signature(function, ("x", "u", "p"))
    of = name_of(function)

    def make() -> dict[str, Any]:
        values, x, _ = symbolic.trace(function, states, 0, [])
        slopes = {(i, j): value.diff(xj) for i, value in enumerate(values) for j, xj in enumerate(x)}
        slopes = {f"out[{i}, {j}]": slope for (i, j), slope in slopes.items() if slope != 0}
        assigned = {f"out[{i}]": value for i, value in enumerate(values)}
        source = symbolic.write_function("measure", "x, data, out", "data", assigned, of=of)
        source += symbolic.write_function("measure_slope", "x, data, out", "data", slopes, of=of)
        return {"source": source, "size": len(values)}

    made = symbolic.kept(function, ("sensor", states), make, source=str, size=int)
    size = int(made["size"])
    return Sensor(text_source(str(made["source"]), of), np.zeros(1), size, tuple(f"{of}[{i}]" for i in range(size)))
