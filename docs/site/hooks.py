"""What mkdocs does not do for the site by itself: pictures from outside of docs/, and equations without a script.

The pages link to ../videos/, so that they also work where the repository is read. The site gets copies, and its links
are shortened. Each GIF is shown as an mp4, which can be paused. Equations become MathML, which browsers draw
themselves; nothing is fetched.
"""

import html
import re
import tempfile
from fractions import Fraction
from pathlib import Path
from typing import Any

import latex2mathml.converter
import numpy as np
from mkdocs.structure.files import File
from PIL import Image, ImageSequence

from lqrsim.view.render import encoder

ROOT = Path(__file__).resolve().parents[2]
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
GIF = re.compile(r'<img alt="([^"]*)" src="([^"]*)\.gif" />')


def on_files(files: Any, config: Any) -> Any:
    """Add the committed pictures and videos."""
    for path in sorted((ROOT / "videos").glob("readme_*")):
        files.append(File.generated(config, f"videos/{path.name}", abs_src_path=str(path)))
        if path.suffix == ".gif":
            files.append(File.generated(config, f"videos/{path.stem}.mp4", content=_mp4(path)))
    for path in sorted((ROOT / "docs" / "figures").glob("*.gif")):
        files.append(File.generated(config, f"figures/{path.stem}.mp4", content=_mp4(path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Link to the copies."""
    return markdown.replace("](../videos/", "](videos/")


def on_page_content(content: str, **_: Any) -> str:
    """Replace each equation by MathML, and each GIF by a video with controls."""
    video = r'<video aria-label="\1" src="\2.mp4" controls loop muted playsinline preload="auto"></video>'
    return GIF.sub(video, EQUATION.sub(_mathml, content))


def _mathml(found: re.Match[str]) -> str:
    kind = "block" if found[1] == "div" else "inline"
    made = latex2mathml.converter.convert(html.unescape(found[2]).strip(), display=kind)
    return f'<div class="equation" tabindex="0">{made}</div>' if kind == "block" else made


def _mp4(gif: Path) -> bytes:
    """A GIF as an mp4, at the mean of its frame rates."""
    with Image.open(gif) as video, tempfile.TemporaryDirectory() as folder:
        spent = [frame.info["duration"] for frame in ImageSequence.Iterator(video)]  # ms
        made, rate = Path(folder) / "made.mp4", Fraction(1000 * len(spent), round(sum(spent)))
        with encoder(made, video.size, rate, crf=23, preset="fast") as put:
            for frame in ImageSequence.Iterator(video):
                put(np.asarray(frame.convert("RGB")))
        return made.read_bytes()
