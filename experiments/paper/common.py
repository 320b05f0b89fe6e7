"""What each script that reproduces a result of the paper is told, what it says, and how it is run.

A script has a `Config`, `main(config)`, which measures and draws, `report(result)`, which says it in Markdown, and
`statements(result)`, which holds what the paper says against it. The last two need nothing but the result, which is
JSON: the page of all results is made of it.
"""

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure
from tqdm import tqdm

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.stress.statistics import Estimate
from lqrsim.versions import versions
from lqrsim.view import gl, style

Result = dict[str, Any]

FREE = (-np.inf, np.inf)  # limits of the controls: the paper's problems have none
FIGURES = "figures"  # folder of the figures, in that of the output


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What all scripts are told."""

    out: Path = Path("runs/paper")
    """Folder for the figures, in a folder of that name."""
    quick: bool = False
    """As little of everything as still shows how it works."""
    json: bool = False
    """Print everything as JSON instead of the report."""


@dataclass(frozen=True, kw_only=True)
class Statement:
    """What the paper says, and what came of it.

    Attributes:
      where: in the paper. paper: what it says. test: when that counts as holding here, a choice of ours.
      ours: what came out. holds: whether it does; None where it could not be found out, and `ours` says why.
      figure: which shows it, its name without the suffix.
    """

    where: str
    paper: str
    test: str
    ours: str
    holds: bool | None
    figure: str


def run(
    config_type: type[Settings],
    main: Callable[[Any], Result],
    report: Callable[[Result], str],
    statements: Callable[[Result], list[Statement]],
    description: str | None,
) -> None:
    """The script as a program: what it found as JSON, or as text."""
    config = tyro.cli(config_type, description=description)
    try:
        result = main(config)
    except ls.InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    verdicts = statements(result)
    if config.json:
        said = {"result": result, "report": report(result), "statements": [asdict(verdict) for verdict in verdicts]}
        print(json.dumps(said, allow_nan=False))
        return
    print(report(result))
    for verdict in verdicts:
        holds = {True: "holds", False: "DOES NOT HOLD", None: "not tested"}[verdict.holds]
        print(f"{holds}: {verdict.paper} ({verdict.where}): {verdict.ours} [{verdict.test}]")
    for name in result["figures"]:
        print(f"wrote {config.out / FIGURES / name}")


def opening(config: Settings) -> Result:
    """What each result begins with: settings, versions, and the figures, none so far."""
    told = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(config).items()}
    return {"config": told, "versions": versions(), "figures": []}


@contextmanager
def figure(config: Settings, result: Result, name: str, size: tuple[float, float]) -> Iterator[Figure]:
    """A figure, `size` inches wide and high, that is written as png and pdf, and noted in the result."""
    files = [f"{name}{suffix}" for suffix in (".png", ".pdf")]
    with style.figure(*(config.out / FIGURES / file for file in files), size=size) as drawn:
        yield drawn
    result["figures"] += files


def render_still(config: Settings, result: Result, name: str, rollout: ls.Rollout, **options: Any) -> None:
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


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown: the first column to the left, the others, numbers, to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(str(cell) for cell in line)} |" for line in lines)


def interval(estimate: Estimate) -> list[float]:
    """An estimate as JSON has it: value, lower and upper end."""
    return [estimate.value, estimate.low, estimate.high]


def between(estimate: Sequence[float], spec: str = ".2f") -> str:
    """Such a list in words."""
    value, low, high = estimate
    return f"{value:{spec}} ({low:{spec}} to {high:{spec}})"


@contextmanager
def counting(name: str) -> Iterator[Callable[[int, int], None]]:
    """A bar for what says itself how many are done of how many, if it takes long."""
    with tqdm(desc=name, leave=False, delay=2.0, disable=None) as bar:

        def told(done: int, of: int) -> None:
            bar.total = of
            bar.update(done - bar.n)

        yield told


def as_in_the_paper(problem: ls.Problem) -> ls.Problem:
    """Without limits of the controls, which the paper does not have."""
    return replace(problem, control_limits=FREE)


def fixed(problem: ls.Problem) -> ls.Problem:
    """The same from exactly the wished start, which is softly drawn to in the paper."""
    assert problem.start is not None
    return replace(problem, initial=ls.FixedState(problem.start))


def numbers(values: Iterable[float] | Array, digits: int = 6) -> list[float | None]:
    """Numbers as JSON has them, to so many digits; None for what is not finite."""
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in map(float, values)]


def shown(value: float | None, spec: str) -> str:
    """Such a number in words."""
    return "-" if value is None else f"{value:{spec}}"
