"""Plans under noise that depends on state and control, and with a risk: what they are expected to cost, and do cost.

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
from types import ModuleType
from typing import Any, Literal

from paper.common import Result, Statement, opening, run
from stochastic import common, growth, iterated, planning, prediction, risks, timing

Section = Literal["prediction", "planning", "ilqg", "time", "growth", "risk"]
SECTIONS: dict[Section, tuple[ModuleType, str]] = {
    "prediction": (prediction, "What is expected"),
    "planning": (planning, "What knowing of the noise is worth"),
    "ilqg": (iterated, "Against iLQG"),
    "time": (timing, "What it takes"),
    "growth": (growth, "As noise grows"),
    "risk": (risks, "Risk"),
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
    return result


def report(result: Result) -> str:
    parts = ["## Plans under noise", "Noise that depends on state and control in the plan itself, and a risk."]
    for name, (section, title) in SECTIONS.items():
        if name in result:
            parts += [f"### {title}", *section.report(result[name])]
    return "\n\n".join(parts)


def statements(result: Result) -> list[Statement]:
    """None: the paper says nothing of noise."""
    return []


if __name__ == "__main__":
    run(Config, main, report, statements, __doc__)
