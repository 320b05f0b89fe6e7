"""Runs of a controller: a `Rollout`. NumPy only."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Bounds, Index, Line, NonNegative, Positive, checked, repr_of
from lqrsim.errors import Array, InputError, check_symmetric, excerpt, vectors_of
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.display import SHOWN, drawing, number_text, of_table
from lqrsim.results.goal import OUTCOMES, Target, departure, scale_of, tracking_unit, worst_of
from lqrsim.results.solution_parts import Trajectory
from lqrsim.scenes.world import World

GOAL_MOVED = "goal moved during the run"  # among the disturbances of a run

# MuJoCo's warnings, in the order of mjtWarning.
WARNINGS = (
    "nearly singular inertia matrix", "too many contacts for its memory", "too many constraints for its memory",
    "position not finite", "velocity not finite", "acceleration not finite", "control not finite",
)  # fmt: skip


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class BallRecord:
    """Positions of a robot's balls in its runs and in the plan, for pictures.

    K trials of T control periods, B balls; the last ball stands for a robot without a position.

    Attributes:
      driven: (K, T+1, B, 3) centres in the world, in metres; NaN where the states are NaN.
      planned: (T+1, B, 3) centres along the plan.
      anchors: (B, 4) number of the MJCF's body that a ball is fixed to, and its position in the body's axes in metres;
        NaN for a ball that names no site.
    """

    driven: Annotated[Array, "K T+1 B 3"]
    planned: Annotated[Array, "T+1 B 3", Bounds()]
    radii: Annotated[Array, "B", Bounds(at_least=0.0)]
    anchors: Annotated[Array, "B 4"]

    __repr__ = repr_of

    def __post_init__(self) -> None:
        if not len(self.radii):
            raise InputError("BallRecord: radii: got none, want at least one ball")

    @property
    def tracked(self) -> tuple[int, Array]:
        """The body that the last ball is fixed to, and its position on that body, (3,)."""
        body, *place = self.anchors[-1].tolist()
        if not np.isfinite(body):
            raise InputError("balls: got no site for the last ball, want one in sites= of CollisionSpheres")
        return int(body), np.array(place)


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class MovingObstacles:
    """The O obstacles of a run that MuJoCo does not have, with axes and sizes as in an `Obstacle`, for pictures."""

    names: Annotated[tuple[Line, ...], "O"]
    kinds: Annotated[tuple[Line, ...], "O"]
    positions: Annotated[Array, "O 3", Bounds()]  # at the beginning of the run, in metres
    rotations: Annotated[Array, "O 3 3", Bounds()]  # with their axes as columns
    sizes: Annotated[Array, "O 3"]
    velocities: Annotated[Array, "O 3", Bounds()]  # in m/s

    __repr__ = repr_of

    @classmethod
    def of(cls, world: World) -> Self:
        obstacles = world.obstacles
        return cls(
            names=world.names, kinds=tuple(one.kind for one in obstacles),
            positions=np.array([one.position for one in obstacles]), sizes=np.array([one.size for one in obstacles]),
            rotations=np.array([one.rotation for one in obstacles]),
            velocities=np.array([one.velocity for one in obstacles]),
        )  # fmt: skip

    def at(self, time: float) -> Array:
        """Their positions (O, 3) in metres, `time` seconds from the beginning of the run."""
        return self.positions + time * self.velocities


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Rollout:
    """Closed-loop runs of one controller in MuJoCo, with all data for drawing them.

    K trials of T control periods; n states, m controls. Row k is trial `first_trial + k` of `seed`, bit for bit on
    equal processors.

    Attributes:
      goal: (n,) the goal state, NaN in states that do not count; None if the goal is the end of the plan. If a
        `Replanner` had a goal that moved, the last one.
      goal_radius: distance from the goal within which a trial has reached it, in `target.unit`: in metres, or a scaled
        error if the goal has no position.
      radius: radius of the robot's collision circle or sphere, in metres.
      states: (K, T+1, n) true states; angles in the representative nearest the plan.
      measured: (K, T+1, n) states as measured, which the controller gets.
      commanded: (K, T, m) the controller's commands.
      applied: (K, T, m) the controls that the actuators applied, within the robot's limits.
      forces: (K, T, 3) disturbing force at the centre of mass of the robot's body in N, world axes.
      torques: (K, T, 3) disturbing torque in N m, world axes.
      displaced: (K, obstacles, 3) displacement of each obstacle from its place in the plan, in metres.
      clearance: (K, T+1) signed distance to the nearest obstacle minus the radius in m; infinite without obstacles.
      contacts: (K,) number of control periods, from the collision on, in which MuJoCo reported a contact of the robot
        with an obstacle; 0 if the robot passes through obstacles.
      collided_at: (K,) seconds to the first collision, at a knot or between two; infinite without a collision.
      obstacles: (K) name of the obstacle of that collision; empty without a collision.
      diverged_at: (K,) seconds to the knot at which the simulation became unstable, a measurement or a force was not
        finite, or the controller's filter had diverged, from which on states are NaN; infinite if nothing diverged.
      failed_at: (K,) seconds to the knot at which the controller failed, after which states are NaN; else infinite.
      reasons: (K) why the controller failed, its filter diverged or a force was not finite; empty otherwise.
      frames: (K, F, nq) MuJoCo's qpos at these times, for drawing.
      disturbances: a description of each disturbance, and whether the goal moved.
      tube: (T+1, p, p) predicted covariance of the position about the plan, for this controller and these disturbances,
        in m^2; p is 2 or 3, the size of the position. None if it was not predicted; see `predict_tube`.
      collision_chance: (T+1,) predicted chance of being in collision at each knot, or None.
      balls: positions of the robot's balls, if it has balls and frames were recorded; else None.
      obstacle_geoms: (obstacles,) numbers of the geoms of `model` that are displaced by `displaced`; None if unknown.
      moving: further obstacles, which moved; None without any.
      warnings: (K, 7) how often MuJoCo warned of each of WARNINGS, until the trial was unstable; None if unknown.
      undisturbed: (T+1, n) states of the plan's own policy in an undisturbed run; NaN once it has ended. None if that
        was not run: with a controller of another kind where the plan is of a model, and not of MuJoCo's own steps.
      controller_run: the controller's run (`ControllerRun`) with its records: the estimates of an `OffsetFree`, the log
        of a `Replanner`. In memory only: None in a rollout that was loaded, pickled or copied.
    """

    _want = "a Rollout, such as simulate(...) returns"

    robot: Line
    body: Line
    scene: Line
    model: str
    plan: Trajectory
    policy_digest: Line
    state_coordinates: Annotated[Coordinates, "n"]
    control_coordinates: Annotated[Coordinates, "m"]
    goal: Annotated[Array, "n"] | None
    goal_radius: Positive
    radius: NonNegative
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
    obstacle_geoms: Annotated[npt.NDArray[np.int64], "obstacles", Bounds(at_least=0)] | None = None
    moving: MovingObstacles | None = None
    warnings: Annotated[npt.NDArray[np.int64], "K 7", Bounds(at_least=0)] | None = None
    undisturbed: Annotated[Array, "T+1 n"] | None = None
    controller_run: Any = field(default=None, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """The attributes without the controller's run, which may not be copyable."""
        return vars(self) | {"controller_run": None}

    def __post_init__(self) -> None:
        if not self.trials:
            raise InputError("Rollout: states: got no trial, want at least one")
        if not self.plan.finite:
            raise InputError("Rollout: plan: got NaN or infinity, want finite states and controls")
        if (self.contacts > self.plan.steps).any():
            raise InputError(f"Rollout: contacts: got {self.contacts.max()}, want at most {self.plan.steps}, the steps")
        if not (np.diff(self.frame_times) > 0).all():
            raise InputError("Rollout: frame_times: got times that are not in order, want increasing times")
        _ = self.target  # raises an exception if the goal is invalid
        self._check_tube()
        self._check_endings()

    def _check_tube(self) -> None:
        """Raises InputError unless a predicted tube consists of covariances of the position."""
        if self.tube is not None:
            size = len(self.state_coordinates.position)
            if self.tube.shape[1] != size or not size:
                want = f"{size} by {size} matrices, as the position has entries" if size else "None without a position"
                raise InputError(f"Rollout: tube: got shape {self.tube.shape}, want {want}")
            check_symmetric("Rollout: tube", self.tube)
            negative = np.linalg.eigvalsh(self.tube)[:, 0] < -1e-9 * np.abs(self.tube).max(axis=(1, 2))
            if negative.any():
                at, want = int(np.argmax(negative)), "no negative variance"
                raise InputError(f"Rollout: tube: got {excerpt(self.tube[at].tolist())} at knot {at}, want {want}")

    def _check_endings(self) -> None:
        """Raises InputError unless trials ended within the run, by named events."""
        horizon = self.plan.horizon
        for name in ("collided_at", "diverged_at", "failed_at"):
            times = getattr(self, name)
            within = (times >= 0) & (times <= (1 + 1e-9) * horizon)  # rounding: 3 * 0.1 is more than 0.3
            if not (within | (times == np.inf)).all():
                wanted = f"seconds from 0 to {horizon:g}, infinite where it did not happen"
                raise InputError(f"Rollout: {name}: got {excerpt(times.tolist())}, want {wanted}")
        collided, failed = np.isfinite(self.collided_at), np.isfinite(self.failed_at)
        for name, must, may in (
            ("obstacles", collided, collided),
            ("reasons", failed, failed | np.isfinite(self.diverged_at)),  # includes filters that diverged
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
        return Target(self.state_coordinates, self.goal, self.plan.states)

    @property
    def plane(self) -> str:
        """The world's axes of `places`; for a robot without a position, the axes of its last ball."""
        return self.state_coordinates.plane or ("xyz" if self.balls is not None else "")

    @checked
    def places(self, trial: Index) -> Array:
        """The robot's places (T+1, 2 or 3) in a trial, in metres: its position, or the position of its last ball."""
        if not trial < self.trials:
            raise InputError(f"trial: got {trial}, want one of 0 to {self.trials - 1}")
        if self.state_coordinates.position or self.balls is None:
            return self.states[trial][:, list(self.state_coordinates.position)]
        return self.balls.driven[trial, :, -1]

    @property
    def planned_places(self) -> Array:
        """The planned places, (T+1, 2 or 3)."""
        if self.state_coordinates.position or self.balls is None:
            return self.plan.states[:, list(self.state_coordinates.position)]
        return self.balls.planned[:, -1]

    def in_world(self, places: npt.ArrayLike, *, height: float = 0.0) -> Array:
        """Points (..., 3) in the world of places (..., 2 or 3), in metres."""
        space = self.state_coordinates
        if space.position or self.balls is None:
            return space.in_world(places, height=height)
        return vectors_of("places", places, 3)

    def of_world(self, points: npt.ArrayLike) -> Array:
        """The places (..., 2 or 3) of points (..., 3) in the world, in metres."""
        points = vectors_of("points", points, 3)
        return self.state_coordinates.of_world(points) if self.state_coordinates.position else points

    @property
    def goal_distance(self) -> Array:
        """Distance from the goal at the end, (K,), in `target.unit`."""
        return self.target.distance(self.states[:, -1])

    @cached_property
    def tracking_error(self) -> Array:
        """Distance from the plan, (K, T+1), in `tracking_unit`."""
        space, plan = self.state_coordinates, self.plan.states
        if space.position:
            place = list(space.position)
            return np.linalg.norm(self.states[..., place] - plan[..., place], axis=-1)
        return np.max(np.abs(space.difference(self.states, plan)) / scale_of(plan), axis=-1)

    @property
    def tracking_unit(self) -> str:
        """Unit of `tracking_error`: m, or the unit of the scaled error (`goal.py`) for robots without a position."""
        return tracking_unit(self.state_coordinates)

    @property
    def saturated(self) -> npt.NDArray[np.bool_]:
        """Whether a command was at a limit, (K, T)."""
        low, high = self.control_coordinates.limits
        return np.any((self.commanded <= low) | (self.commanded >= high), axis=-1)

    @cached_property
    def _endings(self) -> tuple[npt.NDArray[np.str_], Array]:
        """The outcomes, (K,), and the times in seconds, (K,). Of events at the same time the first of these counts."""
        events = np.stack([self.collided_at, self.diverged_at, self.failed_at])
        first, names = events.min(axis=0), np.array(["collided", "diverged", "error"])
        arrived = np.where(self.goal_distance <= self.goal_radius, "reached", "timed out")
        outcome = np.where(np.isfinite(first), names[np.argmin(events, axis=0)], arrived)
        return outcome, np.where(np.isfinite(first), first, self.plan.horizon)

    @property
    def outcome(self) -> tuple[str, ...]:
        """`reached`, `timed out`, `collided`, `diverged` or `error` for each trial, by its first event."""
        return tuple(self._endings[0].tolist())

    @property
    def ended(self) -> Array:
        """The time at which each trial ended, (K,), in seconds; the horizon if no event ended it."""
        return self._endings[1]

    @property
    def counts(self) -> npt.NDArray[np.bool_]:
        """Mask of the knots that count, (K, T+1): the first, all before the trial ended, the last if no event ended it.

        The mask does not depend on whether obstacles stop the robot.
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
        """Whether an unstable simulation or filter, or a number that is not finite, ended a trial, (K,)."""
        return self._endings[0] == "diverged"

    @property
    def reached(self) -> npt.NDArray[np.bool_]:
        """Whether a trial ran to the end of its plan and ended within `goal_radius` of the goal, (K,)."""
        return self._endings[0] == "reached"

    def least_clearance(self) -> Array:
        """The least clearance of each trial until it ended, (K,), in metres; at most 0 where it collided."""
        least = np.where(self.counts, self.clearance, np.inf).min(axis=1)
        return np.where(self.collided, np.minimum(least, 0.0), least)

    def tally(self) -> str:
        """The number of trials that reached the goal, in one line."""
        return f"{self.reached.sum()} of {self.trials} trials reached the {self.target.name}"

    def summary(self) -> str:
        """Disturbances, the end of the plan, the number of each outcome, and a line for each of the first trials."""
        disturbances = "; ".join(self.disturbances) or "undisturbed"
        lines = [f"{self.robot} in {self.scene}, {disturbances}, seed {self.seed}"]
        if GOAL_MOVED in self.disturbances:
            lines.append("  trials are to reach the goal where it was last; the plan was made for another")
        else:
            lines += [f"  {line}" for line in self.target.of_plan(self.goal_radius)]
        if self.undisturbed is not None and (left := self.departure()):
            # One that is left little by little is of other dynamics; by an MJCF, which is robot and scene, of the same.
            by_formula = self.robot != self.scene and "that step jumps" not in left
            hint = "; ls.check_plant compares the plan's dynamics with the simulator's" if by_formula else ""
            lines.append(f"  undisturbed, the plan's policy {left}{hint}")
        if warned := self.warned():
            lines.append(f"  MuJoCo warned {warned}")
        if self.trials > 1:
            counted = Counter(self.outcome)
            outcomes = ", ".join(f"{counted[outcome]} {outcome}" for outcome in OUTCOMES if counted[outcome])
            lines.append(f"  {self.trials} trials: {outcomes}")
        lines += [f"  {self._line(k)}" for k in range(min(self.trials, SHOWN))]
        return "\n".join([*lines, f"  and {self.trials - SHOWN} more"] if self.trials > SHOWN else lines)

    def departure(self) -> str:
        """Where the undisturbed run of the plan's own policy leaves the plan, as text; empty if it does not.

        It leaves the plan where a state is off by more than a tenth of the largest range along the plan in its unit.
        """
        if self.undisturbed is None:
            return ""
        return departure(self.state_coordinates, self.undisturbed, self.plan.states, self.plan.dt)

    def warned(self) -> str:
        """How often MuJoCo warned, in how many trials and of what, as text; empty if it did not."""
        if self.warnings is None or not self.warnings.any():
            return ""
        listed = [f"{warning} ({n})" for warning, n in zip(WARNINGS, self.warnings.sum(axis=0), strict=True) if n]
        trials = f" in {(self.warnings > 0).any(axis=1).sum()} of {self.trials} trials" if self.trials > 1 else ""
        count = int(self.warnings.sum())
        return f"{count} time{'s' if count > 1 else ''}{trials}: {', '.join(listed)}"

    def _line(self, k: int) -> str:
        outcome, counts, name = self.outcome[k], self.counts[k], f"trial {self.first_trial + k}"
        when = f"after {self.ended[k]:.2f} s" if self.ended[k] > 0 else "at once"
        if outcome in ("error", "diverged") and self.reasons[k]:
            return f"{name}: {outcome} {when}: {self.reasons[k]}"
        if not counts.any():
            return f"{name}: {outcome} {when}"
        if outcome in ("collided", "diverged"):
            struck = f" with {self.obstacles[k]}" if outcome == "collided" else ""
            how, final = f"{outcome}{struck} {when}", ""
        else:
            worst = self.target.worst(self.states[k, -1], self.goal_radius)
            how = f"{outcome}, {self.target.describe(float(self.goal_distance[k]))}{f' ({worst})' if worst else ''}"
            final = f", final {self.tracking_error[k, -1]:.3g}"
        error, unit = self.tracking_error[k, counts], self.tracking_unit
        rms = float(np.sqrt(np.mean(error**2)))
        begun = counts[:-1]
        saturated = 100 * np.where(begun, self.saturated[k], False).sum() / max(begun.sum(), 1)
        clearance = self.least_clearance()[k]
        least = f"; clearance {clearance:.3f} m" if np.isfinite(clearance) else ""
        errors = f"tracking error rms {rms:.3g}, max {error.max():.3g}{self._worst(k)}{final} {unit}"
        contact = f"{self.contacts[k]} periods in contact with obstacles"
        return f"{name}: {how}; {errors}{least}; {contact}; {saturated:.0f} % saturated"

    def _worst(self, k: int) -> str:
        """The state with the largest error from the plan in a trial, for a robot without a position; else empty."""
        if self.state_coordinates.position:
            return ""
        knot = int(np.argmax(np.where(self.counts[k], self.tracking_error[k], -1.0)))
        off = self.state_coordinates.difference(self.states[k, knot], self.plan.states[knot])
        worst = worst_of(self.state_coordinates, off, scale_of(self.plan.states))
        return f" ({worst} at {self.times[knot]:.2f} s)" if worst else ""

    __str__ = summary

    def _repr_html_(self) -> str:
        """Outcomes of the first trials, and their paths about the plan, for notebooks."""
        target, least, distance = self.target, self.least_clearance(), self.goal_distance
        error, end = f"largest error, {self.tracking_unit}", f"from the {target.name}"
        rows = [("trial", "outcome", "ended", error, end, "clearance")]
        for k in range(min(self.trials, SHOWN)):
            worst = float(np.max(self.tracking_error[k], where=self.counts[k], initial=0.0))
            ended, end = f"{number_text(self.ended[k])} s", f"{number_text(distance[k])} {target.unit}"
            clearance = f"{number_text(least[k])} m"
            rows.append((str(self.first_trial + k), self.outcome[k], ended, number_text(worst), end, clearance))
        remarks = ["; ".join(self.disturbances) or "undisturbed", self.tally()]
        if self.trials > SHOWN:
            remarks.append(f"the first {SHOWN} of {self.trials} trials are shown")
        picture = drawing(self.state_coordinates, self.times, self.plan.states, self.states)
        return of_table(f"{self.robot} in {self.scene}, seed {self.seed}", remarks, rows, picture)
