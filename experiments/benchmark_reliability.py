"""How reliable smooth() is: stiff systems, bad advice, a thousand random problems, and what the safeguard is good for.

    python experiments/benchmark_reliability.py                            # everything, some minutes
    python experiments/benchmark_reliability.py --sections stiff fragile   # some of it
    python experiments/benchmark_reliability.py --quick                    # bounded, and too few to trust

Statuses, gaps and optimality are what solutions say of themselves; tests/test_reliability.py checks that independently.
Here iLQR tries: from the plan, iterated to 1e-9, it should find next to nothing left to improve. "Handed over" counts
the problems in which the safeguard left the rest to iLQR.

stiff     The quadrotor with drag such that drag/mass times dt is 0.01 to 1, from a fixed start.
fragile   The quadrotor with a prior along the straight line, with and without the safeguard.
random    A thousand random problems: linear-quadratic ones, robots among obstacles, classics of optimal control.
overhead  That the safeguard costs nothing where it is not needed: the same iterations and bits, and the time.
ablation  The quadrotor's queries with and without each part: form, start, prior, safeguard.
"""

import dataclasses
import json
from dataclasses import asdict
from types import ModuleType
from typing import Any

import tyro
from reliability import ablation, fragile, overhead, stiff, thousand
from reliability.common import Config, Section

from lqrsim.machine import processors
from lqrsim.versions import versions

SECTIONS: dict[Section, ModuleType] = {
    "stiff": stiff,
    "fragile": fragile,
    "random": thousand,
    "overhead": overhead,
    "ablation": ablation,
}


def main(config: Config) -> dict[str, Any]:
    if config.quick:
        few = {"queries": min(config.queries, 8), "sample": min(config.sample, 2), "rounds": min(config.rounds, 2)}
        config = dataclasses.replace(config, share=min(config.share, 0.02), **few)
    result: dict[str, Any] = {"config": asdict(config), "versions": versions(), "processors": processors()}
    for name in config.sections:
        result[name] = SECTIONS[name].measure(config)
    return result


def report(result: dict[str, Any]) -> str:
    return "\n\n".join(section.table(result[name]) for name, section in SECTIONS.items() if name in result)


if __name__ == "__main__":
    settings = tyro.cli(Config, description=__doc__)
    outcome = main(settings)
    print(json.dumps(outcome) if settings.json else report(outcome))
