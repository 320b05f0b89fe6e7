"""The meaning of a state or control vector: names, units, limits, and which entries wrap."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Finite, Index, Want, checked
from lqrsim.errors import Array, InputError, check_array, check_name, check_number, excerpt, keep, real, vectors_of
from lqrsim.scenes.world import PLANES, SPACE

_Value = TypeVar("_Value")

# One for each entry, or by name or by unit: {"m": 0.05, "m/s": 0.2}, {"x": 0.05}.
PerEntry = npt.ArrayLike | Mapping[str, float]
# (lowest, highest), each a number or one for each entry; or such a pair by name or unit: {"N": (0, 2)}.
Limits = tuple[npt.ArrayLike, npt.ArrayLike] | Mapping[str, tuple[float, float]]

_FROM_ABOVE = ("xy", "yx")
_UNITS = {  # units of distances to obstacles and of whole turns
    "position": ("m", "for a position"),
    "angles": ("rad", "for an angle, whose whole turns are 2 pi"),
    "rotation_vectors": ("rad", "for a rotation vector"),
}
_UPWARD = ("height", "altitude", "elevation", "vertical")  # such a name does not fit a plane seen from above


@checked
@dataclass(frozen=True, kw_only=True)
class Coordinates:
    """The meaning of the entries of a vector.

    Attributes:
      units: units of the entries; "" for none. A position is in m, angles and rotation vectors in rad.
      position: indices of the 2 (planar) or 3 (spatial) entries that are the position in the world, in metres; or none.
      plane: the world's axes along which the position is measured, in its order: "xyz" for a spatial position, ""
        without a position, and two of x, y and z for a planar position. By default it follows from names with such a
        letter at the end or standing alone, as (x, z), (p_x, p_z) or (x_tip, z_tip), and is "xy" if no name tells it.
      offset: coordinate of the plane along the third axis, in metres: the y of "xz". A vertical plane has an offset, 0
        by default. A horizontal plane has none by default: the world is then seen from above. See `World.seen_by`.
      angles: indices of the entries that are angles in radians, equal up to whole turns.
      rotation_vectors: index of the first of each three entries that are a rotation vector, axis times angle in rad. If
        one of the three is also an angle, it is a turn about its axis, after a tilt by the vector of the other two.
      low: lower limit of each entry, (len(names),); -inf where there is none.
      high: upper limit of each entry, (len(names),); inf where there is none.
    """

    _prefix = ""

    names: tuple[Annotated[str, Want("a name")], ...]
    units: tuple[Annotated[str, 200], ...]
    position: tuple[Index, ...] = ()
    angles: tuple[Index, ...] = ()
    rotation_vectors: tuple[Index, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    plane: str = ""
    offset: Finite | None = None

    def __post_init__(self) -> None:
        size = len(self.names)
        if not size:
            raise InputError("names: got none, want at least one")
        if len(self.units) != size:
            raise InputError(f"units: got {len(self.units)}, want {size}, one for each of {', '.join(self.names)}")
        if len(set(self.names)) != size:
            raise InputError(f"names: got a name twice in {', '.join(self.names)}, want different names")
        if len(self.position) not in (0, 2, 3):
            raise InputError(f"position: got {len(self.position)} entries, want 2 (a planar robot), 3, or none")
        for field, (unit, why) in _UNITS.items():
            indices, width = getattr(self, field), 3 if field == "rotation_vectors" else 1
            if len(set(indices)) < len(indices):
                raise InputError(f"{field}: got {excerpt(indices)}, want different indices")
            if any(index > size - width for index in indices):
                raise InputError(f"{field}: got indices {indices}, want them between 0 and {size - width}")
            for entry in (first + i for first in indices for i in range(width)):
                if self.units[entry] not in ("", unit):
                    name = self.names[entry]
                    raise InputError(f"units: {name}: got {excerpt(self.units[entry])}, want {unit!r} {why}")
        for first in self.rotation_vectors:
            if len(turns := [self.names[i] for i in range(first, first + 3) if i in self.angles]) > 1:
                got = ", ".join(turns)
                raise InputError(f"angles: got {got} of one rotation vector, want at most one of the three")
        plane = self._plane()
        if len(plane) != 2 and self.offset is not None:
            raise InputError(f"offset: got {excerpt(self.offset)} without a plane, want it with a planar position")
        offset = 0.0 if self.offset is None and len(plane) == 2 and plane not in _FROM_ABOVE else self.offset
        low = check_array("low", self.low or (-np.inf,) * size, (size,), infinite=True)
        high = check_array("high", self.high or (np.inf,) * size, (size,), infinite=True)
        if (low >= high).any():
            i = int(np.argmax(low >= high))
            got = f"{low[i]:g} to {high[i]:g}"
            raise InputError(f"limits of {self.names[i]}: got {got}, want the first below the second")
        keep(self, plane=plane, offset=offset, low=tuple(low.tolist()), high=tuple(high.tolist()))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def rules(self) -> str:
        """Limits, and which entries wrap, as text: what controls depend on, for hashes."""
        return f"{self.low} {self.high} {self.angles} {self.rotation_vectors}"

    @property
    def limits(self) -> tuple[Array, Array]:
        """The lower and the upper limits, (n,) each."""
        return np.array(self.low), np.array(self.high)

    @property
    def turns(self) -> tuple[int, ...]:
        """Which entry of each rotation vector, 0 to 2, is an angle, a turn about its axis; -1 if none is."""
        return tuple(next((i for i in range(3) if first + i in self.angles), -1) for first in self.rotation_vectors)

    def _plane(self) -> str:
        """The plane: as given, from the names, or the default. Raises InputError if these contradict each other."""
        names = tuple(self.names[index] for index in self.position)
        said = "".join(_letter(name) for name in names)
        listed = ", ".join(names)
        if len(names) == 3:
            if self.plane not in ("", SPACE):
                got = f"{excerpt(self.plane)} for the position ({listed})"
                raise InputError(f"plane: got {got}, want none: the position is spatial")
            if sorted(said) == sorted(SPACE) and said != SPACE:
                want = ", ".join(names[said.index(letter)] for letter in SPACE)
                raise InputError(f"position: got ({listed}), want it along x, y and z in this order: ({want})")
            return SPACE
        if not names:
            if self.plane:
                raise InputError(f"plane: got {excerpt(self.plane)} without a position, want position=(names) with it")
            return ""
        if self.plane:
            plane = check_name("plane", self.plane, PLANES)
            if said in PLANES and plane != said:
                raise InputError(f"plane: got {plane!r} for the position ({listed}), want {said!r}, or other names")
            return plane
        if said in PLANES:
            return said
        if said != "??" or any(word in name.lower() for word in _UPWARD for name in names):
            got = f"none for the position ({listed}), whose names do not tell the plane"
            raise InputError(f"plane: got {got}, want one of: {', '.join(PLANES)}")
        return "xy"

    @property
    def world_axes(self) -> tuple[int, ...]:
        """The world's axis, 0 to 2, of each entry of the position."""
        return tuple(SPACE.index(letter) for letter in self.plane)

    @property
    def from_above(self) -> bool:
        """Whether the position is in a horizontal plane without a height: the ground under the robot."""
        return len(self.position) == 2 and self.offset is None

    @checked
    def in_world(self, places: npt.ArrayLike, *, height: Finite = 0.0) -> Array:
        """Points (..., 3) in the world of positions (..., 2 or 3), in metres.

        Args:
          height: height in metres of positions in a horizontal plane without a height.
        """
        if not self.position:
            raise InputError("places: got positions, but the coordinates have none, want position=(names) with them")
        places = vectors_of("places", places, len(self.position))
        points = np.full((*places.shape[:-1], 3), height if self.offset is None else self.offset)
        points[..., list(self.world_axes)] = places
        return points

    def of_world(self, points: npt.ArrayLike) -> Array:
        """The positions (..., 2 or 3) of points (..., 3) in the world, projected onto the plane; in metres."""
        return vectors_of("points", points, 3)[..., list(self.world_axes)]

    @property
    def labels(self) -> tuple[str, ...]:
        """`name (unit)` for each entry, for axes and tables."""
        return tuple(f"{n} ({u})" if u else n for n, u in zip(self.names, self.units, strict=True))

    def nearest(self, vector: npt.ArrayLike, near: npt.ArrayLike) -> Array:
        """The representative of `vector` nearest to `near`; angles and rotation vectors are equal up to whole turns.

        Args:
          near: (..., n); leading dimensions broadcast.
        """
        out, near = vectors_of("vector", vector, len(self)), vectors_of("near", near, len(self))
        try:
            out, near = np.broadcast_arrays(out, near)
        except ValueError:
            raise InputError(f"near: got shape {near.shape}, want one that goes with {out.shape} of vector") from None
        out = out.copy()
        for i in self.angles:
            out[..., i] -= 2 * np.pi * np.round((out[..., i] - near[..., i]) / (2 * np.pi))
        for first, turn in zip(self.rotation_vectors, self.turns, strict=True):
            entries = slice(first, first + 3) if turn < 0 else [first + i for i in range(3) if i != turn]
            out[..., entries] = _nearest_rotation_vector(out[..., entries], near[..., entries])
        return out

    def difference(self, vector: npt.ArrayLike, near: npt.ArrayLike) -> Array:
        """The difference `vector - near`, with angles and rotation vectors in the representative nearest to `near`."""
        return self.nearest(vector, near) - vectors_of("near", near, len(self))

    def _by_name(
        self, field: str, entries: Mapping[str, object], check: Callable[[str, object], _Value]
    ) -> dict[int, _Value]:
        """Values that are given by name or by unit, by the index of the entry. A name takes precedence over a unit."""
        units, values = set(self.units) - {""} - set(self.names), {}
        for key in sorted(entries, key=lambda key: key not in units):  # units first, so that names take precedence
            check_name(field, key, [*self.names, *sorted(units)])
            value = check(f"{field}: {excerpt(key)}", entries[key])
            labels = self.units if key in units else self.names
            values |= {i: value for i, label in enumerate(labels) if label == key}
        return values

    def _numbers(self, field: str, entries: Mapping[str, float]) -> Array:
        """Numbers by name or by unit as an array (n,), with 0 for entries without a number."""
        out = np.zeros(len(self))
        for i, number in self._by_name(field, entries, check_number).items():
            out[i] = number
        return out

    def _ranges(self, field: str, limits: Limits) -> tuple[Array, Array]:
        """The lowest and the highest value of each entry, (n,) each, as `limited` takes them."""
        if isinstance(limits, Mapping):
            low, high = self.limits
            pair_of = partial(check_array, shape=(2,), infinite=True)
            for i, pair in self._by_name(field, limits, pair_of).items():  # pyright: ignore[reportArgumentType]
                low[i], high[i] = pair
            return low, high
        try:
            low, high = (np.broadcast_to(real(field, side), len(self)) for side in limits)
        except Exception:  # not a pair, not numbers, or the wrong number of them
            wanted = f"(lowest, highest), each a number or ({len(self)},), or such pairs by name"
            raise InputError(f"{field}: got {excerpt(limits)}, want {wanted}") from None
        return low, high

    def limited(self, limits: Limits) -> "Coordinates":
        """The same coordinates with other limits.

        Args:
          limits: (lowest, highest), each a number or (n,); or a dictionary of name or unit: (lowest, highest). Entries
            that are not named keep their limits.
        """
        low, high = self._ranges("control_limits", limits)
        for name, lowest, highest in zip(self.names, low, high, strict=True):
            if not lowest < highest:
                fixed = "; a control that cannot change is a parameter of the dynamics" if lowest == highest else ""
                got = f"{lowest:g} to {highest:g} for {name}"
                raise InputError(f"control_limits: got {got}, want the first below the second{fixed}")
        return replace(self, low=tuple(low.tolist()), high=tuple(high.tolist()))

    @checked
    def within(self, other: "Coordinates") -> "Coordinates":
        """The same coordinates with the narrower of both limits, between which something must be."""
        if len(other) != len(self):
            raise InputError(f"other: got {len(other)} entries, want {len(self)}: {', '.join(self.names)}")
        low, high = np.maximum(self.low, other.low), np.minimum(self.high, other.high)
        return replace(self, low=tuple(low.tolist()), high=tuple(high.tolist()))

    def clip(self, vector: npt.ArrayLike) -> Array:
        """The `vector` (..., n), clipped to the limits."""
        return np.clip(vectors_of("vector", vector, len(self)), self.low, self.high)


Spaces = tuple[Coordinates, Coordinates]  # of states and of controls


class _Spaced(Protocol):
    @property
    def state_coordinates(self) -> Coordinates: ...
    @property
    def control_coordinates(self) -> Coordinates: ...


def spaces_of(system: _Spaced) -> Spaces:
    """The coordinates of the states and of the controls of dynamics, a policy or a rollout."""
    return system.state_coordinates, system.control_coordinates


def check_same_system(field: str, what: object, got: Spaces, want: Spaces, whose: str) -> None:
    """Check that states and controls have the same names.

    Args:
      field: field in messages. what: description of the given object, such as "a policy". got, want: its coordinates,
        and the required ones. whose: name of the owner of the required coordinates.
    """
    for kind, space, wanted in zip(("states", "controls"), got, want, strict=True):
        if space.names != wanted.names:
            stated = f"{what} with the {kind} {', '.join(space.names)}"
            raise InputError(f"{field}: got {stated}, want {', '.join(wanted.names)}, as {whose} has them")


def _letter(name: str) -> str:
    """The axis in a name: the letter x, y or z at its end, or standing alone; `?` if there is none."""
    if name[-1:].lower() in tuple(SPACE):
        return name[-1].lower()
    alone = set(re.findall(r"(?<![a-z])[xyz](?![a-z])", name.lower()))
    return alone.pop() if len(alone) == 1 else "?"


def _nearest_rotation_vector(vector: Array, near: Array) -> Array:
    """The rotation nearest to `near` among the equal rotations `(angle + 2 pi k) axis`; (..., 3), of tilts (..., 2)."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    distance = np.linalg.norm(near, axis=-1, keepdims=True)
    # The identity has every axis; take the axis that `near` points along.
    small = angle < 1e-12
    axis = np.where(small, near / np.where(distance > 0, distance, 1.0), vector / np.where(small, 1.0, angle))
    turns = np.round((np.sum(axis * near, axis=-1, keepdims=True) - angle) / (2 * np.pi))
    return np.where(turns == 0, vector, (angle + 2 * np.pi * turns) * axis)
