"""The constraint that links of a robot from an MJCF keep clear of each other."""

from typing import Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Finite, checked
from lqrsim.codegen.compiled_module import in_c_order, module_of
from lqrsim.codegen.sources import source_of
from lqrsim.errors import Array, InputError, vectors_of
from lqrsim.kernels import mjcf_distances
from lqrsim.problem.constraints import Constraint, ConstraintTerm
from lqrsim.problem.dynamics import Dynamics
from lqrsim.problem.residual import Residual
from lqrsim.robots.mjcf_dynamics import MjcfDynamics, MjcfMemory
from lqrsim.robots.mjcf_shapes import MOST_ROWS
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.mjcf_obstacles import distance_data, link_pairs

# Distance beyond the margin from which on links have slopes, relative to the largest geom's bounding sphere. Links that
# are two joints apart are always within twice its radius, the reach of a Clearance; all these slopes take time.
SEEN = 0.25


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
        self._mjcf, self._pairs = mjcf, link_pairs(model, model.body(body).id)
        own = model.geom_bodyid[self._pairs]
        bodies = np.sort(np.where(model.body_weldid[own] != 0, model.body_weldid[own], own), axis=1)
        keys, rows = np.unique(bodies, axis=0, return_inverse=True)
        self._rows = np.asarray(rows, dtype=np.int64).ravel()
        self.links = tuple((model.body(one).name, model.body(other).name) for one, other in keys.tolist())

    def with_added_state(self, dynamics: Dynamics) -> Self:
        return self

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        if not isinstance(own := dynamics.calling, MjcfDynamics):
            raise InputError(f"SelfClearance: got dynamics {dynamics.name}, want the robot's own, robot.dynamics")
        model = self._mjcf.model
        reach = self.margin + SEEN * float(model.geom_rbound[self._pairs].max(initial=0.0))
        told = [f"{one!r} and {other!r}" for one, other in self.links]
        rows, merged = self._rows, np.arange(len(told))
        if len(told) > MOST_ROWS:  # then one for each link, to those after it
            firsts = list(dict.fromkeys(one for one, _ in self.links))
            merged = np.array([firsts.index(one) for one, _ in self.links])
            told, rows = [f"{one!r} and other links" for one in firsts], merged[rows]
        count = max(1, len(told))
        distances = Residual(
            source_of(mjcf_distances, ROWS=count), distance_data(model, self._pairs, rows, count, reach),
            parts=tuple(told), moved=model.nv, functions=(MjcfMemory.of(own),),
        )  # fmt: skip

        def describe(row: int) -> str:
            return f"a clearance of {self.margin:g} m between {told[row]}"

        return ConstraintTerm.of_residual(distances, np.array([[self.margin]]), [0] * len(told), describe)

    def distances(self, dynamics: MjcfDynamics, states: npt.ArrayLike) -> Array:
        """The distance (..., L) in m of the links of each pair in `links`, at states (..., n); at most 1 m."""
        states = vectors_of("states", states, len(dynamics.state_coordinates))
        flat, count = in_c_order(states.reshape(-1, states.shape[-1])), len(self.links)
        out, which, segments = np.empty(len(flat) * count + 1), np.empty(count + 1), np.empty((count + 1, 6))
        data = distance_data(self._mjcf.model, self._pairs, self._rows, count, 1.0)
        data = np.concatenate([[float(dynamics.physics.address())], data])
        module = module_of(source_of(mjcf_distances), "MuJoCo's distances", N=flat.shape[1])
        module.distances_of(len(flat), flat, max(1, len(flat)), np.zeros(1), 0, data, out, which, segments)
        return out[:-1].reshape(*states.shape[:-1], count)

    def check(self, field: str, dynamics: MjcfDynamics, state: Array) -> None:
        """Raises InputError if links are nearer to each other than the margin at a state (n,), named `field`."""
        found = self.distances(dynamics, state)
        if found.min(initial=np.inf) < self.margin:
            one, other = self.links[int(found.argmin())]
            raise InputError(
                f"{field}: got a state with {one!r} and {other!r} at {found.min():.3g} m from each other, want"
                f" {self.margin:g} m; or, if they may touch, <contact><exclude"
                f' body1="{one}" body2="{other}"/></contact> in the MJCF'
            )
