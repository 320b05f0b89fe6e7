"""Distances to obstacles, against MuJoCo's own and against finite differences."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import scene
from sampling import examples
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.codegen.compiled_module import module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array
from lqrsim.kernels import distances as distance_kernels
from lqrsim.kernels.declarations import ROW
from lqrsim.kernels.distances import signed_distance_derivatives
from lqrsim.problem import collision_shape
from lqrsim.scenes.world import KINDS, OTHER_KINDS

SIZES = {
    "plane": (0.0, 0.0, 0.0),
    "sphere": (0.4, 0.0, 0.0),
    "capsule": (0.3, 0.7, 0.0),
    "cylinder": (0.4, 0.5, 0.0),
    "box": (0.3, 0.5, 0.2),
    "mesh": (0.5, 0.5, 0.4),
}
ROCK = np.array([[0, 0, 0.4], [0.5, 0, 0.1], [0, 0.5, 0], [-0.5, 0.1, 0], [0, -0.5, -0.1], [0.1, 0, -0.4], [0.1, 0, 0]])


def obstacle(kind: str, seed: int = 0) -> ls.Obstacle:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix()
    corners = {"corners": ROCK} if kind == "mesh" else {}
    return ls.Obstacle(kind, kind, rng.normal(size=3), rotation, np.array(SIZES[kind]), **corners)


def outside(thing: ls.Obstacle, rng: np.random.Generator) -> Array:
    """A point in the neighbourhood, outside."""
    world = ls.World([thing])
    while True:
        point = thing.position + rng.normal(size=3)
        if world.distance(point) > 0.05:
            return point


@pytest.mark.parametrize("kind", KINDS)
def test_distance_is_mujocos(kind: str) -> None:
    """MuJoCo finds the distance between a ball of 1 cm and the geom by its own code; 1e-4 m is its convex solver's."""
    thing = obstacle(kind)
    quaternion = Rotation.from_matrix(thing.rotation).as_quat(scalar_first=True)
    size = (1, 1, 0.1) if kind == "plane" else thing.size
    text = f'size="{" ".join(map(str, np.asarray(size)))}"' if kind != "mesh" else 'mesh="rock"'
    rock = " ".join(map(str, ROCK.ravel()))
    pose = f'pos="{" ".join(map(str, thing.position))}" quat="{" ".join(map(str, quaternion))}"'
    ball, asset = '<body mocap="true"><geom size="0.01"/></body>', f'<asset><mesh name="rock" vertex="{rock}"/></asset>'
    xml = scene(ball, things=f'<geom type="{kind}" {text} {pose}/>', before=asset)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    world, rng = ls.World([thing]), np.random.default_rng(1)
    for _ in range(50):
        point = outside(thing, rng)
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        theirs = 0.01 + mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
        assert abs(world.distance(point) - theirs) < 1e-4


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "mesh"])
def test_derivatives_are_those_of_the_distance(kind: str) -> None:
    """Central differences of step 1e-5: truncation and rounding leave 1e-6 of a Hessian of order ten."""
    thing, rng, step = obstacle(kind), np.random.default_rng(2), 1e-5
    world = ls.World([thing])
    data = world.table.ravel()
    for _ in range(50):
        point = outside(thing, rng)
        gradient, hessian = np.zeros(3), np.zeros((3, 3))
        x, y, z = point
        distance = signed_distance_derivatives(data, 0, x, y, z, gradient, hessian)
        assert distance == pytest.approx(float(world.distance(point)), abs=1e-12)
        for axis, unit in enumerate(np.eye(3)):
            ahead, behind = point + step * unit, point - step * unit
            slope = (world.distance(ahead) - world.distance(behind)) / (2 * step)
            assert abs(gradient[axis] - slope) < 1e-6
            high, low = np.zeros(3), np.zeros(3)
            signed_distance_derivatives(data, 0, ahead[0], ahead[1], ahead[2], high, np.zeros((3, 3)))
            signed_distance_derivatives(data, 0, behind[0], behind[1], behind[2], low, np.zeros((3, 3)))
            curve = (high - low) / (2 * step)
            if np.abs(curve).max() < 1e3:  # else the two points lie on different faces
                np.testing.assert_allclose(hessian[axis], curve, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("unknown", [[0], [1], [2], [0, 2], [0, 1, 2]])
def test_distance_of_a_point_that_is_not_a_number_is_none(kind: str, turned: bool, unknown: list[int]) -> None:
    thing = obstacle(kind)
    thing = thing if turned else replace(thing, rotation=np.eye(3))
    world, point = ls.World([thing]), thing.position + 0.1
    point[unknown] = np.nan
    assert np.isnan(world.distance(point))
    if kind != "mesh":
        x, y, z = point.tolist()
        for kernels in (distance_kernels, module_of(source_of(distance_kernels), "distances")):
            given = world.table.ravel().copy(), 0, x, y, z, np.zeros(3), np.zeros((3, 3))
            assert np.isnan(kernels.signed_distance_derivatives(*given))


@pytest.mark.parametrize("kind", KINDS)
def test_inside_is_negative_and_continuous(kind: str) -> None:
    """Along a straight line through the obstacle the distance changes no faster than the point moves."""
    thing = obstacle(kind)
    world = ls.World([thing])
    line = thing.position + np.linspace(-2, 2, 2001)[:, None] * np.array([0.3, -0.2, 0.9])
    distances = world.distance(line)
    assert distances.min() < 0
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert (np.abs(np.diff(distances)) <= steps * (1 + 1e-9)).all()


@settings(max_examples=examples(25))
@given(seed=st.integers(0, 2**32 - 1))
def test_compiled_distances_are_the_plain_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = ls.World([obstacle(kind, seed) for kind in KINDS])
    points = rng.normal(size=(4, 5, 3))
    np.testing.assert_allclose(
        collision_shape.signed_distance(world, points), world.distance(points), rtol=0, atol=1e-12
    )
    rows = np.array([world.distances(point) for point in points.reshape(-1, 3)])
    assert (world.nearest(points).ravel() == rows.argmin(axis=1)).all()


def test_seen_from_above() -> None:
    upright, level = np.eye(3), Rotation.from_euler("y", 90, degrees=True).as_matrix()
    world = ls.World(
        [
            ls.Obstacle("floor", "plane", np.zeros(3), upright, np.zeros(3)),
            ls.Obstacle("wall", "plane", np.array([2.0, 0, 0]), -level, np.zeros(3)),
            ls.Obstacle("pillar", "cylinder", np.array([0.0, 1, 0.1]), upright, np.array([0.2, 0.1, 0])),
            ls.Obstacle("ball", "sphere", np.array([0.0, -1, 5.0]), upright, np.array([0.3, 0, 0])),
            ls.Obstacle("crate", "box", np.array([-1.0, 0, 0]), level, np.array([0.1, 0.2, 0.3])),
        ]
    )
    flat = world.seen_by("xy")
    assert flat.names == ("wall", "pillar", "ball", "crate")
    # Closed forms in the plane: a half-plane, two circles, a rectangle with half sides of 0.3 along x and 0.2 along y.
    np.testing.assert_allclose(
        flat.distances((0.5, 0.5)), [1.5, np.hypot(0.5, 0.5) - 0.2, np.hypot(0.5, 1.5) - 0.3, np.hypot(1.2, 0.3)]
    )
    assert world.seen_by("xyz") is world


@settings(max_examples=examples(20))
@given(seed=st.integers(0, 2**32 - 1))
def test_an_upright_ellipsoid_that_is_round_from_above_is_a_circle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    up, place, (radius, half) = int(rng.integers(3)), rng.normal(size=3), rng.uniform(0.1, 1.0, size=2)
    rotation = Rotation.from_euler("z", rng.uniform(-4, 4)).as_matrix() @ np.roll(np.eye(3), 2 - up, axis=0)
    egg = ls.Obstacle("egg", "ellipsoid", place, rotation, np.insert(np.full(2, radius), up, half))
    points = rng.normal(size=(5, 2))
    distances = ls.World([egg]).seen_by("xy").distance(points)
    np.testing.assert_allclose(distances, np.linalg.norm(points - place[:2], axis=1) - radius, rtol=0, atol=1e-12)


def test_a_row_is_as_long_as_said() -> None:
    assert ls.World([obstacle("box")]).table.shape == (ROW,)
    assert ls.World().distance(np.zeros((7, 3))).tolist() == [np.inf] * 7


@pytest.mark.parametrize("kind", [*OTHER_KINDS, "mesh"])
@settings(max_examples=examples(10))
@given(seed=st.integers(0, 2**32 - 1))
def test_obstacles_without_a_distance_here_are_refused_for_that_reason(kind: str, seed: int) -> None:
    """Whatever their place: in space, from above, and as prisms. A mesh without corners has no distance."""
    rng = np.random.default_rng(seed)
    size, turned = rng.uniform(0.1, 1.0, size=3), Rotation.random(rng=rng).as_matrix()
    world = ls.World([ls.Obstacle("thing", kind, rng.normal(size=3), turned, size)])
    for distances in (
        lambda: world.distances(np.zeros(3)),
        lambda: world.seen_by("xy").distances(np.zeros(2)),
        lambda: world.seen_by("xz", 0.0).upright().distances(np.zeros(2)),
    ):
        with pytest.raises(ls.InputError, match=f"^obstacle 'thing': got a {kind}, want one of: plane, .*corners"):
            distances()
