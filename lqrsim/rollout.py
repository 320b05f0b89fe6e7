"""What comes out of running a policy: a `Rollout`. NumPy only; `files.py` writes it to disk and reads it back."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lqrsim.coordinates import Coordinates
from lqrsim.errors import (
    Array,
    InputError,
    check_items,
    check_kind,
    check_number,
    check_seed,
    check_shape,
    check_text,
    excerpt,
    numbers_of,
    shaped,
)
from lqrsim.results import Trajectory


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """Closed-loop runs of one policy in MuJoCo, with everything that a picture of them needs.

    K trials of T control periods; n states, m controls. Row k is trial `first_trial + k` of `seed`, to the last bit
    on equal processors.

    Attributes:
      robot, scene: their names. model: the MJCF that was run, as text.
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
      versions: of lqrsim and the libraries that the bits depend on, and the processor.
    """

    robot: str
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

    def __post_init__(self) -> None:
        check_kind("Rollout: plan", self.plan, Trajectory, "a Trajectory")
        for name in ("state_coordinates", "control_coordinates"):
            check_kind(f"Rollout: {name}", getattr(self, name), Coordinates, "Coordinates")
        for name in ("robot", "scene", "policy_digest"):
            check_text(f"Rollout: {name}", getattr(self, name), "a name", empty=True)
        check_kind("Rollout: model", self.model, str, "the MJCF as text")
        said = check_items("Rollout: disturbances", self.disturbances, str, "a description of each, as text")
        object.__setattr__(self, "disturbances", said)
        for name, above in (("radius", None), ("goal_radius", 0.0)):
            least = 0.0 if above is None else None
            number = check_number(f"Rollout: {name}", getattr(self, name), above=above, at_least=least)
            object.__setattr__(self, name, number)
        for name in ("seed", "first_trial"):
            object.__setattr__(self, name, check_seed(f"Rollout: {name}", getattr(self, name)))
        given = check_kind("Rollout: versions", self.versions, Mapping, "a dictionary of name: version")
        if not all(isinstance(one, str) for item in given.items() for one in item):
            raise InputError(f"Rollout: versions: got {excerpt(given)}, want a dictionary of name: version")
        self._check_shapes()

    def _check_shapes(self) -> None:
        """Raises InputError for arrays that do not fit together."""
        n, m, steps = len(self.state_coordinates), len(self.control_coordinates), self.plan.steps
        check_shape("Rollout: plan.states", self.plan.states, (steps + 1, n))
        check_shape("Rollout: plan.controls", self.plan.controls, (steps, m))
        states = shaped("Rollout: states", self.states, (None, steps + 1, n))
        trials, times = len(states), shaped("Rollout: frame_times", self.frame_times, (None,))
        if not trials:
            raise InputError("Rollout: states: got no trial, want at least one")
        shapes: dict[str, tuple[int | None, ...]] = {
            "states": states.shape, "measured": states.shape, "commanded": (trials, steps, m),
            "applied": (trials, steps, m), "forces": (trials, steps, 3), "torques": (trials, steps, 3),
            "displaced": (trials, None, 3), "clearance": (trials, steps + 1), "frame_times": (None,),
            "frames": (trials, len(times), None),
        }  # fmt: skip
        for name, shape in shapes.items():
            object.__setattr__(self, name, shaped(f"Rollout: {name}", getattr(self, name), shape))
        for name, kind in (("contacts", np.int64), ("diverged", np.bool_)):
            numbers = numbers_of(f"Rollout: {name}", getattr(self, name))
            check_shape(f"Rollout: {name}", numbers, (trials,))
            # A period of contact is counted, and a trial has diverged or not.
            most = steps if name == "contacts" else 1
            if not ((numbers >= 0) & (numbers <= most) & (numbers == np.floor(numbers))).all():
                raise InputError(
                    f"Rollout: {name}: got {excerpt(numbers.tolist())}, want whole numbers from 0 to {most}"
                )
            object.__setattr__(self, name, numbers.astype(kind))

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
                whole = self.times[np.isfinite(self.states[k]).all(axis=1)]
                when = f"after {whole[-1]:.2f} s" if len(whole) else "at once"
                lines.append(f"  trial {self.first_trial + k}: diverged {when}")
                continue
            rms, worst = float(np.sqrt(np.mean(error[k] ** 2))), float(error[k].max())
            lines.append(
                f"  trial {self.first_trial + k}: {outcome}, tracking error rms {rms:.3g} m, max {worst:.3g} m,"
                f" final {error[k, -1]:.3g} m; clearance {self.clearance[k].min():.3f} m;"
                f" {self.contacts[k]} periods in contact; {100 * self.saturated[k].mean():.0f} % saturated"
            )
        return "\n".join(lines)

    __str__ = summary
