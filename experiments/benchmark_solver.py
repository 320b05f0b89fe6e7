"""How fast the solvers are, and against what: C++, a peer, larger problems, two threads, a fresh process.

    python experiments/benchmark_solver.py                          # everything, some five minutes
    python experiments/benchmark_solver.py --sections speed peers   # some of it
    python experiments/benchmark_solver.py --quick                  # bounded, and too short to trust

Contestants take turns within one process, a few queries at a time, and their ratios are compared: the absolute times of
a machine that others use too wander by far more than the ratios do. Times are of the whole public call unless they say
otherwise. The problem is the quadrotor's, with the paper's stop test (relative change of cost below 1e-4).

speed     Against the C++ reference, one thread. The reference is no part of this project: a folder with its
          reference.py, given by --reference or $LQRSIM_REFERENCE, or else found in shared/reference beside the
          repository. Needs g++. And symbolic dynamics against the same written by hand for numba: in place of what the
          symbolic ones wrote ("by hand"), and as a user would give them, ls.Dynamics(f, jacobian=...), which compiled
          code calls at an address ("compiled level").
peers     Against Crocoddyl's FDDP (pip install 'lqrsim[bench]', and g++): time a query, and the cost that is reached
          from a start that is given exactly. peers/ says what is timed.
scaling   Time of an iteration as the states grow (a chain of masses, three states each), and time and memory as the
          horizon grows.
threads   smooth_many on two threads against one.
startup   Fresh processes: --help, the first solution with warm caches, and with empty ones.
"""

import peers
from runner import Result, Section, at_most, measure, opening, report_of, run
from solver_benchmark import peer_comparison, scaling, speed, startup, threads
from solver_benchmark.common import Config

SECTIONS = {
    "speed": Section(speed),
    "peers": Section(peer_comparison),
    "scaling": Section(scaling),
    "threads": Section(threads),
    "startup": Section(startup),
}


def main(config: Config) -> Result:
    config = at_most(config, queries=8, rounds=2)
    result = opening(config)
    result["versions"] |= peers.versions()
    return measure(config, SECTIONS, result)


def report(result: Result) -> str:
    return "\n\n".join(report_of(SECTIONS, result))


if __name__ == "__main__":
    run(Config, main, report, __doc__)
