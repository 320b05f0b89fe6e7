"""Arguments that public callables accept: environments of Gymnasium. See `subjects.py`."""

import os
import tempfile
from typing import Any
from unittest import mock

import numpy as np

import lqrsim.gym
from robustness.place import Place


def environments(place: Place) -> dict[str, tuple[Any, ...]]:
    options = {"solution": place.solution, "disturbances": ("light:ControlNoise",), "strength": 0.5}
    made = lqrsim.gym.Environment(place.scenario, **options)
    many = lqrsim.gym.VectorEnvironment(place.scenario, num_envs=2, solution=place.solution, threads=1)
    expert = lqrsim.gym.Expert(made)
    seen, _ = made.reset(seed=0)
    many.reset(seed=0)
    asked = {"seed": 1, "options": {"preset": "light", "strength": 0.5, "trial": 3}}
    scenario = {"scenario": place.scenario}
    pictures = {"actions": "controls", "render_mode": "rgb_array", "camera": "top", "size": (128, 96)}

    def step(action: Any) -> Any:
        made.reset(seed=0)
        return made.step(action)

    def step_many(actions: Any) -> Any:
        many.reset(seed=0)
        return many.step(actions)

    def write(**arguments: Any) -> None:
        """Where nothing is yet, and nobody looks."""
        with tempfile.TemporaryDirectory() as empty, mock.patch.dict(os.environ, MINARI_DATASETS_PATH=empty):
            lqrsim.gym.write_minari(**arguments)

    return {
        "gym.make_env": (scenario | options, 0.3),
        "gym.make_vec": (scenario | {"num_envs": 2} | options, 0.3),
        "gym.Environment": (scenario | options | pictures, 0.3),
        "gym.Environment.reset": ({"call": made.reset, **asked},),
        "gym.Environment.step": ({"call": step, "action": np.zeros(2)},),
        "gym.VectorEnvironment": (
            scenario | {"num_envs": 2, "actions": "controls", "threads": 1, "frames": False} | options, 0.3,
        ),
        "gym.VectorEnvironment.reset": ({"call": many.reset, **asked},),
        "gym.VectorEnvironment.step": ({"call": step_many, "actions": np.zeros((2, 2))},),
        "gym.Expert": ({"env": made, "controller": place.solution.policy},),
        "gym.Expert.__call__": ({"call": expert, "observation": seen},),
        "gym.write_minari": ({"call": write, "name": "tiny/run-v0", "env": made, "rollouts": place.rollout},),
    }  # fmt: skip
