"""Linear-quadratic smoothing, and the paper's continuous-time part."""

from lqrsim.problem.linear_quadratic import Stage
from lqrsim.solvers.continuous import smooth_continuous, smooth_lq_continuous
from lqrsim.solvers.continuous_solution import ContinuousSolution
from lqrsim.solvers.linear_quadratic import smooth_lq

__all__ = [
    "ContinuousSolution",
    "Stage",
    "smooth_continuous",
    "smooth_lq",
    "smooth_lq_continuous",
]
