"""A thousand random problems of eleven kinds. Problem i of a kind and seed is the same however many are drawn."""

import zlib
from collections.abc import Callable, Collection, Iterator
from functools import partial
from typing import Literal

import numpy as np
from numpy.random import Generator

import lqrsim as ls
from reliability import classics, linear, worlds

Family = Literal["linear", "world", "classic"]

_DRAW: dict[str, Callable[[Generator], ls.Problem]] = {
    **{f"linear_{n}_{m}": partial(linear.draw, states=n, controls=m) for n, m in linear.SIZES},
    "drive": worlds.drive,
    "quadrotor": worlds.quadrotor,
    **classics.KINDS,
}
KINDS = tuple(_DRAW)

# How many of each make the thousand.
COUNTS = {kind: 100 if kind.startswith("linear") else 150 if kind in ("drive", "quadrotor") else 60 for kind in KINDS}


def family(kind: str) -> Family:
    """What a kind is one of."""
    if kind.startswith("linear"):
        return "linear"
    return "classic" if kind in classics.KINDS else "world"


def draw(kind: str, index: int, seed: int = 0) -> ls.Problem:
    """Problem `index` of one of `KINDS`."""
    return _DRAW[kind](np.random.default_rng([seed, zlib.crc32(kind.encode()), index]))


def thousand(seed: int = 0, *, share: float = 1.0, kinds: Collection[str] = KINDS) -> Iterator[tuple[str, ls.Problem]]:
    """All of them with their kinds, or of these kinds that share of each: the first ones, at least one."""
    for kind in kinds:
        for index in range(max(1, round(share * COUNTS[kind]))):
            yield kind, draw(kind, index, seed)
