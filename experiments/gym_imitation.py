"""A learner that imitates the policy in an environment of Gymnasium, beside the policy and beside its plan alone.

    pip install 'lqrsim[gym]'
    python experiments/gym_imitation.py
    python experiments/gym_imitation.py --quick       # fewer episodes

The expert acts in `--episodes` disturbed episodes. What it saw and did is all that the learner gets: it fits actions by
ridge regression on the observed state, with coefficients that are piecewise linear in time. A second learner gets the
time alone, which is imitation without feedback. All of them then meet the same new episodes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from runner import Settings, opening, run, table

import lqrsim.gym

RIDGE = 1e-6  # beside features of unit variance


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    scenario: str = "differential_drive"
    """What `lqrsim.gym.make_vec` makes."""
    disturbances: str = "moderate"
    """A preset, for training and for tests."""
    episodes: int = 100
    """Of the expert, to learn from."""
    tests: int = 200
    """Episodes that all meet, none of which is learnt from."""
    knots: int = 20
    """Of the coefficients, evenly in time."""
    seed: int = 0
    """Of the training; the tests have the next one."""


class Learner:
    """Actions as a linear function of the state, with coefficients that are piecewise linear in time.

    Args:
      observations, actions: (k, n+1) and (k, m), to learn from. knots: of the coefficients.
      feedback: whether it may look at the state, or at the time alone.
    """

    def __init__(self, observations: np.ndarray, actions: np.ndarray, knots: int, *, feedback: bool) -> None:
        self._feedback, self._knots = feedback, knots
        states = observations[:, :-1]
        self._mean, spread = states.mean(axis=0), states.std(axis=0)
        self._scale = np.where(spread > 0, spread, 1.0)
        features = self._features(observations)
        square = features.T @ features + RIDGE * len(features) * np.eye(features.shape[1])
        self._weights = np.linalg.solve(square, features.T @ actions)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        return self._features(observations) @ self._weights

    def _features(self, observations: np.ndarray) -> np.ndarray:
        """(k, knots * (1 + n)): hats in time, alone and times each state."""
        at = observations[:, -1] * (self._knots - 1)
        hats = np.maximum(1 - np.abs(at[:, None] - np.arange(self._knots)), 0.0)
        if not self._feedback:
            return hats
        states = (observations[:, :-1] - self._mean) / self._scale
        seen = np.column_stack([np.ones(len(states)), states])
        return (hats[:, :, None] * seen[:, None, :]).reshape(len(states), -1)


def run_episodes(
    env: lqrsim.gym.VectorEnvironment, act: Callable[[np.ndarray], np.ndarray], seed: int
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Observations (k, n+1) and actions (k, m) of all episodes while they go on, and how these ended."""
    observations, info = env.reset(seed=seed)
    going, returns = np.ones(env.num_envs, dtype=bool), np.zeros(env.num_envs)
    seen, done = [], []
    while going.any():
        actions = act(observations)
        seen.append(observations[going])
        done.append(actions[going])
        observations, rewards, terminated, truncated, info = env.step(actions)
        returns, going = returns + rewards, ~(terminated | truncated)
    outcome = info["outcome"]
    whole = np.isin(outcome, ("reached", "timed out"))
    told = {
        "reached": int((outcome == "reached").sum()), "collided": int((outcome == "collided").sum()),
        "episodes": len(outcome), "return": float(np.median(returns[whole])) if whole.any() else None,
    }  # fmt: skip
    return np.concatenate(seen), np.concatenate(done), told


def main(config: Config) -> dict[str, Any]:
    episodes, tests = (10, 20) if config.quick else (config.episodes, config.tests)
    options: dict[str, Any] = {"disturbances": config.disturbances}
    training: Any = lqrsim.gym.make_vec(config.scenario, episodes, **options)
    testing: Any = lqrsim.gym.make_vec(config.scenario, tests, solution=training.solution, **options)
    observations, actions, _ = run_episodes(training, lqrsim.gym.Expert(training), config.seed)
    agents = {
        "the policy": lqrsim.gym.Expert(testing),
        "learnt, with the state": Learner(observations, actions, config.knots, feedback=True),
        "learnt, time alone": Learner(observations, actions, config.knots, feedback=False),
    }
    tested = {name: run_episodes(testing, act, config.seed + 1)[2] for name, act in agents.items()}
    return opening(config) | {"samples": len(actions), "agents": tested}


def report(result: dict[str, Any]) -> str:
    """A table with a row per agent."""
    rows = [
        [
            name, f"{one['reached']} of {one['episodes']}", one["collided"],
            "none" if one["return"] is None else f"{one['return']:.1f}",
        ]
        for name, one in result["agents"].items()
    ]  # fmt: skip
    config = result["config"]
    head = f"{config['scenario']} under {config['disturbances']}, learnt from {result['samples']} actions\n\n"
    return head + table(("agent", "reached", "collided", "return, median of whole episodes"), rows)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
