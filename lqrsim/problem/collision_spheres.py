"""Robots made of several balls, or of convex hulls of balls: each centre as a function of the state, and its radius."""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Index, checked
from lqrsim.codegen import symbolic
from lqrsim.codegen.compiled_module import in_c_order, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.codegen.user_functions import (
    Term,
    axes_of,
    check_depends_on,
    check_derivative,
    level_of,
    name_of,
    numbers_of,
    raise_again,
    rows_of,
    with_derivatives,
)
from lqrsim.errors import (
    Array,
    InputError,
    brief,
    check_array,
    check_count,
    check_items,
    check_number,
    excerpt,
    vectors_of,
)
from lqrsim.kernels import differences, distances, user_functions
from lqrsim.kernels.distances import MOST_CORNERS
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.coordinates import Coordinates


@checked
@dataclass(frozen=True, eq=False)
class SphereCenters(Term):
    """Positions of balls, for one system.

    The source defines `places(x, data, out)`, which writes three coordinates per ball, ball by ball, and
    `places_jacobian(x, data, out, slopes)`, which writes the coordinates, and the nonzero derivatives in the states (3
    K, N) to an array of zeros.

    Attributes:
      depends_on: the states that the places depend on, by their indices.
      in_plane: whether the positions are in the plane of the robot's position, with third coordinate 0; else they are
        in space.
    """

    depends_on: tuple[Index, ...]
    in_plane: bool = False

    @property
    def _defines(self) -> Mapping[str, int]:
        return {"places": 3, "places_jacobian": 4}


def one_at(position: tuple[int, ...]) -> SphereCenters:
    """The centre of a robot that is one ball at its position, of 2 or 3 states."""
    values = [f"out[{i}] = x[{state}]" for i, state in enumerate(position)] + ["out[2] = 0.0"] * (len(position) == 2)
    slopes = [f"slopes[{i}, {state}] = 1.0" for i, state in enumerate(position)]
    lines = ["def places(x, data, out):", *values, "def places_jacobian(x, data, out, slopes):", *values, *slopes]
    text = "\n".join(line if line.startswith("def") else f"    {line}" for line in lines)
    return SphereCenters(text, np.zeros(0), position, len(position) == 2)


class CollisionSpheres:
    """A robot's outline as balls that its state moves: the links of an arm, the rotors of a quadrotor.

        def rotors(x, p):
            r = x[3:6]  # a rotation vector
            arms = [(0.2, 0, 0), (0, 0.2, 0), (-0.2, 0, 0), (0, -0.2, 0)]
            return [[a + b for a, b in zip(x[:3], ls.rotations.rotate(r, arm))] for arm in arms]

        ls.CollisionSpheres(rotors, [0.12] * 4)

    `ObstacleCost(world, balls=...)` and `Clearance(world, balls=...)` keep all balls clear. The `balls` of a `Robot`
    are its collision shape in simulation; a robot without them is one ball at its position. `Capsule` makes chains.

    `hulls` makes convex hulls of them, with exact distances, such as the boxes of a car and its trailer in the plane:

        car, trailer = ls.types.Box(0.5, 0.25), ls.types.Box(0.3, 0.25)

        def outline(x, p):
            from sympy import cos, sin
            behind = (x.px - 0.5 * cos(x.b), x.py - 0.5 * sin(x.b))
            return [*car.corners((x.px, x.py), x.a), *trailer.corners(behind, x.b)]

        ls.CollisionSpheres(outline, 0.0, hulls=[4, 4], names=["car", "trailer"])

    A hull of two balls is a capsule. The distance for an overlap is the length, below 0, of the shortest move that ends
    it.

    To compute the centres in another way, subclass this class and write `bind`.

    Args:
      places: `places(x, p)`, at one of the levels of `Dynamics`; returns the centre of each of K balls, as 3
        coordinates in the world, in metres. Unless the robot has a position in space, a centre may have 2 coordinates,
        in the plane of the position or, without one, in the horizontal plane; obstacles are then seen as for the
        position, see `World.seen_by`. The parameters of the dynamics are attributes of p.
      radii: (K,) radii of the balls, in metres; with hulls also one for all.
      hulls: number of balls of each hull, in the order of the balls, which have one radius. By default each ball is by
        itself. Obstacles of hulls in a plane stand upright on it.
      names: of the balls, or hulls, in messages; by default "ball 0", "ball 1", ..., or "hull 0", ....
      sites: sites or geoms in the robot's MJCF, one per ball, or None. A `Plant` checks that their centres are there.
      jacobian: `jacobian(x, p, slopes)`, for the compiled and the plain level: writes the nonzero derivatives to slopes
        (K, 3 or 2, n), which are zero on entry. Without it, central differences are used; JAX derives it.
      depends_on: names of the states that the centres depend on, for these levels; all by default. The fewer, the
        faster.
      level: as in `Dynamics`.

    The result of `places` is checked when it is first needed.
    """

    def __init__(
        self,
        places: Callable[[Any, Any], Any],
        radii: npt.ArrayLike,
        *,
        hulls: Sequence[int] | None = None,
        names: Sequence[str] | None = None,
        sites: Sequence[str | None] | None = None,
        jacobian: Callable[..., None] | None = None,
        depends_on: Sequence[str] | None = None,
        level: str | None = None,
    ) -> None:
        self.level = level_of(places, level, ("x", "p"))
        if jacobian is not None:
            check_derivative("CollisionSpheres: jacobian", jacobian, places, self.level, "x, p, slopes")
        self.function, self.jacobian = places, jacobian
        self._set_balls(radii, names, sites, hulls)
        self.depends_on = check_depends_on("CollisionSpheres", depends_on, "states")
        if self.depends_on is not None and self.level == "symbolic":
            got = "names for a symbolic function"
            raise InputError(f"CollisionSpheres: depends_on: got {got}, want None: they are derived")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} balls, radii {brief(self.radii.tolist())} m)"

    def _set_balls(
        self, radii: npt.ArrayLike, names: Sequence[str] | None, sites: Sequence[str | None] | None,
        hulls: Sequence[int] | None = None,
    ) -> None:  # fmt: skip
        """Check and set the attributes of each ball."""
        self.hulls = None
        if hulls is not None:
            sizes = check_items("CollisionSpheres: hulls", hulls, (int, np.integer), "the number of balls of each hull")
            self.hulls = tuple(check_count("CollisionSpheres: hulls", size, at_most=MOST_CORNERS) for size in sizes)
            if np.ndim(radii) == 0:  # pyright: ignore[reportArgumentType]
                radius = check_number("CollisionSpheres: radii", radii, at_least=0.0)
                radii = np.full(sum(self.hulls), radius)
        self.radii = check_array("CollisionSpheres: radii", radii, (None,))
        count = len(self.radii)
        if not count:
            raise InputError("CollisionSpheres: radii: got none, want one per ball, at least one")
        if (self.radii < 0).any():
            k = int(np.argmax(self.radii < 0))
            raise InputError(f"CollisionSpheres: radii: got {self.radii[k]:g} for ball {k}, want at least 0")
        if self.hulls is not None:
            if sum(self.hulls) != count:
                raise InputError(f"CollisionSpheres: hulls: got {sum(self.hulls)} balls in all, want {count}, as radii")
            for k, hull_radii in enumerate(np.split(self.radii, np.cumsum(self.hulls)[:-1])):
                if np.ptp(hull_radii):
                    got = f"{hull_radii.tolist()} in hull {k}"
                    raise InputError(f"CollisionSpheres: radii: got {got}, want one for all of it")
        part, parts = ("ball", count) if self.hulls is None else ("hull", len(self.hulls))
        wanted = f"{parts} different texts, one per {part}"
        self.names = tuple(f"{part} {k}" for k in range(parts))
        if names is not None:
            self.names = check_items("CollisionSpheres: names", names, str, wanted)
            if len(set(self.names)) < parts or len(self.names) != parts:
                raise InputError(f"CollisionSpheres: names: got {excerpt(self.names)}, want {wanted}")
        self.sites: tuple[str | None, ...] = (None,) * count
        if sites is not None:
            wanted = f"{count} names of sites or geoms, one per ball, or None in place of one"
            self.sites = check_items("CollisionSpheres: sites", sites, (str, type(None)), wanted)
            if len(self.sites) != count:
                raise InputError(f"CollisionSpheres: sites: got {len(self.sites)}, want {wanted}")

    def __len__(self) -> int:
        return len(self.radii)

    @property
    def ball_names(self) -> tuple[str, ...]:
        """The name of each ball; in a hull, with its number there."""
        if self.hulls is None:
            return self.names
        pairs = zip(self.names, self.hulls, strict=True)
        return tuple(f"{name}, corner {k}" for name, size in pairs for k in range(size))

    @property
    def name(self) -> str:
        return f"{name_of(self.function)}(x, p)"

    def bind(self, dynamics: Dynamics) -> SphereCenters:
        """Bind the places to the system whose states move the balls."""
        if self.level != "symbolic":
            return self._bind_functions(dynamics)
        called = dynamics.calling
        states, constants = dynamics.state_coordinates.names, called.constants
        details = ("balls", states, len(self), tuple(called.parameters), *constants.items())
        traced = symbolic.kept(
            self.function, details, lambda: self._trace(states, called.parameters, constants),
            source=str, size=int, depends_on=list,
        )  # fmt: skip
        self._check_plane(traced["size"], dynamics.state_coordinates)
        return SphereCenters(traced["source"], called.data, tuple(traced["depends_on"]), traced["size"] == 2)

    def _trace(
        self, states: Sequence[str], parameters: Mapping[str, float], constants: Mapping[str, float]
    ) -> dict[str, Any]:
        sizes: set[int] = set()

        @functools.wraps(self.function)
        def listed(x: Any, p: Any) -> list[Any]:
            points = _points(self.function(x, p), len(self))
            sizes.update(len(point) for point in points)
            return [entry for point in points for entry in point]

        entries, x, _ = symbolic.trace(listed, states, None, list(parameters), constants=constants)
        import sympy

        (size,) = sizes
        values: dict[str, Any] = {f"out[{3 * k + i}]": sympy.Integer(0) for k in range(len(self)) for i in range(3)}
        slopes, depends_on = {}, set[int]()
        for i, entry in enumerate(entries):
            row = 3 * (i // size) + i % size
            values[f"out[{row}]"] = entry
            nonzero = {j: slope for j, symbol in enumerate(x) if (slope := entry.diff(symbol)) != 0}
            slopes |= {f"slopes[{row}, {j}]": slope for j, slope in nonzero.items()}
            depends_on |= nonzero.keys()
        function = functools.partial(symbolic.write_function, data="data", of=self.name)
        places = function("places", "x, data, out", assignments=values)
        jacobian = function("places_jacobian", "x, data, out, slopes", assignments=values | slopes)
        return {"source": f"{places}\n\n{jacobian}", "size": size, "depends_on": sorted(depends_on)}

    def _bind_functions(self, dynamics: Dynamics) -> SphereCenters:
        names, size, called = dynamics.state_coordinates.names, self._size_of(dynamics), dynamics.calling
        axes, unused = axes_of("CollisionSpheres", self.depends_on, names)
        returned = {"values": size * len(self), "entries": self.ball_names, "columns": size, "unused": unused}
        functions = with_derivatives(
            self.function, returned, self.jacobian, ((len(self), size, len(names)),),
            level=self.level, states=len(names), controls=0, parameters=tuple(called.parameters), with_control=False,
        )  # fmt: skip
        source = source_of(user_functions, BALLS=len(self), COORDINATES=size)
        if len(functions) == 1:
            source = source_of(differences, BALLS=len(self), ACTIVE=axes).filled(places=source)
        return SphereCenters(source, called.data, axes, size == 2, functions=functions)

    def _size_of(self, dynamics: Dynamics) -> int:
        """The number of coordinates that a compiled or plain function returns for each ball, found by calling it."""
        plain: Any = getattr(self.function, "py_func", self.function)
        p = symbolic.Parameters(**dynamics.calling.parameters)
        try:
            with np.errstate(all="ignore"):
                size = len(_points(plain(np.zeros(len(dynamics.state_coordinates)), p), len(self))[0])
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from None
        except Exception as error:  # any exception of a user's function becomes one line
            failure = f"{type(error).__name__} ({error})"
            raise InputError(f"{self.name}: got {failure}, want it to work at x = (0, ..., 0)") from error
        self._check_plane(size, dynamics.state_coordinates)
        return size

    def _check_plane(self, size: int, space: Coordinates) -> None:
        if size == 2 and len(space.position) == 3:
            raise InputError(f"{self.name}: got points of 2 coordinates for a position in space, want 3")

    @checked
    def centres(self, dynamics: Dynamics, states: npt.ArrayLike) -> Array:
        """The centre of each ball, (..., K, 3), at states (..., n), in the world, in metres.

        Centres in a plane that is seen from above have height 0.
        """
        states = vectors_of("states", states, len(dynamics.state_coordinates))
        places = self.bind(dynamics)
        centers = evaluate(places, len(self), states)
        space = dynamics.state_coordinates
        return space.in_world(centers[..., :2]) if places.in_plane and space.plane else centers


def evaluate(places: SphereCenters, count: int, states: npt.ArrayLike) -> Array:
    """The centres (..., count, 3) of this number of balls, by compiled code, at states (..., n)."""
    points = np.asarray(states, dtype=np.float64)
    flat = in_c_order(points.reshape(-1, points.shape[-1]))
    out = np.empty((len(flat), 3 * count))
    _call(places, "write_centres", flat, out)
    return out.reshape(*points.shape[:-1], count, 3)


def evaluate_slopes(places: SphereCenters, count: int, states: Array) -> tuple[Array, Array]:
    """The same at states (K, n), and their derivatives in these, (K, count, 3, n)."""
    flat = in_c_order(states)
    out, slopes = np.empty((len(flat), 3 * count)), np.zeros((len(flat), 3 * count, flat.shape[1]))
    _call(places, "write_centres_and_jacobians", flat, out, slopes)
    return out.reshape(-1, count, 3), slopes.reshape(len(flat), count, 3, -1)


def _call(places: SphereCenters, name: str, states: Array, *outputs: Array) -> None:
    """Call a function of `kernels/distances.py`; exceptions of a user's function pass through."""
    filled = source_of(distances).filled(places=places.code, places_jacobian=places.code)
    module = module_of(filled, f"places of balls ({states.shape[1]} states)", N=states.shape[1])
    getattr(module, name)(len(states), states, numbers_of(places), *outputs)
    raise_again(places.functions)


def _points(returned: Any, count: int) -> list[list[Any]]:
    """The points that a function returned, if they are that many, and all have 2, or all 3, coordinates."""
    points = rows_of(returned, count, f"{count} points of 3 coordinates, one for each of radii", "points")
    sizes = {len(point) for point in points}
    if sizes not in ({2}, {3}):
        raise InputError(f"got points of {' and '.join(map(str, sorted(sizes)))} coordinates, want 3 of each, or 2")
    return points
