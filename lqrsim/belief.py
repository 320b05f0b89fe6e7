"""Planning in belief space: dynamics of a mean and a covariance, which depend on what the robot's sensors see."""

from lqrsim.control.belief_feedback import BeliefFeedback
from lqrsim.problem.belief import Belief, NoisySensors
from lqrsim.simulation.disturbances.sensors import ReadingErrors

__all__ = ["Belief", "BeliefFeedback", "NoisySensors", "ReadingErrors"]
