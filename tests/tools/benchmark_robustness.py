"""How lqrsim handles hostile input: calls with bad arguments, and damaged or forged files.

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

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "experiments"))  # has the runner

from robustness import api, files
from robustness.common import Config
from runner import Result, Section, measure, opening, report_of, run

SECTIONS = {"api": Section(api), "files": Section(files)}


def main(config: Config) -> Result:
    return measure(config.bounded(), SECTIONS, opening(config))


def report(result: Result) -> str:
    return "\n\n".join(report_of(SECTIONS, result))


def failures(result: Result) -> list[str]:
    return [failed for name in SECTIONS if name in result for failed in result[name]["failures"]]


if __name__ == "__main__":
    run(Config, main, report, __doc__, failures=failures)
