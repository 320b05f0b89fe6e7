"""Policies that survive: tracking, estimation and safe plans, against the smoother's own policy and RotorPy's law.

    python experiments/robust_policies.py                              # everything, several hours
    python experiments/robust_policies.py --sections presets steady    # some of it
    python experiments/robust_policies.py --sections chances severe --keep F.json   # goes on where it was stopped
    python experiments/robust_policies.py --quick                      # as little as shows how it works

Each section's numbers are in the folder of the output, as JSON, as soon as they are there.

presets  How often the quadrotor reaches its goal under the presets: 20 queries, policies and plans, and RotorPy.
alone    How strong one disturbance alone must be for half of the trials to fail.
steady   A steady wind, a wrong mass: whether it gets there, and what error stays when it hovers.
drive    The differential drive under all disturbances at once.
filter   Whether the filter knows how wrong it is.
emphasis How much less often it collides if its law acts where deviations lead to collisions, at equal cost.
harden   What it costs to bring the measured probability of failure below a request, and whether it is then below it.
chances  The predicted chance of collision against what is measured, for four robots.
severe   What keeps the quadrotor from its goal at 'severe': the plan, the lag, the thrust or the sensors; and how many
         trials have a plan that knows what they meet, which bounds any law.
worlds   Whether safe plans in random worlds keep the chance that they were asked for, and what they cost.
"""

from dataclasses import dataclass
from typing import Literal, get_args

from robust import alone, chances, common, consistency, drive, emphasis, harden, presets, severe, steady, worlds
from runner import Result, Section, measure, opening, report_of, run

Name = Literal["presets", "alone", "steady", "drive", "filter", "emphasis", "harden", "chances", "severe", "worlds"]
SECTIONS = {
    "presets": Section(presets, "All disturbances of a preset"),
    "alone": Section(alone, "One disturbance alone"),
    "steady": Section(steady, "Steady disturbances"),
    "drive": Section(drive, "The differential drive"),
    "filter": Section(consistency, "Consistency of the filter"),
    "emphasis": Section(emphasis, "Effort where deviations lead to collisions"),
    "harden": Section(harden, "Failures put back into the plan"),
    "chances": Section(chances, "Predicted chances of collision"),
    "severe": Section(severe, "What limits severe disturbances"),
    "worlds": Section(worlds, "Safe plans in random worlds"),
}


@dataclass(frozen=True, kw_only=True)
class Config(common.Config):
    sections: tuple[Name, ...] = get_args(Name)
    """Which of them."""


def main(config: Config) -> Result:
    config = config.bounded()
    return measure(config, SECTIONS, opening(config), keep_as="robust_policies")


def report(result: Result) -> str:
    return "\n\n".join(
        [
            "## Policies that survive",
            "What the paper's policy does not do: mind being off its plan, and ask why.",
            *report_of(SECTIONS, result),
        ]
    )


if __name__ == "__main__":
    run(Config, main, report, __doc__)
