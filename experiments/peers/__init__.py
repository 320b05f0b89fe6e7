"""Other people's solvers, controllers and gains, to compare with, and what plans are worth.

Each solver solves the problem that lqrsim solves, but for the start: none has a soft one, so the state at t = 0 is
given. What does not change from query to query is made once, before anything is timed. One thread.

Crocoddyl  its FDDP, and its box-FDDP, with the limits of the controls; `fddp.py`.

For any problem of formulas (`formulas.py`):

Shooting   IPOPT and Fatrop through CasADi, with all constraints; `shooting.py`.
BoxFddp    Crocoddyl's box-FDDP, with the limits of the controls alone; `box_fddp.py`.

RotorPy    its SE(3) controller, along the plan of a quadrotor's solution; `rotorpy.py`.
drake      gains of Drake's linear-quadratic regulators; `drake.py`.

`cost_of`, `rollout` and `clearance_of` recompute what a plan costs, where it leads, and how near it comes to obstacles;
`cost_along` what a run costs. `contestants.py` has what comparisons share: lqrsim's solvers beside these, and times.
"""

from peers import drake
from peers.box_fddp import BoxFddp
from peers.common import Answer, Unavailable, versions
from peers.fddp import MAX_ITERATIONS, TOLERANCE, Crocoddyl
from peers.rotorpy import RotorPy
from peers.shooting import Shooting
from peers.truth import clearance_of, cost_along, cost_of, rollout

__all__ = [
    "MAX_ITERATIONS", "TOLERANCE", "Answer", "BoxFddp", "Crocoddyl", "RotorPy", "Shooting", "Unavailable",
    "clearance_of", "cost_along", "cost_of", "drake", "rollout", "versions",
]  # fmt: skip
