"""Costs and constraints on sites of an MJCF, such as a gripper at a desired position and orientation."""

import numpy as np
import numpy.typing as npt

from lqrsim.codegen.sources import Source, source_of
from lqrsim.errors import Array, InputError, brief, check_array, check_name, check_text, check_weights
from lqrsim.kernels import distance_constraint, mjcf_sites, residual_cost
from lqrsim.problem.constraints import STEPS, Constraint, ConstraintTerm
from lqrsim.problem.costs import Cost, CostTerm
from lqrsim.problem.dynamics import Dynamics
from lqrsim.robots.mjcf_dynamics import MjcfDynamics, MjcfMemory
from lqrsim.scenes.mjcf_joints import axes_of, site_frame

_AXES = "xyz"


class _Pose:
    """The desired position and orientation of a site, checked.

    Args:
      what: its name in messages. site: name of the site. position: (3,) or None. orientation: (4,) or None.
    """

    def __init__(self, what: str, site: str, position: npt.ArrayLike | None, orientation: npt.ArrayLike | None) -> None:
        self.what, self.site = what, check_text(f"{what}: site", site, "the name of a site", at_most=1000)
        if position is None and orientation is None:
            raise InputError(f"{what}: got neither position nor orientation, want at least one")
        self.position = None if position is None else check_array(f"{what}: position", position, (3,))
        self.axes: Array | None = None
        self.orientation: Array | None = None
        if orientation is not None:
            quaternion = check_array(f"{what}: orientation", orientation, (4,))
            if not np.linalg.norm(quaternion) > 1e-9:
                raise InputError(f"{what}: orientation: got {quaternion.tolist()}, want a nonzero (w, x, y, z)")
            self.orientation = quaternion
            self.axes = axes_of(quaternion / np.linalg.norm(quaternion))

    def __repr__(self) -> str:
        placed = f" at {brief(self.position)}" if self.position is not None else ""
        turned = f" turned to {brief(self.orientation)}" if self.orientation is not None else ""
        return f"{self.site!r}{placed}{turned}"

    @property
    def rows(self) -> list[str]:
        """The name of each row in messages."""
        placed = [f"{self.site} at its {axis}" for axis in _AXES] if self.position is not None else []
        return placed + ([f"{self.site} turned about {axis}" for axis in _AXES] if self.axes is not None else [])

    def bind(self, dynamics: Dynamics) -> tuple[Source, Array, MjcfMemory, int]:
        """The source of the errors, their data, MuJoCo's memory, and the number of states. Raises InputError."""
        if not isinstance(dynamics, MjcfDynamics):
            raise InputError(f"{self.what}: got {dynamics.name}, want the dynamics of an MjcfRobot")
        model = dynamics.physics.model
        names = [model.site(number).name for number in range(model.nsite)]
        number = names.index(check_name(f"{self.what}: site", self.site, [name for name in names if name]))
        body, offset, axes = site_frame(model, number)
        position, wanted = np.zeros(3), np.eye(3)
        position = position if self.position is None else self.position
        wanted = wanted if self.axes is None else self.axes
        source = source_of(mjcf_sites, PLACED=int(self.position is not None), TURNED=int(self.axes is not None))
        data = np.concatenate([[body], offset, axes.ravel(), position, wanted.ravel()])
        return source, data, MjcfMemory.of(dynamics), model.nv


class SiteCost(Cost):
    """`1/2 weight |place - position|^2 + 1/2 turn_weight |angle|^2` of a site of a robot from an MJCF.

        ls.SiteCost("gripper", position=(0.4, 0.2, 0.3), orientation=(0, 1, 0, 0), weight=1e4, turn_weight=1e3)

    As a stage cost it acts at each step; as a final cost, at the end.

    Args:
      site: name of the site in the MJCF.
      position: (3,) the desired position in the world, in metres; None for any.
      orientation: (4,) the desired orientation in the world, as a quaternion (w, x, y, z); None for any. The angle is
        that of the rotation from the desired orientation, less than half a turn.
      weight: weight of the position error: one number, or one per world axis, (3,).
      turn_weight: weight of the orientation error: one number, or one per axis of the desired orientation, (3,).
    """

    def __init__(
        self,
        site: str,
        *,
        position: npt.ArrayLike | None = None,
        orientation: npt.ArrayLike | None = None,
        weight: npt.ArrayLike = 1.0,
        turn_weight: npt.ArrayLike = 1.0,
    ) -> None:
        self.pose = _Pose("SiteCost", site, position, orientation)
        self.weights = tuple(
            check_weights(f"SiteCost: {name}", given, 3)
            for name, given in (("weight", weight), ("turn_weight", turn_weight))
        )

    def bind(self, dynamics: Dynamics) -> CostTerm:
        errors, data, memory, moved = self.pose.bind(dynamics)
        placed, turned = self.weights
        used = [placed] if self.pose.position is not None else []
        weights = np.concatenate([*used, *([turned] if self.pose.axes is not None else [])])
        kernel = source_of(residual_cost, AT=1 + len(data), ROWS=len(weights), MOVED=moved)
        return CostTerm(
            kernel.filled(places=(errors, "errors"), places_jacobian=(errors, "errors_jacobian")),
            np.concatenate([data, weights]),
            functions=(memory,),
            exact_hessian=False,
        )


class SiteConstraint(Constraint):
    """A site of a robot from an MJCF has exactly a desired position, or a desired orientation, or both.

        ls.SiteConstraint("gripper", position=(0.4, 0.2, 0.3), orientation=(0, 1, 0, 0))

    Args:
      site: name of the site in the MJCF.
      position: (3,) as in a SiteCost.
      orientation: (4,) as in a SiteCost.
      at: "final", or "all" steps except a start that is given exactly.
    """

    def __init__(
        self,
        site: str,
        *,
        position: npt.ArrayLike | None = None,
        orientation: npt.ArrayLike | None = None,
        at: str = "final",
    ) -> None:
        self.pose = _Pose("SiteConstraint", site, position, orientation)
        self.at = check_name("SiteConstraint: at", at, STEPS)

    def bind(self, dynamics: Dynamics) -> ConstraintTerm:
        errors, data, memory, _ = self.pose.bind(dynamics)
        rows = self.pose.rows
        kernel = source_of(distance_constraint, AT=1 + len(data), ROWS=len(rows))
        return ConstraintTerm(
            kernel.filled(places=(errors, "errors"), places_jacobian=(errors, "errors_jacobian")),
            np.concatenate([data, [1, 1], np.zeros(len(rows)), [0.0]]),
            len(rows),
            rows.__getitem__,
            equality=True,
            final_only=self.at == "final",
            shared=len(rows),
            functions=(memory,),
        )
