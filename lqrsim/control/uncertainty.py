"""The uncertainty in a run that its plan ignores, in numbers: the basis of filters, tracking laws and tubes.

All of it is zero-mean and Gaussian. `lqrsim.uncertainty_of` makes an `Uncertainty` from the disturbances of `simulate`.
For your own robot you can also state one directly.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, NamedTuple

import numpy as np

from lqrsim.annotations import LINE, Bounds, NonNegative, Share, Want, check_string, checked
from lqrsim.errors import Array, InputError, check_array, check_kind, check_name, check_number, excerpt, keep, real
from lqrsim.problem.dynamics import Dynamics
from lqrsim.results.coordinates import Coordinates, PerEntry

MEAN_STD = 0.5  # for a filter, the standard deviation of a varying unknown's mean, relative to the unknown's
SUMMED = ("start", "control", "measurement", "model_error")  # standard deviations of independent noises
GAIN, OFFSET = "gain of ", "offset of "  # before the name of a control
NODES, WEIGHTS = np.polynomial.legendre.leggauss(32)  # of Gauss and Legendre, from -1 to 1
Periods = Annotated[int, Bounds(at_least=0, at_most=1000)]  # of a delay


@checked
@dataclass(frozen=True)
class Unknown:
    """A quantity that differs from the value that the plan assumes: a stationary Gaussian process about that value.

    Args:
      of: a parameter or a disturbance of the dynamics ("mass", "wind_x"), or "gain of <control>", of which 0.1 is 10 %
        more than commanded, or "offset of <control>"; or several of them with their weights, such as {"wind_x": 0.6,
        "wind_y": 0.8} for wind in that direction.
      std: standard deviation from the plan's value, in its unit.
      time_constant: seconds in which the correlation falls to 1/e; infinite for a constant, 0 for a value that is drawn
        anew in each control period.
      order: 1, or 2 for noise filtered by (1 + sqrt(3) s) / (1 + s)^2, s in time constants: Dryden's wind across and
        upward.
      drift: random walk of a constant, per square root of a second; must be 0 for other unknowns.
    """

    of: str | Mapping[str, float]
    std: NonNegative
    time_constant: float = np.inf
    order: Annotated[int, Bounds(at_least=1, at_most=2)] = 1
    drift: NonNegative = 0.0

    def __post_init__(self) -> None:
        shares = {self.of: 1.0} if isinstance(self.of, str) else self.of
        check_kind("Unknown: of", shares, Mapping, "a name, or a dictionary of name: share")
        if not shares:
            raise InputError("Unknown: of: got no name, want at least one")
        for name, share in shares.items():
            check_string("Unknown: of", name, LINE)
            check_number(f"Unknown: of: {name}", share)
        keep(self, time_constant=check_seconds("Unknown: time_constant", self.time_constant, at_least=0.0))
        if self.order == 2 and not 0 < self.time_constant < np.inf:
            raise InputError(f"Unknown: order: got 2 with a time constant of {self.time_constant:g} s, want 1")
        if self.drift and not self.constant:
            constant = f"{self.drift:g} with a time constant of {self.time_constant:g} s"
            raise InputError(f"Unknown: drift: got {constant}, want 0, or another Unknown of the same that is constant")

    @property
    def shares(self) -> dict[str, float]:
        """Parameters or disturbances, with their weights."""
        return {self.of: 1.0} if isinstance(self.of, str) else dict(self.of)

    @property
    def name(self) -> str:
        """The name in messages."""
        return " and ".join(self.shares)

    @property
    def constant(self) -> bool:
        """Whether it is drawn once. It may still drift."""
        return self.time_constant == np.inf

    @property
    def white(self) -> bool:
        """Whether it is white noise, without a state to remember."""
        return self.time_constant == 0


@checked
@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """The uncertainty in a run that its plan does not take into account.

    Values for states or controls are one number for all, one for each, or by name or unit: {"m": 0.005, "m/s": 0.05}.

    Attributes:
      unknowns: parameters, winds, forces, actuators' gains and offsets.
      start: standard deviation of each state at the start of a run.
      control: strength of white noise on each control.
      measurement: strength of white noise on each measured state.
      model_error: strength of the model's error in each state over one control period, white noise as well. A filter
        always assumes some model error; see `OffsetFree`.
      lag: time constant in s with which the actuators follow their commands.
      delay: delay of commands in control periods.
      latency: delay of measurements in control periods.
      loss: fraction of the measurements that get lost.
      command_loss: fraction of the commands that get lost; the actuators then keep the last command that arrived.
      obstacles: standard deviation of an obstacle's position in m, along each of the world's axes; planes stay.
      left_out: disturbances that no linear model can represent, for the record.
    """

    _want = "an Uncertainty, such as uncertainty_of(...)"

    unknowns: Annotated[Sequence[Unknown], Want("a tuple of Unknown")] = ()
    start: PerEntry = 0.0
    control: PerEntry = 0.0
    measurement: PerEntry = 0.0
    model_error: PerEntry = 0.0
    lag: NonNegative = 0.0
    delay: Periods = 0
    latency: Periods = 0
    loss: Share = 0.0
    command_loss: Share = 0.0
    obstacles: NonNegative = 0.0
    left_out: Annotated[Sequence[str], Want("a tuple of texts")] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        for name in SUMMED:
            numbers = getattr(self, name)
            for key, value in numbers.items() if isinstance(numbers, Mapping) else ():
                check_number(f"Uncertainty: {name}: {excerpt(key)}", value, at_least=0.0)
            if not isinstance(numbers, Mapping) and (values := real(f"Uncertainty: {name}", numbers)).ndim:
                if values.ndim > 1:
                    raise InputError(f"Uncertainty: {name}: got {excerpt(numbers)}, want one number, or one per entry")
                keep(self, **{name: tuple(values.tolist())})

    def check(self, dynamics: Dynamics) -> None:
        """Check that the uncertainty fits a system."""
        states, controls = dynamics.state_coordinates, dynamics.control_coordinates
        for name in SUMMED:
            per_entry(f"Uncertainty: {name}", getattr(self, name), controls if name == "control" else states)
        for unknown in self.unknowns:
            for name in unknown.shares:
                check_name("Uncertainty: unknowns", name, possible_unknowns(dynamics))

    def steady(self, memory: float) -> "Uncertainty":
        """The uncertainty for a filter: varying unknowns may have a nonzero mean, and constant unknowns may change.

        In the linear model, this leaves no steady error: a filter that assumes a constant stops adapting, and one that
        assumes a wind of mean zero is biased for a steady wind.

        Args:
          memory: seconds in which a constant may wander by its standard deviation; np.inf for `as_stated`.
        """
        memory = check_seconds("memory", memory, above=0.0)
        mean_std = 0.0 if memory == np.inf else MEAN_STD
        constants: dict[tuple[tuple[str, float], ...], list[Unknown]] = {}
        for unknown in self.unknowns:
            constants.setdefault(tuple(sorted(unknown.shares.items())), []).append(unknown)
        merged = []
        for same in constants.values():
            std = float(np.hypot.reduce([unknown.std * (1.0 if unknown.constant else mean_std) for unknown in same]))
            drift = float(np.hypot.reduce([unknown.drift for unknown in same if unknown.constant] or [0.0]))
            merged.append(Unknown(same[0].of, std, drift=max(drift, std / np.sqrt(memory))))
        return replace(self, unknowns=(*merged, *(unknown for unknown in self.unknowns if not unknown.constant)))

    def as_stated(self) -> "Uncertainty":
        """The same, with its unknowns in the order of a filter's: constants stay, and what varies has the mean zero."""
        return self.steady(np.inf)


def possible_unknowns(dynamics: Dynamics) -> list[str]:
    """All names that an Unknown can have."""
    controls = dynamics.control_coordinates.names
    declared = dynamics.parameters | dynamics.disturbances
    return [*declared, *(GAIN + name for name in controls), *(OFFSET + name for name in controls)]


def check_seconds(field: str, value: float, **bounds: float) -> float:
    """A time that may be infinite."""
    return value if isinstance(value, float) and value == np.inf else check_number(field, value, **bounds)


def per_entry(field: str, numbers: PerEntry, space: Coordinates, *, above: float | None = None) -> Array:
    """One number for each entry, (len(space),). A name takes precedence over a unit; entries without a number are 0.

    With a bound, each must be above it; by default numbers may be 0, and names may be left out.
    """
    if isinstance(numbers, Mapping):
        named = space._by_name(field, numbers, check_number)
        missing = [name for i, name in enumerate(space.names) if i not in named]
        if missing and above is not None:
            wanted = f"one for each of {', '.join(space.names)}, by name or unit"
            raise InputError(f"{field}: got none for {', '.join(missing)}, want {wanted}")
        values = np.array([named.get(i, 0.0) for i in range(len(space))])
    elif real(field, numbers).ndim == 0:
        values = np.full(len(space), check_number(field, numbers))
    else:
        values = check_array(field, numbers, (None,)).copy()
        if len(values) != len(space):
            raise InputError(f"{field}: got {len(values)} numbers, want {len(space)}: {', '.join(space.labels)}")
    wrong = values < 0 if above is None else values <= above
    if wrong.any():
        i = int(np.argmax(wrong))
        want = "at least 0" if above is None else f"more than {above:g}"
        raise InputError(f"{field}: got {values[i]:g} for {space.names[i]}, want {want}")
    return values


class ShapingFilter(NamedTuple):
    """An unknown as the output h x of x' = F x + w, with as many states k as its order."""

    transition: Array  # F, (k, k)
    noise: Array  # a square root of the covariance of w, (k, k)
    output: Array  # h, (k,)
    start: Array  # a square root of the covariance of x at the start, (k, k)


def shaping_filter(unknown: Unknown, dt: float) -> ShapingFilter:
    """The shaping filter of an unknown that is not white, for a control period of dt seconds.

    The second-order filter has the states p and p', with p'' + 2 p' + p = 2 w in time constants. In the stationary
    state they have variance 1 and are uncorrelated.
    """
    std, drift = unknown.std, unknown.drift
    step = dt / unknown.time_constant
    decay = np.exp(-step)
    if unknown.order == 1:
        noise = np.hypot(std * np.sqrt(-np.expm1(-2 * step)), drift * np.sqrt(dt))  # one of the two is zero
        return ShapingFilter(np.full((1, 1), decay), np.full((1, 1), noise), np.ones(1), np.full((1, 1), std))
    F = decay * np.array([[1 + step, step], [-step, 1 - step]])
    # The integral of e^As b b' e^A's over the period. It equals I - F F', but that form cancels if the period is short.
    length = min(step, 40.0)
    s = 0.5 * length * (NODES + 1)
    noise = np.sqrt(0.5 * length * WEIGHTS) * 2 * np.exp(-s) * np.array([s, 1 - s])
    return ShapingFilter(F, triangular_root(noise), std / 2 * np.array([1.0, np.sqrt(3.0)]), np.eye(2))


def triangular_root(root: Array) -> Array:
    """The lower triangular L (..., n, n) with L L' = root root', for a root (..., n, k).

    It is found by an orthogonal transformation. Nothing is squared, so each row keeps its own relative precision.
    """
    rows, columns = root.shape[-2:]
    if columns < rows:
        root = np.concatenate([root, np.zeros((*root.shape[:-1], rows - columns))], axis=-1)
    return np.swapaxes(np.linalg.qr(np.swapaxes(root, -1, -2), mode="r"), -1, -2)


def gathered(parts: Iterable[Uncertainty]) -> Uncertainty:
    """Combine several uncertainties; noises of the same kind add up."""
    total = Uncertainty()
    for part in parts:
        numbers = {name: _added(name, getattr(total, name), getattr(part, name)) for name in SUMMED}
        total = Uncertainty(
            unknowns=(*total.unknowns, *part.unknowns), left_out=(*total.left_out, *part.left_out), **numbers,
            lag=total.lag + part.lag,  # approximately right for two lags in series
            delay=total.delay + part.delay, latency=total.latency + part.latency,
            loss=1 - (1 - total.loss) * (1 - part.loss),
            command_loss=1 - (1 - total.command_loss) * (1 - part.command_loss),
            obstacles=float(np.hypot(total.obstacles, part.obstacles)),
        )  # fmt: skip
    return total


def _added(name: str, first: PerEntry, second: PerEntry) -> PerEntry:
    """Standard deviations of the sum of two noises."""
    if first == 0 or second == 0:
        return second if first == 0 else first
    if isinstance(first, Mapping) or isinstance(second, Mapping):
        raise InputError(f"Uncertainty: {name}: got two dictionaries, {excerpt(first)} and {excerpt(second)}, want one")
    one, another = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if one.ndim and another.ndim and len(one) != len(another):
        raise InputError(f"Uncertainty: {name}: got {len(one)} and {len(another)} numbers, want as many of each")
    both = np.hypot(one, another)
    return float(both) if both.ndim == 0 else tuple(both.tolist())
