"""Linear-quadratic smoothing and feedback, and the paper's continuous-time part."""

from lqrsim.solvers.continuous import ContinuousSolution, smooth_continuous, smooth_lq_continuous
from lqrsim.solvers.control_rates import rate_feedback
from lqrsim.solvers.linear_quadratic import Stage, smooth_lq

__all__ = ["ContinuousSolution", "Stage", "rate_feedback", "smooth_continuous", "smooth_lq", "smooth_lq_continuous"]
