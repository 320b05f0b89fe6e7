"""Tubes and chances of collision in figures."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from lqrsim.errors import Array
from lqrsim.view.ellipsoids import Ellipsoids

OUTLINES = 24  # ellipses whose outlines are drawn
BEADS = 0.2  # half axes, in distances from one to the next, of ellipses that are beads
LEAST = 1e-6  # chance that is shown


def draw_tube(axes: Axes, ellipses: Ellipsoids, label: str, *, face: str, edge: str) -> None:
    """Ellipses as one area, and the outlines of some of them, unless these would be beads on a string."""
    every = ellipses.outlines()
    axes.add_collection(PolyCollection(list(every), facecolors=face, edgecolors="none", zorder=1.5, label=label))
    chosen = np.unique(np.linspace(0, len(every) - 1, OUTLINES).astype(int)) if len(every) else np.arange(0)
    apart = np.linalg.norm(np.diff(ellipses.centres[chosen], axis=0), axis=1)
    if len(chosen) < 2 or ellipses.axes()[0][chosen].mean() > BEADS * apart.mean():
        some = PolyCollection(list(every[chosen]), facecolors="none", edgecolors=edge, linewidths=0.6, zorder=2.5)
        axes.add_collection(some)


def draw_tube_in_space(axes: Axes3D, ellipsoids: Ellipsoids, label: str, *, face: str, edge: str) -> None:
    """The shadows that ellipsoids cast along the line of sight, each at its own place, of some that overlap."""
    up, around = np.radians(axes.elev), np.radians(axes.azim)
    right = np.array([-np.sin(around), np.cos(around), 0.0])
    forward = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    onto = np.stack([right, np.cross(forward, right)])
    chosen = ellipsoids.spread(len(ellipsoids.centres))
    flat = ellipsoids.seen_in(onto)
    around_centres = flat.outlines()[chosen] - flat.centres[chosen, None, :]
    discs = ellipsoids.centres[chosen, None, :] + around_centres @ onto
    axes.add_collection3d(Poly3DCollection(list(discs), facecolors=to_rgba(edge, 0.15), edgecolors="none"))
    axes.plot([], [], [], color=face, linewidth=7, label=label)  # as the legend shows it


def draw_chances(axes: Axes, curves: Sequence[tuple[Array, Array, str]]) -> None:
    """The chance of being in collision at each knot, of several: times (T+1,), chances (T+1,) and a colour each."""
    most = LEAST
    for times, chances, colour in curves:
        axes.plot(times, np.where(chances > 0, chances, np.nan), color=colour)
        most = max(most, float(chances.max()))
    axes.set_yscale("log")
    axes.set_ylim(LEAST, 1.0 if most > 0.1 else 10 * most)
    axes.set(xlabel="time (s)", ylabel="chance", title="predicted chance of being in collision")
    axes.margins(x=0.01)
    axes.set_xlim(min(times[0] for times, *_ in curves), max(times[-1] for times, *_ in curves))
    if most <= LEAST:
        axes.text(0.5, 0.5, f"below {LEAST:g} throughout", transform=axes.transAxes, ha="center", va="center")
