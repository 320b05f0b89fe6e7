"""The result of a verification: positions from pixels, tests of their errors against bounds, and a diagnosis."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import LINE, Line, checked
from lqrsim.errors import Array, InputError
from lqrsim.view.recorded_trial import interpolated

FEW_FRAMES = 4  # up to this number, each wrong frame is named


def diagnose(
    numbers: npt.NDArray[np.intp], times: Array, seen: Array, actual: Array, bound: float, interval: float
) -> str:
    """The explanation, as a line, that leaves nearly all positions in frames `numbers` (k,) within twice the bound."""
    where, truth, velocity = seen[numbers], actual[numbers], np.gradient(actual, times, axis=0)[numbers]
    error = where - truth
    wrong = np.flatnonzero(np.linalg.norm(error, axis=1) > bound)
    if 0 < len(wrong) <= FEW_FRAMES:
        named, crossed = numbers[wrong].astype(str), where[wrong] - truth[wrong[::-1]]
        if len(wrong) == 2 and np.linalg.norm(crossed, axis=1).max() <= 2 * bound:
            return f"frames {' and '.join(named)} are swapped"
        return f"frames that do not show their time: {', '.join(named)}"
    for axis, name in zip(range(truth.shape[1]), "xyz", strict=False):
        # If a coordinate is mirrored in one of the two views that show it, it seems to stand still.
        spread = truth[:, axis] - truth[:, axis].mean()
        slope = spread @ (where[:, axis] - where[:, axis].mean()) / max(spread @ spread, 1e-12)
        if slope < 0.25 and spread.std() > 5 * bound:
            return f"{name} is mirrored"
    offset = error.mean(axis=0)
    late = float((error * velocity).sum() / max((velocity**2).sum(), 1e-12))
    split, jump = _change_point(error, velocity)
    candidates: list[tuple[Array, str]] = []
    if np.linalg.norm(offset) > bound / 2:
        moved = np.round(1e3 * offset).astype(int).tolist()
        candidates.append((error - offset, f"a camera is off: it moves the robot by {moved} mm"))
    if abs(late) > interval / 4:
        expected = interpolated(actual, times, times[numbers] + late)
        candidates.append((where - expected, f"pictures show the run {_in_frames(late, interval)}"))
    if abs(jump) > interval / 4 and split > FEW_FRAMES:  # otherwise the whole video is late or early
        expected = interpolated(actual, times, times[numbers] + jump * (np.arange(len(numbers)) >= split))
        fault = "left out" if jump > 0 else "shown twice"
        text = f"frames are {fault} at frame {numbers[split]}: from there on, the run is {_in_frames(jump, interval)}"
        candidates.append((where - expected, text))
    if candidates:
        residual, text = min(candidates, key=lambda candidate: _quantile_95(candidate[0]))
        if _quantile_95(residual) <= 2 * bound:
            return text
    if _quantile_95(error) <= 2 * bound:
        return "the pictures are too small or too coarse"
    return "pictures of another run than the record's: another seed, trial or policy; or another robot's body"


def _change_point(error: Array, velocity: Array) -> tuple[int, float]:
    """The first frame whose error is velocity times a delay, and the delay; earlier frames have no errors."""
    products, squares = (error * velocity).sum(axis=1), (velocity**2).sum(axis=1)
    tails = [np.cumsum(part[::-1])[::-1] for part in (products, squares)]
    gained = tails[0] ** 2 / np.maximum(tails[1], 1e-12)  # reduction of the sum of squares by a break there
    split = int(gained.argmax())
    return split, float(tails[0][split] / max(tails[1][split], 1e-12))


def _in_frames(seconds: float, interval: float) -> str:
    return f"{abs(seconds) / interval:.1f} frames {'early' if seconds > 0 else 'late'}"


def _quantile_95(vectors: Array) -> float:
    return float(np.quantile(np.linalg.norm(vectors, axis=1), 0.95))


HIDDEN_FRACTION = 0.05  # of the frames, in which the robot may be hidden
SCALE_ERROR = 0.002  # largest, of the scale
VERDICTS = {True: "passed", False: "FAILED", None: "not checked"}


@checked
@dataclass(frozen=True)
class Criterion:
    """One test of a verification."""

    __test__ = False  # pytest would collect it

    name: Line
    passed: bool | None  # None if it could not be checked
    detail: Line  # the measured value, and the required value


@checked
@dataclass(frozen=True, eq=False)
class Verification:
    """Positions of a run from pixels, in N frames with d coordinates, and the tests that they passed.

    Attributes:
      seen: (N, d) positions from pixels in metres; NaN where the robot is hidden.
      actual: (N, d) positions in the simulator.
      planned: (N, d) positions in the plan.
      rms: root mean square of the distance between seen and actual, in metres.
      worst: largest distance between seen and actual, in metres.
      shift: shift of the pictures ahead of the run, in seconds.
      scale: scale of the seen motion relative to the actual one.
      likely: the likely cause if a test failed; otherwise empty.
    """

    subject: Annotated[str, 10 * LINE]
    method: Annotated[str, 10 * LINE]
    times: Annotated[Array, "N"]
    seen: Annotated[Array, "N d"]
    actual: Annotated[Array, "N d"]
    planned: Annotated[Array, "N d"]
    rms: float
    worst: float
    shift: float
    scale: float
    tests: tuple[Criterion, ...]
    likely: Annotated[str, 10 * LINE]

    def __post_init__(self) -> None:
        if not len(self.times):
            raise InputError("Verification: times: got none, want one for each frame")

    @property
    def passed(self) -> bool:
        return all(test.passed is not False for test in self.tests)

    @property
    def tracking_error(self) -> Array:
        """Distance from the plan by pixels, in metres, (N,)."""
        return np.linalg.norm(self.seen - self.planned, axis=1)

    def summary(self) -> str:
        """The verdict, and a line for each test."""
        error, recorded = self.tracking_error, np.linalg.norm(self.actual - self.planned, axis=1)
        lines = [
            f"{'verified' if self.passed else 'NOT VERIFIED'}: {self.subject}, by {self.method}",
            f"  off the simulator's position by {1e3 * self.rms:.1f} mm rms, {1e3 * self.worst:.1f} mm at worst;"
            f" {1e3 * self.shift:+.1f} ms ahead; scale {self.scale:.4f}",
            f"  off the plan by {1e3 * _rms(error):.0f} mm rms, {1e3 * np.nanmax(error, initial=0):.0f} mm at worst;"
            f" the record says {1e3 * _rms(recorded):.0f} and {1e3 * recorded.max():.0f} mm",
        ]
        lines += [f"  {VERDICTS[test.passed]}  {test.name}: {test.detail}" for test in self.tests]
        return "\n".join(lines + ([f"  likely: {self.likely}"] if self.likely else []))

    __str__ = summary


def compare(
    subject: str,
    method: str,
    times: Array,
    *,
    seen: Array,
    actual: Array,
    planned: Array,
    apart: Array,
    bound: float,
    interval: float,
    others: tuple[Criterion, ...],
) -> Verification:
    """Compare positions (N, d) from pixels with the actual ones; `apart` (N,) is the views' disagreement in metres.

    The shift must be less than a quarter of `interval`, the seconds between two frames.
    """
    good = np.asarray(np.isfinite(seen).all(axis=1))
    detail = f"in {good.sum()} of {len(good)} frames, want {100 * (1 - HIDDEN_FRACTION):.0f} % of them"
    tests = [*others, Criterion("seen", bool(good.mean() >= 1 - HIDDEN_FRACTION) and int(good.sum()) > 2, detail)]
    rms, worst, shift, scale, likely = np.nan, np.nan, np.nan, np.nan, "the robot is not in the pictures, or too small"
    if good.sum() > 2:
        error, velocity = (seen - actual)[good], np.gradient(actual, times, axis=0)[good]
        distance = np.linalg.norm(error, axis=1)
        (shift, shift_error), (stretch, stretch_error) = _fit(error, velocity, actual[good])
        # A robot that hardly moves determines neither shift nor scale; the bound is then the uncertainty of the fit.
        late, wide = max(interval / 4, 4 * shift_error), max(SCALE_ERROR, 4 * stretch_error)
        rms, worst, scale, when = _rms(distance), float(distance.max()), 1 + stretch, times[good][distance.argmax()]
        detail = f"at worst {1e3 * worst:.1f} mm off, at {when:.2f} s, want {1e3 * bound:.1f} at most"
        tests.append(Criterion("position", worst <= bound, detail))
        if (most := float(apart[good].max())) > 0:  # a single view cannot disagree
            detail = f"at worst {1e3 * most:.1f} mm apart, want {1e3 * bound:.1f} at most"
            tests.append(Criterion("views agree", most <= bound, detail))
        detail = f"{1e3 * shift:+.1f} ms ahead, want {1e3 * late:.1f} at most either way"
        tests.append(Criterion("time", abs(shift) <= late, detail))
        tests.append(Criterion("scale", abs(stretch) <= wide, f"{scale:.4f}, want 1 within {wide:.4f}"))
        likely = _likely_cause(tests, times, seen, actual, bound, interval)
    return Verification(subject, method, times, seen, actual, planned, rms, worst, shift, scale, tuple(tests), likely)


def _likely_cause(
    tests: Sequence[Criterion], times: Array, seen: Array, actual: Array, bound: float, interval: float
) -> str:
    """The likely cause of a failure, as a line; empty if no test failed."""
    failed = {test.name for test in tests if test.passed is False}
    if "thickness" in failed:
        return "the geom is too thin to be seen: give its body a thicker one that can collide, or plan a shorter way"
    if "mark" in failed:
        return "the panes are too small: render the video larger, or with fewer of them"
    if failed & {"position", "time", "scale", "views agree"}:
        return diagnose(np.flatnonzero(np.isfinite(seen).all(axis=1)), times, seen, actual, bound, interval)
    causes = {
        "run": "the video is of another run, or the file of this run has changed",
        "plan": "the plan in this file is not the one that the policy followed",
        "frames": "frames were cut from the video or added to it, or its speed was changed",
        "record": "frames and states in the file are not of the same run",
        "seen": "something covers the robot, or it leaves the picture",
    }
    return "; ".join(cause for name, cause in causes.items() if name in failed)


def _fit(error: Array, velocity: Array, actual: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """The shift in seconds and the stretch that fit the errors (k, d), each with its standard error.

    error = offset + shift * velocity + stretch * (actual - mean of actual), by least squares with a free offset.
    """
    columns = np.stack([(part - part.mean(axis=0)).ravel() for part in (velocity, actual)], axis=1)
    inverse, centred = np.linalg.pinv(columns), (error - error.mean(axis=0)).ravel()
    fit = inverse @ centred
    noise = float(np.linalg.norm(centred - columns @ fit)) / max(np.sqrt(len(centred) - 4), 1)
    uncertain = noise * np.linalg.norm(inverse, axis=1)
    return (float(fit[0]), float(uncertain[0])), (float(fit[1]), float(uncertain[1]))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else np.nan
