"""What the scripts that reproduce a result of the paper share: its problems, and how figures are drawn."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from runner import FIGURES, FolderSettings, Result

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.view import gl, style

FREE = (-np.inf, np.inf)  # limits of the controls: the paper's problems have none


@contextmanager
def figure(config: FolderSettings, result: Result, name: str, size: tuple[float, float]) -> Iterator[Figure]:
    """A figure, `size` inches wide and high, that is written as png and pdf, and noted in the result."""
    files = [f"{name}{suffix}" for suffix in (".png", ".pdf")]
    with style.figure(*(config.out / FIGURES / file for file in files), size=size) as drawn:
        yield drawn
    result["figures"] += files


def render_still(config: FolderSettings, result: Result, name: str, rollout: ls.Rollout, **options: Any) -> None:
    """A picture by `lqrsim.view.render_still`, noted in the result; without OpenGL, why there is none."""
    try:
        gl.bind()
    except ls.InputError as error:
        result.setdefault("not drawn", {})[name] = str(error)
        return
    size = (320, 180) if config.quick else (1280, 720)
    ls.view.render_still(rollout, config.out / FIGURES / f"{name}.png", size=size, **options)
    result["figures"].append(f"{name}.png")


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


def numbers(values: Iterable[float] | Array, digits: int = 6) -> list[float | None]:
    """Numbers for JSON, rounded to so many digits; None for what is not finite."""
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in map(float, values)]


def shown(value: float | None, spec: str) -> str:
    """Such a number in words."""
    return "-" if value is None else f"{value:{spec}}"
