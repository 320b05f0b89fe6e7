"""How accurately positions are measured from pixels, and whether faults are found, on both robots' runs and videos.

    python experiments/benchmark_verification.py            # some minutes; the table of docs/verifying.md
    python experiments/benchmark_verification.py --quick    # small videos of fewer frames
    python experiments/benchmark_verification.py --json     # all that is measured, for other programs

The runs are the demo's. Each is drawn and measured; its video is rendered at standard quality with all overlays, and
measured as its file has it. Then each fault is made in the decoded frames, which are encoded again, or in what the file
says of itself.
"""

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import injected_faults as faults
from runner import Settings, counting, judge, opening, progress, run

import lqrsim as ls
from lqrsim.view import gl
from lqrsim.view.render import digest, read_metadata

VIEWS = {"quadrotor": ("top", "side"), "differential_drive": ("top",)}  # a camera, and insets
RUN, VIDEO = "the run, drawn", "the video"
# Millimetres, and of what.
MOST = {
    ("quadrotor", RUN): ("worst", 5.0),
    ("quadrotor", VIDEO): ("rms", 10.0),
    ("differential_drive", RUN): ("worst", 3.0),
    ("differential_drive", VIDEO): ("worst", 5.0),
}
SAID = {"rms": "rms", "worst": "at worst"}


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    seed: int = 0
    """Of the disturbances; the other run's is the next."""


def main(config: Config) -> dict[str, Any]:
    gl.bind()
    with tempfile.TemporaryDirectory() as folder:
        robots = {name: measure(name, config, Path(folder)) for name in VIEWS}
    return opening(config) | {"robots": robots}


def measure(name: str, config: Config, folder: Path) -> dict[str, dict[str, Any]]:
    """Results of verification, by what is verified."""
    scenario = ls.scenarios.get(name)
    solution, plant = ls.smooth(scenario.problem), scenario.plant()
    tube = ls.predict_tube(scenario.problem, solution, ls.uncertainty_of(plant, scenario.disturbances))
    disturbed, other = (
        tube.added_to(ls.simulate(plant, solution, disturbances=scenario.disturbances, seed=seed))
        for seed in (config.seed, config.seed + 1)
    )
    video, changed = folder / f"{name}.mp4", folder / f"{name}_changed.mp4"
    camera, *insets = VIEWS[name]
    quality, fps = ("draft", 10) if config.quick else ("standard", 30)
    with counting(f"{name}, rendering") as rendered:
        options = {"camera": camera, "insets": insets, "quality": quality, "fps": fps}
        ls.render(disturbed, video, progress=rendered, **options)
    found = {
        RUN: verdict(ls.verify_run(disturbed, solution=solution)),
        VIDEO: verdict(ls.verify_video(video, disturbed, solution=solution)),
    }
    made = all_faults(video, digest(other))
    for label, (make, is_other) in progress(made.items(), f"{name}, faults"):
        make(video, changed)
        found[label] = verdict(ls.verify_video(changed, other if is_other else disturbed, solution=solution))
    return found


def all_faults(video: Path, digest: str) -> dict[str, tuple[faults.Fault, bool]]:
    """The function that makes each fault, and whether its file then claims to show the run of that digest."""
    views = [camera for _, camera in faults.calibrated(read_metadata(video))]
    made: dict[str, tuple[faults.Fault, bool]] = {
        "one frame late": (faults.late, False),
        "one frame dropped": (faults.dropped, False),
        "two frames swapped": (faults.swapped, False),
        f"`{views[0].name}` mirrored": (faults.mirrored, False),
    }
    for view in views:
        for axis in (
            axis for axis in range(3) if view.forward[axis] == 0
        ):  # along its line of sight it may be anywhere
            made[f"`{view.name}` off by {100 * faults.OFF:g} cm in {'xyz'[axis]}"] = (
                faults.off(view.name, axis),
                False,
            )
    return made | {"another seed's run, its digest forged": (faults.forged(digest), True)}


def verdict(found: ls.types.Verification) -> dict[str, Any]:
    return {
        "rms": 1e3 * found.rms, "worst": 1e3 * found.worst, "shift": found.shift, "scale": found.scale,
        "frames": len(found.times), "passed": found.passed, "likely": found.likely,
        "failed": [test.name for test in found.tests if test.passed is False],
    }  # fmt: skip


def report(result: dict[str, Any]) -> str:
    robots = result["robots"]
    heads = [head for name in robots for head in (f"{name.replace('_', ' ')} rms", "worst")]
    rows = [f"| | {' | '.join(heads)} | verdict | likely cause given |", "|---" * (3 + len(heads)) + "|"]
    labels = list(dict.fromkeys(label for found in robots.values() for label in found))
    for label in labels:
        found = [one[label] for one in robots.values() if label in one]
        numbers = [
            f"{one[label][of]:.1f}" if label in one else "" for one in robots.values() for of in ("rms", "worst")
        ]
        verdicts = joined("passed" if one["passed"] else "refused" for one in found)
        likely = joined(one["likely"].split(":")[0].split(";")[0] for one in found)
        rows.append(f"| {label} | {' | '.join(numbers)} | {verdicts} | {likely} |")
    rows.append("")
    for (name, label), (of, most) in MOST.items():
        value, want = robots[name][label][of], f"{most:g} mm or less {SAID[of]}"
        rows.append(f"{name}, {label}: {value:.1f} mm {SAID[of]}  {judge(value <= most, want)}")
    honest, faulty = (
        [one["passed"] for found in robots.values() for label, one in found.items() if (label in (RUN, VIDEO)) is kind]
        for kind in (True, False)
    )
    rows += [
        f"without a fault: {sum(honest)} of {len(honest)} pass  {judge(all(honest), 'all')}",
        f"with one: {faulty.count(False)} of {len(faulty)} are refused  {judge(not any(faulty), 'all')}",
    ]
    return "\n".join(rows)


def joined(said: Iterable[str]) -> str:
    """The robots' entries in order; once, where all are equal."""
    return " / ".join(dict.fromkeys(said))


if __name__ == "__main__":
    run(Config, main, report, __doc__)
