"""What pictures can be asked to show, and how; light, for the command line."""

from typing import Literal, get_args

Overlay = Literal["plan", "ghost", "trace", "forces", "measured", "tube", "caption"]
Quality = Literal["draft", "standard", "publication"]

OVERLAYS: tuple[Overlay, ...] = get_args(Overlay)
CALIBRATED = ("top", "side")
VIEWS = ("overview", "chase", *CALIBRATED)
