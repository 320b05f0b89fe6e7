"""`run.py numbers`: what it takes for a number of a page, and that it notices one that is not printed."""

from pathlib import Path

import pytest
from print_numbers import Claim, all_claims, claims, farthest

PAGE = """
# Numbers

| what | value | conditions | command |
|---|---:|---|---|
| time | 12.5 ms | 100 queries | `python experiments/one.py --sections time` |

Some text of 3 words before `python experiments/two.py` prints this table.

| problem | iterations | cost |
|---|---:|---:|
| escape | 16 | 0.3344 |
| zigzag | 1,234 | - |

## Another section

| a table | of 7 |
|---|---|
| that no command prints | 8 |
"""


@pytest.fixture
def found(tmp_path: Path) -> list[Claim]:
    (tmp_path / "page.md").write_text(PAGE)
    return list(claims(tmp_path / "page.md"))


def test_rows_belong_to_their_own_command_or_to_that_above_them(found: list[Claim]) -> None:
    assert [(claim.command, claim.numbers, claim.in_table) for claim in found] == [
        ("python experiments/one.py --sections time", ("12.5",), True),
        ("python experiments/two.py", ("3",), False),
        ("python experiments/two.py", ("16", "0.3344"), True),
        ("python experiments/two.py", ("1,234",), True),
    ]
    assert [claim.line for claim in found] == [6, 8, 12, 13]


@pytest.mark.parametrize(
    ("output", "far"),
    [
        ("in all 12.4967 ms", 0.0),  # rounded as on the page
        ("in all 12.44 ms", 0.0048),
        ("nothing", float("inf")),
    ],
)
def test_a_value_is_printed_rounded_as_on_the_page(found: list[Claim], output: str, far: float) -> None:
    assert farthest(found[0], output) == pytest.approx(far, abs=1e-9)


@pytest.mark.parametrize(
    ("output", "far"),
    [
        ("| escape | 16 | 0.33441 |", 0.0),
        ("| escape | 20 | 0.3344 |\n| zigzag | 16 | 1 |", 0.25),  # the 16 is another row's
        ("| zigzag | 15 | 0.3344 |", float("inf")),
    ],
)
def test_a_row_is_printed_as_a_whole(found: list[Claim], output: str, far: float) -> None:
    assert farthest(found[2], output) == pytest.approx(far)


def test_every_command_of_the_pages_is_a_script() -> None:
    root = Path(__file__).parents[1]
    scripts = [command.split()[1] for command in all_claims(long=True) if command.startswith("python ")]
    assert len(scripts) > 20
    assert not [script for script in scripts if not (root / script).is_file()]
