"""From pixels to positions: the centre of the tracked object in each view, and the position that fits all views."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError
from lqrsim.view.cameras import Camera, measuring
from lqrsim.view.decorative_geoms import RIM

FEWEST_PIXELS = 20  # of the tracked object; the centre of fewer is too uncertain
LEAST_SHARE = 0.5  # of the mark that must be visible; the rest may be outside the picture
# Green minus the larger of red and blue: below EMPTY a pixel does not count, from FULL on it is all mark. Video blurs
# the edge of the mark, and mixes the colours of overlays into its surroundings.
EMPTY, FULL = 0.2, 0.9


def mask_centre(mask: npt.NDArray[np.bool_]) -> Array:
    """The mean pixel (2,) of a mask (height, width), column and row; NaN if it has too few pixels."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()]) + 0.5 if len(rows) >= FEWEST_PIXELS else np.full(2, np.nan)


def marker_centre(image: npt.NDArray[np.uint8], radius: float) -> Array:
    """The centre (2,), column and row, of the green mark of this radius in pixels; NaN if it is hidden."""
    red, green, blue = np.moveaxis(image.astype(np.int16), 2, 0)
    share = ((green - np.maximum(red, blue)) / 255 - EMPTY) / (FULL - EMPTY)
    rows, columns = np.nonzero(share > 0.5)
    if not len(rows):
        return np.full(2, np.nan)
    # The median ignores stray pixels; then the mean is taken within the rim of the mark.
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
    """Positions (N, d) that best fit measurements (N, views, 2) of N frames, and the disagreement of the views, (N,).

    Args:
      plane: the axes of the positions: "xyz", or the two of a planar robot.

    Raises:
      InputError: the views do not measure all axes.
    """
    size, columns = len(plane), ["xyz".index(axis) for axis in plane]
    axes = np.vstack([view.axes for view in views])[:, columns] if views else np.zeros((0, size))
    if np.linalg.matrix_rank(axes) < size:
        names = " and ".join(view.name for view in views) or "none"
        raise InputError(f"views: got {names}, want {' and '.join(measuring(plane))} to measure positions")
    values = np.asarray(measured, dtype=np.float64).reshape(-1, len(axes))
    seen = np.linalg.norm(axes, axis=1) > 1e-6  # leaves out directions across the plane
    axes, values = axes[seen], values[:, seen]
    positions = values @ np.linalg.pinv(axes).T
    # Two views that differ by d in a direction each have a residual of d / 2.
    return positions, np.sqrt(2) * np.linalg.norm(values - positions @ axes.T, axis=1)
