"""Planning in belief space: dynamics of a mean and a covariance, which depend on what the robot's sensors see."""

from lqrsim.problem.belief import Belief, NoisySensors

__all__ = ["Belief", "NoisySensors"]
