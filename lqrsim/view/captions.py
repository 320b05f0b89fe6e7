"""What the captions of pictures say: of each run what disturbs it and how it is doing, and of all what colours mean."""

from collections.abc import Sequence

import numpy as np

from lqrsim.view import text_tiles
from lqrsim.view.overlays import Overlays, Scale
from lqrsim.view.scene_renderer import Box
from lqrsim.view.text_tiles import Pixels
from lqrsim.view.track import Track

SHARES = 0.4, 0.75  # of the height of a picture, that what disturbs may take: above the picture, and over it
LETTERS = 44, 54  # heights of a letter in the height of a picture, and in the width of a narrow one


class Caption:
    """Of one run, in the upper left corner of its part of the picture.

    Attributes:
      height: of all of it, in pixels; it does not change.
    """

    def __init__(
        self, track: Track, overlays: Overlays, box: Box, title: str | None, speed: float, *, over: bool
    ) -> None:
        """Over the picture it is narrow, in a strip of its own as wide as that."""
        run = track.rollout
        self.track, self.overlays, self.speed, self.over = track, overlays, speed, over
        self.letters = _letters(box.width, box.height)
        which = f", trial {run.first_trial + track.trial}" if run.trials > 1 else ""
        title = title or f"{run.robot} in {run.scene}{which}".replace("_", " ")
        self.width = box.width // 4 if over else box.width
        self.paper = self._paper(title, list(run.disturbances) or ["undisturbed"], box)
        # Where they are, numbers stay: beside the title in a strip that is wide enough, else in a line of their own.
        longest = (
            text_tiles.text((self._line(track.end),), self.letters, width=0, bold=False).shape[1] + 3 * self.letters
        )
        beside = not over and text_tiles.text((title,), self.letters, width=0).shape[1] + longest < self.width
        self.place = (self.width - longest, 0) if beside else (0, self.paper.shape[0])
        self.height = self.paper.shape[0] + (0 if beside else self._numbers(0.0).shape[0])

    def _paper(self, title: str, what: list[str], box: Box) -> Pixels:
        """The title and as much of what disturbs as leaves most of the picture free, and how many more there are."""
        paper = np.empty((0, 0, 4), dtype=np.uint8)
        for count in range(len(what), -1, -1):
            left = len(what) - count
            words = what[:count] + ([f"{left} more disturbances" if count else f"{left} disturbances"] if left else [])
            lines = [title]
            for line in words if self.over else ["; ".join(words)]:
                lines += text_tiles.fit(line, self.letters, self.width - round(1.4 * self.letters))
            width = box.width // 5 if self.over else self.width
            paper = text_tiles.text(tuple(lines), self.letters, width=width)
            if paper.shape[0] <= SHARES[self.over] * box.height:
                break
        return paper

    def draw(self, area: Pixels, time: float) -> None:
        """Writes it into the run's part of the picture, in place."""
        margin = self.letters if self.over else 0
        text_tiles.paste(area, self.paper, left=margin, top=margin)
        numbers = self._numbers(time)
        if self.place[0]:
            numbers = numbers[: round(1.85 * self.letters)]  # the next line begins there
        text_tiles.paste(area, numbers, left=margin + self.place[0], top=margin + self.place[1])

    def _numbers(self, time: float) -> Pixels:
        lines = tuple(self._told(time)) if self.over else (self._line(time),)
        return text_tiles.text(lines, self.letters, width=self.paper.shape[1] if self.over else 0, bold=False)

    def _line(self, time: float) -> str:
        return "   ".join(self._told(time))

    def _told(self, time: float) -> list[str]:
        track, clearance = self.track, self.track.number_at(self.track.clearance, time)
        told = [f"time {time:.1f} s" + (f" at {self.speed:g}x" if self.speed != 1 else "")]
        error = track.number_at(track.error, time)
        told += [f"tracking error {1e3 * error:.0f} mm" if error < 1 else f"tracking error {error:.2f} m"]
        told += [f"clearance {clearance:.2f} m"] if np.isfinite(clearance) else []
        if "forces" in self.overlays.show:
            told += [f"force {np.linalg.norm(track.force_at(time)):.2f} N"]
        return told + ([over.replace("_", " ")] if (over := track.over(time)) else [])


class Legend:
    """Of all runs, in the lower left corner.

    Attributes:
      height: in pixels; 0 where there is nothing to explain.
    """

    def __init__(self, overlays: Sequence[Overlays], scale: Scale, size: tuple[int, int], *, over: bool) -> None:
        entries: dict[str, text_tiles.Colour | None] = dict(entry for one in overlays for entry in one.legend())
        if "trace" in overlays[0].show:
            full = f"{1e3 * scale.error:g} mm" if scale.error < 1 else f"{scale.error:g} m"
            entries[f"driven, tracking error 0 to {full}"] = None
        letters = max(round(0.8 * _letters(*size)), 8)
        self.margin = letters if over else 0
        self.tile = text_tiles.legend(tuple(entries.items()), letters, size[0] - 2 * self.margin) if entries else None
        self.height = 0 if self.tile is None else self.tile.shape[0] + self.tile.shape[0] % 2

    def draw(self, image: Pixels) -> None:
        """Writes it into the picture, in place."""
        if self.tile is not None:
            if not self.margin:
                image[-self.height :] = 255
            text_tiles.paste(image, self.tile, left=self.margin, bottom=self.margin)


def _letters(width: int, height: int) -> int:
    return max(round(min(height / LETTERS[0], width / LETTERS[1])), 9)
