"""What pictures can be asked to show, and how; light, for the command line."""

from typing import Literal, get_args

Overlay = Literal["plan", "ghost", "trace", "forces", "measured", "tube", "cost_tube", "caption"]
Quality = Literal["draft", "standard", "publication"]

ALL_OVERLAYS: tuple[Overlay, ...] = get_args(Overlay)
# Two tubes about one plan hide each other: that of the cost is for those who ask for it.
OVERLAYS: tuple[Overlay, ...] = tuple(name for name in ALL_OVERLAYS if name != "cost_tube")
CALIBRATED = ("top", "side")
VIEWS = ("overview", "chase", *CALIBRATED)
