"""What of a robot from an MJCF collides: its geoms, by MuJoCo's own distances, with each other; or balls along them."""

from typing import Any, Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Finite, checked
from lqrsim.codegen.compiled_module import in_c_order, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError, vectors_of
from lqrsim.kernels import differences, mjcf_distances
from lqrsim.problem.collision_shape import CollisionGeoms, GeomDistances
from lqrsim.problem.collision_spheres import CollisionSpheres, SphereCenters
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.residual import Residual
from lqrsim.robots.mjcf_dynamics import MjcfDynamics, MjcfMemory
from lqrsim.scenes import mjcf_obstacles
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.mjcf_obstacles import Outline
from lqrsim.scenes.scene import Scene
from lqrsim.scenes.world import Obstacle, World

MOST_ROWS = 128  # largest number of distances per step; beyond it, one per body: to the nearest obstacle
# Distance beyond the margin from which on links have slopes, relative to the largest geom's bounding sphere. Links that
# are two joints apart are always within twice its radius, the reach of a Clearance; all these slopes take time.
SEEN = 0.25
_UNBOUNDED = 1e6  # m, a distance beyond all obstacles


class MjcfGeoms(CollisionGeoms):
    """All moving geoms that collide in an MJCF; `MjcfRobot` makes it. Meshes collide by their convex hulls."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        model, pairs = scene.model, mjcf_obstacles.pairs_of(scene.model, list(scene.geoms))
        self._pairs, self._levers = pairs, mjcf_obstacles.levers(model)
        number = {geom: i for i, geom in enumerate(scene.geoms)}
        self._number = np.array([number[geom] for geom in pairs[:, 1].tolist()], dtype=np.int64)
        self._bodies = model.geom_bodyid[pairs[:, 0]].astype(np.int64)

    @property
    def size(self) -> float:
        """The radius of the largest geom's bounding sphere, in metres."""
        geoms = mjcf_obstacles.solid_geoms(self.scene.model)
        return float(self.scene.model.geom_rbound[geoms].max(initial=0.0))

    def bind(self, dynamics: Dynamics, world: World, reach: float) -> GeomDistances:
        mjcf_dynamics, numbers = self._bound(dynamics, world)
        if world.moving:
            raise InputError("geoms: got obstacles that move, want balls=robot.balls for them")
        chosen = np.flatnonzero(np.isin(self._number, numbers))
        place = {int(number): i for i, number in enumerate(numbers)}
        keys = [(int(self._bodies[k]), place[int(self._number[k])]) for k in chosen]
        if len(set(keys)) > MOST_ROWS:
            keys = [(body, -1) for body, _ in keys]
        rows = sorted(set(keys))
        index = {key: row for row, key in enumerate(rows)}
        count, numbered = max(1, len(rows)), np.array([index[key] for key in keys], dtype=np.int64)
        return GeomDistances(
            source=source_of(mjcf_distances, ROWS=count),
            data=mjcf_obstacles.distance_data(self.scene.model, self._pairs[chosen], numbered, count, reach),
            parts=tuple(self.scene.model.body(body).name for body, _ in rows),
            obstacles=tuple(number for _, number in rows), leading_states=self.scene.model.nv,
            functions=(MjcfMemory.of(mjcf_dynamics),),
        )  # fmt: skip

    def clearances(
        self, dynamics: Dynamics, world: World, states: npt.ArrayLike, displaced: Array | None = None
    ) -> Array:
        mjcf_dynamics, numbers = self._bound(dynamics, world)
        states = vectors_of("states", states, len(dynamics.state_coordinates))
        _, data = self._to_each(mjcf_dynamics, numbers)
        distances, _ = _distances(states.reshape(-1, states.shape[-1]), data, displaced)
        return distances.reshape(*states.shape[:-1], len(numbers))

    def slopes(self, dynamics: Dynamics, world: World, states: npt.ArrayLike) -> tuple[Array, Array]:
        mjcf_dynamics, numbers = self._bound(dynamics, world)
        flat, count = in_c_order(vectors_of("states", states, len(dynamics.state_coordinates))), len(numbers)
        distances, slopes = np.empty(len(flat) * count), np.zeros((len(flat) * count, flat.shape[1]))
        _, data = self._to_each(mjcf_dynamics, numbers)
        _module(flat.shape[1]).slopes_of(
            len(flat), flat, data, distances, slopes, np.empty(count), np.empty((count, 6))
        )
        return distances.reshape(-1, count), slopes.reshape(-1, count, flat.shape[1])

    def nearest_bodies(self, dynamics: Dynamics, world: World, state: npt.ArrayLike) -> tuple[str, str]:
        mjcf_dynamics, numbers = self._bound(dynamics, world)
        chosen, data = self._to_each(mjcf_dynamics, numbers)
        distances, pairs = _distances(np.asarray(state, dtype=np.float64)[None], data)
        pair = self._pairs[chosen[int(pairs[int(distances.argmin())])]]
        first, second = (self.scene.model.body(body).name for body in self.scene.model.geom_bodyid[pair].tolist())
        return first, second

    def of_scene(self, scene: Scene) -> bool:
        return scene is self.scene or (scene.xml == self.scene.xml and scene.geoms == self.scene.geoms)

    def travel(self, before: Array, after: Array) -> Array:
        nv = len(self._levers)
        return np.abs(after[..., :nv] - before[..., :nv]) @ self._levers

    def _bound(self, dynamics: Dynamics, world: World) -> tuple[MjcfDynamics, npt.NDArray[np.int64]]:
        """MuJoCo's dynamics, and the index in the scene of each obstacle of the world. Raises InputError."""
        if not isinstance(mjcf_dynamics := dynamics.calling, MjcfDynamics):
            raise InputError(f"geoms: got an MJCF's geoms for {dynamics.name}, want its own dynamics, robot.dynamics")
        if world is self.scene.world:
            return mjcf_dynamics, np.arange(len(world))
        known = {obstacle.name: (number, obstacle) for number, obstacle in enumerate(self.scene.world.obstacles)}
        numbers = []
        for obstacle in world.obstacles:
            number, stated = known.get(obstacle.name, (-1, None))
            if not _same(obstacle, stated):
                raise InputError(
                    f"geoms: got the obstacle {obstacle.name!r}, which is not one of the robot's MJCF, want those of"
                    f" robot.scene.world: {', '.join(known) or 'there are none'}; or balls=robot.balls"
                )
            numbers.append(number)
        return mjcf_dynamics, np.array(numbers, dtype=np.int64)

    def _to_each(self, dynamics: MjcfDynamics, numbers: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.intp], Array]:
        """The indices of the pairs, and the kernel's data with the address of p, for all distances to each obstacle."""
        place = np.full(len(self.scene.world), -1, dtype=np.int64)
        place[numbers] = np.arange(len(numbers))
        rows = np.asarray(place[self._number], dtype=np.int64)
        chosen = np.flatnonzero(rows >= 0)
        pairs = self._pairs[chosen]
        data = mjcf_obstacles.distance_data(self.scene.model, pairs, rows[chosen], len(numbers), _UNBOUNDED)
        return chosen, np.concatenate([[float(dynamics.physics.address())], data])


class SelfClearance(Constraint):
    """`distance(link, other link) >= margin` at the steps, by MuJoCo's distances; `MjcfRobot.self_clearance` makes it.

    The links are those that MuJoCo lets collide: neither fixed to each other nor parent and child, not in an
    `<exclude>` of the MJCF, and of geoms whose `contype` and `conaffinity` fit; and the geoms of each `<pair>`. Links
    that touch in every position of the joints are left out.

    Attributes:
      margin: the margin in metres. links: the pairs of links that are kept apart, by the names of their bodies.
    """

    @checked
    def __init__(self, mjcf: MjcfModel, body: str, margin: Finite = 0.0) -> None:
        model = mjcf.model
        self.margin = margin
        self._mjcf, self._pairs = mjcf, mjcf_obstacles.link_pairs(model, model.body(body).id)
        geom_bodies = model.geom_bodyid[self._pairs]
        bodies = np.sort(
            np.where(model.body_weldid[geom_bodies] != 0, model.body_weldid[geom_bodies], geom_bodies), axis=1
        )
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
            source_of(mjcf_distances, ROWS=count), mjcf_obstacles.distance_data(model, self._pairs, rows, count, reach),
            parts=tuple(described), leading_states=model.nv, functions=(MjcfMemory.of(mjcf_dynamics),),
        )  # fmt: skip

        def describe(row: int) -> str:
            return f"a clearance of {self.margin:g} m between {described[row]}"

        return ConstraintTerm.of_residual(distances, np.array([[self.margin]]), [0] * len(described), describe)

    def distances(self, dynamics: MjcfDynamics, states: npt.ArrayLike) -> Array:
        """The distance (..., L) in m of the links of each pair in `links`, at states (..., n); at most 1 m."""
        states = vectors_of("states", states, len(dynamics.state_coordinates))
        data = mjcf_obstacles.distance_data(self._mjcf.model, self._pairs, self._rows, len(self.links), 1.0)
        data = np.concatenate([[float(dynamics.physics.address())], data])
        distances, _ = _distances(states.reshape(-1, states.shape[-1]), data)
        return distances.reshape(*states.shape[:-1], len(self.links))

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


def _distances(states: Array, data: Array, displaced: Array | None = None) -> tuple[Array, Array]:
    """Distances (K rows,) at states (K, n) by the kernel's data, and the pair of each row at the last state.

    Args:
      displaced: (D, rows, 3), displacements in m of the obstacles, the first for the first K / D states.
    """
    flat, rows = in_c_order(states), int(data[1])
    displaced = np.zeros((1, rows, 3)) if displaced is None else displaced
    distances, pairs, each = np.empty(len(flat) * rows), np.empty(rows), max(1, len(flat) // max(1, len(displaced)))
    _module(flat.shape[1]).distances_of(
        len(flat), flat, each, in_c_order(displaced.reshape(-1)), data, distances, pairs, np.empty((rows, 6))
    )
    return distances, pairs


def _module(states: int) -> Any:
    return module_of(source_of(mjcf_distances), f"MuJoCo's distances ({states} states)", N=states)


class MjcfBalls(CollisionSpheres):
    """Balls that are fixed to bodies of an MJCF; `MjcfRobot` makes them."""

    def __init__(self, outline: Outline) -> None:
        self.outline, self.level = outline, "compiled"
        self._set_balls(outline.radii, outline.names, outline.sites)

    @property
    def name(self) -> str:
        return "MuJoCo's kinematics"

    def bind(self, dynamics: Dynamics) -> SphereCenters:
        if not isinstance(mjcf_dynamics := dynamics.calling, MjcfDynamics):
            raise InputError(f"balls: got an MJCF's balls for {dynamics.name}, want its own dynamics, robot.dynamics")
        memory = MjcfMemory.of(mjcf_dynamics)
        positions = tuple(range(mjcf_dynamics.physics.model.nv))
        data = np.concatenate([[len(self)], np.c_[self.outline.bodies, self.outline.offsets].ravel()])
        source = source_of(differences, BALLS=len(self), AXES=positions).filled(places=source_of(mjcf_distances))
        return SphereCenters(source, data, positions, functions=(memory,))


def _same(one: Obstacle, other: Obstacle | None) -> bool:
    if other is None or one.kind != other.kind:
        return False
    pairs = ((one.position, other.position), (one.rotation, other.rotation), (one.size, other.size))
    return all(np.array_equal(mine, its) for mine, its in pairs)
