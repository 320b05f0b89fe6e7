"""Ellipsoids along a plan, from a predicted tube, or from a total cost near its minimum."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array
from lqrsim.results.solution import Solution

SIGMAS = 2.0  # standard deviations at which ellipsoids are drawn
COST_ABOVE_LEAST = SIGMAS**2 / 2  # total cost above its minimum, on an ellipsoid of the cost
PREDICTED = f"predicted: {SIGMAS:g} sigma, 95 % in each direction"
OF_COST = f"{SIGMAS:g} sigma of the cost: total ≤ least + {COST_ABOVE_LEAST:g}"

WIDEST = 0.2  # largest half axis that is drawn, relative to the extent of the plan; larger ones hide the picture
STAYS = 1e-3  # m; a plan of less extent stays in place, and its tube hides nothing
APART = 0.8  # distance between neighbours, in half axes


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """Ellipsoids at the knots of a plan, or at some of them: centres (k, d) and covariances (k, d, d)."""

    centres: Array
    covariances: Array
    cut_at: float | None = None  # half axis in m at which the tube is cut off; None if it is whole

    @classmethod
    def predicted(cls, centres: Array, covariances: Array) -> "Ellipsoids":
        """The ellipsoids of a tube about positions (T+1, d), up to the first that is too wide for a picture."""
        extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
        largest = WIDEST * extent if extent > STAYS else np.inf
        wide = SIGMAS * np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0)) > largest
        last = int(np.argmax(wide)) if wide.any() else len(wide)
        return cls(centres[:last], covariances[:last], largest if wide.any() else None)

    @classmethod
    def of_cost(cls, solution: Solution, states: tuple[int, ...]) -> "Ellipsoids":
        """The states whose total cost is at most `COST_ABOVE_LEAST` above its minimum, projected onto d of the states.

        The projection of an ellipsoid has the corresponding block of its covariance.
        """
        total, chosen = solution.total_cost, list(states)
        return cls(total.minimizer()[:, chosen], total.covariance()[:, chosen][:, :, chosen])

    @property
    def label(self) -> str:
        """The label of a predicted tube in a legend."""
        return PREDICTED if self.cut_at is None else f"{PREDICTED}; drawn up to half axes of {self.cut_at:.2g} m"

    def axes(self) -> tuple[Array, Array]:
        """Half axes (k, d), and rotations (k, d, d) whose columns are their directions."""
        covariances = 0.5 * (self.covariances + np.swapaxes(self.covariances, 1, 2))
        variances, rotations = np.linalg.eigh(covariances)
        rotations[:, :, 0] *= np.linalg.det(rotations)[:, None]
        return SIGMAS * np.sqrt(np.maximum(variances, 0.0)), rotations

    def projected(self, onto: Array) -> "Ellipsoids":
        """Their projections onto a plane, whose axes are the rows of `onto` (2, d)."""
        return Ellipsoids(self.centres @ onto.T, onto @ self.covariances @ onto.T, self.cut_at)

    def outlines(self) -> Array:
        """Outlines (k, 48, 2) of ellipses."""
        half_axes, rotations = self.axes()
        around = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        circle = np.stack([np.cos(around), np.sin(around)], axis=-1)
        return self.centres[:, None, :] + np.einsum("kij,kj,pj->kpi", rotations, half_axes, circle)

    def overlapping(self, knots: npt.NDArray[np.int64], most: int) -> npt.NDArray[np.int64]:
        """Knots whose ellipsoids overlap to a tube of even depth: the first, the last and some in between."""
        half_axes = self.axes()[0].mean(axis=1)
        chosen = list(knots[:1])
        for knot in knots[1:]:
            before = chosen[-1]
            moved = np.linalg.norm(self.centres[knot] - self.centres[before])
            grown = abs(half_axes[knot] - half_axes[before])
            if moved + grown >= APART * half_axes[knot] or knot == knots[-1]:
                chosen.append(knot)
        places = np.linspace(0, len(chosen) - 1, min(most, len(chosen))).astype(np.int64)
        return np.array(chosen, dtype=np.int64)[places]
