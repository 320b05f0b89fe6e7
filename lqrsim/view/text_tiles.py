"""Text on frames: tiles of text and a legend, drawn with Pillow and blended into images (height, width, 3)."""

import functools
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

Pixels = npt.NDArray[np.uint8]
Colour = tuple[float, float, float]

INK, PAPER = (28, 32, 38, 255), (255, 255, 255, 200)


@functools.lru_cache(maxsize=16)
def text_tile(lines: tuple[str, ...], height: int, *, width: int, bold: bool = True) -> Pixels:
    """Lines of text on translucent paper, (h, w, 4), at least `width` pixels wide.

    The letters are `height` pixels high; with `bold` the first line is bold.
    """
    fonts = [_font(height, bold=bold and number == 0) for number in range(len(lines))]
    needed = max(font.getlength(line) for font, line in zip(fonts, lines, strict=True))
    tile, draw = _blank_tile(max(needed + 1.4 * height, width), (1.5 * len(lines) + 0.7) * height)
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
    tile, draw = _blank_tile(widest, (1.6 * len(rows) + 0.6) * height)
    for number, row in enumerate(rows):
        top = (1.6 * number + 0.45) * height
        for left, name, colour in row:
            for column in range(swatch):
                shade = error_colours(np.array([column / swatch]))[0, :3] if colour is None else colour
                place = (left + column, top + 0.45 * height, left + column, top + 0.95 * height)
                draw.line(place, fill=tuple(round(255 * part) for part in shade))
            draw.text((left + swatch + space, top), name, font=font, fill=INK)
    return np.asarray(tile)


def error_colours(fractions: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Colours (n, 4) of errors as fractions (n,) of the full scale."""
    return np.asarray(matplotlib.colormaps["cividis"](np.asarray(fractions, dtype=np.float64)))


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


def blend(image: Pixels, tile: Pixels, *, left: int, top: int | None = None, bottom: int | None = None) -> None:
    """Blend a tile into the image, in place, at these distances in pixels from the left and the top or bottom."""
    room = image.shape[0] - tile.shape[0]
    start = max(top if top is not None else room - (bottom or 0), 0)
    area = image[start : start + tile.shape[0], left : left + tile.shape[1]]
    tile = tile[: area.shape[0], : area.shape[1]]
    alpha = tile[..., 3:].astype(np.uint16)
    area[...] = ((255 - alpha) * area + alpha * tile[..., :3] + 127) // 255


@functools.lru_cache(maxsize=8)
def _font(height: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return ImageFont.truetype(folder / f"DejaVuSans{'-Bold' if bold else ''}.ttf", height)


def _blank_tile(width: float, height: float) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    tile = Image.new("RGBA", (round(width), round(height)), PAPER)
    return tile, ImageDraw.Draw(tile)
