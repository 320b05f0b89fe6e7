"""Spoilt files: each is to be read as it was written, or refused in one line of InputError, and soon.

File number i of a seed is spoilt in the same way wherever it is made. Half of those whose contents are changed get the
hash of their contents anew, as if another program had written them. These may be read as something else, but what is
read must be of use, or be refused where it is used, in one line too.

A verdict is "refused", "identical" or "accepted" (sealed anew, and of use); or a failure: "raw" (an exception, and not
one line of InputError), "other" (not what was saved), "useless" (a raw exception in its use), "slow" or "large".
"""

import contextlib
import dataclasses
import json
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import lqrsim as ls
from lqrsim.control.tubes import predict_tube
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import LONGEST, InputError
from lqrsim.simulation.disturbances import MeasurementNoise
from lqrsim.stress.campaign import run_campaign
from lqrsim.stress.results import Results, digest_of_rows
from lqrsim.stress.study import Campaign
from lqrsim.view.recorded_trial import RecordedTrial
from robustness import mutations
from robustness.common import Config, Hang, limited
from robustness.mutations import pick

FAILURES = ("raw", "other", "useless", "slow", "large")
PATIENCE = 20.0  # seconds of the processor to read a file, and to use it
MEMORY = 1 << 30  # bytes by which reading a file may raise the most that the process has had
PERIODS = 20_000  # physics steps of a run that is tried


@dataclass(frozen=True)
class Verdict:
    """Result of one file: `what` is how it was spoilt, `why` what was raised."""

    number: int
    subject: str
    kind: str
    what: str
    why: str = ""


@dataclass(frozen=True)
class Saved:
    """A file as it was written."""

    load: Callable[[Path], Any]
    use: Callable[[Any], None]
    data: bytes
    stored: bytes
    arrays: mutations.Arrays
    meta: dict[str, Any]
    loaded: Any

    @classmethod
    def read(cls, path: Path, load: Callable[[Path], Any], use: Callable[[Any], None]) -> "Saved":
        with np.load(path) as archive:
            arrays = dict(archive)
        text = arrays.pop("meta")
        members = [(f"{name}.npy", mutations.member(array)) for name, array in (arrays | {"meta": text}).items()]
        stored = mutations.archive(members, zipfile.ZIP_STORED)
        return cls(load, use, path.read_bytes(), stored, arrays, json.loads(str(text)), load(path))


class Spoiler:
    """Makes and judges file number i of a seed, in a folder of its own."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.seed = folder, seed
        self.plant = ls.scenarios.differential_drive().plant()
        self.saved = {name: self._saved(name, one) for name, one in originals().items()}
        self.campaign = campaign(folder / "campaign")
        self.tables = everything(Results(self.campaign))

    def _saved(self, name: str, one: ls.Solution | ls.Rollout) -> Saved:
        path = ls.save(one, self.folder / f"{name}.npz")
        saved = Saved.read(path, *((ls.load, use_rollout) if name == "rollout" else (ls.load, self.use)))
        assert same(saved.loaded, one), f"{name} is not what was saved"
        assert ls.save(saved.loaded, self.folder / "again.npz").read_bytes() == saved.data, f"{name} is saved otherwise"
        return saved

    def __call__(self, number: int) -> Verdict:
        rng = np.random.default_rng([self.seed, number])
        subject = pick(rng, [*self.saved, *self.saved, "campaign"])
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            if subject == "campaign":
                return self._campaign(rng, number)
            what, data, sealed = self._spoilt(rng, self.saved[subject])
            path = self.folder / "spoilt.npz"
            path.write_bytes(data)
            return self.judge(number, subject, what, path, sealed=sealed)

    def _spoilt(self, rng: np.random.Generator, saved: Saved) -> tuple[str, bytes, bool]:
        how, sealed = pick(rng, ("bytes", "members", "json", "json", "text")), bool(rng.random() < 0.5)
        if how == "bytes":
            other = pick(rng, list(self.saved.values())).data
            return *mutations.spoil_bytes(rng, pick(rng, (saved.data, saved.stored)), other), False
        if how == "members":
            return *mutations.spoil_members(rng, saved.arrays, saved.meta, sealed=sealed), sealed
        if how == "json":
            what, meta = mutations.spoil_json(rng, saved.meta)
            if sealed and isinstance(meta, dict):
                meta["sha256"] = mutations.seal(saved.arrays, meta)
            text = json.dumps(meta)
        else:
            what, text = mutations.spoil_text(rng, saved.meta)
            sealed = False
        members = [(f"{name}.npy", mutations.member(array)) for name, array in saved.arrays.items()]
        data = mutations.archive([*members, ("meta.npy", mutations.member(np.array(text)))], zipfile.ZIP_STORED)
        return what, data, sealed

    def judge(self, number: int, subject: str, what: str, path: Path, *, sealed: bool) -> Verdict:
        """The verdict on a file that replaces a saved one."""
        saved, what = self.saved[subject], f"{what}{', sealed' if sealed else ''}"
        begun, had, why = time.process_time(), most_memory(), ""
        try:
            with limited(PATIENCE):
                loaded = saved.load(path)
            # Spliced near its beginning, a file is another one of these.
            whole = any(same(loaded, each.loaded) for each in self.saved.values())
            kind = "identical" if whole else "accepted" if sealed else "other"
        except (Exception, Hang) as error:
            loaded, (kind, why) = saved.loaded, refusal(error)
        if most_memory() > had + MEMORY:
            kind = "large"
        if kind == "accepted":
            try:
                with limited(PATIENCE):
                    saved.use(loaded)
                    again = ls.save(loaded, self.folder / "again.npz")
                    kind = "accepted" if same(saved.load(again), loaded) else "other"
            except (Exception, Hang) as error:
                kind, why = refusal(error)
                kind = {"raw": "useless", "refused": "accepted"}.get(kind, kind)
        if time.process_time() - begun > PATIENCE:
            kind = "slow"
        return Verdict(number, subject, kind, what, why)

    def _campaign(self, rng: np.random.Generator, number: int) -> Verdict:
        """One file of a campaign's folder is spoilt, or lost, or takes another's place."""
        files = sorted(path for path in self.campaign.rglob("*") if path.is_file() and path.name != "campaign.lock")
        path = pick(rng, [file for file in files if file.name == "manifest.json"] * len(files) + files)
        data, sealed = path.read_bytes(), False
        if path.name == "manifest.json" and rng.random() < 0.7:
            what, spoilt, sealed = spoilt_manifest(rng, data)
        elif rng.random() < 0.1:
            what, spoilt = "another's", pick(rng, files).read_bytes()
        else:
            what, spoilt = mutations.spoil_bytes(rng, data, pick(rng, files).read_bytes())
        what = f"{path.name}: {what}{', sealed' if sealed else ''}"
        begun, had = time.process_time(), most_memory()
        try:
            path.write_bytes(spoilt)
            with limited(PATIENCE):
                results = Results(self.campaign)
                found = everything(results)
                kind, why = "identical" if same(found, self.tables) else "other", ""
                if kind == "identical" and sealed:
                    _ = results.campaign
        except (Exception, Hang) as error:
            kind, why = refusal(error)
        finally:
            path.write_bytes(data)
        if most_memory() > had + MEMORY:
            kind = "large"
        if time.process_time() - begun > PATIENCE:
            kind = "slow"
        return Verdict(number, "campaign", kind, what, why)

    def use(self, solution: ls.Solution) -> None:
        """Use a solution as people do."""
        print(solution, file=_Nowhere())
        solution.policy(np.zeros(3), 0.1)
        solution.open_loop()
        if solution.trajectory.steps > 1:
            solution.shifted(1)
        if self.plant.substeps(solution.trajectory.dt) * solution.trajectory.steps <= PERIODS:
            str(ls.simulate(self.plant, solution, frames=False, threads=1))


def use_rollout(rollout: ls.Rollout) -> None:
    """Use a rollout as people do, except for drawing it."""
    print(rollout, rollout.outcome, rollout.saturated.mean(), file=_Nowhere())
    recorded = RecordedTrial(rollout, 0)
    for look in (recorded.driven, recorded.planned, recorded.force_at, recorded.ending):
        look(recorded.end / 2)


def originals() -> dict[str, ls.Solution | ls.Rollout]:
    """Solutions that together have every optional part, and a rollout."""
    scenario = ls.scenarios.differential_drive()
    clear = ls.Clearance(scenario.scene.world, radius=scenario.robot.radius, margin=0.16)
    found = ls.smooth(scenario.problem)
    kept = ls.smooth(dataclasses.replace(scenario.problem, constraints=[clear]))
    assert found.inverse_policy is not None
    assert found.candidates
    assert kept.multipliers
    disturbances = [*scenario.disturbances, MeasurementNoise(0.001)]
    run = ls.simulate(scenario.plant(), found, disturbances=disturbances, trials=2)
    tube = predict_tube(scenario.problem, found, Uncertainty(control=0.05, measurement={"m": 0.01, "rad": 0.02}))
    return {
        "solution": dataclasses.replace(found, multipliers=kept.multipliers, scenario="differential_drive"),
        "kept": kept,
        "bare": ls.ilqr(scenario.problem, max_iterations=2),
        "rollout": tube.added_to(run),
    }


def campaign(folder: Path) -> Path:
    """A small campaign."""
    asked = Campaign(
        scenario="differential_drive",
        sweeps={"gusts": (ls.disturbances.ForceNoise(0.2), ls.disturbances.ControlNoise(0.01))},
        strengths=(0.0, 1.0),
        policies=("smooth", "open_loop"),
        trials=5,
        shard=3,
    )
    return run_campaign(asked, folder, workers=0).folder


def everything(results: Results) -> Any:
    """All tables of a campaign."""
    results.summary()
    policies = [results.solution(policy) for policy in results.manifest.policies]
    return tuple(results.cells), tuple(results.outcomes(cell) for cell in results.cells), tuple(policies)


def spoilt_manifest(rng: np.random.Generator, data: bytes) -> tuple[str, bytes, bool]:
    """Its text, or what it says; one in two with its hashes made anew, as far as one can without running it."""
    manifest = json.loads(data)
    if rng.random() < 0.3:
        what, text = mutations.spoil_text(rng, manifest)
        return what, text.encode("utf-8", "surrogatepass"), False
    what, manifest = mutations.spoil_json(rng, manifest)
    sealed = bool(rng.random() < 0.5) and isinstance(manifest, dict)
    if sealed:
        with contextlib.suppress(Exception):  # where it has none of what that is made of any more
            manifest["digest"] = digest_of_rows(manifest) if rng.random() < 0.5 else manifest["digest"]
        rest = {name: value for name, value in manifest.items() if name != "sha256"}
        text = json.dumps(rest, sort_keys=True, separators=(",", ":"))
        manifest["sha256"] = mutations.hashlib.sha256(text.encode()).hexdigest()
    return what, json.dumps(manifest).encode(), sealed


def refusal(error: Exception | Hang) -> tuple[str, str]:
    """Whether an exception is one clear line, and where it comes from if not."""
    line = str(error)
    if isinstance(error, Hang):
        return "slow", line
    if isinstance(error, InputError) and len(line.splitlines()) == 1 and 0 < len(line) <= LONGEST:
        return "refused", line
    place = traceback.extract_tb(error.__traceback__)[-1]
    return "raw", f"{type(error).__name__}: {line[:200]} at {Path(place.filename).name}:{place.lineno}"


def same(a: object, b: object) -> bool:
    """Equal in every field that is compared and of the same types, arrays to the bit."""
    if dataclasses.is_dataclass(a) and not isinstance(a, type):
        names = [field.name for field in dataclasses.fields(a) if field.compare]
        return type(a) is type(b) and all(same(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, np.ndarray):
        alike = isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape
        return alike and np.ascontiguousarray(a).tobytes() == np.ascontiguousarray(b).tobytes()
    if isinstance(a, tuple | list):
        return isinstance(b, tuple | list) and type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return type(a) is type(b) and (a == b or (a != a and b != b))


def most_memory() -> int:
    """The most bytes that this process has had; 0 where the system does not say."""
    if sys.platform == "win32":
        return 0
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


class _Nowhere:
    def write(self, text: str) -> int:
        """Forget it, but see that it can be written."""
        return len(text.encode())


def verdicts(count: int, *, seed: int = 0, first: int = 0, progress: bool = False) -> Iterator[Verdict]:
    """So many spoilt files, one after the other."""
    with tempfile.TemporaryDirectory() as folder:
        spoiler = Spoiler(Path(folder), seed)
        for number in tqdm(range(first, first + count), unit="file", disable=None if progress else True):
            yield spoiler(number)


def measure(config: Config) -> dict[str, Any]:
    """Counts of verdicts by what was spoilt, the time it took, and each failure with the number that repeats it."""
    begun, counts, failures = time.monotonic(), dict[str, Counter[str]](), []
    for verdict in verdicts(config.mutations, seed=config.seed, first=config.first, progress=not config.json):
        counts.setdefault(verdict.subject, Counter())[verdict.kind] += 1
        if verdict.kind in FAILURES:
            failures.append(dataclasses.asdict(verdict))
    counted = {subject: dict(found) for subject, found in sorted(counts.items())}
    return {"counts": counted, "seconds": time.monotonic() - begun, "failures": failures}


def report(result: dict[str, Any]) -> list[str]:
    """The counts, and each failure with how to repeat it."""
    kinds = ("refused", "identical", "accepted", *FAILURES)
    lines = [f"{'spoilt files of a':<18}{'all':>8}" + "".join(f"{kind:>11}" for kind in kinds)]
    total: Counter[str] = Counter()
    for subject, found in result["counts"].items():
        total.update(found)
        lines.append(f"{subject:<18}{sum(found.values()):>8}" + "".join(f"{found.get(kind, 0):>11}" for kind in kinds))
    lines.append(f"{'all':<18}{total.total():>8}" + "".join(f"{total[kind]:>11}" for kind in kinds))
    lines += [
        f"{one['kind']}: --first {one['number']} --mutations 1: {one['subject']}, {one['what']}: {one['why']}"
        for one in result["failures"]
    ]
    return ["\n".join([*lines, f"{len(result['failures'])} failures in {result['seconds']:.0f} s"])]
