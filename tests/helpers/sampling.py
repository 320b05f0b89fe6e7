"""How much of a family of problems a run of the tests has: some of it, or with the long tests all."""

from typing import Any

import pytest
from hypothesis import settings


def is_short() -> bool:
    """Whether long tests are left out, and families are drawn less often."""
    return examples(100) < 100


def examples(count: int) -> int:
    """So many; where long tests are left out, a fifth of them, but not fewer than three."""
    return max(min(count, 3), -(-count * settings().max_examples // 100))  # of hypothesis' own 100


def rarely(*values: Any) -> list[Any]:
    """Values of a parameter with which a test is a long one; a tuple is those of several parameters."""
    return [pytest.param(*(one if isinstance(one, tuple) else (one,)), marks=pytest.mark.long) for one in values]
