"""Scenarios as Gymnasium environments; needs the extra `gym`.

    import gymnasium
    import lqrsim.gym

    env = gymnasium.make("lqrsim/Quadrotor-v0", disturbances="moderate")
    env = lqrsim.gym.make_env("my_robot.py:hallway")

Importing this module registers lqrsim/Quadrotor-v0, lqrsim/DifferentialDrive-v0 and lqrsim/Scenario-v0. If only a name
can be given, as in a trainer's configuration, "lqrsim.gym:lqrsim/Quadrotor-v0" imports the module, too. Gymnasium
has not read entry points since version 1.0.
"""

from typing import Any

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ImportError(f"lqrsim.gym: {error}; run: pip install 'lqrsim[gym]'") from None

from lqrsim.gym.environment import Environment, Expert, VectorEnvironment
from lqrsim.gym.minari_data import write_minari
from lqrsim.scenarios.packaged import Scenario

__all__ = ["Environment", "Expert", "VectorEnvironment", "make_env", "make_vec", "write_minari"]

SCENARIOS = {"lqrsim/Quadrotor-v0": "quadrotor", "lqrsim/DifferentialDrive-v0": "differential_drive"}
ANY_SCENARIO = "lqrsim/Scenario-v0"


def make_env(scenario: str | Scenario, **options: Any) -> gymnasium.Env[Any, Any]:
    """Make the environment of any scenario, with Gymnasium's usual wrappers.

    Args:
      scenario: a Scenario, or a reference as on the command line: a name with settings, "quadrotor,query=3"; your own
        function, "my_robot.py:hallway"; an MJCF, "cartpole.xml,start={'pole': 3.14}".
      options: options of `Environment` and of `gymnasium.make`.
    """
    return gymnasium.make(ANY_SCENARIO, scenario=scenario, **options)


def make_vec(scenario: str | Scenario, num_envs: int, **options: Any) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Make many environments of one scenario, run by MuJoCo as one batch, with options of `VectorEnvironment`."""
    return VectorEnvironment(scenario, num_envs=num_envs, **options)


for _name, _scenario in {**SCENARIOS, ANY_SCENARIO: None}.items():
    if _name not in gymnasium.registry:
        gymnasium.register(
            _name, entry_point="lqrsim.gym:Environment", vector_entry_point="lqrsim.gym:VectorEnvironment",
            kwargs={} if _scenario is None else {"scenario": _scenario},
        )  # fmt: skip
