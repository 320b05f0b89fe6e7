"""What can be drawn over a scene, and qualities, by name. Imports nothing heavy: the command line needs them."""

from typing import Literal, NamedTuple

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
OVERLAYS: tuple[Overlay, ...] = tuple(name for name, kind in OVERLAY_KINDS.items() if kind.default)
# What is given for an overlay, and that overlay; a recording for Rerun has its funnel whatever the overlays.
DRAWN_BY: dict[str, Overlay] = {"solution": "cost_tube", "funnel": "funnel", "titles": "caption"}
