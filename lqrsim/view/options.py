"""The contents and layout of a picture: overlays, qualities and views by name; parts of runs, and panes in a part.

This module imports nothing heavy, so that the command line starts fast.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, get_args

Overlay = Literal["plan", "ghost", "trace", "forces", "measured", "tube", "cost_tube", "funnel", "caption"]
Quality = Literal["draft", "standard", "publication"]

ALL_OVERLAYS: tuple[Overlay, ...] = get_args(Overlay)
# Tubes about one plan hide each other, so the tube of the cost and the funnel are not drawn by default.
OVERLAYS: tuple[Overlay, ...] = tuple(name for name in ALL_OVERLAYS if name not in ("cost_tube", "funnel"))
CALIBRATED = ("top", "side")
VIEWS = ("overview", "chase", *CALIBRATED)


INSETS_SHARE = 0.4  # fraction of a run's part for its insets


@dataclass(frozen=True)
class Box:
    """A rectangle of the picture, in pixels from the upper left corner."""

    left: int
    top: int
    width: int
    height: int

    @property
    def aspect(self) -> float:
        return self.width / self.height


def side_by_side(count: int, size: tuple[int, int]) -> list[Box]:
    """Equal parts of a picture of `size` width and height, up to three in a row, with even edges."""
    columns = count if count <= 3 else -(-count // 2)
    rows = -(-count // columns)
    x = [2 * round(size[0] * column / columns / 2) for column in range(columns + 1)]
    y = [2 * round(size[1] * row / rows / 2) for row in range(rows + 1)]
    places = [(number % columns, number // columns) for number in range(count)]
    return [Box(x[i], y[j], x[i + 1] - x[i], y[j + 1] - y[j]) for i, j in places]


def split_into_panes(box: Box, insets: int) -> list[Box]:
    """The first pane and the insets, in a column on its right, or in a row below it if the box is higher than wide."""
    wide = box.width >= box.height
    length, across = (box.width, box.height) if wide else (box.height, box.width)
    edge = 2 * round(length * (1 - INSETS_SHARE) / 2) if insets else length
    cuts = [2 * round(across * number / max(insets, 1) / 2) for number in range(insets + 1)]
    if wide:
        first = Box(box.left, box.top, edge, box.height)
        return [first, *(Box(edge, box.top + i, length - edge, j - i) for i, j in pairwise(cuts))]
    first = Box(box.left, box.top, box.width, edge)
    return [first, *(Box(i, box.top + edge, j - i, length - edge) for i, j in pairwise(cuts))]
