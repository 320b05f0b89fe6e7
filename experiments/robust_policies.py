"""Policies that survive: tracking, estimation and safe plans, against the smoother's own policy and RotorPy's law.

    python experiments/robust_policies.py                              # everything, some forty minutes
    python experiments/robust_policies.py --sections presets steady    # some of it
    python experiments/robust_policies.py --quick                      # as little as shows how it works

Each section's numbers are in the folder of the output, as JSON, as soon as they are there.

presets  How often the quadrotor reaches its goal under the presets: 20 queries, policies and plans, and RotorPy.
alone    How strong one disturbance alone must be for half of the trials to fail.
steady   A steady wind, a wrong mass: whether it gets there, and what error stays when it hovers.
drive    The differential drive under all disturbances at once.
filter   Whether the filter knows how wrong it is.
chances  The predicted chance of collision against what splitting measures.
worlds   Whether safe plans in random worlds keep the chance that they were asked for, and what they cost.
"""

import json
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal

from paper.common import Result, Statement, opening, run
from robust import alone, chances, common, consistency, drive, presets, steady, worlds

from lqrsim.results.save_load import replacing

Section = Literal["presets", "alone", "steady", "drive", "filter", "chances", "worlds"]
SECTIONS: dict[Section, tuple[ModuleType, str]] = {
    "presets": (presets, "All disturbances of a preset"),
    "alone": (alone, "One disturbance alone"),
    "steady": (steady, "Steady disturbances"),
    "drive": (drive, "The differential drive"),
    "filter": (consistency, "Consistency of the filter"),
    "chances": (chances, "Predicted chances of collision"),
    "worlds": (worlds, "Safe plans in random worlds"),
}


@dataclass(frozen=True, kw_only=True)
class Config(common.Config):
    sections: tuple[Section, ...] = tuple(SECTIONS)
    """Which of them."""


def main(config: Config) -> Result:
    result = opening(config)
    asked: Any = common.few(config) if config.quick else config
    for name in config.sections:
        result[name] = SECTIONS[name][0].measure(asked)
        if not config.quick:  # what took so long is not to be lost with what comes after it
            kept = config.out / f"robust_policies_{name}.json"
            with replacing(kept) as unfinished:
                unfinished.write_text(json.dumps(result[name], allow_nan=False) + "\n", encoding="utf-8")
    return result


def report(result: Result) -> str:
    parts = ["## Policies that survive", "What the paper's policy does not do: mind being off its plan, and ask why."]
    for name, (section, title) in SECTIONS.items():
        if name in result:
            parts += [f"### {title}", *section.report(result[name])]
    return "\n\n".join(parts)


def statements(result: Result) -> list[Statement]:
    """None: the paper says nothing of disturbances."""
    return []


if __name__ == "__main__":
    run(Config, main, report, statements, __doc__)
