"""From pixels to positions: the middle of what is seen in each view, and the place that the views agree on."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError
from lqrsim.view.cameras import Camera, measuring_of
from lqrsim.view.decorative_geoms import RIM

FEWEST_PIXELS = 20  # pixels of what is tracked; the middle of fewer is not known well enough
LEAST_SHARE = 0.5  # of the mark that must be seen; the rest may be outside of the picture
# A pixel's green minus its red or blue, whichever is more: from which fraction on it counts, and where it is all mark.
# Video blurs the mark's edge, and leaves a tinge of other overlays in what is around it.
EMPTY, FULL = 0.2, 0.9


def mask_centre(mask: npt.NDArray[np.bool_]) -> Array:
    """The mean pixel (2,) of a mask (height, width), column and row; NaN if it has too few."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()]) + 0.5 if len(rows) >= FEWEST_PIXELS else np.full(2, np.nan)


def marker_centre(image: npt.NDArray[np.uint8], radius: float) -> Array:
    """The pixel (2,), column and row, in the middle of the green mark of that radius in pixels; NaN if it is hidden."""
    red, green, blue = np.moveaxis(image.astype(np.int16), 2, 0)
    share = ((green - np.maximum(red, blue)) / 255 - EMPTY) / (FULL - EMPTY)
    rows, columns = np.nonzero(share > 0.5)
    if not len(rows):
        return np.full(2, np.nan)
    # The median ignores strays; then the mean within the rim, outside of which nothing is the mark's.
    centre, reach = np.array([np.median(columns), np.median(rows)]) + 0.5, 0.9 * RIM * radius + 1
    area = 0.0
    for _ in range(3):
        (left, up), (right, down) = np.maximum(centre - reach, 0).astype(int), (centre + reach + 1).astype(int)
        part = np.clip(share[up:down, left:right], 0, 1)
        x, y = np.arange(left, left + part.shape[1]) + 0.5, np.arange(up, up + part.shape[0]) + 0.5
        weights = part * ((x - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2 <= reach**2)
        area = weights.sum()
        if area < LEAST_SHARE * np.pi * radius**2:
            return np.full(2, np.nan)
        centre = np.array([weights.sum(axis=0) @ x, weights.sum(axis=1) @ y]) / area
    return centre


def triangulate(views: Sequence[Camera], measured: npt.ArrayLike, plane: str) -> tuple[Array, Array]:
    """Positions (N, d) that fit best what N frames' views measured (N, views, 2), and how far apart views are (N,).

    Args:
      plane: the axes of the positions: "xyz", or those of a robot in the plane; where it is across does not matter.

    Raises:
      InputError: the views do not see all directions.
    """
    size, columns = len(plane), ["xyz".index(axis) for axis in plane]
    axes = np.vstack([view.axes for view in views])[:, columns] if views else np.zeros((0, size))
    if np.linalg.matrix_rank(axes) < size:
        names = " and ".join(view.name for view in views) or "none"
        raise InputError(f"views: got {names}, want {' and '.join(measuring_of(plane))} to tell where a robot is")
    values = np.asarray(measured, dtype=np.float64).reshape(-1, len(axes))
    seen = np.linalg.norm(axes, axis=1) > 1e-6  # a direction out of the plane says nothing
    axes, values = axes[seen], values[:, seen]
    positions = values @ np.linalg.pinv(axes).T
    # Two views that measure the same direction with a difference d leave half of it to either.
    return positions, np.sqrt(2) * np.linalg.norm(values - positions @ axes.T, axis=1)
