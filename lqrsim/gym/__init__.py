"""Scenarios as environments of Gymnasium; needs the extra `gym`.

    import gymnasium
    import lqrsim.gym

    env = gymnasium.make("lqrsim/Quadrotor-v0", disturbances="moderate")
    env = lqrsim.gym.make_env("my_robot.py:hallway")

Importing this registers lqrsim/Quadrotor-v0, lqrsim/DifferentialDrive-v0 and lqrsim/Scenario-v0.
"""

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ImportError(f"lqrsim.gym: {error}; run: pip install 'lqrsim[gym]'") from None

from lqrsim.gym.environment import Environment
from lqrsim.gym.expert import Expert
from lqrsim.gym.registered import make_env, make_vec, register
from lqrsim.gym.vector import VectorEnvironment

__all__ = ["Environment", "Expert", "VectorEnvironment", "make_env", "make_vec"]

register(gymnasium.registry)
