"""The pictures that the pages show: they are there, small, and made by the commands beside them."""

import dataclasses
import inspect
import re
import shlex
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import tyro
from PIL import Image, ImageSequence

import lqrsim as ls
from lqrsim.commands import Command
from lqrsim.commands.viewing import Render
from lqrsim.view import gl

ROOT = Path(__file__).parent.parent
README, GALLERY, HOME = ROOT / "README.md", ROOT / "docs" / "gallery.md", ROOT / "docs" / "index.md"
BLOCK = re.compile(r"^```[a-z]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHOWN = re.compile(r"!\[[^\]]*\]\(([^)]+)\)|<img src=\"([^\"]+)\"")


@pytest.fixture(scope="module")
def pictures() -> Mapping[str, tuple[str, ...]]:
    """The script's list: what each file takes."""
    return import_module("readme_pictures").PICTURES


def shown(page: Path) -> list[Path]:
    """The pictures on a page."""
    found = SHOWN.findall(page.read_text(encoding="utf-8"))
    return [(page.parent / (markdown or html)).resolve() for markdown, html in found]


def commands(block: str) -> list[str]:
    """The command lines in a block, without comments and redirections; a backslash continues a line."""
    whole = re.sub(r"\s*\\\n\s*", " ", block)
    lines = [re.split(r" [#>] ", line)[0].strip() for line in whole.splitlines()]
    return [line for line in lines if line.startswith("lqrsim ")]


def beside(page: Path) -> dict[Path, list[str]]:
    """For each picture, the commands of the first block after it."""
    text, found = page.read_text(encoding="utf-8"), {}
    for match in SHOWN.finditer(text):
        if block := BLOCK.search(text, match.end()):
            found[(page.parent / (match[1] or match[2])).resolve()] = commands(block[1])
    return found


@pytest.mark.parametrize("page", [README, *sorted((ROOT / "docs").glob("*.md"))], ids=lambda page: page.name)
def test_what_pages_show_exists_and_is_small(page: Path) -> None:
    for picture in shown(page):
        assert picture.is_file(), picture
        assert picture.stat().st_size < 2e6, picture


def test_the_gallery_names_the_call_behind_its_commands() -> None:
    """With keywords that it has."""
    text = " ".join(GALLERY.read_text(encoding="utf-8").split())
    (stated,) = re.findall(r"`ls\.render\((.*?)\)`", text)
    assert set(re.findall(r"(\w+)=", stated)) <= set(inspect.signature(ls.render).parameters)


def test_the_gallery_says_how_arguments_of_the_call_differ_from_options() -> None:
    options = {field.name for field in dataclasses.fields(Render)} - {"rollouts", "out"}
    text = " ".join(GALLERY.read_text(encoding="utf-8").split())
    renamed = dict(re.findall(r"`--(\w+)` is `(\w+)=`", text))
    arguments = {*inspect.signature(ls.render).parameters} - {"runs", "path", "progress"}
    assert {renamed.get(name, name) for name in options} == arguments


def test_the_gallery_has_every_picture_with_the_commands_that_make_it(pictures: Mapping[str, tuple[str, ...]]) -> None:
    assert beside(GALLERY) == {ROOT / name: list(lines) for name, lines in pictures.items()}
    videos = [name for name in pictures if name.endswith(".gif")]
    assert len(videos) == 3
    assert sum((ROOT / name).stat().st_size for name in pictures) < 6e6
    first = next(iter(pictures))
    assert beside(HOME) == {ROOT / first: list(pictures[first])}
    assert set(shown(README)) <= {ROOT / name for name in pictures}
    assert {path.relative_to(ROOT).as_posix() for path in ROOT.glob("videos/readme_*")} <= set(pictures)


def test_command_lines_of_the_pages_parse() -> None:
    pages = [README, *(ROOT / "docs").glob("*.md")]
    lines = {
        line for page in pages for block in BLOCK.findall(page.read_text(encoding="utf-8")) for line in commands(block)
    }
    assert len(lines) > 20
    for line in lines:
        arguments = shlex.split(line)[1:]
        if not arguments[0].startswith("--"):
            command = tyro.cli(Command, prog="lqrsim", args=arguments)
            assert type(command).__name__.removesuffix("Command").lower() == arguments[0], line


def test_videos_move_and_last_as_long_as_their_runs(pictures: Mapping[str, tuple[str, ...]]) -> None:
    seconds = {"quadrotor": 5.0, "feedback": 25.0 / 4, "wind": 5.0}
    for name in pictures:
        if not name.endswith(".gif"):
            continue
        with Image.open(ROOT / name) as video:
            durations, frames = [], []
            for frame in ImageSequence.Iterator(video):
                frames.append(np.asarray(frame.convert("RGB"), dtype=int))
                durations.append(frame.info["duration"])
        expected = next(length for word, length in seconds.items() if word in name)
        # The last frame stays for one more twelfth of a second, and a GIF counts in hundredths.
        assert sum(durations) / 1e3 == pytest.approx(expected + 1 / 12, abs=0.09)
        assert all(np.abs(one - other).max() > 50 for one, other in zip(frames, frames[6:], strict=False)), name


@pytest.mark.long
def test_script_makes_them_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if gl.missing():
        pytest.skip("no OpenGL here")
    monkeypatch.chdir(tmp_path)
    script = import_module("readme_pictures")
    made = [Path(path) for path in script.main(script.Config(out=Path("there"), quick=True))["made"]]
    assert [path.relative_to("there").as_posix() for path in made] == list(script.PICTURES)
    assert all(path.stat().st_size > 1000 for path in made)
    assert Path.cwd() == tmp_path
