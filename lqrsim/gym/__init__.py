"""Scenarios as environments of Gymnasium; the extra `gym` brings what it needs.

    import gymnasium
    import lqrsim.gym

    env = gymnasium.make("lqrsim/Quadrotor-v0", disturbances="moderate")
    env = lqrsim.gym.make_env("my_robot.py:hallway")

Importing this registers lqrsim/Quadrotor-v0, lqrsim/DifferentialDrive-v0 and lqrsim/Scenario-v0.
"""

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ImportError(f"lqrsim.gym: {error}; want what `pip install 'lqrsim[gym]'` installs") from None

from lqrsim.gym.environment import Environment
from lqrsim.gym.expert import Expert
from lqrsim.gym.registered import make_env, make_vec, register
from lqrsim.gym.vector import VectorEnvironment

__all__ = ["Environment", "Expert", "VectorEnvironment", "make_env", "make_vec"]

register(gymnasium.registry)
