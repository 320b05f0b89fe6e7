"""What is likely to be wrong with pictures that do not show what a run's record says."""

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array

FEW = 4  # frames that may be wrong one by one


def explain(
    numbers: npt.NDArray[np.intp], times: Array, seen: Array, actual: Array, bound: float, interval: float
) -> str:
    """The first explanation after which the positions fit within twice the bound, in a line.

    Args:
      numbers: (k,) of the frames in which the robot is seen. times, seen, actual: of all frames.
      bound: in metres. interval: seconds between frames.
    """
    where, truth, velocity = seen[numbers], actual[numbers], np.gradient(actual, times, axis=0)[numbers]
    error = where - truth
    wrong = np.flatnonzero(_length(error) > bound)
    if 0 < len(wrong) <= FEW:
        return _single(wrong, numbers, where, truth, 2 * bound)
    for axis, name in zip(range(truth.shape[1]), "xyz", strict=False):
        spread = truth[:, axis] - truth[:, axis].mean()
        if spread @ (where[:, axis] - where[:, axis].mean()) < -0.5 * (spread @ spread):
            return f"{name} is mirrored"
    offset = error.mean(axis=0)
    late = _slope(error, velocity)
    split, ahead = _break(error, velocity)
    after = np.arange(len(error)) >= split
    candidates = [
        (error - offset, f"a camera is off, which moves the robot by {np.round(1e3 * offset).astype(int).tolist()} mm"),
        (error - late * velocity, f"pictures show the run {_frames(late, interval)}"),
        (error - ahead * after[:, None] * velocity, f"from frame {numbers[split]} on, pictures show the run"
         f" {_frames(ahead, interval)}: frames are {'missing' if ahead > 0 else 'shown twice'} there"),
    ]  # fmt: skip
    rest, said = min(candidates, key=lambda candidate: _length(candidate[0]).max())
    if _length(rest).max() <= 2 * bound:
        return said
    return "pictures of another run than the record's: another seed, trial, or policy"


def _single(wrong: npt.NDArray[np.intp], numbers: npt.NDArray[np.intp], seen: Array, actual: Array, near: float) -> str:
    """Which frames do not show their moment, and whether two show each other's."""
    if len(wrong) == 2:
        first, second = wrong
        crossed = seen[[first, second]] - actual[[second, first]]
        if _length(crossed).max() <= near:
            return f"frames {numbers[first]} and {numbers[second]} are swapped"
    return f"frames that do not show their moment: {', '.join(str(numbers[one]) for one in wrong)}"


def _slope(error: Array, velocity: Array) -> float:
    return float((error * velocity).sum() / max((velocity**2).sum(), 1e-12))


def _break(error: Array, velocity: Array) -> tuple[int, float]:
    """The frame from which on errors are velocity times a number of seconds, and before which there are none."""
    products, squares = ((error * velocity).sum(axis=1), (velocity**2).sum(axis=1))
    tails = [np.cumsum(part[::-1])[::-1] for part in (products, squares)]
    gained = tails[0] ** 2 / np.maximum(tails[1], 1e-12)  # by how much a break there reduces the squares
    split = int(gained.argmax())
    return split, float(tails[0][split] / max(tails[1][split], 1e-12))


def _frames(seconds: float, interval: float) -> str:
    return f"{abs(seconds) / interval:.1f} frames {'early' if seconds > 0 else 'late'}"


def _length(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=1)
