"""HTML of results for notebooks: a heading, a table and a drawing. NumPy only.

All text is escaped, because names come from files that anyone may have written.
"""

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from lqrsim.errors import Array
from lqrsim.results.coordinates import Coordinates

WIDTH, HEIGHT, MARGIN = 360, 240, 12  # size of a drawing in pixels
POINTS = 300  # largest number of points of a line
SHOWN = 10  # largest number of trials in a table or a summary, and of lines in a drawing
COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b", "#e377c2", "#17becf", "#bcbd22", "#7f7f7f")


def number_text(value: float) -> str:
    """A number with four digits; a dash if it is not finite."""
    return f"{value:.4g}" if np.isfinite(value) else "-"


def of_table(
    heading: str, remarks: Iterable[str], rows: Sequence[Sequence[str]], picture: str = "", *, head: bool = True
) -> str:
    """A heading, remarks, and a table next to a picture; `head`: whether the first row names the columns."""
    lines = "".join(f"<div>{escape(remark)}</div>" for remark in remarks)
    table = ""
    for i, row in enumerate(rows):
        tags = ["td" if (i if head else j) else "th" for j in range(len(row))]
        cells = (f'<{tag} style="text-align:left">{escape(text)}</{tag}>' for tag, text in zip(tags, row, strict=True))
        table += f"<tr>{''.join(cells)}</tr>"
    beside = "display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start"
    above = f'<div class="lqrsim"><div><strong>{escape(heading)}</strong></div>{lines}'
    return f'{above}<div style="{beside}"><table>{table}</table>{picture}</div></div>'


def drawing(space: Coordinates, times: Array, plan: Array, runs: Array) -> str:
    """The plan (T+1, n) and runs (K, T+1, n) as SVG: paths of SHOWN runs along the first two axes of the position.

    Without a position, it shows the states of the plan and of the first run over time, each to its own scale.
    """
    dashes = "4 3" if len(runs) else ""
    if space.position:
        place = list(space.position[:2])
        lines = [(plan[:, place], "currentColor", "plan", dashes)]
        lines += [(run[:, place], COLOURS[k], f"run {k}", "") for k, run in enumerate(runs[:SHOWN])]
        names = [space.labels[i] for i in place]
        return _svg(lines, f"{names[0]} to the right, {names[1]} up", equal=True)
    low, high = _range(plan)
    lines = []
    for states, name, dashed in [(plan, "plan", dashes), *((run, "run 0", "") for run in runs[:1])]:
        scaled = (states - low) / (high - low)
        for i, label in enumerate(space.labels):
            line = np.stack([times, scaled[:, i]], axis=1)
            lines.append((line, COLOURS[i % len(COLOURS)], f"{label}, {name}", dashed))
    return _svg(lines, f"{', '.join(space.labels)} over time, each to its own scale", equal=False)


def _range(values: Array) -> tuple[Array, Array]:
    """The smallest and the largest finite value of each column, kept slightly apart."""
    finite = np.where(np.isfinite(values), values, np.nan)
    known = np.isfinite(finite).any(axis=0)
    finite = np.where(known, finite, 0.0)
    low, high = np.nanmin(finite, axis=0), np.nanmax(finite, axis=0)
    wide = np.maximum(high - low, 1e-9 * np.maximum(np.abs(low), 1.0))
    return low, low + wide


def _svg(lines: list[tuple[Array, str, str, str]], title: str, *, equal: bool) -> str:
    """Lines (N, 2) with colour, title and dashes, to one scale if `equal`; points that are not finite are left out."""
    low, high = _range(np.concatenate([line for line, *_ in lines]))
    scale = (np.array([WIDTH, HEIGHT]) - 2 * MARGIN) / (high - low)
    if equal:
        scale = np.full(2, scale.min())
    middle = (low + high) / 2

    def places(line: Array) -> Array:
        chosen = line[np.unique(np.linspace(0, len(line) - 1, POINTS).round().astype(int))]
        chosen = chosen[np.isfinite(chosen).all(axis=1)]
        return np.array([WIDTH, HEIGHT]) / 2 + (chosen - middle) * scale * np.array([1, -1])

    drawn = []
    for line, colour, name, dashes in lines:
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places(line))
        style = f' stroke-dasharray="{dashes}"' if dashes else ""
        shape = f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"{style}>'
        drawn.append(f"{shape}<title>{escape(name)}</title></polyline>")
    plan = places(lines[0][0])
    for place, name, fill in ((plan[:1], "start", "none"), (plan[-1:], "the plan's end", "currentColor")):
        for x, y in place if equal else ():
            circle = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" stroke="currentColor" fill="{fill}">'
            drawn.append(f"{circle}<title>{escape(name)}</title></circle>")
    size = f'width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img"><title>{escape(title)}</title>'
    return f"{head}{''.join(drawn)}</svg>"
