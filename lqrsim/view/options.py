"""What pictures can be asked to show, and how; light, for the command line."""

from typing import Literal, get_args

Overlay = Literal["plan", "ghost", "trace", "forces", "measured", "tube", "cost_tube", "funnel", "caption"]
Quality = Literal["draft", "standard", "publication"]

ALL_OVERLAYS: tuple[Overlay, ...] = get_args(Overlay)
# Tubes about one plan hide each other: that of the cost, and a funnel, are for those who ask for them.
OVERLAYS: tuple[Overlay, ...] = tuple(name for name in ALL_OVERLAYS if name not in ("cost_tube", "funnel"))
CALIBRATED = ("top", "side")
VIEWS = ("overview", "chase", *CALIBRATED)
