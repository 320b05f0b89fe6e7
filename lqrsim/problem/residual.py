"""Numbers that depend on the states, such as distances or errors, of which costs and constraints are made, by kernels.

`CostTerm.of_residual` adds a loss of each, and `ConstraintTerm.of_residual` says which values are feasible.
"""

from dataclasses import dataclass

from lqrsim.codegen.sources import Source
from lqrsim.codegen.user_functions import Term
from lqrsim.kernels.declarations import N, loss, places, places_jacobian, stack
from lqrsim.kernels.linear_algebra import clear


@dataclass(frozen=True, eq=False)
class Residual(Term):
    """Numbers that depend on the states, for one system.

    The source defines `residual(x, data, out)`, which writes one number per row, and `residual_jacobian(x, data, out,
    slopes)`, which writes them, and their nonzero derivatives in the states (rows, N) to an array of zeros.

    Attributes:
      parts: the name of each row.
      leading_states: number of states, from the first one on, that the numbers depend on.
    """

    parts: tuple[str, ...]
    leading_states: int

    @property
    def rows(self) -> int:
        return len(self.parts)

    def filling(self, kernel: Source) -> Source:
        """A kernel of costs or constraints whose open function `places` is filled with the residual."""
        return kernel.filled(places=(self.code, "residual"), places_jacobian=(self.code, "residual_jacobian"))


# The kernels. `places` and `places_jacobian` are the residual, with whose data `data` begins. Of a constraint it has,
# from AT on, the numbers below, and the table of what is subtracted from the rows, step by step; the last ones hold
# from their step on.
ROWS = 1  # number of rows
LEADING_STATES = 1  # number of states, from the first on, that the residual depends on
FIRST_STEP = 0  # the first step at which a cost acts: 1 for what cannot change at a given start
AT = 0
# From there on: numbers of steps in the table, and of columns; then the column of each row.
STEPS, EACH, COLUMNS = 0, 1, 2


def value(x, u, t, data):
    """The cost."""
    total = 0.0
    if t >= FIRST_STEP:
        residual = stack(ROWS)
        places(x, data, residual)
        for row in range(ROWS):
            cost, _, _ = loss(residual[row], row, data)
            total += cost
    return total


def derivatives(x, u, t, data, hessian, gradient):
    """Add the Hessian and the gradient, and return the cost. The residual's own curvature is left out."""
    total = 0.0
    if t >= FIRST_STEP:
        residual, moves = stack(ROWS), stack(ROWS, N)
        clear(moves, ROWS, N)
        places_jacobian(x, data, residual, moves)
        for row in range(ROWS):
            cost, slope, curvature = loss(residual[row], row, data)
            total += cost
            if slope != 0 or curvature != 0:
                for i in range(LEADING_STATES):
                    gradient[i] += slope * moves[row, i]
                    for j in range(LEADING_STATES):
                        hessian[i, j] += curvature * moves[row, i] * moves[row, j]
    return total


def row_value(at, u, t, row, data):
    """The row minus its number, given the whole residual."""
    steps, each, column = int(data[AT + STEPS]), int(data[AT + EACH]), int(data[AT + COLUMNS + row])
    return at[row] - data[AT + COLUMNS + ROWS + min(t, steps - 1) * each + column]


def row_slope(at, jacobian, t, row, data, gradient):
    """Add its gradient, given the whole residual and its derivatives in the states."""
    for i in range(N):
        gradient[i] += jacobian[row, i]
