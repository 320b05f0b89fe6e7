"""Re-planning in real time: how long it takes, what it is worth, and what others take.

    python experiments/benchmark_replanning.py                           # everything
    python experiments/benchmark_replanning.py --sections times          # some of it
    python experiments/benchmark_replanning.py --quick                   # as little as shows how it works

Each section's numbers are in the folder of the output, as JSON, as soon as they are there.

times     How long a re-plan takes: both robots, with the obstacle's cost, with control limits and with a clearance.
changes   A goal that jumps, and a pillar that appears where the plan leads.
delay     What a delay of one control period costs, predicted or ignored.
estimate  Output feedback with new plans, made with what is estimated, against the same without.
peers     Other people's solvers on the same work, run by run in turn: how long a re-plan takes, what the loop costs.
"""

import json
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal

from paper.common import Result, opening, run
from replan import changes, common, delay, estimate, peers, times

from lqrsim.results.save_load import replacing

Section = Literal["times", "changes", "delay", "estimate", "peers"]
SECTIONS: dict[Section, tuple[ModuleType, str]] = {
    "times": (times, "How long re-plans take"),
    "changes": (changes, "What changes on the way"),
    "delay": (delay, "What a delay costs"),
    "estimate": (estimate, "Planning again with estimates"),
    "peers": (peers, "Against other solvers"),
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
        if not config.quick:
            config.out.mkdir(parents=True, exist_ok=True)
            with replacing(config.out / f"replanning_{name}.json") as unfinished:
                unfinished.write_text(json.dumps(result[name], allow_nan=False) + "\n", encoding="utf-8")
    return result


def report(result: Result) -> str:
    parts = ["## Re-planning in real time"]
    for name, (section, title) in SECTIONS.items():
        if name in result:
            parts += [f"### {title}", *section.report(result[name])]
    return "\n\n".join(parts)


if __name__ == "__main__":
    run(Config, main, report, lambda result: [], __doc__)  # of the paper's statements, for it does not re-plan
