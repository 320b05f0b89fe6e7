"""What comes out of running a policy: a `Rollout`. NumPy only; `files.py` writes it to disk and reads it back."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lqrsim.coordinates import Coordinates
from lqrsim.errors import Array
from lqrsim.results import Trajectory


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """Closed-loop runs of one policy in MuJoCo, with everything that a picture of them needs.

    K trials of T control periods; n states, m controls. Row k is trial `first_trial + k` of `seed`, to the last bit.

    Attributes:
      robot, scene: their names. body: the robot's in the MJCF. model: the MJCF that was run, as text.
      plan: what the policy meant to do. policy_digest: hash of the policy.
      goal_radius: distance in metres from the plan's end within which a trial has reached its goal.
      radius: of the robot's collision circle or sphere, in metres.
      states: (K, T+1, n) true states; angles in the representative nearest the plan.
      measured: (K, T+1, n) the states that the policy was shown.
      commanded: (K, T, m) what the policy asked for, within the limits. applied: (K, T, m) what the actuators got.
      forces: (K, T, 3) disturbing force at the robot's centre of mass in N, world axes. torques: the same in N m.
      displaced: (K, obstacles, 3) by how much each obstacle is away from where the plan believes it, in metres.
      clearance: (K, T+1) signed distance to the nearest obstacle minus the radius in metres; infinite without any.
      contacts: (K,) control periods in which MuJoCo reported a contact of the robot with an obstacle.
      diverged: (K,) whether the simulation became unstable; the states are NaN from there on.
      frame_times: (F,) seconds; frames: (K, F, nq) MuJoCo's qpos then, for drawing.
      disturbances: one description each. seed, first_trial: what the draws came from.
      versions: of lqrsim and the libraries that the numbers depend on.
    """

    robot: str
    body: str
    scene: str
    model: str
    plan: Trajectory
    policy_digest: str
    state_coordinates: Coordinates
    control_coordinates: Coordinates
    radius: float
    goal_radius: float
    states: Array
    measured: Array
    commanded: Array
    applied: Array
    forces: Array
    torques: Array
    displaced: Array
    clearance: Array
    contacts: npt.NDArray[np.int64]
    diverged: npt.NDArray[np.bool_]
    frame_times: Array
    frames: Array
    disturbances: tuple[str, ...]
    seed: int
    first_trial: int = 0
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def trials(self) -> int:
        """K, the number of runs."""
        return len(self.states)

    @property
    def times(self) -> Array:
        """Times of the states in seconds, (T+1,)."""
        return self.plan.times

    @property
    def tracking_error(self) -> Array:
        """Distance from the plan's position in metres, (K, T+1)."""
        position = list(self.state_coordinates.position)
        return np.linalg.norm(self.states[..., position] - self.plan.states[:, position], axis=-1)

    @property
    def saturated(self) -> npt.NDArray[np.bool_]:
        """Whether a command stood at a limit, (K, T)."""
        low, high = np.array(self.control_coordinates.low), np.array(self.control_coordinates.high)
        return np.any((self.commanded <= low) | (self.commanded >= high), axis=-1)

    @property
    def collided(self) -> npt.NDArray[np.bool_]:
        """Whether the clearance was ever negative, (K,)."""
        return np.any(self.clearance < 0, axis=1)

    @property
    def reached(self) -> npt.NDArray[np.bool_]:
        """Whether a trial ended within `goal_radius` of the plan's end, neither collided nor diverged, (K,)."""
        near = self.tracking_error[:, -1] <= self.goal_radius
        return near & ~self.collided & ~self.diverged

    @property
    def outcome(self) -> tuple[str, ...]:
        """`diverged`, `collided`, `reached` or `timed out` for each trial."""
        flags = zip(self.diverged, self.collided, self.reached, strict=True)
        return tuple(
            "diverged" if diverged else "collided" if collided else "reached" if reached else "timed out"
            for diverged, collided, reached in flags
        )

    def summary(self) -> str:
        """One line a trial: outcome, tracking error, clearance, saturation."""
        what = "; ".join(self.disturbances) or "undisturbed"
        lines = [f"{self.robot} in {self.scene}, {what}, seed {self.seed}"]
        error = self.tracking_error
        for k, outcome in enumerate(self.outcome):
            if self.diverged[k]:
                last = self.times[np.isfinite(self.states[k]).all(axis=1)][-1]
                lines.append(f"  trial {self.first_trial + k}: diverged after {last:.2f} s")
                continue
            rms, worst = float(np.sqrt(np.mean(error[k] ** 2))), float(error[k].max())
            lines.append(
                f"  trial {self.first_trial + k}: {outcome}, tracking error rms {rms:.3g} m, max {worst:.3g} m,"
                f" final {error[k, -1]:.3g} m; clearance {self.clearance[k].min():.3f} m;"
                f" {self.contacts[k]} periods in contact; {100 * self.saturated[k].mean():.0f} % saturated"
            )
        return "\n".join(lines)

    __str__ = summary
