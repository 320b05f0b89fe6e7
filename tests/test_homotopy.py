"""Which way a path goes round pillars: paths of which it is known."""

from importlib import import_module

import numpy as np
import pytest

import lqrsim as ls
from lqrsim.errors import Array

way = import_module("paper.homotopy").way

PILLARS = np.array([[0.0, -1.0], [0.7, 0.4], [-0.6, 1.3]])
SOUTH, NORTH = (0.0, -3.0), (0.0, 3.0)


def through(*places: tuple[float, float]) -> Array:
    """Straight from the south over these places to the north."""
    return np.array([SOUTH, *places, NORTH])


def circle(point: Array, turns: int, radius: float = 0.3) -> list[tuple[float, float]]:
    """Counterclockwise about a point, from the south of it and back there."""
    angles = np.linspace(0, 2 * np.pi * turns, 24 * abs(turns) + 1) - np.pi / 2
    return [(point[0] + radius * np.cos(angle), point[1] + radius * np.sin(angle)) for angle in angles]


def test_the_sides_of_pillars_in_their_order() -> None:
    assert way(through((-2, 0)), PILLARS) == (1, 2, 3)
    assert way(through((2, 0)), PILLARS) == ()
    assert way(through((-0.5, -1), (0, 0), (0, 1.4)), PILLARS) == (1, 2)
    assert way(through((0.5, -1), (1.2, 0.4), (-1.2, 1.5)), PILLARS) == (3,)
    assert way(through((2, 0))[::-1], PILLARS) == ()
    assert way(through((-2, 0))[::-1], PILLARS) == (-3, -2, -1)


def test_loops_count_and_detours_do_not() -> None:
    start = through((1.5, -2.5))[:2]
    for turns, letters in ((1, (-1,)), (-1, (1,)), (2, (-1, -1)), (-3, (1, 1, 1))):
        path = np.vstack([start, circle(PILLARS[0], turns), (1.5, -2.5), (2, 0), NORTH])
        assert way(path, PILLARS) == letters
    there_and_back = through((-2, -0.8), (-2, 2), (-2, -0.8), (-2, -2.5), (2, -2.5), (2, 0))
    assert way(there_and_back, PILLARS) == ()
    about_nothing = np.vstack([start, circle(np.array([1.8, 0.0]), 2), NORTH])
    assert way(about_nothing, PILLARS) == ()


def test_more_than_the_angles_about_the_pillars_tell() -> None:
    """About one and another, then back about the one and the other: no angle is left, and yet no way to undo it."""
    foot, aside = (1.5, -2.5), (1.5, 0.1)

    def one(turns: int) -> list[tuple[float, float]]:
        return [foot, *circle(PILLARS[0], turns), foot]

    def other(turns: int) -> list[tuple[float, float]]:
        return [foot, aside, *circle(PILLARS[1], turns), aside, foot]

    path = np.array([*one(1), *other(1), *one(-1), *other(-1)])
    np.testing.assert_allclose(turned(path), 0, atol=1e-12)
    assert way(path, PILLARS) == (-1, -2, 1, 2)
    assert way(np.vstack([path, path[::-1]]), PILLARS) == ()


def turned(path: Array) -> Array:
    """By how many turns a path goes round each pillar, counterclockwise."""
    angles = np.arctan2(*np.moveaxis(path[:, None] - PILLARS, -1, 0)[::-1])
    steps = np.diff(angles, axis=0)
    return np.sum((steps + np.pi) % (2 * np.pi) - np.pi, axis=0) / (2 * np.pi)


@pytest.mark.parametrize("seed", range(20))
def test_random_paths(seed: int) -> None:
    """Closed ones agree with the angles that they turn by; no knot that is added, or moved a little, changes a way."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-2, 2, (12, 2))
    closed = np.vstack([corners, corners[:1]])
    steps = np.linspace(0, len(corners), 4001)
    fine = np.stack([np.interp(steps, np.arange(len(closed)), values) for values in closed.T], axis=1)
    word = way(closed, PILLARS)
    counted = [sum(int(np.sign(letter)) for letter in word if abs(letter) == point) for point in (1, 2, 3)]
    np.testing.assert_allclose(turned(closed), np.negative(counted), atol=1e-9)
    assert way(fine, PILLARS) == word
    if np.linalg.norm(fine[:, None] - PILLARS, axis=-1).min() > 0.02:
        moved = fine + np.pad(rng.uniform(-0.01, 0.01, (len(fine) - 2, 2)), ((1, 1), (0, 0)))
        assert way(moved, PILLARS) == word
    tilted = way(closed, PILLARS, (0.3, 1.0))
    assert (tilted == ()) == (word == ()), "whether a loop can be drawn together does not depend on the rays"


def test_a_knot_on_a_ray_counts_once() -> None:
    pillar = np.array([[0.5, 0.0]])
    for west in (-1.0, 0.0):
        path = through((west, 0.0))
        assert way(path, pillar, (-1.0, 0.0)) == (1,)
    touching = np.array([SOUTH, (-1.0, 0.0), SOUTH])
    assert way(touching, pillar, (-1.0, 0.0)) == ()
    assert way(-touching, pillar, (-1.0, 0.0)) == ()
    along = through((-1.0, 0.0), (-0.5, 0.0))
    assert way(along, pillar, (-1.0, 0.0)) == (1,)


def test_rays_on_one_another_are_refused() -> None:
    with pytest.raises(ValueError, match="no ray lies on another"):
        way(through(), np.array([[0.0, 0.0], [1.0, 0.0]]), (-1.0, 0.0))
    way(through(), np.array([[0.0, 0.0], [1.0, 0.0]]))


def test_the_arena_of_fig_2() -> None:
    """Along its walls, and between any two of its pillars."""
    obstacles = ls.load_scene("arena").world.obstacles
    pillars = np.array([one.position[:2] for one in obstacles if one.kind == "cylinder"])
    west = way(np.array([(0, -2.5), (-1.7, -2.5), (-1.7, 2.5), (0, 2.5)]), pillars)
    assert sorted(west) == list(range(1, 12))
    assert way(np.array([(0, -2.5), (1.7, -2.5), (1.7, 2.5), (0, 2.5)]), pillars) == ()
