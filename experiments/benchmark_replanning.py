"""Re-planning in real time: how long it takes, what it gains, and how other solvers compare.

    python experiments/benchmark_replanning.py                           # everything
    python experiments/benchmark_replanning.py --sections times          # some of it
    python experiments/benchmark_replanning.py --quick                   # as little as shows how it works

Each section's numbers are in the folder of the output, as JSON, as soon as they are there.

times     How long a re-plan takes: both robots, with the obstacle's cost, with control limits and with a clearance.
changes   A goal that jumps, and a pillar that appears where the plan leads.
delay     What a delay of one control period costs, predicted or ignored.
estimate  Output feedback with new plans, made with what is estimated, against the same without.
reach     Arms from MJCFs that are pushed on their way, with a plan every 100 ms.
peers     Other people's solvers on the same work, run by run in turn: how long a re-plan takes, what the loop costs.
"""

from dataclasses import dataclass
from typing import Literal, get_args

from replan import changes, common, delay, estimate, peers, reach, times
from runner import Result, Section, measure, opening, report_of, run

Name = Literal["times", "changes", "delay", "estimate", "reach", "peers"]
SECTIONS = {
    "times": Section(times, "How long re-plans take"),
    "changes": Section(changes, "What changes on the way"),
    "delay": Section(delay, "What a delay costs"),
    "estimate": Section(estimate, "Planning again with estimates"),
    "reach": Section(reach, "Arms that are pushed"),
    "peers": Section(peers, "Against other solvers"),
}


@dataclass(frozen=True, kw_only=True)
class Config(common.Config):
    sections: tuple[Name, ...] = get_args(Name)
    """Which of them."""


def main(config: Config) -> Result:
    config = config.bounded()
    return measure(config, SECTIONS, opening(config), keep_as="replanning")


def report(result: Result) -> str:
    return "\n\n".join(["## Re-planning in real time", *report_of(SECTIONS, result)])


if __name__ == "__main__":
    run(Config, main, report, __doc__)
