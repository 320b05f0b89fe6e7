"""Plans under noise that depends on state and control, and with a risk: their expected costs, and the costs of runs.

    python experiments/noise_aware.py                             # everything, a few minutes
    python experiments/noise_aware.py --sections prediction risk  # some of it
    python experiments/noise_aware.py --quick                     # as little as shows how it works

prediction  Expected cost against the mean of many runs, both robots.
planning    Plans that know of the noise against plans that do not, on the same trials.
ilqg        The smoother against iLQR under the same noise.
time        What an iteration takes with noise, against one without.
growth      What plans become as noise grows.
risk        What a growing risk makes of the spread of costs.
"""

from dataclasses import dataclass
from typing import Literal, get_args

from runner import Result, Section, measure, opening, report_of, run
from stochastic import common, growth, iterated, planning, prediction, risks, timing

Name = Literal["prediction", "planning", "ilqg", "time", "growth", "risk"]
SECTIONS = {
    "prediction": Section(prediction, "What is expected"),
    "planning": Section(planning, "What knowing of the noise is worth"),
    "ilqg": Section(iterated, "Against iLQG"),
    "time": Section(timing, "What it takes"),
    "growth": Section(growth, "As noise grows"),
    "risk": Section(risks, "Risk"),
}


@dataclass(frozen=True, kw_only=True)
class Config(common.Config):
    sections: tuple[Name, ...] = get_args(Name)
    """Which of them."""


def main(config: Config) -> Result:
    config = config.bounded()
    return measure(config, SECTIONS, opening(config))


def report(result: Result) -> str:
    return "\n\n".join(
        [
            "## Plans under noise",
            "Noise that depends on state and control in the plan itself, and a risk; trials are by the problem's own"
            " model.",
            *report_of(SECTIONS, result),
        ]
    )


if __name__ == "__main__":
    run(Config, main, report, __doc__)
