"""What can be drawn over a scene, by name; qualities and views by name; and the layout of a picture.

This module imports nothing heavy, so that the command line starts fast.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

Overlay = Literal["plan", "ghost", "trace", "forces", "measured", "tube", "cost_tube", "funnel", "caption"]
Quality = Literal["draft", "standard", "publication"]
Colour = tuple[float, float, float]


class OverlayKind(NamedTuple):
    """What an overlay draws, in words; its red, green and blue; and whether it is drawn by default.

    The trace has the colours of the error map instead, and text has none.
    """

    words: str
    colour: Colour | None = None
    default: bool = True


OVERLAY_KINDS: dict[Overlay, OverlayKind] = {
    # No colour is in the map of the tracking error, on a robot, or as green as the mark that `lqrsim verify` reads.
    "plan": OverlayKind("the planned path", (0.78, 0.08, 0.42)),
    "ghost": OverlayKind("a disc or ball at the robot's planned position, or its hand's", (0.78, 0.08, 0.42)),
    "trace": OverlayKind("the path so far, coloured by tracking error"),
    "forces": OverlayKind("arrows of forces and wind, averaged over the last fifth of a second", (0.0, 0.50, 0.36)),
    "measured": OverlayKind("the last measured states, if they differ from the true states", (0.10, 0.10, 0.12)),
    "tube": OverlayKind(
        "the states predicted under the run's disturbances, within 2 standard deviations, if there is a tube and as far"
        " as it is not too wide",
        (0.0, 0.70, 0.72),
    ),
    # Tubes about one plan hide each other, so these two are not drawn by default.
    "cost_tube": OverlayKind(
        "where the total cost is near its minimum; it needs the solution", (0.47, 0.30, 0.78), default=False
    ),
    "funnel": OverlayKind(
        "the funnel about the plan, pale between its knots; it needs the funnel", (0.92, 0.55, 0.0), default=False
    ),
    "caption": OverlayKind("time, tracking error, clearance, disturbances, and whether the run is in the funnel"),
}
"""What each overlay draws."""
ALL_OVERLAYS: tuple[Overlay, ...] = get_args(Overlay)
OVERLAYS: tuple[Overlay, ...] = tuple(name for name in ALL_OVERLAYS if OVERLAY_KINDS[name].default)
# What is given for an overlay, and that overlay; a recording for Rerun has its funnel whatever the overlays.
DRAWN_BY: dict[str, Overlay] = {"solution": "cost_tube", "funnel": "funnel", "titles": "caption"}
CALIBRATED = ("top", "side")
VIEWS = ("overview", "chase", *CALIBRATED)
INSETS_FRACTION = 0.4  # fraction of a run's part for its insets


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
    edge = 2 * round(length * (1 - INSETS_FRACTION) / 2) if insets else length
    cuts = [2 * round(across * number / max(insets, 1) / 2) for number in range(insets + 1)]
    parts = [(0, 0, edge, across), *((edge, i, length - edge, j - i) for i, j in pairwise(cuts))]
    if not wide:
        parts = [(y, x, height, width) for x, y, width, height in parts]
    return [Box(box.left + x, box.top + y, width, height) for x, y, width, height in parts]
