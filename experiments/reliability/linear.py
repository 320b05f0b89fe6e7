"""Linear-quadratic problems, stated as any other: stable and unstable, with singular weights, with cross terms."""

import numpy as np
import systems
from numpy.random import Generator

import lqrsim as ls
from lqrsim.errors import Array

SIZES = ((2, 1), (3, 2), (4, 2), (6, 3))  # states and controls; each is compiled once, for matrices are data


def draw(rng: Generator, states: int, controls: int) -> ls.Problem:
    """One of them. Half have a fixed start, and half a cost in which states and controls are multiplied."""
    n, m = states, controls
    a = rng.normal(size=(n, n))
    # From well damped to doubling in half a second, whatever came out.
    a += (rng.uniform(-2.0, 1.4) - np.linalg.eigvals(a).real.max()) * np.eye(n)
    dynamics = systems.linear(a, rng.normal(size=(n, m)), rng.normal(scale=0.3, size=n))
    cross = _semidefinite(rng, n + m, rank=int(rng.integers(1, n + m + 1))) * _scale(rng, 0.1, 10)
    if rng.random() < 0.5:
        cross *= 0.0
    fixed, start = rng.random() < 0.5, rng.normal(size=n)
    return ls.Problem(
        dynamics=dynamics,
        dt=float(rng.uniform(0.05, 0.4) / np.linalg.norm(a, 2)),
        steps=int(rng.integers(5, 101)),
        initial=ls.FixedState(start)
        if fixed
        else ls.QuadraticCost(_definite(rng, n) * _scale(rng, 1, 100), about=start),
        stage_cost=systems.stage_cost(
            ls.ControlCost(_definite(rng, m) * _scale(rng, 0.01, 10), about=rng.normal(size=m)),
            ls.QuadraticCost(_state_weight(rng, n) * _scale(rng, 0.1, 10), about=rng.normal(size=n)),
            cross,
        ),
        final_cost=ls.QuadraticCost(_state_weight(rng, n) * _scale(rng, 1, 1000), about=rng.normal(size=n)),
    )


def _scale(rng: Generator, low: float, high: float) -> float:
    """Between the two, all orders of magnitude alike."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _semidefinite(rng: Generator, size: int, rank: int) -> Array:
    root = rng.normal(size=(size, rank))
    return root @ root.T / size


def _definite(rng: Generator, size: int) -> Array:
    return _semidefinite(rng, size, size) + 0.1 * np.eye(size)


def _state_weight(rng: Generator, size: int) -> Array:
    """Of any rank, down to none."""
    return _semidefinite(rng, size, int(rng.integers(0, size + 1)))
