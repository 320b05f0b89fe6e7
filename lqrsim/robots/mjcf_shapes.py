"""What of a robot from an MJCF collides: its geoms, by MuJoCo's own distances, with each other; or balls along them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import mujoco
import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Finite, checked
from lqrsim.codegen.compiled_module import in_c_order, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError, vectors_of
from lqrsim.kernels import differences
from lqrsim.kernels import mjcf_dynamics as kernel
from lqrsim.outlines import Capsule
from lqrsim.problem.collision_shape import CollisionGeoms, GeomDistances, ShapeInWorld
from lqrsim.problem.collision_spheres import CollisionSpheres, SphereCenters
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.residual import Residual
from lqrsim.robots.mjcf_dynamics import MjcfDynamics, MjcfMemory
from lqrsim.scenes import mjcf_obstacles
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.scene import Scene
from lqrsim.scenes.world import World

MOST_ROWS = 128  # largest number of distances per step; beyond it, one per body: to the nearest obstacle
# Distance beyond the margin from which on links have slopes, relative to the largest geom's bounding sphere. Links that
# are two joints apart are always within twice its radius, the reach of a Clearance; all these slopes take time.
SEEN = 0.25
TOLERANCE = 0.25  # largest part of a capsule outside its balls, relative to its radius
TOUCHING = 1e-9  # m; how deep in an obstacle geoms may be that only touch it
_UNBOUNDED = 1e6  # m, a distance beyond all obstacles


class MjcfGeoms(CollisionGeoms):
    """All moving geoms that collide in an MJCF; `MjcfRobot` makes it. Meshes collide by their convex hulls."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.levers = scene, mjcf_obstacles.levers(scene.model)
        self.pairs = mjcf_obstacles.pairs_of(scene.model, list(scene.geoms))  # (K, 2), each with an obstacle as second
        number = {geom: i for i, geom in enumerate(scene.geoms)}
        self.obstacles = np.array([number[geom] for geom in self.pairs[:, 1].tolist()], dtype=np.int64)  # in the scene

    @property
    def size(self) -> float:
        model = self.scene.model
        return float(model.geom_rbound[mjcf_obstacles.solid_geoms(model)].max(initial=0.0))

    def of_scene(self, scene: Scene) -> bool:
        return scene is self.scene or (scene.xml == self.scene.xml and scene.geoms == self.scene.geoms)

    def in_world(self, dynamics: Dynamics, world: World) -> "GeomsInWorld":
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


@dataclass(frozen=True, eq=False, kw_only=True)
class GeomsInWorld(ShapeInWorld):
    """The geoms of an MJCF among all or some obstacles of its scene."""

    geoms: MjcfGeoms
    numbers: npt.NDArray[np.int64]  # (O,), the index in the scene of each obstacle

    @property
    def depends_on(self) -> tuple[int, ...]:
        return tuple(range(self.geoms.scene.model.nv))

    @property
    def in_plane(self) -> bool:
        return False

    def distances(self, reach: float) -> GeomDistances:
        if self.world.moving:
            raise InputError("geoms: got obstacles that move, want balls=robot.balls for them")
        model, obstacles = self.geoms.scene.model, self.geoms.obstacles
        chosen = np.flatnonzero(np.isin(obstacles, self.numbers))
        place = {int(number): i for i, number in enumerate(self.numbers)}
        bodies = model.geom_bodyid[self.geoms.pairs[:, 0]].tolist()
        keys = [(bodies[k], place[int(obstacles[k])]) for k in chosen]
        if len(set(keys)) > MOST_ROWS:
            keys = [(body, -1) for body, _ in keys]
        rows = sorted(set(keys))
        index = {key: row for row, key in enumerate(rows)}
        count, numbered = max(1, len(rows)), np.array([index[key] for key in keys], dtype=np.int64)
        return GeomDistances(
            source=source_of(kernel, ROWS=count),
            data=mjcf_obstacles.distance_data(model, self.geoms.pairs[chosen], numbered, count, reach),
            parts=tuple(model.body(body).name for body, _ in rows),
            obstacles=tuple(number for _, number in rows), leading_states=model.nv,
            functions=(MjcfMemory.of(self._mjcf_dynamics),),
        )  # fmt: skip

    def places(self, states: Array) -> Array:
        return states[..., None, :]

    def clearances(self, states: npt.ArrayLike, displaced: Array | None = None) -> Array:
        """Signed distances (..., O) in m at states (..., n); (K, ..., n), if obstacles are displaced by (K, O, 3)."""
        return _distances(self.dynamics, states, self._to_each()[1], displaced)[0]

    def clearance(self, places: Array, displaced: Array | None = None) -> Array:
        """NaN where a state has a NaN."""
        states = places[..., 0, :]
        known = np.asarray(np.isfinite(states).all(axis=-1))
        if not len(self.world):
            return np.full(known.shape, np.inf)
        distances = self.clearances(np.where(known[..., None], states, 0.0), displaced).min(axis=-1)
        return distances if known.all() else np.where(known, distances, np.nan)

    def with_slopes(self, states: Array, along: Sequence[int]) -> tuple[Array, Array]:
        flat, count = in_c_order(vectors_of("states", states, len(self.dynamics.state_coordinates))), len(self.world)
        distances, slopes = np.empty(len(flat) * count), np.zeros((len(flat) * count, flat.shape[1]))
        pair_of_row, segments = np.empty(count), np.empty((count, 6))
        _module(flat.shape[1]).slopes_of(len(flat), flat, self._to_each()[1], distances, slopes, pair_of_row, segments)
        return distances.reshape(-1, count), slopes.reshape(-1, count, flat.shape[1])[..., list(along)]

    def nearest(self, places: Array, displaced: Array) -> int:
        return int(self.clearances(places[None], displaced[None])[0, 0].argmin())

    def travel(self, before: Array, after: Array) -> Array:
        nv = len(self.geoms.levers)
        return np.abs(after[..., 0, :nv] - before[..., 0, :nv]) @ self.geoms.levers

    def inside(self, state: Array) -> tuple[str, str] | None:
        if not len(self.world) or np.isnan(state[list(self.depends_on)]).any():
            return None
        state = np.where(np.isnan(state), 0.0, state)  # velocities and activations, which move no geom
        chosen, data = self._to_each()
        distances, pairs = _distances(self.dynamics, state, data)
        if distances.min() >= -TOUCHING:
            return None
        nearest, model = int(distances.argmin()), self.geoms.scene.model
        pair = self.geoms.pairs[chosen[int(pairs[nearest])]]
        body, other = (model.body(number).name for number in model.geom_bodyid[pair].tolist())
        where = f"with {body!r} {-distances.min():.3g} m inside obstacle {self.world.names[nearest]!r}"
        exclude = f'<contact><exclude body1="{other}" body2="{body}"/></contact> in the MJCF'
        return where, f"; or, if they may overlap, {exclude}; or obstacles= of the robot without it"

    @property
    def _mjcf_dynamics(self) -> MjcfDynamics:
        assert isinstance(self.dynamics.calling, MjcfDynamics)
        return self.dynamics.calling

    def _to_each(self) -> tuple[npt.NDArray[np.intp], Array]:
        """The indices of the pairs, and the kernel's data with the address of p, for all distances to each obstacle."""
        place = np.full(len(self.geoms.scene.world), -1, dtype=np.int64)
        place[self.numbers] = np.arange(len(self.numbers))
        rows = np.asarray(place[self.geoms.obstacles], dtype=np.int64)
        chosen = np.flatnonzero(rows >= 0)
        pairs, count = self.geoms.pairs[chosen], len(self.numbers)
        data = mjcf_obstacles.distance_data(self.geoms.scene.model, pairs, rows[chosen], count, _UNBOUNDED)
        return chosen, np.concatenate([[float(self._mjcf_dynamics.physics.address())], data])


class SelfClearance(Constraint):
    """`distance(link, other link) >= margin` at the steps, by MuJoCo's distances; `MjcfRobot.self_clearance` makes it.

    The links are those of `mjcf_obstacles.link_pairs`; `links` has their pairs, by the names of their bodies.
    """

    @checked
    def __init__(self, mjcf: MjcfModel, body: str, margin: Finite = 0.0) -> None:
        model = mjcf.model
        self.margin, self._mjcf, self._pairs = margin, mjcf, mjcf_obstacles.link_pairs(model, model.body(body).id)
        geom_bodies = model.geom_bodyid[self._pairs]
        welds = model.body_weldid[geom_bodies]
        bodies = np.sort(np.where(welds != 0, welds, geom_bodies), axis=1)
        keys, rows = np.unique(bodies, axis=0, return_inverse=True)
        self._rows = np.asarray(rows, dtype=np.int64).ravel()
        self.links = tuple((model.body(first).name, model.body(second).name) for first, second in keys.tolist())

    def with_added_state(self, dynamics: Dynamics) -> Self:
        return self

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        if not isinstance(mjcf_dynamics := dynamics.calling, MjcfDynamics):
            raise InputError(f"SelfClearance: got dynamics {dynamics.name}, want the robot's own, robot.dynamics")
        model = self._mjcf.model
        reach = self.margin + SEEN * float(model.geom_rbound[self._pairs].max(initial=0.0))
        described = [f"{first!r} and {second!r}" for first, second in self.links]
        rows, merged = self._rows, np.arange(len(described))
        if len(described) > MOST_ROWS:  # then one for each link, to those after it
            firsts = list(dict.fromkeys(first for first, _ in self.links))
            merged = np.array([firsts.index(first) for first, _ in self.links])
            described, rows = [f"{link!r} and other links" for link in firsts], merged[rows]
        count = max(1, len(described))
        distances = Residual(
            source_of(kernel, ROWS=count), mjcf_obstacles.distance_data(model, self._pairs, rows, count, reach),
            parts=tuple(described), leading_states=model.nv, functions=(MjcfMemory.of(mjcf_dynamics),),
        )  # fmt: skip

        def describe(row: int) -> str:
            return f"a clearance of {self.margin:g} m between {described[row]}"

        return ConstraintTerm.of_residual(distances, np.array([[self.margin]]), [0] * len(described), describe)

    def distances(self, dynamics: MjcfDynamics, states: npt.ArrayLike) -> Array:
        """The distance (..., L) in m of the links of each pair in `links`, at states (..., n); at most 1 m."""
        data = mjcf_obstacles.distance_data(self._mjcf.model, self._pairs, self._rows, len(self.links), 1.0)
        return _distances(dynamics, states, np.concatenate([[float(dynamics.physics.address())], data]))[0]

    def check(self, field: str, dynamics: MjcfDynamics, state: Array) -> None:
        """Raises InputError if links are nearer to each other than the margin at a state (n,), named `field`."""
        distances = self.distances(dynamics, state)
        if distances.min(initial=np.inf) < self.margin:
            first, second = self.links[int(distances.argmin())]
            raise InputError(
                f"{field}: got a state with {first!r} and {second!r} at {distances.min():.3g} m from each other, want"
                f" {self.margin:g} m; or, if they may touch, <contact><exclude"
                f' body1="{first}" body2="{second}"/></contact> in the MJCF'
            )


def _distances(
    dynamics: Dynamics, states: npt.ArrayLike, data: Array, displaced: Array | None = None
) -> tuple[Array, Array]:
    """Distances (..., rows) at states (..., n) by the kernel's data, and the pair of each row at the last state.

    Obstacles are displaced by (D, rows, 3) in m, by the first of these for the first of D equal parts of the states.
    """
    states = vectors_of("states", states, len(dynamics.state_coordinates))
    flat, rows = in_c_order(states.reshape(-1, states.shape[-1])), int(data[1])
    displaced = np.zeros((1, rows, 3)) if displaced is None else displaced
    distances, pairs, each = np.empty(len(flat) * rows), np.empty(rows), max(1, len(flat) // max(1, len(displaced)))
    _module(flat.shape[1]).distances_of(
        len(flat), flat, each, in_c_order(displaced.reshape(-1)), data, distances, pairs, np.empty((rows, 6))
    )
    return distances.reshape(*states.shape[:-1], rows), pairs


def _module(states: int) -> Any:
    return module_of(source_of(kernel), f"MuJoCo's distances ({states} states)", N=states)


class MjcfBalls(CollisionSpheres):
    """Balls that are fixed to bodies of an MJCF and cover its colliding geoms, as `outline` of `MjcfRobot` says.

    The last ball is in the centre of a geom. Geoms that are only drawn count if nothing collides.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        points, radii, names, sites = list[Array](), list[float](), list[str](), list[str | None]()
        for geom in mjcf_obstacles.solid_geoms(model).tolist():
            middle, name, radius = model.geom_pos[geom], model.geom(geom).name, float(model.geom_rbound[geom])
            centres = [middle]
            if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_CAPSULE):
                radius, half = (float(number) for number in model.geom_size[geom, :2])
                axis = np.zeros(3)
                mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, half]), model.geom_quat[geom])
                capsule = Capsule(2 * half, radius, TOLERANCE * radius)
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
        if not isinstance(mjcf_dynamics := dynamics.calling, MjcfDynamics):
            raise InputError(f"balls: got an MJCF's balls for {dynamics.name}, want its own dynamics, robot.dynamics")
        memory = MjcfMemory.of(mjcf_dynamics)
        positions = tuple(range(mjcf_dynamics.physics.model.nv))
        data = np.concatenate([[len(self)], self._points.ravel()])
        source = source_of(differences, BALLS=len(self), ACTIVE=positions).filled(places=source_of(kernel))
        return SphereCenters(source, data, positions, functions=(memory,))
