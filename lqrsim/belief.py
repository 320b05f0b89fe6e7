"""Planning in belief space: dynamics of a mean and a covariance, which depend on what the robot's sensors see."""

from lqrsim.control.controllers import BeliefFeedback
from lqrsim.problem.belief import Belief, NoisySensors
from lqrsim.simulation.disturbances.noise import ReadingErrors

__all__ = ["Belief", "BeliefFeedback", "NoisySensors", "ReadingErrors"]
