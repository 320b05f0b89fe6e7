"""Representatives of angles and rotation vectors, against SciPy's rotations."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.control.controllers import turn_to_nearest
from lqrsim.errors import Array

SPACE = ls.types.Coordinates(
    names=("x", "heading", "rx", "ry", "rz"), units=("m", *("rad",) * 4), angles=(1,), rotation_vectors=(2,)
)


@settings(max_examples=examples(200))
@given(seed=st.integers(0, 2**32 - 1))
def test_nearest_is_the_same_pose_and_the_nearest_of_all(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vector, near = rng.normal(size=(2, 5)) * [1, 10, 3, 3, 3]
    found = SPACE.nearest(vector, near)
    assert found[0] == vector[0]
    # The same angle, and the same rotation by SciPy's account: 1e-12, rounding of a few turns.
    assert np.exp(1j * found[1]) == pytest.approx(np.exp(1j * vector[1]), abs=1e-12)
    turned = Rotation.from_rotvec(found[2:]) * Rotation.from_rotvec(vector[2:]).inv()
    assert turned.magnitude() < 1e-7  # the arc cosine in it has half the digits near zero
    # No representative, within five turns either way, is nearer.
    angle = np.linalg.norm(vector[2:])
    others = [vector[2:] * (1 + 2 * np.pi * k / angle) for k in range(-5, 6)]
    best = min(np.linalg.norm(other - near[2:]) for other in others)
    assert np.linalg.norm(found[2:] - near[2:]) <= best + 1e-12
    assert abs(found[1] - near[1]) <= np.pi + 1e-12


@pytest.mark.parametrize("turn", range(3))
@settings(max_examples=examples(100))
@given(seed=st.integers(0, 2**32 - 1))
def test_a_turn_and_a_tilt_are_each_the_nearest(turn: int, seed: int) -> None:
    rng, axis = np.random.default_rng(seed), np.eye(3)[turn]
    space = ls.types.Coordinates(names=("rx", "ry", "rz"), units=("rad",) * 3, angles=(turn,), rotation_vectors=(0,))
    vector, near = rng.normal(size=(2, 3)) * np.where(axis, 10, 3)
    found = space.nearest(vector, near)

    def attitude(one: Array) -> Rotation:
        return Rotation.from_rotvec(one[turn] * axis) * Rotation.from_rotvec(np.where(axis, 0, one))

    # 1e-7, as the arc cosine of an angle near zero has half the digits.
    assert (attitude(found) * attitude(vector).inv()).magnitude() < 1e-7
    tilt = np.where(axis, 0, vector)
    others = [tilt * (1 + 2 * np.pi * k / np.linalg.norm(tilt)) for k in range(-5, 6)]
    turns = [vector[turn] + 2 * np.pi * k for k in range(-9, 10)]
    best = min(np.linalg.norm(one + other * axis - near) for one in others for other in turns)
    assert np.linalg.norm(found - near) <= best + 1e-12
    compiled = vector[None, None].copy()
    turn_to_nearest(space, compiled, near[None])
    np.testing.assert_allclose(compiled[0, 0], found, rtol=0, atol=1e-12)  # rounding of a few turns


def test_the_identity_takes_the_axis_of_its_neighbour() -> None:
    found = SPACE.nearest(np.zeros(5), [0, 0, 0, 0, 6.0])
    np.testing.assert_allclose(found[2:], [0, 0, 2 * np.pi])
    assert (SPACE.nearest(np.zeros(5), np.zeros(5)) == 0).all()


def test_leading_dimensions_broadcast() -> None:
    rng = np.random.default_rng(0)
    vectors, near = 5 * rng.normal(size=(4, 3, 5)), 5 * rng.normal(size=(3, 5))
    many = SPACE.nearest(vectors, near)
    for i in range(4):
        for j in range(3):
            assert (many[i, j] == SPACE.nearest(vectors[i, j], near[j])).all()


def test_a_vector_near_enough_is_returned_to_the_bit() -> None:
    vector = np.array([0.1, 3.0, 0.3, -0.2, 1.1])
    assert (SPACE.nearest(vector, vector + 0.1) == vector).all()


@pytest.mark.parametrize(
    ("field", "unit", "others"),
    [
        ("position", "m", ("cm", "mm", "km", "ft", "M", "m/s", "rad")),
        ("angles", "rad", ("deg", "degrees", "°", "turn", "mrad", "rad/s", "m")),
        ("rotation_vectors", "rad", ("deg", "°", "quat", "rad/s")),
    ],
)
def test_what_is_counted_in_metres_or_radians_has_no_other_unit(field: str, unit: str, others: tuple[str, ...]) -> None:
    """Obstacles are in metres, and a whole turn is 2 pi: another unit would be taken for these without a word."""
    names = ("x", "y", "z")
    entries = {"position": (0, 1, 2), "angles": (2,), "rotation_vectors": (0,)}[field]
    for fitting in (unit, ""):
        ls.types.Coordinates(names=names, units=(fitting,) * 3, **{field: entries})
    for other in others:
        units = (unit, unit, other)
        with pytest.raises(ls.InputError, match=f"^units: z: got {other!r}, want {unit!r} for a"):
            ls.types.Coordinates(names=names, units=units, **{field: entries})
        ls.types.Coordinates(names=names, units=(other,) * 3)  # what is none of them may have any


def test_dynamics_in_degrees_are_refused() -> None:
    def f(x: Any, u: Any, p: Any) -> Any:
        return [u[0]]

    options: Any = {"controls": {"speed": "deg/s"}, "angles": ("heading",)}
    with pytest.raises(ls.InputError, match="heading: got 'deg', want 'rad' for an angle, whose whole turns are 2 pi"):
        ls.Dynamics(f, states={"heading": "deg"}, **options)
    assert ls.Dynamics(f, states={"heading": "rad"}, **options).state_coordinates.angles == (0,)
