"""What comes out of running a policy: a `Rollout`. NumPy only; `save_load.py` writes it to disk and reads it back."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_count, excerpt, vectors_of
from lqrsim.results import notebook
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.fields import Bounds, Line, check_fields
from lqrsim.results.goal import Target, endings, tracking_error, tracking_unit
from lqrsim.results.solution_parts import Trajectory


@dataclass(frozen=True, kw_only=True)
class BallRecord:
    """Where the balls of a robot were in its runs, and where they should have been: what pictures of it need.

    K trials of T control periods, B balls; the last ball stands for a robot without a position.

    Attributes:
      driven: (K, T+1, B, 3) centres in the world, in metres; NaN where the states are.
      planned: (T+1, B, 3) the same of the plan.
      radii: (B,) in metres.
      anchors: (B, 4) number of the MJCF's body that a ball is fixed to, and its place in the body's axes in metres; NaN
        for a ball that names no site.
    """

    driven: Annotated[Array, "K T+1 B 3"]
    planned: Annotated[Array, "T+1 B 3", Bounds()]
    radii: Annotated[Array, "B", Bounds(at_least=0.0)]
    anchors: Annotated[Array, "B 4"]

    def __post_init__(self) -> None:
        if not check_fields(self)["B"]:
            raise InputError("BallRecord: radii: got none, want at least one ball")

    @property
    def tracked(self) -> tuple[int, Array]:
        """The body that the last ball is fixed to, and its place on it, (3,).

        Raises:
          InputError: the last ball names no site.
        """
        body, *place = self.anchors[-1].tolist()
        if not np.isfinite(body):
            raise InputError("balls: got no site for the last of them, want one among the sites= of CollisionSpheres")
        return int(body), np.array(place)


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """Closed-loop runs of one policy in MuJoCo, with everything that a picture of them needs.

    K trials of T control periods; n states, m controls. Row k is trial `first_trial + k` of `seed`, to the last bit
    on equal processors.

    Attributes:
      robot: its name.
      body: the robot's in the MJCF.
      scene: its name.
      model: the MJCF that was run, as text.
      plan: what the policy meant to do.
      policy_digest: hash of the policy.
      state_coordinates: names and units of the states, and which of them wrap.
      control_coordinates: names and units of the controls, and their limits.
      goal: (n,) the state that the plan was to reach, NaN in states that do not count; None where it is the plan's end.
      goal_radius: distance from the goal within which a trial has reached it, in `target.unit`: metres, or of the
        scaled error where the goal has no position.
      radius: of the robot's collision circle or sphere, in metres.
      states: (K, T+1, n) true states; angles in the representative nearest the plan.
      measured: (K, T+1, n) the states that the policy was shown.
      commanded: (K, T, m) what the policy asked for.
      applied: (K, T, m) what the actuators got, within the robot's limits.
      forces: (K, T, 3) disturbing force at the robot's centre of mass in N, world axes.
      torques: the same in N m.
      displaced: (K, obstacles, 3) by how much each obstacle is away from where the plan believes it, in metres.
      clearance: (K, T+1) signed distance to the nearest obstacle minus the radius in metres; infinite without any.
      contacts: (K,) control periods from the collision on in which MuJoCo reported a contact of the robot with an
        obstacle; 0 where the robot goes through them.
      collided_at: (K,) seconds to the first collision, at a knot or between two; infinite where there was none.
      obstacles: (K) names of what they collided with; empty where there was none.
      diverged_at: (K,) seconds to the knot from which on the simulation was unstable, or what the policy was shown was
        not finite, or its filter had diverged; infinite where nothing was. The states are NaN from there on.
      failed_at: (K,) seconds to the knot at which the controller failed; infinite where it did not. From there on, too.
      reasons: (K) why it failed, or what of its filter diverged; empty where neither was so.
      frame_times: (F,) seconds.
      frames: (K, F, nq) MuJoCo's qpos then, for drawing.
      disturbances: one description each.
      seed: from which the random numbers were drawn.
      first_trial: number of the first trial, from which its random numbers were drawn.
      versions: of lqrsim and the libraries that the bits depend on, and the processor.
      tube: (T+1, p, p) covariance of the position about the plan that was predicted for the controller and the
        disturbances, in m^2; p is 2 or 3, as the position has it. None where nobody predicted it; see `predict_tube`.
      collision_chance: (T+1,) the predicted chance of being in collision at each knot, or None.
      balls: where the robot's balls were, if it has any and was recorded for drawing; or None.
      controller_run: the run of the controller (`ControllerRun`), with what it recorded: the estimates of an
        `OffsetFree`, the log of a `Replanner`. In memory only: None in a rollout that was loaded, pickled or copied.
    """

    robot: Line
    body: Line
    scene: Line
    model: str
    plan: Trajectory
    policy_digest: Line
    state_coordinates: Annotated[Coordinates, "n"]
    control_coordinates: Annotated[Coordinates, "m"]
    goal: Annotated[Array, "n"] | None
    goal_radius: Annotated[float, Bounds(above=0.0)]
    radius: Annotated[float, Bounds(at_least=0.0)]
    states: Annotated[Array, "K T+1 n"]
    measured: Annotated[Array, "K T+1 n"]
    commanded: Annotated[Array, "K T m"]
    applied: Annotated[Array, "K T m"]
    forces: Annotated[Array, "K T 3"]
    torques: Annotated[Array, "K T 3"]
    displaced: Annotated[Array, "K obstacles 3"]
    clearance: Annotated[Array, "K T+1"]
    contacts: Annotated[npt.NDArray[np.int64], "K"]
    collided_at: Annotated[Array, "K"]
    obstacles: Annotated[tuple[Line, ...], "K"]
    diverged_at: Annotated[Array, "K"]
    failed_at: Annotated[Array, "K"]
    reasons: Annotated[tuple[Line, ...], "K"]
    frame_times: Annotated[Array, "F", Bounds()]
    frames: Annotated[Array, "K F nq"]
    disturbances: tuple[Line, ...]
    seed: int
    first_trial: int = 0
    versions: Mapping[str, Line] = field(default_factory=dict)
    tube: Annotated[Array, "T+1 p p", Bounds()] | None = None
    collision_chance: Annotated[Array, "T+1", Bounds(at_least=0.0, at_most=1.0)] | None = None
    balls: BallRecord | None = None
    controller_run: Any = field(default=None, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Without the controller's run, which may hold what cannot be copied."""
        return vars(self) | {"controller_run": None}

    def __post_init__(self) -> None:
        sizes = check_fields(self)
        if not sizes["K"]:
            raise InputError("Rollout: states: got no trial, want at least one")
        if not self.plan.finite:
            raise InputError("Rollout: plan: got NaN or infinity, want finite states and controls")
        if (self.contacts > self.plan.steps).any():
            raise InputError(f"Rollout: contacts: got {self.contacts.max()}, want at most {self.plan.steps}, the steps")
        if not (np.diff(self.frame_times) > 0).all():
            raise InputError("Rollout: frame_times: got times that are not in order, want increasing times")
        _ = self.target  # which refuses what is no goal
        self._check_tube()
        self._check_endings()

    def _check_tube(self) -> None:
        """Raises InputError unless a predicted tube is covariances of the position."""
        if self.tube is not None:
            size = len(self.state_coordinates.position)
            if self.tube.shape[1] != size or not size:
                wanted = (
                    f"{size} by {size} matrices, as the position has entries" if size else "None without a position"
                )
                raise InputError(f"Rollout: tube: got shape {self.tube.shape}, want {wanted}")
            scale = np.abs(self.tube).max(axis=(1, 2), keepdims=True)
            relative = self.tube / np.where(scale > 0, scale, 1.0)
            # Sums that were taken in another order differ in the last digits.
            skewed = np.abs(relative - relative.transpose(0, 2, 1)).max(axis=(1, 2)) > 1e-9
            negative = np.linalg.eigvalsh(relative)[:, 0] < -1e-9
            for wrong, want in ((skewed, "a symmetric matrix"), (negative, "no negative variance")):
                if wrong.any():
                    at = int(np.argmax(wrong))
                    raise InputError(f"Rollout: tube: got {excerpt(self.tube[at].tolist())} at knot {at}, want {want}")

    def _check_endings(self) -> None:
        """Raises InputError unless trials ended within the run, and what ended them is named."""
        horizon = self.plan.horizon
        for name in ("collided_at", "diverged_at", "failed_at"):
            times = getattr(self, name)
            if not (((times >= 0) & (times <= horizon)) | (times == np.inf)).all():
                wanted = f"seconds from 0 to {horizon:g}, infinite where it did not happen"
                raise InputError(f"Rollout: {name}: got {excerpt(times.tolist())}, want {wanted}")
        collided, failed = np.isfinite(self.collided_at), np.isfinite(self.failed_at)
        for name, must, may in (
            ("obstacles", collided, collided),
            ("reasons", failed, failed | np.isfinite(self.diverged_at)),  # of a filter that diverged, too
        ):
            texts = np.array([bool(text) for text in getattr(self, name)])
            if (wrong := (must & ~texts) | (texts & ~may)).any():
                k = int(np.argmax(wrong))
                ended = "ended that way" if must[k] else "did not end that way"
                raise InputError(f"Rollout: {name}: got {excerpt(getattr(self, name)[k])} for trial {k}, which {ended}")

    @property
    def trials(self) -> int:
        """K, the number of runs."""
        return len(self.states)

    @property
    def times(self) -> Array:
        """Times of the states in seconds, (T+1,)."""
        return self.plan.times

    @property
    def target(self) -> Target:
        """What the trials were to reach."""
        return Target(self.state_coordinates, self.goal, self.plan.states)

    @property
    def plane(self) -> str:
        """The axes of the world that `places` are along; of a robot without a position, of its last ball."""
        return self.state_coordinates.plane or ("xyz" if self.balls is not None else "")

    def places(self, trial: int) -> Array:
        """Places of the robot in a trial: its position, or its last ball.

        Args:
          trial: row of the rollout.

        Returns:
          (T+1, 2 or 3), in metres.

        Raises:
          InputError: there is no such trial.
        """
        if not check_count("trial", trial, at_least=0) < self.trials:
            raise InputError(f"trial: got {trial}, want one of 0 to {self.trials - 1}")
        if self.state_coordinates.position or self.balls is None:
            return self.states[trial][:, list(self.state_coordinates.position)]
        return self.balls.driven[trial, :, -1]

    @property
    def planned_places(self) -> Array:
        """Where it should have been, (T+1, 2 or 3)."""
        if self.state_coordinates.position or self.balls is None:
            return self.plan.states[:, list(self.state_coordinates.position)]
        return self.balls.planned[:, -1]

    def in_world(self, places: npt.ArrayLike, *, height: float = 0.0) -> Array:
        """Points (..., 3) in the world of places (..., 2 or 3); height in metres is that of those seen from above.

        Args:
          places: (..., 2 or 3), in metres.
          height: in metres, of places that are seen from above.

        Returns:
          Points (..., 3).
        """
        space = self.state_coordinates
        if space.position or self.balls is None:
            return space.in_world(places, height=height)
        return vectors_of("places", places, 3)

    def of_world(self, points: npt.ArrayLike) -> Array:
        """Places (..., 2 or 3) of points (..., 3) in the world.

        Args:
          points: (..., 3), in metres.

        Returns:
          Places (..., 2 or 3).
        """
        points = vectors_of("points", points, 3)
        return self.state_coordinates.of_world(points) if self.state_coordinates.position else points

    @property
    def goal_distance(self) -> Array:
        """Distance from the target at the end, (K,), in `target.unit`."""
        return self.target.distance(self.states[:, -1])

    @cached_property
    def tracking_error(self) -> Array:
        """Distance from the plan's position in metres, (K, T+1); for robots without one see `tracking_unit`."""
        return tracking_error(self.state_coordinates, self.states, self.plan.states)

    @property
    def tracking_unit(self) -> str:
        """Of `tracking_error`: m; or of the scaled error that `goal.py` describes, for robots without a position."""
        return tracking_unit(self.state_coordinates)

    @property
    def saturated(self) -> npt.NDArray[np.bool_]:
        """Whether a command stood at a limit, (K, T)."""
        low, high = np.array(self.control_coordinates.low), np.array(self.control_coordinates.high)
        return np.any((self.commanded <= low) | (self.commanded >= high), axis=-1)

    @cached_property
    def _endings(self) -> tuple[npt.NDArray[np.str_], Array]:
        return endings(
            collided_at=self.collided_at,
            diverged_at=self.diverged_at,
            failed_at=self.failed_at,
            distance=self.goal_distance,
            radius=self.goal_radius,
            horizon=self.plan.horizon,
        )

    @property
    def outcome(self) -> tuple[str, ...]:
        """`reached`, `timed out`, `collided`, `diverged` or `error` for each trial: the first event ends it."""
        return tuple(self._endings[0].tolist())

    @property
    def ended(self) -> Array:
        """When each trial ended, (K,), in seconds; the horizon where nothing ended it before."""
        return self._endings[1]

    @property
    def counts(self) -> npt.NDArray[np.bool_]:
        """Which knots count, (K, T+1): those before a trial ended, the last one if nothing ended it, the first always.

        They are the same whether obstacles stop the robot or not.
        """
        ran = ~np.isin(self._endings[0], ("collided", "diverged", "error"))
        counted = (self.times < self.ended[:, None]) | ran[:, None]
        counted[:, 0] = True
        return counted & np.isfinite(self.states).all(axis=2)

    @property
    def collided(self) -> npt.NDArray[np.bool_]:
        """Whether a collision ended a trial, (K,)."""
        return self._endings[0] == "collided"

    @property
    def diverged(self) -> npt.NDArray[np.bool_]:
        """Whether a trial ended as its simulation became unstable, or its filter diverged, (K,)."""
        return self._endings[0] == "diverged"

    @property
    def reached(self) -> npt.NDArray[np.bool_]:
        """Whether a trial ran to its end, and that is within `goal_radius` of the goal, (K,)."""
        return self._endings[0] == "reached"

    def least_clearance(self) -> Array:
        """The least clearance of each trial until it ended, (K,), in metres: not above 0 where it collided."""
        least = np.where(self.counts, self.clearance, np.inf).min(axis=1)
        return np.where(self.collided, np.minimum(least, 0.0), least)

    def tally(self) -> str:
        """How many of the trials reached the target, in a line."""
        return f"{self.reached.sum()} of {self.trials} trials reached the {self.target.name}"

    def summary(self) -> str:
        """One line a trial: outcome, tracking error, clearance, saturation; before that, where the plan ends."""
        what = "; ".join(self.disturbances) or "undisturbed"
        lines = [f"{self.robot} in {self.scene}, {what}, seed {self.seed}"]
        lines += [f"  {line}" for line in self.target.of_plan(self.goal_radius)]
        return "\n".join([*lines, *(f"  {self._line(k)}" for k in range(self.trials))])

    def _line(self, k: int) -> str:
        outcome, counts, name = self.outcome[k], self.counts[k], f"trial {self.first_trial + k}"
        when = f"after {self.ended[k]:.2f} s" if self.ended[k] > 0 else "at once"
        if outcome in ("error", "diverged") and self.reasons[k]:
            return f"{name}: {outcome} {when}: {self.reasons[k]}"
        if not counts.any():
            return f"{name}: {outcome} {when}"
        if outcome in ("collided", "diverged"):
            what = f" with {self.obstacles[k]}" if outcome == "collided" else ""
            how, final = f"{outcome}{what} {when}", ""
        else:
            how = f"{outcome}, {self.target.describe(float(self.goal_distance[k]))}"
            final = f", final {self.tracking_error[k, -1]:.3g}"
        error, unit = self.tracking_error[k, counts], self.tracking_unit
        rms = float(np.sqrt(np.mean(error**2)))
        begun = counts[:-1]
        saturated = 100 * np.where(begun, self.saturated[k], False).sum() / max(begun.sum(), 1)
        clearance = self.least_clearance()[k]
        near = f"; clearance {clearance:.3f} m" if np.isfinite(clearance) else ""
        return (
            f"{name}: {how}; tracking error rms {rms:.3g}, max {error.max():.3g}{final} {unit}{near};"
            f" {self.contacts[k]} periods in contact; {saturated:.0f} % saturated"
        )

    __str__ = summary

    def _repr_html_(self) -> str:
        return notebook.of_rollout(self)
