"""The documentation site: complete, built without warnings, and whole without a network."""

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import lqrsim as ls

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
# What a browser fetches when it opens a page, from elsewhere.
FETCHED = re.compile(
    r"""<(?:script|img|link|iframe|video|source|audio|object)\b[^>]*?\b(?:src|href|data)=["']?(?:https?:)?//"""
)


def test_reference_has_every_public_name_once() -> None:
    pages = [page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md")]
    listed = Counter(name for page in pages for name in re.findall(r"^::: lqrsim\.([\w.]+)$", page, re.MULTILINE))
    rooms = ("disturbances", "lq", "stress", "types", "view")
    inside = {f"{room}.{name}" for room in rooms for name in getattr(ls, room).__all__}
    assert listed == Counter(inside | set(ls.__all__) - set(rooms))


def test_navigation_has_every_page() -> None:
    pages = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    listed = re.findall(r"^ +- (?:[^:]+: )?(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert Counter(listed) == Counter(pages)


def test_site_is_whole_without_a_network(tmp_path: Path) -> None:
    """A build with warnings as errors; some 10 s."""
    pytest.importorskip("mkdocs", reason="needs the `docs` extra")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for page in tmp_path.rglob("*.html"):
        assert not FETCHED.search(page.read_text(encoding="utf-8")), page
    for style in tmp_path.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import )[\"']?(?:https?:)?//", style.read_text(encoding="utf-8")), style
    concepts = (tmp_path / "concepts.html").read_text(encoding="utf-8")
    written = (DOCS / "concepts.md").read_text(encoding="utf-8")
    assert concepts.count("<math") == len(re.findall(r"\$\$.*?\$\$|\$[^$\n]+\$", written, re.DOTALL)) > 20
    assert "arithmatex" not in concepts
    shown = {path.name for path in (tmp_path / "videos").iterdir()}
    assert shown == {path.name for path in (ROOT / "videos").glob("readme_*")}
    index = (tmp_path / "search" / "search_index.json").read_text(encoding="utf-8")
    assert "ls.smooth" in index
    assert "lqrsim.simulate" in index
