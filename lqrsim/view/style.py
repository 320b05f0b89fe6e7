"""The style and the writing of figures: the same data gives the same bytes."""

import contextlib
import os
from collections.abc import Iterator

import matplotlib.style
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, LogLocator, NullFormatter, NullLocator, StrMethodFormatter

from lqrsim.errors import InputError, check_path, excerpt
from lqrsim.results.archive import replacing

PLAN = "#222222"
RUNS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")  # distinct for the colour-blind, and in grey by lightness
SOLID, MARGIN, LIMIT = "#8c96a3", "#dfe3e8", "#7a7a7a"
# No date and no version in the files: the same data gives the same bytes.
METADATA = {".png": {"Software": None}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
STYLE = {
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "font.size": 9,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "pdf.fonttype": 42,  # TrueType text, which journals require
    "savefig.dpi": 150,
    "svg.fonttype": "none",
    "text.parse_math": False,  # dollar signs in names are not mathematics
    "svg.hashsalt": "lqrsim",
}


@contextlib.contextmanager
def figure(*paths: str | os.PathLike[str], size: tuple[float, float]) -> Iterator[Figure]:
    """A figure, `size` inches wide and high, that is written to each path when the block ends: png, pdf or svg.

    A block that fails writes nothing. For the layout use `Figure.set_layout_engine("tight", ...)`, which runs when the
    file is written: `tight_layout` would run before the tick labels of logarithmic axes are replaced.

    Raises:
      InputError: a path has another suffix, or a file cannot be written.
    """
    places = [check_path("path", path) for path in paths]
    for place in places:
        if place.suffix.lower() not in METADATA:
            raise InputError(f"path: got {excerpt(place.name)}, want a name that ends in one of: {', '.join(METADATA)}")
    with contextlib.ExitStack() as stack:
        unfinished = [(place.suffix.lower(), stack.enter_context(replacing(place))) for place in places]
        stack.enter_context(matplotlib.style.context(["default", STYLE]))
        drawn = Figure(figsize=size)
        FigureCanvasAgg(drawn)
        yield drawn
        for axes in drawn.axes:
            for axis in (axes.xaxis, axes.yaxis):
                if isinstance(axis.get_major_formatter(), LogFormatter):  # this formatter writes powers as mathematics
                    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
                    axis.set_minor_formatter(NullFormatter())
        for suffix, file in unfinished:
            drawn.savefig(file, format=suffix[1:], metadata=METADATA[suffix])


def plain_decades(*axes: Axis) -> None:
    """Set the ticks of logarithmic axes over a few decades to 1, 2, 5, 10, 20, ..., in plain numbers."""
    for axis in axes:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
