"""What the sections share: what they are told."""

from dataclasses import dataclass
from typing import Literal, get_args

Section = Literal["files"]


@dataclass(frozen=True, kw_only=True)
class Config:
    sections: tuple[Section, ...] = get_args(Section)
    """What to try."""
    mutations: int = 20_000
    """How many spoilt files."""
    seed: int = 0
    """Of all that is spoilt."""
    first: int = 0
    """Number of the first file: --first N --mutations 1 repeats file N alone."""
    quick: bool = False
    """A fiftieth of it."""
    json: bool = False
    """Print all that is counted as JSON."""
