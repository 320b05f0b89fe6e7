"""Text on pictures: a caption of each run, with title, disturbances and readings, and one legend for all runs.

Tiles of text are drawn with Pillow and blended into images (height, width, 3).
"""

import functools
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from lqrsim.view.options import Box, Colour
from lqrsim.view.overlays import Overlays, error_colours, legend_entries

Pixels = npt.NDArray[np.uint8]

INK, PAPER = (28, 32, 38, 255), (255, 255, 255, 200)
HEADER_FRACTION = 0.4  # largest fraction of a picture's height for the header
LETTER_HEIGHTS = 44, 54  # numbers of lines of text in the height of a picture, and in the width of a narrow one


class Caption:
    """The caption of one run, a strip of constant height above its part of the picture, where it covers nothing."""

    def __init__(self, overlays: Overlays, box: Box, title: str | None, speed: float) -> None:
        recorded, run = overlays.recorded, overlays.recorded.rollout
        self.overlays, self.speed, self.width = overlays, speed, box.width
        self.letter_height = _letter_height(box.width, box.height)
        title = title or recorded.name + (f", trial {run.first_trial + recorded.trial}" if run.trials > 1 else "")
        self.header = self._header_tile(title, list(run.disturbances) or ["undisturbed"], box)
        # Readings keep their place: next to the title in a strip that is wide enough, otherwise in separate lines.
        longest = self._readings_width(1)
        bare_title = text_tile((title,), self.letter_height, width=0)
        beside = bare_title.shape[1] + longest < self.width
        most = len(overlays.readings(recorded.end, speed))
        self.lines = next((count for count in range(1, most) if self._readings_width(count) <= self.width), most)
        self.place = (self.width - longest, 0) if beside else (0, self.header.shape[0])
        self.height = self.header.shape[0] + (0 if beside else self._readings_tile(recorded.end).shape[0])

    def _header_tile(self, title: str, what: list[str], box: Box) -> Pixels:
        """The title, as many disturbances as leave most of the picture free, and the number of the remaining ones."""
        tile = np.empty((0, 0, 4), dtype=np.uint8)
        for count in range(len(what), -1, -1):
            left = len(what) - count
            words = what[:count] + ([f"{left} more disturbances" if count else f"{left} disturbances"] if left else [])
            lines = [title, *wrap("; ".join(words), self.letter_height, self.width - round(1.4 * self.letter_height))]
            tile = text_tile(tuple(lines), self.letter_height, width=self.width)
            if tile.shape[0] <= HEADER_FRACTION * box.height:
                break
        return tile

    def draw(self, area: Pixels, time: float) -> None:
        blend(area, self.header, left=0, top=0)
        readings = self._readings_tile(time)
        if self.place[0]:
            readings = readings[: round(1.85 * self.letter_height)]  # up to the next line
        blend(area, readings, left=self.place[0], top=self.place[1])

    def _readings_tile(self, time: float, lines: int | None = None) -> Pixels:
        """The readings, in at most this number of lines."""
        readings = self.overlays.readings(time, self.speed)
        count = min(lines or self.lines, len(readings))
        cuts = [len(readings) * number // count for number in range(count + 1)]
        texts = tuple("   ".join(readings[first:last]) for first, last in pairwise(cuts))
        return text_tile(texts, self.letter_height, width=0, bold=False)

    def _readings_width(self, lines: int) -> int:
        """The width in pixels of the readings in this number of lines, with room for longer numbers."""
        run, times = self.overlays.recorded.rollout, [0.0, self.overlays.recorded.end]
        if (membership := self.overlays.membership) is not None:
            times.append(float(run.times[membership.index(max(membership, key=len))]))
        return max(self._readings_tile(time, lines).shape[1] for time in times) + 3 * self.letter_height


class Legend:
    """The legend of all runs, a strip below them; its height in pixels is 0 if it is empty."""

    def __init__(self, overlays: Sequence[Overlays], size: tuple[int, int]) -> None:
        entries = legend_entries(overlays)
        letter_height = max(round(0.8 * _letter_height(*size)), 8)
        self.tile = legend_tile(tuple(entries.items()), letter_height, size[0]) if entries else None
        self.height = 0 if self.tile is None else self.tile.shape[0] + self.tile.shape[0] % 2

    def draw(self, image: Pixels) -> None:
        if self.tile is not None:
            image[-self.height :] = 255
            blend(image[-self.tile.shape[0] :], self.tile, left=0, top=0)


def _letter_height(width: int, height: int) -> int:
    return max(round(min(height / LETTER_HEIGHTS[0], width / LETTER_HEIGHTS[1])), 9)


@functools.lru_cache(maxsize=16)
def text_tile(lines: tuple[str, ...], height: int, *, width: int, bold: bool = True) -> Pixels:
    """Lines of text on translucent paper, (h, w, 4), at least `width` pixels wide.

    The letters are `height` pixels high; with `bold` the first line is bold.
    """
    fonts = [_font(height, bold=bold and number == 0) for number in range(len(lines))]
    needed = max(font.getlength(line) for font, line in zip(fonts, lines, strict=True))
    size = round(max(needed + 1.4 * height, width)), round((1.5 * len(lines) + 0.7) * height)
    tile = Image.new("RGBA", size, PAPER)
    draw = ImageDraw.Draw(tile)
    for number, (font, line) in enumerate(zip(fonts, lines, strict=True)):
        draw.text((0.7 * height, (0.4 + 1.5 * number) * height), line, font=font, fill=INK)
    return np.asarray(tile)


@functools.lru_cache(maxsize=16)
def legend_tile(entries: tuple[tuple[str, Colour | None], ...], height: int, width: int) -> Pixels:
    """A legend (h, w, 4) in rows of at most `width` pixels; the colour None is the map of the tracking error."""
    font, swatch, space = _font(height), round(2.5 * height), 0.6 * height
    rows: list[list[tuple[float, str, Colour | None]]] = [[]]
    x = widest = space
    for name, colour in entries:
        needed = font.getlength(name) + swatch + 3 * space
        if rows[-1] and x + needed > width:
            rows.append([])
            x = space
        rows[-1].append((x, name, colour))
        x += needed
        widest = max(widest, x)
    tile = Image.new("RGBA", (round(widest), round((1.6 * len(rows) + 0.6) * height)), PAPER)
    draw = ImageDraw.Draw(tile)
    for number, row in enumerate(rows):
        top = (1.6 * number + 0.45) * height
        for left, name, colour in row:
            for column in range(swatch):
                shade = error_colours(np.array([column / swatch]))[0, :3] if colour is None else colour
                place = (left + column, top + 0.45 * height, left + column, top + 0.95 * height)
                draw.line(place, fill=tuple(round(255 * part) for part in shade))
            draw.text((left + swatch + space, top), name, font=font, fill=INK)
    return np.asarray(tile)


def wrap(words: str, height: int, width: int) -> list[str]:
    """The words in lines of at most `width` pixels, unless a word is longer, in letters `height` pixels high."""
    font, lines = _font(height), [""]
    for word in words.split():
        longer = f"{lines[-1]} {word}" if lines[-1] else word
        if lines[-1] and font.getlength(longer) > width:
            lines.append(f"  {word}")
        else:
            lines[-1] = longer
    return lines


def blend(image: Pixels, tile: Pixels, *, left: int, top: int) -> None:
    """Blend a tile into the image, in place, at these distances in pixels from the left and the top."""
    area = image[top : top + tile.shape[0], left : left + tile.shape[1]]
    tile = tile[: area.shape[0], : area.shape[1]]
    alpha = tile[..., 3:].astype(np.uint16)
    area[...] = ((255 - alpha) * area + alpha * tile[..., :3] + 127) // 255


@functools.lru_cache(maxsize=8)
def _font(height: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return ImageFont.truetype(folder / f"DejaVuSans{'-Bold' if bold else ''}.ttf", height)
