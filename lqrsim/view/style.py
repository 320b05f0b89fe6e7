"""The style and the writing of figures: the same data gives the same bytes."""

import contextlib
import os
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import matplotlib.style
from matplotlib import ticker
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from lqrsim.annotations import checked
from lqrsim.errors import check_path
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


Style = Literal["screen", "page", "column"]


class Layout(NamedTuple):
    """The width of a figure in inches, the size of its text in points, and the panels side by side in it."""

    width: float
    text: float
    columns: int


# Journals' text is 3.4 inches wide in a column and 7.1 in two, and text in figures at least 7 points high.
LAYOUTS: dict[Style, Layout] = {
    "screen": Layout(11.0, 9.0, 2),
    "page": Layout(7.1, 7.0, 2),
    "column": Layout(3.4, 7.0, 1),
}
ROUNDING = 1e-6  # an axis whose range is a smaller part of its values shows that they are equal
HALF_RANGE = 0.025  # of the largest value on such an axis: what is shown on both sides of the middle
AROUND = 7.0, 7.0  # lines of text in height and in width that a panel's title, numbers and labels take
PAD = 0.07  # inches around panels
GAP = 2.0  # least number of pixels between the numbers of ticks


@contextlib.contextmanager
@checked
def figure(
    *paths: str | os.PathLike[str], size: tuple[float, float] | None = None, style: Style = "screen"
) -> Iterator[Figure]:
    """A figure that is written to each path when the block ends: png, pdf or svg.

    A block that fails writes nothing. Numbers of ticks that would overlap, and titles wider than their axes, are mended
    when the block ends: layout engines do not do that. By default `style` gives the width and `arrange` the height.
    """
    places = [check_path("path", path, suffixes=METADATA) for path in paths]
    layout = LAYOUTS[style]
    text = {"font.size": layout.text, "axes.titlesize": layout.text * STYLE["axes.titlesize"] / STYLE["font.size"]}
    with contextlib.ExitStack() as stack:
        unfinished = [(place.suffix.lower(), stack.enter_context(replacing(place))) for place in places]
        stack.enter_context(matplotlib.style.context(["default", STYLE | text]))
        engine = None if size else ConstrainedLayoutEngine(h_pad=PAD, w_pad=PAD)
        drawn = Figure(figsize=size or (layout.width, layout.width), layout=engine)
        FigureCanvasAgg(drawn)
        yield drawn
        for axes in drawn.axes:
            _set_ticks(axes)
        drawn.draw_without_rendering()
        for axes in drawn.axes:
            _keep_apart(axes)
        drawn.draw_without_rendering()
        drawn.set_layout_engine("none")
        for axes in drawn.axes:  # rounded: the layout engine's solver orders variables by address, and so its rounding
            axes.set_position(Bbox(axes.get_position(original=True).get_points().round(9)))
        for suffix, file in unfinished:
            drawn.savefig(file, format=suffix[1:], metadata=METADATA[suffix])


class Panel(NamedTuple):
    """A part of a figure: the height of its axes in inches, and whether it is as wide as the figure."""

    height: float
    wide: bool = False


def arrange(figure: Figure, panels: Sequence[Panel], style: Style = "screen") -> list[SubplotSpec]:
    """Places for panels, in columns from the top, and the height of the figure.

    Where the columns are equally high, as below two views side by side, other columns begin.
    """
    layout = LAYOUTS[style]
    columns = layout.columns

    sections: list[list[list[int]]] = []  # of each section its columns, of each column its panels
    for number, panel in enumerate(panels):
        if panel.wide or columns == 1:
            sections.append([[number]])
        else:
            tops = [sum(panels[i].height for i in column) for column in sections[-1]] if sections else []
            if len(tops) < 2 or 0 < max(tops) < 1.02 * min(tops):
                sections.append([[] for _ in range(columns)])
                tops = [0.0] * columns
            sections[-1][tops.index(min(tops))].append(number)
    sections = [[column for column in section if column] for section in sections]
    texts = AROUND[0] * layout.text / 72  # the layout counts these with the heights of sections, which are grids
    heights = [max(sum(panels[i].height + texts for i in column) for column in section) for section in sections]
    figure.set_figheight(sum(heights))
    places: dict[int, SubplotSpec] = {}
    rows = figure.add_gridspec(len(sections), 1, height_ratios=heights)
    for row, section in enumerate(sections):
        across = rows[row].subgridspec(1, len(section))
        for number, column in enumerate(section):
            below = across[number].subgridspec(len(column), 1, height_ratios=[panels[i].height for i in column])
            places |= {i: below[place] for place, i in enumerate(column)}
    return [places[number] for number in range(len(panels))]


def legend_below(figure: Figure, entries: Mapping[str, Artist]) -> None:
    """A legend below everything, in as many columns as fit; long labels are wrapped."""
    letters = max(int(figure.get_figwidth() * 72 / (0.6 * matplotlib.rcParams["font.size"])) - 8, 20)
    labels = ["\n".join(textwrap.wrap(label, letters)) for label in entries]
    for columns in range(len(entries), 0, -1):
        legend = figure.legend(list(entries.values()), labels, loc="outside lower center", ncols=columns)
        box = legend.get_window_extent()
        if columns == 1 or box.width <= figure.bbox.width:
            figure.set_figheight(figure.get_figheight() + box.height / figure.dpi)
            return
        legend.remove()


def _set_ticks(axes: Axes) -> None:
    """Plain numbers on logarithmic axes, and no axis on which rounding errors look like changes."""
    for axis, scale in ((axes.xaxis, axes.set_xlim), (axes.yaxis, axes.set_ylim)):
        if isinstance(axis.get_major_formatter(), ticker.LogFormatter):  # this formatter writes powers as mathematics
            low, high = axis.get_view_interval()
            if high < 100 * low:  # less than two decades have one power of ten in them, or none
                plain_decades(axis)
            axis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(ticker.NullFormatter())
        elif isinstance(axis.get_major_formatter(), ticker.ScalarFormatter):
            low, high = sorted(axis.get_view_interval())
            largest, middle = max(abs(low), abs(high)), 0.5 * (low + high)
            if axes.get_aspect() == "auto" and high - low < ROUNDING * largest:
                scale(middle - HALF_RANGE * largest, middle + HALF_RANGE * largest)


def _keep_apart(axes: Axes) -> None:
    """Fewer ticks where their numbers would overlap, titles in lines, and what ticks leave out in the axis' label."""
    for along, axis in enumerate((axes.xaxis, axes.yaxis)):
        locator, formatter = axis.get_major_locator(), axis.get_major_formatter()
        if isinstance(locator, ticker.MaxNLocator | ticker.LogLocator):
            name = "nbins" if isinstance(locator, ticker.MaxNLocator) else "numticks"
            for most in range(len(axis.get_major_ticks()), 0, -1):
                axis.get_tightbbox(None)  # places the ticks
                if not _overlap(axis, along):
                    break
                options: dict[str, Any] = {name: most}
                locator.set_params(**options)
        if isinstance(formatter, ticker.ScalarFormatter) and (left_out := formatter.get_offset()):
            axis.offsetText.set_visible(False)
            plus = left_out.startswith(("+", "-", "\N{MINUS SIGN}"))
            scale = left_out if plus else f"times {left_out}"
            axis.set_label_text(" \n"[along].join([axis.get_label_text(), scale]))
    if axes.figure.get_layout_engine() is None:  # nothing would make room for more lines
        return
    for text in axes.get_children():
        if isinstance(text, Text) and (title := text.get_text()) and title == axes.get_title(loc="left"):
            fits = axes.bbox.width / text.get_window_extent().width  # the fraction of the title that does
            text.set_text("\n".join(textwrap.wrap(title, max(int(len(title) * fits), 8))) if fits < 1 else title)


def _overlap(axis: Axis, along: int) -> bool:
    """Whether numbers of neighbouring ticks overlap, or are not apart by GAP, along x (0) or y (1)."""
    low, high = sorted(axis.get_view_interval())
    ticks = [tick for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    texts = [text for tick in ticks for text in (tick.label1, tick.label2)]
    boxes = [text.get_window_extent() for text in texts if text.get_visible() and text.get_text()]
    spans = sorted((box.min[along], box.max[along]) for box in boxes)
    return any(after[0] - before[1] < GAP for before, after in pairwise(spans))


def plain_decades(*axes: Axis) -> None:
    """Set the ticks of logarithmic axes over a few decades to 1, 2, 5, 10, 20, ..., in plain numbers."""
    for axis in axes:
        axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_minor_locator(ticker.NullLocator())
        axis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
