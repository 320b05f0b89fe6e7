"""Robots and obstacles that are convex hulls, in a plane and in space: distances, costs and plans."""

from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import scene
from sampling import examples
from scipy.optimize import lsq_linear
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.kernels.distances import hull_distance
from lqrsim.problem.collision_shape import hull_distances, signed_distance
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
    """The signed distance of two hulls: that of the origin to Qhull's hull M of all differences of their corners.

    Outside it is the least |sum w m| for weights w of the corners m. With least squares of (sum w m, sum w - 1) the
    weights are the same up to their sum. SciPy's `nnls` is wrong for some boxes on a grid: scipy/scipy#25389.
    """
    apart = (own[:, None] - other[None]).reshape(-1, own.shape[1])
    try:
        depth = float(ConvexHull(apart).equations[:, -1].max())
    except QhullError:  # flat
        depth = 0.0
    if depth < 0:
        return depth
    size = np.abs(apart).max()
    rows, right = np.vstack([apart.T / size, np.ones(len(apart))]), np.eye(own.shape[1] + 1)[-1]
    weights = lsq_linear(rows, right, (0, np.inf), method="bvls", tol=1e-15, max_iter=10_000).x
    return float(np.linalg.norm(weights @ apart) / weights.sum())


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
    world = ls.World([box(x, y, length, width, 3 * angle, int(rng.integers(3)))]).upright()
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


def distance(own: Array, world: ls.World) -> float:
    return float(hull_distances(world, own[None], [len(own)])[0].min())


def drawn(seed: int) -> tuple[Array, Array]:
    """The corners of two hulls, apart or not; some of them boxes with parallel faces, flat or a point."""
    rng = np.random.default_rng(seed)
    own, other = (rng.normal(size=(rng.integers(1, 12), 3)) * rng.uniform(0.1, 1.0) for _ in range(2))
    if rng.random() < 0.3:
        sides = [rng.integers(1, 4, 3) / 4 for _ in range(2)]
        own, other = (np.array(ls.types.Box(*one).corners((0, 0, 0), (0, 0, 0)), dtype=float) for one in sides)
        return own + rng.integers(-4, 5, 3) / 4, other
    return own + rng.normal(size=3) * rng.choice([0.2, 1.0, 3.0]), other


@settings(max_examples=examples(100))
@given(st.integers(0, 2**32 - 1))
def test_distances_in_space_are_those_of_the_difference_of_both(seed: int) -> None:
    """To rounding; slopes as in the plane, of hulls that do not touch: an edge that does has a range of them."""
    own, other = drawn(seed)
    world = ls.World([ls.Obstacle.of_corners("rock", other)])
    found, pulls = hull_distances(world, own[None], [len(own)])
    assert found[0, 0, 0] == pytest.approx(separated(own, other), abs=1e-12)
    assert np.linalg.norm(pulls[0, 0, 0].sum(axis=0)) == pytest.approx(1.0, abs=1e-9)  # where it moves as one
    step = np.random.default_rng(seed).normal(size=own.shape)
    ahead, behind = distance(own + 1e-6 * step, world), distance(own - 1e-6 * step, world)
    once, again = (ahead - found[0, 0, 0]) / 1e-6, (found[0, 0, 0] - behind) / 1e-6
    if abs(once - again) < 1e-4 and abs(found[0, 0, 0]) > 1e-5:  # no kink between the two
        assert (once + again) / 2 == pytest.approx((pulls[0, 0, 0] * step).sum(), abs=1e-3)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("axes", [2, 3])
def test_the_way_out_is_that_of_a_face(axes: int, turned: bool) -> None:
    """Of boxes on a grid that overlap or touch, where several faces are equally deep.

    Along it, the first of the robot's corners is as far from the last of the obstacle's as the signed distance says.
    """
    rng = np.random.default_rng(axes)
    for _ in range(600):
        sides = rng.integers(1, 5, (2, axes)) / 4
        turn = np.linalg.qr(rng.normal(size=(axes, axes)))[0] if turned else np.eye(axes)
        own, other = (np.array(ls.types.Box(*one).corners([0] * axes, [0] * 3 if axes == 3 else 0.0)) for one in sides)
        limit = (4 * sides.sum(axis=0)).astype(int)
        own, other = (own + rng.integers(-limit, limit + 1) / 8) @ turn, other @ turn
        world = ls.World([ls.Obstacle.of_corners("rock", other)])
        found, pulls = hull_distances(world.upright() if axes == 2 else world, own[None], [len(own)])
        out = pulls[0, 0, 0].sum(axis=0)[:axes]
        assert np.linalg.norm(out) == pytest.approx(1.0, abs=1e-9)
        assert (own @ out).min() - (other @ out).max() == pytest.approx(found[0, 0, 0], abs=1e-9)


@settings(max_examples=examples(30))
@given(st.integers(0, 2**32 - 1))
def test_a_distance_belongs_to_the_place_of_both_alone(seed: int) -> None:
    """It stays if both move or swap, and changes no more than one of them moves."""
    (own, other), rng = drawn(seed), np.random.default_rng(seed)
    found = distance(own, ls.World([ls.Obstacle.of_corners("rock", other)]))
    turn, moved, step = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3), rng.normal(size=3) / 10
    there = ls.Obstacle("rock", "mesh", moved, turn, np.ones(3), corners=other)
    assert distance(own @ turn.T + moved, ls.World([there])) == pytest.approx(found, abs=1e-12)
    assert distance(other, ls.World([ls.Obstacle.of_corners("rock", own)])) == pytest.approx(found, abs=1e-12)
    ahead = distance(own + step, ls.World([ls.Obstacle.of_corners("rock", other)]))
    assert abs(ahead - found) <= np.linalg.norm(step) + 1e-12


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_specks_in_the_faces_of_others(seed: int) -> None:
    """Nearly flat ones of some 1e-6 m: the least tetrahedron around the origin is then so flat that its mean is not at
    the origin. By the kernel in plain Python, which has no memory beyond its arrays.
    """
    rng = np.random.default_rng(seed)
    for _ in range(600):
        own = rng.normal(size=(rng.integers(2, 6), 3)) * 10.0 ** rng.uniform(-8, -5)
        own[:, rng.integers(3)] *= 10.0 ** rng.uniform(-8, -5)
        other = rng.integers(-2, 3, size=(5, 3)) @ Rotation.random(rng=rng).as_matrix()
        place = rng.normal(size=3)
        world = ls.World([ls.Obstacle.of_corners("rock", other + place)])
        corners = (own + place).ravel()
        found = hull_distance(world.table, 0, corners, 0, len(own), np.zeros(corners.size))
        assert found == pytest.approx(distance(own + place, world), abs=1e-6)


@pytest.mark.parametrize("kind", ["plane", "sphere", "capsule", "cylinder", "box", "mesh"])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_distance_of_a_corner_that_is_nowhere_is_not_a_number(kind: str, count: int) -> None:
    """Whichever corner it is; also of a point to the nearest of several obstacles."""
    rock = ls.Obstacle.of_corners("rock", np.eye(3))
    one = rock if kind == "mesh" else ls.Obstacle("one", kind, np.zeros(3), np.eye(3), np.full(3, 0.3))
    corners = np.random.default_rng(count).normal(size=(count, 3))
    for k in range(count):
        lost = corners.copy()
        lost[k] = np.nan
        found = hull_distances(ls.World([one, rock]), lost[None], [count])[0]
        assert np.isnan(found).all()
        displaced = np.zeros((1, 3, 3))
        displaced[0, k % 3] = np.nan
        world = ls.World([rock, one, rock])
        assert np.isnan(signed_distance(world, corners[:1], displaced)).all()


SIZES = {
    "plane": (0.0, 0.0, 0.0), "sphere": (0.4, 0.0, 0.0), "capsule": (0.3, 0.7, 0.0), "cylinder": (0.4, 0.5, 0.0),
    "box": (0.3, 0.5, 0.2),
}  # fmt: skip


@pytest.mark.parametrize("kind", SIZES)
def test_distances_to_primitives_are_mujocos(kind: str) -> None:
    """Its tolerance of distances of convex bodies is 1e-6 m; for overlaps it finds no less than the least depth."""
    size = SIZES[kind]
    rng, turn = np.random.default_rng(1), Rotation.random(rng=np.random.default_rng(0))
    thing = ls.Obstacle(kind, kind, np.array([0.1, 0.2, 0.3]), turn.as_matrix(), np.array(size))
    rock = rng.normal(size=(9, 3)) * 0.2
    rock -= rock[ConvexHull(rock).vertices].mean(axis=0)
    numbers = {name: " ".join(map(str, np.ravel(one))) for name, one in {
        "size": size if kind != "plane" else (1, 1, 1), "rock": rock, "turn": turn.as_quat(scalar_first=True),
    }.items()}  # fmt: skip
    xml = scene(
        '<body mocap="true"><geom type="mesh" mesh="rock"/></body>',
        before=f'<asset><mesh name="rock" vertex="{numbers["rock"]}"/></asset>',
        things=f'<geom type="{kind}" size="{numbers["size"]}" pos="0.1 0.2 0.3" quat="{numbers["turn"]}"/>',
    )
    model = mujoco.MjModel.from_xml_string(xml)
    data, apart = mujoco.MjData(model), 0
    for one in Rotation.random(60, rng=rng):
        data.mocap_pos[0], data.mocap_quat[0] = rng.normal(size=3) * 0.6, one.as_quat(scalar_first=True)
        mujoco.mj_kinematics(model, data)
        found = distance(one.apply(rock) + data.mocap_pos[0], ls.World([thing]))
        theirs = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
        apart += found > 0
        assert found == pytest.approx(theirs, abs=2e-6) if found > 0 else found >= theirs - 1e-6
    assert 5 < apart < 60


def test_round_obstacles_and_planes() -> None:
    """Against closed forms: a rectangle's distance to a disc's centre, and its lowest corner's to a plane."""
    own = np.array(CAR.corners((0.0, 0.0), 0.0))
    distances = hull_distances(ls.World([ROUND, WALL]).upright(), own[None], [4])[0][0, 0]
    away = np.hypot(0.4 - 0.25, 0.7 - 0.125) - 0.2
    np.testing.assert_allclose(distances, [away, 1.0 - 0.125], atol=1e-12)


def problem(**changed: Any) -> ls.Problem:
    start, goal = np.array([0.0, 0.01, 0.0, 0.0]), np.array([2.6, 0.0, 0.0, 0.0])
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
    boxes = [np.array(ls.types.Box(0.2, 0.8).corners(one.position[:2].tolist(), 0.0)) for one in WORLD.obstacles]
    least = np.inf
    for px, py, a, b in solution.trajectory.states.tolist():
        behind = (px - np.cos(b) / 2, py - np.sin(b) / 2)
        for part in (CAR.corners((px, py), a), TRAILER.corners(behind, b)):
            least = min(least, *(separated(np.array(part), one) for one in boxes))
    assert solution.clearance is not None
    assert least == pytest.approx(0.01, abs=1e-6)
    assert solution.clearance.min() == pytest.approx(least, abs=1e-9)


PLANK = ls.types.Box(0.5, 0.4, 0.06)
SLOT = 0.7  # rad, by which a slot leans, of 0.2 m, into which the plank fits only on edge


def plank(x, p):
    """At height 0, turned by b about the vertical and then by a about its length."""
    rotate = ls.rotations.rotate
    turned = (rotate([0, 0, x.b], corner) for corner in PLANK.corners((0, 0, 0), (x.a, 0, 0)))
    return [[x.px + a, x.py + b, c] for a, b, c in turned]


def gliding(x, u, p):
    """Who banks turns."""
    from sympy import cos, sin

    return [u.v * cos(x.b), u.v * sin(x.b), u.bank, -x.a]


GLIDER = ls.Dynamics(
    gliding, states={"px": "m", "py": "m", "a": "rad", "b": "rad"}, controls={"v": "m/s", "bank": "rad/s"},
    position=("px", "py"), angles=("a", "b"), control_limits={"v": (0.0, 1.0), "bank": (-2.0, 2.0)},
)  # fmt: skip


def lips() -> list[Array]:
    """The corners of what bounds the slot above and below."""
    across = np.array([0.0, -np.sin(SLOT), np.cos(SLOT)])
    places = ((np.array([1.2, 0.0, 0.0]) + side * (0.1 + 0.5) * across).tolist() for side in (-1, 1))
    return [np.array(ls.types.Box(0.2, 3.0, 1.0).corners(one, (SLOT, 0.0, 0.0)), dtype=float) for one in places]


def test_a_plank_banks_through_a_slot() -> None:
    """It keeps 2 cm from both lips by `separated` at the knots, and does not touch them between these."""
    world = ls.World([ls.Obstacle.of_corners(f"lip {k}", one) for k, one in enumerate(lips())])
    hull = ls.CollisionSpheres(plank, 0.0, hulls=[8])
    goal = np.array([2.4, 0.0, 0.0, 0.0])
    solution = ls.smooth(
        ls.Problem(
            dynamics=GLIDER,
            dt=0.05,
            steps=80,
            initial=ls.FixedState(np.zeros(4)),
            stage_cost=ls.ControlCost([0.1, 0.1]),
            final_cost=ls.QuadraticCost([100.0, 10.0, 10.0, 10.0], about=goal),
            constraints=[ls.Clearance(world, balls=hull, margin=0.02)],
        )
    )
    assert solution.status is ls.Status.CONVERGED, solution
    shape = ls.Clearance(world, balls=hull).in_world(GLIDER)

    def least(states: Array) -> float:
        places = shape.places(states)
        return min(separated(place, one) for place in places for one in lips())

    states = solution.trajectory.states
    assert least(states) == pytest.approx(0.02, abs=1e-6)
    assert np.abs(states[:, 2]).max() > 0.3  # it banks
    between = np.linspace(0, 80, 321)
    assert least(np.stack([np.interp(between, np.arange(81), one) for one in states.T], axis=1)) > 0


def test_costs_and_slopes() -> None:
    """The cost is the sum over hulls and obstacles; its gradient and the clearance's slopes against differences."""
    world, x = ls.World([*WORLD.obstacles, ROUND, WALL]), np.array([0.3, 0.1, 0.4, -0.2])
    term = ls.ObstacleCost(world, balls=HULLS, sharpness=3.0, weight=0.5).bind(DYNAMICS)
    shape = ls.Clearance(world, balls=HULLS).in_world(DYNAMICS)
    places = shape.places(x)
    distances = hull_distances(world.upright(), places[:, :2][None], [4, 4])[0][0]
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


def test_a_ball_among_hulls() -> None:
    """Its distance is that of its centre, less its radius; the cost's gradient against differences."""
    world = ls.World([ls.Obstacle.of_corners("wedge", [[0.3, 0.2], [0.9, 0.3], [0.5, 0.7]]), WALL])
    x = np.array([0.2, 0.1, 0.4, -0.2])
    shape = ls.Clearance(world, radius=0.05).in_world(DYNAMICS)
    assert shape.clearance(shape.places(x)) == pytest.approx(world.distance(x[:2]) - 0.05, abs=1e-12)
    assert shape.inside(np.array([0.5, 0.4, 0.0, 0.0])) is not None
    term = ls.ObstacleCost(world, radius=0.05, sharpness=3.0).bind(DYNAMICS)
    value, gradient, _ = evaluate(term, x, np.zeros(2))
    assert value == pytest.approx(np.exp(-3.0 * (world.distances(x[:2]) - 0.05)).sum(), rel=1e-12)
    for i, step in enumerate(1e-6 * np.eye(4)):
        more, less = (evaluate(term, x + side * step, np.zeros(2))[0] for side in (1, -1))
        assert gradient[i] == pytest.approx((more - less) / 2e-6, abs=1e-6)


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
        (lambda: PLANK.corners((1.0, 2.0), 0.0), "want 3 coordinates and a rotation vector"),
        (lambda: ls.Obstacle.of_corners("rock", [1.0, 2.0]), "corners: got shape (2,), want (C, 2) or (C, 3)"),
        (
            lambda: ls.World([ls.Obstacle("rock", "mesh", np.zeros(3), np.eye(3), np.ones(3))]).table,
            "obstacle 'rock': got a mesh, want one of: plane, sphere, capsule, cylinder, box, mesh with corners",
        ),
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
