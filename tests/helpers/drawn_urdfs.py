"""Random URDFs, and their equations of motion written from the file alone, with NumPy."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from lqrsim.errors import Array

GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s^2
MOVING = ("revolute", "continuous", "prismatic")


def draw(seed: int) -> str:
    """A tree of three to eight links under a base; the first moves, each of the rest moves or is fixed.

    Moving links have a mass and the inertia of a body. Fixed ones may have none, or one that no body can have.
    """
    rng = np.random.default_rng(seed)
    parts = [f'<link name="base">{_inertial(rng)}</link>']
    for number in range(int(rng.integers(3, 9))):
        kind = rng.choice([*MOVING, "fixed"] if number else MOVING)
        inertial = _inertial(rng) if kind != "fixed" else rng.choice(["", _inertial(rng), _impossible(rng)])
        parent = rng.choice(["base", *(f"link{k}" for k in range(number))])
        sides = "" if kind == "continuous" else 'lower="-1" upper="2"'
        limit = f'<limit {sides} effort="{rng.uniform(1, 9)!r}" velocity="3"/>'
        parts.append(
            f'<link name="link{number}">{inertial}</link><joint name="joint{number}" type="{kind}">'
            f'<parent link="{parent}"/><child link="link{number}"/>{_origin(rng)}'
            f'<axis xyz="{_text(rng.normal(size=3))}"/>{limit}</joint>'
        )
    return f'<robot name="drawn">{"".join(parts)}</robot>'


def equations(
    urdf: str, positions: Mapping[str, float], speeds: Mapping[str, float], base: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """The mass matrix (n, n), and the forces (n,) of gravity and of what is quadratic in the speeds.

    Args:
      urdf: the text.
      positions: name of a moving joint -> position; its order is that of the last columns.
      speeds: name -> speed.
      base: rotation matrix of the root link, and its angular velocity in its own axes, which with its velocity in the
        world are then the first six coordinates; or None if it is fixed.
    """
    root, first = ElementTree.fromstring(urdf), 0 if base is None else 6
    n = first + len(positions)
    turn, spin = base or (np.eye(3), np.zeros(3))
    mass, forces = np.zeros((n, n)), np.zeros(n)
    links = {one.get("name", ""): one for one in root.iterfind("link")}
    joints = list(root.iterfind("joint"))

    def add(name: str, turn: Array, linear: Array, angular: Array, spin: Array, drift: Array, twist: Array) -> None:
        """Add a link, and those on it.

        `linear` and `angular` (3, n) are the velocities of its origin by the coordinates' rates; `drift` and `twist`
        its accelerations, linear and angular, if these rates do not change.
        """
        heavy = links[name].find("inertial")
        if heavy is not None:
            own, at = _pose(heavy)
            inertia, weight = turn @ own @ _tensor(heavy) @ own.T @ turn.T, float(_find(heavy, "mass").get("value", ""))
            centre = turn @ at
            moved = linear - np.cross(centre, angular, axisb=0, axisc=0)
            pull = drift + np.cross(twist, centre) + np.cross(spin, np.cross(spin, centre)) - GRAVITY
            mass[:] += weight * moved.T @ moved + angular.T @ inertia @ angular
            forces[:] += weight * moved.T @ pull + angular.T @ (inertia @ twist + np.cross(spin, inertia @ spin))
        for joint in (one for one in joints if _find(one, "parent").get("link") == name):
            own, at = _pose(joint)
            here, reach = turn @ own, turn @ at
            label, kind = joint.get("name", ""), joint.get("type", "")
            axis = np.array(_find(joint, "axis").get("xyz", "").split(), dtype=float)
            axis = axis / np.linalg.norm(axis)
            towards, rates = here @ axis, np.zeros(n)
            turns = slides = 0.0
            if kind in MOVING:
                rates[first + list(positions).index(label)] = 1.0
                turns, slides = (0.0, speeds[label]) if kind == "prismatic" else (speeds[label], 0.0)
            if kind == "prismatic":
                reach = reach + towards * positions[label]
            elif kind in MOVING:
                here = here @ Rotation.from_rotvec(axis * positions[label]).as_matrix()
            carried = linear - np.cross(reach, angular, axisb=0, axisc=0)
            pushed = drift + np.cross(twist, reach) + np.cross(spin, np.cross(spin, reach))
            pushed = pushed + 2 * np.cross(spin, towards) * slides
            added = np.outer(towards, rates)
            add(
                _find(joint, "child").get("link", ""), here,
                carried + (added if kind == "prismatic" else 0), angular + (0 if kind == "prismatic" else added),
                spin + towards * turns, pushed, twist + np.cross(spin, towards) * turns,
            )  # fmt: skip

    linear, angular = np.zeros((3, n)), np.zeros((3, n))
    if base is not None:
        linear[:, :3], angular[:, 3:6] = np.eye(3), turn
    add("base", turn, linear, angular, turn @ spin, np.zeros(3), np.zeros(3))
    return mass, forces


def _inertial(rng: Generator) -> str:
    """The inertia of a cloud of points, stated in axes of its own."""
    points = rng.normal(size=(3, 5)) * 0.1
    mass = rng.uniform(0.2, 3)
    second = mass * points @ points.T / 5
    return _stated(rng, mass, np.trace(second) * np.eye(3) - second)


def _impossible(rng: Generator) -> str:
    return _stated(rng, 1e-6, np.full((3, 3), 1e-6))


def _stated(rng: Generator, mass: float, inertia: Array) -> str:
    names = ("ixx", 0, 0), ("iyy", 1, 1), ("izz", 2, 2), ("ixy", 0, 1), ("ixz", 0, 2), ("iyz", 1, 2)
    told = " ".join(f'{name}="{float(inertia[i, j])!r}"' for name, i, j in names)
    return f'<inertial>{_origin(rng)}<mass value="{mass!r}"/><inertia {told}/></inertial>'


def _origin(rng: Generator) -> str:
    return f'<origin xyz="{_text(0.3 * rng.normal(size=3))}" rpy="{_text(rng.uniform(-3, 3, size=3))}"/>'


def _text(numbers: Array) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _find(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    found = element.find(tag)
    assert found is not None
    return found


def _pose(element: ElementTree.Element) -> tuple[Array, Array]:
    origin = _find(element, "origin")
    xyz, rpy = (np.array(origin.get(key, "").split(), dtype=float) for key in ("xyz", "rpy"))
    return Rotation.from_euler("xyz", rpy).as_matrix(), xyz


def _tensor(inertial: ElementTree.Element) -> Array:
    told = {key: float(value) for key, value in _find(inertial, "inertia").attrib.items()}
    order = [["ixx", "ixy", "ixz"], ["ixy", "iyy", "iyz"], ["ixz", "iyz", "izz"]]
    return np.array([[told[key] for key in row] for row in order])
