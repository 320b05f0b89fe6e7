"""Small print on frames: tiles of text and a legend, drawn with Pillow and blended into images (height, width, 3)."""

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
def text(lines: tuple[str, ...], height: int, *, width: int) -> Pixels:
    """Lines of text on translucent paper, (h, w, 4), at least `width` pixels wide.

    The letters are `height` pixels high, and the first line is bold.
    """
    fonts = [_font(height, bold=number == 0) for number in range(len(lines))]
    needed = max(font.getlength(line) for font, line in zip(fonts, lines, strict=True))
    tile, draw = _paper(max(needed + 1.4 * height, width), (1.5 * len(lines) + 0.7) * height)
    for number, (font, line) in enumerate(zip(fonts, lines, strict=True)):
        draw.text((0.7 * height, (0.4 + 1.5 * number) * height), line, font=font, fill=INK)
    return np.asarray(tile)


@functools.lru_cache(maxsize=16)
def legend(entries: tuple[tuple[str, Colour], ...], full: str, height: int) -> Pixels:
    """What the colours mean, (h, w, 4): those of the entries, and the map of the tracking error from 0 to `full`."""
    font, swatch, space = _font(height), round(2.5 * height), 0.6 * height
    driven = f"driven, tracking error 0 to {full}"
    names = [*(name for name, _ in entries), driven]
    tile, draw = _paper(sum(font.getlength(name) + swatch + 3 * space for name in names), 2.2 * height)
    x = space
    for name, colour in (*entries, (driven, None)):
        for column in range(swatch):
            shade = error_colours(np.array([column / swatch]))[0, :3] if colour is None else colour
            draw.line((x + column, 0.9 * height, x + column, 1.4 * height), fill=tuple(round(255 * c) for c in shade))
        draw.text((x + swatch + space, 0.45 * height), name, font=font, fill=INK)
        x += font.getlength(name) + swatch + 3 * space
    return np.asarray(tile)


def error_colours(fractions: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Colours (n, 4) of errors given as fractions (n,) of the full scale."""
    return np.asarray(matplotlib.colormaps["cividis"](np.asarray(fractions, dtype=np.float64)))


def paste(image: Pixels, tile: Pixels, *, left: int, top: int | None = None, bottom: int | None = None) -> None:
    """Blends a tile into the image, in place, that many pixels from the left and the top or the bottom edge."""
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


def _paper(width: float, height: float) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    tile = Image.new("RGBA", (round(width), round(height)), PAPER)
    return tile, ImageDraw.Draw(tile)
