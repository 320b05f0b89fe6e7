"""Comparisons of solutions and of noise that several test files use."""

import dataclasses

import numpy as np

import lqrsim as ls


def fixed(problem: ls.Problem) -> ls.Problem:
    """The problem with its wished start as a fixed start."""
    assert problem.start is not None
    return dataclasses.replace(problem, initial=ls.FixedState(problem.start))


def same(one: ls.Solution, other: ls.Solution) -> bool:
    """Whether two are equal to the last bit."""
    pairs = [(one.policy.gain, other.policy.gain), (one.policy.offset, other.policy.offset)]
    pairs += [(one.trajectory.states, other.trajectory.states), (one.trajectory.controls, other.trajectory.controls)]
    return one.status is other.status and all(np.array_equal(a, b) for a, b in pairs)


def assert_white(noise, std):
    """Noise (trials, steps, d): mean 0, the stated std, no correlation in time, across trials or between channels.

    Each within five of its standard errors over N samples: 1 / sqrt(N), for the std 1 / sqrt(2 N). The seed is fixed.
    """
    std = np.broadcast_to(std, noise.shape[-1])
    scaled, root = noise / std, np.sqrt(noise[..., 0].size)
    assert np.abs(scaled.mean(axis=(0, 1))).max() < 5 / root
    assert np.abs(scaled.std(axis=(0, 1)) - 1).max() < 5 / (np.sqrt(2) * root)
    assert np.abs((scaled[:, 1:] * scaled[:, :-1]).mean(axis=(0, 1))).max() < 5 / root
    assert np.abs((scaled[1:] * scaled[:-1]).mean(axis=(0, 1))).max() < 5 / root
    assert np.abs((scaled[..., 1:] * scaled[..., :-1]).mean(axis=(0, 1))).max() < 5 / root
