"""The videos of a report: the worst trial of each policy and sweep, repeated and rendered, as text for the page."""

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lqrsim.errors import InputError
from lqrsim.reports import tables
from lqrsim.stress import analysis
from lqrsim.stress.results import Results, replay
from lqrsim.view import gl

LARGEST = 1_500_000  # bytes of a video
SIZES = (640, 360), (480, 270), (320, 180)  # the first whose video is small enough is taken
FPS = 15


def videos_of_worst(results: Results, table: analysis.Table, count: int, folder: Path) -> Iterator[Any]:
    """A remark on all videos, and then each video."""
    chosen = [
        next((one for one in tables.worst_trials(table, group) if one.outcome != "error"), None)
        for group in tables.policies_and_sweeps(table)
    ]
    chosen = [one for one in chosen if one is not None][:count]
    problem = ""
    if chosen:
        try:
            gl.bind()
        except InputError as error:
            problem = str(error)
    if not chosen:
        yield "No videos were requested." if count == 0 else "There is no trial to render."
    elif problem:
        yield f"There are none, for this machine cannot draw pictures: {problem}"
    else:
        yield (
            "The worst trial of each policy and sweep, alternating between policies, repeated from its number alone."
            " Line: the plan; trace: the path, coloured by tracking error."
        )
    for one in chosen:
        video = {
            "label": _label(one),
            "command": results.command_of("replay", "--cell", str(one.cell), "--trial", str(one.trial)),
            "data": "",
            "problem": problem,
        }
        yield video if problem else video | _video(results, one, folder)


def _label(one: analysis.Trial) -> str:
    what = f" with {one.obstacle}" if one.obstacle else ""
    return (
        f"{one.cell.policy}, {one.cell.sweep} at strength {one.cell.strength:g}, trial {one.trial}:"
        f" {one.outcome}{what} after {one.ended:.2f} s, least clearance {one.clearance:.3f} m."
    )


def _video(results: Results, one: analysis.Trial, folder: Path) -> dict[str, Any]:
    """The video as text, or the reason for which there is none."""
    from lqrsim.view.render import render  # needs MuJoCo's OpenGL to be chosen

    try:
        rollout = replay(results, one.cell, one.trial)
        title = f"{one.cell.policy}, {one.cell.sweep} at strength {one.cell.strength:g}, trial {one.trial}"
        for width, height in SIZES:
            path = render(rollout, folder / "video.mp4", titles=[title], size=(width, height), fps=FPS)
            if path.stat().st_size <= LARGEST:
                return {"data": base64_text(path), "width": width, "height": height}
    except InputError as error:
        return {"problem": str(error)}
    return {"problem": f"it takes more than {LARGEST / 1e6:g} MB."}


def base64_text(path: Path) -> str:
    """A file in base64, for a page."""
    return base64.b64encode(path.read_bytes()).decode("ascii")
