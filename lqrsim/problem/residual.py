"""Numbers that depend on the states, such as distances or errors, of which costs and constraints are made.

`CostTerm.of_residual` adds a loss of each, and `ConstraintTerm.of_residual` says which values are feasible.
"""

from dataclasses import dataclass

from lqrsim.codegen.sources import Source
from lqrsim.codegen.user_functions import Term


@dataclass(frozen=True, eq=False)
class Residual(Term):
    """Numbers that depend on the states, made for one system: the source to compile, and its data.

    The source defines `residual(x, data, out)`, which writes one number per row, and `residual_jacobian(x, data, out,
    slopes)`, which writes them, and their nonzero derivatives in the states (rows, N) to an array of zeros.

    Attributes:
      parts: the name of each row.
      moved: number of states, from the first one on, that the numbers depend on.
    """

    parts: tuple[str, ...]
    moved: int

    @property
    def rows(self) -> int:
        return len(self.parts)

    def filling(self, kernel: Source) -> Source:
        """A kernel of costs or constraints whose open function `places` is filled with the residual."""
        return kernel.filled(places=(self.code, "residual"), places_jacobian=(self.code, "residual_jacobian"))
