"""What the scripts that reproduce a result of the paper share: its problems, and how figures are drawn."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from runner import FIGURES, FolderSettings, Result
from scipy import stats

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.stress.statistics import CONFIDENCE, Estimate
from lqrsim.view import gl, plots, style

FREE = (-np.inf, np.inf)  # limits of the controls: the paper's problems have none


@contextmanager
def figure(config: FolderSettings, result: Result, name: str, size: tuple[float, float]) -> Iterator[Figure]:
    """A figure, `size` inches wide and high, that is written as png and pdf, and noted in the result."""
    files = [f"{name}{suffix}" for suffix in (".png", ".pdf")]
    with style.figure(*(config.out / FIGURES / file for file in files), size=size) as drawn:
        yield drawn
    result["figures"] += files


def render_still(config: FolderSettings, result: Result, name: str, rollout: ls.Rollout, **options: Any) -> None:
    """A picture by `lqrsim.render`, noted in the result; without OpenGL, why there is none."""
    if reason := gl.missing():
        result.setdefault("not drawn", {})[name] = reason
        return
    size = (320, 180) if config.quick else (1280, 720)
    ls.render(rollout, config.out / FIGURES / f"{name}.png", size=size, **options)
    result["figures"].append(f"{name}.png")


def draw_in_space(axes: Axes3D, world: ls.World, low: Array, high: Array) -> None:
    """Draw translucent surfaces of obstacles between two corners (3,)."""
    for obstacle in world.obstacles:
        if obstacle.kind != "plane":  # planes are the sides of the box
            x, y, z = plots.surface(obstacle, low, high)
            axes.plot_surface(x, y, z, color=style.SOLID, alpha=0.10, linewidth=0, rstride=1, cstride=1, shade=True)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.zaxis.set_rotate_label(False)  # otherwise it would be upside down
    axes.set_zlabel("z (m)", rotation=90)
    axes.set_box_aspect(tuple(high - low), zoom=1.0)  # pyright: ignore[reportArgumentType] a float, as its documentation says
    axes.view_init(elev=27, azim=-110)


def picture(result: Result, name: str, caption: str) -> str:
    """A figure in Markdown, or why there is none."""
    if name in result.get("not drawn", {}):
        return f"({caption}: not drawn: {result['not drawn'][name]})"
    return f"![{caption}]({FIGURES}/{name}.png)"


def as_in_the_paper(problem: ls.Problem) -> ls.Problem:
    """The problem without limits of the controls, as in the paper."""
    return replace(problem, control_limits=FREE)


def fixed(problem: ls.Problem) -> ls.Problem:
    """The problem from exactly the wished start, where the paper has a soft start."""
    assert problem.start is not None
    return replace(problem, initial=ls.FixedState(problem.start))


def bootstrap(statistic: Callable[..., Array | float], *samples: npt.ArrayLike, resamples: int = 10_000) -> Estimate:
    """A statistic of paired samples, (K,) each, with its percentile bootstrap interval.

    Args:
      statistic: a function of the samples and `axis`, as in `scipy.stats.bootstrap`; for example `lambda a, b, axis:
        a.mean(axis) / b.mean(axis)`.
      samples: row i of each belongs to the same trial.
    """
    arrays = [np.asarray(sample, dtype=np.float64) for sample in samples]
    interval = stats.bootstrap(
        arrays,
        statistic,
        paired=True,
        vectorized=True,
        n_resamples=resamples,
        batch=max(1, min(1000, 10_000_000 // len(arrays[0]))),  # bounds the memory
        confidence_level=CONFIDENCE,
        method="percentile",  # BCa is undefined for medians of counts, which we have
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Estimate(float(statistic(*arrays, axis=0)), float(interval.low), float(interval.high))


def numbers(values: Iterable[float] | Array, digits: int = 6) -> list[float | None]:
    """Numbers for JSON, rounded to so many digits; None for what is not finite."""
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in map(float, values)]


def shown(value: float | None, spec: str) -> str:
    """Such a number in words."""
    return "-" if value is None else f"{value:{spec}}"
