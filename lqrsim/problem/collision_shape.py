"""The collision shape of a robot: a ball at its position, several balls or hulls of them, or the geoms of an MJCF.

`CollisionSpheres` and `CollisionGeoms` are what a robot is outside of any world. `ShapeInWorld` is such a shape among
obstacles, with the methods that plans, chances of collision and simulations need.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Finite, Index, checked
from lqrsim.codegen import symbolic
from lqrsim.codegen.compiled_module import CompiledModule, in_c_order, module_of
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
from lqrsim.kernels import differences, distances, mjcf_dynamics, user_functions
from lqrsim.kernels.distances import MOST_CORNERS
from lqrsim.outlines import Capsule
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.mjcf_dynamics import MjcfDynamics, MjcfMemory
from lqrsim.problem.parts import Residual
from lqrsim.results.coordinates import Coordinates
from lqrsim.scenes.mujoco_log import mujoco
from lqrsim.scenes.scene import Pairs, Scene, pairs_of, solid_geoms
from lqrsim.scenes.world import World

MOST_ROWS = 128  # largest number of distances per step; beyond it, one per body: to the nearest obstacle
_TOLERANCE = 0.25  # largest part of a capsule outside its balls, relative to its radius
_TOUCHING = 1e-9  # m; how deep in an obstacle geoms may be that only touch it
_UNBOUNDED = 1e6  # m, a distance beyond all obstacles


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


class MjcfBalls(CollisionSpheres):
    """Balls that are fixed to bodies of an MJCF and cover its colliding geoms, as `outline` of `MjcfRobot` says.

    The last ball is in the centre of a geom. Geoms that are only drawn count if nothing collides.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        points, radii, names, sites = list[Array](), list[float](), list[str](), list[str | None]()
        for geom in solid_geoms(model).tolist():
            middle, name, radius = model.geom_pos[geom], model.geom(geom).name, float(model.geom_rbound[geom])
            centres = [middle]
            if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_CAPSULE):
                radius, half = (float(number) for number in model.geom_size[geom, :2])
                axis = np.zeros(3)
                mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, half]), model.geom_quat[geom])
                capsule = Capsule(2 * half, radius, _TOLERANCE * radius)
                chain = np.array(capsule.between(tuple(middle - axis), tuple(middle + axis)))
                centres = [*(centre for centre in chain if np.linalg.norm(centre - middle) > 1e-9), middle]
            for number, centre in enumerate(centres, start=1 - len(centres)):
                points.append(np.array([model.geom_bodyid[geom], *centre], dtype=np.float64))
                radii.append(radius)
                names.append(f"{name} ({-number} before)" if number else name)
                sites.append(None if number else name)
        self._points = np.array(points)  # of each ball the number of its body and its place in the body's axes
        self._set_balls(radii, names, sites)

    def bind(self, dynamics: Dynamics) -> SphereCenters:
        if not isinstance(called := dynamics.calling, MjcfDynamics):
            raise InputError(f"balls: got an MJCF's balls for {dynamics.name}, want its own dynamics, robot.dynamics")
        positions = tuple(range(called.physics.model.nv))
        data = np.concatenate([[len(self)], self._points.ravel()])
        source = source_of(differences, BALLS=len(self), ACTIVE=positions).filled(places=source_of(mjcf_dynamics))
        return SphereCenters(source, data, positions, functions=(MjcfMemory.of(called),))


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


class CollisionGeoms:
    """All moving geoms that collide in an MJCF, by MuJoCo's distances; `MjcfRobot.geoms` makes it.

    `ObstacleCost(world, geoms=...)` and `Clearance(world, geoms=...)` keep all these geoms clear. Meshes collide by
    their convex hulls.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.levers = scene, levers(scene.model)
        self.pairs = pairs_of(scene.model, list(scene.geoms))  # (K, 2), each with an obstacle as second
        number = {geom: i for i, geom in enumerate(scene.geoms)}
        self.obstacles = np.array([number[geom] for geom in self.pairs[:, 1].tolist()], dtype=np.int64)  # in the scene

    @property
    def size(self) -> float:
        """The radius of the largest geom's bounding sphere, in metres."""
        model = self.scene.model
        return float(model.geom_rbound[solid_geoms(model)].max(initial=0.0))

    def in_world(self, dynamics: Dynamics, world: World) -> "GeomsInWorld":
        """The geoms among obstacles, which must be in the robot's MJCF; the dynamics are the robot's."""
        if not isinstance(dynamics.calling, MjcfDynamics):
            raise InputError(f"geoms: got an MJCF's geoms for {dynamics.name}, want its own dynamics, robot.dynamics")
        known = {obstacle.name: (number, obstacle) for number, obstacle in enumerate(self.scene.world.obstacles)}
        numbers = list[int]()
        for obstacle in world.obstacles:
            number, stated = known.get(obstacle.name, (-1, None))
            if stated is None or not obstacle._equals(stated, "kind", "position", "rotation", "size"):
                raise InputError(
                    f"geoms: got the obstacle {obstacle.name!r}, which is not one of the robot's MJCF, want those of"
                    f" robot.scene.world: {', '.join(known) or 'there are none'}; or balls=robot.balls"
                )
            numbers.append(number)
        return GeomsInWorld(dynamics, world, np.array([self.size]), geoms=self, numbers=np.array(numbers, np.int64))


@dataclass(frozen=True, eq=False)
class GeomPairs:
    """Pairs of geoms of an MJCF, in rows, whose least distances `kernels/mjcf_dynamics.py` computes.

    Attributes:
      dynamics: the robot's, or made of these. pairs: (K, 2), of which the first geom moves. rows: (K,), of `count`.
    """

    dynamics: Dynamics
    model: mujoco.MjModel
    pairs: Pairs
    rows: npt.NDArray[np.int64]
    count: int

    def residual(self, parts: tuple[str, ...], reach: float) -> Residual:
        """The distances of all rows, which have names, up to `reach` in m, as functions of the state."""
        return Residual(
            source_of(mjcf_dynamics, ROWS=self.count), self._data(reach), parts, leading_states=self.model.nv,
            functions=(MjcfMemory.of(self._called),),
        )  # fmt: skip

    def distances(
        self, states: npt.ArrayLike, displaced: Array | None = None, reach: float = _UNBOUNDED
    ) -> tuple[Array, Array]:
        """Distances (..., rows) in m at states (..., n), and the pair of each row at the last state.

        Obstacles are displaced by (D, rows, 3) in m, by the first of these for the first of D equal parts of the
        states.
        """
        states = vectors_of("states", states, len(self.dynamics.state_coordinates))
        flat, rows = in_c_order(states.reshape(-1, states.shape[-1])), self.count
        displaced = np.zeros((1, rows, 3)) if displaced is None else displaced
        out, pairs, each = np.empty(len(flat) * rows), np.empty(rows), max(1, len(flat) // max(1, len(displaced)))
        self._module.distances_of(
            len(flat), flat, each, in_c_order(displaced.reshape(-1)), self._addressed(reach), out, pairs,
            np.empty((rows, 6)),
        )  # fmt: skip
        return out.reshape(*states.shape[:-1], rows), pairs

    def slopes(self, states: Array) -> tuple[Array, Array]:
        """Distances (k, rows) at states (k, n), and their derivatives in these, (k, rows, n)."""
        flat, rows = in_c_order(vectors_of("states", states, len(self.dynamics.state_coordinates))), self.count
        out, slopes = np.empty(len(flat) * rows), np.zeros((len(flat) * rows, flat.shape[1]))
        data = self._addressed(_UNBOUNDED)
        self._module.slopes_of(len(flat), flat, data, out, slopes, np.empty(rows), np.empty((rows, 6)))
        return out.reshape(-1, rows), slopes.reshape(-1, rows, flat.shape[1])

    @property
    def _called(self) -> MjcfDynamics:
        assert isinstance(self.dynamics.calling, MjcfDynamics)
        return self.dynamics.calling

    @property
    def _module(self) -> Any:
        states = len(self.dynamics.state_coordinates)
        return module_of(source_of(mjcf_dynamics), f"MuJoCo's distances ({states} states)", N=states)

    def _addressed(self, reach: float) -> Array:
        return np.concatenate([[float(self._called.physics.address())], self._data(reach)])

    @checked
    def _data(self, reach: Finite) -> Array:
        """The data of the kernel, except the address of p."""
        model, pairs = self.model, self.pairs
        bodies, radii = model.geom_bodyid[pairs], model.geom_rbound[pairs]  # that of a plane is 0
        planes = model.geom_type[pairs[:, 1]] == int(mujoco.mjtGeom.mjGEOM_PLANE)
        moving = np.where(model.body_weldid[bodies[:, 1]] != 0, bodies[:, 1], 0)
        columns = [self.rows, pairs[:, 0], bodies[:, 0], pairs[:, 1], radii.sum(axis=1), planes, moving]
        return np.concatenate([[self.count, len(pairs), reach], np.stack(columns, axis=1).astype(np.float64).ravel()])


@dataclass(frozen=True, eq=False)
class ShapeInWorld:
    """A robot's collision shape among obstacles: one ball or several; `GeomsInWorld` is that of geoms.

    Its *places* at states (..., n) are the centres of its balls, (..., B, 2 or 3) in m; for geoms, they are the states,
    (..., 1, n).

    Attributes:
      dynamics: the robot's dynamics. world: the obstacles, in the coordinates of the places.
      radii: radii of the balls, or hulls, in m, (P,); for geoms, the radius of the largest geom.
      names: their names. centers: the centres of the balls; None for one ball at the robot's position.
      hulls: number of balls of each hull; None for balls by themselves among primitives.
    """

    dynamics: Dynamics
    world: World
    radii: Array
    names: tuple[str, ...] = ("",)
    centers: SphereCenters | None = None
    hulls: tuple[int, ...] | None = None

    @property
    def depends_on(self) -> tuple[int, ...]:
        """The states that the places depend on, by their indices."""
        return self.dynamics.state_coordinates.position if self.centers is None else self.centers.depends_on

    @property
    def in_plane(self) -> bool:
        """Whether the places are in the plane of the robot's position."""
        return len(self.dynamics.state_coordinates.position) == 2 if self.centers is None else self.centers.in_plane

    def distances(self, reach: float) -> tuple[Residual, tuple[int, ...]] | None:
        """The distances of geoms up to `reach` in m, among obstacles that stand still; and the number of each row's
        obstacle, or -1 for the nearest. None for balls, whose distances have second derivatives.
        """
        return None

    @property
    def sizes(self) -> tuple[int, ...]:
        """The number of balls of each part: of each hull, or 1."""
        return self.hulls or (1,) * len(self.radii)

    @property
    def balls(self) -> int:
        return sum(self.sizes)

    @property
    def parts(self) -> Array:
        """For the kernels: the radius of each part, and for hulls the first ball of each, and the end of the last."""
        return np.concatenate([self.radii, np.cumsum([0, *self.hulls])]) if self.hulls else self.radii

    def places(self, states: Array) -> Array:
        """The places at states (..., n)."""
        if self.centers is None:
            return states[..., None, list(self.depends_on)]
        return evaluate(self.centers, self.balls, states)

    def clearance(self, places: Array, displaced: Array | None = None) -> Array:
        """Signed distance to the nearest obstacle, minus the radius, at places: (...) in m; infinite without obstacles.

        Args:
          displaced: (K, O, 3) in m, displacements of the obstacles; the first axis of the places is then K.
        """
        if not len(self.world):
            return np.full(places.shape[:-2], np.inf)
        if self.hulls:
            distances, _ = hull_distances(self.world, places, self.hulls, displaced)
            return (distances - self.radii[:, None]).min(axis=(-2, -1))
        return (signed_distance(self.world, places, displaced) - self.radii).min(axis=-1)

    def with_slopes(self, states: Array, along: Sequence[int]) -> tuple[Array, Array]:
        """Clearance of each obstacle at states (K, n), (K, O) in m, and its derivatives in some states, (K, O, p).

        Both belong to the nearest ball, or hull.
        """
        knots, axes = np.arange(len(states))[:, None], list(self.depends_on)
        if self.centers is None:
            places, slopes = self.places(states), np.eye(states.shape[1])[None, None, axes].repeat(len(states), 0)
        else:
            places, slopes = evaluate_slopes(self.centers, self.balls, states)
        distances, corner_slopes = hull_distances(self.world, places, self.sizes)
        clearance = distances - self.radii[:, None]
        chosen = knots, clearance.argmin(axis=1), np.arange(len(self.world))
        corners = np.cumsum([0, *self.sizes[:-1]])[:, None] + np.arange(max(self.sizes))  # of each part
        moves = slopes[knots[..., None], np.minimum(corners, self.balls - 1)[chosen[1]]][..., list(along)]
        return clearance[chosen], np.einsum("kocd,kocdi->koi", corner_slopes[chosen][..., : moves.shape[-2]], moves)

    def nearest(self, places: Array, displaced: Array) -> int:
        """The number of the obstacle that is nearest at places (B, 2 or 3), when displaced by (O, 3)."""
        distances, _ = hull_distances(self.world, places[None], self.sizes, displaced[None])
        larger = self.radii - self.radii.min()  # a radius that all share changes no order, except by rounding
        return int((distances[0] - larger[:, None]).min(axis=0).argmin())

    def travel(self, before: Array, after: Array) -> Array:
        """The largest distance that any point moves on a straight line between places, (...) in m."""
        return np.linalg.norm(after - before, axis=-1).max(axis=-1)

    def inside(self, state: Array) -> tuple[str, str] | None:
        """The place in an obstacle of a state, which may have NaNs, and the remedy, as texts; None if it is clear."""
        if not len(self.world):
            return None
        ends = np.cumsum(self.sizes)[:-1]
        for name, radius, corners in zip(self.names, self.radii, np.split(self.places(state), ends), strict=True):
            if np.isnan(corners).any():
                continue
            place = corners.mean(axis=0)
            distances = hull_distances(self.world, corners[None], [len(corners)])[0][0, 0] - radius
            if distances.min() < 0:
                which, whose = (f"with {name!r} ", "its radius") if name else ("", "the robot's radius")
                at, deep = ", ".join(f"{value:g}" for value in place), -distances.min()
                obstacle = self.world.names[int(distances.argmin())]
                where = f"{which}at ({at}) m, {deep:.3g} m inside obstacle {obstacle!r}"
                return where, f" of obstacles by {whose} of {radius:g} m" if radius else " of obstacles"
        return None

    def across(self, vectors: Array) -> Array:
        """Convert vectors (..., 3) from the axes of the scene to the axes of `world`."""
        space = self.dynamics.state_coordinates
        if not self.in_plane or not space.plane:
            return vectors
        normal = np.cross(*np.eye(3)[list(space.world_axes)])
        return np.concatenate([space.of_world(vectors), (vectors @ normal)[..., None]], axis=-1)


@dataclass(frozen=True, eq=False, kw_only=True)
class GeomsInWorld(ShapeInWorld):
    """The geoms of an MJCF among all or some obstacles of its scene."""

    geoms: CollisionGeoms
    numbers: npt.NDArray[np.int64]  # (O,), the index in the scene of each obstacle

    @property
    def depends_on(self) -> tuple[int, ...]:
        return tuple(range(self.geoms.scene.model.nv))

    @property
    def in_plane(self) -> bool:
        return False

    def distances(self, reach: float) -> tuple[Residual, tuple[int, ...]]:
        if self.world.moving:
            raise InputError("geoms: got obstacles that move, want balls=robot.balls for them")
        each, model = self._to_each, self.geoms.scene.model
        keys = list(zip(model.geom_bodyid[each.pairs[:, 0]].tolist(), each.rows.tolist(), strict=True))
        if len(set(keys)) > MOST_ROWS:
            keys = [(body, -1) for body, _ in keys]
        rows = sorted(set(keys))
        index = {key: row for row, key in enumerate(rows)}
        numbered = np.array([index[key] for key in keys], dtype=np.int64)
        pairs = replace(each, rows=numbered, count=max(1, len(rows)))
        parts, numbers = tuple(model.body(body).name for body, _ in rows), tuple(number for _, number in rows)
        return pairs.residual(parts, reach), numbers

    def places(self, states: Array) -> Array:
        return states[..., None, :]

    def clearances(self, states: npt.ArrayLike, displaced: Array | None = None) -> Array:
        """Signed distances (..., O) in m at states (..., n); (K, ..., n), if obstacles are displaced by (K, O, 3)."""
        return self._to_each.distances(states, displaced)[0]

    def clearance(self, places: Array, displaced: Array | None = None) -> Array:
        """NaN where a state has a NaN."""
        states = places[..., 0, :]
        known = np.asarray(np.isfinite(states).all(axis=-1))
        if not len(self.world):
            return np.full(known.shape, np.inf)
        distances = self.clearances(np.where(known[..., None], states, 0.0), displaced).min(axis=-1)
        return distances if known.all() else np.where(known, distances, np.nan)

    def with_slopes(self, states: Array, along: Sequence[int]) -> tuple[Array, Array]:
        distances, slopes = self._to_each.slopes(states)
        return distances, slopes[..., list(along)]

    def nearest(self, places: Array, displaced: Array) -> int:
        return int(self.clearances(places[None], displaced[None])[0, 0].argmin())

    def travel(self, before: Array, after: Array) -> Array:
        nv = len(self.geoms.levers)
        return np.abs(after[..., 0, :nv] - before[..., 0, :nv]) @ self.geoms.levers

    def inside(self, state: Array) -> tuple[str, str] | None:
        if not len(self.world) or np.isnan(state[list(self.depends_on)]).any():
            return None
        state = np.where(np.isnan(state), 0.0, state)  # velocities and activations, which move no geom
        each = self._to_each
        distances, pairs = each.distances(state)
        if distances.min() >= -_TOUCHING:
            return None
        nearest, model = int(distances.argmin()), self.geoms.scene.model
        pair = each.pairs[int(pairs[nearest])]
        body, other = (model.body(number).name for number in model.geom_bodyid[pair].tolist())
        where = f"with {body!r} {-distances.min():.3g} m inside obstacle {self.world.names[nearest]!r}"
        exclude = f'<contact><exclude body1="{other}" body2="{body}"/></contact> in the MJCF'
        return where, f"; or, if they may overlap, {exclude}; or obstacles= of the robot without it"

    @property
    def _to_each(self) -> GeomPairs:
        """The pairs with a row for each obstacle."""
        place = np.full(len(self.geoms.scene.world), -1, dtype=np.int64)
        place[self.numbers] = np.arange(len(self.numbers))
        rows = np.asarray(place[self.geoms.obstacles], dtype=np.int64)
        chosen = np.flatnonzero(rows >= 0)
        return GeomPairs(
            self.dynamics, self.geoms.scene.model, self.geoms.pairs[chosen], rows[chosen], len(self.numbers)
        )


def shape_in(
    dynamics: Dynamics, world: World, *, radius: float = 0.0, balls: CollisionSpheres | None = None,
    geoms: CollisionGeoms | None = None,
) -> ShapeInWorld:  # fmt: skip
    """The shape of a robot among obstacles. A robot without a position is among none by its radius."""
    space = dynamics.state_coordinates
    if geoms is not None:
        return geoms.in_world(dynamics, world)
    if balls is not None:
        centers = balls.bind(dynamics)
        seen = world.seen_by(space.plane or "xy", space.offset) if centers.in_plane else world
        if not balls.hulls:
            hulls = (1,) * len(balls) if seen.has_meshes else None
            return ShapeInWorld(dynamics, seen, balls.radii, balls.names, centers, hulls)
        radii = balls.radii[np.cumsum([0, *balls.hulls[:-1]])]
        seen = seen.upright() if centers.in_plane else seen
        for obstacle in seen.obstacles:
            if obstacle.kind == "box" and np.isinf(obstacle.size).sum() > 1:
                got = "a box that is infinite in two directions"
                raise InputError(f"obstacle {obstacle.name!r}: got {got}, want one of them")
        return ShapeInWorld(dynamics, seen, radii, balls.names, centers, balls.hulls)
    seen = world.seen_by(space.plane, space.offset) if space.position else World()
    if seen.has_meshes:
        return ShapeInWorld(dynamics, seen, np.array([radius]), ("",), one_at(space.position), (1,))
    return ShapeInWorld(dynamics, seen, np.array([radius]))


def signed_distance(world_seen: World, points: npt.ArrayLike, displaced: Array | None = None) -> Array:
    """Distances (...) of points (..., 2 or 3) to the nearest obstacle: `world_seen.distance(points)`, compiled.

    Args:
      displaced: (K, obstacles, 3) displacements of the obstacles; the first axis of the points is then K.
    """
    points, count = np.asarray(points, dtype=np.float64), len(world_seen)
    flat = np.zeros((points[..., 0].size, 3))
    flat[:, : points.shape[-1]] = points.reshape(-1, points.shape[-1])
    displaced, out = np.zeros((1, count, 3)) if displaced is None else displaced, np.empty(len(flat))
    per_displacement = max(1, len(flat) // max(1, len(displaced)))
    # One row for each obstacle, so that their number is not part of the type: another world compiles nothing.
    away = np.ascontiguousarray(displaced, dtype=np.float64).reshape(-1, 3)
    _distances().nearest(count, len(flat), per_displacement, world_seen.table, flat, away, out)
    return out.reshape(points.shape[:-1])


def hull_distances(
    world_seen: World, places: Array, hulls: Sequence[int], displaced: Array | None = None
) -> tuple[Array, Array]:
    """Distances of convex hulls to each obstacle, and their derivatives in the corners.

    Args:
      world_seen: the obstacles; those of hulls in a plane are `World.upright`.
      places: (..., B, 2 or 3), the corners, hull by hull.
      hulls: number of corners of each of H hulls; 1 for a ball.
      displaced: (K, O, 3) displacements of the obstacles; the first axis of the places is then K.

    Returns:
      The distances (..., H, O), and the derivatives (..., H, O, C, 3), for C corners of the largest hull.
    """
    batch, count, widest = places.shape[:-2], len(world_seen), max(hulls)
    flat = np.zeros((int(np.prod(batch)), places.shape[-2], 3))
    flat[..., : places.shape[-1]] = places.reshape(-1, *places.shape[-2:])
    displaced = np.zeros((1, count, 3)) if displaced is None else displaced
    rows, per_displacement = len(flat) * len(hulls) * count, max(1, len(flat) // len(displaced))
    out, corner_slopes = np.empty(rows), np.zeros((rows, 3 * widest))
    _distances().hull_distances(
        count, len(flat), per_displacement, world_seen.table, np.cumsum([0, *hulls], dtype=np.float64),
        len(hulls), flat.reshape(len(flat), -1), np.ascontiguousarray(displaced).reshape(-1, 3), out, corner_slopes,
    )  # fmt: skip
    shape = (*batch, len(hulls), count)
    return out.reshape(shape), corner_slopes.reshape(*shape, widest, 3)


def _distances() -> CompiledModule:
    return module_of(source_of(distances), "distances to obstacles")


def levers(model: mujoco.MjModel) -> Array:
    """The most that any point of the robot moves per degree of freedom, (nv,), at any angles: m/rad, or 1 for slides.

    Slides between a joint and the body that it turns count with the farthest that their range lets them move from rest,
    or 1 m without a range.
    """
    reach, spans = np.zeros(model.nbody), np.zeros(model.nbody)
    arms = np.ones(model.nv)
    for joint in range(model.njnt):
        spans[model.jnt_bodyid[joint]] += 2 * np.linalg.norm(model.jnt_pos[joint])
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            moved = model.jnt_range[joint] - model.qpos0[model.jnt_qposadr[joint]]  # from rest, which is at `ref`
            spans[model.jnt_bodyid[joint]] += np.abs(moved).max() if model.jnt_limited[joint] else 1.0
    for geom in solid_geoms(model).tolist():
        body = int(model.geom_bodyid[geom])
        reach[body] = max(reach[body], float(np.linalg.norm(model.geom_pos[geom]) + model.geom_rbound[geom]))
    for body in range(model.nbody - 1, 0, -1):  # children come after their parents
        parent = int(model.body_parentid[body])
        reach[parent] = max(reach[parent], reach[body] + spans[body] + float(np.linalg.norm(model.body_pos[body])))
    for joint in range(model.njnt):
        kind, body, dof = model.jnt_type[joint], int(model.jnt_bodyid[joint]), int(model.jnt_dofadr[joint])
        lever = reach[body] + spans[body] + float(np.linalg.norm(model.jnt_pos[joint]))
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            arms[dof + 3 : dof + 6] = lever
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            arms[dof : dof + 3] = lever
        elif kind == mujoco.mjtJoint.mjJNT_HINGE:
            arms[dof] = lever
    return arms
