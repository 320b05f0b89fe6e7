"""How lqrsim takes what is wrong: spoilt files. Each is to be read as it was written, or refused in one line.

    python experiments/benchmark_robustness.py                                        # everything, some minutes
    python experiments/benchmark_robustness.py --sections files --mutations 1000      # some of it
    python experiments/benchmark_robustness.py --sections files --first 7 --mutations 1   # the one of that number again
    python experiments/benchmark_robustness.py --quick                                # bounded, and too few to trust

files   Solutions, rollouts and campaigns with flipped bits, other members, other arrays and other text, also with the
        hash of their content made anew, as another program would.

Exits with 1 if anything came of one that should not.
"""

import dataclasses
import json
import sys
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any, Literal, get_args

import tyro
from robustness import files

from lqrsim.machine import description
from lqrsim.versions import versions

Section = Literal["files"]
SECTIONS: dict[Section, ModuleType] = {
    "files": files,
}


@dataclass(frozen=True, kw_only=True)
class Config:
    sections: tuple[Section, ...] = get_args(Section)
    """What to try."""
    mutations: int = 20_000
    """How many spoilt files."""
    seed: int = 0
    """Of all that is drawn."""
    first: int = 0
    """Number of the first: each is made of the seed and its number alone."""
    quick: bool = False
    """200 spoilt files."""
    json: bool = False
    """Print everything as JSON instead of the tables."""


def main(config: Config) -> dict[str, Any]:
    if config.quick:
        config = dataclasses.replace(config, mutations=min(config.mutations, 200))
    result: dict[str, Any] = {"config": asdict(config), "versions": versions(), "machine": description()}
    for name in config.sections:
        result[name] = SECTIONS[name].measure(config)
    return result


def report(result: dict[str, Any]) -> str:
    return "\n\n".join(section.table(result[name]) for name, section in SECTIONS.items() if name in result)


if __name__ == "__main__":
    outcome = main(tyro.cli(Config, description=__doc__))
    print(json.dumps(outcome) if outcome["config"]["json"] else report(outcome))
    sys.exit(any(outcome[name]["failures"] for name in SECTIONS if name in outcome))
