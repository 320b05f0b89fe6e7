"""A diagnosis of pictures that do not match the record of a run."""

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array

FEW_FRAMES = 4  # up to this number of wrong frames, each is named


def diagnose(
    numbers: npt.NDArray[np.intp], times: Array, seen: Array, actual: Array, bound: float, interval: float
) -> str:
    """The explanation that leaves nearly all positions within twice the bound, as a line.

    Args:
      numbers: (k,) of the frames in which the robot is seen.
      times, seen, actual: of all frames.
      bound: on the error, in metres.
      interval: seconds between frames.
    """
    where, truth, velocity = seen[numbers], actual[numbers], np.gradient(actual, times, axis=0)[numbers]
    error = where - truth
    wrong = np.flatnonzero(_lengths(error) > bound)
    if 0 < len(wrong) <= FEW_FRAMES:
        return _single_frames(wrong, numbers, where, truth, 2 * bound)
    for axis, name in zip(range(truth.shape[1]), "xyz", strict=False):
        # Mirrored in one of the two views that show it, a coordinate seems to stand still.
        spread = truth[:, axis] - truth[:, axis].mean()
        slope = spread @ (where[:, axis] - where[:, axis].mean()) / max(spread @ spread, 1e-12)
        if slope < 0.25 and spread.std() > 5 * bound:
            return f"{name} is mirrored"
    offset = error.mean(axis=0)
    late = _slope(error, velocity)
    split, ahead = _change_point(error, velocity)
    candidates: list[tuple[Array, str]] = []
    if _lengths(offset) > bound / 2:
        moved = np.round(1e3 * offset).astype(int).tolist()
        candidates.append((error - offset, f"a camera is off: it moves the robot by {moved} mm"))
    if abs(late) > interval / 4:
        shown = _positions_at(times, actual, times[numbers] + late)
        candidates.append((where - shown, f"pictures show the run {_in_frames(late, interval)}"))
    if abs(ahead) > interval / 4 and split > FEW_FRAMES:  # otherwise the whole video is late or early
        shown = _positions_at(times, actual, times[numbers] + ahead * (np.arange(len(numbers)) >= split))
        said = "left out" if ahead > 0 else "shown twice"
        said = f"frames are {said} at frame {numbers[split]}: from there on, the run is {_in_frames(ahead, interval)}"
        candidates.append((where - shown, said))
    if candidates:
        rest, said = min(candidates, key=lambda candidate: _quantile_95(candidate[0]))
        if _quantile_95(rest) <= 2 * bound:
            return said
    if _quantile_95(error) <= 2 * bound:
        return "the pictures are too small or too coarse"
    return "pictures of another run than the record's: another seed, trial or policy; or another robot's body"


def _single_frames(
    wrong: npt.NDArray[np.intp], numbers: npt.NDArray[np.intp], seen: Array, actual: Array, near: float
) -> str:
    """The frames that do not show their time, and whether two of them are swapped."""
    if len(wrong) == 2:
        first, second = wrong
        crossed = seen[[first, second]] - actual[[second, first]]
        if _lengths(crossed).max() <= near:
            return f"frames {numbers[first]} and {numbers[second]} are swapped"
    return f"frames that do not show their time: {', '.join(str(numbers[one]) for one in wrong)}"


def _slope(error: Array, velocity: Array) -> float:
    return float((error * velocity).sum() / max((velocity**2).sum(), 1e-12))


def _change_point(error: Array, velocity: Array) -> tuple[int, float]:
    """The frame from which on errors are velocity times a delay, and the delay; before it there are no errors."""
    products, squares = ((error * velocity).sum(axis=1), (velocity**2).sum(axis=1))
    tails = [np.cumsum(part[::-1])[::-1] for part in (products, squares)]
    gained = tails[0] ** 2 / np.maximum(tails[1], 1e-12)  # the reduction of the squares by a break there
    split = int(gained.argmax())
    return split, float(tails[0][split] / max(tails[1][split], 1e-12))


def _positions_at(times: Array, places: Array, when: Array) -> Array:
    return np.stack([np.interp(when, times, column) for column in places.T], axis=1)


def _in_frames(seconds: float, interval: float) -> str:
    return f"{abs(seconds) / interval:.1f} frames {'early' if seconds > 0 else 'late'}"


def _lengths(vectors: Array) -> npt.NDArray[np.float64]:
    """Lengths (...) of vectors (..., d)."""
    return np.linalg.norm(vectors, axis=-1)


def _quantile_95(vectors: Array) -> float:
    """The 95 % quantile of the lengths."""
    return float(np.quantile(_lengths(vectors), 0.95))
