"""Registration with Gymnasium, and functions that make environments of any scenario."""

from collections.abc import Container
from typing import Any

import gymnasium

from lqrsim.gym.vector import VectorEnvironment
from lqrsim.scenarios.packaged import Scenario

SCENARIOS = {"lqrsim/Quadrotor-v0": "quadrotor", "lqrsim/DifferentialDrive-v0": "differential_drive"}
ANY = "lqrsim/Scenario-v0"


def register(known: Container[str]) -> None:
    """Register the environments that are not `known` yet."""
    for name, scenario in {**SCENARIOS, ANY: None}.items():
        if name not in known:
            gymnasium.register(
                name,
                entry_point="lqrsim.gym:Environment",
                vector_entry_point="lqrsim.gym:VectorEnvironment",
                kwargs={} if scenario is None else {"scenario": scenario},
            )


def make_env(scenario: str | Scenario, **options: Any) -> gymnasium.Env[Any, Any]:
    """Make the environment of any scenario, with Gymnasium's usual wrappers.

    Args:
      scenario: a Scenario, or a reference as on the command line: a name with settings, "quadrotor,query=3"; a function
        of yours, "my_robot.py:hallway"; an MJCF, "cartpole.xml,start={'pole': 3.14}".
      options: those of `Environment`, and those of `gymnasium.make`.

    Raises:
      InputError: as `Environment` does.
    """
    return gymnasium.make(ANY, scenario=scenario, **options)


def make_vec(scenario: str | Scenario, num_envs: int, **options: Any) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Make many environments of one scenario, run by MuJoCo as one batch: see `VectorEnvironment`.

    Args:
      scenario: as in `make_env`. num_envs: number of environments. options: those of `VectorEnvironment`.

    Raises:
      InputError: as `VectorEnvironment` does.
    """
    return VectorEnvironment(scenario, num_envs=num_envs, **options)
