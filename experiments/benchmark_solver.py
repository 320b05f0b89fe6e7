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

import dataclasses
import json
from dataclasses import asdict
from types import ModuleType
from typing import Any

import peers
import tyro
from peers import Unavailable
from solver_benchmark import peer_comparison, scaling, speed, startup, threads
from solver_benchmark.common import Config, Section

from lqrsim.machine import processors
from lqrsim.versions import versions

SECTIONS: dict[Section, ModuleType] = {
    "speed": speed,
    "peers": peer_comparison,
    "scaling": scaling,
    "threads": threads,
    "startup": startup,
}


def main(config: Config) -> dict[str, Any]:
    if config.quick:
        config = dataclasses.replace(config, queries=min(config.queries, 8), rounds=min(config.rounds, 2))
    result: dict[str, Any] = {
        "config": asdict(config) | {"reference": str(config.reference) if config.reference else None},
        "versions": versions() | peers.versions(),
        "processors": processors(),
    }
    for name in config.sections:
        try:
            result[name] = SECTIONS[name].measure(config)
        except Unavailable as error:
            result[name] = {"skipped": str(error)}
    return result


def report(result: dict[str, Any]) -> str:
    parts = []
    for name, section in SECTIONS.items():
        if name in result:
            found = result[name]
            parts.append(f"{name}: skipped: {found['skipped']}" if "skipped" in found else section.table(found))
    return "\n\n".join(parts)


if __name__ == "__main__":
    settings = tyro.cli(Config, description=__doc__)
    outcome = main(settings)
    print(json.dumps(outcome) if settings.json else report(outcome))
