"""How reliable smooth() is: stiff systems, bad starts, a thousand random problems, and what the safeguard is worth.

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

from reliability import ablation, fragile, overhead, stiff, thousand
from reliability.common import Config
from runner import Result, Section, at_most, measure, opening, report_of, run

SECTIONS = {
    "stiff": Section(stiff),
    "fragile": Section(fragile),
    "random": Section(thousand),
    "overhead": Section(overhead),
    "ablation": Section(ablation),
}


def main(config: Config) -> Result:
    config = at_most(config, queries=8, sample=2, rounds=2, share=0.02)
    return measure(config, SECTIONS, opening(config))


def report(result: Result) -> str:
    return "\n\n".join(report_of(SECTIONS, result))


if __name__ == "__main__":
    run(Config, main, report, __doc__)
