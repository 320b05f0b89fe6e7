"""Predictions of a closed loop about its plan: moments, trials of the nonlinear model, and chances of collision.

`LinearLoop` has mean and covariance by the recursion of LQG-MP. The true state and the estimate are jointly Gaussian.
Their deviation from the plan is X = (y, d). Commands move y = (e, a, zhat), with zhat before the measurement of the
same knot; for a law without an estimate, y = (e, a). Nothing moves the unknowns d, whose covariance is therefore the
same for all laws. Control limits enter by statistical linearisation: for u normal with mean mu and std sigma, the
limited control has the mean slope P(low < u < high), and the rest of its variance is noise. For lost commands the
moments of the mixture are exact; the distribution itself is not Gaussian.

From these moments, the clearance of each obstacle is linearised about the mean, so that it is normally distributed. A
collision is counted when it begins: the expected number of steps in which the clearance falls below zero. Clearances of
two neighbouring steps are nearly the same number, so adding or multiplying the chances of single steps would count each
collision many times.

The moments are valid for small deviations. A robot whose commands stay at their limits leaves its plan, and far from
the plan its dynamics are not those linearised there. `sample_loop` therefore runs the nonlinear dynamics without
MuJoCo, with limits, lag, delays, and lost commands and measurements. A seed draws the same numbers for all plans and
laws, so that two of them are compared on the same trials.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
from scipy.special import betaincinv, ndtr, owens_t

from lqrsim.control.controllers import Controller, turn_to_nearest
from lqrsim.control.plan_model import KalmanFilter, PlanModel, recursions
from lqrsim.control.uncertainty import per_entry, triangular_root
from lqrsim.errors import Array, InputError
from lqrsim.kernels.records import LoopArrays, LoopMoments, LoopSizes, LoopWork, zeros_of
from lqrsim.problem.collision_shape import ShapeInWorld
from lqrsim.problem.obstacles import Clearance, KeepsClear, each_once
from lqrsim.problem.problem import Problem
from lqrsim.results.solution import Solution

LARGEST_MARGIN = 12.0  # standard deviations of clearance; with more the chance of a collision is below 1e-32


class Spread(NamedTuple):
    """Distribution of the clearances to O obstacles at T+1 knots; further axes are the first."""

    mean: Array  # (T+1, O), in m, as the standard deviation
    std: Array
    correlation: Array  # (T, O), of each clearance with the same clearance at the previous knot
    normal: Array  # (T+1, O, p), derivative of each clearance by the position

    def chance(self) -> tuple[Array, Array]:
        """The chance of being in collision at each knot (..., T+1), and of colliding at all, (...)."""
        at_knots = np.minimum(ndtr(-self.mean / self.std).sum(axis=-1), 1.0)
        return at_knots, -np.expm1(-self.beginnings().sum(axis=(-2, -1)))

    def beginnings(self) -> Array:
        """The chance that a collision with each obstacle begins at each knot, (..., T+1, O)."""
        margin = self.mean / self.std
        chance, now, previous = ndtr(-margin), margin[..., 1:, :], margin[..., :-1, :]
        begins, possible = np.zeros_like(margin), now < LARGEST_MARGIN
        begins[..., 0, :] = chance[..., 0, :]
        # In collision at a knot, but not at the previous knot.
        both = both_below(-now[possible], -previous[possible], self.correlation[possible])
        begins[..., 1:, :][possible] = np.maximum(chance[..., 1:, :][possible] - both, 0.0)
        return begins


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Obstacles of a problem, as its robot sees them."""

    kept: tuple[KeepsClear, ...]  # the costs and constraints that keep it away from obstacles, without repetitions
    shapes: tuple[ShapeInWorld, ...]  # for each of these, the shape of the robot among its obstacles
    position: tuple[int, ...]  # the states that are the robot's position; with balls or geoms, all that move these
    std: float  # of an obstacle's position, in m

    @classmethod
    def of(cls, problem: Problem, std: float) -> "Surroundings":
        """The obstacles of the problem's costs and constraints, each world once."""
        terms, place = each_once(problem.kept_clear), problem.dynamics.state_coordinates.position
        if any(term.moving for term in terms):
            raise InputError("problem: got obstacles that move, want ones that stand still for a chance of collision")
        pairs = [(term, shape) for term in terms if len((shape := term.in_world(problem.dynamics)).world)]
        shapes = tuple(shape for _, shape in pairs)
        states = [shape.depends_on for shape in shapes]
        position = place if set(states) <= {place} else tuple(sorted({i for indices in states for i in indices}))
        return cls(tuple(term for term, _ in pairs), shapes, position, std)

    def keep_away(self, margin: Array) -> list[Clearance]:
        """Constraints that keep a margin from each obstacle, (T+1, O)."""
        ends = np.cumsum([len(shape.world) for shape in self.shapes])[:-1]
        pairs = zip(self.kept, np.split(margin, ends, axis=1), strict=True)
        return [Clearance(term.world, **term.shape, margin=columns) for term, columns in pairs]

    def clearances(self, states: Array) -> tuple[Array, Array, Array]:
        """At states (K, n): the distance to each obstacle (K, O), its gradient (K, O, p) and its variance (O,).

        With balls, the distance is measured from the ball nearest to the obstacle.
        """
        if not self.shapes:
            return np.zeros((len(states), 0)), np.zeros((len(states), 0, len(self.position))), np.zeros(0)
        parts = [shape.with_slopes(states, self.position) for shape in self.shapes]
        planes = [obstacle.kind == "plane" for shape in self.shapes for obstacle in shape.world.obstacles]
        clearance, normals = (np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))
        return clearance, normals, np.where(planes, 0.0, self.std**2)

    @property
    def by_mujoco(self) -> bool:
        """Whether MuJoCo computes the distances, between geoms."""
        return any("geoms" in term.shape for term in self.kept)

    def displacements(self, rng: np.random.Generator, trials: int) -> list[Array]:
        """Random displacements (K, O, 3) of each world's obstacles in K trials; planes stay, and heights from above."""
        displaced = []
        for shape in self.shapes:
            axes = [1.0, 1.0, 0.0 if shape.dynamics.state_coordinates.from_above else 1.0]
            moves = np.array([[obstacle.kind != "plane"] for obstacle in shape.world.obstacles])
            displaced.append(self.std * moves * axes * rng.standard_normal((trials, len(moves), 3)))
        return displaced

    def nearest(self, states: Array, displaced: list[Array]) -> Array:
        """Clearance of states (K, n) to the nearest obstacle, (K,), the obstacles of each world displaced (K, O, 3)."""
        pairs = zip(self.shapes, displaced, strict=True)
        clearances = [shape.clearance(shape.places(states), moved) for shape, moved in pairs]
        return np.min(clearances, axis=0, initial=np.inf) if clearances else np.full(len(states), np.inf)

    def spread(self, states: Array, covariance: Array, across: Array) -> Spread:
        """Clearances at mean states (..., T+1, n); `across` (..., T, n, n) is the covariance with the previous knot."""
        place, many = list(self.position), states.shape[:-1]
        clearance, normal, displaced = self.clearances(states.reshape(-1, states.shape[-1]))
        clearance, normal = clearance.reshape(*many, -1), normal.reshape(*many, len(displaced), len(place))
        covariance, across = (matrix[..., place, :][..., place] for matrix in (covariance, across))
        ones = np.ones(len(place))  # a product with it is much faster than `sum` over a short axis
        variance = (normal @ covariance * normal) @ ones + displaced
        std = np.maximum(np.sqrt(np.maximum(variance, 0.0)), 1e-12)
        shared = (normal[..., 1:, :, :] @ across * normal[..., :-1, :, :]) @ ones + displaced
        return Spread(clearance, std, np.clip(shared / (std[..., 1:, :] * std[..., :-1, :]), -1.0, 1.0), normal)

    def emphasis(self, states: Array, covariance: Array, across: Array, weights: Array) -> Array:
        """Weights (T+1, n, n) of deviations that lead to a collision, at most as large as `weights` (n,).

        A law that holds all deviations equally tightly spends effort where nothing is near. The chance of a collision
        depends on the variance s^2 of the clearance c at each knot and obstacle. Its derivative is close to
        p z^2 / (2 s^2), with z = c / s and the chance p that a collision begins there. To first order, a law lowers the
        chance most if these derivatives are its weights of deviations along the normals of the obstacles. They belong
        to one law, and weights change the law, but their ratios change little.
        """
        emphasis = np.zeros_like(covariance)
        if not self.kept:
            return emphasis
        spread = self.spread(states, covariance, across)
        slopes = spread.beginnings() * (spread.mean / spread.std) ** 2 / spread.std**2
        place = np.array(self.position)
        emphasis[:, place[:, None], place] = np.einsum("to,toi,toj->tij", slopes, spread.normal, spread.normal)
        largest = float(np.max(np.diagonal(emphasis, axis1=1, axis2=2) @ (1 / weights)))
        return emphasis / largest if largest > 0 else emphasis


def both_below(first: Array, second: Array, correlation: Array) -> Array:
    """P(a < first, b < second) of standard normal numbers with that correlation, elementwise, by Owen's T (1956)."""
    # T needs ratios to both numbers, and to the spread of one given the other; tiny numbers count as 1e-200. Beyond 40,
    # chances do not change.
    a, b = (np.where(np.abs(bound) < 1e-200, 1e-200, np.clip(bound, -40.0, 40.0)) for bound in (first, second))
    spread = np.maximum(np.sqrt((1 - correlation) * (1 + correlation)), 1e-100)
    with np.errstate(over="ignore"):
        owens = owens_t(a, (b - correlation * a) / (a * spread)) + owens_t(b, (a - correlation * b) / (b * spread))
    opposite = (a < 0) != (b < 0)
    return np.maximum(0.5 * (ndtr(a) + ndtr(b) - opposite) - owens, 0.0)


def moments_of(loops: LoopArrays, stated: int, count: int | None, lost: float = 0.0) -> LoopMoments:
    """The moments of the first entries of y, or of all, in each of L systems under each of C laws, (L, C, ...).

    The first `stated` entries of y are the system's own; with losses, the last m of these are a.
    """
    (steps, laws, m, width), (systems, size) = loops.K.shape, loops.F.shape[1:3]
    first = size if count is None else count
    rows, columns, lossy = *loops.noise.shape[2:], 0 < lost < 1
    sizes = LoopSizes(
        steps, systems, laws, size, width, m, first, stated, rows, columns, bool(loops.jointly.size), lossy,
        lost / (1 - lost) if lossy else 0.0,
    )  # fmt: skip
    lengths = {"T": steps, "L": systems, "C": laws, "Y": size, "X": width, "R": width - size, "m": m, "N": first}
    work, moments = zeros_of(LoopWork, **lengths), zeros_of(LoopMoments, **lengths)
    P, M = work.P, work.M
    M[..., size:, size:] = loops.transition
    arguments = sizes, *(type(arrays)(*map(np.ravel, arrays)) for arrays in (loops, work, moments))
    advance = recursions().lay_out("advance", 0, *arguments)
    for t in range(steps + 1):
        advance(t, *arguments)
        if t < steps:
            np.matmul(M[..., :size, :], P, out=work.driven)
            np.matmul(work.driven, M.swapaxes(-1, -2), out=P[..., :size, :])
    return LoopMoments(*(np.moveaxis(moment, 0, 2) for moment in moments))


@dataclass(eq=False)
class LinearLoop:
    """A closed loop about a plan."""

    model: PlanModel
    gain: Array  # (T, m, Z or n) of a law in deviations from the plan, or (C, T, m, Z or n) of C laws
    offset: Array  # (T, m)
    filter_gain: Array | None  # of a Kalman filter, (T+1, Z, Y); None for a law of the measured states
    limits: tuple[Array, Array]  # of the controls, (m,) each
    assumed: PlanModel | None = None  # by the filter, whose estimates have its Z; by default the true system's

    def moments(self, count: int | None = None) -> LoopMoments:
        """The moments of the first entries of y, or of all, from the start to the plan's end."""
        moments = self.in_systems([self.model], count)
        return LoopMoments(*(moment[0, 0] if self.gain.ndim == 3 else moment[0] for moment in moments))

    def in_systems(self, models: Sequence[PlanModel], count: int | None) -> LoopMoments:
        """The moments in several true systems, which differ in no sizes, and in neither sensors nor losses."""
        first, steps, m = models[0], self.model.plan.steps, self.model.m
        n, stated, unknown = first.n, first.n + first.lagging, len(first.transition)
        gain = self.gain.reshape(-1, *self.gain.shape[-3:]).swapaxes(0, 1)
        offset = self.offset.reshape(-1, steps, m).swapaxes(0, 1)
        size = stated if self.filter_gain is None else stated + gain.shape[-1]
        F, K = np.zeros((steps, len(models), size, size + unknown)), np.zeros((*gain.shape[:-1], size + unknown))
        G, c = np.empty((steps, len(models), m, size)), np.empty((steps, len(models), size))
        noise, jointly = np.zeros((steps + 1, len(models), size, size)), np.zeros(0)
        drawn = np.empty((steps + 1, len(models), unknown, unknown))
        if self.filter_gain is None:
            K[..., :n], on_command = gain, gain * first.measurement_std
        else:
            # F and K act on the corrected estimate. With losses, all measurements count less.
            assumed, received = self.assumed or first, 1 - first.uncertainty.loss
            H = first.derivatives.H
            seen = received * (self.filter_gain @ H)[:-1, None]
            measured = np.sqrt(received) * (self.filter_gain @ (H * first.measurement_std))[:-1, None]
            for after, on in ((gain, K), (assumed.step.F[:, None], F[..., stated:, :])):
                on[..., stated:size], on[..., :n] = after, after @ seen
                on[..., stated : stated + n] -= on[..., :n]
            G[..., stated:], c[..., stated:] = assumed.step.G[:, None].swapaxes(-1, -2), assumed.step.c[:, None]
            on_command, measured = gain @ measured, assumed.step.F[:, None] @ measured
            noise[1:, :, stated:, stated:] = measured @ measured.swapaxes(-1, -2)
            jointly = np.zeros((*gain.shape[:-1], size))
            jointly[..., stated:] = on_command @ measured.swapaxes(-1, -2)
        for i, model in enumerate(models):
            to, by, constant = (part[:, :stated] for part in model.step)
            F[:, i, :stated, :stated], F[:, i, :stated, size:] = to[:, :, :stated], to[:, :, stated:]
            G[:, i, :, :stated], c[:, i, :stated] = by.swapaxes(1, 2), constant
            start, process = model.start_root @ model.start_root.T, model.process_noise
            noise[0, i, :stated, :stated], drawn[0, i] = start[:stated, :stated], start[stated:, stated:]
            noise[1:, i, :stated, :stated], drawn[1:, i] = process[:, :stated, :stated], process[:, stated:, stated:]
        planned, reached = first.plan.controls, np.stack([model.reached for model in models], axis=1)
        arrays = LoopArrays(
            F, G, c, noise, drawn, first.transition, K, planned[:, None] + offset, planned,
            on_command @ on_command.swapaxes(-1, -2), jointly, reached, *self.limits,
        )  # fmt: skip
        return moments_of(arrays, stated, count, first.uncertainty.command_loss)


def with_filter(
    model: PlanModel, kalman: KalmanFilter, gain: Array, offset: Array, limits: tuple[Array, Array]
) -> LoopMoments:
    """Moments of the states under C laws that follow a filter's estimates.

    The filter is assumed to be right about the noise. Its error is then independent of its estimate, and what it learns
    from a measurement is noise that moves the estimate. The unknowns' estimates are moved by no law.
    """
    n, size = model.n, model.n + model.lagging
    learned = kalman.gain @ kalman.innovation @ kalman.gain.transpose(0, 2, 1)
    F, G, c, noise = (array[:, None, :size] for array in (*model.step, learned))
    gain, offset = gain.swapaxes(0, 1), offset.swapaxes(0, 1)
    planned = model.plan.controls
    arrays = LoopArrays(
        F, G.swapaxes(-1, -2), c, noise, learned[:, size:, size:], model.transition, gain, planned[:, None] + offset,
        planned, np.zeros((*offset.shape, model.m)), np.zeros(0), model.reached, *limits,
    )  # fmt: skip
    moments = LoopMoments(*(moment[0] for moment in moments_of(arrays, size, n)))
    return moments._replace(
        covariance=moments.covariance + kalman.corrected[:, :n, :n],
        across=moments.across + model.step.F[:, :n] @ kalman.corrected[:-1, :, :n],
    )


# The number of collisions that the linear model's chance counts as, when it is combined with those of the trials: with
# fewer in the trials, it weighs more than they do.
PRIOR = 4.0
REFUTED = 0.025  # tail probability, on either side, of the trials' collisions below which they refute that chance


class DeviationNorm(NamedTuple):
    """The norm of deviations from a plan: of the position in m, or without one of the goal's states, each scaled."""

    states: list[int]  # indices of the states that count
    scale: Array  # (C,) what each is divided by: 1, or `Target.scale`, which has no unit of its own

    @classmethod
    def of(cls, solution: Solution, position: Sequence[int]) -> Self:
        if position:
            return cls(list(position), np.ones(len(position)))
        counts = np.flatnonzero(np.isfinite(solution.target.state)).tolist()
        return cls(counts, solution.target.scale[counts])

    def __call__(self, off: Array) -> Array:
        """The norms (...) of deviations (..., n)."""
        return np.linalg.norm(off[..., self.states] / self.scale, axis=-1)

    def squares(self, covariance: Array) -> Array:
        """The mean squared distance (...) from the mean, by covariances (..., n, n)."""
        return (np.diagonal(covariance, axis1=-2, axis2=-1)[..., self.states] / self.scale**2).sum(axis=-1)


@dataclass(frozen=True, eq=False)
class SampledLoop:
    """The result of K trials."""

    moments: LoopMoments  # of the deviations from the plan and the commands, over the trials whose states stay finite
    collided: npt.NDArray[np.bool_]  # (K,) whether each trial collides at a knot, or its state is not finite
    farthest: Array  # (K,) largest deviation of each trial from its plan, by the `DeviationNorm`

    def chance(self, predicted: float) -> float:
        """The chance of collision by these trials and the linear model's, `predicted`. 0 only if both have none."""
        trials, collisions = len(self.collided), int(self.collided.sum())
        low = float(betaincinv(collisions, trials - collisions + 1, REFUTED)) if collisions else 0.0
        high = float(betaincinv(collisions + 1, trials - collisions, 1 - REFUTED)) if collisions < trials else 1.0
        if not low <= predicted <= high:
            return max(collisions, 0.5) / trials  # no number of trials shows a chance of 0
        return (PRIOR + collisions) / (PRIOR / predicted + trials) if predicted else 0.0


def sample_loop(
    model: PlanModel, controller: Controller, limits: tuple[Array, Array], surroundings: Surroundings,
    norm: DeviationNorm, trials: int, seed: int,
) -> SampledLoop:  # fmt: skip
    """Run K trials of a controller about its plan, in the true system `model`."""
    plan, n = model.plan, model.n
    robots, run = _Robots(model, limits, trials, np.random.default_rng(seed)), controller.start(trials)
    displaced = surroundings.displacements(robots.rng, trials)
    collided, farthest = np.zeros(trials, dtype=bool), np.zeros(trials)
    states, commands = np.empty((plan.steps + 1, trials, n)), np.empty((plan.steps, trials, model.m))
    with np.errstate(over="ignore", invalid="ignore"):  # of trials that diverge
        for t in range(plan.steps + 1):
            states[t] = robots.states(t)
            finite = np.isfinite(states[t]).all(axis=1)
            collided |= ~finite
            collided[finite] |= surroundings.nearest(states[t, finite], [moved[finite] for moved in displaced]) < 0
            off = norm(states[t] - plan.states[t])
            farthest = np.maximum(farthest, np.where(finite, off, np.inf))
            if t < plan.steps:
                commands[t] = robots.advance(t, run.control(t, robots.measure(t, shows_losses=controller.sees_losses)))
    stayed = np.isfinite(farthest)
    off, commands = (states - plan.states[:, None])[:, stayed], commands[:, stayed]
    mean = off.mean(axis=1)
    off -= mean[:, None]
    count = max(off.shape[1], 1)
    at_limit = (commands <= limits[0]) | (commands >= limits[1])
    moments = LoopMoments(
        mean, off.transpose(0, 2, 1) @ off / count, off[1:].transpose(0, 2, 1) @ off[:-1] / count,
        commands.std(axis=1), at_limit.mean(axis=1),
    )  # fmt: skip
    return SampledLoop(moments, collided, farthest)


class _Robots:
    """K simulated robots, and the links that carry measurements and commands.

    Their z is that of `plan_model.py`, but of states themselves in place of deviations from the plan.
    """

    def __init__(self, model: PlanModel, limits: tuple[Array, Array], trials: int, rng: np.random.Generator) -> None:
        plan, uncertainty = model.plan, model.uncertainty
        self.model, self.limits, self.rng, self._trials = model, limits, rng, trials
        start = np.concatenate([plan.states[0], model.reached[0], np.zeros(len(model.transition))])
        self.z = start + self._normal(model.size) @ model.start_root.T
        # Noise on controls is added before the limits, so it does not count as noise on states.
        self._control_std = per_entry("Uncertainty: control", uncertainty.control, model.dynamics.control_coordinates)
        pushed = PlanModel(model.derivatives, replace(uncertainty, control=0.0))
        self._process_roots = triangular_root(pushed.disturbing)
        predictor = model.predictor._replace(lag=np.array([model.arrived.left, model.arrived.mean]))
        self._command = np.zeros((trials, model.m))
        self._predict = model.compiled.lay_out("predict", trials, self._command, predictor, self.z)
        # Measurements and commands under way. The first measurement is repeated until it arrives. The plan's controls
        # are applied until the first command arrives.
        self._late_measured = deque[Array]()
        first = [np.tile(plan.controls[min(i, plan.steps - 1)], (trials, 1)) for i in range(uncertainty.delay)]
        self._late_commands = deque(first)
        self._measured, self._applied = np.tile(plan.states[0], (trials, 1)), np.tile(plan.controls[0], (trials, 1))

    def _normal(self, size: int) -> Array:
        return self.rng.standard_normal((self._trials, size))

    def states(self, t: int) -> Array:
        """The states (K, n), angles near the plan's."""
        model = self.model
        x = self.z[:, : model.n].copy()
        turn_to_nearest(model.dynamics.state_coordinates, x[None], model.plan.states[t : t + 1])
        self.z[:, : model.n] = x
        return x

    def measure(self, t: int, *, shows_losses: bool) -> Array:
        uncertainty, measured = self.model.uncertainty, self._late_measured
        measured.append(self.z[:, : self.model.n] + self._normal(self.model.n) * self.model.measurement_std)
        arrived = measured.popleft() if t >= uncertainty.latency else measured[0]
        lost = self.rng.random((self._trials, 1)) < uncertainty.loss
        self._measured = np.where(lost, self._measured, arrived)
        return np.where(lost, np.nan, arrived) if shows_losses else self._measured

    def advance(self, t: int, commands: Array) -> Array:
        """Advance by a control period, under commands (K, m). Returns the applied commands."""
        uncertainty, model = self.model.uncertainty, self.model
        self._late_commands.append(commands)
        lost = self.rng.random((self._trials, 1)) < uncertainty.command_loss
        self._applied = np.where(lost, self._applied, self._late_commands.popleft())
        np.clip(self._applied + self._normal(model.m) * self._control_std, *self.limits, out=self._command)
        with model.dynamics.quiet():
            self._predict()
        self.z += self._normal(model.size) @ self._process_roots[t].T
        return self._command
