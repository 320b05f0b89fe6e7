"""Other people's solvers, controllers and gains for lqrsim's two robots, to compare with, and what plans are worth.

Each solver solves the problem that lqrsim solves, but for the start: none has a soft one, so the state at t = 0 is
given. What does not change from query to query is made once, before anything is timed. One thread.

Crocoddyl  its FDDP, and its box-FDDP, with the limits of the controls; `fddp.py`.
Ipopt      IPOPT through CasADi, with the limits of the controls and a clearance to be kept; `ipopt.py`.
Fatrop     Fatrop through CasADi, with the limits of the controls, from a plan; `fatrop.py`.

For any problem of formulas (`formulas.py`), with all its constraints: IPOPT and Fatrop in `shooting.py`; without
constraints box-FDDP in `box_fddp.py`.

RotorPy    its SE(3) controller, along the plan of a quadrotor's solution; `rotorpy.py`.
drake      gains of Drake's linear-quadratic regulators; `drake.py`.

`cost_of`, `rollout` and `clearance_of` recompute what a plan costs, where it leads, and how near it comes to obstacles;
`cost_along` what a run costs.
"""

from peers import drake
from peers.common import Answer, Unavailable, versions
from peers.fatrop import Fatrop
from peers.fddp import MAX_ITERATIONS, TOLERANCE, Crocoddyl
from peers.ipopt import Ipopt
from peers.rotorpy import RotorPy
from peers.truth import clearance_of, cost_along, cost_of, rollout

__all__ = [
    "MAX_ITERATIONS", "TOLERANCE", "Answer", "Crocoddyl", "Fatrop", "Ipopt", "RotorPy", "Unavailable", "clearance_of",
    "cost_along", "cost_of", "drake", "rollout", "versions",
]  # fmt: skip
