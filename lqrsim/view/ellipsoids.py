"""Ellipsoids along a plan: where a run is predicted to be, or where the total cost is near its least."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array
from lqrsim.results.solution import Solution

SIGMAS = 2.0  # of the ellipsoids
COST_ABOVE_LEAST = SIGMAS**2 / 2  # the total cost on those of the cost, above its least
PREDICTED = f"predicted: {SIGMAS:g} sigma, 95 % in each direction"
OF_COST = f"{SIGMAS:g} sigma of the cost: total ≤ least + {COST_ABOVE_LEAST:g}"

WIDEST = 0.2  # half axis of the largest that is drawn, in lengths of the plan's extent: a wider one hides the picture
APART = 0.8  # from one to the next, in half axes


@dataclass(frozen=True)
class Ellipsoids:
    """Along a plan, at some of its knots or all.

    Attributes:
      centres: (k, d). covariances: (k, d, d).
      end: half axis in metres at which they are not drawn any more; None where all are.
    """

    centres: Array
    covariances: Array
    end: float | None = None

    @classmethod
    def predicted(cls, centres: Array, covariances: Array) -> "Ellipsoids":
        """Those of a tube about positions (T+1, d), up to where it gets too wide for a picture of them."""
        largest = float(np.linalg.norm(np.ptp(centres, axis=0))) * WIDEST
        wide = SIGMAS * np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0)) > largest
        last = int(np.argmax(wide)) if wide.any() else len(wide)
        return cls(centres[:last], covariances[:last], largest if wide.any() else None)

    @classmethod
    def of_cost(cls, solution: Solution, states: tuple[int, ...]) -> "Ellipsoids":
        """Where the total cost is at most its least plus `COST_ABOVE_LEAST`, at each knot, as seen in d of the states.

        What is an ellipsoid of the whole state casts one on them, with that block of the covariance.

        Raises:
          InputError: the solution has no total cost.
        """
        total, chosen = solution.total_cost, list(states)
        return cls(total.minimizer()[:, chosen], total.covariance()[:, chosen][:, :, chosen])

    @property
    def label(self) -> str:
        """What a legend says of a predicted tube."""
        return PREDICTED if self.end is None else f"{PREDICTED}; drawn up to {self.end:.2g} m"

    def axes(self) -> tuple[Array, Array]:
        """Half axes (k, d) and rotations (k, d, d), whose columns are their directions."""
        covariances = 0.5 * (self.covariances + np.swapaxes(self.covariances, 1, 2))
        variances, rotations = np.linalg.eigh(covariances)
        rotations[:, :, 0] *= np.linalg.det(rotations)[:, None]
        return SIGMAS * np.sqrt(np.maximum(variances, 0.0)), rotations

    def seen_in(self, onto: Array) -> "Ellipsoids":
        """Their shadows on a plane, in its coordinates: onto (2, d) has the directions of its axes."""
        return Ellipsoids(self.centres @ onto.T, onto @ self.covariances @ onto.T, self.end)

    def outlines(self, points: int = 48) -> Array:
        """The outlines (k, points, 2) of ellipses."""
        half_axes, rotations = self.axes()
        around = np.linspace(0, 2 * np.pi, points, endpoint=False)
        circle = np.stack([np.cos(around), np.sin(around)], axis=-1)
        return self.centres[:, None, :] + np.einsum("kij,kj,pj->kpi", rotations, half_axes, circle)

    def spread(self, most: int) -> npt.NDArray[np.int64]:
        """Which of them overlap to a tube of about the same depth everywhere: the first, the last, some in between."""
        half_axes = self.axes()[0].mean(axis=1)
        chosen = [0] if len(self.centres) else []
        for knot in range(1, len(self.centres)):
            before = chosen[-1]
            moved = np.linalg.norm(self.centres[knot] - self.centres[before])
            grown = abs(half_axes[knot] - half_axes[before])
            if moved + grown >= APART * half_axes[knot] or knot == len(self.centres) - 1:
                chosen.append(knot)
        places = np.linspace(0, len(chosen) - 1, min(most, len(chosen))).astype(np.int64)
        return np.array(chosen, dtype=np.int64)[places]
