"""How good the plans of smooth() are: which optimum, at what price, inside which limits, how far from obstacles.

    python experiments/benchmark_quality.py                            # everything, some twenty minutes
    python experiments/benchmark_quality.py --sections starts limits   # some of it
    python experiments/benchmark_quality.py --quick                    # bounded, and too few to trust

Everything starts exactly where it is to start. Costs and clearances are recomputed from the controls by the same NumPy
code, peers/truth.py, whoever planned them. Crocoddyl's FDDP and IPOPT need pip install 'lqrsim[bench]', and g++; where
they are missing they are left out, and that is said.

starts       Three times a hundred quadrotor queries, without limits of the controls: what the plans cost, and how many
             are within 1 % of the lowest cost known, whoever found it. Those are in best_known.json, in a folder given
             by --reference or $LQRSIM_REFERENCE, or else in shared/reference beside the repository. Our plans that cost
             less than that are in quality/best_plans.npz: that is what --save writes.
time         The same in turns, on one thread, against FDDP and IPOPT.
clearance    With a clearance to be kept: at the steps, between them, with a margin; and what that costs.
limits       With narrow limits of the controls: kept to the last bit, and what IPOPT makes of the same limits, from the
             straight line and from our plan.
worlds       Random worlds of both robots, one in five nearly blocked; settings untouched.
resolve      Started with a solution of a similar problem: of a horizon that moved along, of another goal.
ingredients  What each choice of the search brings; see lqrsim/solvers/multistart.py.
finish       Newton's method at the end against smoothing alone, from hover: iterations to 1e-8, and whether both end in
             the same optimum.
"""

import peers
from quality import clearances, finish, ingredients, limits, random_worlds, resolve, starts, timing
from quality.common import Config
from runner import Result, Section, measure, opening, report_of, run

SECTIONS = {
    "starts": Section(starts),
    "time": Section(timing),
    "clearance": Section(clearances),
    "limits": Section(limits),
    "worlds": Section(random_worlds),
    "resolve": Section(resolve),
    "ingredients": Section(ingredients),
    "finish": Section(finish),
}


def main(config: Config) -> Result:
    config = config.bounded()
    result = opening(config)
    result["versions"] |= peers.versions()
    return measure(config, SECTIONS, result)


def report(result: Result) -> str:
    return "\n\n".join(report_of(SECTIONS, result))


if __name__ == "__main__":
    run(Config, main, report, __doc__)
