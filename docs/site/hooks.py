"""What mkdocs does not do for the site by itself: pictures from outside of docs/, and equations without a script.

The pages link to ../videos/, so that they also work where the repository is read. The site gets copies, and its links
are shortened. Equations become MathML, which browsers draw themselves; nothing is fetched.
"""

import html
import re
from pathlib import Path
from typing import Any

import latex2mathml.converter
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[2]
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files: Any, config: Any) -> Any:
    """Add the committed pictures and videos."""
    for path in sorted((ROOT / "videos").glob("readme_*")):
        files.append(File.generated(config, f"videos/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Link to the copies."""
    return markdown.replace("](../videos/", "](videos/")


def on_page_content(content: str, **_: Any) -> str:
    """Replace each equation by MathML."""
    return EQUATION.sub(_mathml, content)


def _mathml(found: re.Match[str]) -> str:
    kind = "block" if found[1] == "div" else "inline"
    return latex2mathml.converter.convert(html.unescape(found[2]).strip(), display=kind)
