"""Robots that are convex polygons: distances, costs and plans."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples
from scipy.spatial import ConvexHull

import lqrsim as ls
from lqrsim.codegen.distances import hull_distances
from lqrsim.errors import Array
from lqrsim.problem.derivative_check import evaluate

CAR, TRAILER = ls.types.Box(0.5, 0.25), ls.types.Box(0.3, 0.25)


def outline(x, p):
    from sympy import cos, sin

    behind = (x.px - cos(x.b) / 2, x.py - sin(x.b) / 2)
    return [*CAR.corners((x.px, x.py), x.a), *TRAILER.corners(behind, x.b)]


def rate(x, u, p):
    from sympy import cos, sin, tan

    return [u.v * cos(x.a), u.v * sin(x.a), u.v / 0.25 * tan(u.steer), u.v / 0.5 * sin(x.a - x.b)]


DYNAMICS = ls.Dynamics(
    rate, states={"px": "m", "py": "m", "a": "rad", "b": "rad"}, controls={"v": "m/s", "steer": "rad"},
    position=("px", "py"), angles=("a", "b"), control_limits={"v": (-0.1, 0.5), "steer": (-1.0, 1.0)},
)  # fmt: skip
HULLS = ls.CollisionSpheres(outline, 0.0, hulls=[4, 4], names=["car", "trailer"])


def box(x: float, y: float, length: float, width: float, angle: float = 0.0, standing: int = 2) -> ls.Obstacle:
    """A box on the plane that stands on one of its axes."""
    c, s, order = np.cos(angle), np.sin(angle), np.roll(np.arange(3), standing + 1)
    rotation, size = np.eye(3), np.ones(3)
    rotation[:, order] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    size[order] = length / 2, width / 2, 1.0
    return ls.Obstacle(f"box {x:g} {y:g}", "box", np.array([x, y, 0.0]), rotation, size)


WORLD = ls.World([box(1.0, 0.42, 0.2, 0.8), box(1.7, -0.42, 0.2, 0.8, standing=0)])
ROUND = ls.Obstacle("post", "cylinder", np.array([0.4, 0.7, 0.0]), np.eye(3), np.array([0.2, 1.0, 0.0]))
WALL = ls.Obstacle("wall", "plane", np.array([0.0, -1.0, 0.0]), np.eye(3)[:, [2, 0, 1]], np.zeros(3))


def separated(own: Array, other: Array) -> float:
    """The signed distance of two polygons: that of the origin to Qhull's hull of all differences of their corners."""
    apart = (own[:, None] - other[None]).reshape(-1, 2)
    hull = ConvexHull(apart)
    depth = float(hull.equations[:, -1].max())
    if depth <= 0:
        return depth
    ends = apart[hull.simplices]
    sides = ends[:, 1] - ends[:, 0]
    share = np.clip(-(ends[:, 0] * sides).sum(axis=1) / (sides**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(ends[:, 0] + share[:, None] * sides, axis=1).min())


@settings(max_examples=examples(60))
@given(st.integers(0, 2**32 - 1), st.integers(1, 7), st.booleans())
def test_distances_are_those_of_the_difference_of_both(seed: int, count: int, backwards: bool) -> None:
    """To rounding, in any order of the corners, for any axis on which a box stands; slopes against differences.

    The differences are over 1e-6 m: their rounding, and curvatures of some 100 / m, make 1e-4.
    """
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count, 2)) * 0.5
    if count > 2:
        corners = corners[ConvexHull(corners).vertices]
    corners = corners[::-1] if backwards else corners
    x, y, angle = rng.uniform(-1, 1, 3)
    length, width = rng.uniform(0.1, 2.0, 2)
    world = ls.World([box(x, y, length, width, 3 * angle, int(rng.integers(3)))])
    others = np.array(ls.types.Box(length, width).corners((x, y), 3 * float(angle)))

    def distance(places: Array) -> float:
        return float(hull_distances(world, places[None], [len(places)])[0][0, 0, 0])

    found, pulls = hull_distances(world, corners[None], [len(corners)])
    assert found[0, 0, 0] == pytest.approx(separated(corners, others), abs=1e-12)
    for k, i in np.ndindex(*corners.shape):
        step = np.zeros_like(corners)
        step[k, i] = 1e-6
        ahead, behind = distance(corners + step), distance(corners - step)
        once, again = (ahead - found[0, 0, 0]) / 1e-6, (found[0, 0, 0] - behind) / 1e-6
        if abs(once - again) < 1e-4:  # no kink between the two
            assert (once + again) / 2 == pytest.approx(pulls[0, 0, 0, k, i], abs=1e-4)


def test_round_obstacles_and_planes() -> None:
    """Against closed forms: a rectangle's distance to a disc's centre, and its lowest corner's to a plane."""
    own = np.array(CAR.corners((0.0, 0.0), 0.0))
    distances = hull_distances(ls.World([ROUND, WALL]), own[None], [4])[0][0, 0]
    away = np.hypot(0.4 - 0.25, 0.7 - 0.125) - 0.2
    np.testing.assert_allclose(distances, [away, 1.0 - 0.125], atol=1e-12)


def problem(**changed: Any) -> ls.Problem:
    start, goal = np.zeros(4), np.array([2.6, 0.0, 0.0, 0.0])
    stated: dict[str, Any] = {
        "dynamics": DYNAMICS, "dt": 0.1, "steps": 90, "initial": ls.FixedState(start),
        "stage_cost": ls.ControlCost([1.0, 0.1]), "final_cost": ls.QuadraticCost(np.zeros(4), about=goal),
        "constraints": [ls.GoalState(goal), ls.Clearance(WORLD, balls=HULLS, margin=0.01)],
    }  # fmt: skip
    return ls.Problem(**stated | changed)


def test_a_plan_passes_a_gap_that_no_ball_passes() -> None:
    """A slalom for a box of 0.5 by 0.25 m. Its plan keeps 1 cm from the boxes by `separated`."""
    solution = ls.smooth(problem())
    assert solution.status is ls.Status.CONVERGED, solution
    boxes = [np.array(ls.types.Box(0.2, 0.8).corners(one.position[:2], 0.0)) for one in WORLD.obstacles]
    least = np.inf
    for px, py, a, b in solution.trajectory.states.tolist():
        behind = (px - np.cos(b) / 2, py - np.sin(b) / 2)
        for part in (CAR.corners((px, py), a), TRAILER.corners(behind, b)):
            least = min(least, *(separated(np.array(part), one) for one in boxes))
    assert solution.clearance is not None
    assert least == pytest.approx(0.01, abs=1e-6)
    assert solution.clearance.min() == pytest.approx(least, abs=1e-9)


def test_costs_and_slopes() -> None:
    """The cost is the sum over hulls and obstacles; its gradient and the clearance's slopes against differences."""
    world, x = ls.World([*WORLD.obstacles, ROUND, WALL]), np.array([0.3, 0.1, 0.4, -0.2])
    term = ls.ObstacleCost(world, balls=HULLS, sharpness=3.0, weight=0.5).bind(DYNAMICS)
    shape = ls.Clearance(world, balls=HULLS).in_world(DYNAMICS)
    places = shape.places(x)
    distances = hull_distances(world, places[:, :2][None], [4, 4])[0][0]
    value, gradient, _ = evaluate(term, x, np.zeros(2))
    assert value == pytest.approx(0.5 * np.exp(-3.0 * distances).sum(), rel=1e-12)
    clearance, slopes = shape.with_slopes(x[None], range(4))
    np.testing.assert_allclose(clearance[0], distances.min(axis=0), atol=1e-12)
    for i, step in enumerate(1e-6 * np.eye(4)):
        ahead, behind = (shape.with_slopes((x + side * step)[None], range(4))[0][0] for side in (1, -1))
        np.testing.assert_allclose(slopes[0, :, i], (ahead - behind) / 2e-6, atol=1e-6)
        more, less = (evaluate(term, x + side * step, np.zeros(2))[0] for side in (1, -1))
        assert gradient[i] == pytest.approx((more - less) / 2e-6, abs=1e-6)
    assert shape.nearest(places, np.zeros((4, 3))) == int(distances.min(axis=0).argmin())


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: ls.CollisionSpheres(outline, [0.1, 0.2, 0.1], hulls=[3]), "radii: got [0.1, 0.2, 0.1] in hull 0"),
        (lambda: ls.CollisionSpheres(outline, [0.1, 0.1], hulls=[3]), "hulls: got 3 balls in all, want 2"),
        (
            lambda: ls.CollisionSpheres(outline, 0.0, hulls=[4, 4], names=["car"]),
            "want 2 different texts, one per hull",
        ),
        (lambda: ls.CollisionSpheres(outline, 0.0, hulls=[0]), "hulls: got 0"),
        (lambda: ls.types.Box(0.0, 1.0), "Box: length: got 0"),
        (lambda: CAR.corners((1.0, 2.0, 3.0), 0.0), "want 2 coordinates and an angle"),
    ],
)
def test_bad_input_is_named(make: Any, said: str) -> None:
    with pytest.raises(ls.InputError) as raised:
        make()
    assert said in str(raised.value)


def test_what_has_no_outline_is_refused() -> None:
    tilted = ls.Obstacle("pipe", "cylinder", np.zeros(3), np.eye(3)[:, [1, 2, 0]], np.array([0.1, 1.0, 0.0]))
    with pytest.raises(ls.InputError, match="tilted cylinder"):
        ls.smooth(problem(constraints=[ls.Clearance(ls.World([tilted]), balls=HULLS)]))


def test_a_hull_in_an_obstacle_is_named() -> None:
    shape = ls.Clearance(ls.World([box(-0.5, 0.0, 0.1, 0.1)]), balls=HULLS).in_world(DYNAMICS)
    assert shape.inside(np.array([5.0, 0.0, 0.0, 0.0])) is None
    found = shape.inside(np.zeros(4))
    assert found is not None
    assert found[0] == "with 'trailer' at (-0.5, 0, 0) m, 0.175 m inside obstacle 'box -0.5 0'"
