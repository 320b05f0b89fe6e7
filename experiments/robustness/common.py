"""What the sections share: what they are told."""

from dataclasses import dataclass
from typing import Literal, get_args

Section = Literal["api", "files"]


@dataclass(frozen=True, kw_only=True)
class Config:
    sections: tuple[Section, ...] = get_args(Section)
    """What to try."""
    calls: int = 20_000
    """How many hostile calls of the API."""
    mutations: int = 20_000
    """How many spoilt files."""
    seed: int = 0
    """Of all that is spoilt."""
    first: int = 0
    """Number of the first call or file: --first N --calls 1 repeats call N alone, --first N --mutations 1 file N."""
    only: str = ""
    """Only callables with this in their name."""
    quick: bool = False
    """A fiftieth of it."""
    json: bool = False
    """Print all that is counted as JSON."""
