"""The documentation site: complete, built without warnings, and whole without a network."""

import html
import json
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
from browsing import CHROMIUM, browser

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
    rooms = ("belief", "disturbances", "lq", "simulators", "stress", "types", "view")
    inside = {f"{room}.{name}" for room in rooms for name in getattr(ls, room).__all__}
    assert listed == Counter(inside | set(ls.__all__) - set(rooms))


def test_navigation_has_every_page() -> None:
    pages = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    listed = re.findall(r"^ +- (?:[^:]+: )?(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert Counter(listed) == Counter(pages)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A build with warnings as errors; some 10 s."""
    pytest.importorskip("mkdocs", reason="needs the `docs` extra")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.mark.long
def test_site_is_whole_without_a_network(site: Path) -> None:
    for page in site.rglob("*.html"):
        assert not FETCHED.search(page.read_text(encoding="utf-8")), page
    for style in site.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import )[\"']?(?:https?:)?//", style.read_text(encoding="utf-8")), style
    concepts = (site / "concepts.html").read_text(encoding="utf-8")
    written = (DOCS / "concepts.md").read_text(encoding="utf-8")
    assert concepts.count("<math") == len(re.findall(r"\$\$.*?\$\$|\$[^$\n]+\$", written, re.DOTALL)) > 20
    assert "arithmatex" not in concepts
    shown = {path.name for path in (site / "videos").iterdir()}
    committed = {path.name for path in (ROOT / "videos").glob("readme_*")}
    assert shown == committed | {name.replace(".gif", ".mp4") for name in committed}
    index = (site / "search" / "search_index.json").read_text(encoding="utf-8")
    assert "ls.smooth" in index
    assert "lqrsim.simulate" in index


@pytest.mark.long
def test_every_link_of_the_site_leads_somewhere(site: Path) -> None:
    pages = {page: page.read_text(encoding="utf-8") for page in site.rglob("*.html")}
    ends = {page: set(re.findall(r'\bid="?([^"\s>]+)', text)) for page, text in pages.items()}
    for page, text in pages.items():
        if page.name == "404.html":  # whose links are of a server
            continue
        for link in re.findall(r'\b(?:href|src)="([^"]*)"', text):
            path, _, end = html.unescape(link).partition("#")
            if "//" in path or path.startswith(("data:", "mailto:")):
                continue
            to = (page.parent / unquote(path)).resolve() if path else page
            assert to.exists(), f"{page.name} links to {link}"
            assert not end or end in ends[to], f"{page.name} links to {link}"


# What goes beyond the page, what scrolls without a sign of it, and pictures that are not there.
LOOKED_AT = """(() => {
  const parts = [...document.querySelectorAll(
    ".md-typeset :is(pre > code, .equation, .md-typeset__scrollwrap, img, video)")];
  const wide = parts.filter(one => one.scrollWidth > one.clientWidth + 1 && one.clientWidth > 0);
  const unsigned = wide.filter(one => {
    const style = getComputedStyle(one);
    return style.overflowX !== "auto" || !style.backgroundAttachment.includes("local");
  });
  return JSON.stringify({
    beyond: document.scrollingElement.scrollWidth - document.scrollingElement.clientWidth,
    outside: parts.filter(one => one.getBoundingClientRect().right > innerWidth + 1).length,
    unsigned: unsigned.length, wide: wide.length,
    broken: [...document.images].filter(one => one.complete && !one.naturalWidth).length,
  });
})()"""


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs a browser")
def test_pages_fit_a_narrow_and_a_wide_screen_in_light_and_dark(site: Path, tmp_path: Path) -> None:
    """What is too wide scrolls, and its shadow says so; videos play and stop."""
    wide = Counter[int]()
    with browser("about:blank", tmp_path / "profile") as page:

        def evaluated(expression: str) -> Any:
            return page.call("Runtime.evaluate", expression=expression, awaitPromise=True)["result"].get("value")

        def until(true: Callable[[], Any], what: str) -> None:
            end = time.monotonic() + 60
            while not true():
                assert time.monotonic() < end, what
                time.sleep(0.02)

        for path in sorted(site.rglob("*.html")):
            page.call("Page.navigate", url=path.as_uri())
            ready = f"document.readyState === 'complete' && location.href === {json.dumps(path.as_uri())}"
            until(lambda ready=ready: evaluated(ready), path.name)
            for width, theme in ((500, "default"), (1280, "slate")):
                screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
                page.call("Emulation.setDeviceMetricsOverride", **screen)
                evaluated(f"document.body.setAttribute('data-md-color-scheme', '{theme}')")
                found = json.loads(evaluated(LOOKED_AT))
                wide[width] += found.pop("wide")
                assert set(found.values()) == {0}, (path.name, width, theme, found)
        assert wide[500] > wide[1280] > 0
        page.call("Page.navigate", url=(site / "gallery.html").as_uri())
        until(lambda: evaluated("document.querySelectorAll('video[controls]').length") == 3, "the gallery's videos")
        evaluated("window.film = document.querySelector('video'); film.play()")
        until(lambda: evaluated("film.currentTime > 0.2"), "the video plays")
        evaluated("film.pause()")
        assert evaluated("film.paused && film.currentTime < film.duration")
