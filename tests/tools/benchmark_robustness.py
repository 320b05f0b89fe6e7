"""How lqrsim takes hostile input: calls with what nobody should pass, and files that are damaged or made up.

    python tests/tools/benchmark_robustness.py                    # everything, some minutes
    python tests/tools/benchmark_robustness.py --sections files   # some of it
    python tests/tools/benchmark_robustness.py --quick            # a fiftieth

All of it is to be accepted, or refused by one clear line of InputError. Exits with 1 if anything else is raised, hangs,
or ends the process.

api     Every public callable, with one or two of its arguments spoilt. What is accepted is asked for all that it has.
        A call that fails is printed with its number; --sections api --first NUMBER --calls 1 repeats it.
files   Solutions, rollouts and campaigns with flipped bits, other members, other arrays and other text, also with the
        hash of their content made anew, as another program would. What is accepted is used. A file that fails is
        printed with its number; --sections files --first NUMBER --mutations 1 repeats it.
"""

import dataclasses
import json
import sys
from dataclasses import asdict
from types import ModuleType
from typing import Any

import tyro
from robustness import api, files
from robustness.common import Config, Section

from lqrsim.versions import versions

SECTIONS: dict[Section, ModuleType] = {"api": api, "files": files}


def main(config: Config) -> dict[str, Any]:
    if config.quick:
        quick = {"calls": max(1, config.calls // 50), "mutations": max(1, config.mutations // 50)}
        config = dataclasses.replace(config, **quick)
    result: dict[str, Any] = {"config": asdict(config), "versions": versions()}
    for name in config.sections:
        result[name] = SECTIONS[name].measure(config)
    return result


def report(result: dict[str, Any]) -> str:
    return "\n\n".join(section.table(result[name]) for name, section in SECTIONS.items() if name in result)


if __name__ == "__main__":
    settings = tyro.cli(Config, description=__doc__)
    outcome = main(settings)
    print(json.dumps(outcome) if settings.json else report(outcome))
    sys.exit(any(outcome[name]["failures"] for name in SECTIONS if name in outcome))
